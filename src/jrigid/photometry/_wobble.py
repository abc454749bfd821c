r"""The free motion of a tumbler, as Fourier series of one turn of the polhode.

A fit of light curves evaluates thousands of motions at hundreds of epochs, and seeks
their two frequencies rather than their angular velocity. This is the motion in these
terms. With a unit angular momentum M in body axes, a_i = 1 / I_i, the axes named so
that M circles the third and the second has the middle moment, and theta its largest
tilt,

    M1 = e sin(theta) sqrt(rho) k' sd(u),   rho = (a2 - a3) / (a1 - a3),
    M2 = sin(theta) cd(u),                  k'^2 = 1 / (1 + (1 - rho) tan(theta)^2),
    M3 = cos(theta) nd(u),                  e = -1 for a1 > a3, else 1,

where u grows by 4 K in a turn. Fourier coefficients of these functions are known in
closed form. The precession obeys

    phi' = (M1^2 a1 + M2^2 a2) / (M1^2 + M2^2),

an even function whose mean and Fourier coefficients follow from equidistant values.

Source: M. Abramowitz and I. Stegun, Handbook of Mathematical Functions, 16.23; the rest
is derived here and compared with `free_rotation` by the tests.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._numerics import product
from jrigid._types import Matrix, Scalar, Vector

# Terms of each series, and values from which those of the precession are found. The
# error of an angle is below 1e-10 for tilts up to 60 degrees and 1e-5 at 80 degrees.
_TERMS = 8
_VALUES = 32
_MEANS = 6  # arithmetic-geometric means, from a ratio of 1e-10
_ODD = 2 * np.arange(_TERMS) + 1
# The rate of the precession repeats after half a turn of the polhode.
_PHASES = np.pi * np.arange(_VALUES) / _VALUES
_MULTIPLES = 2 * np.arange(1, _VALUES // 2)


class Wobble(NamedTuple):
    """One turn of the polhode, in units where the angular momentum is 1.

    Attributes:
        first: Coefficients of M1, of sines of odd multiples of the phase.
        second: Coefficients of M2, of cosines of odd multiples.
        third: Mean of M3.
        third_swing: Coefficients of M3, of cosines of even multiples.
        precession: Coefficients of the precession angle, of sines of even multiples.
        rotation_rate: Rate of the phase, 2 pi / P_psi.
        precession_rate: Mean rate of the precession, 2 pi / P_phi.
    """

    first: Float[Array, " odd"]
    second: Float[Array, " odd"]
    third: Scalar
    third_swing: Float[Array, " even"]
    precession: Float[Array, " multiples"]
    rotation_rate: Scalar
    precession_rate: Scalar


# Long: one solution from the moments to its series, where each line needs those above.
def wobble(inverse_moments: Vector, log_tangent: Scalar) -> Wobble:
    """The series of a motion.

    Args:
        inverse_moments: 1 / I of the axes by their new names: other, middle, circled.
        log_tangent: Logarithm of the tangent of the largest tilt.
    """
    a1, a2, a3 = inverse_moments
    dtype = log_tangent.dtype
    rho = (a2 - a3) / (a1 - a3)
    tangent = jnp.exp(log_tangent)
    cosine = 1 / jnp.sqrt(1 + tangent**2)
    sine = tangent * cosine
    # The moduli k' and k. As a product, k keeps its digits where it is small.
    complement = 1 / jnp.sqrt(1 + (1 - rho) * tangent**2)
    modulus = tangent * jnp.sqrt(1 - rho) * complement
    quarter = _quarter_period(complement)
    # q = exp(-pi K' / K), where K' is K of the other modulus.
    nome = jnp.exp(-jnp.pi * _quarter_period(modulus) / quarter)

    # The series of sd, cd and nd in the nome: Abramowitz and Stegun 16.23.
    n = jnp.asarray(np.arange(_TERMS), dtype)
    sign = jnp.asarray((-1.0) ** np.arange(_TERMS), dtype)
    root = sign * nome ** (n + 0.5) * 2 * jnp.pi / (modulus * quarter)
    square = nome ** (2 * n + 1)
    first = -jnp.sign(a1 - a3) * sine * jnp.sqrt(rho) * root / (1 + square)
    second = sine * root / (1 - square)
    third = cosine * jnp.pi / (2 * complement * quarter)
    power = nome ** (n + 1)
    third_swing = -4 * third * sign * power / (1 + power**2)

    # du/dt, from Euler's equation M1' = (a3 - a2) M2 M3 at the largest tilt, u = 0.
    rate = cosine * jnp.sqrt((a2 - a3) * (a1 - a3)) / complement
    rotation_rate = jnp.pi * rate / (2 * quarter)
    square1 = product("vt,t->v", _constant(np.sin, _PHASES, _ODD, dtype), first) ** 2
    square2 = product("vt,t->v", _constant(np.cos, _PHASES, _ODD, dtype), second) ** 2
    precession = (square1 * a1 + square2 * a2) / (square1 + square2)
    swing = product(
        "vt,t->v", _constant(np.cos, _MULTIPLES, _PHASES, dtype), precession
    )
    multiples = jnp.asarray(_MULTIPLES, dtype)
    return Wobble(
        first=first,
        second=second,
        third=third,
        third_swing=third_swing,
        # Coefficients of the rate, integrated over time term by term.
        precession=2 * swing / (_VALUES * multiples * rotation_rate),
        rotation_rate=rotation_rate,
        precession_rate=jnp.mean(precession),
    )


def _quarter_period(complement: Scalar) -> Scalar:
    """The complete elliptic integral K, by the arithmetic-geometric mean."""
    a = jnp.ones_like(complement)
    b = complement
    for _ in range(_MEANS):
        a, b = (a + b) / 2, jnp.sqrt(a * b)
    return jnp.pi / (2 * a)


def _constant(
    function: np.ufunc, rows: np.ndarray, columns: np.ndarray, dtype: np.dtype
) -> Array:
    """A table of a function of products."""
    return jnp.asarray(function(np.outer(rows, columns)), dtype)


def body_axes(motion: Wobble, phase: Scalar, precession_angle: Scalar) -> Matrix:
    """Directions of the axes by their new names, in axes with z along the momentum.

    Args:
        motion: The series.
        phase: Phase of the rotation [rad], 0 where the tilt is largest.
        precession_angle: Mean angle of precession [rad].

    Returns:
        A rotation matrix; row i is the direction of axis i.
    """
    cos_odd, sin_odd, cos_even, sin_even = _multiples(phase)
    m1 = jnp.sum(sin_odd * motion.first)
    m2 = jnp.sum(cos_odd * motion.second)
    m3 = motion.third + jnp.sum(cos_even[:_TERMS] * motion.third_swing)
    angle = precession_angle + jnp.sum(sin_even * motion.precession)
    # Euler's angles: the momentum is (sin psi sin theta, cos psi sin theta, cos theta).
    sine = jnp.sqrt(m1 * m1 + m2 * m2)
    # The tilt is never 0, since its tangent is an exponential.
    sin_psi = m1 / sine
    cos_psi = m2 / sine
    sin_phi = jnp.sin(angle)
    cos_phi = jnp.cos(angle)
    node = jnp.stack([cos_phi, sin_phi, jnp.zeros_like(angle)])
    across = jnp.stack([-m3 * sin_phi, m3 * cos_phi, sine])
    third = jnp.stack([sine * sin_phi, -sine * cos_phi, m3])
    first = cos_psi * node + sin_psi * across
    second = cos_psi * across - sin_psi * node
    return jnp.stack([first, second, third])


def _multiples(phase: Scalar) -> tuple[Array, Array, Array, Array]:
    """Cosines and sines of odd and of even multiples of a phase.

    Products of complex numbers take a fifth of the time of cosines and sines.
    """
    turn = jax.lax.complex(jnp.cos(2 * phase), jnp.sin(2 * phase))
    even = [turn]
    for _ in _MULTIPLES[1:]:
        even.append(even[-1] * turn)
    half = jax.lax.complex(jnp.cos(phase), jnp.sin(phase))
    odd = [half * x for x in [jnp.ones_like(turn), *even[: _TERMS - 1]]]
    odd, even = jnp.stack(odd), jnp.stack(even)
    return odd.real, odd.imag, even.real, even.imag
