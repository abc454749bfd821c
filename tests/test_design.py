"""Plans: gradients of their bound, the best trial, and fits that reach the bound."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import quick_jit

import jrigid as jr
from jrigid import identify

UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])
TS = np.arange(60) * 0.3
NEARLY_SYMMETRIC = jr.RigidBody(np.array([1.0, 1.05, 1.6]))
NOISE, MOST = 0.01, 1.2  # rad/s


def plan_of(omega, ts=TS, **given):
    record = identify.Rates(ts, None, NOISE)
    return identify.Plan(NEARLY_SYMMETRIC, jr.State(UNTURNED, omega), record, **given)


def spin(plan):
    return plan.state.omega


@quick_jit
@jax.vmap
def error(omega):
    """Root of the summed variances of the ratios."""
    return jnp.sqrt(jnp.trace(plan_of(omega).bound.ratios_covariance))


@pytest.fixture(scope="module")
def best():
    return identify.optimal_trial(plan_of(np.array([0.0, 0.1, 1.0])), spin, MOST)


def test_the_best_trial_beats_random_ones(best, rng):
    omega = np.asarray(best.plan.state.omega)
    assert np.linalg.norm(omega) <= MOST * (1 + 1e-12)
    trials = rng.normal(size=(400, 3))
    trials *= MOST / np.linalg.norm(trials, axis=1, keepdims=True)
    trials[200:] *= rng.uniform(size=(200, 1)) ** (1 / 3)  # and within the limit
    errors = np.asarray(error(np.concatenate([trials, omega[None], [[0.0, 0.1, 1.0]]])))
    *random, least, first = errors
    assert least <= np.nanmin(random)
    np.testing.assert_allclose(np.exp(best.score), least, rtol=1e-9)
    np.testing.assert_allclose(np.exp(best.start_score), first, rtol=1e-9)
    assert least < 0.1 * first


def test_the_best_trial_is_one_that_no_small_change_betters(best, rng):
    """By gradient and by the neighbours; each start has only gone down."""
    assert float(best.slope) < 0.03
    omega = np.asarray(best.plan.state.omega)
    near = omega + 0.02 * rng.normal(size=(400, 3))
    near *= np.minimum(1, MOST / np.linalg.norm(near, axis=1, keepdims=True))
    assert np.min(error(near)) > np.exp(float(best.score)) * (1 - 1e-3)
    history = np.asarray(best.history)
    assert history.shape == (8, 100)
    assert np.all(np.diff(history, axis=1) <= 0)
    assert float(best.score) == history[:, -1].min()
    assert float(best.start_score) == history[0, 0]


def test_a_plan_is_a_pytree_of_all_that_is_planned():
    plan = plan_of(np.array([0.3, 0.5, 0.9]), t0=0.1)
    assert "Plan(system=RigidBody(" in repr(plan)
    other = eqx.tree_at(spin, plan, np.ones(3))
    np.testing.assert_array_equal(other.state.omega, np.ones(3))
    assert len(jax.tree.leaves(plan)) == len(jax.tree.leaves(other))


@pytest.mark.slow  # programs of their own
def test_a_plan_s_bound_has_its_slopes_in_both_modes():
    """In the plan and in the rates it is made of, outside of jit, by differences."""

    def log_error(plan):
        return jnp.log(jnp.trace(plan.bound.ratios_covariance)) / 2

    omega, step = np.array([0.3, 0.5, 0.9]), 1e-6 * np.eye(3)
    slope = jax.jacfwd(lambda x: log_error(plan_of(x)))(omega)
    up, down = (np.log(np.asarray(error(omega + s * step))) for s in (1, -1))
    np.testing.assert_allclose(slope, (up - down) / 2e-6, rtol=1e-5)
    of_plan = eqx.filter_grad(log_error)(plan_of(jnp.asarray(omega)))
    np.testing.assert_allclose(of_plan.state.omega, slope, rtol=1e-9)
    # an error is proportional to the noise
    share = np.sum(np.asarray(of_plan.observations.sigma)) * NOISE
    assert float(share) == pytest.approx(1)
    # and does not change as all times move with that of the state
    shift = np.sum(np.asarray(of_plan.observations.ts)) + float(of_plan.t0)
    assert abs(shift) < 1e-9


@pytest.mark.parametrize(
    "limits", [(1.0, -1.0), -1.0, np.nan, (0.0, np.inf), [0.0, 1.0, 2.0], np.ones(2)]
)
def test_limits_that_hold_no_plan_are_refused(limits):
    with pytest.raises(ValueError, match="Argument `limits` must"):
        identify.optimal_trial(plan_of(np.ones(3)), spin, limits)


def test_a_search_without_a_finite_score_is_an_error(untyped):
    """Of one start: a pair of limits in a list, for arrays in a tuple."""
    plan = plan_of(np.ones(3))
    nothing = lambda bound: jnp.nan * bound.covariance[0, 0]  # noqa: E731

    def search(choose=lambda x: (x.t0,), limits=([0.0, 1.0],), **options):
        options = {"starts": 1, "steps": 1} | options
        return identify.optimal_trial(plan, choose, limits, score=nothing, **options)

    with pytest.raises(RuntimeError, match="`score` must be finite"):
        search()
    for name in ("starts", "steps"):
        with pytest.raises(ValueError, match=f"`{name}` must be an integer"):
            search(**{name: 0})
    with pytest.raises(ValueError, match="`choose` must pick floating point arrays"):
        search(choose=lambda _: ())
    with pytest.raises(ValueError, match="`plan` must be a Plan"):
        identify.optimal_trial(plan.system, spin, 1.0)


def test_a_plan_that_says_too_little_is_refused():
    plan = plan_of(np.ones(3))
    with pytest.raises(ValueError, match="an entry for each of 2 arrays"):
        identify.optimal_trial(
            plan, lambda x: (x.state.omega, x.observations.ts), [1.0]
        )
    with pytest.raises(ValueError, match="noise"):
        identify.Plan(NEARLY_SYMMETRIC, plan.state, identify.Rates(TS, None))
    with pytest.raises(ValueError, match="scale"):
        plan_of(np.ones(3), scale="known")
    with pytest.raises(ValueError, match="nothing of `each` trial"):
        _ = plan_of(np.ones(3), free=lambda _, gyro: identify.each(gyro.bias)).bound


@pytest.mark.slow  # 300 fits
def test_fits_of_the_best_trial_scatter_as_it_promises(best, rng):
    """Ratios over those of the truth, in units of the bound: a covariance of 1."""
    first = plan_of(np.array([0.0, 0.4, 1.0]))
    spread = []
    for plan in (best.plan, first):
        motion = jr.free_rotation(NEARLY_SYMMETRIC.inertia, plan.state, TS)
        values = np.asarray(motion.omega) + NOISE * rng.normal(size=(300, 60, 3))
        records = [identify.Rates(TS, y, NOISE) for y in values]
        results = identify.fit_each(NEARLY_SYMMETRIC, records)
        off = np.asarray(results.ratios) - np.array([1.05, 1.6])
        spread.append(np.sqrt(np.trace(np.cov(off.T))))
        if plan is best.plan:
            half = np.linalg.inv(
                np.linalg.cholesky(np.asarray(plan.bound.ratios_covariance))
            )
            np.testing.assert_allclose(np.cov(half @ off.T), np.eye(2), atol=0.35)
            assert np.all(np.abs(np.mean(half @ off.T, axis=1)) < 4 / np.sqrt(300))
    assert spread[0] < 0.7 * spread[1]


@pytest.mark.slow  # a program of its own
def test_the_spin_and_the_times_together():
    """Few samples at chosen times give smaller errors than evenly spaced ones."""
    plan = plan_of(np.array([0.3, 0.5, 0.8]), np.linspace(0, 18, 12))
    best = identify.optimal_trial(
        plan, lambda x: (x.state.omega, x.observations.ts), (1.0, (0.0, 18.0)), starts=4
    )
    times = np.asarray(best.plan.observations.ts)
    assert times.min() >= 0
    assert times.max() <= 18
    of_spin = identify.optimal_trial(plan, spin, 1.0, starts=4)
    assert float(best.score) < float(of_spin.score) - 0.1
    assert float(of_spin.score) < float(of_spin.start_score)


@pytest.mark.slow  # a program of its own, forward mode under a torque
def test_a_wheel_s_profile_is_chosen_within_its_limits():
    knots = np.linspace(0, 6, 4)
    wheel = jr.torques.Rotor(jr.torques.Sampled(knots, 0.1 * np.ones((4, 3))))
    body = jr.RigidBody(NEARLY_SYMMETRIC.inertia, wheel)
    record = identify.Rates(np.linspace(0, 6, 15), None, NOISE)
    state = jr.State(UNTURNED, np.array([0.3, 0.5, 0.8]))
    plan = identify.Plan(body, state, record, scale="rotor")
    best = identify.optimal_trial(
        plan,
        lambda x: x.system.torque.momentum.values,
        (-0.3, 0.3),
        starts=2,
        steps=30,
        score=lambda bound: jnp.linalg.slogdet(bound.covariance[:6, :6])[1],
    )
    profile = np.asarray(best.plan.system.torque.momentum.values)
    assert np.abs(profile).max() <= 0.3 + 1e-12
    assert float(best.score) < float(best.start_score) - 1
    assert bool(best.plan.predicted.status == identify.Status.OK)


def test_a_plan_knows_nothing_of_what_it_seeks_beforehand():
    """Without a prior all errors are proportional to the noise, however large it is."""

    def free(_, gyro):
        return gyro.bias

    def covariance(noise):
        start = jr.State(UNTURNED, np.array([0.3, 0.5, 0.9]))
        record = identify.Rates(TS, None, noise)
        plan = identify.Plan(NEARLY_SYMMETRIC, start, record, free=free)
        return np.asarray(plan.bound.covariance)

    small, large = covariance(NOISE), covariance(1e3 * NOISE)
    assert np.all(np.diagonal(large)[5:8] > 1)
    units = np.sqrt(np.diagonal(large))
    off = (large - 1e6 * small) / units / units[:, None]
    assert np.max(np.abs(off)) < 1e-6


def test_readings_beyond_the_limit_of_a_gyro_say_little():
    """A plan counts them hardly more than readings that nobody has."""
    limit, state = 0.6, jr.State(UNTURNED, np.array([0.3, 0.5, 0.9]))
    omegas = jr.free_rotation(NEARLY_SYMMETRIC.inertia, state, TS).omega
    beyond = np.abs(omegas) > limit
    assert 0.3 < np.mean(beyond) < 0.6

    def errors(gyro, sigma):
        record = identify.Record(gyro, TS, None, sigma)
        plan = identify.Plan(NEARLY_SYMMETRIC, state, record)
        return np.sqrt(np.diagonal(plan.bound.ratios_covariance))

    seen = errors(identify.Gyro(limit=limit), NOISE)
    without = errors(identify.Gyro(), np.where(beyond, 1e6, NOISE))
    assert np.all((0.9 * without < seen) & (seen < 1.001 * without))


def test_a_plan_at_rest_determines_nothing_in_float32():
    start = jr.State(UNTURNED.astype(np.float32), np.zeros(3, np.float32))
    body = jr.RigidBody(NEARLY_SYMMETRIC.inertia.astype(np.float32))
    record = identify.Rates(TS.astype(np.float32), None, np.float32(NOISE))
    found = identify.Plan(body, start, record).predicted
    assert found.numbers.dtype == np.float32
    assert found.status == identify.Status.UNIDENTIFIABLE


def test_the_report_of_a_plan_does_not_depend_on_the_unit_of_a_magnetometer():
    """In tesla and in nanotesla, with a bias that is zero in the plan."""
    state = jr.State(UNTURNED, np.array([0.3, 0.5, 0.9]))
    gyro = identify.Rates(TS, None, NOISE)

    def free(_, __, magnetometer):
        return magnetometer.bias

    def predicted(unit, t0=0.0, torque=None):
        north = identify.Magnetometer(unit * np.array([2e-5, 0.0, -4e-5]))
        compass = identify.Record(north, TS, None, unit * 2e-7)
        return identify.Plan(
            jr.RigidBody(NEARLY_SYMMETRIC.inertia, torque),
            state,
            (gyro, compass),
            t0=t0,
            free=free,
        ).predicted

    in_tesla, in_nanotesla = predicted(1.0), predicted(1e9)
    np.testing.assert_allclose(in_nanotesla.errors, in_tesla.errors, rtol=1e-6)
    for found in (in_tesla, in_nanotesla):
        assert found.determined == {"inertia": True, "magnetometer.bias": True}
        assert "not finite" not in str(found)
    # Under a torque no motion leads back from the state to the first sample.
    late = predicted(1.0, t0=0.1, torque=jr.torques.LinearDrag(0.01))
    assert "Predictions are not finite" in str(late)
