"""fit() on records that do not obey its model: unmodelled torque, a wheel, several trials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from helpers import quick_jit
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid import identify
from jrigid.identify import Status

TURN = Rotation.from_rotvec([0.6, -0.4, 0.9]).as_matrix()
TENSOR = TURN @ np.diag([0.6, 1.02, 1.38]) @ TURN.T
TENSOR = (TENSOR + TENSOR.T) / 2
OMEGA = TURN @ np.array([0.5, 1.0, 0.4]) / np.linalg.norm([0.5, 1.0, 0.4])
BLIND = jr.RigidBody(np.ones(3))
PAIRS = ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2))
NOISE, STEP = 0.01, 0.3
TS = np.arange(100) * STEP
# The level that moves the rate of a unit tensor by the noise from sample to sample.
LEVEL = NOISE / np.sqrt(STEP)


def errors_of(found):
    """Errors of five elements of each lane's tensor, and their covariances."""

    def one(result):
        slopes = jax.jacfwd(result.unknowns.inertia)(result.numbers)
        slopes = jnp.stack([slopes[i, j] for i, j in PAIRS])
        return slopes @ result.numbers_covariance @ slopes.T

    tensors = np.asarray(found.inertia)
    errors = np.stack([tensors[:, i, j] - TENSOR[i, j] for i, j in PAIRS], axis=-1)
    return errors, np.asarray(jax.vmap(one)(found))


@pytest.fixture(scope="module")
def smoothed():
    return lambda values: identify.fit_each(
        BLIND, [identify.Rates(TS, y, NOISE) for y in values], unmodelled="estimate"
    )


@pytest.mark.parametrize(
    ("kick", "lanes"),
    [
        (0.0, 12),
        (1.0, 12),
        pytest.param(0.0, 40, marks=pytest.mark.slow, id="0.0"),
        pytest.param(0.1, 40, marks=pytest.mark.slow, id="0.1"),
        pytest.param(1.0, 40, marks=pytest.mark.slow, id="1.0"),
        pytest.param(10.0, 40, marks=pytest.mark.slow, id="10.0"),
    ],
)
def test_an_unmodelled_torque_is_found_and_counted(smoothed, kick, lanes, rng):
    """Coverage and level; where there is none the level is zero within its error."""
    omega0 = np.tile(OMEGA, (lanes, 1))
    motion = worlds.tumble(TENSOR, omega0, TS, kick=kick * LEVEL, rng=rng)
    found = smoothed(motion.omega + NOISE * rng.normal(size=motion.omega.shape))
    good = np.asarray(found.status == Status.OK)
    assert good.mean() > 0.9, str(found)
    errors, covariances = errors_of(found)
    square = (
        np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)[good] / 5
    )
    # 5 degrees of freedom each: of 40 fits 1 +- 0.1.
    scatter = np.sqrt(2 / 5 / lanes)
    assert 1 - 4 * scatter < square.mean() < 1 + 5 * scatter
    level, error = (
        np.asarray(found.level)[good, 0],
        np.asarray(found.level_errors)[good, 0],
    )
    if kick:
        # The likelihood of a level that is hardly seen is a parabola in its logarithm,
        # not in it.
        seen, true = level > 0, kick * LEVEL
        pulls = (level - true) / error
        pulls[seen] = np.log(level[seen] / true) / (error[seen] / level[seen])
        assert np.sqrt(np.mean(pulls**2)) < 1.6
        assert abs(np.median(level) / (kick * LEVEL) - 1) < 0.2
        assert abs(np.mean(np.asarray(found.reduced_chi_square)[good]) - 1) < 0.1
    else:
        assert np.median(level) < 0.02 * LEVEL
        # as sure as a fit that takes the model's word for it
        own = np.asarray(found.diagnostics.sensor_covariance)[good]
        ratio = np.diagonal(
            np.asarray(found.numbers_covariance)[good] / own, axis1=1, axis2=2
        )
        assert np.median(ratio) < 1.05
    alike = np.all(np.asarray(found.level) == np.asarray(found.level)[:, :1], axis=1)
    assert np.mean(alike) > 0.5  # axes of their own are asked for by chance in some
    assert np.median(np.asarray(found.correlation_time)) < STEP


def test_a_level_that_is_known_is_that_which_is_estimated(smoothed, rng):
    motion = worlds.tumble(TENSOR, OMEGA[None], TS, kick=LEVEL, rng=rng)
    values = motion.omega + NOISE * rng.normal(size=motion.omega.shape)
    sought = smoothed(values)
    level = float(sought.level[0, 0])
    known = identify.fit(BLIND, identify.Rates(TS, values[0], NOISE), unmodelled=level)
    np.testing.assert_allclose(known.inertia, sought.inertia[0], atol=1e-4)
    np.testing.assert_allclose(
        known.numbers_covariance, sought.numbers_covariance[0], rtol=0.02
    )
    assert "unmodelled torque" in str(known)
    assert "of the errors" in str(known)
    own, whole = known.diagnostics.sensor_covariance, known.numbers_covariance
    assert np.all(np.diagonal(own) < np.diagonal(whole))


# A wheel


def test_a_sampled_function_is_a_cubic_between_its_samples(rng):
    ts = np.sort(rng.uniform(0, 3, 12))
    values = rng.normal(size=(12, 3))
    curve = jr.torques.Sampled(ts, values, 1.2, 0.1)
    slopes = np.gradient(values, ts, axis=0, edge_order=2)
    peer = CubicHermiteSpline(ts, 1.2 * values, 1.2 * slopes)
    times = np.linspace(ts[0], ts[-1], 50)
    seen = jax.vmap(curve)(times + 0.1)
    np.testing.assert_allclose(seen, peer(times), atol=1e-12)
    rate = jax.vmap(jax.jacfwd(curve))(times[1:-1] + 0.1)
    np.testing.assert_allclose(rate, peer(times[1:-1], 1), atol=1e-10)
    for t, value in ((-1.0, values[0]), (9.0, values[-1])):  # held beyond the ends
        np.testing.assert_allclose(curve(t), 1.2 * value)
    padded = jr.torques.Sampled(
        np.append(ts, [ts[-1]] * 3), np.append(values, values[[-1] * 3], 0)
    )
    np.testing.assert_allclose(
        padded(1.5), jr.torques.Sampled(ts, values)(1.5), rtol=1e-12
    )
    np.testing.assert_allclose(padded(9.0), values[-1])
    two = jr.torques.Sampled(np.array([0.0, 2.0]), np.array([1.0, 2.0]))
    assert float(two(0.5)) == pytest.approx(1.25)
    with pytest.raises(ValueError, match="values"):
        jr.torques.Sampled(ts, values[1:])


WHEEL_TENSOR = Rotation.from_rotvec([0.2, -0.1, 0.3]).as_matrix()
WHEEL_TENSOR = WHEEL_TENSOR @ np.diag([2600e-6, 890e-6, 2860e-6]) @ WHEEL_TENSOR.T
WHEEL_TENSOR = (WHEEL_TENSOR + WHEEL_TENSOR.T) / 2


def trials_with_a_wheel(rng, count, scale=1.0, delay=0.0):
    """Half a second each at 400 Hz, a wheel that spins up to 2.1e-3 in each at another pace."""
    ts, sigma = np.arange(0, 0.5, 0.0025), 0.06
    spins = np.array([[6.0, 12.0, -8.0], [-9.0, 7.0, 8.0], [3.0, -14.0, 5.0]])[:count]
    records, bodies = [], []
    for i, spin in enumerate(spins):
        axis = np.array([0.0, 0.6, 0.8])
        true, predicted = worlds.wheel_profile(
            axis, 2.1e-3, 0.05, 0.3 + 0.05 * i, scale, delay
        )
        motion = worlds.tumble(WHEEL_TENSOR, spin, ts, wheel=true)
        values = motion.omega + sigma * rng.normal(size=motion.omega.shape)
        momenta = np.array([predicted(t)[0] for t in ts])
        records.append(identify.Rates(ts, values, sigma))
        bodies.append(
            jr.RigidBody(np.ones(3), jr.torques.Rotor(jr.torques.Sampled(ts, momenta)))
        )
    return ts, bodies, records


def test_the_whole_tensor_from_trials_each_with_its_wheel_s_record(rng):
    """Blind, from a unit tensor, 400 times too large."""
    _, bodies, records = trials_with_a_wheel(rng, 2)
    found = identify.fit(bodies, records, scale="rotor")
    assert bool(found.status == Status.OK)
    assert found.null_directions == ()
    errors = np.linalg.eigvalsh(WHEEL_TENSOR) - np.asarray(found.moments)
    assert np.all(np.abs(errors) < 4 * np.sqrt(np.diagonal(found.moments_covariance)))
    np.testing.assert_allclose(found.inertia, WHEEL_TENSOR, rtol=0, atol=3e-5)


def test_a_wheel_known_to_two_per_cent_tells_the_scale_to_two_per_cent(rng):
    """Its report is 1 % too large and 5 ms late; both are sought, the delay without a prior."""
    _, bodies, records = trials_with_a_wheel(rng, 1, scale=1.01, delay=0.005)

    def free(body):
        return identify.prior(
            body.torque.momentum.scale, 0.02
        ), body.torque.momentum.delay

    found = identify.fit(bodies[0], records, scale="rotor", free=free)
    trace = float(jnp.trace(found.inertia))
    spread = found.spread(lambda tensor: jnp.trace(tensor)[None])[0, 0]
    assert 0.02 < float(spread) ** 0.5 / trace < 0.06
    assert abs(trace / np.trace(WHEEL_TENSOR) - 1.01) < 4 * float(spread) ** 0.5 / trace
    delay, error = found.estimates["torque.momentum.delay"]
    # the samples are to be read 5 ms earlier than they say
    assert abs(float(delay) + 0.005) < 4 * float(error) < 0.008


def test_gyrostat_takes_many_trials_and_states_its_errors(rng):
    ts, bodies, records = trials_with_a_wheel(rng, 3)
    momenta = np.stack([x.torque.momentum.values for x in bodies])
    values = np.stack([x.values for x in records])
    ts = np.tile(ts, (3, 1))
    ts[1, 150:] = values[1, 150:] = np.nan
    found = identify.gyrostat(ts, values, momenta)
    np.testing.assert_allclose(found.inertia, WHEEL_TENSOR, rtol=0, atol=6e-5)
    errors = np.sqrt(np.diagonal(found.covariance))
    assert np.all((errors > 1e-7) & (errors < 5e-5))
    with pytest.raises(RuntimeError, match="increasing"):
        identify.gyrostat(ts[:, ::-1], values, momenta)


def test_momenta_in_body_axes_beside_a_gyro_need_no_attitude(rng):
    motion = jr.free_rotation(TENSOR, jr.State(np.array([1.0, 0, 0, 0]), OMEGA), TS)
    omegas = np.asarray(motion.omega)
    momenta = omegas @ TENSOR + 1e-3 * rng.normal(size=omegas.shape)
    records = (
        identify.Rates(TS, omegas + 1e-3 * rng.normal(size=omegas.shape), 1e-3),
        identify.AngularMomenta(TS, momenta, 1e-3, frame="body"),
    )
    found = identify.fit(BLIND, records, scale="known")
    assert found.status == Status.OK
    off = np.asarray(found.inertia - TENSOR)[np.triu_indices(3)]
    assert np.all(np.abs(off) < 5 * np.sqrt(np.diagonal(upper(found))))


def upper(found):
    """Covariance of the upper triangle of the tensor."""
    places = np.ravel_multi_index(np.triu_indices(3), (3, 3))
    covariance = np.asarray(found.inertia_covariance).reshape(9, 9)
    return covariance[np.ix_(places, places)]


def test_a_fit_does_not_end_worse_than_it_was_told_to_begin(rng):
    """One axis is always at the limit of the gyro, so that the rates mislead."""
    tensor = np.array(
        [
            [0.9809, -0.0507, -0.2102],
            [-0.0507, 0.9252, 0.1061],
            [-0.2102, 0.1061, 1.0939],
        ]
    )
    state = jr.State(np.array([1.0, 0, 0, 0]), np.array([-1.39686, 0.8451, 2.51686]))
    ts = np.linspace(0.0, 12.0, 240)
    omegas = np.asarray(jr.free_rotation(tensor, state, ts).omega)
    for _ in range(4):
        values = np.clip(omegas + 0.02 * rng.normal(size=omegas.shape), -1.5, 1.5)
        record = identify.Record(identify.Gyro(limit=1.5), ts, values, 0.02)
        first = identify.residuals(jr.RigidBody(tensor), state, record)
        found = identify.fit(BLIND, record, start=(tensor, state))
        assert float(found.chi_square) < float(jnp.sum(first**2))


# The posterior


def test_the_log_density_has_a_gradient_under_a_torque(rng):
    """That of its values, by central differences."""
    ts = np.linspace(0.0, 4.0, 60)
    body = jr.RigidBody(TENSOR, jr.torques.LinearDrag(0.05))
    start = jr.State(np.array([1.0, 0, 0, 0]), OMEGA)
    values = np.asarray(jr.simulate(body, start, ts).states.omega)
    record = identify.Rates(ts, values + 0.01 * rng.normal(size=(60, 3)), 0.01)
    blind = jr.RigidBody(np.eye(3), jr.torques.LinearDrag(0.02))
    found = identify.fit(blind, record, free=lambda body, _: body.torque.coefficient)
    density = identify.log_density(found)
    value_and_slope = quick_jit(jax.value_and_grad(density.function))
    # Off the maximum, where the slope is several errors long.
    place = density.start + 3 * np.sqrt(np.diagonal(density.covariance))
    slope = value_and_slope(place)[1]
    steps = 1e-3 * np.sqrt(np.diagonal(density.covariance))
    for k, step in enumerate(steps):
        move = step * np.eye(len(steps))[k]
        ahead, _ = value_and_slope(place + move)
        behind, _ = value_and_slope(place - move)
        assert float(slope[k] * step) == pytest.approx(
            float(ahead - behind) / 2, rel=1e-4, abs=1e-6
        )


def test_the_log_density_has_the_fit_s_minimum_and_curvature(rng):
    """Its gradient at the fit is that of the priors' Jacobians, small beside the errors."""
    motion = jr.free_rotation(TENSOR, jr.State(np.array([1.0, 0, 0, 0]), OMEGA), TS)
    values = np.asarray(motion.omega) + 1e-4 * rng.normal(size=(100, 3))
    free = lambda _, gyro: identify.prior(gyro.bias, 0.02)  # noqa: E731
    found = identify.fit(BLIND, identify.Rates(TS, values, 1e-4), free=free)
    density = identify.log_density(found)
    both = quick_jit(
        lambda x: (jax.grad(density.function)(x), jax.hessian(density.function)(x))
    )
    slope, curvature = both(density.start)
    errors = np.sqrt(np.diagonal(density.covariance))
    assert np.all(np.abs(slope) * errors < 1e-2)
    inverse = np.linalg.inv(-np.asarray(curvature))
    np.testing.assert_allclose(
        inverse, density.covariance, atol=0.02 * errors.max() ** 2
    )
    np.testing.assert_allclose(np.diagonal(inverse), errors**2, rtol=0.02)
    record = identify.Rates(TS, values, 1e-4)
    start = jr.State(np.array([1.0, 0, 0, 0]), OMEGA)
    smoothed = identify.Plan(jr.RigidBody(TENSOR), start, record).predicted
    density = identify.log_density(smoothed)  # a plan has a density too
    assert density.start.shape == (8,)
