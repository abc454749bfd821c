"""What jax, equinox and diffrax do not document is as `_core/third_party.py` says."""

import tomllib
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Primitive
from jax.interpreters import batching
from packaging.requirements import Requirement
from packaging.version import Version

import jrigid as jr
from jrigid._core import third_party
from jrigid._core.lanes_last import lanes_last

LANES = 5
VECTORS = np.random.default_rng(0).uniform(0.1, 0.9, (3, LANES))
OTHERS = np.random.default_rng(1).uniform(0.1, 0.9, (3, LANES))
NUMBERS = VECTORS[0]
INTEGERS = (100 * VECTORS).astype(np.int32)
MORE_INTEGERS = (100 * OTHERS).astype(np.int32)

# Primitives that only some of the tested versions have.
OF_SOME_VERSIONS = {"closed_call", "log2", "split", "stack", "unstack"}


# Examples: a function of one lane, and its arguments with lanes last -----------------

UNARY = """
abs acos acosh asin asinh atan atanh cbrt ceil cos cosh erf exp exp2 expm1 floor
is_finite log log1p logistic neg round rsqrt sign sin sinh sqrt square tan tanh
"""
BINARY = "add atan2 div eq ge gt le lt max min mul ne nextafter pow rem sub"
BITWISE = "and or xor"
REDUCTIONS = "reduce_max reduce_min reduce_prod reduce_sum"


def as_bits(x):
    return jax.lax.bitcast_convert_type(x, jnp.int64)


ELEMENTWISE = {
    "add_jaxvals": (lambda x, y: jax.vjp(lambda z: z * z, x)[1](y)[0], VECTORS, OTHERS),
    "bitcast_convert_type": (as_bits, VECTORS),
    "clamp": (lambda x, y: jax.lax.clamp(0.3, x, y), VECTORS, OTHERS),
    "convert_element_type": (lambda x: x.astype(jnp.float32), VECTORS),
    "copy": (lambda x: jnp.array(x, copy=True), VECTORS),
    "integer_pow": (lambda x: jax.lax.integer_pow(x, 3), VECTORS),
    "log2": (jnp.log2, VECTORS),
    "not": (jax.lax.bitwise_not, INTEGERS),
    "reduce_precision": (lambda x: jax.lax.reduce_precision(x, 8, 10), VECTORS),
    "select_n": (lambda x, y: jax.lax.select(x > y, x, y), VECTORS, OTHERS),
}
for name in UNARY.split():
    ELEMENTWISE[name] = getattr(jax.lax, name), VECTORS
for name in BINARY.split():
    ELEMENTWISE[name] = getattr(jax.lax, name), VECTORS, OTHERS
for name in BITWISE.split():
    ELEMENTWISE[name] = getattr(jax.lax, f"bitwise_{name}"), INTEGERS, MORE_INTEGERS


def reductions(name):
    reduce = getattr(jnp, name.removeprefix("reduce_"))
    many = lambda x: reduce(jnp.concatenate([x, x, x, x]))  # noqa: E731
    return lambda x: (reduce(x), many(x), reduce(jnp.stack([x, 2 * x]), axis=1))


OF_AXES = {
    "concatenate": (lambda x, y: jnp.concatenate([x, y, x]), VECTORS, OTHERS),
    "reduce_and": (lambda x: jnp.all(x > 0.3), VECTORS),
    "reduce_or": (lambda x: jnp.any(x > 0.8), VECTORS),
    "rev": (lambda x: jax.lax.rev(x, (0,)), VECTORS),
    "split": (lambda x: jnp.split(x, 3), VECTORS),
    "squeeze": (lambda x: jnp.squeeze(x[None, :, None], (0, 2)), VECTORS),
    "stack": (lambda x, y: jnp.stack([x, y], axis=-1), VECTORS, OTHERS),
    "unstack": (lambda x: jnp.unstack(jnp.stack([x, x], axis=1), axis=1), VECTORS),
    "broadcast_in_dim": (lambda x: jnp.broadcast_to(x, (2, 3)), VECTORS),
    "reshape": (lambda x: jnp.reshape(x, (1, 3)), VECTORS),
    "transpose": (lambda x, y: jnp.stack([x, y]).T, VECTORS, OTHERS),
    "slice": (lambda x: jax.lax.slice(x, (0,), (3,), (2,)), VECTORS),
}
# Few terms along the first axis are written out, others are not.
OF_AXES |= {name: (reductions(name), VECTORS) for name in REDUCTIONS.split()}


@jax.custom_jvp
def with_jvp(x):
    return jnp.sin(x)


@jax.custom_vjp
def with_vjp(x):
    return jnp.sin(x)


with_jvp.defjvp(lambda x, dx: (with_jvp(*x), dx[0]))
with_vjp.defvjp(lambda x: (with_vjp(x), None), lambda _, slope: (slope,))


def closed_call(x):
    (primitive,) = third_party.known_primitives("closed_call")
    program = jax.make_jaxpr(jnp.sin)(x)
    return third_party.apply(primitive, {"call_jaxpr": program}, x)[0]


CALLS = {
    "jit": (jax.jit(lambda x: x * x[0]), VECTORS),
    "closed_call": (closed_call, VECTORS),
    "custom_jvp_call": (with_jvp, VECTORS),
    "custom_vjp_call": (with_vjp, VECTORS),
    "remat": (jax.checkpoint(lambda x: jnp.sin(x) * x[0]), VECTORS),
}


def products(x, rows):
    def step(carry, row):
        return carry * row + x, carry

    return jax.lax.scan(step, 2 * x, rows, reverse=True)


LOOPS = {
    "scan": (products, VECTORS, OTHERS),
    "cond": (
        lambda x: jax.lax.cond(jnp.sum(jnp.ones(2)) > 1, jnp.sin, jnp.cos, x),
        VECTORS,
    ),
}

EXAMPLES = ELEMENTWISE | OF_AXES | CALLS | LOOPS


def primitives_of(function, *lanes):
    program = jax.make_jaxpr(function)(*(x[..., 0] for x in lanes))
    outer = {equation.primitive for equation in program.eqns}
    called = map(third_party.called_program, program.eqns)
    inner = {equation.primitive for x in called if x is not None for equation in x.eqns}
    return outer | inner


def by_vmap(function, *lanes):
    """The reference; vmap has lanes in front, where all its rules are right."""
    in_front = [jnp.moveaxis(jnp.asarray(x), -1, 0) for x in lanes]
    results = jax.vmap(function)(*in_front)
    return jax.tree_util.tree_map(lambda x: jnp.moveaxis(x, 0, -1), results)


def assert_equal(found, expected):
    assert jax.tree_util.tree_structure(found) == jax.tree_util.tree_structure(expected)
    leaves = jax.tree_util.tree_leaves(found), jax.tree_util.tree_leaves(expected)
    for x, y in zip(*leaves, strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_allclose(x, y, rtol=1e-15, atol=1e-15)


# The tables -------------------------------------------------------------------------


def test_every_primitive_of_the_tables_has_an_example():
    tables = {
        *third_party.ELEMENTWISE_NAMES.split(),
        *third_party.AXES_FROM_FRONT_NAMES.split(),
        *third_party.CHANGED_BY_AXIS,
        *third_party.CALLS,
        "scan",
        "cond",
    }
    assert tables == EXAMPLES.keys()


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_primitive_of_the_tables_is_what_it_is_taken_for(name, monkeypatch):
    known = third_party.known_primitives(name)
    if not known and name in OF_SOME_VERSIONS:
        pytest.skip("not a primitive of this version")
    function, *lanes = EXAMPLES[name]
    assert known & primitives_of(function, *lanes)
    expected = by_vmap(function, *lanes)
    lanes = [jnp.asarray(x) for x in lanes]
    with monkeypatch.context() as patch:
        patch.setattr(jax, "vmap", None)  # the table is used, and not what is beside it
        found = lanes_last(function, *lanes)
    assert_equal(found, expected)


@pytest.mark.parametrize("name", ELEMENTWISE)
def test_elementwise_primitives_take_numbers(name):
    function, *lanes = ELEMENTWISE[name]
    lanes = [jnp.asarray(x[0]) for x in lanes]
    assert_equal(lanes_last(function, *lanes), by_vmap(function, *lanes))


def test_elementwise_primitives_take_numbers_beside_vectors():
    def function(x, number):
        return (
            jax.lax.select(number > 0.5, x, -x),
            jax.lax.select_n((number > 0.5).astype(jnp.int32), x, 2 * x),
            jax.lax.select(jnp.array([True, False, True]), x, -x),
            jax.lax.clamp(number, x, 0.8),
            x + number,
        )

    lanes = jnp.asarray(VECTORS), jnp.asarray(NUMBERS)
    assert_equal(lanes_last(function, *lanes), by_vmap(function, *lanes))


# What the tables do not know --------------------------------------------------------


def widened(x):
    return jax.lax.bitcast_convert_type(x, jnp.float64)


def doubled(x):
    return jax.lax.while_loop(lambda x: jnp.sum(x) < 9, lambda x: 2 * x, x)


def random(x):
    key = jax.lax.bitcast_convert_type(x[:2], jnp.uint64)
    return jax.lax.rng_bit_generator(key, (3,))[1]


@pytest.mark.parametrize(
    ("function", "lanes"),
    [
        (lambda x: jax.lax.bitcast_convert_type(x, jnp.uint32), NUMBERS),
        (lambda x: jax.lax.bitcast_convert_type(x, jnp.uint32), VECTORS),
        (widened, INTEGERS[:2]),
        (widened, np.stack([INTEGERS[:2], MORE_INTEGERS[:2]])),
        (random, VECTORS),
        (lambda x: x + jax.lax.iota(jnp.float64, 3), VECTORS),
        (lambda x: jnp.sort(x)[jnp.argmax(x)], VECTORS),
        (doubled, VECTORS),
        (lambda x: jax.lax.cond(x[0] > 0.5, jnp.sin, jnp.cos, x), VECTORS),
        (lambda x: jax.lax.reshape(jnp.outer(x, x), (9,), (1, 0)), VECTORS),
        (lambda x: jax.random.key_data(jax.random.key(x[0])), INTEGERS),
        (lambda x: jnp.abs(jnp.fft.fft(x)), VECTORS),
    ],
)
def test_any_other_operation_equals_its_vmap(function, lanes):
    lanes = jnp.asarray(lanes)
    assert_equal(lanes_last(function, lanes), by_vmap(function, lanes))


def test_an_operation_without_results_is_done_in_all_lanes(capsys):
    def function(x):
        jax.debug.print("first {}", x[0])
        return 2 * x

    found = lanes_last(function, jnp.asarray(VECTORS))
    jax.effects_barrier()
    np.testing.assert_array_equal(found, 2 * VECTORS)
    assert capsys.readouterr().out.count("first") == LANES


def test_a_layout_over_devices_has_an_entry_for_each_axis():
    devices = jax.sharding.Mesh(jax.devices()[:1], "a")
    layout = jax.sharding.NamedSharding(devices, jax.sharding.PartitionSpec(None))
    options = {"new_dtype": np.dtype("float32"), "weak_type": False, "sharding": layout}

    def function(x):
        return jax.lax.convert_element_type_p.bind(x, **options)

    program = jax.make_jaxpr(function)(VECTORS[:, 0])
    assert not third_party.is_elementwise(program.eqns[0])


def test_primitives_are_not_known_by_their_names_alone():
    def reversed_flat(x):
        return x.reshape(-1)[::-1].reshape(x.shape)

    impostor = Primitive("add")
    impostor.def_impl(reversed_flat)
    impostor.def_abstract_eval(lambda x: x)

    def batch(values, axes):
        return jax.vmap(reversed_flat, axes)(*values), 0

    batching.primitive_batchers[impostor] = batch
    found = lanes_last(lambda x: impostor.bind(x), jnp.asarray(VECTORS))
    np.testing.assert_array_equal(found, VECTORS[::-1])


# The rest ---------------------------------------------------------------------------


def test_enumerations_hold_names_codes_and_messages():
    item = jr.RESULTS.invalid_inertia
    assert isinstance(item, third_party.EnumerationItem)
    assert third_party.enumeration_of(item) is jr.RESULTS
    names = third_party.names_of(jr.RESULTS)
    messages = third_party.messages_of(jr.RESULTS)
    assert len(names) == len(messages) == len(jr.RESULTS)
    assert set(third_party.names_of(diffrax.RESULTS)) < set(names)
    for code, name in enumerate(names):
        assert third_party.code_of(getattr(jr.RESULTS, name)) == code
    assert messages[names.index("invalid_inertia")].startswith("Argument `inertia`")
    lanes = jax.vmap(lambda x: jr.RESULTS.where(x, item, jr.RESULTS.successful))
    codes = third_party.code_of(lanes(jnp.array([True, False])))
    np.testing.assert_array_equal(codes, [names.index("invalid_inertia"), 0])


def test_a_program_tells_which_inputs_it_uses():
    program = jax.make_jaxpr(lambda x, y, _: (jnp.sin(x), y))
    assert third_party.used_inputs(program(1.0, 2.0, 3.0)) == [True, True, False]


def test_whether_any_lane_is_true_is_known_inside_of_vmap():
    seen = []

    def look(x):
        seen.append(third_party.unvmap_any(x))
        return x

    jax.vmap(look)(jnp.array([False, True]))
    jax.vmap(look)(jnp.array([False, False]))
    assert [bool(x) for x in seen] == [True, False]


def test_versions_are_bounded_by_those_tested():
    text = (Path(__file__).parents[1] / "pyproject.toml").read_text()
    required = map(Requirement, tomllib.loads(text)["project"]["dependencies"])
    bounds = {x.name: x.specifier for x in required}
    modules = {"jax": jax, "equinox": eqx, "diffrax": diffrax}
    for name, (oldest, newest) in third_party.TESTED_WITH.items():
        lower = {x.version for x in bounds[name] if x.operator == ">="}
        upper = {x.version for x in bounds[name] if x.operator == "<"}
        major, minor = Version(newest).release[:2]
        assert lower == {oldest}
        assert upper == {f"{major}.{minor + 1}"}
        assert Version(modules[name].__version__) in bounds[name]


def count_arithmetic(function, *arguments):
    return third_party.arithmetic_operations(jax.make_jaxpr(function)(*arguments).jaxpr)


def test_operations_of_called_programs_are_counted():
    def twice(x):
        return x + jax.jit(lambda y: y * y - x)(x)

    assert count_arithmetic(twice, 1.0) == 3


@pytest.mark.parametrize(
    "function",
    [
        jnp.cos,
        jax.jit(lambda x: 1 + jnp.exp(x)),
        lambda x: jax.lax.cond(x > 0, jnp.square, jnp.negative, x),
        lambda x: jax.lax.fori_loop(0, 2, lambda _, y: y * y, x),
    ],
)
def test_functions_of_the_c_library_and_loops_are_not_arithmetic(function):
    assert count_arithmetic(function, 1.0) is None
