"""Legendre's elliptic integrals, as sums of positive terms in Carlson's.

Kernels take both m and mc = 1 - m, since each is exact where the other is rounded. A
derivative with respect to the parameter is taken along mc, whose tangent is minus that
of m.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid.elliptic._carlson import (
    Arrays,
    Values,
    ValuesLike,
    elementwise,
    g_of,
    rc_of,
    rf_g,
    rf_of,
    rf_rj_signed,
)


def with_parameters(
    m: ValuesLike | None, mc: ValuesLike | None, *others: ValuesLike
) -> tuple[Array, ...]:
    """The other arguments, m and mc, in one dtype and shape."""
    if m is None and mc is None:
        raise ValueError("Argument `m` must be given, or else `mc`, but neither is.")
    *arrays, parameter = elementwise(*others, m if mc is None else mc)
    if mc is None:
        return (*arrays, parameter, 1 - parameter)
    return (*arrays, 1 - parameter, parameter)


def reduce_amplitude(phi: Array) -> tuple[Array, Array, Array]:
    """Half turns j, and sine and non-negative cosine of phi - j pi."""
    turns = jax.lax.stop_gradient(jnp.round(phi / jnp.pi))
    # A shift by j pi changes nothing but the sign. The difference phi - j pi itself
    # would lose the digits that sin and cos keep.
    sign = 1 - 2 * jnp.mod(turns, 2.0)
    sine = sign * jnp.sin(phi)
    cosine = sign * jnp.cos(phi)
    beyond = cosine < 0  # the quotient was rounded to the wrong side of a half
    turns = turns + jnp.where(beyond, jnp.where(sine > 0, 1.0, -1.0), 0.0)
    return turns, jnp.where(beyond, -sine, sine), jnp.where(beyond, -cosine, cosine)


def _complete(integral: Callable[..., Array], *parameters: Array) -> Array:
    """An integral `(sine, cosine, *parameters)` up to a quarter turn."""
    zero = jnp.zeros_like(parameters[-1])
    return integral(zero + 1, zero, *parameters)


def _of_any_turns(
    integral: Callable[..., Array], phi: Array, *parameters: Array
) -> Array:
    """An integral `(sine, cosine, *parameters)` up to any amplitude.

    The last parameter is mc.
    """
    turns, sine, cosine = reduce_amplitude(phi)
    # Where there are no turns, the complete integral is evaluated at m = 0, far from
    # its infinite slopes.
    *others, mc = (jnp.where(turns == 0, 0.0, x) for x in parameters)
    whole = _complete(integral, *others, jnp.where(turns == 0, 1.0, mc))
    # The integrand has the period pi, over which the integral is twice the complete
    # one.
    return integral(sine, cosine, *parameters) + 2 * turns * whole


# Within a quarter turn


def _delta(sine: Array, cosine: Array, mc: Array) -> Array:
    """sqrt(1 - m sin^2 phi)."""
    # For m <= 1 this sum keeps its digits where m sin^2 phi is near 1.
    return jnp.sqrt(cosine * cosine + mc * sine * sine)


def _delta_of(phi: Array, mc: Array) -> Array:
    """sqrt(1 - m sin^2 phi) of an amplitude."""
    return _delta(*reduce_amplitude(phi)[1:], mc)


def _f(sine: Array, cosine: Array, mc: Array) -> Array:
    """F for |phi| <= pi/2, DLMF 19.25.5."""
    return sine * rf_of(cosine, _delta(sine, cosine, mc), jnp.ones_like(sine))


def _f_by_m(sine: Array, cosine: Array, mc: Array) -> Array:
    """Derivative of F in m."""
    delta = _delta(sine, cosine, mc)
    return sine * sine * sine / (2 * delta) * g_of(cosine, jnp.ones_like(sine), delta)


def _e(s: Array, c: Array, m: Array, mc: Array) -> Array:
    """E for |phi| <= pi/2 by DLMF 19.25.9 (m <= 0), 19.25.10 (m <= 1) or 19.25.11.

    All of their terms are positive.
    """
    d = _delta(s, c, mc)
    one = jnp.ones_like(s)
    low = m <= 0
    high = mc < 0
    last = jnp.where(low, one, jnp.where(high, c, d))
    rf, g = rf_g(jnp.where(high, d, c), jnp.where(low, d, one), last)
    cube = s * s * s
    middle = mc * s * rf + m * s * (c / last) + m * mc * cube * (g / last)
    above = s * d / last - mc * cube * (g / last)
    value = jnp.where(low, s * rf - m * cube * g, jnp.where(high, above, middle))
    # E is sin phi at m = 1. At a quarter turn the terms above are 0 times infinity.
    return jnp.where((c == 0) & (mc == 0), s, value)


def _e_by_mc(sine: Array, cosine: Array, mc: Array) -> Array:
    """Derivative of E in mc."""
    delta = _delta(sine, cosine, mc)
    return 0.5 * sine * sine * sine * g_of(cosine, delta, jnp.ones_like(sine))


def _pi(sine: Array, cosine: Array, n: Array, m: Array, mc: Array) -> Array:
    """Pi for |phi| <= pi/2; m > 1 by the reciprocal modulus, DLMF 19.7.4."""
    end = (cosine == 0) & (mc == 0)
    delta = _delta(sine, cosine, jnp.where(end, 1.0, mc))
    above = mc < 0
    k = jnp.sqrt(jnp.where(above, m, 1.0))
    s = k * sine
    c = jnp.where(above, delta, cosine)
    d = jnp.where(above, cosine, delta)
    n = n / (k * k)
    mc = jnp.where(above, -mc / (k * k), mc)
    value = _pi_over_sine(s, c, d, n, mc)
    # At m = 1 the complete integral diverges like log(mc) / (2 (n - 1)). The logarithm
    # gives its sign, and an infinite slope in mc.
    infinite = jnp.where(n > 1, 0.5, -0.5) * jnp.log(jnp.where(end, mc, 1.0))
    return jnp.where(end, infinite, s / k * value)


def _pi_over_sine(s: Array, c: Array, d: Array, n: Array, mc: Array) -> Array:
    """Pi / sin(phi) for m <= 1, from sine, cosine and delta.

    DLMF 19.25.14, whose terms cancel for n far below 0. There (t + 1) / (t + p) is
    split into 1 / (1 - n) and a part to which 19.21.12 is applied, with q - c^2 = s^2
    mc / (1 - n).
    """
    negative = n * s * s < -0.5
    share = jnp.where(negative, 1 / (1 - n), 1.0)
    p = c * c + (1 - n) * s * s
    step = s * s * mc * share
    # Complete, and mc is out of range or 0: a term with a limit has reached it, and any
    # other diverges at 0.
    limit = (c == 0) & (step < 64 * jnp.finfo(s.dtype).tiny)
    split = negative & ~limit
    q = jnp.where(split, c * c + step, 1.0)
    # In units in which d is 1, since R_J itself can be below the range.
    unit = jax.lax.stop_gradient(jnp.where(split, 1 / jnp.maximum(d, 1.0), 1.0))
    rf, rj = rf_rj_signed(
        c * unit, d * unit, unit, jnp.where(negative, (q * unit) * unit, p)
    )
    rf = rf * unit
    of_n = jnp.where(limit, jnp.where(negative, p, 1.0), p * q)
    rc = rc_of(jnp.where(limit, 1.0, d), jnp.sqrt(jnp.where(negative, of_n, 1.0)))
    split_off = jnp.where(limit, rc, c * rc + ((step / 3 * unit) * unit) * (rj * unit))
    return jnp.where(negative, share * (rf - n * split_off), rf + n * s * s / 3 * rj)


# Complete


@jax.custom_jvp
def _e_complete(m: Array, mc: Array) -> Array:
    return _complete(_e, m, mc)


@_e_complete.defjvp
def _e_complete_rule(primals: Arrays, tangents: Arrays) -> tuple[Array, Array]:
    return _e_complete(*primals), _complete(_e_by_mc, primals[1]) * tangents[1]


_k_compiled = jax.jit(functools.partial(_complete, _f))
_e_compiled = jax.jit(_e_complete)
_pi_compiled = jax.jit(functools.partial(_complete, _pi))


def ellipk(m: ValuesLike | None, *, mc: ValuesLike | None = None) -> Values:
    r"""Complete elliptic integral of the first kind, as `scipy.special.ellipk`.

    $K(m) = \int_0^{\pi/2} d\theta / \sqrt{1 - m \sin^2 \theta}$.

    Args:
        m: Parameter, the square of the modulus, at most 1.
        mc: 1 - m; where it is given m may be None.

    Returns:
        K to 6 ulps, also for mc = 1e-300; inf at m = 1, NaN for m > 1. Arguments
        broadcast.

    Gradients: R_D(0, 1, mc) / 6, positive, to any order, right at m = 0; inf at m = 1.
    Source: DLMF 19.2.8, 19.25.1.

    >>> import jrigid.elliptic
    >>> print(jrigid.elliptic.ellipk(0.5).round(12))
    1.854074677301
    >>> print(jrigid.elliptic.ellipk(None, mc=1e-300).round(3))
    346.774
    """
    return _k_compiled(with_parameters(m, mc)[1])


def ellipe(m: ValuesLike | None, *, mc: ValuesLike | None = None) -> Values:
    r"""Complete elliptic integral of the second kind, as `scipy.special.ellipe`.

    $E(m) = \int_0^{\pi/2} \sqrt{1 - m \sin^2 \theta} \, d\theta$.

    Args:
        m: Parameter, the square of the modulus, at most 1.
        mc: 1 - m; where it is given m may be None.

    Returns:
        E to 6 ulps; 1 at m = 1, NaN for m > 1. Arguments broadcast.

    Gradients: -R_D(0, mc, 1) / 6, negative, to any order, right at m = 0; -inf at m =
    1.
    Source: DLMF 19.2.8, 19.25.1.

    >>> import jrigid.elliptic
    >>> print(jrigid.elliptic.ellipe(0.5).round(12))
    1.350643881048
    """
    return _e_compiled(*with_parameters(m, mc))


def ellippi(
    n: ValuesLike, m: ValuesLike | None, *, mc: ValuesLike | None = None
) -> Values:
    r"""Complete elliptic integral of the third kind, as `mpmath.ellippi`.

    $\Pi(n, m) = \int_0^{\pi/2} d\theta / ((1 - n \sin^2 \theta) \sqrt{1 - m \sin^2
    \theta})$.

    Args:
        n: Characteristic. For n > 1 the value is Cauchy's principal value, the real
            part of mpmath's.
        m: Parameter, the square of the modulus, at most 1.
        mc: 1 - m; where it is given m may be None.

    Returns:
        The integral to 8 ulps for n < 1, and to 8 ulps of its terms K(m) and Pi(m / n,
        m) for n > 1; inf at n = 1 and at m = 1 (-inf there for n > 1), NaN for m > 1.
        Arguments broadcast.

    Gradients: those of R_F and R_J, to any order, right at m = 0 and n = 0; infinite at
    m = 1.
    Source: DLMF 19.2.8, 19.25.2, 19.6.6; for n < 0 19.21.12, which leaves only positive
    terms.

    >>> import jrigid.elliptic
    >>> print(jrigid.elliptic.ellippi(0.3, 0.5).round(12))
    2.250376821944
    """
    return _pi_compiled(*with_parameters(m, mc, n))


# Incomplete


@jax.custom_jvp
def _f_incomplete(phi: Array, mc: Array) -> Array:
    return _of_any_turns(_f, phi, mc)


@_f_incomplete.defjvp
def _f_incomplete_rule(primals: Arrays, tangents: Arrays) -> tuple[Array, Array]:
    phi, mc = primals
    d_phi, d_mc = tangents
    slope = _of_any_turns(_f_by_m, phi, mc)
    change = d_phi / _delta_of(phi, mc) - slope * d_mc
    return _f_incomplete(phi, mc), change


@jax.custom_jvp
def _e_incomplete(phi: Array, m: Array, mc: Array) -> Array:
    return _of_any_turns(_e, phi, m, mc)


@_e_incomplete.defjvp
def _e_incomplete_rule(primals: Arrays, tangents: Arrays) -> tuple[Array, Array]:
    phi, m, mc = primals
    d_phi, _, d_mc = tangents
    slope = _of_any_turns(_e_by_mc, phi, mc)
    change = _delta_of(phi, mc) * d_phi + slope * d_mc
    return _e_incomplete(phi, m, mc), change


@jax.custom_jvp
def _pi_incomplete(phi: Array, n: Array, m: Array, mc: Array) -> Array:
    return _of_any_turns(_pi, phi, n, m, mc)


@_pi_incomplete.defjvp
def _pi_incomplete_rule(primals: Arrays, tangents: Arrays) -> tuple[Array, Array]:
    phi, n, m, mc = primals
    d_phi, d_n, _, d_mc = tangents
    _, sine, cosine = reduce_amplitude(phi)
    pole = (cosine * cosine + (1 - n) * sine * sine) * _delta(sine, cosine, mc)
    # m changes by -d_mc, whichever of the two was given.
    _, by_parameters = jax.jvp(
        functools.partial(_of_any_turns, _pi, phi), (n, m, mc), (d_n, -d_mc, d_mc)
    )
    return _pi_incomplete(phi, n, m, mc), d_phi / pole + by_parameters


_f_of_phi = jax.jit(_f_incomplete)
_e_of_phi = jax.jit(_e_incomplete)
_pi_of_phi = jax.jit(_pi_incomplete)


def ellipkinc(
    phi: ValuesLike, m: ValuesLike | None, *, mc: ValuesLike | None = None
) -> Values:
    r"""Incomplete elliptic integral of the first kind, as `scipy.special.ellipkinc`.

    $F(\phi, m) = \int_0^\phi d\theta / \sqrt{1 - m \sin^2 \theta}$.

    Args:
        phi: Amplitude [rad], any.
        m: Parameter, the square of the modulus. For m > 1 the amplitude must satisfy
            |phi| <= pi/2 and m sin^2 phi <= 1.
        mc: 1 - m; where it is given m may be None.

    Returns:
        F to 8 ulps (8 ulps of the amplitude where F itself is steep); +-inf at m = 1
        beyond |phi| = pi/2, NaN outside the domain. Arguments broadcast.

    Gradients: closed forms in R_D, to any order, right at m = 0 and m = 1; infinite
    where m sin^2 phi = 1.
    Source: DLMF 19.2.4, 19.25.5; derivative 19.4.4 in the form of 19.18.1.

    >>> import jrigid.elliptic
    >>> print(jrigid.elliptic.ellipkinc(1.0, 0.5).round(12))
    1.083216772845
    """
    phi, _, mc = with_parameters(m, mc, phi)
    return _f_of_phi(phi, mc)


def ellipeinc(
    phi: ValuesLike, m: ValuesLike | None, *, mc: ValuesLike | None = None
) -> Values:
    r"""Incomplete elliptic integral of the second kind, as `scipy.special.ellipeinc`.

    $E(\phi, m) = \int_0^\phi \sqrt{1 - m \sin^2 \theta} \, d\theta$.

    Args:
        phi: Amplitude [rad], any.
        m: Parameter, the square of the modulus. For m > 1 the amplitude must satisfy
            |phi| <= pi/2 and m sin^2 phi <= 1.
        mc: 1 - m; where it is given m may be None.

    Returns:
        E to 8 ulps, NaN outside the domain. Arguments broadcast.

    Gradients: closed forms in R_D, to any order, right at m = 0 and m = 1; at m = 1
    -inf with respect to m beyond |phi| = pi/2. There forward mode gives NaN also with
    respect to phi where both are varied, since it multiplies that infinity by zero.
    Source: DLMF 19.2.5, 19.25.9-19.25.11.

    >>> import jrigid.elliptic
    >>> print(jrigid.elliptic.ellipeinc(1.0, 0.5).round(9))
    0.927329884
    """
    return _e_of_phi(*with_parameters(m, mc, phi))


def ellippiinc(
    n: ValuesLike,
    phi: ValuesLike,
    m: ValuesLike | None,
    *,
    mc: ValuesLike | None = None,
) -> Values:
    r"""Incomplete elliptic integral of the third kind, as `mpmath.ellippi(n, phi, m)`.

    $\Pi(n, \phi, m) = \int_0^\phi d\theta / ((1 - n \sin^2 \theta) \sqrt{1 - m \sin^2
    \theta})$.

    Args:
        n: Characteristic. Where n sin^2 phi > 1 the value is Cauchy's principal value.
        phi: Amplitude [rad], any.
        m: Parameter, the square of the modulus. For m > 1 the amplitude must satisfy
            |phi| <= pi/2 and m sin^2 phi <= 1.
        mc: 1 - m; where it is given m may be None.

    Returns:
        The integral to 10 ulps (of its terms for a principal value); infinite where
        n sin^2 phi = 1 and at m = 1 beyond |phi| = pi/2, NaN outside the domain.
        Arguments broadcast.

    Gradients: in phi the integrand; in n and m those of R_F and R_J, to any order,
    right at m = 0, m = 1 and n = 0.
    Source: DLMF 19.2.7, 19.25.14, 19.21.12.

    >>> import jrigid.elliptic
    >>> print(jrigid.elliptic.ellippiinc(0.3, 1.0, 0.5).round(12))
    1.192325436935
    """
    n, phi, m, mc = with_parameters(m, mc, n, phi)
    return _pi_of_phi(phi, n, m, mc)
