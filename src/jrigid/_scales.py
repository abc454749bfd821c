"""Scales in which `simulate` measures a motion: time, each variable, the fastest rate."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._numerics import power_of_two, product, safe_norm
from jrigid.systems import AbstractSystem


def ravel(tree: Any) -> Array:
    """All components of a pytree in one array, which is how diffrax steps fastest."""
    return jnp.concatenate([x.reshape(-1) for x in jtu.tree_leaves(tree)])


def unravel(components: Array, like: Any) -> Any:
    """The pytree like `like` whose components these are."""
    leaves, structure = jtu.tree_flatten(like)
    parts, start = [], 0
    for leaf in leaves:
        parts.append(components[start : start + leaf.size].reshape(leaf.shape))
        start += leaf.size
    return structure.unflatten(parts)


def units(
    system: AbstractSystem, state0: Any, t_end: Array, t0: Array, args: Any
) -> tuple[Array, Any]:
    """The rate of turning [rad/s] that measures time, and a scale for each component of the state.

    A body at rest turns at the rate its torque would give it within a radian; one that nothing
    turns is measured by the length of the run.
    """
    rates = system.vector_field(t0, state0, args)
    span = jnp.where(t_end > t0, t_end - t0, jnp.ones_like(t_end))
    turning, spinning_up = safe_norm(state0.omega), safe_norm(rates.omega)
    rate = jnp.maximum(turning, jnp.sqrt(spinning_up))
    rate = jnp.where(rate > 0, rate, 1 / span)
    scale: dict[str, Any] = {
        "attitude": jnp.ones_like(rate),
        "omega": rate,
        "internal": system.torque.internal_scale(rate),
    }
    if hasattr(state0, "velocity"):
        # Motion of the centre of mass in one radian of turning, or in the whole run if that is
        # shorter; a body at rest on which no force acts is measured in metres.
        time = jnp.minimum(span, 1 / rate)
        speed = safe_norm(state0.velocity) + safe_norm(rates.velocity) * time
        length = safe_norm(state0.position) + speed * time
        length = jnp.where(length > 0, length, 1.0)
        speed = jnp.where(speed > 0, speed, length / time)
        scale |= {"position": length, "velocity": speed}
    spread = {
        name: jtu.tree_map(lambda s, x: jnp.broadcast_to(s, x.shape), value, getattr(state0, name))
        for name, value in scale.items()
    }
    return rate, power_of_two(ravel(dataclasses.replace(state0, **spread)))


def fastest_rate(vector_field: Callable, y0: Array, args: Any) -> Array:
    """Upper estimate of the fastest rate of the motion linearised about its start.

    The spectral radius of the Jacobian is at most ||J^64||^(1/64), whatever the scales of the
    components; differences will do for J, and ask nothing of a torque but its value.
    """
    size = y0.size
    step = jnp.sqrt(jnp.finfo(y0.dtype).eps)
    nudged = y0[None, :] + step * jnp.eye(size, dtype=y0.dtype)
    zero = jnp.zeros((), y0.dtype)
    there = jax.vmap(lambda y: vector_field(zero, y, args))(nudged)
    jacobian = (there - vector_field(zero, y0, args)[None, :]) / step
    power, exponent = jacobian, zero
    for _ in range(6):
        largest = jnp.max(jnp.abs(power))
        scale = jnp.where(largest > 0, largest, 1.0)
        exponent = 2 * (exponent + jnp.log(scale))
        power = product("ij,jk->ik", power / scale, power / scale)
    norm = jnp.max(jnp.sum(jnp.abs(power), axis=1))
    rate = jnp.exp((exponent + jnp.log(jnp.where(norm > 0, norm, 1.0))) / 64)
    return jnp.where((norm > 0) & jnp.isfinite(rate), rate, 0.0)
