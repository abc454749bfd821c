"""What a symmetric top's motion looks like: bounds and period of nutation, precession, kind."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._checks import Enumeration, where_defined
from jrigid._numerics import safe_arctan2
from jrigid._types import Scalar
from jrigid.dynamics import State
from jrigid.top._flow import Invariants, invariants, square_of
from jrigid.top._top import Answer, SymmetricTop, top_and_state


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


def _of_motion(formula: Callable[[Invariants], Answer], top: SymmetricTop, state: State) -> Answer:
    """A formula of the invariants; NaN where the top or the state is not valid."""
    ok, top, state, _ = top_and_state("state", top, state)
    return where_defined(ok, lambda top, state: formula(invariants(top, state)), top, state)


class _Bounds(NamedTuple):
    """|beta|^2 = (1 - cos tilt) / 2 and |alpha|^2 at the bounds; mgl < 0: of the axis reversed."""

    beta_low: Array
    beta_high: Array
    alpha_low: Array
    alpha_high: Array
    spread: Array


def _bounds(motion: Invariants) -> _Bounds:
    """From the smaller of the two squares, x, which keeps its relative accuracy.

    (dx/dt)^2 / 4 = (X + mu |beta|^2) (-x^2 + c1 x + c0), with the root X of the exact flow.
    """
    alpha, beta, d_alpha, d_beta = motion.start
    hanging = square_of(alpha) < square_of(beta)
    x, dx = jnp.where(hanging, alpha, beta), jnp.where(hanging, d_alpha, d_beta)
    m = jnp.where(hanging, motion.mu, -motion.mu)
    a = jnp.where(hanging, motion.a - 3 * motion.mu, motion.a)
    now = square_of(x)
    slope = square_of(dx) + now * (a + 2 * m * now)  # zero in steady motion
    front = motion.mu * square_of(beta) + jnp.where(motion.nutates, motion.root, 0.0)
    # Upright at the separatrix: from there to -mu x^2 + a x = 0.
    plain = front > 0
    front = jnp.where(plain, front, 1.0)
    speed = (jnp.conj(x) * dx).real / jnp.sqrt(front)
    skew = slope / front + m * (speed / jnp.sqrt(front)) * (speed / jnp.sqrt(front))
    fall = jnp.maximum(a, 0.0) / jnp.where(motion.mu > 0, motion.mu, 1.0)
    skew = jnp.where(plain, skew, jnp.where(motion.mu > 0, fall, 0.0))
    speed = jnp.where(plain, speed, 0.0)
    # A length without underflow, and at a double root zero without a derivative.
    size = jax.lax.stop_gradient(jnp.maximum(jnp.abs(skew), jnp.abs(speed)))
    distinct = size > 0
    size = jnp.where(distinct, size, 1.0)
    square = (skew / size) ** 2 + 4 * (speed / size) ** 2
    spread = jnp.where(distinct, size * jnp.sqrt(jnp.where(distinct, square, 1.0)), 0.0)
    # Without cancellation at the near end.
    far = 0.5 * (jnp.abs(skew) + spread)
    near = speed * (speed / jnp.where(distinct, far, 1.0))
    low = jnp.maximum(now - jnp.where(skew > 0, near, far), 0.0)
    high = jnp.minimum(now + jnp.where(skew > 0, far, near), 1.0)
    beta_low, beta_high = jnp.where(hanging, 1 - high, low), jnp.where(hanging, 1 - low, high)
    alpha_low, alpha_high = jnp.where(hanging, low, 1 - high), jnp.where(hanging, high, 1 - low)
    return _Bounds(
        _nearest(motion, beta, d_beta, 0.0, beta_low, beta_high),
        beta_high,
        _nearest(motion, alpha, d_alpha, 1.0, alpha_low, alpha_high),
        alpha_high,
        spread,
    )


def _nearest(
    motion: Invariants, x: Array, dx: Array, at_zero: float, low: Array, high: Array
) -> Array:
    """The lower bound of |x|^2 where it is far below the upper one, with its relative accuracy.

    At x = 0 the slope's square is -J^2, of the constant momentum J = Im(x* dx/dt).
    """
    front = jnp.where(motion.nutates, motion.root, 0.0) + at_zero * motion.mu
    # Roots of a smaller size carry rounding of the larger numbers they come from.
    sound = motion.nutates & (front > 0.01 * motion.mu) & (front > 0) & (low < 0.25 * high)
    momentum = (jnp.conj(x) * dx).imag
    of_root = momentum * (momentum / jnp.where(sound, front, 1.0))
    return jnp.where(sound, of_root / jnp.where(sound, high, 1.0), low)


def _tilt(of_beta: Array, of_alpha: Array) -> Array:
    inside = (of_beta > 0) & (of_alpha > 0)
    roots = (jnp.sqrt(jnp.where(inside, x, 0.5)) for x in (of_beta, of_alpha))
    return jnp.where(inside, 2 * safe_arctan2(*roots), jnp.where(of_beta > 0, jnp.pi, 0.0))


def nutation_bounds(top: SymmetricTop, state: State) -> NutationBounds:
    """The tilts between which the axis nods.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        Least and largest angle between the axis and the vertical; equal in steady precession.

    Gradients: right where the two differ and neither is vertical; finite everywhere: without the
    infinite part where they meet, zero at the vertical.
    Source: the roots of `cubic`, from the state rather than from its coefficients.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> bounds = jr.top.nutation_bounds(top, jr.top.initial_state(top, 0.5, omega3=5.0))
    >>> print(bounds.theta_min.round(4), bounds.theta_max.round(4))
    0.5 0.7576
    """

    def tilts(motion: Invariants) -> NutationBounds:
        squares = _bounds(motion)
        low = _tilt(squares.beta_low, squares.alpha_high)
        high = _tilt(squares.beta_high, squares.alpha_low)
        least = jnp.where(motion.hangs, jnp.pi - high, low)
        return NutationBounds(least, jnp.where(motion.hangs, jnp.pi - low, high))

    return _of_motion(tilts, top, state)


def nutation_period(top: SymmetricTop, state: State) -> Scalar:
    """Time from one least tilt to the next.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        The period [s]; in steady precession that of small nutations; of a pendulum half a swing,
        or a whole turn; infinite on the separatrix and for a top without weight at rest.

    Gradients: analytic, also in steady precession; zero where the period is infinite.
    Source: docs/top.md, an arithmetic-geometric mean.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> state = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> print(jr.top.nutation_period(top, state).round(5))
    3.51772
    """
    return _of_motion(lambda x: jnp.where(x.nutates, x.period / x.unit, jnp.inf), top, state)


def _side(x: Array, dx: Array) -> Array:
    """Sign of the sense in which a complex number turns."""
    return jnp.sign((jnp.conj(x) * dx).imag)


def _advance(motion: Invariants) -> Advance:
    alpha, beta, d_alpha, d_beta = motion.start
    of_alpha = motion.advance_alpha + jnp.pi * _side(alpha, d_alpha)
    of_beta = motion.advance_beta + jnp.where(motion.wide, jnp.pi * _side(beta, d_beta), 0.0)
    spin = jnp.where(motion.hangs, of_beta - of_alpha, of_alpha - of_beta)
    advance = of_alpha + of_beta, spin + motion.slip * motion.period
    return Advance(*(jnp.where(motion.nutates, x, 0.0) for x in advance))


def advance_per_nutation(top: SymmetricTop, state: State) -> Advance:
    """Angles by which the axis precesses and the body spins in one period of nutation.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        Growth of phi and psi [rad]. In a motion through the vertical, where phi jumps by half a
        turn to either side, the mean of the two. Zero where the period is infinite.

    Gradients: those of the branch, also in steady precession and through the vertical.
    Source: docs/top.md.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> state = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> print(jr.top.advance_per_nutation(top, state).phi.round(5))
    1.62782
    """
    return _of_motion(_advance, top, state)


def mean_precession(top: SymmetricTop, state: State) -> Scalar:
    """Mean rate at which the axis turns about the vertical, over a period of nutation.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        The rate [rad/s]; in steady precession the rate of that; where the period is infinite that
        with which the axis comes upright, I3 omega3 / (2 I1) (mgl < 0: upside down, the opposite).

    Gradients: analytic, also in steady precession; it jumps where the axis passes the vertical.
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

    return _of_motion(rate, top, state)


def motion_class(top: SymmetricTop, state: State) -> CLASSES:
    """What kind of motion it is, a member of `CLASSES`.

    The path of the axis on the sphere is a wave where it precesses one way throughout, a loop
    where it turns back in each nutation, and has cusps between the two. Steady: at a constant
    tilt. Sleeping: at the vertical, upright or hanging. Pendulum: in a plane through the vertical,
    without spin. Through the vertical: spinning, and upright or hanging at times.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        The kind; `CLASSES.undefined` where the top or the state is not valid. Two sides are told
        apart to some 1e-12 (float32: 5e-4) of their size.

    Gradients: none, it is an integer.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 35, problem 1.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> released = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> kind = jr.top.motion_class(top, released)
    >>> print(jr.top.CLASSES[kind], kind == jr.top.CLASSES.cusp)
    cusp True
    """
    ok, top, state, _ = top_and_state("state", top, state)
    motion = jax.lax.stop_gradient(invariants(top, state))
    alpha, beta, d_alpha, d_beta = motion.start
    beta_low, beta_high, alpha_low, alpha_high, spread = _bounds(motion)
    eps = jnp.finfo(spread.dtype).eps
    tolerance = 4096 * eps
    # Momenta about the vertical and the axis, less and plus, over 4 I1
    plus, less = (jnp.conj(alpha) * d_alpha).imag, (jnp.conj(beta) * d_beta).imag
    size = jnp.maximum(jnp.abs(plus), jnp.abs(less))
    rate = jnp.sqrt(motion.mu + square_of(d_alpha) + square_of(d_beta))
    rate = jnp.where(rate > 0, rate, 1.0)

    def sense(of_beta: Array, of_alpha: Array) -> Array:
        """Sign of phi' sin^2 / 4 = plus |beta|^2 + less |alpha|^2, 0 to rounding."""
        parts = plus * of_beta, less * of_alpha
        scale = jnp.abs(parts[0]) + jnp.abs(parts[1])
        total = parts[0] + parts[1]
        return jnp.where(jnp.abs(total) <= tolerance * scale, 0.0, jnp.sign(total))

    turns = sense(beta_low, alpha_high) * sense(beta_high, alpha_low)
    vertical = (beta_low <= tolerance * beta_high) | (alpha_low <= tolerance * alpha_high)
    upright, hanging = (
        square_of(x) + square_of(dx) / rate**2 <= (4 * eps) ** 2
        for x, dx in ((beta, d_beta), (alpha, d_alpha))
    )
    kind = CLASSES.wave
    for holds, other in (
        (turns < 0, CLASSES.loop),
        (turns == 0, CLASSES.cusp),
        (vertical, CLASSES.through_the_vertical),
        (size <= tolerance * rate * beta_high * alpha_high, CLASSES.pendulum),
        (spread <= tolerance * beta_high * alpha_high, CLASSES.steady),
        (upright | hanging, CLASSES.sleeping),
        (~ok, CLASSES.undefined),
    ):
        kind = CLASSES.where(holds, other, kind)
    return kind
