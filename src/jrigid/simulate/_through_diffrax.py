"""Integration by the loop of diffrax: implicit solvers, and those of a user.

Only documented parts of diffrax are used: terms, controllers, `diffeqsolve`.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, PyTree

from jrigid._checks import all_finite
from jrigid._stepping.control import Limits, in_tolerances, judge
from jrigid._stepping.events import first_change, halvings
from jrigid._stepping.motion import Motion, constant, fastest_rate, first_direction
from jrigid._stepping.scales import jacobian, rate_along, undamped_rate
from jrigid._stepping.steppers import Field
from jrigid._types import ScalarLike
from jrigid.simulate._options import Options

# First step, as a part of the longest.
_FIRST_STEP = 0.1

#: Length of the step, the fastest rate at its start, and the direction that finds it.
_ControllerState = tuple[Array, Array, Array]


class RateController(diffrax.AbstractAdaptiveStepSizeController):
    """The step-size control of our own loop, for the loop of diffrax.

    Attributes:
        limits: Of the motion.
        scales: Of the components of the state.
        field: The vector field, of time and state, without derivatives.
        omega: Where in the state the angular velocity starts.
        damped: Whether the solver may step over damped motions.
        rtol: Relative tolerance of the root finders of diffrax.
        atol: Their absolute tolerance.
        norm: Their norm.
    """

    limits: Limits
    scales: Array
    field: Callable[[Array, Array], Array]
    omega: int = eqx.field(static=True)
    damped: bool = eqx.field(static=True)
    rtol: Array
    atol: Array
    norm: Callable[[PyTree], Array] = optx.rms_norm

    def wrap(self, direction: ScalarLike) -> "RateController":
        """The controller itself, since time always grows here."""
        del direction
        return self

    def init(
        self,
        terms: PyTree,
        t0: Array,
        t1: Array,
        y0: Array,
        dt0: None,
        args: PyTree,
        func: Callable[..., PyTree],
        error_order: int | None,
    ) -> tuple[Array, _ControllerState]:
        """The end of the first step, and the state of the controller."""
        del terms, t1, dt0, args, func, error_order
        # For an implicit solver `longest` does not depend on the rate at the start.
        longest = jnp.minimum(
            self.limits.radians / self.limits.start_rate, self.limits.longest
        )
        first = _FIRST_STEP * longest
        return t0 + first, (first, self.limits.start_rate, first_direction(y0))

    def adapt_step_size(
        self,
        t0: Array,
        t1: Array,
        y0: Array,
        y1_candidate: Array,
        args: PyTree,
        y_error: Array,
        error_order: int,
        controller_state: _ControllerState,
    ) -> tuple[Array, Array, Array, bool, _ControllerState, diffrax.RESULTS]:
        """Whether the step is accepted, and the start and the end of the next one."""
        del args
        step, rate0, direction = controller_state
        before, t, y, error = constant((y0, t1, y1_candidate, y_error))
        limits = self.limits
        h = constant(t1 - t0)
        fastest, along = self._fastest(t, y, direction)
        size = in_tolerances(limits, self.scales, before, y, error)
        rate1 = fastest_rate(self.scales, self.omega, y, fastest)
        verdict = judge(limits, error_order, step, h, size, rate0, rate1)
        keep = verdict.accepted
        result = diffrax.RESULTS.where(
            verdict.stuck, diffrax.RESULTS.dt_min_reached, diffrax.RESULTS.successful
        )
        start = jnp.where(keep, t1, t0)
        state = (verdict.step, verdict.rate, jnp.where(keep, along, direction))
        return keep, start, start + verdict.step, False, state, result

    def _fastest(self, t: Array, y: Array, direction: Array) -> tuple[Array, Array]:
        """The fastest rate that bounds the steps, and the direction that finds it."""

        def field(y: Array) -> Array:
            return self.field(t, y)

        # A power iteration finds the fastest motions, which may be damped ones.
        if self.damped:
            # The whole Jacobian needs no direction, which stays as it is.
            return undamped_rate(jacobian(field, y, self.scales)), direction
        return rate_along(field, y, field(y), direction, self.scales)


class _FirstChange(optx.AbstractRootFinder):
    """The first time in a step at which a condition has the sign that it ends with.

    Optimistix's bisection takes a single condition, and none that is zero at the start.
    This is the bisection of our own loop, whose state is whether it is done.
    """

    rtol: ClassVar[float] = 0.0
    atol: ClassVar[float] = 0.0
    norm: ClassVar[Callable[[PyTree], Array]] = optx.max_norm

    def init(self, *_: Any) -> Array:
        """Begin with the flag that says not done."""
        return jnp.array(False)

    def step(
        self,
        fn: Callable[..., Any],
        y: Array,
        args: PyTree,
        options: dict[str, Any],
        *_: Any,
    ) -> tuple[Array, Array, PyTree]:
        """Find the time."""

        def signs(t: Array) -> Array:
            return jnp.sign(jnp.stack(jtu.tree_leaves(fn(t, args)[0])))

        low = jnp.asarray(options["lower"], y.dtype)
        high = jnp.asarray(options["upper"], y.dtype)
        last = signs(high)
        # diffrax puts zero in place of conditions that did not end the step.
        changing = signs(low) != last

        def has_changed(t: Array) -> Array:
            return jnp.any(changing & (signs(t) == last))

        time = first_change(has_changed, (low, high), halvings(y.dtype))
        return time, jnp.array(True), fn(time, args)[1]

    def terminate(
        self,
        fn: Callable[..., Any],
        y: Array,
        args: PyTree,
        options: dict[str, Any],
        state: Array,
        tags: frozenset[object],
    ) -> tuple[Array, optx.RESULTS]:
        """Whether it is done."""
        del fn, y, args, options, tags
        return state, optx.RESULTS.successful

    def postprocess(
        self, fn: Callable[..., Any], y: Array, aux: PyTree, *_: Any
    ) -> tuple[Array, PyTree, dict[str, Any]]:
        """The time, as it is."""
        del fn
        return y, aux, {}


def solve_by_diffrax(
    field: Field,
    motion: Motion,
    omega: int,
    options: Options,
    event: diffrax.Event | None,
) -> tuple[Array, Array, Array, diffrax.RESULTS, dict[str, Array | int]]:
    """Integrate a motion by `diffrax.diffeqsolve`.

    Args:
        field: Vector field of (parameters, t, y).
        motion: The motion.
        omega: Where in the state the angular velocity starts.
        options: Of the integration.
        event: That ends the motion, of states as arrays.

    Returns:
        States at the output times, the time at the end and the state there, the result
        code, and statistics.
    """
    fixed = constant(motion)
    limits = fixed.limits
    if event is not None and event.root_finder is None:
        finder = _FirstChange()
        event = dataclasses.replace(event, root_finder=finder)
    solution = diffrax.diffeqsolve(
        _terms(field, fixed, options),
        options.solver,
        jnp.zeros_like(limits.end),
        limits.end,
        None,
        motion.y0,
        motion.parameters,
        saveat=diffrax.SaveAt(
            # The end is saved too, since an event may end the motion between output
            # times.
            subs=[diffrax.SubSaveAt(ts=fixed.times), diffrax.SubSaveAt(t1=True)]
        ),
        stepsize_controller=_controller(field, fixed, omega, options),
        adjoint=options.adjoint,
        max_steps=options.max_steps,
        event=event,
        throw=False,
        progress_meter=options.meter,
    )
    saved: Any = (solution.ts, solution.ys)
    (_, ends), (ys, end_ys) = saved
    # diffrax saves no state where a condition is met at the start.
    ys = jnp.where((fixed.times <= 0)[:, None], motion.y0, ys)
    return ys, ends[-1], end_ys[-1], solution.result, solution.stats


def _controller(
    field: Field, fixed: Motion, omega: int, options: Options
) -> diffrax.ClipStepSizeController:
    """The step-size controller, with steps that end at output times and jumps."""
    limits = fixed.limits
    controller: Any = RateController(
        limits=limits,
        scales=fixed.scales,
        field=jtu.Partial(field, fixed.parameters),
        omega=omega,
        damped=options.is_implicit,
        rtol=limits.rtol,
        atol=limits.atol * fixed.scales,
    )
    return diffrax.ClipStepSizeController(
        controller,
        # Otherwise diffrax interpolates, at a lower order than that of its steps.
        step_ts=fixed.times,
        jump_ts=fixed.jumps if fixed.jumps.size else None,
    )


def _terms(field: Field, fixed: Motion, options: Options) -> diffrax.ODETerm:
    """The vector field as a term, with the parameters as `args`."""
    # In forward mode NaN stays in the tangents of its own lane.
    if isinstance(options.adjoint, diffrax.ForwardMode):

        def rates(t: Array, y: Array, parameters: list[Array]) -> Array:
            return field(parameters, t, y)

        vector_field: Any = rates
        return diffrax.ODETerm(vector_field)
    # A rate that is not finite would reach the derivatives of other lanes.
    return diffrax.ODETerm(jtu.Partial(_guarded, fixed.y0, field))


def _guarded(
    y0: Array, field: Field, t: Array, y: Array, parameters: list[Array]
) -> Array:
    """The vector field, with a large number in place of NaN and infinities.

    A step to a state where the field is not finite is rejected. In reverse mode its
    cotangent of zero times NaN would be NaN in everything that lanes share. Therefore
    derivatives are evaluated at the start instead, where the field is finite.
    """
    rates = jax.lax.stop_gradient(field(parameters, t, y))
    finite = all_finite(rates)
    t = jnp.where(finite, t, jnp.zeros_like(t))
    y = jnp.where(finite, y, y0)
    largest = jnp.sqrt(jnp.finfo(rates.dtype).max)
    return jnp.where(finite, field(parameters, t, y), largest)
