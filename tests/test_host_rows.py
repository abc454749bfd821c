"""Rows of arrays on the host, and functions of many of them by one program."""

import jax
import numpy as np
import pytest

from jrigid._core.host_rows import in_batches, joined, rows_of


@pytest.mark.parametrize("count", [1, 3, 4, 9])
def test_batches_give_what_the_function_gives_each_row(count):
    values = np.arange(2.0 * count).reshape(count, 2)
    scale = {"by": np.arange(1.0 * count)}
    traced = []

    @jax.jit
    def function(values, scale):
        traced.append(values.shape)
        return values.sum(axis=1) * scale["by"], values

    total, same = in_batches(4, function, values, scale)
    np.testing.assert_array_equal(total, values.sum(axis=1) * scale["by"])
    np.testing.assert_array_equal(same, values)
    assert traced == [(4, 2)]


def test_no_rows_give_no_rows_of_the_same_kind():
    def function(values):
        return values.astype(np.float32).sum(axis=1), values[:, None]

    total, same = in_batches(4, function, np.zeros((0, 3)))
    assert (total.shape, total.dtype) == ((0,), np.float32)
    assert (same.shape, same.dtype) == ((0, 1, 3), np.float64)


def test_rows_are_chosen_and_joined():
    tree = (np.arange(5), {"pairs": np.arange(10).reshape(5, 2)})
    again = joined([rows_of(tree, [3]), rows_of(tree, [])])
    np.testing.assert_array_equal(again[0], [3])
    np.testing.assert_array_equal(again[1]["pairs"], [[6, 7]])
