"""The free symmetric body: its wobble, its precession and their cones."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._checks import where_defined
from jrigid._core.compile import one_program
from jrigid._numerics import safe_arctan2, safe_norm
from jrigid._types import InertiaLike, Scalar, VectorLike
from jrigid.free._free_rotation import where_moving

Tree = TypeVar("Tree")


class ConeAngles(NamedTuple):
    """Angles of the cones that a symmetric body's motion draws [rad].

    Attributes:
        omega: Angle alpha between angular velocity and axis of symmetry, the half-angle
            of the body cone.
        momentum: Angle theta between angular momentum and axis of symmetry, with
            tan theta = (I1/I3) tan alpha.
        space: Angle |alpha - theta| between angular velocity and momentum, the
            half-angle of the space cone. The three lines lie in a plane. For an oblate
            body the momentum lies between axis and angular velocity, and for a prolate
            one the angular velocity lies between axis and momentum.
    """

    omega: Scalar
    momentum: Scalar
    space: Scalar


def _where_symmetric(
    formula: Callable[[Array, Array, Array], Tree],
    inertia: InertiaLike,
    omega: VectorLike,
) -> Tree:
    """Apply a formula of I1, I3 and the rates; NaN if axis 3 is no axis of symmetry."""

    def of_body(inertia: Array, omega: Array) -> Tree:
        tensor = inertia if inertia.ndim == 2 else jnp.diag(inertia)
        i1, i2, i3 = jnp.diagonal(tensor)
        uneven = jnp.stack([i1 - i2, tensor[0, 1], tensor[0, 2], tensor[1, 2]])
        # With the mean of I1 and I2 the wobble rate is right to second order in their
        # difference. So sqrt(eps) of I3 - I1 leaves an error of rounding.
        eps = jnp.finfo(tensor.dtype).eps
        tolerance = jnp.sqrt(eps) * jnp.abs(i3 - i1) + 16 * eps * jnp.max(
            jnp.abs(tensor)
        )
        even = jnp.all(jnp.abs(jax.lax.stop_gradient(uneven)) <= tolerance)
        return where_defined(even, formula, 0.5 * (i1 + i2), i3, omega)

    return where_moving(of_body, inertia, omega=omega)


@one_program
def wobble_rate(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Rate at which the pole of a symmetric body turns in the body, (I3/I1 - 1) omega3.

    Args:
        inertia: Moments (I1, I1, I3) or a tensor that is symmetric about the third axis
            (index 2) [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        The rate [rad/s], positive if the pole turns about the third axis in the
        right-handed sense, as seen in the body. NaN for any other body (use
        `polhode_period`), and outside positive moments and finite rates.

    Gradients: in I1 and I2 those of the linearised wobble of a body with I1 near I2.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 36.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> earth = jnp.array([1.0, 1.0, 1.00327])
    >>> rate = jr.free.wobble_rate(earth, jnp.array([0.0, 0.0, 1.0]))  # [1/day]
    >>> print((1 / rate).round(1))
    305.8
    """
    return _where_symmetric(lambda i1, i3, w: (i3 - i1) / i1 * w[2], inertia, omega)


@one_program
def precession_rate(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Rate |L| / I1 at which the axis of a symmetric body precesses in space.

    Args:
        inertia: Moments (I1, I1, I3) or a tensor that is symmetric about the third axis
            (index 2) [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        The rate [rad/s]. NaN for any other body (`mean_precession_rate` is the mean),
        and outside positive moments and finite rates.

    Gradients: finite; zero at rest.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., eq. 33.5.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> moments, omega = jnp.array([1.0, 1.0, 1.5]), jnp.array([0.0, 0.0, 2.0])
    >>> print(jr.free.precession_rate(moments, omega))
    3.0
    """

    def rate(i1: Array, i3: Array, w: Array) -> Scalar:
        return safe_norm(jnp.stack([w[0], w[1], i3 / i1 * w[2]]))

    return _where_symmetric(rate, inertia, omega)


@one_program
def cone_angles(inertia: InertiaLike, omega: VectorLike) -> ConeAngles:
    """Angles between axis, angular velocity and momentum of a symmetric body.

    Args:
        inertia: Moments (I1, I1, I3) or a tensor that is symmetric about the third axis
            (index 2) [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        Half-angles of body and space cone, and the angle of the momentum [rad]. NaN for
        any other body, and outside positive moments and finite rates.

    Gradients: finite, and right where neither an angle nor omega3 is zero. At zero
    wobble, where the angles have a kink, zero.
    Source: Goldstein, Classical Mechanics, 3rd ed., 5.6.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> moments, omega = jnp.array([1.0, 1.0, 2.0]), jnp.array([1.0, 0.0, 1.0])
    >>> angles = jr.free.cone_angles(moments, omega)
    >>> print(jnp.degrees(jnp.stack(angles)).round(3))
    [45.    26.565 18.435]
    """

    def angles(i1: Array, i3: Array, w: Array) -> ConeAngles:
        # Without wobble a plain norm would have a NaN derivative.
        across = safe_norm(w[:2])
        along = w[2]
        # tan(alpha - theta), without the difference of two angles
        space = safe_arctan2(
            jnp.abs(i3 - i1) * across * jnp.abs(along),
            i1 * across * across + i3 * along * along,
        )
        return ConeAngles(
            safe_arctan2(across, along), safe_arctan2(i1 * across, i3 * along), space
        )

    return _where_symmetric(angles, inertia, omega)
