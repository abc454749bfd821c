"""Where a record is cut into segments, and the states they start from."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jrigid._types import AnyArray
from jrigid.identify._compile import Static, small_program
from jrigid.identify._host import conjugate, exp, log, multiply, normalize
from jrigid.identify._records import Record, Samples, first_and_last, tells
from jrigid.identify._sensors import AbstractSensor

MOST_NODES = 2000  # of a trial, where each sample has one


class Layout(NamedTuple):
    """Times of all samples, their nodes, and where links go: (trials, samples) and (trials, nodes).

    An unused node has no samples and no links.
    """

    ts: AnyArray
    node: AnyArray
    start: AnyArray
    end: AnyArray
    linked: AnyArray
    since: AnyArray  # fraction of the record at each sample


class Told(NamedTuple):
    """Rates, and attitudes if there are any, that tell where the segments start: (trials, n)."""

    ts: np.ndarray
    there: np.ndarray
    omega: np.ndarray
    attitude: np.ndarray | None


def _before(there: np.ndarray) -> np.ndarray:
    """Index of the last sample that is there, before each; -1 up to the first."""
    latest = np.maximum.accumulate(
        np.where(there, np.arange(there.shape[-1]), -1), axis=-1
    )
    return np.concatenate(
        [np.full_like(latest[..., :1], -1), latest[..., :-1]], axis=-1
    )


def _after(there: np.ndarray) -> np.ndarray:
    """Index of the first sample that is there, after each; the count from the last one on."""
    return there.shape[-1] - 1 - _before(there[..., ::-1])[..., ::-1]


def _nearest_before(ts: np.ndarray, there: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Index of the last sample not after each t; of the first one if all are later."""
    times = np.maximum.accumulate(np.where(there, ts, -np.inf))
    after = np.searchsorted(times, t, side="right")
    latest = _before(np.append(there, False))[after]
    return np.where(latest < 0, np.argmax(there), latest)


def _slopes(ts: np.ndarray, there: np.ndarray, attitude: np.ndarray) -> np.ndarray:
    """Rates of a trial from its attitudes: the mean of the turns to the samples on either side."""
    count = ts.size
    index = np.arange(count)
    before = _before(there)
    after = _after(there)

    def turn(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rates between samples, zero where there are none, and where there are some."""
        known = (a >= 0) & (b < count)
        a, b = np.where(known, a, 0), np.where(known, b, 0)
        step = ts[b] - ts[a]
        known = (known & (step > 0))[:, None]
        vector = log(multiply(conjugate(attitude[a]), attitude[b]))
        return np.where(known, vector / np.where(known, step[:, None], 1.0), 0.0), known

    left, is_left = turn(before, index)
    right, is_right = turn(index, after)
    return (left + right) / np.where(is_left & is_right, 2, 1).astype(ts.dtype)


def _turned(ts: np.ndarray, there: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Rates (n, k) of a trial by time, since the sample before: by the mean of the two."""
    last = _before(there)
    step = np.where(there & (last >= 0), np.maximum(ts - ts[last], 0.0), 0.0)
    return 0.5 * (rates[last] + rates) * step[:, None]


def _carried(attitude: np.ndarray, rates: np.ndarray, late: np.ndarray) -> np.ndarray:
    """Attitudes some time later, at constant rates."""
    return multiply(attitude, exp(rates * late[..., None]))


def _reckoned(
    ts: np.ndarray,
    there: np.ndarray,
    omega: np.ndarray,
    q_ts: np.ndarray,
    q_ok: np.ndarray,
    q: np.ndarray,
) -> np.ndarray:
    """Attitudes of a trial by dead reckoning, each from the last that was seen.

    Products of all turns since the attitude that was seen, by doubling: after k rounds
    each is the product of the last 2^k factors.
    """
    latest = _nearest_before(q_ts, q_ok, ts)
    seen = _carried(q[latest], omega, ts - q_ts[latest])
    fresh = np.diff(latest, prepend=-1) != 0
    product = np.where(fresh[:, None], seen, exp(_turned(ts, there, omega)))
    complete = fresh  # up to an attitude that was seen
    shift = 1
    while not np.all(complete):
        longer = multiply(product[:-shift], product[shift:])
        product[shift:] = np.where(complete[shift:, None], product[shift:], longer)
        complete = np.concatenate(
            [complete[:shift], complete[shift:] | complete[:-shift]]
        )
        shift *= 2
    return normalize(product)


@small_program
def _read(sensor: AbstractSensor, name: Static, values: Any) -> Any:
    """What a method of a sensor, "rates" or "attitude", makes of values (trials, n, k)."""
    return jax.vmap(jax.vmap(getattr(sensor, name.value)))(values)


def told_by(
    records: tuple[Record, ...], samples: Samples, attitude0: np.ndarray | None
) -> Told | None:
    """What tells the state on the way: a gyro, or attitudes; None if there is neither.

    Args:
        records: With numpy arrays.
        samples: Of the records.
        attitude0: At the first sample of each trial, where none was observed.
    """

    def first(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Times, which samples tell, and what they tell."""
        for record, values, part in zip(
            records, samples.values, samples.parts, strict=True
        ):
            seen = (
                _read(record.sensor, Static(name), values)
                if tells(record, name)
                else None
            )
            if seen is not None:
                plain = (samples.weight[:, part] > 0) & (samples.sign[:, part] == 0)
                there = np.all(plain, axis=-1)
                return (
                    np.where(there, samples.ts[:, part], 0.0),
                    there,
                    np.asarray(seen),
                )
        return None

    rates, attitudes = first("rates"), first("attitude")
    if rates is None:
        if attitudes is None:
            return None
        return Told(*attitudes[:2], _of_trials(_slopes, *attitudes), attitudes[2])
    ts, there, omega = rates
    omega = np.where(there[..., None], omega, 0.0)
    if attitudes is None and attitude0 is not None:
        start = first_and_last(ts, there)[0][:, None]
        attitudes = start, np.ones_like(start, bool), attitude0[:, None]
    if attitudes is None:
        return Told(ts, there, omega, None)
    return Told(ts, there, omega, _of_trials(_reckoned, ts, there, omega, *attitudes))


def _of_trials(function: Callable[..., np.ndarray], *arrays: np.ndarray) -> np.ndarray:
    """A function of a trial, of each trial."""
    return np.stack([function(*trial) for trial in zip(*arrays, strict=True)])


def angle_turned(told: Told) -> np.ndarray:
    """Radians turned up to each sample, from the rates there."""
    speed = np.sqrt(np.sum(told.omega * told.omega, axis=-1, keepdims=True))
    speed = np.where(told.there[..., None], speed, 0.0)
    return np.cumsum(_of_trials(_turned, told.ts, told.there, speed)[..., 0], axis=1)


def longest_turn(told: Told) -> float:
    """The most that a body turns from one sample to the next [rad]."""
    return float(np.max(np.diff(angle_turned(told), axis=1), initial=0.0))


def whole(samples: Samples, nodes: int, t0: AnyArray | None = None) -> Layout:
    """One segment a trial, in the first of so many nodes; its state at t0, or the first sample."""
    ts = samples.ts
    xp = ts.__array_namespace__()
    first, last = first_and_last(ts, samples.seen)
    is_first = xp.broadcast_to(xp.arange(nodes) == 0, (ts.shape[0], nodes))
    begin = xp.broadcast_to(first if t0 is None else xp.asarray(t0), first.shape)
    start = xp.where(is_first, begin[:, None], 0.0)
    span = xp.where(last > first, last - first, 1.0)
    since = (ts - first[:, None]) / span[:, None]
    return Layout(
        ts, xp.zeros(ts.shape, int), start, start, xp.zeros_like(is_first), since
    )


def segments(
    samples: Samples, told: Told, nodes: int, length: float
) -> tuple[Layout, np.ndarray]:
    """Segments of so many radians, or, of length 0, one a sample; and where each starts.

    They are longer where the nodes do not suffice.
    """
    layout = whole(samples, nodes)
    count = np.cumsum(told.there, axis=1).astype(samples.ts.dtype)
    most = max(nodes - 1, 1) if length else nodes

    def trial(
        layout: Layout, measure: np.ndarray, times: np.ndarray, ok: np.ndarray
    ) -> tuple[Layout, np.ndarray]:
        size = np.maximum(length or 1.0, measure[-1] / most)
        part, last = np.floor(measure / size * (1 - 1e-12)), _before(ok)
        new = np.flatnonzero(ok & ((last < 0) | (part != part[last])))
        opening = np.zeros(nodes, int)
        opening[: new.size] = new[:nodes]
        used = np.arange(nodes) < new.size
        start = times[opening]
        # The first node stands at the first sample of any kind.
        start[0] = layout.start[0]
        node = (
            np.searchsorted(np.where(used, start, np.inf), layout.ts, side="right") - 1
        )
        linked = np.append(used[1:], False)
        end = np.where(linked, np.roll(start, -1), start)
        node = np.clip(node, 0, nodes - 1)
        return Layout(layout.ts, node, start, end, linked, layout.since), opening

    measure = angle_turned(told) if length else count - 0.5
    trials = zip(map(Layout, *layout), measure, told.ts, told.there, strict=True)
    layouts, openings = zip(*(trial(*x) for x in trials), strict=True)
    return Layout(*map(np.stack, zip(*layouts, strict=True))), np.stack(openings)


def node_states(
    told: Told, opening: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """States at the nodes, as observed."""
    trial = np.arange(len(opening))[:, None]
    omega = told.omega[trial, opening]
    if told.attitude is None:
        return omega, None
    late = start - told.ts[trial, opening]
    return omega, _carried(told.attitude[trial, opening], omega, late)


def segments_needed(angle: float, n: int, length: float) -> int:
    """How many nodes a trial needs; if the angle is not finite, for the worst case."""
    if not length:
        return min(n, MOST_NODES)
    most = n // 2 + 2
    if not 0 <= angle < math.inf:
        return most
    # 8, 32, 128, ...: few programs serve all records.
    needed = max(angle / length + 2, 8.0)
    return min(2 * 4 ** math.ceil(math.log(needed / 2, 4)), most)
