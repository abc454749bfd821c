"""A block computed, here or in a process that only has the bytes of what to do."""

import contextlib
import functools
import os
import pickle
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np

from jrigid.sweep._grid import Grid, Leaf, on_block
from jrigid.sweep._store import Memory, Store, fingerprint

# The compiled function is kept for the next sweep of the same one in the same blocks.
evaluated = eqx.filter_jit(on_block)


# What decides besides a function what is traced, and is known to one thread of one
# process.
_SETTINGS = {
    "jax_enable_x64": jax.enable_x64,
    "jax_default_matmul_precision": jax.default_matmul_precision,
    "jax_default_prng_impl": jax.default_prng_impl,
    "jax_numpy_dtype_promotion": jax.numpy_dtype_promotion,
}


def settings() -> tuple[Any, ...]:
    """Those of jax here and now."""
    return tuple(getattr(jax.config, name) for name in _SETTINGS)


@contextlib.contextmanager
def under(values: tuple[Any, ...]) -> Iterator[None]:
    """With the settings of elsewhere."""
    with contextlib.ExitStack() as stack:
        for context, value in zip(_SETTINGS.values(), values, strict=True):
            stack.enter_context(context(value))
        yield


class Work(NamedTuple):
    """What is to be done with each block."""

    function: Callable[..., Any]
    grid: Grid
    leaves: list[Leaf]
    store: Path | None
    about: dict[str, Any]
    settings: tuple[Any, ...]


class Outcome(NamedTuple):
    """What became of a block.

    Attributes:
        number: Which block.
        count: How many points are valid.
        values: Of the block, its mask last; None where they are kept already.
        error: What went wrong, in words: an exception need not survive the way between
            processes.
        final: What to raise, if no other trial or block can do better.
    """

    number: int
    count: int = 0
    values: list[np.ndarray] | None = None
    error: str | None = None
    final: type[Exception] | None = None


class Worker:
    """Computes blocks on all devices of a process; from several threads at once."""

    def __init__(self, work: Work, kept: Store | Memory | None):
        """Without a place to keep blocks they are returned."""
        self.work, self.kept, self.devices = work, kept, jax.local_devices()
        # Two at a time on a device would compile twice, and on a CPU can wait for each
        # other for ever: both run in the same few threads of XLA.
        self.free = {device: threading.Lock() for device in self.devices}

    def __call__(self, number: int, part: Any) -> Outcome:
        """Compute a block, and keep it if there is where."""
        try:
            values = self._computed(number, part)
        except Exception as error:
            return Outcome(number, error=in_words(error))
        count = int(np.count_nonzero(values[-1][self.work.grid.inside(number)]))
        if self.kept is None:
            return Outcome(number, count, values)
        try:
            self.kept.write(number, values)
        except OSError as error:
            text = (
                f"The store cannot be written: {error}. What is finished is kept, and "
                "the same "
            )
            return Outcome(
                number, error=text + "call goes on from there.", final=OSError
            )
        return Outcome(number, count)

    def _computed(self, number: int, part: Any) -> list[np.ndarray]:
        device = self.devices[number % len(self.devices)]
        with under(self.work.settings), self.free[device]:
            part = jax.device_put(part, device)
            found = evaluated(self.work.function, self.work.grid.names, part)
        return [np.asarray(x) for x in jtu.tree_leaves(found)]


def traced(
    function: Callable[..., Any], names: Any, part: Any
) -> tuple[Any, dict[str, Any]]:
    """What a function returns for the first of some points, as shapes, and its fingerprint."""
    one = jtu.tree_map(lambda x: x[:1], part)
    jaxpr, (values, _), _ = eqx.filter_make_jaxpr(evaluated)(function, names, one)
    return values, fingerprint(function, jaxpr)


def in_words(error: BaseException) -> str:
    """What kind of error it was and what it says, without stacks and hints."""
    text = str(error)
    text = (text.partition("EquinoxRuntimeError: ")[2] or text).partition("\n\n-----")[
        0
    ]
    return f"{type(error).__name__}: {text.strip()}"


class Surroundings(NamedTuple):
    """What a process must be told before it has a backend.

    Attributes:
        driver: The process that has the work.
        settings: Of jax.
    """

    driver: int
    settings: tuple[Any, ...]


class Call:
    """Bytes that compute a block where `pickle.loads` reads them.

    So that an executor's own machinery needs no jrigid: where it is missing it says so.
    """

    def __init__(self, *arguments: Any):
        """Of `compute`."""
        self.arguments = arguments

    def __reduce__(self) -> tuple[Any, ...]:
        """How to be read."""
        return compute, self.arguments


def packed(work: Work) -> bytes:
    """The work without its points as bytes, or ValueError."""
    try:
        from cloudpickle import dumps
    except ModuleNotFoundError:
        from pickle import dumps
    try:
        axes = None if work.grid.names is None else dict.fromkeys(work.grid.names)
        return dumps(work._replace(grid=work.grid._replace(points=axes)))
    except Exception as error:
        raise ValueError(
            "Argument `function` must be one that other processes can be sent, but "
            f"it is not: {error}. (Write it at the top of a module, with all it needs "
            "as arrays inside of an equinox.Module; lambdas need cloudpickle, of the "
            "extra jrigid[sweep].)"
        ) from error


def compute(surroundings: Surroundings, work: bytes, number: int, part: Any) -> Outcome:
    """Compute a block, in whatever process this is."""
    elsewhere = surroundings.driver != os.getpid()
    with _one_at_a_time, under(surroundings.settings):
        if elsewhere:
            end_with_driver()
        worker = _unpacked(work)
        about = worker.work.about
        if elsewhere and about != _about_here(work, part):
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
    store = known.store
    return Worker(
        known, None if store is None else Store(store, known.grid, known.leaves)
    )


_seen: dict[bytes, dict[str, Any]] = {}


def _about_here(work: bytes, part: Any) -> dict[str, Any]:
    """The fingerprint that the function has in this process: its module may be an older one."""
    if work not in _seen:
        known = _unpacked(work).work
        _seen.clear()
        _seen[work] = traced(known.function, known.grid.names, part)[1]
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


def _end_with(sentinel: Any) -> None:
    """End this process when another one has ended."""
    from multiprocessing import connection

    connection.wait([sentinel])
    os._exit(1)
