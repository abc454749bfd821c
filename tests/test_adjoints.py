"""Every way to differentiate an integration gives the same derivative,
under every torque."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import quick_jit

import jrigid as jr

MOMENTS = jnp.array([1.0, 1.6, 2.1])
OMEGA = jnp.array([0.3, 1.0, -0.4])
ATTITUDE = jr.rotation.exp(jnp.array([0.3, 0.2, 0.1]))
TS = jnp.array([1.0, 4.0])
PUSH = jr.torques.Torque(lambda t, *_: jnp.array([0.3, 0.0, 0.0]) * jnp.sin(1.7 * t))
ALONG_Z = jnp.array([0.0, 0.0, 1.0])
TORQUES = {
    "none": None,
    "constant": jr.torques.Constant(jnp.array([0.1, 0.0, 0.2])),
    "function of time": PUSH,
    "linear drag": jr.torques.LinearDrag(0.2),
    "quadratic drag": jr.torques.QuadraticDrag(0.2),
    "friction": jr.torques.CoulombFriction(0.1, 0.05),
    "weight": jr.torques.UniformGravity(1.0, jnp.array([0.1, 0.0, 0.3]), -ALONG_Z),
    "gravity gradient": jr.torques.GravityGradient(
        0.3, jr.torques.KeplerOrbit(1.0, 1.0, 0.2)
    ),
    "magnet": jr.torques.MagneticDipole(jnp.array([0.2, 0.0, 0.1]), ALONG_Z),
    "rotor": jr.torques.Rotor(lambda t: jnp.array([0.0, 0.2, 0.3]) * jnp.cos(t)),
    "wheel": jr.torques.SpinningMass(0.2, jnp.array([0.0, 3.0, 4.0])),
    "damper": jr.torques.InternalDamper(0.3, 0.1),
    "damper and function of time": jr.torques.InternalDamper(0.3, 0.1) + PUSH,
}


def last_rate(parameters, torque, adjoint):
    body = jr.RigidBody(parameters[:3], torque)
    state0 = jr.State(ATTITUDE, parameters[3:])
    steps = 256 if isinstance(adjoint, diffrax.DirectAdjoint) else None
    return jr.simulate(body, state0, TS, adjoint=adjoint, max_steps=steps).states.omega[
        -1
    ]


PARAMETERS = jnp.concatenate([MOMENTS, OMEGA])
FORWARD, DIRECT = diffrax.ForwardMode(), diffrax.DirectAdjoint()


def test_what_direct_computes_twice_is_the_same_motion():
    torque = TORQUES["damper and function of time"]
    slopes = jax.jacrev(lambda p: last_rate(p, torque, DIRECT))(PARAMETERS)
    expected = quick_jit(jax.jacfwd(lambda p: last_rate(p, torque, FORWARD)))(
        PARAMETERS
    )
    np.testing.assert_allclose(slopes, expected, rtol=0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("name", TORQUES)
def test_every_adjoint_in_every_mode_under_every_torque(name):
    ways = {
        "forward": (jax.jacfwd, FORWARD),
        "reverse": (jax.jacrev, None),
        "direct, reverse": (jax.jacrev, DIRECT),
        "direct, forward": (jax.jacfwd, DIRECT),
    }
    found = {
        way: mode(lambda p, adjoint=adjoint: last_rate(p, TORQUES[name], adjoint))(
            PARAMETERS
        )
        for way, (mode, adjoint) in ways.items()
    }
    for way, slopes in found.items():
        np.testing.assert_allclose(
            slopes, found["forward"], rtol=0, atol=1e-9, err_msg=way
        )


def slowed(parameters, adjoint):
    """Rate about the third axis under drag, of (start, drag, start time, end time)."""
    omega, drag, t0, t1 = parameters
    body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]), jr.torques.LinearDrag(drag))
    state0 = jr.State(ATTITUDE, jnp.stack([0.0 * omega, 0.0 * omega, omega]))
    motion = jr.simulate(body, state0, t1, t0=t0, rtol=1e-11, adjoint=adjoint)
    return motion.states.omega[2]


@pytest.mark.parametrize(
    ("adjoint", "outer", "inner"),
    [
        (DIRECT, jax.jacfwd, jax.jacrev),
        (DIRECT, jax.jacrev, jax.jacfwd),
        (FORWARD, jax.jacfwd, jax.jacfwd),
    ],
)
def test_second_derivatives_in_times_and_parameters(adjoint, outer, inner):
    """All of them, against the closed form omega exp(-drag (t1 - t0) / I3)."""

    def exact(parameters):
        omega, drag, t0, t1 = parameters
        return omega * jnp.exp(-drag * (t1 - t0) / 3.0)

    point = jnp.array([2.0, 0.5, 0.2, 3.0])
    found = quick_jit(outer(inner(lambda x: slowed(x, adjoint))))(point)
    np.testing.assert_allclose(found, jax.hessian(exact)(point), rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("lanes", ["bodies", "times"])
def test_second_derivatives_in_times_alone(lanes):
    """Without `jit` around it, and with no derivatives of anything else."""
    drags = jnp.array([0.1, 0.5])
    times = jnp.array([1.0, 3.0])

    def rate(drag, t1):
        return slowed((jnp.array(2.0), drag, jnp.array(0.2), t1), FORWARD)

    def second(t1, drag):
        return jax.jacfwd(jax.jacfwd(lambda t1: rate(drag, t1)))(t1)

    if lanes == "bodies":
        found = jax.vmap(second, (None, 0))(times[1], drags)
        at = times[1]
        drag = drags
    else:
        found = jax.vmap(second, (0, None))(times, drags[0])
        at = times
        drag = drags[0]
    exact = 2.0 * (drag / 3.0) ** 2 * jnp.exp(-drag * (at - 0.2) / 3.0)
    np.testing.assert_allclose(found, exact, rtol=1e-7)
