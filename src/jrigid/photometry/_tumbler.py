"""A free body and its surface: everything that its light curves depend on."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jrigid._checks import array_of_shape, check_option, is_concrete
from jrigid._types import Quaternion, Readable, Real, Scalar, Vector
from jrigid.dynamics import State
from jrigid.free import free_rotation
from jrigid.photometry._ellipsoid import Ellipsoid
from jrigid.photometry._facets import Facets
from jrigid.photometry._light_curve import light_curve
from jrigid.photometry._pole import attitude_of_pole, demand_radians, state_of_pole
from jrigid.photometry._scattering import AbstractScattering, LommelSeeliger
from jrigid.photometry._tumbling import omega_from_periods
from jrigid.rotation import from_axis_angle, multiply

MODES = ("short-axis", "long-axis", "principal-axis")


def _converter(name: str, *shape: int) -> Callable[[Any], Array]:
    """Function that makes an array of one shape from a field's value."""
    return lambda value: array_of_shape(name, value, shape)


class Tumbler(Readable):
    """A free body in the terms of observers: its motion, its shape and its surface.

    Body axes are the principal axes of inertia: x has the smallest moment, z the
    largest.

    Attributes:
        moments: Principal moments in rising order; only their ratios matter.
        precession_period: P_phi [s]. In the mode "principal-axis", the period of the
            rotation.
        rotation_period: P_psi [s]. It has no meaning in the mode "principal-axis".
        longitude: Of the angular momentum, space axes [rad].
        latitude: Of the angular momentum, space axes [rad].
        precession_angle: Mean angle of the precession at time 0 [rad].
        rotation_phase: Fraction of P_psi since the tilt was largest, at time 0.
        shape: `Facets` or an `Ellipsoid`, body axes.
        scattering: The scattering law.
        mode: "short-axis", "long-axis" or "principal-axis", the steady rotation about
            the axis of the largest moment.

    Raises:
        ValueError: A mode that does not exist, or an array of a wrong shape.
        RuntimeError: The moments are not in rising order, or the pole is in degrees,
            and they are known when the object is built.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> shape = jr.photometry.Ellipsoid(jnp.array([3.0, 2.0, 1.5]))
    >>> body = jr.photometry.Tumbler(
    ...     shape.moments, 27.4 * 3600, 263 * 3600, 4.0, -1.3, 0.0, 0.0, shape)
    >>> terms = jr.photometry.tumbling(body.moments, body.state.omega)
    >>> print((terms.precession_period / 3600).round(6))
    27.4
    """

    moments: Float[Array, "3"] = eqx.field(converter=_converter("moments", 3))
    precession_period: Float[Array, ""] = eqx.field(
        converter=_converter("precession_period")
    )
    rotation_period: Float[Array, ""] = eqx.field(
        converter=_converter("rotation_period")
    )
    longitude: Float[Array, ""] = eqx.field(converter=_converter("longitude"))
    latitude: Float[Array, ""] = eqx.field(converter=_converter("latitude"))
    precession_angle: Float[Array, ""] = eqx.field(
        converter=_converter("precession_angle")
    )
    rotation_phase: Float[Array, ""] = eqx.field(converter=_converter("rotation_phase"))
    shape: Facets | Ellipsoid
    scattering: AbstractScattering = LommelSeeliger()
    mode: str = eqx.field(static=True, default="short-axis")

    def __check_init__(self) -> None:
        """Raise an error for an unknown mode, degrees, or moments out of order."""
        check_option("mode", self.mode, MODES)
        demand_radians(self.longitude, self.latitude)
        if is_concrete(self.moments) and np.any(np.diff(np.asarray(self.moments)) < 0):
            raise RuntimeError(
                "Argument `moments` must be in rising order, but it is not: turn the "
                "body axes, and `shape` with them."
            )

    @property
    def state(self) -> State:
        """The state at time 0.

        NaN where no motion of this mode has these periods.
        """
        if self.mode == "principal-axis":
            return state_of_pole(
                self.longitude,
                self.latitude,
                self.precession_period,
                self.precession_angle,
            )
        omega = omega_from_periods(
            self.moments, self.precession_period, self.rotation_period, self.mode
        )
        start = _upright(self.moments, omega, self.mode == "long-axis")
        elapsed = self.rotation_phase * self.rotation_period
        later = free_rotation(self.moments, start, elapsed[None], throw=False)
        # The mean precession of that time is not a part of the angle.
        back = 2 * jnp.pi * elapsed / self.precession_period
        angle = self.precession_angle - back
        attitude = _placed(self.longitude, self.latitude, angle, later.attitude[0])
        return State(attitude, later.omega[0])

    def light_curve(
        self,
        ts: Real[ArrayLike, " epochs"],
        to_sun: Real[ArrayLike, "epochs 3"],
        to_observer: Real[ArrayLike, "epochs 3"],
    ) -> Float[Array, " epochs"]:
        """Brightness at unit distances [m^2], as by `photometry.light_curve`.

        Args:
            ts: Times [s] at the body: light times are taken off.
            to_sun: Vectors from the body to the Sun, space axes.
            to_observer: Vectors from the body to the observer, space axes.
        """
        return light_curve(
            self.moments,
            self.state,
            ts,
            to_sun,
            to_observer,
            self.shape,
            self.scattering,
            light_time=False,
        )


@functools.partial(jax.jit, static_argnums=2)
def _upright(moments: Vector, omega: Vector, long_axis: bool) -> State:
    """A state whose angular momentum is along z in space.

    Args:
        moments: Principal moments.
        omega: Angular velocity at the largest tilt.
        long_axis: Whether the momentum circles the axis of the smallest moment.
    """
    x = jnp.asarray([1.0, 0.0, 0.0], omega.dtype)
    # The momentum lies in the plane of the circled axis and of the middle one.
    momentum = moments * omega
    if not long_axis:
        # This turn about x takes the angular momentum to z.
        tilt = jnp.arctan2(momentum[1], momentum[2])
        return State(from_axis_angle(x, tilt), omega)
    # `swap` reverses y. With y reversed here too, the same turn makes both modes
    # upright.
    omega = omega * jnp.asarray([1.0, -1.0, 1.0], omega.dtype)
    tilt = jnp.arctan2(momentum[1], momentum[0])
    half = jnp.sqrt(jnp.asarray(0.5, omega.dtype))
    swap = jnp.stack([0 * half, half, 0 * half, half])  # x to z, y to -y
    return State(multiply(from_axis_angle(x, tilt), swap), omega)


@jax.jit
def _placed(
    longitude: Scalar, latitude: Scalar, angle: Scalar, attitude: Quaternion
) -> Quaternion:
    """An attitude, turned by an angle about z and then tilted with z to a pole."""
    z = jnp.asarray([0.0, 0.0, 1.0], attitude.dtype)
    turned = multiply(from_axis_angle(z, angle), attitude)
    return multiply(attitude_of_pole(longitude, latitude), turned)
