"""The symmetric top: its three numbers, and helpers that apply formulas to it."""

from collections.abc import Callable
from typing import TypeVar, final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jrigid._checks import (
    Findings,
    all_finite,
    all_positive,
    check_type,
    harmless,
    is_unit,
    shaped,
    where_defined,
)
from jrigid._motion_inputs import plain_state
from jrigid._types import Readable, ScalarLike, VectorLike
from jrigid.dynamics import State
from jrigid.mass import MassProperties
from jrigid.systems import RigidBody
from jrigid.torques import UniformGravity

Answer = TypeVar("Answer")

_STANDARD_GRAVITY = 9.80665  # [m/s^2]
_BAD_MOMENT = "Argument `{}` must be positive and finite, but it is not."
_BAD_WEIGHT = "Argument `mgl` must be finite, but it is not."
_OTHER_BODIES = "For any other body use `RigidBody` under `torques.UniformGravity`.)"
_NOT_SYMMETRIC = (
    "Argument `body` must have an inertia symmetric about its axis 3, but it has not. "
    f"(Shown are I11, I22, I12, I13, I23. {_OTHER_BODIES}"
)
_NOT_ON_AXIS = (
    f"Argument `lever` must lie along body axis 3, but it does not. ({_OTHER_BODIES}"
)
_NOT_VERTICAL = "Argument `gravity` must lie along z in space, but it does not."


@final
class SymmetricTop(Readable):
    """A heavy top with a fixed point on its axis of symmetry (Lagrange's top).

    The axis of symmetry is body axis 3. Gravity acts along -z in space. For many tops,
    use `jax.vmap` over the numbers, or over a top whose arrays have a leading axis.

    Attributes:
        I1: Moment about a transverse axis through the fixed point [kg m^2].
        I3: Moment about the axis of symmetry [kg m^2].
        mgl: Weight times the distance of the centre of mass from the fixed point along
            axis 3 [N m]. It is negative if the centre of mass is on the negative side
            of the axis, or if gravity acts upwards. Zero is a free body.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(I1=2e-3, I3=1e-3, mgl=0.2)
    >>> print(top, jr.top.sleeping_spin(top).round(6))
    SymmetricTop(I1=0.002, I3=0.001, mgl=0.2) 40.0
    """

    I1: Float[Array, ""]
    I3: Float[Array, ""]
    mgl: Float[Array, ""]

    def __init__(self, I1: ScalarLike, I3: ScalarLike, mgl: ScalarLike) -> None:
        """Check and store the three numbers, in one dtype.

        Args:
            I1: Moment about a transverse axis, positive and finite [kg m^2].
            I3: Moment about the axis of symmetry, positive and finite [kg m^2].
            mgl: Weight times distance, finite and of any sign [N m].

        Raises:
            RuntimeError: A moment is not positive, or a value is not finite. Use
                `unchecked` where bad lanes of a batch shall give NaN instead.

        Gradients: the identity.
        """
        values = shaped(I1=(I1,), I3=(I3,), mgl=(mgl,))
        findings = Findings()
        _require_valid(findings, *jax.lax.stop_gradient(values))
        self.I1, self.I3, self.mgl = findings.guard(values, throw=True)

    @classmethod
    def unchecked(
        cls, I1: ScalarLike, I3: ScalarLike, mgl: ScalarLike
    ) -> "SymmetricTop":
        """The top of three numbers that are not checked, for batches with bad lanes.

        Every formula checks its top: it gives NaN where `is_valid` is False.

        Args:
            I1: Moment about a transverse axis [kg m^2].
            I3: Moment about the axis of symmetry [kg m^2].
            mgl: Weight times distance [N m].

        Returns:
            The top.

        Gradients: the identity.

        >>> import jax, jax.numpy as jnp, jrigid as jr
        >>> tops = jax.vmap(lambda I1: jr.SymmetricTop.unchecked(I1, 0.5, 1.0))
        >>> print(jax.vmap(jr.top.sleeping_spin)(tops(jnp.array([1.0, -1.0]))))
        [ 4. nan]
        """
        # equinox forbids a second constructor and assignments outside of the first.
        top = object.__new__(cls)
        values = shaped(I1=(I1,), I3=(I3,), mgl=(mgl,))
        for name, value in zip(("I1", "I3", "mgl"), values, strict=True):
            object.__setattr__(top, name, value)
        return top

    @classmethod
    def from_mass_properties(
        cls,
        body: MassProperties,
        lever: VectorLike,
        gravity: VectorLike | None = None,
        *,
        throw: bool = True,
    ) -> "SymmetricTop":
        """Build the top that a body becomes when one of its points is held.

        Args:
            body: Mass properties of a body that is symmetric about body axis 3.
            lever: Vector from the fixed point to the centre of mass, along axis 3,
                in body components [m].
            gravity: Acceleration of gravity, along z, in space components [m/s^2]. The
                default is standard gravity, 9.80665 along -z.
            throw: With False, bad values give NaN instead of an error.

        Returns:
            The top. Its moments are those about the fixed point (parallel axes).

        Raises:
            RuntimeError: The body is not symmetric, the lever or gravity is off its
                axis by more than 1e-8 (float32: 3e-4) of its size, or a moment about
                the fixed point is zero.

        Gradients: linear in mass, moments and gravity, quadratic in the lever.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> cone = jr.solids.cone(0.5, 0.03, 0.08)  # tip 0.06 above the centre of mass
        >>> tip_down = cone.rotated(jr.rotation.exp(jnp.array([jnp.pi, 0.0, 0.0])))
        >>> lever = jnp.array([0.0, 0.0, 0.06])
        >>> top = jr.SymmetricTop.from_mass_properties(tip_down, lever)
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
        findings = Findings()
        _require_symmetry(findings, mass, inertia, lever, gravity)
        # The two may differ within the tolerance.
        transverse = 0.5 * (inertia[0, 0] + inertia[1, 1])
        transverse, axial, mass, length, pull = harmless(
            findings.ok, (transverse, inertia[2, 2], mass, lever[2], gravity[2])
        )
        # `pull` is negative where gravity acts along -z. The sign makes mgl positive
        # for a centre of mass on the positive side of axis 3.
        numbers = transverse + mass * length * length, axial, -mass * pull * length
        _require_valid(findings, *jax.lax.stop_gradient(numbers))
        return findings.guard(cls.unchecked(*numbers), throw)

    def as_rigid_body(self) -> RigidBody:
        """The same top for `jrigid.simulate`: a `RigidBody` under `UniformGravity`.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> body = jr.SymmetricTop(1.0, 0.5, 2.0).as_rigid_body()
        >>> print(body.inertia, body.torque.lever)
        [1.  1.  0.5] [0. 0. 2.]
        """
        lever = jnp.pad(self.mgl[None], (2, 0))
        # The motion depends on the product mgl alone, which is the lever at unit mass
        # and gravity.
        gravity = UniformGravity(1.0, lever, jnp.array([0.0, 0.0, -1.0]))
        return RigidBody(jnp.stack([self.I1, self.I1, self.I3]), gravity)

    @property
    def is_valid(self) -> Bool[Array, ""]:
        """True where all numbers are finite and the moments are positive.

        That is the domain of every formula of a top. Only a top that is `unchecked`, or
        whose arrays were replaced later, can be outside of it.
        """
        return all_positive((self.I1, self.I3)) & all_finite(self.mgl)


def _require_valid(findings: Findings, i1: Array, i3: Array, mgl: Array) -> None:
    """Note which of the three numbers no top has."""
    for name, moment in (("I1", i1), ("I3", i3)):
        findings.require(all_positive(moment), None, _BAD_MOMENT.format(name), moment)
    findings.require(all_finite(mgl), None, _BAD_WEIGHT, mgl)


def _require_symmetry(
    findings: Findings, mass: Array, inertia: Array, lever: Array, gravity: Array
) -> None:
    """Note whether the body is symmetric about axis 3, and lever and gravity fit it."""
    (a, d, e), (_, b, f), (_, _, c) = inertia
    tolerance = jnp.sqrt(jnp.finfo(mass.dtype).eps)
    # The moments of the top are about the fixed point, so that m l^2 is part of their
    # size.
    size = jnp.maximum(a + b + c, mass * lever[2] ** 2)
    uneven = jnp.stack([a - b, d, e, f])
    symmetric = jnp.max(jnp.abs(uneven)) <= tolerance * size
    findings.require(symmetric, None, _NOT_SYMMETRIC, jnp.stack([a, b, d, e, f]))
    for value, message in ((lever, _NOT_ON_AXIS), (gravity, _NOT_VERTICAL)):
        off_axis = jnp.max(jnp.abs(value[:2])) > tolerance * jnp.abs(value[2])
        findings.require(all_finite(value) & ~off_axis, None, message, value)


def where_valid(
    formula: Callable[..., Answer], top: SymmetricTop, **scalars: ScalarLike
) -> Answer:
    """Apply a formula of I1, I3, mgl and scalars; NaN outside its domain.

    All arguments of the formula have one dtype.
    """
    check_type("top", top, SymmetricTop)
    arguments = {name: (value,) for name, value in (vars(top) | scalars).items()}
    numbers = shaped(**arguments)
    return where_defined(top.is_valid & all_finite(numbers), formula, *numbers)


def of_motion(
    formula: Callable[[SymmetricTop, State], Answer], top: SymmetricTop, state: State
) -> Answer:
    """Apply a formula of a top and its state; NaN where one of them is not valid."""
    check_type("top", top, SymmetricTop)
    state, numbers = plain_state("state", state, top.I1, top.I3, top.mgl)
    top = SymmetricTop.unchecked(*numbers)
    ok = top.is_valid & all_finite(state) & is_unit(state.attitude)
    return where_defined(ok, formula, top, state)
