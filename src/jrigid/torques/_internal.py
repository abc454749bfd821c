"""Torques of internal parts with a momentum of their own: a damper, a rotor."""
# ruff: noqa: ARG002

# All torques have the arguments t, state and args, which some of them do not use.

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jrigid._checks import demand
from jrigid._types import BodyState, Matrix, Scalar, ScalarLike, Vector
from jrigid.torques._base import (
    NOT_NEGATIVE,
    POSITIVE,
    AbstractTorque,
    TorqueFunction,
    array,
    direction,
    in_dtype_of,
    value_of,
    vector_or_function,
    zero_like,
)
from jrigid.torques._sampled import Sampled


class InternalDamper(AbstractTorque):
    """A sphere inside the body, coupled to it by a viscous layer.

    The sphere has an angular velocity of its own; the layer exerts c (omega_sphere -
    omega) on the body and the opposite on the sphere. The total angular momentum in
    space is constant, the energy falls at the rate c |omega_sphere - omega|^2. Its
    entry in `State.internal` is omega_sphere, the absolute angular velocity of the
    sphere in the components of the body's axes [rad/s]; by default the sphere starts at
    rest relative to the body. The inertia of the body does not include the sphere's
    own.

    Attributes:
        inertia: Moment of inertia of the sphere [kg m^2], positive.
        coupling: c [N m s], not negative.

    Raises:
        RuntimeError: The inertia is not positive, or the coupling is negative, and the
            value is known when the damper is built.

    Gradients: finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> damper = jr.torques.InternalDamper(0.2, 0.05)
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]), damper)
    >>> sphere = jnp.array([0.0, 0.0, 3.0])
    >>> omega = jnp.array([0.0, 0.0, 1.0])
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), omega, (sphere,))
    >>> print(body.torque_on(0.0, state, None).round(6))
    [0.  0.  0.1]
    """

    inertia: Float[Array, ""] = eqx.field(converter=array("inertia"), metadata=POSITIVE)
    coupling: Float[Array, ""] = eqx.field(
        converter=array("coupling"), metadata=NOT_NEGATIVE
    )

    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Torque on the body [N m], body components."""
        return self.coupling.astype(state.omega.dtype) * (
            state.internal[0] - state.omega
        )

    def internal_at_rest(self, state: BodyState) -> tuple[Vector]:
        """The sphere turning with the body."""
        return (state.omega,)

    def internal_rate(
        self, t: ScalarLike, state: BodyState, args: PyTree
    ) -> tuple[Vector]:
        """Rate of the sphere's angular velocity, in the turning axes of the body."""
        pull = self(t, state, args) / self.inertia.astype(state.omega.dtype)
        # The axes of the components turn with the body, which adds the second term.
        return (-pull - jnp.cross(state.omega, *state.internal),)

    def internal_scale(self, rate: Scalar) -> tuple[Scalar]:
        """The sphere turns about as fast as the body."""
        return (rate,)

    def internal_momentum(
        self, t: ScalarLike, state: BodyState, args: PyTree
    ) -> Vector:
        """Angular momentum of the sphere [kg m^2/s]."""
        return self.inertia.astype(state.omega.dtype) * state.internal[0]

    def internal_energy(self, t: ScalarLike, state: BodyState, args: PyTree) -> Scalar:
        """Kinetic energy of the sphere [J]."""
        return 0.5 * jnp.sum(state.internal[0] * self.internal_momentum(t, state, args))


class Rotor(AbstractTorque):
    """A rotor with a prescribed angular momentum h (a gyrostat): -h' - omega x h.

    The body's inertia includes the locked rotor. `SpinningMass` is a wheel whose spin
    follows from the torque of its motor.

    Attributes:
        momentum: h, relative to the body, body components [kg m^2/s]: an array, or
            `h(t) -> (3,)`. It must be continuous and have a derivative: at a step the
            torque is infinite, and the recoil of the body is missed. A rotor that is
            switched on in an instant is a `Sampled` with four times a millisecond
            apart, two on each side: its slopes at a time come from the neighbours.

    Raises:
        ValueError: The momentum is a `Sampled` with a step.

    Gradients: finite everywhere.
    Source: Hughes, Spacecraft Attitude Dynamics (1986), chapter 6.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> rotor = jr.torques.Rotor(jnp.array([0.0, 0.5, 0.0]))
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 0.0, 0.0]))
    >>> print(rotor(0.0, state, None))
    [-0.  -0.  -0.5]
    """

    momentum: Float[Array, "3"] | Callable[[ScalarLike], Vector] = eqx.field(
        **vector_or_function("momentum")
    )

    def __check_init__(self) -> None:
        """Raise ValueError for a momentum with a known step."""
        demand(
            not (isinstance(self.momentum, Sampled) and self.momentum.has_known_step),
            "Argument `momentum` of `Rotor` must be continuous, but it has a step, "
            "which takes an infinite torque. Put its two times apart.",
        )

    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Torque on the body [N m], body components."""
        time = jnp.asarray(t, state.omega.dtype)

        def momentum_at(t: Scalar) -> Vector:
            return self.internal_momentum(t, state, args)

        # Forward mode returns h and h' of a user's function by one evaluation.
        momentum, rate = jax.jvp(momentum_at, (time,), (jnp.ones_like(time),))
        return -rate - jnp.cross(state.omega, momentum)

    def internal_momentum(
        self, t: ScalarLike, state: BodyState, args: PyTree
    ) -> Vector:
        """Angular momentum of the rotor [kg m^2/s], body components."""
        return value_of("momentum", self.momentum, state, t)


class SpinningMass(AbstractTorque):
    """A wheel with a spin of its own: -(motor torque) a - omega x (J s a).

    The wheel's absolute spin s about its axis a is its entry in `State.internal`
    [rad/s]; by default it starts at rest relative to the body. J s' = motor torque. The
    body's inertia includes the wheel except for its axial moment J about a, which
    `GravityGradient` adds, since it acts on the wheel too.

    Attributes:
        inertia: J [kg m^2], positive.
        axis: a, body components, of any length but zero.
        motor_torque: `(t, state, args) -> ()` torque of the motor on the wheel [N m],
            or None: the wheel turns freely on its axis.

    Gradients: finite for any axis but zero.
    Source: Hughes, Spacecraft Attitude Dynamics (1986), chapter 6.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> wheel = jr.torques.SpinningMass(0.2, jnp.array([0.0, 3.0, 4.0]))
    >>> spins = (jnp.array(10.0),)
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3), spins)
    >>> print(wheel.internal_momentum(0.0, state, None).round(6))
    [0.  1.2 1.6]
    """

    inertia: Float[Array, ""] = eqx.field(converter=array("inertia"), metadata=POSITIVE)
    axis: Float[Array, "3"] = eqx.field(**direction("axis", 3))
    motor_torque: TorqueFunction | None = None

    def _motor(self, t: ScalarLike, state: BodyState, args: PyTree) -> Array:
        """Torque of the motor on the wheel [N m]."""
        if self.motor_torque is None:
            return zero_like(state)
        return value_of(
            "motor_torque", self.motor_torque, state, t, state, args, shape=()
        )

    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Torque on the body [N m], body components."""
        (axis,) = in_dtype_of(state, self.axis)
        # The motor is fixed to the body, which takes up its reaction.
        push = -self._motor(t, state, args) * axis
        return push - jnp.cross(state.omega, self.internal_momentum(t, state, args))

    @property
    def inertia_of_parts(self) -> Matrix:
        """Moment of the wheel about its axis, J a a^T [kg m^2]."""
        return self.inertia * jnp.outer(self.axis, self.axis)

    def internal_at_rest(self, state: BodyState) -> tuple[Scalar]:
        """The wheel turning with the body."""
        (axis,) = in_dtype_of(state, self.axis)
        # The spin of a wheel is absolute: at rest in the body it is that of the body.
        return (jnp.sum(axis * state.omega),)

    def internal_rate(
        self, t: ScalarLike, state: BodyState, args: PyTree
    ) -> tuple[Scalar]:
        """Rate of the wheel's spin [rad/s^2]."""
        (inertia,) = in_dtype_of(state, self.inertia)
        return (self._motor(t, state, args) / inertia,)

    def internal_scale(self, rate: Scalar) -> tuple[Scalar]:
        """The scale of the wheel's spin is the rate of the body."""
        return (rate,)

    def internal_momentum(
        self, t: ScalarLike, state: BodyState, args: PyTree
    ) -> Vector:
        """Angular momentum of the wheel about its axis [kg m^2/s], body components."""
        inertia, axis = in_dtype_of(state, self.inertia, self.axis)
        (spin,) = state.internal
        return inertia * spin * axis

    def internal_energy(self, t: ScalarLike, state: BodyState, args: PyTree) -> Scalar:
        """Kinetic energy of the wheel about its axis [J]."""
        (inertia,) = in_dtype_of(state, self.inertia)
        (spin,) = state.internal
        return 0.5 * inertia * spin**2
