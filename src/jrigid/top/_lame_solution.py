r"""The exact flow of Lagrange's top: one analytic formula without Euler angles.

A symmetric top is a spherical top, with I1 = I3, seen from a body that also turns about
its axis at a constant rate. With mu = mgl / I1, write the attitude of the spherical top
as q = alpha + beta i with complex alpha = q0 + q3 k and beta = q1 + q2 k. Both obey a
linear equation of second order,

    x'' = (mu u - h / 2 - m / 2) x,   x = alpha: m = mu;   x = beta: m = -mu.

Here u = |alpha|^2 - |beta|^2 is the cosine of the tilt and h the energy of the
spherical top over I1. The equations are Lame's. Let P(t) be Weierstrass's function of
the time elapsed, p = (mu u) / 2 - h / 6 and pm = -m / 2 - h / 6. The solution needs
functions of the elapsed time alone,

    s = 1 / sqrt(P - pm),  s'^2 = 1 + A s^2 + B s^4 - G^2 s^6,  w = integral of s^2,
    x(t) = exp(i G w) [x (s' - i G s^3) + x' s] / (1 - m |x|^2 s^2),

with the right side taken at the start. A, B and G (in `Invariants`) are polynomials of
the state, without roots, moduli or phases. So vertical, sleeping, steady and weightless
tops and pendulums are no special cases. A polynomial gives s for a short time, and
quadratures give w. Doubling formulas do the rest, after whole nutations have been taken
off. docs/top.md derives all of it.
"""

from functools import partial
from typing import NamedTuple

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

# The longest phase over 2^11 is 0.03, where the series of s is good to rounding.
_DOUBLINGS = 11
# Quadratures over a short time: 5 nodes are enough if mu s^2 shows no pole nearby.
_NODES = 5
_POLE_IS_NEAR = 0.02
_NEWTON_STEPS = 4  # from an error of a twentieth
_MEANS = 9  # arithmetic-geometric means: quadratic convergence, from a ratio of 1e-26
# Closer to the separatrix than this, no nutation ends in any time. Beyond the longest
# phase a top is taken to stay upright: it would leave only then, from a tilt below
# exp(-phase).
_ON_SEPARATRIX = {8: 1e-100, 4: 1e-15}
# At the limit a quarter of a nutation has a phase of log(4 / 2e-25) = 58 (float32:
# 9.3), which is below it.
_LONGEST_PHASE = {8: 60.0, 4: 10.0}
# Nutations that last longer than some 1e20 (1e6) radians are not counted.
_SLOWEST = {8: 1e-80, 4: 1e-24}
# Least unit of rates, so that their squares do not underflow [rad/s].
_LEAST_UNIT = {8: 1e-140, 4: 1e-17}


def _slope(a: Array, b: Array, g: Array, z: Array) -> Array:
    """The derivative s' from z = s^2, up to the half period."""
    return jnp.sqrt(1 + z * (a + z * b) - (g * z) ** 2 * z)


def _short_time(mu: Array, a: Array, b: Array, g: Array, h: Array) -> Components:
    """Functions s (of beta), w of alpha and w of beta after a short time.

    A series gives s, and quadratures both w. The integrand of alpha's w is
    z / (1 + mu z). Beta's s is short, but mu s^2 need not be: near the threshold of
    sleeping a nutation lasts much longer than 1 / sqrt(mu). Then the pole is taken out
    and integrated by itself.
    """
    x = h * h
    p = a * x
    q = b * x * x
    r = -((g * x) ** 2) * x
    # The Taylor series of s'^2 = 1 + A s^2 + B s^4 - G^2 s^6.
    c1 = p / 6
    c2 = (p * p + 12 * q) / 120
    c3 = (p**3 + 132 * p * q + 360 * r) / 5040
    c4 = (p**4 + 1224 * p * p * q + 12960 * p * r + 3024 * q * q) / 362880
    s = h * (1 + (c1 + (c2 + (c3 + c4))))
    far = mu * s * s > _POLE_IS_NEAR
    pole = -1 / jnp.where(far, mu, 1.0)
    residue = jnp.where(far, 1 / _slope(a, b, g, jnp.where(far, pole, 0.0)), 0.0)
    nodes, weights = gauss_legendre(_NODES, s.dtype)
    z = (s * nodes) ** 2
    weights = s * z * weights
    inverse = 1 / _slope(a, b, g, z)
    w_alpha = jnp.sum(weights / (1 + mu * z) * (inverse - residue))
    w_alpha = w_alpha - s * pole * residue * (1 - arctanc_sqrt(mu * s * s))
    return s, w_alpha, jnp.sum(weights * inverse)


@with_columns
def _elapsed(
    mu: Array, a: Array, b: Array, g_alpha: Array, g_beta: Array, h: Array
) -> Components:
    """Functions s (of beta) and w of alpha and beta, up to a quarter of a nutation."""

    def twice(_: Array, at_half: Components) -> Components:
        s, w_alpha, w_beta = at_half
        z = s * s
        rise = z * (b * z)
        cube = (g_beta * z) ** 2 * z
        double = 2 * s * _slope(a, b, g_beta, z)
        # The differences of w, of alpha and of beta, are arctan(g f) / g.
        f_alpha = z * double / (1 + mu * z * (3 + 2 * a * z + rise) - rise + 2 * cube)
        f_beta = z * double / (1 - rise + 2 * cube)
        w_alpha = 2 * w_alpha + f_alpha * arctanc_sqrt((g_alpha * f_alpha) ** 2)
        w_beta = 2 * w_beta + f_beta * arctanc_sqrt((g_beta * f_beta) ** 2)
        s = double / jnp.sqrt((1 - rise) ** 2 + 4 * cube * (2 + a * z))
        return s, w_alpha, w_beta

    start = _short_time(mu, a, b, g_beta, h * 2.0**-_DOUBLINGS)
    return jax.lax.fori_loop(0, _DOUBLINGS, twice, start)


def _largest_root(a: Array, b: Array, square: Array) -> Array:
    """Initial value for Newton's method: largest root of X^3 + A X^2 + B X - G^2."""
    m = jnp.sqrt(jnp.maximum(a * a - 3 * b, 0.0))
    # Viete's formula for three real roots.
    cosine = (9 * a * b + 27 * square - 2 * a**3) / jnp.where(m > 0, 2 * m**3, 1.0)
    far = (2 * m * jnp.cos(jnp.arccos(jnp.clip(cosine, -1, 1)) / 3) - a) / 3
    # Where the two largest roots are close to each other and to zero, a quadratic.
    leading = jnp.where(a > 0, a, 1.0)
    total = jnp.abs(b) + jnp.sqrt(b * b + 4 * leading * square)
    near = jnp.where(
        b > 0, 2 * square / jnp.where(total > 0, total, 1.0), 0.5 * total / leading
    )
    return jnp.where((a > 0) & (near < 0.05 * leading), near, jnp.maximum(far, 0.0))


@with_columns
def _nutation(root: Array, a: Array, b: Array, g: Array) -> Components:
    """Largest root X, the root of the cubic's slope there, and the period 2 omega1.

    It starts from an approximation of X.
    """
    # Newton's steps, not the approximation, carry the derivatives. Two steps carry
    # those up to third order.
    x = jax.lax.stop_gradient(root)
    for _ in range(_NEWTON_STEPS):
        x = x - (x * (b + x * (a + x)) - g * g) / (b + x * (2 * a + 3 * x))
    q = jnp.sqrt(b + x * (2 * a + 3 * x))

    def mean(_: Array, pair: Components) -> Components:
        arithmetic, geometric = pair
        return 0.5 * (arithmetic + geometric), jnp.sqrt(arithmetic * geometric)

    pair = 0.5 * jnp.sqrt(a + 3 * x + 2 * q), jnp.sqrt(q)
    return x, q, jnp.pi / jax.lax.fori_loop(0, _MEANS, mean, pair)[0]


class Invariants(NamedTuple):
    """Constants of a top's motion, in units with rates of order one; its start."""

    unit: Scalar  # of a rate [rad/s]
    omega3: Scalar  # [rad/s]
    spin: Scalar  # about the axis, of the spherical top [rad/s]
    hangs: Bool[Array, ""]  # mgl < 0: the top is described upside down
    start: tuple[Complex[Array, ""], ...]  # alpha, its rate, beta, its rate
    momenta: Components  # Im x* x' of alpha and of beta, in units of 4 I1
    constants: Components  # mu, A, B, G of alpha, G of beta
    nutates: Bool[Array, ""]  # False where no nutation ends in any time
    root: Scalar  # largest root X of X^3 + A X^2 + B X - G^2, with G of beta
    period: Scalar
    # Growth of the arguments of alpha and beta in a nutation, without the half turn
    # that either makes when it passes zero, or would make. Beta's is 0 where its
    # argument is small.
    advance_alpha: Scalar
    advance_beta: Scalar
    half_turn: Scalar


def square_of(x: Array) -> Array:
    """|x|^2 of a complex number."""
    return x.real * x.real + x.imag * x.imag


def _whole_nutation(
    root: Array, mu: Array, a: Array, b: Array, g_alpha: Array, g_beta: Array
) -> Components:
    """Largest root, period, advances of alpha and beta, and the half turn of beta."""
    x, q, period = _nutation(root, a, b, g_beta)
    _, w_alpha, w_beta = _elapsed(mu, a, b, g_alpha, g_beta, 0.25 * period)
    r = jnp.sqrt(2 * q + a + 3 * x)
    advance_alpha = 4 * g_alpha * w_alpha + 2 * jnp.arctan(g_alpha / (r * (x + mu)))
    # The same for beta. Its quotient is 0 / 0 where the largest root is zero, so there
    # the complement of the angle is used.
    wide = r * x > jnp.abs(g_beta)
    numerator = jnp.where(wide, g_beta, -g_beta * r)
    denominator = jnp.where(wide, r * x, b + x * (a + x))
    advance_beta = 4 * g_beta * w_beta + 2 * jnp.arctan(numerator / denominator)
    half_turn = jnp.where(wide, jnp.pi, jnp.zeros_like(x))
    return materialize(x, period, advance_alpha, advance_beta, half_turn)


@jax.jit  # outside of jit a loop defined in a function is compiled at every call
def invariants(top: SymmetricTop, state: State) -> Invariants:
    """Invariants and nutation of a motion; the attitude is normalised first."""
    attitude = normalize(state.attitude)
    w1, w2, omega3 = state.omega
    spin = top.I3 / top.I1 * omega3
    mu = top.mgl / top.I1
    unit = _unit(w1, w2, spin, mu)
    hangs = mu < 0
    mu = jnp.where(hangs, -mu, mu) / unit / unit
    start = _start(attitude, w1 / unit, w2 / unit, spin / unit, hangs)
    momenta, constants = _constants(mu, start)

    _, a, b, _, g = constants
    root = jax.lax.stop_gradient(_largest_root(a, b, g * g))
    # Over the fourth power of the fastest rate the square of q is zero on the
    # separatrix.
    stretch = b + root * (2 * a + 3 * root)
    size = jnp.dtype(mu.dtype).itemsize
    nutates = stretch > _ON_SEPARATRIX[size] * (a + 3 * root) ** 2 + _SLOWEST[size]
    nutation = _whole_nutation(*harmless(nutates, (root, *constants)))
    return Invariants(
        unit, omega3, spin, hangs, start, momenta, constants, nutates, *nutation
    )


def _unit(w1: Array, w2: Array, spin: Array, mu: Array) -> Array:
    """A power of two near the fastest rate [rad/s]; 1 if there is none."""
    rates = jax.lax.stop_gradient(jnp.stack([w1, w2, spin, jnp.sqrt(jnp.abs(mu))]))
    fastest = jnp.max(jnp.abs(rates))
    least = _LEAST_UNIT[jnp.dtype(mu.dtype).itemsize]
    return power_of_two(jnp.where(fastest > 0, jnp.maximum(fastest, least), 1.0))


def _start(
    attitude: Array, w1: Array, w2: Array, spin: Array, hangs: Array
) -> tuple[Array, Array, Array, Array]:
    """Alpha, its rate, beta and its rate, of a top that hangs seen upside down."""
    q0, q1, q2, q3 = attitude
    upright_alpha = jax.lax.complex(q0, q3)
    upright_beta = jax.lax.complex(q1, q2)
    # The quaternion i q: space makes half a turn about its first axis.
    alpha = jnp.where(hangs, -jnp.conj(upright_beta), upright_alpha)
    beta = jnp.where(hangs, jnp.conj(upright_alpha), upright_beta)
    # q' = q (0, omega) / 2 in complex numbers. omega is that of the spherical top.
    across = jax.lax.complex(0.5 * w1, 0.5 * w2)
    along = jax.lax.complex(jnp.zeros_like(spin), 0.5 * spin)
    d_alpha = along * alpha - beta * jnp.conj(across)
    d_beta = alpha * across - along * beta
    return alpha, d_alpha, beta, d_beta


def _constants(
    mu: Array, start: tuple[Array, Array, Array, Array]
) -> tuple[Components, Components]:
    """Im x* x' of alpha and of beta, and mu, A, B, G of alpha, G of beta."""
    alpha, d_alpha, beta, d_beta = start
    sigma = square_of(beta)
    h = 2 * (square_of(d_alpha) + square_of(d_beta)) + mu * (1 - 2 * sigma)
    a = 0.5 * (3 * mu - h)
    # In this form B is of second order in a small tilt.
    b = -mu * (square_of(d_beta) + sigma * (mu * sigma - a))
    of_alpha = (jnp.conj(alpha) * d_alpha).imag
    of_beta = (jnp.conj(beta) * d_beta).imag
    constants = materialize(mu, a, b, mu * of_alpha, -mu * of_beta)
    return (of_alpha, of_beta), constants


def _turn(angle: Array) -> Array:
    """exp(i angle)."""
    return jax.lax.complex(jnp.cos(angle), jnp.sin(angle))


def _times(x: Array, y: Array) -> Array:
    """A real number times a complex one: dtypes are not mixed."""
    return jax.lax.complex(x * y.real, x * y.imag)


# Long: the formula of the head of this file for x = alpha and beta, and its derivative.
def _carried(
    x: Components, constants: Components, s: Array, slope: Array
) -> Components:
    """Alpha, beta and their rates after the time elapsed, without their turns.

    Those of alpha use functions of beta, which show how near to upright the top comes.
    """
    alpha, d_alpha, beta, d_beta = x
    mu, a, b, g_alpha, g_beta = constants
    z = s * s
    sigma = square_of(beta)
    rho = square_of(alpha)
    n = 1 + mu * sigma * z
    rise = 1 + mu * z
    bend = (2 / n) * (a - mu * sigma + z * (b - g_beta * g_beta * z)) - a
    lift = g_beta * s * z
    twist = (2 / n) * (g_beta * s * slope)
    new_beta = beta * jax.lax.complex(slope, -lift) + _times(s, d_beta)
    new_d_beta = d_beta * jax.lax.complex(slope * (2 / n - 1), lift)
    new_d_beta = new_d_beta + beta * jax.lax.complex(s * bend, -s * twist)

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
    new_alpha = alpha * jax.lax.complex(slope, turning * s) + _times(s * rise, drift)
    new_d_alpha = alpha * jax.lax.complex(s * bend, turning * slope * (2 / n - 1))
    new_d_alpha = new_d_alpha + drift * jax.lax.complex(
        slope * (2 * rise / n - 1), g_alpha * s * z
    )
    factor = 1 / (n * jnp.sqrt(rise))
    return (
        _times(factor, new_alpha),
        _times(factor, new_d_alpha),
        _times(1 / n, new_beta),
        _times(1 / n, new_d_beta),
    )


class _Half(NamedTuple):
    """Functions at half the time, less the whole nutations within the time."""

    nutations: Array
    s: Array
    slope: Array
    w_alpha: Array
    w_beta: Array


def _at_half(motion: Invariants, t: Scalar) -> _Half:
    """The functions of half the time, which two carries then use."""
    mu, a, b, _, g_beta = motion.constants
    phase = t * motion.unit
    nutations = jnp.where(motion.nutates, jnp.round(phase / motion.period), 0.0)
    h = 0.5 * (phase - nutations * motion.period)
    # A motion that nutates gets the rate 0, so its phase is not limited.
    growth = root_of_positive(jax.lax.stop_gradient(jnp.where(motion.nutates, 0.0, a)))
    longest = _LONGEST_PHASE[jnp.dtype(t.dtype).itemsize] / growth
    stop = jnp.clip(h, -longest, longest)
    s, w_alpha, w_beta = _elapsed(*motion.constants, stop)
    z = s * s
    # Beyond the longest phase s stays as it is, and w of alpha grows in proportion.
    w_alpha = w_alpha + z / (1 + mu * z) * (h - stop)
    functions = materialize(s, _slope(a, b, g_beta, z), w_alpha, w_beta)
    return _Half(nutations, *functions)


def state_after(motion: Invariants, t: Scalar) -> tuple[Quaternion, Vector]:
    """Attitude and angular velocity after a time t [s]."""
    _, _, _, g_alpha, g_beta = motion.constants
    half = _at_half(motion, t)
    carry = partial(_carried, constants=motion.constants, s=half.s, slope=half.slope)
    alpha, d_alpha, beta, d_beta = jax.lax.fori_loop(
        0, 2, lambda _, x: carry(x), motion.start
    )
    across = jnp.conj(alpha) * d_beta - beta * jnp.conj(d_alpha)
    # The turns of alpha and beta, and that of the body against the spherical top.
    slip = 0.5 * (motion.omega3 - motion.spin) * t
    angle_alpha = (
        2 * g_alpha * half.w_alpha
        + half.nutations * (motion.advance_alpha + jnp.pi)
        + slip
    )
    angle_beta = (
        2 * g_beta * half.w_beta
        + half.nutations * (motion.advance_beta + motion.half_turn)
        - slip
    )
    turn_alpha, turn_beta = materialize(_turn(angle_alpha), _turn(angle_beta))
    across = _times(2 * motion.unit, across * turn_beta * jnp.conj(turn_alpha))
    upright_alpha = alpha * turn_alpha
    upright_beta = beta * turn_beta
    # The quaternion -i q, the inverse of what `_start` did.
    alpha = jnp.where(motion.hangs, jnp.conj(upright_beta), upright_alpha)
    beta = jnp.where(motion.hangs, -jnp.conj(upright_alpha), upright_beta)
    q = jnp.stack([alpha.real, beta.real, beta.imag, alpha.imag])
    omega = jnp.stack([across.real, across.imag, motion.omega3])
    return q / jnp.sqrt(jnp.sum(q * q)), omega
