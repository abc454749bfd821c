"""Mistakes of new users, each with the message that must come; for the rest:
docs/gotchas.md."""
# ruff: noqa: ARG005

# Users write out the arguments of a lambda, used or not.

import functools
import io
import math
import re
import sys

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jrigid as jr

MOMENTS = np.array([1.0, 2.0, 3.0])
UPRIGHT, OMEGA = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.1, 1.0, 0.2])
STATE, BODY = jr.State(UPRIGHT, OMEGA), jr.RigidBody(MOMENTS)
TS = np.array([0.0, 0.5, 1.0])
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
FACES = np.array(
    [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7],
        [1, 7, 3],
    ]
)
RECORD = jr.datasets.gyro_example()
BLIND = jr.RigidBody(np.ones(3))


def rates(ts=RECORD.times, values=RECORD.omegas, sigma=RECORD.sigma):
    return jr.identify.Rates(ts, values, sigma)


def two_trials(*torques, **options):
    """Fit of two trials, each with a body under a torque of its own."""
    bodies = [jr.RigidBody(MOMENTS, torque) for torque in torques]
    return jr.identify.fit(bodies, [rates(), rates()], **options)


def two_sigmas(_, gyro):
    return jr.identify.prior(gyro.bias, np.ones(2))


def wheel(size):
    return jr.torques.Rotor(lambda t: size * t * OMEGA)


@functools.cache
def found_once():
    return jr.identify.fit(BLIND, rates())


def forced(torque):
    return jr.simulate(jr.RigidBody(MOMENTS, torque), STATE, TS)


def turned(omega, **options):
    return jr.simulate(BODY, jr.State(UPRIGHT, omega), 1.0, **options).states.omega


def table(times, values):
    rows = (",".join(map(str, [t, *x])) for t, x in zip(times, values, strict=True))
    return io.StringIO("\n".join(["t,gx,gy,gz", *rows]))


def without(package, call):
    """Call it as where a package is missing."""
    kept, sys.modules[package] = sys.modules.get(package), None
    try:
        return call()
    finally:
        sys.modules.pop(package)
        if kept is not None:
            sys.modules[package] = kept


class Spring(jr.torques.AbstractTorque):
    def __call__(self, _t, state, _args):
        return -np.asarray(state.attitude)[1:]


flip = np.array(FACES)
flip[0] = flip[0, ::-1]
free = jr.free_rotation
simulate, fit, mesh = jr.simulate, jr.identify.fit, jr.from_mesh

# What a new user writes, and what must be said.
MISTAKES = {
    "bodies of two kinds": (
        lambda: two_trials(jr.torques.LinearDrag(0.1), jr.torques.QuadraticDrag(0.1)),
        "hold bodies for all trials that differ in floating point arrays alone",
    ),
    "wheels by two functions": (
        lambda: two_trials(wheel(1), wheel(2), scale="rotor"),
        "their torques, or functions in them, differ",
    ),
    "a profile of three numbers": (
        lambda: jr.identify.profile(found_once(), jnp.diagonal, [1.0]),
        r"`function` must return .* 0 axes, but it returns one of shape \(3,\)",
    ),
    "a position of a sampler without the states": (
        lambda: jr.identify.log_density(found_once()).function(found_once().numbers),
        r"`position` must have shape \(8,\), but it has shape \(5,\)",
    ),
    "a prior of another shape": (
        lambda: fit(
            BLIND, rates(), free=lambda _, x: jr.identify.prior(x.bias, [1, 1])
        ),
        r"`sigma` of the prior of gyro.bias must have shape \(3,\) or be a number",
    ),
    "a delay that a gyro lacks": (
        lambda: fit(BLIND, rates(), free=lambda _, x: x.delay),
        r"What is None there needs a value, as `Gyro\(delay=0.0\)`",
    ),
    "a start with two moments": (
        lambda: fit(BLIND, rates(), start=(np.ones(2), None)),
        r"`start` must",
    ),
    "a prior without width": (
        lambda: fit(BLIND, rates(), free=lambda _, x: jr.identify.prior(x.bias, 0.0)),
        "`sigma` of a prior must be positive, but it is 0.0",
    ),
    "axes in two units": (
        lambda: jr.records.read(
            io.StringIO("t [s],wx [deg/s],wy [rad/s],wz\n1,2,3,4\n")
        ),
        r"`unit` must say the unit of `rates`, .* deg/s and rad/s for its axes",
    ),
    "many fits of two kinds": (
        lambda: jr.identify.fit_each(
            [BLIND, jr.RigidBody(MOMENTS, jr.torques.LinearDrag(0.1))], [rates()] * 2
        ),
        "must be of one kind for all fits, .*: call `fit` for each",
    ),
    # arguments
    "a state's two arrays swapped": (
        lambda: simulate(BODY, jr.State(OMEGA, UPRIGHT), TS),
        r"`state0.attitude` must have shape \(4,\), .*\(3,\)\. \(`State\(attitude, "
        r"omega\)`",
    ),
    "rates for a state": (
        lambda: free(MOMENTS, OMEGA, TS),
        r"`state0` must be a State, but it is an array of shape \(3,\)",
    ),
    "moments for a system": (
        lambda: simulate(MOMENTS, STATE, TS),
        r"`system` must be a jrigid system \(a RigidBody.*array of shape \(3,\)",
    ),
    "many states at once": (
        lambda: free(
            MOMENTS, jr.State(np.tile(UPRIGHT, (9, 1)), np.tile(OMEGA, (9, 1))), TS
        ),
        r"`state0.attitude` must have shape \(4,\), .*\(9, 4\)\. \(For many, "
        r"`jax.vmap`\.\)",
    ),
    "many inertias at once": (
        lambda: free(np.ones((9, 3)), STATE, TS),
        r"`inertia` must have shape .*\(9, 3\)\. \(For many, `jax.vmap`\.\)",
    ),
    "three inertias as rows": (
        lambda: free(np.array([[1.0, 2, 3], [2, 3, 4], [3, 4, 6]]), STATE, TS),
        r"`inertia` must .*\(Three bodies are three lanes of `jax.vmap`",
    ),
    "an attitude that is not of norm 1": (
        lambda: free(MOMENTS, jr.State(np.array([1.0, 1, 0, 0]), OMEGA), TS),
        r"norm is not 1: \[1\. 1\. 0\. 0\.\]\. \(`jrigid.rotation.normalize` makes it "
        "1",
    ),
    "a class for an instance": (
        lambda: simulate(BODY, STATE, TS, adjoint=diffrax.ForwardMode),
        r"`adjoint` must be .* the class `ForwardMode`, not `ForwardMode\(\.\.\.\)`",
    ),
    # bodies
    "a body for its inertia": (
        lambda: jr.RigidBody(jr.solids.sphere(1.0, 1.0)),
        r"`inertia` must be .* MassProperties: pass its `\.inertia`",
    ),
    "six products of inertia": (
        lambda: jr.RigidBody([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]),
        r"`inertia` must have shape .*\(6,\)\. \(Six numbers make \[\[Ixx, Ixy, "
        r"Ixz\].*sign",
    ),
    "half of a tensor": (
        lambda: jr.MassProperties(
            1.0, np.zeros(3), [[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]
        ),
        r"`inertia` must .* symmetric",
    ),
    "moments of no body": (
        lambda: jr.MassProperties(1.0, np.zeros(3), np.array([1.0, 2.0, 4.0])),
        r"satisfy I3 <= I1 \+ I2, but they do not: \[1\. 2\. 4\.\]",
    ),
    "no mass": (
        lambda: jr.MassProperties(0.0, np.zeros(3), MOMENTS),
        r"`mass` must be positive and finite, but it is not: 0\.0",
    ),
    "a negative density": (
        lambda: mesh(CUBE, FACES, -1.0),
        r"`density` must be positive and finite, but it is not: -1\.0",
    ),
    "an STL file's corners": (
        lambda: mesh(CUBE[FACES.ravel()], np.arange(36).reshape(12, 3)),
        r"as in an STL file\. This merges them: `vertices, same = np.unique\(vertices, "
        "axis=0",
    ),
    "faces counted from 1": (
        lambda: mesh(CUBE, FACES + 1),
        r"Indices count from 0 to 7 here, but they go from 1 to 8",
    ),
    "one face flipped": (
        lambda: mesh(CUBE, flip),
        "flipped: `trimesh.repair.fix_winding`",
    ),
    "a hole": (lambda: mesh(CUBE, FACES[1:]), "A face is missing"),
    "all faces flipped": (
        lambda: mesh(CUBE, FACES[:, ::-1]),
        "`faces` must be ordered counter-clockwise seen from outside.* inside out",
    ),
    # times
    "times out of order": (
        lambda: simulate(BODY, STATE, np.array([0.0, 2.0, 1.0])),
        r"`ts` must .* non-decreasing .* but it is not: 1\.0",
    ),
    "times before the start": (
        lambda: simulate(BODY, STATE, np.array([-1.0, 0.0, 1.0])),
        r"`ts` must .* not earlier than `t0`, but it is not: -1\.0",
    ),
    "a time that is NaN": (
        lambda: simulate(BODY, STATE, np.array([0.0, np.nan, 1.0])),
        r"`ts` must be finite, .* but it is not: nan",
    ),
    # torques and options
    "a torque of a wrong shape": (
        lambda: forced(lambda t, state, args: state.omega[:2]),
        r"`torque` must have shape \(3,\), but it has shape \(2,\)",
    ),
    "a torque without return": (
        lambda: forced(lambda t, state, args: None),
        "`torque` must return an array, but it returns None",
    ),
    "a complex torque": (
        lambda: forced(
            lambda t, state, args: jax.lax.complex(state.omega, state.omega)
        ),
        "`torque` must return real numbers, but it returns complex ones",
    ),
    "complex moments": (
        lambda: jr.RigidBody(np.array([1.0, 2.0, 2.5 + 0.1j])),
        "must be real numbers, but one is complex128",
    ),
    "a torque of two arguments": (
        lambda: jr.RigidBody(MOMENTS, lambda t, state: state.omega),
        r"`torque` must be a callable \(t, state, args\) -> \(3,\), but it does not "
        "take these",
    ),
    "an array for a torque": (
        lambda: jr.RigidBody(MOMENTS, np.ones(3)),
        r"`torque` must be a callable \(t, state, args\)",
    ),
    "an `if` in a torque": (
        lambda: forced(
            lambda t, state, args: state.omega if t > 0.5 else 0 * state.omega
        ),
        "Use `jnp.where` or `jax.lax.cond` in a torque, not `if`, `and` or `max` of "
        "Python",
    ),
    "numpy in a torque": (
        lambda: forced(lambda t, state, args: np.sin(t) * state.omega),
        r"Use `jax.numpy` in a torque, not numpy \(`jnp.sin`, not `np.sin`\)",
    ),
    "numpy in a torque of one's own": (
        lambda: forced(Spring()),
        "Use `jax.numpy` in a torque, not numpy",
    ),
    "math in a torque": (
        lambda: forced(lambda t, state, args: math.sin(t) * state.omega),
        "Use `jax.numpy` in a torque, not `math`, `float` or `int`",
    ),
    "a list in a torque": (
        lambda: forced(lambda t, state, args: [0.0, 1.0][jnp.int32(t)] * state.omega),
        "Use `jax.numpy` in a torque, not `math`, `float` or `int`",
    ),
    "numpy in a torque that is linearised": (
        lambda: jr.stability.linearize(jr.RigidBody(MOMENTS, Spring()), STATE),
        "Use `jax.numpy` in a torque, not numpy",
    ),
    "numpy in a force": (
        lambda: simulate(
            jr.FloatingBody(
                jr.solids.sphere(1.0, 0.1), lambda t, state, args: np.sin(t)
            ),
            jr.FloatingState(np.zeros(3), np.zeros(3), UPRIGHT, OMEGA),
            TS,
        ),
        "Use `jax.numpy` in a force, not numpy",
    ),
    "numpy in an event": (
        lambda: simulate(
            BODY,
            STATE,
            TS,
            event=diffrax.Event(lambda t, state, args, **_: np.sin(t) - 0.5),
        ),
        "Use `jax.numpy` in the condition of an event, not numpy",
    ),
    "numpy in the condition of a section": (
        lambda: jr.stability.poincare_section(
            BODY, STATE, lambda t, state: np.sin(state.omega[0]), 3, 0.1
        ),
        "Use `jax.numpy` in a condition, not numpy",
    ),
    "forward mode through reverse mode": (
        lambda: jax.jacfwd(turned)(OMEGA),
        r"`adjoint=diffrax.ForwardMode\(\)` serves jax.jvp, jax.jacfwd",
    ),
    "a tolerance of zero": (
        lambda: turned(OMEGA, rtol=0.0),
        "`rtol` must be at least 1e-14",
    ),
    "a count through vmap": (
        lambda: jax.vmap(lambda n: jr.stability.megno(BODY, STATE, 1.0, steps=n))(
            np.arange(9)
        ),
        "`steps` must be known when it is compiled, but it is traced: hand it past",
    ),
    "an option through jit": (
        lambda: jax.jit(lambda axis: jr.stability.growth_rate(MOMENTS, axis, 1.0))(1),
        "`axis` must be known when it is compiled, but it is traced: hand it past",
    ),
    "`throw` through jit": (
        lambda: jax.jit(lambda throw: free(MOMENTS, STATE, TS, throw=throw).omega)(
            False
        ),
        "`throw` must be known when it is compiled, but it is traced: hand it past",
    ),
    # records and fits
    "an array for a record": (
        lambda: fit(BLIND, RECORD.omegas),
        r"`observations` must be a record \(jr.identify.Rates, ...\).* but it is "
        "ndarray",
    ),
    "values as columns": (
        lambda: rates(values=RECORD.omegas.T),
        r"must have shapes \(n,\) and \(n, k\), but .*\(200,\) and \(3, 200\)",
    ),
    "degrees in a record": (
        lambda: fit(BLIND, rates(values=np.degrees(RECORD.omegas))),
        "rates in degrees a second, times not in seconds?",
    ),
    "milliseconds in a record": (
        lambda: fit(BLIND, rates(1000 * RECORD.times)),
        "rates in degrees a second, times not in seconds?",
    ),
    "bodies that are not as many as trials": (
        lambda: fit([BLIND] * 3, [rates(), rates()]),
        "`system` must hold one body for each of 2 trials, but it holds 3",
    ),
    "`free` of more sensors than there are": (
        lambda: fit(BLIND, rates(), free=lambda body, gyro, other: gyro.bias),
        r"`free` must be a function of the system and 1 sensor\(s\), .* 3 arguments",
    ),
    "`free` that picks the inertia": (
        lambda: fit(BLIND, rates(), free=lambda body, gyro: body.inertia),
        "`free` must .* beside the inertia, which is always sought",
    ),
    "`free` that picks a number": (
        lambda: fit(BLIND, rates(), free=lambda body, gyro: 3),
        "`free` must be a function .* that picks floating point arrays",
    ),
    "the scale of a free body": (
        lambda: fit(BLIND, rates(), scale="known"),
        "free motion tells ratios of the moments, never their scale",
    ),
    "a string through jit": (
        lambda: jax.jit(lambda scale: fit(BLIND, rates(), scale=scale).inertia)(
            "trace"
        ),
        "static_argnums",
    ),
    "a file without units": (
        lambda: jr.records.read(table(RECORD.times, RECORD.omegas)),
        r"`unit` must say the unit of the rates, .* \(`unit=\{'rates': .*rad/s, "
        ".*deg/s",
    ),
    "a file without names": (
        lambda: jr.records.read(io.StringIO("a,b,c,d\n0,1,2,3\n1,1,2,3\n")),
        "`path` must hold three columns of a sensor, .*: name them by `columns`. "
        "There are a, b",
    ),
    "a system for its mass properties": (
        lambda: jr.io.write_inertials("none.urdf", {"a": BODY}),
        r"`bodies\['a'\]` must be a MassProperties, but it is a RigidBody",
    ),
    "mass properties without a name": (
        lambda: jr.io.write_inertials("none.urdf", jr.solids.sphere(1.0, 0.1)),
        "`bodies` must be a Mapping, but it is a MassProperties",
    ),
    "no matplotlib": (
        lambda: without("matplotlib", lambda: jr.plot.polhode(MOMENTS)),
        r'pip install "jrigid\[plot\]"',
    ),
    "a record for its fit": (
        lambda: jr.plot.fit(RECORD),
        "`result` must be a FitResult, but it is a GyroRecord",
    ),
    "many motions in one picture": (
        lambda: jr.plot.polhode(
            MOMENTS, jr.State(np.ones((2, 9, 4)), np.ones((2, 9, 3)))
        ),
        r"one motion, but it is several: take one by `jax.tree.map\(lambda x: x\[i\], "
        r"motion\)`",
    ),
    "a motion before the body": (
        lambda: jr.plot.polhode(STATE, MOMENTS),
        "`body` must have or be an inertia, but it is a State",
    ),
    "a seed for a random key": (
        lambda: jr.identify.block_bootstrap(
            np.ones((9, 1, 1)), np.ones((9, 1)), 3, key=0
        ),
        r"`key` must be a random key, such as `jax.random.key\(0\)`, but it is a int",
    ),
    "a matrix for the derivatives of each time": (
        lambda: jr.identify.block_bootstrap(
            np.ones((9, 1)), np.ones((9, 1)), 3, key=jax.random.key(0)
        ),
        r"`jacobian` must have shape \(n, n, n\), but it has shape \(9, 1\)",
    ),
    "no zarr": (
        lambda: without(
            "zarr", lambda: jr.sweep(lambda a: a, {"a": TS}, store="none.zarr")
        ),
        r'pip install "jrigid\[sweep\]"',
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_told_with_what_to_do(name, untyped):
    call, message = MISTAKES[name]
    with pytest.raises(Exception, match=re.compile(message, re.DOTALL)):
        call()


def test_an_error_in_a_torque_is_chained_to_that_of_jax(untyped):
    with pytest.raises(ValueError, match=r"Use `jax\.numpy`") as error:
        forced(Spring())
    assert isinstance(error.value.__cause__, jax.errors.TracerArrayConversionError)


def test_single_precision_is_told():
    body, state0 = jax.tree.map(lambda x: x.astype(jnp.float32), (BODY, STATE))
    with pytest.warns(
        UserWarning, match="float32: errors of 1e-6 .* Switch on `jax_enable_x64`"
    ):
        jr.simulate(body, state0, np.float32(1.0))
