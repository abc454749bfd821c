"""A light curve of nine years: the exact motion beside integration.

    python benchmarks/bench_photometry.py [--write]

A tumbler with the periods of Apophis is observed at 1,200 epochs over nine years. Each
row is a model curve of an ellipsoid: by the exact motion, by `simulate` and by DOP853 of
scipy, all at 1e-9 of the angle turned or better. Times are minimum and median in
milliseconds, without compilation. Derivatives are those in the three rates; for DOP853
they are four curves, as a difference quotient needs.

A search for tumblers scans 100,032 starting points: 521 motions in 192 attitudes each,
at 128 epochs. Its time is measured. That of the same scan by integration is 521 times one
motion, without the brightness.
"""

import functools
from typing import NamedTuple

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
from jrigid.photometry._sun_and_earth import SPEED_OF_LIGHT

HOUR, YEAR, AU = 3600.0, 365.25 * 86400, 149597870700.0
EPOCHS = 1200
MOMENTS = jnp.array([0.61, 0.965, 1.0])
SHAPE = ph.Ellipsoid(jnp.array([1.6, 1.1, 1.0]))
MOTIONS = 521
EXACT, JACOBIAN = "exact motion", "exact motion, with derivatives"
SIMULATE = "`simulate`, rtol 1e-10"
SCIPY = "DOP853 of scipy, rtol 1e-11"
ATTITUDE = jnp.array([1.0, 0.0, 0.0, 0.0])
OMEGA = ph.omega_from_periods(MOMENTS, 27.38 * HOUR, 263 * HOUR)


class Scene(NamedTuple):
    """Epochs [s], and the Sun and the observer from the body [m], space components."""

    ts: jax.Array
    sun: jax.Array
    observer: jax.Array

    @property
    def emitted(self):
        """Times at which the light left the body [s]."""
        return self.ts - jnp.linalg.norm(self.observer, axis=1) / SPEED_OF_LIGHT


def observations():
    """A scene of some nights of nine years."""
    rng = np.random.default_rng(0)
    nights = rng.uniform(0.0, 9 * YEAR, EPOCHS // 20)
    ts = np.sort(
        (nights[:, None] + rng.uniform(0.0, 6 * HOUR, (len(nights), 20))).ravel()
    )
    angle = 2 * np.pi * ts / (0.9 * YEAR)
    sun = AU * np.stack([np.cos(angle), np.sin(angle), 0.05 * np.sin(2 * angle)], -1)
    earth = AU * np.stack([np.cos(ts / YEAR), np.sin(ts / YEAR), 0 * ts], -1)
    return Scene(jnp.asarray(ts), jnp.asarray(sun), jnp.asarray(sun - 0.9 * earth))


def exact(scene, omega):
    """The curve by the exact motion."""
    state = jr.State(ATTITUDE, omega)
    ts, sun, observer = scene
    return ph.light_curve(MOMENTS, state, ts, sun, observer, SHAPE)


@jax.jit
@jax.vmap
def brightness(attitude, sun, observer):
    """Brightness of the ellipsoid in each attitude."""
    to_sun = jr.rotation.rotate_inverse(attitude, sun)
    to_observer = jr.rotation.rotate_inverse(attitude, observer)
    return ph.brightness(SHAPE, to_sun, to_observer)


def integrated(scene, omega, adjoint=None):
    """The curve by `simulate`."""
    # Light from farther away left earlier: the times may be out of order.
    order = jnp.argsort(scene.emitted)
    run = jr.simulate(
        jr.RigidBody(MOMENTS),
        jr.State(ATTITUDE, omega),
        scene.emitted[order],
        rtol=1e-10,
        max_steps=1_000_000,
        throw=False,
        adjoint=adjoint,
    )
    attitudes = jnp.zeros((EPOCHS, 4)).at[order].set(run.states.attitude)
    return brightness(attitudes, scene.sun, scene.observer)


def rates(_, y):
    """Rates of a quaternion and of the angular velocity, in numpy."""
    q = y[:4]
    w = y[4:]
    turn = np.concatenate([[-q[1:] @ w], q[0] * w + np.cross(q[1:], w)]) / 2
    moments = np.asarray(MOMENTS)
    return np.concatenate([turn, np.cross(moments * w, w) / moments])


def by_scipy(scene):
    """The curve by DOP853."""
    emitted = np.asarray(scene.emitted)
    order = np.argsort(emitted)
    # Zero is a knot, so that the state there is that of the other rows.
    ts = np.concatenate([[0.0], emitted[order]])
    start = np.concatenate([ATTITUDE, OMEGA])
    run = solve_ivp(rates, ts[[0, -1]], start, "DOP853", ts, rtol=1e-11, atol=1e-13)
    attitudes = np.empty((EPOCHS, 4))
    attitudes[order] = run.y[:4, 1:].T
    attitudes /= np.linalg.norm(attitudes, axis=1, keepdims=True)
    return brightness(attitudes, scene.sun, scene.observer)


def measured(scene):
    """Least and median milliseconds, and the curve, of each way."""
    forward = functools.partial(integrated, adjoint=diffrax.ForwardMode())
    functions = {
        EXACT: exact,
        JACOBIAN: jax.jacfwd(exact, 1),
        SIMULATE: integrated,
        f"{SIMULATE}, with derivatives": jax.jacfwd(forward, 1),
    }
    cases = {
        name: functools.partial(jax.jit(function), scene, OMEGA)
        for name, function in functions.items()
    }
    times = common.timed(cases, repeats=5)
    return times | common.timed({SCIPY: lambda: by_scipy(scene)}, repeats=1)


def curves_table(times):
    """Times of each way, and how far its curve is from that of the exact motion."""
    reference = times[EXACT][2]
    rows = []
    for name, (least, median, curve) in times.items():
        is_value = curve.shape == reference.shape
        unit = times[EXACT if is_value else JACOBIAN][0]
        error = float(np.max(np.abs(curve / reference - 1))) if is_value else None
        rows.append([name, least, median, least / unit, error])
    least, median, _ = times[SCIPY]
    ratio = 4 * least / times[JACOBIAN][0]
    rows.append([f"{SCIPY}, four curves", 4 * least, 4 * median, ratio, None])
    columns = ["ms, min", "ms, median", "of the exact motion", "largest difference"]
    return common.table(["curve", *columns], rows)


def scan():
    """Least milliseconds of a scan of starting points over nine years, and their number."""
    numbers, tasks = bench_device.starting_points(MOTIONS)
    few = _scan.fewer_epochs(bench_device.readings())
    few = few._replace(ts=few.ts * (9 * YEAR / few.span), span=np.asarray(9 * YEAR))
    turned = _scan.attitudes_tried()
    program = _scan.scanned
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
    times = measured(observations())
    text = (
        "A tumbler with the periods of Apophis at 1,200 epochs over nine years, without "
        "compilation."
    )
    text = "\n\n".join([text, curves_table(times), starting_points_table(times)])
    packages = ["jax", "diffrax", "numpy", "scipy"]
    common.report("photometry", "Light curves", text, packages, write)


if __name__ == "__main__":
    main(common.arguments(__doc__).parse_args().write)
