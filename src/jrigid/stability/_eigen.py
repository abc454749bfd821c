"""Eigenvalues with finite derivatives also where two meet; the stability margin."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Complex, Float, Inexact

from jrigid._checks import all_finite, check_shape, float_arrays, where_defined
from jrigid._core.compile import one_program
from jrigid._numerics import product, safe_norm
from jrigid._types import Scalar

# Points of the contour. The error is 2^-48 for an isolated eigenvalue.
_POINTS = 48
# Two eigenvectors whose angle has a larger cosine than this count as one.
_SHARED = 0.999
# Eigenvalues that are closer than this times sqrt(eps) of the matrix count as one.
_TOGETHER = 8.0


@one_program
def eigenvalues(matrix: Inexact[ArrayLike, "n n"]) -> Complex[Array, " n"]:
    """Eigenvalues of a square matrix, by descending real part.

    Args:
        matrix: Any square matrix, whose entries are of comparable size.

    Returns:
        Its eigenvalues. Real parts are rounded to 1e-5 of the matrix's norm to order
        them, and where they are then equal the larger imaginary part comes first. NaN
        for a matrix that is not finite.

    Gradients: exact for an isolated eigenvalue. Eigenvalues closer than 8 sqrt(eps) of
    the matrix's norm (1e-7 in float64) count as one. Each gets the derivative of their
    mean, which is smooth where they meet; its own may be infinite there. No order of
    derivative is NaN.
    Source: T. Kato, Perturbation Theory for Linear Operators, section II.2: derivatives
    by the projector (1 / 2 pi i) times the contour integral of the resolvent.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> def pair(mu):  # eigenvalues +-sqrt(mu), which meet at mu = 0
    ...     return jr.stability.eigenvalues(jnp.array([[0.0, 1.0], [mu, 0.0]])).real
    >>> print(pair(4.0), jax.jacfwd(pair)(4.0), abs(jax.jacfwd(pair)(0.0)).round(9))
    [ 2. -2.] [ 0.25 -0.25] [0. 0.]
    """
    matrix = jnp.asarray(matrix)
    # `float_arrays` makes floats of integers, but refuses a complex matrix.
    if not jnp.iscomplexobj(matrix):
        (matrix,) = float_arrays(matrix)
    check_shape("matrix", matrix, (matrix.shape[:1] or (None,)) * 2)
    return where_defined(all_finite(matrix), eigensystem, matrix)[0]


@jax.custom_jvp
def eigensystem(matrix: Array) -> tuple[Array, Array]:
    """Eigenvalues in order, and eigenvectors: columns without derivatives."""
    values, vectors = jnp.linalg.eig(matrix)
    # Real parts that differ by rounding do not decide the order.
    rounded = jnp.round(values.real / _size(matrix) * 1e5)
    order = jnp.lexsort((-values.imag, -rounded))
    return values[order], vectors[:, order]


def _size(matrix: Array) -> Float[Array, ""]:
    """Norm of a matrix; 1 for a matrix of zeros."""
    size = jnp.sqrt(jnp.sum(jnp.abs(matrix) ** 2))
    return jnp.where(size > 0, size, 1.0)


@eigensystem.defjvp
def _(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    (matrix,), (change,) = primals, tangents
    values, vectors = eigensystem(matrix)
    slopes = _slopes(matrix, jax.lax.stop_gradient(values), change)
    return (values, vectors), (slopes, jnp.zeros_like(vectors))


@jax.numpy_dtype_promotion("standard")
def _slopes(matrix: Array, values: Array, change: Array) -> Array:
    """Derivatives of the eigenvalues, of which those that are close get their mean.

    The sum of the eigenvalues inside a contour changes by the trace of the projector
    times the change of the matrix. A projector is an integral of the resolvent over a
    circle, by the trapezoidal rule.
    """
    n = values.size
    real = values.real.dtype
    size = jax.lax.stop_gradient(_size(matrix))
    close = _clusters(values, _TOGETHER * jnp.sqrt(jnp.finfo(real).eps) * size)
    count = jnp.sum(close, axis=1)
    centre = jnp.sum(jnp.where(close, values[None, :], 0.0), axis=1) / count
    radius = _contour_radius(values, centre, close, size)
    angles = 2 * jnp.pi * (jnp.arange(_POINTS).astype(real) + 0.5) / _POINTS
    circle = jax.lax.complex(jnp.cos(angles), jnp.sin(angles))
    spokes = radius[:, None] * circle[None, :]
    points = (centre[:, None] + spokes)[:, :, None, None]
    identity = jnp.eye(n, dtype=real)[None, None]
    resolvents = jnp.linalg.inv(points * identity - matrix[None, None])
    traces = product("ipjk,kj->ip", resolvents, change.astype(values.dtype))
    # On the circle dz / (2 pi i) is spokes dtheta / (2 pi).
    return jnp.sum(spokes * traces, axis=1) / (_POINTS * count)


def _clusters(values: Array, distance: Array) -> Array:
    """Whether pairs of eigenvalues count as one, directly or through others."""
    close = jnp.abs(values[:, None] - values[None, :]) <= distance
    # Each pass doubles the length of the chains that are joined.
    for _ in range(max(values.size - 1, 1).bit_length()):
        close = jnp.any(close[:, :, None] & close[None, :, :], axis=1)
    return close


def _contour_radius(values: Array, centre: Array, close: Array, size: Array) -> Array:
    """Radius of a circle round each cluster, with all other eigenvalues outside."""
    distance = jnp.abs(values[None, :] - centre[:, None])
    inner = jnp.max(distance, axis=1, initial=0.0, where=close)
    # No eigenvalue is as far as the initial value.
    outer = jnp.min(distance, axis=1, initial=4 * size, where=~close)
    # The error is about (inner / radius)^48 + (radius / outer)^48. Half way to the
    # others both terms are small, and the geometric mean makes them equal.
    return jnp.where(inner < 0.25 * outer, 0.5 * outer, jnp.sqrt(inner * outer))


def pairs(values: Array, vectors: Array) -> tuple[Array, Array]:
    """Distances of all pairs of eigenvalues, and whether they share a direction.

    The distance of an eigenvalue to itself is infinite.
    """
    gaps = jnp.abs(values[:, None] - values[None, :])
    overlap = jnp.abs(product("ki,kj->ij", jnp.conj(vectors), vectors))
    return jnp.where(jnp.eye(values.size, dtype=bool), jnp.inf, gaps), overlap > _SHARED


def null_directions(vectors: Array, operator: Array, tiny: Array) -> Array:
    """Rows that an operator maps to zero, made orthonormal; zeros replace others."""
    rows: list[Array] = []
    for vector in vectors:
        length = safe_norm(vector)
        for row in rows:
            vector = vector - jnp.sum(row * vector) * row
        left = safe_norm(vector)
        vector = vector / jnp.where(left > 0, left, 1.0)
        image = safe_norm(product("i,ij->j", vector, operator))
        rows.append(jnp.where((left > tiny * length) & (image <= tiny), vector, 0.0))
    return jnp.stack(rows)


def _without_symmetries(
    matrix: Array, neutral: Array, conserved: Array, tiny: Array
) -> Array:
    """The matrix, with the zero eigenvalues that every motion has moved to -1.

    These are the eigenvalues of columns that the matrix maps to zero (`neutral`), those
    of rows that it maps to zero (`conserved`), and, where the torque does not depend on
    the attitude, the three of a turn of the whole body. A multiple of v v^T moves the
    eigenvalue of a known vector v and leaves the others where they are. This holds for
    each value of a parameter, so that derivatives are right too.
    """
    blind = jnp.all(matrix[3:, :3] == 0)
    away = -jnp.eye(3, len(matrix), dtype=matrix.dtype)
    # The turn then has the eigenvalue -1 three times and is coupled to nothing.
    matrix = matrix.at[:3].set(jnp.where(blind, away, matrix[:3]))
    conserved = conserved.at[:, :3].set(jnp.where(blind, 0.0, conserved[:, :3]))
    directions = (
        null_directions(neutral, matrix.T, tiny),
        null_directions(conserved, matrix, tiny),
    )
    rows = jnp.concatenate(directions)
    return matrix - product("ki,kj->ij", rows, rows)


def margin(matrix: Array, neutral: Array, conserved: Array, accuracy: Array) -> Scalar:
    """The margin of a matrix, in its units.

    Without damping the eigenvalues s are in mirror pairs about the imaginary axis. Two
    that meet on the axis, at zero or in a Krein collision, may leave it. Then
    ((s - s') / 2)^2 of the two changes smoothly, from minus the square of half their
    distance to the square of the growth rate. With m the mean of the two, it is a
    double eigenvalue of (matrix - m)^2, and semisimple where the two meet.
    """
    # Over the size all eigenvalues but those that are moved are within 1/4 of zero.
    size = 4 * (1 + jnp.sqrt(jnp.sum(jax.lax.stop_gradient(matrix) ** 2)))
    tiny = accuracy / size
    matrix = _without_symmetries(matrix / size, neutral, conserved, tiny)
    values, vectors = eigensystem(matrix)
    known = jax.lax.stop_gradient(values)
    free = known.real > -0.5
    # The mirror image of s about the imaginary axis is -conj(s).
    mirrored = jnp.abs(known[:, None] + jnp.conj(known)[None, :]) <= tiny
    undamped = jnp.all(~free | jnp.any(mirrored, axis=1))
    damped = -jnp.max(jnp.where(free, values.real, -1.0))
    i, j = _nearest(known, vectors, free, tiny)
    mean = 0.5 * (values[i] + values[j])
    shifted = matrix.astype(mean.dtype) - mean * jnp.eye(len(matrix), dtype=mean.dtype)
    squares, _ = eigensystem(product("ij,jk->ik", shifted, shifted))
    # Both s - mean and s' - mean have this square.
    apart = 0.25 * (known[i] - known[j]) ** 2
    place = jnp.argmin(jnp.abs(jax.lax.stop_gradient(squares) - apart))
    return jnp.where(undamped, -squares[place].real * size, damped) * size


def _nearest(
    values: Array, vectors: Array, free: Array, tiny: Array
) -> tuple[Array, Array]:
    """The two eigenvalues of an undamped motion that are nearest to growth.

    If there is growth, they are those that grow most.

    Two of one rate that have directions of their own do not count, nor does one with a
    zero that stays where it is.
    """
    gaps, alike = pairs(values, vectors)
    zero = jnp.abs(values) <= tiny
    counts = (
        jnp.isfinite(gaps)
        & free[:, None]
        & free[None, :]
        & (zero[:, None] == zero[None, :])
    )
    counts = counts & ((gaps > tiny) | alike)
    squares = (0.25 * (values[:, None] - values[None, :]) ** 2).real
    best = jnp.argmax(jnp.where(counts, squares, -jnp.inf))
    return best // values.size, best % values.size
