"""Division of a record into segments, and the states at which they begin."""

import math
from typing import NamedTuple

import numpy as np

from jrigid._types import AnyArray
from jrigid.identify._readings import (
    DirectReadings,
    angle_turned,
    index_before,
    turned_by,
)
from jrigid.identify._records import Samples, first_and_last

MOST_NODES = 2000  # of a trial, where each sample has one


class Layout(NamedTuple):
    """Times of the samples (trials, samples) and of the nodes (trials, nodes).

    An unused node has no samples and no links.

    Attributes:
        ts: Times of the samples [s].
        node: Index of the node from which each sample is predicted.
        start: Time of each node [s].
        end: Time of the next node, or of the node itself where there is no link [s].
        linked: Whether the segment of a node ends at the next node.
        since: Fraction of the record that has passed at each sample.
    """

    ts: AnyArray
    node: AnyArray
    start: AnyArray
    end: AnyArray
    linked: AnyArray
    since: AnyArray


def whole(samples: Samples, nodes: int, t0: AnyArray | None = None) -> Layout:
    """Return a layout with one segment a trial, which begins at the first node.

    Args:
        samples: The samples.
        nodes: How many nodes a trial has; those after the first are unused.
        t0: Time of the first node; by default that of the first sample.
    """
    ts = samples.ts
    xp = ts.__array_namespace__()
    first, last = first_and_last(ts, samples.seen)
    # Unused nodes keep the arrays of all layouts equal in shape, so that one program
    # serves them.
    is_first = xp.broadcast_to(xp.arange(nodes) == 0, (ts.shape[0], nodes))
    begin = xp.broadcast_to(first if t0 is None else xp.asarray(t0), first.shape)
    start = xp.where(is_first, begin[:, None], 0.0)
    # A trial of one sample has no length.
    span = xp.where(last > first, last - first, 1.0)
    return Layout(
        ts=ts,
        node=xp.zeros(ts.shape, int),
        start=start,
        end=start,
        linked=xp.zeros_like(is_first),
        since=(ts - first[:, None]) / span[:, None],
    )


def segments(
    samples: Samples, readings: DirectReadings, nodes: int, length: float
) -> tuple[Layout, np.ndarray]:
    """Divide each trial into segments.

    Args:
        samples: The samples.
        readings: Directly read rates, which say how far the body turns.
        nodes: The most segments of a trial; they become longer where it is too few.
        length: Length of a segment [rad]; 0 for a segment of each direct reading.

    Returns:
        The layout, and the index of the direct reading at each node (trials, nodes).
    """
    if length:
        measure = angle_turned(readings)
        most = max(nodes - 1, 1)
    else:
        # Half a step off the edges of segments, where rounding would decide.
        measure = np.cumsum(readings.valid, axis=1).astype(samples.ts.dtype) - 0.5
        most = nodes
    size = np.maximum(length or 1.0, measure[:, -1] / most)
    # Rounding must not start a segment at the very end of the record.
    number = np.floor(measure / size[:, None] * (1 - 1e-12))
    trials = zip(
        map(Layout, *whole(samples, nodes)),
        number,
        readings.ts,
        readings.valid,
        strict=True,
    )
    layouts, readings_at_nodes = zip(
        *(_segments_of_trial(*trial) for trial in trials), strict=True
    )
    stacked = Layout(*map(np.stack, zip(*layouts, strict=True)))
    return stacked, np.stack(readings_at_nodes)


def _segments_of_trial(
    layout: Layout, number: np.ndarray, ts: np.ndarray, valid: np.ndarray
) -> tuple[Layout, np.ndarray]:
    """Divide one trial.

    Args:
        layout: The trial as one segment.
        number: Number of the segment of each direct reading.
        ts: Times of the direct readings.
        valid: Which direct readings there are.

    Returns:
        The layout, and the index of the direct reading at each node (nodes,).
    """
    nodes = layout.start.size
    last = index_before(valid)
    opens = np.flatnonzero(valid & ((last < 0) | (number != number[last])))
    reading = np.zeros(nodes, int)
    reading[: opens.size] = opens[:nodes]
    used = np.arange(nodes) < opens.size
    start = ts[reading]
    # The first node stands at the first sample of any kind.
    start[0] = layout.start[0]
    node = np.searchsorted(np.where(used, start, np.inf), layout.ts, side="right") - 1
    linked = np.append(used[1:], False)
    divided = layout._replace(
        node=np.clip(node, 0, nodes - 1),
        start=start,
        end=np.where(linked, np.roll(start, -1), start),
        linked=linked,
    )
    return divided, reading


def node_states(
    readings: DirectReadings, reading: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return rates and attitudes at nodes, as read directly.

    Args:
        readings: The direct readings.
        reading: Index of the one at each node (trials, nodes).
        start: Time of each node (trials, nodes) [s].
    """
    trial = np.arange(len(reading))[:, None]
    omega = readings.omega[trial, reading]
    if readings.attitude is None:
        return omega, None
    # Zero, except at the first node, which stands at the first sample of any record.
    late = start - readings.ts[trial, reading]
    return omega, turned_by(readings.attitude[trial, reading], omega, late)


def segments_needed(angle: float, samples: int, length: float) -> int:
    """Return how many nodes a trial needs.

    Args:
        angle: Angle turned [rad]; not finite for the worst case.
        samples: How many samples a trial has.
        length: Length of a segment [rad]; 0 for a segment of each sample.
    """
    if not length:
        return min(samples, MOST_NODES)
    # More segments than this would have fewer than two samples each.
    most = samples // 2 + 2
    if not 0 <= angle < math.inf:
        return most
    # 8, 32, 128, ...: few programs serve all records.
    needed = max(angle / length + 2, 8.0)
    return min(2 * 4 ** math.ceil(math.log(needed / 2, 4)), most)
