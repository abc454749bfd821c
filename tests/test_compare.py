"""Comparison of models by criteria, and by trials that are not in the fit."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid import identify

BLIND = jr.RigidBody(np.ones(3))
TS, NOISE = np.arange(80) * 0.25, 0.02
MOMENTS = np.array([0.6, 1.02, 1.38])


def trials(rng, drag=0.0, turn=0.0, count=1, noise=NOISE):
    """Records of a body with air drag, its principal axes turned from the gyro's."""
    axes = Rotation.from_rotvec(turn * np.array([0.6, -0.4, 0.9])).as_matrix()
    omega = rng.normal(size=(count, 3))
    omega /= np.linalg.norm(omega, axis=1, keepdims=True)
    torque = worlds.quadratic_drag(drag) if drag else None
    motion = worlds.tumble(axes @ np.diag(MOMENTS) @ axes.T, omega, TS, torque)
    values = motion.omega + NOISE * rng.normal(size=motion.omega.shape)
    return [identify.Rates(TS, x, noise) for x in values]


def of_axes(record):
    """Fits with the axes known to be the gyro's, and with any."""
    known = identify.fit(BLIND, record, inertia_model=identify.Moments(), throw=False)
    return {"known axes": known, "any axes": identify.fit(BLIND, record, throw=False)}


@pytest.mark.parametrize("count", [5, pytest.param(10, marks=pytest.mark.slow)])
def test_three_numbers_too_many_are_distinguished_from_three_too_few(count, rng):
    for turn, best, share in ((0.0, "known axes", 0.8), (0.3, "any axes", 1.0)):
        tables = [
            identify.compare(of_axes(trials(rng, turn=turn)[0])) for _ in range(count)
        ]
        wins = [x.names[int(jnp.argmin(x.bic))] == best for x in tables]
        assert sum(wins) >= share * count, wins
    one = tables[0]
    np.testing.assert_array_equal(one.unknowns, [2 + 3, 5 + 3])
    np.testing.assert_array_equal(
        one.degrees_of_freedom, 240 - np.asarray(one.unknowns)
    )
    counts = np.asarray(one.unknowns)
    np.testing.assert_allclose(one.aic - one.chi_square, 2 * counts)
    np.testing.assert_allclose(one.bic - one.chi_square, np.log(240) * counts)
    lines = str(one).splitlines()
    assert lines[0].split() == [
        "model",
        "chi-square",
        "freedom",
        "unknowns",
        "AIC",
        "BIC",
    ]
    assert lines[1].startswith("any axes")
    assert lines[1].endswith("0.0")


def test_fits_of_different_records_are_not_compared(rng):
    first, second = (of_axes(x)["any axes"] for x in trials(rng, count=2))
    assert identify.compare({"one": first, "two": first}).names == ("one", "two")
    with pytest.raises(ValueError, match="same samples"):
        identify.compare({"one": first, "two": second})
    with pytest.raises(ValueError, match="`results` must hold fits"):
        identify.compare({})


def test_what_is_no_fit_is_not_compared(untyped):
    with pytest.raises(ValueError, match="`results` must be a Mapping"):
        identify.compare([1])
    with pytest.raises(ValueError, match="`results` must be a FitResult"):
        identify.compare({"one": 1})


def test_each_trial_or_group_is_left_out_once():
    """By a fit that remembers what it was shown."""

    class Diagnostics:
        log_determinant = 10_000.0

    class Shown:
        diagnostics = Diagnostics()

        def __init__(self, chi_square):
            self.chi_square = jnp.asarray(chi_square)

    def refit(total, group):
        return Shown(float(total) * 100 + sum(group))

    misfits = identify.cross_validate(sum, [1, 2, [3, 4]], refit=refit)
    np.testing.assert_array_equal(misfits, [10_901, 10_802, 10_307])
    with pytest.raises(ValueError, match="two trials"):
        identify.cross_validate(sum, [1], refit=refit)


def test_cross_validation_prefers_no_torque_where_there_is_none(rng):
    """A large torque follows any trial, so that its chi-square alone is the least."""
    records = trials(rng, count=3)

    def misfit(level):
        return identify.cross_validate(
            lambda x: identify.fit(BLIND, x, unmodelled=level, throw=False), records
        )

    without = misfit(0.0)
    assert np.all(misfit(0.1) > without + 50)
    assert np.all(misfit(10.0) > misfit(0.1) + 50)


@pytest.mark.slow  # programs of its own
def test_a_trial_left_out_is_judged_by_the_fit_s_own_model(rng):
    kicked = trials(rng, count=3)
    kinked = [identify.Rates(x.ts, x.values.at[40].add(1.0), x.sigma) for x in kicked]
    robust = lambda x: identify.fit(BLIND, x, loss="robust", throw=False)  # noqa: E731
    squares = identify.cross_validate(robust, kinked)
    assert np.all((squares > 0.7 * 237) & (squares < 1.3 * 237)), squares
    with pytest.raises(ValueError, match="must state the noise"):
        identify.cross_validate(
            without_drag, [identify.Rates(x.ts, x.values) for x in kicked]
        )


DRAGGED = jr.RigidBody(np.ones(3), jr.torques.QuadraticDrag(0.003))


def with_drag(records):
    return identify.fit(
        DRAGGED, records, free=lambda body: body.torque.coefficient, throw=False
    )


def without_drag(records):
    return identify.fit(BLIND, records, throw=False)


def compared(records):
    return identify.compare({"drag": with_drag(records), "free": without_drag(records)})


@pytest.mark.slow  # fits under a torque
def test_drag_is_found_where_it_is_and_not_where_it_is_not(rng):
    records = trials(rng, 0.004, count=4)
    bic = compared(records).bic
    assert float(bic[1] - bic[0]) > 50
    better = identify.cross_validate(without_drag, records)
    better -= identify.cross_validate(with_drag, records)
    assert np.all(better > 0)
    # of a trial left out its three rates are sought, and the rest is as the others say
    assert float(jnp.sum(identify.cross_validate(with_drag, records))) < 1.2 * 4 * 237
    margins = []
    for _ in range(10):
        bic = compared(trials(rng, 0.0, count=4)).bic
        margins.append(float(bic[0] - bic[1]))
    assert sum(x > 0 for x in margins) >= 8, margins
    assert np.all(
        np.array(margins) < np.log(960) + 0.1
    )  # an unknown too many costs that at most


@pytest.mark.slow  # a program of its own
def test_without_a_stated_noise_the_residuals_take_its_place(rng):
    records = trials(rng, turn=0.3, noise=None)
    table = identify.compare(of_axes(records[0]))
    assert int(jnp.argmin(table.bic)) == 1
    misfit = 240 * np.log(np.asarray(table.chi_square) / 240)
    np.testing.assert_allclose(
        table.bic, misfit + np.log(240) * np.asarray(table.unknowns)
    )


@pytest.mark.parametrize("time", [0.0, 2.0])
def test_the_likelihood_of_an_unmodelled_torque_is_that_of_a_dense_covariance(
    time, rng
):
    """A sphere: its rates are noise, a constant and the integral of the torque."""
    ts, level = TS[:30], 0.05
    later, earlier = np.maximum(*np.meshgrid(ts, ts)), np.minimum(*np.meshgrid(ts, ts))
    spread = level**2 * earlier
    # Of a torque whose correlation falls exponentially, and is stationary from the
    # start
    if time:
        memory = 1 + np.exp((earlier - later) / time)
        memory = memory - np.exp(-earlier / time) - np.exp(-later / time)
        spread = spread - level**2 * time / 2 * memory
    covariance = spread / NOISE**2 + np.eye(ts.size)
    values = (
        np.ones(3)
        + rng.multivariate_normal(np.zeros(ts.size), NOISE**2 * covariance, 3).T
    )
    torque = identify.GaussMarkov(level, time)
    result = identify.fit(
        BLIND,
        identify.Rates(ts, values, NOISE),
        inertia_model=identify.Fixed(),
        unmodelled=torque,
    )
    inverse = np.linalg.inv(covariance)
    ones = np.ones(ts.size)
    residuals = (values - ones @ inverse @ values / (ones @ inverse @ ones)) / NOISE
    np.testing.assert_allclose(
        result.chi_square, np.sum(residuals * (inverse @ residuals)), rtol=1e-6
    )
    log_determinant = 3 * np.linalg.slogdet(covariance)[1]
    np.testing.assert_allclose(
        result.diagnostics.log_determinant, log_determinant, rtol=1e-6
    )


def test_an_unmodelled_torque_is_preferred_where_there_is_one(rng):
    for level, best in ((0.0, "none"), (0.02, "torque")):
        (record,) = trials(rng)
        kicks = level * np.sqrt(TS[1]) * rng.normal(size=(TS.size, 3))
        # Kicks of a body that turns slowly: what they do later is left out, as it is
        # small.
        record = identify.Rates(TS, record.values + np.cumsum(kicks, axis=0), NOISE)
        plain = identify.fit(BLIND, record, throw=False)
        torque = identify.fit(BLIND, record, unmodelled="estimate", throw=False)
        table = identify.compare({"none": plain, "torque": torque})
        assert table.names[int(jnp.argmin(table.bic))] == best, str(table)
        assert (
            table.unknowns[1] - table.unknowns[0] == torque.diagnostics.torque_numbers
        )
        assert torque.diagnostics.torque_numbers > 0


@pytest.mark.slow  # a program of its own
def test_trials_with_a_wheel_of_their_own_are_left_out_in_turn(rng):
    """Each is a body with the record of its wheel, and what the gyro read."""
    tensor, ts = np.diag(MOMENTS), np.arange(60) * 0.02
    pairs = []
    for i in range(4):
        moved, recorded = worlds.wheel_profile(
            np.array([0.2, -0.3, 1.0]), 1.5, 0.1 + 0.1 * i, 0.6
        )
        omega = 5.0 * rng.normal(size=3)
        motion = worlds.tumble(tensor, omega, ts, wheel=moved)
        clock = np.arange(61 + i) * 0.02
        wheel = jr.torques.Rotor(jr.torques.Sampled(clock, recorded(clock)[0]))
        values = motion.omega + NOISE * rng.normal(size=motion.omega.shape)
        pairs.append(
            (jr.RigidBody(np.ones(3), wheel), identify.Rates(ts, values, NOISE))
        )

    def fit(pairs):
        bodies, records = zip(*pairs, strict=True)
        return identify.fit(bodies, list(records), scale="rotor")

    squares = np.asarray(identify.cross_validate(fit, pairs))
    freedom = 3 * ts.size - 3
    assert np.all(np.abs(squares - freedom) < 6 * np.sqrt(2 * freedom)), squares


def test_saturated_numbers_count_neither_in_chi_square_nor_in_its_size(rng):
    fits = of_axes(trials(rng)[0])
    sign_of = lambda x: x.problem.samples.sign  # noqa: E731
    first = fits["any axes"]
    sign = np.zeros_like(sign_of(first))
    sign[:, :10, 1] = 1
    fits = {name: eqx.tree_at(sign_of, x, sign) for name, x in fits.items()}
    table = identify.compare(fits)
    cost = np.log(240 - 10) * np.asarray(table.unknowns)
    np.testing.assert_allclose(table.bic - table.chi_square, cost)
