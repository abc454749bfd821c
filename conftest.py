"""Set-up of tests and doctests: float64, and what makes them quick."""

import gc
import itertools
import os
from pathlib import Path

import jaxlib

# XLA's other way to generate code on CPUs, in one piece, takes half the time. What is
# slower to compile is what users have: run `XLA_FLAGS= make test` before a release.
if jaxlib.version.__version_info__ < (0, 11):
    quick = (
        "--xla_cpu_use_fusion_emitters=false",
        "--xla_cpu_parallel_codegen_split_count=1",
        "--xla_disable_hlo_passes=while-loop-invariant-code-motion",
    )
    os.environ.setdefault("XLA_FLAGS", " ".join(quick))

import jax
import pytest
from jax._src import pjit
from jax._src.interpreters import pxla

# Tracing makes millions of small objects that live: looking through them for cycles
# takes a quarter of its time at the usual thresholds.
gc.set_threshold(100_000, 50, 50)

# Examples in docstrings are written in float64.
jax.config.update("jax_enable_x64", True)
# What was compiled is found again by the next run with the same folder, small programs
# too.
if os.environ.get("JRIGID_TEST_CACHE"):
    jax.config.update("jax_compilation_cache_dir", os.environ["JRIGID_TEST_CACHE"])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


# jax keeps the lowered text of every program that it compiled. With each of them the
# next one takes longer: after 2000 programs, three times as long to lower and 1.4 times
# as long to compile. Compiled programs stay when the texts are let go. No public
# function does it, and a version of jax without these caches needs no care.
_LOWERED = [
    getattr(pjit, "_pjit_lower", None),
    getattr(pxla, "_cached_lowering_to_hlo", None),
]

# Each compiled function keeps memory maps of its own, and Linux allows a process 65530:
# beyond them XLA's compiler dies. The suite compiles more than that, so now and then
# all are let go. To count them takes 50 ms when there are many: one test in eight does.
_MAPS = Path("/proc/self/maps")
_MOST_MAPS = 45_000
_TESTS = itertools.count()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown():
    """Let go of what grows with each program, after one test in eight."""
    if next(_TESTS) % 8 != 0:
        return
    for cache in _LOWERED:
        if cache is not None:
            cache.cache_clear()
    if _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > _MOST_MAPS:
        jax.clear_caches()
        gc.collect()


def pytest_configure():
    """Give each worker of pytest-xdist a core of its own.

    XLA starts a thread for each core that it may use, and those of several workers are
    in each other's way.
    """
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[int(worker[2:]) % len(cores)]})
