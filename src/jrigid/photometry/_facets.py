"""Convex bodies as flat facets: areas, normals and albedos."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from jrigid._checks import (
    all_finite,
    check_known,
    demand,
    is_concrete,
    nan_where,
    shaped,
)
from jrigid._numerics import product, safe_norm
from jrigid._types import AnyArray, Readable, Real, Scalar, Vector
from jrigid.photometry._scattering import AbstractScattering

# How far a corner may lie outside of a facet's plane, over the size of the body: shape
# files give four or five digits.
_FLAT = 1e-4
# Corners compared with planes at a time, so that large meshes need little memory.
_AT_A_TIME = 512


class Facets(Readable):
    """The surface of a convex body as small flat pieces.

    The brightness of a convex body depends on the areas and the normals of its facets
    alone; where they are does not matter.

    Attributes:
        areas: Areas [m^2], positive.
        normals: Unit vectors that point outward, body axes.
        albedo: Reflectivities; 1 for all where none are given.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> plate = jr.photometry.Facets(jnp.ones(1), jnp.array([[0.0, 0.0, 1.0]]))
    >>> print(plate.albedo)
    [1.]
    """

    areas: Float[Array, " facets"]
    normals: Float[Array, "facets 3"]
    albedo: Float[Array, " facets"]

    def __init__(
        self,
        areas: Real[ArrayLike, " facets"],
        normals: Real[ArrayLike, "facets 3"],
        albedo: Real[ArrayLike, " facets"] | None = None,
    ):
        """Raise ValueError for wrong shapes or, where they are known, wrong values."""
        albedo = np.ones(np.shape(areas)) if albedo is None else albedo
        areas, normals, albedo = shaped(
            areas=(areas, None), normals=(normals, None, 3), albedo=(albedo, None)
        )
        demand(
            len(areas) == len(normals) == len(albedo),
            "Arguments `areas`, `normals` and `albedo` must have one entry for each "
            f"facet, but they have {len(areas)}, {len(normals)} and {len(albedo)}.",
        )
        if is_concrete(areas) and is_concrete(normals):
            # Triangles of no area have no normal. NaN is left to `brightness`.
            deviations = np.abs(np.linalg.norm(normals, axis=1) - 1)
            demand(
                not np.any((areas < 0) | ((areas > 0) & (deviations > _FLAT))),
                "Arguments `areas` and `normals` must be positive and unit vectors, "
                "but they are not.",
            )
        self.areas = areas
        self.normals = normals
        self.albedo = albedo

    def brightness(
        self, scattering: AbstractScattering, to_sun: Vector, to_observer: Vector
    ) -> Scalar:
        """Sum over all facets that are lit and visible, without the phase function.

        Args:
            scattering: The law.
            to_sun: Unit vector to the Sun, body axes.
            to_observer: Unit vector to the observer, body axes.

        Returns:
            The brightness [m^2]; NaN where a direction or a normal is not finite.
        """
        cos_sun = product("fi,i->f", self.normals, to_sun)
        cos_observer = product("fi,i->f", self.normals, to_observer)
        counted = (cos_sun > 0) & (cos_observer > 0)
        # A law may be singular beyond its domain, and so may be its derivatives.
        cos_sun = jnp.where(counted, cos_sun, 1.0)
        cos_observer = jnp.where(counted, cos_observer, 1.0)
        of_area = scattering.of_area(cos_sun, cos_observer)
        total = jnp.sum(jnp.where(counted, self.albedo * self.areas * of_area, 0.0))
        # NaN is not positive and would count as dark.
        return nan_where(~all_finite((to_sun, to_observer, self.normals)), total)


def facets_from_mesh(
    vertices: Real[ArrayLike, "vertices 3"],
    faces: Int[ArrayLike, "faces 3"],
    albedo: Real[ArrayLike, " faces"] | None = None,
    *,
    hull: bool = False,
) -> Facets:
    """Areas and outward normals of the triangles of a convex mesh.

    Args:
        vertices: Coordinates of the corners [m].
        faces: Indices of the corners of each triangle, counter-clockwise seen from
            outside.
        albedo: Reflectivity of each triangle.
        hull: Take the convex hull of the corners instead of the triangles; `albedo`
            must then be None.

    Returns:
        The facets. A triangle of no area has the normal 0 and adds no light.

    Raises:
        ValueError: A mesh that is not convex (where `vertices` is known at trace time):
            its parts would cast shadows on each other. With `hull=True`, `vertices`
            that `jit` or `vmap` traces.

    Gradients: exact in the vertices; those of a hull are of the triangles at hand, and
    those in vertices inside of it are 0.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> corners = jnp.array([[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    >>> faces = jnp.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> print(jr.photometry.facets_from_mesh(corners, faces).areas.round(3))
    [0.5   0.5   0.5   0.866]
    """
    (vertices,) = shaped(vertices=(vertices, None, 3))
    faces = np.asarray(faces)
    demand(
        faces.ndim == 2
        and faces.shape[1] == 3
        and np.issubdtype(faces.dtype, np.integer),
        "Argument `faces` must hold three integers for each triangle, but it has shape "
        f"{faces.shape} and type {faces.dtype}.",
    )
    demand(
        bool(faces.size and faces.min() >= 0 and faces.max() < len(vertices)),
        f"Argument `faces` must hold indices from 0 to {len(vertices) - 1}, but it "
        "does not.",
    )
    demand(
        albedo is None or not hull,
        "Argument `albedo` must be None where `hull` is True, but it is not.",
    )
    if hull:
        # Which corners span the hull has no derivative.
        known = jax.lax.stop_gradient(vertices)
        check_known("vertices", known)
        faces = hull_of(np.asarray(known))
    areas, normals = _areas_and_normals(vertices, faces)
    if is_concrete(vertices) and not hull:
        _demand_convex(np.asarray(vertices)[faces], np.asarray(normals))
    return Facets(areas, normals, albedo)


@jax.jit  # outside of jit each operation is a program of its own
def _areas_and_normals(
    vertices: Float[Array, "vertices 3"], faces: Int[AnyArray, "faces 3"]
) -> tuple[Float[Array, " faces"], Float[Array, "faces 3"]]:
    """Areas and outward normals of triangles."""
    corners = vertices[faces]
    across = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = safe_norm(across)
    return twice / 2, across / jnp.where(twice > 0, twice, 1.0)[:, None]


def hull_of(vertices: np.ndarray) -> np.ndarray:
    """Triangles of the convex hull, counter-clockwise seen from outside."""
    # Imported where it is used: scipy would add a second to `import jrigid`.
    from scipy.spatial import ConvexHull

    found = ConvexHull(vertices)
    faces = found.simplices.copy()
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    # Qhull lists the corners of a triangle in either order.
    # The first three columns of its equations are outward normals.
    inward = np.einsum("fi,fi->f", np.cross(b - a, c - a), found.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return faces


def _demand_convex(corners: np.ndarray, normals: np.ndarray) -> None:
    """Raise ValueError unless all corners lie behind the planes of all triangles."""
    # Vertices that no triangle has are not a part of the body.
    used = np.unique(corners.reshape(-1, 3), axis=0)
    size = np.max(np.ptp(used, axis=0))
    for first in range(0, len(normals), _AT_A_TIME):
        part = slice(first, first + _AT_A_TIME)
        offsets = np.sum(normals[part] * corners[part, 0], axis=1, keepdims=True)
        beyond = np.max(normals[part] @ used.T - offsets, axis=1) / size
        worst = int(np.argmax(beyond))
        demand(
            bool(beyond[worst] < _FLAT),
            "Argument `vertices` must be those of a convex body, but a corner lies "
            f"{100 * beyond[worst]:.2g} % of the size outside of triangle "
            f"{first + worst}: it casts shadows; `hull=True` takes the hull.",
        )


def as_unit(vector: Any) -> Array:
    """A vector divided by its length."""
    return vector / safe_norm(vector)
