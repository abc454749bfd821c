"""The convex shape, the albedo and the scattering of a body that tumbles."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._checks import demand
from jrigid._numerics import product
from jrigid._types import AnyArray
from jrigid.photometry._alias import (
    MODES,
    covariance_of,
    errors_of,
    estimates_at,
    tumbler_of,
)
from jrigid.photometry._convex import (
    Motion,
    Placed,
    Surface,
    convex_quadratic,
    convex_rows,
    ellipsoid_harmonics,
    facets_of,
    law_of,
    openness,
    surface_of,
    unpacked_convex,
)
from jrigid.photometry._curve_readings import (
    Readings,
    follows,
    noise_in_words,
    readings_of,
    stated_noise,
)
from jrigid.photometry._damit_files import LightCurve
from jrigid.photometry._ellipsoid import Ellipsoid
from jrigid.photometry._inversion import in_degrees, in_hours
from jrigid.photometry._many_starts import Quadratic, minimised
from jrigid.photometry._model import (
    Numbers,
    Task,
    directions_of_axes,
    gap_of_periods,
    geometry_of,
    logits_of,
    unpacked,
)
from jrigid.photometry._pole import direction_of_pole
from jrigid.photometry._scattering import Mixture
from jrigid.photometry._spin import (
    FIRST_NOISE,
    check_curves,
    check_options,
    freedom,
    of_surface,
)
from jrigid.photometry._spin_search import SEARCHED_FACETS, frame_of_pole
from jrigid.photometry._tumbler import Tumbler
from jrigid.photometry._tumbling import tumbling

_DAY = 86400.0
_STEPS = 200  # for each of these weights
# Weights of the equation between the periods and the moments: loose first, so that
# the numbers find each other, then to a millionth.
_LINKS = (300.0, 1e4, 1e6)
# Ratios of semi-axes nearer to 0 or 1 than this are at their limit.
_AT_LIMIT = 0.02
# Of the numbers of the motion, two are the axes of an ellipsoid, which facets replace.
_SOUGHT = np.concatenate(
    Numbers(
        cycles=np.ones(2, bool),
        angles=np.ones(2, bool),
        pole=np.ones(2, bool),
        log_tangent=np.ones(1, bool),
        shape=np.zeros(2, bool),
        inertia=np.ones(2, bool),
    )
)


class ShapeEstimates(NamedTuple):
    """Quantities that observers quote of a tumbler and its surface, or their errors.

    Attributes:
        precession_period: P_phi [s].
        rotation_period: P_psi [s].
        longitude: Of the angular momentum, space axes [rad].
        latitude: Of the angular momentum [rad].
        energy_ratio: E/E0.
        moments: Ratios I1/I3 and I2/I3.
        scattering: `lambert`, `amplitude`, `width` and `slope` of the `Mixture`; an
            error of 0 where they are given.
        albedo: Slope of the logarithm of the albedo along the body axes.
    """

    precession_period: Float[AnyArray, ""]
    rotation_period: Float[AnyArray, ""]
    longitude: Float[AnyArray, ""]
    latitude: Float[AnyArray, ""]
    energy_ratio: Float[AnyArray, ""]
    moments: Float[AnyArray, "2"]
    scattering: Float[AnyArray, "4"]
    albedo: Float[AnyArray, "3"]


@dataclasses.dataclass(frozen=True)
class ShapeFit:
    """A tumbler of convex shape that was fitted to light curves.

    Attributes:
        tumbler: The body with its facets and its scattering law. The sum of the areas
            is that of a unit sphere. Its time 0 is at `epoch`.
        estimates: Its periods, momentum, moments and scattering.
        errors: Their standard errors, near this minimum of chi-square. They hold if the
            errors of the points are independent, and are enlarged where chi-square is
            too large.
        epoch: Julian date of time 0 of the tumbler.
        noise: Standard deviation of a point [mag], stated or found; the median if they
            differ.
        chi_square: Sum of squares of the residuals over the noise, and of what the
            areas and the numbers deviate from what is expected, over its spread.
        reduced_chi_square: Chi-square of the light over its degrees of freedom.
        degrees_of_freedom: Points less unknown numbers.
        correlation: Of the residuals at neighbouring points of a curve. It is near 0
            for noise, and near 1 for a light curve that is missed.
        follows: Whether the fit follows the curves to their noise, as far as it is
            known. If it is not stated, or stated too large, the residuals need only be
            uncorrelated.
        is_noise_found: Whether the noise was not stated: it is what the fit leaves, and
            holds what the model misses.
        is_at_limit: Whether the moments are those of a flat or a round body, at the
            limit of real ones: the fit may have gone astray.
        open_share: Length of the sum of the areas as vectors, over their sum: 0 for a
            closed surface.
        residuals: Of each point of the curves, in their order [mag].
    """

    tumbler: Tumbler
    estimates: ShapeEstimates
    errors: ShapeEstimates
    epoch: float
    noise: float
    chi_square: float
    reduced_chi_square: float
    degrees_of_freedom: int
    correlation: float
    follows: bool
    is_noise_found: bool
    is_at_limit: bool
    open_share: float
    residuals: Float[np.ndarray, " epochs"] = dataclasses.field(repr=False)

    def report(self) -> str:
        """The fit in words."""
        return _report(self)


def fit_shape(
    curves: Sequence[LightCurve],
    tumbler: Tumbler,
    noise: float | None = None,
    *,
    epoch: float,
    degree: int = 4,
    facets: int = 2048,
    scattering: Mixture | None = None,
    fitted: Sequence[str] = (),
    albedo: bool = False,
    closure: float = 0.01,
) -> ShapeFit:
    """Fit a convex shape, the albedo and the scattering of a tumbler to light curves.

    `find_tumblers` tells tumblers apart as ellipsoids. This takes one of its aliases,
    or a solution that is published, and fits its motion, its moments of inertia and a
    convex surface at once. To compare aliases, fit each one with the same stated noise
    and compare the values of `chi_square`; with a noise that each fit finds for itself,
    compare `noise`. The moments are sought apart from the shape.

    Args:
        curves: Light curves, corrected for the light time.
        tumbler: Where the fit starts. It is a short-axis or long-axis mode, and its
            periods count the turns within the curves rightly. Its moments must be near:
            far ones may end in another minimum. The shape starts as its ellipsoid;
            facets are replaced by an ellipsoid with the tumbler's moments.
        noise: Standard deviation of a point [mag]. None: the `errors` of the curves if
            all have them. Else it is what the fit leaves, and a misfit cannot be seen.
        epoch: Julian date of time 0 of the tumbler, as `Inversion.epoch`.
        degree: Largest degree of the harmonics of the areas.
        facets: Number of facets, rounded up to an even one. The search uses 512 of them
            at most, the result has all. With too few the stated errors are too small.
        scattering: The law, or where its fit starts; `Mixture()` where it is None.
        fitted: Names of parameters of `scattering` that are fitted: "lambert",
            "amplitude", "width", "slope". All but the first need curves that are not
            relative.
        albedo: Whether the albedo varies as an exponential along one direction, which
            is what closure can determine.
        closure: Standard deviation of the sum of the areas as vectors, over their sum
            as numbers.

    Returns:
        The fit.

    Raises:
        ValueError: Curves or options from which nothing follows, periods that no motion
            has, or a steady rotation, for which there is `find_spin`.

    Source: the shape of M. Kaasalainen, J. Torppa and K. Muinonen, Icarus 153 (2001)
    37; the motion of M. Kaasalainen, Astron. Astrophys. 376 (2001) 302.

    >>> import jax.numpy as jnp, numpy as np, jrigid as jr
    >>> shape = jr.photometry.Ellipsoid(jnp.array([1.0, 0.6, 0.5]))
    >>> hour = 3600.0
    >>> body = jr.photometry.Tumbler(
    ...     shape.moments, 5 * hour, 25 * hour, 1.0, 0.5, 0.0, 0.0, shape)
    >>> ts = np.linspace(0.0, 100 * hour, 200)
    >>> angle = ts / 4e5
    >>> sun = np.stack([np.cos(angle), np.sin(angle), 0.2 + 0 * ts], axis=1)
    >>> earth = np.stack([np.sin(angle), np.cos(angle), 0.1 + 0 * ts], axis=1)
    >>> noise = 0.01 * np.random.default_rng(0).normal(size=200)
    >>> light = np.asarray(body.light_curve(ts, sun, earth)) * 10 ** (-0.4 * noise)
    >>> curve = jr.photometry.LightCurve(0.0, ts, light, sun, earth, is_relative=True)
    >>> found = jr.photometry.fit_shape(
    ...     [curve], body, 0.01, epoch=0.0, degree=3, facets=64)
    >>> # found.estimates and found.errors are ShapeEstimates
    >>> print((found.estimates.rotation_period / hour).round(1))
    25.0
    """
    law = Mixture() if scattering is None else scattering
    demand(
        tumbler.mode != "principal-axis",
        "Argument `tumbler` must be in a short-axis or a long-axis mode, but it is in "
        "principal-axis rotation: use `find_spin`.",
    )
    check_curves(curves, noise, fitted)
    check_options(degree, facets, law, fitted, closure)
    options = (law, tuple(fitted), albedo, closure)
    surface = surface_of(_SOUGHT, degree, facets, *options)
    searched = surface_of(_SOUGHT, degree, min(facets, SEARCHED_FACETS), *options)
    known = stated_noise(curves, noise)
    readings, middle = readings_of(curves, FIRST_NOISE if known is None else known)
    free = freedom(readings, surface)
    later = (middle - epoch) * _DAY
    task = _task(tumbler)
    start = _start(tumbler, surface, later, float(readings.span))
    vector, _ = _minimum(start, task, searched, readings)
    # The numbers have found each other, so that the tightest link is enough.
    vector, quadratic = _minimum(vector, task, surface, readings, _LINKS[-1:])
    if known is None:
        residuals = np.asarray(_residuals(vector, task, surface, readings))
        found = FIRST_NOISE * np.sqrt(np.sum(np.square(residuals)) / free)
        # Closure and expectations are weighed against the noise, so that the minimum
        # moves with it.
        readings, _ = readings_of(curves, float(found))
        vector, quadratic = _minimum(vector, task, surface, readings)
    stated = known is not None
    return _fit(vector, quadratic, task, surface, readings, middle, curves, stated)


def _task(tumbler: Tumbler) -> Task:
    """Interpretation of the motion's numbers: the momentum is near the x axis."""
    pole = direction_of_pole(
        np.asarray(tumbler.longitude), np.asarray(tumbler.latitude)
    )
    return Task(
        frame=frame_of_pole(pole),
        mode=np.asarray(int(MODES[tumbler.mode])),
        homogeneous=np.asarray(False),
        link=np.asarray(_LINKS[-1]),
    )


def _start(
    tumbler: Tumbler, surface: Surface, later: float, span: float
) -> Float[np.ndarray, " numbers"]:
    """Numbers of a tumbler.

    Args:
        tumbler: The tumbler.
        surface: What is fitted.
        later: Time 0 of the fit, by the time of the tumbler [s].
        span: Time from the first epoch to the last [s].
    """
    moments = np.asarray(tumbler.moments)
    # Semi-axes of the homogeneous ellipsoid with these moments.
    of_moments = np.sqrt(np.maximum(moments.sum() / 2 - moments, 0.0))
    periods = np.stack([tumbler.precession_period, tumbler.rotation_period])
    phases = np.stack([tumbler.precession_angle / (2 * np.pi), tumbler.rotation_phase])
    tilt = tumbling(moments, tumbler.state.omega).tilt_max
    demand(
        bool(np.isfinite(tilt)),
        "Argument `tumbler` must have periods of a motion of its mode with its "
        "moments, but there is none: see `omega_from_periods`.",
    )
    motion = Numbers(
        cycles=span / periods,
        angles=2 * np.pi * (phases + later / periods),
        # The frame has the momentum on its x axis.
        pole=np.zeros(2),
        log_tangent=np.log(np.tan(np.asarray(tilt)))[None],
        shape=np.zeros(2),
        inertia=logits_of(of_moments[1:] / of_moments[:-1]),
    )
    vector = surface.centre.copy()
    vector[: surface.motion] = np.concatenate(motion)
    shape = tumbler.shape
    axes = np.asarray(shape.semi_axes) if isinstance(shape, Ellipsoid) else of_moments
    vector[-surface.harmonics.shape[1] :] = ellipsoid_harmonics(surface, axes)
    return vector


def _moved(motion: Float[Array, "11"], task: Task, readings: Readings) -> Placed:
    """Directions from a tumbler to Sun and observer, and the gap of its periods."""
    numbers = unpacked(motion)
    geometry = geometry_of(numbers, task)
    of_time = functools.partial(directions_of_axes, geometry, task.mode)
    axes = jax.vmap(of_time)(readings.ts / readings.span)
    body = product("eij,jk->eik", axes, geometry.to_momentum)
    lines = jnp.stack([readings.to_sun, readings.to_observer], axis=1)
    gap = task.link * gap_of_periods(numbers, geometry.motion, task)
    return Placed(jnp.einsum("eij,esj->esi", body, lines), gap[None])


def _motion_of(task: Task, readings: Readings) -> Motion:
    """The motion of a task as `convex_rows` takes it."""
    return functools.partial(_moved, task=task, readings=readings)


def _quadratic(
    vector: Float[Array, " numbers"], task: Task, surface: Surface, readings: Readings
) -> Quadratic:
    """`convex_quadratic` of a tumbler."""
    return convex_quadratic(vector, _motion_of(task, readings), surface, readings)


@jax.jit
def _residuals(
    vector: Float[Array, " numbers"], task: Task, surface: Surface, readings: Readings
) -> Float[Array, " epochs"]:
    """Readings less the model, over the noise."""
    # The compiler leaves out the derivatives, which nobody takes. The last row is no
    # epoch, but the equation between the periods.
    rows = convex_rows(vector, _motion_of(task, readings), surface, readings)
    return rows.residuals[:-1]


def _minimum(
    start: np.ndarray,
    task: Task,
    surface: Surface,
    readings: Readings,
    links: Sequence[float] = _LINKS,
) -> tuple[np.ndarray, Quadratic]:
    """The numbers of least chi-square near a start, and chi-square about them."""
    lane = jax.tree.map(lambda x: x[None], task)
    numbers = start[None]
    quadratic = None
    for link in links:
        linked = lane._replace(link=np.asarray([link]))
        numbers, quadratic = minimised(
            _quadratic, numbers, linked, (surface, readings), _STEPS
        )
    return jax.tree.map(lambda x: np.asarray(x)[0], (numbers, quadratic))


def _fit(
    vector: np.ndarray,
    quadratic: Quadratic,
    task: Task,
    surface: Surface,
    readings: Readings,
    middle: float,
    curves: Sequence[LightCurve],
    stated: bool,
) -> ShapeFit:
    """Result of the fit: the tumbler, its estimates, errors and statistics."""
    free = freedom(readings, surface)
    residuals = np.asarray(_residuals(vector, task, surface, readings))
    reduced = float(np.sum(np.square(residuals))) / free
    of_points = readings.in_magnitudes(residuals)
    correlation, is_followed = follows(of_points, curves, reduced, free, stated)
    covariance = covariance_of(quadratic.normal, surface.sought)
    covariance = max(reduced, 1.0) * covariance
    estimates, slopes = _estimates_and_slopes(vector, task, surface, readings)
    numbers = unpacked_convex(jnp.asarray(vector), surface.motion)
    return ShapeFit(
        tumbler=_tumbler(vector, task, surface, estimates),
        estimates=jax.tree.map(np.asarray, estimates),
        errors=errors_of(slopes, covariance),
        epoch=middle,
        noise=readings.typical_noise(),
        chi_square=float(quadratic.chi_square),
        reduced_chi_square=reduced,
        degrees_of_freedom=free,
        correlation=correlation,
        follows=is_followed,
        is_noise_found=not stated,
        is_at_limit=_is_at_limit(np.asarray(numbers.motion)),
        open_share=float(np.linalg.norm(openness(numbers.shape, surface))),
        residuals=of_points,
    )


def _is_at_limit(motion: Float[np.ndarray, " 11"]) -> bool:
    """Whether the ellipsoid of the moments is flat, or round about an axis."""
    # The logistic function, without an exponential that overflows.
    ratios = (1 + np.tanh(unpacked(motion).inertia / 2)) / 2
    return bool(np.any((ratios < _AT_LIMIT) | (ratios > 1 - _AT_LIMIT)))


@jax.jit
def _estimates_and_slopes(
    vector: Array, task: Task, surface: Surface, readings: Readings
) -> tuple[ShapeEstimates, ShapeEstimates]:
    """Estimates and their derivatives in the numbers."""

    def estimates(vector: Array) -> ShapeEstimates:
        numbers = unpacked_convex(vector, surface.motion)
        quoted = estimates_at(numbers.motion, task, readings.span)
        law = law_of(numbers.scattering)
        return ShapeEstimates(
            precession_period=quoted.precession_period,
            rotation_period=quoted.rotation_period,
            longitude=quoted.longitude,
            latitude=quoted.latitude,
            energy_ratio=quoted.energy_ratio,
            moments=quoted.moments,
            scattering=jnp.stack([law.lambert, law.amplitude, law.width, law.slope]),
            albedo=numbers.albedo,
        )

    return estimates(vector), jax.jacfwd(estimates)(vector)


def _tumbler(
    vector: np.ndarray, task: Task, surface: Surface, estimates: ShapeEstimates
) -> Tumbler:
    """The body in space axes."""
    numbers = unpacked_convex(jnp.asarray(vector), surface.motion)
    return dataclasses.replace(
        tumbler_of(np.asarray(numbers.motion), task, estimates),
        shape=facets_of(jnp.asarray(vector), surface),
        scattering=law_of(numbers.scattering),
    )


def _report(fit: ShapeFit) -> str:
    """The fit in words."""
    x, error = fit.estimates, fit.errors
    moments = ", ".join(
        f"{name} {value:.3f} +- {spread:.3f}"
        for name, value, spread in zip(
            ("I1/I3", "I2/I3"), x.moments, error.moments, strict=True
        )
    )
    warnings = []
    if not fit.follows:
        warnings.append(
            "The fit does not follow the light curves to their noise, and residuals "
            f"at neighbouring points correlate by {fit.correlation:.2f}: its periods, "
            "the epoch or the moments of the start are wrong, a stated noise is too "
            "small, or the body is far from convex. The errors mean nothing."
        )
    if fit.is_at_limit:
        warnings.append(
            "The moments are those of a flat body, or of one that is round about an "
            "axis: the fit may have gone astray. Start from other moments."
        )
    return "\n".join(
        [
            *warnings,
            f"{fit.tumbler.mode} mode of a convex body: chi-square over "
            f"{fit.degrees_of_freedom} degrees of freedom is "
            f"{fit.reduced_chi_square:.2f} for a noise of "
            f"{noise_in_words(fit.noise, fit.is_noise_found)}",
            f"   P_phi {in_hours(x.precession_period, error.precession_period)}, P_psi "
            f"{in_hours(x.rotation_period, error.rotation_period)}",
            "   angular momentum towards longitude "
            f"{in_degrees(x.longitude, error.longitude)}, latitude "
            f"{in_degrees(x.latitude, error.latitude)}",
            f"   E/E0 {x.energy_ratio:.4f} +- {error.energy_ratio:.4f}, {moments}",
            *of_surface(x, error, fit.open_share, fit.tumbler.shape),
        ]
    )
