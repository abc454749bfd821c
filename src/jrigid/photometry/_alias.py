"""One tumbler that explains light curves: its estimates, errors and evidence."""

import dataclasses
import functools
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._numerics import product
from jrigid._types import AnyArray
from jrigid.photometry._curve_readings import Readings
from jrigid.photometry._ellipsoid import Ellipsoid
from jrigid.photometry._model import (
    Geometry,
    Mode,
    Numbers,
    Task,
    axes_of_momentum,
    geometry_of,
    independent,
    inverse_moments,
    ratios_of,
    rows_of,
    semi_axes,
    sought,
    unpacked,
)
from jrigid.photometry._tumbler import Tumbler

MODES = {
    "principal-axis": Mode.principal_axis,
    "short-axis": Mode.short_axis,
    "long-axis": Mode.long_axis,
}
Errors = TypeVar("Errors")
_NAMES = {mode: name for name, mode in MODES.items()}
# Least eigenvalue of a scaled normal matrix: no error is more than this^-1/2 larger.
_LEAST = 1e-15
# Nothing between 0 and 1 has a larger standard deviation.
_LARGEST_OF_RATIO = 0.5


class Estimates(NamedTuple):
    """Quantities that observers quote of a tumbler, or their standard errors.

    Attributes:
        precession_period: P_phi, or the period of a principal-axis rotation [s].
        rotation_period: P_psi [s]; NaN for a principal-axis rotation.
        longitude: Of the angular momentum, space axes [rad].
        latitude: Of the angular momentum [rad].
        energy_ratio: E/E0; 1 for a principal-axis rotation.
        moments: Ratios I1/I3 and I2/I3; NaN for a principal-axis rotation.
        axis_ratios: b/a and c/b of the ellipsoid.
    """

    precession_period: Float[AnyArray, ""]
    rotation_period: Float[AnyArray, ""]
    longitude: Float[AnyArray, ""]
    latitude: Float[AnyArray, ""]
    energy_ratio: Float[AnyArray, ""]
    moments: Float[AnyArray, "2"]
    axis_ratios: Float[AnyArray, "2"]


@dataclasses.dataclass(frozen=True)
class Alias:
    """One tumbler that explains light curves.

    Attributes:
        tumbler: The body; its time 0 is at `Inversion.epoch`.
        estimates: Its periods, pole, energy, moments and shape.
        errors: Their standard errors, enlarged where chi-square is too large.
        chi_square: Sum of squares of the residuals over the noise.
        weight: Probability of this alias among those of the table.
        residuals: Of each point of the curves, in their order [mag].
        numbers: The numbers of the fit.
        task: How they are read.
        covariance: Of the numbers.
    """

    tumbler: Tumbler
    estimates: Estimates
    errors: Estimates
    chi_square: float
    weight: float
    residuals: Float[np.ndarray, " epochs"]
    numbers: Float[np.ndarray, " 11"] = dataclasses.field(repr=False)
    task: Task = dataclasses.field(repr=False)
    covariance: Float[np.ndarray, "11 11"] = dataclasses.field(repr=False)


def alias_of(
    numbers: np.ndarray, task: Task, readings: Readings, scale: float
) -> Alias:
    """One row of the table, without its weight."""
    rows, slopes = rows_at(numbers, task, readings)
    normal = np.asarray(slopes).T @ np.asarray(slopes)
    covariance = scale * covariance_of(normal, np.asarray(sought(task)))
    span = np.asarray(readings.span)
    estimates, of_numbers = _estimates_and_slopes(numbers, task, span)
    errors = errors_of(of_numbers, covariance)
    return Alias(
        tumbler=tumbler_of(numbers, task, estimates),
        estimates=jax.tree.map(np.asarray, estimates),
        errors=errors._replace(
            axis_ratios=np.minimum(errors.axis_ratios, _LARGEST_OF_RATIO)
        ),
        chi_square=float(np.sum(np.asarray(rows) ** 2)),
        weight=0.0,
        # The last row is no point, but the equation between the periods.
        residuals=readings.in_magnitudes(np.asarray(rows)[:-1]),
        numbers=numbers,
        task=task,
        covariance=covariance,
    )


rows_at = jax.jit(rows_of)


def covariance_of(normal: np.ndarray, seeks: np.ndarray) -> np.ndarray:
    """Covariance of the numbers that are sought; 0 of the others."""
    covariance = np.zeros_like(normal)
    inside = np.ix_(seeks, seeks)
    covariance[inside] = _inverse_normal(normal[inside])
    return covariance


def errors_of(slopes: Errors, covariance: np.ndarray) -> Errors:
    """Standard errors of estimates, from their derivatives in the numbers."""
    return jax.tree.map(
        lambda x: np.sqrt(np.einsum("...i,ij,...j->...", x, covariance, x)), slopes
    )


def _inverse_normal(normal: np.ndarray) -> np.ndarray:
    """Inverse of a normal matrix, by its scale.

    Along what is not determined it is finite, and at most 1e15 in units in which the
    diagonal of the matrix is 1.
    """
    size = np.sqrt(np.diag(normal))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(normal / np.outer(size, size))
    # Rounding may make the least eigenvalues negative.
    values = np.maximum(values, _LEAST)
    return (vectors / values) @ vectors.T / np.outer(size, size)


def log_evidence(alias: Alias, growth: float, width: float) -> float:
    """Logarithm of the evidence of an alias, but for a constant, by Laplace's method.

    The priors are flat: in the frequencies between the limits of the search, in angles,
    directions and ratios of axes. They decide between motions with different counts of
    numbers. The tilt follows from the frequencies and has no prior.

    Args:
        alias: The alias.
        growth: Of its chi-square over that of the best one.
        width: Of the range of frequencies [cycles].
    """
    seeks = np.asarray(independent(alias.task))
    covariance = alias.covariance[np.ix_(seeks, seeks)]
    size = np.sqrt(np.diag(covariance))
    _, logarithm = np.linalg.slogdet(covariance / np.outer(size, size))
    numbers = unpacked(alias.numbers)
    # Half the logarithm of the determinant of the covariance: the volume of the peak.
    spread = 0.5 * logarithm + np.sum(np.log(size))
    # The integral over a peak of n numbers has the factor (2 pi)^(n / 2).
    peak = spread + 0.5 * len(size) * np.log(2 * np.pi)
    # The prior is flat in solid angle and in ratios, not in latitude and in logits.
    # With p the part of the range of ratios that lies below it, a logit x has
    # dp / dx = p (1 - p), which may underflow.
    slopes = [
        -np.logaddexp(0, x) - np.logaddexp(0, -x)
        for x in (numbers.shape, numbers.inertia)
    ]
    densities = Numbers(
        cycles=np.full(2, -np.log(width)),
        angles=np.full(2, -np.log(2 * np.pi)),
        # A fit may pass a pole of its axes, beyond which the cosine is negative.
        pole=np.array([0.0, np.log(np.abs(np.cos(numbers.pole[1])))]),
        log_tangent=np.zeros(1),
        shape=slopes[0],
        inertia=slopes[1],
    )
    prior = np.sum(np.concatenate(densities)[seeks])
    return float(-growth / 2 + peak + prior)


@jax.jit
def _estimates_and_slopes(
    numbers: Array, task: Task, span: Array
) -> tuple[Estimates, Estimates]:
    """Estimates and their derivatives in the numbers."""
    estimates = functools.partial(estimates_at, task=task, span=span)
    return estimates(numbers), jax.jacfwd(estimates)(numbers)


def estimates_at(vector: Array, task: Task, span: Array) -> Estimates:
    """Quantities that observers quote, from the vector of numbers."""
    numbers = unpacked(vector)
    tumbles = task.mode != Mode.principal_axis
    pole = product("ij,i->j", task.frame, axes_of_momentum(numbers.pole)[2])
    logits = jnp.where(task.homogeneous, numbers.shape, numbers.inertia)
    inverse = inverse_moments(semi_axes(logits), task.mode == Mode.long_axis)
    # At the largest tilt the angular momentum has components along the intermediate and
    # the circled axis only.
    tangent2 = jnp.exp(2 * jnp.where(tumbles, numbers.log_tangent[0], 0.0))
    # This is 2 E / L^2. `inverse` is 1 for the largest moment, so that E0 has the
    # value 1.
    energy = (inverse[1] * tangent2 + inverse[2]) / (1 + tangent2)
    moments = 1 / inverse_moments(semi_axes(logits), jnp.asarray(False))
    return Estimates(
        precession_period=span / numbers.cycles[0],
        # A steady rotation has no second frequency, by which derivatives would divide.
        rotation_period=jnp.where(
            tumbles, span / jnp.where(tumbles, numbers.cycles[1], 1.0), jnp.nan
        ),
        longitude=jnp.arctan2(pole[1], pole[0]) % (2 * jnp.pi),
        latitude=jnp.arcsin(jnp.clip(pole[2], -1.0, 1.0)),
        energy_ratio=jnp.where(tumbles, energy, 1.0),
        moments=jnp.where(tumbles, moments[:2], jnp.nan),
        axis_ratios=ratios_of(numbers.shape),
    )


def tumbler_of(vector: np.ndarray, task: Task, estimates: Any) -> Tumbler:
    """The body in space axes.

    Args:
        vector: The numbers of a fit.
        task: How they are read.
        estimates: `Estimates`, or what else has the periods and the pole.
    """
    numbers = unpacked(jnp.asarray(vector))
    geometry = _geometry(vector, task)
    pole = jnp.stack([estimates.longitude, estimates.latitude])
    # The angle of precession counts from the axis that points south of the pole.
    south = product("ij,kj->ik", geometry.to_momentum, axes_of_momentum(pole))[0]
    angle = numbers.angles[0] + jnp.arctan2(south[1], south[0])
    logits = numbers.shape if task.homogeneous else numbers.inertia
    return Tumbler(
        moments=1 / inverse_moments(semi_axes(logits), jnp.asarray(False)),
        precession_period=estimates.precession_period,
        rotation_period=estimates.rotation_period,
        longitude=estimates.longitude,
        latitude=estimates.latitude,
        precession_angle=angle,
        rotation_phase=numbers.angles[1] / (2 * jnp.pi),
        shape=Ellipsoid(geometry.axes),
        mode=_NAMES[Mode(int(task.mode))],
    )


@jax.jit
def _geometry(vector: Array, task: Task) -> Geometry:
    """The geometry of a lane."""
    return geometry_of(unpacked(vector), task)
