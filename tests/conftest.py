"""Set-up of the test suite: x64, strict promotion, run-time type checks,
warnings as errors."""

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
from jaxtyping import config as jaxtyping_config
from jaxtyping import install_import_hook

# Tracing makes millions of small objects that live: looking through them for cycles
# takes a quarter of its time at the usual thresholds.
gc.set_threshold(100_000, 50, 50)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
# What was compiled is found again by the next run with the same folder, small programs
# too.
if os.environ.get("JRIGID_TEST_CACHE"):
    jax.config.update("jax_compilation_cache_dir", os.environ["JRIGID_TEST_CACHE"])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)

with install_import_hook("jrigid", "beartype.beartype"):
    import jrigid  # noqa: F401

import numpy as np  # noqa: E402
import pytest  # noqa: E402
from hypothesis import given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402


@pytest.fixture(scope="session", autouse=True)
def first_hypothesis():
    """Hypothesis collects garbage before its first test: here,
    while there is little to go through.

    In a process that has run for long it takes eight seconds.
    """

    @settings(max_examples=1, database=None, deadline=None)
    @given(st.none())
    def nothing(_):
        pass

    nothing()


@pytest.fixture
def untyped():
    """Switch the run-time type checks off, to reach the errors a user sees without
    them."""
    jaxtyping_config.update("jaxtyping_disable", True)
    yield
    jaxtyping_config.update("jaxtyping_disable", False)


@pytest.fixture
def rng(request):
    """A generator seeded by the name of the test, printed when the test fails."""
    seed = sum(ord(c) * (i + 1) for i, c in enumerate(request.node.name)) % 2**32
    print(f"seed {seed}")
    return np.random.default_rng(seed)


# Each compiled function keeps memory maps of its own, and Linux allows a process 65530:
# beyond them XLA's compiler dies. The suite compiles more than that, so now and then
# all are let go. To count them takes 50 ms when there are many: one test in eight does.
_MAPS = Path("/proc/self/maps")
_MOST_MAPS = 45_000
_TESTS = itertools.count()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown():
    counts = next(_TESTS) % 8 == 0 and _MAPS.exists()
    if counts and _MAPS.read_bytes().count(b"\n") > _MOST_MAPS:
        jax.clear_caches()
        gc.collect()
