"""Systems: vector fields and invariants of bodies with a fixed point or in flight."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PyTree

from jrigid._checks import (
    INERTIA,
    RESULTS,
    Findings,
    all_positive,
    array_of_shape,
    check_shape,
    check_type,
    internal_parts,
    is_inertia,
    jumps_within,
    state_array,
    traced_by_jax,
)
from jrigid._public import list_public_names
from jrigid._types import (
    BodyState,
    InertiaLike,
    Readable,
    Scalar,
    ScalarLike,
    Vector,
)
from jrigid.dynamics import State, angular_momentum, euler_equations, kinetic_energy
from jrigid.mass import MassProperties
from jrigid.rotation import attitude_rate, rotate
from jrigid.torques import AbstractTorque, Sum, TorqueFunction, as_torque

_State = TypeVar("_State", bound=BodyState)


class AbstractSystem(Readable):
    """A system for `jrigid.simulate`: inertia, torque, vector field and invariants.

    A system of your own has the two attributes and the abstract methods. Coordinates
    beyond those of `State` are internal parts: its torque states them by
    `internal_at_rest` and `internal_scale`, and its `vector_field` returns their rates.
    Only `simulate` takes it. `jrigid.stability` and `jrigid.identify` take a
    `RigidBody`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> ball = jr.solids.sphere(1.0, 0.1)
    >>> bodies = jr.RigidBody(jnp.ones(3)), jr.FloatingBody(ball)
    >>> print([isinstance(x, jr.AbstractSystem) for x in bodies])
    [True, True]
    >>> print([x.state_type.__name__ for x in bodies])
    ['State', 'FloatingState']
    """

    state_type: eqx.AbstractClassVar[type]
    inertia: eqx.AbstractVar[Float[Array, "..."]]
    torque: eqx.AbstractVar[AbstractTorque]

    @abc.abstractmethod
    def vector_field(self, t: ScalarLike, state: BodyState, args: PyTree) -> BodyState:
        """Time derivative of the state, in the state's own structure."""

    @abc.abstractmethod
    def energy(self, t: ScalarLike, state: BodyState, args: PyTree) -> Scalar:
        """Total energy [J]: kinetic, potential and that of internal parts."""

    @abc.abstractmethod
    def angular_momentum(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Total angular momentum, internal parts included.

        Returns:
            Space components [kg m^2/s].
        """

    def with_parts(self, state: _State) -> _State:
        """The state, with internal parts at rest in the body if it has none.

        `simulate` adds them to a state without parts. The vector field needs them, for
        example in a `diffeqsolve` of your own.

        Args:
            state: State, with an entry in `internal` for each torque that carries
                parts, or none.

        Returns:
            The state itself, if it has its parts.
        """
        if state.internal is None:
            # Parts move continuously, also those whose numbers at rest are integers.
            at_rest = jtu.tree_map(
                lambda x: jnp.asarray(x, state.omega.dtype),
                self.torque.internal_at_rest(state),
            )
            state = dataclasses.replace(state, internal=at_rest)
        # Raises an error for wrong parts.
        self._inertia_and_torque(state)
        return state

    @property
    def jumps(self) -> Float[Array, " jumps"]:
        """Times at which the torque declares that it is not smooth [s]."""
        return self.torque.jumps

    def torque_on(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """The torque on this body [N m], body components."""
        return self._inertia_and_torque(state)[1](t, state, args)

    def _inertia_and_torque(self, state: BodyState) -> tuple[Array, AbstractTorque]:
        """The inertia in the dtype of the state, and the torque on a body with it.

        Raises:
            ValueError: The state does not have the internal parts of this body.
        """
        # Shapes are compared when the vector field is traced, at no cost in a run.
        have = _shapes(state.internal)
        want = _shapes(self.torque.internal_at_rest(state))
        if have != want:
            raise ValueError(
                "Argument `internal` of the state must be a tuple with an entry for "
                f"each torque that carries parts, here of the shapes {want}, but it "
                f"holds {have}: `system.with_parts(state)` adds parts at rest to a "
                "state that has none."
            )
        # The precision of a run is that of the state, whatever that of the body.
        inertia = self.inertia.astype(state.omega.dtype)
        return inertia, self.torque.of_body(inertia)

    def check(self, findings: Findings) -> None:
        """Note parameters with bad values, for `simulate`.

        Args:
            findings: Collects what is wrong, by its method `require`.
        """
        findings.require(
            is_inertia(self.inertia), RESULTS.invalid_inertia, value=self.inertia
        )
        self.torque.check(findings)


def _shapes(tree: PyTree) -> list[tuple[str, tuple[int, ...]]]:
    """Paths and shapes of the leaves of a pytree."""
    leaves = jtu.tree_leaves_with_path(tree)
    return [(jtu.keystr(path), jnp.shape(x)) for path, x in leaves]


def _check_parts(method: str, value: PyTree, state: BodyState) -> None:
    """Raise ValueError unless a method of a torque answers for each internal part."""
    have = [jnp.shape(x) for x in jtu.tree_leaves(value)]
    want = [jnp.shape(x) for x in jtu.tree_leaves(state.internal)]
    if have != want:
        raise ValueError(
            f"Method `{method}` of a torque must return what `internal_at_rest` does, "
            f"arrays of the shapes {want}, but it returns {have}."
        )


class FloatingState(Readable):
    """State of a body in flight.

    Attributes:
        position: Centre of mass, space components [m].
        velocity: Velocity of the centre of mass, space components [m/s].
        attitude: Unit quaternion, scalar first, body to space.
        omega: Angular velocity, body components [rad/s].
        internal: A tuple with an entry for each torque that carries parts, as in
            `State`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> state = jr.FloatingState(
    ...     position=jnp.zeros(3),
    ...     velocity=jnp.array([3.0, 0.0, 4.0]),
    ...     attitude=jnp.array([1.0, 0.0, 0.0, 0.0]),
    ...     omega=jnp.ones(3),
    ... )
    """

    position: Float[Array, "*batch 3"] = eqx.field(converter=state_array)
    velocity: Float[Array, "*batch 3"] = eqx.field(converter=state_array)
    attitude: Float[Array, "*batch 4"] = eqx.field(converter=state_array)
    omega: Float[Array, "*batch 3"] = eqx.field(converter=state_array)
    internal: Any = eqx.field(default=(), converter=internal_parts)


class RigidBody(AbstractSystem):
    """A body that turns about a fixed point or about its centre of mass.

    Attributes:
        inertia: Principal moments or symmetric tensor about that point [kg m^2], body
            axes.
        torque: The torque on the body.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 1.0, 1.0]))
    >>> print(body.energy(0.0, state, None), body.angular_momentum(0.0, state, None))
    3.0 [1. 2. 3.]
    """

    state_type: ClassVar[type] = State
    inertia: Float[Array, "..."]
    torque: AbstractTorque

    def __init__(self, inertia: InertiaLike, torque: TorqueFunction | None = None):
        """A body.

        Args:
            inertia: Principal moments or symmetric tensor [kg m^2].
            torque: `(t, state, args) -> (3,)` body components [N m], a torque of
                `jrigid.torques`, or None.
        """
        self.inertia = array_of_shape("inertia", inertia, *INERTIA)
        self.torque = as_torque(torque)

    @property
    def is_free(self) -> bool:
        """True of a body without torque."""
        # `as_torque` makes an empty sum of None.
        return isinstance(self.torque, Sum) and not self.torque.terms

    def vector_field(
        self, t: ScalarLike, state: State | FloatingState, args: PyTree
    ) -> State:
        """Time derivative of the state.

        Args:
            t: Time [s].
            state: State at t.
            args: Passed to the torque.

        Returns:
            (q' [1/s], omega' [rad/s^2], rate of the internal state) as a `State`.

        Gradients: finite for any non-zero attitude quaternion.
        """
        inertia, torque = self._inertia_and_torque(state)
        with traced_by_jax("a torque"):
            acting = torque(t, state, args)
            internal_rate = torque.internal_rate(t, state, args)
        _check_parts("internal_rate", internal_rate, state)
        return State(
            attitude_rate(state.attitude, state.omega),
            euler_equations(inertia, state.omega, acting),
            internal_rate,
        )

    def energy(
        self, t: ScalarLike, state: State | FloatingState, args: PyTree
    ) -> Scalar:
        """Total energy [J]: kinetic, potential, and that of internal parts.

        Args:
            t: Time [s].
            state: State at t.
            args: Passed to the torque.

        Returns:
            Energy [J].

        Gradients: finite for any non-zero attitude quaternion.
        """
        inertia, torque = self._inertia_and_torque(state)
        energy = kinetic_energy(inertia, state.omega)
        energy = energy + torque.internal_energy(t, state, args)
        return energy + torque.potential(t, state, args)

    def angular_momentum(
        self, t: ScalarLike, state: State | FloatingState, args: PyTree
    ) -> Vector:
        """Total angular momentum about the fixed point, internal parts included.

        Args:
            t: Time [s].
            state: State at t.
            args: Passed to the torque.

        Returns:
            Space components [kg m^2/s].

        Gradients: finite for any non-zero attitude quaternion.
        """
        inertia, torque = self._inertia_and_torque(state)
        own = angular_momentum(inertia, state.omega)
        return rotate(state.attitude, own + torque.internal_momentum(t, state, args))


#: `(t, state, args) -> (3,)`: the force on a body, space components [N].
ForceFunction = Callable[[Any, Any, Any], Any]


class Force(eqx.Module):
    """A force with a potential energy, for `FloatingBody`.

    A plain function can be passed as a force without potential energy.

    Attributes:
        fn: `(t, state, args) -> (3,)` space components [N].
        potential: `(t, state, args) -> ()` potential energy [J].

    >>> import jax.numpy as jnp, jrigid as jr
    >>> weight = jr.systems.Force(
    ...     lambda t, state, args: jnp.array([0.0, 0.0, -9.8]),
    ...     lambda t, state, args: 9.8 * state.position[2],
    ... )
    """

    fn: ForceFunction
    potential: Callable[[Any, Any, Any], Any]

    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Force [N], space components."""
        return self.fn(t, state, args)


class FloatingBody(AbstractSystem):
    """A body in flight: its centre of mass moves under forces while it turns.

    Attributes:
        mass_properties: Mass and inertia; the place of the centre of mass in the body
            does not matter.
        force: `(t, state, args) -> (3,)` total force, space components [N], or None.
        torque: The torque about the centre of mass.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> def weight(t, state, args):
    ...     return jnp.array([0.0, 0.0, -9.8])
    >>> box = jr.solids.box(1.0, jnp.array([0.1, 0.3, 0.05]))
    >>> racket = jr.FloatingBody(box, weight)
    """

    state_type: ClassVar[type] = FloatingState
    mass_properties: MassProperties
    force: ForceFunction | None
    torque: AbstractTorque

    def __init__(
        self,
        mass_properties: MassProperties,
        force: ForceFunction | None = None,
        torque: TorqueFunction | None = None,
    ):
        """A body in flight.

        Args:
            mass_properties: Mass and inertia about the centre of mass.
            force: `(t, state, args) -> (3,)` space components [N]; a `Force` adds a
                potential.
            torque: About the centre of mass, as for `RigidBody`.
        """
        check_type("mass_properties", mass_properties, MassProperties)
        if force is not None and not callable(force):
            raise ValueError(
                "Argument `force` must be a callable (t, state, args) -> (3,), "
                f"but it is {force!r}."
            )
        self.mass_properties = mass_properties
        self.force = force
        self.torque = as_torque(torque)

    @property
    def inertia(self) -> Float[Array, "..."]:
        """Inertia tensor about the centre of mass [kg m^2]."""
        return self.mass_properties.inertia

    @property
    def jumps(self) -> Float[Array, " jumps"]:
        """Times at which the torque or the force declares that it is not smooth [s]."""
        return jumps_within([self.torque, self.force])

    @property
    def rotation(self) -> RigidBody:
        """The body that turns about the centre of mass as this one does."""
        return RigidBody(self.inertia, self.torque)

    def check(self, findings: Findings) -> None:
        """Note a mass that is not positive, then as any system.

        Args:
            findings: Collects what is wrong, by its method `require`.
        """
        mass = jax.lax.stop_gradient(self.mass_properties.mass)
        findings.require(all_positive(mass), RESULTS.invalid_mass, value=mass)
        self.rotation.check(findings)

    def vector_field(
        self, t: ScalarLike, state: FloatingState, args: PyTree
    ) -> FloatingState:
        """Time derivative of the state.

        Args:
            t: Time [s].
            state: State at t.
            args: Passed to force and torque.

        Returns:
            (velocity, acceleration, q', omega', rate of the internal state).

        Gradients: finite for any non-zero attitude quaternion.
        """
        check_shape("position", state.position, (3,))
        check_shape("velocity", state.velocity, (3,))
        force = jnp.zeros_like(state.velocity)
        if self.force is not None:
            with traced_by_jax("a force"):
                acting = self.force(t, state, args)
            force = jnp.asarray(acting, force.dtype)
            check_shape("force", force, (3,))
        acceleration = force / self.mass_properties.mass.astype(force.dtype)
        turning = self.rotation.vector_field(t, state, args)
        # The fields of `State` have the same names in `FloatingState`.
        return FloatingState(state.velocity, acceleration, **vars(turning))

    def translational_energy(self, state: FloatingState) -> Scalar:
        """Kinetic energy of the centre of mass [J], m v^2 / 2.

        Args:
            state: State of the body.

        Returns:
            Energy [J]; with the rotational kinetic energy the whole kinetic energy
            (Koenig).
        """
        return 0.5 * jnp.sum(state.velocity * self.momentum(state))

    def rotational_energy(self, state: FloatingState) -> Scalar:
        """Kinetic energy of the rotation about the centre of mass [J].

        Args:
            state: State of the body.

        Returns:
            omega . I omega / 2 [J]; internal parts are counted by `energy`.
        """
        return kinetic_energy(self.inertia.astype(state.omega.dtype), state.omega)

    def energy(self, t: ScalarLike, state: FloatingState, args: PyTree) -> Scalar:
        """Total energy [J]: both kinetic parts, potentials, and that of internal parts.

        Args:
            t: Time [s].
            state: State at t.
            args: Passed to force and torque.

        Returns:
            Energy [J].

        Gradients: finite for any non-zero attitude quaternion.
        """
        total = self.translational_energy(state) + self.rotation.energy(t, state, args)
        if isinstance(self.force, Force):
            total = total + jnp.asarray(
                self.force.potential(t, state, args), total.dtype
            )
        return total

    def momentum(self, state: FloatingState) -> Vector:
        """Linear momentum m v.

        Args:
            state: State of the body.

        Returns:
            Space components [kg m/s].
        """
        return self.mass_properties.mass.astype(state.velocity.dtype) * state.velocity

    def angular_momentum(
        self, t: ScalarLike, state: FloatingState, args: PyTree
    ) -> Vector:
        """Total angular momentum about the origin of space: orbital plus rotational.

        Args:
            t: Time [s].
            state: State at t.
            args: Passed to force and torque.

        Returns:
            Space components [kg m^2/s].

        Gradients: finite for any non-zero attitude quaternion.
        """
        orbital = jnp.cross(state.position, self.momentum(state))
        return orbital + self.rotation.angular_momentum(t, state, args)


list_public_names(__name__)
