"""Ten thousand heavy asymmetric tops to T = 100: the error of the energy against time.

    taskset -c 0 python benchmarks/bench_lanes.py [--write] [--lanes N]
    python benchmarks/bench_lanes.py --memory 100000

I = (1, 2, 3), weight 1, lever (0.3, 0.1, 0.5), rates normal with unit variance.
`jax.vmap` of `jrigid.simulate`, of a hand-written `diffeqsolve` (Dopri8), heyoka's
batch integrator in the same variables (quaternion and rates) and in Euler-Poisson's.
Then lanes that are not alike: rates over a factor of 20, beside the sum of what each of
four kinds takes alone; one lane that fails at once and one that needs a hundred times
the steps; gradients and Jacobians in the three moments; two devices of one process. Run
it on one core: heyoka is timed on one thread.
"""

import os
import pathlib
import resource
import subprocess
import sys
import time
from typing import Any

import common
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import peers

import jrigid as jr

MOMENTS, LEVER, END = (1.0, 2.0, 3.0), (0.3, 0.1, 0.5), 100.0
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
BODY = jr.RigidBody(
    np.array(MOMENTS),
    jr.torques.UniformGravity(1.0, np.array(LEVER), np.array([0.0, 0.0, -1.0])),
)
REPEATS = 3


def cross(a, b):
    return [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]


def spin_up(w, up):
    """Euler's equations for symbols or numbers."""
    first = cross([m * x for m, x in zip(MOMENTS, w, strict=True)], w)
    return [
        (a + b) / m for a, b, m in zip(first, cross(up, LEVER), MOMENTS, strict=True)
    ]


def by_poisson(*z):
    return [*spin_up(z[:3], z[3:]), *cross(z[3:], z[:3])]


def up_of(a, b, c, d):
    return [2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d]


def by_quaternion(*z):
    (p, q, r), (a, b, c, d) = z[:3], z[3:]
    rates = (
        -b * p - c * q - d * r,
        a * p + c * r - d * q,
        a * q + d * p - b * r,
        a * r + b * q - c * p,
    )
    return [*spin_up(z[:3], up_of(a, b, c, d)), *(0.5 * x for x in rates)]


def energy_error(w, up, w0):
    """Median relative error of the energy; all start upright."""
    energy = 0.5 * (np.array(MOMENTS) * w**2).sum(1) + up @ np.array(LEVER)
    start = 0.5 * (np.array(MOMENTS) * w0**2).sum(1) + LEVER[2]
    return float(np.median(np.abs(energy / start - 1)))


def ours(rtol):
    @jax.jit
    @jax.vmap
    def run(omega):
        state = jr.State(UPRIGHT, omega)
        trajectory = jr.simulate(BODY, state, END, rtol=rtol, throw=False)
        return trajectory.final_state, trajectory.stats["num_steps"]

    return run


def by_hand(omega, tolerance):
    solution: Any = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda _t, y, _args: jnp.stack(by_quaternion(*y))),
        diffrax.Dopri8(),
        0.0,
        END,
        0.01,
        jnp.concatenate([omega, jnp.asarray(UPRIGHT)]),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=100_000,
    )
    return solution.ys[0]


def up_in_body(attitude):
    return np.stack(up_of(*np.asarray(attitude).T), 1)


def seconds(function: Any, *arguments: Any) -> tuple[float, float, Any]:
    """Compile time and the least of some runs [ms]; the answer."""
    start = time.perf_counter()
    answer = jax.block_until_ready(function(*arguments))
    first, least = time.perf_counter() - start, np.inf
    for _ in range(REPEATS):
        start = time.perf_counter()
        answer = jax.block_until_ready(function(*arguments))
        least = min(least, time.perf_counter() - start)
    return 1e3 * (first - least), 1e3 * least, answer


def one_size(lanes):
    """Time against error, all ways."""
    w0 = np.random.default_rng(0).normal(size=(lanes, 3))
    rows = []
    for rtol in (1e-6, 1e-8, 1e-10, 1e-12):
        compile_ms, least, (state, steps) = seconds(ours(rtol), w0)
        error = energy_error(np.asarray(state.omega), up_in_body(state.attitude), w0)
        each = 1e6 * least / float(jnp.sum(steps))
        rows.append(
            [f"vmap(jrigid.simulate), rtol {rtol:g}", compile_ms, least, each, error]
        )
    for tolerance in (1e-9, 1e-11):
        some = w0[: lanes // 10]
        program = jax.jit(jax.vmap(lambda w, x=tolerance: by_hand(w, x)))
        compile_ms, least, ends = seconds(program, some)
        ends = np.asarray(ends)
        error = energy_error(ends[:, :3], up_in_body(ends[:, 3:]), some)
        name = (
            f"vmap of hand-written diffrax, Dopri8, {tolerance:g} (ten times a tenth)"
        )
        rows.append([name, compile_ms, 10 * least, None, error])
    up = np.tile([0.0, 0.0, 1.0], (lanes, 1))
    starts = {
        "quaternion": (
            by_quaternion,
            np.concatenate([w0, np.tile(UPRIGHT, (lanes, 1))], 1),
        ),
        "Euler-Poisson": (by_poisson, np.concatenate([w0, up], 1)),
    }
    for name, (rates, begin) in starts.items():
        for tolerance in (1e-9, 1e-11, 1e-13, 1e-15):
            case, compile_ms = peers.by_heyoka(rates, begin, END, tolerance)
            if case is None:
                break
            _, least, end = seconds(case)
            up = up_in_body(end[:, 3:]) if name == "quaternion" else end[:, 3:]
            error = energy_error(end[:, :3], up, w0)
            rows.append(
                [
                    f"heyoka, batch, {name}, {tolerance:g}",
                    compile_ms,
                    least,
                    None,
                    error,
                ]
            )
    return rows


def unlike(lanes):
    """What a lane costs that is not like the others."""
    w0 = np.random.default_rng(1).normal(size=(lanes, 3))
    run = ours(1e-8)
    plain = seconds(run, w0)[1]
    kinds = [
        seconds(run, factor * w0[k::4])[1]
        for k, factor in enumerate((1.0, 3.0, 9.0, 20.0))
    ]
    mixed = w0 * np.tile([1.0, 3.0, 9.0, 20.0], lanes // 4)[:, None]
    rows = [
        [
            "rates over a factor of 20",
            seconds(run, mixed)[1],
            sum(kinds),
            "sum of four kinds alone",
        ]
    ]
    bad, slow = w0.copy(), w0.copy()
    bad[7], slow[7] = np.nan, 300.0
    alone = seconds(run, np.tile(slow[7:8], (8, 1)))[1]
    rows.append(["one lane fails at once", seconds(run, bad)[1], plain, "without it"])
    rows.append(
        ["one lane needs 100 times the steps", seconds(run, slow)[1], alone, "it alone"]
    )
    return [[*x[:2], x[1] / x[2], x[3]] for x in rows]


def derivatives(lanes):
    """Of the last rates in the three moments, beside the value."""
    w0 = np.random.default_rng(2).normal(size=(lanes, 3))

    def end(moments, omega, adjoint=None):
        body = jr.RigidBody(moments, BODY.torque)
        state = jr.State(UPRIGHT, omega)
        return jr.simulate(
            body, state, END, adjoint=adjoint, throw=False
        ).final_state.omega

    def gradient(moments, omega):
        return jax.grad(lambda x: end(x, omega)[0])(moments)

    def jacobian(moments, omega):
        return jax.jacfwd(lambda x: end(x, omega, diffrax.ForwardMode()))(moments)

    rows = []
    for name, starts in (("one", w0[0]), (str(lanes), w0)):
        value = 1.0
        for what, function in (
            ("value", end),
            ("gradient", gradient),
            ("Jacobian", jacobian),
        ):
            one = lambda omega, f=function: f(jnp.asarray(MOMENTS), omega)  # noqa: E731
            program = jax.jit(one if starts.ndim == 1 else jax.vmap(one))
            compile_ms, least, _ = seconds(program, starts)
            value = least if what == "value" else value
            rows.append([f"{name}: {what}", compile_ms, least, least / value])
    return rows


def sharded(lanes):
    """On one device and on two of this process, which may use two cores."""
    os.sched_setaffinity(0, range(2))
    w0, run = np.random.default_rng(0).normal(size=(lanes, 3)), ours(1e-8)
    mesh, spec = jax.sharding.Mesh(np.array(jax.devices()), "lanes"), jax.P("lanes")
    both = jax.shard_map(run, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    print(*(seconds(function, w0)[1] for function in (run, jax.jit(both))))


def on_two_devices(lanes):
    """What a process with two devices says."""
    done = subprocess.run(
        [sys.executable, "-c", f"import bench_lanes; bench_lanes.sharded({lanes})"],
        env=os.environ | {"JAX_NUM_CPU_DEVICES": "2"},
        cwd=pathlib.Path(__file__).parent,
        check=True,
        capture_output=True,
        text=True,
    )
    one, two = map(float, done.stdout.split())
    return [
        ["one device", one, 1.0],
        ["two devices, by `jax.shard_map`", two, two / one],
    ]


def memory(lanes):
    """Seconds and peak memory [MiB] of gradients in three moments of each motion."""
    w0 = np.random.default_rng(2).normal(size=(lanes, 3))

    def end(moments, omega):
        body, state = jr.RigidBody(moments, BODY.torque), jr.State(UPRIGHT, omega)
        return jr.simulate(body, state, END, throw=False).final_state.omega[0]

    start = time.perf_counter()
    found = jax.jit(jax.vmap(jax.grad(end)))(np.tile(MOMENTS, (lanes, 1)), w0)
    assert jnp.isfinite(found).all()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    seconds = time.perf_counter() - start
    print(f"{lanes} gradients: {seconds:.0f} s with compilation, peak {peak:.0f} MiB")


def main(lanes, write):
    text = common.table(
        [
            f"{lanes} heavy asymmetric tops",
            "compile ms",
            "min ms",
            "ns a step",
            "energy, median",
        ],
        one_size(lanes),
    )
    header = [f"{lanes // 5 // 4 * 4} of them", "min ms", "ratio", "to"]
    text += "\n\n" + common.table(header, unlike(lanes // 5 // 4 * 4))
    header = ["T = 100, rtol 1e-8", "compile ms", "min ms", "in values"]
    text += "\n\n" + common.table(header, derivatives(lanes // 5 // 4 * 4))
    header = [f"{lanes} of them, rtol 1e-8", "min ms", "in those of one"]
    text += "\n\n" + common.table(header, on_two_devices(lanes))
    packages = ["jax", "diffrax", "numpy", *(["heyoka"] if "heyoka" in text else [])]
    common.report("lanes", "Many motions at once", text, packages, write)


if __name__ == "__main__":
    parser = common.arguments(__doc__)
    parser.add_argument("--lanes", type=int, default=10_000)
    parser.add_argument(
        "--memory", type=int, help="peak memory of so many gradients, alone"
    )
    options = parser.parse_args()
    if options.memory:
        memory(options.memory)
    else:
        main(options.lanes, options.write)
