"""The exact flow of the free body: values, invariants, derivatives, edges, bad input.

The reference values of tests/data/free_rotation.npz come from a closed form at 60
digits, which tests/test_free_reference.py checks against Taylor series; the derivatives
are compared with variational equations in 80-bit arithmetic (tests/reference.py).
"""

from pathlib import Path

import free_reference
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import reference
from helpers import ATTITUDE, MOMENTS, OMEGA, TENSOR, both_ways, quick_jit, ulps
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid import free

EPS = np.finfo(float).eps
RECORD = np.load(Path(__file__).parent / "data" / "free_rotation.npz")
REGIMES = list(dict.fromkeys(RECORD["regime"].tolist()))
UNSTABLE = {"separatrix", "near separatrix", "near spin, middle", "spin, middle"}


def state_at(inertia, attitude, omega, t):
    state = jr.free_rotation(inertia, jr.State(attitude, omega), t, throw=False)
    return jnp.concatenate([state.attitude, state.omega])


def jacobian(inertia, attitude, omega, t):
    return jax.jacfwd(state_at, argnums=(0, 1, 2))(inertia, attitude, omega, t)


def rows(regime):
    chosen = RECORD["regime"] == regime
    names = ("tensor" if regime == "tensor" else "inertia", "attitude", "omega", "time")
    return tuple(RECORD[name][chosen] for name in names)


def same_sign(found, exact):
    """The attitudes of `found` with the signs of those of `exact`:
    q and -q are one attitude."""
    signs = np.sign(np.sum(found[:, :4] * exact[:, :4], axis=1))[:, None]
    return np.concatenate([signs * found[:, :4], found[:, 4:]], axis=1)


def exact_states(regime):
    chosen = RECORD["regime"] == regime
    return np.concatenate(
        [RECORD["attitude_out"][chosen], RECORD["omega_out"][chosen]], axis=1
    )


def of_lanes(function):
    """A function of the cases of any regime, compiled for as many as the largest
    has."""
    lanes = max(np.sum(RECORD["regime"] == regime) for regime in REGIMES)

    def call(*inputs):
        count = len(inputs[0])
        padded = (
            np.concatenate([x, np.repeat(x[-1:], lanes - count, 0)]) for x in inputs
        )
        return jax.tree.map(lambda x: x[:count], function(*padded))

    return call


@pytest.fixture(scope="module")
def compiled():
    return {
        "value": of_lanes(jax.jit(jax.vmap(state_at))),
        "single": of_lanes(quick_jit(jax.vmap(state_at))),
        "jacobian": of_lanes(quick_jit(jax.vmap(jacobian))),
    }


def test_the_record_holds_at_least_fifty_cases_a_regime():
    assert all(np.sum(RECORD["regime"] == regime) >= 50 for regime in REGIMES)
    assert len(REGIMES) >= 20


@pytest.mark.parametrize("regime", REGIMES)
def test_values_to_the_bar_against_30_digits(regime, compiled):
    inertia, attitude, omega, time = rows(regime)
    exact = exact_states(regime)
    found = same_sign(
        np.asarray(compiled["value"](inertia, attitude, omega, time)), exact
    )
    size = np.linalg.norm(omega, axis=1)
    size = np.where(size == 0, 1.0, size)[:, None]
    radians = size * np.abs(time)[:, None]
    error = np.abs(found - exact) / np.concatenate(
        [np.ones((1, 4)) + 0 * size, size + np.zeros((1, 3))], 1
    )
    # What the last bits of the inputs do: 8 eps |d state / d inputs| |inputs|.
    amplified = np.zeros_like(radians)
    if regime in UNSTABLE or regime.startswith("unphysical"):
        columns = compiled["jacobian"](inertia, attitude, omega, time)
        for column, x in zip(columns, (inertia, attitude, omega), strict=True):
            scaled = (
                np.asarray(column) / np.where(np.arange(7) < 4, 1.0, size)[:, :, None]
            )
            norm = np.linalg.norm(scaled, axis=(1, 2)) * np.linalg.norm(x, axis=1)
            assert np.all(np.isfinite(norm))
            amplified[:, 0] += norm
    bar = 1e-13 * (1 + radians) + 8 * EPS * amplified
    assert np.all(error <= bar), np.max(error / bar)
    if (
        regime != "unphysical 1e6"
    ):  # where the motion amplifies, enough that still says something
        assert np.sum(bar < 1e-6) >= 20


@pytest.mark.parametrize(
    ("dtype", "offset"), [(np.float64, 1e-34), (np.float32, 1e-15)]
)
def test_a_flip_that_begins_very_near_the_unstable_axis_goes_through(dtype, offset):
    """At any time the motion obeys Euler's equations, and it ends at the other side."""
    omega = np.array([offset, 1.0, offset], dtype)
    attitude = np.eye(4, dtype=dtype)[0]
    growth = np.sqrt(1 / 3)
    times = np.linspace(0.6, 1.5, 7) * 2 * np.log(1 / offset) / (2 * growth)
    moments = MOMENTS.astype(dtype)

    @jax.jit
    def moving(t):
        return jax.jvp(
            lambda t: state_at(moments, attitude, omega, t), (t,), (jnp.ones_like(t),)
        )

    for t in times.astype(dtype):
        state, rate = moving(t)
        found = rate[4:]
        exact = jr.euler_equations(moments, state[4:])
        np.testing.assert_allclose(found, exact, atol=2e3 * np.finfo(dtype).eps)
    assert state[5] < -0.9


@pytest.mark.parametrize("regime", REGIMES)
def test_energy_and_momentum_in_space_to_1e_14_at_all_times(regime, compiled):
    inertia, attitude, omega, time = rows(regime)
    found = np.asarray(compiled["value"](inertia, attitude, omega, time))
    tensor = inertia if inertia.ndim == 3 else inertia[:, :, None] * np.eye(3)
    scale = np.max(np.abs(omega), axis=1)
    scale = np.where(scale == 0, 1.0, scale)[:, None]  # squares of 1e-160 underflow
    before, after = omega / scale, found[:, 4:] / scale
    momentum = [np.einsum("nij,nj->ni", tensor, w) for w in (before, after)]
    energy = [
        np.sum(w * m, axis=1) for w, m in zip((before, after), momentum, strict=True)
    ]
    np.testing.assert_allclose(energy[1], energy[0], rtol=1e-14)
    in_space = [
        Rotation.from_quat(q, scalar_first=True).apply(m)
        for q, m in zip((attitude, found[:, :4]), momentum, strict=True)
    ]
    length = np.linalg.norm(momentum[0], axis=1)
    np.testing.assert_allclose(np.linalg.norm(momentum[1], axis=1), length, rtol=1e-14)
    assert np.all(np.linalg.norm(in_space[1] - in_space[0], axis=1) <= 1e-14 * length)
    np.testing.assert_allclose(np.linalg.norm(found[:, :4], axis=1), 1.0, rtol=1e-14)


# --- Derivatives
# --------------------------------------------------------------------------------

OF_THE_SCALE = {"rest", "tensor", "omega x 1e-160", "omega x 1e-7", "omega x 1e4"}
DERIVATIVE_REGIMES = [
    r for r in REGIMES if r not in OF_THE_SCALE and not r.startswith("unphys")
]


# Moments that no real body has, in units of the middle one, as in classic test
# problems.
UNPHYSICAL = np.array(
    [[0.25, 1.0, 1.5], [0.6, 1.0, 1.8], [0.5, 1.0, 2.4], [1.0, 0.2, 1.9]]
)


def of_unit_rate(per_regime):
    """A few bodies of every regime with |omega| = 1 and the middle moment 1,
    side by side."""
    chosen = np.concatenate(
        [
            np.flatnonzero(RECORD["regime"] == regime)[
                np.linspace(
                    0, np.sum(RECORD["regime"] == regime) - 1, per_regime
                ).astype(int)
            ]
            for regime in DERIVATIVE_REGIMES
        ]
    )
    inertia, attitude, omega = (
        RECORD[name][chosen] for name in ("inertia", "attitude", "omega")
    )
    inertia = inertia / np.median(inertia, axis=1)[:, None]
    attitude = attitude / np.linalg.norm(attitude, axis=1)[:, None]
    omega = omega / np.linalg.norm(omega, axis=1)[:, None]
    regimes = RECORD["regime"][chosen]
    inertia = np.concatenate([inertia, UNPHYSICAL])
    attitude, omega = (
        np.concatenate([x, x[: len(UNPHYSICAL)]]) for x in (attitude, omega)
    )
    regimes = np.concatenate([regimes, ["unphysical"] * len(UNPHYSICAL)])
    return np.concatenate([attitude, omega, inertia], axis=1), regimes


def of_inputs(x, t):
    return state_at(x[7:], x[:4], x[4:7], t)


@pytest.fixture(scope="module")
def derivatives():
    def along(x, v, t):
        """Jacobian by columns and by rows, and its derivative along v in both
        orders."""
        (value, *first), (_, *second) = jax.jvp(
            lambda y: both_ways(lambda z: of_inputs(z, t), y), (x,), (v,)
        )
        return value, *first, *second

    return quick_jit(jax.vmap(along, (0, 0, None)))


@pytest.mark.parametrize(
    ("duration", "per_regime"),
    [
        (20.0, 1),
        pytest.param(20.0, 5, marks=pytest.mark.slow),
        pytest.param(-200.0, 2, marks=pytest.mark.slow),
    ],
)
def test_derivatives_equal_the_variational_equations(duration, per_regime, derivatives):
    inputs, regimes = of_unit_rate(per_regime)
    if duration < -20:  # exp(lambda t) of an unstable motion is beyond 80 bits then
        stable = ~np.isin(regimes, list(UNSTABLE))
        inputs, regimes = inputs[stable], regimes[stable]
    attitude, omega, inertia = inputs[:, :4], inputs[:, 4:7], inputs[:, 7:]
    direction = np.random.default_rng(3).normal(size=inputs.shape)
    direction[:, :4] = 0  # the package normalises the attitude, the reference does not
    state, exact = reference.heavy_body(inertia, attitude, omega, duration)
    curvature = reference.free_hessian_vector(
        inertia, attitude, omega, duration, direction
    )
    tangent = np.tile(np.eye(10), (len(inputs), 1, 1))
    tangent[:, :4, :4] -= attitude[:, :, None] * attitude[:, None, :]
    exact = np.einsum("nij,njk->nik", exact.astype(float), tangent)
    curvature = np.einsum("nij,njk->nik", curvature.astype(float), tangent)

    found, *firsts_and_seconds = (
        np.asarray(x) for x in derivatives(inputs, direction, duration)
    )
    signs = np.ones((len(inputs), 7, 1))
    signs[:, :4] = np.sign(np.sum(found[:, :4] * state[:, :4].astype(float), 1))[
        :, None, None
    ]
    forward, reverse, by_columns, by_rows = (signs * x for x in firsts_and_seconds)

    def norm(x):
        return np.linalg.norm(x, axis=(1, 2))

    # A bit of the inputs changes the Jacobian itself by this much.
    rounding = 8 * EPS * norm(curvature) / norm(exact)
    for first in (forward, reverse):
        relative = norm(first - exact) / norm(exact)
        assert np.all(relative <= 1e-9 + rounding), dict(
            zip(regimes, relative, strict=True)
        )
    for second in (by_columns, by_rows):
        relative = norm(second - curvature) / np.maximum(norm(curvature), norm(exact))
        assert np.all(relative <= 1e-9 + 10 * rounding), dict(
            zip(regimes, relative, strict=True)
        )


def test_derivatives_at_rest_are_finite_and_right(compiled):
    attitude = ATTITUDE / np.linalg.norm(ATTITUDE)
    inputs = (x[None] for x in (MOMENTS, attitude, np.zeros(3), np.array(2.0)))
    by_moments, _, by_omega = (np.asarray(x)[0] for x in compiled["jacobian"](*inputs))
    np.testing.assert_array_equal(by_moments, 0.0)
    np.testing.assert_allclose(by_omega[4:], np.eye(3), atol=ulps(float, 2))
    # q (1, t d omega / 2)
    w, x, y, z = attitude
    exact = np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])
    np.testing.assert_allclose(by_omega[:4], exact, atol=ulps(float, 2))


@pytest.mark.parametrize("times", [0.7, 40.0])
def test_derivative_in_time_is_euler_s_equation(times):
    attitude = ATTITUDE / np.linalg.norm(ATTITUDE)
    rates = jax.jacfwd(state_at, argnums=3)(MOMENTS, attitude, OMEGA, times)
    state = state_at(MOMENTS, attitude, OMEGA, times)
    np.testing.assert_allclose(
        rates[:4], jr.rotation.attitude_rate(state[:4], state[4:]), atol=1e-13
    )
    np.testing.assert_allclose(
        rates[4:], jr.euler_equations(MOMENTS, state[4:]), atol=1e-13
    )


# Exact doubles: every change of the size of the differences below is exact too.
TENSORS = {
    "sphere": 2.0 * np.eye(3),
    "symmetric about the third axis": np.diag([1.0, 1.0, 2.0]),
    "symmetric, turned": np.array([[2.0, 1.0, 1.0], [1.0, 2.0, 1.0], [1.0, 1.0, 2.0]]),
    "nearly a sphere": np.diag([2.0, 2.0 + 2.0**-13, 2.0 + 2.0**-12]),
    "nearly symmetric": np.diag([1.0, 1.0 + 2.0**-30, 1.5]),
    "generic": np.array([[2.0, 0.25, -0.5], [0.25, 1.5, 0.125], [-0.5, 0.125, 3.0]]),
    "generic, unphysical": np.array(
        [[2.0, 1.25, -0.5], [1.25, 1.5, 0.125], [-0.5, 0.125, 7.0]]
    ),
}


@pytest.fixture(scope="module")
def of_tensor():
    def along(tensor, omega, change, turn, t):
        def moved(s):
            return state_at(tensor + s * change, jnp.eye(4)[0], omega + s * turn, t)

        zero = jnp.zeros(())
        (value, forward, reverse), (_, second, _) = jax.jvp(
            lambda s: both_ways(moved, s), (zero,), (zero + 1,)
        )
        return value, forward, reverse, second

    return quick_jit(along)


@pytest.mark.parametrize("name", TENSORS)
def test_first_derivatives_in_a_tensor_are_right_at_repeated_moments(name, of_tensor):
    """Against differences of the 30-digit motion, extrapolated to zero step."""
    tensor, t = TENSORS[name], 9.0
    omega, turn = np.array([0.5, -0.75, 0.25]), np.array([0.25, 0.5, -1.0])
    change = np.array([[0.5, -0.25, 0.75], [-0.25, -1.0, 0.5], [0.75, 0.5, 0.25]])

    def motion(s):
        ((q, w),) = free_reference.free_motion(
            tensor + s * change, np.eye(4)[0], omega + s * turn, [t]
        )
        return np.array([*q, *w])

    def slope(h):
        return (motion(h) - motion(-h)) / (2 * h)

    h = 2.0**-14
    with mp.workdps(40):
        exact = np.array((64 * slope(h / 4) - 20 * slope(h / 2) + slope(h)) / 45, float)
    value, forward, reverse, _ = map(
        np.asarray, of_tensor(tensor, omega, change, turn, t)
    )
    sign = np.sign(np.sum(value[:4] * np.array(motion(0.0)[:4], float)))
    exact[:4] *= sign
    bound = 1e-9 * np.linalg.norm(exact)
    np.testing.assert_allclose(forward, exact, rtol=0, atol=bound)
    np.testing.assert_allclose(reverse, exact, rtol=0, atol=bound)


@pytest.mark.parametrize("t", [1e2, 1e3, 1e4, 1e5])
def test_derivatives_in_a_tensor_at_a_long_spin_about_one_of_two_equal_axes(t):
    """I = (1, 1, 1.5), omega along x: domega_y / dI_xy = -t^2 / 6 is by far the
    largest."""

    def end(s):
        tensor = jnp.diag(jnp.array([1.0, 1.0, 1.5])) + s * jnp.zeros((3, 3)).at[
            [0, 1], [1, 0]
        ].set(1)
        return state_at(tensor, jnp.eye(4)[0], jnp.array([1.0, 0.0, 0.0]), t)[4:]

    slope = quick_jit(lambda s: jax.jvp(end, (s,), (1.0,))[1])(0.0)
    assert np.max(np.abs(slope)) == pytest.approx(t * t / 6, rel=1e-8)


@pytest.mark.parametrize("gap", [0.0, 2.0**-40, 2.0**-17, 2.0**-13])
def test_derivatives_in_a_tensor_after_a_long_time_near_the_separatrix(gap, of_tensor):
    """There a gap's effect grows with the square of the time:
    what is near must know."""
    tensor, t, n = np.diag([1.0, 1.0 + gap, 1.5]), 1000.0, np.ones((3, 3))
    omega, turn = np.array([0.75, -0.625, 2.0**-10]), np.zeros(3)

    def motion(s):
        ((q, w),) = free_reference.free_motion(tensor + s * n, np.eye(4)[0], omega, [t])
        return np.array([*q, *w])

    with mp.workdps(40):
        h = 2.0**-34
        exact = np.array(
            (8 * (motion(h) - motion(-h)) - motion(2 * h) + motion(-2 * h)), float
        )
    exact /= 12 * h
    value, forward, reverse, _ = map(np.asarray, of_tensor(tensor, omega, n, turn, t))
    exact[:4] *= np.sign(np.sum(value[:4] * np.array(motion(0.0)[:4], float)))
    bound = 1e-6 * np.linalg.norm(exact)
    np.testing.assert_allclose(forward, exact, rtol=0, atol=bound)
    np.testing.assert_allclose(reverse, exact, rtol=0, atol=bound)


def test_second_derivatives_in_a_tensor_of_distinct_moments(of_tensor):
    tensor, t = TENSORS["generic"], 9.0
    omega, turn = np.array([0.5, -0.75, 0.25]), np.array([0.25, 0.5, -1.0])
    change = np.array([[0.5, -0.25, 0.75], [-0.25, -1.0, 0.5], [0.75, 0.5, 0.25]])

    def motion(s):
        ((q, w),) = free_reference.free_motion(
            tensor + s * change, np.eye(4)[0], omega + s * turn, [t]
        )
        return np.array([*q, *w])

    def bend(h):
        return (motion(h) - 2 * motion(0.0) + motion(-h)) / (h * h)

    h = 2.0**-13
    with mp.workdps(40):
        exact = np.array((64 * bend(h / 4) - 20 * bend(h / 2) + bend(h)) / 45, float)

    value, _, _, found = map(np.asarray, of_tensor(tensor, omega, change, turn, t))
    exact[:4] *= np.sign(np.sum(value[:4] * np.array(motion(0.0)[:4], float)))
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-9 * np.linalg.norm(exact))


# --- float32, shapes, modes
# ---------------------------------------------------------------------

# Errors of the attitude and of omega / |omega|, in float32 eps (1 + radians of the
# motion). The moments of a tensor come from its six elements with an error of a few eps
# of the largest.
FLOAT32_MULTIPLE = 16
FLOAT32_MULTIPLE_OF_A_TENSOR = 64


@pytest.mark.parametrize(
    "regime", [r for r in REGIMES if r not in UNSTABLE | {"omega x 1e-160"}]
)
def test_float32_within_a_multiple_of_its_eps(regime, compiled):
    inertia, attitude, omega, time = (x.astype(np.float32) for x in rows(regime))
    if regime == "tensor":
        inertia = 0.5 * (inertia + np.swapaxes(inertia, 1, 2))
    with jax.numpy_dtype_promotion("standard"):
        found = np.asarray(compiled["single"](inertia, attitude, omega, time), float)
        exact_inputs = [x.astype(float) for x in (inertia, attitude, omega, time)]
        exact = np.asarray(compiled["value"](*exact_inputs))
    assert not np.any(np.isnan(found))
    size = np.linalg.norm(omega.astype(float), axis=1)
    size = np.where(size == 0, 1.0, size)
    # the inputs' own bits: a body with moments 1 : 1e3 has motions that fast
    moments = inertia if inertia.ndim == 2 else np.linalg.eigvalsh(inertia)
    spread = 1.0
    if regime == "tensor" or regime.startswith("unphysical"):
        spread = np.max(moments, axis=1) / np.min(moments, axis=1)
    radians = size * np.abs(time) * spread
    found = same_sign(found, exact)
    error = np.maximum(
        np.max(np.abs(found - exact)[:, :4], axis=1),
        np.max(np.abs(found - exact)[:, 4:], axis=1) / size,
    )
    short = radians < 1e5  # beyond, float32 does not know the phase
    multiple = FLOAT32_MULTIPLE_OF_A_TENSOR if regime == "tensor" else FLOAT32_MULTIPLE
    bar = multiple * np.finfo(np.float32).eps * (1 + radians)
    assert np.all(error[short] <= bar[short]), np.max(error[short] / bar[short])


def test_dtype_follows_the_arguments():
    single = [
        np.float32(x)
        for x in (MOMENTS, ATTITUDE / np.linalg.norm(ATTITUDE), OMEGA, 3.0)
    ]
    state = jr.free_rotation(single[0], jr.State(single[1], single[2]), single[3])
    assert state.attitude.dtype == state.omega.dtype == np.float32


@pytest.fixture(scope="module")
def single():
    return quick_jit(
        lambda state0, t: jr.free_rotation(TENSOR, state0, t, t0=-1.5, throw=False)
    )


@pytest.mark.parametrize("shape", [(), (1,), (4,), (2, 3), (0,)])
def test_times_of_any_shape_and_order(shape, single):
    ts = np.random.default_rng(0).normal(scale=30.0, size=shape)
    state0 = jr.State(ATTITUDE / np.linalg.norm(ATTITUDE), OMEGA)

    states = single(state0, ts)
    assert states.attitude.shape == (*shape, 4)
    assert states.omega.shape == (*shape, 3)
    for index in np.ndindex(shape):
        one = single(state0, ts[index])
        np.testing.assert_allclose(states.attitude[index], one.attitude, atol=1e-14)
        np.testing.assert_allclose(states.omega[index], one.omega, atol=1e-14)


def test_there_and_back_again_and_in_two_steps():
    state0 = jr.State(ATTITUDE / np.linalg.norm(ATTITUDE), OMEGA)
    there = jr.free_rotation(TENSOR, state0, 12.5).states
    back = jr.free_rotation(TENSOR, there, 0.0, t0=12.5)
    np.testing.assert_allclose(back.attitude, state0.attitude, atol=1e-14)
    np.testing.assert_allclose(back.omega, state0.omega, atol=1e-14)
    further = jr.free_rotation(TENSOR, there, 30.0, t0=12.5)
    at_once = jr.free_rotation(TENSOR, state0, 30.0)
    np.testing.assert_allclose(further.attitude, at_once.attitude, atol=1e-13)


def test_equals_simulate():
    state0 = jr.State(ATTITUDE / np.linalg.norm(ATTITUDE), OMEGA)
    ts = np.linspace(0.0, 30.0, 7)

    @quick_jit
    def both(state0, ts):
        integrated = jr.simulate(
            jr.RigidBody(TENSOR), state0, ts, rtol=1e-11, throw=False
        )
        return jr.free_rotation(
            TENSOR, state0, ts, throw=False
        ).states, integrated.states

    exact, integrated = both(state0, ts)
    np.testing.assert_allclose(exact.attitude, integrated.attitude, atol=1e-11)
    np.testing.assert_allclose(exact.omega, integrated.omega, atol=1e-11)


def test_an_eager_call_compiles_once():
    state0, times = jr.State(GOOD["attitude"], OMEGA), np.linspace(0.0, 1.0, 13)

    def both():
        jax.block_until_ready(jr.free_rotation(MOMENTS, state0, times))
        free.polhode_period(MOMENTS, OMEGA).block_until_ready()

    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, *_, **__: compiled.append(event) if "compile" in event else None
    )
    jax.jit(lambda x: x + 1.234)(1.0)
    assert compiled  # the listener hears of what is compiled
    both()
    compiled.clear()
    both()
    assert not compiled


# --- Bad input
# ----------------------------------------------------------------------------------

GOOD = {
    "inertia": MOMENTS,
    "attitude": np.array([1.0, 0.0, 0.0, 0.0]),
    "omega": OMEGA,
    "ts": np.array([1.0, 2.0]),
    "t0": np.array(0.5),
}
BAD = {
    "negative moment": (
        {"inertia": np.array([1.0, -2.0, 3.0])},
        "invalid_inertia",
        r"`inertia` must hold three positive.*: \[ 1\. -2\.  3\.\] in lane 1\. \(Three",
    ),
    "NaN moment": (
        {"inertia": np.array([1.0, np.nan, 3.0])},
        "invalid_inertia",
        r"`inertia` must .*: \[ 1\. nan  3\.\] in lane 1\.",
    ),
    "NaN rate": (
        {"omega": np.array([1.0, np.nan, 3.0])},
        "invalid_state",
        r"`state0` must be finite, .*: \[ 1\.  0\.  0\.  0\.  1\. nan  3\.\] in lane "
        r"1\.",
    ),
    "NaN attitude": (
        {"attitude": np.array([1.0, 0.0, np.nan, 0.0])},
        "invalid_state",
        r"`state0` must be finite",
    ),
    "zero quaternion": (
        {"attitude": np.zeros(4)},
        "invalid_attitude",
        r"unit quaternion, .*: \[0\. 0\. 0\. 0\.\] in lane 1\.",
    ),
    "not unit": (
        {"attitude": 2.0 * GOOD["attitude"]},
        "invalid_attitude",
        "unit quaternion",
    ),
    "infinite time": (
        {"ts": np.array([1.0, np.inf])},
        "invalid_times",
        r"`ts` must be finite, but it is not: inf in lane 1\.",
    ),
    "NaN t0": (
        {"t0": np.nan},
        "invalid_times",
        r"`t0` must be finite.*: nan in lane 1\.",
    ),
}


def run(inertia, attitude, omega, ts, t0, throw=True):
    return jr.free_rotation(inertia, jr.State(attitude, omega), ts, t0=t0, throw=throw)


@quick_jit
def three_lanes(lanes):
    """Numbers of two good lanes around a bad one, the motion,
    and the derivatives of all inputs."""

    def total(lanes, shared):
        motion = jax.vmap(lambda lane: run(**shift(lane, shared), throw=False))(lanes)
        good = jnp.sum(motion.omega[0] ** 3) + jnp.sum(motion.attitude[2])
        return good, motion

    def shift(lane, shared):
        return jax.tree.map(lambda x, y: x + y, lane, shared)

    shared = jax.tree.map(lambda x: jnp.zeros_like(x[0]), lanes)
    (_, motion), slopes = jax.value_and_grad(total, (0, 1), has_aux=True)(lanes, shared)
    forward = jax.jvp(
        lambda x: total(lanes, x)[0], (shared,), (jax.tree.map(jnp.ones_like, shared),)
    )
    return motion, slopes, forward[1]


@jax.jit
def run_under_jit(lane):
    return run(**lane)


@pytest.mark.parametrize("name", BAD)
def test_bad_value_is_an_error_eagerly_and_under_jit_and_marks_its_lane(name):
    change, code, message = BAD[name]
    lanes = {
        k: jnp.stack([x, jnp.asarray(change.get(k, x), float), x])
        for k, x in GOOD.items()
    }
    with pytest.raises(RuntimeError, match=message):
        jax.vmap(lambda lane: run(**lane))(lanes)
    with pytest.raises(RuntimeError, match=message.split(":")[0].split(" in lane")[0]):
        run(**{**GOOD, **change})
    with pytest.raises(Exception, match=message.split(":")[0]):
        jax.block_until_ready(run_under_jit({k: x[1] for k, x in lanes.items()}))
    motion, (slopes, of_shared), forward = three_lanes(lanes)
    assert np.all(np.isnan(motion.omega[1]))
    assert np.all(np.isnan(motion.attitude[1]))
    assert np.all(np.isfinite(motion.omega[::2]))
    assert all(
        np.all(np.isfinite(slope)) for slope in jax.tree.leaves((slopes, of_shared))
    )
    assert np.isfinite(forward)
    np.testing.assert_allclose(
        sum(np.sum(x) for x in of_shared.values()), forward, rtol=1e-12
    )
    expected = getattr(jr.RESULTS, code)
    np.testing.assert_array_equal(motion.result == expected, [False, True, False])
    np.testing.assert_array_equal(
        motion.result == jr.RESULTS.successful, [True, False, True]
    )


def test_angles_that_overflow_are_an_error_or_have_a_code():
    state0 = jr.State(GOOD["attitude"], 1e10 * OMEGA)
    with pytest.raises(RuntimeError, match="out of the range"):
        jr.free_rotation(MOMENTS, state0, 1e300)
    motion = jr.free_rotation(MOMENTS, state0, 1e300, throw=False)
    assert motion.result == jr.RESULTS.nonfinite_state
    assert np.all(np.isnan(motion.omega))


def test_the_answer_shows_its_numbers_and_what_became_of_the_call():
    motion = jr.free_rotation(MOMENTS, jr.State(GOOD["attitude"], OMEGA), 0.0)
    assert isinstance(motion, jr.ExactStates)
    assert "omega=[ 0.3, -0.5, 0.8]" in repr(motion)
    assert jr.RESULTS[motion.result] == "All went well."
    assert motion.states.omega is motion.omega


@pytest.mark.parametrize("inertia", [MOMENTS, TENSOR], ids=["moments", "tensor"])
def test_nothing_that_is_compiled_calls_back(inertia):
    """Callbacks keep jax's persistent cache from serving a compiled function."""
    state0 = jr.State(GOOD["attitude"], OMEGA)

    def everything(inertia, omega):
        names = [
            "cone_angles",
            "geometric_phase",
            "mean_precession_rate",
            "modulus",
            "parameter",
            "poinsot",
            "polhode",
            "polhode_period",
            "precession_per_period",
            "precession_rate",
            "regime",
            "wobble_rate",
        ]
        state = jr.State(state0.attitude, omega)
        return (
            [getattr(free, name)(inertia, omega) for name in names],
            free.separatrix(inertia),
            free.herpolhode(inertia, state, GOOD["ts"]),
            free.relative_rotation(inertia, omega, 1.0),
            jr.free_rotation(inertia, state, GOOD["ts"], throw=False),
        )

    assert "callback" not in str(jax.make_jaxpr(everything)(inertia, OMEGA))
    assert "callback" in str(
        jax.make_jaxpr(lambda w: run(**{**GOOD, "omega": w}))(OMEGA)
    )


@pytest.mark.parametrize(
    "make", [jr.RigidBody, lambda x: jr.MassProperties(1.0, np.zeros(3), x)]
)
def test_a_body_in_place_of_its_inertia_is_a_sentence(make, untyped):
    body, state0 = make(np.array([1.0, 1.5, 2.0])), jr.State(GOOD["attitude"], OMEGA)
    message = (
        rf"`inertia` must be .* but it is a {type(body).__name__}: pass its "
        r"`\.inertia`\."
    )
    for call in (
        lambda: jr.free_rotation(body, state0, 1.0),
        lambda: free.polhode_period(body, OMEGA),
        lambda: free.separatrix(body),
        lambda: free.herpolhode(body, state0, 1.0),
        lambda: jr.kinetic_energy(body, OMEGA),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_wrong_shapes_and_types(untyped):
    state0 = jr.State(GOOD["attitude"], OMEGA)
    with pytest.raises(
        ValueError, match=r"`inertia` must have shape \(3,\) or \(3, 3\)"
    ):
        jr.free_rotation(np.ones(4), state0, 1.0)
    with pytest.raises(ValueError, match="must be a State"):
        jr.free_rotation(MOMENTS, OMEGA, 1.0)
    with pytest.raises(ValueError, match=r"`state0\.omega` must have shape \(3,\)"):
        jr.free_rotation(MOMENTS, jr.State(GOOD["attitude"], np.ones(4)), 1.0)
    with pytest.raises(ValueError, match=r"`state0\.internal` must be empty"):
        jr.free_rotation(MOMENTS, jr.State(GOOD["attitude"], OMEGA, np.ones(3)), 1.0)
    half = jr.State(GOOD["attitude"].astype(np.float16), OMEGA.astype(np.float16))
    with pytest.raises(ValueError, match="float32 or float64"):
        jr.free_rotation(MOMENTS.astype(np.float16), half, np.float16(1.0))
