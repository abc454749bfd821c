"""Closed forms: sleeping and precessing tops, satellites."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float

from jrigid._checks import (
    Enumeration,
    all_finite,
    all_positive,
    check_shape,
    check_type,
    float_arrays,
    where_defined,
)
from jrigid._numerics import root_of_positive
from jrigid._types import Scalar, ScalarLike, VectorLike
from jrigid.top import SymmetricTop, steady_precession

# Moments of a flat body, of which one is the sum of the others, pass with this many eps.
_FLAT = 8


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
        growth_rate_squared: Smooth through 0: where positive, the square of the rate at which the
            tilt grows; where negative, minus the square of half the difference of `frequencies`
            [1/s^2].
        growth_rate: Its root, or 0 [1/s].
        frequencies: At which the tilt goes round the vertical, the nutation and the slow
            precession; both the same where it grows [rad/s].
    """

    growth_rate_squared: Scalar
    growth_rate: Scalar
    frequencies: Float[Array, "2"]


def _top_arrays(top: Any, **numbers: Any) -> tuple[Bool[Array, ""], tuple[Array, ...]]:
    """Whether all is in the domain; I1, I3, mgl and the numbers, of one dtype."""
    check_type("top", top, SymmetricTop)
    arrays = float_arrays(top.I1, top.I3, top.mgl, *numbers.values())
    for name, value in zip(numbers, arrays[3:], strict=True):
        check_shape(name, value, ())
    return all_positive(arrays[:2]) & all_finite(arrays), arrays


def top_stability(top: SymmetricTop, omega3: ScalarLike) -> TopStability:
    """Stability of a vertical top: sleeping (mgl > 0), or hanging (mgl < 0).

    The tilt, as a complex number in the plane, obeys I1 z'' - i I3 omega3 z' - mgl z = 0.

    Args:
        top: The top.
        omega3: Its spin [rad/s].

    Returns:
        Growth rate or frequencies; NaN outside positive, finite moments, finite mgl and spin.

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

    ok, arrays = _top_arrays(top, omega3=omega3)
    return where_defined(ok, formula, *arrays)


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
        2 p cos theta)^2); NaN outside positive, finite moments, finite mgl, tilt and spin.

    Gradients: as those of `top.steady_precession`.
    Source: from the second derivative of `top.effective_potential`; docs/stability.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> print(jr.stability.precession_stability(top, jnp.pi / 3, 6.0).growth_rate_squared.round(4))
    [ -7.0941 -30.9059]
    """

    def formula(i1: Array, i3: Array, mgl: Array, tilt: Array, spin: Array) -> PrecessionStability:
        steady = steady_precession(SymmetricTop(i1, i3, mgl), tilt, spin)
        rates = jnp.stack([steady.slow, steady.fast])
        sine, cosine = jnp.sin(tilt), jnp.cos(tilt)
        squares = -((rates * sine) ** 2) - (i3 * spin / i1 - 2 * rates * cosine) ** 2
        return PrecessionStability(rates, squares, steady.exists & ok)

    ok, arrays = _top_arrays(top, theta=theta, omega3=omega3)
    return where_defined(ok, formula, *arrays)


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
        region: One of `REGIONS`; "marginal" where nothing grows but a margin is not positive,
            "undefined" for moments of no real body.
    """

    pitch_squared: Scalar
    roll_yaw_squared: Complex[Array, "2"]
    growth_rate: Scalar
    margins: Float[Array, "4"]
    region: REGIONS


def satellite_stability(moments: VectorLike, orbital_rate: ScalarLike = 1.0) -> SatelliteStability:
    """Stability of a satellite held by the gravity gradient on a circular orbit.

    Args:
        moments: Principal moments about the axes that point along the radius (yaw), along the
            flight (roll) and along the normal of the orbit (pitch) [kg m^2].
        orbital_rate: n [rad/s].

    Returns:
        Growth rates, margins, and the region: Lagrange's (largest moment along the normal, smallest
        along the radius), DeBra and Delp's, stable in the linear sense only, or unstable. NaN
        outside positive, finite moments and a finite rate. A region is of a real body: it is
        "undefined" where one moment exceeds the sum of the others, which the equations allow.

    Gradients: of squares and margins exact where roll and yaw have different rates; of the growth
    rate as `growth_rate`.
    Source: Hughes, Spacecraft Attitude Dynamics (1986), section 9.2; D. B. DeBra, R. H. Delp,
    Journal of the Astronautical Sciences 8 (1961) 14; derived in docs/stability.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> satellite = jr.stability.satellite_stability(jnp.array([1.0, 2.0, 2.5]))
    >>> print(jr.stability.REGIONS[satellite.region], satellite.pitch_squared)
    Lagrange -1.2
    """
    moments, n = float_arrays(moments, orbital_rate)
    check_shape("moments", moments, (3,))
    check_shape("orbital_rate", n, ())
    ok = all_positive(moments) & jnp.isfinite(n)
    whole, largest = jnp.sum(moments), jnp.max(moments)
    real = ok & (2 * largest <= whole * (1 + _FLAT * jnp.finfo(moments.dtype).eps))
    answer = where_defined(ok, _satellite, moments, n)
    region = REGIONS.where(real, answer.region, REGIONS.undefined)
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
    second = jnp.where(first != 0, 4 * both / jnp.where(first != 0, first, 1.0), -middle - first)
    apart, spiral = inside < 0, 0.5 * root_of_positive(-inside)
    squares = jax.lax.complex(
        jnp.where(apart, -0.5 * middle, jnp.stack([first, second])), jnp.stack([spiral, -spiral])
    )
    # Re sqrt(z) = sqrt((|z| + Re z) / 2), and |z| is 2 sqrt(both) for both of a complex pair.
    of_spiral = root_of_positive(root_of_positive(both) - 0.25 * middle)
    of_real = root_of_positive(jnp.maximum(first, second))
    growth = jnp.maximum(root_of_positive(pitch), jnp.where(apart, of_spiral, of_real))
    margins = jnp.stack([(b - a) / c, both, middle, inside])
    stable = REGIONS.where(yaw > 0, REGIONS.Lagrange, REGIONS.DeBra_Delp)
    others = REGIONS.where(growth > 0, REGIONS.unstable, REGIONS.marginal)
    region = REGIONS.where(jnp.all(margins > 0), stable, others)
    squares = (n * n).astype(squares.dtype) * squares
    return SatelliteStability(n * n * pitch, squares, jnp.abs(n) * growth, margins, region)
