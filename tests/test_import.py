"""What `import jrigid` costs: its own modules, and nothing is computed."""

import os
import subprocess
import sys

import pytest

LARGEST = 0.3  # processor time of the import, over that of its dependencies
LOOK = """
import sys, time
start = time.process_time()
import jax, diffrax, equinox
dependencies = time.process_time() - start
before, start = set(sys.modules), time.process_time()
import jrigid
took = (time.process_time() - start) / dependencies
new = {name.partition(".")[0] for name in set(sys.modules) - before}
print(*sorted(new - sys.stdlib_module_names), took)
"""


@pytest.fixture(scope="module")
def imported():
    """The packages, and the least ratio of some processes, ten at most.

    Other work makes the ratio larger by up to a third, and nothing makes it smaller.
    """
    least = float("inf")
    for _ in range(10):
        # There is no such platform: whatever is computed at import fails.
        out = subprocess.run(
            [sys.executable, "-W", "error", "-c", LOOK],
            env={**os.environ, "JAX_PLATFORMS": "nowhere"},
            check=True,
            capture_output=True,
            text=True,
        )
        *packages, took = out.stdout.split()
        least = min(least, float(took))
        if least < LARGEST:
            break
    return packages, least


def test_nothing_is_computed_and_no_other_package_imported(imported):
    packages, _ = imported
    assert packages == ["jrigid"]


def test_the_import_takes_a_fraction_of_that_of_its_dependencies(imported):
    """The ratio of the processor times is the same on an idle and on a busy machine."""
    _, took = imported
    assert took < LARGEST


def test_packages_are_imported_when_they_are_used():
    """As attributes, by `from`, by a star, and once."""
    code = """
import sys, jrigid
late = jrigid._LATE
assert set(late) <= set(dir(jrigid))
assert not any("jrigid." + x in sys.modules for x in late), late
from jrigid import plot
assert plot is jrigid.plot is sys.modules["jrigid.plot"]
assert "polhode" in dir(plot) and "annotations" not in dir(plot)
from jrigid import *
assert identify.fit is jrigid.identify.fit
try:
    jrigid.simulat
except AttributeError as error:
    assert "simulat" in str(error)
else:
    raise AssertionError
"""
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)
