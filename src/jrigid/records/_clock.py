"""Clocks that repeat, run backwards, skip or round."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jrigid._checks import check_option, check_shape

# Intervals that a row may come too late. A clock that goes back further was reset.
_LATE = 20
# When micro- and milliseconds in 32 bits wrap [s].
_COUNTERS = 2.0**32 * np.array([1e-6, 1e-3])
# Decimal digits that times may end with [s].
_DIGITS = 10.0 ** -np.arange(5)
# What rounding or cutting leaves beside the line, in units of the digit.
_ROUND = 0.7
# A digit coarser than this part of the interval is worth a repair.
_COARSE = 0.02
# Rounding makes more than this part of the steps unequal; an accident makes fewer.
_OFTEN = 0.2
# Stamps that tell a late reading from a lost one.
_NEXT = 8
# The part of a stamp's lateness that the count of readings follows.
_LOCK = 0.05
# If more than this part of the rows have equal times, the clock is coarse.
_SEVERAL = 0.05
_REPEATED = "with the time of the row before"


class Clock(NamedTuple):
    """Times put right.

    Attributes:
        times: [s], increasing.
        rows: Rows of the input that they belong to.
        breaks: Where, in `times`, a piece begins: after a gap or a reset.
        notes: What was done, in words.
    """

    times: Float[np.ndarray, " kept"]
    rows: Int[np.ndarray, " kept"]
    breaks: tuple[int, ...]
    notes: tuple[str, ...]


def repair(
    times: Float[np.ndarray, " rows"],
    values: Float[np.ndarray, "rows columns"] | None = None,
    *,
    clock: str | None = None,
    gap: float = 5.0,
) -> Clock:
    """Times made increasing, and what was wrong with them in words.

    Rows without a time are dropped. A counter of 32 bits that wrapped is unwrapped; a
    clock that goes back by more than 20 intervals was reset, and what follows is put
    one interval later, after a break. Rows that are a little late are sorted in,
    repeated ones dropped. A step of more than `gap` intervals is a break; nothing is
    filled in. Times rounded to a coarse digit are put on the line through them.

    Args:
        times: As recorded [s].
        values: What was read, to tell a row written twice from two readings in one
            tick.
        clock: `"recorded"` leaves times as they are, rounded or not. `"uniform"` puts
            each piece on a line, fitted robustly and with readings lost on the way;
            right where the sensor's clock is even and only the stamps are late. None
            does so where the deviations are those of rounding.
        gap: Steps longer than so many intervals are gaps.

    Raises:
        ValueError: Wrong shapes or options.

    >>> import numpy as np
    >>> import jrigid as jr
    >>> clock = jr.records.repair(np.array([0.0, 0.1, 0.1, 0.2, 0.3, 0.4, 2.4, 2.5]))
    >>> print(clock.rows, clock.breaks)
    [0 1 3 4 5 6 7] (5,)
    >>> print(*clock.notes, sep="; ")
    1 gap, of 2 s after 0.4 s; 1 row with the time of the row before dropped
    """
    check_option("clock", clock, (None, "recorded", "uniform"))
    check_shape("times", np.asarray(times), (None,))
    kept = _Rows(times)
    kept.keep(np.isfinite(kept.times), "without a time")
    kept.put_oldest_first()
    steps = np.diff(kept.times)
    if not (steps > 0).any():
        notes = (*kept.notes, "all rows are of one time")
        return Clock(kept.times[:1], kept.rows[:1], (), notes)
    # Repeated times have steps of 0, which say nothing of the interval.
    interval = float(np.median(steps[steps > 0]))
    resets = _resets(kept.times, interval, kept.notes)
    kept.sort()
    if values is not None:
        kept.drop_copies(values)
    # The first row is new: NaN differs from every number.
    is_new = np.diff(kept.times, prepend=np.nan) != 0
    # Many equal times are those of a coarse clock, which is put on a line below.
    if clock == "recorded" or np.mean(~is_new) <= _SEVERAL:
        kept.keep(is_new, _REPEATED)
    gaps = _gaps(kept.times, gap * interval, kept.notes)
    breaks = np.union1d(gaps, np.searchsorted(kept.times, resets))
    if clock != "recorded":
        pieces = np.split(kept.times, breaks)
        pieces = _evened(pieces, clock == "uniform", kept.notes)
        kept.times = np.concatenate(_in_turn(pieces, interval, kept.notes))
    is_new = ~(np.diff(kept.times, prepend=np.nan) <= 0)
    # The numbers of these rows among those that are kept next.
    breaks = np.cumsum(is_new)[breaks] - 1
    kept.keep(is_new, _REPEATED)
    return Clock(kept.times, kept.rows, tuple(breaks.tolist()), tuple(kept.notes))


class _Rows:
    """Times and the rows of the input that they belong to, while some are dropped.

    Attributes:
        times: [s]
        rows: Rows of the input.
        notes: What was done, in words.
    """

    def __init__(self, times: Float[np.ndarray, " rows"]):
        """All rows of the input."""
        self.times = np.array(times, float)
        self.rows = np.arange(len(times))
        self.notes: list[str] = []

    def keep(self, is_good: np.ndarray, others: str) -> None:
        """Drop the rows that are not good, and note what the others are."""
        _say(self.notes, int(np.sum(~is_good)), f"{others} dropped")
        self.times = self.times[is_good]
        self.rows = self.rows[is_good]

    def put_oldest_first(self) -> None:
        """Reverse rows of which nearly all are earlier than the row before."""
        steps = np.diff(self.times)
        if np.sum(steps < 0) <= np.sum(steps > 0):
            return
        self.notes.append("rows had the newest first, and were reversed")
        self.times = self.times[::-1].copy()
        self.rows = self.rows[::-1]

    def sort(self) -> None:
        """Put the rows in the order of their times."""
        late = int(np.sum(np.diff(self.times) < 0))
        _say(self.notes, late, "out of order sorted in")
        order = np.argsort(self.times, kind="stable")
        self.times = self.times[order]
        self.rows = self.rows[order]

    def drop_copies(self, values: np.ndarray) -> None:
        """Drop rows with the time and the values of the row before."""
        changes = np.diff(values[self.rows], axis=0, prepend=np.nan)
        is_same = np.all(changes == 0, axis=1)
        is_later = np.diff(self.times, prepend=np.nan) != 0
        self.keep(~is_same | is_later, "written twice")


def _gaps(t: np.ndarray, longest: float, notes: list[str]) -> np.ndarray:
    """Rows before which a step is longer than that."""
    steps = np.diff(t)
    gaps = np.flatnonzero(steps > longest) + 1
    if gaps.size:
        last = gaps[np.argmax(steps[gaps - 1])] - 1
        many = f"{gaps.size} gaps, the longest" if gaps.size > 1 else "1 gap,"
        notes.append(f"{many} of {steps[last]:.3g} s after {t[last]:.6g} s")
    return gaps


def _say(notes: list[str], count: int, what: str) -> None:
    """Note how many rows something was done to, if any."""
    if count:
        notes.append(f"{count} row{'s' if count > 1 else ''} {what}")


def _resets(t: np.ndarray, interval: float, notes: list[str]) -> list[float]:
    """Undo wraps and resets in place; the times at which a reset clock goes on."""
    resets = []
    for row in np.flatnonzero(np.diff(t) < 0) + 1:
        # What was added before was added to both rows, so this is as recorded.
        back = t[row - 1] - t[row]
        # A counter that wraps goes back by 2^32 ticks less one interval.
        wrapped = _COUNTERS[np.abs(_COUNTERS - back - interval) < _LATE * interval]
        if wrapped.size:
            t[row:] += wrapped[0]
            notes.append(f"the clock wrapped at row {row}, after 2^32 ticks: unwrapped")
        elif back > _LATE * interval:
            t[row:] += back + interval
            resets.append(float(t[row]))
            went = f"the clock went back by {back:.3g} s at row {row}"
            notes.append(f"{went}: a break of any length")
    return resets


def _evened(
    pieces: list[np.ndarray], asked: bool, notes: list[str]
) -> list[np.ndarray]:
    """Put each piece on its line if asked to, or if that only undoes rounding."""
    tick, shared = _tick(pieces)
    evened = list(pieces)
    beside: list[tuple[float, float]] = []
    for i, piece in enumerate(pieces):
        steps = np.diff(piece)
        # Times that are all equal have no line.
        if piece.size < 4 or np.ptp(steps) <= 1e-9 * np.ptp(piece):
            continue
        line, interval = _line(piece, asked)
        jitter = np.abs(piece - line)
        uneven = np.mean(np.abs(steps - np.median(steps)) > tick / 2)
        is_uneven = shared or uneven > _OFTEN
        is_coarse = tick > _COARSE * interval
        is_rounding = jitter.max() < _ROUND * tick
        if asked or (is_uneven and is_coarse and is_rounding):
            evened[i] = line
            beside.append((interval, float(np.sqrt(np.mean(jitter**2)))))
    if beside:
        intervals, jitters = 1e3 * np.transpose(beside)
        why = "as asked" if asked else f"they are rounded to {1e3 * tick:.5g} ms"
        note = f"times put on an even clock of {intervals.mean():.5g} ms: {why}, "
        notes.append(f"{note}{jitters.max():.3g} ms rms beside it")
    return evened


def _tick(pieces: list[np.ndarray]) -> tuple[float, bool]:
    """Unit of which times are multiples, or 0, and whether most rows share a time."""
    steps = np.concatenate([np.diff(x) for x in pieces])
    if np.median(steps) == 0:
        return float(np.median(steps[steps > 0])), True
    ticks = (np.concatenate(pieces) - pieces[0][0])[:, None] / _DIGITS
    is_whole = np.abs(ticks - np.round(ticks)).max(axis=0) < 1e-3
    return float(_DIGITS[is_whole].max(initial=0.0)), False


def _in_turn(
    pieces: list[np.ndarray], interval: float, notes: list[str]
) -> list[np.ndarray]:
    """Move pieces that begin before the last one ends to one interval after its end.

    The line of a piece may end later than its times do.
    """
    moved = [pieces[0]]
    for piece in pieces[1:]:
        end = moved[-1][-1]
        late = max(0.0, end + interval - piece[0]) if piece[0] <= end else 0.0
        if late:
            notes.append(f"a piece put {late:.3g} s later, after the one before")
        moved.append(piece + late)
    return moved


def _line(t: np.ndarray, lost: bool) -> tuple[np.ndarray, float]:
    """Fit a robust line through times; if `lost`, lost samples are counted too."""
    counts: list[np.ndarray] = [np.arange(t.size)]
    if lost:
        usual = float(np.median(np.diff(t))) or float(np.mean(np.diff(t)))
        ticks = np.ones(t.size)
        phase = t[0]
        for row in range(1, t.size):
            # A reading is lost only if all of the next stamps are late. One late stamp
            # may be the delay of a single message.
            ahead = t[row : row + _NEXT] - phase
            late = (ahead - usual * np.arange(ahead.size)).min()
            ticks[row] = max(1, round(late / usual))
            phase += ticks[row] * usual
            phase += _LOCK * (t[row] - phase)
        counts.append(np.cumsum(ticks))
    lines = [_line_of(count, t) for count in counts]
    # Lost readings are believed only where the line fits better with them.
    return min(lines, key=lambda line: np.median(np.abs(t - line[0])))


def _line_of(count: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit a line through times by their counts; return its times and its slope."""
    slope, start = np.polyfit(count, t, 1)
    for _ in range(2):  # outliers are left out, twice
        beside = np.abs(t - start - slope * count)
        use = beside <= 4 * np.median(beside) + 1e-12 * np.ptp(t)
        slope, start = np.polyfit(count[use], t[use], 1)
    return start + slope * count, float(slope)
