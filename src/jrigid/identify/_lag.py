"""Whether a gyroscope has a low-pass filter that the fit leaves out.

A first-order filter with a time constant tau makes y - tau y' + tau^2 y'' - ... of the
rates y. The second term is a delay, and states that are sought take it up. A delay by
tau has half of the third term. The other half, tau^2 y'' / 2, attenuates the wobble,
and looks like another inertia. It may be much less than the noise of a reading, and
many errors of what a long record says of the inertia. So it is sought among the
residuals, beside all that the fit has sought, as one more number.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from jrigid._numerics import or_one
from jrigid.identify import _host as host
from jrigid.identify import _quality as quality
from jrigid.identify._independent import independent_rows
from jrigid.identify._precision import precision_of_rows
from jrigid.identify._problem import Problem
from jrigid.identify._quality import GATE, Fit
from jrigid.identify._sensors import Gyro

# Standard errors of the number beyond which it is no chance.
_SURE = 6.0
# Part of what the fit does not explain, for a filter to be named.
_EXPLAINED = 0.5
# Part of the square of the rates' changes that free rotation must explain. Where a
# torque moves the body as much, the derivatives below are not those of the motion.
_FREE = 0.8
# Part of the square of a filter's effect that nothing else may imitate, to be shown.
_UNSHOWN = 1e-10


class Lag(NamedTuple):
    """A low-pass filter that would explain residuals of a gyroscope.

    Attributes:
        time_constant: Of the filter [s]; 0 if the residuals show the opposite.
        deviations: Standard errors of its effect; negative if they show the opposite.
    """

    time_constant: float
    deviations: float


NO_LAG = Lag(0.0, 0.0)


def is_named(lag: Lag, chi_square: float, freedom: float) -> bool:
    """Whether a filter is sure, and explains most of what the fit does not.

    Args:
        lag: The filter.
        chi_square: Of the fit, in units of the noise.
        freedom: Its degrees of freedom.
    """
    # Noise alone makes chi-square as large as this.
    chance = freedom + GATE * math.sqrt(2 * max(freedom, 1.0))
    # One more number lowers chi-square by the square of its standard errors.
    explains = lag.deviations**2 > _EXPLAINED * (chi_square - chance)
    return lag.deviations > _SURE and explains


def lag_of(problem: Problem, fit: Fit, noise: float) -> Lag:
    """The filter of the first gyroscope without a time constant.

    Args:
        problem: The record.
        fit: Its minimum.
        noise: Variance of a whitened residual.
    """
    sensors = problem.unknowns.original(0)[1:]
    for index, sensor in enumerate(sensors):
        if isinstance(sensor, Gyro) and sensor.time_constant is None:
            effects = _effects(problem, fit, index, sensor)
            return NO_LAG if effects is None else _sought(problem, fit, effects, noise)
    return NO_LAG


def _effects(
    problem: Problem, fit: Fit, index: int, gyro: Gyro
) -> tuple[np.ndarray, np.ndarray] | None:
    """Whitened first and second derivatives of the readings, of all rows.

    They are those of free rotation at the predicted rates. Differences of predictions
    would follow the noise where a torque is unmodelled. None where the body does not
    rotate freely.
    """
    samples = problem.samples
    part = samples.parts[index]
    whitener = np.asarray(samples.whitener)[:, part, :3, :3]
    weight = quality.weights_of(problem, fit.kept)[:, part, :3]
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
    for derivative in (first, second):
        column = np.zeros_like(fit.minimum.rows.residual)
        effect = (whitener @ matrix @ derivative[..., None])[..., 0]
        column[:, part, :3] = np.where(used[..., None], effect, 0.0)
        columns.append(column)
    return columns[0], columns[1]


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


def _sought(
    problem: Problem, fit: Fit, effects: tuple[np.ndarray, np.ndarray], noise: float
) -> Lag:
    """The filter by its effects beside all numbers and states that were sought."""
    rows, weight, _ = independent_rows(problem, fit)
    own = fit.minimum.point.own.shape[-1]
    # The coefficients of the two effects are two more numbers, which the fit had at 0.
    columns = [_independent(problem, fit, x)[..., None] for x in effects]
    border = np.concatenate([rows.of_border, *columns], axis=-1)
    squares = [np.sum(weight[..., None, None] * x**2) for x in columns]
    units = np.append(fit.minimum.units, 1 / np.sqrt(or_one(np.array(squares))))
    known = precision_of_rows(rows._replace(of_border=border), weight, own, units)
    # One step by Newton's method goes to the minimum in all numbers. Where states can
    # imitate the first effect exactly, its error is huge and it changes no other step.
    step = -known.covariance @ np.sum(known.scores, axis=0)
    half_square = float(step[-1])
    variance = float(known.covariance[-1, -1])
    # What the other numbers and the states can imitate is rounding here.
    is_shown = units[-1] ** 2 > _UNSHOWN * variance
    if not (is_shown and math.isfinite(half_square)) or noise <= 0:
        return NO_LAG
    deviations = half_square / math.sqrt(noise * variance)
    return Lag(math.sqrt(2 * max(half_square, 0.0)), deviations)


def _independent(problem: Problem, fit: Fit, residual: np.ndarray) -> np.ndarray:
    """What a change of the predictions does to the independent rows."""
    if not problem.options.dense:
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
    return independent_rows(problem, changed).rows.residual
