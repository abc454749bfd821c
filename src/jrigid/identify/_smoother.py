"""Least squares over a chain of states with links between: Levenberg-Marquardt, and a smoother.

A wobble of n turns pins its rate so well that the sum of squares over the whole record
has a valley only 0.3 / n wide. Multiple shooting gives each segment a state of its own
and links that ask, more and more strongly, that the end of each be the start of the
next. Links kept at a finite weight are a statement about physics: an unknown torque
pushed the body between the nodes, and what is minimised is then the smoother of Rauch,
Tung and Striebel with unknown parameters.

The normal equations are block-tridiagonal with a border (Bock 1983; Nocedal & Wright,
Numerical Optimization, 2nd ed., section 10.3, for the damping), so that a step costs a
time proportional to the record. The border of a trial holds its own numbers first, then
those of all trials.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._numerics import product
from jrigid._types import AnyArray
from jrigid.rotation import exp, multiply, normalize


class Point(NamedTuple):
    """Where a fit stands: numbers of all trials, of each, and the state at each node."""

    numbers: AnyArray
    own: AnyArray  # (trials, n)
    attitude: AnyArray  # (trials, nodes, 4)
    omega: AnyArray
    # (trials, nodes, 3) in units of its rms, or (trials, nodes, 0) without one
    torque: AnyArray


class Rows(NamedTuple):
    """Whitened residuals (trials, n, D), and derivatives in the border and the state of a node."""

    residual: AnyArray
    of_border: AnyArray
    of_state: AnyArray
    node: AnyArray


class Links(NamedTuple):
    """End of a segment less the next one's start, (trials, nodes, local), and derivatives.

    `torque` is the unmodelled torque at the first node, (trials, 3), whose size is
    known: it is 1 in units of its rms. Without such a torque it is (trials, 0).
    """

    gap: AnyArray
    of_border: AnyArray
    of_state: AnyArray
    torque: AnyArray


class Blocks(NamedTuple):
    """Normal equations: of the states, of each with the next, of the border, and right sides."""

    state: Array
    next: Array
    side: Array
    border: Array
    of_state: Array
    of_border: Array


class Reduced(NamedTuple):
    """The equations of first states, trials' own numbers and numbers, (trials, l + m + g, ...)."""

    matrix: Array
    right: Array
    solved: Array  # of the later states
    log_determinant: Array  # of what was eliminated


def blocks_of(rows: Rows, links: Links, weight: Array, whitener: Array) -> Blocks:
    """Normal equations of weighted rows and whitened links.

    Args:
        rows: Of the record.
        links: Between the segments; the next state enters with minus one.
        weight: Of each sample (trials, n).
        whitener: Of each link (trials, nodes, local, local), zero where there is none.
    """
    nodes = links.gap.shape[1]

    def trial(rows: Rows, w: Array) -> tuple[Array, ...]:
        r, jb, js, node = rows
        at_nodes = lambda x: jax.ops.segment_sum(x, node, nodes)  # noqa: E731
        ws, wb = (product("n,ndi->ndi", w, x) for x in (js, jb))
        return (
            at_nodes(product("ndi,ndj->nij", ws, js)),
            at_nodes(product("ndi,ndj->nij", ws, jb)),
            product("ndi,ndj->ij", wb, jb),
            at_nodes(product("ndi,nd->ni", ws, r)),
            product("ndi,nd->i", wb, r),
        )

    h, hb, bb, b, cb = jax.vmap(trial)(rows, weight)

    def white(x: Array) -> Array:
        return product("tsij,tsjk->tsik", whitener, x)

    def later(x: Array) -> Array:
        """What the link before adds to a node."""
        return jnp.concatenate([jnp.zeros_like(x[:, :1]), x[:, :-1]], axis=1)

    c, g, f = (
        white(links.gap[..., None])[..., 0],
        white(links.of_border),
        white(links.of_state),
    )
    h = (
        h
        + product("tsai,tsaj->tsij", f, f)
        + later(product("tsai,tsaj->tsij", whitener, whitener))
    )
    hb = (
        hb
        + product("tsai,tsaj->tsij", f, g)
        - later(product("tsai,tsaj->tsij", whitener, g))
    )
    bb = bb + product("tsai,tsaj->tij", g, g)
    b = (
        b
        + product("tsai,tsa->tsi", f, c)
        - later(product("tsai,tsa->tsi", whitener, c))
    )
    cb = cb + product("tsai,tsa->ti", g, c)
    if links.torque.shape[-1]:
        last = slice(-links.torque.shape[-1], None)
        h = h.at[:, 0, last, last].add(jnp.eye(links.torque.shape[-1], dtype=h.dtype))
        b = b.at[:, 0, last].add(links.torque)
    return Blocks(h, -product("tsai,tsaj->tsij", f, whitener), hb, bb, b, cb)


def _damped(matrix: Array, damping: Array) -> Array:
    diagonal = jnp.diagonal(matrix, axis1=-2, axis2=-1)
    more = jnp.where(diagonal > 0, damping * diagonal, 1.0)
    eye = jnp.broadcast_to(jnp.eye(matrix.shape[-1], dtype=matrix.dtype), matrix.shape)
    return matrix + more[..., None] * eye


def solve_positive(matrix: Array, columns: Array) -> tuple[Array, Array]:
    """Of a matrix positive definite but for rounding, of any scale; and its log determinant."""
    size = jnp.sqrt(jnp.maximum(jnp.diagonal(matrix), 0.0))
    size = jnp.where(size > 0, size, 1.0)
    scaled = matrix / size[:, None] / size[None, :]
    eye = jnp.eye(size.size, dtype=size.dtype)
    lower = jnp.linalg.cholesky(scaled + 4 * jnp.finfo(size.dtype).eps * eye)
    solved = jax.scipy.linalg.cho_solve((lower, True), columns / size[:, None])
    return solved / size[:, None], 2 * jnp.sum(jnp.log(size * jnp.diagonal(lower)))


def reduced(blocks: Blocks, damping: Array) -> Reduced:
    """Eliminate all states but the first, from the last one on."""
    h, u, hb, bb, b, cb = blocks
    local, h = h.shape[-1], _damped(h, damping)

    def backward(carry: tuple, node: tuple) -> tuple[tuple, tuple]:
        less, border, right = carry
        h, u, hb, b = node
        columns = jnp.concatenate([u.T, hb - border, (b - right)[:, None]], axis=1)
        solved, log_determinant = solve_positive(h - less, columns)
        down = product("ji,jk->ik", columns[:, :local], solved)
        schur = product("ij,ik->jk", columns[:, local:-1], solved[:, local:])
        carry = down[:, :local], down[:, local:-1], down[:, -1]
        return carry, (solved, schur, log_determinant)

    def trial(
        h: Array, u: Array, hb: Array, bb: Array, b: Array, cb: Array
    ) -> tuple[Array, ...]:
        empty = jnp.zeros_like(h[0]), jnp.zeros_like(hb[0]), jnp.zeros_like(b[0])
        later = h[1:], u[:-1], hb[1:], b[1:]
        (less, border, right), (solved, schur, logs) = jax.lax.scan(
            backward, empty, later, reverse=True
        )
        side, schur = hb[0] - border, jnp.sum(schur, axis=0)
        matrix = jnp.block([[h[0] - less, side], [side.T, bb - schur[:, :-1]]])
        return (
            matrix,
            jnp.concatenate([b[0] - right, cb - schur[:, -1]]),
            solved,
            jnp.sum(logs),
        )

    matrix, right, solved, logs = jax.vmap(trial)(h, u, hb, bb, b, cb)
    return Reduced(matrix, right, solved, jnp.sum(logs))


class Eliminated(NamedTuple):
    """What is left for the numbers, and how a trial's first state and own numbers follow them."""

    numbers: Array  # (g, g), without damping
    right: Array  # (trials, g): what each trial adds to the right side
    follow: Array  # (trials, l + m, g)
    still: Array  # (trials, l + m), where the numbers stay
    log_determinant: Array


def eliminated(left: Reduced, count: int) -> Eliminated:
    """Eliminate the first states and trials' own numbers, `count` of them."""

    def trial(matrix: Array, right: Array) -> tuple[Array, ...]:
        columns = jnp.concatenate([matrix[:count, count:], right[:count, None]], axis=1)
        solved, log_determinant = solve_positive(matrix[:count, :count], columns)
        schur = product("ij,ik->jk", matrix[:count, count:], solved)
        numbers = matrix[count:, count:] - schur[:, :-1]
        return (
            numbers,
            right[count:] - schur[:, -1],
            solved[:, :-1],
            solved[:, -1],
            log_determinant,
        )

    numbers, right, follow, still, logs = jax.vmap(trial)(left.matrix, left.right)
    logs = jnp.sum(logs) + left.log_determinant
    return Eliminated(jnp.sum(numbers, axis=0), right, follow, still, logs)


def step_of(
    blocks: Blocks, own: int, damping: Array
) -> tuple[tuple[Array, Array, Array], Array]:
    """Move of the numbers, the trials' own, and the states; and what it gains, -gradient . move."""
    local = blocks.state.shape[-1]
    damped = blocks._replace(border=_damped(blocks.border, damping))
    left = reduced(damped, damping)
    rest = eliminated(left, local + own)
    right = jnp.sum(rest.right, axis=0)
    numbers = -right
    if right.size:
        numbers = -solve_positive(rest.numbers, right[:, None])[0][:, 0]
    firsts = -rest.still - product("tij,j->ti", rest.follow, numbers)

    def moves(solved: Array, first: Array) -> Array:
        border = jnp.concatenate([first[local:], numbers])

        def forward(before: Array, node: Array) -> tuple[Array, Array]:
            move = -node[:, -1] - product("ij,j->i", node[:, :local], before)
            move = move - product("ij,j->i", node[:, local:-1], border)
            return move, move

        later = jax.lax.scan(forward, first[:local], solved)[1]
        return jnp.concatenate([first[None, :local], later])

    states, owns = jax.vmap(moves)(left.solved, firsts), firsts[:, local:]
    gain = -jnp.sum(blocks.of_state * states) - jnp.sum(
        blocks.of_border[:, :own] * owns
    )
    gain = gain - jnp.sum(jnp.sum(blocks.of_border[:, own:], axis=0) * numbers)
    return (numbers, owns, states), gain


def moved(point: Point, move: tuple[Array, Array, Array]) -> Point:
    """A point after a move; turns are about the body's axes."""
    numbers, own, states = move
    attitude = point.attitude
    local = states.shape[-1] - point.torque.shape[-1]
    if local == 6:
        turn = jax.vmap(jax.vmap(lambda q, v: normalize(multiply(q, exp(v)))))
        attitude = turn(attitude, states[..., 3:6])
    return Point(
        numbers=point.numbers + numbers,
        own=point.own + own,
        attitude=attitude,
        omega=point.omega + states[..., :3],
        torque=point.torque + states[..., local:],
    )
