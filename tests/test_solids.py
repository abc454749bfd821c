# ruff: noqa: E501
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jrigid as jr

EPS = np.finfo(float).eps
CORNERS = np.array([[0.1, 0.0, 0.3], [1.0, 0.2, -0.1], [0.3, 1.5, 0.2], [0.2, 0.4, 2.0]])

SOLIDS = {
    "box": (jr.solids.box, (2.0, np.array([1.0, 2.0, 3.0]))),
    "sphere": (jr.solids.sphere, (2.0, 1.5)),
    "shell": (jr.solids.shell, (2.0, 1.5)),
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
    names = {n for n, value in vars(jr.solids).items() if callable(value) and n[0] != "_"}
    assert set(SOLIDS) == names


def thick_shell(mass, radius, inner_radius, throw=True):
    return jr.solids.shell(mass, radius, inner_radius=inner_radius, throw=throw)


def assert_ulps(actual, expected, ulps):
    expected = np.asarray(expected)
    np.testing.assert_allclose(actual, expected, rtol=0, atol=ulps * EPS * np.max(np.abs(expected)))


def nodes(lower, upper, order=40):
    x, w = np.polynomial.legendre.leggauss(order)
    return lower + (x + 1) / 2 * (upper - lower), w * (upper - lower) / 2


def revolved(profiles, mass):
    """Moments of a solid of revolution about its centre: annuli from (z0, z1, inner, outer)."""
    volume = first = along = across = 0.0
    for z0, z1, inner, outer in profiles:
        z, w = nodes(z0, z1)
        a, b = inner(z), outer(z)
        area, polar = np.pi * (b**2 - a**2), np.pi * (b**4 - a**4) / 2
        volume, first = volume + np.sum(w * area), first + np.sum(w * area * z)
        along, across = along + np.sum(w * polar), across + np.sum(w * (polar / 2 + area * z**2))
    centre = first / volume
    across -= volume * centre**2
    return centre, mass / volume * np.array([across, across, along])


def constant(x):
    return lambda z: x + 0 * z


@pytest.mark.parametrize("name", ["sphere", "cylinder", "tube", "cone", "capsule", "thick shell"])
def test_solid_of_revolution_equals_its_integral(name):
    m, r, h, zero = 2.0, 1.5, 0.7, constant(0.0)

    def ball(radius):
        return lambda z: np.sqrt(np.maximum(radius**2 - z**2, 0))

    profiles, body = {
        "sphere": ([(-r, r, zero, ball(r))], jr.solids.sphere(m, r)),
        "cylinder": ([(-h / 2, h / 2, zero, constant(r))], jr.solids.cylinder(m, r, h)),
        "tube": ([(-h / 2, h / 2, constant(1.0), constant(r))], jr.solids.tube(m, 1.0, r, h)),
        "cone": ([(-h / 4, 3 * h / 4, zero, lambda z: r * (0.75 - z / h))], jr.solids.cone(m, r, h)),
        "capsule": (
            [
                (-h / 2, h / 2, zero, constant(r)),
                (h / 2, h / 2 + r, zero, lambda z: ball(r)(z - h / 2)),
                (-h / 2 - r, -h / 2, zero, lambda z: ball(r)(z + h / 2)),
            ],
            jr.solids.capsule(m, r, h),
        ),
        "thick shell": (
            [(-1.0, 1.0, ball(1.0), ball(r)), (1.0, r, zero, ball(r)), (-r, -1.0, zero, ball(r))],
            thick_shell(m, r, 1.0),
        ),
    }[name]  # fmt: skip
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
    along, across = density * np.sum(dz * polar), density * np.sum(dz * (polar / 2 + area * z**2))
    assert_ulps(jr.solids.torus(m, ring, tube).inertia, np.diag([across, across, along]), 32)


def test_thin_bodies_equal_sums_over_their_points():
    m, r, turns = 2.0, 1.5, 64
    angle = 2 * np.pi * np.arange(turns) / turns
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    assert_ulps(
        jr.solids.hoop(m, r).inertia, jr.inertia_tensor(np.full(turns, m / turns), r * circle), 16
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
    assert_ulps(jr.solids.shell(m, r).inertia, sum(circles), 16)
    x, w = nodes(-0.5, 0.5, 4)
    line = jr.from_points(w * m, np.stack([0 * x, 0 * x, r * x], axis=1))
    assert_ulps(jr.solids.rod(m, r).inertia, line.inertia, 8)
    grid = np.stack([*np.meshgrid(x, 2 * x, indexing="ij"), np.zeros((4, 4))], axis=-1).reshape(
        -1, 3
    )
    plate = jr.from_points(m * np.outer(w, w).ravel(), grid)
    assert_ulps(jr.solids.lamina(m, np.array([1.0, 2.0])).inertia, plate.inertia, 8)


def test_box_and_ellipsoid_equal_quadrature_in_three_dimensions():
    m, lengths = 2.0, np.array([1.0, 2.0, 3.0])
    density = m / np.prod(lengths)
    box = jr.from_density(lambda r: density + 0 * r[0], -lengths / 2, lengths / 2, order=4)
    assert_ulps(jr.solids.box(m, lengths).inertia, box.inertia, 8)
    # The ellipsoid's integral over spherical shells: x = (a, b, c) * radius * direction.
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
        (thick_shell(m, r, r * (1 - 1e-15)), jr.solids.shell(m, r)),
        (thick_shell(m, r, 1e-6), jr.solids.sphere(m, r)),
        (jr.solids.tube(m, r, r, 1e-9), jr.solids.hoop(m, r)),
        (jr.solids.torus(m, r, 1e-9), jr.solids.hoop(m, r)),
        (jr.solids.capsule(m, r, 1e-16), jr.solids.sphere(m, r)),
        (jr.solids.box(m, np.array([1.0, 2.0, 1e-9])), jr.solids.lamina(m, np.array([1.0, 2.0]))),
    ]
    for thick, thin in pairs:
        assert_ulps(thick.inertia, thin.inertia, 16)


def test_two_half_cylinders_make_a_cylinder():
    half = jr.solids.cylinder(1.0, 1.5, 1.0)
    up = half.translated(np.array([0, 0, 0.5])) + half.translated(np.array([0, 0, -0.5]))
    assert_ulps(up.inertia, jr.solids.cylinder(2.0, 1.5, 2.0).inertia, 8)


def test_every_solid_under_jit_vmap_grad_and_jacfwd_in_both_precisions():
    # Mass properties scale with mass and length: mass I = dI/dmass, sum of length dI/dlength = 2 I.
    def everything(scale, arguments):
        def scaled(name, mass_scale, length_scale):
            mass, *lengths = arguments[name]
            return SOLIDS[name][0](mass * mass_scale, *(x * length_scale for x in lengths))

        one = jnp.ones_like(scale)
        bodies = {name: scaled(name, one, scale) for name in SOLIDS}
        by_mass = {name: jax.jacfwd(lambda s, n=name: scaled(n, s, scale))(one) for name in SOLIDS}
        by_length = {
            name: jax.grad(lambda s, n=name: jnp.sum(jnp.trace(scaled(n, one, s).inertia)))(scale)
            for name in SOLIDS
        }
        return bodies, by_mass, by_length

    batched = jax.jit(jax.vmap(everything, in_axes=(0, None)))
    for dtype in (np.float32, np.float64):
        arguments = jax.tree.map(
            lambda x, dtype=dtype: jnp.asarray(x, dtype), {k: v[1] for k, v in SOLIDS.items()}
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
            np.testing.assert_allclose(by_length[name], 2 * trace / scale, rtol=tolerance)
            assert np.all(np.asarray(bodies[name].result == jr.RESULTS.successful))


def bad_values():
    for name, (function, (_, *lengths)) in SOLIDS.items():
        for mass in (-1.0, 0.0, np.nan, np.inf):
            yield f"{name}, mass {mass}", function, (mass, *lengths), "`mass` must be positive"
    for name, (function, (mass, *lengths)) in SOLIDS.items():
        if name != "tetrahedron":
            for bad in (-1.0, np.nan):
                changed = [x * bad for x in lengths]
                yield (
                    f"{name}, lengths {bad}",
                    function,
                    (mass, *changed),
                    "must be positive and finite",
                )
    yield "corner", jr.solids.tetrahedron, (1.0, CORNERS * np.nan), "`vertices` must be finite"
    yield "bore", jr.solids.tube, (1.0, 2.0, 1.0, 1.0), "`inner_radius` must not exceed"
    yield "cavity", thick_shell, (1.0, 1.0, 1.0), "`inner_radius` must be below"
    yield "thick ring", jr.solids.torus, (1.0, 1.0, 2.0), "`tube_radius` must not exceed"


BAD_VALUES = {name: case for name, *case in bad_values()}


@pytest.mark.parametrize("name", BAD_VALUES)
def test_bad_value_is_an_error_and_a_code(name):
    function, arguments, message = BAD_VALUES[name]
    with pytest.raises(RuntimeError, match=message):
        function(*arguments)
    body = function(*arguments, throw=False)
    if "`mass`" in message:
        code = jr.RESULTS.invalid_mass
    else:
        corner = "`vertices`" in message
        code = jr.RESULTS.invalid_position if corner else jr.RESULTS.invalid_length
    assert body.result == code
    assert "{}" not in jr.RESULTS[code]
    assert np.any(np.isnan(body.inertia))


@pytest.mark.parametrize("name", ["box, mass -1.0", "sphere, lengths nan", "bore"])
def test_bad_value_is_an_error_under_jit(name):
    function, arguments, message = BAD_VALUES[name]
    with pytest.raises(RuntimeError, match=message):
        jax.block_until_ready(eqx.filter_jit(function)(*arguments))


def test_bad_lane_gets_a_code_and_leaves_the_others_alone():
    masses, radii = np.array([1.0, -1.0, 1.0, 2.0]), np.array([1.0, 1.0, np.nan, 2.0])
    bodies = jax.jit(jax.vmap(lambda m, r: jr.solids.sphere(m, r, throw=False)))(masses, radii)
    good = [True, False, False, True]
    np.testing.assert_array_equal(bodies.result == jr.RESULTS.successful, good)
    np.testing.assert_array_equal(
        bodies.result == jr.RESULTS.invalid_mass, [False, True, False, False]
    )
    np.testing.assert_array_equal(
        bodies.result == jr.RESULTS.invalid_length, [False, False, True, False]
    )
    moments = np.asarray(bodies.inertia)[[0, 3], 0, 0]
    np.testing.assert_allclose(moments, [0.4, 3.2], rtol=4 * EPS)


def test_a_bad_lane_leaves_the_gradient_in_shared_arguments_alone():
    def total(shared, bad):
        bodies = [
            jr.solids.sphere(shared, bad, throw=False),
            jr.solids.sphere(bad, shared, throw=False),
            thick_shell(1.0, 2 * bad, shared / 2, throw=False),
            jr.solids.capsule(shared, bad, bad, throw=False),
            jr.solids.tetrahedron(shared, CORNERS * bad, throw=False),
        ]
        return sum(
            jnp.where(body.result == jr.RESULTS.successful, jnp.trace(body.inertia), 0.0)
            for body in bodies
        )

    both = jax.jit(jax.grad(lambda x, bad: jnp.sum(jax.vmap(total, (None, 0))(x, bad))))
    alone = both(2.0, np.array([1.0]))
    for bad in (np.nan, np.inf, 0.0, -1.0):
        lanes = both(2.0, np.array([1.0, bad]))
        # Corners times 0 or -1 are good.
        corners = jr.solids.tetrahedron(1.0, CORNERS * np.nan_to_num(bad, posinf=0.0)).inertia
        np.testing.assert_allclose(lanes, alone + jnp.trace(corners), rtol=16 * EPS)


@pytest.mark.parametrize("name", SOLIDS)
def test_wrong_shape_is_an_error(name, untyped):
    function, (mass, *lengths) = SOLIDS[name]
    with pytest.raises(ValueError, match=r"`mass` must have shape \(\)"):
        function(np.ones(3), *lengths)
    with pytest.raises(ValueError, match="must have shape"):
        function(mass, *(np.ones((2, 2)) for _ in lengths))
