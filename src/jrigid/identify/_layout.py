"""Where a record is cut into segments, and the states they start from."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._numerics import safe_norm
from jrigid._types import AnyArray
from jrigid.identify._records import Record, Samples, first_and_last
from jrigid.rotation import conjugate, exp, log, multiply, normalize

MOST_NODES = 2000  # of a throw, where each sample has one


class Layout(NamedTuple):
    """Times of all samples, their nodes, and where links go: (throws, samples) and (throws, nodes).

    An unused node has no samples and no links.
    """

    ts: AnyArray
    node: AnyArray
    start: AnyArray
    end: AnyArray
    linked: AnyArray
    since: AnyArray  # fraction of the record at each sample


class Told(NamedTuple):
    """Rates, and attitudes if there are any, that tell where the segments start: (throws, n)."""

    ts: Array
    there: Array
    omega: Array
    attitude: Array | None


def _before(there: Array) -> Array:
    """Index of the last sample that is there, before each; -1 up to the first."""
    latest = jax.lax.cummax(jnp.where(there, jnp.arange(there.size), -1))
    return jnp.roll(latest, 1).at[0].set(-1)


def _nearest_before(ts: Array, there: Array, t: Array) -> Array:
    """Index of the last sample not after each t; of the first one if all are later."""
    times = jax.lax.cummax(jnp.where(there, ts, -jnp.inf))
    after = jnp.searchsorted(times, t, side="right")
    latest = _before(jnp.append(there, False))[after]
    return jnp.where(latest < 0, jnp.argmax(there), latest)


def _slopes(ts: Array, there: Array, attitude: Array) -> Array:
    """Rates from attitudes: the mean of the turns to the samples on either side."""
    count, before = ts.size, _before(there)
    after = count - 1 - _before(there[::-1])[::-1]

    def turn(a: Array, b: Array) -> tuple[Array, Array]:
        step = ts[b] - ts[a]
        ok = (a >= 0) & (b < count) & (step > 0)
        vector = log(normalize(multiply(conjugate(attitude[a]), attitude[b])))
        return jnp.where(ok, vector / jnp.where(ok, step, 1.0), 0.0), ok

    def at(i: Array) -> Array:
        (left, is_left), (right, is_right) = turn(before[i], i), turn(i, after[i])
        return (left + right) / jnp.where(is_left & is_right, 2.0, 1.0)

    return jax.vmap(at)(jnp.arange(count))


def _turned(ts: Array, there: Array, rates: Array) -> Array:
    """Rates (n, k) by time, since the sample before: by the mean of the two."""
    last = _before(there)
    step = jnp.where(there & (last >= 0), jnp.maximum(ts - ts[last], 0.0), 0.0)
    return 0.5 * (rates[last] + rates) * step[:, None]


_carried = jax.vmap(lambda q, rate, late: multiply(q, exp(rate * late)))  # an attitude on the way


def _reckoned(ts: Array, there: Array, omega: Array, q_ts: Array, q_ok: Array, q: Array) -> Array:
    """Attitudes by dead reckoning, each from the last that was seen."""
    latest = _nearest_before(q_ts, q_ok, ts)
    seen = _carried(q[latest], omega, ts - q_ts[latest])
    fresh = (latest != jnp.roll(latest, 1)).at[0].set(True)

    def turn(q: Array, sample: tuple) -> tuple[Array, Array]:
        vector, now, anew = sample
        q = jnp.where(anew, now, normalize(multiply(q, exp(vector))))
        return q, q

    return jax.lax.scan(turn, q[0], (_turned(ts, there, omega), seen, fresh))[1]


def told_by(records: tuple[Record, ...], samples: Samples, attitude0: Array | None) -> Told | None:
    """What tells the state on the way: a gyro, or attitudes; None if there is neither."""

    def first(name: str) -> tuple[Array, Array, Array] | None:
        for record, values, part in zip(records, samples.values, samples.parts, strict=True):
            seen = jax.vmap(jax.vmap(getattr(record.sensor, name)))(values)
            if seen is not None:
                plain = (samples.weight[:, part] > 0) & (samples.sign[:, part] == 0)
                there = jnp.all(plain, axis=-1)
                return jnp.where(there, samples.ts[:, part], 0.0), there, seen
        return None

    rates, attitudes = first("rates"), first("attitude")
    if rates is None:
        return attitudes and Told(*attitudes[:2], jax.vmap(_slopes)(*attitudes), attitudes[2])
    ts, there, omega = rates
    omega = jnp.where(there[..., None], omega, 0.0)
    if attitudes is None and attitude0 is not None:
        start = first_and_last(ts, there)[0][:, None]
        attitudes = start, jnp.ones_like(start, bool), attitude0[:, None]
    found = attitudes and jax.vmap(_reckoned)(ts, there, omega, *attitudes)
    return Told(ts, there, omega, found)


def angle_turned(told: Told) -> Array:
    """Radians turned up to each sample, from the rates there."""
    speed = jnp.where(told.there, jax.vmap(jax.vmap(safe_norm))(told.omega), 0.0)
    turned = jax.vmap(_turned)(told.ts, told.there, speed[..., None])
    return jnp.cumsum(turned[..., 0], axis=1)


def longest_turn(told: Told) -> Array:
    """The most that a body turns from one sample to the next [rad]."""
    return jnp.max(jnp.diff(angle_turned(told), axis=1), initial=0.0)


def whole(samples: Samples, nodes: int, t0: AnyArray | None = None) -> Layout:
    """One segment a throw, in the first of so many nodes; its state at t0, or the first sample."""
    ts = samples.ts
    first, last = first_and_last(ts, samples.seen)
    zero = jnp.zeros((ts.shape[0], nodes), ts.dtype)
    start = zero.at[:, 0].set(first if t0 is None else t0)
    span = jnp.where(last > first, last - first, 1.0)
    since = (ts - first[:, None]) / span[:, None]
    return Layout(ts, jnp.zeros(ts.shape, int), start, start, zero > 0, since)


def segments(samples: Samples, told: Told, nodes: int, length: float) -> tuple[Layout, Array]:
    """Segments of so many radians, or, of length 0, one a sample; and where each starts.

    They are longer where the nodes do not suffice.
    """
    layout = whole(samples, nodes)
    count = jnp.cumsum(told.there, axis=1).astype(samples.ts.dtype)
    most = max(nodes - 1, 1) if length else nodes

    def throw(layout: Layout, measure: Array, times: Array, ok: Array) -> tuple[Layout, Array]:
        part = jnp.maximum(length or 1.0, measure[-1] / most)
        part, last = jnp.floor(measure / part * (1 - 1e-12)).astype(int), _before(ok)
        new = ok & ((last < 0) | (part != part[last]))
        opening, used = jnp.nonzero(new, size=nodes)[0], jnp.arange(nodes) < jnp.sum(new)
        # The first node stands at the first sample of any kind.
        start = times[opening].at[0].set(layout.start[0])
        node = jnp.searchsorted(jnp.where(used, start, jnp.inf), layout.ts, side="right") - 1
        linked = jnp.append(used[1:], False)
        end = jnp.where(linked, jnp.roll(start, -1), start)
        node = jnp.clip(node.astype(int), 0, nodes - 1)
        return Layout(layout.ts, node, start, end, linked, layout.since), opening

    measure = angle_turned(told) if length else count - 0.5
    return jax.vmap(throw)(layout, measure, told.ts, told.there)


def node_states(told: Told, opening: Array, start: Array) -> tuple[Array, Array | None]:
    """States at the nodes, as observed."""
    at = jax.vmap(lambda told, i: jtu.tree_map(lambda x: x[i], told))(told, opening)
    if at.attitude is None:
        return at.omega, None
    return at.omega, jax.vmap(_carried)(at.attitude, at.omega, start - at.ts)


def segments_needed(angle: Array, n: int, length: float) -> int:
    """How many nodes a throw needs; if the angle is not finite, for the worst case."""
    if not length:
        return min(n, MOST_NODES)
    most = n // 2 + 2
    if not 0 <= float(angle) < math.inf:
        return most
    # 8, 32, 128, ...: few programs serve all records.
    needed = max(float(angle) / length + 2, 8.0)
    return min(2 * 4 ** math.ceil(math.log(needed / 2, 4)), most)
