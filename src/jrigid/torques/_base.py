"""The base class of torques, the sum of torques, and functions as torques."""
# ruff: noqa: ARG002

# All torques have the arguments t, state and args, which some of them do not use.

import abc
import dataclasses
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from jrigid._checks import (
    INERTIA,
    RESULTS,
    Findings,
    all_finite,
    all_positive,
    array_of_shape,
    can_be_called,
    check_shape,
    demand,
    is_concrete,
    jumps_within,
)
from jrigid._numerics import as_tensor, safe_norm
from jrigid._types import (
    BodyState,
    InertiaLike,
    Matrix,
    Readable,
    Scalar,
    ScalarLike,
    Vector,
)

#: `(t, state, args) -> (3,)`: the torque on a body, body components [N m]. The types
#: of its arguments are open, since a user's function may state narrower ones.
TorqueFunction = Callable[[Any, Any, Any], Any]

#: Lengths of the axes of an array, None for any length.
Shape = tuple[int | None, ...]


class Rule(NamedTuple):
    """Condition that a parameter of a torque must meet.

    Attributes:
        words: The rule in words.
        holds: Whether a value obeys the rule, traced or not; `simulate` asks.
        is_refused: Whether a known value is refused when the torque is built. NaN is
            not, since a builder with `throw=False` returns it for a bad body.
    """

    words: str
    holds: Callable[[Array], Bool[Array, ""]]
    is_refused: Callable[[np.ndarray], bool | np.bool_] | None = None


def _finite_and_not_negative(x: Array) -> Bool[Array, ""]:
    """True where no component is negative, infinite or NaN."""
    return all_finite(x) & jnp.all(x >= 0)


def _finite_and_not_zero(x: Array) -> Bool[Array, ""]:
    """True where all vectors are finite and none is zero."""
    return all_finite(x) & jnp.all(jnp.any(x, axis=-1))


def has_negative(x: np.ndarray) -> np.bool_:
    """Whether a component is negative."""
    return np.any(x < 0)


def _has_none_positive(x: np.ndarray) -> np.bool_:
    """Whether a component is zero or negative."""
    return np.any(x <= 0)


# Metadata of the fields of torques: the rule for a parameter, and with `positive` that
# a search must keep it on one side of zero.
FINITE = {"rule": Rule("finite", all_finite)}
POSITIVE = {
    "rule": Rule("positive and finite", all_positive, _has_none_positive),
    "positive": True,
}
NOT_NEGATIVE = {
    "rule": Rule("finite and not negative", _finite_and_not_negative, has_negative),
    "positive": True,
}
NOT_ZERO = {"rule": Rule("finite and not zero", _finite_and_not_zero)}


def _parameters_with_rules(module: eqx.Module) -> Iterator[tuple[str, Rule, Array]]:
    """Name in words, rule and value of each parameter of a module that has a rule."""
    for field in dataclasses.fields(module):
        value = getattr(module, field.name)
        # A parameter may also be a function of time, or None.
        if "rule" in field.metadata and eqx.is_array(value):
            name = f"Argument `{field.name}` of `{type(module).__name__}`"
            yield name, field.metadata["rule"], value


def check_parameters(findings: Findings, torque: "AbstractTorque") -> None:
    """Note each parameter that breaks the rule of its field."""
    for name, rule, value in _parameters_with_rules(torque):
        message = f"{name} must be {rule.words}, but it is not."
        value = jax.lax.stop_gradient(value)
        findings.require(rule.holds(value), RESULTS.invalid_torque, message, value)


def refuse_known_parameters(module: eqx.Module) -> None:
    """Raise RuntimeError for a parameter that is known now and refused by its rule."""
    for name, rule, value in _parameters_with_rules(module):
        if rule.is_refused is None or not is_concrete(value):
            continue
        known = np.asarray(value)
        if rule.is_refused(known):
            raise RuntimeError(f"{name} must be {rule.words}, but it is {known}.")


def array(name: str, *shape: int | Shape | None) -> Callable[[ArrayLike], Array]:
    """A converter to an array of this shape, or of one of these shapes."""

    def convert(value: ArrayLike) -> Array:
        return array_of_shape(name, value, *shape)

    return convert


def direction(name: str, *shape: int | None, optional: bool = False) -> dict[str, Any]:
    """Options of a field of vectors, which get length 1; `simulate` refuses zero."""

    def convert(value: ArrayLike | None) -> Array | None:
        if value is None and optional:
            return None
        vectors = array_of_shape(name, value, *shape)
        lengths = safe_norm(vectors)[..., None]
        # A zero vector stays zero and not NaN, so that an error can show it.
        return vectors / jnp.where(lengths > 0, lengths, 1.0)

    return {"converter": convert, "metadata": NOT_ZERO}


def vector_or_function(name: str) -> dict[str, Any]:
    """Options of a field for a vector, or for a function that returns one."""
    to_vector = array(name, 3)

    def convert(
        value: ArrayLike | Callable[..., Any],
    ) -> Array | Callable[..., Any]:
        return value if callable(value) else to_vector(value)

    return {"converter": convert, "metadata": FINITE}


def value_of(
    name: str,
    source: Array | Callable[..., Any],
    state: BodyState,
    *arguments: PyTree,
    shape: tuple[int, ...] = (3,),
) -> Array:
    """An array, or the value of a function of the arguments, in a state's dtype."""
    result = source(*arguments) if callable(source) else source
    demand(
        result is not None,
        f"Argument `{name}` must return an array, but it returns None: "
        "without `return`?",
    )
    demand(
        not any(map(np.iscomplexobj, jtu.tree_leaves(result))),
        f"Argument `{name}` must return real numbers, but it returns complex ones.",
    )
    value = jnp.asarray(result, state.omega.dtype)
    check_shape(name, value, shape)
    return value


def in_dtype_of(state: BodyState, *parameters: Array) -> list[Array]:
    """Parameters of a torque in the dtype of a state."""
    return [x.astype(state.omega.dtype) for x in parameters]


def zero_like(state: BodyState) -> Scalar:
    """Zero of the dtype of a state."""
    return jnp.zeros((), state.omega.dtype)


class AbstractTorque(Readable):
    """A torque, its potential energy, and the internal parts that exert it.

    Subclasses define `__call__`. The other methods default to a torque without
    potential or internal parts. For a torque with internal parts `state.internal` is a
    tuple with an entry for each of its own parts, alone and in a sum, and its methods
    return such tuples.

    Gradients: those of the subclass's own functions.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> class Spring(jr.torques.AbstractTorque):
    ...     stiffness: float
    ...
    ...     def __call__(self, t, state, args):
    ...         return -self.stiffness * jr.rotation.log(state.attitude)
    ...
    ...     def potential(self, t, state, args):
    ...         angle = jr.rotation.log(state.attitude)
    ...         return 0.5 * self.stiffness * jnp.sum(angle**2)
    >>> turned = jr.State(jr.rotation.exp(jnp.array([0.0, 0.5, 0.0])), jnp.zeros(3))
    >>> print((Spring(2.0) + jr.torques.LinearDrag(0.1))(0.0, turned, None).round(6))
    [ 0. -1.  0.]
    """

    def __check_init__(self) -> None:
        """Raise RuntimeError for a known parameter that no such torque has."""
        refuse_known_parameters(self)

    @abc.abstractmethod
    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Torque on the body [N m], body components."""

    def of_body(self, inertia: InertiaLike) -> "AbstractTorque":
        """The torque on a body of this inertia: itself, unless it depends on it.

        `RigidBody` and `FloatingBody` call it at every use, with their own inertia.
        """
        return self

    @property
    def jumps(self) -> Float[Array, " jumps"]:
        """Times at which the torque is not smooth [s]; steps of `simulate` end there.

        By default they are those of its parts: torques in a sum, a `Sampled` in a
        field. A subclass that switches at known times returns these:

        >>> import equinox as eqx, jax, jax.numpy as jnp, jrigid as jr
        >>> class Pulse(jr.torques.AbstractTorque):
        ...     torque: jax.Array
        ...     start: jax.Array = eqx.field(converter=jnp.asarray)
        ...     end: jax.Array = eqx.field(converter=jnp.asarray)
        ...
        ...     def __call__(self, t, state, args):
        ...         inside = (t > self.start) & (t < self.end)
        ...         return jnp.where(inside, self.torque, 0.0)
        ...
        ...     @property
        ...     def jumps(self):
        ...         return jnp.stack([self.start, self.end])
        >>> first = Pulse(jnp.array([0.0, 0.0, 1.0]), 10.0, 10.5)
        >>> second = Pulse(jnp.array([0.0, 0.0, -1.0]), 20.0, 20.5)
        >>> print((first + second + jr.torques.LinearDrag(0.1)).jumps)
        [10.  10.5 20.  20.5]
        """
        return jumps_within([getattr(self, x.name) for x in dataclasses.fields(self)])

    def potential(self, t: ScalarLike, state: BodyState, args: PyTree) -> Scalar:
        """Potential energy [J]; zero if the torque has none."""
        return zero_like(state)

    @property
    def inertia_of_parts(self) -> Matrix | None:
        """Inertia that parts have beside that of the body [kg m^2]; None for nothing.

        `GravityGradient` acts on both. For a wheel with a spin of its own this is its
        moment about its axis.
        """
        return None

    def internal_at_rest(self, state: BodyState) -> tuple[PyTree, ...]:
        """Internal state of parts that move with the body; `()` if there are none.

        A torque that has some also has `internal_rate` and `internal_scale`.
        """
        return ()

    def internal_rate(
        self, t: ScalarLike, state: BodyState, args: PyTree
    ) -> tuple[PyTree, ...]:
        """Time derivative of the internal state."""
        return ()

    def internal_scale(self, rate: Scalar) -> tuple[PyTree, ...]:
        """Size of the internal state of a body that turns at `rate` [rad/s].

        The error control of `simulate` uses it.
        """
        return ()

    def internal_momentum(
        self, t: ScalarLike, state: BodyState, args: PyTree
    ) -> Vector:
        """Angular momentum of the internal parts [kg m^2/s], body components."""
        return jnp.zeros_like(state.omega)

    def internal_energy(self, t: ScalarLike, state: BodyState, args: PyTree) -> Scalar:
        """Kinetic energy of the internal parts [J]."""
        return zero_like(state)

    def check(self, findings: Findings) -> None:
        """Note parameters with bad values, for `simulate` and its like.

        Args:
            findings: Collects what is wrong, by its method `require`.
        """
        check_parameters(findings, self)

    def __add__(self, other: TorqueFunction) -> "Sum":
        """Both torques together."""
        return Sum((self, other))

    def __radd__(self, other: Any) -> "AbstractTorque":
        """Both torques together; `0 + torque` is the torque, so that `sum()` works.

        A plain function cannot be the first item of `sum`, since Python adds it to 0
        before it meets a torque. `Sum([function, torque])` takes them in any order.
        """
        return self if other == 0 else Sum((other, self))


def as_torque(torque: TorqueFunction | None) -> "AbstractTorque":
    """A torque object from a torque, a plain callable or None (no torque).

    Args:
        torque: What to convert.

    Returns:
        The torque itself if it is one already.

    >>> import jrigid as jr
    >>> type(jr.torques.as_torque(None)).__name__
    'Sum'
    """
    if torque is None:
        return Sum(())
    if not callable(torque):
        raise ValueError(
            "Argument `torque` must be a callable (t, state, args) -> (3,), "
            f"but it is {torque!r}."
        )
    if isinstance(torque, AbstractTorque):
        return torque
    demand(
        can_be_called(torque, *range(3)),
        "Argument `torque` must be a callable (t, state, args) -> (3,), but it does "
        f"not take these three: {torque!r}.",
    )
    return Torque(torque)


class Sum(AbstractTorque):
    """Torques acting together; what `+` makes.

    The internal state is a tuple with an entry for each torque that carries parts, in
    their order. For such a torque `state.internal` holds its own entries, for the
    others all entries.

    Attributes:
        terms: The torques; a sum within the sum is replaced by its terms.

    Gradients: the sum of those of the terms.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> push = lambda t, state, args: jnp.ones(3)
    >>> total = jr.torques.Sum([push, jr.torques.LinearDrag(2.0)])
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 2.0, 3.0]))
    >>> print(total(0.0, state, None))
    [-1. -3. -5.]
    """

    terms: tuple[AbstractTorque, ...]

    def __init__(self, terms: Iterable[TorqueFunction]):
        """Add torques.

        Args:
            terms: Torques and plain functions `(t, state, args) -> (3,)`, in any order.
        """
        torques = [as_torque(term) for term in terms]
        # In a nested sum a plain function would see that sum's internal states alone.
        self.terms = sum((x.terms if isinstance(x, Sum) else (x,) for x in torques), ())

    def _views(self, state: BodyState) -> Iterator[tuple[AbstractTorque, BodyState]]:
        """Each term, and the state with the entries of that term."""
        first = 0
        for term in self.terms:
            # Parts at rest have as many entries as parts in motion.
            last = first + len(term.internal_at_rest(state))
            view = state
            if last > first:
                view = dataclasses.replace(state, internal=state.internal[first:last])
            yield term, view
            first = last

    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Sum of the torques [N m], body components."""
        return sum(
            (x(t, own, args) for x, own in self._views(state)),
            # The start value gives an empty sum its shape and dtype.
            jnp.zeros_like(state.omega),
        )

    def of_body(self, inertia: InertiaLike) -> "Sum":
        """The torques on a body of this inertia, and on its parts."""
        parts = [x.inertia_of_parts for x in self.terms]
        parts = [x for x in parts if x is not None]
        if parts:
            tensor = as_tensor(array_of_shape("inertia", inertia, *INERTIA))
            inertia = sum((x.astype(tensor.dtype) for x in parts), tensor)
        return Sum(term.of_body(inertia) for term in self.terms)

    def potential(self, t: ScalarLike, state: BodyState, args: PyTree) -> Scalar:
        """Sum of the potential energies [J]."""
        return sum(
            (x.potential(t, own, args) for x, own in self._views(state)),
            zero_like(state),
        )

    def internal_at_rest(self, state: BodyState) -> tuple[PyTree, ...]:
        """Internal states of the terms that have one."""
        return sum((term.internal_at_rest(state) for term in self.terms), ())

    def internal_rate(
        self, t: ScalarLike, state: BodyState, args: PyTree
    ) -> tuple[PyTree, ...]:
        """Time derivative of the internal state."""
        return sum((x.internal_rate(t, own, args) for x, own in self._views(state)), ())

    def internal_scale(self, rate: Scalar) -> tuple[PyTree, ...]:
        """Size of the internal state when the body turns at `rate` [rad/s]."""
        return sum((term.internal_scale(rate) for term in self.terms), ())

    def internal_momentum(
        self, t: ScalarLike, state: BodyState, args: PyTree
    ) -> Vector:
        """Angular momentum of all internal parts [kg m^2/s], body components."""
        momenta = (x.internal_momentum(t, own, args) for x, own in self._views(state))
        return sum(momenta, jnp.zeros_like(state.omega))

    def internal_energy(self, t: ScalarLike, state: BodyState, args: PyTree) -> Scalar:
        """Kinetic energy of all internal parts [J]."""
        energies = (x.internal_energy(t, own, args) for x, own in self._views(state))
        return sum(energies, zero_like(state))

    def check(self, findings: Findings) -> None:
        """Note bad parameters of the terms."""
        for term in self.terms:
            term.check(findings)


class Torque(AbstractTorque):
    """Any function as a torque, with its potential energy if it has one.

    Attributes:
        fn: `(t, state, args) -> (3,)` body components [N m].
        potential_fn: `(t, state, args) -> ()` potential energy [J], or None.

    `state.internal` is that of the whole body, also in a sum.

    Gradients: those of the functions.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> spring = jr.torques.Torque(lambda t, state, args: -args * state.omega)
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 2.0, 3.0]))
    >>> print((spring + jr.torques.Constant(jnp.ones(3)))(0.0, state, 2.0))
    [-1. -3. -5.]
    """

    fn: TorqueFunction
    potential_fn: TorqueFunction | None

    def __init__(self, fn: TorqueFunction, potential: TorqueFunction | None = None):
        """Wrap a function.

        Args:
            fn: `(t, state, args) -> (3,)` body components [N m].
            potential: `(t, state, args) -> ()` potential energy [J], for the energy
                balance.
        """
        self.fn = fn
        self.potential_fn = potential

    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Torque on the body [N m], body components."""
        return value_of("torque", self.fn, state, t, state, args)

    def potential(self, t: ScalarLike, state: BodyState, args: PyTree) -> Scalar:
        """Potential energy [J]; zero if none was given."""
        if self.potential_fn is None:
            return zero_like(state)
        return jnp.asarray(self.potential_fn(t, state, args), state.omega.dtype)


class Constant(AbstractTorque):
    """Torque constant in the body, as of a thruster fixed to it.

    Attributes:
        torque: Body components [N m].

    Gradients: linear in the torque.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> thruster = jr.torques.Constant(jnp.array([0.0, 0.0, 0.1]))
    """

    torque: Float[Array, "3"] = eqx.field(converter=array("torque", 3), metadata=FINITE)

    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Torque on the body [N m], body components."""
        return self.torque.astype(state.omega.dtype)
