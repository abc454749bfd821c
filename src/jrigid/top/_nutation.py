"""What a symmetric top's motion looks like: bounds and period of nutation, precession, kind."""

from types import MappingProxyType
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jrigid._checks import Findings, nan_where
from jrigid._numerics import safe_arctan2
from jrigid._types import Scalar
from jrigid.dynamics import State
from jrigid.rotation import normalize
from jrigid.top._flow import Motion, invariants, square_of
from jrigid.top._top import SymmetricTop, checked

CLASSES = MappingProxyType(
    {
        0: "wave",
        1: "cusp",
        2: "loop",
        3: "steady",
        4: "sleeping",
        5: "pendulum",
        6: "through the vertical",
    }
)


class NutationBounds(NamedTuple):
    """Least and largest tilt of a motion [rad]."""

    theta_min: Scalar
    theta_max: Scalar


class Advance(NamedTuple):
    """By how much the angles of precession and spin grow in one nutation [rad]."""

    phi: Scalar
    psi: Scalar


def _motion(top: SymmetricTop, state: State, throw: bool) -> tuple[Findings, SymmetricTop, Motion]:
    findings, top, state = checked(top, state, throw)
    attitude = normalize(state.attitude)
    return findings, top, invariants(top.I1, top.I3, top.mgl, attitude, state.omega)


def _squares(motion: Motion) -> tuple[Array, Array, Array]:
    """|beta|^2 = (1 - cos tilt) / 2: now, and at the bounds; where mgl < 0, of the tilt reversed.

    It obeys (d|beta|^2/dt)^2 / 4 = (mu x + X) (-x^2 + c1 x + c0), with the largest root X of the
    exact flow.
    """
    _, beta, _, d_beta = motion.start
    mu, a = motion.mu, motion.a
    now = square_of(beta)
    slope = square_of(d_beta) + now * (a - 2 * mu * now)  # zero in steady motion
    moving = beta.real * d_beta.real + beta.imag * d_beta.imag
    root = jnp.where(motion.nutates, motion.root, 0.0)
    front = mu * now + root
    # Upright at the separatrix: from there to -mu x^2 + a x = 0.
    plain = front > 0
    front = jnp.where(plain, front, 1.0)
    mu_safe = jnp.where(mu > 0, mu, 1.0)
    height = moving * moving / front
    skew = (slope - mu * height) / front
    skew = jnp.where(plain, skew, jnp.where(mu > 0, jnp.maximum(a, 0.0) / mu_safe, 0.0))
    height = jnp.where(plain, height, 0.0)
    square = skew * skew + 4 * height
    # The square root of a double root: zero, without a derivative.
    distinct = square > 0
    root = jnp.where(distinct, jnp.sqrt(jnp.where(distinct, square, 1.0)), 0.0)
    # Without cancellation at the near end.
    far = 0.5 * (jnp.abs(skew) + root)
    near = -height / jnp.where(far > 0, far, 1.0)
    up = jnp.where(skew > 0, far, -near)
    down = jnp.where(skew > 0, near, -far)
    return now, now + down, now + up


def _tilt(square: Array) -> Array:
    square = jnp.clip(square, 0.0, 1.0)
    inside = (square > 0) & (square < 1)
    safe = jnp.where(inside, square, 0.5)
    angle = 2 * safe_arctan2(jnp.sqrt(safe), jnp.sqrt(1 - safe))
    return jnp.where(inside, angle, jnp.where(square > 0, jnp.pi, 0.0))


def nutation_bounds(top: SymmetricTop, state: State, *, throw: bool = True) -> NutationBounds:
    """The tilts between which the axis nods.

    Args:
        top: The top.
        state: Any state of the motion.
        throw: False: bad values give NaN instead of an error.

    Returns:
        Least and largest angle between the axis and the vertical; equal in steady precession.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value (run time, any lane).

    Gradients: right where the two differ and neither is vertical; finite everywhere: without the
    infinite part where they meet, zero at the vertical.
    Source: the roots of `cubic`, from the state rather than from its coefficients.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> bounds = jr.top.nutation_bounds(top, jr.top.initial_state(top, 0.5, omega3=5.0))
    >>> print(bounds.theta_min.round(4), bounds.theta_max.round(4))
    0.5 0.7576
    """
    findings, _, motion = _motion(top, state, throw)
    _, low, high = _squares(motion)
    low, high = _tilt(low), _tilt(high)
    found = NutationBounds(
        jnp.where(motion.hangs, jnp.pi - high, low), jnp.where(motion.hangs, jnp.pi - low, high)
    )
    return nan_where(~findings.ok, found)


def nutation_period(top: SymmetricTop, state: State, *, throw: bool = True) -> Scalar:
    """Time from one least tilt to the next.

    Args:
        top: The top.
        state: Any state of the motion.
        throw: False: bad values give NaN instead of an error.

    Returns:
        The period [s]; in steady precession that of small nutations; of a pendulum half a swing,
        or a whole turn; infinite on the separatrix and for a top without weight at rest.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value (run time, any lane).

    Gradients: analytic, also in steady precession; zero where the period is infinite.
    Source: docs/top.md, an arithmetic-geometric mean.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> state = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> print(jr.top.nutation_period(top, state).round(5))
    3.51772
    """
    findings, _, motion = _motion(top, state, throw)
    period = jnp.where(motion.nutates, motion.period / motion.unit, jnp.inf)
    return nan_where(~findings.ok, period)


def _side(x: Array, dx: Array) -> Array:
    """Sign of the sense in which a complex number turns."""
    return jnp.sign((jnp.conj(x) * dx).imag)


def _advance(motion: Motion) -> tuple[Array, Array]:
    alpha, beta, d_alpha, d_beta = motion.start
    of_alpha = motion.advance_alpha + jnp.pi * _side(alpha, d_alpha)
    of_beta = motion.advance_beta + jnp.where(motion.wide, jnp.pi * _side(beta, d_beta), 0.0)
    spin = jnp.where(motion.hangs, of_beta - of_alpha, of_alpha - of_beta)
    return of_alpha + of_beta, spin + motion.slip * motion.period


def advance_per_nutation(top: SymmetricTop, state: State, *, throw: bool = True) -> Advance:
    """Angles by which the axis precesses and the body spins in one period of nutation.

    Args:
        top: The top.
        state: Any state of the motion.
        throw: False: bad values give NaN instead of an error.

    Returns:
        Growth of phi and psi [rad]. In a motion through the vertical, where phi jumps by half a
        turn to either side, the mean of the two. Zero where the period is infinite.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value (run time, any lane).

    Gradients: those of the branch, also in steady precession and through the vertical.
    Source: docs/top.md.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> state = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> print(jr.top.advance_per_nutation(top, state).phi.round(5))
    1.62782
    """
    findings, _, motion = _motion(top, state, throw)
    found = Advance(*(jnp.where(motion.nutates, x, 0.0) for x in _advance(motion)))
    return nan_where(~findings.ok, found)


def mean_precession(top: SymmetricTop, state: State, *, throw: bool = True) -> Scalar:
    """Mean rate at which the axis turns about the vertical, over a period of nutation.

    Args:
        top: The top.
        state: Any state of the motion.
        throw: False: bad values give NaN instead of an error.

    Returns:
        The rate [rad/s]; in steady precession the rate of that; where the period is infinite that
        with which the axis comes upright, I3 omega3 / (2 I1).

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value (run time, any lane).

    Gradients: analytic, also in steady precession; it jumps where the axis passes the vertical.
    Source: docs/top.md.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> print(jr.top.mean_precession(top, jr.top.initial_state(top, 0.5, omega3=100.0)).round(8))
    0.02000702
    """
    findings, top, motion = _motion(top, state, throw)
    phi, _ = _advance(motion)
    endless = 0.5 * top.I3 * motion.omega3 / top.I1
    rate = jnp.where(motion.nutates, motion.unit * phi / motion.period, endless)
    return nan_where(~findings.ok, rate)


def motion_class(top: SymmetricTop, state: State, *, throw: bool = True) -> Int[Array, ""]:
    """What kind of motion it is, by a code that `CLASSES` names.

    The path of the axis on the sphere is a wave where it precesses one way throughout, a loop
    where it turns back in each nutation, and has cusps between the two. Steady: at a constant
    tilt. Sleeping: at the vertical, upright or hanging. Pendulum: in a plane through the vertical,
    without spin. Through the vertical: spinning, and upright or hanging at times.

    Args:
        top: The top.
        state: Any state of the motion.
        throw: False: bad values give the code -1 instead of an error.

    Returns:
        The code. Two sides are told apart to some 1e-12 (float32: 5e-4) of their size.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value (run time, any lane).

    Gradients: none, it is an integer.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 35, problem 1.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> released = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> jr.top.CLASSES[int(jr.top.motion_class(top, released))]
    'cusp'
    """
    findings, _, motion = _motion(top, state, throw)
    motion = jax.lax.stop_gradient(motion)
    alpha, beta, d_alpha, d_beta = motion.start
    now, low, high = _squares(motion)
    tolerance = 4096 * jnp.finfo(now.dtype).eps
    # Momenta about the vertical and the axis, less and plus, over 4 I1
    plus, less = (jnp.conj(alpha) * d_alpha).imag, (jnp.conj(beta) * d_beta).imag
    size = jnp.maximum(jnp.abs(plus), jnp.abs(less))
    rate = jnp.sqrt(motion.mu + square_of(d_alpha) + square_of(d_beta))
    rate = jnp.where(rate > 0, rate, 1.0)
    spinless = size <= tolerance * rate
    # phi' sin^2 / 4 = plus |beta|^2 + less |alpha|^2, at either bound
    ends = jnp.stack([plus * x + less * (1 - x) for x in (low, high)])
    scales = jnp.stack([jnp.abs(plus) * x + jnp.abs(less) * (1 - x) for x in (low, high)])
    turns = jnp.where(jnp.abs(ends) <= tolerance * scales + 1e-3 * tolerance * size, 0.0, ends)
    wide = (high - low) > jnp.sqrt(tolerance) * jnp.sqrt(high * (1 - low)) + tolerance
    vertical = ((jnp.abs(less) <= tolerance * size) & (low <= tolerance)) | (
        (jnp.abs(plus) <= tolerance * size) & (high >= 1 - tolerance)
    )
    stands = square_of(beta) + square_of(d_beta) / rate**2 <= tolerance**2
    stands = stands | (square_of(alpha) + square_of(d_alpha) / rate**2 <= tolerance**2)
    code = jnp.where(turns[0] * turns[1] < 0, 2, jnp.where(turns[0] * turns[1] == 0, 1, 0))
    code = jnp.where(vertical, 6, code)
    code = jnp.where(spinless & wide, 5, code)
    code = jnp.where(~wide, 3, code)
    code = jnp.where(stands, 4, code)
    return jnp.where(findings.ok, code, -1)
