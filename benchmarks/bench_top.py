"""The exact flow of Lagrange's top beside integrators.

10,000 tops to T = 100: I = (1, 1, 0.5), mgl = 1, tilt 0.5, omega standard normal with 5
added to the third component; final attitude and omega, their Jacobian and a gradient.
Peers: heyoka's batch Taylor integrator (one thread; `pip install heyoka`), hand-written
diffrax, and scipy's DOP853 on the first tops. Errors against 30-digit Taylor series
(tests/taylor_reference.py) on 20 tops. "Thread for thread": run as
`taskset -c 0 python benchmarks/bench_top.py`.

MuJoCo is quoted, not run: 67 ms for one such trajectory (C, RK4, steps of 1e-2), with
an error of 1e-8 of the energy.
"""

import functools
import pathlib
import sys
import time

import common
import jax
import jax.numpy as jnp
import numpy as np
import peers
import scipy.integrate

import jrigid as jr

sys.path.append(str(pathlib.Path(__file__).parent.parent / "tests"))
import taylor_reference  # pyright: ignore[reportMissingImports]

TOPS = 10_000
I1, I3, MGL, TILT, END = 1.0, 0.5, 1.0, 0.5, 100.0
LONG = 2e6 * np.pi / 5
ATTITUDE = np.array([np.cos(TILT / 2), np.sin(TILT / 2), 0.0, 0.0])
OMEGAS = np.random.default_rng(0).normal((0.0, 0.0, 5.0), size=(TOPS, 3))
INPUTS = np.concatenate([np.tile([I1, I3, MGL], (TOPS, 1)), OMEGAS], axis=1)
STARTS = np.concatenate([np.tile(ATTITUDE, (TOPS, 1)), OMEGAS], axis=1)
CHECKED = 20
BY_SCIPY = 5


def final(x, t):
    """State (7,) at time t of the top x[:3] with angular velocity x[3:]."""
    state = jr.top_motion(
        jr.SymmetricTop(*x[:3]), jr.State(ATTITUDE, x[3:]), t, throw=False
    )
    return jnp.concatenate([state.attitude, state.omega], axis=-1)


def loss(x, t):
    return jnp.sum(jax.vmap(final, (0, None))(x, t) ** 3)


def rates(w, x, y, z, a, b, c):
    """Of attitude and omega, for numbers, arrays and symbols."""
    slip = (I1 - I3) / I1 * c
    return [
        0.5 * (-x * a - y * b - z * c),
        0.5 * (w * a + y * c - z * b),
        0.5 * (w * b + z * a - x * c),
        0.5 * (w * c + x * b - y * a),
        slip * b + 2 * MGL / I1 * (y * z + w * x),
        -slip * a - 2 * MGL / I1 * (x * z - w * y),
        0.0 * c,
    ]


@functools.cache
def exact(k):
    q, w = taylor_reference.taylor_top(I1, I3, MGL, ATTITUDE, OMEGAS[k], END)
    return np.array([*q, *w], float)


def error(states):
    """Largest error of attitude and omega over the first tops."""
    worst = 0.0
    for k, found in enumerate(np.asarray(states)[:CHECKED]):
        sign = np.where(np.arange(7) < 4, np.sign(exact(k)[:4] @ found[:4]), 1.0)
        worst = max(worst, np.max(np.abs(found - sign * exact(k))))
    return worst


def by_scipy():
    """The first tops, in milliseconds for all of them."""
    start = time.perf_counter()
    states = [
        scipy.integrate.solve_ivp(
            lambda _t, y: rates(*y), (0, END), y, method="DOP853", rtol=1e-9, atol=1e-9
        ).y[:, -1]
        for y in STARTS[:BY_SCIPY]
    ]
    return np.array(states), (time.perf_counter() - start) * 1e3 * TOPS / BY_SCIPY


def main(write: bool) -> None:
    rows, cases, compile_ms = [], {}, {}

    def add(name, function, *arguments):
        program, compile_ms[name] = common.compiled(function, *arguments)
        cases[name] = lambda: program(*arguments)

    add("value, T = 100", jax.vmap(final, (0, None)), INPUTS, END)
    add("value, 10^6 turns", jax.vmap(final, (0, None)), INPUTS, LONG)
    add("Jacobian, six columns", jax.vmap(jax.jacfwd(final), (0, None)), INPUTS, END)
    add("reverse gradient", jax.grad(loss), INPUTS, END)
    for tolerance in (1e-9, 1e-15):
        run, ms = peers.by_heyoka(rates, STARTS, END, tolerance)
        if run is not None:
            name = f"heyoka, one thread, tolerance {tolerance:g}"
            cases[name], compile_ms[name] = run, ms
    found = common.timed(cases, repeats=9)
    value = found["value, T = 100"][0]
    for name, (least, median, answer) in found.items():
        worst = (
            error(answer)
            if name == "value, T = 100" or name.startswith("heyoka")
            else None
        )
        rows.append([name, compile_ms[name], least, median, least / value, worst])

    program, ms = common.compiled(
        jax.vmap(lambda y: peers.by_diffrax(rates, y, END)), STARTS
    )
    start = time.perf_counter()
    answer = jax.block_until_ready(program(STARTS))
    once = (time.perf_counter() - start) * 1e3
    name = "hand-written diffrax, Dopri8, 1e-9, vmapped (one run)"
    rows.append([name, ms, once, once, once / value, error(answer)])
    answer, once = by_scipy()
    name = f"scipy DOP853, 1e-9 (from {BY_SCIPY} of them)"
    rows.append([name, None, once, once, once / value, error(answer)])
    quoted = 67.0 * TOPS
    name = "MuJoCo, C, RK4, step 1e-2 (quoted: 67 ms each; error of the energy 1e-8)"
    rows.append([name, None, quoted, quoted, quoted / value, None])

    header = [
        "10,000 tops",
        "compile ms",
        "min ms",
        "median ms",
        "of the value",
        "error",
    ]
    packages = ["jax", "diffrax", "numpy", "scipy"]
    if any("heyoka" in row[0] for row in rows):
        packages.append("heyoka")
    common.report(
        "top",
        "The exact flow of Lagrange's top",
        common.table(header, rows),
        packages,
        write,
    )


if __name__ == "__main__":
    main(common.arguments(__doc__).parse_args().write)
