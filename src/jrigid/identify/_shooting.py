"""Levenberg-Marquardt for motions cut into segments: local states, global numbers, links between.

A wobble of n turns pins its rate so well that the sum of squares over the whole record has a
valley only 0.3 / n wide. Multiple shooting gives each segment of half a turn a start of its own and
asks, more and more strongly, that the end of each be the start of the next. The normal equations
are block-tridiagonal with a border (Bock 1983; Nocedal & Wright, Numerical Optimization, 2nd ed.,
section 10.3, for the damping), so that a step costs a time proportional to the record; the last
phase has one segment in each throw and no links: it is the plain least-squares problem.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._numerics import product
from jrigid.rotation import exp, multiply, normalize

_FIRST_DAMPING = 1e-3
_LEAST_DAMPING = 1e-12
_STUCK = 1e8
ACCURACY = 1e-6  # of the sum of squares a step would gain: a thousandth of the standard errors


class Point(NamedTuple):
    """Where a fit stands: global numbers, and the state at each node (throws, nodes)."""

    numbers: Array
    attitude: Array
    omega: Array


class Rows(NamedTuple):
    """Residuals and derivatives: (throws, rows), in numbers and in the state of the row's node."""

    residual: Array
    of_numbers: Array
    of_state: Array
    node: Array
    cost: Array


class Links(NamedTuple):
    """End of a segment less the next one's start, (throws, nodes, local), and derivatives."""

    gap: Array
    of_numbers: Array
    of_state: Array
    of_next: Array


class Stage(NamedTuple):
    """Weight of the links, how much of each record takes part, and the loss."""

    weight: Array
    horizon: Array
    robust: Array
    steps: Array


def _sums(rows: Rows, nodes: int) -> tuple[Array, ...]:
    """Blocks of the normal equations that come from the record."""

    def throw(r: Array, jg: Array, jl: Array, node: Array) -> tuple[Array, ...]:
        def at_nodes(x: Array) -> Array:
            return jax.ops.segment_sum(x, node, nodes)

        return (
            at_nodes(jl[:, :, None] * jl[:, None, :]),
            at_nodes(jl[:, :, None] * jg[:, None, :]),
            product("ri,rj->ij", jg, jg),
            at_nodes(jl * r[:, None]),
            product("ri,r->i", jg, r),
        )

    h, hg, gg, b, bg = jax.vmap(throw)(rows.residual, rows.of_numbers, rows.of_state, rows.node)
    return h, hg, jnp.sum(gg, axis=0), b, jnp.sum(bg, axis=0)


def _linked(sums: tuple[Array, ...], links: Links, weight: Array) -> tuple[Array, ...]:
    """The blocks with those of the links, and the coupling of each node with the next."""
    h, hg, gg, b, bg = sums
    square = weight * weight
    c, g, f, n = links

    def later(x: Array) -> Array:
        """What the link before adds to a node."""
        return jnp.concatenate([jnp.zeros_like(x[:, :1]), x[:, :-1]], axis=1)

    h = h + square * (product("tsai,tsaj->tsij", f, f) + later(product("tsai,tsaj->tsij", n, n)))
    hg = hg + square * (product("tsai,tsaj->tsij", f, g) + later(product("tsai,tsaj->tsij", n, g)))
    gg = gg + square * product("tsai,tsaj->ij", g, g)
    b = b + square * (product("tsai,tsa->tsi", f, c) + later(product("tsai,tsa->tsi", n, c)))
    bg = bg + square * product("tsai,tsa->i", g, c)
    return h, square * product("tsai,tsaj->tsij", f, n), hg, gg, b, bg


def _damped(matrix: Array, damping: Array) -> Array:
    diagonal = jnp.diagonal(matrix, axis1=-2, axis2=-1)
    more = jnp.where(diagonal > 0, damping * diagonal, 1.0)
    eye = jnp.broadcast_to(jnp.eye(matrix.shape[-1], dtype=matrix.dtype), matrix.shape)
    return matrix + more[..., None] * eye


def _step(blocks: tuple[Array, ...], damping: Array) -> tuple[Array, Array, Array]:
    """Move of the numbers and of the local states, and what it would gain, -gradient . move."""
    h, u, hg, gg, b, bg = blocks
    h, gg = _damped(h, damping), _damped(gg, damping)
    local, globals_ = h.shape[-1], gg.shape[-1]

    def forward(carry: tuple, node: tuple) -> tuple[tuple, tuple]:
        less, border, right = carry
        h, u, hg, b = node
        columns = jnp.concatenate([u, hg - border, (b - right)[:, None]], axis=1)
        solved = _solve(h - less, columns)
        down = product("ij,ik->jk", u, solved)
        schur = product("ij,ik->jk", columns[:, local:-1], solved[:, local:])
        carry = down[:, :local], down[:, local:-1], down[:, -1]
        return carry, (solved, schur)

    def throw(h: Array, u: Array, hg: Array, b: Array) -> tuple[Array, Array]:
        empty = jnp.zeros_like(h[0]), jnp.zeros_like(hg[0]), jnp.zeros_like(b[0])
        _, (solved, schur) = jax.lax.scan(forward, empty, (h, u, hg, b))
        return solved, jnp.sum(schur, axis=0)

    solved, schur = jax.vmap(throw)(h, u, hg, b)
    schur = jnp.sum(schur, axis=0)
    numbers = -bg
    if globals_:
        numbers = -_solve(gg - schur[:, :-1], (bg - schur[:, -1])[:, None])[:, 0]

    def back(later: Array, node: Array) -> tuple[Array, Array]:
        move = -node[:, -1] - product("ij,j->i", node[:, :local], later)
        move = move - product("ij,j->i", node[:, local:-1], numbers)
        return move, move

    def moves(solved: Array) -> Array:
        return jax.lax.scan(back, jnp.zeros_like(solved[0, :, 0]), solved, reverse=True)[1]

    states = jax.vmap(moves)(solved)
    gain = -jnp.sum(bg * numbers) - jnp.sum(b * states)
    return numbers, states, gain


def _solve(matrix: Array, columns: Array) -> Array:
    """Positive definite, but for rounding, of any scale in each variable."""
    size = jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), 0.0))
    size = jnp.where(size > 0, size, 1.0)
    scaled = matrix / size[:, None] / size[None, :]
    eye = jnp.eye(size.size, dtype=size.dtype)
    lower = jnp.linalg.cholesky(scaled + 4 * jnp.finfo(size.dtype).eps * eye)
    solved = jax.scipy.linalg.cho_solve((lower, True), columns / size[:, None])
    return solved / size[:, None]


def _moved(point: Point, numbers: Array, states: Array) -> Point:
    if states.shape[-1] == 6:
        turn = jax.vmap(jax.vmap(lambda q, v: normalize(multiply(q, exp(v)))))
        attitude = turn(point.attitude, states[..., 3:])
    else:
        attitude = point.attitude
    return Point(point.numbers + numbers, attitude, point.omega + states[..., :3])


class _Carry(NamedTuple):
    point: Point  # the best so far
    rows: Rows
    links: Links
    cost: Array
    move: tuple[Array, Array]
    gain: Array
    damping: Array
    growth: Array
    stage: Array
    since: Array
    fresh: Array
    settled: Array
    steps: Array
    history: Array


def levenberg_marquardt(
    evaluate: Callable[[Point, Any, Any, Stage], tuple[Rows, Links]],
    args: Any,
    start: Point,
    layout: Any,
    stages: Stage,
    accuracy: Callable[[Rows], Array],
    steps: Array,
    history: Array,
    progress: bool = False,
) -> tuple[Point, Rows, Array, Array, Array]:
    """The minimum of the sums of squares of one stage after the other, each from the last's.

    Returns:
        Point, rows there, whether the last stage settled, steps taken so far, and the sum of
        squares of the record after each.
    """
    throws, nodes = start.omega.shape[:2]
    count = jnp.sum(stages.steps > 0)
    shapes = eqx.filter_eval_shape(
        evaluate, start, args, layout, jtu.tree_map(lambda x: x[0], stages)
    )
    rows, links = jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    dtype = start.omega.dtype
    local = links.gap.shape[-1]
    still = jnp.zeros_like(start.numbers), jnp.zeros((throws, nodes, local), dtype)
    carry = _Carry(
        start, rows, links, jnp.asarray(jnp.inf, dtype), still, jnp.zeros((), dtype),
        jnp.asarray(_FIRST_DAMPING, dtype), jnp.asarray(2.0, dtype), jnp.asarray(0),
        jnp.asarray(0), jnp.asarray(True),
        jnp.asarray(False), steps, history,
    )  # fmt: skip

    def body(carry: _Carry) -> _Carry:
        now = jtu.tree_map(lambda x: x[carry.stage], stages)
        trial = _moved(carry.point, *carry.move)
        rows, links = evaluate(trial, args, layout, now)
        cost = rows.cost + jnp.sum((now.weight * links.gap) ** 2)
        finite = jnp.isfinite(cost) & jnp.all(jnp.isfinite(rows.of_numbers))
        better = finite & (cost <= carry.cost)
        taken = carry.fresh | better
        trial_cost = cost
        point, rows, links, cost = jtu.tree_map(
            lambda new, old: jnp.where(taken, new, old),
            (trial, rows, links, cost),
            (carry.point, carry.rows, carry.links, carry.cost),
        )
        # Nielsen's rule: by how well the gain was foretold, and ever faster while it is not.
        told = (carry.cost - trial_cost) / jnp.where(carry.gain > 0, carry.gain, 1.0)
        ease = jnp.clip(1 - (2 * jnp.where(better, told, 0.0) - 1) ** 3, 0.1, 2.0)
        damping = carry.damping * jnp.where(better, ease, carry.growth)
        damping = jnp.where(carry.fresh, _FIRST_DAMPING, damping)
        growth = jnp.where(carry.fresh | better, 2.0, 2 * carry.growth)
        damping = jnp.maximum(damping, _LEAST_DAMPING)
        blocks = _linked(_sums(rows, nodes), links, now.weight)
        *move, gain = _step(blocks, damping)
        since = carry.since + 1
        # A stage with links only has to start the next one.
        enough = accuracy(rows) * jnp.where(now.weight > 0, 1e4, 1.0)
        small = (gain <= enough) & (damping <= 1e-2)
        settled = small | (damping > _STUCK) | (gain <= 1e-6 * enough)
        over = settled | (since >= now.steps)
        stage = carry.stage + over.astype(int)
        if progress:
            jax.lax.cond(
                over,
                lambda: jax.debug.print(
                    "fit: {} steps, links {}, record {}: chi-square {}",
                    carry.steps + 1, now.weight, jnp.minimum(now.horizon, 1.0), rows.cost,
                ),
                lambda: None,
            )  # fmt: skip
        # A new stage has other weights: its first evaluation is where this one ended.
        move = jtu.tree_map(lambda x: jnp.where(over, 0.0, x), tuple(move))
        return _Carry(
            point, rows, links, cost, move, gain, damping, growth, stage,
            jnp.where(over, 0, since), over,
            settled, carry.steps + 1, carry.history.at[carry.steps].set(rows.cost, mode="drop"),
        )  # fmt: skip

    carry = jax.lax.while_loop(lambda c: c.stage < count, body, carry)
    settled = carry.settled & jnp.isfinite(carry.cost)
    return carry.point, carry.rows, settled, carry.steps, carry.history
