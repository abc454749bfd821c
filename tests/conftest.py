"""Set-up of the test suite: x64, strict promotion, run-time type checks, warnings as errors."""

import os

import jax
from jaxtyping import config as jaxtyping_config
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
# Compiled tests are found again by the next run on the same machine.
jax.config.update("jax_compilation_cache_dir", os.environ.get("JRIGID_TEST_CACHE"))

with install_import_hook("jrigid", "beartype.beartype"):
    import jrigid  # noqa: F401

import numpy as np  # noqa: E402
import pytest  # noqa: E402


@pytest.fixture
def untyped():
    """Switch the run-time type checks off, to reach the errors a user sees without them."""
    jaxtyping_config.update("jaxtyping_disable", True)
    yield
    jaxtyping_config.update("jaxtyping_disable", False)


@pytest.fixture
def rng(request):
    """A generator seeded by the name of the test, printed when the test fails."""
    seed = sum(ord(c) * (i + 1) for i, c in enumerate(request.node.name)) % 2**32
    print(f"seed {seed}")
    return np.random.default_rng(seed)
