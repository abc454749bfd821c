"""Scales in which a motion is measured: time, each variable, the fastest rate."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jrigid._checks import internal_parts
from jrigid._numerics import power_of_two, safe_norm
from jrigid.systems import AbstractSystem, FloatingState


def jacobian(vector_field: Callable, t: Array, y: Array, args: Any, scales: Array) -> Array:
    """Jacobian of the vector field by differences, which ask nothing of a torque but its value.

    Of the components in their scales. A row for each of y: the transpose of the usual one.
    """
    step = jnp.sqrt(jnp.finfo(y.dtype).eps) * jnp.maximum(1.0, jnp.abs(y / scales))
    nudges = jnp.concatenate([jnp.zeros_like(y)[None], jnp.diag(step * scales)])
    rates = jax.vmap(lambda nudge: vector_field(t, y + nudge, args))(nudges)
    return (rates[1:] - rates[:1]) / (step[:, None] * scales[None])


def rate_along(
    field: Callable[[Array], Array], y: Array, base: Array, direction: Array, scales: Array
) -> tuple[Array, Array]:
    """Rate of the linearised motion from a small displacement, and where that points in the end.

    Called from step to step it is a power iteration, which finds the fastest rate. Twice the
    Jacobian, since once does not tell the rate of an oscillation.

    Args:
        field: Rates at a place: of one motion, or of lanes, which are last.
        y: The place.
        base: The rates there.
        direction: Of the displacement, of length 1 in the scales.
        scales: Of the components.
    """
    largest = jnp.max(jnp.abs(y / scales), axis=0)
    nudge = jnp.sqrt(jnp.finfo(y.dtype).eps) * jnp.maximum(1.0, largest)[None] * scales

    def change(direction: Array) -> tuple[Array, Array]:
        there = y + nudge * direction
        rates = (field(there) - base) / nudge
        length = jnp.sqrt(jnp.sum(rates * rates, axis=0))
        unit = rates / jnp.where(length > 0, length, 1.0)[None]
        return length, jnp.where((length > 0)[None], unit, direction)

    first, once = change(direction)
    second, twice = change(once)
    return jnp.sqrt(first * second), twice


def spectral_radius(matrix: Array, rounds: int = 2) -> Array:
    """Upper estimate of the largest magnitude of an eigenvalue: ||J^n||^(1/n), n = 8^rounds.

    It does not depend much on the scales of the components, as a norm would. Products are written
    out: a dot of this size costs several times more.
    """
    if rounds == 0:
        return jnp.max(jnp.sum(jnp.abs(matrix), axis=1))
    largest = jnp.max(jnp.abs(matrix))
    scale = jnp.where(largest > 0, largest, 1.0)
    matrix = matrix / scale
    for _ in range(3):
        matrix = jnp.sum(matrix[:, :, None] * matrix[None, :, :], axis=1)
    return scale * jnp.sqrt(jnp.sqrt(jnp.sqrt(spectral_radius(matrix, rounds - 1))))


def undamped_rate(matrix: Array) -> Array:
    """Largest magnitude of an eigenvalue that does not die away within a radian of its own.

    What an implicit solver has to follow: it may step over the others. A matrix that is not finite
    has none.
    """
    matrix = jax.lax.stop_gradient(matrix)
    values = jnp.linalg.eigvals(jnp.where(jnp.all(jnp.isfinite(matrix)), matrix, 0.0))
    damped = -values.real > jnp.abs(values.imag)
    return jnp.max(jnp.where(damped, 0.0, jnp.abs(values)))


def spread(
    system: AbstractSystem, state: Any, rate: Array, length: Any = None, speed: Any = None
) -> Array:
    """A scale for each component of the state of what turns at a rate; length and speed of flight.

    Those of internal parts are what the torque says.
    """
    scale: dict[str, Any] = {
        "position": length,
        "velocity": speed,
        "attitude": jnp.ones_like(rate),
        "omega": rate,
        "internal": internal_parts(system.torque.internal_scale(rate)),
    }
    full = {x: jtu.tree_map(jnp.full_like, value, scale[x]) for x, value in vars(state).items()}
    return ravel_pytree(dataclasses.replace(state, **full))[0]


def units(
    system: AbstractSystem,
    state0: Any,
    duration: Array,
    t0: Array,
    args: Any,
    fastest_of: Callable[[Array], Array] = spectral_radius,
) -> tuple[Array, Array]:
    """The fastest rate of the motion [rad/s], and a scale for each component of the state.

    The rate is what `fastest_of` says of the Jacobian, by default its spectral radius, and at least
    that of turning: a body at rest turns at the rate its torque would give it within a radian, and
    one that nothing turns is measured by the length of the run.
    """
    rates = system.vector_field(t0, state0, args)
    span = jnp.where(duration > 0, duration, 1.0)
    rate = jnp.maximum(safe_norm(state0.omega), jnp.sqrt(safe_norm(rates.omega)))
    rate = jnp.where(rate > 0, rate, 1 / span)
    flat, unravel = ravel_pytree(state0)

    def powers(length: Array, speed: Array) -> Array:
        return power_of_two(spread(system, state0, rate, length, speed))

    def fastest(scales: Array) -> Array:
        def vector_field(t: Array, y: Array, args: Any) -> Array:
            return ravel_pytree(system.vector_field(t, unravel(y), args))[0]

        radius = fastest_of(jacobian(vector_field, t0, flat, args, scales))
        return jnp.maximum(rate, jnp.where(jnp.isfinite(radius), radius, 0.0))

    if not isinstance(state0, FloatingState):
        scales = powers(rate, rate)
        return fastest(scales), scales
    # First scales of the place alone, to find how fast the motion of the centre of mass changes;
    # then its way in that time, or in the whole run if that is shorter. A run of many orbits is
    # not to be measured by |a| T^2. A body at rest on which no force acts is measured in metres.
    position, velocity, pull = (
        safe_norm(x) for x in (state0.position, state0.velocity, rates.velocity)
    )

    def length_and_speed(length: Array, speed: Array, time: Array) -> tuple[Array, Array]:
        length = jnp.where(length > 0, length, speed * time)
        length = jnp.where(length > 0, length, 1.0)
        return length, jnp.where(speed > 0, speed, length / time)

    time = jnp.minimum(span, 1 / rate)
    bend = jnp.where(pull > 0, velocity / jnp.where(pull > 0, pull, 1.0), time)
    way = jnp.maximum(position, velocity * jnp.minimum(time, bend))
    speed = jnp.where(velocity > 0, velocity, pull * time)
    quickest = fastest(powers(*length_and_speed(way, speed, time)))
    time = jnp.minimum(span, 1 / quickest)
    speed = jnp.maximum(velocity, pull * time)
    way = jnp.maximum(position, speed * time)
    return quickest, powers(*length_and_speed(way, speed, time))
