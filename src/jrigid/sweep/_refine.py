"""Which blocks of a map hold a boundary between two classes."""

import itertools
import math
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.tree_util as jtu
import numpy as np

from jrigid.sweep._grid import Grid
from jrigid.sweep._result import Failure


def corners_of(grid: Grid) -> dict[str, np.ndarray]:
    """Axes of the first points of all blocks, and of the last points of all."""
    lattice = {}
    for (name, x), width in zip(grid.axes.items(), grid.block, strict=True):
        lattice[name] = x[np.minimum(np.arange(0, x.size + width, width), x.size - 1)]
    return lattice


class Tiles:
    """Classes of all points: computed where one changes, elsewhere that of a block's corners."""

    def __init__(self, grid: Grid, kept: Any, structure: Any, classify: Callable[[Any], Any]):
        """Of the blocks that are kept."""
        self.grid, self.kept, self.structure, self.classify = grid, kept, structure, classify

    def _classes(self, values: Any, shape: tuple[int, ...]) -> np.ndarray:
        """Classes of values with axes of this shape in front."""
        flat = jtu.tree_map(lambda x: x.reshape(-1, *x.shape[len(shape) :]), values)
        found = jtu.tree_leaves(jax.vmap(self.classify)(flat))
        if len(found) != 1 or found[0].ndim != 1 or found[0].dtype.kind not in "iub":
            raise ValueError(
                "Argument `refine` must return one integer, boolean or code for a point, but it "
                f"returns {[(x.shape[1:], str(x.dtype)) for x in found]}."
            )
        return np.asarray(found[0]).reshape(shape)

    def refined(
        self, corners: Any, compute: Callable[[Iterable[int]], tuple[Failure, ...]]
    ) -> tuple[tuple[Failure, ...], np.ndarray]:
        """Compute all blocks that hold a change of class; which failed, and all classes."""
        grid = self.grid
        for number in range(math.prod(grid.blocks)):
            self.kept.leave(number)
        lattice = self._classes(corners, tuple(n + 1 for n in grid.blocks))
        place = [np.arange(n) // width for n, width in zip(grid.shape, grid.block, strict=True)]
        self.classes = lattice[np.ix_(*place)]
        within = [(slice(0, -1), slice(1, None))] * lattice.ndim
        ends = np.stack([lattice[x] for x in itertools.product(*within)])
        changes = np.any(ends != ends[0], axis=0)
        numbers = np.arange(changes.size).reshape(changes.shape)
        todo, seen, failures = set(numbers[changes].tolist()), set(), ()
        while todo:
            failures += compute(sorted(todo))
            for number in todo:
                self._look_at(number)
            seen |= todo
            beside = {int(x) for number in todo for x in self._around(number, numbers)}
            todo = {number for number in beside - seen if self._is_entered(number)}
        return failures, self.classes

    def _look_at(self, number: int) -> None:
        """Classes of a block that has been computed."""
        region = self.grid.region(number)
        *arrays, valid = (x[region] for x in self.kept.arrays.values())
        if valid.any():
            values = jtu.tree_unflatten(self.structure, arrays)
            self.classes[region] = self._classes(values, valid.shape)

    def _around(self, number: int, numbers: np.ndarray) -> np.ndarray:
        """The blocks that touch a block."""
        place = np.unravel_index(number, self.grid.blocks)
        return numbers[tuple(slice(max(x - 1, 0), x + 2) for x in place)].ravel()

    def _is_entered(self, number: int) -> bool:
        """Whether a change of class comes in from beside a block."""
        region = self.grid.region(number)
        wider = tuple(slice(max(x.start - 1, 0), x.stop + 1) for x in region)
        return bool(np.any(self.classes[wider] != self.classes[region].flat[0]))
