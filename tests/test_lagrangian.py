import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DTYPES, MOMENTS, central_difference, quick_jit, ulps

import jrigid as jr
from jrigid import lagrangian

TOP = (1.3, 0.6, 2.1)  # I1, I3, mgl
TOP_Q, TOP_Q_DOT = np.array([0.4, 0.9, -0.3]), np.array([0.5, -0.7, 6.0])


def oscillator(q, q_dot, mass, stiffness):
    return 0.5 * mass * jnp.sum(q_dot**2) - 0.5 * stiffness * jnp.sum(q**2)


def symmetric_top(q, q_dot, i1, i3, mgl):
    _, theta, _ = q
    phi_dot, theta_dot, psi_dot = q_dot
    turning = 0.5 * i1 * (theta_dot**2 + (phi_dot * jnp.sin(theta)) ** 2)
    spinning = 0.5 * i3 * (psi_dot + phi_dot * jnp.cos(theta)) ** 2
    return turning + spinning - mgl * jnp.cos(theta)


def top_acceleration(q, q_dot, i1, i3, mgl):
    """By hand: p_psi = I3 w3 and p_phi are constant, and the equation of theta."""
    (_, theta, _), (phi_dot, theta_dot, psi_dot) = q, q_dot
    sin, cos = np.sin(theta), np.cos(theta)
    spin = psi_dot + phi_dot * cos
    phi = (i3 * spin - 2 * i1 * phi_dot * cos) * theta_dot / (i1 * sin)
    nutation = (i1 * phi_dot**2 * cos - i3 * spin * phi_dot + mgl) * sin / i1
    return np.array([phi, nutation, phi_dot * theta_dot * sin - phi * cos])


def double_pendulum(q, q_dot, m1, m2, l1, l2, g):
    """From the positions of the two bobs, differentiated by jax."""

    def bobs(q):
        first = l1 * jnp.stack([jnp.sin(q[0]), -jnp.cos(q[0])])
        return first, first + l2 * jnp.stack([jnp.sin(q[1]), -jnp.cos(q[1])])

    (first, second), (v1, v2) = jax.jvp(bobs, (q,), (q_dot,))
    kinetic = 0.5 * m1 * jnp.sum(v1**2) + 0.5 * m2 * jnp.sum(v2**2)
    return kinetic - g * (m1 * first[1] + m2 * second[1])


def double_pendulum_acceleration(q, q_dot, m1, m2, l1, l2, g):
    (a, b), (a_dot, b_dot) = q, q_dot
    sin, cos = np.sin(a - b), np.cos(a - b)
    common = 2 * m1 + m2 - m2 * np.cos(2 * a - 2 * b)
    first = -g * (2 * m1 + m2) * np.sin(a) - m2 * g * np.sin(a - 2 * b)
    first -= 2 * sin * m2 * (b_dot**2 * l2 + a_dot**2 * l1 * cos)
    second = (
        a_dot**2 * l1 * (m1 + m2) + g * (m1 + m2) * np.cos(a) + b_dot**2 * l2 * m2 * cos
    )
    return np.array([first / (l1 * common), 2 * sin * second / (l2 * common)])


def charge(q, q_dot, mass, charge):
    """In A = (-y^3, x z, x y^2) and the potential x^2 z."""
    x, y, z = q
    vector_potential = jnp.stack([-(y**3), x * z, x * y**2])
    interaction = jnp.sum(vector_potential * q_dot) - x**2 * z
    return 0.5 * mass * jnp.sum(q_dot**2) + charge * interaction


def charge_acceleration(q, q_dot, mass, charge):
    x, y, z = q
    magnetic = np.array([2 * x * y - x, -(y**2), z + 3 * y**2])  # curl A
    electric = np.array([-2 * x * z, 0, -(x**2)])
    return charge / mass * (electric + np.cross(q_dot, magnetic))


def bateman(q, q_dot, mass, damping, stiffness):
    """A damped oscillator x and its growing mirror image y; M = [[0, m], [m, 0]]."""
    (x, y), (x_dot, y_dot) = q, q_dot
    gyroscopic = 0.5 * damping * (x * y_dot - y * x_dot)
    return mass * x_dot * y_dot + gyroscopic - stiffness * x * y


def bateman_acceleration(q, q_dot, mass, damping, stiffness):
    return (np.array([-damping, damping]) * q_dot - stiffness * q) / mass


def oscillator_acceleration(q, q_dot, mass, stiffness):
    return -stiffness / mass * q


TWO, THREE = np.array([0.7, -1.9]), np.array([0.8, -0.6, 1.1])
CASES = {
    "oscillator": (oscillator, oscillator_acceleration, (TWO[:1], TWO[1:]), (0.7, 3.1)),
    "double pendulum": (
        double_pendulum,
        double_pendulum_acceleration,
        (TWO, np.array([1.3, -0.4])),
        (1.2, 0.5, 0.8, 1.1, 9.81),
    ),
    "symmetric top": (symmetric_top, top_acceleration, (TOP_Q, TOP_Q_DOT), TOP),
    "charge in fields": (
        charge,
        charge_acceleration,
        (THREE, THREE[::-1].copy()),
        (1.4, -0.7),
    ),
    "indefinite": (
        bateman,
        bateman_acceleration,
        (TWO, np.array([1.3, -0.4])),
        (1.2, 0.3, 2.0),
    ),
}


@pytest.mark.parametrize(
    ("name", "dtype"),
    [(name, np.float64) for name in CASES] + [("symmetric top", np.float32)],
)
def test_accelerations_are_those_of_the_textbook(name, dtype):
    function, by_hand, (q, q_dot), params = CASES[name]
    expected = by_hand(q, q_dot, *params)

    @quick_jit
    def both(q, q_dot):
        field = lagrangian.vector_field(function)
        direct = lagrangian.acceleration(function, q, q_dot, *params)
        return direct, field(0.0, (q, q_dot), params)

    q, q_dot = q.astype(dtype), q_dot.astype(dtype)
    found, (rate, again) = both(q, q_dot)
    assert found.dtype == rate.dtype == again.dtype == dtype
    atol = ulps(dtype, 64) * np.max(np.abs(expected))
    np.testing.assert_allclose(found, expected, atol=atol)
    np.testing.assert_allclose(again, expected, atol=atol)
    np.testing.assert_array_equal(rate, q_dot)


def test_a_body_in_euler_angles_obeys_eulers_equations():
    def omega(q, q_dot):
        (_, theta, psi), (phi_dot, theta_dot, psi_dot) = q, q_dot
        across, sin, cos = phi_dot * jnp.sin(theta), jnp.sin(psi), jnp.cos(psi)
        parts = across * sin + theta_dot * cos, across * cos - theta_dot * sin
        return jnp.stack([*parts, psi_dot + phi_dot * jnp.cos(theta)])

    @quick_jit
    def rates(q, q_dot):
        free = lambda q, q_dot: jr.kinetic_energy(MOMENTS, omega(q, q_dot))  # noqa: E731
        q_ddot = lagrangian.acceleration(free, q, q_dot)
        rate = jax.jvp(omega, (q, q_dot), (q_dot, q_ddot))[1]
        return rate, jr.euler_equations(MOMENTS, omega(q, q_dot))

    found, expected = rates(TOP_Q, TOP_Q_DOT)
    np.testing.assert_allclose(found, expected, atol=ulps(float, 256))


@pytest.mark.parametrize("name", ["symmetric top", "charge in fields", "indefinite"])
def test_energy_and_momenta(name):
    function, by_hand, (q, q_dot), params = CASES[name]
    expected = {
        "symmetric top": lambda q, v: (
            symmetric_top(q, v, *TOP) + 2 * TOP[2] * np.cos(q[1])
        ),
        # of the magnetic field nothing is left
        "charge in fields": lambda q, v: 0.7 * np.sum(v**2) - 0.7 * q[0] ** 2 * q[2],
        "indefinite": lambda q, v: 1.2 * v[0] * v[1] + 2.0 * q[0] * q[1],
    }

    @quick_jit
    def everything(q, q_dot, q_ddot):
        both = lambda *y: (  # noqa: E731
            lagrangian.energy(function, *y, *params),
            lagrangian.momenta(function, *y, *params),
        )
        force = jax.grad(lambda q: function(q, q_dot, *params))(q)
        return jax.jvp(both, (q, q_dot), (q_dot, q_ddot)), force

    result = everything(q, q_dot, by_hand(q, q_dot, *params))
    ((energy, momenta), (power, rate)), force = result
    np.testing.assert_allclose(energy, expected[name](q, q_dot), rtol=ulps(float, 16))
    of_rate = jax.jit(lambda v: function(q, v, *params))
    slopes = [central_difference(of_rate, q_dot, e) for e in np.eye(q.size)]
    np.testing.assert_allclose(momenta, slopes, rtol=1e-8, atol=1e-8)
    # by the textbook's accelerations
    np.testing.assert_allclose(power, 0, atol=ulps(float, 1e3))
    np.testing.assert_allclose(rate, force, atol=ulps(float, 1e3))


def solve(field, y0, args, ts, rtol=1e-10):
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        diffrax.Tsit5(),
        ts[0],
        ts[-1],
        None,
        y0,
        args,
        saveat=diffrax.SaveAt(ts=ts),
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
        adjoint=diffrax.ForwardMode(),
    )
    return solution.ys


def test_a_top_keeps_its_energy_and_the_momenta_of_phi_and_psi():
    @quick_jit
    def motion(q, q_dot):
        ys = solve(
            lagrangian.vector_field(symmetric_top),
            (q, q_dot),
            TOP,
            jnp.linspace(0, 10, 40),
        )
        of = lambda f: jax.vmap(lambda q, q_dot: f(symmetric_top, q, q_dot, *TOP))(*ys)  # noqa: E731
        return ys, of(lagrangian.energy), of(lagrangian.momenta)

    (q, _), energy, momenta = motion(TOP_Q, TOP_Q_DOT)
    assert np.ptp(q[:, 1]) > 0.1  # it nutates
    np.testing.assert_allclose(energy, energy[0], rtol=1e-8)
    for cyclic in (0, 2):
        np.testing.assert_allclose(momenta[:, cyclic], momenta[0, cyclic], rtol=1e-8)
    assert np.ptp(momenta[:, 1]) > 0.1


def test_a_time_among_the_parameters_drives_an_oscillator_at_resonance():
    """x'' = -x + cos t from rest: x = t sin(t) / 2."""

    def driven(q, q_dot, t, stiffness):
        return oscillator(q, q_dot, 1.0, stiffness) + q[0] * jnp.cos(t)

    ts = np.linspace(0, 12, 7)
    q, q_dot = ts * np.sin(ts) / 2, (np.sin(ts) + ts * np.cos(ts)) / 2

    def at(q, q_dot, t):
        return lagrangian.acceleration(driven, q[None], q_dot[None], t, 1.0)[0]

    found = quick_jit(jax.vmap(at))(q, q_dot, ts)
    np.testing.assert_allclose(found, np.cos(ts) - q, atol=ulps(float, 32))


def test_parameters_may_be_any_pytree_and_may_be_missing():
    def nested(q, q_dot, parameters):
        return oscillator(q, q_dot, parameters["mass"], parameters["springs"][0])

    tree = {"mass": 2.0, "springs": [jnp.array(8.0)]}
    call = quick_jit(lambda q, tree: lagrangian.acceleration(nested, q, q, tree))
    np.testing.assert_array_equal(call(TWO, tree), -4 * TWO)
    free = lambda q, q_dot: oscillator(q, q_dot, 1.0, 3.0)  # noqa: E731
    for args in (None, ()):
        field = lagrangian.vector_field(free)
        rate = quick_jit(lambda q: field(0.0, (q, q), args)[1])(TWO)  # noqa: B023
        np.testing.assert_array_equal(rate, -3 * TWO)


# Derivatives


def test_derivatives_against_differences_of_the_textbook():
    function, by_hand, (q, q_dot), params = CASES["symmetric top"]
    inputs, split = np.concatenate([q, q_dot, params]), (q.size, 2 * q.size)

    def call(f, x, xp):
        q, q_dot, params = xp.split(x, split)
        return f(q, q_dot, *params)

    found = lambda x: call(lambda *a: lagrangian.acceleration(function, *a), x, jnp)  # noqa: E731
    expected = lambda x: call(by_hand, x, np)  # noqa: E731
    weights = np.linspace(1, 2, q.size)
    total = lambda x: jnp.sum(weights * found(x))  # noqa: E731

    @quick_jit
    def derivatives(x):
        return (
            jax.jacfwd(found)(x),
            jax.jacrev(found)(x),
            jax.jacfwd(jax.jacrev(total))(x),
        )

    forward, reverse, hessian = derivatives(inputs)
    basis = np.eye(inputs.size)
    jacobian = np.stack(
        [central_difference(expected, inputs, e) for e in basis], axis=1
    )
    size = np.max(np.abs(jacobian))
    np.testing.assert_allclose(forward, jacobian, atol=1e-8 * size)
    np.testing.assert_allclose(reverse, forward, atol=ulps(float, 256) * size)
    h = 1e-4
    value = lambda x: weights @ expected(x)  # noqa: E731
    for i, j in [
        (0, 1),
        (1, 1),
        (q.size, q.size + 1),
        (1, 2 * q.size),
        (-1, 1),
        (-2, -2),
    ]:
        a, b = h * basis[i], h * basis[j]
        mixed = value(inputs + a + b) - value(inputs + a - b)
        mixed = (mixed - value(inputs - a + b) + value(inputs - a - b)) / (4 * h * h)
        size = np.max(np.abs(hessian))
        np.testing.assert_allclose(
            hessian[i, j], mixed, atol=1e-6 * size, err_msg=f"{i}, {j}"
        )


def test_derivative_through_an_integration():
    """x = cos(sqrt(k) t)"""

    def end(stiffness):
        y0 = (jnp.array([1.0]), jnp.array([0.0]))
        field = lagrangian.vector_field(oscillator)
        return solve(field, y0, (1.0, stiffness), jnp.array([0.0, 3.0]))[0][-1, 0]

    slope = -3 * np.sin(3 * 2**0.5) / (2 * 2**0.5)
    np.testing.assert_allclose(quick_jit(jax.jacfwd(end))(2.0), slope, rtol=1e-7)


# Cyclic coordinates


@pytest.mark.parametrize("dtype", [np.float64])
def test_cyclic_coordinates_of_a_top_are_phi_and_psi(dtype):
    q, q_dot = TOP_Q.astype(dtype), TOP_Q_DOT.astype(dtype)

    def top(q, q_dot, *p):
        return lagrangian.cyclic_coordinates(symmetric_top, q, q_dot, *p)

    top = quick_jit(top)
    np.testing.assert_array_equal(top(q, q_dot, *TOP), [True, False, True])
    # on its vertical axis, and at rest, dL/dq is zero for theta too
    np.testing.assert_array_equal(top(0 * q, 0 * q_dot, *TOP), [True, False, True])
    without_gravity = top(
        q, q_dot, 1.0, 1.0, 0.0
    )  # a sphere's L still depends on theta
    np.testing.assert_array_equal(without_gravity, [True, False, True])


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_coordinate_that_cancels_is_cyclic_and_a_slow_one_is_not(dtype):
    def planet(q, q_dot, mu):
        """In the plane, by way of x and y: the angle drops out only in exact
        numbers."""
        place = lambda q: q[0] * jnp.stack([jnp.cos(q[1]), jnp.sin(q[1])])  # noqa: E731
        at, velocity = jax.jvp(place, (q,), (q_dot,))
        return 0.5 * jnp.sum(velocity**2) + mu / jnp.sqrt(jnp.sum(at**2))

    q, q_dot = np.array([1.5, 2.3], dtype), np.array([0.2, 0.7], dtype)
    found = quick_jit(lambda *a: lagrangian.cyclic_coordinates(planet, *a))(
        q, q_dot, 0.9
    )
    np.testing.assert_array_equal(found, [False, True])
    straight = quick_jit(lambda *a: lagrangian.cyclic_coordinates(oscillator, *a))
    # seconds or centuries: a potential of 1e-14 is seen in a motion of 1e-7 and from
    # rest
    for speed in (1e-7, 0.0):
        slow = straight(q, q_dot * dtype(speed), 1.0, 1e-14)
        np.testing.assert_array_equal(slow, [False, False])
    free = straight(q, q_dot, 1.0, 0.0)
    np.testing.assert_array_equal(free, [True, True])


def test_a_magnetic_field_alone_makes_a_coordinate_not_cyclic():
    landau_gauge = lambda q, q_dot: 0.5 * jnp.sum(q_dot**2) + 3 * q[0] * q_dot[1]  # noqa: E731
    ask = quick_jit(lambda *y: lagrangian.cyclic_coordinates(landau_gauge, *y))
    found = ask(THREE, THREE)
    np.testing.assert_array_equal(found, [False, True, True])


def test_reach_keeps_the_points_where_the_lagrangian_is_defined():
    def well(q, q_dot):  # 1e-9 m wide
        return 0.5 * jnp.sum(q_dot**2) + jnp.log1p(-((1e9 * q[0]) ** 2))

    @quick_jit
    def ask(reach):
        return lagrangian.cyclic_coordinates(well, TWO * 1e-10, TWO, reach=reach)

    np.testing.assert_array_equal(ask(None), [False, False])  # NaN there
    np.testing.assert_array_equal(ask(1e-10), [False, True])
    np.testing.assert_array_equal(ask(np.array([1e-10, 1.0])), [False, True])
    np.testing.assert_array_equal(ask(np.nan), [False, False])


# Singular and badly scaled mass matrices

UPRIGHT = TOP_Q * np.array([1, 0, 1])


def one_top(q, mgl):
    return lagrangian.acceleration(
        symmetric_top, q, TOP_Q_DOT.astype(q.dtype), *TOP[:2], mgl
    )


tops = quick_jit(jax.vmap(one_top, (0, None)))


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_singular_lane_is_nan_and_touches_no_other(dtype):
    inverted = UPRIGHT + np.array([0, np.pi, 0])
    lanes = np.stack([TOP_Q, UPRIGHT, inverted, TOP_Q * np.nan, TOP_Q * np.inf, TOP_Q])
    expected = top_acceleration(TOP_Q, TOP_Q_DOT, *TOP)
    found = tops(lanes.astype(dtype), dtype(TOP[2]))
    for lane in (0, -1):
        atol = ulps(dtype, 64) * np.max(np.abs(expected))
        np.testing.assert_allclose(found[lane], expected, rtol=0, atol=atol)
    assert np.all(np.isnan(found[1:-1]))


def test_a_singular_mass_matrix_is_nan_eagerly_too():
    assert np.all(np.isnan(one_top(UPRIGHT, TOP[2])))


def test_no_rate_in_the_lagrangian_is_a_singular_mass_matrix():
    lacking = lambda q, q_dot: q_dot[0] ** 2 - q[1] ** 2  # noqa: E731
    static = lambda q, _: jnp.sum(q)  # noqa: E731
    for function in (lacking, static):
        assert np.all(np.isnan(lagrangian.acceleration(function, TWO, TWO)))


def test_derivatives_of_a_singular_lane_are_zero_and_touch_no_other():
    lanes = np.stack([TOP_Q, UPRIGHT, TOP_Q])
    field = lagrangian.vector_field(symmetric_top)
    step = lambda q, mgl: field(0.0, (q, TOP_Q_DOT), (*TOP[:2], mgl))[1]  # noqa: E731
    # a parameter that the lanes share is not changed by the singular one
    sharing = np.stack([TOP_Q, UPRIGHT, TOP_Q * np.nan, TOP_Q * np.inf])
    shared = lambda mgl: jnp.nansum(jax.vmap(one_top, (0, None))(sharing, mgl))  # noqa: E731

    @quick_jit
    def derivatives(lanes, mgl):
        each = [
            jax.vmap(mode(step), (0, None))(lanes, mgl)
            for mode in (jax.jacfwd, jax.jacrev)
        ]
        return jax.jacfwd(one_top)(lanes[0], mgl), each, jax.grad(shared)(mgl)

    alone, jacobians, slope = derivatives(lanes, TOP[2])
    for jacobian in jacobians:
        for lane, expected in enumerate([alone, 0 * alone, alone]):
            np.testing.assert_allclose(jacobian[lane], expected, atol=ulps(float, 1e3))
    np.testing.assert_allclose(slope, np.sin(TOP_Q[1]) / TOP[0], rtol=ulps(float, 64))


def test_an_infinite_derivative_in_one_lane_stops_no_other():
    """V = x^1.5 has a finite force and an infinite rate of it at 0."""
    steep = lambda q, q_dot: 0.5 * q_dot[0] ** 2 - q[0] ** 1.5  # noqa: E731
    one = lambda x: lagrangian.acceleration(steep, x[None], jnp.zeros(1))[0]  # noqa: E731
    found = quick_jit(jax.vmap(lambda x: jax.jvp(one, (x,), (1.0,))))(
        jnp.array([0.0, 4.0])
    )
    np.testing.assert_allclose(found, [[0, -3], [-np.inf, -0.375]])


@pytest.mark.parametrize("dtype", DTYPES)
def test_how_close_to_singular(dtype):
    """M = [[1, 1 - d], [1 - d, 1]] has the reciprocal condition number d / 2."""

    def nearly(q, q_dot, d):
        return 0.5 * jnp.sum(q_dot) ** 2 - d * q_dot[0] * q_dot[1] - q[0]

    call = jax.jit(lambda d: lagrangian.acceleration(nearly, zero, zero, d))
    zero, eps = jnp.zeros(2, dtype), float(np.finfo(dtype).eps)
    d = dtype(2**8 * eps)
    regular = np.asarray(call(d), float)
    d = float(d)
    expected = -np.array([1, -(1 - d)]) / (d * (2 - d))
    np.testing.assert_allclose(regular, expected, rtol=1 / 16)
    assert np.all(np.isnan(call(dtype(2**5 * eps))))


@pytest.mark.parametrize("dtype", [np.float32])
def test_units_do_not_make_a_mass_matrix_singular(dtype):
    """Coordinates in units 1e12 apart, with a definite and with an indefinite
    matrix."""
    plain = np.array([[2.0, 0.5, -0.3], [0.5, 1.0, 0.2], [-0.3, 0.2, 1.5]])
    hollow = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.5]])
    units = np.array([1e-6, 1.0, 1e6])

    def quadratic(q, q_dot, matrix):
        kinetic = 0.5 * jnp.sum(q_dot * jnp.sum(matrix * q_dot[None, :], axis=1))
        return kinetic - jnp.sum(units.astype(dtype) * q)

    call = jax.jit(lambda m: lagrangian.acceleration(quadratic, zero, zero, m))
    zero = jnp.zeros(3, dtype)
    for matrix in (plain, hollow):
        found = call((matrix * np.outer(units, units)).astype(dtype))
        expected = -np.linalg.solve(matrix, np.ones(3))
        np.testing.assert_allclose(
            np.asarray(found) * units, expected, rtol=ulps(dtype, 64)
        )


def test_an_integration_that_starts_at_a_singular_point_fails():
    @quick_jit
    def result(y0):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(lagrangian.vector_field(symmetric_top)),
            diffrax.Tsit5(),
            0.0,
            1.0,
            None,
            y0,
            TOP,
            stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6),
            max_steps=64,
            throw=False,
        ).result

    assert result((UPRIGHT, TOP_Q_DOT)) == diffrax.RESULTS.max_steps_reached


# Bad input


def test_values_that_are_not_finite_are_nan():
    assert np.all(
        np.isnan(lagrangian.acceleration(oscillator, TWO * np.nan, TWO, 1.0, 1.0))
    )
    assert np.all(
        np.isnan(lagrangian.acceleration(oscillator, TWO, TWO * np.inf, 1.0, 1.0))
    )
    assert np.all(np.isnan(lagrangian.acceleration(oscillator, TWO, TWO, 1.0, np.inf)))
    zero = jnp.zeros(1, np.float32)
    tiny = lambda q, q_dot: 1e-30 * q_dot[0] ** 2 - 1e20 * q[0]  # noqa: E731
    # the answer is out of the range of its floating point numbers
    assert np.isnan(lagrangian.acceleration(tiny, zero, zero)[0])
    assert np.isnan(lagrangian.vector_field(tiny)(0.0, (zero, zero), None)[1][0])


FUNCTIONS = ["acceleration", "momenta", "energy", "cyclic_coordinates"]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_wrong_arguments_are_errors(name, untyped):
    call = getattr(lagrangian, name)
    with pytest.raises(
        ValueError, match=r"Argument `q` must have shape \(n,\), but .* \(\)\."
    ):
        call(oscillator, 1.0, TWO, 1.0, 1.0)
    with pytest.raises(
        ValueError, match=r"Argument `q_dot` must have shape \(2,\), but .* \(3,\)"
    ):
        call(oscillator, TWO, THREE, 1.0, 1.0)
    for wrong in (
        lambda q, _: q,
        lambda *_: 1,
        lambda q, _: jnp.sum(q).astype(complex),
    ):
        with pytest.raises(
            ValueError, match="Argument `lagrangian` must return a real scalar"
        ):
            call(wrong, TWO, TWO)


def test_wrong_arguments_of_the_field_and_of_reach_are_errors(untyped):
    field = lagrangian.vector_field(oscillator)
    with pytest.raises(
        ValueError, match=r"Argument `args` must be a tuple .* is a float"
    ):
        field(0.0, (TWO, TWO), 1.0)
    with pytest.raises(ValueError, match=r"Argument `q_dot` must have shape \(2,\)"):
        field(0.0, (TWO, THREE), (1.0, 1.0))
    with pytest.raises(ValueError, match=r"Argument `reach` must have shape \(2,\)"):
        lagrangian.cyclic_coordinates(oscillator, TWO, TWO, 1.0, 1.0, reach=THREE)
    for reach in (0.0, np.array([1.0, -0.1]), np.inf):
        with pytest.raises(ValueError, match="Argument `reach` must be positive"):
            lagrangian.cyclic_coordinates(oscillator, TWO, TWO, 1.0, 1.0, reach=reach)


def test_integers_are_promoted():
    ones = np.array([1, 1])
    for name in FUNCTIONS[:3]:
        value = getattr(lagrangian, name)(oscillator, ones, ones, 1, 2)
        assert value.dtype == np.float64
        assert np.all(np.isin(value, [-2, 1, 3]))
