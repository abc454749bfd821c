"""A motion, or many at once, each at its own pace: what `jrigid.simulate` and `jax.vmap` of it run.

Under vmap a loop goes on until its slowest lane is through, and each of its operations goes through
all lanes and out of the cache. Here few lanes step together, along the last axis; one that is
through with its motion hands in the result and takes up the next.

XLA's CPU runtime goes through a loop's operations one after the other, at 25 ns each, where all
that they touch is small (512 bytes); anything larger, or more than eight, costs twice or more. One
motion is one lane, and nothing in its loop is larger than the state.
"""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._lanes_last import lanes_last
from jrigid._runge_kutta import runge_kutta_step
from jrigid._scales import rate_along
from jrigid.simulate._controller import in_tolerances

# So many lanes have their stages in a core's second-level cache; a vector register holds 8 of them.
# Elsewhere than on a CPU many more are needed to keep it busy.
_WIDTH, _WIDTH_ELSEWHERE, _REGISTER = 128, 2**14, 8
# Steps between two looks for lanes that are through.
_STEPS = 8
COUNTS = ("num_steps", "num_accepted_steps", "num_rejected_steps")


class Problem(NamedTuple):
    """A motion as diffrax is given it, from t = 0 on."""

    term: Any
    controller: Any
    y0: Array
    args: Any
    times: Array
    beyond: Array  # for each of them the number of the next that is later
    end: Array

    def field(self, t: Array, y: Array) -> Array:
        """The rates."""
        return self.term.vf(t, y, self.args)

    def goal(self, target: Array) -> Array:
        """The next of the times, by its number, or the end."""
        return jnp.where(target < self.times.size, self.times[target], self.end)

    def measures(self) -> tuple[Array, Array, Array]:
        """Absolute and relative tolerance, scales."""
        return self.controller.atol, self.controller.rtol, self.controller.scales


class Ends(NamedTuple):
    """What became of it."""

    reached: Array  # times, infinite where it did not get to
    ys: Array
    t: Array  # where it ended
    y: Array
    result: Any
    stats: dict[str, Array]


class _Clock(NamedTuple):
    """How far a lane is."""

    t: Array
    tnext: Array
    target: Array  # the number of the next of the times
    controller: Any
    result: Any
    steps: Array
    accepted: Array


class _Lanes(NamedTuple):
    number: Array  # of the motion, or how many there are when there are no more
    motion: Any
    clock: _Clock
    y: Array
    rate: Array
    direction: Array  # the controller's

    @property
    def outcome(self) -> tuple:
        """What is handed in."""
        clock = self.clock
        return clock.t, self.y, clock.result, clock.steps, clock.accepted


class _Steps(NamedTuple):
    """How one motion steps."""

    solver: diffrax.AbstractERK
    max_steps: int

    def begin(self, problem: Problem) -> tuple[_Clock, Array, Array, Array]:
        """Where it starts."""
        term, controller, y0, args, times, beyond, end = problem
        zero, order = jnp.zeros_like(end), self.solver.order(None)
        tnext, state = controller.init(term, zero, end, y0, None, args, self.solver.func, order)
        target = jnp.where(times[0] > 0, 0, beyond[0])
        none = jnp.zeros((), jnp.int32)
        tnext, okay = jnp.minimum(tnext, problem.goal(target)), diffrax.RESULTS.successful
        clock = _Clock(zero, tnext, target, state[:-1], okay, none, none)
        return clock, y0, problem.field(zero, y0), state[-1]

    def going(self, problem: Problem, clock: _Clock) -> Array:
        """Whether it is on its way."""
        fine = clock.result == diffrax.RESULTS.successful
        return (clock.t < problem.end) & fine & (clock.steps < self.max_steps)

    def judge(self, problem: Problem, clock: _Clock, y: Array, error: Array, rate: Array) -> Any:
        """Whether a step stands, whether it ends at a time asked for and which, and the next."""
        controller, goes = problem.controller, self.going(problem, clock)
        rate, order = controller.rate_of(y, rate), self.solver.order(None)
        kept, t, tnext, _, state, result = controller.judged(
            clock.t, clock.tnext, error, order, clock.controller, rate
        )
        kept = kept & goes
        place = jnp.minimum(clock.target, problem.times.size - 1)
        hit = kept & (clock.target < problem.times.size) & (clock.tnext >= problem.times[place])
        target = jnp.where(hit, problem.beyond[place], clock.target)
        goal = problem.goal(target)
        # No sliver is left before it.
        tnext = jnp.where(tnext > goal * (1 - 100 * jnp.finfo(t.dtype).eps), goal, tnext)
        new = _Clock(
            jnp.minimum(t, problem.end), tnext, target, state, result,
            clock.steps + 1, clock.accepted + kept.astype(jnp.int32),
        )  # fmt: skip
        return kept, hit, place, jtu.tree_map(lambda a, b: jnp.where(goes, a, b), new, clock)


class _Batch(NamedTuple):
    """All motions, and what has become of them."""

    steps: _Steps
    fixed: Any  # of all of them
    table: Any  # of each of them
    count: int

    def over_lanes(self, function: Any, *lanes: Any) -> Any:
        """A function of one motion and of what is its own, in all lanes."""
        return lanes_last(lambda x, *y: function(eqx.combine(x, self.fixed), *y), *lanes)

    def take(self, number: Array) -> _Lanes:
        """The motions of these numbers, at their start."""
        there = jnp.minimum(number, self.count - 1)
        motion = jtu.tree_map(lambda x: x[..., there], self.table)
        return _Lanes(number, motion, *self.over_lanes(self.steps.begin, motion))

    def through(self, lanes: _Lanes) -> Array:
        """Which lanes are at the end of a motion."""
        on_the_way = self.over_lanes(self.steps.going, lanes.motion, lanes.clock)
        return (lanes.number < self.count) & ~on_the_way

    def advance(self, carry: tuple[_Lanes, Array]) -> tuple[_Lanes, Array]:
        """A step in all lanes."""
        lanes, saved = carry
        number, motion, clock, y, before, direction = lanes
        h = (clock.tnext - clock.t)[None]

        @jax.jit  # traced once for all stages
        def rates(t: Array, place: Array) -> Array:
            # What goes into a branch and what comes out of it has been computed, once.
            def field(place: Array) -> Array:
                return self.over_lanes(Problem.field, motion, t, place)

            return jax.lax.cond(some, field, lambda x: x, place)

        def rate_at(fraction: float, place: Array) -> Array:
            return rates(clock.t + fraction * h[0], place)

        some = jnp.any(number < self.count)
        step = runge_kutta_step(self.steps.solver.tableau, rate_at, h, y, before)
        y1, error, after, _ = step
        atol, rtol, scales = self.over_lanes(Problem.measures, motion)
        rate, along = rate_along(lambda y: rate_at(1.0, y), y1, after, direction, scales)
        error = in_tolerances(atol, rtol, y, y1, error)
        kept, hit, place, clock = self.over_lanes(self.steps.judge, motion, clock, y1, error, rate)
        pairs = (y1, y), (after, before), (along, direction)
        y, before, direction = (jnp.where(kept[None], new, old) for new, old in pairs)

        def save(saved: Array) -> Array:
            return saved.at[jnp.where(hit, number, self.count), place].set(y.T, mode="drop")

        saved = jax.lax.cond(jnp.any(hit), save, lambda x: x, saved)
        return _Lanes(number, motion, clock, y, before, direction), saved

    def hand_in(self, carry: tuple) -> tuple:
        """What has become of motions that are through, and others in their lanes."""
        lanes, cursor, saved, ends = carry
        through = self.through(lanes)
        where = jnp.where(through, lanes.number, self.count)

        def put(all_: Array, x: Array) -> Array:
            return all_.at[where].set(jnp.moveaxis(x, -1, 0), mode="drop")

        ends = jtu.tree_map(put, ends, lanes.outcome)
        number = jnp.where(through, cursor + jnp.cumsum(through) - 1, lanes.number)
        fresh = self.take(jnp.minimum(number, self.count))
        lanes = jtu.tree_map(lambda a, b: jnp.where(through, a, b), fresh, lanes)
        return lanes, cursor + jnp.sum(through), saved, ends

    def look(self, carry: tuple) -> tuple:
        """Some steps, and a look for lanes that are through."""
        lanes, cursor, saved, ends = carry
        lanes, saved = jax.lax.fori_loop(0, _STEPS, lambda _, x: self.advance(x), (lanes, saved))
        carry = lanes, cursor, saved, ends
        some = jnp.any(self.through(lanes))
        return jax.lax.cond(some, self.hand_in, lambda x: x, carry)


def in_lanes(fixed: Any, each: Any, solver: diffrax.AbstractERK, max_steps: int) -> Ends:
    """Motions that differ in `each`, whose leaves have a motion to each index in front."""
    count = jtu.tree_leaves(each)[0].shape[0]
    table = jtu.tree_map(lambda x: jnp.moveaxis(x, 0, -1), each)
    batch = _Batch(_Steps(solver, max_steps), fixed, table, count)
    widest = _WIDTH if jax.default_backend() == "cpu" else _WIDTH_ELSEWHERE
    width = min(widest, -(-count // _REGISTER) * _REGISTER if count > _REGISTER else count)
    lanes = batch.take(jnp.minimum(jnp.arange(width), count))
    ends = jtu.tree_map(lambda x: jnp.zeros((count, *x.shape[:-1]), x.dtype), lanes.outcome)
    one = eqx.combine(jtu.tree_map(lambda x: x[0], each), fixed)
    saved = jnp.zeros((count, one.times.size, one.y0.size), one.y0.dtype)
    carry = (lanes, jnp.array(min(width, count)), saved, ends)
    *_, saved, ends = jax.lax.while_loop(lambda x: jnp.any(x[0].number < count), batch.look, carry)
    t, y, result, steps, accepted = ends

    def finish(motion: Any, saved: Array, t: Array, result: Any) -> tuple[Array, Array, Any]:
        problem = eqx.combine(motion, fixed)
        first = jnp.searchsorted(problem.times, problem.times, side="left")
        ys = jnp.where(problem.times[:, None] > 0, saved[first], problem.y0[None])
        there = problem.times <= t
        short = (result == diffrax.RESULTS.successful) & (t < problem.end)
        result = diffrax.RESULTS.where(short, diffrax.RESULTS.max_steps_reached, result)
        reached = jnp.where(there, problem.times, jnp.inf)
        return reached, jnp.where(there[:, None], ys, jnp.inf), result

    reached, ys, result = jax.vmap(finish)(each, saved, t, result)
    counts = zip(COUNTS, (steps, accepted, steps - accepted), strict=True)
    return Ends(reached, ys, t, y, result, dict(counts))
