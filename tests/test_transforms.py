"""Every public function under jit, vmap, grad, jacfwd and second derivatives,
in both precisions.

A new public name of a module below must be added to `CASES`; the first test says which
is missing.
"""

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ATTITUDE, MOMENTS, OMEGA, TENSOR, quick_jit, ulps
from jax.flatten_util import ravel_pytree

import jrigid as jr
from jrigid import (
    dynamics,
    elliptic,
    free,
    identify,
    io,
    lagrangian,
    rotation,
    solvers,
    stability,
    systems,
    top,
    torques,
)
from jrigid._checks import float_arrays
from jrigid.mass import MassProperties

MODULES = {
    "elliptic": elliptic,
    "rotation": rotation,
    "dynamics": dynamics,
    "torques": torques,
    "systems": systems,
    "free": free,
    "lagrangian": lagrangian,
    "top": top,
    "solvers": solvers,
    "identify": identify,
    "io": io,
    "stability": stability,
}
# Abstract classes, aliases and records: nothing to call.
NOTHING_TO_CALL = {
    "torques.AbstractTorque",
    "torques.Sampled.has_known_step",
    "torques.TorqueFunction",
    "systems.AbstractSystem",
    "dynamics.ExactStates",
    "identify.AbstractSensor",
    "identify.AbstractInertiaModel",
    "identify.Accelerometer",
    "identify.AngularMomenta",
    "identify.AttitudeSensor",
    "identify.Attitudes",
    "identify.Diagnostics",
    "identify.DirectionSensor",
    "identify.Directions",
    "identify.FitResult",
    "identify.Fixed",
    "identify.Flat",
    "identify.FunctionSensor",
    "identify.GaussMarkov",
    "identify.Gyro",
    "identify.LogCholesky",
    "identify.Magnetometer",
    "identify.MomentumSensor",
    "identify.Moments",
    "identify.Observed",
    "identify.Rates",
    "identify.Record",
    "identify.Symmetric",
    "identify.Tensor",
    "identify.Top",
    "identify.TrainResult",
    "identify.each",
    "identify.prior",
    "identify.LogDensity",
    "identify.log_density",
    "identify.save",
    "identify.load",
    "stability.Linearization",
    "stability.Modes",
    "stability.TopStability",
    "stability.PrecessionStability",
    "stability.SatelliteStability",
    "stability.Megno",
    "stability.LyapunovSpectrum",
    "stability.Section",
    "stability.FinalSpin",
    "stability.STABILITY",
    "stability.ORDER",
    "stability.REGIONS",
    "stability.SIDES",
    "free.REGIMES",
    # Files and other packages' objects: tests/test_io.py.
    "io.from_jaxlie",
    "io.to_jaxlie",
    "io.from_scipy",
    "io.to_scipy",
    "io.from_trimesh",
    "io.mesh_arrays",
    "io.read_mesh",
    "io.read_inertials",
    "io.write_inertials",
    "io.diagnose",
    "io.to_pandas",
    "io.to_xarray",
}
# What answers with a code, not with numbers: tested where it belongs.
CODES = {
    "free.regime",
    "top.motion_class",
    "top.CLASSES",
    "top.SymmetricTop.is_valid",
    "lagrangian.cyclic_coordinates",
}
# Regressions and fits of records of some length: tests/test_identify*.py.
OF_RECORDS = {
    "identify.LinearEstimate",
    "identify.weak_form",
    "identify.momentum",
    "identify.gyrostat",
    "identify.fit",
    "identify.fit_each",
    "identify.Status",
    "identify.Bound",
    "identify.Plan",
    "identify.Plan.bound",
    "identify.Plan.information",
    "identify.Plan.predicted",
    "identify.profile",
    "identify.optimal_trial",
    "identify.Optimum",
    "identify.compare",
    "identify.Comparison",
    "identify.cross_validate",
    "identify.train",
    "identify.residuals",
    "identify.block_bootstrap",
    "identify.coloured_covariance",
    # Long motions and grids: tests/test_stability*.py.
    "stability.lyapunov_spectrum",
    "stability.megno",
    "stability.poincare_section",
    "stability.final_spin",
    "stability.stability_map",
}
CODE_METHOD = "check"


@dataclass
class Case:
    """A function of arrays, generic inputs for it,
    and the public names it goes through."""

    function: Callable[..., Any]
    inputs: tuple[Any, ...]
    covers: tuple[str, ...] = ()


OTHER_ATTITUDE = np.array([0.1, 0.8, -0.3, 0.5])
VECTOR = np.array([0.7, 1.2, -0.4])
AXIS = np.array([2.0, -3.0, 6.0])
ANGLES = np.array([0.4, 1.1, -0.7])
MATRIX = np.asarray(rotation.to_matrix(ATTITUDE))
POSITION, VELOCITY = np.array([1.0, -2.0, 0.5]), np.array([0.4, 3.0, -1.2])
INNER = np.array([1.0, 0.2, -0.6])
PLATES = np.array([[0.1, 1.0, 0.2], [0.5, -0.9, 0.3], [-0.2, 0.1, 1.2]])
SHAPE = np.array([[0.4, 0.1, -0.2], [0.3, -0.5, 0.6], [0.2, 0.7, -0.1]])
SAMPLES = np.random.default_rng(0).normal(size=(5, 3))
TIMES = np.array([0.0, 0.2, 0.35, 0.6, 0.7])
TORQUE_METHODS = (
    "__call__",
    "potential",
    "internal_at_rest",
    "internal_rate",
    "internal_scale",
    "internal_momentum",
    "internal_energy",
)


def number(x):
    """What the functions written here, not the package's, do with integers."""
    return float_arrays(x)[0]


def parts(tree):
    """Real and imaginary parts, as numbers of the real dtype."""
    return jax.tree.map(lambda x: [x.real, x.imag] if jnp.iscomplexobj(x) else x, tree)


def symmetric(tensor):
    """A tensor that stays symmetric when its nine numbers are varied one by one."""
    tensor = number(tensor)
    return 0.5 * (tensor + tensor.T) if tensor.ndim == 2 else tensor


def all_of_a_torque(torque, t, state, args=None):
    return {
        "torque": torque(t, state, args),
        "potential": torque.potential(t, state, args),
        "rest": torque.internal_at_rest(state),
        "rate": torque.internal_rate(t, state, args),
        "scale": torque.internal_scale(state.omega[0] ** 2),
        "momentum": torque.internal_momentum(t, state, args),
        "energy": torque.internal_energy(t, state, args),
    }


def knots(t):
    t = number(t)
    return t * jnp.arange(1.0, 5.0, dtype=t.dtype)


def sampled(t, values):
    """The value at a time, between fixed knots; the jumps of knots that move with
    it."""
    value = torques.Sampled(np.arange(4.0), values)(number(t)[()])
    return value, torques.Sampled(knots(t), values).jumps


def methods(name, *own):
    return tuple(f"{name}.{method}" for method in own)


def of_external(make):
    """All methods of a torque without internal state,
    as a function of its data and the state."""
    return lambda *x: all_of_a_torque(make(*x[:-3]), x[-3], jr.State(x[-2], x[-1]))


def of_internal(make):
    return lambda *x: all_of_a_torque(
        make(*x[:-4]), x[-4], jr.State(x[-3], x[-2], (number(x[-1]),))
    )


def orbit_along(axis):
    return lambda t: number(axis) * (1 + number(t))


def motor(t, state, args):
    return number(t) + state.omega[0] * state.attitude[1]


def two_parts(inertia, coupling, spinning, axis):
    wheel = torques.SpinningMass(spinning, axis, motor)
    drag = torques.LinearDrag(coupling)
    return drag + torques.InternalDamper(inertia, coupling) + wheel


def custom(scale):
    return torques.Torque(
        lambda t, s, _: number(scale) * number(t) * s.attitude[1:] * s.omega,
        lambda t, s, _: number(scale) * number(t) * s.attitude[0] ** 2,
    )


def sunlit(areas, normals, centers, sun, specular, diffuse, pressure, t, q, w):
    towards = lambda t: number(sun) + number(t)  # noqa: E731
    torque = torques.SolarPressure(
        areas, normals, centers, towards, specular, diffuse, pressure
    )
    state = jr.State(q, w)
    return [all_of_a_torque(torque, t, state), torque.force(t, state, None)]


def rigid_body(inertia, mass, lever, gravity, t, q, w):
    body = jr.RigidBody(
        symmetric(inertia), torques.UniformGravity(mass, lever, gravity)
    )
    state = jr.State(q, w)
    assert not body.is_free
    return [
        f(t, state, None)
        for f in (body.vector_field, body.energy, body.angular_momentum)
    ]


def floating_body(mass, inertia, stiffness, t, position, velocity, q, w, inner):
    force = systems.Force(
        lambda t, s, _: -number(stiffness) * s.position * number(t),
        lambda t, s, _: 0.5 * number(stiffness) * jnp.sum(s.position**2) * number(t),
    )
    properties = MassProperties.unchecked(
        mass, jnp.zeros_like(number(position)), symmetric(inertia)
    )
    body = jr.FloatingBody(properties, force, torques.InternalDamper(mass, stiffness))
    state = jr.FloatingState(position, velocity, q, w, (number(inner),))
    return [
        *(
            f(t, state, None)
            for f in (body.vector_field, body.energy, body.angular_momentum)
        ),
        *(
            f(state)
            for f in (body.translational_energy, body.rotational_energy, body.momentum)
        ),
        body.inertia,
        body.rotation.energy(t, state, None),
    ]


def of_body(function):
    """A function of a free motion, of three moments and a rate."""
    return Case(function, (MOMENTS, OMEGA))


def of_symmetric_body(function, *covers):
    def of(i1, i3, omega):
        i1, i3, omega = float_arrays(i1, i3, omega)
        return function(jnp.stack([i1, i1, i3]), omega)

    return Case(of, (1.0, 1.5, OMEGA), covers)


def free_state(function):
    """Of moments, attitude, rate and time, the attitude made a unit quaternion
    first."""
    return Case(
        lambda i, q, w, t: function(i, jr.State(rotation.normalize(q), w), t),
        (MOMENTS, ATTITUDE, OMEGA, 3.0),
    )


def of_top(function, *covers):
    """Of a top's motion, by its three numbers, an attitude and a rate."""

    def of(i1, i3, mgl, q, w):
        return function(
            jr.SymmetricTop(i1, i3, mgl), jr.State(rotation.normalize(q), w)
        )

    return Case(of, (1.0, 0.6, 0.8, ATTITUDE, OMEGA), covers)


def of_tilt(function, *covers):
    """Of a top and two numbers more, a tilt and a rate or a momentum."""
    return Case(
        lambda i1, i3, mgl, *x: function(jr.SymmetricTop(i1, i3, mgl), *x),
        (1.0, 0.6, 0.8, 0.7, 5.0),
        covers,
    )


def all_of_a_lagrangian(mass, stiffness, q, q_dot):
    def energies(q, q_dot, mass, stiffness):
        return 0.5 * mass * jnp.sum(q_dot**2 * (1 + q**2)) - stiffness * jnp.sum(q**4)

    params = float_arrays(mass, stiffness)
    of = [lagrangian.acceleration, lagrangian.momenta, lagrangian.energy]
    q, q_dot = float_arrays(q, q_dot)
    field = lagrangian.vector_field(energies)(0.0, (q, q_dot), params)
    return [f(energies, q, q_dot, *params) for f in of], field


def shapes_of_a_top(i1, i3, mgl):
    i1, i3, mgl = float_arrays(i1, i3, mgl)
    held = jr.SymmetricTop(i1, i3, mgl)
    body = MassProperties(
        mgl, 0 * MATRIX[0].astype(i1.dtype), i1 * jnp.eye(3, dtype=i1.dtype)
    )
    lever = jnp.stack([0 * i3, 0 * i3, i3])
    shifted = jr.SymmetricTop.from_mass_properties(body, lever)
    rigid = held.as_rigid_body()
    unchecked = jr.SymmetricTop.unchecked(i1, i3, mgl)
    return held, unchecked, shifted, rigid.inertia, rigid.torque.lever


def nutation(one, state):
    return (
        top.nutation_bounds(one, state),
        top.nutation_period(one, state),
        top.advance_per_nutation(one, state),
        top.mean_precession(one, state),
    )


def extra_integrals(i1, i3, lever, q, w):
    i1, i3, lever = float_arrays(i1, i3, lever)
    gravity = torques.UniformGravity(i3, lever, jnp.stack([0 * i3, 0 * i3, -i1]))
    body = jr.RigidBody(jnp.stack([i1, i1, i3]), gravity)
    return top.integrals(body, jr.State(rotation.normalize(q), w))


def exact_step(inertia, state, t):
    t = number(t)
    term, solver = solvers.FreeRotation(inertia), solvers.ExactFree()
    assert solver.order(term) is None
    start = solver.init(term, 0.0, t, state, None)
    end, *_ = solver.step(term, 0.0, t, state, None, start, made_jump=False)
    rate = term.prod(solver.func(term, 0.0, state, None), term.contr(0.0, t))
    return end, rate, term.after(state, t)


def splitting_step(inertia, state, t):
    t, solver = number(t), solvers.Splitting(2)
    body = jr.RigidBody(inertia, lambda t, state, args: state.attitude[1:] * (1 + t))  # noqa: ARG005
    terms = solver.terms(body)
    assert solver.order(terms) == 2
    start = solver.init(terms, 0.0, t, state, None)
    end, _, dense, *_ = solver.step(terms, 0.0, t, state, None, start, made_jump=False)
    curve = solver.interpolation_cls(t0=0.0 * t, t1=t, **dense)
    return end, curve.evaluate(0.5 * t), solver.func(terms, 0.0, state, None)


def explicit_step(solver, y, t):
    y, t = number(y), number(t)
    term = diffrax.ODETerm(lambda t, y, args: jnp.cos(y) * (1 + t))  # noqa: ARG005
    assert solver.order(term) == solver.error_order(term)
    start = solver.init(term, 0.1 * t, t, y, None)
    end, error, dense, *_ = solver.step(
        term, 0.1 * t, t, y, None, start, made_jump=False
    )
    curve = solver.interpolation_cls(t0=0.1 * t, t1=t, **dense)
    return end, error, solver.func(term, t, end, None), curve.evaluate(0.5 * t)


CASES = {
    # elliptic
    "elliptic.rf": Case(elliptic.rf, (0.3, 1.2, 2.0)),
    "elliptic.rc": Case(elliptic.rc, (0.3, 1.2)),
    "elliptic.rd": Case(elliptic.rd, (0.3, 1.2, 2.0)),
    "elliptic.rj": Case(elliptic.rj, (0.3, 1.2, 2.0, 0.7)),
    "elliptic.ellipk": Case(elliptic.ellipk, (0.4,)),
    "elliptic.ellipe": Case(elliptic.ellipe, (0.4,)),
    "elliptic.ellippi": Case(elliptic.ellippi, (0.3, 0.4)),
    "elliptic.ellipkinc": Case(elliptic.ellipkinc, (1.1, 0.4)),
    "elliptic.ellipeinc": Case(elliptic.ellipeinc, (1.1, 0.4)),
    "elliptic.ellippiinc": Case(elliptic.ellippiinc, (0.3, 1.1, 0.4)),
    "elliptic.ellipj": Case(elliptic.ellipj, (1.7, 0.4), ("elliptic.JacobiFunctions",)),
    "elliptic.am": Case(elliptic.am, (1.7, 0.4)),
    # rotation
    "rotation.hat": Case(rotation.hat, (VECTOR,)),
    "rotation.vee": Case(rotation.vee, (MATRIX,)),
    "rotation.normalize": Case(rotation.normalize, (2 * ATTITUDE,)),
    "rotation.multiply": Case(rotation.multiply, (ATTITUDE, OTHER_ATTITUDE)),
    "rotation.conjugate": Case(rotation.conjugate, (ATTITUDE,)),
    "rotation.rotate": Case(rotation.rotate, (ATTITUDE, VECTOR)),
    "rotation.rotate_inverse": Case(rotation.rotate_inverse, (ATTITUDE, VECTOR)),
    "rotation.exp": Case(rotation.exp, (VECTOR,)),
    "rotation.log": Case(rotation.log, (OTHER_ATTITUDE,)),
    "rotation.angle_between": Case(rotation.angle_between, (ATTITUDE, OTHER_ATTITUDE)),
    "rotation.from_axis_angle": Case(rotation.from_axis_angle, (AXIS, 0.8)),
    "rotation.to_matrix": Case(rotation.to_matrix, (ATTITUDE,)),
    "rotation.from_matrix": Case(rotation.from_matrix, (MATRIX,)),
    "rotation.to_euler": Case(rotation.to_euler, (ATTITUDE,)),
    "rotation.from_euler": Case(rotation.from_euler, (ANGLES,)),
    "rotation.to_scipy": Case(rotation.to_scipy, (ATTITUDE,)),
    "rotation.from_scipy": Case(rotation.from_scipy, (ATTITUDE,)),
    "io.to_spice": Case(io.to_spice, (ATTITUDE,)),
    "io.from_spice": Case(io.from_spice, (ATTITUDE,)),
    "io.to_mrp": Case(io.to_mrp, (ATTITUDE,)),
    "io.shadow_mrp": Case(io.shadow_mrp, (VECTOR,)),
    "io.from_mrp": Case(io.from_mrp, (VECTOR,)),
    "io.nearest_physical": Case(
        lambda i, m, h: io.nearest_physical(symmetric(i), m, h),
        (np.array([[1.0, 0.3, 0.1], [0.3, 2.0, 0.2], [0.1, 0.2, 4.0]]), 3.0, 0.4),
    ),
    "rotation.attitude_rate": Case(rotation.attitude_rate, (ATTITUDE, OMEGA)),
    "rotation.angular_velocity": Case(rotation.angular_velocity, (MATRIX, TENSOR)),
    "rotation.euler_rates_to_omega": Case(
        rotation.euler_rates_to_omega, (ANGLES, VECTOR)
    ),
    "rotation.omega_to_euler_rates": Case(
        rotation.omega_to_euler_rates, (ANGLES, OMEGA)
    ),
    "rotation.integrate_rate": Case(
        lambda ts, omegas, q: rotation.integrate_rate(
            ts, omegas, rotation.normalize(q)
        ),
        (TIMES, SAMPLES, ATTITUDE),
    ),
    "rotation.identity": Case(
        lambda x: number(x) * rotation.identity(number(x).dtype), (1.3,)
    ),
    "rotation.random": Case(
        # the bits of another precision are others, the norm is not
        lambda x: (
            number(x)
            * jnp.sum(rotation.random(jax.random.key(0), number(x).dtype) ** 2)
        ),
        (1.3,),
    ),
    "rotation.inverse": Case(rotation.inverse, (2 * ATTITUDE,)),
    "rotation.slerp": Case(rotation.slerp, (ATTITUDE, OTHER_ATTITUDE, 0.3)),
    "rotation.from_roll_pitch_yaw": Case(rotation.from_roll_pitch_yaw, (ANGLES,)),
    "rotation.to_roll_pitch_yaw": Case(rotation.to_roll_pitch_yaw, (OTHER_ATTITUDE,)),
    # dynamics
    "dynamics.State": Case(lambda q, w, x: jr.State(q, w, x), (ATTITUDE, OMEGA, INNER)),
    "dynamics.angular_momentum": Case(jr.angular_momentum, (TENSOR, OMEGA)),
    "dynamics.kinetic_energy": Case(jr.kinetic_energy, (TENSOR, OMEGA)),
    "dynamics.euler_equations": Case(
        lambda i, w, n: jr.euler_equations(symmetric(i), w, n), (TENSOR, OMEGA, VECTOR)
    ),
    "dynamics.euler_equations, moments": Case(
        jr.euler_equations, (MOMENTS, OMEGA, VECTOR)
    ),
    "dynamics.bearing_torque": Case(
        lambda i, w: jr.bearing_torque(symmetric(i), w), (TENSOR, OMEGA)
    ),
    "dynamics.bearing_torque, moments": Case(jr.bearing_torque, (MOMENTS, OMEGA)),
    # torques
    "torques.as_torque": Case(
        lambda q, w: torques.as_torque(lambda _t, s, k: k * s.omega)(
            0.0, jr.State(q, w), 3.0
        ),
        (ATTITUDE, OMEGA),
    ),
    "torques.Constant": Case(
        of_external(torques.Constant),
        (VECTOR, 0.5, ATTITUDE, OMEGA),
        methods("torques.Constant", "__call__"),
    ),
    "torques.Torque": Case(
        of_external(custom),
        (1.3, 0.5, ATTITUDE, OMEGA),
        methods("torques.Torque", "__call__", "potential"),
    ),
    "torques.UniformGravity": Case(
        of_external(torques.UniformGravity),
        (2.0, VECTOR, AXIS, 0.5, ATTITUDE, OMEGA),
        methods("torques.UniformGravity", "__call__", "potential"),
    ),
    "torques.GravityGradient": Case(
        of_external(
            lambda i, mu, axis: torques.GravityGradient(mu, orbit_along(axis)).of_body(
                symmetric(i)
            )
        ),
        (TENSOR, 4.0, VECTOR, 0.5, ATTITUDE, OMEGA),
        methods("torques.GravityGradient", "__call__", "potential", "of_body"),
    ),
    "torques.KeplerOrbit": Case(
        lambda mu, a, e, t: [
            torques.KeplerOrbit(mu, a, number(e) / 8)(t),
            torques.KeplerOrbit(mu, a, e).mean_motion,
        ],
        (2.0, 1.5, 1.0, 0.7),
        methods("torques.KeplerOrbit", "__call__", "mean_motion"),
    ),
    "torques.LinearDrag": Case(
        of_external(torques.LinearDrag),
        (TENSOR, 0.5, ATTITUDE, OMEGA),
        methods("torques.LinearDrag", "__call__"),
    ),
    "torques.QuadraticDrag": Case(
        of_external(torques.QuadraticDrag),
        (0.3, 0.5, ATTITUDE, OMEGA),
        methods("torques.QuadraticDrag", "__call__"),
    ),
    "torques.CoulombFriction": Case(
        of_external(torques.CoulombFriction),
        (0.3, 0.8, AXIS, 0.5, ATTITUDE, OMEGA),
        methods("torques.CoulombFriction", "__call__"),
    ),
    "torques.CoulombFriction, a ball joint": Case(
        of_external(torques.CoulombFriction), (0.3, 0.8, 0.5, ATTITUDE, OMEGA)
    ),
    "torques.MagneticDipole": Case(
        of_external(
            lambda m, b: torques.MagneticDipole(
                m, lambda t, s: number(b) * number(t) + s.attitude[1:]
            )
        ),
        (VECTOR, AXIS, 0.5, ATTITUDE, OMEGA),
        methods("torques.MagneticDipole", "__call__", "potential"),
    ),
    "torques.SolarPressure": Case(
        sunlit,
        (
            np.array([1.5, 2.0, 0.7]),
            PLATES,
            SHAPE,
            AXIS,
            0.3,
            0.2,
            1.4,
            0.5,
            ATTITUDE,
            OMEGA,
        ),
        methods("torques.SolarPressure", "__call__", "force"),
    ),
    "torques.InternalDamper": Case(
        of_internal(torques.InternalDamper),
        (0.2, 0.05, 0.5, ATTITUDE, OMEGA, INNER),
        methods("torques.InternalDamper", *(set(TORQUE_METHODS) - {"potential"})),
    ),
    "torques.SpinningMass.inertia_of_parts": Case(
        lambda i, axis: torques.SpinningMass(i, axis).inertia_of_parts, (0.3, AXIS)
    ),
    "torques.SpinningMass": Case(
        of_internal(lambda i, axis: torques.SpinningMass(i, axis, motor)),
        (0.3, AXIS, 0.5, ATTITUDE, OMEGA, 4.0),
        methods("torques.SpinningMass", *(set(TORQUE_METHODS) - {"potential"})),
    ),
    "torques.Rotor": Case(
        of_external(lambda axis: torques.Rotor(lambda t: number(axis) * jnp.sin(t))),
        (AXIS, 0.5, ATTITUDE, OMEGA),
        methods("torques.Rotor", "__call__", "internal_momentum"),
    ),
    "torques.Sampled": Case(
        sampled,
        (1.3, np.array([[0.1, 0.2], [0.5, -0.4], [0.3, 0.3], [1.0, 0.7]])),
        methods("torques.Sampled", "__call__", "jumps"),
    ),
    "torques.Sum": Case(
        lambda *x: all_of_a_torque(
            two_parts(*x[:4]).of_body(MOMENTS),
            x[4],
            jr.State(x[5], x[6], (number(x[7]), number(x[8]))),
        ),
        (0.2, 0.05, 0.3, AXIS, 0.5, ATTITUDE, OMEGA, INNER, 4.0),
        methods("torques.Sum", *TORQUE_METHODS, "of_body"),
    ),
    # systems
    # free
    "free.free_rotation": free_state(lambda *x: jr.free_rotation(*x).states),
    "free.relative_rotation": Case(free.relative_rotation, (MOMENTS, OMEGA, 3.0)),
    "free.herpolhode": free_state(free.herpolhode),
    "free.wobble_rate": of_symmetric_body(free.wobble_rate),
    "free.precession_rate": of_symmetric_body(free.precession_rate),
    "free.cone_angles": of_symmetric_body(free.cone_angles, "free.ConeAngles"),
    "free.polhode_period": of_body(free.polhode_period),
    "free.mean_precession_rate": of_body(free.mean_precession_rate),
    "free.precession_per_period": of_body(free.precession_per_period),
    "free.geometric_phase": of_body(free.geometric_phase),
    "free.parameter": of_body(free.parameter),
    "free.modulus": of_body(free.modulus),
    "free.polhode": of_body(lambda i, w: free.polhode(i, w, 5)),
    "free.separatrix": Case(free.separatrix, (MOMENTS,), ("free.Separatrix",)),
    "free.poinsot": Case(free.poinsot, (MOMENTS, OMEGA), ("free.Poinsot",)),
    # lagrangian
    "lagrangian.acceleration": Case(
        all_of_a_lagrangian,
        (1.3, 0.4, VECTOR, OMEGA),
        ("lagrangian.momenta", "lagrangian.energy", "lagrangian.vector_field"),
    ),
    # top
    "top.SymmetricTop": Case(
        shapes_of_a_top,
        (1.0, 0.6, 0.8),
        methods(
            "top.SymmetricTop", "as_rigid_body", "from_mass_properties", "unchecked"
        ),
    ),
    "top.top_motion": Case(
        lambda i1, i3, mgl, q, w, t: (
            jr.top_motion(
                jr.SymmetricTop(i1, i3, mgl), jr.State(rotation.normalize(q), w), t
            ).states
        ),
        (1.0, 0.6, 0.8, ATTITUDE, OMEGA, 3.0),
    ),
    "top.conserved": of_top(top.conserved, "top.Conserved"),
    "top.cubic": of_top(lambda one, s: top.cubic(one, top.conserved(one, s))),
    "top.reduced_vector_field": of_top(
        lambda one, s: top.reduced_vector_field(one, top.conserved(one, s))(
            0.0, s.attitude, None
        )
    ),
    "top.nutation_period": of_top(
        nutation,
        *(
            "top.NutationBounds",
            "top.nutation_bounds",
            "top.Advance",
            "top.advance_per_nutation",
        ),
        "top.mean_precession",
    ),
    "top.lagrangian": Case(
        lambda i1, i3, mgl, q, v: top.lagrangian(q, v, jr.SymmetricTop(i1, i3, mgl)),
        (1.0, 0.6, 0.8, VECTOR, OMEGA),
    ),
    "top.effective_potential": of_tilt(
        lambda one, x, y: top.effective_potential(one, x, y, y + 1)
    ),
    "top.angle_rates": of_tilt(
        lambda one, x, y: top.angle_rates(one, x, y, y + 1), "top.AngleRates"
    ),
    "top.steady_precession": of_tilt(
        lambda one, x, y: top.steady_precession(one, x, y)[:2], "top.SteadyPrecession"
    ),
    "top.gyroscopic": of_tilt(top.gyroscopic, "top.Gyroscopic"),
    "top.sleeping_spin": of_tilt(lambda one, *_: top.sleeping_spin(one)),
    "top.initial_state": of_tilt(lambda one, x, y: top.initial_state(one, x, omega3=y)),
    "top.integrals": Case(
        extra_integrals, (1.0, 0.5, VECTOR, ATTITUDE, OMEGA), ("top.Integrals",)
    ),
    # identify
    "identify.parameters_from_inertia": Case(
        lambda i: identify.parameters_from_inertia(number(i) + 3), (MOMENTS,)
    ),
    "identify.inertia_from_parameters": Case(
        lambda p: identify.inertia_from_parameters(number(p) / 9),
        (np.linspace(-5, 6, 6),),
    ),
    "identify.log_cholesky_from_body": Case(
        lambda p: identify.log_cholesky_from_body(
            identify.body_from_log_cholesky(number(p) / 9)
        ),
        (np.linspace(-5, 6, 10),),
        ("identify.body_from_log_cholesky",),
    ),
    # solvers
    "solvers.FreeRotation": Case(
        free_state(exact_step).function,
        (MOMENTS, ATTITUDE, OMEGA, 3.0),
        (
            *methods("solvers.FreeRotation", "vf", "contr", "prod", "after"),
            "solvers.ExactFree",
            *methods("solvers.ExactFree", "order", "init", "step", "func"),
        ),
    ),
    "solvers.Splitting": Case(
        free_state(splitting_step).function,
        (MOMENTS, ATTITUDE, OMEGA, 0.3),
        methods("solvers.Splitting", "order", "terms", "init", "step", "func"),
    ),
    "solvers.Verner9": Case(
        # The kind of scan over its stages that diffrax differentiates in every mode.
        functools.partial(explicit_step, solvers.Verner9(scan_kind="bounded")),
        (OMEGA, 0.4),
        methods("solvers.Verner9", "order", "term_structure"),
    ),
    "systems.FloatingState": Case(
        lambda r, v, q, w: jr.FloatingState(r, v, q, w),
        (POSITION, VELOCITY, ATTITUDE, OMEGA),
    ),
    "systems.RigidBody": Case(
        rigid_body,
        (TENSOR, 2.0, VECTOR, AXIS, 0.5, ATTITUDE, OMEGA),
        methods(
            "systems.RigidBody", "vector_field", "energy", "angular_momentum", "is_free"
        ),
    ),
    "systems.FloatingBody": Case(
        floating_body,
        (2.0, TENSOR, 0.4, 0.5, POSITION, VELOCITY, ATTITUDE, OMEGA, INNER),
        (
            *methods(
                "systems.FloatingBody", "vector_field", "energy", "angular_momentum"
            ),
            *methods(
                "systems.FloatingBody", "translational_energy", "rotational_energy"
            ),
            *methods(
                "systems.FloatingBody", "momentum", "inertia", "rotation", "jumps"
            ),
            *("systems.Force", "systems.Force.__call__"),
        ),
    ),
    # stability
    "stability.growth_rate_squared": Case(
        lambda i, w, h: stability.growth_rate_squared(i, 1, w, h), (MOMENTS, 1.3, 0.2)
    ),
    "stability.linearized": Case(
        lambda i, w, t: stability.linearized(i, 1, w, t), (MOMENTS, OMEGA, 2.0)
    ),
    "stability.growth_rate": Case(
        lambda i, w, h: stability.growth_rate(i, 1, w, h), (MOMENTS, 1.3, 0.2)
    ),
    "stability.frequency": Case(
        lambda i, w, h: stability.frequency(i, 0, w, h), (MOMENTS, 1.3, 0.2)
    ),
    "stability.modes": Case(
        lambda i, w: parts(stability.modes(i, 2, w)),
        (MOMENTS * np.array([1.0, 1.3, 1.0]), 1.3),
    ),
    "stability.flip_time": Case(
        stability.flip_time, (MOMENTS, np.array([0.3, -0.9, 0.2]))
    ),
    "stability.eigenvalues": Case(
        lambda m: parts(stability.eigenvalues(number(m))),
        (MATRIX + np.diag([1.0, 3.0, -2.0]),),
    ),
    "stability.linearize": Case(
        lambda i, w: parts(
            stability.linearize(
                jr.RigidBody(i),
                jr.State(
                    jnp.array([1, 0, 0, 0], number(w).dtype),
                    number(w) * jnp.array([0, 1, 0], number(w).dtype),
                ),
            ).matrix
        ),
        (MOMENTS, 1.3),
    ),
    "stability.boundary": Case(
        lambda a, b: stability.boundary(lambda x, c: x**3 - number(c), 0.0, b, a),
        (2.0, 3.0),
    ),
    "stability.top_stability": Case(
        lambda a, c, m, w: list(
            stability.top_stability(jr.SymmetricTop(a, c, m), w)[:3]
        ),
        (1.2, 0.7, 1.5, 3.0),
    ),
    "stability.precession_stability": Case(
        lambda a, c, m, tilt, w: list(
            stability.precession_stability(jr.SymmetricTop(a, c, m), tilt, w)[:2]
        ),
        (1.2, 0.7, 1.5, 1.0, 6.0),
    ),
    "stability.satellite_stability": Case(
        lambda i, n: parts(stability.satellite_stability(i, n)[:4]),
        (np.array([1.0, 2.0, 2.5]), 1.1),
    ),
}


def public_names():
    """`module.function`, `module.Class` and `module.Class.method` of the modules' own
    names."""
    names = set()
    for short, module in MODULES.items():
        for name, value in vars(module).items():
            home = getattr(value, "__module__", "")
            if (
                name.startswith("_")
                or inspect.ismodule(value)
                or module.__name__ not in home
            ):
                continue
            names.add(f"{short}.{name}")
            if inspect.isclass(value) and issubclass(value, eqx.Module):
                own = set(vars(value)) - set(value.__dataclass_fields__)
                own = {x for x in own if not x.startswith("_") or x == "__call__"}
                own -= {CODE_METHOD, *inspect.get_annotations(value)}
                names.update(f"{short}.{name}.{x}" for x in own)
    names -= CODES | OF_RECORDS
    return {
        n
        for n in names
        if not any(n == x or n.startswith(x + ".") for x in NOTHING_TO_CALL)
    }


def test_every_public_name_is_in_the_table():
    covered = {name.split(",")[0] for name in CASES}.union(
        *(c.covers for c in CASES.values())
    )
    missing = public_names() - covered
    assert not missing, (
        f"add a Case of {sorted(missing)} to CASES; of sensors, and of other classes "
        "without a formula, the name alone to NOTHING_TO_CALL"
    )
    gone = covered - public_names()
    assert not gone, f"remove {sorted(gone)} from CASES"


def as_arrays(case, dtype):
    return tuple(np.asarray(x, dtype) for x in case.inputs)


def weighted(case, dtype):
    """The function of one flat vector, and the sum of its outputs with generic
    weights."""
    flat, unravel = ravel_pytree(as_arrays(case, dtype))

    def outputs(x):
        leaves = jax.tree.leaves(case.function(*unravel(x)))
        assert all(leaf.dtype == dtype for leaf in leaves), [
            leaf.dtype for leaf in leaves
        ]
        return jnp.concatenate([jnp.ravel(leaf) for leaf in leaves])

    def total(x):
        values = outputs(x)
        weights = np.cos(1.0 + np.arange(values.size)).astype(dtype)
        return jnp.sum(weights * values), values

    return np.asarray(flat), outputs, total


@pytest.fixture(scope="module", params=list(CASES))
def name(request):
    """A case; by the scope of the module its tests follow each other and share what is
    computed."""
    return request.param


@pytest.fixture(scope="module")
def derivatives():
    """Values and derivatives of a case in a dtype, computed once;
    the second only if `twice`."""

    @functools.cache
    def compute(name, dtype, twice=False):
        flat, outputs, total = weighted(CASES[name], dtype)

        def both_modes(x):
            whole, push, value = jax.linearize(total, x, has_aux=True)
            (reverse,) = jax.linear_transpose(push, x)(jnp.ones_like(whole))
            return reverse, (value, jax.vmap(push)(jnp.eye(x.size, dtype=x.dtype)))

        @quick_jit
        def everything(x, direction):
            if twice:
                reverse, second, rest = jax.jvp(
                    both_modes, (x,), (direction,), has_aux=True
                )
            else:
                (reverse, rest), second = both_modes(x), None
            value, forward = rest
            return {
                "value": value,
                "reverse": reverse,
                "forward": forward,
                "second": second,
            }

        values = jax.tree.map(np.asarray, everything(flat, direction_of(flat)))
        return flat, outputs, everything, values

    return compute


def test_jit_and_vmap_equal_a_plain_call_and_a_loop(name, derivatives):
    flat, outputs, _, found = derivatives(name, np.float64)
    eager = np.asarray(outputs(jnp.asarray(flat)))
    scale = max(1.0, np.max(np.abs(eager)))
    np.testing.assert_allclose(
        found["value"], eager, rtol=0, atol=ulps(float, 32) * scale
    )
    other = flat * (1 + 0.03 * np.sin(np.arange(flat.size)))
    lanes = quick_jit(jax.vmap(outputs))(np.stack([flat, other, flat]))
    loop = np.stack([eager, np.asarray(outputs(jnp.asarray(other))), eager])
    np.testing.assert_allclose(lanes, loop, rtol=0, atol=ulps(float, 64) * scale)


def test_derivatives_agree_in_every_mode_and_with_differences(name, derivatives):
    flat, _, everything, found = derivatives(name, np.float64)
    direction = direction_of(flat)
    gradient = found["reverse"]
    exact = 1e-13 * scale_of(gradient)
    np.testing.assert_allclose(found["forward"], gradient, rtol=0, atol=exact)
    h = np.finfo(float).eps ** (1 / 3)
    up, down = (everything(flat + step * direction, direction) for step in (h, -h))
    weights = np.cos(1.0 + np.arange(found["value"].size))
    first = weights @ np.asarray(up["value"] - down["value"]) / (2 * h)
    curvature = np.asarray(up["reverse"] - down["reverse"]) / (2 * h)
    # truncation and rounding are both eps^(2/3) = 4e-11 of the third derivative and the
    # value
    bound = 1e-8 * (scale_of(gradient) + scale_of(curvature))
    np.testing.assert_allclose(gradient @ direction, first, rtol=0, atol=bound)


# Of each module one, whose second derivatives are taken on every push.
TWICE = {
    "elliptic.rf",
    "rotation.slerp",
    "dynamics.kinetic_energy",
    "torques.QuadraticDrag",
    "systems.FloatingBody",
    "free.free_rotation",
    "lagrangian.acceleration",
    "top.reduced_vector_field",
    "solvers.FreeRotation",
    "identify.log_cholesky_from_body",
    "io.from_mrp",
    "stability.satellite_stability",
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=() if x in TWICE else pytest.mark.slow) for x in CASES],
)
def test_second_derivatives_are_symmetric_and_those_of_differences(name, derivatives):
    flat, _, everything, found = derivatives(name, np.float64, twice=True)
    direction = direction_of(flat)
    other = np.cos(3.0 + 2 * np.arange(flat.size))
    gradient = found["reverse"]
    curvature = found["second"]
    # H d: finite, symmetric (d'.H d = d.H d'), and what differences say
    across = np.asarray(everything(flat, other)["second"])
    scale = scale_of(curvature) + scale_of(across)
    np.testing.assert_allclose(
        other @ curvature, direction @ across, rtol=0, atol=1e-12 * scale
    )
    h = np.finfo(float).eps ** (1 / 3)
    up, down = (
        everything(flat + h * direction, other),
        everything(flat - h * direction, other),
    )
    second = np.asarray(up["reverse"] - down["reverse"]) / (2 * h)
    bound = 1e-7 * (scale_of(gradient) + scale)
    np.testing.assert_allclose(curvature, second, rtol=0, atol=bound)


def test_float32_in_float32_out_with_its_accuracy(name, derivatives):
    exact, single = derivatives(name, np.float64)[3], derivatives(name, np.float32)[3]
    for key, count in (("value", 64), ("forward", 256), ("reverse", 256)):
        assert single[key].dtype == np.float32
        bar = ulps(np.float32, count) * scale_of(exact[key])
        np.testing.assert_allclose(single[key], exact[key], rtol=0, atol=bar)


@pytest.mark.slow
def test_second_derivatives_in_float32(name, derivatives):
    exact = derivatives(name, np.float64, twice=True)[3]["second"]
    single = derivatives(name, np.float32, twice=True)[3]["second"]
    assert single.dtype == np.float32
    np.testing.assert_allclose(
        single, exact, atol=ulps(np.float32, 2048) * scale_of(exact)
    )


def direction_of(flat):
    return np.sin(1.0 + 2 * np.arange(flat.size)).astype(flat.dtype)


def scale_of(array):
    return max(1.0, float(np.max(np.abs(array))))


def whole_numbers(value):
    """Integers of the shape of an input, generic and none of them zero."""
    counted = 1 + (np.arange(np.size(value)) * 7) % 5
    return counted.reshape(np.shape(value))


def test_integers_python_numbers_and_numpy_arrays_are_taken(name):
    case = CASES[name]
    whole = [whole_numbers(x) for x in case.inputs]
    if name == "rotation.integrate_rate":
        whole[0] = np.arange(whole[0].size)
    if name == "torques.LinearDrag":
        # A tensor that no drag has is refused.
        whole[0] = np.diag([1, 2, 3])
    exact = case.function(*(jnp.asarray(x, float) for x in whole))
    as_integers = case.function(*(int(x) if x.ndim == 0 else x for x in whole))
    as_floats = case.function(
        *(float(x) if x.ndim == 0 else x.astype(float) for x in whole)
    )
    as_jax = case.function(*(jnp.asarray(x) for x in whole))
    for other in (as_integers, as_floats, as_jax):
        for a, b in zip(jax.tree.leaves(other), jax.tree.leaves(exact), strict=True):
            np.testing.assert_allclose(a, b, rtol=ulps(float, 4), atol=ulps(float, 4))


def test_lists_are_taken_where_no_type_checker_watches(untyped):
    np.testing.assert_array_equal(rotation.exp([0, 0, 0]), [1, 0, 0, 0])
    np.testing.assert_array_equal(jr.angular_momentum([1, 2, 3], [1, 1, 2]), [1, 2, 6])
    assert jr.State([1, 0, 0, 0], [1, 2, 3]).omega.dtype == np.float64
    assert jr.RigidBody([1, 2, 3]).inertia.dtype == np.float64
