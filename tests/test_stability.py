"""Linear stability: growth rates, linearisation in a turning frame, maps,
boundaries."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.spatial
from helpers import central_difference, quick_jit

import jrigid as jr
from jrigid import stability as st

UP = np.array([1.0, 0.0, 0.0, 0.0])
NONE = np.zeros(3)
GRAVITY = np.array([0.0, 0.0, -9.8])


def spin(axis, rate=1.0):
    return jr.State(UP, rate * np.eye(3)[axis])


def satellite(moments, eccentricity=0.0):
    """A body whose axes point along the radius, the flight and the normal of its orbit;
    n = 1."""
    moments = jnp.asarray(moments)
    orbit = jr.torques.KeplerOrbit(1.0, 1.0, eccentricity)
    return jr.RigidBody(moments, jr.torques.GravityGradient(1.0, orbit))


# Compiled once for many tests, with codes in place of errors


@quick_jit
def about(system, state, own, up):
    return st.linearize(system, state, body_rate=own, space_axis=up, throw=False)


@quick_jit
def about_satellite(moments, eccentricity, rate):
    state = jr.State(UP, rate * jnp.array([0.0, 0.0, 1.0]))
    return st.linearize(satellite(moments, eccentricity), state, throw=False)


@quick_jit
def about_damped(moments, damping, omega):
    body = jr.RigidBody(moments, jr.torques.InternalDamper(0.3, damping))
    return st.linearize(body, jr.State(UP, omega), throw=False)


@quick_jit
@jax.vmap
def six_gyrostats(moments, axis, rate, rotor):
    """Linearisations about spins about an axis, and the slopes of the margin in the
    rotor."""

    def margin(rotor):
        body = jr.RigidBody(moments, jr.torques.Rotor(rotor * axis))
        found = st.linearize(body, jr.State(UP, rate * axis), throw=False)
        return found.margin, found

    _, slope, found = jax.jvp(margin, (rotor,), (jnp.ones_like(rotor),), has_aux=True)
    return found, slope


def gyrostats(moments, axes, rate, rotors):
    count = len(rotors)
    lanes = [
        np.broadcast_to(moments, (count, 3)),
        np.eye(3)[axes],
        np.full(count, rate),
        rotors,
    ]
    found = six_gyrostats(*(x[np.arange(6) % count] for x in map(np.asarray, lanes)))
    return jax.tree.map(lambda x: np.asarray(x)[:count], found)


# Spin about a principal axis


def test_theorem_of_the_tennis_racket_over_a_million_bodies():
    """Unstable about the axis between the other two, stable about those,
    with no exception."""
    rng = np.random.default_rng(0)
    moments = rng.uniform(0.1, 10.0, (1_000_000, 3))
    # A third of them with gaps down to 1e-12 of the moments.
    near = rng.integers(0, 3, 333_333)
    gap = 10 ** rng.uniform(-11.9, 0, 333_333) * rng.choice([-1, 1], 333_333)
    rows = np.arange(333_333)
    moments[rows, near] = moments[rows, (near + 1) % 3] * (1 + gap)
    for axis in range(3):
        square = jax.jit(
            jax.vmap(lambda m, axis=axis: st.growth_rate_squared(m, axis, 1.0))
        )
        found = np.asarray(square(moments))
        own, others = moments[:, axis], np.delete(moments, axis, axis=1)
        between = (own - others[:, 0]) * (own - others[:, 1]) < 0
        apart = np.abs(own[:, None] / others - 1).min(axis=1) > 1e-12
        assert apart.sum() > 900_000
        assert np.all((found > 0)[apart] == between[apart])
        assert np.all((found < 0)[apart] == ~between[apart])


@quick_jit
def after_a_turn(omega, momentum):
    """Jacobian of the angular velocity after a turn."""
    body = jr.RigidBody(jnp.array([1.0, 1.7, 2.3]), jr.torques.Rotor(momentum))
    period, adjoint = 2 * jnp.pi / jnp.linalg.norm(omega), diffrax.ForwardMode()

    def after(omega):
        state = jr.State(jnp.asarray(UP), omega)
        motion = jr.simulate(
            body, state, period, rtol=1e-13, adjoint=adjoint, throw=False
        )
        return motion.states.omega

    return jax.jacfwd(after)(omega)


@pytest.mark.parametrize("rotor", [0.0, 1.5, -0.4])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_growth_rates_and_frequencies_are_those_of_the_monodromy_matrix(axis, rotor):
    """The integrated motion's Jacobian over one turn has the eigenvalues exp(rate x
    period)."""
    moments, rate = jnp.array([1.0, 1.7, 2.3]), 1.3
    momentum = rotor * np.eye(3)[axis]
    period = 2 * np.pi / rate

    monodromy = np.asarray(after_a_turn(rate * np.eye(3)[axis], momentum))
    square = st.growth_rate_squared(moments, axis, rate, rotor)
    exponent = np.sqrt(complex(square)) * period
    others = [i for i in range(3) if i != axis]
    block = monodromy[np.ix_(others, others)]
    np.testing.assert_allclose(
        np.trace(block), 2 * np.cosh(exponent).real, rtol=1e-8, atol=1e-8
    )
    np.testing.assert_allclose(np.linalg.det(block), 1.0, rtol=1e-8)
    growth = st.growth_rate(moments, axis, rate, rotor)
    turning = st.frequency(moments, axis, rate, rotor)
    assert float(growth * turning) == 0
    np.testing.assert_allclose(growth**2 - turning**2, square, rtol=1e-14)
    # The modes are eigenvectors of the same block.
    order = [(axis + 1) % 3, (axis + 2) % 3]
    found = st.modes(moments, axis, rate, rotor)
    cyclic = monodromy[np.ix_(order, order)]
    for value, shape in zip(found.rates, found.shapes, strict=True):
        multiplier = np.exp(complex(value) * period)
        np.testing.assert_allclose(
            cyclic @ np.asarray(shape), multiplier * shape, atol=1e-8
        )
        assert np.linalg.norm(shape) == pytest.approx(1.0, rel=1e-12)
    ratio = np.abs(found.shapes[0, 1] / found.shapes[0, 0])
    np.testing.assert_allclose(found.amplitude_ratio, ratio, rtol=1e-12)


def test_a_rotor_steadies_the_intermediate_axis_at_its_threshold():
    """(l2 - l3) spin < h or (l3 - l1) spin + h < 0: both ends located to 1e-10."""
    moments = jnp.array([1.0, 2.0, 2.7])

    def square(rotor, rate):
        return st.growth_rate_squared(moments, 1, rate, rotor)

    @quick_jit
    def edge(low, high, rate):
        return jax.value_and_grad(
            lambda w: st.boundary(square, low, high, w, throw=False)
        )(rate)

    # About axis 2 the couplings vanish at h = (l3 - l2) spin and h = (l1 - l2) spin.
    for rate in (1.0, 3.0):
        for end, low, high in (
            (0.7 * rate, 0.0, 2.0 * rate),
            (-1.0 * rate, -2.0 * rate, 0.0),
        ):
            found, slope = edge(low, high, rate)
            assert float(found) == pytest.approx(end, abs=1e-10 * rate)
            assert float(slope) == pytest.approx(end / rate, rel=1e-9)
    # ... as a linearisation of the gyrostat finds it.
    rotors = np.array([0.6, 0.8, -0.9, -1.1])
    found, _ = gyrostats(moments, [1] * 4, 1.0, rotors)
    names = [st.STABILITY.texts[i] for i in found.stability._value]
    assert names == ["unstable", "stable", "unstable", "stable"]
    closed = [st.growth_rate(moments, 1, 1.0, rotor) for rotor in rotors]
    np.testing.assert_allclose(found.growth_rate, closed, atol=1e-12)


def test_slope_of_the_growth_rate_is_finite_at_the_threshold():
    def rate(m):
        return st.growth_rate(jnp.stack([1.0, m, 2.0]), 1, 1.0)

    for m, expected in ((1.0, 0.0), (2.0, 0.0), (0.5, 0.0), (1.5, None)):
        slope = jax.grad(rate)(m)
        assert np.isfinite(slope)
        if expected is None:
            np.testing.assert_allclose(
                slope, central_difference(rate, m, 1.0), atol=1e-8
            )
        else:
            assert float(slope) == expected
    assert np.isfinite(jax.grad(jax.grad(rate))(1.0))


FORMULAS = (
    lambda m, w: st.growth_rate_squared(m, 1, w),
    lambda m, w: st.growth_rate(m, 1, w),
    lambda m, w: st.frequency(m, 0, w),
    lambda m, w: st.modes(m, 2, w).amplitude_ratio,
    lambda m, w: st.linearized(m, 1, jnp.stack([w, 1.0, w]), 0.3)[2],
)


def seen(moments, w):
    """Sum of the rates that are numbers, and all of them."""
    found = jnp.stack([jax.vmap(lambda m, f=f: f(m, w))(moments) for f in FORMULAS])
    return jnp.sum(jnp.where(jnp.isnan(found), 0.0, found)), found


slopes_of_rates = quick_jit(jax.grad(seen, (0, 1), has_aux=True))


@pytest.mark.parametrize("bad", [[1.0, np.nan, 3.0], [1.0, -2.0, 3.0], [0.0, 1.0, 2.0]])
def test_rates_outside_their_domain_are_nan_in_that_lane_alone(bad):
    """... not 0, "stable"; what the lanes share keeps its derivative."""
    moments = jnp.array([bad, [1.0, 2.0, 3.0]])
    slopes, found = slopes_of_rates(moments, 1.5)
    assert np.isnan(found[:, 0]).all()
    assert np.isfinite(found[:, 1]).all()
    assert np.all(found[:2, 1] > 0)

    good, _ = slopes_of_rates(jnp.stack([moments[1]] * 2), 1.5)
    for of_both, of_good in zip(slopes, good, strict=True):
        if np.ndim(of_both):
            np.testing.assert_array_equal(of_both[0], 0)
            np.testing.assert_allclose(of_both[1], of_good[1], rtol=1e-12)
        else:
            np.testing.assert_allclose(of_both, of_good / 2, rtol=1e-12)
    assert np.isnan(st.growth_rate(moments[1], 1, jnp.inf))
    waves = st.linearized(
        moments[1], 1, jnp.array([0.1, 1.0, 0.0]), jnp.array([[1.0, np.nan]])
    )
    np.testing.assert_array_equal(np.isnan(waves), [[[False] * 3, [True] * 3]])


def test_a_map_over_an_unphysical_region_marks_it():
    def rate(second, third):
        return st.growth_rate(jnp.stack([1.0, second, third]), 1, 1.0)

    def region(second, third):
        return st.satellite_stability(jnp.stack([1.0, second, third])).region

    axes = {"second": np.linspace(-1.0, 3.0, 9), "third": np.linspace(-1.0, 3.0, 9)}
    positive = axes["second"] > 0
    found = st.stability_map(rate, axes)
    assert np.all(found.valid == (positive[:, None] & positive[None, :]))
    found = st.stability_map(region, axes)
    a, b, c = np.broadcast_arrays(1.0, axes["second"][:, None], axes["third"][None, :])
    real = (a <= b + c) & (b <= c + a) & (c <= a + b)
    assert np.all(found.valid == (positive[:, None] & positive[None, :] & real))
    assert np.all(np.asarray(found.values == st.REGIONS.undefined) == ~found.valid)


def test_tops_and_satellites_outside_their_domain():
    tops = jax.vmap(jr.SymmetricTop.unchecked)(
        jnp.array([1.0, -1.0, 1.0]), jnp.array([0.5, 0.5, np.nan]), jnp.ones(3)
    )
    for call in (
        lambda top, w: st.top_stability(top, w)[:2],
        lambda top, w: st.precession_stability(top, 0.7, w)[:2],
    ):
        lanes = jax.vmap(call, in_axes=(0, None))

        def total(w, lanes=lanes):
            found = lanes(tops, w)
            return sum(jnp.sum(jnp.where(jnp.isnan(x), 0.0, x)) for x in found), found

        slope, found = quick_jit(jax.grad(total, has_aux=True))(6.0)
        for value in found:
            assert np.isfinite(value[0]).all()
            assert np.isnan(value[1:]).all()
        assert np.isfinite(slope)
    no_top = jr.SymmetricTop.unchecked(-1.0, 0.5, 1.0)
    assert not st.precession_stability(no_top, 0.7, 6.0).exists
    region = st.REGIONS[st.satellite_stability(jnp.array([1.0, 2.0, 10.0])).region]
    assert region == "undefined"  # no real body
    assert np.isfinite(st.satellite_stability(jnp.array([1.0, 2.0, 10.0])).growth_rate)
    flat = st.satellite_stability(jnp.array([0.1, 0.2, 0.30000000000000004]))
    assert st.REGIONS[flat.region] == "Lagrange"
    bad = st.satellite_stability(jnp.array([1.0, np.nan, 2.0]))
    assert st.REGIONS[bad.region] == "undefined"
    assert np.isnan(bad.margins).all()
    assert np.isnan(st.eigenvalues(jnp.full((2, 2), np.nan))).all()


# Tops and satellites


def test_sleeping_top_map_against_the_formula():
    """Sign of the square on a grid of spin and mgl; the boundary to 1e-10,
    with its slope."""

    def square(omega3, mgl):
        top = jr.SymmetricTop(1.3, 0.6, mgl)
        return st.top_stability(top, omega3).growth_rate_squared

    spins, weights = np.linspace(0.1, 9.0, 60), np.linspace(-0.5, 4.0, 50)
    found = st.stability_map(square, {"omega3": spins, "mgl": weights}, block_size=700)
    assert found.values.shape == found.valid.shape == (60, 50)
    assert found.valid.all()
    threshold = 2 * np.sqrt(1.3 * np.maximum(weights, 0)) / 0.6
    assert np.all((found.values > 0) == (spins[:, None] < threshold[None, :]))
    for mgl in (0.3, 1.0, 3.7):
        exact = 2 * np.sqrt(1.3 * mgl) / 0.6
        edge = st.boundary(square, 0.0, 20.0, mgl)
        assert float(edge) == pytest.approx(exact, abs=1e-10)
        assert float(
            jr.top.sleeping_spin(jr.SymmetricTop(1.3, 0.6, mgl))
        ) == pytest.approx(exact)


@pytest.mark.parametrize(
    ("omega3", "name"), [(3.9, "unstable"), (4.0, "marginal"), (4.1, "stable")]
)
def test_sleeping_top_linearised(omega3, name):
    top = jr.SymmetricTop(1.0, 0.5, 1.0)
    found = about(
        top.as_rigid_body(), jr.top.initial_state(top, 0.0, omega3=omega3), NONE, NONE
    )
    closed = st.top_stability(top, omega3)
    assert st.STABILITY[found.stability] == name
    np.testing.assert_allclose(found.growth_rate, closed.growth_rate, atol=1e-7)
    if (
        name == "stable"
    ):  # the frame turns with the body: the tilt goes round at omega3 less
        seen = np.sort(np.abs(omega3 - np.asarray(closed.frequencies)))
        positive = np.sort(found.eigenvalues.imag[found.eigenvalues.imag > 1e-6])
        np.testing.assert_allclose(positive, seen, rtol=1e-12)


@pytest.mark.parametrize("theta", [0.4, 1.2, 2.0])
@pytest.mark.parametrize("which", ["slow", "fast"])
def test_steady_precession_linearised_and_in_closed_form(theta, which):
    top = jr.SymmetricTop(1.2, 0.7, 1.5)
    closed = st.precession_stability(top, theta, 6.0)
    i = ("slow", "fast").index(which)
    state = jr.top.initial_state(top, theta, omega3=6.0, phi_dot=which)
    own = (
        jnp.array([0.0, 0.0, 6.0])
        - closed.precession[i] * jnp.cos(theta) * jnp.eye(3)[2]
    )
    found = about(top.as_rigid_body(), state, own, NONE)
    assert st.STABILITY[found.stability] == "stable"
    np.testing.assert_allclose(found.margin, -closed.growth_rate_squared[i], rtol=1e-10)
    nutation = np.max(found.eigenvalues.imag)
    np.testing.assert_allclose(
        -(nutation**2), closed.growth_rate_squared[i], rtol=1e-10
    )
    # A nutation of 1e-5 has that frequency.
    period = 2 * np.pi / nutation
    tilted = jr.top.initial_state(
        top, theta + 1e-5, omega3=6.0, phi_dot=float(closed.precession[i])
    )
    np.testing.assert_allclose(jr.top.nutation_period(top, tilted), period, rtol=1e-4)
    # In a frame that does not turn with the body's own turning there is no equilibrium.
    assert (
        about(top.as_rigid_body(), state, NONE, NONE).result
        == jr.RESULTS.no_equilibrium
    )


def test_no_steady_precession_is_marked():
    found = st.precession_stability(jr.SymmetricTop(1.0, 0.5, 1.0), 0.3, 1.0)
    assert not bool(found.exists)
    assert np.isnan(found.growth_rate_squared).all()


def test_satellites_against_linearisation_and_the_sign_of_the_energy(rng):
    """200 bodies; Lagrange's region is where the energy has a minimum."""
    moments = rng.uniform(0.5, 2.0, (300, 3))

    closed = quick_jit(jax.vmap(st.satellite_stability))(moments)
    each = [about_satellite(m, 0.0, 1.0) for m in moments]
    growth, margin = (
        np.array([getattr(x, n) for x in each]) for n in ("growth_rate", "margin")
    )
    stability = np.array([int(x.stability._value) for x in each])
    np.testing.assert_allclose(growth, closed.growth_rate, atol=1e-7)
    unstable = stability == int(st.STABILITY.unstable._value)
    assert np.all(unstable == ~np.all(np.asarray(closed.margins) > 0, axis=1))
    assert np.all(unstable == (np.asarray(margin) < 0))
    np.testing.assert_allclose(margin[unstable], -(growth[unstable] ** 2), atol=1e-9)
    real = 2 * moments.max(axis=1) <= moments.sum(axis=1)
    assert real.sum() >= 200
    regions = np.array(st.REGIONS.texts)[closed.region._value]
    assert np.all((regions == "undefined") == ~real)
    assert np.all((regions == "unstable")[real] == unstable[real])
    a, b, c = moments.T
    assert np.all((regions == "Lagrange")[real] == ((c > b) & (b > a))[real])
    assert set(regions) == set(st.REGIONS.texts) - {"marginal"}
    assert st.REGIONS[st.satellite_stability(jnp.ones(3)).region] == "marginal"


def test_regions_of_debra_and_delp_located_to_1e_10():
    """Each margin along a line; the boundaries in closed form, and by eigenvalues."""

    def moments(yaw, roll):
        """Moments with k_R = (C - A)/B and k_Y = (C - B)/A, A = 1."""
        b = (1 - yaw) / (1 - roll)
        return jnp.stack([jnp.ones_like(b), b, b + yaw])

    def margin(yaw, roll, index):
        return st.satellite_stability(moments(yaw, roll)).margins[index]

    # 1 + 3 R + R Y = 4 sqrt(R Y): a quadratic in sqrt(-Y), for R < 0.
    for roll in (-0.1, -0.2, -0.3):
        edge = st.boundary(functools.partial(margin, index=3), -0.999, -1e-3, roll)
        x = np.roots([-roll, -4 * np.sqrt(-roll), 1 + 3 * roll]).real
        exact = -(x[(x > 0) & (x < 1)] ** 2)
        assert exact.size == 1
        assert float(edge) == pytest.approx(exact[0], abs=1e-10)
        for side, stable in ((1e-3, roll > edge + 1e-3), (-1e-3, False)):
            found = st.satellite_stability(moments(edge + side, roll))
            linear = about_satellite(moments(edge + side, roll), 0.0, 1.0)
            assert (st.REGIONS[found.region] == "DeBra-Delp") == bool(stable)
            assert (st.STABILITY[linear.stability] == "stable") == bool(stable)
    # Pitch: A = B. Roll and yaw: C = B.
    edge = st.boundary(
        lambda b: st.satellite_stability(jnp.stack([1.0, b, 3.0])).margins[0], 0.5, 2.0
    )
    assert float(edge) == pytest.approx(1.0, abs=1e-10)
    edge = st.boundary(
        lambda c: st.satellite_stability(jnp.stack([1.0, 2.0, c])).margins[1], 1.5, 2.9
    )
    assert float(edge) == pytest.approx(2.0, abs=1e-10)


def test_satellite_growth_is_that_of_the_integrated_motion():
    """Jacobian over one orbit against the exponential of the matrix,
    in the frame of the orbit."""
    moments = np.array([1.6, 1.8, 1.0])
    body = satellite(moments)

    def after(x):
        state = jr.State(jr.rotation.exp(x[:3]), jnp.array([0.0, 0.0, 1.0]) + x[3:])
        adjoint = diffrax.ForwardMode()
        end = jr.simulate(
            body, state, 2 * np.pi, rtol=1e-13, adjoint=adjoint, throw=False
        ).states
        turn = jr.rotation.log(
            jr.rotation.multiply(jr.rotation.conjugate(-UP), end.attitude)
        )
        return jnp.concatenate([turn, end.omega])

    found = quick_jit(jax.jacfwd(after))(np.zeros(6))
    matrix = np.asarray(about_satellite(moments, 0.0, 1.0).matrix)
    expected = scipy.linalg.expm(2 * np.pi * matrix)
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


# linearize


def test_what_is_at_rest():
    top = jr.SymmetricTop(1.0, 0.5, 1.0)
    hanging = jr.top.initial_state(top, jnp.pi)
    found = about(top.as_rigid_body(), hanging, NONE, NONE)
    assert st.STABILITY[found.stability] == "marginal"  # it may turn slowly
    up = np.array([0.0, 0.0, 1.0])
    found = about(top.as_rigid_body(), hanging, NONE, up)
    assert st.STABILITY[found.stability] == "stable"
    np.testing.assert_allclose(np.max(found.eigenvalues.imag), 1.0, rtol=1e-12)
    upright = about(top.as_rigid_body(), jr.top.initial_state(top, 0.0), NONE, up)
    np.testing.assert_allclose(upright.growth_rate, 1.0, rtol=1e-12)
    sphere = st.linearize(jr.RigidBody(jnp.ones(3)), spin(0))
    assert (
        st.STABILITY[sphere.stability] == "stable"
    )  # another spin turns about another axis
    across = st.linearize(jr.RigidBody(jnp.array([1.0, 1.0, 2.0])), spin(0))
    assert st.STABILITY[across.stability] == "marginal"  # it drifts along the equator


def test_zeros_that_drift_nowhere_are_stable():
    """A free wheel's own spin; a tilt that goes round as fast as the frame."""
    wheel = jr.torques.SpinningMass(0.2, np.array([0.0, 0.0, 1.0]))
    for moments, name in (([1.0, 2.0, 1.5], "stable"), ([1.0, 4.0, 2.5], "unstable")):
        body = jr.RigidBody(jnp.array(moments), wheel)
        state = jr.State(UP, np.array([0.0, 0, 1]), (np.array(5.0),))
        assert st.STABILITY[about(body, state, None, NONE).stability] == name
        held, _ = gyrostats(body.inertia, [2], 1.0, np.array([1.0]))
        assert st.STABILITY.texts[held.stability._value[0]] == name
    top = jr.SymmetricTop(1.0, 1.5, 1.0)
    asleep, own = (
        jr.top.initial_state(top, 0.0, omega3=2**0.5),
        np.array([0.0, 0.0, 2**0.5]),
    )
    for rate in (NONE, own):
        assert (
            st.STABILITY[about(top.as_rigid_body(), asleep, rate, NONE).stability]
            == "stable"
        )


@pytest.mark.slow  # programs of its own
def test_a_stiff_part_hides_nothing():
    """Damped fast, a satellite off its equilibrium or orbit is one all the same;
    so is growth."""
    n, moments = 1.08e-3, jnp.array([1.0, 2.0, 2.5])

    @quick_jit
    def stability(damping, e, turn):
        damper = jr.torques.InternalDamper(0.1, damping)
        gradient = jr.torques.GravityGradient(
            n**2, jr.torques.KeplerOrbit(n**2, 1.0, e)
        )
        rate = n * ((1 + e) / (1 - e) ** 3) ** 0.5
        normal = jnp.array([0.0, 0.0, 1.0])
        state = jr.State(jr.rotation.exp(turn * normal), rate * normal)
        return st.linearize(jr.RigidBody(moments, gradient + damper), state).stability

    for damping in (0.1, 1.0):
        assert st.STABILITY[stability(damping, 0.0, 0.0)] == "stable"
        for e, turn, message in (
            (0.0, 0.5, "be an equilibrium"),
            (0.3, 0.0, "same at all times"),
        ):
            with pytest.raises(Exception, match=message):
                jax.block_until_ready(stability(damping, e, turn))
    found = about_damped(np.array([1.0, 2.0, 3.0]), 1e6, np.eye(3)[1])
    assert st.STABILITY[found.stability] == "unstable"
    # As good as one rigid body with the sphere in it.
    rigid = st.growth_rate(jnp.array([1.3, 2.3, 3.3]), 1, 1.0)
    np.testing.assert_allclose(found.growth_rate, rigid, rtol=1e-4)


def test_a_damper_makes_the_largest_axis_attract_and_the_others_repel():
    found = [about_damped(np.array([1.0, 2.0, 3.0]), 0.2, axis) for axis in np.eye(3)]
    assert [st.STABILITY[x.stability] for x in found] == [
        "unstable",
        "unstable",
        "stable",
    ]
    # Beside the zeros of its own turning and the turning of L in space all decay.
    falling = np.sort(np.asarray(found[2].eigenvalues.real))[:5]
    assert np.all(falling < -1e-3)


def test_any_torque_and_any_leaf_with_derivatives():
    """A torque of a user's; slopes of the growth rate in a parameter,
    against differences."""

    def pull(t, state, args, k):
        """Turns body axis 3 away from up."""
        up = jr.rotation.rotate_inverse(state.attitude, jnp.array([0.0, 0.0, 1.0]))
        return k * jnp.cross(up, jnp.array([0.0, 0.0, 1.0])) * 1.0

    @quick_jit
    @jax.value_and_grad
    def growth(k):
        body = jr.RigidBody(
            jnp.array([1.0, 1.4, 0.6]), jr.torques.Torque(functools.partial(pull, k=k))
        )
        return st.linearize(body, spin(2, 0.5), throw=False).growth_rate

    value, slope = growth(np.float64(1.0))
    difference = central_difference(lambda k: growth(k)[0], 1.0, 1.0)
    np.testing.assert_allclose(slope, difference, rtol=1e-7)
    assert float(value) > 0.3


def test_bad_requests(untyped):
    body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    with pytest.raises(RuntimeError, match="equilibrium"):
        st.linearize(body, jr.State(UP, np.array([1.0, 0.1, 0.0])))
    eccentric = about_satellite(np.array([1.0, 2.0, 2.5]), 0.1, 0.9**-1.5 * 1.1**0.5)
    assert eccentric.result == jr.RESULTS.no_equilibrium
    with pytest.raises(RuntimeError, match="finite"):
        st.linearize(body, spin(0, np.nan))
    with pytest.raises(ValueError, match="system"):
        st.linearize(jr.solids.sphere(1.0, 1.0), spin(0))
    assert about(jr.SymmetricTop(1.0, 1.0, 1.0), spin(2, 3.0), NONE, NONE).margin > 0
    damped = jr.RigidBody(jnp.ones(3), jr.torques.InternalDamper(0.3, 0.2))
    with pytest.raises(ValueError, match="body_rate"):
        st.linearize(damped, spin(0), body_rate=np.ones(3))
    for function in (
        lambda x: x**2 + 1,
        lambda x: 1e-200 * (1 + x),
        lambda x: 1 / (x - 0.3),
    ):
        with pytest.raises(RuntimeError, match="change of sign"):
            st.boundary(function, 0.0, 1.0)

    def torque(t, state, args):
        """Switched on slowly, or constant."""
        switched, constant = args
        return switched * jnp.sin(t) * jnp.array([0.0, 0.0, 1.0]) + constant * jnp.ones(
            3
        )

    @quick_jit
    def pushed(size, rate, args):
        body = jr.RigidBody(size * jnp.array([1.0, 2.0, 3.0]), torque)
        state = jr.State(UP, rate * jnp.array([0.0, 0.0, 1.0]))
        return st.linearize(body, state, args, throw=False).result

    assert pushed(1.0, 1.0, (0.0, 0.0)) == jr.RESULTS.successful
    assert pushed(1.0, 1.0, (1.0, 0.0)) == jr.RESULTS.no_equilibrium
    assert pushed(1e7, 0.0, (0.0, 1.0)) == jr.RESULTS.no_equilibrium
    lanes = quick_jit(
        jax.vmap(lambda w: st.linearize(body, jr.State(UP, w), throw=False))
    )
    found = lanes(jnp.array([[1.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.0, np.nan, 0.0]]))
    stable, undefined = st.STABILITY.stable, st.STABILITY.undefined
    np.testing.assert_array_equal(found.stability == stable, [True, False, False])
    np.testing.assert_array_equal(found.stability == undefined, [False, True, True])
    assert np.isfinite(found.margin[0])
    assert np.isnan(found.margin[1:]).all()
    assert np.isfinite(found.matrix[0]).all()
    assert np.isnan(found.growth_rate[1:]).all()
    assert bool((found.result == jr.RESULTS.no_equilibrium)[1])
    assert bool((found.result == jr.RESULTS.invalid_state)[2])


# The margin


def test_margin_of_a_spin_is_minus_the_square_of_its_growth_rate():
    """For any body and rotor; also in the rotor's slope,
    and where it changes its sign."""
    axes = np.array([0, 1, 2, 1, 1, 1])
    rotors = np.array([0.0, 0.0, 0.0, 0.3, 0.9, -1.1])
    moments = np.array([1.0, 2.0, 2.7])
    found, slopes = gyrostats(moments, axes, 1.3, rotors)

    @quick_jit
    def closed(h):
        """About each axis."""
        return [
            jax.value_and_grad(
                lambda h, a=axis: -st.growth_rate_squared(moments, a, 1.3, h)
            )(h)
            for axis in range(3)
        ]

    for i, (axis, h) in enumerate(zip(axes, rotors, strict=True)):
        value, slope = closed(h)[axis]
        np.testing.assert_allclose(found.margin[i], value, rtol=1e-12)
        np.testing.assert_allclose(slopes[i], slope, rtol=1e-9, atol=1e-12)
    assert np.all(
        (found.stability._value == st.STABILITY.stable._value) == (found.margin > 0)
    )


STEP = float(np.finfo(float).eps) ** (1 / 3)
SLEEPING = np.array(
    [1.0, 3.9, 4 - 1e-9, 4.0, 4 + 1e-9, 4.1, 6.0, 3.0, 3 + STEP, 3 - STEP]
)


@pytest.fixture(scope="module")
def sleeping():
    """Margins and growth rates of sleeping tops, and their slopes in the spin and the
    weight."""

    def of(spin_and_weight):
        body = jr.SymmetricTop(1.0, 0.5, spin_and_weight[1]).as_rigid_body()
        state = jr.State(UP, spin_and_weight[0] * jnp.array([0.0, 0.0, 1.0]))
        found = st.linearize(body, state, throw=False)
        return jnp.stack([found.margin, found.growth_rate])

    @quick_jit
    @jax.vmap
    def lane(omega3):
        values, back = jax.vjp(of, jnp.stack([omega3, 1.0]))
        return values, jax.vmap(back)(jnp.eye(2))[0]

    values, slopes = map(np.asarray, lane(SLEEPING))
    return values[:, 0], slopes[:, 0], values[:, 1], slopes[:, 1]


def test_margin_of_a_sleeping_top_is_smooth_through_the_collision(sleeping):
    """Krein's collision at omega3 = 4, where each eigenvalue has an infinite slope."""

    @quick_jit
    @jax.vmap
    @functools.partial(jax.value_and_grad, argnums=(0, 1))
    def closed(omega3, mgl):
        return -st.top_stability(
            jr.SymmetricTop(1.0, 0.5, mgl), omega3
        ).growth_rate_squared

    found, slopes, *_ = sleeping
    values, exact = closed(SLEEPING, np.ones(SLEEPING.size))
    np.testing.assert_allclose(found, values, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(slopes, np.stack(exact, axis=1), rtol=1e-7)
    # The edge is there, and so is its slope in the weight.
    assert np.all((found > 0)[SLEEPING != 4] == (SLEEPING > 4)[SLEEPING != 4])
    np.testing.assert_allclose(-slopes[3, 1] / slopes[3, 0], 2.0, rtol=1e-9)


@pytest.mark.slow
def test_a_boundary_by_the_margin_of_a_linearisation():
    """The sleeping top's threshold to 1e-10, and its slope in the weight."""

    def margin(omega3, mgl):
        body = jr.SymmetricTop(1.0, 0.5, mgl).as_rigid_body()
        state = jr.State(UP, omega3 * jnp.array([0.0, 0.0, 1.0]))
        return st.linearize(body, state, throw=False).margin

    edge = quick_jit(
        jax.value_and_grad(lambda m: st.boundary(margin, 2.0, 7.0, m, throw=False))
    )
    value, slope = edge(1.0)
    assert float(value) == pytest.approx(4.0, abs=1e-10)
    assert float(slope) == pytest.approx(2.0, rel=1e-9)


def test_margin_with_damping_is_minus_the_largest_real_part():
    """The largest axis attracts; the sign changes where it is no longer the largest."""
    seconds = np.array([1.5, 1.9, 2 - 1e-5, 2.0, 2 + 1e-5, 2.1, 2.6])
    found = [about_damped(np.array([1.0, x, 2.0]), 0.2, np.eye(3)[2]) for x in seconds]
    margin, growth = (
        np.array([getattr(x, n) for x in found]) for n in ("margin", "growth_rate")
    )
    assert np.all(margin[:3] > 0)
    assert np.all(margin[4:] < 0)
    assert abs(margin[3]) < 1e-12
    np.testing.assert_allclose(margin[2] - margin[3], margin[3] - margin[4], rtol=1e-2)
    np.testing.assert_allclose(margin[4:], -growth[4:], rtol=1e-9)


def test_margin_of_what_hangs_and_of_a_precession():
    up, top = np.array([0.0, 0.0, 1.0]), jr.SymmetricTop(1.0, 0.5, 1.0)
    for theta, margin in ((jnp.pi, 1.0), (0.0, -1.0)):
        state = jr.top.initial_state(top, theta)
        np.testing.assert_allclose(
            about(top.as_rigid_body(), state, NONE, up).margin, margin, rtol=1e-12
        )
    assert st.linearize(jr.RigidBody(jnp.ones(3)), spin(0)).margin == 0


# Eigenvalues where they meet


def test_slopes_of_eigenvalues_are_those_of_the_simple_ones(rng):
    matrix, change = rng.normal(size=(2, 6, 6))

    @quick_jit
    def slopes_at(matrix):
        """Eigenvalues, their slopes along the change, the slopes of those."""
        first = lambda m: jax.jvp(st.eigenvalues, (m,), (change,))  # noqa: E731
        (values, slopes), (_, second) = jax.jvp(first, (matrix,), (change,))
        return values, slopes, second

    values, slopes, second = slopes_at(matrix)
    exact, left, right = scipy.linalg.eig(matrix, left=True)
    for value, slope in zip(np.asarray(values), np.asarray(slopes), strict=True):
        i = np.argmin(abs(exact - value))
        y, x = left[:, i].conj(), right[:, i]
        np.testing.assert_allclose(slope, y @ change @ x / (y @ x), rtol=1e-11)
    ahead, behind = (
        np.asarray(slopes_at(matrix + h * change)[1]) for h in (1e-5, -1e-5)
    )
    np.testing.assert_allclose(second, (ahead - behind) / 2e-5, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("order", [2, 3])
def test_slopes_at_a_collision_are_finite_in_every_order(order):
    """Roots of mu meet at 0: each gets the slope of their mean, which is smooth."""

    def values(mu):
        companion = jnp.eye(order, k=1).at[-1, 0].set(mu).at[-1, -1].set(mu)
        return st.eigenvalues(companion)

    @quick_jit
    def all_orders(mu):
        """Values, first and second slopes, and the first in reverse."""
        forward = lambda m: jax.jvp(values, (m,), (jnp.ones_like(m),))  # noqa: E731
        (value, first), (_, second) = jax.jvp(forward, (mu,), (jnp.ones_like(mu),))
        return value, first, second, jax.grad(lambda m: jnp.sum(values(m).real))(mu)

    for mu in (0.0, 1e-30):
        _, first, second, reverse = all_orders(mu)
        np.testing.assert_allclose(first, np.full(order, 1 / order), atol=1e-6)
        assert np.isfinite(second).all()
        assert np.isfinite(reverse)
    ahead, behind = (np.asarray(all_orders(0.3 + h)[0]) for h in (1e-6, -1e-6))
    np.testing.assert_allclose(all_orders(0.3)[1], (ahead - behind) / 2e-6, rtol=1e-6)


def test_slopes_of_a_top_where_its_eigenvalues_collide(sleeping):
    *_, growth, slopes = sleeping
    assert SLEEPING[3] == 4.0
    assert np.isfinite(slopes).all()
    difference = (growth[-2] - growth[-1]) / (2 * STEP)
    np.testing.assert_allclose(slopes[-3, 0], difference, rtol=1e-7)


# Maps


def test_a_map_is_the_function_at_each_point_whatever_the_blocks():
    def function(a, b, c):
        return {"product": a * b + c, "vector": jnp.stack([a, b, c])}

    axes = {"a": np.linspace(0, 1, 5), "b": np.arange(7), "c": np.linspace(-1, 2, 3)}
    grid = np.meshgrid(*axes.values(), indexing="ij")
    for size in (1, 4, 105, 1000):
        found = st.stability_map(function, axes, block_size=size)
        np.testing.assert_array_equal(found.values["vector"], np.stack(grid, axis=-1))
        np.testing.assert_allclose(found.values["product"], grid[0] * grid[1] + grid[2])
        assert found.labels == ("a", "b", "c")
        assert found.valid.all()


def test_a_function_may_be_a_module_of_arrays():
    class Line(eqx.Module):
        slope: jax.Array

        def __call__(self, x, y):
            return self.slope * x + y

    axes = {"x": np.arange(3.0), "y": np.arange(4)}
    found = st.stability_map(Line(jnp.array(2.0)), axes)
    np.testing.assert_array_equal(
        found.values, 2 * axes["x"][:, None] + axes["y"][None, :]
    )


def test_points_that_are_undefined_are_marked():
    def root(x, y):
        return jnp.sqrt(x - y)

    axes = {"x": np.linspace(0, 1, 11), "y": np.linspace(0, 1, 11)}
    found = st.stability_map(root, axes)
    assert np.all(found.valid == (axes["x"][:, None] >= axes["y"][None, :]))
    np.testing.assert_allclose(found.extent, (-0.05, 1.05, -0.05, 1.05))

    def truth(x, y):
        order = st.ORDER.where(x > 0.5, st.ORDER.chaotic, st.ORDER.regular)
        return {
            "order": st.ORDER.where(x > y, order, st.ORDER.undefined),
            "count": jnp.array(3),
        }

    found = st.stability_map(truth, axes, block_size=50)
    assert np.all(found.valid == (axes["x"][:, None] > axes["y"][None, :]))
    chaotic = np.asarray(found.values["order"] == st.ORDER.chaotic)
    assert np.all(chaotic == (found.valid & (axes["x"] > 0.5)[:, None]))
    with pytest.raises(ValueError, match="could say so"):
        st.stability_map(lambda x, y: x > y, axes)
    with pytest.raises(ValueError, match="shape"):
        st.stability_map(root, {"x": np.ones((2, 2)), "y": np.ones(3)})
    with pytest.raises(ValueError, match="block_size"):
        st.stability_map(root, axes, block_size=0)
    with pytest.raises(ValueError, match="extent"):
        _ = st.stability_map(lambda x: x, {"x": axes["x"]}).extent


def test_a_boundary_at_an_end_and_lanes_without_one():
    edges = jax.vmap(
        lambda p: st.boundary(lambda x, p: x - p, 1.0, 2.0, p, throw=False)
    )
    found = edges(jnp.array([1.0, 1.5, 2.0, 3.0]))
    np.testing.assert_allclose(found, [1.0, 1.5, 2.0, np.nan], atol=1e-13)
    falling = jax.vmap(
        lambda p: st.boundary(lambda x, p: p - x, 1.0, 2.0, p, throw=False)
    )
    np.testing.assert_allclose(
        falling(jnp.array([1.0, 1.5, 2.0])), [1.0, 1.5, 2.0], atol=1e-13
    )
    assert (
        float(jax.grad(lambda p: st.boundary(lambda x, p: x - p, 1.0, 2.0, p))(1.0))
        == 1.0
    )


def test_slope_of_a_boundary_in_the_shape_of_a_solid_and_of_a_mesh():
    """Shape -> moments -> growth rate -> rotor that steadies it -> slope,
    against differences."""

    def of_box(length):
        body = jr.solids.box(2.0, jnp.stack([1.0, length, 2.5]))
        return jnp.diagonal(body.inertia)

    cube = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], float)
    hull = scipy.spatial.ConvexHull(cube)
    faces = np.array(
        [
            s
            if np.dot(np.cross(cube[s[1]] - cube[s[0]], cube[s[2]] - cube[s[0]]), e[:3])
            > 0
            else s[::-1]
            for s, e in zip(hull.simplices, hull.equations, strict=True)
        ]
    )

    def of_mesh(length):
        stretched = jnp.asarray(cube) * jnp.stack([1.0, length, 2.5])[None]
        return jr.from_mesh(stretched, faces, 2.0).principal_axes().moments

    for shape in (of_box, of_mesh):

        def rotor(length, shape=shape):
            def square(h, length):
                moments = shape(length)
                order = jnp.argsort(moments)
                return st.growth_rate_squared(moments[order], 1, 1.0, h)

            return st.boundary(square, 0.0, 10.0, length, throw=False)

        both = quick_jit(jax.value_and_grad(rotor))
        _, slope = both(np.float64(1.6))
        difference = central_difference(lambda x, f=both: f(x)[0], 1.6, 1.0)
        np.testing.assert_allclose(slope, difference, rtol=1e-6)
        assert abs(float(slope)) > 0.1


def test_orbits_obey_kepler_and_have_his_slopes():

    @quick_jit
    @functools.partial(jax.vmap, in_axes=(None, 0))
    def position_and_pull(e, t):
        orbit = jr.torques.KeplerOrbit(2.0, 1.5, e)
        moving = lambda t: jax.jvp(orbit, (t,), (jnp.ones_like(t),))  # noqa: E731
        (position, _), (_, pull) = jax.jvp(moving, (t,), (jnp.ones_like(t),))
        return position, pull

    ts = np.linspace(-30.0, 30.0, 301)
    for e in (0.0, 0.1, 0.6, 0.99):
        position, pull = map(np.asarray, position_and_pull(e, ts))
        x, y = position[:, 0] / 1.5 + e, position[:, 1] / 1.5 / np.sqrt(1 - e * e)
        anomaly = np.unwrap(np.arctan2(y, x))
        n = np.sqrt(2.0 / 1.5**3)
        anomaly = anomaly - 2 * np.pi * np.round((anomaly - n * ts)[0] / 2 / np.pi)
        np.testing.assert_allclose(anomaly - e * np.sin(anomaly), n * ts, atol=1e-12)
        r = np.linalg.norm(position, axis=1, keepdims=True)
        np.testing.assert_allclose(pull, -2.0 * position / r**3, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(
        jr.torques.KeplerOrbit(2.0, 1.5, 0.99).mean_motion, n, rtol=1e-15
    )
    for e in (0.999, 0.99999):  # near the pericentre, by the radius at the anomaly
        anomaly = 10 ** np.linspace(-5, 0, 301)
        position, _ = position_and_pull(e, (anomaly - e * np.sin(anomaly)) / n)
        radius = np.linalg.norm(position, axis=1)
        np.testing.assert_allclose(radius, 1.5 * (1 - e * np.cos(anomaly)), rtol=1e-6)
    for e in (-0.1, 1.0, np.nan):
        assert np.isnan(position_and_pull(e, ts)[0]).all()


def test_float32_is_as_good_as_float32():
    top = jr.SymmetricTop(np.float32(1.0), np.float32(0.5), np.float32(1.0))
    found = st.top_stability(top, np.float32(3.0))
    assert found.growth_rate.dtype == np.float32
    np.testing.assert_allclose(found.growth_rate, np.sqrt(0.4375), rtol=1e-6)
    moments = np.array([1.0, 2.0, 3.0], np.float32)
    state = jr.State(UP.astype(np.float32), np.array([0, 1, 0], np.float32))
    single = about(jr.RigidBody(moments), state, NONE, NONE)
    assert single.eigenvalues.dtype == np.complex64
    np.testing.assert_allclose(single.growth_rate, 3**-0.5, rtol=1e-5)
    slopes = quick_jit(jax.jacfwd(lambda m: st.satellite_stability(m).margins))(moments)
    assert np.isfinite(slopes).all()
    assert (
        quick_jit(lambda m: st.satellite_stability(m).growth_rate)(moments).dtype
        == np.float32
    )
