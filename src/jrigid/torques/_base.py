"""What a torque is, and how torques add."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PyTree

from jrigid._checks import RESULTS, Findings, all_finite, array_of_shape, check_shape
from jrigid._types import Scalar, ScalarLike, Vector

TorqueFunction = Callable[[Any, Any, Any], Any]


def zero_like(state: Any) -> Scalar:
    """Zero of the dtype of a state."""
    return jnp.zeros((), state.omega.dtype)


def require_finite(findings: Findings, owner: Any, *names: str) -> None:
    """Note each of the named parameters of a torque that is not finite."""
    for name in names:
        findings.require(
            all_finite(jax.lax.stop_gradient(getattr(owner, name))),
            RESULTS.invalid_torque,
            f"Argument `{name}` of `{type(owner).__name__}` must be finite, but it is not.",
        )


def has_parts(internal: PyTree) -> bool:
    """Whether an internal state holds anything."""
    return bool(jtu.tree_leaves(internal))


class AbstractTorque(eqx.Module):
    """A torque, its potential energy, and the internal parts that exert it.

    Subclasses give `__call__`; the rest defaults to a torque without potential or internal parts.

    Gradients: those of the subclass's own functions.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> class Spring(jr.torques.AbstractTorque):
    ...     stiffness: float
    ...
    ...     def __call__(self, t, state, args):
    ...         return -self.stiffness * jr.rotation.log(state.attitude)
    ...
    ...     def potential(self, t, state, args):
    ...         return 0.5 * self.stiffness * jnp.sum(jr.rotation.log(state.attitude) ** 2)
    >>> turned = jr.State(jr.rotation.exp(jnp.array([0.0, 0.5, 0.0])), jnp.zeros(3))
    >>> print((Spring(2.0) + jr.torques.LinearDrag(0.1))(0.0, turned, None).round(6))
    [ 0. -1.  0.]
    """

    @abc.abstractmethod
    def __call__(self, t: ScalarLike, state: Any, args: Any) -> Vector:
        """Torque on the body [N m], body components."""

    def potential(self, t: ScalarLike, state: Any, args: Any) -> Scalar:
        """Potential energy [J]; zero if the torque has none."""
        del t, args
        return zero_like(state)

    def internal_at_rest(self, state: Any) -> PyTree:
        """Internal state of parts that move with the body; `()` if there are none."""
        del state
        return ()

    def internal_rate(self, t: ScalarLike, state: Any, args: Any) -> PyTree:
        """Time derivative of the internal state."""
        del t, state, args
        return ()

    def internal_scale(self, rate: Scalar) -> PyTree:
        """Size of the internal state when the body turns at `rate` [rad/s], for error control."""
        del rate
        return ()

    def internal_momentum(self, t: ScalarLike, state: Any, args: Any) -> Vector:
        """Angular momentum of the internal parts [kg m^2/s], body components."""
        del t, args
        return jnp.zeros_like(state.omega)

    def internal_energy(self, t: ScalarLike, state: Any, args: Any) -> Scalar:
        """Kinetic energy of the internal parts [J]."""
        del t, args
        return zero_like(state)

    def check(self, findings: Findings) -> None:
        """Note parameters with bad values, for `simulate`; by default there are none.

        Args:
            findings: What has been found so far; `require` adds to it.
        """
        del findings

    def __add__(self, other: TorqueFunction) -> "Sum":
        """Both torques together."""
        return Sum((*_terms(self), *_terms(other)))

    def __radd__(self, other: TorqueFunction | int) -> "AbstractTorque":
        """Both torques together; `0 + torque` is the torque, so that `sum()` works."""
        if isinstance(other, int) and other == 0:
            return self
        return Sum((*_terms(other), *_terms(self)))


def as_torque(torque: TorqueFunction | None) -> "AbstractTorque":
    """A torque object from a torque, a plain callable or None (no torque).

    Args:
        torque: What to convert.

    Returns:
        The torque itself if it is one already.

    Raises:
        ValueError: Not callable (trace time).

    >>> import jrigid as jr
    >>> type(jr.torques.as_torque(None)).__name__
    'Sum'
    """
    if torque is None:
        return Sum(())
    if isinstance(torque, AbstractTorque):
        return torque
    if callable(torque):
        return Torque(torque)
    raise ValueError(
        f"Argument `torque` must be a callable (t, state, args) -> (3,), but it is {torque!r}."
    )


def _terms(torque: Any) -> tuple[AbstractTorque, ...]:
    torque = as_torque(torque)
    return torque.terms if isinstance(torque, Sum) else (torque,)


class Sum(AbstractTorque):
    """Torques acting together; what `+` makes.

    The internal state is `()` if no term carries one, the term's own if just one does, and
    otherwise a tuple with one entry for each term that does, in their order. A term that carries
    one sees its own as `state.internal`; the others see all of it.

    Attributes:
        terms: The torques.

    Gradients: the sum of those of the terms.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> total = jr.torques.Constant(jnp.ones(3)) + jr.torques.LinearDrag(2.0)
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 2.0, 3.0]))
    >>> print(total(0.0, state, None))
    [-1. -3. -5.]
    """

    terms: tuple[AbstractTorque, ...]

    def _carriers(self, state: Any) -> list[int]:
        return [i for i, x in enumerate(self.terms) if has_parts(x.internal_at_rest(state))]

    def _states(self, state: Any) -> list[Any]:
        """The state as each term sees it: with its own internal part, or all if it has none."""
        views = [state] * len(self.terms)
        carriers = self._carriers(state)
        if len(carriers) > 1:
            for i, own in zip(carriers, state.internal, strict=True):
                views[i] = dataclasses.replace(state, internal=own)
        return views

    def _pack(self, state: Any, parts: list[Any]) -> PyTree:
        kept = tuple(parts[i] for i in self._carriers(state))
        return kept[0] if len(kept) == 1 else kept

    def __call__(self, t: ScalarLike, state: Any, args: Any) -> Vector:
        """Sum of the torques [N m], body components."""
        total = jnp.zeros_like(state.omega)
        for term, own in zip(self.terms, self._states(state), strict=True):
            total = total + term(t, own, args)
        return total

    def potential(self, t: ScalarLike, state: Any, args: Any) -> Scalar:
        """Sum of the potential energies [J]."""
        pairs = zip(self.terms, self._states(state), strict=True)
        return sum((x.potential(t, own, args) for x, own in pairs), zero_like(state))

    def internal_at_rest(self, state: Any) -> PyTree:
        """Internal states of the terms that have one."""
        return self._pack(state, [x.internal_at_rest(state) for x in self.terms])

    def internal_rate(self, t: ScalarLike, state: Any, args: Any) -> PyTree:
        """Time derivative of the internal state."""
        pairs = zip(self.terms, self._states(state), strict=True)
        return self._pack(state, [x.internal_rate(t, own, args) for x, own in pairs])

    def internal_scale(self, rate: Scalar) -> PyTree:
        """Size of the internal state when the body turns at `rate` [rad/s]."""
        scales = [x.internal_scale(rate) for x in self.terms]
        kept = tuple(x for x in scales if has_parts(x))
        return kept[0] if len(kept) == 1 else kept

    def internal_momentum(self, t: ScalarLike, state: Any, args: Any) -> Vector:
        """Angular momentum of all internal parts [kg m^2/s], body components."""
        total = jnp.zeros_like(state.omega)
        for term, own in zip(self.terms, self._states(state), strict=True):
            total = total + term.internal_momentum(t, own, args)
        return total

    def internal_energy(self, t: ScalarLike, state: Any, args: Any) -> Scalar:
        """Kinetic energy of all internal parts [J]."""
        pairs = zip(self.terms, self._states(state), strict=True)
        return sum((x.internal_energy(t, own, args) for x, own in pairs), zero_like(state))

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

    Raises:
        ValueError: A value of `fn` of the wrong shape (trace time, when called).

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
            potential: `(t, state, args) -> ()` potential energy [J], for the energy balance.
        """
        self.fn = fn
        self.potential_fn = potential

    def __call__(self, t: ScalarLike, state: Any, args: Any) -> Vector:
        """Torque on the body [N m], body components."""
        torque = jnp.asarray(self.fn(t, state, args), state.omega.dtype)
        check_shape("torque", torque, (3,))
        return torque

    def potential(self, t: ScalarLike, state: Any, args: Any) -> Scalar:
        """Potential energy [J]; zero if none was given."""
        if self.potential_fn is None:
            return zero_like(state)
        return jnp.asarray(self.potential_fn(t, state, args), state.omega.dtype)


class Constant(AbstractTorque):
    """Torque constant in the body, as of a thruster fixed to it.

    Attributes:
        torque: Body components [N m].

    Raises:
        ValueError: Wrong shape (trace time). That it is finite is checked by `simulate`.

    Gradients: linear in the torque.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> thruster = jr.torques.Constant(jnp.array([0.0, 0.0, 0.1]))
    """

    torque: Float[Array, "3"] = eqx.field(converter=lambda x: array_of_shape("torque", x, 3))

    def __call__(self, t: ScalarLike, state: Any, args: Any) -> Vector:
        """Torque on the body [N m], body components."""
        del t, args
        return self.torque.astype(state.omega.dtype)

    def check(self, findings: Findings) -> None:
        """Note a torque that is not finite."""
        require_finite(findings, self, "torque")
