"""Reverse mode: a motion is run again, and its steps are taken back from its end.

The rates of the stages are kept for some hundred attempts at a step. A longer motion is
run from its start once, to keep its state every so many attempts, then part after part
from the last of these states. Rejected attempts are kept too, as steps of length zero:
so all lanes count the same attempts.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int

from jrigid._core.lanes import some_at_a_time
from jrigid._core.lanes_last import lanes_last
from jrigid._stepping.engine import Engine
from jrigid._stepping.motion import Motion, Progress
from jrigid._stepping.step import apart

# Rates are kept for so many attempts, within so many bytes.
_FEWEST, _MOST, _BYTES = 64, 1024, 2**26
# So many states are kept.
_KEPT = 256


class Changes(NamedTuple):
    """Cotangents of the results of a motion: the states at its times and at its end."""

    ys: Float[Array, "*motions times n"]
    y: Float[Array, "*motions n"]


class _Step(NamedTuple):
    """An attempt that is kept.

    Attributes:
        place: Time and length of the step, then the state at its start, as one array.
        rates: Of its stages.
        output: The number of the output time that it reached.
    """

    place: Float[Array, " n+2"]
    rates: Float[Array, "stages n"]
    output: Int[Array, ""]


class _Kept(NamedTuple):
    """States that are kept, in order; those from `count` on are out of date."""

    progress: Progress
    attempts: Int[Array, " kept"]
    count: Int[Array, ""]


class _Back(NamedTuple):
    """How far the cotangents have come.

    Attributes:
        attempt: All attempts from this one on are taken back.
        change: Cotangent of the state before it.
        total: Cotangents of the parameters.
    """

    attempt: Int[Array, ""]
    change: Float[Array, " n"]
    total: Any


class _Replay(NamedTuple):
    """Motions that are taken back together: one, or lanes.

    Attributes:
        engine: How they are integrated.
        over: Maps a function of one motion over the lanes.
        fixed: The parts of the motion that are not asked for.
        moved: The parts whose cotangents are asked for; only `parameters`.
        changes: Cotangents of the results.
        estimate: How many attempts there are, about.
    """

    engine: Engine
    over: Callable[..., Any]
    fixed: Any
    moved: Any
    changes: Changes
    estimate: Int[Array, ""]

    def attempt(self, progress: Progress) -> tuple[Progress, _Step]:
        """Try a step, and keep what its reverse needs."""

        def one(fixed: Any, moved: Any, progress: Progress) -> tuple[Progress, _Step]:
            made = self.engine.attempt(eqx.combine(fixed, moved), progress)
            at = jnp.stack([progress.t, made.h])
            place = jnp.concatenate([at, progress.y])
            return made.progress, _Step(place, made.rates, made.output)

        return self.over(one, self.fixed, self.moved, progress)

    def take_back(self, step: _Step, change: Array, total: Any) -> tuple[Array, Any]:
        """Cotangents before a step, from those after it."""

        def one(
            fixed: Any, moved: Any, changes: Changes, step: _Step, carry: tuple
        ) -> tuple[Array, Any]:
            change, total = carry
            t, h, y = step.place[0], step.place[1], step.place[2:]
            # Not every step ends at an output time.
            nothing = jnp.zeros_like(changes.ys[:1])
            asked = jnp.concatenate([changes.ys, nothing])[step.output]
            motion: Motion = eqx.combine(fixed, moved)
            jump = jnp.sum(motion.jumps <= t)
            smooth = self.engine.smooth_field(motion, jump)

            change = change + asked

            def complete(moved: Any) -> list[Array]:
                return eqx.combine(moved, fixed).parameters

            of_parameters, change = self.engine.stepper.pull_back(
                smooth,
                complete,
                moved,
                (t, h, y),
                step.rates,
                change,
                self.engine.in_lanes,
            )
            return change, jtu.tree_map(jnp.add, total, of_parameters)

        return self.over(
            one, self.fixed, self.moved, self.changes, step, (change, total)
        )

    def forwards(self, back: _Back, kept: _Kept, log: _Step) -> tuple:
        """Run from the last of the states that are kept to where cotangents are."""
        size = log.output.shape[0]
        start = kept.count - 1
        progress, attempt = jtu.tree_map(
            lambda x: x[start], (kept.progress, kept.attempts)
        )
        room = _KEPT - kept.count
        left = jnp.minimum(back.attempt, self.estimate) - attempt
        stretch = jnp.maximum(size, -(-left // (room + 1)))

        def goes_on(attempt: Array, progress: Progress) -> Array:
            return (attempt < back.attempt) & jnp.any(progress.running)

        def once(carry: tuple) -> tuple:
            attempt, progress, log, until = carry
            progress, step = self.attempt(progress)
            log = jtu.tree_map(lambda all_, x: _put(all_, x, attempt % size), log, step)
            return attempt + 1, progress, log, until

        def some(carry: tuple) -> tuple:
            attempt, progress, log, kept = carry
            attempt, progress, log, _ = jax.lax.while_loop(
                lambda carry: (carry[0] < carry[3]) & goes_on(*carry[:2]),
                once,
                (attempt, progress, log, attempt + stretch),
            )
            # What is stored after the last place is not read.
            states, attempts = jtu.tree_map(
                lambda all_, x: _put(all_, x, kept.count),
                (kept.progress, kept.attempts),
                (progress, attempt),
            )
            count = jnp.minimum(kept.count + 1, _KEPT)
            return attempt, progress, log, _Kept(states, attempts, count)

        attempt, _, log, kept = jax.lax.while_loop(
            lambda carry: goes_on(*carry[:2]), some, (attempt, progress, log, kept)
        )
        return attempt, start, log, kept

    def backwards(self, first: Array, back: _Back, log: _Step) -> _Back:
        """Take back the attempts from `first` on, whose rates are kept."""
        size = log.output.shape[0]

        def once(back: _Back) -> _Back:
            attempt = back.attempt - 1
            step = jtu.tree_map(lambda x: x[attempt % size], log)
            change, total = self.take_back(step, back.change, back.total)
            return _Back(attempt, change, total)

        return jax.lax.while_loop(lambda back: back.attempt > first, once, back)

    def pull(self) -> tuple[Any, Array]:
        """Cotangents of the parameters and of the start."""
        begin = self.over(
            lambda fixed, moved: self.engine.begin(eqx.combine(fixed, moved)),
            self.fixed,
            self.moved,
        )
        shapes = jax.eval_shape(self.attempt, begin)[1]
        bytes_ = sum(x.size * x.dtype.itemsize for x in jtu.tree_leaves(shapes))
        size = min(max(_BYTES // bytes_, _FEWEST), _MOST)
        log = jtu.tree_map(lambda x: jnp.zeros((size, *x.shape), x.dtype), shapes)
        states = jtu.tree_map(
            lambda x: jnp.zeros((_KEPT + 1, *x.shape), x.dtype).at[0].set(x), begin
        )
        none = jnp.zeros((), jnp.int32)
        kept = _Kept(states, jnp.zeros(_KEPT + 1, jnp.int32), none + 1)
        total = jtu.tree_map(jnp.zeros_like, self.moved)
        unknown = jnp.iinfo(jnp.int32).max
        back = _Back(none + unknown, self.changes.y, total)

        def part(carry: tuple[_Back, _Kept, _Step]) -> tuple[_Back, _Kept, _Step]:
            back, kept, log = carry
            attempt, start, log, kept = self.forwards(back, kept, log)
            # The first run finds how many attempts there are.
            back = back._replace(attempt=attempt)
            first = jnp.maximum(kept.attempts[start], attempt - size)
            back = self.backwards(first, back, log)
            # States at later attempts are out of date.
            valid = jnp.arange(_KEPT + 1, dtype=jnp.int32) < kept.count
            valid = valid & (kept.attempts < back.attempt)
            count = jnp.maximum(jnp.sum(valid), 1).astype(kept.count.dtype)
            return back, kept._replace(count=count), log

        back, _, _ = jax.lax.while_loop(
            lambda carry: carry[0].attempt > 0, part, (back, kept, log)
        )

        def at_start(fixed: Any, changes: Changes) -> Array:
            early = (fixed.times <= 0)[:, None]
            return jnp.sum(jnp.where(early, changes.ys, 0.0), axis=0)

        return back.total, back.change + self.over(at_start, self.fixed, self.changes)


def _put(all_: Array, x: Array, at: Array) -> Array:
    """Store an entry of an array along its first axis, in place."""
    return jax.lax.dynamic_update_index_in_dim(all_, x, at, 0)


def pull_alone(
    engine: Engine, fixed: Any, moved: Any, changes: Changes, tried: Array
) -> tuple[Any, Array]:
    """Cotangents of the parameters and of the start of one motion.

    Args:
        engine: How it is integrated.
        fixed: The parts of the motion that are not asked for.
        moved: The others.
        changes: Cotangents of its results.
        tried: After how many attempts it ended.
    """

    def over(function: Callable[..., Any], *arguments: Any) -> Any:
        return apart(function, tried >= 0, *arguments)

    engine = engine._replace(replays=True, conditions=None)
    return _Replay(engine, over, fixed, moved, changes, tried).pull()


def pull_in_lanes(
    engine: Engine, shared: Any, rest: Any, moved: Any, changes: Changes, tried: Array
) -> tuple[Any, Array]:
    """The same of many motions, which have an index in front of all but what they share."""
    engine = engine._replace(replays=True, conditions=None, in_lanes=True)

    def block(rest: Any, moved: Any, changes: Changes, tried: Array) -> Any:
        def over(function: Callable[..., Any], fixed: Any, *arguments: Any) -> Any:
            return lanes_last(
                lambda x, *y: function(eqx.combine(x, shared), *y), fixed, *arguments
            )

        replay = _Replay(engine, over, rest, moved, changes, jnp.max(tried))
        return replay.pull()

    # Motions of the same length go together: none waits for another.
    order = jnp.argsort(tried)
    return some_at_a_time(block, order, rest, moved, changes, tried)
