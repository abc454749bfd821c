"""Rates and attitudes that a record gives directly, before any fit."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from jrigid._core.compile import Static, small_program
from jrigid._types import AnyArray
from jrigid.identify._host import (
    conjugate,
    exp,
    log,
    multiply,
    normalize,
    to_matrix,
)
from jrigid.identify._records import Record, Samples, first_and_last, tells
from jrigid.identify._sensors import (
    AbstractSensor,
    DirectionSensor,
    Magnetometer,
)

# A reading so many times as far from the path of its neighbours as others are from
# that of theirs is no place to begin a segment.
_LONE = 8.0
_AROUND = 3  # samples to each side that tell the path of the readings
_WIDE = 10  # ... and how far readings are off from it
# An attitude is far from most of those around it if it turned so many times as fast.
_FAST = 3.0
# Intervals that differ by more than this part are no equal ones.
_UNEVEN = 0.1
# Radians from one attitude to the next, twelve samples a turn.
_SHOWN = 0.3  # of a vector: the least mean of its readings in space axes
_LEAST_TURN = 1e-6  # weight of the smallest turn among those that serve as well
_SMALL_TURN = 0.5
# Rates are taken from the attitudes within a turn that is so little [rad] ...
_LITTLE = 1.0
_NEARLY_ALWAYS = 0.95
# ... where there are so many of them on each side ...
_CLOSE = 8
# ... and parabolas leave no more than so many times what noise does.
_WORSE = 1.2
_FEW = 256  # parabolas that decide


class DirectReadings(NamedTuple):
    """Rates, and attitudes if there are any, that records give without a model.

    Attributes:
        ts: Times (trials, n) [s]; zero where there is no reading.
        valid: Whether there is a reading (trials, n).
        omega: Rates in body axes (trials, n, 3) [rad/s].
        attitude: Attitudes (trials, n, 4).
    """

    ts: np.ndarray
    valid: np.ndarray
    omega: np.ndarray
    attitude: np.ndarray | None


class _Series(NamedTuple):
    """Direct readings of one sensor: times, whether there is a reading, values."""

    ts: np.ndarray
    valid: np.ndarray
    values: np.ndarray


def index_before(valid: np.ndarray) -> np.ndarray:
    """Index of the last valid sample before each sample; -1 up to the first one."""
    index = np.where(valid, np.arange(valid.shape[-1]), -1)
    latest = np.maximum.accumulate(index, axis=-1)
    none = np.full_like(latest[..., :1], -1)
    return np.concatenate([none, latest[..., :-1]], axis=-1)


def _index_after(valid: np.ndarray) -> np.ndarray:
    """Index of the first valid sample after each sample; the count from the last on."""
    reverse = index_before(valid[..., ::-1])[..., ::-1]
    return valid.shape[-1] - 1 - reverse


def _nearest_before(ts: np.ndarray, valid: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Index of the last valid sample up to each t, or of the first one."""
    # The search needs ordered times: where there is no reading the latest one is
    # repeated.
    times = np.maximum.accumulate(np.where(valid, ts, -np.inf))
    after = np.searchsorted(times, t, side="right")
    latest = index_before(np.append(valid, False))[after]
    return np.where(latest < 0, np.argmax(valid), latest)


def _mean_rates(
    ts: np.ndarray, attitude: np.ndarray, start: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean rates between samples, and between which of them time passes.

    Args:
        ts: Times.
        attitude: At these times.
        start: Indices of samples, -1 where there is none.
        end: Indices of later ones, the count of samples where there is none.

    Returns:
        Rates (n, 3), zero where no time passes, and a mask (n, 1).
    """
    both = (start >= 0) & (end < ts.size)
    start = np.where(both, start, 0)
    end = np.where(both, end, 0)
    step = ts[end] - ts[start]
    passes = (both & (step > 0))[:, None]
    turn = log(multiply(conjugate(attitude[start]), attitude[end]))
    rates = np.where(passes, turn / np.where(passes, step[:, None], 1.0), 0.0)
    return rates, passes


def _rates_from_attitudes(
    ts: np.ndarray, valid: np.ndarray, attitude: np.ndarray
) -> np.ndarray:
    """Rates of a trial at its attitudes."""
    index = np.arange(ts.size)
    # A turn between samples divided by its time is the rate in their middle. The mean
    # of both sides is more accurate at the sample itself.
    left, has_left = _mean_rates(ts, attitude, index_before(valid), index)
    right, has_right = _mean_rates(ts, attitude, index, _index_after(valid))
    rates = (left + right) / np.where(has_left & has_right, 2, 1).astype(ts.dtype)
    # Noise hides the turns between samples that follow each other closely.
    place = np.flatnonzero(valid)
    reach = _reach(ts[place], attitude[place])
    if reach:
        slopes, known, _ = _slopes(
            ts[place], attitude[place], np.arange(place.size), reach
        )
        rates[place] = np.where(known, slopes, rates[place])
    return rates


def _reach(ts: np.ndarray, attitude: np.ndarray) -> int:
    """Samples to each side that give the best rate; 0 where neighbours do.

    The turns to them must be small and follow a parabola as well as those to the
    nearest samples do, whose residuals are noise.
    """
    best = 0
    least = np.inf
    reach = _CLOSE
    some = np.arange(0, ts.size, max(1, ts.size // _FEW))
    while 2 * reach < ts.size:
        turn = log(multiply(conjugate(attitude[: -2 * reach]), attitude[2 * reach :]))
        if np.quantile(np.linalg.norm(turn, axis=1), _NEARLY_ALWAYS) > _LITTLE:
            break
        _, _, residual = _slopes(ts, attitude, some, reach)
        if residual > _WORSE * least:
            break
        best = reach
        least = min(least, residual)
        reach *= 2
    return best


def _slopes(
    ts: np.ndarray, attitude: np.ndarray, at: np.ndarray, reach: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Rates from parabolas through the turns to samples nearby.

    Args:
        ts: Times.
        attitude: At these times.
        at: Indices of the samples whose rates are sought (n,).
        reach: How many samples before and after take part, or every second, fourth
            and so on of them.

    Returns:
        The rates (n, 3), where there are enough samples for one (n, 1), and what the
        parabolas leave of the turns, rms.
    """
    offsets = np.arange(-reach, reach + 1, reach // _CLOSE)
    index = at[:, None] + offsets
    exists = (index >= 0) & (index < ts.size)
    index = np.clip(index, 0, ts.size - 1)
    width = reach * np.median(np.diff(ts))
    late = (ts[index] - ts[at, None]) / width
    # Beyond a gap the body may have turned by any angle.
    taken = exists & (np.abs(late) < 1.5)
    known = np.sum(taken, axis=1) > _CLOSE
    taken = taken & known[:, None]
    turn = log(multiply(conjugate(attitude[at])[:, None], attitude[index]))
    # Not held at zero where the parabola begins: that sample is as noisy as others.
    powers = np.stack([np.ones_like(late), late, late**2], axis=-1)
    powers = np.where(taken[..., None], powers, 0.0)
    normal = np.swapaxes(powers, 1, 2) @ powers
    normal = np.where(known[:, None, None], normal, np.eye(3))
    parabolas = np.linalg.solve(normal, np.swapaxes(powers, 1, 2) @ turn)
    rest = np.where(taken[..., None], turn - powers @ parabolas, 0.0)
    residual = np.sqrt(np.sum(rest**2) / max(np.sum(taken), 1))
    return parabolas[:, 1] / width, known[:, None], float(residual)


def _turns(ts: np.ndarray, valid: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Integral of rates (n, k) of a trial since the sample before (trapezium rule)."""
    last = index_before(valid)
    step = np.where(valid & (last >= 0), np.maximum(ts - ts[last], 0.0), 0.0)
    return 0.5 * (rates[last] + rates) * step[:, None]


def turned_by(
    attitude: np.ndarray, rates: np.ndarray, duration: np.ndarray
) -> np.ndarray:
    """Attitudes after a duration at constant rates."""
    return multiply(attitude, exp(rates * duration[..., None]))


def _dead_reckoning(
    ts: np.ndarray,
    valid: np.ndarray,
    omega: np.ndarray,
    attitude_ts: np.ndarray,
    attitude_valid: np.ndarray,
    attitude: np.ndarray,
) -> np.ndarray:
    """Attitudes of a trial at times of rates, each from the last observed attitude."""
    # Before the first attitude the motion is followed back from it.
    latest = _nearest_before(attitude_ts, attitude_valid, ts)
    # A missing rate has no time. It continues from the attitude of the rate before it,
    # and from none (-1) before the first rate.
    latest = np.maximum.accumulate(np.where(valid, latest, -1))
    observed = turned_by(attitude[latest], omega, ts - attitude_ts[latest])
    # The first rate after a new attitude starts anew; the others add their turns.
    is_first = np.diff(latest, prepend=-2) != 0
    factors = np.where(is_first[:, None], observed, exp(_turns(ts, valid, omega)))
    return normalize(_running_products(factors, is_first))


def _running_products(factors: np.ndarray, is_first: np.ndarray) -> np.ndarray:
    """Products of quaternions, at each index from the last first factor up to there.

    They are formed by doubling: after k rounds each is the product of the last 2^k
    factors, or of all since the first one.
    """
    # Doubling takes log2(n) products of whole arrays, a loop over samples n products.
    product = factors.copy()
    complete = is_first
    shift = 1
    while not np.all(complete):
        longer = multiply(product[:-shift], product[shift:])
        product[shift:] = np.where(complete[shift:, None], product[shift:], longer)
        complete = np.concatenate(
            [complete[:shift], complete[shift:] | complete[:-shift]]
        )
        shift *= 2
    return product


@small_program
def _apply_method(sensor: AbstractSensor, name: Static, values: AnyArray) -> jax.Array:
    """Apply a method of a sensor, "rates" or "attitude", to values (trials, n, k)."""
    return jax.vmap(jax.vmap(getattr(sensor, name.value)))(values)


def _first_series(
    records: tuple[Record, ...], samples: Samples, name: str
) -> _Series | None:
    """Readings of the first record with "rates" or "attitude"; None without one."""
    for record, values, part in zip(
        records, samples.values, samples.parts, strict=True
    ):
        if not tells(record, name):
            continue
        direct = np.asarray(_apply_method(record.sensor, Static(name), values))
        # A saturated value is a bound only.
        exact = (samples.weight[:, part] > 0) & (samples.sign[:, part] == 0)
        valid = np.all(exact, axis=-1)
        return _Series(np.where(valid, samples.ts[:, part], 0.0), valid, direct)
    return None


_Leaps = Callable[[np.ndarray, np.ndarray], np.ndarray]


def _without_leaps(series: _Series, leaps: _Leaps, fewest: int) -> _Series:
    """The series without the readings that leap.

    Args:
        series: Of all trials.
        leaps: Which readings of a trial leap, from the times and values of those that
            there are.
        fewest: Readings of a trial that tell which of them leap.
    """
    valid = series.valid.copy()
    for ts, there, values in zip(series.ts, valid, series.values, strict=True):
        place = np.flatnonzero(there)
        if place.size >= fewest:
            there[place] = ~leaps(ts[place], values[place])
    return series._replace(valid=valid)


def _lone(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Whether each attitude leaps from the path of those before and after it."""
    span = t[2:] - t[:-2]
    part = (t[1:-1] - t[:-2]) / np.where(span > 0, span, 1.0)
    turn = log(multiply(conjugate(q[:-2]), q[2:]))
    path = multiply(q[:-2], exp(part[:, None] * turn))
    off = np.linalg.norm(log(multiply(conjugate(path), q[1:-1])), axis=1)
    # A leap also bends the paths at its neighbours, by half as much.
    around = np.pad(off, 1)
    largest = (off >= around[:-2]) & (off >= around[2:])
    # The first and the last one have a neighbour on one side only.
    return np.pad(largest & (off > _LONE * np.median(off)), 1)


def _turned_far(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Whether each attitude is far from most of those around it."""
    offsets = np.delete(np.arange(-_AROUND, _AROUND + 1), _AROUND)
    # At the ends the samples inside stand for those that are missing.
    other = np.arange(t.size)[:, None] + offsets
    other = np.where((other < 0) | (other >= t.size), other - 2 * offsets, other)
    turns = np.linalg.norm(log(multiply(conjugate(q)[:, None], q[other])), axis=-1)
    speeds = np.median(turns / np.abs(t[other] - t[:, None]), axis=1)
    return speeds > _FAST * _running_median(speeds, _WIDE)


def _leaping(t: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Whether each rate leaps from the median of those around it."""
    del t
    off = np.max(np.abs(rates - _running_median(rates, _AROUND)), axis=1)
    # A body may turn slower and slower, so that rates are compared with those nearby.
    return off > _LONE * _running_median(off, _WIDE)


def _running_median(values: np.ndarray, reach: int) -> np.ndarray:
    """Medians over so many rows to each side, or over all if there are fewer."""
    reach = min(reach, len(values) - 1)
    beyond = [(reach, reach), *[(0, 0)] * (values.ndim - 1)]
    around = np.pad(values, beyond, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(around, 2 * reach + 1, axis=0)
    return np.median(windows, axis=-1)


def direct_readings_of(
    records: tuple[Record, ...],
    samples: Samples,
    attitude0: np.ndarray | None,
    robust: bool = False,
) -> DirectReadings | None:
    """Return the rates and attitudes that records give directly, None without either.

    Args:
        records: Records with numpy arrays.
        samples: Samples of the records.
        attitude0: Attitude at the first sample of each trial, for dead reckoning where
            none was observed.
        robust: Whether readings that leap away from those around them are passed over.
    """
    rates = _first_series(records, samples, "rates")
    attitudes = _first_series(records, samples, "attitude")
    if attitudes is not None and robust:
        # Among many that leap, those that turned far from all around them go first.
        attitudes = _without_leaps(attitudes, _turned_far, 2 * _AROUND + 1)
        attitudes = _without_leaps(attitudes, _lone, 5)
    if rates is not None and robust:
        rates = _without_leaps(rates, _leaping, 2 * _AROUND + 1)
    if rates is None:
        if attitudes is None:
            return None
        ts, valid, attitude = attitudes
        omega = _for_each_trial(_rates_from_attitudes, *attitudes)
        return DirectReadings(ts, valid, omega, attitude)
    ts, valid, omega = rates
    # A missing reading is not zero after the sensor's bias is subtracted.
    omega = np.where(valid[..., None], omega, 0.0)
    if attitudes is None and attitude0 is not None:
        start = first_and_last(ts, valid)[0][:, None]
        attitudes = _Series(start, np.ones_like(start, bool), attitude0[:, None])
    if attitudes is None:
        return DirectReadings(ts, valid, omega, None)
    attitude = _for_each_trial(_dead_reckoning, ts, valid, omega, *attitudes)
    readings = DirectReadings(ts, valid, omega, attitude)
    if any(tells(x, "attitude") for x in records):
        return readings
    return readings._replace(attitude=_turned_to_vectors(records, samples, readings))


def vector_in_space(sensor: AbstractSensor) -> np.ndarray | None:
    """The vector in space axes that the values of a sensor are in body axes, if any."""
    if isinstance(sensor, Magnetometer):
        return np.asarray(sensor.field)
    if isinstance(sensor, DirectionSensor) and sensor.frame == "body":
        return np.asarray(sensor.of)
    return None


def _turned_to_vectors(
    records: tuple[Record, ...], samples: Samples, readings: DirectReadings
) -> np.ndarray:
    """Attitudes of dead reckoning, turned in space to where sensors show vectors.

    Rates tell an attitude but for that at the start. In space axes all readings of a
    vector are the same, but for errors that the body's turning averages out.

    Source: F. L. Markley, "Attitude determination using vector observations and the
    singular value decomposition" (1988).
    """
    attitude = readings.attitude
    assert attitude is not None
    turned = attitude.copy()
    for trial in range(len(attitude)):
        seen = []
        for record, part, values in zip(
            records, samples.parts, samples.values, strict=True
        ):
            vector = vector_in_space(record.sensor)
            degrees = record.sensor.degrees or values.shape[-1]
            is_seen = np.all(samples.weight[trial, part, :degrees] > 0, axis=-1)
            if vector is None or not np.any(is_seen):
                continue
            q = _attitudes_at(readings, trial, samples.ts[trial, part][is_seen])
            in_space = np.einsum(
                "nij,nj->ni", to_matrix(q), np.asarray(values)[trial][is_seen]
            )
            shown = np.mean(in_space, axis=0) / np.linalg.norm(vector)
            if np.linalg.norm(shown) > _SHOWN:
                seen.append((shown, vector / np.linalg.norm(vector)))
        if seen:
            turn = _turn_between(*map(np.stack, zip(*seen, strict=True)))
            turned[trial] = multiply(turn, attitude[trial])
    return turned.astype(attitude.dtype)


def _attitudes_at(readings: DirectReadings, trial: int, ts: np.ndarray) -> np.ndarray:
    """Attitudes at any times, each from the last reading of the rates before it."""
    assert readings.attitude is not None
    at = np.maximum(_nearest_before(readings.ts[trial], readings.valid[trial], ts), 0)
    late = ts - readings.ts[trial, at]
    return turned_by(readings.attitude[trial, at], readings.omega[trial, at], late)


def _turn_between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The quaternion of the turn that brings vectors (n, 3) nearest to unit vectors.

    A single vector is turned by the smallest angle.
    """
    # Of Davenport's matrix K the eigenvector of the largest value. The small number
    # selects the smallest of the turns that serve as well.
    matrix = start.T @ end
    z = np.array(
        [
            matrix[1, 2] - matrix[2, 1],
            matrix[2, 0] - matrix[0, 2],
            matrix[0, 1] - matrix[1, 0],
        ]
    )
    k = np.zeros((4, 4))
    k[0, 0] = np.trace(matrix) + _LEAST_TURN
    k[0, 1:] = k[1:, 0] = z
    k[1:, 1:] = matrix + matrix.T - np.trace(matrix) * np.eye(3)
    return np.linalg.eigh(k)[1][:, -1]


def _for_each_trial(
    function: Callable[..., np.ndarray], *arrays: np.ndarray
) -> np.ndarray:
    """Apply a function of a trial's arrays to each trial and stack the results."""
    return np.stack([function(*trial) for trial in zip(*arrays, strict=True)])


def angle_turned(readings: DirectReadings) -> np.ndarray:
    """Angle turned up to each sample (trials, n) [rad], by the trapezium rule."""
    omega = readings.omega
    speed = np.sqrt(np.sum(omega * omega, axis=-1, keepdims=True))
    speed = np.where(readings.valid[..., None], speed, 0.0)
    turns = _for_each_trial(_turns, readings.ts, readings.valid, speed)
    return np.cumsum(turns[..., 0], axis=1)


def longest_turn(readings: DirectReadings) -> float:
    """Largest angle turned from one sample to the next [rad]."""
    return float(np.max(np.diff(angle_turned(readings), axis=1), initial=0.0))


def other_way_round(readings: DirectReadings) -> DirectReadings | None:
    """Readings of a motion that turns the other way from each attitude to the next.

    Attitudes at equal intervals are those of such a motion too, an alias. None where
    intervals differ, or where turns are so small that nobody would think of it.
    """
    steps = [np.diff(t[x]) for t, x in zip(readings.ts, readings.valid, strict=True)]
    steps = np.concatenate(steps)
    step = np.median(steps) if steps.size else 0.0
    if not step > 0 or np.max(np.abs(steps - step)) > _UNEVEN * step:
        return None
    speed = np.linalg.norm(readings.omega, axis=-1, keepdims=True)
    if step * np.median(speed[readings.valid]) < _SMALL_TURN:
        return None
    factor = 1 - 2 * np.pi / (step * np.where(speed > 0, speed, np.inf))
    return readings._replace(omega=(factor * readings.omega).astype(speed.dtype))
