"""The exact flow as a diffrax solver: alone, backward, differentiated, and as a stage."""

import dataclasses
from typing import ClassVar

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
def test_one_step_or_many_and_output_between_them_are_the_exact_motion(inertia, t0, t1, dt0):
    ts = np.linspace(t0, t1, 6)
    found, exact = by_steps_and_at_once(inertia, t0, t1, dt0, ts)
    np.testing.assert_allclose(found.attitude, exact.attitude, atol=2e-13)
    np.testing.assert_allclose(found.omega, exact.omega, atol=2e-13)


def test_dense_output():
    @quick_jit
    def both(t):
        solution = solve(MOMENTS, 0.0, 10.0, 10.0, diffrax.SaveAt(dense=True), throw=False)
        exact = jr.free_rotation(MOMENTS, STATE, t, throw=False)
        return solution.evaluate(t).attitude, exact.attitude

    np.testing.assert_allclose(*both(7.3), atol=1e-14)


def test_the_term_works_with_any_solver():
    controller = diffrax.PIDController(rtol=1e-11, atol=1e-12)
    found = solve(MOMENTS, 0.0, 10.0, 0.01, diffrax.SaveAt(t1=True), diffrax.Dopri8(),
                  stepsize_controller=controller).ys  # fmt: skip
    exact = jr.free_rotation(MOMENTS, STATE, 10.0)
    np.testing.assert_allclose(found.attitude[0], exact.attitude, atol=1e-9)


@pytest.fixture(scope="module")
def slope_at_once():
    def at_once(moments):
        return jr.free_rotation(moments, STATE, 20.0, throw=False).omega[1]

    return quick_jit(jax.grad(at_once))(MOMENTS)


@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_derivatives_are_those_of_the_flow(mode, slope_at_once):
    adjoint = diffrax.RecursiveCheckpointAdjoint() if mode == "reverse" else diffrax.ForwardMode()
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
    np.testing.assert_allclose(found.energy, np.full((2, 2), found.energy[0, 0]), rtol=1e-13)


def test_simulate_with_the_exact_solver_has_its_derivatives_and_lanes():
    def final(omega, solver, adjoint=None):
        state = jr.State(STATE.attitude, omega)
        body = jr.RigidBody(MOMENTS)
        return jr.simulate(body, state, 20.0, solver=solver, adjoint=adjoint, throw=False).states

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
        lambda _t, y, _args, **_: y.omega[0], optimistix.Newton(1e-12, 1e-12), direction=True
    )

    @quick_jit
    def until(state):
        body = jr.RigidBody(MOMENTS)
        end = jr.simulate(body, state, 30.0, solver=ExactFree(), event=event, throw=False)
        ts = jnp.linspace(0.0, 1.0, 200) * end.final_time
        return end.final_time, jr.free_rotation(MOMENTS, state, ts, throw=False).omega[:, 0]

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


class Strang(diffrax.AbstractSolver):
    """Half a kick by the torque, free motion, half a kick: symplectic, of order two."""

    torque: object
    term_structure: ClassVar = FreeRotation
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms):
        del terms
        return 2

    def init(self, terms, t0, t1, y0, args):
        return ExactFree().init(terms, t0, t1, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        def kick(t, y, h):
            change = jr.euler_equations(MOMENTS, y.omega, self.torque(t, y, args))
            free = jr.euler_equations(MOMENTS, y.omega)
            return dataclasses.replace(y, omega=y.omega + h * (change - free))

        half = 0.5 * (t1 - t0)
        y = kick(t0, y0, half)
        y, *_ = ExactFree().step(terms, t0, t1, y, args, solver_state, made_jump)
        y1 = kick(t1, y, half)
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)


def test_a_splitting_scheme_with_an_exact_stage_is_of_order_two_and_keeps_the_energy():
    torque = jr.torques.UniformGravity(1.0, np.array([0.1, 0.0, 0.4]), np.array([0.0, 0.0, -1.0]))
    body = jr.RigidBody(MOMENTS, torque)
    exact = quick_jit(lambda s: jr.simulate(body, s, 10.0, rtol=1e-12, throw=False).states)(STATE)

    @quick_jit
    def error(steps):
        h = 10.0 / steps
        found = solve(MOMENTS, 0.0, 10.0, h, diffrax.SaveAt(t1=True), Strang(torque),
                      max_steps=4096, throw=False).ys  # fmt: skip
        energy = body.energy(10.0, jax.tree.map(lambda x: x[0], found), None)
        return jnp.linalg.norm(found.omega[0] - exact.omega), energy - body.energy(0.0, STATE, None)

    coarse, fine = error(100.0), error(200.0)
    assert coarse[0] / fine[0] == pytest.approx(4.0, rel=0.05)
    assert coarse[1] / fine[1] == pytest.approx(4.0, rel=0.05)
    assert abs(fine[1]) < 3e-4
