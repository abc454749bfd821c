"""Mass properties of closed triangle meshes by the divergence theorem."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Int

from jrigid._checks import Findings, check_shape, harmless, is_concrete, shaped
from jrigid._types import AnyArray, Matrix, Real, Scalar, ScalarLike, Vector
from jrigid.mass._axes import ULPS, inertia_of_second_moment, is_physical
from jrigid.mass._mass_body import MassProperties
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
    start = faces.T.ravel()
    end = np.roll(faces, -1, axis=1).T.ravel()
    low = np.minimum(start, end)
    high = np.maximum(start, end)
    # One integer for each run along an edge: even forth, the next odd one back.
    runs = np.sort(2 * (low * vertices + high) + (start > end))
    if runs.size % 2:
        return False
    forth = runs[::2]
    back = runs[1::2]
    # A third run along an edge, or an edge from a vertex to itself, spoils a pair.
    return bool(np.all(forth % 2 == 0) and np.all(back == forth + 1))


def _why_open(faces: Int[np.ndarray, "faces 3"], vertices: int) -> str:
    """Say what may have left faces open, and what mends it."""
    least = faces.min()
    most = faces.max()
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
    """Whether faces run through each edge once forth and once back, at run time."""
    # Three edges a face and two faces an edge make the number of faces even.
    if faces.shape[0] % 2:
        return jnp.asarray(False)
    start = faces.T.ravel()
    end = jnp.roll(faces, -1, axis=1).T.ravel()
    # Three keys instead of one integer, which would overflow int32.
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


def _closed(faces: AnyArray, vertices: int) -> tuple[Bool[Array, ""], str]:
    """Whether faces are closed; if they are known and are not, the reason."""
    if not isinstance(faces, np.ndarray):
        return is_closed_traced(faces, vertices), ""
    if is_closed(faces, vertices):
        return jnp.asarray(True), ""
    return jnp.asarray(False), _why_open(faces, vertices)


def _index_array(faces: AnyArray) -> AnyArray:
    """Convert known faces to an array of numpy, or raise ValueError."""
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
    if isinstance(faces, np.ndarray):
        # A larger index stays one that no vertex has.
        return np.clip(faces, -1, np.iinfo(np.int32).max).astype(np.int32)
    return faces


def _triple_product(a: list[Array], b: list[Array], c: list[Array]) -> Array:
    """Components of a . (b x c), summed."""
    x = a[0] * (b[1] * c[2] - b[2] * c[1])
    y = a[1] * (b[2] * c[0] - b[0] * c[2])
    z = a[2] * (b[0] * c[1] - b[1] * c[0])
    return x + y + z


@jax.jit
def _mesh_integrals(
    vertices: Array, faces: Array
) -> tuple[Scalar, Scalar, Vector, Matrix]:
    """Volume, sum of the absolute volumes of its tetrahedra, centre, tensor about it.

    By the divergence theorem: each face makes a tetrahedron with an origin amid the
    vertices.
    Source: Tonon, J. Math. Stat. 1 (2005) 8-11; Eberly, Polyhedral Mass Properties
    (2002).
    """
    sums = jnp.stack([lane_sum(vertices[:, i]) for i in range(3)])
    # The sums do not depend on the origin, so it has no derivative. It is amid the
    # vertices so that bodies far away lose no digits.
    origin = jax.lax.stop_gradient(sums / vertices.shape[0])
    local = [vertices[:, i] - origin[i] for i in range(3)]

    def corners(k: int) -> list[Array]:
        # One array for each component, as the sums over lanes take them.
        return [x.at[faces[:, k]].get(mode="clip") for x in local]

    a = corners(0)
    b = corners(1)
    c = corners(2)
    # Six times the volume of each tetrahedron, negative where the face looks towards
    # the origin.
    six_volumes = _triple_product(a, b, c)
    s = [a[i] + b[i] + c[i] for i in range(3)]

    def second_moment(i: int, j: int) -> Scalar:
        # The integral of r r^T over a tetrahedron with a corner at 0 is a twentieth of
        # its volume times this; 120 is 6 times 20.
        squares = a[i] * a[j] + b[i] * b[j] + c[i] * c[j] + s[i] * s[j]
        return lane_sum(six_volumes * squares) / 120

    volume = lane_sum(six_volumes) / 6
    # Volumes of both signs cancel in the sum, so its rounding is measured by that of
    # the magnitudes.
    magnitude = lane_sum(jnp.abs(jax.lax.stop_gradient(six_volumes))) / 6
    # The centre of a tetrahedron is at s / 4; 24 is 6 times 4.
    first = jnp.stack([lane_sum(six_volumes * s[i]) for i in range(3)]) / 24
    second = symmetric(second_moment(i, j) for i, j in PAIRS)
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

    The mesh may consist of several closed surfaces. A surface that is turned inward is
    a cavity: its mass is subtracted wherever it lies, also if a program has mirrored a
    part by mistake. Where surfaces overlap their masses add. Programs that repair
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
    findings = Findings()
    finite = jnp.all(jnp.isfinite(vertices), axis=1)
    message = "Argument `vertices` must be finite, but it is not."
    findings.require(jnp.all(finite), None, message, vertices[jnp.argmin(finite)])
    message = "Argument `density` must be positive and finite, but it is not."
    findings.require((density > 0) & jnp.isfinite(density), None, message, density)
    closed, why = _closed(indices, vertices.shape[0])
    findings.require(closed, None, _OPEN + why)
    vertices, density = harmless(findings.ok, (vertices, density))
    volume, magnitude, center, tensor = _mesh_integrals(vertices, indices)
    rounding = ULPS * jnp.finfo(volume.dtype).eps * magnitude
    findings.require(jax.lax.stop_gradient(volume) > rounding, None, _INSIDE_OUT)
    # Parts of negative volume can leave a positive volume, but also a second moment
    # that no mass has.
    is_positive, obeys_triangle = is_physical(tensor)
    findings.require(is_positive & obeys_triangle, None, _CUTS_ITSELF)
    body = MassProperties.unchecked(density * volume, center, density * tensor)
    return findings.guard(body, throw)
