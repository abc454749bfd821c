"""Confidence intervals that hold where moments nearly coincide and at bounds."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._core.compile import SOME, quick_jit
from jrigid._numerics import product
from jrigid._types import Matrix, Scalar

# The path from the estimate goes 6.4 standard errors to each side.
_STEP = 0.4
_STEPS = 16
# A function counts as linear if its rms deviation from a plane is below this many
# standard errors.
_LINEAR = 0.03
# Standard errors across which slopes are taken. Across a kink this gives their mean.
_SMALL = 0.01
# Offsets at which the function is evaluated around a point: none, then a small change
# of each of the six numbers up and down.
_CROSS = _SMALL * np.concatenate([np.zeros((1, 6)), np.eye(6), -np.eye(6)])
_CENTRE = 0
_UP = slice(1, 7)
_DOWN = slice(7, 13)
_DRAWN = slice(13, None)  # random errors of an estimate, see `_draws`
_PAIRS = 500  # of draws, which give a tail of 2.5 % to 0.5 points
_NEWTON = 3  # Newton steps onto equal moments

# I1 - I2, I2 - I3, I12, I23 and I13 as functions of the nine elements of a tensor.
_GAPS = np.eye(9)[[0, 4, 1, 5, 2]]
_GAPS[:2] -= np.eye(9)[[4, 8]]
# Those that vanish where I1 = I2, where I2 = I3 and where all are equal.
_EQUAL = (
    np.array([[1, 0, 1, 0, 0], [0, 1, 0, 1, 0], [1, 1, 1, 1, 1]])[..., None] * _GAPS
)


class _Tensors(NamedTuple):
    """Tensors around an estimate, at points in units of its standard errors.

    Attributes:
        estimate: The tensor at the origin.
        root: Change of the tensor with a point (3, 3, 6), a root of its covariance.
        thickness: Matrix whose inner product with a tensor is (I1 + I2 - I3) / 2.
        thicker: Change of the point that makes a body thicker by one unit (6,).
    """

    estimate: Array
    root: Array
    thickness: Array
    thicker: Array

    def at(self, point: Array) -> Array:
        """Tensor at a point."""
        return self.estimate + product("ijk,k->ij", self.root, point)

    def of_real_body(self, point: Array) -> Array:
        """Tensor at a point, or, beyond flat bodies, that of a nearby flat body."""
        missing = jnp.minimum(jnp.sum(self.thickness * self.at(point)), 0.0)
        return self.at(point - self.thicker * missing)

    def with_equal_moments(self, point: Array, equal: Array) -> Array:
        """Nearest point at which linear combinations of moments vanish.

        Args:
            point: The point to move.
            equal: What vanishes, as in `_EQUAL` (5, 9).
        """
        for _ in range(_NEWTON):
            moments, axes = jnp.linalg.eigh(self.at(point))
            # Two moments coincide where their difference and the element between their
            # axes vanish. In principal axes the element is zero already, and its slope
            # keeps it so.
            slopes = product("ia,ijk,jb->abk", axes, self.root, axes).reshape(9, 6)
            gaps = product("ij,j->i", equal, jnp.diag(moments).ravel())
            inverse = jnp.linalg.pinv(product("ij,jk->ik", equal, slopes))
            point -= product("ij,j->i", inverse, gaps)
        return point


def _tensors(estimate: Array, covariance: Array) -> _Tensors:
    """Tensors around an estimate whose elements have a covariance (9, 9)."""
    squares, axes = jnp.linalg.eigh(covariance)
    # A symmetric tensor has six numbers: three of the nine eigenvalues are zero.
    columns = 0.5 * jnp.sqrt(jnp.maximum(squares, 0.0))[None] * axes
    root = columns[:, 3:].reshape(3, 3, 6)
    root += root.transpose(1, 0, 2)  # symmetric to the last digit
    thinnest = jnp.linalg.eigh(estimate)[1][:, 2]
    thickness = (
        0.5 * jnp.eye(3, dtype=estimate.dtype) - thinnest[:, None] * thinnest[None]
    )
    thicker = product("ij,ijk->k", thickness, root)
    thicker = thicker / (jnp.sum(thicker**2) + jnp.finfo(estimate.dtype).tiny)
    return _Tensors(estimate, root, thickness, thicker)


def _draws() -> np.ndarray:
    """Normal errors of an estimate in pairs of opposite sign, the same in each call."""
    normal = np.random.default_rng(0).normal(size=(_PAIRS, 6))
    return np.kron([[1], [-1]], normal)


def _path(value: Callable[[Array], Array], tensors: _Tensors, sign: Array) -> Array:
    """Points downhill (sign -1) or uphill (1) from the estimate, (_STEPS, 6).

    Each step goes along the slope, or towards tensors with equal moments, whichever
    leads further down or up.
    """
    dtype = tensors.estimate.dtype
    cross = jnp.asarray(_CROSS, dtype)
    equal = jnp.asarray(_EQUAL, dtype)

    def step(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        point, slope = carry
        length = jnp.sqrt(jnp.sum(slope**2) + jnp.finfo(dtype).tiny)
        ahead = point + _STEP * slope / length
        merged = jax.vmap(tensors.with_equal_moments, (None, 0))(ahead, equal)
        change = merged - point[None]
        distance = jnp.linalg.norm(change, axis=1, keepdims=True)
        change /= jnp.maximum(distance / _STEP, 1.0)
        candidates = jnp.concatenate([jnp.stack([point, ahead]), point[None] + change])
        heights = sign * jax.vmap(jax.vmap(value))(candidates[:, None] + cross[None])
        best = jnp.nanargmax(heights[:, _CENTRE])
        slope = heights[best, _UP] - heights[best, _DOWN]
        return (candidates[best], slope), candidates[best]

    # The first round knows no slope yet and makes no step along one. Its point is left
    # out.
    _, points = jax.lax.scan(step, (cross[0], cross[0]), None, _STEPS + 1)
    return points[1:]


def _from_quantiles(values: Array, tail: Array) -> Array:
    """Limits that no true tensor beyond them would pass at the stated level.

    Args:
        values: Function at each true tensor of the path and at estimates of it.
        tail: Probability beyond each limit.
    """
    truths = values[:, _CENTRE]
    estimate = truths[_STEPS]
    ranks = jnp.stack([tail, 1 - tail, 2 * tail, 1 - 2 * tail])
    quantiles = jnp.quantile(values[:, _DRAWN], ranks, axis=1)
    # Quantiles that fall along the path would have no inverse.
    low, high, inner_low, inner_high = jax.lax.cummax(quantiles, axis=1)
    # An estimate beyond those of all true tensors is moved, so that no interval is
    # empty.
    # The lower limit is the true value whose estimates exceed the actual one with the
    # probability `tail`.
    lower = jnp.interp(jnp.minimum(estimate, inner_high[-1]), high, truths)
    upper = jnp.interp(jnp.maximum(estimate, inner_low[0]), low, truths)
    return jnp.stack([lower, upper])


def _error_and_curvature(values: Array, offsets: Array) -> tuple[Array, Array]:
    """Standard error of a function by its slope, and its rms deviation from a plane."""
    slope = (values[_UP] - values[_DOWN]) / (2 * _SMALL)
    error = jnp.sqrt(jnp.sum(slope**2))
    deviation = values - values[_CENTRE]
    deviation -= product("ni,i->n", offsets, slope)
    return error, jnp.sqrt(jnp.mean(deviation**2))


@partial(quick_jit, level=SOME)
def interval(
    function: Callable[[Matrix], Scalar],
    tensor: Matrix,
    covariance: Array,
    level: Scalar,
) -> Float[Array, "2"]:
    """Return limits for a scalar function of an estimated tensor with normal errors.

    A value belongs to the interval if, were it the true one, estimates as low as this
    one and estimates as high would each occur in more than (1 - level) / 2 of all cases
    (equal tails). The true tensors that are tried lie on the paths downhill and uphill
    from the estimate, in the metric of its errors. The noise is the same for all.

    Where moments coincide the function has a kink, and slopes mislead. Each step
    therefore has several candidates: a point along the slope, and tensors with equal
    moments near it, or points towards these if they are far. It goes to the lowest
    (highest) candidate, until none is lower (higher). For the upper limit, an estimate
    below all but 5 % of the estimates at the least value counts as that quantile, so
    that no interval is empty. Tensors beyond flat bodies, I3 > I1 + I2, are replaced by
    a nearby flat body, as in a fit.

    Where the function is linear the limits are those of a normal distribution.

    Args:
        function: Function of the tensor.
        tensor: Estimate of the tensor.
        covariance: Covariance of its elements, row by row.
        level: Confidence level.
    """
    dtype = tensor.dtype
    tensors = _tensors(tensor, covariance)

    def value(point: Array) -> Array:
        return function(tensors.of_real_body(point))

    def values_around(point: Array) -> Array:
        return jax.vmap(value)(point[None] + offsets)

    signs = jnp.asarray([-1.0, 1.0], dtype)
    down, up = jax.vmap(partial(_path, value, tensors))(signs)
    cross = jnp.asarray(_CROSS, dtype)
    offsets = jnp.concatenate([cross, jnp.asarray(_draws(), dtype)])
    points = jnp.concatenate([down[::-1], cross[:1], up])
    values = jax.lax.map(values_around, points)

    tail = 0.5 * (1 - level)
    general = _from_quantiles(values, tail)
    error, curvature = _error_and_curvature(values[_STEPS], offsets)
    normal = jax.scipy.stats.norm.ppf(1 - tail)
    linear = values[_STEPS, _CENTRE] + signs * error * normal
    limits = jnp.where(curvature < _LINEAR * error, linear, general)
    # A value at a bound belongs to the interval, also after rounding.
    return limits + signs * (jnp.sqrt(jnp.finfo(error.dtype).eps) * error)
