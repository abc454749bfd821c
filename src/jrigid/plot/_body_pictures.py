"""A body in space: a mesh, a top, or the box or ellipsoid of the same inertia."""

from typing import Any, NamedTuple

import numpy as np

from jrigid._checks import check_option, demand, kind_of
from jrigid._types import AnyArray
from jrigid.dynamics import State
from jrigid.mass import from_mesh
from jrigid.plot import _drawing as common
from jrigid.plot._drawing import Axes3D, Body
from jrigid.top import SymmetricTop

_LIGHT = np.array([0.36, 0.48, 0.8])  # where it comes from
# Brightness of faces in the dark, by that light and by one that is given.
_DARK = 0.5
_NIGHT = 0.15
_FLAT = 1e-6  # least square of a side, of the largest
# Radius and height along a top's outline, from its tip, in units of its height.
_TOP = np.array(
    [[0.03, 0.4, 0.44, 0.36, 0.05, 0.04, 1e-3], [0, 0.45, 0.55, 0.64, 0.7, 0.98, 1]]
)
_SIDES = 16
# At a pole itself two corners of a face would coincide, and it would have no normal.
_POLAR = np.linspace(np.pi - 1e-3, 1e-3, 13)  # along the outline of a ball
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
# Corner 4 i + 2 j + k has the signs i, j, k of x, y, z. Each four of these digits are a
# face, counter-clockwise from outside.
_QUADS = np.array([int(x) for x in "013246750451237602641573"]).reshape(6, 4)


class Surface(NamedTuple):
    """Surface that is drawn for a body, with its farthest corner at 1.

    Attributes:
        vertices: Corners, body components (n, 3).
        faces: The corners of each face (m, 3 or 4), counter-clockwise from outside.
        normals: Of the faces, outward (m, 3).
        kinds: Which colour each face has (m,).
        lines: What of each principal axis sticks out, from its inner to its outer end
            (3, 2, 3).
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    kinds: np.ndarray
    lines: np.ndarray

    def colours(
        self, attitude: AnyArray, light: np.ndarray | None = None
    ) -> np.ndarray:
        """Colours of the faces of a turned body, with light and shade (m, 3)."""
        from matplotlib.colors import to_rgb

        base = np.array([to_rgb(colour) for colour, _ in common.LOOKS])[self.kinds]
        direction = _LIGHT if light is None else light
        dark = _DARK if light is None else _NIGHT
        cosines = common.turned(attitude, self.normals) @ direction
        bright = dark + (1 - dark) * np.maximum(cosines, 0)
        return bright[:, None] * (0.55 * base + 0.45)


def rings(
    radii: np.ndarray, heights: np.ndarray, sides: int
) -> tuple[np.ndarray, np.ndarray]:
    """Corners and faces, four corners each, of a body of revolution."""
    turn = 2 * np.pi * np.arange(sides) / sides
    x = np.outer(radii, np.cos(turn))
    y = np.outer(radii, np.sin(turn))
    z = np.outer(heights, np.ones(sides))
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    row, k = np.meshgrid(
        np.arange(radii.size - 1) * sides, np.arange(sides), indexing="ij"
    )
    after = (k + 1) % sides
    corners = [row + k, row + after, row + sides + after, row + sides + k]
    return vertices, np.stack(corners, axis=-1).reshape(-1, 4)


_BALL = rings(np.sin(_POLAR), np.cos(_POLAR), 24)


class _Outline(NamedTuple):
    """A body before it is scaled.

    Attributes:
        vertices: Corners, body components (n, 3).
        faces: The corners of each face.
        center: From which the principal axes stick out.
        axes: Principal axes in columns.
        sides: How far the body reaches along each of them.
    """

    vertices: np.ndarray
    faces: np.ndarray
    center: np.ndarray
    axes: np.ndarray
    sides: np.ndarray


def _of_top() -> _Outline:
    """A top that stands on its tip."""
    vertices, faces = rings(_TOP[0], _TOP[1], _SIDES)
    radius = _TOP[0, 2]
    # Then the third axis leaves the top at its upper end, and the others leave it near
    # the widest ring.
    center = np.array([0, 0, 1 - radius])
    return _Outline(vertices, faces, center, np.eye(3), np.full(3, radius))


def _of_mesh(mesh: tuple[AnyArray, AnyArray]) -> _Outline:
    """A mesh where it is, with the principal axes of the solid."""
    vertices = np.asarray(mesh[0], float)
    faces = np.asarray(mesh[1])
    solid = from_mesh(vertices, faces)
    center = np.asarray(solid.center_of_mass)
    _, axes = common.principal(solid)
    sides = np.max(np.abs((vertices - center) @ axes), axis=0)
    return _Outline(vertices, faces, center, axes, sides)


def _of_inertia(body: Body, kind: str) -> _Outline:
    """The box or ellipsoid that has an inertia, up to a factor."""
    moments, axes = common.principal(body)
    # Second moments of the mass: of a box and of an ellipsoid they go as the squares of
    # the sides.
    squares = np.sum(moments) / 2 - moments
    sides = np.sqrt(np.maximum(squares, _FLAT * np.max(squares)))
    vertices, faces = (_CORNERS, _QUADS) if kind == "box" else _BALL
    # From principal to body components, of vectors in rows.
    return _Outline(vertices * sides @ axes.T, faces, np.zeros(3), axes, sides)


def _is_mesh(body: Body) -> bool:
    """Whether a body is given as (vertices, faces)."""
    return isinstance(body, tuple) and len(body) == 2


def surface_of(body: Any, kind: str) -> Surface:
    """The surface of a mesh, of a top, or of the box or ellipsoid with an inertia."""
    check_option("kind", kind, ("box", "ellipsoid"))
    if isinstance(body, SymmetricTop):
        outline = _of_top()
    elif _is_mesh(body):
        outline = _of_mesh(body)
    else:
        outline = _of_inertia(body, kind)
    vertices, faces, center, axes, sides = outline
    size = np.max(np.linalg.norm(vertices, axis=1))
    # Three corners of a face give its plane.
    first, second, third = np.moveaxis(vertices[faces[:, :3]], 1, 0)
    normals = np.cross(second - first, third - first)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals /= np.maximum(lengths, np.finfo(float).tiny)
    # Faces have the colour of the principal axis that is nearest to their normal.
    kinds = np.argmax(np.abs(normals @ axes), axis=1)
    reaches = np.stack([sides / size, sides / size + 0.25], axis=1)
    ends = reaches[..., None] * axes.T[:, None]
    return Surface(vertices / size, faces, normals, kinds, center / size + ends)


def body(
    body: Body,
    attitude: AnyArray | State | tuple[float, ...] = (1.0, 0, 0, 0),
    *,
    ax: Axes3D | None = None,
    kind: str = "box",
) -> Axes3D:
    """Draw a body with its principal axes.

    Args:
        body: A mesh (vertices, faces) as for `from_mesh`, drawn about the origin of its
            vertices; a `SymmetricTop`, drawn as one, standing on its tip; or whatever
            has an inertia, drawn as the homogeneous box or ellipsoid that has it (as
            thin as a sheet where none has).
        attitude: Quaternion, or a state.
        ax: Axes of three dimensions.
        kind: "box" or "ellipsoid".

    Returns:
        The axes; the farthest corner is at 1.

    Raises:
        ImportError: Without the extra `jrigid[plot]`.
        ValueError: Axes of two dimensions, or no such kind.
        RuntimeError: A mesh that is not closed.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> book = jr.solids.box(0.6, jnp.array([0.13, 0.2, 0.03]))
    >>> print(jr.plot.body(book).get_title())
    Box of the same inertia
    I = 0.00089, 0.00205, 0.00285 kg m$^2$
    """
    is_state = isinstance(attitude, common.Rotating)
    quaternion = np.asarray(attitude.attitude if is_state else attitude)
    needed = "Argument `attitude` must be one quaternion or State"
    demand(quaternion.shape == (4,), f"{needed}, but it is {kind_of(attitude)}.")
    surface = surface_of(body, kind)
    space = common.space_axes(ax, 1.1)
    place(space, surface, quaternion)
    space.set_title(_title(body, kind))
    return space


def _title(body: Body, kind: str) -> str:
    """Title: what kind of body is drawn, and its moments unless it is a mesh."""
    if _is_mesh(body):
        return "Mesh"
    if isinstance(body, SymmetricTop):
        name = "Top"
        moments = np.diag(common.tensor_of(body))
    else:
        name = f"{kind.capitalize()} of the same inertia"
        moments, _ = common.principal(body)
    return "{}\nI = {:.3g}, {:.3g}, {:.3g} kg m$^2$".format(name, *moments)


def place(
    ax: Axes3D, surface: Surface, attitude: AnyArray, light: np.ndarray | None = None
) -> list[Any]:
    """Draw a surface and its axes as they are turned; returns the artists."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    corners = common.turned(attitude, surface.vertices)[surface.faces]
    colours = surface.colours(attitude, light)
    faces = Poly3DCollection(
        corners, facecolors=colours, edgecolors=0.7 * colours, lw=0.4
    )
    artists: list[Any] = [ax.add_collection3d(faces)]
    for name, line in zip("123", common.turned(attitude, surface.lines), strict=True):
        # An axis that points away from the eye is behind everything.
        front = common.FRONT * ((line[1] - line[0]) @ common.eye(ax) > 0)
        artists += ax.plot(*line.T, color="k", lw=1, zorder=front)
        artists.append(ax.text(*(1.2 * line[1] - 0.2 * line[0]), name, zorder=front))
    return artists
