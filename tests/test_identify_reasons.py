"""The first line of a report names what is wrong with a request, and what to pass."""

import re
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import worlds
from helpers import ATTITUDE, reference_attitude
from jaxtyping import Array, Float
from scipy.integrate import solve_ivp

import jrigid as jr
from jrigid import identify
from jrigid.identify import Status
from jrigid.identify import _conventions as conventions
from jrigid.identify import _host as host
from jrigid.identify._reasons import reason

MOMENTS = np.array([0.5, 0.8, 1.0])
BLIND = jr.RigidBody(np.ones(3))
TS = np.arange(200) * 0.01
NOISE = 0.02
DEGREES = 180 / np.pi
SLOW = [0.4, 0.9, 0.5]  # rad/s
in_body_axes = jax.vmap(jr.rotation.rotate_inverse, (0, None))


def solved(ts, omega0, drag=0.0):
    """Rates of a body as a function of time, by scipy."""

    def euler(_, omega):
        return (np.cross(MOMENTS * omega, omega) - drag * omega) / MOMENTS

    accuracy = {"rtol": 1e-10, "atol": 1e-10}
    span = ts[[0, -1]]
    return solve_ivp(euler, span, omega0, "DOP853", dense_output=True, **accuracy).sol


def motion(ts):
    """Rates of a free body."""
    return solved(ts, [6.0, 5.0, -6.0])(ts).T


def first_line(values, sigma, **options):
    found = identify.fit(
        BLIND, identify.Rates(TS, values, sigma), throw=False, **options
    )
    return found, str(found).splitlines()[0]


@pytest.fixture
def readings(rng):
    return motion(TS) + NOISE * rng.normal(size=(TS.size, 3))


def test_nothing_is_said_of_a_record_that_obeys_its_model(readings):
    found, line = first_line(readings, NOISE)
    assert found.status == Status.OK
    assert line == f"OK: {Status[found.status]}"


def test_degrees_for_radians_are_named(readings):
    """The body turns by five turns between samples: no fit is tried."""
    found, line = first_line(DEGREES * readings, DEGREES * NOISE)
    assert found.status == Status.BAD_INPUT
    assert "degrees a second" in line
    assert "pi / 180" in line


def test_a_record_of_three_samples_is_named(readings):
    readings[3:] = np.nan
    found, line = first_line(readings, NOISE)
    assert found.status == Status.BAD_INPUT
    assert "`observations` must hold 12 numbers at least" in line


def test_degrees_for_radians_are_named_where_samples_are_dense(rng):
    """A body whose rates change 57 times too slowly is nearly a sphere."""
    ts = np.linspace(0, 2, 1000)
    values = motion(ts) + NOISE * rng.normal(size=(ts.size, 3))
    readings = identify.Rates(ts, DEGREES * values, DEGREES * NOISE)
    found = identify.fit(BLIND, readings, throw=False)
    assert "degrees a second" in str(found).splitlines()[0]
    assert found.ratios[1] < 1.03


def test_a_body_at_rest_is_named(rng):
    bias = np.array([0.3, -0.2, 0.1])
    readings = bias + NOISE * rng.normal(size=(TS.size, 3))
    record = identify.Record(identify.Gyro(jnp.asarray(bias)), TS, readings, NOISE)
    found = identify.fit(BLIND, record, throw=False)
    assert "The body does not turn" in str(found).splitlines()[0]
    assert found.status != Status.OK


def test_radians_converted_as_if_they_were_degrees_are_named(readings):
    found, line = first_line(readings / DEGREES, NOISE / DEGREES)
    assert found.status != Status.OK
    assert re.search(r"swing \d+ times as fast as the body turns", line)
    assert "rad/s" in line


@pytest.mark.parametrize(("factor", "text"), [(50, "too large"), (0.02, "too small")])
def test_a_sigma_of_another_size_is_named(readings, factor, text):
    found, line = first_line(readings, factor * NOISE)
    assert found.status == Status.MISFIT
    assert f"`sigma` is {text}" in line


def short_record(rng, count=30, turned=1.5):
    """Readings while a body turns by so many radians."""
    ts = np.linspace(0, turned / np.linalg.norm([6.0, 5.0, -6.0]), count)
    return ts, motion(ts) + NOISE * rng.normal(size=(count, 3))


def test_a_short_record_shows_no_swing(rng):
    """Its trend looks like a period as long as the record."""
    ts, values = short_record(rng)
    for sigma in (NOISE, None):
        found = identify.fit(BLIND, identify.Rates(ts, values, sigma), throw=False)
        assert "swing" not in str(found), found


def test_a_sigma_that_is_too_small_is_named_in_a_short_record(rng):
    ts, values = short_record(rng)
    found = identify.fit(BLIND, identify.Rates(ts, values, NOISE / 50), throw=False)
    assert found.status != Status.OK
    assert "`sigma` is too small" in str(found).splitlines()[0]


@pytest.mark.parametrize("count", [30, 200])
def test_a_sigma_that_hides_the_inertia_is_named(rng, count):
    """A slow body, whose rates are about as large as the noise that is stated."""
    ts = np.arange(count) * 0.1
    values = solved(ts, [2.0, 0.7, 1.5])(ts).T + 0.01 * rng.normal(size=(count, 3))
    found = identify.fit(BLIND, identify.Rates(ts, values, 0.01), throw=False)
    assert found.status == Status.OK
    found = identify.fit(BLIND, identify.Rates(ts, values, 1.0), throw=False)
    assert found.status != Status.OK
    assert "`sigma` is too large" in str(found).splitlines()[0]


def test_a_sigma_that_an_estimated_torque_hides_is_named(readings):
    found, line = first_line(readings, NOISE / 50, unmodelled="estimate")
    assert found.reduced_chi_square < 1.3
    assert "`sigma` is too small" in line
    found, line = first_line(readings, NOISE, unmodelled="estimate")
    assert line == f"OK: {Status[found.status]}"


def test_a_trial_of_another_body_is_named_by_a_plain_fit(rng):
    ts = TS[::2]
    trials = []
    for index in range(6):
        spin = 8 * worlds.random_axes(rng)[0]
        tensor = np.diag(MOMENTS * ([1.1, 1, 1] if index == 3 else 1.0))
        omega = worlds.tumble(tensor, spin, ts).omega
        noise = NOISE * rng.normal(size=omega.shape)
        trials.append(identify.Rates(ts, omega + noise, NOISE))
    found = identify.fit(BLIND, trials, throw=False)
    assert found.status == Status.MISFIT
    line = str(found).splitlines()[0]
    assert "Chi-square of trial 3 (from 0)" in line
    assert 'loss="robust"' in line
    found = identify.fit(BLIND, trials, loss="robust", throw=False)
    np.testing.assert_array_equal(np.flatnonzero(found.rejected_trials), [3])


def test_a_scale_that_a_known_drag_needs_is_named(rng):
    drag = 0.3
    body = jr.RigidBody(3 * MOMENTS, jr.torques.LinearDrag(jnp.full(3, drag)))
    omega = solved(TS, [6.0, 5.0, -6.0], drag)(TS).T
    record = identify.Rates(TS, omega + NOISE * rng.normal(size=omega.shape), NOISE)
    found = identify.fit(body, record, throw=False)
    assert found.status == Status.MISFIT
    assert 'scale="known"' in str(found).splitlines()[0]
    found = identify.fit(body, record, scale="known", throw=False)
    assert found.status == Status.OK
    assert "scale=" not in str(found).splitlines()[0]


@pytest.mark.parametrize("size", [0.05, 0.3, 2.0])
def test_a_bias_that_is_not_sought_is_named(readings, size):
    bias = size * np.array([1.0, -0.7, 0.4])
    found, line = first_line(readings + bias, NOISE)
    assert found.status == Status.MISFIT
    numbers = re.search(r"A bias of the gyro, some \((.*)\) rad/s", line)
    assert numbers, line
    assert "gyro.bias" in line
    named = np.array([float(x) for x in numbers.group(1).split(",")])
    assert np.linalg.norm(named - bias) < 0.6 * np.linalg.norm(bias)


@pytest.mark.parametrize("lag", [0.008, 0.012])
def test_a_filter_that_is_left_out_is_named(rng, lag):
    """The residuals of the shorter one are no more than noise."""
    sigma = 0.002
    filtered = worlds.gyro(motion, TS, rng, sigma, time_constant=lag)
    found, line = first_line(filtered, sigma)
    assert found.status == Status.MISFIT
    named = re.search(
        r"time constant of some ([\d.]+) s would explain the residuals", line
    )
    assert named, line
    assert float(named.group(1)) == pytest.approx(lag, rel=0.15)
    assert "`Gyro(time_constant=...)`" in line
    truth = MOMENTS[1:] / MOMENTS[0]
    assert np.all(np.abs(found.ratios - truth) < found.ratios_errors)
    direct, _ = first_line(motion(TS) + sigma * rng.normal(size=filtered.shape), sigma)
    assert direct.status == Status.OK
    assert abs(direct.diagnostics.lag[1]) < 4


def test_a_filter_is_named_beside_a_drag_that_is_sought(rng):
    """A change of the states takes up the delay of the filter under a drag, too."""
    sigma = 0.002
    drag = 0.01
    lag = 0.012

    def slope(_, values):
        omega, reading = values[:3], values[3:]
        torque = np.cross(MOMENTS * omega, omega) - drag * omega
        return np.concatenate([torque / MOMENTS, (omega - reading) / lag])

    start = np.array([6.0, 5.0, -6.0] * 2)
    # A filter has forgotten its start after 20 time constants.
    ts = TS + 20 * lag
    solution = solve_ivp(slope, (0, ts[-1]), start, "DOP853", ts, rtol=1e-10)
    values = solution.y[3:].T + sigma * rng.normal(size=(TS.size, 3))
    found = identify.fit(
        jr.RigidBody(np.ones(3), jr.torques.LinearDrag(0.02)),
        identify.Rates(TS, values, sigma),
        free=lambda body, _: body.torque.coefficient,
        throw=False,
    )
    assert "A low-pass filter" in str(found).splitlines()[0]
    assert float(found.diagnostics.lag[0]) == pytest.approx(lag, rel=0.1)
    # It explains all of the excess of chi-square.
    excess = float(found.chi_square) - int(found.degrees_of_freedom)
    assert float(found.diagnostics.lag[1]) ** 2 == pytest.approx(excess, abs=150)


@pytest.mark.parametrize("factor", [0.98, 1.02])
def test_a_scale_that_is_left_out_is_named_and_is_no_filter(rng, factor):
    """A filter would explain 0.7 of the excess of a gyro that reads too little."""
    sigma = 0.002
    values = factor * motion(TS) + sigma * rng.normal(size=(TS.size, 3))
    found, line = first_line(values, sigma)
    assert found.status == Status.MISFIT
    named = re.search(r"scale of the gyro that is ([\d.]+) times as large", line)
    assert named, line
    assert float(named.group(1)) == pytest.approx(factor, abs=0.003)
    assert float(found.diagnostics.gain[0]) == pytest.approx(factor, abs=0.003)
    truth = MOMENTS[1:] / MOMENTS[0]
    assert np.all(np.abs(found.ratios - truth) < 1.5 * found.ratios_errors)


@pytest.mark.parametrize("delay", [0.004, -0.004])
def test_a_delay_after_another_gyro_is_named(rng, delay):
    sigma = 0.002
    ts = np.union1d(TS, TS - delay)
    both = motion(ts)
    late = both[np.isin(ts, TS - delay)]
    values = [
        x + sigma * rng.normal(size=x.shape) for x in (late, both[np.isin(ts, TS)])
    ]
    records = tuple(identify.Rates(TS, x, sigma) for x in values)
    found = identify.fit(BLIND, records, throw=False)
    assert found.status == Status.MISFIT
    line = str(found).splitlines()[0]
    named = re.search(r"A delay of the gyro by some ([-\d.]+) s", line)
    assert named, line
    assert float(named.group(1)) == pytest.approx(delay, rel=0.05)


def test_a_bias_that_is_left_out_is_no_filter(rng):
    """A filter would explain 0.9 of the excess that this bias makes."""
    sigma = 0.002
    bias = np.array([0.0, 0.0, 0.03])
    values = motion(TS) + bias + sigma * rng.normal(size=(TS.size, 3))
    found, line = first_line(values, sigma)
    assert found.diagnostics.lag[1] > 6
    named = re.search(r"A bias of the gyro, some \((.*)\) rad/s", line)
    assert named, line
    seen = [float(x) for x in named.group(1).split(",")]
    assert seen == pytest.approx(bias, abs=0.002)


def test_a_torque_that_swings_is_named_and_is_no_bias(readings):
    """Chi-square would not see it: it changes it by less than its gate."""
    swing = NOISE * np.array([1.0, -0.7, 0.4]) * np.sin(23 * TS)[:, None]
    found, line = first_line(readings + swing, NOISE)
    assert found.reduced_chi_square < 1 + 5 * np.sqrt(2 / 600)
    assert found.status == Status.MISFIT
    assert "band of frequencies" in line


class Blinded(identify.AbstractSensor):
    """A gyro that does not read small rates."""

    depends_on_attitude: ClassVar[bool] = False
    least: Float[Array, ""] = eqx.field(converter=jnp.asarray)

    def predict(self, t, state, system):  # noqa: ARG002
        return jnp.where(jnp.abs(state.omega) > self.least, state.omega, jnp.nan)

    def rates(self, value):
        return value


def test_noise_about_a_constant_rate_is_no_swing(rng):
    ts = np.arange(200) * 0.05
    values = np.array([0.3, -0.2, 0.4]) + 0.01 * rng.normal(size=(200, 3))
    found = identify.fit(
        jr.RigidBody(np.ones(3)), identify.Rates(ts, values, 0.01), throw=False
    )
    assert found.status == Status.UNIDENTIFIABLE
    assert found.determined == {"inertia": False}
    assert "swing" not in str(found)


@pytest.mark.parametrize("rates", [[0.0, 2.0, 0.0], [0.3, 2.0, 1.0]])
def test_constant_rates_without_a_noise_tell_no_ratios(rates):
    """The residuals are rounding, which is no noise to take errors from."""
    ts = np.arange(100) * 0.1
    found = identify.fit(
        BLIND, identify.Rates(ts, np.tile(rates, (100, 1))), throw=False
    )
    assert found.status == Status.UNIDENTIFIABLE
    assert "spin is pure" in str(found)


@pytest.mark.parametrize("factor", [1e20, 1e200])
def test_absurd_rates_are_bad_input_of_which_the_report_says_no_more(readings, factor):
    rates = identify.Rates(TS, factor * readings, 0.01)
    found = identify.fit(jr.RigidBody(np.ones(3)), rates, throw=False)
    assert found.status == Status.BAD_INPUT
    (line,) = str(found).splitlines()
    assert "must be in rad/s" in line


def test_predictions_that_are_not_finite_matter_only_where_there_is_a_reading(readings):
    seen = np.where(np.abs(readings) > 2.5, readings, np.nan)
    assert 50 < np.sum(np.isnan(seen)) < 150

    def fitted(least):
        record = identify.Record(Blinded(least), TS, seen, NOISE)
        return identify.fit(BLIND, record, throw=False)

    found = fitted(1.0)
    assert found.status == Status.OK
    error = found.ratios - MOMENTS[1:] / MOMENTS[0]
    assert np.all(np.abs(error) < 5 * found.ratios_errors)
    never = fitted(np.inf)
    assert never.status == Status.NOT_CONVERGED
    assert "Predictions are not finite" in str(never).splitlines()[0]


def test_a_noise_stated_a_little_too_small_is_no_scatter_between_trials(readings):
    """6 % show in 12000 residuals, of which chi-square scatters by 1.3 %."""
    found, _ = first_line(readings, NOISE)
    fields = lambda x: (x.status, x.chi_square, x.degrees_of_freedom)  # noqa: E731

    def line(result, square):
        other = (Status.MISFIT, jnp.asarray(12000 * square), jnp.asarray(12000))
        return reason(eqx.tree_at(fields, result, other))

    assert "`sigma` is too small" in line(found, 1.06**2)
    # A single trial does not differ from others.
    assert line(found, 1.0) == ""
    several = eqx.tree_at(lambda x: x.kept, found, jnp.repeat(found.kept, 2, axis=0))
    assert "Trials differ" in line(several, 1.0)


# Conventions of other programs


@pytest.fixture(scope="module")
def turning():
    """Times, noisy attitudes and noisy rates of a free body."""
    ts = np.linspace(0, 12, 60)
    rng = np.random.default_rng(3)

    rates = solved(ts, SLOW)
    q = reference_attitude(rates, ts, ATTITUDE)
    turns = 0.01 * rng.normal(size=(60, 3))
    noisy = host.multiply(q, host.exp(turns))
    return ts, noisy, rates(ts).T + 0.01 * rng.normal(size=(60, 3))


def conjugated(q):
    return q * np.array([1, -1, -1, -1])


def scalar_last(q):
    return q[:, [1, 2, 3, 0]]


@pytest.mark.parametrize(
    ("attitudes", "words"),
    [
        (scalar_last, "scalar last: pass (w, x, y, z), by `jr.rotation.from_scipy`"),
        (conjugated, "from space to body: pass those from body to space"),
    ],
)
def test_the_convention_of_attitudes_beside_rates_is_named(turning, attitudes, words):
    ts, q, rates = turning
    records = (
        identify.Attitudes(ts, attitudes(q), 0.01),
        identify.Rates(ts, rates, 0.01),
    )
    found = identify.fit(BLIND, [records], throw=False)
    assert found.status in (Status.WRONG_BASIN, Status.MISFIT)
    assert words in reason(found)


@pytest.mark.parametrize("attitudes", [scalar_last, conjugated])
def test_attitudes_alone_do_not_tell_which_convention(turning, attitudes):
    """(x, y, z, w) is a conjugate of (w, x, y, z), between two fixed rotations."""
    ts, q, _ = turning
    with pytest.raises(RuntimeError, match="scalar last, or from space to body"):
        identify.fit(BLIND, identify.Attitudes(ts, attitudes(q), 0.01))


def test_rates_in_degrees_beside_attitudes_are_named(turning):
    ts, q, rates = turning
    gyro = identify.Rates(ts, DEGREES * rates, DEGREES * 0.01)
    found = identify.fit(BLIND, [(identify.Attitudes(ts, q, 0.01), gyro)], throw=False)
    assert reason(found).startswith("The rates seem to be in degrees")


def test_rates_along_space_axes_are_named(turning):
    ts, q, rates = turning
    along = np.einsum("nij,nj->ni", host.to_matrix(q), rates)
    gyro = identify.Rates(ts, along, 0.01)
    found = identify.fit(BLIND, [(identify.Attitudes(ts, q, 0.01), gyro)], throw=False)
    assert "along space axes" in reason(found)
    # Fits side by side have the same verdicts.
    right = identify.Rates(ts, rates, 0.01)
    both = [[(identify.Attitudes(ts, q, 0.01), x)] for x in (gyro, right)]
    many = identify.fit_each(BLIND, both)
    expected = [[False, False, False, True, False], [False] * 5]
    np.testing.assert_array_equal(many.diagnostics.conventions, expected)


# Two kinds of functions of time, each with programs of its own.
SAMPLED = "table", "function"


def spun_up(t):
    """Momentum of a wheel that is spun up and down."""
    return jnp.multiply.outer(0.8 * jnp.sin(2.0 * t), jnp.array([0.6, 0.0, 0.8]))


@pytest.mark.parametrize(
    "kind", ["array", *(pytest.param(x, marks=pytest.mark.slow) for x in SAMPLED)]
)
def test_a_wheel_of_the_wrong_sign_is_named(kind, rng):
    ts = np.linspace(0, 8, 160)
    clock = np.linspace(-0.5, 8.5, 181)
    momenta = {
        "array": np.array([0.3, 0.2, 0.9]),
        "table": jr.torques.Sampled(clock, np.asarray(spun_up(clock))),
        "function": spun_up,
    }
    opposite = {
        "array": -momenta["array"],
        "table": jr.torques.Sampled(clock, -np.asarray(spun_up(clock))),
        "function": lambda t: -spun_up(t),
    }
    wheel = jr.torques.Rotor(momenta[kind])
    body = jr.RigidBody(np.array([1.0, 1.7, 2.3]), wheel)
    state = jr.State(np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.9, 1.1, -0.7]))
    rates = np.asarray(jr.simulate(body, state, ts=ts).states.omega)
    record = identify.Rates(ts, rates + 0.01 * rng.normal(size=rates.shape), 0.01)

    def found(momentum):
        guess = jr.RigidBody(np.ones(3), jr.torques.Rotor(momentum))
        return identify.fit(guess, record, scale="rotor", throw=False)

    right = found(momenta[kind])
    assert right.status == Status.OK
    assert not np.any(right.diagnostics.conventions)
    wrong = found(opposite[kind])
    assert wrong.status != Status.OK
    assert reason(wrong).startswith("The momentum of the rotor seems to have the wrong")


class Geared(eqx.Module):
    """Momentum of a wheel behind a gear."""

    gain: Array

    def __call__(self, t):
        return self.gain * spun_up(t)


def test_a_wheel_of_the_wrong_sign_is_named_while_its_gain_is_sought(rng):
    ts = np.linspace(0, 8, 160)
    wheel = jr.torques.Rotor(Geared(jnp.asarray(1.0)))
    body = jr.RigidBody(np.array([1.0, 1.7, 2.3]), wheel)
    state = jr.State(np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.9, 1.1, -0.7]))
    rates = np.asarray(jr.simulate(body, state, ts=ts).states.omega)
    record = identify.Rates(ts, rates + 0.01 * rng.normal(size=rates.shape), 0.01)
    guess = jr.RigidBody(np.ones(3), jr.torques.Rotor(Geared(jnp.asarray(-1.0))))
    found = identify.fit(
        guess,
        record,
        scale="rotor",
        free=lambda body: identify.prior(body.torque.momentum.gain, 0.01),
        throw=False,
    )
    assert "momentum of the rotor seems to have the wrong sign" in reason(found)


def test_a_wrong_model_is_no_wrong_convention():
    """A body that is brought nearly to rest, fitted without its drag."""
    ts = np.linspace(0, 12, 60)

    rates = solved(ts, [0.9, 0.5, -1.4], drag=0.4)
    q = reference_attitude(rates, ts, ATTITUDE)
    records = identify.Attitudes(ts, q, 0.01), identify.Rates(ts, rates(ts).T, 0.01)
    found = identify.fit(BLIND, [records], throw=False)
    assert found.reduced_chi_square > 100
    assert not np.any(found.diagnostics.conventions)
    # Nor does a wrong model hide a wrong convention.
    turned = identify.Attitudes(ts, conjugated(q), 0.01), records[1]
    wrong = identify.fit(BLIND, [turned], throw=False)
    assert list(wrong.diagnostics.conventions) == [False, True, False, False, False]


def test_turns_of_attitudes_and_rates_are_compared_at_any_times(turning, untyped):
    """A gyro of a kilohertz beside a slow camera, with gaps, a leap and a bias."""
    ts, q, _ = turning
    rng = np.random.default_rng(0)

    fast = np.arange(0, 12, 0.01)
    rates = solved(ts, SLOW)(fast).T + 0.02 * rng.normal(size=(fast.size, 3))
    rates[100:110] = np.nan
    q = q.copy()
    q[20] = [0.0, 1.0, 0.0, 0.0]
    gyro = identify.Gyro(bias=jnp.array([0.1, 0.0, 0.0]))

    def agree(attitudes, rates):
        pair = (
            identify.Attitudes(ts[None], attitudes[None], 0.01),
            identify.Record(gyro, fast[None], rates[None], 0.02),
        )
        return conventions.turns_agree(pair)

    shown = rates + np.array([0.1, 0.0, 0.0])
    assert agree(q, shown)
    assert not agree(conjugated(q), shown)
    assert not agree(scalar_last(q), shown)
    assert not agree(q, DEGREES * shown)
    assert conventions.turns_agree((identify.Attitudes(ts, q, 0.01),)) is None


@pytest.mark.parametrize("limit", [4.0, np.array([3.0, 2.5, 5.0])])
def test_a_limit_of_the_gyro_that_is_not_passed_is_named(readings, limit):
    clipped = np.clip(readings, -limit, limit)
    found, line = first_line(clipped, NOISE)
    assert found.status not in (Status.OK, Status.UNIDENTIFIABLE)
    assert re.search(r"stand at its largest value, (4|3|2\.5|5) rad/s", line)
    record = identify.Record(identify.Gyro(limit=limit), TS, clipped, NOISE)
    passed = identify.fit(BLIND, record, throw=False)
    assert "largest value" not in str(passed)


def test_readings_in_coarse_steps_are_not_those_at_a_limit(readings):
    """The most frequent reading of a peak is a level beside others."""
    found, line = first_line(np.round(readings, 0), NOISE)
    assert found.status == Status.MISFIT
    assert "largest value" not in line


def test_a_spin_whose_torque_is_sought_is_named_where_it_fails(rng):
    """Records that the search cannot follow, since their bodies are any."""
    lines = []
    for _ in range(4):
        rates = np.array([0.0, 0.0, 2.0]) + NOISE * rng.normal(size=(102, 3))
        record = identify.Rates(np.linspace(0, 6, 102), rates, NOISE)
        found = identify.fit(BLIND, record, unmodelled="estimate", throw=False)
        if found.status in (Status.WRONG_BASIN, Status.NOT_CONVERGED):
            lines.append(str(found).splitlines()[0])
        else:
            assert found.status == Status.UNIDENTIFIABLE
    assert all("say nothing of the inertia" in line for line in lines)


@pytest.mark.parametrize("bias", [0.0, 0.15])
def test_readings_near_a_limit_that_is_passed_show_no_bias_but_a_true_one(rng, bias):
    """Those with the larger noise are saturated, so that the others have a mean."""
    ts = np.linspace(0.0, 20.0, 200)
    start = jr.State(np.array([1.0, 0, 0, 0]), np.array([-1.04, 0.7, -1.56]))
    moments = np.array([1.0, 1.6, 2.2])
    omegas = np.asarray(jr.free_rotation(moments, start, ts).omega)
    statuses = set()
    for _ in range(6):
        noisy = omegas + 0.02 * rng.normal(size=omegas.shape)
        noisy[:, 2] += bias
        values = np.clip(noisy, -1.6, 1.6)
        record = identify.Record(identify.Gyro(limit=1.6), ts, values, 0.02)
        found = identify.fit(BLIND, record, throw=False)
        statuses.add(int(found.status))
        if bias:
            assert "A bias of the gyro" in str(found).splitlines()[0]
    assert statuses == {int(Status.MISFIT if bias else Status.OK)}


@pytest.fixture(scope="module")
def with_magnetometer():
    """A fit of a gyro and a magnetometer of one free motion, and its start."""
    field = np.array([20.0, 0.0, -40.0])
    ts = np.linspace(0.0, 20.0, 100)
    start = jr.State(np.array([1.0, 0, 0, 0]), np.array([0.4, 0.9, -0.5]))
    motion = jr.free_rotation(MOMENTS, start, ts)
    shown = in_body_axes(motion.attitude, jnp.asarray(field))
    rng = np.random.default_rng(7)
    rates = motion.omega + 0.02 * rng.normal(size=(100, 3))
    shown = shown + 0.5 * rng.normal(size=(100, 3))

    def fitted(late=0.0, unit=1.0):
        records = (
            identify.Record(identify.Gyro(), ts, rates, 0.02),
            identify.Record(
                identify.Magnetometer(field), ts + late, unit * shown, 0.5 * unit
            ),
        )
        return identify.fit(BLIND, records, start=start, throw=False)

    return fitted


def test_records_that_have_no_time_in_common_are_named(with_magnetometer):
    assert "no time in common" not in str(with_magnetometer())
    text = str(with_magnetometer(late=1000.0))
    assert "one ends 980 s before the other begins" in text


def test_readings_in_another_unit_than_the_field_are_named(with_magnetometer):
    found = with_magnetometer(unit=1000.0)
    assert found.status not in (Status.OK, Status.UNIDENTIFIABLE)
    assert re.search(r"size of 4\.\d+e\+04, and its field one of 44\.7", str(found))


def test_a_search_without_rates_that_ends_wrong_says_what_it_needs():
    """A state that turns the other way is no start."""
    ts = np.linspace(0.0, 20.0, 100)
    start = jr.State(np.array([1.0, 0, 0, 0]), np.array([0.4, 1.8, -0.5]))
    motion = jr.free_rotation(MOMENTS, start, ts)
    star = in_body_axes(motion.attitude, jnp.array([0.0, 0.6, 0.8]))
    record = identify.Directions(ts, star, 0.01, of=np.array([0.0, 0.6, 0.8]))
    wrong = jr.State(start.attitude, -np.asarray(start.omega))
    found = identify.fit(BLIND, record, start=wrong, throw=False)
    assert found.status not in (Status.OK, Status.UNIDENTIFIABLE)
    assert "pass a tensor and a state (`start`)" in str(found)
