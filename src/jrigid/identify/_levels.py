"""The unmodelled torque that makes a record most likely: its levels and times.

The likelihood is that of the innovations, restricted to what states and numbers leave
open (REML). It is smooth in the logarithms of levels and times and needs no further
evaluation of the motion: a record is linearised once and many torques are compared.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.tree_util as jtu
import numpy as np

from jrigid.identify._disturbance import Disturbance, GaussMarkov
from jrigid.identify._filter import TrialLikelihoods, likelihood
from jrigid.identify._layout import Layout
from jrigid.identify._quality import Fit, columns_of_prior, linearised, weights_of

NO_LEVEL = 1e-4  # part of the first level below which there is no torque
_DIFFERENCE = 0.1  # of logarithms, for second derivatives
_LONGEST_MOVE = 3.0  # of logarithms
_FINE = 0.02  # change of a logarithm that does not matter
_ROUNDS = 40
_TRIED_FRACTIONS = (1.0, 0.3, 0.1, 0.01)  # of a step
_UNKNOWN = 10.0  # error of the logarithm of a level that could have any size
_HIGHEST = 30.0  # logarithm of a level, in units of the first, above all real ones
_TRIED = 2.0  # logarithm of the first time tried, in units of the shortest
# What a number costs, in -2 log likelihood. With Akaike's cost of 2 one of seven
# records under equal levels seems to have three, whose errors are then too small.
_COST = 4.0
# A trial has another body if -2 log likelihood falls by more than this, beyond one for
# each number, where it has numbers of its own. Few trials do not show which of them it
# is, nor do trials of which many seem to have another body.
_FOREIGN = 30.0
FEWEST_TRIALS = 5
MOST_FOREIGN = 0.25  # of all trials
# Sizes of the torque in trials are known beforehand to within a factor exp(0.7).
_PRECISION_OF_SIZES = 1 / 0.7**2


class Form(NamedTuple):
    """Counts of the numbers that describe a torque.

    Attributes:
        levels: 1 for all axes together, or 3.
        times: 0 for white torque, 1 for all axes together, or 3.
    """

    levels: int
    times: int

    @property
    def size(self) -> int:
        """Count of all numbers."""
        return self.levels + self.times

    def contains(self, other: "Form") -> bool:
        """Whether each torque of the other form is one of this form."""
        return other.levels <= self.levels and other.times <= self.times


# Forms beside white torque of one level, simple ones first.
_WIDER = (Form(1, 1), Form(3, 0), Form(3, 1), Form(3, 3))


class Torque(NamedTuple):
    """A torque as a vector of numbers.

    Attributes:
        form: How many numbers there are.
        numbers: Logarithms of levels and of times.
        trials: Logarithm of the size of the torque in each trial, over its level
            (trials,).
        own_sizes: Whether the sizes were sought.
        minus_two_log_likelihood: Of the record; infinite if it was not computed.
    """

    form: Form
    numbers: np.ndarray
    trials: np.ndarray
    own_sizes: bool = False
    minus_two_log_likelihood: float = np.inf

    @property
    def size(self) -> int:
        """Count of the numbers sought, with the sizes of trials if they were sought."""
        return self.form.size + (self.trials.size if self.own_sizes else 0)

    @property
    def cost(self) -> float:
        """-2 log likelihood of the record, and what the numbers of the form cost."""
        return self.minus_two_log_likelihood + _COST * self.form.size

    @property
    def levels(self) -> np.ndarray:
        """Levels in a trial of mean size: one, or one for each axis."""
        return np.exp(self.numbers[: self.form.levels])

    def with_levels(self, levels: np.ndarray) -> "Torque":
        """The same torque with other levels."""
        times = self.numbers[self.form.levels :]
        return self._replace(numbers=np.concatenate([np.log(levels), times]))

    @property
    def disturbance(self) -> Disturbance:
        """The torque in each trial, with all axes."""
        levels, times = np.split(np.exp(self.numbers), [self.form.levels])
        levels = np.exp(self.trials)[:, None] * np.broadcast_to(levels, 3)
        return Disturbance(levels, np.broadcast_to(times if times.size else 0.0, 3))

    @property
    def typical(self) -> GaussMarkov:
        """The torque of a trial of mean size."""
        of_mean = self._replace(trials=np.zeros(1)).disturbance
        return GaussMarkov(of_mean.level[0], of_mean.time)


def known(level: np.ndarray, time: np.ndarray, trials: int) -> Torque:
    """A torque of given levels and times, of the same size in all trials."""
    tiny = np.finfo(float).tiny
    form = Form(3, 3 if np.any(time > 0) else 0)
    numbers = np.concatenate([level, time[: form.times]])
    return Torque(form, np.log(np.maximum(numbers, tiny)), np.zeros(trials))


class Likelihood:
    """-2 log likelihood of torques for a record, linearised where a fit ended."""

    def __init__(self, fit: Fit):
        """Compute what does not depend on the torque."""
        record = linearised(fit)
        prior = columns_of_prior(fit)
        trials = record.weight.shape[0]
        own = record.links.gap.shape[-1] + record.own.shape[-1]
        unknown = fit.minimum.point.numbers.size + trials * own
        freedom = max(float(np.sum(weights_of(fit.problem, fit.kept))) - unknown, 1.0)
        self._dtype = record.tensor.dtype
        self._arguments = (
            record,
            np.einsum("tndi,tndj->tij", prior, prior),
            np.asarray(freedom, self._dtype),
            np.asarray(fit.problem.options.noise_known),
        )
        layout = fit.layout
        shortest = np.min((layout.end - layout.start)[layout.linked], initial=1.0)
        # White torque has a correlation time far below all steps, where the covariance
        # of a step no longer depends on it.
        self._time_of_white = np.log(1e-7 * shortest)
        # Each link has a kick along each of three axes.
        self.kicks = 2.0 * max(3 * np.sum(layout.linked), 1)

    def __call__(
        self, form: Form, numbers: np.ndarray, trials: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the value and its derivatives in numbers and sizes of trials."""
        (value, _), slopes = self._evaluate(form, numbers, trials)
        of_levels, of_times, of_trials = slopes
        slope = [
            _of_form(of_levels, form.levels),
            _of_form(of_times, form.times),
        ]
        return float(value), np.concatenate(slope), of_trials

    def as_of_another_body(self, torque: Torque) -> np.ndarray:
        """Fall of -2 log likelihood of each trial that is given numbers of its own.

        The torque has the size that suits the trial best in either case, so that a
        trial with a larger torque is not taken for one of another body.
        """
        sizes = np.linspace(-2.0, 2.0, 9)[:, None] + torque.trials
        of_trials = [
            self._evaluate(torque.form, torque.numbers, size)[0][1] for size in sizes
        ]
        together = np.min([x.together for x in of_trials], axis=0)
        return together - np.min([x.alone for x in of_trials], axis=0)

    def _evaluate(
        self, form: Form, numbers: np.ndarray, trials: np.ndarray
    ) -> tuple[tuple[np.ndarray, TrialLikelihoods], tuple[np.ndarray, ...]]:
        """Results of `likelihood` in double precision."""
        levels, times = np.split(numbers, [form.levels])
        if not form.times:
            times = np.array([self._time_of_white])
        # The time of an axis with white torque is zero, which has no logarithm.
        times = np.maximum(times, self._time_of_white)
        torque = np.broadcast_to(levels, 3), np.broadcast_to(times, 3), trials
        results = likelihood(*self._arguments, *(x.astype(self._dtype) for x in torque))
        return jtu.tree_map(lambda x: np.asarray(x, float), results)


def _of_form(of_axes: np.ndarray, count: int) -> np.ndarray:
    """Derivatives in `count` numbers: none, one for all axes, or one for each."""
    if count == 1:
        return np.sum(of_axes, keepdims=True)
    return of_axes[:count]


Function = Callable[[np.ndarray], tuple[float, np.ndarray]]


def descend(
    function: Function,
    x: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    inverse: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Minimise a smooth function within bounds, by BFGS with a backtracking search.

    Args:
        function: Returns value and slope.
        x: Where to start.
        low: Lower bounds.
        high: Upper bounds.
        inverse: Approximate inverse of the matrix of second derivatives.

    Returns:
        The minimum, and the value there.
    """
    value, slope = function(x)
    for _ in range(_ROUNDS):
        # A number at its bound that would leave it stays.
        held = ((x <= low) & (slope > 0)) | ((x >= high) & (slope < 0))
        free = np.where(held, 0.0, 1.0)
        move = -free * (inverse @ (free * slope))
        longest = np.max(np.abs(move), initial=0.0)
        if not longest > 0.1 * _FINE:
            break
        move = move * min(1.0, _LONGEST_MOVE / longest)
        for fraction in _TRIED_FRACTIONS:
            new = np.clip(x + fraction * move, low, high)
            new_value, new_slope = function(new)
            if new_value < value:
                break
        else:
            break
        inverse = _bfgs_update(inverse, new - x, new_slope - slope)
        x = new
        value = new_value
        slope = new_slope
    return x, value


def _bfgs_update(
    inverse: np.ndarray, step: np.ndarray, change: np.ndarray
) -> np.ndarray:
    """The inverse of second derivatives after a step that changed the slope.

    Source: Nocedal & Wright, Numerical Optimization, 2nd ed., eq. 6.17.
    """
    along = float(change @ step)
    if not along > 1e-12:
        return inverse
    projector = np.eye(step.size) - np.outer(step, change) / along
    return projector @ inverse @ projector.T + np.outer(step, step) / along


class Search:
    """The search for the torque of a record.

    Args:
        layout: Segments of the record.
        first: A level that moves a rate by its noise from node to node.
    """

    def __init__(self, layout: Layout, first: float):
        """Set the bounds of levels and times."""
        span = np.where(layout.linked, layout.end - layout.start, np.inf)
        end = np.where(layout.linked, layout.end, -np.inf).max(axis=1)
        duration = np.max(end - layout.start[:, 0], initial=0.0)
        self._first = np.log(first)
        # A torque is white if its correlation time is shorter than a step, and constant
        # if it is longer than the record.
        step = float(np.min(span, initial=1e9))
        self._shortest = np.log(0.2 * step)
        self._longest = np.log(max(duration, step))

    def start(self, level: float, trials: int) -> Torque:
        """White torque of one level along all axes."""
        return Torque(Form(1, 0), np.log(np.full(1, level)), np.zeros(trials))

    def improved(self, torque: Torque, fit: Fit) -> Torque:
        """The most likely torque of the same form, with the same sizes in trials."""
        return self._descended(torque, Likelihood(fit))

    def bounds(self, form: Form) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the numbers of a form."""
        counts = [form.levels, form.times]
        low = np.repeat([self._first + np.log(NO_LEVEL), self._shortest], counts)
        high = np.repeat([self._first + _HIGHEST, self._longest], counts)
        return low, high

    def _descended(self, torque: Torque, likelihood: Likelihood) -> Torque:
        """The most likely torque of the same form, searched from a torque."""
        low, high = self.bounds(torque.form)

        def function(x: np.ndarray) -> tuple[float, np.ndarray]:
            return likelihood(torque.form, x, torque.trials)[:2]

        start = np.clip(torque.numbers, low, high)
        # n kicks determine the logarithm of a level to 1 / sqrt(2 n).
        inverse = np.eye(start.size) / likelihood.kicks
        numbers, value = descend(function, start, low, high, inverse)
        return torque._replace(numbers=numbers, minus_two_log_likelihood=value)

    def are_faint(self, torque: Torque) -> np.ndarray:
        """Whether each level is too low to be detected."""
        return torque.levels < 2 * NO_LEVEL * np.exp(self._first)

    def are_unbounded(self, torque: Torque, errors: np.ndarray) -> np.ndarray:
        """Whether levels are large and may be much larger, by errors of logarithms."""
        return (torque.levels > np.exp(self._first)) & ~(errors < _UNKNOWN)

    def preferred(self, torque: Torque, fit: Fit, spins: np.ndarray) -> Torque:
        """The most likely torque of all forms.

        Args:
            torque: Where to start: white torque of one level.
            fit: Where the record is linearised.
            spins: Rms rate of each trial [rad/s].
        """
        likelihood = Likelihood(fit)
        best = self._descended(torque, likelihood)
        if np.all(self.are_faint(best)):
            return best
        if spins.size > 1:
            # Such sizes follow from the spins and cost no number, so that any gain
            # decides for them.
            proportional = best._replace(trials=np.log(spins) - np.mean(np.log(spins)))
            best = _cheapest([best, self._descended(proportional, likelihood)])
        found = [best]
        for form in _WIDER:
            simpler = _cheapest([x for x in found if form.contains(x.form)])
            found.append(self._descended(self._widened(simpler, form), likelihood))
        best = _cheapest(found)
        if spins.size > 1:
            best = self._with_trials(best, likelihood)
        return best

    def _widened(self, torque: Torque, form: Form) -> Torque:
        """The same torque in a form of more numbers."""
        levels, times = np.split(torque.numbers, [torque.form.levels])
        levels = np.resize(levels, form.levels)
        if not times.size:
            middle = 0.5 * (self._shortest + self._longest)
            times = np.full(1, min(self._shortest + _TRIED, middle))
        times = np.resize(times, form.times)
        return torque._replace(form=form, numbers=np.concatenate([levels, times]))

    def _with_trials(self, torque: Torque, likelihood: Likelihood) -> Torque:
        """The torque with a size of its own in each trial, if that is more likely."""
        size = torque.form.size
        trials = torque.trials.size
        function = _with_sizes(torque, likelihood)
        low, high = self.bounds(torque.form)
        low = np.concatenate([low, np.full(trials, -_HIGHEST)])
        high = np.concatenate([high, np.full(trials, _HIGHEST)])
        start = np.concatenate([torque.numbers, np.zeros(trials)])
        # A trial has only its part of all kicks.
        scale = np.repeat([1.0, float(trials)], [size, trials])
        inverse = np.diag(scale / likelihood.kicks)
        x, value = descend(function, start, low, high, inverse)
        cost = _cost_of_sizes(function, x, trials)
        if torque.minus_two_log_likelihood - value < cost:
            return torque
        numbers, own = np.split(x, [size])
        sizes = torque.trials + own
        return torque._replace(
            numbers=numbers,
            trials=sizes,
            own_sizes=True,
            minus_two_log_likelihood=likelihood(torque.form, numbers, sizes)[0],
        )

    def foreign(self, torque: Torque, fit: Fit) -> np.ndarray:
        """Whether each trial has another body, as far as its likelihood shows."""
        used = np.any(fit.kept > 0, axis=1)
        none = np.zeros(used.shape, bool)
        numbers = fit.minimum.point.numbers.size
        if np.sum(used) < FEWEST_TRIALS or not numbers:
            return none
        fall = Likelihood(fit).as_of_another_body(torque)
        # Under a torque that is not quite of this form all trials differ.
        usual = max(float(np.median(fall[used])) / numbers, 1.0)
        # In a trial of the same body the fall is about chi-square of as many degrees of
        # freedom as there are numbers.
        foreign = used & (fall > usual * (numbers + _FOREIGN))
        most = used.size * MOST_FOREIGN
        return foreign if np.sum(foreign | ~used) <= most else none

    def covariance(self, torque: Torque, fit: Fit) -> np.ndarray:
        """Covariance of the logarithms of levels and times."""
        likelihood = Likelihood(fit)

        def slope(numbers: np.ndarray) -> np.ndarray:
            return likelihood(torque.form, numbers, torque.trials)[1]

        changes = [
            slope(torque.numbers + move) - slope(torque.numbers - move)
            for move in _DIFFERENCE * np.eye(torque.form.size)
        ]
        curvature = np.array(changes) / (2 * _DIFFERENCE)
        curvature = 0.5 * (curvature + curvature.T)
        finite = np.where(np.isfinite(curvature), curvature, 0.0)
        values, axes = np.linalg.eigh(finite)
        # The value is twice the logarithm.
        return (axes * (2 / np.maximum(values, 1e-12))) @ axes.T


def _cheapest(torques: list[Torque]) -> Torque:
    """The torque of least cost, of equal ones the first."""
    return min(torques, key=lambda x: x.cost)


def _with_sizes(torque: Torque, likelihood: Likelihood) -> Function:
    """-2 log likelihood of a torque's numbers and of changes of its sizes in trials.

    Prior knowledge that sizes are alike within a factor is included.
    """
    form = torque.form

    def function(x: np.ndarray) -> tuple[float, np.ndarray]:
        numbers, own = np.split(x, [form.size])
        value, slope, of_trials = likelihood(form, numbers, torque.trials + own)
        value = value + _PRECISION_OF_SIZES * float(np.sum(own**2))
        of_trials = of_trials + 2 * _PRECISION_OF_SIZES * own
        return value, np.concatenate([slope, of_trials])

    return function


def _cost_of_sizes(function: Function, x: np.ndarray, trials: int) -> float:
    """Cost of the sizes of trials in -2 log likelihood, by Laplace's method."""
    # Trials hardly depend on each other: moving all shows the curvature of each.
    move = np.zeros(x.size)
    move[-trials:] = _DIFFERENCE
    change = function(x + move)[1] - function(x - move)[1]
    curvature = change[-trials:] / (2 * _DIFFERENCE)
    ratio = curvature / (2 * _PRECISION_OF_SIZES)
    return float(np.sum(np.log(np.maximum(ratio, 1.0))))
