"""The algebra of unit quaternions: products, rotation of vectors, exp and log."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, PRNGKeyArray

from jrigid._checks import array_of_shape, shaped, where_defined
from jrigid._core.compile import one_program
from jrigid._numerics import (
    arctanc_sqrt,
    cos_sqrt,
    power_of_two,
    safe_norm,
    sinc_sqrt,
    sum_of_squares,
)
from jrigid._types import (
    Quaternion,
    QuaternionLike,
    Scalar,
    ScalarLike,
    Vector,
    VectorLike,
)


def _scale(vector: Array) -> Array:
    """Power of two that brings the sum of the magnitudes of a vector to [1, 2)."""
    # Component by component: a reduction would not fuse with what follows.
    size = functools.reduce(jnp.add, [jnp.abs(x) for x in vector])
    return 2 / power_of_two(size)


def rescaled(vector: Array) -> Array:
    """Scale a vector by a power of two, to a sum of magnitudes in [1, 2).

    This does not round. Squares of the result stay in the range of numbers, in values
    and in derivatives. Zero stays zero.
    """
    return vector * _scale(vector)


def _dtype(dtype: DTypeLike | None) -> jnp.dtype:
    dtype = jnp.dtype(jnp.result_type(float) if dtype is None else dtype)
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(
            "Argument `dtype` must be of floating point numbers, but it is "
            f"{dtype.name}."
        )
    return dtype


def identity(dtype: DTypeLike | None = None) -> Quaternion:
    """The unit quaternion (1, 0, 0, 0): body and space axes coincide.

    Args:
        dtype: Floating point type; JAX's default by default (float32 unless x64 is on).
            For use with arrays of another precision pass theirs.

    Returns:
        The quaternion of no rotation.

    >>> import jrigid as jr
    >>> print(jr.rotation.identity())
    [1. 0. 0. 0.]
    """
    return jnp.array([1, 0, 0, 0], _dtype(dtype))


def random(key: PRNGKeyArray, dtype: DTypeLike | None = None) -> Quaternion:
    """A random attitude, uniform on the sphere of unit quaternions.

    The distribution is the same in every turned frame.

    Args:
        key: Of `jax.random`; for many attitudes `jax.vmap` over
            `jax.random.split(key, count)`.
        dtype: Floating point type; JAX's default by default.

    Returns:
        Unit quaternion, of either sign.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> attitudes = jax.vmap(jr.rotation.random)(jax.random.split(jax.random.key(0), 5))
    >>> print(attitudes.shape, jnp.linalg.norm(attitudes, axis=1))
    (5, 4) [1. 1. 1. 1. 1.]
    """
    # Independent normal numbers of equal variance prefer no direction.
    return normalize(jax.random.normal(key, (4,), _dtype(dtype)))


@one_program
def normalize(quaternion: QuaternionLike) -> Quaternion:
    """Quaternion scaled to norm 1; the zero quaternion stays zero, with gradient zero.

    Args:
        quaternion: Any quaternion, scalar first.

    Returns:
        The unit quaternion.

    Gradients: projected on the tangent of the unit sphere, over the norm, whatever that
    is; zero at the zero quaternion.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.rotation.normalize(jnp.array([0.0, 3.0, 0.0, 4.0])))
    [0.  0.6 0.  0.8]
    """
    return _direction(array_of_shape("quaternion", quaternion, 4))


def _direction(vector: Array) -> Array:
    """Vector over its norm; at zero the value is zero and the gradient zero."""
    vector = rescaled(vector)
    square = sum_of_squares(vector)
    is_zero = square == 0
    # The inner `where` keeps NaN of sqrt(0) out of the derivative.
    norm = jnp.sqrt(jnp.where(is_zero, 1.0, square))
    return jnp.where(is_zero, jnp.zeros_like(vector), vector / norm)


@one_program
def multiply(p: QuaternionLike, q: QuaternionLike) -> Quaternion:
    """Hamilton product p q: `R(p q) = R(p) R(q)`, q is applied first.

    Args:
        p: Left factor, scalar first.
        q: Right factor, scalar first.

    Returns:
        The product.

    Gradients: bilinear, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> i, j = jnp.array([0.0, 1.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0, 0.0])
    >>> print(jr.rotation.multiply(i, j))
    [0. 0. 0. 1.]
    """
    (a, b, c, d), (w, x, y, z) = shaped(p=(p, 4), q=(q, 4))
    return jnp.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
    )


@one_program
def conjugate(quaternion: QuaternionLike) -> Quaternion:
    """Conjugate; for a unit quaternion the inverse rotation.

    Args:
        quaternion: Scalar first.

    Returns:
        (w, -x, -y, -z).

    Gradients: linear, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.rotation.conjugate(jnp.array([1.0, 2.0, 3.0, 4.0])))
    [ 1. -2. -3. -4.]
    """
    w, x, y, z = array_of_shape("quaternion", quaternion, 4)
    return jnp.stack([w, -x, -y, -z])


@one_program
def inverse(quaternion: QuaternionLike) -> Quaternion:
    """The quaternion that, multiplied with the one given, makes the identity.

    Args:
        quaternion: Scalar first, of any norm; NaN where it is zero or not finite.

    Returns:
        The conjugate over the square of the norm: the inverse rotation.

    Gradients: finite for any non-zero quaternion, of order 1 / norm squared.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.rotation.inverse(jnp.array([0.0, 0.0, 2.0, 0.0])))
    [ 0.  -0.  -0.5 -0. ]
    """
    q = array_of_shape("quaternion", quaternion, 4)

    def formula(q: Array) -> Array:
        unit = rescaled(q)
        # conj(q) / |q|^2 in terms of unit = scale q, whose square stays in range.
        return conjugate(unit) / jnp.sum(unit * unit) * _scale(q)

    return where_defined(_spans(q), formula, q)


def _spans(quaternion: Array) -> Array:
    """Whether a quaternion stands for an attitude: finite and not zero."""
    return jnp.any(quaternion != 0) & jnp.all(jnp.isfinite(quaternion))


@one_program
def rotate(attitude: QuaternionLike, vector: VectorLike) -> Vector:
    """Space components of a vector given in body components.

    Args:
        attitude: Unit quaternion, body to space.
        vector: Body components [any unit].

    Returns:
        Space components, same unit. Exact for any non-zero quaternion: its norm drops
        out.

    Gradients: finite for any non-zero quaternion, of order 1 / norm in the attitude.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> quarter = jr.rotation.exp(jnp.array([0.0, 0.0, jnp.pi / 2]))
    >>> print(jr.rotation.rotate(quarter, jnp.array([1.0, 0.0, 0.0])).round(6))
    [0. 1. 0.]
    """
    quaternion, vector = shaped(attitude=(attitude, 4), vector=(vector, 3))
    w, x, y, z = _rescaled_components(quaternion)
    return _rotated(w, x, y, z, vector)


def _rescaled_components(quaternion: Array) -> list[Array]:
    """The components of `rescaled`, as scalars.

    XLA compiles and runs one more kernel for each intermediate array.
    """
    scale = _scale(quaternion)
    return [component * scale for component in quaternion]


def _rotated(w: Array, x: Array, y: Array, z: Array, vector: Array) -> Vector:
    """A vector rotated by a quaternion of any norm, given by its components."""
    a, b, c = vector
    # v + 2 (w u x v + u x (u x v)) / |q|^2, with u = (x, y, z) and (p, q, r) = u x v
    scale = 2 / (w * w + x * x + y * y + z * z)
    p = y * c - z * b
    q = z * a - x * c
    r = x * b - y * a
    return jnp.stack(
        [
            a + scale * (w * p + y * r - z * q),
            b + scale * (w * q + z * p - x * r),
            c + scale * (w * r + x * q - y * p),
        ]
    )


@one_program
def rotate_inverse(attitude: QuaternionLike, vector: VectorLike) -> Vector:
    """Body components of a vector given in space components.

    Args:
        attitude: Unit quaternion, body to space.
        vector: Space components [any unit].

    Returns:
        Body components, same unit.

    Gradients: finite for any non-zero quaternion.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> quarter = jr.rotation.exp(jnp.array([0.0, 0.0, jnp.pi / 2]))
    >>> print(jr.rotation.rotate_inverse(quarter, jnp.array([0.0, 1.0, 0.0])).round(6))
    [1. 0. 0.]
    """
    quaternion, vector = shaped(attitude=(attitude, 4), vector=(vector, 3))
    w, x, y, z = _rescaled_components(quaternion)
    return _rotated(w, -x, -y, -z, vector)


@one_program
def exp(rotation_vector: VectorLike) -> Quaternion:
    """Quaternion of a rotation vector: axis times angle.

    Args:
        rotation_vector: Axis times angle [rad].

    Returns:
        Unit quaternion (cos(a/2), axis sin(a/2)).

    Gradients: analytic everywhere, also at the zero vector, to any order.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.rotation.exp(jnp.array([jnp.pi, 0.0, 0.0])).round(6))
    [0. 1. 0. 0.]
    """
    v = array_of_shape("rotation_vector", rotation_vector, 3)
    # The square of half the angle: cosine and sinc are even, hence analytic in it.
    z = 0.25 * jnp.sum(v * v)
    return jnp.concatenate([cos_sqrt(z)[None], 0.5 * sinc_sqrt(z) * v])


@one_program
def log(attitude: QuaternionLike) -> Vector:
    """Rotation vector, of length at most pi, of a quaternion.

    Args:
        attitude: Unit quaternion; its norm drops out, and q and -q give the same, but
            for the sign of the axis of an exact half turn.

    Returns:
        Axis times angle [rad]; zero for the zero quaternion.

    Gradients: finite everywhere, analytic at the identity, zero at the zero quaternion.
    Across a half turn the value itself jumps from +pi to -pi along the axis.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> v = jnp.array([0.1, -0.2, 0.3])
    >>> bool(jnp.allclose(jr.rotation.log(-jr.rotation.exp(v)), v))
    True
    """
    q = rescaled(array_of_shape("attitude", attitude, 4))
    q = jnp.where(q[0] < 0, -q, q)
    w = q[0]
    v = q[1:]
    square = jnp.sum(v * v)
    # Half the angle over |v| is arctan(|v| / w) / |v|. Up to a quarter turn it is a
    # series in |v|^2 / w^2; beyond, w / |v| is the smaller number.
    is_near = square <= w * w
    is_zero = jnp.all(q == 0)
    w_near = jnp.where(is_near & ~is_zero, w, 1.0)
    ratio = jnp.where(is_near, square, 0.0) / (w_near * w_near)
    half_near = arctanc_sqrt(ratio) / w_near
    norm = jnp.sqrt(jnp.where(is_near, 1.0, square))
    half_far = (jnp.pi / 2 - jnp.arctan(jnp.where(is_near, 0.0, w) / norm)) / norm
    half = jnp.where(is_near, half_near, half_far)
    return 2 * jnp.where(is_zero, 0.0, half) * v


@one_program
def angle_between(p: QuaternionLike, q: QuaternionLike) -> Scalar:
    """Angle of the rotation that takes attitude p to attitude q.

    Args:
        p: Unit quaternion; its norm drops out.
        q: Unit quaternion; its norm drops out.

    Returns:
        Angle in [0, pi] [rad], accurate also for tiny angles; 0 if p or q is zero.

    Gradients: at p = q the angle has a cone; the gradient there is 0, as at a zero
    quaternion.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> q = jr.rotation.exp(jnp.array([0.0, 1e-3, 0.0]))
    >>> angle = jr.rotation.angle_between(jr.rotation.identity(), q)
    >>> print(round(float(angle), 9))
    0.001
    """
    p, q = shaped(p=(p, 4), q=(q, 4))
    # The arc cosine of the scalar part would lose the digits of a small angle.
    return safe_norm(log(multiply(rescaled(conjugate(p)), rescaled(q))))


@one_program
def slerp(p: QuaternionLike, q: QuaternionLike, s: ScalarLike) -> Quaternion:
    """Spherical linear interpolation from p to q along the shortest arc.

    The rate of rotation is constant.

    Args:
        p: Attitude at s = 0: unit quaternion; its norm drops out.
        q: Attitude at s = 1: unit quaternion; its norm drops out, and -q gives the
            same.
        s: Fraction of the way; outside of [0, 1] the rotation goes on. NaN where p or q
            is zero or not finite.

    Returns:
        Unit quaternion p exp(s log(p^-1 q)), of the sign of p at s = 0.

    Gradients: analytic also at p = q, to any order. Attitudes half a turn apart have
    two shortest arcs, and the value jumps from one to the other there. If conj(p) q has
    no scalar part, the arc about its vector part is taken, with the derivatives of that
    side.
    Source: K. Shoemake, Animating rotation with quaternion curves, SIGGRAPH (1985) 245.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> half = jr.rotation.exp(jnp.array([0.0, 0.0, 1.0]))
    >>> quarter = jr.rotation.slerp(jr.rotation.identity(), half, 0.25)
    >>> print(jr.rotation.log(quarter).round(6))
    [0.   0.   0.25]
    """
    p, q, s = shaped(p=(p, 4), q=(q, 4), s=(s,))

    def formula(p: Array, q: Array, s: Array) -> Array:
        p = normalize(p)
        # Of the two, only the norm of p enters the result.
        turn = multiply(conjugate(p), rescaled(q))
        return multiply(p, exp(s * log(turn)))

    return where_defined(_spans(p) & _spans(q), formula, p, q, s)


@one_program
def from_axis_angle(axis: VectorLike, angle: ScalarLike) -> Quaternion:
    """Attitude turned by an angle about an axis.

    Args:
        axis: Direction of the axis, of any non-zero length.
        angle: Angle [rad], right-handed about the axis.

    Returns:
        Unit quaternion; the identity, as (1, 0, 0, 0) or (-1, 0, 0, 0), with gradient
        zero in `axis`, if the axis is zero.

    Gradients: finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.rotation.from_axis_angle(jnp.array([0.0, 0.0, 2.0]), jnp.pi).round(6))
    [0. 0. 0. 1.]
    """
    v, a = shaped(axis=(axis, 3), angle=(angle,))
    vector_part = jnp.sin(0.5 * a) * _direction(v)
    # For an axis of zero this makes the identity of (cos(a / 2), 0, 0, 0).
    return normalize(jnp.concatenate([jnp.cos(0.5 * a)[None], vector_part]))
