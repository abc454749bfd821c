"""The free symmetric body: its wobble, its precession and their cones."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._checks import (
    RESULTS,
    Findings,
    nan_where,
)
from jrigid._numerics import safe_arctan2, safe_norm
from jrigid._types import InertiaLike, Scalar, VectorLike
from jrigid.free._inputs import checked


class ConeAngles(NamedTuple):
    """Angles of the cones that a symmetric body's motion draws [rad].

    Attributes:
        omega: Between angular velocity and axis 3, the half-angle of the body cone (alpha).
        momentum: Between angular momentum and axis 3 (theta): tan theta = (I1/I3) tan alpha.
        space: Between angular velocity and momentum, the half-angle of the space cone,
            |alpha - theta|. The three lines lie in a plane: the momentum between the axis and the
            angular velocity for an oblate body, the angular velocity between the two for a
            prolate one.
    """

    omega: Scalar
    momentum: Scalar
    space: Scalar


def _symmetric(inertia: Any, omega: Any, throw: bool) -> tuple[Findings, Array, Array, Array]:
    findings, (inertia, omega) = checked(inertia, omega, throw)
    tensor = inertia if inertia.ndim == 2 else jnp.diag(inertia)
    rest = jnp.stack([tensor[0, 0] - tensor[1, 1], tensor[0, 1], tensor[0, 2], tensor[1, 2]])
    eps = jnp.finfo(tensor.dtype).eps
    tolerance = jnp.sqrt(eps) * jnp.abs(tensor[2, 2] - tensor[0, 0])
    tolerance = tolerance + 16 * eps * jnp.max(jnp.abs(tensor))
    findings.require(
        jnp.all(jnp.abs(jax.lax.stop_gradient(rest)) <= tolerance),
        RESULTS.invalid_inertia,
        "Argument `inertia` must be symmetric about axis 3 (I1 = I2, I3), but it is not: for any "
        "other body ask for `polhode_period` and `mean_precession_rate`.",
    )
    tensor, omega = findings.apply((tensor, omega), throw)
    return findings, 0.5 * (tensor[0, 0] + tensor[1, 1]), tensor[2, 2], omega


def wobble_rate(inertia: InertiaLike, omega: VectorLike, *, throw: bool = True) -> Scalar:
    """Rate at which the pole of a symmetric body turns in the body, (I3/I1 - 1) omega3.

    Args:
        inertia: Moments (I1, I1, I3) or tensor symmetric about axis 3 [kg m^2].
        omega: Angular velocity, body components [rad/s].
        throw: False: bad values give NaN instead of an error.

    Returns:
        The rate [rad/s], positive when the pole turns about +axis 3, as seen in the body.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value, or a body not symmetric about axis 3 (run time, any lane).

    Gradients: in I1 and I2 those of the linearised wobble of a body with I1 near I2.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 36.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> earth = jnp.array([1.0, 1.0, 1.00327])
    >>> print((1 / jr.free.wobble_rate(earth, jnp.array([0.0, 0.0, 1.0]))).round(1))  # days
    305.8
    """
    findings, i1, i3, w = _symmetric(inertia, omega, throw)
    return nan_where(~findings.ok, (i3 - i1) / i1 * w[2])


def precession_rate(inertia: InertiaLike, omega: VectorLike, *, throw: bool = True) -> Scalar:
    """Rate at which the axis of a symmetric body turns about its momentum in space, |L| / I1.

    Args:
        inertia: Moments (I1, I1, I3) or tensor symmetric about axis 3 [kg m^2].
        omega: Angular velocity, body components [rad/s].
        throw: False: bad values give NaN instead of an error.

    Returns:
        The rate [rad/s]; of any other body `mean_precession_rate` is the mean.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value, or a body not symmetric about axis 3 (run time, any lane).

    Gradients: finite; zero at rest.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., eq. 33.5.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.free.precession_rate(jnp.array([1.0, 1.0, 1.5]), jnp.array([0.0, 0.0, 2.0])))
    3.0
    """
    findings, i1, i3, w = _symmetric(inertia, omega, throw)
    momentum = jnp.stack([i1 * w[0], i1 * w[1], i3 * w[2]])
    return nan_where(~findings.ok, safe_norm(momentum) / i1)


def cone_angles(inertia: InertiaLike, omega: VectorLike, *, throw: bool = True) -> ConeAngles:
    """Angles between axis, angular velocity and momentum of a symmetric body.

    Args:
        inertia: Moments (I1, I1, I3) or tensor symmetric about axis 3 [kg m^2].
        omega: Angular velocity, body components [rad/s].
        throw: False: bad values give NaN instead of an error.

    Returns:
        Half-angles of body and space cone, and the angle of the momentum [rad].

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value, or a body not symmetric about axis 3 (run time, any lane).

    Gradients: finite; right where no angle is zero and omega3 is not. At zero wobble, where the
    angles have a kink, zero.
    Source: Goldstein, Classical Mechanics, 3rd ed., 5.6.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> angles = jr.free.cone_angles(jnp.array([1.0, 1.0, 2.0]), jnp.array([1.0, 0.0, 1.0]))
    >>> print(jnp.degrees(jnp.stack(angles)).round(3))
    [45.    26.565 18.435]
    """
    findings, i1, i3, w = _symmetric(inertia, omega, throw)
    across = safe_norm(w[:2])
    alpha, theta = safe_arctan2(across, w[2]), safe_arctan2(i1 * across, i3 * w[2])
    # tan(alpha - theta), without the difference of two angles
    space = safe_arctan2(
        jnp.abs(i3 - i1) * across * jnp.abs(w[2]), i1 * across * across + i3 * w[2] * w[2]
    )
    return nan_where(~findings.ok, ConeAngles(alpha, theta, space))
