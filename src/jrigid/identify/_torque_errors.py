"""The unmodelled torque at the end of a fit: its levels and times, and their errors."""

import numpy as np

from jrigid.identify import _levels as levels
from jrigid.identify._layout import Layout
from jrigid.identify._problem import Problem
from jrigid.identify._quality import Fit

# Of the level that moves a rate by its noise: where one of zero is judged.
_TRIED = 0.03


def first_level(problem: Problem, layout: Layout, tensor: np.ndarray) -> float:
    """The level of a torque that moves a rate by its noise from node to node."""
    span = np.sum(np.where(layout.linked, layout.end - layout.start, 0.0))
    mean = span / max(np.sum(layout.linked), 1)
    size = np.trace(tensor) / 3
    # A white torque of level s changes a rate by s sqrt(t) / I in a time t.
    return float(problem.noise[0] * size / np.sqrt(mean if mean > 0 else 1.0))


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
    first = first_level(problem, fit.layout, fit.minimum.tensor)
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
    typical = tried.typical
    errors = search.errors(tried, fit)
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
