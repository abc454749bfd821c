"""A motion that is integrated: its data and its progress."""

from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jrigid._numerics import inverse_of_power
from jrigid._stepping.control import Limits

Tree = TypeVar("Tree")

# States of a motion that is integrated; EMPTY is the state of a lane without a motion.
RUNNING, ENDED, STUCK, NOT_FINITE, EVENT, TOO_MANY_STEPS, EMPTY = range(7)


class Motion(NamedTuple):
    """The data of a motion that starts at time 0.

    Attributes:
        parameters: Arrays that the vector field depends on.
        observed: Arrays that the conditions of an event depend on.
        y0: State at the start.
        times: Output times, in order.
        jumps: Times at which the vector field is not smooth, in order; infinite ones
            are none.
        beside: For each jump, the distance from it at which the vector field is
            evaluated.
        scales: Scales of the components of the state.
        limits: Bounds of the steps. A motion whose fastest rate is zero ends at its
            start.
    """

    parameters: list[Array]
    observed: list[Array]
    y0: Float[Array, " n"]
    times: Float[Array, " times"]
    jumps: Float[Array, " jumps"]
    beside: Float[Array, " jumps"]
    scales: Float[Array, " n"]
    limits: Limits


def constant(tree: Tree) -> Tree:
    """The same pytree without derivatives; the choice of steps has none."""
    arrays, others = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.lax.stop_gradient(arrays), others)


def steps_fixed(motion: Motion) -> Motion:
    """The motion, of which only the parameters and the start have derivatives."""
    # What keeps its derivatives is left out here and put back below.
    fixed = constant(motion._replace(parameters=[], y0=motion.y0[:0]))
    return fixed._replace(parameters=motion.parameters, y0=motion.y0)


class Progress(NamedTuple):
    """A motion between two steps.

    Attributes:
        y: The state.
        direction: Of a small displacement, which finds the fastest rate.
        clock: The time; the length of the next step; the fastest rate; the time at
            which the motion ends, which an event may change.
        counts: One of the states above; steps tried; steps accepted; index of the next
            output time; index of the next jump; index of the condition whose zero
            ends the motion, -1 if none is zero.
        values: Of the conditions of an event.
    """

    y: Float[Array, " n"]
    direction: Float[Array, " n"]
    clock: Float[Array, " 4"]
    counts: Int[Array, " 6"]
    values: Float[Array, " conditions"]

    @property
    def t(self) -> Float[Array, "*lanes"]:
        """The time."""
        return self.clock[0]

    @property
    def running(self) -> Bool[Array, "*lanes"]:
        """Whether the motion has not ended yet."""
        return self.counts[0] == RUNNING


def first_direction(y: Float[Array, " n"]) -> Float[Array, " n"]:
    """A direction of length 1 that is no eigenvector of a usual motion."""
    # The cosines of whole numbers of radians are all different, and none is zero.
    direction = np.cos(np.arange(y.size))
    return jnp.asarray(direction / np.linalg.norm(direction), y.dtype)


def fastest_rate(scales: Array, omega: int, y: Array, other: Array) -> Array:
    """The rate that bounds the steps: that of turning, or `other` if it is faster.

    Args:
        scales: Of the components of the state; powers of two.
        omega: Where in the state the angular velocity starts.
        y: The state.
        other: Rate of the linearised motion.
    """
    # Scaled, since the squares of rates may be out of the range of the dtype.
    scaled = (y * inverse_of_power(scales))[omega : omega + 3]
    turning = scales[omega] * jnp.sqrt(jnp.sum(scaled * scaled))
    rate = jnp.maximum(other, turning)
    # Lengths of steps are angles divided by this rate, so it must not be zero.
    tiny = jnp.finfo(rate.dtype).tiny
    return jnp.maximum(jnp.where(jnp.isfinite(rate), rate, 0.0), tiny)
