"""The loop body of an integration: one attempt at a step."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jrigid._stepping.events import Conditions
from jrigid._stepping.motion import (
    ENDED,
    EVENT,
    NOT_FINITE,
    RUNNING,
    STUCK,
    TOO_MANY_STEPS,
    Motion,
    Progress,
    first_direction,
)
from jrigid._stepping.steppers import Field, Stepper, Stretch, Trial


class Attempt(NamedTuple):
    """The result of an attempt at a step.

    Attributes:
        progress: Of the motion after the attempt.
        h: Length of the step; 0 if it was not accepted.
        rates: Of the stages.
        output: Index of the output time that was reached; if none was, the number of
            output times.
    """

    progress: Progress
    h: Float[Array, ""]
    rates: Float[Array, "stages n"]
    output: Int[Array, ""]


class _Passage(NamedTuple):
    """The effect of a step on the conditions of an event.

    Attributes:
        keep: Whether the step is accepted. A step that passes the time of the event is
            repeated up to that time.
        repeat: Whether the step is repeated.
        ended: Whether the motion ends with the step.
        end: Time at which the motion ends.
        which: Index of the condition whose zero ends it; -1 if none is zero.
        values: Of the conditions after the step.
    """

    keep: Bool[Array, ""]
    repeat: Bool[Array, ""]
    ended: Bool[Array, ""]
    end: Float[Array, ""]
    which: Int[Array, ""]
    values: Float[Array, " conditions"]


def _entry(times: Float[Array, " times"], number: Int[Array, ""]) -> Float[Array, ""]:
    """The time of an index; infinity after the last one."""
    last = times.size - 1
    return jnp.where(number <= last, times[jnp.minimum(number, last)], jnp.inf)


def _state_after(trial: Trial, ended: Bool[Array, ""]) -> Int[Array, ""]:
    """State of a motion after a trial, without regard to events and counts of steps."""
    stuck = jnp.where(trial.infinite, NOT_FINITE, STUCK)
    new_state = jnp.where(trial.verdict.stuck, stuck, RUNNING)
    return jnp.where(ended, ENDED, new_state)


def _jump_after(
    motion: Motion, jump: Int[Array, ""], t1: Array, keep: Bool[Array, ""]
) -> Int[Array, ""]:
    """Index of the next jump after a step to `t1`."""
    if not motion.jumps.size:
        return jump
    passed = keep & (t1 >= _entry(motion.jumps, jump))
    return jump + passed.astype(jump.dtype)


def _progress_if(
    running: Bool[Array, ""],
    progress: Progress,
    keep: Bool[Array, ""],
    trial: Trial,
    clock: list[Array],
    counts: list[Array],
    values: Float[Array, " conditions"],
) -> Progress:
    """Progress after an attempt; a motion that has ended keeps its clock and counts."""
    new_clock = jnp.stack(clock)
    new_counts = jnp.stack([x.astype(progress.counts.dtype) for x in counts])
    return Progress(
        jnp.where(keep, trial.y1, progress.y),
        # The direction of a motion that has ended is not read again.
        trial.direction,
        jnp.where(running, new_clock, progress.clock),
        jnp.where(running, new_counts, progress.counts),
        values,
    )


class Engine(NamedTuple):
    """Configuration of an integration, which is static when it is compiled.

    Attributes:
        field: The vector field.
        stepper: Tries a step.
        max_steps: Largest number of attempts at a step.
        conditions: Of an event, or None.
        in_lanes: Whether many motions are integrated at once.
        replays: Whether attempts return the rates of all stages, for the reverse mode.
    """

    field: Field
    stepper: Stepper
    max_steps: int
    conditions: Conditions | None = None
    in_lanes: bool = False
    replays: bool = False

    @property
    def keeps_rates(self) -> bool:
        """Whether an attempt returns the rates of all stages."""
        # The reverse of a step and the dense output at an event need them.
        return self.replays or self.conditions is not None

    def begin(self, motion: Motion) -> Progress:
        """The motion at its start."""
        limits = motion.limits
        zero = jnp.zeros_like(limits.end)
        first = limits.longest * self.stepper.first
        counts = [
            # An invalid motion has the rate zero and ends at once: no lane waits.
            jnp.where((limits.end > 0) & (limits.start_rate > 0), RUNNING, ENDED),
            0,
            0,
            # States at the start are stored without a step, and jumps there have
            # passed.
            jnp.sum(motion.times <= 0),
            jnp.sum(motion.jumps <= 0),
            -1,
        ]
        values = jnp.zeros(0, motion.y0.dtype)
        if self.conditions is not None:
            values = self.conditions.values(motion.observed, zero, motion.y0)
        return Progress(
            motion.y0,
            first_direction(motion.y0),
            jnp.stack([zero, first, limits.start_rate, limits.end]),
            jnp.stack([jnp.asarray(x, jnp.int32) for x in counts]),
            values,
        )

    def smooth_field(self, motion: Motion, jump: Int[Array, ""]) -> Field:
        """The vector field between two jumps, of which `jump` is the later one.

        A step that ends at a jump must not evaluate the field beyond it, and a step
        that starts at a jump must not evaluate it before.
        """
        if motion.jumps.size == 0:
            return self.field
        # Before the first jump and after the last one nothing bounds the times.
        # The entry in front shifts the indices by one: `after[jump]` belongs to the
        # jump that the motion has passed last.
        after = jnp.pad(motion.jumps + motion.beside, 1, constant_values=-jnp.inf)
        before = jnp.pad(motion.jumps - motion.beside, 1, constant_values=jnp.inf)
        low = after[jump]
        high = before[jump + 1]

        def field(parameters: list[Array], t: Array, y: Array) -> Array:
            return self.field(parameters, jnp.clip(t, low, high), y)

        return field

    def attempt(self, motion: Motion, progress: Progress) -> Attempt:
        """Try one step."""
        t, step, _, end = progress.clock
        output = progress.counts[3]
        jump = progress.counts[4]
        # Steps end at output times, since the order of dense output is lower.
        goal = jnp.minimum(_entry(motion.times, output), motion.times[-1])
        if motion.jumps.size:
            goal = jnp.minimum(goal, _entry(motion.jumps, jump))
        # The time of an event cuts a step off. It does not divide the way to it anew,
        # since a second run, which knows that time, must take the steps of the first.
        t1 = jnp.minimum(self.stepper.end(t, step, goal), end)
        field = self.smooth_field(motion, jump)
        trial = self.stepper.attempt(
            field, motion, progress, t1, self.in_lanes, self.keeps_rates
        )
        return self._settled(motion, progress, t1, trial)

    def _settled(
        self, motion: Motion, progress: Progress, t1: Array, trial: Trial
    ) -> Attempt:
        """Progress of the motion after a trial of a step."""
        t, step, _, end = progress.clock
        state, tried, accepted, output, jump, which = progress.counts
        running = state == RUNNING
        keep = trial.verdict.accepted & running
        following = trial.verdict.step
        hit = keep & (t1 >= _entry(motion.times, output))
        # The last output time may occur several times, each of which takes an attempt.
        again = t1 >= _entry(motion.times, output + hit.astype(output.dtype))
        new_state = _state_after(trial, keep & (t1 >= end) & ~again)
        values = progress.values
        if self.conditions is not None:
            taken = Stretch(t, t1, progress.y, trial.y1, trial.rates)
            passage = self._passage(self.conditions, motion, progress, taken, keep)
            keep, repeat, at_event, end, which, values = passage
            new_state = jnp.where(at_event, EVENT, new_state)
            # A step that is repeated has not reached the end yet.
            new_state = jnp.where(repeat, RUNNING, new_state)
            following = jnp.where(repeat, step, following)
        too_many = (new_state == RUNNING) & (tried + 1 >= self.max_steps)
        new_state = jnp.where(too_many, TOO_MANY_STEPS, new_state)
        # A step that is repeated up to an event has reached no output time.
        hit = hit & keep
        reached = jnp.where(hit, output, motion.times.size)
        clock = [jnp.where(keep, t1, t), following, trial.verdict.rate, end]
        counts = [
            new_state,
            tried + 1,
            accepted + keep.astype(accepted.dtype),
            output + hit.astype(output.dtype),
            _jump_after(motion, jump, t1, keep),
            which,
        ]
        return Attempt(
            _progress_if(running, progress, keep, trial, clock, counts, values),
            jnp.where(keep, t1 - t, 0.0),
            trial.rates,
            reached,
        )

    def _passage(
        self,
        conditions: Conditions,
        motion: Motion,
        progress: Progress,
        taken: Stretch,
        keep: Bool[Array, ""],
    ) -> _Passage:
        """Look for an event in a step that would be accepted if `keep`."""
        end = progress.clock[3]
        which = progress.counts[5]
        now = conditions.values(motion.observed, taken.t1, taken.y1)
        # The end of a step has no derivative; `place_of_event` adds that of an event.
        now = jax.lax.stop_gradient(now)
        happened = conditions.happened(progress.values, now)
        # After the time of an event is known, the motion ends there.
        sought = keep & (end == motion.limits.end) & jnp.any(happened)
        exact, zero = conditions.crossing(
            motion.observed,
            happened,
            (progress.values, now),
            (taken.t0, taken.t1),
            lambda t: self.stepper.state_at(motion.parameters, taken, t),
            sought,
        )
        repeat = sought & (exact < taken.t1)
        # Only the time of an event is before the end that the limits set.
        reached = keep & (taken.t1 >= end) & (end < motion.limits.end)
        keep = keep & ~repeat
        return _Passage(
            keep=keep,
            repeat=repeat,
            ended=(sought & ~repeat) | reached,
            end=jnp.where(repeat, exact, end),
            which=jnp.where(sought, zero, which),
            values=jnp.where(keep, now, progress.values),
        )
