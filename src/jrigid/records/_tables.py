"""Read files as tables, with the units that their formats do not state."""

import codecs
import csv
import io
import itertools
import os
import pathlib
import re
import types
import zipfile
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jrigid._checks import demand
from jrigid._extra import extra

Source = str | os.PathLike[str] | io.TextIOBase
# How the log of a flight controller begins.
_BLACKBOX = "H Product:Blackbox"
# Lines that may stand above the header: blackbox logs have their settings there.
_MOST_ABOVE = 400
_NOTHING: Mapping[int, float] = types.MappingProxyType({})
# Flight controllers run their gyros at 2000 deg/s, which 16 bits divide into 16.4
# counts a deg/s.
_FULL_SCALE = 2000.0
# Zero offsets and filters add a little to the full scale.
_OVER = 1.05
_MOST_COUNTS = 1 << 15
# Smaller scales are in radians per microsecond, as Baseflight has them.
_PER_MICROSECOND = 1e-6
# The bits of a float in hexadecimal digits.
_BITS = re.compile("(0x)?[0-9a-f]{8}", re.IGNORECASE)
# Numbers beyond this one are the bits of a float.
_LEAST_BITS = 1 << 20


class Table(NamedTuple):
    """Numbers under headers.

    Attributes:
        name: Of the file.
        headers: Of the columns.
        values: As the file has them.
        about: What the file says about itself, by key.
        notes: In words.
        source: Who states the units in the headers.
        scales: Factors from the file's numbers to the units in the headers, by column;
            1 if absent.
        sources: Who states the unit of a column, where it is not `source`, by column.
    """

    name: str
    headers: list[str]
    values: np.ndarray
    about: dict[str, str]
    notes: list[str]
    source: str = "the header says so"
    scales: Mapping[int, float] = _NOTHING
    sources: Mapping[int, str] = types.MappingProxyType({})


def tables_of(path: Source, log: int) -> list[Table]:
    """All tables of a path.

    Of several files those without a table are passed over.
    """
    texts = [(name, _text_of(data)) for name, data in _files_of(path)]
    # Sensor Logger writes this file beside those of the sensors.
    metadata = dict(texts).get("Metadata", "").splitlines()
    about = next(csv.DictReader(metadata, restval=""), {})
    tables: list[Table] = []
    for name, text in texts:
        try:
            if text.startswith(_BLACKBOX):
                table = _blackbox(str(path), name, log)
            else:
                table = _parse(text, name)
        except ValueError:
            if len(texts) == 1:
                raise
            continue
        tables.append(_with_units(table._replace(about=table.about | about)))
    return tables


def _files_of(path: Source) -> list[tuple[str, bytes]]:
    """Names and contents of a text, a file, or the CSV files of a folder or an archive.

    Files in different folders of an archive may have the same name.
    """
    if isinstance(path, io.TextIOBase):
        return [(str(getattr(path, "name", "text")), path.read().encode())]
    path = pathlib.Path(path)
    if path.is_dir():
        files = sorted(p for p in path.iterdir() if p.suffix.lower() == ".csv")
        return [(p.stem, p.read_bytes()) for p in files]
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            names = [n for n in archive.namelist() if n.lower().endswith(".csv")]
            return [(pathlib.PurePath(n).stem, archive.read(n)) for n in names]
    return [(path.stem, path.read_bytes())]


def _text_of(data: bytes) -> str:
    """The text of a file: of UTF-8, or of UTF-16 where a byte order mark says so."""
    # Spreadsheets write "Unicode text" so.
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    return data.decode("utf-8-sig", errors="replace")


def _blackbox(path: str, name: str, log: int) -> Table:
    """A log of a flight controller, decoded by orangebox."""
    orangebox = extra("records", "orangebox")
    # A parser for each log: one that goes on to another keeps the headers of the last.
    try:
        parser = orangebox.Parser.load(path, log, allow_invalid_header=True)
    except RuntimeError as error:
        raise ValueError(
            "Arguments `path` and `log` must be of a log that can be decoded, but: "
            f"{error}"
        ) from error
    names = parser.field_names
    several = parser.reader.log_count
    notes = [f"log {log} of {several}"] if several > 1 else []
    frames: list[list[int | float]] = []
    try:
        for frame in parser.frames():
            row = [x if isinstance(x, int | float) else np.nan for x in frame.data]
            frames.append(row)
    except (RuntimeError, ValueError, IndexError) as error:
        # Where a crash or the battery ended the log, orangebox raises one of these.
        notes.append(f"the log breaks off after {len(frames)} frames ({error})")
    whole = [x for x in frames if len(x) == len(names)]
    values = np.array(whole, float).reshape(-1, len(names))
    about = {key: str(value) for key, value in parser.headers.items()}
    return Table(name, names, values, about, notes)


def _parse(text: str, name: str) -> Table:
    """Parse a text with any separator, decimal sign and lines above the header."""
    separator, rows = _cells(text)
    pairs = itertools.pairwise(rows[:_MOST_ABOVE])
    head = next((i for i, pair in enumerate(pairs) if _is_header(*pair)), -1)
    demand(
        head >= 0,
        f"Argument `path` must have names of its columns above numbers, but {name!r} "
        "has not.",
    )
    headers = rows[head]
    width = len(headers)
    # Some programs write the header again where they were paused.
    below = [row for row in rows[head + 1 :] if row != headers]
    whole = [row[:width] for row in below if len(row) >= width and not any(row[width:])]
    numbers = [[_number(x) for x in row] for row in whole]
    values = np.array(numbers, float).reshape(-1, width)
    is_cut = len(rows[-1]) < width
    odd = len(below) - len(whole) - is_cut
    repeated = len(rows) - head - 1 - len(below)
    notes: list[str] = []
    if is_cut:
        notes.append("the last line is cut off: dropped")
    if odd:
        notes.append(f"{_lines(odd)} with another number of columns dropped")
    if repeated:
        notes.append(f"{_lines(repeated)} of headers in the middle skipped")
    if any("," in x and not np.isnan(_number(x)) for row in whole for x in row):
        notes.append("read with decimal commas")
    about = {row[0]: separator.join(row[1:]) for row in rows[:head]}
    return Table(name, headers, values, about, notes)


def _cells(text: str) -> tuple[str, list[list[str]]]:
    """The separator of a text, and the cells of its lines."""
    lines = [x for x in text.removeprefix("\ufeff").splitlines() if x.strip(" \t,;")]
    separator = _separator(lines)
    if separator == " ":
        # The trajectories of many data sets are like this, with names after a "#". A
        # unit in brackets belongs to the name before it.
        lines = [x.strip().removeprefix("#").lstrip() for x in lines]
        lines = [re.sub(r"\s+(?=[(\[])", "", x) for x in lines]
    # Several spaces are one separator.
    cells = csv.reader(lines, delimiter=separator, skipinitialspace=separator == " ")
    rows = [[x.strip() for x in row] for row in cells]
    return separator, rows


def _separator(lines: list[str]) -> str:
    """The separator of columns: one that most of the last lines have."""
    last = lines[-50:]
    # The comma comes after those beside which it may be the decimal sign. Spaces come
    # last, since they stand within the cells of other tables.
    for separator in "\t;, ":
        if sum(separator in x for x in last) > len(last) / 2:
            return separator
    return ","


def _lines(count: int) -> str:
    return f"{count} line{'s' if count > 1 else ''}"


def _is_header(names: list[str], numbers: list[str]) -> bool:
    """Names without a number above at least two numbers."""
    words = [x for x in names if x]
    known = [x for x in numbers if x.lower() == "nan" or not np.isnan(_number(x))]
    # A separator at the end of a line makes one more cell.
    fits = min(len(known), len(words)) > 1 and len(numbers) <= len(names) + 1
    return fits and all(np.isnan(_number(x)) for x in words)


def _number(cell: str) -> float:
    """A number, with a decimal point or comma; NaN for anything else."""
    try:
        return float(cell.replace(",", ".", 1))
    except ValueError:
        return np.nan


def _with_units(table: Table) -> Table:
    """Add the units that Sensor Logger and Betaflight do not state in headers."""
    if "seconds_elapsed" in table.headers:
        return _with_units_of_sensor_logger(table)
    if any(x.startswith(("gyroADC", "gyroUnfilt")) for x in table.headers):
        return _with_units_of_blackbox(table)
    return table


def _with_units_of_sensor_logger(table: Table) -> Table:
    """Rates are in rad/s; iOS gives accelerations the other sign."""
    about = table.about
    ios = about.get("platform") == "ios" and about.get("standardisation") != "true"
    sign = -1.0 if ios else 1.0
    # The first rule that fits counts. `acc` fits totals and uncalibrated readings, too,
    # which include gravity.
    rules = [
        ("^gyro|^rotationrate", "{} (rad/s)", 1.0),
        ("^magnetometer", "{} (uT)", 1.0),
        ("^total", "{} (m/s^2)", sign),
        ("uncalibrated|^gravity", "{}", sign),
        ("acc", "linear {}", sign),
        ("^seconds", "{} (s)", 1.0),
    ]
    for j, header in enumerate(table.headers):
        # Columns are called x, y and z, and the file after the sensor.
        name = f"{table.name} {header}" if len(header) == 1 else header
        fits = [rule for rule in rules if re.search(rule[0], name, re.IGNORECASE)]
        for _, new, factor in fits[:1]:
            table.headers[j] = new.format(name)
            table.values[:, j] *= factor
            if factor < 0:
                table.notes.append(
                    "turned about: iOS gives accelerations the other sign"
                )
    return table._replace(source="so Sensor Logger writes it")


def _with_units_of_blackbox(table: Table) -> Table:
    """Rates are in deg/s times a scale, or counts; accelerations in parts of `acc_1G`.

    Firmware up to the end of 2016 logs counts, and later firmware deg/s. The settings
    say which by `gyro_scale`; a CSV of `blackbox_decode` has no settings, so the range
    of the gyro decides.
    """
    scale, said = _gyro_scale(table.about)
    scales = {}
    sources = {}
    one_g = _number(table.about.get("acc_1G", ""))
    # A log without an accelerometer may state 0.
    if 0 < one_g < np.inf:
        for j in _columns(table, "accSmooth"):
            table.headers[j] += " (g)"
            scales[j] = 1 / one_g
    gyros = [*_columns(table, "gyroADC"), *_columns(table, "gyroUnfilt")]
    values = table.values[:, gyros]
    values = values[np.isfinite(values)]
    most = float(np.abs(values).max(initial=0.0))
    whole = bool(np.all(values == np.round(values)))
    unit = "deg/s"
    # A scale of 1 is written by firmware that scales itself, and by some that does not.
    if scale == 1.0 and _OVER * _FULL_SCALE < most <= _MOST_COUNTS and whole:
        unit = "counts"
        said = (
            f"no gyro of 2000 deg/s reads {most:.0f} deg/s, and counts are 16.4 to a "
            "deg/s; "
        )
        said += f"if they are tenths of deg/s, pass unit={np.pi / 1800:.6g}"
    elif not said and not table.about.keys() & {"gyro_scale", "gyro.scale"}:
        said = (
            "so Betaflight logs it since 2017; there is no gyro_scale, and older "
            "logs have "
        )
        said += "counts (unit='counts')"
    for j in gyros:
        table.headers[j] += f" ({unit})"
        scales[j] = scale
        if said:
            sources[j] = said
    return table._replace(
        source="so Betaflight logs it", scales=scales, sources=sources
    )


def _columns(table: Table, stem: str) -> list[int]:
    """Columns of the three axes of a field of a blackbox log without a unit."""
    fits = re.compile(rf"^{stem}\[[012]\]$")
    return [j for j, header in enumerate(table.headers) if fits.match(header)]


def _single(text: str) -> float:
    """A number, or the float of single precision whose bits are written; else NaN."""
    # Betaflight writes the bits as 0x3f800000. The prefix may be missing.
    if _BITS.fullmatch(text):
        bits = int(text, 16)
    else:
        number = _number(text)
        if not _LEAST_BITS < number < 1 << 32:
            return number
        bits = int(number)
    return float(np.uint32(bits).view(np.float32))


def _gyro_scale(about: Mapping[str, str]) -> tuple[float, str]:
    """Degrees per second of the number 1, and a note unless the settings are usual.

    Source: betaflight/blackbox-tools, `parser.c`; blackbox-log-viewer,
    `flightlog_parser.js` and `flightlog_fields_presenter.js`.
    """
    text = about.get("gyro_scale", about.get("gyro.scale", "1"))
    scale = _single(text)
    said = ""
    if not 0 < scale < np.inf:
        scale = 1.0
        said = f"gyro_scale is {text!r}, which is no scale: 1 is taken"
    elif scale < _PER_MICROSECOND:
        scale = float(np.degrees(1e6 * scale))
        # Single precision leaves a little beside a scale of 1.
        scale = 1.0 if abs(scale - 1) < 1e-5 else scale
        said = f"gyro_scale says {scale:.4g} deg/s, in radians per microsecond"
    elif scale != 1.0:
        said = f"gyro_scale says {scale:.4g} deg/s for each count"
    if about.get("blackbox_high_resolution", "0") not in ("0", "", "null"):
        scale /= 10
        said = "blackbox_high_resolution: tenths of deg/s"
    return scale, said
