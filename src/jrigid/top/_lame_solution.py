r"""The exact flow of Lagrange's top: one analytic formula, no regimes, no Euler angles.

A symmetric top is a spherical one, I1 = I3, seen from a body that turns about its axis
at a constant rate besides. With mu = mgl / I1 the attitude of the spherical top, q =
alpha + beta i with complex alpha = q0 + q3 k and beta = q1 + q2 k, obeys two linear
equations of second order,

    x'' = (mu u - h / 2 - m / 2) x,   x = alpha: m = mu;   x = beta: m = -mu,

u = |alpha|^2 - |beta|^2 the cosine of the tilt, h the energy of the spherical top over
I1. They are Lame's: with P(t) Weierstrass's function of the time elapsed, p = (mu u) /
2 - h / 6 and pm = -m / 2 - h / 6, they are solved by functions of the elapsed time
alone,

    s = 1 / sqrt(P - pm),  s'^2 = 1 + A s^2 + B s^4 - G^2 s^6,  w = integral of s^2,
    x(t) = exp(i G w) [x (s' - i G s^3) + x' s] / (1 - m |x|^2 s^2)    (right side at
    the start),

A, B and G polynomials of the state (in `Invariants`), without roots, moduli or phases,
so that vertical, sleeping, steady, weightless tops and pendulums are no special cases.
A polynomial gives s for a short time, and quadratures w; doubling formulas do the rest,
after whole nutations have been taken off.
docs/top.md derives it.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex

from jrigid._checks import harmless
from jrigid._numerics import (
    Components,
    arctanc_sqrt,
    gauss_legendre,
    materialize,
    power_of_two,
    root_of_positive,
    with_columns,
)
from jrigid._types import Quaternion, Scalar, Vector
from jrigid.dynamics import State
from jrigid.rotation import normalize
from jrigid.top._symmetric_top import SymmetricTop

_DOUBLINGS = 11
# Quadratures over a short time: 5 nodes are enough where poles are not nearer than mu
# s^2 says.
_NODES = 5
_POLE_IS_NEAR = 0.02
_NEWTON_STEPS = 4  # from an error of a twentieth
_MEANS = 9  # arithmetic-geometric means: quadratic convergence, from a ratio of 1e-26
# Nearer to the separatrix than this the nutation is out of reach, and beyond this phase
# a top is taken to stay upright: it would leave only then, from a tilt below
# exp(-phase).
_ON_SEPARATRIX = {8: 1e-100, 4: 1e-15}
# Nor are nutations counted of which one lasts longer than some 1e20 (1e6) radians.
_SLOWEST = {8: 1e-80, 4: 1e-24}
# Rates are in units that are not smaller, whose squares do not underflow [rad/s].
_LEAST_UNIT = {8: 1e-140, 4: 1e-17}
_LONGEST_PHASE = {8: 60.0, 4: 10.0}


def _slope(a: Array, b: Array, g: Array, z: Array) -> Array:
    """The derivative s' from z = s^2, up to the half period."""
    return jnp.sqrt(1 + z * (a + z * b) - (g * z) ** 2 * z)


def _short_time(mu: Array, a: Array, b: Array, g: Array, h: Array) -> Components:
    """Functions s (of beta), w of alpha and w of beta of a short time: a series, and quadratures.

    The integrand of alpha's w is z / (1 + mu z), where beta's s is short but mu s^2
    need not be: near the threshold of sleeping a nutation lasts much longer than 1 /
    sqrt(mu). Then the pole is taken out and integrated by itself.
    """
    x = h * h
    p, q, r = a * x, b * x * x, -((g * x) ** 2) * x
    c1, c2 = p / 6, (p * p + 12 * q) / 120
    c3 = (p**3 + 132 * p * q + 360 * r) / 5040
    c4 = (p**4 + 1224 * p * p * q + 12960 * p * r + 3024 * q * q) / 362880
    s = h * (1 + (c1 + (c2 + (c3 + c4))))
    far = mu * s * s > _POLE_IS_NEAR
    pole = -1 / jnp.where(far, mu, 1.0)
    residue = jnp.where(far, 1 / _slope(a, b, g, jnp.where(far, pole, 0.0)), 0.0)
    nodes, weights = gauss_legendre(_NODES, s.dtype)
    z = (s * nodes) ** 2
    weights, inverse = s * z * weights, 1 / _slope(a, b, g, z)
    w_alpha = jnp.sum(weights / (1 + mu * z) * (inverse - residue))
    w_alpha = w_alpha - s * pole * residue * (1 - arctanc_sqrt(mu * s * s))
    return s, w_alpha, jnp.sum(weights * inverse)


@with_columns
def _elapsed(
    mu: Array, a: Array, b: Array, g_alpha: Array, g_beta: Array, h: Array
) -> Components:
    """Functions s (of beta), w of alpha and w of beta, at most a quarter of a nutation."""

    def twice(_: Any, at_half: Components) -> Components:
        s, w_alpha, w_beta = at_half
        z = s * s
        rise, cube = z * (b * z), (g_beta * z) ** 2 * z
        double = 2 * s * _slope(a, b, g_beta, z)
        # The differences of w, of alpha and of beta, are arctan(g f) / g.
        f_alpha = z * double / (1 + mu * z * (3 + 2 * a * z + rise) - rise + 2 * cube)
        f_beta = z * double / (1 - rise + 2 * cube)
        w_alpha = 2 * w_alpha + f_alpha * arctanc_sqrt((g_alpha * f_alpha) ** 2)
        w_beta = 2 * w_beta + f_beta * arctanc_sqrt((g_beta * f_beta) ** 2)
        return (
            double / jnp.sqrt((1 - rise) ** 2 + 4 * cube * (2 + a * z)),
            w_alpha,
            w_beta,
        )

    start = _short_time(mu, a, b, g_beta, h * 2.0**-_DOUBLINGS)
    return jax.lax.fori_loop(0, _DOUBLINGS, twice, start)


def _largest_root(a: Array, b: Array, square: Array) -> Array:
    """A start for Newton's method at the largest root of X^3 + A X^2 + B X - G^2."""
    m = jnp.sqrt(jnp.maximum(a * a - 3 * b, 0.0))
    cosine = (9 * a * b + 27 * square - 2 * a**3) / jnp.where(m > 0, 2 * m**3, 1.0)
    far = (2 * m * jnp.cos(jnp.arccos(jnp.clip(cosine, -1, 1)) / 3) - a) / 3
    # The two largest roots are near each other and zero: a quadratic.
    leading = jnp.where(a > 0, a, 1.0)
    total = jnp.abs(b) + jnp.sqrt(b * b + 4 * leading * square)
    near = jnp.where(
        b > 0, 2 * square / jnp.where(total > 0, total, 1.0), 0.5 * total / leading
    )
    return jnp.where((a > 0) & (near < 0.05 * leading), near, jnp.maximum(far, 0.0))


@with_columns
def _nutation(root: Array, a: Array, b: Array, g: Array) -> Components:
    """From the largest root X: X, the root of the cubic's slope there, and the period 2 omega1."""
    # Newton's steps, not the root given, carry the derivatives: two of them to the
    # third order.
    x = jax.lax.stop_gradient(root)
    for _ in range(_NEWTON_STEPS):
        x = x - (x * (b + x * (a + x)) - g * g) / (b + x * (2 * a + 3 * x))
    q = jnp.sqrt(b + x * (2 * a + 3 * x))

    def mean(_: Any, pair: Components) -> Components:
        arithmetic, geometric = pair
        return 0.5 * (arithmetic + geometric), jnp.sqrt(arithmetic * geometric)

    pair = 0.5 * jnp.sqrt(a + 3 * x + 2 * q), jnp.sqrt(q)
    return x, q, jnp.pi / jax.lax.fori_loop(0, _MEANS, mean, pair)[0]


class Invariants(NamedTuple):
    """What a top's motion keeps, in units in which its rates are of order one; and its start."""

    unit: Scalar  # of a rate [rad/s]
    omega3: Scalar  # [rad/s]
    spin: Scalar  # about the axis, of the spherical top [rad/s]
    hangs: Bool[Array, ""]  # mgl < 0: seen upside down
    start: tuple[Complex[Array, ""], ...]  # alpha, its rate, beta, its rate
    momenta: Components  # Im x* x' of alpha and of beta, in units of 4 I1
    kept: Components  # mu, A, B, G of alpha, G of beta
    nutates: Bool[Array, ""]  # False where no nutation ends in any time
    root: Scalar  # largest root X of X^3 + A X^2 + B X - G^2, G that of beta
    period: Scalar
    # Of the arguments of alpha and beta in a nutation, without the half turn that
    # either makes when it passes zero, or would; beta's is 0 where its argument is
    # small.
    advance_alpha: Scalar
    advance_beta: Scalar
    half_turn: Scalar


def square_of(x: Array) -> Array:
    """|x|^2 of a complex number."""
    return x.real * x.real + x.imag * x.imag


def _whole_nutation(
    root: Array, mu: Array, a: Array, b: Array, g_alpha: Array, g_beta: Array
) -> Components:
    """The largest root, the period, the advances of alpha and beta, and the half turn of beta."""
    x, q, period = _nutation(root, a, b, g_beta)
    _, w_alpha, w_beta = _elapsed(mu, a, b, g_alpha, g_beta, 0.25 * period)
    r = jnp.sqrt(2 * q + a + 3 * x)
    advance_alpha = 4 * g_alpha * w_alpha + 2 * jnp.arctan(g_alpha / (r * (x + mu)))
    # The same for beta, which is 0 / 0 where the largest root is zero: then its
    # complement.
    wide = r * x > jnp.abs(g_beta)
    last = jnp.where(wide, g_beta, -g_beta * r) / jnp.where(
        wide, r * x, b + x * (a + x)
    )
    advance_beta = 4 * g_beta * w_beta + 2 * jnp.arctan(last)
    half_turn = jnp.where(wide, jnp.pi, jnp.zeros_like(x))
    return materialize(x, period, advance_alpha, advance_beta, half_turn)


@jax.jit  # outside of jit a loop defined in a function is compiled at every call
def invariants(top: SymmetricTop, state: State) -> Invariants:
    """The invariants and the nutation of a motion; the attitude is normalised first."""
    q0, q1, q2, q3 = normalize(state.attitude)
    w1, w2, omega3 = state.omega
    spin, mu = top.I3 / top.I1 * omega3, top.mgl / top.I1
    size = jnp.dtype(mu.dtype).itemsize
    rates = jax.lax.stop_gradient(jnp.stack([w1, w2, spin, jnp.sqrt(jnp.abs(mu))]))
    fastest = jnp.max(jnp.abs(rates))
    unit = power_of_two(
        jnp.where(fastest > 0, jnp.maximum(fastest, _LEAST_UNIT[size]), 1.0)
    )
    hangs = mu < 0
    mu = jnp.where(hangs, -mu, mu) / unit / unit
    alpha, beta = jax.lax.complex(q0, q3), jax.lax.complex(q1, q2)
    alpha, beta = (
        jnp.where(hangs, -jnp.conj(beta), alpha),
        jnp.where(hangs, jnp.conj(alpha), beta),
    )
    across = jax.lax.complex(0.5 * (w1 / unit), 0.5 * (w2 / unit))
    along = jax.lax.complex(jnp.zeros_like(spin), 0.5 * (spin / unit))
    d_alpha = along * alpha - beta * jnp.conj(across)
    d_beta = alpha * across - along * beta
    sigma = square_of(beta)
    h = 2 * (square_of(d_alpha) + square_of(d_beta)) + mu * (1 - 2 * sigma)
    a = 0.5 * (3 * mu - h)
    b = -mu * (
        square_of(d_beta) + sigma * (mu * sigma - a)
    )  # of second order in a small tilt
    plus, less = (jnp.conj(alpha) * d_alpha).imag, (jnp.conj(beta) * d_beta).imag
    kept = mu, a, b, _, g = materialize(mu, a, b, mu * plus, -mu * less)

    # Over the fourth power of the fastest rate the square of q is zero on the
    # separatrix.
    root = jax.lax.stop_gradient(_largest_root(a, b, g * g))
    stretch = b + root * (2 * a + 3 * root)
    nutates = stretch > _ON_SEPARATRIX[size] * (a + 3 * root) ** 2 + _SLOWEST[size]
    nutation = _whole_nutation(*harmless(nutates, (root, *kept)))
    start = alpha, d_alpha, beta, d_beta
    return Invariants(
        unit, omega3, spin, hangs, start, (plus, less), kept, nutates, *nutation
    )


def _turn(angle: Array) -> Array:
    return jax.lax.complex(jnp.cos(angle), jnp.sin(angle))


def _times(x: Array, y: Array) -> Array:
    """A real number times a complex one: dtypes are not mixed."""
    return jax.lax.complex(x * y.real, x * y.imag)


def _carried(x: Components, kept: Components, s: Array, slope: Array) -> Components:
    """Alpha, beta and their rates after the time elapsed, from these, without their turns.

    Those of alpha by functions of beta's, which tell how near to upright it comes.
    """
    alpha, d_alpha, beta, d_beta = x
    mu, a, b, g_alpha, g_beta = kept
    z, sigma, rho = s * s, square_of(beta), square_of(alpha)
    n, rise = 1 + mu * sigma * z, 1 + mu * z
    bend = (2 / n) * (a - mu * sigma + z * (b - g_beta * g_beta * z)) - a
    lift, twist = g_beta * s * z, (2 / n) * (g_beta * s * slope)
    moved = beta * jax.lax.complex(slope, -lift) + _times(s, d_beta)
    rate = d_beta * jax.lax.complex(slope * (2 / n - 1), lift)
    rate = rate + beta * jax.lax.complex(s * bend, -s * twist)

    turning = (jnp.conj(alpha) * d_alpha).imag  # g_alpha / mu
    along = jnp.conj(beta) * d_beta  # its imaginary part -g_beta / mu
    # The drift alpha' - i turning alpha, of second order in a small tilt.
    upper = rho > 0.5
    small = _times(
        1 / jnp.where(upper, rho, 1.0), jax.lax.complex(-along.real, turning * sigma)
    )
    still = jax.lax.complex(jnp.zeros_like(turning), turning)
    drift = jnp.where(upper, alpha * small, d_alpha - alpha * still)
    bend = bend - mu - z * (b + mu * along.imag * along.imag)
    risen = alpha * jax.lax.complex(slope, turning * s) + _times(s * rise, drift)
    gain = alpha * jax.lax.complex(s * bend, turning * slope * (2 / n - 1))
    gain = gain + drift * jax.lax.complex(slope * (2 * rise / n - 1), g_alpha * s * z)
    factor = 1 / (n * jnp.sqrt(rise))
    return (
        _times(factor, risen),
        _times(factor, gain),
        _times(1 / n, moved),
        _times(1 / n, rate),
    )


def state_after(motion: Invariants, t: Scalar) -> tuple[Quaternion, Vector]:
    """Attitude and angular velocity after a time t [s]."""
    mu, a, b, g_alpha, g_beta = motion.kept
    phase = t * motion.unit
    whole = jnp.where(motion.nutates, jnp.round(phase / motion.period), 0.0)
    h = 0.5 * (phase - whole * motion.period)
    growth = root_of_positive(jax.lax.stop_gradient(jnp.where(motion.nutates, 0.0, a)))
    longest = _LONGEST_PHASE[jnp.dtype(t.dtype).itemsize] / growth
    stop = jnp.clip(h, -longest, longest)
    s, w_alpha, w_beta = _elapsed(*motion.kept, stop)
    z = s * s
    w_alpha = w_alpha + z / (1 + mu * z) * (h - stop)
    s, slope, w_alpha, w_beta = materialize(s, _slope(a, b, g_beta, z), w_alpha, w_beta)
    carry = partial(_carried, kept=motion.kept, s=s, slope=slope)
    alpha, d_alpha, beta, d_beta = jax.lax.fori_loop(
        0, 2, lambda _, x: carry(x), motion.start
    )
    across = jnp.conj(alpha) * d_beta - beta * jnp.conj(d_alpha)
    # The turns, and that of the body against the spherical top.
    slip = 0.5 * (motion.omega3 - motion.spin) * t
    angle_alpha = 2 * g_alpha * w_alpha + whole * (motion.advance_alpha + jnp.pi) + slip
    angle_beta = (
        2 * g_beta * w_beta + whole * (motion.advance_beta + motion.half_turn) - slip
    )
    turn_alpha, turn_beta = materialize(_turn(angle_alpha), _turn(angle_beta))
    across = _times(2 * motion.unit, across * turn_beta * jnp.conj(turn_alpha))
    alpha, beta = alpha * turn_alpha, beta * turn_beta
    upside_down = jnp.conj(beta), -jnp.conj(alpha)
    alpha, beta = (
        jnp.where(motion.hangs, *x)
        for x in zip(upside_down, (alpha, beta), strict=True)
    )
    q = jnp.stack([alpha.real, beta.real, beta.imag, alpha.imag])
    return q / jnp.sqrt(jnp.sum(q * q)), jnp.stack(
        [across.real, across.imag, motion.omega3]
    )
