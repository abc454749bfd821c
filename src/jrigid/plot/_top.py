"""Pictures of a heavy top: the path of its tip, and its effective potential."""

import numpy as np

from jrigid.plot import _drawing as common
from jrigid.plot._drawing import Axes, Axes3D, Look, Motion
from jrigid.top import SymmetricTop, conserved, nutation_bounds
from jrigid.top import effective_potential as potential

_LEAST = np.radians(4.0)  # of tilts on either side of a top that hardly nods
_ELEVATION = 25, 55  # of the eye, least and most [degrees]
_BAND = 12  # lines across the band of nutation


def _bounds(top: SymmetricTop, *motions: Motion) -> np.ndarray:
    """The least and the largest tilt of each motion (n, 2) [rad]."""
    return np.array([nutation_bounds(top, common.start_of(x)) for x in motions], float)


def _words(band: np.ndarray) -> str:
    """Tilts in degrees, one of a steady precession."""
    return " to ".join(dict.fromkeys(f"{x:.1f}°" for x in np.degrees(band)))


def tip(
    top: SymmetricTop, motion: Motion, *more: Motion, ax: Axes3D | None = None
) -> Axes3D:
    """Draw paths of the top's axis on the unit sphere, with the circles they touch.

    Of several motions each is named by its tilts.

    Args:
        top: The top.
        motion: What `top_motion` or `simulate` returned.
        more: Further motions.
        ax: Axes of three dimensions.

    Returns:
        The axes.

    Raises:
        ImportError: Without the extra `jrigid[plot]`.
        ValueError: Axes of two dimensions.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> state = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> motion = jr.top_motion(top, state, jnp.linspace(0.0, 20.0, 500))
    >>> print(jr.plot.tip(top, motion).get_title())
    Tip of the top, tilts 28.6° to 43.4°
    """
    bounds = _bounds(top, motion, *more)
    # Look at the band from the side of its pole.
    up = 90 - np.degrees(np.mean(bounds))
    elevation = np.copysign(np.clip(abs(up), *_ELEVATION), up)
    space = common.space_axes(ax, 1.1, elevation)
    common.globe(space, np.ones(3), np.eye(3))
    vertical = np.array([[0, 0, 1.0], [0, 0, 1.2]])
    common.on_surface(space, vertical, vertical, color="k", lw=1)
    space.text(0, 0, 1.25, "up", ha="center", zorder=common.FRONT)
    pairs = zip((motion, *more), bounds, strict=True)
    for look, (one, band) in common.looks(pairs):
        _draw_band(space, band, look)
        _draw_path(space, one, _words(band), look)
    title = "Tip of the top"
    if more:
        space.legend(
            loc="lower center",
            ncols=4,
            frameon=False,
            handlelength=1.0,
            columnspacing=1.0,
        )
    else:
        title = f"{title}, tilts {_words(bounds[0])}"
    space.set_title(title)
    return space


def _draw_band(ax: Axes3D, band: np.ndarray, look: Look) -> None:
    """Draw the circles that a path touches and the band between them."""
    for circle in common.circles(band):
        common.on_surface(ax, circle, circle, color="0.4", ls="--", lw=0.9)
    points = common.circles(np.linspace(band[0], band[1], _BAND))
    x, y, z = np.moveaxis(points, -1, 0)
    ax.plot_surface(x, y, z, color=look[0], alpha=0.15, lw=0, rasterized=True)


def _draw_path(ax: Axes3D, motion: Motion, name: str, look: Look) -> None:
    """Draw the path of the tip and where it starts."""
    colour, marker = look
    attitudes = np.asarray(common.states_of(motion).attitude).reshape(-1, 4)
    path = common.turned(attitudes, np.eye(3)[2:])[:, 0]
    common.on_surface(ax, path, path, color=colour, lw=1.5)
    # The last but one line is the part in front. It gets a label also where another
    # path has the same one.
    ax.lines[-2].set_label(name)
    start = path[np.isfinite(path[:, 0])][:1]
    common.on_surface(ax, start, start, color=colour, marker=marker, ls="none")


def effective_potential(
    top: SymmetricTop, motion: Motion, *more: Motion, ax: Axes | None = None
) -> Axes:
    """Draw the effective potential, and the energy between the turning points.

    Args:
        top: The top.
        motion: A state, or what `top_motion` or `simulate` returned.
        more: Further motions.
        ax: Axes.

    Returns:
        The axes.

    Raises:
        ImportError: Without the extra `jrigid[plot]`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> state = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> ax = jr.plot.effective_potential(top, state)
    >>> print(ax.get_xlabel(), ax.get_ylabel())
    tilt [degrees] energy of the tilt [J]
    """
    bounds = _bounds(top, motion, *more)
    starts = map(common.start_of, (motion, *more))
    ax = common.flat_axes(ax)
    margin = max(0.6 * np.ptp(bounds), _LEAST)
    ends = [np.min(bounds) - margin, np.max(bounds) + margin]
    # At the vertical the potential may be infinite.
    ends = np.clip(ends, 1e-3, np.pi - 1e-3)
    tilts = np.linspace(ends[0], ends[1], 400)
    heights = []
    pairs = zip(starts, bounds, strict=True)
    for (colour, marker), (state, band) in common.looks(pairs):
        p_phi, p_psi, energy = conserved(top, state)
        well = np.asarray(potential(top, tilts, p_phi, p_psi))
        # The energy of the spin about the axis is constant and not in the potential.
        level = float(energy - p_psi**2 / (2 * top.I3))
        ax.plot(np.degrees(tilts), well, color=colour, lw=1.2)
        style = {"color": colour, "lw": 2, "clip_on": False, "label": _words(band)}
        ax.plot(np.degrees(band), [level, level], marker + "-", **style)
        low = np.min(well)
        depth = max(level - low, 0.3 * (np.median(well) - low))
        heights += [low - 0.3 * depth, level + 1.5 * depth]
    ax.set(xlim=np.degrees(ends), ylim=(min(heights), max(heights)))
    ax.set(
        xlabel="tilt [degrees]",
        ylabel="energy of the tilt [J]",
        title="Effective potential",
    )
    ax.legend(loc="lower right", frameon=False)
    return ax
