"""A file becomes a reading: which sensors, which units, whose clock; and all of it said."""

import io
import os
from collections.abc import Mapping, Sequence

import numpy as np

from jrigid._checks import check_option
from jrigid.records._clock import Clock, repair
from jrigid.records._formats import MEASURED, Sensor, sensors_of, tables_of
from jrigid.records._reading import Reading
from jrigid.records._table import UNITS, Table, plain_unit, split_unit

_GYRO_RANGE = 70.0  # [rad/s] no common gyro measures beyond 4000 deg/s
_COUNTS = 4100.0  # beyond, numbers are neither rad/s nor deg/s but counts of a converter
_GRAVITY = {"g": (0.8, 1.25), "m/s^2": (7.8, 12.3)}  # the median of |specific force| at hand
_TICKS = {"s": 1.25e-4, "ms": 0.125, "us": 125.0, "ns": 1.25e5}  # least step of 8 Hz to 8 kHz
_EPOCH = 1e6  # [s] later times count from some epoch and are made to count from 0
_TURN = 0.1  # [s] over which the turning of gravity is compared with the rates
_LIKE = 0.4  # correlation of the two from which their ratio is believed


def read(
    path: str | os.PathLike[str] | io.TextIOBase,
    *,
    unit: str | Mapping[str, str] | None = None,
    columns: Mapping[str, str | Sequence[str]] | None = None,
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
      - times taken as ms: the header says so
      - rates (g) taken as deg/s: the header says so

    Source: phyphox-android, `DataExport.java`; awesome-sensor-logger, `UNITS.md` and
    `COORDINATES.md`; betaflight/blackbox-tools, `units.h` and `parser.c`.
    """
    units = {"rates": unit} if isinstance(unit, str) else dict(unit or {})
    for kind, name in units.items():
        check_option("unit", kind, tuple(UNITS))
        check_option("unit", plain_unit(name), tuple(UNITS[kind]))
    named = dict(columns or {})
    tables, about = tables_of(path, log)
    chosen: dict[str, Sensor] = {}
    for table in tables:
        for sensor in sensors_of(table, named):
            old = chosen.get(sensor.kind)
            if old is None or ("uncal" in old.label.lower() and sensor.kind not in named):
                chosen[sensor.kind] = sensor
    main = next((chosen[kind] for kind in MEASURED if kind in chosen), None)
    if main is None:
        headers = ", ".join(h for table in tables for h in table.headers)
        raise ValueError(
            "Argument `path` must hold three columns of a sensor, but none is recognised: name "
            f"them by `columns`. There are {headers or 'no tables'}."
        )
    several = len({s.table.name for s in chosen.values()}) > 1
    notes = [f"{t.name}: {x}" if several else x for t in tables for x in t.notes]

    times = {kind: _seconds(sensor, units, notes) for kind, sensor in chosen.items()}
    origin = min(t.min() for t in times.values())
    if origin > _EPOCH:
        notes.append(f"times count from {origin:.6f} s of the file's clock")
        times = {kind: t - origin for kind, t in times.items()}
    clocks: dict[str, Clock] = {}
    for kind, sensor in chosen.items():
        clocks[kind] = repair(times[kind], sensor.values, clock=clock)
        notes += [f"{sensor.label}: {x}" if several else x for x in clocks[kind].notes]
    own = clocks[main.kind]
    onto = {kind: _onto(own, clocks[kind], sensor, notes) for kind, sensor in chosen.items()}
    forces = _forces(chosen, onto, units, about, notes)
    fields = None
    if "magnetic_fields" in chosen:
        fields = _in_si(chosen["magnetic_fields"], onto["magnetic_fields"], units, notes)
    rates = None
    if "rates" in chosen:
        rates = _rates(chosen["rates"], own.times, onto["rates"], forces, units, notes)
    rows = main.rows[own.rows]
    rest = _others(main.table, rows, [s for s in chosen.values() if s.table is main.table], named)
    return Reading(own.times, rates, forces, fields, rest, own.breaks, tuple(dict.fromkeys(notes)))


def _seconds(sensor: Sensor, units: dict[str, str], notes: list[str]) -> np.ndarray:
    """Times of a sensor [s]."""
    times = sensor.times
    header, stated = split_unit(sensor.table.headers[sensor.time or 0])
    if "times" in units:
        unit, why = plain_unit(units["times"]), "`unit` says so"
    elif stated is not None or header == "seconds_elapsed":
        unit, why = stated or "s", "the header says so"
    else:
        steps = np.diff(times[np.isfinite(times)])
        step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        likely = [name for name, least in _TICKS.items() if least <= step < 1000 * least]
        if not likely:
            raise ValueError(
                "Argument `unit` must say the unit of `times`, but it does not, and steps of "
                f"{step:g} are neither seconds nor milli-, micro- or nanoseconds of 8 Hz to 8 kHz."
            )
        unit, why = likely[0], f"their median step is {step:g}"
    notes.append(f"times taken as {unit}: {why}")
    return times * _factor("times", unit)


def _factor(kind: str, unit: str) -> float:
    if unit not in UNITS[kind]:
        raise ValueError(
            f"Argument `unit` must say the unit of `{kind}`, but it does not, and the file's "
            f"{unit!r} is not known."
        )
    return UNITS[kind][unit]


def _stated(sensor: Sensor, kind: str, units: dict[str, str], notes: list[str]) -> float | None:
    """The factor to SI that the caller or the file states."""
    if kind in units:
        unit, why = plain_unit(units[kind]), "`unit` says so"
        if sensor.unit not in (None, unit):
            why += f", though the file says {sensor.unit}"
        factor = _factor(kind, unit)
    elif sensor.unit is not None:
        unit, why = sensor.unit, sensor.source
        factor = _factor(kind, unit) if sensor.factor is None else sensor.factor
    else:
        return None
    notes.append(f"{kind.replace('_', ' ')} ({sensor.label}) taken as {unit}: {why}")
    return factor


def _in_si(
    sensor: Sensor, values: np.ndarray, units: dict[str, str], notes: list[str]
) -> np.ndarray | None:
    """Forces or fields in SI; None where their unit is neither stated nor recognised."""
    factor = _stated(sensor, sensor.kind, units, notes)
    if factor is not None:
        return factor * values
    what = f"{sensor.kind.replace('_', ' ')} ({sensor.label})"
    size = float(np.nanmedian(np.linalg.norm(values, axis=1)))
    for unit, (least, most) in _GRAVITY.items():
        if sensor.kind == "specific_forces" and least < size < most:
            notes.append(f"{what} taken as {unit}: their median is {size:.3g}")
            return _factor(sensor.kind, unit) * values
    notes.append(f"{what} left out: their unit is not stated, and their median is {size:.3g}")
    return None


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


def _forces(
    chosen: dict[str, Sensor],
    onto: dict[str, np.ndarray],
    units: dict[str, str],
    about: dict[str, str],
    notes: list[str],
) -> np.ndarray | None:
    """Specific forces [m/s^2], from one sensor or from what a phone took apart."""
    sensor, values = chosen.get("specific_forces"), onto.get("specific_forces")
    if sensor is None and "linear" in chosen:
        if "gravity" not in chosen:
            notes.append(f"{chosen['linear'].label}: without gravity, no specific force; left out")
            return None
        values = onto["linear"] + onto["gravity"]
        sensor = chosen["linear"]._replace(kind="specific_forces", label="with gravity added")
    if sensor is None or values is None:
        return None
    forces = _in_si(sensor, values, units, notes)
    apple = about.get("platform", "").lower() == "ios"
    if forces is not None and apple and about.get("standardisation", "").lower() != "true":
        notes.append("specific forces turned about: iOS gives them the other sign")
        forces = -forces
    return forces


def _rates(
    sensor: Sensor,
    times: np.ndarray,
    rates: np.ndarray,
    forces: np.ndarray | None,
    units: dict[str, str],
    notes: list[str],
) -> np.ndarray:
    """Rates [rad/s]."""
    factor = _stated(sensor, "rates", units, notes)
    if factor is not None:
        return factor * rates
    unit = why = None
    most = float(np.abs(rates).max())
    if _GYRO_RANGE < most < _COUNTS:
        unit, why = "deg/s", f"no gyro reads {most:.0f} rad/s"
    elif most <= _GYRO_RANGE and forces is not None:
        unit, why = _by_turning_gravity(times, rates, forces), "so gravity turns in the body"
    if unit is None:
        raise ValueError(
            "Argument `unit` must say the unit of the rates, but it does not, and neither does the "
            f"file; numbers up to {most:.6g} do not tell."
        )
    notes.append(f"rates ({sensor.label}) taken as {unit}: {why}")
    return UNITS["rates"][unit] * rates


def _by_turning_gravity(times: np.ndarray, rates: np.ndarray, forces: np.ndarray) -> str | None:
    """The unit in which gravity turns as the rates say, df/dt = -omega x f; None if unclear."""
    lag = max(1, round(_TURN / float(np.median(np.diff(times)))))
    turning = -np.cross(rates, forces)
    steps = 0.5 * (turning[1:] + turning[:-1]) * np.diff(times)[:, None]
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(np.nan_to_num(steps), axis=0)])
    said, seen = sums[lag:] - sums[:-lag], forces[lag:] - forces[:-lag]
    size = np.linalg.norm(forces, axis=1)
    least, most = _GRAVITY["m/s^2"]
    use = np.isfinite(seen).all(axis=1) & (size[lag:] > least) & (size[lag:] < most)
    said, seen = said[use], seen[use]
    product, square = float(np.sum(said * seen)), float(np.sum(said**2))
    if product <= _LIKE * np.sqrt(square * np.sum(seen**2)):
        return None
    return min(("rad/s", "deg/s"), key=lambda u: abs(np.log(product / square / UNITS["rates"][u])))


def _others(
    table: Table, rows: np.ndarray, used: list[Sensor], named: dict[str, str | Sequence[str]]
) -> dict[str, np.ndarray]:
    """The other columns with numbers, and those asked for by a name, in SI by their header."""
    taken = {j for s in used for j in (*s.columns, s.time)}
    rest = {
        header: table.values[rows, j]
        for j, header in enumerate(table.headers)
        if header and j not in taken and np.isfinite(table.values[rows, j]).any()
    }
    for name, header in named.items():
        if name not in UNITS:
            column = table.column(str(header))
            stated = split_unit(table.headers[column])[1]
            known = [kind for kind in UNITS if stated in UNITS[kind]]
            rest.pop(table.headers[column], None)
            factor = UNITS[known[0]][str(stated)] if known else 1.0
            rest[name] = factor * table.values[rows, column]
    return rest
