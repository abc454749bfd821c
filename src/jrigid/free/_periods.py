"""Periods, phases and the kind of a free rotation of any body."""

import jax.numpy as jnp

from jrigid._checks import Enumeration
from jrigid._numerics import root_of_positive, safe_norm
from jrigid._types import InertiaLike, Scalar, VectorLike
from jrigid.free._free_rotation import from_invariants
from jrigid.free._jacobi_solution import Invariants

# Below this many eps, relative, two moments are one and a motion is on the separatrix.
_ROUNDING = 64


class REGIMES(Enumeration):
    """Kinds of free motion: `REGIMES[code]` is the text of what `regime` answers."""

    at_rest = "at rest"
    sphere = "sphere"
    steady_rotation = "steady rotation"
    about_smallest = "about the axis of the smallest moment"
    about_largest = "about the axis of the largest moment"
    separatrix = "separatrix"
    undefined = (
        "undefined: the inertia is not positive definite, or a rate is not finite"
    )


def polhode_period(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Time after which the angular velocity of a free body comes back, in the body.

    4 K(m) / lam of Jacobi's solution; 2 pi / |wobble rate| for a symmetric body; of
    spin about a stable axis the limit of small wobbles. Infinite where nothing comes
    round: sphere, separatrix, spin about the middle axis or an axis of no distinction,
        rest.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        Period [s]; NaN outside positive definite inertia and finite rates.

    Gradients: right wherever the period is finite; zero where it is infinite.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., eq. 37.12.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.free.polhode_period(jnp.array([1., 2., 3.]), jnp.array([0.1, 0.0, 1.0])).round(4))
    6.2884
    """
    return from_invariants(
        lambda x: jnp.where(x.circles, 4 * x.quarter / x.unit, jnp.inf), inertia, omega
    )


def mean_precession_rate(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Mean rate at which the axis that the momentum circles turns about the momentum in space.

    |L| / I1 for a symmetric body; |L| / I2 on the separatrix and about an axis of no distinction.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        Rate [rad/s]; NaN outside positive definite inertia and finite rates.

    Gradients: right off the separatrix; there the rate has infinite slope, and |L| /
        I2's is given.
    Source: the complete integral of the third kind in docs/free_rotation.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> rate = jr.free.mean_precession_rate(jnp.array([1., 2., 3.]), jnp.array([0.1, 0.0, 1.0]))
    >>> print(rate.round(4))
    2.0008
    """
    return from_invariants(
        lambda motion: motion.unit * _mean_rate(motion), inertia, omega
    )


def _mean_rate(motion: Invariants) -> Scalar:
    """Mean precession rate, in units of the motion's."""
    quarter = jnp.where(motion.circles, motion.quarter, 1.0)
    extra = motion.al * motion.v * motion.quarter_w / quarter
    over_momentum = 1 / motion.moments[1] + jnp.where(motion.circles, extra, 0.0)
    return safe_norm(jnp.stack(motion.momentum)) * over_momentum


def precession_per_period(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Angle about the momentum by which a free body has turned after one polhode period.

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
    return from_invariants(
        lambda x: jnp.where(x.circles, 4 * x.quarter * _mean_rate(x), jnp.inf),
        inertia,
        omega,
    )


def geometric_phase(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Part of `precession_per_period` beyond the dynamic phase 2 E T / |L|.

    Up to whole turns it is minus the solid angle that the momentum circles in the body
    (positive where it goes round the axis in the right-handed sense): it depends on the
    shape of the polhode and not on the pace.

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


def parameter(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Parameter m = k^2 of the Jacobi functions of the motion, from 0 to 1 on the separatrix.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity, body components [rad/s].

    Returns:
        m; 0 for symmetric bodies, spheres, spin about a stable axis, and at rest. NaN
        outside positive definite inertia and finite rates.

    Gradients: right where no two moments are equal; where two are, m has a kink at 0
    and the slope of one side is given; zero for a sphere and at rest.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., eq. 37.11.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.free.parameter(jnp.array([1.0, 2.0, 3.0]), jnp.array([0.1, 0.0, 1.0])).round(6))
    0.003333
    """
    return from_invariants(_parameter, inertia, omega)


def _parameter(motion: Invariants) -> Scalar:
    al, be = motion.al, motion.be
    l1, l2, _ = motion.momentum
    p = al * ((al + be) * l1 * l1 + be * l2 * l2)
    q = p + (motion.u + motion.v)  # not kap + v: never below p
    return jnp.where(q > 0, p / jnp.where(q > 0, q, 1.0), 0.0)


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


def regime(inertia: InertiaLike, omega: VectorLike) -> REGIMES:
    """Which kind of motion it is.

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
    rate = jnp.stack([be * l2 * l3, (al + be) * l3 * l1, al * l1 * l2])
    size = jnp.maximum(jnp.abs(al), jnp.abs(be)) * motion.momentum_square
    first, third = jnp.abs(al) * l1 * l1, jnp.abs(be) * l3 * l3
    kind = REGIMES.where(i3 < i1, REGIMES.about_smallest, REGIMES.about_largest)
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
