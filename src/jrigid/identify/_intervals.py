"""Confidence intervals that hold where moments nearly coincide and at bounds: see `interval`."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._numerics import product
from jrigid._types import Matrix, Scalar
from jrigid.identify._compile import quick_jit

_STEP, _STEPS = 0.4, 16  # in standard errors: 6.4 to each side
_LINEAR = 0.03  # standard errors by which a function that counts as linear is off, rms
_SMALL = 0.01  # standard errors across which slopes are taken; across a kink the mean
_CROSS = _SMALL * np.concatenate([np.zeros((1, 6)), np.eye(6), -np.eye(6)])
_PAIRS = 500  # of draws: a tail of 2.5 % is good to 0.5 points
# I1 - I2, I2 - I3, I12, I23, I13; which of them vanish where I1 = I2, I2 = I3 and all
# are equal.
_GAPS = np.eye(9)[[0, 4, 1, 5, 2]]
_GAPS[:2] -= np.eye(9)[[4, 8]]
_EQUAL = (
    np.array([[1, 0, 1, 0, 0], [0, 1, 0, 1, 0], [1, 1, 1, 1, 1]])[..., None] * _GAPS
)


@quick_jit
def interval(
    function: Callable[[Matrix], Scalar],
    tensor: Matrix,
    covariance: Array,
    level: Scalar,
) -> Float[Array, "2"]:
    """Limits for a scalar function of a tensor, from the estimate and its normal error.

    A value belongs to the interval if, were it the true one, estimates as low as the
    one at hand and estimates as high would come up in more than (1 - level) / 2 of all
    cases (equal tails). The true tensors tried lie on the way downhill and uphill from
    the estimate, in the metric of its errors; the noise is the same for all. Where
    moments coincide the function has a kink, at which slopes mislead: each step goes
    along the slope, or from there onto tensors with equal moments (if these are far,
    straight towards them), whichever leads lower (higher), until none does. For the
    upper limit an estimate below all but 5 % of what the least value gives counts as
    that: no interval is empty. What would be beyond flat bodies, I3 > I1 + I2, a fit
    ends at the nearest flat one.

    Args:
        function: Of the tensor.
        tensor: The estimate.
        covariance: Of its elements, row by row.
        level: Of confidence.
    """
    pairs = np.kron([[1], [-1]], np.random.default_rng(0).normal(size=(_PAIRS, 6)))
    cross, draws, equal = (
        jnp.asarray(x, tensor.dtype) for x in (_CROSS, pairs, _EQUAL)
    )
    squares, axes = jnp.linalg.eigh(covariance)
    root = (0.5 * jnp.sqrt(jnp.maximum(squares, 0.0))[None] * axes)[:, 3:].reshape(
        3, 3, 6
    )
    root += root.transpose(1, 0, 2)  # symmetric to the last digit
    moved = lambda x: tensor + product("ijk,k->ij", root, x)  # noqa: E731 - by standard errors
    thinnest = jnp.linalg.eigh(tensor)[1][:, 2]
    thickness = (
        0.5 * jnp.eye(3, dtype=tensor.dtype) - thinnest[:, None] * thinnest[None]
    )
    thicker = product("ij,ijk->k", thickness, root)
    thicker = thicker / (jnp.sum(thicker**2) + jnp.finfo(tensor.dtype).tiny)

    def f(x: Array) -> Array:
        return function(
            moved(x - thicker * jnp.minimum(jnp.sum(thickness * moved(x)), 0.0))
        )

    def merged(x: Array, equal: Array) -> Array:
        for _ in range(3):
            moments, axes = jnp.linalg.eigh(moved(x))
            inside = product("ia,ijk,jb->abk", axes, root, axes).reshape(9, 6)
            gaps = product("ij,j->i", equal, jnp.diag(moments).ravel())
            x -= product(
                "ij,j->i", jnp.linalg.pinv(product("ij,jk->ik", equal, inside)), gaps
            )
        return x

    def way(sign: Array) -> Array:
        def step(
            now: tuple[Array, Array], _: None
        ) -> tuple[tuple[Array, Array], Array]:
            x, slope = now
            ahead = x + _STEP * slope / jnp.sqrt(
                jnp.sum(slope**2) + jnp.finfo(x.dtype).tiny
            )
            away = jax.vmap(merged, (None, 0))(ahead, equal) - x[None]
            away /= jnp.maximum(
                jnp.linalg.norm(away, axis=1, keepdims=True) / _STEP, 1.0
            )
            places = jnp.concatenate([jnp.stack([x, ahead]), x[None] + away])
            there = sign * jax.vmap(jax.vmap(f))(places[:, None] + cross[None])
            best = jnp.nanargmax(there[:, 0])
            return (places[best], there[best, 1:7] - there[best, 7:]), places[best]

        return jax.lax.scan(step, (cross[0], cross[0]), None, _STEPS + 1)[1][1:]

    signs = jnp.asarray([-1.0, 1.0], tensor.dtype)
    down, up = jax.vmap(way)(signs)
    around, nodes = (
        jnp.concatenate([cross, draws]),
        jnp.concatenate([down[::-1], cross[:1], up]),
    )
    values = jax.lax.map(lambda x: jax.vmap(f)(x[None] + around), nodes)
    tail, here = 0.5 * (1 - level), values[_STEPS, 0]
    ranks = jnp.stack([tail, 1 - tail, 2 * tail, 1 - 2 * tail])
    low, high, low2, high2 = jax.lax.cummax(
        jnp.quantile(values[:, 13:], ranks, axis=1), axis=1
    )
    lower = jnp.interp(jnp.minimum(here, high2[-1]), high, values[:, 0])
    upper = jnp.interp(jnp.maximum(here, low2[0]), low, values[:, 0])
    slope = (values[_STEPS, 1:7] - values[_STEPS, 7:13]) / (2 * _SMALL)
    error, off = jnp.sqrt(jnp.sum(slope**2)), values[_STEPS] - here
    off -= product("ni,i->n", around, slope)
    straight = here + signs * error * jax.scipy.stats.norm.ppf(1 - tail)
    linear = jnp.sqrt(jnp.mean(off**2)) < _LINEAR * error
    rounding = (
        jnp.sqrt(jnp.finfo(error.dtype).eps) * error
    )  # a bound belongs to the interval
    return jnp.where(linear, straight, jnp.stack([lower, upper])) + signs * rounding
