"""Input validation: errors name the argument, its value and the lane, or mark it."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jrigid as jr
from jrigid import _checks
from jrigid._checks import RESULTS, Findings, settle, where_defined
from jrigid._types import Readable

MOMENTS = jnp.array([1.0, 2.0, 3.0])


class Answer(eqx.Module):
    value: jax.Array
    result: object


def look(inertia, x):
    findings = Findings()
    findings.require(
        _checks.is_inertia(inertia), RESULTS.invalid_inertia, value=inertia
    )
    message = "Argument `x` must be positive, but it is not."
    findings.require(x > 0, RESULTS.invalid_state, message, x)
    return findings


@eqx.filter_jit
def compute(inertia, x):
    findings = look(inertia, x)
    result = RESULTS.where(
        findings.ok & (x > 10), RESULTS.max_steps_reached, findings.result
    )
    return Answer(_checks.nan_where(~findings.ok, jnp.sum(inertia) * x * 2), result)


def work(inertia, x, throw=True):
    inertia, x = _checks.float_arrays(inertia, x)
    return settle(compute(inertia, x), throw, lambda: look(inertia, x))


XS = jnp.array([1.0, -2.0, -3.0])


def test_complex_numbers_are_an_error_where_real_ones_are_due():
    with pytest.raises(ValueError, match="must be real numbers, but one is complex"):
        _checks.float_arrays(MOMENTS, np.array(MOMENTS) + 0.1j)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (
            jr.SymmetricTop(1.0, 0.5, 0.0),
            r"a SymmetricTop: pass its `\.as_rigid_body\(\)\.inertia`",
        ),
        (jr.RigidBody(MOMENTS), r"a RigidBody: pass its `\.inertia`"),
        (jr.State(jnp.ones(4), MOMENTS), r"one is a State\."),
        (None, r"one is a NoneType\."),
    ],
)
def test_what_is_no_number_is_named(untyped, value, message):
    with pytest.raises(ValueError, match=message):
        jr.free_rotation(value, jr.State(jnp.ones(4), MOMENTS), 1.0)
    with pytest.raises(ValueError, match=message):
        jr.dynamics.kinetic_energy(value, MOMENTS)


def test_lists_of_traced_numbers_are_arrays(untyped):
    def turned(angle):
        return jr.rotation.exp([0.0, angle, 0.0])

    np.testing.assert_allclose(jax.jit(turned)(jnp.pi), [0, 0, 1, 0], atol=1e-15)
    _, slope = jax.jvp(turned, (0.0,), (1.0,))
    np.testing.assert_allclose(slope, [0, 0, 0.5, 0], atol=1e-15)


def test_a_torque_may_return_a_list():
    state = jr.State(jnp.array([1.0, 0, 0, 0]), jnp.array([0, 0, 1.0]))
    body = jr.RigidBody(MOMENTS, lambda t, _state, _args: [0.0, 0.0, t])
    end = jr.simulate(body, state, 2.0).final_state
    # The moment is 3, so that the rate grows by t^2 / 6.
    assert float(end.omega[2]) == pytest.approx(1 + 4 / 6, rel=1e-7)


def test_a_jump_is_not_nan():
    state = jr.State(jnp.array([1.0, 0, 0, 0]), MOMENTS)
    with pytest.raises(RuntimeError, match="`jumps` must hold times"):
        jr.simulate(jr.RigidBody(MOMENTS), state, 1.0, jumps=jnp.array([jnp.nan]))


@pytest.mark.parametrize(
    ("event", "message"),
    [
        (lambda _t, y, _args: y.omega[0], r"must be a `diffrax.Event\(condition\)`"),
        (diffrax.Event(lambda t, _y: t), r"does not take these"),
        (diffrax.Event(lambda _t, y, _args: y.omega), r"`event` must return a number"),
    ],
)
def test_a_wrong_event_is_named(untyped, event, message):
    state = jr.State(jnp.array([1.0, 0, 0, 0]), MOMENTS)
    with pytest.raises(ValueError, match=message):
        jr.simulate(jr.RigidBody(MOMENTS), state, 1.0, event=event)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: work(MOMENTS, -1.0), r"`x` must be positive, but it is not: -1\.0\."),
        (lambda: work(-MOMENTS, 1.0), r"not: \[-1\. -2\. -3\.\]\. \(Three bodies"),
        (lambda: work(MOMENTS, 11.0), "maximum number of solver steps"),
        (
            lambda: jax.vmap(lambda x: work(MOMENTS, x))(XS),
            r"not: -2\.0 in lane 1 and 1 more\.",
        ),
        (
            lambda: jax.vmap(lambda x: work(-MOMENTS, x))(XS),
            r"-3\.\] in lane 0 and 2 more",
        ),
        (
            lambda: jax.vmap(
                lambda a: jax.vmap(lambda x: work(a * MOMENTS, x))(
                    jnp.array([1.0, 2.0, 3.0])
                )
            )(jnp.array([1.0, -1.0])),
            r"\[-1\. -2\. -3\.\] in lane \(1, 0\) and 2 more",
        ),
        (lambda: jax.grad(lambda x: work(MOMENTS, x).value)(-1.0), r"not: -1\.0\."),
        (
            lambda: jax.vmap(jax.grad(lambda x: work(MOMENTS, x).value))(XS),
            r"-2\.0 in lane 1",
        ),
        (
            lambda: jax.grad(
                lambda a: jnp.sum(jax.vmap(lambda x: work(MOMENTS, x).value)(a))
            )(XS),
            r"-2\.0 in lane 1",
        ),
        (
            lambda: jax.vmap(lambda x: work(MOMENTS, x))(jnp.array([1.0, 12.0])),
            r"maximum number of solver steps .*`max_steps`: in lane 1\.",
        ),
    ],
)
def test_known_values_raise_in_python_with_value_and_lane(call, message):
    with pytest.raises(RuntimeError, match=message) as error:
        call()
    assert len(error.value.args[0]) < 300


@pytest.mark.parametrize(
    ("xs", "message"),
    [
        (jnp.array([1.0, -1.0]), "Argument `x` must be positive"),
        (jnp.array([1.0, 12.0]), "maximum number of solver steps"),
    ],
)
def test_inside_jit_the_error_is_raised_at_run_time(xs, message):
    with pytest.raises(RuntimeError, match=message):
        eqx.filter_jit(jax.vmap(lambda x: work(MOMENTS, x).value))(xs)


def test_good_values_pass_everywhere_and_without_callbacks():
    assert work(MOMENTS, 1.0).value == 12
    assert jax.grad(lambda x: work(MOMENTS, x).value)(1.0) == 12
    assert "callback" not in str(
        jax.make_jaxpr(lambda x: work(MOMENTS, x, throw=False).value)(1.0)
    )


def test_without_trial_a_bad_lane_is_marked_and_no_other_touched():
    found = jax.vmap(lambda x: work(MOMENTS, x, throw=False))(XS)
    np.testing.assert_array_equal(found.value, [12, np.nan, np.nan])
    np.testing.assert_array_equal(
        found.result == RESULTS.invalid_state, [False, True, True]
    )


def test_a_builder_raises_or_is_nan():
    def build(x, throw):
        return look(MOMENTS, x).guard({"x": x}, throw)["x"]

    with pytest.raises(RuntimeError, match=r"not: -2\.0 in lane 1 and 1 more"):
        jax.vmap(lambda x: build(x, True))(XS)
    np.testing.assert_array_equal(
        jax.vmap(lambda x: build(x, False))(XS), [1, np.nan, np.nan]
    )


def test_a_formula_is_nan_outside_its_domain_and_its_derivatives_are_clean():
    def root(x, shared):
        return where_defined(x > 0, lambda x, shared: shared * jnp.sqrt(x), x, shared)

    def total(xs, shared):
        roots = jax.vmap(lambda x: root(x, shared))(xs)
        return jnp.sum(jnp.where(jnp.isnan(roots), 0.0, roots))

    xs = jnp.array([4.0, -1.0, jnp.nan])
    slopes, of_shared = jax.grad(total, argnums=(0, 1))(xs, jnp.asarray(2.0))
    np.testing.assert_allclose(slopes, [0.5, 0, 0])
    np.testing.assert_allclose(of_shared, 2.0)


def test_codes_are_listed_each_with_a_text():
    names = [x for x in dir(RESULTS) if isinstance(getattr(RESULTS, x), RESULTS)]
    assert {"successful", "invalid_inertia", "max_steps_reached"} <= set(names)
    assert all(RESULTS[getattr(RESULTS, name)] for name in names)
    found = jax.vmap(lambda x: work(MOMENTS, x, throw=False))(XS)
    texts = RESULTS[found.result]
    assert texts.shape == (3,)
    assert texts[0] == "All went well."
    assert "must be finite" in texts[1]


def test_a_readable_module_shows_its_numbers():
    class Point(Readable):
        x: jax.Array
        far: jax.Array

    shown = repr(Point(jnp.array([1.0, 2.5]), jnp.zeros((20, 3))))
    assert shown == "Point(x=[1. , 2.5], far=f64[20,3])"
    traced = []
    jax.jit(lambda x: traced.append(repr(Point(x, x))))(jnp.ones(2))
    assert traced == ["Point(x=f64[2], far=f64[2])"]
