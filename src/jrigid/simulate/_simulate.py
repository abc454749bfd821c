"""simulate(): a motion by lanes, or by the one call of `diffrax.diffeqsolve`."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.extend import core
from jax.flatten_util import ravel_pytree
from jaxtyping import Array
from jaxtyping import ArrayLike as _ArrayLike

from jrigid._checks import RESULTS, Findings, all_finite, harmless, nan_where, settle
from jrigid._motion import HasRigidBody, depends_on, harmless_motion, motion_arguments
from jrigid._types import Real, ScalarLike
from jrigid.rotation import normalize
from jrigid.simulate._adjoint import WithTimes, forward_only, guard_inputs, guard_outputs
from jrigid.simulate._controller import (
    SMALLEST_BOUND,
    EvenSteps,
    SteadyController,
    WatchfulController,
    constant,
    guarded,
    largest_step,
)
from jrigid.simulate._event import event_of_states
from jrigid.simulate._lanes import COUNTS, Ends, Problem, Steps
from jrigid.simulate._options import Inputs, Options, checked_options, judged
from jrigid.simulate._trajectory import Trajectory
from jrigid.simulate._vmap import motion_in_lanes
from jrigid.solvers import ExactFree, FreeRotation, Splitting
from jrigid.systems import AbstractSystem, RigidBody

# One step commits this fraction of rtol, less with methods of lower order than 8, whose estimates
# are as large as their errors. Where a motion is unstable its derivatives ask for much more than
# its values.
_OF_VALUES, _OF_LOWER_ORDERS, _OF_DERIVATIVES = 0.5, 0.03, 1e-3
# The error of the energy adds up over the turns and that of the phase over the energy's: in a long
# run one step may commit no more than so much of rtol for each radian.
_RADIANS = 50.0
# Below this many eps of the state the error estimate is rounding noise.
_NOISE = 40.0
# Below this many eps of the run a step is none. A motion that ends there is looked at so many of
# them further on, beyond the last step that was tried.
_RESOLUTION, _AHEAD = 16.0, 8.0


def simulate(
    system: AbstractSystem | HasRigidBody,
    state0: Any,
    ts: Real[_ArrayLike, "..."],
    args: Any = None,
    *,
    t0: ScalarLike = 0.0,
    solver: diffrax.AbstractSolver | None = None,
    rtol: ScalarLike | None = None,
    atol: ScalarLike | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int | None = None,
    max_step: ScalarLike | None = None,
    event: diffrax.Event | None = None,
    throw: bool = True,
    progress: bool | diffrax.AbstractProgressMeter = False,
) -> Trajectory:
    r"""Integrate the motion of a body and return its states at the times `ts`.

    Nothing needs tuning: the variables are measured in their own scales, so the answer does not
    depend on the unit of time, and the error control is set for the promises below.

    Args:
        system: A `RigidBody`, a `FloatingBody`, another `AbstractSystem`, or what has a method
            `as_rigid_body`, as a `SymmetricTop`. A torque that is a function is compiled anew for
            each new function object, which takes seconds, and memory that only
            `jax.clear_caches()` frees: define it once, and hand on what changes through `args`.
        state0: Its state at `t0`. Where a damper or a rotor needs an internal state and none is
            given, it starts at rest relative to the body.
        ts: Times [s], non-decreasing in the order of their memory, none before `t0`; any shape.
            Their dtype may have more digits than the state's, and needs them where `t0` is far
            from 0, as the seconds of 1970 are.
        args: Passed to torques and forces.
        t0: Time of `state0` [s].
        solver: A diffrax solver with an error estimate; `jrigid.solvers.Verner9()` by default. An
            implicit one (`diffrax.Kvaerno5()`) steps over what drag or a damper kills within a
            radian of its own rate. For a `RigidBody` without torque `jrigid.solvers.ExactFree()`
            gives the closed form, for one in a potential `jrigid.solvers.Splitting()` symplectic
            steps of the length `max_step`.
        rtol: Relative accuracy, by default 1e-8 (float64) or 1e-5 (float32). At an angle of turn
            phi [rad] the relative error of energy and space angular momentum stays below
            rtol (1 + phi), that of the state of a regular motion below 10 rtol (1 + phi), with a
            floor of 100 eps (1 + phi). One step is held to half of rtol for that, to less in
            long runs or by a method of lower order, and to a thousandth where derivatives are
            taken, whose value is closer for it. What counts is the fastest part of the motion: for
            a body in flight that turns slowly, or not at all, phi is the angle of its orbit, and
            errors of position and velocity are relative to their initial magnitudes (to those they
            reach in the run, or in a radian, where they start at zero).
        atol: The same for components near zero, as a fraction of the scale of their variable (the
            initial rate of turning, say); `rtol` by default.
        adjoint: How derivatives are taken. By default reverse mode (`jax.grad`, `jax.vjp`,
            `jax.jacrev`) works; `diffrax.ForwardMode()` gives `jax.jvp`, `jax.jacfwd` and forward
            over forward; `diffrax.DirectAdjoint()` every mode and order.
        max_steps: Largest number of steps; by default 2e7, enough for some 5e5 turns, but 4096
            for `DirectAdjoint`, whose cost grows with it.
        max_step: Longest step [s]. Steps follow the fastest rate of the motion, which is looked
            at where each begins and ends. A pulse of torque much shorter than a radian of
            turning, or than the run if the body is at rest, can fall between two such looks:
            bound the step by its length.
        event: A `diffrax.Event` that ends the motion; its condition functions are called with
            (t, state, args), in SI units. Where one changes its sign is found by bisection, unless
            the event brings a root finder; one that is true or false ends the motion with a step.
        throw: If True, bad input and a failed integration raise an error; if False, they set the
            lane's result code, and NaN where there is no state.
        progress: True prints a progress meter, or give one of diffrax's.

    Returns:
        The trajectory. With `throw=False` look at its `result` before its states.

    Gradients: those of the motion, in the state, the system's parameters, `args`, `t0` and `ts`,
    also at pure spin and the sleeping top. Their error, relative to the norm of the Jacobian, is
    at most 1000 rtol up to 1e4 radians; from there on it grows as radians^2. A mode that the
    adjoint cannot serve raises an error that names one that can. A lane that fails, from its
    input or on the way, has no part in the gradients of what lanes share once its states are
    masked by `result`, unless the vector field itself has no finite derivative where it starts.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.01, 1.0, 0.0]))
    >>> trajectory = jr.simulate(body, state0, jnp.linspace(0.0, 100.0, 5))
    >>> print(trajectory.states.attitude.shape, trajectory.energy.round(6))
    (5, 4) [1.00005 1.00005 1.00005 1.00005 1.00005]

    Without raising, one result code tells what became of it, and has a message:

    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.01, jnp.nan, 0.0]))
    >>> trajectory = jr.simulate(body, state0, 100.0, throw=False)
    >>> print(trajectory.result == jr.RESULTS.successful)
    False
    >>> print(jr.RESULTS[trajectory.result])
    Argument `state0` must be finite, but a component is not.
    """
    body, state0, (ts, t0) = motion_arguments(system, state0, ts=ts, t0=t0)
    asked = Options(solver, rtol, atol, adjoint, max_steps, max_step, event, progress)
    options = checked_options(asked, body, state0.omega.dtype)
    inputs = Inputs(body, state0, ts, t0, args)
    with forward_only(options.adjoint):
        trajectory = _simulate(inputs, options)

    def findings() -> Findings:
        found, _ = judged(inputs, options)
        stopped = trajectory.result == RESULTS.nonfinite_torque
        found.require(~stopped, RESULTS.nonfinite_torque, value=trajectory.final_time)
        return found

    return settle(trajectory, throw, findings)


class _Run(NamedTuple):
    """When, and in what scales."""

    ok: Array
    start: Array  # t0, in the precision of the state
    scales: Array  # of the components of the state
    fastest: Array  # rate
    times: Array  # since the start
    end: Array
    resolution: Array  # the shortest step
    longest: Array  # step that the options allow


# What diffrax moves: the term, its initial value, how to read a state from it, the controller.
_Problem = tuple[diffrax.AbstractTerm, Any, Callable[[Any], Any], Any]


@eqx.filter_jit
def _simulate(inputs: Inputs, options: Options) -> Trajectory:
    findings, measures = judged(inputs, options)
    usable = guard_inputs(options.adjoint, harmless_motion(findings.ok, inputs))
    options, measures = harmless(findings.ok, (options, measures))
    run = _measured(findings.ok, usable, options, measures)
    kinds = {ExactFree: _exact, Splitting: _split}
    problem_of = kinds.get(type(options.solver), _stepped)
    terms, y0, to_state, controller = problem_of(run, usable, options)
    fixed = jax.lax.stop_gradient(run.times)
    beyond = jnp.searchsorted(fixed, fixed, side="right")
    finer = {}
    if isinstance(controller, WatchfulController):
        radians = jnp.full_like(controller.radians, SMALLEST_BOUND)
        finer = _tolerances(run, options, _OF_DERIVATIVES) | {"radians": radians}
    problem = Problem(terms, controller, finer, y0, usable.args, run.times, beyond, run.end)
    event = event_of_states(options.event, run.start, to_state)
    if isinstance(options.solver, diffrax.AbstractERK) and options.in_lanes:
        forward = isinstance(options.adjoint, diffrax.ForwardMode)
        ends = motion_in_lanes(problem, Steps(options.solver, options.max_steps), forward)
    else:
        ends = _alone(options, event, problem)
    trajectory = _trajectory(findings, inputs, usable, run, to_state, ends, options)
    return guard_outputs(options.adjoint, trajectory)


def _alone(options: Options, event: Any, problem: Problem) -> Ends:
    """One motion, by diffrax."""
    terms, controller, _, y0, args, times, _, end = problem.finely
    controller = constant(controller)
    if isinstance(terms, diffrax.ODETerm):
        if not isinstance(options.adjoint, diffrax.ForwardMode):  # NaN would reach what lanes share
            field = jtu.Partial(guarded, terms.vector_field, jax.lax.stop_gradient(y0))
            terms = diffrax.ODETerm(field)
        step_ts = jax.lax.stop_gradient(times)
        controller = diffrax.ClipStepSizeController(controller, step_ts=step_ts)
    # Neither first step nor times are handed to diffrax here: it would check them by callbacks.
    solution: Any = diffrax.diffeqsolve(
        terms,
        options.solver,
        jnp.zeros_like(end),
        jnp.full_like(end, jnp.inf),
        None,
        y0,
        args,
        saveat=diffrax.SaveAt(subs=[diffrax.SubSaveAt(t1=True), diffrax.SubSaveAt(t1=True)]),
        stepsize_controller=controller,
        adjoint=WithTimes(options.adjoint, times, end),
        max_steps=options.max_steps,
        event=event,
        throw=False,
        progress_meter=options.meter,
    )
    (reached, ends), (ys, end_ys) = solution.ts, solution.ys
    t, y = jtu.tree_map(lambda x: x[-1], (ends, end_ys))
    counts = {x: jnp.asarray(solution.stats[x], jnp.int32) for x in COUNTS}
    return Ends(reached, ys, t, y, solution.result, counts)


def _measured(ok: Array, inputs: Inputs, options: Options, measures: tuple[Array, ...]) -> _Run:
    fastest, scales = measures
    times = jnp.where(ok, inputs.since_start, 0.0)
    eps = jnp.finfo(times.dtype).eps
    # Where all times are at t0, or a lane is bad, there is one step, which hands the start in.
    end = jnp.where(times[-1] > 0, times[-1], eps / fastest)
    resolution = _RESOLUTION * eps * jax.lax.stop_gradient(end)
    start = inputs.t0.astype(end.dtype)
    return _Run(ok, start, scales, fastest, times, end, resolution, options.max_step)


def _opened(function: Callable[..., Array], *example: Any) -> Callable[..., Array]:
    """The same function with the arrays that it closes over as leaves.

    equinox's would compare arguments with the example, between devices to no avail.
    """
    arrays, others = eqx.partition(example, eqx.is_array)
    plain = jax.make_jaxpr(lambda *arrays: function(*eqx.combine(arrays, others)))(*arrays)
    return jtu.Partial(partial(_evaluated, plain.jaxpr), plain.consts)


def _evaluated(jaxpr: Any, consts: list[Any], *arguments: Any) -> Array:
    arrays = jtu.tree_leaves(eqx.filter(arguments, eqx.is_array))
    return core.jaxpr_as_fun(core.ClosedJaxpr(jaxpr, consts))(*arrays)[0]


def _stepped(run: _Run, inputs: Inputs, options: Options) -> _Problem:
    """The motion as one array, for a solver with an error estimate."""
    system, state0, _, _, args = inputs
    y0, to_state = ravel_pytree(state0)

    def plain_field(t: Any, y: Any, args: Any) -> Array:
        return ravel_pytree(system.vector_field(run.start + t, to_state(y), args))[0]

    def rate_of(y: Any, rate: Array) -> Array:
        unit = to_state(run.scales).omega[0]  # beyond the range of numbers are rates, not squares
        rate = jnp.maximum(rate, unit * jnp.sqrt(jnp.sum((to_state(y).omega / unit) ** 2)))
        return jnp.maximum(jnp.where(jnp.isfinite(rate), rate, 0.0), jnp.finfo(y.dtype).tiny)

    # What the functions of a user close over becomes visible.
    field = harmless(run.ok, _opened(plain_field, run.end, y0, args))
    fraction = _OF_VALUES if options.solver.order(None) >= 8 else _OF_LOWER_ORDERS
    watchful = WatchfulController(
        **_tolerances(run, options, fraction),
        limit=run.longest,
        resolution=run.resolution,
        start_rate=run.fastest,
        scales=run.scales,
        field=constant(field),
        rate_of=constant(_opened(rate_of, y0, run.end)),
        damped=options.is_implicit,
    )
    return diffrax.ODETerm(field), y0, to_state, watchful


def _tolerances(run: _Run, options: Options, fraction: float) -> dict[str, Any]:
    """What holds the steps of a controller, by the fraction of rtol that one may commit."""
    least, radians = _NOISE * jnp.finfo(run.end.dtype).eps, run.end * run.fastest
    share = jax.lax.stop_gradient(jnp.minimum(fraction, _RADIANS / radians))
    return {
        "rtol": jnp.maximum(share * options.rtol, least),
        "atol": jnp.maximum(share * options.atol, least) * run.scales,
        "radians": largest_step(options.solver.order(None), share * options.rtol),
    }


def _exact(run: _Run, inputs: Inputs, options: Options) -> _Problem:
    """The free body, for `ExactFree`: in one step, or those of an event."""
    step = jax.lax.stop_gradient(run.end)
    if options.event is not None:
        step = jnp.minimum(step, jnp.minimum(SMALLEST_BOUND / run.fastest, run.longest))
    terms = FreeRotation(inputs.system.inertia.astype(step.dtype))
    return terms, inputs.state0, lambda y: y, SteadyController(step)


def _split(run: _Run, inputs: Inputs, options: Options) -> _Problem:
    """A body in a potential, for `Splitting`: equal steps that no other lane shares."""
    system, state0, _, _, args = inputs

    def torque(t: Any, y: Any, args: Any) -> Array:
        return system.torque_on(run.start + t, y, args)

    looks_at_omega = depends_on(
        lambda omega: torque(run.end, dataclasses.replace(state0, omega=omega), args), state0.omega
    )
    if looks_at_omega or jtu.tree_leaves(state0.internal):
        raise ValueError(
            "Argument `solver` must not be Splitting where the torque depends on the angular "
            "velocity or the body has moving parts, but it is."
        )
    seen = harmless(run.ok, _opened(torque, run.end, state0, args))
    terms: Any = options.solver.terms(RigidBody(system.inertia, seen))
    return terms, state0, lambda y: y, EvenSteps(run.times, run.end, run.longest)


def _trajectory(
    findings: Findings,
    inputs: Inputs,
    usable: Inputs,
    run: _Run,
    to_state: Callable[[Any], Any],
    ends: Ends,
    options: Options,
) -> Trajectory:
    """What became of it."""
    reached, ys, last = ends.reached, ends.ys, (ends.t, ends.y)

    def state_at(t: Array, y: Any) -> Any:
        there = jnp.isfinite(t)
        state = to_state(harmless(there, y))
        state = dataclasses.replace(state, attitude=normalize(state.attitude))
        return nan_where(~there, state)

    states = jax.vmap(state_at)(reached, ys)
    # Without an event the motion ends at the last of the times.
    t, y = jtu.tree_map(lambda x: x[-1], (reached, ys)) if options.event is None else last
    final_state = state_at(t, y)
    ending, end_y = constant((ends.t, ends.y))
    final_time = usable.t0 + jnp.where(jnp.isfinite(t), t, ending).astype(usable.t0.dtype)
    result = RESULTS.promote(ends.result)
    beyond = constant((usable, run.start + ending, to_state(end_y), run.resolution))
    stopped = (result == RESULTS.dt_min_reached) & ~_finite_ahead(*beyond)
    result = RESULTS.where(stopped, RESULTS.nonfinite_torque, result)
    lost = (result == RESULTS.successful) & ~all_finite(final_state)
    result = RESULTS.where(lost, RESULTS.nonfinite_state, result)
    result = RESULTS.where(run.ok, result, findings.result)
    failed = ~((result == RESULTS.successful) | (result == RESULTS.event_occurred))
    final_state = nan_where(failed, final_state)
    states, final_time = nan_where(~run.ok, (states, final_time))
    states = jtu.tree_map(lambda x: x.reshape(*inputs.ts.shape, *x.shape[1:]), states)
    moved = eqx.partition((usable.system, usable.args), eqx.is_array)
    return Trajectory(inputs.ts, states, result, ends.stats, final_time, final_state, *moved)


def _finite_ahead(inputs: Inputs, t: Array, state: Any, resolution: Array) -> Array:
    """Whether the vector field is finite a little beyond where the integration ended."""
    system, _, _, _, args = inputs
    step = _AHEAD * resolution

    def euler(_: Any, carry: tuple[Any, ...]) -> tuple[Any, ...]:
        t, state, finite = carry
        rates = system.vector_field(t, state, args)
        state = jtu.tree_map(lambda x, rate: x + step * rate, state, rates)
        return t + step, state, finite & all_finite(rates)

    return jax.lax.fori_loop(0, 2, euler, (t, state, jnp.asarray(True)))[2]
