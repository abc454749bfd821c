"""The search for steady rotations that explain light curves."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jrigid._checks import demand
from jrigid._core.host_rows import in_batches, joined, rows_of
from jrigid._types import AnyArray
from jrigid.photometry._convex import (
    FIRST_AXES,
    SPIN,
    Surface,
    degrees_of_harmonics,
    ellipsoid_harmonics,
    even_directions,
    spin_quadratic,
    unpacked_convex,
)
from jrigid.photometry._curve_readings import Readings
from jrigid.photometry._many_starts import Quadratic, minimised
from jrigid.photometry._periodogram import shared_places
from jrigid.photometry._pole import direction_of_pole
from jrigid.photometry._scan import fewer_epochs

# Chi-square has a minimum about every half turn within the span: half turns of an
# elongated body look alike.
STRIDE = 0.4
# Minima of chi-square are 40 degrees apart and more.
_POLES = 24
# The scan uses a coarse body and a part of the epochs.
COARSE_DEGREE = 3
COARSE_FACETS = 128
# A facet has a kink where it becomes lit or visible. Few facets make chi-square rough,
# with minima some degrees apart and slopes in the pole that are too large. A search may
# be rough, but errors need more facets.
SEARCHED_FACETS = 512
_EPOCHS = 512
# A body that is nearly round says little of its pole, so the shape goes first.
_SHAPE_STEPS = 3
_SCAN_STEPS = 7
_SURVIVORS = 96
_COARSE_STEPS = 40
_FINALISTS = 24
_FULL_STEPS = 25
REFINED = 12
_LAST_STEPS = 200
# Solutions are one if their turns within the span differ by less than this, and their
# poles by less than a quarter of a radian.
_APART = 0.3
_APART_IN_POLE = 0.25
# Minima whose poles differ by less [rad] are the same minimum.
_SAME_POLE = 0.01
# A period has many poles. It takes no more than this part of the places while there are
# other periods, so that it does not hide them.
_SHARE = 1 / 3
_COARSE_LANES = 32
# A processor gains nothing by more lanes of the full body at once, and all lanes wait
# for the slowest.
_LANES = 1


class Spins(NamedTuple):
    """Points of a search, one in each row.

    Attributes:
        numbers: Of the fit.
        frames: Axes of the fit, rows; its x axis is near the pole.
        quadratic: Chi-square about the points.
    """

    numbers: Float[AnyArray, "many numbers"]
    frames: Float[AnyArray, "many 3 3"]
    quadratic: Quadratic

    def poles(self) -> Float[np.ndarray, "many 3"]:
        """Directions of the poles in space."""
        return poles_of(self.numbers, self.frames)


def poles_of(
    numbers: Float[np.ndarray, "many numbers"], frames: Float[np.ndarray, "many 3 3"]
) -> Float[np.ndarray, "many 3"]:
    """Directions of the poles in space."""
    longitude, latitude = unpacked_convex(numbers, SPIN).motion[..., 1:].T
    inside = direction_of_pole(longitude, latitude)
    return np.einsum("ni,nij->nj", inside, frames)


def frame_of_pole(pole: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Axes of a fit, rows: the pole, east of it and north of it."""
    longitude = np.arctan2(pole[1], pole[0])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    return np.stack([pole, east, np.cross(pole, east)])


def search_spins(
    readings: Readings,
    surface: Surface,
    searched: Surface,
    coarse: Surface,
    lowest: float,
    highest: float,
) -> Spins:
    """Steady rotations that explain the readings, the best first, with its mirror.

    Args:
        readings: The light curves.
        surface: The body that is sought.
        searched: The same, with fewer facets.
        coarse: The body of the scan, with fewer harmonics and facets.
        lowest: Fewest turns within the span.
        highest: Most turns.
    """
    few = fewer_epochs(readings, _EPOCHS)
    numbers, frames = starts(coarse, lowest, highest)
    is_motion = np.arange(coarse.centre.size) < SPIN
    still = coarse._replace(sought=coarse.sought & ~is_motion)
    scanned = minimise(numbers, frames, still, few, _SHAPE_STEPS, _COARSE_LANES)
    scanned = minimise(scanned.numbers, frames, coarse, few, _SCAN_STEPS, _COARSE_LANES)
    better = best(scanned, _SURVIVORS)
    better = minimise(
        better.numbers, better.frames, coarse, few, _COARSE_STEPS, _COARSE_LANES
    )
    finalists = best(better, _FINALISTS)
    # Harmonics are in the order of their degrees: those of the coarse body come first.
    finer = surface.centre.size - finalists.numbers.shape[1]
    numbers = np.pad(finalists.numbers, ((0, 0), (0, finer)))
    full = minimise(numbers, finalists.frames, searched, readings, _FULL_STEPS, _LANES)
    kept = _chosen(full, REFINED, _APART_IN_POLE)
    demand(
        len(kept) > 0,
        "Arguments `shortest` and `longest` must hold a rotation whose light is finite "
        "at all epochs of `curves`, but they do not.",
    )
    near = [neighbours(full, rows_of(full, [i])) for i in kept.tolist()]
    return settled(rows_of(full, np.unique(np.concatenate(near))), surface, readings)


def settled(spins: Spins, surface: Surface, readings: Readings) -> Spins:
    """The points refined to their end, with the mirror of the best; the best first.

    Minima of one period and pole are all kept.
    """
    last = (surface, readings, _LAST_STEPS, _LANES)
    found = distinct(minimise(spins.numbers, spins.frames, *last))
    of_mirror = minimise(*mirrored(rows_of(found, [0])), *last)
    return distinct(joined([found, of_mirror]))


def neighbours(spins: Spins, one: Spins) -> Int[np.ndarray, " near"]:
    """Indices of the points with the period and the pole of a point, itself among them.

    A facet has a kink where it becomes lit or visible, so that chi-square has several
    minima about a pole, some degrees apart.
    """
    turns = np.abs(spins.numbers[:, 0] - one.numbers[0, 0])
    apart = np.abs(spins.poles() - one.poles()).max(axis=1)
    return np.flatnonzero((turns <= _APART) & (apart <= _APART_IN_POLE))


def minima_about(spins: Spins, poles: Spins) -> list[Int[np.ndarray, " minima"]]:
    """Indices of the minima about each of some poles, which are in the order of merit.

    A minimum between two poles belongs to the better one.
    """
    groups = []
    left_over = np.ones(len(spins.numbers), bool)
    for i in range(len(poles.numbers)):
        near = neighbours(spins, rows_of(poles, [i]))
        groups.append(near[left_over[near]])
        left_over[near] = False
    return groups


def starts(
    surface: Surface, lowest: float, highest: float
) -> tuple[AnyArray, AnyArray]:
    """Numbers and frames of all starting points."""
    count = max(1, int(np.ceil((highest - lowest) / STRIDE)))
    cycles = lowest + (highest - lowest) * (np.arange(count) + 0.5) / count
    frames = np.stack([frame_of_pole(pole) for pole in even_directions(_POLES)])
    first = surface.centre.copy()
    first[10:] = ellipsoid_harmonics(surface, FIRST_AXES)
    numbers = np.tile(first, (count * _POLES, 1))
    numbers[:, 0] = np.repeat(cycles, _POLES)
    return numbers, np.tile(frames, (count, 1, 1))


def mirrored(spins: Spins) -> tuple[AnyArray, AnyArray]:
    """Numbers and frames that give the same light in the plane of the ecliptic.

    There, the mirror image has the Sun and the observer where they are. Its pole has
    another longitude by half a turn. In body axes all directions are opposite, and so
    are the normals.
    """
    numbers = np.array(spins.numbers)
    numbers[:, 3:6] *= -1
    numbers[:, 10:] *= (-1.0) ** degrees_of_harmonics(numbers.shape[1] - 10)
    return numbers, np.asarray(spins.frames) * [-1.0, -1.0, 1.0]


def distinct(spins: Spins) -> Spins:
    """The points that are unlike in their periods or their poles at all."""
    return rows_of(spins, _chosen(spins, len(spins.numbers), _SAME_POLE))


def best(spins: Spins, count: int) -> Spins:
    """The best points, unlike in their periods or their poles."""
    return rows_of(spins, _chosen(spins, count, _APART_IN_POLE))


def _chosen(spins: Spins, count: int, apart: float) -> Int[np.ndarray, " chosen"]:
    """Indices of the best points that are unlike in their periods or their poles.

    Args:
        spins: The points; those of no chi-square are left out.
        count: How many to choose.
        apart: Distance from which poles are apart.
    """
    finite = np.flatnonzero(np.isfinite(spins.quadratic.chi_square))
    turns = spins.numbers[finite, 0]
    # In this scale one threshold serves the turns and the poles.
    poles = spins.poles()[finite] * _APART / apart
    places = np.column_stack([turns, poles])
    merits = -spins.quadratic.chi_square[finite]
    most = int(np.ceil(_SHARE * count))
    return finite[shared_places(places, turns, merits, _APART, count, most)]


def minimise(
    numbers: Float[np.ndarray, "many numbers"],
    frames: Float[np.ndarray, "many 3 3"],
    surface: Surface,
    readings: Readings,
    steps: int,
    lanes: int,
) -> Spins:
    """The points after so many steps, so many lanes at a time."""

    def of_batch(numbers: np.ndarray, frames: np.ndarray) -> Spins:
        result = minimised(spin_quadratic, numbers, frames, (surface, readings), steps)
        return Spins(result[0], frames, result[1])

    return in_batches(lanes, of_batch, numbers, frames)
