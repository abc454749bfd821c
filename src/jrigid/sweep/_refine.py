"""Which blocks of a map hold a boundary between two classes."""

import itertools
import math
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.tree_util as jtu
import numpy as np

from jrigid.sweep._grid import Grid
from jrigid.sweep._result import Failure, SweepResult


def corners_of(grid: Grid) -> dict[str, np.ndarray]:
    """Axes of the first points of all blocks, and of the last points of all."""
    lattice = {}
    for (name, x), width in zip(grid.axes.items(), grid.block, strict=True):
        lattice[name] = x[np.minimum(np.arange(0, x.size + width, width), x.size - 1)]
    return lattice


def _classes(
    classify: Callable[[Any], Any], values: Any, shape: tuple[int, ...]
) -> np.ndarray:
    """Classes of values with axes of this shape in front."""
    flat = jtu.tree_map(lambda x: x.reshape(-1, *x.shape[len(shape) :]), values)
    found = jtu.tree_leaves(classify(flat))
    if len(found) != 1 or found[0].ndim != 1 or found[0].dtype.kind not in "iub":
        raise ValueError(
            "Argument `refine` must return one integer, boolean or code for a point, but it "
            f"returns {[(x.shape[1:], str(x.dtype)) for x in found]}."
        )
    return np.asarray(found[0]).reshape(shape)


def _changes(corners: SweepResult, lattice: np.ndarray) -> np.ndarray:
    """Which blocks have corners of several classes, or one whose class is not known."""
    lost = np.zeros(lattice.shape, bool)
    for failure in corners.failures:
        ends = zip(failure.first, failure.last, strict=True)
        lost[tuple(slice(first, last + 1) for first, last in ends)] = True
    within = [*itertools.product(*[(slice(0, -1), slice(1, None))] * lattice.ndim)]
    ends = np.stack([lattice[x] for x in within])
    return np.any(ends != ends[0], axis=0) | np.any([lost[x] for x in within], axis=0)


def refined(
    grid: Grid,
    kept: Any,
    structure: Any,
    classify: Callable[[Any], Any],
    corners: SweepResult,
    compute: Callable[[Iterable[int]], tuple[Failure, ...]],
) -> tuple[tuple[Failure, ...], np.ndarray]:
    """Compute all blocks that hold a change of class.

    Returns:
        The blocks that failed; classes of all points, in blocks that were not computed,
        or failed, that of the first corner.
    """
    classify = jax.jit(jax.vmap(classify))
    lattice = _classes(classify, corners.values, tuple(n + 1 for n in grid.blocks))
    place = [
        np.arange(n) // width for n, width in zip(grid.shape, grid.block, strict=True)
    ]
    classes = lattice[np.ix_(*place)]
    numbers = np.arange(math.prod(grid.blocks)).reshape(grid.blocks)
    todo = {
        *numbers[_changes(corners, lattice)].tolist(),
        *filter(kept.has, range(numbers.size)),
    }
    for number in range(numbers.size):
        kept.leave(number)

    def is_entered(number: int) -> bool:
        """Whether a change of class comes in from beside a block."""
        region = grid.region(number)
        wider = tuple(slice(max(x.start - 1, 0), x.stop + 1) for x in region)
        return bool(np.any(classes[wider] != classes[region].flat[0]))

    seen, failures = set(), ()
    while todo:
        new = compute(sorted(todo))
        failures += new
        lost = {x.first for x in new}
        for number in todo:
            if grid.corner(number) not in lost:
                region = grid.region(number)
                *arrays, valid = (x[region] for x in kept.arrays.values())
                values = jtu.tree_unflatten(structure, arrays)
                classes[region] = _classes(classify, values, valid.shape)
        seen |= todo
        places = zip(*np.unravel_index(sorted(todo), grid.blocks), strict=True)
        around = [tuple(slice(max(x - 1, 0), x + 2) for x in place) for place in places]
        beside = {number for x in around for number in numbers[x].ravel().tolist()}
        todo = set(filter(is_entered, beside - seen))
    return failures, classes
