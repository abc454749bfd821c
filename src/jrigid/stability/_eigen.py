"""Eigenvalues of a small matrix whose derivatives are finite, also where two of them meet."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Complex, Float, Inexact

from jrigid._checks import all_finite, check_shape, float_arrays, where_defined
from jrigid._numerics import product

_POINTS = 48  # of the contour: its error is 2^-48 for an eigenvalue by itself
_SHARED = 0.999  # cosine of the angle below which two eigenvectors count as one
_TOGETHER = 8.0  # sqrt(eps) of the matrix: eigenvalues nearer than that count as one


def eigenvalues(matrix: Inexact[ArrayLike, "n n"]) -> Complex[Array, " n"]:
    """Eigenvalues of a square matrix, in the order of their real parts, the largest first.

    Args:
        matrix: Any square matrix, whose entries are of comparable size.

    Returns:
        Its eigenvalues; real parts closer than 1e-5 of the matrix's norm count as equal, and there
        the larger imaginary part comes first. NaN of a matrix that is not finite.

    Gradients: exact where an eigenvalue is by itself. Eigenvalues that are nearer than 8 sqrt(eps)
    of the matrix's norm (1e-7 in float64) count as one, and each gets the derivative of their mean,
    which is smooth where they meet; its own may be infinite there. Never NaN, in all orders.
    Source: T. Kato, Perturbation Theory for Linear Operators, section II.2: derivatives by the
    projector (1 / 2 pi i) times the contour integral of the resolvent.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> def pair(mu):  # eigenvalues +-sqrt(mu), which meet at mu = 0
    ...     return jr.stability.eigenvalues(jnp.array([[0.0, 1.0], [mu, 0.0]])).real
    >>> print(pair(4.0), jax.jacfwd(pair)(4.0), abs(jax.jacfwd(pair)(0.0)).round(9))
    [ 2. -2.] [ 0.25 -0.25] [0. 0.]
    """
    (matrix,) = float_arrays(matrix)
    check_shape("matrix", matrix, (matrix.shape[:1] or (None,)) * 2)
    return where_defined(all_finite(matrix), _eigenvalues, matrix)


@jax.custom_jvp
def _eigenvalues(matrix: Array) -> Array:
    values = jnp.linalg.eigvals(matrix)
    size = _size(matrix)
    # Real parts that differ by rounding do not decide the order.
    rounded = jnp.round(values.real / jnp.where(size > 0, size, 1.0) * 1e5)
    return values[jnp.lexsort((-values.imag, -rounded))]


def _size(matrix: Array) -> Float[Array, ""]:
    return jnp.sqrt(jnp.sum(jnp.abs(matrix) ** 2))


@_eigenvalues.defjvp
def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    (matrix,), (change,) = primals, tangents
    values = _eigenvalues(matrix)
    return values, _slopes(matrix, jax.lax.stop_gradient(values), change.astype(values.dtype))


def _slopes(matrix: Array, values: Array, change: Array) -> Array:
    n, real = values.size, values.real.dtype
    size = jax.lax.stop_gradient(_size(matrix))
    size = jnp.where(size > 0, size, 1.0)
    gaps = jnp.abs(values[:, None] - values[None, :])
    near = gaps <= _TOGETHER * jnp.sqrt(jnp.finfo(real).eps) * size
    # Neighbours of neighbours belong together too.
    for _ in range(max(n - 1, 1).bit_length()):
        near = jnp.any(near[:, :, None] & near[None, :, :], axis=1)
    members = near.astype(real)
    count = jnp.sum(members, axis=1)
    centre = product("ij,j->i", members.astype(values.dtype), values) / count.astype(values.dtype)
    away = jnp.abs(values[None, :] - centre[:, None])
    inner = jnp.max(jnp.where(near, away, 0.0), axis=1)
    outer = jnp.min(jnp.where(near, jnp.inf, away), axis=1)
    outer = jnp.where(jnp.isfinite(outer), outer, 4 * jnp.maximum(inner, size))
    radius = jnp.where(inner < 0.25 * outer, 0.5 * outer, jnp.sqrt(inner * outer))
    angles = 2 * jnp.pi * (jnp.arange(_POINTS).astype(real) + 0.5) / _POINTS
    turn = jax.lax.complex(jnp.cos(angles), jnp.sin(angles))
    eye = jnp.eye(n, dtype=values.dtype)

    def one(centre: Array, radius: Array, count: Array) -> Array:
        spoke = radius * turn
        points = (centre + spoke)[:, None, None] * eye[None] - matrix.astype(values.dtype)[None]
        # The sum of the eigenvalues inside changes by the trace of the projector times the change.
        spread = jnp.trace(product("pij,jk->pik", jnp.linalg.inv(points), change), axis1=1, axis2=2)
        return jnp.sum(spoke * spread) / (_POINTS * count)

    return jax.vmap(one)(centre, radius.astype(values.dtype), count.astype(values.dtype))


def eigenvectors(matrix: Array, values: Array) -> Array:
    """Eigenvectors in the order of the eigenvalues; without derivatives."""
    unordered, columns = jnp.linalg.eig(matrix)
    gaps = jnp.abs(unordered[None, :] - values[:, None])
    # Each eigenvalue takes the nearest that is left.
    order = []
    for i in range(values.size):
        nearest = jnp.argmin(gaps[i])
        order.append(nearest)
        gaps = jnp.where(jnp.arange(values.size)[None, :] == nearest, jnp.inf, gaps)
    return columns[:, jnp.stack(order)]


def pairs(values: Array, vectors: Array) -> tuple[Array, Array]:
    """Distances of each two eigenvalues, and whether they share a direction; infinite to itself."""
    gaps = jnp.abs(values[:, None] - values[None, :])
    overlap = jnp.abs(product("ki,kj->ij", jnp.conj(vectors), vectors))
    return jnp.where(jnp.eye(values.size, dtype=bool), jnp.inf, gaps), overlap > _SHARED
