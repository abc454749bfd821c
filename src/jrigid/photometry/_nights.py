"""Light curves that are planned: which ones would tell tumblers apart."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jrigid._checks import demand
from jrigid.photometry._alias import Alias, rows_at
from jrigid.photometry._curve_readings import orthonormal, readings_of
from jrigid.photometry._damit_files import LightCurve

_DAY = 86400.0


@dataclasses.dataclass(frozen=True)
class NightPlan:
    """A choice of planned light curves that tells aliases apart.

    Attributes:
        chosen: Indices of the curves, the most useful one first.
        growth: For each pair of aliases, the growth of chi-square by all of these
            curves that the wrong one of the pair has at least.
        decided: Pairs of aliases (ranks from 1) that each chosen curve tells apart
            first.
        threshold: Growth above which a pair is apart.
        dates: Julian dates of the first and last point of each chosen curve.

    >>> import numpy as np, jrigid as jr
    >>> growth = np.array([[0.0, 80.0], [80.0, 0.0]])
    >>> plan = jr.photometry.NightPlan([3], growth, [[(1, 2)]], 25.0, [(10.5, 10.6)])
    >>> print(plan.report().splitlines()[0])  # as `Inversion.choose_nights` returns it
    curve 3, JD 10.50 to 10.60: tells 1 from 2 (80) apart
    """

    chosen: list[int]
    growth: Float[np.ndarray, "aliases aliases"]
    decided: list[list[tuple[int, int]]]
    threshold: float
    dates: list[tuple[float, float]]

    def report(self) -> str:
        """The plan in words."""
        return _report(self)


class Predictions(NamedTuple):
    """Predictions of aliases for planned light curves, over the noise.

    Attributes:
        rows: Of each alias, but for the sign.
        slopes: Derivatives in the numbers of the alias.
        basis: Columns that unknown factors of the curves add.
        of_curve: Index of the curve of each point.
    """

    rows: Float[np.ndarray, "aliases points"]
    slopes: Float[np.ndarray, "aliases points 11"]
    basis: Float[np.ndarray, "points factors"]
    of_curve: np.ndarray


def predictions(
    aliases: Sequence[Alias],
    curves: Sequence[LightCurve],
    noise: float,
    epoch: float,
    span: float,
) -> Predictions:
    """Predictions of aliases for planned light curves.

    Args:
        aliases: The aliases.
        curves: Planned light curves; their brightness is not used.
        noise: Standard deviation of a point [mag].
        epoch: Julian date of time 0 of the aliases.
        span: Time within which their numbers count cycles [s].
    """
    plain = [dataclasses.replace(x, brightness=np.ones(len(x.ts))) for x in curves]
    readings, middle = readings_of(plain, noise)
    there = readings.weights > 0
    ts = np.where(there, readings.ts + (middle - epoch) * _DAY, 0.0)
    basis = readings.basis
    # Unknown factors are taken out later, of the curves that are chosen.
    readings = readings._replace(
        ts=ts,
        span=np.asarray(span),
        values=np.zeros_like(readings.values),
        basis=np.zeros_like(basis),
    )
    # The last row is no point, but the equation between the periods.
    pairs = [rows_at(x.numbers, x.task, readings) for x in aliases]
    return Predictions(
        rows=np.stack([np.asarray(rows)[:-1][there] for rows, _ in pairs]),
        slopes=np.stack([np.asarray(slopes)[:-1][there] for _, slopes in pairs]),
        basis=basis[there],
        of_curve=np.repeat(np.arange(len(curves)), [len(x.ts) for x in curves]),
    )


def growths(
    predicted: Predictions, aliases: Sequence[Alias], chosen: Sequence[int]
) -> Float[np.ndarray, "aliases aliases"]:
    """Least growth of chi-square by some of the curves together, for each pair.

    The difference of the predictions is compared with the noise and with what both
    predictions may still change by, each by its own covariance: both aliases move until
    they are as near as they can be.
    """
    points = np.isin(predicted.of_curve, chosen)
    rows = predicted.rows[:, points]
    slopes = predicted.slopes[:, points]
    # Factors are known from the chosen points alone.
    factors = orthonormal(predicted.basis[points])
    rows = rows - (rows @ factors) @ factors.T
    slopes = slopes - np.einsum("pf,qf,aqn->apn", factors, factors, slopes)
    count = len(aliases)
    result = np.zeros((count, count))
    for i, j in itertools.combinations(range(count), 2):
        # The rows are over the noise, which therefore has unit variance.
        spread = np.eye(rows.shape[1])
        for k in (i, j):
            spread = spread + slopes[k] @ aliases[k].covariance @ slopes[k].T
        difference = rows[j] - rows[i]
        result[i, j] = difference @ np.linalg.solve(spread, difference)
    return result + result.T


def chosen_nights(
    predicted: Predictions,
    aliases: Sequence[Alias],
    curves: Sequence[LightCurve],
    threshold: float,
) -> NightPlan:
    """Choose curves one after the other until the pairs of aliases are apart.

    Each choice is the curve with which the growths, cut off at the threshold, have the
    largest sum. More curves never let a growth fall, so a pair that all curves together
    leave below the threshold is not sought.
    """
    demand(
        threshold > 0, f"Argument `threshold` must be positive, but it is {threshold}."
    )
    chosen: list[int] = []
    decided: list[list[tuple[int, int]]] = []
    growth = np.zeros((len(aliases), len(aliases)))
    possible = np.triu(growths(predicted, aliases, range(len(curves))) >= threshold, 1)
    while np.any(growth[possible] < threshold):
        left = [k for k in range(len(curves)) if k not in chosen]
        trials = [growths(predicted, aliases, [*chosen, k]) for k in left]
        gains = [np.sum(np.minimum(x[possible], threshold)) for x in trials]
        best = int(np.argmax(gains))
        apart = possible & (trials[best] >= threshold) & (growth < threshold)
        growth = trials[best]
        chosen.append(left[best])
        decided.append([(int(i) + 1, int(j) + 1) for i, j in np.argwhere(apart)])
    times = [curves[k].epoch + np.sort(curves[k].ts)[[0, -1]] / _DAY for k in chosen]
    dates = [(float(start), float(end)) for start, end in times]
    return NightPlan(chosen, growth, decided, threshold, dates)


def _report(plan: NightPlan) -> str:
    """The plan in words."""
    lines = []
    for index, (start, end), pairs in zip(
        plan.chosen, plan.dates, plan.decided, strict=True
    ):
        pairs_told_apart = ", ".join(
            f"{i} from {j} ({plan.growth[i - 1, j - 1]:.0f})" for i, j in pairs
        )
        lines.append(
            f"curve {index}, JD {start:.2f} to {end:.2f}: "
            + (f"tells {pairs_told_apart} apart" if pairs_told_apart else "helps")
        )
    count = len(plan.growth)
    missed = [
        f"{i + 1} and {j + 1} ({plan.growth[i, j]:.0f})"
        for i, j in itertools.combinations(range(count), 2)
        if plan.growth[i, j] < plan.threshold
    ]
    if missed:
        lines.append(f"Not even all curves together tell apart {', '.join(missed)}.")
    elif count < 2:
        lines.append("There is one alias, so that nothing must be told apart.")
    lines.append(
        "In brackets: by how much the chi-square of the wrong one grows at least, by "
        f"all of these curves; {plan.threshold:g} decides."
    )
    return "\n".join(lines)
