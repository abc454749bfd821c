"""Reverse mode: run a motion again, and reverse its steps from its end.

The log holds the rates of the stages of some hundred attempts at a step. A longer
motion is run once from its start to store checkpoints. Then it is run part by part from
the last checkpoint. Rejected attempts are in the log too, as steps of length zero, so
that all lanes count the same attempts.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int

from jrigid._core.lanes import some_at_a_time
from jrigid._core.lanes_last import lanes_last
from jrigid._stepping.engine import Engine
from jrigid._stepping.motion import Motion, Progress
from jrigid._stepping.step import apart, put

Tree = TypeVar("Tree")

# The log holds at least and at most this many attempts, and between these bounds as
# many as this number of bytes has room for.
_FEWEST = 64
_MOST = 1024
_BYTES = 2**26
# Largest number of checkpoints.
_CHECKPOINTS = 256


class Cotangents(NamedTuple):
    """Cotangents of the results of a motion: the states at its times and at its end."""

    ys: Float[Array, "*motions times n"]
    y: Float[Array, "*motions n"]


class _Step(NamedTuple):
    """Data that the reverse of an attempt needs.

    Attributes:
        place: Time and length of the step, then the state at its start, as one array.
        rates: Of its stages.
        output: Index of the output time that it reached.
    """

    place: Float[Array, " n+2"]
    rates: Float[Array, "stages n"]
    output: Int[Array, ""]


class _Checkpoints(NamedTuple):
    """Checkpoints in order, of which the first `count` are valid."""

    progress: Progress
    attempts: Int[Array, " checkpoints"]
    count: Int[Array, ""]


class _Back(NamedTuple):
    """Progress of the cotangents, backward in time.

    Attributes:
        attempt: All attempts from this one on have been reversed.
        change: Cotangent of the state before this attempt.
        total: Cotangents of the parameters.
    """

    attempt: Int[Array, ""]
    change: Float[Array, " n"]
    total: Motion


class _Replay(NamedTuple):
    """Motions that are reversed together: one, or lanes.

    A motion comes in two parts, `fixed` and `varied`, which `equinox.combine` joins.

    Attributes:
        engine: Integrates the motions.
        over: Maps a function of one motion over the lanes.
        fixed: Without those parameters whose cotangents are needed.
        varied: With these parameters alone.
        changes: Cotangents of the results.
        estimate: About how many attempts there are.
    """

    engine: Engine
    over: Callable[..., Any]
    fixed: Motion
    varied: Motion
    changes: Cotangents
    estimate: Int[Array, ""]

    def begin(self) -> Progress:
        """The motions at their start."""

        def of_one(fixed: Motion, varied: Motion) -> Progress:
            return self.engine.begin(eqx.combine(fixed, varied))

        return self.over(of_one, self.fixed, self.varied)

    def attempt(self, progress: Progress) -> tuple[Progress, _Step]:
        """Try a step, and return what its reverse needs."""

        def of_one(
            fixed: Motion, varied: Motion, progress: Progress
        ) -> tuple[Progress, _Step]:
            attempt = self.engine.attempt(eqx.combine(fixed, varied), progress)
            at = jnp.stack([progress.t, attempt.h])
            place = jnp.concatenate([at, progress.y])
            return attempt.progress, _Step(place, attempt.rates, attempt.output)

        return self.over(of_one, self.fixed, self.varied, progress)

    def reverse(
        self, step: _Step, change: Array, total: Motion
    ) -> tuple[Array, Motion]:
        """Cotangents before a step, from those after it."""

        def of_one(
            fixed: Motion,
            varied: Motion,
            changes: Cotangents,
            step: _Step,
            carry: tuple[Array, Motion],
        ) -> tuple[Array, Motion]:
            change, total = carry
            t, h, y = step.place[0], step.place[1], step.place[2:]
            # The last row belongs to steps that do not end at an output time.
            nothing = jnp.zeros_like(changes.ys[:1])
            of_output = jnp.concatenate([changes.ys, nothing])[step.output]
            motion: Motion = eqx.combine(fixed, varied)
            # Steps end exactly at jumps, so the start determines the next jump.
            jump = jnp.sum(motion.jumps <= t)
            smooth = self.engine.smooth_field(motion, jump)
            change = change + of_output

            def complete(varied: Motion) -> list[Array]:
                return eqx.combine(varied, fixed).parameters

            of_parameters, change = self.engine.stepper.pull_back(
                smooth,
                complete,
                varied,
                (t, h, y),
                step.rates,
                change,
                self.engine.in_lanes,
            )
            return change, jtu.tree_map(jnp.add, total, of_parameters)

        return self.over(
            of_one, self.fixed, self.varied, self.changes, step, (change, total)
        )

    def forwards(
        self, back: _Back, checkpoints: _Checkpoints, log: _Step
    ) -> tuple[Int[Array, ""], Int[Array, ""], _Step, _Checkpoints]:
        """Run from the last checkpoint to the state whose cotangent is known.

        Returns:
            The number of the next attempt, the index of the checkpoint at which the run
            started, the latest attempts, and all checkpoints.
        """
        size = log.output.shape[0]
        start = checkpoints.count - 1
        progress, attempt = jtu.tree_map(
            lambda x: x[start], (checkpoints.progress, checkpoints.attempts)
        )
        room = _CHECKPOINTS - checkpoints.count
        # In the first run `back.attempt` is unknown, and larger than the estimate.
        left = jnp.minimum(back.attempt, self.estimate) - attempt
        # Checkpoints are spread over the rest of the run as far as they suffice.
        # The log reaches back `size` attempts, so that closer checkpoints are of no
        # use.
        stretch = jnp.maximum(size, -(-left // (room + 1)))

        def continues(attempt: Array, progress: Progress) -> Array:
            return (attempt < back.attempt) & jnp.any(progress.running)

        def one_attempt(carry: tuple) -> tuple:
            attempt, progress, log, until = carry
            progress, step = self.attempt(progress)
            # The latest attempt replaces the earliest one in the log.
            log = _put(log, step, attempt % size)
            return attempt + 1, progress, log, until

        def to_checkpoint(carry: tuple) -> tuple:
            attempt, progress, log, checkpoints = carry
            attempt, progress, log, _ = jax.lax.while_loop(
                lambda carry: (carry[0] < carry[3]) & continues(*carry[:2]),
                one_attempt,
                (attempt, progress, log, attempt + stretch),
            )
            return attempt, progress, log, _appended(checkpoints, progress, attempt)

        attempt, _, log, checkpoints = jax.lax.while_loop(
            lambda carry: continues(*carry[:2]),
            to_checkpoint,
            (attempt, progress, log, checkpoints),
        )
        return attempt, start, log, checkpoints

    def backwards(self, first: Array, back: _Back, log: _Step) -> _Back:
        """Reverse the attempts from `first` on, which are in the log."""
        size = log.output.shape[0]

        def once(back: _Back) -> _Back:
            attempt = back.attempt - 1
            step = jtu.tree_map(lambda x: x[attempt % size], log)
            change, total = self.reverse(step, back.change, back.total)
            return _Back(attempt, change, total)

        return jax.lax.while_loop(lambda back: back.attempt > first, once, back)

    def pull(self) -> tuple[Motion, Array]:
        """Cotangents of the parameters and of the start."""
        begin = self.begin()
        log = _empty_log(jax.eval_shape(self.attempt, begin)[1])
        checkpoints = _first_checkpoint(begin)
        total = jtu.tree_map(jnp.zeros_like, self.varied)
        unknown = jnp.zeros((), jnp.int32) + jnp.iinfo(jnp.int32).max
        back = _Back(unknown, self.changes.y, total)

        def part(
            carry: tuple[_Back, _Checkpoints, _Step],
        ) -> tuple[_Back, _Checkpoints, _Step]:
            back, checkpoints, log = carry
            attempt, start, log, checkpoints = self.forwards(back, checkpoints, log)
            # The first run counts the attempts.
            back = back._replace(attempt=attempt)
            # Attempts that the log has lost are run again later, from the checkpoint.
            first = jnp.maximum(
                checkpoints.attempts[start], attempt - log.output.shape[0]
            )
            back = self.backwards(first, back, log)
            return back, _without_later(checkpoints, back.attempt), log

        back, _, _ = jax.lax.while_loop(
            lambda carry: carry[0].attempt > 0, part, (back, checkpoints, log)
        )

        def at_start(fixed: Motion, changes: Cotangents) -> Array:
            # No step reaches an output time at the start.
            early = (fixed.times <= 0)[:, None]
            return jnp.sum(jnp.where(early, changes.ys, 0.0), axis=0)

        return back.total, back.change + self.over(at_start, self.fixed, self.changes)


def _empty_log(shapes: _Step) -> _Step:
    """Room for the latest attempts, as many as the memory for them allows."""
    size = sum(x.size * x.dtype.itemsize for x in jtu.tree_leaves(shapes))
    count = min(max(_BYTES // size, _FEWEST), _MOST)
    return jtu.tree_map(lambda x: jnp.zeros((count, *x.shape), x.dtype), shapes)


def _first_checkpoint(begin: Progress) -> _Checkpoints:
    """Room for all checkpoints, of which the first is the start of the motion."""
    states = jtu.tree_map(
        lambda x: jnp.zeros((_CHECKPOINTS + 1, *x.shape), x.dtype).at[0].set(x), begin
    )
    attempts = jnp.zeros(_CHECKPOINTS + 1, jnp.int32)
    return _Checkpoints(states, attempts, jnp.zeros((), jnp.int32) + 1)


def _appended(
    checkpoints: _Checkpoints, progress: Progress, attempt: Array
) -> _Checkpoints:
    """Append a checkpoint; without effect if the buffer is full."""
    # The row after the last checkpoint is never read.
    states, attempts = _put(
        (checkpoints.progress, checkpoints.attempts),
        (progress, attempt),
        checkpoints.count,
    )
    count = jnp.minimum(checkpoints.count + 1, _CHECKPOINTS)
    return _Checkpoints(states, attempts, count)


def _without_later(checkpoints: _Checkpoints, attempt: Array) -> _Checkpoints:
    """The checkpoints before an attempt, and always the first one."""
    valid = jnp.arange(_CHECKPOINTS + 1, dtype=jnp.int32) < checkpoints.count
    valid = valid & (checkpoints.attempts < attempt)
    count = jnp.maximum(jnp.sum(valid), 1).astype(checkpoints.count.dtype)
    return checkpoints._replace(count=count)


def _put(buffers: Tree, entries: Tree, index: Array) -> Tree:
    """Store an entry in each of the arrays of a pytree."""

    def stored(buffer: Array, entry: Array) -> Array:
        return put(buffer, entry, index)

    return jtu.tree_map(stored, buffers, entries)


def pull_alone(
    engine: Engine, fixed: Motion, varied: Motion, changes: Cotangents, tried: Array
) -> tuple[Motion, Array]:
    """Cotangents of the parameters and of the start of one motion.

    Args:
        engine: Integrates the motion.
        fixed: The motion without those parameters whose cotangents are needed.
        varied: The motion with these parameters alone.
        changes: Cotangents of its results.
        tried: Number of attempts after which it ended.
    """

    def over(function: Callable[..., Any], *arguments: Any) -> Any:
        # A number of attempts is never negative, so that the branch is always taken.
        return apart(function, tried >= 0, *arguments)

    # The motion ends where the first run ended, so no event is sought again.
    engine = engine._replace(replays=True, conditions=None)
    return _Replay(engine, over, fixed, varied, changes, tried).pull()


def pull_in_lanes(
    engine: Engine,
    shared: Motion,
    rest: Motion,
    varied: Motion,
    changes: Cotangents,
    tried: Array,
) -> tuple[Motion, Array]:
    """Cotangents of the parameters and of the start of many motions.

    All arguments but `engine` and `shared`, which the motions have in common, have an
    axis of motions in front.
    """
    engine = engine._replace(replays=True, conditions=None, in_lanes=True)

    def block(
        rest: Motion, varied: Motion, changes: Cotangents, tried: Array
    ) -> tuple[Motion, Array]:
        def over(function: Callable[..., Any], fixed: Motion, *arguments: Any) -> Any:
            def of_lane(_: Array, fixed: Motion, *arguments: Any) -> Any:
                return function(eqx.combine(fixed, shared), *arguments)

            # Where motions differ in their cotangents alone, `fixed` and the arguments
            # may have no arrays, and `tried` tells how many lanes there are.
            return lanes_last(of_lane, tried, fixed, *arguments)

        # The lanes of a block run together until the longest motion has ended.
        replay = _Replay(engine, over, rest, varied, changes, jnp.max(tried))
        return replay.pull()

    # Motions of the same length are in one block, so that none waits for another.
    order = jnp.argsort(tried)
    return some_at_a_time(block, order, rest, varied, changes, tried)
