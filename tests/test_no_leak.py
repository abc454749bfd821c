"""Calls that raise compile nothing anew and keep no memory."""

import ast
import gc
import itertools
from pathlib import Path

import house
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jrigid as jr

CALLS = 100
WARM_UP = 5
PAGE = 4096  # bytes
MEMORY = Path("/proc/self/statm")
COMPILED = "/jax/core/compile/backend_compile_duration"

UNIT = np.array([1.0, 0.0, 0.0, 0.0])
MOMENTS = np.array([1.0, 2.0, 3.0])
TIMES = np.array([0.0, 0.5, 1.0])
GOOD = jr.State(jnp.asarray(UNIT), jnp.array([0.1, 1.0, 0.2]))
BAD = jr.State(jnp.asarray(UNIT), jnp.array([0.1, jnp.nan, 0.2]))
CORNERS = np.array([[0.0, 0, 0], [6.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
SAMPLES = np.linspace(0.0, 2.0, 20)
RATES = np.stack([np.cos(SAMPLES), np.sin(SAMPLES), 1 + 0 * SAMPLES], axis=1)
COUNTER = itertools.count(1)


def broken(t, state, args):
    return jnp.where(t > args, jnp.nan, 1.0) * jnp.ones(3)


def crossing(t, state):
    return state.omega[0]


def simulate(state, breaks_at):
    return jr.simulate(jr.RigidBody(MOMENTS, broken), state, TIMES, breaks_at)


def free_rotation_lanes(sign):
    moments = np.stack([MOMENTS, sign * MOMENTS])
    return jax.vmap(lambda x: jr.free_rotation(x, GOOD, TIMES))(moments)


def mesh(faces):
    return jr.from_mesh(CORNERS, faces)


def density(sign):
    lower, upper = np.zeros(3), np.ones(3)
    return jr.from_density(lambda r: sign * (1 + r[0]), lower, upper, order=3)


def upright_top(moments):
    body = jr.MassProperties(1.0, np.zeros(3), moments)
    return jr.SymmetricTop.from_mass_properties(body, np.array([0.0, 0.0, 1.0]))


def initial_state(moment):
    return jr.top.initial_state(jr.SymmetricTop(moment, 0.5, 1.0), 0.5, omega3=5.0)


def top_motion(moment):
    return jr.top_motion(jr.SymmetricTop(moment, 0.5, 1.0), GOOD, TIMES)


def above(x, least):
    return x - least


def boundary(least):
    return jr.stability.boundary(above, 0.0, 1.0, least)


def fit(rates):
    record = jr.identify.Rates(SAMPLES, rates, 0.1)
    return jr.identify.fit(jr.RigidBody(MOMENTS), record)


def body(mass):
    return jr.MassProperties(mass, np.zeros(3), np.ones(3))


def section(state):
    body = jr.RigidBody(MOMENTS)
    return jr.stability.poincare_section(body, state, crossing, 3, 0.1)


# A call that works, or None, and the call that raises.
CASES = {
    "simulate": (lambda: simulate(GOOD, 9.0), lambda: simulate(BAD, 9.0)),
    "simulate, torque": (lambda: simulate(GOOD, 9.0), lambda: simulate(GOOD, 0.3)),
    "free_rotation": (
        lambda: jr.free_rotation(MOMENTS, GOOD, TIMES),
        lambda: jr.free_rotation(-MOMENTS, GOOD, TIMES),
    ),
    "free_rotation, lanes": (None, lambda: free_rotation_lanes(-1.0)),
    "top_motion": (lambda: top_motion(1.0), lambda: top_motion(-1.0)),
    "MassProperties": (lambda: body(1.0), lambda: body(-1.0)),
    "MassProperties, gradient": (
        None,
        lambda: jax.grad(lambda mass: body(mass).mass)(-1.0),
    ),
    "from_points": (
        lambda: jr.from_points(np.ones(4), CORNERS),
        lambda: jr.from_points(-np.ones(4), CORNERS),
    ),
    "from_mesh": (lambda: mesh(FACES), lambda: mesh(FACES[:, ::-1])),
    # Each time with another message.
    "from_mesh, message": (lambda: mesh(FACES), lambda: mesh(FACES + next(COUNTER))),
    "from_density": (None, lambda: density(-1.0)),
    "from_mass_properties": (
        lambda: upright_top(np.array([1.0, 1.0, 1.5])),
        lambda: upright_top(np.array([1.0, 1.2, 1.5])),
    ),
    "initial_state": (lambda: initial_state(1.0), lambda: initial_state(-1.0)),
    "poincare_section": (None, lambda: section(BAD)),
    "boundary": (lambda: boundary(0.5), lambda: boundary(5.0)),
    "weak_form": (
        lambda: jr.identify.weak_form(SAMPLES, RATES),
        lambda: jr.identify.weak_form(SAMPLES[::-1], RATES),
    ),
    "fit": (None, lambda: fit(np.nan * RATES)),
}


@pytest.fixture(scope="module")
def compilations():
    """How many programs have been compiled so far."""
    count = [0]

    def listen(event, duration, **_):
        count[0] += event == COMPILED

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield lambda: count[0]
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.fixture(scope="module", autouse=True)
def only_what_is_new():
    """Leave out of each collection what earlier tests hold:
    gigabytes take eight seconds."""
    gc.freeze()
    yield
    gc.unfreeze()


def memory():
    gc.collect()
    return int(MEMORY.read_text().split()[1]) * PAGE


def fail(call, times):
    for _ in range(times):
        with pytest.raises(RuntimeError):
            call()


@pytest.mark.parametrize("name", CASES)
def test_calls_that_raise_compile_once_and_keep_no_memory(name, compilations):
    works, raises = CASES[name]
    if works is None:
        fail(raises, 1)
    else:
        works()
    before = compilations()
    fail(raises, WARM_UP)
    held = memory() if MEMORY.exists() else 0
    fail(raises, CALLS - WARM_UP)
    assert compilations() - before <= 1
    if MEMORY.exists():
        assert memory() - held < 3e6


def test_what_is_wrong_is_looked_up_by_functions_and_not_by_closures():
    """`settle` compiles what it is given: a closure would be compiled at each error."""
    for name, _, tree in house.modules():
        defined = {x.name for x in tree.body if isinstance(x, ast.FunctionDef)}
        imported = {
            x.asname or x.name
            for node in tree.body
            if isinstance(node, ast.ImportFrom)
            for x in node.names
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "settle":
                findings = node.args[2]
                assert isinstance(findings, ast.Name), name
                assert findings.id in defined | imported, (name, findings.id)
