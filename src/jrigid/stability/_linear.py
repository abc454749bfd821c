"""Small wobbles about a principal axis, by the linearised equations."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Complex, Float

from jrigid._checks import (
    all_finite,
    all_positive,
    check_option,
    check_shape,
    float_arrays,
    where_defined,
)
from jrigid._numerics import cosh_sqrt, root_of_positive, sinhc_sqrt
from jrigid._types import Real, Scalar, ScalarLike, VectorLike

Answer = TypeVar("Answer")


class Modes(NamedTuple):
    """The two small motions about a principal axis, each in proportion to exp(rate t).

    Attributes:
        rates: Growing or turning, and its opposite [1/s].
        shapes: For each the two small components of the angular velocity, those of the axes that
            follow the spin axis in cyclic order; of unit length. Both the same, at rates of 0,
            where the motion drifts; zero where nothing couples the two.
        amplitude_ratio: |second component / first|; infinite or NaN, and its slopes, where a
            coupling is zero.
    """

    rates: Complex[Array, "2"]
    shapes: Complex[Array, "2 2"]
    amplitude_ratio: Scalar


def _couplings(moments: Array, axis: int, spin: Array, rotor: Any) -> tuple[Array, Array]:
    """What couples the two small components j and k: w_j' = first w_k, w_k' = second w_j."""
    own, first, second = (moments[(axis + n) % 3] for n in range(3))
    towards = ((second - own) * spin - rotor) / first
    return towards, ((own - first) * spin + rotor) / second


def _of_couplings(
    formula: Callable[[Array, Array], Answer],
    moments: VectorLike,
    axis: int,
    spin: ScalarLike,
    rotor: ScalarLike,
) -> Answer:
    """A formula of the two couplings, NaN outside the domain of the arguments."""
    moments, spin, rotor = float_arrays(moments, spin, rotor)
    check_shape("moments", moments, (3,))
    check_shape("spin", spin, ())
    check_shape("rotor", rotor, ())
    check_option("axis", axis, (0, 1, 2))
    return where_defined(
        all_positive(moments) & all_finite((spin, rotor)),
        lambda moments, spin, rotor: formula(*_couplings(moments, axis, spin, rotor)),
        moments,
        spin,
        rotor,
    )


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
        Square of the growth rate [1/s^2]; where negative, minus the square of the frequency. NaN
        outside positive, finite moments and finite rates.

    Gradients: polynomial over moments, finite everywhere.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 37; with a rotor, Hughes, Spacecraft
    Attitude Dynamics (1986), section 6.3.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> moments = jnp.array([1.0, 2.0, 3.0])
    >>> print([jr.stability.growth_rate_squared(moments, n, 1.0).item() for n in range(3)])
    [-0.3333333333333333, 0.3333333333333333, -1.0]
    """
    return _of_couplings(lambda towards, back: towards * back, moments, axis, spin, rotor)


def growth_rate(
    moments: VectorLike, axis: int, spin: ScalarLike, rotor: ScalarLike = 0.0
) -> Scalar:
    """Rate at which a small wobble grows about a principal axis; 0 where it does not.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2.
        spin: Rate of the rotation about it [rad/s].
        rotor: Angular momentum of a rotor along the axis, relative to the body [kg m^2/s].

    Returns:
        Growth rate [1/s]. Where it is 0 the wobble turns: see `frequency`. NaN outside positive,
        finite moments and finite rates.

    Gradients: exact where it is positive; at the threshold itself, where they are infinite, 0. Use
    `growth_rate_squared`, which is smooth there, to find thresholds.
    Source: as `growth_rate_squared`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.stability.growth_rate(jnp.array([1.0, 2.0, 3.0]), 1, 2.0).round(6))
    1.154701
    """
    return _of_couplings(
        lambda towards, back: root_of_positive(towards * back), moments, axis, spin, rotor
    )


def frequency(moments: VectorLike, axis: int, spin: ScalarLike, rotor: ScalarLike = 0.0) -> Scalar:
    """Angular frequency of a small wobble about a principal axis; 0 where it grows.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2.
        spin: Rate of the rotation about it [rad/s].
        rotor: Angular momentum of a rotor along the axis, relative to the body [kg m^2/s].

    Returns:
        Angular frequency [rad/s]; NaN outside positive, finite moments and finite rates.

    Gradients: as `growth_rate`.
    Source: as `growth_rate_squared`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.stability.frequency(jnp.array([1.0, 2.0, 3.0]), 2, 2.0))
    2.0
    """
    return _of_couplings(
        lambda towards, back: root_of_positive(-towards * back), moments, axis, spin, rotor
    )


def modes(moments: VectorLike, axis: int, spin: ScalarLike, rotor: ScalarLike = 0.0) -> Modes:
    """The two small motions about spin on a principal axis.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2.
        spin: Rate of the rotation about it [rad/s].
        rotor: Angular momentum of a rotor along the axis, relative to the body [kg m^2/s].

    Returns:
        Rates, shapes, and the ratio of the amplitudes; `linearized` is the solution. NaN outside
        positive, finite moments and finite rates.

    Gradients: exact where the two rates differ.
    Source: as `growth_rate_squared`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.stability.modes(jnp.array([1.0, 2.0, 3.0]), 2, 1.0).amplitude_ratio)
    1.0
    """
    return _of_couplings(_modes, moments, axis, spin, rotor)


def _modes(towards: Array, back: Array) -> Modes:
    square = towards * back
    rate = jax.lax.complex(root_of_positive(square), root_of_positive(-square))
    rates = jnp.stack([rate, -rate])
    # (towards, rate) and (rate, back) are parallel: the longer one is the better one.
    of_first = jnp.abs(towards) >= jnp.abs(back)
    upper = jnp.where(of_first, towards.astype(rates.dtype), rates)
    lower = jnp.where(of_first, rates, back.astype(rates.dtype))
    length = root_of_positive(jnp.abs(square) + jnp.maximum(towards**2, back**2))
    length = jnp.where(length > 0, length, 1.0).astype(rates.dtype)
    shapes = jnp.stack([upper, lower], axis=1) / length
    return Modes(rates, shapes, jnp.sqrt(jnp.abs(back / towards)))


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
        NaN outside positive, finite moments, and at a time that is not finite.

    Gradients: finite everywhere, equal moments included.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 37.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> w = jnp.array([1e-3, 1.0, 0.0])
    >>> print(jr.stability.linearized(jnp.array([1.0, 2.0, 3.0]), 1, w, 5.0).round(6))
    [ 0.008995  1.       -0.005161]
    """
    moments, omega0, ts = float_arrays(moments, omega0, ts)
    check_shape("moments", moments, (3,))
    check_shape("omega0", omega0, (3,))
    check_option("axis", axis, (0, 1, 2))

    def wave(moments: Array, omega0: Array, t: Array) -> Array:
        spin, first, second = (omega0[(axis + n) % 3] for n in range(3))
        towards, back = _couplings(moments, axis, spin, 0.0)
        square = towards * back * t * t
        even, odd = cosh_sqrt(square), t * sinhc_sqrt(square)
        components = [
            spin,
            first * even + towards * odd * second,
            second * even + back * odd * first,
        ]
        return jnp.stack([components[(n - axis) % 3] for n in range(3)])

    ok = all_positive(moments) & all_finite(omega0)
    each = jax.vmap(lambda t: where_defined(ok & jnp.isfinite(t), wave, moments, omega0, t))
    return each(ts.reshape(-1)).reshape(*ts.shape, 3)
