"""A motion and small motions beside it, in a fixed number of equal steps."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jrigid._checks import RESULTS, Findings, all_finite, all_positive, nan_where
from jrigid._core.compile import floats_as_arrays
from jrigid._motion_inputs import (
    check_motion,
    harmless_motion,
    motion_arguments,
    resolves,
    solver_of,
)
from jrigid._numerics import safe_norm, unit_again
from jrigid._stepping.method import method_of
from jrigid._stepping.scales import units
from jrigid._stepping.step import error_of, stages
from jrigid.dynamics import State
from jrigid.rotation import attitude_rate
from jrigid.systems import RigidBody

# Largest local error of a step, in the scales of the variables, that a result may have.
_LARGEST_ERROR = {8: 1e-6, 4: 1e-3}


class Motion(NamedTuple):
    """The arguments that define a motion."""

    system: RigidBody
    state0: State
    args: Any
    t0: Array
    duration: Array
    solver: Any

    @property
    def dimension(self) -> int:
        """Number of components of a small motion."""
        return 6 + sum(x.size for x in jtu.tree_leaves(self.state0.internal))


def motion_of(
    system: Any,
    state0: Any,
    args: Any,
    t0: Any,
    duration: Any = 1.0,
    solver: Any = None,
) -> Motion:
    """A motion with checked shapes and internal parts, in the dtype of its state."""
    system, state0, times = motion_arguments(
        system, state0, RigidBody, t0=t0, duration=duration
    )
    t0, duration = (x.astype(state0.omega.dtype) for x in times)
    solver = solver_of(solver, diffrax.Dopri8())
    args = floats_as_arrays(args, state0.omega.dtype)
    return Motion(system, state0, args, t0, duration, solver)


def findings_of(motion: Motion) -> Findings:
    """Findings about the values of the arguments."""
    system, state0, args, t0, duration, _ = motion
    findings = Findings()
    message = "Argument `t0` must be finite, but it is not."
    findings.require(jnp.isfinite(t0), RESULTS.invalid_times, message, t0)
    resolved = resolves(t0, safe_norm(state0.omega))
    findings.require(resolved, RESULTS.unresolved_times, value=t0)
    message = (
        "Argument `duration` (or `step`) must be positive and finite, but it is not."
    )
    findings.require(all_positive(duration), RESULTS.invalid_times, message, duration)
    check_motion(findings, system, state0, t0, args)
    return findings


class Walk(NamedTuple):
    """A motion in equal steps.

    Its state is one array. Tangents may follow in the same array, each (turn about the
    body axes, change of the rate, change of the internal state), the changes in the
    scales of what changes.
    """

    motion: Motion
    step: Array
    scales: Array

    @property
    def end(self) -> Array:
        """The time after the duration of the motion."""
        return self.motion.t0 + self.motion.duration

    @property
    def start(self) -> Array:
        """The state at the start."""
        return ravel_pytree(self.motion.state0)[0]

    def state(self, y: Array) -> State:
        """The state."""
        return ravel_pytree(self.motion.state0)[1](y[: self.scales.size])

    def tangents(self, y: Array) -> Array:
        """The tangents, a row each."""
        # A turn has three components where the quaternion has four.
        return y[self.scales.size :].reshape(-1, self.scales.size - 1)

    @property
    def units_of_tangents(self) -> Array:
        """The unit of each component of a tangent: radians, and the scales of rates."""
        return jnp.concatenate([jnp.ones_like(self.scales[:3]), self.scales[4:]])

    def with_tangents(self, y: Array, rows: Array) -> Array:
        """The state with these tangents."""
        return jnp.concatenate([y[: self.scales.size], rows.reshape(-1)])

    def on_sphere(self, y: Array) -> Array:
        """The state with a quaternion of norm 1."""
        # A step changes the norm by its error, and no later rate corrects that.
        return jnp.concatenate([unit_again(y[:4]), y[4:]])

    def rates(self, t: Array, y: Array) -> Array:
        """Time derivative of the state."""
        rates = self.motion.system.vector_field(t, self.state(y), self.motion.args)
        return ravel_pytree(rates)[0]

    def _together(self, t: Array, y: Array) -> Array:
        """Time derivatives of the state and of its tangents."""
        state = self.state(y)
        tangents = self.tangents(y)
        alone = y[: self.scales.size]
        if not tangents.size:
            return self.rates(t, y)

        units = self.scales[4:]  # powers of two

        def beside(tangent: Array) -> tuple[Array, Array]:
            turn = tangent[:3]
            change = units * tangent[3:]
            moved = jnp.concatenate([attitude_rate(state.attitude, turn), change])
            rates, growth = jax.jvp(lambda y: self.rates(t, y), (alone,), (moved,))
            # x' = y - omega x x of docs/stability.md. A turn has three components,
            # since the norm of the quaternion has no exponent.
            turning = change[:3] - jnp.cross(state.omega, turn)
            return rates, jnp.concatenate([turning, growth[4:] * (1 / units)])

        if len(tangents) == 1:
            return self.with_tangents(*beside(tangents[0]))
        # All tangents share the rates of the motion, which are computed once.
        return self.with_tangents(*jax.vmap(beside, out_axes=(None, 0))(tangents))

    def _by_solver(self, t: Array, y: Array) -> tuple[Array, Array, Any]:
        """End, error and interpolation of a step by another kind of solver.

        Such a solver is no explicit Runge-Kutta method.
        """
        # diffrax types the time as any real scalar, and passes an array.
        term = diffrax.ODETerm(
            lambda t, y, _: self._together(t, y)  # pyright: ignore[reportArgumentType]
        )
        solver = self.motion.solver
        end = t + self.step
        memory = solver.init(term, t, end, y, None)
        return solver.step(term, t, end, y, None, memory, made_jump=False)[:3]

    def _step(
        self, t: Array, y: Array, in_lanes: bool = False
    ) -> tuple[Array, Array, Any]:
        """End, error and interpolation of one step."""
        if not isinstance(self.motion.solver, diffrax.AbstractERK):
            return self._by_solver(t, y)
        method = method_of(self.motion.solver)
        rates, after = stages(method, self._together, t, self.step, y, in_lanes)
        # diffrax interpolates from increments instead of rates.
        known = self.step * rates[: method.own]
        return (
            after,
            error_of(method, rates, self.step),
            {"y0": y, "y1": after, "k": known},
        )

    def advance(
        self, t: Array, y: Array, in_lanes: bool = False
    ) -> tuple[Array, Array]:
        """State after one step, and its local error.

        The error of a tangent is relative to its length.
        """
        after, error, _ = self._step(t, y, in_lanes)
        size = self.scales.size
        errors = [jnp.abs(error[:size]) / self.scales]
        # In a relative equilibrium the motion has no error, but tangents oscillate.
        for tangent, wrong in zip(self.tangents(y), self.tangents(error), strict=True):
            errors.append(jnp.abs(wrong) / safe_norm(tangent))
        return self.on_sphere(after), jnp.max(jnp.concatenate(errors))

    def within(self, t: Array, y: Array) -> Callable[[Array], Array]:
        """States within one step, as a function of the fraction of it."""
        *_, dense = self._step(t, y)
        zero = jnp.zeros_like(t)
        curve = self.motion.solver.interpolation_cls(t0=zero, t1=zero + 1, **dense)
        return lambda fraction: self.on_sphere(curve.evaluate(fraction))

    def follow(self, first: Any, count: int, y: Array) -> tuple[Array, Array]:
        """State after `count` steps from step `first`, and the largest local error."""

        def step(carry: tuple, i: Array) -> tuple[tuple, None]:
            y, error = carry
            number = first + i
            # In a product rounding does not add up, as it does in a sum of steps.
            t = self.motion.t0 + self.step * number.astype(y.dtype)
            # `in_blocks` evaluates this loop in lanes, even for a single motion.
            y, local = self.advance(t, y, in_lanes=True)
            return (y, jnp.maximum(error, local)), None

        return jax.lax.scan(step, (y, jnp.zeros((), y.dtype)), jnp.arange(count))[0]


def walk(motion: Motion, steps: int, ok: Array) -> Walk:
    """Set up `steps` equal steps over the duration.

    Where the arguments are not ok the steps are harmless.
    """
    motion = harmless_motion(ok, motion)
    system, state0, args, t0, duration, _ = motion
    _, scales = jax.lax.stop_gradient(units(system, state0, duration, t0, args))
    return Walk(motion, duration / steps, scales)


def _may_miss_a_pulse(path: Walk, end: Array) -> Array:
    """Whether two jumps that the torque declares up to a time fit into one step."""
    jumps = path.motion.system.jumps.astype(path.step.dtype)
    if jumps.size < 2:
        return jnp.asarray(False)
    t0 = path.motion.t0
    inside = (jumps >= t0) & (jumps <= end)
    # What is outside is moved to where it makes no short gap, rounding included.
    ordered = jnp.sort(jnp.where(inside, jumps, t0 - 2 * path.step))
    gaps = jnp.diff(ordered)
    return jnp.any((gaps > 0) & (gaps < path.step))


def verdict(
    findings: Findings, path: Walk, end: Array, error: Array, values: Any
) -> Any:
    """The values, or NaN where something is wrong.

    It notes two more findings: a motion that is inaccurate, and one that is not finite.

    Args:
        findings: What is wrong with the arguments.
        path: The motion.
        end: Time at which it ended.
        error: Largest local error of a step.
        values: What was computed.
    """
    accurate = error <= _LARGEST_ERROR[error.dtype.itemsize]
    findings.require(accurate & ~_may_miss_a_pulse(path, end), RESULTS.inaccurate)
    findings.require(all_finite(values), RESULTS.nonfinite_state)
    return nan_where(~findings.ok, values)


def orthonormal(rows: Array) -> tuple[Array, Array]:
    """Rows made orthonormal in turn, and the length of each before normalisation."""
    done: list[Array] = []
    lengths = []
    for row in rows:
        for other in done:
            # In modified Gram-Schmidt each projection is of the row so far, which loses
            # fewer digits.
            row = row - jnp.sum(row * other) * other
        lengths.append(jnp.sqrt(jnp.sum(row * row)))
        done.append(row / jnp.where(lengths[-1] > 0, lengths[-1], 1.0))
    return jnp.stack(done), jnp.stack(lengths)
