"""Mass properties of point clouds, and of densities by quadrature."""

from collections.abc import Callable, Iterable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jrigid._checks import (
    Findings,
    all_finite,
    check_shape,
    harmless,
    nan_where,
    shaped,
    whole_number,
)
from jrigid._numerics import product
from jrigid._types import Matrix, Real, Scalar, Vector, VectorLike
from jrigid.mass._axes import inertia_of_second_moment
from jrigid.mass._mass_body import MassProperties

# Partial sums over points. Naive float32 sums of 10^6 terms lose four digits, and XLA's
# reductions and products of tall thin matrices run below numpy's speed on a CPU. Lanes
# of partial sums mend both.
_LANES = 1024

_NO_BOX = (
    "Arguments `lower`, `upper` must be finite with `lower` < `upper`, but they are "
    "not."
)

#: Indices of the entries of a symmetric matrix.
PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def symmetric(entries: Iterable[Array]) -> Matrix:
    """The symmetric matrix of these entries, in the order of `PAIRS`."""
    xx, xy, xz, yy, yz, zz = entries
    return jnp.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def lane_sum(x: Float[Array, " points"]) -> Scalar:
    """Sum in 64 lanes: see `_LANES`; few terms do not fill more."""
    padded = jnp.pad(x, (0, -x.shape[0] % 64))
    return jnp.sum(jnp.sum(padded.reshape(-1, 64), axis=0))


def _terms(m: Array, positions: Array, place: Vector) -> list[Array]:
    """The nine products m r and m r r^T of each point, r from a place."""
    r = [positions[:, i] - place[i] for i in range(3)]
    first = [m * x for x in r]
    return [*first, *(first[i] * r[j] for i, j in PAIRS)]


def _at_once(weights: Array, positions: Array, place: Vector) -> list[Array]:
    return [jnp.sum(x) for x in _terms(weights, positions, place)]


def _in_lanes(weights: Array, positions: Array, place: Vector) -> list[Array]:
    def add(i: Array, sums: list[Array]) -> list[Array]:
        m = jax.lax.dynamic_slice_in_dim(weights, _LANES * i, _LANES)
        r = jax.lax.dynamic_slice_in_dim(positions, _LANES * i, _LANES)
        return [s + x for s, x in zip(sums, _terms(m, r, place), strict=True)]

    blocks = weights.shape[0] // _LANES
    lanes = jax.lax.fori_loop(0, blocks, add, [jnp.zeros(_LANES, weights.dtype)] * 9)
    done = _LANES * blocks
    rest = _at_once(weights[done:], positions[done:], place)
    return [jnp.sum(x) + y for x, y in zip(lanes, rest, strict=True)]


@jax.custom_jvp
def _moments(weights: Array, positions: Array, place: Vector) -> tuple[Vector, Matrix]:
    """Sums of m r and of m r r^T, r from a place, in one pass.

    The rule below spares reverse mode the memory of a scan. It also keeps NaN of bad
    points from the derivatives of the others; masking them in the sum would cost as
    much as the sum.
    """
    on_cpu = _in_lanes if len(weights) >= _LANES else _at_once
    sums = jax.lax.platform_dependent(
        weights, positions, place, cpu=on_cpu, default=_at_once
    )
    return jnp.stack(sums[:3]), symmetric(sums[3:])


@_moments.defjvp
def _moments_jvp(
    primals: tuple[Array, Array, Vector], tangents: tuple[Array, Array, Vector]
) -> tuple[tuple[Vector, Matrix], tuple[Vector, Matrix]]:
    weights, positions, place = primals
    dm, dr, _ = tangents  # the place is a constant
    m = _finite_or_zero(weights)
    r = _finite_or_zero(positions - place[None, :])
    first = jnp.sum(dm[:, None] * r + m[:, None] * dr, axis=0)
    # The change of m r r^T is this matrix plus its transpose, so half of the term in dm
    # is in each.
    half = product("na,nb->ab", 0.5 * dm[:, None] * r + m[:, None] * dr, r)
    return _moments(*primals), (first, half + half.T)


def _finite_or_zero(x: Array) -> Array:
    return jnp.where(jnp.isfinite(x), x, 0.0)


@jax.jit
def _cloud(masses: Array, positions: Array) -> MassProperties:
    """The body of points, in one pass over them, or in two for an uneven mass."""
    mass = lane_sum(masses)
    # Callers refuse a mass of zero later. Until then nothing may become NaN.
    divisor = jnp.where(mass == 0, 1.0, mass)
    # Sums are about a place amid 64 points, which is usually near the centre of mass.
    some = positions[:: -(-len(positions) // 64)]
    place = jax.lax.stop_gradient(jnp.mean(some, axis=0))
    sums = _moments(masses, positions, place)
    # The new place is a constant for `_moments`, so it may not depend on masses here.
    offset = jax.lax.stop_gradient(sums[0] / divisor)
    # The difference of second moments loses digits if most of them is the offset's.
    is_far = 2 * mass * jnp.sum(offset * offset) > jnp.trace(sums[1])
    place = place + jnp.where(is_far, offset, 0.0)

    def about_new_place(*_: Array) -> tuple[Vector, Matrix]:
        return _moments(masses, positions, place)

    first, second = jax.lax.cond(is_far, about_new_place, lambda *x: x, *sums)
    center = first / divisor
    about_center = second - mass * center[:, None] * center[None, :]
    inertia = inertia_of_second_moment(about_center)
    return MassProperties.unchecked(mass, place + center, inertia)


def _first_bad(ok: Bool[Array, "points ..."], x: Array) -> tuple[Array, Array]:
    """Whether all of x are good, and the first entry that is not."""
    all_good = jnp.all(ok)

    def searched() -> Array:
        return x[jnp.argmin(jnp.all(ok.reshape(len(x), -1), axis=1))]

    # The search is left out where there is nothing to find: it costs more than the sum.
    return all_good, jax.lax.cond(all_good, lambda: x[0], searched)


@jax.jit
def _examined(
    masses: Array, positions: Array
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Whether all masses, then all positions, are good, and the first that is not."""
    are_masses = jnp.isfinite(masses) & (masses >= 0)
    return (
        _first_bad(are_masses, masses),
        _first_bad(jnp.isfinite(positions), positions),
    )


def _cloud_arrays(masses: ArrayLike, positions: ArrayLike) -> tuple[Array, Array]:
    masses, positions = shaped(masses=(masses, None), positions=(positions, None, 3))
    check_shape("positions", positions, (masses.shape[0], 3))
    if masses.shape[0] == 0:
        raise ValueError(
            "Argument `masses` must hold at least one point, but it is empty."
        )
    return masses, positions


def from_points(
    masses: Real[ArrayLike, " points"],
    positions: Real[ArrayLike, "points 3"],
    *,
    throw: bool = True,
) -> MassProperties:
    r"""Mass properties of point masses.

    Args:
        masses: Point masses [kg], non-negative, not all zero.
        positions: Their coordinates [m].
        throw: False: a bad value makes the body of its lane NaN instead of an error.

    Returns:
        The body, its tensor about the centre of mass. Accurate far from the origin too,
        and where a light point is far from the others.

    Raises:
        RuntimeError: A mass is negative or not finite or all are zero, or a position is
            not finite.

    Gradients: finite everywhere.
    Source: Goldstein, Classical Mechanics, 3rd ed., eq. 5.7-5.8.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> ends = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    >>> dumbbell = jr.from_points(jnp.array([1.0, 1.0]), ends)
    >>> print(dumbbell.center_of_mass, jnp.diag(dumbbell.inertia))
    [0. 0. 1.] [2. 2. 0.]
    """
    arrays = _cloud_arrays(masses, positions)
    (are_masses, mass), (are_places, place) = _examined(*jax.lax.stop_gradient(arrays))
    findings = Findings()
    message = "Argument `masses` must be finite and non-negative, but it is not."
    findings.require(are_masses, None, message, mass)
    message = "Argument `positions` must be finite, but it is not."
    findings.require(are_places, None, message, place)
    if not throw:
        # NaN in the sums would reach the gradients of the other lanes.
        arrays = harmless(findings.ok, arrays)
    body = _cloud(*arrays)
    message = "Argument `masses` must not be all zero, but it is."
    findings.require(body.mass > 0, None, message)
    return findings.guard(body, throw)


def inertia_tensor(
    masses: Real[ArrayLike, " points"], positions: Real[ArrayLike, "points 3"]
) -> Matrix:
    r"""Inertia tensor of point masses about the origin of their coordinates.

    $I_{ab} = \sum_i m_i (|r_i|^2 \delta_{ab} - r_{ia} r_{ib})$. NaN where a mass is
    negative.

    Args:
        masses: Point masses [kg].
        positions: Coordinates [m].

    Returns:
        Symmetric positive semi-definite tensor [kg m^2].

    Gradients: finite everywhere.
    Source: Goldstein, Classical Mechanics, 3rd ed., eq. 5.7-5.8.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.inertia_tensor(jnp.array([2.0]), jnp.array([[0.0, 0.0, 3.0]])))
    [[18.  0.  0.]
     [ 0. 18.  0.]
     [ 0.  0.  0.]]
    """
    return _inertia_about_origin(*_cloud_arrays(masses, positions))


@jax.jit
def _inertia_about_origin(masses: Array, positions: Array) -> Matrix:
    ok = jnp.all(masses >= 0) & all_finite((masses, positions))
    _, second = _moments(masses, positions, jnp.zeros(3, positions.dtype))
    return nan_where(~ok, inertia_of_second_moment(second))


def _quadrature(
    order: int, dtype: np.dtype
) -> tuple[Float[Array, "nodes 3"], Float[Array, " nodes"]]:
    """Nodes and weights of Gauss-Legendre quadrature in the cube from -1 to 1."""
    # On the host, so that nodes in float32 are rounded from float64.
    x, w = np.polynomial.legendre.leggauss(order)
    nodes = np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=-1).reshape(-1, 3)
    weights = np.einsum("i,j,k->ijk", w, w, w).ravel()
    return jnp.asarray(nodes, dtype), jnp.asarray(weights, dtype)


def from_density(
    density: Callable[[Vector], Scalar],
    lower: VectorLike,
    upper: VectorLike,
    *,
    order: int = 16,
    throw: bool = True,
) -> MassProperties:
    """Mass properties of a density in a box, by Gauss-Legendre quadrature.

    Args:
        density: Maps coordinates [m] to a density [kg/m^3], non-negative. It may close
            over parameters that are differentiated.
        lower: Least coordinates of the box [m].
        upper: Greatest coordinates of the box [m].
        order: Nodes along each axis. Exact for densities that are polynomials of degree
            up to 2 order - 3 in each coordinate; a density that jumps inside the box,
            such as that of a ball, converges slowly: split the box, or use `from_mesh`
            or `jrigid.solids`.
        throw: False: a bad value makes the body of its lane NaN instead of an error.

    Returns:
        The body, its tensor about the centre of mass.

    Raises:
        ValueError: A density that is no scalar.
        RuntimeError: The density is negative or not finite at a node, its integral is
            zero, or the box is empty.

    Gradients: finite wherever those of the density are.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> wedge = jr.from_density(lambda r: 2 * r[0], jnp.zeros(3), jnp.ones(3), order=2)
    >>> print(wedge.mass.round(6), wedge.center_of_mass.round(6))
    1.0 [0.666667 0.5      0.5     ]
    """
    lower, upper = shaped(lower=(lower, 3), upper=(upper, 3))
    # A single node would make the body a point.
    order = whole_number("order", order, 2)
    shape = jax.eval_shape(density, jax.ShapeDtypeStruct((3,), lower.dtype))
    if getattr(shape, "shape", None) != ():
        raise ValueError(
            "Argument `density` must map coordinates (3,) to a scalar, but it gives "
            f"{shape}."
        )
    findings = Findings()
    box = jnp.stack([lower, upper])
    is_box = all_finite(box) & jnp.all(lower < upper)
    findings.require(is_box, None, _NO_BOX, box)
    lower, upper = harmless(findings.ok, (lower, upper))
    half = 0.5 * (upper - lower)
    nodes, weights = _quadrature(order, half.dtype)
    positions = 0.5 * (lower + upper)[None, :] + half[None, :] * nodes
    values = jax.vmap(density)(positions).astype(half.dtype)
    [(is_fine, value), _] = _examined(*jax.lax.stop_gradient((values, positions)))
    message = "Argument `density` must be finite and non-negative, but it is not."
    findings.require(is_fine, None, message, value)
    # The product of the half-lengths is the Jacobian of the map from the cube to the
    # box.
    masses = harmless(is_fine, values) * jnp.prod(half) * weights
    body = _cloud(masses, positions)
    message = "Argument `density` must not be zero, but it is."
    findings.require(body.mass > 0, None, message)
    return findings.guard(body, throw)
