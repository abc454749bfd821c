"""The exact free flow beside integrators, and the elliptic functions beside scipy's.

10,000 random bodies to T = 100 (and to 10^6 turns), I = (1, 2, 3), omega standard
normal: final attitude and omega, their Jacobian and a gradient; one body at 1000 times.
Peers: heyoka's batch Taylor integrator (one thread, the widest vectors it recommends;
`pip install heyoka`) and hand-written diffrax. Errors against the 30-digit closed form
of tests/free_reference.py, on 50 bodies. "Thread for thread": run as
`taskset -c 0 python benchmarks/bench_free.py`, so that no contender has a second core.
"""

import pathlib
import sys
import time

import common
import jax
import jax.numpy as jnp
import numpy as np
import peers
import scipy.special

import jrigid as jr

sys.path.append(str(pathlib.Path(__file__).parent.parent / "tests"))
import free_reference  # pyright: ignore[reportMissingImports]

BODIES = 10_000
MOMENTS = np.array([1.0, 2.0, 3.0])
ATTITUDE = np.array([1.0, 0.0, 0.0, 0.0])
OMEGAS = np.random.default_rng(0).normal(size=(BODIES, 3))
END = 100.0
LONG = 2e6 * np.pi
TIMES = np.linspace(0.0, END, 1000)
CHECKED = 50


def final(x, t):
    """State (7,) at time t of moments x[:3] and angular velocity x[3:]."""
    return final_of(x[:3], x[3:], t)


def final_of(inertia, omega, t):
    state = jr.free_rotation(inertia, jr.State(ATTITUDE, omega), t, throw=False)
    return jnp.concatenate([state.attitude, state.omega], axis=-1)


INPUTS = np.concatenate([np.tile(MOMENTS, (BODIES, 1)), OMEGAS], axis=1)
AXES = np.linalg.qr(np.random.default_rng(2).normal(size=(BODIES, 3, 3)))[0]
TENSORS = np.einsum("nik,k,njk->nij", AXES, MOMENTS, AXES)
STARTS = np.concatenate([np.tile(ATTITUDE, (BODIES, 1)), OMEGAS], axis=1)


def loss(x, t):
    return jnp.sum(jax.vmap(final, (0, None))(x, t) ** 3)


def loss_of_tensors(tensors, omegas, t):
    return jnp.sum(jax.vmap(final_of, (0, 0, None))(tensors, omegas, t) ** 3)


def hessian_vector(x, t):
    return jax.jvp(lambda y: jax.grad(loss)(y, t), (x,), (x,))[1]


def error(states):
    """Largest error of attitude and omega over the first bodies."""
    worst = 0.0
    for omega, found in zip(
        OMEGAS[:CHECKED], np.asarray(states)[:CHECKED], strict=True
    ):
        ((q, w),) = free_reference.free_motion(MOMENTS, ATTITUDE, omega, [END])
        exact = np.array([*q, *w], float)
        exact[:4] *= np.sign(exact[:4] @ found[:4])
        worst = max(worst, np.max(np.abs(found - exact)))
    return worst


def rates(w, x, y, z, a, b, c):
    i1, i2, i3 = MOMENTS
    return [
        0.5 * (-x * a - y * b - z * c),
        0.5 * (w * a + y * c - z * b),
        0.5 * (w * b + z * a - x * c),
        0.5 * (w * c + x * b - y * a),
        (i2 - i3) / i1 * b * c,
        (i3 - i1) / i2 * c * a,
        (i1 - i2) / i3 * a * b,
    ]


def main(write: bool) -> None:
    rows, cases, compile_ms = [], {}, {}

    def add(name, function, *arguments):
        program, compile_ms[name] = common.compiled(function, *arguments)
        cases[name] = lambda: program(*arguments)

    many = jax.vmap(final, (0, None))
    add("value, T = 100", many, INPUTS, END)
    add("value, 10^6 turns", many, INPUTS, LONG)
    add("Jacobian, six columns", jax.vmap(jax.jacfwd(final), (0, None)), INPUTS, END)
    add("reverse gradient", jax.grad(loss), INPUTS, END)
    gradient = jax.grad(loss_of_tensors, (0, 1))
    kinds = {"(3, 3) tensors": TENSORS, "spheres as tensors": 0 * AXES + np.eye(3)}
    for name, tensors in kinds.items():
        add(f"reverse gradient, {name}", gradient, tensors, OMEGAS, END)
    add("Hessian-vector product", hessian_vector, INPUTS, END)
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
        rows.append(
            [
                f"10,000 bodies: {name}",
                compile_ms[name],
                least,
                median,
                least / value,
                worst,
            ]
        )

    program, ms = common.compiled(
        jax.vmap(lambda x: peers.by_diffrax(rates, x, END)), STARTS
    )
    start = time.perf_counter()
    answer = jax.block_until_ready(program(STARTS))
    once = (time.perf_counter() - start) * 1e3
    name = "10,000 bodies: hand-written diffrax, Dopri8, 1e-9, vmapped (one run)"
    rows.append([name, ms, once, once, once / value, error(answer)])

    cases = {}
    one = INPUTS[0]
    add("value", final, one, TIMES)
    add("Jacobian, six columns", jax.jacfwd(final), one, TIMES)
    add(
        "reverse gradient", jax.grad(lambda x, t: jnp.sum(final(x, t) ** 3)), one, TIMES
    )
    found = common.timed(cases, repeats=31)
    for name, (least, median, _) in found.items():
        ratio = least / found["value"][0]
        rows.append(
            [
                f"one body, 1000 times: {name}",
                compile_ms[name],
                least,
                median,
                ratio,
                None,
            ]
        )

    cases = {}
    u, m = np.random.default_rng(1).uniform(size=(2, BODIES)) * [[10.0], [1.0]]
    add("sn, cn, dn", lambda u, m: jr.elliptic.ellipj(u, m)[:3], u, m)
    cases["scipy"] = lambda: scipy.special.ellipj(u, m)[:3]

    def total(u, m):
        return jnp.sum(jnp.stack(jr.elliptic.ellipj(u, m)[:3]))

    add("gradient in u and m", jax.grad(total, (0, 1)), u, m)
    found = common.timed(cases, repeats=31)
    for name, (least, median, answer) in found.items():
        worst = None
        if name == "sn, cn, dn":
            worst = float(
                np.max(np.abs(np.stack(answer) - np.stack(found["scipy"][2])))
            )
        ratio = least / found["scipy"][0]
        rows.append(
            [
                f"ellipj, 10,000 lanes: {name}",
                compile_ms.get(name),
                least,
                median,
                ratio,
                worst,
            ]
        )

    header = ["what", "compile ms", "min ms", "median ms", "of the value", "error"]
    text = (
        "Ratios are to the value of the same group, for ellipj to scipy, whose "
        "difference is the error there.\n"
        "\n" + common.table(header, rows)
    )
    packages = ["jax", "diffrax", "numpy", "scipy"]
    if any("heyoka" in row[0] for row in rows):
        packages.append("heyoka")
    common.report("free", "The exact free flow", text, packages, write)


if __name__ == "__main__":
    main(common.arguments(__doc__).parse_args().write)
