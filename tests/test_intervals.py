"""Intervals contain the true value where moments nearly coincide and at bounds.

`benchmarks/bench_intervals.py` has more trials.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jrigid as jr
from jrigid import identify
from jrigid.identify._intervals import interval

LEVEL = jnp.asarray(0.95)
ERROR = 0.002  # of each of five orthonormal numbers
GAP = 2**0.5 * ERROR  # standard error of an isolated gap


def basis():
    matrices = np.zeros((5, 3, 3))
    matrices[0], matrices[1] = (
        np.diag([-1, 1, 0]) / 2**0.5,
        np.diag([1, 1, -2]) / 6**0.5,
    )
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2)), 2):
        matrices[k, i, j] = matrices[k, j, i] = 0.5**0.5
    return matrices


def ratio(which, tensor):
    moments = jr.principal_axes(tensor).moments
    return moments[which] / moments[0]


def thickness(tensor):
    moments = jr.principal_axes(tensor).moments
    return moments[0] + moments[1] - moments[2]


def covariance(errors):
    roots = jnp.asarray((np.asarray(errors)[:, None, None] * basis()).reshape(5, 9))
    return roots.T @ roots


@jax.jit
def intervals(which, tensors, spread):
    """And by derivatives."""
    function = Partial(ratio, which)

    def one(tensor):
        slope = jax.jacfwd(function)(tensor).ravel()
        far = 1.96 * jnp.sqrt(slope @ spread @ slope)
        plain = function(tensor) + jnp.stack([-far, far])
        return interval(function, tensor, spread, LEVEL), plain

    return jax.lax.map(one, tensors)


def covered(limits, truth):
    limits = np.asarray(limits)
    return np.mean((limits[:, 0] <= truth) & (truth <= limits[:, 1]))


def coverage(gaps, which, errors, rng, trials=200):
    gaps = np.array(gaps) * GAP
    moments = 1 + np.cumsum([0, *gaps])
    turn = np.einsum("ni,iab->nab", rng.normal(size=(trials, 5)) * errors, basis())
    limits = intervals(
        jnp.asarray(which), jnp.asarray(np.diag(moments) + turn), covariance(errors)
    )
    return tuple(covered(x, moments[which] / moments[0]) for x in limits)


ALIKE = ERROR * np.ones(5)
# 200 trials have a standard error of 1.5 points, so that 90 % is more than three of
# them below 95 %.


@pytest.mark.parametrize("gap", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("which", [1, 2])
def test_intervals_hold_the_truth_of_a_nearly_symmetric_body(gap, which, rng):
    assert coverage((gap, 40.0), which, ALIKE, rng)[0] > 0.9


def test_intervals_of_a_nearly_spherical_body_hold_where_derivatives_do_not(rng):
    new, plain = coverage((0.1, 0.1), 2, ALIKE, rng)
    assert new > 0.9
    assert plain < 0.7


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_errors_that_differ_by_directions_do_no_harm(factor, rng):
    errors = ALIKE * np.array([factor, 1, 1, 1, 1])
    assert coverage((0.0, 100.0), 1, errors, rng)[0] > 0.9


def test_where_the_function_is_linear_the_errors_are_the_usual_ones():
    limits = interval(
        lambda x: x[0, 1],
        jnp.diag(jnp.array([1.0, 1.5, 2.0])),
        covariance(ALIKE),
        jnp.asarray(0.9),
    )
    np.testing.assert_allclose(
        limits, ERROR * 0.5**0.5 * 1.6448536 * np.array([-1, 1]), rtol=1e-6
    )


def test_equal_moments_and_flat_bodies_are_closed_ends():
    near = jnp.diag(jnp.array([1.0, 1 + GAP, 1.7]))
    lower, upper = interval(
        Partial(ratio, jnp.asarray(1)), near, covariance(ALIKE), LEVEL
    )
    assert 1 - 1e-8 < lower <= 1
    assert 1 + GAP < upper < 1 + 5 * GAP
    flat = jnp.diag(jnp.array([1.0, 1.5, 2.5 - ERROR]))
    lower, upper = interval(thickness, flat, covariance(ALIKE), LEVEL)
    assert -0.1 * ERROR < lower <= 0
    assert upper > 2 * ERROR


def test_a_fit_hands_out_intervals(rng):
    record = jr.datasets.gyro_example()
    readings = identify.Rates(record.times, record.omegas, record.sigma)
    result = identify.fit(jr.RigidBody(np.ones(3)), readings)
    usual = np.asarray(result.ratios) + 1.96 * np.outer([-1, 1], result.ratios_errors)
    np.testing.assert_allclose(result.ratios_intervals, usual, atol=1e-4)
    wide, narrow = result.interval(thickness), result.interval(thickness, level=0.5)
    assert wide[0] < narrow[0] < narrow[1] < wide[1]
