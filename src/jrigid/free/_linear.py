"""Small wobbles about a principal axis, by the linearised equations."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Real

from jrigid._checks import (
    check_option,
    check_shape,
    float_arrays,
)
from jrigid._numerics import cosh_sqrt, sinhc_sqrt
from jrigid._types import Scalar, ScalarLike, VectorLike


def growth_rate_squared(
    moments: VectorLike, axis: int, spin: ScalarLike, rotor: ScalarLike = 0.0
) -> Scalar:
    """Square of the rate at which a small wobble grows about a principal axis.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2.
        spin: Rate of the rotation about it [rad/s].
        rotor: Angular momentum of a rotor along the axis, relative to the body [kg m^2/s].

    Returns:
        Square of the growth rate [1/s^2]; where negative, minus the square of the frequency.

    Raises:
        ValueError: Wrong shape or axis (trace time). Values are not checked.

    Gradients: polynomial over moments, finite everywhere.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 37; with a rotor, Hughes, Spacecraft
    Attitude Dynamics (1986), section 6.3.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> moments = jnp.array([1.0, 2.0, 3.0])
    >>> print([jr.free.growth_rate_squared(moments, n, 1.0).item() for n in range(3)])
    [-0.3333333333333333, 0.3333333333333333, -1.0]
    """
    towards, back, _, _ = linear_rates(moments, axis, spin, rotor)
    return towards * back


def linear_rates(
    moments: Any, axis: int, spin: Any, rotor: Any = 0.0
) -> tuple[Array, Array, int, int]:
    """What couples the two small components j and k: w_j' = first w_k, w_k' = second w_j."""
    moments, spin, rotor = float_arrays(moments, spin, rotor)
    check_shape("moments", moments, (3,))
    check_shape("spin", spin, ())
    check_shape("rotor", rotor, ())
    check_option("axis", axis, (0, 1, 2))
    j, k = (axis + 1) % 3, (axis + 2) % 3
    own, first, second = moments[axis], moments[j], moments[k]
    towards = ((second - own) * spin - rotor) / first
    return towards, ((own - first) * spin + rotor) / second, j, k


def linearized(
    moments: VectorLike, axis: int, omega0: VectorLike, ts: Real[ArrayLike, "..."]
) -> Float[Array, "... 3"]:
    """Angular velocity of a small wobble about a principal axis, by the linearised equations.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2: the axis that `omega0` is near.
        omega0: Angular velocity at time 0, body components [rad/s].
        ts: Times [s] of any shape.

    Returns:
        Body components [rad/s]; the error is of the order of the wobble squared, while it is small.

    Raises:
        ValueError: Wrong shape or axis (trace time). Values are not checked.

    Gradients: finite everywhere, equal moments included.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 37.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> w = jnp.array([1e-3, 1.0, 0.0])
    >>> print(jr.free.linearized(jnp.array([1.0, 2.0, 3.0]), 1, w, 5.0).round(6))
    [ 0.008995  1.       -0.005161]
    """
    moments, omega0, ts = float_arrays(moments, omega0, ts)
    check_shape("omega0", omega0, (3,))
    towards, back, j, k = linear_rates(moments, axis, omega0[axis])
    square = towards * back * ts * ts
    even, odd = cosh_sqrt(square), ts * sinhc_sqrt(square)
    wave = [jnp.full(ts.shape, omega0[n]) for n in range(3)]
    wave[j] = omega0[j] * even + towards * odd * omega0[k]
    wave[k] = omega0[k] * even + back * odd * omega0[j]
    return jnp.stack(wave, axis=-1)
