"""A directory that keeps what is done: a zarr array for each value, a chunk for each block."""

import contextlib
import hashlib
import json
import math
import os
import re
import shutil
import uuid
import warnings
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from jrigid._core.third_party import ClosedJaxpr, Jaxpr, Literal
from jrigid._extra import extra
from jrigid.sweep._grid import VALID, Grid, Leaf

try:
    import fcntl
except ModuleNotFoundError:  # on Windows
    fcntl = None

_ADDRESS = re.compile(r"0x[0-9a-f]+")  # addresses differ from run to run
_KEY = "jrigid"
_CONVENTIONS = {"Conventions": "CF-1.11"}


def _constants(jaxpr: Any) -> Iterator[Any]:
    """Arrays that a traced function holds, also in what it calls."""
    if isinstance(jaxpr, ClosedJaxpr):
        yield from jaxpr.consts
        jaxpr = jaxpr.jaxpr
    for eqn in jaxpr.eqns:
        yield from (x.val for x in eqn.invars if isinstance(x, Literal))
        for value in jtu.tree_leaves(list(eqn.params.values()), is_leaf=_is_jaxpr):
            if _is_jaxpr(value):
                yield from _constants(value)


def _is_jaxpr(value: Any) -> bool:
    return isinstance(value, ClosedJaxpr | Jaxpr)


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


def _checksum(numbers: Any) -> bytes:
    return extra("sweep", "google_crc32c").value(numbers).to_bytes(4, "little")


def fingerprint(function: Any, jaxpr: Any) -> dict[str, Any]:
    """What a function and its surroundings compute: its jaxpr, with all that it calls and holds.

    The file it stands in does not matter.
    """
    text = _ADDRESS.sub("", str(jaxpr))
    arrays = jtu.tree_leaves(eqx.filter(function, eqx.is_array))
    return {
        "function": _digest(text, *_constants(jaxpr), *arrays),
        "versions": {name: version(name) for name in ("jax", "jaxlib", "jrigid")},
    }


def identity(grid: Grid, leaves: list[Leaf]) -> dict[str, Any]:
    """What else must be the same for a sweep to go on: points, blocks, what comes out."""
    points = {"point": grid.points} if grid.names is None else grid.points
    return {
        "points": {name: _digest(*jtu.tree_leaves(x)) for name, x in points.items()},
        "shape": list(grid.shape),
        "block": list(grid.block),
        "values": [
            [x.name, list(x.shape), str(x.dtype), list(x.codes)] for x in leaves
        ],
    }


def _told(path: Path) -> dict[str, Any]:
    """What a directory says that it was made for."""
    try:
        return json.loads((path / "zarr.json").read_text())["attributes"][_KEY]
    except (KeyError, TypeError, ValueError, OSError) as error:
        raise ValueError(
            "Argument `store` must be a new directory or one that a sweep has "
            f"written, but {path} is not. (Choose another, or remove it.)"
        ) from error


def _is_new(path: Path) -> bool:
    return not path.exists() or (path.is_dir() and not any(path.iterdir()))


def known_block(path: Path) -> tuple[int, ...] | None:
    """The block of a store that is there already."""
    return None if _is_new(path) else tuple(_told(path)["block"])


class Memory:
    """Arrays that are filled block by block, as a `Store`."""

    def __init__(self, grid: Grid, leaves: list[Leaf]):
        """Nothing is touched before it is written."""
        self.grid, self.fills = grid, [x.fill for x in leaves]
        self.arrays = {
            x.name: np.empty((*grid.shape, *x.shape), x.dtype) for x in leaves
        }

    @contextlib.contextmanager
    def opened(self, *_: Any) -> Iterator[None]:
        """It is no one else's."""
        yield

    def has(self, _: int) -> bool:
        """No block is there yet."""
        return False

    def count(self, _: int) -> None:
        """So none of its points is known to be valid."""

    def write(self, number: int, values: list[np.ndarray]) -> None:
        """Keep a block."""
        region, inside = self.grid.region(number), self.grid.inside(number)
        for array, value in zip(self.arrays.values(), values, strict=True):
            array[region] = value[inside]

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
        self._axes: dict[str, Any] = {}

    @property
    def arrays(self) -> dict[str, Any]:
        """The zarr arrays of the leaves, in their order."""
        if not self._arrays:
            try:
                group = extra("sweep", "zarr").open_group(
                    self.path, mode="r+", use_consolidated=False
                )
                self._arrays = {x.name: group[x.name] for x in self.leaves}
                self._axes = {name: group[name] for name in self.grid.axes}
            except (KeyError, ValueError) as error:
                text = (
                    f"The store {self.path} is spoilt: its description is not whole "
                    f"({error!r})."
                )
                raise OSError(text) from error
        return self._arrays

    def _create(self, about: dict[str, Any], attributes: dict[str, dict]) -> None:
        """Write what describes the arrays; all of it appears at once."""
        zarr, grid = extra("sweep", "zarr"), self.grid
        partial = self.path.with_name(f".{self.path.name}.{uuid.uuid4().hex}")
        parts: list[Any] = [
            (x, n.shape, n.shape, n.dtype, 0, [x], {}) for x, n in grid.axes.items()
        ]
        for x in self.leaves:
            shape, block = (*grid.shape, *x.shape), (*grid.block, *x.shape)
            parts.append(
                (
                    x.name,
                    shape,
                    block,
                    x.dtype,
                    x.fill,
                    x.dimensions(tuple(grid.axes)),
                    x.flags,
                )
            )
        try:
            group = zarr.create_group(partial, attributes=_CONVENTIONS | {_KEY: about})
            for name, shape, block, dtype, fill, dimensions, flags in parts:
                group.create_array(
                    name,
                    shape=shape,
                    chunks=block,
                    dtype=dtype,
                    fill_value=fill,
                    dimension_names=dimensions,
                    attributes=flags | attributes.get(name, {}),
                    compressors=[extra("sweep", "zarr.codecs").Crc32cCodec()],
                )
            with warnings.catch_warnings():
                # So that xarray opens it in one look; the format's next version will
                # have it.
                warnings.simplefilter("ignore")
                zarr.consolidate_metadata(partial)
            os.rename(partial, self.path)
        except OSError as error:
            if not (
                self.path / "zarr.json"
            ).exists():  # of another process, a moment ago
                raise OSError(
                    f"The store {self.path} cannot be written: {error}."
                ) from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)

    def _chunk(self, leaf: Leaf, number: int) -> Path:
        place = [*np.unravel_index(number, self.grid.blocks), *(0 for _ in leaf.shape)]
        return self.path.joinpath(leaf.name, "c", *map(str, place))

    def has(self, number: int) -> bool:
        """Whether a block is done."""
        return self._chunk(VALID, number).exists()

    def count(self, number: int) -> int | None:
        """How many valid points a block has; None where one of its chunks is lost or spoilt."""
        if not self.has(number):
            return None
        for leaf in self.leaves:
            numbers = self._read(leaf, number)
            if numbers is None:
                self._chunk(VALID, number).unlink(missing_ok=True)
                return None
        valid = np.frombuffer(numbers, bool).reshape(self.grid.block)  # the last leaf
        return int(np.count_nonzero(valid[self.grid.inside(number)]))

    def _read(self, leaf: Leaf, number: int) -> bytes | None:
        """The numbers of a chunk, if it is whole."""
        try:
            content = self._chunk(leaf, number).read_bytes()
        except FileNotFoundError:
            return None
        numbers, known = content[:-4], content[-4:]
        size = leaf.dtype.itemsize * math.prod((*self.grid.block, *leaf.shape))
        return numbers if len(numbers) == size and known == _checksum(numbers) else None

    def write(self, number: int, values: list[np.ndarray]) -> None:
        """Keep a block, its mask last.

        As zarr would, but without a copy: the numbers, little end first, and their
        checksum.
        """
        for leaf, value in zip(self.leaves, values, strict=True):
            numbers = (
                np.ascontiguousarray(value, leaf.dtype.newbyteorder("<"))
                .reshape(-1)
                .view(np.uint8)
            )
            chunk = self._chunk(leaf, number)
            partial = chunk.with_name(f"{chunk.name}.{uuid.uuid4().hex}.partial")
            chunk.parent.mkdir(parents=True, exist_ok=True)
            try:
                with partial.open("wb") as file:
                    file.write(numbers.data)
                    file.write(_checksum(numbers))
                partial.replace(chunk)
            except OSError:
                partial.unlink(missing_ok=True)
                raise

    @contextlib.contextmanager
    def opened(
        self, about: dict[str, Any], attributes: dict[str, dict]
    ) -> Iterator[None]:
        """New or gone on with, if it is of the same sweep."""
        if _is_new(self.path):
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
                    "Argument `store` must be new or that of the same sweep, but "
                    f"{self.path} is of another: {'; '.join(differences)}. (Choose "
                    "another directory, or remove it.)"
                )
            self._mend_axes()
            yield

    def _mend_axes(self) -> None:
        """Coordinates that are lost or spoilt are known."""
        _ = self.arrays
        for name, x in self.grid.axes.items():
            try:
                same = np.array_equal(self._axes[name][...], x)
            except ValueError:
                same = False
            if not same:
                self._axes[name][...] = x

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
            for partial in self.path.glob("**/c/**/*.partial"):
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
