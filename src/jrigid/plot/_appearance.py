"""A body as the observer sees it, lit by the Sun."""

from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from jrigid._checks import check_shape, demand, kind_of
from jrigid._types import AnyArray, VectorLike
from jrigid.dynamics import State
from jrigid.photometry import (
    AbstractScattering,
    Ellipsoid,
    Facets,
    LommelSeeliger,
    Tumbler,
    mesh_from_facets,
)
from jrigid.plot._body_pictures import rings
from jrigid.plot._drawing import Axes, Rotating, flat_axes, turned
from jrigid.plot._tumbler_pictures import attitudes_at

Mesh: TypeAlias = tuple[AnyArray, AnyArray]

_ROWS = 40  # of faces from pole to pole of an ellipsoid
_DARK = 0.13  # grey of what is not lit
_REACH = 1.45  # of the picture, where the farthest corner is at 1
_BEYOND = 0.22  # of the principal axes
_SUN = "#E69F00"  # Okabe and Ito's orange
# Cosine below which a face is not drawn: its brightness on the sky divides by it.
_EDGE_ON = 1e-9
_ALONG = 0.05  # sine of the angle between Sun and observer


class Outline(NamedTuple):
    """Corners of a body and its faces.

    Attributes:
        vertices: Corners, body axes (n, 3), the farthest at 1.
        faces: The corners of each face (m, 3 or 4), counter-clockwise from outside.
    """

    vertices: np.ndarray
    faces: np.ndarray


def appearance(
    body: Tumbler | Ellipsoid | Mesh,
    to_sun: VectorLike,
    to_observer: VectorLike,
    attitude: AnyArray | State | tuple[float, ...] | None = None,
    *,
    time: float = 0.0,
    mesh: Mesh | None = None,
    scattering: AbstractScattering | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a body as the observer sees it, lit by the Sun.

    The grey of each face is its brightness by the scattering law, over that of the
    brightest one. What is not lit is nearly black, and nothing casts a shadow. The
    third axis of space (the ecliptic's north for files of DAMIT) is up, and longitudes
    increase to the left, as on the sky. A line points towards the Sun, and principal
    axes that point towards the observer stick out.

    Args:
        body: A `Tumbler`; or an `Ellipsoid`, or a mesh (vertices, faces) in principal
            axes, with an attitude.
        to_sun: Vector from the body to the Sun, space axes.
        to_observer: Vector from the body to the observer, space axes.
        attitude: Quaternion or state; of a `Tumbler` none.
        time: Of a `Tumbler`, since its time 0 [s].
        mesh: Of a `Tumbler` with `Facets`, vertices and faces to draw in place of the
            convex body that has these facets.
        scattering: The law, `LommelSeeliger()` if None; of a `Tumbler` its own.
        ax: Axes.

    Returns:
        The axes; the farthest corner is at most 1 from the middle.

    Raises:
        ImportError: Without the extra `jrigid[plot]`.
        ValueError: Facets that do not close, a body without an attitude, or vectors of
            another shape.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> shape = jr.photometry.Ellipsoid(jnp.array([1.0, 0.7, 0.5]))
    >>> x, y = jnp.eye(3)[:2]
    >>> ax = jr.plot.appearance(shape, x, x + y, (1.0, 0.0, 0.0, 0.0))
    >>> print(ax.get_title(loc="left"))
    phase angle 45 degrees
    """
    sun = _unit("to_sun", to_sun)
    observer = _unit("to_observer", to_observer)
    outline = outline_of(body, mesh)
    quaternion = _attitude_of(body, attitude, time)
    law = LommelSeeliger() if scattering is None else scattering
    if isinstance(body, Tumbler):
        law = body.scattering
    sky = sky_axes(observer)
    ax = flat_axes(ax)
    _draw_faces(ax, outline, quaternion, sky, sun, law)
    _draw_axes(ax, outline, quaternion, sky)
    _draw_sun(ax, sky @ sun)
    limits = (-_REACH, _REACH)
    ax.set(xlim=limits, ylim=limits, aspect="equal")
    ax.set_axis_off()
    # Rounding may take the product of two unit vectors beyond 1.
    angle = np.degrees(np.arccos(np.clip(sun @ observer, -1, 1)))
    ax.set_title(f"phase angle {angle:.0f} degrees", loc="left")
    return ax


def outline_of(body: Tumbler | Ellipsoid | Mesh, mesh: Mesh | None) -> Outline:
    """Corners and faces of a body."""
    shape = body.shape if isinstance(body, Tumbler) else body
    shape = shape if mesh is None else mesh
    if isinstance(shape, Facets):
        shape = mesh_from_facets(shape)
    if isinstance(shape, Ellipsoid):
        # At a pole itself two corners of a face would coincide, and it would have no
        # normal.
        polar = np.linspace(np.pi - 1e-3, 1e-3, _ROWS + 1)
        ball, faces = rings(np.sin(polar), np.cos(polar), 2 * _ROWS)
        vertices = ball * np.asarray(shape.semi_axes)
    else:
        vertices = np.asarray(shape[0], float)
        faces = np.asarray(shape[1])
    return Outline(vertices / np.max(np.linalg.norm(vertices, axis=1)), faces)


def sky_axes(observer: np.ndarray) -> np.ndarray:
    """Directions right, up and towards the observer, in rows."""
    north = np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(np.cross(north, observer)) < 1e-6:
        # Seen along the third axis, north has no direction on the sky.
        north = np.array([0.0, 1.0, 0.0])
    right = np.cross(north, observer)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(observer, right), observer])


def _unit(name: str, vector: VectorLike) -> np.ndarray:
    """A vector over its length."""
    array = np.asarray(vector, float)
    check_shape(name, array, (3,))
    length = np.linalg.norm(array)
    message = f"Argument `{name}` must be a finite vector other than 0, but it is not."
    demand(bool(np.isfinite(length) and length > 0), message)
    return array / length


def _attitude_of(
    body: Tumbler | Ellipsoid | Mesh,
    attitude: AnyArray | State | tuple[float, ...] | None,
    time: float,
) -> np.ndarray:
    """The quaternion of a body."""
    if isinstance(body, Tumbler):
        message = "Argument `attitude` must be left out for a `Tumbler`, but it is not."
        demand(attitude is None, message)
        return attitudes_at(body, np.array([time]))[0]
    given = attitude.attitude if isinstance(attitude, Rotating) else attitude
    quaternion = np.asarray(given, float)
    needed = "Argument `attitude` must be one quaternion or State"
    demand(quaternion.shape == (4,), f"{needed}, but it is {kind_of(attitude)}.")
    return quaternion


def _draw_faces(
    ax: Axes,
    outline: Outline,
    attitude: np.ndarray,
    sky: np.ndarray,
    sun: np.ndarray,
    law: AbstractScattering,
) -> None:
    """Draw the faces that are seen, the far ones first."""
    from matplotlib.collections import PolyCollection

    # In the axes right, up and towards the observer, of which the third is the depth.
    corners = (turned(attitude, outline.vertices) @ sky.T)[outline.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(across, axis=1)
    normals = across / np.maximum(lengths, np.finfo(float).tiny)[:, None]
    to_observer = normals[:, 2]
    seen = np.flatnonzero(to_observer > _EDGE_ON)
    seen = seen[np.argsort(np.mean(corners[seen, :, 2], axis=1))]
    to_sun = normals[seen] @ (sky @ sun)
    light = _surface_brightness(law, to_sun, to_observer[seen])
    greys = np.where(to_sun > 0, _DARK + (1 - _DARK) * light, _DARK)
    colours = np.repeat(greys[:, None], 3, axis=1)
    # Edges of the same colour cover the seams between neighbouring faces.
    faces = PolyCollection(
        list(corners[seen, :, :2]), facecolors=colours, edgecolors=colours, lw=0.5
    )
    ax.add_collection(faces)


def _surface_brightness(
    law: AbstractScattering, to_sun: np.ndarray, to_observer: np.ndarray
) -> np.ndarray:
    """Brightness of a unit of area on the sky, over the largest; 0 where not lit."""
    lit = to_sun > 0
    # A law may be singular outside of its domain.
    cos_sun = jnp.asarray(np.where(lit, to_sun, 1.0))
    of_area = jax.vmap(law.of_area)(cos_sun, jnp.asarray(to_observer))
    # A piece of surface covers this cosine times its area on the sky.
    light = np.where(lit, np.asarray(of_area) / to_observer, 0.0)
    # If nothing is lit, this is 0 over a small number and not over 0.
    return light / max(float(np.max(light, initial=0.0)), np.finfo(float).tiny)


def _draw_axes(
    ax: Axes, outline: Outline, attitude: np.ndarray, sky: np.ndarray
) -> None:
    """Draw principal axes, of which the ends that point away are behind the body."""
    # The outline is in principal axes, which leave it near its largest coordinates.
    reach = np.max(np.abs(outline.vertices), axis=0)
    ends = turned(attitude, np.diag(reach + _BEYOND)) @ sky.T
    starts = turned(attitude, np.diag(reach)) @ sky.T
    for name, start, end in zip("123", starts, ends, strict=True):
        # Collections of matplotlib, as that of the faces, have zorder 1.
        style: dict[str, Any] = {"color": "#0072B2", "zorder": 3 if end[2] > 0 else 0}
        ax.plot([start[0], end[0]], [start[1], end[1]], lw=1.2, **style)
        ax.text(1.1 * end[0], 1.1 * end[1], name, ha="center", va="center", **style)


def _draw_sun(ax: Axes, direction: np.ndarray) -> None:
    """Draw a line towards the Sun, unless it is along the line of sight."""
    length = np.hypot(direction[0], direction[1])
    if length < _ALONG:
        return
    across = direction[:2] / length
    inner = 1.1 * across
    outer = 1.25 * across
    ax.plot([inner[0], outer[0]], [inner[1], outer[1]], color=_SUN, lw=2.5)
    # Beside the line, the text must not run back over it.
    side = {-1: "right", 0: "center", 1: "left"}[round(across[0])]
    where = 1.32 * across
    ax.text(where[0], where[1], "Sun", color=_SUN, ha=side, va="center")
