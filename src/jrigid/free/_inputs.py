"""What the functions of a free rotation do with their arguments: check, and find the motion."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_inertia_shape,
    check_shape,
    float_arrays,
    is_inertia,
)
from jrigid._numerics import product
from jrigid._spectral import eigh
from jrigid._types import InertiaLike, VectorLike
from jrigid.free._flow import Motion, invariants


def checked(inertia: Any, omega: Any, throw: bool) -> tuple[Findings, tuple[Array, Array]]:
    inertia, omega = float_arrays(inertia, omega)
    check_inertia_shape(inertia)
    check_shape("omega", omega, (3,))
    findings = Findings()
    findings.require(is_inertia(inertia), RESULTS.invalid_inertia)
    findings.require(
        all_finite(omega),
        RESULTS.invalid_state,
        "Argument `omega` must be finite, but it is not.",
    )
    inertia, omega = findings.apply((inertia, omega), throw)
    one = jnp.ones(3, inertia.dtype) if inertia.ndim == 1 else jnp.eye(3, dtype=inertia.dtype)
    ok = findings.ok
    return findings, (jnp.where(ok, inertia, one), jnp.where(ok, omega, 0.0))


def in_principal_axes(inertia: Array, omega: Array) -> tuple[Array, Array]:
    if inertia.ndim == 1:
        return inertia, omega
    moments, axes = eigh(inertia)
    return moments, product("ji,j->i", axes, omega)


def motion_of(inertia: InertiaLike, omega: VectorLike, throw: bool) -> tuple[Findings, Motion]:
    findings, arrays = checked(inertia, omega, throw)
    return findings, invariants(*in_principal_axes(*arrays))
