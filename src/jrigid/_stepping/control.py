"""Step-size control: by the estimated error, and by the fastest rate of the motion."""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jrigid._numerics import inverse_of_power

# Bounds of a step in radians of the fastest rate, which is that of the turning or of
# the linearised motion. At an equilibrium the error estimate is zero: a step that is
# too long leaves the value right and the derivative wrong. Between these bounds the
# length of a step follows from the term of the exponential series that a method of its
# order omits: that term may be this many tolerances. The second numbers hold where
# derivatives are taken, which are more sensitive than the error estimate.
SMALLEST_BOUND = 0.4
_LARGEST_BOUNDS = 1.2, 0.8
_TOLERANCES = 30.0, 0.1
# A step is repeated if, by the rate at its end, it was longer than this many bounds.
_TOO_LONG = 2.0
# A step in which the rate changes by this factor is repeated until the change is
# confined to a step of this many radians. The error estimate misses a torque that is
# switched on at an equilibrium.
_JUMP = 4.0
_CONFINED = 1e-6
# The longest step of a motion may commit the whole tolerance. A shorter one may commit
# less: steps are short where a torque is not smooth, and there the estimate is no
# bound. The share grows with the square of the length. Shares in proportion to the
# length are enough where estimates are bounds; with them the worst of 16 torques of
# each kind had 3.3 times the promised error of the energy, with squares it has 0.3
# times (benchmarks/bench_nonsmooth.py, whose motions were used to choose these
# numbers). A step can pass a jump because the share has a minimum, and because steps of
# a few times the shortest length may commit the whole tolerance again.
_SMALLEST_SHARE = 3e-3
_AT_A_JUMP = 8.0
# Safety factor of a new step, and the factors by which a step may shrink and grow.
_SAFETY = 0.88
_SHRINK = 0.2
_GROW = 1e3
# An error estimate below this many eps of the state is rounding noise.
_NOISE = 8.0


class Limits(NamedTuple):
    """Bounds of the steps of a motion. Times are in seconds since its start.

    Attributes:
        end: Where the motion ends.
        rtol: Relative error that a step may commit.
        atol: Absolute error that a step may commit, in the scales of the components.
        radians: Longest step, in radians of the fastest rate.
        fine: The same where derivatives are taken.
        whole: A step of this many radians may commit the whole tolerance.
        longest: Longest step.
        shortest: Shortest step; a quarter of it still changes the time.
        start_rate: Fastest rate at the start [rad/s].
    """

    end: Float[Array, ""]
    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    radians: Float[Array, ""]
    fine: Float[Array, ""]
    whole: Float[Array, ""]
    longest: Float[Array, ""]
    shortest: Float[Array, ""]
    start_rate: Float[Array, ""]

    def for_derivatives(self) -> "Limits":
        """The limits of a motion whose derivatives are taken."""
        longest = jnp.minimum(self.longest, self.fine / self.start_rate)
        return self._replace(radians=self.fine, longest=longest)


class Verdict(NamedTuple):
    """Whether a step is accepted, and the length of the next one.

    Attributes:
        accepted: Whether the motion continues from the end of the step.
        stuck: Whether no shorter step can be tried.
        step: Length of the next step.
        rate: Fastest rate where the next step starts.
    """

    accepted: Bool[Array, ""]
    stuck: Bool[Array, ""]
    step: Float[Array, ""]
    rate: Float[Array, ""]


def largest_steps(
    order: int, rtol: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Longest step of a method of this order, in radians of the fastest rate.

    The second number holds where derivatives are taken.
    """
    # A method of this order omits the term x^(order + 1) / (order + 1)! of a step of x
    # radians. This is x^order / (order + 1)! for each radian.

    def longest(tolerances: float, bound: float) -> Array:
        error = math.factorial(order + 1) * tolerances * rtol
        return jnp.clip(error ** (1 / order), SMALLEST_BOUND, bound)

    for_values, for_derivatives = map(longest, _TOLERANCES, _LARGEST_BOUNDS)
    return for_values, for_derivatives


def in_tolerances(
    limits: Limits, scales: Array, y0: Array, y1: Array, error: Array
) -> Float[Array, ""]:
    """Root mean square of an error's components, each divided by its tolerance."""
    inverse = inverse_of_power(scales)
    size = jnp.maximum(jnp.abs(y0), jnp.abs(y1)) * inverse
    multiples = (error * inverse) / (limits.atol + size * limits.rtol)
    norm = jnp.sqrt(jnp.mean(multiples * multiples))
    # An infinite error shrinks the next step as far as is allowed. NaN would become the
    # length of that step.
    return jnp.where(jnp.isnan(norm), jnp.inf, norm)


def _share_of_tolerance(
    limits: Limits, h: Float[Array, ""], rate: Float[Array, ""]
) -> Float[Array, ""]:
    """The share of the tolerance that a step of length `h` may commit."""
    part = h * rate / limits.whole
    share = jnp.clip(part * part, _SMALLEST_SHARE, 1.0)
    return jnp.where(h < _AT_A_JUMP * limits.shortest, 1.0, share)


def _judge_error(
    limits: Limits,
    order: int,
    h: Float[Array, ""],
    error: Float[Array, ""],
    rate: Float[Array, ""],
) -> tuple[Bool[Array, ""], Float[Array, ""]]:
    """Whether the error of a step is small enough, and the length that it suggests."""
    share = _share_of_tolerance(limits, h, rate)
    # Rounding noise in the estimate must not decide on this step or on the next one.
    noise = _NOISE * jnp.finfo(error.dtype).eps
    small = (error < share) | (error * limits.rtol < noise)
    error = error / share
    beyond_noise = jnp.maximum(error * limits.rtol, noise) / limits.rtol
    # The error estimate of a pair of orders p and p - 1 grows with h^p.
    factor = _SAFETY * beyond_noise ** (-1 / order)
    # By its error an accepted step never shortens the next one, and a rejected one
    # always does.
    factor = jnp.where(
        small, jnp.clip(factor, 1.0, _GROW), jnp.clip(factor, _SHRINK, _SAFETY)
    )
    return small, factor * h


def _longest_tolerable(
    limits: Limits,
    longest: Float[Array, ""],
    rate0: Float[Array, ""],
    rate1: Float[Array, ""],
) -> Float[Array, ""]:
    """The longest step that is accepted between two fastest rates.

    Args:
        limits: Of the motion.
        longest: Longest step by the rate at its end.
        rate0: Fastest rate at the start of the step.
        rate1: The same at its end.
    """
    # Changes below the rate at the start do not matter: a body speeds up from rest.
    before, after = (jnp.maximum(rate, limits.start_rate) for rate in (rate0, rate1))
    jumped = (after > _JUMP * before) | (before > _JUMP * after)
    confined = jnp.maximum(_CONFINED / jnp.maximum(before, after), limits.shortest)
    return jnp.where(jumped, confined, _TOO_LONG * longest)


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
        h: The length that was tried, which ends at an output time if one is near.
        error: In tolerances.
        rate0: Fastest rate at the start of the step.
        rate1: The same at its end.
    """
    small, following = _judge_error(limits, order, h, error, rate0)
    # A step that was cut short at an output time says little about the next one.
    following = jnp.where(small & (h < step), jnp.maximum(following, step), following)
    following = jnp.minimum(following, limits.longest)
    # Below a quarter of the shortest step a length might not change the time.
    stuck = ~small & (4 * following <= limits.shortest)
    # Where a torque jumps, differences yield a rate without bound, which must not
    # reduce the steps to zero.
    longest = jnp.maximum(limits.radians / rate1, limits.shortest)
    tolerable = _longest_tolerable(limits, longest, rate0, rate1)
    too_long = small & (h > tolerable)
    # The cause of a change of the rate lies somewhere in the step: halving finds it.
    halved = jnp.maximum(tolerable / _TOO_LONG, 0.5 * h)
    bound = jnp.where(too_long, halved, longest)
    following = jnp.where(small, jnp.minimum(following, bound), following)
    accepted = small & ~too_long
    return Verdict(accepted, stuck, following, jnp.where(accepted, rate1, rate0))
