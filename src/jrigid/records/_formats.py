"""What is in a file: tables, and the sensors in them with the units that files and apps state."""

import importlib
import io
import os
import pathlib
import struct
import zipfile
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jrigid.records._table import Table, kind_of, parse
from jrigid.records._units import UNITS, split_unit

_BLACKBOX = b"H Product:Blackbox"  # how the log of a flight controller begins
# Unit, who states it, and a factor to SI where the unit alone is not enough.
Scale = tuple[str | None, str, float | None]
Source = str | os.PathLike[str] | io.TextIOBase
Named = Mapping[str, str | Sequence[str]]
MEASURED = ("rates", "specific_forces", "magnetic_fields")
# Sensor Logger: what is in the file of a sensor, and in which unit (None: it depends).
_SENSOR_LOGGER = {
    "gyroscope": ("rates", "rad/s"),
    "gyroscopeuncalibrated": ("rates", "rad/s"),
    "totalacceleration": ("specific_forces", "m/s^2"),
    "accelerometer": ("linear", None),
    "accelerometeruncalibrated": ("specific_forces", None),
    "gravity": ("gravity", None),
    "magnetometer": ("magnetic_fields", "ut"),
    "magnetometeruncalibrated": ("magnetic_fields", "ut"),
}


class Sensor(NamedTuple):
    """Three columns of a table where all are numbers, with their unit and who states it."""

    kind: str
    label: str
    table: Table
    time: int | None
    columns: list[int]
    rows: np.ndarray
    scale: Scale = (None, "", None)

    @property
    def times(self) -> np.ndarray:
        """As they are in the table."""
        if self.time is None:
            raise ValueError(
                "Argument `columns` must name the column of the times, but it does not, and none "
                f"of {', '.join(self.table.headers)} is recognised."
            )
        return self.table.values[self.rows, self.time]

    @property
    def values(self) -> np.ndarray:
        """As they are in the table."""
        return self.table.values[self.rows][:, self.columns]


def tables_of(path: Source, log: int) -> tuple[list[Table], dict[str, str]]:
    """All tables behind a path, and what a recording says about itself."""
    if isinstance(path, io.TextIOBase):
        return [parse(path.read(), str(getattr(path, "name", "text")))], {}
    path = pathlib.Path(path)
    if path.is_dir():
        files = {p.stem: p.read_bytes() for p in sorted(path.glob("*.csv"))}
    elif path.suffix.lower() == ".zip":
        with zipfile.ZipFile(path) as archive:
            names = [n for n in archive.namelist() if n.lower().endswith(".csv")]
            files = {pathlib.PurePath(n).stem: archive.read(n) for n in names}
    else:
        files = {path.stem: path.read_bytes()}
        if files[path.stem].startswith(_BLACKBOX):
            return [_blackbox(path, log)], {}
    texts = {name: data.decode("utf-8-sig", errors="replace") for name, data in files.items()}
    several = len(texts) > 1
    about: dict[str, str] = {}
    for name in [n for n in texts if n.lower() == "metadata"]:
        keys, values, *_ = [*texts.pop(name).splitlines(), "", ""]
        about = dict(zip(keys.split(","), values.split(","), strict=False))
    tables = []
    for name, text in texts.items():
        try:
            tables.append(parse(text, name))
        except ValueError:
            if not several:  # of several files some, as annotations or phyphox's `meta`, hold none
                raise
    return tables, about


def _blackbox(path: pathlib.Path, log: int) -> Table:
    """A log of a flight controller, decoded by orangebox."""
    try:
        orangebox = importlib.import_module("orangebox")
    except ModuleNotFoundError as error:
        raise ImportError('This needs orangebox: pip install "jrigid[records]".') from error
    # A parser for each log: one that goes on to another keeps the headers of the last.
    try:
        parser = orangebox.Parser.load(str(path), log, allow_invalid_header=True)
    except RuntimeError as error:
        raise ValueError(
            f"Arguments `path` and `log` must be of a log that can be decoded, but: {error}"
        ) from error
    names, frames, notes = parser.field_names, [], []
    if parser.reader.log_count > 1:
        notes.append(f"log {log} of {parser.reader.log_count}")
    try:
        for frame in parser.frames():
            frames.append([x if isinstance(x, int | float) else np.nan for x in frame.data])
    except (RuntimeError, ValueError, IndexError) as error:
        # Where a crash or the battery ended the log, orangebox raises one of these.
        notes.append(f"the log breaks off after {len(frames)} frames ({error})")
    values = [row for row in frames if len(row) == len(names)]
    about = {key: str(value) for key, value in parser.headers.items()}
    return Table(path.stem, names, np.array(values, float).reshape(-1, len(names)), about, notes)


def sensors_of(table: Table, named: Named) -> list[Sensor]:
    """The sensors of a table: those named, then those recognised."""
    logger = "seconds_elapsed" in table.headers
    candidates: list[tuple[str | None, str, list[int], Scale]] = []
    for kind in MEASURED:
        if kind in named:
            if isinstance(named[kind], str) or len(named[kind]) != 3:
                raise ValueError(
                    f"Argument `columns` must name three columns for `{kind}`, but it names "
                    f"{named[kind]!r}."
                )
            three = [table.column(name) for name in named[kind]]
            scale = _betaflight(named[kind][0].partition("[")[0], table.about)
            candidates.append((kind, ", ".join(named[kind]), three, scale))
    for stem, three in table.triples().items():
        label = stem.strip() or table.name
        if len(label) == 1:
            label = ", ".join(split_unit(table.headers[j])[0] for j in three)
        kind, scale = kind_of(stem or table.name), _betaflight(label, table.about)
        if logger and not stem:
            kind, unit = _SENSOR_LOGGER.get(table.name.lower(), (None, None))
            scale = unit, "so Sensor Logger writes it", None
        elif logger and kind == "specific_forces":
            kind = "linear"  # of watches and headphones, which have columns of gravity too
        candidates.append((kind, label, three, scale))
    sensors = []
    for kind, label, three, scale in candidates:
        unit = split_unit(table.headers[three[0]])[1]
        if unit is not None:  # a unit in the header beats that of the format
            scale = unit, "the header says so", None
        time = table.column(str(named["times"])) if "times" in named else table.before(three[0])
        rows = np.flatnonzero(np.isfinite(table.values[:, three]).all(axis=1))
        if kind not in (None, "times") and rows.size:
            sensors.append(Sensor(str(kind), label, table, time, three, rows, scale))
    return sensors


def _betaflight(stem: str, about: dict[str, str]) -> Scale:
    """Unit and scale of the raw numbers of a blackbox log; nothing for other names."""
    if stem in ("gyroADC", "gyroUnfilt"):
        text = about.get("gyro_scale", about.get("gyro.scale", "1"))
        bits = int(text, 0) if text.startswith("0x") or text.isdigit() else 0
        # a float written as the integer of the same bits
        scale = struct.unpack("f", struct.pack("I", bits))[0] if bits > 1 << 20 else float(text)
        return "deg/s", "so Betaflight logs its gyro", scale * UNITS["rates"]["deg/s"]
    if stem == "accSmooth" and "acc_1G" in about:
        one = float(about["acc_1G"])
        return "counts", f"acc_1G is {one:g}", UNITS["specific_forces"]["g"] / one
    return None, "", None
