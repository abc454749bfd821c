r"""The exact flow of the free body in its principal axes: one analytic formula, no regimes.

With a_i = 1 / I_i and the momentum L = I omega, axes labelled so that I2 is the middle moment and
the momentum circles the third axis, let

    al = a1 - a2,  be = a2 - a3,  C2 = 2 E - a2 |L|^2,
    kap = al be |L|^2 >= 0,  u = -al C2 >= 0,  v = -be C2 >= 0,  P = kap - u,  Q = kap + v.

The momentum moves as the scaled Jacobi functions of the elapsed time

    s' = cP cQ,  cP' = -P s cQ,  cQ' = -Q s cP,  s = 0, cP = cQ = 1 at the start,

(s = sn(lam t) / lam, cQ = cn, cP = dn with lam^2 = Q and m = P / Q), which are analytic in kap, u
and v: spheres, symmetric bodies, spin about an axis and the separatrix are no special cases. The
attitude is a rotation about the momentum by an angle that needs one integral more,

    w = integral of s^2 / (1 - kap s^2),

times the rotation that carries the momentum at the time to that at the start; both come from
the momentum at half the time. A polynomial gives s, cP, cQ and w for a short time; doubling
formulas (addition theorems with equal arguments) do the rest, after whole half-periods of the
momentum have been taken off.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jrigid._numerics import (
    Components,
    arctanc_sqrt,
    cos_sqrt,
    materialize,
    power_of_two,
    sinc_sqrt,
    with_columns,
)
from jrigid._types import Quaternion, Scalar, Vector
from jrigid.rotation import multiply, rotate_inverse

_DOUBLINGS = 11
_MEANS = 11  # arithmetic-geometric means: quadratic convergence, from a ratio of 1e-60
# Half-periods are taken off beyond this phase; a quarter period is pi/2 of phase or more.
_SHORT_PHASE = 0.7
# Nearer to the separatrix than this fraction the half-period is out of reach, and beyond this phase
# the momentum is taken to stay: a start within 1e-60 (float32: 1e-18) of the unstable axis, whose
# departure would begin only then.
_ON_SEPARATRIX = {8: 1e-120, 4: 1e-36}
_LONGEST_PHASE = {8: 80.0, 4: 24.0}


def _short_time(kap: Array, p: Array, q: Array, h: Array) -> Components:
    a, b, k = (p + q) * h * h, p * q * h**4, kap * h * h
    c1 = -a / 6
    c2 = (a * a + 12 * b) / 120
    c3 = -a * (a * a + 132 * b) / 5040
    c4 = (a**4 + 1224 * a * a * b + 3024 * b * b) / 362880
    s = h * (1 + (c1 + (c2 + (c3 + c4))))
    d1, d2, d3 = 2 * c1, c1 * c1 + 2 * c2, 2 * (c3 + c1 * c2)
    g1 = d1 + k
    g2 = d2 + k * (d1 + g1)
    g3 = d3 + k * (d2 + d1 * g1 + g2)
    w = h**3 * (1 / 3 + (g1 / 5 + (g2 / 7 + g3 / 9)))
    return s, jnp.sqrt(1 - p * s * s), jnp.sqrt(1 - q * s * s), w


def _twice(kap: Array, u: Array, v: Array, at_half: Components) -> Components:
    s, cp, cq, w = at_half
    p, q = kap - u, kap + v
    s2, cp2, cq2 = s * s, cp * cp, cq * cq
    inverse = 2 / (cp2 * (1 + q * s2) + cq2 * (1 + p * s2))
    # The first form does not amplify the error of a cosine, the second keeps the relative
    # accuracy of an exponentially small one.
    spread = (u + v) * s2 * s2
    cp_twice = jnp.where(
        p * s2 < 0.3, 1 - 2 * p * s2 * cq2 * inverse, (cp2 * cp2 + p * spread) * inverse
    )
    cq_twice = jnp.where(
        q * s2 < 0.3, 1 - 2 * q * s2 * cp2 * inverse, (cq2 * cq2 - q * spread) * inverse
    )
    s_twice = 2 * s * cp * cq * inverse
    g = (
        s2
        * s_twice
        / (cq_twice * cq_twice + v * s_twice * s_twice + kap * s2 * cp_twice * cq_twice)
    )
    return s_twice, cp_twice, cq_twice, 2 * w + g * arctanc_sqrt(kap * (u * g) * (v * g))


@with_columns
def scaled_jacobi(kap: Array, u: Array, v: Array, t: Array) -> Components:
    """Functions s, cP, cQ and w of kap, u, v >= 0 and a time of at most a quarter period."""
    start = _short_time(kap, kap - u, kap + v, t * 2.0**-_DOUBLINGS)
    return jax.lax.fori_loop(0, _DOUBLINGS, lambda _, x: _twice(kap, u, v, x), start)


@with_columns
def quarter_period(kap: Array, u: Array, v: Array) -> Components:
    """Time K / lam in which s grows to its maximum, and w there; v > 0.

    Source: R. Bulirsch, Numer. Math. 7 (1965) 78, 13 (1969) 305: the complete integral `cel`
    with a = 0, b = 1.
    """
    square = kap + v
    rate = jnp.sqrt(square)
    complement = jnp.sqrt((u + v) / square)

    def body(_: Any, x: Components) -> Components:
        kc, e, m, p, a, b = x
        kc, e, m, p, a, b = kc, e, m, p, a + b / p, 2 * (b + a * (e / p))
        p, m = e / p + p, m + kc
        kc = 2 * jnp.sqrt(e)
        return kc, kc * m, m, p, a, b

    one = jnp.ones_like(rate)
    p = jnp.sqrt(v / square)
    start = (complement, complement, one, p, jnp.zeros_like(rate), one / p)
    _, _, m, p, a, b = jax.lax.fori_loop(0, _MEANS, body, start)
    half_pi = jnp.pi / 2
    return half_pi * 2.0**_MEANS / (m * rate), half_pi * (b + a * m) / (m * (m + p) * rate * square)


class Labels(NamedTuple):
    """How the axes are renamed: the second has the middle moment and the third is circled.

    A proper rotation: a cyclic shift and, where `reverse`, (x, y, z) to (-z, -y, -x).
    """

    first_is_middle: Bool[Array, ""]
    second_is_middle: Bool[Array, ""]
    reverse: Bool[Array, ""]

    def shift(self, x: Components) -> Components:
        """The cyclic shift alone."""
        return self._cycled(x, 1, 2)

    def flip(self, x: Components, sign: int = -1) -> Components:
        """The reversal alone, of a vector, or of moments with sign = 1; its own inverse."""
        return tuple(jnp.where(self.reverse, sign * x[2 - j], x[j]) for j in range(3))

    def undo(self, x: Components) -> Components:
        """The components of a vector by the names the axes had."""
        return self._cycled(self.flip(x), 2, 1)

    def _cycled(self, x: Components, by: int, otherwise: int) -> Components:
        unless = (jnp.where(self.second_is_middle, x[j], x[j - otherwise]) for j in range(3))
        return tuple(jnp.where(self.first_is_middle, x[j - by], y) for j, y in enumerate(unless))


class Invariants(NamedTuple):
    """What a free motion keeps, in units in which the moments and rates are of order one."""

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
    circles: Bool[Array, ""]  # False where nothing is circled in any time: sphere, separatrix, rest
    quarter: Scalar
    quarter_w: Scalar


@jax.jit  # outside of jit a loop defined in a function is compiled at every call
def invariants(moments: Vector, omega: Vector) -> Invariants:
    """The labels, the invariants and the period of a motion."""
    unit = power_of_two(jax.lax.stop_gradient(jnp.max(jnp.abs(omega))))
    i = moments / power_of_two(jax.lax.stop_gradient(jnp.max(moments)))
    rates = omega / unit
    first, second = ((i[j] - i[j - 1]) * (i[j] - i[j - 2]) <= 0 for j in range(2))
    labels = Labels(first, second, jnp.array(False))
    i1, i2, i3 = labels.shift(tuple(i))
    w1, w2, w3 = labels.shift(tuple(rates))
    above = ((i2 - i1) * i1 * w1 * w1 - (i3 - i2) * i3 * w3 * w3) / i2  # 2 E - a2 |L|^2
    labels = labels._replace(reverse=(i3 - i1) * above > 0)
    i1, i2, i3 = labels.flip((i1, i2, i3), 1)
    w1, w2, w3 = labels.flip((w1, w2, w3))
    al, be = (i2 - i1) / (i1 * i2), (i3 - i2) / (i2 * i3)
    l1, l2, l3 = i1 * w1, i2 * w2, i3 * w3
    square = l1 * l1 + l2 * l2 + l3 * l3
    kap, u, v = materialize(al * be * square, -al * above, -be * above)
    tiny = _ON_SEPARATRIX[jnp.dtype(i.dtype).itemsize]
    circles = u + v > tiny * (kap + v)
    quarter, quarter_w = quarter_period(*(jnp.where(circles, x, 0.5) for x in (kap, u, v)))
    al, be, l1, l2, l3, i1, i2, i3, square = materialize(al, be, l1, l2, l3, i1, i2, i3, square)
    return Invariants(
        labels, unit, (i1, i2, i3), (l1, l2, l3), al, be, square, kap, u, v, circles, quarter,
        quarter_w,
    )  # fmt: skip


def after(motion: Invariants, t: Scalar) -> tuple[Quaternion, Vector]:
    """Rotation p since the start, q(t) = q(0) p(t), and angular velocity, in the principal axes."""
    labels, unit, (i1, i2, i3), momentum, al, be, square, kap, u, v, circles, *quarters = motion
    quarter, quarter_w = quarters
    l1, l2, l3 = momentum
    t = t * unit

    # Whole half-periods; both neighbours of a change of their number give the same motion.
    reach = (kap + v) * t * t
    counted = circles & (reach >= _SHORT_PHASE**2)
    halves = jnp.where(counted, jnp.round(jax.lax.stop_gradient(t / (2 * quarter))), 0.0)
    h = 0.5 * t - halves * quarter
    longest = _LONGEST_PHASE[jnp.dtype(t.dtype).itemsize]
    reach = (kap + v) * h * h
    beyond = reach > longest * longest
    h = jnp.where(beyond, h * (longest / jnp.sqrt(jnp.where(beyond, reach, 1.0))), h)
    s, cp, cq, w = scaled_jacobi(kap, u, v, h)
    phase = 0.5 * t / i2 + al * v * (w + halves * quarter_w)
    s, cp, cq, phase = materialize(s, cp, cq, phase)

    # The momentum at half the time, and the rotation that carries the momentum to its start.
    d = cq * cq + be * (al + be) * l3 * l3 * s * s
    half1 = (l1 * cq - be * l2 * l3 * s * cp) / d
    half3 = (l3 * cp - al * l1 * l2 * s * cq) / d
    x, y, z = cp * cq, al * half1 * s * cq, -be * half3 * s * cp
    norm = jnp.sqrt(x * x + y * y + z * z)
    x, y, z = materialize(x / norm, y / norm, z / norm)
    quarter_turns = halves - 4 * jnp.floor(halves / 4)
    even = jnp.where(quarter_turns == 0, 1.0, jnp.where(quarter_turns == 2, -1.0, 0.0))
    odd = jnp.where(quarter_turns == 1, 1.0, jnp.where(quarter_turns == 3, -1.0, 0.0))
    odd = jnp.where(be * l3 < 0, odd, -odd)
    back = jnp.stack([x * even - z * odd, y * even, -y * odd, x * odd + z * even])

    z = square * phase * phase
    turn = sinc_sqrt(z) * phase
    about = jnp.stack([cos_sqrt(z), turn * l1, turn * l2, turn * l3])
    back, about = materialize(back, about)
    attitude = multiply(about, back)
    end = rotate_inverse(back, jnp.stack(momentum))
    attitude, end = materialize(attitude, end)
    vector = labels.undo((attitude[1], attitude[2], attitude[3]))
    rates = labels.undo((end[0] / i1, end[1] / i2, end[2] / i3))
    return jnp.stack([attitude[0], *vector]), unit * jnp.stack(rates)
