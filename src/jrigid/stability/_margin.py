"""How far a linearisation is from the edge of stability, smooth through it."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._numerics import product, safe_norm
from jrigid._types import Scalar
from jrigid.stability._eigen import eigenvalues, eigenvectors, pairs


def without_symmetries(
    matrix: Array, neutral: Array, conserved: Array, accuracy: Array
) -> tuple[Array, Scalar]:
    """The matrix over a size, what comes with every motion moved from the axis to -1.

    All other eigenvalues, over the size, are within 1/4 of zero. Moved are those of directions that
    the matrix takes to zero, of rows that it does, and, where the torque does not look at the
    attitude, the turn of the body, which all follows. An eigenvalue of a known vector v is moved by
    adding a multiple of v v^T, which leaves the others where they are, for each value of a
    parameter and so for derivatives.
    """
    size = 4 * (1 + jnp.sqrt(jnp.sum(jax.lax.stop_gradient(matrix) ** 2)))
    tiny = accuracy / size
    matrix = matrix / size
    blind = jnp.all(matrix[3:, :3] == 0)
    away = -jnp.eye(3, len(matrix), dtype=matrix.dtype)
    matrix = matrix.at[:3].set(jnp.where(blind, away, matrix[:3]))
    conserved = conserved.at[:, :3].set(jnp.where(blind, 0.0, conserved[:, :3]))

    for vectors, images in (
        (neutral, product("ij,kj->ki", matrix, neutral)),
        (conserved, product("ki,ij->kj", conserved, matrix)),
    ):
        first = _null(vectors[0], images[0], tiny)
        second = _null(vectors[1] - jnp.sum(first * vectors[1]) * first, images[1], tiny)
        matrix = matrix - first[:, None] * first[None, :] - second[:, None] * second[None, :]
    return matrix, size


def _null(vector: Array, image: Array, tiny: Scalar) -> Array:
    """The vector at length 1 if its image is zero, else zero."""
    length = safe_norm(vector)
    zero = (length > tiny) & (safe_norm(image) <= tiny * length)
    return jnp.where(zero, vector / jnp.where(zero, length, 1.0), 0.0)


def margin(matrix: Array, size: Scalar, accuracy: Array) -> Scalar:
    """The margin of a matrix `without_symmetries`, in its units before that.

    Without damping the eigenvalues lie in mirror images about the imaginary axis. Two that meet
    there, at zero or in a collision of Krein's kind, leave it: ((s - s') / 2)^2 of the two goes
    smoothly from minus the square of half their distance to the square of the growth rate. It is a
    double eigenvalue of the square of the matrix less their mean, simple in kind where they meet.
    """
    values = eigenvalues(matrix)
    known = jax.lax.stop_gradient(values)
    tiny = accuracy / size
    free = known.real > -0.5
    mirrored = jnp.abs(known[:, None] + jnp.conj(known)[None, :]) <= tiny
    undamped = jnp.all(~free | jnp.any(mirrored, axis=1))
    damped = -jnp.max(jnp.where(free, values.real, -1.0))
    i, j = _nearest(jax.lax.stop_gradient(matrix), known, free, tiny)
    mean = 0.5 * (values[i] + values[j])
    apart = 0.25 * (known[i] - known[j]) ** 2
    shifted = matrix.astype(mean.dtype) - mean * jnp.eye(len(matrix), dtype=mean.dtype)
    squares = eigenvalues(product("ij,jk->ik", shifted, shifted))
    place = jnp.argmin(jnp.abs(jax.lax.stop_gradient(squares) - apart))
    return jnp.where(undamped, -squares[place].real * size * size, damped * size)


def _nearest(matrix: Array, values: Array, free: Array, tiny: Array) -> tuple[Array, Array]:
    """The two eigenvalues of an undamped motion that are nearest to growth, or grow most.

    Two of one rate that have directions of their own do not count, nor does one with a zero that
    stays where it is.
    """
    gaps, alike = pairs(values, eigenvectors(matrix, values))
    zero = jnp.abs(values) <= tiny
    counts = jnp.isfinite(gaps) & free[:, None] & free[None, :] & (zero[:, None] == zero[None, :])
    counts = counts & ((gaps > tiny) | alike)
    squares = (0.25 * (values[:, None] - values[None, :]) ** 2).real
    best = jnp.argmax(jnp.where(counts, squares, -jnp.inf))
    return best // values.size, best % values.size
