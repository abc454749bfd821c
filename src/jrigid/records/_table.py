"""Text with columns: separators, decimal commas, headers, and what the names of columns mean."""

import csv
import itertools
import re
from typing import NamedTuple

import numpy as np

from jrigid.records._units import split_unit

_MOST_ABOVE = 400  # lines that may stand above the header: blackbox logs have their settings there

_AXIS = re.compile(r"^(.*?)[\s_.\-]*(?:\[([012])\]|([xyz]))$", re.IGNORECASE)
# What a column measures, by words in its name; the first that fits.
_KINDS = {
    "times": r"^t$|^ts$|time|^second|^zeit|^millis|^micros",
    "gravity": r"gravity",
    "linear": r"lin|user|without g",  # acceleration with gravity taken away
    "rates": r"gyr|rot(?!.*vec)|angular|angvel|omega|winkel|^[wg]$|^rate",
    "specific_forces": r"acc|specific|beschl|^[af]$",
    "magnetic_fields": r"mag|^[mb]$",
}


class Table(NamedTuple):
    """Numbers under a header: of a `name` (the file's), `about` from the lines above."""

    name: str
    headers: list[str]
    values: np.ndarray
    about: dict[str, str]
    notes: list[str]

    def before(self, column: int) -> int | None:
        """The column of times nearest before a column, or the first one."""
        times = [j for j, x in enumerate(self.headers) if kind_of(split_unit(x)[0]) == "times"]
        times = [j for j in times if np.isfinite(self.values[:, j]).any()]
        return max((j for j in times if j < column), default=min(times, default=None))

    def triples(self) -> dict[str, list[int]]:
        """Columns of x, y, z by what their names have in common, in the order of the file."""
        triples: dict[str, dict[str, int]] = {}
        for column, header in enumerate(self.headers):
            match = _AXIS.match(split_unit(header)[0])
            if match and np.isfinite(self.values[:, column]).any():
                axis = match[3].lower() if match[3] else "xyz"[int(match[2])]
                triples.setdefault(match[1], {}).setdefault(axis, column)
        return {stem: [t[a] for a in "xyz"] for stem, t in triples.items() if len(t) == 3}

    def column(self, wanted: str) -> int:
        """A column by its header, with or without its unit, or ValueError."""
        for names in (self.headers, [split_unit(x)[0] for x in self.headers]):
            if wanted in names:
                return names.index(wanted)
        raise ValueError(
            f"Argument `columns` must name columns of the file, but {wanted!r} is none of "
            f"{', '.join(self.headers)}."
        )


def kind_of(name: str) -> str | None:
    """What the words of a name say that is measured: a key of `UNITS`, gravity, linear, None."""
    words = name.strip().lower()
    return next((kind for kind, pattern in _KINDS.items() if re.search(pattern, words)), None)


def parse(text: str, name: str) -> Table:
    """The table in a text, whatever its separator, decimal sign and lines above the header.

    Raises:
        ValueError: No line of numbers with a line of names above it.
    """
    lines = [x for x in text.removeprefix("\ufeff").splitlines() if x.strip(" \t,;")]
    few = lines[-50:]
    held = [d for d in "\t;," if sum(d in x for x in few) > len(few) / 2]
    separator = held[0] if held else ","
    rows = [[x.strip() for x in row] for row in csv.reader(lines, delimiter=separator)]
    head = next(
        (i for i, pair in enumerate(itertools.pairwise(rows[:_MOST_ABOVE])) if _is_header(*pair)),
        None,
    )
    if head is None:
        raise ValueError(
            "Argument `path` must be a file with the names of its columns in a line above its "
            f"numbers, but in {name!r} there is none."
        )
    headers, width, notes = rows[head], len(rows[head]), list[str]()
    body, commas, short, repeated = [], 0, 0, 0
    for row in rows[head + 1 :]:
        if row == headers:
            repeated += 1
        elif len(row) < width or any(row[width:]):
            short += 1
        else:
            commas += any("," in x for x in row)
            body.append([_number(x) for x in row[:width]])
    cut = bool(short) and len(rows[-1]) < width
    if cut:
        notes.append("the last line is cut off: dropped")
    for count, what in (
        (short - cut, "with another number of columns dropped"),
        (repeated, "of headers in the middle skipped"),
        (commas, "read with decimal commas"),
    ):
        if count:
            notes.append(f"{count} line{'s' if count > 1 else ''} {what}")
    above = {row[0]: separator.join(row[1:]) for row in rows[:head]}
    return Table(name, headers, np.array(body, float).reshape(-1, width), above, notes)


def _is_header(names: list[str], numbers: list[str]) -> bool:
    """Names without a number above at least two numbers."""
    known = [x for x in numbers if not np.isnan(_number(x)) or x.lower() == "nan"]
    words = [x for x in names if x]
    return (
        len(known) > 1
        and len(words) > 1
        and len(numbers) <= len(names) + 1
        and all(np.isnan(_number(x)) for x in words)
    )


def _number(cell: str) -> float:
    """A number, with a decimal point or comma; NaN for anything else."""
    if not cell:
        return np.nan
    try:
        return float(cell)
    except ValueError:
        try:
            return float(cell.replace(",", ".", 1))
        except ValueError:
            return np.nan
