"""Periods, phases and the kind of a free rotation of any body."""

import jax.numpy as jnp

from jrigid._checks import Enumeration
from jrigid._core.compile import one_program
from jrigid._numerics import root_of_positive, safe_norm
from jrigid._types import InertiaLike, Scalar, VectorLike
from jrigid.free._free_rotation import from_invariants
from jrigid.free._jacobi_solution import Invariants

# Below this many eps, relative, two moments are one and a motion is on the separatrix.
_ROUNDING = 64


class REGIMES(Enumeration):
    """Kinds of free rotation, as `regime` returns them; `REGIMES[code]` is the text."""

    at_rest = "at rest"
    sphere = "sphere"
    steady_rotation = "steady rotation"
    about_smallest = "about the axis of the smallest moment"
    about_largest = "about the axis of the largest moment"
    separatrix = "separatrix"
    undefined = (
        "undefined: the inertia is not positive definite, or a rate is not finite"
    )


@one_program
def polhode_period(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Period of the angular velocity of a free body, in the body.

    It is 4 K(m) / lam of Jacobi's solution, and 2 pi / |wobble rate| for a symmetric
    body. For spin about a stable axis it is the limit of small wobbles. It is infinite
    for a sphere, on the separatrix, for spin about the intermediate axis or about any
    axis in a plane of equal moments, and at rest.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        Period [s]; NaN outside positive definite inertia and finite rates.

    Gradients: right wherever the period is finite; zero where it is infinite.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., eq. 37.12.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> moments, omega = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.1, 0.0, 1.0])
    >>> print(jr.free.polhode_period(moments, omega).round(4))
    6.2884
    """

    def period(motion: Invariants) -> Scalar:
        return jnp.where(motion.circles, 4 * motion.quarter / motion.unit, jnp.inf)

    return from_invariants(period, inertia, omega)


@one_program
def mean_precession_rate(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Mean rate at which a free body precesses about its momentum in space.

    It is the rate of the axis that the momentum circles. It equals |L| / I1 for a
    symmetric body, and |L| / I2 on the separatrix and for spin about an axis in a plane
    of equal moments.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        Rate [rad/s]; NaN outside positive definite inertia and finite rates.

    Gradients: right off the separatrix. On it the rate has infinite slope, and the
    gradient is that of |L| / I2.
    Source: the complete integral of the third kind in docs/free_rotation.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> moments, omega = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.1, 0.0, 1.0])
    >>> print(jr.free.mean_precession_rate(moments, omega).round(4))
    2.0008
    """

    def rate(motion: Invariants) -> Scalar:
        return motion.unit * _mean_rate(motion)

    return from_invariants(rate, inertia, omega)


def _mean_rate(motion: Invariants) -> Scalar:
    """Mean precession rate in units of the motion."""
    quarter = jnp.where(motion.circles, motion.quarter, 1.0)
    # This is the part with w of `phase` in `_jacobi_solution.py`, averaged over a
    # quarter period.
    extra = motion.al * motion.v * motion.quarter_w / quarter
    over_momentum = 1 / motion.moments[1] + jnp.where(motion.circles, extra, 0.0)
    return safe_norm(jnp.stack(motion.momentum)) * over_momentum


@one_program
def precession_per_period(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Angle by which a free body turns about its momentum in one polhode period.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        Angle [rad], not reduced: `mean_precession_rate` times `polhode_period`;
        infinite where the period is. NaN outside positive definite inertia and finite
        rates.

    Gradients: right wherever the angle is finite; zero where it is infinite.
    Source: R. Montgomery, Am. J. Phys. 59 (1991) 394.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body, omega = jnp.array([1.0, 1.0, 2.0]), jnp.array([0.1, 0.0, 1.0])
    >>> print(jr.free.precession_per_period(body, omega).round(4))
    12.5821
    """

    def angle(motion: Invariants) -> Scalar:
        # Both factors are in units of the motion, which cancel in an angle.
        turned = 4 * motion.quarter * _mean_rate(motion)
        return jnp.where(motion.circles, turned, jnp.inf)

    return from_invariants(angle, inertia, omega)


@one_program
def geometric_phase(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Part of `precession_per_period` beyond the dynamic phase 2 E T / |L|.

    Up to whole turns it is minus the solid angle that the momentum encloses in the body
    (positive where it goes round the axis in the right-handed sense). It depends on the
    shape of the polhode and not on the rate.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        Angle [rad], not reduced; 0 where the period is infinite and nothing is circled.
        NaN outside positive definite inertia and finite rates.

    Gradients: right wherever the period is finite; zero where it is infinite.
    Source: R. Montgomery, Am. J. Phys. 59 (1991) 394.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body, omega = jnp.array([1.0, 1.0, 2.0]), jnp.array([0.1, 0.0, 1.0])
    >>> print(f"{jr.free.geometric_phase(body, omega):.4f}")
    6.2753
    """
    return from_invariants(_geometric_phase, inertia, omega)


def _geometric_phase(motion: Invariants) -> Scalar:
    """Geometric phase in one period; 0 where there is none."""
    square = motion.momentum_square
    size = safe_norm(jnp.stack(motion.momentum))
    # 1 / I2 - 2 E / |L|^2, without the difference: al be (2 E - |L|^2 / I2) is -al v
    gap = motion.v / jnp.where(motion.be == 0, 1.0, motion.be)
    gap = jnp.where(
        motion.be == 0, motion.u / jnp.where(motion.al == 0, 1.0, motion.al), gap
    )
    slow = motion.quarter * gap / jnp.where(square == 0, 1.0, square)
    phase = 4 * size * (slow + motion.al * motion.v * motion.quarter_w)
    return jnp.where(motion.circles, phase, 0.0)


@one_program
def parameter(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Parameter m = k^2 of the Jacobi functions of the motion; 1 on the separatrix.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        m; 0 for symmetric bodies, spheres, spin about a stable axis, and at rest. NaN
        outside positive definite inertia and finite rates.

    Gradients: right where no two moments are equal. Where two are equal m has a kink at
    0, and the gradient is that of one side. Zero for a sphere and at rest.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., eq. 37.11.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> moments, omega = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.1, 0.0, 1.0])
    >>> print(jr.free.parameter(moments, omega).round(6))
    0.003333
    """
    return from_invariants(_parameter, inertia, omega)


def _parameter(motion: Invariants) -> Scalar:
    """P / Q, without the cancellation in either."""
    al, be = motion.al, motion.be
    l1, l2, _ = motion.momentum
    # P = kap - u. Since al and be have one sign, this is a sum of non-negative numbers.
    p = al * ((al + be) * l1 * l1 + be * l2 * l2)
    q = p + (motion.u + motion.v)  # not kap + v: never below p
    return jnp.where(q > 0, p / jnp.where(q > 0, q, 1.0), 0.0)


@one_program
def modulus(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Modulus k of the Jacobi functions of the motion, from 0 to 1 on the separatrix.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        k = sqrt(m), see `parameter`; NaN where that is.

    Gradients: at k = 0, where k has a kink, zero; `parameter` is smooth at a stable
    spin.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., eq. 37.11.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> k = jr.free.modulus(jnp.array([1.0, 2.0, 3.0]), jnp.array([0.1, 0.0, 1.0]))
    >>> print(f"{k:.6f}")
    0.057735
    """
    return from_invariants(lambda x: root_of_positive(_parameter(x)), inertia, omega)


@one_program
def regime(inertia: InertiaLike, omega: VectorLike) -> REGIMES:
    """Kind of a free rotation.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        A member of `free.REGIMES`, `undefined` outside positive definite inertia and
        finite rates. A symmetric body goes about the axis of its smallest moment
        (prolate) or its largest (oblate). Equalities hold to a few eps.

    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 37.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> code = jr.free.regime(jnp.array([1.0, 2.0, 3.0]), jnp.array([0.1, 0.0, 1.0]))
    >>> jr.free.REGIMES[code]
    'about the axis of the largest moment'
    """
    motion = from_invariants(lambda motion: motion, inertia, omega)
    rounding = _ROUNDING * jnp.finfo(motion.kap.dtype).eps
    i1, _, i3 = motion.moments
    l1, l2, l3 = motion.momentum
    al, be = motion.al, motion.be
    # Rates of the angular momentum by Euler's equations, but for signs.
    rate = jnp.stack([be * l2 * l3, (al + be) * l3 * l1, al * l1 * l2])
    size = jnp.maximum(jnp.abs(al), jnp.abs(be)) * motion.momentum_square
    # The two are equal where 2 E = |L|^2 / I2, which is the separatrix.
    first, third = jnp.abs(al) * l1 * l1, jnp.abs(be) * l3 * l3
    kind = REGIMES.where(i3 < i1, REGIMES.about_smallest, REGIMES.about_largest)
    # A later case overrides an earlier one: a sphere, for example, always rotates
    # steadily.
    for case, code in (
        (
            jnp.abs(first - third) <= rounding * jnp.maximum(first, third),
            REGIMES.separatrix,
        ),
        (jnp.max(jnp.abs(rate)) <= rounding * size, REGIMES.steady_rotation),
        (jnp.abs(i3 - i1) <= rounding * jnp.maximum(i1, i3), REGIMES.sphere),
        (motion.momentum_square == 0, REGIMES.at_rest),
        (jnp.isnan(motion.unit), REGIMES.undefined),
    ):
        kind = REGIMES.where(case, code, kind)
    return kind
