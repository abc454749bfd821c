"""How fits are compiled: what a first call costs beside tracing and XLA."""

import gc

import numpy as np
import pytest

from jrigid.identify import _compile


@pytest.fixture
def collector():
    """Garbage collection is as it was after the test."""
    enabled = gc.isenabled()
    yield
    (gc.enable if enabled else gc.disable)()


@pytest.mark.parametrize("compiled", [_compile.program, _compile.quick_jit])
@pytest.mark.parametrize("enabled", [True, False])
def test_no_garbage_is_collected_while_a_program_is_traced(
    collector, compiled, enabled
):
    seen = []

    @compiled
    def double(x):
        seen.append(gc.isenabled())
        return 2 * x

    (gc.enable if enabled else gc.disable)()
    np.testing.assert_array_equal(double(np.ones(3)), 2 * np.ones(3))
    assert seen == [False]
    assert gc.isenabled() is enabled


def test_garbage_is_collected_again_after_an_error(collector):
    @_compile.program
    def wrong(x):
        raise ValueError

    gc.enable()
    with pytest.raises(ValueError):
        wrong(np.ones(3))
    assert gc.isenabled()
