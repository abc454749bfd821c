"""Errors of a fit when the noise has a colour: what white-noise error bars miss."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jrigid._checks import demand
from jrigid._types import RandomKey


def _influence(jacobian: Float[Array, "rows params"]) -> Float[Array, "params rows"]:
    """Shift of the fitted parameters for each unit of noise in each row (the pseudo-inverse).

    By a QR decomposition, so the condition number is not squared. A Jacobian without
    full rank gives infinities or NaN: the record cannot tell these parameters apart.
    """
    q, r = jnp.linalg.qr(jacobian)
    return jax.scipy.linalg.solve_triangular(r, q.T)


def coloured_covariance(
    jacobian: Float[Array, "rows params"], colour: Callable[[Array], Array]
) -> Float[Array, "params params"]:
    """Covariance of the parameters of an unweighted fit when the noise has a known colour.

    Args:
        jacobian: Of the residuals, as fitted.
        colour: Takes a vector of rows to `B^T` times it, where the noise is `B` times
            independent draws of unit variance, that is, its covariance is `B B^T`.

    Returns:
        `A B B^T A^T`, A the pseudo-inverse of the Jacobian.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.identify.coloured_covariance(jnp.ones((4, 1)), lambda row: 2 * row))
    [[1.]]
    """
    shaped = jax.vmap(colour)(_influence(jacobian))
    return shaped @ shaped.T


def block_bootstrap(
    jacobian: Float[Array, "times outputs params"],
    residuals: Float[Array, "times outputs"],
    block: int,
    key: RandomKey,
    *,
    samples: int = 1000,
) -> Float[Array, "samples params"]:
    """Shifts of the parameters when blocks of residuals are dealt out anew.

    The moving-block bootstrap of Kuensch (1989), with the fit linearised at its
    optimum, so that no refit is needed. It keeps the correlation of the noise up to the
    length of a block and loses what is longer: for noise with a longer memory the
        spread comes out too small.

    Args:
        jacobian: Of the residuals, as fitted: `found.linearization()` gives both, for
            one record of one trial.
        residuals: At the optimum, equally spaced in time.
        block: Length of a block in samples.
        key: Random key.
        samples: Number of redrawn records.

    Raises:
        ValueError: A block as long as the record, which could be dealt in one way only.

    Returns:
        Parameter shifts; their standard deviation estimates the standard error.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> residuals = jnp.sin(jnp.arange(50.0))[:, None]
    >>> shifts = jr.identify.block_bootstrap(jnp.ones((50, 1, 1)), residuals, 5, jax.random.key(0))
    >>> print(shifts.shape)
    (1000, 1)
    """
    times, outputs, params = jacobian.shape
    text = (
        f"Argument `block` must be at least 1 and less than {times}, but it is {block}."
    )
    demand(1 <= block < times, text)
    gain = _influence(jacobian.reshape(times * outputs, params))
    centred = residuals - jnp.mean(residuals, axis=0, keepdims=True)

    def shift(key):
        starts = jax.random.randint(key, (-(-times // block),), 0, times - block + 1)
        rows = (starts[:, None] + jnp.arange(block)[None, :]).reshape(-1)[:times]
        return gain @ centred[rows].reshape(-1)

    return jax.lax.map(shift, jax.random.split(key, samples), batch_size=50)
