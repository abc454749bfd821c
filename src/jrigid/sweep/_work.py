"""A block computed, here or in a process that only has the bytes of what to do."""

import contextlib
import functools
import multiprocessing
import multiprocessing.connection
import os
import pickle
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from jrigid.sweep._grid import Grid, Leaf, on_block
from jrigid.sweep._store import Memory, Store

# The compiled function is kept for the next sweep of the same one in the same blocks.
evaluated = eqx.filter_jit(on_block)


class Work(NamedTuple):
    """What is to be done with each block."""

    function: Callable[..., Any]
    grid: Grid
    leaves: list[Leaf]
    store: Path | None


class Outcome(NamedTuple):
    """What became of a block.

    Attributes:
        number: Which block.
        count: How many points are valid.
        values: Of the block, its mask last; None where a store has them.
        error: What went wrong, in words: an exception need not survive the way between processes.
        lost: Whether the store could not be written.
    """

    number: int
    count: int = 0
    values: list[np.ndarray] | None = None
    error: str | None = None
    lost: bool = False


class Worker:
    """Computes blocks on all devices of a process; from several threads at once."""

    def __init__(self, work: Work, kept: Store | Memory | None):
        """Send the points to each device; without a place to keep blocks, return them."""
        self.work, self.kept = work, kept
        self.grids = [jax.device_put(work.grid, x) for x in jax.local_devices()]
        self.x64 = x64()  # a thread does not know what is around
        # The first call of a device compiles, which a second thread would do again.
        self.first = {device: threading.Lock() for device in range(len(self.grids))}

    def __call__(self, number: int) -> Outcome:
        """Compute a block, and keep it if there is where."""
        known = self.kept and self.kept.count(number)
        if known is not None:
            return Outcome(number, known)
        try:
            values = self._computed(number)
        except Exception as error:
            return Outcome(number, error=in_words(error))
        count = int(np.sum(values[-1]))
        if self.kept is None:
            return Outcome(number, count, values)
        try:
            self.kept.write(number, values)
        except OSError as error:
            return Outcome(number, error=str(error), lost=True)
        return Outcome(number, count)

    def _computed(self, number: int) -> list[np.ndarray]:
        grid = self.work.grid
        device = number % len(self.grids)
        corner = np.array(grid.corner(number), np.int32)
        with self.first.get(device, contextlib.nullcontext()), jax.enable_x64(self.x64):
            found = evaluated(self.work.function, self.grids[device], corner)
        self.first.pop(device, None)
        region = grid.region(number)
        inside = tuple(slice(0, x.stop - x.start) for x in region)
        return [np.asarray(x)[inside] for x in jtu.tree_leaves(found)]


def in_words(error: BaseException) -> str:
    """What kind of error it was and what it says, without stacks and hints."""
    text = str(error)
    text = (text.partition("EquinoxRuntimeError: ")[2] or text).partition("\n\n-----")[0]
    return f"{type(error).__name__}: {text.strip()}"


def x64() -> bool:
    """Whether numbers have 64 bits here."""
    return jnp.zeros(()).dtype == np.float64


class Surroundings(NamedTuple):
    """What a process must be told before it has a backend.

    Attributes:
        driver: The process that has the work.
        x64: Whether numbers have 64 bits.
        cores: How many a worker may have, if that is known.
    """

    driver: int
    x64: bool
    cores: int | None


def packed(work: Work) -> bytes:
    """The work as bytes, or ValueError."""
    try:
        from cloudpickle import dumps
    except ModuleNotFoundError:
        from pickle import dumps
    grid = jtu.tree_map(np.asarray, work.grid)
    try:
        return dumps(work._replace(grid=grid))
    except Exception as error:
        raise ValueError(
            "Argument `function` must be one that other processes can be sent, but it is not: "
            f"{error}. (Write it at the top of a module, with all it needs as arrays inside of an "
            "equinox.Module; lambdas need cloudpickle, of the extra jrigid[sweep].)"
        ) from error


def compute(surroundings: Surroundings, work: bytes, number: int) -> Outcome:
    """Compute a block, in whatever process this is."""
    with _one_at_a_time:
        if surroundings.driver != os.getpid():
            _settle_in(surroundings)
        worker = _unpacked(work)
    return worker(number)


_one_at_a_time = threading.Lock()


@functools.lru_cache(maxsize=1)
def _unpacked(work: bytes) -> Worker:
    known: Work = pickle.loads(work)
    store = known.store
    return Worker(known, None if store is None else Store(store, known.grid, known.leaves))


@functools.lru_cache(maxsize=1)
def _settle_in(surroundings: Surroundings) -> None:
    """Once in a process, before its backend starts: what it may use, and when it ends."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    _take_cores(surroundings.cores or _threads_of_dask())
    jax.config.update("jax_enable_x64", surroundings.x64)
    if not jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        jax.config.update("jax_compilation_cache_dir", str(_own_directory() / "compiled"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def _end_with(sentinel: Any) -> None:
    """A pool's worker would wait for a driver that was killed for ever."""
    multiprocessing.connection.wait([sentinel])
    os._exit(1)


def _threads_of_dask() -> int | None:
    if "distributed" not in sys.modules:
        return None
    from distributed import get_worker

    try:
        return get_worker().state.nthreads
    except ValueError:
        return None


def _own_directory() -> Path:
    path = Path(tempfile.gettempdir()) / f"jrigid-{os.getuid() if hasattr(os, 'getuid') else 0}"
    path.mkdir(mode=0o700, exist_ok=True)
    return path


_held: list[int] = []


def _take_cores(count: int | None) -> None:
    """Keep to so many cores that no other worker on this machine has taken, if there are."""
    if count is None or not hasattr(os, "sched_setaffinity"):
        return
    import fcntl

    taken: dict[int, int] = {}
    for core in sorted(os.sched_getaffinity(0)):
        lock = os.open(_own_directory() / f"core-{core}", os.O_CREAT | os.O_RDWR)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # until the process ends
            taken[core] = lock
        except OSError:
            os.close(lock)
        if len(taken) == count:
            break
    else:
        for lock in taken.values():
            os.close(lock)
        return
    _held.extend(taken.values())
    for thread in os.listdir("/proc/self/task"):
        with contextlib.suppress(ProcessLookupError):
            os.sched_setaffinity(int(thread), set(taken))


def here(work: Work, kept: Store | Memory) -> tuple[Callable[[int], Outcome], int]:
    """A worker in this process, and in how many threads it is to be called."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    devices = jax.local_devices()
    # Of two threads one writes while the other computes.
    threads = max(cores or 1, 2) if devices[0].platform == "cpu" else 2 * len(devices)
    return Worker(work, kept), max(threads, len(devices))
