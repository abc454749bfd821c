"""Closed forms: spin about a principal axis, sleeping and precessing tops, satellites."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from jrigid._checks import RESULTS, Findings, all_finite, check_shape, float_arrays, nan_where
from jrigid._numerics import root_of_positive
from jrigid._types import Scalar, ScalarLike, VectorLike
from jrigid.free._linear import linear_rates
from jrigid.top import SymmetricTop, steady_precession

REGIONS = ("unstable", "Lagrange", "DeBra-Delp", "marginal")


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
        Growth rate [1/s]. Where it is 0 the wobble turns: see `frequency`.

    Raises:
        ValueError: Wrong shape or axis (trace time). Values are not checked.

    Gradients: exact where it is positive; at the threshold itself, where they are infinite, 0. Use
    `growth_rate_squared`, which is smooth there, to find thresholds.
    Source: as `growth_rate_squared`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.stability.growth_rate(jnp.array([1.0, 2.0, 3.0]), 1, 2.0).round(6))
    1.154701
    """
    towards, back, _, _ = linear_rates(moments, axis, spin, rotor)
    return root_of_positive(towards * back)


def frequency(moments: VectorLike, axis: int, spin: ScalarLike, rotor: ScalarLike = 0.0) -> Scalar:
    """Angular frequency of a small wobble about a principal axis; 0 where it grows.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2.
        spin: Rate of the rotation about it [rad/s].
        rotor: Angular momentum of a rotor along the axis, relative to the body [kg m^2/s].

    Returns:
        Angular frequency [rad/s].

    Raises:
        ValueError: Wrong shape or axis (trace time). Values are not checked.

    Gradients: as `growth_rate`.
    Source: as `growth_rate_squared`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.stability.frequency(jnp.array([1.0, 2.0, 3.0]), 2, 2.0))
    2.0
    """
    towards, back, _, _ = linear_rates(moments, axis, spin, rotor)
    return root_of_positive(-towards * back)


def modes(moments: VectorLike, axis: int, spin: ScalarLike, rotor: ScalarLike = 0.0) -> Modes:
    """The two small motions about spin on a principal axis.

    Args:
        moments: Principal moments [kg m^2].
        axis: 0, 1 or 2.
        spin: Rate of the rotation about it [rad/s].
        rotor: Angular momentum of a rotor along the axis, relative to the body [kg m^2/s].

    Returns:
        Rates, shapes, and the ratio of the amplitudes; `jrigid.free.linearized` is the solution.

    Raises:
        ValueError: Wrong shape or axis (trace time). Values are not checked.

    Gradients: exact where the two rates differ.
    Source: as `growth_rate_squared`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.stability.modes(jnp.array([1.0, 2.0, 3.0]), 2, 1.0).amplitude_ratio)
    1.0
    """
    towards, back, _, _ = linear_rates(moments, axis, spin, rotor)
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


class TopStability(NamedTuple):
    """A vertical top.

    Attributes:
        growth_rate_squared: Smooth through 0: where positive, the square of the rate at which the
            tilt grows; where negative, minus the square of half the difference of `frequencies`
            [1/s^2].
        growth_rate: Its root, or 0 [1/s].
        frequencies: At which the tilt goes round the vertical, the nutation and the slow
            precession; both the same where it grows [rad/s].
        result: `jrigid.RESULTS` of the input.
    """

    growth_rate_squared: Scalar
    growth_rate: Scalar
    frequencies: Float[Array, "2"]
    result: object


def top_stability(top: SymmetricTop, omega3: ScalarLike, *, throw: bool = True) -> TopStability:
    """Stability of a vertical top: sleeping (mgl > 0), or hanging (mgl < 0).

    The tilt, as a complex number in the plane, obeys I1 z'' - i I3 omega3 z' - mgl z = 0.

    Args:
        top: The top.
        omega3: Its spin [rad/s].
        throw: False: bad values are a result code and NaN.

    Returns:
        Growth rate or frequencies.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value (run time, any lane).

    Gradients: of the square exact everywhere; of its root as `growth_rate`.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 5.7.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)  # falls asleep at omega3 = 4
    >>> print([jr.stability.top_stability(top, w).growth_rate.item() for w in (0.0, 4.0, 5.0)])
    [1.0, 0.0, 0.0]
    """
    i1, i3, mgl, spin = float_arrays(top.I1, top.I3, top.mgl, omega3)
    check_shape("omega3", spin, ())
    findings = Findings()
    findings.require(top.is_valid, RESULTS.invalid_top)
    findings.require(all_finite(spin), RESULTS.invalid_state)
    ok = findings.ok
    i1, i3, mgl, spin = (jnp.where(ok, x, 1.0) for x in (i1, i3, mgl, spin))
    half = i3 * spin / (2 * i1)
    square = mgl / i1 - half * half
    split = root_of_positive(-square)
    found = (square, root_of_positive(square), jnp.stack([half + split, half - split]))
    square, growth, frequencies = findings.apply(nan_where(~ok, found), throw)
    return TopStability(square, growth, frequencies, findings.result)


class PrecessionStability(NamedTuple):
    """Both steady precessions of a top at a tilt, slow and fast.

    Attributes:
        precession: Rates [rad/s]; the fast one is infinite for a level top.
        growth_rate_squared: Minus the squares of the frequencies of a small nutation [1/s^2].
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
        For the slow and the fast precession p the square -(p^2 sin^2 theta + (I3 omega3 / I1 -
        2 p cos theta)^2).

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value (run time, any lane).

    Gradients: as those of `top.steady_precession`.
    Source: from the second derivative of `top.effective_potential`; docs/stability.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> print(jr.stability.precession_stability(top, jnp.pi / 3, 6.0).growth_rate_squared.round(4))
    [ -7.0941 -30.9059]
    """
    steady = steady_precession(top, theta, omega3)
    i1, i3, tilt, spin = float_arrays(top.I1, top.I3, theta, omega3)
    rates = jnp.stack([steady.slow, steady.fast])
    sine, cosine = jnp.sin(tilt), jnp.cos(tilt)
    squares = -((rates * sine) ** 2) - (i3 * spin / i1 - 2 * rates * cosine) ** 2
    return PrecessionStability(rates, squares, steady.exists)


class SatelliteStability(NamedTuple):
    """A satellite that keeps its face to the attractor.

    Attributes:
        pitch_squared: Square of the growth rate of pitch, smooth through 0 [1/s^2].
        roll_yaw_squared: Squares of the two growth rates of roll and yaw, complex where they form
            two growing and two falling spirals [1/s^2].
        growth_rate: The largest [1/s].
        margins: Four numbers that are all positive where it is stable, each smooth through 0, of
            the moments (A, B, C) with k_R = (C - A)/B, k_Y = (C - B)/A: (B - A)/C (pitch), k_R k_Y,
            1 + 3 k_R + k_R k_Y, and its square less 16 k_R k_Y.
        region: Index into `REGIONS`; "marginal" where nothing grows but a margin is not positive.
        result: `jrigid.RESULTS` of the input.
    """

    pitch_squared: Scalar
    roll_yaw_squared: Complex[Array, "2"]
    growth_rate: Scalar
    margins: Float[Array, "4"]
    region: Int[Array, ""]
    result: object


def satellite_stability(
    moments: VectorLike, orbital_rate: ScalarLike = 1.0, *, throw: bool = True
) -> SatelliteStability:
    """Stability of a satellite held by the gravity gradient on a circular orbit.

    Args:
        moments: Principal moments about the axes that point along the radius (yaw), along the
            flight (roll) and along the normal of the orbit (pitch) [kg m^2].
        orbital_rate: n [rad/s].
        throw: False: bad values are a result code and NaN.

    Returns:
        Growth rates, margins, and the region: Lagrange's (largest moment along the normal, smallest
        along the radius), DeBra and Delp's, stable in the linear sense only, or unstable.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value (run time, any lane).

    Gradients: of squares and margins exact where roll and yaw have different rates; of the growth
    rate as `growth_rate`.
    Source: Hughes, Spacecraft Attitude Dynamics (1986), section 9.2; D. B. DeBra, R. H. Delp,
    Journal of the Astronautical Sciences 8 (1961) 14; derived in docs/stability.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> found = jr.stability.satellite_stability(jnp.array([1.0, 2.0, 2.5]))
    >>> print(jr.stability.REGIONS[found.region], found.pitch_squared)
    Lagrange -1.2
    """
    moments, n = float_arrays(moments, orbital_rate)
    check_shape("moments", moments, (3,))
    check_shape("orbital_rate", n, ())
    findings = Findings()
    findings.require(all_finite(moments) & jnp.all(moments > 0), RESULTS.invalid_inertia)
    findings.require(all_finite(n), RESULTS.invalid_state)
    ok = findings.ok
    a, b, c = jnp.where(ok, moments, 1.0)
    n = jnp.where(ok, n, 1.0)
    roll, yaw = (c - a) / b, (c - b) / a
    both, sum_ = roll * yaw, 1 + 3 * roll + roll * yaw
    inside = sum_ * sum_ - 16 * both
    pitch = 3 * (a - b) / c
    # s^4 + sum s^2 + 4 both = 0, for s^2, in units of n
    real = root_of_positive(inside)
    first = -0.5 * (sum_ + jnp.where(sum_ < 0, -real, real))
    second = jnp.where(first != 0, 4 * both / jnp.where(first != 0, first, 1.0), -sum_ - first)
    apart, spiral = inside < 0, 0.5 * root_of_positive(-inside)
    squares = jax.lax.complex(
        jnp.where(apart, -0.5 * sum_, jnp.stack([first, second])), jnp.stack([spiral, -spiral])
    )
    # Re sqrt(z) = sqrt((|z| + Re z) / 2), and |z| is 2 sqrt(both) for both of a complex pair.
    of_spiral = root_of_positive(root_of_positive(both) - 0.25 * sum_)
    of_real = root_of_positive(jnp.maximum(first, second))
    growth = jnp.maximum(root_of_positive(pitch), jnp.where(apart, of_spiral, of_real))
    margins = jnp.stack([(b - a) / c, both, sum_, inside])
    stable = jnp.all(margins > 0)
    region = jnp.where(stable, jnp.where(yaw > 0, 1, 2), jnp.where(growth > 0, 0, 3))
    found = (n * n * pitch, (n * n).astype(squares.dtype) * squares, jnp.abs(n) * growth, margins)
    pitch, squares, growth, margins = findings.apply(nan_where(~ok, found), throw)
    region = jnp.where(ok, region, -1)
    return SatelliteStability(pitch, squares, growth, margins, region, findings.result)
