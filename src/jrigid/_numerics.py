r"""Safe primitives; each states its value and its gradient at the edge.

Functions of an angle or a norm that are even in it are written as functions of its
square, which makes them analytic where `sqrt`, `norm` and `sin(x) / x` have none or NaN
derivatives.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._types import AnyArray

Components = tuple[Array, ...]

# Vectors and quaternions, the usual cases, have no more components.
_FEW = 4
# Derivatives of the closed forms divide by powers of z, and lose digits near 0. Below
# this z the series are used.
_SERIES_BELOW = 0.5
_SERIES_TERMS = 9  # 0.5^9 / 19! < 1e-19


def safe_norm(vector: Float[Array, "*many n"]) -> Float[Array, "*many"]:
    """Euclidean norm without overflow; value and gradient are 0 at the zero vector."""
    # Squares of the quotients stay in range. A power of two adds no rounding.
    scale = power_of_two(_over_components(jnp.maximum, jnp.abs(vector)))
    unit = vector * inverse_of_power(scale)[..., None]
    return scale * root_of_positive(sum_of_squares(unit))


def unit_again(vector: Float[Array, " n"]) -> Float[Array, " n"]:
    """A vector whose norm is nearly 1, brought to 1."""
    return vector * jax.lax.rsqrt(sum_of_squares(vector))


def sum_of_squares(vector: Float[Array, "*many n"]) -> Float[Array, "*many"]:
    """Square of the Euclidean norm."""
    return _over_components(jnp.add, vector * vector)


def _over_components(
    combine: Any, vector: Float[Array, "*many n"]
) -> Float[Array, "*many"]:
    """A reduction over the last axis, by a ufunc.

    Of few components it is written out: XLA then computes it together with what is
    around it, where a reduction is a program of its own.
    """
    if vector.shape[-1] > _FEW:
        return combine.reduce(vector, axis=-1)
    return functools.reduce(combine, [vector[..., i] for i in range(vector.shape[-1])])


def or_one(size: AnyArray) -> AnyArray:
    """A size to divide by: 1 where it is not positive."""
    return size.__array_namespace__().where(size > 0, size, 1.0)


def without_gradient(value: AnyArray) -> AnyArray:
    """`jax.lax.stop_gradient`, which would make an array of JAX of one of numpy."""
    return (
        value
        if isinstance(value, np.ndarray | np.generic)
        else jax.lax.stop_gradient(value)
    )


def rms(vectors: AnyArray, there: AnyArray) -> AnyArray:
    """Root mean square length of the vectors that count; 1 if that is no size."""
    xp = vectors.__array_namespace__()
    shown = xp.where(there[..., None], vectors, 0.0)
    # The scale keeps squares in range. It cancels, and with it its derivative.
    largest = without_gradient(or_one(xp.max(xp.abs(shown))))
    count = xp.maximum(xp.sum(there), 1).astype(vectors.dtype)
    square = xp.sum((shown / largest) ** 2) / count
    good = (square > 0) & (square < xp.inf)
    return xp.where(good, largest * xp.sqrt(xp.where(good, square, 1.0)), 1.0)


def root_of_positive(square: Float[Array, "..."]) -> Float[Array, "..."]:
    """The square root of a positive number, else 0; the slope at 0 is 0."""
    positive = square > 0
    # The inner `where` keeps the infinite slope of the root at 0 out of the derivative.
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def safe_arctan2(y: Float[Array, "..."], x: Float[Array, "..."]) -> Float[Array, "..."]:
    """`arctan2` without overflow; at the origin the value is 0 and the gradient 0."""
    # The angle does not depend on a common factor, so that the scale has no derivative.
    largest = jax.lax.stop_gradient(jnp.maximum(jnp.abs(x), jnp.abs(y)))
    origin = largest == 0
    scale = jnp.where(origin, 1.0, largest)
    # At x = 1, y = 0 the derivatives are finite, and the outer `where` drops them.
    angle = jnp.arctan2(y / scale, jnp.where(origin, 1.0, x / scale))
    return jnp.where(origin, 0.0, angle)


def polynomial(coefficients: list[float], z: Array) -> Array:
    """A polynomial of these coefficients, that of the lowest power first."""
    total = jnp.full_like(z, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = coefficient + z * total
    return total


_COS = [(-1) ** k / math.factorial(2 * k) for k in range(_SERIES_TERMS + 1)]
_SINC = [(-1) ** k / math.factorial(2 * k + 1) for k in range(_SERIES_TERMS + 1)]
# For an eighth of a right angle, twelve terms reach the rounding of float64.
_ARCTANC = [(-1) ** k / (2 * k + 1) for k in range(12)]


def cos_sqrt(z: Float[Array, "..."]) -> Float[Array, "..."]:
    """cos(sqrt(z)) for z >= 0, analytic at z = 0."""
    # Each branch gets an argument at which its derivatives are finite. NaN in the
    # branch that is not taken would become NaN in the derivative.
    small = z < _SERIES_BELOW
    root = jnp.sqrt(jnp.where(small, 1.0, z))
    return jnp.where(small, polynomial(_COS, jnp.where(small, z, 0.0)), jnp.cos(root))


def sinc_sqrt(z: Float[Array, "..."]) -> Float[Array, "..."]:
    """sin(sqrt(z)) / sqrt(z) for z >= 0, analytic at z = 0."""
    small = z < _SERIES_BELOW
    root = jnp.sqrt(jnp.where(small, 1.0, z))
    return jnp.where(
        small, polynomial(_SINC, jnp.where(small, z, 0.0)), jnp.sin(root) / root
    )


def _within_range(root: Array) -> Array:
    """An exponent whose exponential is finite, so that none is multiplied with zero."""
    return jnp.minimum(root, 0.95 * math.log(float(jnp.finfo(root.dtype).max)))


def cosh_sqrt(z: Float[Array, "..."]) -> Float[Array, "..."]:
    """cosh(sqrt(z)) for any real z, analytic at z = 0; never infinite.

    For negative z it is cos(sqrt(-z)).
    """
    large = z > _SERIES_BELOW
    root = _within_range(jnp.sqrt(jnp.where(large, z, 1.0)))
    return jnp.where(large, jnp.cosh(root), cos_sqrt(jnp.where(large, 0.0, -z)))


def sinhc_sqrt(z: Float[Array, "..."]) -> Float[Array, "..."]:
    """sinh(sqrt(z)) / sqrt(z) for any real z, analytic at z = 0; never infinite."""
    large = z > _SERIES_BELOW
    root = _within_range(jnp.sqrt(jnp.where(large, z, 1.0)))
    return jnp.where(large, jnp.sinh(root) / root, sinc_sqrt(jnp.where(large, 0.0, -z)))


def power_of_two(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """The power of two next above |x|, to scale by without rounding; 1 at 0.

    In the bits of the exponent: `frexp` and `ldexp` take longer than what is scaled, to
    compile too. It and its inverse are normal numbers also where |x| is not, is
    infinite or NaN.
    """
    info = jnp.finfo(x.dtype)
    least = 1 << info.nmant  # as bits: the smallest exponent, no mantissa
    # With a larger exponent the inverse would no longer be a normal number.
    greatest = ((1 << info.nexp) - 4) * least
    # -least has ones in the bits of sign and exponent alone. To add `least` to the bits
    # doubles the power.
    bits = (
        jax.lax.bitcast_convert_type(jnp.abs(x), jnp.dtype(f"int{info.bits}")) & -least
    )
    power = jax.lax.bitcast_convert_type(
        jnp.clip(bits, least, greatest) + least, x.dtype
    )
    # A scale is piecewise constant, and cancels where it is used.
    return jax.lax.stop_gradient(jnp.where(x == 0, 1.0, power))


def inverse_of_power(power: Float[Array, "..."]) -> Float[Array, "..."]:
    """The inverse of a power of two, exactly, if it is a normal number.

    In the bits of the exponent: XLA's CPU compiler makes a kernel of its own for a
    division whose result several kernels need.
    """
    info = jnp.finfo(power.dtype)
    integer = jnp.dtype(f"int{info.bits}")
    one = int(np.ones((), power.dtype).view(integer))
    bits = 2 * one - jax.lax.bitcast_convert_type(power, integer)
    return jax.lax.stop_gradient(jax.lax.bitcast_convert_type(bits, power.dtype))


def gauss_legendre(count: int, dtype: Any) -> tuple[Array, Array]:
    """Nodes and weights of the integral from 0 to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return jnp.asarray((nodes + 1) / 2, dtype), jnp.asarray(weights / 2, dtype)


def materialize(*arrays: Array) -> tuple[Array, ...]:
    """The arrays themselves, computed once.

    XLA's CPU compiler fuses by computing what is used twice twice: a long formula, and
    more so its derivative, then runs hundreds of times slower than its operations. It
    does not look into a loop, and a loop of two trips is not removed.
    """

    def trip(i: Array, values: tuple[Array, ...]) -> tuple[Array, ...]:
        # The condition never holds. It keeps the compiler from finding that the loop
        # does nothing.
        return tuple(jnp.where(i == 2, -x, x) for x in values)

    return jax.lax.fori_loop(0, 2, trip, arrays)


# Without it float32 products run in TF32 (10 bits) on recent GPUs.
_EXACT = jax.lax.Precision.HIGHEST


_WORTH_A_PLAN = 1000  # numbers of an array, where numpy's plan for a product pays


def as_tensor(inertia: AnyArray) -> AnyArray:
    """The tensor of principal moments, or the tensor itself."""
    return inertia.__array_namespace__().diag(inertia) if inertia.ndim == 1 else inertia


def product(subscripts: str, *operands: AnyArray) -> AnyArray:
    """`einsum` in full precision on every device; numpy's if all arrays are numpy's."""
    if not all(isinstance(x, np.ndarray) for x in operands):
        return jnp.einsum(subscripts, *operands, precision=_EXACT)
    if _is_matrix_product(subscripts):
        # This is a call of BLAS, which `einsum` without a plan does not use.
        return np.tensordot(*operands, axes=1)
    large = max(x.size for x in operands) > _WORTH_A_PLAN
    return np.einsum(subscripts, *operands, optimize=large)


@functools.cache
def _is_matrix_product(subscripts: str) -> bool:
    """Whether the last index of one array is summed with the first one of another."""
    inputs, _, output = subscripts.partition("->")
    left, *rest = inputs.split(",")
    if len(rest) != 1 or "." in subscripts or not output:
        return False
    if left[-1:] != rest[0][:1]:
        return False
    # An index that repeats is no axis of its own.
    return output == left[:-1] + rest[0][1:] and len(set(inputs)) == len(inputs) - 1


def with_columns(function: Callable[..., Components]) -> Callable[..., Components]:
    """Give a function of scalars a derivative rule by its whole Jacobian.

    Reverse mode then transposes a small matrix, not the loops in `function`. The rule
    is plain code, which every mode differentiates again.
    """
    wrapped = jax.custom_jvp(function)

    @wrapped.defjvp
    def rule(
        arguments: Components, changes: Components
    ) -> tuple[Components, Components]:
        columns = jnp.eye(len(arguments), dtype=arguments[0].dtype)
        # The values are the same for all columns, so that `out_axes=None` keeps one of
        # them.
        values, jacobian = jax.vmap(
            lambda column: jax.jvp(function, arguments, tuple(column)),
            out_axes=(None, 0),
        )(columns)
        weights = jnp.stack(changes)
        return values, tuple(jnp.sum(row * weights) for row in jacobian)

    return wrapped


@jax.custom_jvp
def arctanc_sqrt(z: Float[Array, "..."]) -> Float[Array, "..."]:
    """arctan(sqrt(z)) / sqrt(z) for z >= 0, analytic at z = 0.

    The angle is halved three times, then a series is summed.
    """
    factor = jnp.ones_like(z)
    for _ in range(3):
        # tan(a / 2) = tan(a) / (1 + sqrt(1 + tan(a)^2)), where z is the square of the
        # tangent.
        below = 1 + jnp.sqrt(1 + z)
        factor = factor * (2 / below)
        z = z / (below * below)
    return factor * polynomial(_ARCTANC, z)


@arctanc_sqrt.defjvp
def _arctanc_sqrt_jvp(
    arguments: Components, changes: Components
) -> tuple[Array, Array]:
    """Compute the slope once, for any number of tangents.

    It is plain code, which can be differentiated in every mode.
    """
    function = arctanc_sqrt.__wrapped__
    value, slope = jax.jvp(function, arguments, (jnp.ones_like(arguments[0]),))
    return value, slope * changes[0]
