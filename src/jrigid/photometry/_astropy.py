"""Epochs and frames by astropy, an extra: time scales, and coordinates of a body."""

import contextlib
from collections.abc import Generator, Sequence
from decimal import Decimal
from typing import Any

import numpy as np

from jrigid._checks import demand
from jrigid._extra import extra
from jrigid.photometry._sun_and_earth import Positions, Vectors, geometry_of_table

# Astropy is an extra, so that its classes cannot be named here.
SkyCoord = Any  # `astropy.coordinates.SkyCoord`
Time = Any  # `astropy.time.Time`

TDB = "tdb"
# Of Julian dates. These scales differ by up to 69 s.
TIME_SCALES = (TDB, "tt", "tai", "utc")
# A cubic spline needs as many points.
_LEAST_ROWS = 4


def in_tdb(dates: Sequence[Decimal], time_scale: str) -> list[Decimal]:
    """Julian dates of another time scale as those of TDB, with all their digits."""
    # Two floats together hold the digits that one of them loses.
    days = [int(date) for date in dates]
    fractions = [float(date - day) for date, day in zip(dates, days, strict=True)]
    make = extra("photometry", "astropy.time").Time
    with _no_download():
        times = make(np.array(days, float), fractions, format="jd", scale=time_scale)
        tdb = times.tdb
    return [
        Decimal(float(day)) + Decimal(float(fraction))
        for day, fraction in zip(tdb.jd1, tdb.jd2, strict=True)
    ]


def geometry_of_coordinates(body: SkyCoord, observer: SkyCoord = None) -> Positions:
    """Directions of the Sun and of the observer from coordinates of astropy.

    Astropy takes any of its frames to the ecliptic of J2000. The Sun and the Earth come
    from the ephemeris that it contains; nothing is downloaded.

    Args:
        body: A `SkyCoord` with distances, and with an `obstime` for each, which
            increase. At least four rows; a row a day is good for a body in the main
            belt, and one a minute for a satellite. It is where the light left it that
            is seen at `obstime`, as ephemerides of observers have it.
        observer: An `EarthLocation`, or a `SkyCoord` of as many rows, such as that of a
            spacecraft; the centre of the Earth if None.

    Returns:
        A function of the Julian dates of observation (TDB), for `read_alcdef`. It
        returns vectors from the body to the Sun and to the observer [m], in the
        ecliptic of J2000, by cubic splines. It raises ValueError for dates outside of
        those of `body`.

    Raises:
        ImportError: Without the extra `jrigid[photometry]`.
        ValueError: Coordinates without times or distances, fewer than four, times that
            do not increase, or an `observer` of another shape.

    Right ascension, declination and distance from the Earth belong into the frame
    "gcrs", also if a table says ICRF. The origin of "icrs", which is astropy's default,
    is the barycentre of the solar system. GCRS has the aberration of light, which moves
    a direction by up to 1e-4 rad.

    >>> import astropy.units as u, jrigid as jr, numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.time import Time
    >>> times = Time(2451545.0 + np.arange(5), format="jd", scale="tdb")
    >>> ra, dec = np.linspace(70, 71, 5), np.full(5, 20.0)  # of an ephemeris
    >>> body = SkyCoord(
    ...     ra * u.deg, dec * u.deg, 1.5 * u.au, frame="gcrs", obstime=times)
    >>> positions = jr.photometry.geometry_of_coordinates(body)
    >>> to_sun, to_observer = positions(times.jd[:1])
    >>> print(to_sun.round(-9) / 1e9, to_observer.round(-9) / 1e9)
    [[ -46. -357.    8.]] [[ -72. -212.    8.]]
    """
    coordinates = extra("photometry", "astropy.coordinates")
    times: Time = getattr(body, "obstime", None)
    demand(
        isinstance(times, extra("photometry", "astropy.time").Time)
        and times.ndim == 1
        and len(times) >= _LEAST_ROWS
        and bool(np.all(np.diff(times.jd) > 0)),
        f"Argument `body` must have an `obstime` of at least {_LEAST_ROWS} times that "
        "increase, but it has not.",
    )
    if isinstance(observer, coordinates.EarthLocation):
        observer = observer.get_itrs(times)
    if observer is None:
        earth = coordinates.get_body_barycentric("earth", times, ephemeris="builtin")
        observer = coordinates.SkyCoord(earth, frame="icrs")
    from_sun = _from_sun("body", body, times)
    observer_from_sun = _from_sun("observer", observer, times)
    return geometry_of_table(times.tdb.jd, -from_sun, observer_from_sun - from_sun)


def _from_sun(name: str, place: SkyCoord, times: Time) -> Vectors:
    """Heliocentric positions of an argument in the ecliptic of J2000 [m]."""
    units = extra("photometry", "astropy.units")
    coordinates = extra("photometry", "astropy.coordinates")
    demand(
        place.shape == times.shape and place.cartesian.x.unit.is_equivalent(units.m),
        f"Argument `{name}` must have a distance for each of the {len(times)} times, "
        "but it has not.",
    )
    # Catalogues of orbits take the obliquity of 1976.
    frame = coordinates.HeliocentricEclipticIAU76(obstime=times)
    with _no_download():
        return place.transform_to(frame).cartesian.xyz.to_value(units.m).T


@contextlib.contextmanager
def _no_download() -> Generator[None, None, None]:
    """Keep astropy from looking for newer tables of leap seconds and of the Earth.

    It has tables of its own. Beyond their end the Earth's rotation is off by less than
    a second in some years, which moves an observer by less than 500 m.
    """
    settings = extra("photometry", "astropy.utils.iers").conf
    with (
        settings.set_temp("auto_download", value=False),
        settings.set_temp("auto_max_age", value=None),
    ):
        yield
