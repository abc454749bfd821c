"""Random records of random bodies, fitted blind: is what is OK ever wrong?

    python benchmarks/bench_random.py [--records 10000] [--rows FILE.npz] [--write]

`worlds.random_record` of tests/: bodies of any kind, rods and plates and near spheres
among them, axes turned, 5 to 3000 samples of 0.03 to 1.5 rad each, irregular, with
gaps, 0.1 to 5 % of noise, moved by an independent integrator. OK and wrong is beyond
six standard errors: a chi-square of the tensor's five numbers above 53 (as improbable
in five as 36 in one), or a ratio six errors off. `--rows` keeps what was done, so that
a run of hours can be interrupted and continued.
"""

import collections
import pathlib
import sys
import time

import common
import numpy as np

import jrigid as jr
from jrigid import identify
from jrigid.identify import Status

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "tests"))
import worlds  # pyright: ignore[reportMissingImports]

BLIND = jr.RigidBody(np.ones(3))
TOGETHER = 500  # records fitted side by side
FIVE = ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2))
MOST = 53.0
BANDS = (5, 20), (20, 100), (100, 500), (500, 3001)  # of samples


def rows_of(seeds):
    """Status, chi-square of five numbers, ratios off by how many errors, samples."""
    records = [worlds.random_record(np.random.default_rng([7, seed])) for seed in seeds]
    tensors = np.stack([3 * x.tensor / np.trace(x.tensor) for x in records])
    readings = [identify.Rates(x.ts, x.readings, x.sigma) for x in records]
    found = identify.fit_each(BLIND, readings)
    places = [3 * i + j for i, j in FIVE]
    spread = np.asarray(found.inertia_covariance)[:, places][:, :, places]
    error = (np.asarray(found.inertia) - tensors).reshape(-1, 9)[:, places]
    sound = np.isfinite(spread).all(axis=(1, 2)) & (
        np.linalg.matrix_rank(spread) == len(FIVE)
    )
    spread = np.where(sound[:, None, None], spread, np.eye(len(FIVE)))
    square = np.sum(error * np.linalg.solve(spread, error[..., None])[..., 0], axis=1)
    true = np.linalg.eigvalsh(tensors)
    off = (
        np.abs(np.asarray(found.ratios) - true[:, 1:] / true[:, :1])
        / found.ratios_errors
    )
    counts = [len(x.ts) for x in records]
    square = np.where(sound, square, np.inf)
    return np.stack(
        [np.asarray(found.status), square, np.max(off, axis=1), counts], axis=1
    )


def summary(rows, seconds):
    """Text about records: the verdicts, and how far the bodies that are OK are off."""
    names = {int(getattr(Status, x)): x for x in dir(Status) if x.isupper()}
    counts = collections.Counter(names[int(code)] for code in rows[:, 0])
    kinds = ", ".join(f"{count} {name}" for name, count in counts.most_common())
    ok = rows[:, 0] == int(Status.OK)
    off = (rows[:, 1] > MOST) | (rows[:, 2] > 6)
    wrong = ", ".join(str(x) for x in np.flatnonzero(ok & off)) or "none"
    heads = ["samples", "records", "OK", "of which wrong"]
    for name in ("chi-square of 5", "ratios / error"):
        heads += [f"{name}, {x}" for x in ("median", "99 %", "largest")]
    lines = []
    for least, beyond in BANDS:
        inside = (rows[:, 3] >= least) & (rows[:, 3] < beyond)
        if not np.any(inside & ok):
            continue
        cells = [f"{least} to {beyond - 1}"]
        cells += [int(np.sum(x)) for x in (inside, inside & ok, inside & ok & off)]
        for column in (1, 2):
            values = rows[inside & ok, column]
            cells += [float(np.quantile(values, q)) for q in (0.5, 0.99, 1.0)]
        lines.append(cells)
    return (
        f"{len(rows)} records: {kinds}. OK and wrong, by seed: {wrong}.\n\n"
        f"{common.table(heads, lines)}\n\n"
        "Of five numbers within their errors the median is 4.4, and 99 % are below "
        f"15.1. CPU time: {seconds / len(rows) * 1e3:.0f} ms a record."
    )


def main():
    """Fit the records in parts, and report after each of them."""
    parser = common.arguments(__doc__)
    parser.add_argument("--records", type=int, default=100)
    parser.add_argument("--rows", type=pathlib.Path, help="file of what was done")
    options = parser.parse_args()
    rows = np.zeros((0, 4))
    seconds = 0.0
    if options.rows and options.rows.exists():
        with np.load(options.rows) as done:
            rows = done["rows"]
            seconds = float(done["seconds"])
    while len(rows) < options.records:
        start = time.process_time()
        last = min(len(rows) + TOGETHER, options.records)
        rows = np.concatenate([rows, rows_of(range(len(rows), last))])
        seconds += time.process_time() - start
        if options.rows:
            np.savez(options.rows, rows=rows, seconds=seconds)
        text = summary(rows, seconds)
        packages = "jax", "diffrax", "numpy", "scipy"
        common.report("random", "Random records", text, packages, options.write)


if __name__ == "__main__":
    main()
