r"""The exact flow of Lagrange's top: one analytic formula, no regimes, no Euler angles.

A symmetric top is a spherical one, I1 = I3, seen from a body that turns about its axis at a
constant rate besides. With mu = mgl / I1 the attitude of the spherical top, q = alpha + beta i
with complex alpha = q0 + q3 k and beta = q1 + q2 k, obeys two linear equations of second order,

    x'' = (mu u - h / 2 - m / 2) x,   x = alpha: m = mu;   x = beta: m = -mu,

u = |alpha|^2 - |beta|^2 the cosine of the tilt, h the energy of the spherical top over I1. They
are Lame's: with P(t) Weierstrass's function of the time elapsed, p = (mu u) / 2 - h / 6 and
pm = -m / 2 - h / 6, they are solved by functions of the elapsed time alone,

    s = 1 / sqrt(P - pm),  s'^2 = 1 + A s^2 + B s^4 - G^2 s^6,  w = integral of s^2,
    x(t) = exp(i G w) [x (s' - i G s^3) + x' s] / (1 - m |x|^2 s^2)    (right side at the start),

A, B and G polynomials of the state (in `Invariants`), without roots, moduli or phases, so that
vertical, sleeping, steady, weightless tops and pendulums are no special cases. A polynomial gives s
and w for a short time; doubling formulas do the rest, after whole nutations have been taken off.
docs/top.md derives it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex

from jrigid._numerics import (
    Components,
    arctanc_sqrt,
    materialize,
    power_of_two,
    with_columns,
)
from jrigid._types import Quaternion, Scalar, Vector
from jrigid.dynamics import State
from jrigid.rotation import normalize
from jrigid.top._top import SymmetricTop

_DOUBLINGS = 11
_MEANS = 9  # arithmetic-geometric means: quadratic convergence, from a ratio of 1e-26
# Nearer to the separatrix than this the nutation is out of reach, and beyond this phase a top is
# taken to stay upright: it would leave only then, from a tilt below exp(-phase).
_ON_SEPARATRIX = {8: 1e-100, 4: 1e-15}
# Nor are nutations counted of which one lasts longer than some 1e20 (1e6) radians.
_SLOWEST = {8: 1e-80, 4: 1e-24}
# Rates are in units that are not smaller, whose squares do not underflow [rad/s].
_LEAST_UNIT = {8: 1e-140, 4: 1e-17}
_LONGEST_PHASE = {8: 60.0, 4: 10.0}


def _short_time(a: Array, b: Array, g: Array, h: Array) -> tuple[Array, Array]:
    """Functions s and w of a short time."""
    x = h * h
    a, b, c = a * x, b * x * x, -((g * x) ** 2) * x
    c1 = a / 6
    c2 = (a * a + 12 * b) / 120
    c3 = (a**3 + 132 * a * b + 360 * c) / 5040
    c4 = (a**4 + 1224 * a * a * b + 12960 * a * c + 3024 * b * b) / 362880
    d1, d2, d3 = 2 * c1, c1 * c1 + 2 * c2, 2 * (c3 + c1 * c2)
    s = h * (1 + (c1 + (c2 + (c3 + c4))))
    return s, h**3 * (1 / 3 + (d1 / 5 + (d2 / 7 + d3 / 9)))


def _short_time_of_alpha(mu: Array, a: Array, b: Array, g: Array, s: Array) -> Array:
    """The integral w of alpha, of z / (1 + mu z), where beta's s is short but mu s^2 need not be.

    Near the threshold of sleeping a nutation lasts much longer than 1 / sqrt(mu). The inverse of
    s' is a series in s^2; what is left are the moments of 1 / (1 + mu s^2).
    """
    x = s * s
    a, b, c = a * x, b * x * x, (g * x) ** 2 * x
    weights = (
        jnp.ones_like(x),
        -a / 2,
        3 * a * a / 8 - b / 2,
        -5 * a**3 / 16 + 3 * a * b / 4 + c / 2,
        35 * a**4 / 128 - 15 * a * a * b / 16 + 3 * b * b / 8 - 3 * a * c / 4,
    )
    q = mu * x
    small = q < 0.25
    # Integrals of y^(2 k) / (1 + q y^2) from 0 to 1: backward from a series, or forward.
    near = jnp.where(small, q, 0.0)
    total = jnp.full_like(x, 1 / 49)
    for k in range(18, -1, -1):
        total = 1 / (2 * k + 11) - near * total
    moments = [total]
    for k in range(4, 0, -1):
        moments.insert(0, 1 / (2 * k + 1) - near * moments[0])
    far = jnp.where(small, 1.0, q)
    moment = arctanc_sqrt(far)
    sum_ = jnp.zeros_like(x)
    for k, (weight, close) in enumerate(zip(weights, moments, strict=True)):
        moment = (1 / (2 * k + 1) - moment) / far
        sum_ = sum_ + weight * jnp.where(small, close, moment)
    return s * x * sum_


def _slope(a: Array, b: Array, g: Array, z: Array) -> Array:
    """The derivative s' from z = s^2, up to the half period."""
    return jnp.sqrt(1 + z * (a + z * b) - (g * z) ** 2 * z)


@with_columns
def _elapsed(mu: Array, a: Array, b: Array, g_alpha: Array, g_beta: Array, h: Array) -> Components:
    """Functions s (of beta), w of alpha and w of beta, at most a quarter of a nutation."""
    h = h * 2.0**-_DOUBLINGS
    s, w_beta = _short_time(a, b, g_beta, h)
    w_alpha = _short_time_of_alpha(mu, a, b, g_beta, s)

    def twice(_: Any, at_half: Components) -> Components:
        s, w_alpha, w_beta = at_half
        z = s * s
        slope = _slope(a, b, g_beta, z)
        rise, cube = z * (b * z), (g_beta * z) ** 2 * z
        double = 2 * s * slope
        # The differences of w, of alpha and of beta, are arctan(g f) / g.
        f_alpha = z * double / (1 + mu * z * (3 + 2 * a * z + rise) - rise + 2 * cube)
        f_beta = z * double / (1 - rise + 2 * cube)
        w_alpha = 2 * w_alpha + f_alpha * arctanc_sqrt((g_alpha * f_alpha) ** 2)
        w_beta = 2 * w_beta + f_beta * arctanc_sqrt((g_beta * f_beta) ** 2)
        s = double / jnp.sqrt((1 - rise) ** 2 + 4 * cube * (2 + a * z))
        return s, w_alpha, w_beta

    return jax.lax.fori_loop(0, _DOUBLINGS, twice, (s, w_alpha, w_beta))


def _largest_root(a: Array, b: Array, square: Array) -> Array:
    """A start for Newton's method at the largest root of X^3 + A X^2 + B X - G^2."""
    m = jnp.sqrt(jnp.maximum(a * a - 3 * b, 0.0))
    cosine = (9 * a * b + 27 * square - 2 * a**3) / jnp.where(m > 0, 2 * m**3, 1.0)
    far = (2 * m * jnp.cos(jnp.arccos(jnp.clip(cosine, -1, 1)) / 3) - a) / 3
    # The two largest roots are near each other and zero: a quadratic.
    near = a > 0
    safe = jnp.where(near, a, 1.0)
    x = jnp.zeros_like(a)
    for _ in range(8):
        leading = safe + x
        total = jnp.abs(b) + jnp.sqrt(b * b + 4 * leading * square)
        x = jnp.where(b > 0, 2 * square / jnp.where(total > 0, total, 1.0), 0.5 * total / leading)
    return jnp.where(near & (x < 0.05 * safe), x, jnp.maximum(far, 0.0))


def _newton(x: Array, a: Array, b: Array, square: Array) -> Array:
    return x - (x * (b + x * (a + x)) - square) / (b + x * (2 * a + 3 * x))


@with_columns
def _nutation(root: Array, a: Array, b: Array, g: Array) -> Components:
    """From the largest root X: X, the root of the cubic's slope there, and the period 2 omega1."""
    # Newton's steps, not the root given, carry the derivatives: two of them to the third order.
    x = _newton(_newton(jax.lax.stop_gradient(root), a, b, g * g), a, b, g * g)
    q = jnp.sqrt(b + x * (2 * a + 3 * x))

    def mean(_: Any, pair: Components) -> Components:
        arithmetic, geometric = pair
        return 0.5 * (arithmetic + geometric), jnp.sqrt(arithmetic * geometric)

    pair = 0.5 * jnp.sqrt(a + 3 * x + 2 * q), jnp.sqrt(q)
    arithmetic, _ = jax.lax.fori_loop(0, _MEANS, mean, pair)
    return x, q, jnp.pi / arithmetic


class Invariants(NamedTuple):
    """What a top's motion keeps, in units in which its rates are of order one; and its start."""

    unit: Scalar  # of a rate [rad/s]
    omega3: Scalar  # [rad/s]
    spin: Scalar  # about the axis, of the spherical top [rad/s]
    hangs: Bool[Array, ""]  # mgl < 0: seen with the axis reversed
    start: tuple[Complex[Array, ""], ...]  # alpha, beta and their rates
    mu: Scalar
    a: Scalar
    b: Scalar
    g_alpha: Scalar
    g_beta: Scalar
    nutates: Bool[Array, ""]  # False where no nutation ends in any time
    root: Scalar  # largest root X of X^3 + A X^2 + B X - G^2, G that of beta
    period: Scalar
    # Of the arguments of alpha and beta in a nutation, without the half turn that either makes when
    # it passes zero, or would; `wide` where beta does.
    advance_alpha: Scalar
    advance_beta: Scalar
    wide: Bool[Array, ""]

    @property
    def slip(self) -> Scalar:
        """By how much the body turns faster than the spherical top about their axis."""
        return (self.omega3 - self.spin) / self.unit


def square_of(x: Array) -> Array:
    """|x|^2 of a complex number."""
    return x.real * x.real + x.imag * x.imag


def _reversed(hangs: Array, q: Components, w: Components) -> tuple[Components, Components]:
    """Attitude and rates about body axes turned half about axis 1; q becomes q i, up to order."""
    q0, q1, q2, q3 = q
    w1, w2, w3 = w
    q = tuple(jnp.where(hangs, x, y) for x, y in ((-q1, q0), (q0, q1), (q3, q2), (-q2, q3)))
    return q, (w1, jnp.where(hangs, -w2, w2), jnp.where(hangs, -w3, w3))


@jax.jit  # outside of jit a loop defined in a function is compiled at every call
def invariants(top: SymmetricTop, state: State) -> Invariants:
    """The invariants and the nutation of a motion; the attitude is normalised first."""
    attitude, omega = normalize(state.attitude), state.omega
    w1, w2, w3 = omega
    spin = top.I3 / top.I1 * w3
    mu = top.mgl / top.I1
    sizes = jnp.stack([w1, w2, spin, jnp.sqrt(jnp.abs(jax.lax.stop_gradient(mu)))])
    size = jnp.dtype(mu.dtype).itemsize
    fastest = jnp.max(jnp.abs(jax.lax.stop_gradient(sizes)))
    unit = power_of_two(jnp.where(fastest > 0, jnp.maximum(fastest, _LEAST_UNIT[size]), 1.0))
    hangs = mu < 0
    q, w = _reversed(hangs, tuple(attitude), (w1 / unit, w2 / unit, spin / unit))
    mu = jnp.where(hangs, -mu, mu) / unit / unit
    w1, w2, w3 = w
    alpha, beta = jax.lax.complex(q[0], q[3]), jax.lax.complex(q[1], q[2])
    across = jax.lax.complex(0.5 * w1, 0.5 * w2)
    along = jax.lax.complex(jnp.zeros_like(w3), 0.5 * w3)
    d_alpha = along * alpha - beta * jnp.conj(across)
    d_beta = alpha * across - along * beta
    sigma = square_of(beta)
    h = 2 * (square_of(d_alpha) + square_of(d_beta)) + mu * (1 - 2 * sigma)
    a = 0.5 * (3 * mu - h)
    b = -mu * (square_of(d_beta) + sigma * (mu * sigma - a))  # of second order in a small tilt
    g_alpha = mu * (jnp.conj(alpha) * d_alpha).imag
    g_beta = -mu * (jnp.conj(beta) * d_beta).imag
    mu, a, b, g_alpha, g_beta = materialize(mu, a, b, g_alpha, g_beta)

    # Over the fourth power of the fastest rate the square of q is zero on the separatrix.
    root = jax.lax.stop_gradient(_largest_root(a, b, g_beta * g_beta))
    stretch = b + root * (2 * a + 3 * root)
    nutates = stretch > _ON_SEPARATRIX[size] * (a + 3 * root) ** 2 + _SLOWEST[size]
    example = (1.0, 1.0, 1.0, 1.0, 3**0.5, 3**0.5)
    mu_, x, a_, b_, g_alpha_, g_beta_ = (
        jnp.where(nutates, value, other)
        for value, other in zip((mu, root, a, b, g_alpha, g_beta), example, strict=True)
    )
    x, q, period = _nutation(x, a_, b_, g_beta_)
    _, w_alpha, w_beta = _elapsed(mu_, a_, b_, g_alpha_, g_beta_, 0.25 * period)
    r = jnp.sqrt(2 * q + a_ + 3 * x)
    advance_alpha = 4 * g_alpha_ * w_alpha + 2 * jnp.arctan(g_alpha_ / (r * (x + mu_)))
    # The same for beta, which is 0 / 0 where the largest root is zero: then its complement.
    wide = jax.lax.stop_gradient(r * x > jnp.abs(g_beta_))
    last = jnp.where(wide, g_beta_, -g_beta_ * r) / jnp.where(wide, r * x, b_ + x * (a_ + x))
    advance_beta = 4 * g_beta_ * w_beta + 2 * jnp.arctan(last)
    x, period, advance_alpha, advance_beta = materialize(x, period, advance_alpha, advance_beta)
    return Invariants(
        unit, omega[2], spin, hangs, (alpha, beta, d_alpha, d_beta), mu, a, b, g_alpha, g_beta,
        nutates, x, period, advance_alpha, advance_beta, wide,
    )  # fmt: skip


def _turn(angle: Array) -> Array:
    return jax.lax.complex(jnp.cos(angle), jnp.sin(angle))


def _times(x: Array, y: Array) -> Array:
    """A real number times a complex one: dtypes are not mixed."""
    return jax.lax.complex(x * y.real, x * y.imag)


def _beta_after(
    beta: Array, d_beta: Array, kept: Components, s: Array, slope: Array, turn: Array
) -> tuple[Array, Array]:
    """The component beta of the attitude and its rate after the time elapsed, from these."""
    mu, a, b, _, g = kept
    z, sigma = s * s, square_of(beta)
    n = 1 + mu * sigma * z
    lift = g * s * z
    bend = (2 / n) * (a - mu * sigma + z * (b - g * g * z)) - a
    twist = (2 / n) * (g * s * slope)
    factor = _times(1 / n, turn)
    moved = beta * jax.lax.complex(slope, -lift) + _times(s, d_beta)
    rate = d_beta * jax.lax.complex(slope * (2 / n - 1), lift)
    return factor * moved, factor * (rate + beta * jax.lax.complex(s * bend, -s * twist))


def _alpha_after(
    start: tuple[Array, ...], kept: Components, s: Array, slope: Array, turn: Array
) -> tuple[Array, Array]:
    """The same for alpha, by functions of beta's, which tell how near to upright it comes."""
    alpha, beta, d_alpha, d_beta = start
    mu, a, b, g_alpha, g_beta = kept
    z, sigma, rho = s * s, square_of(beta), square_of(alpha)
    turning = (jnp.conj(alpha) * d_alpha).imag  # g_alpha / mu
    # The drift alpha' - i turning alpha, of second order in a small tilt.
    upper = jax.lax.stop_gradient(rho > 0.5)
    small = jax.lax.complex(-(jnp.conj(beta) * d_beta).real, turning * sigma)
    drift = jnp.where(
        upper,
        alpha * _times(1 / jnp.where(upper, rho, 1.0), small),
        d_alpha - alpha * jax.lax.complex(jnp.zeros_like(turning), turning),
    )
    n = 1 + mu * sigma * z
    rise = 1 + mu * z
    side = (jnp.conj(beta) * d_beta).imag  # -g_beta / mu
    bend = (2 / n) * (a - mu * sigma + z * (b - g_beta * g_beta * z))
    bend = bend - mu - a - z * (b + mu * side * side)
    factor = _times(1 / (n * jnp.sqrt(rise)), turn)
    moved = alpha * jax.lax.complex(slope, turning * s) + _times(s * rise, drift)
    rate = alpha * jax.lax.complex(s * bend, turning * slope * (2 / n - 1))
    rate = rate + drift * jax.lax.complex(slope * (2 * rise / n - 1), g_alpha * s * z)
    return factor * moved, factor * rate


def state_after(motion: Invariants, t: Scalar) -> tuple[Quaternion, Vector]:
    """Attitude and angular velocity after a time t [s]."""
    (
        unit, omega3, _, hangs, (alpha, beta, d_alpha, d_beta), mu, a, b, g_alpha, g_beta,
        nutates, _, period, advance_alpha, advance_beta, wide,
    ) = motion  # fmt: skip
    t = t * unit
    whole = jnp.where(nutates, jnp.round(jax.lax.stop_gradient(t / period)), 0.0)
    h = 0.5 * (t - whole * jnp.where(nutates, period, 0.0))
    longest = _LONGEST_PHASE[jnp.dtype(t.dtype).itemsize]
    reach = jax.lax.stop_gradient(a) * h * h
    beyond = ~nutates & (reach > longest * longest)
    stop = jnp.where(beyond, h * (longest / jnp.sqrt(jnp.where(beyond, reach, 1.0))), h)
    s, w_alpha, w_beta = _elapsed(mu, a, b, g_alpha, g_beta, stop)
    z = s * s
    slope = _slope(a, b, g_beta, z)
    w_alpha = w_alpha + jnp.where(beyond, z / (1 + mu * z) * (h - stop), 0.0)
    s, slope, w_alpha, w_beta = materialize(s, slope, w_alpha, w_beta)
    turn_alpha, turn_beta = materialize(_turn(g_alpha * w_alpha), _turn(g_beta * w_beta))
    kept = mu, a, b, g_alpha, g_beta

    def half(_: Any, x: Components) -> Components:
        alpha, d_alpha, beta, d_beta = x
        return (
            *_alpha_after((alpha, beta, d_alpha, d_beta), kept, s, slope, turn_alpha),
            *_beta_after(beta, d_beta, kept, s, slope, turn_beta),
        )

    alpha, d_alpha, beta, d_beta = jax.lax.fori_loop(0, 2, half, (alpha, d_alpha, beta, d_beta))
    across = jnp.conj(alpha) * d_beta - beta * jnp.conj(d_alpha)
    across = across + across
    advance_alpha = advance_alpha + jnp.pi
    advance_beta = advance_beta + jnp.where(wide, jnp.pi, 0.0)
    turn_alpha, turn_beta = _turn(whole * advance_alpha), _turn(whole * advance_beta)
    alpha, beta, across = (
        alpha * turn_alpha,
        beta * turn_beta,
        across * turn_beta * jnp.conj(turn_alpha),
    )
    # Back to the axis as it was, and to the body.
    (q0, q1), (q2, q3) = (alpha.real, beta.real), (beta.imag, alpha.imag)
    q = [jnp.where(hangs, x, y) for x, y in ((q1, q0), (-q0, q1), (-q3, q2), (q2, q3))]
    across = jnp.where(hangs, jnp.conj(across), across)
    alpha, beta = jax.lax.complex(q[0], q[3]), jax.lax.complex(q[1], q[2])
    turn = _turn(0.5 * motion.slip * t)
    alpha, beta, across = alpha * turn, beta * jnp.conj(turn), across * jnp.conj(turn * turn)
    q = jnp.stack([alpha.real, beta.real, beta.imag, alpha.imag])
    q = q / jnp.sqrt(jnp.sum(q * q))
    return q, jnp.stack([unit * across.real, unit * across.imag, omega3])
