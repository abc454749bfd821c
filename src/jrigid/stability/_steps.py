"""A motion, and small motions beside it, in a fixed number of equal steps: a fixed cost a lane."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_shape,
    float_arrays,
    harmless,
    is_unit,
    nan_where,
)
from jrigid._scales import ravel, units, unravel
from jrigid.dynamics import State
from jrigid.rotation import attitude_rate, normalize
from jrigid.systems import RigidBody

# Largest local error of a step, in the scales of the variables, that a result may have.
_LARGEST_ERROR = {8: 1e-6, 4: 1e-3}


class Walk(NamedTuple):
    """A motion in equal steps, checked and measured.

    The state is one array in its own scales; a tangent is (turn about the body axes, change of the
    rate, change of the internal state) in the same.
    """

    advance: Callable[[Array, Array, Array], tuple[Array, Array, Array]]
    to_state: Callable[[Array], State]
    on_sphere: Callable[[Array], Array]
    field: Callable[[Array, Array], Array]
    start: Array
    t0: Array
    step: Array
    dimension: int
    findings: Findings


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


def checked_state(system: Any, state: Any, name: str = "state0") -> State:
    """Shapes and types, at trace time: the state, with its internal parts."""
    if not isinstance(system, RigidBody):
        raise ValueError(
            f"Argument `system` must be a RigidBody, but it is {type(system).__name__}."
        )
    if not isinstance(state, State):
        raise ValueError(f"Argument `{name}` must be a State, but it is {type(state).__name__}.")
    attitude, omega = float_arrays(state.attitude, state.omega)
    check_shape("attitude", attitude, (4,))
    check_shape("omega", omega, (3,))
    internal = jtu.tree_map(lambda x: jnp.asarray(x, omega.dtype), state.internal)
    return system.with_parts(State(attitude, omega, internal))


def checked_body(system: Any, state0: Any, duration: Any, t0: Any) -> tuple[State, Array, Array]:
    """The state, and the times in a dtype that serves all."""
    state0 = checked_state(system, state0)
    duration, t0, attitude, omega = float_arrays(duration, t0, state0.attitude, state0.omega)
    check_shape("duration", duration, ())
    check_shape("t0", t0, ())
    internal = jtu.tree_map(lambda x: x.astype(omega.dtype), state0.internal)
    return State(attitude, omega, internal), duration, t0


def walk(
    system: RigidBody,
    state0: State,
    duration: Array,
    steps: int,
    args: Any,
    t0: Array,
    solver: Any,
) -> Walk:
    """Set up `steps` equal steps over a duration."""
    dtype = state0.omega.dtype
    findings = Findings()
    system.check(findings)
    findings.require(all_finite(state0), RESULTS.invalid_state)
    findings.require(is_unit(jax.lax.stop_gradient(state0.attitude)), RESULTS.invalid_attitude)
    findings.require(
        all_finite((duration, t0)) & (duration > 0),
        RESULTS.invalid_times,
        "Argument `duration` must be positive and finite, and `t0` finite, but they are not.",
    )
    field = system.vector_field(t0, state0, args)
    findings.require(all_finite(field), RESULTS.invalid_vector_field)
    ok = findings.ok
    system, state0, args = harmless(ok, (system, state0, args))
    identity = jnp.zeros(4, dtype).at[0].set(1)
    attitude = normalize(jnp.where(ok, state0.attitude, identity))
    state0 = dataclasses.replace(state0, attitude=attitude)
    duration = jnp.where(ok, duration, 1.0).astype(dtype)
    t0 = jnp.where(ok, t0, 0.0).astype(dtype)
    _, _, scales = jax.lax.stop_gradient(units(system, state0, t0 + duration, t0, args))
    size, dimension = scales.size, scales.size - 1

    def to_state(y: Array) -> State:
        return unravel(y * scales, state0)

    def on_sphere(y: Array) -> Array:
        return jnp.concatenate([normalize(y[:4] * scales[:4]) / scales[:4], y[4:]])

    def rates(t: Array, y: Array) -> Array:
        return ravel(system.vector_field(t, to_state(y), args)) / scales

    def beside(y: Array, tangent: Array) -> Array:
        """A tangent as a change of the state's components."""
        turned = attitude_rate(to_state(y).attitude, tangent[:3])
        return jnp.concatenate([turned / scales[:4], tangent[3:]])

    def together(t: Any, both: Any, _: Any) -> Array:
        y = both[:size]
        tangents = both[size:].reshape(-1, dimension)
        spin, unit = to_state(y).omega, scales[4]

        if not tangents.size:
            return rates(t, y)

        def of(tangent: Array) -> tuple[Array, Array]:
            now, change = jax.jvp(lambda y: rates(t, y), (y,), (beside(y, tangent),))
            turn = unit * tangent[3:6] - jnp.cross(spin, tangent[:3])
            return now, jnp.concatenate([turn, change[4:]])

        if len(tangents) == 1:
            return jnp.concatenate(of(tangents[0]))
        now, changes = jax.vmap(of, out_axes=(None, 0))(tangents)
        return jnp.concatenate([now, changes.reshape(-1)])

    term = diffrax.ODETerm(together)
    step = duration / steps

    def advance(t: Array, y: Array, tangents: Array) -> tuple[Array, Array, Array]:
        """One step: the state, its tangents (a row each), the local error of the state."""
        both = jnp.concatenate([y, tangents.reshape(-1)])
        solver_state = solver.init(term, t, t + step, both, None)
        after, error, _, _, _ = solver.step(
            term, t, t + step, both, None, solver_state, made_jump=False
        )
        y = on_sphere(after[:size])
        return y, after[size:].reshape(tangents.shape), jnp.max(jnp.abs(error[:size]))

    start = ravel(state0) / scales
    return Walk(advance, to_state, on_sphere, rates, start, t0, step, dimension, findings)


def follow(path: Walk, first: Any, count: int, y: Array, rows: Array) -> tuple[Array, Array, Array]:
    """Some steps from the one of a number on: state, tangents, largest local error."""

    def step(carry: tuple[Array, ...], i: Array) -> tuple[tuple[Array, ...], None]:
        y, rows, error = carry
        t = path.t0 + path.step * (first + i).astype(y.dtype)
        y, rows, local = path.advance(t, y, rows)
        return (y, rows, jnp.maximum(error, local)), None

    begin = (y, rows, jnp.zeros((), y.dtype))
    return jax.lax.scan(step, begin, jnp.arange(count))[0]


def verdict(findings: Findings, error: Array, found: Any, throw: bool) -> tuple[Any, Array, Any]:
    """What became of it: the code, whether it is good, and what was found, an error or NaN if not.

    Beside a bad input that is a motion that left its accuracy, or the numbers.
    """
    worst = _LARGEST_ERROR[error.dtype.itemsize]
    ok = findings.ok
    findings.require(
        (error <= worst) | ~ok,
        RESULTS.inaccurate,
        "Arguments `steps` or `step` must be fine enough for a local error below "
        f"{worst:g} a step, but they are not.",
    )
    findings.require(all_finite(found) | ~ok, RESULTS.nonfinite_state)
    ok = findings.ok
    return findings.result, ok, findings.apply(nan_where(~ok, found), throw)


def orthonormal(rows: Array) -> tuple[Array, Array]:
    """Rows made orthogonal one after the other, and the lengths that were left of them."""
    done: list[Array] = []
    lengths = []
    for i in range(rows.shape[0]):
        row = rows[i]
        for other in done:
            row = row - jnp.sum(row * other) * other
        length = jnp.sqrt(jnp.sum(row * row))
        lengths.append(length)
        done.append(row / jnp.where(length > 0, length, 1.0))
    return jnp.stack(done), jnp.stack(lengths)
