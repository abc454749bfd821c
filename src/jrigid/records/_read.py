"""Make a reading of tables: columns of sensors, their units, and one clock."""

import numbers
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jrigid._checks import check_option, demand
from jrigid.records._clock import Clock, repair
from jrigid.records._found_in_records import Reading
from jrigid.records._tables import Source, Table, tables_of

# By what is measured, in SI, spelled as `_plain` returns them.
_UNITS: dict[str, dict[str, float]] = {
    "times": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "rates": dict.fromkeys(("rad/s", "rads", "rad_s", "radians/s"), 1.0)
    | dict.fromkeys(("deg/s", "°/s", "dps", "deg_s", "degs", "degrees/s"), np.pi / 180)
    | {"mrad/s": 1e-3, "mdps": np.pi / 180e3, "rpm": np.pi / 30, "rev/s": 2 * np.pi}
    | {"counts": np.pi / 180 / 16.4},  # of 16 bits for 2000 deg/s
    "specific_forces": dict.fromkeys(
        ("m/s^2", "m/s2", "m/s/s", "mps2", "ms^-2", "ms-2"), 1.0
    )
    | {"g": 9.80665, "mg": 9.80665e-3},
    "magnetic_fields": {
        "t": 1.0,
        "mt": 1e-3,
        "ut": 1e-6,
        "nt": 1e-9,
        "g": 1e-4,
        "gauss": 1e-4,
    },
}
#: A name, or a factor to SI.
Unit = str | float | int
Columns = Mapping[str, str | Sequence[str]]
_MEASURED = ("rates", "specific_forces", "magnetic_fields")
# What a column measures, by words in its name; the first that fits.
_KINDS = {
    "times": r"^t$|^ts$|time|^second|^zeit|^millis|^micros",
    "gravity": r"gravity",
    "linear": r"lin|user|without g",  # acceleration with gravity taken away
    "rates": r"gyr|rot(?!.*vec)|angular|angvel|omega|winkel|^[wg]$|^rate",
    "specific_forces": r"acc|specific|beschl|^[af]$",
    "magnetic_fields": r"mag|^[mb]$",
}
_AXIS = re.compile(r"^(.*?)[\s_.\-]*(\[[012]\]|[xyz])$", re.IGNORECASE)
_UNIT = re.compile(r"\s*[(\[]\s*([^()\[\]\d][^()\[\]]*)\s*[)\]]\s*$")
_SUFFIX = re.compile(
    r"_(rad_s|deg_s|rads|degs|dps|mdps|rpm|mps2|ms|us|ns|s)$", re.IGNORECASE
)
# Times beyond this count from some epoch [s], and are made to count from 0.
_EPOCH = 1e6
# No common gyro measures more: 4000 deg/s is the widest range of those in phones,
# loggers and flight controllers. In rad/s, and in deg/s with a margin for what a filter
# or an offset adds.
_RANGE = (70.0, 4100.0)
# Medians of what each row says: steps of 8 Hz to 8 kHz, and sizes at hand.
_USUAL = {
    "times": {
        "s": (125e-6, 0.125),
        "ms": (0.125, 125),
        "us": (125, 125e3),
        "ns": (125e3, 125e6),
    },
    "specific_forces": {"g": (0.8, 1.25), "m/s^2": (7.8, 12.3)},
}
# Time over which the turning of gravity is compared with the rates [s].
_TURN = 0.1
# If the two have at least this correlation, their ratio is believed.
_LIKE = 0.4


class _Sensor(NamedTuple):
    """Times and three axes of a table, in the rows where all axes are numbers."""

    label: str
    table: Table
    columns: list[int]
    rows: np.ndarray
    missed: int = 0


class _Units(NamedTuple):
    """Units that the caller `asked` for, and notes on who states each unit."""

    asked: dict[str, Unit]
    notes: list[str]

    def factor(
        self, kind: str, sensor: _Sensor, values: np.ndarray, turned: str = ""
    ) -> float | None:
        """The factor to SI from the caller, the file or the numbers, else None."""
        table = sensor.table
        # The first column has the times. One axis speaks for all three.
        columns = sensor.columns[:1] if kind == "times" else sensor.columns[1:4]
        column = columns[0]
        units = [_split(table.headers[j])[1] for j in columns]
        stated = [x for x in units if x is not None]
        unit = stated[0] if stated else None
        scale = table.scales.get(column, 1.0)
        what = f"{kind.replace('_', ' ')} ({_label(kind, sensor)})"
        if unit == "counts":
            turned = ""  # gravity tells rad/s from deg/s alone
        demand(
            kind in self.asked or len({_UNITS[kind].get(x, x) for x in stated}) < 2,
            f"Argument `unit` must say the unit of `{kind}`, but it does not, and the "
            f"file states {' and '.join(dict.fromkeys(stated))} for its axes.",
        )
        if kind in self.asked:
            factor, said = self._as_asked(kind, unit, scale, column in table.sources)
        else:
            source = table.sources.get(column, table.source)
            if unit is None:
                unit, source = _recognised(kind, values, turned)
            if unit is None:
                self.notes.append(f"{what} left out: their unit is not stated")
                return None
            other = f"but it does not, and the file's {unit!r} is not known."
            # How much a count is only the caller can tell, unless the format does.
            known = unit in _UNITS[kind] and (
                unit != "counts" or column in table.sources
            )
            demand(known, f"Argument `unit` must say the unit of `{kind}`, {other}")
            factor = scale * _UNITS[kind][unit]
            said = f"taken as {unit}: {source}"
        if kind == "rates":
            said += _range_checked(values, factor, "rates" in self.asked)
        self.notes.append(f"{what} {said}")
        # rad/s and deg/s differ by a factor of 57: within 5 the file and gravity agree.
        if turned and not 0.2 < factor / scale / _UNITS["rates"][turned] < 5:
            # Headers can be wrong.
            self.notes.append(
                f"yet gravity turns in the body as if the rates were in {turned}"
            )
        return factor

    def _as_asked(
        self, kind: str, unit: str | None, scale: float, guessed: bool
    ) -> tuple[float, str]:
        """The caller's factor and a note; `unit` is what the file says."""
        asked = self.asked[kind]
        if not isinstance(asked, str):
            return float(asked), f"multiplied by {asked:g}: `unit` says so"
        differs = unit not in (None, asked) and not guessed
        heard = f", though the file says {unit}" if differs else ""
        # Where the caller names another unit than the file, the numbers are meant as
        # they are.
        factor = _UNITS[kind][asked] * (scale if unit == asked else 1.0)
        return factor, f"taken as {asked}: `unit` says so{heard}"


def _label(kind: str, sensor: _Sensor) -> str:
    """Name in notes of the columns of a sensor, or of its column of times."""
    return sensor.table.headers[sensor.columns[0]] if kind == "times" else sensor.label


def _range_checked(values: np.ndarray, factor: float, asked: bool) -> str:
    """Note rates that no gyro reads if the caller states a unit, else raise."""
    most = float(np.abs(values).max(initial=0.0))
    if most * factor <= _RANGE[0]:
        return ""
    beyond = f"no common gyro reads {most * factor:.0f} rad/s"
    if asked:
        return f", though {beyond}"
    raise ValueError(_question(most, beyond))


def _question(most: float, why: str) -> str:
    """Ask for the unit of rates, with the largest number in the usual units."""
    degree = np.pi / 180
    count = _UNITS["rates"]["counts"]
    return (
        f"Argument `unit` must say the unit of the rates, but it does not, and {why}. "
        f"The largest number, {most:.6g}, is {most:.4g} rad/s by `unit='rad/s'`, "
        f"{most * degree:.4g} rad/s by `unit='deg/s'`, {most * count:.4g} rad/s by "
        "`unit='counts'` (of a gyro of 2000 deg/s, 16.4 to a deg/s). "
        f"(`unit={{'rates': ...}}`, one of {', '.join(_UNITS['rates'])}, or a factor "
        "to rad/s.)"
    )


def read(
    path: Source,
    *,
    unit: Unit | Mapping[str, Unit] | None = None,
    columns: Columns | None = None,
    clock: str | None = None,
    log: int = 1,
) -> Reading:
    r"""Read a file of sensors: phyphox, Sensor Logger, Betaflight or named columns.

    A folder or a zip may hold a file for each sensor. Units are those that `unit` says,
    else those that the file says (headers, or the format), else recognised where only
    one makes sense: times by the interval, accelerations by gravity, rates by the range
    of gyros or by how fast gravity turns in the body. Accelerations and magnetic fields
    whose unit nobody says are left out. All of it is in `notes`. The
    clock is the gyro's, put right by `repair`; sensors with times of their own are
    brought to it by linear interpolation, which is said too.

    Args:
        path: A file (.csv, .txt, .zip, .bbl, .bfl), a folder, or a text open for
            reading.
        unit: Of the rates (`"deg/s"`), or by what is measured:
            `{"times": "ms", "rates": "dps", "specific_forces": "g", "magnetic_fields":
            "uT"}`. A number is a factor to SI: `unit=` `np.pi /
            1800` for tenths of deg/s. `"counts"` are those of a gyro with a range of
            2000 deg/s in 16 bits, 16.4 to a deg/s. Rates above 70 rad/s need a unit
            from the caller.
        columns: Which columns to take, by their headers with or without a unit:
            `{"times": "t", "rates": ("gx", "gy", "gz"), "specific_forces": ...}`; any
            other key is the new name of a column, as in `{"wheel": "speed (rpm)"}`.
            What is not named is recognised.
        clock: As in `repair`: `"recorded"`, `"uniform"` or None.
        log: Which log of a blackbox file with several, from 1.

    Returns:
        Times in s, rates in rad/s, specific forces in m/s^2, magnetic fields in T.

    Raises:
        ValueError: No times, no sensor, no such column, a unit that is not known, or
            rates beyond the range of gyros (70 rad/s) without `unit`.
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
    units = _Units(_asked(unit), [])
    columns = columns or {}
    tables = tables_of(path, log)
    chosen, main = _chosen(tables, columns, units.notes)
    own, raw = _on_one_clock(chosen, main, clock, units)
    measured = _in_si(chosen, raw, own.times, units)
    used = {main.columns[0]}
    for kind in measured:
        if chosen[kind].table is main.table:
            used.update(chosen[kind].columns)
    others = _others(main, own.rows, used)
    notes = tuple(dict.fromkeys(units.notes))
    return Reading(
        own.times, **measured, columns=others, breaks=own.breaks, notes=notes
    )


def _chosen(
    tables: list[Table], columns: Columns, notes: list[str]
) -> tuple[dict[str, _Sensor], _Sensor]:
    """Choose the sensors to read, by what they measure, and the one with the clock.

    Notes say which others are not read.
    """
    headers = ", ".join(header for table in tables for header in table.headers)
    _rename(tables, columns)
    sensors = [x for table in tables for x in _sensors(table, columns)]
    # Calibrated sensors come first, and the first of a kind is taken.
    sensors.sort(key=lambda x: "uncal" in x[1].label.lower())
    chosen = dict(reversed(sensors))  # the first of a kind
    if "specific_forces" in chosen:
        # Parts of the force, with and without gravity, are not needed then.
        chosen = {kind: sensor for kind, sensor in chosen.items() if kind in _MEASURED}
    main = next((chosen[kind] for kind in _MEASURED if kind in chosen), None)
    if main is None:
        raise ValueError(
            "Argument `path` must hold three columns of a sensor, but none is "
            f"recognised: name them by `columns`. There are {headers or 'no tables'}."
        )
    apart = columns.keys() - _UNITS.keys() - set(main.table.headers)
    message = f"must name columns of one file, but {apart} is apart."
    demand(not apart, f"Argument `columns` {message}")
    for sensor in chosen.values():
        notes += _read_once(sensor)
    for kind, sensor in sensors:
        read = chosen.get(kind, sensor)
        if read.table is not sensor.table:
            what = kind.replace("_", " ")
            notes.append(
                f"{what} of {sensor.table.name!r} left out: those of "
                f"{read.table.name!r} are read"
            )
    return chosen, main


def _read_once(sensor: _Sensor) -> list[str]:
    """Notes on columns of a sensor whose header is that of others, too."""
    headers = sensor.table.headers
    names = [headers[j] for j in sensor.columns]
    return [
        f"{headers.count(name)} columns are called {name!r}: the first is read"
        for name in names
        if headers.count(name) > 1
    ]


def _in_si(
    chosen: dict[str, _Sensor],
    raw: dict[str, np.ndarray],
    times: np.ndarray,
    units: _Units,
) -> dict[str, np.ndarray]:
    """Measured values in SI, without those whose unit nobody states."""
    measured: dict[str, np.ndarray] = {}
    # The rates come last, because gravity may tell their unit.
    for kind in reversed(_MEASURED):
        if kind not in chosen:
            continue
        sensor = chosen[kind]
        turned = ""
        if kind == "rates" and "specific_forces" in measured:
            scale = sensor.table.scales.get(sensor.columns[1], 1.0)
            turned = _turned(times, scale * raw[kind], measured["specific_forces"])
        factor = units.factor(kind, sensor, raw[kind], turned)
        if factor is not None:
            measured[kind] = factor * raw[kind]
    return measured


def _others(main: _Sensor, rows: np.ndarray, used: set[int]) -> dict[str, np.ndarray]:
    """Columns of the main table that are no sensor's and hold numbers, by header."""
    table = main.table
    values = table.values[main.rows[rows]].T
    others = {}
    for j, (header, column) in enumerate(zip(table.headers, values, strict=True)):
        if header and j not in used and np.isfinite(column).any():
            others[header] = table.scales.get(j, 1.0) * column
    return others


def _asked(unit: Unit | Mapping[str, Unit] | None) -> dict[str, Unit]:
    """Units that the caller states, by what is measured; checked."""
    given = dict(unit) if isinstance(unit, Mapping) else {"rates": unit}
    asked: dict[str, Unit] = {}
    for kind, said in given.items():
        check_option("unit", kind, tuple(_UNITS))
        if isinstance(said, str):
            asked[kind] = _plain(said)
            check_option("unit", asked[kind], tuple(_UNITS[kind]))
        elif said is not None:
            real = isinstance(said, numbers.Real) and not isinstance(said, bool)
            needed = "Argument `unit` must be a unit or a positive factor to SI"
            demand(real and 0 < said < np.inf, f"{needed}, but it is {said!r}.")
            asked[kind] = said
    return asked


def _rename(tables: list[Table], columns: Columns) -> None:
    """Give columns the caller's names; those of no known sensor are in SI."""
    factors: dict[str | None, float] = {}
    # Units of the same name, such as g, are those of the first quantity.
    for known in reversed(_UNITS.values()):
        factors |= known
    headers = ", ".join(header for table in tables for header in table.headers)
    for new, old in columns.items():
        olds = [old] if isinstance(old, str) else old
        is_sensor = new in _MEASURED
        demand(
            len(olds) == 3 or not is_sensor,
            f"Argument `columns` must name three columns for `{new}`, but it names "
            f"{old!r}.",
        )
        for i, one in enumerate(olds):
            name = f"{new}[{i}]" if is_sensor else new
            places = _places(tables, one)
            demand(
                len(places) > 0,
                f"Argument `columns` must name columns of the file, but {one!r} is "
                f"none of {headers}",
            )
            for table, j in places:
                _, unit = _split(table.headers[j])
                if new in _UNITS:
                    table.headers[j] = f"{name} ({unit})" if unit else name
                else:
                    table.headers[j] = name
                    table.values[:, j] *= factors.get(unit, 1.0)


def _places(tables: list[Table], name: str) -> list[tuple[Table, int]]:
    """Columns whose header is a name, else those whose header without a unit is it."""
    columns = [(t, j) for t in tables for j in range(len(t.headers))]
    exact = [(t, j) for t, j in columns if t.headers[j] == name]
    return exact or [(t, j) for t, j in columns if _split(t.headers[j])[0] == name]


def _sensors(table: Table, columns: Columns) -> list[tuple[str, _Sensor]]:
    """Find sensors: three columns whose names differ by the axis, and their times."""
    names = [_split(x)[0] for x in table.headers]
    times: list[int] = []
    triples: dict[str, dict[str, int]] = {}
    for j in np.flatnonzero(np.isfinite(table.values).any(axis=0)).tolist():
        match = _AXIS.match(names[j])
        if match:
            triples.setdefault(match[1], {}).setdefault(match[2].lower(), j)
        elif _kind(names[j]) == "times":
            times.append(j)
    # Another file may have the column that the caller names.
    if "times" in columns and "times" in names:
        times = [names.index("times")]
    sensors: list[tuple[str, _Sensor]] = []
    for stem, axes in triples.items():
        kind = _kind(stem or table.name)
        is_other = kind in columns and kind != stem  # the caller names another one
        if len(axes) < 3 or kind is None or kind == "times" or is_other:
            continue
        demand(
            len(times) > 0,
            "Argument `columns` must name the column of the times, but it does not, "
            f"and none of {', '.join(table.headers)} is recognised.",
        )
        three = [axes[axis] for axis in sorted(axes)]
        is_letter = len(stem) == 1  # as in gx, gy, gz
        label = ", ".join(names[j] for j in three) if is_letter else stem or table.name
        # Each sensor may have times of its own, to the left of it.
        time = max((j for j in times if j < three[0]), default=times[0])
        sensor = _sensor(label, table, time, three)
        if sensor.rows.size:
            sensors.append((kind, sensor))
    return sensors


def _sensor(label: str, table: Table, time: int, three: list[int]) -> _Sensor:
    """A sensor in the rows where all axes are numbers."""
    is_known = np.isfinite(table.values)
    is_whole = is_known[:, three].all(axis=1)
    rows = np.flatnonzero(is_whole)
    # Below the last row the columns are padded, unless there are times.
    is_row = is_known[:, time] | (np.arange(is_whole.size) < rows.max(initial=-1))
    missed = int(np.sum(~is_whole & is_row))
    return _Sensor(label, table, [time, *three], rows, missed)


def _on_one_clock(
    chosen: dict[str, _Sensor], main: _Sensor, clock: str | None, units: _Units
) -> tuple[Clock, dict[str, np.ndarray]]:
    """Repair the clock of the main sensor and read every sensor at its times."""
    raw = {k: x.table.values[x.rows][:, x.columns] for k, x in chosen.items()}
    times = _times(chosen, raw, units)
    clocks = {k: repair(times[k], raw[k][:, 1:], clock=clock) for k in chosen}
    own = clocks[next(kind for kind, x in chosen.items() if x is main)]
    are_several = any(x.table is not main.table for x in chosen.values())
    for kind, sensor in chosen.items():
        notes = [*sensor.table.notes, *clocks[kind].notes]
        if sensor.missed:
            count = f"{sensor.missed} row{'s' if sensor.missed > 1 else ''}"
            notes.insert(0, f"{count} without numbers of all three axes dropped")
        raw[kind] = raw[kind][clocks[kind].rows, 1:]
        if not np.array_equal(own.times, clocks[kind].times):
            notes.append("times of its own; brought to those of the rest linearly")
            raw[kind] = _onto(own.times, clocks[kind], raw[kind])
        prefix = f"{sensor.label}: " if are_several else ""
        units.notes.extend(prefix + x for x in notes)
    if "linear" in chosen:
        _add_gravity(chosen, raw, units)
    return own, raw


def _times(
    chosen: dict[str, _Sensor], raw: dict[str, np.ndarray], units: _Units
) -> dict[str, np.ndarray]:
    """Times of each sensor [s], from 0 if they count from some epoch."""
    times = {}
    for kind, sensor in chosen.items():
        t = raw[kind][:, 0]
        times[kind] = t * units.factor("times", sensor, t)
    origin = min(np.nanmin(t, initial=np.inf) for t in times.values())
    if _EPOCH < origin < np.inf:
        units.notes.append(f"times count from {origin:.6f} s of the file's clock")
        times = {kind: t - origin for kind, t in times.items()}
    return times


def _add_gravity(
    chosen: dict[str, _Sensor], raw: dict[str, np.ndarray], units: _Units
) -> None:
    """Add gravity to an acceleration without it: the specific force, in place."""
    linear = chosen["linear"]
    gravity = chosen.get("gravity")
    if gravity is None:
        text = "without gravity, no specific force; left out"
        units.notes.append(f"{linear.label}: {text}")
        return
    raw["specific_forces"] = raw["linear"] + raw["gravity"]
    chosen["specific_forces"] = _Sensor(
        f"{linear.label} with gravity",
        linear.table,
        linear.columns + gravity.columns,
        linear.rows,
    )


def _onto(times: np.ndarray, other: Clock, values: np.ndarray) -> np.ndarray:
    """Values at other times; NaN before, after and in breaks."""
    after = np.searchsorted(other.times, times, side="left")
    silent = (times < other.times[0]) | (times > other.times[-1])
    # A time is in a break where the next row of the other clock begins a piece.
    silent |= np.isin(after, other.breaks) & ~np.isin(times, other.times)
    columns = [np.interp(times, other.times, column) for column in values.T]
    return np.where(silent[:, None], np.nan, np.stack(columns, axis=1))


def _recognised(kind: str, values: np.ndarray, turned: str) -> tuple[str | None, str]:
    """The unit in which alone numbers make sense, and why."""
    if kind == "rates":
        return _recognised_rates(values, turned)
    # Rows may have the newest first.
    is_time = kind == "times"
    size = np.abs(np.diff(values)) if is_time else np.linalg.norm(values, axis=1)
    size = float(np.median(size[size > 0])) if (size > 0).any() else 0.0
    usual = _USUAL.get(kind, {}).items()
    unit = next((unit for unit, (least, most) in usual if least <= size < most), None)
    if unit is None and is_time:
        raise ValueError(
            "Argument `unit` must say the unit of the times, but it does not, and "
            f"steps of {size:g} are neither s, ms, us nor ns at 8 Hz to 8 kHz. "
            f"(`unit={{'times': ...}}`, one of {', '.join(_UNITS[kind])}.)"
        )
    return unit, f"their median {'step ' * is_time}is {size:.4g}"


def _recognised_rates(values: np.ndarray, turned: str) -> tuple[str, str]:
    """The unit of rates by the range of gyros or by how gravity turns, and why."""
    most = float(np.abs(values).max())
    if _RANGE[0] < most < _RANGE[1]:
        return "deg/s", f"no gyro reads {most:.0f} rad/s"
    if most >= _RANGE[1] or not turned:
        raise ValueError(_question(most, f"numbers up to {most:.6g} do not tell"))
    return turned, "so gravity turns in the body"


def _turned(times: np.ndarray, rates: np.ndarray, forces: np.ndarray) -> str:
    """The unit in which gravity obeys df/dt = -omega x f; empty if unclear."""
    # A single row does not turn.
    if times.size < 2:
        return ""
    lag = max(1, round(_TURN / float(np.median(np.diff(times)))))
    steps = np.nan_to_num(np.cross(forces, rates) * np.gradient(times)[:, None])
    sums = np.cumsum(steps, axis=0) - steps / 2
    by_rates = sums[lag:] - sums[:-lag]
    seen = forces[lag:] - forces[:-lag]
    # Only where the accelerometer shows gravity and nothing else.
    size = np.linalg.norm(forces, axis=1)[lag:]
    least, most = _USUAL["specific_forces"]["m/s^2"]
    use = np.isfinite(seen).all(axis=1) & (size > least) & (size < most)
    by_rates = by_rates[use]
    seen = seen[use]
    product = np.sum(by_rates * seen)
    square = np.sum(by_rates**2)
    if product <= _LIKE * np.sqrt(square * np.sum(seen**2)):
        return ""
    # Least squares for seen = ratio by_rates: the unit of the rates in rad/s.
    ratio = product / square

    def misfit(unit: str) -> float:
        return abs(np.log(ratio / _UNITS["rates"][unit]))

    return min(("rad/s", "deg/s"), key=misfit)


def _kind(name: str) -> str | None:
    """Quantity that the words of a name state: a key of `_KINDS`, or None."""
    words = name.strip().lower()
    fits = (kind for kind, pattern in _KINDS.items() if re.search(pattern, words))
    return next(fits, None)


def _split(header: str) -> tuple[str, str | None]:
    """Split the unit off a header such as `gyro x (deg/s)`, `t [ms]`, `gyro_x_dps`."""
    match = _UNIT.search(header) or _SUFFIX.search(header)
    # A header that is all unit is a name.
    if not match or not match.start():
        return header, "s" if header == "seconds_elapsed" else None
    return header[: match.start()], _plain(match[1])


def _plain(unit: str) -> str:
    """A unit as in `_UNITS`; two signs for micro, and one lost in decoding, are u."""
    unit = re.sub("[\u00b5\u03bc\ufffd]", "u", unit.lower())
    # "m/sec" and "m/second" are m/s.
    unit = re.sub(r"\s|(?<=s)ec(onds?|s)?", "", unit)
    return unit.replace("²", "^2").replace("**", "^")
