import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from helpers import DTYPES, ulps

from jrigid._numerics import (
    arctanc_sqrt,
    cos_sqrt,
    inverse_of_power,
    power_of_two,
    safe_arctan2,
    safe_norm,
    sinc_sqrt,
    unit_again,
)


def derivatives(function):
    """Value and first three derivatives of a scalar function,
    over an array of points."""
    orders = [function]
    for _ in range(3):
        orders.append(jax.grad(orders[-1]))
    return jax.jit(lambda points: jnp.stack([jax.vmap(f)(points) for f in orders]))


# --- edges
# ------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
def test_norm_at_zero_has_value_gradient_and_hessian_zero(dtype):
    zero = jnp.zeros(3, dtype)
    assert safe_norm(zero) == 0
    assert safe_norm(zero).dtype == dtype
    orders = [jax.grad(safe_norm), jax.jacfwd(safe_norm), jax.hessian(safe_norm)]
    for derivative in jax.jit(lambda v: [order(v) for order in orders])(zero):
        assert np.all(np.asarray(derivative) == 0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_norm_neither_overflows_nor_underflows_and_nor_does_its_gradient(dtype):
    both = jax.jit(jax.value_and_grad(safe_norm))
    tiny = float(np.finfo(dtype).tiny)
    for size in (64 * tiny, tiny**0.5, 1.0, 1e19, float(np.finfo(dtype).max) / 8):
        vector = np.array([2.0, -3.0, 6.0]).astype(dtype) * dtype(size)
        value, gradient = both(jnp.asarray(vector))
        np.testing.assert_allclose(value, 7 * dtype(size), rtol=ulps(dtype, 4))
        np.testing.assert_allclose(
            gradient, np.array([2, -3, 6]) / 7, rtol=ulps(dtype, 4)
        )


@pytest.mark.parametrize("dtype", DTYPES)
def test_inverses_of_powers_of_two_are_exact_where_they_are_normal_numbers(dtype):
    info = np.finfo(dtype)
    # The inverse of the smallest normal number is normal, that of the largest is not.
    powers = np.ldexp(dtype(1), np.arange(info.minexp, info.maxexp - 1)).astype(dtype)
    assert powers[0] == info.tiny
    inverses = inverse_of_power(jnp.asarray(powers))
    assert inverses.dtype == dtype
    np.testing.assert_array_equal(inverses, dtype(1) / powers)


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_number_has_a_power_of_two_next_to_it_with_a_normal_inverse(dtype):
    info = np.finfo(dtype)
    tiny, huge = float(info.tiny), float(info.max)
    sizes = [0.0, tiny / 4, tiny, 0.75, 1.0, -3.0, huge, np.inf, np.nan]
    powers = power_of_two(jnp.asarray(sizes, dtype))
    np.testing.assert_array_equal(powers[3:6], np.array([1.0, 2.0, 4.0], dtype))
    assert powers[0] == 1
    inverses = np.asarray(inverse_of_power(powers))
    assert np.all((inverses >= info.tiny) & (inverses < np.inf))
    np.testing.assert_array_equal(inverses * np.asarray(powers), 1)


def test_a_vector_of_norm_nearly_one_is_brought_to_one_with_derivatives():
    unit = np.array([2.0, -3.0, 6.0]) / 7
    np.testing.assert_allclose(unit_again(jnp.asarray(1.001 * unit)), unit, rtol=4e-16)

    # Of v / |v| at a unit vector u: P and -(u P + P u + P u) with P = 1 - u u.
    across = np.eye(3) - np.outer(unit, unit)
    first = jax.jacfwd(unit_again)(jnp.asarray(unit))
    np.testing.assert_allclose(first, across, atol=1e-15)
    second = jax.hessian(unit_again)(jnp.asarray(unit))
    expected = -(
        np.einsum("i,jk->ijk", unit, across)
        + np.einsum("j,ik->ijk", unit, across)
        + np.einsum("k,ij->ijk", unit, across)
    )
    np.testing.assert_allclose(second, expected, atol=1e-14)


@pytest.mark.parametrize("dtype", DTYPES)
def test_arctan2_at_the_origin_has_value_and_gradient_zero(dtype):
    orders = [
        safe_arctan2,
        jax.grad(safe_arctan2, (0, 1)),
        jax.hessian(safe_arctan2, (0, 1)),
    ]
    together = jax.jit(lambda y, x: [order(y, x) for order in orders])
    for y in (0.0, -0.0):
        for x in (0.0, -0.0):
            for derivatives in together(jnp.asarray(y, dtype), jnp.asarray(x, dtype)):
                assert np.all(np.asarray(derivatives) == 0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_arctan2_and_its_gradient_at_any_distance_from_the_origin(dtype):
    both = jax.jit(jax.value_and_grad(safe_arctan2, (0, 1)))
    tiny, large = float(np.finfo(dtype).tiny), float(np.finfo(dtype).max)
    for size in (8 * tiny, tiny**0.5 / 8, 1.0, large**0.5 * 8):
        for y, x in ((3, 4), (3, -4), (-3, -4), (0, 5), (5, 0), (0, -5), (-5, 0)):
            value, gradient = both(
                jnp.asarray(y * size, dtype), jnp.asarray(x * size, dtype)
            )
            np.testing.assert_allclose(value, np.arctan2(y, x), rtol=ulps(dtype, 2))
            expected = np.array([x, -y]) / (25 * size)
            np.testing.assert_allclose(
                np.array(gradient, float), expected, rtol=ulps(dtype, 8), atol=0
            )


# --- functions of a square
# --------------------------------------------------------------------

EVEN = {
    "cos_sqrt": (cos_sqrt, lambda r: mpmath.cos(r)),
    "sinc_sqrt": (sinc_sqrt, lambda r: mpmath.sin(r) / r if r else mpmath.mpf(1)),
    "arctanc_sqrt": (
        arctanc_sqrt,
        lambda r: mpmath.atan(r) / r if r else mpmath.mpf(1),
    ),
}
SEAMS = {"cos_sqrt": 0.5, "sinc_sqrt": 0.5, "arctanc_sqrt": 0.2}
# A derivative divides differences of the closed form by the seam: so many ulps at each
# order.
ULPS_BY_ORDER = (3, 16, 256, 4096)


def points_of(seam, dtype):
    seam = dtype(seam)
    beside = [np.nextafter(seam, dtype(0)), seam, np.nextafter(seam, dtype(1))]
    small = [0.0, 1e-300, 1e-16, 1e-8, 1e-4, 0.01, 0.1, 0.19]
    return np.array([*small, *beside, 0.3, 0.7, 1.0, 2.4, np.pi**2 / 4], dtype)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", EVEN)
def test_even_function_and_three_derivatives_are_seamless(name, dtype):
    function, reference = EVEN[name]
    points = points_of(SEAMS[name], dtype)
    found = np.asarray(derivatives(function)(jnp.asarray(points)))
    assert found.dtype == dtype
    with mpmath.workdps(40):
        for order, allowed in enumerate(ULPS_BY_ORDER):
            series = _taylor_at_zero(name, order)
            for z, value in zip(points, found[order], strict=True):
                even = lambda u: reference(mpmath.sqrt(u))  # noqa: E731
                exact = (
                    series
                    if z < 1e-30
                    else mpmath.diff(even, mpmath.mpf(float(z)), order)
                )
                scale = abs(float(series))
                error = abs(float(value) - float(exact)) / (
                    scale * float(np.finfo(dtype).eps)
                )
                assert error <= allowed, (order, z, error)


def _taylor_at_zero(name, order):
    """The derivative at zero: k! times the coefficient of z^k."""
    k = order
    coefficient = {
        "cos_sqrt": 1 / mpmath.factorial(2 * k),
        "sinc_sqrt": 1 / mpmath.factorial(2 * k + 1),
        "arctanc_sqrt": mpmath.mpf(1) / (2 * k + 1),
    }[name]
    return (-1) ** k * mpmath.factorial(k) * coefficient


@pytest.mark.parametrize("name", EVEN)
def test_even_function_far_from_the_seam(name):
    function, reference = EVEN[name]
    points = np.array([5.0, 30.0, 1e3, 1e6])
    exact = [float(reference(mpmath.sqrt(float(z)))) for z in points]
    # the argument's own last bit turns the angle by half of sqrt(z) eps
    slack = ulps(float, 2) * (1 + np.sqrt(points) * (name != "arctanc_sqrt"))
    assert np.all(np.abs(np.asarray(function(jnp.asarray(points))) - exact) <= slack)
