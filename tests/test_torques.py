import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from helpers import ATTITUDE, MOMENTS, OMEGA, TENSOR, quick_jit, ulps

import jrigid as jr
from jrigid import rotation as ro
from jrigid import torques as tq
from jrigid._checks import Findings

GRAVITY = np.array([1.0, -2.0, -9.0])
LEVER = np.array([0.3, -0.2, 0.5])
MU = 4.0
H = np.array([0.4, -0.3, 0.6])


def orbit(t):
    return jnp.stack([2.0 + 0.3 * t, 1.0 - t, 0.5 * t * t])


def momentum_of_time(t):
    return jnp.stack([0.2 * jnp.sin(t), 0.5 - 0.1 * t, 0.3 * t**2])


STATE = jr.State(ATTITUDE, OMEGA)
POTENTIALS = {
    "gravity": tq.UniformGravity(2.0, LEVER, GRAVITY),
    "gradient, tensor": tq.GravityGradient(MU, orbit).of_body(TENSOR),
    "gradient, moments": tq.GravityGradient(MU, orbit).of_body(MOMENTS),
}
FIELD = np.array([0.3, 0.8, -0.5])
POTENTIALS["dipole"] = tq.MagneticDipole(LEVER, FIELD)
POTENTIALS["dipole, field of time"] = tq.MagneticDipole(LEVER, lambda t, _: orbit(t))
POTENTIALS["both and a drag"] = POTENTIALS["gravity"] + POTENTIALS["gradient, tensor"]


# --- torques that are not smooth
# --------------------------------------------------------------

PUSH = np.array([0.0, 0.0, 1.0])
TURNING = jr.State(np.array([1.0, 0, 0, 0]), np.array([0.0, 0.0, 0.01]))
ON, OFF = 1000.0, 1000.1


class Pulse(tq.AbstractTorque):
    torque: jax.Array = eqx.field(converter=jnp.asarray)
    start: jax.Array = eqx.field(converter=jnp.asarray)
    end: jax.Array = eqx.field(converter=jnp.asarray)

    def __call__(self, t, _state, _args):
        return jnp.where((t > self.start) & (t < self.end), self.torque, 0.0)

    @property
    def jumps(self):
        return jnp.stack([self.start, self.end])


def thruster(t, state, args):
    return jnp.where((t > ON) & (t < OFF), jnp.asarray(PUSH), 0.0)


@pytest.mark.parametrize("way", ["jumps", "a torque's own", "implicit"])
def test_a_pulse_that_is_shorter_than_a_step_acts(way):
    """A tenth of a second in an hour, in which the body turns by 36 rad."""
    own = tq.LinearDrag(0.0) + Pulse(PUSH, ON, OFF)
    torque = thruster if way == "jumps" else own
    jumps = np.array([OFF, ON]) if way == "jumps" else None
    solver, rtol = (diffrax.Kvaerno5(), 1e-6) if way == "implicit" else (None, None)
    body = jr.RigidBody(MOMENTS, torque)
    motion = jr.simulate(body, TURNING, 3600.0, jumps=jumps, solver=solver, rtol=rtol)
    expected = TURNING.omega + PUSH * (OFF - ON) / MOMENTS
    np.testing.assert_allclose(motion.final_state.omega, expected, atol=1e-9)


@pytest.mark.filterwarnings("ignore:simulate.. runs in float32")
def test_a_pulse_early_in_a_long_run_acts_in_single_precision():
    """The run is so long that its resolution at the end is coarser than the pulse."""
    pulse = Pulse(*(np.float32(x) for x in ([0, 0, 20.0], 1.0, 1.02)))
    body = jr.RigidBody(np.float32([1.0, 2.0, 1.0]), pulse)
    start = jr.State(np.float32([1, 0, 0, 0]), np.float32([0, 0, 1e-3]))
    motion = jr.simulate(body, start, np.float32(86400.0))
    np.testing.assert_allclose(motion.final_state.omega, [0, 0, 0.401], rtol=1e-5)


def test_splitting_keeps_its_order_at_a_pulse():
    body = jr.RigidBody(np.array([1.0, 2.0, 3.0]), Pulse(PUSH, 3.0, 4.0))
    start = jr.State(np.array([1.0, 0, 0, 0]), np.array([0.5, 0.3, 0.8]))
    expected = jr.simulate(body, start, 10.0, rtol=1e-12).final_state.omega

    @quick_jit
    def error(h):
        solver = jr.solvers.Splitting(4)
        motion = jr.simulate(body, start, 10.0, solver=solver, max_step=h)
        return jnp.max(jnp.abs(motion.final_state.omega - expected))

    assert error(0.1) < 1e-7
    assert 12 < error(0.1) / error(0.05) < 20


SWITCHED = 1.0


def rising_from_one_second(t, state, args):
    """Torques about the third axis: one that is switched on, and one that grows."""
    del state, args
    third = jnp.array([0.0, 0.0, 1.0])
    return (jnp.where(t > SWITCHED, 3.0, 0.0) + 0.3 * t) * third


@pytest.mark.parametrize(
    "adjoint", [None, diffrax.ForwardMode(), diffrax.DirectAdjoint()], ids=str
)
def test_an_earlier_start_does_not_move_a_switch(adjoint):
    """The rate at 2 s is w0 + (3 (2 - 1) + 0.15 (2^2 - t0^2)) / I3."""
    body = jr.RigidBody(np.array([1.0, 2.0, 3.0]), rising_from_one_second)
    max_steps = None if adjoint is None else 300

    def rate(t0):
        motion = jr.simulate(
            body,
            TURNING,
            2.0,
            t0=t0,
            jumps=np.array([SWITCHED]),
            adjoint=adjoint,
            max_steps=max_steps,
        )
        return motion.final_state.omega[2]

    derivative = jax.grad if adjoint is None else jax.jacfwd
    np.testing.assert_allclose(derivative(rate)(0.2), -0.1 * 0.2, rtol=1e-6)
    if isinstance(adjoint, diffrax.DirectAdjoint):
        np.testing.assert_allclose(jax.hessian(rate)(0.2), -0.1, rtol=1e-6)


def test_the_time_of_an_event_after_a_switch_does_not_move_with_the_start():
    body = jr.RigidBody(np.array([1.0, 2.0, 3.0]), Pulse(3 * PUSH, SWITCHED, 9.0))
    event = diffrax.Event(lambda _t, state, _args, **_: state.omega[2] - 0.51)

    def end(t0):
        return jr.simulate(body, TURNING, 2.0, t0=t0, event=event).final_time

    time, slope = jax.value_and_grad(end)(0.2)
    np.testing.assert_allclose([time, slope], [1.5, 0.0], atol=1e-7)


@pytest.mark.filterwarnings("ignore:simulate.. runs in float32")
def test_a_torque_of_time_is_not_given_times_that_its_precision_does_not_tell_apart():
    """Seconds since 1970: neighbouring float32 numbers are 128 s apart."""
    epoch = np.float64(1.7e9)
    start = jr.State(np.float32([1, 0, 0, 0]), np.float32([0, 0, 1.0]))
    moments = np.float32([1.0, 2.0, 3.0])

    def run(torque):
        body = jr.RigidBody(moments, torque)
        return jr.simulate(body, start, epoch + np.arange(3.0), t0=epoch, throw=False)

    steady = run(lambda *_: jnp.zeros(3, jnp.float32))
    assert steady.result == jr.RESULTS.successful
    pulse = Pulse(*(np.float32(x) for x in (PUSH, 0.0, 1.0)))
    assert run(pulse).result == jr.RESULTS.unresolved_times


def test_samples_in_no_order_and_no_samples_are_refused():
    with pytest.raises(RuntimeError, match="in order"):
        tq.Sampled(np.array([0.0, 2.0, 1.0]), np.zeros(3))
    with pytest.raises(ValueError, match="not be empty"):
        tq.Sampled(np.zeros(0), np.zeros(0))


def test_a_time_that_occurs_twice_is_a_step():
    """t^2 before, 5 - t^2 from it on: the cubics are exact on both sides."""
    ts = np.array([0.0, 0.5, 1.0, 1.0, 1.5, 2.0])
    table = tq.Sampled(ts, np.where(np.arange(6) < 3, ts**2, 5 - ts**2))
    times = np.array([0.2, 0.7, 1 - 1e-12, 1.0, 1.2, 1.9])
    expected = np.where(times < 1, times**2, 5 - times**2)
    found = jax.vmap(table)(times)
    np.testing.assert_allclose(found, expected, atol=ulps(float, 16))
    padded = tq.Sampled(np.append(ts, [2.0, 2.0]), np.append(table.values, [1.0, 1.0]))
    np.testing.assert_allclose(padded(3.0), 1.0, atol=ulps(float, 16))


def test_jumps_are_collected_from_all_parts_of_a_torque_and_a_force():
    table = tq.Sampled(np.array([1.0, 2.0, 4.0]), np.ones((3, 3)), delay=0.5)
    light = tq.SolarPressure(np.ones(1), PUSH[None], PUSH[None], table)
    known = {
        "a function": (thruster, []),
        "a sum": (Pulse(PUSH, ON, OFF) + tq.Rotor(table), [ON, OFF, 1.5, 2.5, 4.5]),
        "an orbit": (tq.GravityGradient(MU, table), [1.5, 2.5, 4.5]),
        "a module in a function's place": (tq.Torque(Pulse(PUSH, ON, OFF)), [ON, OFF]),
    }
    for torque, expected in known.values():
        np.testing.assert_array_equal(jr.RigidBody(MOMENTS, torque).jumps, expected)
    flying = jr.FloatingBody(
        jr.solids.sphere(1.0, 0.1), light.force, Pulse(PUSH, ON, OFF)
    )
    np.testing.assert_array_equal(flying.jumps, [ON, OFF, 1.5, 2.5, 4.5])


# --- torques that have a potential
# ------------------------------------------------------------


@pytest.mark.parametrize("name", POTENTIALS)
def test_a_torque_is_minus_the_gradient_of_its_potential(name):
    """-dV/de of V(q exp(e)) at e = 0 is the torque in body components."""
    torque = POTENTIALS[name]

    @jax.jit
    def both(q, t):
        state = lambda e: jr.State(ro.multiply(q, ro.exp(e)), OMEGA)  # noqa: E731
        gradient = jax.grad(lambda e: torque.potential(t, state(e), None))(jnp.zeros(3))
        return torque(t, jr.State(q, OMEGA), None), -gradient

    for q in (ATTITUDE, np.array([1.0, 0, 0, 0]), np.array([0.0, 0.6, 0.0, -0.8])):
        found, expected = both(q, 0.7)
        assert np.linalg.norm(expected) > 1e-3
        np.testing.assert_allclose(found, expected, atol=ulps(float, 256))


def test_uniform_gravity_against_numpy():
    r = np.asarray(ro.to_matrix(ATTITUDE))
    gravity = POTENTIALS["gravity"]
    in_space = np.cross(r @ LEVER, 2.0 * GRAVITY)
    np.testing.assert_allclose(
        gravity(0.0, STATE, None), r.T @ in_space, atol=ulps(float, 64)
    )
    np.testing.assert_allclose(
        gravity.potential(0.0, STATE, None),
        -2.0 * GRAVITY @ (r @ LEVER),
        rtol=ulps(float, 16),
    )


@pytest.mark.parametrize("inertia", [TENSOR, MOMENTS], ids=["tensor", "moments"])
def test_gravity_gradient_is_that_of_a_body_of_points(inertia):
    """Six point masses on the principal axes under Newton's force;
    the rest is of fourth order."""
    matrix = np.diag(inertia) if inertia.ndim == 1 else inertia
    moments, axes = np.linalg.eigh(matrix)
    arms = np.sqrt(moments.sum() / 2 - moments)  # two masses of 1/2 at each end
    size = 1e-3
    points = size * np.concatenate([(axes * arms).T, -(axes * arms).T])
    r = np.asarray(ro.to_matrix(ATTITUDE))
    center = np.asarray(orbit(0.7))
    torque, energy = np.zeros(3), 0.0
    for point in points:
        where = center + r @ point
        distance = np.linalg.norm(where)
        torque += np.cross(point, r.T @ (-0.5 * MU * where / distance**3))
        energy += -0.5 * MU * (1 / distance - 1 / np.linalg.norm(center))
    body = tq.GravityGradient(MU, orbit).of_body(size**2 * inertia)
    np.testing.assert_allclose(body(0.7, STATE, None), torque, atol=1e-5 * size**2)
    np.testing.assert_allclose(
        body.potential(0.7, STATE, None), energy, atol=1e-5 * size**2
    )


def test_gravity_gradient_of_the_earth_seen_in_float32():
    """mu / r^3 of the Sun in SI units: r^3 alone is out of the range of float32."""
    sun = tq.GravityGradient(1.327e20, lambda _: jnp.array([1.2e11, 9e10, 0.0]))
    sun = sun.of_body(MOMENTS)
    state = jr.State(np.float32(ATTITUDE), np.float32(OMEGA))
    found = sun(0.0, state, None)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, sun(0.0, STATE, None), rtol=ulps(np.float32, 32))


def test_gravity_gradient_at_the_bodys_own_position():
    position = np.asarray(orbit(0.7))
    flying = jr.FloatingState(position, OMEGA, ATTITUDE, OMEGA)
    own, given = tq.GravityGradient(MU).of_body(TENSOR), POTENTIALS["gradient, tensor"]
    np.testing.assert_array_equal(own(0.0, flying, None), given(0.7, STATE, None))
    assert own.potential(0.0, flying, None) == given.potential(0.7, STATE, None)


def test_a_dipole_against_numpy_in_a_field_of_time_and_place():
    r = np.asarray(ro.to_matrix(ATTITUDE))
    torque = tq.MagneticDipole(LEVER, FIELD)
    in_body = r.T @ FIELD
    np.testing.assert_allclose(
        torque(0.0, STATE, None), np.cross(LEVER, in_body), atol=ulps(float, 4)
    )
    np.testing.assert_allclose(
        torque.potential(0.0, STATE, None), -LEVER @ in_body, rtol=ulps(float, 8)
    )
    place = np.array([2.0, -1.0, 0.5])
    flying = jr.FloatingState(place, OMEGA, ATTITUDE, OMEGA)
    of_place = tq.MagneticDipole(LEVER, lambda t, s: t * s.position)(0.7, flying, None)
    np.testing.assert_allclose(
        of_place, np.cross(LEVER, r.T @ (0.7 * place)), atol=ulps(float, 4)
    )


def test_a_compass_needle_swings_at_its_frequency():
    """About the field at sqrt(m B / I), for small swings."""
    moment, field, inertia = 2.0, 3e-5, 0.01
    needle = tq.MagneticDipole(np.array([moment, 0, 0]), np.array([field, 0, 0]))
    body = jr.RigidBody(np.full(3, inertia), needle)

    def rate(e):
        return body.vector_field(0.0, jr.State(ro.exp(e), np.zeros(3)), None).omega

    stiffness = jax.jit(jax.jacfwd(rate))(jnp.zeros(3))
    expected = -moment * field / inertia * np.diag([0.0, 1.0, 1.0])
    np.testing.assert_allclose(stiffness, expected, atol=ulps(float, 4) * 6e-3)


# --- sunlight
# -------------------------------------------------------------------------------------

NORMALS = np.array([[0.0, 0.0, 2.0], [0.6, 0.0, -0.8], [0.0, 3.0, 0.0]])
PLATES = {
    "areas": np.array([1.5, 2.0, 0.7]),
    "normals": NORMALS,
    "centers": np.array([[0.4, 0.1, -0.2], [0.3, -0.5, 0.6], [0.2, 0.7, -0.1]]),
}
SUN = np.array([1.0, 2.0, 2.0])
COATINGS = {
    "black": (0.0, 0.0),
    "mirrors": (1.0, 0.0),
    "paper": (0.0, 1.0),
    "each its own": (np.array([0.1, 0.5, 0.0]), np.array([0.2, 0.3, 0.9])),
}


def momentum_of_light(sun, specular, diffuse):
    """Force and moment in body axes from what each photon brings and takes away."""
    force, moment = np.zeros(3), np.zeros(3)
    for k in range(3):
        area, arm = PLATES["areas"][k], PLATES["centers"][k]
        n = NORMALS[k] / np.linalg.norm(NORMALS[k])
        cosine = n @ sun
        if cosine <= 0:
            continue
        mirrored = 2 * cosine * n - sun
        # Lambert's law: the mean direction of what leaves is 2/3 of the normal
        scattered = 2 / 3 * n
        leaving = np.broadcast_to(specular, 3)[k] * mirrored
        leaving = leaving + np.broadcast_to(diffuse, 3)[k] * scattered
        push = -1361 / 299792458 * area * cosine * (sun + leaving)
        force, moment = force + push, moment + np.cross(arm, push)
    return force, moment


@pytest.mark.parametrize("name", COATINGS)
def test_sunlight_pushes_by_the_momentum_it_loses(name):
    specular, diffuse = COATINGS[name]
    light = tq.SolarPressure(**PLATES, sun=SUN, specular=specular, diffuse=diffuse)
    of_time = tq.SolarPressure(
        **PLATES, sun=lambda t: t * jnp.asarray(SUN), specular=specular, diffuse=diffuse
    )
    lit = set()
    for q in (
        ATTITUDE,
        np.eye(4)[0],
        np.array([0.0, 0.6, 0.0, -0.8]),
        np.array([0.6, 0, -0.8, 0]),
    ):
        r, state = np.asarray(ro.to_matrix(q)), jr.State(q, OMEGA)
        lit.add(tuple(NORMALS @ r.T @ SUN > 0))
        force, moment = momentum_of_light(r.T @ SUN / 3, specular, diffuse)
        for one in (light, of_time):
            np.testing.assert_allclose(
                one(0.4, state, None), moment, rtol=0, atol=1e-20
            )
            np.testing.assert_allclose(
                one.force(0.4, state, None), r @ force, rtol=0, atol=1e-20
            )
    assert len(lit) >= 3  # plates in the light and in the dark


def test_a_sail_in_flight_feels_force_and_torque():
    light = tq.SolarPressure(**PLATES, sun=SUN, specular=0.3)
    body = jr.FloatingBody(
        jr.MassProperties(2.0, np.zeros(3), TENSOR), light.force, light
    )
    place = np.array([2.0, -1.0, 0.5])
    flying = jr.FloatingState(place, OMEGA, ATTITUDE, OMEGA)
    rates = body.vector_field(0.0, flying, None)
    force = light.force(0.0, flying, None)
    np.testing.assert_allclose(rates.velocity, force / 2.0, rtol=ulps(float, 2))
    momentum = lambda s: body.angular_momentum(0.0, s, None)  # noqa: E731
    _, rate = jax.jvp(momentum, (flying,), (rates,))
    expected = np.cross(place, force) + ro.rotate(ATTITUDE, light(0.0, flying, None))
    np.testing.assert_allclose(rate, expected, atol=ulps(float, 64))


def test_no_light_no_torque_and_clean_derivatives_edge_on():
    """In an eclipse, from behind, and seen edge on,
    where value and derivatives are zero."""
    one = {"areas": np.ones(1), "normals": np.eye(3)[:1], "centers": np.eye(3)[1:2]}
    upright = jr.State(np.eye(4)[0], OMEGA)

    @jax.jit
    @jax.vmap
    def torque_and_derivatives(sun):
        light = tq.SolarPressure(**one, sun=sun, diffuse=0.4)
        torque = lambda e: light(0.0, jr.State(ro.exp(e), OMEGA), None)  # noqa: E731
        return [
            f(jnp.zeros(3)) for f in (torque, jax.jacfwd(torque), jax.jacrev(torque))
        ]

    for found in torque_and_derivatives(
        np.array([[0.0, 0, 0], [-1, 0.5, 0], [0, 1, 0]])
    ):
        assert np.all(np.asarray(found) == 0)
    eclipse = lambda t: jnp.where(t > 1, 0.0, 1.0) * jnp.asarray(SUN)  # noqa: E731
    dark = tq.SolarPressure(**PLATES, sun=eclipse)
    assert np.all(np.asarray(dark(2.0, upright, None)) == 0)
    assert np.any(np.asarray(dark(0.0, upright, None)) != 0)


# --- drag
# -------------------------------------------------------------------------------------

COEFFICIENTS = {
    "number": 0.3,
    "axes": np.array([0.1, 0.2, 0.4]),
    "tensor": 0.1 * TENSOR,
}


@pytest.mark.parametrize("name", COEFFICIENTS)
def test_drag_against_numpy(name):
    coefficient = COEFFICIENTS[name]
    matrix = coefficient * np.eye(3) if np.ndim(coefficient) < 2 else coefficient
    linear, quadratic = tq.LinearDrag(coefficient), tq.QuadraticDrag(coefficient)
    np.testing.assert_allclose(
        linear(0.0, STATE, None), -matrix @ OMEGA, atol=ulps(float, 2)
    )
    np.testing.assert_allclose(
        quadratic(0.0, STATE, None),
        -np.linalg.norm(OMEGA) * matrix @ OMEGA,
        atol=ulps(float, 2),
    )


FRICTION = {"coefficient": 0.3, "width": 1e-3, "start": 1.5, "moment": 2.0}
FRICTION_AXIS = np.array([0.0, 0.6, 0.8])


@pytest.fixture(scope="module")
def runs():
    """Four motions as lanes of one compilation, of a body that has all torques,
    some of them zero.

    Slowed by linear and by quadratic drag, stopped by friction, a gyrostat.
    """

    @jax.jit
    @jax.vmap
    def lanes(moments, linear, quadratic, friction, momentum, state0, ts, rtol):
        torque = (
            tq.LinearDrag(linear) + tq.QuadraticDrag(quadratic) + tq.Rotor(momentum)
        )
        torque += tq.CoulombFriction(friction, FRICTION["width"], FRICTION_AXIS)
        run = jr.simulate(jr.RigidBody(moments, torque), state0, ts, rtol=rtol)
        return run.states, run.stats["num_steps"], run.energy, run.angular_momentum

    spheres, rest = np.full((2, 3), 0.8), np.full(3, FRICTION["moment"])
    stop = FRICTION["moment"] * FRICTION["start"] / FRICTION["coefficient"]  # 10 s
    states = [
        STATE,
        STATE,
        jr.State(np.eye(4)[0], FRICTION["start"] * FRICTION_AXIS),
        STATE,
    ]
    zero, fall = np.zeros(6), np.array([0.3, 0.7, 0.95, 0.999, 2.0, 3.0]) * stop
    found = lanes(
        np.stack([*spheres, rest, MOMENTS]),
        np.array([0.3, 0, 0, 0]),
        np.array([0, 0.3, 0, 0]),
        np.array([0, 0, FRICTION["coefficient"], 0]),
        np.stack([zero[:3], zero[:3], zero[:3], H]),
        jax.tree.map(lambda *x: np.stack(x), *states),
        np.stack([np.linspace(0, 10, 6)] * 2 + [fall, np.linspace(0, 20, 6)]),
        np.array([1e-10, 1e-10, 1e-9, 1e-12]),
    )
    names = ("linear", "quadratic", "friction", "gyrostat")
    found = jax.tree.map(np.asarray, found)
    return {
        name: jax.tree.map(lambda x, k=k: x[k], found) for k, name in enumerate(names)
    }


def test_a_sphere_slows_down_as_linear_and_quadratic_drag_say(runs):
    """omega0 exp(-c t / I) and omega0 / (1 + c |omega0| t / I)."""
    moment, c = 0.8, 0.3
    ts = np.linspace(0, 10, 6)
    slow, slower = (runs[name][0].omega for name in ("linear", "quadratic"))
    exact = OMEGA * np.exp(-c * ts / moment)[:, None]
    np.testing.assert_allclose(slow, exact, rtol=1e-9)
    rate = np.linalg.norm(OMEGA)
    np.testing.assert_allclose(
        slower, OMEGA / (1 + c * rate * ts / moment)[:, None], rtol=1e-9
    )


def test_quadratic_drag_at_rest_has_value_and_gradient_zero():
    for coefficient in COEFFICIENTS.values():

        def drag(w, c=coefficient):
            return tq.QuadraticDrag(c)(0.0, jr.State(ATTITUDE, w), None)

        for derivative in (jax.jacfwd, jax.jacrev):
            both = quick_jit(lambda w, f=drag, d=derivative: (f(w), d(f)(w)))
            value, jacobian = both(jnp.zeros(3))
            assert np.all(np.asarray(value) == 0)
            assert np.all(np.asarray(jacobian) == 0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_friction_is_of_one_size_and_linear_below_its_width(dtype):
    axis = np.array([2.0, -3.0, 6.0], dtype)
    joint = tq.CoulombFriction(0.3, 1e-3)
    bearing = tq.CoulombFriction(0.3, 1e-3, axis)
    state = lambda w: jr.State(ATTITUDE.astype(dtype), w.astype(dtype))  # noqa: E731
    omega, unit = OMEGA.astype(dtype), axis / 7
    fast = omega / np.linalg.norm(omega)
    close = {"rtol": 2e-6}  # the width over the speed, squared
    np.testing.assert_allclose(joint(0.0, state(omega), None), -0.3 * fast, **close)
    turning = np.sign(unit @ omega)
    np.testing.assert_allclose(
        bearing(0.0, state(omega), None), -0.3 * turning * unit, **close
    )
    at_width = np.linalg.norm(joint(0.0, state(1e-3 * fast), None))
    np.testing.assert_allclose(at_width, 0.3 / np.sqrt(2), rtol=ulps(dtype, 8))
    across = np.cross(unit, omega)  # turning about another axis is free
    np.testing.assert_allclose(
        bearing(0.0, state(across), None), np.zeros(3), atol=2e-5
    )
    for friction, slope in ((joint, np.eye(3)), (bearing, np.outer(unit, unit))):
        torque = lambda w, f=friction: f(0.0, jr.State(ATTITUDE.astype(dtype), w), None)  # noqa: E731
        for derivative in (jax.jacfwd, jax.jacrev):
            found = quick_jit(derivative(torque))(np.zeros(3, dtype))
            np.testing.assert_allclose(found, -300.0 * slope, rtol=1e-6, atol=1e-4)
        assert np.all(np.asarray(torque(np.zeros(3, dtype))) == 0)


def test_friction_brings_a_body_to_rest_at_the_time_and_in_few_steps(runs):
    """I w' = -c w / sqrt(w^2 + e^2): sqrt(w^2 + e^2) - e arsinh(e / w) falls as c t /
    I.

    A callable -c sign(omega) took 43 s and ended at `max_steps`.
    """
    c, width, start, moment = FRICTION.values()
    axis, stop = FRICTION_AXIS, moment * start / c
    ts = np.array([0.3, 0.7, 0.95, 0.999, 2.0, 3.0]) * stop
    states, steps, energy, _ = runs["friction"]
    assert int(steps) < 10_000  # most of them at rest: 2.5 for I e / c
    fall = lambda w: np.hypot(w, width) - width * np.arcsinh(width / w)  # noqa: E731
    for t, omega in zip(ts[:4], states.omega, strict=False):
        exact = scipy.optimize.brentq(
            lambda w, t=t: fall(w) - fall(start) + c * t / moment,
            1e-12,
            start,
            xtol=1e-14,
        )
        np.testing.assert_allclose(omega, exact * axis, atol=1e-8)
    assert np.linalg.norm(states.omega[4:]) < 1e-9
    # the energy went into heat, and the angle is that of a constant torque, to the
    # width
    assert np.all(np.diff(energy[:5]) < 0)
    angle = start**2 * moment / (2 * c)
    turned = ro.angle_between(states.attitude[-1], ro.from_axis_angle(axis, angle))
    assert turned < 1e-4


# --- sums and states of internal parts
# --------------------------------------------------------

WHEEL = tq.SpinningMass(0.3, np.array([1.0, 2.0, -2.0]))
DAMPER, SLOSH = tq.InternalDamper(0.2, 0.05), tq.InternalDamper(0.4, 0.02)


def test_torques_add_with_plus_and_sum_and_with_plain_functions():
    spring = lambda t, state, args: -args * state.omega + t  # noqa: E731
    constant, drag = tq.Constant(H), tq.LinearDrag(0.3)
    expected = np.asarray(H) - 0.3 * OMEGA + (-2.0 * OMEGA + 0.5)
    sums = [constant + drag + spring, sum([constant, drag, tq.Torque(spring)])]
    sums += [
        spring + constant + drag,
        constant + (drag + spring),
        sum([constant, drag, spring]),
    ]
    for total in sums:
        assert len(total.terms) == 3  # flat, whatever the brackets
        np.testing.assert_allclose(
            total(0.5, STATE, 2.0), expected, atol=ulps(float, 4)
        )
        assert total.potential(0.5, STATE, 2.0) == 0
    assert sum([drag]) is drag
    in_any_order = tq.Sum([spring, constant, tq.Sum((drag,))])
    assert len(in_any_order.terms) == 3
    np.testing.assert_allclose(
        in_any_order(0.5, STATE, 2.0), expected, atol=ulps(float, 4)
    )
    with pytest.raises(
        TypeError, match="unsupported operand"
    ):  # Python's own: 0 + function
        sum([spring, constant])
    nothing = tq.as_torque(None)
    assert np.all(np.asarray(nothing(0.0, STATE, None)) == 0)
    assert nothing.internal_at_rest(STATE) == ()


def test_potentials_add():
    height = tq.Torque(lambda *_: jnp.zeros(3), lambda _t, s, _a: 2 * s.attitude[0])
    total = POTENTIALS["gravity"] + height + tq.LinearDrag(1.0)
    expected = POTENTIALS["gravity"].potential(0.0, STATE, None) + 2 * ATTITUDE[0]
    np.testing.assert_allclose(
        total.potential(0.0, STATE, None), expected, rtol=ulps(float, 2)
    )


def test_internal_states_of_a_sum_are_a_tuple_in_the_order_of_the_terms():
    total = tq.Constant(H) + DAMPER + WHEEL + tq.LinearDrag(0.1) + SLOSH + tq.Rotor(H)
    rest = total.internal_at_rest(STATE)
    axis = np.array([1.0, 2.0, -2.0]) / 3
    assert len(rest) == 3
    np.testing.assert_array_equal(rest[0], OMEGA)
    np.testing.assert_allclose(rest[1], axis @ OMEGA, rtol=ulps(float, 2))
    np.testing.assert_array_equal(rest[2], OMEGA)
    structure = jax.tree.structure
    inner, spin, outer = np.array([1.0, 2, 3]), 5.0, np.array([-0.5, 0.2, 0.1])
    state = jr.State(
        ATTITUDE, OMEGA, (jnp.asarray(inner), jnp.asarray(spin), jnp.asarray(outer))
    )
    rate = total.internal_rate(0.0, state, None)
    assert (
        structure(rate)
        == structure(rest)
        == structure(total.internal_scale(jnp.array(2.0)))
    )

    momentum = 0.2 * inner + 0.3 * spin * axis + 0.4 * outer + H
    found = total.internal_momentum(0.0, state, None)
    np.testing.assert_allclose(found, momentum, atol=ulps(float, 4))
    energy = 0.1 * inner @ inner + 0.15 * spin**2 + 0.2 * outer @ outer
    np.testing.assert_allclose(
        total.internal_energy(0.0, state, None), energy, rtol=ulps(float, 4)
    )
    torque = (
        H
        - 0.1 * OMEGA
        + 0.05 * (inner - OMEGA)
        + 0.02 * (outer - OMEGA)
        - np.cross(OMEGA, 0.3 * spin * axis + H)
    )
    np.testing.assert_allclose(total(0.0, state, None), torque, atol=ulps(float, 8))
    pulls = 0.05 * (inner - OMEGA) / 0.2, 0.02 * (outer - OMEGA) / 0.4
    expected = [
        -pulls[0] - np.cross(OMEGA, inner),
        0.0,
        -pulls[1] - np.cross(OMEGA, outer),
    ]
    for a, b in zip(rate, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=ulps(float, 8))


def test_the_internal_state_of_one_carrier_is_a_tuple_of_one():
    total = tq.LinearDrag(0.1) + DAMPER
    state = jr.State(ATTITUDE, OMEGA, total.internal_at_rest(STATE))
    assert [x.shape for x in state.internal] == [(3,)]
    (spin,) = WHEEL.internal_at_rest(STATE)
    assert spin.shape == ()
    alone = jr.State(ATTITUDE, OMEGA, DAMPER.internal_at_rest(STATE))
    np.testing.assert_array_equal(
        total.internal_rate(0.0, state, None), DAMPER.internal_rate(0.0, alone, None)
    )
    # at rest relative to the body it exerts nothing
    np.testing.assert_allclose(
        total(0.0, state, None), -0.1 * OMEGA, atol=ulps(float, 1)
    )


def test_a_plain_torque_sees_the_whole_internal_state_alone_and_in_a_sum():
    """Terms that carry a part see their own; the others all of it,
    in torque and potential."""
    first = lambda s: jax.tree.leaves(s.internal)[0]  # noqa: E731
    plain = tq.Torque(lambda _t, s, _a: 1.0 * first(s), lambda _t, s, _a: first(s)[0])
    inner, outer = jnp.array([1.0, 2, 3]), jnp.array([-0.5, 0.2, 0.1])
    alone = jr.State(ATTITUDE, OMEGA, (inner,))
    one, two = DAMPER + plain, DAMPER + plain + SLOSH
    np.testing.assert_allclose(
        one(0.0, alone, None),
        plain(0.0, alone, None) + DAMPER(0.0, alone, None),
        atol=ulps(float, 4),
    )
    assert one.potential(0.0, alone, None) == plain.potential(0.0, alone, None) == 1
    both = jr.State(ATTITUDE, OMEGA, (inner, outer))
    expected = inner + 0.05 * (inner - OMEGA) + 0.02 * (outer - OMEGA)
    np.testing.assert_allclose(two(0.0, both, None), expected, atol=ulps(float, 4))
    assert two.potential(0.0, both, None) == 1
    nested = tq.Sum((DAMPER, tq.Sum((plain,)), SLOSH))
    np.testing.assert_allclose(nested(0.0, both, None), expected, atol=ulps(float, 4))


class Sprung(tq.InternalDamper):
    """A part whose potential depends on its own state."""

    def potential(self, t, state, args):
        del t, args
        return 2 * jnp.sum(*state.internal)


def test_the_potential_of_a_part_in_a_sum_is_that_of_its_own_state():
    total = DAMPER + Sprung(0.2, 0.05) + POTENTIALS["gravity"]
    state = jr.State(ATTITUDE, OMEGA, (jnp.ones(3), jnp.array([0.3, 0.1, 0.3])))
    expected = 1.4 + POTENTIALS["gravity"].potential(0.0, STATE, None)
    np.testing.assert_allclose(
        total.potential(0.0, state, None), expected, rtol=ulps(float, 4)
    )


def test_internal_parts_exert_what_they_lose():
    """The space rate of their own momentum is minus their torque, whatever they do."""
    wheel = tq.SpinningMass(
        0.3, np.array([1.0, 2.0, -2.0]), lambda t, s, _a: 0.7 * t + s.omega[0]
    )
    parts = {
        "damper": (DAMPER, (jnp.array([1.0, 2, 3]),)),
        "wheel": (wheel, (jnp.array(5.0),)),
        "prescribed": (tq.Rotor(momentum_of_time), ()),
    }
    t = jnp.asarray(0.4)
    for name, (part, internal) in parts.items():
        state = jr.State(ATTITUDE, OMEGA, internal)
        rates = jr.State(
            ro.attitude_rate(ATTITUDE, OMEGA),
            jr.euler_equations(TENSOR, OMEGA, part(t, state, None)),
            part.internal_rate(t, state, None),
        )

        def momentum(t, s, p=part):
            return ro.rotate(s.attitude, p.internal_momentum(t, s, None))

        _, rate = jax.jvp(momentum, (t, state), (jnp.ones_like(t), rates))
        expected = -ro.rotate(ATTITUDE, part(t, state, None))
        np.testing.assert_allclose(rate, expected, atol=ulps(float, 32), err_msg=name)


def test_a_damper_loses_energy_as_its_coupling_says():
    inner = jnp.array([1.0, 2.0, 3.0])
    body = jr.RigidBody(TENSOR, DAMPER)
    state = jr.State(ATTITUDE, OMEGA, (inner,))
    rates = body.vector_field(0.0, state, None)
    _, power = jax.jvp(lambda s: body.energy(0.0, s, None), (state,), (rates,))
    np.testing.assert_allclose(
        power, -0.05 * np.sum((inner - OMEGA) ** 2), rtol=ulps(float, 32)
    )


def test_damping_ends_in_spin_about_the_major_axis_with_all_momentum_kept():
    """From near the minor axis through the separatrix;
    two dampers and a free wheel's state."""
    body = jr.RigidBody(
        MOMENTS, tq.InternalDamper(0.3, 0.5) + tq.InternalDamper(0.2, 0.1)
    )
    state0 = jr.State(ATTITUDE, np.array([3.0, 0.2, 0.1]))
    ts = np.linspace(0, 100, 201)
    run = jr.simulate(body, state0, ts, rtol=1e-12)
    assert [x.shape for x in run.states.internal] == [(201, 3), (201, 3)]
    momentum = np.asarray(run.angular_momentum)
    np.testing.assert_allclose(
        momentum,
        np.broadcast_to(momentum[0], (201, 3)),
        atol=1e-12 * np.linalg.norm(momentum[0]),
    )
    energy = np.asarray(run.energy)
    alive = energy - energy[-1] > 1e-9
    assert np.count_nonzero(alive) > 60
    assert np.all(np.diff(energy)[alive[:-1]] < 0)
    omega, total = np.asarray(run.states.omega[-1]), np.linalg.norm(momentum[0])
    assert np.linalg.norm(omega[:2]) < 1e-3 * abs(omega[2])
    np.testing.assert_allclose(
        energy[-1], total**2 / (2 * (3.0 + 0.3 + 0.2)), rtol=1e-5
    )
    assert np.argmax(np.abs(run.states.omega[0])) == 0


# --- rotors
# -----------------------------------------------------------------------------------


def test_a_gyrostat_follows_hand_derived_equations(runs):
    """(I w)' = (I w + h) x w for constant h, written out and integrated by scipy."""

    def rate(t, w):
        i1, i2, i3 = MOMENTS
        h1, h2, h3 = H
        a, b, c = w
        return [
            ((i2 - i3) * b * c + h2 * c - h3 * b) / i1,
            ((i3 - i1) * c * a + h3 * a - h1 * c) / i2,
            ((i1 - i2) * a * b + h1 * b - h2 * a) / i3,
        ]

    ts = np.linspace(0, 20, 6)
    states, _, _, momentum = runs["gyrostat"]
    exact = scipy.integrate.solve_ivp(
        rate, (0, 20), OMEGA, "DOP853", ts, rtol=1e-13, atol=1e-14
    )
    np.testing.assert_allclose(states.omega, exact.y.T, atol=1e-10)
    np.testing.assert_allclose(
        momentum, np.broadcast_to(momentum[0], (6, 3)), atol=2e-12
    )
    np.testing.assert_allclose(
        momentum[0], ro.rotate(ATTITUDE, MOMENTS * OMEGA + H), atol=1e-14
    )


def test_a_prescribed_function_of_time_may_be_constant():
    found = tq.Rotor(lambda _: jnp.asarray(H))(0.3, STATE, None)
    np.testing.assert_allclose(found, -np.cross(OMEGA, H), atol=ulps(float, 2))


def test_prescribed_momentum_equals_a_wheel_driven_by_the_motor_that_keeps_it():
    """J s = h + J a.omega and motor = h' + J a.omega';
    the wheel leaves the body's inertia."""
    axis = np.array([1.0, 2.0, -2.0]) / 3
    moment = 0.3
    h = lambda t: 0.5 + 0.2 * t - 0.1 * t**3  # noqa: E731
    t = 0.6
    value, slope = h(t), 0.2 - 0.3 * t**2
    prescribed = tq.Rotor(lambda t: h(t) * jnp.asarray(axis))
    free = jr.RigidBody(TENSOR, prescribed).vector_field(t, STATE, None)
    momentum = prescribed.internal_momentum(t, STATE, None)
    np.testing.assert_allclose(momentum, value * axis, rtol=ulps(float, 4))

    motor = slope + moment * axis @ np.asarray(free.omega)
    spin = value / moment + axis @ OMEGA
    wheel = tq.SpinningMass(moment, axis, lambda *_: motor)
    body = jr.RigidBody(TENSOR - moment * np.outer(axis, axis), wheel)
    state = jr.State(ATTITUDE, OMEGA, (jnp.asarray(spin),))
    found = body.vector_field(t, state, None)
    np.testing.assert_allclose(found.omega, free.omega, atol=ulps(float, 16))
    np.testing.assert_allclose(found.internal[0], motor / moment, rtol=ulps(float, 4))
    np.testing.assert_allclose(
        body.angular_momentum(t, state, None),
        jr.RigidBody(TENSOR, prescribed).angular_momentum(t, STATE, None),
        atol=ulps(float, 16),
    )


def test_a_free_wheel_keeps_energy_momentum_and_its_spin():
    body = jr.RigidBody(TENSOR, WHEEL)
    state = jr.State(ATTITUDE, OMEGA, (jnp.asarray(4.0),))

    @jax.jit
    def rates(state):
        def invariants(s):
            return (
                body.energy(0.0, s, None),
                body.angular_momentum(0.0, s, None),
            )

        rate = body.vector_field(0.0, state, None)
        return rate, *jax.jvp(invariants, (state,), (rate,))[1]

    rate, power, momentum_rate = rates(state)
    assert rate.internal == (0,)
    assert np.linalg.norm(rate.omega) > 0.1
    assert abs(power) <= ulps(float, 16)
    np.testing.assert_allclose(momentum_rate, np.zeros(3), atol=ulps(float, 16))


def test_a_wheel_started_without_a_state_turns_with_the_body():
    """Then, and only at that instant, body and wheel move as one rigid body with a
    brake."""
    axis = np.array([1.0, 2.0, -2.0]) / 3
    body = jr.RigidBody(TENSOR, WHEEL)
    state = jr.State(ATTITUDE, OMEGA, body.torque.internal_at_rest(STATE))
    whole = TENSOR + 0.3 * np.outer(axis, axis)
    expected = ro.rotate(ATTITUDE, whole @ OMEGA)
    np.testing.assert_allclose(
        body.angular_momentum(0.0, state, None), expected, atol=ulps(float, 16)
    )
    np.testing.assert_allclose(
        body.energy(0.0, state, None), OMEGA @ whole @ OMEGA / 2, rtol=ulps(float, 8)
    )


# --- values of parameters
# ---------------------------------------------------------------------


def sunlit(**changes):
    return tq.SolarPressure(**{**PLATES, "sun": SUN, **changes})


def findings_of(torque):
    findings = Findings()
    torque.check(findings)
    return findings


INDEFINITE = np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
ROW = np.array([1.0, -2.0, 0.5])
SKEW = np.array([[1.0, 0.2, 0.0], [-0.2, 1.0, 0.0], [0.0, 0.0, 1.0]])
NAN3 = np.array([0.0, np.nan, 0.0])
BAD_VALUES = {
    "mu": (lambda: tq.GravityGradient(np.inf, orbit), "mu"),
    "mass": (lambda: tq.UniformGravity(-1.0, LEVER, GRAVITY), "mass"),
    "nan mass": (lambda: tq.UniformGravity(np.nan, LEVER, GRAVITY), "mass"),
    "lever": (lambda: tq.UniformGravity(1.0, NAN3, GRAVITY), "lever"),
    "gravity": (lambda: tq.UniformGravity(1.0, LEVER, NAN3), "gravity"),
    "damper": (lambda: tq.InternalDamper(0.0, 0.1), "inertia"),
    "coupling": (lambda: tq.InternalDamper(0.1, -0.1), "coupling"),
    "nan coupling": (lambda: tq.InternalDamper(0.1, np.nan), "coupling"),
    "wheel": (lambda: tq.SpinningMass(-1.0, LEVER), "inertia"),
    "axis": (lambda: tq.SpinningMass(1.0, np.zeros(3)), "axis"),
    "linear": (lambda: tq.LinearDrag(-0.1), "coefficient"),
    "linear, axes": (lambda: tq.LinearDrag(np.array([1.0, -1.0, 0.0])), "coefficient"),
    "linear, tensor": (lambda: tq.LinearDrag(INDEFINITE), "coefficient"),
    "quadratic": (lambda: tq.QuadraticDrag(np.inf), "coefficient"),
    "quadratic, tensor": (lambda: tq.QuadraticDrag(SKEW), "coefficient"),
    "constant": (lambda: tq.Constant(NAN3), "torque"),
    "rotor": (lambda: tq.Rotor(NAN3), "momentum"),
    "dipole": (lambda: tq.MagneticDipole(NAN3, FIELD), "moment"),
    "field": (lambda: tq.MagneticDipole(LEVER, NAN3), "field"),
    "friction": (lambda: tq.CoulombFriction(-0.1, 1.0), "magnitude"),
    "width": (lambda: tq.CoulombFriction(0.1, 0.0), "width"),
    "bearing": (lambda: tq.CoulombFriction(0.1, 1.0, np.zeros(3)), "axis"),
    "area": (lambda: sunlit(areas=-PLATES["areas"]), "areas"),
    "normal": (lambda: sunlit(normals=NORMALS * [[1], [0], [1]]), "normals"),
    "center": (lambda: sunlit(centers=np.full((3, 3), np.nan)), "centers"),
    "sun": (lambda: sunlit(sun=NAN3), "sun"),
    "specular": (lambda: sunlit(specular=-0.1), "specular"),
    "diffuse": (lambda: sunlit(diffuse=np.array([0.1, np.nan, 0.2])), "diffuse"),
    "pressure": (lambda: sunlit(pressure=-1.0), "pressure"),
}


def unchecked(build):
    """A torque whose parameters are traced, and so not known, when it is built."""
    return eqx.filter_jit(build)()


@pytest.mark.parametrize("name", BAD_VALUES)
def test_a_bad_parameter_is_found_alone_and_in_a_sum(name):
    build, argument = BAD_VALUES[name]
    torque = unchecked(build)
    for bad in (torque, tq.LinearDrag(0.1) + torque, tq.Sum((tq.Sum((torque,)),))):
        findings = findings_of(bad)
        assert findings.result == jr.RESULTS.invalid_torque
        with pytest.raises(RuntimeError, match=f"Argument `{argument}` of `"):
            findings.guard(jnp.zeros(()), throw=True)


# Parameters of the wrong sign, and the end of the message.
WRONG_SIGN = {
    "mass": "must be finite and not negative, but it is -1.0.",
    "damper": "must be positive and finite, but it is 0.0.",
    "coupling": "must be finite and not negative, but it is -0.1.",
    "wheel": "must be positive and finite, but it is -1.0.",
    "linear": "must be finite and not negative .*, but it is -0.1.",
    "linear, axes": r"must be finite and not negative .*, but it is \[ 1. -1.  0.\].",
    "linear, tensor": r"must be .* positive semi-definite\), but it is \[\[1. 2. 0.\]",
    "friction": "must be finite and not negative, but it is -0.1.",
    "width": "must be positive and finite, but it is 0.0.",
    "area": "must be finite and not negative, but it is ",
    "specular": "must be finite and not negative, but it is -0.1.",
    "pressure": "must be finite and not negative, but it is -1.0.",
}


@pytest.mark.parametrize("name", WRONG_SIGN)
def test_a_known_parameter_of_the_wrong_sign_is_refused_when_the_torque_is_built(name):
    build, argument = BAD_VALUES[name]
    message = f"Argument `{argument}` of `[A-Za-z]*` {WRONG_SIGN[name]}"
    with pytest.raises(RuntimeError, match=message):
        build()


@pytest.mark.parametrize("name", sorted(BAD_VALUES.keys() - WRONG_SIGN))
def test_other_bad_values_are_left_to_the_simulation(name):
    build, _ = BAD_VALUES[name]
    assert findings_of(build()).result == jr.RESULTS.invalid_torque


def test_a_quadratic_drag_and_samples_of_the_wrong_sign_are_refused():
    with pytest.raises(RuntimeError, match="`coefficient` of `QuadraticDrag` must"):
        tq.QuadraticDrag(-0.1)
    with pytest.raises(RuntimeError, match=r"`scale` of `Sampled` must .* it is -2\.0"):
        tq.Sampled(np.arange(3.0), np.ones((3, 3)), scale=-2.0)
    # By rounding an eigenvalue of a product may be negative.
    tq.LinearDrag(np.outer(ROW, ROW))


def test_good_parameters_are_let_pass_and_bad_lanes_are_told_apart():
    good = [tq.UniformGravity(0.0, LEVER, GRAVITY), tq.GravityGradient(0.0), DAMPER]
    good += [
        tq.InternalDamper(0.1, 0.0),
        WHEEL,
        tq.Rotor(H),
        tq.Rotor(momentum_of_time),
    ]
    good += [
        POTENTIALS["dipole"],
        tq.CoulombFriction(0.0, 1.0),
        tq.CoulombFriction(1.0, 1.0, H),
    ]
    good += [
        sunlit(specular=0.4, diffuse=0.6),
        sunlit(sun=np.zeros(3)),
        sunlit(sun=lambda _: SUN),
    ]
    good += [tq.LinearDrag(c) for c in (0.0, TENSOR, np.zeros((3, 3)), MOMENTS)]
    good += [
        tq.QuadraticDrag(1e-30 * np.outer(ROW, ROW)),
        tq.Constant(H),
        tq.as_torque(None),
    ]
    good += [
        tq.LinearDrag(np.float32(1e20 * np.outer(ROW, ROW))),
        tq.Torque(lambda *_: NAN3),
    ]
    for torque in good:
        assert findings_of(torque).ok, torque

    lanes = jax.jit(
        jax.vmap(lambda c: findings_of(tq.LinearDrag(c) + tq.Constant(H)).result)
    )
    codes = lanes(np.array([0.1, -0.1, np.nan]))
    for k, code in enumerate(("successful", "invalid_torque", "invalid_torque")):
        assert (codes == getattr(jr.RESULTS, code))[k]


def test_what_a_torque_says_of_a_bad_value_shows_it():
    for torque, message in (
        (
            unchecked(lambda: tq.LinearDrag(-0.25)),
            r"`coefficient` of `LinearDrag` must be .*, but it is not: -0\.25",
        ),
        (
            tq.SpinningMass(1.0, np.zeros(3)),
            r"`axis` of `SpinningMass` .* not: \[0\. 0\. 0\.\]",
        ),
        (
            sunlit(specular=0.7, diffuse=np.array([0.1, 0.4, 0.0])),
            r"`specular` and `diffuse` .* at most 1, but .* not: \[0\.8 1\.1 0\.7\]",
        ),
    ):
        with pytest.raises(RuntimeError, match=message):
            findings_of(torque).guard(jnp.zeros(()), throw=True)


# --- arguments
# --------------------------------------------------------------------------------

FOUR = np.ones(4)
WRONG = {
    "not callable": (
        lambda: tq.as_torque(3.0),
        r"`torque` must be a callable \(t, state, args\) -> \(3,\), but it is 3.0",
    ),
    "sum with a number": (lambda: DAMPER + 3.0, r"`torque` must be a callable"),
    "constant": (
        lambda: tq.Constant(FOUR),
        r"`torque` must have shape \(3,\), but it has",
    ),
    "lever": (
        lambda: tq.UniformGravity(1.0, FOUR, GRAVITY),
        r"`lever` must have shape \(3,\), but it has shape \(4,\)",
    ),
    "gravity": (
        lambda: tq.UniformGravity(1.0, LEVER, np.array(9.8)),
        r"`gravity` must have shape \(3,\), but it has shape \(\)",
    ),
    "mass": (
        lambda: tq.UniformGravity(np.ones(2), LEVER, GRAVITY),
        r"`mass` must have shape \(\), but it has shape \(2,\)",
    ),
    "gradient": (
        lambda: tq.GravityGradient(MU, orbit).of_body(FOUR),
        r"`inertia` must have shape \(3,\) or \(3, 3\), but it has shape \(4,\)",
    ),
    "mu": (
        lambda: tq.GravityGradient(np.ones(2), orbit),
        r"`mu` must have shape \(\), but it has shape \(2,\)",
    ),
    "unbound": (
        lambda: tq.GravityGradient(MU, orbit)(0.0, STATE, None),
        "`torque` must know the inertia of its body, but this `GravityGradient` does "
        "not",
    ),
    "dipole": (
        lambda: tq.MagneticDipole(FOUR, FIELD),
        r"`moment` must have shape \(3,\), but",
    ),
    "field of time": (
        lambda: tq.MagneticDipole(LEVER, lambda *_: jnp.ones(4))(0.0, STATE, None),
        r"`field` must have shape \(3,\), but it has shape \(4,\)",
    ),
    "normals": (
        lambda: sunlit(normals=NORMALS[:2]),
        r"`normals` must have shape \(3, 3\), but it has shape \(2, 3\)",
    ),
    "specular": (
        lambda: sunlit(specular=np.ones(2)),
        r"`specular` must have shape \(3,\), but it has shape \(2,\)",
    ),
    "friction": (
        lambda: tq.CoulombFriction(MOMENTS, 1.0),
        r"`magnitude` must have shape \(\), but it has shape \(3,\)",
    ),
    "linear": (
        lambda: tq.LinearDrag(FOUR),
        r"`coefficient` must have shape \(\) or \(3,\) or \(3, 3\), but it has shape "
        r"\(4,\)",
    ),
    "quadratic": (lambda: tq.QuadraticDrag(FOUR), r"`coefficient` must have shape"),
    "damper": (
        lambda: tq.InternalDamper(MOMENTS, 0.1),
        r"`inertia` must have shape \(\), but it has shape \(3,\)",
    ),
    "coupling": (
        lambda: tq.InternalDamper(0.1, MOMENTS),
        r"`coupling` must have shape \(\), but it has shape \(3,\)",
    ),
    "axis": (lambda: tq.SpinningMass(1.0, FOUR), r"`axis` must have shape \(3,\), but"),
    "wheel": (
        lambda: tq.SpinningMass(MOMENTS, LEVER),
        r"`inertia` must have shape \(\), but it has shape \(3,\)",
    ),
    "rotor": (lambda: tq.Rotor(FOUR), r"`momentum` must have shape \(3,\), but it has"),
    "rotor of time": (
        lambda: tq.Rotor(lambda _: jnp.ones(4))(0.0, STATE, None),
        r"`momentum` must have shape \(3,\), but it has shape \(4,\)",
    ),
    "orbit": (
        lambda: tq.GravityGradient(MU, lambda _: jnp.ones(2)).of_body(MOMENTS)(
            0.0, STATE, None
        ),
        r"`position` must have shape \(3,\), but it has shape \(2,\)",
    ),
    "function": (
        lambda: tq.Torque(lambda *_: jnp.zeros(()))(0.0, STATE, None),
        r"`torque` must have shape \(3,\), but it has shape \(\)",
    ),
    "motor": (
        lambda: tq.SpinningMass(0.3, LEVER, lambda *_: jnp.ones(3))(
            0.0, jr.State(ATTITUDE, OMEGA, (jnp.ones(()),)), None
        ),
        r"`motor_torque` must have shape \(\), but it has shape \(3,\)",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_argument_is_an_error(name, untyped):
    call, message = WRONG[name]
    with pytest.raises(ValueError, match="Argument " + message):
        call()


def test_gravity_gradient_acts_on_a_wheel_too():
    """With a wheel that stands still the body is the rigid one of all its mass."""
    moments = np.array([1.0, 1.3, 1.5])
    wheel = tq.SpinningMass(0.1, np.array([0.0, 0.0, 2.0]))
    gradient = tq.GravityGradient(1.0, tq.KeplerOrbit(1.0, 1.0, 0.0))
    own = np.array([1.0, 1.3, 1.4])
    body = jr.RigidBody(own, gradient + wheel)
    turned = jr.rotation.exp(np.array([0.3, 0.5, 0.2]))
    state = jr.State(turned, jnp.zeros(3), (jnp.array(0.0),))
    n = np.asarray(jr.rotation.rotate_inverse(turned, np.array([1.0, 0.0, 0.0])))
    expected = 3 * np.cross(n, moments * n)
    np.testing.assert_allclose(body.torque_on(0.0, state, None), expected, rtol=1e-14)
    tensor = jr.RigidBody(np.diag(own), wheel + gradient)
    np.testing.assert_allclose(tensor.torque_on(0.0, state, None), expected, rtol=1e-14)
    # A satellite in its orbit has the frequencies of the rigid body.
    flying = jr.State(
        jnp.array([1.0, 0, 0, 0]), jnp.array([0.0, 0, 1.0]), (jnp.array(1.0),)
    )
    found = jr.stability.linearize(body, flying).eigenvalues.imag
    squared = jr.stability.satellite_stability(moments).roll_yaw_squared
    for frequency in np.sqrt(-np.asarray(squared).real):
        assert np.min(np.abs(found - frequency)) < 1e-7


def test_a_rotor_refuses_a_step_of_its_momentum():
    ts = np.array([0.0, 1.0, 1.0, 2.0])
    momenta = np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 0.5], [0, 0, 0.5]])
    with pytest.raises(ValueError, match="must be continuous"):
        tq.Rotor(tq.Sampled(ts, momenta))
    # A time that is there twice with one value is no step.
    rotor = tq.Rotor(tq.Sampled(ts, momenta[[0, 1, 1, 3]]))
    assert not rotor.momentum.has_known_step


def test_a_list_of_parts_is_a_tuple():
    state = jr.State(np.array([1.0, 0, 0, 0]), np.zeros(3), [np.array(3.0)])
    body = jr.RigidBody(np.array([1.0, 2.0, 3.0]), tq.SpinningMass(0.1, np.ones(3)))
    assert isinstance(state.internal, tuple)
    assert jr.simulate(body, state, 0.1).final_state.internal[0].shape == ()
