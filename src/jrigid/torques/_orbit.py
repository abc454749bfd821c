"""The orbit on which a torque depends: Kepler's ellipse."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jrigid._types import Scalar, ScalarLike, Vector
from jrigid.torques._base import array


class KeplerOrbit(eqx.Module):
    """Position on an ellipse, as a function of time, for `GravityGradient`.

    At time 0 the body is at the pericentre, on the x axis of space. It moves in the
    direction of y, and z is the normal of the orbit.

    Attributes:
        mu: Gravitational parameter of the attractor [m^3/s^2].
        semi_major_axis: Semi-major axis [m].
        eccentricity: Eccentricity, from 0 to below 1.

    The position is NaN for an eccentricity out of this range. It is right to rounding
    up to an eccentricity of 0.99; beyond, some digits are lost near the pericentre.

    Gradients: finite for eccentricities below 1.
    Source: S. Mikkola, Celestial Mechanics 40 (1987) 329, for the start; J. M. A.
    Danby, Fundamentals of Celestial Mechanics, 2nd ed. (1988), section 6.6.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> orbit = jr.torques.KeplerOrbit(1.0, 1.0, 0.1)
    >>> print(orbit(0.0).round(6), orbit(jnp.pi).round(6))
    [0.9 0.  0. ] [-1.1  0.   0. ]
    """

    mu: Float[Array, ""] = eqx.field(converter=array("mu"))
    semi_major_axis: Float[Array, ""] = eqx.field(converter=array("semi_major_axis"))
    eccentricity: Float[Array, ""] = eqx.field(converter=array("eccentricity"))

    @property
    def mean_motion(self) -> Float[Array, ""]:
        """Mean motion n = sqrt(mu / a^3) [rad/s]."""
        # The cube of an axis in metres can overflow in float32.
        return jnp.sqrt(self.mu / self.semi_major_axis) / self.semi_major_axis

    def __call__(self, t: ScalarLike) -> Vector:
        """Position at a time, space components [m]."""
        a = self.semi_major_axis
        e = self.eccentricity
        mean = self.mean_motion * jnp.asarray(t, a.dtype)
        # The start below is for mean anomalies from -pi to pi.
        mean = mean - 2 * jnp.pi * jax.lax.stop_gradient(jnp.round(mean / (2 * jnp.pi)))
        anomaly = _eccentric_anomaly(mean, e)
        x = a * (jnp.cos(anomaly) - e)
        y = a * jnp.sqrt(1 - e * e) * jnp.sin(anomaly)
        fixed = jax.lax.stop_gradient(e)
        ellipse = (fixed >= 0) & (fixed < 1)
        return jnp.where(ellipse, jnp.stack([x, y, jnp.zeros_like(x)]), jnp.nan)


def _eccentric_anomaly(mean: Scalar, e: Scalar) -> Scalar:
    """The solution E of Kepler's equation, mean = E - e sin E."""
    anomaly = _without_derivatives(*jax.lax.stop_gradient((mean, e)))
    # Newton's steps give the derivatives: two, for those of second order too.
    for _ in range(2):
        anomaly = anomaly - (anomaly - e * jnp.sin(anomaly) - mean) / (
            1 - e * jnp.cos(anomaly)
        )
    return anomaly


def _without_derivatives(mean: Scalar, e: Scalar) -> Scalar:
    """The eccentric anomaly, from Mikkola's start by steps of Danby."""
    # The root of a cubic is a good start at any eccentricity.
    scale = 4 * e + 0.5
    alpha = (1 - e) / scale
    beta = 0.5 * jnp.abs(mean) / scale
    z = jnp.cbrt(beta + jnp.sqrt(alpha**3 + beta * beta))
    # The sine s of a third of E, so that sin E = 3 s - 4 s^3. This quotient is
    # Mikkola's z - alpha / z without its cancellation at small anomalies.
    sine = 2 * beta / (z * z + alpha + (alpha / z) ** 2)
    # Mikkola's correction for what the cubic neglects.
    sine = sine - 0.078 * sine**5 / (1 + e)
    anomaly = mean + jnp.sign(mean) * e * (3 * sine - 4 * sine**3)
    # Each step is of fourth order.
    for _ in range(3):
        sine = e * jnp.sin(anomaly)
        cosine = e * jnp.cos(anomaly)
        f = anomaly - sine - mean
        slope = 1 - cosine
        first = -f / slope
        second = -f / (slope + 0.5 * first * sine)
        anomaly = anomaly - f / (slope + 0.5 * second * sine + second**2 * cosine / 6)
    return anomaly
