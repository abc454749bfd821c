"""Rests that are found in a record, and the noise of the gyro at rest."""

import itertools
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jrigid._checks import check_shape, demand
from jrigid._types import Readable

# Time over which it is judged whether the body is at rest [s].
_REST = 0.25
# Standard deviation and mean of the rates [rad/s] of a body at rest, at most.
_STILL = (0.1, 0.2)
# The quietest tenth of the windows are at rest; others at rest are up to three times
# as noisy.
_FLOOR = (0.1, 3.0)
# Standard errors by which the mean of a window at an end of a rest differs from that of
# its neighbour where the body begins to turn.
_TURNS = 6.0
# Averaging times in a factor of two.
_PER_OCTAVE = 4
# Allan deviation of 1/f noise of a unit instability: sqrt(2 log 2 / pi).
_FLICKER = 0.664


class Reading(Readable):
    """Readings of the sensors in one box, in SI units and body axes, on one clock.

    `print(reading)` is a report in words; `reading[first:last]` are some of its rows.
    It holds NumPy arrays in float64 whatever JAX's precision is set to.

    Attributes:
        times: When it was read [s], increasing.
        rates: Angular velocity, body components [rad/s]; None where there is no gyro.
        specific_forces: What an accelerometer shows [m/s^2]: acceleration minus
            gravity, so 9.8 upward at rest and zero in free fall. NaN where it was
            silent; None without one.
        magnetic_fields: Magnetic field, body components [T]; NaN where silent; None
            without.
        columns: What else is in the file, by its header there and in the file's units;
            columns that were asked for by a name, in SI where their header states a
            unit.
        breaks: Rows before which time is missing (a gap) or of unknown length (a reset
            clock).
        notes: In words what was recognised, converted and repaired.
    """

    times: Float[np.ndarray, " rows"]
    rates: Float[np.ndarray, "rows 3"] | None = None
    specific_forces: Float[np.ndarray, "rows 3"] | None = None
    magnetic_fields: Float[np.ndarray, "rows 3"] | None = None
    columns: dict[str, Float[np.ndarray, " rows"]] = eqx.field(default_factory=dict)
    breaks: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def interval(self) -> float:
        """Median time from a row to the next [s]; NaN for less than two rows."""
        return (
            float(np.median(np.diff(self.times)))
            if self.times.size > 1
            else float("nan")
        )

    def __getitem__(self, rows: slice) -> "Reading":
        """Consecutive rows, with the notes of the whole."""
        first, last, step = rows.indices(self.times.size)
        demand(
            step == 1, f"Argument `rows` must be consecutive, but their step is {step}."
        )
        arrays = (self.rates, self.specific_forces, self.magnetic_fields)
        rates, forces, fields = (None if x is None else x[first:last] for x in arrays)
        columns = {name: column[first:last] for name, column in self.columns.items()}
        # A break before the first row is not in this part.
        breaks = tuple(row - first for row in self.breaks if first < row < last)
        times = self.times[first:last]
        return Reading(times, rates, forces, fields, columns, breaks, self.notes)

    def pieces(self) -> list["Reading"]:
        """The stretches between breaks: within each of them no time is missing."""
        ends = [0, *self.breaks, self.times.size]
        return [self[a:b] for a, b in itertools.pairwise(ends)]

    def __str__(self) -> str:
        """A report in words."""
        size = self.times.size
        lines = [f"{size} readings"]
        if size > 1:
            lines[0] += (
                f" over {np.ptp(self.times):.4g} s, one in {1e3 * self.interval:.4g} ms"
            )
        units = {"rates": "rad/s", "specific_forces": "m/s^2", "magnetic_fields": "T"}
        for what, unit in units.items():
            array = getattr(self, what)
            if array is not None and np.isfinite(array).any():
                largest = np.nanmax(np.linalg.norm(array, axis=1))
                lines.append(
                    f"  {what.replace('_', ' ')}: {largest:.4g} {unit} at most"
                )
        if self.columns:
            lines.append(f"  other columns: {', '.join(self.columns)}")
        if self.breaks:
            lines.append(f"  pieces without a break: {len(self.breaks) + 1}")
        return "\n".join([*lines, *(f"  - {note}" for note in self.notes)])


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """First and last plus one of each run of True."""
    # The difference of booleans is their exclusive or, which marks both ends of a run.
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


class Allan(NamedTuple):
    """Overlapping Allan deviations.

    Attributes:
        times: Averaging times [s].
        deviations: In the unit of the values, for each averaging time and column.
        counts: Differences averaged over; longer times have fewer independent ones.
    """

    times: Float[np.ndarray, " n"]
    deviations: Float[np.ndarray, "n columns"]
    counts: Float[np.ndarray, " n"]


class Noise(Readable):
    """Noise of a gyro at rest, each of three axes.

    Attributes:
        interval: Between readings [s].
        bias: Mean at rest [rad/s].
        sigma: White noise of one reading [rad/s]: Allan deviation over one interval.
        density: White noise [rad/s/sqrt(Hz)], from where the Allan deviation falls as
            it should for white noise. In a gyro that filters its output it exceeds
            `sigma` sqrt(interval).
        instability: Bias instability [rad/s]: the least Allan deviation over 0.664; an
            upper bound where `instability_times` is the longest that was looked at.
        instability_times: Averaging times of the least deviation [s].
        allan: The Allan deviations that it is taken from.
        notes: In words.
    """

    interval: float
    bias: Float[np.ndarray, " 3"]
    sigma: Float[np.ndarray, " 3"]
    density: Float[np.ndarray, " 3"]
    instability: Float[np.ndarray, " 3"]
    instability_times: Float[np.ndarray, " 3"]
    allan: Allan
    notes: tuple[str, ...]


def allan(
    values: Float[np.ndarray, "rows columns"] | list[np.ndarray], interval: float
) -> Allan:
    r"""Overlapping Allan deviations of even readings.

    $\sigma^2(m \tau) = \langle (\theta_{k+2m} - 2 \theta_{k+m} + \theta_k)^2 \rangle /
    (2 m^2 \tau^2)$ with $\theta$ the integral of the values, for averages over up to a
    third of the readings. White noise of standard deviation s gives s / sqrt(m), a bias
    that wanders as a random walk rises as sqrt(m), and 1/f noise of instability B lies
    level at 0.664 B.

    Args:
        values: Readings, or a list of stretches of them, whose squares are pooled.
        interval: Between readings [s].

    Raises:
        ValueError: Fewer than three readings.

    >>> import numpy as np
    >>> import jrigid as jr
    >>> noise = np.random.default_rng(0).normal(size=(20000, 1))
    >>> print(jr.records.allan(noise, 0.01).deviations[0].round(2))
    [1.]

    Source: IEEE Std 952-1997, annex C; Riley, NIST SP 1065 (2008), section 5.2.
    """
    stretches = values if isinstance(values, list) else [values]
    pieces = [np.asarray(x, float) for x in stretches]
    for piece in pieces:
        check_shape("values", piece, (None, None))
    longest = max(map(len, pieces), default=0)
    demand(
        longest > 2, f"Argument `values` must have 3 readings, but it has {longest}."
    )
    octaves = np.arange(0, np.log2(longest / 3) + 1e-9, 1 / _PER_OCTAVE)
    averaged = np.unique(np.round(2**octaves).astype(int))
    squares = np.zeros((averaged.size, pieces[0].shape[1]))
    counts = np.zeros(averaged.size)
    for piece in pieces:
        # The mean changes nothing but the rounding of the sums.
        sums = np.cumsum(piece - piece.mean(axis=0), axis=0)
        sums = np.concatenate([np.zeros((1, piece.shape[1])), sums])
        for i, m in enumerate(averaged[2 * averaged < len(sums)]):
            # The interval drops out: sums are integrals in its units.
            second = sums[2 * m :] - 2 * sums[m:-m] + sums[: -2 * m]
            squares[i] += np.sum(second**2, axis=0)
            counts[i] += len(second)
    deviations = np.sqrt(squares / (2 * counts * averaged**2)[:, None])
    return Allan(averaged * interval, deviations, counts)


def rests(reading: Reading, *, min_duration: float = 1.0) -> list[Reading]:
    """The parts of a reading in which the body is at rest: quiet and not turning.

    In a quarter of a second the rates scatter by less than 0.1 rad/s, and by less than
    three times what the quietest tenth of the reading does; their mean is below 0.2
    rad/s.

    Args:
        reading: With rates.
        min_duration: Shorter parts are dropped [s].

    Raises:
        ValueError: No rates.

    >>> import numpy as np
    >>> import jrigid as jr
    >>> rates = 0.01 * np.random.default_rng(0).normal(size=(600, 3))
    >>> rates[200:400] += 5.0  # turned for two seconds
    >>> parts = jr.records.rests(jr.records.Reading(np.arange(600) / 100, rates))
    >>> print([x.times[[0, -1]].round(1).tolist() for x in parts])
    [[0.0, 2.0], [4.0, 6.0]]
    """
    rates = reading.rates
    times = reading.times
    if rates is None:
        raise ValueError("Argument `reading` must have rates, but it has none.")
    size = max(4, round(_REST / reading.interval)) if times.size > 1 else 4
    ends = itertools.pairwise((0, *reading.breaks, times.size))
    # No window reaches across a break.
    starts = np.concatenate([np.arange(a, b - size + 1, size) for a, b in ends])
    if not starts.size:
        return []
    windows = starts[:, None] + np.arange(size)
    spreads = np.linalg.norm(rates[windows].std(axis=1), axis=1)
    quantile, factor = _FLOOR
    most_spread, most_mean = _STILL
    floor = factor * np.quantile(spreads, quantile)
    is_quiet = spreads <= min(most_spread, floor)
    means = rates[windows].mean(axis=1)
    is_quiet &= np.linalg.norm(means, axis=1) < most_mean
    if not np.any(is_quiet):
        return []
    error = np.median(spreads[is_quiet]) / np.sqrt(size)
    is_quiet &= ~_begins_to_turn(means, is_quiet, error)
    is_still = np.isin(np.arange(times.size), windows[is_quiet])
    # Of n readings the times span n - 1 intervals.
    shortest = min_duration - reading.interval
    parts: list[Reading] = []
    for first, last in runs(is_still):
        # Windows on both sides of a break make one run.
        parts += reading[first:last].pieces()
    return [part for part in parts if np.ptp(part.times) >= shortest]


def _begins_to_turn(means: np.ndarray, quiet: np.ndarray, error: float) -> np.ndarray:
    """Quiet windows at the ends of rests whose mean is not that of their neighbours.

    Slow drifts of a bias are none: from one window to the next they are small.

    Args:
        means: Of the rates in each window (windows, 3).
        quiet: Which windows are quiet.
        error: Standard error of a mean.
    """
    found = np.zeros_like(quiet)
    for first, last in runs(quiet):
        inner = means[first:last]
        # A hand takes up a body within half a second, two windows.
        for _ in range(min(2, (last - first - 1) // 2)):
            off = np.linalg.norm(inner[[0, -1]] - inner[[1, -2]], axis=1)
            off_begins, off_ends = off > _TURNS * error
            found[first] |= off_begins
            found[last - 1] |= off_ends
            first += off_begins
            last -= off_ends
            inner = means[first:last]
    return found


def _density(curve: Allan, lowest: np.ndarray) -> np.ndarray:
    """White noise [unit/sqrt(Hz)] of each column, from times before the lowest one.

    The Allan deviation of white noise falls as the root of the averaging time. If it
    falls so nowhere, all times before the lowest deviation count.
    """
    times = curve.times[:, None]
    logs = np.log(np.maximum(curve.deviations, np.finfo(float).tiny))
    run = np.diff(np.log(times), axis=0, append=np.nan)
    slopes = np.diff(logs, axis=0, append=np.nan) / run
    # Where the first deviation is the lowest one, it counts alone.
    is_early = np.arange(len(times))[:, None] < np.maximum(lowest, 1)
    is_white = is_early & (np.abs(slopes + 0.5) < 0.1)
    used = np.where(is_white.any(axis=0), is_white, is_early)
    densities = np.where(used, curve.deviations * np.sqrt(times), np.nan)
    return np.nanmedian(densities, axis=0)


def noise(
    reading: Reading, *, at_rest: bool = False, min_duration: float = 1.0
) -> Noise:
    """Noise of the gyro from its rests: white noise, bias, bias instability.

    Args:
        reading: With rates.
        at_rest: All of the reading is rest; else `rests` looks for it.
        min_duration: Shorter rests are not used [s].

    Raises:
        ValueError: No rates, or no rest.

    >>> import numpy as np
    >>> import jrigid as jr
    >>> rates = 0.02 + 0.01 * np.random.default_rng(0).normal(size=(6000, 3))
    >>> gyro = jr.records.noise(jr.records.Reading(np.arange(6000) / 100, rates))
    >>> print(gyro.bias.round(3), gyro.sigma.round(3), gyro.density.round(4))
    [0.02 0.02 0.02] [0.01 0.01 0.01] [0.001 0.001 0.001]
    """
    pieces = reading.pieces() if at_rest else rests(reading, min_duration=min_duration)
    # `allan` needs three readings.
    parts = [x.rates for x in pieces if x.rates is not None and x.times.size > 2]
    needed = f"rates at rest for {min_duration:g} s"
    demand(len(parts) > 0, f"Argument `reading` must have {needed}, but it has none.")
    curve = allan(parts, reading.interval)
    deviations = curve.deviations
    lowest = np.argmin(deviations, axis=0)
    total = sum(map(len, parts)) * reading.interval
    notes = [f"{len(parts)} rest{'s' if len(parts) > 1 else ''}, {total:.4g} s in all"]
    if (lowest == len(curve.times) - 1).any():
        notes.append("the rest is too short for the bias instability: an upper bound")
    return Noise(
        reading.interval,
        bias=np.concatenate(parts).mean(axis=0),
        sigma=deviations[0],
        density=_density(curve, lowest),
        instability=deviations.min(axis=0) / _FLICKER,
        instability_times=curve.times[lowest],
        allan=curve,
        notes=tuple(notes),
    )
