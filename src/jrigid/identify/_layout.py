"""Where a record is cut into segments, and the states they start from."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._checks import is_concrete
from jrigid._numerics import safe_norm
from jrigid.identify._records import Record, Samples
from jrigid.rotation import conjugate, exp, log, multiply, normalize

MOST_NODES = 2000  # of a throw, where each sample has one


class Layout(NamedTuple):
    """Times of all samples, their nodes, and where links go: (throws, samples) and (throws, nodes).

    An unused node has no samples and no links.
    """

    ts: Array
    node: Array
    start: Array
    end: Array
    linked: Array
    since: Array  # fraction of the record at each sample


class Told(NamedTuple):
    """Rates, and attitudes if there are any, that tell where the segments start: (throws, n)."""

    ts: Array
    there: Array
    omega: Array
    attitude: Array | None


def first_and_last(ts: Array, there: Array) -> tuple[Array, Array]:
    """Times of the first and last samples of each throw; zero for one without samples."""
    first = jnp.min(jnp.where(there, ts, jnp.inf), axis=1)
    last = jnp.max(jnp.where(there, ts, -jnp.inf), axis=1)
    some = jnp.any(there, axis=1)
    return jnp.where(some, first, 0.0), jnp.where(some, last, 0.0)


def _nearest_before(ts: Array, there: Array, t: Array) -> Array:
    """Index of the last sample not after t; of the first one if all are later."""
    times = jnp.where(there, ts, jnp.inf)
    before = jnp.where(there & (ts <= t), ts, -jnp.inf)
    return jnp.where(jnp.any(there & (ts <= t)), jnp.argmax(before), jnp.argmin(times))


def _slopes(ts: Array, there: Array, attitude: Array) -> Array:
    """Rates from attitudes: the mean of the turns to the samples on either side."""
    count = ts.shape[0]
    index = jnp.arange(count)
    last = jax.lax.associative_scan(jnp.maximum, jnp.where(there, index, -1))
    before = jnp.concatenate([jnp.full(1, -1), last[:-1]])
    following = jnp.where(there, index, count)[::-1]
    next_ = jax.lax.associative_scan(jnp.minimum, following)[::-1]
    after = jnp.concatenate([next_[1:], jnp.full(1, count)])

    def turn(a: Array, b: Array) -> tuple[Array, Array]:
        ok = (a >= 0) & (b < count)
        a, b = jnp.clip(a, 0, count - 1), jnp.clip(b, 0, count - 1)
        step = ts[b] - ts[a]
        ok = ok & (step > 0)
        vector = log(normalize(multiply(conjugate(attitude[a]), attitude[b])))
        return jnp.where(ok, vector / jnp.where(ok, step, 1.0), 0.0), ok.astype(ts.dtype)

    def at(i: Array) -> Array:
        left, a = turn(before[i], i)
        right, b = turn(i, after[i])
        return (left + right) / jnp.maximum(a + b, 1.0)

    return jax.vmap(at)(index)


def _carried(attitude: Array, omega: Array, late: Array) -> Array:
    """Attitudes a time later, at the rates there: (throws, n)."""
    turn = jax.vmap(jax.vmap(lambda q, w, dt: multiply(q, exp(w * dt))))
    return turn(attitude, omega, late)


def told_by(records: tuple[Record, ...], samples: Samples, attitude0: Array | None) -> Told | None:
    """What tells the state on the way: a gyro, or attitudes; None if there is neither."""

    def first(name: str) -> tuple[Array, Array, Array] | None:
        for record, values, part in zip(records, samples.values, samples.parts, strict=True):
            seen = jax.vmap(jax.vmap(getattr(record.sensor, name)))(values)
            if seen is not None:
                weight, sign = samples.weight[:, part], samples.sign[:, part]
                there = jnp.all((weight > 0) & (sign == 0), axis=-1)
                return jnp.where(there, samples.ts[:, part], 0.0), there, seen
        return None

    rates, attitudes = first("rates"), first("attitude")
    if rates is None:
        if attitudes is None:
            return None
        return Told(*attitudes[:2], jax.vmap(_slopes)(*attitudes), attitudes[2])
    ts, there, omega = rates
    omega = jnp.where(there[..., None], omega, 0.0)
    if attitudes is not None:
        q_ts, q_there, q = attitudes
        latest = jax.vmap(lambda t, a, b: jax.vmap(lambda t: _nearest_before(a, b, t))(t))(
            ts, q_ts, q_there
        )
        at = jax.vmap(lambda x, i: x[i])
        seen, late = at(q, latest), ts - at(q_ts, latest)
        fresh = jnp.concatenate(
            [jnp.ones_like(there[:, :1]), latest[:, 1:] != latest[:, :-1]], axis=1
        )
        found = jax.vmap(_reckoned)(ts, there, omega, q[:, 0], _carried(seen, omega, late), fresh)
        return Told(ts, there, omega, found)
    if attitude0 is None:
        return Told(ts, there, omega, None)
    none = jnp.zeros((*ts.shape, 4), ts.dtype).at[..., 0].set(1), jnp.zeros(ts.shape, bool)
    return Told(ts, there, omega, jax.vmap(_reckoned)(ts, there, omega, attitude0, *none))


def _reckoned(
    ts: Array, there: Array, omega: Array, attitude0: Array, seen: Array, fresh: Array
) -> Array:
    """Attitudes by dead reckoning from those that are fresh: by the mean of neighbouring rates."""

    def turn(carry: tuple, sample: tuple) -> tuple[tuple, Array]:
        q, t, w, any_ = carry
        time, rate, ok, now, anew = sample
        step = jnp.where(ok & any_, time - t, 0.0)
        q = normalize(multiply(q, exp(0.5 * (w + rate) * step)))
        q = jnp.where(anew, now, q)
        carry = q, jnp.where(ok, time, t), jnp.where(ok, rate, w), any_ | ok
        return carry, q

    start = attitude0, ts[0], omega[0], jnp.asarray(False)
    return jax.lax.scan(turn, start, (ts, omega, there, seen, fresh))[1]


def angle_turned(told: Told) -> Array:
    """Radians turned up to each sample, from the rates there."""

    def throw(ts: Array, there: Array, omega: Array) -> Array:
        speed = jnp.where(there, jax.vmap(safe_norm)(omega), 0.0)

        def add(carry: tuple, sample: tuple) -> tuple[tuple, Array]:
            total, t, w, any_ = carry
            time, rate, ok = sample
            step = jnp.where(ok & any_, jnp.maximum(time - t, 0.0), 0.0)
            total = total + 0.5 * (rate + w) * step
            carry = total, jnp.where(ok, time, t), jnp.where(ok, rate, w), any_ | ok
            return carry, total

        zero = jnp.zeros_like(ts[0])
        return jax.lax.scan(add, (zero, zero, zero, jnp.asarray(False)), (ts, speed, there))[1]

    return jax.vmap(throw)(told.ts, told.there, told.omega)


def is_coarse(told: Told) -> Array:
    """Whether a body turns by more than half a turn from one sample to the next."""
    return jnp.max(jnp.diff(angle_turned(told), axis=1), initial=0.0) > jnp.pi


def whole(samples: Samples, nodes: int, t0: Array | None = None) -> Layout:
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
    ts, whole_ = samples.ts, whole(samples, nodes)
    count = jnp.cumsum(told.there, axis=1).astype(ts.dtype)
    measure = angle_turned(told) if length else count - 0.5

    def throw(measure: Array, times: Array, ok: Array) -> tuple[Array, ...]:
        most = max(nodes - 1, 1) if length else nodes
        part = jnp.maximum(length or 1.0, measure[-1] / most)
        part = jnp.floor(measure / part * (1 - 1e-12)).astype(int)
        count = part.size

        def rank(carry: tuple, sample: tuple) -> tuple[tuple, Array]:
            last, index = carry
            now, here = sample
            new = here & (now != last)
            index = jnp.where(new, index + 1, index)
            return (jnp.where(new, now, last), index), index

        _, index = jax.lax.scan(rank, (jnp.asarray(-1), jnp.asarray(-1)), (part, ok))
        index = jnp.clip(index, 0, nodes - 1)
        opening = jax.ops.segment_min(jnp.where(ok, jnp.arange(count), count), index, nodes)
        used = opening < count
        opening = jnp.where(used, opening, 0)
        return opening, used, times[opening]

    opening, used, start = jax.vmap(throw)(measure, told.ts, told.there)
    # The first node stands at the first sample of any kind.
    start = start.at[:, 0].set(whole_.start[:, 0])
    reach = jnp.where(used, start, jnp.inf)
    node = jax.vmap(
        lambda starts, t: jnp.clip(
            jnp.searchsorted(starts, t, side="right").astype(int) - 1, 0, nodes - 1
        )
    )(reach, ts)
    following = jnp.concatenate([used[:, 1:], jnp.zeros_like(used[:, :1])], axis=1)
    linked = used & following
    end = jnp.where(linked, jnp.roll(start, -1, axis=1), start)
    return Layout(ts, node, start, end, linked, whole_.since), opening


def node_states(told: Told, opening: Array, start: Array) -> tuple[Array, Array | None]:
    """States at the nodes, as observed."""
    omega = jax.vmap(lambda w, i: w[i])(told.omega, opening)
    if told.attitude is None:
        return omega, None
    at = jax.vmap(lambda q, i: q[i])(told.attitude, opening)
    late = start - jax.vmap(lambda t, i: t[i])(told.ts, opening)
    return omega, _carried(at, omega, late)


def segments_needed(angle: Array, n: int, length: float) -> int:
    """How many nodes a throw needs; if the angle is not known yet, for the worst case."""
    if not length:
        return min(n, MOST_NODES)
    most = n // 2 + 2
    if not is_concrete(angle) or not float(angle) >= 0:
        return most
    needed = 2
    while needed < float(angle) / length + 2:
        needed *= 2
    return min(needed, most)
