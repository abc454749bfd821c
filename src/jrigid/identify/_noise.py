"""Errors of a fit whose noise is correlated in time."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jrigid._checks import array_of_shape, check_key, check_shape, demand, shaped
from jrigid._numerics import product
from jrigid._types import RandomKey

_AT_ONCE = 50  # redrawn records that are held in memory


def _influence(jacobian: Float[Array, "rows params"]) -> Float[Array, "params rows"]:
    """Shift of the parameters per unit of noise in each row: the pseudo-inverse.

    It uses a QR decomposition, so the condition number is not squared. A Jacobian
    without full rank gives infinities or NaN, because the record does not determine all
    parameters.
    """
    q, r = jnp.linalg.qr(jacobian)
    return jax.scipy.linalg.solve_triangular(r, q.T)


def coloured_covariance(
    jacobian: Float[Array, "rows params"], colour: Callable[[Array], Array]
) -> Float[Array, "params params"]:
    """Return the covariance of an unweighted fit whose noise has a known covariance.

    Args:
        jacobian: Derivatives of the residuals, as fitted, one row for each number: of
            `jacobian, _ = result.linearization()` it is
            `jacobian.reshape(-1, jacobian.shape[-1])`.
        colour: Function that multiplies a vector of rows by `B^T`. The noise is `B`
            times independent numbers of unit variance: its covariance is `B B^T`.

    Returns:
        Covariance of the parameters, `A B B^T A^T`, with A the pseudo-inverse of the
        Jacobian.

    Raises:
        ValueError: A `jacobian` that is no matrix.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.identify.coloured_covariance(jnp.ones((4, 1)), lambda row: 2 * row))
    [[1.]]
    """
    jacobian = array_of_shape("jacobian", jacobian, None, None)
    # With A the influence, B^T times a row of A is a row of A B.
    root = jax.vmap(colour)(_influence(jacobian))
    return product("ik,jk->ij", root, root)


def block_bootstrap(
    jacobian: Float[Array, "times outputs params"],
    residuals: Float[Array, "times outputs"],
    block: int,
    key: RandomKey,
    *,
    samples: int = 1000,
) -> Float[Array, "samples params"]:
    """Return shifts of the parameters for records redrawn from blocks of residuals.

    This is the moving-block bootstrap of Kuensch (1989). The fit is linearised at its
    minimum, so that no fit is repeated. The method keeps the correlation of the noise
    up to the length of a block. For noise with a longer memory the spread is too small.

    Args:
        jacobian: Derivatives of the residuals, as fitted. `result.linearization()`
            returns both, for one record of one trial.
        residuals: Residuals at the minimum, equally spaced in time.
        block: Length of a block in samples.
        key: Random key.
        samples: Number of redrawn records.

    Returns:
        Shifts of the parameters. Their standard deviation estimates the standard error.

    Raises:
        ValueError: Shapes that do not fit each other, no random key, or a block as long
            as the record, which could be drawn in one way only.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> jacobian = jnp.ones((50, 1, 1))
    >>> residuals = jnp.sin(jnp.arange(50.0))[:, None]
    >>> shifts = jr.identify.block_bootstrap(jacobian, residuals, 5, jax.random.key(0))
    >>> print(shifts.shape)
    (1000, 1)
    """
    check_key("key", key)
    jacobian, residuals = shaped(
        jacobian=(jacobian, None, None, None), residuals=(residuals, None, None)
    )
    times, outputs, params = jacobian.shape
    check_shape("residuals", residuals, (times, outputs))
    demand(
        1 <= block < times,
        f"Argument `block` must be at least 1 and less than {times}, but it is "
        f"{block}.",
    )
    influence = _influence(jacobian.reshape(times * outputs, params))
    # A mean would move all redrawn records alike, which is no scatter.
    centred = residuals - jnp.mean(residuals, axis=0, keepdims=True)
    blocks = -(-times // block)  # rounded up

    def shift(key: Array) -> Array:
        # The upper bound is exclusive: the last block ends at the last residual.
        starts = jax.random.randint(key, (blocks,), 0, times - block + 1)
        rows = (starts[:, None] + jnp.arange(block)[None, :]).reshape(-1)[:times]
        return product("in,n->i", influence, centred[rows].reshape(-1))

    return jax.lax.map(shift, jax.random.split(key, samples), batch_size=_AT_ONCE)
