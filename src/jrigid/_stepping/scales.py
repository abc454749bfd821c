"""Scales of a motion: its fastest rate, and one for each component of its state."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

from jrigid._checks import internal_parts
from jrigid._numerics import inverse_of_power, power_of_two, safe_norm
from jrigid._types import BodyState
from jrigid.systems import AbstractSystem, FloatingState

# Squarings of the Jacobian: the norm of this power estimates its spectral radius.
_SQUARINGS = 6


def jacobian(
    field: Callable[[Array], Array], y: Float[Array, " n"], scales: Float[Array, " n"]
) -> Float[Array, "n n"]:
    """Transposed Jacobian of a vector field, in scaled components, by differences.

    Differences need no derivative rules of a user's function. Each row belongs to a
    component of the state.

    Args:
        field: The vector field, of the state.
        y: The state.
        scales: Of the components; powers of two.
    """
    largest = jnp.maximum(1.0, jnp.abs(y * inverse_of_power(scales)))
    step = _step_of_difference(largest)
    # The first row is zero: the state itself.
    which = np.eye(y.size + 1, y.size, k=-1, dtype=y.dtype)
    rates = jax.vmap(lambda row: field(y + row * step * scales))(which)
    inverse = inverse_of_power(step)[:, None] * inverse_of_power(scales)[None]
    return (rates[1:] - rates[:1]) * inverse


def _step_of_difference(largest: Array) -> Array:
    """The step of a forward difference, from the largest component of the state.

    It balances the error of rounding and that of truncation, and is a power of two.
    """
    half = 0.5 * math.sqrt(jnp.finfo(largest.dtype).eps) * largest
    # The next power of two above half of a number is at most that number.
    return power_of_two(half)


def rate_along(
    field: Callable[[Array], Array],
    y: Float[Array, " n"],
    base: Float[Array, " n"],
    direction: Float[Array, " n"],
    scales: Float[Array, " n"],
) -> tuple[Float[Array, ""], Float[Array, " n"]]:
    """Rate of the linearised motion along a direction, and the next direction.

    Repeated at each step this is a power iteration, which finds the fastest rate. The
    Jacobian is applied twice, since a single application does not give the rate of an
    oscillation.

    Args:
        field: Vector field, of the state.
        y: The state.
        base: Value of the field at that state.
        direction: Of the displacement, of length 1 in the scales.
        scales: Of the components; powers of two.
    """
    largest = jnp.maximum(1.0, jnp.max(jnp.abs(y * inverse_of_power(scales))))
    nudge = _step_of_difference(largest) * scales

    def change(_: Int[Array, ""], carry: tuple[Array, Array]) -> tuple[Array, Array]:
        rate, direction = carry
        rates = (field(y + nudge * direction) - base) / nudge
        length = jnp.sqrt(jnp.sum(rates * rates))
        usable = (length > 0) & (length < jnp.inf)
        unit = rates / jnp.where(usable, length, 1.0)
        # The geometric mean of both growths is the rate, also of an oscillation.
        return rate * jnp.sqrt(length), jnp.where(usable, unit, direction)

    return jax.lax.fori_loop(0, 2, change, (jnp.ones_like(nudge[0]), direction))


def spectral_radius(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """Upper estimate of the largest magnitude of an eigenvalue: ||J^64||^(1/64).

    Unlike a norm it depends little on the scales of the components. Products are
    written out, since a dot of this size takes several times longer.
    """

    def square(_: Int[Array, ""], carry: tuple[Array, Array]) -> tuple[Array, Array]:
        matrix, log_factor = carry
        largest = jnp.max(jnp.abs(matrix))
        # Without the scale the high power of a matrix could overflow.
        scale = power_of_two(largest)
        matrix = matrix * inverse_of_power(scale)
        matrix = jnp.sum(matrix[:, :, None] * matrix[None, :, :], axis=1)
        return matrix, 2.0 * (log_factor + jnp.log(scale))

    # The power is exp(log_factor) times the matrix in the carry.
    start = matrix, jnp.zeros_like(matrix[0, 0])
    power, log_factor = jax.lax.fori_loop(0, _SQUARINGS, square, start)
    norm = jnp.max(jnp.sum(jnp.abs(power), axis=1))
    return jnp.exp((log_factor + jnp.log(norm)) / 2**_SQUARINGS)


def undamped_rate(matrix: Array) -> Array:
    """Largest magnitude of an eigenvalue whose motion is not damped within a radian.

    An implicit solver must follow these motions and may step over the others. The
    result is zero for a matrix that is not finite.
    """
    matrix = jax.lax.stop_gradient(matrix)
    values = jnp.linalg.eigvals(jnp.where(jnp.all(jnp.isfinite(matrix)), matrix, 0.0))
    # The amplitude falls by more than a factor of e within a radian of its oscillation.
    damped = -values.real > jnp.abs(values.imag)
    return jnp.max(jnp.where(damped, 0.0, jnp.abs(values)))


def spread(
    system: AbstractSystem,
    state: BodyState,
    rate: Array,
    length: Array | None = None,
    speed: Array | None = None,
    rounded: Callable[[Array], Array] = lambda scale: scale,
) -> Array:
    """A scale for each component of the state of a body that turns at a rate.

    The torque states the scales of its internal parts.

    Args:
        system: The body.
        state: Its state.
        rate: Of turning [rad/s].
        length: Scale of the position of a body in flight [m].
        speed: Scale of its velocity [m/s].
        rounded: Applied to each scale.
    """
    of_parts = internal_parts(system.torque.internal_scale(rate))
    have = jtu.tree_structure(of_parts)
    want = jtu.tree_structure(state.internal)
    if have != want:
        raise ValueError(
            "Method `internal_scale` of a torque must return a tuple as that of "
            f"`internal_at_rest`, of {want.num_leaves} arrays, but it returns one of "
            f"{have.num_leaves}."
        )
    scale: dict[str, PyTree[Array]] = {
        "position": length,
        "velocity": speed,
        "attitude": jnp.ones_like(rate),
        "omega": rate,
        "internal": of_parts,
    }

    def filled(value: Array, scale: Array) -> Array:
        return jnp.full_like(value, rounded(scale))

    full = {
        name: jtu.tree_map(filled, value, scale[name])
        for name, value in vars(state).items()
    }
    return ravel_pytree(dataclasses.replace(state, **full))[0]


class _Start(NamedTuple):
    """A system at its start, for the choice of units.

    Attributes:
        system: The system.
        state: Its state.
        t0: The time.
        args: Of torques and forces.
        rate: Rate of turning [rad/s].
        fastest_of: Returns the fastest rate of a transposed Jacobian.
    """

    system: AbstractSystem
    state: BodyState
    t0: Array
    args: PyTree
    rate: Array
    fastest_of: Callable[[Array], Array]

    def powers(self, length: Array, speed: Array) -> Array:
        """Scales of the components of the state, as powers of two."""
        # Products with powers of two do not round.
        return spread(self.system, self.state, self.rate, length, speed, power_of_two)

    def fastest(self, scales: Array) -> Array:
        """The fastest rate of the linearised motion, at least that of turning."""
        flat, unravel = ravel_pytree(self.state)

        def field(y: Array) -> Array:
            rates = self.system.vector_field(self.t0, unravel(y), self.args)
            return ravel_pytree(rates)[0]

        radius = self.fastest_of(jacobian(field, flat, scales))
        # Beside a singularity of the field the differences may not be finite.
        return jnp.maximum(self.rate, jnp.where(jnp.isfinite(radius), radius, 0.0))


def units(
    system: AbstractSystem,
    state0: BodyState,
    duration: Array,
    t0: Array,
    args: PyTree,
    fastest_of: Callable[[Array], Array] = spectral_radius,
) -> tuple[Array, Array]:
    """The fastest rate of the motion [rad/s], and scales of the state's components.

    The rate is what `fastest_of` returns for the Jacobian, by default its spectral
    radius, and at least the rate of turning. For a body at rest this is the rate that
    its torque gives it within a radian. If nothing turns the body, it is the inverse of
    the length of the run.
    """
    rates: Any = system.vector_field(t0, state0, args)
    span = jnp.where(duration > 0, duration, 1.0)
    turning = safe_norm(state0.omega)
    rate = jnp.maximum(turning, jnp.sqrt(safe_norm(rates.omega)))
    rate = jnp.where(rate > 0, rate, 1 / span)
    start = _Start(system, state0, t0, args, rate, fastest_of)
    if isinstance(state0, FloatingState):
        return _units_in_flight(start, state0, rates.velocity, span)
    scales = start.powers(rate, rate)
    return start.fastest(scales), scales


def _units_in_flight(
    start: _Start, state0: FloatingState, acceleration: Array, span: Array
) -> tuple[Array, Array]:
    """The fastest rate and the scales of a body in flight.

    The first scales belong to the place alone. They give the rate at which the motion
    of the centre of mass changes. The length is then the way within the inverse of that
    rate, or within the run if that is shorter: a run of many orbits must not be
    measured by |a| T^2. A body at rest on which no force acts is measured in metres.
    """
    position, velocity, pull = (
        safe_norm(x) for x in (state0.position, state0.velocity, acceleration)
    )
    time = jnp.minimum(span, 1 / start.rate)
    # The time in which the pull changes the velocity by its own magnitude.
    bend = jnp.where(pull > 0, velocity / jnp.where(pull > 0, pull, 1.0), time)
    way = jnp.maximum(position, velocity * jnp.minimum(time, bend))
    speed = jnp.where(velocity > 0, velocity, pull * time)
    quickest = start.fastest(start.powers(*_length_and_speed(way, speed, time)))
    time = jnp.minimum(span, 1 / quickest)
    speed = jnp.maximum(velocity, pull * time)
    way = jnp.maximum(position, speed * time)
    return quickest, start.powers(*_length_and_speed(way, speed, time))


def _length_and_speed(length: Array, speed: Array, time: Array) -> tuple[Array, Array]:
    """Scales of length and speed, each from the other or from 1 m where it is zero."""
    length = jnp.where(length > 0, length, speed * time)
    length = jnp.where(length > 0, length, 1.0)
    return length, jnp.where(speed > 0, speed, length / time)
