"""Errors in units of the promise, and steps, under torques that are not smooth.

    python benchmarks/bench_nonsmooth.py [--write] [--rtol 1e-8 1e-11]
        [--duration 5 500] [--kinds sampled kinked] [--solver dopri8] [--declare]

Sixteen random bodies under each kind of torque (tests/nonsmooth_reference.py): linear
and cubic interpolation in tables, switches and pulses, kinks in the angular velocity,
and smooth torques to count steps. References are DOP853 in short steps, started anew at
each break. They are made once, which takes some minutes, and are stored in the system's
folder of temporary files.

At the angle of turn phi the promise is rtol (1 + phi) for the relative errors of energy
and space angular momentum, and ten times that for the state of a regular motion. All of
these motions are regular. `--declare` passes the breaks to `simulate` as `jumps`. Steps
are those of 16 motions in which no time but the end is asked for.
"""

import functools
import hashlib
import inspect
import pathlib
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import common
import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jrigid as jr

sys.path.append(str(pathlib.Path(__file__).parent.parent / "tests"))
import nonsmooth_reference  # pyright: ignore[reportMissingImports]

KINDS = nonsmooth_reference.KINDS
RTOLS, DURATIONS = (1e-8, 1e-11), (5.0, 500.0)
MOTIONS = 16
SOLVERS = {"default": None, "dopri8": diffrax.Dopri8(), "tsit5": diffrax.Tsit5()}
QUANTITIES = ("energy", "momentum", "state")


class Cases(NamedTuple):
    """Motions side by side, and their references: a motion to each first index."""

    motion: Any
    reference: Any


@functools.cache
def cases(kind: str, duration: float) -> Cases:
    """The motions of a kind, from the cache or made."""
    source = pathlib.Path(str(nonsmooth_reference.__file__)).read_bytes()
    key = hashlib.sha256(source).hexdigest()[:12]
    name = f"jrigid-nonsmooth-{kind}-{duration:g}-{MOTIONS}-{key}.npz"
    path = pathlib.Path(tempfile.gettempdir()) / name
    if not path.exists():
        print(f"making {path}", file=sys.stderr)
        arrays = nonsmooth_reference.arrays_of(kind, MOTIONS, duration)
        np.savez_compressed(path, **arrays)
    with np.load(path) as file:
        return Cases(*nonsmooth_reference.from_arrays(dict(file)))


@functools.cache
def program(simulate: Callable[..., Any], kind: str, solver: str, declare: bool) -> Any:
    """A compiled function of motions, times and rtol: states, counts and success."""

    def one(motion: Any, ts: Any, rtol: Any) -> Any:
        body = jr.RigidBody(motion.moments, nonsmooth_reference.TORQUES[kind])
        state0 = jr.State(motion.attitude, motion.omega)
        options: dict[str, Any] = {
            "solver": SOLVERS[solver],
            "rtol": rtol,
            "throw": False,
        }
        if declare and motion.breaks.size:
            options["jumps"] = motion.breaks
        trajectory = simulate(body, state0, ts, motion.parameters, **options)
        states = trajectory.states.attitude, trajectory.states.omega
        return states, trajectory.stats, trajectory.result == jr.RESULTS.successful

    return jax.jit(jax.vmap(one, in_axes=(0, 0, None)))


rotate = jax.jit(jnp.vectorize(jr.rotation.rotate, signature="(4),(3)->(3)"))
_angle = jnp.vectorize(jr.rotation.angle_between, signature="(4),(4)->()")
angle_between = jax.jit(_angle)


def size(vectors: Any) -> np.ndarray:
    """Length of vectors."""
    return np.linalg.norm(vectors, axis=-1)


def relative_errors(these: Cases, attitudes: Any, omegas: Any) -> dict[str, np.ndarray]:
    """Errors of energy, angular momentum and state, for each motion and time.

    Each is relative to the larger of the size at the start and the size now. The error
    of the state is the larger of that of the angular velocity and the angle between the
    attitudes [rad].
    """
    motion, reference = these

    def invariants(attitudes: Any, omegas: Any) -> tuple[np.ndarray, np.ndarray]:
        body = motion.moments[:, None] * omegas
        energies = 0.5 * np.sum(body * omegas, axis=-1)
        return energies, np.asarray(rotate(attitudes, body))

    attitudes, omegas = np.asarray(attitudes), np.asarray(omegas)
    energy, momentum = invariants(attitudes, omegas)
    true_energy, true_momentum = invariants(reference.attitude, reference.omega)
    starts = motion.attitude[:, None], motion.omega[:, None]
    start_energy, start_momentum = invariants(*starts)
    turning = np.maximum(size(reference.omega), size(starts[1]))
    of_omega = size(omegas - reference.omega) / turning
    angle = np.asarray(angle_between(attitudes, reference.attitude))
    largest_momentum = np.maximum(size(true_momentum), size(start_momentum))
    return {
        "energy": np.abs(energy - true_energy) / np.maximum(true_energy, start_energy),
        "momentum": size(momentum - true_momentum) / largest_momentum,
        "state": np.maximum(of_omega, angle),
    }


def measure(
    simulate: Callable[..., Any],
    kind: str,
    rtol: float,
    duration: float,
    *,
    solver: str = "default",
    declare: bool = False,
) -> dict[str, Any]:
    """Errors in units of the promise, and steps, of the 16 motions of a kind.

    Programs are compiled once for each `simulate`, kind, solver and `declare`, and
    serve every rtol and duration. After a change of what `simulate` calls, pass another
    function object, or call `program.cache_clear()` and `jax.clear_caches()`.

    Args:
        simulate: `jrigid.simulate`, or what has its signature.
        kind: One of `KINDS`.
        rtol: Relative tolerance.
        duration: Length of the run [s], 5 or 500.
        solver: A name in `SOLVERS`.
        declare: Whether to pass the breaks as `jumps`.

    Returns:
        `energy`, `momentum`, `state`: for each motion the largest error in units of the
        promise. `steps`, `attempts`: accepted steps and all of them, for each motion.
        `ok`: whether all motions succeeded. `seconds`: wall time of the two runs.
    """
    these = cases(kind, duration)
    run = program(simulate, kind, solver, declare)
    # Steps end at the times asked for. With the end alone they are as long as can be.
    ts = these.reference.ts
    ends = np.broadcast_to(ts[:, -1:], ts.shape)
    floor = 100 * np.finfo(float).eps
    promise = max(rtol, floor) * (1 + these.reference.radians)
    worst = {name: np.zeros(MOTIONS) for name in QUANTITIES}
    count, is_fine, start = {}, True, time.perf_counter()
    for times, is_way in ((ts, True), (ends, False)):
        states, count, ok = jax.block_until_ready(run(these.motion, times, rtol))
        is_fine = is_fine and bool(np.all(ok))
        at = slice(None) if is_way else slice(-1, None)
        errors = relative_errors(these, *states)
        for name, error in errors.items():
            allowed = promise * (10 if name == "state" else 1)
            found = np.max((error / allowed)[:, at], axis=1)
            # A failed motion has NaN.
            found = np.where(np.isnan(found), np.inf, found)
            worst[name] = np.maximum(worst[name], found)
    seconds = time.perf_counter() - start
    steps = np.asarray(count["num_accepted_steps"])
    attempts = np.asarray(count["num_steps"])
    return worst | {
        "steps": steps,
        "attempts": attempts,
        "ok": is_fine,
        "seconds": seconds,
    }


def row(kind: str, rtol: float, duration: float, found: dict[str, Any]) -> list[Any]:
    """What is printed of a measurement."""
    of_errors = [f(found[name]) for name in QUANTITIES for f in (np.max, np.median)]
    counts = [int(np.sum(found[name])) for name in ("steps", "attempts")]
    return [kind, f"{duration:g}", f"{rtol:.0e}", *map(float, of_errors), *counts]


HEADER = [
    *("kind", "T [s]", "rtol", "energy worst", "median", "L worst", "median"),
    *("state worst", "median", "steps", "attempts"),
]


def main(options: Any) -> None:
    """Print the table."""
    if options.declare and "jumps" not in inspect.signature(jr.simulate).parameters:
        sys.exit("--declare needs a simulate() that has the argument `jumps`.")
    rows = []
    for kind in options.kinds:
        for duration in options.duration:
            for rtol in options.rtol:
                found = measure(
                    jr.simulate,
                    kind,
                    rtol,
                    duration,
                    solver=options.solver,
                    declare=options.declare,
                )
                rows.append(row(kind, rtol, duration, found))
                how = f"{found['seconds']:.1f} s"
                if not found["ok"]:
                    how += ", some FAILED"
                print(*rows[-1][:3], how, file=sys.stderr)
    declared = "yes" if options.declare else "no"
    text = f"Solver: {options.solver}; breaks declared: {declared}.\n\n"
    text += common.table(HEADER, rows)
    title = "Torques that are not smooth: errors in units of the promise"
    packages = ("jrigid", "jax", "diffrax", "scipy")
    option = "--declare" if options.declare else ""
    common.report("nonsmooth", title, text, packages, options.write, option)


if __name__ == "__main__":
    parser = common.arguments(__doc__)
    parser.add_argument("--rtol", type=float, nargs="+", default=RTOLS)
    parser.add_argument("--duration", type=float, nargs="+", default=DURATIONS)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--solver", choices=SOLVERS, default="default")
    parser.add_argument("--declare", action="store_true", help="pass breaks as `jumps`")
    main(parser.parse_args())
