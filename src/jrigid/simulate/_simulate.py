"""simulate(): the one call of `diffrax.diffeqsolve`, and the Trajectory it gives."""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Real
from jaxtyping import ArrayLike as _ArrayLike

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_shape,
    float_arrays,
    harmless,
    nan_where,
)
from jrigid._numerics import power_of_two
from jrigid._scales import ravel, units, unravel
from jrigid._types import ScalarLike
from jrigid.rotation import normalize
from jrigid.simulate._adjoint import guard_inputs, guard_outputs
from jrigid.simulate._controller import (
    LARGEST_STEP,
    WatchfulController,
    constant,
    fastest_on_the_way,
    guarded,
    standing_still,
)
from jrigid.simulate._options import DEFAULT_RTOL, check_values, numbers, tolerances
from jrigid.simulate._trajectory import Trajectory
from jrigid.solvers import ExactFree, FreeRotation
from jrigid.systems import AbstractSystem, RigidBody
from jrigid.torques import Sum
from jrigid.torques._base import has_parts

# One step commits this fraction of rtol. The error of the energy adds up over the turns and that
# of the phase over the energy's: what is promised of the state after thousands of turns, and of
# its derivatives through a near-separatrix, asks for much more than rtol at each step.
_STEP_FRACTION = 1e-3
# Beyond this many radians the phase error, quadratic in time, asks for a smaller fraction still.
_LONG_RADIANS = 2e4
# Below this many eps of the state the error estimate is rounding noise.
_NOISE = 40.0
# After a step clipped to a sliver by one of the times asked for, the next is full-sized again.
_GROWTH = 1e16
_DEFAULT_MAX_STEPS = 20_000_000
_DEFAULT_MAX_STEPS_DIRECT = 4096
_CHECKPOINTS = 100
_ADJOINTS = (diffrax.RecursiveCheckpointAdjoint, diffrax.ForwardMode, diffrax.DirectAdjoint)


def simulate(
    system: AbstractSystem,
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
        system: A `RigidBody`, a `FloatingBody`, or another `AbstractSystem`. Torques that are
            functions are compiled anew for each new function object: define them once.
        state0: Its state at `t0`. Where a damper or a rotor needs an internal state and none is
            given, it starts at rest relative to the body.
        ts: Times [s], non-decreasing in the order of their memory, none before `t0`; any shape.
        args: Passed to torques and forces.
        t0: Time of `state0` [s].
        solver: A diffrax solver with an error estimate; `diffrax.Dopri8()` by default. For a
            `RigidBody` without torque `jrigid.solvers.ExactFree()` gives the closed form.
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
            (t, state, args), in SI units.
        throw: If True, bad input and a failed integration raise an error, under jit too; if
            False, they set the lane's result code and its states to NaN.
        progress: True prints a progress meter, or give one of diffrax's.

    Returns:
        The trajectory. With `throw=False` look at its `result` before its states.

    Raises:
        ValueError: Wrong shape or option, or an `rtol` the dtype cannot serve (trace time).
        RuntimeError: Bad value or failed integration, with `throw=True` (run time, any lane).

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
    if not isinstance(system, AbstractSystem):
        raise ValueError(
            "Argument `system` must be a jrigid system (a RigidBody, a FloatingBody), "
            f"but it is {type(system).__name__}."
        )
    if not isinstance(state0, system.state_type):
        raise ValueError(
            f"Argument `state0` must be a {system.state_type.__name__}, "
            f"but it is {type(state0).__name__}."
        )
    for name, size in (("attitude", 4), ("omega", 3), ("position", 3), ("velocity", 3)):
        value = getattr(state0, name, jnp.zeros(size))  # only a body in flight has all
        if not eqx.is_array(value):
            raise ValueError(
                f"Argument `state0.{name}` must be an array of shape ({size},), "
                f"but it is {value!r}."
            )
        check_shape(f"state0.{name}", value, (size,))
    internal = jtu.tree_map(lambda x: float_arrays(x)[0], state0.internal)
    state0 = dataclasses.replace(state0, internal=internal)
    ts, t0 = numbers(ts=ts, t0=t0)
    if ts.size == 0:
        raise ValueError("Argument `ts` must hold at least one time, but it is empty.")
    check_shape("t0", t0, ())
    dtype = jnp.result_type(*(x.dtype for x in jtu.tree_leaves(state0)))
    if jnp.dtype(dtype).itemsize not in DEFAULT_RTOL:
        raise ValueError(
            f"Argument `state0` must be float32 or float64, but it is {jnp.dtype(dtype).name}."
        )
    if solver is None:
        solver = diffrax.Dopri8()
    if isinstance(solver, ExactFree):
        torque = system.torque
        free = isinstance(system, RigidBody) and isinstance(torque, Sum) and not torque.terms
        if not free:
            raise ValueError(
                "Argument `solver` must not be ExactFree for anything but a RigidBody without a "
                "torque, but it is."
            )
    elif not isinstance(solver, diffrax.AbstractAdaptiveSolver):
        raise ValueError(
            "Argument `solver` must be a diffrax solver with an error estimate, or ExactFree(), "
            f"but it is {type(solver).__name__}."
        )
    if adjoint is None:
        adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=_CHECKPOINTS)
    if not isinstance(adjoint, _ADJOINTS):
        raise ValueError(
            "Argument `adjoint` must be diffrax.RecursiveCheckpointAdjoint(), ForwardMode() or "
            f"DirectAdjoint(), but it is {adjoint!r}."
        )
    if event is not None and not isinstance(event, diffrax.Event):
        raise ValueError(f"Argument `event` must be a diffrax.Event, but it is {event!r}.")
    if max_steps is not None and (not isinstance(max_steps, int | np.integer) or max_steps < 1):
        raise ValueError(
            f"Argument `max_steps` must be an integer and at least 1, but it is {max_steps!r}."
        )
    (longest,) = numbers(max_step=jnp.inf if max_step is None else max_step)
    check_shape("max_step", longest, ())
    longest = longest.astype(dtype)
    if max_steps is None:
        direct = isinstance(adjoint, diffrax.DirectAdjoint)
        max_steps = _DEFAULT_MAX_STEPS_DIRECT if direct else _DEFAULT_MAX_STEPS
    rtol, atol = tolerances(rtol, atol, dtype)
    if progress is True:
        meter: diffrax.AbstractProgressMeter = diffrax.TextProgressMeter()
    elif progress is False:
        meter = diffrax.NoProgressMeter()
    elif isinstance(progress, diffrax.AbstractProgressMeter):
        meter = progress
    else:
        raise ValueError(
            "Argument `progress` must be True, False or a progress meter of diffrax, "
            f"but it is {progress!r}."
        )
    return _simulate(
        dtype, system, state0, ts, t0, args, solver, rtol, atol, adjoint, int(max_steps), longest,
        event, throw, meter,
    )  # fmt: skip


@eqx.filter_jit
def _simulate(
    dtype: Any,
    system: Any,
    state0: Any,
    ts: Array,
    t0: Array,
    args: Any,
    solver: Any,
    rtol: Array,
    atol: Array,
    adjoint: Any,
    max_steps: int,
    longest: Array,
    event: Any,
    throw: bool,
    meter: Any,
) -> Trajectory:
    if not has_parts(state0.internal):
        state0 = dataclasses.replace(state0, internal=system.torque.internal_at_rest(state0))
    have, want = (
        [(jtu.keystr(path), x.shape) for path, x in jtu.tree_leaves_with_path(tree)]
        for tree in (state0.internal, system.torque.internal_at_rest(state0))
    )
    if have != want:
        raise ValueError(
            f"Argument `state0.internal` must hold arrays of the shapes {want}, "
            f"but it holds {have}."
        )

    flat = ts.reshape(-1)
    findings = Findings()
    check_values(findings, system, state0, flat, t0, longest, rtol, atol, args)
    ok = findings.ok
    # A bad lane integrates a body that keeps still instead, so that no other lane waits for it,
    # and so that no NaN reaches the derivatives of what it shares with the others: ones, since
    # there are forces that are singular at the origin.
    system, args = harmless(ok, (system, args))
    state0, rtol, atol = harmless(ok, (state0, rtol, atol))
    identity = jnp.zeros(4, state0.attitude.dtype).at[0].set(1)
    attitude = normalize(jnp.where(ok, state0.attitude, identity))
    state0 = dataclasses.replace(state0, attitude=attitude)
    flat = jnp.where(ok, flat, jnp.zeros_like(flat))
    t0 = jnp.where(ok, t0, jnp.zeros_like(t0))
    system, state0, flat, t0, args = guard_inputs(adjoint, (system, state0, flat, t0, args))
    # Times may come in more digits than states: they are subtracted in their own precision.
    since_start = (flat - t0).astype(dtype)
    start = t0.astype(dtype)

    measures = units(system, state0, since_start[-1], start, args)
    rate, fastest, scales = harmless(ok, jax.lax.stop_gradient(measures))
    moving = since_start[-1] > 0  # all times at t0: nothing to integrate
    stretch = power_of_two(jnp.where(moving, rate, 1.0))  # exact to multiply by
    taus = since_start * stretch
    end = jnp.where(moving, taus[-1], 1.0)
    stop = jax.lax.stop_gradient(end)
    radians = stop * fastest / stretch
    largest_step = jnp.minimum(LARGEST_STEP * stretch / fastest, longest * stretch)
    largest_step = jnp.where(ok, largest_step, 1.0)
    if isinstance(solver, ExactFree):
        terms, y0, to_state = _exact_problem(system, state0, stretch)
        controller: Any = diffrax.ConstantStepSize()
        first_step = stop if event is None else jnp.minimum(largest_step, stop)
    else:
        to_state, terms, y0, field, turning = _problem(
            ok, adjoint, system, state0, args, start, stretch, scales
        )
        fraction = _STEP_FRACTION * jnp.minimum(1, _LONG_RADIANS / radians)
        eps = jnp.finfo(dtype).eps
        step_rtol, step_atol = (jnp.maximum(fraction * x, _NOISE * eps) for x in (rtol, atol))
        controller = diffrax.ClipStepSizeController(
            WatchfulController(
                rtol=step_rtol,
                atol=step_atol,
                dtmax=largest_step,
                factormax=_GROWTH,
                resolution=16 * eps * stop,
                start_rate=fastest / stretch,
                fastest=constant(jtu.Partial(fastest_on_the_way, ok, field, turning)),
            ),
            step_ts=jax.lax.stop_gradient(taus),
        )
        first_step = jnp.minimum(0.1 * largest_step, stop)
    if event is None:
        saveat = diffrax.SaveAt(ts=taus)
    else:
        saveat = diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=taus), diffrax.SubSaveAt(t1=True)])
    solution = diffrax.diffeqsolve(
        terms,
        solver,
        jnp.zeros_like(end),
        end,
        first_step,
        y0,
        args,
        saveat=saveat,
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=max_steps,
        event=_event_in_si(event, start, stretch, to_state),
        throw=False,
        progress_meter=meter,
    )
    saved: Any = (solution.ts, solution.ys)
    result: Any = RESULTS.promote(solution.result)

    def to_states(taus: Array, y: Any) -> Any:
        valid = jnp.isfinite(taus)

        def where_valid(tree: Any, otherwise: float) -> Any:
            return jtu.tree_map(
                lambda x: jnp.where(valid.reshape(-1, *(1,) * (x.ndim - 1)), x, otherwise), tree
            )

        state = jax.vmap(to_state)(where_valid(y, 1.0))
        state = dataclasses.replace(state, attitude=jax.vmap(normalize)(state.attitude))
        return where_valid(state, jnp.nan)

    if event is None:  # the motion ends at the last of the times
        states = ends = to_states(*saved)
        end_taus = saved[0]
    else:
        (reached, end_taus), (ys, end_ys) = saved
        states, ends = to_states(reached, ys), to_states(end_taus, end_ys)
    final_state = jtu.tree_map(lambda x: x[-1], ends)
    final_time = jnp.where(moving, t0 + (end_taus[-1] / stretch).astype(t0.dtype), t0)
    finite = all_finite(final_state) | (result != RESULTS.successful)
    result = RESULTS.where(finite, result, RESULTS.nonfinite_state)
    result = RESULTS.where(ok, result, findings.result)
    failed = ~((result == RESULTS.successful) | (result == RESULTS.event_occurred))
    states = nan_where(~ok, states)
    final_state, final_time = nan_where(failed, (final_state, final_time))
    states, final_state, final_time = guard_outputs(adjoint, (states, final_state, final_time))
    stats = {
        name: solution.stats[name]
        for name in ("num_steps", "num_accepted_steps", "num_rejected_steps")
    }
    found = (states, final_state, final_time, stats)
    if throw:
        found = result.error_if(found, failed)
    states, final_state, final_time, stats = found
    states = jtu.tree_map(lambda x: x.reshape(*ts.shape, *x.shape[1:]), states)
    return Trajectory(ts, states, result, stats, final_time, final_state, (system, args))


def _problem(
    ok: Array,
    adjoint: Any,
    system: Any,
    state0: Any,
    args: Any,
    start: Array,
    stretch: Array,
    scales: Array,
) -> tuple[Any, ...]:
    """The motion as one array in its own scales, and time in radians."""

    def to_state(y: Any) -> Any:
        return unravel(y * scales, state0)

    def plain_field(tau: Any, y: Any, args: Any) -> Any:
        rates = system.vector_field(start + tau / stretch, to_state(y), args)
        return ravel(rates) / (scales * stretch)

    y0 = ravel(state0) / scales
    y_start = jax.lax.stop_gradient(y0)
    # What the functions of a user close over becomes visible.
    converted = eqx.filter_closure_convert(plain_field, jnp.zeros_like(stretch), y0, args)
    field: Any = harmless(ok, converted)

    def vector_field(tau: Any, y: Any, args: Any) -> Any:
        if isinstance(adjoint, diffrax.ForwardMode):  # NaN goes no way but its own lane's
            return standing_still(ok, field(tau, y, args))
        return standing_still(ok, guarded(field, y_start, tau, y, args))

    still = jtu.tree_map(jnp.zeros_like, state0)
    turning = ravel(dataclasses.replace(still, omega=jnp.ones_like(state0.omega)))
    return to_state, diffrax.ODETerm(vector_field), y0, field, turning * scales / stretch


def _exact_problem(system: Any, state0: Any, stretch: Array) -> tuple[Any, Any, Callable]:
    """The free body with time in radians, for `ExactFree`."""

    def to_state(y: Any) -> Any:
        return dataclasses.replace(y, omega=y.omega * stretch)

    y0 = dataclasses.replace(state0, omega=state0.omega / stretch)
    return FreeRotation(system.inertia.astype(y0.omega.dtype)), y0, to_state


def _event_in_si(event: Any, t0: Array, stretch: Array, to_state: Callable) -> Any:
    if event is None:
        return None

    def in_si(condition: Callable) -> Callable:
        def wrapped(t: Array, y: Any, args: Any, **kwargs: Any) -> Any:
            return condition(t0 + t / stretch, to_state(y), args, **kwargs)

        return wrapped

    return diffrax.Event(
        jtu.tree_map(in_si, event.cond_fn, is_leaf=callable), event.root_finder, event.direction
    )
