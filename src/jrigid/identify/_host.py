"""Quaternions and small matrices of numpy arrays, which need no compiled programs.

A fit reads its records once, on the host. JAX would compile every operation anew for
each length of a record, which takes longer than the work itself. Functions of tensors
take JAX arrays too, for plans, which are traced.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from jrigid._spectral import eigh
from jrigid._types import AnyArray


def on_host(tree: Any) -> Any:
    """The tree with numpy arrays in place of JAX's floating point arrays.

    Arrays that were the same object before are the same object after.
    """
    # `_arrays_of` takes only identical arrays for those that trials share.
    converted: dict[int, np.ndarray] = {}

    def convert(leaf: Any) -> Any:
        if not isinstance(leaf, jax.Array) or not eqx.is_inexact_array(leaf):
            return leaf
        if id(leaf) not in converted:
            converted[id(leaf)] = np.asarray(leaf)
        return converted[id(leaf)]

    return jtu.tree_map(convert, tree)


def multiply(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Products of quaternions (..., 4); q is applied first."""
    a, b, c, d = np.moveaxis(p, -1, 0)
    w, x, y, z = np.moveaxis(q, -1, 0)
    parts = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    return np.stack(parts, axis=-1)


def conjugate(q: np.ndarray) -> np.ndarray:
    """Conjugate quaternions (..., 4)."""
    return q * np.array([1, -1, -1, -1], q.dtype)


def normalize(q: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) over their norms; zero stays zero."""
    norm = np.sqrt(np.sum(q * q, axis=-1, keepdims=True))
    return q / np.where(norm > 0, norm, 1.0)


def exp(vectors: np.ndarray) -> np.ndarray:
    """Quaternions of rotation vectors (..., 3)."""
    angle = np.sqrt(np.sum(vectors * vectors, axis=-1, keepdims=True))
    half = 0.5 * angle
    # sin(x / 2) / x, whose error at small angles is below rounding.
    ratio = np.where(
        angle > 1e-10, np.sin(half) / np.where(angle > 1e-10, angle, 1.0), 0.5
    )
    return np.concatenate([np.cos(half), ratio * vectors], axis=-1)


def log(q: np.ndarray) -> np.ndarray:
    """Rotation vectors, of length at most pi, of unit quaternions (..., 4)."""
    # Of the two quaternions of an attitude this one gives the shorter turn.
    q = np.where(q[..., :1] < 0, -q, q)
    scalar = q[..., :1]
    vector = q[..., 1:]
    sine = np.sqrt(np.sum(vector * vector, axis=-1, keepdims=True))
    angle = 2 * np.arctan2(sine, scalar)
    # The limit at the identity is 2, since a quaternion holds half the angle.
    return np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 2.0) * vector


def to_matrix(q: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def principal_axes(tensor: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Moments, ascending, and axes, with the signs of `jrigid._spectral.eigh`."""
    if not isinstance(tensor, np.ndarray):
        return eigh(tensor)
    if not np.all(np.isfinite(tensor)):
        # numpy may raise an error for NaN, where JAX returns NaN.
        return np.full(3, np.nan, tensor.dtype), np.full((3, 3), np.nan, tensor.dtype)
    moments, axes = np.linalg.eigh(tensor)
    return moments, with_signs(axes)


def with_signs(axes: np.ndarray) -> np.ndarray:
    """Orthonormal columns with the signs of `jrigid._spectral.eigh`."""
    axes = axes.copy()
    # As in `eigh`, 0.9 keeps rounding from deciding between two components that tie.
    for column in (0, 2):
        size = np.abs(axes[:, column])
        leading = axes[np.argmax(size >= 0.9 * np.max(size)), column]
        axes[:, column] *= -1 if leading < 0 else 1
    axes[:, 1] *= -1 if np.linalg.det(axes) < 0 else 1
    return axes


def cholesky(matrix: AnyArray) -> AnyArray:
    """The lower factor of a matrix; NaN where there is none."""
    if not isinstance(matrix, np.ndarray):
        return jnp.linalg.cholesky(matrix)
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return np.full_like(matrix, np.nan)
