"""fit() on records that mislead: it is right, or says what is wrong.

The records are simulated in `worlds.py`.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid import identify
from jrigid.identify import Status
from jrigid.identify._readings import _turn_between

BLIND = jr.RigidBody(np.ones(3))
TS = np.arange(200) * 0.3  # ten turns at a radian a second, twenty samples each
MOMENTS = np.array([1.0, 1.7, 2.3])
FIVE = ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2))
SIX = (*FIVE, (2, 2))
SAYS_WHY = (Status.UNIDENTIFIABLE, Status.MISFIT, Status.AT_BOUNDARY)


def body_of(rng, moments=MOMENTS):
    """Inertia of mean moment 1, its axes at random."""
    axes = worlds.random_axes(rng)
    tensor = axes @ np.diag(moments) @ axes.T
    tensor = (tensor + tensor.T) / 2
    return 3 * tensor / np.trace(tensor)


def spin_of(rng, tensor, size=1.0, off=0.5):
    """Rates half way between an axis and any direction."""
    axes = np.linalg.eigh(tensor)[1]
    direction = axes @ (np.array([0.5, 1.0, 0.4]) + off * rng.uniform(-0.5, 0.5, 3))
    return size * direction / np.linalg.norm(direction)


def seen(rng, tensor, ts=TS, sigma=0.01, omega0=None, **motion):
    """True motion and readings with noise."""
    omega0 = spin_of(rng, tensor) if omega0 is None else omega0
    moved = worlds.tumble(tensor, omega0, ts, rng=rng, **motion)
    return moved, moved.omega + sigma * rng.normal(size=moved.omega.shape)


def fitted(values, sigma=0.01, ts=TS, **options):
    """Of a free body; compiled once for 200 samples of about ten turns."""
    return identify.fit(BLIND, identify.Rates(ts, values, sigma), **options)


def is_in(found, statuses):
    return any(bool(found.status == x) for x in statuses)


def words(found):
    """What a fit that is not OK must have: numbers that are, steps, and a word."""
    text = str(found)
    assert np.isfinite(float(found.chi_square)), text
    assert int(np.sum(np.isfinite(found.diagnostics.history))) > 0, text
    return text


def covers(found, tensor, absolute=False, far=30.0, ratio=5.0):
    """The tensor is within its errors: chi-square of five numbers, 1e-5; of six."""
    pairs = SIX if absolute else FIVE

    def numbers(tensor):
        return jnp.stack([tensor[i, j] for i, j in pairs])

    slopes = numbers(jax.jacfwd(found.unknowns.inertia)(found.numbers))
    spread = np.asarray(slopes @ found.numbers_covariance @ slopes.T)
    error = np.asarray(numbers(found.inertia) - numbers(jnp.asarray(tensor)))
    distance = error @ np.linalg.solve(spread, error)
    assert distance < far, f"{distance}\n{found}"
    true = np.linalg.eigvalsh(tensor)
    off = np.abs(np.asarray(found.ratios) - true[1:] / true[0])
    assert np.all(off < ratio * np.asarray(found.ratios_errors)), str(found)


def near(found, name, true, far=5.0, least=0.0):
    """An array that was sought is within its errors."""
    value, error = (np.asarray(x) for x in found.estimates[name])
    assert np.all(np.abs(value - true) < far * error + least), (
        f"{value} {error} {true}\n{found}"
    )


# Records that tell little, or not what they seem to


@pytest.mark.parametrize("kind", ["prolate", "near sphere"])
def test_a_spin_that_is_nearly_pure_does_not_tell_the_ratios(kind, rng):
    for _ in range(6):
        if kind == "prolate":  # about an equatorial axis
            tensor = body_of(rng, np.array([1.0, 4.295, 4.295]))
            omega0 = np.linalg.eigh(tensor)[1] @ np.array([0.0, 0.6, 0.8])
        else:
            tensor, omega0 = body_of(rng, 1 + 1e-4 * rng.normal(size=3)), None
        _, values = seen(rng, tensor, omega0=omega0, sigma=0.014)
        found = fitted(values, 0.014, throw=False)
        assert is_in(found, (Status.UNIDENTIFIABLE, Status.AT_BOUNDARY)), words(found)
        assert "spin is pure: ratios not determined" in found.null_directions


def short_fit(ts, values, sigma):
    return identify.fit(BLIND, identify.Rates(ts, values, sigma), throw=False)


@pytest.mark.slow  # many fits
def test_prolate_bodies_about_equatorial_axes_are_never_ok_and_wrong(rng):
    """Their rate along the axis is hardly determined, and so is not the ratio."""
    ts, wrong = np.arange(60.0), []
    for i in range(100):
        ratio, tilt = np.exp(rng.uniform([0.3, -9.0], [3.0, -2.0]))
        noise, step = np.exp(rng.uniform([-6.9, -0.7], [-3.0, 1.1]))
        tensor = body_of(rng, np.array([1.0, ratio, ratio]))
        omega0 = np.linalg.eigh(tensor)[1] @ np.array([tilt, 0.6, 0.8])
        _, values = seen(rng, tensor, ts * step, noise, omega0)
        found = short_fit(ts * step, values, noise)
        if is_in(found, (Status.OK,)):
            try:
                covers(found, tensor, far=53.0)
            except AssertionError as error:
                wrong.append(f"{i}: {ratio} {tilt} {noise} {step} {error}")
    assert not wrong, "\n".join(wrong)


# Of `worlds.random_record`, each of which tells both ratios to better than a tenth.
TELLING = (
    2311,
    21639,
    21700,
    3261,
    21489,
    2633,
    2941,
    1079,
    3297,
    21189,
    1653,
    21929,
    21976,
    3485,
)
TELLING += (21453, 41, 1520, 1687, 3174, 20312, 2892)


# Six samples in nine turns, of which an alias is followed: it is said to be no answer
COARSE = 21453
# Their parts tell the body, and the turns of the gaps between them follow.
WITH_GAPS = (21639, 21700)


def fit_of_random_record(seed):
    record = worlds.random_record(np.random.default_rng([0, 60, seed]), largest=60)
    found = short_fit(record.ts, record.readings, record.sigma)
    return found, 3 * record.tensor / np.trace(record.tensor)


@pytest.mark.parametrize(
    "seed", [WITH_GAPS[0], pytest.param(WITH_GAPS[1], marks=pytest.mark.slow)]
)
def test_a_record_with_long_gaps_is_fitted_at_the_first_attempt(seed):
    """Dense parts on both sides of a gap in which the body turns by 11 radians or more.

    Attempts that fail take hundreds of steps each.
    """
    found, tensor = fit_of_random_record(seed)
    assert is_in(found, (Status.OK,)), str(found)
    assert np.sum(np.isfinite(found.diagnostics.history)) < 60
    covers(found, tensor, far=53.0)


@pytest.mark.slow  # many fits
@pytest.mark.parametrize("seed", TELLING)
def test_records_that_tell_all_are_fitted(seed):
    found, tensor = fit_of_random_record(seed)
    if seed == COARSE:
        assert is_in(found, (Status.UNIDENTIFIABLE,))
    else:
        assert is_in(found, (Status.OK, Status.UNIDENTIFIABLE)), str(found)
        covers(found, tensor, far=53.0)


def off_by(found, tensor):
    """Squares of the tensor's five numbers, and ratios, in units of their errors."""
    places = [3 * i + j for i, j in FIVE]
    spread = np.asarray(found.inertia_covariance)[:, places][:, :, places]
    error = (np.asarray(found.inertia) - tensor).reshape(-1, 9)[:, places]
    square = np.sum(error * np.linalg.solve(spread, error[..., None])[..., 0], axis=1)
    true = np.linalg.eigvalsh(tensor)
    ratios = (
        np.abs(np.asarray(found.ratios) - true[:, 1:] / true[:, :1])
        / found.ratios_errors
    )
    return square, np.max(ratios, axis=1)


@pytest.mark.parametrize("count", [24, pytest.param(500, marks=pytest.mark.slow)])
def test_random_records_are_never_ok_and_wrong(count):
    """Beyond six of their errors: chi-square of five numbers 53, and each ratio six."""
    draws = (np.random.default_rng([1, seed]) for seed in range(count))
    records = [worlds.random_record(rng, largest=60) for rng in draws]
    tensors = np.stack([3 * x.tensor / np.trace(x.tensor) for x in records])
    readings = [identify.Rates(x.ts, x.readings, x.sigma) for x in records]
    found = identify.fit_each(BLIND, readings)
    ok = np.asarray(found.status == Status.OK)
    square, ratio = off_by(jax.tree.map(lambda x: x[ok], found), tensors[ok])
    good = (square < 53) & (ratio < 6)
    seeds = np.flatnonzero(ok)[~good]
    wrong = [
        f"{x}: {y} {z}"
        for x, y, z in zip(seeds, square[~good], ratio[~good], strict=True)
    ]
    right = int(np.sum(good))
    assert not wrong, "\n".join(wrong)
    assert right > 0.18 * count, right


def test_a_ratio_that_moves_along_a_curved_valley_has_an_error_that_covers_it():
    """Fourteen samples; the body that moved is 10.1 of chi-square from the best one.

    That is 3.2 standard errors. By the covariance alone I3/I1 was 7.1 of them off.
    """
    record = worlds.random_record(np.random.default_rng([7, 347]))
    found = short_fit(record.ts, record.readings, record.sigma)
    assert is_in(found, (Status.OK,))
    true = np.linalg.eigvalsh(record.tensor)
    off = np.abs(found.ratios - true[1:] / true[0]) / found.ratios_errors
    assert 2.5 < np.max(off) < 4, off


@pytest.mark.slow  # a long record
def test_a_prolate_body_about_an_equatorial_axis_for_230_turns(rng):
    """The issue's: 2.283 +- 0.15 was found, 4.295 is true."""
    ts = np.arange(1024) * (230 * 2 * np.pi / 1024)
    program = lambda y: identify.fit(BLIND, identify.Rates(ts, y, 0.014), throw=False)  # noqa: E731
    for tilt in (0.0, 0.0, 0.003, 0.003, 0.01, 0.01):
        tensor = body_of(rng, np.array([1.0, 4.295, 4.295]))
        omega0 = np.linalg.eigh(tensor)[1] @ np.array([tilt, 0.6, 0.8])
        _, values = seen(rng, tensor, ts, 0.014, omega0)
        found = program(values)
        if is_in(found, (Status.OK,)):
            covers(found, tensor)
        else:  # or creeps along the valley
            expected = (Status.UNIDENTIFIABLE, Status.AT_BOUNDARY, Status.NOT_CONVERGED)
            assert is_in(found, expected), words(found)


def test_a_reversed_axis_of_the_gyro_is_that_of_the_mirror_body_which_is_named(rng):
    tensor = body_of(rng)
    _, values = seen(rng, tensor)
    found = fitted(values * np.array([1.0, 1.0, -1.0]))
    assert is_in(found, (Status.OK,)), words(found)
    text = str(found)
    assert (
        "with one axis of the gyro reversed the same record is that of a body" in text
    )
    _, _, named = text.partition("of a body with ")
    ratios = [
        float(part.split(" = ")[1].split()[0])
        for part in named.split("\n")[0].split(", ")
    ]
    np.testing.assert_allclose(ratios, [1.7, 2.3], rtol=0.02)


def test_flat_bodies_are_not_told_to_be_unknown_beside_sharp_ratios(rng):
    for _ in range(6):
        tensor = worlds.random_body(rng, "flat")
        _, values = seen(rng, tensor)
        found = fitted(values, throw=False)
        text = words(found)
        assert is_in(found, (Status.OK, Status.UNIDENTIFIABLE, Status.AT_BOUNDARY)), (
            text
        )
        if found.ratios_errors[1] < 0.05 * found.ratios[1]:
            assert not any("I3/I1" in x for x in found.null_directions), text


def test_the_largest_moment_of_a_body_that_looks_flat_has_its_error(rng):
    """The estimate of a body that is half an error thick is flat in one of two fits.

    The errors of flat estimates are those of the others, whose rows know the thickness.
    """
    moments = 3 * np.array([0.6, 0.9, 1.4994]) / 2.9994
    _, rates = seen(rng, np.diag(moments), sigma=0.0)
    records = [
        identify.Rates(TS, rates + 0.02 * rng.normal(size=rates.shape), 0.02)
        for _ in range(12)
    ]
    found = identify.fit_each(BLIND, records)
    errors = np.asarray(found.moments_errors)
    off = np.asarray(found.moments) - moments
    assert np.all(np.abs(off) < 4.5 * errors)
    flat = np.asarray(found.status == Status.AT_BOUNDARY)
    assert 0 < np.sum(flat) < 12
    size = np.median(errors[~flat, 2])
    assert np.all(errors[flat, 2] > 0.5 * size)
    assert np.all(errors[flat, 2] < 2.0 * size)


def test_moments_by_a_few_samples_are_not_stated_to_ten_digits(rng):
    """Estimates end at flat bodies and rods, whose largest moment is half the trace."""
    ts = np.arange(8) * 0.02
    motion = worlds.tumble(np.diag([1.0, 1.7, 2.2]), np.array([2.0, 6.0, 1.0]), ts)
    true = 3 * np.array([1.0, 1.7, 2.2]) / 4.9
    for _ in range(6):
        values = motion.omega + 0.02 * rng.normal(size=motion.omega.shape)
        found = fitted(values, 0.02, ts, throw=False)
        off = np.asarray(found.moments) - true
        assert np.all(np.abs(off) < 5 * np.asarray(found.moments_errors)), str(found)


# The noise that was stated, or not


@pytest.mark.parametrize("noise", [0.002, 0.02])
def test_a_noise_that_is_not_stated_gives_the_errors_of_one_that_is(noise, rng):
    # The fit begins with a noise of its own, which may be far from the true one.
    ts = np.arange(400) / 200
    start = jr.State(np.array([1.0, 0.0, 0.0, 0.0]), np.array([3.0, 5.0, 2.0]))
    omegas = jr.free_rotation(np.array([1.0, 1.7, 2.3]), start, ts).omega
    omegas = omegas + noise * rng.normal(size=omegas.shape)
    stated, unstated = (
        identify.fit(jr.RigidBody(np.ones(3)), identify.Rates(ts, omegas, sigma))
        for sigma in (noise, None)
    )
    assert unstated.status == Status.OK
    errors = unstated.ratios_errors / stated.ratios_errors
    np.testing.assert_allclose(errors, 1.0, atol=0.1)


def test_a_noise_stated_a_little_too_small_is_a_misfit_and_no_error(rng):
    tensor = body_of(rng)
    _, values = seen(rng, tensor)
    found = fitted(values, 0.01 / 1.3)
    assert is_in(found, (Status.MISFIT,)), words(found)
    covers(found, tensor)
    honest = fitted(values)
    np.testing.assert_allclose(found.ratios_errors, honest.ratios_errors, rtol=0.1)


def in_space(tensor, omega0, ts):
    """Rates along axes at rest."""
    moved = worlds.tumble(tensor, omega0, ts, attitude0=np.array([1.0, 0.0, 0.0, 0.0]))
    return worlds.turned(moved.attitude, moved.omega)


def test_clipped_rates_and_rates_in_space_without_a_noise_stated_are_not_ok(rng):
    for _ in range(3):
        tensor = body_of(rng)
        moved, values = seen(rng, tensor)
        limit = 0.8 * np.abs(moved.omega).max()
        found = fitted(np.clip(values, -limit, limit), None, throw=False)
        text = words(found)
        assert not is_in(found, (Status.OK,)), text
        assert "saturated" in text
        assert "not white" in text

        values = in_space(tensor, moved.omega[0], TS) + 0.01 * rng.normal(
            size=moved.omega.shape
        )
        found = fitted(values, None, throw=False)
        text = words(found)
        assert not is_in(found, (Status.OK,)), text
        assert "not white" in text
        found = fitted(seen(rng, tensor)[1], None)
        assert is_in(found, (Status.OK,)), words(found)
        covers(found, tensor)


@pytest.mark.slow  # a program of its own
def test_a_clipped_gyro_whose_limit_is_given_is_ok(rng):
    for fraction in (0.9, 0.75):
        tensor = body_of(rng)
        moved, values = seen(rng, tensor)
        limit = fraction * np.abs(moved.omega).max()
        record = identify.Record(
            identify.Gyro(limit=limit), TS, np.clip(values, -limit, limit), 0.01
        )
        found = identify.fit(BLIND, record)
        assert is_in(found, (Status.OK,)), words(found)
        covers(found, tensor)


@pytest.mark.parametrize("turned", [1.0, np.pi])
def test_attitudes_that_leap_are_left_out_wherever_they_are(rng, turned):
    """As where markers of a camera are swapped; some leaps begin a segment."""
    ts = np.arange(120) / 30
    start = jr.State(np.array([1.0, 0, 0, 0]), np.array([4.0, 6.0, 3.0]))
    moments = np.array([1.0, 1.12, 1.3])
    attitudes = np.array(jr.free_rotation(moments, start, ts).states.attitude)
    leaps = [7, 20, 55, 90]
    turns = 0.01 * rng.normal(size=(120, 3))
    turns[leaps] = [0.0, turned, 0.0]
    seen = jax.vmap(jr.rotation.multiply)(attitudes, jax.vmap(jr.rotation.exp)(turns))
    found = identify.fit(BLIND, identify.Attitudes(ts, seen, 0.01), loss="robust")
    assert is_in(found, (Status.OK,)), words(found)
    assert list(np.flatnonzero(~np.asarray(found.kept)[0])) == leaps
    covers(found, 3 * np.diag(moments) / np.sum(moments))


def test_many_attitudes_of_swapped_markers_are_left_out(rng):
    """15 % of them, half a turn off, and often several in a row."""
    ts = np.linspace(0.0, 20.0, 200)
    for _ in range(4):
        tensor = body_of(rng)
        start = jr.State(np.array([1.0, 0, 0, 0]), spin_of(rng, tensor, 2.0))
        attitudes = np.array(jr.free_rotation(tensor, start, ts).states.attitude)
        turns = 0.01 * rng.normal(size=(200, 3))
        swapped = rng.choice(200, 30, replace=False)
        turns[swapped] = [0.0, 0.0, np.pi]
        values = jax.vmap(jr.rotation.multiply)(
            attitudes, jax.vmap(jr.rotation.exp)(turns)
        )
        record = identify.Attitudes(ts, values, 0.01)
        found = identify.fit(BLIND, record, loss="robust")
        assert is_in(found, (Status.OK,)), words(found)
        assert not np.any(np.asarray(found.kept)[0, swapped])
        covers(found, tensor)


@pytest.mark.parametrize(("share", "size"), [(0.05, 300.0), (0.05, 1e6), (0.2, 1.0)])
def test_robust_fits_find_their_way_past_any_outliers(rng, share, size):
    """They are judged by their residuals: their size is that of the noise."""
    for _ in range(4):
        tensor = body_of(rng)
        _, values = seen(rng, tensor, sigma=0.02)
        values = np.array(values)
        off = rng.random(len(values)) < share
        values[off] += size * rng.normal(size=(np.sum(off), 3))
        found = fitted(values, 0.02, loss="robust")
        assert is_in(found, (Status.OK,)), words(found)
        assert float(found.diagnostics.scales[0]) == pytest.approx(1.0, abs=0.2)
        # A few outliers are small, and a few good samples are far off.
        assert np.mean(np.asarray(found.kept[0]) == off) < 0.05
        covers(found, tensor)


@pytest.mark.slow  # a program of its own
def test_robust_does_not_trial_all_away_where_the_model_is_wrong(rng):
    """A torque moves the rates by 65 times the noise."""
    tensor = body_of(rng)
    omega0 = spin_of(rng, tensor)
    torque = worlds.wobble_torque(rng, tensor, omega0, 0.1)
    moved, _ = seen(rng, tensor, omega0=omega0, torque=torque)
    free = worlds.tumble(tensor, omega0, TS)
    plain = fitted(moved.omega, None, throw=False)
    error = float(jnp.sqrt(plain.reduced_chi_square)) * 0.02
    sigma = error / 65 if error > 1e-3 else np.std(moved.omega - free.omega) / 65
    values = moved.omega + sigma * rng.normal(size=moved.omega.shape)
    found = fitted(values, sigma, loss="robust", throw=False)
    text = words(found)
    assert int(np.sum(found.kept[0])) > 100, text
    assert int(found.degrees_of_freedom) > 100, text
    assert not is_in(found, (Status.OK,)), text
    assert "times the stated noise" in text


def test_blocks_of_residuals_dealt_out_anew_give_errors(rng):
    tensor = body_of(rng)
    found = fitted(seen(rng, tensor)[1])
    rows = found.linearization()
    shifts = identify.block_bootstrap(*rows, 10, jax.random.key(0), samples=300)
    spread = np.std(np.asarray(shifts), axis=0)
    stated = np.sqrt(np.diagonal(np.asarray(found.covariance)))
    assert np.all(spread > 0.5 * stated)
    assert np.all(spread < 1.5 * stated)
    with pytest.raises(ValueError, match="block"):
        identify.block_bootstrap(*rows, 200, jax.random.key(0))


# Torques


CONSTANT = np.array([0.02, -0.01, 0.015])


def pushed(tensor, drag=0.02):
    del tensor
    return lambda _t, w: CONSTANT - drag * w


def test_a_body_that_turned_a_hundred_times_in_a_gap_is_found_or_ambiguous(rng):
    """One that turned once more or less describes the two parts of a record as well."""
    ts = np.linspace(0.0, 20.0, 100)
    ts = np.concatenate([ts, ts + 1000.0])
    ended = []
    for _ in range(6):
        second = rng.uniform(0.1, 1.0, 3)
        tensor = body_of(rng, np.sum(second) - second)
        _, values = seen(rng, tensor, ts, 0.02)
        found = fitted(values, 0.02, ts)
        assert is_in(found, (Status.OK, Status.UNIDENTIFIABLE)), str(found)
        if is_in(found, (Status.OK,)):
            covers(found, tensor)
        else:
            assert "others far from it are nearly as good" in str(found)
        ended.append(is_in(found, (Status.OK,)))
    assert sum(ended) > 3


@pytest.mark.parametrize("vectors", [1, 2])
def test_vectors_beside_a_gyro_tell_the_attitude(rng, vectors):
    """Of a body at any attitude, without `start`; one vector does not tell a heading."""
    in_space = np.array([[20.0, 0.0, -40.0], [1.0, 2.0, 0.0]])[:vectors]
    for _ in range(5):
        tensor = body_of(rng)
        attitude0 = Rotation.random(random_state=rng.integers(10**6))
        omega0 = spin_of(rng, tensor)
        q0 = attitude0.as_quat(scalar_first=True)
        moved = worlds.tumble(tensor, omega0, TS, attitude0=q0)
        back = Rotation.from_quat(moved.attitude, scalar_first=True).inv()
        bias = np.array([2.0, -1.0, 3.0])
        field = back.apply(in_space[0]) + bias + 0.5 * rng.normal(size=(200, 3))
        rates = moved.omega + 0.01 * rng.normal(size=(200, 3))
        records = [
            identify.Rates(TS, rates, 0.01),
            identify.Record(identify.Magnetometer(in_space[0]), TS, field, 0.5),
        ]
        if vectors == 2:
            shown = back.apply(in_space[1] / np.sqrt(5)) + 0.01 * rng.normal(
                size=(200, 3)
            )
            shown /= np.linalg.norm(shown, axis=1, keepdims=True)
            records.append(identify.Directions(TS, shown, 0.01, of=in_space[1]))
        found = identify.fit(
            BLIND, tuple(records), free=lambda _body, _gyro, field, *_: field.bias
        )
        assert is_in(found, (Status.OK,)), str(found)
        covers(found, tensor)
        value, error = found.estimates["magnetometer.bias"]
        assert np.all(np.abs(value - bias) < 5 * error)
        off = (
            Rotation.from_quat(found.state.attitude, scalar_first=True)
            * attitude0.inv()
        )
        size = np.linalg.norm(in_space[0])
        assert np.linalg.norm(off.apply(in_space[0]) - in_space[0]) < 0.02 * size
        if vectors == 2:
            assert off.magnitude() < 0.02


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_turn_between_vectors_is_the_smallest(rng, count):
    start = rng.normal(size=(count, 3))
    start /= np.linalg.norm(start, axis=1, keepdims=True)
    turn = Rotation.random(random_state=rng.integers(10**6))
    end = turn.apply(start)
    found = Rotation.from_quat(_turn_between(start, end), scalar_first=True)
    np.testing.assert_allclose(found.apply(start), end, atol=1e-5)
    if count == 1:
        angle = np.arccos(np.sum(start * end))
        np.testing.assert_allclose(found.magnitude(), angle, atol=1e-5)


def test_ratios_have_errors_where_the_axes_have_none(rng):
    """The body may be turned about a mark on it, which no direction of the mark shows.

    The errors are those of a Fisher matrix by differences of scipy's motions, with the
    turn left out.
    """
    mark = np.array([0.0, 0.6, 0.8])
    ts = TS[::2]
    tensor = body_of(rng)
    omega0 = spin_of(rng, tensor)
    upright = np.array([1.0, 0.0, 0.0, 0.0])

    def shown(change):
        moments, axes = np.linalg.eigh(tensor)
        moments = moments * np.exp(np.append(0.0, change[:2]))
        axes = axes @ Rotation.from_rotvec(change[2:5]).as_matrix()
        first = omega0 + change[5:8]
        turn = Rotation.from_rotvec(change[8:11])
        inertia = axes @ np.diag(moments) @ axes.T
        moved = worlds.tumble(inertia, first, ts, attitude0=upright)
        attitudes = Rotation.from_quat(moved.attitude, scalar_first=True)
        return (turn * attitudes).apply(mark)

    steps = 1e-4 * np.eye(11)
    slopes = np.stack([(shown(x) - shown(-x)).ravel() / 2e-4 for x in steps], axis=1)
    covariance = np.linalg.pinv(slopes.T @ slopes / 0.01**2, rcond=1e-10)
    moments = np.linalg.eigvalsh(tensor)
    errors = np.sqrt(np.diag(covariance)[:2]) * moments[1:] / moments[0]

    values = shown(np.zeros(11))
    off = 0.01 * rng.normal(size=values.shape)
    off -= np.sum(off * values, axis=1, keepdims=True) * values
    values = (values + off) / np.linalg.norm(values + off, axis=1, keepdims=True)
    record = identify.Directions(ts, values, 0.01, of=mark, frame="space")
    start = (tensor, jr.State(upright, omega0))
    found = identify.fit(BLIND, record, start=start, throw=False)
    assert is_in(found, (Status.UNIDENTIFIABLE,)), str(found)
    np.testing.assert_allclose(found.ratios_errors, errors, rtol=0.1)
    far = np.abs(found.ratios - moments[1:] / moments[0]) / errors
    assert np.all(far < 4), str(found)
    assert "equal within their errors" not in str(found)
    low, high = np.asarray(found.ratios_intervals)
    assert np.all((low >= 1) & (low < found.ratios) & (found.ratios < high))


@pytest.mark.slow  # a program of its own
def test_a_known_thruster_and_a_known_drag_tell_the_tensor_blind(rng):
    """Or it is said why they do not."""
    system = jr.RigidBody(
        np.ones(3), jr.torques.Constant(CONSTANT) + jr.torques.LinearDrag(0.02)
    )
    ended = []
    for _ in range(5):
        tensor = rng.uniform(0.5, 2.0) * body_of(rng, np.exp(rng.uniform(0, 0.6, 3)))
        _, values = seen(rng, tensor, torque=pushed(tensor))
        found = identify.fit(system, identify.Rates(TS, values, 0.01), scale="known")
        text = words(found)
        assert is_in(found, (Status.OK, *SAYS_WHY)), text
        if is_in(found, (Status.OK,)):
            covers(found, tensor, absolute=True)
        ended.append(is_in(found, (Status.OK,)))
    assert sum(ended) >= 3


@pytest.mark.slow  # a program of its own
def test_a_drag_that_is_not_there_ends_at_none(rng):
    """Noise alone would make it negative half of the time."""
    system = jr.RigidBody(np.ones(3), jr.torques.LinearDrag(0.1))
    for drag in (0.0, 0.0, 0.001, 0.02):
        tensor = body_of(rng)
        _, values = seen(rng, tensor, torque=lambda _t, w, c=drag: -c * w)
        found = identify.fit(
            system,
            identify.Rates(TS, values, 0.01),
            free=lambda body: body.torque.coefficient,
        )
        text = words(found)
        value, error = (float(x) for x in found.estimates["torque.coefficient"])
        assert value >= 0
        # A drag of zero has the error of one that might be negative.
        assert 0 < error < 0.01, text
        assert abs(value - drag) < 5 * error + 1e-4, text
        covers(found, tensor)
        assert "overall scale, which what is sought of the torque follows" in text
        if drag > 0.01:
            assert is_in(found, (Status.OK,)), text


def test_a_coefficient_that_ends_at_zero_takes_part_in_the_errors_of_the_others():
    """A body that spins about one axis hardly tells its drags about the other two."""
    turn = Rotation.from_rotvec([0.0, 0.045, 0.15]) * Rotation.from_rotvec(
        [0.0, np.pi / 2, 0.0]
    )
    turn = turn.as_matrix()
    tensor = turn @ np.diag([0.24, 0.338, 0.422]) @ turn.T
    drag = np.array([0.0056, 0.0070, 0.0243])
    ts = np.linspace(0, 10, 151)
    spin = turn @ np.array([-0.37, 0.03, 4.99])
    moved = worlds.tumble(tensor, spin, ts, torque=lambda _t, w: -drag * w)
    rng = np.random.default_rng(0)
    noise = 0.02 * rng.normal(size=(12, *moved.omega.shape))
    body = jr.RigidBody(np.ones(3) / 3, jr.torques.LinearDrag(0.01 * np.ones(3)))
    found = identify.fit_each(
        body,
        [identify.Rates(ts, moved.omega + x, 0.02) for x in noise],
        free=lambda body: body.torque.coefficient,
    )
    assert np.all(found.status == Status.OK)
    pulls = []
    vanished = 0
    for i in range(12):
        one = jax.tree.map(lambda x, i=i: x[i], found)
        value, error = one.estimates["torque.coefficient"]
        vanished += np.sum(value < 1e-4)
        pulls.append((value - drag) / error)
    assert vanished > 3
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 1.6


@pytest.mark.slow  # a program of its own
def test_a_drag_sought_as_a_tensor_stays_one(rng):
    system = jr.RigidBody(np.ones(3), jr.torques.LinearDrag(0.05 * np.eye(3)))
    for i in range(3):
        tensor = body_of(rng)
        drag = 0.02 * body_of(rng, np.array([1.0, 2.0, 3.0]))
        if i == 2:  # none about one axis
            drag = worlds.random_axes(rng)
            drag = 0.02 * drag @ np.diag([0.0, 1.0, 2.0]) @ drag.T
        torque = lambda _t, w, c=drag: -worlds.times(c, w)  # noqa: E731
        _, values = seen(rng, tensor, torque=torque, sigma=0.003)
        found = identify.fit(
            system,
            identify.Rates(TS, values, 0.003),
            free=lambda body: body.torque.coefficient,
            throw=False,
        )
        text = words(found)
        assert is_in(found, (Status.OK, Status.UNIDENTIFIABLE)), text
        value, error = (np.asarray(x) for x in found.estimates["torque.coefficient"])
        np.testing.assert_allclose(value, value.T, rtol=1e-12)
        assert np.linalg.eigvalsh(value)[0] > -1e-12
        assert np.all(np.abs(value - drag) < 5 * error + 1e-4), (
            f"{value} {error} {drag} {text}"
        )


@pytest.mark.slow  # a program of its own
def test_a_drag_alone_does_not_tell_scale_and_itself(rng):
    system = jr.RigidBody(np.ones(3), jr.torques.LinearDrag(0.05))
    tensor = body_of(rng)
    _, values = seen(rng, tensor, torque=lambda _t, w: -0.02 * w)
    found = identify.fit(
        system,
        identify.Rates(TS, values, 0.01),
        free=lambda body: body.torque.coefficient,
        scale="known",
    )
    text = words(found)
    assert is_in(found, (Status.UNIDENTIFIABLE,)), text
    assert any("overall scale" in x for x in found.null_directions), text
    assert int(np.sum(np.isfinite(found.diagnostics.history))) < 200
    assert abs(float(found.ratios[1]) - 2.3) < 5 * float(found.ratios_errors[1])


# A torque that no model has


@pytest.mark.slow  # a program of its own, of many stages
@pytest.mark.parametrize("sigma", [0.01, None])
def test_a_torque_that_no_model_has_is_estimated(sigma, rng):
    """White, then smooth, then none; beside a noise that is stated or sought."""
    for kind in ("white", "smooth", "none"):
        tensor = body_of(rng)
        omega0 = spin_of(rng, tensor)
        torque = (
            worlds.wobble_torque(rng, tensor, omega0, 0.03)
            if kind == "smooth"
            else None
        )
        kick = 0.02 if kind == "white" else 0.0
        _, values = seen(rng, tensor, omega0=omega0, torque=torque, kick=kick)
        found = fitted(values, sigma, unmodelled="estimate")
        text = words(found)
        assert is_in(found, (Status.OK,)), text
        covers(found, tensor)
        level, error = float(found.level[0]), float(found.level_errors[0])
        if kind == "white":
            assert abs(level - kick) < 5 * error, text
        if kind == "none":
            assert level < 3 * error, text
        if kind == "smooth":
            assert level > 3 * error, text


def test_what_no_fit_answers_is_refused(untyped):
    rates = functools.partial(identify.Rates, TS, np.ones((200, 3)))
    with pytest.raises(ValueError, match="`unmodelled` must be 0 or estimated"):
        identify.fit(BLIND, rates(), unmodelled=0.1)
    with pytest.raises(ValueError, match=r"`covariance` .* beside a sensor's `limit`"):
        identify.Record(
            identify.Gyro(limit=2.0), TS, np.ones((200, 3)), covariance=np.eye(3)
        )


# Sensors


def test_the_drift_of_a_gyro_begins_with_its_record():
    state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    drifting = identify.Gyro(drift=jnp.ones(3))
    for since, late in ((None, 2.0), (1e9 + 1.0, 1.0)):
        sensor = identify.Gyro(drift=jnp.ones(3), since=since)
        record = identify.Record(sensor, 1e9 + np.arange(3.0), np.zeros((3, 3)), 0.1)
        rows = identify.residuals(BLIND, state, record, t0=1e9)
        np.testing.assert_allclose(rows[0, -3:], late / 0.1)
    np.testing.assert_array_equal(
        drifting.predict(jnp.asarray(3.0), state, BLIND), 3 * np.ones(3)
    )


def gyro_of(rng, moved, ts, sigma, **errors):
    """Readings of a motion on a grid that leads and ends with them."""
    return worlds.gyro((moved.ts, moved.omega), ts, rng, sigma, **errors)


def grid_for(ts, lead=3.0, fine=10):
    step = (ts[1] - ts[0]) / fine
    before = int(np.ceil(lead / step))
    return ts[0] + np.arange(-before, (len(ts) - 1) * fine + 1) * step


@pytest.mark.slow  # a program of its own
@pytest.mark.parametrize("name", ["time_constant", "scale", "bias", "drift"])
def test_errors_of_a_gyro_are_found(name, rng):
    true = {"time_constant": 0.2, "scale": 1.02, "bias": 0.02, "drift": 0.001}[name]
    sensor = identify.Gyro(time_constant=0.05 if name == "time_constant" else None)

    def free(_, gyro):
        picked = getattr(gyro, name)
        return identify.prior(picked, 0.05) if name == "bias" else picked

    grid, epoch = (
        grid_for(TS),
        1.7e9 if name == "drift" else 0.0,
    )  # of a telephone's clock
    for _ in range(2):
        tensor = body_of(rng)
        moved = worlds.tumble(tensor, spin_of(rng, tensor), grid)
        errors = {"matrix": true * np.eye(3)} if name == "scale" else {name: true}
        values = gyro_of(rng, moved, TS, 0.005, **errors)
        record = identify.Record(sensor, epoch + TS, values, 0.005)
        found = identify.fit(BLIND, record, free=free)
        assert is_in(found, (Status.OK,)), words(found)
        covers(found, tensor)
        # The memory of the filter is a quadrature.
        near(found, f"gyro.{name}", true)


@pytest.mark.slow  # a program of its own
def test_a_delay_of_a_gyro_alone_is_the_state_s_and_the_ratios_are_told_all_the_same(
    rng,
):
    """Free motion a little later is free motion."""
    grid = grid_for(TS)
    for _ in range(6):
        tensor = body_of(rng)
        moved = worlds.tumble(tensor, spin_of(rng, tensor), grid)
        values = gyro_of(rng, moved, TS, 0.005, delay=0.15)
        record = identify.Record(identify.Gyro(delay=0.0), TS, values, 0.005)
        found = identify.fit(BLIND, record, free=lambda _, gyro: gyro.delay)
        text = words(found)
        assert is_in(found, (Status.OK,)), text
        assert found.determined == {"inertia": True, "gyro.delay": False}
        assert "does not determine gyro.delay" in text.splitlines()[0]
        assert "gyro delay" in found.null_directions
        assert np.all(found.ratios_errors < 0.02), text


@pytest.mark.slow  # a program of its own
def test_a_delay_of_half_a_sample_beside_attitudes(rng):
    tensor = body_of(rng)
    grid = grid_for(TS)
    start = np.array([1.0, 0.0, 0.0, 0.0])
    moved = worlds.tumble(tensor, spin_of(rng, tensor), grid, attitude0=start)
    values = gyro_of(rng, moved, TS, 0.005, delay=0.15)
    at = np.searchsorted(grid, TS - 1e-9)
    small = 0.01 * rng.normal(size=(len(TS), 3))
    turn = jax.vmap(lambda q, v: jr.rotation.multiply(q, jr.rotation.exp(v)))
    looks = turn(moved.attitude[at], small)
    records = (
        identify.Record(identify.Gyro(delay=0.0), TS, values, 0.005),
        identify.Attitudes(TS, looks, 0.01),
    )
    found = identify.fit(BLIND, records, free=lambda _, gyro: gyro.delay)
    assert is_in(found, (Status.OK,)), words(found)
    covers(found, tensor)
    near(found, "gyro.delay", 0.15)


@pytest.mark.slow  # a program of its own
def test_a_lever_of_an_accelerometer_beside_a_gyro(rng):
    lever, sigma = np.array([0.03, -0.05, 0.02]), 0.003
    tensor = body_of(rng)
    moved, values = seen(rng, tensor)
    force = worlds.accelerometer(moved, lever, rng, sigma, bias=0.01)
    records = (
        identify.Rates(TS, values, 0.01),
        identify.Record(identify.Accelerometer(np.zeros(3)), TS, force, sigma),
    )
    found = identify.fit(BLIND, records, free=lambda _, __, box: (box.lever, box.bias))
    assert is_in(found, (Status.OK,)), words(found)
    covers(found, tensor)
    near(found, "accelerometer.lever", lever)
    near(found, "accelerometer.bias", 0.01)


@pytest.mark.slow  # a program of its own
def test_a_magnetometer_of_an_unknown_field_beside_a_gyro(rng):
    """Its field is in space axes, which the start sets."""
    field, sigma = np.array([20.0, 5.0, -40.0]), 0.5
    tensor = body_of(rng)
    start = np.array([1.0, 0.0, 0.0, 0.0])
    moved, values = seen(rng, tensor, attitude0=start)
    back = moved.attitude * np.array([1.0, -1.0, -1.0, -1.0])
    shown = worlds.turned(back, field) + sigma * rng.normal(size=moved.omega.shape)
    shown += np.array([3.0, 0.0, -2.0])
    records = (
        identify.Rates(TS, values, 0.01),
        identify.Record(
            identify.Magnetometer(np.array([1.0, 1.0, -1.0])), TS, shown, sigma
        ),
    )
    free = lambda _, __, compass: (compass.field, compass.bias)  # noqa: E731
    with pytest.raises(ValueError, match="start"):
        identify.fit(BLIND, records, free=free)
    found = identify.fit(BLIND, records, free=free, start=jr.State(start, np.zeros(3)))
    text = words(found)
    near(found, "magnetometer.bias", np.array([3.0, 0.0, -2.0]))
    size, _ = found.estimates["magnetometer.field"]
    assert abs(np.linalg.norm(size) - np.linalg.norm(field)) < 1.0, text
    # Attitude and field turn together.
    assert is_in(found, (Status.OK,)), text
    assert not found.determined["magnetometer.field"]
    assert found.determined["magnetometer.bias"]
    assert "magnetometer field" in found.null_directions
    covers(found, tensor)


SHORT = np.arange(60) * 0.3
SEVERAL = 4


def trials_of(rng, tensors, **errors):
    """A record of each body, three turns, with errors of the gyro.

    The errors are each trial's own if they are a list.
    """
    records = []
    grid = grid_for(SHORT)
    for i, tensor in enumerate(tensors):
        moved = worlds.tumble(tensor, spin_of(rng, tensor), grid)
        own = {k: v[i] if isinstance(v, list) else v for k, v in errors.items()}
        records.append(
            identify.Rates(SHORT, gyro_of(rng, moved, SHORT, 0.01, **own), 0.01)
        )
    return records


@pytest.mark.slow  # a program of its own
def test_a_bias_of_each_trial(rng):
    tensor, biases = body_of(rng), list(0.05 * rng.normal(size=(SEVERAL, 3)))
    records = trials_of(rng, [tensor] * SEVERAL, bias=biases)
    found = identify.fit(BLIND, records, free=lambda _, gyro: identify.each(gyro.bias))
    assert is_in(found, (Status.OK,)), words(found)
    covers(found, tensor)
    near(found, "gyro.bias", np.stack(biases))


@pytest.mark.slow  # two programs of their own
@pytest.mark.parametrize("sought", [False, True])
def test_a_wheel_as_each_trial_recorded_it(sought, rng):
    """With 1 % of scale and 5 ms of delay in the record, sought or none."""
    spin, sigma, ts = 5.0, 0.02, np.arange(60) * 0.02
    tensor = body_of(rng)
    scale, delay = (1.01, 0.005) if sought else (1.0, 0.0)
    systems, records = [], []
    for i in range(3):
        true, predicted = worlds.wheel_profile(
            rng.normal(size=3), 1.5, 0.1 + 0.1 * i, 0.6, scale, delay
        )
        moved = worlds.tumble(tensor, spin_of(rng, tensor, spin), ts, wheel=true)
        values = moved.omega + sigma * rng.normal(size=moved.omega.shape)
        clock = np.arange(61 + i) * 0.02  # of another length in each trial
        wheel = jr.torques.Rotor(jr.torques.Sampled(clock, predicted(clock)[0]))
        systems.append(jr.RigidBody(np.ones(3), wheel))
        records.append(identify.Rates(ts, values, sigma))
    free = None
    if sought:
        free = lambda body: (  # noqa: E731
            identify.prior(body.torque.momentum.scale, 0.02),
            body.torque.momentum.delay,
        )
    found = identify.fit(systems, records, scale="rotor", free=free)
    text = words(found)
    assert is_in(found, (Status.OK,)), text
    covers(found, tensor, absolute=True, far=33.0)
    if sought:
        near(found, "torque.momentum.scale", 1 / scale)
        near(found, "torque.momentum.delay", -delay)


@pytest.mark.slow  # a program of its own
def test_lanes_are_what_they_are_alone(rng):
    """A bias sought in 64 records at once."""
    records = []
    for _ in range(64):
        tensor = body_of(rng)
        records.append(seen(rng, tensor, SHORT)[1] + 0.02 * rng.normal(size=3))

    readings = [identify.Rates(SHORT, x, 0.01) for x in records]
    free = lambda _, gyro: gyro.bias  # noqa: E731
    together = identify.fit_each(BLIND, readings, free=free)
    for i, x in enumerate(readings):
        alone = identify.fit(BLIND, x, free=free, throw=False)
        assert bool(alone.status == jax.tree.map(lambda y, i=i: y[i], together.status))
        np.testing.assert_allclose(
            together.inertia[i], alone.inertia, rtol=1e-6, atol=1e-9
        )
        np.testing.assert_allclose(together.chi_square[i], alone.chi_square, rtol=1e-6)


@pytest.mark.parametrize(
    ("factor", "text"), [(50.0, "is too large"), (0.02, "is too small")]
)
def test_a_noise_that_is_stated_wrongly_is_named_in_the_first_line(factor, text, rng):
    tensor = body_of(rng)
    _, values = seen(rng, tensor)
    found = identify.fit(BLIND, identify.Rates(TS, values, 0.01 * factor), throw=False)
    assert is_in(found, (Status.MISFIT,)), str(found)
    first, *_ = str(found).splitlines()
    assert text in first, first
    assert "sigma" in first, first


def test_a_rotor_beside_a_scale_that_is_kept_is_refused():
    body = jr.RigidBody(np.ones(3), jr.torques.Rotor(np.array([0.0, 0.0, 0.1])))
    with pytest.raises(ValueError, match="`scale` must be 'rotor' for a system with a"):
        identify.fit(body, identify.Rates(TS, np.ones((200, 3)), 0.01))


def test_a_tensor_that_is_known_has_no_numbers_and_its_state_is_found(rng):
    tensor = body_of(rng)
    moved, values = seen(rng, tensor)
    record = identify.Rates(TS, values, 0.01)
    found = identify.fit(jr.RigidBody(tensor), record, inertia_model=identify.Fixed())
    assert is_in(found, (Status.OK,)), words(found)
    assert found.numbers.shape == (0,)
    np.testing.assert_allclose(found.inertia, tensor)
    errors = np.sqrt(np.diagonal(found.covariance))
    assert np.all(np.abs(found.state.omega[0] - moved.omega[0]) < 5 * errors)


def test_attitudes_are_also_those_of_a_body_that_turns_the_other_way(rng):
    """Of a body near a sphere, which turns by 4.2 radians from one to the next."""
    moments = np.array([1.0, 1.1, 1.3])
    omega0 = jnp.array([2.7, 2.52, 7.38])
    ts = np.linspace(0, 20, 40)
    state = jr.State(jr.rotation.identity(), omega0)
    attitudes = jr.free_rotation(moments, state, ts).attitude
    noise = jax.vmap(jr.rotation.exp)(jnp.asarray(0.01 * rng.normal(size=(40, 3))))
    seen = jax.vmap(jr.rotation.multiply)(attitudes, noise)
    record = identify.Attitudes(ts, np.asarray(seen), 0.01)
    found = identify.fit(BLIND, record)
    assert found.status == Status.UNIDENTIFIABLE, str(found)
    assert "turns the other way round" in str(found)
    found = identify.fit(BLIND, record, start=state)
    assert found.status == Status.OK, str(found)
    ratios = moments[1:] / moments[0]
    assert np.all(np.abs(found.ratios - ratios) < 4 * found.ratios_errors), str(found)
