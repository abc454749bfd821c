"""Step-size control: by the estimated error, and by the fastest rate of the motion."""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# No step is longer than so many radians of the fastest rate, that of the turning or of
# the linearised motion: at an equilibrium the error estimate sees nothing, and a step
# too long to be accurate leaves the value right and the derivative wrong. Between these
# bounds a step is as long as makes the term of the exponential that a method of its
# order leaves out so many tolerances. The second numbers hold where derivatives are
# taken, which see more than the error estimate does.
SMALLEST_BOUND = 0.4
_LARGEST_BOUNDS = 1.2, 0.8
_TOLERANCES = 30.0, 0.1
# A step is repeated if it turns out, at its end, to have been longer than this many of
# those bounds.
_TOO_LONG = 2.0
# So is one in which the rate changes by this factor, until the change is confined to a
# step of this many radians: the error estimate does not see a torque that is switched
# on at an equilibrium.
_JUMP = 4.0
_CONFINED = 1e-6
# A step may commit the whole tolerance if it covers so many radians, a shorter one
# less: steps are short where a torque is not smooth, and there the estimate is no
# bound. Errors in proportion to the radians would be enough for steps whose estimates
# are bounds; with the square the worst of 16 torques of each kind was 1.8 times the
# promise, where it had been 10.7 (benchmarks/bench_nonsmooth.py, on whose motions the
# numbers below were chosen). A jump can be passed because there is a smallest part,
# and because steps of a few times the shortest length may commit the whole again.
_WHOLE = 1.0
_SMALLEST_PART = 3e-3
_AT_A_JUMP = 8.0
# Factors by which a step may shrink and grow.
_SAFETY, _SHRINK, _GROW = 0.88, 0.2, 1e3
# An error estimate below so many eps of the state is rounding noise.
_NOISE = 8.0


class Limits(NamedTuple):
    """What holds the steps of a motion. Times are in seconds since its start.

    Attributes:
        end: Where the motion ends.
        rtol: Relative error that a step may commit.
        atol: Absolute error that a step may commit, in the scales of the components.
        radians: Longest step, in radians of the fastest rate.
        fine: The same where derivatives are taken.
        longest: Longest step.
        shortest: Shortest step, of which a quarter can still be told from none.
        start_rate: Fastest rate at the start [rad/s].
    """

    end: Float[Array, ""]
    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    radians: Float[Array, ""]
    fine: Float[Array, ""]
    longest: Float[Array, ""]
    shortest: Float[Array, ""]
    start_rate: Float[Array, ""]

    def for_derivatives(self) -> "Limits":
        """The limits of a motion whose derivatives are taken."""
        longest = jnp.minimum(self.longest, self.fine / self.start_rate)
        return self._replace(radians=self.fine, longest=longest)


class Verdict(NamedTuple):
    """What becomes of a step.

    Attributes:
        accepted: Whether the motion goes on from its end.
        stuck: Whether no shorter step can be tried.
        step: Length of the next one.
        rate: Fastest rate where the next one starts.
    """

    accepted: Bool[Array, ""]
    stuck: Bool[Array, ""]
    step: Float[Array, ""]
    rate: Float[Array, ""]


def largest_steps(order: int, rtol: Float[Array, ""]) -> Float[Array, "2"]:
    """How many radians of the fastest rate a step of this order may span.

    The second number is that where derivatives are taken.
    """
    error = math.factorial(order + 1) * rtol * jnp.array(_TOLERANCES, rtol.dtype)
    largest = jnp.array(_LARGEST_BOUNDS, rtol.dtype)
    return jnp.clip(error ** (1 / order), SMALLEST_BOUND, largest)


def in_tolerances(
    limits: Limits, scales: Array, y0: Array, y1: Array, error: Array
) -> Float[Array, ""]:
    """Root mean square of the components of an error, as multiples of their tolerances."""
    size = jnp.maximum(jnp.abs(y0 / scales), jnp.abs(y1 / scales))
    multiples = (error / scales) / (limits.atol + size * limits.rtol)
    norm = jnp.sqrt(jnp.mean(multiples * multiples))
    return jnp.where(jnp.isnan(norm), jnp.inf, norm)


def judge(
    limits: Limits,
    order: int,
    step: Float[Array, ""],
    h: Float[Array, ""],
    error: Float[Array, ""],
    rate0: Float[Array, ""],
    rate1: Float[Array, ""],
) -> Verdict:
    """Accept a step or repeat it, and choose the next one.

    Args:
        limits: Of the motion.
        order: Of the method.
        step: The length that was chosen.
        h: The length that was tried, up to an output time if one was near.
        error: In tolerances.
        rate0: Fastest rate at the start of the step.
        rate1: The same at its end.
    """
    radians = h * rate0 / _WHOLE
    part = jnp.clip(radians * radians, _SMALLEST_PART, 1.0)
    part = jnp.where(h < _AT_A_JUMP * limits.shortest, 1.0, part)
    # An estimate may be rounding noise, which must not decide on a step or on the next.
    noise = _NOISE * jnp.finfo(error.dtype).eps
    small = (error < part) | (error * limits.rtol < noise)
    error = error / part
    beyond_noise = jnp.maximum(error * limits.rtol, noise) / limits.rtol
    factor = _SAFETY * beyond_noise ** (-1 / order)
    factor = jnp.where(
        small, jnp.clip(factor, 1.0, _GROW), jnp.clip(factor, _SHRINK, _SAFETY)
    )
    following = factor * h
    # A step that was cut short says little about the next one.
    following = jnp.where(small & (h < step), jnp.maximum(following, step), following)
    following = jnp.minimum(following, limits.longest)
    stuck = ~small & (4 * following <= limits.shortest)
    # Where a torque jumps, differences see a rate without bound: steps must not become
    # zero there.
    longest = jnp.maximum(limits.radians / rate1, limits.shortest)
    # Changes below the rate at the start do not matter: a body speeds up from rest.
    before, after = (jnp.maximum(r, limits.start_rate) for r in (rate0, rate1))
    jumped = (after > _JUMP * before) | (before > _JUMP * after)
    confined = jnp.maximum(_CONFINED / jnp.maximum(before, after), limits.shortest)
    tolerable = jnp.where(jumped, confined, _TOO_LONG * longest)
    too_long = small & (h > tolerable)
    # Whatever made the rate change is somewhere in the step: halving finds it.
    halved = jnp.maximum(tolerable / _TOO_LONG, 0.5 * h)
    bound = jnp.where(too_long, halved, longest)
    following = jnp.where(small, jnp.minimum(following, bound), following)
    accepted = small & ~too_long
    return Verdict(accepted, stuck, following, jnp.where(accepted, rate1, rate0))
