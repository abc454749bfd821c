"""Blind inversion of light curves of tumblers that another code made.

    python benchmarks/bench_tumblers.py [--case plain] [--bodies 40] [--write]

Each body is a random homogeneous ellipsoid that tumbles, half of them in each mode,
integrated by DOP853 of scipy and seen as facets in numpy
(tests/tumbler_reference.py). The geometry is that of Apophis from December 2012 to
April 2013: 110 days, 12 relative light curves of up to three nights, about 360 points
with a noise of 0.02 mag, unknown factors. `find_tumblers` knows that periods are
between 8 and 400 h. In the plain case it also knows the noise, and that the body is
homogeneous. In the case "noise-found" it finds the noise, and in "inertia-free" the
moments do not follow from the shape.

The table counts bodies whose true pair of periods and mode are in the alias table, and
first in it; how often 95 % intervals hold the truth; bodies that are said to be
determined and are wrong by more than six errors; and bodies with more than one pair
that fits.
"""

import pathlib
import sys
import time

import common
import numpy as np

from jrigid import photometry as ph

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "tests"))
import tumbler_reference  # pyright: ignore[reportMissingImports]

HOUR = 3600.0
CASES = {
    "plain": {"noise": 0.02},
    "noise-found": {"noise": None},
    "inertia-free": {"noise": 0.02, "inertia": "free"},
}
_ONE = 0.3  # cycles within the span: closer frequencies are one pair


def same(alias, truth, span):
    """Whether an alias has the true mode and the true periods."""
    if alias.tumbler.mode != truth.mode:
        return False
    pairs = [
        (alias.estimates.precession_period, truth.precession_period),
        (alias.estimates.rotation_period, truth.rotation_period),
    ]
    return all(abs(span / float(a) - span / b) < _ONE for a, b in pairs)


def direction(estimates):
    """Unit vector along the momentum."""
    across = np.cos(estimates.latitude)
    longitude = estimates.longitude
    return np.array(
        [
            across * np.cos(longitude),
            across * np.sin(longitude),
            np.sin(estimates.latitude),
        ]
    )


def pulls(alias, others, truth):
    """Errors over stated errors of what an alias says.

    Its momentum is that of one of the others, of the same motion, if that is nearer to
    the true one.
    """
    estimates, errors = alias.estimates, alias.errors
    moments = truth.moments[:2] / truth.moments[2]
    ratios = truth.semi_axes[1:] / truth.semi_axes[:2]
    omega = ph.omega_from_periods(
        truth.moments, truth.precession_period, truth.rotation_period, truth.mode
    )
    energy = ph.tumbling(truth.moments, omega).energy_ratio
    nearest = max([alias, *others], key=lambda x: direction(x.estimates) @ truth.pole)
    pole, spread = nearest.estimates, nearest.errors
    off = pole.longitude - np.arctan2(truth.pole[1], truth.pole[0])
    off = (off + np.pi) % (2 * np.pi) - np.pi
    rows = [
        (
            estimates.precession_period,
            errors.precession_period,
            truth.precession_period,
        ),
        (estimates.rotation_period, errors.rotation_period, truth.rotation_period),
        (pole.latitude, spread.latitude, np.arcsin(truth.pole[2])),
        *zip(estimates.moments, errors.moments, moments, strict=True),
        *zip(estimates.axis_ratios, errors.axis_ratios, ratios, strict=True),
        (estimates.energy_ratio, errors.energy_ratio, energy),
        (off, spread.longitude, 0.0),
    ]
    return np.array([float((value - true) / error) for value, error, true in rows])


def one_body(seed, mode, case):
    """Rank of the truth or None, its pulls, and the inversion."""
    curves, truth = tumbler_reference.tumbler(np.random.default_rng(seed), mode)
    start = time.process_time()
    found = ph.find_tumblers(
        curves, shortest=8 * HOUR, longest=400 * HOUR, **CASES[case]
    )
    seconds = time.process_time() - start
    span = max(x.ts.max() for x in curves)
    right = [same(alias, truth, span) for alias in found.aliases]
    rank = right.index(True) if any(right) else None
    others = [x for x, is_right in zip(found.aliases, right, strict=True) if is_right]
    if found.mirror is not None:
        others.append(found.mirror)
    pull = pulls(found.aliases[rank or 0], others, truth)
    return found, rank, pull, seconds


def main(bodies, case, write):
    """Invert all bodies and report."""
    rows = []
    every = []
    wrong = 0
    for index in range(bodies):
        mode = ("short-axis", "long-axis")[index % 2]
        found, rank, pull, seconds = one_body(1000 + index, mode, case)
        false = found.determined and (rank is None or np.abs(pull).max() > 6)
        wrong += false
        rows.append((mode, rank, found, seconds))
        if rank is not None and found.follows:
            every.append(pull)
        print(
            index,
            mode,
            "rank",
            rank,
            "aliases",
            len(found.aliases),
            f"chi2/dof {found.reduced_chi_square:.2f} {seconds:.0f} s",
            "FALSE" if false else "",
            np.round(pull, 1),
            flush=True,
        )
    covered = np.mean(np.abs(np.array(every)) < 1.96, axis=0)
    times = [seconds for *_, seconds in rows[2:]]
    counts = [
        ("true pair and mode in the alias table", sum(x[1] is not None for x in rows)),
        ("first in it", sum(x[1] == 0 for x in rows)),
        (
            "no tumbler found, and the report says so",
            sum(not x[2].follows for x in rows),
        ),
        ("said to be determined, and wrong or beyond six errors", wrong),
        ("more than one tumbler fits", sum(len(x[2].aliases) > 1 for x in rows)),
        (
            "of these with several periods or modes",
            sum(len(x[2].aliases) > 1 and not x[2].determined for x in rows),
        ),
    ]
    names = ["P_phi", "P_psi", "latitude", "I1/I3", "I2/I3", "b/a", "c/b"]
    names += ["E/E0", "longitude"]
    shares = ", ".join(f"{n} {x:.2f}" for n, x in zip(names, covered, strict=True))
    text = (
        common.table(["what", f"of {bodies} bodies"], counts)
        + f"\n\nShare of 95 % intervals that hold the truth: {shares}; "
        + f"all {np.mean(covered):.3f}.\n\nCPU seconds a body, without the first two, "
        + f"which compile: minimum {min(times):.0f}, median {np.median(times):.0f}."
    )
    title = f"Blind inversion of {bodies} tumblers, {case}"
    packages = ["jax", "scipy", "numpy"]
    common.report("tumblers", title, text, packages, write, f"--case {case}")


if __name__ == "__main__":
    parser = common.arguments(__doc__)
    parser.add_argument("--bodies", type=int, default=40)
    parser.add_argument("--case", choices=CASES, default="plain")
    options = parser.parse_args()
    main(options.bodies, options.case, options.write)
