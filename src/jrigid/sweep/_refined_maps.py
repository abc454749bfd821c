"""Refined maps: which tiles hold a boundary between two classes."""

import itertools
import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from jrigid._checks import traced_by_jax
from jrigid._core.third_party import EnumerationItem, enumeration_of, names_of
from jrigid.sweep._grid import Grid
from jrigid.sweep._store import Memory, Store
from jrigid.sweep._sweep_result import Failure, SweepResult


def corners_of(grid: Grid) -> dict[str, np.ndarray]:
    """Axes through the first points of all tiles and the last points of the grid."""
    lattice = {}
    for (name, x), width in zip(grid.axes.items(), grid.block, strict=True):
        # Neighbouring tiles share their corners.
        lattice[name] = x[np.minimum(np.arange(0, x.size + width, width), x.size - 1)]
    return lattice


class Classes(NamedTuple):
    """Classes of points.

    Attributes:
        numbers: The class of each point; None of a map that is not refined.
        names: Of the classes, in the order of their numbers, if they are codes.
    """

    numbers: np.ndarray | None = None
    names: tuple[str, ...] = ()


def _classes(
    classify: Callable[[PyTree], Any], values: PyTree, shape: tuple[int, ...]
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return classes of values that have axes of this shape in front, and names."""
    flat = jtu.tree_map(lambda x: x.reshape(-1, *x.shape[len(shape) :]), values)
    with traced_by_jax("`refine`"):
        classes = classify(flat)
    leaves = jtu.tree_leaves(classes)
    if len(leaves) != 1 or leaves[0].ndim != 1 or leaves[0].dtype.kind not in "iub":
        raise ValueError(
            "Argument `refine` must return one integer, boolean or code for a point, "
            f"but it returns {[(x.shape[1:], str(x.dtype)) for x in leaves]}."
        )
    is_code = isinstance(classes, EnumerationItem)
    names = names_of(enumeration_of(classes)) if is_code else ()
    return np.asarray(leaves[0]).reshape(shape), names


def _changes(corners: SweepResult, lattice: np.ndarray) -> np.ndarray:
    """Say which tiles have corners of several classes, or of an unknown class."""
    failed = np.zeros(lattice.shape, bool)
    for failure in corners.failures:
        ends = zip(failure.first, failure.last, strict=True)
        failed[tuple(slice(first, last + 1) for first, last in ends)] = True
    # Along each axis a tile lies between two neighbouring points of the lattice.
    sides = (slice(0, -1), slice(1, None))
    of_tile = [*itertools.product(*[sides] * lattice.ndim)]
    ends = np.stack([lattice[x] for x in of_tile])
    differ = np.any(ends != ends[0], axis=0)
    return differ | np.any([failed[x] for x in of_tile], axis=0)


class RefinedMap:
    """The classes of all points, refined tile by tile.

    Attributes:
        classes: Class of every point. In a tile that was not computed, or failed, it is
            that of the first corner.
        names: Of the classes, if they are codes.
    """

    def __init__(
        self,
        grid: Grid,
        kept: Memory | Store,
        structure: Any,
        classify: Callable[[PyTree], Any],
        corners: SweepResult,
    ):
        """Give all points the class of the first corner of their tile.

        Args:
            grid: The points, in tiles.
            kept: Where finished tiles are kept.
            structure: Of the values of the function.
            classify: The class of the values of one point.
            corners: Values at the corners of all tiles.
        """
        self._grid = grid
        self._kept = kept
        self._structure = structure
        self._classify = jax.jit(jax.vmap(classify))
        lattice_shape = tuple(n + 1 for n in grid.blocks)
        lattice, names = _classes(self._classify, corners.values, lattice_shape)
        self.names = names
        tile = [
            np.arange(n) // width
            for n, width in zip(grid.shape, grid.block, strict=True)
        ]
        self.classes = lattice[np.ix_(*tile)]
        self._numbers = np.arange(math.prod(grid.blocks)).reshape(grid.blocks)
        self._with_change = self._numbers[_changes(corners, lattice)].tolist()

    def refine(
        self, compute: Callable[[Iterable[int]], tuple[Failure, ...]]
    ) -> tuple[Failure, ...]:
        """Compute all tiles with a change of class, and return those that failed."""
        all_tiles = range(self._numbers.size)
        # Finished tiles of a store show their classes without a computation.
        finished = filter(self._kept.has, all_tiles)
        waiting = {*self._with_change, *finished}
        # Arrays in memory are not initialised, and some tiles are never computed.
        for number in all_tiles:
            self._kept.leave(number)
        computed: set[int] = set()
        failures: tuple[Failure, ...] = ()
        while waiting:
            new = compute(sorted(waiting))
            failures += new
            failed = {x.first for x in new}
            for number in waiting:
                if self._grid.corner(number) not in failed:
                    self._classify_tile(number)
            computed |= waiting
            # A boundary that leaves a tile shows at its edge, so that the next tile is
            # computed.
            beside = self._neighbours(waiting) - computed
            waiting = set(filter(self._is_entered, beside))
        return failures

    def _classify_tile(self, number: int) -> None:
        """Replace the classes of a tile by those of its own values."""
        region = self._grid.region(number)
        *arrays, valid = (x[region] for x in self._kept.arrays.values())
        values = jtu.tree_unflatten(self._structure, arrays)
        self.classes[region], _ = _classes(self._classify, values, valid.shape)

    def _neighbours(self, tiles: Iterable[int]) -> set[int]:
        """Return the tiles that share a face, an edge or a corner with one of these."""
        beside: set[int] = set()
        places = np.unravel_index(sorted(tiles), self._grid.blocks)
        for place in zip(*places, strict=True):
            around = tuple(slice(max(x - 1, 0), x + 2) for x in place)
            beside.update(self._numbers[around].ravel().tolist())
        return beside

    def _is_entered(self, number: int) -> bool:
        """Say whether a point beside a tile has another class than its first corner."""
        region = self._grid.region(number)
        wider = tuple(slice(max(x.start - 1, 0), x.stop + 1) for x in region)
        # A tile that was not computed has one class, that of its first corner.
        return bool(np.any(self.classes[wider] != self.classes[region].flat[0]))
