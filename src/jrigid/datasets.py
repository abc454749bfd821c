"""Small records of real and synthetic rotation, to fit and to test against.

Records are NumPy arrays in float64 whatever JAX's precision is set to: turn them into
JAX arrays where they are used.
"""

import importlib.resources
import math

import numpy as np
from jaxtyping import Float, Shaped

from jrigid._extra import extra
from jrigid._public import list_public_names
from jrigid._types import Readable

_DEGREE = math.pi / 180.0
_ARCSECOND = math.pi / 648000.0
_DAY = 86400.0


class EarthPole(Readable):
    """Daily polar motion of the Earth, as published.

    The coordinates are those of the celestial intermediate pole in the terrestrial
    frame. `x` is positive toward the meridian of Greenwich, `y` positive toward 90
    degrees WEST. With the terrestrial axes (Greenwich, 90 degrees east, north) the pole
    is therefore at (x, -y): its complex number is `x - 1j * y`, and it turns
    counter-clockwise, with the spin. Read as `x + 1j * y` the pole turns backwards, as
    that of a prolate body.

    Attributes:
        mjd: Modified Julian Date [days, UTC, 0h], one a day.
        x: Pole coordinate toward Greenwich [rad].
        y: Pole coordinate toward 90 degrees west [rad].
        x_sigma: Published standard error of `x` [rad]: 30 mas in 1962, 0.05 mas since
            about 2000.
        y_sigma: Published standard error of `y` [rad].
    """

    mjd: Float[np.ndarray, " days"]
    x: Float[np.ndarray, " days"]
    y: Float[np.ndarray, " days"]
    x_sigma: Float[np.ndarray, " days"]
    y_sigma: Float[np.ndarray, " days"]


class ToutatisRecord(Readable):
    """Attitudes and spins of the asteroid 4179 Toutatis by radar, and a published fit.

    Body axes: x the principal axis of the intermediate moment, y of the short body axis
    (largest moment), z of the long body axis (smallest moment). In this order they are
    right-handed. Space axes: ecliptic J2000.

    Attributes:
        times: Seconds since 1992-11-09T17:49:47 UTC; 17 days of December 1992, and one
            of 2008.
        attitudes: Unit quaternions (w, x, y, z), body to space.
        omegas: Angular velocity, body components [rad/s].
        moments: Published principal moments about (x, y, z), in units of the smallest.
        epoch_attitude: Published attitude at time 0, fitted to all of the record.
        epoch_omega: Published angular velocity at time 0, body components [rad/s].
    """

    times: Float[np.ndarray, " rows"]
    attitudes: Float[np.ndarray, "rows 4"]
    omegas: Float[np.ndarray, "rows 3"]
    moments: Float[np.ndarray, " 3"]
    epoch_attitude: Float[np.ndarray, " 4"]
    epoch_omega: Float[np.ndarray, " 3"]


class GyroRecord(Readable):
    """SYNTHETIC readings of a three-axis gyro on a free body, and the true motion.

    Attributes:
        times: Sampling times [s], equally spaced from 0.
        omegas: Readings [rad/s], body components, with noise.
        sigma: Standard deviation of the noise on each component [rad/s].
        true_moments: Principal moments of the body about the gyro's axes, scaled to a
            trace of 1.
        true_omegas: What a perfect gyro would have read [rad/s].
    """

    times: Float[np.ndarray, " samples"]
    omegas: Float[np.ndarray, "samples 3"]
    sigma: float
    true_moments: Float[np.ndarray, " 3"]
    true_omegas: Float[np.ndarray, "samples 3"]


def earth_pole() -> EarthPole:
    """The Earth's polar motion since 1962: the IERS 20 C04 record, one pole a day.

    Read from the package astropy-iers-data, which ships the file `eopc04.1962-now`; no
    network is touched. A newer version of that package has a longer record.

    Returns:
        The whole record, about 24 000 days; pole coordinates and their errors in rad.

    Raises:
        ImportError: Without the extra `jrigid[data]`.

    >>> import jrigid as jr
    >>> record = jr.datasets.earth_pole()
    >>> print(record.mjd[0], f"{record.y[0]:.4g} rad")
    37665.0 1.033e-06 rad

    Source: IERS Earth Orientation Centre, Paris Observatory, EOP 20 C04, consistent
    with ITRF 2020; Bizouard et al., J. Geodesy 93, 621 (2019).
    """
    iers = extra("data", "astropy_iers_data")
    # MJD, x, y and the errors of x and y. Before them stand year, month, day and hour.
    columns = np.loadtxt(
        iers.IERS_B_FILE, usecols=(4, 5, 6, 13, 14), encoding="ascii", unpack=True
    )
    return EarthPole(columns[0], *(columns[1:] * _ARCSECOND))


def toutatis_1992() -> ToutatisRecord:
    """Radar observations of the tumbling asteroid Toutatis, and their published fit.

    Free rotation with the published moments from the published epoch state passes the
    17 attitudes of 1992 at a median of 5.6 degrees (16 at most) and their spins at a
    median of 6.6 degrees a day, which is what the observations are worth. The spins of
    rows 5 and 12 alone are off by 45 degrees a day, though the attitudes beside them
    fit. The tides of the Earth's passage on 8 December 1992 (day 29) and of all those
    since are no free rotation: the row of 2008 is off by 130 degrees.

    Returns:
        The record: times in s from the epoch, unit quaternions (body to space), rates
        in rad/s.

    >>> import jrigid as jr
    >>> record = jr.datasets.toutatis_1992()
    >>> print(record.attitudes.shape, record.moments)
    (18, 4) [3.0836 3.235  1.    ]

    Source: Takahashi, Busch and Scheeres, Astron. J. 146, 95 (2013), tables 1 and 2;
    observations by Hudson, Ostro and others.
    """
    path = importlib.resources.files("jrigid") / "data" / "toutatis_1992.csv"
    with path.open(encoding="ascii") as file:
        # The first six lines are remarks and the names of the columns.
        table = np.loadtxt(file, delimiter=",", skiprows=6)
    # The published fit: Euler angles z-x-z [deg] and spin [deg/day] at the epoch.
    epoch_angles = np.array([145.498, 65.865, 241.524])
    epoch_spin = np.array([14.51, 33.529, -98.709])
    return ToutatisRecord(
        times=table[:, 0] * _DAY,
        attitudes=_attitude(table[:, 1:4] * _DEGREE),
        omegas=table[:, 4:7] * _DEGREE / _DAY,
        moments=np.array([3.0836, 3.235, 1.0]),
        epoch_attitude=_attitude(epoch_angles * _DEGREE),
        epoch_omega=epoch_spin * _DEGREE / _DAY,
    )


def gyro_example() -> GyroRecord:
    """A SYNTHETIC gyro record of a tumbling box: 200 readings with 2 % noise.

    A body of moments in the ratio 2 : 3 : 4 spins about its intermediate axis and flips
    over every 5.7 s. The gyro reads it for 20 s at 10 Hz. Every call returns the same
    record. It is made for examples and tests; nothing was measured.

    Returns:
        Readings and truth: times in s, rates in rad/s, moments in units of their sum.

    >>> import jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> print(record.omegas.shape, record.sigma)
    (200, 3) 0.06
    """
    times = np.arange(200) / 10.0
    moments = np.array([2.0, 3.0, 4.0]) / 9.0
    true_omegas = _tumble(moments, np.array([0.3, 3.0, 0.4]), times)
    sigma = 0.06
    noise = np.random.default_rng(1758).normal(scale=sigma, size=true_omegas.shape)
    return GyroRecord(times, true_omegas + noise, sigma, moments, true_omegas)


def _attitude(angles: Shaped[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 4"]:
    """Quaternion of Rz(a) Rx(b) Rz(c), a, b, c the angles [rad]."""
    # By NumPy: `jrigid.rotation` would give float32 where x64 is off.
    a, b, c = np.moveaxis(angles, -1, 0)
    w = np.cos(b / 2) * np.cos((a + c) / 2)
    x = np.sin(b / 2) * np.cos((a - c) / 2)
    y = np.sin(b / 2) * np.sin((a - c) / 2)
    z = np.cos(b / 2) * np.sin((a + c) / 2)
    return np.stack([w, x, y, z], axis=-1)


def _tumble(
    moments: Float[np.ndarray, "3"],
    omega: Float[np.ndarray, "3"],
    times: Float[np.ndarray, " samples"],
) -> Float[np.ndarray, "samples 3"]:
    """Angular velocities of a free body at the times, with a relative error of 1e-8."""
    # Euler's equations: I1 omega1' = (I2 - I3) omega2 omega3, and so on in turn.
    differences = np.roll(moments, -1) - np.roll(moments, -2)

    def rate(omega: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        return differences / moments * np.roll(omega, -1) * np.roll(omega, -2)

    omegas = [omega]
    # Classical Runge-Kutta steps, ten from sample to sample. The exact motion would
    # depend on JAX's precision.
    for step in np.repeat(np.diff(times) / 10, 10):
        k1 = rate(omega)
        k2 = rate(omega + step / 2 * k1)
        k3 = rate(omega + step / 2 * k2)
        k4 = rate(omega + step * k3)
        omega = omega + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        omegas.append(omega)
    return np.stack(omegas[::10])


list_public_names(__name__)
