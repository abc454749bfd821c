"""Units of what sensors measure: stated in headers, by a format, by the caller, or recognised."""

import re

import numpy as np

from jrigid._checks import check_option

# By what is measured, in SI, spelled as `plain_unit` returns them.
UNITS: dict[str, dict[str, float]] = {
    "times": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "rates": dict.fromkeys(("rad/s", "rads", "rad_s"), 1.0)
    | dict.fromkeys(("deg/s", "°/s", "dps", "deg_s", "degs", "degrees/s"), np.pi / 180)
    | {"mrad/s": 1e-3, "mdps": np.pi / 180e3, "rpm": np.pi / 30, "rev/s": 2 * np.pi},
    "specific_forces": dict.fromkeys(("m/s^2", "m/s2", "m/s/s", "mps2", "ms^-2", "ms-2"), 1.0)
    | {"g": 9.80665, "mg": 9.80665e-3},
    "magnetic_fields": {"t": 1.0, "mt": 1e-3, "ut": 1e-6, "nt": 1e-9, "g": 1e-4, "gauss": 1e-4},
}
_UNIT = re.compile(r"\s*[(\[]\s*([^()\[\]\d][^()\[\]]*)\s*[)\]]\s*$")
_SUFFIX = re.compile(r"_(rad_s|deg_s|rads|degs|dps|rpm|mps2|ms|us|ns|s)$", re.IGNORECASE)
_GYRO_RANGE = 70.0  # [rad/s] no common gyro measures beyond 4000 deg/s
_COUNTS = 4100.0  # beyond, numbers are neither rad/s nor deg/s but counts of a converter
_GRAVITY = {"g": (0.8, 1.25), "m/s^2": (7.8, 12.3)}  # the median of |specific force| at hand
_TICKS = {"s": 1.25e-4, "ms": 0.125, "us": 125.0, "ns": 1.25e5}  # least step of 8 Hz to 8 kHz
_TURN = 0.1  # [s] over which the turning of gravity is compared with the rates
_LIKE = 0.4  # correlation of the two from which their ratio is believed


def split_unit(header: str) -> tuple[str, str | None]:
    """A header without its unit, and the unit: `gyro x (deg/s)`, `t [ms]`, `gyro_x_dps`."""
    match = _UNIT.search(header) or _SUFFIX.search(header)
    if not match or not match.start():
        return header, None
    return header[: match.start()], plain_unit(match[1])


def plain_unit(unit: str) -> str:
    """A unit in the spelling of `UNITS`; two signs for micro, and one lost in decoding, are u."""
    unit = re.sub("[\u00b5\u03bc\ufffd]", "u", unit.strip()).lower().replace(" ", "")
    return unit.replace("²", "^2").replace("**", "^").replace("sec", "s")


class Units:
    """Brings what is measured to SI, and notes who says in which unit it is.

    Each method takes the unit that the file states, if it does, and in which words; or a factor.
    """

    def __init__(self, asked: dict[str, str], notes: list[str]) -> None:
        """Of what the caller asked for, by what is measured."""
        for kind, unit in asked.items():
            check_option("unit", kind, tuple(UNITS))
            check_option("unit", plain_unit(unit), tuple(UNITS[kind]))
        self.asked = {kind: plain_unit(unit) for kind, unit in asked.items()}
        self.notes = notes

    def stated(
        self, kind: str, label: str, unit: str | None, source: str, factor: float | None = None
    ) -> float | None:
        """The factor that the caller or the file states."""
        if kind in self.asked:
            if unit not in (None, self.asked[kind]):
                source = f"`unit` says so, though the file says {unit}"
            else:
                source = "`unit` says so"
            unit, factor = self.asked[kind], None
        if unit is None:
            return None
        return self._taken(kind, label, unit, source, factor)

    def _taken(
        self, kind: str, label: str, unit: str, source: str, factor: float | None = None
    ) -> float:
        if factor is None and unit not in UNITS[kind]:
            raise ValueError(
                f"Argument `unit` must say the unit of `{kind}`, but it does not, and the file's "
                f"{unit!r} is not known."
            )
        self.notes.append(f"{kind.replace('_', ' ')} ({label}) taken as {unit}: {source}")
        return UNITS[kind][unit] if factor is None else factor

    def of_times(self, label: str, times: np.ndarray) -> float:
        """The factor of times that nobody states, by their median step."""
        steps = np.diff(times[np.isfinite(times)])
        step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        for unit, least in _TICKS.items():
            if least <= step < 1000 * least:
                return self._taken("times", label, unit, f"their median step is {step:g}")
        raise ValueError(
            "Argument `unit` must say the unit of `times`, but it does not, and steps of "
            f"{step:g} are neither seconds nor milli-, micro- or nanoseconds of 8 Hz to 8 kHz."
        )

    def of_forces(self, label: str, forces: np.ndarray) -> float | None:
        """The factor of specific forces that nobody states, by gravity; None where it is unlike."""
        sizes = np.linalg.norm(forces, axis=1)
        size = float(np.median(sizes[np.isfinite(sizes)])) if np.isfinite(sizes).any() else np.nan
        for unit, (least, most) in _GRAVITY.items():
            if least < size < most:
                return self._taken("specific_forces", label, unit, f"their median is {size:.3g}")
        return None

    def of_rates(
        self, label: str, times: np.ndarray, rates: np.ndarray, forces: np.ndarray | None
    ) -> float:
        """The factor of rates that nobody states, by the range of gyros or by turning gravity."""
        most = float(np.abs(rates).max())
        unit, source = None, "so gravity turns in the body"
        if _GYRO_RANGE < most < _COUNTS:
            unit, source = "deg/s", f"no gyro reads {most:.0f} rad/s"
        elif most <= _GYRO_RANGE and forces is not None:
            unit = _by_turning_gravity(times, rates, forces)
        if unit is None:
            raise ValueError(
                "Argument `unit` must say the unit of the rates, but it does not, and neither does "
                f"the file; numbers up to {most:.6g} do not tell."
            )
        return self._taken("rates", label, unit, source)

    def doubt(
        self, times: np.ndarray, rates: np.ndarray, forces: np.ndarray, factor: float
    ) -> None:
        """A note where gravity turns in another unit than the stated one: headers can be wrong."""
        unit = _by_turning_gravity(times, rates, forces)
        if unit is not None and not 0.2 < factor / UNITS["rates"][unit] < 5:
            self.notes.append(f"yet gravity turns in the body as if the rates were in {unit}")


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
