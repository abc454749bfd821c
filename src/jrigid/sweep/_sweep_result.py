"""The result of a sweep."""

from typing import Any, NamedTuple

import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from jrigid._extra import extra
from jrigid.sweep._grid import flags_of, leaves_of


class Failure(NamedTuple):
    """A block that could not be computed.

    Attributes:
        first: Indices of its first point.
        last: Indices of its last point.
        error: Type and text of the error of the last of three trials.
    """

    first: tuple[int, ...]
    last: tuple[int, ...]
    error: str


class SweepResult(NamedTuple):
    """Values of a function at many points.

    Attributes:
        values: The tree that the function returns, with the axes of the grid in front.
            Its arrays are those of numpy, or with a store those of zarr, which are read
            when they are indexed.
        valid: Where all numbers are finite and no code is `undefined`: a numpy array of
            the shape of the grid.
        axes: Names and points of the axes, in their order; for a list `point`, its
            numbers.
        failures: The blocks that failed three times. Their points are not valid.
        attributes: Attributes of axes and values (units, names), by their names.
        store: The directory of the store, if there is one.
        classes: The class of every point of a refined map, also of points that were not
            evaluated.
        class_names: Names of the classes in the order of their numbers, if they are
            codes.
    """

    values: PyTree
    valid: np.ndarray
    axes: dict[str, np.ndarray]
    failures: tuple[Failure, ...] = ()
    # A named tuple has no factories of defaults, and nothing writes to this one.
    attributes: dict[str, dict[str, Any]] = {}  # noqa: RUF012
    store: str | None = None
    classes: np.ndarray | None = None
    class_names: tuple[str, ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(self.axes)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """The edges of a map over two axes, half a step beyond its points.

        Made for `imshow(values.T, origin="lower", extent=...)` of matplotlib.

        Raises:
            ValueError: The map is over more or fewer axes.
        """
        if len(self.axes) != 2:
            raise ValueError(
                f"Property `extent` is for two axes, but there are {len(self.axes)}."
            )
        ends: list[float] = []
        for x in self.axes.values():
            half = 0.5 * (x[-1] - x[0]) / max(x.size - 1, 1)
            ends += [float(x[0] - half), float(x[-1] + half)]
        return ends[0], ends[1], ends[2], ends[3]

    def to_xarray(self) -> Any:
        """Convert to an `xarray.Dataset` with named dimensions and coordinates.

        It has a variable for each array, and `valid`. With a store it is lazy.
        Integers are floats, NaN where they are not known; codes stay integers.

        Raises:
            ImportError: Without the extra `jrigid[sweep]`.
        """
        xarray = extra("sweep", "xarray")
        if self.store is not None:
            # Older versions of xarray take a unit of time for that of a timedelta64.
            dataset = xarray.open_zarr(self.store, decode_timedelta=False)
        else:
            dataset = self._dataset(xarray)
        if self.classes is not None:
            flags = flags_of(self.class_names)
            dataset["classes"] = self.labels, self.classes, flags
        return dataset

    def _dataset(self, xarray: Any) -> Any:
        """The data set of arrays in memory, as `open_zarr` would give it."""
        attributes = self.attributes
        axes = {name: (name, x, attributes.get(name)) for name, x in self.axes.items()}
        dataset = xarray.Dataset(coords=axes)
        arrays = [*jtu.tree_leaves(self.values), self.valid]
        leaves = leaves_of(self.values, self.labels)
        for leaf, array in zip(leaves, arrays, strict=True):
            about = leaf.flags | attributes.get(leaf.name, {})
            dataset[leaf.name] = leaf.dimensions(self.labels), array, about
        # Integers that are not known become NaN.
        return xarray.decode_cf(dataset, decode_timedelta=False)
