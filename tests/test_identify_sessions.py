"""Trials in sessions, between which the gyro was taken off and put back."""

import jax
import numpy as np
import pytest
import worlds
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid import identify
from jrigid.identify import Status

TENSOR = np.array([[0.8, 0.05, -0.03], [0.05, 1.1, 0.04], [-0.03, 0.04, 1.4]])
BLIND = jr.RigidBody(np.ones(3))
TS = np.arange(100) * 0.02
NOISE = 0.02
SESSIONS = [-1, -1, -1, 0, 0, 0, 1, 1, 1]  # the first has the axes of the body


def by_session(_, gyro):
    return identify.each(gyro.misalignment, SESSIONS)


def trials(rng, turns):
    """Records of trials whose sensors are turned from the body by rotation vectors."""
    spins = 6.0 * rng.normal(size=(len(SESSIONS), 3))
    motion = worlds.tumble(TENSOR, spins, TS)
    values = motion.omega + NOISE * rng.normal(size=motion.omega.shape)
    records = []
    for session, rates in zip(SESSIONS, values, strict=True):
        turn = Rotation.from_rotvec(np.zeros(3) if session < 0 else turns[session])
        records.append(identify.Rates(TS, turn.inv().apply(rates), NOISE))
    return records


@pytest.fixture(scope="module")
def worlds_found():
    """Fits of several worlds, and the turns of their sessions."""
    rng = np.random.default_rng(3)
    turns = np.radians(2.4) * rng.normal(size=(8, 2, 3))
    found = identify.fit_each(BLIND, [trials(rng, x) for x in turns], free=by_session)
    return found, turns


def test_a_turn_for_each_session_is_found_with_its_error(worlds_found):
    found, turns = worlds_found
    assert np.all(np.asarray(found.status == Status.OK))
    for i, true in enumerate(turns):
        one = jax.tree.map(lambda x, i=i: x[i], found)
        value, error = one.estimates["gyro.misalignment"]
        assert value.shape == (2, 3)
        assert np.all(np.abs(np.asarray(value) - true) < 4.5 * np.asarray(error))
        assert one.determined == {"inertia": True, "gyro.misalignment": True}
        # Of each trial the sensor of its session.
        for trial in (0, 4, 8):
            gyro = one.fitted(trial)[1]
            of_trial = np.zeros((1, 3)) if trial == 0 else value[SESSIONS[trial]]
            np.testing.assert_allclose(
                gyro.misalignment, np.ravel(of_trial), atol=1e-12
            )


def test_errors_of_the_tensor_are_those_made(worlds_found):
    found, _ = worlds_found
    trace = np.trace(np.asarray(found.inertia), axis1=1, axis2=2)[:, None, None]
    off = np.asarray(found.inertia) * np.trace(TENSOR) / trace - TENSOR
    errors = np.sqrt(
        np.diagonal(np.asarray(found.inertia_covariance), axis1=1, axis2=2)
    )
    pulls = off.reshape(-1, 9) / (errors * np.trace(TENSOR) / trace[:, 0])
    assert 0.6 < np.sqrt(np.mean(pulls**2)) < 1.5
    assert np.all(np.abs(pulls) < 4.5)


def test_turned_sessions_that_are_taken_for_one_are_a_misfit(rng):
    turns = np.radians(2.4) * np.array([[1.0, -1.0, 0.5], [-0.7, 1.0, 1.0]])
    assert identify.fit(BLIND, trials(rng, turns), throw=False).status == Status.MISFIT


def test_names_tell_session_and_axis(worlds_found):
    names = jax.tree.map(lambda x: x[0], worlds_found[0]).names
    assert names[5:8] == tuple(f"gyro.misalignment[0][{i}]" for i in range(3))
    assert names[8] == "gyro.misalignment[1][0]"


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ([0, 1], "Argument `groups` of `each` must number the groups of 9 trials"),
        ([0] * 8 + [2], "Argument `groups` of `each` must number the groups"),
        ([-1] * 9, "Argument `groups` of `each` must number the groups"),
        ([0] * 8 + [-2], "Argument `groups` must be an integer and at least -1"),
    ],
)
def test_groups_that_are_none_are_an_error(groups, message, rng):
    with pytest.raises(ValueError, match=message):
        identify.fit(
            BLIND,
            trials(rng, np.zeros((2, 3))),
            free=lambda _, gyro: identify.each(gyro.misalignment, groups),
        )
