"""Maps of stability: ten million linear points, and 128 x 128 motions by MEGNO.

Linear: the square of the growth rate about an axis over (I2/I1, I3/I1), against
vectorised numpy; and DeBra and Delp's plane, growth rate and region. Peak memory of the
same map in 20 blocks and in 2, and of 20 blocks of a size against 2 blocks of that
size, each in a process of its own.

Nonlinear: a heavy top without symmetry (moments 1, 1.5, 0.7; lever 0.3, 0.1, 0.5;
weight 1), released at a tilt about x with a spin about its third axis, 128 x 128 of
them, followed to T = 200 with one small motion beside each. Peers do the same in
Euler-Poisson variables: heyoka's batch Taylor integrator with the small motion's
equations written out, and with `var_ode_sys` (all six directions, which is what it
offers); scipy's DOP853. From them only the growth at the end is taken. "Thread for
thread": run as `taskset -c 0 python benchmarks/bench_stability.py`.
"""

import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import common
import jax
import jax.numpy as jnp
import numpy as np
import peers
import scipy.integrate

import jrigid as jr

MOMENTS, LEVER = (1.0, 1.5, 0.7), (0.3, 0.1, 0.5)
SIDE, END, STEPS = 128, 200.0, 800
TILTS, SPINS = np.linspace(0.05, 3.1, SIDE), np.linspace(0.1, 4.0, SIDE)
BODY = jr.RigidBody(
    np.array(MOMENTS),
    jr.torques.UniformGravity(1.0, np.array(LEVER), np.array([0.0, 0.0, -1.0])),
)
BY_SCIPY = 6


def square(second, third):
    return jr.stability.growth_rate_squared(jnp.stack([1.0, second, third]), 2, 1.0)


def satellite(roll, yaw):
    """DeBra and Delp's plane: k_R and k_Y."""
    b = (1 - yaw) / (1 - roll)
    moments = jnp.stack([jnp.ones_like(b), b, b + yaw])
    found = jr.stability.satellite_stability(moments)
    return found.growth_rate, found.region


def by_numpy(second, third):
    """As long as the grid, the formula with its broadcasting."""
    return (second[:, None] - third[None, :]) * (third[None, :] - 1.0) / second[:, None]


def linear():
    """Rows of ten million points."""
    axes = {"second": np.linspace(0.3, 3.0, 3200), "third": np.linspace(0.3, 3.0, 3200)}
    plane = {
        "roll": np.linspace(-0.99, 0.99, 3200),
        "yaw": np.linspace(-0.99, 0.99, 3200),
    }
    size = 2**20
    maps = {
        "growth rate squared": lambda: jr.stability.stability_map(
            square, axes, block_size=size
        ),
        "satellite, rate and region": lambda: jr.stability.stability_map(
            satellite, plane, block_size=size
        ),
    }
    rows = []
    first = {}
    for name, case in maps.items():
        start = time.perf_counter()
        case()
        first[name] = (time.perf_counter() - start) * 1e3
    cases: dict[str, Callable[[], Any]] = {
        name: lambda c=c: c().valid.size for name, c in maps.items()
    }
    cases["numpy, growth rate squared"] = lambda: by_numpy(*axes.values()).size
    for name, (least, median, _) in common.timed(cases, repeats=5).items():
        compile_ms = first[name] - median if name in first else None
        rows.append([f"10,240,000 points: {name}", compile_ms, least, median, None])
    ours = maps["growth rate squared"]().values
    assert np.abs(ours - by_numpy(*axes.values())).max() < 1e-13
    return rows


def peak_memory(side, block):
    """Peak of the resident memory of a process that makes one map [MiB]."""
    code = (
        "import sys; sys.path.insert(0, 'benchmarks');"
        "import numpy as np, bench_stability as b, jrigid as jr;"
        f"x = np.linspace(0.3, 3.0, {side});"
        "jr.stability.stability_map(b.satellite, {'roll': x / 4, 'yaw': -x / 4},"
        f" block_size={block});"
        "print([x for x in open('/proc/self/status') if 'VmHWM' in x][0].split()[1])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return float(done.stdout) / 1024


def point(tilt, spin):
    axis = jnp.array([1.0, 0.0, 0.0])
    state = jr.State(jr.rotation.exp(tilt * axis), spin * jnp.array([0.0, 0.0, 1.0]))
    found = jr.stability.megno(BODY, state, END, STEPS, samples=4, throw=False)
    return found.megno, found.exponent, found.error


def rates(*z):
    """Euler-Poisson equations and those of a small motion, for symbols or numbers."""
    (w, u), (d, e) = (z[:3], z[3:6]), (z[6:9], z[9:])

    def cross(a, b):
        return [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]

    def momentum(a):
        return [m * x for m, x in zip(MOMENTS, a, strict=True)]

    pull, of_pull = cross(u, LEVER), cross(e, LEVER)  # lever x (-up)
    first = cross(momentum(w), w)
    second = [
        x + y for x, y in zip(cross(momentum(d), w), cross(momentum(w), d), strict=True)
    ]
    turn = [(a + b) / m for a, b, m in zip(first, pull, MOMENTS, strict=True)]
    of_turn = [(a + b) / m for a, b, m in zip(second, of_pull, MOMENTS, strict=True)]
    of_up = [x + y for x, y in zip(cross(e, w), cross(u, d), strict=True)]
    return [*turn, *cross(u, w), *of_turn, *of_up]


def starts():
    """Of the peers: rates, up in the body, and a small motion; the rows of the map."""
    tilt, spin = (x.reshape(-1) for x in np.meshgrid(TILTS, SPINS, indexing="ij"))
    zero, one = np.zeros_like(tilt), np.ones_like(tilt)
    up = [zero, np.sin(tilt), np.cos(tilt)]
    return np.stack(
        [zero, zero, spin, *up, 0.3 * one, 0.2 * one, 0.1 * one, one, zero, zero], 1
    )


def by_var_ode_sys(some):
    """With heyoka's own variational equations, in six directions, on some motions."""
    import heyoka as hy  # pyright: ignore[reportMissingImports]

    variables = hy.make_vars(*(f"x{i}" for i in range(6)))
    equations = rates(*variables, *([0.0] * 6))[:6]
    system = hy.var_ode_sys(
        list(zip(variables, equations, strict=True)), hy.var_args.vars
    )
    width = hy.recommended_simd_size()
    size = 6 + 36
    integrator = hy.taylor_adaptive_batch(
        system, np.zeros((size, width)), tol=1e-9, compact_mode=True
    )
    start = time.perf_counter()
    for first in range(0, len(some), width):
        integrator.set_time(0.0)
        integrator.state[:6] = some[first : first + width, :6].T
        integrator.state[6:] = np.eye(6).reshape(-1)[:, None]
        integrator.propagate_until(END)
    return (time.perf_counter() - start) * 1e3


def nonlinear():
    """Rows of 128 x 128 motions."""
    axes = {"tilt": TILTS, "spin": SPINS}
    lanes = SIDE * SIDE
    run = lambda: jr.stability.stability_map(point, axes, block_size=2048)  # noqa: E731
    start = time.perf_counter()
    run()
    first = (time.perf_counter() - start) * 1e3
    start = time.perf_counter()
    found = run()
    ours = (time.perf_counter() - start) * 1e3
    order = found.values[0]
    share = (
        f"{100 * np.mean(order > 5):.0f} % chaotic, {100 * np.mean(order < 3):.0f} % "
        "regular"
    )
    worst = (
        f"{share}; valid {100 * found.valid.mean():.0f} %; error "
        f"{found.values[2].max():.0e}"
    )
    rows = [["16,384 motions to T = 200: megno", first - ours, ours, ours, worst]]
    begin = starts()
    for tolerance in (1e-9, 1e-15):
        case, ms = peers.by_heyoka(rates, begin, END, tolerance)
        if case is None:
            break
        start = time.perf_counter()
        end = case()
        taken = (time.perf_counter() - start) * 1e3
        growth = np.log(np.linalg.norm(end[:, 6:], axis=1)) / END
        agree = np.corrcoef(growth, found.values[1].reshape(-1))[0, 1]
        note = f"growth rate agrees to a correlation of {agree:.3f}"
        rows.append([f"heyoka, one direction, {tolerance:g}", ms, taken, taken, note])
    if len(rows) > 1:
        some = begin[::64]
        taken = by_var_ode_sys(some) * len(begin) / len(some)
        rows.append(
            ["heyoka, var_ode_sys, 1e-9 (from a 64th)", None, taken, taken, None]
        )
    rng = np.random.default_rng(0)
    start = time.perf_counter()
    for y in begin[rng.choice(lanes, BY_SCIPY, replace=False)]:
        scipy.integrate.solve_ivp(
            lambda _, y: rates(*y), (0, END), y, method="DOP853", rtol=1e-9, atol=1e-9
        )
    taken = (time.perf_counter() - start) * 1e3 * lanes / BY_SCIPY
    rows.append([f"scipy DOP853, 1e-9 (from {BY_SCIPY})", None, taken, taken, None])
    return rows


def main(write):
    rows = linear() + nonlinear()
    text = common.table(["map", "compile ms", "min ms", "median ms", ""], rows)
    side, size = 2000, 2_000_000
    memory = [
        ["4,000,000 points in 2 blocks", peak_memory(side, size)],
        ["the same in 20 blocks", peak_memory(side, size // 10)],
        ["2 blocks of 200,000 points", peak_memory(632, 200_000)],
        ["20 blocks of 200,000 points", peak_memory(side, 200_000)],
    ]
    text += "\n\n" + common.table(
        ["growth rate and region: peak memory", "MiB"], memory
    )
    packages = ["jax", "diffrax", "numpy", "scipy"]
    if any("heyoka" in row[0] for row in rows):
        packages.append("heyoka")
    common.report("stability", "Maps of stability", text, packages, write)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main(common.arguments(__doc__).parse_args().write)
