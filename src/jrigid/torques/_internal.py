"""Torques of internal parts with a momentum of their own: a damper, a rotor."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jrigid._checks import RESULTS, Findings, array_of_shape, check_shape, float_arrays
from jrigid._numerics import safe_norm
from jrigid._types import Scalar, ScalarLike, Vector, VectorLike
from jrigid.torques._base import AbstractTorque, TorqueFunction, require_finite, zero_like


def _require_moment(findings: Findings, part: Any) -> None:
    inertia = jax.lax.stop_gradient(part.inertia)
    findings.require(
        jnp.isfinite(inertia) & (inertia > 0),
        RESULTS.invalid_torque,
        f"Argument `inertia` of `{type(part).__name__}` must be positive and finite, but it is "
        "not.",
    )


class InternalDamper(AbstractTorque):
    """A sphere inside the body, coupled to it by a viscous layer.

    The sphere has an angular velocity of its own; the layer exerts c (omega_sphere - omega) on
    the body and the opposite on the sphere. The total angular momentum in space is constant, the
    energy falls at the rate c |omega_sphere - omega|^2. `State.internal` is omega_sphere, the
    absolute angular velocity of the sphere in the components of the body's axes [rad/s]; by
    default the sphere starts at rest relative to the body. The inertia of the body does not
    include the sphere's own.

    Attributes:
        inertia: Moment of inertia of the sphere [kg m^2].
        coupling: c [N m s].

    Raises:
        ValueError: Wrong shape (trace time). Values (finite, inertia positive, coupling not
            negative) are checked by `simulate`.

    Gradients: finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]), jr.torques.InternalDamper(0.2, 0.05))
    >>> sphere = jnp.array([0.0, 0.0, 3.0])
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0]), sphere)
    >>> print(body.torque(0.0, state, None).round(6))
    [0.  0.  0.1]
    """

    inertia: Float[Array, ""] = eqx.field(converter=lambda x: array_of_shape("inertia", x))
    coupling: Float[Array, ""] = eqx.field(converter=lambda x: array_of_shape("coupling", x))

    def __call__(self, t: ScalarLike, state: Any, args: Any) -> Vector:
        """Torque on the body [N m], body components."""
        del t, args
        return self.coupling.astype(state.omega.dtype) * (state.internal - state.omega)

    def internal_at_rest(self, state: Any) -> PyTree:
        """The sphere turning with the body."""
        return state.omega

    def internal_rate(self, t: ScalarLike, state: Any, args: Any) -> PyTree:
        """Rate of the sphere's angular velocity, in the turning axes of the body."""
        pull = self(t, state, args) / self.inertia.astype(state.omega.dtype)
        return -pull - jnp.cross(state.omega, state.internal)

    def internal_scale(self, rate: Scalar) -> PyTree:
        """The sphere turns about as fast as the body."""
        return rate

    def internal_momentum(self, t: ScalarLike, state: Any, args: Any) -> Vector:
        """Angular momentum of the sphere [kg m^2/s]."""
        del t, args
        return self.inertia.astype(state.omega.dtype) * state.internal

    def internal_energy(self, t: ScalarLike, state: Any, args: Any) -> Scalar:
        """Kinetic energy of the sphere [J]."""
        del t, args
        return 0.5 * self.inertia.astype(state.omega.dtype) * jnp.sum(state.internal**2)

    def check(self, findings: Findings) -> None:
        """Note an inertia that is not positive and a coupling that is negative."""
        _require_moment(findings, self)
        coupling = jax.lax.stop_gradient(self.coupling)
        findings.require(
            jnp.isfinite(coupling) & (coupling >= 0),
            RESULTS.invalid_torque,
            "Argument `coupling` of `InternalDamper` must be finite and not negative, but it is "
            "not.",
        )


class SpinningMass(eqx.Module):
    """A wheel with a spin of its own, for `Rotor`.

    Attributes:
        inertia: Moment of inertia about its axis [kg m^2].
        axis: Direction of the axis, body components, of any length.
        motor_torque: `(t, state, args) -> ()` torque of the motor on the wheel [N m], or None: the
            wheel turns freely on its axis.

    Raises:
        ValueError: Wrong shape (trace time). Values (a positive, finite inertia, an axis that is
            finite and not zero) are checked by `simulate`.

    Gradients: finite for any axis but zero.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> wheel = jr.torques.SpinningMass(0.2, jnp.array([0.0, 3.0, 4.0]))
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3), jnp.array(10.0))
    >>> print(jr.torques.Rotor(wheel).internal_momentum(0.0, state, None).round(6))
    [0.  1.2 1.6]
    """

    inertia: Float[Array, ""]
    axis: Float[Array, "3"]
    motor_torque: TorqueFunction | None

    def __init__(
        self,
        inertia: ScalarLike,
        axis: VectorLike,
        motor_torque: TorqueFunction | None = None,
    ):
        """A wheel.

        Args:
            inertia: Moment of inertia about its axis [kg m^2].
            axis: Direction of the axis, body components.
            motor_torque: Torque of the motor on the wheel [N m].

        Raises:
            ValueError: Wrong shape (trace time). Values are checked by `simulate`.
        """
        self.inertia, axis = float_arrays(inertia, axis)
        check_shape("inertia", self.inertia, ())
        check_shape("axis", axis, (3,))
        self.axis = axis / safe_norm(axis)
        self.motor_torque = motor_torque

    def check(self, findings: Findings) -> None:
        """Note an inertia that is not positive and an axis that has no direction."""
        _require_moment(findings, self)
        axis = jax.lax.stop_gradient(self.axis)
        findings.require(
            jnp.all(jnp.isfinite(axis)) & jnp.any(axis != 0),  # a zero axis normalised is NaN
            RESULTS.invalid_torque,
            "Argument `axis` of `SpinningMass` must be finite and not zero, but it is not.",
        )


class Rotor(AbstractTorque):
    """A rotor inside the body (a gyrostat): prescribed momentum, or a wheel with its own spin.

    With a prescribed momentum h (an array, or a function of time, in body components, relative to
    the body) the torque on the body is -h' - omega x h and the body's inertia includes the locked
    rotor. With a `SpinningMass` of axial moment J the wheel's absolute spin s about its axis a is
    `State.internal` [rad/s], J s' = motor torque, and the body's inertia includes the wheel except
    for J about a; by default the wheel starts at rest relative to the body.

    Attributes:
        momentum: h [kg m^2/s] as an array or `h(t)`, or a `SpinningMass`.

    Raises:
        ValueError: Wrong shape (trace time; of a function, when called). That an array is finite
            is checked by `simulate`.

    Gradients: finite everywhere; a function of time must be differentiable.
    Source: Hughes, Spacecraft Attitude Dynamics (1986), chapter 6.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> rotor = jr.torques.Rotor(jnp.array([0.0, 0.5, 0.0]))
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 0.0, 0.0]))
    >>> print(rotor(0.0, state, None))
    [-0.  -0.  -0.5]
    """

    momentum: Any

    def __init__(self, momentum: Any):
        """A rotor.

        Args:
            momentum: (3,) array [kg m^2/s], `momentum(t) -> (3,)`, or a `SpinningMass`.

        Raises:
            ValueError: Wrong shape (trace time). Values are checked by `simulate`.
        """
        if isinstance(momentum, SpinningMass) or callable(momentum):
            self.momentum = momentum
        else:
            self.momentum = array_of_shape("momentum", momentum, 3)

    @property
    def _wheel(self) -> SpinningMass | None:
        return self.momentum if isinstance(self.momentum, SpinningMass) else None

    def _momentum_and_rate(self, t: ScalarLike, state: Any, args: Any) -> tuple[Array, Array]:
        dtype = state.omega.dtype
        wheel = self._wheel
        if wheel is not None:
            axis = wheel.axis.astype(dtype)
            motor = self._motor(t, state, args)
            return wheel.inertia.astype(dtype) * state.internal * axis, motor * axis
        if callable(self.momentum):
            time = jnp.asarray(t, dtype)
            value, rate = jax.jvp(
                lambda s: jnp.asarray(self.momentum(s), dtype), (time,), (jnp.ones_like(time),)
            )
            check_shape("momentum", value, (3,))
            return value, rate
        value = self.momentum.astype(dtype)
        return value, jnp.zeros_like(value)

    def _motor(self, t: ScalarLike, state: Any, args: Any) -> Array:
        wheel = self._wheel
        if wheel is None or wheel.motor_torque is None:
            return zero_like(state)
        motor = jnp.asarray(wheel.motor_torque(t, state, args), state.omega.dtype)
        check_shape("motor_torque", motor, ())
        return motor

    def __call__(self, t: ScalarLike, state: Any, args: Any) -> Vector:
        """Torque on the body [N m], body components."""
        momentum, rate = self._momentum_and_rate(t, state, args)
        return -rate - jnp.cross(state.omega, momentum)

    def internal_at_rest(self, state: Any) -> PyTree:
        """The wheel turning with the body."""
        if self._wheel is None:
            return ()
        return jnp.sum(self._wheel.axis.astype(state.omega.dtype) * state.omega)

    def internal_rate(self, t: ScalarLike, state: Any, args: Any) -> PyTree:
        """Rate of the wheel's spin [rad/s^2]."""
        if self._wheel is None:
            return ()
        return self._motor(t, state, args) / self._wheel.inertia.astype(state.omega.dtype)

    def internal_scale(self, rate: Scalar) -> PyTree:
        """The wheel's spin is judged against the body's."""
        return () if self._wheel is None else rate

    def internal_momentum(self, t: ScalarLike, state: Any, args: Any) -> Vector:
        """Angular momentum of the rotor [kg m^2/s], body components."""
        return self._momentum_and_rate(t, state, args)[0]

    def internal_energy(self, t: ScalarLike, state: Any, args: Any) -> Scalar:
        """Kinetic energy of a wheel [J]; zero for a prescribed momentum, whose motor does work."""
        del t, args
        if self._wheel is None:
            return zero_like(state)
        return 0.5 * self._wheel.inertia.astype(state.omega.dtype) * state.internal**2

    def check(self, findings: Findings) -> None:
        """Note a momentum that is not finite, or what is wrong with the wheel."""
        if self._wheel is not None:
            self._wheel.check(findings)
        elif not callable(self.momentum):
            require_finite(findings, self, "momentum")
