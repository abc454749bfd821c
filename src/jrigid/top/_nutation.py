"""What a symmetric top's motion looks like: bounds and period of nutation, precession, kind."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._checks import Enumeration
from jrigid._numerics import root_of_positive, safe_arctan2, safe_norm
from jrigid._types import Scalar
from jrigid.dynamics import State
from jrigid.top._lame_solution import Invariants, invariants, square_of
from jrigid.top._symmetric_top import Answer, SymmetricTop, of_motion


class CLASSES(Enumeration):
    """The kinds of motion that `motion_class` tells apart; `CLASSES[kind]` is the text."""

    wave = "wave"
    cusp = "cusp"
    loop = "loop"
    steady = "steady"
    sleeping = "sleeping"
    pendulum = "pendulum"
    through_the_vertical = "through the vertical"
    undefined = "undefined"


class NutationBounds(NamedTuple):
    """Least and largest tilt of a motion [rad]."""

    theta_min: Scalar
    theta_max: Scalar


class Advance(NamedTuple):
    """By how much the angles of precession and spin grow in one nutation [rad]."""

    phi: Scalar
    psi: Scalar


def _of_invariants(
    formula: Callable[[Invariants], Answer], top: SymmetricTop, state: State
) -> Answer:
    """A formula of the invariants; NaN where the top or the state is not valid."""
    return of_motion(lambda top, state: formula(invariants(top, state)), top, state)


def _bounds(motion: Invariants) -> tuple[Array, Array, Array]:
    """At the least and at the largest tilt |beta|^2 = (1 - cos tilt) / 2 and |alpha|^2; the spread.

    For mgl < 0 of the motion upside down. From the smaller of the two squares, x, which
    keeps its relative accuracy: (dx/dt)^2 / 4 = (X + mu |beta|^2) (-x^2 + c1 x + c0),
    with the root X of the exact flow.
    """
    alpha, d_alpha, beta, d_beta = motion.start
    mu, a, *_ = motion.kept
    hanging = square_of(alpha) < square_of(beta)
    x, dx = jnp.where(hanging, alpha, beta), jnp.where(hanging, d_alpha, d_beta)
    m, c = jnp.where(hanging, mu, -mu), jnp.where(hanging, a - 3 * mu, a)
    now = square_of(x)
    slope = square_of(dx) + now * (c + 2 * m * now)  # zero in steady motion
    root = jnp.where(motion.nutates, motion.root, 0.0)
    front = mu * square_of(beta) + root
    # Upright at the separatrix: from there to -mu x^2 + a x = 0.
    plain = front > 0
    front = jnp.where(plain, front, 1.0)
    speed = jnp.where(plain, (jnp.conj(x) * dx).real / jnp.sqrt(front), 0.0)
    fall = jnp.maximum(a, 0.0) / jnp.where(mu > 0, mu, 1.0)
    skew = jnp.where(plain, slope / front + m * (speed * (speed / front)), fall)
    spread = safe_norm(jnp.stack([skew, 2 * speed]))
    # Without cancellation at the near end.
    far = 0.5 * (jnp.abs(skew) + spread)
    near = speed * (speed / jnp.where(spread > 0, far, 1.0))
    low = jnp.maximum(now - jnp.where(skew > 0, near, far), 0.0)
    high = jnp.minimum(now + jnp.where(skew > 0, far, near), 1.0)
    low, high = jnp.stack([low, 1 - high]), jnp.stack([high, 1 - low])
    low, high = (
        jnp.where(hanging, y[::-1], y) for y in (low, high)
    )  # of beta and of alpha
    # Where the lower bound is far below the upper one, with its relative accuracy: at x
    # = 0 the slope's square is -J^2, of the constant momentum J. Roots of a smaller
    # size carry rounding of the larger numbers they come from.
    front, momenta = jnp.stack([root, root + mu]), jnp.stack(motion.momenta[::-1])
    sound = motion.nutates & (front > 0.01 * mu) & (front > 0) & (low < 0.25 * high)
    of_root = momenta * (momenta / jnp.where(sound, front, 1.0))
    low = jnp.where(sound, of_root / jnp.where(sound, high, 1.0), low)
    return jnp.stack([low[0], high[0]]), jnp.stack([high[1], low[1]]), spread


def nutation_bounds(top: SymmetricTop, state: State) -> NutationBounds:
    """The tilts between which the axis nods.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        Least and largest angle between the axis and the vertical; equal in steady
        precession.

    Gradients: right where the two differ and neither is vertical; finite everywhere:
    without the infinite part where they meet, zero at the vertical.
    Source: the roots of `cubic`, from the state rather than from its coefficients.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> bounds = jr.top.nutation_bounds(top, jr.top.initial_state(top, 0.5, omega3=5.0))
    >>> print(bounds.theta_min.round(4), bounds.theta_max.round(4))
    0.5 0.7576
    """

    def tilts(motion: Invariants) -> NutationBounds:
        of_beta, of_alpha, _ = _bounds(motion)
        both = 2 * safe_arctan2(root_of_positive(of_beta), root_of_positive(of_alpha))
        return NutationBounds(*jnp.where(motion.hangs, jnp.pi - both[::-1], both))

    return _of_invariants(tilts, top, state)


def nutation_period(top: SymmetricTop, state: State) -> Scalar:
    """Time from one least tilt to the next.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        The period [s]; in steady precession that of small nutations; of a pendulum half
        a swing, or a whole turn; infinite on the separatrix and for a top without
        weight at rest.

    Gradients: analytic, also in steady precession; zero where the period is infinite.
    Source: docs/top.md, an arithmetic-geometric mean.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> state = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> print(jr.top.nutation_period(top, state).round(5))
    3.51772
    """
    return _of_invariants(
        lambda x: jnp.where(x.nutates, x.period / x.unit, jnp.inf), top, state
    )


def _advance(motion: Invariants) -> Advance:
    plus, less = motion.momenta
    of_alpha = motion.advance_alpha + jnp.pi * jnp.sign(plus)
    of_beta = motion.advance_beta + motion.half_turn * jnp.sign(less)
    phi = jnp.where(motion.hangs, -1.0, 1.0) * (of_alpha + of_beta)
    psi = (
        of_alpha - of_beta + (motion.omega3 - motion.spin) / motion.unit * motion.period
    )
    return Advance(*(jnp.where(motion.nutates, x, 0.0) for x in (phi, psi)))


def advance_per_nutation(top: SymmetricTop, state: State) -> Advance:
    """Angles by which the axis precesses and the body spins in one period of nutation.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        Growth of phi and psi [rad]. In a motion through the vertical, where phi jumps
        by half a turn to either side, the mean of the two. Zero where the period is
        infinite.

    Gradients: those of the branch, also in steady precession and through the vertical.
    Source: docs/top.md.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> state = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> print(jr.top.advance_per_nutation(top, state).phi.round(5))
    1.62782
    """
    return _of_invariants(_advance, top, state)


def mean_precession(top: SymmetricTop, state: State) -> Scalar:
    """Mean rate at which the axis turns about the vertical, over a period of nutation.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        The rate [rad/s]; in steady precession the rate of that; where the period is
        infinite that with which the axis comes upright, I3 omega3 / (2 I1) (mgl < 0:
        upside down, the opposite).

    Gradients: analytic, also in steady precession; it jumps where the axis passes the
        vertical.
    Source: docs/top.md.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> print(jr.top.mean_precession(top, jr.top.initial_state(top, 0.5, omega3=100.0)).round(8))
    0.02000702
    """

    def rate(motion: Invariants) -> Array:
        endless = jnp.where(motion.hangs, -0.5, 0.5) * motion.spin
        mean = motion.unit * _advance(motion).phi / motion.period
        return jnp.where(motion.nutates, mean, endless)

    return _of_invariants(rate, top, state)


def motion_class(top: SymmetricTop, state: State) -> CLASSES:
    """What kind of motion it is, a member of `CLASSES`.

    The path of the axis on the sphere is a wave where it precesses one way throughout,
    a loop where it turns back in each nutation, and has cusps between the two. Steady:
    at a constant tilt. Sleeping: at the vertical, upright or hanging. Pendulum: in a
    plane through the vertical, without spin. Through the vertical: spinning, and
        upright or hanging at times.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        The kind; `CLASSES.undefined` where the top or the state is not valid. Two sides
        are told apart to some 1e-12 (float32: 5e-4) of their size.

    Gradients: none, it is an integer.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 35, problem 1.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> released = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> kind = jr.top.motion_class(top, released)
    >>> print(jr.top.CLASSES[kind], kind == jr.top.CLASSES.cusp)
    cusp True
    """
    motion = jax.lax.stop_gradient(_of_invariants(lambda motion: motion, top, state))
    alpha, d_alpha, beta, d_beta = motion.start
    plus, less = motion.momenta  # about the vertical and the axis, added and subtracted
    of_beta, of_alpha, spread = _bounds(motion)
    eps = jnp.finfo(spread.dtype).eps
    tolerance = 4096 * eps
    rate = jnp.sqrt(motion.kept[0] + square_of(d_alpha) + square_of(d_beta))
    rate = jnp.where(rate > 0, rate, 1.0)
    pairs = (alpha, d_alpha), (beta, d_beta)
    away = jnp.minimum(*(rate**2 * square_of(x) + square_of(dx) for x, dx in pairs))
    # phi' sin^2 / 4 at both bounds, 0 to rounding
    turning = plus * of_beta + less * of_alpha
    rounding = tolerance * (jnp.abs(plus * of_beta) + jnp.abs(less * of_alpha))
    turns = jnp.prod(jnp.where(jnp.abs(turning) <= rounding, 0.0, jnp.sign(turning)))
    vertical = (of_beta[0] <= tolerance * of_beta[1]) | (
        of_alpha[1] <= tolerance * of_alpha[0]
    )
    widest = of_beta[1] * of_alpha[0]
    momentum = jnp.maximum(jnp.abs(plus), jnp.abs(less))
    kind = CLASSES.wave
    for holds, other in (
        (turns < 0, CLASSES.loop),
        (turns == 0, CLASSES.cusp),
        (vertical, CLASSES.through_the_vertical),
        (momentum <= tolerance * rate * widest, CLASSES.pendulum),
        (spread <= tolerance * widest, CLASSES.steady),
        (away <= (4 * eps * rate) ** 2, CLASSES.sleeping),
        (jnp.isnan(motion.unit), CLASSES.undefined),
    ):
        kind = CLASSES.where(holds, other, kind)
    return kind
