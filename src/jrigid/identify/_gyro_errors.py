"""Whether a gyroscope has a filter, a scale or a delay that the fit leaves out.

A first-order filter with a time constant tau makes y - tau y' + tau^2 y'' - ... of the
rates y. The second term is a delay, and states that are sought take it up. A delay by
tau has half of the third term. The other half, tau^2 y'' / 2, attenuates the wobble,
and looks like another inertia. It may be much less than the noise of a reading, and
many errors of what a long record says of the inertia. So it is sought among the
residuals, beside all that the fit has sought, as one more number.

A scale that is off by a few parts in a thousand leaves residuals of nearly the same
shape. Therefore it is sought in the same way, and whichever explains more is named.
Beside another sensor, whose readings are not late, a delay is a third such number.
"""

import dataclasses
import math
from collections.abc import Sequence
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from jrigid._numerics import or_one
from jrigid.identify import _host as host
from jrigid.identify import _quality as quality
from jrigid.identify._independent import independent_rows
from jrigid.identify._precision import of_numbers, without_states
from jrigid.identify._quality import GATE, Fit
from jrigid.identify._sensors import Gyro

# Standard errors of a number beyond which it is no chance.
_SURE = 6.0
# Part of what the fit does not explain, for an error of the gyroscope to be named.
_EXPLAINED = 0.5
# Part of the square of the rates' changes that free rotation must explain. Where a
# torque moves the body as much, the derivatives below are not those of the motion.
_FREE = 0.8
# Part of the square of an effect that nothing else may imitate, to be shown.
_UNSHOWN = 1e-10


class Lag(NamedTuple):
    """A low-pass filter that would explain residuals of a gyroscope.

    Attributes:
        time_constant: Of the filter [s]; 0 if the residuals show the opposite.
        deviations: Standard errors of its effect; negative if they show the opposite.
    """

    time_constant: float
    deviations: float


class Gain(NamedTuple):
    """A factor in the scale of a gyroscope that would explain residuals.

    Attributes:
        factor: Of all readings without their bias.
        deviations: Standard errors from 1.
    """

    factor: float
    deviations: float


class Delay(NamedTuple):
    """A delay of a gyroscope that would explain residuals.

    Attributes:
        seconds: Of its readings, after those of the other sensors [s].
        deviations: Standard errors from 0.
    """

    seconds: float
    deviations: float


class GyroErrors(NamedTuple):
    """Errors of a gyroscope that are not sought, each as if there were no other.

    Attributes:
        lag: A low-pass filter.
        gain: A factor in the scale.
        delay: A delay.
        moved: By how much the filter, the factor and the delay move the numbers that
            were sought, in this order.
    """

    lag: Lag
    gain: Gain
    delay: Delay
    moved: tuple[np.ndarray, ...] = ()

    def named(self, chi_square: float, freedom: float) -> list[Lag | Gain | Delay]:
        """The errors that are sure, the one that explains most first.

        Args:
            chi_square: Of the fit, in units of the noise.
            freedom: Its degrees of freedom.
        """
        # No filter amplifies, but a scale or a delay may be wrong either way.
        sizes = (
            (self.lag.deviations, self.lag),
            (abs(self.gain.deviations), self.gain),
            (abs(self.delay.deviations), self.delay),
        )
        sure = [x for x in sizes if _is_sure(x[0], chi_square, freedom)]
        return [error for _, error in sorted(sure, key=itemgetter(0), reverse=True)]

    def moved_by(self, error: Lag | Gain | Delay) -> np.ndarray:
        """By how much an error moves the numbers that were sought."""
        return self.moved[(Lag, Gain, Delay).index(type(error))]


NO_ERRORS = GyroErrors(Lag(0.0, 0.0), Gain(1.0, 0.0), Delay(0.0, 0.0))


def _is_sure(deviations: float, chi_square: float, freedom: float) -> bool:
    """Whether a number is sure, and explains most of what the fit does not."""
    # Noise alone makes chi-square as large as this.
    chance = freedom + GATE * math.sqrt(2 * max(freedom, 1.0))
    # One more number lowers chi-square by the square of its standard errors.
    explains = deviations**2 > _EXPLAINED * (chi_square - chance)
    return deviations > _SURE and explains


def gyro_errors(fit: Fit, noise: float) -> GyroErrors:
    """The errors of the first gyroscope without a time constant.

    Args:
        fit: Where the search ended.
        noise: Variance of a whitened residual.
    """
    sensors = fit.problem.unknowns.original(0)[1:]
    for index, sensor in enumerate(sensors):
        if isinstance(sensor, Gyro) and sensor.time_constant is None:
            effects = _effects(fit, index, sensor)
            if effects is None:
                return NO_ERRORS
            return _sought(fit, effects, noise)
    return NO_ERRORS


class _Effects(NamedTuple):
    """Whitened effects of errors of a gyroscope on all rows.

    Attributes:
        reading: Readings without their bias.
        first: Their first derivative.
        second: Their second derivative.
    """

    reading: np.ndarray
    first: np.ndarray
    second: np.ndarray


def _effects(fit: Fit, index: int, gyro: Gyro) -> _Effects | None:
    """Effects of errors of a gyroscope, or None where the body does not rotate freely.

    The derivatives are those of free rotation at the predicted rates. Differences of
    predictions would follow the noise where a torque is unmodelled.
    """
    samples = fit.problem.samples
    part = samples.parts[index]
    whitener = np.asarray(samples.whitener)[:, part, :3, :3]
    weight = quality.weights_of(fit.problem, fit.kept)[:, part, :3]
    used = np.all(weight > 0, axis=-1)
    safe = np.where(used[..., None, None], whitener, np.eye(3))
    errors = np.linalg.solve(safe, fit.residual[:, part, :3, None])[..., 0]
    offset = np.asarray(samples.values[index]) + errors - np.asarray(gyro.bias)
    matrix = _matrix(gyro)
    rates = np.linalg.solve(matrix, offset[..., None])[..., 0]
    first, second = _derivatives(np.asarray(fit.minimum.tensor), rates)
    if not _rotates_freely(np.asarray(samples.ts)[:, part], rates, first, used):
        return None
    columns = []
    for rate in (rates, first, second):
        column = np.zeros_like(fit.minimum.rows.residual)
        effect = (whitener @ matrix @ rate[..., None])[..., 0]
        column[:, part, :3] = np.where(used[..., None], effect, 0.0)
        columns.append(column)
    return _Effects(*columns)


def _matrix(gyro: Gyro) -> np.ndarray:
    """The matrix that turns rates into readings, as in `Gyro.predict`."""
    # In numpy, since the first fit would wait for JAX to compile it.
    turn = host.to_matrix(host.exp(np.asarray(gyro.misalignment)))
    return np.asarray(gyro.matrix) @ (np.asarray(gyro.scale) * turn).T


def _derivatives(
    tensor: np.ndarray, rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivatives of the rates of a free body, by Euler's equations."""
    inverse = np.linalg.inv(tensor)
    momentum = rates @ tensor
    first = np.cross(momentum, rates) @ inverse
    change = np.cross(first @ tensor, rates) + np.cross(momentum, first)
    return first, change @ inverse


def _rotates_freely(
    ts: np.ndarray, rates: np.ndarray, derivative: np.ndarray, used: np.ndarray
) -> bool:
    """Whether changes of the rates are those of free rotation, in the main."""
    missing = 0.0
    total = 0.0
    for times, trial, slope, mask in zip(ts, rates, derivative, used, strict=True):
        steps = np.diff(trial[mask], axis=0)
        means = (slope[mask][1:] + slope[mask][:-1]) / 2
        expected = means * np.diff(times[mask])[:, None]
        missing += np.sum((steps - expected) ** 2)
        total += np.sum(steps**2)
    return bool(total > 0 and missing <= (1 - _FREE) * total)


def _sought(fit: Fit, effects: _Effects, noise: float) -> GyroErrors:
    """The errors by their effects beside all numbers and states that were sought."""
    table = _table(fit, effects)
    if noise <= 0 or not np.all(np.isfinite(table.rows)):
        return NO_ERRORS
    # A change of the states delays all sensors of a trial. Only beside other sensors is
    # a delay of the gyroscope one more number, which is sought with the others.
    delays = (1,) if len(fit.problem.samples.parts) > 1 else ()
    lag = table.explained((*delays, 2), noise)
    filtered = Lag(math.sqrt(2 * max(lag.multiple, 0.0)), lag.deviations)
    if fit.problem.options.dense:
        # Rates that follow an unmodelled torque follow the noise of the readings, too,
        # which would seem to be a scale or a delay.
        return NO_ERRORS._replace(lag=filtered, moved=(lag.moved,))
    gain = table.explained((*delays, 0), noise)
    late = table.explained(delays, noise)
    return GyroErrors(
        lag=filtered,
        gain=Gain(1 + gain.multiple, gain.deviations),
        # A late reading has less of the derivative.
        delay=Delay(-late.multiple, -late.deviations),
        moved=(lag.moved, gain.moved, late.moved),
    )


class _Explained(NamedTuple):
    """The multiple of an effect that explains residuals best.

    Attributes:
        multiple: Of the effect.
        deviations: Its standard errors from zero.
        moved: By how much it moves the numbers that were sought.
    """

    multiple: float
    deviations: float
    moved: np.ndarray


class _Table(NamedTuple):
    """Small rows with the products of all rows, without what states can explain.

    Attributes:
        rows: In the numbers, the effects and the residual, columns.
        units: Of the numbers and the effects.
    """

    rows: np.ndarray
    units: np.ndarray

    def explained(self, places: Sequence[int], noise: float) -> _Explained:
        """Explain residuals by the last of these effects, beside all that was sought.

        Args:
            places: Of the effects, which become more numbers; the fit had them at zero.
            noise: Variance of a residual.
        """
        count = self.units.size - len(_Effects._fields)
        nothing = _Explained(0.0, 0.0, np.zeros(count))
        if not places:
            return nothing
        columns = [*range(count), *(count + x for x in places)]
        units = self.units[columns]
        slopes = self.rows[:, columns]
        _, _, covariance = of_numbers(slopes[None], units)
        # One step by Newton's method goes to the minimum in all numbers.
        step = -covariance @ (slopes.T @ self.rows[:, -1] / units)
        variance = float(covariance[-1, -1])
        # What the other numbers and the states can imitate is rounding here.
        if not units[-1] ** 2 > _UNSHOWN * variance:
            return nothing
        deviations = float(step[-1]) / math.sqrt(noise * variance)
        return _Explained(float(step[-1]), deviations, step[:count])


def _table(fit: Fit, effects: _Effects) -> _Table:
    """Effects, and all that was sought, in one table."""
    rows, weight, _ = independent_rows(fit)
    own = fit.minimum.point.own.shape[-1]
    columns = np.stack([_independent(fit, x) for x in effects], axis=-1)
    border = np.concatenate([rows.of_border, columns], axis=-1)
    squares = np.sum(weight[..., None, None] * columns**2, axis=(0, 1, 2))
    units = np.append(fit.minimum.units, 1 / np.sqrt(or_one(squares)))
    reduced = without_states(rows._replace(of_border=border), weight, own, units)
    table = np.concatenate([reduced.of_numbers, reduced.residual[..., None]], axis=-1)
    table = table.reshape(-1, table.shape[-1])
    if not np.all(np.isfinite(table)):
        return _Table(table, units)
    return _Table(np.asarray(np.linalg.qr(table, mode="r")), units)


def _independent(fit: Fit, residual: np.ndarray) -> np.ndarray:
    """What a change of the predictions does to the independent rows."""
    if not fit.problem.options.dense:
        return residual
    minimum = fit.minimum
    links = minimum.links._replace(
        gap=np.zeros_like(minimum.links.gap),
        torque=np.zeros_like(minimum.links.torque),
    )
    rows = minimum.rows._replace(residual=residual)
    changed = dataclasses.replace(
        fit, minimum=minimum._replace(rows=rows, links=links), computed={}
    )
    return independent_rows(changed).rows.residual
