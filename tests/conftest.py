"""Set-up of the tests: strict promotion and run-time type checks."""

import jax
from jaxtyping import config as jaxtyping_config
from jaxtyping import install_import_hook

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
with install_import_hook("jrigid", "beartype.beartype"):
    import jrigid

    # Packages that are imported at their first use are checked as well.
    for name in jrigid.__all__:
        getattr(jrigid, name)

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
