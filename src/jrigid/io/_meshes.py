"""Bodies of trimesh's meshes and scenes, and of the files that trimesh reads."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jrigid._checks import check_type, demand, kind_of
from jrigid._extra import extra
from jrigid._types import ScalarLike
from jrigid.mass import MassProperties, from_mesh

Density = ScalarLike | Mapping[str, float]
_ADVICE = (
    "Corners at one place were merged already. `mesh.fill_holes()` of trimesh closes small holes, "
    "`mesh.fix_normals()` turns faces, `trimesh.boolean.union` joins parts that overlap."
)


def mesh_arrays(
    mesh: Any,
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Vertices and faces of a trimesh, as `jrigid.from_mesh` takes them.

    Corners at one place become one vertex, which STL files and meshes with textures or
    normals at their corners do not have, and faces that this makes lines are left out.

    Args:
        mesh: A `trimesh.Trimesh`.

    Returns:
        Vertices, in the units of the mesh, and faces.

    >>> import jrigid as jr, trimesh
    >>> vertices, faces = jr.io.mesh_arrays(trimesh.creation.box((1, 2, 3)))
    >>> print(vertices.shape, faces.shape, jr.from_mesh(vertices, faces).mass)
    (8, 3) (12, 3) 6.0
    """
    message = f"Argument `mesh` must be a mesh or scene of trimesh, but it is {kind_of(mesh)}."
    demand(
        hasattr(mesh, "merge_vertices"), f"{message} (`jrigid.from_mesh` takes arrays.)"
    )
    merged = mesh.copy()
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    faces = np.asarray(merged.faces, np.int64)
    lines = np.any(faces == np.roll(faces, 1, axis=1), axis=1)
    return np.asarray(merged.vertices, float), faces[~lines]


def _parts(shape: Any) -> list[tuple[tuple[str, ...], Any]]:
    """Meshes in the coordinates of the whole, each with the names it goes by."""
    if not hasattr(shape, "graph"):
        return [((str(getattr(shape, "metadata", {}).get("name", "mesh")),), shape)]
    parts = []
    for node in shape.graph.nodes_geometry:
        transform, geometry = shape.graph[node]
        if hasattr(
            shape.geometry[geometry], "faces"
        ):  # else a path or a cloud of points
            mesh = shape.geometry[geometry].copy()
            mesh.apply_transform(transform)  # turns the faces over where it mirrors
            parts.append(((str(node), str(geometry)), mesh))
    demand(bool(parts), "Argument `mesh` must hold a mesh, but its scene holds none.")
    return parts


def from_trimesh(
    mesh: Any, density: Density = 1.0, *, scale: float = 1.0
) -> MassProperties:
    """Mass properties of a trimesh, or of a scene of parts with their places, rigidly joined.

    Each part is a homogeneous body; where parts overlap their masses add.

    Args:
        mesh: A `trimesh.Trimesh` or `trimesh.Scene`.
        density: Of all parts, or of each by the name of its node or geometry [kg/m^3].
        scale: Metres in a unit of the mesh: 1e-3 for millimetres.

    Returns:
        The body, in the coordinates of the mesh or scene, in metres.

    Raises:
        ValueError: A part has no density or a name none of the parts, a part is no
            closed surface, or a value is wrong; the text says which part and what to
            do.

    >>> import jrigid as jr, trimesh
    >>> scene = trimesh.Scene({"hull": trimesh.creation.box((1, 1, 1))})
    >>> weight = trimesh.creation.box((1, 1, 1))
    >>> shift = trimesh.transformations.translation_matrix((2, 0, 0))
    >>> name = scene.add_geometry(weight, geom_name="weight", transform=shift)
    >>> body = jr.io.from_trimesh(scene, {"hull": 1.0, "weight": 3.0})
    >>> print(body.mass, body.center_of_mass)
    4.0 [1.5 0.  0. ]
    """
    demand(scale > 0, f"Argument `scale` must be positive, but it is {scale}.")
    parts, bodies = _parts(mesh), []
    known: dict[str, Any] = {name: density for names, _ in parts for name in names}
    densities = density if isinstance(density, Mapping) else known
    message = f"Argument `density` must name parts, {list(known)}, but it names {list(densities)}."
    demand(set(densities) <= set(known), message)
    for names, part in parts:
        own = [densities[x] for x in names if x in densities]
        demand(
            bool(own),
            f"Argument `density` must have one of {names[0]!r}, but it has not.",
        )
        vertices, faces = mesh_arrays(part)
        try:
            bodies.append(from_mesh(scale * vertices, faces, own[0]))
        except (RuntimeError, ValueError) as error:
            advice = f" {_ADVICE}" if "`faces`" in str(error) else ""
            raise ValueError(
                f"Part {names[0]!r} of the mesh: {error}{advice}"
            ) from error
    return sum(bodies[1:], bodies[0])


def read_mesh(
    path: str | Path, density: Density = 1.0, *, scale: float = 1.0
) -> MassProperties:
    """Mass properties of the parts in a file of meshes: STL, OBJ, PLY, glTF, all trimesh reads.

    Args:
        path: The file.
        density: Of all parts, or of each by its name in the file [kg/m^3].
        scale: Metres in a unit of the file. STL, OBJ and PLY do not say their unit, CAD
            programs mean millimetres (1e-3); glTF is in metres, its y axis up.

    Returns:
        The body, in the coordinates of the file, in metres.

    Raises:
        ImportError: Without the extra `jrigid[io]`.
        ValueError: As `from_trimesh`.

    >>> import jrigid as jr, tempfile, trimesh
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = trimesh.creation.box((100, 200, 300)).export(f"{folder}/box.stl")
    ...     body = jr.io.read_mesh(f"{folder}/box.stl", 500.0, scale=1e-3)
    >>> print(body.mass.round(6))
    3.0
    """
    check_type("path", path, str, Path)
    return from_trimesh(extra("io", "trimesh").load_scene(path), density, scale=scale)
