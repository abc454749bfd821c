"""The search for tumblers that explain light curves: candidates, scan, refinement."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._checks import demand
from jrigid.photometry._model import (
    COUNT,
    Mode,
    Numbers,
    Task,
    gap_of_periods,
    motion_of,
    unpacked,
)
from jrigid.photometry._periodogram import frequency_pairs, strongest_lines, unlike
from jrigid.photometry._readings import Readings
from jrigid.photometry._refine import Quadratic, refined
from jrigid.photometry._scan import (
    best_orientations,
    fewer_epochs,
    frame_of,
    orientations,
)

# Ratios of the semi-axes b/a and c/b that a scan tries.
_RATIOS = [(x, y) for x in (0.42, 0.62, 0.82) for y in (0.6, 0.75, 0.9)]
_PHASES = np.pi * np.arange(6) / 6  # half a turn of the polhode looks like the other
_TILTS = np.linspace(-2.5, 3.5, 61)  # logarithms of tangents in a table
# Starting points of each pair of periods that are refined.
_STARTS = 3
# The best periods, and the starting points of each, when they are looked at again.
_AGAIN = 8
_MANY_STARTS = 12
_FIRST_STEPS = 6
# Then the better half goes on, so many times, for so many steps each; the last ones are
# refined to their end.
_FINALISTS = 48
_HALVINGS = 2
_NEXT_STEPS = 8
_LAST_STEPS = 80
# Tumblers whose cycles within the span differ by less than this are one.
_APART = 0.3
# Weight of the equation between the periods and the moments: loose first, so that the
# numbers find each other, then to a millionth.
_LOOSE = 300.0
_TIGHT = 1e6
_LANES_OF_SCAN = 512
_LANES = 16


Tree = TypeVar("Tree")


class Found(NamedTuple):
    """Points of a search, one in each row, the best first."""

    numbers: Float[np.ndarray, "many 11"]
    tasks: Task
    quadratic: Quadratic


def search(
    readings: Readings,
    lowest: float,
    highest: float,
    modes: list[Mode],
    homogeneous: bool,
    pairs: int,
) -> Found:
    """Tumblers that explain the readings, unlike in their periods or their mode.

    Args:
        readings: The light curves.
        lowest: Lowest frequency [cycles within the span].
        highest: Highest frequency.
        modes: Kinds of motion to try.
        homogeneous: Whether moments are those of the ellipsoid that is seen.
        pairs: Pairs of frequencies to try.

    Raises:
        ValueError: No candidate is a motion of these modes.
    """
    cycles, _ = frequency_pairs(readings, lowest, highest, pairs)
    lines, _ = strongest_lines(readings, lowest, highest)
    found = []
    for mode in modes:
        if mode == Mode.principal_axis:
            # An ellipsoid looks the same after half a turn, so that its strongest line
            # is at twice its frequency.
            candidates = np.concatenate([lines, lines / 2])
            candidates = candidates[(lowest <= candidates) & (candidates <= highest)]
            candidates = np.stack([candidates, np.zeros_like(candidates)], axis=1)
        else:
            candidates = cycles
        found += _from_candidates(readings, candidates, mode, _STARTS)
    demand(
        len(found) > 0,
        "Arguments `shortest` and `longest` must hold the periods of a motion of these "
        "`modes`, but they do not: choose a wider range.",
    )
    best = _settled(readings, _joined(found), homogeneous=True)
    # The best periods are looked at again, from more starting points.
    for mode in modes:
        of_mode = best.tasks.mode[:_AGAIN] == mode
        candidates = _neighbours(best.numbers[:_AGAIN, :2][of_mode], mode)
        found += _from_candidates(readings, candidates, mode, _MANY_STARTS)
    return _settled(readings, _joined(found), homogeneous)


def beside_mirror(readings: Readings, found: Found) -> tuple[Found, Found]:
    """The points with the better of the best one and its mirror first, and the other.

    There may be no other.
    """
    mirror = _mirrored(readings, found)
    if not len(mirror.numbers):
        return found, mirror
    if mirror.quadratic.chi_square[0] >= found.quadratic.chi_square[0]:
        return found, mirror
    others = np.arange(1, len(found.numbers))
    return _joined([mirror, _chosen(found, others)]), _chosen(found, [0])


def _mirrored(readings: Readings, found: Found) -> Found:
    """The best point, mirrored by the plane from which the body was seen, and refined.

    Let M reflect vectors at that plane. Directions in the plane stay as they are, and
    an ellipsoid looks the same from opposite sides. Therefore the rotation -M R has the
    light curves of R. Its momentum is -M L. It has the same periods and moments.
    """
    directions = np.concatenate([readings.to_sun, readings.to_observer])
    _, _, axes = np.linalg.svd(directions, full_matrices=False)
    reflection = np.eye(3) - 2 * np.outer(axes[2], axes[2])
    best = _chosen(found, [0])
    tasks = best.tasks._replace(frame=-best.tasks.frame @ reflection)
    return _minimised(readings, best.numbers, tasks, _LAST_STEPS)


def _neighbours(candidates: np.ndarray, mode: Mode) -> np.ndarray:
    """Candidates with frequencies half a cycle to each side."""
    either = (-0.5, 0.0, 0.5)
    # A principal-axis rotation has no second frequency.
    second = (0.0,) if mode == Mode.principal_axis else either
    beside = np.array([(x, y) for x in either for y in second])
    return (candidates[:, None] + beside).reshape(-1, 2)


def _from_candidates(
    readings: Readings, candidates: np.ndarray, mode: Mode, count: int
) -> list[Found]:
    """What so many starting points of each candidate lead to, if there are any."""
    numbers, of_candidate = _motions(candidates, mode)
    if len(numbers) == 0:
        return []
    return [_refined(readings, _starts(readings, numbers, of_candidate, mode, count))]


def _starts(
    readings: Readings,
    numbers: np.ndarray,
    of_candidate: np.ndarray,
    mode: Mode,
    count: int,
) -> Found:
    """The best orientations of the best motions for each candidate."""
    turned = orientations()
    few = fewer_epochs(readings)
    tasks = _tasks(len(numbers), mode, _LOOSE)
    scan = best_orientations
    values, index = _in_blocks(
        _LANES_OF_SCAN, lambda x, y: scan(x, y, turned, few), numbers, tasks
    )
    chosen = [
        _best_few(values, np.flatnonzero(of_candidate == k), count)
        for k in np.unique(of_candidate)
    ]
    motion, rank = np.concatenate(chosen).T
    frames = [frame_of(turned[i]) for i in index[motion, rank]]
    tasks = _rows(tasks, motion)._replace(frame=np.array(frames).reshape(-1, 3, 3))
    return Found(numbers[motion], tasks, Quadratic(values[motion, rank], None, None))


def _best_few(values: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """Row and column of the least values in some rows."""
    order = np.argsort(values[rows], axis=None)[:count]
    row, column = np.unravel_index(order, values[rows].shape)
    found = np.stack([rows[row], column], axis=1)
    return found[np.isfinite(values[found[:, 0], found[:, 1]])]


def _motions(candidates: np.ndarray, mode: Mode) -> tuple[np.ndarray, np.ndarray]:
    """Numbers for each candidate, shape and phase, and the candidate of each."""
    ratios = np.array(_RATIOS)
    logits = np.log(ratios / (1 - ratios))
    if mode == Mode.principal_axis:
        tilts = np.zeros((len(candidates), len(ratios)))
        phases = np.zeros(1)
    else:
        wanted = np.log(candidates[:, 0] / candidates[:, 1])
        tilts = np.stack([_tilts(x, wanted, mode) for x in logits], axis=1)
        phases = _PHASES
    candidate, shape, phase = np.meshgrid(
        *(np.arange(len(x)) for x in (candidates, ratios, phases)), indexing="ij"
    )
    exists = np.isfinite(tilts[candidate, shape])
    candidate, shape, phase = candidate[exists], shape[exists], phase[exists]
    zero = np.zeros(len(candidate))
    numbers = Numbers(
        cycles=candidates[candidate],
        angles=np.stack([zero, phases[phase]], axis=1),
        pole=np.stack([zero, zero], axis=1),
        log_tangent=tilts[candidate, shape][:, None],
        shape=logits[shape],
        inertia=logits[shape],
    )
    return np.concatenate(numbers, axis=1), candidate


def _tilts(logits: np.ndarray, wanted: np.ndarray, mode: Mode) -> np.ndarray:
    """Tilts at which a body has given ratios of periods; NaN where there is none."""
    table = np.asarray(_log_ratios(logits, _TILTS, mode))
    order = np.argsort(table)
    return np.interp(wanted, table[order], _TILTS[order], left=np.nan, right=np.nan)


@jax.jit
def _log_ratios(logits: Array, tilts: Array, mode: Array) -> Array:
    """Logarithms of f_phi / f_psi of a body at several tilts."""

    def at(tilt: Array) -> Array:
        numbers = unpacked(jnp.ones(COUNT, tilt.dtype))
        numbers = numbers._replace(log_tangent=tilt[None], shape=logits)
        task = Task(jnp.eye(3), mode, jnp.asarray(True), jnp.ones_like(tilt))
        # Both frequencies are 1 here, so the gap is minus the logarithm of the motion.
        return -gap_of_periods(numbers, motion_of(numbers, task), task)

    return jax.vmap(at)(tilts)


def _tasks(count: int, mode: Mode, link: float) -> Task:
    """The same task in all lanes, of a homogeneous body."""
    return Task(
        frame=np.tile(np.eye(3), (count, 1, 1)),
        mode=np.full(count, int(mode)),
        homogeneous=np.ones(count, bool),
        link=np.full(count, link),
    )


def _refined(readings: Readings, starts: Found) -> Found:
    """The best points to which starting points lead.

    Most starting points lead nowhere. The first steps look at a part of the epochs, and
    only the better half of the points goes on each time.
    """
    few = fewer_epochs(readings)
    found = _minimised(few, starts.numbers, starts.tasks, _FIRST_STEPS)
    for halving in range(_HALVINGS + 1):
        # Points of like frequencies may still go different ways.
        order = np.argsort(found.quadratic.chi_square)
        found = _chosen(found, order[: _FINALISTS // 2**halving])
        found = _minimised(readings, found.numbers, found.tasks, _NEXT_STEPS)
    found = _best(found, len(found.numbers))
    tasks = found.tasks._replace(link=np.full(len(found.numbers), _TIGHT))
    return _minimised(readings, found.numbers, tasks, _LAST_STEPS)


def _best(found: Found, count: int) -> Found:
    """The best points, unlike in their frequencies or their modes."""
    places = np.column_stack([found.numbers[:, :2], found.tasks.mode])
    return _chosen(found, unlike(places, -found.quadratic.chi_square, _APART, count))


def _settled(readings: Readings, found: Found, homogeneous: bool) -> Found:
    """The points with moments of their own, if they are sought; the best first."""
    found = _best(found, len(found.numbers))
    if not homogeneous:
        numbers = found.numbers.copy()
        # The search for the moments begins at those of the ellipsoid that is seen.
        numbers[:, 9:11] = numbers[:, 7:9]
        tasks = found.tasks._replace(homogeneous=np.zeros(len(numbers), bool))
        found = _minimised(readings, numbers, tasks, _LAST_STEPS)
    return _best(found, len(found.numbers))


def _minimised(
    readings: Readings, numbers: np.ndarray, tasks: Task, steps: int
) -> Found:
    """The points after so many steps, those that are finite."""
    minimise: Callable[..., tuple[Array, Quadratic]] = refined
    numbers, quadratic = _in_blocks(
        _LANES, lambda x, y: minimise(x, y, readings, steps=steps), numbers, tasks
    )
    found = Found(numbers, tasks, quadratic)
    return _chosen(found, np.flatnonzero(np.isfinite(quadratic.chi_square)))


def _in_blocks(
    lanes: int, function: Callable[..., tuple], numbers: np.ndarray, tasks: Task
) -> tuple:
    """Results of a function for all lanes, by a program for so many of them."""
    blocks = []
    for first in range(0, len(numbers), lanes):
        rows = np.arange(first, min(first + lanes, len(numbers)))
        # The last block repeats its rows, so that all blocks have one shape.
        block = _rows((numbers, tasks), np.resize(rows, lanes))
        blocks.append(_rows(function(*block), np.arange(len(rows))))
    return jax.tree.map(lambda *x: np.concatenate(x), *blocks)


def _rows(tree: Tree, rows: np.ndarray) -> Tree:
    """Some rows of all arrays, on the host."""
    return jax.tree.map(lambda x: np.asarray(x)[rows], tree)


def _chosen(found: Found, rows: list[int] | np.ndarray) -> Found:
    """Some of the points."""
    return _rows(found, np.asarray(rows, int))


def _joined(found: list[Found]) -> Found:
    """Points of several searches in one."""
    return jax.tree.map(lambda *x: np.concatenate(x), *found)
