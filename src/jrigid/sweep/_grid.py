"""Points in blocks of one shape, and a function on a block of them."""

import dataclasses
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool

from jrigid._checks import all_finite, float_arrays
from jrigid._core.third_party import EnumerationItem, code_of, enumeration_of, names_of


class Grid(NamedTuple):
    """The points that some axes span, or a list of points, in blocks of one shape.

    Attributes:
        points: A dict of axes, or any tree with the points in front; numpy arrays.
        names: Of the axes; None of a list.
        shape: How many points along each.
        block: How many of them a block has.
    """

    points: Any
    names: tuple[str, ...] | None
    shape: tuple[int, ...]
    block: tuple[int, ...]

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """Coordinates along each axis; of a list `point`, numbers from 0."""
        return (
            {"point": np.arange(self.shape[0])} if self.names is None else self.points
        )

    @property
    def blocks(self) -> tuple[int, ...]:
        """How many blocks there are along each axis."""
        return tuple(
            -(-n // width) for n, width in zip(self.shape, self.block, strict=True)
        )

    def corner(self, number: int) -> tuple[int, ...]:
        """Where a block begins; the last axis runs fastest."""
        place = np.unravel_index(number, self.blocks)
        return tuple(int(x) * width for x, width in zip(place, self.block, strict=True))

    def region(self, number: int) -> tuple[slice, ...]:
        """Which points a block has."""
        ends = zip(self.corner(number), self.shape, self.block, strict=True)
        return tuple(slice(first, min(first + width, n)) for first, n, width in ends)

    def inside(self, number: int) -> tuple[slice, ...]:
        """Which of the points of a block are not beyond the end of an axis."""
        return tuple(slice(0, x.stop - x.start) for x in self.region(number))

    def part(self, number: int) -> Any:
        """The points of a block; beyond the end of an axis its last one again."""
        region = self.region(number)

        def cut(x: np.ndarray, places: slice, width: int) -> np.ndarray:
            return x[
                np.minimum(
                    np.arange(places.start, places.start + width), places.stop - 1
                )
            ]

        if self.names is None:
            return jtu.tree_map(lambda x: cut(x, region[0], self.block[0]), self.points)
        return tuple(map(cut, self.points.values(), region, self.block))

    def tiled(self, size: int) -> "Grid":
        """The same points in blocks of about so many that are as long along each axis."""
        side = max(round(size ** (1 / len(self.shape))), 2)
        return self._replace(block=tuple(min(side, n) for n in self.shape))

    def cut(self, size: int) -> "Grid":
        """The same points in blocks of about so many, cut along the first axes first."""
        block: list[int] = []
        for n in reversed(self.shape):
            pieces = -(-n // max(min(size, n), 1))
            block.insert(0, -(-n // pieces))
            size //= block[0]
        return self._replace(block=tuple(block))


def grid_of(axes: Mapping[str, Any] | None, points: Any) -> Grid:
    """Axes or points with types and shapes checked, in one block."""
    if (axes is None) == (points is None):
        raise ValueError("Give one of the arguments `axes` and `points`, but not both.")
    if axes is None:
        return _list_of(points)
    arrays = {name: _native(x) for name, x in axes.items()}
    for name, x in arrays.items():
        if not name.isidentifier() or name == VALID.name:
            raise ValueError(
                f"Argument `axes` must name arguments, but {name!r} can be none."
            )
        if x.ndim != 1 or x.size == 0 or x.dtype.kind not in "iuf":
            raise ValueError(
                "Argument `axes` must hold arrays of numbers of shape (n,), but "
                f"{name!r} has shape {x.shape} and type {x.dtype}."
            )
    if not arrays:
        raise ValueError(
            "Argument `axes` must name at least one axis, but it is empty."
        )
    shape = tuple(x.size for x in arrays.values())
    # One dtype, that of all axes taken together.
    values = map(np.asarray, float_arrays(*arrays.values()))
    return Grid(dict(zip(arrays, values, strict=True)), tuple(arrays), shape, shape)


def _native(values: Any) -> np.ndarray:
    """Return numbers in the byte order of this machine, the only one that JAX takes."""
    array = np.asarray(values)
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _list_of(points: Any) -> Grid:
    leaves = [
        jnp.asarray(_native(x) if isinstance(x, np.ndarray) else x)
        for x in jtu.tree_leaves(points)
    ]
    if any(jnp.issubdtype(x.dtype, jax.dtypes.extended) for x in leaves):
        raise ValueError(
            "Argument `points` must hold numbers, but it has keys. (Pass integers, "
            "and call `jax.random.key` in the function.)"
        )
    lengths = {x.shape[:1] for x in leaves}
    if len(lengths) != 1 or lengths <= {(), (0,)}:
        raise ValueError(
            "Argument `points` must hold arrays with the same number of points in "
            f"front, but they have the shapes {[x.shape for x in leaves]}."
        )
    (shape,) = lengths
    arrays = jtu.tree_unflatten(jtu.tree_structure(points), map(np.asarray, leaves))
    return Grid(arrays, None, shape, shape)


def _defined(values: Any) -> Bool[Array, ""]:
    """Whether all numbers are finite and no code is `undefined`."""
    leaves = jtu.tree_leaves(values, is_leaf=lambda x: isinstance(x, EnumerationItem))
    codes = [x for x in leaves if isinstance(x, EnumerationItem)]
    if not codes and not any(eqx.is_inexact_array(x) for x in leaves):
        raise ValueError(
            "Argument `function` must return floats, NaN where it is undefined, or "
            "codes, but it returns nothing that could say so."
        )
    defined = all_finite(leaves)
    for code in codes:
        undefined = getattr(enumeration_of(code), "undefined", None)
        defined = defined if undefined is None else defined & (code != undefined)
    return defined


def on_block(
    function: Callable[..., Any], names: tuple[str, ...] | None, part: Any
) -> tuple[Any, Array]:
    """Values at the points of a block, and where they are defined."""
    if names is None:
        points, shape = part, jtu.tree_leaves(part)[0].shape[:1]
    else:
        spread, shape = jnp.meshgrid(*part, indexing="ij"), tuple(x.size for x in part)
        points = {name: x.reshape(-1) for name, x in zip(names, spread, strict=True)}

    def evaluate(point: Any) -> tuple[Any, Array]:
        values = function(point) if names is None else function(**point)
        for leaf in jtu.tree_leaves(values):
            if not eqx.is_array_like(leaf):
                raise ValueError(
                    f"Argument `function` must return arrays, but it returns {leaf!r}."
                )
        values = jtu.tree_map(jnp.asarray, values)
        return values, _defined(values)

    found = jax.vmap(evaluate)(points)
    return jtu.tree_map(lambda x: x.reshape(*shape, *x.shape[1:]), found)


class Leaf(eqx.Module):
    """One array of what a function returns: its name, its own shape, what its numbers mean.

    Attributes:
        name: The path in the tree, joined by underscores; `value` where there is
            nothing but it.
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


def leaves_of(values: Any, axes: Iterable[str]) -> list[Leaf]:
    """The arrays of what a function returned on axes, by names that no axis has; `valid` last."""
    found: list[Leaf] = []
    names = {*axes, VALID.name}
    beyond = len(names) - 1
    paths, _ = jtu.tree_flatten_with_path(
        values, is_leaf=lambda x: isinstance(x, EnumerationItem)
    )
    for path, value in paths:
        codes: tuple[str, ...] = ()
        if isinstance(value, EnumerationItem):
            codes = names_of(enumeration_of(value))
            value = code_of(value)
        dtype = np.dtype(value.dtype)
        if codes:
            fill: Any = codes.index("undefined") if "undefined" in codes else -1
        elif jnp.issubdtype(dtype, jnp.inexact):
            fill = np.nan
        elif dtype.kind == "b":
            fill = False
        else:
            fill = np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max
        name = (
            re.sub(r"\W", "_", jtu.keystr(path, simple=True, separator="_")) or "value"
        )
        leaf = Leaf(name, value.shape[beyond:], dtype, fill, codes)
        while names & {leaf.name, *leaf.dimensions(())}:
            leaf = dataclasses.replace(leaf, name=leaf.name + "_")
        names |= {leaf.name, *leaf.dimensions(())}
        found.append(leaf)
    return [*found, VALID]
