"""What all solids share: their checks, and the way to mass properties."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

from jrigid._checks import RESULTS, Findings, check_shape, float_arrays
from jrigid.mass import MassProperties
from jrigid.mass._validity import raise_or_mark


def mass_and_lengths(
    mass: ArrayLike, **lengths: tuple[ArrayLike, tuple[int, ...]]
) -> tuple[Findings, list[Array]]:
    """What was found wrong, then the mass and the lengths, with 1 for what is bad.

    A moment that is NaN would reach the gradients of the other lanes of a batch.
    """
    mass, *arrays = float_arrays(mass, *(value for value, _ in lengths.values()))
    check_shape("mass", mass, ())
    for array, (name, (_, shape)) in zip(arrays, lengths.items(), strict=True):
        check_shape(name, array, shape)
    findings = Findings()
    safe = [checked_mass(findings, mass)]
    for name, array in zip(lengths, arrays, strict=True):
        fine = (array > 0) & jnp.isfinite(array)
        message = f"Argument `{name}` must be positive and finite, but it is not."
        findings.require(jnp.all(fine), RESULTS.invalid_length, message)
        safe.append(jnp.where(fine, array, 1.0))
    return findings, safe


def checked_mass(findings: Findings, mass: Array) -> Array:
    fine = (mass > 0) & jnp.isfinite(mass)
    findings.require(fine, RESULTS.invalid_mass)
    return jnp.where(fine, mass, 1.0)


def solid(
    findings: Findings,
    mass: Array,
    inertia_per_mass: Array,
    throw: bool,
    *,
    fits: tuple[Bool[Array, ""], str] | None = None,
    center: Array | None = None,
) -> MassProperties:
    if fits is not None:
        findings.require(fits[0], RESULTS.invalid_length, fits[1])
    tensor = jnp.diag(inertia_per_mass) if inertia_per_mass.ndim == 1 else inertia_per_mass
    center = jnp.zeros(3, mass.dtype) if center is None else center
    return MassProperties(
        *raise_or_mark(findings, (mass, center, mass * tensor), throw), throw=None
    )
