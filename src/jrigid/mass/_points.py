"""Mass properties of point clouds, and of densities by quadrature."""

from collections.abc import Callable, Iterable
from typing import Any

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
from jrigid.mass._body import MassProperties

# Sums over points. Naive float32 sums of 10^6 terms lose four digits, and XLA's CPU
# reductions and products of tall thin matrices run below numpy's speed; lanes of
# partial sums mend both.
_LANES = 1024


PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def symmetric(entries: Iterable[Array]) -> Matrix:
    """The symmetric matrix of these entries, in the order of `PAIRS`."""
    xx, xy, xz, yy, yz, zz = entries
    return jnp.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def lane_sum(x: Float[Array, " points"]) -> Scalar:
    padded = jnp.pad(x, (0, -x.shape[0] % 64))
    return jnp.sum(jnp.sum(padded.reshape(-1, 64), axis=0))


def _terms(m: Array, positions: Array, place: Vector) -> list[Array]:
    r = [positions[:, i] - place[i] for i in range(3)]
    first = [m * x for x in r]
    return [*first, *(first[i] * r[j] for i, j in PAIRS)]


def _at_once(weights: Array, positions: Array, place: Vector) -> list[Array]:
    return [jnp.sum(x) for x in _terms(weights, positions, place)]


def _in_lanes(weights: Array, positions: Array, place: Vector) -> list[Array]:
    def add(i: Array, sums: list[Array]) -> list[Array]:
        m, r = (
            jax.lax.dynamic_slice_in_dim(x, _LANES * i, _LANES)
            for x in (weights, positions)
        )
        return [s + x for s, x in zip(sums, _terms(m, r, place), strict=True)]

    blocks = weights.shape[0] // _LANES
    lanes = jax.lax.fori_loop(0, blocks, add, [jnp.zeros(_LANES, weights.dtype)] * 9)
    rest = _at_once(weights[_LANES * blocks :], positions[_LANES * blocks :], place)
    return [jnp.sum(x) + y for x, y in zip(lanes, rest, strict=True)]


@jax.custom_jvp
def _moments(weights: Array, positions: Array, place: Vector) -> tuple[Vector, Matrix]:
    """Sums of m r and of m r r^T, r from a place, in one pass.

    The rule spares reverse mode the memory of a scan, and NaN from bad values: to keep
    them from the sum itself would cost as much as the sum.
    """
    on_cpu = _in_lanes if len(weights) >= _LANES else _at_once
    sums = jax.lax.platform_dependent(
        weights, positions, place, cpu=on_cpu, default=_at_once
    )
    return jnp.stack(sums[:3]), symmetric(sums[3:])


@_moments.defjvp
def _moments_jvp(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    m, r, place = primals
    dm, dr, _ = tangents  # the place is a constant
    m, r = (jnp.where(jnp.isfinite(x), x, 0.0) for x in (m, r - place[None, :]))
    first = jnp.sum(dm[:, None] * r + m[:, None] * dr, axis=0)
    half = product("na,nb->ab", 0.5 * dm[:, None] * r + m[:, None] * dr, r)
    return _moments(*primals), (first, half + half.T)


@jax.jit
def _cloud(masses: Array, positions: Array) -> MassProperties:
    """The body, in one pass about the midst of some points, in two where the mass is elsewhere."""
    mass = lane_sum(masses)
    divisor = jnp.where(mass == 0, 1.0, mass)
    place = jax.lax.stop_gradient(
        jnp.mean(positions[:: -(-len(positions) // 64)], axis=0)
    )
    sums = _moments(masses, positions, place)
    off = jax.lax.stop_gradient(sums[0]) / divisor
    far = 2 * mass * jnp.sum(off * off) > jnp.trace(sums[1])  # then digits are lost
    place = place + jnp.where(far, off, 0.0)
    again = lambda *_: _moments(masses, positions, place)  # noqa: E731
    first, second = jax.lax.cond(far, again, lambda *x: x, *sums)
    center = first / divisor
    inertia = inertia_of_second_moment(
        second - mass * center[:, None] * center[None, :]
    )
    return MassProperties.unchecked(mass, place + center, inertia)


@jax.jit
def _examined(masses: Array, positions: Array) -> list[tuple[Bool[Array, ""], Array]]:
    """Whether all masses are finite and not negative, and positions finite; the first that is not.

    Asked of the whole, not of each one, a good answer is quick.
    """

    def first_bad(ok: Array, x: Array) -> Array:
        each = ok.reshape(len(x), -1)
        return jax.lax.cond(
            jnp.all(ok), lambda: x[0], lambda: x[jnp.argmin(jnp.all(each, axis=1))]
        )

    fine, finite = jnp.isfinite(masses) & (masses >= 0), jnp.isfinite(positions)
    return [
        (jnp.all(ok), first_bad(ok, x))
        for ok, x in ((fine, masses), (finite, positions))
    ]


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
    (fine, mass), (finite, position) = _examined(*jax.lax.stop_gradient(arrays))
    findings = Findings()
    message = "Argument `masses` must be finite and non-negative, but it is not."
    findings.require(fine, None, message, mass)
    findings.require(
        finite, None, "Argument `positions` must be finite, but it is not.", position
    )
    if not throw:  # NaN in the sums would reach the gradients of the other lanes
        arrays = harmless(findings.ok, arrays)
    body = _cloud(*arrays)
    findings.require(
        body.mass > 0, None, "Argument `masses` must not be all zero, but it is."
    )
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


def from_density(
    density: Callable[[Float[Array, "3"]], Any],
    lower: VectorLike,
    upper: VectorLike,
    *,
    order: int = 16,
    throw: bool = True,
) -> MassProperties:
    """Mass properties of a density in a box, by tensor-product Gauss-Legendre quadrature.

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
    order = whole_number("order", order, 2)
    shape = jax.eval_shape(density, jax.ShapeDtypeStruct((3,), lower.dtype))
    if getattr(shape, "shape", None) != ():
        raise ValueError(
            "Argument `density` must map coordinates (3,) to a scalar, but it gives "
            f"{shape}."
        )
    nodes, node_weights = np.polynomial.legendre.leggauss(order)
    grid = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), axis=-1).reshape(
        -1, 3
    )
    weights = np.einsum("i,j,k->ijk", node_weights, node_weights, node_weights).ravel()
    findings = Findings()
    box = jnp.stack([lower, upper])
    message = (
        "Arguments `lower`, `upper` must be finite with `lower` < `upper`, but they "
        "are not."
    )
    findings.require(all_finite(box) & jnp.all(lower < upper), None, message, box)
    lower, upper = harmless(findings.ok, (lower, upper))
    half = 0.5 * (upper - lower)
    positions = 0.5 * (lower + upper)[None, :] + half[None, :] * jnp.asarray(
        grid, half.dtype
    )
    values = jax.vmap(density)(positions).astype(half.dtype)
    [(fine, value), _] = _examined(*jax.lax.stop_gradient((values, positions)))
    message = "Argument `density` must be finite and non-negative, but it is not."
    findings.require(fine, None, message, value)
    masses = harmless(fine, values) * jnp.prod(half) * jnp.asarray(weights, half.dtype)
    body = _cloud(masses, positions)
    findings.require(
        body.mass > 0, None, "Argument `density` must not be zero, but it is."
    )
    return findings.guard(body, throw)
