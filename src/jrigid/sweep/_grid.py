"""Points in blocks of one shape, and the evaluation of a function on a block."""

import dataclasses
import re
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, PyTree

from jrigid._checks import all_finite, demand, float_arrays, kind_of
from jrigid._core.third_party import EnumerationItem, code_of, enumeration_of, names_of


class Grid(NamedTuple):
    """The points that some axes span, or a list of points, in blocks of one shape.

    Attributes:
        points: A dict of axes, or any tree with the points in front; numpy arrays.
        names: Of the axes; None for a list.
        shape: How many points there are along each axis.
        block: How many points of each axis a block has.
    """

    points: PyTree
    names: tuple[str, ...] | None
    shape: tuple[int, ...]
    block: tuple[int, ...]

    @property
    def axes(self) -> dict[str, np.ndarray]:
        """Coordinates along each axis; for a list `point`, numbers from 0."""
        if self.names is None:
            return {"point": np.arange(self.shape[0])}
        return self.points

    @property
    def blocks(self) -> tuple[int, ...]:
        """Number of blocks along each axis."""
        return tuple(
            -(-n // width) for n, width in zip(self.shape, self.block, strict=True)
        )

    def corner(self, number: int) -> tuple[int, ...]:
        """Indices of the first point of a block; the last axis runs fastest."""
        place = np.unravel_index(number, self.blocks)
        return tuple(int(x) * width for x, width in zip(place, self.block, strict=True))

    def region(self, number: int) -> tuple[slice, ...]:
        """Indices of the points of a block."""
        ends = zip(self.corner(number), self.shape, self.block, strict=True)
        return tuple(slice(first, min(first + width, n)) for first, n, width in ends)

    def inside(self, number: int) -> tuple[slice, ...]:
        """Indices within a block of the points that are not beyond the last ones."""
        return tuple(slice(0, x.stop - x.start) for x in self.region(number))

    def part(self, number: int) -> PyTree:
        """The points of a block.

        All blocks have one shape, for one compilation: beyond the end of an axis its
        last point is repeated.
        """

        def indices(places: slice, width: int) -> np.ndarray:
            whole = np.arange(places.start, places.start + width)
            return np.minimum(whole, places.stop - 1)

        picked = list(map(indices, self.region(number), self.block))
        if self.names is None:
            return jtu.tree_map(lambda x: x[picked[0]], self.points)
        axes = self.points.values()
        return tuple(x[places] for x, places in zip(axes, picked, strict=True))

    def tiled(self, size: int) -> "Grid":
        """The same points in tiles, blocks of about that size of equal sides."""
        side = max(round(size ** (1 / len(self.shape))), 2)
        return self._replace(block=tuple(min(side, n) for n in self.shape))

    def is_tile(self, block: tuple[int, ...]) -> bool:
        """Whether the sides of a block are equal, or as long as a shorter axis."""
        side = max(block)
        pairs = zip(block, self.shape, strict=True)
        return all(width == min(side, n) for width, n in pairs)

    def cut(self, size: int) -> "Grid":
        """The same points in blocks of about that size, cut along the first axes."""
        block: list[int] = []
        for n in reversed(self.shape):
            # With equal pieces few points are repeated to fill the last block.
            pieces = -(-n // max(min(size, n), 1))
            block.insert(0, -(-n // pieces))
            size //= block[0]
        return self._replace(block=tuple(block))


def grid_of(axes: Mapping[str, ArrayLike] | None, points: PyTree) -> Grid:
    """Check types and shapes of axes or points, and make them one block."""
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
        demand(x.size > 0, f"Argument `axes` must hold points, but {name!r} is empty.")
        if x.ndim != 1 or x.dtype.kind not in "iuf":
            raise ValueError(
                "Argument `axes` must hold arrays of numbers of shape (n,), but "
                f"{name!r} has shape {x.shape} and type {x.dtype}."
            )
    if not arrays:
        raise ValueError(
            "Argument `axes` must name at least one axis, but it is empty."
        )
    shape = tuple(x.size for x in arrays.values())
    # All axes get one dtype, as the arguments of other functions.
    numbers = map(np.asarray, float_arrays(*arrays.values()))
    values = dict(zip(arrays, numbers, strict=True))
    for name, x in arrays.items():
        demand(
            x.dtype.kind == "f" or np.array_equal(x, values[name].astype(x.dtype)),
            f"Argument `axes` must hold floating point numbers, but the integers of "
            f"{name!r} are none: pass them by `points`.",
        )
    return Grid(values, tuple(arrays), shape, shape)


def _native(values: ArrayLike) -> np.ndarray:
    """Return numbers in the byte order of this machine, the only one that JAX takes."""
    array = np.asarray(values)
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _numbers_of(leaf: Any) -> jax.Array:
    """Convert an array of a tree of points, or raise ValueError if it is none."""
    if isinstance(leaf, jax.Array):
        return leaf
    array = _native(np.asarray(leaf))
    if not any(jnp.issubdtype(array.dtype, kind) for kind in (jnp.number, jnp.bool_)):
        raise ValueError(
            "Argument `points` must hold arrays of numbers, but it holds "
            f"{kind_of(leaf)}. (Pass a dict of arrays, or register a class by "
            "`jax.tree_util.register_dataclass`.)"
        )
    return jnp.asarray(array)


def _list_of(points: PyTree) -> Grid:
    """Check a tree of arrays with the points in front."""
    leaves = [_numbers_of(x) for x in jtu.tree_leaves(points)]
    if any(jnp.issubdtype(x.dtype, jax.dtypes.extended) for x in leaves):
        raise ValueError(
            "Argument `points` must hold numbers, but it has keys. (Pass integers, "
            "and call `jax.random.key` in the function.)"
        )
    lengths = {x.shape[:1] for x in leaves}
    # A single number has no axis of points.
    if len(lengths) != 1 or () in lengths:
        raise ValueError(
            "Argument `points` must hold arrays with the same number of points in "
            f"front, but they have the shapes {[x.shape for x in leaves]}."
        )
    (shape,) = lengths
    demand(shape != (0,), "Argument `points` must hold a point, but it is empty.")
    arrays = jtu.tree_unflatten(jtu.tree_structure(points), map(np.asarray, leaves))
    return Grid(arrays, None, shape, shape)


def _is_code(value: object) -> bool:
    return isinstance(value, EnumerationItem)


def _defined(values: PyTree) -> Bool[Array, ""]:
    """Whether all numbers are finite and no code is `undefined`."""
    leaves = jtu.tree_leaves(values, is_leaf=_is_code)
    codes = [x for x in leaves if _is_code(x)]
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
    function: Callable[..., Any], names: tuple[str, ...] | None, part: PyTree
) -> tuple[PyTree, Array]:
    """Evaluate a function at the points of a block.

    Args:
        function: Of a point, or of a number for each axis.
        names: Of the axes, None for a list.
        part: The points of the block, or its piece of each axis.

    Returns:
        Values, with the axes of the block in front, and where they are defined.
    """
    if names is None:
        points = part
        shape = jtu.tree_leaves(part)[0].shape[:1]
    else:
        # The last axis runs fastest, as in `Grid.corner`.
        spread = jnp.meshgrid(*part, indexing="ij")
        points = {name: x.reshape(-1) for name, x in zip(names, spread, strict=True)}
        shape = tuple(x.size for x in part)

    def evaluate(point: PyTree) -> tuple[PyTree, Array]:
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


def flags_of(codes: tuple[str, ...]) -> dict[str, Any]:
    """Attributes that explain codes, by the conventions CF-1.11; none of no codes."""
    if not codes:
        return {}
    return {
        "flag_values": list(range(len(codes))),
        "flag_meanings": " ".join(codes),
    }


class Leaf(eqx.Module):
    """Description of one array of the tree that a function returns.

    Attributes:
        name: The path in the tree, joined by underscores; `value` if the tree is the
            array itself.
        shape: Without the axes of the grid.
        dtype: Its numpy dtype.
        fill: Value of points that are not known: NaN; for codes `undefined`, for
            integers the least one, for unsigned ones the largest.
        codes: Names of the codes in their order, if it holds codes.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    fill: Any
    codes: tuple[str, ...]

    @property
    def flags(self) -> dict[str, Any]:
        """Attributes that explain its numbers, by the conventions CF-1.11."""
        if self.codes:
            return flags_of(self.codes)
        # xarray shows NaN in place of this value.
        return {"_FillValue": int(self.fill)} if self.dtype.kind in "iu" else {}

    def dimensions(self, axes: tuple[str, ...]) -> tuple[str, ...]:
        """Names of the dimensions: the axes, then its own."""
        return (*axes, *(f"{self.name}_{k}" for k in range(len(self.shape))))


VALID = Leaf("valid", (), np.dtype(bool), False, ())


def leaves_of(values: PyTree, axes: Collection[str]) -> list[Leaf]:
    """Describe the arrays that a function returned on axes, and `valid` as the last.

    No array or dimension has the name of an axis or of another one.
    """
    leaves: list[Leaf] = []
    names = {*axes, VALID.name}
    paths, _ = jtu.tree_flatten_with_path(values, is_leaf=_is_code)
    for path, value in paths:
        leaf = _leaf(jtu.keystr(path, simple=True, separator="_"), value, len(axes))
        while names & {leaf.name, *leaf.dimensions(())}:
            leaf = dataclasses.replace(leaf, name=leaf.name + "_")
        names |= {leaf.name, *leaf.dimensions(())}
        leaves.append(leaf)
    return [*leaves, VALID]


def _leaf(path: str, value: Any, axes: int) -> Leaf:
    """Describe one array or code, of which the first axes are those of the grid."""
    codes: tuple[str, ...] = ()
    if _is_code(value):
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
    name = re.sub(r"\W", "_", path) or "value"
    return Leaf(name, value.shape[axes:], dtype, fill, codes)
