"""How `simulate` steps: the vector field guarded, and a controller that watches the fastest rate.

A module of its own, since both are about one step and nothing else in `simulate` is.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._checks import all_finite
from jrigid._scales import jacobian, spectral_radius

# No step is longer than this fraction of the shortest time scale, that of the turning or of the
# linearised motion: at an equilibrium the error estimate sees nothing, and a step too long to be
# stable leaves the value right and the derivative wrong.
LARGEST_STEP = 0.4
# A step is taken back if it turns out, at its end, to have been longer than this many of those.
_TOO_LONG = 2.0
# So is one in which the rate changes by this factor, until the change is confined to a step of
# this many radians: what is switched on at an equilibrium, the error estimate does not see.
_JUMP = 4.0
_CONFINED = 1e-6


class WatchfulController(diffrax.PIDController):
    """A PID controller that bounds steps by the motion's fastest rate, which may rise on the way.

    It also reports a step rejected at the resolution of time. Its own `dtmin` would stop a step
    that is short only because a time asked for is near, too.
    """

    resolution: Any = 0.0
    fastest: Any = None
    start_rate: Any = 0.0

    def init(self, *args: Any) -> Any:
        """As the PID controller; the state also carries the rate where the step begins."""
        t1, state = super().init(*args)
        return t1, (state, self.start_rate)

    def adapt_step_size(
        self,
        t0: Any,
        t1: Any,
        y0: Any,
        y1_candidate: Any,
        args: Any,
        y_error: Any,
        error_order: Any,
        controller_state: Any,
    ) -> Any:
        """As the PID controller; a torque that turns NaN or infinite ends here."""
        pid_state, rate0 = controller_state
        keep, next_t0, next_t1, made_jump, pid_state, result = super().adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, pid_state
        )
        stuck = ~keep & (next_t1 - next_t0 <= self.resolution)
        result = diffrax.RESULTS.where(stuck, diffrax.RESULTS.dt_min_reached, result)
        t, y, args = constant((t1, y1_candidate, args))
        rate = jax.lax.stop_gradient(self.fastest(t, y, args))
        # Where a torque jumps, differences see a rate without bound: never down to a standstill.
        shortest = 4 * self.resolution
        longest = jnp.maximum(LARGEST_STEP / rate, shortest)
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
        state = (pid_state, jnp.where(kept, rate, rate0))
        return kept, next_t0, next_t1, made_jump, state, result


def constant(tree: Any) -> Any:
    """The same without derivatives: what decides on steps is not differentiated."""
    arrays, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(jax.lax.stop_gradient(arrays), rest)


def fastest_on_the_way(
    ok: Array, field: Callable, turning: Array, t: Array, y: Array, args: Any
) -> Array:
    """The fastest rate at a point of the motion; `turning` weighs out the angular velocity."""
    speed = jnp.sqrt(jnp.sum((turning * y) ** 2))
    tiny = jnp.finfo(y.dtype).tiny
    rate = jnp.maximum(spectral_radius(jacobian(field, t, y, args), 1), speed)
    return jnp.maximum(jnp.where(ok & jnp.isfinite(rate), rate, 0.0), tiny)


def standing_still(ok: Array, rates: Array) -> Array:
    """The rates, or zero in a lane whose input is bad: no other lane is to wait for it."""
    return jnp.where(ok, rates, jnp.zeros_like(rates))


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

    def there(field: Callable, t: Array, y: Array, args: Any) -> Array:
        return field(jnp.where(usable, t, jnp.zeros_like(t)), jnp.where(usable, y, y0), args)

    _, rates_dot = eqx.filter_jvp(there, (field, t, y, args), (field_dot, t_dot, y_dot, args_dot))
    return guarded(*primals), jnp.where(usable, rates_dot, jnp.zeros_like(rates_dot))
