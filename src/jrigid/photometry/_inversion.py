"""Inversion of light curves: tumblers that explain them, with errors and weights."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jrigid._checks import check_option, demand, whole_number
from jrigid._types import AnyArray
from jrigid.photometry._alias import (
    MODES,
    Alias,
    alias_of,
    log_evidence,
)
from jrigid.photometry._curve_readings import (
    Readings,
    check_threshold,
    follows,
    noise_in_words,
    readings_of,
    stated_noise,
)
from jrigid.photometry._damit_files import LightCurve
from jrigid.photometry._model import Task, independent
from jrigid.photometry._nights import (
    NightPlan,
    Predictions,
    chosen_nights,
    growths,
    predictions,
)
from jrigid.photometry._periodogram import cycles_within, points_of
from jrigid.photometry._tumbler_search import APART, Found, index_of_mirror, search

_INERTIA = ("homogeneous", "free")
# Noise of the first search where none is given [mag]; the rms residual replaces it.
_FIRST_NOISE = 0.02
_HOUR = 3600.0
# Of the ratio of two axes: the light of such a body hardly changes as it rotates.
_NEARLY_ROUND = 0.02
_ROUND = (
    "   nearly round about this axis, so that the light hardly shows the rotation: "
    "P_psi and E/E0 follow from the moments of the ellipsoid, and other values may be "
    "as good"
)
# A ratio of two axes below which no known asteroid is.
_THIN = 0.1
_IS_THIN = (
    "   an ellipsoid as thin as no known body: the curves are few for its shape, and "
    "the errors mean little"
)
# How many of the solutions that do not count as aliases are kept.
_REJECTED = 5
# An error of an angle [rad] beyond which the angle is not known at all.
_ANY_ANGLE = np.pi
# Digits of a period in hours whose error is not known.
_USUAL_DIGITS = 4


@dataclasses.dataclass(frozen=True)
class Inversion:
    """Tumblers that explain light curves, the best first: an alias table.

    Attributes:
        aliases: The tumblers whose chi-square is near the least one.
        rejected: The best of the others.
        epoch: Julian date of time 0 of the tumblers.
        noise: Standard deviation of a point [mag], stated or found; the median if they
            differ.
        reduced_chi_square: Chi-square of the best alias over its degrees of freedom.
        degrees_of_freedom: Points less unknown numbers.
        correlation: Of the best alias's residuals at neighbouring points of a curve. It
            is near 0 for noise, and near 1 for a light curve that is missed.
        follows: Whether the best alias follows the curves to their noise, as far as it
            is known. If it is not stated, or stated too large, its residuals need only
            be uncorrelated, which says little of curves whose points are far apart in
            time.
        determined: Whether the curves determine the motion: the best alias follows
            them, and all others have its periods and its mode. Their momenta may point
            elsewhere.
        mirror: The best alias mirrored by the plane from which the body was seen, whose
            momentum is elsewhere. It is not among the aliases. None if its chi-square
            is not near the least one.
        span: Time from the first epoch to the last [s].
        is_noise_found: Whether the noise was not stated: it is what the fit leaves, and
            holds what the model misses.
        is_homogeneous: Whether the moments were taken to be those of a homogeneous
            ellipsoid.
    """

    aliases: list[Alias]
    rejected: list[Alias]
    epoch: float
    noise: float
    reduced_chi_square: float
    degrees_of_freedom: int
    correlation: float
    follows: bool
    determined: bool
    span: float
    is_noise_found: bool = False
    is_homogeneous: bool = True
    mirror: Alias | None = None

    def report(self) -> str:
        """The table in words."""
        return report_of(self)

    def separation(
        self, curves: Sequence[LightCurve], noise: float
    ) -> Float[np.ndarray, "curves aliases aliases"]:
        """Power of each of several future light curves to tell aliases apart.

        Args:
            curves: Light curves with the epochs and the geometry that are planned;
                their brightness is not used.
            noise: Standard deviation of a point [mag].

        Returns:
            For each curve and pair of aliases, by how much the chi-square of the wrong
            one grows at least: both may still change within their errors, and are taken
            where they are nearest. Above 25 the curve decides.
        """
        predicted = self._predictions(curves, noise)
        return np.array(
            [growths(predicted, self.aliases, [k]) for k in range(len(curves))]
        )

    def choose_nights(
        self, curves: Sequence[LightCurve], noise: float, threshold: float = 25.0
    ) -> NightPlan:
        """Choose planned light curves that tell all aliases apart together.

        Args:
            curves: Light curves with the epochs and the geometry that are possible;
                their brightness is not used.
            noise: Standard deviation of a point [mag].
            threshold: Growth of chi-square at which a pair is apart.

        Returns:
            The chosen curves. They are few, but another choice may be as short: each
            curve is the best one beside those before it. The mirror is not considered.
        """
        predicted = self._predictions(curves, noise)
        return chosen_nights(predicted, self.aliases, curves, threshold)

    def _predictions(self, curves: Sequence[LightCurve], noise: float) -> Predictions:
        """Predictions of the aliases."""
        return predictions(self.aliases, curves, noise, self.epoch, self.span)


def find_tumblers(
    curves: Sequence[LightCurve],
    noise: float | None = None,
    *,
    shortest: float,
    longest: float,
    modes: Sequence[str] = tuple(MODES),
    inertia: str = "homogeneous",
    pairs: int = 100,
    threshold: float = 25.0,
) -> Inversion:
    """Find the tumbling ellipsoids that explain light curves.

    Gradients do not find periods: chi-square has a minimum for each turn that is
    counted wrongly. So pairs of periods come from a two-dimensional periodogram, a scan
    tries shapes, phases and directions of the angular momentum for each pair and mode,
    and Levenberg-Marquardt refines the best ones. Curves may be relative: their factors
    are taken out exactly.

    Args:
        curves: Light curves, corrected for the light time.
        noise: Standard deviation of a point [mag]. None: the `errors` of the curves if
            all have them. Else it is what the best tumbler leaves, and only a
            correlation of the residuals shows a misfit.
        shortest: Shortest period of precession or rotation [s].
        longest: Longest period [s].
        modes: Kinds of motion to try: "principal-axis", "short-axis", "long-axis".
        inertia: "homogeneous": the moments are those of the ellipsoid. "free": they are
            those of another ellipsoid, sought apart.
        pairs: Pairs of periods that are tried.
        threshold: Growth of chi-square up to which a tumbler is an alias, in units of
            the reduced chi-square where that is above 1.

    Returns:
        The aliases. The shape is an ellipsoid by Lommel-Seeliger's law, of which the
        longest semi-axis is 1. Ellipsoids look alike after half turns about their axes,
        so attitudes that differ by these are given once.

    Raises:
        ValueError: Curves or options from which nothing follows.

    Source: the model of M. Kaasalainen, Astron. Astrophys. 376 (2001) 302, with the
    exact motion in place of an integration.

    >>> import jax.numpy as jnp, numpy as np, jrigid as jr
    >>> shape = jr.photometry.Ellipsoid(jnp.array([1.0, 0.6, 0.5]))
    >>> hour = 3600.0
    >>> body = jr.photometry.Tumbler(
    ...     shape.moments, 6 * hour, 1.0, 1.0, 0.5, 0.0, 0.0, shape,
    ...     mode="principal-axis")
    >>> ts = np.linspace(0.0, 40 * hour, 100)
    >>> angle = ts / 4e5
    >>> sun = np.stack([np.cos(angle), np.sin(angle), 0.2 + 0 * ts], axis=1)
    >>> earth = np.stack([np.sin(angle), np.cos(angle), 0.1 + 0 * ts], axis=1)
    >>> noise = 0.01 * np.random.default_rng(0).normal(size=100)
    >>> light = np.asarray(body.light_curve(ts, sun, earth)) * 10 ** (-0.4 * noise)
    >>> curve = jr.photometry.LightCurve(0.0, ts, light, sun, earth, is_relative=True)
    >>> found = jr.photometry.find_tumblers(
    ...     [curve], 0.01, shortest=4 * hour, longest=20 * hour,
    ...     modes=["principal-axis"], pairs=5)
    >>> best = found.aliases[0]  # an Alias with its Tumbler and its Estimates
    >>> print((best.estimates.precession_period / hour).round(1))
    6.0
    """
    check_option("inertia", inertia, _INERTIA)
    demand(len(modes) > 0, "Argument `modes` must name a motion, but it is empty.")
    for mode in modes:
        check_option("modes", mode, tuple(MODES))
    whole_number("pairs", pairs)
    check_threshold(threshold)
    # Too few points are an error.
    points_of(curves)
    known = stated_noise(curves, noise)
    stated = known is not None
    readings, epoch = readings_of(curves, _FIRST_NOISE if known is None else known)
    lowest, highest = cycles_within(float(readings.span), shortest, longest)
    found = search(
        readings,
        lowest,
        highest,
        [MODES[mode] for mode in modes],
        inertia == "homogeneous",
        pairs,
    )
    width = highest - lowest
    return _inversion(found, readings, epoch, curves, stated, threshold, width)


def _inversion(
    found: Found,
    readings: Readings,
    epoch: float,
    curves: Sequence[LightCurve],
    stated: bool,
    threshold: float,
    width: float,
) -> Inversion:
    """The table of what a search found.

    Args:
        found: What the search found.
        readings: The light curves.
        epoch: Time 0 of the readings.
        curves: The same as they were given.
        stated: Whether the noise is known.
        threshold: Largest growth of chi-square of an alias.
        width: Of the range of frequencies that were searched [cycles].
    """
    tasks = [Task(*fields) for fields in zip(*found.tasks, strict=True)]
    unknown = readings.factor_count() + int(np.count_nonzero(independent(tasks[0])))
    freedom = points_of(curves) - unknown
    demand(
        freedom > 0,
        "Argument `curves` must hold more points than the tumbler has numbers, but it "
        "does not.",
    )
    least = float(found.quadratic.chi_square[0])
    reduced = least / freedom
    # A stated noise may be too small, and the errors grow with the misfit. It is never
    # reduced.
    scale = max(reduced, 1.0) if stated else reduced
    growth = (found.quadratic.chi_square - least) / scale
    near = int(np.count_nonzero(growth <= threshold))
    shown = zip(found.numbers[: near + _REJECTED], tasks, strict=False)
    every = [alias_of(numbers, task, readings, scale) for numbers, task in shown]
    mirror = index_of_mirror(readings, found)
    if mirror is not None and mirror >= near:
        mirror = None
    others = [i for i in range(near) if i != mirror]
    aliases = _weighted([every[i] for i in others], growth[others], width)
    correlation, is_followed = follows(
        every[0].residuals, curves, reduced, freedom, stated
    )
    noise = readings.typical_noise()
    return Inversion(
        aliases=aliases,
        rejected=every[near:],
        epoch=epoch,
        noise=noise if stated else noise * np.sqrt(reduced),
        reduced_chi_square=reduced if stated else 1.0,
        degrees_of_freedom=freedom,
        correlation=correlation,
        follows=is_followed,
        determined=is_followed and all(_is_same_motion(aliases[0], x) for x in aliases),
        span=float(readings.span),
        is_noise_found=not stated,
        is_homogeneous=bool(tasks[0].homogeneous),
        mirror=None if mirror is None else every[mirror],
    )


def _weighted(
    aliases: list[Alias], growth: Float[np.ndarray, " points"], width: float
) -> list[Alias]:
    """Aliases with their posterior weights.

    Args:
        aliases: Those near the least chi-square.
        growth: Of chi-square, of these first.
        width: Of the range of frequencies that were searched [cycles].
    """
    logarithms = np.array(
        [log_evidence(alias, growth[i], width) for i, alias in enumerate(aliases)]
    )
    # Only ratios of weights matter. Without the largest one the exponentials stay in
    # range.
    weights = np.exp(logarithms - logarithms.max())
    return [
        dataclasses.replace(alias, weight=float(weight))
        for alias, weight in zip(aliases, weights / weights.sum(), strict=True)
    ]


def _is_same_motion(one: Alias, other: Alias) -> bool:
    """Whether two aliases have the same periods and mode."""
    apart = np.abs(one.numbers[:2] - other.numbers[:2])
    return bool(np.all(apart < APART)) and one.tumbler.mode == other.tumbler.mode


def report_of(inversion: Inversion) -> str:
    """The table of aliases in words."""
    lines = [_verdict(inversion)]
    for rank, alias in enumerate(inversion.aliases, 1):
        lines += ["", *_described(rank, alias)]
    if inversion.mirror is not None:
        x, error = inversion.mirror.estimates, inversion.mirror.errors
        grown = inversion.mirror.chi_square - inversion.aliases[0].chi_square
        lines += [
            "",
            "The mirror of the first has the same periods and its angular momentum "
            f"towards longitude {in_degrees(x.longitude, error.longitude)}, latitude "
            f"{in_degrees(x.latitude, error.latitude)}. Its chi-square is larger by "
            f"{grown:.1f}: the curves do not tell the two apart.",
        ]
    if inversion.rejected:
        best = inversion.aliases[0].chi_square
        grown = inversion.rejected[0].chi_square - best
        lines += [
            "",
            f"The next tumbler has a chi-square that is larger by {grown:.0f}.",
        ]
    if inversion.is_homogeneous:
        lines += [
            "",
            "Values and errors hold for homogeneous ellipsoids. `inertia='free'` seeks "
            "the moments apart from the shape.",
        ]
    return "\n".join(lines)


def _verdict(inversion: Inversion) -> str:
    """A sentence that sums up the table."""
    count = len(inversion.aliases)
    points = f"chi-square over {inversion.degrees_of_freedom} degrees of freedom"
    value = (
        f"{points} is {inversion.reduced_chi_square:.2f} for a noise of "
        f"{noise_in_words(inversion.noise, inversion.is_noise_found)}"
    )
    if not inversion.follows:
        return (
            "No tumbler was found that follows the light curves to their noise: "
            f"{value}, and residuals at neighbouring points correlate by "
            f"{inversion.correlation:.2f}. A stated noise is too small, the body is no "
            "ellipsoid, or its periods were not among the `pairs`."
        )
    if count == 1:
        return f"One tumbler explains the light curves: {value}."
    if inversion.determined:
        return (
            f"{count} tumblers explain the light curves. They have the same periods "
            "and mode, and differ in the direction of the angular momentum or in the "
            f"shape: {value}."
        )
    return (
        f"{count} tumblers explain the light curves, which do not say which one is "
        f"true: {value}."
    )


def _described(rank: int, alias: Alias) -> list[str]:
    """One alias in words."""
    x, error = alias.estimates, alias.errors
    mode = alias.tumbler.mode
    head = (
        f"{rank}. {mode}, chi-square {alias.chi_square:.1f}, weight {alias.weight:.3f}"
    )
    periods = f"   P_phi {in_hours(x.precession_period, error.precession_period)}"
    if mode == "principal-axis":
        periods = periods.replace("P_phi", "period")
    else:
        periods += f", P_psi {in_hours(x.rotation_period, error.rotation_period)}"
    pole = (
        "   angular momentum towards longitude "
        f"{in_degrees(x.longitude, error.longitude)}, latitude "
        f"{in_degrees(x.latitude, error.latitude)}"
    )
    shape = ", ".join(
        f"{name} {value:.3f} +- {spread:.3f}"
        for name, value, spread in zip(
            ("b/a", "c/b"), x.axis_ratios, error.axis_ratios, strict=True
        )
    )
    lines = [head, periods, pole, f"   {shape}"]
    if np.min(x.axis_ratios) < _THIN:
        lines.append(_IS_THIN)
    if mode != "principal-axis":
        lines.append(f"   E/E0 {x.energy_ratio:.4f} +- {error.energy_ratio:.4f}")
        if _is_round(alias):
            lines.append(_ROUND)
    return lines


def _is_round(alias: Alias) -> bool:
    """Whether the body looks the same from all sides of the axis that it circles."""
    # The axes other than the longest, or other than the shortest.
    which = 1 if alias.tumbler.mode == "long-axis" else 0
    ratio = alias.estimates.axis_ratios[which]
    return bool(1 - ratio < max(2 * alias.errors.axis_ratios[which], _NEARLY_ROUND))


def in_hours(period: Float[AnyArray, ""], error: Float[AnyArray, ""]) -> str:
    """A period in hours with its error."""
    # An error that is known is shown with two digits.
    is_known = np.isfinite(error) and error > 0
    last = 1 - np.floor(np.log10(error / _HOUR)) if is_known else _USUAL_DIGITS
    digits = int(np.clip(last, 0, 9))
    return f"{period / _HOUR:.{digits}f} +- {error / _HOUR:.{digits}f} h"


def in_degrees(angle: Float[AnyArray, ""], error: Float[AnyArray, ""]) -> str:
    """An angle in degrees with its error, unless it may be any angle."""
    if error > _ANY_ANGLE:
        return "undetermined"
    return f"{np.rad2deg(angle):.1f} +- {np.rad2deg(error):.1f} degrees"
