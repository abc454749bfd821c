"""Principal-axis rotation by its pole, as tables of asteroids give it."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jrigid._checks import shaped
from jrigid._types import Quaternion, Scalar, ScalarLike
from jrigid.dynamics import State
from jrigid.rotation import from_axis_angle, multiply


def state_of_pole(
    longitude: ScalarLike, latitude: ScalarLike, period: ScalarLike, angle: ScalarLike
) -> State:
    """State of a body that rotates about its third axis, for a given pole.

    R = Rz(longitude) Ry(pi / 2 - latitude) Rz(angle), from body to space axes: the
    convention of DAMIT, whose tables give degrees and hours.

    Args:
        longitude: Of the pole, the direction of the angular velocity, in space axes
            (the ecliptic of DAMIT) [rad].
        latitude: Of the pole [rad].
        period: Sidereal period of rotation [s].
        angle: Angle of rotation at the epoch of the state [rad].

    Returns:
        The state at that epoch.

    Gradients: exact.
    Source: J. Durech, V. Sidorin and M. Kaasalainen, Astron. Astrophys. 513 (2010)
    A46, eq. 1.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> state = jr.photometry.state_of_pole(0.0, jnp.pi / 2, 2 * jnp.pi, 0.0)
    >>> print(state.attitude, state.omega)
    [1. 0. 0. 0.] [0. 0. 1.]
    """
    longitude, latitude, period, angle = shaped(
        longitude=(longitude,),
        latitude=(latitude,),
        period=(period,),
        angle=(angle,),
    )
    z = jnp.asarray([0.0, 0.0, 1.0], period.dtype)
    tilted = attitude_of_pole(longitude, latitude)
    attitude = multiply(tilted, from_axis_angle(z, angle))
    return State(attitude, 2 * jnp.pi / period * z)


def direction_of_pole(
    longitude: Float[np.ndarray, "*many"], latitude: Float[np.ndarray, "*many"]
) -> Float[np.ndarray, "*many 3"]:
    """Unit vector towards a pole, on the host."""
    across = np.cos(latitude)
    return np.stack(
        [across * np.cos(longitude), across * np.sin(longitude), np.sin(latitude)], -1
    )


def attitude_of_pole(longitude: Scalar, latitude: Scalar) -> Quaternion:
    """Rotation that takes the z axis to a pole, and the x axis south of it."""
    _, y, z = jnp.eye(3, dtype=longitude.dtype)
    return multiply(
        from_axis_angle(z, longitude), from_axis_angle(y, jnp.pi / 2 - latitude)
    )
