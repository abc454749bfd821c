r"""The exact flow of the free body in its principal axes: one analytic formula, no regimes.

With a_i = 1 / I_i and the momentum L = I omega, axes labelled so that I2 is the middle
moment and the momentum circles the third axis, let

    al = a1 - a2,  be = a2 - a3,  C2 = 2 E - a2 |L|^2,
    kap = al be |L|^2 >= 0,  u = -al C2 >= 0,  v = -be C2 >= 0,  P = kap - u,  Q = kap +
    v.

The momentum moves as the scaled Jacobi functions of the elapsed time

    s' = cP cQ,  cP' = -P s cQ,  cQ' = -Q s cP,  s = 0, cP = cQ = 1 at the start,

(s = sn(lam t) / lam, cQ = cn, cP = dn with lam^2 = Q and m = P / Q), which are analytic
in kap, u and v: spheres, symmetric bodies, spin about an axis and the separatrix are no
special cases. The attitude is a rotation about the momentum by an angle that needs one
integral more,

    w = integral of s^2 / (1 - kap s^2),

times the rotation that carries the momentum at the time to that at the start; both come
from the momentum at half the time. For a short time a polynomial gives s, and with it
cP and cQ, and a quadrature w; doubling formulas (addition theorems with equal
arguments) do the rest, after whole half-periods of the momentum have been taken off.
"""

from typing import Any, NamedTuple

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

_DOUBLINGS = 11
_MEANS = 11  # arithmetic-geometric means: quadratic convergence, from a ratio of 1e-60
# Nearer to the separatrix than this fraction the half-period is out of reach, and
# beyond this phase the momentum is taken to stay: a start within 1e-60 (float32: 1e-18)
# of the unstable axis, whose departure would begin only then.
_ON_SEPARATRIX = {8: 1e-120, 4: 1e-36}
_LONGEST_PHASE = {8: 80.0, 4: 24.0}


def _short_time(kap: Array, p: Array, q: Array, h: Array) -> Components:
    a, b = (p + q) * h * h, p * q * h**4
    c1 = -a / 6
    c2 = (a * a + 12 * b) / 120
    c3 = -a * (a * a + 132 * b) / 5040
    c4 = (a**4 + 1224 * a * a * b + 3024 * b * b) / 362880
    s = h * (1 + (c1 + (c2 + (c3 + c4))))
    nodes, weights = gauss_legendre(5, s.dtype)
    z = (s * nodes) ** 2
    w = jnp.sum(s * z * weights / ((1 - kap * z) * jnp.sqrt((1 - p * z) * (1 - q * z))))
    return s, jnp.sqrt(1 - p * s * s), jnp.sqrt(1 - q * s * s), w


def _twice(kap: Array, u: Array, v: Array, at_half: Components) -> Components:
    s, cp, cq, w = at_half
    p, q = kap - u, kap + v
    s2, cp2, cq2 = s * s, cp * cp, cq * cq
    inverse = 2 / (cp2 * (1 + q * s2) + cq2 * (1 + p * s2))

    def cosine(m: Array, own: Array, other: Array, spread: Array) -> Array:
        # The first form does not amplify the error of a cosine, the second keeps the
        # relative accuracy of an exponentially small one.
        far = own * own + m * spread * s2 * s2
        return jnp.where(m * s2 < 0.3, 1 - 2 * m * s2 * other * inverse, far * inverse)

    s, cp, cq = (
        2 * s * cp * cq * inverse,
        cosine(p, cp2, cq2, u + v),
        cosine(q, cq2, cp2, -u - v),
    )
    g = s2 * s / (cq * cq + v * s * s + kap * s2 * cp * cq)
    return s, cp, cq, 2 * w + g * arctanc_sqrt(kap * (u * g) * (v * g))


@with_columns
def scaled_jacobi(kap: Array, u: Array, v: Array, t: Array) -> Components:
    """Functions s, cP, cQ and w of kap, u, v >= 0 and a time of at most a quarter period."""
    start = _short_time(kap, kap - u, kap + v, t * 2.0**-_DOUBLINGS)
    return jax.lax.fori_loop(0, _DOUBLINGS, lambda _, x: _twice(kap, u, v, x), start)


@with_columns
def quarter_period(kap: Array, u: Array, v: Array) -> Components:
    """Time K / lam in which s grows to its maximum, and w there; v > 0.

    Source: R. Bulirsch, Numer. Math. 7 (1965) 78, 13 (1969) 305: the complete integral
    `cel` with a = 0, b = 1.
    """
    square = kap + v
    rate = jnp.sqrt(square)
    complement = jnp.sqrt((u + v) / square)

    def body(_: Any, x: Components) -> Components:
        kc, e, m, p, a, b = x
        a, b = a + b / p, 2 * (b + a * (e / p))
        p, m = e / p + p, m + kc
        kc = 2 * jnp.sqrt(e)
        return kc, kc * m, m, p, a, b

    one = jnp.ones_like(rate)
    p = jnp.sqrt(v / square)
    start = (complement, complement, one, p, jnp.zeros_like(rate), one / p)
    _, _, m, p, a, b = jax.lax.fori_loop(0, _MEANS, body, start)
    half_pi = jnp.pi / 2
    return half_pi * 2.0**_MEANS / (m * rate), half_pi * (b + a * m) / (
        m * (m + p) * rate * square
    )


class Labels(NamedTuple):
    """How the axes are renamed: the second has the middle moment and the third is circled.

    A proper rotation: a cyclic shift and, where `reverse`, (x, y, z) to (-z, -y, -x).
    """

    first_is_middle: Bool[Array, ""]
    second_is_middle: Bool[Array, ""]
    reverse: Bool[Array, ""]

    def shift(self, x: Components | Array, by: int = 1) -> Components:
        """The cyclic shift alone, or with 2 its inverse."""
        unless = [
            jnp.where(self.second_is_middle, x[j], x[j + by - 3]) for j in range(3)
        ]
        return tuple(
            jnp.where(self.first_is_middle, x[j - by], y) for j, y in enumerate(unless)
        )

    def flip(self, x: Components | Array, sign: int = -1) -> Components:
        """The reversal alone, of a vector, or of moments with sign = 1; its own inverse."""
        return tuple(jnp.where(self.reverse, sign * x[2 - j], x[j]) for j in range(3))

    def undo(self, x: Components | Array) -> Components:
        """The components of a vector by the names the axes had."""
        return self.shift(self.flip(x), 2)


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
    circles: Bool[
        Array, ""
    ]  # False where nothing is circled in any time: sphere, separatrix, rest
    quarter: Scalar
    quarter_w: Scalar


@jax.jit  # outside of jit a loop defined in a function is compiled at every call
def invariants(moments: Vector, omega: Vector) -> Invariants:
    """The labels, the invariants and the period of a motion."""
    unit = power_of_two(jax.lax.stop_gradient(jnp.max(jnp.abs(omega))))
    i = moments / power_of_two(jax.lax.stop_gradient(jnp.max(moments)))
    first, second = ((i[j] - i[j - 1]) * (i[j] - i[j - 2]) <= 0 for j in range(2))
    labels = Labels(first, second, jnp.array(False))
    i1, i2, i3 = labels.shift(i)
    w1, w2, w3 = labels.shift(omega / unit)
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
    quarters = quarter_period(*harmless(circles, (kap, u, v)))
    al, be, l1, l2, l3, i1, i2, i3, square = materialize(
        al, be, l1, l2, l3, i1, i2, i3, square
    )
    return Invariants(
        labels,
        unit,
        (i1, i2, i3),
        (l1, l2, l3),
        al,
        be,
        square,
        kap,
        u,
        v,
        circles,
        *quarters,
    )


def after(motion: Invariants, t: Scalar) -> tuple[Quaternion, Vector]:
    """Rotation p since the start, q(t) = q(0) p(t), and angular velocity, in the principal axes."""
    (
        labels,
        unit,
        moments,
        (l1, l2, l3),
        al,
        be,
        square,
        kap,
        u,
        v,
        circles,
        *quarters,
    ) = motion
    quarter, quarter_w = quarters
    t = t * unit
    # Whole half-periods; both neighbours of a change of their number give the same
    # motion.
    halves = jnp.where(circles, jnp.round(t / (2 * quarter)), 0.0)
    growth = root_of_positive(jax.lax.stop_gradient(kap + v))
    longest = _LONGEST_PHASE[jnp.dtype(t.dtype).itemsize] / growth
    h = jnp.clip(0.5 * t - halves * quarter, -longest, longest)
    s, cp, cq, w = scaled_jacobi(kap, u, v, h)
    phase = 0.5 * t / moments[1] + al * v * (w + halves * quarter_w)
    s, cp, cq, phase = materialize(s, cp, cq, phase)

    # The momentum at half the time, and the rotation that carries the momentum to its
    # start.
    d = cq * cq + be * (al + be) * l3 * l3 * s * s
    half1 = (l1 * cq - be * l2 * l3 * s * cp) / d
    half3 = (l3 * cp - al * l1 * l2 * s * cq) / d
    x, y, z = cp * cq, al * half1 * s * cq, -be * half3 * s * cp
    norm = jnp.sqrt(x * x + y * y + z * z)
    x, y, z = materialize(x / norm, y / norm, z / norm)
    turns = halves - 4 * jnp.floor(halves / 4)  # quarters of 720 degrees
    even, odd = (
        jnp.where(turns % 2 == 0, 1 - turns, 0.0),
        jnp.where(turns % 2 == 1, 2 - turns, 0.0),
    )
    odd = jnp.where(be * l3 < 0, odd, -odd)
    back = jnp.stack([x * even - z * odd, y * even, -y * odd, x * odd + z * even])

    z = square * phase * phase
    turn = sinc_sqrt(z) * phase
    about = jnp.stack([cos_sqrt(z), turn * l1, turn * l2, turn * l3])
    back, about = materialize(back, about)
    attitude = multiply(about, back)
    end = rotate_inverse(back, jnp.stack([l1, l2, l3]))
    attitude, end = materialize(attitude, end)
    rates = labels.undo(end / jnp.stack(moments))
    return jnp.stack([attitude[0], *labels.undo(attitude[1:])]), unit * jnp.stack(rates)
