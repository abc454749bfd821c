"""Mass properties of point clouds, and of densities by quadrature."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Real

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_shape,
    float_arrays,
    nan_where,
)
from jrigid._numerics import product
from jrigid._types import (
    Matrix,
    Scalar,
    Vector,
    VectorLike,
)
from jrigid.mass._body import MassProperties
from jrigid.mass._validity import raise_or_mark

# Sums over points. Naive float32 sums of 10^6 terms lose four digits, and XLA's CPU reductions
# and products of tall thin matrices run below numpy's speed; lanes of partial sums mend both.
_LANES = 64


def lane_sum(x: Float[Array, " points"]) -> Scalar:
    if x.shape[0] < 4 * _LANES:
        return jnp.sum(x)
    padded = jnp.pad(x, (0, -x.shape[0] % _LANES))
    return jnp.sum(jnp.sum(padded.reshape(-1, _LANES), axis=0))


def _outer_sum(weights: Array, positions: Array) -> Matrix:
    return jnp.sum((weights[:, None] * positions)[:, :, None] * positions[:, None, :], axis=0)


def _outer_sum_in_lanes(weights: Array, positions: Array) -> Matrix:
    def add(sums: tuple, block: tuple) -> tuple[tuple, None]:
        m, r = block
        x, y, z = r[:, 0], r[:, 1], r[:, 2]
        mx, my, mz = m * x, m * y, m * z
        terms = (mx * x, my * y, mz * z, mx * y, mx * z, my * z)
        return tuple(s + t for s, t in zip(sums, terms, strict=True)), None

    whole = weights.shape[0] // _LANES * _LANES
    blocks = (
        weights[:whole].reshape(-1, _LANES),
        positions[:whole].reshape(-1, _LANES, 3),
    )
    start = (jnp.zeros(_LANES, weights.dtype),) * 6
    lanes, _ = jax.lax.scan(add, start, blocks)
    xx, yy, zz, xy, xz, yz = (jnp.sum(lane) for lane in lanes)
    matrix = jnp.stack([jnp.stack([xx, xy, xz]), jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz])])
    return matrix + _outer_sum(weights[whole:], positions[whole:])


@jax.custom_jvp
def _second_moment(weights: Float[Array, " points"], positions: Float[Array, "points 3"]) -> Matrix:
    """Sum of m r r^T; the rule spares reverse mode the memory of a scan."""
    if weights.shape[0] < 16 * _LANES:
        return _outer_sum(weights, positions)
    return jax.lax.platform_dependent(
        weights, positions, cpu=_outer_sum_in_lanes, default=_outer_sum
    )


@_second_moment.defjvp
def _second_moment_jvp(primals: tuple, tangents: tuple) -> tuple[Matrix, Matrix]:
    (m, r), (dm, dr) = primals, tangents
    half = product("na,nb->ab", 0.5 * dm[:, None] * r + m[:, None] * dr, r)
    return _second_moment(m, r), half + half.T


def inertia_of_second_moment(second: Matrix) -> Matrix:
    return jnp.trace(second) * jnp.eye(3, dtype=second.dtype) - second


@jax.jit
def _cloud(masses: Array, positions: Array) -> tuple[Scalar, Vector, Matrix]:
    """Mass, centre, and tensor about the centre, by differences to a local origin."""
    mass = lane_sum(masses)
    origin = jax.lax.stop_gradient(positions[0])
    local = positions - origin[None, :]
    divisor = jnp.where(mass == 0, 1.0, mass)
    center = jnp.stack([lane_sum(masses * local[:, i]) for i in range(3)]) / divisor
    return (
        mass,
        origin + center,
        inertia_of_second_moment(_second_moment(masses, local - center[None, :])),
    )


@jax.jit
def _cloud_checks(masses: Array, positions: Array) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    fine = jnp.all(jnp.isfinite(masses) & (masses >= 0)) & jnp.any(masses > 0)
    return fine, all_finite(positions)


def _points(masses: ArrayLike, positions: ArrayLike, throw: bool) -> tuple[Array, Array, Findings]:
    masses, positions = float_arrays(masses, positions)
    check_shape("masses", masses, (None,))
    check_shape("positions", positions, (masses.shape[0], 3))
    if masses.shape[0] == 0:
        raise ValueError("Argument `masses` must hold at least one point, but it is empty.")
    findings = Findings()
    fine_masses, fine_positions = _cloud_checks(*jax.lax.stop_gradient((masses, positions)))
    findings.require(fine_masses, RESULTS.invalid_masses)
    findings.require(fine_positions, RESULTS.invalid_position)
    if not throw:  # NaN in the sums would reach the gradients of the other lanes
        masses = jnp.where(findings.ok, masses, 1.0)
        positions = jnp.where(findings.ok, positions, 0.0)
    return masses, positions, findings


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
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, its tensor about the centre of mass. Accurate far from the origin too.

    Raises:
        ValueError: Wrong shapes or no points (trace time).
        RuntimeError: A mass is negative or not finite or all are zero, or a position is not
            finite (run time, any lane).

    Gradients: finite everywhere.
    Source: Goldstein, Classical Mechanics, 3rd ed., eq. 5.7-5.8.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> ends = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    >>> dumbbell = jr.from_points(jnp.array([1.0, 1.0]), ends)
    >>> print(dumbbell.center_of_mass, jnp.diag(dumbbell.inertia))
    [0. 0. 1.] [2. 2. 0.]
    """
    masses, positions, findings = _points(masses, positions, throw)
    values = raise_or_mark(findings, _cloud(masses, positions), throw)
    return MassProperties(*values, throw=None)


def inertia_tensor(
    masses: Real[ArrayLike, " points"],
    positions: Real[ArrayLike, "points 3"],
    *,
    throw: bool = True,
) -> Matrix:
    r"""Inertia tensor of point masses about the origin of their coordinates.

    $I_{ab} = \sum_i m_i (|r_i|^2 \delta_{ab} - r_{ia} r_{ib})$.

    Args:
        masses: Point masses [kg], non-negative, not all zero.
        positions: Coordinates [m].
        throw: False: a bad value makes the tensor of its lane NaN instead of an error;
            `from_points` gives the code.

    Returns:
        Symmetric positive semi-definite tensor [kg m^2].

    Raises:
        ValueError: Wrong shapes or no points (trace time).
        RuntimeError: A mass is negative or not finite or all are zero, or a position is not
            finite (run time, any lane).

    Gradients: finite everywhere.
    Source: Goldstein, Classical Mechanics, 3rd ed., eq. 5.7-5.8.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.inertia_tensor(jnp.array([2.0]), jnp.array([[0.0, 0.0, 3.0]])))
    [[18.  0.  0.]
     [ 0. 18.  0.]
     [ 0.  0.  0.]]
    """
    masses, positions, findings = _points(masses, positions, throw)
    tensor = _inertia_about_origin(masses, positions)
    return findings.apply(tensor, True) if throw else nan_where(~findings.ok, tensor)


@jax.jit
def _inertia_about_origin(masses: Array, positions: Array) -> Matrix:
    return inertia_of_second_moment(_second_moment(masses, positions))


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
        density: Maps coordinates [m] to a density [kg/m^3], non-negative. It may close over
            parameters that are differentiated.
        lower: Least coordinates of the box [m].
        upper: Greatest coordinates of the box [m].
        order: Nodes along each axis. Exact for densities that are polynomials of degree up to
            2 order - 3 in each coordinate; a density that jumps inside the box, such as that of a
            ball, converges slowly: split the box, or use `from_mesh` or `jrigid.solids`.
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, its tensor about the centre of mass.

    Raises:
        ValueError: Wrong shape, order below 2, or a density that is no scalar (trace time).
        RuntimeError: The density is negative or not finite at a node, its integral is zero, or
            the box is empty (run time, any lane).

    Gradients: finite wherever those of the density are.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> wedge = jr.from_density(lambda r: 2 * r[0], jnp.zeros(3), jnp.ones(3), order=2)
    >>> print(wedge.mass.round(6), wedge.center_of_mass.round(6))
    1.0 [0.666667 0.5      0.5     ]
    """
    lower, upper = float_arrays(lower, upper)
    check_shape("lower", lower, (3,))
    check_shape("upper", upper, (3,))
    if not isinstance(order, int) or order < 2:
        raise ValueError(f"Argument `order` must be an integer of at least 2, but it is {order!r}.")
    shape = jax.eval_shape(density, jax.ShapeDtypeStruct((3,), lower.dtype))
    if getattr(shape, "shape", None) != ():
        raise ValueError(
            f"Argument `density` must map coordinates (3,) to a scalar, but it gives {shape}."
        )
    nodes, node_weights = np.polynomial.legendre.leggauss(order)
    grid = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 3)
    weights = np.einsum("i,j,k->ijk", node_weights, node_weights, node_weights).ravel()
    box = all_finite((lower, upper)) & jnp.all(lower < upper)
    # A bad box gives way to a unit box: its NaN would reach the gradients of the other lanes.
    lower, upper = jnp.where(box, lower, 0.0), jnp.where(box, upper, 1.0)
    half = 0.5 * (upper - lower)
    positions = 0.5 * (lower + upper)[None, :] + half[None, :] * jnp.asarray(grid, half.dtype)
    values = jax.vmap(density)(positions).astype(half.dtype)
    findings = Findings()
    fine = jnp.all(jnp.isfinite(values) & (values >= 0)) & jnp.any(values > 0)
    findings.require(fine & box, RESULTS.invalid_density)
    masses = jnp.where(fine, values, 1.0) * jnp.prod(half) * jnp.asarray(weights, half.dtype)
    return MassProperties(*raise_or_mark(findings, _cloud(masses, positions), throw), throw=None)
