"""Mass properties of closed triangle meshes by the divergence theorem."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Int, Real

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_shape,
    float_arrays,
    is_concrete,
)
from jrigid._types import (
    Matrix,
    Scalar,
    ScalarLike,
    Vector,
)
from jrigid.mass._body import MassProperties
from jrigid.mass._points import inertia_of_second_moment, lane_sum
from jrigid.mass._surface import closed_parts, closed_traced, winds_once
from jrigid.mass._validity import ULPS, is_physical, raise_or_mark


def _mesh(vertices: Array, faces: Any) -> tuple[Any, Bool[Array, ""], np.ndarray | None]:
    """Faces, whether they are closed, and where to ask how often they wind (`closed_parts`)."""
    check_shape("vertices", vertices, (None, 3))
    if not eqx.is_array_like(faces):
        faces = np.asarray(faces)
    if is_concrete(faces):
        faces = np.asarray(faces)
    check_shape("faces", faces, (None, 3))
    if not jnp.issubdtype(faces.dtype, jnp.integer):
        raise ValueError(
            f"Argument `faces` must hold integers, but it holds {faces.dtype}: indices of vertices."
        )
    if faces.shape[0] == 0:
        raise ValueError("Argument `faces` must hold at least one face, but it is empty.")
    if isinstance(faces, np.ndarray):
        closed, samples = closed_parts(faces, vertices.shape[0])
        return faces.astype(np.int32), jnp.asarray(closed), samples
    return faces, closed_traced(faces, vertices.shape[0]), None


@jax.jit
def _mesh_integrals(vertices: Array, faces: Array) -> tuple[Scalar, Scalar, Vector, Matrix]:
    """Volume, sum of the absolute volumes of its tetrahedra, centre, second moment about it.

    The divergence theorem, as tetrahedra between the faces and an origin amid the vertices: the
    sums do not depend on it, so no derivative runs through it, and far bodies lose no digits.
    Source: Tonon, J. Math. Stat. 1 (2005) 8-11; Eberly, Polyhedral Mass Properties (2002).
    """
    # NaN in the sums would reach the gradients of the other lanes.
    vertices = jnp.where(all_finite(vertices), vertices, 0.0)
    sums = jnp.stack([lane_sum(vertices[:, i]) for i in range(3)])
    origin = jax.lax.stop_gradient(sums / vertices.shape[0])
    local = [vertices[:, i] - origin[i] for i in range(3)]
    a, b, c = ([x.at[faces[:, k]].get(mode="clip") for x in local] for k in range(3))
    six_volumes = (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
    s = [a[i] + b[i] + c[i] for i in range(3)]
    volume = lane_sum(six_volumes) / 6
    magnitude = lane_sum(jnp.abs(jax.lax.stop_gradient(six_volumes))) / 6
    first = jnp.stack([lane_sum(six_volumes * s[i]) for i in range(3)]) / 24
    second = {
        (i, j): lane_sum(six_volumes * (a[i] * a[j] + b[i] * b[j] + c[i] * c[j] + s[i] * s[j]))
        / 120
        for i in range(3)
        for j in range(i, 3)
    }
    center = first / jnp.where(volume == 0, 1.0, volume)
    matrix = jnp.stack(
        [jnp.stack([second[min(i, j), max(i, j)] for j in range(3)]) for i in range(3)]
    )
    about_center = matrix - volume * center[:, None] * center[None, :]
    return volume, magnitude, origin + center, about_center


def _judged(vertices: Array, faces: Any) -> tuple[Findings, tuple[Scalar, Vector, Matrix]]:
    """What is wrong with a mesh, and volume, centre, and tensor about it, of unit density."""
    faces, closed, samples = _mesh(vertices, faces)
    volume, magnitude, center, second = _mesh_integrals(vertices, faces)
    tensor = inertia_of_second_moment(second)
    findings = Findings()
    findings.require(
        all_finite(vertices),
        RESULTS.invalid_position,
        "Argument `vertices` must be finite, but it is not.",
    )
    findings.require(closed, RESULTS.open_mesh)
    rounding = ULPS * jnp.finfo(vertices.dtype).eps * jax.lax.stop_gradient(magnitude)
    findings.require(jax.lax.stop_gradient(volume) > rounding, RESULTS.inside_out_mesh)
    if samples is not None:
        findings.require(
            winds_once(vertices, faces, samples),
            RESULTS.inside_out_mesh,
            "Argument `faces` must describe surfaces that bound one body together, but a part is "
            "inside out or lies within another or at the same place.",
        )
    positive, triangle = is_physical(tensor)
    findings.require(
        positive & triangle,
        RESULTS.inside_out_mesh,
        "Argument `faces` must describe a surface that does not cut itself and no part of which is "
        "inside out, but the tensor is not that of a real body.",
    )
    return findings, (volume, center, tensor)


def from_mesh(
    vertices: Real[ArrayLike, "vertices 3"],
    faces: Int[ArrayLike, "faces 3"],
    density: ScalarLike = 1.0,
    *,
    throw: bool = True,
) -> MassProperties:
    """Mass properties of a homogeneous body bounded by a closed triangle mesh; exact.

    Args:
        vertices: Coordinates of the corners [m]. Corners at one place must be one vertex.
        faces: Indices of the corners of each triangle, counter-clockwise seen from outside. A
            cavity is a surface of its own, counter-clockwise seen from inside the cavity. Known
            values are checked once, at trace time; traced ones by a sort at run time, which does
            not tell surfaces apart.
        density: Density [kg/m^3], positive.
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, its tensor about the centre of mass. Accurate far from the origin too.

    Where known faces make several surfaces that share no vertex, points on both sides of each
    are asked how often all of them wind around: more than once or less than never is an error.
    This finds a surface inside out where there is no body, one within another that is no cavity,
    and one at the place of another; each point costs a solid angle a face. Of surfaces that cut
    through each other or through themselves it finds those that have one of up to 16 corners,
    spread over all of them, on the wrong side: not all. Nor are parts that share a vertex told
    apart.

    Raises:
        ValueError: Wrong shape, no faces, or indices that are no integers (trace time).
        RuntimeError: A vertex is not finite; an edge is not shared by exactly two faces that run
            through it in opposite directions (an open mesh, a flipped, repeated or degenerate
            face, an index out of range, three faces at an edge); the volume is not positive (inside
            out or flat); surfaces contradict each other, as said above; the tensor is not that of a
            real body (the surface cuts itself); the density is not positive and finite (run time,
            any lane).

    Gradients: exact in the vertices and the density.
    Source: Tonon, J. Math. Stat. 1 (2005) 8-11; Eberly, Polyhedral Mass Properties (2002).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> corners = jnp.array([[0.0, 0, 0], [6.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    >>> faces = jnp.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> body = jr.from_mesh(corners, faces)
    >>> print(body.mass, body.center_of_mass)
    1.0 [1.5  0.25 0.25]
    """
    vertices, density = float_arrays(vertices, density)
    check_shape("density", density, ())
    findings, (volume, center, tensor) = _judged(vertices, faces)
    dense = (density > 0) & jnp.isfinite(density)
    density = jnp.where(dense, density, 1.0)
    findings.require(
        dense,
        RESULTS.invalid_density,
        "Argument `density` must be positive and finite, but it is not.",
    )
    volume = jnp.where(findings.ok, volume, 1.0)  # a code may stand on a mass that is good
    values = raise_or_mark(findings, (density * volume, center, density * tensor), throw)
    return MassProperties(*values, throw=None)


def mesh_validity(
    vertices: Real[ArrayLike, "vertices 3"], faces: Int[ArrayLike, "faces 3"]
) -> RESULTS:
    """What `from_mesh` would find wrong with a mesh, as a code.

    Args:
        vertices: Coordinates of the corners [m].
        faces: Indices of the corners of each triangle.

    Returns:
        `successful`, `invalid_position`, `open_mesh` or `inside_out_mesh`, a code a lane.

    Raises:
        ValueError: Wrong shape, no faces, or indices that are no integers (trace time).

    Gradients: none, a code is no number.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> corners = jnp.array([[0.0, 0, 0], [6.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    >>> inward = jnp.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    >>> jr.mass.mesh_validity(corners, inward) == jr.RESULTS.inside_out_mesh
    Array(True, dtype=bool)
    """
    (vertices,) = float_arrays(vertices)
    return _judged(vertices, faces)[0].result  # pyright: ignore[reportReturnType]
