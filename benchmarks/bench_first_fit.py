"""CPU seconds of a first fit: in a fresh process, a command line, at new lengths.

    python benchmarks/bench_first_fit.py [--write]

Each row is a process of its own, of which all CPU seconds count: imports, tracing,
compiling and the fit. "With cache" is a second process that finds the compiled programs
of the first one in JAX's persistent cache.
"""

import os
import pathlib
import resource
import subprocess
import sys
import tempfile

import common
import numpy as np

import jrigid as jr

REPEATS = 3
FIT = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import jrigid as jr
record = jr.datasets.gyro_example()
readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
"""
IMPORT = "import jrigid"
LENGTHS = """
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import jrigid as jr
compiled = []

def count(event, duration, fun_name=None, **_):
    if "backend_compile" in event and "minimise" in str(fun_name):
        compiled.append(fun_name)

jax.monitoring.register_event_duration_secs_listener(count)
record = jr.datasets.gyro_example()
ts, values = np.asarray(record.times), np.asarray(record.omegas)
ts = np.concatenate([ts, ts[-1] + ts[1:21] - ts[0]])
values = np.concatenate([values, values[-20:]])
for count in range(180, 220, 2):
    readings = jr.identify.Rates(ts[:count], values[:count], record.sigma)
    jr.identify.fit(jr.RigidBody(np.ones(3)), readings, throw=False)
print(len(compiled))
"""


def cpu_of(command, **environment):
    """CPU seconds of a process and its output."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        command,
        env=os.environ | environment,
        check=True,
        capture_output=True,
        text=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = (after.ru_utime + after.ru_stime) - (before.ru_utime + before.ru_stime)
    return spent, done.stdout


def row(name, command, **environment):
    times = [cpu_of(command, **environment)[0] for _ in range(REPEATS)]
    return [name, min(times), float(np.median(times))]


def write_record(path):
    """Twelve seconds at 200 Hz of a body that tumbles, with a bias and noise."""
    rng = np.random.default_rng(0)
    ts = np.arange(2400) / 200
    start = jr.State(np.array([1.0, 0.0, 0.0, 0.0]), np.array([3.0, 5.0, 2.0]))
    omegas = np.asarray(jr.free_rotation(np.array([1.0, 1.7, 2.3]), start, ts).omega)
    omegas = omegas + 0.02 + 0.02 * rng.normal(size=omegas.shape)
    table = np.column_stack([ts, omegas])
    header = "time (s),gx (rad/s),gy (rad/s),gz (rad/s)"
    np.savetxt(path, table, delimiter=",", header=header, comments="")


def main():
    options = common.arguments(__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        record = pathlib.Path(folder, "record.csv")
        write_record(record)
        cached = {
            "JAX_COMPILATION_CACHE_DIR": str(pathlib.Path(folder, "cache")),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
        }
        python = [sys.executable, "-c"]
        cpu_of([*python, FIT], **cached)  # fills the cache
        command = [sys.executable, "-m", "jrigid", "fit", str(record), "--bias"]
        rows = [
            row("`import jrigid`", [*python, IMPORT]),
            row("first fit, 200 samples", [*python, FIT]),
            row("the same, with cache", [*python, FIT], **cached),
            row("`jrigid fit` of 12 s at 200 Hz, `--bias`", command),
        ]
        programs = cpu_of([*python, LENGTHS])[1].strip()
    text = common.table(["process", "CPU s, min", "CPU s, median"], rows)
    text += "\n\nTwenty records of 180 to 218 samples compile `minimise` "
    text += f"{programs} time(s)."
    common.report("first_fit", "The first fit", text, ("jax", "numpy"), options.write)


if __name__ == "__main__":
    main()
