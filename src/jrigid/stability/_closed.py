"""Closed forms: small wobbles about a principal axis, sleeping and precessing tops, satellites."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from jrigid._checks import (
    Enumeration,
    all_finite,
    all_positive,
    check_option,
    check_shape,
    check_type,
    float_arrays,
    shaped,
    where_defined,
)
from jrigid._numerics import cosh_sqrt, root_of_positive, sinhc_sqrt
from jrigid._types import Real, Scalar, ScalarLike, VectorLike
from jrigid.top import SymmetricTop, steady_precession

Answer = TypeVar("Answer")
# Moments of a flat body, of which one is the sum of the others, pass with this many
# eps.
_FLAT = 8


class Modes(NamedTuple):
    """The two small motions about a principal axis, each in proportion to exp(rate t).

    Attributes:
        rates: Growing or turning, and its opposite [1/s].
        shapes: For each the two small components of the angular velocity, those of the
            axes that follow the spin axis in cyclic order; of unit length. Both the
            same, at rates of 0, where the motion drifts; zero where nothing couples the
            two.
        amplitude_ratio: |second component / first|; infinite or NaN, and its slopes,
            where a coupling is zero.
    """

    rates: Complex[Array, "2"]
    shapes: Complex[Array, "2 2"]
    amplitude_ratio: Scalar


def _of_couplings(
    formula: Callable[..., Answer],
    moments: VectorLike,
    axis: int,
    spin: ScalarLike,
    rotor: ScalarLike,
    *others: ArrayLike,
) -> Answer:
    """A formula of what couples the two small components j and k, and of others.

    w_j' = towards w_k, w_k' = back w_j. NaN outside the domain of the arguments.
    """
    check_option("axis", axis, (0, 1, 2))
    moments, spin, rotor = shaped(moments=(moments, 3), spin=(spin,), rotor=(rotor,))
    moments, spin, rotor, *arrays = float_arrays(moments, spin, rotor, *others)

    def of_arrays(moments: Array, spin: Array, rotor: Array, *others: Array) -> Answer:
        own, first, second = jnp.roll(moments, -axis)
        towards = ((second - own) * spin - rotor) / first
        return formula(towards, ((own - first) * spin + rotor) / second, *others)

    ok = all_positive(moments) & all_finite((spin, rotor, arrays))
    return where_defined(ok, of_arrays, moments, spin, rotor, *arrays)


def growth_rate_squared(
    moments: VectorLike, axis: int, spin: ScalarLike, rotor: ScalarLike = 0.0
) -> Scalar:
    """Square of the rate at which a small wobble grows about a principal axis.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2.
        spin: Rate of the rotation about it [rad/s].
        rotor: Angular momentum of a rotor along the axis, relative to the body [kg
            m^2/s].

    Returns:
        Square of the growth rate [1/s^2]; where negative, minus the square of the
        frequency. NaN outside positive, finite moments and finite rates.

    Gradients: polynomial over moments, finite everywhere.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 37; with a rotor, Hughes,
    Spacecraft Attitude Dynamics (1986), section 6.3.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> moments = jnp.array([1.0, 2.0, 3.0])
    >>> print([jr.stability.growth_rate_squared(moments, n, 1.0).item() for n in range(3)])
    [-0.3333333333333333, 0.3333333333333333, -1.0]
    """
    return _of_couplings(
        lambda towards, back: towards * back, moments, axis, spin, rotor
    )


def growth_rate(
    moments: VectorLike, axis: int, spin: ScalarLike, rotor: ScalarLike = 0.0
) -> Scalar:
    """Rate at which a small wobble grows about a principal axis; 0 where it does not.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2.
        spin: Rate of the rotation about it [rad/s].
        rotor: Angular momentum of a rotor along the axis, relative to the body [kg
            m^2/s].

    Returns:
        Growth rate [1/s]. Where it is 0 the wobble turns: see `frequency`. NaN outside
        positive, finite moments and finite rates.

    Gradients: exact where it is positive; at the threshold itself, where they are
    infinite, 0. Use `growth_rate_squared`, which is smooth there, to find thresholds.
    Source: as `growth_rate_squared`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.stability.growth_rate(jnp.array([1.0, 2.0, 3.0]), 1, 2.0).round(6))
    1.154701
    """
    return _of_couplings(
        lambda towards, back: root_of_positive(towards * back),
        moments,
        axis,
        spin,
        rotor,
    )


def frequency(
    moments: VectorLike, axis: int, spin: ScalarLike, rotor: ScalarLike = 0.0
) -> Scalar:
    """Angular frequency of a small wobble about a principal axis; 0 where it grows.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2.
        spin: Rate of the rotation about it [rad/s].
        rotor: Angular momentum of a rotor along the axis, relative to the body [kg
            m^2/s].

    Returns:
        Angular frequency [rad/s]; NaN outside positive, finite moments and finite
        rates.

    Gradients: as `growth_rate`.
    Source: as `growth_rate_squared`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.stability.frequency(jnp.array([1.0, 2.0, 3.0]), 2, 2.0))
    2.0
    """
    return _of_couplings(
        lambda towards, back: root_of_positive(-towards * back),
        moments,
        axis,
        spin,
        rotor,
    )


def modes(
    moments: VectorLike, axis: int, spin: ScalarLike, rotor: ScalarLike = 0.0
) -> Modes:
    """The two small motions about spin on a principal axis.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2.
        spin: Rate of the rotation about it [rad/s].
        rotor: Angular momentum of a rotor along the axis, relative to the body [kg
            m^2/s].

    Returns:
        Rates, shapes, and the ratio of the amplitudes; `linearized` is the solution.
        NaN outside positive, finite moments and finite rates.

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
        Body components [rad/s]; the error is of the order of the wobble squared, while
        it is small. NaN outside positive, finite moments, and at a time that is not
        finite.

    Gradients: finite everywhere, equal moments included.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 37.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> w = jnp.array([1e-3, 1.0, 0.0])
    >>> print(jr.stability.linearized(jnp.array([1.0, 2.0, 3.0]), 1, w, 5.0).round(6))
    [ 0.008995  1.       -0.005161]
    """
    omega0, ts = float_arrays(omega0, ts)
    check_shape("omega0", omega0, (3,))
    check_option("axis", axis, (0, 1, 2))

    def wave(towards: Array, back: Array, omega0: Array, t: Array) -> Array:
        spin, first, second = jnp.roll(omega0, -axis)
        square = towards * back * t * t
        even, odd = cosh_sqrt(square), t * sinhc_sqrt(square)
        turned = first * even + towards * odd * second
        return jnp.roll(
            jnp.stack([spin, turned, second * even + back * odd * first]), axis
        )

    each = jax.vmap(
        lambda t: _of_couplings(wave, moments, axis, omega0[axis], 0.0, omega0, t)
    )
    return each(ts.reshape(-1)).reshape(*ts.shape, 3)


class REGIONS(Enumeration):
    """Where in DeBra and Delp's plane the moments of a satellite lie."""

    unstable = "unstable"
    Lagrange = "Lagrange"
    DeBra_Delp = "DeBra-Delp"
    marginal = "marginal"
    undefined = "undefined"


class TopStability(NamedTuple):
    """A vertical top.

    Attributes:
        growth_rate_squared: Smooth through 0: where positive, the square of the rate at
            which the tilt grows; where negative, minus the square of half the
            difference of `frequencies` [1/s^2].
        growth_rate: Its root, or 0 [1/s].
        frequencies: At which the tilt goes round the vertical, the nutation and the
            slow precession; both the same where it grows [rad/s].
    """

    growth_rate_squared: Scalar
    growth_rate: Scalar
    frequencies: Float[Array, "2"]


def _of_top(formula: Callable[..., Answer], top: Any, **numbers: Any) -> Answer:
    """A formula of I1, I3, mgl and the numbers, NaN outside its domain."""
    check_type("top", top, SymmetricTop)
    arrays = shaped(**{name: (value,) for name, value in (vars(top) | numbers).items()})
    return where_defined(top.is_valid & all_finite(arrays), formula, *arrays)


def top_stability(top: SymmetricTop, omega3: ScalarLike) -> TopStability:
    """Stability of a vertical top: sleeping (mgl > 0), or hanging (mgl < 0).

    The tilt, as a complex number in the plane, obeys I1 z'' - i I3 omega3 z' - mgl z =
    0.

    Args:
        top: The top.
        omega3: Its spin [rad/s].

    Returns:
        Growth rate or frequencies; NaN outside positive, finite moments, finite mgl and
        spin.

    Gradients: of the square exact everywhere; of its root as `growth_rate`.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 5.7.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)  # falls asleep at omega3 = 4
    >>> print([jr.stability.top_stability(top, w).growth_rate.item() for w in (0.0, 4.0, 5.0)])
    [1.0, 0.0, 0.0]
    """

    def formula(i1: Array, i3: Array, mgl: Array, spin: Array) -> TopStability:
        half = i3 * spin / (2 * i1)
        square = mgl / i1 - half * half
        split = root_of_positive(-square)
        frequencies = jnp.stack([half + split, half - split])
        return TopStability(square, root_of_positive(square), frequencies)

    return _of_top(formula, top, omega3=omega3)


class PrecessionStability(NamedTuple):
    """Both steady precessions of a top at a tilt, slow and fast.

    Attributes:
        precession: Rates [rad/s]; the fast one is infinite for a level top.
        growth_rate_squared: Minus the squares of the frequencies of a small nutation
            [1/s^2].
        exists: Whether the spin is fast enough for any; NaN where not.
    """

    precession: Float[Array, "2"]
    growth_rate_squared: Float[Array, "2"]
    exists: Bool[Array, ""]


def precession_stability(
    top: SymmetricTop, theta: ScalarLike, omega3: ScalarLike
) -> PrecessionStability:
    """Stability of steady precession: a small nutation turns and never grows, while there is one.

    Args:
        top: The top.
        theta: Tilt of the axis from the vertical [rad].
        omega3: Third component of the angular velocity [rad/s].

    Returns:
        For the slow and the fast precession p the square -(p^2 sin^2 theta + (I3 omega3
        / I1 - 2 p cos theta)^2); NaN outside positive, finite moments, finite mgl, tilt
        and spin.

    Gradients: as those of `top.steady_precession`.
    Source: from the second derivative of `top.effective_potential`; docs/stability.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> print(jr.stability.precession_stability(top, jnp.pi / 3, 6.0).growth_rate_squared.round(4))
    [ -7.0941 -30.9059]
    """

    def formula(
        i1: Array, i3: Array, mgl: Array, tilt: Array, spin: Array
    ) -> tuple[Array, Array]:
        steady = steady_precession(SymmetricTop(i1, i3, mgl), tilt, spin)
        rates = jnp.stack([steady.slow, steady.fast])
        sine, cosine = jnp.sin(tilt), jnp.cos(tilt)
        return rates, -((rates * sine) ** 2) - (
            i3 * spin / i1 - 2 * rates * cosine
        ) ** 2

    rates, squares = _of_top(formula, top, theta=theta, omega3=omega3)
    return PrecessionStability(rates, squares, ~jnp.isnan(rates[0]))


class SatelliteStability(NamedTuple):
    """A satellite that keeps its face to the attractor.

    Attributes:
        pitch_squared: Square of the growth rate of pitch, smooth through 0 [1/s^2].
        roll_yaw_squared: Squares of the two growth rates of roll and yaw, complex where
            they form two growing and two falling spirals [1/s^2].
        growth_rate: The largest [1/s].
        margins: Four numbers that are all positive where it is stable, each smooth
            through 0, of the moments (A, B, C) with k_R = (C - A)/B, k_Y = (C - B)/A:
            (B - A)/C (pitch), k_R k_Y, 1 + 3 k_R + k_R k_Y, and its square less 16 k_R
            k_Y.
        region: One of `REGIONS`; "marginal" where nothing grows but a margin is not
            positive, "undefined" for moments of no real body.
    """

    pitch_squared: Scalar
    roll_yaw_squared: Complex[Array, "2"]
    growth_rate: Scalar
    margins: Float[Array, "4"]
    region: REGIONS


def satellite_stability(
    moments: VectorLike, orbital_rate: ScalarLike = 1.0
) -> SatelliteStability:
    """Stability of a satellite held by the gravity gradient on a circular orbit.

    Args:
        moments: Principal moments about the axes that point along the radius (yaw),
            along the flight (roll) and along the normal of the orbit (pitch) [kg m^2].
        orbital_rate: n [rad/s].

    Returns:
        Growth rates, margins, and the region: Lagrange's (largest moment along the
        normal, smallest along the radius), DeBra and Delp's, stable in the linear sense
        only, or unstable. NaN outside positive, finite moments and a finite rate. A
        region is of a real body: it is "undefined" where one moment exceeds the sum of
            the others, which the equations allow.

    Gradients: of squares and margins exact where roll and yaw have different rates; of
    the growth rate as `growth_rate`.
    Source: Hughes, Spacecraft Attitude Dynamics (1986), section 9.2; D. B. DeBra, R. H.
    Delp, Journal of the Astronautical Sciences 8 (1961) 14; derived in
    docs/stability.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> satellite = jr.stability.satellite_stability(jnp.array([1.0, 2.0, 2.5]))
    >>> print(jr.stability.REGIONS[satellite.region], satellite.pitch_squared)
    Lagrange -1.2
    """
    moments, n = shaped(moments=(moments, 3), orbital_rate=(orbital_rate,))
    ok = all_positive(moments) & jnp.isfinite(n)
    real = 2 * jnp.max(moments) <= jnp.sum(moments) * (
        1 + _FLAT * jnp.finfo(moments.dtype).eps
    )
    answer = where_defined(ok, _satellite, moments, n)
    region = REGIONS.where(ok & real, answer.region, REGIONS.undefined)
    return answer._replace(region=region)


def _satellite(moments: Array, n: Array) -> SatelliteStability:
    a, b, c = moments
    roll, yaw = (c - a) / b, (c - b) / a
    both, middle = roll * yaw, 1 + 3 * roll + roll * yaw
    inside = middle * middle - 16 * both
    pitch = 3 * (a - b) / c
    # s^4 + middle s^2 + 4 both = 0, for s^2, in units of n
    root = root_of_positive(inside)
    first = -0.5 * (middle + jnp.where(middle < 0, -root, root))
    second = jnp.where(
        first != 0, 4 * both / jnp.where(first != 0, first, 1.0), -middle - first
    )
    apart, spiral = inside < 0, 0.5 * root_of_positive(-inside)
    squares = jax.lax.complex(
        jnp.where(apart, -0.5 * middle, jnp.stack([first, second])),
        jnp.stack([spiral, -spiral]),
    )
    # Re sqrt(z) = sqrt((|z| + Re z) / 2), and |z| is 2 sqrt(both) for both of a complex
    # pair.
    of_spiral = root_of_positive(root_of_positive(both) - 0.25 * middle)
    of_real = root_of_positive(jnp.maximum(first, second))
    growth = jnp.maximum(root_of_positive(pitch), jnp.where(apart, of_spiral, of_real))
    margins = jnp.stack([(b - a) / c, both, middle, inside])
    stable = REGIONS.where(yaw > 0, REGIONS.Lagrange, REGIONS.DeBra_Delp)
    others = REGIONS.where(growth > 0, REGIONS.unstable, REGIONS.marginal)
    region = REGIONS.where(jnp.all(margins > 0), stable, others)
    squares = (n * n).astype(squares.dtype) * squares
    return SatelliteStability(
        n * n * pitch, squares, jnp.abs(n) * growth, margins, region
    )
