"""What a textbook says of free rotation, by name; asteroids that tumble;
an independent check."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import MOMENTS, quick_jit
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid import free

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
DAY = 86400.0


def motion_of(moments, omega, ts):
    return jr.free_rotation(moments, jr.State(IDENTITY, omega), ts)


# --- The symmetric body
# -------------------------------------------------------------------------


def test_the_earth_as_a_rigid_body():
    """0.2 arcseconds of wobble, I3/I1 = 1.00327: space cone 0.997 days, wobble 305."""
    moments = np.array([1.0, 1.0, 1.00327])
    sidereal_day = 86164.0905
    alpha = np.radians(0.2 / 3600)
    rate = 2 * np.pi / sidereal_day
    omega = rate * np.array([np.sin(alpha), 0.0, np.cos(alpha)])

    precession = free.precession_rate(moments, omega)
    assert precession / rate == pytest.approx(1.00327, abs=5e-6)
    assert 2 * np.pi / precession / sidereal_day == pytest.approx(0.997, abs=5e-4)
    wobble = free.wobble_rate(moments, omega)
    assert 2 * np.pi / wobble / sidereal_day == pytest.approx(305, abs=1)
    assert 2 * np.pi / wobble / sidereal_day == pytest.approx(1 / 0.00327, rel=1e-9)
    assert free.polhode_period(moments, omega) == pytest.approx(
        2 * np.pi / float(wobble), rel=1e-12
    )
    assert free.mean_precession_rate(moments, omega) == pytest.approx(
        float(precession), rel=1e-14
    )
    # The pole of rotation goes with the spin, once round the figure in 305 days.
    quarter = motion_of(moments, omega, np.pi / 2 / wobble).omega
    np.testing.assert_allclose(
        quarter,
        rate * np.array([0, np.sin(alpha), np.cos(alpha)]),
        rtol=0,
        atol=1e-9 * alpha * rate,
    )


@pytest.mark.parametrize(("i3", "kind"), [(1.6, "oblate"), (0.5, "prolate")])
def test_momentum_rate_and_axis_lie_in_a_plane_in_the_order_of_the_shape(i3, kind):
    moments, omega = np.array([1.0, 1.0, i3]), np.array([0.3, -0.4, 1.2])
    angles = free.cone_angles(moments, omega)
    assert np.tan(angles.momentum) == pytest.approx(
        np.tan(angles.omega) / i3, rel=1e-14
    )
    states = motion_of(moments, omega, np.linspace(0.0, 20.0, 9))
    for q, w in zip(np.array(states.attitude), np.array(states.omega), strict=True):
        turn = Rotation.from_quat(np.array(q), scalar_first=True)
        momentum, rate, axis = (
            turn.apply(moments * w),
            turn.apply(w),
            turn.apply([0.0, 0.0, 1.0]),
        )
        assert abs(np.dot(momentum, np.cross(rate, axis))) < 1e-14 * np.linalg.norm(
            momentum
        )

        def between(a, b):
            return np.arctan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b))

        assert between(rate, axis) == pytest.approx(float(angles.omega), rel=1e-13)
        assert between(momentum, axis) == pytest.approx(
            float(angles.momentum), rel=1e-13
        )
        assert between(momentum, rate) == pytest.approx(float(angles.space), rel=1e-13)
    if kind == "oblate":  # the momentum between axis and rate
        assert angles.momentum < angles.omega
        assert angles.momentum + angles.space == pytest.approx(
            float(angles.omega), rel=1e-14
        )
    else:
        assert angles.omega < angles.momentum
        assert angles.omega + angles.space == pytest.approx(
            float(angles.momentum), rel=1e-14
        )


def test_the_axis_of_a_symmetric_body_precesses_at_the_precession_rate():
    moments, omega = np.array([1.0, 1.0, 1.6]), np.array([0.3, 0.0, 1.2])
    rate = float(free.precession_rate(moments, omega))
    state = motion_of(moments, omega, 0.8 / rate)
    momentum = moments * omega
    turn = Rotation.from_rotvec(0.8 * momentum / np.linalg.norm(momentum))
    axis = Rotation.from_quat(np.array(state.attitude), scalar_first=True).apply(
        [0.0, 0.0, 1.0]
    )
    np.testing.assert_allclose(axis, turn.apply([0.0, 0.0, 1.0]), atol=1e-14)


# --- The asymmetric body
# ------------------------------------------------------------------------


def test_the_separatrix_is_where_landau_says():
    """L3/L1 = +-sqrt((I2/I1 - 1) / (1 - I2/I3)); about the third axis above,
    the first below."""
    i1, i2, i3 = 1.0, 1.7, 2.9
    moments = np.array([i1, i2, i3])
    edge = free.separatrix(moments)
    ratio = np.sqrt((i2 / i1 - 1) / (1 - i2 / i3))
    assert edge.momentum_ratio == pytest.approx(ratio, rel=1e-14)
    assert edge.omega_ratio == pytest.approx(ratio * i1 / i3, rel=1e-14)
    assert edge.momentum_angle == pytest.approx(np.arctan(ratio), rel=1e-14)
    assert edge.omega_angle == pytest.approx(np.arctan(ratio * i1 / i3), rel=1e-14)
    shuffled = free.separatrix(np.array([i3, i1, i2]))
    assert shuffled.momentum_ratio == pytest.approx(ratio, rel=1e-14)
    for sign in (1, -1):
        for factor, name in ((1.01, "largest"), (0.99, "smallest")):
            momentum = np.array([1.0, 0.4, sign * factor * ratio])
            code = free.regime(moments, momentum / moments)
            assert free.REGIMES[code] == f"about the axis of the {name} moment"


@pytest.mark.parametrize("share", [0.02, 0.5, 0.98])
def test_which_axis_is_circled_follows_from_energy_and_momentum(share):
    """About the third axis for 1/I3 < 2E/L^2 < 1/I2,
    about the first for 1/I2 < 2E/L^2 < 1/I1."""
    moments = np.array([1.0, 1.7, 2.9])
    for low, high, name, fixed in ((2, 1, "largest", 2), (1, 0, "smallest", 0)):
        ratio = (1 - share) / moments[low] + share / moments[high]
        # L of size 1 with that energy and L2 = 0.1
        rest = 1 - 0.1**2
        along1 = (ratio - 0.1**2 / moments[1] - rest / moments[2]) / (
            1 / moments[0] - 1 / moments[2]
        )
        if not 0 < along1 < rest:
            continue
        momentum = np.array([np.sqrt(along1), 0.1, np.sqrt(rest - along1)])
        omega = momentum / moments
        assert omega @ (moments * omega) == pytest.approx(ratio, rel=1e-14)
        assert free.REGIMES[free.regime(moments, omega)].endswith(f"the {name} moment")
        period = float(free.polhode_period(moments, omega))
        curve = np.asarray(motion_of(moments, omega, np.linspace(0, period, 101)).omega)
        signs = [np.ptp(np.sign(curve[:, n])) for n in range(3)]
        assert [n for n in range(3) if signs[n] == 0] == [fixed]


CODES = {
    "at rest": (MOMENTS, np.zeros(3)),
    "sphere": (np.full(3, 2.0), np.array([1.0, 2.0, 3.0])),
    "steady rotation": (MOMENTS, np.array([0.0, 2.0, 0.0])),
    "about the axis of the smallest moment": (
        np.array([2.0, 2.0, 1.0]),
        np.array([0.3, 0.4, 1.0]),
    ),
    "about the axis of the largest moment": (
        np.array([2.0, 3.0, 2.0]),
        np.array([0.3, 0.4, 1.0]),
    ),
    "separatrix": (np.array([1.0, 2.0, 2.25]), np.array([3.0, 1.0, 4.0])),
}


REGIME = jax.jit(free.regime)
NAMES = (
    "at_rest",
    "sphere",
    "steady_rotation",
    "about_smallest",
    "about_largest",
    "separatrix",
)


def test_regimes_are_listed_each_with_a_text():
    assert {*NAMES, "undefined"} <= set(dir(free.REGIMES))
    assert free.REGIMES.texts[:-1] == list(CODES)
    assert free.REGIMES.texts[-1].startswith("undefined: ")


@pytest.mark.parametrize(("name", "text"), list(zip(NAMES, CODES, strict=True)))
def test_every_regime_has_its_code_under_jit_and_as_a_tensor(name, text):
    moments, omega = CODES[text]
    code = REGIME(moments, omega)
    assert code == getattr(free.REGIMES, name)
    assert free.REGIMES[code] == text
    axes = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
    tensor = axes @ np.diag(moments) @ axes.T
    tensor = 0.5 * (tensor + tensor.T)
    assert free.REGIMES[REGIME(tensor, axes @ omega)] == text


def test_steady_rotation_about_the_equator_of_a_symmetric_body():
    moments, omega = np.array([1.0, 1.0, 2.0]), np.array([0.6, 0.8, 0.0])
    assert free.REGIMES[free.regime(moments, omega)] == "steady rotation"
    assert free.polhode_period(moments, omega) == np.inf


BODIES = {
    "about the third axis": (MOMENTS, np.array([0.3, 0.5, 1.0])),
    "about the first axis": (MOMENTS, np.array([1.5, 0.5, 0.3])),
    "near the separatrix": (MOMENTS, np.array([1.0, 1e-4, 0.5774])),
    "other order": (np.array([2.0, 3.0, 1.0]), np.array([0.5, 1.0, 0.3])),
    "backwards": (MOMENTS, np.array([0.3, 0.5, -1.0])),
    "unphysical": (np.array([1.0, 2.0, 9.0]), np.array([0.3, 0.5, 1.0])),
}


@pytest.mark.parametrize("name", BODIES)
def test_periods_and_phases_against_an_integration(name):
    """scipy integrates the body through one period;
    its turn about the momentum is unwrapped."""
    moments, omega = BODIES[name]
    period = float(free.polhode_period(moments, omega))
    momentum = moments * omega
    size = np.linalg.norm(momentum)

    def rhs(_, y):
        q, w = y[:4], y[4:7]
        dq = 0.5 * np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))])
        return [
            *dq,
            *(np.cross(moments * w, w) / moments),
            1 / size * (w @ (moments * w)),
        ]

    start = [*IDENTITY, *omega, 0.0]
    ts = np.linspace(0.0, period, 4001)
    path = solve_ivp(
        rhs, (0, period), start, method="DOP853", t_eval=ts, rtol=1e-12, atol=1e-13
    ).y
    back = np.linalg.norm(path[4:7] - omega[:, None], axis=0)
    np.testing.assert_allclose(back[-1], 0, atol=1e-8)
    assert np.min(back[40:-40]) > 1e-3 * np.linalg.norm(omega)  # and not before
    # The axis circled, seen along the momentum, unwrapped.
    circled = {"smallest": np.argmin(moments), "largest": np.argmax(moments)}[
        free.REGIMES[free.regime(moments, omega)].split()[-2]
    ]
    axis = np.eye(3)[circled] * np.sign(momentum[circled])
    in_space = Rotation.from_quat(path[:4].T, scalar_first=True).apply(axis)
    e3 = momentum / size
    e1 = np.cross(e3, [0.3, 0.9, -0.2])
    e1 /= np.linalg.norm(e1)
    angle = np.unwrap(np.arctan2(in_space @ np.cross(e3, e1), in_space @ e1))
    turned = free.precession_per_period(moments, omega)
    assert turned == pytest.approx(angle[-1] - angle[0], rel=1e-8)
    assert free.mean_precession_rate(moments, omega) * period == pytest.approx(
        float(turned), rel=1e-13
    )
    # The geometric phase: what is left of it without 2 E T / |L|.
    dynamic = path[7, -1]
    phase = free.geometric_phase(moments, omega)
    assert phase == pytest.approx(angle[-1] - angle[0] - dynamic, rel=1e-7)
    # ... minus the solid angle that the momentum circles in the body, up to whole
    # turns.
    unit = (moments * path[4:7].T) / size
    longitude = np.unwrap(
        np.arctan2(unit[:, (circled + 2) % 3], unit[:, (circled + 1) % 3])
    )
    height = unit @ axis
    area = np.sum(0.5 * ((1 - height[1:]) + (1 - height[:-1])) * np.diff(longitude))
    area *= np.sign(momentum[circled])
    difference = (float(phase) + area) / (2 * np.pi)
    assert difference == pytest.approx(round(difference), abs=2e-5)


def test_a_period_can_be_fitted_and_designed():
    """Derivatives of period, phases and modulus against central differences,
    moments and tensor."""
    names = (
        "polhode_period",
        "mean_precession_rate",
        "precession_per_period",
        "geometric_phase",
        "parameter",
        "modulus",
    )

    @jax.jit
    def all_of(x):
        return jnp.stack([getattr(free, name)(x[:3], x[3:]) for name in names])

    slopes = quick_jit(jax.jacrev(all_of))
    for moments, omega in BODIES.values():
        if abs(omega[1]) < 1e-3:
            continue
        x = np.concatenate([moments, omega])
        found = np.asarray(slopes(x))
        h = 1e-5
        for n in range(6):
            step = h * np.eye(6)[n]
            difference = (
                8 * (all_of(x + step) - all_of(x - step))
                - (all_of(x + 2 * step) - all_of(x - 2 * step))
            ) / (12 * h)
            scale = np.max(np.abs(found), axis=1)
            np.testing.assert_array_less(
                np.abs(found[:, n] - difference), 1e-8 * (1 + scale)
            )


def test_the_period_has_its_derivative_at_a_pure_spin():
    """T = 2 pi sqrt(I1 I2 / ((I3 - I1)(I3 - I2))) / omega3,
    in the limit of small wobbles."""

    def small(x):
        i1, i2, i3, w = x[0], x[1], x[2], x[5]
        return 2 * jnp.pi * jnp.sqrt(i1 * i2 / ((i3 - i1) * (i3 - i2))) / w

    def period(x):
        return free.polhode_period(x[:3], x[3:])

    @functools.cache
    def all_of(f):
        return quick_jit(lambda x: (f(x), jax.grad(f)(x), jax.hessian(f)(x)))

    for moments in (MOMENTS, np.array([1.0, 1.0, 1.5]), np.array([2.0, 1.7, 1.0])):
        x = np.concatenate([moments, [0.0, 0.0, 1.3]])
        value, slopes, curvature = all_of(period)(x)
        exact_value, exact_slopes, exact = all_of(small)(x)
        assert value == pytest.approx(float(exact_value), rel=1e-14)
        np.testing.assert_allclose(slopes, exact_slopes, rtol=1e-12, atol=1e-13)
        assert np.all(np.isfinite(curvature))
        np.testing.assert_allclose(
            curvature[:3, :3], exact[:3, :3], rtol=1e-11, atol=1e-10
        )


def test_jacobi_s_modulus_of_landau():
    """k^2 = (I2 - I1)(2 E I3 - L^2) / ((I3 - I2)(L^2 - 2 E I1)), eq. 37.11,
    when L^2 > 2 E I2."""
    i1, i2, i3 = MOMENTS
    omega = np.array([0.3, 0.5, 1.0])
    energy, square = omega @ (MOMENTS * omega), np.sum((MOMENTS * omega) ** 2)
    assert square > energy * i2
    m = (i2 - i1) * (energy * i3 - square) / ((i3 - i2) * (square - energy * i1))
    assert free.parameter(MOMENTS, omega) == pytest.approx(m, rel=1e-14)
    assert free.modulus(MOMENTS, omega) == pytest.approx(np.sqrt(m), rel=1e-14)


def test_polhode_lies_on_poinsot_s_sphere_and_ellipsoid():
    omega = np.array([0.3, 0.5, 1.0])
    curve = np.asarray(free.polhode(MOMENTS, omega, 101))
    surfaces = free.poinsot(MOMENTS, omega)
    momentum = MOMENTS * curve
    np.testing.assert_allclose(
        np.linalg.norm(momentum, axis=1), surfaces.sphere_radius, rtol=1e-14
    )
    on = np.sum((momentum / np.asarray(surfaces.momentum_ellipsoid)) ** 2, axis=1)
    np.testing.assert_allclose(on, 1.0, rtol=1e-14)
    on = np.sum((curve / np.asarray(surfaces.omega_ellipsoid)) ** 2, axis=1)
    np.testing.assert_allclose(on, 1.0, rtol=1e-14)
    np.testing.assert_allclose(curve[0], omega, atol=1e-15)
    np.testing.assert_allclose(curve[-1], omega, atol=1e-13)
    assert np.all(np.linalg.norm(np.diff(curve, axis=0), axis=1) > 1e-3)


def test_polhode_of_the_separatrix_runs_from_pole_to_pole():
    moments, omega = CODES["separatrix"]
    curve = np.asarray(free.polhode(moments, omega, 101))
    np.testing.assert_allclose(curve[50], omega, rtol=1e-12)
    spin = np.linalg.norm(moments * omega) / moments[1]
    np.testing.assert_allclose(np.abs(curve[[0, -1], 1]), spin, rtol=1e-7)
    assert curve[0, 1] * curve[-1, 1] < 0


def test_herpolhode_lies_in_the_invariable_plane():
    omega = np.array([0.3, 0.5, 1.0])
    attitude = np.asarray(jr.rotation.exp(np.array([0.3, -0.8, 0.4])))
    ts = np.linspace(0.0, 50.0, 12).reshape(3, 4)
    curve = free.herpolhode(MOMENTS, jr.State(attitude, omega), ts)
    assert curve.shape == (3, 4, 3)
    momentum = np.asarray(jr.rotation.rotate(attitude, MOMENTS * omega))
    along = np.asarray(curve) @ (momentum / np.linalg.norm(momentum))
    np.testing.assert_allclose(
        along, free.poinsot(MOMENTS, omega).plane_distance, rtol=1e-13
    )


# --- Small wobbles
# ------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", range(3))
def test_linearised_motion_agrees_to_the_square_of_the_wobble(axis):
    for size in (1e-3, 1e-5):
        omega = 1.3 * np.eye(3)[axis] + size * np.eye(3)[(axis + 1) % 3] - size / 2
        omega[axis] = 1.3
        ts = np.linspace(-4.0, 6.0, 11)
        exact = np.asarray(motion_of(MOMENTS, omega, ts).omega)
        linear = np.asarray(jr.stability.linearized(MOMENTS, axis, omega, ts))
        wobble = np.max(np.abs(np.delete(exact, axis, axis=1)))
        assert np.max(np.abs(exact - linear)) < 2 * wobble**2
        assert wobble < 100 * size
    growth = jr.stability.growth_rate_squared(MOMENTS, axis, 1.3)
    assert (growth > 0) == (axis == 1)
    if axis != 1:
        period = free.polhode_period(MOMENTS, 1.3 * np.eye(3)[axis])
        assert -growth == pytest.approx(float((2 * np.pi / period) ** 2), rel=1e-13)


def test_linearised_motion_stays_finite_and_the_modulus_at_most_one():
    far = jr.stability.linearized(
        MOMENTS, 1, np.array([1e-3, 1.0, 0.0]), np.array([2000.0, -1e6])
    )
    assert np.all(np.isfinite(far))
    assert free.parameter(np.array([1.0, 2.0, 2.25]), np.array([0.75, 0.5, 1.0])) <= 1


def test_slopes_of_the_separatrix_s_angle():
    slopes = jax.grad(lambda i: free.separatrix(i).momentum_angle)
    i1, i2, i3 = 1.0, 1.7, 2.9
    ratio = np.sqrt((i2 / i1 - 1) / (1 - i2 / i3))
    by_i2 = (
        (1 / i1 / (i2 / i1 - 1) + 1 / i3 / (1 - i2 / i3)) * ratio / 2 / (1 + ratio**2)
    )
    assert slopes(np.array([i1, i2, i3]))[1] == pytest.approx(by_i2, rel=1e-13)
    np.testing.assert_array_equal(
        slopes(np.array([1.0, 1.0, 2.0])), [-np.inf, np.inf, 0.0]
    )
    np.testing.assert_array_equal(
        slopes(np.array([1.0, 2.0, 2.0])), [0.0, np.inf, -np.inf]
    )


def test_a_body_less_symmetric_than_it_is_flat_has_no_wobble_rate():
    for third, symmetric in ((1.0 + 1.5e-8, False), (2.0, True)):
        rate = free.wobble_rate(
            np.array([1.0, 1.0 + 1e-8, third]), np.array([0.0, 0.0, 1.0])
        )
        assert np.isfinite(rate) == symmetric


def test_linearised_sphere_and_symmetric_body_are_exact_limits():
    np.testing.assert_array_equal(
        jr.stability.growth_rate_squared(np.ones(3), 0, 2.0), 0.0
    )
    slope = jax.jacfwd(
        lambda i: jr.stability.linearized(i, 2, np.array([0.1, 0.2, 1.0]), 3.0)
    )(np.ones(3))
    # w1' = (I2 - I3) w2 w3 / I1: a first step of the motion, 3 seconds long
    np.testing.assert_allclose(slope[0], [0.0, 0.6, -0.6], atol=1e-14)
    np.testing.assert_allclose(slope[1], [-0.3, 0.0, 0.3], atol=1e-14)


# --- Asteroids
# ----------------------------------------------------------------------------------


def test_periods_of_4179_toutatis():
    """Published: 5.38 and 7.41 days (B. E. A. Mueller, N. H. Samarasinha, M. J. S.
    Belton, Icarus 158 (2002) 305), 5.41 and 7.35 (R. S. Hudson, S. J. Ostro,
    Science 270 (1995) 84).

    Moments and state: Y. Takahashi, M. W. Busch, D. J. Scheeres, Astron. J. 146:95
        (2013).
    """
    record = jr.datasets.toutatis_1992()
    rotation = free.polhode_period(record.moments, record.epoch_omega) / DAY
    precession = (
        2 * np.pi / free.mean_precession_rate(record.moments, record.epoch_omega) / DAY
    )
    assert f"{float(rotation):.5f}" == "5.36853"
    assert f"{float(precession):.5f}" == "7.41165"
    assert rotation == pytest.approx(5.38, abs=0.02)
    assert precession == pytest.approx(7.41, abs=0.01)
    code = free.regime(record.moments, record.epoch_omega)
    assert free.REGIMES[code] == "about the axis of the smallest moment"


# Angles [deg] between the observed and the computed directions of the body's long,
# intermediate and short axes, as Principia's physics/euler_solver_test.cpp prints them,
# each to its last digit.
PRINCIPIA = """
7.9 5.4 5.9, 6.6 7.7 4.7, 13 15 9.4, 9.4 4.3 8.4, 2.0 0.6 2.1, 5.7 15 15, 3.0 2.6 2.6,
3.4 3.4 1.1, 3.1 1.4 3.4, 2.8 1.6 2.7, 2.0 3.2 2.6, 2.5 5.3 5.3, 4.1 3.8 4.5,
3.2 8.2 8.0, 7.3 5.8 8.0,
0.8 1.1 1.2, 5.6 6.3 4.1, 29 122 131
"""


def test_radar_attitudes_of_toutatis_as_closely_as_principia():
    record = jr.datasets.toutatis_1992()
    states = jr.free_rotation(
        record.moments,
        jr.State(record.epoch_attitude, record.epoch_omega),
        record.times,
    )
    computed = Rotation.from_quat(
        np.array(states.attitude), scalar_first=True
    ).as_matrix()
    observed = Rotation.from_quat(
        np.array(record.attitudes), scalar_first=True
    ).as_matrix()
    cosines = np.einsum("nik,nik->nk", computed, observed)
    angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))[:, [2, 0, 1]]
    for row, printed in zip(angles, PRINCIPIA.strip().split(","), strict=True):
        for angle, digits in zip(row, printed.split(), strict=True):
            unit = 0.1 if "." in digits else 1.0
            assert abs(angle - float(digits)) <= unit


def test_periods_of_99942_apophis():
    """P. Pravec et al., Icarus 233 (2014) 48: precession 27.38 +- 0.07 h, rotation 263
    +- 6 h, from I1/I3 = 0.61, I2/I3 = 0.965, E/E0 = 1.024, E0 the energy of the slowest
    spin with that momentum.
    """
    i1, _, i3 = moments = np.array([0.61, 0.965, 1.0])
    energy = 1.024 / i3  # 2 E for |L| = 1
    along1 = (energy - 1 / i3) / (1 / i1 - 1 / i3)
    momentum = np.array([np.sqrt(along1), 0.0, np.sqrt(1 - along1)])
    omega = momentum / moments
    assert (
        free.REGIMES[free.regime(moments, omega)]
        == "about the axis of the largest moment"
    )
    # The momentum itself is published as the precession period alone: it sets the unit
    # of time.
    precession = 2 * np.pi / float(free.mean_precession_rate(moments, omega))
    omega = omega * precession / (27.38 * 3600)
    assert free.polhode_period(moments, omega) / 3600 == pytest.approx(263, abs=6)


# --- Outside the domain
# -------------------------------------------------------------------------

OF_ANY_BODY = (
    "polhode_period",
    "mean_precession_rate",
    "precession_per_period",
    "geometric_phase",
    "parameter",
    "modulus",
    "poinsot",
)
SYMMETRIC = ("wobble_rate", "precession_rate", "cone_angles")
SKEWED = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 3.0]])
LANES = {  # the inertia and the rates of each
    "good": (np.array([1.0, 1.0, 3.0]), np.ones(3)),
    "negative": (np.array([1.0, -1.0, 3.0]), np.ones(3)),
    "zero": (np.array([0.0, 1.0, 3.0]), np.ones(3)),
    "NaN moment": (np.array([1.0, 1.0, np.nan]), np.ones(3)),
    "infinite moment": (np.array([1.0, 1.0, np.inf]), np.ones(3)),
    "infinite rate": (np.array([1.0, 1.0, 3.0]), np.array([0.0, np.inf, 0.0])),
    "NaN rate": (np.array([1.0, 1.0, 3.0]), np.array([0.0, np.nan, 0.0])),
    "also good": (np.array([2.0, 2.0, 1.0]), np.array([0.3, -0.4, 0.9])),
}
IN_DOMAIN = np.array(["good" in name for name in LANES])


def along_the_motion(inertia, omega):
    return {
        "relative_rotation": free.relative_rotation(inertia, omega, 2.0),
        "polhode": free.polhode(inertia, omega, 5),
        "herpolhode": free.herpolhode(
            inertia, jr.State(IDENTITY, omega), np.arange(2.0)
        ),
    }


def every_formula(inertia, omega):
    values = {n: getattr(free, n)(inertia, omega) for n in (*OF_ANY_BODY, *SYMMETRIC)}
    # of a tensor the motion's derivatives take a minute to compile; the values are
    # tested below
    return values | (along_the_motion(inertia, omega) if inertia.ndim == 1 else {})


@quick_jit
def all_lanes(inertia, omega):
    """Values of every formula, and the derivatives of their sum where they are
    numbers."""

    def total(inertia, omega, shift):
        more = shift * (1.0 if inertia.ndim == 2 else jnp.eye(3))
        values = jax.vmap(lambda i, w: every_formula(i + more, w + shift))(
            inertia, omega
        )
        leaves = jax.tree.leaves(values)
        return sum(jnp.sum(jnp.where(jnp.isfinite(x), x, 0.0)) for x in leaves), values

    inputs = (inertia, omega, jnp.zeros(()))
    _, push, values = jax.linearize(total, *inputs, has_aux=True)
    slopes = jax.linear_transpose(push, *inputs)(jnp.ones(()))
    forward = push(jnp.zeros_like(inertia), jnp.zeros_like(omega), jnp.ones(()))
    return values, slopes, forward


@pytest.mark.parametrize(
    "kind", ["moments", pytest.param("tensor", marks=pytest.mark.slow)]
)
def test_outside_its_domain_a_formula_is_nan_in_that_lane_alone(kind):
    inertia, omega = (np.stack(x) for x in zip(*LANES.values(), strict=True))
    if kind == "tensor":
        inertia = np.where(np.eye(3, dtype=bool), inertia[:, None, :], 0.0)
        inertia[2] = SKEWED
    values, (by_inertia, by_omega, by_shift), forward = all_lanes(inertia, omega)
    if kind == "tensor":
        values |= quick_jit(jax.vmap(along_the_motion))(inertia, omega)
    for name, leaves in values.items():
        for leaf in jax.tree.leaves(leaves):
            numbers = np.isfinite(np.asarray(leaf).reshape(len(LANES), -1))
            np.testing.assert_array_equal(numbers.all(1), IN_DOMAIN, err_msg=name)
            np.testing.assert_array_equal(numbers.any(1), IN_DOMAIN, err_msg=name)
    assert np.all(np.isfinite(by_inertia))
    assert np.all(np.isfinite(by_omega))
    # the derivative of what the lanes share is that of the good lanes, in both modes
    by_moments = by_inertia if kind == "moments" else np.einsum("nii->ni", by_inertia)
    np.testing.assert_array_equal(by_moments[~IN_DOMAIN], 0.0)
    np.testing.assert_array_equal(by_omega[~IN_DOMAIN], 0.0)
    expected = np.sum(by_moments) + np.sum(by_omega)
    np.testing.assert_allclose([by_shift, forward], expected, rtol=1e-11)
    codes = jax.vmap(free.regime)(inertia, omega)
    np.testing.assert_array_equal(codes != free.REGIMES.undefined, IN_DOMAIN)


def test_a_body_that_is_not_symmetric_about_the_third_axis_has_no_wobble_rate():
    bodies = [
        np.diag([1.0, 1.0, 3.0]),
        np.diag(MOMENTS),
        np.diag([2.0, 1.0, 1.0]),
        np.diag([1.0, 1.0, 2.0]) + 0.1,
    ]
    omega = np.tile([0.3, -0.4, 1.2], (4, 1))
    values = all_lanes(np.stack(bodies * 2), np.concatenate([omega] * 2))[0]
    for name in SYMMETRIC:
        for leaf in jax.tree.leaves(values[name]):
            np.testing.assert_array_equal(np.isnan(leaf), [False, True, True, True] * 2)
    assert np.all(np.isfinite(values["mean_precession_rate"]))


def test_a_sphere_has_no_separatrix():
    @quick_jit
    def both(shift):
        value, push, edges = jax.linearize(total, shift, has_aux=True)
        return (
            push(shift + 1),
            jax.linear_transpose(push, shift)(jnp.ones_like(value)),
            edges,
        )

    def total(shift):
        bodies = np.array(
            [[2.0] * 3, [1.0, 2.0, 3.0], [1.0, -2.0, 3.0], [1.0, np.nan, 3.0]]
        )
        edges = jax.vmap(lambda i: free.separatrix(i + shift))(bodies)
        return jnp.nansum(edges.omega_angle), edges

    forward, (reverse,), edges = both(0.0)
    for leaf in edges:
        np.testing.assert_array_equal(np.isnan(leaf), [True, False, True, True])
    alone = quick_jit(jax.grad(lambda x: free.separatrix(MOMENTS + x).omega_angle))(0.0)
    np.testing.assert_allclose([reverse, forward], [alone] * 2, rtol=1e-14)


def test_wrong_shapes_and_options(untyped):
    for points in (1, 2.0):
        with pytest.raises(
            ValueError, match="`points` must be an integer and at least 2"
        ):
            free.polhode(MOMENTS, np.ones(3), points)
    with pytest.raises(ValueError, match="`axis` must be one of 0, 1, 2"):
        jr.stability.growth_rate_squared(MOMENTS, 3, 1.0)
    with pytest.raises(ValueError, match=r"`omega` must have shape \(3,\)"):
        free.polhode_period(MOMENTS, np.ones(4))
    with pytest.raises(ValueError, match=r"`duration` must have shape \(\)"):
        free.relative_rotation(MOMENTS, np.ones(3), np.ones(2))
    with pytest.raises(
        ValueError, match=r"`inertia` must have shape \(3,\) or \(3, 3\)"
    ):
        free.separatrix(np.ones(2))


def test_times_that_their_dtype_cannot_tell_apart_are_an_error():
    """Unix time in float32: its numbers are 128 seconds apart."""
    single = [
        jnp.asarray(x, jnp.float32)
        for x in ([1.0, 2.0, 3.0], [1.0, 0, 0, 0], [0.1, 1, 0.2])
    ]
    state0 = jr.State(*single[1:])
    ts = jnp.asarray(1.7e9 + np.arange(11.0), jnp.float32)
    with pytest.raises(RuntimeError, match=r"tells apart times .*Subtract the epoch"):
        jr.free_rotation(single[0], state0, ts, t0=jnp.float32(1.7e9))
    motion = jr.free_rotation(single[0], state0, ts, t0=jnp.float32(1.7e9), throw=False)
    assert motion.result == jr.RESULTS.unresolved_times
    assert np.isnan(motion.omega).all()
    top = jr.SymmetricTop(*(jnp.float32(x) for x in (1.0, 0.5, 1.0)))
    with pytest.raises(RuntimeError, match="tells apart times"):
        jr.top_motion(top, state0, ts, t0=jnp.float32(1.7e9))
