"""Mass properties of closed triangle meshes by the divergence theorem."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Int

from jrigid._checks import Findings, check_shape, harmless, is_concrete, shaped
from jrigid._types import Matrix, Real, Scalar, ScalarLike, Vector
from jrigid.mass._axes import ULPS, inertia_of_second_moment, is_physical
from jrigid.mass._body import MassProperties
from jrigid.mass._points import PAIRS, lane_sum, symmetric

_OPEN = (
    "Argument `faces` must describe a closed surface in which every edge is shared "
    "by two faces that run through it in opposite directions, but an edge is not."
)
_INSIDE_OUT = (
    "Argument `faces` must be ordered counter-clockwise seen from outside, enclosing "
    "a positive volume, but the enclosed volume is not positive: the mesh is inside "
    "out or flat."
)
_CUTS_ITSELF = (
    "Argument `faces` must describe a surface that does not cut itself and no part "
    "of which is inside out, but the tensor is not that of a real body."
)


def is_closed(faces: Int[np.ndarray, "faces 3"], vertices: int) -> bool:
    """Whether known faces run through each edge once forth and once back."""
    faces = faces.astype(np.int64)
    if faces.min() < 0 or faces.max() >= vertices:
        return False
    start, end = faces.T.ravel(), np.roll(faces, -1, axis=1).T.ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    edges = np.sort(2 * (low * vertices + high) + (start > end))
    forth, back = edges[::2], edges[1::2]
    # Sorted, every edge once forth and once back leaves no room for a third run or a
    # point.
    return not (edges.size % 2 or np.any(forth % 2) or np.any(back != forth + 1))


def _why_open(faces: Int[np.ndarray, "faces 3"], vertices: int) -> str:
    """What may have left faces open, and what mends it."""
    least, most = faces.min(), faces.max()
    if least < 0 or most >= vertices:
        return (
            f" (Indices count from 0 to {vertices - 1} here, but they go from {least} "
            f"to {most}.)"
        )
    if np.unique(faces).size == faces.size:
        return (
            " (No two faces share a vertex, as in an STL file. This merges them: "
            "`vertices, same = np.unique(vertices, axis=0, return_inverse=True)`, "
            "`faces = same.ravel()[faces]`.)"
        )
    runs = faces.astype(np.int64) * vertices + np.roll(faces, -1, axis=1)
    if np.unique(runs).size < runs.size:
        return (
            " (A face is there twice or flipped: `trimesh.repair.fix_winding` turns "
            "it.)"
        )
    return " (A face is missing, or vertices at one place are not merged.)"


def is_closed_traced(faces: Int[Array, "faces 3"], vertices: int) -> Bool[Array, ""]:
    """As `is_closed`, at run time."""
    if faces.shape[0] % 2:
        return jnp.asarray(False)
    start, end = faces.T.ravel(), jnp.roll(faces, -1, axis=1).T.ravel()
    # Keys stay apart: their product overflows int32.
    keys = (
        jnp.minimum(start, end),
        jnp.maximum(start, end),
        (start > end).astype(start.dtype),
    )
    low, high, back = jax.lax.sort(keys, num_keys=3)
    same = (low[::2] == low[1::2]) & (high[::2] == high[1::2])
    alternate = (back[::2] == 0) & (back[1::2] == 1)
    inside = jnp.all((faces >= 0) & (faces < vertices))
    return inside & jnp.all(same & alternate)


def _index_array(faces: Any) -> Any:
    """Faces as numpy's array if they are known, or ValueError."""
    if is_concrete(faces) or not eqx.is_array_like(faces):
        faces = np.asarray(faces)
    check_shape("faces", faces, (None, 3))
    if not jnp.issubdtype(faces.dtype, jnp.integer):
        raise ValueError(
            f"Argument `faces` must hold integers, but it holds {faces.dtype}: "
            "indices of vertices."
        )
    if faces.shape[0] == 0:
        raise ValueError(
            "Argument `faces` must hold at least one face, but it is empty."
        )
    return faces.astype(np.int32) if isinstance(faces, np.ndarray) else faces


@jax.jit
def _mesh_integrals(
    vertices: Array, faces: Array
) -> tuple[Scalar, Scalar, Vector, Matrix]:
    """Volume, sum of the absolute volumes of its tetrahedra, centre, tensor about it.

    The divergence theorem, as tetrahedra between the faces and an origin amid the
    vertices: the sums do not depend on it, so no derivative runs through it, and far
    bodies lose no digits.
    Source: Tonon, J. Math. Stat. 1 (2005) 8-11; Eberly, Polyhedral Mass Properties
    (2002).
    """
    sums = jnp.stack([lane_sum(vertices[:, i]) for i in range(3)])
    origin = jax.lax.stop_gradient(sums / vertices.shape[0])
    local = [vertices[:, i] - origin[i] for i in range(3)]
    a, b, c = ([x.at[faces[:, k]].get(mode="clip") for x in local] for k in range(3))
    six_volumes: Any = sum(
        a[i] * (b[i - 2] * c[i - 1] - b[i - 1] * c[i - 2]) for i in range(3)
    )
    s = [a[i] + b[i] + c[i] for i in range(3)]
    volume = lane_sum(six_volumes) / 6
    magnitude = lane_sum(jnp.abs(jax.lax.stop_gradient(six_volumes))) / 6
    first = jnp.stack([lane_sum(six_volumes * s[i]) for i in range(3)]) / 24
    second = symmetric(
        lane_sum(six_volumes * (a[i] * a[j] + b[i] * b[j] + c[i] * c[j] + s[i] * s[j]))
        / 120
        for i, j in PAIRS
    )
    center = first / jnp.where(volume == 0, 1.0, volume)
    about_center = second - volume * center[:, None] * center[None, :]
    return volume, magnitude, origin + center, inertia_of_second_moment(about_center)


def from_mesh(
    vertices: Real[ArrayLike, "vertices 3"],
    faces: Int[ArrayLike, "faces 3"],
    density: ScalarLike = 1.0,
    *,
    throw: bool = True,
) -> MassProperties:
    """Mass properties of a homogeneous body bounded by a closed triangle mesh; exact.

    Surfaces that close each for itself are taken at their word: a cavity is a surface
    turned inward, and where surfaces overlap or one is inside out outside of the others
    (a part mirrored by its program) their masses add or subtract. Programs that repair
    meshes join them.

    Args:
        vertices: Coordinates of the corners [m]. Corners at one place must be one
            vertex.
        faces: Indices of the corners of each triangle, counter-clockwise seen from
            outside, in a cavity seen from inside the cavity. Known values are checked
            once, at trace time; traced ones by a sort at run time.
        density: Density [kg/m^3], positive.
        throw: False: a bad value makes the body of its lane NaN instead of an error.

    Returns:
        The body, its tensor about the centre of mass. Accurate far from the origin too.

    Raises:
        ValueError: No faces, or indices that are no integers.
        RuntimeError: A vertex is not finite; an edge is not shared by exactly two faces
            that run through it in opposite directions (an open mesh, a flipped,
            repeated or degenerate face, an index out of range, three faces at an edge);
            the volume is not positive (inside out or flat); the tensor is not that of a
            real body (the surface cuts itself); the density is not positive and finite.

    Gradients: exact in the vertices and the density.
    Source: Tonon, J. Math. Stat. 1 (2005) 8-11; Eberly, Polyhedral Mass Properties
    (2002).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> corners = jnp.array([[0.0, 0, 0], [6.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    >>> faces = jnp.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> body = jr.from_mesh(corners, faces)
    >>> print(body.mass, body.center_of_mass)
    1.0 [1.5  0.25 0.25]
    """
    vertices, density = shaped(vertices=(vertices, None, 3), density=(density,))
    indices = _index_array(faces)
    known, findings = isinstance(indices, np.ndarray), Findings()
    closed: Any = (is_closed if known else is_closed_traced)(indices, vertices.shape[0])
    finite = jnp.all(jnp.isfinite(vertices), axis=1)
    message = "Argument `vertices` must be finite, but it is not."
    findings.require(jnp.all(finite), None, message, vertices[jnp.argmin(finite)])
    message = "Argument `density` must be positive and finite, but it is not."
    findings.require((density > 0) & jnp.isfinite(density), None, message, density)
    why = _why_open(indices, vertices.shape[0]) if known and not closed else ""
    findings.require(jnp.asarray(closed), None, _OPEN + why)
    vertices, density = harmless(findings.ok, (vertices, density))
    volume, magnitude, center, tensor = _mesh_integrals(vertices, indices)
    rounding = ULPS * jnp.finfo(volume.dtype).eps * magnitude
    findings.require(jax.lax.stop_gradient(volume) > rounding, None, _INSIDE_OUT)
    positive, triangle = is_physical(tensor)
    findings.require(positive & triangle, None, _CUTS_ITSELF)
    body = MassProperties.unchecked(density * volume, center, density * tensor)
    return findings.guard(body, throw)
