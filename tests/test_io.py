"""Interoperability: every convention is checked against the other package itself."""

import importlib
import os
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
    clouds = [
        jr.from_points(rng.uniform(0.5, 2, 4), rng.normal(size=(4, 3))) for _ in names
    ]
    return dict(zip(names, clouds, strict=True))


def assert_same(body, other, rtol=1e-12):
    for x, y in zip(jax.tree.leaves(body), jax.tree.leaves(other), strict=True):
        assert_allclose(x, y, rtol=rtol, atol=rtol * float(jnp.max(jnp.abs(y))))


# Attitudes


def test_scipy_turns_vectors_as_attitudes_do(rng):
    q, v = attitudes(rng), rng.normal(size=3)
    turn = jr.io.to_scipy(q)
    assert_allclose(
        turn.apply(v), np.asarray(jax.vmap(jr.rotation.rotate, (0, None))(q, v))
    )
    assert_allclose(matrices(jr.io.from_scipy(turn)), turn.as_matrix(), atol=1e-15)
    assert jr.io.from_scipy(jr.io.to_scipy(q[0])).shape == (4,)


def test_scipys_rigid_transforms(rng):
    q, place, v = attitudes(rng), rng.normal(size=(20, 3)), rng.normal(size=3)
    pose = jr.io.to_scipy(q, place)
    assert_allclose(pose.apply(v), matrices(q) @ v + place, atol=1e-14)
    back, position = jr.io.from_scipy(pose)
    assert_allclose(matrices(back), matrices(q), atol=1e-14)
    assert_allclose(position, place)


def test_what_is_no_rotation_is_refused():
    with pytest.raises(
        ValueError, match=r"must be a scipy.*RigidTransform, but it is a int"
    ):
        jr.io.from_scipy(3)
    with pytest.raises(
        ValueError, match=r"must be a jaxlie.SO3 or jaxlie.SE3, but it is a int"
    ):
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


@pytest.mark.parametrize("function", ["to_scipy", "to_jaxlie"])
def test_what_is_no_attitude_is_refused(function, untyped):
    with pytest.raises(
        ValueError, match=r"`attitude` must have shape \(4,\), but .* \(3,\)"
    ):
        getattr(jr.io, function)(np.ones(3))
    with pytest.raises(
        ValueError, match=r"`position` must have shape \(3,\), but .* \(5, 3\)"
    ):
        getattr(jr.io, function)(HALF, np.ones((5, 3)))


def m2q(matrix):
    """NAIF's SPICE quaternion of a matrix: Q2M's formula of its header,
    solved for q0 > 0."""
    q0 = 0.5 * np.sqrt(1 + np.trace(matrix))
    off = [
        matrix[2, 1] - matrix[1, 2],
        matrix[0, 2] - matrix[2, 0],
        matrix[1, 0] - matrix[0, 1],
    ]
    return np.array([q0, *(np.array(off) / (4 * q0))])


def test_spice_quaternions_are_those_of_matrices_from_space_to_body(rng):
    # The header of M2Q: ROTATE by a quarter about z makes this matrix and this
    # quaternion.
    assert_allclose(
        m2q(np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])),
        [0.5**0.5, 0, 0, -(0.5**0.5)],
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


@pytest.mark.parametrize(
    "q", [HALF, -HALF, np.array([1e-9, 0.6, 0.0, -0.8]), np.eye(4)[0]]
)
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
    assert_allclose(
        body.inertia, expected["inertia"], rtol=rtol, atol=rtol * body.inertia.max()
    )


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb"])
def test_files_of_meshes_are_read_as_trimesh_does(rng, tmp_path, suffix):
    mesh = lump(rng)
    mesh.export(tmp_path / f"lump.{suffix}")
    body = jr.io.read_mesh(tmp_path / f"lump.{suffix}", 2700.0, scale=1e-3)
    assert_same_as_trimesh(body, mesh, 2700.0, 1e-3)


def test_corners_at_one_place_are_merged(rng):
    mesh = lump(rng)
    soup = trimesh.Trimesh(
        *trimesh.triangles.to_kwargs(mesh.triangles).values(), process=False
    )
    assert len(soup.vertices) == 3 * len(mesh.faces)
    with pytest.raises(RuntimeError, match="closed surface"):
        jr.from_mesh(soup.vertices, soup.faces)
    assert_same(jr.io.from_trimesh(soup), jr.from_mesh(mesh.vertices, mesh.faces))
    assert jr.io.mesh_arrays(soup)[0].shape == mesh.vertices.shape


def test_a_scene_is_its_parts_in_their_places_also_mirrored(rng, tmp_path):
    hull, weight = lump(rng), lump(rng, 12)
    place = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]) @ np.diag(
        [1.0, -1, 1, 1]
    )
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
    again = jr.io.read_mesh(
        tmp_path / "scene.glb", {"hull": 3.0, "left": 5.0, "right": 7.0}
    )
    assert_same(again, two, 1e-6)
    with pytest.raises(ValueError, match=r"must have one of 'left'"):
        jr.io.from_trimesh(scene, {"hull": 3.0})
    with pytest.raises(
        ValueError, match=r"must name parts, .'hull'.* but it names .*'keel'"
    ):
        jr.io.from_trimesh(scene, {"hull": 3.0, "left": 1.0, "right": 1.0, "keel": 1.0})
    with pytest.raises(ValueError, match="its scene holds none"):
        jr.io.from_trimesh(trimesh.Scene())


def test_a_part_that_is_no_body_is_named_with_what_to_do(rng):
    mesh = lump(rng)
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    with pytest.raises(
        ValueError, match=r"Part 'hull'.* .*closed surface.* `mesh.fill_holes\(\)`"
    ):
        jr.io.from_trimesh(trimesh.Scene({"hull": mesh}))
    mesh = lump(rng)
    mesh.invert()
    with pytest.raises(ValueError, match=r"inside out.*fix_normals"):
        jr.io.from_trimesh(mesh)
    with pytest.raises(
        ValueError, match=r"`density` must be positive and finite, .*: -1.0\.$"
    ):
        jr.io.from_trimesh(lump(rng), -1.0)
    with pytest.raises(ValueError, match=r"`scale` must be positive, but it is -1.0"):
        jr.io.from_trimesh(lump(rng), scale=-1.0)
    for function in (jr.io.from_trimesh, jr.io.mesh_arrays):
        with pytest.raises(
            ValueError, match=r"scene of trimesh, but it is a tuple.*`jrigid.from_m"
        ):
            function((mesh.vertices, mesh.faces))


@pytest.mark.parametrize(
    ("suffix", "part"),
    [
        ("stl", 0.0),
        ("stl", 0.5),
        ("stl", 0.99),
        ("ply", 0.02),
        ("glb", 0.0),
        ("xyz", 1),
    ],
)
def test_a_file_of_a_mesh_that_is_cut_off_is_named(rng, tmp_path, suffix, part):
    path = tmp_path / f"lump.{suffix}"
    lump(rng).export(path, file_type="ply" if suffix == "xyz" else suffix)
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data))])
    with pytest.raises(ValueError, match=rf"^File .*lump\.{suffix}' (holds|cannot)"):
        jr.io.read_mesh(path)


@pytest.mark.parametrize("end", ["f", "f 2", "f 2 4"])
def test_an_obj_cut_off_in_its_first_face_holds_no_face(tmp_path, end):
    text = trimesh.exchange.obj.export_obj(trimesh.creation.box((1, 2, 3)))
    path = tmp_path / "box.obj"
    path.write_text(text[: text.index("f ")] + end)
    with pytest.raises(ValueError, match=r"hold(s no mesh| at least one face)"):
        jr.io.read_mesh(path)


def test_a_mesh_must_be_a_file_and_its_faults_name_the_file(rng, tmp_path):
    for path in (tmp_path, tmp_path / "none.stl"):
        with pytest.raises(ValueError, match=r"`path` must be a file, but .* is none"):
            jr.io.read_mesh(path)
    mesh = lump(rng)
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    mesh.export(tmp_path / "open.obj")
    with pytest.raises(ValueError, match=r"^Part .* of file .*open\.obj': .*`faces`"):
        jr.io.read_mesh(tmp_path / "open.obj")


def test_a_byte_order_mark_in_an_obj_is_harmless(rng, tmp_path):
    mesh = lump(rng)
    mesh.export(tmp_path / "a.obj")
    text = (tmp_path / "a.obj").read_text()
    (tmp_path / "b.obj").write_text(text, encoding="utf-8-sig")
    assert_same(*(jr.io.read_mesh(tmp_path / f"{x}.obj") for x in "ab"))


# Inertials

mujoco = pytest.importorskip("mujoco")

# Else MuJoCo drops what cannot move
FUSE = "<mujoco><compiler fusestatic='false'/></mujoco>"


def urdf(inertial):
    return f"<robot name='r'>{FUSE}<link name='b'>{inertial}</link></robot>"


def mjcf(inertial, compiler=""):
    body = f"<worldbody><body name='b'>{inertial}</body></worldbody>"
    return f"<mujoco><compiler {compiler}/>{body}</mujoco>"


def in_mujoco(text, name="b"):
    """A body as MuJoCo has it, its tensor from the principal moments and axes that it
    keeps."""
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
    "urdf": urdf(
        "<inertial><origin xyz='0.1 -0.2 0.3' rpy='0.4 -1.1 2'/><mass value='3'/>"
        f"<inertia {SIX}/></inertial>"
    ),
    "urdf at the origin": urdf(
        f"<inertial><mass value='3'/><inertia {SIX}/></inertial>"
    ),
    "full": mjcf(
        "<inertial pos='0.1 -0.2 0.3' mass='3' fullinertia='1 2 2.5 0.1 -0.2 0.3'/>"
    ),
    **{
        name: mjcf(
            f"<inertial pos='0.1 -0.2 0.3' mass='3' diaginertia='1 2 2.5' {turn}/>"
        )
        for name, turn in TURNED.items()
    },
    **{
        seq: mjcf(
            "<inertial pos='0 0 0' mass='3' diaginertia='1 2 2.5' euler='0.4 -1.1 2'/>",
            f"angle='radian' eulerseq='{seq}'",
        )
        for seq in ("xyz", "zxz", "ZYX", "xYz")
    },
}


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


def test_what_is_written_in_single_precision_is_read_again(tmp_path):
    with jax.enable_x64(False):
        for numbers in (
            "ixx='0.1' iyy='0.2' izz='0.3' ixy='0' ixz='0' iyz='0'",
            "ixx='.1' iyy='.2' izz='.7' ixy='.05' ixz='.02' iyz='-.03'",
        ):
            text = urdf(f"<inertial><mass value='0.1'/><inertia {numbers}/></inertial>")
            body = jr.io.read_inertials(text, unphysical="nearest")["b"]
            jr.io.write_inertials(tmp_path / "b.urdf", {"b": body}, template=text)
            assert_same(jr.io.read_inertials(tmp_path / "b.urdf")["b"], body, 0)
            assert 'mass value="0.1"' in (tmp_path / "b.urdf").read_text()
        with pytest.raises(ValueError, match=r"0\.1, 0\.2, 0\.3001 kg m"):
            jr.io.read_inertials(
                urdf(
                    "<inertial><mass value='1'/><inertia ixx='.1' iyy='.2' izz='.3001' "
                    "ixy='0' ixz='0' "
                    "iyz='0'/></inertial>"
                )
            )


@pytest.mark.parametrize(
    "pose",
    [
        "<pose>0.1 -0.2 0.3 0.4 -1.1 2</pose>",
        "<pose><!-- to the tip -->0.1 -0.2 0.3 0.4 -1.1 2<!-- or so --></pose>",
        "<pose degrees='true'>0.1 -0.2 0.3 10 -50 120</pose>",
        "<pose degrees='True'>0.1 -0.2 0.3 10 -50 120</pose>",
        "<pose rotation_format='quat_xyzw'>0.1 -0.2 0.3 0.1 0.7 -0.5 0.5</pose>",
        "<pose rotation_format='quat_xyzw'/>",
        "<pose/>",
        "",
    ],
)
def test_sdf_is_read_as_drake_does(pose):
    parsing = pytest.importorskip("pydrake.multibody.parsing")
    plant = importlib.import_module("pydrake.multibody.plant").MultibodyPlant(0.0)
    parsing.Parser(plant).AddModelsFromString(sdf(pose), "sdf")
    known = plant.GetBodyByName("b").default_spatial_inertia()
    tensor = known.Shift(known.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    expected = jr.MassProperties(known.get_mass(), known.get_com(), tensor)
    assert_same(jr.io.read_inertials(sdf(pose))["b"], expected)


def sdf(pose, more=""):
    six = "".join(
        f"<{k}>{x}</{k}>"
        for k, x in (y.split("=") for y in SIX.replace("'", "").split())
    )
    inertial = f"<inertial>{pose}<mass>3</mass><inertia>{six}</inertia></inertial>"
    model = f"<model name='m'><link name='b'>{inertial}</link></model>"
    return f"<sdf version='1.9'>{model}{more}</sdf>"


def test_sdf_turns_by_roll_pitch_yaw_about_fixed_axes_as_urdf():
    for pose in (
        "<pose>0.1 -0.2 0.3 0.4 -1.1 2</pose>",
        "<pose><!-- to the tip -->0.1 -0.2 0.3 0.4 -1.1 2<!-- or so --></pose>",
        "<pose degrees='True'>0.1 -0.2 0.3 22.918311805232932 -63.02535746439056 "
        "114.59155902616465</pose>",
    ):
        assert_same(jr.io.read_inertials(sdf(pose))["b"], in_mujoco(FILES["urdf"]))
    x, y, z, w = scipy_transform.Rotation.from_euler("xyz", [0.4, -1.1, 2]).as_quat()
    pose = f"<pose rotation_format='quat_xyzw'>0.1 -0.2 0.3 {x} {y} {z} {w}</pose>"
    assert_same(jr.io.read_inertials(sdf(pose))["b"], in_mujoco(FILES["urdf"]))
    for empty in (
        "",
        "<pose/><mass/><inertia/>",
        "<pose rotation_format='quat_xyzw'/>",
    ):
        link = f"<link name='b'><inertial>{empty}</inertial></link><link name='c'/>"
        read = jr.io.read_inertials(
            f"<sdf><model name='m'>{link}</model></sdf>"
        )  # SDF's defaults
        assert list(read) == ["b"]
        assert_same(read["b"], jr.MassProperties(1.0, np.zeros(3), np.ones(3)))


def test_links_of_several_models_have_their_models_in_the_name():
    """As in Drake."""
    inner = "<model name='x'><link name='b'><inertial/></link></model>"
    more = (
        f"<world name='w'><model name='n'>{inner}</model><model "
        f"name='k'>{inner}</model></world>"
    )
    assert set(jr.io.read_inertials(sdf("", more))) == {"m::b", "n::x::b", "k::x::b"}


@pytest.mark.parametrize(
    "text", [FILES["urdf"], FILES["euler"], sdf("<pose>1 2 3 1 2 3</pose>")]
)
def test_a_template_keeps_all_but_its_inertials(rng, tmp_path, text):
    body, path = bodies(rng)["a"], tmp_path / "robot"
    kept = "<!-- by hand --><visual><geometry><box size='1 1 1'/></geometry></visual>"
    end = "</body>" if "<mujoco><compiler" in text[:20] else "</link>"
    text = text.replace(end, kept.replace("visual", "extra") + end)
    jr.io.write_inertials(path, {"b": body}, template=text)
    assert "<!-- by hand -->" in path.read_text()
    assert "<box size=" in path.read_text()
    assert path.read_text().count("<inertial") == 1
    assert_same(jr.io.read_inertials(path)["b"], body, 0)
    jr.io.write_inertials(path, {"b": body.translated(np.ones(3))}, template=path)
    assert_same(jr.io.read_inertials(path)["b"], body.translated(np.ones(3)), 0)
    with pytest.raises(
        ValueError, match=r"`bodies` must name links of the template, but \['c'\]"
    ):
        jr.io.write_inertials(path, {"c": body}, template=path)


@pytest.mark.parametrize("space", ["xmlns:drake='drake.mit.edu'", "xmlns:ns0='other'"])
def test_a_template_keeps_what_is_around_its_root_and_its_prefixes(
    rng, tmp_path, space
):
    prefix = space[6:].partition("=")[0]
    before, after = (
        "<!-- Licence: yes --><?note by hand?>",
        "<!-- old: <robot/></robot> -->",
    )
    text = (
        f"{before}<robot {space}><?keep me?><{prefix}:plate/><link "
        f"name='b'/></robot>{after}"
    )
    jr.io.write_inertials(
        tmp_path / "b.urdf", {"b": bodies(rng)["a"]}, template=f"\n {text}\n"
    )
    lines = (tmp_path / "b.urdf").read_text().splitlines()
    assert lines[1:3] == ["<!-- Licence: yes -->", "<?note by hand?>"]
    assert lines[3].startswith(f"<robot xmlns:{prefix}=")
    assert lines[4].strip() == "<?keep me?>"
    assert lines[5].strip() == f"<{prefix}:plate />"
    assert lines[-1] == after


def test_a_batch_or_a_number_that_is_not_finite_is_not_written(tmp_path):
    path = tmp_path / "bodies.urdf"
    boxes = jax.vmap(lambda mass: jr.solids.box(mass, jnp.ones(3)))(jnp.ones(2))
    with pytest.raises(ValueError, match="must be one body, but it is a batch of 2"):
        jr.io.write_inertials(path, {"b": boxes})
    odd = jr.MassProperties.unchecked(1.0, jnp.zeros(3), jnp.eye(3) * jnp.nan)
    with pytest.raises(ValueError, match=r"`bodies\['b'\]` must be finite"):
        jr.io.write_inertials(path, {"b": odd})
    assert not path.exists()


def test_sdf_written_is_read(rng, tmp_path):
    known = bodies(rng)
    jr.io.write_inertials(tmp_path / "bodies.sdf", known)
    for name, body in jr.io.read_inertials(tmp_path / "bodies.sdf").items():
        assert_same(body, known[name], 0)
    with pytest.raises(
        ValueError, match=r"`path` must be one of '.urdf', '.xml', '.sdf', but"
    ):
        jr.io.write_inertials(tmp_path / "bodies.txt", known)


def test_mjcf_in_several_files(tmp_path):
    """As MuJoCo: what is included stands in its place, and the last compiler wins."""
    (tmp_path / "settings.xml").write_text(
        "<mujoco><compiler angle='radian'/></mujoco>"
    )
    (tmp_path / "arm.xml").write_text(
        "<mujocoinclude><body name='b'><inertial pos='0 0 1' mass='2' diaginertia='1 "
        "2 2.5' euler='0.4 -1.1 2'/><body><inertial pos='0 0 0' mass='1' "
        "diaginertia='1 1 1'/></body></body></mujocoinclude>"
    )
    path = tmp_path / "robot.xml"
    path.write_text(
        "<mujoco><compiler angle='degree' eulerseq='zxz'/><include "
        "file='settings.xml'/><worldbody><include file='arm.xml'/><body "
        "name='d'/></worldbody></mujoco>"
    )
    read = jr.io.read_inertials(path)
    assert list(read) == ["b", "body 2"]
    model = mujoco.MjModel.from_xml_path(str(path))
    mujoco.mj_saveLastXML(str(tmp_path / "whole.xml"), model)
    assert_same(read["b"], in_mujoco((tmp_path / "whole.xml").read_text()), 1e-5)


@pytest.mark.parametrize(
    ("name", "mass"), [("sub/b.xml", 3.0), ("b.xml", 3.0), ("c.xml", 2.0)]
)
def test_included_files_are_looked_for_where_mujoco_does(tmp_path, name, mass):
    def include(file):
        return f"<mujocoinclude><include file='{file}'/></mujocoinclude>"

    def body(mass):
        return mjcf(f"<inertial pos='0 0 0' mass='{mass}' diaginertia='1 1 1'/>")

    path, inner = tmp_path / "main.xml", tmp_path / "sub"
    inner.mkdir()
    path.write_text("<mujoco><include file='sub/a.xml'/></mujoco>")
    (inner / "a.xml").write_text(include(name))
    (inner / "b.xml").write_text(body(3.0).replace("mujoco>", "mujocoinclude>"))
    (inner / "c.xml").write_text(body(3.0).replace("mujoco>", "mujocoinclude>"))
    (tmp_path / "c.xml").write_text(body(2.0).replace("mujoco>", "mujocoinclude>"))
    assert mujoco.MjModel.from_xml_path(str(path)).body("b").mass == mass
    assert jr.io.read_inertials(path)["b"].mass == mass


OPTION = "<mujocoinclude><option/></mujocoinclude>"
TWICE = r"has an `<include file='{}'>`, but MuJoCo takes each file only once"
INCLUDES = {  # what main.xml includes, the other files, what is said
    "twice": ("<include file='a.xml'/>" * 2, {"a": OPTION}, TWICE.format("a.xml")),
    "twice, spelled otherwise": (
        "<include file='a.xml'/><include file='./x/../a.xml'/>",
        {"a": OPTION},
        TWICE.format("./x/../a.xml"),
    ),
    "by two others": (
        "<include file='a.xml'/><include file='b.xml'/>",
        {
            "a": OPTION.replace("<option", "<include file='c.xml'/><option"),
            "b": OPTION.replace("<option", "<include file='c.xml'/><option"),
            "c": OPTION,
        },
        r"b\.xml' " + TWICE.format("c.xml"),
    ),
    "itself": (
        "<include file='a.xml'/>",
        {"a": "<mujocoinclude><include file='a.xml'/></mujocoinclude>"},
        r"a\.xml' " + TWICE.format("a.xml"),
    ),
    "main": (
        "<include file='a.xml'/>",
        {"a": "<mujocoinclude><include file='main.xml'/></mujocoinclude>"},
        r"a\.xml' " + TWICE.format("main.xml"),
    ),
    "no name": ("<include/>", {}, r"main\.xml' has an `<include>` without a `file`"),
    "no file": ("<include file='a.xml'/>", {}, "'a.xml'>`, but that is no file"),
    "folder": ("<include file='.'/>", {}, "'.'>`, but that is no file"),
    "empty": ("<include file='a.xml'/>", {"a": ""}, r"a\.xml' cannot be parsed as XML"),
    "broken": (
        "<include file='a.xml'/>",
        {"a": "<mujocoinclude>\n<option></mujocoinclude>"},
        r"a\.xml' cannot be parsed as XML: mismatched tag: line 2",
    ),
    "without elements": (
        "<include file='a.xml'/>",
        {"a": "<mujocoinclude><!-- later --></mujocoinclude>"},
        r"a\.xml' is included, but it has no elements",
    ),
    "with children": (
        "<include file='a.xml'><option/></include>",
        {"a": OPTION},
        "with children: delete them",
    ),
}


@pytest.mark.parametrize("name", INCLUDES)
def test_includes_that_mujoco_refuses_are_refused(tmp_path, name):
    inside, others, match = INCLUDES[name]
    path = tmp_path / "main.xml"
    (tmp_path / "x").mkdir()
    path.write_text(f"<mujoco>{inside}</mujoco>")
    for other, text in others.items():
        (tmp_path / f"{other}.xml").write_text(text)
    with pytest.raises(ValueError):
        mujoco.MjModel.from_xml_path(str(path))
    with pytest.raises(ValueError, match=match):
        jr.io.read_inertials(path)


def test_a_pipe_is_refused_before_it_is_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.xml")
    with pytest.raises(ValueError, match=r"pipe\.xml' is not a regular one"):
        jr.io.read_inertials(tmp_path / "pipe.xml")
    path = tmp_path / "main.xml"
    path.write_text("<mujoco><include file='pipe.xml'/></mujoco>")
    with pytest.raises(ValueError, match=r"'pipe\.xml'>`, but that is no file"):
        jr.io.read_inertials(path)


def test_byte_order_marks_are_harmless(tmp_path):
    text = FILES["euler"].replace("<worldbody", "<include file='a.xml'/><worldbody")
    (tmp_path / "a.xml").write_text(OPTION, encoding="utf-8-sig")
    path = tmp_path / "main.xml"
    path.write_text(text, encoding="utf-8-sig")
    assert mujoco.MjModel.from_xml_path(str(path)).body("b").mass == 3
    expected = jr.io.read_inertials(FILES["euler"])["b"]
    assert_same(jr.io.read_inertials(path)["b"], expected, 0)
    assert_same(jr.io.read_inertials("\ufeff" + FILES["euler"])["b"], expected, 0)
    jr.io.write_inertials(tmp_path / "b.xml", {"b": expected}, template=path)
    assert_same(jr.io.read_inertials(tmp_path / "b.xml")["b"], expected, 0)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", r"File .*b\.urdf' cannot be parsed as XML: no element found: line 1"),
        ("<robot>\n<link>\n</robot>", r"b\.urdf' cannot be .*: mismatched tag: line 3"),
        ("<?xml version='1.0' encoding='none'?><robot/>", r"b\.urdf' cannot be parsed"),
        (
            urdf(f"<inertial><mass value='1_0'/><inertia {SIX}/></inertial>"),
            r"b\.urdf': The inertial of 'b' cannot be read: '1_0' must be a number",
        ),
    ],
)
def test_what_is_wrong_in_a_file_is_said_with_its_name(tmp_path, text, match):
    path = tmp_path / "b.urdf"
    path.write_text(text)
    with pytest.raises(ValueError, match=match):
        jr.io.read_inertials(path)
    if text.startswith("<robot>"):
        with pytest.raises(ValueError, match=match):
            jr.io.write_inertials(tmp_path / "c.urdf", {}, template=path)


def test_a_suffix_must_be_that_of_the_template(tmp_path):
    text = urdf(f"<inertial><mass value='1'/><inertia {SIX}/></inertial>")
    with pytest.raises(
        ValueError, match=r"'b\.sdf' would hold a template of root <rob"
    ):
        jr.io.write_inertials(tmp_path / "b.sdf", {}, template=text)


def test_a_file_that_is_not_there_is_no_empty_text(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.urdf"):
        jr.io.read_inertials(tmp_path / "none.urdf")
    for text in ("", " \n", "\ufeff"):
        with pytest.raises(ValueError, match="must be a file or XML, but it is empty"):
            jr.io.read_inertials(text)
    with pytest.raises(ValueError, match=r"The text cannot be parsed as XML: .*line 1"):
        jr.io.read_inertials("<robot>")


DIAGONAL = "<inertial mass='1' pos='0 0 0' diaginertia='1 1 1' {}/>"
FULL = "<inertial mass='1' pos='0 0 0' fullinertia='1 1 1 0 0 0' {}/>"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (
            mjcf(DIAGONAL.format("quat='1 0 0 0' euler='1 2 3'")),
            "takes only one of quat, euler",
        ),
        (mjcf(FULL.format("zaxis='0 0 1'")), "takes only one of zaxis, fullinertia"),
        *(
            (mjcf(DIAGONAL.format(f"{name}='{numbers}'")), f"`{name}` must state a dir")
            for name, numbers in (
                ("axisangle", "0 0 0 40"),
                ("xyaxes", "0.1 0.2 0.3 0.3 0.6 0.9"),
                ("xyaxes", "0 0 0 0 1 0"),
                ("zaxis", "0 0 0"),
            )
        ),
        (
            mjcf(FULL.format("diaginertia='1 1 1'")),
            "takes only one of fullinertia, diaginertia",
        ),
        (
            mjcf("<inertial pos='0 0 0' diaginertia='1 1 1'/>"),
            "'b' cannot be read: it has no mass",
        ),
        (mjcf("<inertial mass='1' diaginertia='1 1 1'/>"), "it has no pos"),
        (mjcf("<inertial mass='1' pos='0 0 0'/>"), "it has no diaginertia"),
        (
            mjcf(DIAGONAL.replace("'1'", "'1_0'", 1).format("")),
            "'1_0' must be a number",
        ),
    ],
)
def test_what_mujoco_refuses_is_refused(text, match):
    with pytest.raises(ValueError):
        mujoco.MjModel.from_xml_string(
            text.replace("<inertial", "<freejoint/><inertial")
        )
    with pytest.raises(ValueError, match=match):
        jr.io.read_inertials(text)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (
            urdf(f"<inertial><mass value='${{m}}'/><inertia {SIX}/></inertial>"),
            r"of 'b' cannot be read: '\$\{m\}' is a formula",
        ),
        (
            urdf(
                "<inertial><mass value='1'/><inertia ixx='1' ixz='0' iyy='1' izz='1' "
                "iyz='0'/></inertial>"
            ),
            r"of 'b' cannot be read: it has no inertia ixy\.$",
        ),
        (urdf("<inertial/>"), r"it has no mass value, no inertia ixx, no inertia iyy"),
        *(
            (
                f"<robot xmlns:xacro='{uri}'>"
                "<link name='a'><xacro:box_inertia m='1'/></link></robot>",
                "it has macros: `xacro a.xacro > a.urdf` first",
            )
            for uri in ("http://www.ros.org/wiki/xacro", "http://wiki.ros.org/xacro")
        ),
        (
            "<mujoco><include file='a.xml'/></mujoco>",
            "must be a path, but it is the text of a file",
        ),
        (
            sdf("", "<world name='w'><include><uri>model://x</uri></include></world>"),
            "gz sdf -p",
        ),
        (
            "<mujoco><worldbody><replicate count='2'><frame><body "
            "name='b'/></frame></replicate></worldbody></mujoco>",
            "`<replicate>` makes bodies: save the compiled model",
        ),
        (
            "<mujoco><worldbody><attach model='b'/></worldbody></mujoco>",
            "`<attach>` adds bodies",
        ),
        (
            "<mujoco><worldbody><body name='a'><frame pos='1 0 0'><inertial pos='0 1 0'"
            " mass='1' diaginertia='1 1 1'/></frame></body></worldbody></mujoco>",
            "an `<inertial>` is in a `<frame>`, which moves it",
        ),
        (
            mjcf("<inertial mass='1' pos='0 0 0' diaginertia='1 1 1'/>" * 2),
            "must have one `<inertial>` at most",
        ),
        (
            mjcf(
                "<inertial mass='1' pos='0 0 0' diaginertia='1 1 1' euler='1 2 3'/>",
                "angle='deg'",
            ),
            "`angle` must be one of 'degree', 'radian'",
        ),
        *(
            (
                mjcf(
                    "<inertial mass='1' pos='0 0 0' diaginertia='1 1 1'/>",
                    f"{option}='3'",
                ),
                f"`{option}` makes MuJoCo change it: save .*, "
                f"delete `{option}` there and read that",
            )
            for option in ("settotalmass", "boundmass", "boundinertia")
        ),
        (
            sdf("<pose degrees='yes'>0 0 0 0 0 0</pose>"),
            "`degrees` must be one of 'true', '1'",
        ),
        (
            sdf("<pose rotation_format='rpy'>0 0 0 0 0 0</pose>"),
            "one of 'euler_rpy', 'quat_xyzw'",
        ),
        (sdf("<pose>1 2 3</pose>"), "'1 2 3' must be 6 numbers"),
        (
            mjcf(
                "<inertial mass='1' pos='0 0 0' diaginertia='1 1 1'/>",
                "inertiafromgeom='true'",
            ),
            "overlook",
        ),
        (
            mjcf(
                "<inertial mass='1' pos='0 0 0' diaginertia='1 1 1'/>",
                "coordinate='global'",
            ),
            "global coordinates",
        ),
        (
            urdf(
                f"<inertial><mass value='1'/><inertia {SIX}/>"
                "<origin xyz='0 0 1'/><origin xyz='0 0 2'/></inertial>"
            ),
            "it has two <origin>",
        ),
        (
            sdf("<pose>0 0 1 0 0 0</pose><!-- or --><pose>0 0 2 0 0 0</pose>"),
            "it has two <pose>",
        ),
        (sdf("<pose relative_to='m'>0 0 0 0 0 0</pose>"), "relative to the link"),
        (
            "<sdf><model name='m'><link name='b'><inertial "
            "auto='true'/></link></model></sdf>",
            "`auto`",
        ),
        (
            "<robot><link name='a'/><link name='a'/></robot>",
            "must be unique, but 'a' is not",
        ),
        ("<html/>", "must be one of 'robot', 'mujoco', 'sdf', but it is 'html'"),
    ],
)
def test_files_that_cannot_be_read_say_why(text, match):
    with pytest.raises(ValueError, match=match):
        jr.io.read_inertials(text)


# What is wrong with an inertial: those of which users complained


def complaint(mass, center, six):
    """Of ixx, iyy, izz, ixy, ixz, iyz."""
    a, b, c, d, e, f = six
    body = jr.MassProperties.unchecked(
        mass, np.array(center, float), np.array([[a, d, e], [d, b, f], [e, f, c]])
    )
    return " ".join(jr.io.diagnose(body))


def test_mujoco_375_a_long_finger():
    text = complaint(0.01, [0, 0, 0], [1.486e-06, 2e-07, 8.31e-07, 0, 0, 0])
    assert "2e-07, 8.31e-07, 1.486e-06 kg m^2, of which the largest exceeds" in text
    assert "by 4.55e-07" in text
    assert "nearest_physical`), which changes it by" in text


def test_gepetto_130_talos_has_its_products_negated():
    text = complaint(0.0, [0, 0, 0], [1.15e-4, 1.53e-4, 1.9e-4, 5.2e-5, 2.5e-5, 3.4e-5])
    assert "The mass is 0 kg" in text
    assert "exceeds the sum of the others by 5.751e-06" in text  # as the complaint says
    assert "if its products of inertia are negated" in text


def test_compas_fab_486_a_shift_made_twice():
    text = complaint(40.0, [0, 0, 1.0], [-8.0, -8.0, 0.482, 0, 0, 0])
    assert "of which the smallest is negative" in text
    assert "already about the centre of mass when" in text
    assert "add it back" in text
    assert "products" not in text


def test_drake_19551_rounding():
    assert complaint(1.0, [0, 0, 0], [1.0, 1.0, 2.0 + 1e-15, 0, 0, 0]) == ""
    text = complaint(1.0, [0, 0, 0], [0.0833, 0.0833, 0.1667, 0, 0, 0])
    assert "as little as rounding to few digits makes" in text


def test_drake_11109_all_links_are_named_in_one_error():
    one = (
        "<inertial><mass value='{}'/><inertia ixx='{}' iyy='1' izz='1' ixy='0' "
        "ixz='0' iyz='0'/>"
    )
    one += "</inertial>"
    links = [
        one.format(1, 2.5),
        one.format(0, 1),
        one.format(1, 1),
        one.format(1, "nan"),
    ]
    text = "".join(f"<link name='l{i}'>{x}</link>" for i, x in enumerate(links))
    with pytest.raises(ValueError) as error:
        jr.io.read_inertials(f"<robot name='r'>{text}</robot>")
    lines = str(error.value).splitlines()
    assert lines[1].startswith(
        "'l0': The principal moments are 1, 1, 2.5 kg m^2, of which the lar"
    )
    assert lines[2].startswith("'l1': The mass is 0 kg, which is not positive")
    assert lines[3].startswith("'l3': A number is not finite")
    assert len(lines) == 4
    kept = jr.io.read_inertials(f"<robot name='r'>{text}</robot>", unphysical="keep")
    assert_allclose(kept["l0"].inertia[0, 0], 2.5)
    mended = jr.io.read_inertials(urdf(links[0]), unphysical="nearest")
    assert_allclose(mended["b"].inertia.diagonal(), [2.5, 1.25, 1.25])


def test_wrong_signs_and_orders_are_recognised():
    lean = jr.from_points(
        np.ones(4), np.array([[0.1, 0, 0], [3, 2, 1], [-3, -2, -1.1], [0, 0.1, 0]])
    )
    tensor = np.asarray(lean.inertia)
    a, b, c, d, e, f = (tensor[i] for i in zip(*np.triu_indices(3), strict=True))
    assert complaint(4.0, [0, 0, 0], [a, d, f, b, c, e]) == ""
    negated = complaint(4.0, [0, 0, 0], [a, d, f, -b, -c, -e])
    assert "if its products of inertia are negated" in negated
    # What MJCF wants is xx yy zz xy xz yz, what URDF says is xx xy xz yy yz zz.
    assert "where MJCF's `fullinertia` is" in complaint(
        4.0, [0, 0, 0], [a, b, c, d, e, f]
    )
    read = {"ixx": a, "ixy": d, "ixz": f, "iyy": b, "iyz": c, "izz": e}
    six = [read[k] for k in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")]
    assert "iyy iyz izz are asked for" in complaint(4.0, [0, 0, 0], six)


def test_what_looks_odd_is_told():
    rod = jr.solids.rod(1.0, 1.0).translated(np.array([0, 0, 0.5]))
    about_its_end = jr.MassProperties(1.0, rod.center_of_mass, rod.about(np.zeros(3)))
    [text] = jr.io.diagnose(about_its_end)
    assert "may be about the origin of the link" in text
    assert jr.io.diagnose(rod) == ()
    box = jr.solids.box(2.0, np.array([0.1, 0.2, 0.3]))
    for factor, unit in (
        (1e6, "0.11 m if the tensor is in kg mm^2"),
        (1e9, "0.11 m if in g mm^2"),
    ):
        [text] = jr.io.diagnose(
            jr.MassProperties(2.0, np.zeros(3), factor * box.inertia)
        )
        assert unit in text
    [text] = jr.io.diagnose(jr.MassProperties(2e6, np.zeros(3), box.inertia))
    assert "if the mass is in g." in text
    [text] = jr.io.diagnose(jr.MassProperties(2.0, np.array([50.0, 0, 0]), box.inertia))
    assert "is it in mm?" in text
    [text] = jr.io.diagnose(jr.MassProperties(1.0, np.zeros(3), np.ones(3)))
    assert "which programs write where they know none" in text
    assert jr.io.diagnose(jr.MassProperties(1.0, np.zeros(3), np.zeros(3))) == ()


def test_other_real_bodies_are_not_complained_of(rng):
    for body in bodies(rng).values():
        assert jr.io.diagnose(body.translated(-body.center_of_mass)) == ()
    far = jr.solids.sphere(1.0, 0.5).translated(
        np.array([0.5, 0, 0])
    )  # touches the origin
    assert jr.io.diagnose(far) == ()


def second(tensor):
    return 0.5 * np.trace(tensor) * AXES - tensor


@pytest.mark.parametrize("thickness", [0.0, 0.4])
def test_the_nearest_tensor_is_a_projection(rng, thickness):
    """The conditions of Karush, Kuhn and Tucker: S' - S and S' - l are semi-definite,
    product 0."""
    least = 3.0 * thickness**2 / 12
    for scale in (1.0, 1e-6):
        tensor = rng.normal(size=(3, 3))
        tensor = scale * (tensor + tensor.T)
        floor = least * scale
        nearest = np.asarray(jr.io.nearest_physical(tensor, 3.0 * scale, thickness))
        change, above = second(nearest - tensor), second(nearest) - floor * AXES
        assert np.linalg.eigvalsh(change)[0] >= -1e-14 * scale
        assert np.linalg.eigvalsh(above)[0] >= -1e-14 * scale
        assert abs(np.sum(change * above)) <= 1e-13 * scale**2
        assert np.linalg.norm(change) > 0.1 * scale
        for _ in range(20):  # and no other body's is nearer
            points = rng.normal(size=(4, 3))
            other = points.T @ points * scale * rng.uniform(0, 1) + floor * AXES
            other = second(nearest) + 0.1 * (other - second(nearest))
            assert np.linalg.norm(other - second(tensor)) >= np.linalg.norm(change)


def test_the_nearest_of_a_real_one_is_itself(rng):
    for body in [*bodies(rng).values(), jr.solids.box(1.0, np.array([1.0, 2.0, 3.0]))]:
        assert np.array_equal(jr.io.nearest_physical(body.inertia), body.inertia)
    assert_allclose(
        jr.io.nearest_physical(np.array([1.0, 1, 2.5])).diagonal(), [1.25, 1.25, 2.5]
    )


def test_mujoco_loads_the_nearest(rng):
    """Of a thickness: MuJoCo allows no rounding in A + B >= C."""
    bad = mjcf(
        "<freejoint/><inertial mass='2' pos='0 0 0' fullinertia='1 2 4 0.3 0.1 0'/>"
    )
    with pytest.raises(ValueError, match="A \\+ B >= C"):
        mujoco.MjModel.from_xml_string(bad)
    [body] = jr.io.read_inertials(bad, unphysical="nearest", thickness=1e-3).values()
    text = " ".join(
        repr(float(body.inertia[i]))
        for i in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    )
    assert_same(in_mujoco(bad.replace("1 2 4 0.3 0.1 0", text)), body, 1e-9)


# Tables


def motion(ts):
    body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    return lambda omega: jr.simulate(body, jr.State(jr.rotation.identity(), omega), ts)


def test_a_trajectory_as_tables():
    pandas, xarray = pytest.importorskip("pandas"), pytest.importorskip("xarray")
    omegas = jnp.array([[0.1, 1.0, 0.2], [0.3, 0.1, 0.2]])
    many = jax.vmap(motion(jnp.linspace(0.0, 2.0, 5)))(omegas)
    moved = jax.tree.map(lambda x: x[0], many)
    table, data = jr.io.to_pandas(moved), jr.io.to_xarray(moved)
    assert isinstance(table, pandas.DataFrame)
    assert isinstance(data, xarray.Dataset)
    assert_allclose(table.index, moved.ts)
    assert_allclose(table[["omega_x", "omega_y", "omega_z"]], moved.states.omega)
    assert_allclose(table[[f"attitude_{x}" for x in "wxyz"]], moved.states.attitude)
    assert_allclose(data.omega.sel(axis="z", time=2.0), moved.states.omega[-1, 2])
    assert table.attrs["units"] == {
        **{f"attitude_{x}": "1" for x in "wxyz"},
        **{f"omega_{x}": "rad/s" for x in "xyz"},
    }
    assert data.time.units == "s"
    assert data.attrs["result"] == "All went well."
    # Lanes, with their times in common and each with its own.
    lanes = jr.io.to_xarray(many)
    assert dict(lanes.sizes) == {"lane": 2, "time": 5, "component": 4, "axis": 3}
    assert_allclose(lanes.omega.isel(lane=1), many.states.omega[1])
    assert list(lanes.result.values) == ["All went well."] * 2
    own = jr.Trajectory(
        many.ts + jnp.array([[0.0], [1.0]]), *list(vars(many).values())[1:]
    )
    assert jr.io.to_xarray(own).time.dims == ("lane", "sample")
    for several in (
        many,
        jax.tree.map(lambda x: x[0, 0] if x.ndim > 1 else x[0], many),
    ):
        with pytest.raises(
            ValueError, match=r"shape \(n,\), but they have .*: use `to_xarray`"
        ):
            jr.io.to_pandas(several)


def test_a_trajectory_with_a_time_that_is_nan():
    """Of a `simulate` run with `throw=False`; its one lane has one clock."""
    pytest.importorskip("pandas")
    pytest.importorskip("xarray")
    body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    state = jr.State(jr.rotation.identity(), jnp.array([0.1, 1.0, 0.2]))
    ts = jnp.array([0.0, jnp.nan, 2.0])
    moved = jr.simulate(body, state, ts, throw=False)
    table = jr.io.to_pandas(moved)
    np.testing.assert_array_equal(table.index, moved.ts)
    np.testing.assert_array_equal(table["omega_x"], moved.states.omega[:, 0])
    assert jr.io.to_xarray(moved).omega.dims == ("time", "axis")


def test_a_flight_with_a_wheel_as_tables():
    pytest.importorskip("xarray")
    wheel = jr.torques.SpinningMass(0.1, np.array([0.0, 0, 1]))
    body = jr.FloatingBody(jr.solids.box(2.0, np.array([0.1, 0.2, 0.3])), None, wheel)
    start = jr.FloatingState(
        np.zeros(3), np.ones(3), jr.rotation.identity(), np.ones(3), (0.5,)
    )
    flown = jr.simulate(body, start, jnp.linspace(0.0, 1.0, 3))
    table = jr.io.to_pandas(flown)
    assert_allclose(table[["position_x", "velocity_y"]].iloc[-1], 1.0)
    assert_allclose(table["internal0"], flown.states.internal[0])


@pytest.fixture(scope="module")
def fit():
    record = jr.datasets.gyro_example()
    readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    return jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)


def test_a_fit_as_tables(fit):
    pytest.importorskip("xarray")
    table, data = jr.io.to_pandas(fit), jr.io.to_xarray(fit)
    assert_allclose(table.loc[["ratios_I2/I1", "ratios_I3/I1"], "value"], fit.ratios)
    assert_allclose(
        table.loc[["ratios_I2/I1", "ratios_I3/I1"], "error"], fit.ratios_errors
    )
    assert_allclose(data.shares, fit.shares)
    assert_allclose(data.moments_error**2, np.diagonal(fit.moments_covariance))
    assert list(data.number.values) == list(fit.names)
    assert_allclose(data.numbers_covariance, fit.numbers_covariance)
    assert data.inertia.units == "kg m^2"
    assert "describes the record" in data.attrs["status"]
    many = jax.tree.map(lambda x: jnp.stack([x, x]) if hasattr(x, "shape") else x, fit)
    with pytest.raises(ValueError, match="a single fit, but it is many"):
        jr.io.to_xarray(many)


def test_a_sweep_as_tables():
    pytest.importorskip("xarray")
    swept = jr.sweep(
        lambda x, y: {"sum": x + y},
        {"x": np.arange(3.0), "y": np.arange(2.0)},
        progress=False,
    )
    assert_allclose(
        jr.io.to_xarray(swept)["sum"], np.add.outer(np.arange(3.0), np.arange(2.0))
    )
    assert_allclose(jr.io.to_pandas(swept)["sum"].loc[2.0, 1.0], 3.0)


def test_a_missing_package_is_named_with_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match=r'needs trimesh: pip install "jrigid\[io\]"'):
        jr.io.read_mesh("box.stl")


def test_objects_of_an_obj_have_densities_of_their_own(tmp_path):
    lines = []
    for count, name in enumerate("AB"):
        box = trimesh.creation.box((1, 2, 3))
        box.apply_translation((5.0 * count, 0, 0))
        lines.append(f"o {name}")
        lines += ["v " + " ".join(map(str, x)) for x in box.vertices]
        lines += ["f " + " ".join(map(str, x + 1 + 8 * count)) for x in box.faces]
    path = tmp_path / "two.obj"
    path.write_text("\n".join(lines) + "\n")
    assert float(jr.io.read_mesh(path, 2.0).mass) == pytest.approx(24.0)
    both = jr.io.read_mesh(path, {"A": 1.0, "B": 3.0})
    assert float(both.mass) == pytest.approx(24.0)
    assert_allclose(both.center_of_mass, [3.75, 0, 0], atol=1e-12)
    with pytest.raises(ValueError, match="'B'"):
        jr.io.read_mesh(path, {"A": 1.0})


def test_a_format_that_needs_another_package_says_so(tmp_path, monkeypatch):
    def load_scene(*_, **__):
        raise ModuleNotFoundError("No module named 'cascadio'")

    path = tmp_path / "part.step"
    path.write_text("ISO-10303-21;")
    monkeypatch.setattr(trimesh, "load_scene", load_scene)
    with pytest.raises(ImportError, match=r"part\.step.*trimesh needs.*cascadio"):
        jr.io.read_mesh(path)
