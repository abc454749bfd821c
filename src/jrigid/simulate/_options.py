"""The arguments and options of `simulate`, and the checks of its options."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jrigid._checks import (
    check_type,
    demand,
    is_concrete,
    kind_of,
    whole_number,
)
from jrigid._motion_inputs import numbers, solver_of
from jrigid._stepping.scales import spectral_radius, undamped_rate
from jrigid._types import BodyState, ScalarLike
from jrigid.solvers import ExactFree, Splitting, Verner9
from jrigid.systems import AbstractSystem, RigidBody

# By the size of a number in bytes.
_DEFAULT_RTOL = {8: 1e-8, 4: 1e-5}
SMALLEST_RTOL = {8: 1e-14, 4: 1e-7}
_DEFAULT_MAX_STEPS = 20_000_000
# The record of `DirectAdjoint` has a row for each of these steps, taken or not.
_DEFAULT_MAX_STEPS_DIRECT = 4096
_ADJOINTS = (
    diffrax.RecursiveCheckpointAdjoint,
    diffrax.ForwardMode,
    diffrax.DirectAdjoint,
)


class Inputs(NamedTuple):
    """The arguments of `simulate`: the system, its state, and times."""

    system: AbstractSystem
    state0: BodyState
    ts: Array
    t0: Array
    args: PyTree
    jumps: Array

    @property
    def jumps_since_start(self) -> Array:
        """Times at which the vector field is not smooth, since the start, in order."""
        if self.jumps.size == 0:
            return jnp.zeros(0, self.state0.omega.dtype)
        jumps = (self.jumps - self.t0).astype(self.state0.omega.dtype)
        # Infinite jumps count as none (see `Motion`) and come last in the order.
        return jnp.sort(jnp.where(jnp.isfinite(jumps), jumps, jnp.inf))

    @property
    def since_start(self) -> Array:
        """Times since the start, in the precision of the state.

        They are subtracted in their own precision, which may be higher.
        """
        return (self.ts.reshape(-1) - self.t0).astype(self.state0.omega.dtype)


class Requested(NamedTuple):
    """The options of `simulate` as the user passed them, None for a default."""

    solver: diffrax.AbstractSolver | None
    rtol: ScalarLike | None
    atol: ScalarLike | None
    adjoint: diffrax.AbstractAdjoint | None
    max_steps: int | None
    max_step: ScalarLike | None
    event: diffrax.Event | None
    progress: bool | diffrax.AbstractProgressMeter


class Options(NamedTuple):
    """The options of an integration, checked and without defaults."""

    solver: diffrax.AbstractSolver
    rtol: Array
    atol: Array
    adjoint: diffrax.AbstractAdjoint
    max_steps: int
    max_step: Array
    event: diffrax.Event | None
    meter: diffrax.AbstractProgressMeter

    @property
    def is_implicit(self) -> bool:
        """True of a solver that may step over damped motions."""
        return isinstance(self.solver, diffrax.AbstractImplicitSolver)

    @property
    def is_worth_foreseeing(self) -> bool:
        """Whether a motion that needs too many steps fails before its first one.

        It would run for minutes until it has used up the default number. A smaller
        number bounds the work, and such a run returns the states that it reached. If an
        event ends a motion, the number of steps is not known in advance. The closed
        form takes no steps.
        """
        if self.event is not None or isinstance(self.solver, ExactFree):
            return False
        return self.max_steps >= _default_max_steps(self.adjoint)

    @property
    def fastest_of(self) -> Callable[[Array], Array]:
        """The rate of the Jacobian that bounds the steps.

        It is the fastest rate, or the fastest undamped rate for an implicit solver.
        """
        return undamped_rate if self.is_implicit else spectral_radius


def _default_max_steps(adjoint: diffrax.AbstractAdjoint) -> int:
    """Default of the largest number of steps."""
    direct = isinstance(adjoint, diffrax.DirectAdjoint)
    return _DEFAULT_MAX_STEPS_DIRECT if direct else _DEFAULT_MAX_STEPS


def checked_options(
    requested: Requested, system: AbstractSystem, dtype: np.dtype
) -> Options:
    """The options with their defaults, or ValueError."""
    solver = _checked_solver(requested, system)
    adjoint = requested.adjoint
    if adjoint is None:
        adjoint = diffrax.RecursiveCheckpointAdjoint()
    check_type("adjoint", adjoint, *_ADJOINTS)
    max_steps = requested.max_steps
    if max_steps is None:
        max_steps = _default_max_steps(adjoint)
    if requested.event is not None:
        demand(
            isinstance(requested.event, diffrax.Event),
            "Argument `event` must be a `diffrax.Event(condition)`, but it is "
            f"{kind_of(requested.event)}.",
        )
    check_type("progress", requested.progress, bool, diffrax.AbstractProgressMeter)
    rtol, atol, max_step = _checked_tolerances(requested, dtype)
    if dtype.itemsize == 4:
        warnings.warn(
            "simulate() runs in float32: errors of 1e-6 a radian are usual. Switch on "
            "`jax_enable_x64` and pass float64 arrays for more.",
            # The warning points to the call of `simulate`.
            stacklevel=3,
        )
    return Options(
        solver=solver,
        rtol=rtol,
        atol=atol,
        adjoint=adjoint,
        max_steps=whole_number("max_steps", max_steps),
        max_step=max_step,
        event=requested.event,
        meter=_meter(requested.progress),
    )


def _checked_solver(
    requested: Requested, system: AbstractSystem
) -> diffrax.AbstractSolver:
    """The solver, or ValueError for one that cannot serve the system."""
    solver = requested.solver
    if isinstance(solver, Splitting):
        if requested.max_step is None or not isinstance(system, RigidBody):
            raise ValueError(
                "Argument `solver` must not be Splitting for anything but a RigidBody, "
                "its step given as `max_step`, but it is."
            )
        return solver
    if not isinstance(solver, ExactFree):
        return solver_of(solver, Verner9(), ", or ExactFree() or Splitting()")
    if not (isinstance(system, RigidBody) and system.is_free):
        raise ValueError(
            "Argument `solver` must not be ExactFree for anything but a RigidBody "
            "without a torque, but it is."
        )
    return solver


def _checked_tolerances(
    requested: Requested, dtype: np.dtype
) -> tuple[Array, Array, Array]:
    """Relative and absolute tolerance and longest step; ValueError for known bad ones.

    Tolerances that are traced are checked with the other values.
    """
    rtol = requested.rtol
    if rtol is None:
        rtol = _DEFAULT_RTOL[dtype.itemsize]
    atol = rtol if requested.atol is None else requested.atol
    max_step = jnp.inf if requested.max_step is None else requested.max_step
    arrays = numbers(rtol=rtol, atol=atol, max_step=max_step)
    smallest = SMALLEST_RTOL[dtype.itemsize]
    for name, value in (("rtol", rtol), ("atol", atol)):
        number: Any = value
        if is_concrete(value) and not smallest <= float(number) < 1:
            raise ValueError(
                f"Argument `{name}` must be at least {smallest} and below 1 in "
                f"{dtype.name}, but it is {float(number)}."
            )
    rtol, atol, max_step = (x.astype(dtype) for x in arrays)
    return rtol, atol, max_step


def _meter(
    progress: bool | diffrax.AbstractProgressMeter,
) -> diffrax.AbstractProgressMeter:
    """The progress meter of diffrax that an argument stands for."""
    if not isinstance(progress, bool):
        return progress
    return diffrax.TextProgressMeter() if progress else diffrax.NoProgressMeter()
