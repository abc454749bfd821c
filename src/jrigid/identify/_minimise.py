"""The compiled part of a fit: Levenberg-Marquardt for many records, or attempts, at once.

`minimise` is the one program that a fit of a record needs. All its arguments have an
axis of lanes in front; a lane is a record, or one attempt at a record. Which
minimisation comes next, and what follows from one, is decided in Python: see
`_search.py`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._numerics import product
from jrigid._spectral import eigh
from jrigid.identify._compile import program, small_program
from jrigid.identify._disturbance import Disturbance, Push, push_of, with_torque
from jrigid.identify._layout import Layout
from jrigid.identify._problem import Problem, evaluation
from jrigid.identify._smoother import (
    Links,
    Point,
    Rows,
    blocks_of,
    moved,
    step_of,
)
from jrigid.identify._unknowns import Unknowns

# At most, of one call: a stage that is cut in two may end elsewhere in a bent valley
STEPS = 400
FIRST_DAMPING = 1e-3
_LEAST_DAMPING = 1e-12
_STUCK = 1e8
_BEND = 4.0  # where Cauchy's loss bends, in units of the noise, squared, of each number


class Settings(NamedTuple):
    """What one minimisation is asked for.

    Attributes:
        kept: 1 for each sample that takes part, 0 for one that does not (trials,
            samples).
        scales: Size of each record's residuals, in units of the noise.
        disturbance: The unmodelled torque, where there is one.
        weight: Of the links, in units of the noise, where there is none.
        horizon: Fraction of the record that takes part.
        soft: Whether the loss is Cauchy's.
        enough: A gain in the sum of squares that is not worth a step.
        steps: The largest number of steps.
        damping: Of the first step.
    """

    kept: Any
    scales: Any
    disturbance: Disturbance
    weight: Any
    horizon: Any
    soft: Any
    enough: Any
    steps: Any
    damping: Any


class Minimum(NamedTuple):
    """Where a minimisation ended.

    Attributes:
        point: Numbers and states.
        rows: Residuals there and their derivatives.
        links: Gaps between segments and their derivatives, without the unmodelled
            torque.
        weight: Of each row (trials, rows).
        kicks: Sum of squares of the whitened gaps.
        square: Sum of squares of the rows, or what stands for it under Cauchy's loss.
        settled: Whether no step was worth taking any more.
        steps: How many were taken.
        history: `square` after each of them, NaN beyond the last.
        damping: Of the next step.
        tensor: The inertia.
        units: Natural units of the numbers.
    """

    point: Point
    rows: Rows
    links: Links
    weight: Any
    kicks: Any
    square: Any
    settled: Any
    steps: Any
    history: Any
    damping: Any
    tensor: Any
    units: Any


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
    """Weights of rows (trials, n), and their sum of squares, or what stands for it."""
    square = jnp.sum(rows.residual**2, axis=-1)
    count = settings.kept.shape[1]
    kept = jnp.where(layout.since <= settings.horizon, settings.kept, 0.0)
    # Rows of prior knowledge follow those of samples; last come the rows that hold a
    # fit near its start, which count while only a part of the record takes part.
    known = jnp.ones_like(square[:, count:])
    early = jnp.where(settings.horizon < 1, 1.0, 0.0)
    known = known.at[:, known.shape[1] - problem.held :].set(early)
    weight = jnp.concatenate([kept, known], axis=1)
    if not problem.options.robust:
        return weight, jnp.sum(weight * square)
    width = jnp.sum(problem.samples.weight, axis=-1)
    size = of_samples(problem, settings.scales**2)[None]
    bend = jnp.maximum(_BEND * width * size, 1e-30)
    bend = jnp.pad(bend, ((0, 0), (0, known.shape[1])), constant_values=jnp.inf)
    soft = settings.soft & jnp.isfinite(bend)
    bend = jnp.where(soft, bend, 1.0)
    loss = jnp.where(soft, bend * jnp.log1p(square / bend), square)
    total = jnp.sum(jnp.where(weight > 0, loss, 0.0))
    return jnp.where(soft, weight / (1 + square / bend), weight), total


def push_over(
    problem: Problem, layout: Layout, numbers: Array, settings: Settings
) -> Push:
    """What may come between the end of a segment and the start of the next."""
    if problem.options.dense:
        tensor, span = problem.unknowns.inertia(numbers), layout.end - layout.start
        depends_on_attitude = problem.options.depends_on_attitude
        return push_of(
            settings.disturbance, span, layout.linked, tensor, depends_on_attitude
        )
    local = 6 if problem.options.depends_on_attitude else 3
    linked = layout.linked.astype(numbers.dtype)
    size = jnp.diag(settings.weight / problem.noise[:local])
    whitener = product("ts,ij->tsij", linked, size)
    nothing = jnp.zeros_like(whitener)
    return Push(covariance=nothing, whitener=whitener, carried=nothing)


class _Place(NamedTuple):
    """A point, and what is known of it."""

    point: Point
    rows: Rows
    links: Links
    weight: Array
    kicks: Array
    square: Array
    cost: Array


class _Loop(NamedTuple):
    """Where the loop stands: the best place so far and the step to try from it."""

    best: _Place
    move: tuple[Array, Array, Array]
    gain: Array
    damping: Array
    growth: Array
    going: Array
    settled: Array
    steps: Array
    history: Array


def _chosen(which: Array, new: Any, old: Any) -> Any:
    """Leaves of `new` in the lanes where `which` is true, of `old` elsewhere."""

    def choose(a: Array, b: Array) -> Array:
        return jnp.where(which.reshape(which.shape + (1,) * (a.ndim - 1)), a, b)

    return jtu.tree_map(choose, new, old)


def _next_damping(loop: _Loop, better: Array, cost: Array) -> tuple[Array, Array]:
    """The damping after a trial, and by how much it grows if the next trial fails.

    Nielsen's rule: ease it by how well the gain was foretold, and raise it ever faster
    while steps fail. The first evaluation has nothing to be compared with.
    """
    first = jnp.isinf(loop.best.cost)
    gain = jnp.where(first | ~(loop.gain > 0), 1.0, loop.gain)
    foretold = jnp.where(first, 0.5, (loop.best.cost - cost) / gain)
    ease = jnp.clip(1 - (2 * foretold - 1) ** 3, 0.1, 2.0)
    damping = loop.damping * jnp.where(better, ease, loop.growth)
    growth = jnp.where(better, 2.0, 2 * loop.growth)
    return jnp.maximum(damping, _LEAST_DAMPING), growth


def _start(problem: Problem, point: Point, settings: Settings) -> _Loop:
    """The loop of one lane before its first evaluation: nothing is known of the point."""
    dtype = point.omega.dtype
    local = 6 if problem.options.depends_on_attitude else 3
    still = jnp.zeros((*point.omega.shape[:-1], local), dtype)
    move = jnp.concatenate([still, jnp.zeros_like(point.torque)], axis=-1)
    border = point.own.shape[-1] + point.numbers.shape[-1]
    trials, samples, width = problem.samples.weight.shape
    # Shapes as `evaluation` returns them.
    residual = jnp.zeros((trials, samples + problem.known, width), dtype)
    rows = Rows(
        residual=residual,
        of_border=jnp.zeros((*residual.shape, border), dtype),
        of_state=jnp.zeros((*residual.shape, local), dtype),
        node=jnp.zeros(residual.shape[:-1], int),
    )
    links = Links(
        gap=still,
        of_border=jnp.zeros((*still.shape, border), dtype),
        of_state=jnp.zeros((*still.shape, local), dtype),
        torque=still[:, 0, :0],
    )
    one = jnp.ones((), dtype)
    best = _Place(
        point=point,
        rows=rows,
        links=links,
        weight=jnp.zeros(residual.shape[:-1], dtype),
        kicks=0 * one,
        square=jnp.inf * one,
        cost=jnp.inf * one,
    )
    return _Loop(
        best=best,
        move=(jnp.zeros_like(point.numbers), jnp.zeros_like(point.own), move),
        gain=one,
        damping=settings.damping,
        growth=2 * one,
        going=settings.steps > 0,
        settled=jnp.asarray(False),
        steps=jnp.asarray(0),
        history=jnp.full(STEPS, jnp.nan, dtype),
    )


def _of_one_lane(function: Callable[..., Any]) -> Callable[..., Any]:
    """`jax.vmap` of a single lane, which takes less time to trace."""

    def call(*arguments: Any) -> Any:
        found = function(*jtu.tree_map(lambda x: x[0], arguments))
        return jtu.tree_map(lambda x: x[None], found)

    return call


@program
def minimise(
    problem: Problem, layout: Layout, point: Point, settings: Settings
) -> Minimum:
    """Minimise sums of squares by Levenberg-Marquardt; all arguments have lanes in front.

    Args:
        problem: The records.
        layout: Their segments.
        point: Where to start.
        settings: What is asked for.

    Source: J. J. More (1978); H. B. Nielsen, "Damping parameter in Marquardt's method"
        (1999).
    """
    over_lanes = jax.vmap if settings.steps.shape[0] > 1 else _of_one_lane
    evaluate = over_lanes(
        lambda problem, layout, point: evaluation(problem, layout)(point)
    )
    push = over_lanes(push_over)(problem, layout, point.numbers, settings)
    own = point.own.shape[-1]

    def whole(
        rows: Rows, links: Links, push: Push, torque: Array
    ) -> tuple[Rows, Links]:
        """Rows and links of states that hold the torque, if there is one."""
        return (
            with_torque(rows, links, push, torque)
            if torque.shape[-1]
            else (rows, links)
        )

    def kicks_of(rows: Rows, links: Links, push: Push, torque: Array) -> Array:
        links = whole(rows, links, push, torque)[1]
        gap = product("tsij,tsj->tsi", push.whitener, links.gap)
        return jnp.sum(gap * gap) + jnp.sum(links.torque**2)

    def next_step(place: _Place, push: Push, damping: Array) -> Any:
        rows, links = whole(place.rows, place.links, push, place.point.torque)
        return step_of(
            blocks_of(rows, links, place.weight, push.whitener), own, damping
        )

    def worth(cost: Array) -> Array:
        """The gain below which a step is not worth taking."""
        if problem.options.noise_known:
            return settings.enough
        counted = settings.kept[..., None] * problem.samples.weight
        count = jnp.maximum(jnp.sum(counted, axis=(1, 2, 3)), 1.0)
        return settings.enough * cost / count

    def body(loop: _Loop) -> _Loop:
        point = over_lanes(moved)(loop.best.point, loop.move)
        rows, links = evaluate(problem, layout, point)
        weight, square = over_lanes(weights)(problem, layout, settings, rows)
        kicks = over_lanes(kicks_of)(rows, links, push, point.torque)
        cost = square + kicks
        finite = jnp.isfinite(cost) & jnp.all(
            jnp.isfinite(rows.of_border), axis=(1, 2, 3, 4)
        )
        better = loop.going & finite & (cost <= loop.best.cost)
        trial = _Place(point, rows, links, weight, kicks, square, cost)
        best: _Place = _chosen(better, trial, loop.best)
        damping, growth = _next_damping(loop, better, cost)
        move, gain = over_lanes(next_step)(best, push, damping)
        gain_worth = worth(best.cost)
        settled = (gain <= gain_worth) & (damping <= 1e-2)
        settled = settled | (damping > _STUCK) | ~(gain > 1e-6 * gain_worth)
        place = jnp.where(loop.going, loop.steps, STEPS)
        note = over_lanes(lambda notes, i, y: notes.at[i].set(y, mode="drop"))
        history = note(loop.history, place, square)
        steps = loop.steps + loop.going.astype(loop.steps.dtype)
        going = loop.going & ~settled & (steps < settings.steps)
        settled = jnp.where(loop.going, settled, loop.settled)
        return _Loop(best, move, gain, damping, growth, going, settled, steps, history)

    start = over_lanes(_start)(problem, point, settings)
    end = jax.lax.while_loop(lambda loop: jnp.any(loop.going), body, start)
    numbers = end.best.point.numbers
    return Minimum(
        point=end.best.point,
        rows=end.best.rows,
        links=end.best.links,
        weight=end.best.weight,
        kicks=end.best.kicks,
        square=end.best.square,
        settled=end.settled & jnp.isfinite(end.best.cost),
        steps=end.steps,
        history=end.history,
        damping=end.damping,
        tensor=over_lanes(lambda x, y: x.unknowns.inertia(y))(problem, numbers),
        units=over_lanes(lambda x, y: x.unknowns.natural_units(y))(problem, numbers),
    )


@small_program
def tensors_at(unknowns: Unknowns, numbers: Any) -> Any:
    """Inertia tensors of several vectors of numbers (several, numbers)."""
    return jax.vmap(unknowns.inertia)(numbers)


@small_program
def spectrum(unknowns: Unknowns, numbers: Any) -> Any:
    """The tensor, its moments and axes, and its derivatives in the numbers (3, 3, numbers)."""
    tensor = unknowns.inertia(numbers)
    return tensor, *eigh(tensor), jax.jacfwd(unknowns.inertia)(numbers)
