"""Reader of ALCDEF files: light curves of asteroids as observers publish them."""

import dataclasses
import pathlib
from decimal import Decimal, InvalidOperation

import numpy as np
from jaxtyping import Float

from jrigid._checks import demand
from jrigid.photometry._astropy import TDB, TIME_SCALES, in_tdb
from jrigid.photometry._damit_files import ASTRONOMICAL_UNIT, LightCurve
from jrigid.photometry._sun_and_earth import (
    LEAST_DATE,
    Positions,
    Vectors,
    check_metres,
    light_time,
)

_DAY = 86400  # s
_DELIMITERS = {"PIPE": "|", "TAB": "\t"}
# How a correction was applied: not at all, one value a session, one value a point.
_CORRECTIONS = ("NONE", "AVERAGE", "POINT")
# Programs write 99.99 where they measured no magnitude.
_NO_MAGNITUDE = 90
# The time of observation from that of the light's departure: errors shrink by 1e4 each.
_LIGHT_TIME_STEPS = 3


@dataclasses.dataclass
class _Session:
    """One block of metadata and the data that follow it."""

    line: int
    has_ended_metadata: bool = False
    metadata: dict[str, tuple[int, str]] = dataclasses.field(default_factory=dict)
    dates: list[Decimal] = dataclasses.field(default_factory=list)
    magnitudes: list[float] = dataclasses.field(default_factory=list)
    # 0 where none is stated.
    errors: list[float] = dataclasses.field(default_factory=list)


class _Parser:
    """Collects the sessions of a file line by line."""

    def __init__(self, path: str | pathlib.Path):
        """Read all sessions of a file."""
        self.path = pathlib.Path(path)
        self.line = 0
        self.sessions: list[_Session] = []
        self.session: _Session | None = None
        # A byte of another encoding, in a name say, must not make the data unreadable.
        text = self.path.read_text(encoding="utf-8-sig", errors="replace")
        for self.line, line in enumerate(text.splitlines(), 1):
            if line.strip() and not line.strip().startswith("#"):
                self._read(line)
        if self.session is not None:
            raise self.error(
                f"the block of line {self.session.line} has no ENDDATA: add it, or get "
                "the whole file."
            )
        if not self.sessions:
            raise self.error("there is no STARTMETADATA: pass an ALCDEF file.")

    def error(self, text: str, line: int | None = None) -> ValueError:
        """An error that names the file and the line."""
        return ValueError(f"{self.path.name}, line {line or self.line}: {text}")

    def option(self, session: _Session, key: str, options: tuple[str, ...]) -> str:
        """The value of a keyword, by default the first one."""
        line, value = session.metadata.get(key, (session.line, options[0]))
        value = value.upper() or options[0]
        if value not in options:
            raise self.error(
                f"{key} must be one of {', '.join(options)}, but it is {value[:20]!r}.",
                line,
            )
        return value

    def _read(self, line: str) -> None:
        """Take one line."""
        key, equals, value = line.partition("=")
        key = key.strip().upper()
        if key == "STARTMETADATA":
            self._start()
        elif self.session is None:
            raise self.error(
                f"{key[:20]!r} is outside of a block: put STARTMETADATA before it."
            )
        elif key == "ENDMETADATA":
            self.session.has_ended_metadata = True
        elif key == "ENDDATA":
            self._end(self.session)
        elif key == "DATA":
            self._point(self.session, value)
        elif not equals:
            raise self.error(f"a line must be KEYWORD=value, but it is {line[:30]!r}.")
        else:
            self.session.metadata[key] = (self.line, value.strip())

    def _start(self) -> None:
        """Begin a session."""
        if self.session is not None:
            raise self.error(
                f"the block of line {self.session.line} has no ENDDATA: add it before."
            )
        self.session = _Session(self.line)

    def _end(self, session: _Session) -> None:
        """End a session."""
        if not session.dates:
            raise self.error(
                f"the block of line {session.line} has no DATA: remove the block."
            )
        self.sessions.append(session)
        self.session = None

    def _point(self, session: _Session, value: str) -> None:
        """Take one point: date, magnitude, and perhaps error and airmass."""
        if not session.has_ended_metadata:
            raise self.error("DATA is among the metadata: put ENDMETADATA before it.")
        words = value.split(self._delimiter(session))
        if len(words) < 2 or not words[1].strip():
            raise self.error(
                "the magnitude is missing: DATA must be date and magnitude with the "
                "DELIMITER between. Remove the line or correct DELIMITER."
            )
        date = self._number("the Julian date", words[0])
        if date < LEAST_DATE:
            raise self.error(
                f"the date {date} is no Julian date of this age: of a modified or "
                "truncated one, add what was taken off (2400000.5 days for MJD)."
            )
        magnitude = self._number("the magnitude", words[1])
        if abs(magnitude) > _NO_MAGNITUDE:
            raise self.error(
                f"the magnitude {magnitude} stands for a missing one: remove the line."
            )
        if session.dates and date < session.dates[-1]:
            raise self.error(
                f"the date {date} is before that of the point before: sort the points."
            )
        session.dates.append(date)
        session.magnitudes.append(float(magnitude))
        has_error = len(words) > 2 and bool(words[2].strip())
        error = self._number("the error", words[2]) if has_error else Decimal(0)
        session.errors.append(float(error))

    def _delimiter(self, session: _Session) -> str:
        """Text between the values of a point."""
        if "DELIMITER" not in session.metadata:
            raise self.error(
                "the metadata have no DELIMITER: add DELIMITER=PIPE or DELIMITER=TAB.",
                session.line,
            )
        return _DELIMITERS[self.option(session, "DELIMITER", tuple(_DELIMITERS))]

    def _number(self, what: str, word: str) -> Decimal:
        """A finite number. Dates have more digits than a float holds."""
        try:
            number = Decimal(word.strip())
        except InvalidOperation:
            number = Decimal("nan")
        if not number.is_finite():
            raise self.error(
                f"{what} must be a number, but it is {word.strip()[:20]!r}: correct or "
                "remove the line."
            )
        return number


def read_alcdef(
    path: str | pathlib.Path,
    positions: Positions,
    *,
    epoch: float | None = None,
    time_scale: str = TDB,
) -> list[LightCurve]:
    r"""Read a file in the Asteroid Lightcurve Data Exchange Format.

    Such a file holds magnitudes, but no vectors to the Sun and to the observer: these
    come from `positions`. Each session (a block of metadata and its data) becomes a
    relative light curve, 10^(-0.4 m) with a mean of 1.

    The times become those at which the light left the body, unless LTCAPP says that
    they are already. The brightness becomes that at 1 au from the Sun and from the
    observer, unless REDUCEDMAGS is POINT. The average that REDUCEDMAGS=AVERAGE took
    off is a constant, which a relative curve ignores. The light is not corrected for
    the phase angle.

    Args:
        path: The file.
        positions: A function of the Julian dates of observation. It returns vectors
            from the body, where the light left it, to the Sun and to the observer
            [m, ecliptic]: `geometry_of_orbit`, `geometry_of_table` or
            `geometry_of_coordinates` makes one.
        epoch: Julian date of time 0; the first one in the file if None.
        time_scale: That of the dates of the file: "tdb", "tt", "tai" or "utc". Dates of
            another scale than "tdb" become those of TDB, for which astropy must be
            installed. Observers state UTC as a rule, which is 69 s behind since 2017.
            If it is taken as TDB, a curve is shifted by that, and each leap second is
            missing between the times before it and those after it.

    Returns:
        A light curve for each session, all with the same epoch. Their `band` is
        MAGBAND, or else FILTER. Their `errors` are those of the points, if each point
        has one.

    Raises:
        ValueError: A line that does not hold what it should, with the file and the
            line; several objects; positions that are not vectors; or another
            `time_scale`.
        ImportError: Another scale than "tdb" without the extra `jrigid[photometry]`.

    Source: ALCDEF, Definition and standards, v. 2.2.7 (alcdef.org).

    >>> import pathlib, tempfile, jrigid as jr
    >>> text = "STARTMETADATA\nMAGBAND=V\nDELIMITER=PIPE\nENDMETADATA\n"
    >>> text += "DATA=2451545.0|15.1\nDATA=2451545.1|15.2\nENDDATA\n"
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "curve.txt"
    >>> _ = path.write_text(text)
    >>> orbit = jr.photometry.Orbit(3e11, 0.1, 0.0, 0.0, 0.0, 0.0, 2451545.0)
    >>> positions = jr.photometry.geometry_of_orbit(orbit)
    >>> curve = jr.photometry.read_alcdef(path, positions)[0]
    >>> print(curve.band, curve.brightness.round(3))
    V [1.046 0.954]
    """
    demand(
        time_scale in TIME_SCALES,
        f"Argument `time_scale` must be one of {', '.join(TIME_SCALES)}, but it is "
        f"{time_scale!r}.",
    )
    parser = _Parser(path)
    _check_one_object(parser)
    if time_scale != TDB:
        for session in parser.sessions:
            session.dates = in_tdb(session.dates, time_scale)
    zero = parser.sessions[0].dates[0]
    if epoch is not None:
        # `repr` gives the digits that were typed, not those of the binary fraction.
        zero = Decimal(repr(float(epoch)))
        demand(
            zero.is_finite() and zero >= LEAST_DATE,
            "Argument `epoch` must be a Julian date of this age, but it is "
            f"{epoch}: of a modified one, add 2400000.5 days.",
        )
    return [_curve(parser, session, positions, zero) for session in parser.sessions]


def _check_one_object(parser: _Parser) -> None:
    """Raise ValueError for sessions of several objects.

    Objects without a number have 0, and are identified by their designations. A
    numbered object may have several of these.
    """
    first: dict[str, str] = {}
    for session in parser.sessions:
        key = "OBJECTNUMBER"
        line, number = session.metadata.get(key, (session.line, ""))
        own = number.lstrip("0")
        if not own:
            key = "MPCDESIG"
            line, designation = session.metadata.get(key, (session.line, ""))
            own = designation.replace(" ", "").replace("_", "").upper()
        if not own:
            continue
        before = first.setdefault(key, own)
        if own != before:
            raise parser.error(
                f"the object is {own[:20]}, but that of sessions before is "
                f"{before[:20]}: split the file, since `positions` is of one object.",
                line,
            )


def _curve(
    parser: _Parser, session: _Session, positions: Positions, zero: Decimal
) -> LightCurve:
    """A session as a relative light curve."""
    # AVERAGE takes one light time off a whole session, which serves as well: in a night
    # that of an asteroid changes by a few seconds.
    is_corrected = parser.option(session, "LTCAPP", _CORRECTIONS) != "NONE"
    reduced = parser.option(session, "REDUCEDMAGS", _CORRECTIONS)
    dates = np.array(session.dates, dtype=float)
    # The difference of decimals is exact, while floats do not hold all digits of a
    # date.
    ts = np.array([float((date - zero) * _DAY) for date in session.dates])
    if is_corrected:
        to_sun, to_observer = _seen_later(positions, dates)
    else:
        to_sun, to_observer = _vectors(positions, dates)
        ts = ts - light_time(to_observer)
    magnitudes = np.array(session.magnitudes)
    if reduced != "POINT":
        magnitudes = magnitudes - _distance_modulus(to_sun, to_observer)
    # From the brightest point, so that no power overflows.
    brightness = 10 ** (-0.4 * (magnitudes - magnitudes.min()))
    errors = np.array(session.errors)
    _, filter_ = session.metadata.get("FILTER", (0, ""))
    _, band = session.metadata.get("MAGBAND", (0, filter_))
    return LightCurve(
        epoch=float(zero),
        ts=ts,
        brightness=brightness / brightness.mean(),
        to_sun=to_sun,
        to_observer=to_observer,
        is_relative=True,
        band=band or filter_,
        errors=errors if np.all(errors > 0) else None,
    )


def _vectors(
    positions: Positions, dates: Float[np.ndarray, " epochs"]
) -> tuple[Vectors, Vectors]:
    """Vectors that the caller's function returns, checked."""
    vectors = [np.asarray(each, dtype=float) for each in positions(dates)]
    shape = (len(dates), 3)
    if [each.shape for each in vectors] != [shape, shape]:
        raise ValueError(
            f"Argument `positions` must return two arrays of shape {shape}, but it "
            f"returned {[each.shape for each in vectors]}."
        )
    lengths = np.linalg.norm(vectors, axis=-1)
    if not np.all(np.isfinite(lengths) & (lengths > 0)):
        raise ValueError(
            "Argument `positions` must return finite vectors other than 0, but some "
            "are not: check the dates that it covers."
        )
    to_sun, to_observer = vectors
    check_metres("positions", to_sun)
    return to_sun, to_observer


def _seen_later(
    positions: Positions, dates: Float[np.ndarray, " epochs"]
) -> tuple[Vectors, Vectors]:
    """Vectors for dates at which the light left the body."""
    to_sun, to_observer = _vectors(positions, dates)
    # `positions` takes dates of observation. These are later by the light time, which
    # depends on them in turn.
    for _ in range(_LIGHT_TIME_STEPS):
        light_days = light_time(to_observer) / _DAY
        to_sun, to_observer = _vectors(positions, dates + light_days)
    return to_sun, to_observer


def _distance_modulus(
    to_sun: Vectors, to_observer: Vectors
) -> Float[np.ndarray, " epochs"]:
    """Magnitudes between a body and the same one at 1 au from Sun and observer."""
    r = np.linalg.norm(to_sun, axis=-1) / ASTRONOMICAL_UNIT
    delta = np.linalg.norm(to_observer, axis=-1) / ASTRONOMICAL_UNIT
    return 5 * np.log10(r * delta)
