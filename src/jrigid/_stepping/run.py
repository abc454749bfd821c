"""Run motions from their start to their end: one alone, or many in lanes.

Under `jax.vmap` a loop continues until its slowest lane has ended, and each operation
works on all lanes, which do not fit into the cache. Here few lanes step together, along
the last axis of their arrays. A lane whose motion has ended stores its result and takes
the next motion.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from jrigid._core.lanes import width_of
from jrigid._core.lanes_last import lanes_last
from jrigid._stepping.engine import Engine
from jrigid._stepping.motion import EMPTY, Motion, Progress, steps_fixed
from jrigid._stepping.step import put

# Largest number of steps between two searches for finished lanes. A larger number
# saves searches, but finished lanes are idle for longer.
_STEPS = 8

#: The parts of a motion that are its own: numbers in one array, and other arrays.
_Packed = tuple[Array, PyTree]


class Ends(NamedTuple):
    """The result of a motion.

    Attributes:
        ys: States at the output times; zero at times that were not reached.
        t: Time at which the motion ended.
        y: State at that time.
        counts: As of `Progress`.
    """

    ys: Float[Array, "*motions times n"]
    t: Float[Array, "*motions"]
    y: Float[Array, "*motions n"]
    counts: Int[Array, "*motions 6"]


def _states_at_start(motion: Motion) -> Float[Array, "rows n"]:
    """Initial values of the states at the output times, and a last row of zeros.

    The last row takes states of steps that do not reach an output time.
    """
    early = jnp.append(motion.times <= 0, False)
    return jnp.where(early[:, None], motion.y0, 0.0)


def run_alone(engine: Engine, motion: Motion) -> Ends:
    """Run one motion from its start to its end."""
    count = motion.times.size

    def step(carry: tuple[Progress, Array]) -> tuple[Progress, Array]:
        progress, saved = carry
        progress, _, _, output = engine.attempt(motion, progress)
        # The row after the last output time is never read.
        saved = put(saved, progress.y, output)
        return progress, saved

    start = (engine.begin(motion), _states_at_start(motion))
    progress, saved = jax.lax.while_loop(lambda carry: carry[0].running, step, start)
    return Ends(saved[:count], progress.t, progress.y, progress.counts)


class Record(NamedTuple):
    """The steps of a motion, in order; steps that were not taken have length zero.

    Attributes:
        places: Start and length of each step.
        jumps: Index of the jump before which it lies.
        outputs: Index of the output time that it reached.
    """

    places: Float[Array, "steps 2"]
    jumps: Int[Array, " steps"]
    outputs: Int[Array, " steps"]


def record_alone(engine: Engine, motion: Motion) -> tuple[Progress, Record]:
    """Run one motion, and record its steps."""

    def step(carry: tuple[Progress, Record]) -> tuple[Progress, Record]:
        progress, record = carry
        attempt = engine.attempt(motion, progress)
        accepted = attempt.progress.counts[2] > progress.counts[2]
        # Entries after the last step are dropped.
        number = jnp.where(accepted, progress.counts[2], engine.max_steps)
        place = jnp.stack([progress.t, attempt.h])
        entry = Record(place, progress.counts[4], attempt.output)

        def stored(steps: Array, x: Array) -> Array:
            return steps.at[number].set(x.astype(steps.dtype), mode="drop")

        return attempt.progress, jtu.tree_map(stored, record, entry)

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

    XLA's CPU compiler makes three kernels of `jnp.any`, and one or two of a search.
    """
    return lanes[jnp.argmax(lanes)]


class _Lanes(NamedTuple):
    """Lanes and the motions in them, with lanes along the last axis.

    Attributes:
        number: Of the motion in each lane; the number of motions in an empty lane.
        own: The parts that are the motion's own.
        progress: Of the motion.
    """

    number: Int[Array, " lanes"]
    own: _Packed
    progress: Progress


class _Some(NamedTuple):
    """A few steps of all lanes.

    Attributes:
        taken: Number of steps that were taken.
        progress: Of the motions.
        output: Index of the output time that each lane reached in the last step; if
            none was reached, the number of output times. Arbitrary before the first
            step.
    """

    taken: Int[Array, ""]
    progress: Progress
    output: Int[Array, " lanes"]


class _Results(NamedTuple):
    """Buffers for the results of the motions.

    Attributes:
        ys: States at the output times, and a last row that is not read.
        ends: Time and state at the end.
        counts: As of `Progress`.
    """

    ys: Float[Array, "motions times+1 n"]
    ends: Float[Array, "motions n+1"]
    counts: Int[Array, "motions 6"]


class _Batch(NamedTuple):
    """Many motions.

    Attributes:
        engine: Integrates the motions.
        motion_of: A motion, from the parts that are its own.
        table: These parts, a motion to each row of every array.
        order: Numbers of the motions, in the order in which they start.
    """

    engine: Engine
    motion_of: Callable[[_Packed], Motion]
    table: _Packed
    order: Int[Array, " motions"]

    @property
    def count(self) -> int:
        """Number of motions."""
        return self.order.size

    def take(self, number: Int[Array, " lanes"]) -> _Lanes:
        """Lanes with the motions of these numbers at their start."""
        # An empty lane computes with the data of the last motion, without effect.
        own = jtu.tree_map(
            lambda x: jnp.moveaxis(x.at[number].get(mode="clip"), 0, -1), self.table
        )
        progress = lanes_last(lambda own: self.engine.begin(self.motion_of(own)), own)
        state = jnp.where(number < self.count, progress.counts[0], EMPTY)
        progress = progress._replace(counts=progress.counts.at[0].set(state))
        return _Lanes(number, own, progress)

    def empty_lanes(self) -> _Lanes:
        """Lanes without motions."""
        number = jnp.full(width_of(self.count), self.count, self.order.dtype)
        shapes = jax.eval_shape(self.take, number)
        empty = jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        counts = jnp.full_like(empty.progress.counts, EMPTY)
        progress = empty.progress._replace(counts=counts)
        return empty._replace(number=number, progress=progress)

    def refilled(
        self, lanes: _Lanes, started: Int[Array, ""], results: _Results
    ) -> tuple[_Lanes, Int[Array, ""], _Results]:
        """Store the results of finished lanes and load new motions into them.

        Args:
            lanes: The lanes.
            started: How many motions have been started.
            results: Of the motions.
        """
        progress = lanes.progress
        ended = ~progress.running
        # The result of an empty lane is dropped.
        number = jnp.where(ended, lanes.number, self.count)
        ends = jnp.concatenate([progress.clock[:1], progress.y])
        results = results._replace(
            ends=results.ends.at[number].set(ends.T, mode="drop"),
            counts=results.counts.at[number].set(progress.counts.T, mode="drop"),
        )
        # Each finished lane takes a motion of its own, or none if all have started.
        behind = jnp.cumsum(ended.astype(started.dtype))
        following = self.order.at[started + behind - 1].get(
            mode="fill", fill_value=self.count
        )
        fresh = self.take(jnp.where(ended, following, lanes.number))
        lanes = jtu.tree_map(lambda a, b: jnp.where(ended, a, b), fresh, lanes)
        return lanes, started + behind[-1], results

    def some_steps(self, lanes: _Lanes, ys: Array) -> tuple[_Lanes, Array]:
        """Take a few steps in all lanes, and store the states at output times."""
        times = ys.shape[1] - 1
        number, own, progress = lanes

        def attempt(own: _Packed, progress: Progress) -> tuple[Progress, Array]:
            result = self.engine.attempt(self.motion_of(own), progress)
            return result.progress, result.output

        def step(some: _Some) -> _Some:
            progress, output = lanes_last(attempt, own, some.progress)
            return _Some(some.taken + 1, progress, output)

        def until_output(carry: tuple[_Some, Array]) -> tuple[_Some, Array]:
            before, ys = carry

            def none_to_store(some: _Some) -> Array:
                # At least one step is taken, since `output` is arbitrary before the
                # first.
                none = ~any_of(some.output < times) | (some.taken == before.taken)
                return (some.taken < _STEPS) & none

            # The inner loop carries small arrays only.
            some = jax.lax.while_loop(none_to_store, step, before)
            ys = ys.at[number, some.output].set(some.progress.y.T, mode="drop")
            return some, ys

        def continues(carry: tuple[_Some, Array]) -> Array:
            some, _ = carry
            return (some.taken < _STEPS) & any_of(some.progress.running)

        none = jnp.zeros((), number.dtype)
        start = (_Some(none, progress, number), ys)
        some, ys = jax.lax.while_loop(continues, until_output, start)
        return _Lanes(number, own, some.progress), ys

    def run(self, lanes: _Lanes, results: _Results) -> _Results:
        """Run all motions, in lanes that are empty at first."""

        def unfinished(carry: tuple[_Lanes, Array, _Results]) -> Array:
            lanes, started, _ = carry
            return (started < self.count) | any_of(lanes.number < self.count)

        def refill_and_step(
            carry: tuple[_Lanes, Array, _Results],
        ) -> tuple[_Lanes, Array, _Results]:
            lanes, started, results = self.refilled(*carry)
            lanes, ys = self.some_steps(lanes, results.ys)
            return lanes, started, results._replace(ys=ys)

        start = (lanes, jnp.zeros((), self.order.dtype), results)
        _, _, results = jax.lax.while_loop(unfinished, refill_and_step, start)
        return results


def run_in_lanes(engine: Engine, shared: Motion, each: Motion) -> Ends:
    """Run many motions.

    Args:
        engine: Integrates the motions.
        shared: The parts that all motions have in common.
        each: The other parts, with an axis of motions in front.
    """
    count = jtu.tree_leaves(each)[0].shape[0]
    one = eqx.combine(jtu.tree_map(lambda x: x[0], each), shared)
    table, unpacked = _packed(each, one.y0.dtype)

    def motion_of(own: _Packed) -> Motion:
        # Limits and times are in one array with parts that have derivatives.
        return steps_fixed(eqx.combine(unpacked(own), shared))

    def at_start(own: _Packed) -> tuple[Array, Array]:
        motion = motion_of(own)
        # The radians of the fastest rate stand for the number of steps.
        return _states_at_start(motion), motion.limits.end * motion.limits.start_rate

    ys, radians = jax.vmap(at_start)(table)
    # Long motions come first, so that none remains at the end with few beside it.
    numbers = jnp.arange(count, dtype=jnp.int32)
    _, order = jax.lax.sort_key_val(-radians, numbers)
    batch = _Batch(engine._replace(in_lanes=True), motion_of, table, order)
    empty = batch.empty_lanes()
    counts = empty.progress.counts
    results = _Results(
        ys,
        jnp.zeros((count, 1 + one.y0.size), one.y0.dtype),
        jnp.zeros((count, len(counts)), counts.dtype),
    )
    results = batch.run(empty, results)
    return Ends(
        results.ys[:, :-1], results.ends[:, 0], results.ends[:, 1:], results.counts
    )


def _packed(
    each: PyTree, dtype: np.dtype
) -> tuple[_Packed, Callable[[_Packed], PyTree]]:
    """Pack the arrays of one dtype into a single one, with a row for each motion.

    Returns:
        That array and the other arrays; a function that restores the pytree of one
        motion.
    """
    numbers, others = eqx.partition(each, lambda x: x.dtype == dtype)
    _, unravel = ravel_pytree(jtu.tree_map(lambda x: x[0], numbers))
    rows = jax.vmap(lambda x: ravel_pytree(x)[0])(numbers)

    def unpacked(table: _Packed) -> PyTree:
        row, others = table
        return eqx.combine(unravel(row), others)

    return (rows, others), unpacked
