"""The symmetric top: its three numbers, where they come from, and the way into its formulas."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jrigid._checks import (
    Findings,
    all_finite,
    all_positive,
    array_of_shape,
    check_type,
    harmless,
    is_unit,
    shaped,
    where_defined,
)
from jrigid._motion import plain_state
from jrigid._types import Readable, VectorLike
from jrigid.dynamics import State
from jrigid.mass import MassProperties
from jrigid.systems import RigidBody
from jrigid.torques import UniformGravity

Answer = TypeVar("Answer")
_STANDARD_GRAVITY = 9.80665  # [m/s^2]
_ELSE = "For any other body use `RigidBody` under `torques.UniformGravity`.)"
_NOT_SYMMETRIC = (
    "Argument `body` must have an inertia symmetric about its axis 3, but it has not. (Shown are "
    f"I11, I22, I12, I13, I23. {_ELSE}"
)
_NOT_ON_AXIS = f"Argument `lever` must lie along body axis 3, but it does not. ({_ELSE}"
_NOT_VERTICAL = "Argument `gravity` must lie along z in space, but it does not."


class SymmetricTop(Readable):
    """A heavy top, symmetric about body axis 3, with a fixed point on that axis (Lagrange's top).

    Gravity pulls along -z in space. For many tops `jax.vmap` over the numbers, or over a top whose
    leaves have a leading axis.

    Attributes:
        I1: Moment about a transverse axis through the fixed point, positive [kg m^2].
        I3: Moment about the axis, positive [kg m^2].
        mgl: Weight times the distance of the centre of mass from the fixed point along axis 3
            [N m]; negative where the centre of mass is on the negative side, or gravity pulls up.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(I1=2e-3, I3=1e-3, mgl=0.2)
    >>> print(top, jr.top.sleeping_spin(top).round(6))
    SymmetricTop(I1=0.002, I3=0.001, mgl=0.2) 40.0
    """

    I1: Float[Array, ""] = eqx.field(converter=lambda x: _scalar("I1", x))
    I3: Float[Array, ""] = eqx.field(converter=lambda x: _scalar("I3", x))
    mgl: Float[Array, ""] = eqx.field(converter=lambda x: _scalar("mgl", x))

    @classmethod
    def from_mass_properties(
        cls,
        body: MassProperties,
        lever: VectorLike,
        gravity: VectorLike | None = None,
        *,
        throw: bool = True,
    ) -> "SymmetricTop":
        """The top that a body makes when one of its points is held.

        Args:
            body: Mass properties, about the centre of mass; symmetric about body axis 3.
            lever: From the fixed point to the centre of mass, along axis 3, body components [m].
            gravity: Acceleration of gravity, along z, space components [m/s^2]; standard gravity,
                9.80665 along -z, by default.
            throw: False: bad values give NaN instead of an error.

        Returns:
            The top, its moments about the fixed point (parallel axes).

        Raises:
            RuntimeError: A body that is not symmetric, a lever or gravity off its axis by more
                than 1e-8 (float32: 3e-4) of its size.

        Gradients: linear in mass, moments and gravity, quadratic in the lever.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> cone = jr.solids.cone(0.5, 0.03, 0.08)  # its tip is 0.06 above the centre of mass
        >>> tip_down = cone.rotated(jr.rotation.exp(jnp.array([jnp.pi, 0.0, 0.0])))
        >>> top = jr.SymmetricTop.from_mass_properties(tip_down, jnp.array([0.0, 0.0, 0.06]))
        >>> print(top.I1.round(7), top.mgl.round(4))
        0.0019875 0.2942
        """
        check_type("body", body, MassProperties)
        if gravity is None:
            gravity = jnp.array([0.0, 0.0, -_STANDARD_GRAVITY], body.mass.dtype)
        mass, inertia, lever, gravity = shaped(
            mass=(body.mass,),
            inertia=(body.inertia, 3, 3),
            lever=(lever, 3),
            gravity=(gravity, 3),
        )
        (a, d, e), (_, b, f), (_, _, c) = inertia
        tolerance = jnp.sqrt(jnp.finfo(mass.dtype).eps)
        size = jnp.maximum(a + b + c, mass * lever[2] ** 2)
        symmetric = jnp.max(jnp.abs(jnp.stack([a - b, d, e, f]))) <= tolerance * size
        findings = Findings()
        findings.require(symmetric, None, _NOT_SYMMETRIC, jnp.stack([a, b, d, e, f]))
        for value, message in ((lever, _NOT_ON_AXIS), (gravity, _NOT_VERTICAL)):
            off = jnp.max(jnp.abs(value[:2])) > tolerance * jnp.abs(value[2])
            findings.require(all_finite(value) & ~off, None, message, value)
        across, c, mass, length, pull = harmless(
            findings.ok, (0.5 * (a + b), c, mass, lever[2], gravity[2])
        )
        top = cls(across + mass * length * length, c, -mass * pull * length)
        return findings.guard(top, throw)

    def as_rigid_body(self) -> RigidBody:
        """The same top for `jrigid.simulate`: a `RigidBody` under `UniformGravity`.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> body = jr.SymmetricTop(1.0, 0.5, 2.0).as_rigid_body()
        >>> print(body.inertia, body.torque.lever)
        [1.  1.  0.5] [0. 0. 2.]
        """
        lever = jnp.pad(self.mgl[None], (2, 0))
        gravity = UniformGravity(1.0, lever, jnp.array([0.0, 0.0, -1.0]))
        return RigidBody(jnp.stack([self.I1, self.I1, self.I3]), gravity)

    @property
    def is_valid(self) -> Bool[Array, ""]:
        """True where the moments are positive and all is finite: the domain of every formula."""
        return all_positive((self.I1, self.I3)) & all_finite(self.mgl)


def _scalar(name: str, value: Any) -> Any:
    return (
        None if value is None else array_of_shape(name, value)
    )  # None: an axis of vmap


def where_valid(
    formula: Callable[..., Answer], top: SymmetricTop, **scalars: Any
) -> Answer:
    """A formula of I1, I3, mgl and scalars, in one dtype; NaN where any is outside its domain."""
    check_type("top", top, SymmetricTop)
    numbers = shaped(
        **{name: (value,) for name, value in (vars(top) | scalars).items()}
    )
    return where_defined(top.is_valid & all_finite(numbers), formula, *numbers)


def of_motion(
    formula: Callable[[SymmetricTop, State], Answer], top: SymmetricTop, state: State
) -> Answer:
    """A formula of a top and its state; NaN where one of them is not valid."""
    check_type("top", top, SymmetricTop)
    state, numbers = plain_state("state", state, top.I1, top.I3, top.mgl)
    top = SymmetricTop(*numbers)
    ok = top.is_valid & all_finite(state) & is_unit(state.attitude)
    return where_defined(ok, formula, top, state)
