"""Other forms of an attitude: matrices, Euler angles, roll-pitch-yaw, scipy."""

from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jrigid._checks import array_of_shape, where_defined
from jrigid._core.compile import one_program
from jrigid._numerics import product, safe_arctan2, safe_norm
from jrigid._types import (
    Matrix,
    MatrixLike,
    Quaternion,
    QuaternionLike,
    Vector,
    VectorLike,
)
from jrigid.rotation._quaternion import multiply, normalize, rescaled, rotate

# A matrix that is typed with four digits passes as a rotation.
_ORTHOGONAL = 1e-3


@one_program
def hat(vector: VectorLike) -> Matrix:
    """Skew matrix with `hat(a) b = a x b`.

    Args:
        vector: Components a [any unit].

    Returns:
        Skew-symmetric matrix, same unit.

    Gradients: linear, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> a, b = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.5, -1.0, 2.0])
    >>> bool(jnp.allclose(jr.rotation.hat(a) @ b, jnp.cross(a, b)))
    True
    """
    x, y, z = array_of_shape("vector", vector, 3)
    zero = jnp.zeros_like(x)
    return jnp.stack(
        [jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])]
    )


@one_program
def vee(matrix: MatrixLike) -> Vector:
    """Vector of the skew-symmetric part of a matrix: `vee(hat(a)) = a`.

    Args:
        matrix: Any matrix; its symmetric part is dropped.

    Returns:
        The vector, same unit.

    Gradients: linear, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.rotation.vee(jr.rotation.hat(jnp.array([1.0, 2.0, 3.0]))))
    [1. 2. 3.]
    """
    m = array_of_shape("matrix", matrix, 3, 3)
    return 0.5 * jnp.stack([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])


@one_program
def to_matrix(attitude: QuaternionLike) -> Matrix:
    """Rotation matrix R with `v_space = R v_body`.

    Args:
        attitude: Unit quaternion, body to space.

    Returns:
        Rotation matrix; its columns are the body axes in space.

    Gradients: finite for any non-zero quaternion.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.rotation.to_matrix(jnp.array([1.0, 0.0, 0.0, 0.0])))
    [[1. 0. 0.]
     [0. 1. 0.]
     [0. 0. 1.]]
    """
    q = array_of_shape("attitude", attitude, 4)
    return jax.vmap(rotate, in_axes=(None, 1), out_axes=1)(q, jnp.eye(3, dtype=q.dtype))


@one_program
def from_matrix(matrix: MatrixLike) -> Quaternion:
    """Unit quaternion, with w >= 0, of a rotation matrix.

    Args:
        matrix: Rotation matrix R, body to space.

    Returns:
        Unit quaternion. Where w = 0 (half turns) the sign makes the largest component
        positive. NaN where the matrix is no rotation: where an element of R^T R - 1 is
        larger than 1e-3, or where the determinant is negative (a reflection).

    Gradients: those of a smooth extension off the rotation group. They are exact along
    the group, everywhere.
    Source: S. W. Shepperd, Quaternion from rotation matrix, J. Guidance and Control 1
    (1978) 223.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.rotation.from_matrix(jnp.diag(jnp.array([1.0, -1.0, -1.0]))))
    [0. 1. 0. 0.]
    """
    m = array_of_shape("matrix", matrix, 3, 3)
    return where_defined(_is_rotation(jax.lax.stop_gradient(m)), _from_rotation, m)


def _is_rotation(matrix: Array) -> Bool[Array, ""]:
    """Whether a matrix is orthogonal to `_ORTHOGONAL` and right-handed."""
    excess = product("ki,kj->ij", matrix, matrix) - jnp.eye(3, dtype=matrix.dtype)
    # A reflection is orthogonal too. Its determinant is -1.
    first, second, third = matrix
    determinant = jnp.sum(jnp.cross(first, second) * third)
    return jnp.all(jnp.abs(excess) <= _ORTHOGONAL) & (determinant > 0)


def _from_rotation(m: Array) -> Quaternion:
    """Shepperd's formula: the row of 4 q q^T with the largest diagonal element."""
    a, b, c = jnp.diagonal(m)
    # Elements of 4 q q^T off the diagonal, named by the components of q.
    wx = m[2, 1] - m[1, 2]
    wy = m[0, 2] - m[2, 0]
    wz = m[1, 0] - m[0, 1]
    xy = m[1, 0] + m[0, 1]
    xz = m[2, 0] + m[0, 2]
    yz = m[2, 1] + m[1, 2]
    # Each row is 4 q_k q. The row with the largest q_k loses the fewest digits.
    rows = jnp.array(
        [
            [1 + a + b + c, wx, wy, wz],
            [wx, 1 + a - b - c, xy, xz],
            [wy, xy, 1 - a + b - c, yz],
            [wz, xz, yz, 1 - a - b + c],
        ]
    )
    row = rows[jnp.argmax(jnp.diagonal(rows))]
    return normalize(jnp.where(row[0] < 0, -row, row))


def to_scipy(attitude: QuaternionLike) -> Quaternion:
    """Scalar-last order (x, y, z, w), as `scipy.spatial.transform.Rotation` takes.

    Args:
        attitude: Quaternion, scalar first.

    Returns:
        The same quaternion, scalar last.

    Gradients: linear, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.rotation.to_scipy(jnp.array([1.0, 2.0, 3.0, 4.0])))
    [2. 3. 4. 1.]
    """
    return jnp.roll(array_of_shape("attitude", attitude, 4), -1)


# scipy is not imported: who passes a rotation of its has done so.
@runtime_checkable
class _ScipyRotation(Protocol):
    def as_quat(self) -> np.ndarray: ...


def from_scipy(rotation: QuaternionLike | _ScipyRotation) -> Quaternion:
    """Attitude of a rotation of scipy, or of a scalar-last quaternion.

    Args:
        rotation: A single `scipy.spatial.transform.Rotation`, or a quaternion (x, y, z,
            w).

    Returns:
        The same quaternion, scalar first.

    Raises:
        ValueError: The argument is neither.

    Gradients: linear in a quaternion, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> from scipy.spatial.transform import Rotation
    >>> print(jr.rotation.from_scipy(Rotation.from_rotvec([0.0, 0.0, jnp.pi])).round(6))
    [0. 0. 0. 1.]
    >>> print(jr.rotation.from_scipy(jnp.array([2.0, 3.0, 4.0, 1.0])))
    [1. 2. 3. 4.]
    """
    value = rotation.as_quat() if isinstance(rotation, _ScipyRotation) else rotation
    try:
        return jnp.roll(array_of_shape("rotation", value, 4), 1)
    except (TypeError, ValueError) as error:
        shape = getattr(value, "shape", None)
        kind = type(rotation).__name__ if shape is None else f"of shape {shape}"
        raise ValueError(
            "Argument `rotation` must be a single scipy.spatial.transform.Rotation "
            f"or a quaternion (x, y, z, w) of shape (4,), but it is {kind}."
        ) from error


@one_program
def from_euler(angles: VectorLike) -> Quaternion:
    """Attitude of z-x-z Euler angles: `R = Rz(phi) Rx(theta) Rz(psi)`.

    Args:
        angles: (phi, theta, psi) [rad]: precession, nutation, spin.

    Returns:
        Unit quaternion, body to space.

    Gradients: analytic everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.rotation.from_euler(jnp.array([0.0, jnp.pi, 0.0])).round(6))
    [0. 1. 0. 0.]
    """
    phi, theta, psi = 0.5 * array_of_shape("angles", angles, 3)
    c = jnp.cos(theta)
    s = jnp.sin(theta)
    plus = phi + psi
    minus = phi - psi
    return jnp.stack(
        [c * jnp.cos(plus), s * jnp.cos(minus), s * jnp.sin(minus), c * jnp.sin(plus)]
    )


@one_program
def to_euler(attitude: QuaternionLike) -> Vector:
    """z-x-z Euler angles of an attitude.

    At theta = 0 only phi + psi is defined, at theta = pi only phi - psi. There psi is 0
    and phi carries the whole rotation about the vertical.

    Args:
        attitude: Unit quaternion, body to space; its norm drops out.

    Returns:
        (phi, theta, psi) [rad], theta in [0, pi], phi and psi in [-pi, pi].

    Gradients: exact for 0 < theta < pi. At the two poles theta has a cone (gradient 0)
    and phi and psi the derivatives along the choice psi = 0: finite always.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> angles = jnp.array([0.3, 0.8, -1.2])
    >>> print(jr.rotation.to_euler(jr.rotation.from_euler(angles)).round(6))
    [ 0.3  0.8 -1.2]
    """
    w, x, y, z = rescaled(array_of_shape("attitude", attitude, 4))
    # q = (c cos(plus), s cos(minus), s sin(minus), c sin(plus)), as in `from_euler`.
    # A plain norm would have a NaN derivative at a pole, where one of the two is 0.
    c = safe_norm(jnp.stack([w, z]))
    s = safe_norm(jnp.stack([x, y]))
    plus = safe_arctan2(z, w)
    minus = safe_arctan2(y, x)
    # At a pole one of the two is not defined; psi = plus - minus = 0 replaces it.
    minus = jnp.where((x == 0) & (y == 0), plus, minus)
    plus = jnp.where((w == 0) & (z == 0), minus, plus)
    theta = 2 * safe_arctan2(s, c)
    return jnp.stack([_wrap(plus + minus), theta, _wrap(plus - minus)])


def _wrap(angle: Array) -> Array:
    """The same angle in [-pi, pi]."""
    # `round` is piecewise constant, so the derivative is that of the angle.
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


@one_program
def from_roll_pitch_yaw(angles: VectorLike) -> Quaternion:
    """Attitude of roll, pitch and yaw: `R = Rz(yaw) Ry(pitch) Rx(roll)`, body to space.

    This is the aerospace sequence z-y'-x''. From the space axes the body is turned by
    yaw about z, then by pitch about its new y axis, then by roll about its newest x
    axis, each right-handed. scipy writes it as
    `Rotation.from_euler("ZYX", (yaw, pitch, roll))`.

    Args:
        angles: (roll, pitch, yaw) [rad].

    Returns:
        Unit quaternion, body to space.

    Gradients: analytic everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> nose_up = jr.rotation.from_roll_pitch_yaw(jnp.array([0.0, -jnp.pi / 2, 0.0]))
    >>> print(jr.rotation.rotate(nose_up, jnp.array([1.0, 0.0, 0.0])).round(6))
    [0. 0. 1.]
    """
    half = 0.5 * array_of_shape("angles", angles, 3)
    # The quaternions of the three rotations are (c, 0, 0, r), (b, 0, q, 0) and (a, p,
    # 0, 0), and this is their product in that order.
    (a, b, c), (p, q, r) = jnp.cos(half), jnp.sin(half)
    return jnp.stack(
        [
            a * b * c + p * q * r,
            p * b * c - a * q * r,
            a * q * c + p * b * r,
            a * b * r - p * q * c,
        ]
    )


@one_program
def to_roll_pitch_yaw(attitude: QuaternionLike) -> Vector:
    """Roll, pitch and yaw of an attitude, as `from_roll_pitch_yaw` takes them.

    At pitch = +-pi/2, to rounding, only roll -+ yaw is defined. There roll is 0 and yaw
    carries the whole rotation about the vertical.

    Args:
        attitude: Unit quaternion, body to space; its norm drops out.

    Returns:
        (roll, pitch, yaw) [rad], to rounding of the attitude; pitch in [-pi/2, pi/2],
        roll and yaw in [-pi, pi].

    Gradients: exact for |pitch| < pi/2. At the two poles pitch has a cone (gradient 0)
    and yaw and roll the derivatives along the choice roll = 0: finite always.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> angles = jnp.array([0.3, -0.8, 1.2])
    >>> attitude = jr.rotation.from_roll_pitch_yaw(angles)
    >>> print(jr.rotation.to_roll_pitch_yaw(attitude).round(6))
    [ 0.3 -0.8  1.2]
    """
    q = rescaled(array_of_shape("attitude", attitude, 4))
    # Rz(yaw) Ry(pitch) Rx(roll) = Rz(yaw + pi/2) Rx(pitch + pi/2) Rz(roll) C, where C
    # permutes the axes. The quaternion of C^-1 is four halves.
    q = multiply(q, jnp.full(4, 0.5, q.dtype))
    # `to_euler` takes a pole where two components are 0. No float is a pole exactly, so
    # components that are 0 to rounding become 0.
    w, x, y, z = jnp.abs(q) / (4 * jnp.finfo(q.dtype).eps)
    upper = w + z < 1
    lower = x + y < 1
    is_zero = jnp.stack([upper, lower, lower, upper])
    yaw, pitch, roll = to_euler(jnp.where(is_zero, 0.0, q))
    return jnp.stack([roll, pitch - jnp.pi / 2, _wrap(yaw - jnp.pi / 2)])
