"""Scales in which a motion is measured: time, each variable, the fastest rate."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jrigid._checks import internal_parts
from jrigid._numerics import power_of_two, safe_norm
from jrigid.systems import AbstractSystem, FloatingState

# Squarings of the Jacobian whose norm estimates its spectral radius.
_SQUARINGS = 6


def jacobian(
    field: Callable[[Array], Array], y: Float[Array, " n"], scales: Float[Array, " n"]
) -> Float[Array, "n n"]:
    """Jacobian of a vector field by differences, which need nothing but its values.

    Of the components in their scales; a row for each component of the state.
    """
    largest = jnp.maximum(1.0, jnp.abs(y / scales))
    step = jnp.sqrt(jnp.finfo(y.dtype).eps) * largest
    # The first row is the place itself.
    which = np.eye(y.size + 1, y.size, k=-1, dtype=y.dtype)
    rates = jax.vmap(lambda row: field(y + row * step * scales))(which)
    return (rates[1:] - rates[:1]) / (step[:, None] * scales[None])


def rate_along(
    field: Callable[[Array], Array],
    y: Float[Array, " n"],
    base: Float[Array, " n"],
    direction: Float[Array, " n"],
    scales: Float[Array, " n"],
) -> tuple[Float[Array, ""], Float[Array, " n"]]:
    """Rate of the linearised motion from a small displacement, and where that points then.

    Called from step to step it is a power iteration, which finds the fastest rate. It
    takes the Jacobian twice: once does not tell the rate of an oscillation.

    Args:
        field: Rates at a place.
        y: The place.
        base: The rates there.
        direction: Of the displacement, of length 1 in the scales.
        scales: Of the components.
    """
    largest = jnp.maximum(1.0, jnp.max(jnp.abs(y / scales)))
    nudge = jnp.sqrt(jnp.finfo(y.dtype).eps) * largest * scales

    def change(_: Any, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        rate, direction = carry
        rates = (field(y + nudge * direction) - base) / nudge
        length = jnp.sqrt(jnp.sum(rates * rates))
        usable = (length > 0) & (length < jnp.inf)
        unit = rates / jnp.where(usable, length, 1.0)
        return rate * jnp.sqrt(length), jnp.where(usable, unit, direction)

    return jax.lax.fori_loop(0, 2, change, (jnp.ones_like(nudge[0]), direction))


def spectral_radius(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """Upper estimate of the largest magnitude of an eigenvalue: ||J^64||^(1/64).

    It does not depend much on the scales of the components, as a norm would. Products
    are written out: a dot of this size costs several times more.
    """

    def square(_: Any, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        matrix, log_factor = carry
        largest = jnp.max(jnp.abs(matrix))
        scale = jnp.where(largest > 0, largest, 1.0)
        matrix = matrix / scale
        matrix = jnp.sum(matrix[:, :, None] * matrix[None, :, :], axis=1)
        return matrix, 2.0 * (log_factor + jnp.log(scale))

    # The power is exp(log_factor) times the matrix that is carried along.
    start = matrix, jnp.zeros_like(matrix[0, 0])
    power, log_factor = jax.lax.fori_loop(0, _SQUARINGS, square, start)
    norm = jnp.max(jnp.sum(jnp.abs(power), axis=1))
    return jnp.exp((log_factor + jnp.log(norm)) / 2**_SQUARINGS)


def undamped_rate(matrix: Array) -> Array:
    """Largest magnitude of an eigenvalue that does not die away within a radian of its own.

    What an implicit solver has to follow: it may step over the others. A matrix that is
    not finite has none.
    """
    matrix = jax.lax.stop_gradient(matrix)
    values = jnp.linalg.eigvals(jnp.where(jnp.all(jnp.isfinite(matrix)), matrix, 0.0))
    damped = -values.real > jnp.abs(values.imag)
    return jnp.max(jnp.where(damped, 0.0, jnp.abs(values)))


def spread(
    system: AbstractSystem,
    state: Any,
    rate: Array,
    length: Any = None,
    speed: Any = None,
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
    full = {
        x: jtu.tree_map(jnp.full_like, value, scale[x])
        for x, value in vars(state).items()
    }
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

    The rate is what `fastest_of` says of the Jacobian, by default its spectral radius,
    and at least that of turning: a body at rest turns at the rate its torque would give
    it within a radian, and one that nothing turns is measured by the length of the run.
    """
    rates = system.vector_field(t0, state0, args)
    span = jnp.where(duration > 0, duration, 1.0)
    turning, spinning_up = safe_norm(jnp.stack([state0.omega, rates.omega]))
    rate = jnp.maximum(turning, jnp.sqrt(spinning_up))
    rate = jnp.where(rate > 0, rate, 1 / span)
    flat, unravel = ravel_pytree(state0)

    def powers(length: Array, speed: Array) -> Array:
        return power_of_two(spread(system, state0, rate, length, speed))

    def fastest(scales: Array) -> Array:
        def field(y: Array) -> Array:
            return ravel_pytree(system.vector_field(t0, unravel(y), args))[0]

        radius = fastest_of(jacobian(field, flat, scales))
        return jnp.maximum(rate, jnp.where(jnp.isfinite(radius), radius, 0.0))

    if not isinstance(state0, FloatingState):
        scales = powers(rate, rate)
        return fastest(scales), scales
    # First scales of the place alone, to find how fast the motion of the centre of mass
    # changes; then its way in that time, or in the whole run if that is shorter. A run
    # of many orbits is not to be measured by |a| T^2. A body at rest on which no force
    # acts is measured in metres.
    position, velocity, pull = (
        safe_norm(x) for x in (state0.position, state0.velocity, rates.velocity)
    )

    def length_and_speed(
        length: Array, speed: Array, time: Array
    ) -> tuple[Array, Array]:
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
