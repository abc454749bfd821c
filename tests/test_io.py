"""Doors: every convention against the package itself, not against ourselves."""

import importlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jrigid as jr

scipy_transform = importlib.import_module("scipy.spatial.transform")
HALF = np.array([0.0, 0.6, 0.0, -0.8])  # half a turn
AXES = np.eye(3)


def attitudes(rng, count=20):
    q = rng.normal(size=(count, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def matrices(q):
    return np.asarray(jax.vmap(jr.rotation.to_matrix)(q))


def bodies(rng, count=4, names="abcd"):
    """Real ones, of four points each, with all products of inertia."""
    clouds = [jr.from_points(rng.uniform(0.5, 2, 4), rng.normal(size=(4, 3))) for _ in names]
    return dict(zip(names, clouds, strict=True))


def assert_same(body, other, rtol=1e-12):
    for x, y in zip(jax.tree.leaves(body), jax.tree.leaves(other), strict=True):
        assert_allclose(x, y, rtol=rtol, atol=rtol * float(jnp.max(jnp.abs(y))))


# Attitudes


def test_scipy_turns_vectors_as_attitudes_do(rng):
    q, v = attitudes(rng), rng.normal(size=3)
    turn = jr.io.to_scipy(q)
    assert_allclose(turn.apply(v), np.asarray(jax.vmap(jr.rotation.rotate, (0, None))(q, v)))
    assert_allclose(matrices(jr.io.from_scipy(turn)), turn.as_matrix(), atol=1e-15)
    assert jr.io.from_scipy(jr.io.to_scipy(q[0])).shape == (4,)


def test_scipys_rigid_transforms(rng):
    if not hasattr(scipy_transform, "RigidTransform"):
        pytest.skip("scipy older than 1.16")
    q, place, v = attitudes(rng), rng.normal(size=(20, 3)), rng.normal(size=3)
    pose = jr.io.to_scipy(q, place)
    assert_allclose(pose.apply(v), matrices(q) @ v + place, atol=1e-14)
    back, position = jr.io.from_scipy(pose)
    assert_allclose(matrices(back), matrices(q), atol=1e-14)
    assert_allclose(position, place)


def test_what_is_no_rotation_is_told_so():
    with pytest.raises(ValueError, match=r"must be a scipy.*RigidTransform, but it is a int"):
        jr.io.from_scipy(3)
    with pytest.raises(ValueError, match=r"must be a jaxlie.SO3 or jaxlie.SE3, but it is a int"):
        jr.io.from_jaxlie(3)


@jax.numpy_dtype_promotion("standard")  # jaxlie needs it
def test_jaxlie_turns_vectors_as_attitudes_do(rng):
    jaxlie = pytest.importorskip("jaxlie")
    q, place, v = attitudes(rng)[0], rng.normal(size=3), rng.normal(size=3)
    turn, pose = jr.io.to_jaxlie(q), jr.io.to_jaxlie(q, place)
    assert isinstance(turn, jaxlie.SO3)
    assert isinstance(pose, jaxlie.SE3)
    assert_allclose(turn.as_matrix(), jr.rotation.to_matrix(q), atol=1e-15)
    assert_allclose(pose.apply(v), jr.rotation.rotate(q, v) + place, atol=1e-14)
    assert_allclose(jr.io.from_jaxlie(turn), q)
    back, position = jr.io.from_jaxlie(pose)
    assert_allclose(back, q)
    assert_allclose(position, place)
    rolled = jaxlie.SO3.from_rpy_radians(0.1, 0.2, 0.3)
    expected = jr.rotation.from_roll_pitch_yaw(np.array([0.1, 0.2, 0.3]))
    assert_allclose(jr.io.from_jaxlie(rolled), expected, atol=1e-15)
    slope = jax.jit(jax.grad(lambda q: jr.io.to_jaxlie(q).wxyz[1]))(jnp.asarray(q))
    assert_allclose(slope, [0, 1, 0, 0])


def m2q(matrix):
    """NAIF's SPICE quaternion of a matrix: Q2M's formula of its header, solved for q0 > 0."""
    q0 = 0.5 * np.sqrt(1 + np.trace(matrix))
    off = [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    return np.array([q0, *(np.array(off) / (4 * q0))])


def test_spice_quaternions_are_those_of_matrices_from_space_to_body(rng):
    # The header of M2Q: ROTATE by a quarter about z makes this matrix and this quaternion.
    assert_allclose(
        m2q(np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])), [0.5**0.5, 0, 0, -(0.5**0.5)]
    )
    for q in attitudes(rng):
        q = q * np.sign(q[0])
        to_body = np.asarray(jr.rotation.to_matrix(q)).T
        assert_allclose(jr.io.to_spice(q), m2q(to_body), atol=1e-12)
        assert_allclose(jr.io.from_spice(m2q(to_body)), q, atol=1e-12)


def test_spice_itself(rng):
    spice = pytest.importorskip("spiceypy")
    for q in attitudes(rng):
        to_body = np.array(jr.rotation.to_matrix(q).T, order="C")
        back = jr.rotation.to_matrix(jr.io.from_spice(spice.m2q(to_body)))
        assert_allclose(back, to_body.T, atol=1e-14)
        assert_allclose(spice.q2m(np.array(jr.io.to_spice(q))), to_body, atol=1e-14)


def test_mrps_are_those_of_scipy(rng):
    q = attitudes(rng)
    ours = jax.vmap(jr.io.to_mrp)(q)
    assert_allclose(
        ours, scipy_transform.Rotation.from_quat(np.roll(q, -1, 1)).as_mrp(), atol=1e-15
    )
    assert np.all(np.linalg.norm(ours, axis=1) <= 1)
    for mrp in (ours, jax.vmap(jr.io.shadow_mrp)(ours)):
        turn = scipy_transform.Rotation.from_mrp(np.array(mrp)).as_matrix()
        back = jax.vmap(jr.io.from_mrp)(mrp)
        assert_allclose(matrices(back), turn, atol=1e-14)
        assert_allclose(np.linalg.norm(back, axis=1), 1, rtol=1e-14)


@pytest.mark.parametrize("q", [HALF, -HALF, np.array([1e-9, 0.6, 0.0, -0.8]), np.eye(4)[0]])
def test_mrps_have_the_derivative_of_their_set_at_half_turns_and_at_none(q):
    """Along p -> p exp(d): that of the inverse map, from_mrp, which is analytic."""
    along = lambda d: jr.io.to_mrp(jr.rotation.multiply(q, jr.rotation.exp(d)))  # noqa: E731
    slope = jax.jacfwd(along)(jnp.zeros(3))
    assert_allclose(jax.jacrev(along)(jnp.zeros(3)), slope, atol=1e-14)
    p = jr.io.to_mrp(q)
    back = lambda p: jr.rotation.log(  # noqa: E731
        jr.rotation.multiply(jr.rotation.conjugate(q), jr.io.from_mrp(p))
    )
    assert_allclose(jax.jacfwd(back)(p) @ slope, AXES, atol=1e-13)
    # d p = (1 - |p|^2 + 2 hat(p) + 2 p p^T) d / 4, of Schaub and Junkins
    published = (1 - p @ p) * AXES + 2 * jr.rotation.hat(p) + 2 * jnp.outer(p, p)
    assert_allclose(slope, published / 4, atol=1e-9)


# Meshes


trimesh = pytest.importorskip("trimesh")


def lump(rng, count=30):
    """Convex, with products of inertia, away from the origin."""
    mesh = trimesh.convex.convex_hull(rng.normal(size=(count, 3)))
    mesh.apply_translation([1.0, -2.0, 0.5])
    return mesh


def assert_same_as_trimesh(body, mesh, density, scale=1.0, rtol=1e-6):
    own = mesh.copy()
    own.apply_scale(scale)
    own.density = density
    expected = own.mass_properties
    assert_allclose(body.mass, expected["mass"], rtol=rtol)
    assert_allclose(body.center_of_mass, expected["center_mass"], rtol=rtol)
    assert_allclose(body.inertia, expected["inertia"], rtol=rtol, atol=rtol * body.inertia.max())


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb"])
def test_files_of_meshes_are_read_as_trimesh_does(rng, tmp_path, suffix):
    mesh = lump(rng)
    mesh.export(tmp_path / f"lump.{suffix}")
    body = jr.io.read_mesh(tmp_path / f"lump.{suffix}", 2700.0, scale=1e-3)
    assert_same_as_trimesh(body, mesh, 2700.0, 1e-3)


def test_corners_at_one_place_are_merged(rng):
    mesh = lump(rng)
    soup = trimesh.Trimesh(*trimesh.triangles.to_kwargs(mesh.triangles).values(), process=False)
    assert len(soup.vertices) == 3 * len(mesh.faces)
    with pytest.raises(RuntimeError, match="closed surface"):
        jr.from_mesh(soup.vertices, soup.faces)
    assert_same(jr.io.from_trimesh(soup), jr.from_mesh(mesh.vertices, mesh.faces))
    assert jr.io.mesh_arrays(soup)[0].shape == mesh.vertices.shape


def test_a_scene_is_its_parts_in_their_places_also_mirrored(rng, tmp_path):
    hull, weight = lump(rng), lump(rng, 12)
    place = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]) @ np.diag([1.0, -1, 1, 1])
    place[:3, 3] = 3.0, 1.0, 2.0
    scene = trimesh.Scene()
    scene.add_geometry(hull, geom_name="hull")
    scene.add_geometry(weight, node_name="left", geom_name="weight", transform=place)
    scene.add_geometry(weight, node_name="right", geom_name="weight")
    moved = weight.copy()
    moved.apply_transform(place)
    whole = trimesh.util.concatenate([hull, moved, weight])
    assert_same_as_trimesh(jr.io.from_trimesh(scene, 3.0), whole, 3.0)
    two = jr.io.from_trimesh(scene, {"hull": 3.0, "left": 5.0, "right": 7.0})
    expected = sum(
        jr.from_mesh(np.asarray(x.vertices), np.asarray(x.faces), d)
        for x, d in ((hull, 3.0), (moved, 5.0), (weight, 7.0))
    )
    assert_same(two, expected)
    scene.export(tmp_path / "scene.glb")
    again = jr.io.read_mesh(tmp_path / "scene.glb", {"hull": 3.0, "left": 5.0, "right": 7.0})
    assert_same(again, two, 1e-6)
    with pytest.raises(ValueError, match=r"must have a density of 'left'"):
        jr.io.from_trimesh(scene, {"hull": 3.0})
    with pytest.raises(ValueError, match=r"must name parts of the mesh, but .'keel'. are not"):
        jr.io.from_trimesh(scene, {"hull": 3.0, "left": 1.0, "right": 1.0, "keel": 1.0})
    with pytest.raises(ValueError, match="its scene holds none"):
        jr.io.from_trimesh(trimesh.Scene())


def test_a_part_that_is_no_body_is_named_with_what_to_do(rng):
    mesh = lump(rng)
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    with pytest.raises(ValueError, match=r"Part 'hull'.* 3 of its edges .* `mesh.fill_holes\(\)`"):
        jr.io.from_trimesh(trimesh.Scene({"hull": mesh}))
    mesh = lump(rng)
    mesh.invert()
    with pytest.raises(ValueError, match=r"inside out.* 0 of its edges .*fix_normals"):
        jr.io.from_trimesh(mesh)


# Inertials

mujoco = pytest.importorskip("mujoco")

FUSE = "<mujoco><compiler fusestatic='false'/></mujoco>"  # else MuJoCo drops what cannot move


def urdf(inertial):
    return f"<robot name='r'>{FUSE}<link name='b'>{inertial}</link></robot>"


def mjcf(inertial, compiler=""):
    body = f"<worldbody><body name='b'>{inertial}</body></worldbody>"
    return f"<mujoco><compiler {compiler}/>{body}</mujoco>"


def in_mujoco(text, name="b"):
    """A body as MuJoCo has it, its tensor from the principal moments and axes that it keeps."""
    model = mujoco.MjModel.from_xml_string(text)
    body, turn = model.body(name), np.zeros(9)
    mujoco.mju_quat2Mat(turn, body.iquat)
    turn = turn.reshape(3, 3)
    tensor = turn @ np.diag(body.inertia) @ turn.T
    return jr.MassProperties(body.mass[0], body.ipos, 0.5 * (tensor + tensor.T))


SIX = "ixx='1.0' iyy='2.0' izz='2.5' ixy='0.1' ixz='-0.2' iyz='0.3'"
TURNED = {
    "quat": "quat='1 -2 0.5 0.3'",
    "axis": "axisangle='1 -2 0.5 40'",
    "axes": "xyaxes='1 2 3 0.1 1 -1'",
    "z": "zaxis='1 -2 -0.5'",
    "down": "zaxis='0 0 -1'",
    "euler": "euler='10 -50 120'",
    "none": "",
}
FILES = {
    "urdf": urdf(f"<inertial><origin xyz='0.1 -0.2 0.3' rpy='0.4 -1.1 2'/><mass value='3'/><inertia {SIX}/></inertial>"),
    "urdf at the origin": urdf(f"<inertial><mass value='3'/><inertia {SIX}/></inertial>"),
    "full": mjcf("<inertial pos='0.1 -0.2 0.3' mass='3' fullinertia='1 2 2.5 0.1 -0.2 0.3'/>"),
    **{
        name: mjcf(f"<inertial pos='0.1 -0.2 0.3' mass='3' diaginertia='1 2 2.5' {turn}/>")
        for name, turn in TURNED.items()
    },
    **{
        seq: mjcf(
            "<inertial pos='0 0 0' mass='3' diaginertia='1 2 2.5' euler='0.4 -1.1 2'/>",
            f"angle='radian' eulerseq='{seq}'",
        )
        for seq in ("xyz", "zxz", "ZYX", "xYz")
    },
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_inertials_are_read_as_mujoco_does(name):
    assert_same(jr.io.read_inertials(FILES[name])["b"], in_mujoco(FILES[name]))


@pytest.mark.parametrize("suffix", ["urdf", "xml"])
def test_mujoco_reads_what_is_written(rng, tmp_path, suffix):
    path, known = tmp_path / f"bodies.{suffix}", bodies(rng)
    jr.io.write_inertials(path, known)
    text = path.read_text()
    if suffix == "urdf":
        text = text.replace("</robot>", FUSE + "</robot>")
    for name, body in known.items():
        assert_same(in_mujoco(text, name), body, 1e-11)
        assert_same(jr.io.read_inertials(path)[name], body, 0)
