"""State of a turning body, angular momentum, kinetic energy, Euler's equations."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jrigid._checks import (
    INERTIA,
    check_shape,
    float_arrays,
    internal_parts,
    shaped,
    state_array,
)
from jrigid._core.compile import one_program
from jrigid._public import list_public_names
from jrigid._types import InertiaLike, Readable, Scalar, Vector, VectorLike


class State(Readable):
    """State of a body that turns about a fixed point or its centre of mass.

    Attributes:
        attitude: Unit quaternion, scalar first, body to space.
        omega: Angular velocity, body components [rad/s].
        internal: A tuple with an entry for each torque that carries parts, in the order
            of the torques (see `jrigid.torques`): that of one wheel is `(spin,)`. None
            if there are no parts, and before `system.with_parts(state)`, or `simulate`,
            adds parts at rest in the body.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.1, 0.0, 5.0]))
    >>> print(state.omega)
    [0.1 0.  5. ]
    """

    attitude: Float[Array, "*batch 4"] = eqx.field(converter=state_array)
    omega: Float[Array, "*batch 3"] = eqx.field(converter=state_array)
    internal: Any = eqx.field(default=(), converter=internal_parts)


class ExactStates(Readable):
    """States of an exact motion, and a result code.

    Attributes:
        states: State at each time; the leading axes of its leaves are those of the
            times.
        result: `jrigid.RESULTS.successful`, or a code for an error in the arguments;
            one for each lane under vmap. `jrigid.RESULTS[motion.result]` is its text.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    >>> inertia, ts = jnp.array([1.0, 1.0, 2.0]), jnp.array([0.0, jnp.pi])
    >>> motion = jr.free_rotation(inertia, state0, ts)
    >>> print(motion.omega[1, 2], motion.result == jr.RESULTS.successful)
    1.0 True
    """

    states: State
    result: Any

    @property
    def attitude(self) -> Float[Array, "... 4"]:
        """Unit quaternions, scalar first, body to space."""
        return self.states.attitude

    @property
    def omega(self) -> Float[Array, "... 3"]:
        """Angular velocities, body components [rad/s]."""
        return self.states.omega


def _inertia_and_vector(
    inertia: InertiaLike, vector: VectorLike
) -> tuple[Array, Array]:
    inertia, vector = shaped(inertia=(inertia, *INERTIA), omega=(vector, 3))
    return inertia, vector


def _inertia_times(inertia: Array, vector: Array) -> tuple[Array, ...]:
    """Components of I v, written out so that XLA fuses them, without a dot."""
    a, b, c = vector
    if inertia.ndim == 1:
        return inertia[0] * a, inertia[1] * b, inertia[2] * c
    return tuple(
        inertia[i, 0] * a + inertia[i, 1] * b + inertia[i, 2] * c for i in range(3)
    )


def _inverse_times(inertia: Array, vector: Array) -> Array:
    """I^-1 v for a symmetric tensor, through the cofactors."""
    if inertia.ndim == 1:
        return vector / inertia
    # In units of the largest moment, since a product of three moments can be out of the
    # range of float32.
    # The largest entry of a positive definite tensor is on its diagonal. The unit
    # cancels, so that it needs no derivative.
    unit = jax.lax.stop_gradient(jnp.max(jnp.diagonal(inertia)))
    inertia = inertia / unit
    vector = vector / unit
    a, b, c = inertia[0, 0], inertia[1, 1], inertia[2, 2]
    d, e, f = inertia[0, 1], inertia[0, 2], inertia[1, 2]
    # Cofactors of the entries with the same letters.
    aa = b * c - f * f
    bb = a * c - e * e
    cc = a * b - d * d
    dd = e * f - d * c
    ee = d * f - b * e
    ff = d * e - a * f
    determinant = a * aa + d * dd + e * ee
    x, y, z = vector
    rows = [
        aa * x + dd * y + ee * z,
        dd * x + bb * y + ff * z,
        ee * x + ff * y + cc * z,
    ]
    return jnp.stack(rows) / determinant


@one_program
def angular_momentum(inertia: InertiaLike, omega: VectorLike) -> Vector:
    """Angular momentum I omega, body components.

    Args:
        inertia: Principal moments or symmetric tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        Angular momentum [kg m^2/s], body components; `rotation.rotate` takes it to
        space.

    Gradients: bilinear, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> inertia, omega = jnp.array([1.0, 2.0, 3.0]), jnp.array([1.0, 1.0, 1.0])
    >>> print(jr.angular_momentum(inertia, omega))
    [1. 2. 3.]
    """
    return jnp.stack(_inertia_times(*_inertia_and_vector(inertia, omega)))


@one_program
def kinetic_energy(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Rotational kinetic energy, omega . I omega / 2.

    Args:
        inertia: Principal moments or symmetric tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        Energy [J].

    Gradients: finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.kinetic_energy(jnp.array([1.0, 2.0, 3.0]), jnp.array([1.0, 1.0, 1.0])))
    3.0
    """
    tensor, w = _inertia_and_vector(inertia, omega)
    a, b, c = _inertia_times(tensor, w)
    return 0.5 * (w[0] * a + w[1] * b + w[2] * c)


@one_program
def euler_equations(
    inertia: InertiaLike, omega: VectorLike, torque: VectorLike | None = None
) -> Vector:
    """Euler's equations: the rate of the angular velocity in body components.

    I omega' = N - omega x (I omega). Moments may be any positive numbers, also those
    that violate the triangle inequality.

    Args:
        inertia: Principal moments or symmetric tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].
        torque: Torque N, body components [N m]; none by default.

    Returns:
        omega' [rad/s^2], body components.

    Gradients: finite everywhere.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., eq. 36.5.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> inertia, omega = jnp.array([1.0, 2.0, 3.0]), jnp.array([1.0, 1.0, 1.0])
    >>> print(jr.euler_equations(inertia, omega))
    [-1.          1.         -0.33333333]
    """
    tensor, w = _inertia_and_vector(inertia, omega)
    gyroscopic = _momentum_cross_omega(tensor, w)
    if torque is not None:
        tensor, gyroscopic, torque = float_arrays(tensor, gyroscopic, torque)
        check_shape("torque", torque, (3,))
        gyroscopic = gyroscopic + torque
    return _inverse_times(tensor, gyroscopic)


def _momentum_cross_omega(inertia: Array, omega: Array) -> Array:
    """(I omega) x omega, which is exactly zero for a sphere."""
    a, b, c = omega
    if inertia.ndim == 1:
        # Differences of moments are exactly zero for a sphere.
        i1, i2, i3 = inertia
        return jnp.stack([(i2 - i3) * b * c, (i3 - i1) * c * a, (i1 - i2) * a * b])
    # An isotropic part of the tensor has no effect. Without it the tensor of a sphere
    # is exactly zero.
    i = inertia
    shift = inertia[2, 2]
    p = (i[0, 0] - shift) * a + i[0, 1] * b + i[0, 2] * c
    q = i[1, 0] * a + (i[1, 1] - shift) * b + i[1, 2] * c
    # The shift makes the third entry of the diagonal zero.
    r = i[2, 0] * a + i[2, 1] * b
    return jnp.stack([q * c - r * b, r * a - p * c, p * b - q * a])


@one_program
def bearing_torque(inertia: InertiaLike, omega: VectorLike) -> Vector:
    """Torque of the supports that keep a rotation steady: omega x (I omega).

    Args:
        inertia: Principal moments or symmetric tensor [kg m^2], about a point on the
            axis.
        omega: The constant angular velocity, body components [rad/s].

    Returns:
        Torque on the body [N m], body components; zero about a principal axis.

    Gradients: finite everywhere.
    Source: Goldstein, Classical Mechanics, 3rd ed., eq. 5.39 with omega' = 0.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.bearing_torque(jnp.array([1.0, 2.0, 3.0]), jnp.array([1.0, 1.0, 1.0])))
    [ 1. -2.  1.]
    """
    return -_momentum_cross_omega(*_inertia_and_vector(inertia, omega))


list_public_names(__name__)
