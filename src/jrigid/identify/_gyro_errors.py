"""Whether a gyroscope has a filter, a scale or a delay that the fit leaves out.

A first-order filter with a time constant tau makes y - tau y' + tau^2 y'' - ... of the
rates y. The second term is a delay, and states that are sought take it up. A delay by
tau has half of the third term. The other half, tau^2 y'' / 2, attenuates the wobble,
and looks like another inertia. It may be much less than the noise of a reading, and
many errors of what a long record says of the inertia. So it is sought among the
residuals, beside all that the fit has sought, as one more number.

A scale that is off by a few parts in a thousand leaves residuals of nearly the same
shape, and so may a bias. Therefore they are sought in the same way, and whichever
explains most is named. Beside another sensor, whose readings are not late, a delay is
one more such number.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from jrigid._numerics import or_one
from jrigid.identify import _host as host
from jrigid.identify import _quality as quality
from jrigid.identify._independent import independent_rows
from jrigid.identify._precision import of_numbers, reduced
from jrigid.identify._quality import GATE, Fit
from jrigid.identify._sensors import Gyro

# Standard errors of a number beyond which it is no chance.
_NO_CHANCE = 6.0
# Part of what the fit does not explain, for an error of the gyroscope to be named.
_EXPLAINED = 0.5
# Part of the square of the rates' changes that free rotation must explain. Where a
# torque moves the body as much, the derivatives below are not those of the motion.
_FREE = 0.8
# Standard deviations from a limit at which no reading is saturated.
_CLEAR = 4.0
# Part of the square of an effect that nothing else may imitate, to be shown.
_UNSHOWN = 1e-10


class GyroError(NamedTuple):
    """An error of a gyroscope that would explain residuals.

    Attributes:
        value: Of the error, in its unit.
        deviations: Standard errors of its effect. They are zero where it was not
            sought, and negative for what no filter does.
        moved: By how much it moves the numbers that were sought.
    """

    value: np.ndarray
    deviations: float
    moved: np.ndarray

    @property
    def gained(self) -> float:
        """Fall of chi-square, less what all but one of its numbers cause by chance."""
        # In noise each number lowers chi-square by 1 in the mean.
        return self.deviations**2 - (self.value.size - 1)


_NOTHING = np.zeros(0)


class GyroErrors(NamedTuple):
    """Errors of a gyroscope that are not sought, each as if there were no other.

    Attributes:
        lag: Time constant of a low-pass filter [s].
        gain: Factor of all readings without their bias.
        delay: Of the readings, after those of other sensors [s].
        bias: Added to all readings [rad/s].
    """

    lag: GyroError = GyroError(np.zeros(()), 0.0, _NOTHING)
    gain: GyroError = GyroError(np.ones(()), 0.0, _NOTHING)
    delay: GyroError = GyroError(np.zeros(()), 0.0, _NOTHING)
    bias: GyroError = GyroError(np.zeros(3), 0.0, _NOTHING)

    def named(self, chi_square: float, freedom: float) -> dict[str, GyroError]:
        """The errors that are sure, the one that explains most first.

        Args:
            chi_square: Of the fit, in units of the noise.
            freedom: Its degrees of freedom.
        """
        errors = self._asdict()
        sure = [x for x in errors if _is_sure(errors[x], chi_square, freedom)]
        sure.sort(key=lambda x: errors[x].gained, reverse=True)
        return {x: errors[x] for x in sure}


def _is_sure(error: GyroError, chi_square: float, freedom: float) -> bool:
    """Whether an error is no chance, and explains most of what the fit does not."""
    # Noise alone makes chi-square as large as this.
    chance = freedom + GATE * math.sqrt(2 * max(freedom, 1.0))
    explains = error.deviations**2 > _EXPLAINED * (chi_square - chance)
    return error.deviations > _NO_CHANCE and explains


def gyro_errors(fit: Fit, noise: float) -> GyroErrors:
    """The errors of the first gyroscope.

    Args:
        fit: Where the search ended.
        noise: Variance of a whitened residual.
    """
    sensors = fit.problem.unknowns.original(0)[1:]
    gyros = [i for i, sensor in enumerate(sensors) if isinstance(sensor, Gyro)]
    if not (gyros and np.isfinite(fit.minimum.square)):
        return GyroErrors()
    effects = _effects(fit, gyros[0], sensors[gyros[0]], noise)
    if not effects:
        return GyroErrors()
    table = _table(fit, effects)
    if not np.all(np.isfinite(table.rows)):
        return GyroErrors()
    readings = np.nan_to_num(fit.problem.samples.values[gyros[0]])
    return _sought(fit, table, noise, float(np.max(np.abs(readings))))


def _effects(fit: Fit, index: int, gyro: Gyro, noise: float) -> dict[str, np.ndarray]:
    """Whitened effects of errors of a gyroscope on all rows.

    An error may be several numbers (trials, rows, degrees, numbers).
    """
    samples = fit.problem.samples
    part = samples.parts[index]
    whitener = np.asarray(samples.whitener)[:, part, :3, :3]
    weight = quality.weights_of(fit.problem, fit.kept)[:, part, :3]
    used = np.all(weight > 0, axis=-1)
    safe = np.where(used[..., None, None], whitener, np.eye(3))
    errors = np.linalg.solve(safe, fit.residual[:, part, :3, None])[..., 0]
    predicted = np.asarray(samples.values[index]) + errors
    limit = gyro.saturation()
    if limit is not None:
        # Of readings near the limit those with the larger noise are saturated. The mean
        # of the others is biased.
        spread = np.sqrt(noise) * np.linalg.norm(np.linalg.inv(safe), axis=-1)
        is_clear = np.abs(predicted) < np.asarray(limit) - _CLEAR * spread
        used = used & np.all(is_clear, axis=-1)
    offset = predicted - np.asarray(gyro.bias)
    shape = fit.minimum.rows.residual.shape
    effects = {}
    changes = _changes(fit, index, gyro, offset, used)
    if fit.problem.options.dense:
        # Only a filter is sought there, beside a delay. Each effect costs a filter run.
        changes = {x: y for x, y in changes.items() if x in ("lag", "delay")}
    for name, change in changes.items():
        effect = np.zeros((*shape, change.shape[-1]))
        effect[:, part, :3] = np.where(used[..., None, None], whitener @ change, 0.0)
        effects[name] = effect
    return effects


def _changes(
    fit: Fit, index: int, gyro: Gyro, offset: np.ndarray, used: np.ndarray
) -> dict[str, np.ndarray]:
    """Effects of errors of a gyroscope on its readings (trials, samples, 3, numbers).

    Args:
        fit: Where the search ended.
        index: Of the gyroscope's record.
        gyro: The gyroscope.
        offset: Predicted readings without their bias.
        used: Which of them take part.
    """
    samples = fit.problem.samples
    matrix = _matrix(gyro)
    rates = np.linalg.solve(matrix, offset[..., None])[..., 0]
    # The derivatives are those of free rotation at the predicted rates. Differences of
    # predictions would follow the noise where a torque is unmodelled.
    first, second = _derivatives(np.asarray(fit.minimum.tensor), rates)
    times = np.asarray(samples.ts)[:, samples.parts[index]]
    of_rates = {}
    # Behind a filter that is known, readings are not the rates of a free body.
    if gyro.time_constant is None and _rotates_freely(times, rates, first, used):
        of_rates = {"gain": rates, "lag": second}
        # A change of the states delays all sensors of a trial. Only beside other
        # sensors is a delay of the gyroscope one more number.
        if len(samples.parts) > 1:
            # A late reading has less of the derivative.
            of_rates["delay"] = -first
    changes = {name: matrix @ rate[..., None] for name, rate in of_rates.items()}
    changes["bias"] = np.broadcast_to(np.eye(3), (*rates.shape, 3))
    return changes


def _matrix(gyro: Gyro) -> np.ndarray:
    """The matrix that turns rates into readings, as in `Gyro.predict`."""
    # In numpy, since the first fit would wait for JAX to compile it.
    turn = host.to_matrix(host.exp(np.asarray(gyro.misalignment)))
    return np.asarray(gyro.matrix) @ (np.asarray(gyro.scale) * turn).T


def _derivatives(
    tensor: np.ndarray, rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivatives of a free body's rates, by Euler's equations."""
    # A fit may end at a body without a third moment.
    inverse = np.linalg.pinv(tensor)
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


def _sought(fit: Fit, table: "_Table", noise: float, largest: float) -> GyroErrors:
    """The errors by their effects beside all numbers and states that were sought.

    Args:
        fit: Where the search ended.
        table: Of the effects.
        noise: Variance of a whitened residual.
        largest: Of the readings [rad/s].
    """
    none = GyroErrors()
    lag = table.explained("lag", noise)
    # The effect of a filter is half of the square of its time constant.
    constant = np.sqrt(2 * np.maximum(lag.value[0], 0.0))
    errors = none._replace(lag=lag._replace(value=constant))
    if fit.problem.options.dense:
        # Rates that follow an unmodelled torque follow the noise of the readings, too,
        # which would seem to be a scale, a delay or a bias.
        return errors
    gain = table.explained("gain", noise)
    delay = table.explained("delay", noise)
    bias = table.explained("bias", noise)
    # A bias as large as the readings only imitates them.
    if np.max(np.abs(bias.value)) > largest:
        bias = none.bias
    return errors._replace(
        gain=gain._replace(value=1 + gain.value[0]),
        delay=delay._replace(value=delay.value[0]),
        bias=bias,
    )


class _Table(NamedTuple):
    """Small rows with the products of all rows, without what states can explain.

    Attributes:
        rows: In the numbers, the effects and the residual, columns.
        units: Of the numbers and the effects.
        numbers: How many numbers were sought.
        places: Columns of each effect.
    """

    rows: np.ndarray
    units: np.ndarray
    numbers: int
    places: dict[str, range]

    def explained(self, name: str, noise: float) -> GyroError:
        """Explain residuals by an effect, beside all that was sought.

        Its numbers become more numbers of the fit, which had them at zero. A delay is
        sought beside every other effect.

        Args:
            name: Of the effect.
            noise: Variance of a residual.
        """
        own = self.places.get(name, range(0))
        late = self.places.get("delay", range(0))
        beside = range(0) if name == "delay" else late
        columns = [*range(self.numbers), *beside, *own]
        units = self.units[columns]
        slopes = self.rows[:, columns]
        _, _, covariance = of_numbers(slopes[None], units)
        # One step by Newton's method goes to the minimum in all numbers.
        step = -covariance @ (slopes.T @ self.rows[:, -1] / units)
        last = slice(len(columns) - len(own), None)
        of_effect = covariance[last, last]
        # What the other numbers and the states can imitate is rounding here.
        is_shown = units[last] ** 2 > _UNSHOWN * np.diag(of_effect)
        if not own or not np.all(is_shown):
            return GyroError(np.zeros(3 if name == "bias" else 1), 0.0, _NOTHING)
        value = step[last]
        deviations = math.sqrt(value @ np.linalg.solve(of_effect, value) / noise)
        # The effect of a filter is positive.
        sign = -1.0 if name == "lag" and value[0] < 0 else 1.0
        return GyroError(value, sign * deviations, step[: self.numbers])


def _table(fit: Fit, effects: dict[str, np.ndarray]) -> _Table:
    """Effects, and all that was sought, in one table."""
    weight = independent_rows(fit).weight
    known = reduced(fit)
    numbers = fit.minimum.units.size
    places = {}
    columns = [known.of_numbers]
    units = [fit.minimum.units]
    end = numbers
    for name, effect in effects.items():
        places[name] = range(end, end + effect.shape[-1])
        end += effect.shape[-1]
        for column in np.moveaxis(effect, -1, 0):
            weighted = np.sqrt(weight)[..., None] * _independent(fit, column)
            weighted = weighted.reshape(weight.shape[0], -1, 1)
            unit = 1 / or_one(np.sqrt(np.sum(weighted**2)))
            columns.append(known.rest(unit * weighted))
            units.append(np.reshape(unit, 1))
    columns.append(known.residual[..., None])
    table = np.concatenate(columns, axis=-1)
    table = table.reshape(-1, table.shape[-1])
    if np.all(np.isfinite(table)):
        # The triangle has the products of all rows and is small.
        table = np.asarray(np.linalg.qr(table, mode="r"))
    return _Table(table, np.concatenate(units), numbers, places)


def _independent(fit: Fit, residual: np.ndarray) -> np.ndarray:
    """Change of the independent rows that a change of the predictions causes."""
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
