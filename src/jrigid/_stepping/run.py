"""Motions from their start to their end: one alone, or many in lanes.

Under `jax.vmap` a loop goes on until its slowest lane has ended, and each operation
goes through all lanes, out of the cache. Here few lanes step together, along the last
axis of their arrays. A lane whose motion has ended stores its result and takes the next
motion.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from jrigid._core.lanes import width_of
from jrigid._core.lanes_last import lanes_last
from jrigid._stepping.engine import Engine
from jrigid._stepping.motion import EMPTY, Motion, Progress, steps_fixed

# At most so many steps between two looks for lanes whose motion has ended.
_STEPS = 8


class Ends(NamedTuple):
    """How a motion went.

    Attributes:
        ys: States at the output times; those that were not reached are zero.
        t: Where it ended.
        y: The state there.
        counts: As of `Progress`.
    """

    ys: Float[Array, "*motions times n"]
    t: Float[Array, "*motions"]
    y: Float[Array, "*motions n"]
    counts: Int[Array, "*motions 6"]


def _states_at_start(motion: Motion) -> Float[Array, "rows n"]:
    """States at the output times, as far as the start tells; the last row is not read."""
    early = jnp.append(motion.times <= 0, False)
    return jnp.where(early[:, None], motion.y0, 0.0)


def run_alone(engine: Engine, motion: Motion) -> Ends:
    """One motion from its start to its end."""
    count = motion.times.size

    def step(carry: tuple[Progress, Array]) -> tuple[Progress, Array]:
        progress, saved = carry
        progress, _, _, output = engine.attempt(motion, progress)
        # What is stored after the last of the times is not read.
        return progress, jax.lax.dynamic_update_index_in_dim(
            saved, progress.y, output, 0
        )

    start = engine.begin(motion), _states_at_start(motion)
    progress, saved = jax.lax.while_loop(lambda carry: carry[0].running, step, start)
    return Ends(saved[:count], progress.t, progress.y, progress.counts)


class Record(NamedTuple):
    """The steps of a motion, in order; those that were not taken have length zero.

    Attributes:
        places: Where each starts, and its length.
        jumps: The number of the jump before which it lies.
        outputs: The number of the output time that it reached.
    """

    places: Float[Array, "steps 2"]
    jumps: Int[Array, " steps"]
    outputs: Int[Array, " steps"]


def record_alone(engine: Engine, motion: Motion) -> tuple[Progress, Record]:
    """The end of one motion, and its steps."""

    def step(carry: tuple[Progress, Record]) -> tuple[Progress, Record]:
        progress, record = carry
        made = engine.attempt(motion, progress)
        kept = made.progress.counts[2] > progress.counts[2]
        number = jnp.where(kept, progress.counts[2], engine.max_steps)
        entry = Record(jnp.stack([progress.t, made.h]), progress.counts[4], made.output)
        record = jtu.tree_map(
            lambda all_, x: all_.at[number].set(x.astype(all_.dtype), mode="drop"),
            record,
            entry,
        )
        return made.progress, record

    record = Record(
        jnp.zeros((engine.max_steps, 2), motion.y0.dtype),
        jnp.zeros(engine.max_steps, jnp.int32),
        jnp.full(engine.max_steps, motion.times.size, jnp.int32),
    )
    return jax.lax.while_loop(
        lambda carry: carry[0].running, step, (engine.begin(motion), record)
    )


def any_of(lanes: Bool[Array, " lanes"]) -> Bool[Array, ""]:
    """Whether a condition holds in any lane.

    For `jnp.any` XLA's CPU compiler makes three kernels, for a search one or two.
    """
    return lanes[jnp.argmax(lanes)]


class _Lanes(NamedTuple):
    """Lanes and the motions in them, lanes last.

    Attributes:
        number: Of the motion in each lane; beyond the last one in an empty lane.
        own: What is the motion's own.
        progress: Of the motion.
    """

    number: Int[Array, " lanes"]
    own: Any
    progress: Progress


class _Some(NamedTuple):
    """A few steps of all lanes.

    Attributes:
        taken: How many of them were taken.
        progress: Of the motions.
        output: The number of the output time that each lane reached by the last of the
            steps; as many as there are where none was. Before the first step it means
            nothing.
    """

    taken: Int[Array, ""]
    progress: Progress
    output: Int[Array, " lanes"]


class _Results(NamedTuple):
    """Where the motions store what becomes of them.

    Attributes:
        ys: States at the output times, then a row that is not read.
        ends: The time and the state at the end.
        counts: As of `Progress`.
    """

    ys: Float[Array, "motions times+1 n"]
    ends: Float[Array, "motions n+1"]
    counts: Int[Array, "motions 6"]


class _Batch(NamedTuple):
    """Many motions.

    Attributes:
        engine: How they are integrated.
        motion_of: A motion, from what is its own.
        table: What is their own, a motion to each row of every array.
        order: Their numbers, in the order in which they start.
    """

    engine: Engine
    motion_of: Callable[[Any], Motion]
    table: Any
    order: Int[Array, " motions"]

    @property
    def count(self) -> int:
        """How many there are."""
        return self.order.size

    def take(self, number: Int[Array, " lanes"]) -> _Lanes:
        """The motions of these numbers at their start."""
        own = jtu.tree_map(
            lambda x: jnp.moveaxis(x.at[number].get(mode="clip"), 0, -1), self.table
        )
        progress = lanes_last(lambda own: self.engine.begin(self.motion_of(own)), own)
        state = jnp.where(number < self.count, progress.counts[0], EMPTY)
        return _Lanes(
            number, own, progress._replace(counts=progress.counts.at[0].set(state))
        )

    def refilled(
        self, lanes: _Lanes, started: Int[Array, ""], results: _Results
    ) -> tuple[_Lanes, Int[Array, ""], _Results]:
        """A lane whose motion has ended stores its result and takes the next motion."""
        progress = lanes.progress
        ended = ~progress.running
        # What an empty lane would store is dropped.
        number = jnp.where(ended, lanes.number, self.count)
        ends = jnp.concatenate([progress.clock[:1], progress.y])
        results = results._replace(
            ends=results.ends.at[number].set(ends.T, mode="drop"),
            counts=results.counts.at[number].set(progress.counts.T, mode="drop"),
        )
        behind = jnp.cumsum(ended.astype(started.dtype))
        following = self.order.at[started + behind - 1].get(
            mode="fill", fill_value=self.count
        )
        fresh = self.take(jnp.where(ended, following, lanes.number))
        lanes = jtu.tree_map(lambda a, b: jnp.where(ended, a, b), fresh, lanes)
        return lanes, started + behind[-1], results

    def some_steps(self, lanes: _Lanes, ys: Array) -> tuple[_Lanes, Array]:
        """A few steps, whose output is stored."""
        times = ys.shape[1] - 1
        number, own, progress = lanes

        def attempt(own: Any, progress: Progress) -> tuple[Progress, Array]:
            made = self.engine.attempt(self.motion_of(own), progress)
            return made.progress, made.output

        def step(some: _Some) -> _Some:
            progress, output = lanes_last(attempt, own, some.progress)
            return _Some(some.taken + 1, progress, output)

        def until_output(carry: tuple[_Some, Array]) -> tuple[_Some, Array]:
            before, ys = carry

            def none_to_store(some: _Some) -> Array:
                none = ~any_of(some.output < times) | (some.taken == before.taken)
                return (some.taken < _STEPS) & none

            # Only small arrays go through the inner loop.
            some = jax.lax.while_loop(none_to_store, step, before)
            ys = ys.at[number, some.output].set(some.progress.y.T, mode="drop")
            return some, ys

        def goes_on(carry: tuple[_Some, Array]) -> Array:
            some, _ = carry
            return (some.taken < _STEPS) & any_of(some.progress.running)

        none = jnp.zeros((), number.dtype)
        start = _Some(none, progress, number), ys
        some, ys = jax.lax.while_loop(goes_on, until_output, start)
        return _Lanes(number, own, some.progress), ys


def run_in_lanes(engine: Engine, shared: Any, each: Any) -> Ends:
    """Motions that differ in `each`, whose leaves have a motion to each index in front."""
    count = jtu.tree_leaves(each)[0].shape[0]
    one = eqx.combine(jtu.tree_map(lambda x: x[0], each), shared)
    table, unpacked = _packed(each, one.y0.dtype)

    def motion_of(own: Any) -> Motion:
        # Packed with what has derivatives, limits and times must not seem to have some.
        return steps_fixed(eqx.combine(unpacked(own), shared))

    def at_start(own: Any) -> tuple[Array, Array]:
        motion = motion_of(own)
        return _states_at_start(motion), motion.limits.end * motion.limits.start_rate

    ys, radians = jax.vmap(at_start)(table)
    # Long motions come first, so that none is left at the end with few beside it.
    numbers = jnp.arange(count, dtype=jnp.int32)
    _, order = jax.lax.sort_key_val(-radians, numbers)
    batch = _Batch(engine._replace(in_lanes=True), motion_of, table, order)
    lanes = jnp.full(width_of(count), count, order.dtype)
    shapes = jax.eval_shape(batch.take, lanes)
    empty = jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    empty = empty._replace(
        number=lanes,
        progress=empty.progress._replace(
            counts=jnp.full_like(empty.progress.counts, EMPTY)
        ),
    )
    results = _Results(
        ys,
        jnp.zeros((count, 1 + one.y0.size), one.y0.dtype),
        jnp.zeros((count, len(empty.progress.counts)), empty.progress.counts.dtype),
    )

    def look(carry: tuple[_Lanes, Array, _Results]) -> tuple[_Lanes, Array, _Results]:
        lanes, started, results = batch.refilled(*carry)
        lanes, ys = batch.some_steps(lanes, results.ys)
        return lanes, started, results._replace(ys=ys)

    _, _, results = jax.lax.while_loop(
        lambda carry: (carry[1] < count) | any_of(carry[0].number < count),
        look,
        (empty, jnp.zeros((), order.dtype), results),
    )
    return Ends(
        results.ys[:, :-1], results.ends[:, 0], results.ends[:, 1:], results.counts
    )


def _packed(each: Any, dtype: Any) -> tuple[Any, Callable[[Any], Any]]:
    """A tree with its arrays of one dtype as a single one; a function that takes them apart."""
    numbers, others = eqx.partition(each, lambda x: x.dtype == dtype)
    _, unravel = ravel_pytree(jtu.tree_map(lambda x: x[0], numbers))
    rows = jax.vmap(lambda x: ravel_pytree(x)[0])(numbers)

    def unpacked(table: tuple[Array, Any]) -> Any:
        row, others = table
        return eqx.combine(unravel(row), others)

    return (rows, others), unpacked
