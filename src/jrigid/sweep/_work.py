"""Compute a block, in this process or in one that receives the work as bytes.

A worker of a process pool ends itself when its driver ends (`end_with_driver`). If the
driver is killed, `concurrent.futures` leaves its workers waiting for ever.
"""

import contextlib
import functools
import os
import pickle
import threading
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from jrigid._checks import traced_by_jax
from jrigid.sweep._grid import Grid, Leaf, on_block
from jrigid.sweep._store import Memory, Store, fingerprint

# One function for all sweeps: the next sweep of the same function in the same blocks
# compiles nothing.
evaluated = eqx.filter_jit(on_block)

# Settings of jax that change what is traced. They belong to a thread, so that the
# threads and processes that compute blocks do not have those of the caller.
_SETTINGS = {
    "jax_enable_x64": jax.enable_x64,
    "jax_default_matmul_precision": jax.default_matmul_precision,
    "jax_default_prng_impl": jax.default_prng_impl,
    "jax_numpy_dtype_promotion": jax.numpy_dtype_promotion,
}


def settings() -> tuple[Any, ...]:
    """The settings of jax in this thread."""
    return tuple(getattr(jax.config, name) for name in _SETTINGS)


@contextlib.contextmanager
def under(values: tuple[Any, ...]) -> Generator[None, None, None]:
    """Apply the settings of another thread or process."""
    with contextlib.ExitStack() as stack:
        for context, value in zip(_SETTINGS.values(), values, strict=True):
            stack.enter_context(context(value))
        yield


class Work(NamedTuple):
    """Task of a worker, which is the same for each block.

    Attributes:
        function: Of a point, or of a number for each axis.
        grid: All points, in blocks.
        leaves: What the function returns.
        store: Where the worker writes; None: it returns the values.
        about: Fingerprint of the function in the driver.
        settings: Of jax in the driver.
    """

    function: Callable[..., Any]
    grid: Grid
    leaves: list[Leaf]
    store: Path | None
    about: dict[str, Any]
    settings: tuple[Any, ...]


class Outcome(NamedTuple):
    """Outcome of a block.

    Attributes:
        number: Which block.
        count: How many points are valid.
        values: Of the block, with the mask `valid` last; None if they are kept already.
        error: What went wrong, as a text: not every exception can be pickled.
        final: What to raise, if no other trial or block can do better.
    """

    number: int
    count: int = 0
    values: list[np.ndarray] | None = None
    error: str | None = None
    final: type[Exception] | None = None


class Worker:
    """Computes blocks on all devices of a process; several threads may call it."""

    def __init__(self, work: Work, kept: Store | Memory | None):
        """Prepare a worker.

        Args:
            work: What to do.
            kept: Where to keep blocks; None to return them.
        """
        self.work = work
        self.kept = kept
        self.devices = jax.local_devices()
        # Two blocks at a time on a device would compile twice, and on a CPU can wait
        # for each other for ever: both run in the same few threads of XLA.
        self.free = {device: threading.Lock() for device in self.devices}

    def __call__(self, number: int, part: PyTree) -> Outcome:
        """Compute a block, and keep or return it."""
        try:
            values = self._computed(number, part)
        except Exception as error:
            return Outcome(number, error=in_words(error))
        # Points that are repeated to fill the last block of an axis do not count.
        count = int(np.count_nonzero(values[-1][self.work.grid.inside(number)]))
        if self.kept is None:
            return Outcome(number, count, values)
        try:
            self.kept.write(number, values)
        except OSError as error:
            text = (
                f"The store cannot be written: {error}. What is finished is kept, and "
                "the same call goes on from there."
            )
            return Outcome(number, error=text, final=OSError)
        return Outcome(number, count)

    def _computed(self, number: int, part: PyTree) -> list[np.ndarray]:
        device = self.devices[number % len(self.devices)]
        with under(self.work.settings), self.free[device]:
            part = jax.device_put(part, device)
            found = evaluated(self.work.function, self.work.grid.names, part)
        return [np.asarray(x) for x in jtu.tree_leaves(found)]


def traced(
    function: Callable[..., Any], names: tuple[str, ...] | None, part: PyTree
) -> tuple[PyTree, dict[str, Any]]:
    """Trace a function; return the shapes of its values and its fingerprint.

    Only the first of some points is traced: the fingerprint must not depend on the
    blocks.
    """
    one = jtu.tree_map(lambda x: x[:1], part)
    with traced_by_jax("the function of a sweep"):
        jaxpr, (values, _), _ = eqx.filter_make_jaxpr(evaluated)(function, names, one)
    return values, fingerprint(function, jaxpr)


def in_words(error: BaseException) -> str:
    """Type and text of an error, without what XLA and equinox add."""
    text = str(error)
    text = text.partition("EquinoxRuntimeError: ")[2] or text
    text = text.partition("\n\n-----")[0]
    return f"{type(error).__name__}: {text.strip()}"


class Surroundings(NamedTuple):
    """Settings that a process needs before it imports or traces anything.

    Attributes:
        driver: Number of the process that hands out the blocks.
        settings: Of jax in the driver.
    """

    driver: int
    settings: tuple[Any, ...]


class Call:
    """A call of `compute`, which is made where `pickle.loads` reads it.

    An executor then only unpickles a function of Python. A worker without jrigid
    raises an ImportError, where it could not even read a function of jrigid.
    """

    def __init__(self, *arguments: Any):
        """Take the arguments of `compute`."""
        self.arguments = arguments

    def __reduce__(self) -> tuple[Any, ...]:
        """The call that `pickle.loads` makes."""
        return compute, self.arguments


def packed(work: Work) -> bytes:
    """Pickle the work without its points, or raise ValueError."""
    try:
        from cloudpickle import dumps
    except ModuleNotFoundError:
        from pickle import dumps
    try:
        # Each call carries the points of its own block, and the work only names the
        # axes.
        axes = None if work.grid.names is None else dict.fromkeys(work.grid.names)
        return dumps(work._replace(grid=work.grid._replace(points=axes)))
    except Exception as error:
        raise ValueError(
            "Argument `function` must be one that other processes can be sent, but "
            f"it is not: {error}. (Write it at the top of a module, with all it needs "
            "as arrays inside of an equinox.Module; lambdas need cloudpickle, of the "
            "extra jrigid[sweep].)"
        ) from error


def compute(
    surroundings: Surroundings, work: bytes, number: int, part: PyTree
) -> Outcome:
    """Compute a block, in any process."""
    is_elsewhere = surroundings.driver != os.getpid()
    # Workers of dask have threads, which must not unpack or trace the work twice.
    with _one_at_a_time, under(surroundings.settings):
        if is_elsewhere:
            end_with_driver()
        worker = _unpacked(work)
        about = worker.work.about
        if is_elsewhere and about != _about_here(work, part):
            text = (
                f"A worker has not the function and versions {about} of the driver, "
                "or another kind of device: start it anew."
            )
            return Outcome(number, error=text, final=RuntimeError)
    return worker(number, part)


_one_at_a_time = threading.Lock()


@functools.lru_cache(maxsize=1)
def _unpacked(work: bytes) -> Worker:
    known: Work = pickle.loads(work)
    if known.store is None:
        return Worker(known, None)
    return Worker(known, Store(known.store, known.grid, known.leaves))


# The fingerprint of the latest work; `part` is no key of a cache.
_seen: dict[bytes, dict[str, Any]] = {}


def _about_here(work: bytes, part: PyTree) -> dict[str, Any]:
    """Fingerprint of the function in this process, whose module may be an older one."""
    if work not in _seen:
        known = _unpacked(work).work
        _seen.clear()
        _, _seen[work] = traced(known.function, known.grid.names, part)
    return _seen[work]


@functools.cache
def end_with_driver() -> None:
    """End this process when its parent ends, if it is a worker of a process pool.

    `concurrent.futures` leaves the workers of a killed driver waiting for ever, so that
    they hold memory and may still write to the store of the next run
    (`tests/test_sweep_killed.py`). Workers of dask end by themselves.
    """
    import multiprocessing

    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    """End this process when another one has ended."""
    from multiprocessing import connection

    connection.wait([sentinel])
    os._exit(1)
