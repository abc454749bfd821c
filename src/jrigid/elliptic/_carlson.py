"""Carlson's symmetric elliptic integrals, and the kernels of all other functions.

The kernels take the square roots a, b, c, q of the arguments x, y, z, p. In the roots
the duplication step is a' = sqrt((a + b)(a + c)) / 2. It has no subtractions, is smooth
where an argument is zero, and is never out of range. Every tangent of that step is
positive, so its derivative along an axis is as stable as the step itself, also where
arguments coincide.
"""

import functools
from collections.abc import Callable
from typing import TypeAlias, cast

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, ArrayLike, Float

from jrigid._checks import float_arrays
from jrigid._numerics import arctanc_sqrt
from jrigid._types import Real

Values: TypeAlias = Float[Array, "..."]
ValuesLike: TypeAlias = Real[ArrayLike, "..."]
Arrays: TypeAlias = tuple[Array, ...]
# A kernel of roots, with two values.
Kernel: TypeAlias = Callable[..., tuple[Array, Array]]


def elementwise(*values: ValuesLike | None) -> list[Array] | Arrays:
    """Arrays of one floating point dtype and one shape."""
    # A list or, in newer versions of JAX, a tuple.
    return jnp.broadcast_arrays(*float_arrays(*values))


def _steps(x: Array) -> int:
    """Steps that bring a quotient of roots of 1e-300 (float32: 1e-38) to 1e-3 of 1."""
    # A step halves the logarithm of a quotient that is far from 1, so that 10 steps
    # (float32: 7) bring it to order one. After that a step divides the deviation from 1
    # by 4.
    return 15 if x.dtype == jnp.float64 else 11


# Kernels of roots of order one


def _next_roots(a: Array, b: Array, c: Array) -> tuple[Array, Array, Array]:
    """One duplication, x' = (x + lambda) / 4 (DLMF 19.26.18), in the roots."""
    ab = jnp.sqrt(a + b)
    ac = jnp.sqrt(a + c)
    bc = jnp.sqrt(b + c)
    return 0.5 * ab * ac, 0.5 * ab * bc, 0.5 * ac * bc


def _rf_series(a: Array, b: Array, c: Array) -> Array:
    """R_F of nearly equal arguments, DLMF 19.36.1."""
    x, y, z = a * a, b * b, c * c
    mean = (x + y + z) / 3
    dx = (mean - x) / mean
    dy = (mean - y) / mean
    dz = -dx - dy
    e2 = dx * dy - dz * dz
    e3 = dx * dy * dz
    series = e2 * (-1 / 10 + e2 * (1 / 24 - 5 / 208 * e2) + e3 * (-3 / 44 + e2 / 16))
    return (1 + (series + e3 * (1 / 14 + 3 / 104 * e3))) / jnp.sqrt(mean)


def _rj_series(x: Array, y: Array, z: Array, p: Array) -> Array:
    """R_J of nearly equal arguments, DLMF 19.36.2."""
    mean = (x + y + z + 2 * p) / 5
    dx, dy, dz = (mean - x) / mean, (mean - y) / mean, (mean - z) / mean
    dp = -(dx + dy + dz) / 2
    pp = dp * dp
    xyz = dx * dy * dz
    e2 = dx * dy + dx * dz + dy * dz - 3 * pp
    e3 = xyz + dp * (2 * e2 + 4 * pp)
    e4 = (2 * xyz + dp * (e2 + 3 * pp)) * dp
    e5 = xyz * pp
    series = e2 * (-3 / 14 + e2 * (9 / 88 - e2 / 16) + e3 * (-9 / 52 + 45 / 272 * e2))
    series = series + e3 * (1 / 6 + 3 / 40 * e3) + e4 * (-3 / 22 + 3 / 20 * e2)
    series = series + 3 / 26 * e5 - 9 / 68 * (e3 * e4 + e2 * e5)
    return (1 + series) / (mean * jnp.sqrt(mean))


def _rf_g_kernel(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    """R_F and c R_D / 3 of the squares, of which at most one may be zero."""

    def step(_: Array, carry: Arrays) -> Arrays:
        a, b, c, weight, total = carry
        # R_D(x, y, z) = 2 R_D(x + lambda, y + lambda, z + lambda) + 3 / (sqrt(z) (z +
        # lambda)), and z + lambda is (c + a)(c + b).
        total = total + weight / (c * (c + a) * (c + b))
        return *_next_roots(a, b, c), 0.25 * weight, total

    # The first step by hand: its c cancels, and c may be zero.
    total = 1 / ((c + a) * (c + b))
    start = (*_next_roots(a, b, c), 0.25 * c, total)
    a, b, c, weight, total = jax.lax.fori_loop(1, _steps(a), step, start)
    # R_D is R_J with p = z, so that one series serves both.
    remainder = weight * _rj_series(a * a, b * b, c * c, c * c) / 3
    return _rf_series(a, b, c), total + remainder


def _rc_of_one(root: Array) -> Array:
    """R_C(1, root^2), differentiable as it stands; DLMF 19.2.17, 19.2.18."""
    e = (root - 1) * (root + 1)
    # R_C diverges like a logarithm at root = 0, where the halvings and the series in e
    # fail. So the half near there has a formula of its own.
    low = e < -0.5
    down = jnp.sqrt(jnp.where(low, -e, 0.75))
    root = jnp.where(low, root, 0.5)
    logarithm = jnp.log1p((1 - root + down) / root) / down
    return jnp.where(low, logarithm, arctanc_sqrt(jnp.where(low, 0.0, e)))


def _rf_rj_kernel(a: Array, b: Array, c: Array, q: Array) -> tuple[Array, Array]:
    """R_F and R_J of the squares; q > 0 and not much larger than the others."""

    def step(_: Array, carry: Arrays) -> Arrays:
        a, b, c, q, weight, total = carry
        sides = q * q + a * b + a * c + b * c
        # DLMF 19.26.22 with alpha, beta there as sums of positive terms
        alpha = q * q * (a + b + c) + a * b * c
        total = total + 3 * weight / alpha * _rc_of_one(q * sides / alpha)
        return *_next_roots(a, b, c), 0.5 * jnp.sqrt(sides), 0.25 * weight, total

    start = (a, b, c, q, jnp.ones_like(a), jnp.zeros_like(a))
    a, b, c, q, weight, total = jax.lax.fori_loop(0, _steps(a) + 1, step, start)
    return _rf_series(a, b, c), total + weight * _rj_series(a * a, b * b, c * c, q * q)


# Kernels of any roots, with their derivatives


def _varied(tangents: tuple[Array | SymbolicZero, ...]) -> list[int]:
    """Indices of the arguments along which a derivative is taken."""
    return [i for i, t in enumerate(tangents) if not isinstance(t, SymbolicZero)]


def _two_zero(a: Array, b: Array, c: Array) -> Array:
    """Whether two of the three are zero."""
    return ((a == 0) & (b == 0)) | ((a == 0) & (c == 0)) | ((b == 0) & (c == 0))


def _scale(*roots: Array) -> Array:
    """The largest root, as a unit; NaN where one is NaN, 1 where all are 0."""
    largest = functools.reduce(jnp.maximum, roots)
    scale = jnp.where(largest == 0, jnp.ones_like(largest), largest)
    return jax.lax.stop_gradient(scale)


def _of_any_roots(kernel: Kernel, degree: int) -> Kernel:
    """A kernel of roots of any size.

    Its second value is of the given degree in the reciprocals of the roots.
    """

    def scaled(a: Array, b: Array, c: Array, *q: Array) -> tuple[Array, Array]:
        scale = _scale(a, b, c, *q)
        is_nan = jnp.isnan(scale)
        pole = _two_zero(a, b, c)
        # The second value has more poles than the first.
        pole_of_second = functools.reduce(jnp.logical_or, [x == 0 for x in q], pole)
        size = jnp.where(jnp.isinf(scale), 1.0, scale)
        # Where a value is infinite or zero the loop runs on ones.
        regular = ~pole & (scale < jnp.inf) | is_nan
        regular_second = ~pole_of_second & (scale < jnp.inf) | is_nan
        roots = [jnp.where(regular, x / size, 1.0) for x in (a, b, c)]
        values = kernel(*roots, *(jnp.where(regular_second, x / size, 1.0) for x in q))
        return (
            _unscaled(values[0], size, 1, regular, pole),
            _unscaled(values[1], size, degree, regular_second, pole_of_second),
        )

    return scaled


def _unscaled(
    value: Array, size: Array, degree: int, regular: Array, pole: Array
) -> Array:
    """A value in the units of its arguments; at a pole infinite, else 0 at infinity."""
    for _ in range(degree):
        value = value * (1 / size)
    return jnp.where(regular, value, jnp.where(pole, jnp.inf, 0.0))


def _along_axes(kernel: Kernel) -> Kernel:
    """A kernel with its partial derivatives, in one loop without the tangents.

    An argument without a tangent costs nothing, and its infinite derivative does no
    harm.
    """
    function = jax.custom_jvp(kernel)

    def rule(
        roots: Arrays, tangents: tuple[Array | SymbolicZero, ...]
    ) -> tuple[Arrays, Arrays]:
        varied = _varied(tangents)
        axes = [
            jnp.stack([jnp.full_like(x, i == k) for i in varied])
            for k, x in enumerate(roots)
        ]
        along = jax.vmap(
            functools.partial(jax.jvp, kernel, list(roots)), out_axes=(None, 0)
        )
        values, partials = along(axes)
        # Both values fall as a root grows, so at a pole their slope is -inf. The loop,
        # which ran on ones there, cannot give it.
        slopes = jax.tree.map(
            lambda x, d: jnp.where(x == jnp.inf, -jnp.inf, d), values, partials
        )
        given = [cast("Array", tangents[i]) for i in varied]
        totals = (sum(d[n] * x for n, x in enumerate(given)) for d in slopes)
        return values, cast("Arrays", tuple(totals))

    function.defjvp(rule, symbolic_zeros=True)  # pyright: ignore[reportArgumentType]
    return function


# R_F(a^2, b^2, c^2) and G = (c / 3) R_D(a^2, b^2, c^2), the derivative of -R_F by c. G
# is 1 / (a b) at c = 0; where two roots are zero both are infinite.
rf_g = _along_axes(_of_any_roots(_rf_g_kernel, 2))
# R_F and R_J of the squares, for q not many times the largest of the others.
rf_rj = _along_axes(_of_any_roots(_rf_rj_kernel, 3))


def g_of(a: Array, b: Array, c: Array) -> Array:
    """G = (c / 3) R_D(a^2, b^2, c^2); see `rf_g`."""
    return rf_g(a, b, c)[1]


@jax.custom_jvp
def rf_of(a: Array, b: Array, c: Array) -> Array:
    """R_F(a^2, b^2, c^2)."""
    return rf_g(a, b, c)[0]


@jax.custom_jvp
def rc_of(a: Array, b: Array) -> Array:
    """R_C(a^2, b^2), DLMF 19.2.17 and 19.2.18."""
    gap = jnp.abs(b - a)
    # Where a = b any other value of `root` will do.
    safe = (gap > 0) & (b > 0) & jnp.isfinite(a + b)
    # The root of |b^2 - a^2|, as a product since the squares may leave the range.
    root = jnp.where(safe, jnp.sqrt(gap) * jnp.sqrt(b + a), 1.0)
    circular = jnp.arctan2(root, a) / root
    hyperbolic = jnp.log1p((a - b + root) / jnp.where(b > 0, b, 1.0)) / root
    value = jnp.where(b > a, circular, hyperbolic)
    finite_edge = jnp.where(jnp.isinf(a + b), 0.0, 1 / jnp.where(b > 0, b, 1))
    edge = jnp.where(b == 0, jnp.inf, finite_edge)
    return jnp.where(safe | jnp.isnan(a + b), value, edge)


def _by_slopes(function: jax.custom_jvp[Array], *slopes: Callable[..., Array]) -> None:
    """Give a function its partial derivatives, computed only for varied arguments."""

    def rule(
        primals: Arrays, tangents: tuple[Array | SymbolicZero, ...]
    ) -> tuple[Array, Array]:
        given = {i: cast("Array", tangents[i]) for i in _varied(tangents)}
        total = sum(slopes[i](*primals) * x for i, x in given.items())
        return function(*primals), -cast("Array", total)

    function.defjvp(rule, symbolic_zeros=True)


_by_slopes(rf_of, lambda a, b, c: g_of(b, c, a), lambda a, b, c: g_of(a, c, b), g_of)
_by_slopes(rc_of, lambda a, b: g_of(b, b, a), lambda a, b: 2 * g_of(a, b, b))


# Principal values


def rc_signed(a: Array, y: Array) -> Array:
    """R_C(a^2, y), for y < 0 its Cauchy principal value, DLMF 19.2.20."""
    negative = y < 0
    shifted = jnp.sqrt(jnp.where(negative, a * a - y, 1.0))
    values = rc_of(
        jnp.where(negative, shifted, a), jnp.sqrt(jnp.where(negative, -y, y))
    )
    return jnp.where(negative, a / shifted, 1.0) * values


def _ordered(a: Array, b: Array) -> tuple[Array, Array]:
    """The smaller and the larger."""
    return jnp.where(a > b, b, a), jnp.where(a > b, a, b)


def rf_rj_signed(a: Array, b: Array, c: Array, p: Array) -> tuple[Array, Array]:
    """R_F(a^2, b^2, c^2) and R_J(a^2, b^2, c^2, p).

    For p < 0 the latter is its Cauchy principal value. A negative or a very large p is
    replaced by the q of DLMF 19.21.12, (p - x)(q - x) = (y - x)(z - x), where x is the
    middle, or the largest, of the three arguments.
    """
    # The root of p counts with a small factor: a huge p then does not overflow, and the
    # other roots do not vanish beside it.
    size = _scale(a, b, c, 1e-10 * jnp.sqrt(jnp.abs(p)))
    size = jnp.where(jnp.isinf(size), 1.0, size)
    # Products, since XLA makes x / size / size / size into x / size^3, which overflows.
    per = 1 / size
    a, b, c, p = a * per, b * per, c * per, p * per * per
    low, high = _ordered(a, b)
    middle, high = _ordered(high, c)
    low, middle = _ordered(low, middle)
    large = p > 16 * high * high
    other = (p < 0) | large
    base = jnp.where(large, high, middle)
    second = jnp.where(large, middle, high)
    base = jnp.where(base > 0, base, 1.0)
    distance = jnp.where(other, p - base * base, 1.0)
    gap = (low - base) * (low + base) * (second - base) * (second + base) / distance
    q = jnp.where(other, base * base + gap, p)
    rf, rj = rf_rj(a, b, c, jnp.sqrt(q))
    xi = jnp.where(other, low * second / base, 1.0)
    eta = jnp.where(other, (p / base) * (q / base), 1.0)
    # R_J can be out of range where its factor is nothing.
    of_rj = gap * jnp.where(jnp.isfinite(rj), rj, 0.0)
    moved = (3 * (rf - rc_signed(xi, eta)) - of_rj) / distance
    moved = jnp.where(_two_zero(a, b, c), jnp.copysign(jnp.inf, p), moved)
    return rf * per, jnp.where(other, moved, rj) * per * per * per


# Public functions

# Compiled, so that a call outside of jit does not compile its loop anew.


@jax.jit
def _rf(x: Array, y: Array, z: Array) -> Array:
    return rf_of(jnp.sqrt(x), jnp.sqrt(y), jnp.sqrt(z))


@jax.jit
def _rc(x: Array, y: Array) -> Array:
    return rc_signed(jnp.sqrt(x), y)


@jax.jit
def _rd(x: Array, y: Array, z: Array) -> Array:
    root = jnp.sqrt(z)
    return 3 * g_of(jnp.sqrt(x), jnp.sqrt(y), root) / root


@jax.jit
def _rj(x: Array, y: Array, z: Array, p: Array) -> Array:
    return rf_rj_signed(jnp.sqrt(x), jnp.sqrt(y), jnp.sqrt(z), p)[1]


def rf(x: ValuesLike, y: ValuesLike, z: ValuesLike) -> Values:
    r"""Carlson's symmetric elliptic integral of the first kind.

    $R_F(x, y, z) = \frac12 \int_0^\infty dt / \sqrt{(t + x)(t + y)(t + z)}$.

    Args:
        x: Non-negative.
        y: Non-negative.
        z: Non-negative; at most one of the three zero.

    Returns:
        R_F to 6 ulps, over the whole range of the dtype; inf where two arguments are
        zero, 0 where one is infinite, NaN where one is negative. Arguments broadcast.

    Gradients: R_D of the same arguments, to any order; -inf with respect to an argument
    at 0.
    Source: DLMF 19.16.1; the duplication theorem 19.26.18, the series 19.36.1.

    >>> import jrigid.elliptic
    >>> print(jrigid.elliptic.rf(1.0, 2.0, 0.0).round(12))
    1.311028777146
    """
    return _rf(*elementwise(x, y, z))


def rc(x: ValuesLike, y: ValuesLike) -> Values:
    r"""Carlson's degenerate elliptic integral, $R_C(x, y) = R_F(x, y, y)$.

    It is an elementary function.

    Args:
        x: Non-negative.
        y: Not zero; where it is negative the value is Cauchy's principal value.

    Returns:
        R_C to 6 ulps; inf where y = 0, NaN where x < 0. Arguments broadcast.

    Gradients: R_D, to any order, right also at x = y; infinite with respect to x at x =
    0.
    Source: DLMF 19.2.17-19.2.20.

    >>> import jrigid.elliptic
    >>> print(jrigid.elliptic.rc(0.0, 0.25).round(12))
    3.14159265359
    """
    return _rc(*elementwise(x, y))


def rd(x: ValuesLike, y: ValuesLike, z: ValuesLike) -> Values:
    r"""Carlson's symmetric elliptic integral of the second kind.

    $R_D(x, y, z) = R_J(x, y, z, z)$ and
    $R_D(x, y, z) = \frac32 \int_0^\infty dt / ((t + z) \sqrt{(t + x)(t + y)(t + z)})$.

    Args:
        x: Non-negative.
        y: Non-negative; not zero together with x.
        z: Positive.

    Returns:
        R_D to 8 ulps; inf where z = 0 or x = y = 0, NaN where an argument is negative.
        Arguments broadcast.

    Gradients: of the duplication along each argument, which has no cancellation: right
    also where arguments coincide; -inf with respect to an argument at 0.
    Source: DLMF 19.16.5; Carlson, Numerical Algorithms 10 (1995) 13.

    >>> import jrigid.elliptic
    >>> print(jrigid.elliptic.rd(0.0, 2.0, 1.0).round(12))
    1.797210352103
    """
    return _rd(*elementwise(x, y, z))


def rj(x: ValuesLike, y: ValuesLike, z: ValuesLike, p: ValuesLike) -> Values:
    r"""Carlson's symmetric elliptic integral of the third kind.

    $R_J(x, y, z, p) = \frac32 \int_0^\infty dt / ((t + p) \sqrt{(t + x)(t + y)(t +
    z)})$.

    Args:
        x: Non-negative.
        y: Non-negative.
        z: Non-negative; at most one of the three zero.
        p: Not zero; where it is negative the value is Cauchy's principal value.

    Returns:
        R_J to 8 ulps for p > 0, and as well as the terms of DLMF 19.21.12 allow for p <
        0 (it changes sign there); inf where p = 0 or two of x, y, z are zero, NaN where
        one of them is negative. Arguments broadcast.

    Gradients: of the duplication along each argument, which has no cancellation: right
    also where arguments coincide; -inf with respect to x, y or z at 0.
    Source: DLMF 19.16.2, 19.26.22, 19.36.2; Carlson, Numerical Algorithms 10 (1995) 13.

    >>> import jrigid.elliptic
    >>> print(jrigid.elliptic.rj(2.0, 3.0, 4.0, 5.0).round(12))
    0.142975796672
    """
    return _rj(*elementwise(x, y, z, p))
