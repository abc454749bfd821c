"""Tables become a reading: which columns are of which sensor, in which unit, on whose clock."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jrigid._checks import check_option, demand
from jrigid.records._clock import Clock, repair
from jrigid.records._files import Source, Table, tables_of
from jrigid.records._reading import Reading

_DEGREE = np.pi / 180
# By what is measured, in SI, spelled as `_plain` returns them.
_UNITS: dict[str, dict[str, float]] = {
    "times": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "rates": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": _DEGREE, "mdeg/s": 1e-3 * _DEGREE}
    | {"rpm": 6 * _DEGREE, "rev/s": 360 * _DEGREE},
    "specific_forces": {"m/s^2": 1.0, "g": 9.80665, "mg": 9.80665e-3},
    "magnetic_fields": {"t": 1.0, "mt": 1e-3, "ut": 1e-6, "nt": 1e-9, "g": 1e-4, "gauss": 1e-4},
}
# Other spellings of them: two signs for micro, and one lost in decoding, are u.
_SPELLED = {
    r"[\u00b5\u03bc\ufffd]": "u",
    r"\s|(?<=s)ec(s|onds?)?": "",
    r"°|degrees?": "deg",
    r"radians?": "rad",
    r"(rad|deg)_?s$": r"\1/s",
    r"dps$": "deg/s",
    r"m/s/s|mps2|m/?s(\^|\*\*)?(-?2|²)": "m/s^2",
}
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
_SUFFIX = re.compile(r"_(rad_s|deg_s|rads|degs|dps|rpm|mps2|ms|us|ns|s)$", re.IGNORECASE)
_EPOCH = 1e6  # [s] later times count from some epoch and are made to count from 0
_RANGE = 70.0, 4100.0  # [rad/s] no common gyro measures beyond; larger numbers are not deg/s either
# Medians of what each row says: steps of 8 Hz to 8 kHz, and sizes at hand.
_USUAL = {
    "times": {
        "s": (0.000125, 0.125),
        "ms": (0.125, 125.0),
        "us": (125.0, 125e3),
        "ns": (125e3, 125e6),
    },
    "specific_forces": {"g": (0.8, 1.25), "m/s^2": (7.8, 12.3)},
}
_TURN = 0.1  # [s] over which the turning of gravity is compared with the rates
_LIKE = 0.4  # correlation of the two from which their ratio is believed
Stated = tuple[str | None, str, float]  # a unit, who says so, the factor of the numbers to it


Columns = Mapping[str, str | Sequence[str]]


class _Sensor(NamedTuple):
    """Columns of a table: the times and the axes, of the rows where all of these are numbers."""

    kind: str
    label: str
    table: Table
    columns: list[int]
    rows: np.ndarray
    stated: Stated

    @property
    def values(self) -> np.ndarray:
        """Times and axes as they are in the table."""
        return self.table.values[np.ix_(self.rows, self.columns)]


def read(
    path: Source,
    *,
    unit: str | Mapping[str, str] | None = None,
    columns: Columns | None = None,
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
    given = {"rates": unit} if isinstance(unit, str) else dict(unit or {})
    asked = {kind: _plain(said) for kind, said in given.items()}
    for kind, said in asked.items():
        check_option("unit", kind, tuple(_UNITS))
        check_option("unit", said, tuple(_UNITS[kind]))
    tables, columns = tables_of(path, log), dict(columns or {})
    chosen = _choose(tables, columns)
    main = next((chosen[kind] for kind in _MEASURED if kind in chosen), None)
    if main is None:
        headers = ", ".join(h for table in tables for h in table.headers)
        raise ValueError(
            "Argument `path` must hold three columns of a sensor, but none is recognised: name "
            f"them by `columns`. There are {headers or 'no tables'}."
        )
    used = {s.table.name: s.table for s in chosen.values()}
    notes = [f"{x.name}: {n}" if len(used) > 1 else n for x in used.values() for n in x.notes]
    times = {}
    for kind, sensor in chosen.items():
        t, header = sensor.values[:, 0], sensor.table.headers[sensor.columns[0]]
        stated = _split(header)[1], "the header says so", 1.0
        times[kind] = t * _factor(asked, notes, "times", header, stated, t)
    origin = min(np.nanmin(t, initial=np.inf) for t in times.values())
    if _EPOCH < origin < np.inf:
        notes.append(f"times count from {origin:.6f} s of the file's clock")
        times = {kind: t - origin for kind, t in times.items()}
    clocks = {k: repair(times[k], s.values[:, 1:], clock=clock) for k, s in chosen.items()}
    own, raw = clocks[main.kind], {}
    for kind, sensor in chosen.items():
        said, rows = clocks[kind].notes, clocks[kind].rows
        notes += [f"{sensor.label}: {x}" for x in said] if len(used) > 1 else said
        raw[kind] = sensor.values[rows, 1:]
        if not np.array_equal(own.times, clocks[kind].times):
            notes.append(f"{sensor.label}: times of its own; brought to those of the rest linearly")
            raw[kind] = _onto(own.times, clocks[kind], raw[kind])
    found = _in_si(chosen, raw, own.times, asked, notes)
    used = [s for k, s in chosen.items() if (k if k in _MEASURED else "specific_forces") in found]
    others = _others(main, own.rows, used, columns)
    said = tuple(dict.fromkeys(notes))
    return Reading(own.times, **found, columns=others, breaks=own.breaks, notes=said)


def _choose(tables: list[Table], columns: Columns) -> dict[str, _Sensor]:
    """The first sensor of each kind; named ones, and those that are calibrated, before others."""
    names = [[_split(header)[0] for header in table.headers] for table in tables]
    for new, old in columns.items():
        olds = (old,) if isinstance(old, str) else old
        demand(
            len(olds) == 3 or new not in _MEASURED,
            f"Argument `columns` must name three columns for `{new}`, but it names {old!r}.",
        )
        for axis, one in zip(("[0]", "[1]", "[2]"), olds, strict=False):
            for i, j in _find(tables, one):
                names[i][j] = f"{new}{axis}" if new in _MEASURED else new
    sensors = [s for x, own in zip(tables, names, strict=True) for s in _sensors(x, own, columns)]
    chosen: dict[str, _Sensor] = {}
    for sensor in sorted(sensors, key=lambda s: "uncal" in s.label.lower()):
        chosen.setdefault(sensor.kind, sensor)
    if "specific_forces" in chosen:
        chosen = {kind: s for kind, s in chosen.items() if kind in _MEASURED}
    return chosen


def _find(tables: list[Table], wanted: str) -> list[tuple[int, int]]:
    """Where columns are of this header, with or without its unit: numbers of table and column."""
    for which in (lambda header: header, lambda header: _split(header)[0]):
        every = ((i, j, x) for i, table in enumerate(tables) for j, x in enumerate(table.headers))
        hits = [(i, j) for i, j, header in every if which(header) == wanted]
        if hits:
            return hits
    headers = ", ".join(header for table in tables for header in table.headers)
    raise ValueError(
        f"Argument `columns` must name columns of the file, but {wanted!r} is none of {headers}."
    )


def _sensors(table: Table, names: list[str], columns: Columns) -> list[_Sensor]:
    """The sensors of a table: three columns whose names differ by the axis, and their times."""
    known = np.isfinite(table.values)
    times = [j for j, x in enumerate(names) if _kind(x) == "times" and known[:, j].any()]
    times = [names.index("times")] if "times" in names else times
    triples: dict[str, dict[str, int]] = {}
    for j, name in enumerate(names):
        match = _AXIS.match(name)
        if match and known[:, j].any():
            triples.setdefault(match[1], {}).setdefault(match[2].lower(), j)
    sensors = []
    for stem, axes in triples.items():
        kind = _kind(stem or table.name)
        if len(axes) < 3 or kind in (None, "times") or (kind in columns and kind != stem):
            continue
        three = [axes[axis] for axis in sorted(axes)]
        headers = [_split(table.headers[j])[0] for j in three]
        label = ", ".join(headers) if kind == stem or len(stem) == 1 else stem or table.name
        kind, *stated = _stated(kind, label, table)
        unit = _split(table.headers[three[0]])[1]
        if unit is not None:  # a unit in the header beats that of the format
            stated = unit, "the header says so", 1.0
        demand(
            len(times) > 0,
            "Argument `columns` must name the column of the times, but it does not, and none of "
            f"{', '.join(table.headers)} is recognised.",
        )
        time = max((j for j in times if j < three[0]), default=times[0])
        rows = np.flatnonzero(known[:, three].all(axis=1))
        if rows.size:
            sensors.append(_Sensor(kind, label, table, [time, *three], rows, tuple(stated)))
    return sensors


def _stated(kind: str, label: str, table: Table) -> tuple[str, str | None, str, float]:
    """What is measured, its unit, who says so, and the factor to it, as the format has it."""
    name, about = label.lower().partition("[")[0], table.about
    if "seconds_elapsed" in table.headers:
        units = {"rates": "rad/s", "magnetic_fields": "ut"}
        unit = "m/s^2" if "total" in name else units.get(kind)
        ios = about.get("platform") == "ios" and about.get("standardisation") != "true"
        sign = -1.0 if ios and kind not in units else 1.0
        if kind == "specific_forces" and not re.search("total|uncal", name):
            kind = "linear"
        return kind, unit, "so Sensor Logger writes it", sign
    if name in ("gyroadc", "gyrounfilt"):
        text = about.get("gyro_scale", about.get("gyro.scale", "1"))
        scale = int(text, 0) if text.isalnum() else float(text)
        if scale > 1 << 20:  # a float written as the integer of the same bits
            scale = float(np.uint32(scale).view(np.float32))
        return kind, "deg/s", "so Betaflight logs its gyro", scale
    if name == "accsmooth" and "acc_1G" in about:
        one = about["acc_1G"]
        return kind, "g", f"acc_1G is {one}", 1 / float(one)
    return kind, None, "", 1.0


def _onto(times: np.ndarray, other: Clock, values: np.ndarray) -> np.ndarray:
    """Values at other times; NaN before, after and in breaks."""
    after = np.searchsorted(other.times, times, side="left")
    silent = (times < other.times[0]) | (times > other.times[-1])
    silent |= np.isin(after, other.breaks) & ~np.isin(times, other.times)
    columns = [np.interp(times, other.times, column) for column in values.T]
    return np.where(silent[:, None], np.nan, np.stack(columns, axis=1))


def _in_si(
    chosen: dict[str, _Sensor],
    raw: dict[str, np.ndarray],
    times: np.ndarray,
    asked: dict[str, str],
    notes: list[str],
) -> dict[str, np.ndarray]:
    """What is measured in SI, by kind; without that whose unit nobody knows."""
    if "linear" in raw and "gravity" in raw:
        label = f"{chosen['linear'].label} with gravity"
        chosen["specific_forces"] = chosen["linear"]._replace(label=label)
        raw["specific_forces"] = raw["linear"] + raw["gravity"]
    elif "linear" in raw:
        label = chosen["linear"].label
        notes.append(f"{label}: without gravity, no specific force; left out")
    found: dict[str, np.ndarray] = {}
    for kind in reversed(_MEASURED):  # rates last: gravity may tell their unit
        if kind in raw:
            turned = None
            if kind == "rates" and "specific_forces" in found:
                turned = _turned(times, raw[kind], found["specific_forces"])
            _, label, *_, stated = chosen[kind]
            factor = _factor(asked, notes, kind, label, stated, raw[kind], turned)
            if factor is not None:
                found[kind] = factor * raw[kind]
    return found


def _factor(
    asked: dict[str, str],
    notes: list[str],
    kind: str,
    label: str,
    stated: Stated,
    values: np.ndarray,
    turned: str | None = None,
) -> float | None:
    """The factor to SI by who says the unit: the caller, the file or the numbers; None if nobody."""
    unit, source, factor = stated
    if kind in asked:
        heard = "" if unit in (None, asked[kind]) else f", though the file says {unit}"
        unit, source = asked[kind], f"`unit` says so{heard}"
    elif unit is None:
        unit, source = _recognised(kind, values, turned)
    what = f"{kind.replace('_', ' ')} ({label})"
    if unit is None:
        notes.append(f"{what} left out: their unit is not stated")
        return None
    demand(
        unit in _UNITS[kind],
        f"Argument `unit` must say the unit of `{kind}`, but it does not, and the file's {unit!r} "
        "is not known.",
    )
    notes.append(f"{what} taken as {unit}: {source}")
    if factor < 0:
        notes.append(f"{what} turned about: iOS gives them the other sign")
    factor *= _UNITS[kind][unit]
    if turned and not 0.2 < factor / _UNITS["rates"][turned] < 5:  # headers can be wrong
        notes.append(f"yet gravity turns in the body as if the rates were in {turned}")
    return factor


def _recognised(kind: str, values: np.ndarray, turned: str | None) -> tuple[str | None, str]:
    """The unit in which alone numbers make sense, and why."""
    if kind == "rates":
        most = float(np.abs(values).max())
        unit, why = turned, "so gravity turns in the body"
        if most > _RANGE[0]:
            unit, why = "deg/s" if most < _RANGE[1] else None, f"no gyro reads {most:.0f} rad/s"
        doubt = f"numbers up to {most:.6g} do not tell"
    else:
        size = np.diff(values) if kind == "times" else np.linalg.norm(values, axis=1)
        size = float(np.median(size[size > 0])) if (size > 0).any() else 0.0
        usual = _USUAL.get(kind, {}).items()
        unit = next((unit for unit, (least, most) in usual if least <= size < most), None)
        why = f"their median {'step ' * (kind == 'times')}is {size:.4g}"
        doubt = f"steps of {size:g} are neither s, ms, us nor ns at 8 Hz to 8 kHz"
    demand(
        unit is not None or kind not in ("times", "rates"),
        f"Argument `unit` must say the unit of the {kind}, but neither it nor the file does; {doubt}.",
    )
    return unit, why


def _turned(times: np.ndarray, rates: np.ndarray, forces: np.ndarray) -> str | None:
    """The unit in which gravity turns as the rates say, df/dt = -omega x f; None if unclear."""
    lag = max(1, round(_TURN / float(np.median(np.diff(times)))))
    steps = np.nan_to_num(np.cross(forces, rates) * np.gradient(times)[:, None])
    sums, size = np.cumsum(steps, axis=0), np.linalg.norm(forces, axis=1)[lag:]
    said, seen = sums[lag:] - sums[:-lag], forces[lag:] - forces[:-lag]
    least, most = _USUAL["specific_forces"]["m/s^2"]
    use = np.isfinite(seen).all(axis=1) & (size > least) & (size < most)
    said, seen = said[use], seen[use]
    product, square = np.sum(said * seen), np.sum(said**2)
    if product <= _LIKE * np.sqrt(square * np.sum(seen**2)):
        return None
    return min(("rad/s", "deg/s"), key=lambda u: abs(np.log(product / square / _UNITS["rates"][u])))


def _kind(name: str) -> str | None:
    """What the words of a name say that is measured: a key of `_KINDS`."""
    words = name.strip().lower()
    return next((kind for kind, pattern in _KINDS.items() if re.search(pattern, words)), None)


def _split(header: str) -> tuple[str, str | None]:
    """A header without its unit, and the unit: `gyro x (deg/s)`, `t [ms]`, `gyro_x_dps`."""
    match = _UNIT.search(header) or _SUFFIX.search(header)
    if not match or not match.start():
        return header, "s" if header == "seconds_elapsed" else None
    return header[: match.start()], _plain(match[1])


def _plain(unit: str) -> str:
    """A unit as in `_UNITS`."""
    unit = unit.strip().lower()
    for pattern, plain in _SPELLED.items():
        unit = re.sub(pattern, plain, unit)
    return unit


def _others(
    main: _Sensor, rows: np.ndarray, used: list[_Sensor], columns: Columns
) -> dict[str, np.ndarray]:
    """The other columns with numbers, and those asked for by a name, in SI by their header."""
    table, rows = main.table, main.rows[rows]
    taken = {main.columns[0]}.union(*(s.columns for s in used if s.table is table))
    others = {
        header: table.values[rows, j]
        for j, header in enumerate(table.headers)
        if header and j not in taken and np.isfinite(table.values[rows, j]).any()
    }
    for name, header in columns.items():
        if name not in _UNITS:
            [(_, j), *_] = _find([table], str(header))
            unit = _split(table.headers[j])[1]
            factor = next((known[unit] for known in _UNITS.values() if unit in known), 1.0)
            others.pop(table.headers[j], None)
            others[name] = factor * table.values[rows, j]
    return others
