"""Tumbling in the observers' terms: two periods, a mode, the tilt and the energy."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jrigid._checks import (
    INERTIA,
    all_positive,
    check_option,
    is_inertia,
    shaped,
    where_defined,
)
from jrigid._numerics import product, root_of_positive, safe_arctan2, safe_norm
from jrigid._types import InertiaLike, Scalar, ScalarLike, Vector, VectorLike
from jrigid.dynamics import angular_momentum
from jrigid.free import REGIMES, mean_precession_rate, polhode_period, regime
from jrigid.mass import principal_axes
from jrigid.stability import boundary

_MODES = ("long-axis", "short-axis")
# Logarithms of the tangent of the largest tilt between which a motion is sought. Below
# them the ratio of the periods is that of a small wobble to the last digit; above them
# the tilt is 90 degrees but for 1e-17.
_LOWEST = -20.0
_HIGHEST = 40.0


class Tumbling(NamedTuple):
    """A free rotation in the terms in which light curves of tumblers are described.

    Attributes:
        precession_period: P_phi [s], the mean period in which the axis that the angular
            momentum circles turns about the angular momentum.
        rotation_period: P_psi [s], the period of the motion in body axes: the time of
            one turn of the polhode.
        regime: `jr.free.REGIMES.about_smallest` is the long-axis mode,
            `about_largest` the short-axis mode.
        tilt_min: Least angle between that axis and the angular momentum [rad].
        tilt_max: Largest such angle [rad]; the difference is the amplitude of the
            nutation.
        energy_ratio: E/E0, the kinetic energy over the least one of the same angular
            momentum, that of rotation about the axis of the largest moment.
    """

    precession_period: Scalar
    rotation_period: Scalar
    regime: REGIMES
    tilt_min: Scalar
    tilt_max: Scalar
    energy_ratio: Scalar


def tumbling(inertia: InertiaLike, omega: VectorLike) -> Tumbling:
    """Periods, mode, tilt and energy of a free rotation.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        Of a long-axis mode the angles are about the axis of the smallest moment, of a
        short-axis mode about the axis of the largest. NaN outside positive definite
        inertia and finite rates.

    Gradients: as those of `free.polhode_period` and `free.mean_precession_rate`.
    Source: N. H. Samarasinha and M. F. A'Hearn, Icarus 93 (1991) 194, for the modes; M.
    Kaasalainen, Astron. Astrophys. 376 (2001) 302, and P. Pravec et al., Icarus 173
    (2005) 108, for the periods; P. Pravec et al., Icarus 233 (2014) 48, for E/E0.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> apophis = jnp.array([0.61, 0.965, 1.0])
    >>> omega = jr.photometry.omega_from_periods(apophis, 27.38 * 3600, 263 * 3600)
    >>> terms = jr.photometry.tumbling(apophis, omega)
    >>> print(terms.energy_ratio.round(4), jr.free.REGIMES[terms.regime])
    1.0236 about the axis of the largest moment
    """
    return _terms(*shaped(inertia=(inertia, *INERTIA), omega=(omega, 3)))


@jax.jit  # outside of jit each operation is a program of its own
def _terms(inertia: Array, omega: Vector) -> Tumbling:
    """The terms of `tumbling`."""
    kind = regime(inertia, omega)
    ok = kind != REGIMES.undefined
    tilts, ratio = where_defined(ok, _tilts_and_energy, inertia, omega)
    return Tumbling(
        precession_period=2 * jnp.pi / mean_precession_rate(inertia, omega),
        rotation_period=polhode_period(inertia, omega),
        regime=kind,
        tilt_min=tilts[0],
        tilt_max=tilts[1],
        energy_ratio=ratio,
    )


def _tilts_and_energy(
    inertia: Array, omega: Vector
) -> tuple[Float[Array, "2"], Scalar]:
    """Least and largest tilt, and E/E0, from the direction of the angular momentum.

    With n a unit vector along it, 2 E / L^2 is the sum of n_i^2 / I_i. Excesses over
    the energies of rotation about the two outer axes are sums of positive terms, so
    small tilts keep their digits.
    """
    principal = principal_axes(inertia)
    momentum = product("ij,i->j", principal.axes, angular_momentum(inertia, omega))
    size = safe_norm(momentum)
    squares = (momentum / jnp.where(size > 0, size, 1.0)) ** 2
    smallest, middle, largest = principal.moments
    # Over the energy about the third axis, and under that about the first.
    above = squares[0] * (largest / smallest - 1) + squares[1] * (largest / middle - 1)
    below = squares[1] * (1 - smallest / middle) + squares[2] * (1 - smallest / largest)
    # The momentum crosses two planes of principal axes in its extreme positions.
    about_largest = jnp.stack(
        [
            _quotient(above, largest / smallest - 1),
            _quotient(above, largest / middle - 1),
        ]
    )
    about_smallest = jnp.stack(
        [
            _quotient(below, 1 - smallest / largest),
            _quotient(below, 1 - smallest / middle),
        ]
    )
    # The motion is about the smallest moment's axis where its energy is above that of
    # rotation about the intermediate axis. The quotients do not show this if two
    # moments are equal.
    long_axis = above > largest / middle - 1
    sines = jnp.clip(jnp.where(long_axis, about_smallest, about_largest), 0.0, 1.0)
    tilts = safe_arctan2(root_of_positive(sines), root_of_positive(1 - sines))
    return tilts, jnp.where(size > 0, 1 + above, jnp.nan)


def _quotient(excess: Scalar, largest: Scalar) -> Scalar:
    """An excess of energy over that at 90 degrees; 0 where the two axes are alike."""
    return excess / jnp.where(largest > 0, largest, jnp.inf)


def omega_from_periods(
    inertia: InertiaLike,
    precession_period: ScalarLike,
    rotation_period: ScalarLike,
    mode: str = "short-axis",
) -> Vector:
    """Angular velocity of the free rotation with given periods: `tumbling` reversed.

    The ratio of the periods grows with the tilt, from that of a small wobble without
    bound at the separatrix, so there is one motion for each ratio and mode, but for its
    phase and the sense of rotation.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        precession_period: P_phi [s].
        rotation_period: P_psi [s].
        mode: "short-axis" or "long-axis": the axis that the angular momentum circles.

    Returns:
        Angular velocity, body components [rad/s], at the largest tilt: the angular
        momentum is in the plane of the circled axis and the middle one. NaN where no
        motion has these periods, where the only one is within rounding of the
        separatrix, and outside positive definite inertia and positive periods.

    Gradients: right to second order, in all arguments.
    Source: the formulas of `free.polhode_period` and `free.mean_precession_rate`,
    solved by `stability.boundary`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> toutatis = jnp.array([1.0, 3.09, 3.22])
    >>> day = 86400.0
    >>> omega = jr.photometry.omega_from_periods(
    ...     toutatis, 7.35 * day, 5.41 * day, "long-axis")
    >>> print(jnp.rad2deg(jr.photometry.tumbling(toutatis, omega).tilt_max).round(1))
    51.2
    """
    check_option("mode", mode, _MODES)
    arguments = shaped(
        inertia=(inertia, *INERTIA),
        precession_period=(precession_period,),
        rotation_period=(rotation_period,),
    )
    return _where_positive(_of_periods, mode == "long-axis", *arguments)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _where_positive(
    formula: Callable[..., Vector], long_axis: bool, inertia: Array, *numbers: Scalar
) -> Vector:
    """A formula of a mode, for positive numbers and an inertia that a body has."""
    ok = is_inertia(inertia) & all_positive(numbers)
    return where_defined(ok, functools.partial(formula, long_axis), inertia, *numbers)


def _of_periods(
    long_axis: bool, inertia: Array, precession_period: Scalar, rotation_period: Scalar
) -> Vector:
    """The angular velocity of `omega_from_periods`; NaN where there is none."""
    principal = principal_axes(inertia)
    moments = principal.moments
    wanted = rotation_period / precession_period
    lowest, highest = (jnp.asarray(y, wanted.dtype) for y in (_LOWEST, _HIGHEST))
    excess = _EXCESS[long_axis]
    eps = float(jnp.finfo(wanted.dtype).eps)
    y = boundary(excess, lowest, highest, moments, wanted, rtol=eps, throw=False)
    found = jnp.isfinite(y)
    # Derivatives of other lanes stay clean.
    omega = _at_largest_tilt(moments, jnp.where(found, y, 0.0), long_axis)
    # The ratio of the periods fixes the direction of the angular momentum, and its size
    # scales both.
    omega = _with_precession(moments, omega, precession_period)
    return jnp.where(found, product("ij,j->i", principal.axes, omega), jnp.nan)


def _excess(long_axis: bool, y: Scalar, moments: Vector, wanted: Scalar) -> Scalar:
    """Logarithm of the ratio of the periods over the wanted one; it rises with y."""
    omega = _at_largest_tilt(moments, y, long_axis)
    turns = polhode_period(moments, omega) * mean_precession_rate(moments, omega)
    return jnp.log(turns / (2 * jnp.pi) / wanted)


# One function object for each mode, so that no call compiles a new one.
_EXCESS = {mode: functools.partial(_excess, mode) for mode in (False, True)}


def omega_from_energy(
    inertia: InertiaLike,
    energy_ratio: ScalarLike,
    precession_period: ScalarLike,
    mode: str = "short-axis",
) -> Vector:
    """Angular velocity of the free rotation with a given E/E0: `tumbling` reversed.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        energy_ratio: E/E0, from 1 to I3/I2 in a short-axis mode, and from I3/I2 to
            I3/I1 in a long-axis mode.
        precession_period: P_phi [s].
        mode: "short-axis" or "long-axis": the axis that the angular momentum circles.

    Returns:
        Angular velocity, body components [rad/s], at the largest tilt: the angular
        momentum is in the plane of the circled axis and the middle one. NaN where no
        motion of the mode has this energy, at the separatrix, and outside positive
        definite inertia and positive periods.

    Gradients: right, but for E/E0 of a steady rotation, from which the tilt grows as a
    square root.
    Source: P. Pravec et al., Icarus 233 (2014) 48 for E/E0; the tilt follows from 2 E /
    L^2, the sum of n_i^2 / I_i with n a unit vector along the angular momentum.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> apophis = jnp.array([0.61, 0.965, 1.0])
    >>> omega = jr.photometry.omega_from_energy(apophis, 1.0236, 27.38 * 3600)
    >>> terms = jr.photometry.tumbling(apophis, omega)
    >>> print((terms.rotation_period / 3600).round(0))
    263.0
    """
    check_option("mode", mode, _MODES)
    arguments = shaped(
        inertia=(inertia, *INERTIA),
        energy_ratio=(energy_ratio,),
        precession_period=(precession_period,),
    )
    return _where_positive(_of_energy, mode == "long-axis", *arguments)


def _of_energy(
    long_axis: bool, inertia: Array, energy_ratio: Scalar, precession_period: Scalar
) -> Vector:
    """The angular velocity of `omega_from_energy`; NaN where there is none."""
    principal = principal_axes(inertia)
    smallest, middle, largest = principal.moments
    # E/E0 of a rotation about the intermediate axis, and about the one that is circled.
    highest = largest / middle
    circled = largest / smallest if long_axis else jnp.ones_like(largest)
    # How far the energy is from that about the circled axis to that about the middle
    # one: the square of the sine of the tilt.
    width = highest - circled
    part = (energy_ratio - circled) / jnp.where(width != 0, width, 1.0)
    exists = (part >= 0) & (part < 1) & (width != 0)
    part = jnp.where(exists, part, 0.5)
    sine = root_of_positive(part)
    cosine = jnp.sqrt(1 - part)
    omega = _of_tilt(principal.moments, sine, cosine, long_axis)
    omega = _with_precession(principal.moments, omega, precession_period)
    return jnp.where(exists, product("ij,j->i", principal.axes, omega), jnp.nan)


def _at_largest_tilt(moments: Vector, y: Scalar, long_axis: bool) -> Vector:
    """Angular velocity for unit angular momentum whose tilt has the tangent exp(y)."""
    # The squares of sine and cosine are 1 / (1 + exp(-2 y)) and 1 / (1 + exp(2 y)):
    # neither is a difference, so that both keep their digits at all tilts.
    sine = jnp.sqrt(jax.nn.sigmoid(2 * y))
    cosine = jnp.sqrt(jax.nn.sigmoid(-2 * y))
    return _of_tilt(moments, sine, cosine, long_axis)


def _of_tilt(moments: Vector, sine: Scalar, cosine: Scalar, long_axis: bool) -> Vector:
    """Angular velocity for unit angular momentum, from sine and cosine of its tilt."""
    zero = jnp.zeros_like(sine)
    momentum = [cosine, sine, zero] if long_axis else [zero, sine, cosine]
    return jnp.stack(momentum) / moments


def _with_precession(
    moments: Vector, omega: Vector, precession_period: Scalar
) -> Vector:
    """The same motion, but so fast that its precession has a given period."""
    period = 2 * jnp.pi / mean_precession_rate(moments, omega)
    return omega * period / precession_period
