import functools
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import jrigid as jr
from jrigid._checks import is_positive_definite, is_symmetric
from jrigid.mass._mesh import is_closed, is_closed_traced

EPS = np.finfo(float).eps
QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}

CUBE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
CUBE_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)
OUTWARD = np.array(
    [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
)  # of a right-handed tetrahedron
# F. Tonon, Explicit exact formulas for the 3-D tetrahedron inertia tensor in terms of
# its vertex coordinates, J. Math. Stat. 1 (2005) 8-11, the numerical example.
TONON = np.array(
    [
        [8.33220, -11.86875, 0.93355],
        [0.75523, 5.00000, 16.37072],
        [52.61236, 5.00000, -5.38580],
        [2.00000, 5.00000, 3.00000],
    ]
)
# About the centroid, density 1: a, b, c and the integrals of y z, x z, x y (his a', b',
# c').
TONON_MOMENTS = np.array([43520.33257, 194711.28938, 191168.76173])
TONON_PRODUCTS = np.array([4417.66150, -46343.16662, 11996.20119])


def rotation(seed):
    axes, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return axes * np.linalg.det(axes)


def symmetric(seed):
    a = np.random.default_rng(seed).normal(size=(3, 3))
    return a + a.T


def inertia_of(second):
    return np.trace(second) * np.eye(3) - second


def assert_nan(tree):
    assert all(np.all(np.isnan(leaf)) for leaf in jax.tree.leaves(tree))


def assert_ulps(actual, expected, ulps):
    actual, expected = np.asarray(actual), np.asarray(expected)
    scale = np.finfo(actual.dtype).eps * np.max(np.abs(expected))
    np.testing.assert_allclose(actual, expected, rtol=0, atol=ulps * scale)


# --- worked examples
# -------------------------------------------------------------------------


def test_cube_about_its_corner_and_its_centre():
    mass, a = 3.0, 2.0
    corner = mass * a**2 * (np.eye(3) * (2 / 3 + 1 / 4) - 1 / 4)
    centre = mass * a**2 / 6 * np.eye(3)
    density = mass / a**3
    bodies = {
        "solid": jr.solids.box(mass, jnp.full(3, a)).translated(jnp.full(3, a / 2)),
        "mesh": jr.from_mesh(a * CUBE, CUBE_FACES, density),
        "density": jr.from_density(
            lambda r: density + 0 * r[0], jnp.zeros(3), jnp.full(3, a)
        ),
    }
    for name, body in bodies.items():
        assert_ulps(body.about(jnp.zeros(3)), corner, 8), name
        assert_ulps(body.inertia, centre, 8), name
        assert_ulps(body.center_of_mass, np.full(3, a / 2), 8), name
    # The space diagonal is a principal axis: M a^2 / 6; across it 11/12 M a^2.
    principal = jr.principal_axes(bodies["solid"].about(jnp.zeros(3)))
    assert_ulps(principal.moments, mass * a**2 * np.array([1 / 6, 11 / 12, 11 / 12]), 8)
    assert_ulps(principal.axes[:, 0], np.full(3, 3**-0.5), 8)


def test_rod_about_its_centre_and_its_end():
    mass, length = 3.0, 2.0
    rod = jr.solids.rod(mass, length)
    assert_ulps(rod.inertia, mass * length**2 / 12 * np.diag([1, 1, 0]), 2)
    end = rod.about(jnp.array([0.0, 0.0, -length / 2]))
    assert_ulps(end, mass * length**2 / 3 * np.diag([1, 1, 0]), 2)


def test_rectangular_lamina_about_a_corner():
    mass, a, b = 2.0, 3.0, 1.5
    tensor = jr.solids.lamina(mass, jnp.array([a, b])).about(
        jnp.array([-a / 2, -b / 2, 0.0])
    )
    xy = -mass * a * b / 4
    expected = [
        [mass * b**2 / 3, xy, 0],
        [xy, mass * a**2 / 3, 0],
        [0, 0, mass * (a**2 + b**2) / 3],
    ]
    assert_ulps(tensor, expected, 4)
    x, y, _ = np.asarray(jr.principal_axes(tensor).axes[:, 0])
    np.testing.assert_allclose(
        np.tan(2 * np.arctan2(y, x)), 3 * a * b / (2 * (a**2 - b**2)), rtol=20 * EPS
    )


def test_square_lamina_about_a_corner_has_its_diagonals_as_principal_axes():
    lamina = jr.solids.lamina(1.0, jnp.array([1.0, 1.0])).about(
        jnp.array([-0.5, -0.5, 0.0])
    )
    principal = jr.principal_axes(lamina)
    assert_ulps(principal.moments, np.array([1 / 12, 7 / 12, 2 / 3]), 8)
    root = 0.5**0.5
    expected = np.array([[root, -root, 0], [root, root, 0], [0, 0, 1]])
    assert_ulps(principal.axes, expected, 8)
    # At the next corner the axis is (1, -1, 0): the tie of its components must not
    # decide the sign.
    flip = np.diag([1.0, -1.0, 1.0])
    other = flip @ lamina @ flip
    expected = np.array([[root, root, 0], [-root, root, 0], [0, 0, 1]])
    for seed in range(8):
        nudged = jr.principal_axes(other + 1e-13 * symmetric(seed)).axes
        np.testing.assert_allclose(nudged, expected, atol=1e-11)


def test_tonon_tetrahedron_with_products_of_inertia():
    mesh = jr.from_mesh(TONON, OUTWARD, 1.0)
    for body in (mesh, jr.solids.tetrahedron(mesh.mass, TONON)):
        tensor = np.asarray(body.inertia)
        found = np.concatenate([np.diag(tensor), -tensor[[1, 0, 0], [2, 2, 1]]])
        printed = np.concatenate([TONON_MOMENTS, TONON_PRODUCTS])
        # All six are printed 1.64e-8 too small: the volume there was rounded.
        np.testing.assert_allclose(found, printed, rtol=2e-8)
        np.testing.assert_allclose(found / found[1], printed / printed[1], rtol=2e-9)
        np.testing.assert_allclose(body.center_of_mass, TONON.mean(0), rtol=8 * EPS)


# --- composition and change of axes
# ----------------------------------------------------------


def test_parallel_axis_round_trip_and_both_moments_and_tensors():
    d = jnp.array([1.0, -2.0, 0.5])
    for inertia in (
        jnp.array([1.0, 2.0, 2.5]),
        jnp.asarray(rotation(1) @ np.diag([1, 2, 2.5]) @ rotation(1).T),
    ):
        displaced = jr.parallel_axis(inertia, 3.0, d)
        tensor = jnp.diag(inertia) if inertia.ndim == 1 else inertia
        direct = tensor + 3.0 * inertia_of(np.outer(d, d))
        assert_ulps(displaced, direct, 4)
        assert_ulps(jr.to_center_of_mass(displaced, 3.0, d), tensor, 64)


def test_composition_equals_the_cloud_taken_at_once():
    rng = np.random.default_rng(0)
    masses, positions = rng.uniform(0.5, 2, 30), rng.normal(size=(30, 3)) + 5.0
    whole = jr.from_points(masses, positions)
    parts = sum(
        jr.from_points(masses[i : i + 10], positions[i : i + 10]) for i in (0, 10, 20)
    )
    singles = sum(
        jr.MassProperties(m, r, np.zeros(3))
        for m, r in zip(masses[:3], positions[:3], strict=True)
    )
    three = jr.from_points(masses[:3], positions[:3])
    for a, b in ((parts, whole), (singles, three)):
        assert_ulps(a.mass, b.mass, 8)
        assert_ulps(a.center_of_mass, b.center_of_mass, 8)
        assert_ulps(a.inertia, b.inertia, 32)
    with pytest.raises(TypeError, match="unsupported operand"):
        _ = whole + 1
    with pytest.raises(TypeError, match="unsupported operand"):
        _ = 1 + whole


def test_rotation_and_translation_are_those_of_the_points():
    rng = np.random.default_rng(1)
    masses, positions = rng.uniform(0.5, 2, 20), rng.normal(size=(20, 3))
    q, d = jnp.array([0.5, -1.0, 2.0, 0.3]), jnp.array([3.0, 1.0, -2.0])
    turn = np.asarray(jr.rotation.to_matrix(q))
    moved = jr.from_points(masses, positions).rotated(q).translated(d)
    direct = jr.from_points(masses, positions @ turn.T + np.asarray(d))
    assert_ulps(moved.center_of_mass, direct.center_of_mass, 8)
    assert_ulps(moved.inertia, direct.inertia, 16)
    origin = jr.inertia_tensor(masses, positions @ turn.T + np.asarray(d))
    assert_ulps(moved.about(jnp.zeros(3)), origin, 16)
    np.testing.assert_allclose(
        moved.principal_axes().moments,
        jr.principal_axes(direct.inertia).moments,
        rtol=1e-14,
    )


# --- points, densities, meshes
# ---------------------------------------------------------------


@pytest.mark.parametrize("points", [1, 5, 1023, 1024, 5003])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_inertia_of_points_equals_numpy(points, dtype):
    rng = np.random.default_rng(points)
    masses = rng.uniform(0.5, 1.5, points).astype(dtype)
    positions = (rng.normal(size=(points, 3)) @ symmetric(0)).astype(dtype)
    exact = inertia_of(
        np.einsum(
            "n,na,nb->ab",
            *(np.asarray(x, np.float64) for x in (masses, positions, positions)),
        )
    )
    tensor = jr.inertia_tensor(masses, positions)
    assert tensor.dtype == dtype
    assert_ulps(tensor, exact.astype(dtype), 16)
    assert_ulps(jr.from_points(masses, positions).about(np.zeros(3, dtype)), tensor, 32)


def test_derivatives_of_the_inertia_of_many_points_in_every_mode():
    rng = np.random.default_rng(3)
    m, r = (
        jnp.asarray(rng.uniform(0.5, 1.5, 1500)),
        jnp.asarray(rng.normal(size=(1500, 3))),
    )
    weight, dm, dr = (
        jnp.asarray(symmetric(4)),
        jnp.asarray(rng.normal(size=1500)),
        r[::-1],
    )

    def f(m, r):
        return jnp.sum(weight * jr.inertia_tensor(m, r))

    core = np.asarray(jnp.trace(weight) * jnp.eye(3) - weight)
    gradient_m = np.einsum("na,ab,nb->n", r, core, r)
    gradient_r = 2 * np.asarray(m)[:, None] * (np.asarray(r) @ core)

    @jax.jit
    def derivatives(m, r):
        gradient = jax.grad(f, (0, 1))
        return (
            gradient(m, r),
            jax.jvp(f, (m, r), (dm, dr))[1],
            jax.jvp(gradient, (m, r), (dm, dr))[1],
        )

    (by_m, by_r), forward, (second_m, _) = derivatives(m, r)
    np.testing.assert_allclose(by_m, gradient_m, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(by_r, gradient_r, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(
        forward, np.sum(gradient_m * dm) + np.sum(gradient_r * dr), rtol=1e-12
    )
    np.testing.assert_allclose(
        second_m, 2 * np.einsum("na,ab,nb->n", r, core, dr), rtol=1e-10, atol=1e-11
    )


def test_a_body_far_from_the_origin_keeps_its_digits():
    far = np.full(3, 1e6)
    near_mesh, far_mesh = (
        jr.from_mesh(CUBE + d, CUBE_FACES) for d in (np.zeros(3), far)
    )
    # The corners themselves round to 1e6 eps = 2e-10, exactly: they are integers.
    assert_ulps(far_mesh.inertia, near_mesh.inertia, 8)
    assert_ulps(far_mesh.center_of_mass, far + 0.5, 2)
    near, distant = (jr.from_points(np.ones(8), CUBE + d) for d in (np.zeros(3), far))
    assert_ulps(distant.inertia, near.inertia, 8)


@pytest.mark.parametrize("towards", [[1.0, 0, 0], [0.6, 0.48, 0.64]])
@pytest.mark.parametrize("light", [1e-30, 1e-20, 1e-12, 1.0])
def test_a_point_far_away_costs_no_digits_whatever_its_mass(light, towards):
    rng = np.random.default_rng(20)
    masses = np.concatenate([[light], rng.uniform(0.5, 1, 20)])
    positions = np.concatenate([1e10 * np.array([towards]), rng.normal(size=(20, 3))])
    with mpmath.workdps(60):
        m, r = mpmath.matrix(masses.tolist()), mpmath.matrix(positions.tolist())
        center = (r.T * m) / sum(m)
        arms = mpmath.matrix(
            [[r[i, j] - center[j] for j in range(3)] for i in range(21)]
        )
        second = arms.T * mpmath.diag(list(m)) * arms
        trace = sum(second[i, i] for i in range(3))
        exact = np.array((trace * mpmath.eye(3) - second).tolist(), float)
        body = jr.from_points(masses, positions)
        assert_ulps(body.inertia, exact, 4)
        if towards[1] == 0:  # moment by moment, and so that none comes out negative
            np.testing.assert_allclose(
                np.diag(body.inertia), np.diag(exact), rtol=4 * EPS
            )
            assert (
                min(
                    mpmath.eigsy(
                        mpmath.matrix(body.inertia.tolist()), eigvals_only=True
                    )
                )
                > 0
            )


def test_density_by_quadrature_is_exact_for_polynomials():
    # rho = x y^2 over [0, 1] x [0, 2] x [1, 2]: moments by hand.
    body = jr.from_density(
        lambda r: r[0] * r[1] ** 2,
        jnp.array([0.0, 0, 1]),
        jnp.array([1.0, 2, 2]),
        order=3,
    )
    x = [1 / 2, 1 / 3, 1 / 4]
    y = [8 / 3, 4.0, 32 / 5]
    z = [1.0, 3 / 2, 7 / 3]
    mass = x[0] * y[0] * z[0]
    centre = np.array([x[1] / x[0], y[1] / y[0], z[1] / z[0]])
    second = np.array(
        [
            [x[2] * y[0] * z[0], x[1] * y[1] * z[0], x[1] * y[0] * z[1]],
            [x[1] * y[1] * z[0], x[0] * y[2] * z[0], x[0] * y[1] * z[1]],
            [x[1] * y[0] * z[1], x[0] * y[1] * z[1], x[0] * y[0] * z[2]],
        ]
    )
    assert_ulps(body.mass, mass, 8)
    assert_ulps(body.center_of_mass, centre, 8)
    assert_ulps(body.about(jnp.zeros(3)), inertia_of(second), 8)
    slope = jax.jit(
        jax.grad(
            lambda p: (
                jr.from_density(
                    lambda r: 1 + p * r[0] ** 2, jnp.zeros(3), jnp.ones(3), order=4
                ).mass
            )
        )
    )(1.0)
    np.testing.assert_allclose(slope, 1 / 3, rtol=8 * EPS)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_a_few_uneven_points_in_their_masses(mode):
    """The centre of mass is far from the mean of the points, so sums are made twice."""
    masses = jnp.array([1e-3, 1e-3, 1.0])
    positions = jnp.array([[0.0, 0, 0], [1.0, 2, 0], [10.0, 0, 3]])

    def center(masses):
        return jr.from_points(masses, positions).center_of_mass

    exact = (positions - center(masses)[None]).T / jnp.sum(masses)
    np.testing.assert_allclose(mode(center)(masses), exact, rtol=1e-13, atol=1e-14)


def test_a_cavity_is_a_surface_turned_inward():
    vertices = np.concatenate([4 * CUBE, 2 * CUBE + 1])
    faces = np.concatenate([CUBE_FACES, CUBE_FACES[:, ::-1] + 8])
    body = jr.from_mesh(vertices, faces)
    np.testing.assert_allclose(body.mass, 64 - 8, rtol=4 * EPS)
    assert_ulps(body.inertia, (64 * 16 - 8 * 4) / 6 * np.eye(3), 8)


def test_derivatives_of_a_mesh_in_its_vertices():
    weight, change = (
        jnp.asarray(symmetric(5)),
        np.random.default_rng(6).normal(size=(8, 3)),
    )

    def f(vertices):
        body = jr.from_mesh(vertices, CUBE_FACES, 2.0)
        return (
            body.mass + jnp.sum(body.center_of_mass**2) + jnp.sum(weight * body.inertia)
        )

    value = jax.jit(f)
    reverse, forward = jax.jit(
        lambda v: (
            jnp.sum(jax.grad(f)(v) * change),
            jax.jvp(f, (v,), (jnp.asarray(change),))[1],
        )
    )(CUBE)
    h = EPS ** (1 / 3)
    central = (value(CUBE + h * change) - value(CUBE - h * change)) / (2 * h)
    np.testing.assert_allclose(reverse, central, rtol=1e-9)
    np.testing.assert_allclose(forward, reverse, rtol=1e-13)
    # Gauss: the volume grows by the flux of the displacement, three volumes for a
    # dilation.
    dilation = jax.jit(
        lambda v: jax.jvp(lambda v: jr.from_mesh(v, CUBE_FACES).mass, (v,), (v,))[1]
    )(CUBE)
    np.testing.assert_allclose(dilation, 3.0, rtol=8 * EPS)


def _bad_meshes():
    flipped = CUBE_FACES.copy()
    flipped[3] = flipped[3, ::-1]
    out_of_range, negative = CUBE_FACES.copy(), CUBE_FACES.copy()
    out_of_range[CUBE_FACES == 7] = 8
    negative[CUBE_FACES == 7] = -1
    degenerate = np.concatenate([CUBE_FACES, [[0, 0, 1], [1, 0, 0]]])
    repeated = np.concatenate([CUBE_FACES, CUBE_FACES[:2]])
    # Two tetrahedra that share an edge: four faces meet there.
    four = np.concatenate([OUTWARD, [[0, 4, 1], [0, 1, 5], [0, 5, 4], [1, 4, 5]]])
    soup = np.arange(36).reshape(12, 3)
    closed, inside_out = "closed surface", "inside out"
    apex = np.array(
        [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, -1]]
    )
    big = np.concatenate(
        [CUBE, CUBE * 0.9 + 5]
    )  # a second cube, inside out and not inside
    return {
        "open": (CUBE, CUBE_FACES[:-1], closed),
        "open by two faces": (CUBE, CUBE_FACES[:-2], closed),
        "one face flipped": (CUBE, flipped, closed),
        "index out of range": (CUBE, out_of_range, closed),
        "negative index": (CUBE, negative, closed),
        "index beyond 32 bits": (CUBE, CUBE_FACES + 2**32, closed),
        "degenerate faces": (CUBE, degenerate, closed),
        "repeated faces": (CUBE, repeated, closed),
        "four faces at an edge": (apex, four, closed),
        "corners not merged": (CUBE[CUBE_FACES.ravel()], soup, closed),
        "inside out": (CUBE, CUBE_FACES[:, ::-1].copy(), inside_out),
        "flat": (CUBE * np.array([1, 1, 0]), CUBE_FACES, inside_out),
        "a part inside out": (
            big,
            np.concatenate([CUBE_FACES, CUBE_FACES[:, ::-1] + 8]),
            inside_out,
        ),
        "a corner at NaN": (
            np.where(CUBE == 1, np.nan, CUBE),
            CUBE_FACES,
            "`vertices` must be finite, but it is not: [",
        ),
    }


BAD_MESHES = _bad_meshes()


@pytest.mark.parametrize("name", BAD_MESHES)
def test_bad_mesh_is_an_error_for_known_faces(name):
    vertices, faces, message = BAD_MESHES[name]
    with pytest.raises(RuntimeError, match=re.escape(message)):
        jr.from_mesh(vertices, faces)
    assert_nan(jr.from_mesh(vertices, faces, throw=False))


mesh_of_traced_faces = jax.jit(functools.partial(jr.from_mesh, throw=False))


@pytest.mark.parametrize(
    "name",
    [
        "open by two faces",
        "one face flipped",
        "index out of range",
        "negative index",
        "index beyond 32 bits",
        "degenerate faces",
        "repeated faces",
        "four faces at an edge",
        "inside out",
        "corners not merged",
    ],
)
def test_bad_mesh_is_found_among_traced_faces(name):
    vertices, faces, _ = BAD_MESHES[name]
    assert_nan(mesh_of_traced_faces(vertices, faces))


@pytest.mark.parametrize(
    "fault", ["two faces gone", "four faces gone", "one flipped", "two doubled"]
)
def test_open_meshes_are_found_however_their_vertices_are_numbered(fault):
    rng = np.random.default_rng(17)
    meshes = []
    for _ in range(200):
        faces = rng.permutation(8)[CUBE_FACES][rng.permutation(12)]
        if fault == "one flipped":
            faces[0] = faces[0, ::-1]
        meshes.append(
            {
                "two faces gone": faces[2:],
                "four faces gone": faces[4:],
                "one flipped": faces,
                "two doubled": np.concatenate([faces, faces[:2]]),
            }[fault]
        )
    assert not any(is_closed(faces, 8) for faces in meshes)
    traced = jax.jit(jax.vmap(lambda faces: is_closed_traced(faces, 8)))(
        np.stack(meshes)
    )
    assert not np.any(traced)


def test_traced_faces_of_a_good_mesh_pass_whatever_their_order():
    rng = np.random.default_rng(7)
    for _ in range(3):
        order, roll = rng.permutation(12), rng.integers(3)
        faces = np.roll(CUBE_FACES[order], roll, axis=1)
        for body in (mesh_of_traced_faces(CUBE, faces), jr.from_mesh(CUBE, faces)):
            np.testing.assert_allclose(body.mass, 1.0, rtol=4 * EPS)
    assert_nan(mesh_of_traced_faces(CUBE, CUBE_FACES[:-1]))
    body = eqx.filter_jit(jr.from_mesh)(CUBE, jnp.asarray(CUBE_FACES))
    np.testing.assert_allclose(body.mass, 1.0, rtol=4 * EPS)


def test_an_inside_out_mesh_is_an_error_under_jit():
    body = eqx.filter_jit(lambda v: jr.from_mesh(v, CUBE_FACES))
    assert body(CUBE).mass == 1
    with pytest.raises(RuntimeError, match="inside out"):
        jax.block_until_ready(body(-CUBE))


def cubes(*parts):
    """Vertices and faces of cubes (centre, edge);
    a negative edge turns its cube inside out."""
    vertices = [edge * (CUBE - 0.5) + np.asarray(centre) for centre, edge in parts]
    faces = [CUBE_FACES + 8 * k for k in range(len(parts))]
    return np.concatenate(vertices), np.concatenate(faces)


BIG = ([0.0, 0, 0], 2.0)
PARTS = {
    "hollow": (BIG, ([0.1, 0.2, 0], -1.0)),
    "apart": (BIG, ([3.0, 0, 0], 1.0)),
    "face to face": (BIG, ([2.0, 0, 0], 2.0)),
    "a smaller one on a face": (BIG, ([1.5, 0.2, 0.1], 1.0)),
    "an island in a cavity": (BIG, ([0.0, 0, 0], -1.5), ([0.1, 0, 0], 0.5)),
    "many": tuple(([3.0 * k, 0, 0], 2.0) for k in range(20)),
    "far away": (([1e4, 0, 0], 2.0), ([1e4 + 3, 0, 0], 2.0)),
    "one without area": (BIG, ([0.1, 0.2, 0.0], 0.0), ([3.0, 0, 0], 1.0)),
    "overlapping": (BIG, ([0.5, 0, 0], 2.0)),
}


@pytest.mark.parametrize("name", PARTS)
def test_surfaces_are_taken_at_their_word(name):
    parts = PARTS[name]
    vertices, faces = cubes(*parts)
    volumes = np.array([edge**3 for _, edge in parts])
    centers = np.array([center for center, _ in parts])
    center = volumes @ centers / volumes.sum()
    arms = centers - center
    own = sum(edge**5 for _, edge in parts) / 6 * np.eye(3)
    for dtype in (np.float32, np.float64):
        eps = np.finfo(dtype).eps * (1 + np.max(np.abs(centers))) * 16
        body = jr.from_mesh(vertices.astype(dtype), faces)
        np.testing.assert_allclose(body.mass, volumes.sum(), rtol=eps)
        np.testing.assert_allclose(body.center_of_mass, center, rtol=eps, atol=eps)
        exact = own + inertia_of(np.einsum("n,na,nb->ab", volumes, arms, arms))
        np.testing.assert_allclose(
            body.inertia, exact, rtol=eps, atol=eps * np.max(exact)
        )


def test_derivatives_of_a_hollow_mesh_in_its_vertices():
    vertices, faces = cubes(BIG, ([0.1, 0.2, 0], -1.0))
    volume = lambda v, faces: jr.from_mesh(v, faces).mass  # noqa: E731
    found = jax.jit(jax.grad(lambda v: volume(v, faces)))(vertices)
    of_a_cube = jax.jit(jax.grad(lambda v: volume(v, CUBE_FACES)))
    # The cavity's own volume grows by as much as the body loses: a cube mirrored at its
    # centre.
    outer, inner = of_a_cube(vertices[:8]), -of_a_cube(-vertices[8:])
    np.testing.assert_allclose(found, np.concatenate([outer, -inner]), atol=8 * EPS)


# --- principal axes and functions of a tensor
# ------------------------------------------------


def test_principal_axes_rebuild_the_tensor_in_order_right_handed_with_fixed_signs():
    rng = np.random.default_rng(8)
    for dtype in (np.float32, np.float64):
        axes = np.linalg.qr(rng.normal(size=(500, 3, 3)))[0]
        moments = 10 ** rng.uniform(-6, 0, size=(500, 3))
        moments[:100, 1] = moments[:100, 0]
        moments[100:200, 2] = moments[100:200, 1] * (
            1 + 10 ** rng.uniform(-16, -2, 100)
        )
        tensors = np.einsum("nij,nj,nkj->nik", axes, moments, axes).astype(dtype)
        tensors = (tensors + np.swapaxes(tensors, 1, 2)) / 2
        found = jax.jit(jax.vmap(jr.principal_axes))(tensors)
        turned = np.float64(found.axes)
        rebuilt = np.einsum(
            "nij,nj,nkj->nik", turned, np.float64(found.moments), turned
        )
        eps = np.finfo(dtype).eps
        scale = np.max(np.abs(tensors), axis=(1, 2), keepdims=True)
        assert np.max(np.abs(rebuilt - tensors) / scale) < 16 * eps
        assert np.max(np.abs(np.swapaxes(turned, 1, 2) @ turned - np.eye(3))) < 8 * eps
        assert np.all(np.linalg.det(turned) > 0)
        assert np.all(np.diff(found.moments, axis=1) >= 0)
        leading = np.abs(turned) >= 0.9 * np.max(np.abs(turned), axis=1, keepdims=True)
        first = np.take_along_axis(turned, np.argmax(leading, axis=1)[:, None], axis=1)[
            :, 0
        ]
        assert np.all(first[:, [0, 2]] > 0)


def test_principal_axes_of_diagonal_tensors_are_exact():
    for moments in ([1.0, 2.0, 3.0], [0.1, 0.1, 0.3], [0.7, 0.7, 0.7], [0.0, 0.0, 0.0]):
        found = jr.principal_axes(jnp.array(moments))
        np.testing.assert_array_equal(found.moments, moments)
        np.testing.assert_array_equal(found.axes, np.eye(3))
    found = jr.principal_axes(jnp.array([3.0, 2.0, 1.0]))
    np.testing.assert_array_equal(found.axes, [[0, 0, 1], [0, -1, 0], [1, 0, 0]])
    tiny = jr.principal_axes(jnp.array([3.0, 2.0, 1.0]) * 1e-300).moments
    np.testing.assert_array_equal(tiny, np.array([1.0, 2.0, 3.0]) * 1e-300)


GAPS = [0.0, *(10.0**-k for k in (16, 15, 14, 12, 10, 8, 6, 4, 3))]
REPEATED = np.array(
    [
        *([1 + g, 1 + 2 * g, 1.0] for g in GAPS),  # near the sphere
        *([1.0, 1 + g, 1.5] for g in GAPS),
        *([0.7, 1.0, 1 + g] for g in GAPS),
    ]
)


def near_repeated():
    turned = [rotation(i) @ np.diag(m) @ rotation(i).T for i, m in enumerate(REPEATED)]
    tensors = np.concatenate([[np.diag(m) for m in REPEATED], turned])
    return (tensors + np.swapaxes(tensors, 1, 2)) / 2


def test_first_derivatives_of_symmetric_functions_of_moments_at_repeated_moments():
    # Exact by algebra: sum 1/m = tr I^-1, sum m^3 = tr I^3, prod m = det I.
    functions = {
        "sum of reciprocals": (
            lambda m: jnp.sum(1 / m),
            lambda a: -np.linalg.inv(a @ a),
        ),
        "sum of cubes": (lambda m: jnp.sum(m**3), lambda a: 3 * a @ a),
        "product": (jnp.prod, lambda a: np.linalg.det(a) * np.linalg.inv(a)),
        "middle of pairs": (
            lambda m: m[0] * m[1] + m[1] * m[2] + m[0] * m[2],
            lambda a: np.trace(a) * np.eye(3) - a,
        ),
    }
    tensors = near_repeated()
    directions = np.stack([symmetric(100 + i) for i in range(len(tensors))])

    @jax.jit
    @jax.vmap
    def derivatives(tensor, direction):
        def composed(name):
            return lambda tensor: functions[name][0](jr.principal_axes(tensor).moments)

        return {
            name: (
                jax.grad(composed(name))(tensor),
                jax.jvp(composed(name), (tensor,), (direction,))[1],
            )
            for name in functions
        }

    found = derivatives(tensors, directions)
    for name, (_, exact) in functions.items():
        reverse, forward = found[name]
        expected = np.stack([exact(tensor) for tensor in tensors])
        np.testing.assert_allclose(
            reverse, expected, atol=2e-14 * np.max(np.abs(expected))
        )
        along = np.einsum("nij,nij->n", expected, directions)
        np.testing.assert_allclose(forward, along, atol=1e-13 * np.max(np.abs(along)))


def test_derivatives_of_axes_where_moments_are_apart_and_where_they_repeat():
    direction = jnp.asarray(symmetric(9))
    tensor = jnp.asarray(rotation(2) @ np.diag([1.0, 1.7, 2.3]) @ rotation(2).T)
    slope = jax.jit(
        lambda tensor: jax.jvp(
            lambda x: jr.principal_axes(x).axes, (tensor,), (direction,)
        )[1]
    )
    axes = jax.jit(lambda tensor: jr.principal_axes(tensor).axes)
    h = EPS ** (1 / 3)
    central = (axes(tensor + h * direction) - axes(tensor - h * direction)) / (2 * h)
    np.testing.assert_allclose(slope(tensor), central, atol=1e-8)
    np.testing.assert_array_equal(slope(jnp.eye(3)), 0.0)
    assert np.all(np.isfinite(slope(jnp.diag(jnp.array([1.0, 1.0, 2.0])))))


ORDERS = {
    "forward over forward": (jax.jacfwd, jax.jacfwd),
    "forward over reverse": (jax.jacfwd, jax.jacrev),
    "reverse over forward": (jax.jacrev, jax.jacfwd),
    "reverse over reverse": (jax.jacrev, jax.jacrev),
}


def test_tensor_function_to_second_order_at_repeated_moments():
    # Exact by algebra, f = 1/x: D f[H] = -J H J, D2 f[H, G] = J H J G J + J G J H J, J
    # = I^-1; f = x^3: D f[H] = H I I + I H I + I I H and so on.
    tensors = near_repeated()
    h_all = np.stack([symmetric(200 + i) for i in range(len(tensors))])
    g_all = np.stack([symmetric(300 + i) for i in range(len(tensors))])

    def exact(tensor, h, g):
        j = np.linalg.inv(tensor)
        inverse = -j @ h @ j, j @ h @ j @ g @ j + j @ g @ j @ h @ j
        cube = (
            h @ tensor @ tensor + tensor @ h @ tensor + tensor @ tensor @ h,
            sum(
                a @ b @ c
                for a, b, c in (
                    (h, g, tensor),
                    (g, h, tensor),
                    (h, tensor, g),
                    (g, tensor, h),
                    (tensor, h, g),
                    (tensor, g, h),
                )
            ),
        )
        return inverse, cube

    @jax.jit
    @jax.vmap
    def found(tensor, h, g):
        def orders(f):
            def first(tensor):
                return jax.jvp(lambda x: jr.tensor_function(f, x), (tensor,), (h,))[1]

            return jax.jvp(first, (tensor,), (g,))

        return orders(lambda x: 1 / x), orders(lambda x: x**3)

    expected = [exact(*case) for case in zip(tensors, h_all, g_all, strict=True)]
    for k, pair in enumerate(found(tensors, h_all, g_all)):
        for order, values in enumerate(pair):
            wanted = np.stack([case[k][order] for case in expected])
            scale = np.max(np.abs(wanted), axis=(1, 2), keepdims=True)
            assert np.max(np.abs(values - wanted) / scale) < (1e-13, 1e-12)[order]


def test_tensor_function_second_derivatives_agree_in_every_mode_and_in_parameters():
    # sum(weight * I^p), p captured by the closure: d/dp of tr I^p is tr(I^p log I).
    weight = jnp.asarray(symmetric(11))

    def f(tensor, p):
        return jnp.sum(weight * jnp.sin(jr.tensor_function(lambda m: m**p, tensor)))

    cases = jnp.stack(
        [
            jnp.eye(3),
            jnp.diag(jnp.array([1.0, 1.0, 1.5])),
            jnp.asarray(near_repeated()[-3]),
        ]
    )
    p = jnp.asarray(0.7)

    @functools.partial(jax.jit, compiler_options=QUICK)
    def every(cases):
        second = {
            name: jax.vmap(lambda x, o=o: o[0](o[1](f))(x, p))(cases)
            for name, o in ORDERS.items()
        }
        mixed = jax.vmap(lambda x: jax.jacrev(jax.grad(f), argnums=1)(x, p))(cases)
        return second, mixed

    gradient = jax.jit(jax.vmap(jax.grad(f), in_axes=(0, None)))
    second, mixed = every(cases)
    reference = second.pop("forward over forward")
    for other in second.values():
        np.testing.assert_allclose(other, reference, atol=1e-13)
    h = EPS ** (1 / 3)
    for i, j in ((0, 1), (1, 2), (0, 0)):
        step = np.zeros((3, 3))
        step[i, j] += h / 2
        step[j, i] += h / 2
        central = (
            gradient(cases + step[None], p) - gradient(cases - step[None], p)
        ) / (2 * h)
        expected = 0.5 * (reference[..., i, j] + reference[..., j, i])
        np.testing.assert_allclose(central, expected, atol=1e-9)
    central = (gradient(cases, p + h) - gradient(cases, p - h)) / (2 * h)
    np.testing.assert_allclose(mixed, central, atol=1e-9)


@functools.partial(jax.jit, compiler_options=QUICK)
def square_root_and_slopes(tensor, h, g):
    def first(tensor):
        return jax.jvp(lambda x: jr.tensor_function(jnp.sqrt, x), (tensor,), (h,))[1]

    return jax.jvp(first, (tensor,), (g,))


@pytest.mark.parametrize(
    "moments", [[1.0, 1.0, 1.0], [1.0, 1 + 1e-9, 1.5], [1e-4, 1.0, 1 + 1e-5]]
)
def test_tensor_function_square_root_against_mpmath(moments):
    mpmath.mp.dps = 60
    tensor = rotation(3) @ np.diag(moments) @ rotation(3).T
    tensor = (tensor + tensor.T) / 2
    h, g = symmetric(12), symmetric(13)

    def root(step_h, step_g):
        steps = [mpmath.matrix(x.tolist()) for x in (tensor, h, g)]
        values, axes = mpmath.eigsy(steps[0] + step_h * steps[1] + step_g * steps[2])
        return axes * mpmath.diag([mpmath.sqrt(x) for x in values]) * axes.T

    e = mpmath.mpf(10) ** -15
    first = (root(e, 0) - root(-e, 0)) / (2 * e)
    second = (root(e, e) - root(e, -e) - root(-e, e) + root(-e, -e)) / (4 * e * e)
    first, second = (np.array(x.tolist(), float) for x in (first, second))
    found = square_root_and_slopes(tensor, h, g)
    tolerance = 30 * EPS * max(moments) / min(moments)
    np.testing.assert_allclose(found[0], first, atol=tolerance * np.max(np.abs(first)))
    np.testing.assert_allclose(
        found[1], second, atol=30 * tolerance * np.max(np.abs(second))
    )


def test_third_derivatives_of_tensor_function_raise_instead_of_being_wrong():
    def f(tensor):
        return jnp.trace(jr.tensor_function(jnp.exp, tensor))

    forward = jax.jacfwd(jax.jacfwd(jax.jacfwd(f)))
    reverse = jax.grad(lambda x: jax.hessian(f)(x)[0, 0, 0, 0])
    for third in (forward, reverse):
        with pytest.raises(NotImplementedError, match="Third derivatives"):
            jax.jit(third)(jnp.eye(3))


# --- transformations and precision
# -----------------------------------------------------------


def every_function(x):
    """All of the module's functions of one array (3,) near one;
    x[0] < x[1] + x[2] and so on."""
    tensor = jnp.diag(x) + 0.1 * x[0] * (
        jnp.ones((3, 3), x.dtype) - jnp.eye(3, dtype=x.dtype)
    )
    quaternion = jnp.concatenate([x, x[:1]])
    body = jr.MassProperties(x[0], x, tensor)
    moved = body.translated(x)
    points = jnp.stack([x, 2 * x[::-1], -x])
    principal = jr.principal_axes(tensor)
    return {
        "from_points": jr.from_points(x, points),
        "inertia_tensor": jr.inertia_tensor(x, points),
        "from_density": jr.from_density(
            lambda r: 1 + jnp.sum((r * x) ** 2), -x, x, order=3
        ),
        "from_mesh": jr.from_mesh(
            jnp.asarray(CUBE, x.dtype) * x[None, :], CUBE_FACES, x[1]
        ),
        "parallel_axis": jr.parallel_axis(x, x[0], x),
        "to_center_of_mass": jr.to_center_of_mass(tensor, 0.01 * x[0], x),
        "principal_axes": principal.moments,
        "PrincipalAxes": principal.axes,
        "tensor_function": jr.tensor_function(jnp.log, tensor),
        "second_moment": jr.mass.second_moment(tensor),
        "inertia_of_second_moment": jr.mass.inertia_of_second_moment(tensor),
        "MassProperties": body,
        "MassProperties.unchecked": jr.MassProperties.unchecked(x[0], x, tensor),
        "MassProperties.about": body.about(2 * x),
        "MassProperties.translated": moved.center_of_mass,
        "MassProperties.rotated": moved.rotated(quaternion) + body,
        "MassProperties.principal_axes": body.principal_axes().moments,
    }


def test_every_public_name_is_among_the_functions():
    names = {
        name
        for name, value in vars(jr.mass).items()
        if not name.startswith("_")
        and "jrigid.mass" in getattr(value, "__module__", "")
    }
    for name in ("MassProperties", "PrincipalAxes"):
        kind = getattr(jr.mass, name)
        own = set(vars(kind)) - set(kind.__dataclass_fields__)
        names |= {f"{name}.{method}" for method in own if not method.startswith("_")}
    assert set(jax.eval_shape(every_function, jnp.ones(3))) == names


def test_every_function_under_jit_vmap_grad_and_jacfwd_in_both_precisions():
    x64 = jnp.array([1.0, 1.1, 1.3])

    def everything(x):
        def total(x):
            return sum(
                jnp.sum(jnp.cos(leaf)) for leaf in jax.tree.leaves(every_function(x))
            )

        slopes, values = jax.jacfwd(lambda x: (every_function(x),) * 2, has_aux=True)(x)
        return values, slopes, jax.grad(total)(x)

    def forward_total(values, slopes):
        pairs = zip(jax.tree.leaves(values), jax.tree.leaves(slopes), strict=True)
        return sum(-np.tensordot(np.sin(v), s, axes=np.ndim(v)) for v, s in pairs)

    batched = jax.jit(jax.vmap(everything), compiler_options=QUICK)
    results = {}
    for dtype in (jnp.float64, jnp.float32):
        values, slopes, gradient = batched(jnp.stack([x64, x64[::-1]]).astype(dtype))
        assert all(
            leaf.dtype == dtype for leaf in jax.tree.leaves((values, slopes, gradient))
        )
        assert all(
            np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves((values, slopes))
        )
        one = jax.tree.map(lambda leaf: np.asarray(leaf[0]), (values, slopes))
        scale = np.max(np.abs(gradient))
        np.testing.assert_allclose(
            forward_total(*one), gradient[0], atol=100 * jnp.finfo(dtype).eps * scale
        )
        results[dtype] = (values, slopes)
    eager = every_function(x64)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b[0], atol=1e-14),
        eager,
        results[jnp.float64][0],
    )
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-4),
        results[jnp.float32],
        results[jnp.float64],
    )


def weighted_sum(body):
    """A number that mass, centre and every moment enter with curvature."""
    weights = np.cos(1.0 + np.arange(9.0)).reshape(3, 3)
    return (
        body.mass**2
        + jnp.sum(jnp.sin(body.center_of_mass))
        + jnp.sum(weights * body.inertia**2)
    )


HOLLOW, HOLLOW_FACES = cubes(([0.0, 0, 0], 1.0), ([0.1, 0.05, 0], -0.5))
CLOUD = np.random.default_rng(0).normal(size=(40, 3))
CURVED = {
    "mesh": (lambda v: jr.from_mesh(v, CUBE_FACES, 2.0), CUBE),
    "mesh with a cavity": (lambda v: jr.from_mesh(v, HOLLOW_FACES, 2.0), HOLLOW),
    "positions": (lambda r: jr.from_points(jnp.arange(1.0, 41.0) / 40, r), CLOUD),
    "positions of many": (
        lambda r: jr.from_points(jnp.ones(1200) / 1200, jnp.concatenate([r] * 30)),
        CLOUD,
    ),
    "masses": (lambda m: jr.from_points(m, CLOUD), np.arange(1.0, 41.0) / 40),
    "density": (
        lambda c: jr.from_density(
            lambda r: 1 + jnp.sum((r * c) ** 2), -ONES, ONES, order=4
        ),
        np.array([1.0, 0.5, 2.0]),
    ),
    "box of a density": (
        lambda a: jr.from_density(lambda r: jnp.exp(r[0] - r[1]), -a, ONES, order=4),
        np.array([1.0, 0.5, 2.0]),
    ),
    "capsule": (lambda x: jr.solids.capsule(*x), np.array([1.0, 0.5, 2.0])),
    "shell": (lambda x: jr.solids.shell(*x), np.array([1.0, 0.5, 1.2])),
    "tetrahedron": (
        lambda v: jr.solids.tetrahedron(1.5, v),
        np.array([[0.1, 0, 0.3], [1, 0.2, -0.1], [0.3, 1.5, 0.2], [0.2, 0.4, 2]]),
    ),
    "turned": (
        lambda q: jr.solids.box(1.0, np.arange(1.0, 4)).translated(ONES).rotated(q),
        np.array([1.0, 0.2, 0.3, 0.4]),
    ),
}


@pytest.mark.parametrize("name", CURVED)
def test_second_derivatives_equal_differences_of_the_gradient(name):
    body, x = CURVED[name]
    total = lambda x: weighted_sum(body(x))  # noqa: E731
    rng = np.random.default_rng(1)
    along, across = rng.normal(size=x.shape), rng.normal(size=x.shape)

    @functools.partial(jax.jit, compiler_options=QUICK)
    def derivatives(x):
        gradient, curvature = jax.jvp(jax.grad(total), (x,), (along,))
        forward = jax.jvp(lambda x: jax.jvp(total, (x,), (across,))[1], (x,), (along,))[
            1
        ]
        return gradient, curvature, forward

    _, curvature, forward = derivatives(x)
    h = 1e-5
    difference = (derivatives(x + h * along)[0] - derivatives(x - h * along)[0]) / (
        2 * h
    )
    scale = np.max(np.abs(difference))
    # truncation is about h^2 of the fourth derivative, rounding eps / h
    np.testing.assert_allclose(curvature, difference, rtol=0, atol=1e-8 * scale)
    size = scale * np.sum(np.abs(across))
    np.testing.assert_allclose(
        np.sum(curvature * across), forward, rtol=0, atol=64 * EPS * size
    )


def test_a_gradient_in_mass_properties_has_their_shape():
    body = jr.solids.box(1.0, jnp.array([1.0, 2.0, 3.0]))
    gradient = jax.grad(lambda body: jnp.trace(body.about(jnp.ones(3))))(body)
    assert isinstance(gradient, jr.MassProperties)
    np.testing.assert_allclose(gradient.mass, 6.0)
    np.testing.assert_allclose(gradient.inertia, np.eye(3))


# --- bad input
# -------------------------------------------------------------------------------

ONES, ZEROS = np.ones(3), np.zeros(3)
SKEW = np.arange(9.0).reshape(3, 3)
THREE_LANES = np.array([[1.0, 2.0, 2.5], [1.0, 1.0, 1.5], [2.0, 2.0, 2.0]])
POINTS = np.eye(3)

BAD_VALUES = {
    "negative mass": (
        jr.MassProperties,
        (-1.0, ZEROS, ONES),
        r"`mass` must be positive and finite, but it is not: -1\.0\.",
    ),
    "zero mass": (jr.MassProperties, (0.0, ZEROS, ONES), "`mass` must be positive"),
    "NaN mass": (jr.MassProperties, (np.nan, ZEROS, ONES), "`mass` must be positive"),
    "NaN centre": (
        jr.MassProperties,
        (1.0, ZEROS * np.nan, ONES),
        "`center_of_mass` must be finite",
    ),
    "NaN moment": (
        jr.MassProperties,
        (1.0, ZEROS, ONES * np.nan),
        "`inertia` must hold three",
    ),
    "infinite moment": (
        jr.MassProperties,
        (1.0, ZEROS, ONES * np.inf),
        "`inertia` must hold three",
    ),
    "negative moment": (
        jr.MassProperties,
        (1.0, ZEROS, np.array([-0.1, 1, 1])),
        r"`inertia` must hold three.*: \[-0\.1",
    ),
    "three lanes of moments": (
        jr.MassProperties,
        (1.0, ZEROS, THREE_LANES),
        "three lanes of `jax.vmap`",
    ),
    "triangle inequality": (
        jr.MassProperties,
        (1.0, ZEROS, np.array([1.0, 1.0, 2.1])),
        "real body",
    ),
    "negative point mass": (
        jr.from_points,
        (-ONES, POINTS),
        r"`masses` must be finite and non-negative, but it is not: -1\.0",
    ),
    "massless points": (
        jr.from_points,
        (ZEROS, POINTS),
        "`masses` must not be all zero",
    ),
    "NaN point mass": (
        jr.from_points,
        (ONES * np.nan, POINTS),
        "`masses` must be finite",
    ),
    "NaN position": (
        jr.from_points,
        (ONES, POINTS * np.nan),
        r"`positions` must be finite, but it is not: \[nan",
    ),
    "negative density": (
        lambda c, **k: jr.from_density(lambda r: c * r[0], ZEROS, ONES, **k),
        (-1.0,),
        "`density` must be finite and non-negative",
    ),
    "NaN density": (
        lambda c, **k: jr.from_density(lambda r: c * r[0], ZEROS, ONES, **k),
        (np.nan,),
        "`density` must be finite",
    ),
    "no density": (
        lambda c, **k: jr.from_density(lambda r: c * r[0], ZEROS, ONES, **k),
        (0.0,),
        "`density` must not be zero",
    ),
    "box turned round": (
        lambda a, b, **k: jr.from_density(lambda r: 1 + r[0], a, b, **k),
        (ONES, ZEROS),
        "`lower` < `upper`",
    ),
    "negative density of a mesh": (
        lambda d, **k: jr.from_mesh(CUBE, CUBE_FACES, d, **k),
        (-1.0,),
        "`density` must be positive",
    ),
}


@pytest.mark.parametrize("name", BAD_VALUES)
def test_bad_value_is_an_error_or_nan(name):
    function, arguments, message = BAD_VALUES[name]
    with pytest.raises(RuntimeError, match=message):
        function(*arguments)
    assert_nan(function(*arguments, throw=False))


@pytest.mark.parametrize(
    "name",
    [
        "negative mass",
        "three lanes of moments",
        "triangle inequality",
        "NaN position",
        "negative density",
    ],
)
def test_bad_value_is_an_error_under_jit(name):
    function, arguments, message = BAD_VALUES[name]
    with pytest.raises(RuntimeError, match=message.partition(", but it is not: ")[0]):
        jax.block_until_ready(eqx.filter_jit(function)(*arguments))


BAD_LANES = {
    "negative mass": (jr.MassProperties, ([1.0, -1, 2], [ONES] * 3, [ONES] * 3)),
    "NaN centre": (
        jr.MassProperties,
        ([1.0, 1, 2], [ONES, ONES * np.nan, ONES], [ONES] * 3),
    ),
    "three lanes of moments": (
        jr.MassProperties,
        ([1.0, 1, 2], [ONES] * 3, [np.eye(3), THREE_LANES, np.eye(3)]),
    ),
    "NaN inertia": (
        jr.MassProperties,
        ([1.0, 1, 2], [ONES] * 3, [ONES, ONES * np.nan, ONES]),
    ),
    "triangle inequality": (
        jr.MassProperties,
        ([1.0, 1, 2], [ONES] * 3, [ONES, [1, 1, 3.0], ONES]),
    ),
    "points: negative mass": (jr.from_points, ([ONES, -ONES, ONES], [POINTS] * 3)),
    "points: NaN": (jr.from_points, ([ONES] * 3, [POINTS, POINTS * np.nan, POINTS])),
    "mesh inside out": (
        lambda v, throw=True: jr.from_mesh(v, CUBE_FACES, throw=throw),
        ([CUBE, -CUBE, 2 * CUBE],),
    ),
    "mesh open": (
        lambda f, throw=True: jr.from_mesh(CUBE, f, throw=throw),
        (
            np.stack(
                [CUBE_FACES, np.roll(CUBE_FACES, 1, 0) * 0 + CUBE_FACES[:1], CUBE_FACES]
            ),
        ),
    ),
    "mesh of a negative density": (
        lambda d, throw=True: jr.from_mesh(CUBE, CUBE_FACES, d, throw=throw),
        ([1.0, -1, 2],),
    ),
    "negative density": (
        lambda c, throw=True: jr.from_density(
            lambda r: c * r[0], ZEROS, ONES, order=2, throw=throw
        ),
        ([1.0, -1, 2],),
    ),
}


@pytest.mark.parametrize("name", BAD_LANES)
def test_a_bad_lane_is_named_or_nan_and_leaves_the_others_alone(name):
    function, lanes = BAD_LANES[name]
    lanes = [np.asarray(x) for x in lanes]
    with pytest.raises(RuntimeError, match=r"in lane 1\."):
        jax.vmap(function)(*lanes)
    batch = jax.jit(jax.vmap(functools.partial(function, throw=False)))(*lanes)
    for i in (0, 2):
        lane, alone = (
            jax.tree.map(lambda x, i=i: x[i], batch),
            function(*(x[i] for x in lanes)),
        )
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=4 * EPS), lane, alone
        )
    assert_nan(jax.tree.map(lambda x: x[1], batch))


GOOD_CENTER = np.array([0.5, -1.0, 2.0])
BAD_FORMULAS = {
    "skew tensor displaced": (
        jr.parallel_axis,
        ([np.eye(3), SKEW], [1.0, 1], [ONES] * 2),
    ),
    "NaN tensor displaced": (
        jr.parallel_axis,
        ([ONES, ONES * np.nan], [1.0, 1], [ONES] * 2),
    ),
    "negative mass displaced": (jr.parallel_axis, ([ONES] * 2, [1.0, -1], [ONES] * 2)),
    "displaced to infinity": (
        jr.parallel_axis,
        ([ONES] * 2, [1.0, 1], [ONES, ONES * np.inf]),
    ),
    "three lanes displaced back": (
        jr.to_center_of_mass,
        ([4 * np.eye(3), THREE_LANES], [1.0, 1], [ONES] * 2),
    ),
    "NaN displaced back": (
        jr.to_center_of_mass,
        ([3 * ONES, ONES * np.nan], [0.1, 0.1], [ONES] * 2),
    ),
    "NaN mass displaced back": (
        jr.to_center_of_mass,
        ([3 * ONES] * 2, [0.1, np.nan], [ONES] * 2),
    ),
    "displaced back from NaN": (
        jr.to_center_of_mass,
        ([3 * ONES] * 2, [0.1, 0.1], [ONES, ONES * np.nan]),
    ),
    "displaced back too far": (
        jr.to_center_of_mass,
        ([3 * ONES] * 2, [0.1, 3.0], [ONES] * 2),
    ),
    "negative mass of a point": (jr.inertia_tensor, ([ONES, -ONES], [POINTS] * 2)),
    "NaN position of a point": (
        jr.inertia_tensor,
        ([ONES] * 2, [POINTS, POINTS * [[1, 1, np.nan]]]),
    ),
    "axes of a skew tensor": (jr.principal_axes, ([np.diag([1.0, 2.0, 3.0]), SKEW],)),
    "axes of three lanes": (
        jr.principal_axes,
        ([np.diag([1.0, 2.0, 3.0]), THREE_LANES],),
    ),
    "axes of NaN": (jr.principal_axes, ([ONES * [1, 2, 3], ONES * np.nan],)),
    "function of a skew tensor": (
        functools.partial(jr.tensor_function, jnp.log),
        ([np.eye(3) * 2, SKEW],),
    ),
    "function of NaN": (
        functools.partial(jr.tensor_function, jnp.log),
        ([ONES * 2, ONES * np.nan],),
    ),
    "about a place of a bad body": (
        lambda i, x: jr.MassProperties(2.0, GOOD_CENTER, i, throw=False).about(x),
        ([ONES, -ONES], [ONES] * 2),
    ),
    "about no place": (jr.solids.sphere(2.0, 1.0).about, ([ONES, ONES * np.nan],)),
    "zero turn": (
        jr.solids.box(2.0, ONES).translated(GOOD_CENTER).rotated,
        ([np.arange(4.0), np.zeros(4)],),
    ),
}


@pytest.mark.parametrize("name", BAD_FORMULAS)
def test_a_bad_lane_of_a_formula_is_nan_and_leaves_the_other_and_its_gradient_alone(
    name,
):
    function, lanes = BAD_FORMULAS[name]
    lanes = [np.asarray(x, float) for x in lanes]

    def total(*lanes):
        answers = jax.vmap(function)(*lanes)
        finite = [
            jnp.where(jnp.isnan(x), 0.0, jnp.sin(x)) for x in jax.tree.leaves(answers)
        ]
        return sum(jnp.sum(x) for x in finite), answers

    both = jax.jit(jax.value_and_grad(total, tuple(range(len(lanes))), has_aux=True))
    (_, answers), slopes = both(*lanes)
    (_, alone), expected = both(*(x[[0, 0]] for x in lanes))
    assert_nan(jax.tree.map(lambda x: x[1], answers))
    for found, good in ((answers, alone), (slopes, expected)):
        jax.tree.map(
            lambda a, b: np.testing.assert_array_equal(a[0], b[0]), found, good
        )
    assert all(np.all(np.isfinite(x[0])) for x in jax.tree.leaves(answers))
    assert any(np.any(x[0] != 0) for x in slopes)
    for slope in slopes:
        np.testing.assert_array_equal(slope[1], 0.0)


def test_a_bad_tensor_leaves_the_gradient_in_the_parameters_of_its_function_alone():
    def total(p, tensors):
        found = jax.vmap(lambda x: jr.tensor_function(lambda m: m**p, x))(tensors)
        return jnp.sum(jnp.where(jnp.isnan(found), 0.0, found))

    slope = jax.jit(jax.grad(total))
    good = 3 * 2**0.7 * np.log(2)
    np.testing.assert_allclose(
        slope(0.7, np.stack([2 * np.eye(3), SKEW])), good, rtol=8 * EPS
    )
    np.testing.assert_allclose(
        slope(0.7, np.stack([2 * np.eye(3)] * 2)), 2 * good, rtol=8 * EPS
    )


def test_what_is_done_with_a_bad_body_is_nan():
    good, q = jr.solids.sphere(1.0, 1.0), jnp.array([1.0, 2.0, 3.0, 4.0])
    bodies = [
        jr.MassProperties(-1.0, ZEROS, ONES, throw=False),
        jr.solids.sphere(1.0, -1.0),
        good.rotated(jnp.zeros(4)),
    ]
    for body in bodies:
        assert_nan(
            [body, good + body, body + good, body.translated(ONES), body.rotated(q)]
        )
        assert_nan([body.about(ZEROS), body.principal_axes(), sum([good, body])])
    lost = good.translated(jnp.full(3, jnp.inf))
    assert_nan([lost + good, lost.rotated(q), lost.about(ZEROS)])


NAN_LANE = np.array([1.0, np.nan])
SHARED = {
    "points, a bad mass": (
        lambda x, bad: jr.from_points(jnp.stack([bad, 1.0]), x, throw=False),
        POINTS[:2] + 1,
    ),
    "points, a bad position": (
        lambda m, bad: jr.from_points(m, POINTS * bad, throw=False),
        ONES,
    ),
    "mesh, a bad vertex": (
        lambda d, bad: jr.from_mesh(CUBE * bad, CUBE_FACES, d, throw=False),
        2.0,
    ),
    "mesh, a bad density": (
        lambda v, bad: jr.from_mesh(v, CUBE_FACES, bad, throw=False),
        CUBE,
    ),
    "density, a bad box": (
        lambda c, bad: jr.from_density(
            lambda r: c * r[0], ZEROS, ONES * bad, order=2, throw=False
        ),
        2.0,
    ),
    "sum, a bad centre": (
        lambda m, bad: (
            jr.solids.sphere(m, 1.0)
            + jr.MassProperties(m, bad * ONES, ONES, throw=False)
        ),
        2.0,
    ),
    "sum, a bad mass": (
        lambda x, bad: (
            jr.solids.sphere(1.0, 1.0).translated(x)
            + jr.MassProperties(bad, ZEROS, ONES, throw=False)
        ),
        ONES,
    ),
    "turn of a bad body": (
        lambda q, bad: jr.MassProperties(1.0, ONES, bad * ONES, throw=False).rotated(q),
        np.arange(1.0, 5),
    ),
    "bad turn": (
        lambda m, bad: jr.solids.box(m, np.arange(1.0, 4)).rotated(
            np.arange(4.0) * bad
        ),
        2.0,
    ),
    "zero turn": (
        lambda m, bad: jr.solids.box(m, np.arange(1.0, 4)).rotated(
            jnp.nan_to_num(np.arange(4.0) * bad)
        ),
        2.0,
    ),
    "bad shift": (lambda m, bad: jr.solids.sphere(m, 1.0).translated(bad * ONES), 2.0),
}


@pytest.mark.parametrize("name", SHARED)
def test_a_bad_lane_leaves_the_gradient_in_shared_arguments_alone(name):
    function, shared = SHARED[name]

    def total(x, bad):
        body = function(x, bad)
        origin = body.about(jnp.zeros(3))
        value = (
            body.mass + jnp.sum(jnp.sin(body.center_of_mass)) + jnp.sum(jnp.cos(origin))
        )
        return jnp.where(jnp.isfinite(value), value, 0.0)

    shared = jnp.asarray(shared)
    both = jax.jit(jax.grad(lambda x, bad: jnp.sum(jax.vmap(total, (None, 0))(x, bad))))
    twice = both(shared, np.ones(2))
    assert np.any(twice != 0)
    np.testing.assert_allclose(
        both(shared, NAN_LANE), twice / 2, rtol=64 * EPS, atol=64 * EPS
    )


@pytest.mark.parametrize("scale", [1e-30, 1.0, 4e37])
def test_checks_of_a_tensor_do_not_depend_on_its_scale(scale):
    good = np.array([[3.0, 0.3, -0.2], [0.3, 3.5, 0.4], [-0.2, 0.4, 4.0]])
    turn = rotation(0)
    negative, odd = (
        turn @ np.diag(x) @ turn.T for x in ([-0.2, 2.0, 2.1], [1.0, 2.0, 3.5])
    )
    for tensor, message in (
        (good, None),
        (negative, "must hold three"),
        (odd, "real body"),
    ):
        tensor = jnp.asarray(tensor * scale, jnp.float32)
        assert is_symmetric(tensor)
        assert is_positive_definite(tensor) == (message != "must hold three")
        body = functools.partial(
            jr.MassProperties, jnp.float32(1), jnp.zeros(3, jnp.float32), tensor
        )
        if message is None:
            np.testing.assert_array_equal(body().inertia, tensor)
        else:
            assert_nan(body(throw=False))
            with pytest.raises(RuntimeError, match=message):
                body()
    tensor = jnp.asarray(good * scale, jnp.float32)
    displacement = jnp.asarray([0.5, 0.0, 0.0], jnp.float32)
    reduced = jr.to_center_of_mass(tensor, jnp.float32(scale), displacement)
    assert np.all(np.isfinite(reduced))
    assert_nan(jr.to_center_of_mass(tensor, jnp.float32(8 * scale), 2 * displacement))
    thin = jnp.diag(jnp.asarray([1e-30, 1e-30, 1.0], jnp.float32))
    assert is_positive_definite(thin)
    assert not is_positive_definite(0 * thin)


def test_thin_bodies_are_bodies():
    for moments in ([1.0, 1.0, 2.0], [0.3, 0.4, 0.7], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0]):
        body = jr.MassProperties(1.0, ZEROS, np.array(moments))
        for seed in range(4):
            turned = body.rotated(
                jnp.asarray(np.random.default_rng(seed).normal(size=4))
            )
            again = jr.MassProperties(
                turned.mass, turned.center_of_mass, turned.inertia
            )
            np.testing.assert_array_equal(again.inertia, turned.inertia)


def test_bodies_print_their_numbers():
    body = jr.solids.box(12.0, np.array([1.0, 2.0, 3.0]))
    assert "mass=12." in repr(body)
    assert "moments=[ 5., 10., 13.]" in repr(body.principal_axes())


WRONG_SHAPES = {
    "mass": (jr.MassProperties, (ONES, ZEROS, ONES), r"`mass` must have shape \(\)"),
    "centre": (
        jr.MassProperties,
        (1.0, np.zeros(2), ONES),
        r"`center_of_mass` must have shape \(3,\)",
    ),
    "inertia": (
        jr.MassProperties,
        (1.0, ZEROS, np.ones(6)),
        r"`inertia` must have shape \(3,\) or",
    ),
    "masses": (
        jr.from_points,
        (np.ones((3, 1)), POINTS),
        r"`masses` must have shape \(n,\)",
    ),
    "positions": (
        jr.from_points,
        (ONES, POINTS[:2]),
        r"`positions` must have shape \(3, 3\)",
    ),
    "no points": (jr.from_points, (np.ones(0), np.ones((0, 3))), "at least one point"),
    "tensor of nothing": (
        jr.inertia_tensor,
        (np.ones(0), np.ones((0, 3))),
        "at least one point",
    ),
    "lower": (
        lambda: jr.from_density(jnp.sum, np.zeros(2), ONES),
        (),
        r"`lower` must have shape",
    ),
    "upper": (
        lambda: jr.from_density(jnp.sum, ZEROS, np.ones(2)),
        (),
        r"`upper` must have shape",
    ),
    "order": (
        lambda: jr.from_density(jnp.sum, ZEROS, ONES, order=1),
        (),
        "`order` must be an integer",
    ),
    "density": (
        lambda: jr.from_density(lambda r: r, ZEROS, ONES),
        (),
        "`density` must map",
    ),
    "vertices": (
        jr.from_mesh,
        (CUBE[:, :2], CUBE_FACES),
        r"`vertices` must have shape \(n, 3\)",
    ),
    "faces": (
        jr.from_mesh,
        (CUBE, CUBE_FACES.ravel()),
        r"`faces` must have shape \(n, 3\)",
    ),
    "fractional faces": (
        jr.from_mesh,
        (CUBE, CUBE_FACES * 1.0),
        "`faces` must hold integers",
    ),
    "no faces": (jr.from_mesh, (CUBE, CUBE_FACES[:0]), "at least one face"),
    "mesh density": (
        jr.from_mesh,
        (CUBE, CUBE_FACES, ONES),
        r"`density` must have shape \(\)",
    ),
    "displaced tensor": (
        jr.parallel_axis,
        (np.ones(2), 1.0, ONES),
        "`inertia` must have shape",
    ),
    "displaced mass": (jr.parallel_axis, (ONES, ONES, ONES), "`mass` must have shape"),
    "displacement": (
        jr.to_center_of_mass,
        (ONES, 1.0, 1.0),
        "`displacement` must have shape",
    ),
    "mass displaced back": (
        jr.to_center_of_mass,
        (ONES, ONES, ONES),
        "`mass` must have shape",
    ),
    "axes": (jr.principal_axes, (np.ones((3, 2)),), "`inertia` must have shape"),
    "function": (
        lambda: jr.tensor_function(lambda x: jnp.stack([x, x]), ONES),
        (),
        "`f` must map",
    ),
    "point": (
        lambda: jr.solids.rod(1.0, 1.0).about(1.0),
        (),
        "`point` must have shape",
    ),
    "shift": (
        lambda: jr.solids.rod(1.0, 1.0).translated(1.0),
        (),
        "`displacement` must have shape",
    ),
    "turn": (
        lambda: jr.solids.rod(1.0, 1.0).rotated(ONES),
        (),
        "`attitude` must have shape",
    ),
}


@pytest.mark.parametrize("name", WRONG_SHAPES)
def test_wrong_shape_is_an_error(name, untyped):
    function, arguments, message = WRONG_SHAPES[name]
    with pytest.raises(ValueError, match=message):
        function(*arguments)


def test_lists_place_and_turn_a_body(untyped):
    box = jr.solids.box(2.0, np.array([0.1, 0.2, 0.3]))
    moved = box.translated([0.1, 0, 0])
    np.testing.assert_allclose(moved.center_of_mass, [0.1, 0, 0])
    expected = moved.about(np.zeros(3))
    np.testing.assert_array_equal(moved.about([0, 0, 0]), expected)
    turned = box.rotated([1.0, 0, 0, 0])
    np.testing.assert_allclose(turned.inertia, box.inertia, rtol=1e-15)
