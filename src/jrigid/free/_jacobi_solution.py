r"""The exact flow of the free body in its principal axes: one analytic formula.

With a_i = 1 / I_i and the momentum L = I omega, axes labelled so that I2 is the middle
moment and the momentum circles the third axis, let

    al = a1 - a2,  be = a2 - a3,  C2 = 2 E - a2 |L|^2,  kap = al be |L|^2 >= 0,
    u = -al C2 >= 0,  v = -be C2 >= 0,  P = kap - u,  Q = kap + v.

The momentum follows from scaled Jacobi functions of the elapsed time,

    s' = cP cQ,  cP' = -P s cQ,  cQ' = -Q s cP,  s = 0, cP = cQ = 1 at the start,

(s = sn(lam t) / lam, cQ = cn, cP = dn with lam^2 = Q and m = P / Q). They are analytic
in kap, u and v, so spheres, symmetric bodies, spin about an axis and the separatrix are
no special cases. The attitude is a rotation about the momentum by an angle that needs
one more integral,

    w = integral of s^2 / (1 - kap s^2),

times the rotation that carries the momentum at the time to that at the start. Both
follow from the momentum at half the time. For a short time a polynomial gives s, and
with it cP and cQ, and a quadrature gives w. Doubling formulas (addition theorems with
equal arguments) do the rest, after whole half-periods of the momentum have been taken
off.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jrigid._checks import harmless
from jrigid._numerics import (
    Components,
    arctanc_sqrt,
    cos_sqrt,
    gauss_legendre,
    materialize,
    power_of_two,
    root_of_positive,
    sinc_sqrt,
    with_columns,
)
from jrigid._types import Quaternion, Scalar, Vector
from jrigid.rotation import multiply, rotate_inverse

# The longest phase over 2^11 is 0.04. There the next term of the series is below 0.01 x
# 0.04^10 = 1e-16 of s, which is its rounding.
_DOUBLINGS = 11
_MEANS = 11  # arithmetic-geometric means: quadratic convergence, from a ratio of 1e-60
# Closer to the separatrix than this fraction, no half-period ends in any time. Beyond
# the longest phase the momentum is taken to stay: it would leave only then, from within
# 1e-60 (float32: 1e-18) of the unstable axis.
_ON_SEPARATRIX = {8: 1e-120, 4: 1e-36}
# Half of the quarter period at the limit, log(4 / 1e-60) / 2 = 70 (float32: 21), is
# below it.
_LONGEST_PHASE = {8: 80.0, 4: 24.0}


def _short_time(kap: Array, p: Array, q: Array, h: Array) -> Components:
    """Functions s, cP, cQ and w after a short time: a series and a quadrature."""
    # The Taylor series of s'^2 = 1 - (P + Q) s^2 + P Q s^4.
    a = (p + q) * h * h
    b = p * q * h**4
    c1 = -a / 6
    c2 = (a * a + 12 * b) / 120
    c3 = -a * (a * a + 132 * b) / 5040
    c4 = (a**4 + 1224 * a * a * b + 3024 * b * b) / 362880
    s = h * (1 + (c1 + (c2 + (c3 + c4))))
    # The integral over s instead of the time, with dt = ds / (cP cQ).
    nodes, weights = gauss_legendre(5, s.dtype)
    z = (s * nodes) ** 2
    w = jnp.sum(s * z * weights / ((1 - kap * z) * jnp.sqrt((1 - p * z) * (1 - q * z))))
    return s, jnp.sqrt(1 - p * s * s), jnp.sqrt(1 - q * s * s), w


def _twice(kap: Array, u: Array, v: Array, at_half: Components) -> Components:
    """Functions s, cP, cQ and w after twice the time."""
    s, cp, cq, w = at_half
    p = kap - u
    q = kap + v
    s2 = s * s
    cp2 = cp * cp
    cq2 = cq * cq
    # The denominator 1 - P Q s^4 of the addition theorems, as a sum of positive terms.
    inverse = 2 / (cp2 * (1 + q * s2) + cq2 * (1 + p * s2))

    def cosine(m: Array, own: Array, other: Array, spread: Array) -> Array:
        # The first form does not amplify the error of a cosine, the second keeps the
        # relative accuracy of an exponentially small one.
        far = own * own + m * spread * s2 * s2
        return jnp.where(m * s2 < 0.3, 1 - 2 * m * s2 * other * inverse, far * inverse)

    s = 2 * s * cp * cq * inverse
    cp = cosine(p, cp2, cq2, u + v)
    cq = cosine(q, cq2, cp2, -u - v)
    g = s2 * s / (cq * cq + v * s * s + kap * s2 * cp * cq)
    return s, cp, cq, 2 * w + g * arctanc_sqrt(kap * (u * g) * (v * g))


@with_columns
def scaled_jacobi(kap: Array, u: Array, v: Array, t: Array) -> Components:
    """Functions s, cP, cQ and w of kap, u, v >= 0, up to a quarter period."""
    start = _short_time(kap, kap - u, kap + v, t * 2.0**-_DOUBLINGS)
    return jax.lax.fori_loop(0, _DOUBLINGS, lambda _, x: _twice(kap, u, v, x), start)


@with_columns
def quarter_period(kap: Array, u: Array, v: Array) -> Components:
    """Time K / lam in which s grows to its maximum, and w at that time; v > 0.

    Source: R. Bulirsch, Numer. Math. 7 (1965) 78, 13 (1969) 305: the complete integral
    `cel` with a = 0, b = 1.
    """
    square = kap + v
    rate = jnp.sqrt(square)
    complement = jnp.sqrt((u + v) / square)

    # The letters are Bulirsch's.
    def body(_: Array, x: Components) -> Components:
        kc, e, m, p, a, b = x
        next_a = a + b / p
        next_b = 2 * (b + a * (e / p))
        p = e / p + p
        m = m + kc
        kc = 2 * jnp.sqrt(e)
        return kc, kc * m, m, p, next_a, next_b

    one = jnp.ones_like(rate)
    p = jnp.sqrt(v / square)
    start = (complement, complement, one, p, jnp.zeros_like(rate), one / p)
    _, _, m, p, a, b = jax.lax.fori_loop(0, _MEANS, body, start)
    half_pi = jnp.pi / 2
    time = half_pi * 2.0**_MEANS / (m * rate)
    return time, half_pi * (b + a * m) / (m * (m + p) * rate * square)


class Labels(NamedTuple):
    """New names of the axes: the second has the middle moment, the third is circled.

    They are a proper rotation: a cyclic shift and, where `reverse`, (x, y, z) to
    (-z, -y, -x).
    """

    first_is_middle: Bool[Array, ""]
    second_is_middle: Bool[Array, ""]
    reverse: Bool[Array, ""]

    def shift(self, x: Components | Array, by: int = 1) -> Components:
        """The cyclic shift alone; with `by=2` its inverse."""
        unless_first = [
            jnp.where(self.second_is_middle, x[j], x[j + by - 3]) for j in range(3)
        ]
        return tuple(
            jnp.where(self.first_is_middle, x[j - by], y)
            for j, y in enumerate(unless_first)
        )

    def flip(self, x: Components | Array, sign: int = -1) -> Components:
        """The reversal alone, its own inverse; with `sign=1` that of moments."""
        return tuple(jnp.where(self.reverse, sign * x[2 - j], x[j]) for j in range(3))

    def undo(self, x: Components | Array) -> Components:
        """The components of a vector by the old names of the axes."""
        return self.shift(self.flip(x), 2)


class Invariants(NamedTuple):
    """Constants of a free motion, in units with moments and rates of order one.

    The letters are those of the head of this file.
    """

    labels: Labels
    unit: Scalar  # of omega [rad/s]
    moments: Components
    momentum: Components
    al: Scalar
    be: Scalar
    momentum_square: Scalar
    kap: Scalar
    u: Scalar
    v: Scalar
    # False where the momentum circles no axis in any time: sphere, separatrix, rest.
    circles: Bool[Array, ""]
    quarter: Scalar  # a quarter of the period
    quarter_w: Scalar  # w after a quarter of the period


@jax.jit  # outside of jit a loop defined in a function is compiled at every call
def invariants(moments: Vector, omega: Vector) -> Invariants:
    """The labels, the invariants and the period of a motion."""
    unit = power_of_two(jax.lax.stop_gradient(jnp.max(jnp.abs(omega))))
    # The motion depends on ratios of the moments alone.
    i = moments / power_of_two(jax.lax.stop_gradient(jnp.max(moments)))
    labels, i, w, excess = _labelled(i, omega / unit)
    i1, i2, i3 = i
    w1, w2, w3 = w
    al = (i2 - i1) / (i1 * i2)
    be = (i3 - i2) / (i2 * i3)
    l1, l2, l3 = i1 * w1, i2 * w2, i3 * w3
    square = l1 * l1 + l2 * l2 + l3 * l3
    kap, u, v = materialize(al * be * square, -al * excess, -be * excess)
    tiny = _ON_SEPARATRIX[jnp.dtype(i1.dtype).itemsize]
    circles = u + v > tiny * (kap + v)
    quarter, quarter_w = quarter_period(*harmless(circles, (kap, u, v)))
    al, be, l1, l2, l3, i1, i2, i3, square = materialize(
        al, be, l1, l2, l3, i1, i2, i3, square
    )
    return Invariants(
        labels=labels,
        unit=unit,
        moments=(i1, i2, i3),
        momentum=(l1, l2, l3),
        al=al,
        be=be,
        momentum_square=square,
        kap=kap,
        u=u,
        v=v,
        circles=circles,
        quarter=quarter,
        quarter_w=quarter_w,
    )


def _labelled(
    moments: Array, omega: Array
) -> tuple[Labels, Components, Components, Array]:
    """Labels, moments and rates by the new names of the axes, and 2 E - a2 |L|^2."""
    # The middle moment is not above both others, nor below both.
    first, second = (
        (moments[j] - moments[j - 1]) * (moments[j] - moments[j - 2]) <= 0
        for j in range(2)
    )
    labels = Labels(first, second, jnp.array(False))
    i1, i2, i3 = labels.shift(moments)
    w1, w2, w3 = labels.shift(omega)
    # Differences of the moments come first: the difference of 2 E and a2 |L|^2 would
    # lose digits, and its sign decides the regime.
    excess = ((i2 - i1) * i1 * w1 * w1 - (i3 - i2) * i3 * w3 * w3) / i2
    # The angular momentum circles axis 3 where u = -al C2 >= 0, and al has the sign of
    # I3 - I1.
    labels = labels._replace(reverse=(i3 - i1) * excess > 0)
    return labels, labels.flip((i1, i2, i3), 1), labels.flip((w1, w2, w3)), excess


class _Half(NamedTuple):
    """The scaled Jacobi functions at half the time, less the half-periods within it."""

    half_periods: Array  # of the momentum in the whole time
    s: Array
    cp: Array
    cq: Array
    phase: Array  # half the angle about the momentum, over |L|


def _at_half(motion: Invariants, t: Array) -> _Half:
    """The functions at half of a time, which is in units of the motion."""
    # At a change of their number both neighbours give the same motion.
    half_periods = jnp.where(motion.circles, jnp.round(t / (2 * motion.quarter)), 0.0)
    # For a sphere and at rest this is 0, and then no phase is too long.
    growth = root_of_positive(jax.lax.stop_gradient(motion.kap + motion.v))
    longest = _LONGEST_PHASE[jnp.dtype(t.dtype).itemsize] / growth
    h = jnp.clip(0.5 * t - half_periods * motion.quarter, -longest, longest)
    s, cp, cq, w = scaled_jacobi(motion.kap, motion.u, motion.v, h)
    phase = 0.5 * t / motion.moments[1] + motion.al * motion.v * (
        w + half_periods * motion.quarter_w
    )
    return _Half(half_periods, *materialize(s, cp, cq, phase))


def _back_to_start(motion: Invariants, half: _Half) -> Array:
    """Rotation that carries the momentum at the time to that at the start."""
    s, cp, cq = half.s, half.cp, half.cq
    al, be = motion.al, motion.be
    l1, l2, l3 = motion.momentum
    d = cq * cq + be * (al + be) * l3 * l3 * s * s
    half1 = (l1 * cq - be * l2 * l3 * s * cp) / d  # the momentum at half the time
    half3 = (l3 * cp - al * l1 * l2 * s * cq) / d
    x = cp * cq
    y = al * half1 * s * cq
    z = -be * half3 * s * cp
    norm = jnp.sqrt(x * x + y * y + z * z)
    x, y, z = materialize(x / norm, y / norm, z / norm)
    # Each half-period of the momentum is a half turn about the third axis.
    quarters = half.half_periods - 4 * jnp.floor(
        half.half_periods / 4
    )  # of 720 degrees
    even = jnp.where(quarters % 2 == 0, 1 - quarters, 0.0)
    odd = jnp.where(quarters % 2 == 1, 2 - quarters, 0.0)
    odd = jnp.where(be * l3 < 0, odd, -odd)
    return jnp.stack([x * even - z * odd, y * even, -y * odd, x * odd + z * even])


def after(motion: Invariants, t: Scalar) -> tuple[Quaternion, Vector]:
    """Rotation p with q(t) = q(0) p(t), and angular velocity, in the principal axes."""
    half = _at_half(motion, t * motion.unit)
    back = _back_to_start(motion, half)
    l1, l2, l3 = motion.momentum
    # The half-angle about L is |L| times this phase. Even functions of it need no |L|,
    # which has no derivative at rest.
    z = motion.momentum_square * half.phase * half.phase
    turn = sinc_sqrt(z) * half.phase
    about = jnp.stack([cos_sqrt(z), turn * l1, turn * l2, turn * l3])
    back, about = materialize(back, about)
    attitude = multiply(about, back)
    end = rotate_inverse(back, jnp.stack([l1, l2, l3]))
    attitude, end = materialize(attitude, end)
    rates = motion.labels.undo(end / jnp.stack(motion.moments))
    turned = jnp.stack([attitude[0], *motion.labels.undo(attitude[1:])])
    return turned, motion.unit * jnp.stack(rates)
