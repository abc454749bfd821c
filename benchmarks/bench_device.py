"""Large batches on the device that JAX finds: a graphics processor, or the CPU.

    python benchmarks/bench_device.py [--scale 1.0] [--write]

Heavy asymmetric tops to T = 100 (the case of bench_lanes.py), free motion of many
bodies in closed form, MEGNO maps (the case of bench_stability.py), and light curves of
tumblers: a model of 384 epochs with derivatives, and the scan of starting points. Each
row gives the first call, which compiles, apart. `--scale` shrinks the batches.
"""

import bench_lanes
import bench_stability
import common
import jax
import jax.numpy as jnp
import numpy as np

import jrigid as jr
from jrigid.photometry import _curve_readings, _model, _scan

EPOCHS = 384


def tops(lanes):
    """Heavy tops at rtol 1e-8; the accuracy beside the time."""
    omegas = np.random.default_rng(0).normal(size=(lanes, 3))
    first, least, (final, _) = bench_lanes.seconds(bench_lanes.ours(1e-8), omegas)
    up = bench_lanes.up_in_body(final.attitude)
    error = bench_lanes.energy_error(np.asarray(final.omega), up, omegas)
    return [f"heavy tops to T = 100, rtol 1e-8: {lanes:,}", first, least, lanes, error]


def free(lanes):
    """Closed-form motion of many bodies, each at one time."""
    rng = np.random.default_rng(1)
    omegas = rng.normal(size=(lanes, 3))
    ts = rng.uniform(0.0, 1e4, lanes)

    @jax.jit
    @jax.vmap
    def at(omega, t):
        state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), omega)
        return jr.free_rotation(jnp.array([1.0, 2.0, 3.0]), state, t)

    first, least, final = bench_lanes.seconds(at, omegas, ts)
    omega = np.asarray(final.omega)
    moments = np.array([1.0, 2.0, 3.0])
    energy = (moments * omega**2).sum(1) / (moments * omegas**2).sum(1)
    error = float(np.abs(energy - 1).max())
    return [f"free motion at a time: {lanes:,}", first, least, lanes, error]


def megno(side):
    """A map of heavy tops."""
    tilts = np.linspace(0.05, 3.1, side)
    spins = np.linspace(0.1, 4.0, side)
    tilt, spin = (x.reshape(-1) for x in np.meshgrid(tilts, spins, indexing="ij"))
    first, least, _ = bench_lanes.seconds(
        jax.jit(jax.vmap(bench_stability.point)), tilt, spin
    )
    return [f"MEGNO to T = 200: {side} x {side}", first, least, side * side, None]


def readings():
    """An apparition of 110 days, with one unknown factor."""
    rng = np.random.default_rng(2)
    ts = np.sort(rng.uniform(-0.5, 0.5, EPOCHS)) * 110 * 86400
    angle = ts / 1e7
    sun = np.stack([np.cos(angle), np.sin(angle), 0.1 + 0 * ts], axis=1)
    observer = np.stack([np.sin(angle), np.cos(angle), 0.2 + 0 * ts], axis=1)
    return _curve_readings.Readings(
        ts=ts,
        to_sun=sun / np.linalg.norm(sun, axis=1, keepdims=True),
        to_observer=observer / np.linalg.norm(observer, axis=1, keepdims=True),
        values=rng.normal(size=EPOCHS),
        weights=np.full(EPOCHS, 50.0),
        basis=np.full((EPOCHS, 1), EPOCHS**-0.5),
        span=np.asarray(110 * 86400.0),
    )


def starting_points(lanes):
    """Random tumblers and how their numbers are read."""
    rng = np.random.default_rng(3)
    numbers = rng.normal(size=(lanes, _model.COUNT))
    numbers[:, :2] = rng.uniform(20.0, 300.0, (lanes, 2))
    tasks = _model.Task(
        frame=np.tile(np.eye(3), (lanes, 1, 1)),
        mode=np.full(lanes, int(_model.Mode.short_axis)),
        homogeneous=np.ones(lanes, bool),
        link=np.ones(lanes),
    )
    return numbers, tasks


def curves(lanes):
    """Model light curves of 384 epochs and their derivatives in eleven numbers."""
    numbers, tasks = starting_points(lanes)
    program = jax.jit(jax.vmap(_model.rows_of, (0, 0, None)))
    first, least, _ = bench_lanes.seconds(program, numbers, tasks, readings())
    name = f"light curves of {EPOCHS} epochs with derivatives: {lanes:,}"
    return [name, first, least, lanes, None]


def scan(motions):
    """Chi-square of many starting points: motions times attitudes."""
    numbers, tasks = starting_points(motions)
    few = _scan.fewer_epochs(readings())
    turned = _scan.attitudes_tried()
    first, least, _ = bench_lanes.seconds(_scan.scanned, numbers, tasks, turned, few)
    many = motions * len(turned)
    name = f"scan of starting points, {_curve_readings.EPOCHS} epochs: {many:,}"
    return [name, first, least, many, None]


def main(scale, write):
    """Run all cases."""

    def size(count):
        return max(1, round(count * scale))

    cases = [
        lambda: free(size(1_000_000)),
        lambda: tops(size(10_000)),
        lambda: tops(size(100_000)),
        lambda: tops(size(1_000_000)),
        lambda: curves(size(10_000)),
        lambda: scan(size(521)),
        lambda: scan(size(5_210)),
        lambda: megno(max(2, round(128 * scale**0.5))),
        lambda: megno(max(2, round(512 * scale**0.5))),
    ]
    rows = []
    for case in cases:
        name, first, least, many, error = case()
        rows.append([name, first / 1e3, least, 1e3 * least / many, error])
        print(rows[-1], flush=True)
    header = ["work", "first call, s", "ms", "microseconds each", "error of the energy"]
    text = common.table(header, rows) + f"\n\nDevice: {jax.devices()[0].device_kind}."
    title = "Large batches on one device"
    common.report("device", title, text, ["jax", "diffrax", "numpy"], write)


if __name__ == "__main__":
    parser = common.arguments(__doc__)
    parser.add_argument("--scale", type=float, default=1.0)
    options = parser.parse_args()
    main(options.scale, options.write)
