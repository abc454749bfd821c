"""How many 95 % intervals of ratios hold the truth where moments nearly coincide.

A gap is in standard errors of an isolated gap. Tensors: the estimate is the truth and
normal errors of 0.5 % of a moment, no fit; errors alike in all five numbers, or with
variances across a factor of ten in directions drawn anew for each trial, or a tenth in
the variance of I2 - I1. Fits: `fit` of simulated records of a gyro, ten turns of twenty
samples each. By derivatives: the estimate and 1.96 times its error by derivatives of
the sorted moments; there `jr.identify` had nothing better before.
"""

import functools
import time

import common
import jax
import jax.numpy as jnp
import numpy as np

import jrigid as jr
from jrigid.identify import Plan, Rates, Status, fit_each
from jrigid.identify._intervals import interval

GAPS, WIDE = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0), 50.0
ERROR = 0.005  # of each of the five numbers
TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
TURN *= np.linalg.det(TURN)
SPHERE = jr.RigidBody(np.ones(3))
TS = np.arange(200) * 2 * np.pi / 20
# Moments but for the gap, which of them it widens, the spin in principal axes, the
# noise [rad/s].
BODIES = {
    "(0.6794, +, 0.6892), 0.1 %": ((0.6794, 0.6794, 0.6892), 1, (0.5, 0.3, 0.8), 0.001),
    "(1, +, 1.6), 1 %": ((1.0, 1.0, 1.6), 1, (0.5, 0.3, 0.8), 0.01),
    "(1, 1.6, +), 1 %": ((1.0, 1.6, 1.6), 2, (0.8, 0.3, 0.5), 0.01),
}


def basis():
    """Five orthonormal traceless symmetric matrices; the first is half of I2 - I1."""
    found = np.zeros((5, 3, 3))
    found[0], found[1] = (
        np.diag([-1, 1, 0]) / np.sqrt(2),
        np.diag([1, 1, -2]) / np.sqrt(6),
    )
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2)), 2):
        found[k, i, j] = found[k, j, i] = np.sqrt(0.5)
    return jnp.asarray(found)


def ratio(which, tensor):
    moments = jr.principal_axes(tensor).moments
    return moments[which] / moments[0]


def quick_ratio(which, tensor):
    """By the roots of a cubic: five times quicker, equal moments to 1e-8 alone."""
    mean = jnp.trace(tensor) / 3
    rest = tensor - mean * jnp.eye(3)
    size = jnp.sqrt(jnp.sum(rest**2) / 6)
    angle = jnp.arccos(jnp.clip(jnp.linalg.det(rest) / (2 * size**3), -1.0, 1.0)) / 3
    low, high = (mean + 2 * size * jnp.cos(angle + x) for x in (2 * np.pi / 3, 0.0))
    return (high if which == 2 else 3 * mean - low - high) / low


def both(tensor, covariance):
    """Intervals of both ratios, new ones and by derivatives: (way, limit, ratio)."""
    new, old = [], []
    for which in (1, 2):
        function = functools.partial(ratio, which)
        quick = functools.partial(quick_ratio, which)
        new.append(interval(quick, tensor, covariance, jnp.asarray(0.95)))
        slope = jax.jacfwd(function)(tensor).ravel()
        far = 1.96 * jnp.sqrt(slope @ covariance @ slope)
        old.append(function(tensor) + jnp.stack([-far, far]))
    return jnp.stack([jnp.stack(new), jnp.stack(old)]).transpose(0, 2, 1)


@jax.jit
def of_tensors(tensors, roots):
    """Of estimates, and roots of their covariances in the numbers (trials, 5, 5)."""

    def one(pair):
        tensor, root = pair
        elements = root.T @ basis().reshape(5, 9)
        return both(tensor, elements.T @ elements)

    return jax.lax.map(one, (tensors, roots))


def of_fits(values, noise):
    """Intervals of fits, by their own method and by derivatives, and how they ended."""
    found = fit_each(SPHERE, [Rates(TS, y, noise) for y in values])
    intervals = jax.jit(jax.vmap(lambda x: x.ratios_intervals))(found)
    plain = jax.jit(jax.vmap(lambda x, y: both(x, y)[1]))
    return intervals, plain(found.inertia, found.inertia_covariance), found.status


def judged(limits, truth):
    """Covered % and median width, of each ratio; limits (trials, limit, ratio)."""
    limits = np.asarray(limits)
    near = truth + 1e-6 * (truth - 1 + ERROR)  # of `quick_ratio`
    inside = (limits[:, 0] <= near) & (truth <= limits[:, 1])
    return 100 * np.mean(inside, axis=0), np.median(limits[:, 1] - limits[:, 0], axis=0)


def tensor_trials(gaps, kind, trials, rng):
    """Moments, estimates and roots of covariances."""
    unit = np.sqrt(2) * ERROR * (np.sqrt(0.1) if kind == "along" else 1.0)
    first, second = gaps[0] * unit, gaps[1] * np.sqrt(2) * ERROR
    moments = 1 - (2 * first + second) / 3 + np.array([0, first, first + second])
    roots = np.broadcast_to(ERROR * np.eye(5), (trials, 5, 5)).copy()
    if kind == "any":
        turns = np.linalg.qr(rng.normal(size=(trials, 5, 5)))[0]
        roots = ERROR * turns * 10.0 ** np.linspace(-0.25, 0.25, 5)
    elif kind == "along":
        roots[:, 0, 0] *= np.sqrt(0.1)
    errors = np.einsum(
        "nij,nj,iab->nab", roots, rng.normal(size=(trials, 5)), np.asarray(basis())
    )
    return moments, np.diag(moments) + errors, roots


def tensors(trials):
    rows, rng = [], np.random.default_rng(5)
    names = {"alike": "alike", "any": "any directions", "along": "I2 - I1 known better"}
    others = {
        "alike": ("12, 50", "12, 0", "12, 1", "50, 23"),
        "any": ("12, 50", "12, 0"),
        "along": ("12, 50",),
    }
    for kind, name in names.items():
        for place in others[kind]:
            for gap in GAPS:
                pair = [
                    gap if x in ("12", "23") else float(x) for x in place.split(", ")
                ]
                moments, estimates, roots = tensor_trials(pair, kind, trials, rng)
                limits = np.asarray(
                    of_tensors(jnp.asarray(estimates), jnp.asarray(roots))
                )
                truth = moments[1:] / moments[0]
                (new, width), (old, far) = (
                    judged(limits[:, i], truth) for i in range(2)
                )
                cells = [f"{x:g}" for x in pair]
                row = [f"{x:.1f}" for x in (new[0], old[0], new[1], old[1])]
                rows.append([name, *cells, *row, *(width / far)])
                print(*rows[-1], flush=True)
    return rows


def records(name, gap, trials, rng):
    """Moments and readings (trials, samples, 3) of a body with a gap in errors."""
    moments, which, spin, noise = BODIES[name]
    turned = lambda m: (TURN * np.asarray(m)) @ TURN.T  # noqa: E731
    omega = TURN @ np.array(spin) / np.linalg.norm(spin)
    start = jr.State(np.array([1.0, 0.0, 0.0, 0.0]), omega)
    plan = Plan(jr.RigidBody(turned(moments)), start, Rates(TS, None, noise))
    known = plan.predicted
    slopes = jax.jacfwd(known.unknowns.inertia)(known.numbers).reshape(9, -1)
    covariance = slopes @ plan.bound.covariance[:5, :5] @ slopes.T
    covariance = np.asarray(covariance).reshape(3, 3, 3, 3)
    inside = np.einsum("ia,jb,ijkl,kc,ld->abcd", TURN, TURN, covariance, TURN, TURN)
    i, j = which - 1, which
    square = inside[i, i, i, i] + inside[j, j, j, j] - 2 * inside[i, i, j, j]
    unit = np.sqrt((square + 4 * inside[i, j, i, j]) / 2)
    moments = np.array(moments)
    moments[which:] += gap * unit * (np.arange(which, 3) == which)
    rates = np.asarray(jr.free_rotation(turned(moments), start, TS).omega)
    return moments, rates + noise * rng.normal(size=(trials, *rates.shape))


def fits(trials):
    rows, rng = [], np.random.default_rng(6)
    for name in BODIES:
        for gap in GAPS:
            moments, values = records(name, gap, trials, rng)
            new, old, status = of_fits(values, BODIES[name][-1])
            good = np.isin(np.asarray(status), [int(Status.OK)])
            truth = np.sort(moments)[1:] / moments.min()
            (new, width), (old, far) = (
                judged(np.asarray(x)[good], truth) for x in (new, old)
            )
            row = [f"{x:.1f}" for x in (new[0], old[0], new[1], old[1])]
            rows.append([name, f"{gap:g}", int(good.sum()), *row, *(width / far)])
            print(*rows[-1], flush=True)
    return rows


def together(rows):
    """Of all bodies, by gap: fits that are OK, and the mean of what they cover."""
    mean = {
        gap: np.mean([[float(x) for x in r[2:7]] for r in rows if r[1] == gap], axis=0)
        for gap in dict.fromkeys(r[1] for r in rows)
    }
    return [
        [gap, round(x[0] * len(BODIES)), *(f"{y:.1f}" for y in x[1:])]
        for gap, x in mean.items()
    ]


def speed():
    """Milliseconds of an interval, and of compiling one."""
    rows = []
    for gap in (1.0, WIDE):
        _, estimates, roots = tensor_trials(
            (gap, WIDE), "alike", 1, np.random.default_rng(0)
        )
        elements = roots[0].T @ np.asarray(basis()).reshape(5, 9)
        given = (
            jnp.asarray(estimates[0]),
            jnp.asarray(elements.T @ elements),
            jnp.asarray(0.95),
        )
        function = functools.partial(ratio, 1)
        start = time.perf_counter()
        jax.block_until_ready(interval(function, *given))
        first = (time.perf_counter() - start) * 1e3
        case = {"": lambda function=function, given=given: interval(function, *given)}
        least, median, _ = common.timed(case)[""]
        rows.append([f"I2/I1, gap {gap:g}", first, least, median])
    return rows


def main():
    parser = common.arguments(__doc__)
    parser.add_argument(
        "--trials", type=int, default=500, help="of tensors, in each cell"
    )
    parser.add_argument("--fits", type=int, default=300, help="in each cell")
    parser.add_argument(
        "--speed", action="store_true", help="print the times of a call alone"
    )
    given = parser.parse_args()
    times = common.table(
        ["one interval", "first call ms", "min ms", "median ms"], speed()
    )
    if given.speed:
        print(common.machine(["jax"]), times, sep="\n\n")
        return
    ratios = [
        "I2/I1 covered %",
        "by derivatives",
        "I3/I1 covered %",
        "by derivatives",
        "width to that by derivatives",
        "of I3/I1",
    ]
    fitted, all_fits = fits(given.fits), given.fits * len(BODIES)
    text = "\n\n".join(
        [
            times,
            f"Tensors, {given.trials} in each cell (a standard error of 95 % is "
            f"{100 * np.sqrt(0.0475 / given.trials):.1f} points).",
            common.table(
                ["errors", "gap 1, 2", "gap 2, 3", *ratios], tensors(given.trials)
            ),
            f"Fits, {given.fits} in each cell "
            f"({100 * np.sqrt(0.0475 / given.fits):.1f} points).",
            common.table(["moments, noise", "gap", "OK", *ratios], fitted),
            "The bodies together (a standard error of "
            f"{100 * np.sqrt(0.0475 / all_fits):.1f} points):",
            common.table(["gap", "OK", *ratios[:4]], together(fitted)),
        ]
    )
    packages = ("jax", "equinox", "numpy")
    common.report(
        "intervals",
        "Intervals of the ratios where moments coincide",
        text,
        packages,
        given.write,
    )


if __name__ == "__main__":
    main()
