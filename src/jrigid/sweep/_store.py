"""A directory that keeps what is done: a zarr array for each value, a chunk for each block."""

import contextlib
import hashlib
import json
import os
import re
import shutil
import uuid
import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.extend.core as jex
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from jrigid.sweep._grid import VALID, Grid, Leaf
from jrigid.sweep._result import extra

try:
    import fcntl
except ModuleNotFoundError:  # on Windows
    fcntl = None

_WITHOUT = re.compile(r"0x[0-9a-f]+")  # addresses differ from run to run
_KEY = "jrigid"
_CONVENTIONS = {"Conventions": "CF-1.11"}
_KEPT = {"write_empty_chunks": True}  # a block that is all NaN is one that is done


def _constants(jaxpr: Any) -> Iterator[Any]:
    """Arrays that a traced function holds, also in what it calls."""
    if isinstance(jaxpr, jex.ClosedJaxpr):
        yield from jaxpr.consts
        jaxpr = jaxpr.jaxpr
    for eqn in jaxpr.eqns:
        yield from (x.val for x in eqn.invars if isinstance(x, jex.Literal))
        for value in jtu.tree_leaves(list(eqn.params.values()), is_leaf=_is_jaxpr):
            if _is_jaxpr(value):
                yield from _constants(value)


def _is_jaxpr(value: Any) -> bool:
    return isinstance(value, jex.ClosedJaxpr | jex.Jaxpr)


def _digest(*values: Any) -> str:
    digest = hashlib.sha256()
    for value in values:
        if eqx.is_array(value) and jnp.issubdtype(value.dtype, jax.dtypes.extended):
            value = jax.random.key_data(value)
        if not isinstance(value, str):
            value = np.asarray(value)
            digest.update(f"{value.dtype} {value.shape} ".encode())
        digest.update(value.encode() if isinstance(value, str) else value.tobytes())
    return digest.hexdigest()[:32]


def identity(function: Any, grid: Grid, jaxpr: Any) -> dict[str, Any]:
    """What must be the same for a sweep to go on: the traced function, points, blocks, versions.

    The function is told by its jaxpr, with all that it calls and the constants in it; neither its
    name nor the file it stands in matter.
    """
    text = _WITHOUT.sub("", str(jaxpr))
    arrays = jtu.tree_leaves(eqx.filter(function, eqx.is_array))
    packages = ("jax", "jaxlib", "jrigid")
    return {
        "function": _digest(text, *_constants(jaxpr), *arrays),
        "points": {
            name: _digest(*jtu.tree_leaves(x))
            for name, x in (("point", grid.points),) * grid.listed or grid.points.items()
        },
        "shape": list(grid.shape),
        "block": list(grid.block),
        "versions": {name: version(name) for name in packages},
    }


def _told(path: Path) -> dict[str, Any]:
    """What a directory says that it was made for."""
    try:
        return json.loads((path / "zarr.json").read_text())["attributes"][_KEY]
    except (KeyError, TypeError, ValueError, OSError) as error:
        raise ValueError(
            "Argument `store` must be a new directory or one that a sweep has written, but "
            f"{path} is not. (Choose another, or remove it.)"
        ) from error


def known_block(path: Path) -> tuple[int, ...] | None:
    """The block of a store that is there already."""
    return tuple(_told(path)["block"]) if path.exists() else None


class Memory:
    """Arrays that are filled block by block, as a `Store`."""

    def __init__(self, grid: Grid, leaves: list[Leaf]):
        """Nothing is touched before it is written."""
        self.grid, self.fills = grid, [x.fill for x in leaves]
        self.arrays = {x.name: np.empty((*grid.shape, *x.shape), x.dtype) for x in leaves}

    @contextlib.contextmanager
    def opened(self, *_: Any) -> Iterator[None]:
        """It is no one else's."""
        yield

    def count(self, _: int) -> None:
        """No block is there yet."""

    def write(self, number: int, values: list[np.ndarray]) -> None:
        """Keep a block."""
        region = self.grid.region(number)
        for array, value in zip(self.arrays.values(), values, strict=True):
            array[region] = value

    def leave(self, number: int) -> None:
        """Nothing will be known of a block."""
        region = self.grid.region(number)
        for array, fill in zip(self.arrays.values(), self.fills, strict=True):
            array[region] = fill

    def tell(self, _: Any) -> None:
        """The result says which blocks failed."""


class Store:
    """The arrays in a directory, in blocks.

    `valid` is written last: where a block of it is, the block is done.
    """

    def __init__(self, path: Path, grid: Grid, leaves: list[Leaf]):
        """Nothing is opened before it is used."""
        self.path, self.grid, self.leaves = path, grid, leaves
        self._arrays: dict[str, Any] = {}

    @property
    def arrays(self) -> dict[str, Any]:
        """The zarr arrays of the leaves, in their order."""
        if not self._arrays:
            group = extra("zarr").open_group(self.path, mode="r+", use_consolidated=False)
            self._arrays = {x.name: group[x.name].with_config(_KEPT) for x in self.leaves}
        return self._arrays

    def _create(self, about: dict[str, Any], attributes: dict[str, dict]) -> None:
        """Write what describes the arrays; all of it appears at once."""
        zarr, grid = extra("zarr"), self.grid
        partial = self.path.with_name(f".{self.path.name}.{uuid.uuid4().hex}")
        parts: list[Any] = [
            (x, n.shape, n.shape, n.dtype, 0, [x], {}) for x, n in grid.axes.items()
        ]
        for x in self.leaves:
            shape, block = (*grid.shape, *x.shape), (*grid.block, *x.shape)
            parts.append((x.name, shape, block, x.dtype, x.fill, x.dimensions(grid.names), x.flags))
        try:
            group = zarr.create_group(partial, attributes=_CONVENTIONS | {_KEY: about})
            for name, shape, block, dtype, fill, dimensions, flags in parts:
                group.create_array(
                    name, shape=shape, chunks=block, dtype=dtype, fill_value=fill,
                    dimension_names=dimensions, attributes=flags | attributes.get(name, {}),
                    compressors=[extra("zarr.codecs").Crc32cCodec()],
                )  # fmt: skip
            for name, x in grid.axes.items():
                group[name].with_config(_KEPT)[...] = x
            with warnings.catch_warnings():
                # So that xarray opens it in one look; the format's next version will have it.
                warnings.simplefilter("ignore")
                zarr.consolidate_metadata(partial)
            os.rename(partial, self.path)
        except OSError as error:
            raise OSError(f"The store {self.path} cannot be written: {error}.") from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)

    def _chunk(self, leaf: Leaf, number: int) -> Path:
        place = [*np.unravel_index(number, self.grid.blocks), *(0 for _ in leaf.shape)]
        return self.path.joinpath(leaf.name, "c", *map(str, place))

    def count(self, number: int) -> int | None:
        """How many valid points a block has; None where one of its chunks is lost or spoilt."""
        done = self._chunk(VALID, number)
        if not done.exists():
            return None
        try:
            for leaf in self.leaves:
                self._chunk(leaf, number).stat()  # zarr takes a chunk that is lost for one of NaN
                found = self.arrays[leaf.name][self.grid.region(number)]
        except (FileNotFoundError, ValueError, RuntimeError):
            done.unlink(missing_ok=True)
            return None
        return int(np.sum(found))

    def write(self, number: int, values: list[np.ndarray]) -> None:
        """Keep a block, its mask last."""
        region = self.grid.region(number)
        for array, value in zip(self.arrays.values(), values, strict=True):
            array[region] = value

    @contextlib.contextmanager
    def opened(
        self, identity: Callable[[], dict[str, Any]], attributes: dict[str, dict]
    ) -> Iterator[None]:
        """New or gone on with, if it is of the same sweep."""
        about = identity()
        if not self.path.exists():
            self._create(about, attributes)
        known = _told(self.path)
        with self._locked():
            differences = [
                f"{key} ({known.get(key)} there, {value} here)"
                for key, value in about.items()
                if known.get(key) != value
            ]
            if differences:
                raise ValueError(
                    f"Argument `store` must be new or that of the same sweep, but {self.path} is "
                    f"of another: {'; '.join(differences)}. (Choose another directory, or remove "
                    "it.)"
                )
            yield

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """No other process may write; what one left half-written is removed."""
        directory = os.open(self.path, os.O_RDONLY)
        try:
            try:
                if fcntl is not None:
                    fcntl.flock(directory, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                text = f"Another process is writing to the store {self.path}."
                raise RuntimeError(text) from error
            for partial in self.path.glob("**/*.partial"):
                partial.unlink(missing_ok=True)
            yield
        finally:
            os.close(directory)

    def leave(self, _: int) -> None:
        """Where no chunk is nothing is known."""

    def tell(self, failures: Any) -> None:
        """Say in the attributes which blocks failed."""
        place = self.path / "zarr.json"
        known = json.loads(place.read_text())
        said = [x._asdict() for x in failures]
        if known["attributes"][_KEY].setdefault("failures", []) != said:
            known["attributes"][_KEY]["failures"] = said
            new = place.with_suffix(".partial")
            new.write_text(json.dumps(known))
            new.replace(place)
