"""A motion, or many at once, each at its own pace: what `jrigid.simulate` and `jax.vmap` of it run.

Under vmap a loop goes on until its slowest lane is through, and each of its operations goes through
all lanes and out of the cache. Here few lanes step together, along the last axis; one that is
through with its motion hands in the result and takes up the next.

XLA's CPU runtime goes through a loop's operations one after the other, at 25 ns each, where all
that they touch is small (512 bytes); anything larger, or more than eight, costs twice or more. One
motion is one lane, and nothing in its loop is larger than the state.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._as_lanes import width_of
from jrigid._lanes_last import lanes_last
from jrigid._runge_kutta import kept_apart, runge_kutta_step
from jrigid._scales import rate_along
from jrigid.simulate._controller import constant, in_tolerances

# At most so many steps between two looks for lanes that are through.
_STEPS = 8
COUNTS = ("num_steps", "num_accepted_steps", "num_rejected_steps")


class Problem(NamedTuple):
    """A motion as diffrax is given it, from t = 0 on."""

    term: Any
    controller: Any
    finer: dict[str, Array]  # what of the controller is other where derivatives are taken
    y0: Array
    args: Any
    times: Array
    beyond: Array  # for each of them the number of the next that is later
    end: Array

    @property
    def first(self) -> Array:
        """For each of the times the number of the first that is equal to it."""
        return jnp.searchsorted(self.times, self.times, side="left")

    @property
    def finely(self) -> "Problem":
        """In steps for derivatives."""
        return self._replace(controller=dataclasses.replace(self.controller, **self.finer))

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


class Place(NamedTuple):
    """Where a motion is."""

    clock: _Clock
    y: Array
    rate: Array
    direction: Array  # the controller's

    @property
    def outcome(self) -> tuple:
        """What is handed in."""
        clock = self.clock
        return clock.t, self.y, clock.result, clock.steps, clock.accepted


class _Lanes(NamedTuple):
    number: Array  # of the motion, or how many there are when there are no more
    motion: Any
    place: Place


class Steps(NamedTuple):
    """How one motion steps."""

    solver: diffrax.AbstractERK
    max_steps: int

    def begin(self, problem: Problem) -> Place:
        """Where it starts."""
        term, controller, _, y0, args, times, beyond, end = problem
        zero, order = jnp.zeros_like(end), self.solver.order(None)
        tnext, state = controller.init(term, zero, end, y0, None, args, self.solver.func, order)
        target = jnp.where(times[0] > 0, 0, beyond[0])
        none = jnp.zeros((), jnp.int32)
        tnext, okay = jnp.minimum(tnext, problem.goal(target)), diffrax.RESULTS.successful
        clock = _Clock(zero, tnext, target, state[:-1], okay, none, none)
        return Place(clock, y0, problem.field(zero, y0), state[-1])

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


class Batch(NamedTuple):
    """All motions, and what has become of them."""

    steps: Steps
    fixed: Any  # of all of them
    table: Any  # of each of them
    count: int

    def over_lanes(self, function: Any, *lanes: Any) -> Any:
        """A function of one motion and of what is its own, in all lanes."""
        return lanes_last(lambda x, *y: function(eqx.combine(x, self.fixed), *y), *lanes)

    @property
    def longest_first(self) -> Array:
        """The order in which the motions begin: none is left for the end, with few beside it."""
        radians = self.over_lanes(lambda x: x.end * x.controller.start_rate, self.table)
        return jnp.argsort(-radians)

    def take(self, number: Array, order: Array | None = None) -> _Lanes:
        """The motions of these numbers, at their start."""
        there = jnp.minimum(number, self.count - 1)
        there = there if order is None else order[there]
        motion = jtu.tree_map(lambda x: x[..., there], self.table)
        return _Lanes(number, motion, self.over_lanes(self.steps.begin, motion))

    def going(self, motion: Any, place: Place) -> Array:
        """Which lanes are on their way."""
        return self.over_lanes(self.steps.going, motion, place.clock)

    def through(self, lanes: _Lanes) -> Array:
        """Which lanes are at the end of a motion."""
        return (lanes.number < self.count) & ~self.going(lanes.motion, lanes.place)

    def rates(self, motion: Any, true: Array) -> Callable[[Array, Array], Array]:
        """The field at a time and a place. `true`: so it is, but the compiler must not know."""
        return kept_apart(lambda t, y: self.over_lanes(Problem.field, motion, t, y), true)

    def attempt(self, motion: Any, place: Place) -> tuple[Place, Array, Array]:
        """A step in all lanes; which of them are at a time asked for, and at which."""
        clock, y, before, direction = place
        h, rates = clock.tnext - clock.t, self.rates(motion, clock.steps[0] >= 0)

        def rate_at(fraction: float, y: Array) -> Array:
            return rates(clock.t + fraction * h, y)

        step = runge_kutta_step(self.steps.solver.tableau, rate_at, h[None], y, before)
        y1, error, after, _ = step
        atol, rtol, scales = self.over_lanes(Problem.measures, motion)
        there, base, error = constant((y1, after, in_tolerances(atol, rtol, y, y1, error)))
        rate, along = rate_along(lambda y: rate_at(1.0, y), there, base, direction, scales)
        judge = self.steps.judge
        kept, hit, number, clock = self.over_lanes(judge, motion, clock, there, error, rate)
        pairs = (y1, y), (after, before), (along, direction)
        return Place(clock, *(jnp.where(kept[None], a, b) for a, b in pairs)), hit, number

    def hand_in(self, carry: tuple) -> tuple:
        """What has become of motions that are through, and others in their lanes."""
        lanes, cursor, saved, ends, order = carry
        through = self.through(lanes)
        where = jnp.where(through, lanes.number, self.count)

        def put(all_: Array, x: Array) -> Array:
            return all_.at[where].set(jnp.moveaxis(x, -1, 0), mode="drop")

        ends = jtu.tree_map(put, ends, lanes.place.outcome)
        number = jnp.where(through, cursor + jnp.cumsum(through) - 1, lanes.number)
        fresh = self.take(jnp.minimum(number, self.count), order)
        lanes = jtu.tree_map(lambda a, b: jnp.where(through, a, b), fresh, lanes)
        return lanes, cursor + jnp.sum(through), saved, ends, order

    def some_steps(self, carry: tuple[_Lanes, Array]) -> tuple[_Lanes, Array]:
        """On to where one is at a time asked for, which is saved, but not too far."""
        (number, motion, place), saved = carry
        none = jnp.zeros(number.shape, bool), jnp.zeros(number.shape, place.clock.target.dtype)

        def more(carry: tuple) -> Array:
            count, _, (hit, _) = carry
            return (count < _STEPS) & ~jnp.any(hit)

        def on(carry: tuple) -> tuple:
            count, place, _ = carry
            place, *found = self.attempt(motion, place)
            return count + 1, place, tuple(found)

        # Nothing large in this loop: `saved` is not.
        _, place, (hit, target) = jax.lax.while_loop(more, on, (0, place, none))

        def save(saved: Array) -> Array:
            y = jnp.moveaxis(place.y, -1, 0)
            return saved.at[jnp.where(hit, number, self.count), target].set(y, mode="drop")

        return _Lanes(number, motion, place), _when(jnp.any(hit), save, saved)

    def to_the_end(self, width: int, saved: Array) -> tuple:
        """All motions, each in its lane: what was saved on the way, what became of them."""
        lanes = self.take(jnp.minimum(jnp.arange(width), self.count))

        def more(carry: tuple[_Lanes, Array]) -> Array:
            return ~jnp.all(self.through(carry[0]) | (carry[0].number == self.count))

        lanes, saved = jax.lax.while_loop(more, self.some_steps, (lanes, saved))
        outcome = lanes.place.outcome
        return saved, jtu.tree_map(lambda x: jnp.moveaxis(x, -1, 0)[: self.count], outcome)

    def refilled(self, width: int, saved: Array) -> tuple:
        """The same of more motions than there are lanes."""
        order = self.longest_first
        lanes = self.take(jnp.arange(width), order)

        def look(carry: tuple) -> tuple:
            lanes, cursor, saved, *others = carry
            lanes, saved = self.some_steps((lanes, saved))
            some = jnp.any(self.through(lanes))
            return _when(some, self.hand_in, (lanes, cursor, saved, *others))

        def more(carry: tuple) -> Array:
            return jnp.any(carry[0].number < self.count)

        ends = jtu.tree_map(
            lambda x: jnp.zeros((self.count, *x.shape[:-1]), x.dtype), lanes.place.outcome
        )
        carry = lanes, jnp.array(width), saved, ends, order
        _, _, *found, order = jax.lax.while_loop(more, look, carry)
        return jtu.tree_map(lambda x: x[jnp.argsort(order)], tuple(found))


def _when(condition: Array, change: Callable[[Any], Any], x: Any) -> Any:
    """`change(x)` or `x`. As a loop, in place: of what goes through a branch a copy is made."""

    def once(carry: tuple[Array, Any]) -> tuple[Array, Any]:
        return jnp.zeros_like(carry[0]), change(carry[1])

    return jax.lax.while_loop(lambda carry: carry[0], once, (condition, x))[1]


def in_lanes(fixed: Any, each: Any, steps: Steps) -> Ends:
    """Motions that differ in `each`, whose leaves have a motion to each index in front."""
    count = jtu.tree_leaves(each)[0].shape[0]
    table = jtu.tree_map(lambda x: jnp.moveaxis(x, 0, -1), each)
    batch = Batch(steps, fixed, table, count)
    width = width_of(count)
    one = eqx.combine(jtu.tree_map(lambda x: x[0], each), fixed)
    saved = jnp.zeros((count, one.times.size, one.y0.size), one.y0.dtype)
    run = batch.refilled if width < count else batch.to_the_end
    saved, (t, y, result, made, accepted) = run(width, saved)

    def finish(motion: Any, saved: Array, t: Array, result: Any) -> tuple[Array, Array, Any]:
        problem = eqx.combine(motion, fixed)
        ys = jnp.where(problem.times[:, None] > 0, saved[problem.first], problem.y0[None])
        there = problem.times <= t
        short = (result == diffrax.RESULTS.successful) & (t < problem.end)
        result = diffrax.RESULTS.where(short, diffrax.RESULTS.max_steps_reached, result)
        reached = jnp.where(there, problem.times, jnp.inf)
        return reached, jnp.where(there[:, None], ys, jnp.inf), result

    reached, ys, result = jax.vmap(finish)(each, saved, t, result)
    counts = zip(COUNTS, (made, accepted, made - accepted), strict=True)
    return Ends(reached, ys, t, y, result, dict(counts))
