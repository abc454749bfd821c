"""What all solids share: their checks, and the way to mass properties."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

from jrigid._checks import RESULTS, Findings, check_shape, float_arrays
from jrigid.mass import MassProperties
from jrigid.mass._body import raise_or_mark


def mass_and_lengths(mass: ArrayLike, **lengths: tuple[ArrayLike, tuple[int, ...]]) -> list[Array]:
    arrays = float_arrays(mass, *(value for value, _ in lengths.values()))
    check_shape("mass", arrays[0], ())
    for array, (name, (_, shape)) in zip(arrays[1:], lengths.items(), strict=True):
        check_shape(name, array, shape)
    return list(arrays)


def solid(
    mass: Array,
    inertia_per_mass: Array,
    throw: bool,
    *,
    positive: dict[str, Array],
    others: tuple[tuple[Bool[Array, ""], str], ...] = (),
    center: Array | None = None,
) -> MassProperties:
    findings = Findings()
    findings.require((mass > 0) & jnp.isfinite(mass), RESULTS.invalid_mass)
    for name, length in positive.items():
        fine = jnp.all((length > 0) & jnp.isfinite(length))
        message = RESULTS[RESULTS.invalid_length].format(name)
        findings.require(fine, RESULTS.invalid_inertia, message)
    for fine, message in others:
        findings.require(fine, RESULTS.invalid_inertia, message)
    tensor = jnp.diag(inertia_per_mass) if inertia_per_mass.ndim == 1 else inertia_per_mass
    center = jnp.zeros(3, mass.dtype) if center is None else center
    return MassProperties(
        *raise_or_mark(findings, (mass, center, mass * tensor), throw), throw=None
    )
