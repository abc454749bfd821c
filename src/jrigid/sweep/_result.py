"""What a sweep gives back."""

from typing import Any, NamedTuple

import jax.tree_util as jtu
import numpy as np

from jrigid._extra import extra
from jrigid.sweep._grid import leaves_of


class Failure(NamedTuple):
    """A block that could not be computed.

    Attributes:
        first: Indices of its first point.
        last: Indices of its last point.
        error: What the last of three trials ended with.
    """

    first: tuple[int, ...]
    last: tuple[int, ...]
    error: str


class SweepResult(NamedTuple):
    """Values of a function at many points.

    Attributes:
        values: As the function returned them, with the axes of the grid in front: numpy
            arrays, or of a store zarr arrays, which are read where they are indexed.
        valid: Where all numbers are finite and no code is `undefined`: a mask of the
            shape of the grid, a numpy array.
        axes: Names and points of the axes, in their order; of a list `point`, its
            numbers.
        failures: The blocks that failed thrice, whose points are not valid.
        attributes: What was said about axes and values (units, names), by their names.
        store: Where it is kept, if anywhere.
        classes: Of a refined map the class of every point, also of those not evaluated.
    """

    values: Any
    valid: np.ndarray
    axes: dict[str, np.ndarray]
    failures: tuple[Failure, ...] = ()
    attributes: dict[str, dict] = {}  # noqa: RUF012
    store: str | None = None
    classes: np.ndarray | None = None

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(self.axes)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Of a map over two axes, for matplotlib's `imshow(values.T, origin="lower", extent=...)`.

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
        """An `xarray.Dataset`: a variable for each array, `valid`, named dimensions, coordinates.

        Lazy where there is a store.

        Raises:
            ImportError: Without the extra `jrigid[sweep]`.
        """
        xarray = extra("sweep", "xarray")
        if self.store is not None:
            dataset = xarray.open_zarr(self.store)
        else:
            coordinates = {
                k: (k, x, self.attributes.get(k)) for k, x in self.axes.items()
            }
            dataset = xarray.Dataset(coords=coordinates)
            arrays = [*jtu.tree_leaves(self.values), self.valid]
            for leaf, array in zip(
                leaves_of(self.values, self.labels), arrays, strict=True
            ):
                about = leaf.flags | self.attributes.get(leaf.name, {})
                dataset[leaf.name] = leaf.dimensions(self.labels), array, about
        if self.classes is not None:
            dataset["classes"] = self.labels, self.classes
        return dataset
