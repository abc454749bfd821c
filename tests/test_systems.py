# ruff: noqa: ARG002

# Systems and torques have arguments that some of them do not use.

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from helpers import ATTITUDE, MOMENTS, OMEGA, TENSOR, quick_jit, ulps

import jrigid as jr
from jrigid import rotation as ro
from jrigid import torques as tq
from jrigid._checks import Findings
from jrigid.mass import MassProperties
from jrigid.systems import Force

GRAVITY = np.array([1.0, -2.0, -9.0])
LEVER = np.array([0.3, -0.2, 0.5])
MASS = 2.0
POSITION, VELOCITY = np.array([1.0, -2.0, 0.5]), np.array([0.4, 3.0, -1.2])
WEIGHT = Force(
    lambda *_: MASS * jnp.asarray(GRAVITY),
    lambda _t, s, _a: -MASS * jnp.sum(jnp.asarray(GRAVITY) * s.position),
)
BODY = MassProperties(MASS, np.array([5.0, 6.0, 7.0]), TENSOR)
STATE = jr.State(ATTITUDE, OMEGA)
FLYING = jr.FloatingState(POSITION, VELOCITY, ATTITUDE, OMEGA)


def orbit(t):
    return jnp.stack([2.0 + 0.3 * t, 1.0 - t, 0.5 * t * t])


def along_the_motion(system, t, state, args=None):
    """Energy, its rate, momentum, its rate along the vector field, at a frozen time."""

    @quick_jit
    def both(t, state):
        state_rate = system.vector_field(t, state, args)
        invariants = lambda s: (  # noqa: E731
            system.energy(t, s, args),
            system.angular_momentum(t, s, args),
        )
        values, rates = jax.jvp(invariants, (state,), (state_rate,))
        return *values, *rates

    return both(t, state)


# --- a body with a fixed point
# ----------------------------------------------------------------

CONSERVATIVE = {
    "free": None,
    "heavy": tq.UniformGravity(MASS, LEVER, GRAVITY),
    "attracted": tq.GravityGradient(4.0, orbit),
    "with a free wheel": tq.SpinningMass(0.3, LEVER),
    "heavy with a wheel": tq.UniformGravity(MASS, LEVER, GRAVITY)
    + tq.SpinningMass(0.3, LEVER),
    "sprung": tq.Torque(
        lambda _t, s, k: -k * s.attitude[0] * s.attitude[1:],
        lambda _t, s, k: -k * s.attitude[0] ** 2,
    ),
}


@pytest.mark.parametrize("name", CONSERVATIVE)
@pytest.mark.parametrize("inertia", [TENSOR, MOMENTS], ids=["tensor", "moments"])
def test_energy_is_constant_where_nothing_takes_any(name, inertia):
    torque = CONSERVATIVE[name]
    state = jr.State(ATTITUDE, OMEGA, tq.as_torque(torque).internal_at_rest(STATE))
    if "wheel" in name:
        state = jr.State(ATTITUDE, OMEGA, (jnp.asarray(4.0),))
    energy, _, power, _ = along_the_motion(
        jr.RigidBody(inertia, torque), 0.4, state, 1.7
    )
    assert np.isfinite(energy)
    assert abs(power) <= ulps(float, 128)
    kinetic = OMEGA @ (inertia @ OMEGA if inertia.ndim == 2 else inertia * OMEGA) / 2
    if name == "free":
        np.testing.assert_allclose(energy, kinetic, rtol=ulps(float, 4))
    else:
        assert abs(energy - kinetic) > 0.01  # the potential counts


def test_momentum_in_space_changes_at_the_rate_of_the_torque():
    for torque in (CONSERVATIVE["heavy"], tq.LinearDrag(0.3), tq.Constant(LEVER)):
        system = jr.RigidBody(TENSOR, torque)
        _, momentum, _, rate = along_the_motion(system, 0.4, STATE)
        expected = ro.rotate(ATTITUDE, torque(0.4, STATE, None))
        np.testing.assert_allclose(rate, expected, atol=ulps(float, 64))
        np.testing.assert_allclose(
            momentum, ro.rotate(ATTITUDE, TENSOR @ OMEGA), atol=ulps(float, 8)
        )


def test_energy_falls_at_the_power_of_the_drag():
    for drag, power in (
        (tq.LinearDrag(0.3), -0.3 * OMEGA @ OMEGA),
        (tq.QuadraticDrag(0.3), -0.3 * np.linalg.norm(OMEGA) ** 3),
        (tq.LinearDrag(TENSOR), -OMEGA @ TENSOR @ OMEGA),
        (CONSERVATIVE["heavy"] + tq.LinearDrag(0.3), -0.3 * OMEGA @ OMEGA),
    ):
        _, _, found, _ = along_the_motion(jr.RigidBody(TENSOR, drag), 0.4, STATE)
        np.testing.assert_allclose(found, power, rtol=ulps(float, 512))


def test_momentum_about_the_vertical_of_a_heavy_body_is_constant():
    system = jr.RigidBody(TENSOR, CONSERVATIVE["heavy"])
    _, _, _, rate = along_the_motion(system, 0.0, STATE)
    assert np.linalg.norm(rate) > 0.1
    assert abs(rate @ GRAVITY) <= ulps(float, 512)


def test_a_heavy_body_with_any_inertia_and_lever_is_lagranges_equation():
    """Against the Euler-Lagrange equations in Euler angles,
    written without any torque."""
    angles, rates = jnp.array([0.3, 1.1, -0.7]), jnp.array([0.5, -0.4, 1.3])

    def lagrangian(q, dq):
        omega = ro.euler_rates_to_omega(q, dq)
        height = ro.rotate(ro.from_euler(q), LEVER)
        return 0.5 * omega @ TENSOR @ omega + MASS * height @ GRAVITY

    @jax.jit
    def accelerations(q, dq):
        momentum = jax.grad(lagrangian, 1)
        mass = jax.jacfwd(momentum, 1)(q, dq)
        drift = jax.jvp(lambda q: momentum(q, dq), (q,), (dq,))[1]
        ddq = jnp.linalg.solve(mass, jax.grad(lagrangian)(q, dq) - drift)
        return jax.jvp(ro.euler_rates_to_omega, (q, dq), (dq, ddq))

    omega, expected = accelerations(angles, rates)
    system = jr.RigidBody(TENSOR, tq.UniformGravity(MASS, LEVER, GRAVITY))
    state = jr.State(ro.from_euler(angles), omega)
    found = system.vector_field(0.0, state, None)
    np.testing.assert_allclose(found.omega, expected, atol=ulps(float, 128))
    np.testing.assert_allclose(
        found.attitude, ro.attitude_rate(state.attitude, omega), atol=0
    )


def test_a_custom_function_gets_time_state_and_arguments():
    system = jr.RigidBody(MOMENTS, lambda t, s, args: args["k"] * t * s.attitude[1:])
    found = system.vector_field(2.0, STATE, {"k": 3.0}).omega
    torque = 6.0 * ATTITUDE[1:]
    np.testing.assert_allclose(
        found, jr.euler_equations(MOMENTS, OMEGA, torque), atol=0
    )
    assert system.energy(0.0, STATE, {"k": 3.0}) == jr.kinetic_energy(MOMENTS, OMEGA)


def swinging(inertia):
    return jr.RigidBody(inertia, tq.LinearDrag(0.1) + tq.GravityGradient(4.0, orbit))


@pytest.mark.parametrize("inertia", [TENSOR, MOMENTS], ids=["tensor", "moments"])
def test_the_gradient_of_gravity_acts_on_the_bodys_own_inertia(inertia):
    """Built with it, replaced, in lanes, in flight;
    derivatives flow through the torque too."""
    gradient = tq.GravityGradient(4.0, orbit)
    by_hand = lambda i: jr.euler_equations(  # noqa: E731
        i, OMEGA, gradient.of_body(i)(0.7, STATE, None) - 0.1 * OMEGA
    )
    rate = lambda i: swinging(i).vector_field(0.7, STATE, None).omega  # noqa: E731
    other = inertia + 0.2 * (np.eye(3) if inertia.ndim == 2 else 1)

    @quick_jit
    def every(inertia, other):
        bodies = jnp.stack([inertia, other])
        replaced = eqx.tree_at(lambda body: body.inertia, swinging(inertia), other)
        slopes = [
            d(f)(inertia) for d in (jax.jacfwd, jax.jacrev) for f in (rate, by_hand)
        ]
        torques = (
            swinging(inertia).torque_on(0.7, STATE, None),
            gradient.of_body(inertia)(0.7, STATE, None) - 0.1 * OMEGA,
        )
        rates = jax.vmap(rate)(bodies), replaced.vector_field(0.7, STATE, None).omega
        return rates, jnp.stack([by_hand(inertia), by_hand(other)]), slopes, torques

    (in_lanes, replaced), expected, slopes, torques = every(inertia, other)
    np.testing.assert_allclose(in_lanes, expected, atol=ulps(float, 8))
    np.testing.assert_allclose(replaced, expected[1], atol=ulps(float, 8))
    for found, by_product_rule in (slopes[:2], slopes[2:]):
        np.testing.assert_allclose(found, by_product_rule, atol=ulps(float, 32))
    np.testing.assert_allclose(*torques, atol=ulps(float, 4))
    if inertia.ndim == 2:
        flying = jr.FloatingState(orbit(0.7), VELOCITY, ATTITUDE, OMEGA)
        in_flight = jr.FloatingBody(BODY, None, tq.GravityGradient(4.0))
        own = in_flight.torque_on(0.0, flying, None)
        np.testing.assert_allclose(own, torques[0] + 0.1 * OMEGA, atol=ulps(float, 4))


def test_a_body_without_torque_is_free():
    assert jr.RigidBody(MOMENTS).is_free
    assert jr.RigidBody(MOMENTS, tq.Sum([])).is_free
    assert not swinging(MOMENTS).is_free
    assert isinstance(jr.RigidBody(MOMENTS), jr.AbstractSystem)


class Wheels(tq.AbstractTorque):
    """Two parts that turn at constant rates and push nothing."""

    def __call__(self, t, state, args):
        return jnp.zeros(3)

    def internal_at_rest(self, state):
        return (jnp.zeros(2, int),)

    def internal_rate(self, t, state, args):
        return (jnp.array([0.3, 0.7]),)

    def internal_scale(self, rate):
        return (rate,)


class OfAnotherShape(Wheels):
    def internal_rate(self, t, state, args):
        return (jnp.zeros(3),)


class WithoutRate(Wheels):
    def internal_rate(self, t, state, args):
        return ()


class WithoutScale(Wheels):
    def internal_scale(self, rate):
        return ()


STILL = jr.State(ATTITUDE, OMEGA)


def test_parts_whose_numbers_at_rest_are_integers_move():
    motion = jr.simulate(jr.RigidBody(MOMENTS, Wheels()), STILL, 1.0)
    np.testing.assert_allclose(motion.final_state.internal[0], [0.3, 0.7], rtol=1e-7)


@pytest.mark.parametrize(
    ("torque", "message"),
    [
        (OfAnotherShape(), r"`internal_rate` .* shapes \[\(2,\)\], .* \[\(3,\)\]"),
        (WithoutRate(), r"`internal_rate` .* shapes \[\(2,\)\], .* \[\]"),
        (WithoutScale(), "`internal_scale` .* of 1 arrays, .* of 0"),
    ],
)
def test_methods_of_a_torque_that_disagree_on_its_parts_are_an_error(torque, message):
    with pytest.raises(ValueError, match=message):
        jr.simulate(jr.RigidBody(MOMENTS, torque), STILL, 1.0)


class Slider(jr.AbstractSystem):
    """A body with a mass that slides on a spring along its first axis, at a height.

    Its torque is `Slide`, which states the two coordinates of the mass.
    """

    state_type = jr.State
    inertia: jax.Array
    torque: tq.AbstractTorque
    mass: float
    height: float
    stiffness: float

    def moving(self, state):
        """Position and velocity of the mass, and the velocity in the body's axes."""
        place, speed = state.internal
        position = jnp.stack([place, 0.0 * place, self.height + 0.0 * place])
        along = speed * jnp.array([1.0, 0.0, 0.0])
        return position, jnp.cross(state.omega, position) + along, along

    def vector_field(self, t, state, args):
        """By Newton's second law for the mass, and the angular momentum of the rest."""
        position, _, along = self.moving(state)
        omega, axis = state.omega, jnp.array([1.0, 0.0, 0.0])
        apparent = jnp.cross(omega, jnp.cross(omega, position))
        apparent += 2 * jnp.cross(omega, along)
        arm = jnp.cross(position, axis)
        square = jnp.sum(position**2) * jnp.eye(3)
        square -= position[:, None] * position[None]
        left = jnp.diag(self.inertia) + self.mass * square
        corner = jnp.full((1, 1), self.mass)
        side = self.mass * arm
        matrix = jnp.block([[left, side[:, None]], [side, corner]])
        turning = -jnp.cross(omega, self.inertia * omega)
        turning -= self.mass * jnp.cross(position, apparent)
        pull = -self.stiffness * position[:1] - self.mass * apparent[:1]
        change = jnp.linalg.solve(matrix, jnp.concatenate([turning, pull]))
        attitude = ro.attitude_rate(state.attitude, omega)
        return jr.State(attitude, change[:3], (along[0], change[3]))

    def energy(self, t, state, args):
        position, velocity, _ = self.moving(state)
        turning = jnp.sum(self.inertia * state.omega**2)
        moving = self.mass * jnp.sum(velocity**2)
        return (turning + moving + self.stiffness * position[0] ** 2) / 2

    def angular_momentum(self, t, state, args):
        position, velocity, _ = self.moving(state)
        momentum = self.inertia * state.omega
        momentum += self.mass * jnp.cross(position, velocity)
        return ro.rotate(state.attitude, momentum)


class Slide(Wheels):
    def internal_at_rest(self, state):
        return (jnp.zeros(()), jnp.zeros(()))

    def internal_scale(self, rate):
        return (jnp.ones_like(rate), rate)


def test_a_system_of_ones_own_with_coordinates_of_its_own():
    """Its torque states them, as the documentation of `AbstractSystem` says."""
    system = Slider(jnp.asarray(MOMENTS), Slide(), mass=0.3, height=0.7, stiffness=2.0)
    state = jr.State(ATTITUDE, OMEGA, (jnp.array(0.1), jnp.array(0.0)))
    motion = jr.simulate(system, state, np.linspace(0.0, 20.0, 5), rtol=1e-10)
    place, _ = motion.states.internal
    assert np.ptp(place) > 0.1
    np.testing.assert_allclose(motion.energy, motion.energy[0], rtol=1e-8)
    momentum = np.asarray(motion.angular_momentum)
    np.testing.assert_allclose(momentum, np.tile(momentum[0], (5, 1)), atol=1e-8)


def test_a_state_without_its_parts_is_an_error_that_says_how_to_add_them():
    """In `diffeqsolve` of one's own this was "DynamicJaxprTracer * NoneType"."""
    wheel, damper = tq.SpinningMass(0.3, LEVER), tq.InternalDamper(0.2, 0.05)
    body = jr.RigidBody(TENSOR, wheel + damper)
    flying = jr.FloatingBody(BODY, WEIGHT, wheel + damper)

    def solve(state):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(body.vector_field), diffrax.Tsit5(), 0.0, 0.1, 0.01, state
        ).ys

    message = (
        r"`internal` of the state must be a tuple "
        r".*\[\('\[0\]', \(\)\), \('\[1\]', \(3,\)\)\]"
    )
    for call in (
        lambda: solve(STATE),
        lambda: body.energy(0.0, STATE, None),
        lambda: body.angular_momentum(0.0, STATE, None),
        lambda: body.torque_on(0.0, STATE, None),
        lambda: flying.vector_field(0.0, FLYING, None),
        lambda: flying.energy(0.0, FLYING, None),
        lambda: body.with_parts(jr.State(ATTITUDE, OMEGA, (jnp.ones(()),))),
        lambda: body.vector_field(0.0, jr.State(ATTITUDE, OMEGA, jnp.ones(3)), None),
    ):
        with pytest.raises(
            ValueError, match=message + r".*`system.with_parts\(state\)`"
        ):
            call()
    with pytest.raises(ValueError, match="carries parts, here of the shapes \\[\\]"):
        jr.RigidBody(TENSOR).vector_field(
            0.0, jr.State(ATTITUDE, OMEGA, (jnp.ones(()),)), None
        )

    state = body.with_parts(STATE)
    spin, sphere = state.internal
    axis = LEVER / np.linalg.norm(LEVER)
    np.testing.assert_allclose(spin, axis @ OMEGA, rtol=ulps(float, 4))
    np.testing.assert_array_equal(sphere, OMEGA)
    assert body.with_parts(state) is state
    assert jax.tree.structure(solve(state)) == jax.tree.structure(state)
    assert jr.RigidBody(TENSOR).with_parts(STATE).internal is None
    assert len(flying.with_parts(FLYING).internal) == 2


# --- a body in flight
# -------------------------------------------------------------------------


def test_kinetic_energy_splits_as_koenig_says_and_momentum_sums_over_points():
    random = np.random.default_rng(7)
    masses, points = random.uniform(0.1, 1, 9), random.normal(size=(9, 3))
    points -= masses @ points / masses.sum()
    inertia = sum(
        m * (p @ p * np.eye(3) - np.outer(p, p))
        for m, p in zip(masses, points, strict=True)
    )
    body = jr.FloatingBody(MassProperties(masses.sum(), np.zeros(3), inertia))
    r = np.asarray(ro.to_matrix(ATTITUDE))
    places = POSITION + points @ r.T
    velocities = VELOCITY + np.cross(OMEGA, points) @ r.T
    kinetic = 0.5 * np.sum(masses[:, None] * velocities**2)
    translational, rotational = (
        body.translational_energy(FLYING),
        body.rotational_energy(FLYING),
    )
    np.testing.assert_allclose(
        translational + rotational, kinetic, rtol=ulps(float, 16)
    )
    np.testing.assert_allclose(
        translational, masses.sum() * VELOCITY @ VELOCITY / 2, rtol=ulps(float, 8)
    )
    np.testing.assert_allclose(
        rotational, OMEGA @ inertia @ OMEGA / 2, rtol=ulps(float, 8)
    )
    np.testing.assert_allclose(
        body.energy(0.0, FLYING, None), kinetic, rtol=ulps(float, 16)
    )
    np.testing.assert_allclose(
        body.momentum(FLYING), masses @ velocities, rtol=ulps(float, 32)
    )
    about_the_origin = np.einsum("n,ni->i", masses, np.cross(places, velocities))
    np.testing.assert_allclose(
        body.angular_momentum(0.0, FLYING, None),
        about_the_origin,
        atol=ulps(float, 128),
    )


def test_a_projectile_flies_a_parabola_and_tumbles_as_if_it_hung_still():
    ts = np.linspace(0, 8, 5)
    flight = jr.simulate(jr.FloatingBody(BODY, WEIGHT), FLYING, ts, rtol=1e-11)
    parabola = POSITION + VELOCITY * ts[:, None] + GRAVITY * ts[:, None] ** 2 / 2
    scale = np.max(np.abs(parabola))
    np.testing.assert_allclose(
        flight.states.position, parabola, rtol=0, atol=1e-11 * scale
    )
    np.testing.assert_allclose(
        flight.states.velocity,
        VELOCITY + GRAVITY * ts[:, None],
        rtol=0,
        atol=1e-11 * scale,
    )
    free = lambda _, w: np.linalg.solve(TENSOR, np.cross(TENSOR @ w, w))  # noqa: E731
    still = scipy.integrate.solve_ivp(
        free, (0, 8), OMEGA, "DOP853", ts, rtol=1e-13, atol=1e-14
    )
    np.testing.assert_allclose(flight.states.omega, still.y.T, atol=1e-10)
    momentum = TENSOR @ np.asarray(flight.states.omega)[..., None]
    in_space = jax.vmap(ro.rotate)(flight.states.attitude, momentum[..., 0])
    expected = ro.rotate(ATTITUDE, TENSOR @ OMEGA)
    np.testing.assert_allclose(in_space, np.tile(expected, (5, 1)), atol=1e-10)
    energy = np.asarray(flight.energy)
    kinetic = MASS * VELOCITY @ VELOCITY / 2 + OMEGA @ TENSOR @ OMEGA / 2
    np.testing.assert_allclose(
        energy[0], kinetic - MASS * GRAVITY @ POSITION, rtol=1e-14
    )
    np.testing.assert_allclose(energy, energy[0], rtol=1e-10)


def test_laws_of_momentum_of_a_body_in_flight():
    """P' = F; L' about the origin = r x F + torque;
    E' = power of what has no potential."""
    push = lambda t, s, a: jnp.stack([a * t, s.velocity[0], -s.position[1]])  # noqa: E731
    twist = tq.Constant(LEVER)
    body = jr.FloatingBody(BODY, push, twist)
    t, args = 0.4, 1.7
    force = np.array([args * t, VELOCITY[0], -POSITION[1]])
    rates = body.vector_field(t, FLYING, args)
    np.testing.assert_array_equal(rates.position, VELOCITY)
    np.testing.assert_allclose(rates.velocity, force / MASS, rtol=ulps(float, 2))
    _, _, power, rate = along_the_motion(body, t, FLYING, args)
    expected = np.cross(POSITION, force) + ro.rotate(ATTITUDE, LEVER)
    np.testing.assert_allclose(rate, expected, atol=ulps(float, 64))
    np.testing.assert_allclose(
        power, force @ VELOCITY + LEVER @ OMEGA, rtol=ulps(float, 64)
    )


def test_a_force_conserves_energy_only_if_it_has_a_potential():
    for force, conserved in ((WEIGHT, True), (WEIGHT.fn, False)):
        _, _, power, _ = along_the_motion(jr.FloatingBody(BODY, force), 0.0, FLYING)
        expected = 0.0 if conserved else MASS * GRAVITY @ VELOCITY
        np.testing.assert_allclose(power, expected, atol=ulps(float, 256))


def test_a_force_at_an_offset_turns_the_body_as_the_lagrangian_says():
    """A spring from a point of the body to the origin:
    conservative only if both agree."""
    stiffness = 3.0

    def tip(state):
        return state.position + ro.rotate(state.attitude, LEVER)

    force = Force(
        lambda _t, s, _a: -stiffness * tip(s),
        lambda _t, s, _a: stiffness / 2 * jnp.sum(tip(s) ** 2),
    )
    torque = lambda _t, s, _a: jnp.cross(  # noqa: E731
        jnp.asarray(LEVER), ro.rotate_inverse(s.attitude, -stiffness * tip(s))
    )
    body = jr.FloatingBody(BODY, force, torque)
    _, _, power, rate = along_the_motion(body, 0.0, FLYING)
    assert abs(power) <= ulps(float, 512)
    # a central force through the origin has no moment about it
    np.testing.assert_allclose(rate, np.zeros(3), atol=ulps(float, 512))


def test_internal_parts_fly_along():
    body = jr.FloatingBody(BODY, WEIGHT, tq.InternalDamper(0.2, 0.05))
    inner = np.array([1.0, 2.0, 3.0])
    state = jr.FloatingState(POSITION, VELOCITY, ATTITUDE, OMEGA, (jnp.asarray(inner),))
    energy, momentum, power, rate = along_the_motion(body, 0.0, state)
    np.testing.assert_allclose(
        power, -0.05 * np.sum((inner - OMEGA) ** 2), rtol=ulps(float, 512)
    )
    np.testing.assert_allclose(
        rate, MASS * np.cross(POSITION, GRAVITY), atol=ulps(float, 256)
    )
    r = np.asarray(ro.to_matrix(ATTITUDE))
    own = r @ (TENSOR @ OMEGA + 0.2 * inner)
    expected = MASS * np.cross(POSITION, VELOCITY) + own
    np.testing.assert_allclose(momentum, expected, atol=ulps(float, 64))
    bare = jr.FloatingBody(BODY, WEIGHT).energy(0.0, FLYING, None)
    np.testing.assert_allclose(energy, bare + 0.1 * inner @ inner, rtol=ulps(float, 16))


def test_the_centre_of_mass_in_body_coordinates_plays_no_role():
    moved = MassProperties(MASS, np.zeros(3), TENSOR)
    for a, b in zip(
        jax.tree.leaves(jr.FloatingBody(BODY, WEIGHT).vector_field(0.0, FLYING, None)),
        jax.tree.leaves(jr.FloatingBody(moved, WEIGHT).vector_field(0.0, FLYING, None)),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


# --- pytrees, dtypes, errors
# ------------------------------------------------------------------


def test_systems_and_states_are_pytrees_whose_data_are_leaves():
    torque = tq.UniformGravity(MASS, LEVER, GRAVITY) + tq.InternalDamper(0.2, 0.05)
    system = jr.RigidBody(TENSOR, torque)
    arrays = [x.shape for x in jax.tree.leaves(system)]
    assert arrays == [(3, 3), (), (3,), (3,), (), ()]
    flying = jr.FloatingState(POSITION, VELOCITY, ATTITUDE, OMEGA)
    assert [x.shape for x in jax.tree.leaves(flying)] == [(3,), (3,), (4,), (3,)]
    doubled = jax.tree.map(lambda x: 2 * x, system)
    state = jr.State(ATTITUDE, OMEGA, (jnp.zeros(3),))
    np.testing.assert_allclose(
        doubled.angular_momentum(0.0, state, None),
        2 * system.angular_momentum(0.0, state, None),
        rtol=ulps(float, 4),
    )
    energies = jax.jit(jax.vmap(lambda i: jr.RigidBody(i).energy(0.0, STATE, None)))
    lanes = np.stack([MOMENTS, 2 * MOMENTS])
    single = jr.kinetic_energy(MOMENTS, OMEGA)
    np.testing.assert_allclose(
        energies(lanes), [single, 2 * single], rtol=ulps(float, 4)
    )


def findings_of(system):
    findings = Findings()
    system.check(findings)
    return findings


INDEFINITE = np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("inertia", [-MOMENTS, INDEFINITE], ids=["moments", "tensor"])
def test_a_bad_inertia_is_found_whatever_the_torque(inertia):
    for torque in (None, tq.GravityGradient(4.0, orbit)):
        findings = findings_of(jr.RigidBody(inertia, torque))
        assert findings.result == jr.RESULTS.invalid_inertia
        shown = str(inertia.ravel()[0])[:2]
        with pytest.raises(
            RuntimeError, match=rf"`inertia` .*, but it is not: \[+{shown}"
        ):
            findings.guard(jnp.zeros(()), throw=True)


def test_a_bad_body_in_flight_is_found_by_its_mass_or_inertia():
    changed = lambda leaf, value: eqx.tree_at(leaf, jr.FloatingBody(BODY), value)  # noqa: E731
    for system, code, message in (
        (
            changed(lambda s: s.mass_properties.mass, jnp.array(-1.0)),
            jr.RESULTS.invalid_mass,
            r"`mass` must be positive and finite, but it is not: -1\.0",
        ),
        (
            changed(lambda s: s.mass_properties.inertia, jnp.full((3, 3), jnp.nan)),
            jr.RESULTS.invalid_inertia,
            r"`inertia` must hold .*, but it is not: \[\[nan",
        ),
    ):
        findings = findings_of(system)
        assert findings.result == code
        with pytest.raises(RuntimeError, match=message):
            findings.guard(jnp.zeros(()), throw=True)
    assert findings_of(jr.FloatingBody(BODY, WEIGHT, tq.LinearDrag(0.1))).ok


def test_systems_and_states_show_their_numbers():
    assert "velocity=[ 0.4, 3. , -1.2]" in repr(FLYING)
    assert repr(jr.RigidBody(MOMENTS)).startswith(
        "RigidBody(inertia=[1., 2., 3.], torque="
    )
    assert repr(tq.LinearDrag(0.1)) == "LinearDrag(coefficient=0.1)"


FOUR = np.ones(4)
WRONG = {
    "inertia": (
        lambda: jr.RigidBody(FOUR),
        r"`inertia` must have shape \(3,\) or \(3, 3\), but it has shape \(4,\)",
    ),
    "torque": (lambda: jr.RigidBody(MOMENTS, 3.0), r"`torque` must be a callable"),
    "floating torque": (
        lambda: jr.FloatingBody(BODY, None, 3.0),
        r"`torque` must be a callable",
    ),
    "force": (
        lambda: jr.FloatingBody(BODY, 3.0),
        r"`force` must be a callable \(t, state, args\) -> \(3,\), but it is 3.0",
    ),
    "mass properties": (
        lambda: jr.FloatingBody(TENSOR),
        r"`mass_properties` must be a MassProperties, but it is",
    ),
    "shape of a force": (
        lambda: jr.FloatingBody(BODY, lambda *_: FOUR).vector_field(0.0, FLYING, None),
        r"`force` must have shape \(3,\), but it has shape \(4,\)",
    ),
    "shape of a torque": (
        lambda: jr.RigidBody(MOMENTS, lambda *_: FOUR).vector_field(0.0, STATE, None),
        r"`torque` must have shape \(3,\), but it has shape \(4,\)",
    ),
    "shape of omega": (
        lambda: jr.RigidBody(MOMENTS).vector_field(0.0, jr.State(ATTITUDE, FOUR), None),
        r"`omega` must have shape \(3,\), but it has shape \(4,\)",
    ),
    "shape of attitude": (
        lambda: jr.RigidBody(MOMENTS).vector_field(0.0, jr.State(OMEGA, OMEGA), None),
        r"`attitude` must have shape \(4,\), but it has shape \(3,\)",
    ),
    "shape of position": (
        lambda: jr.FloatingBody(BODY).vector_field(
            0.0, jr.FloatingState(FOUR, VELOCITY, ATTITUDE, OMEGA), None
        ),
        r"`position` must have shape \(3,\), but it has shape \(4,\)",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_argument_is_an_error(name, untyped):
    call, message = WRONG[name]
    with pytest.raises(ValueError, match="Argument " + message):
        call()


def test_a_vector_field_is_diffrax_s_with_states_saved():
    """`State` itself is a state for diffeqsolve, internal parts or none."""
    for system, state in (
        (jr.RigidBody(MOMENTS), jr.State(ATTITUDE, OMEGA)),
        (
            jr.RigidBody(MOMENTS, jr.torques.InternalDamper(0.3, 0.1)),
            jr.State(ATTITUDE, OMEGA, (jnp.array([0.1, 0.2, 0.3]),)),
        ),
    ):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(system.vector_field),
            diffrax.Tsit5(),
            0.0,
            1.0,
            0.01,
            state,
            saveat=diffrax.SaveAt(ts=jnp.array([0.5, 1.0])),
        )
        state = jr.State(jr.rotation.normalize(ATTITUDE), OMEGA, state.internal)
        exact = jr.simulate(system, state, 1.0).states
        np.testing.assert_allclose(solution.ys.omega[1], exact.omega, atol=1e-7)
