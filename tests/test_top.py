"""The exact flow of Lagrange's top: values, invariants, derivatives, edges, bad input.

tests/data/top_motion.npz holds Taylor series at 30 digits, top_derivatives.npz
variational equations in 80-bit arithmetic (tests/data/make_top_motion.py).
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import reference
from helpers import ATTITUDE, OMEGA, both_ways, central_difference, quick_jit, ulps
from scipy.spatial.transform import Rotation
from taylor_reference import taylor_top
from top_reference import closed_form

import jrigid as jr

EPS = np.finfo(float).eps
HERE = Path(__file__).parent / "data"
RECORD = np.load(HERE / "top_motion.npz")
SLOPES = np.load(HERE / "top_derivatives.npz")
REGIMES = list(dict.fromkeys(RECORD["regime"].tolist()))


UNSTABLE = {"pendulum", "near sleeping spin"}


def state_at(parameters, attitude, omega, t):
    top = jr.SymmetricTop(*parameters)
    state = jr.top_motion(top, jr.State(attitude, omega), t, throw=False)
    return jnp.concatenate([state.attitude, state.omega])


def jacobians(parameters, attitude, omega, t):
    """In attitude, omega and parameters, forward and in reverse, by one trace."""

    def of_inputs(x):
        return state_at(x[7:], x[:4], x[4:7], t)

    x = jnp.concatenate([attitude, omega, parameters])
    return both_ways(of_inputs, x)[1:]


@quick_jit
def along(x, v):
    """The state of (parameters, attitude, omega, t) and its first two derivatives along
    v."""

    def moved(s):
        y = x + s * v
        return state_at(y[:3], y[3:7] / jnp.linalg.norm(y[3:7]), y[7:10], y[10])

    def with_slope(s):
        return jax.jvp(moved, (s,), (1.0,))

    (value, first), (_, second) = jax.jvp(with_slope, (0.0,), (1.0,))
    return value, first, second


def state_and_rate(parameters, attitude, omega, t):
    """With its derivative in time."""
    return along(np.array([*parameters, *attitude, *omega, t]), np.eye(11)[10])[:2]


def rows(regime):
    chosen = RECORD["regime"] == regime
    parameters = np.concatenate([RECORD["moments"], RECORD["mgl"][:, None]], axis=1)[
        chosen
    ]
    return (
        parameters,
        *(RECORD[name][chosen] for name in ("attitude", "omega", "time")),
    )


def rates(parameters, omega):
    """The fastest rate of a top: of its body, its precession, its pendulum."""
    i1, i3, mgl = parameters.T
    own = np.concatenate([omega, (i3 / i1 * omega[:, 2])[:, None]], axis=1)
    rate = np.maximum(np.max(np.abs(own), axis=1), np.sqrt(np.abs(mgl) / i1))
    return np.where(rate == 0, 1.0, rate)


LANES = 168  # of one compilation for every regime


def of_lanes(function):
    def call(*arrays):
        rows = len(arrays[0])
        padded = (
            np.concatenate([x, np.repeat(x[:1], LANES - rows, axis=0)]) for x in arrays
        )
        return jax.tree.map(lambda x: np.asarray(x)[:rows], function(*padded))

    return call


@pytest.fixture(scope="module")
def compiled():
    return {
        "value": of_lanes(jax.jit(jax.vmap(state_at))),
        "jacobians": of_lanes(quick_jit(jax.vmap(jacobians))),
    }


def test_the_record_holds_at_least_fifty_cases_a_regime():
    assert all(np.sum(RECORD["regime"] == regime) >= 50 for regime in REGIMES)
    assert len(REGIMES) >= 19
    near = RECORD["regime"] == "near sleeping spin"
    assert all(
        np.sum(near & (RECORD["level"] == level)) >= 50 for level in (1e-3, 1e-8, 1e-12)
    )


@pytest.mark.parametrize("regime", REGIMES)
def test_values_to_the_bar_against_30_digits(regime, compiled):
    parameters, attitude, omega, time = rows(regime)
    chosen = RECORD["regime"] == regime
    exact = np.concatenate([RECORD["attitude_out"], RECORD["omega_out"]], axis=1)[
        chosen
    ]
    found = compiled["value"](parameters, attitude, omega, time)  # sign included
    rate = rates(parameters, omega)[:, None]
    unit = np.concatenate([np.ones((len(rate), 4)), np.tile(rate, (1, 3))], axis=1)
    error = np.max(np.abs(found - exact) / unit, axis=1)
    radians = rate[:, 0] * np.abs(time)
    bar = 1e-13 * (1 + radians)
    if (
        regime in UNSTABLE
    ):  # near a separatrix the motion amplifies the inputs' last bits
        forward, _ = compiled["jacobians"](parameters, attitude, omega, time)
        columns = np.split(forward, [4, 7], axis=2)
        for column, x in zip(columns, (attitude, omega, parameters), strict=True):
            scaled = np.linalg.norm(column / unit[:, :, None], axis=1)
            bar = bar + 8 * EPS * np.linalg.norm(scaled * x, axis=1)
        assert np.sum(bar < 1e-6) >= 50
    assert np.all(error <= bar), np.max(error / bar)


@pytest.mark.parametrize("regime", REGIMES)
def test_energy_and_momenta_keep_their_values(regime, compiled):
    parameters, attitude, omega, time = rows(regime)
    found = compiled["value"](parameters, attitude, omega, time)
    i1, i3, mgl = parameters.T
    rate = rates(parameters, omega)
    size = i1 * rate**2 * np.maximum(1.0, i3 / i1)

    def invariants(q, w):
        up = Rotation.from_quat(q, scalar_first=True).inv().apply([0.0, 0.0, 1.0])
        momentum = np.stack([i1 * w[:, 0], i1 * w[:, 1], i3 * w[:, 2]], axis=1)
        energy = 0.5 * np.sum(momentum * w, axis=1) + mgl * up[:, 2]
        return np.stack([energy / size, np.sum(momentum * up, axis=1) * rate / size])

    change = invariants(found[:, :4], found[:, 4:]) - invariants(attitude, omega)
    assert np.max(np.abs(change)) <= 2e-14
    np.testing.assert_array_equal(found[:, 6], omega[:, 2])
    np.testing.assert_allclose(np.linalg.norm(found[:, :4], axis=1), 1.0, rtol=1e-14)


def test_a_million_turns_err_no_more_than_their_phase(compiled):
    """Against the same closed form at 50 digits, itself checked against the Taylor
    series."""
    parameters, attitude, omega, _ = rows("generic nutation")
    time = 2e6 * np.pi / rates(parameters, omega)
    found = compiled["value"](parameters, attitude, omega, time)
    for k in range(0, 60, 6):
        q, w = closed_form(*parameters[k], attitude[k], omega[k], time[k])
        exact = np.array([*q, *w], float)
        unit = np.where(
            np.arange(7) < 4, 1.0, rates(parameters[k : k + 1], omega[k : k + 1])
        )
        assert np.max(np.abs(found[k] - exact) / unit) < 1e-13 * 2e6 * np.pi


@pytest.mark.parametrize(
    "regime", ["generic nutation", "loops", "through upright", "fast spin"]
)
def test_the_closed_form_at_50_digits_is_the_taylor_series(regime):
    parameters, attitude, omega, time = rows(regime)
    stored = [
        [
            [mp.mpf(x) for x in row]
            for row in RECORD[name][RECORD["regime"] == regime].tolist()
        ]
        for name in ("attitude_out", "attitude_low", "omega_out", "omega_low")
    ]
    for k in range(0, len(time), 6):
        q, w = closed_form(*parameters[k], attitude[k], omega[k], time[k])
        with mp.workdps(40):
            high, low = ([*stored[i][k], *stored[i + 2][k]] for i in (0, 1))
            assert (
                max(abs(a - b - c) for a, b, c in zip((*q, *w), high, low, strict=True))
                < 1e-29
            )


@pytest.mark.parametrize("spin", [3.0, 4.0, 4.5])
@pytest.mark.parametrize("t", [1e3, 1e6])
def test_a_top_asleep_turns_about_the_vertical_for_ever(spin, t):
    """Below, at and above the threshold, where a nutation lasts without end."""
    found = state_at(
        jnp.array([1.0, 0.5, 1.0]), np.eye(4)[0], jnp.array([0, 0, spin]), t
    )
    half = mp.mpf(spin) * mp.mpf(t) / 2
    exact = [float(mp.cos(half)), 0, 0, float(mp.sin(half)), 0, 0, spin]
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-13 * (1 + spin * t))


def test_rates_whose_squares_underflow_and_angles_that_overflow():
    for rate in (1e-140, 1e-170, 1e-200):
        found = state_at(
            jnp.array([1.0, 0.5, 0.0]),
            ATTITUDE / np.linalg.norm(ATTITUDE),
            rate * OMEGA,
            0.5 / rate,
        )
        slow = state_at(
            jnp.array([1.0, 0.5, 0.0]), ATTITUDE / np.linalg.norm(ATTITUDE), OMEGA, 0.5
        )
        np.testing.assert_allclose(found[:4], slow[:4], atol=1e-14)
        np.testing.assert_allclose(found[4:] / rate, slow[4:], atol=1e-14)
    single = jr.top_motion(
        jr.SymmetricTop(np.float32(1), np.float32(0.5), np.float32(0)),
        jr.State(np.eye(4, dtype=np.float32)[0], np.array([0, 0, 1e-19], np.float32)),
        np.float32(1),
    )
    assert np.all(np.isfinite(single.omega))
    top, state = jr.SymmetricTop(1.0, 0.5, 1.0), jr.State(np.eye(4)[0], 1e10 * OMEGA)
    with pytest.raises(RuntimeError, match="out of the range"):
        jr.top_motion(top, state, 1e300)
    beyond = jr.top_motion(top, state, 1e300, throw=False)
    assert beyond.result == jr.RESULTS.nonfinite_state
    assert np.all(np.isnan(beyond.omega))


def test_without_gravity_it_is_the_free_body():
    parameters, attitude, omega, time = rows("no gravity")
    for x, q, w, t in zip(parameters[:8], attitude, omega, time, strict=False):
        found = state_at(x, q, w, t)
        free = jr.free_rotation(np.array([x[0], x[0], x[1]]), jr.State(q, w), t)
        bound = 1e-13 * (1 + np.linalg.norm(w) * abs(t)) * max(1, np.max(np.abs(w)))
        sign = np.sign(np.sum(found[:4] * free.attitude))
        np.testing.assert_allclose(sign * found[:4], free.attitude, atol=bound)
        np.testing.assert_allclose(found[4:], free.omega, atol=bound)


@pytest.mark.parametrize("mgl", [1.0, -1.0])
def test_a_fall_that_begins_very_near_upright_goes_through(mgl):
    """At any time the motion obeys Euler's equations, and it comes down."""
    top = jr.SymmetricTop(1.0, 0.5, mgl)
    tilt = 1e-25
    attitude = (
        np.array([1.0, 0.5 * tilt, 0, 0])
        if mgl > 0
        else np.array([0.5 * tilt, 1.0, 0, 0])
    )
    body = top.as_rigid_body()
    vector_field = quick_jit(lambda body, state: body.vector_field(0.0, state, None))
    x = np.array([1.0, 0.5, mgl])
    growth = np.sqrt(1 - 0.25**2)
    lowest = 1.0
    for t in np.linspace(0.93, 1.1, 13) * np.log(4 / tilt) / growth:
        state, found = state_and_rate(x, attitude, np.array([0.0, 0.0, 1.0]), float(t))
        exact = vector_field(body, jr.State(state[:4], state[4:]))
        np.testing.assert_allclose(found[4:], exact.omega, atol=1e-12)
        np.testing.assert_allclose(found[:4], exact.attitude, atol=1e-12)
        height = np.sign(mgl) * (1 - 2 * (state[1] ** 2 + state[2] ** 2))
        lowest = min(lowest, float(height))
    assert lowest < -0.5


# --- Derivatives
# --------------------------------------------------------------------------------


def test_derivatives_equal_the_variational_equations(compiled):
    """Over 20 units of time of either sign, and 200 of what is stable."""
    inputs, regimes, exact = (SLOPES[name] for name in ("inputs", "regime", "jacobian"))
    lanes = inputs[:, 7:], inputs[:, :4], inputs[:, 4:7], SLOPES["duration"]
    found = compiled["jacobians"](*lanes)
    # The package normalises the attitude, the reference does not.
    tangent = np.tile(np.eye(10), (len(inputs), 1, 1))
    tangent[:, :4, :4] -= inputs[:, :4, None] * inputs[:, None, :4]
    exact = np.einsum("nij,njk->nik", exact, tangent)
    size = np.linalg.norm(exact, axis=(1, 2))
    for one in found:
        relative = np.linalg.norm(one - exact, axis=(1, 2)) / size
        assert np.all(relative <= 1e-9), dict(zip(regimes, relative, strict=True))
    assert set(regimes) == set(REGIMES) - {"slow units", "fast units"}
    assert np.sum(SLOPES["duration"] == -200) >= 20


def test_stored_derivatives_are_those_of_the_variational_equations():
    """A few rows again, over a shorter time, beside differences of the 30-digit
    motion."""
    x = np.array([0.5, -0.1, 0.7, 0.5, 0.3, -0.4, 0.6, 1.5, 0.5, 0.75])
    x[:4] /= np.linalg.norm(x[:4])
    lever = np.array([[0.0, 0.0, x[9]]])
    moments = np.array([[x[7], x[7], x[8]]])
    _, full = reference.heavy_body(moments, x[None, :4], x[None, 4:7], 2.0, lever)

    def motion(z):
        q, w = taylor_top(z[1], z[2], z[3], x[:4], [z[0], x[5], x[6]], 2.0)
        return np.array([*q, *w], float)

    columns = [
        full[0, :, 4],
        full[0, :, 7] + full[0, :, 8],
        full[0, :, 9],
        full[0, :, 12],
    ]
    for k, column in enumerate(columns):
        slope = central_difference(motion, x[[4, 7, 8, 9]], np.eye(4)[k], 2.0**-17)
        np.testing.assert_allclose(column.astype(float), slope, atol=1e-9)


SPECIAL = {
    "generic": ([1.0, 0.5, 1.0], ATTITUDE, OMEGA),
    "sleeping": ([1.0, 0.5, 1.0], [1.0, 0, 0, 0], [0, 0, 4.5]),
    "threshold": ([1.0, 0.5, 1.0], [1.0, 0, 0, 0], [0, 0, 4.0]),
    "falling": ([1.0, 0.5, 1.0], [0.6, 0, 0, 0.8], [0, 0, 2.0]),
    "hanging": ([1.0, 0.5, 1.0], [0.0, 1, 0, 0], [0, 0, 1.0]),
    "upright, mgl < 0": ([1.0, 0.5, -1.0], [1.0, 0, 0, 0], [0, 0, 1.0]),
    "no gravity": ([1.0, 0.5, 0.0], ATTITUDE, OMEGA),
    "rest": ([1.0, 0.5, 0.0], ATTITUDE, [0.0, 0, 0]),
    "pendulum": ([1.0, 0.5, 1.0], [0.8, 0.6, 0, 0], [0.5, 0, 0]),
}


@pytest.mark.parametrize("name", SPECIAL)
def test_second_derivatives_are_differences_of_the_first(name):
    parameters, attitude, omega = (np.asarray(v, float) for v in SPECIAL[name])
    x = np.concatenate([parameters, attitude / np.linalg.norm(attitude), omega, [3.0]])
    v = np.append(np.random.default_rng(4).normal(size=10), 0.0)
    *_, found = along(x, v)
    h = 1e-3
    firsts = [np.asarray(along(x + s * v, v)[1]) for s in (h, -h, 2 * h, -2 * h)]
    slope = (8 * (firsts[0] - firsts[1]) - (firsts[2] - firsts[3])) / (12 * h)
    np.testing.assert_allclose(found, slope, atol=1e-8 * max(1, np.max(np.abs(slope))))


def test_derivative_in_time_is_euler_s_equation():
    top = jr.SymmetricTop(1.3, 0.7, 0.9)
    attitude = ATTITUDE / np.linalg.norm(ATTITUDE)
    for t in (0.7, 40.0):
        _, found = state_and_rate(np.array([1.3, 0.7, 0.9]), attitude, OMEGA, t)
        state = jr.top_motion(top, jr.State(attitude, OMEGA), t).states
        exact = top.as_rigid_body().vector_field(t, state, None)
        np.testing.assert_allclose(found[:4], exact.attitude, atol=1e-13)
        np.testing.assert_allclose(found[4:], exact.omega, atol=1e-13)


# --- float32, shapes, modes
# ---------------------------------------------------------------------

FLOAT32_MULTIPLE = 32


@pytest.mark.parametrize("regime", [r for r in REGIMES if "units" not in r])
def test_float32_within_a_multiple_of_its_eps(regime, compiled):
    parameters, attitude, omega, time = (x.astype(np.float32) for x in rows(regime))
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    found = compiled["value"](parameters, attitude, omega, time)
    assert found.dtype == np.float32
    wide = [x.astype(float) for x in (parameters, attitude, omega, time)]
    exact = compiled["value"](*wide)
    rate = rates(wide[0], wide[2])[:, None]
    error = np.abs(found - exact) / np.concatenate(
        [0 * rate + np.ones(4), rate + np.zeros(3)], 1
    )
    columns = np.split(compiled["jacobians"](*wide)[0], [4, 7], axis=2)
    scaled = sum(np.linalg.norm(c, axis=(1, 2)) for c in columns) / np.minimum(
        1, rate[:, 0]
    )
    eps = float(np.finfo(np.float32).eps)
    bar = FLOAT32_MULTIPLE * eps * (1 + rate[:, 0] * np.abs(wide[3]))
    # Where the motion does not amplify its inputs' last bits.
    calm = scaled < 30 * (1 + rate[:, 0] * np.abs(wide[3]))
    assert np.mean(calm) > (0.2 if regime in UNSTABLE else 0.5)
    assert np.all(np.isfinite(found))
    assert np.all(np.max(error, axis=1)[calm] <= bar[calm]), np.max(
        (np.max(error, 1) / bar)[calm]
    )


def test_times_of_any_shape_and_the_time_of_the_start():
    top, state = jr.SymmetricTop(1.0, 0.5, 1.0), jr.State(ATTITUDE, OMEGA)
    times = np.linspace(-3, 5, 6).reshape(2, 3)
    motion = jr.top_motion(top, state, times, t0=1.5)
    assert motion.attitude.shape == (2, 3, 4)
    assert motion.omega.shape == (2, 3, 3)
    single = jr.top_motion(top, state, float(times[1, 2]) - 1.5)
    np.testing.assert_allclose(motion.omega[1, 2], single.omega, atol=ulps(float, 8))
    assert jr.top_motion(top, state, np.zeros((0,))).omega.shape == (0, 3)


# --- Bad input
# ----------------------------------------------------------------------------------

GOOD = {
    "I1": 1.0,
    "I3": 0.5,
    "mgl": 1.0,
    "q": np.eye(4)[0],
    "w": OMEGA,
    "t": 1.0,
    "t0": 0.0,
}
BAD = {
    "negative I1": (
        "I1",
        -1.0,
        "invalid_top",
        r"`top` must have I1 > 0.*: \[-1\. +0\.5 +1\. *\]",
    ),
    "I3 zero": ("I3", 0.0, "invalid_top", "`top` must have I1 > 0, I3 > 0"),
    "I3 infinite": ("I3", np.inf, "invalid_top", "`top` must have I1 > 0, I3 > 0"),
    "mgl NaN": ("mgl", np.nan, "invalid_top", "finite mgl, but it has not: .*nan"),
    "omega infinite": (
        "w",
        np.array([np.inf, 0, 0]),
        "invalid_state",
        "`state0` .*finite.*inf",
    ),
    "attitude of norm 2": (
        "q",
        2 * np.eye(4)[0],
        "invalid_attitude",
        r"unit quaternion.*\[2\. 0",
    ),
    "time NaN": (
        "t",
        np.nan,
        "invalid_times",
        "`ts` must be finite, but it is not: nan",
    ),
    "start infinite": (
        "t0",
        np.inf,
        "invalid_times",
        "`t0` must be finite, but it is not: inf",
    ),
}


def motion_of(I1, I3, mgl, q, w, t, t0, throw=False):
    top = jr.SymmetricTop.unchecked(I1, I3, mgl)
    return jr.top_motion(top, jr.State(q, w), t, t0=t0, throw=throw)


@pytest.fixture(scope="module")
def in_lanes():
    """All bad inputs, each a lane, and the good one as the last."""
    inputs = [{**GOOD, name: value} for name, value, _, _ in BAD.values()] + [GOOD]
    lanes = jax.tree.map(
        lambda *x: jnp.stack([jnp.asarray(y, float) for y in x]), *inputs
    )
    return lanes, jax.vmap(lambda x: motion_of(**x))(lanes)


@pytest.mark.parametrize("name", BAD)
def test_bad_values_are_errors_with_a_code(name, in_lanes):
    changed, value, code, message = BAD[name]
    with pytest.raises(RuntimeError, match=message):
        motion_of(**{**GOOD, changed: value}, throw=True)
    lane = list(BAD).index(name)
    _, motion = in_lanes
    assert np.all(np.isnan(motion.attitude[lane]))
    assert np.all(np.isnan(motion.omega[lane]))
    codes = motion.result == getattr(jr.RESULTS, code)
    assert codes[lane]
    assert not codes[-1]


def test_a_good_lane_among_bad_ones_is_as_alone_and_the_first_is_named(in_lanes):
    lanes, motion = in_lanes
    alone = motion_of(**GOOD, throw=True)
    np.testing.assert_allclose(
        motion.attitude[-1], alone.attitude, rtol=0, atol=ulps(float, 4)
    )
    np.testing.assert_allclose(
        motion.omega[-1], alone.omega, rtol=0, atol=ulps(float, 4)
    )
    assert (motion.result == jr.RESULTS.successful)[-1]
    assert alone.result == jr.RESULTS.successful
    with pytest.raises(RuntimeError, match=f"in lane 0 and {len(BAD) - 1} more"):
        jax.vmap(lambda x: motion_of(**x, throw=True))(lanes)


def test_inside_jit_the_error_names_the_argument():
    omega = quick_jit(lambda x: motion_of(**x, throw=True).omega)
    with pytest.raises(RuntimeError, match="`top` must have I1 > 0"):
        jax.block_until_ready(omega({**GOOD, "I1": -1.0}))


def test_a_bad_lane_leaves_the_others_and_shared_gradients_alone():
    def total(i1, omegas):
        def one(omega):
            state = jr.top_motion(
                jr.SymmetricTop(i1, 0.5, 1.0),
                jr.State(np.eye(4)[0], omega),
                2.0,
                throw=False,
            )
            return jnp.where(jnp.isnan(state.omega), 0.0, state.omega)

        return jnp.sum(jax.vmap(one)(omegas))

    both = quick_jit(jax.value_and_grad(total))
    found = both(1.0, np.array([OMEGA, [np.nan, 0, 0], 2 * OMEGA]))
    good = [both(1.0, np.array([OMEGA, k * OMEGA, 2 * OMEGA])) for k in (1, 2)]
    # 2 a + b and a + 2 b
    np.testing.assert_allclose(found, np.sum(good, axis=0) / 3, rtol=1e-13)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            (np.array([1.0, 1.0, 0.5]), jr.State(np.eye(4)[0], OMEGA), 1.0),
            "`top` must be a Symm",
        ),
        ((jr.SymmetricTop(1.0, 0.5, 1.0), OMEGA, 1.0), "`state0` must be a State"),
        (
            (jr.SymmetricTop(1.0, 0.5, 1.0), jr.State(np.eye(3)[0], OMEGA), 1.0),
            "shape \\(4,\\)",
        ),
    ],
)
def test_wrong_shapes_and_types_are_value_errors(arguments, message, untyped):
    with pytest.raises(ValueError, match=message):
        jr.top_motion(*arguments)


def test_a_top_of_arrays_is_a_value_error(untyped):
    with pytest.raises(ValueError, match="`I1` must have shape"):
        jr.SymmetricTop(np.ones(2), 0.5, 1.0)


def test_integrals_of_a_body_without_a_torque_and_of_a_symmetric_top():
    state = jr.State(jnp.array([0.6, 0.0, 0.8, 0.0]), jnp.array([1.0, 2.0, 3.0]))
    body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    found = jr.top.integrals(body, state, "euler")
    momentum = np.array([1.0, 4.0, 9.0])
    assert float(found.extra) == pytest.approx(momentum @ momentum, rel=1e-15)
    assert float(found.energy) == pytest.approx(18, rel=1e-15)
    assert float(found.vertical_momentum) == 0
    top = jr.SymmetricTop(1.0, 0.5, 2.0)
    found = jr.top.integrals(top, state, "lagrange")
    conserved = jr.top.conserved(top, state)
    assert float(found.extra) == pytest.approx(1.5, rel=1e-15)
    assert float(found.energy) == pytest.approx(float(conserved.energy), rel=1e-14)
