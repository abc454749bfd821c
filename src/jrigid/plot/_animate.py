"""A body in motion: a page that any browser plays, or a gif or a film."""

import html
import json
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jrigid._checks import check_option, demand
from jrigid._types import AnyArray
from jrigid.plot import _common as common
from jrigid.plot._body import Surface, place, surface_of
from jrigid.plot._common import Body, Motion
from jrigid.rotation import slerp
from jrigid.top import SymmetricTop

_DIGITS = 4  # of what is written into a page


class Animation(NamedTuple):
    """A body in motion. A notebook shows it; `save` writes it.

    Attributes:
        surface: What is drawn.
        times: Of the frames [s].
        attitudes: Quaternions of the frames (frames, 4).
        trace: Points of the body whose paths are drawn, body components (n, 3).
        fps: Frames a second.
    """

    surface: Surface
    times: np.ndarray
    attitudes: np.ndarray
    trace: np.ndarray
    fps: float

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
        data["colours"] = [colour for colour, _ in common.LOOKS]
        page = resources.files("jrigid.plot").joinpath("animation.html").read_text()
        return page.replace("/* data */ null", json.dumps(data, separators=(",", ":")))

    def _repr_html_(self) -> str:
        """For notebooks."""
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
        figure = plt.figure(figsize=(4.6, 4.6))
        recorder = writer(fps=self.fps)
        ax = figure.add_axes((0, 0, 1, 1), projection="3d", elev=25, azim=35)
        common.space_axes(ax, 1.1)
        clock = ax.text2D(0.04, 0.04, "", transform=ax.transAxes)
        lines = [ax.plot([], [], [], color="#D55E00", lw=1.5)[0] for _ in self.trace]
        trails = np.moveaxis(common.turned(self.attitudes, self.trace), 1, 0)
        frames = zip(self.times, self.attitudes, strict=True)
        drawn = []
        with recorder.saving(figure, path, dpi=100):
            for i, (time, attitude) in enumerate(frames):
                clock.set_text(f"t = {time:.3g} s")
                for line, trail in zip(lines, trails, strict=True):
                    line.set_data_3d(*trail[: i + 1].T)
                for artist in drawn:
                    artist.remove()
                drawn = place(ax, self.surface, attitude)
                recorder.grab_frame()
        plt.close(figure)


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
    demand(fps > 0, f"Argument `fps` must be positive, but it is {fps!r}.")
    frames = max(round(seconds * fps), 2)
    times = np.linspace(known_times[0], known_times[-1], frames)
    attitudes = _at(times, known_times, attitudes)
    if trace is None:
        trace = np.eye(3)[2:] if isinstance(body, SymmetricTop) else np.empty((0, 3))
    points = np.reshape(np.asarray(trace, float), (-1, 3))
    return Animation(surface_of(body, kind), times, attitudes, points, fps)


def _at(times: np.ndarray, ts: np.ndarray, attitudes: np.ndarray) -> np.ndarray:
    """Attitudes at other times, between those at `ts`."""
    before = np.clip(np.searchsorted(ts, times, side="right") - 1, 0, len(ts) - 2)
    # Times may repeat, as at an event.
    steps = np.maximum(np.diff(ts)[before], np.finfo(float).tiny)
    part = (times - ts[before]) / steps
    return np.asarray(jax.vmap(slerp)(attitudes[before], attitudes[before + 1], part))
