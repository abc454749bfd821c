"""Flights in simulated trials: how well they are found, and what could hide them."""

import pathlib
import sys

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jrigid as jr

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "benchmarks"))
import bench_flights  # pyright: ignore[reportMissingImports]


@pytest.fixture(scope="module", params=[40, pytest.param(100, marks=pytest.mark.slow)])
def thrown(request):
    """Trials that the detector was not tuned on."""
    return bench_flights.cases(request.param, seed=3)


def test_flights_keep_what_the_documentation_states(thrown):
    """Start and end within 30 ms for 90 % of the flights, and at most 5 % missed."""
    results = [bench_flights.compare(x, jr.records.flights(x.reading)) for x in thrown]
    errors = np.concatenate([x for x, _ in results])
    assert len(errors) > len(thrown)
    missed = np.isnan(errors[:, 0])
    assert missed.mean() <= 0.05
    within = np.abs(errors) <= 0.03
    assert within[:, 0].mean() >= 0.9
    assert within[:, 1].mean() >= 0.9
    assert sum(false for _, false in results) == 0


def test_nothing_flies_before_the_trial(thrown):
    """Shaking and winding up are no flights."""
    for case in thrown:
        released = case.flights[0][0] - 0.06
        hand = case.reading[: int(np.searchsorted(case.reading.times, released))]
        assert jr.records.flights(hand) == []


def flying(times, start=1.0, end=1.8, spin=12.0, lever=(0.05, 0.0, 0.02)):
    """A body that turns steadily about its mass centre, at rest before and after."""
    free = ((times >= start) & (times < end))[:, None]
    rates = np.where(free, [0.0, spin, 0.0], 0.0)
    forces = np.cross(rates, np.cross(rates, np.array(lever)))
    return rates, np.where(free, forces, [0.0, 0.0, 9.80665])


def test_a_slow_clock_loses_no_reading_of_a_flight():
    times = np.arange(0.003, 3, 0.02)
    rates, forces = flying(times)
    [flight] = jr.records.flights(jr.records.Reading(times, rates, forces))
    inside = times[(times >= 1.0) & (times < 1.8)]
    np.testing.assert_array_equal(flight.times, inside)


def test_a_blow_between_two_readings_parts_a_flight(rng):
    """The accelerometer shows nothing of it; the rates jump."""
    times = np.arange(0.003, 3, 0.02)
    rates, forces = flying(times, lever=(0.0, 0.0, 0.0))
    rates[(times > 1.41) & (times < 1.8)] = [0.0, 4.0, 9.0]
    rates += 0.01 * rng.normal(size=rates.shape)
    first, second = jr.records.flights(jr.records.Reading(times, rates, forces))
    assert first.times[-1] < 1.41 < second.times[0]
    assert first.times[0] < 1.03
    assert second.times[-1] > 1.77


def test_an_accelerometer_at_the_end_of_its_range():
    """It shows 4 g for the 58 m/s^2 of the lever."""
    times = np.arange(0, 3, 0.005)
    rates, forces = flying(times, spin=34.0)
    assert forces[:, 0].min() < -50
    forces = forces.clip(-39.2, 39.2)
    [flight] = jr.records.flights(jr.records.Reading(times, rates, forces))
    assert 1.0 <= flight.times[0] < 1.03
    assert 1.77 < flight.times[-1] < 1.8


def test_an_accelerometer_that_lags(thrown):
    """In 5 ms a tumbling body of 20 rad/s turns the force by 6 degrees."""
    for x in [x for x in thrown if not x.wheel and not x.bounces][:8]:
        reading = x.reading
        late = np.stack(
            [
                np.interp(reading.times - 0.005, reading.times, c)
                for c in reading.specific_forces.T
            ],
            axis=1,
        )
        delayed = jr.records.Reading(reading.times, reading.rates, late)
        errors, false = bench_flights.compare(x, jr.records.flights(delayed))
        assert not np.isnan(errors).any()
        assert false == 0


@pytest.mark.parametrize("delay", [-0.008, -0.004, 0.004, 0.008])
def test_a_delay_of_either_sign_at_a_fast_clock(delay, rng):
    """Euler's equations in flight, read at 500 Hz."""
    times = np.arange(0, 3, 0.002)
    moments = np.array([1.0, 2.0, 2.5])
    lever = np.array([0.05, 0.03, 0.02])

    def slope(_, omega):
        return -np.cross(omega, moments * omega) / moments

    start = 37.0 * np.array([0.5, 0.7, 0.51])
    motion = solve_ivp(slope, (1.0, 1.8), start, rtol=1e-9, dense_output=True)
    free = (times >= 1.0) & (times < 1.8)
    rates = np.where(free[:, None], motion.sol(times).T, 0.0)
    turned = np.cross(slope(0, rates), lever)
    forces = turned + np.cross(rates, np.cross(rates, lever))
    forces = np.where(free[:, None], forces, [0.0, 0.0, 9.8])
    forces = forces + 0.1 * rng.normal(size=forces.shape)
    late = [np.interp(times - delay, times, column) for column in forces.T]
    reading = jr.records.Reading(times, rates, np.stack(late, axis=1))
    [flight] = jr.records.flights(reading)
    assert 0.99 < flight.times[0] < 1.03
    assert 1.77 < flight.times[-1] < 1.81


def test_a_bias_is_no_contact_and_gravity_is_no_bias():
    times = np.arange(0, 3, 0.01)
    rates, forces = flying(times, spin=0.0)
    [flight] = jr.records.flights(jr.records.Reading(times, rates, forces + 0.5))
    assert 1.0 <= flight.times[0] <= 1.02
    held = jr.records.Reading(times, rates, np.tile([0.0, 0.0, 9.8], (300, 1)))
    assert jr.records.flights(held) == []


def test_pieces_of_a_few_readings_between_breaks():
    times = np.arange(0, 3, 0.01)
    rates, forces = flying(times)
    reading = jr.records.Reading(times, rates, forces, breaks=(1, 3, 6, 298))
    [flight] = jr.records.flights(reading)
    assert 1.0 <= flight.times[0] <= 1.02


def test_drag_is_allowed_for_where_there_is_no_accelerometer(rng):
    """A spin that loses a third a second."""
    times = np.arange(0, 3, 0.005)
    moments = np.array([1.0, 2.0, 2.5])
    rates = np.zeros((times.size, 3))
    omega = np.array([9.0, 3.0, 12.0])
    for i in np.flatnonzero((times >= 1.0) & (times < 1.8)):
        rates[i] = omega
        for _ in range(20):
            torque = -np.cross(omega, moments * omega) - 0.33 * moments.mean() * omega
            omega = omega + 0.005 / 20 * torque / moments
    hand = (times < 1.0) | (times >= 1.8)
    rates[hand] = 4 * np.sin(9 * times[hand, None] * np.array([1.0, 1.3, 0.7]))
    rates += 0.005 * rng.normal(size=rates.shape)
    [flight] = jr.records.flights(jr.records.Reading(times, rates))
    assert 0.99 < flight.times[0] < 1.05
    assert 1.75 < flight.times[-1] < 1.81


def test_an_even_rest_is_not_the_end_of_a_range(rng):
    """A synthetic record may read 9.8 m/s^2 throughout,
    and a slow clock leaves large steps."""
    body = jr.datasets.gyro_example()
    rest = 0.01 * rng.normal(size=(300, 3))
    rates = np.concatenate([rest, body.omegas, rest])
    forces = np.zeros(rates.shape)
    forces[:300, 2] = forces[-300:, 2] = 9.8
    times = 0.1 * np.arange(len(rates))
    [flight] = jr.records.flights(jr.records.Reading(times, rates, forces))
    assert len(flight.times) == len(body.omegas)
