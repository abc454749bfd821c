"""The search for the minimum: stages, attempts from several bodies, and probes.

The search is plain Python: a generator that yields what is to be minimised as a
`Request` and is sent the `Minimum`. So one driver serves a single record and many,
whose requests share compiled calls.
"""

import dataclasses
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from jrigid._types import AnyArray
from jrigid.identify import _levels as levels
from jrigid.identify._counts import gaps_of, places_beside
from jrigid.identify._disturbance import Disturbance, GaussMarkov, no_disturbance
from jrigid.identify._errors import Weakest, weakest
from jrigid.identify._inertia_models import LOGARITHMS, Tensor
from jrigid.identify._layout import Layout
from jrigid.identify._minimise import (
    FIRST_DAMPING,
    FIRST_GROWTH,
    Minimum,
    Settings,
    minimise,
    tensors_at,
)
from jrigid.identify._precision import precision
from jrigid.identify._problem import Problem
from jrigid.identify._quality import (
    FOLLOWED,
    Fit,
    Probe,
    is_at_boundary,
    is_pure,
    misfit,
    scales_of,
    unexplained,
    weights_of,
    without_outliers,
)
from jrigid.identify._result import LARGEST_ERROR
from jrigid.identify._smoother import Point
from jrigid.identify._torque_errors import first_level
from jrigid.identify._unknowns import Unknowns

# Of the sum of squares, a step is worth: a thousandth of the standard errors.
ACCURACY = 1e-6
_ROUGH = 0.3  # ... where a stage only has to start the next one
# Weights of the links, in units of the noise; and a slower way for fits that went
# wrong.
_WEIGHTS = {True: (1.0, 30.0, 1e3), False: (1.0, 10.0, 100.0, 1e3, 1e4)}
_SLOW = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4)
_LARGEST = {8: 1e4, 4: 100.0}  # whose square is still far from the digits' end
_IN_A_STAGE = 15
_REJECTIONS = 3  # stages after each of which outliers are judged anew
_APART = 3  # stages in which the parts of a coarse record are not linked
_GAP = 3.5  # radians between nodes: a segment without samples, longer than others are
# The most records of one compiled call on a GPU. On a CPU each call takes one, as `fit`
# does: lanes wait for the slowest, which costs more than the overhead that they share.
_LANES = 8
_WAITING = 8  # calls, for which there may be requests before another search begins
# Steps of one call. A call lasts until its slowest lane has ended, so that a record
# which needs hundreds of steps makes others wait; but most stages end in one call.
_IN_A_CALL = 32
# Stages in which an unmodelled torque is sought, white and then of any form.
_LEVELS = 12
_LEVEL_STEPS = 6  # stages in which one that is known is reached
_AT_REST = 0.02  # a change of the logarithms of its numbers that is none

# Logarithms of values that are small enough in their unit, the largest first, and the
# rise of chi-square that they may cost. All else is held where it is, so that a value
# of a hundredth of its stated error can cost much.
_SMALL = (-7.0, -11.0, -15.0, -19.0, -23.0)
_NO_RISE = 0.01
# Logarithms of elements of L of a body that is thicker than flat: the first one tried,
# the thickest and the thinnest.
_FIRST_THICKNESS = -3.5
_THICKEST = -1.5
_THINNEST = -8.0
_VAGUE = 3.0  # an error of such a logarithm that is more than a factor of size
_FLAT = 1e-3  # least second moment of the body that the first attempt starts from
_ROUND = 0.1  # ... that others start from, since the first led nowhere
# Chi-square for each degree of freedom: a misfit worth other initial values.
_MUCH_MISFIT = 10.0
_PROBES = (-0.25, 0.25, -1.0, 1.0)  # natural units, along the weakest direction
_WEAK = 0.01  # an error in natural units that is worth probes
_HARD = 1e4  # weight of what a probe holds, in natural units
_LEAST_GROWTH = 1e-6  # of chi-square at a probe: rounding may make it less
# Growth of chi-square, six standard errors, at which a probe is content.
_ENOUGH_GROWTH = 36.0
_DISTINCT = 0.1  # natural units between two minima
_BEYOND = 6.0  # standard errors from a fit that no error describes
_BESIDE = 100  # steps to a minimum with another number of turns in a gap
_FEW = 32  # numbers of a coarse record, too few to tell aliases
# Times what Fisher's information says: a valley that no covariance describes.
_BENT = 2.0
_RIVAL = 25.0  # growth of chi-square beyond which another minimum does not matter


class Line(eqx.Module):
    """Holds the numbers on a plane: a residual that is zero there."""

    direction: AnyArray
    value: AnyArray

    def __call__(self, unknowns: Unknowns, numbers: Array) -> Array:
        """The residual."""
        del unknowns
        return jnp.sum(self.direction * numbers) - self.value


class Stage(NamedTuple):
    """One minimisation of an attempt.

    Attributes:
        weight: Of the links, in units of the noise; of a torque that is known, how far
            its level has come.
        steps: The largest number of steps.
        enough: A gain that is not worth a step.
        horizon: Fraction of the record that takes part.
        whole: From one state a trial.
        apart: Parts of the record between long gaps have states of their own.
        soft: With Cauchy's loss.
        reject: Samples too far off are left out from here on.
        last: The torque is no longer changed.
    """

    weight: float
    steps: int
    enough: float
    horizon: float = 2.0
    whole: bool = False
    apart: bool = False
    soft: bool = False
    reject: bool = False
    last: bool = False


@dataclasses.dataclass(frozen=True)
class Effort:
    """Limits of a search, and a function that reports its progress.

    Attributes:
        max_steps: Of the last stage.
        doublings: The first stage without shooting sees 2^-doublings of the record.
        report: Called with a line of text after each stage, or None.
    """

    max_steps: int = 400
    doublings: int = 8
    report: Callable[[str], None] | None = None


class Starts:
    """Numbers from which attempts start, by one tensor for each attempt.

    They are computed when they are needed: only a fit that went wrong needs more than
    the first ones.

    Attributes:
        unknowns: With the frame of the inertia model chosen for the first tensor.
    """

    def __init__(self, unknowns: Unknowns, tensors: np.ndarray):
        """Choose the frame, and compute the numbers of the first attempt.

        Args:
            unknowns: With the inertia model as it was given.
            tensors: Where to start (attempts, 3, 3).
        """
        self._given = unknowns
        self._tensors = tensors
        self.unknowns, self._first = unknowns.start(tensors[0], _FLAT)

    def __len__(self) -> int:
        """Number of attempts that are possible."""
        return len(self._tensors)

    def __getitem__(self, attempt: int) -> np.ndarray:
        """The numbers of an attempt."""
        if attempt == 0:
            return self._first
        unknowns, numbers = self._given.start(self._tensors[attempt], _ROUND)
        return unknowns.in_frame(numbers, self.unknowns)[1]


@dataclasses.dataclass(frozen=True)
class Case:
    """A record and where its search begins.

    Attributes:
        problem: The record.
        single: One segment a trial.
        cut: Many segments.
        point: States at their starts, as observed.
        starts: Numbers of each attempt.
        tensor: The inertia of the first start.
        torque: Unmodelled, if it is known.
        coarse: Whether the body turns by more than half a turn between samples.
        long: Whether it turns many times, so that probes must go slowly too.
        alias: The same record as that of another motion, if there may be one.
        given: The same record, from the body and the states that the user gave, if
            that is where a search may begin.
        effort: How hard to try.
    """

    problem: Problem
    single: Layout
    cut: Layout
    point: Point
    starts: Starts
    tensor: np.ndarray
    torque: GaussMarkov
    coarse: bool
    long: bool
    alias: "Case | None"
    given: "Case | None"
    effort: Effort

    @property
    def final(self) -> Layout:
        """The layout of the last stage."""
        options = self.problem.options
        return self.cut if options.dense or not options.free_motion else self.single


class Request(NamedTuple):
    """The arguments of `minimise`, without lanes."""

    problem: Problem
    layout: Layout
    point: Point
    settings: Settings


Search = Generator[Request, Minimum, Fit]
_Value = TypeVar("_Value")


def stages_of(case: Case, slow: bool) -> list[Stage]:
    """The stages of an attempt."""
    options = case.problem.options
    # The exact flow holds over a whole trial. Under a torque the segments stay, held
    # together by links of the largest weight.
    whole = not options.dense and (options.free_motion or not options.shooting)
    largest = _LARGEST[case.point.omega.dtype.itemsize]
    end = Stage(largest, case.effort.max_steps, ACCURACY, whole=whole, last=True)
    if options.dense:
        stages = _stages_of_torque(options.unmodelled)
        end = end._replace(weight=1.0)
    elif not options.shooting:
        horizons = [2.0**-k for k in range(case.effort.doublings, 0, -1)]
        stages = [Stage(0.0, _IN_A_STAGE, ACCURACY, horizon=x) for x in horizons]
    else:
        weights = _SLOW if slow else _WEIGHTS[options.free_motion]
        steps = 2 * _IN_A_STAGE if slow else _IN_A_STAGE
        stages = [Stage(min(x, largest), steps, _ROUGH) for x in weights]
        if case.coarse:
            # The number of turns in a gap is counted by the body that the parts of the
            # record tell.
            stages = [*(x._replace(apart=True) for x in stages[:_APART]), *stages]
    stages = [x._replace(soft=options.robust) for x in (*stages, end)]
    if options.robust:
        # What is left out changes the fit, and with it what is far off.
        stages += _REJECTIONS * [end._replace(soft=False, reject=True)]
    return stages


def _stages_of_torque(unmodelled: str) -> list[Stage]:
    """Stages in which the level of an unmodelled torque is reached or sought."""
    if unmodelled == "known":
        weights = np.linspace(0, 1, _LEVEL_STEPS).tolist()
    else:
        weights = [1.0] * (2 * _LEVELS)
    return [Stage(x, 8, 0.01) for x in weights]


def attempt(
    case: Case, problem: Problem, numbers: np.ndarray, slow: bool, framed: bool = True
) -> Search:
    """All stages from some numbers, each from where the one before ended.

    Args:
        case: The record.
        problem: The record, with the frame of the numbers, and what a probe holds.
        numbers: Where to start.
        slow: Whether to take more stages.
        framed: Whether each stage may have a frame of its own.
    """
    options = problem.options
    dtype = case.point.omega.dtype
    kept = problem.samples.seen.astype(dtype)
    candidates = kept
    scales = np.ones(len(problem.samples.values), dtype)
    torque = _Torque(case, problem)
    point = case.point._replace(numbers=numbers)
    histories = []
    fit = None
    has_left_out = False
    for stage in stages_of(case, slow):
        if torque.at_rest and not stage.last:
            continue
        if options.robust and fit is not None:
            scales = scales_of(problem, fit.residual, kept)
        if stage.reject:
            assert fit is not None  # other stages come first
            chosen = without_outliers(problem, fit.residual, candidates, scales)
            if has_left_out and np.array_equal(chosen, kept):
                break
            kept = chosen
            has_left_out = True
        else:
            candidates = kept
        if framed:
            problem, point = _in_own_frame(problem, point)
        torque.begin(stage)
        layout = _layout_of(case, stage, point)
        settings = _settings(stage, kept, scales, torque.disturbance)
        minimum, history = yield from _stage(Request(problem, layout, point, settings))
        point = minimum.point
        histories.append(history)
        fit = Fit(
            problem=problem,
            minimum=minimum,
            layout=layout,
            kept=kept,
            scales=scales,
            disturbance=torque.disturbance,
            torque=torque.sought,
            history=np.concatenate(histories),
        )
        if case.effort.report is not None:
            case.effort.report(_progress(stage, fit))
        if options.unmodelled == "estimate" and not stage.last:
            kept = torque.sought_anew(fit)
    assert fit is not None  # there is always a last stage
    if options.robust:
        # It is judged by its own residuals, and not by those of the stage before.
        scales = scales_of(problem, fit.residual, kept)
    return dataclasses.replace(fit, scales=scales, computed={})


def _layout_of(case: Case, stage: Stage, point: Point) -> Layout:
    """The layout of a stage.

    Parts that are apart have no links between nodes that are many radians apart.
    """
    layout = case.single if stage.whole else case.cut
    if not stage.apart:
        return layout
    turned = np.linalg.norm(point.omega, axis=-1) * (layout.end - layout.start)
    return layout._replace(linked=layout.linked & (turned < _GAP))


def _in_own_frame(problem: Problem, point: Point) -> tuple[Problem, Point]:
    """The same point, by numbers in which a search moves best."""
    unknowns, numbers = problem.unknowns.in_frame(point.numbers)
    moved = dataclasses.replace(problem, unknowns=unknowns)
    return moved, point._replace(numbers=numbers)


def _settings(
    stage: Stage, kept: np.ndarray, scales: np.ndarray, disturbance: Disturbance
) -> Settings:
    """The settings of a stage."""
    dtype = kept.dtype
    return Settings(
        kept=kept,
        scales=scales,
        disturbance=disturbance,
        weight=np.asarray(stage.weight, dtype),
        horizon=np.asarray(stage.horizon, dtype),
        soft=np.asarray(stage.soft),
        enough=np.asarray(stage.enough, dtype),
        steps=np.asarray(stage.steps),
        damping=np.asarray(FIRST_DAMPING, dtype),
        growth=np.asarray(FIRST_GROWTH, dtype),
    )


class _Torque:
    """The unmodelled torque on the way through the stages of an attempt.

    It is white at first. Once its level has come to rest its other forms are tried;
    once these have, trials of another body are looked for and left out.
    """

    def __init__(self, case: Case, problem: Problem):
        """Begin with a torque far too large: the fit then follows the record."""
        self._case = case
        self._dtype = case.point.omega.dtype
        self._kind = problem.options.unmodelled
        trials = case.point.omega.shape[0]
        self._first = first_level(problem, case.cut, case.tensor)
        self._search = levels.Search(case.cut, self._first)
        # Beside a noise that is not known a level far too large is nearly as likely as
        # another.
        level = (10 if problem.options.noise_known else 1) * self._first
        self._current = self._search.start(level, trials)
        self.disturbance = no_disturbance(trials, self._dtype)
        self._may_have_other_forms = True
        self.at_rest = False

    @property
    def sought(self) -> levels.Torque | None:
        """The torque, where one is sought."""
        return self._current if self._kind == "estimate" else None

    def begin(self, stage: Stage) -> None:
        """Set the torque of a stage."""
        if self._kind == "none":
            return
        torque = self._current.disturbance
        if self._kind == "known":
            known = self._case.torque
            # From a level that moves a rate by its noise between nodes, in equal ratios
            # to the known one.
            level = self._first * (known.level / self._first) ** stage.weight
            torque = Disturbance(np.broadcast_to(level, torque.level.shape), known.time)
        self.disturbance = Disturbance(*(x.astype(self._dtype) for x in torque))

    def sought_anew(self, fit: Fit) -> np.ndarray:
        """Seek the torque where a stage ended; which samples are kept from here on."""
        before = self._current
        self._current = self._search.improved(before, fit)
        if np.max(np.abs(self._current.numbers - before.numbers)) > _AT_REST:
            return fit.kept
        if self._may_have_other_forms:
            self._may_have_other_forms = False
            rates = np.sum(fit.minimum.point.omega**2, axis=-1)
            spins = np.sqrt(np.mean(rates, axis=1))
            self._current = self._search.preferred(self._current, fit, spins)
            return fit.kept
        foreign = self._search.foreign(self._current, fit)
        self.at_rest = not np.any(foreign)
        return np.where(foreign[:, None], 0, fit.kept).astype(fit.kept.dtype)


def _stage(request: Request) -> Generator[Request, Minimum, tuple[Minimum, np.ndarray]]:
    """Minimise in calls of a few steps each, which end where a single call would.

    Returns:
        The minimum, and the sum of squares after each step.
    """
    settings = request.settings
    allowed = int(settings.steps)
    histories = []
    repeated = 0
    while True:
        # A call begins with an evaluation of the point where the last one ended.
        steps = np.asarray(min(repeated + allowed, _IN_A_CALL))
        minimum = yield request._replace(settings=settings._replace(steps=steps))
        taken = int(minimum.steps)
        histories.append(minimum.history[repeated:taken])
        allowed -= taken - repeated
        if bool(minimum.settled) or taken < steps or not allowed:
            return minimum, np.concatenate(histories)
        request = request._replace(point=minimum.point)
        settings = settings._replace(damping=minimum.damping, growth=minimum.growth)
        repeated = 1


def _progress(stage: Stage, fit: Fit) -> str:
    """A line of text about a stage that has ended."""
    part = min(stage.horizon, 1.0)
    return (
        f"fit: {fit.history.size} steps, links {stage.weight:g}, record {part:.3g}: "
        f"chi-square {float(fit.minimum.square):.6g}"
    )


def search(case: Case) -> Search:
    """Run all stages; if they fail, run them again, slower, from other numbers.

    Fisher's information at a minimum knows nothing of a valley that bends, nor of other
    minima. So a fit whose weakest direction is poorly determined is probed: that
    direction is held a natural unit, and a quarter of one, to either side, and all else
    is fitted anew. How little chi-square grows tells the error. Of coarse records,
    which have aliases, several attempts are compared.
    """
    best, ambiguous = yield from _best_of_attempts(case)
    if case.given is not None and misfit(best) > 0:
        given = case.given
        other = yield from attempt(given, given.problem, given.starts[0], slow=False)
        best = other if misfit(other) < misfit(best) else best
    if case.alias is not None and (misfit(best) > 0 or not ambiguous):
        read = best
        best, rival = yield from _beside_alias(case.alias, best)
        if best is not read:
            # Probes begin where this fit began.
            case = case.alias
        ambiguous = ambiguous or rival
    options = case.problem.options
    if case.coarse and options.free_motion and not options.dense:
        best, rival = yield from _among_counts(case, best)
        ambiguous = ambiguous or rival
    best = yield from _off_zero(case, best)
    best = dataclasses.replace(best, ambiguous=ambiguous)
    if misfit(best) == 0 and not ambiguous and not case.problem.options.dense:
        # Squares beside levels of their own differ, so fits with a level are not
        # probed.
        best = yield from _probed(case, best, weakest(best))
    if _is_thickness_unknown(best):
        thicker = yield from _thicker(case, best)
        best = dataclasses.replace(best, thicker=thicker)
    return best


def _best_of_attempts(
    case: Case,
) -> Generator[Request, Minimum, tuple[Fit, bool]]:
    """The best of all attempts, and whether others far from it are about as good."""
    problem = case.problem
    # Few samples of a coarse record follow any alias.
    counted = np.sum(weights_of(problem, problem.samples.seen.astype(float)))
    few = case.coarse and bool(counted < _FEW)
    best = yield from attempt(case, problem, case.starts[0], slow=False)
    wrong = misfit(best)
    weak = weakest(best)
    ambiguous = few
    index = 1
    while index < _attempts(case, best, wrong, weak.noise, ambiguous):
        other = yield from attempt(case, problem, case.starts[index], slow=True)
        other_wrong = misfit(other)
        other_weak = weakest(other)
        # Squares are compared in units of the noise, which may not have been stated.
        fall = (weak.square - other_weak.square) / other_weak.noise
        better = other_wrong < wrong or (other_wrong <= wrong and fall > 0)
        error = max(weak.error, other_weak.error)
        apart = _are_apart(best, other, error)
        rival = apart and abs(fall) < _RIVAL
        ambiguous = few or rival or (ambiguous and not (better and fall > _RIVAL))
        if better:
            best = other
            wrong = other_wrong
            weak = other_weak
        index += 1
    return best, ambiguous


def _among_counts(
    case: Case, best: Fit
) -> Generator[Request, Minimum, tuple[Fit, bool]]:
    """The best of the minima that differ in the turns of the body in gaps.

    Returns:
        The fit, and whether another minimum is about as good or may have been missed.
    """
    if not np.isfinite(best.minimum.square):
        return best, False
    last = stages_of(case, slow=False)[-1]
    last = last._replace(steps=min(last.steps, _BESIDE))
    noise = weakest(best).noise
    fits = [best]
    complete = True
    for gap in gaps_of(best):
        now = _lowest(fits)
        # Each side tells how the body turns. The one that predicts the other better is
        # used.
        by_side = []
        for known, predicted in (gap.sides, gap.sides[::-1]):
            kept = best.kept.copy()
            kept[gap.trial] *= known
            side = yield from _fitted_again(now, now.minimum.point, last, kept)
            if side.minimum.settled:
                by_side.append(places_beside(side, now, gap.trial, predicted, noise))
        if not by_side:
            complete = False
            continue
        places = min(by_side, key=lambda x: x.angle)
        complete = complete and places.complete
        squares = []
        for point in places.points:
            there = yield _evaluation(case, best, best.problem, point)
            squares.append(float(there.square))
        for point in places.lowest(np.array(squares)):
            fits.append((yield from _fitted_again(best, point, last, best.kept)))
    least = _lowest(fits)
    # What the errors of the fit allow is no other minimum.
    is_rival = [
        x.minimum.square - least.minimum.square < _RIVAL * noise
        and _distance(least, x) > _BEYOND * np.sqrt(noise)
        for x in fits
    ]
    return least, any(is_rival) or not complete


def _lowest(fits: Sequence[Fit]) -> Fit:
    """The fit with the smallest sum of squares, of which one is finite."""
    return fits[int(np.nanargmin([x.minimum.square for x in fits]))]


def _distance(one: Fit, other: Fit) -> float:
    """Distance between the numbers of two fits, in errors of the first for noise 1."""
    known = precision(one)
    change = other.minimum.point.numbers - one.minimum.point.numbers
    along = known.directions.T @ (change / one.minimum.units)
    return float(np.linalg.norm(known.values * along))


def _fitted_again(fit: Fit, point: Point, stage: Stage, kept: np.ndarray) -> Search:
    """The last stage of a fit from another point, with other samples."""
    settings = _settings(stage, kept, fit.scales, fit.disturbance)
    request = Request(fit.problem, fit.layout, point, settings)
    minimum, history = yield from _stage(request)
    return dataclasses.replace(
        fit,
        minimum=minimum,
        kept=kept,
        history=np.concatenate([fit.history, history]),
        computed={},
    )


def _off_zero(case: Case, best: Fit) -> Search:
    """The minimum with values that vanished moved off zero, where nothing changes.

    A positive array is an exponential of its numbers where it is small. At zero it has
    no slope, so that the errors of all else would be those for an array that is known
    to be zero.
    """
    before = best.minimum
    point = before.point
    # Single precision does not hold such small slopes beside those of other numbers.
    single = before.units.dtype == np.float32
    for least in _SMALL[:1] if single else _SMALL:
        numbers, own = best.problem.unknowns.off_zero(point.numbers, point.own, least)
        if np.array_equal(numbers, point.numbers) and np.array_equal(own, point.own):
            return best
        moved = point._replace(numbers=numbers, own=own)
        minimum = yield _evaluation(case, best, best.problem, moved)
        fit = dataclasses.replace(
            best, minimum=minimum._replace(settled=before.settled), computed={}
        )
        rise = weakest(fit).square - weakest(best).square
        if rise < _NO_RISE * weakest(best).noise:
            return fit
    return best


def _evaluation(case: Case, best: Fit, problem: Problem, point: Point) -> Request:
    """Ask for the rows of a fit at another point."""
    # The first step evaluates the point, and moves nothing.
    stage = stages_of(case, slow=False)[-1]._replace(steps=1)
    settings = _settings(stage, best.kept, best.scales, best.disturbance)
    return Request(problem, best.layout, point, settings)


def _is_thickness_unknown(best: Fit) -> bool:
    """Whether the mass may lie in a plane or on a line for all that is known."""
    if not isinstance(best.problem.unknowns.inertia_model, Tensor):
        return False
    logarithms = best.minimum.point.numbers[LOGARITHMS]
    variances = np.diagonal(precision(best).covariance)[LOGARITHMS]
    is_thin = (logarithms < _FIRST_THICKNESS) & (variances > _VAGUE**2)
    return is_at_boundary(best) or bool(np.any(is_thin))


def _thicker(case: Case, best: Fit) -> Search:
    """The rows of a body as thick as its thickness is uncertain.

    The numbers of a body are logarithms. Those that state the thickness of a flat one
    change nothing to first order, so that its own rows say nothing of their errors.
    """
    problem, point = _in_own_frame(best.problem, best.minimum.point)
    fit = best
    least = _FIRST_THICKNESS
    # The first time tells the size of the error.
    for _ in range(2):
        numbers = point.numbers.copy()
        numbers[LOGARITHMS] = np.maximum(numbers[LOGARITHMS], least)
        at = point._replace(numbers=numbers)
        minimum = yield _evaluation(case, best, problem, at)
        fit = dataclasses.replace(
            best, problem=problem, minimum=minimum, probes=(), computed={}
        )
        variances = np.diagonal(precision(fit).covariance)[LOGARITHMS]
        # A second moment is the square of an element of L.
        error = 2 * np.sqrt(np.max(variances))
        least = np.clip(least + 0.5 * np.log(error), _THINNEST, _THICKEST)
    return fit


def _beside_alias(
    alias: Case, best: Fit
) -> Generator[Request, Minimum, tuple[Fit, bool]]:
    """The better of a fit and one of its alias, and whether they are about as good."""
    # The rates of an alias are rough, and with them its first start. The last one is
    # rounder.
    numbers = alias.starts[len(alias.starts) - 1]
    other = yield from attempt(alias, alias.problem, numbers, slow=True)
    at = weakest(best)
    fall = (at.square - weakest(other).square) / at.noise
    wrong = misfit(best)
    other_wrong = misfit(other)
    as_good = other_wrong <= wrong
    better = other_wrong < wrong or (as_good and fall > _RIVAL)
    return other if better else best, as_good and abs(fall) < _RIVAL


def no_search(case: Case) -> Search:
    """Evaluate nothing: for a record that cannot be used."""
    dtype = case.point.omega.dtype
    samples = case.problem.samples
    one = np.ones((), dtype)
    settings = Settings(
        kept=np.zeros(samples.ts.shape, dtype),
        scales=np.ones(len(samples.values), dtype),
        disturbance=no_disturbance(samples.ts.shape[0], dtype),
        weight=one,
        horizon=one,
        soft=np.asarray(False),
        enough=one,
        steps=np.asarray(0),
        damping=one,
        growth=one,
    )
    minimum = yield Request(case.problem, case.final, case.point, settings)
    return Fit(
        problem=case.problem,
        minimum=minimum,
        layout=case.final,
        kept=settings.kept,
        scales=settings.scales,
        disturbance=settings.disturbance,
        torque=None,
        history=np.zeros(0, dtype),
    )


def _attempts(
    case: Case, best: Fit, wrong: float, noise: float, ambiguous: bool
) -> int:
    """Number of attempts to make.

    A misfit that follows the record gets two, other failures get all. A coarse record
    has many bodies that follow it, so its misfits are such failures.
    """
    count = len(case.starts)
    if is_pure(best, noise) and wrong < 0.5:  # no misfit
        return 1
    if ambiguous and wrong == 0:
        return 1
    if wrong > 0:
        lost = wrong > _MUCH_MISFIT or is_at_boundary(best)
        lost = lost or unexplained(best) > FOLLOWED
        return count if lost or case.coarse else min(2, count)
    return min(4, count) if case.coarse else 1


def _probed(case: Case, best: Fit, at: Weakest) -> Search:
    """The same fit, with what probes show of its weakest direction."""
    problem = best.problem
    if not _WEAK < at.error < LARGEST_ERROR or is_pure(best, at.noise):
        return best
    before = best.minimum.point.numbers
    probes: list[Probe] = []
    sides_beyond = set()
    for step in _PROBES:
        side = np.sign(step)
        # Chi-square grows along a valley, so that a longer step leads farther away.
        if side in sides_beyond:
            continue
        numbers = before + step * at.direction
        # A miss of one natural unit along the direction is a residual of this weight.
        normal = _HARD * at.normal
        line = Line(normal, np.sum(normal * numbers))
        held = dataclasses.replace(problem, unknowns=problem.unknowns.holding(line))
        end = yield from attempt(case, held, numbers, case.long, framed=False)
        growth = (weakest(end).square - at.square) / at.noise
        distance = float(np.sqrt(max(growth, _LEAST_GROWTH)))
        error = _error_by_probe(best, end, at.direction, step, distance)
        # Beyond six standard errors a probe says nothing of those that are stated.
        if growth >= _ENOUGH_GROWTH:
            sides_beyond.add(side)
            continue
        probes.append(Probe(end.minimum.tensor, distance, error))
        largest = max(x.error for x in probes)
        if largest > _BENT * at.error:
            return dataclasses.replace(best, ambiguous=True, probes=tuple(probes))
        if largest >= LARGEST_ERROR:
            break
    return dataclasses.replace(best, probes=tuple(probes))


def _are_apart(one: Fit, other: Fit, error: float) -> bool:
    """Whether two fits are different minima."""
    judged = other.problem.unknowns.judged
    _, numbers = one.problem.unknowns.in_frame(
        one.minimum.point.numbers, other.problem.unknowns
    )
    apart = np.abs(numbers - other.minimum.point.numbers) / other.minimum.units
    far = np.max(apart[judged], initial=0.0)
    return bool(far > max(_DISTINCT, 6 * error))


def _error_by_probe(
    best: Fit,
    end: Fit,
    direction: np.ndarray,
    step: float,
    distance: float,
) -> float:
    """Error in natural units, by how far the tensor moved: numbers are logarithms."""
    tensor = best.minimum.tensor
    h = 1e-4
    near = best.minimum.point.numbers + h * np.stack([direction, -direction])
    ahead, back = np.asarray(tensors_at(best.problem.unknowns, near))
    slope = (ahead - back) / (2 * h)
    square = np.sum(slope * slope)
    if square > 0:
        step = float(np.sum((end.minimum.tensor - tensor) * slope) / square)
    # Chi-square grows as the square of a move over its error.
    return abs(step) / distance


class _Call(NamedTuple):
    """A compiled call that is under way, or has ended.

    Attributes:
        indices: Of the searches that asked for it.
        results: A `Minimum` of arrays that may still be computed, with lanes in front.
    """

    indices: list[int]
    results: Minimum

    @property
    def has_ended(self) -> bool:
        """Whether the results are there."""
        return self.results.square.is_ready()

    def answers(self) -> list[tuple[int, Minimum]]:
        """Minimum for each search that asked; waits until the call has ended."""
        minima = _of_lanes(self.results, len(self.indices))
        return list(zip(self.indices, minima, strict=True))


@np.errstate(all="ignore")  # attempts may run out of the range of numbers
def run(searches: Iterable[Generator[Request, Minimum, _Value]]) -> list[_Value]:
    """Carry out a search, or many: what each of them returns.

    Requests of equal shapes share compiled calls on a GPU. JAX computes in the
    background: while a call is under way, Python does what other searches need. One
    call at a time: two would share the cores, and neither would end sooner.
    """
    searches = list(searches)
    is_batched = len(searches) > 1 and jax.default_backend() != "cpu"
    lanes = _LANES if is_batched else 1
    values: list[Any] = [None] * len(searches)
    # What can be answered in one call, by shapes: requests by the index of the search.
    waiting: dict[Any, dict[int, Request]] = {}
    not_begun = deque(range(len(searches)))
    answered: deque[tuple[int, Minimum]] = deque()
    call: _Call | None = None

    def go_on(index: int, answer: Any) -> None:
        try:
            request = searches[index].send(answer)
        except StopIteration as end:
            values[index] = end.value
        else:
            waiting.setdefault(_shapes(request), {})[index] = request

    def fullest() -> dict[int, Request]:
        return max(waiting.values(), key=len, default={})

    def may_begin() -> bool:
        # More than a few that wait take memory, and keep nobody busy.
        return bool(not_begun) and len(fullest()) < _WAITING * lanes

    while call or answered or not_begun or fullest():
        idle = not answered and not may_begin()
        if call is not None and (idle or call.has_ended):
            answered.extend(call.answers())
            call = None
        # Lanes cost time whether they are used or not, so that a call which is not full
        # waits for what other searches ask.
        is_full = len(fullest()) >= lanes
        if call is None and (is_full or not (answered or may_begin())):
            requests = fullest()
            indices = list(requests)[:lanes]
            call = _Call(indices, _called([requests.pop(i) for i in indices], lanes))
        if answered:
            go_on(*answered.popleft())
        elif may_begin():
            go_on(not_begun.popleft(), None)
    return values


def _shapes(request: Request) -> Any:
    """Key that is equal for requests that one compiled call can answer."""
    leaves, tree = jtu.tree_flatten(request)
    return tree, tuple(np.shape(x) for x in leaves)


def _called(requests: Sequence[Request], lanes: int) -> Minimum:
    """Minimise side by side; unused lanes repeat the first one, without steps."""
    # The compiled call has a fixed number of lanes. Without steps a lane ends at once.
    idle = requests[0]._replace(
        settings=requests[0].settings._replace(steps=np.asarray(0))
    )
    padded = [*requests, *[idle] * (lanes - len(requests))]
    stacked = jtu.tree_map(lambda *x: np.array([np.asarray(y) for y in x]), *padded)
    return minimise(*stacked)


def _of_lanes(results: Minimum, count: int) -> list[Minimum]:
    """The first so many results, as numpy arrays."""
    results = jtu.tree_map(np.asarray, results)
    return [jtu.tree_map(lambda x, i=i: x[i], results) for i in range(count)]


def minima(requests: Sequence[Request]) -> list[Minimum]:
    """Minimise side by side."""
    count = len(requests)
    return _of_lanes(_called(requests, count), count)
