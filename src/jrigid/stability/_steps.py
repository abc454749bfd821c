"""A motion, and small motions beside it, in a fixed number of equal steps: a fixed cost a lane."""

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

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    all_positive,
    harmless,
    nan_where,
)
from jrigid._motion import check_motion, motion_arguments
from jrigid._scales import units
from jrigid.dynamics import State
from jrigid.rotation import attitude_rate, normalize
from jrigid.systems import RigidBody

# Largest local error of a step, in the scales of the variables, that a result may have.
_LARGEST_ERROR = {8: 1e-6, 4: 1e-3}


class Motion(NamedTuple):
    """A motion that is asked for."""

    system: RigidBody
    state0: State
    args: Any
    t0: Array
    duration: Array

    @property
    def dimension(self) -> int:
        """How many numbers a small motion beside it has."""
        return 6 + sum(x.size for x in jtu.tree_leaves(self.state0.internal))


def motion_of(system: Any, state0: Any, args: Any, t0: Any, duration: Any = 1.0) -> Motion:
    """A motion with shapes checked and internal parts, its times in the precision of the state."""
    system, state0, times = motion_arguments(system, state0, RigidBody, t0=t0, duration=duration)
    t0, duration = (x.astype(state0.omega.dtype) for x in times)
    return Motion(system, state0, args, t0, duration)


def findings_of(motion: Motion) -> Findings:
    """What is wrong with the values of the arguments."""
    system, state0, args, t0, duration = motion
    findings = Findings()
    findings.require(
        jnp.isfinite(t0), RESULTS.invalid_times, "Argument `t0` must be finite, but it is not.", t0
    )
    findings.require(
        all_positive(duration),
        RESULTS.invalid_times,
        "Argument `duration` (or `step`) must be positive and finite, but it is not.",
        duration,
    )
    check_motion(findings, system, state0, t0, args)
    return findings


def harmless_motion(ok: Array, motion: Motion) -> Motion:
    """The motion, its attitude normalised; where it is bad another that can be followed."""
    motion = harmless(ok, motion)
    state0 = dataclasses.replace(motion.state0, attitude=normalize(motion.state0.attitude))
    return motion._replace(state0=state0)


def solver_of(solver: Any) -> Any:
    """The solver, or the one that is the default."""
    if solver is None:
        return diffrax.Dopri8(scan_kind="lax")
    if not isinstance(solver, diffrax.AbstractAdaptiveSolver):
        raise ValueError(
            "Argument `solver` must be a diffrax solver with an error estimate, but it is "
            f"{type(solver).__name__}."
        )
    return solver


class Walk(eqx.Module):
    """A motion in equal steps.

    Its state is one array in its own scales; a tangent is (turn about the body axes, change of the
    rate, change of the internal state) in the same.
    """

    motion: Motion
    solver: Any
    step: Array
    scales: Array

    @property
    def start(self) -> Array:
        """The state at the start."""
        return ravel_pytree(self.motion.state0)[0] / self.scales

    def state(self, y: Array) -> State:
        """The state in SI units."""
        return ravel_pytree(self.motion.state0)[1](y * self.scales)

    def on_sphere(self, y: Array) -> Array:
        """The same with a quaternion of norm 1."""
        attitude = normalize(y[:4] * self.scales[:4]) / self.scales[:4]
        return jnp.concatenate([attitude, y[4:]])

    def rates(self, t: Array, y: Array) -> Array:
        """Time derivative of the state."""
        rates = self.motion.system.vector_field(t, self.state(y), self.motion.args)
        return ravel_pytree(rates)[0] / self.scales

    def _together(self, t: Array, both: Array) -> Array:
        """Time derivatives of a state and of the tangents that follow it in the array."""
        size = self.scales.size
        y, tangents = both[:size], both[size:].reshape(-1, size - 1)
        if not tangents.size:
            return self.rates(t, y)
        state, unit = self.state(y), self.scales[4]

        def beside(tangent: Array) -> tuple[Array, Array]:
            turned = attitude_rate(state.attitude, tangent[:3]) / self.scales[:4]
            moved = jnp.concatenate([turned, tangent[3:]])
            rates, change = jax.jvp(lambda y: self.rates(t, y), (y,), (moved,))
            turn = unit * tangent[3:6] - jnp.cross(state.omega, tangent[:3])
            return rates, jnp.concatenate([turn, change[4:]])

        if len(tangents) == 1:
            return jnp.concatenate(beside(tangents[0]))
        rates, changes = jax.vmap(beside, out_axes=(None, 0))(tangents)
        return jnp.concatenate([rates, changes.reshape(-1)])

    def _solve(self, t: Array, both: Array) -> tuple[Array, Array, Any]:
        """One step of the solver: its end, its error, and what interpolates it."""
        term = diffrax.ODETerm(lambda t, both, _: self._together(t, both))  # pyright: ignore
        end = t + self.step
        memory = self.solver.init(term, t, end, both, None)
        return self.solver.step(term, t, end, both, None, memory, made_jump=False)[:3]

    def advance(self, t: Array, y: Array, tangents: Array) -> tuple[Array, Array, Array]:
        """One step: the state, its tangents (a row each), the local error of the state."""
        size = self.scales.size
        after, error, _ = self._solve(t, jnp.concatenate([y, tangents.reshape(-1)]))
        local = jnp.max(jnp.abs(error[:size]))
        return self.on_sphere(after[:size]), after[size:].reshape(tangents.shape), local

    def within(self, t: Array, y: Array) -> Callable[[Array], Array]:
        """States within one step, by the fraction of it that has passed."""
        *_, dense = self._solve(t, y)
        zero = jnp.zeros_like(t)
        curve = self.solver.interpolation_cls(t0=zero, t1=zero + 1, **dense)
        return lambda fraction: self.on_sphere(curve.evaluate(fraction))

    def follow(self, first: Any, count: int, y: Array, rows: Array) -> tuple[Array, Array, Array]:
        """Steps from the one of a number on: state, tangents, largest local error."""

        def step(carry: tuple, i: Array) -> tuple[tuple, None]:
            y, rows, error = carry
            t = self.motion.t0 + self.step * (first + i).astype(y.dtype)
            y, rows, local = self.advance(t, y, rows)
            return (y, rows, jnp.maximum(error, local)), None

        begin = (y, rows, jnp.zeros((), y.dtype))
        (y, rows, error), _ = jax.lax.scan(step, begin, jnp.arange(count))
        return y, rows, error


def walk(motion: Motion, steps: int, solver: Any, ok: Array) -> Walk:
    """Set up `steps` equal steps over the duration, harmless where the arguments are not ok."""
    motion = harmless_motion(ok, motion)
    system, state0, args, t0, duration = motion
    _, _, scales = jax.lax.stop_gradient(units(system, state0, t0 + duration, t0, args))
    return Walk(motion, solver, duration / steps, scales)


def verdict(findings: Findings, error: Array, values: Any) -> tuple[Any, Array, Any]:
    """What became of it: the code, whether it is good, the values, NaN if not.

    Beside bad arguments that is a motion that left its accuracy, or the numbers.
    """
    findings.require(error <= _LARGEST_ERROR[error.dtype.itemsize], RESULTS.inaccurate)
    findings.require(all_finite(values), RESULTS.nonfinite_state)
    return findings.result, findings.ok, nan_where(~findings.ok, values)


def orthonormal(rows: Array) -> tuple[Array, Array]:
    """Rows made orthogonal one after the other, and the lengths that were left of them."""
    done: list[Array] = []
    lengths = []
    for row in rows:
        for other in done:
            row = row - jnp.sum(row * other) * other
        length = jnp.sqrt(jnp.sum(row * row))
        lengths.append(length)
        done.append(row / jnp.where(length > 0, length, 1.0))
    return jnp.stack(done), jnp.stack(lengths)
