"""A hundred trials of a racquet with drag and a loose mass: is `fit` honest?

The trials come from an independent integrator (tests/worlds.py): a flat body of moments
0.07, 0.93 and 1 (their unit plays no role), 0.5 to 1 s at 100 Hz, 5 to 20 rad/s, about
any axis or nearly about a principal one; quadratic drag takes 0.3 % of the spin in a
radian; the gyro's noise is 0.05 % of the spin (0.0025 to 0.01 rad/s), its low-pass has
3 ms. The lash is white torque, its root spectral density s over the mean moment [rad /
s^1.5], or a ball of so many parts of the smallest moment on a spring. `fit` is told the
drag's form, and that there may be a torque (`unmodelled="estimate"`).

Told: the error stated is below a tenth of the ratio. Scatter: rms of the errors of
I2/I1, of I3/I1 and of the drag over what was stated, of the trials that are told.
Explained: the fit does not end MISFIT, WRONG_BASIN or NOT_CONVERGED. Errors: those
stated over the part of the sensor. Halves: two fits of half the trials each; the
difference of both ratios over its error, and each half's I3/I1 less the truth over its
error.
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
MEAN = MOMENTS.mean()
RATIOS = MOMENTS[1:] / MOMENTS[0]
DRAG = 0.003
LAG = 0.003
SCENE = {
    "body": tuple(MOMENTS),
    "duration": (0.5, 1.0),
    "spin": (5.0, 20.0),
    "drag": DRAG,
    "time_constant": LAG,
    "sigma": 5e-4,
    "wobble": 0.0,
}
LASHES = {
    "none": {},
    "white, s = 0.01": {"kick": 0.01},
    "white, s = 0.03": {"kick": 0.03},
    "ball 0.03, 15 Hz": {"wobble": 0.03},
    "ball 0.1, 15 Hz": {"wobble": 0.1},
    "ball 0.1, 5 Hz": {"wobble": 0.1, "wobble_frequency": 5.0},
}
WHITE = "white, s = 0.01"
SHAPES = {"flat": identify.Flat(), "any": identify.Tensor()}
FAILED = (Status.MISFIT, Status.WRONG_BASIN, Status.NOT_CONVERGED)
NAMES = [x for x in dir(Status) if isinstance(getattr(Status, x), Status)]


def trials_of(lash, count, seed):
    """Trials of the world with this lash, each a `worlds.Record`."""
    return worlds.trials(np.random.default_rng(seed), count, **SCENE | LASHES[lash])


def fitter(shape, lag, unmodelled):
    """A function that fits each of several sets of trials."""
    body = jr.RigidBody(np.full(3, MEAN), jr.torques.QuadraticDrag(jnp.asarray(1e-3)))
    gyro = identify.Gyro(time_constant=None if lag == "ignored" else jnp.asarray(LAG))

    def free(body, gyro):
        sought = identify.prior(gyro.time_constant, 0.002) if lag == "sought" else ()
        return body.torque.coefficient, sought

    def fit_sets(sets):
        records = [
            [identify.Record(gyro, x.ts, x.readings, x.sigma) for x in trials]
            for trials in sets
        ]
        return identify.fit_each(
            body, records, free=free, inertia_model=SHAPES[shape], unmodelled=unmodelled
        )

    return fit_sets


def is_one_of(status, states):
    """Whether each fit ended in one of these states."""
    return np.any([np.asarray(status == x) for x in states], axis=0)


def drags_of(found):
    """The drag's coefficient in each fit, and its error."""
    values, errors = jax.vmap(lambda x: x.estimates["torque.coefficient"])(found)
    return np.asarray(values), np.asarray(errors)


def of_singles(found):
    """Explained %, at boundary %, determined, scatters, error of I3/I1, errors."""
    ratios = np.asarray(found.ratios)
    errors = np.asarray(found.ratios_errors)
    failed = is_one_of(found.status, FAILED)
    boundary = is_one_of(found.status, [Status.AT_BOUNDARY])
    told = (errors[:, 1] < 0.1 * RATIOS[1]) & ~failed
    drag, drag_error = drags_of(found)
    pulls = np.column_stack(
        [(ratios - RATIOS) / errors, (drag - DRAG * MEAN) / drag_error]
    )
    scatter = np.sqrt(np.mean(pulls[told] ** 2, axis=0))
    size = 100 * np.median(errors[told, 1] / RATIOS[1])
    whole = np.diagonal(np.asarray(found.numbers_covariance), axis1=1, axis2=2)[told]
    own = np.diagonal(
        np.asarray(found.diagnostics.sensor_covariance), axis1=1, axis2=2
    )[told]
    return [
        f"{100 * np.mean(~failed):.0f}",
        f"{100 * np.mean(boundary):.0f}",
        int(told.sum()),
        *(f"{x:.2f}" for x in scatter),
        f"{size:.2f}",
        f"{np.median(np.sqrt(whole / own)):.1f}",
    ]


def of_halves(found):
    """Differences of the ratios and each half's error over those stated; size."""
    ratios = np.asarray(found.ratios)
    errors = np.asarray(found.ratios_errors)
    apart = (ratios[0] - ratios[1]) / np.linalg.norm(errors, axis=0)
    off = (ratios[:, 1] - RATIOS[1]) / errors[:, 1]
    size = 100 * errors[0, 1] / RATIOS[1]
    ends = {int(getattr(Status, x)._value): x for x in NAMES}
    return [
        ", ".join(f"{x:+.1f}" for x in apart),
        ", ".join(f"{x:+.1f}" for x in off),
        f"{size:.3f}",
        ", ".join(ends[int(x)] for x in np.asarray(found.status)),
    ]


def name_of(unmodelled):
    """What a fit is told of the unmodelled torque, in a word."""
    if unmodelled == "estimate":
        return "estimate"
    return "known" if unmodelled else "none"


def main():
    parser = common.arguments(__doc__)
    parser.add_argument("--count", type=int, default=100, help="trials")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--any", action="store_true", help="also as a body of any shape"
    )
    given = parser.parse_args()
    cases = [("flat", "known", "estimate", lash) for lash in LASHES]
    cases += [("flat", lag, "estimate", WHITE) for lag in ("sought", "ignored")]
    cases += [("flat", "known", level, WHITE) for level in (0.01 * MEAN, 0.0)]
    if given.any:
        cases += [("any", "known", "estimate", lash) for lash in LASHES]
    fits, rows = {}, []
    for shape, lag, unmodelled, lash in cases:
        fit_sets = fits.setdefault(
            (shape, lag, unmodelled), fitter(shape, lag, unmodelled)
        )
        trials = trials_of(lash, given.count, given.seed)
        half = given.count // 2
        start = time.perf_counter()
        singles = of_singles(fit_sets([[x] for x in trials]))
        halves = of_halves(fit_sets([trials[:half], trials[half:]]))
        rows.append([lash, shape, lag, name_of(unmodelled), *singles, *halves])
        print(*rows[-1], f"{time.perf_counter() - start:.0f} s", sep=" | ", flush=True)
    header = [
        "lash",
        "shape",
        "lag",
        "unmodelled",
        "explained %",
        "at boundary %",
        "told",
        "scatter I2/I1",
        "I3/I1",
        "drag",
        "error of I3/I1 %",
        "errors over the sensor's",
        "halves apart",
        "off",
        "error %",
        "they end",
    ]
    explained = [" ".join(x.split()) for x in (__doc__ or "").split("\n\n")[1:3]]
    text = "\n\n".join([*explained, common.table(header, rows)])
    packages = ("jax", "equinox", "numpy", "scipy")
    common.report(
        "unmodelled",
        "A hundred trials with what no model has",
        text,
        packages,
        given.write,
    )


if __name__ == "__main__":
    main()
