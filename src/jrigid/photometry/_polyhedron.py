"""The convex body of given facets: Minkowski's problem.

The areas and outward normals of the facets determine a convex polyhedron, but for where
it is. Its planes are at distances h from a point within. The function

    sum of A_f h_f - log V(h),

with the areas A that are wanted and the volume V of the body between the planes, is
convex in h, and its slope is A - a / V with the areas a of that body. At its minimum
these are the areas that are wanted, up to a factor. Newton's method finds it. Its steps
are so short that no facet vanishes.

Source: J. J. Little, Proc. 1st Symp. Computational Geometry (1985) 110, has a function
with the same minimum; R. Schneider, Convex Bodies: The Brunn-Minkowski Theory, chapter
5, the second derivatives of the volume; J. Kitagawa, Q. Merigot and B. Thibert, J. Eur.
Math. Soc. 21 (2019) 2603, the length of the steps.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jrigid._checks import check_known, demand
from jrigid.photometry._facets import Facets, hull_of

# Areas may fail to close by this part of their sum. Areas that were fitted to light
# do by 1 %.
MOST_OPEN = 0.1
# Normals that differ by less are one: coplanar triangles of a mesh.
_COPLANAR = 1e-7
_SAME = 1e-9  # corners nearer to each other, over the size of the body, are one
# Least mean square of the normals along any direction.
_LEAST_SPREAD = 1e-9
_STEPS_TO_CLOSE = 10
_STEPS = 100
_HALVINGS = 40
# Largest error of an area, over the mean area, and what rounding may leave of it.
_EXACT = 1e-12
_ENOUGH = 1e-6
# Added to the diagonal of the second derivatives, over its mean: they are 0 where the
# body is moved.
_RIDGE = 1e-10


class _Body(NamedTuple):
    """A convex body between planes.

    Attributes:
        distances: Of the planes from the point 0.
        vertices: Its corners, some of them more than once.
        volume: Its volume.
        areas: Areas of the facets, which are the slope of the volume in the distances.
        slopes: Slopes of the areas.
    """

    distances: Float[np.ndarray, " planes"]
    vertices: Float[np.ndarray, "vertices 3"]
    volume: float
    areas: Float[np.ndarray, " facets"]
    slopes: Float[np.ndarray, "facets facets"]


def mesh_from_facets(
    facets: Facets,
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "triangles 3"]]:
    """The mesh of the convex body that has given facets.

    Light depends on the areas and the normals of facets alone, so that `find_spin` and
    `fit_shape` return no corners. These follow from the areas and normals by
    Minkowski's theorem: only one convex body has them. `from_mesh` gives its inertia if
    it is homogeneous, and programs for meshes draw and print it.

    Args:
        facets: Areas and normals. Their albedos are not used.

    Returns:
        Vertices [m], about the centre of mass of the homogeneous body, and triangles,
        counter-clockwise seen from outside. Areas that fail to close by some per cent
        are changed by as much, so that they close.

    Raises:
        ValueError: Areas that are negative, that are far from closed, or whose
            normals lie in a plane; facets that `jit` or `vmap` traces.

    >>> import numpy as np, jrigid as jr
    >>> normals = np.concatenate([np.eye(3), -np.eye(3)])
    >>> box = jr.photometry.Facets(np.array([6.0, 3, 2, 6, 3, 2]), normals)
    >>> vertices, faces = jr.photometry.mesh_from_facets(box)  # 1 by 2 by 3
    >>> print(np.ptp(vertices, axis=0).round(6), faces.shape)
    [1. 2. 3.] (12, 3)
    """
    check_known("facets", facets.areas)
    check_known("facets", facets.normals)
    areas, normals = _merged(np.asarray(facets.areas), np.asarray(facets.normals))
    areas = _closed(areas, normals)
    total = areas.sum()
    body = _solved(areas / total, normals)
    # Areas grow as the square of lengths.
    vertices = body.vertices * np.sqrt(total / body.areas.sum())
    # Where more than three planes meet a corner occurs more than once.
    size = np.max(np.linalg.norm(vertices, axis=1))
    vertices = vertices[_first_of_each(vertices, _SAME * size)[0]]
    faces = hull_of(vertices)
    used, renumbered = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], renumbered.reshape(faces.shape)
    return vertices - _centre(vertices, faces), faces


def _merged(
    areas: Float[np.ndarray, " facets"], normals: Float[np.ndarray, "facets 3"]
) -> tuple[Float[np.ndarray, " planes"], Float[np.ndarray, "planes 3"]]:
    """Areas and unit normals of the planes in which facets lie."""
    demand(
        bool(np.all(np.isfinite(areas)) and np.all(np.isfinite(normals))),
        "Argument `facets` must have finite areas and normals, but it has not.",
    )
    # Triangles of no area have no normal.
    there = (areas > 0) & (np.linalg.norm(normals, axis=1) > 0)
    areas = areas[there].astype(float)
    normals = normals[there].astype(float)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    planes, plane = _first_of_each(normals, _COPLANAR)
    return np.bincount(plane, areas), normals[planes]


def _first_of_each(
    points: Float[np.ndarray, "points 3"], distance: float
) -> tuple[Int[np.ndarray, " places"], Int[np.ndarray, " points"]]:
    """The first point at each place, and the place of each point."""
    # Imported where it is used: scipy would add a second to `import jrigid`.
    from scipy.spatial import KDTree

    near = KDTree(points).query_pairs(distance, output_type="ndarray")
    first = np.arange(len(points))
    np.minimum.at(first, near[:, 1], near[:, 0])
    return np.unique(first, return_inverse=True)


def _closed(
    areas: Float[np.ndarray, " planes"], normals: Float[np.ndarray, "planes 3"]
) -> Float[np.ndarray, " planes"]:
    """Areas that close: each is changed by the exponential of n.b, with one vector b.

    As an albedo that varies like this, it is what closure can determine.
    """
    second = (areas[:, None] * normals).T @ normals
    demand(
        bool(np.linalg.eigvalsh(second)[0] > _LEAST_SPREAD * areas.sum()),
        "Argument `facets` must have normals in all directions of space, but they lie "
        "in a plane.",
    )
    share = float(np.linalg.norm(areas @ normals) / areas.sum())
    demand(
        share < MOST_OPEN,
        "Argument `facets` must be those of a closed surface, but the sum of their "
        f"areas as vectors is {100 * share:.3g} % of their sum.",
    )
    # Newton's method for the minimum of the sum of the areas, which is convex in b.
    for _ in range(_STEPS_TO_CLOSE):
        second = (areas[:, None] * normals).T @ normals
        areas = areas * np.exp(-normals @ np.linalg.solve(second, areas @ normals))
    return areas


def _solved(
    areas: Float[np.ndarray, " planes"], normals: Float[np.ndarray, "planes 3"]
) -> _Body:
    """The body whose areas are in the proportions of those that are wanted."""
    # All planes touch a ball.
    body = _between(np.ones(len(areas)), normals)
    # A plane that leaves the body has no slope that would bring it back.
    least = min(np.min(areas), np.min(body.areas / body.volume)) / 2
    error = np.inf
    for _ in range(_STEPS):
        before = error
        error = float(np.max(np.abs(areas - body.areas / body.volume)) / np.mean(areas))
        # Below `_ENOUGH` rounding decides, and steps may stop to help.
        if error < _EXACT or (error < _ENOUGH and error > before / 2):
            return body
        body = _nearer(body, areas, normals, least)
    raise ValueError(
        "Argument `facets` must have the areas and normals of a convex body, but none "
        f"was found whose areas agree: they differ by {100 * error:.2g} % of the mean."
    )


def _nearer(
    body: _Body,
    areas: Float[np.ndarray, " planes"],
    normals: Float[np.ndarray, "planes 3"],
    least: float,
) -> _Body:
    """The body after a step of Newton's method, halved until areas agree better.

    Args:
        body: The body before.
        areas: Areas that are wanted, of the body over its volume.
        normals: Of the planes.
        least: No area over the volume may be smaller.
    """
    share = body.areas / body.volume
    slope = areas - share
    second = np.outer(share, share) - body.slopes / body.volume
    ridge = _RIDGE * np.mean(np.diag(second)) * np.eye(len(areas))
    step = np.linalg.solve(second + ridge, -slope)
    for halving in range(_HALVINGS):
        part = 0.5**halving
        distances = body.distances + part * step
        if np.all(distances > 0):
            new = _between(distances, normals)
            share = new.areas / new.volume
            falls = np.linalg.norm(areas - share) < (1 - part / 2) * np.linalg.norm(
                slope
            )
            if falls and np.min(share) > least:
                # The point within stays near the middle, far from all planes.
                middle = new.vertices.mean(axis=0)
                return new._replace(
                    distances=distances - normals @ middle,
                    vertices=new.vertices - middle,
                )
    # Rounding allows no better step.
    return body


def _between(
    distances: Float[np.ndarray, " planes"], normals: Float[np.ndarray, "planes 3"]
) -> _Body:
    """The body between planes at positive distances from the point 0.

    The planes n.x = h are points n / h of the dual body. Each triangle of its hull is a
    corner of the body, and each edge of the hull is an edge between two planes.
    """
    # Imported where it is used: scipy would add a second to `import jrigid`.
    from scipy.spatial import ConvexHull

    dual = ConvexHull(normals / distances[:, None])
    # On a triangle of the dual hull e.x = -e3, and v.x = 1 for the corner v.
    vertices = dual.equations[:, :3] / -dual.equations[:, 3:]
    # Each edge of the hull lies in two triangles; sorted, the two follow each other.
    pairs = np.sort(dual.simplices[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    triangle = np.repeat(np.arange(len(vertices)), 3)
    order = np.lexsort(pairs.T)
    first, second = pairs[order][::2].T
    ends = triangle[order].reshape(-1, 2)
    lengths = np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1)
    cosine = np.sum(normals[first] * normals[second], axis=1)
    sine = np.linalg.norm(np.cross(normals[first], normals[second]), axis=1)
    count = len(distances)
    slopes = np.zeros((count, count))
    slopes[first, second] = slopes[second, first] = lengths / sine
    both = np.concatenate([first, second])
    turned = np.tile(lengths * cosine / sine, 2)
    slopes[np.arange(count), np.arange(count)] = -np.bincount(both, turned, count)
    # Areas are homogeneous of second degree in the distances, and the volume of third.
    areas = slopes @ distances / 2
    volume = float(areas @ distances / 3)
    return _Body(distances, vertices, volume, areas, slopes)


def _centre(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "triangles 3"]
) -> Float[np.ndarray, "3"]:
    """Centre of mass of a homogeneous body.

    `from_mesh` gives it too, but would compile a program for each number of corners.
    """
    corners = vertices[faces]
    volumes = np.linalg.det(corners)
    # A tetrahedron with a corner at the point 0 has its centre at a fourth of the sum.
    return volumes @ corners.sum(axis=1) / (4 * volumes.sum())
