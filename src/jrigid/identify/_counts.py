"""Minima that differ in how often a body turned in the long gaps of a record.

A part of a record tells the rate at which the body turns with an error. Over a gap this
error grows, and where it reaches half a turn the number of turns in the gap is a guess:
there is a minimum of chi-square for each number. This module says where they are.
"""

from typing import NamedTuple

import numpy as np

from jrigid._core.compile import small_program
from jrigid.identify._independent import condensed_rows
from jrigid.identify._minimise import moved_on_path
from jrigid.identify._precision import precision, reduced
from jrigid.identify._quality import Fit, signal_of, weights_of
from jrigid.identify._smoother import Move, Point

_GAP = 3.5  # radians that a body turns in a gap
_LONG = 10.0  # times the median interval of its trial that a gap lasts
_GAPS = 4  # of a trial, the longest, that are looked at
_UNDOUBTED_ANGLE = 0.2  # radians: an error that leaves no doubt of the number of turns
_ERRORS_SEARCHED = 5.0  # standard errors to which other numbers of turns are looked for
_STEP = 0.5  # radians between places to look at; minima are some six radians apart
_MOST = 400  # places to look at beside one gap
_SHOWN = 1e-7  # of the largest singular value: a direction that the record shows
_point_after = small_program(moved_on_path)


class Gap(NamedTuple):
    """A gap in a trial, by which samples are on its two sides.

    Attributes:
        trial: The trial.
        sides: Which samples come before it, and which come after it.
    """

    trial: int
    sides: tuple[np.ndarray, np.ndarray]


class Places(NamedTuple):
    """Points from which all minima are found that one side of a gap allows.

    Attributes:
        angle: Error of what that side predicts of the other one [rad].
        complete: Whether these are all the places that there are.
        offsets: How far each one is from the first side's own motion, along each
            direction that matters [steps] (places, directions).
        points: The points.
    """

    angle: float
    complete: bool
    offsets: np.ndarray
    points: list[Point]

    def lowest(self, squares: np.ndarray) -> list[Point]:
        """The places of which no neighbour has a smaller sum of squares."""
        apart = np.abs(self.offsets[:, None] - self.offsets)
        is_neighbour = np.all(apart < 1.5, axis=-1)
        near = np.where(is_neighbour, squares, np.inf)
        least = np.min(near, axis=1, initial=np.inf)
        return [self.points[i] for i in np.flatnonzero(squares <= least)]


def gaps_of(fit: Fit) -> list[Gap]:
    """The longest gaps of each trial, in which the body turns far."""
    found = []
    for trial, (ts, kept) in enumerate(zip(fit.layout.ts, fit.kept, strict=True)):
        times = np.unique(ts[kept > 0])
        if times.size < 3:
            continue
        intervals = np.diff(times)
        rate = np.linalg.norm(fit.minimum.point.omega[trial, 0])
        is_gap = intervals * rate > _GAP
        is_gap &= intervals > _LONG * np.median(intervals)
        longest = np.argsort(-np.where(is_gap, intervals, 0.0))[:_GAPS]
        for index in np.sort(longest[is_gap[longest]]):
            is_before = ts <= times[index]
            sides = ((kept > 0) & is_before, (kept > 0) & ~is_before)
            found.append(Gap(trial, sides))
    return found


def places_beside(
    side: Fit, whole: Fit, trial: int, predicted: np.ndarray, noise: float
) -> Places:
    """Find places of minima that differ in the number of turns in a gap.

    Args:
        side: A fit of the record without the samples on one side of the gap.
        whole: A fit of the record.
        trial: The trial of the gap.
        predicted: The samples on the other side.
        noise: Mean square of the residuals that is noise.
    """
    of_numbers, of_local = _errors(side, trial)
    # A side that says nothing of some number predicts nothing of the other.
    says_all = of_numbers.shape[1] >= _errors(whole, trial)[0].shape[1]
    effect = _effect(side, trial, of_numbers, of_local)[predicted]
    signal = signal_of(side.problem, weights_of(side.problem, whole.kept))
    size = np.linalg.norm(signal[trial, predicted])
    if not (says_all and size > 0 and np.all(np.isfinite(effect))):
        return Places(np.inf, False, np.zeros((0, 0)), [])
    effect = effect.reshape(-1, effect.shape[-1])
    _, sizes, vt = np.linalg.svd(effect, full_matrices=False)
    angles = np.sqrt(noise) * sizes / size
    # Two counts may be open, that of turns and that of wobbles.
    large = angles[angles > _UNDOUBTED_ANGLE][:2]
    offsets, complete = _offsets(large)
    changes = (offsets * _STEP * size / sizes[: large.size]) @ vt[: large.size]
    points = [
        _point_moved(side, trial, of_numbers @ change, of_local @ change)
        for change in changes
    ]
    return Places(float(np.max(angles, initial=0.0)), complete, offsets, points)


def _errors(fit: Fit, trial: int) -> tuple[np.ndarray, np.ndarray]:
    """Changes by one standard error, in columns, of all that a fit determines.

    Returns:
        Changes of the numbers (numbers, columns), and those of one trial's first state
        and own numbers that go with them (local, columns).
    """
    known = precision(fit)
    is_shown = known.values > _SHOWN * np.max(known.values, initial=0.0)
    units = fit.minimum.units[:, None]
    of_numbers = units * known.directions[:, is_shown] / known.values[is_shown]
    follows = known.sensitivity[trial] @ of_numbers
    states = reduced(fit).states
    of_state = states.half[trial][:, states.shown[trial]]
    still = np.zeros((len(of_numbers), of_state.shape[1]))
    return (
        np.concatenate([of_numbers, still], axis=1),
        np.concatenate([follows, of_state], axis=1),
    )


def _effect(
    fit: Fit, trial: int, of_numbers: np.ndarray, of_local: np.ndarray
) -> np.ndarray:
    """Effect of changes on whitened samples of a trial (samples, degrees, columns)."""
    rows = condensed_rows(fit)
    count = fit.kept.shape[1]
    own = fit.minimum.point.own.shape[-1]
    border = rows.of_border[trial, :count]
    local = np.concatenate([rows.of_state[trial, :count], border[..., :own]], axis=-1)
    return local @ of_local + border[..., own:] @ of_numbers


def _offsets(angles: np.ndarray) -> tuple[np.ndarray, bool]:
    """Offsets to try, in steps along directions with these standard errors [rad].

    Returns:
        Offsets (places, directions), and whether they reach as far as they should.
    """
    grid = np.zeros((1, 0))
    complete = True
    for angle in angles:
        steps = int(np.ceil(_ERRORS_SEARCHED * angle / _STEP))
        most = (_MOST // len(grid) - 1) // 2
        complete = complete and steps <= most
        along = np.arange(-min(steps, most), min(steps, most) + 1.0)
        grid = np.concatenate(
            [np.column_stack([grid, np.full(len(grid), x)]) for x in along]
        )
    # Within an ellipse of so many standard errors, and one step beyond it.
    beyond = _ERRORS_SEARCHED + _STEP / np.min(angles, initial=np.inf)
    is_inside = np.linalg.norm(grid * _STEP / angles, axis=1) <= beyond
    return grid[is_inside], complete


def _point_moved(fit: Fit, trial: int, numbers: np.ndarray, local: np.ndarray) -> Point:
    """The point of a fit after a change of numbers, and of one trial's first state."""
    point = fit.minimum.point
    own = np.zeros_like(point.own)
    states = np.zeros((*point.omega.shape[:2], local.size - own.shape[-1]))
    states[trial, 0] = local[: states.shape[-1]]
    own[trial] = local[states.shape[-1] :]
    move = Move(numbers, own, states.astype(point.omega.dtype))
    return _point_after(fit.problem.unknowns, point, move)
