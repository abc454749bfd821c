"""A fixed number of equal steps against diffrax's,
and its derivatives in every mode."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jrigid._stepping.method import method_of
from jrigid._stepping.step import equal_steps

SOLVERS = {"Tsit5": diffrax.Tsit5(), "Dopri8": diffrax.Dopri8(), "Heun": diffrax.Heun()}
START = jnp.array([0.4, 1.1])
STIFFNESS = jnp.asarray(1.7)
T0, STEP, COUNT = jnp.asarray(0.3), jnp.asarray(0.2), 3


def pendulum(stiffness, t, y):
    """A pendulum whose pivot moves up and down."""
    return jnp.stack([y[1], -stiffness * (1 + 0.2 * jnp.cos(t)) * jnp.sin(y[0])])


def moved(solver, stiffness, y, step=STEP, count=COUNT):
    def field(t, y):
        return pendulum(stiffness, t, y)

    return equal_steps(method_of(solver), field, T0, step, y, count)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("count", [1, COUNT])
def test_the_state_is_that_of_diffrax(name, count):
    solver = SOLVERS[name]
    term = diffrax.ODETerm(lambda t, y, _: pendulum(STIFFNESS, t, y))
    ts = T0 + STEP * jnp.arange(count + 1.0)
    control = diffrax.StepTo(ts)
    expected = diffrax.diffeqsolve(
        term, solver, ts[0], ts[-1], None, START, stepsize_controller=control
    ).ys[0]
    found = moved(solver, STIFFNESS, START, count=count)
    np.testing.assert_allclose(found, expected, rtol=1e-14)


def test_steps_back_lead_to_the_start():
    solver = SOLVERS["Dopri8"]
    there = moved(solver, STIFFNESS, START, count=1)
    back = equal_steps(
        method_of(solver),
        lambda t, y: pendulum(STIFFNESS, t, y),
        T0 + STEP,
        -STEP,
        there,
    )
    # Twice the local error of a method of order 8.
    np.testing.assert_allclose(back, START, atol=2 * float(STEP) ** 9)


@pytest.mark.parametrize("count", [1, COUNT])
def test_derivatives_of_every_mode_and_order_agree(count):
    def end(x):
        return moved(SOLVERS["Tsit5"], x[0], x[1:], count=count)

    x = jnp.concatenate([STIFFNESS[None], START])
    slopes = jax.jit(jax.jacfwd(end))(x)
    np.testing.assert_allclose(
        jax.jit(jax.jacrev(end))(x), slopes, rtol=1e-12, atol=1e-14
    )
    nudge = jnp.finfo(x.dtype).eps ** (1 / 3)
    rows = [(end(x + nudge * e) - end(x - nudge * e)) / (2 * nudge) for e in jnp.eye(3)]
    np.testing.assert_allclose(jnp.stack(rows, axis=1), slopes, atol=1e-9)
    second = jax.jit(jax.jacfwd(jax.jacfwd(end)))(x)
    for outer, inner in ((jax.jacfwd, jax.jacrev), (jax.jacrev, jax.jacfwd)):
        # The reverse of a forward derivative is what a loss with a Jacobian needs.
        np.testing.assert_allclose(
            jax.jit(outer(inner(end)))(x), second, rtol=1e-11, atol=1e-13
        )
