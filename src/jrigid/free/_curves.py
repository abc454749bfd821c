"""Polhode and herpolhode, separatrix, and Poinsot's surfaces."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jrigid._checks import where_defined, whole_number
from jrigid._core.compile import one_program, quick_jit
from jrigid._numerics import safe_norm
from jrigid._spectral import eigh
from jrigid._types import InertiaLike, Real, Scalar, ScalarLike, Vector, VectorLike
from jrigid.dynamics import State, angular_momentum, kinetic_energy
from jrigid.free._free_rotation import (
    free_rotation,
    in_principal_axes,
    relative_rotation,
    where_moving,
)
from jrigid.free._jacobi_solution import invariants
from jrigid.rotation import rotate

# The polhode of an endless motion is drawn within this phase of the start. exp(-20) is
# 2e-9, so from a point well off the intermediate axis both ends reach that axis.
_ENDLESS_PHASE = 20.0


def polhode(
    inertia: InertiaLike, omega: VectorLike, points: int = 200
) -> Float[Array, "{points} 3"]:
    """Curve of the angular velocity in the body, over one period.

    The curve is closed and does not depend on the attitude, so inertia and one of its
    points define it. The points at given times are `free_rotation(...).omega`. In space
    the curve is `herpolhode`.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].
        points: Number of points, equally spaced in time; the last equals the first.

    Returns:
        Body components [rad/s]. An endless motion (the separatrix) is drawn over 20
        e-folding times before and after the given point. NaN outside positive definite
        inertia and finite rates.

    Gradients: of the points at fixed fractions of the period.
    Source: Goldstein, Classical Mechanics, 3rd ed., 5.6.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> moments, omega = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.1, 0.0, 1.0])
    >>> curve = jr.free.polhode(moments, omega, 5)
    >>> print(curve[2].round(6))
    [-0.1  0.   1. ]
    """
    count = whole_number("points", points, 2)
    return where_moving(partial(_polhode, count), inertia, omega=omega)


@quick_jit  # outside of jit each operation is a program of its own
def _polhode(count: int, inertia: Array, omega: Array) -> Float[Array, "{count} 3"]:
    """The curve of `polhode`."""
    motion = invariants(*in_principal_axes(inertia, omega))
    square = motion.kap + motion.v
    # On the separatrix the angular momentum approaches the axis as exp(-sqrt(Q) t),
    # with Q = kap + v.
    endless = _ENDLESS_PHASE / jnp.sqrt(jnp.where(square > 0, square, 1.0))
    end = jnp.where(motion.circles, 4 * motion.quarter, endless)
    start = jnp.where(motion.circles, 0.0, -end)
    # The invariants are in units in which rates are of order one.
    times = jnp.linspace(start, end, count) / motion.unit

    def at_time(t: Array) -> Array:
        _, omega_then = relative_rotation(inertia, omega, t)
        return omega_then

    return jax.vmap(at_time)(times)


@one_program
def herpolhode(
    inertia: InertiaLike,
    state0: State,
    ts: Real[ArrayLike, "..."],
    *,
    t0: ScalarLike = 0.0,
) -> Float[Array, "... 3"]:
    """Curve of the angular velocity in space, in a plane normal to the momentum.

    In general the curve never closes, so the times are arguments. Its rate is that of
    the precession and not of the polhode: the Earth's herpolhode goes round in a day,
    its polhode in 305 days. The attitude defines where it lies in space.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        state0: State at `t0`, without internal parts.
        ts: Times [s] of any shape.
        t0: Time of `state0` [s].

    Returns:
        Space components [rad/s], with the shape of `ts` in front. The component along
        the momentum is always 2 E / |L|. NaN outside positive definite inertia, unit
        attitude and finite values.

    Gradients: as those of `free_rotation`.
    Source: Goldstein, Classical Mechanics, 3rd ed., 5.6.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    >>> print(jr.free.herpolhode(jnp.array([1.0, 2.0, 3.0]), state0, 7.0).round(6))
    [0. 0. 1.]
    """
    motion = free_rotation(inertia, state0, ts, t0=t0, throw=False)
    return jnp.vectorize(rotate, signature="(4),(3)->(3)")(
        motion.attitude, motion.omega
    )


class Separatrix(NamedTuple):
    """Planes through the intermediate axis that divide the motions about the other two.

    I1 < I2 < I3, and the components of L and omega are in the same order.

    Attributes:
        momentum_ratio: |L3 / L1| on them, sqrt((I2/I1 - 1) / (1 - I2/I3)).
        omega_ratio: |omega3 / omega1| on them.
        momentum_angle: Angle of the momentum's planes from the axis of I1 [rad].
        omega_angle: Angle of the angular velocity's planes from the axis of I1 [rad].
    """

    momentum_ratio: Scalar
    omega_ratio: Scalar
    momentum_angle: Scalar
    omega_angle: Scalar


@one_program
def separatrix(inertia: InertiaLike) -> Separatrix:
    """Position of the separatrix; I1 < I2 < I3 are the ascending moments.

    Args:
        inertia: Principal moments in any order, or a tensor [kg m^2].

    Returns:
        Ratios and angles. For an oblate body the planes are at 0, for a prolate one at
        90 degrees. NaN for a sphere, which has none, and outside positive definite
        inertia.

    Gradients: infinite at two equal moments, where the derivative is infinite.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 37.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.free.separatrix(jnp.array([1.0, 2.0, 3.0])).momentum_ratio.round(6))
    1.732051
    """

    def of_body(inertia: Array) -> Separatrix:
        i1, i2, i3 = jnp.sort(inertia) if inertia.ndim == 1 else eigh(inertia)[0]
        return where_defined(i3 > i1, _planes, i1, i2, i3)

    return where_moving(of_body, inertia)


def _planes(i1: Array, i2: Array, i3: Array) -> Separatrix:
    """The planes of a body that is no sphere."""
    # Roots of products would have NaN slopes in the third moment where two are equal.
    # On the separatrix al L1^2 = be L3^2, in the letters of `_jacobi_solution.py`, so
    # |L3 / L1| = sqrt(I3 (I2 - I1) / (I1 (I3 - I2))).
    low = jnp.sqrt(i2 - i1)
    high = jnp.sqrt(i3 - i2)
    up = low * jnp.sqrt(i3)
    across = high * jnp.sqrt(i1)
    omega_up = low * jnp.sqrt(i1)
    omega_across = high * jnp.sqrt(i3)
    angles = jnp.arctan2(up, across), jnp.arctan2(omega_up, omega_across)
    return Separatrix(up / across, omega_up / omega_across, *angles)


class Poinsot(NamedTuple):
    """Poinsot's surfaces: the sphere and the ellipsoids of a motion, in the body.

    The momentum stays on a sphere and on an ellipsoid.

    Attributes:
        sphere_radius: |L| [kg m^2/s].
        momentum_ellipsoid: Semi-axes sqrt(2 E I) of the ellipsoid of constant energy on
            which the momentum moves [kg m^2/s], in the order of the moments.
        omega_ellipsoid: Semi-axes sqrt(2 E / I) of the ellipsoid of the angular
            velocity [rad/s], which rolls on the invariable plane.
        plane_distance: Distance 2 E / |L| of that plane from the centre [rad/s].
    """

    sphere_radius: Scalar
    momentum_ellipsoid: Vector
    omega_ellipsoid: Vector
    plane_distance: Scalar


@one_program
def poinsot(inertia: InertiaLike, omega: VectorLike) -> Poinsot:
    """Poinsot's sphere, ellipsoids and invariable plane.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        Radius, semi-axes along the principal axes, and the distance of the plane; zeros
        at rest. NaN outside positive definite inertia and finite rates.

    Gradients: finite; zero at rest.
    Source: Goldstein, Classical Mechanics, 3rd ed., 5.6.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> moments, omega = jnp.array([1.0, 1.0, 4.0]), jnp.array([0.0, 0.0, 2.0])
    >>> surfaces = jr.free.poinsot(moments, omega)
    >>> print(surfaces.sphere_radius, surfaces.momentum_ellipsoid)
    8.0 [4. 4. 8.]
    """

    def surfaces(inertia: Array, omega: Array) -> Poinsot:
        moments, omega = in_principal_axes(inertia, omega)
        momentum = safe_norm(angular_momentum(moments, omega))
        twice = 2 * kinetic_energy(moments, omega)
        # This is sqrt(2 E). As a norm it has the gradient 0 at rest, where a root gives
        # NaN.
        root = safe_norm(jnp.sqrt(moments) * omega)
        resting = momentum == 0
        distance = jnp.where(resting, 0.0, twice / jnp.where(resting, 1.0, momentum))
        return Poinsot(
            momentum, root * jnp.sqrt(moments), root / jnp.sqrt(moments), distance
        )

    return where_moving(surfaces, inertia, omega=omega)
