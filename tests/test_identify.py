"""Parametrisations of real bodies, and linear regressions on samples of known bodies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import quick_jit
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid import identify
from jrigid.identify import _starts as starts
from jrigid.identify._flow import free_flow
from jrigid.identify._inputs import sizes_of
from jrigid.identify._problem import Options, Problem
from jrigid.identify._quality import signal_of
from jrigid.identify._readings import direct_readings_of
from jrigid.identify._records import of_trials, samples_of
from jrigid.identify._unknowns import unknowns_of


def second_moments(tensor):
    return 0.5 * np.trace(tensor) * np.eye(3) - tensor


def a_body(rng):
    """Of twelve points: physical without any formula."""
    return jr.from_points(
        rng.uniform(0.1, 1, 12), rng.normal((0.3, -0.2, 0.1), 1.0, (12, 3))
    )


def test_any_six_numbers_are_a_real_body_s(rng):
    for _ in range(50):
        numbers = rng.normal(size=6) * rng.choice([0.1, 1, 3])
        tensor = np.asarray(identify.inertia_from_parameters(numbers))
        np.testing.assert_array_equal(tensor, tensor.T)
        # Sigma = L L^T with the L of the docstring: positive definite
        n = numbers
        lower = np.exp(n[0]) * np.array(
            [
                [1, 0, 0],
                [numbers[3], np.exp(numbers[1]), 0],
                [numbers[4], numbers[5], np.exp(numbers[2])],
            ],
            np.longdouble,  # a needle's moment is a small difference
        )
        sigma = lower @ lower.T
        np.testing.assert_allclose(
            tensor, np.trace(sigma) * np.eye(3) - sigma, rtol=1e-13
        )
        moments = np.linalg.eigvalsh(tensor)
        assert moments[0] > 0
        assert moments[2] <= moments[0] + moments[1] + 1e-14 * moments[2]


def test_both_ways_of_the_six_numbers(rng):
    for _ in range(20):
        tensor = np.asarray(a_body(rng).inertia)
        numbers = identify.parameters_from_inertia(tensor)
        np.testing.assert_allclose(
            identify.inertia_from_parameters(numbers), tensor, rtol=1e-12
        )
        # the first is the scale, the others the shape
        scaled = identify.parameters_from_inertia(9.0 * tensor)
        np.testing.assert_allclose(scaled[0] - numbers[0], np.log(3.0), rtol=1e-12)
        np.testing.assert_allclose(scaled[1:], numbers[1:], atol=1e-13)


def test_the_sphere_and_the_symmetric_body_are_nothing_special():
    for moments in ([2.0, 2, 2], [1.0, 1, 1.5], [1.5, 1, 1]):
        numbers = identify.parameters_from_inertia(np.array(moments))
        jacobian = np.asarray(jax.jacfwd(identify.inertia_from_parameters)(numbers))
        six = jacobian[np.triu_indices(3)]
        assert np.linalg.cond(six) < 30
        back = jax.jacfwd(
            lambda p: identify.parameters_from_inertia(
                identify.inertia_from_parameters(p)
            )
        )
        np.testing.assert_allclose(back(numbers), np.eye(6), atol=1e-13)


def test_the_ten_numbers_both_ways(rng):
    for _ in range(20):
        body = a_body(rng)
        numbers = identify.log_cholesky_from_body(body)
        again = identify.body_from_log_cholesky(numbers)
        np.testing.assert_allclose(again.mass, body.mass, rtol=1e-13)
        np.testing.assert_allclose(
            again.center_of_mass, body.center_of_mass, rtol=1e-13
        )
        np.testing.assert_allclose(again.inertia, body.inertia, rtol=1e-11, atol=1e-12)


def test_the_ten_numbers_are_the_factor_of_the_pseudo_inertia(rng):
    """Rucker & Wensing's definition, about the origin of the coordinates."""
    body = a_body(rng)
    m, c = float(body.mass), np.asarray(body.center_of_mass)
    about_origin = np.asarray(body.about(np.zeros(3)))
    pseudo = np.block(
        [
            [second_moments(about_origin), m * c[:, None]],
            [m * c[None], np.full((1, 1), m)],
        ]
    )
    alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = np.asarray(
        identify.log_cholesky_from_body(body)
    )
    upper = np.exp(alpha) * np.array(
        [
            [np.exp(d1), s12, s13, t1],
            [0, np.exp(d2), s23, t2],
            [0, 0, np.exp(d3), t3],
            [0, 0, 0, 1],
        ]
    )
    np.testing.assert_allclose(upper @ upper.T, pseudo, rtol=1e-12, atol=1e-12)


def test_any_ten_numbers_are_a_real_body_s(rng):
    for _ in range(20):
        body = identify.body_from_log_cholesky(rng.normal(size=10))
        jr.MassProperties(
            body.mass, body.center_of_mass, body.inertia
        )  # checks and does not raise


def test_turned_axes_are_the_same_body(rng):
    """The spectrum does not depend on the axes the factor is written in."""
    body = a_body(rng)
    turn = Rotation.random(rng=0).as_matrix()
    numbers = identify.parameters_from_inertia(turn @ np.asarray(body.inertia) @ turn.T)
    tensor = identify.inertia_from_parameters(numbers)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(tensor), np.linalg.eigvalsh(body.inertia), rtol=1e-12
    )


FLAT = np.array([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("function", "good", "bad"),
    [
        (identify.parameters_from_inertia, np.array([1.0, 2.0, 2.5]), FLAT),
        (
            identify.parameters_from_inertia,
            np.array([1.0, 2.0, 2.5]),
            np.array([1.0, 1, 3]),
        ),
        (
            identify.parameters_from_inertia,
            np.array([1.0, 2.0, 2.5]),
            np.full(3, np.nan),
        ),
        (identify.parameters_from_inertia, np.eye(3), np.eye(3) + 0.1 * np.eye(3, k=1)),
        (identify.inertia_from_parameters, np.arange(6.0) / 9, np.full(6, np.inf)),
        (identify.body_from_log_cholesky, np.arange(10.0) / 9, np.full(10, np.nan)),
        (
            identify.log_cholesky_from_body,
            jr.solids.box(8.0, np.array([1.0, 2.0, 3.0])),
            jr.solids.disk(1.0, 0.5),
        ),
    ],
)
def test_outside_the_domain_a_lane_is_nan_and_derivatives_are_clean(
    function, good, bad
):
    """That of the lane, that of the other lane, and that of what they share."""
    lanes = jax.tree.map(
        lambda *x: jnp.stack([jnp.asarray(y, float) for y in x]), good, bad
    )
    values = jax.vmap(function)(lanes)
    alone = function(good)
    for both, one in zip(jax.tree.leaves(values), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(both[0], one, rtol=1e-14)
        assert np.all(np.isnan(both[1]))

    def total(shift, lanes):
        moved = jax.tree.map(lambda x: x + shift, lanes)
        return sum(jnp.nansum(x) for x in jax.tree.leaves(jax.vmap(function)(moved)))

    slope = jax.jit(jax.grad(total, argnums=(0, 1)))
    of_shift, of_lanes = slope(0.0, lanes)
    expected, of_good = slope(
        0.0, jax.tree.map(lambda x: jnp.stack([x[0], x[0]]), lanes)
    )
    np.testing.assert_allclose(of_shift, expected / 2, rtol=1e-12)
    for both, one in zip(
        jax.tree.leaves(of_lanes), jax.tree.leaves(of_good), strict=True
    ):
        np.testing.assert_allclose(both[0], one[0], rtol=1e-12)
        assert np.all(both[1] == 0)


def test_bad_shapes_and_flat_bodies(untyped):
    with pytest.raises(ValueError, match="`parameters` must have shape \\(6,\\)"):
        identify.inertia_from_parameters(np.zeros(5))
    with pytest.raises(ValueError, match="must be a MassProperties"):
        identify.log_cholesky_from_body(np.eye(3))
    with pytest.raises(
        RuntimeError, match="`body` must have extent in three directions"
    ):
        identify.LogCholesky(jr.solids.disk(1.0, 0.5))


# --- Linear starts
# ------------------------------------------------------------------------------

TENSOR = np.array([[2.0, -0.3, 0.2], [-0.3, 2.5, 0.4], [0.2, 0.4, 1.7]])
RATIOS = TENSOR / np.trace(TENSOR)
STATE = jr.State(np.array([0.5, -0.5, 0.5, 0.5]), np.array([0.4, 0.9, -0.6]))
TS = np.linspace(0.0, 50.0, 1001)


@pytest.fixture(scope="module")
def free_samples():
    motion = jr.free_rotation(TENSOR, STATE, TS)
    return np.asarray(motion.attitude), np.asarray(motion.omega)


@pytest.fixture(scope="module")
def wheel_samples():
    """(I omega + h)' = -omega x (I omega + h), h of a wheel inside."""

    def h(t):
        return np.stack([0.3 * np.sin(t), 0.2 + 0 * t, 0.05 * t])

    def rate(t, omega):
        slope = np.array([0.3 * np.cos(t), 0.0, 0.05])
        return np.linalg.solve(TENSOR, np.cross(TENSOR @ omega + h(t), omega) - slope)

    start = np.asarray(STATE.omega)
    motion = solve_ivp(rate, (0, TS[-1]), start, "DOP853", TS, rtol=1e-10, atol=1e-12)
    return motion.y.T.copy(), h(TS).T.copy()


def test_exact_samples_give_the_body(free_samples, wheel_samples):
    attitudes, omegas = free_samples
    weak = identify.weak_form(TS, omegas)
    np.testing.assert_allclose(weak.inertia, RATIOS, atol=1e-6)
    assert weak.singular_values[-1] < 1e-6 * weak.singular_values[-2]
    by_momentum = identify.momentum(TS, attitudes, omegas)
    np.testing.assert_allclose(by_momentum.inertia, RATIOS, atol=1e-13)
    exact = Rotation.from_quat(attitudes[0], scalar_first=True).apply(
        RATIOS @ omegas[0]
    )
    np.testing.assert_allclose(by_momentum.momentum, exact, atol=1e-12)
    wheel = identify.gyrostat(TS, *wheel_samples)
    np.testing.assert_allclose(wheel.inertia, TENSOR, rtol=1e-5)


def test_errors_fall_with_the_noise(free_samples, wheel_samples, rng):
    attitudes, omegas = free_samples
    for noise, bar in ((0.01, 0.02), (0.001, 0.002)):
        errors = []
        for _ in range(10):
            dirty = omegas + noise * rng.normal(size=omegas.shape)
            turned, wheel = wheel_samples
            found = (
                identify.weak_form(TS, dirty).inertia / RATIOS,
                identify.momentum(TS, attitudes, dirty).inertia / RATIOS,
                identify.gyrostat(
                    TS, turned + noise * rng.normal(size=turned.shape), wheel
                ).inertia
                / TENSOR,
            )
            errors.append([np.sqrt(np.mean((np.diagonal(x) - 1) ** 2)) for x in found])
        assert np.all(np.median(errors, axis=0) < bar), np.median(errors, axis=0)


def test_samples_that_are_missing_are_left_out(free_samples, wheel_samples, rng):
    attitudes, omegas = (x.copy() for x in free_samples)
    turned, wheel = (x.copy() for x in wheel_samples)
    lost = rng.choice(len(TS), 10, replace=False)
    for x in (attitudes, omegas, turned):
        x[lost] = np.nan
    np.testing.assert_allclose(
        identify.weak_form(TS, omegas).inertia, RATIOS, atol=1e-5
    )
    found = identify.momentum(TS, attitudes, omegas)
    np.testing.assert_allclose(found.inertia, RATIOS, atol=1e-12)
    found = identify.gyrostat(TS, turned, wheel).inertia
    np.testing.assert_allclose(found, TENSOR, rtol=1e-4)


def test_what_the_samples_do_not_tell_shows_in_the_singular_values():
    """Pure spin: ratios are not determined; the unit of time and of the rates changes nothing."""
    spin = np.tile([0.0, 0.0, 1.3], (len(TS), 1))
    values = np.asarray(identify.weak_form(TS, spin).singular_values)
    assert np.sum(values > 1e-6 * values[0]) <= 3
    omegas = np.asarray(jr.free_rotation(TENSOR, STATE, TS).omega)
    for unit in (1e-7, 1e4):
        found = identify.weak_form(TS / unit, omegas * unit)
        np.testing.assert_allclose(found.inertia, RATIOS, atol=1e-6)


def test_one_window_gives_a_tensor_that_obeys_its_equations(free_samples):
    """It has three equations for six numbers, so that many tensors do."""
    _, omegas = free_samples
    found = identify.weak_form(TS, omegas, windows=1, radians=20.0)
    values = np.asarray(found.singular_values)
    np.testing.assert_array_equal(values[3:], 0.0)
    seen, nothing = np.ones(len(TS), bool), np.zeros_like(omegas)
    rows = starts._weak_rows(1, 20.0, TS, seen, omegas, nothing, nothing)
    tensor = np.asarray(found.inertia)
    six = np.concatenate([np.diag(tensor), tensor[[0, 0, 1], [1, 2, 2]]])
    size = np.linalg.norm(rows[:, :6]) * np.linalg.norm(six)
    assert np.linalg.norm(rows[:, :6] @ six) < 1e-12 * size


def test_starts_under_jit_vmap_and_derivatives(free_samples, wheel_samples, rng):
    attitudes, omegas = free_samples
    turned, wheel = wheel_samples
    ts, change = TS, rng.normal(size=omegas.shape)

    def all_three(s):
        dirty, other = omegas + s * change, turned + s * change
        return (
            identify.weak_form(ts, dirty).inertia,
            identify.momentum(ts, attitudes, dirty).inertia,
            identify.gyrostat(ts, other, wheel).inertia,
        )

    values, slopes = jax.jit(jax.vmap(lambda s: jax.jvp(all_three, (s,), (1.0,))))(
        jnp.array([0.02, 0.03])
    )
    h = 1e-6
    up, down, here = all_three(0.02 + h), all_three(0.02 - h), all_three(0.02)
    for value, slope, a, b, c in zip(values, slopes, up, down, here, strict=True):
        np.testing.assert_allclose(value[0], c, atol=1e-12)
        np.testing.assert_allclose(
            slope[0], (a - b) / (2 * h), atol=1e-7 * np.max(np.abs(slope))
        )
    single = identify.weak_form(
        ts.astype(np.float32), omegas.astype(np.float32)
    ).inertia
    assert single.dtype == np.float32
    np.testing.assert_allclose(
        single, identify.weak_form(ts, omegas).inertia, atol=1e-3
    )


def test_bad_samples_are_errors(free_samples, wheel_samples, untyped):
    _, omegas = free_samples
    with pytest.raises(RuntimeError, match="`ts` must be finite and increasing"):
        identify.weak_form(TS[::-1].copy(), omegas)
    with pytest.raises(RuntimeError, match=r"four samples that are finite .*: 0"):
        identify.weak_form(TS, np.full_like(omegas, np.nan))
    with pytest.raises(ValueError, match="four times at least"):
        identify.weak_form(TS[:3], omegas[:3])
    with pytest.raises(ValueError, match="`omegas` must have shape"):
        identify.weak_form(TS, omegas[:-1])
    with pytest.raises(ValueError, match="`rotor` must have shape"):
        identify.gyrostat(TS, omegas, wheel_samples[1][:-1])
    found = identify.weak_form(TS[::-1].copy(), omegas, throw=False)
    assert np.all(np.isnan(found.inertia))
    assert found.result == jr.RESULTS.invalid_times


def test_a_bad_lane_of_samples_is_named_or_marked(free_samples):
    attitudes, omegas = (x[::20] for x in free_samples)
    ts = TS[::20]
    lanes = np.stack([omegas, np.full_like(omegas, np.nan)])
    with pytest.raises(
        RuntimeError, match=r"four samples that are finite .*: 0 in lane 1"
    ):
        jax.vmap(lambda w: identify.momentum(ts, attitudes, w))(lanes)
    found = jax.vmap(lambda w: identify.momentum(ts, attitudes, w, throw=False))(lanes)
    assert list(found.result == jr.RESULTS.invalid_state) == [False, True]
    assert list(np.isnan(found.momentum).any(axis=1)) == [False, True]
    np.testing.assert_allclose(found.inertia[0], RATIOS, atol=1e-12)


def test_few_windows_have_no_errors(wheel_samples):
    """Each window has three equations for six unknowns: one and two have no misfit."""
    for windows in (1, 2):
        found = identify.gyrostat(TS, *wheel_samples, windows=windows)
        assert found.inertia.shape == (3, 3)
        assert np.all(np.isnan(found.covariance))
    found = identify.gyrostat(TS, *wheel_samples, windows=5)
    assert np.all(np.diagonal(found.covariance) > 0)


def test_equations_without_a_known_torque_keep_the_trace(rng):
    """They hold for any multiple of a tensor, and so for none at all."""
    rows = np.pad(rng.normal(size=(30, 6)), ((0, 0), (0, 1)))
    tensors = starts._least_squares(rows, None, np.float64(3.3))
    np.testing.assert_allclose([np.trace(x) for x in tensors], 3.3, rtol=1e-12)


@pytest.mark.parametrize("missing", [[], [400], [0, 1, 2], [79, 80, 81]])
def test_attitudes_between_two_observed_ones_follow_the_rates(missing):
    """A missing rate does not send the path back to the attitude before it."""
    ts = np.linspace(0, 20, 801)
    motion = jr.free_rotation(RATIOS, STATE, ts).states
    omegas = np.array(motion.omega)
    omegas[missing] = np.nan
    attitudes = np.array(motion.attitude)
    observed = [0, 80]
    records = of_trials(
        (
            identify.Rates(ts, omegas, 0.01),
            identify.Attitudes(ts[observed], attitudes[observed], 0.01),
        )
    )
    records = jax.tree.map(np.asarray, records)
    readings = direct_readings_of(records, samples_of(records, np.ones(())), None)
    seen = readings.valid[0]
    assert np.sum(seen) == 801 - len(missing)
    turn = Rotation.from_quat(attitudes[seen], scalar_first=True).inv()
    turn *= Rotation.from_quat(readings.attitude[0][seen], scalar_first=True)
    assert np.max(turn.magnitude()) < 2e-3


def noisy_attitudes(rng, ts, moments, omega, sigma):
    """Attitudes of a free body with noise [rad], and its rates."""
    start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.asarray(omega))
    motion = jr.free_rotation(jnp.asarray(moments), start, jnp.asarray(ts))
    noise = Rotation.from_rotvec(sigma * rng.normal(size=(ts.size, 3)))
    turns = Rotation.from_quat(np.asarray(motion.attitude), scalar_first=True)
    attitudes = (turns * noise).as_quat(scalar_first=True)
    record = identify.Attitudes(ts, attitudes, max(sigma, 1e-6))
    return record, np.asarray(motion.omega)


@pytest.mark.parametrize(
    ("step", "sigma", "bar"),
    [
        (1e-3, 5e-3, 0.05),  # rates between neighbours would be 5 rad/s off
        (1e-3, 0.0, 0.02),
        (5e-3, 5e-3, 0.06),
        (0.05, 0.0, 0.02),  # too far apart for parabolas
    ],
)
def test_rates_from_attitudes_however_close_they_are(rng, step, sigma, bar):
    ts = np.delete(np.arange(0.0, 3.0, step), slice(10, 14))
    # A gap of .4 s, through which the body turns by two radians.
    ts = ts[(ts < 1.0) | (ts > 1.4)]
    record, omega = noisy_attitudes(rng, ts, [1.0, 1.5, 2.0], [2.0, 4.0, 1.0], sigma)
    values = np.array(record.values)
    values[20] = np.nan  # one reading is missing
    records = jax.tree.map(
        np.asarray, of_trials(record.with_values(jnp.asarray(values)))
    )
    readings = direct_readings_of(records, samples_of(records, np.ones(())), None)
    seen = readings.valid[0]
    off = np.linalg.norm(readings.omega[0] - omega, axis=1) / np.linalg.norm(omega[0])
    assert np.sum(~seen) == 1
    # Rates are less accurate at the ends, and worthless at a gap beside few attitudes.
    assert np.quantile(off[seen], 0.95) < bar


def test_rates_of_a_body_that_swings_by_small_angles(rng):
    """It never turns far, but its rate changes its sign within some samples."""
    ts = np.arange(0.0, 60.0, 0.05)
    swing = np.outer(0.1 * np.sin(2 * ts), [1.0, 0.0, 0.0])
    rates = np.outer(0.2 * np.cos(2 * ts), [1.0, 0.0, 0.0])
    noise = Rotation.from_rotvec(1e-3 * rng.normal(size=(ts.size, 3)))
    attitudes = (Rotation.from_rotvec(swing) * noise).as_quat(scalar_first=True)
    records = of_trials(identify.Attitudes(ts, attitudes, 1e-3))
    records = jax.tree.map(np.asarray, records)
    readings = direct_readings_of(records, samples_of(records, np.ones(())), None)
    # Rates between neighbours would be off by .02 rad/s.
    off = np.linalg.norm(readings.omega[0] - rates, axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.013


def test_a_fit_of_attitudes_a_millisecond_apart(rng):
    record, _ = noisy_attitudes(
        rng, np.arange(0.0, 3.0, 1e-3), [1.0, 1.5, 2.0], [2.0, 4.0, 1.0], 5e-3
    )
    found = identify.fit(jr.RigidBody(jnp.ones(3)), record, throw=True)
    assert found.status == identify.Status.OK
    off = (found.ratios - np.array([1.5, 2.0])) / found.ratios_errors
    assert np.max(np.abs(off)) < 4


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_flow_has_the_same_value_with_its_derivative(dtype):
    """Also of a symmetric body, whose moments are moved apart in the derivative."""
    omega = np.array([0.5, 1.0, 0.3], dtype)
    tensor = np.diag(np.array([1.0, 1.0, 1.5], dtype))
    arguments = tuple(map(jnp.asarray, (tensor, omega, dtype(100.0))))
    # Outside of jit each operation would be a program of its own.
    turn, rates = quick_jit(lambda *x: jax.jvp(free_flow, x, x)[0])(*arguments)
    # The rates of a symmetric body turn about its axis by this angle.
    angle = (1.5 - 1) * 0.3 * 100.0
    wanted = Rotation.from_rotvec([0, 0, angle]).apply(omega)
    bar = 300 * np.finfo(dtype).eps
    np.testing.assert_allclose(rates, wanted, atol=bar)
    exact_turn, exact_rates = quick_jit(free_flow)(*arguments)
    np.testing.assert_allclose(turn, exact_turn, atol=bar)
    np.testing.assert_allclose(rates, exact_rates, atol=bar)


@pytest.mark.parametrize(
    "off", [1e-9, 1e-3, 1.0, 1.6, np.pi - 2e-3, np.pi - 1e-5, np.pi]
)
def test_the_residual_of_a_direction_is_the_chord(off, rng):
    value = rng.normal(size=3)
    value /= np.linalg.norm(value)
    across = np.cross(value, [0.3, -0.8, 0.5])
    across /= np.linalg.norm(across)
    predicted = np.cos(off) * value + np.sin(off) * across
    sensor = identify.DirectionSensor(jnp.ones(3))
    chord = sensor.difference(jnp.array(value), jnp.array(predicted))
    exact = 2 * np.sin(off / 2)
    np.testing.assert_allclose(np.linalg.norm(chord), exact, rtol=1e-7, atol=1e-15)


def test_the_residual_of_an_opposite_direction_is_two_with_a_finite_derivative():
    sensor = identify.DirectionSensor(jnp.ones(3))
    value = jnp.array([0.0, 0.0, 1.0])
    chord = sensor.difference(value, -value)
    assert float(jnp.linalg.norm(chord)) == 2.0
    assert np.all(np.isfinite(jax.jacfwd(sensor.difference, 1)(value, -value)))


def a_problem(*records, free=None):
    """The problem of a fit of records."""
    records = of_trials(records)
    samples = samples_of(jax.tree.map(np.asarray, records), np.ones(()))
    body = jr.RigidBody(np.ones(3), jr.torques.LinearDrag(1e-5))
    sensors = [x.sensor for x in records]
    unknowns = unknowns_of(
        (body,),
        sensors,
        sizes_of(samples),
        free,
        identify.Tensor(),
        True,
        np.ones(()),
        1,
    )
    return Problem(Options(False, True), unknowns, samples, np.ones(6))


def test_numbers_of_a_tensor_in_another_frame_are_those_of_the_same_body(rng):
    unknowns, _ = identify.Tensor().start(np.eye(3), np.eye(3), 1e-3)
    for numbers in (rng.normal(size=5), np.array([-9.0, -4.0, 0.3, -0.2, 1e-3])):
        own, diagonal = unknowns.in_frame(numbers)
        back, same = own.in_frame(diagonal, unknowns)
        np.testing.assert_allclose(diagonal[2:], 0, atol=1e-12)
        assert 0 > diagonal[0] > diagonal[1]
        np.testing.assert_allclose(same, numbers, rtol=1e-8, atol=1e-12)
        for model, values in ((own, diagonal), (back, same)):
            expected = unknowns.inertia(jnp.asarray(numbers))
            inertia = model.inertia(jnp.asarray(values))
            scaled = inertia * (jnp.trace(expected) / jnp.trace(inertia))
            np.testing.assert_allclose(scaled, expected, atol=1e-13)


def test_a_step_of_a_tensor_is_straight_in_its_second_moments(rng):
    model = identify.Tensor()
    numbers = jnp.asarray(rng.normal(size=5))
    change = jnp.asarray([0.2, 0.3, -0.5, 0.4, 0.7])

    def lower(part):
        x = model.moved(numbers, part * change)
        return jnp.exp(x[0]), jnp.exp(x[1]), x[2], x[3], x[4]

    slope = jax.jacfwd(lambda part: model.moved(numbers, part * change))(0.0)
    np.testing.assert_allclose(slope, change, rtol=1e-12)

    def straight(part):
        second, third, left, right, side = lower(part)
        return jnp.stack([second**2, (third / second) ** 2, left, right, side / second])

    start, middle, end = (straight(x) for x in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(middle, (start + end) / 2, rtol=1e-12)
    # A second moment that would become negative stays positive.
    assert np.all(np.isfinite(model.moved(numbers, -1e6 * jnp.ones(5))))


def test_the_signal_of_a_sensor_does_not_depend_on_the_others(rng):
    """A radian for attitudes and directions, the variation of values for the others."""
    ts, sigma = np.arange(20.0), 0.01
    attitudes = Rotation.random(20, rng=rng).as_quat(scalar_first=True)
    directions = Rotation.from_quat(attitudes, scalar_first=True).apply([1, 0, 0])
    four = rng.normal(size=(20, 4))
    records = (
        identify.Attitudes(ts, attitudes, sigma),
        identify.Directions(ts, directions, sigma, of=np.ones(3)),
        identify.Observed(lambda *_: four[0], ts, four, sigma),
    )
    problem = a_problem(*records)
    signal = signal_of(problem, problem.samples.weight)[0]
    np.testing.assert_allclose(signal[:20], [[100, 100, 100, 0]] * 20)
    np.testing.assert_allclose(signal[20:40], [[100, 100, 0, 0]] * 20)
    np.testing.assert_allclose(signal[40:], (four - four.mean(axis=0)) / sigma)


def test_a_positive_number_that_grew_is_judged_by_its_new_size(rng):
    record = identify.Rates(np.arange(20.0), rng.normal(size=(20, 3)), 0.01)
    unknowns = a_problem(record, free=lambda body: body.torque.coefficient).unknowns
    (drag,) = unknowns.sought
    for value in (1e-5, 0.02):
        x = jnp.log(jnp.expm1(jnp.full(1, value / 1e-5)))
        x = jnp.where(value == 0.02, value / 1e-5, x)
        slope = jax.grad(lambda y: jnp.sum(drag.value(y)))(x)
        relative = float(slope[0]) * float(drag.natural_units(x)[0]) / value
        assert 0.5 < relative < 1.01, value


def test_priors_are_counted_once_or_in_each_trial(rng):
    record = identify.Rates(np.arange(20.0), rng.normal(size=(20, 3)), 0.01)

    def free(body, gyro):
        return (
            identify.prior(gyro.bias, 0.1),
            identify.prior(identify.each(gyro.scale), 0.1),
            body.torque.coefficient,
        )

    assert a_problem(record, free=free).priors(trials=5) == 3 + 5


def test_a_time_that_is_not_finite_beside_a_value_is_refused():
    ts = np.append(np.arange(19.0), np.inf)
    record = identify.Rates(ts, np.ones((20, 3)), 0.01)
    with pytest.raises(RuntimeError, match="finite where there are values"):
        identify.fit(jr.RigidBody(np.ones(3)), record)
