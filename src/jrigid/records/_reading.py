"""A reading, and what is found in it: flights, rests, and the noise of the gyro at rest."""

import dataclasses
import itertools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jrigid._checks import check_option, check_shape, demand
from jrigid._types import Readable

_WINDOW = 0.2  # [s] over which a lever or a tensor is guessed
_GUESSES = 300  # windows that are tried, at most
_SOUND = 0.9  # of the rows of a window that its own guess must explain to be tried on the rest
_REACH = {"forces": 0.01, "momentum": 0.05}  # [s] to either side that an equation looks
_USUAL = 0.2  # [m] from the mass centre to an accelerometer; moments from equal, of a trace of 1
_FORCE = 2.0, 0.05  # [m/s^2], and of the force itself: noise, drag of the air, a wrong scale
_KEPT = 0.02, 6.0  # of a momentum that may come or go in that time, and of the gyro's noise
_SPIN = 2.0  # [rad/s] slower spins tell nothing of a momentum
_LARGEST = 0.55  # moment of a trace of 1: half for a flat body, and some noise
_REST = 0.25  # [s] over which it is judged whether the body rests
_STILL = 0.1, 0.2  # [rad/s] standard deviation, and mean, above which a body does not rest
_FLOOR = 0.1, 3.0  # the quietest tenth of the windows, and how much noisier others at rest may be
_PER_OCTAVE = 4  # averaging times in a factor of two
_FLICKER = 0.664  # Allan deviation of 1/f noise of a unit instability: sqrt(2 log 2 / pi)


class Reading(Readable):
    """Readings of the sensors in one box, in SI units and body axes, on one clock.

    `print(reading)` is a report in words; `reading[first:last]` are some of its rows. It holds
    NumPy arrays in float64 whatever JAX's precision is set to.

    Attributes:
        times: When it was read [s], increasing.
        rates: Angular velocity, body components [rad/s]; None where there is no gyro.
        specific_forces: What an accelerometer shows [m/s^2]: acceleration minus gravity, so 9.8
            upward at rest and zero in free fall. NaN where it was silent; None without one.
        magnetic_fields: Magnetic field, body components [T]; NaN where silent; None without.
        columns: What else is in the file, by its header there and in the file's units; columns that
            were asked for by a name, in SI where their header states a unit.
        breaks: Rows before which time is missing (a gap) or of unknown length (a reset clock).
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
        return float(np.median(np.diff(self.times))) if self.times.size > 1 else float("nan")

    def __getitem__(self, rows: slice) -> "Reading":
        """Consecutive rows, with the notes of the whole."""
        first, last, step = rows.indices(self.times.size)
        demand(step == 1, f"Argument `rows` must be consecutive, but their step is {step}.")
        arrays = (self.rates, self.specific_forces, self.magnetic_fields)
        rates, forces, fields = (None if x is None else x[first:last] for x in arrays)
        columns = {name: column[first:last] for name, column in self.columns.items()}
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
            lines[0] += f" over {np.ptp(self.times):.4g} s, one in {1e3 * self.interval:.4g} ms"
        units = {"rates": "rad/s", "specific_forces": "m/s^2", "magnetic_fields": "T"}
        for what, unit in units.items():
            array = getattr(self, what)
            if array is not None and np.isfinite(array).any():
                largest = np.nanmax(np.linalg.norm(array, axis=1))
                lines.append(f"  {what.replace('_', ' ')}: {largest:.4g} {unit} at most")
        if self.columns:
            lines.append(f"  other columns: {', '.join(self.columns)}")
        if self.breaks:
            lines.append(f"  pieces without a break: {len(self.breaks) + 1}")
        return "\n".join([*lines, *(f"  - {note}" for note in self.notes)])


def flights(
    reading: Reading, *, least: float = 0.2, margin: float = 0.01, by: str | None = None
) -> list[Reading]:
    r"""The parts of a reading in which nothing touches the body: throws, without hand and catch.

    With an accelerometer: in free fall it shows $\dot\omega \times r + \omega \times (\omega \times
    r)$, where $r$ is its lever from the mass centre, whatever that is; a hand adds gravity and
    more. Without: the momentum of one tensor stays the same in space, $I (\omega_b - \omega_a) +
    \int \omega \times I \omega\, dt = 0$ from any time to any other. Lever or tensor, both linear
    here, are those that explain the longest part of the record. By its momentum a smooth slow turn
    in the hand, or a spin in a bearing, looks like a flight.

    Args:
        reading: With rates, and specific forces if there are any. No flight goes over a break.
        least: Shorter parts are dropped [s].
        margin: Cut off at both ends of each [s].
        by: `"forces"`, `"momentum"`, or None for forces where there are any.

    Returns:
        A reading for each flight, with a note. The list is empty where there is none.

    Raises:
        ValueError: No rates, or no specific forces for `by="forces"`.

    >>> import numpy as np
    >>> import jrigid as jr
    >>> times = np.arange(200) / 100
    >>> flying = (times > 0.5) & (times < 1.2)
    >>> forces = np.where(flying[:, None], 0.0, [0.0, 0.0, 9.8])
    >>> reading = jr.records.Reading(times, np.zeros((200, 3)), forces)
    >>> [flight] = jr.records.flights(reading)
    >>> print(*flight.notes)
    flight 1 of 1, 0.52 s to 1.18 s: no contact by the specific forces

    Source: the consensus of guesses is that of Fischler and Bolles, Comm. ACM 24, 381 (1981).
    """
    check_option("by", by, (None, "forces", "momentum"))
    rates, forces, t = reading.rates, reading.specific_forces, reading.times
    if rates is None or (by == "forces" and forces is None):
        needed = "rates" if rates is None else "specific forces"
        raise ValueError(f"Argument `reading` must have {needed}, but it has none.")
    by = "momentum" if forces is None else by or "forces"
    size = max(4, round(_WINDOW / reading.interval)) if t.size > 4 else t.size
    if t.size <= size:
        return []
    reach = max(1, round(_REACH[by] / reading.interval))
    if forces is None or by == "momentum":
        law = _of_a_tensor(t, rates, reach)
    else:
        law = _of_a_lever(t, rates, forces, reach)
    for row in (0, *reading.breaks, t.size):
        law[1][max(row - reach, 0) : row + reach] = np.nan
    free = _consensus(*law, size, max(2, round(least / reading.interval)) - 2 * reach)
    if by == "momentum":  # an equation holds for all that it looks at, and hardly for its ends
        free = np.convolve(free, np.ones(2 * (4 * reach // 5) + 1), mode="same") > 0.5
    flown = []
    for first, last in _runs(free):
        rows = np.flatnonzero((t >= t[first] + margin) & (t <= t[last - 1] - margin))
        if rows.size and t[last - 1] - t[first] >= least:
            flown.append(reading[int(rows[0]) : int(rows[-1]) + 1])
    for i, x in enumerate(flown):
        note = f"flight {i + 1} of {len(flown)}, {x.times[0]:.6g} s to {x.times[-1]:.6g} s: "
        note += f"no contact by the {by.replace('forces', 'specific forces')}"
        flown[i] = dataclasses.replace(x, notes=(*x.notes, note))
    return flown


# Equations of each row that hold in flight, |model x - wanted| < bound(x, rows), over their errors.
_Law = tuple[np.ndarray, np.ndarray, Callable[[np.ndarray, slice], np.ndarray | float]]


def _of_a_lever(t: np.ndarray, rates: np.ndarray, forces: np.ndarray, reach: int) -> _Law:
    """The specific force is that of a lever."""

    def cross(vectors: np.ndarray) -> np.ndarray:
        return np.cross(np.eye(3), vectors[:, None])

    slope = _across(rates, reach) / _across(t, reach)[:, None]
    absolute, relative = _FORCE
    tolerance = absolute + relative * np.linalg.norm(forces, axis=1, keepdims=True)
    model = (cross(slope) + cross(rates) @ cross(rates)) / tolerance[..., None]
    return model, forces / tolerance, lambda *_: 1.0


def _of_a_tensor(t: np.ndarray, rates: np.ndarray, reach: int) -> _Law:
    """The momentum of a tensor of trace 1 stays, in parts of itself."""
    # A sphere and five tensors without a trace, which make up all others; their angular momenta.
    x, y, z = np.eye(3)
    off = [np.outer(a, b) + np.outer(b, a) for a, b in ((x, y), (x, z), (y, z))]
    tensors = np.array([np.eye(3) / 3, np.diag(x - y), np.diag(y - z), *off])
    momenta = np.einsum("kij,tj->tik", tensors, rates)
    turning = np.cross(rates[:, :, None], momenta, axis=1)
    steps = turning * np.gradient(t)[:, None, None]
    whole = momenta + np.cumsum(steps, axis=0) - steps / 2
    spin = np.linalg.norm(rates, axis=1)
    # Third differences of smooth rates are noise, of 20 times its variance; the median of 3 axes.
    noise = np.median(np.linalg.norm(np.diff(rates, 3, axis=0), axis=1)) / np.sqrt(20 * 2.37)
    relative, times_noise = _KEPT
    tolerance = np.where(spin > _SPIN, (relative * spin + times_noise * noise) / 3, np.nan)
    change = _across(whole, reach) / tolerance[:, None, None]

    def bound(x: np.ndarray, rows: slice) -> np.ndarray | float:
        """The momentum, in parts of the sphere's; moments are positive and none exceeds others."""
        tensor = tensors[0] + np.tensordot(x, tensors[1:], 1)
        moments = np.linalg.eigvalsh(tensor)
        if moments[0] <= 0 or moments[2] > _LARGEST:
            return 0.0
        return 3 * np.linalg.norm(rates[rows] @ tensor, axis=1) / np.maximum(spin[rows], _SPIN)

    return change[..., 1:], -change[..., 0], bound


def _across(x: np.ndarray, reach: int) -> np.ndarray:
    """Changes from some rows before to as many after; of no meaning at the ends."""
    return np.roll(x, -reach, axis=0) - np.roll(x, reach, axis=0)


def _consensus(
    model: np.ndarray, wanted: np.ndarray, bound: Callable, size: int, least: int
) -> np.ndarray:
    """Rows that the best unknowns explain: those that explain the longest part in long runs."""
    known = np.isfinite(wanted.sum(axis=1) + model.sum(axis=(1, 2)))
    model = np.where(known[:, None, None], model, 0.0)
    wanted = np.where(known[:, None], wanted, 0.0)
    drawn = np.eye(model.shape[2]) / _USUAL**2

    def solve(rows: slice | np.ndarray) -> np.ndarray:
        """Least squares, drawn to zero by what is usual where the rows do not tell."""
        a = model[rows].reshape(-1, len(drawn))
        return np.linalg.solve(a.T @ a + drawn, a.T @ wanted[rows].ravel())

    def explained(x: np.ndarray, rows: slice = slice(None)) -> np.ndarray:
        beside = np.linalg.norm(model[rows] @ x - wanted[rows], axis=1)
        return known[rows] & (beside < bound(x, rows))

    def in_runs(x: np.ndarray) -> np.ndarray:
        kept = explained(x)
        for first, last in _runs(kept):
            kept[first:last] = last - first >= least
        return kept

    windows = range(0, len(known) - size, max(size // 2, len(known) // _GUESSES))
    windows = [slice(first, first + size) for first in windows]
    guesses = [np.zeros(len(drawn)), *map(solve, windows)]
    sound = [explained(x, w).mean() >= _SOUND for x, w in zip(guesses[1:], windows, strict=True)]
    best = max(map(in_runs, itertools.compress(guesses, [True, *sound])), key=np.sum)
    return max(in_runs(solve(best)), best, key=np.sum)


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """First and last plus one of each run of True."""
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
        density: White noise [rad/s/sqrt(Hz)], from where the Allan deviation falls as it should for
            white noise. In a gyro that filters its output it exceeds `sigma` sqrt(interval).
        instability: Bias instability [rad/s]: the least Allan deviation over 0.664; an upper bound
            where `instability_times` is the longest that was looked at.
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


def allan(values: Float[np.ndarray, "rows columns"] | list[np.ndarray], interval: float) -> Allan:
    r"""Overlapping Allan deviations of even readings.

    $\sigma^2(m \tau) = \langle (\theta_{k+2m} - 2 \theta_{k+m} + \theta_k)^2 \rangle / (2 m^2
    \tau^2)$ with $\theta$ the integral of the values, for averages over up to a third of the
    readings. White noise of standard deviation s gives s / sqrt(m), a bias that wanders as a random
    walk rises as sqrt(m), and 1/f noise of instability B lies level at 0.664 B.

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
    pieces = [np.asarray(x, float) for x in (values if isinstance(values, list) else [values])]
    for piece in pieces:
        check_shape("values", piece, (None, None))
    longest = max(map(len, pieces), default=0)
    demand(longest > 2, f"Argument `values` must have 3 readings, but it has {longest}.")
    octaves = np.arange(0, np.log2(longest / 3) + 1e-9, 1 / _PER_OCTAVE)
    averaged = np.unique(np.round(2**octaves).astype(int))
    squares, counts = np.zeros((averaged.size, pieces[0].shape[1])), np.zeros(averaged.size)
    for piece in pieces:
        # the mean changes nothing but the rounding of the sums
        sums = np.cumsum(piece - piece.mean(axis=0), axis=0)
        sums = np.concatenate([np.zeros((1, piece.shape[1])), sums])
        for i, m in enumerate(averaged[2 * averaged < len(sums)]):
            second = sums[2 * m :] - 2 * sums[m:-m] + sums[: -2 * m]
            squares[i] += np.sum(second**2, axis=0)
            counts[i] += len(second)
    deviations = np.sqrt(squares / (2 * counts * averaged**2)[:, None])
    return Allan(averaged * interval, deviations, counts)


def rests(reading: Reading, *, least: float = 1.0) -> list[Reading]:
    """The parts of a reading in which the body rests: as quiet as its quietest, and not turning.

    Args:
        reading: With rates.
        least: Shorter parts are dropped [s].

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
    rates, times = reading.rates, reading.times
    if rates is None:
        raise ValueError("Argument `reading` must have rates, but it has none.")
    size = max(4, round(_REST / reading.interval)) if times.size > 1 else 4
    ends = itertools.pairwise((0, *reading.breaks, times.size))
    starts = np.concatenate([np.arange(a, b - size + 1, size) for a, b in ends])
    if not starts.size:
        return []
    windows = starts[:, None] + np.arange(size)
    spreads = np.linalg.norm(rates[windows].std(axis=1), axis=1)
    (quantile, factor), (spread, mean) = _FLOOR, _STILL
    quiet = spreads <= min(spread, factor * np.quantile(spreads, quantile))
    quiet &= np.linalg.norm(rates[windows].mean(axis=1), axis=1) < mean
    still = np.isin(np.arange(times.size), windows[quiet])
    parts = [part for first, last in _runs(still) for part in reading[first:last].pieces()]
    return [part for part in parts if np.ptp(part.times) >= least - reading.interval]


def noise(reading: Reading, *, at_rest: bool = False, least: float = 1.0) -> Noise:
    """Noise of the gyro from the rest in a reading: white noise, bias, bias instability.

    Args:
        reading: With rates.
        at_rest: All of the reading is rest; else `rests` looks for it.
        least: Shorter rests are not used [s].

    Raises:
        ValueError: No rates, or no rest.

    >>> import numpy as np
    >>> import jrigid as jr
    >>> rates = 0.02 + 0.01 * np.random.default_rng(0).normal(size=(6000, 3))
    >>> gyro = jr.records.noise(jr.records.Reading(np.arange(6000) / 100, rates))
    >>> print(gyro.bias.round(3), gyro.sigma.round(3), gyro.density.round(4))
    [0.02 0.02 0.02] [0.01 0.01 0.01] [0.001 0.001 0.001]
    """
    pieces = reading.pieces() if at_rest else rests(reading, least=least)
    parts = [x.rates for x in pieces if x.rates is not None and x.times.size > 2]
    needed = f"rates at rest for {least:g} s"
    demand(len(parts) > 0, f"Argument `reading` must have {needed}, but it has none.")
    curve = allan(parts, reading.interval)
    times, deviations = curve.times[:, None], curve.deviations
    lowest = np.argmin(deviations, axis=0)
    logs = np.log(np.maximum(deviations, np.finfo(float).tiny))
    slopes = np.diff(logs, axis=0, append=np.nan) / np.diff(np.log(times), axis=0, append=np.nan)
    early = np.arange(len(times))[:, None] < np.maximum(lowest, 1)
    white = early & (np.abs(slopes + 0.5) < 0.1)
    white = np.where(white.any(axis=0), white, early)
    total = sum(map(len, parts)) * reading.interval
    notes = [f"{len(parts)} rest{'s' if len(parts) > 1 else ''}, {total:.4g} s in all"]
    if (lowest == len(times) - 1).any():
        notes.append("the rest is too short for the bias instability: an upper bound")
    return Noise(
        reading.interval,
        bias=np.concatenate(parts).mean(axis=0),
        sigma=deviations[0],
        density=np.nanmedian(np.where(white, deviations * np.sqrt(times), np.nan), axis=0),
        instability=deviations.min(axis=0) / _FLICKER,
        instability_times=curve.times[lowest],
        allan=curve,
        notes=tuple(notes),
    )
