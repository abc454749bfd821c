"""Mass properties: point clouds, densities and meshes; parallel axis; principal axes; composition.

Positions, centres of mass and tensors are components in one set of body axes [m, kg, kg m^2].
`MassProperties` holds its tensor about the centre of mass. Where moments repeat, derivatives of
their symmetric functions are right to first order through `principal_axes`, and to second order
through `tensor_function`.
"""

from collections.abc import Callable
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Real

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_inertia_shape,
    check_shape,
    float_arrays,
    is_concrete,
    is_symmetric,
)
from jrigid._spectral import eigh, product, spectral_function
from jrigid._types import (
    InertiaLike,
    Matrix,
    QuaternionLike,
    Scalar,
    ScalarLike,
    Vector,
    VectorLike,
)
from jrigid.rotation import to_matrix

_ULPS = 64  # rounding allowed in "symmetric", "not negative" and "I3 <= I1 + I2"


@final
class PrincipalAxes(eqx.Module):
    """Principal moments and axes of an inertia tensor.

    Attributes:
        moments: Principal moments, ascending [kg m^2].
        axes: Rotation whose columns are the principal axes: v_body = axes @ v_principal.
    """

    moments: Float[Array, "3"]
    axes: Float[Array, "3 3"]

    @property
    def result(self) -> RESULTS:
        """Code of what became of the call: `successful` or `invalid_inertia`."""

        def judge(moments: Array) -> RESULTS:
            findings = Findings()
            findings.require(all_finite(moments), RESULTS.invalid_inertia)
            return findings.result  # pyright: ignore[reportReturnType]

        for _ in range(self.moments.ndim - 1):
            judge = jax.vmap(judge)
        return judge(self.moments)


@final
class MassProperties(eqx.Module):
    """Mass, centre of mass, and inertia tensor about the centre of mass, of a real body.

    Thin bodies are bodies too: a plate may have I3 = I1 + I2, a rod one zero moment, a point
    three. `a + b` is the two bodies rigidly joined (coordinates in common), and `sum` works.

    Attributes:
        mass: Mass [kg].
        center_of_mass: Coordinates of the centre of mass [m].
        inertia: Tensor about the centre of mass [kg m^2].

    >>> import jax.numpy as jnp, jrigid as jr
    >>> center = jnp.array([0.0, 0.0, 1.0])
    >>> rod = jr.MassProperties(3.0, center, jnp.array([1.0, 1.0, 0.0]))
    >>> print(rod.about(jnp.zeros(3)))
    [[4. 0. 0.]
     [0. 4. 0.]
     [0. 0. 0.]]
    """

    mass: Float[Array, ""]
    center_of_mass: Float[Array, "3"]
    inertia: Float[Array, "3 3"]

    def __init__(
        self,
        mass: ScalarLike,
        center_of_mass: VectorLike,
        inertia: InertiaLike,
        *,
        throw: bool | None = True,
    ) -> None:
        """Check and store; principal moments become a diagonal tensor.

        Args:
            mass: Mass [kg], positive.
            center_of_mass: Coordinates of the centre of mass [m].
            inertia: Moments or tensor about the centre of mass [kg m^2], positive semi-definite,
                with I3 <= I1 + I2, to rounding. It is stored symmetrised.
            throw: True: a bad value is an error. False: it turns into NaN and `result` says what
                was wrong. None: values known to be good are not looked at.

        Raises:
            ValueError: Wrong shape (trace time).
            RuntimeError: Mass not positive, a value not finite, a tensor that is not symmetric or
                has a negative moment or violates I3 <= I1 + I2 (run time, any lane).

        Gradients: the identity, on symmetric tensors.
        """
        mass, center_of_mass, inertia = float_arrays(mass, center_of_mass, inertia)
        check_shape("mass", mass, ())
        check_shape("center_of_mass", center_of_mass, (3,))
        check_inertia_shape(inertia)
        tensor = _as_tensor(inertia)
        if throw is not None:
            findings = _judge(mass, center_of_mass, tensor)
            mass, center_of_mass, tensor = _answer(findings, (mass, center_of_mass, tensor), throw)
        self.mass = mass
        self.center_of_mass = center_of_mass
        self.inertia = 0.5 * (tensor + tensor.T)

    @property
    def result(self) -> RESULTS:
        """Code of what these values are, computed when asked.

        `successful`, `invalid_mass`, `invalid_position`, `invalid_inertia` or
        `unphysical_inertia`; one code a lane where the leaves carry batch axes.
        """
        judge = lambda mass, center, tensor: _judge(mass, center, tensor).result  # noqa: E731
        for _ in range(self.mass.ndim):
            judge = jax.vmap(judge)
        return judge(self.mass, self.center_of_mass, self.inertia)  # pyright: ignore[reportReturnType]

    def about(self, point: VectorLike) -> Matrix:
        """Inertia tensor about any point.

        Args:
            point: Coordinates, not relative to the centre of mass [m].

        Returns:
            Tensor about the point, same axes [kg m^2].

        Raises:
            ValueError: Wrong shape (trace time).

        Gradients: polynomial, finite everywhere.
        Source: Goldstein, Classical Mechanics, 3rd ed., 5.3 (Steiner).

        >>> import jax.numpy as jnp, jrigid as jr
        >>> ball = jr.MassProperties(2.0, jnp.array([1.0, 0.0, 0.0]), jnp.ones(3))
        >>> print(ball.about(jnp.zeros(3))[2, 2])
        3.0
        """
        (point,) = float_arrays(point)
        check_shape("point", point, (3,))
        center, point = float_arrays(self.center_of_mass, point)
        return self.inertia + self.mass * _unit_steiner(point - center)

    def translated(self, displacement: VectorLike) -> "MassProperties":
        """The body moved by a displacement, without turning it.

        Args:
            displacement: Added to the centre of mass [m].

        Returns:
            The moved body.

        Raises:
            ValueError: Wrong shape (trace time).

        Gradients: linear, finite everywhere.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> ball = jr.MassProperties(1.0, jnp.zeros(3), jnp.ones(3))
        >>> print(ball.translated(jnp.array([0.0, 2.0, 0.0])).center_of_mass)
        [0. 2. 0.]
        """
        (displacement,) = float_arrays(displacement)
        check_shape("displacement", displacement, (3,))
        center, displacement = float_arrays(self.center_of_mass, displacement)
        return MassProperties(self.mass, center + displacement, self.inertia, throw=None)

    def rotated(self, attitude: QuaternionLike) -> "MassProperties":
        """The body turned about the origin of the coordinates.

        Args:
            attitude: Quaternion of the turn, any but zero; its norm drops out.

        Returns:
            The turned body: centre of mass R c, tensor R I R^T. After a zero quaternion they
            are NaN and `result` is `invalid_position`.

        Raises:
            ValueError: Wrong shape (trace time).

        Gradients: finite for any non-zero quaternion.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> rod = jr.solids.rod(1.0, 2.0).translated(jnp.array([0.0, 0.0, 1.0]))
        >>> turned = rod.rotated(jr.rotation.exp(jnp.array([jnp.pi, 0.0, 0.0])))
        >>> print(turned.center_of_mass.round(6)[2])
        -1.0
        """
        center, tensor, attitude = float_arrays(self.center_of_mass, self.inertia, attitude)
        check_shape("attitude", attitude, (4,))
        turn = to_matrix(attitude)
        turned = product("ij,jk,lk->il", turn, tensor, turn)
        # The mark of an unphysical tensor, a diagonal without products, survives the turn.
        turned = jnp.where(_is_marked_unphysical(tensor), tensor, turned)
        return MassProperties(self.mass, product("ij,j->i", turn, center), turned, throw=None)

    def principal_axes(self) -> PrincipalAxes:
        """Principal moments and axes about the centre of mass; see `jrigid.principal_axes`."""
        return PrincipalAxes(*eigh(self.inertia))

    def __add__(self, other: "MassProperties") -> "MassProperties":
        """The two bodies rigidly joined."""
        if not isinstance(other, MassProperties):
            return NotImplemented
        mass_a, center_a, inertia_a, mass_b, center_b, inertia_b = float_arrays(
            self.mass, self.center_of_mass, self.inertia,
            other.mass, other.center_of_mass, other.inertia,
        )  # fmt: skip
        mass = mass_a + mass_b
        share = mass_b / mass
        apart = center_b - center_a
        inertia = inertia_a + inertia_b + mass_a * share * _unit_steiner(apart)
        return MassProperties(mass, center_a + share * apart, inertia, throw=None)

    def __radd__(self, other: int) -> "MassProperties":
        """Start of `sum`: 0 is no body."""
        if isinstance(other, int) and other == 0:
            return self
        return NotImplemented


def _as_tensor(inertia: Array) -> Matrix:
    return jnp.diag(inertia) if inertia.ndim == 1 else inertia


def _unit_steiner(displacement: Float[Array, "3"]) -> Matrix:
    x, y, z = displacement
    return jnp.stack(
        [
            jnp.stack([y * y + z * z, -x * y, -x * z]),
            jnp.stack([-x * y, x * x + z * z, -y * z]),
            jnp.stack([-x * z, -y * z, x * x + y * y]),
        ]
    )


def _is_marked_unphysical(tensor: Float[Array, "3 3"]) -> Bool[Array, ""]:
    return jnp.all(jnp.isfinite(jnp.diagonal(tensor))) & jnp.all(
        jnp.isnan(tensor) | jnp.eye(3, dtype=bool)
    )


@jax.jit
def _symmetric(tensor: Float[Array, "3 3"]) -> Bool[Array, ""]:
    return all_finite(tensor) & is_symmetric(tensor)


def _semidefinite(tensor: Float[Array, "3 3"], scale: Scalar) -> Bool[Array, ""]:
    """Whether no moment is below -64 ulps of a scale: Cholesky with diagonal pivots."""
    # A few ulps off at any moments, where the roots of the cubic lose half the digits.
    shift = _ULPS * jnp.finfo(tensor.dtype).eps * scale
    rest = tensor + shift * jnp.eye(3, dtype=tensor.dtype)
    left, fine = jnp.ones(3, bool), jnp.asarray(True)
    for _ in range(3):
        k = jnp.argmax(jnp.where(left, jnp.diagonal(rest), -jnp.inf))
        row, pivot = rest[k], rest[k, k]
        fine = fine & (pivot >= 0)
        rest = rest - row[:, None] * row[None, :] / jnp.where(pivot > 0, pivot, 1.0)
        left = left & (jnp.arange(3) != k)
    return fine


@jax.jit
def _physical(tensor: Float[Array, "3 3"]) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether a tensor is positive semi-definite, and whether I3 <= I1 + I2, to rounding."""
    tensor = jax.lax.stop_gradient(tensor)
    trace = jnp.trace(tensor)
    second = 0.5 * trace * jnp.eye(3, dtype=tensor.dtype) - tensor
    return _semidefinite(tensor, trace), _semidefinite(second, trace)


_NOT_A_BODY = (
    "Argument `inertia` must hold three finite, non-negative principal moments or be a finite, "
    "symmetric, positive semi-definite (3, 3) tensor, but it is not. (Three bodies are three "
    "lanes of `jax.vmap`, not the rows of a (3, 3) array.)"
)


def _judge(mass: Scalar, center_of_mass: Vector, tensor: Matrix) -> Findings:
    mass, center_of_mass, tensor = jax.lax.stop_gradient((mass, center_of_mass, tensor))
    findings = Findings()
    findings.require((mass > 0) & jnp.isfinite(mass), RESULTS.invalid_mass)
    findings.require(
        all_finite(center_of_mass),
        RESULTS.invalid_position,
        "Argument `center_of_mass` must be finite, but it is not.",
    )
    positive, triangle = _physical(tensor)
    findings.require(~_is_marked_unphysical(tensor), RESULTS.unphysical_inertia)
    findings.require(_symmetric(tensor) & positive, RESULTS.invalid_inertia, _NOT_A_BODY)
    findings.require(triangle, RESULTS.unphysical_inertia)
    return findings


def _answer(
    findings: Findings, body: tuple[Scalar, Vector, Matrix], throw: bool
) -> tuple[Scalar, Vector, Matrix]:
    """Raise, or turn what is wrong, and all that follows from it, into NaN.

    What is left finite lets `MassProperties.result` recover the code: of an unphysical tensor
    the diagonal, of an invalid one mass and centre, of an invalid position the mass.
    """
    if throw:
        return findings.apply(body, throw)
    mass, center_of_mass, tensor = body
    unphysical = findings.result == RESULTS.unphysical_inertia
    bad_tensor = unphysical | (findings.result == RESULTS.invalid_inertia)
    bad_center = ~findings.ok & ~bad_tensor
    bad_mass = bad_center & (findings.result != RESULTS.invalid_position)
    kept = findings.ok | (unphysical & jnp.eye(3, dtype=bool))
    return (
        jnp.where(bad_mass, jnp.nan, mass),
        jnp.where(bad_center, jnp.nan, center_of_mass),
        jnp.where(kept, tensor, jnp.nan),
    )


def _checked_tensor(inertia: ArrayLike, *others: ArrayLike) -> tuple[Array, ...]:
    inertia, *rest = float_arrays(inertia, *others)
    check_inertia_shape(inertia)
    tensor = _as_tensor(inertia)
    findings = Findings()
    findings.require(_symmetric(tensor), RESULTS.invalid_inertia, _NOT_SYMMETRIC)
    return (findings.apply(tensor, True), *rest)


_NOT_SYMMETRIC = (
    "Argument `inertia` must hold three finite principal moments or be a finite, symmetric (3, 3) "
    "tensor, but it is not. (Three bodies are three lanes of `jax.vmap`, not the rows of a (3, 3) "
    "array.)"
)


# Sums over points. Naive float32 sums of 10^6 terms lose four digits, and XLA's CPU reductions
# and products of tall thin matrices run below numpy's speed; lanes of partial sums mend both.
_LANES = 64


def _total(x: Float[Array, " points"]) -> Scalar:
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


def _inertia_of(second: Matrix) -> Matrix:
    return jnp.trace(second) * jnp.eye(3, dtype=second.dtype) - second


@jax.jit
def _cloud(masses: Array, positions: Array) -> tuple[Scalar, Vector, Matrix]:
    """Mass, centre, and tensor about the centre, by differences to a local origin."""
    mass = _total(masses)
    origin = jax.lax.stop_gradient(positions[0])
    local = positions - origin[None, :]
    divisor = jnp.where(mass == 0, 1.0, mass)
    center = jnp.stack([_total(masses * local[:, i]) for i in range(3)]) / divisor
    return mass, origin + center, _inertia_of(_second_moment(masses, local - center[None, :]))


@jax.jit
def _cloud_checks(masses: Array, positions: Array) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    fine = jnp.all(jnp.isfinite(masses) & (masses >= 0)) & jnp.any(masses > 0)
    return fine, all_finite(positions)


def _points(masses: ArrayLike, positions: ArrayLike) -> tuple[Array, Array, Findings]:
    masses, positions = float_arrays(masses, positions)
    check_shape("masses", masses, (None,))
    check_shape("positions", positions, (masses.shape[0], 3))
    if masses.shape[0] == 0:
        raise ValueError("Argument `masses` must hold at least one point, but it is empty.")
    findings = Findings()
    fine_masses, fine_positions = _cloud_checks(*jax.lax.stop_gradient((masses, positions)))
    findings.require(fine_masses, RESULTS.invalid_masses)
    findings.require(fine_positions, RESULTS.invalid_position)
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
    masses, positions, findings = _points(masses, positions)
    values = _answer(findings, _cloud(masses, positions), throw)
    return MassProperties(*values, throw=None)


def inertia_tensor(
    masses: Real[ArrayLike, " points"], positions: Real[ArrayLike, "points 3"]
) -> Matrix:
    r"""Inertia tensor of point masses about the origin of their coordinates.

    $I_{ab} = \sum_i m_i (|r_i|^2 \delta_{ab} - r_{ia} r_{ib})$.

    Args:
        masses: Point masses [kg], non-negative, not all zero.
        positions: Coordinates [m].

    Returns:
        Symmetric positive semi-definite tensor [kg m^2].

    Raises:
        ValueError: Wrong shapes or no points (trace time).
        RuntimeError: A mass is negative or not finite or all are zero, or a position is not
            finite (run time, any lane). `from_points` answers with a code instead.

    Gradients: finite everywhere.
    Source: Goldstein, Classical Mechanics, 3rd ed., eq. 5.7-5.8.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.inertia_tensor(jnp.array([2.0]), jnp.array([[0.0, 0.0, 3.0]])))
    [[18.  0.  0.]
     [ 0. 18.  0.]
     [ 0.  0.  0.]]
    """
    masses, positions, findings = _points(masses, positions)
    return findings.apply(_inertia_about_origin(masses, positions), True)


@jax.jit
def _inertia_about_origin(masses: Array, positions: Array) -> Matrix:
    return _inertia_of(_second_moment(masses, positions))


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
    half = 0.5 * (upper - lower)
    positions = 0.5 * (lower + upper)[None, :] + half[None, :] * jnp.asarray(grid, half.dtype)
    values = jax.vmap(density)(positions).astype(half.dtype)
    findings = Findings()
    fine = jnp.all(jnp.isfinite(values) & (values >= 0)) & jnp.any(values > 0)
    box = all_finite((lower, upper)) & jnp.all(lower < upper)
    findings.require(fine & box, RESULTS.invalid_density)
    masses = values * jnp.prod(half) * jnp.asarray(weights, half.dtype)
    return MassProperties(*_answer(findings, _cloud(masses, positions), throw), throw=None)


def _closed_numpy(faces: np.ndarray, vertices: int) -> bool:
    faces = faces.astype(np.int64)
    if faces.min() < 0 or faces.max() >= vertices:
        return False
    a, b, c = faces.T
    start, end = np.concatenate([a, b, c]), np.concatenate([b, c, a])
    low, high = np.minimum(start, end), np.maximum(start, end)
    edges = np.sort(2 * (low * vertices + high) + (start > end))
    forth, back = edges[::2], edges[1::2]
    # Sorted, every edge once forth and once back leaves no room for a third run or a point.
    return bool(edges.size % 2 == 0 and np.all(forth % 2 == 0) and np.all(back == forth + 1))


def _closed_traced(faces: Int[Array, "faces 3"], vertices: int) -> Bool[Array, ""]:
    if faces.shape[0] % 2:
        return jnp.asarray(False)
    a, b, c = faces.T
    start, end = jnp.concatenate([a, b, c]), jnp.concatenate([b, c, a])
    back = (start > end).astype(start.dtype)
    # Keys stay apart: their product overflows int32.
    low, high, back = jax.lax.sort(
        (jnp.minimum(start, end), jnp.maximum(start, end), back), num_keys=3
    )
    same = (low[::2] == low[1::2]) & (high[::2] == high[1::2])
    alternate = (back[::2] == 0) & (back[1::2] == 1)
    inside = jnp.all((faces >= 0) & (faces < vertices))
    return inside & jnp.all(same & alternate)


def _mesh(vertices: Array, faces: Any) -> tuple[Any, Bool[Array, ""]]:
    check_shape("vertices", vertices, (None, 3))
    if not eqx.is_array_like(faces):
        faces = np.asarray(faces)
    if is_concrete(faces):
        faces = np.asarray(faces)
    check_shape("faces", faces, (None, 3))
    if not jnp.issubdtype(faces.dtype, jnp.integer):
        raise ValueError(
            f"Argument `faces` must hold integers, but it holds {faces.dtype}: indices of vertices."
        )
    if faces.shape[0] == 0:
        raise ValueError("Argument `faces` must hold at least one face, but it is empty.")
    if isinstance(faces, np.ndarray):
        closed = _closed_numpy(faces, vertices.shape[0])
        return faces.astype(np.int32), jnp.asarray(closed)
    return faces, _closed_traced(faces, vertices.shape[0])


@jax.jit
def _mesh_integrals(vertices: Array, faces: Array) -> tuple[Scalar, Scalar, Vector, Matrix]:
    """Volume, sum of the absolute volumes of its tetrahedra, centre, second moment about it.

    The divergence theorem, as tetrahedra between the faces and an origin amid the vertices: the
    sums do not depend on it, so no derivative runs through it, and far bodies lose no digits.
    Source: Tonon, J. Math. Stat. 1 (2005) 8-11; Eberly, Polyhedral Mass Properties (2002).
    """
    finite = jnp.isfinite(vertices)
    count = jnp.maximum(jnp.sum(finite, axis=0), 1).astype(vertices.dtype)
    columns = [jnp.where(finite[:, i], vertices[:, i], 0.0) for i in range(3)]
    origin = jax.lax.stop_gradient(jnp.stack([_total(column) for column in columns]) / count)
    local = [vertices[:, i] - origin[i] for i in range(3)]
    a, b, c = ([x.at[faces[:, k]].get(mode="clip") for x in local] for k in range(3))
    six_volumes = (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
    s = [a[i] + b[i] + c[i] for i in range(3)]
    volume = _total(six_volumes) / 6
    magnitude = _total(jnp.abs(jax.lax.stop_gradient(six_volumes))) / 6
    first = jnp.stack([_total(six_volumes * s[i]) for i in range(3)]) / 24
    second = {
        (i, j): _total(six_volumes * (a[i] * a[j] + b[i] * b[j] + c[i] * c[j] + s[i] * s[j])) / 120
        for i in range(3)
        for j in range(i, 3)
    }
    center = first / jnp.where(volume == 0, 1.0, volume)
    matrix = jnp.stack(
        [jnp.stack([second[min(i, j), max(i, j)] for j in range(3)]) for i in range(3)]
    )
    about_center = matrix - volume * center[:, None] * center[None, :]
    return volume, magnitude, origin + center, about_center


_NOT_FINITE_VERTICES = "Argument `vertices` must be finite, but it is not."


def _mesh_findings(
    vertices: Array, closed: Bool[Array, ""], volume: Scalar, magnitude: Scalar
) -> Findings:
    volume, magnitude = jax.lax.stop_gradient((volume, magnitude))
    findings = Findings()
    findings.require(all_finite(vertices), RESULTS.invalid_position, _NOT_FINITE_VERTICES)
    findings.require(closed, RESULTS.open_mesh)
    rounding = _ULPS * jnp.finfo(vertices.dtype).eps * magnitude
    findings.require(volume > rounding, RESULTS.inside_out_mesh)
    return findings


def from_mesh(
    vertices: Real[ArrayLike, "vertices 3"],
    faces: Int[ArrayLike, "faces 3"],
    density: ScalarLike = 1.0,
    *,
    throw: bool = True,
) -> MassProperties:
    """Mass properties of a homogeneous body bounded by a closed triangle mesh; exact.

    Args:
        vertices: Coordinates of the corners [m]. Corners at one place must be one vertex.
        faces: Indices of the corners of each triangle, counter-clockwise seen from outside. A
            cavity is a surface of its own, counter-clockwise seen from inside the cavity. Known
            values are checked once, at trace time; traced ones by a sort at run time.
        density: Density [kg/m^3], positive.
        throw: False: bad values give NaN and a code in `.result` instead of an error;
            `mesh_validity` says what is wrong with the mesh.

    Returns:
        The body, its tensor about the centre of mass. Accurate far from the origin too.

    Raises:
        ValueError: Wrong shape, no faces, or indices that are no integers (trace time).
        RuntimeError: A vertex is not finite; an edge is not shared by exactly two faces that run
            through it in opposite directions (an open mesh, a flipped, repeated or degenerate
            face, an index out of range, three faces at an edge); the volume is not positive (inside
            out or flat); the tensor is not that of a real body (the surface cuts itself); the
            density is not positive and finite (run time, any lane).

    Gradients: exact in the vertices and the density.
    Source: Tonon, J. Math. Stat. 1 (2005) 8-11; Eberly, Polyhedral Mass Properties (2002).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> corners = jnp.array([[0.0, 0, 0], [6.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    >>> faces = jnp.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> body = jr.from_mesh(corners, faces)
    >>> print(body.mass, body.center_of_mass)
    1.0 [1.5  0.25 0.25]
    """
    vertices, density = float_arrays(vertices, density)
    check_shape("density", density, ())
    faces, closed = _mesh(vertices, faces)
    volume, magnitude, center, second = _mesh_integrals(vertices, faces)
    findings = _mesh_findings(vertices, closed, volume, magnitude)
    tensor = _inertia_of(second)
    # One NaN or inside-out lane must not be reported as unphysical too: the first finding wins.
    positive, triangle = _physical(tensor)
    findings.require(
        positive & triangle,
        RESULTS.inside_out_mesh,
        "Argument `faces` must describe a surface that does not cut itself and no part of which is "
        "inside out, but the tensor is not that of a real body.",
    )
    findings.require(
        (density > 0) & jnp.isfinite(density),
        RESULTS.invalid_density,
        "Argument `density` must be positive and finite, but it is not.",
    )
    values = _answer(findings, (density * volume, center, density * tensor), throw)
    return MassProperties(*values, throw=None)


def mesh_validity(
    vertices: Real[ArrayLike, "vertices 3"], faces: Int[ArrayLike, "faces 3"]
) -> RESULTS:
    """What `from_mesh` would find wrong with a mesh, as a code.

    Args:
        vertices: Coordinates of the corners [m].
        faces: Indices of the corners of each triangle.

    Returns:
        `successful`, `invalid_position`, `open_mesh` or `inside_out_mesh`, a code a lane.

    Raises:
        ValueError: Wrong shape, no faces, or indices that are no integers (trace time).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> corners = jnp.array([[0.0, 0, 0], [6.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    >>> inward = jnp.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    >>> jr.mass.mesh_validity(corners, inward) == jr.RESULTS.inside_out_mesh
    Array(True, dtype=bool)
    """
    (vertices,) = float_arrays(vertices)
    faces, closed = _mesh(vertices, faces)
    volume, magnitude, _, second = _mesh_integrals(vertices, faces)
    findings = _mesh_findings(vertices, closed, volume, magnitude)
    positive, triangle = _physical(_inertia_of(second))
    findings.require(positive & triangle, RESULTS.inside_out_mesh)
    return findings.result  # pyright: ignore[reportReturnType]


def parallel_axis(inertia_com: InertiaLike, mass: ScalarLike, displacement: VectorLike) -> Matrix:
    r"""Inertia tensor about a point displaced from the centre of mass.

    $I = I_{com} + m (|d|^2 1 - d d^T)$.

    Args:
        inertia_com: Moments or tensor about the centre of mass [kg m^2].
        mass: Mass [kg].
        displacement: Between centre of mass and point, either way round [m].

    Returns:
        Tensor about the point, same axes [kg m^2].

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: The tensor is not finite or not symmetric (run time, any lane).

    Gradients: polynomial, finite everywhere.
    Source: Goldstein, Classical Mechanics, 3rd ed., 5.3 (Steiner).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> d = jnp.array([0.0, 0.0, 2.0])
    >>> print(jnp.diag(jr.parallel_axis(jnp.array([1.0, 1.0, 0.0]), 3.0, d)))
    [13. 13.  0.]
    """
    tensor, mass, displacement = _checked_tensor(inertia_com, mass, displacement)
    check_shape("mass", mass, ())
    check_shape("displacement", displacement, (3,))
    return tensor + mass * _unit_steiner(displacement)


def to_center_of_mass(inertia: InertiaLike, mass: ScalarLike, displacement: VectorLike) -> Matrix:
    r"""Inertia tensor about the centre of mass, from that about a displaced point.

    The inverse of `parallel_axis`: $I_{com} = I - m (|d|^2 1 - d d^T)$.

    Args:
        inertia: Moments or tensor about the point [kg m^2].
        mass: Mass [kg].
        displacement: Between centre of mass and point, either way round [m].

    Returns:
        Tensor about the centre of mass, same axes [kg m^2].

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: The tensor is not finite or not symmetric, or less than `mass` at
            `displacement` has, so that a moment comes out negative (run time, any lane).

    Gradients: polynomial, finite everywhere.
    Source: Goldstein, Classical Mechanics, 3rd ed., 5.3 (Steiner).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> d = jnp.array([0.0, 0.0, 2.0])
    >>> print(jnp.diag(jr.to_center_of_mass(jnp.array([13.0, 13.0, 0.0]), 3.0, d)))
    [1. 1. 0.]
    """
    tensor, mass, displacement = _checked_tensor(inertia, mass, displacement)
    check_shape("mass", mass, ())
    check_shape("displacement", displacement, (3,))
    reduced = tensor - mass * _unit_steiner(displacement)
    fixed, trace = jax.lax.stop_gradient((reduced, jnp.trace(tensor)))
    return eqx.error_if(
        reduced,
        ~_semidefinite(fixed, trace),
        "Argument `inertia` must be at least that of `mass` at `displacement`, but a moment about "
        "the centre of mass comes out negative.",
    )


def principal_axes(inertia: InertiaLike, *, throw: bool = True) -> PrincipalAxes:
    """Principal moments and axes of an inertia tensor.

    Moments ascend; axes are the columns of a right-handed rotation. In axes 1 and 3 the first
    component that has at least 0.9 of the largest magnitude is positive, so that the signs do not
    hang on the last bit where two components tie; axis 2 completes the rotation.

    Args:
        inertia: Moments or tensor [kg m^2]; any finite symmetric tensor will do.
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        Moments and axes, tensor = axes diag(moments) axes^T to a few ulps of the largest.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: The tensor is not finite or not symmetric (run time, any lane).

    Gradients: d moments = diag(axes^T dI axes). First derivatives of symmetric functions of
    the moments (`sum(1 / moments)`) are right everywhere, repeated moments included. The moments
    one by one, and the axes, have no derivative where moments repeat: there d axes is finite and
    leaves out the axes of equal moments, so functions composed of moments and axes by hand, and
    second derivatives, cannot be right there. Use `tensor_function` for them.
    Source: Golub and Van Loan, Matrix Computations, 4th ed., 8.5 (Jacobi).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.principal_axes(jnp.array([3.0, 1.0, 2.0])).moments)
    [1. 2. 3.]
    """
    (inertia,) = float_arrays(inertia)
    check_inertia_shape(inertia)
    tensor = _as_tensor(inertia)
    findings = Findings()
    findings.require(_symmetric(tensor), RESULTS.invalid_inertia, _NOT_SYMMETRIC)
    tensor = findings.apply(tensor, throw)
    return PrincipalAxes(*eigh(jnp.where(findings.ok, tensor, jnp.nan)))


def tensor_function(f: Callable[[Any], Any], inertia: InertiaLike) -> Matrix:
    """Function of a tensor, axes diag(f(moments)) axes^T, with derivatives right everywhere.

    Args:
        f: Maps a scalar to a scalar, smooth on the range of the moments, by jax operations;
            forward-differentiable. It may close over parameters that are differentiated. Across
            gaps below a tenth of a moment its derivatives are integrated with eight nodes.
        inertia: Moments or tensor [kg m^2]; any finite symmetric tensor in the domain of f.

    Returns:
        Symmetric tensor in the units of f.

    Raises:
        ValueError: Wrong shape, or f does not map scalars to scalars (trace time).
        RuntimeError: The tensor is not finite or not symmetric (run time, any lane).
        NotImplementedError: A third derivative in the tensor (trace time).

    Gradients: first and second, in every mode, in the tensor and in what f closes over, right at
    repeated and nearly repeated moments (divided differences), where moments and axes composed by
    hand give NaN or finite wrong numbers. So are those of its trace.
    Source: Higham, Functions of Matrices (2008), theorem 3.11 (Daleckii and Krein).

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> trace = lambda inertia: jnp.trace(jr.tensor_function(jnp.sqrt, inertia))
    >>> print(jax.grad(trace)(4 * jnp.eye(3)))
    [[0.25 0.   0.  ]
     [0.   0.25 0.  ]
     [0.   0.   0.25]]
    """
    (tensor,) = _checked_tensor(inertia)
    moment = jax.ShapeDtypeStruct((), tensor.dtype)
    shape = jax.eval_shape(f, moment)
    if getattr(shape, "shape", None) != () or shape.dtype != tensor.dtype:
        raise ValueError(f"Argument `f` must map {moment} to the same, but it gives {shape}.")
    hoisted, parameters = jax.closure_convert(f, jnp.zeros((), tensor.dtype))
    return spectral_function(hoisted, tensor, *parameters)
