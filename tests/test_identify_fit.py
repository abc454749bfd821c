"""fit(): bodies estimated from noisy records, errors, and what no record tells."""

import functools
import re
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from helpers import quick_jit
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid import identify
from jrigid.identify import Status, _progress

UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])
TURN = Rotation.from_rotvec([0.6, -0.4, 0.9]).as_matrix()
# Moments and the direction of the spin along the principal axes.
BODIES = {
    "asymmetric": ((1.0, 1.7, 2.3), (0.5, 1.0, 0.4)),
    "symmetric": ((1.0, 1.0, 1.6), (0.6, 0.0, 0.8)),
    "nearly symmetric": ((1.0, 1.02, 1.5), (0.6, 0.3, 0.8)),
    "slender rod": ((0.05, 1.0, 1.02), (1.0, 0.3, 0.3)),
    "near separatrix": ((1.0, 1.7, 2.3), (0.02, 1.0, 0.01)),
}
ASYMMETRIC, SYMMETRIC = BODIES["asymmetric"], BODIES["symmetric"]
FLAT = (1.0, 1.7, 2.7), (0.5, 1.0, 0.4)
BLIND = jr.RigidBody(np.ones(3))
TS = np.arange(200) * 0.3  # ten turns, twenty samples each


def turned(moments):
    tensor = TURN @ np.diag(moments) @ TURN.T
    return (tensor + tensor.T) / 2


def rates(body, ts=TS, axes=TURN):
    """Tensor and true rates in the axes of the sensor, one radian a second."""
    moments, direction = body
    omega = axes @ np.array(direction) / np.linalg.norm(direction)
    tensor = axes @ np.diag(moments) @ axes.T
    tensor = (tensor + tensor.T) / 2
    motion = jr.free_rotation(tensor, jr.State(UNTURNED, omega), ts)
    return tensor, np.asarray(motion.omega), np.asarray(motion.attitude)


def elements(tensor):
    """Five independent numbers of a tensor of trace 3."""
    return np.stack(
        [tensor[..., i, j] for i, j in ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2))], -1
    )


def spread_of_elements(result):
    """Covariance of `elements`, of one fit or of many."""

    def one(result):
        slopes = jax.jacfwd(result.unknowns.inertia)(result.numbers)
        slopes = jnp.stack(
            [slopes[i, j] for i, j in ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2))]
        )
        return slopes @ result.numbers_covariance @ slopes.T

    return np.asarray(
        one(result) if result.numbers.ndim == 1 else jax.vmap(one)(result)
    )


@pytest.fixture(scope="module")
def blind_fit():
    """Many bodies from rates alone, side by side."""
    return lambda values, sigma: identify.fit_each(
        BLIND, [identify.Rates(TS, y, sigma) for y in values]
    )


@pytest.mark.parametrize(
    ("noise", "trials"),
    [
        (0.001, 12),
        (0.05, 4),
        pytest.param(0.01, 12, marks=pytest.mark.slow),
        pytest.param(0.05, 12, marks=pytest.mark.slow),
    ],
)
def test_every_body_is_found_blind_at_the_bound(blind_fit, noise, trials, rng):
    tensors, records = [], []
    for body in BODIES.values():
        tensor, omegas, _ = rates(body)
        tensors += [3 * tensor / np.trace(tensor)] * trials
        records.append(omegas + noise * rng.normal(size=(trials, *omegas.shape)))
    found = blind_fit(np.concatenate(records), noise)
    assert bool(jnp.all(found.status == Status.OK)), str(found)
    errors = elements(np.asarray(found.inertia)) - elements(np.stack(tensors))
    spread = spread_of_elements(found)
    normalised = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(spread), errors) / 5
    # Chi-square of 5 degrees of freedom each: of 60 fits 1 +- 0.08.
    scatter = np.sqrt(2 / 5 / len(normalised))
    assert abs(normalised.mean() - 1) < 3.67 * scatter
    per_body = normalised.reshape(len(BODIES), trials).mean(axis=1)
    assert np.all(per_body < 1 + 4 * np.sqrt(2 / 5 / trials)), per_body
    chi_square = np.asarray(found.reduced_chi_square)
    assert np.all(np.abs(chi_square - 1) < 5 * np.sqrt(2 / 592))


def fit_of_rates(ts, values, sigma):
    """Compiled once for 200 samples of about ten turns."""
    return identify.fit(BLIND, identify.Rates(ts, values, sigma), throw=False)


SHORT = TS / 40  # a radian and a half


def short_fit(values):
    """Compiled once, with everything said that a fit can say."""
    return identify.fit(BLIND, identify.Rates(SHORT, values, 1e-4), progress=True)


def test_a_short_record_whose_linear_start_is_flat():
    """At 1e-4: the first attempt ends at a flat body, the second does not."""
    tensor, omegas, _ = rates(ASYMMETRIC, SHORT)
    values = omegas + 1e-4 * np.random.default_rng(5).normal(size=omegas.shape)
    found = short_fit(values)
    assert bool(found.status == Status.OK)
    error = elements(np.asarray(found.inertia)) - elements(
        3 * tensor / np.trace(tensor)
    )
    assert error @ np.linalg.solve(spread_of_elements(found), error) < 21


def test_a_bad_lane_is_marked_and_leaves_the_others_alone(blind_fit, rng):
    _, omegas, _ = rates(ASYMMETRIC)
    records = np.tile(omegas + 0.01 * rng.normal(size=omegas.shape), (60, 1, 1))
    alone = blind_fit(records, 0.01)
    disturbed = records.copy()  # the first call may still be reading
    disturbed[1] = np.nan
    found = blind_fit(disturbed, 0.01)
    assert bool((found.status == Status.BAD_INPUT)[1])
    assert np.all(np.isnan(found.inertia[1]))
    assert "60 fits: 59 OK, 1 BAD_INPUT" in str(found)
    np.testing.assert_array_equal(found.inertia[2:], alone.inertia[2:])


@pytest.fixture(scope="module")
def one_fit():
    rng = np.random.default_rng(4)
    tensor, omegas, _ = rates(ASYMMETRIC)
    readings = identify.Rates(TS, omegas + 0.02 * rng.normal(size=omegas.shape), 0.02)
    found = fit_of_rates(TS, readings.values, 0.02)
    assert bool(found.status == Status.OK)
    return tensor, readings, found


def test_minimum_and_covariance_are_those_of_scipy_in_other_parameters(one_fit):
    """Moments and a rotation vector, Euler's equations, finite differences."""
    _, readings, found = one_fit
    moments, axes = np.linalg.eigh(np.asarray(found.inertia))
    axes = axes * np.sign(np.linalg.det(axes))

    def tensor(x):
        turn = axes @ Rotation.from_rotvec(x[2:5]).as_matrix()
        diagonal = np.append(x[:2], 3 - x[0] - x[1])
        return turn @ np.diag(diagonal) @ turn.T

    def residuals(xs):
        """Of many points at once, rows after points."""
        inertias = np.stack([tensor(x) for x in xs])
        inverse = np.linalg.inv(inertias)

        def rate(t, omega):
            omega = omega.reshape(-1, 3, 1)
            torque = np.cross((inertias @ omega)[..., 0], omega[..., 0])
            return (inverse @ torque[..., None]).ravel()

        motion = solve_ivp(
            rate, (0, TS[-1]), xs[:, 5:].ravel(), "DOP853", TS, rtol=1e-11, atol=1e-12
        )
        return (motion.y.reshape(len(xs), 3, -1).swapaxes(1, 2) - values).reshape(
            len(xs), -1
        ) / 0.02

    def slopes(x):
        up, down = np.split(
            residuals(x + 1e-5 * np.concatenate([np.eye(8), -np.eye(8)])), 2
        )
        return (up - down).T / 2e-5

    values = np.asarray(readings.values)
    start = np.concatenate([moments[:2], np.zeros(3), np.asarray(found.state.omega[0])])
    peer = least_squares(lambda x: residuals(x[None])[0], start, slopes, x_scale="jac")
    errors = np.sqrt(np.diagonal(np.linalg.inv(peer.jac.T @ peer.jac)))
    assert abs(2 * peer.cost - float(found.chi_square)) < 1e-4
    assert np.all(np.abs(peer.x - start) < 0.01 * errors)
    np.testing.assert_allclose(
        errors[:2], np.sqrt(np.diagonal(found.moments_covariance))[:2], rtol=1e-3
    )
    np.testing.assert_allclose(errors[2:5], found.axes_errors, rtol=1e-3)
    np.testing.assert_allclose(
        errors[5:], np.sqrt(np.diagonal(found.covariance))[5:], rtol=1e-3
    )


def test_what_is_printed(one_fit):
    _, _, found = one_fit
    text = str(found)
    assert text.startswith("OK: The fit describes the record")
    for line in (
        "200 samples",
        "I3/I1 = ",
        "trace as declared",
        "not determined by the record: overall",
    ):
        assert line in text
    assert found.names == tuple(f"inertia[{i}]" for i in range(5))
    assert float(jnp.trace(found.inertia)) == pytest.approx(3)
    steps = np.asarray(found.diagnostics.history)[
        np.isfinite(found.diagnostics.history)
    ]
    assert steps[-1] == pytest.approx(float(found.chi_square))
    assert found.system.inertia.shape == (3, 3)


@quick_jit
def rows_and_slope(inertia, state, t0, ts, values):
    """Residuals with an axis of trials in what is given; slope of half their squares."""

    def loss(omega):
        start, readings = (
            jr.State(state.attitude, omega),
            identify.Rates(ts, values, 0.02),
        )
        rows = identify.residuals(jr.RigidBody(inertia), start, readings, t0=t0)
        return jnp.sum(rows**2), rows

    (_, rows), slope = jax.value_and_grad(loss, has_aux=True)(state.omega)
    return rows, slope


def test_residuals_are_those_of_the_motion_and_have_its_derivatives(one_fit):
    _, readings, found = one_fit
    rows, slope = rows_and_slope(
        found.inertia, found.state, found.t0, TS, readings.values
    )
    np.testing.assert_allclose(
        rows, found.diagnostics.residuals.reshape(1, -1), atol=1e-9
    )
    # at the minimum the slope vanishes
    scale = np.linalg.norm(
        np.asarray(found.diagnostics.jacobian)[0].reshape(600, 8), axis=0
    )[5:]
    assert np.all(np.abs(slope[0]) < 0.01 * scale)


@pytest.mark.parametrize(
    "drag", [None, jr.torques.LinearDrag(0.05)], ids=["free", "dragged"]
)
def test_residuals_are_late_by_what_a_gyro_is(drag):
    body = jr.RigidBody(jnp.array([1.0, 1.7, 2.3]), drag)
    start = jr.State(jnp.array([1.0, 0, 0, 0]), jnp.array([0.5, 1.0, 0.3]))
    ts, zero = jnp.linspace(1.0, 5.0, 40), jnp.zeros((40, 3))

    def rows(delay, ts):
        gyro = identify.Gyro(delay=delay)
        return identify.residuals(body, start, identify.Record(gyro, ts, zero, 1.0))

    rows = quick_jit(rows)
    np.testing.assert_allclose(rows(0.02, ts), rows(0.0, ts - 0.02), atol=1e-8)
    assert np.abs(rows(0.02, ts) - rows(0.0, ts)).max() > 1e-3


@quick_jit
def bound(tensor, omega, ts, t0):
    """Of I3/I1 and of both ratios, and its slopes in the rate and in the times."""

    def variance(omega, ts):
        plan, start = identify.Rates(ts, None, 0.02), jr.State(UNTURNED, omega)
        bound = identify.Plan(jr.RigidBody(tensor), start, plan, t0=t0).bound
        covariance = bound.ratios_covariance
        return covariance[1, 1], covariance

    return jax.value_and_grad(variance, argnums=(0, 1), has_aux=True)(omega, ts)


def fitted_and_information(tensor, omega, ts, sigma, t0):
    start, record = jr.State(UNTURNED, omega), identify.Rates(ts, None, sigma)
    plan = identify.Plan(jr.RigidBody(tensor), start, record, t0=t0)
    return plan.predicted, plan.information


def test_a_record_that_starts_late_has_its_state_at_its_own_t0(one_fit):
    """Who takes the state of a fit takes its time too; without it all is 50 s off."""
    _, readings, early = one_fit
    ts = TS + 50
    found = fit_of_rates(ts, readings.values, 0.02)
    np.testing.assert_allclose(found.inertia, early.inertia, rtol=1e-7)
    np.testing.assert_array_equal(found.t0, 50.0)
    assert "rates at t = 50 s" in str(found)
    state0, t0 = found.initial_state()
    np.testing.assert_array_equal(state0.omega, found.state.omega[0])

    motion = jr.free_rotation(found.inertia, state0, ts, t0=t0)
    rows = (np.asarray(motion.omega) - readings.values) / 0.02
    np.testing.assert_allclose(rows, found.diagnostics.residuals[0], atol=1e-9)
    rows, _ = rows_and_slope(found.inertia, found.state, found.t0, ts, readings.values)
    np.testing.assert_allclose(
        rows, found.diagnostics.residuals.reshape(1, -1), atol=1e-9
    )
    # Everywhere the state is that at t0 = 0.0 unless it is said.
    at_zero = jr.free_rotation(found.inertia, state0, np.zeros(200), t0=t0)
    at_zero = jr.State(at_zero.attitude[0], at_zero.omega[0])
    lane = jax.tree.map(lambda x: x[None], at_zero)
    rows, _ = rows_and_slope(found.inertia, lane, np.zeros(1), ts, readings.values)
    np.testing.assert_allclose(
        rows, found.diagnostics.residuals.reshape(1, -1), atol=1e-9
    )
    for state, at in ((state0, t0), (at_zero, np.zeros(()))):
        (_, covariance), _ = bound(found.inertia, state.omega, ts, at)
        np.testing.assert_allclose(covariance, found.ratios_covariance, rtol=1e-3)
        stated = fitted_and_information(found.inertia, state.omega, ts, 0.02, at)[0].t0
        np.testing.assert_array_equal(stated, at)


@pytest.mark.slow  # programs of its own
def test_under_a_torque_a_state_after_the_first_sample_is_refused():
    """The motion under a torque is followed forward only."""
    body = jr.RigidBody(np.array([1.0, 1.7, 2.3]), jr.torques.LinearDrag(0.01))
    state, ts = (
        jr.State(UNTURNED, np.array([0.5, 1.0, 0.3])),
        np.array([1.0, 2.0, 3.0, 4.0]),
    )
    record = identify.Rates(ts, np.ones((4, 3)), 0.01)
    both = eqx.filter_jit(
        lambda t0, t1: (
            identify.residuals(body, state, record, t0=t0),
            identify.Plan(body, state, record, t0=t1).information,
        )
    )
    rows, information = both(np.zeros(()), np.ones(()))
    assert np.all(np.isfinite(rows))
    assert np.all(np.isfinite(information))
    assert np.all(np.isnan(both(np.zeros(()), np.full((), 1.5))[1]))
    with pytest.raises(RuntimeError, match="not earlier than `t0`"):
        both(np.full((), 1.5), np.ones(()))


def test_profile_is_the_parabola_of_the_errors_near_the_minimum(one_fit):
    _, _, found = one_fit
    best, error = float(found.moments[0]), float(found.moments_covariance[0, 0] ** 0.5)
    moves = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    growth = identify.profile(
        found, lambda i: jnp.linalg.eigvalsh(i)[0], best + error * moves
    )
    np.testing.assert_allclose(growth, moves**2, rtol=0.05, atol=1e-3)


@pytest.mark.slow  # a program of its own
def test_the_profile_of_a_clipped_gyro_is_zero_at_the_fit(rng):
    """Saturated readings are in the sum that is minimised, and not in chi-square."""
    _, omegas, _ = rates(ASYMMETRIC)
    values = omegas + 0.01 * rng.normal(size=omegas.shape)
    limit = 0.8 * np.abs(omegas).max()
    gyro = identify.Gyro(limit=limit)
    record = identify.Record(gyro, TS, np.clip(values, -limit, limit), 0.01)
    found = identify.fit(BLIND, record)
    assert np.sum(np.asarray(found.problem.samples.sign) != 0) > 10
    best, error = float(found.moments[0]), float(found.moments_covariance[0, 0] ** 0.5)
    moves = np.array([-1.0, 0.0, 1.0])
    growth = identify.profile(
        found, lambda i: jnp.linalg.eigvalsh(i)[0], best + error * moves
    )
    np.testing.assert_allclose(growth, moves**2, rtol=0.1, atol=1e-3)


def test_bound_of_a_plan_is_the_error_of_the_fit_and_has_its_derivatives(one_fit):
    tensor, _, found = one_fit
    tensor = 3 * tensor / np.trace(tensor)
    omega = TURN @ np.array(ASYMMETRIC[1]) / np.linalg.norm(ASYMMETRIC[1])

    def variance(omega, ts):
        return float(bound(tensor, omega, ts, np.zeros(()))[0][0])

    (least, _), (slope_omega, slope_ts) = bound(tensor, omega, TS, np.zeros(()))
    assert float(least) == pytest.approx(float(found.ratios_covariance[1, 1]), rel=0.1)
    fitted, information = fitted_and_information(tensor, omega, TS, 0.02, np.zeros(()))
    assert bool(fitted.status == Status.OK)
    np.testing.assert_allclose(fitted.ratios_covariance[1, 1], least, rtol=1e-4)
    inverse = np.linalg.inv(np.asarray(information))
    np.testing.assert_allclose(inverse, fitted.covariance, rtol=1e-6, atol=1e-12)
    for k in range(3):
        h = 1e-5 * np.eye(3)[k]
        difference = (variance(omega + h, TS) - variance(omega - h, TS)) / 2e-5
        np.testing.assert_allclose(slope_omega[k], difference, rtol=1e-4)
    later = 1e-5 * (np.arange(200) == 150)
    difference = (variance(omega, TS + later) - variance(omega, TS - later)) / 2e-5
    np.testing.assert_allclose(slope_ts[150], difference, rtol=1e-4, atol=1e-12)


# What data can tell: the list of what is and is not determined


def picked(gyro, name, sigma):
    array = getattr(gyro, name)
    return array if sigma is None else identify.prior(array, sigma)


@functools.cache
def program(name=None, prior=None, factors=None):
    """Compiled once for each error of the gyro that is sought."""
    if name is None:
        return lambda tensor, omega: fitted_and_information(
            tensor, omega, TS, 0.01, np.zeros(())
        )[0]
    gyro = identify.Gyro(scale=np.ones(factors) if factors else 1.0)
    free = lambda _, gyro: picked(gyro, name, prior)  # noqa: E731
    record = identify.Record(gyro, TS, None, 0.01)
    return lambda tensor, omega: (
        identify.Plan(
            jr.RigidBody(tensor), jr.State(UNTURNED, omega), record, free=free
        ).predicted
    )


def planned(body, name=None, prior=None, factors=None, axes=TURN):
    moments, direction = body
    tensor = axes @ np.diag(moments) @ axes.T
    omega = axes @ np.array(direction) / np.linalg.norm(direction)
    return program(name, prior, factors)((tensor + tensor.T) / 2, omega)


def test_free_motion_tells_everything_but_the_scale():
    found = planned(ASYMMETRIC)
    assert found.null_directions == ("overall scale",)
    assert bool(found.status == Status.OK)
    plan = identify.Attitudes(TS, None, 0.01)
    omega = TURN @ np.array([0.5, 1.0, 0.4])
    body = jr.RigidBody(turned(ASYMMETRIC[0]))
    found = identify.Plan(body, jr.State(UNTURNED, omega), plan).predicted
    assert found.null_directions == ("overall scale",)


def test_many_fits_name_their_numbers_once_and_other_methods_ask_for_one_fit():
    one = planned(ASYMMETRIC, "bias")
    both = jax.tree.map(lambda x: jnp.stack([x, x]), one)
    assert both.names == one.names
    assert one.names[5:] == ("gyro.bias[0]", "gyro.bias[1]", "gyro.bias[2]")
    asked = [
        lambda: both.system,
        lambda: both.estimates,
        lambda: both.determined,
        lambda: both.null_directions,
        lambda: both.ratios_intervals,
        lambda: both.predict(1.0),
        both.residuals,
        both.observations,
        both.linearization,
        lambda: both.spread(jnp.trace),
        lambda: identify.profile(both, jnp.trace, jnp.ones(1)),
        lambda: identify.compare({"both": both}),
    ]
    for ask in asked:
        with pytest.raises(ValueError, match=r"of a single fit here, .* \(2,\) fits"):
            ask()


def test_trials_records_levels_and_functions_that_are_none_are_refused(untyped):
    """JAX would read the last trial in the place of one that there is not."""
    one = planned(ASYMMETRIC, "bias")
    for ask in (one.fitted, one.initial_state):
        for index in (1, -1):
            with pytest.raises(ValueError, match="`index` must be at least 0"):
                ask(index)
    with pytest.raises(ValueError, match="`trial` must be at least 0 and below 1"):
        one.linearization(0, 1)
    for ask in (one.linearization, one.residuals, one.observations):
        with pytest.raises(ValueError, match="`record` must be at least 0 and below 1"):
            ask(1)
    for level in (0.0, 1.0, 95, np.nan):
        with pytest.raises(ValueError, match="`level` must be above 0 and below 1"):
            one.interval(jnp.trace, level)
    with pytest.raises(ValueError, match=r"of 0 axes, but it returns one of shape"):
        one.interval(jnp.diag)
    with pytest.raises(ValueError, match=r"of 1 axes, but it returns one of shape"):
        one.spread(jnp.trace)


@pytest.mark.parametrize("scale", ["known", "rotor"])
def test_the_scale_of_a_free_body_is_refused(scale):
    with pytest.raises(ValueError, match="scale"):
        identify.fit(BLIND, identify.Rates(TS, np.ones((200, 3)), 0.01), scale=scale)


@pytest.mark.parametrize(
    "body", [((1, 1.7, 2.3), (0, 0, 1)), ((1, 1, 1), (0.5, 1, 0.4))]
)
def test_pure_spin_and_a_sphere_do_not_tell_ratios(body, rng):
    words = planned(body).null_directions
    assert "spin is pure: ratios not determined" in words
    _, omegas, _ = rates(body)
    for _ in range(5):
        values = omegas + 0.01 * rng.normal(size=omegas.shape)
        found = fit_of_rates(TS, values, 0.01)
        assert bool(found.status == Status.UNIDENTIFIABLE), str(found)
    assert "spin is pure: ratios not determined" in found.null_directions
    assert "ratios   not determined" in str(found)
    # Nothing is said of bodies whose ratios are not determined.
    assert "equal within" not in str(found)
    assert "reversed" not in str(found)
    assert np.all(np.isnan(found.ratios_intervals))


def test_bias_of_the_gyro():
    found = planned(ASYMMETRIC, "bias")
    assert found.null_directions == ("overall scale",)
    found = planned(SYMMETRIC, "bias")
    assert bool(found.status == Status.UNIDENTIFIABLE)
    (text,) = found.null_directions[1:]
    assert "I3/I1" in text
    assert "gyro bias along the axis of I3" in text


def test_one_scale_factor_of_the_gyro():
    assert planned(ASYMMETRIC, "scale").null_directions == ("overall scale",)
    (text,) = planned(SYMMETRIC, "scale").null_directions[1:]
    assert "gyro scale" in text
    assert "I3/I1" in text


@pytest.mark.slow  # two programs of their own
def test_three_scale_factors_or_a_whole_matrix_of_the_gyro():
    """Three factors along principal axes change (I2 - I3)/I1 and cyclic ones at will."""
    words = planned(ASYMMETRIC, "scale", factors=3, axes=np.eye(3)).null_directions
    assert len(words) > 1
    assert all("gyro scale" in text for text in words[1:])
    words = planned(ASYMMETRIC, "matrix").null_directions
    assert len(words) > 1
    assert all("gyro matrix" in text for text in words[1:])


def test_bias_and_scale_inflate_the_bound_as_measured_before():
    """Factors of 1.6 and 2.7 (asymmetric) to 60 and 160 for I = (1, 1.02, 1.5)."""
    for body, least in ((ASYMMETRIC, 1.2), (BODIES["nearly symmetric"], 10.0)):
        plain, bias, factor = (
            float(planned(body, n).ratios_errors[1]) for n in (None, "bias", "scale")
        )
        assert bias > least * plain
        assert factor > least * plain
    # What is known beforehand of the bias helps
    known = planned(BODIES["nearly symmetric"], "bias", 1e-4)
    assert float(known.ratios_errors[1]) < 3 * plain


def test_a_gyro_of_unknown_handedness_fits_two_bodies():
    _, omegas, _ = rates(ASYMMETRIC)
    found = planned(ASYMMETRIC)
    assert (
        "with one axis of the gyro reversed the same record is that of a body"
        in str(found)
    )
    # One axis reversed: the mirror body, physical, moves so.
    axes = np.asarray(found.axes)
    mirror = axes @ np.diag(np.asarray(found.mirror_moments)) @ axes.T
    reversed_ = omegas @ axes * np.array([-1, 1, 1]) @ axes.T
    motion = jr.free_rotation(
        (mirror + mirror.T) / 2, jr.State(UNTURNED, reversed_[0]), TS
    )
    np.testing.assert_allclose(motion.omega, reversed_, atol=1e-10)
    moments = np.sort(np.asarray(found.mirror_moments))
    assert moments[2] < moments[0] + moments[1]


@pytest.mark.slow  # a program of its own
def test_a_sleeping_top_tells_nothing_and_a_nutating_one_its_ratios():
    top = jr.SymmetricTop(1.0, 0.6, 2.0).as_rigid_body()
    plan = identify.Rates(np.arange(300) * 0.05, None, 0.01)
    options = {"inertia_model": identify.Top(), "free": lambda body: body.torque.mass}

    told_of = lambda state: identify.Plan(top, state, plan, **options).predicted  # noqa: E731

    def words(tilt):
        return told_of(
            jr.top.initial_state(jr.SymmetricTop(1.0, 0.6, 2.0), tilt, omega3=6.0)
        )

    assert words(0.5).null_directions[1:] == ("heading about the vertical",)
    sleeping = words(0.0)
    assert bool(sleeping.status == Status.UNIDENTIFIABLE)
    assert "spin is pure: ratios not determined" in sleeping.null_directions


# Records of other kinds


def test_gaps_missing_samples_and_single_components(rng):
    ts = np.arange(260) * 0.23
    keep = np.ones(260, bool)
    keep[70:130] = False  # a gap of two turns
    ts = ts[keep]  # as many as elsewhere, so that no other program is compiled
    tensor, omegas, _ = rates(ASYMMETRIC, ts)
    values = omegas + 0.01 * rng.normal(size=omegas.shape)
    values[rng.random(len(ts)) < 0.05] = np.nan
    values[50:60, 1] = np.nan  # one axis out
    found = fit_of_rates(ts, values, 0.01)
    assert bool(found.status == Status.OK)
    error = elements(np.asarray(found.inertia)) - elements(
        3 * tensor / np.trace(tensor)
    )
    spread = spread_of_elements(found)
    assert error @ np.linalg.solve(spread, error) < 21  # chi-square of 5, 0.1 %
    assert int(found.degrees_of_freedom) == int(np.isfinite(values).sum()) - 8


def test_attitudes_rates_directions_and_momenta_together(rng):
    """All kinds at once, with times of their own, one with a covariance.

    The momentum sets the scale.

    No attitude is seen in two turns of the six: dead reckoning carries them over the
        gap.
    """
    ts = np.arange(120) * 0.3
    later = ts[:60] + 0.11
    tensor, omegas, attitudes = rates(ASYMMETRIC, ts)
    _, _, attitudes_later = rates(ASYMMETRIC, later)
    star = np.array([0.6, 0.0, 0.8])
    seen = Rotation.from_quat(np.roll(attitudes_later, -1, axis=1)).inv().apply(star)
    tilt = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 1.5]]) * 1e-4
    noise = rng.multivariate_normal(np.zeros(3), tilt, size=120)
    turned_ = Rotation.from_quat(np.roll(attitudes, -1, axis=1)) * Rotation.from_rotvec(
        noise
    )
    looks = np.roll(turned_.as_quat(), 1, axis=1)
    looks[40:80] = np.nan
    across = seen + 0.01 * rng.normal(size=seen.shape)
    momentum = tensor @ omegas[0]
    observations = (
        identify.Rates(
            ts, omegas + 0.02 * rng.normal(size=omegas.shape), np.full(3, 0.02)
        ),
        identify.Attitudes(ts, looks, covariance=tilt),
        identify.Directions(
            later, across / np.linalg.norm(across, axis=1, keepdims=True), 0.01, of=star
        ),
        identify.AngularMomenta(
            ts[:3], momentum + 0.01 * rng.normal(size=(3, 3)), 0.01
        ),
    )
    found = identify.fit(BLIND, observations, scale="known")
    assert bool(found.status == Status.OK)
    assert found.null_directions == ()
    np.testing.assert_allclose(found.inertia, tensor, rtol=0, atol=0.05)
    spread = np.sqrt(np.diagonal(found.moments_covariance))
    assert np.all(
        np.abs(np.asarray(found.moments) - np.array(ASYMMETRIC[0])) < 4 * spread
    )
    assert abs(float(found.reduced_chi_square) - 1) < 5 * np.sqrt(2 / 800)


@pytest.mark.slow  # a program of its own
def test_attitudes_alone_with_noise_that_is_not_known(rng):
    ts = np.arange(100) * 0.4
    tensor, _, attitudes = rates(ASYMMETRIC, ts)
    noisy = Rotation.from_quat(np.roll(attitudes, -1, axis=1)) * Rotation.from_rotvec(
        0.03 * rng.normal(size=(100, 3))
    )
    sign = rng.choice([-1.0, 1.0], size=(100, 1))  # either sign of a quaternion
    values = sign * np.roll(noisy.as_quat(), 1, axis=1)
    found = identify.fit(
        BLIND, identify.Attitudes(ts, values, 1.0), absolute_sigma=False
    )
    error = elements(np.asarray(found.inertia)) - elements(
        3 * tensor / np.trace(tensor)
    )
    assert error @ np.linalg.solve(spread_of_elements(found), error) < 21
    assert float(found.reduced_chi_square) ** 0.5 == pytest.approx(0.03, rel=0.15)
    assert "noise taken from the residuals" in str(found)


@pytest.mark.parametrize(
    ("shape", "body", "size"),
    [
        pytest.param(identify.Symmetric(), SYMMETRIC, 3, marks=pytest.mark.slow),
        pytest.param(
            identify.Flat(),
            ((1.0, 1.7, 2.7), (0.5, 1.0, 0.4)),
            4,
            marks=pytest.mark.slow,
        ),
        pytest.param(identify.Moments(), ASYMMETRIC, 2, marks=pytest.mark.slow),
    ],
)
def test_what_is_known_of_the_tensor_holds(shape, body, size, rng):
    axes = np.eye(3) if isinstance(shape, identify.Moments) else TURN
    tensor, omegas, _ = rates(body, axes=axes)
    readings = identify.Rates(TS, omegas + 0.01 * rng.normal(size=omegas.shape), 0.01)
    found = identify.fit(BLIND, readings, inertia_model=shape)
    assert found.numbers.size == size
    np.testing.assert_allclose(found.inertia, 3 * tensor / np.trace(tensor), atol=0.02)
    moments = np.asarray(found.moments)
    if isinstance(shape, identify.Symmetric):
        assert moments[1] == pytest.approx(moments[0], rel=1e-12)
    if isinstance(shape, identify.Flat):
        assert moments[2] == pytest.approx(moments[0] + moments[1], rel=1e-12)
    if isinstance(shape, identify.Moments):
        off = np.asarray(found.inertia) - np.diag(np.diagonal(found.inertia))
        assert np.abs(off).max() < 1e-14
    true = np.sort(body[0]) / np.min(body[0])
    errors = np.maximum(np.asarray(found.ratios_errors), 1e-9)
    assert np.all(np.abs(np.asarray(found.ratios) - true[1:]) < 4 * errors)


@pytest.mark.slow  # notebooks/toutatis.ipynb makes the same fit
def test_toutatis():
    record = jr.datasets.toutatis_1992()
    apparition = slice(0, 17)  # free motion
    times = record.times[apparition]
    degree = np.pi / 180
    found = identify.fit(
        BLIND,
        (
            identify.Attitudes(times, record.attitudes[apparition], 6 * degree),
            identify.Rates(times, record.omegas[apparition], 6 * degree / 86400),
        ),
        inertia_model=identify.Moments(),
        loss="robust",
    )
    # An independent refit of the same record: 3.19 +- 0.19 and 3.15 +- 0.17
    assert found.numbers.size == 2
    off = np.asarray(found.inertia) - np.diag(np.diagonal(found.inertia))
    assert np.abs(off).max() < 1e-14
    moments = np.diagonal(found.inertia) / found.inertia[2, 2]
    assert abs(moments[0] - 3.19) < 0.19
    assert abs(moments[1] - 3.15) < 0.17
    assert np.all(np.asarray(found.ratios_errors) > 0.03)
    assert np.all(np.asarray(found.ratios_errors) < 0.25)
    text = str(found)
    assert "weakly constrained" in text
    assert "I2 and I3 are equal within their errors" in text
    # The two spins that are off by 45 degrees a day
    spins = found.problem.samples.parts[1]
    assert list(np.flatnonzero(~np.asarray(found.kept)[0, spins])) == [5, 12]


# Torques


def steps_of_one_s_own(system, state, ts, t0):
    """Runge and Kutta's steps, two from sample to sample: a `motion` quickly compiled."""

    def rate(t, y):
        slope = system.vector_field(t, jr.State(*y), None)
        return slope.attitude, slope.omega

    def moved(y, h, k):
        return jax.tree.map(lambda a, b: a + h * b, y, k)

    def step(y, span):
        for half in range(2):
            h = (span[1] - span[0]) / 2
            t = span[0] + half * h
            k1 = rate(t, y)
            k2 = rate(t + h / 2, moved(y, h / 2, k1))
            k3 = rate(t + h / 2, moved(y, h / 2, k2))
            k4 = rate(t + h, moved(y, h, k3))
            y = jax.tree.map(
                lambda y, a, b, c, d, h=h: y + h / 6 * (a + 2 * b + 2 * c + d),
                y,
                k1,
                k2,
                k3,
                k4,
            )
        return y, y

    spans = jnp.stack([jnp.append(t0, ts[:-1]), ts], axis=1)
    _, (attitude, omega) = jax.lax.scan(step, (state.attitude, state.omega), spans)
    return jr.State(attitude, omega)


WHEEL = jr.torques.Rotor(
    lambda t: jnp.stack([0.1 + 0 * t, 0.2 * jnp.sin(0.7 * t), 0.3 + 0 * t])
)


def test_a_rotor_of_known_momentum_tells_the_scale():
    plan, start = (
        identify.Rates(TS / 2, None, 0.01),
        jr.State(UNTURNED, np.array([0.5, 1.0, 0.4])),
    )
    for tensor in (turned(ASYMMETRIC[0]), 1.3 * np.eye(3)):
        body = jr.RigidBody(tensor, WHEEL)
        found = identify.Plan(body, start, plan, scale="rotor").predicted
        assert bool(found.status == Status.OK)
        assert found.null_directions == ()
        np.testing.assert_allclose(found.inertia, tensor, atol=1e-6)


@pytest.mark.slow  # shooting under a torque: the heavy top below is quicker
def test_absolute_tensor_beside_a_rotor_of_known_momentum(rng):
    wheel = WHEEL
    ts = np.arange(200) * 0.15
    sphere = 1.3 * np.eye(3)
    for tensor in (turned(ASYMMETRIC[0]), sphere):
        body = jr.RigidBody(tensor, wheel)
        motion = jr.simulate(body, jr.State(UNTURNED, np.array([0.5, 1.0, 0.4])), ts)
        values = np.asarray(motion.states.omega) + 0.01 * rng.normal(size=(200, 3))
        found = identify.fit(
            jr.RigidBody(np.ones(3), wheel),
            identify.Rates(ts, values, 0.01),
            scale="rotor",
        )
        assert bool(found.status == Status.OK)
        assert found.null_directions == ()
        error = elements(np.asarray(found.inertia)) - elements(tensor)
        assert error @ np.linalg.solve(spread_of_elements(found), error) < 21
        np.testing.assert_allclose(found.moments, np.linalg.eigvalsh(tensor), rtol=0.03)


def test_heavy_top_from_its_gyro_alone(rng):
    """I3/I1 and mgl/I1, from a start that is wrong by half in both."""
    top = jr.SymmetricTop(1.0, 0.6, 2.0)
    ts = np.arange(300) * 0.05
    motion = jr.top_motion(top, jr.top.initial_state(top, 0.6, omega3=5.0), ts)
    values = np.asarray(motion.omega) + 0.02 * rng.normal(size=(300, 3))
    guess = jr.SymmetricTop(1.0, 1.0, 1.0).as_rigid_body()
    found = identify.fit(
        guess,
        identify.Rates(ts, values, 0.02),
        inertia_model=identify.Top(),
        free=lambda body: body.torque.mass,
        start=jr.State(jr.rotation.exp(jnp.array([0.4, 0.0, 0.0])), np.zeros(3)),
    )
    assert bool(found.status == Status.OK)
    assert found.null_directions == (
        "overall scale, which what is sought of the torque follows",
        "heading about the vertical",
    )
    transverse, _, axial = np.diagonal(found.inertia)
    assert axial / transverse == pytest.approx(0.6, abs=4 * 0.0005)
    ((value, error),) = found.estimates.values()
    one = float(guess.torque.mass)
    assert float(value) / one / transverse == pytest.approx(
        2.0, abs=4 * float(error) / one
    )


def test_ten_numbers_of_a_body_about_its_pivot_of_which_two_are_known(rng):
    """A gyro on a swinging body tells inertia over weight.

    Mass and one length must be known.
    """
    turn = jr.rotation.exp(np.array([0.3, -0.2, 0.5]))
    box = jr.solids.box(2.0, np.array([0.2, 0.3, 0.5])).rotated(turn)
    arm = box.translated(np.array([0.05, -0.02, 0.4]))
    gravity = np.array([0.0, 0.0, -9.8])
    weight = jr.torques.UniformGravity(arm.mass, arm.center_of_mass, gravity)
    body = jr.RigidBody(arm.about(np.zeros(3)), weight)
    ts = np.arange(200) * 0.05
    state = jr.State(
        jr.rotation.exp(jnp.array([2.5, 0.2, 0.0])), np.array([0.5, -1.0, 4.0])
    )
    own = {"motion": steps_of_one_s_own}
    moved = quick_jit(lambda: steps_of_one_s_own(body, state, ts, ts[0]).omega)
    values = np.asarray(moved()) + 0.005 * rng.normal(size=(200, 3))
    true = np.asarray(identify.log_cholesky_from_body(arm))
    wrong = true + np.array([0, 0.1, -0.1, 0.1, 0.02, -0.02, 0.02, 0.02, 0.01, 0])
    start = identify.body_from_log_cholesky(wrong)
    ten = identify.LogCholesky(start, frozen=("alpha", "t3"))
    readings, known = (
        identify.Rates(ts, values, 0.005),
        {"scale": "known", "start": state},
    )
    found = identify.fit(body, readings, inertia_model=ten, **known, **own)
    assert bool(found.status == Status.OK)
    assert found.names == ("d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2")
    error = np.asarray(found.numbers) - true[1:9]
    assert error @ np.linalg.solve(found.covariance[:8, :8], error) < 26
    assert np.asarray(found.errors).max() < 0.05
    np.testing.assert_allclose(found.body.mass, arm.mass, rtol=1e-12)
    np.testing.assert_allclose(found.body.center_of_mass, arm.center_of_mass, atol=0.01)
    np.testing.assert_allclose(found.inertia, found.body.about(np.zeros(3)), rtol=1e-12)
    weighed = found.system.torque
    np.testing.assert_allclose(weighed.lever, found.body.center_of_mass, rtol=1e-12)
    density = identify.log_density(
        found
    )  # flat in the numbers: ten do not make a tensor of six
    expected = -0.5 * float(found.chi_square) / float(found.diagnostics.inflation)
    np.testing.assert_allclose(
        quick_jit(density.function)(density.start), expected, rtol=1e-6
    )
    with pytest.raises(ValueError, match="scale"):
        identify.fit(body, readings, inertia_model=ten, start=state)
    with pytest.raises(ValueError, match="frozen"):
        identify.LogCholesky(arm, frozen="mass")


@pytest.mark.slow  # a minute of compiling
def test_ten_numbers_are_two_too_many():
    """The mass, and the scale of the inertia and the weight's moment, are not determined."""
    arm = jr.solids.box(2.0, np.array([0.2, 0.3, 0.5])).translated(
        np.array([0.05, -0.02, 0.4])
    )
    gravity = np.array([0.0, 0.0, -9.8])
    weight = jr.torques.UniformGravity(arm.mass, arm.center_of_mass, gravity)
    body = jr.RigidBody(arm.about(np.zeros(3)), weight)
    state = jr.State(
        jr.rotation.exp(jnp.array([2.5, 0.2, 0.0])), np.array([0.5, -1.0, 4.0])
    )
    plan, ten = (
        identify.Rates(np.arange(100) * 0.05, None, 0.005),
        identify.LogCholesky(arm),
    )
    found = identify.Plan(body, state, plan, inertia_model=ten, scale="known").predicted
    nulls = [text for text in found.null_directions if "heading" not in text]
    assert len(nulls) == 2
    assert "alpha" in " ".join(nulls)
    with pytest.raises(ValueError, match="LogCholesky"):
        _ = identify.Plan(body, state, plan).predicted.body


def test_degrees_for_radians_are_suspected_where_the_body_seems_a_sphere(rng):
    """Where it is seen so often that it seems to turn little between samples."""
    degrees = 180 / np.pi
    _, omegas, _ = rates(ASYMMETRIC, SHORT)
    values = omegas + 1e-4 * rng.normal(size=omegas.shape)
    found = fit_of_rates(SHORT, values * degrees, 1e-4 * degrees)
    assert bool(found.status == Status.MISFIT)
    assert "degrees a second" in str(found)
    found = short_fit(values)
    assert bool(found.status == Status.OK)
    assert "degrees a second" not in str(found)


def trials_of_a_phone(rng, count, drags):
    """Rates at 100 Hz of trials of 0.5 to 1.5 s; bad samples, bad trials."""
    box = jr.solids.box(0.17, np.array([0.0715, 0.147, 0.0078]))
    moments = np.asarray(jnp.diagonal(box.inertia))
    turn = Rotation.from_rotvec(np.radians([1.5, -1.0, 0.8])).as_matrix()
    tensor = turn @ np.diag(moments) @ turn.T
    drag = np.array([0.010, 0.012, 0.015]) * moments
    tensor = (tensor + tensor.T) / 2
    ts = np.arange(151) * 0.01
    spin = rng.normal(size=(count, 3))
    spin *= rng.uniform(8, 16, (count, 1)) / np.linalg.norm(spin, axis=1, keepdims=True)
    if drags:
        phone = jr.RigidBody(tensor, jr.torques.QuadraticDrag(drag))
        motion = jax.jit(
            jax.vmap(
                lambda w: jr.simulate(phone, jr.State(UNTURNED, w), ts).states.omega
            )
        )
    else:
        motion = jax.jit(
            jax.vmap(
                lambda w: jr.free_rotation(tensor, jr.State(UNTURNED, w), ts).omega
            )
        )
    values = np.asarray(motion(spin)) + 0.02 * rng.normal(size=(count, 151, 3))
    touched = rng.random((count, 151)) < 0.02
    values[touched] += 2 * rng.normal(size=(touched.sum(), 3))
    disturbed = np.sort(rng.choice(count, max(1, count // 20), replace=False))
    values[disturbed] += np.cumsum(
        0.15 * rng.normal(size=(disturbed.size, 151, 3)), axis=1
    )
    lengths = rng.integers(50, 152, count)
    trials = [
        identify.Rates(ts[:n], y[:n], 0.02)
        for n, y in zip(lengths, values, strict=True)
    ]
    torque = jr.torques.QuadraticDrag(0.005 * moments) if drags else None
    start = jr.RigidBody(np.full(3, moments.mean()), torque)
    return moments, drag, disturbed, trials, start


def check_phone(rng, count, drags):
    moments, drag, disturbed, trials, start = trials_of_a_phone(rng, count, drags)
    free = (lambda body: body.torque.coefficient) if drags else None
    found = identify.fit(start, trials, loss="robust", free=free)
    assert bool(found.status == Status.OK)
    assert list(np.flatnonzero(np.asarray(found.rejected_trials))) == list(disturbed)
    assert "trials left out: " + ", ".join(str(i) for i in disturbed) in str(found)
    true = np.sort(moments)[1:] / moments.min()
    errors = np.asarray(found.ratios_errors)
    assert np.all(np.abs(np.asarray(found.ratios) - true) < 4 * errors)
    assert np.all(errors < 0.01)
    if drags:
        for value, error, c in zip(
            *found.estimates["torque.coefficient"], drag, strict=True
        ):
            assert abs(value - c) < 4 * error


def test_a_few_trials_of_a_phone(rng):
    """In vacuum, where it is soon compiled."""
    check_phone(rng, 8, drags=False)


@pytest.mark.slow
def test_117_trials_of_a_phone(rng):
    check_phone(rng, 117, drags=True)


@pytest.mark.slow  # a program of its own
def test_motion_of_one_s_own_and_a_function_of_the_state(rng):
    """A damped pointer seen through one angle: doubling horizons from a bad start."""
    ts = np.linspace(0.0, 12.0, 120)
    body = jr.RigidBody(np.array([1.0, 1.0, 1.5]), jr.torques.LinearDrag(0.1))
    start = jr.State(UNTURNED, np.array([0.3, 0.0, 2.0]))
    motion = quick_jit(lambda: steps_of_one_s_own(body, start, ts, ts[0]))()
    values = np.asarray(motion.omega)[:, :1] + 0.003 * rng.normal(size=(120, 1))

    def across(t, state, system):
        return state.omega[:1]

    guess = jr.RigidBody(np.array([1.0, 1.0, 1.3]), jr.torques.LinearDrag(0.05))
    observations = (
        identify.Observed(across, ts, values, 0.003, depends_on_attitude=False),
        identify.Observed(
            spin_of, ts[:1], np.array([[2.0]]), 1e-3, depends_on_attitude=False
        ),
    )
    found = identify.fit(
        guess,
        observations,
        inertia_model=identify.Top(),
        free=lambda b: b.torque.coefficient,
        start=jr.State(UNTURNED, np.array([0.25, 0.05, 2.0])),
        doublings=3,
        motion=steps_of_one_s_own,
    )
    ratio, error = float(found.ratios[1]), float(found.ratios_errors[1])
    assert abs(ratio - 1.5) < 4 * error < 0.1


def spin_of(t, state, system):
    return state.omega[2:]


# Bad input


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"values": np.full((200, 3), np.nan)}, "all are NaN"),
        ({"ts": TS[::-1]}, "increasing"),
        ({"ts": np.where(np.arange(200) == 7, TS[6], TS)}, "increasing"),
        (
            {"ts": np.where(np.arange(200) == 7, np.nan, TS)},
            "finite where there are values",
        ),
        ({"sigma": 0.0}, "positive"),
        ({"scale": 180 / np.pi * 3}, "degrees"),
    ],
)
def test_bad_values_are_errors(change, message):
    _, omegas, _ = rates(ASYMMETRIC)
    values = change.get("values", omegas * change.get("scale", 1.0))
    readings = identify.Rates(change.get("ts", TS), values, change.get("sigma", 0.01))
    with pytest.raises(RuntimeError, match=message) as caught:
        identify.fit(BLIND, readings)
    assert len(str(caught.value)) < 200  # a sentence, without boilerplate


def test_too_few_samples_and_wrong_options(untyped):
    ts, values = np.arange(3.0), np.ones((3, 3))
    with pytest.raises(RuntimeError, match="too few"):
        identify.fit(BLIND, identify.Rates(ts, values, 0.01))
    readings = identify.Rates(TS, np.ones((200, 3)), 0.01)
    for options, message in (
        ({"inertia_model": "cube"}, "inertia_model"),
        ({"scale": "mass"}, "scale"),
        ({"unmodelled": "some"}, "unmodelled"),
        ({"unmodelled": -1.0}, "unmodelled"),
        ({"unmodelled": [1.0, 0.0, 1.0]}, "unmodelled"),
        ({"loss": "huber"}, "loss"),
        ({"start": 3.0}, "start"),
        ({"free": lambda body: body.torque}, "free"),
        ({"free": lambda _: 0}, "free"),
    ):
        with pytest.raises(ValueError, match=message):
            identify.fit(BLIND, readings, **options)
    with pytest.raises(ValueError, match="system"):
        identify.fit(jr.SymmetricTop(1.0, 1.0, 1.0), readings)
    with pytest.raises(ValueError, match="observations"):
        identify.fit(BLIND, np.ones((200, 3)))
    with pytest.raises(ValueError, match="observations"):
        identify.fit(BLIND, [])
    with pytest.raises(ValueError, match="shapes"):
        identify.Rates(TS, np.ones((199, 3)), 0.01)
    with pytest.raises(ValueError, match="sigma"):
        identify.Rates(TS, np.ones((200, 3)), np.ones(7))
    star = identify.Directions(TS, np.ones((200, 3)), 0.01, of=np.ones(3))
    momenta = identify.Record(identify.MomentumSensor(), TS, np.ones((200, 3)), 0.01)
    with pytest.raises(ValueError, match="attitude"):
        identify.fit(BLIND, (readings, momenta))
    with pytest.raises(ValueError, match="start"):
        identify.fit(BLIND, star)


@pytest.mark.parametrize("trials", [4, pytest.param(12, marks=pytest.mark.slow)])
def test_a_model_or_a_noise_that_is_wrong_is_said_to_be(blind_fit, trials, rng):
    _, omegas, _ = rates(ASYMMETRIC)
    records = omegas + 0.05 * rng.normal(size=(trials, *omegas.shape))
    found = blind_fit(records, 0.01)  # five times the noise that is stated
    assert bool(jnp.all(found.status == Status.MISFIT))
    honest = blind_fit(records, 0.05)
    np.testing.assert_allclose(found.ratios_errors, honest.ratios_errors, rtol=0.15)
    _, omegas, _ = rates(ASYMMETRIC, SHORT)
    found = short_fit(omegas + 5e-4 * rng.normal(size=omegas.shape))
    assert bool(found.status == Status.MISFIT)
    assert re.search(r"residuals are [45](\.\d)? times the stated noise", str(found))


def test_larger_residuals_do_not_loosen_what_was_known_beforehand(rng):
    """Of a symmetric body the rates alone tell no ratio beside an unknown scale."""
    motion = jr.free_rotation(
        jnp.array([1.0, 1.0, 1.6]), jr.State(UNTURNED, jnp.array([1.0, 0.5, 2.0])), TS
    )
    omegas = np.asarray(motion.omega) + 0.01 * rng.normal(size=(TS.size, 3))

    def found(sigma):
        return identify.fit(
            BLIND,
            identify.Rates(TS, omegas, sigma),
            free=lambda _, gyro: identify.prior(gyro.scale, 0.01),
            inertia_model=identify.Top(),
            throw=False,
        )

    right = found(0.01)
    wrong = found(0.002)
    assert bool(wrong.status == Status.MISFIT)
    np.testing.assert_allclose(right.estimates["gyro.scale"][1], 0.01, rtol=0.01)
    np.testing.assert_allclose(wrong.estimates["gyro.scale"][1], 0.01, rtol=0.01)
    np.testing.assert_allclose(wrong.ratios_errors, right.ratios_errors, rtol=0.1)
    # That advice would be refused, see the next test.
    assert "`sigma` is too small" in str(wrong)
    assert "absolute_sigma" not in str(wrong)


def test_what_cannot_be_weighed_is_refused():
    _, omegas, _ = rates(ASYMMETRIC)
    relative = {"absolute_sigma": False}
    readings = identify.Rates(TS, omegas, 0.01)
    free = lambda _, gyro: identify.prior(gyro.scale, 0.02)  # noqa: E731
    with pytest.raises(ValueError, match="known beforehand"):
        identify.fit(BLIND, readings, free=free, **relative)
    turns = np.broadcast_to(UNTURNED, (200, 4))
    with pytest.raises(ValueError, match="each kind"):
        identify.fit(BLIND, (readings, identify.Attitudes(TS, turns)))
    with pytest.raises(ValueError, match="noise"):
        identify.Plan(BLIND, jr.State(UNTURNED, np.ones(3)), identify.Rates(TS, None))
    with pytest.raises(ValueError, match="free"):
        identify.fit(BLIND, readings, free=lambda body: body.inertia)
    stars = [identify.Directions(TS, omegas, 0.01, of=of) for of in np.eye(3)[:2]]
    with pytest.raises(ValueError, match="of"):
        identify.fit(BLIND, stars)


@pytest.mark.slow  # a program of its own
def test_a_gyro_and_a_star_tracker_that_looks_seldom(rng):
    """25 turns, four attitudes: dead reckoning carries them over the gaps."""
    ts = np.arange(400) * 0.4
    tensor, omegas, attitudes = rates(ASYMMETRIC, ts)
    noise = Rotation.from_rotvec(0.01 * rng.normal(size=(4, 3)))
    seen = Rotation.from_quat(np.roll(attitudes[::100], -1, axis=1)) * noise
    observations = (
        identify.Attitudes(ts[::100], np.roll(seen.as_quat(), 1, axis=1), 0.01),
        identify.Rates(ts, omegas + 0.05 * rng.normal(size=omegas.shape), 0.05),
    )
    found = identify.fit(BLIND, observations)
    assert bool(found.status == Status.OK)
    error = elements(np.asarray(found.inertia)) - elements(
        3 * tensor / np.trace(tensor)
    )
    assert error @ np.linalg.solve(spread_of_elements(found), error) < 21


@pytest.mark.slow
def test_the_torque_of_a_gravity_gradient_follows_the_body(rng):
    """The same tensor stands in the torque: both are sought together."""

    def orbit(t):
        return jnp.stack([jnp.cos(0.3 * t), jnp.sin(0.3 * t), 0 * t])

    moments, ts = np.array([1.0, 1.7, 2.3]), np.linspace(0.0, 20.0, 60)
    body = jr.RigidBody(moments, jr.torques.GravityGradient(0.09, orbit))
    start = jr.State(UNTURNED, np.array([0.5, 1.0, 0.3]))
    values = np.asarray(jr.simulate(body, start, ts).states.omega) + 0.01 * rng.normal(
        size=(60, 3)
    )
    near = np.array([1.0, 1.4, 1.9])
    guess = jr.RigidBody(near, jr.torques.GravityGradient(0.09, orbit))
    found = identify.fit(
        guess,
        identify.Rates(ts, values, 0.01),
        start=start,
        inertia_model=identify.Moments(),
    )
    errors = np.asarray(found.ratios_errors)
    assert np.all(np.abs(np.asarray(found.ratios) - [1.7, 2.3]) < 4 * errors)


def test_progress_is_printed(capfd, rng):
    _, omegas, _ = rates(ASYMMETRIC, SHORT)
    short_fit(omegas + 1e-4 * rng.normal(size=omegas.shape))
    jax.effects_barrier()
    assert "chi-square" in capfd.readouterr().out


@pytest.mark.parametrize("with_tqdm", [True, False])
def test_progress_is_shown_on_a_terminal_by_default(
    with_tqdm, capsys, monkeypatch, rng
):
    """In a bar if there is tqdm, else line by line."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setattr(_progress, "_PATIENCE", 0.0)
    if not with_tqdm:
        monkeypatch.setitem(sys.modules, "tqdm", None)
    _, omegas, _ = rates(ASYMMETRIC, SHORT)
    identify.fit(
        BLIND,
        identify.Rates(SHORT, omegas + 1e-4 * rng.normal(size=omegas.shape), 1e-4),
    )
    shown = capsys.readouterr()
    assert "compiles the first stage" in shown.err
    assert "chi-square" in shown.err
    assert ("stages" in shown.err) is with_tqdm
    assert "chi-square" not in shown.out


@pytest.mark.parametrize(
    ("ratio", "status"), [(300.0, Status.OK), (1000.0, Status.UNIDENTIFIABLE)]
)
def test_a_rod_takes_tens_of_steps(ratio, status):
    """Its valley of chi-square is far narrower than its bend in logarithms of moments.

    A search that was straight in these took 115 to 300 steps for the thinner rod.
    """
    sigma = 0.004
    rng = np.random.default_rng(1)
    axes = Rotation.random(rng=rng).as_matrix()
    moments = np.array([1.0, ratio, ratio + 0.4]) / ratio
    ts = np.linspace(0, 600, 300)
    start = axes @ np.array([1.0, 0.8, 0.6])
    omega = worlds.tumble(axes @ np.diag(moments) @ axes.T, start, ts).omega
    readings = omega + sigma * rng.normal(size=(3, *omega.shape))
    records = [identify.Rates(ts, x, sigma) for x in readings]
    found = identify.fit_each(jr.RigidBody(np.ones(3)), records)
    assert np.all(np.isfinite(found.diagnostics.history).sum(axis=1) < 50)
    reduced = np.asarray(found.reduced_chi_square)
    np.testing.assert_allclose(reduced, 1, atol=5 * np.sqrt(2 / omega.size))
    assert np.all(np.asarray(found.status) == np.asarray(status))
    off = np.asarray(found.ratios) - moments[1:] / moments[0]
    assert np.all(np.abs(off) < 4 * np.asarray(found.ratios_errors))


@pytest.mark.parametrize("part", ["wheel", "damper"])
def test_parts_inside_the_body_begin_in_the_state_that_is_given(part, rng):
    """A wheel that spins freely, and a ball in a viscous fluid; rates by simulate."""
    if part == "wheel":
        torque = jr.torques.SpinningMass(0.3, jnp.array([0.0, 0.0, 1.0]))
        internal = (jnp.array(4.0),)
    else:
        torque = jr.torques.InternalDamper(0.2, 0.05)
        internal = (jnp.array([0.0, 0.0, 1.0]),)
    moments = jnp.array([1.0, 1.7, 2.3])
    start = jr.State(jnp.array([1.0, 0, 0, 0]), jnp.array([0.5, 1.0, 0.3]), internal)
    ts = jnp.linspace(0.0, 20.0, 120)
    omega = jr.simulate(jr.RigidBody(moments, torque), start, ts).states.omega
    record = identify.Rates(ts, omega + 0.01 * rng.normal(size=omega.shape), 0.01)
    # A ball: the fit does not begin at the solution.
    body = jr.RigidBody(5 / 3 * jnp.ones(3), torque)
    scale = "rotor" if part == "wheel" else "trace"
    found = identify.fit(body, record, scale=scale, start=start)
    assert found.status == identify.Status.OK
    off = (found.moments - moments) / found.moments_errors
    # The trace of a system without a wheel is that of the guess.
    assert np.max(np.abs(off)) < 4
    with pytest.raises(ValueError, match="the state of the parts inside the body"):
        identify.fit(body, record, scale=scale)
    without = jr.State(start.attitude, start.omega)
    with pytest.raises(ValueError, match="the state of the parts inside the body"):
        identify.fit(body, record, scale=scale, start=without)


def test_a_damper_s_coupling_is_found_beside_the_scale(rng):
    """The first parts of a record say little of either, and a scale could go anywhere."""
    moments = jnp.array([1.0, 1.6, 2.2])
    internal = (jnp.zeros(3),)
    start = jr.State(jnp.array([1.0, 0, 0, 0]), jnp.array([0.6, 1.2, 0.3]), internal)
    true = jr.RigidBody(moments, jr.torques.InternalDamper(0.3, 0.1))
    ts = jnp.linspace(0.0, 15.0, 151)
    omega = jr.simulate(true, start, ts).states.omega
    guess = jr.RigidBody(1.6 * jnp.ones(3), jr.torques.InternalDamper(0.3, 0.05))
    for _ in range(6):
        record = identify.Rates(ts, omega + 0.01 * rng.normal(size=omega.shape), 0.01)
        found = identify.fit(
            guess,
            record,
            free=lambda body, _: body.torque.coupling,
            start=start,
            scale="known",
        )
        assert found.status == identify.Status.OK
        coupling, error = found.estimates["torque.coupling"]
        assert abs(float(coupling) - 0.1) < 4 * float(error)
        off = (found.moments - moments) / found.moments_errors
        assert np.max(np.abs(off)) < 4
