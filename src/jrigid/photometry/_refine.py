"""Levenberg-Marquardt for many starting points at once."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jrigid._numerics import product
from jrigid._types import AnyArray
from jrigid.photometry._model import Task, rows_of, sought
from jrigid.photometry._readings import Readings

_FIRST_DAMPING = 1e-2
_LEAST_DAMPING = 1e-9
# Above this much damping no step helps.
_STUCK = 1e8
_FALL = 0.2  # of the damping after a step that helps
_RISE = 4.0  # after one that does not
# A lane has converged where a nearly undamped step gains less of chi-square than this.
_ENOUGH = 1e-4
_UNDAMPED = 1e-2
# Least diagonal of the normal equations: a number of no effect stays where it is.
_FLOOR = 1e-12


class Quadratic(NamedTuple):
    """Chi-square about a point: its value, half its slope and its normal matrix."""

    chi_square: Float[AnyArray, "*lanes"]
    slope: Float[AnyArray, "*lanes numbers"]
    normal: Float[AnyArray, "*lanes numbers numbers"]


class _Loop(NamedTuple):
    """The best points so far and what comes next."""

    numbers: Float[Array, "lanes 11"]
    at: Quadratic
    damping: Float[Array, " lanes"]
    going: Bool[Array, " lanes"]
    steps: Int[Array, ""]


def quadratic(vector: Float[Array, "11"], task: Task, readings: Readings) -> Quadratic:
    """Chi-square of one lane and its derivatives in the numbers that it seeks."""
    rows, slopes = rows_of(vector, task, readings)
    slopes = jnp.where(sought(task), slopes, 0.0)
    return Quadratic(
        chi_square=product("r,r->", rows, rows),
        slope=product("rn,r->n", slopes, rows),
        normal=product("rn,rm->nm", slopes, slopes),
    )


@jax.jit
def refined(
    numbers: Float[Array, "lanes 11"],
    tasks: Task,
    readings: Readings,
    steps: Int[ArrayLike, ""],
) -> tuple[Float[Array, "lanes 11"], Quadratic]:
    """Minimise chi-square in each lane.

    Args:
        numbers: Starting points.
        tasks: One for each lane.
        readings: The light curves, the same for all.
        steps: The largest number of steps; one program serves all.

    Source: J. J. More, Lecture Notes in Mathematics 630 (1978) 105.
    """
    evaluate = jax.vmap(quadratic, (0, 0, None))
    start = evaluate(numbers, tasks, readings)
    loop = _Loop(
        numbers=numbers,
        at=start,
        damping=jnp.full(len(numbers), _FIRST_DAMPING, numbers.dtype),
        going=jnp.isfinite(start.chi_square),
        steps=jnp.asarray(0),
    )
    found = jax.lax.while_loop(
        lambda loop: jnp.any(loop.going) & (loop.steps < steps),
        lambda loop: _iteration(loop, lambda x: evaluate(x, tasks, readings)),
        loop,
    )
    return found.numbers, found.at


def _iteration(loop: _Loop, evaluate: Callable[[Array], Quadratic]) -> _Loop:
    """Try a damped step in all lanes, and keep the better points."""
    moves = jax.vmap(damped_step)(loop.at, loop.damping)
    numbers = loop.numbers + moves
    new = evaluate(numbers)
    # Chi-square may be finite where its derivatives are not, and the next step needs
    # both.
    finite = jnp.isfinite(new.chi_square) & jnp.all(
        jnp.isfinite(new.normal), axis=(1, 2)
    )
    gain = loop.at.chi_square - new.chi_square
    # A gain of 0 counts: else a lane at its minimum would go on until it is stuck.
    better = loop.going & finite & (gain >= 0)
    factor = jnp.where(better, _FALL, _RISE)
    damping = jnp.maximum(loop.damping * factor, _LEAST_DAMPING)
    converged = better & (gain < _ENOUGH) & (loop.damping <= _UNDAMPED)

    def chosen(a: Array, b: Array) -> Array:
        return jnp.where(better.reshape((-1,) + (1,) * (a.ndim - 1)), a, b)

    return _Loop(
        numbers=chosen(numbers, loop.numbers),
        at=jax.tree.map(chosen, new, loop.at),
        damping=damping,
        going=loop.going & ~converged & (damping < _STUCK),
        steps=loop.steps + 1,
    )


def damped_step(at: Quadratic, damping: Float[Array, ""]) -> Float[Array, " numbers"]:
    """The step of Levenberg and Marquardt, with More's scaling by the diagonal."""
    diagonal = jnp.maximum(jnp.diagonal(at.normal), _FLOOR)
    # In units in which the diagonal is 1 the equations are well scaled.
    scale = 1 / jnp.sqrt(diagonal)
    normal = at.normal * scale[None] * scale[:, None]
    # The row of a number of no effect is zero, and 1 on its diagonal keeps the matrix
    # well conditioned.
    normal = normal + jnp.diag(damping + jnp.where(diagonal > _FLOOR, 0.0, 1.0))
    return -scale * jnp.linalg.solve(normal, scale * at.slope)
