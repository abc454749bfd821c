"""The compiled part of a fit: Levenberg-Marquardt for several records at once.

`minimise` is the one program that a fit of a record needs. All its arguments have an
axis of lanes in front; a lane is a record, or one attempt at a record. Which
minimisation comes next is decided in Python, in `_search.py`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._core.compile import program, small_program
from jrigid._numerics import product
from jrigid._spectral import eigh
from jrigid._types import AnyArray
from jrigid.identify._disturbance import Disturbance, Push, push_of, with_torque
from jrigid.identify._layout import Layout
from jrigid.identify._problem import Problem, evaluation
from jrigid.identify._smoother import (
    Links,
    Move,
    Point,
    Rows,
    moved,
    normal_equations,
    step_of,
)
from jrigid.identify._unknowns import Unknowns

STEPS = 400  # the most of one call
# As Madsen, Nielsen & Tingleff (2004), section 3.2, recommend for rough initial values.
FIRST_DAMPING = 1e-3
FIRST_GROWTH = 2.0  # by Nielsen's rule
_LEAST_DAMPING = 1e-12
# A search has converged only where it takes nearly undamped steps, and is given up
# where steps fail even with this much damping.
_UNDAMPED = 1e-2
_STUCK = 1e8
# Square of a number, in units of its noise, at which Cauchy's loss begins to flatten.
_BEND = 4.0

_Tree = TypeVar("_Tree")
_Vmap = Callable[[Callable[..., _Tree]], Callable[..., _Tree]]


class Settings(NamedTuple):
    """Settings of one minimisation.

    Attributes:
        kept: 1 for each sample that takes part, 0 for one that does not (trials,
            samples).
        scales: Size of each record's residuals, in units of the noise.
        disturbance: The unmodelled torque, where there is one.
        weight: Weight of the links, in units of the noise, where there is no such
            torque.
        horizon: Fraction of the record that takes part.
        soft: Whether the loss is Cauchy's.
        enough: Gain in the sum of squares below which no step is taken.
        steps: The largest number of steps.
        damping: Damping of the first step.
        growth: Factor of the damping if the first step fails.
    """

    kept: AnyArray
    scales: AnyArray
    disturbance: Disturbance
    weight: AnyArray
    horizon: AnyArray
    soft: AnyArray
    enough: AnyArray
    steps: AnyArray
    damping: AnyArray
    growth: AnyArray


class Minimum(NamedTuple):
    """Point at which a minimisation ended.

    Attributes:
        point: Numbers and states.
        rows: Residuals at the point and their derivatives.
        links: Gaps between segments and their derivatives, without the unmodelled
            torque.
        weight: Weight of each row (trials, rows).
        kicks: Sum of squares of the whitened gaps.
        square: Sum of squares of the rows, or what replaces it under Cauchy's loss.
        settled: Whether no further step is worth taking.
        steps: How many steps were taken.
        history: `square` after each step, NaN beyond the last.
        damping: Damping of the next step.
        growth: Factor of the damping if the next step fails.
        tensor: The inertia.
        units: Natural units of the numbers.
    """

    point: Point
    rows: Rows
    links: Links
    weight: AnyArray
    kicks: AnyArray
    square: AnyArray
    settled: AnyArray
    steps: AnyArray
    history: AnyArray
    damping: AnyArray
    growth: AnyArray
    tensor: AnyArray
    units: AnyArray


class _Evaluation(NamedTuple):
    """A point and what was computed there; `cost` is the sum that is minimised."""

    point: Point
    rows: Rows
    links: Links
    weight: Array
    kicks: Array
    square: Array
    cost: Array


class _Loop(NamedTuple):
    """State of the loop: the best point so far and the step to try from it.

    Attributes:
        best: The best point.
        move: The step.
        gain: By how much the step lowers the cost of the linearised problem.
        damping: Damping of the step.
        growth: Factor of the damping if the step fails.
        going: Whether the search goes on.
        settled: Whether no further step is worth taking.
        steps: How many points were evaluated.
        history: Sum of squares at each of them.
    """

    best: _Evaluation
    move: Move
    gain: Array
    damping: Array
    growth: Array
    going: Array
    settled: Array
    steps: Array
    history: Array


def of_samples(problem: Problem, of_records: Array) -> Array:
    """Repeat a number of each record for each of its samples."""
    parts = problem.samples.parts
    repeated = [
        jnp.broadcast_to(of_records[i], x.stop - x.start) for i, x in enumerate(parts)
    ]
    return jnp.concatenate(repeated)


def weights(
    problem: Problem, layout: Layout, settings: Settings, rows: Rows
) -> tuple[Array, Array]:
    """Return weights of rows (trials, n) and their sum of squares.

    Under Cauchy's loss the sum is that of the losses, and the weights are those of
    least squares that have the same gradient.
    """
    square = jnp.sum(rows.residual**2, axis=-1)
    count = settings.kept.shape[1]
    kept = jnp.where(layout.since <= settings.horizon, settings.kept, 0.0)
    # Rows of prior knowledge follow those of samples. Last come the rows that hold a
    # fit near its start, which count while only a part of the record takes part.
    known = jnp.ones_like(square[:, count:])
    early = jnp.where(settings.horizon < 1, 1.0, 0.0)
    known = known.at[:, known.shape[1] - problem.held :].set(early)
    weight = jnp.concatenate([kept, known], axis=1)
    if problem.options.robust:
        return _robust_weights(problem, settings, weight, square)
    return weight, jnp.sum(weight * square)


def _robust_weights(
    problem: Problem, settings: Settings, weight: Array, square: Array
) -> tuple[Array, Array]:
    """Weights under Cauchy's loss b log(1 + s / b) of squares s, and the sum of losses.

    Rows of prior knowledge keep their squares.
    """
    width = jnp.sum(problem.samples.weight, axis=-1)
    size = of_samples(problem, settings.scales**2)[None]
    # Samples without a reading have no width.
    # The square of a sample is a sum over its numbers and grows with their count.
    bend = jnp.maximum(_BEND * width * size, 1e-30)
    known = square.shape[1] - bend.shape[1]
    bend = jnp.pad(bend, ((0, 0), (0, known)), constant_values=jnp.inf)
    soft = settings.soft & jnp.isfinite(bend)
    bend = jnp.where(soft, bend, 1.0)
    loss = jnp.where(soft, bend * jnp.log1p(square / bend), square)
    total = jnp.sum(jnp.where(weight > 0, loss, 0.0))
    return jnp.where(soft, weight / (1 + square / bend), weight), total


def push_over(
    problem: Problem, layout: Layout, numbers: Array, settings: Settings
) -> Push:
    """Change that the unmodelled torque may add from one segment to the next."""
    if problem.options.dense:
        return push_of(
            settings.disturbance,
            layout.end - layout.start,
            layout.linked,
            problem.unknowns.inertia(numbers),
            problem.options.depends_on_attitude,
        )
    # Without such a torque the weights of multiple shooting stand in its place.
    local = problem.options.local
    # They are in units of the noise, so that one schedule serves all records.
    linked = layout.linked.astype(numbers.dtype)
    size = jnp.diag(settings.weight / problem.noise[:local])
    whitener = product("ts,ij->tsij", linked, size)
    nothing = jnp.zeros_like(whitener)
    return Push(covariance=nothing, whitener=whitener, carried=nothing)


def _torque_included(
    rows: Rows, links: Links, push: Push, torque: Array
) -> tuple[Rows, Links]:
    """Rows and links of states that hold the unmodelled torque, if there is one."""
    if torque.shape[-1]:
        return with_torque(rows, links, push, torque)
    return rows, links


def _sum_of_kicks(rows: Rows, links: Links, push: Push, torque: Array) -> Array:
    """Sum of squares of the whitened gaps and of the torques at the first nodes."""
    _, links = _torque_included(rows, links, push, torque)
    gap = product("tsij,tsj->tsi", push.whitener, links.gap)
    return jnp.sum(gap * gap) + jnp.sum(links.torque**2)


def _evaluate(
    problem: Problem, layout: Layout, settings: Settings, push: Push, point: Point
) -> _Evaluation:
    """Evaluate residuals, their derivatives and the cost at a point."""
    rows, links = evaluation(problem, layout)(point)
    weight, square = weights(problem, layout, settings, rows)
    kicks = _sum_of_kicks(rows, links, push, point.torque)
    return _Evaluation(point, rows, links, weight, kicks, square, square + kicks)


def moved_on_path(unknowns: Unknowns, point: Point, move: Move) -> Point:
    """Return a point after a move, on the path of the inertia model."""
    return moved(point, move, unknowns.moved(point.numbers, move.numbers))


def _next_step(place: _Evaluation, push: Push, damping: Array) -> tuple[Move, Array]:
    """Return the damped step from a point, and by how much it should lower the cost."""
    rows, links = _torque_included(place.rows, place.links, push, place.point.torque)
    equations = normal_equations(rows, links, place.weight, push.whitener)
    return step_of(equations, place.point.own.shape[-1], damping)


def _next_damping(loop: _Loop, better: Array, cost: Array) -> tuple[Array, Array]:
    """Return the damping after an evaluation, and its growth if the next step fails.

    Nielsen's rule: the damping falls the more, the better the gain was predicted, and
    grows ever faster while steps fail. The first evaluation has nothing to be compared
    with, so that it changes neither.
    """
    first = jnp.isinf(loop.best.cost)
    gain = jnp.where(first | ~(loop.gain > 0), 1.0, loop.gain)
    # A ratio of one half leaves the damping as it is.
    ratio = jnp.where(first, 0.5, (loop.best.cost - cost) / gain)
    factor = jnp.clip(1 - (2 * ratio - 1) ** 3, 0.1, 2.0)
    damping = loop.damping * jnp.where(better, factor, loop.growth)
    growth = jnp.where(better, FIRST_GROWTH, 2 * loop.growth)
    growth = jnp.where(first & better, loop.growth, growth)
    return jnp.maximum(damping, _LEAST_DAMPING), growth


def _worthwhile_gain(problem: Problem, settings: Settings, cost: Array) -> Array:
    """Gain below which a step is not worth taking, in each lane."""
    if problem.options.noise_known:
        return settings.enough
    # The noise is as large as the residuals.
    counted = settings.kept[..., None] * problem.samples.weight
    count = jnp.maximum(jnp.sum(counted, axis=(1, 2, 3)), 1.0)
    return settings.enough * cost / count


def _where(lanes: Array, new: _Tree, old: _Tree) -> _Tree:
    """Leaves of `new` in the lanes where the condition holds, of `old` elsewhere."""

    def choose(a: Array, b: Array) -> Array:
        return jnp.where(lanes.reshape(lanes.shape + (1,) * (a.ndim - 1)), a, b)

    return jtu.tree_map(choose, new, old)


def _initial_rows(problem: Problem, point: Point) -> tuple[Rows, Links]:
    """Rows and links of zeros, in the shapes that `evaluation` returns."""
    dtype = point.omega.dtype
    local = problem.options.local
    border = point.own.shape[-1] + point.numbers.shape[-1]
    trials, samples, width = problem.samples.weight.shape
    residual = jnp.zeros((trials, samples + problem.known, width), dtype)
    gap = jnp.zeros((*point.omega.shape[:-1], local), dtype)
    rows = Rows(
        residual=residual,
        of_border=jnp.zeros((*residual.shape, border), dtype),
        of_state=jnp.zeros((*residual.shape, local), dtype),
        node=jnp.zeros(residual.shape[:-1], int),
    )
    links = Links(
        gap=gap,
        of_border=jnp.zeros((*gap.shape, border), dtype),
        of_state=jnp.zeros((*gap.shape, local), dtype),
        torque=gap[:, 0, :0],
    )
    return rows, links


def _initial_loop(problem: Problem, point: Point, settings: Settings) -> _Loop:
    """State of the loop before the first evaluation; its first step moves nothing."""
    # An infinite cost makes the first evaluation the best one.
    rows, links = _initial_rows(problem, point)
    one = jnp.ones((), point.omega.dtype)
    still = jnp.concatenate([links.gap, jnp.zeros_like(point.torque)], axis=-1)
    best = _Evaluation(
        point=point,
        rows=rows,
        links=links,
        weight=jnp.zeros(rows.residual.shape[:-1], one.dtype),
        kicks=0 * one,
        square=jnp.inf * one,
        cost=jnp.inf * one,
    )
    return _Loop(
        best=best,
        move=Move(jnp.zeros_like(point.numbers), jnp.zeros_like(point.own), still),
        gain=one,
        damping=settings.damping,
        growth=settings.growth,
        going=settings.steps > 0,
        settled=jnp.asarray(False),
        steps=jnp.asarray(0),
        history=jnp.full(STEPS, jnp.nan, one.dtype),
    )


def _iteration(
    over_lanes: _Vmap,
    problem: Problem,
    layout: Layout,
    settings: Settings,
    push: Push,
    loop: _Loop,
) -> _Loop:
    """Try the step, keep the better point and compute the next step, in all lanes."""
    point = over_lanes(moved_on_path)(problem.unknowns, loop.best.point, loop.move)
    new = over_lanes(_evaluate)(problem, layout, settings, push, point)
    # Residuals are not finite where the motion could not be integrated.
    finite = jnp.all(jnp.isfinite(new.rows.of_border), axis=(1, 2, 3, 4))
    finite = jnp.isfinite(new.cost) & finite
    better = loop.going & finite & (new.cost <= loop.best.cost)
    best = _where(better, new, loop.best)
    damping, growth = _next_damping(loop, better, new.cost)
    move, gain = over_lanes(_next_step)(best, push, damping)
    worthwhile = _worthwhile_gain(problem, settings, best.cost)
    # Under strong damping a small gain does not mean convergence. Without any gain, or
    # with NaN, rounding is reached.
    converged = (gain <= worthwhile) & (damping <= _UNDAMPED)
    settled = converged | (damping > _STUCK) | ~(gain > 1e-6 * worthwhile)
    steps = loop.steps + loop.going.astype(loop.steps.dtype)
    # Lanes that have ended write nowhere.
    index = jnp.where(loop.going, loop.steps, STEPS)
    return _Loop(
        best=best,
        move=move,
        gain=gain,
        damping=damping,
        growth=growth,
        going=loop.going & ~settled & (steps < settings.steps),
        settled=jnp.where(loop.going, settled, loop.settled),
        steps=steps,
        history=over_lanes(_with_entry)(loop.history, index, new.square),
    )


def _with_entry(history: Array, index: Array, value: Array) -> Array:
    """A history with a value at an index, or as it was if the index is beyond it."""
    return history.at[index].set(value, mode="drop")


def _minimum(problem: Problem, loop: _Loop) -> Minimum:
    """Return what a loop found."""
    best = loop.best
    return Minimum(
        point=best.point,
        rows=best.rows,
        links=best.links,
        weight=best.weight,
        kicks=best.kicks,
        square=best.square,
        settled=loop.settled & jnp.isfinite(best.cost),
        steps=loop.steps,
        history=loop.history,
        damping=loop.damping,
        growth=loop.growth,
        tensor=problem.unknowns.inertia(best.point.numbers),
        units=problem.unknowns.natural_units(best.point.numbers),
    )


def _over_one_lane(function: Callable[..., _Tree]) -> Callable[..., _Tree]:
    """`jax.vmap` of a single lane, which takes less time to trace."""

    def call(*arguments: Any) -> _Tree:
        result = function(*jtu.tree_map(lambda x: x[0], arguments))
        return jtu.tree_map(lambda x: x[None], result)

    return call


@program
def minimise(
    problem: Problem, layout: Layout, point: Point, settings: Settings
) -> Minimum:
    """Minimise sums of squares by Levenberg-Marquardt, one in each lane.

    Args:
        problem: The records.
        layout: Their segments.
        point: Initial values.
        settings: What is to be done.

    Source: J. J. More (1978); H. B. Nielsen, "Damping parameter in Marquardt's method"
    (1999).
    """
    over_lanes = jax.vmap if settings.steps.shape[0] > 1 else _over_one_lane
    # The weights of the links are those of the tensor at the start. If they followed
    # it, the sum of squares could fall by a change of the weights alone.
    push = over_lanes(push_over)(problem, layout, point.numbers, settings)

    def iteration(loop: _Loop) -> _Loop:
        return _iteration(over_lanes, problem, layout, settings, push, loop)

    def goes_on(loop: _Loop) -> Array:
        # A condition on one array alone makes XLA look for a counter: it copies all of
        # the loop's body again and again, which takes a sixth of the time to compile.
        return jnp.any(loop.going & (loop.steps < STEPS))

    start = over_lanes(_initial_loop)(problem, point, settings)
    loop = jax.lax.while_loop(goes_on, iteration, start)
    return over_lanes(_minimum)(problem, loop)


@small_program
def tensors_at(unknowns: Unknowns, numbers: Array) -> Array:
    """Inertia tensors of several vectors of numbers (several, numbers)."""
    return jax.vmap(unknowns.inertia)(numbers)


@small_program
def spectrum(unknowns: Unknowns, numbers: Array) -> tuple[Array, Array, Array, Array]:
    """The tensor, its moments and axes, its derivatives in numbers (3, 3, numbers)."""
    tensor = unknowns.inertia(numbers)
    moments, axes = eigh(tensor)
    return tensor, moments, axes, jax.jacfwd(unknowns.inertia)(numbers)
