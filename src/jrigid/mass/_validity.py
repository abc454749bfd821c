"""Whether values are those of a body, and how the code of what is wrong is kept in the values."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jrigid._checks import RESULTS, Findings, all_finite, is_symmetric, of_unit_size
from jrigid._types import Matrix, Scalar, Vector

ULPS = 64  # rounding allowed in "symmetric", "not negative" and "I3 <= I1 + I2"

Body = tuple[Scalar, Vector, Matrix]  # mass, centre of mass, tensor about it

_MOMENTS = np.eye(3, dtype=bool)
_LAST_MOMENT = np.diag([False, False, True])
# Moments left finite, by the code of what leaves neither mass nor centre.
_NOTHING_ELSE = (
    (RESULTS.open_mesh, np.diag([True, False, False])),
    (RESULTS.inside_out_mesh, np.diag([False, True, False])),
    (RESULTS.invalid_masses, np.diag([True, True, False])),
    (RESULTS.invalid_density, np.diag([True, False, True])),
)


_MARKS = np.stack([_MOMENTS, _LAST_MOMENT, *(kept for _, kept in _NOTHING_ELSE)])


@jax.jit
def _marks(tensor: Float[Array, "3 3"]) -> Bool[Array, " marks"]:
    """Which of `_MARKS` are the finite entries of a tensor, all others being NaN."""
    finite, nan = jnp.isfinite(tensor)[None], jnp.isnan(tensor)[None]
    return jnp.all((_MARKS & finite) | (~_MARKS & nan), axis=(1, 2))


def find(findings: Findings, mass: Scalar, center_of_mass: Vector, tensor: Matrix) -> None:
    """Read what `raise_or_mark` has marked, and find what else is not finite."""
    mass, center_of_mass, tensor = jax.lax.stop_gradient((mass, center_of_mass, tensor))
    centered = all_finite(center_of_mass)
    moments, last, *marks = _marks(tensor)
    nothing = jnp.isnan(mass) & jnp.all(jnp.isnan(center_of_mass))
    for (code, _), mark in zip(_NOTHING_ELSE, marks, strict=True):
        findings.require(~(nothing & mark), code)
    findings.require((mass > 0) & jnp.isfinite(mass), RESULTS.invalid_mass)
    findings.require(centered | ~last, RESULTS.invalid_attitude)
    findings.require(
        centered,
        RESULTS.invalid_position,
        "Argument `center_of_mass` must be finite, but it is not.",
    )
    findings.require(~last, RESULTS.invalid_length)
    findings.require(~moments, RESULTS.unphysical_inertia)
    findings.require(all_finite(tensor), RESULTS.invalid_inertia, _NOT_A_BODY)


@jax.jit
def is_finite_symmetric(tensor: Float[Array, "3 3"]) -> Bool[Array, ""]:
    return all_finite(tensor) & is_symmetric(tensor)


def is_semidefinite(tensor: Float[Array, "3 3"], scale: Scalar) -> Bool[Array, ""]:
    """Whether no moment is below -64 ulps of a scale: Cholesky with diagonal pivots.

    Entries and scale are about 1: products of much larger or smaller ones leave the range.
    """
    # A few ulps off at any moments, where the roots of the cubic lose half the digits.
    shift = ULPS * jnp.finfo(tensor.dtype).eps * scale
    rest = tensor + shift * jnp.eye(3, dtype=tensor.dtype)
    left, fine = jnp.ones(3, bool), jnp.asarray(True)
    for _ in range(3):
        k = jnp.argmax(jnp.where(left, jnp.diagonal(rest), -jnp.inf))
        row, pivot = rest[k], rest[k, k]
        fine = fine & (pivot >= 0)
        rest = rest - row[:, None] * row[None, :] / jnp.where(pivot > 0, pivot, 1.0)
        left = left & (jnp.arange(3) != k)
    return fine


@jax.jit
def is_physical(tensor: Float[Array, "3 3"]) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether a tensor is positive semi-definite, and whether I3 <= I1 + I2, to rounding."""
    (tensor,) = of_unit_size(jax.lax.stop_gradient(tensor))
    trace = jnp.trace(tensor)
    second = 0.5 * trace * jnp.eye(3, dtype=tensor.dtype) - tensor
    return is_semidefinite(tensor, trace), is_semidefinite(second, trace)


_NOT_A_BODY = (
    "Argument `inertia` must hold three finite, non-negative principal moments or be a finite, "
    "symmetric, positive semi-definite (3, 3) tensor, but it is not. (Three bodies are three "
    "lanes of `jax.vmap`, not the rows of a (3, 3) array.)"
)


def judge(mass: Scalar, center_of_mass: Vector, tensor: Matrix) -> Findings:
    tensor = jax.lax.stop_gradient(tensor)
    findings = Findings()
    find(findings, mass, center_of_mass, tensor)
    positive, triangle = is_physical(tensor)
    findings.require(is_finite_symmetric(tensor) & positive, RESULTS.invalid_inertia, _NOT_A_BODY)
    findings.require(triangle, RESULTS.unphysical_inertia)
    return findings


def raise_or_mark(findings: Findings, body: Body, throw: bool) -> Body:
    """Raise, or turn what is wrong, and all that follows from it, into NaN.

    What is left finite lets `MassProperties.result` recover the code: of an unphysical tensor
    the diagonal, of an invalid one mass and centre, of an invalid position the mass; after an
    invalid length or attitude also the last moment; of the codes in `_NOTHING_ELSE` moments alone.
    Other codes turn into `invalid_mass`.
    """
    if throw:
        return findings.apply(body, throw)
    mass, center_of_mass, tensor = body
    code = findings.result
    unphysical = code == RESULTS.unphysical_inertia
    length, attitude = code == RESULTS.invalid_length, code == RESULTS.invalid_attitude
    bad_center = ~(findings.ok | unphysical | length | (code == RESULTS.invalid_inertia))
    bad_mass = bad_center & ~attitude & (code != RESULTS.invalid_position)
    kept = (unphysical & _MOMENTS) | ((length | attitude) & _LAST_MOMENT)
    for lost, moments in _NOTHING_ELSE:
        kept = kept | ((code == lost) & moments)
    # A kept moment is finite: the mark must be read again.
    marked = jnp.where(kept, jnp.where(jnp.isfinite(tensor), tensor, 1.0), jnp.nan)
    return (
        jnp.where(bad_mass, jnp.nan, mass),
        jnp.where(bad_center, jnp.nan, center_of_mass),
        jnp.where(findings.ok, tensor, marked),
    )


NOT_SYMMETRIC = (
    "Argument `inertia` must hold three finite principal moments or be a finite, symmetric (3, 3) "
    "tensor, but it is not. (Three bodies are three lanes of `jax.vmap`, not the rows of a (3, 3) "
    "array.)"
)
