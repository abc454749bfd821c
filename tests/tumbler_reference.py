"""Light curves of tumblers by another code path: Kepler orbits, DOP853 and facets.

Nothing of the package computes the motion or the brightness here.
"""

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from jrigid.photometry import LightCurve

DAY, AU = 86400.0, 149597870700.0
_GAUSS = 0.01720209895  # mean motion at 1 au [rad/day]
# Semi-major axis [au], eccentricity, inclination, node, argument of perihelion, mean
# anomaly [degrees] and its Julian date. The second orbit is like that of Apophis, with
# the approach to 0.097 au on 9 January 2013.
_EARTH = (1.0, 0.0167, 0.0, 0.0, 102.94, 357.53, 2451545.0)
_APOPHIS = (0.9224, 0.1911, 3.331, 204.43, 126.42, 115.6, 2456300.5)
_FIRST_DATE = 2456285.5  # 23 December 2012
_DAYS = 110
_ROWS = 24  # rings of facets


class Truth(NamedTuple):
    """What an inversion should find."""

    mode: str
    precession_period: float
    rotation_period: float
    pole: np.ndarray
    moments: np.ndarray
    semi_axes: np.ndarray


def positions(elements, dates):
    """Heliocentric ecliptic positions [au]."""
    a, e, i, node, argument, anomaly, epoch = elements
    mean = np.deg2rad(anomaly) + _GAUSS / a**1.5 * (dates - epoch)
    eccentric = mean
    for _ in range(30):
        slope = 1 - e * np.cos(eccentric)
        eccentric = eccentric - (eccentric - e * np.sin(eccentric) - mean) / slope
    x = a * (np.cos(eccentric) - e)
    y = a * np.sqrt(1 - e * e) * np.sin(eccentric)
    turn = Rotation.from_euler("ZXZ", np.deg2rad([node, i, argument]))
    return turn.apply(np.stack([x, y, 0 * x], axis=-1))


def geometry(dates):
    """Vectors from the body to the Sun and to the Earth [m]."""
    body = positions(_APOPHIS, dates)
    return -AU * body, AU * (positions(_EARTH, dates) - body)


def random_body(rng, mode, longest=400 * 3600.0, shortest=8 * 3600.0):
    """A homogeneous ellipsoid that tumbles by at least 15 degrees, and its rates."""
    from jrigid import photometry

    while True:
        middle, short = rng.uniform(0.4, 0.9), rng.uniform(0.55, 0.95)
        semi_axes = np.array([1.0, middle, middle * short])
        moments = (np.sum(semi_axes**2) - semi_axes**2) / 5
        momentum = rng.normal(size=3)
        momentum = momentum / np.linalg.norm(momentum)
        omega = momentum / moments
        if (momentum @ omega > 1 / moments[1]) != (mode == "long-axis"):
            continue
        period = rng.uniform(10, 40) * 3600
        terms = photometry.tumbling(moments, omega)
        omega = omega * float(terms.precession_period) / period
        rotation = float(terms.rotation_period) / float(terms.precession_period)
        inside = shortest < rotation * period < longest
        if inside and float(terms.tilt_max) > np.deg2rad(15):
            return semi_axes, moments, omega, period, rotation * period


def dates_of(rng, curves):
    """Julian dates of light curves of up to three nights each."""
    first = np.sort(rng.choice(np.arange(0, _DAYS, 3), curves, replace=False))
    dates = []
    for day in first:
        nights = [day, *(day + k for k in (1, 2) if rng.random() > 0.2)]
        ones = [_night(rng, _FIRST_DATE + night) for night in nights]
        dates.append(np.concatenate(ones))
    return dates


def _night(rng, day):
    """Dates of 8 to 15 points within 3 to 7 hours."""
    hours = rng.uniform(3, 7)
    start = day + 0.1 + rng.uniform(0, 0.1)
    return start + np.sort(rng.uniform(0, hours / 24, rng.integers(8, 16)))


def attitudes(moments, omega, attitude, ts):
    """Rotation matrices by DOP853."""

    def rates(_, y):
        w, x, yy, z = y[:4]
        a, b, c = y[4:]
        return 0.5 * np.array(
            [
                -x * a - yy * b - z * c,
                w * a + yy * c - z * b,
                w * b - x * c + z * a,
                w * c + x * b - yy * a,
                *(-2 * np.cross(y[4:], moments * y[4:]) / moments),
            ]
        )

    start = np.concatenate([np.roll(attitude.as_quat(), 1), omega])
    size = np.linalg.norm(omega)
    tolerances = [1e-11] * 4 + [1e-11 * size] * 3
    run = solve_ivp(
        rates, (0, ts[-1]), start, "DOP853", t_eval=ts, rtol=1e-11, atol=tolerances
    )
    return Rotation.from_quat(np.roll(run.y[:4].T, -1, axis=1)).as_matrix()


def brightness(semi_axes, to_sun, to_observer):
    """Sum over triangles of an ellipsoid by Lommel-Seeliger's law, body axes."""
    polar = np.pi * np.arange(_ROWS + 1) / _ROWS
    around = np.pi * np.arange(2 * _ROWS + 1) / _ROWS
    polar, around = np.meshgrid(polar, around, indexing="ij")
    corners = np.stack(
        [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)],
        axis=-1,
    )
    corners = corners * semi_axes
    a, b = corners[:-1, :-1], corners[1:, :-1]
    c, d = corners[1:, 1:], corners[:-1, 1:]
    areas = np.concatenate(
        [np.cross(b - a, c - a).reshape(-1, 3), np.cross(c - a, d - a).reshape(-1, 3)]
    )
    sizes = np.linalg.norm(areas, axis=1)
    areas, sizes = areas[sizes > 1e-14], sizes[sizes > 1e-14]
    sun = to_sun @ areas.T / sizes
    observer = to_observer @ areas.T / sizes
    seen = (sun > 0) & (observer > 0)
    law = sun * observer / np.where(seen, sun + observer, 1.0)
    return np.sum(np.where(seen, sizes / 2 * law, 0.0), axis=1)


def tumbler(rng, mode, noise=0.02, curves=12):
    """Relative light curves of a random tumbler [noise in mag], and the truth."""
    semi_axes, moments, omega, precession, rotation = random_body(rng, mode)
    attitude = Rotation.random(random_state=int(rng.integers(2**31)))
    dates = dates_of(rng, curves)
    every = np.concatenate(dates)
    sun, observer = geometry(every)
    ts = (every - every[0]) * DAY
    turned = attitudes(moments, omega, attitude, ts)
    unit = [x / np.linalg.norm(x, axis=1, keepdims=True) for x in (sun, observer)]
    light = brightness(semi_axes, *(np.einsum("nij,ni->nj", turned, x) for x in unit))
    of_curve = np.repeat(np.arange(curves), [len(x) for x in dates])
    magnitudes = noise * rng.normal(size=len(ts)) + rng.normal(size=curves)[of_curve]
    light = light * 10 ** (-0.4 * magnitudes)
    parts = [of_curve == k for k in range(curves)]
    found = [
        LightCurve(every[0], ts[x], light[x], sun[x], observer[x], is_relative=True)
        for x in parts
    ]
    pole = attitude.apply(moments * omega)
    pole = pole / np.linalg.norm(pole)
    return found, Truth(mode, precession, rotation, pole, moments, semi_axes)
