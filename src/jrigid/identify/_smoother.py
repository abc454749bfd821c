"""Least squares over chains of states with links: Levenberg-Marquardt and a smoother.

A wobble of n turns fixes its rate so well that the sum of squares over the whole record
has a valley only 0.3 / n wide. Multiple shooting gives each segment a state of its own.
Links ask, more and more strongly, that the end of each segment be the start of the
next. Links of finite weight are a statement about physics: an unknown torque acted
between the nodes. The minimum is then that of the smoother of Rauch, Tung and Striebel
with unknown parameters.

The normal equations are block-tridiagonal with a border (Bock 1983; Nocedal & Wright,
Numerical Optimization, 2nd ed., section 10.3, for the damping), so that a step costs a
time proportional to the length of the record. The border of a trial holds its own
numbers first, then those of all trials.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._numerics import or_one, product
from jrigid._types import AnyArray
from jrigid.rotation import exp, multiply, normalize


class Point(NamedTuple):
    """Values of all unknowns.

    Attributes:
        numbers: Numbers of all trials.
        own: Numbers of each trial (trials, n).
        attitude: Attitude at each node (trials, nodes, 4).
        omega: Rates at each node (trials, nodes, 3).
        torque: Unmodelled torque at each node in units of its rms (trials, nodes, 3),
            or (trials, nodes, 0) without one.
    """

    numbers: AnyArray
    own: AnyArray
    attitude: AnyArray
    omega: AnyArray
    torque: AnyArray


class Move(NamedTuple):
    """Change of a point.

    Attributes:
        numbers: Of the numbers of all trials.
        own: Of the numbers of each trial (trials, n).
        states: Of the states (trials, nodes, local): rates, then turns about the body
            axes if the state has an attitude, then the unmodelled torque if it has one.
    """

    numbers: AnyArray
    own: AnyArray
    states: AnyArray


class Rows(NamedTuple):
    """Whitened residuals and their derivatives.

    Attributes:
        residual: (trials, n, D).
        of_border: Derivatives in the border (trials, n, D, border).
        of_state: Derivatives in the state at the row's node (trials, n, D, local).
        node: Index of that node (trials, n).
    """

    residual: AnyArray
    of_border: AnyArray
    of_state: AnyArray
    node: AnyArray


class Links(NamedTuple):
    """Gaps between segments and their derivatives.

    Attributes:
        gap: End of a segment less the start of the next (trials, nodes, local).
        of_border: Derivatives in the border (trials, nodes, local, border).
        of_state: Derivatives in the state at the segment's start (trials, nodes, local,
            local).
        torque: Unmodelled torque at the first node (trials, 3). Its size is known: it
            is 1 in units of its rms. Without such a torque it is (trials, 0).
    """

    gap: AnyArray
    of_border: AnyArray
    of_state: AnyArray
    torque: AnyArray


class NormalEquations(NamedTuple):
    """Matrix J^T W J and right side J^T W r of least squares, in blocks of each trial.

    Attributes:
        state: Of each state (trials, nodes, local, local).
        coupling: Of each state with the next (trials, nodes, local, local).
        side: Of each state with the border (trials, nodes, local, border).
        border: Of the border (trials, border, border).
        state_right: Right side of each state (trials, nodes, local).
        border_right: Right side of the border (trials, border).
    """

    state: Array
    coupling: Array
    side: Array
    border: Array
    state_right: Array
    border_right: Array


class _StateBlocks(NamedTuple):
    """Blocks of one state, or what eliminating the next state takes from them."""

    state: Array
    side: Array
    right: Array


class FirstStates(NamedTuple):
    """Equations of the first states, the trials' own numbers and the numbers.

    Attributes:
        matrix: (trials, local + border, local + border).
        right: (trials, local + border).
        solved: How each later state depends on the one before, on the border, and its
            constant part (trials, nodes - 1, local, local + border + 1).
        log_determinant: Of the matrix of the eliminated states.
    """

    matrix: Array
    right: Array
    solved: Array
    log_determinant: Array


class SharedNumbers(NamedTuple):
    """Equations of the numbers of all trials, and how the rest depends on them.

    Attributes:
        matrix: (numbers, numbers), without damping.
        right: What each trial adds to the right side (trials, numbers).
        slope: How the first state and the own numbers of a trial depend on the numbers
            (trials, local + own, numbers).
        constant: Their constant part (trials, local + own).
        log_determinant: Of the matrix of all that was eliminated.
    """

    matrix: Array
    right: Array
    slope: Array
    constant: Array
    log_determinant: Array


def _sums_over_rows(nodes: int, rows: Rows, weight: Array) -> tuple[Array, ...]:
    """Blocks of one trial's normal equations from its rows, without those of links."""
    residual, of_border, of_state, node = rows

    def at_nodes(of_rows: Array) -> Array:
        return jax.ops.segment_sum(of_rows, node, nodes)

    # Samples of one node are added; those of different nodes have no product.
    # The weight is that of the square, so that one of the two factors has it.
    state = product("n,ndi->ndi", weight, of_state)
    border = product("n,ndi->ndi", weight, of_border)
    return (
        at_nodes(product("ndi,ndj->nij", state, of_state)),
        at_nodes(product("ndi,ndj->nij", state, of_border)),
        product("ndi,ndj->ij", border, of_border),
        at_nodes(product("ndi,nd->ni", state, residual)),
        product("ndi,nd->i", border, residual),
    )


def _from_link_before(blocks: Array) -> Array:
    """Blocks of links (trials, nodes, ...), each moved to the node at which it ends."""
    return jnp.concatenate([jnp.zeros_like(blocks[:, :1]), blocks[:, :-1]], axis=1)


def normal_equations(
    rows: Rows, links: Links, weight: Array, whitener: Array
) -> NormalEquations:
    """Normal equations of weighted rows and whitened links.

    Args:
        rows: Rows of the record.
        links: Links between its segments.
        weight: Weight of each row (trials, n).
        whitener: Matrix that whitens the gap of each link (trials, nodes, local,
            local), zero where there is no link.
    """
    nodes = links.gap.shape[1]
    sums = jax.vmap(partial(_sums_over_rows, nodes))(rows, weight)
    state, side, border, state_right, border_right = sums
    gap = product("tsij,tsj->tsi", whitener, links.gap)
    of_border = product("tsij,tsjk->tsik", whitener, links.of_border)
    of_state = product("tsij,tsjk->tsik", whitener, links.of_state)
    # The derivative of a whitened gap in the next state is minus the whitener.
    state = (
        state
        + product("tsai,tsaj->tsij", of_state, of_state)
        + _from_link_before(product("tsai,tsaj->tsij", whitener, whitener))
    )
    side = (
        side
        + product("tsai,tsaj->tsij", of_state, of_border)
        - _from_link_before(product("tsai,tsaj->tsij", whitener, of_border))
    )
    border = border + product("tsai,tsaj->tij", of_border, of_border)
    state_right = (
        state_right
        + product("tsai,tsa->tsi", of_state, gap)
        - _from_link_before(product("tsai,tsa->tsi", whitener, gap))
    )
    border_right = border_right + product("tsai,tsa->ti", of_border, gap)
    torques = links.torque.shape[-1]
    if torques:
        # The torque at the first node has the variance 1 beforehand.
        last = slice(-torques, None)
        state = state.at[:, 0, last, last].add(jnp.eye(torques, dtype=state.dtype))
        state_right = state_right.at[:, 0, last].add(links.torque)
    coupling = -product("tsai,tsaj->tsij", of_state, whitener)
    return NormalEquations(state, coupling, side, border, state_right, border_right)


def _damped(matrix: Array, damping: Array) -> Array:
    """Matrices with a part of their diagonals added, and 1 where these are zero."""
    # Marquardt's scaling makes the damping independent of units. A zero belongs to a
    # state without samples, which stays where it is.
    diagonal = jnp.diagonal(matrix, axis1=-2, axis2=-1)
    more = jnp.where(diagonal > 0, damping * diagonal, 1.0)
    eye = jnp.broadcast_to(jnp.eye(matrix.shape[-1], dtype=matrix.dtype), matrix.shape)
    return matrix + more[..., None] * eye


def solve_positive(matrix: Array, columns: Array) -> tuple[Array, Array]:
    """Solve linear equations whose matrix is positive definite except for rounding.

    Args:
        matrix: Matrix (n, n), whose rows may have any scale.
        columns: Right sides (n, k).

    Returns:
        Solutions (n, k), and the logarithm of the determinant.
    """
    # Unit diagonal, since rates, turns and numbers have different units.
    # A trial that was left out has zeros, where the root has no derivative.
    size = jnp.sqrt(or_one(jnp.diagonal(matrix)))
    scaled = matrix / size[:, None] / size[None, :]
    eye = jnp.eye(size.size, dtype=size.dtype)
    # Rounding must not make a nearly singular matrix indefinite.
    lower = jnp.linalg.cholesky(scaled + 4 * jnp.finfo(size.dtype).eps * eye)
    solved = jax.scipy.linalg.cho_solve((lower, True), columns / size[:, None])
    return solved / size[:, None], 2 * jnp.sum(jnp.log(size * jnp.diagonal(lower)))


def _eliminate_state(
    after: _StateBlocks, node: tuple[_StateBlocks, Array]
) -> tuple[_StateBlocks, tuple[Array, Array, Array]]:
    """Eliminate one state.

    Args:
        after: What the elimination of the next state takes from this one's blocks.
        node: Blocks of this state, and of the one before with this one.

    Returns:
        What is taken from the blocks of the state before; and the solution, what is
        taken from the border with its right side, and the logarithm of the determinant.
    """
    blocks, coupling = node
    local = blocks.right.size
    side = blocks.side - after.side
    right = (blocks.right - after.right)[:, None]
    columns = jnp.concatenate([coupling.T, side, right], axis=1)
    # The coupling with the state before is one more block of columns: how the solution
    # depends on that state.
    solved, log_determinant = solve_positive(blocks.state - after.state, columns)
    before = product("ji,jk->ik", columns[:, :local], solved)
    border = product("ij,ik->jk", columns[:, local:-1], solved[:, local:])
    taken = _StateBlocks(before[:, :local], before[:, local:-1], before[:, -1])
    return taken, (solved, border, log_determinant)


def _eliminate_later_states(equations: NormalEquations) -> tuple[Array, ...]:
    """Fields of `FirstStates` for one trial."""
    states = _StateBlocks(equations.state, equations.side, equations.state_right)
    # The first state stays, since the trial's own numbers are eliminated with it.
    first = _StateBlocks(*(x[0] for x in states))
    later = _StateBlocks(*(x[1:] for x in states)), equations.coupling[:-1]
    nothing = _StateBlocks(*map(jnp.zeros_like, first))
    taken, (solved, border, log_determinants) = jax.lax.scan(
        _eliminate_state, nothing, later, reverse=True
    )
    border = jnp.sum(border, axis=0)
    side = first.side - taken.side
    matrix = jnp.block(
        [
            [first.state - taken.state, side],
            [side.T, equations.border - border[:, :-1]],
        ]
    )
    right = [first.right - taken.right, equations.border_right - border[:, -1]]
    return matrix, jnp.concatenate(right), solved, jnp.sum(log_determinants)


def first_states(equations: NormalEquations) -> FirstStates:
    """Eliminate all states but the first of each trial, from the last one on."""
    results = jax.vmap(_eliminate_later_states)(equations)
    matrix, right, solved, log_determinants = results
    return FirstStates(matrix, right, solved, jnp.sum(log_determinants))


def _eliminate_own(count: int, matrix: Array, right: Array) -> tuple[Array, ...]:
    """Fields of `SharedNumbers` for one trial, without its first `count` unknowns."""
    columns = jnp.concatenate([matrix[:count, count:], right[:count, None]], axis=1)
    solved, log_determinant = solve_positive(matrix[:count, :count], columns)
    schur = product("ij,ik->jk", matrix[:count, count:], solved)
    return (
        matrix[count:, count:] - schur[:, :-1],
        right[count:] - schur[:, -1],
        solved[:, :-1],
        solved[:, -1],
        log_determinant,
    )


def shared_numbers(first: FirstStates, count: int) -> SharedNumbers:
    """Eliminate the first states and the trials' own numbers, `count` of each trial."""
    results = jax.vmap(partial(_eliminate_own, count))(first.matrix, first.right)
    matrix, right, slope, constant, log_determinants = results
    log_determinant = jnp.sum(log_determinants) + first.log_determinant
    return SharedNumbers(
        jnp.sum(matrix, axis=0), right, slope, constant, log_determinant
    )


def _moves_of_states(solved: Array, first: Array, border: Array) -> Array:
    """Moves of a trial's states, from that of the first state and of the border."""
    local = first.size

    # Back substitution, from the first state on.
    def forward(before: Array, node: Array) -> tuple[Array, Array]:
        move = -node[:, -1] - product("ij,j->i", node[:, :local], before)
        move = move - product("ij,j->i", node[:, local:-1], border)
        return move, move

    later = jax.lax.scan(forward, first, solved)[1]
    return jnp.concatenate([first[None], later])


def step_of(equations: NormalEquations, own: int, damping: Array) -> tuple[Move, Array]:
    """Solve the damped normal equations.

    Args:
        equations: The equations, without damping.
        own: How many numbers of its own a trial has.
        damping: Part of the diagonals that is added to them.

    Returns:
        The step, and minus its product with the gradient.
    """
    local = equations.state.shape[-1]
    damped = equations._replace(
        state=_damped(equations.state, damping),
        border=_damped(equations.border, damping),
    )
    first = first_states(damped)
    shared = shared_numbers(first, local + own)
    right = jnp.sum(shared.right, axis=0)
    # There may be no numbers for all trials.
    numbers = -right
    if right.size:
        numbers = -solve_positive(shared.matrix, right[:, None])[0][:, 0]
    firsts = -shared.constant - product("tij,j->ti", shared.slope, numbers)

    def states_of_trial(solved: Array, first: Array) -> Array:
        border = jnp.concatenate([first[local:], numbers])
        return _moves_of_states(solved, first[:local], border)

    states = jax.vmap(states_of_trial)(first.solved, firsts)
    owns = firsts[:, local:]
    of_own = equations.border_right[:, :own]
    of_numbers = jnp.sum(equations.border_right[:, own:], axis=0)
    # With the damped part, which is not counted, the linear model gains more.
    gain = -jnp.sum(equations.state_right * states) - jnp.sum(of_own * owns)
    gain = gain - jnp.sum(of_numbers * numbers)
    return Move(numbers, owns, states), gain


def moved(point: Point, move: Move, numbers: Array) -> Point:
    """Return a point after a move, which has led to these numbers of all trials."""
    states = move.states
    attitude = point.attitude
    # States without an attitude have three numbers beside the torque.
    local = states.shape[-1] - point.torque.shape[-1]
    if local == 6:
        # Turns about body axes multiply from the right.
        turn = jax.vmap(jax.vmap(lambda q, v: normalize(multiply(q, exp(v)))))
        attitude = turn(attitude, states[..., 3:6])
    return Point(
        numbers=numbers,
        own=point.own + move.own,
        attitude=attitude,
        omega=point.omega + states[..., :3],
        torque=point.torque + states[..., local:],
    )
