"""Positions of a body and the Earth: Kepler orbits about the Sun, on the host."""

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Float

from jrigid._checks import demand
from jrigid._types import Readable, Real
from jrigid.photometry._damit_files import ASTRONOMICAL_UNIT

SPEED_OF_LIGHT = 299792458.0  # m / s
# Of the Sun [m^3 / s^2], JPL's ephemeris DE440.
_GRAVITATIONAL_PARAMETER = 1.32712440041e20
_RADIUS_OF_THE_SUN = 7e8  # m
# No known asteroid comes so near to the Sun [m], and no planet is so far from it [km].
_NEAREST = 5e9
LEAST_DATE = 2_378_497  # 1800: no photometry is older
_DAY = 86400.0  # s
_J2000 = 2451545.0
_CENTURY = 36525.0  # days
# Elements of the Earth-Moon barycentre at J2000 and their rates a century: semi-major
# axis [au], eccentricity, and inclination, mean longitude, longitude of perihelion
# [deg].
_EARTH = np.array(
    [
        [1.00000261, 0.00000562],
        [0.01671123, -0.00004392],
        [-0.00001531, -0.01294668],
        [100.46457166, 35999.37244981],
        [102.93768193, 0.32327364],
    ]
)
# Newton's method contracts by 2/3 at worst, and a start is within 2 of the root.
_NEWTON_STEPS = 100
# Each step divides the error by the speed of light over that of the body, about 1e4.
_LIGHT_TIME_STEPS = 3

Vectors: TypeAlias = Float[np.ndarray, "epochs 3"]
Positions: TypeAlias = Callable[[Float[np.ndarray, " epochs"]], tuple[Vectors, Vectors]]


class Orbit(Readable):
    """A Kepler orbit about the Sun, with elements in the ecliptic of J2000.

    Attributes:
        semi_major_axis: [m], positive.
        eccentricity: From 0 to below 1.
        inclination: To the ecliptic, from 0 to pi [rad].
        node: Longitude of the ascending node, from -2 pi to 2 pi [rad].
        argument_of_perihelion: From the node, from -2 pi to 2 pi [rad].
        mean_anomaly: At the epoch, from -2 pi to 2 pi [rad].
        epoch: Julian date of the mean anomaly (TDB).

    Raises:
        ValueError: An element that is not finite or out of its range.

    >>> import numpy as np, jrigid as jr
    >>> orbit = jr.photometry.Orbit(3e11, 0.1, 0.0, 0.0, 0.0, 0.0, 2451545.0)
    >>> print(orbit.position(np.array([2451545.0])) / 1e11)
    [[2.7 0.  0. ]]
    """

    semi_major_axis: float = eqx.field(converter=float)
    eccentricity: float = eqx.field(converter=float)
    inclination: float = eqx.field(converter=float)
    node: float = eqx.field(converter=float)
    argument_of_perihelion: float = eqx.field(converter=float)
    mean_anomaly: float = eqx.field(converter=float)
    epoch: float = eqx.field(converter=float)

    def __check_init__(self):
        """Reject elements that are no ellipse."""
        for name, value in vars(self).items():
            demand(
                bool(np.isfinite(value)),
                f"Argument `{name}` must be finite, but it is {value}.",
            )
        demand(
            self.semi_major_axis > 0,
            "Argument `semi_major_axis` must be positive, but it is "
            f"{self.semi_major_axis}.",
        )
        demand(
            self.semi_major_axis > _RADIUS_OF_THE_SUN,
            "Argument `semi_major_axis` must be in metres, outside of the Sun, but it "
            f"is {self.semi_major_axis}. (Catalogues have au: 1.496e11 m.)",
        )
        demand(
            self.epoch >= LEAST_DATE,
            f"Argument `epoch` must be a Julian date, but it is {self.epoch}. (Add "
            "2400000.5 to a modified one.)",
        )
        demand(
            0 <= self.inclination <= np.pi,
            "Argument `inclination` must be from 0 to pi, in radians, but it is "
            f"{self.inclination}. (Angles of catalogues are in degrees.)",
        )
        for name in ("node", "argument_of_perihelion", "mean_anomaly"):
            angle = getattr(self, name)
            demand(
                abs(angle) <= 2 * np.pi * (1 + 1e-9),
                f"Argument `{name}` must be from -2 pi to 2 pi, in radians, but it is "
                f"{angle}. (Angles of catalogues are in degrees.)",
            )
        demand(
            0 <= self.eccentricity < 1,
            "Argument `eccentricity` must be from 0 to below 1, but it is "
            f"{self.eccentricity}: pass positions of your own for an open orbit.",
        )

    def position(self, julian_dates: Real[ArrayLike, "..."]) -> Vectors:
        """Heliocentric positions in the ecliptic of J2000 [m], without perturbations.

        Args:
            julian_dates: Epochs (TDB; UTC is about a minute behind it).

        Source: C. D. Murray and S. F. Dermott, Solar System Dynamics, eq. 2.122.
        """
        dates = _dates(julian_dates)
        rate = np.sqrt(_GRAVITATIONAL_PARAMETER / self.semi_major_axis**3)
        mean_anomaly = self.mean_anomaly + rate * _DAY * (dates - self.epoch)
        return _position(
            self.semi_major_axis,
            self.eccentricity,
            self.inclination,
            self.node,
            self.argument_of_perihelion,
            mean_anomaly,
        )


def earth_position(julian_dates: Real[ArrayLike, "..."]) -> Vectors:
    """Heliocentric positions of the Earth-Moon barycentre, ecliptic of J2000 [m].

    Mean elements with linear rates. From 1800 to 2050 they are within 1.5e-4 au of the
    centre of the Earth, which is up to 3e-5 au from the barycentre. The light time of
    an asteroid is thus off by at most 0.08 s.

    Args:
        julian_dates: Epochs from 1800 to 2050 (TDB).

    Source: E. M. Standish and J. G. Williams, Approximate positions of the planets,
    Explanatory Supplement to the Astronomical Almanac, 3rd ed., table 8.10.2.

    >>> import numpy as np, jrigid as jr
    >>> print(jr.photometry.earth_position(np.array([2451545.0])).round(-9) / 1e9)
    [[-27. 145.  -0.]]
    """
    centuries = (_dates(julian_dates) - _J2000) / _CENTURY
    elements = _EARTH[:, :1] + _EARTH[:, 1:] * centuries[None]
    axis, eccentricity = elements[:2]
    inclination, longitude, perihelion = np.radians(elements[2:])
    # The node is at longitude 0 by definition of these elements.
    node = np.zeros_like(perihelion)
    return _position(
        ASTRONOMICAL_UNIT * axis,
        eccentricity,
        inclination,
        node,
        perihelion,
        # The mean anomaly is the mean longitude less that of the perihelion.
        longitude - perihelion,
    )


def geometry_of_orbit(orbit: Orbit) -> Positions:
    """Directions of the Sun and of the Earth, seen from a body on an orbit.

    Args:
        orbit: Of the body.

    Returns:
        A function of the Julian dates of observation at the Earth. It returns vectors
        from the body to the Sun and to the Earth [m], in the ecliptic of J2000. The
        body is where it was when the light left it.

    >>> import numpy as np, jrigid as jr
    >>> orbit = jr.photometry.Orbit(3e11, 0.1, 0.0, 0.0, 0.0, 0.0, 2451545.0)
    >>> positions = jr.photometry.geometry_of_orbit(orbit)
    >>> to_sun, to_observer = positions(np.array([2451545.0]))
    >>> print(to_observer.round(-9) / 1e9)
    [[-297.  145.   -0.]]
    """

    def positions(julian_dates: Real[ArrayLike, "..."]) -> tuple[Vectors, Vectors]:
        """Vectors to the Sun and to the Earth, corrected for the light time."""
        dates = _dates(julian_dates)
        earth = earth_position(dates)
        body = orbit.position(dates)
        for _ in range(_LIGHT_TIME_STEPS):
            light_days = light_time(earth - body) / _DAY
            body = orbit.position(dates - light_days)
        return -body, earth - body

    return positions


def geometry_of_table(
    julian_dates: Real[ArrayLike, " rows"],
    to_sun: Real[ArrayLike, "rows 3"],
    to_observer: Real[ArrayLike, "rows 3"],
) -> Positions:
    """Directions of the Sun and of the observer from a table, as of an ephemeris.

    Args:
        julian_dates: Of observation, increasing. A row a day is good for a body in the
            main belt, and one an hour for one that passes the Earth.
        to_sun: From the body, where the light left it, to the Sun [m, ecliptic].
        to_observer: From the body to the observer [m, ecliptic].

    Returns:
        A function of the Julian dates of observation. It returns both vectors [m] by
        cubic splines, and raises ValueError for dates outside of the table.

    Raises:
        ValueError: Fewer than four rows, dates that do not increase, or vectors that do
            not fit them.

    >>> import numpy as np, jrigid as jr
    >>> orbit = jr.photometry.Orbit(3e11, 0.1, 0.0, 0.0, 0.0, 0.0, 2451545.0)
    >>> positions = jr.photometry.geometry_of_orbit(orbit)
    >>> dates = 2451545.0 + np.arange(10)
    >>> table = jr.photometry.geometry_of_table(dates, *positions(dates))
    >>> print(table(np.array([2451548.5]))[1].round(-9) / 1e9)
    [[-305.  136.   -0.]]
    """
    # Imported where it is used: scipy takes a second, which `import jrigid` must not.
    from scipy.interpolate import CubicSpline

    dates = np.asarray(julian_dates, dtype=float)
    vectors = [np.asarray(x, dtype=float) for x in (to_sun, to_observer)]
    demand(
        dates.ndim == 1 and dates.size >= 4 and bool(np.all(np.diff(dates) > 0)),
        "Argument `julian_dates` must hold four dates or more that increase, but it "
        "does not.",
    )
    shape = (len(dates), 3)
    demand(
        all(x.shape == shape and bool(np.all(np.isfinite(x))) for x in vectors),
        "Arguments `to_sun` and `to_observer` must be finite and have the shape "
        f"{shape}, but they are not.",
    )
    check_metres("to_sun", vectors[0])
    # Small numbers keep the digits of a time of day, which a Julian date loses.
    spline = CubicSpline(dates - dates[0], np.stack(vectors, axis=1))

    def positions(wanted: Real[ArrayLike, "..."]) -> tuple[Vectors, Vectors]:
        """Vectors to the Sun and to the observer at Julian dates."""
        asked = _dates(wanted)
        demand(
            bool(np.all((asked >= dates[0]) & (asked <= dates[-1]))),
            f"Dates must be within the table, from {dates[0]} to {dates[-1]}, but they "
            f"are from {asked.min()} to {asked.max()}.",
        )
        sun, observer = np.moveaxis(spline(asked - dates[0]), 1, 0)
        return sun, observer

    return positions


def check_metres(name: str, to_sun: Vectors) -> None:
    """Raise ValueError for vectors to the Sun that are too short for metres."""
    nearest = float(np.min(np.linalg.norm(to_sun, axis=-1)))
    demand(
        nearest > _NEAREST,
        f"Argument `{name}` must give the Sun in metres, but its distance is "
        f"{nearest:.4g}: of kilometres or astronomical units, pass 1e3 or "
        f"{ASTRONOMICAL_UNIT} times as much.",
    )


def _dates(julian_dates: Real[ArrayLike, "..."]) -> Float[np.ndarray, " epochs"]:
    """Dates as an array, of one or of many."""
    return np.atleast_1d(np.asarray(julian_dates, dtype=float))


def light_time(vectors: Vectors) -> Float[np.ndarray, " epochs"]:
    """Time that light takes along each vector [s]."""
    return np.linalg.norm(vectors, axis=-1) / SPEED_OF_LIGHT


def _position(
    axis: float | Float[np.ndarray, " epochs"],
    eccentricity: float | Float[np.ndarray, " epochs"],
    inclination: float | Float[np.ndarray, " epochs"],
    node: float | Float[np.ndarray, " epochs"],
    argument: float | Float[np.ndarray, " epochs"],
    mean_anomaly: Float[np.ndarray, " epochs"],
) -> Vectors:
    """Positions on ellipses, from their elements."""
    anomaly = _eccentric_anomaly(mean_anomaly, eccentricity)
    # In the plane of the orbit, from the Sun, with x towards the perihelion.
    x = axis * (np.cos(anomaly) - eccentricity)
    y = axis * np.sqrt(1 - eccentricity**2) * np.sin(anomaly)
    along = np.cos(argument) * x - np.sin(argument) * y
    across = np.sin(argument) * x + np.cos(argument) * y
    level = np.cos(inclination) * across
    return np.stack(
        [
            np.cos(node) * along - np.sin(node) * level,
            np.sin(node) * along + np.cos(node) * level,
            np.sin(inclination) * across,
        ],
        axis=-1,
    )


def _eccentric_anomaly(
    mean_anomaly: Float[np.ndarray, " epochs"],
    eccentricity: float | Float[np.ndarray, " epochs"],
) -> Float[np.ndarray, " epochs"]:
    """Solve Kepler's equation, E - e sin E = M, by Newton's method.

    From 0 to pi the left side is convex, so that the iteration from an upper bound of
    the root converges monotonically; the other half follows by symmetry.
    """
    wrapped = np.remainder(mean_anomaly + np.pi, 2 * np.pi) - np.pi
    size = np.abs(wrapped)
    # E = M + e sin E is at most M + e, and for M up to pi it is at most pi.
    anomaly = np.minimum(size + eccentricity, np.pi)
    for _ in range(_NEWTON_STEPS):
        excess = anomaly - eccentricity * np.sin(anomaly) - size
        step = excess / (1 - eccentricity * np.cos(anomaly))
        anomaly = anomaly - step
        if np.all(np.abs(step) <= 1e-15):
            break
    return np.copysign(anomaly, wrapped)
