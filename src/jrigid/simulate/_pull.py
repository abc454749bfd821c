"""Reverse mode: what a change of its states asks of a motion, pulled back through its steps.

A run keeps where its lanes are before each attempt at a step, or before every so many where not all
have a place; what lies between two is run again, by the same compiled step, when its turn comes.
Each step is then one of known length, which has a derivative like any function.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._as_lanes import some_at_a_time
from jrigid._runge_kutta import runge_kutta_step
from jrigid.simulate._lanes import Batch, Place, Problem, Steps

# So many places are kept, within so many bytes: a run of n attempts is run again some
# log(n) / log(places) times.
_FEWEST, _MOST, _BYTES = 256, 4096, 2**25
_UNKNOWN = -1


class _Kept(NamedTuple):
    """Where the lanes are before some attempts, the earliest first."""

    places: Any
    attempts: Array  # their numbers
    count: Array

    @property
    def room(self) -> Array:
        """For how many more."""
        return self.attempts.size - self.count

    @property
    def last(self) -> tuple[Place, Array]:
        """The latest, and its number."""
        at = self.count - 1
        return jtu.tree_map(lambda x: x[at], self.places), self.attempts[at]

    def put(self, place: Place, attempt: Array, count: Array) -> "_Kept":
        """One more, if need be instead of the latest; of all only so many count."""
        at = jnp.minimum(self.count, self.attempts.size - 1)
        places = jtu.tree_map(lambda all_, x: all_.at[at].set(x), self.places, place)
        return _Kept(
            places, self.attempts.at[at].set(attempt), jnp.minimum(count, self.attempts.size)
        )


class _Back(NamedTuple):
    """How far the cotangents have come."""

    attempt: Array  # before which the lanes are where they belong; unknown on the way to the end
    t: Array  # when that is
    target: Array  # the number of the next of the times, or -1
    y: Array
    moved: Any


class _Block(NamedTuple):
    """Motions that are pulled back together; `moved` is what has cotangents, `rest` what not."""

    steps: Steps
    shared: Any
    rest: Any
    moved: Any
    change: Array  # of the states at the times, for the first of equal ones; lanes last
    estimate: Array  # of the number of attempts

    @property
    def table(self) -> Any:
        """What is each motion's own."""
        return eqx.combine(self.rest, self.moved)

    @property
    def batch(self) -> Batch:
        """The motions."""
        return Batch(self.steps, self.shared, self.table, self.change.shape[-1])

    def forwards(self, last: tuple[Place, Array], kept: tuple[Array, Array], back: _Back) -> Any:
        """Some attempts on from the latest place that is kept: one more of them."""
        count, room = kept
        place, attempt = last
        running = back.attempt == _UNKNOWN
        left = jnp.maximum(jnp.where(running, self.estimate, back.attempt - 1) - attempt, 1)
        stride = jnp.where(left <= room, 1, -(-left // jnp.maximum(room // 2, 1)))

        def more(carry: tuple[Array, Place]) -> Array:
            return (carry[0] < stride) & jnp.any(self.batch.going(self.table, carry[1]))

        def on(carry: tuple[Array, Place]) -> tuple[Array, Place]:
            return carry[0] + 1, self.batch.attempt(self.table, carry[1])[0]

        made, place = jax.lax.while_loop(more, on, (jnp.zeros_like(stride), place))
        attempt = attempt + made
        # Where the run ends there is nothing to attempt.
        ended = running & ~jnp.any(self.batch.going(self.table, place))
        t = jnp.where(ended, place.clock.t, back.t)
        back = back._replace(attempt=jnp.where(ended, attempt, back.attempt), t=t)
        return (place, attempt), jnp.where(ended, count, count + 1), back

    def backwards(self, last: tuple[Place, Array], kept: tuple[Array, Array], back: _Back) -> Any:
        """The cotangents before the latest attempt that is kept: one less."""
        place, _ = last
        t = place.clock.t
        h = back.t - t  # none for an attempt that failed, and in a lane that has ended
        asked, target = self.batch.over_lanes(
            _asked, self.table, self.change, back.target, t, back.t
        )

        def step(moved: Any, y: Array) -> Array:
            rates = self.batch.rates(eqx.combine(self.rest, moved), back.attempt > 0)

            def rate_at(fraction: float, y: Array) -> Array:
                return rates(t + fraction * h, y)

            tableau = self.steps.solver.tableau
            return runge_kutta_step(tableau, rate_at, h[None], y, rate_at(0.0, y)).y1

        moved, y = jax.vjp(step, self.moved, place.y)[1](back.y + asked)
        moved = jtu.tree_map(jnp.add, back.moved, moved)
        return last, kept[0] - 1, _Back(back.attempt - 1, t, target, y, moved)

    def pull(self, change: Array, target: Array) -> Any:
        """The cotangents of `moved`, of a change of the last state and of those at the times."""
        batch = self.batch
        start = batch.take(jnp.arange(batch.count)).place
        size = _BYTES // sum(x.nbytes for x in jtu.tree_leaves(start))
        size = min(max(size, _FEWEST), _MOST)
        places = jtu.tree_map(lambda x: jnp.zeros((size, *x.shape), x.dtype), start)
        none = jnp.zeros((), jnp.int32)
        kept = _Kept(places, jnp.zeros(size, jnp.int32), none).put(start, none, none + 1)
        zeros = jtu.tree_map(jnp.zeros_like, self.moved)
        late = jnp.full_like(start.clock.t, jnp.inf)
        back = _Back(jnp.full_like(none, _UNKNOWN), late, target, change, zeros)

        def on(carry: tuple[_Kept, _Back]) -> tuple[_Kept, _Back]:
            kept, back = carry
            missing = kept.last[1] != back.attempt - 1
            # All that is kept goes through no branch: it would be copied.
            (place, attempt), count, back = jax.lax.cond(
                missing, self.forwards, self.backwards, kept.last, (kept.count, kept.room), back
            )
            return kept.put(place, attempt, count), back

        _, back = jax.lax.while_loop(lambda carry: carry[1].attempt != 0, on, (kept, back))
        first = self.batch.over_lanes(_at_start, self.table, self.change)
        return back.moved._replace(y0=back.moved.y0 + back.y + first)


def _before(problem: Problem) -> Array:
    """For each of the times the number of the first of those that come next before it, or -1."""
    first = problem.first
    return jnp.where(first > 0, first[first - 1], -1)


def _asked(
    problem: Problem, change: Array, target: Array, t: Array, later: Array
) -> tuple[Array, Array]:
    """The change of the state at the end of a step, if it is asked for, and the next target."""
    hit = (target >= 0) & (later > t) & (later <= problem.times[target])
    return jnp.where(hit, change[target], 0.0), jnp.where(hit, _before(problem)[target], target)


def _at_start(problem: Problem, change: Array) -> Array:
    return jnp.where(problem.times[0] > 0, 0.0, change[0])


def pull_in_lanes(
    steps: Steps, shared: Any, rest: Any, moved: Any, changes: Any, reached: Any
) -> Any:
    """Cotangents of `moved`, of changes of the last state and of those at the times.

    All but what is shared has a motion to each index in front. `reached`: where each ended, after
    how many attempts.
    """

    def block(rest: Any, moved: Any, changes: Any, reached: Any) -> Any:
        (last, ys), (t, made), table = changes, reached, eqx.combine(rest, moved)
        ys, target = Batch(steps, shared, table, t.size).over_lanes(_firsts, table, ys, t)
        return _Block(steps, shared, rest, moved, ys, jnp.max(made)).pull(last, target)

    # Motions of the same length go together: none waits for another.
    order = jnp.argsort(reached[1])
    return some_at_a_time(block, order, rest, moved, changes, reached)


def _firsts(problem: Problem, change: Array, t: Array) -> tuple[Array, Array]:
    """Changes at equal times with the first of them; the first of the last that were reached."""
    first = problem.first
    there = problem.times <= t
    change = jnp.zeros_like(change).at[first].add(jnp.where(there[:, None], change, 0.0))
    count = jnp.sum(there)
    return change, jnp.where(count > 0, first[count - 1], -1)
