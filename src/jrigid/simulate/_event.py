"""Events: conditions on states, and where between two steps one changed its sign."""

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._checks import harmless

# Each Newton step doubles the orders of the derivatives that are right: two serve the second.
_NEWTON_STEPS = 2


def event_of_states(event: Any, t0: Array, to_state: Callable) -> Any:
    """The event with its conditions called with the time since `t0` and a state as one array."""
    if event is None:
        return None

    def of_states(condition: Callable) -> Callable:
        known = inspect.signature(condition).parameters.values()
        every = any(x.kind is x.VAR_KEYWORD for x in known)
        names = {x.name for x in known}

        def wrapped(t: Array, y: Any, args: Any, **options: Any) -> Any:
            asked = {name: x for name, x in options.items() if every or name in names}
            return condition(t0 + t, to_state(y), args, **asked)

        return wrapped

    conditions = jtu.tree_map(of_states, event.cond_fn, is_leaf=callable)
    return dataclasses.replace(event, cond_fn=conditions)


def where_it_happened(final: Any, event: Any, args: Any, options: Any) -> tuple[Array, Any]:
    """Time and state at which a real condition changed its sign within the last step.

    By bisection, which cannot miss. Where no condition ended the loop, or a boolean one did, they
    are those of its end.

    Gradients: those of the implicit function, of first and second order, in every mode.
    """
    conditions, masks, values = (
        jtu.tree_leaves(x, is_leaf=callable)
        for x in (event.cond_fn, final.event_mask, final.event_values)
    )
    real = jnp.array([jnp.issubdtype(jnp.result_type(x), jnp.floating) for x in values])
    ended = jnp.stack(masks) & real
    happened = jnp.any(ended)
    late = jnp.where(happened, final.event_tnext, final.event_tprev + 1)
    interpolant = options["solver"].interpolation_cls(
        t0=final.event_tprev, t1=late, **harmless(happened, final.event_dense_info)
    )
    early, late = jax.lax.stop_gradient((final.event_tprev, late))

    def distance(t: Array) -> Array:
        y = interpolant.evaluate(t)
        values = [jnp.asarray(f(t, y, args, **options), t.dtype) for f in conditions]
        return jnp.sum(jnp.where(ended, jnp.stack(values), 0.0))

    def halve(_: Any, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = low + 0.5 * (high - low)
        beyond = jnp.sign(jax.lax.stop_gradient(distance(middle))) == sign
        return jnp.where(beyond, low, middle), jnp.where(beyond, middle, high)

    sign = jnp.sign(jax.lax.stop_gradient(distance(late)))
    bits = jnp.finfo(late.dtype).nmant + 8
    t = jax.lax.fori_loop(0, bits, halve, (early, late))[1]
    level = jax.lax.stop_gradient(distance(t))
    for _ in range(_NEWTON_STEPS):  # these leave the value as it is
        value, slope = jax.jvp(distance, (t,), (jnp.ones_like(t),))
        t = t - jnp.where(slope == 0, 0.0, (value - level) / jnp.where(slope == 0, 1.0, slope))
    y = jtu.tree_map(lambda x, end: jnp.where(happened, x, end), interpolant.evaluate(t), final.y)
    return jnp.where(happened, t, final.tprev), y
