"""Sweeps that are killed at any moment, and gone on with."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import sweep_job
from test_sweep import chunks, job

import jrigid as jr

pytest.importorskip("zarr")
BLOCKS = 40


def start(mode, store):
    path = str(Path(jr.__file__).parents[1])
    environment = os.environ | {"PYTHONPATH": path, "TF_CPP_MIN_LOG_LEVEL": "3"}
    return subprocess.Popen(
        [sys.executable, sweep_job.__file__, mode, store, str(BLOCKS)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def finished(store):
    """The blocks that are done, and what they are."""
    return {x: when for x, when in chunks(store).items() if "valid" in x.parts}


def killed(mode, store, what, count):
    """Start a sweep, kill something once so many blocks are done;
    how the driver ended."""
    driver = start(mode, store)
    until = time.monotonic() + 120
    while len(finished(store)) < count and driver.poll() is None:
        assert time.monotonic() < until
        time.sleep(0.002)
    if what == "group":
        os.killpg(driver.pid, signal.SIGKILL)
    elif what == "driver":
        driver.kill()
    else:
        while driver.poll() is None and not (found := workers_of(driver)):
            time.sleep(0.002)
        if driver.poll() is None:
            found[-1].kill()
    driver.communicate(timeout=120)
    left = psutil.wait_procs(of_session(driver.pid), timeout=20)[1]
    assert not left, "a worker outlives its driver"
    return driver.returncode


def workers_of(driver):
    found = []
    try:
        for process in psutil.Process(driver.pid).children(recursive=True):
            if "spawn_main" in " ".join(process.cmdline()):
                found.append(process)
    except psutil.Error:  # one that has just ended
        return []
    return found


def of_session(leader):
    found = []
    for process in psutil.process_iter():
        try:
            if os.getsid(process.pid) == leader and process.pid != leader:
                found.append(process)
        except ProcessLookupError:
            continue
    return found


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    done = job("here", tmp_path_factory.mktemp("undisturbed") / "s", BLOCKS)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()[1]


def goes_on(mode, what, count, store, undisturbed):
    """Nothing that was finished is computed again,
    and the store is that of an undisturbed run."""
    code = killed(mode, store, what, count)
    before = finished(store)
    assert len(before) >= count
    if mode == "dask" and what == "worker":
        assert code == 0  # it was replaced
    done = job(mode, store, BLOCKS)
    assert done.returncode == 0, done.stderr
    after = finished(store)
    assert len(after) == BLOCKS
    assert all(after[x] == when for x, when in before.items())
    assert done.stdout.split()[1] == undisturbed


@pytest.mark.parametrize(
    ("mode", "what"), [("here", "driver"), ("pool", "worker"), ("pool", "driver")]
)
def test_a_killed_sweep_goes_on(mode, what, tmp_path, undisturbed):
    goes_on(mode, what, 9, tmp_path / "s", undisturbed)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["driver", "worker", "group"])
@pytest.mark.parametrize("mode", ["pool", "dask"])
def test_a_sweep_killed_ten_times_at_any_moment_goes_on(
    mode, what, tmp_path, undisturbed, rng
):
    for trial, count in enumerate(rng.integers(0, BLOCKS, 10)):
        goes_on(mode, what, int(count), tmp_path / str(trial), undisturbed)
    np.testing.assert_equal(len(list(tmp_path.iterdir())), 10)
