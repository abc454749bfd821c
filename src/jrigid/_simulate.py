"""simulate(): the one call of `diffrax.diffeqsolve`, and the Trajectory it gives."""

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Real
from jaxtyping import ArrayLike as _ArrayLike

from jrigid._adjoint import guard_inputs, guard_outputs
from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_shape,
    float_arrays,
    is_concrete,
    is_inertia,
    is_unit,
    nan_where,
)
from jrigid._numerics import power_of_two
from jrigid._scales import fastest_rate, ravel, units, unravel
from jrigid._trajectory import Trajectory
from jrigid._types import ScalarLike
from jrigid.rotation import normalize
from jrigid.systems import AbstractSystem
from jrigid.torques._base import has_parts

# One step commits this fraction of rtol. The error of the energy adds up over the turns and that
# of the phase over the energy's: what is promised of the state after thousands of turns, and of
# its derivatives through a near-separatrix, asks for much more than rtol at each step.
_STEP_FRACTION = 1e-3
# Beyond this many radians the phase error, quadratic in time, asks for a smaller fraction still.
_LONG_RADIANS = 1e5
# No step is longer than this fraction of the shortest time scale at the start, that of the turning
# or of the linearised motion: at an equilibrium the error estimate sees nothing, and a step too
# long to be stable leaves the value right and the derivative wrong.
_LARGEST_STEP = 0.4
# Below this many eps of the state the error estimate is rounding noise.
_NOISE = 40.0
# After a step clipped to a sliver by one of the times asked for, the next is full-sized again.
_GROWTH = 1e16
_DEFAULT_RTOL = {8: 1e-8, 4: 1e-5}
_SMALLEST_RTOL = {8: 1e-14, 4: 1e-7}
_DEFAULT_MAX_STEPS = 20_000_000
_DEFAULT_MAX_STEPS_DIRECT = 4096
_CHECKPOINTS = 100
_ADJOINTS = (diffrax.RecursiveCheckpointAdjoint, diffrax.ForwardMode, diffrax.DirectAdjoint)


class _GiveUp(diffrax.PIDController):
    """A PID controller that reports a step rejected at the resolution of time.

    Its own `dtmin` would also stop a step that is short only because a time asked for is near.
    """

    resolution: Any = 0.0

    def adapt_step_size(self, t0: Any, t1: Any, *args: Any) -> Any:
        """As the PID controller; a torque that turns NaN or infinite ends here."""
        keep, next_t0, next_t1, made_jump, state, result = super().adapt_step_size(t0, t1, *args)
        stuck = ~keep & (next_t1 - next_t0 <= self.resolution)
        result = diffrax.RESULTS.where(stuck, diffrax.RESULTS.dt_min_reached, result)
        return keep, next_t0, next_t1, made_jump, state, result


def simulate(
    system: AbstractSystem,
    state0: Any,
    ts: Real[_ArrayLike, "..."],
    args: Any = None,
    *,
    t0: ScalarLike = 0.0,
    solver: diffrax.AbstractAdaptiveSolver | None = None,
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
        solver: A diffrax solver with an error estimate; `diffrax.Dopri8()` by default.
        rtol: Relative accuracy, by default 1e-8 (float64) or 1e-5 (float32). At an angle of turn
            phi [rad] the relative error of energy and space angular momentum stays below
            rtol (1 + phi), that of the state of a regular motion below 10 rtol (1 + phi), with a
            floor of 100 eps (1 + phi). Each step is held to a thousandth of rtol for that.
        atol: The same for components near zero, as a fraction of the scale of their variable (the
            initial rate of turning, say); `rtol` by default.
        adjoint: How derivatives are taken. By default reverse mode (`jax.grad`, `jax.vjp`,
            `jax.jacrev`) works; `diffrax.ForwardMode()` gives `jax.jvp`, `jax.jacfwd` and forward
            over forward; `diffrax.DirectAdjoint()` every mode and order.
        max_steps: Largest number of steps; by default 2e7, which is never in the way, but 4096
            for `DirectAdjoint`, whose cost grows with it.
        max_step: Longest step [s]. A pulse of torque much shorter than a radian of turning, or
            than the run if the body is at rest, can fall between two steps: bound them by its
            length.
        event: A `diffrax.Event` that ends the motion; its condition functions are called with
            (t, state, args), in SI units.
        throw: If True, bad input and a failed integration raise an error, under jit too; if
            False, they set the lane's result code and its states to NaN.
        progress: True prints a progress meter, or give one of diffrax's.

    Returns:
        The trajectory.

    Raises:
        ValueError: Wrong shape or option, or an `rtol` the dtype cannot serve (trace time).
        RuntimeError: Bad value or failed integration, with `throw=True` (run time, any lane).

    Gradients: those of the motion, in the state, the system's parameters, `args`, `t0` and `ts`,
    also at pure spin and the sleeping top. Their relative error is at most 1000 rtol; a mode that
    the adjoint cannot serve raises an error that names one that can.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.01, 1.0, 0.0]))
    >>> trajectory = jr.simulate(body, state0, jnp.linspace(0.0, 100.0, 5))
    >>> print(trajectory.states.attitude.shape, trajectory.energy.round(6))
    (5, 4) [1.00005 1.00005 1.00005 1.00005 1.00005]
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
    for name, size in (("attitude", 4), ("omega", 3)):
        check_shape(f"state0.{name}", getattr(state0, name), (size,))
    internal = jtu.tree_map(lambda x: float_arrays(x)[0], state0.internal)
    state0 = dataclasses.replace(state0, internal=internal)
    ts, t0 = float_arrays(ts, t0)
    if ts.size == 0:
        raise ValueError("Argument `ts` must hold at least one time, but it is empty.")
    check_shape("t0", t0, ())
    dtype = jnp.result_type(*(x.dtype for x in jtu.tree_leaves(state0)))
    if jnp.dtype(dtype).itemsize not in _DEFAULT_RTOL:
        raise ValueError(
            f"Argument `state0` must be float32 or float64, but it is {jnp.dtype(dtype).name}."
        )
    ts, t0 = ts.astype(dtype), t0.astype(dtype)
    if solver is None:
        solver = diffrax.Dopri8()
    if not isinstance(solver, diffrax.AbstractAdaptiveSolver):
        raise ValueError(
            "Argument `solver` must be a diffrax solver with an error estimate, "
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
    if max_steps is not None and max_steps < 1:
        raise ValueError(f"Argument `max_steps` must be at least 1, but it is {max_steps}.")
    longest = jnp.asarray(jnp.inf if max_step is None else max_step, dtype)
    check_shape("max_step", longest, ())
    if max_steps is None:
        direct = isinstance(adjoint, diffrax.DirectAdjoint)
        max_steps = _DEFAULT_MAX_STEPS_DIRECT if direct else _DEFAULT_MAX_STEPS
    rtol, atol = _tolerances(rtol, atol, dtype)
    if progress is True:
        meter: diffrax.AbstractProgressMeter = diffrax.TextProgressMeter()
    elif progress is False:
        meter = diffrax.NoProgressMeter()
    else:
        meter = progress
    return _simulate(
        system, state0, ts, t0, args, solver, rtol, atol, adjoint, max_steps, longest, event, throw,
        meter,
    )  # fmt: skip


def _tolerances(rtol: Any, atol: Any, dtype: Any) -> tuple[Array, Array]:
    size = jnp.dtype(dtype).itemsize
    if rtol is None:
        rtol = _DEFAULT_RTOL[size]
    if atol is None:
        atol = rtol
    for name, value in (("rtol", rtol), ("atol", atol)):
        check_shape(name, jnp.asarray(value), ())
        smallest = _SMALLEST_RTOL[size]
        if is_concrete(value) and not smallest <= float(value) < 1:
            raise ValueError(
                f"Argument `{name}` must be at least {smallest} and below 1 in "
                f"{jnp.dtype(dtype).name}, but it is {float(value)}."
            )
    if size == 4:
        warnings.warn(
            "simulate() runs in float32: errors of 1e-6 a radian are usual. Switch on "
            "`jax_enable_x64` and pass float64 arrays for more.",
            stacklevel=3,
        )
    return jnp.asarray(rtol, dtype), jnp.asarray(atol, dtype)


@eqx.filter_jit
def _simulate(
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
    _check(findings, system, state0, flat, t0, longest, args)
    ok = findings.ok
    # A bad lane integrates a harmless motion instead, so that no other lane waits for it, and so
    # that no NaN reaches the derivatives of what it shares with the others.
    system, args = _harmless(ok, (system, args))
    state0 = jtu.tree_map(lambda x: jnp.where(ok, x, jnp.zeros_like(x)), state0)
    identity = jnp.zeros(4, state0.attitude.dtype).at[0].set(1)
    attitude = normalize(jnp.where(ok, state0.attitude, identity))
    state0 = dataclasses.replace(state0, attitude=attitude)
    flat = jnp.where(ok, flat, jnp.zeros_like(flat))
    t0 = jnp.where(ok, t0, jnp.zeros_like(t0))
    system, state0, flat, t0, args = guard_inputs(adjoint, (system, state0, flat, t0, args))

    rate, scales = jax.lax.stop_gradient(units(system, state0, flat[-1], t0, args))
    moving = flat[-1] > t0  # all times at t0: nothing to integrate
    stretch = power_of_two(jnp.where(moving, rate, 1.0))  # exact to multiply by
    taus = (flat - t0) * stretch
    end = jnp.where(moving, taus[-1], 1.0)

    def to_state(y: Any) -> Any:
        return unravel(y * scales, state0)

    def vector_field(tau: Any, y: Any, args: Any) -> Any:
        rates = system.vector_field(t0 + tau / stretch, to_state(y), args)
        return ravel(rates) / (scales * stretch)

    y0 = ravel(state0) / scales
    eps = jnp.finfo(flat.dtype).eps
    radians = jax.lax.stop_gradient(end)
    fraction = _STEP_FRACTION * jnp.minimum(1, _LONG_RADIANS / radians)
    step_rtol, step_atol = (jnp.maximum(fraction * x, _NOISE * eps) for x in (rtol, atol))
    fastest = jnp.maximum(fastest_rate(vector_field, y0, args), rate / stretch)
    fastest = jax.lax.stop_gradient(fastest)
    largest_step = jnp.where(ok, jnp.minimum(_LARGEST_STEP / fastest, longest * stretch), 1.0)
    controller = diffrax.ClipStepSizeController(
        _GiveUp(
            rtol=step_rtol,
            atol=step_atol,
            dtmax=largest_step,
            factormax=_GROWTH,
            resolution=16 * eps * radians,
        ),
        step_ts=jax.lax.stop_gradient(taus),
    )
    zero = jnp.zeros_like(end)
    if event is None:
        saveat = diffrax.SaveAt(ts=taus)
    else:
        saveat = diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=taus), diffrax.SubSaveAt(t1=True)])
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(vector_field),
        solver,
        zero,
        end,
        jnp.minimum(0.1 * largest_step, radians),
        y0,
        args,
        saveat=saveat,
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=max_steps,
        event=_event_in_si(event, t0, stretch, to_state),
        throw=False,
        progress_meter=meter,
    )
    saved: Any = (solution.ts, solution.ys)
    result: Any = RESULTS.promote(solution.result)

    def to_states(taus: Array, y: Array) -> Any:
        valid = jnp.isfinite(taus)
        state = jax.vmap(to_state)(jnp.where(valid[:, None], y, 1.0))
        state = dataclasses.replace(state, attitude=jax.vmap(normalize)(state.attitude))
        return jtu.tree_map(
            lambda x: jnp.where(valid.reshape(-1, *(1,) * (x.ndim - 1)), x, jnp.nan), state
        )

    if event is None:  # the motion ends at the last of the times
        states = ends = to_states(*saved)
        end_taus = saved[0]
    else:
        (reached, end_taus), (ys, end_ys) = saved
        states, ends = to_states(reached, ys), to_states(end_taus, end_ys)
    final_state = jtu.tree_map(lambda x: x[-1], ends)
    final_time = jnp.where(moving, t0 + end_taus[-1] / stretch, t0)
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


def _check(
    findings: Findings,
    system: AbstractSystem,
    state0: Any,
    flat: Array,
    t0: Array,
    longest: Array,
    args: Any,
) -> None:
    ordered = jnp.all(flat[1:] >= flat[:-1]) & (flat[0] >= t0)
    findings.require(is_inertia(system.inertia), RESULTS.invalid_inertia)
    torque: Any = system.torque
    torque.check(findings)
    findings.require(all_finite(state0), RESULTS.invalid_state)
    findings.require(is_unit(state0.attitude), RESULTS.invalid_attitude)
    findings.require(all_finite((flat, t0)) & ordered, RESULTS.invalid_times)
    findings.require(longest > 0, RESULTS.invalid_max_step)
    field = system.vector_field(t0, state0, args)
    findings.require(all_finite(field), RESULTS.invalid_vector_field)


def _harmless(ok: Array, tree: Any) -> Any:
    """Ones, and unit tensors, in place of the arrays of a bad lane."""
    arrays, rest = eqx.partition(tree, eqx.is_inexact_array)

    def replace(x: Array) -> Array:
        unit = jnp.eye(3, dtype=x.dtype) if x.shape == (3, 3) else jnp.ones_like(x)
        return jnp.where(ok, x, unit)

    return eqx.combine(jtu.tree_map(replace, arrays), rest)


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
