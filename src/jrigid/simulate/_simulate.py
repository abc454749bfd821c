"""simulate(): the one call of `diffrax.diffeqsolve`."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array
from jaxtyping import ArrayLike as _ArrayLike

from jrigid._checks import RESULTS, Findings, all_finite, harmless, nan_where, settle
from jrigid._motion import HasRigidBody, motion_arguments, resolves
from jrigid._numerics import power_of_two
from jrigid._scales import ravel, spectral_radius, undamped_rate, units
from jrigid._types import Real, ScalarLike
from jrigid.rotation import normalize
from jrigid.simulate._adjoint import WithTimes, guard_inputs, guard_outputs
from jrigid.simulate._controller import (
    LARGEST_STEP,
    SteadyController,
    WatchfulController,
    constant,
    fastest_on_the_way,
    guarded,
)
from jrigid.simulate._event import event_in_si
from jrigid.simulate._options import Inputs, Options, checked_options, judged
from jrigid.simulate._trajectory import Trajectory
from jrigid.solvers import ExactFree, FreeRotation
from jrigid.systems import AbstractSystem

# One step commits this fraction of rtol. The error of the energy adds up over the turns and that
# of the phase over the energy's: what is promised of the state after thousands of turns, and of
# its derivatives through a near-separatrix, asks for much more than rtol at each step.
_STEP_FRACTION = 1e-3
# Beyond this many radians the phase error, quadratic in time, asks for a smaller fraction still.
_LONG_RADIANS = 2e4
# Below this many eps of the state the error estimate is rounding noise.
_NOISE = 40.0
# Below this many eps of the run a step is none. A motion that ends there is looked at so many of
# them further on, beyond the last step that was tried.
_RESOLUTION, _AHEAD = 16.0, 8.0
_COUNTS = ("", "accepted_", "rejected_")


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
        solver: A diffrax solver with an error estimate; `diffrax.Dopri8()` by default. An implicit
            one (`diffrax.Kvaerno5()`) steps over what drag or a damper kills within a radian of its
            own rate. For a `RigidBody` without torque `jrigid.solvers.ExactFree()` gives the
            closed form.
        rtol: Relative accuracy, by default 1e-8 (float64) or 1e-5 (float32). At an angle of turn
            phi [rad] the relative error of energy and space angular momentum stays below
            rtol (1 + phi), that of the state of a regular motion below 10 rtol (1 + phi), with a
            floor of 100 eps (1 + phi). Each step is held to a thousandth of rtol for that. What
            counts is the fastest part of the motion: for a body in flight that turns slowly, or
            not at all, phi is the angle of its orbit, and errors of position and velocity are
            relative to their initial magnitudes (to those they reach in the run, or in a radian,
            where they start at zero).
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
    options = checked_options(
        body, state0.omega.dtype, solver, (rtol, atol), adjoint, (max_steps, max_step), event,
        progress,
    )  # fmt: skip
    inputs = Inputs(body, state0, ts, t0, args)
    trajectory = _simulate(inputs, options)

    def findings() -> Findings:
        found = judged(inputs, options)
        for code, value in (
            (RESULTS.unresolved_times, t0),
            (RESULTS.nonfinite_torque, trajectory.final_time),
        ):
            found.require(trajectory.result != code, code, value=value)
        return found

    return settle(trajectory, throw, findings)


class _Run(NamedTuple):
    """The motion in its own scales."""

    ok: Array
    start: Array  # t0, in the precision of the state
    stretch: Array  # radians in a second
    scales: Array  # of the components of the state
    fastest: Array  # rate, per radian
    taus: Array  # times [rad]
    end: Array  # of the run [rad]

    @property
    def resolution(self) -> Array:
        """The shortest step [rad]."""
        eps = jnp.finfo(self.end.dtype).eps
        return _RESOLUTION * eps * jax.lax.stop_gradient(self.end)


class _Problem(NamedTuple):
    """The motion as diffrax takes it."""

    terms: Any
    y0: Any
    to_state: Callable[[Any], Any]
    controller: Any


@eqx.filter_jit
def _simulate(inputs: Inputs, options: Options) -> Trajectory:
    findings = judged(inputs, options)
    usable, options = _usable(findings.ok, inputs, options)
    usable = guard_inputs(options.adjoint, usable)
    run = _measured(findings, usable, options)
    problem = (_exact if isinstance(options.solver, ExactFree) else _stepped)(run, usable, options)
    # Neither first step nor times are handed to diffrax here: it would check them by callbacks.
    solution = diffrax.diffeqsolve(
        problem.terms,
        options.solver,
        jnp.zeros_like(run.end),
        jnp.full_like(run.end, jnp.inf),
        None,
        problem.y0,
        usable.args,
        saveat=diffrax.SaveAt(subs=[diffrax.SubSaveAt(t1=True), diffrax.SubSaveAt(t1=True)]),
        stepsize_controller=problem.controller,
        adjoint=WithTimes(options.adjoint, run.taus, run.end),
        max_steps=options.max_steps,
        event=event_in_si(options.event, run.start, run.stretch, problem.to_state),
        throw=False,
        progress_meter=options.meter,
    )
    trajectory = _trajectory(findings, inputs, usable, run, problem, solution, options.event)
    return guard_outputs(options.adjoint, trajectory)


def _usable(ok: Array, inputs: Inputs, options: Options) -> tuple[Inputs, Options]:
    """The inputs, or those of a body that keeps still.

    No other lane is to wait for a bad one, and no NaN to reach the derivatives of what it shares
    with the others: ones, since there are forces that are singular at the origin.
    """
    system, state0, ts, t0, args = inputs
    system, state0, args, rtol, atol = harmless(
        ok, (system, state0, args, options.rtol, options.atol)
    )
    state0 = dataclasses.replace(state0, attitude=normalize(state0.attitude))
    ts, t0 = (jnp.where(ok, x, jnp.zeros_like(x)) for x in (ts, t0))
    return Inputs(system, state0, ts, t0, args), options._replace(rtol=rtol, atol=atol)


def _fastest_of(solver: Any, rounds: int) -> Callable[[Array], Array]:
    """What bounds a solver's steps, of the Jacobian; those of an implicit one nothing damped."""
    if isinstance(solver, diffrax.AbstractImplicitSolver):
        return undamped_rate
    return lambda matrix: spectral_radius(matrix, rounds)


def _measured(findings: Findings, inputs: Inputs, options: Options) -> _Run:
    system, state0, ts, t0, args = inputs
    ok, dtype = findings.ok, options.rtol.dtype
    # Times may come in more digits than states: they are subtracted in their own precision.
    since_start = (ts.reshape(-1) - t0).astype(dtype)
    start = t0.astype(dtype)
    measures = units(system, state0, since_start[-1], start, args, _fastest_of(options.solver, 2))
    rate, fastest, scales = harmless(ok, jax.lax.stop_gradient(measures))
    findings.require(resolves(t0, fastest), RESULTS.unresolved_times)
    since_start = jnp.where(findings.ok, since_start, jnp.zeros_like(since_start))
    moving = since_start[-1] > 0  # all times at t0: nothing to integrate
    stretch = power_of_two(jnp.where(moving, rate, 1.0))  # exact to multiply by
    taus = since_start * stretch
    end = jnp.where(moving, taus[-1], 1.0)
    return _Run(findings.ok, start, stretch, scales, fastest / stretch, taus, end)


def _longest_step(run: _Run, options: Options) -> Array:
    longest = jnp.minimum(LARGEST_STEP / run.fastest, options.max_step * run.stretch)
    return jnp.where(run.ok, longest, 1.0)


def _stepped(run: _Run, inputs: Inputs, options: Options) -> _Problem:
    """The motion as one array, for a solver with an error estimate."""
    system, state0, _, _, args = inputs
    start, stretch, scales = run.start, run.stretch, run.scales
    flat, unravel = ravel_pytree(state0)

    def to_state(y: Any) -> Any:
        return unravel(y * scales)

    def plain_field(tau: Any, y: Any, args: Any) -> Any:
        rates = system.vector_field(start + tau / stretch, to_state(y), args)
        return ravel(rates) / (scales * stretch)

    y0 = flat / scales
    y_start = jax.lax.stop_gradient(y0)
    # What the functions of a user close over becomes visible.
    converted = eqx.filter_closure_convert(plain_field, jnp.zeros_like(stretch), y0, args)
    field: Any = harmless(run.ok, converted)

    forward = isinstance(options.adjoint, diffrax.ForwardMode)
    vector_field = jtu.Partial(_rates if forward else _guarded_rates, run.ok, field, y_start)

    still = jtu.tree_map(jnp.zeros_like, state0)
    turning = ravel(dataclasses.replace(still, omega=jnp.ones_like(state0.omega)))
    stop = jax.lax.stop_gradient(run.end)
    first = longest = _longest_step(run, options)
    if isinstance(options.solver, diffrax.AbstractImplicitSolver):  # only what is on the way bounds
        longest = jnp.where(run.ok, options.max_step * stretch, 1.0)
    fraction = _STEP_FRACTION * jnp.minimum(1, _LONG_RADIANS / (stop * run.fastest))
    noise = _NOISE * jnp.finfo(y0.dtype).eps
    rtol, atol = (jnp.maximum(fraction * x, noise) for x in (options.rtol, options.atol))
    fastest = jtu.Partial(
        fastest_on_the_way, run.ok, field, turning * scales / stretch,
        jtu.Partial(_fastest_of(options.solver, 1)),
    )  # fmt: skip
    watchful = WatchfulController(
        rtol=rtol,
        atol=atol,
        longest=longest,
        first_step=jnp.minimum(0.1 * first, stop),
        resolution=run.resolution,
        start_rate=run.fastest,
        fastest=constant(fastest),
    )
    controller = diffrax.ClipStepSizeController(watchful, step_ts=jax.lax.stop_gradient(run.taus))
    return _Problem(diffrax.ODETerm(vector_field), y0, to_state, controller)


def _rates(ok: Array, field: Any, _: Array, tau: Any, y: Any, args: Any) -> Array:
    """No other lane is to wait for a bad one: that stands still."""
    rates = field(tau, y, args)
    return jnp.where(ok, rates, jnp.zeros_like(rates))


def _guarded_rates(ok: Array, field: Any, start: Array, tau: Any, y: Any, args: Any) -> Array:
    """The same in reverse mode, in which NaN goes to all that lanes share."""
    return _rates(ok, jtu.Partial(guarded, field, start), start, tau, y, args)


def _exact(run: _Run, inputs: Inputs, options: Options) -> _Problem:
    """The free body with time in radians, for `ExactFree`: in one step, or those of an event."""
    state0, stretch = inputs.state0, run.stretch

    def to_state(y: Any) -> Any:
        return dataclasses.replace(y, omega=y.omega * stretch)

    y0 = dataclasses.replace(state0, omega=state0.omega / stretch)
    step = jax.lax.stop_gradient(run.end)
    if options.event is not None:
        step = jnp.minimum(_longest_step(run, options), step)
    terms = FreeRotation(inputs.system.inertia.astype(y0.omega.dtype))
    return _Problem(terms, y0, to_state, SteadyController(step))


def _trajectory(
    findings: Findings,
    inputs: Inputs,
    usable: Inputs,
    run: _Run,
    problem: _Problem,
    solution: Any,
    event: Any,
) -> Trajectory:
    """What became of it, in SI units."""
    (reached, (end,)), (ys, end_ys) = solution.ts, solution.ys

    def states_of(taus: Array, y: Any) -> Any:
        valid = jnp.isfinite(taus)

        def where_valid(tree: Any, otherwise: float) -> Any:
            return jtu.tree_map(
                lambda x: jnp.where(valid.reshape(-1, *(1,) * (x.ndim - 1)), x, otherwise), tree
            )

        state = jax.vmap(problem.to_state)(where_valid(y, 1.0))
        state = dataclasses.replace(state, attitude=jax.vmap(normalize)(state.attitude))
        return where_valid(state, jnp.nan)

    states = ends = states_of(reached, ys)
    if event is None:  # the motion ends at the last of the times
        last = reached[-1]
        end = jnp.where(jnp.isfinite(last), last, jax.lax.stop_gradient(end))
    else:
        ends = states_of(end[None], end_ys)
    final_state = jtu.tree_map(lambda x: x[-1], ends)
    final_time = usable.t0 + (end / run.stretch).astype(usable.t0.dtype)
    result = RESULTS.promote(solution.result)
    stuck = result == RESULTS.dt_min_reached
    stopped = stuck & ~_finite_ahead(usable, run, problem, constant((end, end_ys)))
    result = RESULTS.where(stopped, RESULTS.nonfinite_torque, result)
    finite = all_finite(final_state) | (result != RESULTS.successful)
    result = RESULTS.where(finite, result, RESULTS.nonfinite_state)
    result = RESULTS.where(run.ok, result, findings.result)
    failed = ~((result == RESULTS.successful) | (result == RESULTS.event_occurred))
    final_state = nan_where(failed, final_state)
    states, final_time = nan_where(~run.ok, (states, final_time))
    states = jtu.tree_map(lambda x: x.reshape(*inputs.ts.shape, *x.shape[1:]), states)
    stats = {f"num_{x}steps": solution.stats[f"num_{x}steps"] for x in _COUNTS}
    return Trajectory(
        inputs.ts, states, result, stats, final_time, final_state, (usable.system, usable.args)
    )


def _finite_ahead(inputs: Inputs, run: _Run, problem: _Problem, where: tuple[Array, Any]) -> Array:
    """Whether the vector field is finite a little beyond where the integration ended."""
    system, _, _, _, args = constant(inputs)
    end, ys = where
    step = _AHEAD * run.resolution / run.stretch

    def euler(_: Any, carry: tuple[Any, ...]) -> tuple[Any, ...]:
        t, state, finite = carry
        rates = system.vector_field(t, state, args)
        state = jtu.tree_map(lambda x, rate: x + step * rate, state, rates)
        return t + step, state, finite & all_finite(rates)

    state = problem.to_state(jtu.tree_map(lambda x: x[0], ys))
    begin = (run.start + end / run.stretch, state, jnp.asarray(True))
    return jax.lax.fori_loop(0, 2, euler, begin)[2]
