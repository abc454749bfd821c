"""Accuracy with which the steps of a fit follow the motion under a torque.

A fit makes a fixed number of Runge-Kutta steps for each segment, without an error
estimate. Its segments are parts of a turn, which suffices where the torque changes as
slowly as the body turns. A torque may change faster: a wheel's, or that of a pendulum
that swings by a few degrees. So the steps are compared with far shorter ones, where the
search begins and where it ends.
"""

from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Array

from jrigid._core.compile import small_program
from jrigid._core.inline import inlined
from jrigid._types import AnyArray
from jrigid.dynamics import State
from jrigid.identify._host import conjugate, log, multiply
from jrigid.identify._layout import Layout
from jrigid.identify._problem import Problem, flow, over_trials
from jrigid.identify._smoother import Point
from jrigid.identify._unknowns import Unknowns

# Steps of a segment that are compared with: the most, the fewest, and of all segments
# together, which take a second or two.
_MOST = 256
_FEWEST = 16
_TOGETHER = 2**17
# What a segment may add, in units of the rates, by the size of the dtype in bytes; and
# in units of the noise. A record has some hundred segments.
_OF_RATE = {8: 1e-6, 4: 1e-3}
_OF_NOISE = 1e-4
# An error at the end of a search that spoils a fit. The body that a search begins from
# is not the one that it finds, so that some excess is no surprise.
UNRESOLVED = 10.0


@small_program
def _states_after(
    problem: Problem, layout: Layout, point: Point, steps: Array
) -> tuple[Array, Array]:
    """Attitudes and rates at the ends of all segments (trials, nodes, ...)."""

    def trial(
        point: Point, leaves: tuple[AnyArray, ...], trial: Any
    ) -> tuple[Array, Array]:
        system = problem.unknowns.parts(point.numbers, point.own, leaves)[0]
        layout = trial.layout
        nodes = State(point.attitude, point.omega)
        after = flow(problem.options, system, nodes, layout.start, layout.end, steps)
        return after.attitude, after.omega

    return over_trials(partial(inlined, trial), problem, layout)(point)


def _to_last_samples(layout: Layout, seen: np.ndarray) -> Layout:
    """The layout, with segments that end at the next node or at their last sample."""
    end = np.array(layout.end)
    trial, sample = np.nonzero(seen)
    np.maximum.at(end, (trial, layout.node[trial, sample]), layout.ts[trial, sample])
    return layout._replace(end=end)


def is_resolved(problem: Problem, layout: Layout, point: Point) -> bool:
    """Whether the steps of a fit follow the motion from the states at the nodes."""
    return integration_error(problem, layout, point) <= 1


@small_program
def _jumps(
    unknowns: Unknowns, numbers: Array, own: Array, leaves: tuple[AnyArray, ...]
) -> Array:
    """Times of a trial at which the torque declares that it is not smooth."""
    return unknowns.parts(numbers, own, leaves)[0].jumps


def jumps_in_a_segment(problem: Problem, layout: Layout, point: Point) -> int:
    """The most jumps that the torque declares within a segment, or at its ends."""
    layout = _to_last_samples(layout, problem.samples.seen)
    unknowns = problem.unknowns
    most = 0
    for trial, own in enumerate(point.own):
        leaves = unknowns.leaves_of(trial)
        jumps = np.sort(_jumps(unknowns, point.numbers, own, leaves))
        first = np.searchsorted(jumps, layout.start[trial], side="left")
        last = np.searchsorted(jumps, layout.end[trial], side="right")
        most = max(most, int(np.max(last - first)))
    return most


def integration_error(problem: Problem, layout: Layout, point: Point) -> float:
    """Largest error of a segment's steps, in units of what is allowed.

    It is 0 where the motion is exact, or integrated with an error estimate.

    Args:
        problem: The record.
        layout: The segments.
        point: The numbers, and the states at the starts of segments.
    """
    options = problem.options
    if options.free_motion or not options.shooting:
        return 0.0
    layout = _to_last_samples(layout, problem.samples.seen)
    reference = np.clip(_TOGETHER // layout.start.size, _FEWEST, _MOST)
    # The method is of order 8: four times as many steps have an error 4^8 times
    # smaller.
    reference = max(reference, 4 * options.steps)
    states = partial(_states_after, problem, layout, point)
    (attitude, omega), (true_attitude, true_omega) = (
        [np.asarray(x) for x in states(np.asarray(steps))]
        for steps in (options.steps, reference)
    )
    part = _OF_RATE[omega.dtype.itemsize]
    rate = np.sqrt(np.mean(np.sum(point.omega**2, axis=-1)))
    allowed = np.maximum(part * rate, _OF_NOISE * problem.noise[:3])
    error = np.max(np.abs(omega - true_omega) / allowed)
    if options.depends_on_attitude:
        allowed = np.maximum(part, _OF_NOISE * problem.noise[3:])
        turn = log(multiply(conjugate(true_attitude), attitude))
        error = max(error, np.max(np.abs(turn) / allowed))
    return float(error) if np.isfinite(error) else np.inf
