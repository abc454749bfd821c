"""The least-squares fit and its error bars, on problems whose answers are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jrigid import _fit

TIMES = np.arange(400) * 0.05  # 20 turns at one a second


def line(params, data):
    x, y = data
    return params["slope"] * x + params["offset"] - y


def line_data(rng, noise):
    x = np.linspace(0.0, 1.0, 300)
    return jnp.asarray(x), jnp.asarray(2.0 * x - 1.0 + noise * rng.normal(size=x.size))


def test_linear_problem_has_its_textbook_answer_and_covariance(rng):
    x, y = line_data(rng, 0.1)
    start = {"offset": jnp.asarray(0.0), "slope": jnp.asarray(0.0)}
    fit = _fit.least_squares(line, start, (x, y))
    design = np.stack([np.ones(x.size), np.asarray(x)], axis=1)
    expected, (squares,), *_ = np.linalg.lstsq(design, np.asarray(y), rcond=None)
    textbook = np.linalg.inv(design.T @ design) * squares / (x.size - 2)
    assert bool(fit.converged)
    found = np.array([fit.params["offset"], fit.params["slope"]])
    assert np.all(np.abs(found - expected) < 1e-3 * np.sqrt(np.diag(textbook)))
    np.testing.assert_allclose(fit.jacobian, design, atol=1e-14)
    covariance = _fit.covariance(fit.jacobian, fit.residuals)
    np.testing.assert_allclose(covariance, textbook, rtol=1e-5)


def test_data_without_noise_are_met(rng):
    data = line_data(rng, 0.0)
    start = {"offset": jnp.asarray(3.0), "slope": jnp.asarray(-5.0)}
    fit = _fit.least_squares(line, start, data)
    assert bool(fit.converged)
    np.testing.assert_allclose(fit.params["slope"], 2.0, rtol=1e-11)


def test_badly_scaled_parameters_do_not_matter(rng):
    x, y = line_data(rng, 0.1)
    start = {"offset": jnp.asarray(0.0), "slope": jnp.asarray(0.0)}
    plain = _fit.least_squares(line, start, (x, y))

    def scaled(params, data):
        return line({"offset": 1e6 * params["offset"], "slope": 1e-3 * params["slope"]}, data)

    fit = _fit.least_squares(scaled, start, (x, y))
    assert bool(fit.converged)
    assert int(fit.steps) <= int(plain.steps) + 2
    np.testing.assert_allclose(1e-3 * fit.params["slope"], plain.params["slope"], rtol=1e-5)


def test_a_fit_that_runs_out_of_steps_says_so(rng):
    data = line_data(rng, 0.1)
    start = {"offset": jnp.asarray(0.0), "slope": jnp.asarray(0.0)}
    assert not bool(_fit.least_squares(line, start, data, max_steps=1).converged)


def test_a_fit_of_nan_says_so(rng):
    x, y = line_data(rng, 0.1)
    start = {"offset": jnp.asarray(0.0), "slope": jnp.asarray(0.0)}
    fit = _fit.least_squares(line, start, (x, y.at[7].set(jnp.nan)))
    assert not bool(fit.converged)


def turning(params, observed):
    rate, amplitude = params
    angle = 2 * jnp.pi * rate * jnp.asarray(TIMES)
    return amplitude * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1) - observed


@pytest.fixture
def turns(rng):
    noise = 0.05 * jnp.asarray(rng.normal(size=(TIMES.size, 2)))
    return turning((jnp.asarray(1.0), jnp.asarray(1.0)), -noise)


def test_doubling_the_horizon_finds_what_one_shot_misses(turns):
    blind = (jnp.asarray(0.7), jnp.asarray(1.0))
    shot = _fit.least_squares(turning, blind, turns)
    assert abs(float(shot.params[0]) - 1.0) > 0.1
    horizons = _fit.doublings(TIMES, 1.0)
    fit = _fit.doubling_horizon(turning, blind, turns, jnp.asarray(TIMES), horizons)
    assert bool(fit.converged)
    error = np.sqrt(_fit.covariance(fit.jacobian, fit.residuals)[0, 0])
    assert abs(float(fit.params[0]) - 1.0) < 4 * error
    assert error < 1e-3


def test_last_stage_is_free_of_stiffness(turns):
    near = (jnp.asarray(1.0), jnp.asarray(0.5))
    times, horizons = jnp.asarray(TIMES), _fit.doublings(TIMES, 1.0)
    stiffness = (jnp.asarray(0.0), jnp.asarray(100.0))
    held = _fit.doubling_horizon(turning, near, turns, times, horizons, stiffness=stiffness)
    free = _fit.doubling_horizon(turning, near, turns, times, horizons)
    np.testing.assert_allclose(held.params[1], free.params[1], atol=1e-5)


def test_doublings_end_beyond_the_record():
    np.testing.assert_array_equal(_fit.doublings(np.array([3.0, 13.0]), 2.0), [5.0, 7.0, 11.0, 19])
    np.testing.assert_array_equal(_fit.doublings(np.array([0.0, 1.0]), 2.0), [2.0])


def test_influence_is_the_pseudo_inverse(rng):
    jacobian = rng.normal(size=(30, 4))
    expected = np.linalg.pinv(jacobian)
    np.testing.assert_allclose(_fit.influence(jnp.asarray(jacobian)), expected, atol=1e-14)


def autoregressive(rng, memory, rows):
    noise = np.zeros(rows)
    for row, kick in enumerate(rng.normal(size=rows)):
        noise[row] = memory * noise[row - 1] + kick
    return noise


def test_error_of_a_mean_in_autoregressive_noise(rng):
    """Exact sum over the covariance; the bootstrap agrees, white noise is sure by a factor of 3."""
    rows, memory = 2000, 0.8
    lags = np.abs(np.subtract.outer(np.arange(rows), np.arange(rows)))
    covariance = memory**lags / (1 - memory**2)
    jacobian = jnp.ones((rows, 1))
    exact = np.sqrt(covariance.mean())

    root = jnp.asarray(np.linalg.cholesky(covariance))
    known = _fit.coloured_covariance(jacobian, lambda row: root.T @ row)
    np.testing.assert_allclose(np.sqrt(known[0, 0]), exact, rtol=1e-12)

    noise = jnp.asarray(autoregressive(rng, memory, rows))
    shifts = _fit.block_bootstrap(
        jacobian[:, None, :], noise[:, None], 50, jax.random.key(0), samples=2000
    )
    assert shifts.shape == (2000, 1)
    np.testing.assert_allclose(float(jnp.std(shifts)), exact, rtol=0.2)
    white = np.sqrt(_fit.covariance(jacobian, noise - noise.mean())[0, 0])
    assert exact / white > 2.5
