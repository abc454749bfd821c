"""Levenberg-Marquardt for many starting points at once."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from jrigid._numerics import product
from jrigid._types import AnyArray

_FIRST_DAMPING = 1e-2
_LEAST_DAMPING = 1e-9
_STUCK = 1e12  # above this much damping no step helps
# A lane has converged where a nearly undamped step promises less of chi-square.
_ENOUGH = 1e-3
_UNDAMPED = 1e-2
# Least diagonal of the normal equations: a number of no effect stays where it is.
_FLOOR = 1e-12


class Quadratic(NamedTuple):
    """Chi-square about a point: its value, half its slope and its normal matrix."""

    chi_square: Float[AnyArray, "*lanes"]
    slope: Float[AnyArray, "*lanes numbers"]
    normal: Float[AnyArray, "*lanes numbers numbers"]


class _Loop(NamedTuple):
    """The best points so far and what comes next.

    Attributes:
        numbers: The best point of each lane.
        at: Chi-square about it.
        damping: Of the next step.
        rise: Factor of the damping if the next step fails.
        going: Whether the search goes on.
        steps: How many steps were taken; -1 before the start is evaluated.
    """

    numbers: Float[Array, "lanes numbers"]
    at: Quadratic
    damping: Float[Array, " lanes"]
    rise: Float[Array, " lanes"]
    going: Bool[Array, " lanes"]
    steps: Int[Array, ""]


@functools.partial(jax.jit, static_argnames="quadratic")
def minimised(
    quadratic: Callable[..., Quadratic],
    numbers: Float[Array, "lanes numbers"],
    tasks: PyTree,
    shared: tuple[PyTree, ...],
    steps: Int[ArrayLike, ""],
) -> tuple[Float[Array, "lanes numbers"], Quadratic]:
    """Levenberg-Marquardt in all lanes, with the damping of Nielsen.

    A damping that heeds how well a step was predicted takes half of the steps that one
    with fixed factors takes.

    Args:
        quadratic: Chi-square about the numbers of a lane, a function of these numbers,
            of the task of the lane, and of what is shared.
        numbers: Starting points.
        tasks: What `quadratic` takes second, with lanes in front.
        shared: What it takes then, the same for all lanes.
        steps: The largest number of steps; one program serves all.

    Source: K. Madsen, H. B. Nielsen and O. Tingleff, Methods for non-linear least
    squares problems, 2nd ed., 2004, algorithm 3.16.
    """
    each = jax.vmap(lambda x, task: quadratic(x, task, *shared))

    def evaluate(numbers: Array) -> Quadratic:
        return each(numbers, tasks)

    def next_loop(loop: _Loop) -> _Loop:
        return _iteration(loop, evaluate)

    def is_going(loop: _Loop) -> Array:
        return jnp.any(loop.going) & (loop.steps < steps)

    # The loop evaluates the start, too, so that the program holds `quadratic` once. The
    # first step has the slope zero, and leads nowhere.
    lanes, count = numbers.shape
    unknown = Quadratic(
        chi_square=jnp.full(lanes, jnp.inf, numbers.dtype),
        slope=jnp.zeros_like(numbers),
        normal=jnp.zeros((lanes, count, count), numbers.dtype),
    )
    loop = _Loop(
        numbers=numbers,
        at=unknown,
        damping=jnp.full_like(unknown.chi_square, _FIRST_DAMPING),
        rise=jnp.full_like(unknown.chi_square, 2.0),
        going=jnp.full(lanes, True),
        steps=jnp.asarray(-1),
    )
    found = jax.lax.while_loop(is_going, next_loop, loop)
    return found.numbers, found.at


def _iteration(loop: _Loop, evaluate: Callable[[Array], Quadratic]) -> _Loop:
    """Try a damped step in all lanes, and keep the better points."""
    moves = jax.vmap(_damped_step)(loop.at, loop.damping)
    numbers = loop.numbers + moves
    new = evaluate(numbers)
    # A step m changes chi-square of the quadratic model by 2 m.s + m.N m, since the
    # slope s is half its gradient.
    bent = product("ln,lnm,lm->l", moves, loop.at.normal, moves)
    predicted = -2 * product("ln,ln->l", moves, loop.at.slope) - bent
    gain = loop.at.chi_square - new.chi_square
    # Chi-square may be finite where its derivatives are not, and the next step needs
    # both.
    finite = jnp.isfinite(new.chi_square) & jnp.all(
        jnp.isfinite(new.normal), axis=(1, 2)
    )
    better = loop.going & finite & (gain > 0)
    is_first = loop.steps < 0
    # A ratio of one half leaves the damping as it is.
    ratio = jnp.where(is_first, 0.5, jnp.where(better, gain / predicted, 0.0))
    fall = jnp.maximum(1 / 3, 1 - (2 * ratio - 1) ** 3)
    damping = loop.damping * jnp.where(better, fall, loop.rise)
    promising = (predicted > _ENOUGH) | (loop.damping > _UNDAMPED)
    promising = jnp.where(is_first, finite, promising)
    taken = better | is_first

    def chosen(a: Array, b: Array) -> Array:
        return jnp.where(taken.reshape((-1,) + (1,) * (a.ndim - 1)), a, b)

    return _Loop(
        numbers=chosen(numbers, loop.numbers),
        at=jax.tree.map(chosen, new, loop.at),
        damping=jnp.maximum(damping, _LEAST_DAMPING),
        rise=jnp.where(better, 2.0, 2 * loop.rise),
        going=loop.going & promising & (damping < _STUCK),
        steps=loop.steps + 1,
    )


def _damped_step(at: Quadratic, damping: Float[Array, ""]) -> Float[Array, " numbers"]:
    """The step of Levenberg and Marquardt, with More's scaling by the diagonal."""
    diagonal = jnp.maximum(jnp.diagonal(at.normal), _FLOOR)
    # In units in which the diagonal is 1 the equations are well scaled.
    scale = 1 / jnp.sqrt(diagonal)
    normal = at.normal * scale[None] * scale[:, None]
    # The row of a number of no effect is zero, and 1 on its diagonal keeps the matrix
    # well conditioned.
    normal = normal + jnp.diag(damping + jnp.where(diagonal > _FLOOR, 0.0, 1.0))
    return -scale * jnp.linalg.solve(normal, scale * at.slope)
