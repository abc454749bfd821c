"""Parametrisations of real bodies: both ways, physical by construction, smooth at the sphere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid import identify


def second_moments(tensor):
    return 0.5 * np.trace(tensor) * np.eye(3) - tensor


def a_body(rng):
    """Of twelve points: physical without any formula."""
    return jr.from_points(rng.uniform(0.1, 1, 12), rng.normal((0.3, -0.2, 0.1), 1.0, (12, 3)))


def test_any_six_numbers_are_a_real_body_s(rng):
    for _ in range(50):
        numbers = rng.normal(size=6) * rng.choice([0.1, 1, 3])
        tensor = np.asarray(identify.inertia_from_parameters(numbers))
        np.testing.assert_array_equal(tensor, tensor.T)
        # Sigma = L L^T with the L of the docstring: positive definite
        n = numbers
        lower = np.exp(n[0]) * np.array(
            [
                [1, 0, 0],
                [numbers[3], np.exp(numbers[1]), 0],
                [numbers[4], numbers[5], np.exp(numbers[2])],
            ]
        )
        sigma = lower @ lower.T
        np.testing.assert_allclose(tensor, np.trace(sigma) * np.eye(3) - sigma, rtol=1e-13)
        moments = np.linalg.eigvalsh(tensor)
        assert moments[0] > 0
        assert moments[2] <= moments[0] + moments[1] + 1e-14 * moments[2]


def test_both_ways_of_the_six_numbers(rng):
    for _ in range(20):
        tensor = np.asarray(a_body(rng).inertia)
        numbers = identify.parameters_from_inertia(tensor)
        np.testing.assert_allclose(identify.inertia_from_parameters(numbers), tensor, rtol=1e-12)
        # the first is the scale, the others the shape
        scaled = identify.parameters_from_inertia(9.0 * tensor)
        np.testing.assert_allclose(scaled[0] - numbers[0], np.log(3.0), rtol=1e-12)
        np.testing.assert_allclose(scaled[1:], numbers[1:], atol=1e-13)


def test_the_sphere_and_the_symmetric_body_are_nothing_special():
    for moments in ([2.0, 2, 2], [1.0, 1, 1.5], [1.5, 1, 1]):
        numbers = identify.parameters_from_inertia(np.array(moments))
        jacobian = np.asarray(jax.jacfwd(identify.inertia_from_parameters)(numbers))
        six = jacobian[np.triu_indices(3)]
        assert np.linalg.cond(six) < 30
        back = jax.jacfwd(
            lambda p: identify.parameters_from_inertia(identify.inertia_from_parameters(p))
        )
        np.testing.assert_allclose(back(numbers), np.eye(6), atol=1e-13)


def test_the_ten_numbers_both_ways(rng):
    for _ in range(20):
        body = a_body(rng)
        numbers = identify.log_cholesky_from_body(body)
        again = identify.body_from_log_cholesky(numbers)
        np.testing.assert_allclose(again.mass, body.mass, rtol=1e-13)
        np.testing.assert_allclose(again.center_of_mass, body.center_of_mass, rtol=1e-13)
        np.testing.assert_allclose(again.inertia, body.inertia, rtol=1e-11, atol=1e-12)


def test_the_ten_numbers_are_the_factor_of_the_pseudo_inertia(rng):
    """Rucker & Wensing's definition, about the origin of the coordinates."""
    body = a_body(rng)
    m, c = float(body.mass), np.asarray(body.center_of_mass)
    about_origin = np.asarray(body.about(np.zeros(3)))
    pseudo = np.block(
        [[second_moments(about_origin), m * c[:, None]], [m * c[None], np.full((1, 1), m)]]
    )
    alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = np.asarray(identify.log_cholesky_from_body(body))
    upper = np.exp(alpha) * np.array(
        [
            [np.exp(d1), s12, s13, t1],
            [0, np.exp(d2), s23, t2],
            [0, 0, np.exp(d3), t3],
            [0, 0, 0, 1],
        ]
    )
    np.testing.assert_allclose(upper @ upper.T, pseudo, rtol=1e-12, atol=1e-12)


def test_any_ten_numbers_are_a_real_body_s(rng):
    for _ in range(20):
        body = identify.body_from_log_cholesky(rng.normal(size=10))
        assert body.result == jr.RESULTS.successful
        jr.MassProperties(body.mass, body.center_of_mass, body.inertia)  # checks and does not raise


def test_turned_axes_are_the_same_body(rng):
    """The spectrum does not depend on the axes the factor is written in."""
    body = a_body(rng)
    turn = Rotation.random(rng=0).as_matrix()
    numbers = identify.parameters_from_inertia(turn @ np.asarray(body.inertia) @ turn.T)
    tensor = identify.inertia_from_parameters(numbers)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(tensor), np.linalg.eigvalsh(body.inertia), rtol=1e-12
    )


FLAT = np.array([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("function", "bad", "message"),
    [
        (identify.parameters_from_inertia, FLAT, "I3 < I1 \\+ I2"),
        (identify.parameters_from_inertia, np.array([1.0, 1, 3]), "I3 < I1 \\+ I2"),
        (identify.parameters_from_inertia, np.eye(3) + 0.1 * np.eye(3, k=1), "symmetric tensor"),
        (identify.parameters_from_inertia, np.full(3, np.nan), "I3 < I1 \\+ I2"),
        (identify.inertia_from_parameters, np.full(6, np.inf), "`parameters` must be finite"),
        (identify.body_from_log_cholesky, np.full(10, np.nan), "`parameters` must be finite"),
        (identify.log_cholesky_from_body, jr.solids.disk(1.0, 0.5), "`body` must be"),
    ],
)
def test_bad_values_are_errors_or_nan(function, bad, message):
    with pytest.raises(RuntimeError, match=message):
        function(bad)
    with pytest.raises(RuntimeError, match=message):
        jax.block_until_ready(jax.jit(function)(bad))
    assert all(np.all(np.isnan(x)) for x in jax.tree.leaves(function(bad, throw=False)))


def test_bad_lanes_and_shapes(untyped):
    lanes = jnp.array([[2.0, 2, 2], [1.0, 2, 3.5], [1.0, 2, 2.5]])
    found = jax.vmap(lambda i: identify.parameters_from_inertia(i, throw=False))(lanes)
    assert list(np.isnan(found).any(axis=1)) == [False, True, False]
    slope = jax.grad(
        lambda s: jnp.nansum(
            jax.vmap(lambda i: identify.parameters_from_inertia(s * i, throw=False))(lanes)
        )
    )(1.0)
    assert slope == pytest.approx(2 * 0.5)
    with pytest.raises(ValueError, match="`parameters` must have shape \\(6,\\)"):
        identify.inertia_from_parameters(np.zeros(5))
    with pytest.raises(ValueError, match="must be MassProperties"):
        identify.log_cholesky_from_body(np.eye(3))
