"""simulate(): integrate a motion, and return its states at the output times."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree
from jaxtyping import ArrayLike as _ArrayLike

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    harmless,
    is_without_error,
    nan_where,
    settle,
)
from jrigid._core.compile import floats_as_arrays, quick_jit
from jrigid._motion_inputs import HasRigidBody, motion_arguments
from jrigid._numerics import unit_again
from jrigid._stepping.derivatives import (
    moved_by,
    moved_in_a_step,
    solve_direct,
    solve_forward,
    solve_reverse,
)
from jrigid._stepping.engine import Engine
from jrigid._stepping.events import Conditions
from jrigid._stepping.guards import forward_only, guard_inputs, guard_outputs
from jrigid._stepping.method import method_of
from jrigid._stepping.motion import (
    ENDED,
    EVENT,
    NOT_FINITE,
    STUCK,
    TOO_MANY_STEPS,
    Motion,
)
from jrigid._stepping.run import Ends
from jrigid._stepping.steppers import ErrorControlled
from jrigid._types import BodyState, Real, ScalarLike
from jrigid.simulate._equal_steps import equal_steps
from jrigid.simulate._event import (
    Condition,
    condition_of_states,
    conditions_of,
    place_of_event,
)
from jrigid.simulate._options import Inputs, Options, Requested, checked_options
from jrigid.simulate._prepare import (
    Prepared,
    judged,
    jumps_of,
    opened,
    prepared,
    require_enough_steps,
    with_derivatives_of_start,
)
from jrigid.simulate._through_diffrax import solve_by_diffrax
from jrigid.simulate._trajectory import Trajectory
from jrigid.solvers import ExactFree, FreeRotation, Splitting
from jrigid.systems import AbstractSystem


def simulate(
    system: AbstractSystem | HasRigidBody,
    state0: BodyState,
    ts: Real[_ArrayLike, "..."],
    args: PyTree = None,
    *,
    t0: ScalarLike = 0.0,
    solver: diffrax.AbstractSolver | None = None,
    rtol: ScalarLike | None = None,
    atol: ScalarLike | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int | None = None,
    max_step: ScalarLike | None = None,
    jumps: Real[_ArrayLike, " jumps"] | None = None,
    event: diffrax.Event | None = None,
    throw: bool = True,
    progress: bool | diffrax.AbstractProgressMeter = False,
) -> Trajectory:
    r"""Integrate the motion of a body and return its states at the times `ts`.

    The variables are measured in their own scales, so the result does not depend on the
    unit of time. The error control is set for the accuracy that `rtol` states below. A
    pulse of torque that is shorter than a step is missed, unless `jumps` or `max_step`
    is given.

    Args:
        system: A `RigidBody`, a `FloatingBody`, another `AbstractSystem`, or an object
            with a method `as_rigid_body`, such as a `SymmetricTop`. A torque that is a
            function is compiled again for each new function object. This takes seconds,
            and memory that only `jax.clear_caches()` frees. Define the function once,
            and pass what changes through `args`.
        state0: Its state at `t0`. A damper or a rotor whose internal state is not given
            starts at rest relative to the body.
        ts: Times [s] of any shape, non-decreasing in the order of their memory, none
            before `t0`. Their dtype may be more precise than the state's. It must be
            where `t0` is far from 0, such as the seconds since 1970.
        args: Passed to torques and forces. Python floats become arrays, so that other
            values need no compilation.
        t0: Time of `state0` [s].
        solver: A diffrax solver with an error estimate; `jrigid.solvers.Verner9()` by
            default. An implicit one (`diffrax.Kvaerno5()`) steps over motions that drag
            or a damper stops within a radian. For a `RigidBody` without torque
            `jrigid.solvers.ExactFree()` evaluates the closed form. For one in a
            potential `jrigid.solvers.Splitting()` takes symplectic steps of the length
            `max_step`.
        rtol: Relative accuracy, by default 1e-8 (float64) or 1e-5 (float32). At an
            angle of turn phi [rad] the relative error of energy and space angular
            momentum stays below rtol (1 + phi), that of the state of a regular motion
            below 10 rtol (1 + phi), with a floor of 100 eps (1 + phi). A motion that
            passes close to an unstable equilibrium (near a separatrix) is not regular
            in this sense: it magnifies the errors of its state. To this end the error
            of a step is at most half of rtol, and less in long runs or for a method of
            lower order. Where derivatives are taken, steps are shorter and values more
            accurate, except by implicit solvers. The fastest part of the motion
            determines phi: for a body in flight that turns slowly, or not at all, it is
            the angle of the orbit. Errors of position and velocity are relative to
            their initial magnitudes, or, if these are zero, to those that they reach in
            the run or in a radian.
        atol: The same for components near zero, as a fraction of the scale of their
            variable (the initial rate of turning, say); `rtol` by default.
        adjoint: How derivatives are taken. By default reverse mode (`jax.grad`,
            `jax.vjp`, `jax.jacrev`) works; `diffrax.ForwardMode()` gives `jax.jvp`,
            `jax.jacfwd` and forward over forward; `diffrax.DirectAdjoint()` every mode
            and order.
        max_steps: Largest number of steps; by default 2e7, enough for some 5e5 turns,
            but 4096 for `DirectAdjoint`, whose cost grows with it. A motion that
            certainly needs more than the default fails before its first step. With a
            smaller number it fails when the steps are used up. For a free body
            `jrigid.free_rotation` has no such bound.
        max_step: Longest step [s]. Steps follow the fastest rate of the motion, which
            is evaluated where each begins and ends. A pulse of torque much shorter than
            a radian of turning, or than the run if the body is at rest, can fall
            between two evaluations and is then missed: bound the step by the length of
            the pulse, or name its start and end as `jumps`.
        jumps: Times [s] at which a torque or a force is not smooth: where it is
            switched, or the times of a table in which it is interpolated. Steps end
            exactly there. A torque with a property `jumps`, such as those of
            `jrigid.torques`, declares its own; a plain function cannot. A jump that is
            not named is found by more and shorter steps, but a pulse shorter than a
            step is missed.
        event: A `diffrax.Event` that ends the motion; its condition functions are
            called with (t, state, args), in SI units. The time at which a number
            changes its sign, or a boolean becomes true, is found by bisection, unless
            the event brings a root finder. (With an implicit solver a boolean ends the
            motion at the end of a step.)
        throw: If True, bad input and a failed integration raise an error; if False,
            they set the lane's result code, and NaN where there is no state.
        progress: True prints a progress meter, or give one of diffrax's.

    Returns:
        The trajectory. With `throw=False` look at its `result` before its states.

    Gradients: those of the motion, in the state, the system's parameters, `args`, `t0`
    and `ts`, also at pure spin and the sleeping top. Their error, relative to the norm
    of the Jacobian, is at most 1000 rtol up to 1e4 radians; beyond, it grows as
    radians^2. A mode that the adjoint does not support raises an error that names an
    adjoint that does. If the states of a failed lane are masked by `result`, it does
    not contribute to the gradients of what lanes share, unless the vector field has no
    finite derivative at its start.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.01, 1.0, 0.0]))
    >>> trajectory = jr.simulate(body, state0, jnp.linspace(0.0, 100.0, 5))
    >>> print(trajectory.states.attitude.shape, trajectory.energy.round(6))
    (5, 4) [1.00005 1.00005 1.00005 1.00005 1.00005]

    With `throw=False` a result code with a message states what went wrong:

    >>> omega = jnp.array([0.01, jnp.nan, 0.0])
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), omega)
    >>> trajectory = jr.simulate(body, state0, 100.0, throw=False)
    >>> print(trajectory.result == jr.RESULTS.successful)
    False
    >>> print(jr.RESULTS[trajectory.result])
    Argument `state0` must be finite, but a component is not.
    """
    body, state0, (ts, t0) = motion_arguments(system, state0, ts=ts, t0=t0)
    args = floats_as_arrays(args, state0.omega.dtype)
    jumps = jumps_of(body, jumps, ts.dtype)
    requested = Requested(
        solver, rtol, atol, adjoint, max_steps, max_step, event, progress
    )
    options = checked_options(requested, body, state0.omega.dtype)
    inputs = Inputs(body, state0, ts, t0, args, jumps)
    with forward_only(options.adjoint):
        trajectory = _simulate(inputs, options)
    return settle(
        trajectory,
        throw,
        _findings,
        inputs,
        options,
        trajectory.result,
        trajectory.final_time,
    )


def _findings(
    inputs: Inputs, options: Options, result: RESULTS, final_time: Array
) -> Findings:
    """Errors in the arguments, and the time at which a torque became NaN."""
    findings, limits, _ = judged(inputs, options)
    # The errors below are those of the run; `judged` has repeated the checks before.
    enough = result != RESULTS.max_steps_reached
    require_enough_steps(findings, enough, limits)
    stopped = result == RESULTS.nonfinite_torque
    findings.require(~stopped, RESULTS.nonfinite_torque, value=final_time)
    return findings


# Result codes for the states in which our own loop ends.
_RESULTS: dict[int, Any] = {
    EVENT: RESULTS.event_occurred,
    STUCK: RESULTS.dt_min_reached,
    NOT_FINITE: RESULTS.nonfinite_torque,
    TOO_MANY_STEPS: RESULTS.max_steps_reached,
}


class _Solved(NamedTuple):
    """The result of an integration, with times since the start.

    Attributes:
        ys: States at the output times, as arrays. If an event may end the motion, the
            state at its end follows in a row of its own.
        reached: Which of these states the motion reached.
        t: Time at which the motion ended.
        result: Result code.
        tried: Number of steps that were tried.
        accepted: Number of steps that were accepted.
    """

    ys: Array
    reached: Array
    t: Array
    result: Any
    tried: Array
    accepted: Array


@quick_jit
def _simulate(inputs: Inputs, options: Options) -> Trajectory:
    """Prepare, integrate, and convert to a trajectory."""
    # Without jumps the vector field as a function of `t0` has the right derivatives.
    if inputs.jumps.size:
        inputs = with_derivatives_of_start(inputs)
    given = prepared(inputs, options)
    differentiated = (given.motion, given.parameters, given.times)
    motion, parameters, times = guard_inputs(options.adjoint, differentiated)
    given = given._replace(motion=motion, parameters=parameters, times=times)
    solved = _solved(given, options)
    trajectory = _trajectory(given, inputs, solved)
    return guard_outputs(options.adjoint, trajectory)


def _solved(given: Prepared, options: Options) -> _Solved:
    """The motion, integrated by the loop that serves the solver."""
    solver = options.solver
    if not isinstance(options.meter, diffrax.NoProgressMeter):
        # Our own derivative rules do not allow the callbacks of a progress meter.
        return _by_diffrax(given, options)
    if isinstance(solver, diffrax.AbstractERK):
        stepper = ErrorControlled(
            method_of(solver), solver.interpolation_cls, given.omega
        )
        engine = Engine(given.field, stepper, options.max_steps)
        return _integrated(engine, given.motion, given, options)
    if isinstance(solver, ExactFree) and options.event is None:
        return _closed_form(given)
    if isinstance(solver, ExactFree | Splitting):
        engine, motion = equal_steps(given, options)
        return _integrated(engine, motion, given, options)
    return _by_diffrax(given, options)


def _closed_form(given: Prepared) -> _Solved:
    """The free body, evaluated at the output times."""
    motion = given.harmless_motion
    body = FreeRotation(given.inputs.system.inertia.astype(motion.y0.dtype))

    def state_at(t: Array) -> Array:
        return ravel_pytree(body.after(given.to_state(motion.y0), t))[0]

    ys = jax.vmap(state_at)(motion.times)
    one = jnp.ones((), jnp.int32)
    reached = jnp.full(motion.times.shape, given.findings.ok)
    end = motion.times[-1]
    return _Solved(ys, reached, end, RESULTS.successful, one, one)


def _by_diffrax(given: Prepared, options: Options) -> _Solved:
    """Integrate the motion by the loop of diffrax."""
    # diffrax evaluates the field of invalid lanes, too.
    motion = given.harmless_motion
    event = options.event
    if event is not None:
        event = _event_of_arrays(given, options, event)
    ys, t, y, result, stats = solve_by_diffrax(
        given.field, motion, given.omega, options, event
    )
    result: Any = RESULTS.promote(result)
    # The last output has derivatives in its time, which the end of the loop has not.
    # But for rounding they are the same.
    complete = (result == RESULTS.successful) & (event is None)
    t = jnp.where(complete, motion.times[-1], t)
    ys = _with_derivatives_in_times(given, options, motion.times, ys, t)
    reached = _reached(given, t)
    if event is not None:
        ys, reached = _with_end(given, ys, reached, y, result)
    tried = jnp.asarray(stats["num_steps"], jnp.int32)
    accepted = jnp.asarray(stats["num_accepted_steps"], jnp.int32)
    return _Solved(ys, reached, t, result, tried, accepted)


def _reached(given: Prepared, end: Array) -> Array:
    """Whether a motion that ended at a time reached each output time."""
    times = jax.lax.stop_gradient(given.times)
    return (times <= jax.lax.stop_gradient(end)) & given.findings.ok


def _with_end(
    given: Prepared, ys: Array, reached: Array, y: Array, result: RESULTS
) -> tuple[Array, Array]:
    """States and whether they were reached, with those of the end in a last row."""
    good = is_without_error(result) & given.findings.ok
    return jnp.concatenate([ys, y[None]]), jnp.append(reached, good)


def _event_of_arrays(
    given: Prepared, options: Options, event: diffrax.Event
) -> diffrax.Event:
    """The event, with conditions on states as arrays."""
    each, _ = _each_condition(given, options, event)

    def with_args(condition: Condition) -> Callable[..., Array]:
        # diffrax passes some or all arguments by name.
        def of_array(t: Array, y: Array, args: PyTree, **_: object) -> Array:
            del args
            return condition(t, y, given.inputs.args)

        return of_array

    structure = jtu.tree_structure(event.cond_fn, is_leaf=callable)
    conditions = structure.unflatten([with_args(x) for x in each])
    return dataclasses.replace(event, cond_fn=conditions)


def _integrated(
    engine: Engine, motion: Motion, given: Prepared, options: Options
) -> _Solved:
    """Integrate the motion by our own loop."""
    conditions, observed = _conditions(given, options)
    engine = engine._replace(conditions=conditions)
    motion = motion._replace(observed=observed)
    solve = solve_reverse
    if isinstance(options.adjoint, diffrax.ForwardMode):
        solve = solve_forward
    if isinstance(options.adjoint, diffrax.DirectAdjoint):
        solve = solve_direct
        # Under vmap the scan evaluates the steps of invalid lanes, too.
        motion = motion._replace(
            parameters=harmless(given.findings.ok, motion.parameters)
        )
    ends = solve(engine, motion)
    times = given.times
    ys = ends.ys
    result = _result_of(ends.counts[0])
    if conditions is None:
        # The last output has derivatives in its time, which the end of the loop has
        # not. But for rounding they are the same.
        complete = ends.counts[0] == ENDED
        t = jnp.where(complete, times[-1], jax.lax.stop_gradient(ends.t))
        ys = _with_derivatives_in_times(given, options, times, ys, t)
        reached = _reached(given, t)
    else:
        t, y = _end_at_event(given, options, conditions, motion, ends)
        # Output times within rounding of the event, or several at it, have no state of
        # their own.
        number = jnp.arange(times.size, dtype=ends.counts.dtype)
        missing = (number >= ends.counts[3]) & (times <= t)
        ys = jnp.where(missing[:, None], ends.y[None], ys)
        ys = _with_derivatives_in_times(given, options, times, ys, t)
        ys, reached = _with_end(given, ys, _reached(given, t), y, result)
    return _Solved(ys, reached, t, result, ends.counts[1], ends.counts[2])


def _with_derivatives_in_times(
    given: Prepared, options: Options, times: Array, ys: Array, end: Array
) -> Array:
    """States at the output times, whose derivatives in these times are the rates.

    Args:
        given: The motion.
        options: Of the integration.
        times: Output times.
        ys: States there.
        end: Time at which the motion ended, beyond which rates need not be finite.
    """
    is_direct = isinstance(options.adjoint, diffrax.DirectAdjoint)
    moved = moved_in_a_step if is_direct else moved_by
    later = jax.vmap(partial(moved, given.field, given.parameters))
    fixed = jax.lax.stop_gradient(times)
    is_reached = fixed <= jax.lax.stop_gradient(end)
    # Others stay where they are, at the start, where rates are finite. The difference
    # of the times is zero, but its derivatives are those of the times.
    late = jnp.where(is_reached, times - fixed, 0.0)
    fixed = jnp.where(is_reached, fixed, 0.0)
    is_reached = is_reached[:, None]
    start = jax.lax.stop_gradient(given.motion.y0)
    ys = jnp.where(is_reached, ys, start)
    return later(fixed, ys, late)


def _end_at_event(
    given: Prepared,
    options: Options,
    conditions: Conditions,
    motion: Motion,
    ends: Ends,
) -> tuple[Array, Array]:
    """Time and state at the end of a motion, with the derivatives of an event's."""
    which = ends.counts[5]
    finder = None if options.event is None else options.event.root_finder
    # The time of a condition that jumps, as a boolean does, has no derivative.
    has_zero = (ends.counts[0] == EVENT) & (which >= 0)
    return place_of_event(
        partial(given.field, given.parameters),
        lambda t, y: conditions.values(motion.observed, t, y)[which],
        finder,
        jax.lax.stop_gradient(ends.t),
        ends.y,
        has_zero,
    )


def _result_of(state: Array) -> RESULTS:
    """The result code for the state in which our own loop ended."""
    result: Any = RESULTS.successful
    for code, item in _RESULTS.items():
        result = RESULTS.where(state == code, item, result)
    return result


def _each_condition(
    given: Prepared, options: Options, event: diffrax.Event
) -> tuple[list[Condition], tuple[Array, Array]]:
    """The conditions of an event, and an example of a time and a state."""
    system = given.inputs.system

    def vector_field(t: ScalarLike, state: BodyState, args: PyTree) -> BodyState:
        return system.vector_field(t, state, args)

    # The options that diffrax passes to conditions and that exist here.
    passed = {
        "terms": diffrax.ODETerm(vector_field),
        "solver": options.solver,
        "max_steps": options.max_steps,
    }
    each = [
        condition_of_states(x, given.start, given.to_state, passed)
        for x in jtu.tree_leaves(event.cond_fn, is_leaf=callable)
    ]
    return each, (given.motion.times[-1], given.motion.y0)


def _conditions(
    given: Prepared, options: Options
) -> tuple[Conditions | None, list[Array]]:
    """The conditions of the event, if any, and the arrays that they depend on."""
    event = options.event
    if event is None:
        return None, []
    args = given.inputs.args
    each, example = _each_condition(given, options, event)

    def values(t: Array, y: Array) -> Array:
        return jnp.stack([jnp.asarray(x(t, y, args)).astype(y.dtype) for x in each])

    plain, observed = opened(values, *example)
    return conditions_of(each, event.direction, plain, example, args), observed


def _trajectory(given: Prepared, inputs: Inputs, solved: _Solved) -> Trajectory:
    """The trajectory of an integrated motion."""
    findings = given.findings
    usable = given.inputs

    def state_at(reached: Array, y: Array) -> BodyState:
        # diffrax fills rows that were not reached with infinities. Their derivatives
        # may be NaN.
        state = given.to_state(harmless(reached, y))
        # Runge-Kutta steps do not preserve the norm of a quaternion.
        state = dataclasses.replace(state, attitude=unit_again(state.attitude))
        return nan_where(~reached, state)

    states = jax.vmap(state_at)(solved.reached, solved.ys)
    final_state = jtu.tree_map(lambda x: x[-1], states)
    states = jtu.tree_map(
        lambda x: x[: inputs.ts.size].reshape(*inputs.ts.shape, *x.shape[1:]), states
    )
    result = solved.result
    lost = is_without_error(result) & ~all_finite(final_state)
    result = RESULTS.where(lost, RESULTS.nonfinite_state, result)
    result = RESULTS.where(findings.ok, result, findings.result)
    final_time = usable.t0 + solved.t.astype(usable.t0.dtype)
    final_time = nan_where(~findings.ok, final_time)
    counts = {
        "num_steps": solved.tried,
        "num_accepted_steps": solved.accepted,
        "num_rejected_steps": solved.tried - solved.accepted,
    }
    moved = eqx.partition((usable.system, usable.args), eqx.is_array)
    return Trajectory(
        inputs.ts, states, result, counts, final_time, final_state, *moved
    )
