"""Nutation and precession of a symmetric top: bounds, period, mean rate, kind."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._checks import Enumeration
from jrigid._core.compile import one_program
from jrigid._numerics import root_of_positive, safe_arctan2, safe_norm
from jrigid._types import Scalar, ScalarLike
from jrigid.dynamics import State
from jrigid.top._lame_solution import Invariants, invariants, square_of
from jrigid.top._symmetric_top import Answer, SymmetricTop, of_motion


class CLASSES(Enumeration):
    """Kinds of motion that `motion_class` returns; `CLASSES[kind]` is the text."""

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
    """Growth of the angles of precession and spin in one nutation [rad]."""

    phi: Scalar
    psi: Scalar


def _of_invariants(
    formula: Callable[[Invariants], Answer], top: SymmetricTop, state: State
) -> Answer:
    """Apply a formula of the invariants; NaN where top or state are not valid."""
    return of_motion(lambda top, state: formula(invariants(top, state)), top, state)


class _Bounds(NamedTuple):
    """Squares at the least and at the largest tilt, of a motion with mgl >= 0.

    A motion with mgl < 0 is described upside down.
    """

    of_beta: Array  # |beta|^2 = (1 - cos tilt) / 2
    of_alpha: Array  # |alpha|^2
    spread: Array  # difference of |beta|^2 at the two


# Long: one formula from the state to both bounds, where each line needs those above.
def _bounds(motion: Invariants) -> _Bounds:
    """The squares |alpha|^2 and |beta|^2 at the bounds of the tilt.

    They follow from the smaller of the two squares, x, which keeps its relative
    accuracy: (dx/dt)^2 / 4 = (X + mu |beta|^2) (-x^2 + c1 x + c0), with the root X of
    the exact flow.
    """
    alpha, d_alpha, beta, d_beta = motion.start
    mu, a, *_ = motion.constants
    hanging = square_of(alpha) < square_of(beta)
    x = jnp.where(hanging, alpha, beta)
    dx = jnp.where(hanging, d_alpha, d_beta)
    m = jnp.where(hanging, mu, -mu)
    c = jnp.where(hanging, a - 3 * mu, a)
    now = square_of(x)
    slope = square_of(dx) + now * (c + 2 * m * now)  # zero in steady motion
    root = jnp.where(motion.nutates, motion.root, 0.0)
    front = mu * square_of(beta) + root
    # Upright on the separatrix: from there to the other root of -mu x^2 + a x = 0.
    plain = front > 0
    front = jnp.where(plain, front, 1.0)
    speed = jnp.where(plain, (jnp.conj(x) * dx).real / jnp.sqrt(front), 0.0)
    fall = jnp.maximum(a, 0.0) / jnp.where(mu > 0, mu, 1.0)
    skew = jnp.where(plain, slope / front + m * (speed * (speed / front)), fall)
    spread = safe_norm(jnp.stack([skew, 2 * speed]))
    # The nearer bound is formed without cancellation.
    far = 0.5 * (jnp.abs(skew) + spread)
    near = speed * (speed / jnp.where(spread > 0, far, 1.0))
    least = jnp.maximum(now - jnp.where(skew > 0, near, far), 0.0)
    most = jnp.minimum(now + jnp.where(skew > 0, far, near), 1.0)
    low = jnp.stack([least, 1 - most])
    high = jnp.stack([most, 1 - least])
    # In the order (of beta, of alpha).
    low = jnp.where(hanging, low[::-1], low)
    high = jnp.where(hanging, high[::-1], high)
    low = _accurate_low(motion, root, low, high)
    return _Bounds(jnp.stack([low[0], high[0]]), jnp.stack([high[1], low[1]]), spread)


def _accurate_low(motion: Invariants, root: Array, low: Array, high: Array) -> Array:
    """Lower bounds with full relative accuracy where they are far below the upper ones.

    At x = 0 the square of the slope is -J^2, with J the constant momentum, so the
    product of both bounds is known. Roots of a smaller size carry the rounding of the
    larger numbers they come from, and are not used.
    """
    mu, *_ = motion.constants
    front = jnp.stack([root, root + mu])
    momenta = jnp.stack(motion.momenta[::-1])
    usable = motion.nutates & (front > 0.01 * mu) & (front > 0) & (low < 0.25 * high)
    both = momenta * (momenta / jnp.where(usable, front, 1.0))
    return jnp.where(usable, both / jnp.where(usable, high, 1.0), low)


@one_program
def nutation_bounds(top: SymmetricTop, state: State) -> NutationBounds:
    """Least and largest tilt of a motion.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        Least and largest angle between the axis and the vertical; equal in steady
        precession.

    Gradients: right where the two differ and neither is vertical. Where the two meet
    the infinite part is left out; at the vertical they are zero.
    Source: the roots of `cubic`, from the state rather than from its coefficients.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> bounds = jr.top.nutation_bounds(top, jr.top.initial_state(top, 0.5, omega3=5.0))
    >>> print(bounds.theta_min.round(4), bounds.theta_max.round(4))
    0.5 0.7576
    """

    def tilts(motion: Invariants) -> NutationBounds:
        of_beta, of_alpha, _ = _bounds(motion)
        # The arc cosine of cos theta would lose half the digits of a small tilt.
        both = 2 * safe_arctan2(root_of_positive(of_beta), root_of_positive(of_alpha))
        return NutationBounds(*jnp.where(motion.hangs, jnp.pi - both[::-1], both))

    return _of_invariants(tilts, top, state)


@one_program
def nutation_period(top: SymmetricTop, state: State) -> Scalar:
    """Time from one least tilt to the next.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        The period [s]. In steady precession it is that of small nutations, and for a
        pendulum it is half a swing, or a whole turn. It is infinite on the separatrix
        and for a top without weight at rest.

    Gradients: analytic, also in steady precession; zero where the period is infinite.
    Source: docs/top.md, an arithmetic-geometric mean.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> state = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> print(jr.top.nutation_period(top, state).round(5))
    3.51772
    """

    def period(motion: Invariants) -> Array:
        return jnp.where(motion.nutates, motion.period / motion.unit, jnp.inf)

    return _of_invariants(period, top, state)


def _advance(motion: Invariants) -> Advance:
    """Advance in one nutation; zero where no nutation ends."""
    momentum_alpha, momentum_beta = motion.momenta
    # Each argument makes its half turn in the sense of its constant momentum. If that
    # is zero, both senses are as good, and their mean is 0.
    of_alpha = motion.advance_alpha + jnp.pi * jnp.sign(momentum_alpha)
    of_beta = motion.advance_beta + motion.half_turn * jnp.sign(momentum_beta)
    phi = jnp.where(motion.hangs, -1.0, 1.0) * (of_alpha + of_beta)
    # The rotation of the body about its axis against the spherical top.
    slip = (motion.omega3 - motion.spin) / motion.unit * motion.period
    psi = of_alpha - of_beta + slip
    return Advance(
        jnp.where(motion.nutates, phi, 0.0), jnp.where(motion.nutates, psi, 0.0)
    )


@one_program
def advance_per_nutation(top: SymmetricTop, state: State) -> Advance:
    """Angles by which the axis precesses and the body spins in one period of nutation.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        Growth of phi and psi [rad]. In a motion through the vertical phi jumps by half
        a turn to either side, and the mean of the two is returned. Zero where the
        period is infinite.

    Gradients: those of the branch, also in steady precession and through the vertical.
    Source: docs/top.md.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> state = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> print(jr.top.advance_per_nutation(top, state).phi.round(5))
    1.62782
    """
    return _of_invariants(_advance, top, state)


@one_program
def mean_precession(top: SymmetricTop, state: State) -> Scalar:
    """Mean rate at which the axis turns about the vertical, over a period of nutation.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        The rate [rad/s]. In steady precession it is the rate of that. Where the period
        is infinite it is the rate at which the axis comes upright, I3 omega3 / (2 I1)
        (for mgl < 0 the opposite, at which it comes upside down).

    Gradients: analytic, also in steady precession. The rate jumps where the axis passes
    the vertical.
    Source: docs/top.md.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> state = jr.top.initial_state(top, 0.5, omega3=100.0)
    >>> print(jr.top.mean_precession(top, state).round(8))
    0.02000702
    """

    def rate(motion: Invariants) -> Array:
        # The axis comes to the vertical, round which it goes at half the spin of the
        # spherical top.
        endless = jnp.where(motion.hangs, -0.5, 0.5) * motion.spin
        mean = motion.unit * _advance(motion).phi / motion.period
        return jnp.where(motion.nutates, mean, endless)

    return _of_invariants(rate, top, state)


@one_program
def motion_class(top: SymmetricTop, state: State) -> CLASSES:
    """Kind of a motion, a member of `CLASSES`.

    The path of the axis on the sphere is a wave if the axis always precesses the same
    way, a loop if it turns back in each nutation, and has cusps between the two. A
    steady motion has a constant tilt. A sleeping top is vertical, upright or hanging. A
    pendulum moves in a plane through the vertical, without spin. A motion through the
    vertical has spin, and is upright or hanging at times.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        The kind; `CLASSES.undefined` where the top or the state is not valid. Numbers
        within some 1e-12 (float32: 5e-4) of their size count as equal.

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
    bounds = _bounds(motion)
    of_beta, of_alpha, spread = bounds
    eps = jnp.finfo(spread.dtype).eps
    tolerance = 4096 * eps
    mu, *_ = motion.constants
    rate = jnp.sqrt(mu + square_of(d_alpha) + square_of(d_beta))
    rate = jnp.where(rate > 0, rate, 1.0)
    pairs = (alpha, d_alpha), (beta, d_beta)
    # A sleeping top has beta = 0 (upright) or alpha = 0 (hanging), at rest.
    away = jnp.minimum(*(rate**2 * square_of(x) + square_of(dx) for x, dx in pairs))
    turns = _turns(motion, bounds, tolerance)
    upright = of_beta[0] <= tolerance * of_beta[1]
    vertical = upright | (of_alpha[1] <= tolerance * of_alpha[0])
    widest = of_beta[1] * of_alpha[0]
    momentum = jnp.maximum(*(jnp.abs(x) for x in motion.momenta))
    kind = CLASSES.wave
    # A later kind overrides an earlier one.
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


def _turns(motion: Invariants, bounds: _Bounds, tolerance: ScalarLike) -> Array:
    """Sign of phi' at the least tilt times that at the largest; 0 within rounding."""
    momentum_alpha, momentum_beta = motion.momenta
    # phi' sin^2 / 4 at both bounds
    of_alpha = momentum_alpha * bounds.of_beta
    of_beta = momentum_beta * bounds.of_alpha
    # |alpha|^2 and |beta|^2 are (1 +- cos theta) / 2, and the momenta are (p_phi +-
    # p_psi) / (4 I1): this is (p_phi - p_psi cos theta) / (4 I1).
    turning = of_alpha + of_beta
    rounding = tolerance * (jnp.abs(of_alpha) + jnp.abs(of_beta))
    return jnp.prod(jnp.where(jnp.abs(turning) <= rounding, 0.0, jnp.sign(turning)))
