"""Errors in coloured noise, on a problem whose answer is known."""

import jax
import jax.numpy as jnp
import numpy as np

from jrigid import identify


def autoregressive(rng, memory, rows):
    noise = np.zeros(rows)
    for row, kick in enumerate(rng.normal(size=rows)):
        noise[row] = memory * noise[row - 1] + kick
    return noise


def test_error_of_a_mean_in_autoregressive_noise(rng):
    """Exact sum over the covariance; the bootstrap agrees, white noise too sure."""
    rows, memory = 2000, 0.8
    lags = np.abs(np.subtract.outer(np.arange(rows), np.arange(rows)))
    covariance = memory**lags / (1 - memory**2)
    jacobian = jnp.ones((rows, 1))
    exact = np.sqrt(covariance.mean())

    root = jnp.asarray(np.linalg.cholesky(covariance))
    known = identify.coloured_covariance(jacobian, lambda row: root.T @ row)
    np.testing.assert_allclose(np.sqrt(known[0, 0]), exact, rtol=1e-12)

    noise = jnp.asarray(autoregressive(rng, memory, rows))
    shifts = identify.block_bootstrap(
        jacobian[:, None, :], noise[:, None], 50, jax.random.key(0), samples=2000
    )
    assert shifts.shape == (2000, 1)
    np.testing.assert_allclose(float(jnp.std(shifts)), exact, rtol=0.2)
    white = np.std(noise) / np.sqrt(rows)
    assert exact / white > 2.5
