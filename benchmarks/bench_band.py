"""A narrow band of torque at the spin rate: is a good chi-square wrong about it?

Records of 60 samples of a gyro, 0.3 rad of rotation apart, with noise of 1 % of the
spin; bodies of moments 1, 1.7 and 2.3, their axes and spins drawn anew for each record
and moved by an independent integrator (tests/worlds.py). An unmodelled torque acts
along each axis: three sines of random phase whose frequencies lie in a narrow band, so
that its amplitude varies slowly. The band is the spin rate within 5 %, or within 5 % of
the rate at which the free body precesses, 0.2 to 0.4 of the spin rate, where a torque
acts most like a change of the inertia. The rms of the torque is a fraction of the
gyroscopic torque. At the sizes of this table chi-square over its degrees of freedom n
rises to about the gate of a good fit, 1 + 5 sqrt(2 / n), which is 1.54 for these
records.

Each record is fitted twice: the torque is ignored, or a torque is estimated
(`unmodelled="estimate"`). Chi-square: that over its degrees of freedom, median and 90 %
of the records. Wrong: fits that end OK with a ratio I2/I1 or I3/I1 more than six stated
errors from the truth. Largest, and rms: the ratios less the truth over their errors, of
fits that end OK.

`python benchmarks/bench_band.py` makes the table; `--records` sets how many records
there are in each row, `--bands` and `--sizes` choose others.
"""

import collections
import pathlib
import sys
import time

import common
import numpy as np
from scipy.special import ellipk

import jrigid as jr
from jrigid import identify
from jrigid.identify import Status

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "tests"))
import worlds  # pyright: ignore[reportMissingImports]

MOMENTS = np.array([1.0, 1.7, 2.3])
RATIOS = MOMENTS[1:] / MOMENTS[0]
SIGMA = 0.01
TIMES = 0.3 * np.arange(60)
SPHERE = jr.RigidBody(np.ones(3))
KINDS = {"ignored": 0.0, "estimated": "estimate"}
MOST = 6.0  # stated errors
WIDTH = 0.05  # of the band, to either side, over its middle
# Rms of the torque over the gyroscopic torque, for each middle of the band.
BANDS = {"spin": (0.0, 0.03, 0.05), "precession": (0.01, 0.02)}
NAMES = [x for x in dir(Status) if isinstance(getattr(Status, x), Status)]


def precession_rates(directions):
    """Rates at which free bodies with these spins in principal axes precess [rad/s].

    Landau, Lifshitz, Mechanics, section 37: the rates repeat after 4 K(k) / (rate in
        front of t).
    """
    small, middle, large = MOMENTS
    momentum = directions**2 @ MOMENTS**2
    energy = directions**2 @ MOMENTS  # twice
    about_large = momentum > energy * middle
    from_small = momentum - energy * small
    from_large = energy * large - momentum
    square = np.where(
        about_large, (large - middle) * from_small, (middle - small) * from_large
    )
    other = np.where(
        about_large, (middle - small) * from_large, (large - middle) * from_small
    )
    return np.pi / 2 * np.sqrt(square / np.prod(MOMENTS)) / ellipk(other / square)


def readings_of(rng, count, size, band):
    """Rates read by the gyro (records, samples, 3); the first sample is 1 rad/s."""
    axes = np.stack([worlds.random_axes(rng) for _ in range(count)])
    tensors = np.einsum("nij,j,nkj->nik", axes, MOMENTS / MOMENTS.mean(), axes)
    directions = np.array([0.5, 1.0, 0.4]) + 0.25 * rng.uniform(-1, 1, size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    omega0 = worlds.times(axes, directions)
    rates = np.ones(count) if band == "spin" else precession_rates(directions)
    rates = rates[:, None, None]
    limits = (1 - WIDTH) * rates, (1 + WIDTH) * rates
    torque = worlds.wobble_torque(rng, tensors, omega0, size, limits)
    motion = worlds.tumble(tensors, omega0, TIMES, torque)
    return motion.omega + SIGMA * rng.normal(size=motion.omega.shape)


def how_they_end(status):
    """How many fits ended in each state."""
    names = {int(getattr(Status, x)): x for x in NAMES}
    counts = collections.Counter(names[int(x)] for x in np.asarray(status))
    return ", ".join(f"{count} {name}" for name, count in counts.most_common())


def row_of(band, size, kind, readings):
    """Figures of the fits of all records."""
    start = time.perf_counter()
    records = [identify.Rates(TIMES, x, SIGMA) for x in readings]
    found = identify.fit_each(SPHERE, records, unmodelled=KINDS[kind])
    ok = np.asarray(found.status == Status.OK)
    off = (np.asarray(found.ratios) - RATIOS)[ok] / np.asarray(found.ratios_errors)[ok]
    largest = np.max(np.abs(off), axis=1, initial=0.0)
    chi_square = np.asarray(found.reduced_chi_square)
    rms = np.sqrt(np.mean(off**2, axis=0)) if np.any(ok) else np.full(2, np.nan)
    return [
        band,
        f"{size:g}",
        kind,
        f"{np.median(chi_square):.2f}",
        f"{np.quantile(chi_square, 0.9):.2f}",
        how_they_end(found.status),
        int(np.sum(largest > MOST)),
        f"{np.max(largest, initial=0.0):.1f}",
        ", ".join(f"{x:.2f}" for x in rms),
        f"{time.perf_counter() - start:.0f}",
    ]


def main():
    parser = common.arguments(__doc__)
    parser.add_argument("--records", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bands", choices=BANDS, nargs="+", default=BANDS)
    parser.add_argument(
        "--sizes", type=float, nargs="+", help="in place of those of each band"
    )
    given = parser.parse_args()
    rows = []
    for band in given.bands:
        for size in given.sizes or BANDS[band]:
            rng = np.random.default_rng(given.seed)
            readings = readings_of(rng, given.records, size, band)
            for kind in KINDS:
                rows.append(row_of(band, size, kind, readings))
                print(*rows[-1], sep=" | ", flush=True)
    header = [
        "band",
        "torque",
        "torque is",
        "chi-square",
        "90 %",
        "they end",
        "wrong",
        "largest",
        "rms of I2/I1, I3/I1",
        "s",
    ]
    explained = [" ".join(x.split()) for x in (__doc__ or "").split("\n\n")[1:3]]
    count = f"{given.records} records in each row."
    text = "\n\n".join([*explained, count, common.table(header, rows)])
    packages = ("jax", "equinox", "numpy", "scipy")
    common.report("band", "A narrow band of torque", text, packages, given.write)


if __name__ == "__main__":
    main()
