"""Principal-axis rotation by its pole, as tables of asteroids give it."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jrigid._checks import is_concrete, shaped
from jrigid._types import Quaternion, Scalar, ScalarLike
from jrigid.dynamics import State
from jrigid.rotation import from_axis_angle, multiply

# Of a quarter or a full turn in single precision.
_ROUNDING = 1e-6


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

    Raises:
        RuntimeError: A latitude beyond pi / 2 or a longitude beyond 2 pi, which must be
            degrees, if they are known when the function is called.

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
    demand_radians(longitude, latitude)
    return _state(longitude, latitude, period, angle)


@jax.jit  # outside of jit each operation is a program of its own
def _state(longitude: Scalar, latitude: Scalar, period: Scalar, angle: Scalar) -> State:
    """The state of `state_of_pole`."""
    z = jnp.asarray([0.0, 0.0, 1.0], period.dtype)
    tilted = attitude_of_pole(longitude, latitude)
    attitude = multiply(tilted, from_axis_angle(z, angle))
    return State(attitude, 2 * jnp.pi / period * z)


def demand_radians(longitude: Scalar, latitude: Scalar) -> None:
    """Raise RuntimeError for a pole whose numbers must be degrees, if it is known."""
    limits = {"longitude": (longitude, 2 * np.pi), "latitude": (latitude, np.pi / 2)}
    for name, (angle, largest) in limits.items():
        if is_concrete(angle) and np.abs(angle) > largest * (1 + _ROUNDING):
            raise RuntimeError(
                f"Argument `{name}` must be in radians, at most {largest:.4f} in size, "
                f"but it is {angle}: convert degrees by `numpy.deg2rad`."
            )


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
