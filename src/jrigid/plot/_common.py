"""What the pictures share: colours, axes, what a motion is, lines on a surface."""

from itertools import cycle
from typing import Any

import numpy as np

from jrigid._checks import INERTIA, demand, kind_of
from jrigid._extra import extra
from jrigid.dynamics import State
from jrigid.mass import principal_axes

# Okabe and Ito's colours, told apart by the colour-blind, with a marker each.
LOOKS = ("#0072B2", "o"), ("#D55E00", "s"), ("#009E73", "d"), ("#CC79A7", "^")
TURN = np.linspace(0, 2 * np.pi, 361)
FRONT = 100  # of lines and texts, above the surfaces
_VIEW = 25, 35  # elevation and azimuth of a new picture in space [degrees]


def pyplot() -> Any:
    """`matplotlib.pyplot`, or an error that names the extra."""
    return extra("plot", "matplotlib.pyplot")


def flat_axes(ax: Any) -> Any:
    """The axes given, or those of a new figure."""
    return pyplot().figure(layout="constrained").add_subplot() if ax is None else ax


def space_axes(ax: Any, size: float, elevation: float = _VIEW[0]) -> Any:
    """Axes of three dimensions, without a frame, for what is within a distance of the origin."""
    if ax is None:
        figure = pyplot().figure(figsize=(5.5, 5.5), layout="constrained")
        ax = figure.add_subplot(projection="3d", elev=elevation, azim=_VIEW[1])
    demand(
        ax.name == "3d", "Argument `ax` must be 3-d (projection='3d'), but it is not."
    )
    ax.set(
        proj_type="ortho", xlim=(-size, size), ylim=(-size, size), zlim=(-size, size)
    )
    ax.set_box_aspect((1, 1, 1), zoom=1.45)
    ax.set_axis_off()
    return ax


def looks(things: Any) -> Any:
    """Each thing with its colour and marker."""
    return zip(cycle(LOOKS), things, strict=False)


def tensor_of(body: Any) -> np.ndarray:
    """The tensor of moments, a tensor, or of whatever has one."""
    system = body.as_rigid_body() if hasattr(body, "as_rigid_body") else body
    inertia = np.asarray(getattr(system, "inertia", system))
    wrong = f"Argument `body` must have or be an inertia, but it is {kind_of(body)}."
    demand(inertia.dtype.kind in "iuf" and inertia.shape in INERTIA, wrong)
    return (np.diag(inertia) if inertia.ndim == 1 else inertia).astype(float)


def principal(body: Any) -> tuple[np.ndarray, np.ndarray]:
    """Moments, ascending, and axes in columns."""
    found = principal_axes(tensor_of(body))
    return np.asarray(found.moments), np.asarray(found.axes)


def states_of(motion: Any) -> Any:
    """The states of what `simulate`, `free_rotation` or `top_motion` returned, or a state."""
    states = getattr(motion, "states", motion)
    wrong = (
        f"Argument `motion` must be a motion or a State, but it is {kind_of(motion)}."
    )
    demand(hasattr(states, "attitude"), wrong)
    one = "Argument `motion` must be one motion, but it is several: take one by "
    demand(
        np.ndim(states.attitude) <= 2, one + "`jax.tree.map(lambda x: x[i], motion)`."
    )
    return states


def start_of(motion: Any) -> State:
    """The first finite state of a motion, or the state itself."""
    states = states_of(motion)
    attitudes, omegas = states.attitude.reshape(-1, 4), states.omega.reshape(-1, 3)
    seen = np.isfinite(np.sum(attitudes, axis=1) + np.sum(omegas, axis=1))
    demand(
        bool(np.any(seen)),
        "Argument `motion` must have a finite state, but it has none.",
    )
    return State(attitudes[np.argmax(seen)], omegas[np.argmax(seen)])


def times_of(motion: Any, ts: Any) -> np.ndarray:
    """The times given, or those of a trajectory [s]: one for each state."""
    ts, shape = (
        getattr(motion, "ts", None) if ts is None else ts,
        states_of(motion).omega.shape,
    )
    demand(
        ts is not None,
        "Argument `ts` must be given for a motion without times, but it is not.",
    )
    demand(
        len(shape) == 2,
        "Argument `motion` must hold many states, but it is a single one.",
    )
    wrong = (
        f"Argument `ts` must be a time for each of {shape[0]} states, but it has shape"
    )
    demand(np.shape(ts) == shape[:1], f"{wrong} {np.shape(ts)}.")
    return np.asarray(ts, float)


def turned(attitudes: Any, vectors: Any) -> np.ndarray:
    """Body components (..., n, 3) in space, of attitudes (..., 4)."""
    q, v = np.asarray(attitudes)[..., None, :], np.asarray(vectors)
    across = 2 * np.cross(q[..., 1:], v)
    return v + q[..., :1] * across + np.cross(q[..., 1:], across)


def eye(ax: Any) -> np.ndarray:
    """Direction from which axes of three dimensions are seen."""
    up, round_ = np.radians([ax.elev, ax.azim])
    return np.array(
        [np.cos(up) * np.cos(round_), np.cos(up) * np.sin(round_), np.sin(up)]
    )


def circles(tilts: Any) -> np.ndarray:
    """Circles of latitude on the unit sphere (tilts, points, 3)."""
    polar = np.reshape(tilts, (-1, 1))
    round_ = np.sin(polar) * np.cos(TURN), np.sin(polar) * np.sin(TURN)
    return np.stack([*round_, np.cos(polar) + 0 * TURN], axis=-1)


def globe(ax: Any, semi_axes: Any, axes: Any) -> None:
    """An ellipsoid, as a pale surface."""
    x, y, z = np.moveaxis(circles(TURN[:181:4])[:, ::5] * semi_axes @ axes.T, -1, 0)
    ax.plot_surface(
        x, y, z, color="0.92", alpha=0.4, lw=0, shade=False, rasterized=True
    )


def on_surface(ax: Any, points: np.ndarray, normals: np.ndarray, **style: Any) -> None:
    """A line on a surface, full where it faces the eye and faint behind, also when it is turned.

    A label that is there already is not set again.
    """
    known = {line.get_label() for line in ax.lines}
    style["label"] = None if style.get("label") in known else style.get("label")
    (near,) = ax.plot(*points.T, zorder=FRONT, **style)
    (far,) = ax.plot(*points.T, zorder=FRONT, **style | {"alpha": 0.25, "label": None})

    def hide(_: Any = None) -> None:
        seen = (normals @ eye(ax) >= 0)[:, None]
        near.set_data_3d(*np.where(seen, points, np.nan).T)
        far.set_data_3d(*np.where(seen, np.nan, points).T)

    hide()
    ax.figure.canvas.mpl_connect("motion_notify_event", hide)


def label(ax: Any, title: str, across: str, up: str) -> None:
    """Title and units, and a legend above the picture where there is something to tell."""
    ax.set_title(title, loc="left")
    ax.set(xlabel=across, ylabel=up)
    if handles := ax.get_legend_handles_labels()[0]:
        place = {"loc": "lower right", "bbox_to_anchor": (1, 1), "borderaxespad": 0}
        ax.legend(
            ncols=len(handles),
            frameon=False,
            handlelength=1.4,
            columnspacing=1.0,
            **place,
        )
