"""Solvers that diffrax's own loop serves: implicit ones, and those of a user.

What is used of diffrax is what it documents: terms, controllers, `diffeqsolve`.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array

from jrigid._checks import all_finite
from jrigid._stepping.control import Limits, in_tolerances, judge
from jrigid._stepping.motion import constant, fastest_rate, first_direction
from jrigid._stepping.scales import jacobian, rate_along, undamped_rate

_FIRST_STEP = 0.1  # of the longest


class RateController(diffrax.AbstractAdaptiveStepSizeController):
    """The step-size control of our own loop, for the loop of diffrax.

    Attributes:
        limits: Of the motion.
        scales: Of the components of the state.
        field: The vector field, of time and state, without derivatives.
        omega: Where in the state the angular velocity starts.
        damped: Whether the solver may step over what is damped.
        rtol: What diffrax and its root finders ask for.
        atol: The same.
        norm: The same.
    """

    limits: Limits
    scales: Array
    field: Callable[[Array, Array], Array]
    omega: int = eqx.field(static=True)
    damped: bool = eqx.field(static=True)
    rtol: Array
    atol: Array
    norm: Callable[[Any], Array] = optx.rms_norm

    def wrap(self, direction: Any) -> "RateController":
        """The same: time grows."""
        del direction
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """The end of the first step; its length, the fastest rate, a direction."""
        del terms, t1, dt0, args, func, error_order
        longest = jnp.minimum(
            self.limits.radians / self.limits.start_rate, self.limits.longest
        )
        first = _FIRST_STEP * longest
        return t0 + first, (first, self.limits.start_rate, first_direction(y0))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, *others):
        """Whether the step stands, and the next one."""
        del args
        y_error, error_order, (step, rate0, direction) = others
        before, t, y, error = constant((y0, t1, y1_candidate, y_error))
        limits = self.limits
        h = constant(t1 - t0)
        if self.damped:
            rates = jacobian(lambda y: self.field(t, y), y, self.scales)
            fastest, along = undamped_rate(rates), direction
        else:
            base = self.field(t, y)
            fastest, along = rate_along(
                lambda y: self.field(t, y), y, base, direction, self.scales
            )
        size = in_tolerances(limits, self.scales, before, y, error)
        rate1 = fastest_rate(self.scales, self.omega, y, fastest)
        verdict = judge(limits, error_order, step, h, size, rate0, rate1)
        keep = verdict.accepted
        result = diffrax.RESULTS.where(
            verdict.stuck, diffrax.RESULTS.dt_min_reached, diffrax.RESULTS.successful
        )
        start = jnp.where(keep, t1, t0)
        state = verdict.step, verdict.rate, jnp.where(keep, along, direction)
        return keep, start, start + verdict.step, False, state, result


def solve_by_diffrax(
    field: Callable[[list[Array], Array, Array], Array],
    motion: Any,
    omega: int,
    options: Any,
    event: diffrax.Event | None,
) -> tuple[Array, Array, Array, Any, dict[str, Any]]:
    """States at the output times, the end and the state there, what became of it."""
    fixed = constant(motion)
    limits = fixed.limits
    controller: Any = RateController(
        limits=limits,
        scales=fixed.scales,
        field=jtu.Partial(field, fixed.parameters),
        omega=omega,
        damped=isinstance(options.solver, diffrax.AbstractImplicitSolver),
        rtol=limits.rtol,
        atol=limits.atol * fixed.scales,
    )
    controller = diffrax.ClipStepSizeController(
        controller,
        step_ts=fixed.times,
        jump_ts=fixed.jumps if fixed.jumps.size else None,
    )

    def rates(t: Any, y: Any, parameters: Any) -> Array:
        return field(parameters, t, y)

    terms = diffrax.ODETerm(rates)
    if not isinstance(options.adjoint, diffrax.ForwardMode):
        # A rate that is not finite would reach the derivatives of other lanes.
        terms = diffrax.ODETerm(jtu.Partial(_guarded, fixed.y0, field))
    if event is not None and event.root_finder is None:
        finder = optx.Bisection(_exactness(limits), _exactness(limits), flip="detect")
        event = dataclasses.replace(event, root_finder=finder)
    solution = diffrax.diffeqsolve(
        terms,
        options.solver,
        jnp.zeros_like(limits.end),
        limits.end,
        None,
        motion.y0,
        motion.parameters,
        saveat=diffrax.SaveAt(
            subs=[diffrax.SubSaveAt(ts=fixed.times), diffrax.SubSaveAt(t1=True)]
        ),
        stepsize_controller=controller,
        adjoint=options.adjoint,
        max_steps=options.max_steps,
        event=event,
        throw=False,
        progress_meter=options.meter,
    )
    saved: Any = solution.ts, solution.ys
    (_, ends), (ys, end_ys) = saved
    return ys, ends[-1], end_ys[-1], solution.result, solution.stats


def _exactness(limits: Limits) -> float:
    """Tolerance of the time of an event."""
    return 16 * float(jnp.finfo(limits.end.dtype).eps)


def _guarded(
    y0: Array, field: Callable, t: Array, y: Array, parameters: list[Array]
) -> Array:
    """The vector field, with a large number for NaN and infinities.

    A step into a place where the field is not finite is rejected. In reverse mode a
    cotangent of zero times NaN would be NaN, in everything that lanes share:
    derivatives there are taken at the start instead, where the field is finite.
    """
    rates = jax.lax.stop_gradient(field(parameters, t, y))
    finite = all_finite(rates)
    t, y = jnp.where(finite, t, jnp.zeros_like(t)), jnp.where(finite, y, y0)
    largest = jnp.sqrt(jnp.finfo(rates.dtype).max)
    return jnp.where(finite, field(parameters, t, y), largest)
