"""Points in blocks of one shape, and a function on a block of them."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool

from jrigid._checks import RESULTS, all_finite, float_arrays

_Code = type(RESULTS.successful)  # an item of any enumeration


class Grid(eqx.Module):
    """The points that some axes span, or a list of points, in blocks of one shape.

    Attributes:
        names: Of the axes; a list has one, `point`.
        shape: How many points along each.
        block: How many of them a block has.
        points: A dict of axes, or any tree with the points in front.
        listed: Whether it is a list.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)
    block: tuple[int, ...] = eqx.field(static=True)
    points: Any
    listed: bool = eqx.field(static=True)

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """Coordinates along each axis; numbers from 0 of a list."""
        if self.listed:
            return {"point": np.arange(self.shape[0])}
        return {name: np.asarray(self.points[name]) for name in self.names}

    @property
    def blocks(self) -> tuple[int, ...]:
        """How many blocks there are along each axis."""
        return tuple(-(-n // width) for n, width in zip(self.shape, self.block, strict=True))

    def corner(self, number: int) -> tuple[int, ...]:
        """Where a block begins; the last axis runs fastest."""
        place = np.unravel_index(number, self.blocks)
        return tuple(int(x) * width for x, width in zip(place, self.block, strict=True))

    def region(self, number: int) -> tuple[slice, ...]:
        """Which points a block has."""
        ends = zip(self.corner(number), self.shape, self.block, strict=True)
        return tuple(slice(first, min(first + width, n)) for first, n, width in ends)

    def tiled(self, size: int) -> "Grid":
        """The same points in blocks of about so many that are as long along each axis."""
        side = max(round(size ** (1 / len(self.shape))), 2)
        return dataclasses.replace(self, block=tuple(min(side, n) for n in self.shape))

    def cut(self, size: int) -> "Grid":
        """The same points in blocks of about so many, cut along the first axes first."""
        block: list[int] = []
        for n in reversed(self.shape):
            pieces = -(-n // max(min(size, n), 1))
            block.insert(0, -(-n // pieces))
            size //= block[0]
        return dataclasses.replace(self, block=tuple(block))


def grid_of(axes: Mapping[str, Any] | None, points: Any) -> Grid:
    """Axes or points with types and shapes checked, in one block."""
    if (axes is None) == (points is None):
        raise ValueError("Give one of the arguments `axes` and `points`, but not both.")
    if axes is None:
        return _list_of(points)
    arrays = {name: np.asarray(x) for name, x in axes.items()}
    for name, x in arrays.items():
        if x.ndim != 1 or x.size == 0 or x.dtype.kind not in "iuf":
            raise ValueError(
                f"Argument `axes` must hold arrays of numbers of shape (n,), but {name!r} has "
                f"shape {x.shape} and type {x.dtype}."
            )
    if not arrays:
        raise ValueError("Argument `axes` must name at least one axis, but it is empty.")
    shape = tuple(x.size for x in arrays.values())
    # One dtype, that of all axes taken together.
    values = dict(zip(arrays, float_arrays(*arrays.values()), strict=True))
    return Grid(tuple(arrays), shape, shape, values, False)


def _list_of(points: Any) -> Grid:
    points = jtu.tree_map(jnp.asarray, points)
    if any(jnp.issubdtype(x.dtype, jax.dtypes.extended) for x in jtu.tree_leaves(points)):
        raise ValueError(
            "Argument `points` must hold numbers, but it has keys: make them of seeds."
        )
    lengths = {x.shape[:1] for x in jtu.tree_leaves(points)}
    if len(lengths) != 1 or lengths <= {(), (0,)}:
        raise ValueError(
            "Argument `points` must hold arrays with the same number of points in front, but they "
            f"have the shapes {[x.shape for x in jtu.tree_leaves(points)]}."
        )
    (shape,) = lengths
    return Grid(("point",), shape, shape, points, True)


def _defined(values: Any) -> Bool[Array, ""]:
    """Whether all numbers are finite and no code is `undefined`."""
    leaves = jtu.tree_leaves(values, is_leaf=lambda x: isinstance(x, _Code))
    codes = [x for x in leaves if isinstance(x, _Code)]
    if not codes and not any(eqx.is_inexact_array(x) for x in leaves):
        raise ValueError(
            "Argument `function` must return floats, NaN where it is undefined, or codes, but it "
            "returns nothing that could say so."
        )
    defined = all_finite(leaves)
    for code in codes:
        undefined = getattr(code._enumeration, "undefined", None)
        defined = defined if undefined is None else defined & (code != undefined)
    return defined


def on_block(function: Callable[..., Any], grid: Grid, corner: Any) -> tuple[Any, Array]:
    """Values at the points of a block, and where they are defined.

    Beyond the end of an axis its last point is taken again, so that all blocks are of one shape.
    """
    # Digits of the index in the block's own bases: no number beyond 32 bits is needed.
    carry = jnp.arange(math.prod(grid.block), dtype=jnp.int32)
    indices = {}
    for k in reversed(range(len(grid.block))):
        index = corner[k] + carry % grid.block[k]
        indices[grid.names[k]] = jnp.minimum(index, grid.shape[k] - 1)
        carry = carry // grid.block[k]

    def evaluate(point: Any) -> tuple[Any, Array]:
        values = function(point) if grid.listed else function(**point)
        for leaf in jtu.tree_leaves(values):
            if not eqx.is_array_like(leaf):
                raise ValueError(
                    f"Argument `function` must return arrays, but it returns {leaf!r}."
                )
        values = jtu.tree_map(jnp.asarray, values)
        return values, _defined(values)

    if grid.listed:
        points = jtu.tree_map(lambda x: x[indices["point"]], grid.points)
    else:
        points = {name: grid.points[name][indices[name]] for name in grid.names}
    found = jax.vmap(evaluate)(points)
    return jtu.tree_map(lambda x: x.reshape(*grid.block, *x.shape[1:]), found)


class Leaf(eqx.Module):
    """One array of what a function returns: its name, its own shape, what its numbers mean.

    Attributes:
        name: The path in the tree, joined by dots; `value` where there is nothing but it.
        shape: Without the axes of the grid.
        dtype: Its numpy dtype.
        fill: Where nothing is known: NaN; of codes `undefined`, of integers the least.
        codes: Names of the codes in their order, if it holds codes.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    fill: Any
    codes: tuple[str, ...]

    @property
    def flags(self) -> dict[str, Any]:
        """What its numbers mean, by the climate and forecast conventions."""
        if self.codes:
            return {
                "flag_values": list(range(len(self.codes))),
                "flag_meanings": " ".join(self.codes),
            }
        return {"_FillValue": int(self.fill)} if self.dtype.kind in "iu" else {}

    def dimensions(self, axes: tuple[str, ...]) -> tuple[str, ...]:
        """Names of the dimensions: the axes, then its own."""
        return (*axes, *(f"{self.name}_{k}" for k in range(len(self.shape))))


VALID = Leaf("valid", (), np.dtype(bool), False, ())


def leaves_of(values: Any, axes: tuple[str, ...]) -> list[Leaf]:
    """The arrays of what a function returned on axes, by names that no axis has; `valid` last."""
    found: list[Leaf] = []
    names = {*axes, VALID.name}
    paths, _ = jtu.tree_flatten_with_path(values, is_leaf=lambda x: isinstance(x, _Code))
    for path, value in paths:
        name = jtu.keystr(path, simple=True, separator=".").replace("/", ".") or "value"
        while name in names:
            name += "_"
        names.add(name)
        codes: tuple[str, ...] = ()
        if isinstance(value, _Code):
            codes = tuple(vars(value._enumeration)["_name_to_item"])
            value = value._value
        dtype = np.dtype(value.dtype)
        if codes:
            fill: Any = codes.index("undefined") if "undefined" in codes else -1
        elif jnp.issubdtype(dtype, jnp.inexact):
            fill = np.nan
        elif dtype.kind == "b":
            fill = False
        else:
            fill = np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
        found.append(Leaf(name, value.shape[len(axes) :], dtype, fill, codes))
    return [*found, VALID]
