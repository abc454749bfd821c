"""Closed forms of stability: spin about a principal axis, tops, satellites."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

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
from jrigid._core.compile import one_program
from jrigid._numerics import cosh_sqrt, root_of_positive, sinhc_sqrt
from jrigid._types import Real, Scalar, ScalarLike, VectorLike
from jrigid.top import SymmetricTop, steady_precession

Answer = TypeVar("Answer")
# Moments of a flat body, of which one is the sum of the others, pass with an error of
# this many eps.
_FLAT = 8


class Modes(NamedTuple):
    """The two small motions about a principal axis, proportional to exp(rate t).

    Attributes:
        rates: A rate that grows or oscillates, and its opposite [1/s].
        shapes: For each rate the two small components of the angular velocity, of unit
            length. They belong to the axes that follow the spin axis in cyclic order.
            At zero rates, where the motion drifts, both shapes are the same. They are
            zero where the two components are not coupled.
        amplitude_ratio: |second component / first|. It and its slopes are infinite or
            NaN where a coupling is zero.
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
    """Apply a formula of the couplings of the two small components, and of others.

    The components j and k obey w_j' = towards w_k and w_k' = back w_j. NaN outside the
    domain of the arguments.
    """
    check_option("axis", axis, (0, 1, 2))
    moments, spin, rotor = shaped(moments=(moments, 3), spin=(spin,), rotor=(rotor,))
    moments, spin, rotor, *arrays = float_arrays(moments, spin, rotor, *others)

    def of_arrays(moments: Array, spin: Array, rotor: Array, *others: Array) -> Answer:
        # Euler's equations with a rotor, linear in the two components across the axis
        # (docs/stability.md). A cyclic order keeps the axes right-handed.
        own, first, second = jnp.roll(moments, -axis)
        towards = ((second - own) * spin - rotor) / first
        back = ((own - first) * spin + rotor) / second
        return formula(towards, back, *others)

    ok = all_positive(moments) & all_finite((spin, rotor, arrays))
    return where_defined(ok, of_arrays, moments, spin, rotor, *arrays)


class _Wobble(NamedTuple):
    """Growth and frequency of a small wobble."""

    growth_rate_squared: Array
    growth_rate: Array
    frequency: Array


def _wobble(towards: Array, back: Array) -> _Wobble:
    """The wobble w'' = towards back w."""
    square = towards * back
    return _Wobble(square, root_of_positive(square), root_of_positive(-square))


@partial(one_program, static="axis")
def growth_rate_squared(
    moments: VectorLike, axis: int, spin: ScalarLike, rotor: ScalarLike = 0.0
) -> Scalar:
    """Square of the rate at which a small wobble about a principal axis grows.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2.
        spin: Angular velocity about the axis [rad/s].
        rotor: Angular momentum of a rotor along the axis, relative to the body [kg
            m^2/s].

    Returns:
        Square of the growth rate [1/s^2]. Where it is negative it is minus the square
        of the frequency. NaN outside positive, finite moments and finite rates.

    Gradients: finite everywhere. The square is a polynomial over moments.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 37; with a rotor, Hughes,
    Spacecraft Attitude Dynamics (1986), section 6.3.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> moments = jnp.array([1.0, 2.0, 3.0])
    >>> square = jr.stability.growth_rate_squared
    >>> print([square(moments, axis, 1.0).item() for axis in range(3)])
    [-0.3333333333333333, 0.3333333333333333, -1.0]
    """
    return _of_couplings(_wobble, moments, axis, spin, rotor).growth_rate_squared


@partial(one_program, static="axis")
def growth_rate(
    moments: VectorLike, axis: int, spin: ScalarLike, rotor: ScalarLike = 0.0
) -> Scalar:
    """Rate at which a small wobble about a principal axis grows; 0 if it does not.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2.
        spin: Angular velocity about the axis [rad/s].
        rotor: Angular momentum of a rotor along the axis, relative to the body [kg
            m^2/s].

    Returns:
        Growth rate [1/s]. Where it is 0 the wobble oscillates: see `frequency`. NaN
        outside positive, finite moments and finite rates.

    Gradients: exact where the rate is positive. At the threshold, where they are
    infinite, 0. Use `growth_rate_squared`, which is smooth there, to find thresholds.
    Source: as `growth_rate_squared`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.stability.growth_rate(jnp.array([1.0, 2.0, 3.0]), 1, 2.0).round(6))
    1.154701
    """
    return _of_couplings(_wobble, moments, axis, spin, rotor).growth_rate


@partial(one_program, static="axis")
def frequency(
    moments: VectorLike, axis: int, spin: ScalarLike, rotor: ScalarLike = 0.0
) -> Scalar:
    """Angular frequency of a small wobble about a principal axis; 0 where it grows.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2.
        spin: Angular velocity about the axis [rad/s].
        rotor: Angular momentum of a rotor along the axis, relative to the body [kg
            m^2/s].

    Returns:
        Angular frequency [rad/s]. NaN outside positive, finite moments and finite
        rates.

    Gradients: as `growth_rate`.
    Source: as `growth_rate_squared`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.stability.frequency(jnp.array([1.0, 2.0, 3.0]), 2, 2.0))
    2.0
    """
    return _of_couplings(_wobble, moments, axis, spin, rotor).frequency


@partial(one_program, static="axis")
def modes(
    moments: VectorLike, axis: int, spin: ScalarLike, rotor: ScalarLike = 0.0
) -> Modes:
    """The two small motions about a spin on a principal axis.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2.
        spin: Angular velocity about the axis [rad/s].
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
    wobble = _wobble(towards, back)
    rate = jax.lax.complex(wobble.growth_rate, wobble.frequency)
    rates = jnp.stack([rate, -rate])
    # (towards, rate) and (rate, back) are parallel: the longer one is more accurate.
    of_first = jnp.abs(towards) >= jnp.abs(back)
    upper = jnp.where(of_first, towards.astype(rates.dtype), rates)
    lower = jnp.where(of_first, rates, back.astype(rates.dtype))
    square = jnp.abs(wobble.growth_rate_squared)
    # The square of the magnitude of the rate is |square|, so this is the longer of the
    # two vectors.
    length = root_of_positive(square + jnp.maximum(towards**2, back**2))
    length = jnp.where(length > 0, length, 1.0).astype(rates.dtype)
    shapes = jnp.stack([upper, lower], axis=1) / length
    return Modes(rates, shapes, jnp.sqrt(jnp.abs(back / towards)))


@partial(one_program, static="axis")
def linearized(
    moments: VectorLike, axis: int, omega0: VectorLike, ts: Real[ArrayLike, "..."]
) -> Float[Array, "... 3"]:
    """Angular velocity of a small wobble about a principal axis, linearised.

    Args:
        moments: Principal moments [kg m^2].
        axis: The axis that `omega0` is near: 0, 1 or 2.
        omega0: Angular velocity at time 0, body components [rad/s].
        ts: Times [s] of any shape.

    Returns:
        Body components [rad/s]. While the wobble is small the error is of the order of
        its square. NaN outside positive, finite moments, and at a time that is not
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

    def at_time(t: Array) -> Array:
        spin = omega0[axis]
        return _of_couplings(small_wobble, moments, axis, spin, 0.0, omega0, t)

    def small_wobble(towards: Array, back: Array, omega0: Array, t: Array) -> Array:
        spin, first, second = jnp.roll(omega0, -axis)
        # Even functions of the rate give growth and oscillation by one formula.
        square = towards * back * t * t
        even = cosh_sqrt(square)
        odd = t * sinhc_sqrt(square)
        components = jnp.stack(
            [
                spin,
                first * even + towards * odd * second,
                second * even + back * odd * first,
            ]
        )
        return jnp.roll(components, axis)

    return jax.vmap(at_time)(ts.reshape(-1)).reshape(*ts.shape, 3)


class REGIONS(Enumeration):
    """Regions of DeBra and Delp's plane of the moments of a satellite."""

    unstable = "unstable"
    Lagrange = "Lagrange"
    DeBra_Delp = "DeBra-Delp"
    marginal = "marginal"
    undefined = "undefined"


class TopStability(NamedTuple):
    """Stability of a vertical top.

    Attributes:
        growth_rate_squared: Square of the rate at which the tilt grows [1/s^2]. It is
            smooth through 0. Where it is negative it is minus the square of half the
            difference of `frequencies`.
        growth_rate: Its root, or 0 where it is negative [1/s].
        frequencies: Rates at which the tilt goes round the vertical: the nutation and
            the slow precession. Both are the same where the tilt grows [rad/s].
    """

    growth_rate_squared: Scalar
    growth_rate: Scalar
    frequencies: Float[Array, "2"]


def _of_top(
    formula: Callable[..., Answer], top: SymmetricTop, **numbers: ScalarLike
) -> Answer:
    """Apply a formula of I1, I3, mgl and numbers; NaN outside its domain."""
    check_type("top", top, SymmetricTop)
    arguments = {name: (value,) for name, value in (vars(top) | numbers).items()}
    arrays = shaped(**arguments)
    return where_defined(top.is_valid & all_finite(arrays), formula, *arrays)


@one_program
def top_stability(top: SymmetricTop, omega3: ScalarLike) -> TopStability:
    """Stability of a vertical top: sleeping (mgl > 0) or hanging (mgl < 0).

    The tilt, written as a complex number in the horizontal plane, obeys
    I1 z'' - i I3 omega3 z' - mgl z = 0.

    Args:
        top: The top.
        omega3: Its spin [rad/s].

    Returns:
        Growth rate and frequencies. NaN outside positive, finite moments, finite mgl
        and spin.

    Gradients: those of the square are exact everywhere; those of its root are as for
    `growth_rate`.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 5.7.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)  # falls asleep at omega3 = 4
    >>> stability = [jr.stability.top_stability(top, w) for w in (0.0, 4.0, 5.0)]
    >>> print([x.growth_rate.item() for x in stability])
    [1.0, 0.0, 0.0]
    """

    def formula(i1: Array, i3: Array, mgl: Array, spin: Array) -> TopStability:
        # z = exp(i s t) gives I1 s^2 - I3 omega3 s + mgl = 0, with the roots half +-
        # split.
        half = i3 * spin / (2 * i1)
        square = mgl / i1 - half * half
        split = root_of_positive(-square)
        frequencies = jnp.stack([half + split, half - split])
        return TopStability(square, root_of_positive(square), frequencies)

    return _of_top(formula, top, omega3=omega3)


class PrecessionStability(NamedTuple):
    """Stability of the slow and the fast steady precession of a top at a tilt.

    Attributes:
        precession: Rates [rad/s]; the fast one is infinite for a level top.
        growth_rate_squared: Minus the squares of the frequencies of a small nutation
            [1/s^2].
        exists: Whether the spin is fast enough for any; NaN where not.
    """

    precession: Float[Array, "2"]
    growth_rate_squared: Float[Array, "2"]
    exists: Bool[Array, ""]


@one_program
def precession_stability(
    top: SymmetricTop, theta: ScalarLike, omega3: ScalarLike
) -> PrecessionStability:
    """Stability of steady precession: a small nutation oscillates and never grows.

    Args:
        top: The top.
        theta: Tilt of the axis from the vertical [rad].
        omega3: Third component of the angular velocity [rad/s].

    Returns:
        The square -(p^2 sin^2 theta + (I3 omega3 / I1 - 2 p cos theta)^2) of the slow
        and of the fast precession p. NaN outside positive, finite moments, finite mgl,
        tilt and spin.

    Gradients: as those of `top.steady_precession`.
    Source: from the second derivative of `top.effective_potential`; docs/stability.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> stability = jr.stability.precession_stability(top, jnp.pi / 3, 6.0)
    >>> print(stability.growth_rate_squared.round(4))
    [ -7.0941 -30.9059]
    """

    def formula(
        i1: Array, i3: Array, mgl: Array, tilt: Array, spin: Array
    ) -> tuple[Array, Array]:
        steady = steady_precession(SymmetricTop.unchecked(i1, i3, mgl), tilt, spin)
        rates = jnp.stack([steady.slow, steady.fast])
        # The frequency of a small nutation is the hypotenuse of these two rates, so no
        # steady precession is unstable.
        azimuthal = rates * jnp.sin(tilt)
        polar = i3 * spin / i1 - 2 * rates * jnp.cos(tilt)
        return rates, -(azimuthal**2) - polar**2

    rates, squares = _of_top(formula, top, theta=theta, omega3=omega3)
    return PrecessionStability(rates, squares, ~jnp.isnan(rates[0]))


class SatelliteStability(NamedTuple):
    """Stability of a satellite that keeps one side to the attractor.

    Attributes:
        pitch_squared: Square of the growth rate of pitch, smooth through 0 [1/s^2].
        roll_yaw_squared: Squares of the two growth rates of roll and yaw, complex where
            they form two growing and two falling spirals [1/s^2].
        growth_rate: The largest [1/s].
        margins: Four numbers that are all positive where the satellite is stable, each
            smooth through 0. With moments (A, B, C), k_R = (C - A)/B and k_Y = (C -
            B)/A they are (B - A)/C (pitch), k_R k_Y, 1 + 3 k_R + k_R k_Y, and the
            square of the latter less 16 k_R k_Y.
        region: One of `REGIONS`. It is "marginal" where nothing grows but a margin is
            not positive, and "undefined" for moments of no real body.
    """

    pitch_squared: Scalar
    roll_yaw_squared: Complex[Array, "2"]
    growth_rate: Scalar
    margins: Float[Array, "4"]
    region: REGIONS


@one_program
def satellite_stability(
    moments: VectorLike, orbital_rate: ScalarLike = 1.0
) -> SatelliteStability:
    """Stability of a satellite held by the gravity gradient on a circular orbit.

    Args:
        moments: Principal moments about the axes that point along the radius (yaw),
            along the flight (roll) and along the normal of the orbit (pitch) [kg m^2].
        orbital_rate: Rate of the orbit, n [rad/s].

    Returns:
        Growth rates, margins, and the region. Lagrange's region has the largest moment
        along the normal and the smallest along the radius; DeBra and Delp's is stable
        in the linear sense only. NaN outside positive, finite moments and a finite
        rate. The region is "undefined" where one moment exceeds the sum of the others:
        the equations allow it, but no real body has such moments.

    Gradients: those of squares and margins are exact where roll and yaw have different
    rates; those of the growth rate are as for `growth_rate`.
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
    # The largest moment of a body is at most the sum of the other two.
    real = 2 * jnp.max(moments) <= jnp.sum(moments) * (
        1 + _FLAT * jnp.finfo(moments.dtype).eps
    )
    answer = where_defined(ok, _satellite, moments, n)
    region = REGIONS.where(ok & real, answer.region, REGIONS.undefined)
    return answer._replace(region=region)


def _satellite(moments: Array, n: Array) -> SatelliteStability:
    a, b, c = moments
    roll = (c - a) / b
    yaw = (c - b) / a
    product = roll * yaw
    middle = 1 + 3 * roll + roll * yaw
    discriminant = middle * middle - 16 * product
    # Until they are returned, rates are in units of the orbital rate.
    pitch = 3 * (a - b) / c
    squares, growth = _roll_and_yaw(product, middle, discriminant)
    growth = jnp.maximum(root_of_positive(pitch), growth)
    margins = jnp.stack([(b - a) / c, product, middle, discriminant])
    # Where all margins are positive, roll and yaw have the same sign.
    stable = REGIONS.where(yaw > 0, REGIONS.Lagrange, REGIONS.DeBra_Delp)
    others = REGIONS.where(growth > 0, REGIONS.unstable, REGIONS.marginal)
    region = REGIONS.where(jnp.all(margins > 0), stable, others)
    squares = (n * n).astype(squares.dtype) * squares
    return SatelliteStability(
        n * n * pitch, squares, jnp.abs(n) * growth, margins, region
    )


def _roll_and_yaw(
    product: Array, middle: Array, discriminant: Array
) -> tuple[Array, Array]:
    """Both roots s^2 of s^4 + middle s^2 + 4 product = 0, and the largest Re s."""
    root = root_of_positive(discriminant)
    # The root of larger magnitude first: the other one follows without cancellation.
    first = -0.5 * (middle + jnp.where(middle < 0, -root, root))
    second = jnp.where(
        first != 0, 4 * product / jnp.where(first != 0, first, 1.0), -middle - first
    )
    is_complex = discriminant < 0
    imaginary = 0.5 * root_of_positive(-discriminant)
    squares = jax.lax.complex(
        jnp.where(is_complex, -0.5 * middle, jnp.stack([first, second])),
        jnp.stack([imaginary, -imaginary]),
    )
    # Re sqrt(z) = sqrt((|z| + Re z) / 2), and |z| is 2 sqrt(product) for both of a
    # complex pair.
    of_complex = root_of_positive(root_of_positive(product) - 0.25 * middle)
    of_real = root_of_positive(jnp.maximum(first, second))
    return squares, jnp.where(is_complex, of_complex, of_real)
