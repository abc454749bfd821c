"""Events: conditions that end a motion, and the exact time at which one is met."""

import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from jrigid._checks import can_be_called, demand, kind_of, traced_by_jax
from jrigid._stepping.events import Conditions
from jrigid._types import BodyState

# Each Newton step doubles the order of the derivatives that are right. Two steps are
# enough for the second derivative.
_NEWTON_STEPS = 2


#: A condition of an event, of (t, y, args) with the state as one array.
Condition = Callable[[Array, Array, PyTree], Array]


def condition_of_states(
    condition: Callable[..., Array],
    t0: Array,
    to_state: Callable[[Array], BodyState],
    options: dict[str, object],
) -> Condition:
    """A condition, called with the time since `t0` and a state as one array.

    Like diffrax this passes the options that the user's function has as arguments.
    """
    parameters = inspect.signature(condition).parameters.values()
    takes_all = any(x.kind is x.VAR_KEYWORD for x in parameters)
    names = {x.name for x in parameters}
    passed = {name: x for name, x in options.items() if takes_all or name in names}
    demand(
        can_be_called(condition, *range(3), **passed),
        "The condition of an event must be a callable (t, y, args, **kwargs), but it "
        f"does not take these: {condition!r}.",
    )

    # What a user's condition returns is checked where it is called.
    def of_array(t: Array, y: Array, args: PyTree) -> Any:
        with traced_by_jax("the condition of an event"):
            value = condition(t0 + t, to_state(y), args, **passed)
        demand(
            not isinstance(value, jax.Array) or value.ndim == 0,
            "The condition of an `event` must return a number or a boolean, but it "
            f"returns {kind_of(value)}.",
        )
        return value

    return of_array


def conditions_of(
    each: list[Condition],
    direction: PyTree[bool | None],
    values: Callable[[list[Array], Array, Array], Array],
    example: tuple[Array, Array],
    args: PyTree,
) -> Conditions:
    """The conditions of an event.

    Args:
        each: The conditions, as functions.
        direction: As in `diffrax.Event`.
        values: Of (arrays, t, y): one value for each condition.
        example: A time and a state.
        args: Passed to the conditions.
    """
    shapes = [jax.eval_shape(x, *example, args) for x in each]
    boolean = tuple(jnp.issubdtype(x.dtype, jnp.bool_) for x in shapes)
    directions = tuple(jtu.tree_leaves(direction, is_leaf=lambda x: x is None))
    return Conditions(values, boolean, directions)


def place_of_event(
    field: Callable[[Array, Array], Array],
    value: Callable[[Array, Array], Array],
    finder: optx.AbstractRootFinder | None,
    t: Float[Array, ""],
    y: Float[Array, " n"],
    met: Bool[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, " n"]]:
    """Time and state at which a condition is zero, from a time very near to it.

    Gradients: those of the implicit function, of first and second order, in every mode.

    Args:
        field: The vector field, of time and state.
        value: Of the condition, of time and state.
        finder: A root finder to use in place of Newton's method.
        t: The time; it has no derivatives.
        y: The state at that time.
        met: Whether a zero of the condition ended the motion.
    """

    def later(dt: Array) -> Array:
        """The state by the midpoint rule, whose second derivatives are right."""
        middle = y + 0.5 * dt * field(t, y)
        return y + dt * field(t + 0.5 * dt, middle)

    def distance(dt: Array, _: None = None) -> Array:
        return value(t + dt, later(dt))

    dt = jnp.zeros_like(t)
    if finder is not None:
        solution = optx.root_find(distance, finder, dt, throw=False)
        dt = jnp.where(met, solution.value, 0.0)
    else:
        for _ in range(_NEWTON_STEPS):
            now, slope = jax.jvp(distance, (dt,), (jnp.ones_like(dt),))
            # A condition that jumps between constants has no slope. The time of the
            # bisection is then the result.
            usable = met & (slope != 0)
            dt = dt - jnp.where(usable, now / jnp.where(usable, slope, 1.0), 0.0)
    # Rounding must not lead to a time before the start, where an event may be.
    dt = dt - jax.lax.stop_gradient(jnp.minimum(t + dt, 0.0))
    return t + dt, later(dt)
