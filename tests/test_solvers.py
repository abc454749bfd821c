"""The diffrax solvers: the exact flow, alone and as a stage, splitting,
methods of high order."""

import warnings
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from helpers import ATTITUDE, MOMENTS, OMEGA, TENSOR, quick_jit

import jrigid as jr
from jrigid.solvers import ExactFree, FreeRotation

STATE = jr.State(ATTITUDE / np.linalg.norm(ATTITUDE), OMEGA)


def solve(inertia, t0, t1, dt0, saveat, solver=None, **options):
    solver = ExactFree() if solver is None else solver
    return diffrax.diffeqsolve(
        FreeRotation(inertia), solver, t0, t1, dt0, STATE, saveat=saveat, **options
    )


@quick_jit
def by_steps_and_at_once(inertia, t0, t1, dt0, ts):
    found = solve(inertia, t0, t1, dt0, diffrax.SaveAt(ts=ts), throw=False).ys
    return found, jr.free_rotation(inertia, STATE, ts, t0=t0, throw=False)


@pytest.mark.parametrize("inertia", [MOMENTS, TENSOR], ids=["moments", "tensor"])
@pytest.mark.parametrize(
    ("t0", "t1", "dt0"), [(0.5, 40.0, 39.5), (0.5, 40.0, 3.1), (1.0, -9.0, -2.0)]
)
def test_one_step_or_many_and_output_between_them_are_the_exact_motion(
    inertia, t0, t1, dt0
):
    ts = np.linspace(t0, t1, 6)
    found, exact = by_steps_and_at_once(inertia, t0, t1, dt0, ts)
    np.testing.assert_allclose(found.attitude, exact.attitude, atol=2e-13)
    np.testing.assert_allclose(found.omega, exact.omega, atol=2e-13)


def test_dense_output():
    @quick_jit
    def both(t):
        solution = solve(
            MOMENTS, 0.0, 10.0, 10.0, diffrax.SaveAt(dense=True), throw=False
        )
        exact = jr.free_rotation(MOMENTS, STATE, t, throw=False)
        return solution.evaluate(t).attitude, exact.attitude

    np.testing.assert_allclose(*both(7.3), atol=1e-14)


def test_the_term_works_with_any_solver():
    controller = diffrax.PIDController(rtol=1e-11, atol=1e-12)
    found = solve(
        MOMENTS,
        0.0,
        10.0,
        0.01,
        diffrax.SaveAt(t1=True),
        diffrax.Dopri8(),
        stepsize_controller=controller,
    ).ys
    exact = jr.free_rotation(MOMENTS, STATE, 10.0)
    np.testing.assert_allclose(found.attitude[0], exact.attitude, atol=1e-9)


@pytest.fixture(scope="module")
def slope_at_once():
    def at_once(moments):
        return jr.free_rotation(moments, STATE, 20.0, throw=False).omega[1]

    return quick_jit(jax.grad(at_once))(MOMENTS)


@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_derivatives_are_those_of_the_flow(mode, slope_at_once):
    adjoint = (
        diffrax.RecursiveCheckpointAdjoint()
        if mode == "reverse"
        else diffrax.ForwardMode()
    )
    derivative = jax.grad if mode == "reverse" else jax.jacfwd

    def by_steps(moments):
        saveat = diffrax.SaveAt(t1=True)
        found = solve(moments, 0.0, 20.0, 6.0, saveat, adjoint=adjoint, throw=False)
        return found.ys.omega[0, 1]

    slope = quick_jit(derivative(by_steps))(MOMENTS)
    np.testing.assert_allclose(slope, slope_at_once, rtol=1e-11)


@pytest.mark.parametrize("inertia", [MOMENTS, TENSOR], ids=["moments", "tensor"])
def test_simulate_with_the_exact_solver_is_the_closed_form_in_one_step(inertia):
    body, ts = jr.RigidBody(inertia), np.array([[1.0, 2.0], [500.0, 9e6]])

    @quick_jit
    def both(body, ts):
        found = jr.simulate(body, STATE, ts, t0=-1.5, solver=ExactFree(), throw=False)
        return found, jr.free_rotation(inertia, STATE, ts, t0=-1.5, throw=False)

    found, exact = both(body, ts)
    assert found.stats["num_steps"] == 1
    np.testing.assert_allclose(found.states.omega[0], exact.omega[0], atol=1e-14)
    np.testing.assert_allclose(found.states.attitude, exact.attitude, atol=1e-8)
    np.testing.assert_allclose(
        found.energy, np.full((2, 2), found.energy[0, 0]), rtol=1e-13
    )


def test_simulate_with_the_exact_solver_has_its_derivatives_and_lanes():
    def final(omega, solver, adjoint=None):
        state = jr.State(STATE.attitude, omega)
        body = jr.RigidBody(MOMENTS)
        return jr.simulate(
            body, state, 20.0, solver=solver, adjoint=adjoint, throw=False
        ).states

    @quick_jit
    @jax.vmap
    def lane(omega):
        """The end and its derivative, by columns."""

        def of(omega):
            return (final(omega, ExactFree(), diffrax.ForwardMode()).omega,) * 2

        forward, end = jax.jacfwd(of, has_aux=True)(omega)
        return end, forward

    def at_once(omega):
        state = jr.State(STATE.attitude, omega)
        return jr.free_rotation(MOMENTS, state, 20.0, throw=False).omega

    ends, forward = lane(np.stack([OMEGA, OMEGA * np.nan]))
    reverse = quick_jit(jax.jacrev(lambda w: final(w, ExactFree()).omega))(OMEGA)
    exact = quick_jit(jax.jacfwd(at_once))(OMEGA)
    for found in (forward[0], reverse):
        np.testing.assert_allclose(found, exact, rtol=1e-12, atol=1e-12)
    assert np.all(np.isfinite(ends[0]))
    assert np.all(np.isnan(ends[1]))


@pytest.mark.slow
def test_simulate_with_the_exact_solver_has_events():
    event = diffrax.Event(
        lambda _t, y, _args, **_: y.omega[0],
        optimistix.Newton(1e-12, 1e-12),
        direction=True,
    )

    @quick_jit
    def until(state):
        body = jr.RigidBody(MOMENTS)
        end = jr.simulate(
            body, state, 30.0, solver=ExactFree(), event=event, throw=False
        )
        ts = jnp.linspace(0.0, 1.0, 200) * end.final_time
        return end.final_time, jr.free_rotation(MOMENTS, state, ts, throw=False).omega[
            :, 0
        ]

    stop, first = map(np.asarray, until(STATE))
    assert 0 < stop < 30
    assert abs(first[-1]) < 1e-8
    rises = (first[:-1] < 0) & (first[1:] > 0)
    assert first[-2] < 0
    assert not rises[:-1].any()


def test_the_exact_solver_is_for_free_bodies(untyped):
    heavy = jr.RigidBody(MOMENTS, jr.torques.Constant(np.ones(3)))
    with pytest.raises(ValueError, match="RigidBody without a torque"):
        jr.simulate(heavy, STATE, 1.0, solver=ExactFree())
    with pytest.raises(ValueError, match=r"or ExactFree\(\)"):
        jr.simulate(jr.RigidBody(MOMENTS), STATE, 1.0, solver=diffrax.Euler())


# Verner's method
# ----------------------------------------------------------------------------


def test_verners_weights_integrate_polynomials_of_their_degrees():
    """The conditions of quadrature of the method,
    of its estimate and of its dense output."""
    tableau = jr.solvers.Verner9.tableau
    assert tableau.fsal
    c = np.concatenate([[0.0], tableau.c])
    for weights, degree in ((tableau.b_sol, 8), (tableau.b_sol - tableau.b_error, 7)):
        for k in range(degree + 1):
            assert np.sum(weights * c**k) == pytest.approx(1 / (k + 1), abs=1e-15)
    assert abs(np.sum(tableau.b_error * c**8)) > 1e-6
    for theta in (0.0, 0.3, 0.71, 1.0):
        for k in range(6):
            dense = jr.solvers.Verner9.interpolation_cls(
                t0=0.0, t1=1.0, y0=jnp.zeros(()), y1=None, k=jnp.asarray(c**k)
            )
            end = theta ** (k + 1) / (k + 1)
            assert float(dense.evaluate(theta)) == pytest.approx(end, abs=1e-15)


def test_verners_dense_output_has_the_order_it_claims():
    """A local error of order 7: 2.0**7 by halving the step, on the free body."""

    @quick_jit
    def error(h):
        found = solve(
            MOMENTS, 0.0, h, h, diffrax.SaveAt(ts=0.37 * h[None]), jr.solvers.Verner9()
        )
        exact = jr.free_rotation(MOMENTS, STATE, 0.37 * h, throw=False)
        return jnp.linalg.norm(found.ys.omega[0] - exact.omega)

    assert np.log2(error(0.2) / error(0.1)) > 6.8


def test_verners_dense_output_of_a_lane_that_is_through_keeps_its_gradient():
    """A loop of fixed length goes on with steps of no length, whose slope is masked,
    not NaN."""

    def middle(a):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(lambda _, y, a: jnp.cos(a * y)),
            jr.solvers.Verner9(),
            0.0,
            1.0,
            0.1,
            jnp.ones(()),
            a,
            saveat=diffrax.SaveAt(ts=jnp.array([0.3, 1.0])),
            max_steps=32,
            stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8),
            throw=False,
            adjoint=diffrax.DirectAdjoint(),
        ).ys[0]

    rates = jnp.array([1.0, 10.0])
    alone = [quick_jit(jax.grad(middle))(a) for a in rates]
    np.testing.assert_allclose(
        quick_jit(jax.vmap(jax.grad(middle)))(rates), alone, rtol=1e-7
    )


# Splitting
# ----------------------------------------------------------------------------------

WEIGHT = jr.torques.UniformGravity(
    1.0, np.array([0.3, 0.1, 0.5]), np.array([0.0, 0.0, -1.0])
)
TOP = jr.RigidBody(MOMENTS, WEIGHT)


def split(body, ts, order, step, state=STATE, **options):
    solver = jr.solvers.Splitting(order)
    return jr.simulate(
        body, state, ts, solver=solver, max_step=step, throw=False, **options
    )


@pytest.mark.parametrize("order", [2, 4, 6])
@pytest.mark.parametrize("inertia", [MOMENTS, TENSOR], ids=["moments", "tensor"])
def test_splitting_is_of_its_order_and_keeps_what_is_to_be_kept(order, inertia):
    body = jr.RigidBody(inertia, WEIGHT)
    exact = jr.simulate(body, STATE, 8.0, rtol=1e-13).final_state

    @quick_jit
    def found(step):
        motion = split(body, jnp.array([0.0, 8.0]), order, step)
        return (
            motion.final_state,
            motion.energy,
            motion.angular_momentum,
            motion.stats["num_steps"],
        )

    errors = []
    for steps in (40, 80):
        state, energy, momentum, taken = found(8.0 / steps)
        assert int(taken) == steps
        assert abs(np.linalg.norm(state.attitude) - 1) < 1e-15
        # About the vertical; each of the hundreds of exact turns adds a rounding of its
        # own.
        assert abs(momentum[1, 2] - momentum[0, 2]) < 2e-14
        errors.append(
            [np.linalg.norm(state.omega - exact.omega), abs(energy[1] - energy[0])]
        )
    state_order, energy_order = np.log2(np.array(errors[0]) / errors[1])
    assert state_order == pytest.approx(order, abs=0.4)
    assert energy_order > order - 0.6


def test_splitting_is_its_own_inverse_and_its_dense_output_a_shorter_step():
    solver, body = jr.solvers.Splitting(4), TOP

    @quick_jit
    def there_and_back(state):
        def run(state, t0, t1, dt0, ts):
            found = diffrax.diffeqsolve(
                solver.terms(body),
                solver,
                t0,
                t1,
                dt0,
                state,
                saveat=diffrax.SaveAt(ts=ts),
                stepsize_controller=diffrax.ConstantStepSize(),
                max_steps=64,
                throw=False,
            )
            return found.ys

        there = run(state, 0.0, 4.0, 0.125, jnp.array([0.0625, 4.0]))
        between, end = (jax.tree.map(lambda x, i=i: x[i], there) for i in (0, 1))
        back = run(end, 4.0, 0.0, -0.125, jnp.array([0.0]))
        once = run(state, 0.0, 0.0625, 0.0625, jnp.array([0.0625]))
        return back, between, once

    back, between, once = there_and_back(STATE)
    np.testing.assert_allclose(back.omega[0], STATE.omega, atol=1e-13)
    np.testing.assert_allclose(back.attitude[0], STATE.attitude, atol=1e-13)
    np.testing.assert_allclose(between.omega, once.omega[0], atol=1e-15)


def test_splitting_follows_a_potential_that_moves():
    def pushed(t, state, args):
        return args * (1 + jnp.sin(t)) * WEIGHT(t, state, None)

    body, force = jr.RigidBody(MOMENTS, pushed), jnp.asarray(1.3)
    exact = jr.simulate(body, STATE, 5.0, force, t0=1.0, rtol=1e-12).final_state
    solver = jr.solvers.Splitting(6)
    found = jr.simulate(
        body, STATE, 5.0, force, t0=1.0, solver=solver, max_step=0.05
    ).final_state
    np.testing.assert_allclose(found.omega, exact.omega, atol=1e-8)


@pytest.mark.slow
def test_the_rounding_of_splitting_does_not_drift():
    """10^6 steps of nine free motions: eps times the root of their number,
    not their number."""

    @quick_jit
    def energies(state):
        return split(TOP, jnp.linspace(0.0, 2e4, 101), 6, 0.02, state).energy

    energy = np.asarray(energies(jr.State(jnp.eye(4)[0], jnp.array([0.1, 1.0, 0.3]))))
    walk = np.finfo(float).eps * np.sqrt(9e6)
    assert np.max(np.abs(energy / energy[0] - 1)) < 3 * walk


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_steps_of_splitting_are_as_many_as_asked_for_and_equal(dtype):
    state = jax.tree.map(lambda x: jnp.asarray(x, dtype), STATE)
    gravity = jr.torques.UniformGravity(
        *map(dtype, (1.0, np.array([0.3, 0.1, 0.5]))), np.array([0, 0, -1], dtype)
    )
    body = jr.RigidBody(
        jnp.asarray(1e20 * MOMENTS, dtype), gravity
    )  # L^2 is beyond float32

    @quick_jit
    def motion(ts, step):
        found = split(body, ts, 2, step, state)
        return found.stats["num_steps"], found.states.omega

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for ts, step, count in (
            (np.linspace(0, 100, 1001), 0.1, 1000),
            ([10.0], 0.01, 1000),
        ):
            taken, omega = motion(jnp.asarray(ts, dtype), jnp.asarray(step, dtype))
            assert int(taken) == count
            assert np.all(np.isfinite(omega))


@pytest.mark.parametrize(
    "mode",
    ["reverse", "forward", pytest.param("direct", marks=pytest.mark.slow)],
)
def test_derivatives_of_splitting_are_those_of_the_motion(mode):
    adjoint = {"forward": diffrax.ForwardMode(), "direct": diffrax.DirectAdjoint()}.get(
        mode
    )
    derivative = jax.jacfwd if mode == "forward" else jax.grad

    def end(moments, **options):
        return jr.simulate(
            jr.RigidBody(moments, WEIGHT),
            STATE,
            3.0,
            throw=False,
            adjoint=adjoint,
            **options,
        ).final_state.omega[0]

    exact = quick_jit(derivative(end))(MOMENTS)
    options = {"solver": jr.solvers.Splitting(6), "max_step": 0.05}
    found = quick_jit(derivative(lambda moments: end(moments, **options)))(MOMENTS)
    np.testing.assert_allclose(found, exact, atol=1e-6)


def test_splitting_has_events_and_lanes():
    def level(t, state, args, **_):
        return jr.rotation.rotate(state.attitude, jnp.array([0.0, 0.0, 1.0]))[2]

    event = diffrax.Event(level)
    exact = jr.simulate(TOP, STATE, 30.0, event=event)

    @quick_jit
    @jax.vmap
    def ends(omega):
        motion = split(TOP, 30.0, 6, 0.05, jr.State(STATE.attitude, omega), event=event)
        return motion.final_time, motion.result == jr.RESULTS.event_occurred

    times, happened = ends(jnp.stack([STATE.omega, STATE.omega * jnp.nan]))
    assert float(times[0]) == pytest.approx(float(exact.final_time), abs=1e-7)
    np.testing.assert_array_equal(happened, [True, False])


def test_derivatives_of_splitting_are_those_of_its_own_steps():
    """Of `max_step`, whatever a derivative needs of a Runge-Kutta method."""

    def end(omega):
        state0 = jr.State(STATE.attitude, omega)
        motion = split(TOP, 3.0, 2, 0.35, state0)
        return motion.final_state.omega[0], motion.stats["num_steps"]

    value, steps = end(STATE.omega)
    (same, again), _ = jax.value_and_grad(end, has_aux=True)(STATE.omega)
    assert int(steps) == int(again) == 9
    np.testing.assert_allclose(same, value, rtol=1e-14)


@pytest.mark.slow  # without an event it is tested above
def test_reverse_mode_of_splitting_reverses_the_steps_to_an_event():
    """They divide the time to the next output, and not the time to the event."""
    event = diffrax.Event(lambda t, _state, _args, **_: t - 3.17)

    def end(omega, adjoint):
        motion = jr.simulate(
            TOP,
            jr.State(STATE.attitude, omega),
            10.0,
            solver=jr.solvers.Splitting(2),
            max_step=0.35,
            event=event,
            adjoint=adjoint,
        )
        return motion.final_state.omega[0]

    slopes = [
        quick_jit(jax.grad(partial(end, adjoint=adjoint)))(STATE.omega)
        for adjoint in (None, diffrax.DirectAdjoint())
    ]
    np.testing.assert_allclose(*slopes, rtol=1e-9)


def test_splitting_takes_a_compiled_torque_and_one_with_branches():
    """Whose programs take the whole state, of which they look at the attitude alone."""

    @jax.jit
    def weight(t, state, args):
        push = lambda state: WEIGHT(t, state, args)  # noqa: E731
        return jax.lax.cond(
            state.attitude[0] > 2, lambda state: 0 * push(state), push, state
        )

    ends = [
        split(jr.RigidBody(MOMENTS, x), 1.0, 2, 0.1).final_state
        for x in (weight, WEIGHT)
    ]
    np.testing.assert_allclose(ends[0].omega, ends[1].omega, atol=1e-14)


@pytest.mark.usefixtures("untyped")
def test_splitting_says_what_it_is_for():
    with pytest.raises(ValueError, match="`order` must be 2, 4 or 6, but it is 3"):
        jr.solvers.Splitting(3)
    solver = jr.solvers.Splitting()
    with pytest.raises(ValueError, match="its step given as `max_step`"):
        jr.simulate(TOP, STATE, 1.0, solver=solver)
    dragged = jr.RigidBody(MOMENTS, jr.torques.LinearDrag(0.1))
    with pytest.raises(
        ValueError, match="where the torque depends on the angular velocity"
    ):
        jr.simulate(dragged, STATE, 1.0, solver=solver, max_step=0.1)
    damped = jr.RigidBody(MOMENTS, jr.torques.InternalDamper(0.1, 0.1))
    with pytest.raises(ValueError, match="moving parts"):
        jr.simulate(damped, STATE, 1.0, solver=solver, max_step=0.1)
