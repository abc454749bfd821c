"""How `simulate` steps: the vector field guarded, the controller that watches its rates."""

import math
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array

from jrigid._checks import all_finite
from jrigid._scales import jacobian, rate_along, undamped_rate

# No step is longer than so many of the shortest time scale, that of the turning or of the
# linearised motion: at an equilibrium the error estimate sees nothing, and a step too long to be
# accurate leaves the value right and the derivative wrong. Between these bounds it is where the
# term of the exponential that a method of its order leaves out is so many tolerances.
SMALLEST_BOUND, _LARGEST_BOUND, _TOLERANCES = 0.4, 1.2, 30.0
# A step is taken back if it turns out, at its end, to have been longer than this many of those.
_TOO_LONG = 2.0
# So is one in which the rate changes by this factor, until the change is confined to a step of
# this many radians: what is switched on at an equilibrium, the error estimate does not see.
_JUMP = 4.0
_CONFINED = 1e-6
# After a step clipped to a sliver by one of the times asked for, the next is full-sized again.
_GROWTH = 1e16

# Equal steps are one fewer where so little of one would be left, which rounding may have made.
_RAGGED = 1e-3


class _Onwards(diffrax.AbstractStepSizeController):
    """A controller for time that grows."""

    def wrap(self, direction):
        """The same."""
        del direction
        return self


def largest_step(order: int, rtol: Array) -> Array:
    """How many radians of the fastest rate a step of this order may span."""
    radians = (math.factorial(order + 1) * _TOLERANCES * rtol) ** (1 / order)
    return jnp.clip(radians, SMALLEST_BOUND, _LARGEST_BOUND)


def in_tolerances(atol: Array, rtol: Array, y0: Array, y1: Array, error: Array) -> Array:
    """An error as a multiple of the tolerances, of one motion, or of lanes, which are last."""
    y0, y1, error = constant((y0, y1, error))
    scaled = error / (atol + jnp.maximum(jnp.abs(y0), jnp.abs(y1)) * rtol[None])
    norm = jnp.sqrt(jnp.mean(scaled * scaled, axis=0))
    return jnp.where(jnp.isnan(norm), jnp.inf, norm)


class WatchfulController(_Onwards, diffrax.AbstractAdaptiveStepSizeController):
    """A controller whose steps are bounded by the motion's fastest rate, which may rise on the way.

    It also reports a step rejected at the resolution of time. A `dtmin` of the PID controller would
    stop a step that is short only because a time asked for is near, too.

    Attributes:
        rtol: Relative tolerance of a step.
        atol: Absolute tolerance of a step, of each component.
        radians: Longest step by the fastest rate.
        limit: Longest step.
        resolution: Shortest step.
        start_rate: Fastest rate at the start.
        scales: Of the components.
        field: The vector field, not differentiated.
        rate_of: `(y, rate)` -> the rate that bounds the steps, of that of the linearised motion.
        damped: Whether the solver may step over what is damped.
        norm: What diffrax would ask for.
    """

    rtol: Array
    atol: Array
    radians: Array
    limit: Array
    resolution: Array
    start_rate: Array
    scales: Array
    field: Callable[[Array, Array, Any], Array]
    rate_of: Callable[[Array, Array], Array]
    damped: bool = eqx.field(static=True)
    norm: Callable[[Any], Array] = optx.rms_norm

    @property
    def _start(self) -> Array:
        """The longest step by the rate at the start."""
        return jnp.minimum(self.radians / self.start_rate, self.limit)

    @property
    def _by_error(self) -> diffrax.PIDController:
        # What an implicit solver steps over bounds it only where it is on the way.
        longest = self.limit if self.damped else self._start
        # It is handed errors in tolerances.
        return diffrax.PIDController(rtol=0, atol=1, dtmax=longest, factormax=_GROWTH)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """The end of the first step; the state also carries the rate where the step begins."""
        del dt0  # diffrax would check one that it is given by a callback
        first = 0.1 * self._start
        t1, state = self._by_error.init(terms, t0, t1, y0, first, args, func, error_order)
        # No motion keeps to this direction.
        direction = jnp.cos(jnp.arange(y0.size, dtype=y0.dtype))
        return t1, (state, self.start_rate, direction / jnp.sqrt(jnp.sum(direction**2)))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, *others):
        """By the error, then by the fastest rate; a torque that turns NaN or infinite ends here."""
        y_error, error_order, (inner_state, rate0, direction) = others
        t, y, args = constant((t1, y1_candidate, args))
        if self.damped:
            rate = undamped_rate(jacobian(self.field, t, y, args, self.scales))
        else:
            base = self.field(t, y, args)
            rate, direction = rate_along(
                lambda y: self.field(t, y, args), y, base, direction, self.scales
            )
        error = in_tolerances(self.atol, self.rtol, y0, y1_candidate, y_error)
        state = (inner_state, rate0)
        *found, state, result = self.judged(
            t0, t1, error, error_order, state, self.rate_of(y, rate)
        )
        return *found, (*state, direction), result

    def judged(self, t0, t1, error, error_order, state, rate):
        """What becomes of a step with an error in tolerances, by the rate at its end."""
        inner_state, rate0 = state
        zero = jnp.zeros_like(error)
        keep, next_t0, next_t1, made_jump, inner_state, result = self._by_error.adapt_step_size(
            t0, t1, zero, zero, None, error, error_order, inner_state
        )
        stuck = ~keep & (next_t1 - next_t0 <= self.resolution)
        result = diffrax.RESULTS.where(stuck, diffrax.RESULTS.dt_min_reached, result)
        rate = jax.lax.stop_gradient(rate)
        # Where a torque jumps, differences see a rate without bound: never down to a standstill.
        shortest = 4 * self.resolution
        longest = jnp.maximum(self.radians / rate, shortest)
        # Changes below the rate at the start are of no account: a body speeds up from rest.
        before, after = (jnp.maximum(r, self.start_rate) for r in (rate0, rate))
        jumped = (after > _JUMP * before) | (before > _JUMP * after)
        confined = jnp.maximum(_CONFINED / jnp.maximum(before, after), shortest)
        tolerable = jnp.where(jumped, confined, _TOO_LONG * longest)
        # Whatever made the rate change is somewhere in the step: halving finds it.
        step = jax.lax.stop_gradient(t1 - t0)
        back = keep & (step > tolerable)
        kept = keep & ~back
        bound = jnp.where(back, jnp.maximum(tolerable / _TOO_LONG, 0.5 * step), longest)
        next_t0 = jnp.where(back, t0, next_t0)
        next_t1 = jnp.where(keep, jnp.minimum(next_t1, next_t0 + bound), next_t1)
        state = (inner_state, jnp.where(kept, rate, rate0))
        return kept, next_t0, next_t1, made_jump, state, result


class SteadyController(_Onwards):
    """Steps of one length, for a solver that makes no error."""

    step: Array

    def init(self, terms, t0, *_):
        """The end of the first step."""
        del terms
        return t0 + self.step, None

    def adapt_step_size(self, t0, t1, *_):
        """The end of the next one."""
        del t0
        return True, t1, t1 + self.step, False, None, diffrax.RESULTS.successful


class EvenSteps(_Onwards):
    """Equal steps from each of the times asked for to the next.

    Attributes:
        times: Asked for.
        end: Of the motion.
        longest: That a step may be.
    """

    times: Array
    end: Array
    longest: Array

    def _next(self, t: Array) -> Array:
        number = jnp.searchsorted(self.times, t, side="right")
        target = jnp.append(self.times, self.end)[number]
        count = jnp.ceil((target - t) / self.longest - _RAGGED)
        return jnp.where(count > 1, t + (target - t) / count, target)

    def init(self, terms, t0, *_):
        """The end of the first step."""
        del terms
        return self._next(t0), None

    def adapt_step_size(self, t0, t1, *_):
        """The end of the next one."""
        del t0
        return True, t1, self._next(t1), False, None, diffrax.RESULTS.successful


class KnownSteps(_Onwards):
    """Steps that another run has taken.

    Attributes:
        ends: Their ends, then infinity.
        result: What became of that run.
    """

    ends: Array
    result: Any

    def init(self, *_):
        """The end of the first step, and the number of the next."""
        return self.ends[0], jnp.array(1)

    def adapt_step_size(self, t0, t1, *others):
        """The end of the next one, or what stopped the other run."""
        del t0
        number = others[-1]
        end = self.ends[number]
        result = diffrax.RESULTS.where(jnp.isfinite(end), diffrax.RESULTS.successful, self.result)
        return True, t1, end, False, number + 1, result


def constant(tree: Any) -> Any:
    """The same without derivatives: what decides on steps is not differentiated."""
    arrays, others = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.lax.stop_gradient(arrays), others)


@eqx.filter_custom_jvp
def guarded(field: Callable, y0: Array, t: Array, y: Array, args: Any) -> Array:  # noqa: ARG001
    """The vector field, with a large number for NaN and infinities, so that no NaN comes back.

    A step into a place where the field is not finite is rejected, and a lane that ends there is
    masked; but in reverse mode a cotangent of zero times NaN is NaN, in everything the lanes
    share. Derivatives there are taken at the start instead, where the field is finite.
    """
    rates = field(t, y, args)
    largest = jnp.sqrt(jnp.finfo(rates.dtype).max)
    return jnp.where(jnp.isfinite(rates), rates, largest)


@guarded.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    field, y0, t, y, args = primals
    field_dot, _, t_dot, y_dot, args_dot = tangents
    usable = all_finite(field(t, y, args))

    def usable_field(field: Callable, t: Array, y: Array, args: Any) -> Array:
        return field(jnp.where(usable, t, jnp.zeros_like(t)), jnp.where(usable, y, y0), args)

    _, rates_dot = eqx.filter_jvp(
        usable_field, (field, t, y, args), (field_dot, t_dot, y_dot, args_dot)
    )
    return guarded(*primals), jnp.where(usable, rates_dot, jnp.zeros_like(rates_dot))
