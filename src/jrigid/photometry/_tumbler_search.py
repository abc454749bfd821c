"""The search for tumblers that explain light curves: candidates, scan, refinement."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._checks import demand
from jrigid._core.host_rows import in_batches, joined, rows_of
from jrigid.photometry._curve_readings import Readings
from jrigid.photometry._many_starts import Quadratic, minimised
from jrigid.photometry._model import (
    COUNT,
    Mode,
    Numbers,
    Task,
    gap_of_periods,
    logits_of,
    motion_of,
    tumbler_quadratic,
    unpacked,
)
from jrigid.photometry._periodogram import frequency_pairs, strongest_lines, unlike
from jrigid.photometry._pole import direction_of_pole
from jrigid.photometry._scan import (
    ANGLES,
    attitudes_tried,
    fewer_epochs,
    frame_of,
    scanned,
)

# Ratios of the semi-axes b/a and c/b that a scan tries.
_RATIOS = [(x, y) for x in (0.42, 0.62, 0.82) for y in (0.6, 0.75, 0.9)]
_PHASES = np.pi * np.arange(6) / 6  # half a turn of the polhode looks like the other
_TILTS = np.linspace(-2.5, 3.5, 61)  # logarithms of tangents in a table
# Starting points of each pair of periods that are refined.
_STARTS = 3
# Best directions of the momentum that each motion is tried with.
_DIRECTIONS = 2
# The best periods, and the starting points of each, when they are looked at again.
_AGAIN = 8
_MANY_STARTS = 12
# The best periods that are looked at from all poles, if chi-square is no larger than so
# many times the least one.
_FROM_ALL_POLES = 4
_MUCH_WORSE = 2.0
_FIRST_STEPS = 6
# Then the better half goes on, so many times, for so many steps each; the last ones are
# refined to their end.
_FINALISTS = 48
_HALVINGS = 2
_NEXT_STEPS = 8
_LAST_STEPS = 80
# Tumblers are one if their cycles within the span differ by less than this, and the
# directions of their momenta by less than a quarter of a radian.
APART = 0.3
_APART_IN_POLE = 0.25
# Weight of the equation between the periods and the moments: loose first, so that the
# numbers find each other, then to a millionth.
_LOOSE = 300.0
_TIGHT = 1e6
_LANES_OF_SCAN = 512
_LANES = 16

# A mirror's momentum is as far from that of the reflection, but for what the curves
# tell.
_NEAR_MIRROR = 0.6

# Rows and columns of some of a table of values.
Choice: TypeAlias = Callable[[np.ndarray], np.ndarray]


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
    """Tumblers that explain the readings, unlike in their periods, mode or momentum.

    The mirror of the best one is among them where it is a minimum.

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
    lines, _ = strongest_lines(readings, lowest, highest)
    cycles = np.zeros((0, 2))
    if modes != [Mode.principal_axis]:
        cycles, _ = frequency_pairs(readings, lines, lowest, highest, pairs)
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
        found += _from_candidates(readings, candidates, mode, _few(_STARTS))
    demand(
        sum(len(points.numbers) for points in found) > 0,
        "Arguments `shortest` and `longest` must hold the periods of a motion of these "
        "`modes` that is lit at all epochs, but they do not: choose a wider range.",
    )
    # The best periods are looked at again, from more starting points.
    best = _unlike_periods(joined(found), _AGAIN)
    for mode in modes:
        candidates = _neighbours(best.numbers[best.tasks.mode == mode, :2], mode)
        found += _from_candidates(readings, candidates, mode, _few(_MANY_STARTS))
    # A search keeps few points of one motion, and would miss other poles.
    best = _unlike_periods(joined(found), _FROM_ALL_POLES)
    growth = best.quadratic.chi_square / best.quadratic.chi_square[0]
    best = rows_of(best, np.flatnonzero(growth < _MUCH_WORSE))
    for mode in modes:
        cycles = best.numbers[best.tasks.mode == mode, :2]
        found += _from_all_poles(readings, cycles, mode)
    best = _best(joined(found))
    if not homogeneous:
        best = _with_own_moments(readings, best)
    return _best(joined([best, _mirrored(readings, best)]))


def _with_own_moments(readings: Readings, found: Found) -> Found:
    """The points with moments that are sought apart from the ellipsoid."""
    numbers = found.numbers.copy()
    # The search for the moments begins at those of the ellipsoid that is seen.
    numbers[:, 9:11] = numbers[:, 7:9]
    tasks = found.tasks._replace(homogeneous=np.zeros(len(numbers), bool))
    return _best(_minimised(readings, numbers, tasks, _LAST_STEPS))


def poles_of(found: Found) -> Float[np.ndarray, "many 3"]:
    """Directions of the momenta in space."""
    longitude, latitude = unpacked(found.numbers).pole.T
    inside = direction_of_pole(longitude, latitude)
    return np.einsum("ni,nij->nj", inside, found.tasks.frame)


def index_of_mirror(readings: Readings, found: Found) -> int | None:
    """Index of the point that is the mirror of the first one, or None."""
    poles = poles_of(found)
    mirrored = -poles[0] @ _reflection(readings)
    apart = np.linalg.norm(poles - mirrored, axis=1)
    places = _motions_of(found)
    same = np.all(np.abs(places - places[0]) < APART, axis=1)
    same &= apart < _NEAR_MIRROR
    same[0] = False
    return int(np.argmin(np.where(same, apart, np.inf))) if np.any(same) else None


def _mirrored(readings: Readings, found: Found) -> Found:
    """The best point, mirrored by the plane from which the body was seen, and refined.

    Let M reflect vectors at that plane. Directions in the plane stay as they are, and
    an ellipsoid looks the same from opposite sides. Therefore the rotation -M R has the
    light curves of R. Its momentum is -M L. It has the same periods and moments.
    """
    best = rows_of(found, [0])
    tasks = best.tasks._replace(frame=-best.tasks.frame @ _reflection(readings))
    return _minimised(readings, best.numbers, tasks, _LAST_STEPS)


def _reflection(readings: Readings) -> Float[np.ndarray, "3 3"]:
    """Reflection at the plane from which the body was seen."""
    directions = np.concatenate([readings.to_sun, readings.to_observer])
    _, _, axes = np.linalg.svd(directions, full_matrices=False)
    return np.eye(3) - 2 * np.outer(axes[2], axes[2])


def _neighbours(candidates: np.ndarray, mode: Mode) -> np.ndarray:
    """Candidates with frequencies half a cycle to each side, but none below zero."""
    either = (-0.5, 0.0, 0.5)
    # A principal-axis rotation has no second frequency.
    second = (0.0,) if mode == Mode.principal_axis else either
    beside = np.array([(x, y) for x in either for y in second])
    moved = (candidates[:, None] + beside).reshape(-1, 2)
    sought = moved[:, :1] if mode == Mode.principal_axis else moved
    return moved[np.all(sought > 0, axis=1)]


def _from_candidates(
    readings: Readings, candidates: np.ndarray, mode: Mode, choose: Choice
) -> list[Found]:
    """Refined points from chosen starting points of all candidates, if any exist."""
    numbers, of_candidate = _motions(candidates, mode)
    if len(numbers) == 0:
        return []
    return [_refined(readings, _starts(readings, numbers, of_candidate, mode, choose))]


def _from_all_poles(
    readings: Readings, candidates: np.ndarray, mode: Mode
) -> list[Found]:
    """Refined points from starting points at all poles, an entry for each candidate."""
    numbers, of_candidate = _motions(candidates, mode)
    if len(numbers) == 0:
        return []
    starts = _starts(readings, numbers, of_candidate, mode, _each_pole)
    parts = np.split(np.arange(len(starts.numbers)), len(np.unique(of_candidate)))
    return [_refined(readings, rows_of(starts, rows)) for rows in parts]


def _starts(
    readings: Readings,
    numbers: np.ndarray,
    of_candidate: np.ndarray,
    mode: Mode,
    choose: Choice,
) -> Found:
    """Chosen attitudes of the motions of each candidate."""
    turned = attitudes_tried()
    few = fewer_epochs(readings)
    tasks = _tasks(len(numbers), mode, _LOOSE)
    values = in_batches(
        _LANES_OF_SCAN, lambda x, y: scanned(x, y, turned, few), numbers, tasks
    )
    chosen = []
    for k in np.unique(of_candidate):
        rows = np.flatnonzero(of_candidate == k)
        row, column = choose(values[rows]).T
        chosen.append(np.stack([rows[row], column], axis=1))
    motion, orientation = np.concatenate(chosen).T
    frames = [frame_of(turned[i]) for i in orientation]
    tasks = rows_of(tasks, motion)._replace(frame=np.array(frames).reshape(-1, 3, 3))
    at = Quadratic(values[motion, orientation], None, None)
    return Found(numbers[motion], tasks, at)


def _few(count: int) -> Choice:
    """The best points, of which each motion has at most two."""

    def choose(values: np.ndarray) -> np.ndarray:
        columns = np.argsort(values, axis=1)[:, :_DIRECTIONS]
        each = np.take_along_axis(values, columns, axis=1)
        row, rank = np.unravel_index(np.argsort(each, axis=None)[:count], each.shape)
        chosen = np.stack([row, columns[row, rank]], axis=1)
        return chosen[np.isfinite(each[row, rank])]

    return choose


def _each_pole(values: np.ndarray) -> np.ndarray:
    """The best motion and angle for each pole, those of no light included."""
    columns = np.arange(values.shape[1]).reshape(-1, ANGLES)
    of_pole = np.swapaxes(values[:, columns], 0, 1).reshape(len(columns), -1)
    row, angle = np.divmod(np.argmin(of_pole, axis=1), ANGLES)
    return np.stack([row, columns[np.arange(len(columns)), angle]], axis=1)


def _motions(candidates: np.ndarray, mode: Mode) -> tuple[np.ndarray, np.ndarray]:
    """Numbers for each candidate, shape and phase, and the candidate of each."""
    ratios = np.array(_RATIOS)
    logits = logits_of(ratios)
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
        found = rows_of(found, order[: _FINALISTS // 2**halving])
        found = _minimised(readings, found.numbers, found.tasks, _NEXT_STEPS)
    found = _best(found)
    tasks = found.tasks._replace(link=np.full(len(found.numbers), _TIGHT))
    return _minimised(readings, found.numbers, tasks, _LAST_STEPS)


def _motions_of(found: Found) -> Float[np.ndarray, "many 3"]:
    """Frequencies and modes, which tell motions apart."""
    return np.column_stack([found.numbers[:, :2], found.tasks.mode])


def _best(found: Found) -> Found:
    """The points that are unlike in their motions or their momenta, the best first."""
    # In this scale one threshold serves the cycles and the directions.
    poles = poles_of(found) * APART / _APART_IN_POLE
    places = np.column_stack([_motions_of(found), poles])
    merits = -found.quadratic.chi_square
    return rows_of(found, unlike(places, merits, APART, len(places)))


def _unlike_periods(found: Found, count: int) -> Found:
    """The best points that are unlike in their motions."""
    merits = -found.quadratic.chi_square
    return rows_of(found, unlike(_motions_of(found), merits, APART, count))


def _minimised(
    readings: Readings, numbers: np.ndarray, tasks: Task, steps: int
) -> Found:
    """The points after so many steps, those that are finite."""

    def of_batch(numbers: np.ndarray, tasks: Task) -> tuple[Array, Quadratic]:
        return minimised(tumbler_quadratic, numbers, tasks, (readings,), steps)

    numbers, quadratic = in_batches(_LANES, of_batch, numbers, tasks)
    found = Found(numbers, tasks, quadratic)
    return rows_of(found, np.flatnonzero(np.isfinite(quadratic.chi_square)))
