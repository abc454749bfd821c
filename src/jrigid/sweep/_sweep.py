"""Evaluate a function at very many points, in blocks that are kept and resumed."""

import math
import os
import pickle
import warnings
from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax.tree_util as jtu
import numpy as np
from jaxtyping import ArrayLike, PyTree

from jrigid._checks import check_type, demand, kind_of, whole_number
from jrigid.sweep._drive import Submit, meter, outcomes
from jrigid.sweep._grid import Grid, Leaf, grid_of, leaves_of
from jrigid.sweep._refined_maps import Classes, RefinedMap, corners_of
from jrigid.sweep._store import Memory, Store, identity, known_block
from jrigid.sweep._sweep_result import Failure, SweepResult
from jrigid.sweep._work import (
    Call,
    Outcome,
    Surroundings,
    Work,
    Worker,
    end_with_driver,
    packed,
    settings,
    traced,
)

# Blocks that an executor has at a time: enough for its workers never to wait.
_AHEAD = 1024
# By default a sweep has so many blocks, unless a block would have fewer points than
# _LEAST (a call costs a millisecond), or more than _MOST, or more bytes of values than
# _BYTES (an interrupt loses the blocks that are not finished).
_BLOCKS = 64
_LEAST = 256
_MOST = 2**18
_BYTES = 2**24
# Points of a tile of a refined map.
_TILE = 1024


def sweep(
    function: Callable[..., Any],
    axes: Mapping[str, ArrayLike] | None = None,
    *,
    points: PyTree = None,
    store: str | os.PathLike[str] | None = None,
    executor: Executor | None = None,
    block_size: int | None = None,
    attributes: Mapping[str, Mapping[str, Any]] | None = None,
    refine: Callable[[PyTree], Any] | None = None,
    progress: bool = True,
) -> SweepResult:
    """Evaluate a function on the grid that axes span, or at each of many points.

    The points are cut into blocks of one shape. Each block is one call of the same
    compiled and vmapped function, so results do not depend on where or when a block was
    computed. The sweep needs the memory of some blocks and, without a store, of the
    result.

    Args:
        function: A pure function of one number for each axis, passed by name, or of one
            of the points. As for `jax.jit`, what it closes over must not change. It
            returns an array, a code, or a tree of them. Inside, pass `throw=False` to
            functions that take it, so that points that fail are NaN.
        axes: Name and points of each axis; the last one runs fastest. They become
            floating point numbers; integers, such as seeds, go into `points`.
        points: In place of axes: any tree of arrays whose first axis is that of the
            points.
        store: A directory that keeps finished blocks (zarr, version 3; extra
            `jrigid[sweep]`). After any interruption the same call resumes from it.
            `xarray.open_zarr` opens it at any time, with NaN in unfinished blocks.
        executor: Computes the blocks, in place of the devices of this process: anything
            with the interface of `concurrent.futures.Executor`, such as
            `Client.get_executor()` of `dask.distributed`, or a `ProcessPoolExecutor`
            that spawns. Workers need jrigid and, if there is a store, the directory.
        block_size: About how many points a block has. Axes are cut evenly, the last one
            only if a block is smaller than it. The default is a 64th of all points, but
            between 256 and 2^18 points and at most 16 MB of values; or the block of an
            existing store.
        attributes: Attributes of axes and values by name, such as
            `{"spin": {"units": "rad/s"}}`. A store keeps those of earlier calls unless
            others are given for the same name.
        refine: Maps the values of one point to its class, an integer, boolean or code.
            Then only blocks that hold a change of class are computed. They are found
            from the corners of all blocks and followed from block to block. The blocks
            are tiles, of 1,024 points by default. A region within one tile that no
            corner shows is missed.
        progress: Show how many points are done.

    Returns:
        Values, where they are valid, and which blocks failed three times. A refined map
        also has the class of every point, and values where a class changes.

    Raises:
        ValueError: Axes are not arrays of numbers; the function returns integers or
            booleans only, which cannot be undefined (return floats, NaN where they
            are); it cannot be sent to a worker; or the store is of another sweep.
        OSError: The store cannot be written.
        RuntimeError: Another process writes to the store, or a worker died and took the
            executor along.
        ImportError: The extra is missing, or jrigid on a worker.

    Gradients: none; differentiate the function.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> def flips(second, offset):
    ...     inertia = jnp.stack([1.0, second, 2.0])
    ...     return jr.stability.flip_time(inertia, jnp.stack([offset, 1.0, 0.0]))
    >>> axes = {"second": jnp.linspace(1.1, 1.9, 5), "offset": jnp.array([1e-3, 1e-2])}
    >>> result = jr.sweep(flips, axes, progress=False)
    >>> print(result.values.shape, result.valid.all())
    (5, 2) True
    """
    grid = grid_of(axes, points)
    path = None if store is None else Path(store).absolute()
    # One point shows shapes and types of the values, on which the default size of a
    # block depends.
    values, about = traced(function, grid.names, grid.cut(1).part(0))
    leaves = leaves_of(values, grid.axes)
    grid = _cut(grid, block_size, path, refine is not None, leaves)
    descriptions = _descriptions(attributes, grid, leaves)
    work = Work(function, grid, leaves, path, about, settings())
    kept = Memory(grid, leaves) if path is None else Store(path, grid, leaves)
    run = _Run(work, kept, executor, progress)
    structure = jtu.tree_structure(values)
    classes = Classes()
    with kept.opened(about | identity(grid, leaves), descriptions):
        if refine is None:
            failures = run.compute(range(math.prod(grid.blocks)))
        else:
            failures, classes = run.refine(refine, structure)
        kept.record(failures)
    _warn(failures, run.valid, grid)
    *arrays, valid = kept.arrays.values()
    return SweepResult(
        values=jtu.tree_unflatten(structure, arrays),
        valid=np.asarray(valid[...]),
        axes=grid.axes,
        failures=failures,
        attributes=kept.attributes,
        store=kept.name,
        classes=classes.numbers,
        class_names=classes.names,
    )


def _descriptions(
    attributes: Mapping[str, Mapping[str, Any]] | None, grid: Grid, leaves: list[Leaf]
) -> dict[str, dict[str, Any]]:
    """Return the attributes, after a check that they belong to axes or values."""
    attributes = attributes or {}
    for name, about in attributes.items():
        check_type(f"attributes[{name!r}]", about, Mapping)
    descriptions = {name: dict(x) for name, x in attributes.items()}
    unknown = descriptions.keys() - {*grid.axes, *(x.name for x in leaves)}
    if unknown:
        raise ValueError(
            "Argument `attributes` must name axes or values, but "
            f"{sorted(unknown)} are neither."
        )
    return descriptions


def _corners(
    function: Callable[..., Any], grid: Grid, executor: Executor | None
) -> SweepResult:
    """Evaluate a function at the corners of all tiles, without warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return sweep(function, corners_of(grid), executor=executor, progress=False)


def _warn(failures: tuple[Failure, ...], valid: int, grid: Grid) -> None:
    """Warn the caller of `sweep` of failed blocks, or if no point is valid."""
    if failures:
        warnings.warn(
            f"{len(failures)} of {math.prod(grid.blocks)} blocks failed three times, "
            "and their points are not valid; see `failures`. The last of them: "
            f"{failures[-1].error}",
            stacklevel=3,
        )
    elif not valid:
        warnings.warn(
            f"None of the {math.prod(grid.shape)} points is valid: the function "
            "returned NaN, infinity or an undefined code at each.",
            stacklevel=3,
        )


def _cut(
    grid: Grid,
    size: int | None,
    path: Path | None,
    is_refined: bool,
    leaves: list[Leaf],
) -> Grid:
    """Cut the points into blocks of a size, by default into those of an existing store.

    Args:
        grid: The points.
        size: Points of a block, if the caller chose it.
        path: Of the store, if there is one.
        is_refined: Whether blocks must be tiles.
        leaves: What the function returns.
    """
    if is_refined and grid.names is None:
        raise ValueError(
            "Argument `refine` is for a grid of `axes`, not for a list of points."
        )
    if size is not None:
        size = whole_number("block_size", size)
        return grid.tiled(size) if is_refined else grid.cut(size)
    block = None if path is None else known_block(path)
    # A block of other dimensions is of another sweep, which the store will refuse.
    if block is not None and len(block) == len(grid.shape):
        if is_refined and not grid.is_tile(block):
            raise ValueError(
                "Argument `refine` needs a store in tiles, but the blocks of "
                f"{path} are {block}: choose another."
            )
        return grid._replace(block=block)
    return grid.tiled(_TILE) if is_refined else grid.cut(_default_size(grid, leaves))


def _default_size(grid: Grid, leaves: list[Leaf]) -> int:
    bytes_of_point = sum(math.prod(x.shape) * x.dtype.itemsize for x in leaves)
    most = max(min(_MOST, _BYTES // bytes_of_point), _LEAST)
    return min(max(math.prod(grid.shape) // _BLOCKS, _LEAST), most)


class _Run:
    """Blocks that are computed and kept.

    Attributes:
        valid: How many points of all blocks so far are valid.
    """

    def __init__(
        self,
        work: Work,
        kept: Memory | Store,
        executor: Executor | None,
        progress: bool,
    ):
        self._work = work
        self._kept = kept
        self._executor = executor
        self._progress = progress
        self.valid = 0

    def compute(self, numbers: Iterable[int]) -> tuple[Failure, ...]:
        """Compute the blocks that are not kept yet, and return those that failed."""
        grid = self._work.grid
        kept = self._kept
        counts = {number: kept.count(number) for number in numbers}
        sizes = {
            number: math.prod(x.stop - x.start for x in grid.region(number))
            for number in counts
        }
        waiting = [number for number, count in counts.items() if count is None]
        self.valid += sum(count or 0 for count in counts.values())
        total = sum(sizes.values())
        done = total - sum(sizes[number] for number in waiting)
        failures = []
        with (
            meter(total, done, self._progress and bool(waiting)) as advance,
            _submitting(self._work, kept, self._executor) as (submit, ahead),
        ):
            for outcome in outcomes(submit, waiting, ahead):
                self.valid += outcome.count
                advance(sizes[outcome.number])
                if outcome.values is not None:
                    kept.write(outcome.number, outcome.values)
                if outcome.error is not None:
                    kept.leave(outcome.number)
                    failures.append(_failure(grid, outcome.number, outcome.error))
        return tuple(failures)

    def refine(
        self, classify: Callable[[PyTree], Any], structure: Any
    ) -> tuple[tuple[Failure, ...], Classes]:
        """Compute the tiles with a change of class; return failures and all classes."""
        grid = self._work.grid
        corners = _corners(self._work.function, grid, self._executor)
        refined = RefinedMap(grid, self._kept, structure, classify, corners)
        failures = refined.refine(self.compute)
        # `valid` decides on a warning alone, so points may count twice.
        self.valid += int(np.sum(corners.valid))
        return failures, Classes(refined.classes, refined.names)


def _failure(grid: Grid, number: int, error: str) -> Failure:
    """Describe a block that failed by its first and last points."""
    region = grid.region(number)
    first = tuple(x.start for x in region)
    last = tuple(x.stop - 1 for x in region)
    return Failure(first, last, error)


@contextmanager
def _submitting(
    work: Work, kept: Memory | Store, executor: Executor | None
) -> Generator[tuple[Submit, int], None, None]:
    """A function that has a block computed, and how many blocks may wait for it."""
    if executor is None:
        worker = Worker(work, kept)
        # Two for each device: one writes while the other computes.
        threads = 2 * len(worker.devices)
        with ThreadPoolExecutor(threads) as pool:
            # Two more blocks wait, so that no thread does.
            yield lambda n: pool.submit(worker, n, work.grid.part(n)), threads + 2
    else:
        _prepare(executor)
        surroundings = Surroundings(os.getpid(), work.settings)
        payload = packed(work)

        def submit(number: int) -> Future[Outcome]:
            call = Call(surroundings, payload, number, work.grid.part(number))
            return executor.submit(pickle.loads, pickle.dumps(call))

        yield submit, _AHEAD


# Any: pools of processes have attributes that `Executor` has not.
def _prepare(executor: Any) -> None:
    """Refuse what is no executor, or forks; let workers end with this process."""
    can_submit = hasattr(executor, "submit") and not isinstance(executor, type)
    message = f"must have the method `submit`, but it is {kind_of(executor)}."
    demand(can_submit, f"Argument `executor` {message}")
    processes = getattr(executor, "_mp_context", None)
    if processes is not None and processes.get_start_method() == "fork":
        raise ValueError(
            "Argument `executor` must not fork, beside the threads of jax, but it "
            "does: pass it "
            '`mp_context=multiprocessing.get_context("spawn")`.'
        )
    if getattr(executor, "_initializer", end_with_driver) is None:
        # A worker that has no block yet would outlive a driver that is killed.
        executor._initializer = end_with_driver
