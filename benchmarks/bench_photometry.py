"""A light curve of nine years: the exact motion beside integration.

    python benchmarks/bench_photometry.py [--write]

A tumbler with the periods of Apophis is observed at 1,200 epochs over nine years. Each
row is a model curve of an ellipsoid: by the exact motion, by `simulate` and by DOP853 of
scipy, all at 1e-9 of the angle turned or better. Times are minimum and median in
milliseconds, without compilation. Derivatives are those in the three rates; for DOP853
they are four curves, as a difference quotient needs.

A search for tumblers scans 100,032 starting points: 521 motions in 192 orientations each,
at 128 epochs. Its time is measured. That of the same scan by integration is 521 times one
motion, without the brightness.
"""

import functools

import bench_device
import bench_lanes
import common
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jrigid as jr
from jrigid import photometry as ph
from jrigid.photometry import _scan

HOUR, YEAR, AU = 3600.0, 365.25 * 86400, 149597870700.0
EPOCHS = 1200
MOMENTS = jnp.array([0.61, 0.965, 1.0])
SHAPE = ph.Ellipsoid(jnp.array([1.6, 1.1, 1.0]))
MOTIONS = 521
EXACT, JACOBIAN = "exact motion", "exact motion, with derivatives"
SIMULATE = "`simulate`, rtol 1e-10"
SCIPY = "DOP853 of scipy, rtol 1e-11"


def observations():
    """Epochs [s] in some nights of nine years, and directions to Sun and observer."""
    rng = np.random.default_rng(0)
    nights = rng.uniform(0.0, 9 * YEAR, EPOCHS // 20)
    ts = np.sort(
        (nights[:, None] + rng.uniform(0.0, 6 * HOUR, (len(nights), 20))).ravel()
    )
    angle = 2 * np.pi * ts / (0.9 * YEAR)
    sun = AU * np.stack([np.cos(angle), np.sin(angle), 0.05 * np.sin(2 * angle)], -1)
    earth = AU * np.stack([np.cos(ts / YEAR), np.sin(ts / YEAR), 0 * ts], -1)
    return jnp.asarray(ts), jnp.asarray(sun), jnp.asarray(sun - 0.9 * earth)


def scan():
    """Milliseconds of a scan of starting points over nine years, and their number."""
    numbers, tasks = bench_device.starting_points(MOTIONS)
    few = _scan.fewer_epochs(bench_device.readings())
    few = few._replace(ts=few.ts * (9 * YEAR / few.span), span=np.asarray(9 * YEAR))
    turned = _scan.orientations()
    program = _scan.best_orientations
    _, least, _ = bench_lanes.seconds(program, numbers, tasks, turned, few)
    return least, MOTIONS * len(turned)


def starting_points_table(times):
    """Time of the scan beside the integration of its motions."""
    least, many = scan()
    rows = [["exact motion, with the brightness", least / 1e3, 1.0]]
    for name in (SIMULATE, SCIPY):
        integrations = MOTIONS * times[name][0]
        rows.append([f"{name}, without", integrations / 1e3, integrations / least])
    header = [f"scan of {many:,} starting points", "s", "of the exact motion"]
    return common.table(header, rows)


def main(write):
    """Measure and report."""
    ts, sun, observer = observations()
    omega = ph.omega_from_periods(MOMENTS, 27.38 * HOUR, 263 * HOUR)
    attitude = jnp.array([1.0, 0.0, 0.0, 0.0])
    emitted = ts - jnp.linalg.norm(observer, axis=1) / 299792458.0

    def exact(omega):
        state = jr.State(attitude, omega)
        return ph.light_curve(MOMENTS, state, ts, sun, observer, SHAPE)

    @jax.vmap
    def seen(attitude, sun, observer):
        to_sun = jr.rotation.rotate_inverse(attitude, sun)
        to_observer = jr.rotation.rotate_inverse(attitude, observer)
        return ph.brightness(SHAPE, to_sun, to_observer)

    def integrated(omega, adjoint=None):
        state = jr.State(attitude, omega)
        order = jnp.argsort(emitted)
        run = jr.simulate(
            jr.RigidBody(MOMENTS),
            state,
            emitted[order],
            rtol=1e-10,
            max_steps=1_000_000,
            throw=False,
            adjoint=adjoint,
        )
        attitudes = jnp.zeros((EPOCHS, 4)).at[order].set(run.states.attitude)
        return seen(attitudes, sun, observer)

    moments = np.asarray(MOMENTS)

    def rates(_, y):
        q, w = y[:4], y[4:]
        turn = np.concatenate([[-q[1:] @ w], q[0] * w + np.cross(q[1:], w)]) / 2
        return np.concatenate([turn, np.cross(moments * w, w) / moments])

    def by_scipy():
        order = np.argsort(emitted)
        start = np.concatenate([attitude, omega])
        span = float(emitted.min()), float(emitted.max())
        first = solve_ivp(
            rates, (0.0, span[0]), start, "DOP853", rtol=1e-11, atol=1e-13
        )
        run = solve_ivp(
            rates,
            span,
            first.y[:, -1],
            "DOP853",
            np.asarray(emitted)[order],
            rtol=1e-11,
            atol=1e-13,
        )
        attitudes = np.empty((EPOCHS, 4))
        attitudes[order] = run.y[:4].T
        attitudes /= np.linalg.norm(attitudes, axis=1, keepdims=True)
        return shine(attitudes, sun, observer)

    shine = jax.jit(seen)
    value, gradient = jax.jit(exact), jax.jit(jax.jacfwd(exact))
    loop = jax.jit(integrated)
    forward = functools.partial(integrated, adjoint=diffrax.ForwardMode())
    loop_gradient = jax.jit(jax.jacfwd(forward))
    cases = {
        EXACT: lambda: value(omega),
        JACOBIAN: lambda: gradient(omega),
        SIMULATE: lambda: loop(omega),
        f"{SIMULATE}, with derivatives": lambda: loop_gradient(omega),
    }
    times = common.timed(cases, repeats=5)
    times |= common.timed({SCIPY: by_scipy}, repeats=1)
    least, median, curve = times[SCIPY]
    times[f"{SCIPY}, four curves"] = 4 * least, 4 * median, curve
    reference = times[EXACT][2]
    rows = []
    for name, (least, median, answer) in times.items():
        is_value = name in (EXACT, SIMULATE, SCIPY)
        exact_least = times[EXACT if is_value else JACOBIAN][0]
        error = float(np.max(np.abs(answer / reference - 1))) if is_value else None
        rows.append([name, least, median, least / exact_least, error])
    header = [
        "curve",
        "ms, min",
        "ms, median",
        "of the exact motion",
        "largest difference",
    ]
    text = (
        "A tumbler with the periods of Apophis at 1,200 epochs over nine years, without "
        "compilation.\n\n" + common.table(header, rows)
    )
    text += "\n\n" + starting_points_table(times)
    packages = ["jax", "diffrax", "numpy", "scipy"]
    common.report("photometry", "Light curves", text, packages, write)


if __name__ == "__main__":
    main(common.arguments(__doc__).parse_args().write)
