"""The options of `simulate`: checked when it is traced, and the values that it judges."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._checks import check_type, is_concrete, whole_number
from jrigid._motion import numbers, solver_of
from jrigid._stepping.scales import spectral_radius, undamped_rate
from jrigid.solvers import ExactFree, Splitting, Verner9
from jrigid.systems import AbstractSystem, RigidBody

_DEFAULT_RTOL = {8: 1e-8, 4: 1e-5}
SMALLEST_RTOL = {8: 1e-14, 4: 1e-7}
_DEFAULT_MAX_STEPS = 20_000_000
_DEFAULT_MAX_STEPS_DIRECT = 4096
_ADJOINTS = (
    diffrax.RecursiveCheckpointAdjoint,
    diffrax.ForwardMode,
    diffrax.DirectAdjoint,
)


class Inputs(NamedTuple):
    """What moves, and when."""

    system: AbstractSystem
    state0: Any
    ts: Array
    t0: Array
    args: Any
    jumps: Array

    @property
    def jumps_since_start(self) -> Array:
        """Times at which the vector field is not smooth, since the start, in order."""
        if self.jumps.size == 0:
            return jnp.zeros(0, self.state0.omega.dtype)
        jumps = (self.jumps - self.t0).astype(self.state0.omega.dtype)
        return jnp.sort(jnp.where(jnp.isfinite(jumps), jumps, jnp.inf))

    @property
    def since_start(self) -> Array:
        """Times since the start, in the precision of the state.

        They may come in more digits: they are subtracted in their own.
        """
        return (self.ts.reshape(-1) - self.t0).astype(self.state0.omega.dtype)


class Options(NamedTuple):
    """How it is integrated."""

    solver: Any
    rtol: Any
    atol: Any
    adjoint: Any
    max_steps: Any
    max_step: Any
    event: Any
    meter: Any

    @property
    def is_implicit(self) -> bool:
        """True of a solver that may step over what is damped."""
        return isinstance(self.solver, diffrax.AbstractImplicitSolver)

    @property
    def is_worth_foreseeing(self) -> bool:
        """Whether a motion that needs too many steps is to fail before its first one.

        It runs for minutes before it has used up the default number. A smaller one
        bounds the work: such a run hands out what it reached. Where an event ends a
        motion, nothing is known beforehand, and the closed form takes no steps.
        """
        if self.event is not None or isinstance(self.solver, ExactFree):
            return False
        return self.max_steps >= _default_max_steps(self.adjoint)

    @property
    def fastest_of(self) -> Callable[[Array], Array]:
        """What bounds the steps, of the Jacobian: its fastest rate, or that which nothing damps."""
        return undamped_rate if self.is_implicit else spectral_radius


def _default_max_steps(adjoint: diffrax.AbstractAdjoint) -> int:
    """The largest number of steps, unless it is given."""
    direct = isinstance(adjoint, diffrax.DirectAdjoint)
    return _DEFAULT_MAX_STEPS_DIRECT if direct else _DEFAULT_MAX_STEPS


def checked_options(asked: Options, system: AbstractSystem, dtype: Any) -> Options:
    """The options with their defaults, or ValueError."""
    solver, rtol, atol, adjoint, max_steps, max_step, event, meter = asked
    if isinstance(solver, Splitting):
        if max_step is None or not isinstance(system, RigidBody):
            raise ValueError(
                "Argument `solver` must not be Splitting for anything but a RigidBody, its step "
                "given as `max_step`, but it is."
            )
    elif not isinstance(solver, ExactFree):
        solver = solver_of(solver, Verner9(), ", or ExactFree() or Splitting()")
    elif not (isinstance(system, RigidBody) and system.is_free):
        raise ValueError(
            "Argument `solver` must not be ExactFree for anything but a RigidBody without a "
            "torque, but it is."
        )
    if adjoint is None:
        adjoint = diffrax.RecursiveCheckpointAdjoint()
    check_type("adjoint", adjoint, *_ADJOINTS)
    if max_steps is None:
        max_steps = _default_max_steps(adjoint)
    if event is not None:
        check_type("event", event, diffrax.Event)
    check_type("progress", meter, bool, diffrax.AbstractProgressMeter)
    if isinstance(meter, bool):
        meter = diffrax.TextProgressMeter() if meter else diffrax.NoProgressMeter()
    size = jnp.dtype(dtype).itemsize
    rtol = _DEFAULT_RTOL[size] if rtol is None else rtol
    limits = {"rtol": rtol, "atol": rtol if atol is None else atol}
    arrays = numbers(**limits, max_step=jnp.inf if max_step is None else max_step)
    smallest = SMALLEST_RTOL[size]
    for name, value in limits.items():  # what is known now; the rest is judged
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
    rtol, atol, max_step = (x.astype(dtype) for x in arrays)
    max_steps = whole_number("max_steps", max_steps)
    return Options(solver, rtol, atol, adjoint, max_steps, max_step, event, meter)
