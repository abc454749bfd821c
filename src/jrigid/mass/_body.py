"""The mass properties of a body: checks, composition, motion."""

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_inertia_shape,
    check_shape,
    float_arrays,
    nan_where,
)
from jrigid._numerics import product
from jrigid._spectral import eigh
from jrigid._types import (
    InertiaLike,
    Matrix,
    Quaternion,
    QuaternionLike,
    ScalarLike,
    Vector,
    VectorLike,
)
from jrigid.mass._validity import Body, find, judge, raise_or_mark
from jrigid.rotation import to_matrix


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
        tensor = as_tensor(inertia)
        if throw is not None:
            findings = judge(mass, center_of_mass, tensor)
            mass, center_of_mass, tensor = raise_or_mark(
                findings, (mass, center_of_mass, tensor), throw
            )
        self.mass = mass
        self.center_of_mass = center_of_mass
        self.inertia = 0.5 * tensor + 0.5 * tensor.T

    @property
    def result(self) -> RESULTS:
        """Code of what these values are, computed when asked.

        `successful`, `invalid_mass`, `invalid_position`, `invalid_inertia`,
        `unphysical_inertia`, `invalid_length` (of a solid), `invalid_attitude` (of `rotated`),
        `invalid_masses` (of points), `invalid_density`, `open_mesh` or `inside_out_mesh`; one code
        a lane where the leaves carry batch axes.
        """
        code = lambda *body: judge(*body).result  # noqa: E731
        for _ in range(self.mass.ndim):
            code = jax.vmap(code)
        return code(self.mass, self.center_of_mass, self.inertia)  # pyright: ignore[reportReturnType]

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
        *body, point = float_arrays(self.mass, self.center_of_mass, self.inertia, point)
        return _about(body, point)

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
        *body, displacement = float_arrays(
            self.mass, self.center_of_mass, self.inertia, displacement
        )
        return MassProperties(*_translated(body, displacement), throw=None)

    def rotated(self, attitude: QuaternionLike) -> "MassProperties":
        """The body turned about the origin of the coordinates.

        Args:
            attitude: Quaternion of the turn, any but zero; its norm drops out.

        Returns:
            The turned body: centre of mass R c, tensor R I R^T. After a zero quaternion the
            centre and moments are NaN and `result` is `invalid_attitude`.

        Raises:
            ValueError: Wrong shape (trace time).

        Gradients: finite for any non-zero quaternion.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> rod = jr.solids.rod(1.0, 2.0).translated(jnp.array([0.0, 0.0, 1.0]))
        >>> turned = rod.rotated(jr.rotation.exp(jnp.array([jnp.pi, 0.0, 0.0])))
        >>> print(turned.center_of_mass.round(6)[2])
        -1.0
        """
        *body, attitude = float_arrays(self.mass, self.center_of_mass, self.inertia, attitude)
        check_shape("attitude", attitude, (4,))
        return MassProperties(*_rotated(body, attitude), throw=None)

    def principal_axes(self) -> PrincipalAxes:
        """Principal moments and axes about the centre of mass; see `jrigid.principal_axes`.

        Returns:
            Moments and axes; NaN where the tensor is.

        Gradients: as those of `jrigid.principal_axes`.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> box = jr.solids.box(12.0, jnp.array([1.0, 2.0, 3.0]))
        >>> print(box.principal_axes().moments)
        [ 5. 10. 13.]
        """
        return PrincipalAxes(*eigh(self.inertia))

    def __add__(self, other: "MassProperties") -> "MassProperties":
        """The two bodies rigidly joined."""
        if not isinstance(other, MassProperties):
            return NotImplemented
        leaves = float_arrays(
            self.mass, self.center_of_mass, self.inertia,
            other.mass, other.center_of_mass, other.inertia,
        )  # fmt: skip
        return MassProperties(*_joined(list(leaves[:3]), list(leaves[3:])), throw=None)

    def __radd__(self, other: int) -> "MassProperties":
        """Start of `sum`: 0 is no body."""
        if isinstance(other, int) and other == 0:
            return self
        return NotImplemented


def as_tensor(inertia: Array) -> Matrix:
    return jnp.diag(inertia) if inertia.ndim == 1 else inertia


def unit_steiner(displacement: Float[Array, "3"]) -> Matrix:
    x, y, z = displacement
    return jnp.stack(
        [
            jnp.stack([y * y + z * z, -x * y, -x * z]),
            jnp.stack([-x * y, x * x + z * z, -y * z]),
            jnp.stack([-x * z, -y * z, x * x + y * y]),
        ]
    )


# Derivatives of NaN are NaN, even those that a mask multiplies by zero: what shares a lane with
# bad values would lose its gradient in all lanes. So bad values do not enter the arithmetic.
def _harmless(ok: Bool[Array, ""], body: list[Array]) -> Body:
    mass, center_of_mass, tensor = body
    eye = jnp.eye(3, dtype=tensor.dtype)
    return (
        jnp.where(ok, mass, 1.0),
        jnp.where(ok, center_of_mass, 0.0),
        jnp.where(ok, tensor, eye),
    )


def _examined(
    *bodies: list[Array], also: tuple[Bool[Array, ""], RESULTS] | None = None
) -> tuple[Findings, list[Body]]:
    """What is wrong with bodies, or else with `also`, and the bodies made harmless."""
    findings = Findings()
    for body in bodies:
        find(findings, *body)
    if also is not None:
        findings.require(*also)
    return findings, [_harmless(findings.ok, body) for body in bodies]


@jax.jit
def _about(body: list[Array], point: Vector) -> Matrix:
    also = all_finite(point), RESULTS.invalid_position
    findings, [(mass, center, tensor)] = _examined(body, also=also)
    point = jnp.where(findings.ok, point, 0.0)
    return nan_where(~findings.ok, tensor + mass * unit_steiner(point - center))


@jax.jit
def _translated(body: list[Array], displacement: Vector) -> Body:
    also = all_finite(displacement), RESULTS.invalid_position
    findings, [(mass, center, tensor)] = _examined(body, also=also)
    return raise_or_mark(findings, (mass, center + displacement, tensor), False)


@jax.jit
def _rotated(body: list[Array], attitude: Quaternion) -> Body:
    turnable = all_finite(attitude) & jnp.any(attitude != 0)
    also = turnable, RESULTS.invalid_attitude
    findings, [(mass, center, tensor)] = _examined(body, also=also)
    turn = to_matrix(jnp.where(turnable, attitude, 1.0))
    turned = product("ij,jk,lk->il", turn, tensor, turn)
    return raise_or_mark(findings, (mass, product("ij,j->i", turn, center), turned), False)


@jax.jit
def _joined(body_a: list[Array], body_b: list[Array]) -> Body:
    findings, bodies = _examined(body_a, body_b)
    (mass_a, center_a, tensor_a), (mass_b, center_b, tensor_b) = bodies
    mass = mass_a + mass_b
    share = mass_b / mass
    apart = center_b - center_a
    tensor = tensor_a + tensor_b + mass_a * share * unit_steiner(apart)
    return raise_or_mark(findings, (mass, center_a + share * apart, tensor), False)
