import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ATTITUDE, DTYPES, MOMENTS, OMEGA, TENSOR, ulps

import jrigid as jr
from jrigid import rotation as ro

TORQUE = np.array([0.4, -0.7, 0.2])
# Positive moments that no real body has; classic test problems use such.
BREAKS_THE_TRIANGLE = np.array([1.0, 2.0, 8.0])
BODIES = {
    "tensor": TENSOR,
    "moments": MOMENTS,
    "symmetric": np.array([1.0, 1.0, 1.5]),
    "breaks the triangle": BREAKS_THE_TRIANGLE,
}


def matrix_of(inertia):
    return np.diag(inertia) if inertia.ndim == 1 else inertia


@jax.jit
def everything(inertia, omega, torque):
    return {
        "momentum": jr.angular_momentum(inertia, omega),
        "energy": jr.kinetic_energy(inertia, omega),
        "rate": jr.euler_equations(inertia, omega, torque),
        "free rate": jr.euler_equations(inertia, omega),
        "bearing": jr.bearing_torque(inertia, omega),
    }


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", BODIES)
def test_against_numpy(name, dtype):
    inertia, omega, torque = (x.astype(dtype) for x in (BODIES[name], OMEGA, TORQUE))
    found = everything(inertia, omega, torque)
    matrix = matrix_of(inertia.astype(float))
    omega, torque = omega.astype(float), torque.astype(float)
    momentum = matrix @ omega
    expected = {
        "momentum": momentum,
        "energy": omega @ momentum / 2,
        "rate": np.linalg.solve(matrix, torque - np.cross(omega, momentum)),
        "free rate": np.linalg.solve(matrix, -np.cross(omega, momentum)),
        "bearing": np.cross(omega, momentum),
    }
    for key, value in found.items():
        assert value.dtype == dtype
        np.testing.assert_allclose(
            value, expected[key], atol=ulps(dtype, 16), err_msg=key
        )


@pytest.mark.parametrize("name", BODIES)
def test_angular_momentum_in_space_changes_at_the_rate_of_the_torque(name):
    """d/dt (R I R^T omega_space) = R N along attitude and rate that follow the
    equations."""
    inertia = BODIES[name]

    @jax.jit
    def rate_of_momentum(q, omega, torque):
        def momentum(q, omega):
            r = ro.to_matrix(q)
            return r @ matrix_of(inertia) @ r.T @ (r @ omega)

        rates = ro.attitude_rate(q, omega), jr.euler_equations(inertia, omega, torque)
        return jax.jvp(momentum, (q, omega), rates)[1], ro.rotate(q, torque)

    found, expected = rate_of_momentum(ATTITUDE, OMEGA, TORQUE)
    np.testing.assert_allclose(found, expected, atol=ulps(float, 32))
    free, _ = rate_of_momentum(ATTITUDE, OMEGA, np.zeros(3))
    np.testing.assert_allclose(free, np.zeros(3), atol=ulps(float, 32))


@pytest.mark.parametrize("name", BODIES)
def test_energy_changes_at_the_power_of_the_torque_and_poinsots_invariants_do_not(name):
    inertia = BODIES[name]

    @jax.jit
    def rates(omega, torque):
        invariants = lambda w: (  # noqa: E731
            jr.kinetic_energy(inertia, w),
            jnp.sum(jr.angular_momentum(inertia, w) ** 2),
        )
        driven = jax.jvp(
            invariants, (omega,), (jr.euler_equations(inertia, omega, torque),)
        )
        free = jax.jvp(invariants, (omega,), (jr.euler_equations(inertia, omega),))
        return driven[1], free[1]

    (power, _), (energy, momentum) = rates(OMEGA, TORQUE)
    np.testing.assert_allclose(power, TORQUE @ OMEGA, atol=ulps(float, 16))
    scale = np.max(matrix_of(inertia))
    assert abs(energy) <= ulps(float, 8) * scale
    assert abs(momentum) <= ulps(float, 16) * scale**2


def test_moments_and_their_diagonal_tensor_agree():
    for moments in (MOMENTS, BREAKS_THE_TRIANGLE):
        for key, value in everything(np.diag(moments), OMEGA, TORQUE).items():
            expected = everything(moments, OMEGA, TORQUE)[key]
            np.testing.assert_allclose(
                value, expected, atol=ulps(float, 8), err_msg=key
            )


def test_a_body_in_turned_axes_moves_the_same_way():
    """Frame-independence: turning tensor, rate and torque together turns the answer."""
    r = np.asarray(ro.to_matrix(ATTITUDE))
    turned = r @ np.diag(MOMENTS) @ r.T
    own = everything(MOMENTS, OMEGA, TORQUE)
    other = everything((turned + turned.T) / 2, r @ OMEGA, r @ TORQUE)
    for key, value in own.items():
        expected = r @ value if value.shape else value
        np.testing.assert_allclose(
            other[key], expected, atol=ulps(float, 32), err_msg=key
        )


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_sphere_keeps_its_rate_exactly(dtype):
    moment = 0.4 * 1.3 * 0.7**2
    omega = jnp.asarray(1e3 * OMEGA, dtype)
    for sphere in (np.full(3, moment, dtype), moment * np.eye(3, dtype=dtype)):
        for turn in (jr.euler_equations, jax.jit(jr.euler_equations)):
            assert np.all(np.asarray(turn(sphere, omega)) == 0)
        assert np.all(np.asarray(jr.bearing_torque(sphere, omega)) == 0)


def test_bearings_bear_nothing_about_a_principal_axis_and_more_the_faster_the_wobble():
    for axis in np.eye(3):
        assert np.all(np.asarray(jr.bearing_torque(MOMENTS, 7 * axis)) == 0)
    # a disk on a shaft tilted by b: (I3 - I1) w^2 sin b cos b (Goldstein, 3rd ed.,
    # section 5.5)
    b, spin, disk = 0.2, 30.0, np.array([1.0, 1.0, 2.0])
    torque = jr.bearing_torque(disk, spin * np.array([np.sin(b), 0.0, np.cos(b)]))
    size = (2.0 - 1.0) * spin**2 * np.sin(b) * np.cos(b)
    np.testing.assert_allclose(torque, [0, -size, 0], rtol=ulps(float, 8))
    # the torque keeps the rotation steady
    held = jr.euler_equations(TENSOR, OMEGA, jr.bearing_torque(TENSOR, OMEGA))
    np.testing.assert_allclose(held, np.zeros(3), atol=ulps(float, 4))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("size", [1e-15, 1e15])
def test_a_tensor_of_any_size_neither_overflows_nor_underflows(size, dtype):
    """An asteroid's tensor in float32: products of three moments are out of range."""
    found = everything(
        (size * TENSOR).astype(dtype),
        OMEGA.astype(dtype),
        (size * TORQUE).astype(dtype),
    )
    expected = np.linalg.solve(TENSOR, TORQUE - np.cross(OMEGA, TENSOR @ OMEGA))
    np.testing.assert_allclose(found["rate"], expected, atol=ulps(dtype, 16))


def test_derivatives_at_the_sphere_and_at_equal_moments():
    """Where moments coincide and omega is of order one: polynomials over moments,
    no edge."""

    @jax.jit
    def jacobians(inertia):
        rate = lambda i: jr.euler_equations(i, OMEGA, TORQUE)  # noqa: E731
        return jax.jacfwd(rate)(inertia), jax.jacrev(rate)(inertia)

    def exact(moments, k, h=1e-30):
        """Derivative by a complex step of the written-out equations."""
        i = moments.astype(complex)
        i[k] += 1j * h
        w = OMEGA
        rate = (
            TORQUE
            + np.array(
                [
                    (i[1] - i[2]) * w[1] * w[2],
                    (i[2] - i[0]) * w[2] * w[0],
                    (i[0] - i[1]) * w[0] * w[1],
                ]
            )
        ) / i
        return rate.imag / h

    for moments in (np.ones(3), np.array([1.0, 1.0, 1.5]), np.array([2.0, 1.5, 1.5])):
        expected = np.stack([exact(moments, k) for k in range(3)], axis=1)
        for found in jacobians(moments):
            np.testing.assert_allclose(found, expected, atol=ulps(float, 8))
        along_the_diagonal = [
            np.einsum("aii->ai", x) for x in jacobians(np.diag(moments))
        ]
        for found in along_the_diagonal:
            np.testing.assert_allclose(found, expected, atol=ulps(float, 8))


def test_state_is_a_pytree_of_arrays():
    state = jr.State(
        np.array([1, 0, 0, 0]), np.array([1, 2, 3]), (jnp.ones(3), jnp.zeros(()))
    )
    assert state.omega.dtype == np.float64
    leaves, structure = jax.tree.flatten(state)
    assert [x.shape for x in leaves] == [(4,), (3,), (3,), ()]
    again = jax.tree.unflatten(structure, leaves)
    assert jax.tree.structure(again) == structure
    assert jr.State(ATTITUDE, OMEGA).internal is None
    assert (
        jr.State(np.float32(ATTITUDE), np.float32(OMEGA)).attitude.dtype == np.float32
    )
    lanes = jax.vmap(lambda w: jr.State(jnp.asarray(ATTITUDE), w))(jnp.ones((5, 3)))
    assert lanes.attitude.shape == (5, 4)


FOUR, LANES = np.ones(4), np.ones((5, 3))
WRONG_SHAPES = {
    "momentum": (
        lambda: jr.angular_momentum(FOUR, OMEGA),
        r"`inertia` must have shape \(3,\) or \(3, 3\), but it has shape \(4,\)",
    ),
    "energy": (
        lambda: jr.kinetic_energy(MOMENTS, LANES),
        r"`omega` must have shape \(3,\), but it has shape \(5, 3\)",
    ),
    "rate": (lambda: jr.euler_equations(LANES, OMEGA), r"`inertia` must .* \(5, 3\)"),
    "torque": (
        lambda: jr.euler_equations(MOMENTS, OMEGA, FOUR),
        r"`torque` must have shape \(3,\), but it has shape \(4,\)",
    ),
    "bearing": (
        lambda: jr.bearing_torque(MOMENTS, FOUR),
        r"`omega` must have shape \(3,\), but",
    ),
}


@pytest.mark.parametrize("name", WRONG_SHAPES)
def test_wrong_shape_is_an_error(name, untyped):
    call, message = WRONG_SHAPES[name]
    with pytest.raises(ValueError, match="Argument " + message):
        call()
