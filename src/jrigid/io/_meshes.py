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
Trimesh = Any  # `trimesh.Trimesh`; trimesh is an extra and states no types
Scene = Any  # `trimesh.Scene`
_ADVICE = (
    "Vertices at one place were merged already. `mesh.fill_holes()` of trimesh closes "
    "small holes, `mesh.fix_normals()` turns faces, `trimesh.boolean.union` joins "
    "parts that overlap."
)


def mesh_arrays(
    mesh: Trimesh,
) -> tuple[Float[np.ndarray, "vertices 3"], Int[np.ndarray, "faces 3"]]:
    """Return vertices and faces of a trimesh, as `jrigid.from_mesh` takes them.

    Vertices at one place become one vertex. STL files and meshes with textures or
    normals at their corners have several. Faces that shrink to a line are left out.

    Args:
        mesh: A `trimesh.Trimesh`.

    Returns:
        Vertices, in the units of the mesh, and faces.

    Raises:
        ValueError: `mesh` is no mesh of trimesh.

    >>> import jrigid as jr, trimesh
    >>> vertices, faces = jr.io.mesh_arrays(trimesh.creation.box((1, 2, 3)))
    >>> print(vertices.shape, faces.shape, jr.from_mesh(vertices, faces).mass)
    (8, 3) (12, 3) 6.0
    """
    needed = "Argument `mesh` must be a mesh or scene of trimesh"
    advice = "(`jrigid.from_mesh` takes arrays.)"
    is_mesh = hasattr(mesh, "merge_vertices")
    demand(is_mesh, f"{needed}, but it is {kind_of(mesh)}. {advice}")
    # `merge_vertices` changes a mesh in place.
    merged = mesh.copy()
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    # Of a mesh without faces trimesh gives an array of one axis.
    faces = np.asarray(merged.faces, np.int64).reshape(-1, 3)
    # A face has collapsed where two of its corners are one vertex now.
    is_line = np.any(faces == np.roll(faces, 1, axis=1), axis=1)
    return np.asarray(merged.vertices, float), faces[~is_line]


def _parts(shape: Trimesh | Scene) -> list[tuple[tuple[str, ...], Trimesh]]:
    """Meshes in the coordinates of the whole, each with the names it goes by."""
    if not hasattr(shape, "graph"):
        name = getattr(shape, "metadata", {}).get("name", "mesh")
        return [((str(name),), shape)]
    parts = []
    for node in shape.graph.nodes_geometry:
        transform, geometry = shape.graph[node]
        # A scene may also hold paths and clouds of points.
        if hasattr(shape.geometry[geometry], "faces"):
            mesh = shape.geometry[geometry].copy()
            # This also turns the faces over where the transform mirrors.
            mesh.apply_transform(transform)
            parts.append(((str(node), str(geometry)), mesh))
    demand(bool(parts), "Argument `mesh` must hold a mesh, but its scene holds none.")
    return parts


def _densities(
    density: Density, parts: list[tuple[tuple[str, ...], Trimesh]]
) -> list[ScalarLike]:
    """The density of each part, checked."""
    if not isinstance(density, Mapping):
        return [density] * len(parts)
    names = list(dict.fromkeys(name for names, _ in parts for name in names))
    message = (
        f"Argument `density` must name parts, {names}, but it names {list(density)}."
    )
    demand(set(density) <= set(names), message)
    densities: list[ScalarLike] = []
    for names, _ in parts:
        own = [density[x] for x in names if x in density]
        message = f"Argument `density` must have one of {names[0]!r}, but it has not."
        demand(bool(own), message)
        densities.append(own[0])
    return densities


def _joined(
    shape: Trimesh | Scene, density: Density, scale: float, whole: str
) -> MassProperties:
    """The body of all parts; errors say of which `whole` a part is."""
    demand(scale > 0, f"Argument `scale` must be positive, but it is {scale}.")
    parts = _parts(shape)
    bodies = []
    for (names, part), own in zip(parts, _densities(density, parts), strict=True):
        vertices, faces = mesh_arrays(part)
        try:
            bodies.append(from_mesh(scale * vertices, faces, own))
        except (RuntimeError, ValueError) as error:
            advice = f" {_ADVICE}" if "`faces`" in str(error) else ""
            message = f"Part {names[0]!r} of {whole}: {error}{advice}"
            raise ValueError(message) from error
    # `sum` begins at 0, which is no body, unless it gets a first term.
    return sum(bodies[1:], bodies[0])


def from_trimesh(
    mesh: Trimesh | Scene, density: Density = 1.0, *, scale: float = 1.0
) -> MassProperties:
    """Return the mass properties of a trimesh, or of a scene of parts, rigidly joined.

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
    return _joined(mesh, density, scale, "the mesh")


def read_mesh(
    path: str | Path, density: Density = 1.0, *, scale: float = 1.0
) -> MassProperties:
    """Read the mass properties of the parts in a file of meshes.

    The formats are those that trimesh reads: STL, OBJ, PLY, glTF and more.

    Args:
        path: The file.
        density: Of all parts, or of each by its name in the file [kg/m^3]. Parts of an
            OBJ are its objects, of one material each; its groups are not.
        scale: Metres in a unit of the file. STL, OBJ and PLY do not say their unit, CAD
            programs mean millimetres (1e-3); glTF is in metres, its y axis up.

    Returns:
        The body, in the coordinates of the file, in metres.

    Raises:
        ImportError: Without the extra `jrigid[io]`, or without what trimesh needs for a
            format, as for STEP.
        ValueError: No such file, a file that is cut off or of another format than its
            suffix says, or an error as in `from_trimesh`.

    >>> import jrigid as jr, tempfile, trimesh
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = trimesh.creation.box((100, 200, 300)).export(f"{folder}/box.stl")
    ...     body = jr.io.read_mesh(f"{folder}/box.stl", 500.0, scale=1e-3)
    >>> print(body.mass.round(6))
    3.0
    """
    check_type("path", path, str, Path)
    trimesh = extra("io", "trimesh")
    file = repr(str(path))
    is_file = Path(path).is_file()
    demand(is_file, f"Argument `path` must be a file, but {file} is none.")
    options = {}
    if isinstance(density, Mapping) and Path(path).suffix.lower() == ".obj":
        # Otherwise trimesh joins objects of the same material to one part.
        options = {"split_objects": True, "group_material": False}
    try:
        scene = trimesh.load_scene(path, **options)
    except ImportError as error:
        raise ImportError(
            f"File {file} cannot be read without a package that trimesh needs for its "
            f"format: {error}."
        ) from error
    except Exception as error:  # trimesh raises many types for files that are cut off
        cause = f"{type(error).__name__}: {error}"
        raise ValueError(f"File {file} cannot be read as a mesh. ({cause})") from error
    message = f"File {file} holds no mesh: is it cut off, or is its suffix wrong?"
    demand(any(hasattr(x, "faces") for x in scene.geometry.values()), message)
    return _joined(scene, density, scale, f"file {file}")
