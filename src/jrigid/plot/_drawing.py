"""Parts that pictures share: colours, axes, states of motions, lines on a surface."""

from collections.abc import Iterable, Iterator
from itertools import cycle
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Array

from jrigid._checks import INERTIA, demand, kind_of
from jrigid._extra import extra
from jrigid._motion_inputs import HasRigidBody
from jrigid._numerics import as_tensor
from jrigid._types import AnyArray
from jrigid.dynamics import State
from jrigid.mass import principal_axes
from jrigid.simulate import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
else:  # matplotlib is an extra, which is imported when a picture is drawn
    Axes = Any
Axes3D = Any  # of mplot3d, which states no types

Thing = TypeVar("Thing")
Look = tuple[str, str]  # a colour and a marker

# Okabe and Ito's colours, which the colour-blind can tell apart, with a marker each.
LOOKS: tuple[Look, ...] = (
    ("#0072B2", "o"),
    ("#D55E00", "s"),
    ("#009E73", "d"),
    ("#CC79A7", "^"),
)
TURN = np.linspace(0, 2 * np.pi, 361)
FRONT = 100  # of lines and texts, above the surfaces
_VIEW = 25, 35  # elevation and azimuth of a new picture in space [degrees]


@runtime_checkable
class HasInertia(Protocol):
    """A body, or its mass properties."""

    inertia: Array


@runtime_checkable
class Rotating(Protocol):
    """A state, or many of them."""

    @property
    def attitude(self) -> AnyArray:
        """Unit quaternions, body to space."""
        ...

    @property
    def omega(self) -> AnyArray:
        """Angular velocities, body components [rad/s]."""
        ...


@runtime_checkable
class HasStates(Protocol):
    """Object with states, as `simulate` and the exact motions return it."""

    states: Any


# What `tensor_of` and `states_of` take. Users may pass what has the same attributes.
Body = object
Motion = object


def pyplot() -> Any:
    """`matplotlib.pyplot`, or an error that names the extra."""
    return extra("plot", "matplotlib.pyplot")


def flat_axes(ax: Axes | None) -> Axes:
    """The axes given, or those of a new figure."""
    return pyplot().figure(layout="constrained").add_subplot() if ax is None else ax


def space_axes(ax: Axes3D | None, size: float, elevation: float = _VIEW[0]) -> Axes3D:
    """Axes of three dimensions, without a frame, that reach `size` from the origin."""
    space: Axes3D = ax
    if ax is None:
        figure = pyplot().figure(figsize=(5.5, 5.5), layout="constrained")
        space = figure.add_subplot(projection="3d", elev=elevation, azim=_VIEW[1])
    message = "Argument `ax` must be 3-d (projection='3d'), but it is not."
    demand(space.name == "3d", message)
    limits = (-size, size)
    # Without perspective, all points are seen from one direction: that of `eye`.
    space.set(proj_type="ortho", xlim=limits, ylim=limits, zlim=limits)
    space.set_box_aspect((1, 1, 1), zoom=1.45)
    space.set_axis_off()
    return space


def looks(things: Iterable[Thing]) -> Iterator[tuple[Look, Thing]]:
    """Each thing with its colour and marker."""
    return zip(cycle(LOOKS), things, strict=False)


def tensor_of(body: Body) -> np.ndarray:
    """The tensor of moments, of a tensor, or of whatever has one."""
    system = body.as_rigid_body() if isinstance(body, HasRigidBody) else body
    inertia = np.asarray(system.inertia if isinstance(system, HasInertia) else system)
    wrong = f"Argument `body` must have or be an inertia, but it is {kind_of(body)}."
    demand(inertia.dtype.kind in "iuf" and inertia.shape in INERTIA, wrong)
    return as_tensor(inertia).astype(float)


def principal(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Moments, ascending, and axes in columns."""
    frame = principal_axes(tensor_of(body))
    return np.asarray(frame.moments), np.asarray(frame.axes)


def states_of(motion: Motion) -> Rotating:
    """The states of what `simulate` or an exact motion returned, or a state itself."""
    states = motion.states if isinstance(motion, HasStates) else motion
    if not isinstance(states, Rotating):
        kind = kind_of(motion)
        raise ValueError(
            f"Argument `motion` must be a motion or a State, but it is {kind}."
        )
    message = "Argument `motion` must be one motion, but it is several: take one by "
    advice = "`jax.tree.map(lambda x: x[i], motion)`."
    demand(np.ndim(states.attitude) <= 2, message + advice)
    return states


def start_of(motion: Motion) -> State:
    """The first finite state of a motion, or the state itself."""
    states = states_of(motion)
    attitudes = states.attitude.reshape(-1, 4)
    omegas = states.omega.reshape(-1, 3)
    finite = np.isfinite(np.sum(attitudes, axis=1) + np.sum(omegas, axis=1))
    message = "Argument `motion` must have a finite state, but it has none."
    demand(bool(np.any(finite)), message)
    first = np.argmax(finite)
    return State(attitudes[first], omegas[first])


def times_of(motion: Motion, ts: AnyArray | None) -> np.ndarray:
    """The times given, or those of a trajectory [s]: one for each state."""
    shape = states_of(motion).omega.shape
    if ts is None and isinstance(motion, Trajectory):
        ts = motion.ts
    if ts is None:
        raise ValueError(
            "Argument `ts` must be given for a motion without times, but it is not."
        )
    message = "Argument `motion` must hold many states, but it is a single one."
    demand(len(shape) == 2, message)
    needed = f"Argument `ts` must be a time for each of {shape[0]} states"
    message = f"{needed}, but it has shape {np.shape(ts)}."
    demand(np.shape(ts) == shape[:1], message)
    return np.asarray(ts, float)


def turned(attitudes: AnyArray, vectors: AnyArray) -> np.ndarray:
    """Body components (..., n, 3) in space, of attitudes (..., 4)."""
    q = np.asarray(attitudes)[..., None, :]
    v = np.asarray(vectors)
    # For q = (w, u) this is v + w (2 u x v) + u x (2 u x v).
    across = 2 * np.cross(q[..., 1:], v)
    return v + q[..., :1] * across + np.cross(q[..., 1:], across)


def eye(ax: Axes3D) -> np.ndarray:
    """Direction from which axes of three dimensions are seen."""
    elevation, azimuth = np.radians([ax.elev, ax.azim])
    level = np.cos(elevation)
    return np.array(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
    )


def circles(tilts: AnyArray) -> np.ndarray:
    """Circles of latitude on the unit sphere (tilts, points, 3)."""
    polar = np.reshape(tilts, (-1, 1))
    x = np.sin(polar) * np.cos(TURN)
    y = np.sin(polar) * np.sin(TURN)
    return np.stack([x, y, np.cos(polar) + 0 * TURN], axis=-1)


def globe(ax: Axes3D, semi_axes: np.ndarray, axes: np.ndarray) -> None:
    """Draw an ellipsoid as a pale surface."""
    # `TURN` has steps of 1 degree: polar angles in steps of 4, and 5 around.
    points = circles(TURN[:181:4])[:, ::5] * semi_axes @ axes.T
    x, y, z = np.moveaxis(points, -1, 0)
    style: dict[str, Any] = {"color": "0.92", "alpha": 0.4, "lw": 0, "shade": False}
    ax.plot_surface(x, y, z, rasterized=True, **style)


def on_surface(
    ax: Axes3D, points: np.ndarray, normals: np.ndarray, **style: Any
) -> None:
    """Draw a line on a surface, full where it faces the eye and faint behind.

    It stays so when the picture is turned. A label that the axes have is not set again.
    """
    known = {line.get_label() for line in ax.lines}
    style["label"] = None if style.get("label") in known else style.get("label")
    faint = style | {"alpha": 0.25, "label": None}
    (near,) = ax.plot(*points.T, zorder=FRONT, **style)
    (far,) = ax.plot(*points.T, zorder=FRONT, **faint)

    def hide(_: object = None) -> None:
        """Show each point by one of the two lines."""
        is_near = (normals @ eye(ax) >= 0)[:, None]
        near.set_data_3d(*np.where(is_near, points, np.nan).T)
        far.set_data_3d(*np.where(is_near, np.nan, points).T)

    hide()
    # Turning a picture with the mouse sends this event.
    ax.figure.canvas.mpl_connect("motion_notify_event", hide)


def label(ax: Axes, title: str, across: str, up: str) -> None:
    """Set title and units, and a legend above the picture if anything has a label."""
    ax.set_title(title, loc="left")
    ax.set(xlabel=across, ylabel=up)
    handles = ax.get_legend_handles_labels()[0]
    if handles:
        ax.legend(
            ncols=len(handles),
            frameon=False,
            handlelength=1.4,
            columnspacing=1.0,
            loc="lower right",
            bbox_to_anchor=(1, 1),
            borderaxespad=0,
        )
