"""simulate(): rates that rise on the way, orbits, lanes that fail, precision of times."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import ATTITUDE, MOMENTS, OMEGA, quick_jit
from reference import free_hessian_vector

import jrigid as jr

FORWARD = diffrax.ForwardMode()
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
SYMMETRIC = np.array([1.0, 1.0, 1.5])
SINGLE = UPRIGHT.astype(np.float32)
BODY = jr.MassProperties(2.0, np.zeros(3), SYMMETRIC)


def _at(omega):
    return jr.State(UPRIGHT, omega)


def test_reverse_jacobian_in_the_initial_state():
    """Of one motion, whose lanes differ in their cotangents alone."""
    exact = jax.jacfwd(lambda w: jr.free_rotation(MOMENTS, _at(w), 5.0).attitude)

    def end(omega):
        return jr.simulate(jr.RigidBody(MOMENTS), _at(omega), 5.0).final_state.attitude

    np.testing.assert_allclose(jax.jacrev(end)(OMEGA), exact(OMEGA), atol=1e-7)
    many = quick_jit(jax.vmap(jax.jacrev(end)))(np.stack([OMEGA, 0.5 * OMEGA]))
    np.testing.assert_allclose(many[1], exact(0.5 * OMEGA), atol=1e-7)


# Orbits
# --------------------------------------------------------------------------------------


def _attraction(_t, state, strength):
    return -2.0 * strength * state.position / jnp.sum(state.position**2) ** 1.5


def _potential(_t, state, strength):
    return -2.0 * strength / jnp.sqrt(jnp.sum(state.position**2))


ORBIT = jr.FloatingBody(BODY, jr.systems.Force(_attraction, _potential))


@jax.jit
def _circle(turning, radians, rtol, unit):
    """Errors after a circular orbit of radius 1 at the rate `unit`, as fractions of the bars."""
    state0 = jr.FloatingState(
        jnp.array([1.0, 0, 0]),
        jnp.array([0, 1.0, 0]) * unit,
        UPRIGHT,
        jnp.array([0, 0, 1.0]) * turning * unit,
    )
    ts = jnp.stack([jnp.zeros_like(radians), radians / unit])
    trajectory = jr.simulate(ORBIT, state0, ts, unit**2, rtol=rtol)
    bar = rtol * (1 + radians)
    c, s = jnp.cos(radians), jnp.sin(radians)
    position, velocity = (
        trajectory.states.position[1],
        trajectory.states.velocity[1] / unit,
    )
    energy = trajectory.energy
    return jnp.stack(
        [
            jnp.abs(energy[1] / energy[0] - 1) / bar,
            jnp.linalg.norm(position - jnp.stack([c, s, 0 * s])) / (10 * bar),
            jnp.linalg.norm(velocity - jnp.stack([-s, c, 0 * s])) / (10 * bar),
        ]
    )


@pytest.mark.parametrize(
    ("turning", "turns", "rtol", "unit"),
    [
        (0.0, 100, 1e-6, 1),
        (0.0, 1000, 1e-8, 1),
        (1e-4, 100, 1e-8, 1),
        (1e-4, 1000, 1e-4, 1),
        (0.0, 3000, 1e-8, 1),
        (1.0, 100, 1e-8, 1),
        (1e-4, 100, 1e-8, 1e-7),
        (0.0, 100, 1e-8, 1e4),
    ],
)
def test_a_body_that_turns_slowly_or_not_at_all_keeps_its_orbit(
    turning, turns, rtol, unit
):
    errors = _circle(turning, 2 * np.pi * turns, rtol, float(unit))
    assert np.all(errors <= 1), errors


def test_a_projectile_that_does_not_turn_in_any_unit_of_time():
    """Thrown from the origin, and let go at rest a rounding error away from it."""
    body = jr.FloatingBody(BODY, lambda _t, _s, unit: jnp.array([0, 0, -2.0]) * unit**2)

    @jax.jit
    def flight(velocity, height, unit):
        start = jnp.array([0, 0, 1.0]) * height
        state0 = jr.FloatingState(start, velocity * unit, UPRIGHT, np.zeros(3))
        trajectory = jr.simulate(body, state0, 10 / unit, unit)
        return trajectory.states.position, trajectory.stats["num_steps"]

    for unit in (1e-7, 1.0, 1e4):
        for velocity, height in ((np.array([1.0, 0, 1.0]), 0.0), (np.zeros(3), 1e-13)):
            position, steps = flight(velocity, height, unit)
            assert steps < 200
            exact = velocity * 10 + np.array([0, 0, height - 50.0])
            np.testing.assert_allclose(position, exact, atol=1e-8)


# Rates that rise after the start
# -------------------------------------------------------------


def _motion(omega, case, adjoint=None):
    """A wheel spun up while a torque acts on the body, whose attitude is controlled from t = 10."""
    moments, spin_up, held, gain, rtol, duration, start = case
    along = jnp.array([0, 0, 1.0])

    def control(t, state, gain):
        pull = gain * (25 * jr.rotation.log(state.attitude) + 2 * state.omega)
        return jnp.where(t > 10, -pull, jnp.zeros(3))

    torque = (
        jr.torques.SpinningMass(1e-2, along, lambda _t, _s, _a: spin_up)
        + jr.torques.Constant(held * along)
        + jr.torques.Torque(control)
    )
    body = jr.RigidBody(moments, torque)
    state0 = jr.State(UPRIGHT, omega + start * along, (jnp.zeros(()),))
    return jr.simulate(
        body, state0, duration, gain, adjoint=adjoint, rtol=rtol, throw=False
    ).states.omega


def _damped():
    """x'' + 2 x' + 25 x = 0 for 20 s from x = 10, x' = 1: x' of the controlled body."""
    root = np.sqrt(24)
    c, s, decay = np.cos(20 * root), np.sin(20 * root), np.exp(-20)
    slope = (1 + 10) / root
    return decay * (-(10 * c + slope * s) + root * (slope * c - 10 * s))


# Of each: moments, what spins the wheel up, what acts on the body, whether it is
# controlled, the tolerance, the duration, its rate at the start about axis 3.
RISING = {
    # a wheel spun up to h = 50 while a counter-torque holds the body: |d omega| is
    # conserved
    "wheel": (SYMMETRIC, 0.5, 0.5, 0.0, 1e-8, 100.0, 0.0),
    # a body at rest whose attitude control is switched on
    "control": (MOMENTS, 0.0, 0.0, 1.0, 1e-8, 30.0, 0.0),
    # a flat symmetric body spun up about its axis; the wobble rate grows to 40 rad/s
    "body": (np.array([1.0, 1.0, 5.0]), 0.0, 0.5, 0.0, 1e-4, 100.0, 0.01),
}
LANES = [np.array(x) for x in zip(*RISING.values(), strict=True)]


@pytest.fixture(scope="module")
def rising_columns():
    """d omega / d omega_1 of each, as lanes of one compilation."""

    def column(case):
        final = lambda w: _motion(w, case, FORWARD)  # noqa: E731
        return jax.jvp(final, (jnp.zeros(3),), (jnp.array([1.0, 0, 0]),))[1]

    return dict(
        zip(RISING, np.asarray(quick_jit(jax.vmap(column))(LANES)), strict=True)
    )


@pytest.mark.parametrize("what", RISING)
def test_derivative_where_a_fast_rate_appears_on_the_way(what, rising_columns):
    slope = rising_columns[what]
    if what == "control":
        # About axis 1 the body is x'' = -(25 x + 2 x') with 2 log(q) halved: see
        # _damped.
        np.testing.assert_allclose(abs(slope[0]), abs(_damped()), rtol=1e-5)
    else:
        np.testing.assert_allclose(np.hypot(*slope[:2]), 1.0, rtol=1e-5)


def test_reverse_mode_and_lanes_where_a_fast_rate_appears_on_the_way():
    moments, wheel = SYMMETRIC, (0.0, 1e-8, 100.0, 0.0)

    def final(scale):
        case = (moments, 0.5 * scale, 0.5 * scale, *wheel)
        return lambda w: _motion(w, case)[0]

    slopes = quick_jit(jax.vmap(lambda s: jax.grad(final(s))(jnp.zeros(3))))(
        jnp.array([1.0, 0.2])
    )
    # the turning plane has turned by the integral of h / I1
    np.testing.assert_allclose(slopes[0, :2], [np.cos(2500), -np.sin(2500)], atol=1e-4)
    np.testing.assert_allclose(slopes[1, :2], [np.cos(500), -np.sin(500)], atol=1e-4)


# Derivatives
# ---------------------------------------------------------------------------------


def test_gradient_in_float32_at_pure_spin():
    moments = SYMMETRIC.astype(np.float32)

    def final(omega):
        body, state0 = jr.RigidBody(moments), jr.State(SINGLE, omega)
        return jr.simulate(body, state0, np.float32(40)).states.omega[0]

    with pytest.warns(UserWarning, match="float32"):
        slope = quick_jit(jax.grad(final))(jnp.array([0, 0, 1.0], jnp.float32))
    assert slope.dtype == jnp.float32
    np.testing.assert_allclose(slope, [np.cos(20), -np.sin(20), 0], atol=2e-4)


def test_derivative_of_an_orbit_is_its_period_law():
    """d(angle)/d(strength) of a circle, from the exact linearised motion (Clohessy-Wiltshire)."""

    def final(velocity):
        state0 = jr.FloatingState(np.array([1.0, 0, 0]), velocity, UPRIGHT, np.zeros(3))
        trajectory = jr.simulate(ORBIT, state0, 40.0, jnp.ones(()), adjoint=FORWARD)
        return trajectory.states.position

    along = quick_jit(lambda v: jax.jvp(final, (v,), (jnp.array([0, 1.0, 0]),))[1])
    slope = along(jnp.array([0, 1.0, 0]))
    c, s = np.cos(40.0), np.sin(40.0)
    outward, forward = 2 * (1 - c), 4 * s - 3 * 40
    exact = [outward * c - forward * s, outward * s + forward * c, 0]
    np.testing.assert_allclose(slope, exact, atol=1e-5 * np.linalg.norm(exact))


def test_derivative_of_the_time_of_an_event():
    def when(rate):
        event = diffrax.Event(
            lambda _t, state, _args, **_: state.attitude[0] - jnp.cos(0.65),
            optx.Newton(1e-10, 1e-10),
        )
        state0 = jr.State(UPRIGHT, rate * jnp.array([0, 0, 1.0]))
        return jr.simulate(
            jr.RigidBody(MOMENTS), state0, jnp.array([5.0]), event=event
        ).final_time

    np.testing.assert_allclose(quick_jit(jax.grad(when))(2.0), -1.3 / 4, rtol=1e-7)


def test_second_derivative_at_pure_spin():
    direction = np.array([1.0, 0.5, 0.3])

    def final(omega):
        state0 = jr.State(UPRIGHT, omega)
        states = jr.simulate(
            jr.RigidBody(MOMENTS), state0, 10.0, adjoint=FORWARD
        ).states
        return jnp.concatenate([states.attitude, states.omega])

    # direction first: one trace of two derivatives, instead of four
    twice = quick_jit(
        lambda w: jax.jacfwd(lambda w: jax.jvp(final, (w,), (direction,))[1])(w)
    )
    for spin in ([0, 0, 1.0], [0, 1.0, 0]):
        along = np.concatenate([np.zeros(4), direction, np.zeros(3)])
        exact = free_hessian_vector(
            MOMENTS[None], UPRIGHT[None], np.array([spin]), 10.0, along
        )
        exact = exact[0][:, 4:7].astype(float)
        error = np.linalg.norm(np.asarray(twice(jnp.array(spin))) - exact)
        assert error <= 1e-5 * np.linalg.norm(exact), spin


def test_jacobian_after_a_thousand_turns():
    """At most 1000 rtol up to 1e4 radians."""
    omega = jnp.array([0.3, 0.5, 0.8])
    duration = 2 * np.pi * 1000 / np.linalg.norm(omega)

    def final(w):
        states = jr.simulate(
            jr.RigidBody(MOMENTS), jr.State(UPRIGHT, w), duration, adjoint=FORWARD
        )
        return jnp.concatenate([states.states.attitude, states.states.omega])

    def closed(w):
        states = jr.free_rotation(MOMENTS, jr.State(UPRIGHT, w), duration)
        return jnp.concatenate([states.attitude, states.omega])

    found, exact = (
        quick_jit(jax.jacfwd(final))(omega),
        quick_jit(jax.jacfwd(closed))(omega),
    )
    # q and -q are the same attitude
    sign = jnp.sign(found[:4].ravel() @ exact[:4].ravel())
    exact = exact.at[:4].multiply(sign)
    assert np.linalg.norm(found - exact) <= 1000 * 1e-8 * np.linalg.norm(exact)


# Lanes that fail
# -----------------------------------------------------------------------------


def _total(lane):
    def total(shared, own):
        values, result = jax.vmap(lane, in_axes=(None, 0))(shared, own)
        return jnp.sum(jnp.where(result == jr.RESULTS.successful, values, 0.0))

    return jax.grad(total, argnums=(0, 1))


def _fading(adjoint):
    """A torque that is NaN from t = 1 / own on."""
    max_steps = 64 if isinstance(adjoint, diffrax.DirectAdjoint) else None

    def lane(drag, own):
        torque = lambda t, s, a: -a[0] * s.omega * jnp.sqrt(1 - a[1] * t)  # noqa: E731
        body, state0 = (
            jr.RigidBody(MOMENTS, torque),
            jr.State(UPRIGHT, jnp.array([0.1, 0.2, 0.3])),
        )
        trajectory = jr.simulate(
            body,
            state0,
            2.0,
            (drag, own),
            throw=False,
            adjoint=adjoint,
            max_steps=max_steps,
        )
        return trajectory.states.omega[0], trajectory.result

    return lane


@pytest.mark.parametrize(
    "adjoint", [None, pytest.param(diffrax.DirectAdjoint(), marks=pytest.mark.slow)]
)
def test_a_lane_that_turns_nan_on_the_way_leaves_shared_gradients_alone(adjoint):
    gradient = quick_jit(_total(_fading(adjoint)))
    first, second = (gradient(0.1, np.array([0.1, 0.2, x])) for x in (0.1, 0.2))
    with_bad = gradient(0.1, np.array([0.1, 0.2, 0.9]))
    # 2 a + b and a + 2 b
    np.testing.assert_allclose(with_bad[0], (first[0] + second[0]) / 3, rtol=1e-12)
    np.testing.assert_allclose(with_bad[1], [*first[1][:2], 0.0], rtol=1e-12)


def test_bad_lanes_whose_force_closes_over_its_parameter_leave_shared_gradients_alone():
    """NaN in a state, NaN in what a force closes over, a start in the singularity."""

    def lane(shared, own):
        strength, start, omega = own

        def attraction(_t, state, _args):
            return (
                -shared * strength * state.position / jnp.sum(state.position**2) ** 1.5
            )

        body = jr.FloatingBody(BODY, attraction)
        state0 = jr.FloatingState(start, jnp.array([0, 0.7, 0]), UPRIGHT, omega)
        trajectory = jr.simulate(body, state0, 0.5, throw=False)
        return trajectory.states.position[0], trajectory.result

    good = jnp.ones(4), jnp.tile(jnp.array([1.0, 0, 0]), (4, 1)), jnp.full((4, 3), 0.2)
    strengths, starts, omegas = good
    bad = strengths.at[1].set(jnp.nan), starts.at[2].set(0.0), omegas.at[3].set(jnp.nan)
    gradient = quick_jit(_total(lane))
    np.testing.assert_allclose(
        gradient(2.0, bad)[0], gradient(2.0, good)[0] / 4, rtol=1e-12
    )


def test_a_bad_lane_does_not_keep_the_others_waiting():
    """The body that stands in for it would fall into the attractor of a real planet."""

    def lane(omega):
        state0 = jr.FloatingState(
            np.array([7e6, 0, 0]), np.array([0, 7.5e3, 0]), UPRIGHT, omega
        )
        body = jr.FloatingBody(BODY, lambda t, s, a: _attraction(t, s, 3.986e14))  # noqa: ARG005
        trajectory = jr.simulate(body, state0, 5000.0, throw=False)
        return trajectory.result, trajectory.stats["num_steps"]

    result, steps = quick_jit(jax.vmap(lane))(np.array([[0.0, 0, 0], [np.nan, 0, 0]]))
    assert [int(c) for c in result._value] == [0, int(jr.RESULTS.invalid_state._value)]
    assert 3 * steps[1] < 10 < steps[0] < 200


@pytest.mark.parametrize("which", ["rtol", "atol"])
@pytest.mark.parametrize("value", [5.0, -1.0, 0.0, 1e-16, np.nan, np.inf])
def test_a_traced_tolerance_is_checked(which, value):
    tolerances = {"rtol": np.full(2, 1e-6), "atol": np.full(2, 1e-6)}
    tolerances[which][1] = value
    result, omega, steps = _lanes_with(tolerances["rtol"], tolerances["atol"])
    assert [int(c) for c in result._value] == [
        0,
        int(jr.RESULTS.invalid_tolerance._value),
    ]
    assert np.all(np.isfinite(omega[0]))
    assert np.all(np.isnan(omega[1]))
    assert steps[1] < 20


@jax.jit
@jax.vmap
def _lanes_with(rtol, atol):
    body, state0 = jr.RigidBody(MOMENTS), jr.State(UPRIGHT, OMEGA)
    trajectory = jr.simulate(body, state0, 1.0, throw=False, rtol=rtol, atol=atol)
    return trajectory.result, trajectory.states.omega, trajectory.stats["num_steps"]


def test_a_traced_tolerance_out_of_bounds_raises_under_jit():
    def motion(rtol):
        state0 = jr.State(UPRIGHT, OMEGA)
        return jr.simulate(jr.RigidBody(MOMENTS), state0, 1.0, rtol=rtol).states

    with pytest.raises(RuntimeError, match="`rtol` and `atol` must be below 1"):
        jax.block_until_ready(quick_jit(motion)(jnp.array(5.0)))
    with pytest.raises(ValueError, match="`rtol` must be at least"):
        motion(np.nan)


def test_bad_mass_properties_in_a_lane_are_found():
    def lane(mass, center, moments, position):
        body = jr.MassProperties(mass, center, moments, throw=False)
        state0 = jr.FloatingState(position, np.ones(3), UPRIGHT, OMEGA)
        trajectory = jr.simulate(jr.FloatingBody(body), state0, 1.0, throw=False)
        return trajectory.result, trajectory.states.position

    codes = jr.RESULTS
    cases = [
        (1.0, 0.0, MOMENTS, 0.0, codes.successful),
        (-1.0, 0.0, MOMENTS, 0.0, codes.invalid_mass),
        (np.nan, 0.0, MOMENTS, 0.0, codes.invalid_mass),
        (1.0, np.nan, MOMENTS, 0.0, codes.invalid_mass),
        (1.0, 0.0, -MOMENTS, 0.0, codes.invalid_mass),
        (1.0, 0.0, np.array([1.0, 2.0, 4.0]), 0.0, codes.invalid_mass),
        (1.0, 0.0, np.array([1.0, 1.0, 0.0]), 0.0, codes.invalid_inertia),
        (1.0, 0.0, MOMENTS, np.inf, codes.invalid_state),
    ]
    masses, centers, moments, positions, expected = zip(*cases, strict=True)
    spread = lambda x: np.outer(x, np.ones(3))  # noqa: E731
    result, position = quick_jit(jax.vmap(lane))(
        np.array(masses), spread(centers), np.stack(moments), spread(positions)
    )
    np.testing.assert_array_equal(result._value, [int(x._value) for x in expected])
    assert np.all(np.isfinite(position[0]))
    assert np.all(np.isnan(position[1:]))


def test_the_origin_of_time_plays_no_role():
    """A body at rest, let go, is measured by the length of the run."""
    body = jr.FloatingBody(BODY, lambda _t, _s, _a: jnp.array([0.0, 0.0, -9.8]))
    state0 = jr.FloatingState(np.zeros(3), np.zeros(3), UPRIGHT, np.zeros(3))
    early, late = (jr.simulate(body, state0, t0 + 64.0, t0=t0) for t0 in (0.0, 4096.0))
    assert early.stats == late.stats
    np.testing.assert_allclose(
        late.final_state.position, early.final_state.position, rtol=1e-12
    )


# Precision
# -----------------------------------------------------------------------------------


def test_times_in_more_digits_than_the_state():
    state0 = jr.State(SINGLE, OMEGA.astype(np.float32))
    body = jr.RigidBody(MOMENTS.astype(np.float32))
    with pytest.warns(UserWarning, match="float32"):
        near = jr.simulate(body, state0, np.array([0.3, 10.0]))
    with pytest.warns(UserWarning, match="float32"):
        far = jr.simulate(body, state0, 1e8 + np.array([0.3, 10.0]), t0=1e8)
    assert far.states.omega.dtype == jnp.float32
    assert far.energy.dtype == jnp.float32
    np.testing.assert_allclose(far.states.omega, near.states.omega, atol=1e-5)
    np.testing.assert_allclose(far.final_time, 1e8 + 10, rtol=0, atol=1e-5)


def _starts(attitude, omega):
    state0, ts = jr.State(attitude, omega), np.array([0.05, 0.1])
    trajectory = jr.simulate(
        jr.RigidBody(MOMENTS.astype(omega.dtype)), state0, ts, throw=False
    )
    return bool(trajectory.result == jr.RESULTS.successful)


@pytest.mark.filterwarnings("ignore:simulate:UserWarning")
def test_what_counts_as_a_unit_quaternion(rng):
    exact = rng.normal(size=(3, 4))
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    single = exact.astype(np.float32)
    single_norm = np.linalg.norm(single, axis=1, keepdims=True)
    double, float32 = np.ones(3), np.ones(3, np.float32)
    for q, rounded, normalised in zip(exact, single, single / single_norm, strict=True):
        assert _starts(q, double)
        assert _starts(rounded, float32)
        assert _starts(normalised, float32)
        assert _starts(rounded.astype(np.float64), double)
    assert not _starts(np.array([0.7071, 0, 0, 0.7071]), double)
    assert not _starts(
        np.array([0.7, 0, 0, 0.7106], np.float32), float32
    )  # |q| = 0.9975


# Options
# -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda b, s: jr.simulate(b, s, None), "`ts` must be numbers, but it is None"),
        (lambda b, s: jr.simulate(b, s, "x"), "`ts` must be numbers"),
        (lambda b, s: jr.simulate(b, s, 1.0, t0="x"), "`t0` must be numbers"),
        (lambda b, s: jr.simulate(b, s, 1.0, rtol="x"), "`rtol` must be numbers"),
        (lambda b, s: jr.simulate(b, s, 1.0, atol="x"), "`atol` must be numbers"),
        (
            lambda b, s: jr.simulate(b, s, 1.0, max_step="x"),
            "`max_step` must be numbers",
        ),
        (
            lambda b, s: jr.simulate(b, s, 1.0, progress="x"),
            "`progress` must be a bool or a AbstractProgressMeter",
        ),
        (
            lambda b, s: jr.simulate(b, s, 1.0, max_steps=1e5),
            "`max_steps` must be an integer",
        ),
        (
            lambda b, s: jr.simulate(b, jr.State(None, s.omega), 1.0),
            "`state0.attitude` must be an",
        ),
        (
            lambda b, s: jr.simulate(b, jr.State(s.attitude, 1), 1.0),
            "`state0.omega` must be an",
        ),
        (
            lambda _b, s: jr.simulate(
                ORBIT, jr.FloatingState(None, np.ones(3), s.attitude, s.omega), 1.0
            ),
            "`state0.position` must be an",
        ),
        (lambda _b, _s: jr.RigidBody(BODY), r"`inertia` must be three .*`\.inertia`"),
    ],
)
def test_a_newcomers_mistake_is_a_value_error(untyped, call, message):
    with pytest.raises(ValueError, match=message):
        call(jr.RigidBody(MOMENTS), jr.State(ATTITUDE, OMEGA))
