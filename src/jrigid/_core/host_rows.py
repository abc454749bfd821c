"""Rows of arrays on the host, and functions of many of them by one program."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import numpy as np

Tree = TypeVar("Tree")


def rows_of(tree: Tree, rows: Sequence[int] | np.ndarray) -> Tree:
    """Some rows of all arrays."""
    index = np.asarray(rows, int)
    return jax.tree.map(lambda x: np.asarray(x)[index], tree)


def joined(trees: Sequence[Tree]) -> Tree:
    """The rows of several trees, one tree after the other."""
    return jax.tree.map(lambda *x: np.concatenate(x), *trees)


def in_batches(size: int, function: Callable[..., Any], *arrays: Any) -> Any:
    """A function of the rows of arrays, evaluated for so many rows at a time.

    The last batch repeats its rows, so that all have one shape and one compiled program
    serves them.

    Args:
        size: Rows in a batch.
        function: Of trees with `size` rows; its results have as many.
        *arrays: Trees of arrays that all have the same number of rows.
    """
    count = len(jax.tree.leaves(arrays)[0])
    if count == 0:
        batch = jax.tree.map(lambda x: np.zeros((size, *x.shape[1:]), x.dtype), arrays)
        shapes = jax.eval_shape(function, *batch)
        return jax.tree.map(lambda x: np.zeros((0, *x.shape[1:]), x.dtype), shapes)
    results = []
    for first in range(0, count, size):
        rows = np.arange(first, min(first + size, count))
        batch = rows_of(arrays, np.resize(rows, size))
        results.append(rows_of(function(*batch), np.arange(len(rows))))
    return joined(results)
