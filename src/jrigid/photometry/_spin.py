"""Inversion of light curves to the spin and the convex shape of a steady rotator."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._checks import check_option, demand, whole_number
from jrigid._core.host_rows import rows_of
from jrigid._numerics import product
from jrigid._types import AnyArray, Matrix
from jrigid.mass import from_mesh
from jrigid.photometry._alias import covariance_of, errors_of
from jrigid.photometry._convex import (
    SCATTERING,
    SPIN,
    Surface,
    facets_of,
    law_of,
    openness,
    spin_rows,
    surface_of,
    unpacked_convex,
)
from jrigid.photometry._curve_readings import (
    Readings,
    check_list,
    check_threshold,
    follows,
    noise_in_words,
    phase_angles,
    readings_of,
    stated_noise,
)
from jrigid.photometry._damit_files import LightCurve
from jrigid.photometry._ellipsoid import Ellipsoid
from jrigid.photometry._facets import Facets
from jrigid.photometry._inversion import in_degrees, in_hours
from jrigid.photometry._model import axes_of_momentum
from jrigid.photometry._periodogram import check_span
from jrigid.photometry._polyhedron import MOST_OPEN, mesh_from_facets
from jrigid.photometry._scattering import Mixture
from jrigid.photometry._spin_search import (
    COARSE_DEGREE,
    COARSE_FACETS,
    REFINED,
    SEARCHED_FACETS,
    STRIDE,
    Spins,
    best,
    minima_about,
    search_spins,
    settled,
)
from jrigid.photometry._tumbler import Tumbler

# Noise of the search where none is given [mag]; what the best solution leaves replaces
# it.
FIRST_NOISE = 0.02
_MOST_PERIODS = 50_000
_MOST_DEGREE = 12
# A mirror has the other longitude by half a turn, but for what the inclination of the
# orbit tells.
_NEAR_MIRROR = 0.6
_SAME_TURNS = 0.3
_FULL = (
    "The table is full, so that other rotations may explain the curves, too. Search a "
    "part of the range of periods at a time."
)
# Phase angles that differ by less [rad] say nothing of the phase function.
_LEAST_ANGLES = float(np.radians(1.0))
# Within a curve the phase function is nearly constant, as is the factor that a relative
# curve leaves open.
_NEEDS_SCALE = ("amplitude", "width", "slope")


class SpinEstimates(NamedTuple):
    """Quantities that observers quote of a steady rotation, or their errors.

    Attributes:
        period: Sidereal period of rotation [s].
        longitude: Of the pole, space axes [rad].
        latitude: Of the pole [rad].
        scattering: `lambert`, `amplitude`, `width` and `slope` of the `Mixture`; an
            error of 0 where they are given.
        albedo: Slope of the logarithm of the albedo along the body axes.
    """

    period: Float[AnyArray, ""]
    longitude: Float[AnyArray, ""]
    latitude: Float[AnyArray, ""]
    scattering: Float[AnyArray, "4"]
    albedo: Float[AnyArray, "3"]


@dataclasses.dataclass(frozen=True)
class Spin:
    """One steady rotation of a convex body that explains light curves.

    Attributes:
        body: The body, in the mode "principal-axis", with its facets and its scattering
            law. The sum of the areas is that of a unit sphere. The moments of inertia
            are not known and have no effect: they are given as equal.
        estimates: Its period, pole and scattering.
        errors: Their standard errors: root mean square distances from this minimum of
            chi-square in a mixture of normal distributions, one about each minimum that
            was found within a quarter of a radian. They know nothing of other poles.
            They hold if the errors of the points are independent and the surface is as
            assumed, and are enlarged where chi-square is too large.
        chi_square: Sum of squares of the residuals over the noise, and of what the
            areas and the numbers deviate from what is expected, over its spread.
        open_share: Length of the sum of the areas as vectors, over their sum: 0 for a
            closed surface. Above about .01 the albedo is not uniform, or the body is
            far from convex.
        residuals: Of each point of the curves, in their order [mag].
    """

    body: Tumbler
    estimates: SpinEstimates
    errors: SpinEstimates
    chi_square: float
    open_share: float
    residuals: Float[np.ndarray, " epochs"] = dataclasses.field(repr=False)


@dataclasses.dataclass(frozen=True)
class SpinInversion:
    """Steady rotations that explain light curves, the best first.

    Attributes:
        solutions: Those whose chi-square is near the least one.
        rejected: The best of the others.
        mirror: The solution with the pole's longitude larger by half a turn. Curves
            from the plane of the ecliptic do not tell it from the first solution. None
            if a fit that starts there goes elsewhere.
        epoch: Julian date of time 0 of the bodies.
        noise: Standard deviation of a point [mag], stated or found; the median if they
            differ.
        reduced_chi_square: Chi-square of the light over its degrees of freedom.
        degrees_of_freedom: Points less unknown numbers.
        correlation: Of the best solution's residuals at neighbouring points of a curve.
            It is near 0 for noise, and near 1 for a light curve that is missed.
        follows: Whether the best solution follows the curves to their noise, as far as
            it is known. If it is not stated, or stated too large, its residuals need
            only be uncorrelated.
        is_noise_found: Whether the noise was not stated: it is what the fit leaves, and
            holds what the model misses.
    """

    solutions: list[Spin]
    rejected: list[Spin]
    mirror: Spin | None
    epoch: float
    noise: float
    reduced_chi_square: float
    degrees_of_freedom: int
    correlation: float
    follows: bool
    is_noise_found: bool

    def report(self) -> str:
        """The table in words."""
        return _report(self)


def find_spin(
    curves: Sequence[LightCurve],
    noise: float | None = None,
    *,
    shortest: float,
    longest: float,
    degree: int = 6,
    facets: int = 2048,
    scattering: Mixture | None = None,
    fitted: Sequence[str] = (),
    albedo: bool = False,
    closure: float = 0.01,
    threshold: float = 25.0,
) -> SpinInversion:
    """Find the period, the pole and the convex shape of a body that rotates steadily.

    The normals of the facets are fixed, and the logarithms of their areas are sums of
    spherical harmonics. Each trial period is combined with poles all over the sky; a
    coarse body sorts them, and Levenberg-Marquardt refines the best ones. The mirror
    image of the best one is always refined too. Curves may be relative: their factors
    are taken out exactly.

    The body rotates about its z axis. Whether that is the axis of its largest moment
    is not imposed.

    Args:
        curves: Light curves, corrected for the light time.
        noise: Standard deviation of a point [mag]. None: the `errors` of the curves if
            all have them. Else it is what the best solution leaves, and a misfit cannot
            be seen.
        shortest: Shortest sidereal period [s].
        longest: Longest sidereal period [s]. The cost grows with the number of periods,
            2.5 times the span of the curves over `shortest` less that over `longest`.
        degree: Largest degree of the harmonics.
        facets: Number of facets, rounded up to an even one. The search uses 512 of them
            at most, the solutions have all. With too few the stated errors are too
            small.
        scattering: The law, or where its fit starts; `Mixture()` where it is None.
        fitted: Names of parameters of `scattering` that are fitted: "lambert",
            "amplitude", "width", "slope". All but the first need curves that are not
            relative.
        albedo: Whether the albedo varies as an exponential along one direction, which
            is what closure can determine.
        closure: Standard deviation of the sum of the areas as vectors, over their sum
            as numbers.
        threshold: Growth of chi-square up to which a solution is in the table, in units
            of the reduced chi-square where that is above 1.

    Returns:
        The solutions.

    Raises:
        ValueError: Curves or options from which nothing follows.

    Source: M. Kaasalainen and J. Torppa, Icarus 153 (2001) 24; M. Kaasalainen, J.
    Torppa and K. Muinonen, Icarus 153 (2001) 37.

    >>> import jax.numpy as jnp, numpy as np, jrigid as jr
    >>> shape = jr.photometry.Ellipsoid(jnp.array([1.5, 1.0, 0.8]))
    >>> hour = 3600.0
    >>> body = jr.photometry.Tumbler(
    ...     shape.moments, 6 * hour, 1.0, 1.0, 0.5, 0.0, 0.0, shape,
    ...     mode="principal-axis")
    >>> ts = np.linspace(0.0, 400 * hour, 120)
    >>> angle = ts / 4e5
    >>> seen = angle + 0.4 * np.cos(angle)
    >>> sun = np.stack([np.cos(angle), np.sin(angle), 0.1 + 0 * ts], axis=1)
    >>> earth = np.stack([np.cos(seen), np.sin(seen), 0.1 + 0 * ts], axis=1)
    >>> noise = 0.01 * np.random.default_rng(0).normal(size=120)
    >>> light = np.asarray(body.light_curve(ts, sun, earth)) * 10 ** (-0.4 * noise)
    >>> curve = jr.photometry.LightCurve(0.0, ts, light, sun, earth, is_relative=True)
    >>> found = jr.photometry.find_spin(
    ...     [curve], 0.01, shortest=5.9 * hour, longest=6.1 * hour, degree=3,
    ...     facets=128)
    >>> best = found.solutions[0]  # a Spin with its body and its SpinEstimates
    >>> print((best.estimates.period / hour).round(2))
    6.0
    """
    law = Mixture() if scattering is None else scattering
    check_curves(curves, noise, fitted)
    check_options(degree, facets, law, fitted, closure)
    check_threshold(threshold)
    known = stated_noise(curves, noise)
    readings, epoch = readings_of(curves, FIRST_NOISE if known is None else known)
    turns = _turns(float(readings.span), shortest, longest)
    make = functools.partial(
        surface_of,
        np.ones(SPIN, bool),
        scattering=law,
        fitted=tuple(fitted),
        albedo=albedo,
        closure=closure,
    )
    surface = make(degree=degree, facets=facets)
    searched = make(degree=degree, facets=min(facets, SEARCHED_FACETS))
    coarse = make(degree=min(degree, COARSE_DEGREE), facets=min(facets, COARSE_FACETS))
    # This refuses curves with too few points before the search.
    free = freedom(readings, surface)
    spins = search_spins(readings, surface, searched, coarse, *turns)
    if known is None:
        square = np.sum(_left(spins, surface, readings) ** 2)
        noise_found = FIRST_NOISE * np.sqrt(square / free)
        # Closure and expectations are weighed against the noise, so that the minimum
        # moves with it.
        readings, epoch = readings_of(curves, float(noise_found))
        spins = settled(spins, surface, readings)
    return _inversion(
        spins, surface, readings, epoch, curves, known is not None, threshold
    )


def check_curves(
    curves: Sequence[LightCurve], noise: float | None, fitted: Sequence[str]
) -> None:
    """Raise ValueError for curves that do not determine what is fitted."""
    check_list(curves)
    demand(
        len(curves) > 0, "Argument `curves` must hold a light curve, but it is empty."
    )
    demand(
        noise is None or (np.ndim(noise) == 0 and noise > 0),
        f"Argument `noise` must be a positive number or None, but it is {noise}: "
        "errors of points are those of a `LightCurve`.",
    )
    for name in fitted:
        check_option("fitted", name, SCATTERING)
    # Relative curves say nothing of the phase function, nor do calibrated ones that
    # were all taken at one phase angle.
    angles = [phase_angles(x) for x in curves if not x.is_relative]
    known = float(np.ptp(np.concatenate(angles))) if angles else 0.0
    demand(
        known > _LEAST_ANGLES or not set(fitted) & set(_NEEDS_SCALE),
        "Argument `fitted` must be empty or `lambert` for curves that are relative, or "
        f"whose phase angles differ by {np.degrees(known):.1f} degrees, but it is "
        f"{tuple(fitted)}: they say nothing of the phase function.",
    )


def check_options(
    degree: int, facets: int, law: Mixture, fitted: Sequence[str], closure: float
) -> None:
    """Raise ValueError for options from which nothing follows."""
    whole_number("degree", degree, least=2)
    demand(
        degree <= _MOST_DEGREE,
        f"Argument `degree` must be at most {_MOST_DEGREE}, but it is {degree}.",
    )
    whole_number("facets", facets, least=2 * (degree + 1) ** 2)
    demand(closure > 0, f"Argument `closure` must be positive, but it is {closure}.")
    for name in ("lambert", "width"):
        value = float(getattr(law, name))
        # A parameter is sought by its logarithm, but a given weight may be 0.
        may_be_zero = name == "lambert" and name not in fitted
        demand(
            value > 0 or (may_be_zero and value == 0),
            f"Argument `scattering` must have a positive `{name}`, but it is {value}.",
        )


def _turns(span: float, shortest: float, longest: float) -> tuple[float, float]:
    """Fewest and most turns within the span."""
    demand(
        0 < shortest <= longest,
        "Arguments `shortest` and `longest` must be periods in seconds in rising "
        f"order, but they are {shortest} and {longest}.",
    )
    check_span(span, shortest)
    turns = span / longest, span / shortest
    count = (turns[1] - turns[0]) / STRIDE
    demand(
        count < _MOST_PERIODS,
        f"Arguments `shortest` and `longest` hold {count:.0f} trial periods, more than "
        f"{_MOST_PERIODS}: narrow the range, or fit a part of the curves first.",
    )
    return turns


def freedom(readings: Readings, surface: Surface) -> int:
    """Points less unknown factors and numbers."""
    points = int(np.count_nonzero(readings.weights))
    unknown = readings.factor_count() + int(np.count_nonzero(surface.sought))
    demand(
        points > unknown,
        f"Argument `curves` must hold more points than there are unknown numbers, but "
        f"it holds {points} for {unknown}: take a smaller `degree`.",
    )
    return points - unknown


@jax.jit
def _residuals(
    vector: Float[Array, " numbers"],
    frame: Matrix,
    surface: Surface,
    readings: Readings,
) -> Float[Array, " rows"]:
    """Readings less the model, over the noise."""
    # The compiler leaves out the derivatives, which nobody takes.
    return spin_rows(vector, frame, surface, readings).residuals


def _left(
    spins: Spins, surface: Surface, readings: Readings
) -> Float[np.ndarray, " epochs"]:
    """Residuals of the best solution, over the noise."""
    best = _residuals(spins.numbers[0], spins.frames[0], surface, readings)
    return np.asarray(best)


def _inversion(
    spins: Spins,
    surface: Surface,
    readings: Readings,
    epoch: float,
    curves: Sequence[LightCurve],
    stated: bool,
    threshold: float,
) -> SpinInversion:
    """The table of what a search found."""
    free = freedom(readings, surface)
    left = _left(spins, surface, readings)
    reduced = float(np.sum(left**2)) / free
    correlation, is_followed = follows(
        readings.in_magnitudes(left), curves, reduced, free, stated
    )
    scale = max(reduced, 1.0)
    unlike = best(spins, len(spins.numbers))
    every = []
    for group in minima_about(spins, unlike):
        minima = [
            _spin(rows_of(spins, [k]), surface, readings, scale) for k in group.tolist()
        ]
        every.append(_with_spread(minima, scale))
    growth = (unlike.quadratic.chi_square - unlike.quadratic.chi_square[0]) / scale
    near = int(np.count_nonzero(growth <= threshold))
    mirror = _index_of_mirror(unlike)
    return SpinInversion(
        solutions=every[:near],
        rejected=every[near:],
        mirror=None if mirror is None else every[mirror],
        epoch=epoch,
        noise=readings.typical_noise(),
        reduced_chi_square=reduced,
        degrees_of_freedom=free,
        correlation=correlation,
        follows=is_followed,
        is_noise_found=not stated,
    )


def _with_spread(minima: list[Spin], scale: float) -> Spin:
    """The best of the minima about a pole, with errors that hold the others.

    They are root mean square distances from it in a mixture of normal distributions,
    one about each minimum.
    """
    lowest = min(minima, key=lambda spin: spin.chi_square)
    growth = np.array([(x.chi_square - lowest.chi_square) / scale for x in minima])
    weights = np.exp(-growth / 2)
    weights = weights / np.sum(weights)

    def error(name: str) -> np.ndarray:
        moves = [
            getattr(x.estimates, name) - getattr(lowest.estimates, name) for x in minima
        ]
        if name == "longitude":
            moves = [np.mod(x + np.pi, 2 * np.pi) - np.pi for x in moves]
        squares = [
            getattr(x.errors, name) ** 2 + move**2
            for x, move in zip(minima, moves, strict=True)
        ]
        return np.asarray(np.sqrt(np.tensordot(weights, np.stack(squares), 1)))

    errors = SpinEstimates(*map(error, SpinEstimates._fields))
    return dataclasses.replace(lowest, errors=errors)


def _index_of_mirror(spins: Spins) -> int | None:
    """Index of the solution that is the mirror of the first one, or None."""
    poles = spins.poles()
    # Half a turn about the third axis of space.
    apart = np.linalg.norm(poles - poles[0] * [-1.0, -1.0, 1.0], axis=1)
    turns = np.abs(spins.numbers[:, 0] - spins.numbers[0, 0])
    near = np.flatnonzero((apart < _NEAR_MIRROR) & (turns < _SAME_TURNS))
    near = near[near > 0]
    return int(near[np.argmin(apart[near])]) if len(near) else None


def _spin(one: Spins, surface: Surface, readings: Readings, scale: float) -> Spin:
    """One row of the table."""
    vector = one.numbers[0]
    frame = one.frames[0]
    covariance = scale * covariance_of(one.quadratic.normal[0], surface.sought)
    span = np.asarray(readings.span)
    estimates, slopes = _estimates_and_slopes(vector, frame, span)
    residuals = np.asarray(_residuals(vector, frame, surface, readings))
    shape = unpacked_convex(jnp.asarray(vector), SPIN).shape
    return Spin(
        body=_body(vector, frame, surface, estimates),
        estimates=jax.tree.map(np.asarray, estimates),
        errors=errors_of(slopes, covariance),
        chi_square=float(one.quadratic.chi_square[0]),
        open_share=float(np.linalg.norm(openness(shape, surface))),
        residuals=readings.in_magnitudes(residuals),
    )


@jax.jit
def _estimates_and_slopes(
    vector: Array, frame: Array, span: Array
) -> tuple[SpinEstimates, SpinEstimates]:
    """Estimates and their derivatives in the numbers."""
    estimates = functools.partial(_estimates, frame=frame, span=span)
    return estimates(vector), jax.jacfwd(estimates)(vector)


def _estimates(vector: Array, frame: Matrix, span: Array) -> SpinEstimates:
    """Quantities that observers quote, from the vector of numbers."""
    numbers = unpacked_convex(vector, SPIN)
    pole = product("ij,i->j", frame, axes_of_momentum(numbers.motion[1:])[2])
    law = law_of(numbers.scattering)
    return SpinEstimates(
        period=span / numbers.motion[0],
        longitude=jnp.arctan2(pole[1], pole[0]) % (2 * jnp.pi),
        latitude=jnp.arcsin(jnp.clip(pole[2], -1.0, 1.0)),
        scattering=jnp.stack([law.lambert, law.amplitude, law.width, law.slope]),
        albedo=numbers.albedo,
    )


def _body(
    vector: np.ndarray, frame: np.ndarray, surface: Surface, estimates: SpinEstimates
) -> Tumbler:
    """The body in space axes."""
    numbers = unpacked_convex(jnp.asarray(vector), SPIN)
    axes = product(
        "ij,jk->ik", axes_of_momentum(numbers.motion[1:]), jnp.asarray(frame)
    )
    pole = jnp.stack([estimates.longitude, estimates.latitude])
    # The angle of rotation counts from the axis that points south of the pole.
    south = product("ij,kj->ik", axes, axes_of_momentum(pole))[0]
    return Tumbler(
        moments=jnp.ones(3, axes.dtype),
        precession_period=estimates.period,
        # It has no meaning in this mode.
        rotation_period=estimates.period,
        longitude=estimates.longitude,
        latitude=estimates.latitude,
        precession_angle=jnp.arctan2(south[1], south[0]),
        rotation_phase=0.0,
        shape=facets_of(jnp.asarray(vector), surface),
        scattering=law_of(numbers.scattering),
        mode="principal-axis",
    )


def _report(found: SpinInversion) -> str:
    """The table in words."""
    lines = [_verdict(found)]
    for rank, spin in enumerate(found.solutions, 1):
        lines += ["", *_described(f"{rank}.", spin)]
    lines += ["", _of_mirror(found)]
    others = [x for x in found.rejected if x is not found.mirror]
    if others:
        grown = others[0].chi_square - found.solutions[0].chi_square
        lines.append(
            "The best one of all others that the search kept has a chi-square that is "
            f"larger by {grown:.0f}."
        )
    elif len(found.solutions) >= REFINED:
        lines.append(_FULL)
    lines.append(
        "Errors assume that those of the points are independent and that the body is "
        "convex; the errors of poles in use are often several times larger."
    )
    return "\n".join(lines)


def _verdict(found: SpinInversion) -> str:
    """A sentence that sums up the table."""
    count = len(found.solutions)
    value = (
        f"chi-square over {found.degrees_of_freedom} degrees of freedom is "
        f"{found.reduced_chi_square:.2f} for a noise of "
        f"{noise_in_words(found.noise, found.is_noise_found)}"
    )
    if not found.follows:
        return (
            "No steady rotation was found that follows the light curves to their "
            f"noise: {value}, and residuals at neighbouring points correlate by "
            f"{found.correlation:.2f}. The body tumbles or is far from convex, its "
            "period is out of the range, `scattering` is another law, `degree` or "
            "`facets` are too few, or a stated noise is too small."
        )
    if count == 1:
        return f"One steady rotation explains the light curves: {value}."
    return (
        f"{count} steady rotations explain the light curves, which do not say which "
        f"one is true: {value}."
    )


def _of_mirror(found: SpinInversion) -> str:
    """A sentence about the mirror solution."""
    mirror = found.mirror
    if mirror is None:
        return "The mirror solution, with the pole's other longitude, is no minimum."
    for rank, spin in enumerate(found.solutions, 1):
        if spin is mirror:
            return (
                f"Solution {rank} is the mirror of 1, with the pole's other longitude: "
                "curves from near the plane of the ecliptic hardly tell them apart."
            )
    grown = mirror.chi_square - found.solutions[0].chi_square
    pole = in_degrees(mirror.estimates.longitude, mirror.errors.longitude)
    latitude = in_degrees(mirror.estimates.latitude, mirror.errors.latitude)
    return (
        f"The mirror of 1, with its pole at longitude {pole}, latitude {latitude}, has "
        f"a chi-square that is larger by {grown:.0f}."
    )


def _described(head: str, spin: Spin) -> list[str]:
    """One solution in words."""
    x = spin.estimates
    error = spin.errors
    return [
        f"{head} period {in_hours(x.period, error.period)}, chi-square "
        f"{spin.chi_square:.1f}",
        f"   pole at longitude {in_degrees(x.longitude, error.longitude)}, latitude "
        f"{in_degrees(x.latitude, error.latitude)}",
        *of_surface(x, error, spin.open_share, spin.body.shape),
    ]


def of_surface(
    x: Any, error: Any, open_share: float, shape: Facets | Ellipsoid
) -> list[str]:
    """Lines of text that describe a surface that was found.

    Args:
        x: Estimates, with `scattering` and `albedo`.
        error: Their standard errors.
        open_share: Length of the sum of the areas as vectors, over their sum.
        shape: The body.
    """
    lines = [f"   the areas fail to close by {100 * open_share:.2g} % of their sum"]
    for name, value, spread in zip(
        SCATTERING, x.scattering, error.scattering, strict=True
    ):
        if spread > 0:
            lines.append(f"   {name} {value:.3f} +- {spread:.3f}")
    if np.any(error.albedo > 0):
        # The logarithm of the albedo runs from minus to plus the length of this slope.
        contrast = np.exp(2 * np.linalg.norm(x.albedo))
        lines.append(f"   albedo varies by a factor of {contrast:.2f}")
    if isinstance(shape, Facets) and open_share < MOST_OPEN:
        lines.append(_of_homogeneous(shape))
    return lines


def _of_homogeneous(facets: Facets) -> str:
    """The inertia of a homogeneous body of a fitted shape, in words."""
    principal = from_mesh(*mesh_from_facets(facets)).principal_axes()
    first, second, third = np.asarray(principal.moments)
    # The motion is about the z axis, or that is its axis of the largest moment.
    angle = np.degrees(np.arccos(min(abs(float(principal.axes[2, 2])), 1.0)))
    return (
        f"   a homogeneous body of this shape has I1/I3 {first / third:.3f}, I2/I3 "
        f"{second / third:.3f}, and its axis of I3 is {angle:.1f} degrees from z"
    )
