"""Light curves: closed forms, published numbers, another program, another integrator."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from helpers import central_difference, quick_jit
from scipy.integrate import solve_ivp
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid import photometry as ph

HOUR, DAY, AU = 3600.0, 86400.0, 149597870700.0
SEMI_AXES = np.array([3.0, 2.0, 1.2])
LAWS = {
    "lambert": ph.Lambert(),
    "lommel_seeliger": ph.LommelSeeliger(),
    "geometric": ph.Geometric(),
    "mixture": ph.Mixture(0.2, amplitude=0.5, width=0.1, slope=-0.3),
}


def egg():
    """Corners of a convex body without symmetry, as they are written to a file."""
    rows, around = np.arange(1, 12) * np.pi / 12, np.arange(16) * np.pi / 8
    theta, phi = np.meshgrid(rows, around, indexing="ij")
    n = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    n = np.stack(n, axis=-1).reshape(-1, 3)
    n = np.concatenate([n, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    corners = n * [34.0, 26.0, 21.0]
    corners[:, 0] += 5.0 * n[:, 0] ** 2 + 2.0 * n[:, 2] ** 2
    return corners.round(3)


# Brightness of the egg by `lcgenerator` of DAMIT's light-curve inversion package 0.2.1
# (CC-BY-4.0, M. Kaasalainen and J. Durech), at epochs of its test asteroid: pole 210.3,
# -32.7 degrees, period 5.76198 h, angle 37 degrees at JD 2438882.2, phase function .5,
# .1, -.5, Lambert coefficient .1.
POINTS = """1
9 1
2438882.233275  559.9660  1.467574  1.309298  .08242228  .7140329  .6399864  .08236481
2438882.319985  555.5720  1.466729 1.310028  .08236771  .7141551  .6395958  .08231011
2441543.477618  387.0470 -1.731287  .8765158 -.1087737 -.9367699  .2481637 -.1088044
2445167.689432  1.007140 -1.963816  .4163673 -.1207416 -1.541748 -.5082327 -.1207748
2445213.698375  .9700990 -2.090452 -.1383338 -.1256040 -1.150336 -.5052291 -.1256139
2445829.672690  1.126260  2.134992 -1.044011  .1342643  1.471909 -1.805445  .1342327
2446818.447285  .9786510  .7257654 -2.465920  .05632194  .1960257 -1.636432  .05634442
2446833.746687  1.013830  .8666943 -2.415556  .06457978  .1326092 -1.756971  .06459386
2447852.709786  1.004540 -.8141091 -2.371461 -.03712506 -.3205179 -1.515999 -.03710149
"""
BY_LCGENERATOR = [
    *(1900.090410, 1887.177629, 1241.605799, 868.297887, 1163.724944),
    *(909.094352, 1175.913738, 963.065657, 1304.919451),
]


def test_brightness_is_that_of_damits_generator(tmp_path):
    (tmp_path / "curves").write_text(POINTS)
    (curve,) = ph.read_light_curves(tmp_path / "curves", epoch=2438882.2)
    facets = ph.facets_from_mesh(egg(), np.zeros((1, 3), int), hull=True)
    pole = np.deg2rad([210.3, -32.7])
    state = ph.state_of_pole(*pole, 5.76198 * HOUR, np.deg2rad(37.0))
    law = ph.Mixture(0.1, amplitude=0.5, width=0.1, slope=-0.5)
    body = np.array([1.0, 1.5, 2.0])  # any: it rotates about a principal axis
    found = ph.light_curve(
        body,
        state,
        curve.ts,
        curve.to_sun,
        curve.to_observer,
        facets,
        law,
        light_time=False,
    )
    np.testing.assert_allclose(found, BY_LCGENERATOR, rtol=2e-8)


def directions(rng, count):
    return rng.normal(size=(2, count, 3))


def test_facets_converge_to_the_ellipsoid_in_closed_form(rng):
    shape = ph.Ellipsoid(SEMI_AXES)
    brightness = jax.jit(jax.vmap(ph.brightness, in_axes=(None, 0, 0)))
    pairs = directions(rng, 6)
    exact = brightness(shape, *pairs)
    errors = [
        np.max(np.abs(brightness(shape.facets(rows), *pairs) / exact - 1))
        for rows in (18, 36, 71)
    ]
    assert errors[2] < 2e-3  # of 2 * 10^4 facets
    assert errors[0] / errors[1] > 3  # quadratic in the size of a facet
    assert errors[1] / errors[2] > 3


def test_a_sphere_is_as_bright_from_all_sides_and_by_its_phase_curve(rng):
    ball = ph.Ellipsoid(np.full(3, 2.0))
    alpha = np.array([0.0, 1e-9, 0.3, 1.0, 2.5])
    turns = Rotation.random(5, random_state=0)
    sun = turns.apply([1.0, 0.0, 0.0])
    seen = np.stack([np.cos(alpha), np.sin(alpha), 0 * alpha], axis=-1)
    observer = np.array([r.apply(x) for r, x in zip(turns, seen, strict=True)])
    found = jax.vmap(ph.brightness, in_axes=(None, 0, 0))(ball, sun, observer)
    # H. von Seeliger's phase curve of a sphere by this law.
    half = alpha / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        bent = np.sin(half) * np.tan(half) * np.log(np.tan(alpha / 4))
    expected = 4 * np.pi / 2 * (1 + np.where(alpha > 0, bent, 0.0))
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("law", ["lommel_seeliger", "lambert", "mixture"])
def test_gradients_are_those_of_central_differences(law, rng):
    shape = ph.Ellipsoid(SEMI_AXES).facets(8)
    sun, observer = directions(rng, 1)[:, 0]
    x = jnp.concatenate([jnp.asarray(sun), jnp.asarray(observer)])

    @jax.jit
    def brightness(x):
        return ph.brightness(shape, x[:3], x[3:], LAWS[law])

    h = 6e-6
    step = h * np.eye(6)
    difference = jax.vmap(lambda e: brightness(x + e) - brightness(x - e))(step) / (
        2 * h
    )
    for derivative in (jax.grad, jax.jacfwd):
        found = derivative(brightness)(x)
        np.testing.assert_allclose(found, difference, rtol=0, atol=1e-8)


CUBE = np.concatenate([np.eye(3), -np.eye(3)])  # normals; it is seen from the front


@pytest.mark.parametrize("law", LAWS)
def test_facets_edge_on_and_in_the_dark_have_finite_derivatives(law):
    cube = ph.Facets(np.ones(6), CUBE)
    x, y, _ = jnp.eye(3)

    def brightness(sun, observer):
        return ph.brightness(cube, sun, observer, LAWS[law])

    for sun, observer in ((x, x), (x, y), (x, -x), (x + y, x)):
        for derivative in (jax.jacfwd, jax.jacrev):
            for slope in derivative(brightness, argnums=(0, 1))(sun, observer):
                assert np.all(np.isfinite(slope))


@pytest.mark.parametrize("law", ["lommel_seeliger", "lambert", "mixture"])
def test_a_facet_edge_on_has_the_derivative_of_one_that_is_dark(law):
    """The observer is in the plane of one facet, which the Sun lights.

    The brightness has a kink there. Its derivative is that of the side where the facet
    is hidden, for each component by a difference of second order on this side.
    """
    facet = ph.Facets(np.ones(2), np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]]))
    sun, observer = jnp.array([0.5, 0.3, 0.9]), jnp.array([0.0, 0.8, 0.6])

    @jax.jit
    def brightness(sun, observer):
        return ph.brightness(facet, sun, observer, LAWS[law])

    # Towards negative x the first facet is hidden, and along the others it stays
    # edge-on.
    h = 1e-5
    for axis, side in enumerate((-1.0, 1.0, 1.0)):
        step = side * h * jnp.eye(3)[axis]
        values = [brightness(sun, observer + k * step) for k in range(3)]
        expected = side * (-3 * values[0] + 4 * values[1] - values[2]) / (2 * h)
        for derivative in (jax.jacfwd, jax.jacrev):
            found = derivative(brightness, argnums=1)(sun, observer)[axis]
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)


def test_gradients_of_the_ellipsoid_are_those_of_its_facets(rng):
    shape = ph.Ellipsoid(SEMI_AXES)
    sun, observer = directions(rng, 1)[:, 0]

    def slopes(rows):
        """Derivatives in the semi-axes and in both directions, of facets or exact."""

        def brightness(axes, sun, observer):
            body = ph.Ellipsoid(axes)
            return ph.brightness(
                body if rows is None else body.facets(rows), sun, observer
            )

        gradient = jax.jit(jax.grad(brightness, argnums=(0, 1, 2)))
        return np.concatenate(gradient(shape.semi_axes, sun, observer))

    exact = slopes(None)
    errors = [np.max(np.abs(slopes(rows) - exact)) for rows in (24, 96)]
    scale = np.max(np.abs(exact))
    # A facet that turns into the dark at once is an error of first order in its size.
    assert errors[1] < 5e-3 * scale
    assert errors[1] < errors[0]


def test_the_ellipsoid_has_derivatives_at_opposition():
    shape = ph.Ellipsoid(SEMI_AXES)
    x = jnp.array([0.3, -0.4, 0.8])
    same = jax.grad(lambda y: ph.brightness(shape, x, y))(x)
    near = jax.grad(lambda y: ph.brightness(shape, x, y))(x * (1 + 1e-9))
    assert np.all(np.isfinite(same))
    np.testing.assert_allclose(same, near, atol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-2, 0.5, 2.0, np.pi])
def test_the_ellipsoid_keeps_its_digits_with_the_sun_behind_it(angle):
    """Lommel's and Seeliger's phase function of a sphere, of which numbers of order 1
    cancel. The Sun is at `angle` beside straight behind."""
    x, y, _ = np.eye(3)
    observer = -np.cos(angle) * x + np.sin(angle) * y
    ball = ph.Ellipsoid(np.ones(3))
    value = ph.brightness(ball, x, observer)
    exact = float(angle == np.pi)
    if 0 < angle < np.pi:
        with mpmath.workdps(50):
            half = (mpmath.pi - mpmath.mpf(angle)) / 2
            logarithm = mpmath.log(mpmath.cot(half / 2))
            exact = 1 - mpmath.sin(half) * mpmath.tan(half) * logarithm
    exact = np.pi / 2 * float(exact)
    np.testing.assert_allclose(float(value), exact, rtol=1e-12, atol=1e-32)
    slope = jax.grad(lambda y: ph.brightness(ball, x, y))(jnp.asarray(observer))
    assert np.all(np.isfinite(slope))


def test_second_derivatives_at_opposition_grow_as_the_logarithm():
    """By a factor of ten in the angle they grow by the same each time."""
    shape = ph.Ellipsoid(SEMI_AXES)
    x, y, _ = jnp.eye(3)

    def across(angle):
        observer = jnp.cos(angle) * x + jnp.sin(angle) * y
        return ph.brightness(shape, x, observer)

    second = jax.vmap(jax.grad(jax.grad(across)))(jnp.array([1e-3, 1e-4, 1e-5]))
    first, then = np.diff(second)
    np.testing.assert_allclose(first, then, rtol=1e-3)
    assert then < -1
    assert np.isfinite(jax.grad(jax.grad(across))(0.0))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("bad", [np.nan, 0.0])
def test_directions_that_are_none_have_no_brightness(law, bad):
    cube = ph.Facets(np.ones(6), np.concatenate([np.eye(3), -np.eye(3)]))
    x, nowhere = np.eye(3)[0], np.full(3, bad)
    for directions in ((x, nowhere), (nowhere, x)):
        assert np.isnan(ph.brightness(cube, *directions, LAWS[law]))


@pytest.mark.parametrize("law", LAWS)
def test_laws_broadcast(law):
    one, many = jnp.asarray(0.5), jnp.full(3, 0.5)
    each = LAWS[law].of_area(one, one)
    for cosines in ((one, many), (many, one)):
        np.testing.assert_allclose(LAWS[law].of_area(*cosines), [each] * 3)


def tumbler():
    """Moments, a state, epochs, directions and facets of a body that tumbles."""
    moments = np.array([1.0, 2.1, 2.6])
    state = jr.State(np.array([0.5, 0.5, -0.5, 0.5]), np.array([1.1, 0.3, 0.7]))
    ts = np.sort(np.random.default_rng(3).uniform(0.0, 60.0, 12))
    sun = AU * np.stack([np.cos(ts / 99), np.sin(ts / 99), 0.1 + 0 * ts], axis=-1)
    observer = AU * np.stack([0.3 + 0 * ts, 0.2 * np.cos(ts / 50), -0.1 + 0 * ts], -1)
    return moments, state, ts, sun, observer


def test_a_tumbler_is_that_of_another_integrator():
    moments, state, ts, sun, observer = tumbler()
    facets = ph.Ellipsoid(SEMI_AXES).facets(6)
    emitted = ts - np.linalg.norm(observer, axis=1) / 299792458.0

    def rates(t, y):
        q, w = y[:4], y[4:]
        turn = np.concatenate([[-q[1:] @ w], q[0] * w + np.cross(q[1:], w)]) / 2
        return np.concatenate([turn, np.cross(moments * w, w) / moments])

    start = np.concatenate([state.attitude, state.omega])
    parts = []
    for t in emitted:  # some before the epoch of the state
        end = solve_ivp(rates, (0.0, t), start, method="DOP853", rtol=1e-12, atol=1e-12)
        parts.append(end.y[:4, -1])
    turns = Rotation.from_quat(np.array(parts)[:, [1, 2, 3, 0]]).inv()
    areas, normals = np.asarray(facets.areas), np.asarray(facets.normals)
    expected = []
    for turn, *lines in zip(turns, sun, observer, strict=True):
        mu0, mu = (normals @ turn.apply(x / np.linalg.norm(x)) for x in lines)
        counted = (mu0 > 0) & (mu > 0)
        mu0, mu = mu0[counted], mu[counted]
        expected.append(np.sum(areas[counted] * mu0 * mu / (mu0 + mu)))
    found = ph.light_curve(moments, state, ts, sun, observer, facets)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_a_body_under_a_torque_has_the_light_of_its_motion():
    """Drag about the axis of rotation: the angle is 1 - exp(-t) times the first rate."""
    shape = ph.Ellipsoid(SEMI_AXES)
    body = jr.RigidBody(np.ones(3), jr.torques.LinearDrag(1.0))
    start = jr.State(np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, 2.0]))
    ts = np.linspace(0.0, 3.0, 7)
    sun, observer = (np.tile(x, (7, 1)) for x in ([1.0, 0.3, 0.2], [0.9, -0.2, 0.1]))
    found = ph.light_curve(body, start, ts, sun, observer, shape, light_time=False)
    turned = Rotation.from_rotvec(
        np.stack([0 * ts, 0 * ts, 2.0 * (1 - np.exp(-ts))], axis=1)
    )
    expected = [
        ph.brightness(shape, *x)
        for x in zip(turned.inv().apply(sun), turned.inv().apply(observer), strict=True)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    # In another order, and seen later by the light time.
    turn = np.array([3, 0, 6, 1, 2, 5, 4])
    far = 299792458.0 * observer / np.linalg.norm(observer[0])
    later = ph.light_curve(body, start, ts[turn] + 1.0, sun, far, shape)
    np.testing.assert_allclose(later, np.array(expected)[turn], rtol=1e-6)
    with pytest.raises(ValueError, match="must not be later than the first light"):
        ph.light_curve(body, start, ts, sun, far, shape)


def test_a_light_curve_has_derivatives_in_all_that_a_fit_seeks():
    moments, state, ts, sun, observer = tumbler()

    @jax.jit
    def curve(x):
        body, semi_axes, attitude, omega = x
        start = jr.State(attitude / jnp.linalg.norm(attitude), omega)
        shape = ph.Ellipsoid(semi_axes)
        return ph.light_curve(body, start, ts, sun, observer, shape, light_time=False)

    x = tuple(map(jnp.asarray, (moments, SEMI_AXES, state.attitude, state.omega)))
    directions = tuple(
        jnp.asarray(np.random.default_rng(i).normal(size=y.shape))
        for i, y in enumerate(x)
    )
    _, slope = jax.jvp(curve, (x,), (directions,))
    h = 1e-6
    moved = [
        jax.tree.map(lambda y, e, s=s: y + s * h * e, x, directions) for s in (1, -1)
    ]
    difference = (curve(moved[0]) - curve(moved[1])) / (2 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-6, atol=1e-6)
    (back,) = jax.vjp(curve, x)[1](jnp.ones(ts.size))
    inner = sum(np.sum(a * b) for a, b in zip(back, directions, strict=True))
    np.testing.assert_allclose(inner, np.sum(slope), rtol=1e-10)


APOPHIS = np.array([0.61, 0.965, 1.0])  # P. Pravec et al., Icarus 233 (2014) 48


def test_apophis_has_its_published_energy():
    omega = ph.omega_from_periods(APOPHIS, 27.38 * HOUR, 263 * HOUR)
    terms = ph.tumbling(APOPHIS, omega)
    assert terms.regime == jr.free.REGIMES.about_largest
    np.testing.assert_allclose(terms.energy_ratio, 1.0236, atol=1e-4)
    # Ratios that are rounded to two digits move it by about 1 %.
    rounded = ph.tumbling(
        APOPHIS.round(2),
        ph.omega_from_periods(np.array([0.61, 0.96, 1.0]), 27.38 * HOUR, 263 * HOUR),
    )
    assert abs(rounded.energy_ratio - terms.energy_ratio) < 0.02


def test_toutatis_has_its_published_periods():
    body = jr.datasets.toutatis_1992()
    terms = ph.tumbling(body.moments, body.epoch_omega)
    assert terms.regime == jr.free.REGIMES.about_smallest
    # R. S. Hudson and S. J. Ostro, Science 270 (1995) 84: 7.35 and 5.41 days, from
    # moments that differ by .5 % from those of the data set.
    np.testing.assert_allclose(terms.precession_period / DAY, 7.35, rtol=0.01)
    np.testing.assert_allclose(terms.rotation_period / DAY, 5.41, rtol=0.01)


@pytest.mark.parametrize("mode", ["short-axis", "long-axis"])
def test_periods_and_angular_velocity_are_inverses(mode, rng):
    """From small wobbles to the separatrix, for moments and for a tensor."""
    turn = Rotation.random(random_state=1).as_matrix()
    tensor = turn @ np.diag(APOPHIS) @ turn.T

    @quick_jit
    @jax.vmap
    def there_and_back(ratio):
        omega = ph.omega_from_periods(tensor, 3.0, 3.0 * ratio, mode)
        terms = ph.tumbling(tensor, omega)
        return terms.precession_period, terms.rotation_period / 3.0, terms.tilt_max

    least = {"short-axis": 7.5669281, "long-axis": 1.6400806}[mode]
    ratios = np.array([*least * np.array([1.00001, 1.01, 1.3, 2.0]), 40.0])
    precession, found, tilt = there_and_back(ratios)
    np.testing.assert_allclose(precession, 3.0, rtol=1e-9)
    np.testing.assert_allclose(found, ratios, rtol=1e-8)
    assert np.all(np.diff(tilt) > 0)
    assert np.isnan(there_and_back(np.array([0.99 * least]))[0][0])


@pytest.mark.parametrize("mode", ["short-axis", "long-axis"])
def test_energy_and_angular_velocity_are_inverses(mode):
    """From small wobbles to the separatrix; the tilts follow from a second formula."""
    turn = Rotation.random(random_state=1).as_matrix()
    tensor = turn @ np.diag(APOPHIS) @ turn.T
    smallest, middle, largest = APOPHIS
    circled = largest / (largest if mode == "short-axis" else smallest)
    separatrix = largest / middle
    parts = np.array([1e-8, 0.1, 0.7, 1 - 1e-6])
    ratios = circled + parts * (separatrix - circled)

    @quick_jit
    @jax.vmap
    def there_and_back(ratio):
        omega = ph.omega_from_energy(tensor, ratio, 3.0, mode)
        terms = ph.tumbling(tensor, omega)
        return terms.precession_period, terms.energy_ratio, terms.tilt_max

    precession, found, tilt = there_and_back(ratios)
    np.testing.assert_allclose(precession, 3.0, rtol=1e-12)
    np.testing.assert_allclose(found, ratios, rtol=1e-12)
    np.testing.assert_allclose(np.sin(tilt) ** 2, parts, rtol=1e-6)
    beyond = circled + np.array([-0.01, 1.01]) * (separatrix - circled)
    assert np.all(np.isnan(there_and_back(beyond)[0]))


def test_energy_of_apophis_has_its_published_period():
    """The derivative in the energy is that of the periods, reversed."""

    def rotation_period(energy_ratio):
        omega = ph.omega_from_energy(APOPHIS, energy_ratio, 27.38)
        return ph.tumbling(APOPHIS, omega).rotation_period

    def energy_ratio(period):
        omega = ph.omega_from_periods(APOPHIS, 27.38, period)
        return ph.tumbling(APOPHIS, omega).energy_ratio

    ratio, slope = jax.value_and_grad(energy_ratio)(263.0)
    period, inverse = jax.value_and_grad(rotation_period)(ratio)
    np.testing.assert_allclose(period, 263.0, rtol=1e-9)
    np.testing.assert_allclose(inverse * slope, 1.0, rtol=1e-6)


def slopes_of_inverse(mode, orders):
    """Derivatives of `omega_from_periods` of rising order, and central differences."""

    def omega(x):
        moments = APOPHIS * jnp.array([1.0, x[0], 1.0])
        return ph.omega_from_periods(moments, x[1], x[2], mode)

    @quick_jit
    def every(x):
        functions = [omega]
        for _ in range(orders):
            functions.append(jax.jacfwd(functions[-1]))
        return [function(x) for function in functions]

    # Of Apophis; in a long-axis mode P_psi may be shorter.
    x = np.array([1.0, 27.38, 263.0 if mode == "short-axis" else 70.0])
    step = 1e-5 * x * np.eye(3)
    ahead = [every(x + e) for e in step]
    back = [every(x - e) for e in step]
    for order, derivative in enumerate(every(x)[1:]):
        differences = [a[order] - b[order] for a, b in zip(ahead, back, strict=True)]
        yield derivative, np.stack(differences, axis=-1) / (2 * np.diagonal(step))


@pytest.mark.parametrize(
    ("mode", "orders"),
    [
        ("short-axis", 1),
        ("long-axis", 1),
        pytest.param("short-axis", 2, marks=pytest.mark.slow),
    ],
)
def test_inverse_has_derivatives(mode, orders):
    pairs = slopes_of_inverse(mode, orders)
    for (found, difference), tolerance in zip(pairs, (1e-6, 1e-5), strict=False):
        scale = np.max(np.abs(difference), axis=tuple(range(difference.ndim - 1)))
        assert np.max(np.abs(found - difference) / scale) < tolerance


@pytest.mark.parametrize(
    ("moments", "omega", "tangent"),
    [
        ([1.0, 1.0, 2.0], [0.1, 0.0, 1.0], 0.05),
        ([1.0, 1.0, 2.0], [0.06, 0.08, -1.0], 0.05),
        ([1.0, 2.0, 2.0], [1.0, 0.1, 0.0], 0.2),
    ],
)
def test_the_tilt_of_an_exactly_symmetric_body_is_constant(moments, omega, tangent):
    terms = ph.tumbling(jnp.array(moments), jnp.array(omega))
    tilts = np.array([terms.tilt_min, terms.tilt_max])
    np.testing.assert_allclose(tilts, np.arctan(tangent), rtol=1e-14)


def test_steady_rotation_has_no_tilt_and_no_excess():
    terms = ph.tumbling(APOPHIS, np.array([0.0, 0.0, 2.0]))
    np.testing.assert_allclose([terms.tilt_min, terms.tilt_max], 0.0, atol=1e-12)
    np.testing.assert_allclose(terms.energy_ratio, 1.0, rtol=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "ends where the number of light curves should be"),
        ("x\n", "line 1: the number of light curves must be numbers"),
        (
            "1\n1 0\n0 1e400 1 0 0 1 0 0\n",
            "line 3: a point of light curve 1 must be finite",
        ),
        ("1\n2 0\n2450000.5 1 1 0 0 1 0 0\n", "ends where a point of light curve 1"),
        (
            "1\n2 0\n2450000.5 1 1 0 0 1 0 0\n2450000.4 1 1 0 0 1 0 0\n",
            "line 4: the dates of light curve 1 must ascend",
        ),
        ("1\n1 2\n", "line 2: a light curve must have at least 1 point and the kind"),
        (
            "1\n1 0\n2450000.5 1 1 0 0 1 0\n",
            "line 3: .* must be 8 numbers, but there are 7",
        ),
        ("1\n1 0\n2450000.5 -1 1 0 0 1 0 0\n", "line 3: brightness must be positive"),
        ("1\n1 0\n2450000.5 1 0 0 0 1 0 0\n", "line 3: the vector to the Sun must not"),
        (
            "1\n1 0\n2450000.5 18.2 1 0 0 1 0 0\n",
            r"line 3: .*looks like magnitudes m: take 10\^\(-0.4 m\)",
        ),
        (
            "1\n2 1\n0 15.1 1 0 0 1 0 0\n0 15.3 1 0 0 1 0 0\n",
            r"line 4: .*looks like magnitudes m: take 10\^\(-0.4 m\)",
        ),
        ("1\n1 0\n2450000.5 nan 1 0 0 1 0 0\n", "line 3: .* must be finite"),
        ("0\n1 0\n", "line 2: the end of the file"),
        ("-1\n", "line 1: the number of light curves must not be -1"),
    ],
)
def test_a_malformed_file_of_light_curves_is_named_by_line(text, message, tmp_path):
    (tmp_path / "curves").write_text(text)
    with pytest.raises(ValueError, match=message):
        ph.read_light_curves(tmp_path / "curves")


def test_a_body_that_is_not_convex_is_refused_or_wrapped():
    corners = np.concatenate([np.eye(3), -np.eye(3)])
    signs = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    faces = np.arange(3) + 3 * signs
    mirrored = np.sum(signs, axis=1) % 2 == 1
    faces[mirrored] = faces[mirrored][:, ::-1]
    octahedron = ph.facets_from_mesh(corners, faces)
    np.testing.assert_allclose(octahedron.areas, np.sqrt(3) / 2)
    dented = corners.copy()
    dented[2] *= -0.3
    with pytest.raises(
        ValueError, match="must be those of a convex body, but a corner"
    ):
        ph.facets_from_mesh(dented, faces)
    wrapped = ph.facets_from_mesh(dented, faces, hull=True)
    # Half of the octahedron, and the square that closes it.
    np.testing.assert_allclose(np.sum(wrapped.areas), 2 * np.sqrt(3) + 2)
    inside = np.concatenate([dented, [[0.1, 0.1, -0.4]]])

    def area(vertices):
        return jnp.sum(ph.facets_from_mesh(vertices, faces, hull=True).areas)

    slope = jax.grad(area)(jnp.asarray(inside))
    outward = np.zeros(inside.shape)
    outward[0] = 1, 2, 3
    step = central_difference(area, inside, outward)
    np.testing.assert_allclose(np.sum(slope * outward), step, rtol=1e-8)
    np.testing.assert_array_equal(slope[-1], 0)
    with pytest.raises(ValueError, match="`vertices` must be known when it is comp"):
        jax.jit(area)(inside)
    # The areas of a closed surface, as vectors, have the sum 0.
    closed = np.asarray(wrapped.areas) @ np.asarray(wrapped.normals)
    np.testing.assert_allclose(closed, 0.0, atol=1e-12)


def test_mistakes_say_what_to_pass_instead(untyped):
    ball = ph.Ellipsoid(np.ones(3))
    x = np.array([1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"take `shape.facets\(\)`"):
        ph.brightness(ball, x, x, ph.Lambert())

    class Dim(ph.LommelSeeliger):
        """Another law, though of the same family."""

        def of_area(self, cos_sun, cos_observer):
            return 0.1 * super().of_area(cos_sun, cos_observer)

    with pytest.raises(ValueError, match=r"take `shape.facets\(\)`"):
        ph.brightness(ball, x, x, Dim())
    for areas, normals in ((-np.ones(1), x[None]), (np.ones(1), 2 * x[None])):
        with pytest.raises(ValueError, match="must be positive and unit vectors"):
            ph.Facets(areas, normals)
    with pytest.raises(ValueError, match="must have one entry for each facet"):
        ph.Facets(np.ones(2), np.eye(3))
    with pytest.raises(RuntimeError, match="`moments` must be in rising order"):
        ph.Tumbler(np.array([3.0, 2.0, 1.0]), 1.0, 2.0, 0.0, 0.0, 0.0, 0.0, ball)
    with pytest.raises(RuntimeError, match="`longitude` must be in radians"):
        ph.Tumbler(np.ones(3), 1.0, 2.0, 253.0, 0.0, 0.0, 0.0, ball)
    with pytest.raises(RuntimeError, match="`latitude` must be in radians"):
        ph.state_of_pole(0.0, -15.0, 1.0, 0.0)
    state = jr.State(np.array([1.0, 0.0, 0.0, 0.0]), x)
    with pytest.raises(ValueError, match="must have one entry for each epoch"):
        ph.light_curve(np.ones(3), state, np.zeros(2), x[None], x[None], ball)


def corners_of_a_hull(rng, count):
    """Corners of a convex body about its centre of mass, and its volume."""
    corners = rng.normal(size=(count, 3))
    # On an ellipsoid, so that all of them are corners.
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    corners *= SEMI_AXES
    # The mean is inside, so that tetrahedra from it fill the body.
    corners -= corners.mean(axis=0)
    faces = ConvexHull(corners).simplices
    a, b, c = np.moveaxis(corners[faces], 1, 0)
    volumes = np.abs(np.linalg.det(np.stack([a, b, c], axis=1)))
    return corners - volumes @ (a + b + c) / (4 * volumes.sum()), volumes.sum() / 6


@pytest.mark.parametrize("count", [5, 40, 300])
def test_a_convex_body_is_found_by_its_areas_and_normals(count, rng):
    corners, volume = corners_of_a_hull(rng, count)
    facets = ph.facets_from_mesh(corners, np.zeros((1, 3), int), hull=True)
    vertices, faces = ph.mesh_from_facets(facets)
    assert vertices.shape == corners.shape
    distances = np.linalg.norm(vertices[:, None] - corners, axis=-1)
    assert np.max(np.min(distances, axis=0)) < 1e-10
    # The triangles close, and face outward.
    body = jr.from_mesh(vertices, faces)
    np.testing.assert_allclose(body.mass, volume, rtol=1e-10)
    np.testing.assert_allclose(body.center_of_mass, 0.0, atol=1e-10)


def test_coplanar_triangles_and_areas_that_do_not_close():
    box = np.array([[i, j, k] for i in (0, 1) for j in (0, 2) for k in (0, 3)], float)
    facets = ph.facets_from_mesh(box, np.zeros((1, 3), int), hull=True)
    assert len(facets.areas) == 12
    vertices, _ = ph.mesh_from_facets(facets)
    np.testing.assert_allclose(
        np.unique(np.abs(vertices).round(9), axis=0), [[0.5, 1.0, 1.5]]
    )
    # Areas of 6, 3 and 2 in pairs: one is larger by 2 %, which the pair shares.
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    areas = np.array([6.0, 3.0, 2.0, 6.0, 3.0, 2.0])
    areas[0] *= 1.02
    vertices, _ = ph.mesh_from_facets(ph.Facets(areas, normals))
    y, z = np.ptp(vertices, axis=0)[1:]
    # The geometric mean of two opposite areas closes them.
    np.testing.assert_allclose(y * z, np.sqrt(6 * 6.12), rtol=1e-9)


def test_a_mesh_of_facets_that_no_body_has_is_an_error():
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    cases = {
        "those of a closed surface": (np.array([6.0, 3, 2, 1, 3, 2]), normals),
        "normals in all directions": (np.ones(4), normals[[0, 1, 3, 4]]),
        "finite areas and normals": (np.array([1.0, 1, 1, np.nan, 1, 1]), normals),
    }
    for message, (areas, directions) in cases.items():
        with pytest.raises(ValueError, match=message):
            ph.mesh_from_facets(ph.Facets(areas, directions))
    with pytest.raises(ValueError, match="`facets` must be known when it is compiled"):
        jax.jit(lambda x: ph.mesh_from_facets(ph.Facets(x, normals))[0])(np.ones(6))
