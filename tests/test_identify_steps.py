"""Fits under torques that change faster than the body turns.

A fit passes each segment of a record in a few equal steps. The records are made by
scipy, with Euler's equations written out here.
"""

# ruff: noqa: ARG002

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid import identify
from jrigid.identify import Status
from jrigid.identify._flow import forced_flow

MOMENTS = np.array([0.0065, 0.010, 0.013])
GUESS = np.full(3, 0.01)


def motion(ts, omega, torque):
    """Attitudes, scalar first, and rates; the torque is of t, the attitude, the rates.

    Args:
        ts: Times.
        omega: Rates at the first of them, where the body axes are those of space.
        torque: In body axes.
    """

    def rates(t, y):
        attitude = Rotation.from_quat(y[:4], scalar_first=True)
        spin = Rotation.from_quat([0.0, *y[4:]], scalar_first=True)
        product = (attitude * spin).as_quat(canonical=False, scalar_first=True)
        # The product of unit quaternions has lost the size of the rates.
        turning = 0.5 * np.linalg.norm(y[:4]) * np.linalg.norm(y[4:]) * product
        moment = torque(t, attitude, y[4:])
        return np.append(turning, (np.cross(MOMENTS * y[4:], y[4:]) + moment) / MOMENTS)

    start = np.concatenate([[1.0, 0, 0, 0], omega])
    span = ts[[0, -1]]
    found = solve_ivp(rates, span, start, "DOP853", ts, rtol=1e-10, atol=1e-12).y.T
    return found[:, :4] / np.linalg.norm(found[:, :4], axis=1)[:, None], found[:, 4:]


def judged(found):
    """Errors of the moments, in units of what is stated."""
    return (found.moments - MOMENTS) / found.moments_errors


def test_a_wheel_that_turns_faster_than_the_body(rng):
    """A segment of 0.75 radians would hold two periods of the wheel's momentum."""
    ts = np.arange(250.0)
    rate = 2 * np.pi / 30
    size = 2e-4

    def wheel(t):
        return size * np.stack([np.sin(rate * t), 0.7 * np.cos(rate * t), 0 * t], -1)

    def torque(t, _, omega):
        slope = size * rate * np.array([np.cos(rate * t), -0.7 * np.sin(rate * t), 0])
        return np.cross(wheel(t), omega) - slope

    noise = 2e-5
    _, rates = motion(ts, np.array([0.01, -0.012, 0.008]), torque)
    record = identify.Rates(ts, rates + noise * rng.normal(size=rates.shape), noise)
    telemetry = np.arange(-5, 256, 0.25)
    sampled = jr.torques.Sampled(telemetry, wheel(telemetry))
    body = jr.RigidBody(GUESS, jr.torques.Rotor(sampled))
    found = identify.fit(body, record, scale="rotor")
    assert found.status == Status.OK
    assert found.diagnostics.integration_error < 1
    assert np.max(np.abs(judged(found))) < 4
    assert np.max(found.moments_errors / found.moments) < 1e-3


def test_a_pendulum_that_swings_many_times_in_a_small_angle(rng):
    """Its segments of 0.75 radians would be longer than a period."""
    lever = np.array([0.0, 0.0, -0.02])
    weight = np.array([0.0, 0.0, -9.8])

    def torque(_, attitude, omega):
        del omega
        return np.cross(lever, attitude.inv().apply(weight))

    ts = np.arange(120) * 0.05
    attitudes, rates = motion(ts, np.array([0.15, 0.1, 0.3]), torque)
    noise = 1e-3
    turns = Rotation.from_rotvec(noise * rng.normal(size=rates.shape))
    seen = Rotation.from_quat(attitudes, scalar_first=True) * turns
    record = (
        identify.Rates(ts, rates + noise * rng.normal(size=rates.shape), noise),
        identify.Attitudes(ts, seen.as_quat(scalar_first=True), noise),
    )
    gravity = jr.torques.UniformGravity(1.0, lever, weight)
    found = identify.fit(jr.RigidBody(GUESS, gravity), record, scale="known")
    assert found.status == Status.OK
    assert found.diagnostics.integration_error < 1
    assert np.max(np.abs(judged(found))) < 4
    assert 0.8 < found.reduced_chi_square < 1.2


def test_a_torque_too_fast_for_any_steps_is_told(rng):
    """A shaker at 200 Hz, of a body that is read once a second."""

    steady = np.array([1e-5, 0.0, 0.0])

    def torque(t, state, args):
        del state, args
        shaken = jnp.array([0.0, 0.0, 1e-4]) * jnp.sin(404 * jnp.pi * t)
        return jnp.asarray(steady) + shaken

    ts = np.arange(64.0)
    # The shaker is too fast to move the body.
    _, rates = motion(ts, np.array([0.1, -0.12, 0.08]), lambda *_: steady)
    record = identify.Rates(ts, rates + 1e-4 * rng.normal(size=rates.shape), 1e-4)
    found = identify.fit(
        jr.RigidBody(GUESS, torque), record, scale="known", throw=False
    )
    assert found.status == Status.NOT_CONVERGED
    assert "changes too fast" in str(found).splitlines()[0]


class _Pulse(jr.torques.AbstractTorque):
    """A constant torque between two times, which it declares."""

    torque: jax.Array
    start: float
    end: float

    def __call__(self, t, state, args):
        return jnp.where((t > self.start) & (t < self.end), self.torque, 0.0)

    @property
    def jumps(self):
        return jnp.array([self.start, self.end])


@pytest.mark.parametrize(
    ("start", "end"),
    [(1.0, 3.0), (3.0, 1.0), (1.5, 2.5), (2.0, 3.0), (2.0, 2.0), (0.0, 1.0)],
)
def test_the_flow_of_a_fit_is_exact_across_declared_jumps(start, end):
    body = jr.RigidBody(
        jnp.array([1.0, 1.5, 2.0]), _Pulse(jnp.array([0.2, -0.1, 0.3]), 2.0, 2.25)
    )
    state = jr.State(jnp.array([1.0, 0, 0, 0]), jnp.array([0.1, 0.05, -0.2]))
    found = forced_flow(
        body, state, jnp.asarray(start), jnp.asarray(end), False, jumps=2
    )
    if end >= start:
        expected = jr.simulate(body, state, end, t0=start, rtol=1e-12).final_state
    else:
        # Back in time: the reference brings the result to where it came from.
        found, expected = (
            jr.simulate(body, found, start, t0=end, rtol=1e-12).final_state,
            state,
        )
    np.testing.assert_allclose(found.omega, expected.omega, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("start", "end"), [(20.0, 25.0), (20.13, 24.9)])
def test_a_fit_follows_a_torque_that_is_switched(rng, start, end):
    """At samples, and between them."""
    ts = np.linspace(0, 60, 241)
    torque = _Pulse(jnp.array([0.02, -0.01, 0.03]), start, end)
    moments = np.array([1.0, 1.5, 2.0])
    state = jr.State(jnp.array([1.0, 0, 0, 0]), jnp.array([0.1, 0.05, -0.2]))
    truth = jr.simulate(jr.RigidBody(jnp.array(moments), torque), state, ts)
    seen = truth.states.omega + 1e-3 * rng.normal(size=(ts.size, 3))
    found = identify.fit(
        jr.RigidBody(np.full(3, 1.5), torque),
        identify.Rates(ts, np.asarray(seen), 1e-3),
        scale="known",
    )
    assert found.status == Status.OK, str(found)
    assert float(found.diagnostics.integration_error) < 1
    off = np.sort(found.moments) - moments
    assert np.all(np.abs(off) < 4 * found.moments_errors), str(found)
