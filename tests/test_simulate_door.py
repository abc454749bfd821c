"""simulate(): what it refuses and says, events, and what its compiled function holds."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from helpers import ATTITUDE, MOMENTS, OMEGA, in_a_process, quick_jit

import jrigid as jr
from jrigid._stepping.control import _LARGEST_BOUNDS
from jrigid.simulate._event import condition_of_states

FORWARD = diffrax.ForwardMode()
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
STATE = jr.State(UPRIGHT, OMEGA)
BODY = jr.RigidBody(MOMENTS)


# What is compiled
# ----------------------------------------------------------------------------


def _turned_by(angle):
    """A condition: the body, turning about axis 3, has turned by an angle."""
    return lambda _t, state, _args, **_: state.attitude[0] - jnp.cos(0.5 * angle)


# The same functions for all tests: a new one is compiled anew.
TURNED = diffrax.Event(_turned_by(1.3))
BY_NEWTON = diffrax.Event(TURNED.cond_fn, optx.Newton(1e-12, 1e-12))


def _spun(rate, event=None, adjoint=None, solver=None):
    state0 = jr.State(UPRIGHT, rate * jnp.array([0, 0, 1.0]))
    return jr.simulate(
        BODY, state0, jnp.array([0.5, 5.0]), event=event, adjoint=adjoint, solver=solver
    )


@pytest.mark.parametrize("event", [None, TURNED], ids=["plain", "event"])
@pytest.mark.parametrize("mode", ["value", "reverse", "forward"])
def test_the_compiled_function_holds_no_callback(event, mode):
    """Which would keep it out of jax's persistent cache, with `throw` or without."""
    adjoint = FORWARD if mode == "forward" else None

    def number(rate):
        state0 = jr.State(UPRIGHT, rate * jnp.array([0, 0, 1.0]))
        trajectory = jr.simulate(
            BODY, state0, 5.0, event=event, adjoint=adjoint, throw=False
        )
        return trajectory.final_time + trajectory.final_state.attitude[0]

    function = {
        "value": number,
        "reverse": jax.grad(number),
        "forward": jax.jacfwd(number),
    }[mode]
    assert "callback" not in str(jax.make_jaxpr(function)(2.0))


SCRIPT = """
import jax
jax.config.update("jax_enable_x64", True)
counts = {{}}
def count(name, **_):
    counts[name] = counts.get(name, 0) + 1
jax.monitoring.register_event_listener(count)
import jax.numpy as jnp
import jrigid as jr
{work}
print(*(counts.get("/jax/compilation_cache/" + x, 0) for x in ("cache_hits", "cache_misses")))
"""

WORK = {
    "motions": """
def final(omega):
    state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), omega)
    return jr.simulate(jr.RigidBody(jnp.array([1.0, 2.0, 3.0])), state0, 1.0).states.omega[0]

omega = jnp.array([0.3, -0.5, 0.8])
jax.block_until_ready((final(omega), jax.grad(final)(omega)))
jax.block_until_ready(jax.vmap(final)(jnp.stack([omega, -omega])))
""",
    "closed forms": """
state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.3, -0.5, 0.8]))
turn = lambda inertia: jr.free_rotation(inertia, state, 1.0, throw=False).omega[0]
jax.block_until_ready(jax.vmap(jax.grad(turn))(jnp.stack([jnp.eye(3), 2 * jnp.eye(3)])))
jax.block_until_ready(jr.top_motion(jr.SymmetricTop(1.0, 2.0, 0.3), state, 1.0).omega)
""",
    "a fit": """
record = jr.datasets.gyro_example()
readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
jax.block_until_ready(jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings).inertia)
""",
}


@pytest.mark.parametrize(
    "work", ["motions", "closed forms", pytest.param("a fit", marks=pytest.mark.slow)]
)
def test_a_second_process_with_the_persistent_cache_compiles_nothing(work, tmp_path):
    environment = {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        "JAX_EXPLAIN_CACHE_MISSES": "0",
    }
    for process in (1, 2):
        said, complained = in_a_process(SCRIPT.format(work=WORK[work]), **environment)
        hits, misses = map(int, said.split())
        assert "host callbacks" not in complained
        assert misses > 0 if process == 1 else (misses == 0 and hits > 0)


# Events
# --------------------------------------------------------------------------------------


def test_an_event_is_located_without_being_asked_and_differentiated_twice():
    """A body turning at `rate` has turned by 1.3 rad at 1.3 / rate."""

    def with_slope(rate):
        return jax.jvp(lambda r: _spun(r, TURNED, FORWARD).final_time, (rate,), (1.0,))

    trajectory = _spun(2.0, TURNED)
    assert trajectory.result == jr.RESULTS.event_occurred
    np.testing.assert_allclose(
        trajectory.final_state.attitude[0], np.cos(0.65), atol=1e-12
    )
    np.testing.assert_array_equal(
        np.isfinite(trajectory.states.omega[:, 0]), [True, False]
    )
    twice = quick_jit(lambda r: jax.jvp(with_slope, (r,), (1.0,)))
    (time, slope), (_, curvature) = twice(2.0)
    np.testing.assert_allclose([time, slope], [0.65, -1.3 / 4], rtol=1e-8)
    np.testing.assert_allclose(curvature, 2 * 1.3 / 8, rtol=1e-6)


@pytest.mark.parametrize("adjoint", [None, diffrax.DirectAdjoint()])
def test_derivatives_of_an_event_in_reverse_and_in_lanes(adjoint):
    event = diffrax.Event([_turned_by(1.3), _turned_by(9.0)])

    def when(rate):
        return _spun(rate, event, adjoint).final_time

    rates = jnp.array([2.0, 0.1, 1.0])  # the second turns by half a radian only
    times, slopes = quick_jit(jax.vmap(jax.value_and_grad(when)))(rates)
    np.testing.assert_allclose(times, [0.65, 5.0, 1.3], rtol=1e-8)
    np.testing.assert_allclose(slopes, [-1.3 / 4, 0.0, -1.3], rtol=1e-7, atol=1e-12)


def test_conditions_that_become_true_are_located_and_a_root_finder_is_used_if_given():
    exact = float(_spun(2.0, TURNED).final_time)
    assert float(_spun(2.0, BY_NEWTON).final_time) == pytest.approx(exact, abs=1e-9)
    truth = diffrax.Event(
        lambda _t, state, _args, **_: state.attitude[0] < np.cos(0.65)
    )
    found = _spun(2.0, truth)
    assert found.result == jr.RESULTS.event_occurred
    # To the accuracy of a step's dense output; a number is refined by Newton's method.
    assert float(found.final_time) == pytest.approx(exact, abs=1e-8)


def test_a_condition_is_given_what_it_asks_for():
    def plain(t, state, args):
        return t, state, args

    def named(t, state, args, terms):
        return terms

    def every(t, state, args, **options):
        return options

    known = {"terms": 5, "solver": 6}
    each = [
        condition_of_states(x, jnp.array(1.0), lambda y: 2 * y, known)
        for x in (plain, named, every)
    ]
    found = [condition(jnp.array(2.0), jnp.array(3.0), 4) for condition in each]
    assert found == [(3.0, 6.0, 4), 5, known]


def test_an_event_ends_the_motion_in_si_units():
    """A body turning at 2 rad/s about z has turned by 1.3 rad after 0.65 s."""
    trajectory = _spun(2.0, BY_NEWTON)
    assert trajectory.result == jr.RESULTS.event_occurred
    np.testing.assert_allclose(trajectory.final_time, 0.65, atol=1e-8)
    np.testing.assert_allclose(trajectory.final_state.omega, [0, 0, 2], atol=1e-9)
    reached = np.isfinite(trajectory.states.omega[:, 0])
    np.testing.assert_array_equal(reached, trajectory.ts <= 0.65)
    assert list(reached) == [True, False]


@pytest.mark.parametrize("solver", [None, jr.solvers.ExactFree()])
def test_a_condition_that_jumps_ends_the_motion_where_it_jumps(solver):
    """The yaw jumps from pi to -pi. By its slope there it would be zero at 0 or 2 pi."""

    def yaw(t, state, args, **_):
        x, y, _ = jr.rotation.rotate(state.attitude, jnp.array([1.0, 0.0, 0.0]))
        return jnp.arctan2(y, x)

    motion = jr.simulate(
        BODY,
        jr.State(UPRIGHT, np.array([0.0, 0.0, 1.0])),
        np.array([1.0, 3.0, 5.0]),
        event=diffrax.Event(yaw, direction=False),
        solver=solver,
    )
    np.testing.assert_allclose(motion.final_time, np.pi, atol=1e-7)
    reached = np.isfinite(motion.states.omega[:, 2])
    np.testing.assert_array_equal(reached, [True, True, False])


def test_a_condition_that_is_nan_at_the_start_has_not_changed_its_sign():
    event = diffrax.Event(lambda t, _state, _args, **_: jnp.sin(t) / t)
    motion = jr.simulate(BODY, jr.State(UPRIGHT, OMEGA), 10.0, event=event)
    np.testing.assert_allclose(motion.final_time, np.pi, atol=1e-9)


def test_outputs_at_the_time_of_an_event_have_its_state():
    event = diffrax.Event(lambda t, _state, _args, **_: t - 1.0)
    state0 = jr.State(UPRIGHT, np.array([0.0, 0.0, 1.0]))
    motion = jr.simulate(BODY, state0, np.array([0.5, 1.0, 1.0]), event=event)
    turned = [np.cos(0.5), 0.0, 0.0, np.sin(0.5)]
    np.testing.assert_allclose(motion.states.attitude[1:], [turned] * 2, atol=1e-12)

    # Rounding decides whether the event is before or after the first output time.
    @quick_jit
    @jax.vmap
    def run(time):
        level = jnp.cos(time / 4)
        event = diffrax.Event(lambda _t, state, args, **_: state.attitude[0] - args)
        times = jnp.stack([time / 2, time])
        return jr.simulate(BODY, state0, times, level, event=event, throw=False)

    times = jnp.linspace(0.3, 2.9, 200)
    found = run(times)
    np.testing.assert_allclose(found.final_time, times / 2, rtol=1e-10)
    reached = np.asarray(found.final_time >= times / 2)
    assert 0 < reached.sum() < 200
    first = np.asarray(found.states.omega[:, 0, 2])
    np.testing.assert_allclose(first[reached], 1.0, rtol=1e-12)
    assert np.isnan(first[~reached]).all()


@pytest.mark.parametrize("solver", [None, diffrax.Kvaerno5()], ids=["own", "diffrax"])
def test_an_invalid_lane_is_nan_where_an_event_may_end_it(solver):
    rates = jnp.array([1.0, jnp.nan])

    def run(rate):
        state0 = jr.State(UPRIGHT, rate * jnp.array([0.0, 0.0, 1.0]))
        return jr.simulate(
            BODY, state0, 5.0, event=TURNED, solver=solver, rtol=1e-6, throw=False
        )

    motion = quick_jit(jax.vmap(run))(rates)
    np.testing.assert_allclose(motion.final_time[0], 1.3, rtol=1e-5)
    assert np.all(np.isfinite(motion.final_state.omega[0]))
    for part in (motion.states, motion.final_state, motion.final_time):
        for x in jax.tree.leaves(part):
            assert np.all(np.isnan(x[1]))


# Runs that are too long
# ----------------------------------------------------------------------

SLOWING = jr.RigidBody(MOMENTS, jr.torques.LinearDrag(1.0))


def test_a_run_that_needs_more_than_the_default_steps_fails_before_its_first_one():
    rates = np.stack([OMEGA, 1e7 * OMEGA])
    motion = jax.vmap(
        lambda w: jr.simulate(BODY, jr.State(UPRIGHT, w), 50.0, throw=False)
    )(rates)
    assert [int(x) for x in motion.result._value] == [0, _pick("max_steps_reached")]
    assert int(motion.stats["num_steps"][1]) == 0
    assert np.all(np.isfinite(motion.states.omega[0]))
    assert np.all(np.isnan(motion.states.omega[1]))


def test_no_run_is_refused_that_would_succeed():
    """Few steps may do where an event ends the motion, or where splitting takes long ones."""
    state0 = jr.State(UPRIGHT, 2.0 * np.array([0, 0, 1.0]))
    ended = jr.simulate(BODY, state0, np.array([0.5, 1e9]), event=TURNED)
    np.testing.assert_allclose(ended.final_time, 0.65, atol=1e-8)
    weight = jr.torques.UniformGravity(
        1.0, np.array([0, 0, 1e-3]), np.array([0, 0, -1.0])
    )
    kicked = jr.simulate(
        jr.RigidBody(MOMENTS, weight),
        jr.State(UPRIGHT, 1e8 * OMEGA),
        10.0,
        solver=jr.solvers.Splitting(),
        max_step=1.0,
    )
    assert kicked.result == jr.RESULTS.successful


def test_steps_are_never_longer_than_the_fastest_rate_at_the_start_allows():
    """What foresees that steps will be too few: drag makes the rate fall, but no step longer."""
    rate = 100.0
    state0 = jr.State(UPRIGHT, np.array([0, 0, rate]))
    motion = jr.simulate(SLOWING, state0, 30.0)
    assert motion.final_state.omega[2] < 1e-3 * rate
    assert int(motion.stats["num_steps"]) > rate * 30.0 / _LARGEST_BOUNDS[0]


def test_an_implicit_solver_locates_an_event():
    event = diffrax.Event(_turned_by(1.3))
    state0 = jr.State(UPRIGHT, np.array([0.0, 0.0, 1.0]))
    trajectory = jr.simulate(
        BODY, state0, 5.0, event=event, solver=diffrax.Kvaerno5(), rtol=1e-6
    )
    assert trajectory.result == jr.RESULTS.event_occurred
    np.testing.assert_allclose(trajectory.final_time, 1.3, rtol=1e-5)


@pytest.mark.parametrize("solver", [None, diffrax.Kvaerno5()], ids=["own", "diffrax"])
def test_one_of_several_conditions_ends_a_motion_or_its_start(solver):
    """In lanes: within the span, at the start by a number, at the start by a boolean."""

    def late(_t, _state, args, **_):
        return args[1]

    event = diffrax.Event([lambda t, _state, args, **_: t - args[0], late])
    state0 = jr.State(UPRIGHT, np.array([0.0, 0.0, 1.0]))

    @quick_jit
    @jax.vmap
    def run(time, is_late):
        return jr.simulate(
            BODY,
            state0,
            np.array([0.0, 1.0, 5.0]),
            (time, is_late),
            event=event,
            solver=solver,
            rtol=1e-6,
        )

    times = jnp.array([1.3, 0.0, 4.0])
    found = run(times, jnp.array([False, False, True]))
    assert np.all(found.result == jr.RESULTS.event_occurred)
    np.testing.assert_allclose(found.final_time, [1.3, 0.0, 0.0], atol=1e-12)
    assert np.all(found.final_time >= 0)
    np.testing.assert_allclose(found.states.omega[:, 0], [state0.omega] * 3)
    reached = np.isfinite(found.states.omega[..., 2])
    np.testing.assert_array_equal(reached, [[1, 1, 0], [1, 0, 0], [1, 0, 0]])


# Stiffness
# -----------------------------------------------------------------------------------


def test_an_implicit_solver_steps_over_what_is_damped():
    """Drag of 1e6 a second, and a slow turn by a torque: 2.5 million explicit steps."""
    drag = jr.torques.LinearDrag(1e6)
    body = jr.RigidBody(np.ones(3), drag + jr.torques.Constant(np.array([0, 0, 5e5])))
    trajectory = jr.simulate(
        body,
        jr.State(UPRIGHT, OMEGA),
        4.0,
        rtol=1e-6,
        solver=diffrax.Kvaerno5(),
        max_steps=2000,
    )
    assert trajectory.stats["num_steps"] < 500
    np.testing.assert_allclose(trajectory.states.omega, [0, 0, 0.5], atol=1e-6)
    turned = jnp.array([np.cos(1.0), 0, 0, np.sin(1.0)])  # by 2 rad
    assert jr.rotation.angle_between(trajectory.states.attitude, turned) < 1e-5


# What is refused
# -----------------------------------------------------------------------------


def _fading_torque(t, state, end):
    """NaN from t = `end` on."""
    return -0.1 * state.omega * jnp.where(t > end, jnp.nan, 1.0)


FADING = jr.RigidBody(MOMENTS, _fading_torque)


def _faded(ends, throw=True):
    times = np.array([0.5, 2.0])
    return jax.vmap(lambda end: jr.simulate(FADING, STATE, times, end, throw=throw))(
        ends
    )


def _in_twenty_steps(omegas, times):
    def lane(omega, time):
        return jr.simulate(BODY, jr.State(UPRIGHT, omega), time, max_steps=20)

    return jax.vmap(lane)(omegas, times)


def _pick(code):
    return int(getattr(jr.RESULTS, code)._value)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: jr.simulate(BODY, jr.State(UPRIGHT, 1e-200 * OMEGA), 1e200),
            r"whose squares are in the range of their dtype .*not: 9\.89.*e-201\. \(Choose another",
        ),
        (
            lambda: jr.simulate(BODY, jr.State(UPRIGHT, 1e160 * OMEGA), 1e-160),
            r"whose squares are in the range .* not: 9\.89.*e\+159\. \(Choose another unit of time",
        ),
        (
            lambda: jr.simulate(BODY, STATE, np.array([1.0, 0.5])),
            r"`ts` must .* not: 0\.5\.$",
        ),
        (
            lambda: jr.simulate(BODY, STATE, np.array([1.0, 2.0]), t0=1.5),
            r"`t0`, .* not: 1\.0\.$",
        ),
        (
            lambda: _faded(jnp.array([10.0, 1.0])),
            r"became NaN or infinite .* after `final_time` \[s\]: (1\.0|0\.999)\d* in lane 1\.",
        ),
        (
            lambda: _in_twenty_steps(
                np.stack([OMEGA, np.nan * OMEGA]), np.array([0.1, 0.1])
            ),
            r"`state0` must be finite, but a component is not: \[.*nan\] in lane 1\.",
        ),
        (
            lambda: _in_twenty_steps(np.stack([OMEGA, OMEGA]), np.array([0.1, 100.0])),
            r"maximum number of solver steps .* fastest rate .* the radians requested: "
            r"\[ *0\.989\d* +98\.9\d*\] in lane 1\. \(.*`jrigid.free_rotation` of a free body",
        ),
    ],
)
def test_an_error_is_one_sentence_with_the_value_and_the_lane(call, message):
    with pytest.raises(RuntimeError, match=message) as error:
        call()
    assert len(str(error.value)) < 400


@pytest.mark.filterwarnings("ignore:simulate:UserWarning")
def test_times_that_their_dtype_cannot_tell_apart_are_an_error():
    """Unix time in float32: its numbers are 128 seconds apart."""
    single = lambda *x: [np.asarray(a, np.float32) for a in x]  # noqa: E731
    moments, attitude, omega, ts = single(
        MOMENTS, UPRIGHT, OMEGA, 1.7e9 + np.array([0.0, 10.0])
    )
    body, state0 = jr.RigidBody(moments), jr.State(attitude, omega)
    with pytest.raises(
        RuntimeError, match=r"1\.7e\+09.*\(Subtract the epoch.*jax_enable_x64"
    ):
        jr.simulate(body, state0, ts, t0=ts[0])
    trajectory = jr.simulate(body, state0, ts, t0=ts[0], throw=False)
    assert trajectory.result == jr.RESULTS.unresolved_times
    assert np.all(np.isnan(trajectory.states.omega))
    fine = jr.simulate(body, state0, ts.astype(np.float64), t0=float(ts[0]))
    assert fine.result == jr.RESULTS.successful


def test_rates_near_the_ends_of_the_range_are_integrated():
    for unit in (1e-140, 1e140):
        trajectory = jr.simulate(BODY, jr.State(UPRIGHT, unit * OMEGA), 3.0 / unit)
        exact = jr.free_rotation(MOMENTS, jr.State(UPRIGHT, OMEGA), 3.0).omega
        np.testing.assert_allclose(
            trajectory.states.omega / unit, exact, rtol=1e-8, atol=1e-8
        )


@pytest.fixture(scope="module")
def faded():
    return _faded(jnp.array([10.0, 1.0]), throw=False)


def test_a_torque_that_turns_nan_has_its_own_code_and_time(faded):
    assert [int(x) for x in faded.result._value] == [0, _pick("nonfinite_torque")]
    np.testing.assert_allclose(faded.final_time, [2.0, 1.0], rtol=1e-12)
    assert np.all(np.isfinite(faded.final_state.omega[0]))
    assert np.all(np.isnan(faded.final_state.omega[1]))


def test_a_torque_that_turns_nan_on_the_way_is_reported_at_once(faded):
    assert faded.stats["num_steps"][1] < 300
    assert np.all(np.isfinite(faded.states.omega[1, 0]))
    assert np.all(np.isnan(faded.states.omega[1, 1]))


def test_what_is_a_rigid_body_in_other_words_moves():
    top = jr.SymmetricTop(1.0, 0.5, 2.0)
    state0 = jr.State(ATTITUDE / np.linalg.norm(ATTITUDE), OMEGA)
    found = jr.simulate(top, state0, 2.0)
    exact = jr.top_motion(top, state0, 2.0)
    np.testing.assert_allclose(found.states.omega, exact.omega, atol=1e-8)
    assert isinstance(found.system, jr.RigidBody)


def test_a_trajectory_shows_its_numbers():
    shown = repr(jr.simulate(BODY, STATE, np.array([0.0, 1.0])))
    assert "ts=[0., 1.]" in shown
    assert "\n" not in shown
    assert len(shown) < 400
