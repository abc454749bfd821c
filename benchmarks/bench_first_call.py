"""The first call of `simulate` and the runs after it, beside hand-written diffrax.

    python benchmarks/bench_first_call.py [--quick] [--write] [--throw] [--work NAME]

Two works. `top`: the heavy asymmetric top I = (1, 2, 3), weight 1, lever
(0.3, 0.1, 0.5), its state at T = 100, derivatives in the three moments. `dipole`: a
user's own torque, a dipole in a turning field, its states at 11 times to T = 20,
derivatives in the dipole. Five programs of each: the value, the gradient of a weighted
sum of all outputs, the Jacobian (`jax.jacfwd` and `ForwardMode`), and value and
gradient of 1,000 lanes that differ in their initial rates.

The peer is what a user of diffrax writes by hand: Dopri8, rtol = atol = 1e-9. Compile
times are CPU seconds of the process. Every repetition traces new function objects after
`jax.clear_caches()`, and the two take turns. Errors are relative, the median over the
first 100 lanes, against the peer at 1e-13. "At equal error" interpolates the peer's run
time between the two tolerances (powers of ten) whose errors enclose ours.

Functions run with `throw=False`; `--throw` leaves both at their defaults.
"""

import gc
import pathlib
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import common
import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import jrigid as jr

sys.path.append(str(pathlib.Path(__file__).parent.parent / "tests"))
import helpers  # pyright: ignore[reportMissingImports]

MOMENTS = np.array([1.0, 2.0, 3.0])
LEVER = np.array([0.3, 0.1, 0.5])
DOWN = np.array([0.0, 0.0, -1.0])
DIPOLE = np.array([0.3, 0.1, 0.5])
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
OMEGA = np.array([0.3, 0.5, 0.8])
LANES = np.random.default_rng(0).normal(size=(1000, 3))

ERROR_LANES = 100

RTOL = 1e-8
PEER_TOLERANCE = 1e-9
REFERENCE_TOLERANCE = 1e-13
# Beyond so many CPU seconds a compilation is repeated three times, not five.
COSTLY_COMPILE = 20.0
# Runs of one program take about so many seconds in all, but there are five at least,
# and two of those that last longer than the second figure.
RUN_BUDGET, LONG_RUN = 2.0, 8.0

# (parameter, omega0) -> outputs
Run = Callable[[Any, Any], Any]


class Settings(NamedTuple):
    """How one program integrates."""

    tolerance: Any  # rtol of ours, rtol and atol of the peer
    adjoint: diffrax.AbstractAdjoint | None
    throw: bool


@dataclass(frozen=True)
class Work:
    """One problem, twice, and the figures to reach."""

    title: str
    parameter: np.ndarray
    ours: Callable[[Settings], Run]
    peer: Callable[[Settings], Run]
    kernels: dict[str, int]
    run_time: dict[str, float]


class Cost(NamedTuple):
    """CPU seconds of one compilation."""

    trace: float
    lower: float
    xla: float

    @property
    def total(self) -> float:
        """All three."""
        return sum(self)


class Timing(NamedTuple):
    """Milliseconds of a run."""

    wall: float
    wall_median: float
    cpu: float


def turning_field(t):
    return jnp.stack([jnp.cos(0.7 * t), jnp.sin(0.7 * t), jnp.zeros_like(t)])


def rotated_back(attitude, vector):
    """A vector of space in components of the body."""
    scalar, axial = attitude[0], attitude[1:]
    twice = 2.0 * jnp.cross(axial, vector)
    return vector - scalar * twice + jnp.cross(axial, twice)


def rates_of(moments, torque, y):
    """Right-hand sides for attitude and rates in one array."""
    a, b, c, d, p, q, r = y
    attitude_rate = 0.5 * jnp.stack(
        [
            -b * p - c * q - d * r,
            a * p + c * r - d * q,
            a * q + d * p - b * r,
            a * r + b * q - c * p,
        ]
    )
    omega = y[4:]
    omega_rate = (jnp.cross(moments * omega, omega) + torque) / moments
    return jnp.concatenate([attitude_rate, omega_rate])


def by_hand(field, ts, parameter, omega, settings):
    """What a user of diffrax writes."""
    adjoint = settings.adjoint or diffrax.RecursiveCheckpointAdjoint()
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        diffrax.Dopri8(),
        0.0,
        float(ts[-1]),
        0.01,
        jnp.concatenate([jnp.asarray(UPRIGHT), omega]),
        parameter,
        saveat=diffrax.SaveAt(ts=jnp.asarray(ts)),
        stepsize_controller=diffrax.PIDController(
            rtol=settings.tolerance, atol=settings.tolerance
        ),
        adjoint=adjoint,
        max_steps=100_000,
        throw=settings.throw,
    )
    return solution.ys


def by_jrigid(body, ts, omega, args, settings):
    trajectory = jr.simulate(
        body,
        jr.State(UPRIGHT, omega),
        ts,
        args,
        rtol=settings.tolerance,
        adjoint=settings.adjoint,
        throw=settings.throw,
    )
    states = trajectory.states
    return jnp.concatenate([states.attitude, states.omega], axis=1)


TOP_TIMES = np.array([100.0])
DIPOLE_TIMES = np.linspace(0.0, 20.0, 11)


def top_ours(settings):
    def run(moments, omega):
        body = jr.RigidBody(moments, jr.torques.UniformGravity(1.0, LEVER, DOWN))
        return by_jrigid(body, TOP_TIMES, omega, None, settings)

    return run


def top_peer(settings):
    def field(_t, y, moments):
        torque = jnp.cross(LEVER, rotated_back(y[:4], DOWN))
        return rates_of(moments, torque, y)

    return lambda moments, omega: by_hand(field, TOP_TIMES, moments, omega, settings)


def dipole_ours(settings):
    def torque(t, state, args):
        return jnp.cross(
            args, jr.rotation.rotate_inverse(state.attitude, turning_field(t))
        )

    def run(dipole, omega):
        body = jr.RigidBody(MOMENTS, torque)
        return by_jrigid(body, DIPOLE_TIMES, omega, dipole, settings)

    return run


def dipole_peer(settings):
    def field(t, y, dipole):
        torque = jnp.cross(dipole, rotated_back(y[:4], turning_field(t)))
        return rates_of(MOMENTS, torque, y)

    return lambda dipole, omega: by_hand(field, DIPOLE_TIMES, dipole, omega, settings)


COMPILE_TARGETS = {
    "value": 1.5,
    "gradient": 1.0,
    "Jacobian": 1.2,
    "vmapped value": 1.5,
    "vmapped gradient": 1.2,
}
WORKS = {
    "top": Work(
        "Heavy asymmetric top, T = 100",
        MOMENTS,
        top_ours,
        top_peer,
        kernels={},
        # 1.2 times what it was before the redesign: .9, .5, .5.
        run_time={
            "value": 1.08,
            "gradient": 0.6,
            "Jacobian": 0.6,
            "vmapped gradient": 0.25,
        },
    ),
    "dipole": Work(
        "A user's torque, a dipole in a turning field, T = 20, 11 times",
        DIPOLE,
        dipole_ours,
        dipole_peer,
        kernels={
            "value": 100,
            "gradient": 300,
            "vmapped value": 130,
            "vmapped gradient": 350,
        },
        run_time={"value": 1.0, "gradient": 1.0, "vmapped gradient": 0.25},
    ),
}


def weighted_sum(run):
    """One number that depends on all outputs."""

    def total(parameter, omega):
        outputs = run(parameter, omega)
        weights = np.cos(np.arange(outputs.size)).reshape(outputs.shape)
        return jnp.sum(weights * outputs)

    return total


def program(what, make, tolerance, throw):
    """A function of parameter and rates that jax has not seen before."""
    adjoint = diffrax.ForwardMode() if what == "Jacobian" else None
    run = make(Settings(tolerance, adjoint, throw))
    if what == "Jacobian":
        return jax.jacfwd(run)
    one = jax.grad(weighted_sum(run)) if "gradient" in what else run
    if "vmapped" in what:
        return jax.vmap(one, in_axes=(None, 0))
    return lambda parameter, omega: one(parameter, omega)


def compiled(function, *arguments):
    """The compiled program, and what that cost with empty caches."""
    jax.clear_caches()
    gc.collect()
    clock = [time.process_time()]
    traced = jax.jit(function).trace(*arguments)
    clock.append(time.process_time())
    lowered = traced.lower()
    clock.append(time.process_time())
    executable = lowered.compile()
    clock.append(time.process_time())
    return executable, Cost(*np.diff(clock).tolist())


def turns(cases):
    """Run times of functions without arguments that take turns."""
    longest = 0.0
    for case in cases.values():
        start = time.perf_counter()
        jax.block_until_ready(case())
        longest = max(longest, time.perf_counter() - start)
    wall = {name: [] for name in cases}
    cpu = {name: [] for name in cases}
    repeats = int(np.clip(RUN_BUDGET / longest, 5, 100)) if longest < LONG_RUN else 2
    for _ in range(repeats):
        for name, case in cases.items():
            start = time.perf_counter(), time.process_time()
            jax.block_until_ready(case())
            wall[name].append(1e3 * (time.perf_counter() - start[0]))
            cpu[name].append(1e3 * (time.process_time() - start[1]))
    return {
        name: Timing(min(wall[name]), float(np.median(wall[name])), min(cpu[name]))
        for name in cases
    }


def relative_error(outputs, reference, lanes):
    """Median over the first lanes of |outputs - reference| / |reference|."""
    rows = (lanes, -1) if lanes else (1, -1)
    outputs = np.asarray(outputs)
    outputs = (outputs[:lanes] if lanes else outputs).reshape(rows)
    reference = np.asarray(reference).reshape(rows)
    off = np.linalg.norm(outputs - reference, axis=1)
    return float(np.median(off / np.linalg.norm(reference, axis=1)))


def enclosing(error_at, error):
    """Exponents x, x + 1 and errors of tolerances 10**-x that enclose an error."""
    exponent = round(-np.log10(PEER_TOLERANCE))
    errors = {exponent: error_at(exponent)}
    while errors[exponent] > error and exponent < 12:
        exponent += 1
        errors[exponent] = error_at(exponent)
    while min(errors) == exponent and errors[exponent] < error and exponent > 4:
        exponent -= 1
        errors[exponent] = error_at(exponent)
    ordered = sorted(errors)
    tighter = next((x for x in ordered if errors[x] <= error), ordered[-1])
    looser = max((x for x in ordered if x < tighter), default=tighter)
    return {x: errors[x] for x in (looser, tighter)}


def at_equal_error(errors, times, error):
    """A time between two, by logarithms; that of the nearer one outside."""
    order = sorted(errors, key=errors.get)
    x = np.log([errors[k] for k in order])
    y = np.log([times[k] for k in order])
    return float(np.exp(np.interp(np.log(error), x, y)))


def measured(work, what, repeats, throw):
    """Rows of the table of times and of the table of ratios, for one program."""
    omega = LANES if "vmapped" in what else OMEGA
    inputs = jnp.asarray(work.parameter), jnp.asarray(omega)
    peers = {"jrigid": (work.ours, RTOL), "diffrax": (work.peer, PEER_TOLERANCE)}
    executables = {}
    costs = {name: [] for name in peers}
    for i in range(repeats):
        spent = sum(x[0].total for x in costs.values() if x)
        if i >= 3 and spent > COSTLY_COMPILE:
            break
        for name, (make, tolerance) in peers.items():
            function = program(what, make, tolerance, throw)
            executables[name], cost = compiled(function, *inputs)
            costs[name].append(cost)
    kernels = {name: helpers.kernels(x.as_text()) for name, x in executables.items()}

    # The peer once more, its tolerance an argument.
    def at(tolerance, *inputs):
        return program(what, work.peer, tolerance, throw)(*inputs)

    peer_at = jax.jit(at)
    lanes = ERROR_LANES if omega.ndim == 2 else 0
    few = inputs[0], inputs[1][:lanes] if lanes else inputs[1]
    reference = peer_at(REFERENCE_TOLERANCE, *few)

    def error_at(exponent):
        outputs = peer_at(10.0**-exponent, *few)
        return relative_error(outputs, reference, lanes)

    errors = {
        name: relative_error(executable(*inputs), reference, lanes)
        for name, executable in executables.items()
    }
    near = enclosing(error_at, errors["jrigid"])
    cases = {n: (lambda x=x: x(*inputs)) for n, x in executables.items()}
    cases |= {x: (lambda x=x: peer_at(10.0**-x, *inputs)) for x in near}
    times = turns(cases)

    rows = []
    for name in peers:
        least = min(costs[name], key=lambda x: x.total)
        middle = float(np.median([x.total for x in costs[name]]))
        row = [what, name, *least, least.total, middle, len(costs[name])]
        rows.append([*row, kernels[name], *times[name], errors[name]])
    ours, theirs = rows
    equal_wall = at_equal_error(
        near, {x: times[x].wall for x in near}, errors["jrigid"]
    )
    equal_cpu = at_equal_error(near, {x: times[x].cpu for x in near}, errors["jrigid"])
    ratios = [
        what,
        ours[5] / theirs[5],
        ours[6] / theirs[6],
        COMPILE_TARGETS[what],
        f"{kernels['jrigid']} for {kernels['diffrax']}",
        work.kernels.get(what),
        times["jrigid"].wall / equal_wall,
        times["jrigid"].cpu / equal_cpu,
        work.run_time.get(what),
    ]
    return rows, ratios


TIMES_HEADER = [
    "program",
    "who",
    "trace s",
    "lower s",
    "XLA s",
    "all, min",
    "all, median",
    "of",
    "kernels",
    "run ms, min",
    "median",
    "CPU ms, min",
    "error",
]
RATIOS_HEADER = [
    "jrigid / diffrax",
    "compile, min",
    "median",
    "target",
    "kernels",
    "target",
    "run at equal error, wall",
    "CPU",
    "target",
]


def section(work, repeats, throw):
    rows, ratios = [], []
    for what in COMPILE_TARGETS:
        two, ratio = measured(work, what, repeats, throw)
        rows += two
        ratios.append(ratio)
        print(common.table(TIMES_HEADER, two), file=sys.stderr, flush=True)
    parts = [
        work.title,
        common.table(RATIOS_HEADER, ratios),
        common.table(TIMES_HEADER, rows),
    ]
    return "\n\n".join(parts)


def main():
    parser = common.arguments(__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="compile once, not five times"
    )
    parser.add_argument(
        "--throw", action="store_true", help="raise errors, as by default"
    )
    parser.add_argument("--work", choices=list(WORKS), help="only this work")
    options = parser.parse_args()
    jax.config.update("jax_enable_compilation_cache", False)
    # What a process compiles first also starts the compiler.
    jax.block_until_ready(jax.jit(jnp.sin)(1.0))
    works = [options.work] if options.work else list(WORKS)
    repeats = 1 if options.quick else 5
    text = "\n\n".join(section(WORKS[x], repeats, options.throw) for x in works)
    packages = ["jax", "diffrax", "equinox", "numpy"]
    title = "The first call, and the runs after it"
    common.report_by_jax("first_call", title, text, packages, options.write)


if __name__ == "__main__":
    main()
