"""Many motions at once: the quick road equals the plain one, whatever is around a lane."""

import diffrax
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import in_a_process, quick_jit

import jrigid as jr
from jrigid._core.lanes_last import lanes_last
from jrigid._stepping import replay
from jrigid._stepping.method import method_of
from jrigid._stepping.step import combine, error_of, pull_back, stages

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
GRAVITY = jr.torques.UniformGravity(
    1.0, np.array([0.3, 0.1, 0.5]), np.array([0.0, 0.0, -1.0])
)
TOP = jr.RigidBody(np.array([1.0, 2.0, 3.0]), GRAVITY)
TIMES = np.array([0.0, 1.0, 1.0, 3.0])


def _motion(body, omega, ts=TIMES, **options):
    return jr.simulate(body, jr.State(UPRIGHT, omega), ts, throw=False, **options)


def _states(body, omega, ts=TIMES):
    trajectory = _motion(body, omega, ts)
    return trajectory.states, trajectory.result, trajectory.stats


_TOPS = quick_jit(jax.vmap(lambda omega: _states(TOP, omega)))


# Arrays whose last axis are the lanes
# -------------------------------------------------------


@jax.custom_jvp
def _ruled(x):
    return jnp.sin(x)


_ruled.defjvp(lambda x, dx: (_ruled(*x), dx[0]))


def _of_all_kinds(x, i, table):
    """Operations that go number by number, that move numbers, and that need a rule of vmap."""
    a, b, c = x
    rows = jnp.stack([x, 2 * x, jnp.flip(x)], axis=1)
    halves = jax.lax.bitcast_convert_type(x, jnp.int32).astype(x.dtype)
    mixed = jnp.concatenate(
        [rows.T.reshape(-1)[:4], jnp.where(a > 0, x, -x), jnp.arange(2.0)]
    )
    by_cond = jax.lax.cond(a > b, lambda x: x**2, lambda x: -x, x)
    by_loop = jax.lax.while_loop(
        lambda x: jnp.sum(x) < 10, lambda x: 2 * jnp.abs(x) + 1, x
    )
    looked_up = jnp.interp(c, jnp.linspace(-3, 3, 9), table)
    turned = jnp.linalg.solve(rows @ rows.T + 5 * jnp.eye(3), x)
    tail = jax.jit(lambda x: _ruled(jnp.sort(x))[i])(x)
    sums = jnp.sum(x, axis=()), jnp.max(x), jnp.sum(rows, axis=0), jnp.prod(x[:0])
    return {
        "a": (mixed, sums),
        "b": (by_cond, by_loop, rows),
        "c": [looked_up, turned, tail, jnp.ones(2), halves],
    }


def test_a_function_in_lanes_equals_its_vmap(rng):
    x, i = jnp.asarray(rng.normal(size=(3, 6))), jnp.array([0, 1, 2, 0, 1, 2])
    table = jnp.asarray(rng.normal(size=9))
    found = lanes_last(lambda x, i: _of_all_kinds(x, i, table), x, i)
    wanted = jax.vmap(lambda x, i: _of_all_kinds(x, i, table), -1, -1)(x, i)
    jax.tree_util.tree_map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13), found, wanted
    )


# Steps of a method
# --------------------------------------------------------------------------

METHODS = {
    "Verner9": (jr.solvers.Verner9(), 9, 4),
    "Dopri8": (diffrax.Dopri8(), 8, 8),
    "Tsit5": (diffrax.Tsit5(), 5, 40),
    "Bosh3": (diffrax.Bosh3(), 3, 40),
    "Heun": (diffrax.Heun(), 2, 40),
}


def _field(t, y):
    return jnp.stack([1.3 * y[1], -y[0] * jnp.cos(t)])


@pytest.mark.parametrize("in_lanes", [False, True])
@pytest.mark.parametrize("name", METHODS)
def test_a_step_is_that_of_its_method(name, in_lanes):
    """State and error estimate, as diffrax computes them."""
    solver, _, _ = METHODS[name]
    method = method_of(solver)
    t, h, y = jnp.array(0.3), jnp.array(0.4), jnp.array([1.0, 0.2])

    @quick_jit
    def ours(t, h, y):
        rates, y1 = stages(method, _field, t, h, y, in_lanes)
        return y1, h * combine(method.rows[-1], rates), error_of(method, rates, h)

    term = diffrax.ODETerm(lambda t, y, _: _field(t, y))
    memory = solver.init(term, t, t + h, y, None)
    theirs = solver.step(term, t, t + h, y, None, memory, False)[:2]
    *found, size = ours(t, h, y)
    for x, wanted in zip(found, theirs, strict=True):
        np.testing.assert_allclose(x, wanted, rtol=1e-13, atol=1e-15)
    assert np.all(size >= np.abs(found[1]) * (1 - 1e-6))


def _turned(method, angle):
    """Estimates of the error of a step of y' = i y, which turns y by an angle."""
    table = 1j * angle * method.rows[:-1]
    rates = np.linalg.solve(np.eye(method.stages) - table, np.ones(method.stages))
    return [abs(angle * x @ rates) for x in (method.rows[-1], method.second_row)]


@pytest.mark.parametrize("name", ["Verner9", "Dopri8", "Tsit5", "Bosh3"])
def test_the_second_estimate_is_smaller_in_smooth_steps(name):
    """It is of one order less, and a quarter of the first on a turn by 0.6 rad."""
    solver, order, _ = METHODS[name]
    method = method_of(solver)
    first, second = np.transpose([_turned(method, angle) for angle in (0.3, 0.6)])
    np.testing.assert_allclose(second[1], first[1] / 4, rtol=1e-6)
    np.testing.assert_allclose(np.log2(first[1] / first[0]), order, atol=0.6)
    np.testing.assert_allclose(np.log2(second[1] / second[0]), order - 1, atol=0.6)


@pytest.mark.parametrize(("name", "most"), [("Verner9", 300), ("Dopri8", 80)])
def test_an_error_at_a_kink_is_a_bounded_multiple_of_both_estimates(name, most):
    """y' = max(0, t - kink) over a step of length 1 has y = (1 - kink)^2 / 2."""
    method = method_of(METHODS[name][0])
    kinks = np.linspace(0, 1, 20_001)[1:-1]
    rates = np.maximum(0, method.times[:, None] - kinks)
    # The last stage is at the new state.
    error = abs(method.rows[-2] @ rates - (1 - kinks) ** 2 / 2)
    first = abs(method.rows[-1] @ rates)
    second = abs(method.second_row @ rates)
    assert np.max(error / first) > 10_000
    assert np.max(error / np.maximum(first, second)) < most


@pytest.mark.parametrize("name", METHODS)
def test_steps_are_of_the_order_of_their_method(name):
    solver, order, count = METHODS[name]
    method = method_of(solver)

    @quick_jit
    def end(count):
        h = 2.0 / count

        def step(i, y):
            return stages(method, _field, i * h, h, y)[1]

        return jax.lax.fori_loop(0, count.astype(int), step, jnp.array([1.0, 0.0]))[0]

    ends = [end(jnp.array(many * float(count))) for many in (1, 2, 64)]
    assert np.log2(abs(ends[0] - ends[2]) / abs(ends[1] - ends[2])) > order - 0.4


@pytest.mark.parametrize("in_lanes", [False, True])
def test_the_reverse_of_a_step_is_its_transpose(in_lanes):
    """Beside the derivative that JAX takes of the loop over the stages."""
    method = method_of(jr.solvers.Verner9())

    def field(strength, t, y):
        return strength * _field(t, y)

    t, h, y = jnp.array(0.3), jnp.array(0.4), jnp.array([1.0, 0.2])
    strength, change = jnp.array([0.7, 1.1]), jnp.array([0.3, -2.0])

    def end(strength, y):
        return stages(method, lambda t, y: field(strength, t, y), t, h, y)[1]

    rates, _ = stages(method, lambda t, y: field(strength, t, y), t, h, y)
    found = pull_back(method, field, strength, (t, h, y), rates, change, in_lanes)
    wanted = jax.vjp(end, strength, y)[1](change)
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-15)


# Motions
# -------------------------------------------------------------------------------------


def test_a_lane_is_the_same_to_the_bit_whatever_is_around_it(rng):
    """Other lanes, their order, their number."""
    omegas = rng.normal(size=(200, 3))
    order = rng.permutation(200)
    all_, again, few = _TOPS(omegas), _TOPS(omegas[order]), _TOPS(omegas[:130])
    for x, y, z in zip(
        *map(jax.tree_util.tree_leaves, (all_, again, few)), strict=True
    ):
        np.testing.assert_array_equal(x[order], y)
        np.testing.assert_array_equal(x[:130], z)


def test_lanes_equal_single_calls(rng):
    omegas = rng.normal(size=(3, 3)) * np.array([[0.0], [1.0], [10.0]])
    together, results, stats = _TOPS(omegas)
    for i, omega in enumerate(omegas):
        alone = _motion(TOP, omega)
        np.testing.assert_allclose(together.omega[i], alone.states.omega, atol=1e-10)
        np.testing.assert_allclose(
            together.attitude[i], alone.states.attitude, atol=1e-10
        )
        assert abs(int(stats["num_steps"][i]) - int(alone.stats["num_steps"])) <= 3
        assert int(results._value[i]) == 0


def test_lanes_that_fail_or_are_slow_change_nothing_in_the_others(rng):
    omegas = rng.normal(size=(20, 3))
    states, result, _ = _TOPS(omegas)
    spoiled = omegas.copy()
    spoiled[3], spoiled[11] = np.nan, 300.0
    other_states, other_result, stats = _TOPS(spoiled)
    keep = np.delete(np.arange(20), [3, 11])
    np.testing.assert_array_equal(other_states.omega[keep], states.omega[keep])
    assert np.all(np.isnan(other_states.omega[3]))
    assert int(other_result._value[3]) == int(jr.RESULTS.invalid_state._value)
    assert np.all(other_result._value[keep] == result._value[keep])
    steps = np.asarray(stats["num_steps"])
    assert steps[11] > 30 * np.median(steps)


def test_lanes_may_differ_in_everything_also_twice_over(rng):
    """Inertia, a parameter of the torque, times, t0, tolerances, args; a vmap in a vmap."""

    def moved(moments, mass, ts, rtol, strength, omega):
        def push(t, state, args):
            return args * jnp.sin(t) * state.omega

        lever, gravity = jnp.array([0.1, 0.0, 0.2]), jnp.array([0.0, 0.0, -1.0])
        weight = jr.torques.UniformGravity(mass, lever, gravity)
        body = jr.RigidBody(moments, jr.torques.as_torque(push) + weight)
        trajectory = jr.simulate(
            body,
            jr.State(UPRIGHT, omega),
            ts,
            strength,
            t0=ts[0] - 0.5,
            rtol=rtol,
            throw=False,
        )
        return trajectory.states.omega

    moments, omegas = 1 + rng.uniform(size=(2, 3)), rng.normal(size=(3, 3))
    mass, ts = np.array([1.0, 2.0]), np.array([[0.0, 1.0], [0.3, 2.0], [1.0, 1.5]])
    rtol, strength = np.array([1e-6, 1e-8, 1e-9]), np.array([0.1, 0.2])
    inner = jax.vmap(moved, (None, None, 0, 0, None, 0))
    found = quick_jit(jax.vmap(inner, (0, 0, None, None, 0, None)))(
        moments, mass, ts, rtol, strength, omegas
    )
    single = quick_jit(moved)
    for i in range(2):
        for k in range(3):
            alone = single(moments[i], mass[i], ts[k], rtol[k], strength[i], omegas[k])
            np.testing.assert_allclose(found[i, k], alone, atol=30 * rtol[k])


def test_a_torque_of_any_make_is_the_same_in_lanes(rng):
    """With `lax.cond`, a while loop, a table and a small network inside."""
    weights = 0.3 * rng.normal(size=(8, 3)), 0.3 * rng.normal(size=(3, 8))

    def torque(t, state, args):
        hidden = jnp.tanh(weights[0] @ state.omega)
        wave = jnp.interp(jnp.mod(t, 1.0), jnp.linspace(0, 1, 5), args)
        series = jax.lax.while_loop(
            lambda s: s[1] < 6,
            lambda s: (s[0] + t ** s[1] / 100, s[1] + 1),
            (0.0 * t, 1),
        )[0]
        sign = jax.lax.cond(
            state.omega[0] > 0, lambda w: -0.1 * w, lambda w: 0.1 * w, state.omega
        )
        return weights[1] @ hidden + sign + 0.05 * wave * jnp.ones(3) + 0.01 * series

    body, table = (
        jr.RigidBody(np.array([1.0, 2.0, 3.0]), torque),
        np.array([0.0, 1.0, 0.5, -1.0, 0.0]),
    )

    def final(omega):
        state = jr.State(UPRIGHT, omega)
        return jr.simulate(
            body, state, 1.5, table, rtol=1e-8, throw=False
        ).final_state.omega

    omegas = rng.normal(size=(3, 3))
    together = quick_jit(jax.vmap(final))(omegas)
    for omega, found in zip(omegas, together, strict=True):
        np.testing.assert_allclose(found, final(omega), atol=1e-5)


def _library():
    """Every torque of the library, on an orbit where it takes one."""
    t, up = jr.torques, np.array([0.0, 0.6, 0.8])
    orbit = t.KeplerOrbit(0.5, 1.3, 0.2)
    plates, centers = (
        np.array([[1.0, 0, 0], [0, 0.6, 0.8]]),
        np.array([[0, 0.1, 0.2], [0.3, 0, 0]]),
    )
    towards = lambda t: jnp.stack([jnp.cos(t), jnp.sin(t), 0 * t])  # noqa: E731
    return {
        "constant": t.Constant(0.1 * up),
        "gravity": GRAVITY,
        "gravity gradient": t.GravityGradient(0.5, orbit),
        "dipole": t.MagneticDipole(0.2 * up, lambda t, _: orbit(t)),
        "sunlight": t.SolarPressure(
            np.ones(2), plates, centers, towards, 0.3, 0.2, 0.1
        ),
        "linear drag": t.LinearDrag(np.array([0.1, 0.2, 0.3])),
        "quadratic drag": t.QuadraticDrag(0.1),
        "friction": t.CoulombFriction(0.1, 0.5, up),
        "damper": t.InternalDamper(0.2, 0.1),
        "rotor": t.Rotor(lambda t: jnp.sin(t) * up),
        "wheel": t.SpinningMass(0.2, up, lambda t, *_: 0.1 * jnp.cos(t)),
    }


def test_every_public_torque_is_in_the_library():
    public = [getattr(jr.torques, name) for name in jr.torques.__all__]
    general = (jr.torques.AbstractTorque, jr.torques.Sum, jr.torques.Torque)
    torques = {
        x
        for x in public
        if isinstance(x, type)
        and issubclass(x, jr.torques.AbstractTorque)
        and x not in general
    }
    missing = torques - {type(x) for x in _library().values()}
    assert not missing, f"add {sorted(x.__name__ for x in missing)} to _library"


@pytest.mark.parametrize("name", _library())
def test_every_torque_of_the_library_is_the_same_in_lanes(name, rng):
    body = jr.RigidBody(TOP.inertia, _library()[name])

    def rates(t, q, w):
        state = body.with_parts(jr.State(jr.rotation.normalize(q), w))
        return jax.flatten_util.ravel_pytree(body.vector_field(t, state, None))[0]

    lanes = (
        jnp.asarray(rng.normal(size=8)),
        rng.normal(size=(4, 8)),
        rng.normal(size=(3, 8)),
    )
    found = quick_jit(lambda *x: lanes_last(rates, *x))(*lanes)
    wanted = quick_jit(jax.vmap(rates, -1, -1))(*lanes)
    np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-14)


def test_all_torques_at_once_move_a_body_as_a_solver_of_diffrax_does(rng):
    """Lanes of the fast road beside `diffeqsolve` by hand, within what is promised."""
    body = jr.RigidBody(TOP.inertia, jr.torques.Sum(_library().values()))
    omegas = rng.normal(size=(3, 3))

    def by_hand(omega):
        state = body.with_parts(jr.State(UPRIGHT, omega))
        controller = diffrax.PIDController(rtol=1e-9, atol=1e-9)
        return diffrax.diffeqsolve(
            diffrax.ODETerm(body.vector_field),
            diffrax.Tsit5(),
            0.0,
            2.0,
            0.01,
            state,
            stepsize_controller=controller,
            throw=False,
        ).ys

    def ours(omega):
        state = jr.State(UPRIGHT, omega)
        options = {"solver": diffrax.Bosh3(), "rtol": 1e-6, "throw": False}
        return jr.simulate(body, state, 2.0, **options).final_state

    found, wanted = (quick_jit(jax.vmap(x))(omegas) for x in (ours, by_hand))
    wanted = jax.tree_util.tree_map(lambda x: x[:, 0], wanted)
    for x, y in zip(*map(jax.tree_util.tree_leaves, (found, wanted)), strict=True):
        np.testing.assert_allclose(x, y, atol=5e-5)  # 10 rtol (1 + phi)


SHARDED = """
import diffrax, jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
import jrigid as jr

def end(drag, omega):
    torque = jr.torques.LinearDrag(drag * jnp.ones(3))
    body, start = jr.RigidBody(np.array([1.0, 2.0, 3.0]), torque), jr.State(np.eye(4)[0], omega)
    options = {"solver": diffrax.Bosh3(), "rtol": 1e-4, "throw": False}
    return jnp.sum(jr.simulate(body, start, 1.0, **options).final_state.omega)

lanes = jax.vmap(jax.value_and_grad(end), (None, 0))
mesh, spec = jax.sharding.Mesh(np.array(jax.devices()), "lanes"), jax.P("lanes")
split = jax.shard_map(
    lanes, mesh=mesh, in_specs=(jax.P(), spec), out_specs=spec, check_vma=False
)
omegas = np.arange(12.0).reshape(4, 3)
pairs = zip(jax.jit(lanes)(0.1, omegas), jax.jit(split)(0.1, omegas), strict=True)
print(len(jax.devices()), all(np.array_equal(a, b) for a, b in pairs))
"""


def test_lanes_over_the_devices_of_a_process():
    said, complained = in_a_process(
        SHARDED, JAX_NUM_CPU_DEVICES="2", JAX_PLATFORMS="cpu"
    )
    assert said.split() == ["2", "True"], complained


# Derivatives
# ---------------------------------------------------------------------------------


def _end(moments, omega, adjoint=None):
    body, options = (
        jr.RigidBody(moments, GRAVITY),
        {"solver": diffrax.Tsit5(), "rtol": 1e-6},
    )
    trajectory = _motion(body, omega, adjoint=adjoint, **options)
    states = trajectory.states
    return jnp.concatenate(
        [states.omega.ravel(), states.attitude.ravel()]
    ), trajectory.result


def test_derivatives_in_lanes_are_those_of_single_motions(rng):
    """In what is each lane's own and in what all share; one lane is bad, one slow, one at rest."""
    omegas = rng.normal(size=(6, 3)) * np.array([0.0, 1.0, 1.0, 9.0, 1.0, 1.0])[:, None]
    weights = rng.normal(size=28)

    def loss(moments, omegas):
        ends, result = jax.vmap(lambda omega: _end(moments, omega))(omegas)
        good = result == jr.RESULTS.successful
        return jnp.sum(jnp.where(good[:, None], ends, 0.0) @ weights)

    def jacobian(moments, omega):
        forward = lambda *x: _end(*x, adjoint=diffrax.ForwardMode())[0]  # noqa: E731
        return jax.jacfwd(forward, (0, 1))(moments, omega)

    moments = np.array([1.0, 2.0, 3.0])
    omegas[2, 1] = np.nan
    found = quick_jit(jax.grad(loss, (0, 1)))(moments, omegas)
    good = np.array([0, 1, 3, 4, 5])
    jacobians = quick_jit(jax.vmap(jacobian, (None, 0)))(moments, omegas[good])
    of_moments, of_omegas = (np.einsum("i,lij->lj", weights, x) for x in jacobians)
    np.testing.assert_allclose(found[0], of_moments.sum(0), rtol=1e-9)
    np.testing.assert_allclose(found[1][good], of_omegas, rtol=1e-8, atol=1e-9)
    assert np.all(found[1][2] == 0)
    alone = quick_jit(jacobian)(moments, omegas[3])
    np.testing.assert_allclose(
        jacobians[0][2], alone[0], atol=1e-8 * np.abs(alone[0]).max()
    )


def test_what_is_not_kept_is_run_again(monkeypatch):
    """The cotangents are the same however few places there are for a long run."""
    ts = np.array([0.0, 20.0, 20.0, 60.0])

    def gradient(max_steps):  # each of them is traced
        options = {"solver": diffrax.Bosh3(), "rtol": 1e-3, "max_steps": max_steps}

        def total(moments):
            body, omega = jr.RigidBody(moments, GRAVITY), np.array([1.0, 0.3, -0.5])
            return jnp.sum(_motion(body, omega, ts, **options).states.omega)

        return quick_jit(jax.grad(total))(np.array([1.0, 2.0, 3.0]))

    kept = gradient(100_000)
    monkeypatch.setattr(replay, "_MOST", 6)
    monkeypatch.setattr(replay, "_FEWEST", 6)
    monkeypatch.setattr(replay, "_CHECKPOINTS", 3)
    again = gradient(100_001)
    np.testing.assert_allclose(again, kept, rtol=1e-11)
