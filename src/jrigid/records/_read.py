"""A file becomes a reading: which sensors, which units, whose clock; and all of it said."""

from collections.abc import Mapping

import numpy as np

from jrigid.records._clock import Clock, repair
from jrigid.records._formats import MEASURED, Named, Sensor, Source, sensors_of, tables_of
from jrigid.records._reading import Reading
from jrigid.records._table import Table
from jrigid.records._units import UNITS, Units, split_unit

_EPOCH = 1e6  # [s] later times count from some epoch and are made to count from 0


def read(
    path: Source,
    *,
    unit: str | Mapping[str, str] | None = None,
    columns: Named | None = None,
    clock: str | None = None,
    log: int = 1,
) -> Reading:
    r"""Read a file of sensors: phyphox, Sensor Logger, Betaflight, or anyone's columns by names.

    A folder or a zip may hold a file for each sensor. Units are those that `unit` says, else those
    that the file says (headers, or the format), else recognised where only one makes sense: times
    by the interval, accelerations by gravity, rates by the range of gyros or by how fast gravity
    turns in the body. All of it is in `notes`. The clock is the gyro's, put right by `repair`;
    sensors with times of their own are brought to it by linear interpolation, which is said too.

    Args:
        path: A file (.csv, .txt, .zip, .bbl, .bfl), a folder, or a text open for reading.
        unit: Of the rates (`"deg/s"`), or by what is measured: `{"times": "ms", "rates": "dps",
            "specific_forces": "g", "magnetic_fields": "uT"}`.
        columns: Which columns to take, by their headers with or without a unit: `{"times": "t",
            "rates": ("gx", "gy", "gz"), "specific_forces": ...}`; any other key is the new name of
            a column, as in `{"wheel": "speed (rpm)"}`. What is not named is recognised.
        clock: As in `repair`: `"recorded"`, `"uniform"` or None.
        log: Which log of a blackbox file with several, from 1.

    Returns:
        Times in s, rates in rad/s, specific forces in m/s^2, magnetic fields in T.

    Raises:
        ValueError: No times, no sensor, no such column, or a unit that is not known.
        ImportError: A blackbox log without the extra `jrigid[records]`.

    >>> import io
    >>> import jrigid as jr
    >>> rows = "".join(f"{10 * i},0,{18 * i},180\n" for i in range(4))
    >>> text = io.StringIO("t_ms,gx (deg/s),gy (deg/s),gz (deg/s)\n" + rows)
    >>> print(jr.records.read(text))
    4 readings over 0.03 s, one in 10 ms
      rates: 3.28 rad/s at most
      - times (t_ms) taken as ms: the header says so
      - rates (gx, gy, gz) taken as deg/s: the header says so

    Source: phyphox-android, `DataExport.java`; awesome-sensor-logger, `UNITS.md` and
    `COORDINATES.md`; betaflight/blackbox-tools, `units.h` and `parser.c`.
    """
    notes: list[str] = []
    units = Units({"rates": unit} if isinstance(unit, str) else dict(unit or {}), notes)
    named = dict(columns or {})
    tables, about = tables_of(path, log)
    chosen = _choose(tables, named)
    main = next((chosen[kind] for kind in MEASURED if kind in chosen), None)
    if main is None:
        headers = ", ".join(h for table in tables for h in table.headers)
        raise ValueError(
            "Argument `path` must hold three columns of a sensor, but none is recognised: name "
            f"them by `columns`. There are {headers or 'no tables'}."
        )
    several = len({s.table.name for s in chosen.values()}) > 1
    notes += [f"{t.name}: {x}" if several else x for t in tables for x in t.notes]

    times = {kind: _seconds(sensor, units) for kind, sensor in chosen.items()}
    origin = min(np.nanmin(t, initial=np.inf) for t in times.values())
    if _EPOCH < origin < np.inf:
        notes.append(f"times count from {origin:.6f} s of the file's clock")
        times = {kind: t - origin for kind, t in times.items()}
    clocks: dict[str, Clock] = {}
    for kind, sensor in chosen.items():
        clocks[kind] = repair(times[kind], sensor.values, clock=clock)
        notes += [f"{sensor.label}: {x}" if several else x for x in clocks[kind].notes]
    own = clocks[main.kind]
    onto = {kind: _onto(own, clocks[kind], sensor, notes) for kind, sensor in chosen.items()}

    forces = _forces(chosen, onto, units, about)
    rates = fields = None
    if "magnetic_fields" in chosen:
        fields = _in_si(chosen["magnetic_fields"], onto["magnetic_fields"], units)
    if "rates" in chosen:
        gyro, raw = chosen["rates"], onto["rates"]
        factor = units.stated("rates", gyro.label, *gyro.scale)
        if factor is None:
            factor = units.of_rates(gyro.label, own.times, raw, forces)
        elif forces is not None:
            units.doubt(own.times, raw, forces, factor)
        rates = factor * raw
    missing = {"specific_forces", "linear", "gravity"} if forces is None else set()
    missing |= {"magnetic_fields"} if fields is None else set()
    used = [s for kind, s in chosen.items() if kind not in missing]
    others = _others(main, main.rows[own.rows], used, named)
    said = tuple(dict.fromkeys(notes))
    return Reading(own.times, rates, forces, fields, others, own.breaks, said)


def _choose(tables: list[Table], named: Named) -> dict[str, Sensor]:
    """The first sensor of each kind; one that is calibrated before others."""
    chosen: dict[str, Sensor] = {}
    for sensor in (s for table in tables for s in sensors_of(table, named)):
        old = chosen.get(sensor.kind)
        if old is None or ("uncal" in old.label.lower() and sensor.kind not in named):
            chosen[sensor.kind] = sensor
    for part in ("linear", "gravity") if "specific_forces" in chosen else ():
        chosen.pop(part, None)
    return chosen


def _seconds(sensor: Sensor, units: Units) -> np.ndarray:
    """Times of a sensor [s]."""
    times, header = sensor.times, sensor.table.headers[sensor.time or 0]
    stated = "s" if header == "seconds_elapsed" else split_unit(header)[1]
    factor = units.stated("times", header, stated, "the header says so")
    return times * (factor or units.of_times(header, times))


def _onto(own: Clock, other: Clock, sensor: Sensor, notes: list[str]) -> np.ndarray:
    """Values at the times of the main clock; NaN before, after and in breaks."""
    values = sensor.values[other.rows]
    if np.array_equal(own.times, other.times):
        return values
    notes.append(f"{sensor.label}: times of its own; brought to those of the rest linearly")
    after = np.searchsorted(other.times, own.times, side="left")
    silent = (own.times < other.times[0]) | (own.times > other.times[-1])
    silent |= np.isin(after, other.breaks) & ~np.isin(own.times, other.times)
    columns = [np.interp(own.times, other.times, column) for column in values.T]
    return np.where(silent[:, None], np.nan, np.stack(columns, axis=1))


def _in_si(sensor: Sensor, values: np.ndarray, units: Units) -> np.ndarray | None:
    """Forces or fields in SI; None where their unit is neither stated nor recognised."""
    factor = units.stated(sensor.kind, sensor.label, *sensor.scale)
    if factor is None and sensor.kind == "specific_forces":
        factor = units.of_forces(sensor.label, values)
    if factor is None:
        what = sensor.kind.replace("_", " ")
        units.notes.append(f"{what} ({sensor.label}) left out: their unit is not stated")
        return None
    return factor * values


def _forces(
    chosen: dict[str, Sensor], onto: dict[str, np.ndarray], units: Units, about: dict[str, str]
) -> np.ndarray | None:
    """Specific forces [m/s^2], from one sensor or from what a phone took apart."""
    sensor, values = chosen.get("specific_forces"), onto.get("specific_forces")
    if sensor is None and "linear" in chosen:
        sensor = chosen["linear"]
        if "gravity" not in chosen:
            units.notes.append(f"{sensor.label}: without gravity, no specific force; left out")
            return None
        sensor = sensor._replace(kind="specific_forces", label=f"{sensor.label} with gravity")
        values = onto["linear"] + onto["gravity"]
    if sensor is None or values is None:
        return None
    forces = _in_si(sensor, values, units)
    standard = about.get("standardisation", "").lower() == "true"
    if forces is not None and about.get("platform", "").lower() == "ios" and not standard:
        units.notes.append("specific forces turned about: iOS gives them the other sign")
        forces = -forces
    return forces


def _others(
    main: Sensor, rows: np.ndarray, used: list[Sensor], named: Named
) -> dict[str, np.ndarray]:
    """The other columns with numbers, and those asked for by a name, in SI by their header."""
    table = main.table
    taken = {main.time, *(j for s in used if s.table is table for j in (*s.columns, s.time))}
    others = {
        header: table.values[rows, j]
        for j, header in enumerate(table.headers)
        if header and j not in taken and np.isfinite(table.values[rows, j]).any()
    }
    for name, header in named.items():
        if name not in UNITS:
            column = table.column(str(header))
            unit = split_unit(table.headers[column])[1]
            factor = next((known[unit] for known in UNITS.values() if unit in known), 1.0)
            others.pop(table.headers[column], None)
            others[name] = factor * table.values[rows, column]
    return others
