"""The unmodelled torque at the end of a fit: its levels and times, and their errors."""

from typing import NamedTuple

import numpy as np

from jrigid.identify import _levels as levels
from jrigid.identify import _quality as quality
from jrigid.identify._disturbance import Disturbance
from jrigid.identify._independent import innovations_under
from jrigid.identify._layout import Layout
from jrigid.identify._precision import (
    Precision,
    precision,
    precision_of,
    without_states,
)
from jrigid.identify._problem import Problem
from jrigid.identify._quality import Fit

# Of the level that moves a rate by its noise: where one of zero is judged.
_TRIED = 0.03
# The largest error of the logarithm of a level or time. What the record does not tell
# is known beforehand to within a factor e.
_LARGEST = 1.0


def first_level(problem: Problem, layout: Layout, tensor: np.ndarray) -> float:
    """The level of a torque that moves a rate by its noise from node to node."""
    span = np.sum(np.where(layout.linked, layout.end - layout.start, 0.0))
    mean = span / max(np.sum(layout.linked), 1)
    size = np.trace(tensor) / 3
    # A white torque of level s changes a rate by s sqrt(t) / I in a time t.
    return float(problem.noise[0] * size / np.sqrt(mean if mean > 0 else 1.0))


class SoughtTorque(NamedTuple):
    """The unmodelled torque of a fit, and how well the record tells it.

    Attributes:
        torque: As it was found, or given.
        tried: The same, with levels that could be seen in place of faint ones.
        faint: Which levels are too low to be detected.
        covariance: Of the logarithms of the levels and times, where they are `tried`.
        search: The search for it.
    """

    torque: levels.Torque
    tried: levels.Torque
    faint: np.ndarray
    covariance: np.ndarray
    search: levels.Search


@quality.once_for_each_fit
def sought_torque(fit: Fit) -> SoughtTorque:
    """The unmodelled torque of a fit that has one."""
    first = first_level(fit.problem, fit.layout, fit.minimum.tensor)
    search = levels.Search(fit.layout, first)
    torque = fit.torque
    if torque is None:
        level = np.asarray(fit.disturbance.level[0], float)
        time = np.asarray(fit.disturbance.time, float)
        torque = levels.known(level, time, fit.kept.shape[0])
    faint = search.are_faint(torque)
    # The likelihood hardly changes with the logarithm of a faint level, so that errors
    # are taken at a level that could be seen.
    tried = torque.with_levels(np.where(faint, _TRIED * first, torque.levels))
    return SoughtTorque(torque, tried, faint, search.covariance(tried, fit), search)


def fields_of_torque(fit: Fit, inflation: float) -> dict[str, np.ndarray]:
    """Level and correlation time of the unmodelled torque, with errors."""
    problem = fit.problem
    none = np.zeros(3)
    fields = {
        "level": none,
        "level_errors": none,
        "correlation_time": none,
        "correlation_time_errors": none,
        "level_by_trial": np.ones(fit.kept.shape[0]),
    }
    if not problem.options.dense:
        return fields
    torque, tried, faint, covariance, search = sought_torque(fit)
    typical = tried.typical
    errors = np.sqrt(np.diagonal(covariance))
    of_levels, of_times = np.split(errors, [torque.form.levels])
    # Near none the likelihood is quadratic in the level squared: the least to be seen.
    # An error e of the logarithm is an error 2 e of the level squared, relative to it.
    of_levels = np.where(faint, np.sqrt(2 * of_levels), of_levels)
    # A level was relative to a noise that was not known.
    size = 1.0 if problem.options.noise_known else np.sqrt(inflation)
    level = size * typical.level
    if fit.torque is not None:
        level = np.where(search.are_unbounded(tried, of_levels), np.inf, level)
    fields["level"] = np.where(faint, 0.0, level)
    fields["level_errors"] = level * of_levels
    if np.all(faint):
        return fields
    fields["correlation_time"] = typical.time
    fields["level_by_trial"] = np.exp(torque.trials)
    if torque.form.times:
        fields["correlation_time_errors"] = typical.time * of_times
    return fields


@quality.once_for_each_fit
def added_by_torque(fit: Fit) -> np.ndarray:
    """Covariance that errors of an estimated torque add to that of the numbers.

    The covariance of a fit is that under its torque. Others are nearly as likely, and
    give other estimates and other errors: the variance of a number is the mean of its
    variances under them and the variance of its estimates. They are one standard error
    away along each axis of the covariance of the torque's logarithms.

    Source: R. E. Kass and D. Steffey, "Approximate Bayesian inference in conditionally
    independent hierarchical models", J. Am. Stat. Assoc. 84 (1989) 717.
    """
    units = fit.minimum.units
    none = np.zeros((units.size, units.size))
    if fit.torque is None or not units.size:
        return none
    sought = sought_torque(fit)
    if np.all(sought.faint):
        return none
    torque = sought.torque
    low, high = sought.search.bounds(torque.form)
    variances, axes = np.linalg.eigh(sought.covariance)
    count = variances.size
    # With as many axes as numbers the mean over these points has the right variance.
    moves = np.sqrt(count * np.minimum(variances, _LARGEST**2)) * axes
    found = precision(fit)
    added = none
    for move in (*moves.T, *-moves.T):
        numbers = np.clip(torque.numbers + move, low, high)
        other = _precision_under(fit, torque._replace(numbers=numbers))
        shift = _to_best(other) - _to_best(found)
        change = other.covariance - found.covariance + np.outer(shift, shift)
        added = added + change / (2 * count)
    return _without_negative(added, units) if np.all(np.isfinite(added)) else none


def _precision_under(fit: Fit, torque: levels.Torque) -> Precision:
    """Precision of the numbers that a fit would have if this torque acted."""
    units = fit.minimum.units
    disturbance = Disturbance(*(np.asarray(x, units.dtype) for x in torque.disturbance))
    rows, weight, _ = innovations_under(fit, disturbance)
    return precision_of(without_states(fit, rows, weight), units)


def _to_best(known: Precision) -> np.ndarray:
    """Change of the numbers from a fit to the best ones by these rows."""
    return -known.covariance @ np.sum(known.scores, axis=0)


def _without_negative(matrix: np.ndarray, units: np.ndarray) -> np.ndarray:
    """Part of a symmetric matrix whose eigenvalues, in these units, are positive."""
    values, axes = np.linalg.eigh(matrix / (units[:, None] * units))
    return (axes * np.maximum(values, 0.0)) @ axes.T * (units[:, None] * units)
