"""Events: conditions that end a motion, and the exact time at which one is met."""

import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jrigid._checks import traced_by_jax
from jrigid._stepping.events import Conditions

# Each Newton step doubles the orders of the derivatives that are right: two serve the
# second derivative.
_NEWTON_STEPS = 2


def condition_of_states(
    condition: Callable, t0: Array, to_state: Callable, options: dict[str, Any]
) -> Callable[[Array, Any, Any], Any]:
    """A condition, called with the time since `t0` and a state as one array.

    Like diffrax, it is given those of the options by name that it asks for.
    """
    known = inspect.signature(condition).parameters.values()
    every = any(x.kind is x.VAR_KEYWORD for x in known)
    names = {x.name for x in known}
    asked = {name: x for name, x in options.items() if every or name in names}

    def of_array(t: Array, y: Any, args: Any) -> Any:
        with traced_by_jax("the condition of an event"):
            return condition(t0 + t, to_state(y), args, **asked)

    return of_array


def conditions_of(
    each: list[Callable],
    direction: Any,
    values: Callable,
    example: tuple[Array, Array],
    args: Any,
) -> Conditions:
    """The conditions of an event.

    Args:
        each: Functions of (t, y, args).
        direction: As that of `diffrax.Event`.
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
    """Time and state at which a condition is zero, from a place very near to it.

    Gradients: those of the implicit function, of first and second order, in every mode.

    Args:
        field: The vector field, of time and state.
        value: Of the condition, of time and state.
        finder: A root finder to use in place of Newton's method.
        t: The time; it has no derivatives.
        y: The state at that time.
        met: Whether such a condition ended the motion.
    """

    def later(dt: Array) -> Array:
        """By the midpoint rule, whose derivatives are right to second order."""
        middle = y + 0.5 * dt * field(t, y)
        return y + dt * field(t + 0.5 * dt, middle)

    def distance(dt: Array, _: Any = None) -> Array:
        return value(t + dt, later(dt))

    dt = jnp.zeros_like(t)
    if finder is not None:
        found = optx.root_find(distance, finder, dt, throw=False)
        dt = jnp.where(met, found.value, 0.0)
    else:
        for _ in range(_NEWTON_STEPS):
            now, slope = jax.jvp(distance, (dt,), (jnp.ones_like(dt),))
            usable = met & (slope != 0)
            dt = dt - jnp.where(usable, now / jnp.where(usable, slope, 1.0), 0.0)
    return t + dt, later(dt)
