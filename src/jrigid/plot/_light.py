"""Light curves beside a model, and the periods of the tumblers that explain them."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jrigid._checks import check_option
from jrigid.photometry import Alias, Inversion, LightCurve, PeriodPairs, Tumbler
from jrigid.plot._drawing import LOOKS, Axes, flat_axes, label, looks, pyplot
from jrigid.plot._tumbler_pictures import (
    Model,
    Numbers,
    Points,
    between,
    magnitudes_at,
    model_of,
    points_of,
    unit_of,
)

_LAYOUT = [["unfolded", "folded"], ["residuals", "folded"]]
_SIZES: dict[str, Any] = {"width_ratios": [1.8, 1], "height_ratios": [1.6, 1]}
_HOUR = 3600.0
# Parts of the period of precession: a gap that is cut out, and a step of the model.
_CUT = 0.25
_STEP = 0.01
_GAPS = 0.3  # of the observed time: all gaps together, where they are cut out
_MARKS = 14  # times below the axis, at most
_SURE = 1.96  # standard deviations: 95 %
_SIDE = 48  # of the map of two phases
_BAR = 0.5  # of the longest stretch: the bar is not longer
_SCALE = (1.0, 2.0, 5.0)  # lengths of a bar, in powers of ten
_LEAST_BARS = 3.0  # a bar may be one unit long, other times are some
# Looks of the kinds of motion.
_MODES = {"short-axis": LOOKS[0], "long-axis": LOOKS[1], "principal-axis": LOOKS[2]}
_RANGE = 3.0  # ratio of the longest period to the shortest, above which an axis is log


def light_curves(
    curves: Sequence[LightCurve],
    model: Inversion | Tumbler,
    axes: Mapping[str, Axes] | None = None,
    *,
    alias: int = 0,
    epoch: float | None = None,
) -> dict[str, Axes]:
    """Draw light curves with a model and what it leaves.

    - "unfolded" shows the points and the model against time. Gaps of more than a
      quarter of the period of precession are cut out. The bar shows how long the
      stretches are. Each relative curve is moved by its unknown factor, and each curve
      has a colour.
    - "residuals" shows points less model on the same axis, with the range of 95 % of
      the noise of an `Inversion`.
    - "folded" shows the points by phase, for the directions of the Sun and of the
      observer at the middle point: what the model says for these directions, plus the
      residual of each point. A tumbler has two phases, so there colours show the
      magnitudes. Points that stand out from the map do not fit.

    Args:
        curves: Light curves, those of the inversion or others.
        model: An `Inversion`, or a `Tumbler`.
        axes: Matplotlib's axes by the names above, to draw only these; None: a new
            figure.
        alias: Which alias of an inversion.
        epoch: Of a `Tumbler`, the Julian date of its time 0; None: that of the first
            curve.

    Returns:
        The axes by their names; `axes["folded"].figure.savefig("curves.png")`.

    Raises:
        ImportError: Without the extra `jrigid[plot]`.
        ValueError: No curves, no such picture or alias, or brightness that is not
            positive.

    >>> import jax.numpy as jnp, numpy as np, jrigid as jr
    >>> shape = jr.photometry.Ellipsoid(jnp.array([1.0, 0.6, 0.5]))
    >>> body = jr.photometry.Tumbler(
    ...     shape.moments, 2e4, 1.0, 1.0, 0.5, 0.0, 0.0, shape, mode="principal-axis")
    >>> ts, far = np.linspace(0.0, 4e4, 50), np.tile([1e11, 0.0, 0.0], (50, 1))
    >>> light = np.asarray(body.light_curve(ts, far, far))
    >>> curve = jr.photometry.LightCurve(0.0, ts, light, far, far, is_relative=True)
    >>> axes = jr.plot.light_curves([curve], body)
    >>> print(axes["unfolded"].get_ylabel())
    brightness [mag]
    """
    shown = model_of(curves, model, alias, epoch)
    for name in axes or {}:
        check_option("axes", name, ("unfolded", "residuals", "folded"))
    points = points_of(curves, shown)
    if axes is None:
        figure: Any = pyplot().figure(figsize=(13, 5.5), layout="constrained")
        axes = dict(figure.subplot_mosaic(_LAYOUT, **_SIZES))
    stretches = _stretches_of(points, shown.tumbler)
    if "unfolded" in axes:
        _draw_unfolded(axes["unfolded"], points, stretches, shown)
    if "residuals" in axes:
        _draw_residuals(axes["residuals"], points, stretches, shown)
    if "folded" in axes:
        draw = _draw_one_phase
        if shown.tumbler.mode != "principal-axis":
            draw = _draw_two_phases
        draw(axes["folded"], points, shown.tumbler)
    return dict(axes)


class _Stretches(NamedTuple):
    """Times with points, and where they are on an axis without the gaps between.

    Attributes:
        starts: First times [s].
        ends: Last times [s].
        places: Of the first times on the axis [s].
        gap: Between stretches on the axis [s].
    """

    starts: np.ndarray
    ends: np.ndarray
    places: np.ndarray
    gap: float

    def place(self, ts: Numbers) -> Numbers:
        """Times on the axis."""
        k = np.searchsorted(self.starts, ts, side="right") - 1
        return ts - self.starts[k] + self.places[k]


def _stretches_of(points: Points, tumbler: Tumbler) -> _Stretches:
    """Stretches of points without a long gap."""
    ts = points.ts
    cut = _CUT * float(tumbler.precession_period)
    after = np.flatnonzero(np.diff(ts) > cut)
    starts = ts[np.concatenate([[0], after + 1])]
    ends = ts[np.concatenate([after, [len(ts) - 1]])]
    lengths = ends - starts
    # Single points have no length.
    gap = _GAPS * (np.sum(lengths) or 1.0) / len(starts)
    places = np.concatenate([[0.0], np.cumsum(lengths + gap)[:-1]])
    return _Stretches(starts, ends, places, float(gap))


def _draw_unfolded(
    ax: Axes, points: Points, stretches: _Stretches, model: Model
) -> None:
    """Draw points and model against time."""
    period = float(model.tumbler.precession_period)
    fine = [
        np.linspace(first, last, int((last - first) / (_STEP * period)) + 2)
        for first, last in zip(stretches.starts, stretches.ends, strict=True)
    ]
    ts = np.concatenate(fine)
    vectors = [between(ts, points.ts, x) for x in (points.to_sun, points.to_observer)]
    magnitudes = magnitudes_at(model.tumbler, ts, *vectors) - points.zero
    # A point that is not a number ends the line of a stretch.
    ends = np.cumsum([len(x) for x in fine])[:-1]
    places = np.insert(stretches.place(ts), ends, np.nan)
    ax.plot(places, np.insert(magnitudes, ends, np.nan), color="0.4", lw=1.2)
    _draw_points(ax, points, stretches, points.magnitudes)
    # Magnitudes grow as light fades.
    ax.invert_yaxis()
    _mark_times(ax, points, stretches)
    _draw_bar(ax, stretches)
    ax.set_title(f"Light curves and {_name_of(model.tumbler)}", loc="left")
    ax.set_ylabel("brightness [mag]")


def _name_of(tumbler: Tumbler) -> str:
    """A tumbler by its mode and its periods."""
    seconds = float(tumbler.precession_period)
    scale, unit = unit_of(seconds)
    first = f"{seconds / scale:.4g} {unit}"
    if tumbler.mode == "principal-axis":
        return f"a rotation in {first}"
    seconds = float(tumbler.rotation_period)
    scale, unit = unit_of(seconds)
    return f"a {tumbler.mode} mode: {first}, {seconds / scale:.4g} {unit}"


def _draw_points(
    ax: Axes, points: Points, stretches: _Stretches, values: Numbers
) -> None:
    """Draw a value for each point, each curve by a colour of its own."""
    places = stretches.place(points.ts)
    for (colour, marker), k in looks(np.unique(points.curve)):
        own = points.curve == k
        ax.plot(places[own], values[own], marker, color=colour, ms=3.5, alpha=0.8)


def _draw_residuals(
    ax: Axes, points: Points, stretches: _Stretches, model: Model
) -> None:
    """Draw points less model against time."""
    if model.noise is not None:
        edge = _SURE * model.noise
        ax.axhspan(-edge, edge, color="0.9", label="95 % of noise")
    ax.axhline(0, color="0.4", lw=1)
    _draw_points(ax, points, stretches, points.residuals)
    ax.invert_yaxis()
    size = float(np.std(points.residuals))
    label(ax, f"Residuals: {size:.3f} mag rms", "", "residual [mag]")
    _mark_times(ax, points, stretches)


def _mark_times(ax: Axes, points: Points, stretches: _Stretches) -> None:
    """Write the times of stretches below, and separate stretches by lines."""
    first = points.ts[0]
    scale, unit = unit_of(float(points.ts[-1] - first))
    if len(stretches.starts) == 1:
        ax.xaxis.set_major_formatter(lambda place, _: f"{place / scale:.3g}")
        ax.set_xlabel(f"time since the first point [{unit}]")
        return
    apart = stretches.places[-1] / _MARKS
    shown = [0]
    for k, place in enumerate(stretches.places):
        if place - stretches.places[shown[-1]] > apart:
            shown.append(k)
    texts = [f"{(x - first) / scale:.1f}" for x in stretches.starts[shown]]
    ax.set_xticks(stretches.places[shown], texts)
    for place in stretches.places[1:]:
        ax.axvline(place - stretches.gap / 2, color="0.85", lw=0.8, zorder=0)
    ax.set_xlabel(f"time since the first point [{unit}], gaps cut out")


def _draw_bar(ax: Axes, stretches: _Stretches) -> None:
    """Draw how long the stretches are above the picture, where gaps are cut out."""
    longest = _BAR * float(np.max(stretches.ends - stretches.starts))
    if len(stretches.starts) == 1 or longest == 0:
        return
    scale, unit = unit_of(_LEAST_BARS * longest)
    power = 10.0 ** np.floor(np.log10(longest / scale))
    length = power * max(x for x in _SCALE if x * power * scale <= longest)
    end = float(stretches.place(stretches.ends)[-1])
    high: Any = {"transform": ax.get_xaxis_transform(), "clip_on": False}
    ax.plot([end - length * scale, end], [1.03, 1.03], color="k", lw=2, **high)
    where = end - length * scale - 0.3 * stretches.gap
    ax.text(where, 1.03, f"{length:g} {unit}", ha="right", va="center", **high)


def _draw_one_phase(ax: Axes, points: Points, tumbler: Tumbler) -> None:
    """Draw points and model against the phase of a steady rotation."""
    period = float(tumbler.precession_period)
    middle = len(points.ts) // 2
    phases = np.linspace(0.0, 1.0, 201)
    ts = np.concatenate([phases * period, points.ts])
    magnitudes = _at_one_geometry(points, tumbler, ts, middle)
    line, moved = np.split(magnitudes, [len(phases)])
    ax.plot(phases, line, color="0.4", lw=1.2)
    moved = moved + points.residuals
    for (colour, marker), k in looks(np.unique(points.curve)):
        own = points.curve == k
        turns = points.ts[own] / period % 1.0
        ax.plot(turns, moved[own], marker, color=colour, ms=3.5, alpha=0.8)
    ax.invert_yaxis()
    label(ax, "Folded", "phase of the rotation", "brightness [mag]")


def _draw_two_phases(ax: Axes, points: Points, tumbler: Tumbler) -> None:
    """Draw points on the map of the model over both phases."""
    periods = np.array([tumbler.precession_period, tumbler.rotation_period], float)
    middle = len(points.ts) // 2
    edges = np.linspace(0.0, 1.0, _SIDE + 1)
    centers = (edges[1:] + edges[:-1]) / 2
    first, second = np.meshgrid(centers, centers, indexing="ij")
    # At these times the rotation has its phases, and the precession has gone on.
    ts = (second * periods[1]).ravel()
    # Sun and observer, turned about the pole by the surplus of the precession, are seen
    # from the body as without it.
    back = 2 * np.pi * (ts / periods[0] - first.ravel())
    pole = _pole_of(tumbler)
    directions = []
    for each in (points.to_sun, points.to_observer):
        directions.append(_turned_about(pole, back, each[middle]))
    values = magnitudes_at(tumbler, ts, *directions) - points.zero
    values = values.reshape(first.shape)
    moved = _at_one_geometry(points, tumbler, points.ts, middle) + points.residuals
    style: dict[str, Any] = {
        # Reversed, since the small magnitudes are the bright ones.
        "cmap": "cividis_r",
        "vmin": min(values.min(), moved.min()),
        "vmax": max(values.max(), moved.max()),
    }
    ax.pcolormesh(edges, edges, values.T, rasterized=True, **style)
    turns = points.ts[:, None] / periods % 1.0
    drawn = ax.scatter(*turns.T, c=moved, s=26, edgecolors="w", lw=0.6, **style)
    bar = ax.figure.colorbar(drawn, ax=ax, label="brightness [mag]")
    bar.ax.invert_yaxis()
    label(ax, "Folded by both periods", r"phase of $P_\phi$", r"phase of $P_\psi$")


def _at_one_geometry(
    points: Points, tumbler: Tumbler, ts: Numbers, middle: int
) -> Numbers:
    """Magnitudes of the model for the directions of one point."""
    shape = (len(ts), 3)
    to_sun = np.broadcast_to(points.to_sun[middle], shape)
    to_observer = np.broadcast_to(points.to_observer[middle], shape)
    return magnitudes_at(tumbler, ts, to_sun, to_observer) - points.zero


def _pole_of(tumbler: Tumbler) -> np.ndarray:
    """Direction of the angular momentum in space."""
    longitude = float(tumbler.longitude)
    latitude = float(tumbler.latitude)
    level = np.cos(latitude)
    return np.array(
        [level * np.cos(longitude), level * np.sin(longitude), np.sin(latitude)]
    )


def _turned_about(pole: np.ndarray, angles: Numbers, vector: np.ndarray) -> np.ndarray:
    """A vector, turned about a pole by many angles (angles, 3)."""
    along = (pole @ vector) * pole
    across = vector - along
    cosines = np.cos(angles)[:, None]
    sines = np.sin(angles)[:, None]
    return along + cosines * across + sines * np.cross(pole, across)


def period_map(
    inversion: Inversion, pairs: PeriodPairs | None = None, *, ax: Axes | None = None
) -> Axes:
    """Draw the periods of the tumblers that explain light curves.

    Aliases are full, with their rank beside them and a list of their weights. The best
    of the tumblers that are rejected are hollow. Bars are standard errors, which are
    often smaller than the marker. A principal-axis rotation has one period and is a
    vertical line. An axis is logarithmic where its periods differ by more than a factor
    of three.

    Args:
        inversion: What `find_tumblers` returned.
        pairs: What `period_pairs` returned, drawn as small grey dots.
        ax: Axes.

    Returns:
        The axes: P_phi to the right and P_psi upward [h].

    Raises:
        ImportError: Without the extra `jrigid[plot]`.

    >>> import numpy as np, jrigid as jr
    >>> pairs = jr.photometry.PeriodPairs(
    ...     np.array([9e4, 1e5]), np.array([9e5, 8e5]), np.array([0.9, 0.8]))
    >>> none = jr.photometry.Inversion(
    ...     aliases=[], rejected=[], epoch=0.0, noise=0.02, reduced_chi_square=1.0,
    ...     degrees_of_freedom=10, correlation=0.0, follows=True, determined=False,
    ...     span=1e6)
    >>> ax = jr.plot.period_map(none, pairs)  # pass what find_tumblers returned
    >>> print(ax.get_title(loc="left"))
    Aliases by rank
    """
    ax = flat_axes(ax)
    if pairs is not None:
        periods = np.stack([pairs.precession_period, pairs.rotation_period]) / _HOUR
        ax.plot(*periods, ".", color="0.7", ms=4, zorder=0, label="candidates")
    for rank, alias in enumerate(inversion.aliases, 1):
        _draw_periods(ax, alias, is_rejected=False)
        _write_rank(ax, alias, rank)
    for alias in inversion.rejected:
        _draw_periods(ax, alias, is_rejected=True)
    _scale(ax)
    label(ax, "Aliases by rank", r"$P_\phi$ [h]", r"$P_\psi$ [h]")
    weights = [f"{k}: {x.weight:.2g}" for k, x in enumerate(inversion.aliases, 1)]
    text = "\n".join(["weights", *weights])
    ax.text(1.03, 1.0, text, transform=ax.transAxes, va="top")
    ax.legend(loc="lower left", bbox_to_anchor=(1.0, 0.0), frameon=False)
    return ax


def _draw_periods(ax: Axes, alias: Alias, is_rejected: bool) -> None:
    """Draw one tumbler by its periods."""
    mode = alias.tumbler.mode
    colour, marker = _MODES[mode]
    name = f"{mode}, rejected" if is_rejected else mode
    # A name occurs once in the legend, however many tumblers have this mode.
    known = ax.get_legend_handles_labels()[1]
    style: dict[str, Any] = {"color": colour, "label": None if name in known else name}
    first = float(alias.estimates.precession_period) / _HOUR
    if mode == "principal-axis":
        ax.axvline(first, ls=":" if is_rejected else "-", lw=1.2, **style)
        return
    ax.errorbar(
        first,
        float(alias.estimates.rotation_period) / _HOUR,
        yerr=float(alias.errors.rotation_period) / _HOUR,
        xerr=float(alias.errors.precession_period) / _HOUR,
        fmt=marker,
        ms=7,
        mfc="none" if is_rejected else colour,
        **style,
    )


def _write_rank(ax: Axes, alias: Alias, rank: int) -> None:
    """Write the rank of a tumbler beside it, the even ones on the other side."""
    x = float(alias.estimates.precession_period) / _HOUR
    y = float(alias.estimates.rotation_period) / _HOUR
    offset = (7, 5) if rank % 2 else (-14, -12)
    place: dict[str, Any] = {"xytext": offset, "textcoords": "offset points"}
    if alias.tumbler.mode == "principal-axis":
        place |= {"xytext": (7, 5), "xycoords": ax.get_xaxis_transform()}
        # A steady rotation has no second period. The rank stands near the foot of its
        # line.
        y = 0.02
    ax.annotate(str(rank), (x, y), **place)


def _scale(ax: Axes) -> None:
    """Make the axes logarithmic on which periods differ by much."""
    ax.margins(0.12)
    from matplotlib.ticker import LogLocator, NullFormatter

    for axis, rescale in ((ax.xaxis, ax.set_xscale), (ax.yaxis, ax.set_yscale)):
        low, high = axis.get_data_interval()
        if low > 0 and high > _RANGE * low:
            rescale("log")
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
