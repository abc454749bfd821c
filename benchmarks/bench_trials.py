"""Groups of trials like real ones: do the stated errors account for the scatter?

Each world is one body and a series of trials of it by an independent integrator
(tests/worlds.py). The body is flat, of moments 0.07, 0.93 and 1, or a general one of
0.5, 0.8 and 1 (their unit plays no role), its axes at random. A trial lasts 0.5 to 1 s
at 200 Hz, at 5 to 20 rad/s about any axis or nearly about a principal one; quadratic
drag takes 0.3 % of the spin in a radian; the gyro's noise is 0.05 % of the spin. An
unmodelled torque acts along the principal axes: Ornstein-Uhlenbeck processes of
correlation time tau, whose standard deviation is in proportion to the spin. It differs
between axes (40 % in the logarithm, drawn for each world) and between trials (40 %
again). Its size is the same for every tau; tau = 0 is white torque with the spectral
density that tau = 0.05 s has at frequency 0. Trials are "plain"; "turned": the axes of
the gyro are turned by 2.4 degrees, about a random axis for each session of 28 trials;
"foreign": 6 % of the trials are of a body whose smallest moment is 10 % larger; or,
with `--cases both`, turned and foreign.

Groups of 16 trials are interleaved (every seventh trial) or blocks of consecutive
trials. Each group is one fit of a list of records. It is given the form of the drag,
that there may be a torque (`unmodelled="estimate"`), that the flat body is flat, and
which of the turned trials are of one session. The axes are those of the first session
of the group, and the turns of others are sought (`each(gyro.misalignment, sessions)`).

Errors: rms over groups of the estimate less the truth over the error stated, of I2/I1,
I3/I1 and the drag. Between: root of chi-square over its degrees of freedom of the
groups of a world about their weighted mean. Both are 1 where errors are right, and are
of the fits that do not end WRONG_BASIN, NOT_CONVERGED or BAD_INPUT. Over the sensor's:
errors stated over the part of the sensors, median of all fits and numbers. Named:
trials of the other body that the fits left out (`rejected_trials`), of all such trials;
wrongly: the body's own trials that they left out. Seconds include compilation.

`python benchmarks/bench_trials.py` makes the table of the flat body, with
`--body general` that of the general one; `--worlds`, `--taus` and `--cases` choose a
part of it.
"""

import collections
import pathlib
import sys
import time
from dataclasses import dataclass, replace
from typing import NamedTuple

import common
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid import identify
from jrigid.identify import Status

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "tests"))
import worlds  # pyright: ignore[reportMissingImports]

BODIES = {"flat": (0.07, 0.93, 1.0), "general": (0.5, 0.8, 1.0)}
DRAG = 0.003
SCENE = {
    "rate": 200.0,
    "duration": (0.5, 1.0),
    "spin": (5.0, 20.0),
    "drag": DRAG,
    "sigma": 5e-4,
    "wobble": 0.0,
    "time_constant": 0.0,
}
TAUS = (0.0, 0.05, 0.1, 0.2, 0.5)
TAU_OF_WHITE = 0.05  # of the torque whose spectral density white torque has
BETWEEN_AXES = 0.4  # standard deviation of the logarithm of the level
BETWEEN_TRIALS = 0.4
CASES = ("plain", "turned", "foreign", "both")
GROUPINGS = ("interleaved", "consecutive")
FAILED = (Status.WRONG_BASIN, Status.NOT_CONVERGED, Status.BAD_INPUT)
NAMES = [x for x in dir(Status) if isinstance(getattr(Status, x), Status)]


@dataclass(frozen=True)
class World:
    """Trials of a body, and the truth.

    Attributes:
        moments: Principal moments of the body, ascending (3,).
        trials: A `worlds.Record` of each trial, readings along the axes of the gyro.
        foreign: Whether each trial is of the other body (trials,).
        turned: Whether the axes of the gyro are turned for each session.
    """

    moments: np.ndarray
    trials: list
    foreign: np.ndarray
    turned: bool

    @property
    def truth(self):
        """I2/I1, I3/I1 and the drag's coefficient."""
        ratios = self.moments[1:] / self.moments[0]
        return np.append(ratios, DRAG * np.mean(self.moments))


def random_turn(rng, degrees):
    """A rotation matrix by an angle about a random axis."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    return Rotation.from_rotvec(degrees * axis, degrees=True).as_matrix()


def turned(rng, trials, degrees, session):
    """Trials read along axes that are turned anew for each session."""
    sessions = -(-len(trials) // session)
    turns = [random_turn(rng, degrees) for _ in range(sessions)]
    return [
        replace(trial, readings=trial.readings @ turns[i // session].T)
        for i, trial in enumerate(trials)
    ]


def other_body(moments, by):
    """Moments of the body that foreign trials are of: a flat body's is flat, too."""
    small, middle, large = moments
    flat = np.isclose(small + middle, large)
    small = small * (1 + by)
    return (small, middle, small + middle if flat else large)


def world_of(options, case, tau, seed):
    """A world of a case and a correlation time; equal seeds draw equal spins."""
    moments = np.array(BODIES[options.body])
    rng = np.random.default_rng([options.seed, seed])
    axes = worlds.random_axes(rng)
    deviation = options.level * np.exp(BETWEEN_AXES * rng.normal(size=3))
    scene = SCENE | {
        "ou": deviation * np.sqrt(2 * (tau or TAU_OF_WHITE)),
        "tau": tau,
        "ou_scatter": BETWEEN_TRIALS,
        "axes": axes,
    }
    trials = worlds.trials(rng, options.trials, tuple(moments), **scene)
    foreign = np.zeros(options.trials, bool)
    if case in ("foreign", "both"):
        count = round(options.foreign * options.trials)
        foreign[rng.choice(options.trials, count, replace=False)] = True
        others = other_body(moments, options.foreign_by)
        strange = worlds.trials(rng, count, others, **scene)
        for i, trial in zip(np.flatnonzero(foreign), strange, strict=True):
            trials[i] = trial
    is_turned = case in ("turned", "both")
    if is_turned:
        trials = turned(rng, trials, options.turn, options.session)
    return World(moments, trials, foreign, is_turned)


def groups_of(grouping, trials, size):
    """Indices of the trials of each group (groups, size)."""
    count = trials // size
    whole = np.arange(count * size)
    return (
        whole.reshape(size, count).T
        if grouping == "interleaved"
        else whole.reshape(count, size)
    )


def drag_of(body):
    """What is sought beside the inertia of trials of one session."""
    return body.torque.coefficient


def drag_and_turns(sessions):
    """What is sought beside the inertia; sessions count from -1, the first."""

    def free(body, gyro):
        return body.torque.coefficient, identify.each(gyro.misalignment, sessions)

    return free


def sessions_of(groups, session):
    """Which session of its group each trial is of, from -1 on (groups, size)."""
    return (
        np.array([np.unique(x // session, return_inverse=True)[1] for x in groups]) - 1
    )


def fit_groups(body, trials_of_groups, sessions):
    """One fit for each group of trials: those with the same sessions side by side.

    Args:
        body: Which.
        trials_of_groups: Records of each group.
        sessions: Of each trial (groups, size).

    Returns:
        What each fit found, in the order of the groups.
    """
    moments = np.array(BODIES[body])
    system = jr.RigidBody(
        np.full(3, moments.mean()), jr.torques.QuadraticDrag(jnp.asarray(1e-3))
    )
    records = [
        [identify.Rates(x.ts, x.readings, x.sigma) for x in trials]
        for trials in trials_of_groups
    ]
    shape = identify.Flat() if body == "flat" else identify.Tensor()
    found: list[Found] = [None] * len(records)  # pyright: ignore[reportAssignmentType]
    for pattern in np.unique(sessions, axis=0):
        places = np.flatnonzero(np.all(sessions == pattern, axis=1))
        fits = identify.fit_each(
            system,
            [records[i] for i in places],
            free=drag_and_turns(pattern) if np.any(pattern >= 0) else drag_of,
            inertia_model=shape,
            unmodelled="estimate",
            throw=False,
        )
        for lane, place in enumerate(places):
            found[place] = Found.of(jax.tree.map(lambda x, i=lane: x[i], fits))
    return jax.tree.map(lambda *x: np.stack(x), *found)


class Found(NamedTuple):
    """What is looked at of a fit, or of many."""

    estimates: np.ndarray  # I2/I1, I3/I1 and the drag's coefficient
    errors: np.ndarray
    over_sensor: (
        np.ndarray
    )  # errors of ratios over the part of the sensors, in the median
    status: np.ndarray
    left_out: np.ndarray

    @classmethod
    def of(cls, fit):
        """Of one fit."""
        drag, drag_error = fit.estimates["torque.coefficient"]
        whole = np.diagonal(np.asarray(fit.numbers_covariance))
        own = np.diagonal(np.asarray(fit.diagnostics.sensor_covariance))
        return cls(
            np.append(fit.ratios, drag),
            np.append(fit.ratios_errors, drag_error),
            np.median(np.sqrt(whole / own)),
            np.asarray(fit.status),
            np.asarray(fit.rejected_trials),
        )


def chi_square_between(values, errors):
    """Chi-square of groups about their weighted mean, and its degrees of freedom."""
    weights = 1 / errors**2
    mean = np.sum(weights * values, axis=0) / np.sum(weights, axis=0)
    return np.sum(weights * (values - mean) ** 2, axis=0), len(values) - 1


def rms_between(values, errors, usable):
    """Scatter between groups of each world over stated errors; pooled over worlds.

    Args:
        values: Estimates (worlds, groups, 3).
        errors: What was stated.
        usable: Which fits count (worlds, groups).
    """
    total, freedom = np.zeros(3), 0
    for x, error, good in zip(values, errors, usable, strict=True):
        if np.sum(good) > 1:
            square, count = chi_square_between(x[good], error[good])
            total += square
            freedom += count
    return np.sqrt(total / max(freedom, 1))


def how_they_end(status):
    """How many fits ended in each state."""
    names = {int(getattr(Status, x)): x for x in NAMES}
    counts = collections.Counter(names[int(x)] for x in status)
    return ", ".join(f"{count} {name}" for name, count in counts.most_common())


def row_of(options, drawn, grouping):
    """Figures of all fits of one grouping over the worlds that were drawn."""
    start = time.perf_counter()
    groups = groups_of(grouping, options.trials, options.group)
    trials = [[world.trials[i] for i in group] for world in drawn for group in groups]
    of_groups = sessions_of(groups, options.session)
    if not drawn[0].turned:
        of_groups[:] = -1
    found = fit_groups(options.body, trials, np.tile(of_groups, (len(drawn), 1)))
    values, errors = found.estimates, found.errors
    usable = ~np.isin(found.status, [int(x) for x in FAILED])
    usable &= np.all(np.isfinite(errors) & (errors > 0), axis=1)
    pulls = ((values - drawn[0].truth) / errors)[usable]
    by_world = (len(drawn), len(groups))
    between = rms_between(
        values.reshape(*by_world, 3),
        errors.reshape(*by_world, 3),
        usable.reshape(by_world),
    )
    foreign = np.concatenate([world.foreign[groups] for world in drawn])
    left_out = found.left_out
    return [
        *(f"{x:.2f}" for x in np.sqrt(np.mean(pulls**2, axis=0))),
        *(f"{x:.2f}" for x in between),
        f"{100 * np.median(errors[usable, 1] / drawn[0].truth[1]):.2f}",
        f"{np.median(found.over_sensor[usable]):.1f}",
        how_they_end(found.status),
        f"{np.sum(left_out & foreign)} of {np.sum(foreign)}",
        f"{np.sum(left_out & ~foreign)} of {np.sum(~foreign)}",
        f"{time.perf_counter() - start:.0f}",
    ]


def arguments():
    parser = common.arguments(__doc__)
    parser.add_argument("--body", choices=BODIES, default="flat")
    parser.add_argument("--trials", type=int, default=112, help="of a world")
    parser.add_argument("--group", type=int, default=16, help="trials of a fit")
    parser.add_argument("--worlds", type=int, default=2, help="of each row")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--taus", type=float, nargs="+", default=TAUS, help="[s]")
    parser.add_argument("--cases", choices=CASES, nargs="+", default=CASES[:3])
    parser.add_argument(
        "--level",
        type=float,
        default=0.01,
        help="standard deviation of the torque over the mean moment and the spin [1/s]",
    )
    parser.add_argument(
        "--turn", type=float, default=2.4, help="of a session's axes [degrees]"
    )
    parser.add_argument("--session", type=int, default=28, help="trials of a session")
    parser.add_argument(
        "--foreign", type=float, default=0.06, help="fraction of the trials"
    )
    parser.add_argument(
        "--foreign-by",
        type=float,
        default=0.1,
        help="relative change of the smallest moment",
    )
    return parser.parse_args()


def main():
    options = arguments()
    rows = []
    for case in options.cases:
        for tau in options.taus:
            drawn = [
                world_of(options, case, tau, seed) for seed in range(options.worlds)
            ]
            for grouping in GROUPINGS:
                rows.append(
                    [case, f"{tau:g}", grouping, *row_of(options, drawn, grouping)]
                )
                print(*rows[-1], sep=" | ", flush=True)
    header = [
        "trials",
        "tau [s]",
        "groups",
        "errors of I2/I1",
        "I3/I1",
        "drag",
        "between: I2/I1",
        "I3/I1",
        "drag",
        "error of I3/I1 %",
        "over the sensor's",
        "they end",
        "named",
        "wrongly",
        "s",
    ]
    explained = [" ".join(x.split()) for x in (__doc__ or "").split("\n\n")[1:3]]
    sizes = (
        f"The {options.body} body; in each row {options.worlds} worlds of "
        f"{options.trials} trials, in groups of {options.group}. The standard "
        f"deviation of the torque is about {options.level:g} / s times the spin and "
        "the mean moment."
    )
    text = "\n\n".join([*explained, sizes, common.table(header, rows)])
    packages = ("jax", "equinox", "numpy", "scipy")
    common.report("trials", "Trials like real ones", text, packages, options.write)


if __name__ == "__main__":
    main()
