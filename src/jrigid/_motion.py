"""What every call that moves a body asks of its arguments: system, state and times."""

import dataclasses
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_precision,
    check_shape,
    check_type,
    float_arrays,
    is_unit,
)
from jrigid._numerics import safe_norm
from jrigid.dynamics import State
from jrigid.systems import AbstractSystem, RigidBody

_SIZES = {"position": 3, "velocity": 3, "attitude": 4, "omega": 3}


@runtime_checkable
class HasRigidBody(Protocol):
    """What is a rigid body in other words, a `jrigid.SymmetricTop` for one."""

    def as_rigid_body(self) -> RigidBody:
        """The same as a system for `simulate`."""
        ...


def motion_arguments(
    system: Any, state: Any, kind: type = AbstractSystem, name: str = "state0", **times: Any
) -> tuple[Any, Any, tuple[Array, ...]]:
    """System, state and times with types and shapes checked, or ValueError.

    Args:
        system: Of the kind, or with a method `as_rigid_body`.
        state: Its state. Internal parts that are not given start at rest relative to the body.
        kind: What the system must be.
        name: What the state is called.
        times: By their names: `ts` of any shape, the others numbers.

    Returns:
        The system; the state, all of it in one dtype; the times in one dtype, theirs: they may have
        more digits than the state, and are to be subtracted before they are rounded to its own.
    """
    if isinstance(system, HasRigidBody):
        system = system.as_rigid_body()
    if not isinstance(system, kind):
        names = "jrigid system (a RigidBody, a FloatingBody)"
        wanted = names if kind is AbstractSystem else kind.__name__
        raise ValueError(
            f"Argument `system` must be a {wanted}, but it is {type(system).__name__}."
        )
    check_type(name, state, system.state_type)
    return system, _checked_state(system, state, name), _checked_times(times)


def _checked_state(system: AbstractSystem, state: Any, name: str) -> Any:
    fields = [x.name for x in dataclasses.fields(state) if x.name in _SIZES]
    for field in fields:
        value, size = getattr(state, field), _SIZES[field]
        if not eqx.is_array(value):
            raise ValueError(
                f"Argument `{name}.{field}` must be an array of shape ({size},), "
                f"but it is {value!r}."
            )
        check_shape(f"{name}.{field}", value, (size,))
    parts, structure = jtu.tree_flatten(state.internal)
    arrays = float_arrays(*(getattr(state, x) for x in fields), *parts)
    check_precision(arrays[0].dtype)
    known, parts = arrays[: len(fields)], arrays[len(fields) :]
    state = dataclasses.replace(
        state, **dict(zip(fields, known, strict=True)), internal=structure.unflatten(parts)
    )
    return system.with_parts(state)


def plain_state(name: str, state: Any, *others: Any) -> tuple[State, tuple[Array, ...]]:
    """A state without internal parts and other arrays in one dtype, or ValueError."""
    check_type(name, state, State)
    if jtu.tree_leaves(state.internal):
        raise ValueError(
            f"Argument `{name}.internal` must be empty, but it is not: a body with moving parts "
            "has no motion in closed form; use `jrigid.simulate`."
        )
    attitude, omega, *converted = float_arrays(state.attitude, state.omega, *others)
    check_shape(f"{name}.attitude", attitude, (4,))
    check_shape(f"{name}.omega", omega, (3,))
    check_precision(omega.dtype)
    return State(attitude, omega), tuple(converted)


# Times are told apart while their last bit is worth less than this turn [rad].
_BLUR = 0.1


def resolves(t0: Array, rate: Array) -> Array:
    """Whether times near `t0` can be told apart in their dtype, for a body that turns at a rate."""
    blur = (jnp.finfo(t0.dtype).eps * jnp.abs(t0)).astype(rate.dtype)
    return ~(blur * rate > _BLUR)


def numbers(**values: Any) -> tuple[Array, ...]:
    """Floating point arrays of one dtype, or a ValueError that names what is not numbers."""
    for name, value in values.items():
        try:
            float_arrays(value)
        except (TypeError, ValueError) as error:
            raise ValueError(f"Argument `{name}` must be numbers, but it is {value!r}.") from error
    return float_arrays(*values.values())


def _checked_times(times: dict[str, Any]) -> tuple[Array, ...]:
    arrays = numbers(**times)
    for name, value in zip(times, arrays, strict=True):
        if name != "ts":
            check_shape(name, value, ())
        elif value.size == 0:
            raise ValueError("Argument `ts` must hold at least one time, but it is empty.")
    return arrays


def _rate_range(dtype: Any) -> tuple[float, float]:
    """Rates whose squares, and the last bits of those, are within the range of the dtype."""
    info = np.finfo(dtype)
    return float(info.tiny / info.eps) ** 0.5, float(info.max * info.eps) ** 0.5


def check_motion(findings: Findings, system: Any, state: Any, t: Array, args: Any) -> None:
    """Note bad values of a system and its state at a time in the precision of the state."""
    system.check(findings)
    findings.require(all_finite(state), RESULTS.invalid_state, value=ravel_pytree(state)[0])
    findings.require(is_unit(state.attitude), RESULTS.invalid_attitude, value=state.attitude)
    field = system.vector_field(t, state, args)
    turning, spinning_up = (safe_norm(x) for x in (state.omega, field.omega))
    rate = jnp.maximum(turning, jnp.where(spinning_up < jnp.inf, jnp.sqrt(spinning_up), 0.0))
    slowest, fastest = _rate_range(rate.dtype)
    in_range = (rate == 0) | ((rate > slowest) & (rate < fastest))
    findings.require(in_range, RESULTS.rate_out_of_range, value=rate)
    findings.require(all_finite(field), RESULTS.invalid_vector_field)
