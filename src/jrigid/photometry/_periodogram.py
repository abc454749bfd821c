"""Pairs of periods that may explain light curves, by Fourier series in two frequencies.

During an apparition the direction from which a body is seen and lit turns. The terms of
the series grow, shrink and shift with it, often by more than their size. So each term
has coefficients that are linear in the two directions in which the bisector of the Sun
and the observer moves most.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._checks import demand
from jrigid._core.host_rows import in_batches
from jrigid._numerics import product
from jrigid._types import Scalar
from jrigid.photometry._curve_readings import Readings, check_list, readings_of
from jrigid.photometry._damit_files import LightCurve

# Frequencies in one resolution element, 1 over the span.
_OVERSAMPLING = 4
_OVERSAMPLING_OF_LINES = 8
# Strongest lines of the ordinary periodogram of which one must be a line of the pair.
_LINES = 10
# A search takes minutes for 10,000 cycles. More than this are hours for seconds.
_MOST_CYCLES = 100_000
# Lines k f_phi + m f_psi that are the strongest ones of tumblers. An ellipsoid looks
# the same after half a turn about each of its axes, so m is even.
_STRONGEST = ((2, 0), (2, -2), (2, 2), (1, -2), (1, 2), (1, 0))
# Lines of the series that is fitted for a pair.
_SERIES = ((0, 2), (1, -2), (1, 0), (1, 2), (2, -2), (2, 0), (2, 2))
_LINE = ((1,),)
# Two candidates this many resolution elements apart are one, and two lines.
_APART = 0.5
_LINES_APART = 0.6
# A bisector that moves by less than this [rad, root mean square] modulates nothing.
_LEAST_MOTION = 0.02
# Points for each number of a series, below which its coefficients stay constant: with
# fewer the series of many wrong pairs follow the curves.
_POINTS_A_NUMBER = 5
# Added to the diagonal of the normal equations, as a fraction of its mean: some series
# hold the same line twice.
_RIDGE = 1e-4
# Least frequency of the rotation that is tried [cycles within the span].
_LEAST_CYCLES = 0.5
# A tumbler has up to eleven numbers, with one equation between them.
_LEAST_POINTS = 12
_LANES = 64  # series fitted at once
_BLOCK = 4096  # candidates in a call, so that a search compiles one program


class PeriodPairs(NamedTuple):
    """Pairs of periods, the best first.

    Attributes:
        precession_period: P_phi [s].
        rotation_period: P_psi [s].
        explained: Fraction of the variance of the light curves that a Fourier series
            with these periods explains.
    """

    precession_period: Float[np.ndarray, " pairs"]
    rotation_period: Float[np.ndarray, " pairs"]
    explained: Float[np.ndarray, " pairs"]


def period_pairs(
    curves: Sequence[LightCurve],
    shortest: float,
    longest: float,
    *,
    count: int = 60,
) -> PeriodPairs:
    """Pairs of periods of a tumbler by a two-dimensional periodogram.

    A light curve of a tumbler is a Fourier series in its two frequencies, with
    coefficients that change with the direction from which it is seen: they are linear
    in that direction here, but constant if there are few points. One of the strongest
    lines of the periodogram is taken for one of the lines 2 f_phi, 2 (f_phi - f_psi)
    and others; the second frequency is then sought on a grid.

    Args:
        curves: Light curves, relative or absolute.
        shortest: Shortest period [s].
        longest: Longest period [s].
        count: How many pairs are returned at most.

    Returns:
        The pairs, with unlike frequencies. Sampling by night, and frequencies that
        differ by f_psi, give many pairs that explain the curves about as well:
        `find_tumblers` tells them apart by the physics.

    Raises:
        ValueError: Fewer points than a tumbler has numbers, periods out of order, or
            curves that span less than half of the shortest period.

    Source: P. Pravec et al., Icarus 173 (2005) 108, section 3.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> ts = jnp.linspace(0.0, 1e6, 300)
    >>> # a line at 2 (f_phi - f_psi) and one at 2 f_phi
    >>> wave = 0.1 * jnp.cos(4 * jnp.pi * ts / 3e4)
    >>> wave = wave + 0.03 * jnp.cos(4 * jnp.pi * ts / 2e4)
    >>> far = jnp.ones((300, 3))
    >>> curve = jr.photometry.LightCurve(0.0, ts, 10**(-0.4 * wave), far, far, True)
    >>> pairs = jr.photometry.period_pairs([curve], 1e4, 1e5, count=5)
    >>> print(pairs.explained.round(2).max())
    1.0
    """
    points_of(curves)
    # Any noise will do: it drops out of the fraction that is explained.
    readings, _ = readings_of(curves, noise=0.01)
    span = float(readings.span)
    lowest, highest = cycles_within(span, shortest, longest)
    lines, _ = strongest_lines(readings, lowest, highest)
    pairs, powers = frequency_pairs(readings, lines, lowest, highest, count)
    explained = powers / float(np.sum(readings.values**2))
    return PeriodPairs(span / pairs[:, 0], span / pairs[:, 1], explained)


def points_of(curves: Sequence[LightCurve]) -> int:
    """Number of points of light curves.

    Raises:
        ValueError: They are fewer than the numbers of a tumbler.
    """
    check_list(curves)
    points = sum(len(x.ts) for x in curves)
    demand(
        points >= _LEAST_POINTS,
        f"Argument `curves` must hold at least {_LEAST_POINTS} points, but it holds "
        f"{points}.",
    )
    return points


def cycles_within(span: float, shortest: float, longest: float) -> tuple[float, float]:
    """Lowest and highest frequency of periods, in cycles within the span."""
    demand(
        bool(0 < shortest < longest),
        "Arguments `shortest` and `longest` must be positive periods in this order, "
        f"but they are {shortest:g} s and {longest:g} s.",
    )
    check_span(span, shortest)
    demand(
        bool(span <= _MOST_CYCLES * shortest),
        f"Argument `shortest` must be at least 1 / {_MOST_CYCLES} of the time that the "
        f"curves span, {span:.4g} s, but it is {shortest:g} s: are periods in seconds?",
    )
    return span / longest, span / shortest


def check_span(span: float, shortest: float) -> None:
    """Raise ValueError for curves that say nothing of the shortest period."""
    demand(
        bool(span > _LEAST_CYCLES * shortest),
        "Argument `curves` must span more than half of `shortest`, but they span "
        f"{span:.4g} s.",
    )


def frequency_pairs(
    readings: Readings,
    lines: Float[np.ndarray, " lines"],
    lowest: float,
    highest: float,
    count: int,
) -> tuple[Float[np.ndarray, "pairs 2"], Float[np.ndarray, " pairs"]]:
    """Pairs of frequencies, in cycles within the span, and chi-square they explain.

    Args:
        readings: The light curves.
        lines: Lines of their periodogram, each of which a pair has.
        lowest: Lowest frequency [cycles within the span].
        highest: Highest frequency.
        count: How many pairs are returned.
    """
    step = 1 / _OVERSAMPLING
    rotation = np.arange(max(lowest, _LEAST_CYCLES), highest, step)
    rows = []
    for line in lines:
        for k, m in _STRONGEST:
            precession = (line - m * rotation) / k
            inside = (precession > lowest) & (precession < highest)
            rows.append(np.stack([precession[inside], rotation[inside]], axis=1))
    pairs = np.concatenate(rows)
    demand(
        len(pairs) > 0,
        "Arguments `shortest` and `longest` must hold a pair of periods of the curves' "
        "strongest lines, but they do not: choose a wider range.",
    )
    powers = _explained(_SERIES, readings, pairs)
    chosen = unlike(pairs, powers, _APART, count)
    return pairs[chosen], powers[chosen]


def strongest_lines(
    readings: Readings, lowest: float, highest: float
) -> tuple[Float[np.ndarray, " lines"], Float[np.ndarray, " lines"]]:
    """Lines of the ordinary periodogram, in cycles within the span, and their power."""
    step = 1 / _OVERSAMPLING_OF_LINES
    # The line 2 f_phi + 2 f_psi reaches up to four times the highest frequency.
    frequencies = np.arange(2 * max(lowest, 1.0), 4 * highest, step)
    powers = _explained(_LINE, readings, frequencies[:, None])
    chosen = unlike(frequencies[:, None], powers, _LINES_APART, _LINES)
    return frequencies[chosen], powers[chosen]


def unlike(
    places: Float[np.ndarray, "many n"],
    merits: Float[np.ndarray, " many"],
    apart: float,
    count: int,
) -> list[int]:
    """Indices of the places of most merit that are apart from all better ones."""
    one_group = np.zeros(len(merits))
    return shared_places(places, one_group, merits, apart, count, count)


def shared_places(
    places: Float[np.ndarray, "many n"],
    groups: Float[np.ndarray, " many"],
    merits: Float[np.ndarray, " many"],
    apart: float,
    count: int,
    most: int,
) -> list[int]:
    """Choose as `unlike` does, but at most so many of a group while others remain.

    Args:
        places: Where each index is.
        groups: Those within `apart` of each other are one group.
        merits: The largest is the best.
        apart: Distance from which places are apart, along one axis at least.
        count: How many are chosen.
        most: How many of them may be of one group.
    """
    chosen: list[int] = []
    spare: list[int] = []  # of groups that have their share
    for index in np.argsort(-merits):
        gaps = np.abs(places[index] - places[chosen + spare]).max(axis=1)
        if np.any(gaps <= apart):
            continue
        near = np.abs(groups[index] - groups[chosen]) <= apart
        if np.count_nonzero(near) < most:
            chosen.append(int(index))
        elif len(spare) < count:
            spare.append(int(index))
        if len(chosen) == count:
            break
    kept = [*chosen, *spare][:count]
    return sorted(kept, key=lambda index: -merits[index])


def modulations(readings: Readings) -> Float[np.ndarray, "epochs 3"]:
    """1, and how far the bisector is along the two directions in which it moves most.

    Few points have 0 in place of these.
    """
    there = readings.weights > 0
    numbers = 3 * 2 * len(_SERIES) + readings.factor_count()
    if np.count_nonzero(there) < _POINTS_A_NUMBER * numbers:
        return np.stack([there, 0 * there, 0 * there], axis=1).astype(float)
    both = (readings.to_sun + readings.to_observer)[there]
    # Zero where the Sun is straight behind the body, where there is no light either.
    length = np.linalg.norm(both, axis=1, keepdims=True)
    bisectors = both / np.where(length > 0, length, 1.0)
    moved = bisectors - bisectors.mean(axis=0)
    _, _, directions = np.linalg.svd(moved, full_matrices=False)
    along = moved @ directions[:2].T
    size = np.sqrt(np.mean(along**2, axis=0))
    columns = np.zeros((len(readings.ts), 3))
    columns[there, 0] = 1
    # Division by infinity leaves a column of zeros, for which `_RIDGE` is there too.
    columns[there, 1:] = along / np.where(size > _LEAST_MOTION, size, np.inf)
    return columns


def _explained(
    series: tuple[tuple[int, ...], ...], readings: Readings, frequencies: np.ndarray
) -> Float[np.ndarray, " many"]:
    """Part of chi-square that a series explains for each row of frequencies."""
    modulating = modulations(readings)
    return in_batches(
        _BLOCK, lambda x: _powers(series, readings, modulating, x), frequencies
    )


@functools.partial(jax.jit, static_argnums=0)
def _powers(
    series: tuple[tuple[int, ...], ...],
    readings: Readings,
    modulating: Float[Array, "epochs 3"],
    frequencies: Float[Array, "many n"],
) -> Float[Array, " many"]:
    """Part of chi-square that a series explains for each row, some at a time."""
    one = functools.partial(_power, series, readings, modulating)
    return jax.lax.map(one, frequencies, batch_size=_LANES)


def _power(
    series: tuple[tuple[int, ...], ...],
    readings: Readings,
    modulating: Float[Array, "epochs 3"],
    frequencies: Array,
) -> Scalar:
    """The part of chi-square that a Fourier series explains.

    Single precision suffices to find candidates, and takes half the time.
    """
    turns = jnp.outer(readings.ts / readings.span, frequencies)
    # Whole turns are taken off in double precision.
    angles = (2 * jnp.pi * (turns - jnp.round(turns))).astype(jnp.float32)
    lines = product("en,ln->el", angles, jnp.asarray(series, jnp.float32))
    waves = jnp.concatenate([jnp.cos(lines), jnp.sin(lines)], axis=1)
    weighted = (modulating * readings.weights[:, None]).astype(jnp.float32)
    columns = (waves[:, :, None] * weighted[:, None]).reshape(len(waves), -1)
    basis = readings.basis.astype(jnp.float32)
    inside = product("ef,ec->fc", basis, columns)
    # The values have no part along the basis already.
    slope = product("ec,e->c", columns, readings.values.astype(jnp.float32))
    # The normal matrix of the columns less their parts along the basis, which is
    # orthonormal.
    normal = product("ec,ed->cd", columns, columns) - product(
        "fc,fd->cd", inside, inside
    )
    ridge = _RIDGE * jnp.trace(normal) / len(normal)
    factor = jax.scipy.linalg.cho_factor(
        normal + ridge * jnp.eye(len(normal), dtype=jnp.float32)
    )
    return product("c,c->", slope, jax.scipy.linalg.cho_solve(factor, slope))
