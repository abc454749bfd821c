"""Jacobi's elliptic functions and the amplitude."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid.elliptic._carlson import Arrays, Values, ValuesLike, g_of
from jrigid.elliptic._legendre import with_parameters

# Landen steps that take mc = 1e-300 (float32: 1e-37) to 1 within rounding.
_LANDEN_STEPS = 13
_LANDEN_STEPS_FLOAT32 = 9
# pi in two parts, the first of 33 (float32: 12) bits: its multiples are exact.
_PI_PARTS = (3.1415926534682512, 1.2154201013012384e-10)
_PI_PARTS_FLOAT32 = (3.140625, 9.67653589793e-4)


class JacobiFunctions(NamedTuple):
    """Jacobi's functions and the amplitude, as `ellipj` returns them.

    Attributes:
        sn: Sine of the amplitude.
        cn: Cosine of the amplitude.
        dn: Derivative of the amplitude by u, sqrt(1 - m sn^2) with its sign.
        am: Amplitude [rad].
    """

    sn: Values
    cn: Values
    dn: Values
    am: Values


def _hyperbolic(u: Array) -> tuple[Array, Array]:
    """Tanh u and sech u without overflow."""
    decay = jnp.exp(-jnp.abs(u))
    square = decay * decay
    tanh = -jnp.expm1(-2 * jnp.abs(u)) / (1 + square)
    return jnp.copysign(tanh, u), 2 * decay / (1 + square)


def _sides(cotangent: Array) -> tuple[Array, Array]:
    """Sine and cosine, divided by the larger one of them."""
    # The larger side is 1, so that squares stay in range for any cotangent, an infinite
    # one too.
    flat = jnp.abs(cotangent) <= 1
    tangent = 1 / jnp.where(flat, 1.0, cotangent)
    return jnp.where(flat, 1.0, tangent), jnp.where(flat, cotangent, 1.0)


def _landen(u: Array, mc: Array) -> tuple[Array, Array, Array, Array]:
    """Sn, |cn|, dn of u - 2 j K and the half turns j, for 0 < mc.

    Source: Bulirsch (1965), `sncndn`. His arithmetic-geometric means a, b enter as
    their quotients b / a, which stay in range.
    """
    is_double = u.dtype == jnp.float64
    steps = _LANDEN_STEPS if is_double else _LANDEN_STEPS_FLOAT32

    def down(carry: Arrays, _: None) -> tuple[Arrays, Array]:
        quotient, mean = carry
        # The means a and b become (a + b) / 2 and sqrt(a b).
        half = 0.5 * (1 + quotient)
        return (jnp.sqrt(quotient) / half, mean * half), quotient

    start = (jnp.sqrt(mc), jnp.ones_like(mc))
    (_, mean), quotients = jax.lax.scan(down, start, None, length=steps)
    # K = pi / (2 mean)
    angle = mean * u
    turns = jnp.round(angle / jnp.pi)
    first, second = _PI_PARTS if is_double else _PI_PARTS_FLOAT32
    angle = (angle - turns * first) - turns * second

    def up(carry: Arrays, quotient: Array) -> tuple[Arrays, None]:
        cotangent, dn = carry
        half = 0.5 * (1 + quotient)
        sine, cosine = _sides(cotangent)
        ss = sine * sine
        cc = half * (cosine * cosine)
        return (cotangent * half * dn, (quotient * ss + cc) / (ss + cc)), None

    # The cotangent of |angle| is infinite at 0; `_sides` makes (0, 1) of it.
    start = (jnp.cos(angle) / jnp.abs(jnp.sin(angle)), jnp.ones_like(angle))
    (cotangent, dn), _ = jax.lax.scan(up, start, quotients, reverse=True)
    sine, cosine = _sides(jnp.abs(cotangent))
    norm = jax.lax.rsqrt(sine * sine + cosine * cosine)
    # The sine of |angle| gets its sign back.
    return jnp.copysign(sine * norm, angle), cosine * norm, dn, turns


@jax.custom_jvp
def _reduced(u: Array, m: Array, mc: Array) -> tuple[Array, Array, Array, Array]:
    """`_landen`, with m = 1 and derivatives; NaN for mc < 0."""
    del m  # its derivatives need it
    # At m = 1 the functions are hyperbolic and K is infinite: there are no turns to
    # take off, and the means would vanish.
    end = mc == 0
    values = _landen(jnp.where(end, 0.0, u), jnp.where(end, 1.0, mc))
    sine, cosine = _hyperbolic(u)
    limits = (sine, cosine, cosine, jnp.zeros_like(u))
    return jax.tree.map(functools.partial(jnp.where, end), limits, values)


# jax asks for a tuple of four where the rule has a tuple of any length.
@_reduced.defjvp  # pyright: ignore[reportArgumentType]
def _reduced_rule(primals: Arrays, tangents: Arrays) -> tuple[Arrays, Arrays]:
    u, m, mc = primals
    d_u, _, d_mc = tangents
    values = s, c, dn, turns = _reduced(u, m, mc)
    turns = jax.lax.stop_gradient(turns)
    # d am / d mc = dn dF/dm, dF/dm = s^3 R_D(c^2, 1, dn^2) / 6 + 2 j K'(m)
    one = jnp.ones_like(s)
    # Without turns a harmless value replaces the infinite slopes of K.
    root = jnp.sqrt(jnp.where(turns == 0, 1.0, mc))
    # cn and dn underflow to 0 at m = 1 and large u, where G of two zeros is infinite.
    tiny = jnp.finfo(s.dtype).tiny
    low = jnp.maximum(dn, 4 * tiny)
    reduced = 0.5 * s * s * s * g_of(jnp.maximum(c, 4 * tiny), one, low)
    turned = turns * g_of(jnp.zeros_like(one), one, root) / root
    d_am = dn * d_u + (reduced + dn * turned) * d_mc
    of_dn = (0.5 * s * s - m * s * (c * reduced)) / low - m * s * c * turned
    return values, (
        c * d_am,
        -s * d_am,
        of_dn * d_mc - m * s * c * d_u,
        jnp.zeros_like(u),
    )


@jax.jit  # so that a call outside of jit does not compile its loops anew
def _ellipj(u: Array, m: Array, mc: Array) -> JacobiFunctions:
    """Any m; m > 1 by the reciprocal modulus, DLMF 22.17.2-22.17.4."""
    above = mc < 0
    k = jnp.sqrt(jnp.where(above, m, 1.0))
    square = k * k
    parameter = jnp.where(above, 1 / square, m)
    s, c, d, turns = _reduced(k * u, parameter, jnp.where(above, -mc / square, mc))
    turns = jax.lax.stop_gradient(turns)
    sign = 1 - 2 * jnp.mod(turns, 2.0)
    sn = sign * s / k
    cn = jnp.where(above, d, sign * c)
    dn = jnp.where(above, sign * c, d)
    # Above m = 1 cn and dn change places. The amplitude then oscillates within a
    # quarter turn, so no half turns are added to it.
    am = jnp.arctan2(jnp.where(above, sn, s), jnp.where(above, d, c))
    return JacobiFunctions(sn, cn, dn, am + jnp.where(above, 0.0, turns * jnp.pi))


def ellipj(
    u: ValuesLike, m: ValuesLike | None, *, mc: ValuesLike | None = None
) -> JacobiFunctions:
    r"""Jacobi's elliptic functions and the amplitude, as `scipy.special.ellipj`.

    The amplitude am is defined by $u = F(am, m)$, or for all m by am' = dn. Then sn =
    sin(am) and cn = cos(am).

    Args:
        u: Argument, any.
        m: Parameter, the square of the modulus, any: for m > 1 the amplitude oscillates
            between +-arcsin(1 / sqrt(m)) and dn changes sign.
        mc: 1 - m; where it is given m may be None.

    Returns:
        sn, cn, dn and am, with an error of 4e-15 (1 + |u|) in float64 and 2e-6 (1 +
        |u|) in float32. Where |m| > 1 they turn faster by sqrt(|m|): the error is in
        units of 1 + |u| sqrt(|m|) and, for dn, sqrt(|m|) times as large. NaN where u or
        m is NaN or infinite. Arguments broadcast.

    Gradients: in u closed forms; in m dn dF/dm, with F's derivative in R_D. They are
    right at m = 0, m = 1 and across it, in every mode and to any order. At m = 1 they
    grow as sinh(u), and the second one in m loses a factor of cosh(u)^2 to
    cancellation.
    Source: DLMF 22.16.1, 22.20(ii), 22.17.2-22.17.4; Bulirsch, Numer. Math. 7 (1965)
    78.

    >>> import jrigid.elliptic
    >>> sn, cn, dn, am = jrigid.elliptic.ellipj(1.0, 0.5)
    >>> print(f"{sn:.9f} {cn:.9f} {dn:.9f} {am:.9f}")
    0.803001825 0.595976568 0.823161002 0.932315080
    """
    return _ellipj(*with_parameters(m, mc, u))


def am(u: ValuesLike, m: ValuesLike | None, *, mc: ValuesLike | None = None) -> Values:
    r"""Jacobi's amplitude, the solution of am' = dn that vanishes at 0.

    Args:
        u: Argument, any.
        m: Parameter, the square of the modulus, any.
        mc: 1 - m; where it is given m may be None.

    Returns:
        Amplitude [rad], as by `ellipj`. For m < 1 it is continuous and grows by pi with
        2 K; at m = 1 it is the Gudermannian; for m > 1 it oscillates between +-arcsin(1
        / sqrt(m)).

    Gradients: as of `ellipj`.
    Source: DLMF 22.16.1.

    >>> import jrigid.elliptic
    >>> quarter = jrigid.elliptic.ellipk(0.5)
    >>> print(jrigid.elliptic.am(6 * quarter, 0.5).round(12))
    9.424777960769
    """
    return ellipj(u, m, mc=mc).am
