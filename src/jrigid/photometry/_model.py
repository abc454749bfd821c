"""Light curves of a tumbling ellipsoid in the numbers that a fit seeks."""

import enum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from jrigid._numerics import product
from jrigid._types import AnyArray, Matrix, Scalar, Vector
from jrigid.photometry._curve_readings import Readings
from jrigid.photometry._ellipsoid import lommel_seeliger_brightness
from jrigid.photometry._many_starts import Quadratic
from jrigid.photometry._wobble import Wobble, body_axes, wobble


class Mode(enum.IntEnum):
    """Kinds of motion; the values are those that compiled programs are given."""

    principal_axis = 0
    short_axis = 1
    long_axis = 2


class Numbers(NamedTuple):
    """Numbers that a fit seeks; leaves may have lanes in front.

    Attributes:
        cycles: Turns of precession and of rotation within the span.
        angles: Mean angle of precession and phase of rotation at time 0 [rad].
        pole: Longitude and latitude of the momentum, in the axes of the fit [rad].
        log_tangent: Logarithm of the tangent of the largest tilt.
        shape: Logits of the ratios b/a and c/b of the semi-axes, see `ratios_of`.
        inertia: The same of the homogeneous ellipsoid that has the moments of inertia.
    """

    cycles: Float[AnyArray, "*lanes 2"]
    angles: Float[AnyArray, "*lanes 2"]
    pole: Float[AnyArray, "*lanes 2"]
    log_tangent: Float[AnyArray, "*lanes 1"]
    shape: Float[AnyArray, "*lanes 2"]
    inertia: Float[AnyArray, "*lanes 2"]


COUNT = 11
# Ratios of semi-axes are no smaller, so that a needle keeps an area to see.
_LEAST_RATIO = 0.02
# A ratio of 1, or the least one, has no logit: it is taken this far from them.
_OFF_LIMIT = 1e-3
_SLICES = Numbers(
    *(slice(i, j) for i, j in [(0, 2), (2, 4), (4, 6), (6, 7), (7, 9), (9, 11)])
)


def unpacked(vector: Float[AnyArray, "*lanes 11"]) -> Numbers:
    """The numbers of a vector."""
    return Numbers(*(vector[..., part] for part in _SLICES))


class Task(NamedTuple):
    """Interpretation of the numbers of one lane.

    Attributes:
        frame: Axes of the fit, in which the pole is near the x axis; rows are their
            directions in space.
        mode: A `Mode`.
        homogeneous: Whether the moments are those of the ellipsoid that is seen.
        link: Weight of the equation between the periods, the tilt and the moments.
    """

    # Near the x axis longitude and latitude are regular. At the poles of these axes a
    # step of the longitude would move nothing.
    frame: Float[AnyArray, "*lanes 3 3"]
    mode: Int[AnyArray, "*lanes"]
    homogeneous: Bool[AnyArray, "*lanes"]
    link: Float[AnyArray, "*lanes"]


def sought(task: Task) -> Bool[Array, " 11"]:
    """Whether a lane seeks each number; the others have no meaning there."""
    tumbles = task.mode != Mode.principal_axis
    always = jnp.ones(2, bool)
    free = tumbles & ~task.homogeneous
    one_of_two = jnp.stack([always[0], tumbles])
    return jnp.concatenate(
        Numbers(
            cycles=one_of_two,
            angles=one_of_two,
            pole=always,
            log_tangent=tumbles[None],
            shape=always,
            inertia=jnp.stack([free, free]),
        )
    )


def independent(task: Task) -> Bool[Array, " 11"]:
    """Whether a lane seeks each number and it does not follow from the others.

    The two frequencies of a tumbler determine its tilt.
    """
    return sought(task).at[_SLICES.log_tangent].set(False)


def ratios_of(logits: Float[AnyArray, "*lanes 2"]) -> Float[Array, "*lanes 2"]:
    """Ratios b/a and c/b of semi-axes, between the least one and 1."""
    return _LEAST_RATIO + (1 - _LEAST_RATIO) * jax.nn.sigmoid(jnp.asarray(logits))


def logits_of(ratios: Float[np.ndarray, "*lanes 2"]) -> Float[np.ndarray, "*lanes 2"]:
    """The inverse of `ratios_of`, for any ratios from 0 to 1."""
    part = (ratios - _LEAST_RATIO) / (1 - _LEAST_RATIO)
    part = np.clip(part, _OFF_LIMIT, 1 - _OFF_LIMIT)
    return np.log(part / (1 - part))


def semi_axes(logits: Float[Array, "2"]) -> Vector:
    """Semi-axes of which the longest is 1, from logits of b/a and c/b."""
    # Ratios below 1 keep the order of the axes, so that none changes its role in a fit.
    ratios = ratios_of(logits)
    return jnp.stack([jnp.ones_like(ratios[0]), ratios[0], ratios[0] * ratios[1]])


def inverse_moments(axes: Vector, long_axis: Bool[Array, ""]) -> Vector:
    """1 / I of the axes other, middle, circled; that of the shortest semi-axis is 1."""
    square = axes * axes
    # Those of a homogeneous ellipsoid but for m / 5, which the quotient loses.
    moments = jnp.sum(square) - square
    inverse = moments[2] / moments
    return jnp.where(long_axis, inverse[::-1], inverse)


def motion_of(numbers: Numbers, task: Task) -> Wobble:
    """The series of the motion; of a tumbler of no matter what for the others."""
    tumbles = task.mode != Mode.principal_axis
    logits = jnp.where(task.homogeneous, numbers.shape, numbers.inertia)
    # Axes of equal length give NaN, which would reach the derivatives of a steady
    # rotation although it does not use the series. It takes those of another body.
    logits = jnp.where(tumbles, logits, 0.0)
    log_tangent = jnp.where(tumbles, numbers.log_tangent[0], 0.0)
    inverse = inverse_moments(semi_axes(logits), task.mode == Mode.long_axis)
    return wobble(inverse, log_tangent)


def gap_of_periods(numbers: Numbers, motion: Wobble, task: Task) -> Scalar:
    """Logarithm of the ratio of the frequencies, over that of the motion."""
    tumbles = task.mode != Mode.principal_axis
    # The second frequency of a steady rotation is 0 and has no logarithm.
    cycles = jnp.where(tumbles, numbers.cycles, 1.0)
    sought = jnp.log(cycles[0]) - jnp.log(cycles[1])
    given = jnp.log(motion.precession_rate) - jnp.log(motion.rotation_rate)
    return jnp.where(tumbles, sought - given, 0.0)


class Geometry(NamedTuple):
    """Parts of the model that serve all epochs, computed once from the numbers.

    Attributes:
        cycles: Turns of precession and of rotation within the span.
        angles: Mean angle of precession and phase of rotation at time 0 [rad].
        motion: The series of the motion.
        to_momentum: Rotation from space axes to axes with z along the momentum.
        axes: The semi-axes.
    """

    cycles: Float[Array, "2"]
    angles: Float[Array, "2"]
    motion: Wobble
    to_momentum: Matrix
    axes: Vector


def geometry_of(numbers: Numbers, task: Task) -> Geometry:
    """The geometry of a lane."""
    return Geometry(
        cycles=numbers.cycles,
        angles=numbers.angles,
        motion=motion_of(numbers, task),
        to_momentum=product("ij,jk->ik", axes_of_momentum(numbers.pole), task.frame),
        axes=semi_axes(numbers.shape),
    )


def axes_of_momentum(pole: Float[Array, "2"]) -> Matrix:
    """Axes with z along the momentum, rows, for its longitude and latitude."""
    cosines = jnp.cos(pole)
    sines = jnp.sin(pole)
    zero = jnp.zeros_like(sines[0])
    south = jnp.stack([sines[1] * cosines[0], sines[1] * sines[0], -cosines[1]])
    east = jnp.stack([-sines[0], cosines[0], zero])
    along = jnp.stack([cosines[1] * cosines[0], cosines[1] * sines[0], sines[1]])
    return jnp.stack([south, east, along])


def directions_of_axes(geometry: Geometry, mode: Array, time: Scalar) -> Matrix:
    """Directions of body axes at a time in spans, in axes with z along the momentum.

    Row i is the direction of axis i.
    """
    # The two frequencies are numbers of the fit, not those of `motion`. The gap between
    # them is a row of the residuals.
    angles = 2 * jnp.pi * geometry.cycles * time + geometry.angles
    tumbling = body_axes(geometry.motion, angles[1], angles[0])
    # A long-axis mode circles x, and y is turned so that the axes stay right-handed.
    about_x = tumbling[::-1] * jnp.asarray([[1.0], [-1.0], [1.0]], tumbling.dtype)
    tumbling = jnp.where(mode == Mode.long_axis, about_x, tumbling)
    cosine = jnp.cos(angles[0])
    sine = jnp.sin(angles[0])
    zero = jnp.zeros_like(sine)
    steady = jnp.stack(
        [
            jnp.stack([cosine, sine, zero]),
            jnp.stack([-sine, cosine, zero]),
            jnp.stack([zero, zero, zero + 1]),
        ]
    )
    return jnp.where(mode == Mode.principal_axis, steady, tumbling)


def log_brightness(
    geometry: Geometry, mode: Array, time: Scalar, to_sun: Vector, to_observer: Vector
) -> Scalar:
    """Logarithm of the brightness at a time in spans, for directions in space."""
    axes = directions_of_axes(geometry, mode, time)
    body = product("ij,jk->ik", axes, geometry.to_momentum)
    sun = product("ij,j->i", body, to_sun)
    observer = product("ij,j->i", body, to_observer)
    return jnp.log(lommel_seeliger_brightness(geometry.axes, sun, observer))


class Rows(NamedTuple):
    """Residuals over the noise, the gap between the periods last, and their slopes."""

    residuals: Float[Array, " rows"]
    slopes: Float[Array, "rows 11"]


def rows_of(vector: Float[Array, "11"], task: Task, readings: Readings) -> Rows:
    """Readings less the model, and derivatives in the numbers.

    Reverse mode gives the derivatives of one epoch in the geometry, and forward mode
    those of the geometry in the numbers: together they cost half of forward mode alone.
    """

    def of_vector(x: Array) -> tuple[Array, Array]:
        numbers = unpacked(x)
        geometry = geometry_of(numbers, task)
        flat, _ = ravel_pytree(geometry)
        gap = task.link * gap_of_periods(numbers, geometry.motion, task)
        return flat, gap

    flat, gap = of_vector(vector)
    flat_slopes, gap_slopes = jax.jacfwd(of_vector)(vector)
    # `jacfwd` passes on arrays alone, so the inverse of the flattening is made here.
    _, restored = ravel_pytree(geometry_of(unpacked(vector), task))

    def of_epoch(flat: Array, time: Array, sun: Array, observer: Array) -> Array:
        return log_brightness(restored(flat), task.mode, time, sun, observer)

    each = jax.vmap(jax.value_and_grad(of_epoch), (None, 0, 0, 0))
    # In this unit of time the frequencies are the cycles within the span.
    times = readings.ts / readings.span
    model, slopes = each(flat, times, readings.to_sun, readings.to_observer)
    slopes = product("eg,gn->en", slopes, flat_slopes)
    projected = jax.vmap(readings.projected, -1, -1)(slopes)
    return Rows(
        residuals=jnp.append(readings.values - readings.projected(model), gap),
        slopes=jnp.concatenate([-projected, gap_slopes[None]]),
    )


def tumbler_quadratic(
    vector: Float[Array, "11"], task: Task, readings: Readings
) -> Quadratic:
    """Chi-square of one lane and its derivatives in the numbers that it seeks."""
    rows, slopes = rows_of(vector, task, readings)
    slopes = jnp.where(sought(task), slopes, 0.0)
    return Quadratic(
        chi_square=product("r,r->", rows, rows),
        slope=product("rn,r->n", slopes, rows),
        normal=product("rn,rm->nm", slopes, slopes),
    )
