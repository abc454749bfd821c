"""The options of `simulate`: checked when it is traced, and the values that it judges."""

import warnings
from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._checks import RESULTS, Findings, check_shape, is_concrete, whole_number
from jrigid._motion import check_motion, numbers
from jrigid.solvers import ExactFree
from jrigid.systems import AbstractSystem, RigidBody

_DEFAULT_RTOL = {8: 1e-8, 4: 1e-5}
_SMALLEST_RTOL = {8: 1e-14, 4: 1e-7}
_DEFAULT_MAX_STEPS = 20_000_000
_DEFAULT_MAX_STEPS_DIRECT = 4096
_CHECKPOINTS = 100
_ADJOINTS = (diffrax.RecursiveCheckpointAdjoint, diffrax.ForwardMode, diffrax.DirectAdjoint)


class Inputs(NamedTuple):
    """What moves, and when."""

    system: AbstractSystem
    state0: Any
    ts: Array
    t0: Array
    args: Any


class Options(NamedTuple):
    """How it is integrated."""

    solver: Any
    rtol: Array
    atol: Array
    adjoint: Any
    max_steps: int
    max_step: Array
    event: Any
    meter: Any


def checked_options(
    system: AbstractSystem,
    dtype: Any,
    solver: Any,
    tolerances: tuple[Any, Any],
    adjoint: Any,
    steps: tuple[Any, Any],
    event: Any,
    progress: Any,
) -> Options:
    """Options with their defaults, or ValueError; steps are how many at most, and how long."""
    if adjoint is None:
        adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=_CHECKPOINTS)
    if not isinstance(adjoint, _ADJOINTS):
        raise ValueError(
            "Argument `adjoint` must be diffrax.RecursiveCheckpointAdjoint(), ForwardMode() or "
            f"DirectAdjoint(), but it is {adjoint!r}."
        )
    if event is not None and not isinstance(event, diffrax.Event):
        raise ValueError(f"Argument `event` must be a diffrax.Event, but it is {event!r}.")
    max_steps, max_step = steps
    if max_steps is None:
        direct = isinstance(adjoint, diffrax.DirectAdjoint)
        max_steps = _DEFAULT_MAX_STEPS_DIRECT if direct else _DEFAULT_MAX_STEPS
    (longest,) = numbers(max_step=jnp.inf if max_step is None else max_step)
    check_shape("max_step", longest, ())
    rtol, atol = _tolerances(*tolerances, dtype)
    return Options(
        _solver(solver, system), rtol, atol, adjoint, whole_number("max_steps", max_steps),
        longest.astype(dtype), event, _meter(progress),
    )  # fmt: skip


def _solver(solver: Any, system: AbstractSystem) -> Any:
    if isinstance(solver, ExactFree):
        if not (isinstance(system, RigidBody) and system.is_free):
            raise ValueError(
                "Argument `solver` must not be ExactFree for anything but a RigidBody without a "
                "torque, but it is."
            )
    elif not isinstance(solver, diffrax.AbstractAdaptiveSolver | None):
        raise ValueError(
            "Argument `solver` must be a diffrax solver with an error estimate, or ExactFree(), "
            f"but it is {type(solver).__name__}."
        )
    return diffrax.Dopri8() if solver is None else solver


def _meter(progress: Any) -> diffrax.AbstractProgressMeter:
    if isinstance(progress, diffrax.AbstractProgressMeter):
        return progress
    if not isinstance(progress, bool):
        raise ValueError(
            "Argument `progress` must be True, False or a progress meter of diffrax, "
            f"but it is {progress!r}."
        )
    return diffrax.TextProgressMeter() if progress else diffrax.NoProgressMeter()


def _tolerances(rtol: Any, atol: Any, dtype: Any) -> tuple[Array, Array]:
    """Both tolerances as arrays; what is known now to be out of bounds is a ValueError."""
    size = jnp.dtype(dtype).itemsize
    rtol = _DEFAULT_RTOL[size] if rtol is None else rtol
    atol = rtol if atol is None else atol
    for name, value in (("rtol", rtol), ("atol", atol)):
        check_shape(name, numbers(**{name: value})[0], ())
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
            stacklevel=4,
        )
    return jnp.asarray(rtol, dtype), jnp.asarray(atol, dtype)


def judged(inputs: Inputs, options: Options) -> Findings:
    """Every bad value that goes into an integration."""
    system, state0, ts, t0, args = inputs
    findings, flat, dtype = Findings(), ts.reshape(-1), options.rtol.dtype
    smallest = _SMALLEST_RTOL[dtype.itemsize]
    for x in (options.rtol, options.atol):
        findings.require((x >= smallest) & (x < 1), RESULTS.invalid_tolerance, value=x)
    findings.require(options.max_step > 0, RESULTS.invalid_max_step, value=options.max_step)
    before = jnp.concatenate([t0[None], flat[:-1]])
    wrong = ~jnp.isfinite((flat - t0).astype(dtype)) | ~(flat >= before)
    findings.require(~jnp.any(wrong), RESULTS.invalid_times, value=flat[jnp.argmax(wrong)])
    check_motion(findings, system, state0, t0.astype(dtype), args)
    return findings
