"""Sweeps: 10^8 points streamed to a store, peers, memory, the cost of a block.

The square of the growth rate about an axis, and DeBra and Delp's plane (growth rate and
region), on a grid of 10,000 x 10,000: evaluated by vectorised numpy (in rows of blocks,
nothing kept), by numba in parallel, by a loop over blocks of a jitted function, all
dropping what they find; by `jrigid.sweep` to a store, and to one a twentieth as large.
Each in a process of its own, whose peak memory is that of /proc. The store is written
to the disk under TMPDIR; the page cache takes it.

Then what a block costs beside its work: blocks of about 50 ms in this process against a
loop of the same calls, with and without a store, on one core; and empty blocks on a
LocalCluster of two and in a pool of two processes. The most blocks ever run is
`--many`.
"""

import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import common
import jax
import jax.numpy as jnp
import numpy as np

import jrigid as jr

SIDE, ROWS = 10_000, 26  # blocks of 260,000 points, as by default
REPEATS = 3


def square(second, third):
    return jr.stability.growth_rate_squared(jnp.stack([1.0, second, third]), 2, 1.0)


def satellite(roll, yaw):
    b = (1 - yaw) / (1 - roll)
    found = jr.stability.satellite_stability(jnp.stack([jnp.ones_like(b), b, b + yaw]))
    return found.growth_rate, found.region


def axes(function, side=SIDE):
    if function is square:
        return {
            "second": np.linspace(0.3, 3.0, side),
            "third": np.linspace(0.3, 3.0, SIDE),
        }
    return {
        "roll": np.linspace(-0.99, 0.99, side),
        "yaw": np.linspace(-0.99, 0.99, SIDE),
    }


def by_numpy(_):
    second, third = axes(square).values()
    yield
    for first in range(0, SIDE, ROWS):
        rows = second[first : first + ROWS, None]
        _ = (rows - third) * (third - 1.0) / rows


def by_numba(_):
    import numba

    @numba.njit(parallel=True)
    def blocks(second, third, rows):
        last = 0.0
        for block in numba.prange(-(-second.size // rows)):
            kept = np.empty((rows, third.size))
            for i in range(min(rows, second.size - block * rows)):
                x = second[block * rows + i]
                for j in range(third.size):
                    kept[i, j] = (x - third[j]) * (third[j] - 1.0) / x
            last += kept[0, 0]
        return last

    second, third = axes(square).values()
    blocks(second[:ROWS], third, ROWS)
    yield
    blocks(second, third, ROWS)


def by_loop(function):
    """As a user would write it."""

    @jax.jit
    def block(first, second):
        one = lambda x: jax.vmap(lambda y: function(x, y))(second)  # noqa: E731
        return jax.vmap(one)(first)

    first, second = axes(function).values()
    jax.block_until_ready(block(first[:ROWS], second))
    yield
    for start in range(0, SIDE, ROWS):
        found = block(first[min(start, SIDE - ROWS) :][:ROWS], second)
        [np.asarray(x) for x in jax.tree_util.tree_leaves(found)]


def by_sweep(function, side=SIDE, store=True):
    with tempfile.TemporaryDirectory() as path:
        run = lambda place, side: jr.sweep(  # noqa: E731
            function,
            axes(function, side),
            progress=False,
            block_size=ROWS * SIDE,
            store=place if store else None,
        )
        run(Path(path) / "first", ROWS)
        yield
        done = run(Path(path) / "s", side)
        yield
        assert done.valid[-1].all()


CASES = {
    "numpy, nothing kept": lambda: by_numpy(square),
    "numba, parallel, nothing kept": lambda: by_numba(square),
    "loop over jit, nothing kept": lambda: by_loop(square),
    "jrigid.sweep in memory": lambda: by_sweep(square, store=False),
    "jrigid.sweep to a store": lambda: by_sweep(square),
    "the same, a twentieth": lambda: by_sweep(square, SIDE // 20),
    "rate and region: loop over jit, nothing kept": lambda: by_loop(satellite),
    "rate and region: jrigid.sweep to a store": lambda: by_sweep(satellite),
    "rate and region: the same, a twentieth": lambda: by_sweep(satellite, SIDE // 20),
}


def alone(name):
    """Seconds and peak memory [MiB] of one case; run in a process of its own."""
    case = CASES[name]()
    next(case)
    start = time.perf_counter()
    next(case, None)
    seconds = time.perf_counter() - start
    peak = next(
        x for x in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in x
    )
    print(json.dumps([seconds, int(peak.split()[1]) / 1024]))


def linear():
    """Rows of 10^8 points."""
    times: dict[str, list] = {name: [] for name in CASES}
    for _ in range(REPEATS):
        for name in CASES:
            command = [sys.executable, __file__, "--alone", name]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            times[name].append(json.loads(done.stdout.splitlines()[-1]))
    rows = []
    for name, found in times.items():
        seconds, peaks = np.array(found).T
        rows.append(
            [name, seconds.min(), float(np.median(seconds)), f"{np.median(peaks):.0f}"]
        )
    return rows


def work(x):
    """50 ms for a block of 4,096 points."""
    return jax.lax.fori_loop(0, 1150, lambda _, y: jnp.sin(y) + 1e-3, x)


def a_block(count=40, size=4096):
    """Milliseconds of a 50 ms block beside the same call in a loop; on one core."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    x = np.linspace(0, 1, count * size)
    block = jax.jit(jax.vmap(work))
    np.asarray(block(x[:size]))
    jr.sweep(work, {"x": x[: 2 * size]}, block_size=size, progress=False)

    def loop():
        for k in range(count):
            np.asarray(block(x[k * size : (k + 1) * size]))

    def kept():
        with tempfile.TemporaryDirectory() as path:
            jr.sweep(work, {"x": x}, store=f"{path}/s", block_size=size, progress=False)

    cases = {
        "loop over jit": loop,
        "jrigid.sweep": lambda: (
            jr.sweep(work, {"x": x}, block_size=size, progress=False).valid
        ),
        "jrigid.sweep to a store": kept,
    }
    found = common.timed(cases, repeats=7)
    os.sched_setaffinity(0, cores)
    return [
        [name, least / count, median / count]
        for name, (least, median, _) in found.items()
    ]


def empty(x):
    return x + 1.0


def executors(count=400):
    """Milliseconds of an empty block, kept in a store, wherever it is computed."""
    from dask.distributed import Client, LocalCluster

    spawn = multiprocessing.get_context("spawn")
    cluster = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)  # type: ignore
    client = Client(cluster)
    pool = ProcessPoolExecutor(2, mp_context=spawn)
    kinds = {
        "in process": None,
        "pool of two": pool,
        "LocalCluster of two": client.get_executor(),
    }
    rows = []
    for name, executor in kinds.items():
        for kept in (False, True):
            seconds = []
            for n in (8, count, count, count):
                x = np.linspace(0, 1, 16 * n)
                path = tempfile.mkdtemp()
                start = time.perf_counter()
                jr.sweep(
                    empty,
                    {"x": x},
                    executor=executor,
                    block_size=16,
                    progress=False,
                    store=f"{path}/s" if kept else None,
                )
                seconds.append((time.perf_counter() - start) / n * 1e3)
                shutil.rmtree(path)
            where = f"{name}, {'to a store' if kept else 'results sent back'}"
            rows.append([where, min(seconds[1:]), float(np.median(seconds[1:]))])
    pool.shutdown()
    client.close()
    cluster.close()
    return rows


def many(count):
    """Seconds to store many blocks of four points in process, and to look at them."""
    with tempfile.TemporaryDirectory() as path:
        start = time.perf_counter()
        x = np.linspace(0, 1, 4 * count)
        jr.sweep(empty, {"x": x}, store=f"{path}/s", block_size=4, progress=False)
        first = time.perf_counter() - start
        start = time.perf_counter()
        jr.sweep(empty, {"x": x}, store=f"{path}/s", progress=False)
        return [[f"{count:,} blocks", first, time.perf_counter() - start]]


if __name__ == "__main__":
    parser = common.arguments(__doc__)
    parser.add_argument("--alone", help="one case, as JSON")
    parser.add_argument("--many", type=int, default=100_000)
    options = parser.parse_args()
    if options.alone:
        alone(options.alone)
        sys.exit()
    text = [
        common.table(["10^8 points", "min s", "median s", "peak MiB"], linear()),
        common.table(
            ["a block of 4,096 points, one core", "min ms", "median ms"], a_block()
        ),
        common.table(["an empty block", "min ms", "median ms"], executors()),
        common.table(
            ["to a store", "first s", "again s"], many(20_000) + many(options.many)
        ),
    ]
    packages = ("jax", "numpy", "numba", "zarr", "distributed")
    common.report("sweep", "Sweeps", "\n\n".join(text), packages, options.write)
