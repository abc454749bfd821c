"""Random records of random bodies, fitted blind: is what is OK ever wrong?

`worlds.random_record` of tests/: bodies of any kind, rods and plates and near spheres among them,
axes turned, 5 to 3000 samples of 0.03 to 1.5 rad each, irregular, with gaps, 0.1 to 5 % of noise,
moved by an independent integrator. OK and wrong is beyond six standard errors: a chi-square of the
tensor's five numbers above 53 (as improbable in five as 36 in one), or a ratio six errors off.
"""

import collections
import pathlib
import sys
import time

import common
import jax
import jax.numpy as jnp
import numpy as np

import jrigid as jr
from jrigid import identify
from jrigid.identify import Status

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "tests"))
import worlds  # pyright: ignore[reportMissingImports]

BLIND = jr.RigidBody(np.ones(3))
LENGTHS = 8, 16, 32, 64, 128, 256, 512, 1024, 3000  # to which records are padded
FIVE = ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2))
MOST = 53.0


@jax.jit
def judged(ts, values, sigma, tensor):
    """Status, squares of five numbers in units of their errors, ratios in theirs, largest error."""
    found = identify.fit(BLIND, identify.Rates(ts, values, sigma), throw=False)
    numbers = lambda x: jnp.stack([x[i, j] for i, j in FIVE])  # noqa: E731
    slopes = jax.vmap(numbers, -1, -1)(jax.jacfwd(found.unknowns.inertia)(found.numbers))
    error, spread = numbers(found.inertia - tensor), slopes @ found.numbers_covariance @ slopes.T
    true = jnp.linalg.eigvalsh(tensor)
    ratios = jnp.abs(found.ratios - true[1:] / true[0]) / found.ratios_errors
    square = error @ jnp.linalg.solve(spread, error)
    return found.status._value, square, jnp.max(ratios)


def row(record):
    """Status, chi-square of five, ratios' errors, samples."""
    count = len(record.ts)
    rest = next(x for x in LENGTHS if x >= count) - count
    ts = np.pad(record.ts, (0, rest), constant_values=np.nan)
    values = np.pad(record.readings, ((0, rest), (0, 0)), constant_values=np.nan)
    tensor = 3 * record.tensor / np.trace(record.tensor)
    return *map(float, judged(ts, values, jnp.asarray(record.sigma), tensor)), count


if __name__ == "__main__":
    parser = common.arguments(__doc__)
    parser.add_argument("--records", type=int, default=100, help="1000 take half an hour")
    options = parser.parse_args()
    start = time.perf_counter()
    seeds = range(options.records)
    records = (worlds.random_record(np.random.default_rng([7, seed])) for seed in seeds)
    rows = np.array([row(x) for x in records])
    names = {int(getattr(Status, x)._value): x for x in dir(Status) if x.isupper()}
    counts = collections.Counter(names[int(code)] for code in rows[:, 0])
    ok = rows[:, 0] == int(Status.OK._value)
    off = (rows[:, 1] > MOST) | (rows[:, 2] > 6)
    bands = [(5, 20), (20, 100), (100, 500), (500, 3001)]
    inside = [(rows[:, 3] >= a) & (rows[:, 3] < b) for a, b in bands]
    lines = [
        (f"{a} to {b - 1}", int(x.sum()), int((x & ok).sum()), int((x & ok & off).sum()),
         *(float(np.quantile(rows[x & ok, k], q)) for k in (1, 2) for q in (0.5, 0.99, 1.0)))
        for (a, b), x in zip(bands, inside, strict=True) if (x & ok).any()
    ]  # fmt: skip
    kinds = ", ".join(f"{count} {name}" for name, count in counts.most_common())
    wrong = ", ".join(str(x) for x in np.flatnonzero(ok & off)) or "none"
    heads = "samples", "records", "OK", "of which wrong"
    heads += tuple(f"{x}, {q}" for x in ("chi-square of 5", "ratios / error")
                   for q in ("median", "99 %", "largest"))  # fmt: skip
    text = f"{len(rows)} records: {kinds}. OK and wrong, by seed: {wrong}.\n\n"
    text += common.table(heads, lines)
    text += "\n\nOf five numbers within their errors the median is 4.4, and 99 % are below 15.1. "
    text += f"{(time.perf_counter() - start) / len(rows) * 1e3:.0f} ms a record, all told."
    packages = "jax", "diffrax", "numpy", "scipy"
    common.report("random", "Random records", text, packages, options.write)
