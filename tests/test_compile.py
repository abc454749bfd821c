"""How eager calls and fits are compiled, and what that costs beside XLA."""

import gc

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jrigid as jr
from jrigid._core import compile as _compile
from jrigid._core.third_party import outside_of_jit


@pytest.fixture
def collector():
    """Garbage collection is as it was after the test."""
    enabled = gc.isenabled()
    yield
    (gc.enable if enabled else gc.disable)()


@pytest.fixture
def programs():
    """Counts the programs that have been compiled since the start of the test."""
    count = 0

    def listen(event, _seconds, **_):
        nonlocal count
        count += "backend_compile" in event

    jax.monitoring.register_event_duration_secs_listener(listen)
    jax.clear_caches()
    yield lambda: count
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.mark.parametrize("compiled", [_compile.program, _compile.quick_jit])
@pytest.mark.parametrize("enabled", [True, False])
def test_no_garbage_is_collected_while_a_program_is_traced(
    collector, compiled, enabled
):
    seen = []

    @compiled
    def double(x):
        seen.append(gc.isenabled())
        return 2 * x

    (gc.enable if enabled else gc.disable)()
    np.testing.assert_array_equal(double(np.ones(3)), 2 * np.ones(3))
    assert seen == [False]
    assert gc.isenabled() is enabled


def test_garbage_is_collected_again_after_an_error(collector):
    @_compile.program
    def wrong(x):
        raise ValueError

    gc.enable()
    with pytest.raises(ValueError):
        wrong(np.ones(3))
    assert gc.isenabled()


def test_only_vmap_leaves_values_known():
    seen = []

    def look(x):
        seen.append(outside_of_jit())
        return jnp.sum(x)

    x = jnp.ones(3)
    look(x)
    jax.vmap(jax.vmap(look))(jnp.ones((2, 3)))
    assert seen == [True, True]
    seen.clear()
    jax.grad(look)(x)
    jax.vmap(jax.grad(look))(jnp.ones((2, 3)))
    jax.grad(lambda x: jnp.sum(jax.vmap(look)(x)))(jnp.ones((2, 3)))
    jax.jit(look)(x)
    jax.jit(jax.vmap(look))(jnp.ones((2, 3)))
    jax.eval_shape(look, jnp.ones(4))
    assert seen == [False] * 6


def test_options_of_the_compiler_are_for_programs_of_their_own():
    """JAX refuses options within another program, and where it differentiates."""

    @_compile.quick_jit
    def cube(x):
        return x**3

    @jax.jit
    def of_a_constant(x):
        return x + cube(jnp.asarray(2.0))

    x = jnp.asarray(2.0)
    lanes = jnp.asarray([1.0, 2.0])
    assert cube(x) == 8
    assert jax.jit(cube)(x) == 8
    assert of_a_constant(x) == 10
    assert jax.grad(cube)(x) == 12
    assert jax.jvp(cube, (x,), (x,)) == (8, 24)
    np.testing.assert_array_equal(jax.vmap(cube)(lanes), [1, 8])
    np.testing.assert_array_equal(jax.vmap(jax.grad(cube))(lanes), [3, 12])
    np.testing.assert_array_equal(jax.lax.map(cube, lanes), [1, 8])


@_compile.one_program
def _ratio(numerator, denominator=2.0, sign=None):
    numerator, denominator = jnp.asarray(numerator), jnp.asarray(denominator)
    ratio = jnp.sum(jnp.sin(numerator)) / denominator
    return ratio if sign is None else sign * ratio


def test_a_call_outside_of_jit_is_one_program(programs):
    x = np.arange(3.0)
    _ratio(x)
    for value in (1.0, 2.0, 3):
        _ratio(x, denominator=value)
    # An argument that is not given, a float and an integer.
    assert programs() == 3
    expected = np.sum(np.sin(x)) / 2
    for numbers in (x, np.arange(3.0), [0.0, 1.0, 2.0], (0, 1, 2)):
        assert float(_ratio(numbers)) == pytest.approx(expected, rel=1e-15)
    # A tuple of integers is the only other kind of array.
    assert programs() == 4


def test_other_calls_are_as_without_it():
    with pytest.raises(TypeError, match="string"):
        _ratio("string")
    x = jnp.arange(3.0)
    slope = jnp.cos(x) / 2
    np.testing.assert_allclose(jax.grad(_ratio)(x), slope, rtol=1e-15)
    np.testing.assert_allclose(jax.jit(jax.grad(_ratio))(x), slope, rtol=1e-15)
    lanes = jax.vmap(_ratio)(jnp.stack([x, x]))
    np.testing.assert_allclose(lanes, [_ratio(x)] * 2, rtol=1e-15)
    # Without the fallback JAX would refuse what is no number.
    assert _ratio.__wrapped__.__name__ == "_ratio"


@pytest.mark.parametrize("function", ["growth_rate", "frequency", "modes"])
def test_functions_of_an_axis_are_one_program_for_each_axis(programs, function):
    function = getattr(jr.stability, function)
    moments, spin = np.array([1.0, 2.0, 3.0]), np.asarray(1.5)
    for axis in (0, 1, 2, 0, 1, 2):
        by_place = function(moments, axis, spin)
        by_name = function(moments=moments, spin=spin, axis=axis)
        jax.tree_util.tree_map(np.testing.assert_array_equal, by_place, by_name)
    assert programs() == 3
    with pytest.raises(ValueError, match="`axis` must be one of 0, 1, 2"):
        function(moments, 3, spin)


def test_integrals_are_one_program_for_each_case(programs):
    gravity = jr.torques.UniformGravity(
        np.asarray(1.0), np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
    )
    body = jr.RigidBody(np.array([2.0, 2.0, 1.0]), gravity)
    state = jr.State(np.array([1.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.0, 3.0]))
    before = programs()
    for case in (None, "kovalevskaya", None, "kovalevskaya"):
        extra = jr.top.integrals(body, state, case).extra
        assert extra is None if case is None else float(extra) == 1.0
    assert programs() - before == 2


@pytest.mark.parametrize(
    "function",
    [jr.rotation.from_matrix, jr.rotation.to_euler, jr.rotation.log],
)
def test_functions_of_rotations_are_one_program(programs, function):
    of_matrix = function is jr.rotation.from_matrix
    argument = np.eye(3) if of_matrix else np.array([0.6, 0.0, 0.8, 0.0])
    function(argument)
    assert programs() == 1


def drag(t, state, args):
    return -args * state.omega


def final_rate(coefficient):
    body = jr.RigidBody(np.array([1.0, 2.0, 3.0]), drag)
    return jr.simulate(body, SPINNING, 1.0, coefficient).final_state.omega


def largest_exponent(coefficient):
    body = jr.RigidBody(np.array([1.0, 2.0, 3.0]), drag)
    return jr.stability.megno(body, SPINNING, 1.0, 20, args=coefficient).exponent


def above(x, coefficient):
    return x - coefficient


def root(coefficient):
    return jr.stability.boundary(above, 0.0, 1.0, coefficient)


SPINNING = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.1, 1.0, 0.2]))


@pytest.mark.parametrize("function", [final_rate, largest_exponent, root])
def test_another_float_in_args_is_not_compiled_anew(function, programs):
    first = function(0.3)
    compiled = programs()
    assert compiled > 0
    second = function(0.4)
    assert programs() == compiled
    assert np.max(np.abs(np.asarray(first - second))) > 1e-3
