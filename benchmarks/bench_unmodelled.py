"""A hundred trials with a torque that the model lacks: are the stated errors right?

The trials come from an independent integrator (tests/worlds.py). A flat body has the
moments 0.07, 0.93 and 1 (their unit plays no role). Each trial lasts 0.5 to 1 s at
100 Hz. The body spins at 5 to 20 rad/s about any axis, or nearly about a principal one.
Quadratic drag takes 0.3 % of the spin in a radian. The noise of the gyro is 0.05 % of
the spin (0.0025 to 0.01 rad/s), and its low-pass has a time constant of 3 ms. The
disturbance is white torque with a root spectral density of s over the mean moment
[rad / s^1.5], or a ball on a spring whose moment is a part of the smallest moment.
`fit` receives the form of the drag, and `unmodelled="estimate"` or a level.

Determined: the fit does not end MISFIT, WRONG_BASIN or NOT_CONVERGED, and the stated
error of I3/I1 is below a tenth of it. Scatter: root mean square of the errors of I2/I1,
of I3/I1 and of the drag, over the stated ones, in the determined trials. Explained: the
fit does not end MISFIT, WRONG_BASIN or NOT_CONVERGED. Over the sensor's: the stated
error over the part of it that the noise of the sensor alone would cause. Halves: two
fits of half the trials each. Their columns are the differences of both ratios over
their errors, the errors of I3/I1 over the stated ones, the stated error, and the
verdicts.
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
DISTURBANCES = {
    "none": {},
    "white, s = 0.01": {"kick": 0.01},
    "white, s = 0.03": {"kick": 0.03},
    "ball 0.03, 15 Hz": {"wobble": 0.03},
    "ball 0.1, 15 Hz": {"wobble": 0.1},
    "ball 0.1, 5 Hz": {"wobble": 0.1, "wobble_frequency": 5.0},
}
WHITE = "white, s = 0.01"
MODELS = {"flat": identify.Flat(), "any": identify.Tensor()}
FAILED = (Status.MISFIT, Status.WRONG_BASIN, Status.NOT_CONVERGED)
NAMES = [x for x in dir(Status) if isinstance(getattr(Status, x), Status)]


def trials_of(disturbance, count, seed):
    """Trials with this disturbance, each a `worlds.Record`."""
    return worlds.trials(
        np.random.default_rng(seed), count, **SCENE | DISTURBANCES[disturbance]
    )


def fitter(model, lag, unmodelled):
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
            body, records, free=free, inertia_model=MODELS[model], unmodelled=unmodelled
        )

    return fit_sets


def is_one_of(status, states):
    """Whether each fit ended in one of these states."""
    return np.any([np.asarray(status == x) for x in states], axis=0)


def drags_of(found):
    """The drag's coefficient in each fit, and its error."""
    values, errors = jax.vmap(lambda x: x.estimates["torque.coefficient"])(found)
    return np.asarray(values), np.asarray(errors)


def variances(covariances):
    """The diagonal of each of several covariances."""
    return np.diagonal(np.asarray(covariances), axis1=1, axis2=2)


def of_singles(found):
    """The columns of fits of single trials."""
    ratios = np.asarray(found.ratios)
    errors = np.asarray(found.ratios_errors)
    failed = is_one_of(found.status, FAILED)
    boundary = is_one_of(found.status, [Status.AT_BOUNDARY])
    determined = (errors[:, 1] < 0.1 * RATIOS[1]) & ~failed
    drag, drag_error = drags_of(found)
    pulls = np.column_stack(
        [(ratios - RATIOS) / errors, (drag - DRAG * MEAN) / drag_error]
    )
    scatter = np.sqrt(np.mean(pulls[determined] ** 2, axis=0))
    size = 100 * np.median(errors[determined, 1] / RATIOS[1])
    whole = variances(found.numbers_covariance)[determined]
    own = variances(found.diagnostics.sensor_covariance)[determined]
    return [
        f"{100 * np.mean(~failed):.0f}",
        f"{100 * np.mean(boundary):.0f}",
        int(determined.sum()),
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
    """The option `unmodelled` in a word."""
    if unmodelled == "estimate":
        return "estimate"
    return "known" if unmodelled else "none"


def main():
    parser = common.arguments(__doc__)
    parser.add_argument("--count", type=int, default=100, help="trials")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--any", action="store_true", help="also with any inertia tensor"
    )
    given = parser.parse_args()
    cases = [("flat", "known", "estimate", x) for x in DISTURBANCES]
    cases += [("flat", lag, "estimate", WHITE) for lag in ("sought", "ignored")]
    cases += [("flat", "known", level, WHITE) for level in (0.01 * MEAN, 0.0)]
    if given.any:
        cases += [("any", "known", "estimate", x) for x in DISTURBANCES]
    fits, rows = {}, []
    for model, lag, unmodelled, disturbance in cases:
        fit_sets = fits.setdefault(
            (model, lag, unmodelled), fitter(model, lag, unmodelled)
        )
        trials = trials_of(disturbance, given.count, given.seed)
        half = given.count // 2
        start = time.perf_counter()
        singles = of_singles(fit_sets([[x] for x in trials]))
        halves = of_halves(fit_sets([trials[:half], trials[half:]]))
        rows.append([disturbance, model, lag, name_of(unmodelled), *singles, *halves])
        print(*rows[-1], f"{time.perf_counter() - start:.0f} s", sep=" | ", flush=True)
    header = [
        "disturbance",
        "inertia model",
        "time constant",
        "unmodelled",
        "explained %",
        "at boundary %",
        "determined",
        "scatter I2/I1",
        "I3/I1",
        "drag",
        "error of I3/I1 %",
        "over the sensor's",
        "halves: differences",
        "errors of I3/I1",
        "stated error %",
        "verdicts",
    ]
    explained = [" ".join(x.split()) for x in (__doc__ or "").split("\n\n")[1:3]]
    text = "\n\n".join([*explained, common.table(header, rows)])
    packages = ("jax", "equinox", "numpy", "scipy")
    common.report(
        "unmodelled",
        "A hundred trials with a torque that the model lacks",
        text,
        packages,
        given.write,
    )


if __name__ == "__main__":
    main()
