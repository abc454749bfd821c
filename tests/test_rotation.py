import itertools
import math

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.spatial
import scipy.stats
from helpers import (
    ATTITUDE,
    DTYPES,
    MOMENTS,
    OMEGA,
    quick_jit,
    reference_attitude,
    ulps,
)
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid import rotation as ro

AXIS = np.array([2.0, -3.0, 6.0]) / 7
ANGLES = [0.0, 1e-300, 1e-16, 1e-12, 1e-8, 1e-4, 1.0, np.pi - 1e-8, np.pi]
DEGENERATE = [0.0, 1e-300, 1e-16, 1e-8, 1e-4]


def scipy_rotation(q):
    return Rotation.from_quat(np.roll(np.asarray(q, float), -1, axis=-1))


def same_attitude(p, q):
    """Largest component of the difference, the sign of one of them chosen."""
    p, q = np.asarray(p, float), np.asarray(q, float)
    sign = np.where(np.sum(p * q, axis=-1, keepdims=True) < 0, -1, 1)
    return np.max(np.abs(p - sign * q))


def unit(*components):
    components = np.asarray(components, float)
    return components / np.linalg.norm(components)


# --- group axioms
# -----------------------------------------------------------------------------

angles = st.one_of(
    st.sampled_from([*ANGLES, *(-a for a in ANGLES)]), st.floats(-np.pi, np.pi)
)
directions = st.tuples(*(st.integers(-9, 9),) * 3).filter(any).map(lambda v: unit(*v))
rotations = st.builds(lambda axis, angle: axis * angle, directions, angles)
axioms_of = settings(
    derandomize=True,
    max_examples=60,
    deadline=None,
    database=None,
    phases=[Phase.generate],
)


@jax.jit
def axioms(u, v, w, x):
    """Residuals of the axioms of SO(3) for attitudes exp(u), exp(v),
    exp(w) and a vector x."""
    p, q, r = ro.exp(u), ro.exp(v), ro.exp(w)
    one = ro.identity(p.dtype)
    pq = ro.multiply(p, q)
    m = ro.to_matrix(p)
    return {
        "unit": jnp.sum(p * p) - 1,
        "product is unit": jnp.sum(pq * pq) - 1,
        "associative": ro.multiply(pq, r) - ro.multiply(p, ro.multiply(q, r)),
        "identity": ro.multiply(p, one) - p + ro.multiply(one, q) - q,
        "inverse": ro.multiply(p, ro.conjugate(p)) - one,
        "inverse of any": ro.multiply(ro.inverse(3 * p), 3 * p) - one,
        "inverse of a product": ro.conjugate(pq)
        - ro.multiply(ro.conjugate(q), ro.conjugate(p)),
        "acts": ro.rotate(pq, x) - ro.rotate(p, ro.rotate(q, x)),
        "inverse acts": ro.rotate_inverse(p, ro.rotate(p, x)) - x,
        "keeps lengths": jnp.sum(ro.rotate(p, x) ** 2) - jnp.sum(x * x),
        "covers twice": ro.rotate(-p, x) - ro.rotate(p, x),
        "homomorphism": ro.to_matrix(pq) - m @ ro.to_matrix(q),
        "orthogonal": m.T @ m - jnp.eye(3, dtype=m.dtype),
        "right-handed": jnp.linalg.det(m) - 1,
        "log after exp": ro.exp(ro.log(p)) - jnp.where(p[0] < 0, -p, p),
        "log of minus": jnp.where(pq[0] == 0, 0.0, ro.log(-pq) - ro.log(pq)),
        "from after to matrix": ro.to_matrix(ro.from_matrix(m)) - m,
        "from after to euler": ro.to_matrix(ro.from_euler(ro.to_euler(pq)))
        - ro.to_matrix(pq),
        "slerp ends": jnp.concatenate(
            [
                ro.slerp(p, q, 0) - p,
                ro.to_matrix(ro.slerp(p, q, 1))[0] - ro.to_matrix(q)[0],
            ]
        ),
        "from after to roll, pitch and yaw": ro.to_matrix(
            ro.from_roll_pitch_yaw(ro.to_roll_pitch_yaw(pq))
        )
        - ro.to_matrix(pq),
        "adjoint": ro.hat(ro.rotate(p, x)) - m @ ro.hat(x) @ m.T,
        "distance is symmetric": ro.angle_between(p, q) - ro.angle_between(q, p),
        "distance is invariant": jnp.abs(
            ro.angle_between(ro.multiply(r, p), ro.multiply(r, q))
            - ro.angle_between(p, q)
        )
        * jnp.minimum(1, ro.angle_between(p, q)),
    }


@pytest.mark.parametrize("dtype", DTYPES)
@axioms_of
@given(u=rotations, v=rotations, w=rotations)
def test_group_axioms(dtype, u, v, w):
    arrays = [jnp.asarray(a, dtype) for a in (u, v, w, OMEGA)]
    for name, residual in axioms(*arrays).items():
        assert residual.dtype == dtype
        if name == "log of minus" and not np.all(np.abs(residual) < 1e-3):
            # beside the half turn, where rounding decides which of its two vectors it
            # is
            np.testing.assert_allclose(np.linalg.norm(residual), 2 * np.pi, atol=1e-3)
            continue
        assert np.max(np.abs(residual)) <= ulps(dtype, 20), (name, residual)


# --- values against scipy and mpmath
# ----------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("angle", ANGLES)
def test_exp_and_log_in_ulps(angle, dtype):
    for axis in (AXIS, np.array([1.0, 0, 0]), np.array([0, 0, -1.0])):
        vector = (axis * angle).astype(dtype)
        with mpmath.workdps(50):
            v = [mpmath.mpf(float(c)) for c in vector]
            half = mpmath.sqrt(sum(c * c for c in v)) / 2
            sinc = mpmath.sin(half) / half if half else mpmath.mpf(1)
            exact = np.array(
                [float(c) for c in (mpmath.cos(half), *(sinc * c / 2 for c in v))]
            )
        q = np.asarray(ro.exp(jnp.asarray(vector)))
        assert q.dtype == dtype
        # each component to ulps of itself, cos(angle / 2) near the half turn to ulps of
        # 1
        np.testing.assert_allclose(q[1:], exact[1:], rtol=ulps(dtype, 4), atol=0)
        np.testing.assert_allclose(q[0], exact[0], rtol=0, atol=ulps(dtype, 2))
        back = np.asarray(ro.log(jnp.asarray(q)))
        if angle >= 3.14 and np.linalg.norm(back + vector) < 1e-3:
            back = -back  # float32(pi) is more than a half turn
        np.testing.assert_allclose(
            back, vector, rtol=ulps(dtype, 4), atol=ulps(dtype, 4 * angle)
        )
        again = np.asarray(ro.log(-jnp.asarray(q)))
        np.testing.assert_allclose(np.abs(again), np.abs(back), rtol=ulps(dtype, 4))
        length = float(
            ro.angle_between(jnp.asarray([1, 0, 0, 0], dtype), jnp.asarray(q))
        )
        np.testing.assert_allclose(
            length, math.hypot(*vector.astype(float)), rtol=ulps(dtype, 4), atol=0
        )


def test_log_is_a_logarithm_whatever_the_norm():
    q = 3.7 * ATTITUDE
    expected = scipy_rotation(q).as_rotvec()
    np.testing.assert_allclose(ro.log(q), expected, rtol=ulps(float, 8))
    np.testing.assert_allclose(ro.log(-q), expected, rtol=ulps(float, 8))


def test_against_scipy_rotation():
    random = np.random.default_rng(3)
    near = [np.concatenate([[1.0], 1e-9 * AXIS]), np.concatenate([[1e-9], AXIS])]
    axes = np.eye(4)
    qs = np.stack([*random.normal(size=(40, 4)), *near, *axes])
    qs /= np.linalg.norm(qs, axis=1, keepdims=True)
    ps = qs[::-1]
    vectors = random.normal(size=(len(qs), 3))
    p, q = scipy_rotation(ps), scipy_rotation(qs)

    @jax.jit
    @jax.vmap
    def ours(p, q, v):
        return {
            "matrix": ro.to_matrix(q),
            "from matrix": ro.from_matrix(ro.to_matrix(q)),
            "rotate": ro.rotate(q, v),
            "inverse": ro.rotate_inverse(q, v),
            "unscaled": ro.rotate(3 * q, v),
            "product": ro.to_matrix(ro.multiply(p, q)),
            "angle": ro.angle_between(p, q),
            "log": ro.exp(ro.log(q)),
            "exp": ro.to_matrix(ro.exp(v)),
            "hat": ro.hat(v),
            "axis and angle": ro.to_matrix(ro.from_axis_angle(2 * v, q[0])),
            "scipy": ro.to_scipy(q),
            "back": ro.from_scipy(ro.to_scipy(q)),
        }

    found = {name: np.asarray(value) for name, value in ours(ps, qs, vectors).items()}
    along = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    expected = {
        "matrix": q.as_matrix(),
        "rotate": q.apply(vectors),
        "inverse": q.inv().apply(vectors),
        "unscaled": q.apply(vectors),
        "product": (p * q).as_matrix(),
        "angle": (p.inv() * q).magnitude(),
        "exp": Rotation.from_rotvec(vectors).as_matrix(),
        "axis and angle": Rotation.from_rotvec(along * qs[:, :1]).as_matrix(),
        "scipy": q.as_quat(),
        "back": qs,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(
            found[name], value, atol=ulps(float, 24), err_msg=name
        )
    assert same_attitude(found["from matrix"], qs) < ulps(float, 8)
    assert np.all(found["from matrix"][:, 0] >= 0)
    assert same_attitude(found["log"], qs) < ulps(float, 8)
    np.testing.assert_array_equal(
        np.einsum("nij,nj->ni", found["hat"], along), np.cross(vectors, along)
    )
    for generator, rotation in zip(found["hat"], found["exp"], strict=True):
        np.testing.assert_allclose(
            scipy.linalg.expm(generator), rotation, atol=ulps(float, 40)
        )


def test_quaternion_algebra_is_hamiltons():
    one, i, j, k = jnp.eye(4)
    products = {
        (1, 1): -one,
        (2, 2): -one,
        (3, 3): -one,
        (1, 2): k,
        (2, 3): i,
        (3, 1): j,
    }
    basis = (one, i, j, k)
    for (a, b), expected in products.items():
        np.testing.assert_array_equal(ro.multiply(basis[a], basis[b]), expected)
        if a != b:
            np.testing.assert_array_equal(ro.multiply(basis[b], basis[a]), -expected)
    np.testing.assert_array_equal(ro.conjugate(ATTITUDE), ATTITUDE * [1, -1, -1, -1])


def test_vee_takes_the_antisymmetric_part():
    matrix = np.arange(9.0).reshape(3, 3) ** 2
    np.testing.assert_array_equal(ro.hat(ro.vee(matrix)), (matrix - matrix.T) / 2)


def test_a_matrix_at_a_half_turn_gives_a_positive_largest_component():
    for axis in (*np.eye(3), unit(1, -2, 2), unit(-3, 1, -1), unit(-1, -1, 1)):
        q = np.asarray(ro.from_matrix(2 * np.outer(axis, axis) - np.eye(3)))
        assert q[0] == 0
        largest = np.argmax(np.abs(axis))
        assert q[1 + largest] > 0
        np.testing.assert_allclose(
            q[1:], axis * np.sign(axis[largest]), atol=ulps(float, 4)
        )


NO_ROTATIONS = {
    "reflection": np.diag([1.0, 1.0, -1.0]),
    "inversion": -np.eye(3),
    "zero": np.zeros((3, 3)),
    "stretched": 1.01 * np.eye(3),
    "sheared": np.eye(3) + 0.01 * np.eye(3, k=1),
    "NaN": np.full((3, 3), np.nan),
    "infinite": np.diag([np.inf, 1.0, 1.0]),
}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", NO_ROTATIONS)
def test_a_matrix_that_is_no_rotation_gives_nan(name, dtype):
    assert np.all(np.isnan(ro.from_matrix(NO_ROTATIONS[name].astype(dtype))))


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_matrix_typed_with_four_digits_is_a_rotation(dtype):
    matrix = np.round(np.asarray(ro.to_matrix(ATTITUDE)), 4).astype(dtype)
    np.testing.assert_allclose(ro.from_matrix(matrix), ATTITUDE, atol=2e-4)


def test_matrices_that_are_no_rotations_leave_other_lanes_and_shared_slopes_alone():
    good = np.asarray(ro.to_matrix(ATTITUDE))
    lanes = jnp.stack([good, *NO_ROTATIONS.values(), good])
    alone = [0, len(lanes) - 1]

    def total(vector, lanes):
        attitudes = jax.vmap(lambda x: ro.from_matrix(x + ro.hat(vector)))(lanes)
        return jnp.nansum(attitudes), attitudes

    slopes = quick_jit(jax.grad(total, has_aux=True))
    found, attitudes = slopes(jnp.zeros(3), lanes)
    expected, of_good = slopes(jnp.zeros(3), lanes[np.array(alone)])
    bad = np.delete(np.arange(len(lanes)), alone)
    assert np.all(np.isnan(attitudes[bad]))
    np.testing.assert_allclose(attitudes[np.array(alone)], of_good, atol=1e-15)
    np.testing.assert_allclose(found, expected, atol=1e-14)


@pytest.mark.parametrize("dtype", DTYPES)
def test_normalize_and_the_zero_quaternion(dtype):
    tiny, large = float(np.finfo(dtype).tiny), float(np.finfo(dtype).max)
    for size in (64 * tiny, 1.0, large / 64):
        q = ro.normalize(jnp.asarray(np.array([1, -1, 3, 5]) * size, dtype))
        np.testing.assert_allclose(q, np.array([1, -1, 3, 5]) / 6, rtol=ulps(dtype, 4))
    zero = jnp.zeros(4, dtype)
    assert np.all(np.asarray(ro.normalize(zero)) == 0)
    for derivative in (jax.jacfwd, jax.jacrev):
        assert np.all(np.asarray(derivative(ro.normalize)(zero)) == 0)
    projector = np.eye(4) - np.outer(ATTITUDE, ATTITUDE)
    for derivative in (jax.jacfwd, jax.jacrev):
        found = derivative(ro.normalize)(jnp.asarray(2 * ATTITUDE, dtype))
        np.testing.assert_allclose(found, projector / 2, atol=ulps(dtype, 4))


def test_axis_and_angle_about_no_axis_is_the_identity_with_gradient_zero_in_the_axis():
    zero = jnp.zeros(3)
    for angle in (0.0, 0.7, np.pi):
        assert same_attitude(ro.from_axis_angle(zero, angle), [1, 0, 0, 0]) == 0
        for derivative in (jax.jacfwd, jax.jacrev):
            found = derivative(ro.from_axis_angle, (0, 1))(zero, jnp.asarray(angle))
            assert np.all(np.asarray(found[0]) == 0)
            assert np.all(np.isfinite(found[1]))
    np.testing.assert_allclose(
        ro.from_axis_angle(-3 * np.eye(3)[2], 2.0),
        [np.cos(1), 0, 0, -np.sin(1)],
        rtol=ulps(float, 2),
    )


def sizes(dtype):
    """Norms over nearly all of the range of a dtype;
    squares of most of them are out of it."""
    tiny, most = float(np.finfo(dtype).tiny), float(np.finfo(dtype).max)
    return [
        256 * tiny,
        tiny**0.9,
        tiny**0.55,
        tiny**0.3,
        1.0,
        most**0.3,
        most**0.55,
        most / 256,
    ]


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_norm_drops_out_whatever_it_is(dtype):
    vector = jnp.asarray(OMEGA, dtype)
    other = jnp.asarray([0.1, 0.8, -0.3, 0.5], dtype)

    @jax.jit
    @jax.vmap
    def everything(q):
        return {
            "rotate": ro.rotate(q, vector),
            "inverse": ro.rotate_inverse(q, vector),
            "matrix": ro.to_matrix(q),
            "log": ro.log(q),
            "angle": ro.angle_between(q, other),
            "angle to the same": ro.angle_between(other, q),
            "angles": ro.to_euler(q),
            "unit": ro.normalize(q),
            "axis": ro.from_axis_angle(q[1:], jnp.asarray(1.3, dtype)),
        }

    found = everything(
        np.stack([size * ATTITUDE for size in sizes(dtype)]).astype(dtype)
    )
    for name, values in found.items():
        values = np.asarray(values)
        expected = np.broadcast_to(values[4], values.shape)
        np.testing.assert_allclose(values, expected, atol=ulps(dtype, 8), err_msg=name)


OF_ANY_NORM = {
    "rotate": lambda q: ro.rotate(q, OMEGA.astype(q.dtype)),
    "log": ro.log,
    "normalize": ro.normalize,
    "euler": ro.to_euler,
    "axis": lambda q: ro.from_axis_angle(q[1:], jnp.asarray(1.3, q.dtype)),
}


@pytest.mark.parametrize("name", OF_ANY_NORM)
@pytest.mark.parametrize("dtype", DTYPES)
def test_derivatives_go_as_powers_of_the_norm_whatever_it_is(dtype, name):
    function = OF_ANY_NORM[name]
    first = jax.jit(
        jax.vmap(lambda q: (jax.jacfwd(function)(q), jax.jacrev(function)(q)))
    )
    second = jax.jit(jax.vmap(jax.jacfwd(jax.jacrev(function))))
    powers = {1: sizes(dtype)[1:-1], 2: [x**0.5 for x in sizes(dtype)[1:-1]]}
    q = {
        k: np.stack([x * ATTITUDE for x in (1.0, *powers[k])]).astype(dtype)
        for k in (1, 2)
    }
    for k, found in ((1, first(q[1])), (2, (second(q[2]),))):
        for derivative in found:
            # in two steps: the powers of the greatest norms are at the edge of the
            # range
            scaled = np.asarray(derivative, np.float64)
            for _ in range(k):
                size = np.array([1.0, *powers[k]]).reshape(-1, *[1] * (scaled.ndim - 1))
                scaled = scaled * size
            scale = np.max(np.abs(scaled[0]))
            expected = np.broadcast_to(scaled[0], scaled.shape)
            np.testing.assert_allclose(
                scaled, expected, rtol=0, atol=ulps(dtype, 32) * scale
            )


def test_a_body_turns_by_a_quaternion_of_any_norm():
    body = jr.solids.box(1.0, np.array([1.0, 2.0, 3.0])).translated(OMEGA)
    expected = body.rotated(ATTITUDE)
    for size in (1e-300, 1e-170, 1e170, 1e300):
        turned = body.rotated(size * ATTITUDE)
        np.testing.assert_allclose(
            turned.inertia, expected.inertia, atol=ulps(float, 16)
        )
        np.testing.assert_allclose(
            turned.center_of_mass, expected.center_of_mass, atol=1e-15
        )


# --- z-x-z Euler angles
# -----------------------------------------------------------------------


def rz(a):
    return np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])


def rx(a):
    return np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])


EULER = [
    np.array([phi, theta, psi])
    for phi, theta, psi in itertools.product(
        (-3.0, -0.4, 0.0, 2.1), (1e-8, 0.3, 1.5, np.pi - 1e-6), (-2.6, 0.0, 0.9, 3.1)
    )
]


def test_euler_angles_are_z_x_z():
    @jax.jit
    @jax.vmap
    def both(angles):
        q = ro.from_euler(angles)
        return ro.to_matrix(q), ro.to_euler(q)

    matrices, back = both(np.stack(EULER))
    for (phi, theta, psi), matrix in zip(EULER, matrices, strict=True):
        np.testing.assert_allclose(
            matrix, rz(phi) @ rx(theta) @ rz(psi), atol=ulps(float, 4)
        )
    expected = Rotation.from_euler("ZXZ", np.stack(EULER)).as_matrix()
    np.testing.assert_allclose(matrices, expected, atol=ulps(float, 8))
    # phi - psi (or phi + psi at the other pole) carries the rounding over sin theta
    np.testing.assert_allclose(back, np.stack(EULER), rtol=0, atol=ulps(float, 16))


@pytest.mark.parametrize("dtype", DTYPES)
def test_euler_angles_at_the_poles_choose_psi_zero(dtype):
    for turn in (-2.0, -0.3, 0.0, 1.4, 3.0):
        upright = jnp.asarray([np.cos(turn / 2), 0, 0, np.sin(turn / 2)], dtype)
        inverted = jnp.asarray([0, np.cos(turn / 2), np.sin(turn / 2), 0], dtype)
        for q, theta in (
            (upright, 0.0),
            (inverted, np.pi),
            (-upright, 0.0),
            (-inverted, np.pi),
        ):
            found = ro.to_euler(q)
            assert found.dtype == dtype
            np.testing.assert_allclose(found, [turn, theta, 0.0], atol=ulps(dtype, 4))
            assert found[2] == 0


def test_euler_rates_are_those_of_the_rotation():
    rates = np.array([0.7, -1.3, 2.1])

    @jax.jit
    @jax.vmap
    def both(angles):
        matrix = lambda a: ro.to_matrix(ro.from_euler(a))  # noqa: E731
        r, dr = jax.jvp(matrix, (angles,), (jnp.asarray(rates),))
        omega = ro.euler_rates_to_omega(angles, rates)
        return r, dr, omega, ro.omega_to_euler_rates(angles, omega)

    r, dr, omega, back = (np.asarray(x) for x in both(np.stack(EULER)))
    for k, (_, theta, psi) in enumerate(EULER):
        skew = r[k].T @ dr[k]
        np.testing.assert_allclose(
            omega[k], skew[[2, 0, 1], [1, 2, 0]], atol=ulps(float, 16)
        )
        s, c = np.sin(psi), np.cos(psi)
        written_out = [
            rates[0] * np.sin(theta) * s + rates[1] * c,
            rates[0] * np.sin(theta) * c - rates[1] * s,
            rates[2] + rates[0] * np.cos(theta),
        ]
        np.testing.assert_allclose(omega[k], written_out, atol=ulps(float, 8))
        np.testing.assert_allclose(back[k], rates, atol=ulps(float, 16) / np.sin(theta))


@pytest.mark.parametrize("dtype", DTYPES)
def test_euler_rates_at_the_poles_are_those_of_the_choice(dtype):
    """psi' = 0, phi' takes the turning about the vertical;
    a tiny angle is not a pole."""
    omega = jnp.asarray([0.3, -0.2, 0.8], dtype)
    for theta, sign in ((0.0, 1), (np.pi, -1), (-np.pi, -1)):
        angles = jnp.asarray([0.4, theta, 1.1], dtype)
        expected = [sign * 0.8, 0.3 * np.cos(1.1) + 0.2 * np.sin(1.1), 0]
        np.testing.assert_allclose(
            ro.omega_to_euler_rates(angles, omega), expected, atol=ulps(dtype, 4)
        )
        for derivative in (jax.jacfwd, jax.jacrev):
            found = derivative(ro.omega_to_euler_rates, (0, 1))(angles, omega)
            assert np.all(np.isfinite(found[0]))
            assert np.all(np.isfinite(found[1]))
    for theta in (1e-17, 1e-30):
        angles = jnp.asarray([0.4, theta, 1.1], dtype)
        horizontal = 0.3 * np.sin(1.1) - 0.2 * np.cos(1.1)
        found = ro.omega_to_euler_rates(angles, omega)
        np.testing.assert_allclose(found[0], horizontal / theta, rtol=ulps(dtype, 8))


# --- angular velocity
# -------------------------------------------------------------------------


def euler_motion(t):
    """Euler angles of a motion that nothing singles out."""
    return jnp.stack(
        [0.3 + 1.1 * t - 0.2 * t**2, 1.2 + 0.5 * jnp.sin(t), 0.4 - 0.7 * t + t**3 / 9]
    )


def motion(t):
    """Attitude and body rate of that motion, at any time."""
    angles, rates = jax.jvp(euler_motion, (t,), (jnp.ones_like(t),))
    return ro.from_euler(angles), ro.euler_rates_to_omega(angles, rates)


motions = jax.jit(jax.vmap(motion))


def test_angular_velocity_has_body_and_space_components():
    @jax.jit
    def everything(t):
        q, dq = jax.jvp(lambda t: motion(t)[0], (t,), (jnp.ones_like(t),))
        r, dr = jax.jvp(lambda t: ro.to_matrix(motion(t)[0]), (t,), (jnp.ones_like(t),))
        omega = ro.angular_velocity(r, dr)
        return q, dq, r, dr, omega, motion(t)[1], ro.hat(omega), ro.hat(r @ omega)

    q, dq, r, dr, omega, expected, hat, hat_in_space = everything(jnp.asarray(0.8))
    np.testing.assert_allclose(omega, expected, atol=ulps(float, 8))
    np.testing.assert_allclose(r.T @ dr, hat, atol=ulps(float, 8))
    np.testing.assert_allclose(dr @ r.T, hat_in_space, atol=ulps(float, 8))
    np.testing.assert_allclose(r @ hat, dr, atol=ulps(float, 8))
    np.testing.assert_allclose(ro.attitude_rate(q, omega), dq, atol=ulps(float, 8))
    pure = np.concatenate([[0.0], omega])
    np.testing.assert_allclose(
        ro.attitude_rate(q, omega), 0.5 * ro.multiply(q, pure), atol=ulps(float, 2)
    )


def test_rotation_is_the_time_ordered_exponential_with_new_increments_on_the_right():
    def error(count, newest_on_the_right):
        edges = np.linspace(0.0, 2.0, count + 1)
        _, omegas = motions((edges[1:] + edges[:-1]) / 2)
        (q0, q1), _ = motions(np.array([0.0, 2.0]))
        product = scipy_rotation(q0)
        for step in Rotation.from_rotvec(np.asarray(omegas) * 2.0 / count):
            product = product * step if newest_on_the_right else step * product
        return (scipy_rotation(q1).inv() * product).magnitude()

    coarse, fine = error(64, True), error(128, True)
    assert 3.9 < coarse / fine < 4.1
    assert fine < 1e-4
    assert error(128, False) > 0.1


# --- dead reckoning
# ---------------------------------------------------------------------------

integrate_rate = jax.jit(ro.integrate_rate)
CONE, CONING = 0.3, 2 * np.pi


def coning(t):
    """Attitude and body rate of classical coning: Euler angles (W t, cone, -W t)."""
    t = np.asarray(t)
    half = CONE / 2
    zero = np.zeros_like(t)
    attitude = np.stack(
        [
            zero + np.cos(half),
            np.sin(half) * np.cos(CONING * t),
            np.sin(half) * np.sin(CONING * t),
            zero,
        ],
        -1,
    )
    omega = CONING * np.stack(
        [
            -np.sin(CONE) * np.sin(CONING * t),
            np.sin(CONE) * np.cos(CONING * t),
            zero + np.cos(CONE) - 1,
        ],
        -1,
    )
    return attitude, omega


def dead_reckoning_error(ts, exact=coning):
    attitudes, omegas = exact(ts)
    found = integrate_rate(ts, omegas, attitudes[0])
    assert found.shape == attitudes.shape
    return (scipy_rotation(attitudes).inv() * scipy_rotation(found)).magnitude()


def test_dead_reckoning_of_coning_is_of_fourth_order():
    errors = [
        dead_reckoning_error(np.linspace(0, 2, n + 1))[-1] for n in (64, 128, 256)
    ]
    assert errors[-1] < 1e-6
    for coarse, fine in itertools.pairwise(errors):
        assert coarse / fine > 2**3.9
    # a coning-blind product of exponentials of the mean rate drifts by orders more
    _, omegas = coning(np.linspace(0, 2, 257))
    steps = Rotation.from_rotvec((omegas[1:] + omegas[:-1]) / 2 * 2 / 256)
    product = scipy_rotation(coning(0.0)[0])
    for step in steps:
        product = product * step
    drift = (scipy_rotation(coning(2.0)[0]).inv() * product).magnitude()
    assert drift > 300 * errors[-1]


def test_dead_reckoning_of_unevenly_sampled_rates_is_of_fourth_order():
    def uneven(count):
        s = np.linspace(0, 1, count + 1)
        jitter = (
            0.1
            / count
            * np.where((s > 0) & (s < 1), np.sin(1e3 * np.arange(count + 1)), 0)
        )
        return 2 * (s + 0.12 * np.sin(2 * np.pi * s) + jitter)

    errors = [np.max(dead_reckoning_error(uneven(n))) for n in (64, 128, 256)]
    assert errors[-1] < 5e-6
    for coarse, fine in itertools.pairwise(errors):
        assert coarse / fine > 2**3.7
    for n in (64, 128, 256):
        exact = lambda t: tuple(np.asarray(x) for x in motions(t))  # noqa: E731
        assert np.max(dead_reckoning_error(uneven(n), exact)) < 3.0 * (2 / n) ** 4


def test_dead_reckoning_of_short_records():
    axis = AXIS
    for count, power in ((2, 1), (3, 2), (4, 3)):
        ts = np.array([0.2, 0.5, 1.3, 1.6])[:count]
        rate = lambda t, power=power: (power + 1) * t**power  # noqa: E731
        turned = ts ** (power + 1) - ts[0] ** (power + 1)
        found = integrate_rate(ts, rate(ts)[:, None] * axis)
        expected = Rotation.from_rotvec(turned[:, None] * axis).as_matrix()
        np.testing.assert_allclose(
            scipy_rotation(found).as_matrix(), expected, atol=ulps(float, 32)
        )
    # two samples of a turning axis: omega is taken as linear in time, one step errs as
    # h^5
    linear = lambda t: np.array([1.0, 0.5, -0.3]) + np.array([-2.0, 0.7, 3.0]) * t  # noqa: E731
    errors = []
    for h in (0.2, 0.1):
        ts = np.array([0.0, h])
        found = integrate_rate(ts, np.stack([linear(t) for t in ts]))[-1]
        errors.append(same_attitude(found, reference_attitude(linear, ts)[-1]))
    assert errors[1] < 1e-6
    assert errors[0] / errors[1] > 2**4.5


def test_dead_reckoning_follows_a_tumbling_body():
    def rate(t, y):
        q, w = y[:4], y[4:]
        dw = np.cross(MOMENTS * w, w) / MOMENTS
        product = np.concatenate([[-q[1:] @ w], q[0] * w + np.cross(q[1:], w)])
        return np.concatenate([product / 2, dw])

    ts = np.linspace(0, 20, 1001)
    start = np.concatenate([ATTITUDE, OMEGA])
    solution = scipy.integrate.solve_ivp(
        rate, (0, 20), start, "DOP853", ts, rtol=1e-13, atol=1e-14
    )
    found = integrate_rate(ts, solution.y[4:].T, ATTITUDE)
    assert same_attitude(found, solution.y[:4].T) < 1e-8
    norms = np.sum(np.asarray(found) ** 2, axis=1)
    np.testing.assert_allclose(norms, 1, rtol=0, atol=ulps(float, 4))


def test_dead_reckoning_does_not_mind_an_epoch_far_from_zero():
    ts = np.arange(65) / 64  # exact at either epoch
    _, omegas = coning(ts)
    near, far = integrate_rate(ts, omegas), integrate_rate(ts + 2.0**30, omegas)
    np.testing.assert_allclose(far, near, atol=ulps(float, 8))
    # times at the resolution of the clock: what counts are the differences of the
    # floats given
    for dtype, epoch in ((np.float64, 1e9), (np.float32, 4e3)):
        late = (epoch + np.linspace(0, 0.64, 65)).astype(dtype)
        exact_times = (late - late[0]).astype(np.float64)
        attitudes, omegas = coning(exact_times)
        found = integrate_rate(late, omegas.astype(dtype), attitudes[0].astype(dtype))
        same = integrate_rate(
            exact_times.astype(dtype), omegas.astype(dtype), attitudes[0].astype(dtype)
        )
        assert found.dtype == dtype
        np.testing.assert_allclose(found, same, atol=ulps(dtype, 32))


def test_derivatives_of_dead_reckoning():
    ts = np.array([0.0, 0.1, 0.25, 0.3, 0.5])
    _, omegas = coning(ts)
    direction = np.random.default_rng(1).normal(size=omegas.shape)
    nudge = np.array([0.1, 0.4, -0.3, 0.2, 0.5])

    @jax.jit
    def final(omegas, ts):
        return ro.log(integrate_rate(ts, omegas, ATTITUDE)[-1])

    @quick_jit
    def both(omegas, ts):
        forward = jax.jvp(
            final, (omegas, ts), (jnp.asarray(direction), jnp.asarray(nudge))
        )[1]
        by_rates, by_times = jax.jacrev(final, (0, 1))(omegas, ts)
        return forward, jnp.einsum("ikj,kj->i", by_rates, direction) + by_times @ nudge

    forward, reverse = both(omegas, ts)
    h = 1e-5
    up = final(omegas + h * direction, ts + h * nudge)
    down = final(omegas - h * direction, ts - h * nudge)
    difference = (up - down) / (2 * h)
    np.testing.assert_allclose(forward, difference, atol=1e-9)
    np.testing.assert_allclose(forward, reverse, atol=ulps(float, 32))
    at_rest = both(np.zeros_like(omegas), ts)
    assert np.all(np.isfinite(at_rest))


TS = np.array([0.0, 0.1, 0.25, 0.3, 0.5])
RATES = np.stack([np.sin(3 * TS), 1 - TS, np.cos(TS)], axis=1)


def replaced(array, index, value):
    array = np.array(array)
    array[index] = value
    return array


BAD_RECORDS = {
    "repeated": (replaced(TS, 2, 0.1), RATES, ATTITUDE),
    "backwards": (TS[::-1].copy(), RATES, ATTITUDE),
    "nan time": (replaced(TS, 0, np.nan), RATES, ATTITUDE),
    "infinite time": (replaced(TS, 4, np.inf), RATES, ATTITUDE),
    "from -infinity": (replaced(TS, 0, -np.inf), RATES, ATTITUDE),
    "nan rate": (TS, replaced(RATES, (1, 2), np.nan), ATTITUDE),
    "inf rate": (TS, replaced(RATES, (4, 0), np.inf), ATTITUDE),
    "long": (TS, RATES, 1.001 * ATTITUDE),
    "zero": (TS, RATES, np.zeros(4)),
    "nan start": (TS, RATES, replaced(ATTITUDE, 1, np.nan)),
}


def test_bad_records_of_rates_are_nan_lanes_that_leave_the_others_alone():
    lanes = [(TS, RATES, ATTITUDE), *BAD_RECORDS.values()]
    batch = tuple(jnp.asarray(np.stack(x)) for x in zip(*lanes, strict=True))

    def total(ts, omegas, attitude0, shared):
        attitudes = jax.vmap(ro.integrate_rate)(ts, omegas + shared, attitude0)
        return jnp.nansum(jnp.sin(attitudes)), attitudes

    of_total = quick_jit(jax.value_and_grad(total, (0, 1, 2, 3), has_aux=True))
    (_, found), gradients = of_total(*batch, jnp.asarray(0.0))
    alike = (jnp.broadcast_to(x[0], x.shape) for x in batch)
    (_, good), expected = of_total(*alike, jnp.asarray(0.0))
    np.testing.assert_allclose(found[0], good[0], atol=ulps(float, 2))
    assert np.all(np.isnan(found[1:]))
    for of_lanes, of_good in zip(gradients[:3], expected[:3], strict=True):
        np.testing.assert_allclose(of_lanes[0], of_good[0], atol=ulps(float, 8))
        assert np.all(np.asarray(of_lanes[1:]) == 0)
    np.testing.assert_allclose(
        gradients[3], expected[3] / len(lanes), atol=ulps(float, 8)
    )
    assert np.all(np.isnan(ro.integrate_rate(*BAD_RECORDS["nan rate"])))  # eagerly too


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_start_rounded_to_its_dtype_is_a_unit_quaternion(dtype):
    start = (ATTITUDE * (1 + ulps(dtype, 60))).astype(dtype)
    record = TS.astype(dtype), RATES.astype(dtype), start
    assert integrate_rate(*record).dtype == dtype
    assert np.all(np.isfinite(integrate_rate(*record)))
    assert integrate_rate(*record[:2]).dtype == dtype
    assert np.all(np.isfinite(integrate_rate(*record[:2])))


# --- identity, inverse, interpolation, random attitudes
# ----------------------------------------

KEY = jax.random.key(3)


@pytest.mark.parametrize("dtype", DTYPES)
def test_identity_and_random_attitudes_are_of_the_dtype_asked_for(dtype):
    assert ro.identity(dtype).dtype == ro.random(KEY, dtype).dtype == dtype
    np.testing.assert_array_equal(ro.identity(dtype), [1, 0, 0, 0])
    assert ro.identity().dtype == ro.random(KEY).dtype == jnp.zeros(()).dtype
    assert (
        ro.multiply(np.float32(ATTITUDE), ro.identity(np.float32)).dtype == np.float32
    )


def test_random_attitudes_are_uniform_on_the_sphere_of_quaternions():
    count = 20_000
    q = np.asarray(jax.jit(jax.vmap(ro.random))(jax.random.split(KEY, count)))
    np.testing.assert_allclose(np.sum(q * q, axis=1), 1, atol=ulps(float, 4))
    sigma = count**-0.5
    # moments to the fourth of the uniform distribution: 0, 1/4, and 1/24 (1 + 2 delta)
    np.testing.assert_allclose(np.mean(q, axis=0), 0, atol=4 * 0.5 * sigma)
    np.testing.assert_allclose(q.T @ q / count, np.eye(4) / 4, atol=4 * 0.25 * sigma)
    squares = (q * q).T @ (q * q) / count
    np.testing.assert_allclose(squares, (1 + 2 * np.eye(4)) / 24, atol=4 * 0.15 * sigma)
    # the angle of a uniform rotation has the density (1 - cos) / pi
    angles = scipy_rotation(q).magnitude()
    expected = lambda a: (a - np.sin(a)) / np.pi  # noqa: E731
    assert scipy.stats.kstest(angles, expected).pvalue > 0.01


@pytest.mark.parametrize("dtype", DTYPES)
def test_inverse_of_a_quaternion_of_any_norm(dtype):
    far = np.finfo(dtype).maxexp // 2 - 8

    @jax.jit
    @jax.vmap
    def both(q):
        return ro.inverse(q), jax.jacfwd(ro.inverse)(q), jax.jacrev(ro.inverse)(q)

    norms = np.array([1.0, 3.0, 2.0**-far, 2.0**far])
    inverse, forward, reverse = both((norms[:, None] * ATTITUDE).astype(dtype))
    conjugate = ATTITUDE * [1, -1, -1, -1]
    signs = np.diag([1, -1, -1, -1])
    slope = signs - 2 * np.outer(conjugate, ATTITUDE)
    for k, norm in enumerate(norms):
        np.testing.assert_allclose(
            np.asarray(inverse[k], float) * norm, conjugate, atol=ulps(dtype, 4)
        )
        for jacobian in (forward, reverse):
            scaled = np.asarray(jacobian[k], float) * norm * norm
            np.testing.assert_allclose(scaled, slope, atol=ulps(dtype, 8))


NOT_ATTITUDES = [np.zeros(4), ATTITUDE * np.nan, ATTITUDE * np.inf]


def test_of_no_attitude_there_is_no_inverse_and_no_way_from_or_to_it():
    lanes = np.stack([ATTITUDE, *NOT_ATTITUDES])

    def all_three(shared):
        one = shared + unit(1, 2, 3, 4)
        return jnp.concatenate(
            [
                jax.vmap(lambda q: ro.inverse(q + shared))(lanes),
                jax.vmap(lambda q: ro.slerp(one, q, 0.3 + shared))(lanes),
                jax.vmap(lambda q: ro.slerp(q, one, 0.3 + shared))(lanes),
            ],
            axis=1,
        )

    def total(shared):
        found = all_three(shared)
        return jnp.nansum(found), found

    (_, found), slope = quick_jit(jax.value_and_grad(total, has_aux=True))(0.0)
    assert np.all(np.isfinite(found[0]))
    assert np.all(np.isnan(found[1:]))
    assert np.isfinite(slope)  # of what they share with a good lane


def test_slerp_is_scipys_along_the_shortest_arc():
    random = np.random.default_rng(5)
    p, q = random.normal(size=(2, 30, 4))
    q[:4] = -p[:4]  # the same attitude
    q[4:8] = -p[4:8] + 1e-9 * q[4:8]
    s = np.concatenate([np.linspace(0, 1, 20), random.uniform(-1, 2, 10)])
    found = jax.jit(jax.vmap(ro.slerp))(p, q, s)
    first, last = scipy_rotation(p), scipy_rotation(q)
    step = (first.inv() * last).as_rotvec()
    expected = first * Rotation.from_rotvec(s[:, None] * step)
    np.testing.assert_allclose(
        scipy_rotation(found).as_matrix(), expected.as_matrix(), atol=ulps(float, 32)
    )
    theirs = [
        scipy.spatial.transform.Slerp([0, 1], Rotation.concatenate([a, b]))(
            t
        ).as_matrix()
        for a, b, t in zip(first[:20], last[:20], s[:20], strict=True)
    ]
    np.testing.assert_allclose(
        scipy_rotation(found[:20]).as_matrix(), theirs, atol=ulps(float, 32)
    )
    np.testing.assert_allclose(np.sum(found * found, axis=1), 1, atol=ulps(float, 8))


@pytest.mark.parametrize("dtype", DTYPES)
def test_derivatives_of_slerp_at_equal_and_at_opposite_attitudes(dtype):
    """Along p exp(u) and p exp(v), both tangent at 0,
    slerp is p exp((1 - s) u + s v)."""
    p = jnp.asarray(ATTITUDE, dtype)

    def way(x):
        u, v, s = x[:3], x[3:6], x[6]
        return ro.slerp(ro.multiply(p, ro.exp(u)), -ro.multiply(p, ro.exp(v)), s)

    @quick_jit
    @jax.vmap
    def derivatives(x):
        first = jax.jacfwd(way)(x), jax.jacrev(way)(x)
        return *first, jax.jacfwd(jax.jacrev(way))(x) if dtype == np.float64 else first[
            0
        ]

    equal = np.array([0, 0, 0, 0, 0, 0, 0.3])
    opposite = np.concatenate([np.zeros(3), np.pi * AXIS, [0.3]])
    found = [
        np.asarray(x) for x in derivatives(np.stack([equal, opposite]).astype(dtype))
    ]
    assert all(np.all(np.isfinite(x)) for x in found)
    forward, reverse, second = found
    w, x, y, z = ATTITUDE
    generators = 0.5 * np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])
    for jacobian in (forward, reverse):
        expected = np.concatenate(
            [0.7 * generators, 0.3 * generators, np.zeros((4, 1))], axis=1
        )
        np.testing.assert_allclose(jacobian[0], expected, atol=ulps(dtype, 16))
        # half a turn apart the rate is half a turn about the axis, one way or the other
        rate = np.linalg.norm(generators @ (np.pi * AXIS))
        np.testing.assert_allclose(
            np.linalg.norm(jacobian[1, :, 6]), rate, rtol=ulps(dtype, 64)
        )
    if dtype == np.float32:
        return
    np.testing.assert_allclose(second[0, :, 3:6, 6], generators, atol=ulps(dtype, 32))
    for part, share in ((slice(0, 3), 0.7), (slice(3, 6), 0.3)):
        curvature = -ATTITUDE[:, None, None] * share**2 / 4 * np.eye(3)
        np.testing.assert_allclose(
            second[0, :, part, part], curvature, atol=ulps(dtype, 32)
        )


# --- roll, pitch and yaw
# ------------------------------------------------------------------------


def about(k, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.roll([[1, 0, 0], [0, c, -s], [0, s, c]], (k, k), (0, 1))


FLIGHT = [
    np.array(angles)
    for angles in itertools.product(
        (-3.0, -0.4, 0.0, 2.1),
        (1e-8 - np.pi / 2, -0.7, 0.0, 1.5),
        (-2.6, 0.0, 0.9, 3.1),
    )
]


def test_roll_pitch_and_yaw_are_z_y_x():
    @jax.jit
    @jax.vmap
    def both(angles):
        q = ro.from_roll_pitch_yaw(angles)
        return ro.to_matrix(q), ro.to_roll_pitch_yaw(3 * q)

    angles = np.stack(FLIGHT)
    matrices, back = both(angles)
    for (roll, pitch, yaw), matrix in zip(FLIGHT, matrices, strict=True):
        expected = about(2, yaw) @ about(1, pitch) @ about(0, roll)
        np.testing.assert_allclose(matrix, expected, atol=ulps(float, 4))
    expected = Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix()
    np.testing.assert_allclose(matrices, expected, atol=ulps(float, 8))
    # what is defined at the pole to ulps, its parts to the rounding over the cosine
    np.testing.assert_allclose(back[:, 1], angles[:, 1], atol=ulps(float, 16))
    cosine = np.cos(angles[:, 1])[:, None]
    assert np.all(np.abs(back - angles) * cosine <= ulps(float, 32))


@pytest.mark.parametrize("dtype", DTYPES)
def test_roll_is_zero_at_the_poles_of_pitch_and_gradients_are_finite(dtype):
    @quick_jit
    @jax.vmap
    def everything(q):
        angles = ro.to_roll_pitch_yaw
        return (
            angles(q),
            jax.jacfwd(angles)(q),
            jax.jacrev(angles)(q),
            jax.hessian(angles)(q),
        )

    poles = [
        (sign * np.pi / 2, yaw)
        for sign in (1, -1)
        for yaw in (-2.0, -0.3, 0.0, 1.4, 3.0)
    ]
    qs = np.stack(
        [ro.from_roll_pitch_yaw(np.array([0.0, *pole])) for pole in poles]
    ).astype(dtype)
    found, forward, reverse, second = everything(qs)
    np.testing.assert_allclose(found[:, 1:], poles, atol=ulps(dtype, 8))
    assert np.all(np.asarray(found[:, 0]) == 0)
    assert np.all(np.isfinite(second))
    for jacobian in (forward, reverse):
        assert np.all(np.isfinite(jacobian))
        assert np.all(np.asarray(jacobian[:, 1]) == 0)
        # yaw turns about the vertical, roll stays
        turning = np.stack(
            [np.asarray(ro.attitude_rate(q, ro.rotate_inverse(q, EZ))) for q in qs]
        )
        np.testing.assert_allclose(
            np.einsum("nij,nj->ni", jacobian, turning),
            np.broadcast_to([0, 0, 1], (len(qs), 3)),
            atol=ulps(dtype, 16),
        )


EZ = np.array([0.0, 0.0, 1.0], np.float32)


def test_derivatives_of_roll_pitch_and_yaw():
    """Both ways they are each other's inverse, and the rates are those of the
    textbook."""

    @quick_jit
    @jax.vmap
    def both(angles):
        q = ro.from_roll_pitch_yaw(angles)
        out = jax.jacfwd(ro.from_roll_pitch_yaw)(angles)
        return (
            q,
            out,
            jax.jacfwd(ro.to_roll_pitch_yaw)(q),
            jax.jacrev(ro.to_roll_pitch_yaw)(q),
        )

    angles = np.stack([a for a in FLIGHT if abs(a[1]) < 1.5])
    q, out, forward, reverse = (np.asarray(x) for x in both(angles))
    for k, (roll, pitch, _) in enumerate(angles):
        for back in (forward, reverse):
            np.testing.assert_allclose(
                back[k] @ out[k], np.eye(3), atol=ulps(float, 64)
            )
            np.testing.assert_allclose(
                back[k] @ q[k], np.zeros(3), atol=ulps(float, 64)
            )
        # omega of unit rates of roll, pitch and yaw (Stevens and Lewis, eq. 1.3-22)
        s, c = np.sin(roll), np.cos(roll)
        omega = [
            [1, 0, -np.sin(pitch)],
            [0, c, s * np.cos(pitch)],
            [0, -s, c * np.cos(pitch)],
        ]
        w, x, y, z = q[k]
        generators = 0.5 * np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])
        np.testing.assert_allclose(out[k], generators @ omega, atol=ulps(float, 8))


# --- scipy's rotations
# --------------------------------------------------------------------------


def test_from_scipy_takes_a_rotation_itself():
    rotation = Rotation.from_euler("ZYX", [0.3, -0.2, 0.9])
    found = ro.from_scipy(rotation)
    np.testing.assert_array_equal(found, ro.from_scipy(rotation.as_quat()))
    np.testing.assert_allclose(
        ro.to_matrix(found), rotation.as_matrix(), atol=ulps(float, 4)
    )
    again = Rotation.from_quat(ro.to_scipy(found))
    np.testing.assert_allclose(
        again.as_matrix(), rotation.as_matrix(), atol=ulps(float, 4)
    )


@pytest.mark.parametrize(
    ("wrong", "kind"),
    [
        (Rotation.from_rotvec(np.ones((2, 3))), r"of shape \(2, 4\)"),
        (np.ones(3), r"of shape \(3,\)"),
        ("xyz", "str"),
        (None, "NoneType"),
        (object(), "object"),
    ],
)
def test_from_scipy_of_anything_else_says_what_it_takes(wrong, kind, untyped):
    taken = (
        "`rotation` must be a single scipy.spatial.transform.Rotation or a quaternion "
    )
    with pytest.raises(
        ValueError, match=rf"{taken}\(x, y, z, w\) .*, but it is {kind}"
    ):
        ro.from_scipy(wrong)


@pytest.mark.parametrize("dtype", DTYPES)
def test_log_and_angle_at_the_zero_quaternion_are_zero_with_gradient_zero(dtype):
    zero, q = np.zeros(4, dtype), ATTITUDE.astype(dtype)

    @quick_jit
    def everything(zero, q):
        values = ro.log(zero), ro.angle_between(zero, q), ro.angle_between(q, zero)
        derivatives = [d(ro.log)(zero) for d in (jax.jacfwd, jax.jacrev, jax.hessian)]
        derivatives += [
            d(ro.angle_between, (0, 1))(zero, q) for d in (jax.jacfwd, jax.jacrev)
        ]
        return values, derivatives

    for x in jax.tree.leaves(everything(zero, q)):
        assert np.all(np.asarray(x) == 0)


# --- derivatives at degenerate points
# ---------------------------------------------------------


def mp_jacobian(function, point, order=1):
    """All partial derivatives of one order of an R^n -> R^m function, by mpmath."""
    n = len(point)
    point = [mpmath.mpf(float(x)) for x in point]
    m = len(function(*point))
    result = np.zeros((m,) + (n,) * order)
    for indices in itertools.combinations_with_replacement(range(n), order):
        counts = tuple(indices.count(k) for k in range(n))
        for component in range(m):
            value = mpmath.diff(
                lambda *x, c=component: function(*x)[c], tuple(point), counts
            )
            for permuted in set(itertools.permutations(indices)):
                result[(component, *permuted)] = float(value)
    return result


def mp_exp(x, y, z):
    half = mpmath.sqrt(x * x + y * y + z * z) / 2
    sinc = mpmath.sin(half) / half if half else mpmath.mpf(1)
    return [mpmath.cos(half), sinc * x / 2, sinc * y / 2, sinc * z / 2]


def mp_log_on_the_branch(sign):
    def log(w, x, y, z):
        w, x, y, z = sign * w, sign * x, sign * y, sign * z
        norm = mpmath.sqrt(x * x + y * y + z * z)
        scale = 2 * mpmath.atan2(norm, w) / norm if norm else 2 / w
        return [scale * x, scale * y, scale * z]

    return log


@quick_jit
@jax.vmap
def exp_derivatives(v):
    first_forward, first_reverse = jax.jacfwd(ro.exp), jax.jacrev(ro.exp)
    second = jax.jacfwd(first_reverse)
    return (
        first_forward(v),
        first_reverse(v),
        second(v),
        jax.jacrev(first_forward)(v),
        jax.jacfwd(second)(v),
    )


@pytest.mark.parametrize("dtype", DTYPES)
def test_derivatives_of_exp_to_third_order(dtype):
    vectors = [(AXIS * a).astype(dtype) for a in (*DEGENERATE, 1.0, 1.42, np.pi, 6.0)]
    vectors += [np.array([1e-12, 1.0, 0], dtype)]
    forward, reverse, second, second_reverse, third = exp_derivatives(np.stack(vectors))
    assert third.dtype == dtype
    with mpmath.workdps(50):
        for k, v in enumerate(vectors):
            exact = [mp_jacobian(mp_exp, v, order) for order in (1, 2, 3)]
            np.testing.assert_allclose(forward[k], exact[0], atol=ulps(dtype, 4))
            np.testing.assert_allclose(reverse[k], exact[0], atol=ulps(dtype, 4))
            np.testing.assert_allclose(second[k], exact[1], atol=ulps(dtype, 16))
            np.testing.assert_allclose(
                second_reverse[k], exact[1], atol=ulps(dtype, 16)
            )
            np.testing.assert_allclose(third[k], exact[2], atol=ulps(dtype, 128))


@quick_jit
@jax.vmap
def log_derivatives(q):
    return (
        jax.jacfwd(ro.log)(q),
        jax.jacrev(ro.log)(q),
        jax.jacfwd(jax.jacrev(ro.log))(q),
    )


@pytest.mark.parametrize("dtype", DTYPES)
def test_derivatives_of_log_from_the_identity_to_the_half_turn(dtype):
    turns = [*DEGENERATE, 0.84, 1.0, np.pi / 2, 3.0, np.pi - 1e-8, np.pi]
    turns = [np.concatenate([[np.cos(a / 2)], np.sin(a / 2) * AXIS]) for a in turns]
    turns[-1][0] = 0.0
    turns = [t.astype(dtype) for t in (*turns, -turns[1], -turns[6])]
    forward, reverse, second = log_derivatives(np.stack(turns))
    with mpmath.workdps(50):
        for k, q in enumerate(turns):
            reference = mp_log_on_the_branch(-1 if q[0] < 0 else 1)
            exact = mp_jacobian(reference, q, 1)
            np.testing.assert_allclose(forward[k], exact, atol=ulps(dtype, 16))
            np.testing.assert_allclose(reverse[k], exact, atol=ulps(dtype, 16))
            exact = mp_jacobian(reference, q, 2)
            np.testing.assert_allclose(second[k], exact, atol=ulps(dtype, 256))


def mp_euler(w, x, y, z):
    s, d = mpmath.atan2(z, w), mpmath.atan2(y, x)
    theta = 2 * mpmath.atan2(mpmath.sqrt(x * x + y * y), mpmath.sqrt(w * w + z * z))
    return [s + d, theta, s - d]


@quick_jit
@jax.vmap
def euler_derivatives(q):
    return (
        jax.jacfwd(ro.to_euler)(q),
        jax.jacrev(ro.to_euler)(q),
        jax.jacfwd(jax.jacrev(ro.to_euler))(q),
    )


@pytest.mark.parametrize("dtype", DTYPES)
def test_derivatives_of_euler_angles_near_the_poles(dtype):
    thetas = [*DEGENERATE[1:], 1.0, np.pi - 1e-4, np.pi - 1e-7]
    thetas[0] = 1e-300 if dtype == np.float64 else 1e-35
    qs = []
    for theta in thetas:
        c, s = np.cos(theta / 2), np.sin(theta / 2)
        half_sum, half_difference = -0.25, 0.95  # phi = 0.7, psi = -1.2
        q = [
            c * np.cos(half_sum),
            s * np.cos(half_difference),
            s * np.sin(half_difference),
            c * np.sin(half_sum),
        ]
        qs.append(np.array(q, dtype))
    forward, reverse, second = (np.asarray(x) for x in euler_derivatives(np.stack(qs)))
    for k, q in enumerate(qs):
        with mpmath.workdps(400 if k == 0 else 60):
            exact = mp_jacobian(mp_euler, q)
            scale = np.max(np.abs(exact), axis=1, keepdims=True)
            np.testing.assert_allclose(
                forward[k] / scale, exact / scale, atol=ulps(dtype, 16)
            )
            np.testing.assert_allclose(
                reverse[k] / scale, exact / scale, atol=ulps(dtype, 16)
            )
            if k > 0:
                exact = mp_jacobian(mp_euler, q, 2)
                scale = np.max(np.abs(exact), axis=(1, 2), keepdims=True)
                np.testing.assert_allclose(
                    second[k] / scale, exact / scale, atol=ulps(dtype, 64)
                )


@pytest.mark.parametrize("dtype", DTYPES)
def test_derivatives_of_euler_angles_at_the_poles_are_finite(dtype):
    """theta has a cone: gradient 0; phi turns about the vertical, psi stays."""
    upright = np.array([np.cos(0.35), 0, 0, np.sin(0.35)], dtype)
    inverted = np.array([0, np.cos(0.35), np.sin(0.35), 0], dtype)
    forward, reverse, second = euler_derivatives(np.stack([upright, inverted]))
    assert np.all(np.isfinite(second))
    for found in (forward, reverse):
        for jacobian, q, (a, b) in zip(
            found, (upright, inverted), ((0, 3), (1, 2)), strict=True
        ):
            expected = np.zeros((3, 4))
            expected[0, a], expected[0, b] = -2 * q[b], 2 * q[a]
            np.testing.assert_allclose(jacobian, expected, atol=ulps(dtype, 4))


MATRIX_AXES = [np.eye(3)[0], np.eye(3)[1], np.eye(3)[2], AXIS, -AXIS, unit(1, 1, 1)]


@pytest.mark.parametrize("dtype", DTYPES)
def test_derivatives_of_from_matrix_along_the_group(dtype):
    """Of q exp(e): q (0, e) / 2 and -q |e|^2 / 4, at every angle,
    half turns and ties included."""

    @quick_jit
    @jax.vmap
    def both(q):
        zero = jnp.zeros(3, q.dtype)
        through = lambda v: ro.from_matrix(  # noqa: E731
            ro.to_matrix(q) @ ro.to_matrix(ro.exp(v))
        )
        derivatives = (jax.jacfwd(through), jax.jacrev(through), jax.hessian(through))
        return ro.from_matrix(ro.to_matrix(q)), *(d(zero) for d in derivatives)

    qs = []
    for axis, angle in itertools.product(
        MATRIX_AXES, (*ANGLES, np.pi / 2, 2 * np.pi / 3)
    ):
        q = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])
        q[0] = 0.0 if angle == np.pi else q[0]
        qs.append(q)
    qs = np.stack(qs).astype(dtype)
    found, forward, reverse, second = (np.asarray(x) for x in both(qs))
    for k, q in enumerate(qs):
        sign = np.sign(np.sum(np.asarray(found[k]) * q))
        w, x, y, z = q
        expected = 0.5 * np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])
        np.testing.assert_allclose(found[k], sign * q, atol=ulps(dtype, 8))
        np.testing.assert_allclose(forward[k], sign * expected, atol=ulps(dtype, 16))
        np.testing.assert_allclose(reverse[k], sign * expected, atol=ulps(dtype, 16))
        exact = -q[:, None, None] / 4 * np.eye(3)
        np.testing.assert_allclose(second[k], sign * exact, atol=ulps(dtype, 32))


@pytest.mark.parametrize("dtype", DTYPES)
def test_derivatives_of_the_angle_between_attitudes(dtype):
    """The gradient along v of the angle from p to p exp(v) is v / |v|;
    at v = 0 it is 0."""

    @quick_jit
    def both(p, v):
        angle = lambda v: ro.angle_between(p, ro.multiply(p, ro.exp(v)))  # noqa: E731
        return angle(v), jax.jacfwd(angle)(v), jax.jacrev(angle)(v)

    one = jnp.asarray([1, 0, 0, 0], dtype)
    small = 1e-300 if dtype == np.float64 else 1e-35
    for angle in (small, 1e-16, 1e-8, 1e-4, 1.0, 2.0, 3.1):
        value, forward, reverse = both(one, jnp.asarray(angle * AXIS, dtype))
        np.testing.assert_allclose(value, angle, rtol=ulps(dtype, 8), atol=0)
        np.testing.assert_allclose(forward, AXIS, atol=ulps(dtype, 16))
        np.testing.assert_allclose(reverse, AXIS, atol=ulps(dtype, 16))
    # between attitudes of order one rounding of their product is eps / angle of the
    # direction
    p = jnp.asarray(ATTITUDE, dtype)
    for angle in (1e-4, 1e-2, 1.0, 3.1):
        _, forward, reverse = both(p, jnp.asarray(angle * AXIS, dtype))
        np.testing.assert_allclose(
            forward, AXIS, atol=ulps(dtype, 16) * max(1, 1 / angle)
        )
        np.testing.assert_allclose(
            reverse, AXIS, atol=ulps(dtype, 16) * max(1, 1 / angle)
        )
    for q in (one, jnp.asarray([0.5, -0.5, 0.5, 0.5], dtype)):
        value, forward, reverse = both(q, jnp.zeros(3, dtype))
        assert value == 0
        assert np.all(np.asarray(forward) == 0)
        assert np.all(np.asarray(reverse) == 0)


# --- shapes
# -----------------------------------------------------------------------------------

THREE, FOUR, NINE = np.ones(3), np.ones(4), np.ones((3, 3))
WRONG_SHAPES = {
    "hat": (
        lambda: ro.hat(FOUR),
        r"`vector` must have shape \(3,\), but it has shape \(4,\)",
    ),
    "vee": (lambda: ro.vee(THREE), r"`matrix` must have shape \(3, 3\), but"),
    "to_matrix": (
        lambda: ro.to_matrix(THREE),
        r"`attitude` must have shape \(4,\), but",
    ),
    "from_matrix": (
        lambda: ro.from_matrix(FOUR),
        r"`matrix` must have shape \(3, 3\), but",
    ),
    "to_scipy": (lambda: ro.to_scipy(THREE), r"`attitude` must have shape \(4,\), but"),
    "inverse": (lambda: ro.inverse(THREE), r"`quaternion` must have shape \(4,\), but"),
    "slerp": (lambda: ro.slerp(FOUR, THREE, 0.5), r"`q` must have shape \(4,\), but"),
    "slerp of many": (
        lambda: ro.slerp(FOUR, FOUR, FOUR),
        r"`s` must have shape \(\), but",
    ),
    "from_roll_pitch_yaw": (
        lambda: ro.from_roll_pitch_yaw(FOUR),
        r"`angles` must have shape",
    ),
    "to_roll_pitch_yaw": (
        lambda: ro.to_roll_pitch_yaw(THREE),
        r"`attitude` must have shape",
    ),
    "identity": (
        lambda: ro.identity(int),
        "`dtype` must be of floating point .* it is int64",
    ),
    "random": (
        lambda: ro.random(KEY, jnp.int32),
        "`dtype` must be of floating point .* int32",
    ),
    "from_euler": (
        lambda: ro.from_euler(FOUR),
        r"`angles` must have shape \(3,\), but",
    ),
    "to_euler": (lambda: ro.to_euler(THREE), r"`attitude` must have shape \(4,\), but"),
    "normalize": (
        lambda: ro.normalize(THREE),
        r"`quaternion` must have shape \(4,\), but",
    ),
    "multiply": (lambda: ro.multiply(FOUR, THREE), r"`q` must have shape \(4,\), but"),
    "conjugate": (
        lambda: ro.conjugate(THREE),
        r"`quaternion` must have shape \(4,\), but",
    ),
    "rotate": (lambda: ro.rotate(FOUR, FOUR), r"`vector` must have shape \(3,\), but"),
    "rotate batch": (
        lambda: ro.rotate(np.ones((5, 4)), THREE),
        r"`attitude` must .* \(5, 4\)",
    ),
    "rotate_inverse": (
        lambda: ro.rotate_inverse(FOUR, FOUR),
        r"`vector` must have shape",
    ),
    "exp": (lambda: ro.exp(FOUR), r"`rotation_vector` must have shape \(3,\), but"),
    "log": (lambda: ro.log(THREE), r"`attitude` must have shape \(4,\), but"),
    "angle_between": (
        lambda: ro.angle_between(THREE, FOUR),
        r"`p` must have shape \(4,\), but",
    ),
    "axis": (
        lambda: ro.from_axis_angle(FOUR, 1.0),
        r"`axis` must have shape \(3,\), but",
    ),
    "angle": (
        lambda: ro.from_axis_angle(THREE, THREE),
        r"`angle` must have shape \(\), but",
    ),
    "attitude_rate": (
        lambda: ro.attitude_rate(FOUR, FOUR),
        r"`omega` must have shape \(3,\)",
    ),
    "angular_velocity": (
        lambda: ro.angular_velocity(NINE, THREE),
        r"`rotation_rate` must have shape \(3, 3\), but",
    ),
    "rates": (
        lambda: ro.euler_rates_to_omega(THREE, FOUR),
        r"`rates` must have shape \(3,\)",
    ),
    "omega": (
        lambda: ro.omega_to_euler_rates(THREE, FOUR),
        r"`omega` must have shape \(3,\)",
    ),
    "samples": (
        lambda: ro.integrate_rate(np.arange(5.0), np.ones((5, 4))),
        r"`omegas` must have shape \(5, 3\), but it has shape \(5, 4\)",
    ),
    "times": (
        lambda: ro.integrate_rate(np.arange(4.0), np.ones((5, 3))),
        r"`omegas` must have shape \(4, 3\), but it has shape \(5, 3\)",
    ),
    "one sample": (
        lambda: ro.integrate_rate(np.zeros(1), np.ones((1, 3))),
        r"`ts` must hold at least two samples, but it has shape \(1,\)",
    ),
    "start": (
        lambda: ro.integrate_rate(np.arange(2.0), np.ones((2, 3)), THREE),
        r"`attitude0` must have shape \(4,\), but",
    ),
}


@pytest.mark.parametrize("name", WRONG_SHAPES)
def test_wrong_shape_is_an_error(name, untyped):
    call, message = WRONG_SHAPES[name]
    with pytest.raises(ValueError, match="Argument " + message):
        call()


def test_names_of_the_package():
    assert jr.rotation is ro
