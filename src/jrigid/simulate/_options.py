"""What `simulate` does with its arguments: options at trace time, values at run time."""

import warnings
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_shape,
    float_arrays,
    is_concrete,
    is_unit,
)
from jrigid.systems import AbstractSystem

DEFAULT_RTOL = {8: 1e-8, 4: 1e-5}
_SMALLEST_RTOL = {8: 1e-14, 4: 1e-7}


def numbers(**values: Any) -> tuple[Array, ...]:
    """Floating point arrays of one dtype, or a ValueError that names what is not numbers."""
    for name, value in values.items():
        try:
            float_arrays(value)
        except (TypeError, ValueError) as error:
            raise ValueError(f"Argument `{name}` must be numbers, but it is {value!r}.") from error
    return float_arrays(*values.values())


def tolerances(rtol: Any, atol: Any, dtype: Any) -> tuple[Array, Array]:
    """Both tolerances as arrays; what is known now to be out of bounds is a ValueError."""
    size = jnp.dtype(dtype).itemsize
    if rtol is None:
        rtol = DEFAULT_RTOL[size]
    if atol is None:
        atol = rtol
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
            stacklevel=3,
        )
    return jnp.asarray(rtol, dtype), jnp.asarray(atol, dtype)


def check_values(
    findings: Findings,
    system: AbstractSystem,
    state0: Any,
    flat: Array,
    t0: Array,
    longest: Array,
    rtol: Array,
    atol: Array,
    args: Any,
) -> None:
    """Note every bad value that goes into an integration."""
    ordered = jnp.all(flat[1:] >= flat[:-1]) & (flat[0] >= t0)
    smallest = _SMALLEST_RTOL[rtol.dtype.itemsize]
    for tolerance in (rtol, atol):
        findings.require((tolerance >= smallest) & (tolerance < 1), RESULTS.invalid_tolerance)
    system.check(findings)
    findings.require(all_finite(state0), RESULTS.invalid_state)
    findings.require(is_unit(state0.attitude), RESULTS.invalid_attitude)
    findings.require(all_finite((flat - t0).astype(rtol.dtype)) & ordered, RESULTS.invalid_times)
    findings.require(longest > 0, RESULTS.invalid_max_step)
    field = system.vector_field(t0.astype(rtol.dtype), state0, args)
    findings.require(all_finite(field), RESULTS.invalid_vector_field)
