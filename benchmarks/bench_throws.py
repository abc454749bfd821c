"""A hundred throws of a racquet with drag and a lash, read by a gyro with a lag: is `fit` honest?

The throws come from an independent integrator (tests/worlds.py): a flat body of moments 0.07, 0.93
and 1 (their unit plays no role), 0.5 to 1 s at 100 Hz, 5 to 20 rad/s, about any axis or nearly
about a principal one; quadratic drag takes 0.3 % of the spin in a radian; the gyro's noise is
0.05 % of the spin (0.0025 to 0.01 rad/s), its low-pass has 3 ms. The lash is white torque, its
root spectral density s over the mean moment [rad / s^1.5], or a ball of so many parts of the
smallest moment on a spring. `fit` is told the drag's form, and that there may be a torque
(`unmodelled="estimate"`).

Told: the error stated is below a tenth of the ratio. Scatter: rms of the errors of I2/I1, of I3/I1
and of the drag over what was stated, of the throws that are told. Explained: the fit does not end
MISFIT, WRONG_BASIN or NOT_CONVERGED. Errors: those stated over the part of the sensor. Halves: two
fits of half the throws each; the difference of both ratios over its error, and each half's I3/I1
less the truth over its error.
"""

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

MOMENTS = np.array([0.07, 0.93, 1.0])
RATIOS, DRAG, LAG, MOST = MOMENTS[1:] / MOMENTS[0], 0.003, 0.003, 101
SCENE = {"body": tuple(MOMENTS), "duration": (0.5, 1.0), "spin": (5.0, 20.0), "drag": DRAG,
         "time_constant": LAG, "sigma": 5e-4, "wobble": 0.0}  # fmt: skip
LASHES = {
    "none": {},
    "white, s = 0.01": {"kick": 0.01},
    "white, s = 0.03": {"kick": 0.03},
    "ball 0.03, 15 Hz": {"wobble": 0.03},
    "ball 0.1, 15 Hz": {"wobble": 0.1},
    "ball 0.1, 5 Hz": {"wobble": 0.1, "wobble_frequency": 5.0},
}
FAILED = [int(x._value) for x in (Status.MISFIT, Status.WRONG_BASIN, Status.NOT_CONVERGED)]


def records(lash, count, seed):
    """Times, readings and noise (throws, samples, ...), padded with NaN."""
    throws = worlds.throws(np.random.default_rng(seed), count, **SCENE | LASHES[lash])
    ts, values = np.full((count, MOST), np.nan), np.full((count, MOST, 3), np.nan)
    for i, x in enumerate(throws):
        ts[i, : x.ts.size], values[i, : x.ts.size] = x.ts, x.readings
    return ts, values, np.array([x.sigma for x in throws])[:, None] * np.ones(MOST)


def fitter(shape, lag, unmodelled):
    """A fit of one throw, or of several at once; compiled once for each."""
    body = jr.RigidBody(np.full(3, MOMENTS.mean()), jr.torques.QuadraticDrag(jnp.asarray(1e-3)))
    gyro = identify.Gyro(time_constant=None if lag == "ignored" else jnp.asarray(LAG))

    def free(body, gyro):
        sought = identify.prior(gyro.time_constant, 0.002) if lag == "sought" else ()
        return body.torque.coefficient, sought

    def one(ts, values, sigma):
        record = identify.Record(gyro, ts, values, sigma)
        return identify.fit(
            body, record, free=free, shape=shape, unmodelled=unmodelled, throw=False
        )

    return jax.jit(jax.vmap(one))


def of_singles(found):
    """Explained %, told, scatters, errors over the sensor's."""
    status, ratios, errors = (
        np.asarray(x) for x in (found.status._value, found.ratios, found.ratios_errors)
    )
    explained = 100 * np.mean(~np.isin(status, FAILED))
    told = (errors[:, 1] < 0.1 * RATIOS[1]) & ~np.isin(status, FAILED)
    boundary = 100 * np.mean(status == int(Status.AT_BOUNDARY._value))
    pulls = ((ratios - RATIOS) / errors)[told]
    drag, error = map(np.asarray, jax.vmap(lambda x: x.leaves["torque.coefficient"])(found))
    pulls = np.column_stack([pulls, ((drag - DRAG * MOMENTS.mean()) / error)[told]])
    whole, own = (
        np.diagonal(np.asarray(x), axis1=1, axis2=2)[told]
        for x in (found.numbers_covariance, found.sensor_covariance)
    )
    scatter = [f"{x:.2f}" for x in np.sqrt(np.mean(pulls**2, axis=0))]
    size = 100 * np.median(errors[told, 1] / RATIOS[1])
    return [f"{explained:.0f}", f"{boundary:.0f}", int(told.sum()), *scatter, f"{size:.2f}",
            f"{np.median(np.sqrt(whole / own)):.1f}"]  # fmt: skip


def of_halves(found):
    """Differences of the ratios and each half's error, in units of what was stated; its size."""
    ratios, errors = np.asarray(found.ratios), np.asarray(found.ratios_errors)
    apart = (ratios[0] - ratios[1]) / np.linalg.norm(errors, axis=0)
    off = (ratios[:, 1] - RATIOS[1]) / errors[:, 1]
    size = 100 * errors[0, 1] / RATIOS[1]
    names = [x for x in dir(Status) if isinstance(getattr(Status, x), Status)]
    ends = {int(getattr(Status, x)._value): x for x in names}
    return [", ".join(f"{x:+.1f}" for x in apart), ", ".join(f"{x:+.1f}" for x in off),
            f"{size:.3f}", ", ".join(ends[int(x)] for x in found.status._value)]  # fmt: skip


def main():
    parser = common.arguments(__doc__)
    parser.add_argument("--count", type=int, default=100, help="throws")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--any", action="store_true", help="also as a body of any shape")
    given = parser.parse_args()
    flat, any_ = identify.Flat(), identify.Tensor()
    cases = [("flat", flat, "known", "estimate", lash) for lash in LASHES]
    white = "white, s = 0.01"
    cases += [("flat", flat, lag, "estimate", white) for lag in ("sought", "ignored")]
    cases += [("flat", flat, "known", x, white) for x in (0.01 * MOMENTS.mean(), 0.0)]
    if given.any:
        cases += [("any", any_, "known", "estimate", lash) for lash in LASHES]
    fits, rows = {}, []
    for name, shape, lag, unmodelled, lash in cases:
        fit = fits.setdefault((name, lag, unmodelled), fitter(shape, lag, unmodelled))
        data = records(lash, given.count, given.seed)
        start = time.perf_counter()
        singles = of_singles(fit(*data))
        halves = fit(*(x.reshape(2, -1, *x.shape[1:]) for x in data))
        told = unmodelled if unmodelled == "estimate" else "known" if unmodelled else "none"
        rows.append([lash, name, lag, told, *singles, *of_halves(halves)])
        print(*rows[-1], f"{time.perf_counter() - start:.0f} s", sep=" | ", flush=True)
    header = ["lash", "shape", "lag", "unmodelled", "explained %", "at boundary %", "told",
              "scatter I2/I1", "I3/I1", "drag", "error of I3/I1 %", "errors over the sensor's",
              "halves apart", "off", "error %", "they end"]  # fmt: skip
    text = "\n\n".join([" ".join((__doc__ or "").split("\n\n")[1].split()),
                        " ".join((__doc__ or "").split("\n\n")[2].split()),
                        common.table(header, rows)])  # fmt: skip
    packages = ("jax", "equinox", "numpy", "scipy")
    common.report("throws", "A hundred throws with what no model has", text, packages, given.write)


if __name__ == "__main__":
    main()
