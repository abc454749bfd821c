"""What every call that moves a body asks of its arguments: system, state and times."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol, TypeVar, runtime_checkable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_shape,
    check_type,
    float_arrays,
    harmless,
    is_unit,
    kind_of,
    nan_where,
    settle,
    where_defined,
)
from jrigid._core.third_party import used_inputs
from jrigid._numerics import safe_norm
from jrigid.dynamics import ExactStates, State
from jrigid.rotation import normalize
from jrigid.systems import AbstractSystem, RigidBody

Motion = TypeVar("Motion", bound=Any)

_SIZES = {"position": 3, "velocity": 3, "attitude": 4, "omega": 3}


@runtime_checkable
class HasRigidBody(Protocol):
    """What is a rigid body in other words, a `jrigid.SymmetricTop` for one."""

    def as_rigid_body(self) -> RigidBody:
        """The same as a system for `simulate`."""
        ...


def motion_arguments(
    system: Any,
    state: Any,
    kind: type = AbstractSystem,
    name: str = "state0",
    **times: Any,
) -> tuple[Any, Any, tuple[Array, ...]]:
    """System, state and times with types and shapes checked, or ValueError.

    Args:
        system: Of the kind, or with a method `as_rigid_body`.
        state: Its state. Internal parts that are not given start at rest relative to
            the body.
        kind: What the system must be.
        name: What the state is called.
        times: By their names: `ts` of any shape, the others numbers.

    Returns:
        The system; the state, all of it in one dtype; the times in one dtype, theirs:
        they may have more digits than the state, and are to be subtracted before they
        are rounded to its own.
    """
    if isinstance(system, HasRigidBody):
        system = system.as_rigid_body()
    if not isinstance(system, kind):
        names = "jrigid system (a RigidBody, a FloatingBody)"
        wanted = names if kind is AbstractSystem else kind.__name__
        raise ValueError(
            f"Argument `system` must be a {wanted}, but it is {kind_of(system)}."
        )
    check_type(name, state, system.state_type)
    state, _ = _in_one_dtype(name, state)
    return system, system.with_parts(state), numbers(**times)


def _in_one_dtype(name: str, state: Any, *others: Any) -> tuple[Any, tuple[Array, ...]]:
    """A state and other arrays in one dtype; ValueError for a shape that is wrong."""
    known = {field: value for field, value in vars(state).items() if field in _SIZES}
    for field, value in known.items():
        size = _SIZES[field]
        if not eqx.is_array(value):
            raise ValueError(
                f"Argument `{name}.{field}` must be an array of shape ({size},), "
                f"but it is {value!r}."
            )
        check_shape(f"{name}.{field}", value, (size,))
    parts, structure = jtu.tree_flatten((known, state.internal))
    arrays = float_arrays(*parts, *others)
    if arrays[0].dtype not in (jnp.float32, jnp.float64):
        raise ValueError(
            f"Arguments must be float32 or float64, but they are {arrays[0].dtype}."
        )
    known, internal = structure.unflatten(arrays[: len(parts)])
    return dataclasses.replace(state, **known, internal=internal), arrays[len(parts) :]


def plain_state(name: str, state: Any, *others: Any) -> tuple[State, tuple[Array, ...]]:
    """A state without internal parts and other arrays in one dtype, or ValueError."""
    check_type(name, state, State)
    if jtu.tree_leaves(state.internal):
        raise ValueError(
            f"Argument `{name}.internal` must be empty, but it is not: a body with moving parts "
            "has no motion in closed form; use `jrigid.simulate`."
        )
    return _in_one_dtype(name, state, *others)


# Times are told apart while their last bit is worth less than this turn [rad].
_BLUR = 0.1


def resolves(t0: Array, rate: Array) -> Array:
    """Whether times near `t0` can be told apart in their dtype, for a body that turns at a rate."""
    blur = (jnp.finfo(t0.dtype).eps * jnp.abs(t0)).astype(rate.dtype)
    return ~(blur * rate > _BLUR)


def numbers(**values: Any) -> tuple[Array, ...]:
    """Floating point arrays of one dtype: `ts` of any shape, of the others each a number.

    A ValueError names what is not.
    """
    for name, value in values.items():
        try:
            (array,) = float_arrays(value)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"Argument `{name}` must be numbers, but it is {value!r}."
            ) from error
        if name != "ts":
            check_shape(name, array, ())
        elif array.size == 0:
            raise ValueError(
                "Argument `ts` must hold at least one time, but it is empty."
            )
    return float_arrays(*values.values())


def _check_state(findings: Findings, state: Any) -> None:
    findings.require(
        all_finite(state), RESULTS.invalid_state, value=ravel_pytree(state)[0]
    )
    findings.require(
        is_unit(state.attitude), RESULTS.invalid_attitude, value=state.attitude
    )


def check_motion(
    findings: Findings, system: Any, state: Any, t: Array, args: Any
) -> None:
    """Note bad values of a system and its state at a time in the precision of the state."""
    system.check(findings)
    _check_state(findings, state)
    field = system.vector_field(t, state, args)
    turning, spinning_up = safe_norm(jnp.stack([state.omega, field.omega]))
    rate = jnp.maximum(
        turning, jnp.where(spinning_up < jnp.inf, jnp.sqrt(spinning_up), 0.0)
    )
    # Rates whose squares, and the last bits of those, are within the range of the
    # dtype.
    info = np.finfo(rate.dtype)
    slowest, fastest = (
        float(info.tiny / info.eps) ** 0.5,
        float(info.max * info.eps) ** 0.5,
    )
    in_range = (rate == 0) | ((rate > slowest) & (rate < fastest))
    findings.require(in_range, RESULTS.rate_out_of_range, value=rate)
    # The rate of the attitude is finite where the state is.
    slopes = {name: rate for name, rate in vars(field).items() if name != "attitude"}
    findings.require(all_finite(slopes), RESULTS.invalid_vector_field)


def harmless_motion(ok: Array, motion: Motion) -> Motion:
    """A named tuple with a `state0`, whose attitude is normalised; where it is bad, ones.

    No other lane is to wait for a bad one, and no NaN to reach the derivatives of what
    it shares with the others: ones, since there are forces that are singular at the
        origin.
    """
    motion = harmless(ok, motion)
    attitude = normalize(motion.state0.attitude)
    return motion._replace(state0=dataclasses.replace(motion.state0, attitude=attitude))


def solver_of(solver: Any, default: diffrax.AbstractSolver, or_else: str = "") -> Any:
    """A solver that estimates its error, or the default for None; ValueError for any other."""
    if not isinstance(solver, diffrax.AbstractAdaptiveSolver | None):
        raise ValueError(
            f"Argument `solver` must be a diffrax solver with an error estimate{or_else}, "
            f"but it is {type(solver).__name__}."
        )
    return default if solver is None else solver


def depends_on(function: Callable[[Array], Any], x: Array) -> bool:
    """Whether a function looks at its argument, as far as its program shows."""
    return used_inputs(jax.make_jaxpr(function)(x))[0]


def exact_motion(
    check: Callable, flow: Callable, throw: bool, *motion: Any
) -> ExactStates:
    """A motion in closed form at times of any shape; a bad value is an error or NaN and a code.

    Args:
        check: Of findings and a body: notes what is wrong with it.
        flow: Of a body, a state and a time since then: attitude and angular velocity.
        throw: Whether to raise.
        motion: The body, its state at `t0` (as from `plain_state`), the times and `t0`,
            all in one dtype.
    """
    check_shape("t0", motion[-1], ())
    answer = _exact_states(check, flow, *motion)
    return settle(answer, throw, _motion_findings, check, *motion)


def _motion_findings(
    check: Callable, body: Any, state0: State, ts: Array, t0: Array
) -> Findings:
    findings = Findings()
    check(findings, body)
    _check_state(findings, state0)
    for name, times in (("t0", t0), ("ts", ts)):
        # The sum shows in what way
        message = f"Argument `{name}` must be finite, but it is not."
        findings.require(
            all_finite(times), RESULTS.invalid_times, message, jnp.sum(times)
        )
    told_apart = resolves(t0, safe_norm(state0.omega))
    findings.require(told_apart, RESULTS.unresolved_times, value=t0)
    return findings


@partial(jax.jit, static_argnums=(0, 1))
def _exact_states(
    check: Callable, flow: Callable, body: Any, state0: State, ts: Array, t0: Array
) -> ExactStates:
    findings = _motion_findings(check, body, state0, ts, t0)

    def states(body: Any, state0: State, times: Array) -> State:
        at_time = partial(flow, body, state0)
        return State(*jnp.vectorize(at_time, signature="()->(4),(3)")(times))

    answer = where_defined(findings.ok, states, body, state0, ts - t0)
    findings.require(all_finite(answer), RESULTS.nonfinite_state)
    return ExactStates(nan_where(~findings.ok, answer), findings.result)
