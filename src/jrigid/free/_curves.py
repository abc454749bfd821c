"""Polhode and herpolhode, separatrix, and Poinsot's surfaces."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Real

from jrigid._checks import (
    RESULTS,
    float_arrays,
    nan_where,
)
from jrigid._numerics import safe_norm
from jrigid._spectral import eigh
from jrigid._types import InertiaLike, Scalar, ScalarLike, Vector, VectorLike
from jrigid.dynamics import State, angular_momentum, kinetic_energy
from jrigid.free._inputs import checked, in_principal_axes, motion_of
from jrigid.free._motion import free_rotation
from jrigid.rotation import rotate

# Phase on either side of the start within which the polhode of an endless motion is drawn.
_ENDLESS_PHASE = 20.0


def polhode(
    inertia: InertiaLike, omega: VectorLike, points: int = 200, *, throw: bool = True
) -> Float[Array, "{points} 3"]:
    """The curve of the angular velocity in the body, over one period from the given point.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].
        points: Number of points, equally spaced in time; the last equals the first.
        throw: False: bad values give NaN instead of an error.

    Returns:
        Body components [rad/s]. An endless motion (the separatrix) is drawn over 20 e-folding
        times before and after.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value (run time, any lane).

    Gradients: of the points at fixed fractions of the period.
    Source: Goldstein, Classical Mechanics, 3rd ed., 5.6.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> curve = jr.free.polhode(jnp.array([1.0, 2.0, 3.0]), jnp.array([0.1, 0.0, 1.0]), 5)
    >>> print(curve[2].round(6))
    [-0.1  0.   1. ]
    """
    if points < 2:
        raise ValueError(f"Argument `points` must be at least 2, but it is {points}.")
    findings, motion = motion_of(inertia, omega, throw)
    rate = jnp.sqrt(jnp.where(motion.kap + motion.v > 0, motion.kap + motion.v, 1.0))
    end = jnp.where(motion.circles, 4 * motion.quarter, _ENDLESS_PHASE / rate)
    start = jnp.where(motion.circles, 0.0, -end)
    times = jnp.linspace(start, end, points) / motion.unit
    _, (inertia, omega) = checked(inertia, omega, False)
    attitude = jnp.zeros(4, omega.dtype).at[0].set(1)
    curve = free_rotation(inertia, State(attitude, omega), times, throw=False).omega
    return nan_where(~findings.ok, curve)


def herpolhode(
    inertia: InertiaLike,
    state0: State,
    ts: Real[ArrayLike, "..."],
    *,
    t0: ScalarLike = 0.0,
    throw: bool = True,
) -> Float[Array, "... 3"]:
    """The curve of the angular velocity in space, in a plane at right angles to the momentum.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        state0: State at `t0`.
        ts: Times [s] of any shape: in general the curve never closes.
        t0: Time of `state0` [s].
        throw: False: bad values give NaN instead of an error.

    Returns:
        Space components [rad/s], with the shape of `ts` in front. Along the momentum they are
        2 E / |L|, always.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value (run time, any lane).

    Gradients: as those of `free_rotation`.
    Source: Goldstein, Classical Mechanics, 3rd ed., 5.6.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    >>> print(jr.free.herpolhode(jnp.array([1.0, 2.0, 3.0]), state0, 7.0).round(6))
    [0. 0. 1.]
    """
    states = free_rotation(inertia, state0, ts, t0=t0, throw=throw)
    shape = states.omega.shape
    turned = jax.vmap(rotate)(states.attitude.reshape(-1, 4), states.omega.reshape(-1, 3))
    return turned.reshape(shape)


class Separatrix(NamedTuple):
    """The planes through the middle axis that part the motions about axis 1 from those about 3.

    Attributes:
        momentum_ratio: |L3 / L1| on them, sqrt((I2/I1 - 1) / (1 - I2/I3)).
        omega_ratio: |omega3 / omega1| on them.
        momentum_angle: Angle of the momentum's planes from axis 1 [rad].
        omega_angle: Angle of the angular velocity's planes from axis 1 [rad].
    """

    momentum_ratio: Scalar
    omega_ratio: Scalar
    momentum_angle: Scalar
    omega_angle: Scalar


def separatrix(inertia: InertiaLike, *, throw: bool = True) -> Separatrix:
    """Where the separatrix lies; I1 < I2 < I3 are the ascending moments.

    Args:
        inertia: Principal moments in any order, or a tensor [kg m^2].
        throw: False: bad values give NaN instead of an error.

    Returns:
        Ratios and angles. For an oblate body the planes are at 0, for a prolate one at 90 degrees.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value, or a sphere, which has none (run time, any lane).

    Gradients: infinite in two equal moments, as the truth is.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 37.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.free.separatrix(jnp.array([1.0, 2.0, 3.0])).momentum_ratio.round(6))
    1.732051
    """
    (inertia,) = float_arrays(inertia)
    findings, (inertia, _) = checked(inertia, jnp.zeros(3, inertia.dtype), throw)
    moments = jnp.sort(inertia) if inertia.ndim == 1 else eigh(inertia)[0]
    i1, i2, i3 = moments
    findings.require(
        i3 > i1, RESULTS.invalid_inertia,
        "Argument `inertia` must not be that of a sphere, which has no separatrix.",
    )  # fmt: skip
    i1, i2, i3 = findings.apply((i1, i2, i3), throw)
    i1 = jnp.where(findings.ok, i1, 0.5 * i2)
    # Roots of products would have NaN slopes in the third moment where two are equal.
    low, high = jnp.sqrt(i2 - i1), jnp.sqrt(i3 - i2)
    up, across = low * jnp.sqrt(i3), high * jnp.sqrt(i1)
    omega_up, omega_across = low * jnp.sqrt(i1), high * jnp.sqrt(i3)
    return nan_where(
        ~findings.ok,
        Separatrix(
            up / across,
            omega_up / omega_across,
            jnp.arctan2(up, across),
            jnp.arctan2(omega_up, omega_across),
        ),
    )


class Poinsot(NamedTuple):
    """Poinsot's surfaces: the momentum stays on a sphere and on an ellipsoid, in the body.

    Attributes:
        sphere_radius: |L| [kg m^2/s].
        momentum_ellipsoid: Semi-axes sqrt(2 E I) of the ellipsoid of constant energy on which the
            momentum moves [kg m^2/s], in the order of the moments.
        omega_ellipsoid: Semi-axes sqrt(2 E / I) of the ellipsoid of the angular velocity [rad/s],
            which rolls on the invariable plane.
        plane_distance: Distance 2 E / |L| of that plane from the centre [rad/s].
    """

    sphere_radius: Scalar
    momentum_ellipsoid: Vector
    omega_ellipsoid: Vector
    plane_distance: Scalar


def poinsot(inertia: InertiaLike, omega: VectorLike, *, throw: bool = True) -> Poinsot:
    """Poinsot's sphere, ellipsoids and invariable plane.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].
        throw: False: bad values give NaN instead of an error.

    Returns:
        Radius, semi-axes along the principal axes, and the distance of the plane; zeros at rest.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value (run time, any lane).

    Gradients: finite; zero at rest.
    Source: Goldstein, Classical Mechanics, 3rd ed., 5.6.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> surfaces = jr.free.poinsot(jnp.array([1.0, 1.0, 4.0]), jnp.array([0.0, 0.0, 2.0]))
    >>> print(surfaces.sphere_radius, surfaces.momentum_ellipsoid)
    8.0 [4. 4. 8.]
    """
    findings, (inertia, omega) = checked(inertia, omega, throw)
    moments, omega = in_principal_axes(inertia, omega)
    momentum = safe_norm(angular_momentum(moments, omega))
    twice = 2 * kinetic_energy(moments, omega)
    root = safe_norm(jnp.sqrt(moments) * omega)
    resting = momentum == 0
    distance = jnp.where(resting, 0.0, twice / jnp.where(resting, 1.0, momentum))
    answer = Poinsot(momentum, root * jnp.sqrt(moments), root / jnp.sqrt(moments), distance)
    return nan_where(~findings.ok, answer)
