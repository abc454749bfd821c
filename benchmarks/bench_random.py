"""Random records of random bodies, fitted blind: is what is OK ever wrong?

`worlds.random_record` of tests/: bodies of any kind, rods and plates and near spheres
among them, axes turned, 5 to 3000 samples of 0.03 to 1.5 rad each, irregular, with
gaps, 0.1 to 5 % of noise, moved by an independent integrator. OK and wrong is beyond
six standard errors: a chi-square of the tensor's five numbers above 53 (as improbable
in five as 36 in one), or a ratio six errors off.
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
TOGETHER = 100  # records fitted side by side
FIVE = ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2))
MOST = 53.0


def rows_of(seeds):
    """Status, squares of five numbers over their errors, ratios, samples."""
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


if __name__ == "__main__":
    parser = common.arguments(__doc__)
    parser.add_argument("--records", type=int, default=100)
    options = parser.parse_args()
    start = time.perf_counter()
    seeds = np.arange(options.records)
    parts = np.array_split(seeds, -(-len(seeds) // TOGETHER))
    rows = np.concatenate([rows_of(x) for x in parts])
    names = {int(getattr(Status, x)): x for x in dir(Status) if x.isupper()}
    counts = collections.Counter(names[int(code)] for code in rows[:, 0])
    ok = rows[:, 0] == int(Status.OK)
    off = (rows[:, 1] > MOST) | (rows[:, 2] > 6)
    bands = [(5, 20), (20, 100), (100, 500), (500, 3001)]
    inside = [(rows[:, 3] >= a) & (rows[:, 3] < b) for a, b in bands]
    lines = [
        (
            f"{a} to {b - 1}",
            int(x.sum()),
            int((x & ok).sum()),
            int((x & ok & off).sum()),
            *(
                float(np.quantile(rows[x & ok, k], q))
                for k in (1, 2)
                for q in (0.5, 0.99, 1.0)
            ),
        )
        for (a, b), x in zip(bands, inside, strict=True)
        if (x & ok).any()
    ]
    kinds = ", ".join(f"{count} {name}" for name, count in counts.most_common())
    wrong = ", ".join(str(x) for x in np.flatnonzero(ok & off)) or "none"
    heads = "samples", "records", "OK", "of which wrong"
    heads += tuple(
        f"{x}, {q}"
        for x in ("chi-square of 5", "ratios / error")
        for q in ("median", "99 %", "largest")
    )
    text = f"{len(rows)} records: {kinds}. OK and wrong, by seed: {wrong}.\n\n"
    text += common.table(heads, lines)
    text += (
        "\n\nOf five numbers within their errors the median is 4.4, and 99 % are below "
        "15.1. "
    )
    text += (
        f"{(time.perf_counter() - start) / len(rows) * 1e3:.0f} ms a record, all told."
    )
    packages = "jax", "diffrax", "numpy", "scipy"
    common.report("random", "Random records", text, packages, options.write)
