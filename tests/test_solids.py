import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import quick_jit

import jrigid as jr

EPS = np.finfo(float).eps
CORNERS = np.array(
    [[0.1, 0.0, 0.3], [1.0, 0.2, -0.1], [0.3, 1.5, 0.2], [0.2, 0.4, 2.0]]
)

SOLIDS = {
    "box": (jr.solids.box, (2.0, np.array([1.0, 2.0, 3.0]))),
    "sphere": (jr.solids.sphere, (2.0, 1.5)),
    "shell": (jr.solids.shell, (2.0, 1.0, 1.5)),
    "ellipsoid": (jr.solids.ellipsoid, (2.0, np.array([1.0, 2.0, 3.0]))),
    "cylinder": (jr.solids.cylinder, (2.0, 1.5, 0.7)),
    "tube": (jr.solids.tube, (2.0, 1.0, 1.5, 0.7)),
    "cone": (jr.solids.cone, (2.0, 1.5, 0.7)),
    "rod": (jr.solids.rod, (2.0, 1.5)),
    "lamina": (jr.solids.lamina, (2.0, np.array([1.0, 2.0]))),
    "disk": (jr.solids.disk, (2.0, 1.5)),
    "hoop": (jr.solids.hoop, (2.0, 1.5)),
    "torus": (jr.solids.torus, (2.0, 1.5, 0.7)),
    "capsule": (jr.solids.capsule, (2.0, 1.5, 0.7)),
    "tetrahedron": (jr.solids.tetrahedron, (2.0, CORNERS)),
}


def test_every_public_name_is_in_the_table():
    names = {
        n for n, value in vars(jr.solids).items() if callable(value) and n[0] != "_"
    }
    missing = names - set(SOLIDS)
    assert not missing, f"add {sorted(missing)} to SOLIDS"
    assert not set(SOLIDS) - names


def assert_ulps(actual, expected, ulps):
    expected = np.asarray(expected)
    np.testing.assert_allclose(
        actual, expected, rtol=0, atol=ulps * EPS * np.max(np.abs(expected))
    )


def nodes(lower, upper, order=40):
    x, w = np.polynomial.legendre.leggauss(order)
    return lower + (x + 1) / 2 * (upper - lower), w * (upper - lower) / 2


def revolved(profiles, mass):
    """Moments of a solid of revolution about its centre: annuli from (z0, z1, inner,
    outer)."""
    volume = first = along = across = 0.0
    for z0, z1, inner, outer in profiles:
        z, w = nodes(z0, z1)
        a, b = inner(z), outer(z)
        area, polar = np.pi * (b**2 - a**2), np.pi * (b**4 - a**4) / 2
        volume, first = volume + np.sum(w * area), first + np.sum(w * area * z)
        along, across = (
            along + np.sum(w * polar),
            across + np.sum(w * (polar / 2 + area * z**2)),
        )
    centre = first / volume
    across -= volume * centre**2
    return centre, mass / volume * np.array([across, across, along])


def constant(x):
    return lambda z: x + 0 * z


@pytest.mark.parametrize(
    "name", ["sphere", "cylinder", "tube", "cone", "capsule", "shell"]
)
def test_solid_of_revolution_equals_its_integral(name):
    m, r, h, zero = 2.0, 1.5, 0.7, constant(0.0)

    def ball(radius):
        return lambda z: np.sqrt(np.maximum(radius**2 - z**2, 0))

    profiles, body = {
        "sphere": ([(-r, r, zero, ball(r))], jr.solids.sphere(m, r)),
        "cylinder": ([(-h / 2, h / 2, zero, constant(r))], jr.solids.cylinder(m, r, h)),
        "tube": (
            [(-h / 2, h / 2, constant(1.0), constant(r))],
            jr.solids.tube(m, 1.0, r, h),
        ),
        "cone": (
            [(-h / 4, 3 * h / 4, zero, lambda z: r * (0.75 - z / h))],
            jr.solids.cone(m, r, h),
        ),
        "capsule": (
            [
                (-h / 2, h / 2, zero, constant(r)),
                (h / 2, h / 2 + r, zero, lambda z: ball(r)(z - h / 2)),
                (-h / 2 - r, -h / 2, zero, lambda z: ball(r)(z + h / 2)),
            ],
            jr.solids.capsule(m, r, h),
        ),
        "shell": (
            [
                (-1.0, 1.0, ball(1.0), ball(r)),
                (1.0, r, zero, ball(r)),
                (-r, -1.0, zero, ball(r)),
            ],
            jr.solids.shell(m, 1.0, r),
        ),
    }[name]
    centre, moments = revolved(profiles, m)
    assert abs(centre) < 1e-14
    assert_ulps(body.inertia, np.diag(moments), 32)
    assert body.mass == m
    np.testing.assert_array_equal(body.center_of_mass, 0)


def test_torus_equals_its_integral():
    m, ring, tube = 2.0, 1.5, 0.7
    # z = tube sin a makes the profile analytic: the walls are ring -+ tube cos a.
    a, w = nodes(-np.pi / 2, np.pi / 2)
    z, dz = tube * np.sin(a), w * tube * np.cos(a)
    inner, outer = ring - tube * np.cos(a), ring + tube * np.cos(a)
    area, polar = np.pi * (outer**2 - inner**2), np.pi * (outer**4 - inner**4) / 2
    density = m / np.sum(dz * area)
    along, across = (
        density * np.sum(dz * polar),
        density * np.sum(dz * (polar / 2 + area * z**2)),
    )
    assert_ulps(
        jr.solids.torus(m, ring, tube).inertia, np.diag([across, across, along]), 32
    )


def test_thin_bodies_equal_sums_over_their_points():
    m, r, turns = 2.0, 1.5, 64
    angle = 2 * np.pi * np.arange(turns) / turns
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    assert_ulps(
        jr.solids.hoop(m, r).inertia,
        jr.inertia_tensor(np.full(turns, m / turns), r * circle),
        16,
    )
    rho, w = nodes(0, r, 8)
    rings = [
        jr.inertia_tensor(np.full(turns, 2 * w_ * x / r**2 * m / turns), x * circle)
        for x, w_ in zip(rho, w, strict=True)
    ]
    assert_ulps(jr.solids.disk(m, r).inertia, sum(rings), 16)
    height, w = nodes(-1, 1, 8)
    circles = [
        jr.inertia_tensor(
            np.full(turns, w_ / 2 * m / turns),
            r * (np.sqrt(1 - x**2) * circle + np.array([0, 0, x])),
        )
        for x, w_ in zip(height, w, strict=True)
    ]
    assert_ulps(jr.solids.shell(m, r, r).inertia, sum(circles), 16)
    x, w = nodes(-0.5, 0.5, 4)
    line = jr.from_points(w * m, np.stack([0 * x, 0 * x, r * x], axis=1))
    assert_ulps(jr.solids.rod(m, r).inertia, line.inertia, 8)
    grid = np.stack(
        [*np.meshgrid(x, 2 * x, indexing="ij"), np.zeros((4, 4))], axis=-1
    ).reshape(-1, 3)
    plate = jr.from_points(m * np.outer(w, w).ravel(), grid)
    assert_ulps(jr.solids.lamina(m, np.array([1.0, 2.0])).inertia, plate.inertia, 8)


def test_box_and_ellipsoid_equal_quadrature_in_three_dimensions():
    m, lengths = 2.0, np.array([1.0, 2.0, 3.0])
    density = m / np.prod(lengths)
    box = jr.from_density(
        lambda r: density + 0 * r[0], -lengths / 2, lengths / 2, order=4
    )
    assert_ulps(jr.solids.box(m, lengths).inertia, box.inertia, 8)
    # The ellipsoid's integral over spherical shells: x = (a, b, c) * radius *
    # direction.
    rho, w_rho = nodes(0, 1, 6)
    u, w_u = nodes(-1, 1, 6)
    phi = 2 * np.pi * np.arange(8) / 8
    rho, u, phi = (x.ravel() for x in np.meshgrid(rho, u, phi, indexing="ij"))
    side = np.sqrt(1 - u**2)
    points = lengths * (rho * np.stack([side * np.cos(phi), side * np.sin(phi), u])).T
    weights = np.einsum("i,j,k->ijk", w_rho, w_u, np.ones(8)).ravel() * rho**2
    cloud = jr.from_points(m * weights / weights.sum(), points)
    assert_ulps(jr.solids.ellipsoid(m, lengths).inertia, cloud.inertia, 16)


def test_polyhedra_equal_their_meshes():
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    mesh = jr.from_mesh(CORNERS, faces, 3.0)
    closed = jr.solids.tetrahedron(mesh.mass, CORNERS[[2, 0, 3, 1]])
    assert_ulps(closed.inertia, mesh.inertia, 16)
    assert_ulps(closed.center_of_mass, mesh.center_of_mass, 8)


def test_cylinder_transverse_moment_is_a_twelfth_not_a_half():
    m, r, h = 3.0, 0.5, 2.0
    inertia = jr.solids.cylinder(m, r, h).inertia
    assert_ulps(inertia[0, 0], m * h**2 / 12 + m * r**2 / 4, 2)
    assert_ulps(inertia[2, 2], m * r**2 / 2, 2)
    assert_ulps(jr.solids.cylinder(m, 1e-9, h).inertia, jr.solids.rod(m, h).inertia, 4)
    assert_ulps(jr.solids.cylinder(m, r, 1e-9).inertia, jr.solids.disk(m, r).inertia, 4)


def test_limits_join_the_solids_to_each_other():
    m, r = 2.0, 1.5
    pairs = [
        (jr.solids.ellipsoid(m, np.full(3, r)), jr.solids.sphere(m, r)),
        (jr.solids.shell(m, r * (1 - 1e-15), r), jr.solids.shell(m, r, r)),
        (jr.solids.shell(m, 1e-6, r), jr.solids.sphere(m, r)),
        (jr.solids.tube(m, r, r, 1e-9), jr.solids.hoop(m, r)),
        (jr.solids.torus(m, r, 1e-9), jr.solids.hoop(m, r)),
        (jr.solids.capsule(m, r, 1e-16), jr.solids.sphere(m, r)),
        (
            jr.solids.box(m, np.array([1.0, 2.0, 1e-9])),
            jr.solids.lamina(m, np.array([1.0, 2.0])),
        ),
    ]
    for thick, thin in pairs:
        assert_ulps(thick.inertia, thin.inertia, 16)


def test_two_half_cylinders_make_a_cylinder():
    half = jr.solids.cylinder(1.0, 1.5, 1.0)
    up = half.translated(np.array([0, 0, 0.5])) + half.translated(
        np.array([0, 0, -0.5])
    )
    assert_ulps(up.inertia, jr.solids.cylinder(2.0, 1.5, 2.0).inertia, 8)


def test_every_solid_under_jit_vmap_grad_and_jacfwd_in_both_precisions():
    # Mass properties scale with mass and length: mass I = dI/dmass, sum of length
    # dI/dlength = 2 I.
    def everything(scale, arguments):
        def scaled(name, mass_scale, length_scale):
            mass, *lengths = arguments[name]
            return SOLIDS[name][0](
                mass * mass_scale, *(x * length_scale for x in lengths)
            )

        bodies, by_mass, by_length = {}, {}, {}
        ones = jnp.stack([jnp.ones_like(scale), scale])
        for name in SOLIDS:  # one trace for both modes
            body, along = jax.linearize(lambda s, n=name: scaled(n, *s), ones)
            trace = eqx.tree_at(
                lambda x: x.inertia,
                jax.tree.map(jnp.zeros_like, body),
                jnp.eye(3, dtype=scale.dtype),
            )
            bodies[name], by_mass[name] = (
                body,
                along(jnp.array([1.0, 0.0], scale.dtype)),
            )
            by_length[name] = jax.linear_transpose(along, ones)(trace)[0][1]
        return bodies, by_mass, by_length

    batched = quick_jit(jax.vmap(everything, in_axes=(0, None)))
    for dtype in (np.float32, np.float64):
        arguments = jax.tree.map(
            lambda x, dtype=dtype: jnp.asarray(x, dtype),
            {k: v[1] for k, v in SOLIDS.items()},
        )
        scale = jnp.asarray([1.0, 2.0], dtype)
        bodies, by_mass, by_length = batched(scale, arguments)
        tolerance = 16 * float(np.finfo(dtype).eps)
        for name in SOLIDS:
            inertia = np.asarray(bodies[name].inertia)
            assert inertia.dtype == dtype
            np.testing.assert_allclose(inertia[1], 4 * inertia[0], rtol=tolerance)
            np.testing.assert_allclose(by_mass[name].inertia, inertia, rtol=tolerance)
            trace = np.trace(inertia, axis1=1, axis2=2)
            np.testing.assert_allclose(
                by_length[name], 2 * trace / scale, rtol=tolerance
            )
            for k in range(2):  # real bodies
                jr.MassProperties(*(x[k] for x in jax.tree.leaves(bodies[name])))


def bad_values():
    for name, (_, arguments) in SOLIDS.items():
        for k, argument in enumerate(arguments):
            for bad in (-1.0, 0.0, np.nan, np.inf):
                if name != "tetrahedron" or k == 0 or not np.isfinite(bad):
                    changed = np.array(argument)
                    changed.flat[-1] = bad
                    yield name, (*arguments[:k], changed, *arguments[k + 1 :])
    yield "tube", (1.0, 2.0, 1.0, 1.0)  # a bore wider than the tube
    yield "shell", (1.0, 1.1, 1.0)  # a cavity wider than the ball
    yield "torus", (1.0, 1.0, 2.0)  # a tube thicker than the ring


def test_a_bad_lane_is_nan_and_leaves_the_others_and_their_gradients_alone():
    cases = list(bad_values())

    def size(function, arguments):
        leaves = jax.tree.leaves(function(*arguments))
        return sum(
            jnp.sum(jnp.sin(jnp.where(jnp.isnan(x), 0.0, x))) for x in leaves
        ), leaves

    @quick_jit  # one compilation for all
    def gradients(lanes):
        return {
            name: jax.vmap(
                jax.grad(functools.partial(size, SOLIDS[name][0]), has_aux=True)
            )(own)
            for name, own in lanes.items()
        }

    lanes = {
        name: jax.tree.map(
            lambda *x: np.stack(x),
            arguments,
            *(changed for other, changed in cases if other == name),
        )
        for name, (_, arguments) in SOLIDS.items()
    }
    together = gradients(lanes)
    good_alone = gradients(jax.tree.map(lambda x: x[[0] * len(x)], lanes))
    for name in SOLIDS:
        (slopes, leaves), (alone, expected) = together[name], good_alone[name]
        for found, good in ((slopes, alone), (leaves, expected)):
            jax.tree.map(
                lambda a, b: np.testing.assert_array_equal(a[0], b[0]), found, good
            )
        for leaf in leaves:
            assert np.all(np.isfinite(leaf[0]))
            assert np.all(np.isnan(leaf[1:]))
        for slope in slopes:
            np.testing.assert_array_equal(slope[1:], 0.0)


def test_a_bad_lane_leaves_the_gradient_in_shared_arguments_alone():
    def total(shared, bad):
        bodies = [
            jr.solids.sphere(shared, bad),
            jr.solids.sphere(bad, shared),
            jr.solids.shell(1.0, shared / 2, 2 * bad),
            jr.solids.capsule(shared, bad, bad),
            jr.solids.tetrahedron(shared, CORNERS * bad),
        ]
        traces = [jnp.trace(body.inertia) for body in bodies]
        return sum(jnp.where(jnp.isnan(x), 0.0, x) for x in traces)

    both = quick_jit(
        jax.grad(lambda x, bad: jnp.sum(jax.vmap(total, (None, 0))(x, bad)))
    )
    alone = both(2.0, np.array([1.0, 1.0])) / 2
    for bad in (np.nan, np.inf, 0.0, -1.0):
        lanes = both(2.0, np.array([1.0, bad]))
        # Corners times 0 or -1 are good.
        corners = jr.solids.tetrahedron(
            1.0, CORNERS * np.nan_to_num(bad, posinf=0.0)
        ).inertia
        np.testing.assert_allclose(lanes, alone + jnp.trace(corners), rtol=16 * EPS)


@pytest.mark.parametrize("name", SOLIDS)
def test_wrong_shape_is_an_error(name, untyped):
    function, (mass, *lengths) = SOLIDS[name]
    with pytest.raises(ValueError, match=r"`mass` must have shape \(\)"):
        function(np.ones(3), *lengths)
    with pytest.raises(ValueError, match="must have shape"):
        function(mass, *(np.ones((2, 2)) for _ in lengths))
