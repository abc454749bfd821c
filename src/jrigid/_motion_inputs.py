"""Input validation of functions that move a body: system, state and times."""

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
from jaxtyping import Array, PyTree

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
from jrigid._core.compile import quick_jit
from jrigid._core.third_party import used_inputs
from jrigid._numerics import safe_norm, unit_again
from jrigid._types import BodyState
from jrigid.dynamics import ExactStates, State
from jrigid.systems import AbstractSystem, RigidBody

Motion = TypeVar("Motion", bound=Any)
_State = TypeVar("_State", bound=BodyState)

#: Notes invalid values of a body, as `check(findings, body)`.
Check = Callable[[Findings, Any], None]
#: Attitude and angular velocity of a body, as `flow(body, state0, time)`.
Flow = Callable[[Any, State, Array], tuple[Array, Array]]

_SIZES = {"position": 3, "velocity": 3, "attitude": 4, "omega": 3}


@runtime_checkable
class HasRigidBody(Protocol):
    """A body that can be converted to a `RigidBody`, such as a `SymmetricTop`."""

    def as_rigid_body(self) -> RigidBody:
        """The same body as a system for `simulate`."""
        ...


def motion_arguments(
    system: Any,
    state: Any,
    kind: type = AbstractSystem,
    name: str = "state0",
    **times: object,
) -> tuple[Any, Any, tuple[Array, ...]]:
    """System, state and times with types and shapes checked, or ValueError.

    Args:
        system: An object of the kind, or with a method `as_rigid_body`.
        state: Its state. Internal parts that are not given start at rest relative to
            the body.
        kind: Class that the system must have.
        name: Name of the argument that holds the state.
        times: By their names: `ts` of any shape, the others numbers.

    Returns:
        The system; the state, all of it in one dtype; the times in a dtype of their
        own. It may be more precise than that of the state, so times must be subtracted
        before they are rounded to the dtype of the state.
    """
    if isinstance(system, HasRigidBody):
        system = system.as_rigid_body()
    if not isinstance(system, kind):
        wanted = kind.__name__
        if kind is AbstractSystem:
            wanted = "jrigid system (a RigidBody, a FloatingBody)"
        raise ValueError(
            f"Argument `system` must be a {wanted}, but it is {kind_of(system)}."
        )
    check_type(name, state, system.state_type)
    state, _ = _in_one_dtype(name, state)
    return system, system.with_parts(state), numbers(**times)


def _in_one_dtype(
    name: str, state: _State, *others: object
) -> tuple[_State, tuple[Array, ...]]:
    """A state and other arrays in one dtype; ValueError for a shape that is wrong."""
    vectors = {field: value for field, value in vars(state).items() if field in _SIZES}
    for field, value in vectors.items():
        size = _SIZES[field]
        if not eqx.is_array(value):
            raise ValueError(
                f"Argument `{name}.{field}` must be an array of shape ({size},), "
                f"but it is {value!r}."
            )
        check_shape(f"{name}.{field}", value, (size,))
    parts, structure = jtu.tree_flatten((vectors, state.internal))
    arrays = float_arrays(*parts, *others)
    if arrays[0].dtype not in (jnp.float32, jnp.float64):
        raise ValueError(
            f"Arguments must be float32 or float64, but they are {arrays[0].dtype}."
        )
    vectors, internal = structure.unflatten(arrays[: len(parts)])
    state = dataclasses.replace(state, **vectors, internal=internal)
    return state, arrays[len(parts) :]


def plain_state(
    name: str, state: object, *others: object
) -> tuple[State, tuple[Array, ...]]:
    """A state without internal parts and other arrays in one dtype, or ValueError."""
    check_type(name, state, State)
    assert isinstance(state, State)  # for type checkers
    if jtu.tree_leaves(state.internal):
        raise ValueError(
            f"Argument `{name}.internal` must be empty, but it is not: a body with "
            "moving parts has no motion in closed form; use `jrigid.simulate`."
        )
    return _in_one_dtype(name, state, *others)


# Times are distinct as long as the body turns less than this in their last bit [rad].
_BLUR = 0.1


def resolves(t0: Array, rate: Array) -> Array:
    """Whether the dtype of `t0` resolves times near it, for a body with this rate."""
    blur = (jnp.finfo(t0.dtype).eps * jnp.abs(t0)).astype(rate.dtype)
    # The result is True for NaN, which other checks report.
    return ~(blur * rate > _BLUR)


def numbers(**values: object) -> tuple[Array, ...]:
    """Convert numbers to arrays of one floating point dtype; `ts` may have any shape.

    Raises:
        ValueError: An argument is no number; the error names it.
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


def _check_state(findings: Findings, state: BodyState) -> None:
    """Note a state that is not finite, or whose attitude is no unit quaternion."""
    findings.require(
        all_finite(state), RESULTS.invalid_state, value=ravel_pytree(state)[0]
    )
    findings.require(
        is_unit(state.attitude), RESULTS.invalid_attitude, value=state.attitude
    )


def check_motion(
    findings: Findings,
    system: AbstractSystem,
    state: BodyState,
    t: Array,
    args: PyTree,
) -> None:
    """Note invalid values of a system and its state.

    Args:
        findings: Collects what is wrong.
        system: The system.
        state: Its state.
        t: The time, in the precision of the state.
        args: Of torques and forces.
    """
    system.check(findings)
    _check_state(findings, state)
    field = system.vector_field(t, state, args)
    turning, spinning_up = safe_norm(jnp.stack([state.omega, field.omega]))
    # A torque that is NaN or infinite is reported below, as what it is.
    rate = jnp.maximum(
        turning, jnp.where(spinning_up < jnp.inf, jnp.sqrt(spinning_up), 0.0)
    )
    # The squares of the rates, and the last bits of the squares, must be within the
    # range of the dtype.
    info = np.finfo(rate.dtype)
    slowest = float(info.tiny / info.eps) ** 0.5
    fastest = float(info.max * info.eps) ** 0.5
    # The rate is zero where nothing turns the body. `simulate` then takes its rate from
    # the length of the run.
    in_range = (rate == 0) | ((rate > slowest) & (rate < fastest))
    findings.require(in_range, RESULTS.rate_out_of_range, value=rate)
    # The rate of the attitude is finite where the state is.
    slopes = {name: rate for name, rate in vars(field).items() if name != "attitude"}
    findings.require(all_finite(slopes), RESULTS.invalid_vector_field)


def harmless_motion(ok: Array, motion: Motion) -> Motion:
    """Normalise the attitude of a motion, and replace an invalid motion by ones.

    Thus no lane waits for an invalid one, and no NaN reaches the derivatives of what
    lanes share. The values are ones, since some forces are singular at the origin.

    Args:
        ok: Whether the motion is valid.
        motion: A named tuple with a field `state0`.
    """
    motion = harmless(ok, motion)
    # Of a valid motion the norm is 1 but for rounding.
    attitude = unit_again(motion.state0.attitude)
    return motion._replace(state0=dataclasses.replace(motion.state0, attitude=attitude))


def solver_of(
    solver: object, default: diffrax.AbstractSolver, or_else: str = ""
) -> diffrax.AbstractSolver:
    """A solver with an error estimate, or ValueError.

    Args:
        solver: The solver, or None for the default.
        default: The default.
        or_else: Further solvers that the caller accepts, for the error message.
    """
    if not isinstance(solver, diffrax.AbstractAdaptiveSolver | None):
        raise ValueError(
            "Argument `solver` must be a diffrax solver with an error estimate"
            f"{or_else}, but it is {kind_of(solver)}."
        )
    return default if solver is None else solver


def depends_on(function: Callable[[Array], Any], x: Array) -> bool:
    """Whether the program of a function uses its argument."""
    return used_inputs(jax.make_jaxpr(function)(x))[0]


def exact_motion(check: Check, flow: Flow, throw: bool, *motion: Any) -> ExactStates:
    """An exact motion at times of any shape.

    Args:
        check: Notes invalid values of the body.
        flow: The exact flow.
        throw: Whether an invalid value raises an error; if not, it gives NaN and a
            result code.
        motion: The body, its state at `t0` (as from `plain_state`), the times and `t0`,
            all in one dtype.
    """
    check_shape("t0", motion[-1], ())
    answer = _exact_states(check, flow, *motion)
    return settle(answer, throw, _motion_findings, check, *motion)


def _motion_findings(
    check: Check, body: PyTree, state0: State, ts: Array, t0: Array
) -> Findings:
    """Errors in the arguments of an exact motion."""
    findings = Findings()
    check(findings, body)
    _check_state(findings, state0)
    for name, times in (("t0", t0), ("ts", ts)):
        message = f"Argument `{name}` must be finite, but it is not."
        # The error shows the sum of the times, which is NaN or infinite.
        findings.require(
            all_finite(times), RESULTS.invalid_times, message, jnp.sum(times)
        )
    resolved = resolves(t0, safe_norm(state0.omega))
    findings.require(resolved, RESULTS.unresolved_times, value=t0)
    return findings


@quick_jit
def _exact_states(
    check: Check, flow: Flow, body: PyTree, state0: State, ts: Array, t0: Array
) -> ExactStates:
    """The states at all times, NaN and with a result code for invalid arguments."""
    findings = _motion_findings(check, body, state0, ts, t0)

    def states(body: PyTree, state0: State, times: Array) -> State:
        at_time = partial(flow, body, state0)
        return State(*jnp.vectorize(at_time, signature="()->(4),(3)")(times))

    answer = where_defined(findings.ok, states, body, state0, ts - t0)
    findings.require(all_finite(answer), RESULTS.nonfinite_state)
    return ExactStates(nan_where(~findings.ok, answer), findings.result)
