"""The unmodelled torque that a record makes most likely: its levels and correlation times.

The likelihood is that of the innovations, restricted to what the states and numbers
leave open (REML). It is smooth in the logarithms of levels and times, and little is
asked of it: where the record was linearised once, many torques are tried without
another evaluation of the motion.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.tree_util as jtu
import numpy as np

from jrigid.identify._disturbance import Disturbance, GaussMarkov
from jrigid.identify._filter import likelihood
from jrigid.identify._layout import Layout
from jrigid.identify._problem import Problem
from jrigid.identify._quality import Fit, columns_of_prior, linearised, weights_of

FAINT = 1e-4  # of the first level: no torque at all
_DIFFERENCE = 0.1  # in logarithms, for derivatives
_LONGEST_MOVE = 3.0  # in logarithms
_FINE = 0.02  # a change of a logarithm that does not matter
_UNKNOWN = 10.0  # error of the logarithm of a level that could be any
_ROUNDS = 40
_HIGHEST = 30.0  # logarithm of a level, in units of the first, that no record asks for
_TRIED = 2.0  # logarithm of a time to begin with, in units of the shortest
_GAIN = 2.0  # of -2 log likelihood, for each number more (Akaike)
_FOREIGN = (
    30.0  # fall of -2 log likelihood, beyond one for each number, for another body
)
_FEWEST = 5  # trials that show which of them is of another body
_MOST_FOREIGN = 0.25  # of all trials: beyond, nobody knows who is foreign
_SPREAD = 0.7  # of the logarithms of trials' levels, as far as is known beforehand


class Form(NamedTuple):
    """What is sought of a torque.

    Attributes:
        levels: 1 for all axes, or 3.
        times: 0 for white torque, 1 or 3.
    """

    levels: int
    times: int

    @property
    def size(self) -> int:
        """How many numbers are sought."""
        return self.levels + self.times


class Torque(NamedTuple):
    """A torque as it is sought.

    Attributes:
        form: Which numbers there are.
        numbers: Logarithms of levels and of times.
        trials: Of the size of the torque in each trial, beside that of others
            (trials,).
        own_sizes: Whether these were sought, too.
        minus_two_log_likelihood: Of the record; infinite where it was not computed.
    """

    form: Form
    numbers: np.ndarray
    trials: np.ndarray
    own_sizes: bool = False
    minus_two_log_likelihood: float = np.inf

    @property
    def size(self) -> int:
        """How many numbers were sought: those of its form, and of trials that differ."""
        return self.form.size + (self.trials.size if self.own_sizes else 0)

    @property
    def levels(self) -> np.ndarray:
        """Its levels in a trial of mean size: one, or one for each axis."""
        return np.exp(self.numbers[: self.form.levels])

    def with_levels(self, levels: np.ndarray) -> "Torque":
        """The same torque with other levels."""
        times = self.numbers[self.form.levels :]
        return self._replace(numbers=np.concatenate([np.log(levels), times]))

    @property
    def disturbance(self) -> Disturbance:
        """The torque."""
        levels, times = np.split(np.exp(self.numbers), [self.form.levels])
        levels = np.exp(self.trials)[:, None] * np.broadcast_to(levels, 3)
        return Disturbance(levels, np.broadcast_to(times if times.size else 0.0, 3))

    @property
    def typical(self) -> GaussMarkov:
        """The torque of a trial of mean size."""
        of_mean = self._replace(trials=np.zeros(1)).disturbance
        return GaussMarkov(of_mean.level[0], of_mean.time)


def known(level: np.ndarray, time: np.ndarray) -> Torque:
    """A torque that was given, as if it had been sought."""
    tiny = np.finfo(float).tiny
    form = Form(3, 3 if np.all(time > 0) else 0)
    numbers = np.concatenate([level, time[: form.times]])
    return Torque(form, np.log(np.maximum(numbers, tiny)), np.zeros(1))


class Likelihood:
    """-2 log likelihood of torques for a record that was linearised where a fit ended."""

    def __init__(self, problem: Problem, fit: Fit):
        """Take what does not depend on the torque."""
        record = linearised(fit)
        inner = record.links.gap.shape[-1]
        prior = columns_of_prior(fit)
        trials, unknown = record.weight.shape[0], fit.minimum.point.numbers.size
        unknown += trials * (inner + record.own.shape[-1])
        freedom = max(float(np.sum(weights_of(problem, fit.kept))) - unknown, 1.0)
        self._dtype = record.tensor.dtype
        self._arguments = (
            record,
            np.einsum("tndi,tndj->tij", prior, prior),
            np.asarray(freedom, self._dtype),
            np.asarray(problem.options.noise_known),
        )
        span = fit.layout.end - fit.layout.start
        self.kicks = 2.0 * max(3 * np.sum(fit.layout.linked), 1)
        self._none = np.log(1e-7 * np.min(span[fit.layout.linked], initial=1.0))

    def __call__(
        self, form: Form, numbers: np.ndarray, trials: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """The value, and its derivatives in numbers and in the logarithms of trials' sizes."""
        (value, _), slopes = self._found(form, numbers, trials)
        of_levels, of_times, of_trials = slopes
        slope = [np.sum(of_levels, keepdims=True) if form.levels == 1 else of_levels]
        if form.times:
            slope.append(
                np.sum(of_times, keepdims=True) if form.times == 1 else of_times
            )
        return float(value), np.concatenate(slope), of_trials

    def as_of_another_body(self, torque: Torque) -> np.ndarray:
        """By how much -2 log likelihood of each trial falls with numbers of its own.

        The torque in it has the size that suits the trial best in either case, so that
        a trial with a larger torque is not taken for one of another body.
        """
        sizes = np.linspace(-2.0, 2.0, 9)[:, None] + torque.trials
        found = [self._found(torque.form, torque.numbers, x)[0][1] for x in sizes]
        together = np.min([x.together for x in found], axis=0)
        return together - np.min([x.alone for x in found], axis=0)

    def _found(self, form: Form, numbers: np.ndarray, trials: np.ndarray) -> Any:
        levels, times = np.split(numbers, [form.levels])
        times = times if form.times else np.array([self._none])
        given = (np.broadcast_to(levels, 3), np.broadcast_to(times, 3), trials)
        found = likelihood(*self._arguments, *(x.astype(self._dtype) for x in given))
        return jtu.tree_map(_wide, found)


def _wide(x: Any) -> np.ndarray:
    return np.asarray(x, float)


Function = Callable[[np.ndarray], tuple[float, np.ndarray]]


def descend(
    function: Function,
    x: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    inverse: np.ndarray,
) -> tuple[np.ndarray, float, np.ndarray]:
    """Minimise a smooth function within bounds: BFGS with a backtracking search along its steps.

    Args:
        function: Gives value and slope.
        x: Where to start.
        low: Bounds.
        high: Bounds.
        inverse: Of the second derivatives, as far as it is known.

    Returns:
        Where it ended, the value there and the inverse as it was learnt.
    """
    at, slope = function(x)
    for _ in range(_ROUNDS):
        # A number at its bound that would leave it stays.
        held = ((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0))
        free = np.where(held, 0.0, 1.0)
        move = -free * (inverse @ (free * slope))
        longest = np.max(np.abs(move), initial=0.0)
        if not longest > 0.1 * _FINE:
            break
        move = move * min(1.0, _LONGEST_MOVE / longest)
        for fraction in (1.0, 0.3, 0.1, 0.01):
            point = np.clip(x + fraction * move, low, high)
            value, new = function(point)
            if value < at:
                break
        else:
            break
        step, change = point - x, new - slope
        x, at, slope = point, value, new
        along = float(change @ step)
        if along > 1e-12:
            left = np.eye(x.size) - np.outer(step, change) / along
            inverse = left @ inverse @ left.T + np.outer(step, step) / along
    return x, at, inverse


class Search:
    """The search for the torque of a record.

    Args:
        problem: The record.
        layout: Its segments.
        first: A level that moves a rate by its noise from node to node.
    """

    def __init__(self, problem: Problem, layout: Layout, first: float):
        """Set bounds."""
        self._problem = problem
        span = np.where(layout.linked, layout.end - layout.start, np.inf)
        end = np.where(layout.linked, layout.end, -np.inf).max(axis=1)
        duration = np.max(end - layout.start[:, 0], initial=0.0)
        self._first = np.log(first)
        # A memory shorter than a step is none; one longer than the record, a constant
        # torque.
        step = float(np.min(span, initial=1e9))
        self._shortest = np.log(0.2 * step)
        self._longest = np.log(max(duration, step))

    def start(self, level: float, trials: int) -> Torque:
        """White torque of a level about all axes."""
        return Torque(Form(1, 0), np.log(np.full(1, level)), np.zeros(trials))

    def improved(self, torque: Torque, fit: Fit) -> Torque:
        """The most likely torque of the same form at a fit; its sizes in trials stay."""
        return self._descended(torque, Likelihood(self._problem, fit))

    def _bounds(self, form: Form) -> tuple[np.ndarray, np.ndarray]:
        low = [self._first + np.log(FAINT)] * form.levels + [
            self._shortest
        ] * form.times
        high = [self._first + _HIGHEST] * form.levels + [self._longest] * form.times
        return np.array(low), np.array(high)

    def _descended(self, torque: Torque, likelihood: Likelihood) -> Torque:
        low, high = self._bounds(torque.form)

        def function(x: np.ndarray) -> tuple[float, np.ndarray]:
            return likelihood(torque.form, x, torque.trials)[:2]

        start = np.clip(torque.numbers, low, high)
        # A level's logarithm is known to 1 / sqrt(2 n) by n kicks.
        inverse = np.eye(start.size) / likelihood.kicks
        numbers, at, _ = descend(function, start, low, high, inverse)
        return torque._replace(numbers=numbers, minus_two_log_likelihood=at)

    def are_faint(self, torque: Torque) -> np.ndarray:
        """Which of the levels are too low to be seen."""
        return torque.levels < 2 * FAINT * np.exp(self._first)

    def are_unbounded(self, torque: Torque, errors: np.ndarray) -> np.ndarray:
        """Which of the levels are large and might be much larger, by the errors of logarithms."""
        return (torque.levels > np.exp(self._first)) & ~(errors < _UNKNOWN)

    def preferred(self, torque: Torque, fit: Fit, spins: np.ndarray) -> Torque:
        """The torque of the form that the likelihood prefers, from a white one.

        Args:
            torque: White, of one level.
            fit: Where the record is linearised.
            spins: Rms rate of each trial [rad/s].
        """
        likelihood = Likelihood(self._problem, fit)
        best = self._descended(torque, likelihood)
        if np.all(self.are_faint(best)):
            return best
        if spins.size > 1:
            proportional = best._replace(trials=np.log(spins) - np.mean(np.log(spins)))
            best = self._better(best, self._descended(proportional, likelihood))
        for form in (Form(1, 1), Form(3, 0), Form(3, 1), Form(3, 3)):
            if form.times < best.form.times or form.levels < best.form.levels:
                continue
            wider = self._descended(self._widened(best, form), likelihood)
            best = self._better(best, wider)
        if spins.size > 1:
            best = self._with_trials(best, likelihood)
        return best

    def _better(self, one: Torque, other: Torque) -> Torque:
        cost = _GAIN * (other.form.size - one.form.size)
        gain = one.minus_two_log_likelihood - other.minus_two_log_likelihood
        return other if gain > cost else one

    def _widened(self, torque: Torque, form: Form) -> Torque:
        """The same torque in a form of more numbers."""
        levels, times = np.split(torque.numbers, [torque.form.levels])
        levels = np.resize(levels, form.levels)
        if not times.size:
            times = np.full(
                1, min(self._shortest + _TRIED, 0.5 * (self._shortest + self._longest))
            )
        times = np.resize(times, form.times)
        return torque._replace(form=form, numbers=np.concatenate([levels, times]))

    def _with_trials(self, torque: Torque, likelihood: Likelihood) -> Torque:
        """With a size of its own in each trial, if that is more likely.

        Sizes are known beforehand to be alike within a factor; what this costs in
        likelihood is counted by Laplace's method.
        """
        size, start, precision = torque.form.size, torque.trials, 1 / _SPREAD**2

        def function(x: np.ndarray) -> tuple[float, np.ndarray]:
            own = x[size:]
            value, *slopes = likelihood(torque.form, x[:size], start + own)
            slopes[1] = slopes[1] + 2 * precision * own
            return value + precision * float(np.sum(own**2)), np.concatenate(slopes)

        trials = start.size
        low, high = self._bounds(torque.form)
        low = np.concatenate([low, np.full(trials, -_HIGHEST)])
        high = np.concatenate([high, np.full(trials, _HIGHEST)])
        x = np.concatenate([torque.numbers, np.zeros(trials)])
        scale = np.concatenate([np.full(size, 1.0), np.full(trials, float(trials))])
        x, at, _ = descend(function, x, low, high, np.diag(scale / likelihood.kicks))
        # Trials hardly know of each other: moving all shows how each bends.
        move = np.concatenate([np.zeros(size), np.full(trials, _DIFFERENCE)])
        bend = (function(x + move)[1] - function(x - move)[1])[size:] / (
            2 * _DIFFERENCE
        )
        cost = float(np.sum(np.log(np.maximum(bend / (2 * precision), 1.0))))
        if torque.minus_two_log_likelihood - at < cost:
            return torque
        own = x[size:]
        at = likelihood(torque.form, x[:size], start + own)[0]
        return Torque(
            torque.form,
            x[:size],
            start + own,
            own_sizes=True,
            minus_two_log_likelihood=at,
        )

    def foreign(self, torque: Torque, fit: Fit) -> np.ndarray:
        """Which trials are of another body, as far as their likelihood shows."""
        alive = np.any(fit.kept > 0, axis=1)
        none, numbers = np.zeros(alive.shape, bool), fit.minimum.point.numbers.size
        if np.sum(alive) < _FEWEST or not numbers:
            return none
        fall = Likelihood(self._problem, fit).as_of_another_body(torque)
        # A torque that is not quite of this kind lets all trials differ.
        usual = max(float(np.median(fall[alive])) / numbers, 1.0)
        found = alive & (fall > usual * (numbers + _FOREIGN))
        most = alive.size * _MOST_FOREIGN
        return found if np.sum(found | ~alive) <= most else none

    def errors(self, torque: Torque, fit: Fit) -> np.ndarray:
        """Standard errors of the logarithms of levels and times."""
        likelihood = Likelihood(self._problem, fit)
        moves = _DIFFERENCE * np.eye(torque.form.size)

        def slope(x: np.ndarray) -> np.ndarray:
            return likelihood(torque.form, x, torque.trials)[1]

        rows = [slope(torque.numbers + y) - slope(torque.numbers - y) for y in moves]
        bend = np.array(rows) / (2 * _DIFFERENCE)
        bend = 0.5 * (bend + bend.T)
        values, axes = np.linalg.eigh(np.where(np.isfinite(bend), bend, 0.0))
        covariance = (axes * (2 / np.maximum(values, 1e-12))) @ axes.T
        return np.sqrt(np.diagonal(covariance))
