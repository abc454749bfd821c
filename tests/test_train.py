"""train() against an independent simulator: a table learns an unmodelled drag."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import worlds
from helpers import ATTITUDE

import jrigid as jr
from jrigid import identify

RATES = np.linspace(0.0, 16.0, 7)
ADAM = optax.adam(2e-2)


class Table(jr.torques.AbstractTorque):
    """A drag -f(|w|) w in units of an inertia, linear between the rates of a table."""

    inertia: jax.Array
    table: jax.Array

    def __call__(self, t, state, args):  # noqa: ARG002
        speed = jnp.sqrt(jnp.sum(state.omega**2))
        return -self.inertia * jnp.interp(speed, RATES, self.table) * state.omega


class Scene:
    """Thirty trials of a phone in thick air, read by a gyro with a memory."""

    def __init__(self):
        seen = worlds.trials(
            np.random.default_rng(4),
            30,
            spin=(5.0, 15.0),
            duration=(0.4, 0.5),
            sigma=1e-3,
            drag=0.02,
            wobble=0.0,
            time_constant=0.004,
        )
        gyro, self.tensor = (
            identify.Gyro(time_constant=jnp.asarray(0.004)),
            seen[0].tensor,
        )
        self.trials = [identify.Record(gyro, x.ts, x.readings, x.sigma) for x in seen]
        mean = jnp.trace(jnp.asarray(self.tensor)) / 3
        self.body = jr.RigidBody(self.tensor, Table(mean, jnp.zeros(7)))

    def train(self, body=None, optimizer=ADAM, **options):
        given = {
            "key": jax.random.key(0),
            "free": lambda body: body.torque.table,
            "batch": 8,
        }
        body = body or self.body
        return identify.train(body, self.trials, optimizer, **given | options)


@pytest.fixture(scope="module")
def scene():
    return Scene()


@pytest.fixture(scope="module")
def learnt(scene):
    return scene.train(epochs=35)


def test_a_table_learns_quadratic_drag(scene, learnt):
    assert learnt.validation[0] > 100  # without a torque
    assert learnt.validation[learnt.epoch] == np.min(learnt.validation) < 1.2
    assert abs(learnt.training[-1] - 1) < 0.1
    table = learnt.system.torque.table
    # between 5 and 15 rad/s; a chord of a straight line is the line
    np.testing.assert_allclose(table[2:6], 0.02 * RATES[2:6], atol=0.01)
    assert learnt.system.inertia is scene.body.inertia
    assert learnt.system.torque.inertia is scene.body.torque.inertia  # not picked


def test_the_same_key_gives_the_same_bits(scene, learnt):
    again, other = scene.train(epochs=3), scene.train(epochs=3, key=jax.random.key(1))
    assert np.array_equal(again.validation, learnt.validation[:4])
    assert np.array_equal(again.training, learnt.training[:4])
    assert again.validation[0] == other.validation[0]
    assert again.validation[-1] != other.validation[-1]


def test_training_stops_when_validation_has_stopped_to_fall(scene, learnt, capsys):
    ended = scene.train(learnt.system, epochs=60, patience=3, progress=True)
    assert len(ended.validation) == len(ended.training) == ended.epoch + 4 < 60
    assert np.all(ended.validation[ended.epoch :] >= ended.validation[ended.epoch])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(ended.training)
    assert lines[0].startswith("epoch 0: training ")


def test_training_ends_where_the_parameters_are_not_finite(scene):
    """At the first step, or after steps of which the best is returned."""
    with pytest.raises(RuntimeError, match="pass a lower learning rate"):
        scene.train(optimizer=optax.sgd(1e300), epochs=20)
    rate = optax.piecewise_constant_schedule(2e-2, {6: 1e300})  # of two epochs
    ended = scene.train(optimizer=optax.adam(rate), epochs=20)
    assert ended.epoch == len(ended.validation) - 1 == 2
    assert np.all(np.isfinite(ended.validation))
    assert np.all(np.isfinite(ended.system.torque.table))


@pytest.mark.slow
def test_the_loss_of_the_truth_is_one(rng):
    """A gyro with a lag, attitudes at other times, trials of different lengths."""
    tensor, lag = worlds.random_body(rng), 0.004
    grid = np.arange(-400, 1001) / 1000
    start = rng.normal(size=(12, 3))
    start *= 8 / np.linalg.norm(start, axis=1, keepdims=True)
    drag = worlds.quadratic_drag(0.01)
    motion = worlds.tumble(tensor, start, grid, drag, attitude0=ATTITUDE)
    trials = []
    for i in range(12):
        ts, seen = np.arange(100)[: 100 - 7 * i] / 100, slice(405, 1405, 40)
        values = worlds.gyro((grid, motion.omega[i]), ts, rng, 0.01, time_constant=lag)
        turns = jax.vmap(jr.rotation.exp)(0.002 * rng.normal(size=(25, 3)))
        pictures = jax.vmap(jr.rotation.multiply)(motion.attitude[i, seen], turns)
        gyro = identify.Gyro(time_constant=lag)
        trials.append(
            (
                identify.Record(gyro, ts, values, 0.01),
                identify.Attitudes(grid[seen], pictures, 0.002),
            )
        )
    body = jr.RigidBody(tensor, jr.torques.QuadraticDrag(0.01))
    learnt = identify.train(
        body,
        trials,
        ADAM,
        key=jax.random.key(0),
        validation=range(11),
        segment=30,
        epochs=1,
    )
    # 4300 numbers: 1 +- 0.02
    assert abs(learnt.validation[0] - 1) < 0.08


def test_the_gradient_of_a_torque_far_from_the_true_one_is_that_of_the_loss(rng):
    """Without the drag a segment bends away from its samples; its state moves far."""
    moments = jnp.array([1.0, 1.7, 2.3])
    truth = jr.RigidBody(moments, jr.torques.LinearDrag(jnp.asarray(0.2)))
    ts = jnp.linspace(0.0, 10.0, 100)
    trials = []
    for _ in range(3):
        start = jr.State(ATTITUDE, jnp.asarray(rng.normal(size=3)))
        omega = np.asarray(jr.simulate(truth, start, ts).states.omega)
        omega = omega + 0.005 * rng.normal(size=omega.shape)
        trials.append(identify.Rates(ts, omega, 0.005))
    seen = []

    def update(slope, memory, params=None):
        leaves = jax.tree_util.tree_leaves(slope)
        jax.debug.callback(lambda x: seen.append(float(x)), *leaves)
        return jax.tree_util.tree_map(jnp.zeros_like, slope), memory

    still = optax.GradientTransformation(lambda _: (), update)

    def loss(drag):
        body = jr.RigidBody(moments, jr.torques.LinearDrag(jnp.asarray(drag)))
        options = {"key": jax.random.key(0), "epochs": 1, "batch": 4}
        result = identify.train(
            body,
            trials,
            still,
            free=lambda body: body.torque.coefficient,
            **options,
        )
        return float(result.training[0])

    loss(1e-3)
    jax.effects_barrier()
    slope = np.mean(seen)
    step = 1e-5
    expected = (loss(1e-3 + step) - loss(1e-3 - step)) / (2 * step)
    assert slope == pytest.approx(expected, rel=1e-3)
    assert abs(slope) > 100


def test_bad_arguments_are_named(scene, untyped):
    train, body = scene.train, scene.body
    key = jax.random.key(0)
    with pytest.raises(ValueError, match="`observations` must hold two trials or more"):
        identify.train(body, scene.trials[:1], ADAM, key=key)
    unsaid = [eqx.tree_at(lambda x: x.sigma, r, None) for r in scene.trials]
    with pytest.raises(ValueError, match="must state the noise"):
        identify.train(body, unsaid, ADAM, key=key)
    with pytest.raises(
        ValueError, match="`validation` must be indices of some of 30 trials"
    ):
        train(validation=[30])
    for wrong in (range(30), [False] * 29 + [True], [0.5]):
        with pytest.raises(ValueError, match=r"`validation` must be indices .* all"):
            train(validation=wrong)
    with pytest.raises(ValueError, match="`free` must pick floating point arrays"):
        train(free=lambda body: body)
    with pytest.raises(ValueError, match="`free` must pick floating point arrays"):
        identify.train(jr.RigidBody(scene.tensor), scene.trials, ADAM, key=key)
    with pytest.raises(ValueError, match="`segment` in each segment"):
        train(segment=1)
    with pytest.raises(ValueError, match="`batch` must be an integer"):
        train(batch=0)
    with pytest.raises(
        ValueError, match="`optimizer` must be a GradientTransformation"
    ):
        identify.train(body, scene.trials, "adam", key=key)
    with pytest.raises(ValueError, match="`key` must be a random key"):
        identify.train(body, scene.trials, ADAM, key=0)
    with pytest.raises(ValueError, match="`system` must be a RigidBody"):
        identify.train(scene.tensor, scene.trials, ADAM, key=key)
    upright = jr.torques.MagneticDipole(np.ones(3), np.ones(3))
    with pytest.raises(ValueError, match="must show the whole state"):
        identify.train(jr.RigidBody(scene.tensor, upright), scene.trials, ADAM, key=key)
    with pytest.raises(RuntimeError, match="`inertia` must"):
        train(jr.RigidBody(-scene.tensor, body.torque))
    gyro = identify.Gyro(limit=5.0)
    cut = [(x.ts, np.clip(x.values, -5, 5), x.sigma) for x in scene.trials]
    with pytest.raises(ValueError, match="must hold no saturated readings"):
        identify.train(body, [identify.Record(gyro, *x) for x in cut], ADAM, key=key)
    broken = eqx.tree_at(lambda x: x.torque.table, body, np.nan * body.torque.table)
    with pytest.raises(RuntimeError, match="must have a finite loss"):
        train(broken, epochs=1)
