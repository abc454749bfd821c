"""A body in motion: a page that any browser plays, or a gif or a film."""

import html
import json
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jrigid._checks import check_option, check_shape, demand
from jrigid._types import AnyArray
from jrigid.photometry import Ellipsoid, Inversion, LightCurve, Tumbler
from jrigid.plot import _drawing as common
from jrigid.plot._appearance import outline_of, sky_axes
from jrigid.plot._body_pictures import Surface, place, surface_of
from jrigid.plot._drawing import Axes3D, Body, Motion
from jrigid.plot._tumbler_pictures import (
    attitudes_at,
    between,
    magnitudes_at,
    model_of,
    points_of,
    unit_of,
)
from jrigid.rotation import from_matrix, multiply, slerp
from jrigid.top import SymmetricTop

_DIGITS = 4  # of what is written into a page
# Elevation and azimuth of the first view, as of pictures in space [rad].
_VIEW = (0.44, 0.61)
_MARGIN = 0.06  # of the range of a curve, beside it


class Curve(NamedTuple):
    """A light curve that is drawn below a body.

    Attributes:
        values: Magnitudes of the model, of the frames (frames,).
        times: Of the points [s] (points,).
        points: Magnitudes of the points (points,).
    """

    values: np.ndarray
    times: np.ndarray
    points: np.ndarray

    @property
    def limits(self) -> tuple[float, float]:
        """The faintest and the brightest magnitude of a picture."""
        both = np.concatenate([self.values, self.points])
        margin = _MARGIN * float(np.ptp(both))
        # The larger one first: magnitudes grow as light fades, hence the axis is
        # reversed.
        return float(np.max(both)) + margin, float(np.min(both)) - margin


class Animation(NamedTuple):
    """A body in motion. A notebook shows it; `save` writes it.

    Attributes:
        surface: What is drawn.
        times: Of the frames [s].
        attitudes: Quaternions of the frames (frames, 4).
        trace: Points of the body whose paths are drawn, body components (n, 3).
        fps: Frames a second.
        lights: Directions of the light, of the frames (frames, 3), in the axes of the
            attitudes; None: from above, and faces in the dark are seen.
        curve: The light curve below the body, if any.
        view: Elevation and azimuth of the first view [rad].
        unit: Seconds in the unit of time that is shown, and its name.
    """

    surface: Surface
    times: np.ndarray
    attitudes: np.ndarray
    trace: np.ndarray
    fps: float
    lights: np.ndarray | None = None
    curve: Curve | None = None
    view: tuple[float, float] = _VIEW
    unit: tuple[float, str] = (1.0, "s")

    @property
    def html(self) -> str:
        """A page that needs no server and no network: drag it to look around."""
        arrays = self.surface._asdict() | {
            "attitudes": self.attitudes,
            "trace": self.trace,
        }
        data: dict[str, Any] = {
            name: x.round(_DIGITS).tolist() for name, x in arrays.items()
        }
        data |= {"fps": self.fps, "times": [float(x) for x in self.times[[0, -1]]]}
        data |= {"view": self.view, "unit": self.unit, "lights": None, "curve": None}
        if self.lights is not None:
            data["lights"] = self.lights.round(_DIGITS).tolist()
        if self.curve is not None:
            rows = {name: x.round(_DIGITS) for name, x in self.curve._asdict().items()}
            data["curve"] = {name: x.tolist() for name, x in rows.items()}
            data["curve"]["limits"] = self.curve.limits
        data["colours"] = [colour for colour, _ in common.LOOKS]
        page = resources.files("jrigid.plot").joinpath("animation.html").read_text()
        return page.replace("/* data */ null", json.dumps(data, separators=(",", ":")))

    def _repr_html_(self) -> str:
        """HTML for notebooks: the page in a frame."""
        # In a frame of its own the page keeps its styles and names apart from those
        # of the notebook.
        frame = (
            '<iframe width="480" height="540" style="border:0" srcdoc="{}"></iframe>'
        )
        return frame.format(html.escape(self.html))

    def save(self, path: str | Path) -> Path:
        """Write a page (.html, 10 to 30 kB), a gif, or a film (.mp4, with ffmpeg).

        Args:
            path: Where.

        Returns:
            The path.

        Raises:
            ValueError: Another suffix.
            ImportError: A gif or a film without the extra `jrigid[plot]`.
            RuntimeError: A film without ffmpeg.
        """
        path = Path(path)
        check_option("path", path.suffix, (".html", ".gif", ".mp4"))
        if path.suffix == ".html":
            path.write_text(self.html, encoding="utf-8")
            return path
        self._film(path)
        return path

    def _film(self, path: Path) -> None:
        """Write a gif or a film, frame by frame."""
        plt = common.pyplot()
        from matplotlib import animation as film

        writer: Any = film.PillowWriter if path.suffix == ".gif" else film.FFMpegWriter
        if not writer.isAvailable():
            raise RuntimeError(
                "A film needs ffmpeg, which is not found; a .gif or .html does not."
            )
        figure, ax = self._figure(plt)
        recorder = writer(fps=self.fps)
        clock = ax.text2D(0.04, 0.04, "", transform=ax.transAxes)
        lines = [ax.plot([], [], [], color="#D55E00", lw=1.5)[0] for _ in self.trace]
        marker = None if self.curve is None else self._draw_curve(figure, self.curve)
        scale, unit = self.unit
        # By points of the body first, and then by frames.
        trails = np.moveaxis(common.turned(self.attitudes, self.trace), 1, 0)
        drawn = []
        with recorder.saving(figure, path, dpi=100):
            for i, time in enumerate(self.times):
                clock.set_text(f"t = {time / scale:.3g} {unit}")
                for line, trail in zip(lines, trails, strict=True):
                    line.set_data_3d(*trail[: i + 1].T)
                # Colours of faces and the axes in front change with the attitude.
                for artist in drawn:
                    artist.remove()
                light = None if self.lights is None else self.lights[i]
                drawn = place(ax, self.surface, self.attitudes[i], light)
                if light is not None:
                    drawn += _draw_sun(ax, light)
                if marker is not None and self.curve is not None:
                    marker.set_data([time / scale], [self.curve.values[i]])
                recorder.grab_frame()
        # pyplot keeps each figure in memory until it is closed.
        plt.close(figure)

    def _figure(self, plt: Any) -> tuple[Any, Axes3D]:
        """A figure with axes of three dimensions, and room for the curve if any."""
        low = 0.0 if self.curve is None else 0.3
        # A curve makes the figure higher, so that the body has the same square with
        # and without one.
        figure = plt.figure(figsize=(4.6, 4.6 / (1 - low)))
        elevation, azimuth = np.degrees(self.view)
        place_of_body: Any = (0, low, 1, 1 - low)
        ax: Axes3D = figure.add_axes(
            place_of_body, projection="3d", elev=elevation, azim=azimuth
        )
        common.space_axes(ax, 1.1)
        return figure, ax

    def _draw_curve(self, figure: Any, curve: Curve) -> Any:
        """Draw the light curve below; returns the marker that moves along it."""
        scale, unit = self.unit
        ax = figure.add_axes((0.19, 0.09, 0.77, 0.2))
        ax.plot(self.times / scale, curve.values, color="0.4", lw=1)
        ax.plot(curve.times / scale, curve.points, "o", color="#0072B2", ms=3)
        ax.set(xlabel=f"time [{unit}]", ylabel="brightness [mag]", ylim=curve.limits)
        (marker,) = ax.plot([], [], "o", color="#D55E00", ms=8)
        return marker


def _draw_sun(ax: Axes3D, light: np.ndarray) -> list[Any]:
    """Draw a line towards the Sun; returns the artists."""
    # The observer is on the x axis. Light from behind the body has a negative x there,
    # and is drawn below the faces.
    style: dict[str, Any] = {"color": "#E69F00", "zorder": common.FRONT * light[0]}
    (line,) = ax.plot(*np.outer(light, [1.08, 1.25]), lw=2.5, **style)
    return [line, ax.text(*(1.3 * light), "Sun", **style)]


def animate(
    body: Body,
    motion: Motion,
    *,
    ts: AnyArray | None = None,
    kind: str = "box",
    trace: AnyArray | None = None,
    seconds: float = 10.0,
    fps: float = 20.0,
) -> Animation:
    """Show a body along a motion.

    Args:
        body: As for `body`: a mesh (vertices, faces), a `SymmetricTop`, or what has an
            inertia.
        motion: What `simulate`, `free_rotation` or `top_motion` returned: no more than
            half a turn from state to state.
        ts: Times of the states [s]; of a trajectory its own.
        kind: "box" or "ellipsoid".
        trace: A point of the body, or several (n, 3), whose paths are drawn: body
            components, the farthest corner at 1; by default the end of a top's axis,
            (0, 0, 1), and none of others.
        seconds: How long it plays.
        fps: Frames a second.

    Returns:
        An `Animation`: a notebook shows it, `.save("top.html")` (or .gif, .mp4) writes
        it.

    Raises:
        ValueError: Not one time for each state of one motion, in their order, or fewer
            than two finite states.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> ts = jnp.linspace(0.0, 20.0, 500)
    >>> motion = jr.top_motion(top, jr.top.initial_state(top, 0.5, omega3=5.0), ts)
    >>> film = jr.plot.animate(top, motion, ts=ts)
    >>> print(film.attitudes.shape, film._repr_html_()[:7])
    (200, 4) <iframe
    """
    attitudes = np.asarray(common.states_of(motion).attitude, float)
    known_times = common.times_of(motion, ts)
    finite = np.all(np.isfinite(attitudes), axis=-1)
    known_times = known_times[finite]
    attitudes = attitudes[finite]
    message = "Argument `motion` must hold two states at least, but it does not."
    demand(len(known_times) > 1, message)
    message = "Argument `ts` must not decrease, but it does."
    demand(bool(np.all(np.diff(known_times) >= 0)), message)
    frames = _number_of_frames(seconds, fps)
    times = np.linspace(known_times[0], known_times[-1], frames)
    attitudes = _at(times, known_times, attitudes)
    if trace is None:
        trace = np.eye(3)[2:] if isinstance(body, SymmetricTop) else np.empty((0, 3))
    points = np.asarray(trace, float)
    check_shape("trace", points, (3,), (None, 3))
    points = points.reshape(-1, 3)
    return Animation(surface_of(body, kind), times, attitudes, points, fps)


def _number_of_frames(seconds: float, fps: float) -> int:
    """Number of frames of a film, two at least."""
    for name, value in (("seconds", seconds), ("fps", fps)):
        message = f"Argument `{name}` must be positive and finite, but it is {value!r}."
        demand(0 < value < np.inf, message)
    return max(round(seconds * fps), 2)


def _at(times: np.ndarray, ts: np.ndarray, attitudes: np.ndarray) -> np.ndarray:
    """Attitudes at other times, between those at `ts`."""
    # No interval begins at the last state. That before it serves its time, too.
    before = np.clip(np.searchsorted(ts, times, side="right") - 1, 0, len(ts) - 2)
    # Times may repeat, as at an event.
    steps = np.maximum(np.diff(ts)[before], np.finfo(float).tiny)
    part = (times - ts[before]) / steps
    return np.asarray(jax.vmap(slerp)(attitudes[before], attitudes[before + 1], part))


def animate_light_curve(
    curve: LightCurve,
    model: Inversion | Tumbler,
    *,
    alias: int = 0,
    epoch: float | None = None,
    mesh: tuple[AnyArray, AnyArray] | None = None,
    seconds: float = 10.0,
    fps: float = 20.0,
) -> Animation:
    """Show a tumbler from the observer, lit by the Sun, above its light curve.

    The third axis of space is up, as in `appearance`. A page can be turned with the
    mouse. Faces have the colours of the principal axes to which they are normal.

    Args:
        curve: A light curve. The film lasts from its first point to its last one, with
            the directions of Sun and observer between its points by interpolation.
        model: An `Inversion`, or a `Tumbler`.
        alias: Which alias of an inversion.
        epoch: Of a `Tumbler`, the Julian date of its time 0; None: that of the curve.
        mesh: Of a body whose shape is `Facets`, vertices and faces to show in place of
            the convex body that has these facets.
        seconds: How long it plays.
        fps: Frames a second.

    Returns:
        An `Animation`: a notebook shows it, `.save("curve.html")` (or .gif, .mp4)
        writes it. Its times count from the first point.

    Raises:
        ValueError: A curve of a single time, no such alias, or facets that do not
            close.

    >>> import jax.numpy as jnp, numpy as np, jrigid as jr
    >>> shape = jr.photometry.Ellipsoid(jnp.array([1.0, 0.6, 0.5]))
    >>> body = jr.photometry.Tumbler(
    ...     shape.moments, 2e4, 1.0, 1.0, 0.5, 0.0, 0.0, shape, mode="principal-axis")
    >>> ts, far = np.linspace(0.0, 4e4, 50), np.tile([1e11, 0.0, 0.0], (50, 1))
    >>> curve = jr.photometry.LightCurve(0.0, ts, 1 + ts / 1e6, far, far, True)
    >>> film = jr.plot.animate_light_curve(curve, body, seconds=2.0)
    >>> print(film.attitudes.shape, film.curve.points.shape)
    (40, 4) (50,)
    """
    shown = model_of([curve], model, alias, epoch)
    points = points_of([curve], shown)
    first, last = points.ts[[0, -1]]
    message = "Argument `curve` must have points at two times at least, but it has not."
    demand(bool(last > first), message)
    ts = np.linspace(first, last, _number_of_frames(seconds, fps))
    to_sun = between(ts, points.ts, points.to_sun)
    to_observer = between(ts, points.ts, points.to_observer)
    values = magnitudes_at(shown.tumbler, ts, to_sun, to_observer) - points.zero
    frames = [sky_axes(x / np.linalg.norm(x)) for x in to_observer]
    # The observer is on the x axis: y is to the right and z up.
    turns = np.roll(np.array(frames), 1, axis=1)
    suns = np.einsum("nij,nj->ni", turns, to_sun)
    attitudes = attitudes_at(shown.tumbler, ts)
    return Animation(
        surface=_surface_of_shape(shown.tumbler, mesh),
        times=ts - first,
        attitudes=np.asarray(_turned_by(turns, attitudes)),
        trace=np.empty((0, 3)),
        fps=fps,
        lights=suns / np.linalg.norm(suns, axis=1, keepdims=True),
        curve=Curve(values, points.ts - first, points.magnitudes),
        view=(0.0, 0.0),
        unit=unit_of(last - first),
    )


@jax.jit
def _turned_by(
    turns: Float[ArrayLike, "frames 3 3"], attitudes: Float[ArrayLike, "frames 4"]
) -> Float[Array, "frames 4"]:
    """Attitudes of turned bodies."""
    return jax.vmap(multiply)(jax.vmap(from_matrix)(turns), attitudes)


def _surface_of_shape(
    tumbler: Tumbler, mesh: tuple[AnyArray, AnyArray] | None
) -> Surface:
    """The surface of a tumbler: its ellipsoid, or the mesh of its facets."""
    if mesh is None and isinstance(tumbler.shape, Ellipsoid):
        # The homogeneous ellipsoid of these moments has the same ratios of semi-axes.
        return surface_of(tumbler.shape.moments, "ellipsoid")
    return surface_of(tuple(outline_of(tumbler, mesh)), "box")
