"""A directory that keeps finished blocks: a zarr array for each value.

A chunk holds a block. Chunks are written and checked here, for two reasons. zarr 3.1.6
takes 1 ms for each, this takes 0.1 ms, and all chunks are checked when a sweep is
resumed. And whether a killed sweep can be resumed depends on how chunks are written: a
rename gives a chunk its name once it is complete, and the mask of valid points is the
last array of a block, so that a block with a mask is whole.
"""

import contextlib
import hashlib
import json
import math
import os
import re
import shutil
import uuid
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
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
from jrigid.sweep._sweep_result import Failure

try:
    import fcntl
except ModuleNotFoundError:  # on Windows
    fcntl = None

# Addresses in the text of a jaxpr, which differ from run to run.
_ADDRESS = re.compile(r"0x[0-9a-f]+")
# Attribute of the store that holds what it was made for: a JSON text, since netCDF has
# no nested attributes.
_KEY = "jrigid"
_CONVENTIONS = {"Conventions": "CF-1.11"}

#: Attributes of axes and values, by their names.
Attributes = Mapping[str, Mapping[str, Any]]


def _constants(jaxpr: ClosedJaxpr | Jaxpr) -> Iterator[Any]:
    """Arrays that a traced function and the functions it calls close over."""
    if isinstance(jaxpr, ClosedJaxpr):
        yield from jaxpr.consts
        jaxpr = jaxpr.jaxpr
    for eqn in jaxpr.eqns:
        yield from (x.val for x in eqn.invars if isinstance(x, Literal))
        for value in jtu.tree_leaves(list(eqn.params.values()), is_leaf=_is_jaxpr):
            if _is_jaxpr(value):
                yield from _constants(value)


def _is_jaxpr(value: object) -> bool:
    return isinstance(value, ClosedJaxpr | Jaxpr)


def _digest(*values: Any) -> str:
    """Hash texts and arrays."""
    digest = hashlib.sha256()
    for value in values:
        if eqx.is_array(value) and jnp.issubdtype(value.dtype, jax.dtypes.extended):
            value = jax.random.key_data(value)
        if isinstance(value, str):
            digest.update(value.encode())
        else:
            array = np.asarray(value)
            # Arrays of other shapes or types may consist of the same bytes.
            digest.update(f"{array.dtype} {array.shape} ".encode())
            digest.update(array.tobytes())
    return digest.hexdigest()[:32]


def _checksum(numbers: bytes | np.ndarray) -> bytes:
    """The bytes that zarr's codec `crc32c` appends."""
    return extra("sweep", "google_crc32c").value(numbers).to_bytes(4, "little")


def fingerprint(function: Callable[..., Any], jaxpr: ClosedJaxpr) -> dict[str, Any]:
    """Identify what a function computes: a hash of its jaxpr, and versions.

    The jaxpr includes the functions that it calls and the arrays that it closes over.
    Name and file of the function do not matter.
    """
    text = _ADDRESS.sub("", str(jaxpr))
    # The arrays of an equinox.Module are arguments of the jaxpr, not constants.
    arrays = jtu.tree_leaves(eqx.filter(function, eqx.is_array))
    return {
        "function": _digest(text, *_constants(jaxpr), *arrays),
        "versions": {name: version(name) for name in ("jax", "jaxlib", "jrigid")},
    }


def identity(grid: Grid, leaves: list[Leaf]) -> dict[str, Any]:
    """Identify points, blocks and values, which a resumed sweep must share."""
    points = {"point": grid.points} if grid.names is None else grid.points
    return {
        "points": {name: _digest(*jtu.tree_leaves(x)) for name, x in points.items()},
        "shape": list(grid.shape),
        "block": list(grid.block),
        "values": [
            [x.name, list(x.shape), str(x.dtype), list(x.codes)] for x in leaves
        ],
    }


def _identity_of(path: Path) -> dict[str, Any]:
    """Fingerprint and identity of the sweep that made a store."""
    try:
        about = json.loads((path / "zarr.json").read_text())["attributes"][_KEY]
        return json.loads(about)
    except (KeyError, TypeError, ValueError, OSError) as error:
        raise ValueError(
            "Argument `store` must be a new directory or one that a sweep has "
            f"written, but {path} is not, or its zarr.json is damaged. (Restore that "
            "file to keep what was computed. Else choose another directory.)"
        ) from error


def _consolidate(path: Path) -> None:
    """Copy the metadata of all arrays to that of their group."""
    with warnings.catch_warnings():
        # xarray opens consolidated metadata by one read. zarr warns that version 3 of
        # the format does not specify them yet.
        warnings.simplefilter("ignore")
        extra("sweep", "zarr").consolidate_metadata(path)


@contextlib.contextmanager
def _exclusive(path: Path) -> Generator[None, None, None]:
    """Refuse to enter while another process has entered for the same folder.

    Windows has no such lock of folders, and nothing is refused there.
    """
    if fcntl is None:
        yield
        return
    folder = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            text = f"Another process is writing to the store {path}."
            raise RuntimeError(text) from error
        yield
    finally:
        # The system also releases the lock when the process ends or is killed.
        os.close(folder)


def _is_new(path: Path) -> bool:
    return not path.exists() or (path.is_dir() and not any(path.iterdir()))


def known_block(path: Path) -> tuple[int, ...] | None:
    """The block of a store that exists already."""
    return None if _is_new(path) else tuple(_identity_of(path)["block"])


class Memory:
    """Arrays in memory with the methods of a `Store`."""

    def __init__(self, grid: Grid, leaves: list[Leaf]):
        """Make arrays that take no memory before blocks are written."""
        self.grid = grid
        self.fills = [x.fill for x in leaves]
        self.attributes: dict[str, dict[str, Any]] = {}
        self.name = None
        self.arrays = {
            x.name: np.empty((*grid.shape, *x.shape), x.dtype) for x in leaves
        }

    @contextlib.contextmanager
    def opened(self, _: object, attributes: Attributes) -> Generator[None, None, None]:
        """Take the attributes: no other process can write to this memory."""
        self.attributes = {name: dict(x) for name, x in attributes.items()}
        yield

    def has(self, _: int) -> bool:
        """No block is finished before a sweep."""
        return False

    def count(self, _: int) -> None:
        """No block is finished before a sweep."""

    def write(self, number: int, values: list[np.ndarray]) -> None:
        """Keep a block."""
        region = self.grid.region(number)
        inside = self.grid.inside(number)
        for array, value in zip(self.arrays.values(), values, strict=True):
            array[region] = value[inside]

    def leave(self, number: int) -> None:
        """Fill a block that will not be computed."""
        region = self.grid.region(number)
        for array, fill in zip(self.arrays.values(), self.fills, strict=True):
            array[region] = fill

    def record(self, _: object) -> None:
        """Do nothing: the result lists the blocks that failed."""


class Store:
    """Arrays in a directory.

    The chunk of `valid` is written last: a block is finished if this chunk exists.
    """

    def __init__(self, path: Path, grid: Grid, leaves: list[Leaf]):
        """Name the directory, which is not opened before it is used."""
        self.path = path
        self.name = str(path)
        self.grid = grid
        self.leaves = leaves
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
                    f"The store {self.path} is damaged: its description is not whole "
                    f"({error!r})."
                )
                raise OSError(text) from error
        return self._arrays

    def _create(self, about: dict[str, Any], attributes: Attributes) -> None:
        """Write the metadata of all arrays, in a directory that appears at once."""
        # The directory is beside the store, since a rename needs the same file system.
        partial = self.path.with_name(f".{self.path.name}.{uuid.uuid4().hex}")
        try:
            self._describe(partial, about, attributes)
            os.rename(partial, self.path)
        except OSError as error:
            # Another process may have made the same store a moment ago.
            if not (self.path / "zarr.json").exists():
                raise OSError(
                    f"The store {self.path} cannot be written: {error}."
                ) from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)

    def _describe(
        self, path: Path, about: dict[str, Any], attributes: Attributes
    ) -> None:
        """Write the metadata of all arrays to a directory."""
        zarr = extra("sweep", "zarr")
        checksum = extra("sweep", "zarr.codecs").Crc32cCodec()
        grid = self.grid
        known = _CONVENTIONS | {_KEY: json.dumps(about)}
        group = zarr.create_group(path, attributes=known)
        for name, x in grid.axes.items():
            group.create_array(
                name,
                shape=x.shape,
                chunks=x.shape,
                dtype=x.dtype,
                fill_value=0,
                dimension_names=[name],
                attributes=attributes.get(name, {}),
                compressors=[checksum],
            )
        for leaf in self.leaves:
            group.create_array(
                leaf.name,
                shape=(*grid.shape, *leaf.shape),
                chunks=(*grid.block, *leaf.shape),
                dtype=leaf.dtype,
                fill_value=leaf.fill,
                dimension_names=leaf.dimensions(tuple(grid.axes)),
                attributes={**leaf.flags, **attributes.get(leaf.name, {})},
                compressors=[checksum],
            )
        _consolidate(path)

    def _chunk(self, leaf: Leaf, number: int) -> Path:
        """The file of a block of an array, as zarr names it."""
        place = [*np.unravel_index(number, self.grid.blocks), *(0 for _ in leaf.shape)]
        return self.path.joinpath(leaf.name, "c", *map(str, place))

    def has(self, number: int) -> bool:
        """Whether a block is finished."""
        return self._chunk(VALID, number).exists()

    def count(self, number: int) -> int | None:
        """Number of valid points of a block; None if a chunk is lost or damaged."""
        if not self.has(number):
            return None
        *values, valid = [self._read(leaf, number) for leaf in self.leaves]
        if valid is None or any(x is None for x in values):
            # Without its mask the block is unfinished, for the next run too.
            self._chunk(VALID, number).unlink(missing_ok=True)
            return None
        mask = np.frombuffer(valid, bool).reshape(self.grid.block)
        return int(np.count_nonzero(mask[self.grid.inside(number)]))

    def _read(self, leaf: Leaf, number: int) -> bytes | None:
        """The numbers of a chunk; None if it is lost or damaged."""
        try:
            content = self._chunk(leaf, number).read_bytes()
        except FileNotFoundError:
            return None
        numbers = content[:-4]
        size = leaf.dtype.itemsize * math.prod((*self.grid.block, *leaf.shape))
        is_whole = len(numbers) == size and content[-4:] == _checksum(numbers)
        return numbers if is_whole else None

    def write(self, number: int, values: list[np.ndarray]) -> None:
        """Keep a block, its mask last.

        A chunk of zarr is the numbers, little end first, and their checksum.
        """
        for leaf, value in zip(self.leaves, values, strict=True):
            in_order = np.ascontiguousarray(value, leaf.dtype.newbyteorder("<"))
            numbers = in_order.reshape(-1).view(np.uint8)
            chunk = self._chunk(leaf, number)
            # A chunk appears whole or not at all, also if this process is killed.
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
        self, about: dict[str, Any], attributes: Attributes
    ) -> Generator[None, None, None]:
        """Create the store, or check that it is of the same sweep; lock it."""
        if _is_new(self.path):
            self._create(about, attributes)
        known = _identity_of(self.path)
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
            # A new store has no coordinates yet.
            self._mend_axes()
            self._add_attributes(attributes)
            yield

    def _mend_axes(self) -> None:
        """Write the coordinates, unless they are in the store undamaged."""
        _ = self.arrays  # opens the group, and `_axes` with it
        for name, x in self.grid.axes.items():
            try:
                is_same = np.array_equal(self._axes[name][...], x)
            except ValueError:  # a wrong checksum
                is_same = False
            if not is_same:
                self._axes[name][...] = x

    @property
    def attributes(self) -> dict[str, dict[str, Any]]:
        """Attributes of axes and values, without those that explain codes."""
        flags = {leaf.name: leaf.flags for leaf in self.leaves}
        of_arrays = {}
        for name, array in (self.arrays | self._axes).items():
            own = flags.get(name, {})
            rest = {key: x for key, x in array.attrs.items() if key not in own}
            if rest:
                of_arrays[name] = rest
        return of_arrays

    def _add_attributes(self, attributes: Attributes) -> None:
        """Write the attributes that the store does not have, in place of others."""
        # JSON has lists in place of tuples.
        given = json.loads(json.dumps(attributes))
        known = self.attributes
        flags = {leaf.name: leaf.flags for leaf in self.leaves}
        new = {name: x for name, x in given.items() if known.get(name, {}) != x}
        for name, about in new.items():
            array = (self.arrays | self._axes)[name]
            array.attrs.put(flags.get(name, {}) | about)
        if new:
            _consolidate(self.path)

    @contextlib.contextmanager
    def _locked(self) -> Generator[None, None, None]:
        """Lock the store; remove files that a killed process left half-written."""
        with _exclusive(self.path):
            chunks = self.path.glob("**/c/**/*.partial")
            for partial in (*chunks, self._new_description):
                partial.unlink(missing_ok=True)
            yield

    @property
    def _new_description(self) -> Path:
        """Path to which the description is written before it replaces the old one."""
        return self.path / "zarr.partial"

    def leave(self, _: int) -> None:
        """Do nothing: zarr fills blocks that have no chunk."""

    def record(self, failures: Iterable[Failure]) -> None:
        """Write to the attributes which blocks failed."""
        about = _identity_of(self.path)
        # JSON has lists in place of tuples.
        failed = json.loads(json.dumps([x._asdict() for x in failures]))
        # A resumed run may have computed the blocks that failed before.
        if about.get("failures", []) != failed:
            place = self.path / "zarr.json"
            known = json.loads(place.read_text())
            known["attributes"][_KEY] = json.dumps(about | {"failures": failed})
            # As for a chunk, a killed process leaves the old description or the new
            # one.
            self._new_description.write_text(json.dumps(known))
            self._new_description.replace(place)
