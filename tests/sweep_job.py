"""A sweep in a process of its own, to be killed: `python sweep_job.py MODE STORE
BLOCKS`."""

import hashlib
import os
import sys
from pathlib import Path

if sys.argv[1:2] == ["devices"]:
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_force_host_platform_device_count=2"

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import jrigid as jr  # noqa: E402

BLOCK = 64


def slow(x, y):
    """Some milliseconds for a block."""
    turned = jax.lax.fori_loop(0, 20_000, lambda _, z: jnp.sin(z) + 1e-3 * x, y)
    return {
        "turned": turned,
        "both": jnp.stack([x, y]) ** 0.3,
        "near": jnp.where(y > x, 0.0, turned),
    }


def axes(blocks):
    """Those of so many blocks; the last one is not full."""
    return {"x": np.linspace(0, 1, blocks), "y": np.linspace(0, 1, BLOCK - 3)}


def contents(path):
    """A digest of every file of a store."""
    digest = hashlib.sha256()
    for file in sorted(Path(path).rglob("*")):
        if file.is_file():
            digest.update(str(file.relative_to(path)).encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()


def executor(mode):
    """What computes, by its name."""
    if mode == "pool":
        import multiprocessing
        from concurrent.futures import ProcessPoolExecutor

        return ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn"))
    if mode == "dask":
        from dask.distributed import Client, LocalCluster

        cluster = LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None
        )
        return Client(cluster).get_executor()
    return None


if __name__ == "__main__":
    mode, store, blocks = sys.argv[1], sys.argv[2], int(sys.argv[3])
    done = jr.sweep(
        slow,
        axes(blocks),
        store=store,
        executor=executor(mode),
        block_size=BLOCK,
        progress=False,
    )
    assert done.valid[...].all()
    assert not done.failures
    print(len(jax.devices()), contents(store))
    sys.stdout.flush()
    os._exit(0)  # whatever a cluster would still say
