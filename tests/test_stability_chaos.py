"""Order and chaos: exponents, the indicator, sections, flips,
and where a damped body ends."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import MOMENTS, quick_jit
from scipy.integrate import solve_ivp

import jrigid as jr
from jrigid import stability as st

UP = np.array([1.0, 0.0, 0.0, 0.0])
DOWN = np.array([0.0, 0.0, -1.0])
TURN = 2 * np.pi
# A heavy top without symmetry, and a state from which it is chaotic.
HEAVY = (np.array([1.0, 1.5, 0.7]), np.array([0.3, 0.1, 0.5]))
FIRST = lambda _, s: s.omega[0]  # noqa: E731
TILTED, SPINNING = np.array([1.2, 0.0, 0.0]), np.array([0.3, 0.2, 0.8])


def heavy(moments, lever):
    return jr.RigidBody(moments, jr.torques.UniformGravity(1.0, lever, DOWN))


def kovalevskaya():
    return heavy(np.array([2.0, 2.0, 1.0]), np.array([0.5, 0.0, 0.0]))


def state(turn, omega):
    return jr.State(jr.rotation.exp(jnp.asarray(turn)), jnp.asarray(omega))


def hyperion(eccentricity=0.1):
    """Moments of (B - A)/C = 0.26, axis 3 along the normal of the orbit, n = 1."""
    moments = jnp.array([0.7, 0.96, 1.0])
    orbit = jr.torques.KeplerOrbit(1.0, 1.0, eccentricity)
    return jr.RigidBody(moments, jr.torques.GravityGradient(1.0, orbit))


def spectrum_of_heavy(lanes, count):
    """Exponents of motions of one energy and one momentum about the vertical,
    to T = 1200."""
    rng = np.random.default_rng(3)
    turns = 1e-6 * rng.normal(size=(lanes, 3))
    body = heavy(*HEAVY)

    @jax.jit
    @jax.vmap
    def lane(turn):
        q = jr.rotation.multiply(
            jr.rotation.exp(turn), jr.rotation.exp(jnp.asarray(TILTED))
        )
        start = jr.State(q, jnp.asarray(SPINNING))
        return st.lyapunov_spectrum(body, start, 1200.0, 9600, count=count, throw=False)

    return turns, lane(turns)


# Tangents


def spinning_satellite():
    """Its wheel makes it nutate 22 times an orbit."""
    pull = jr.torques.GravityGradient(1.0, jr.torques.KeplerOrbit(1.0, 1.0, 0.0))
    wheel = jr.torques.Rotor(jnp.array([0.0, 0.0, 30.0]))
    return jr.RigidBody(jnp.array([1.0, 2.0, 2.5]), pull + wheel)


def test_steps_too_coarse_for_small_motions_alone_are_refused():
    """In a relative equilibrium the motion has no error in any step."""
    body, start = spinning_satellite(), state([0, 0, 0], [0, 0, 1.0])
    with pytest.raises(RuntimeError, match="fine enough"):
        st.megno(body, start, 50 * TURN, 24 * 50)
    fine = st.megno(body, start, 50 * TURN, 200 * 50)
    assert abs(float(fine.megno)) < 0.01
    damper = jr.torques.InternalDamper(0.001, 0.2)
    body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]), damper)
    coarse = st.lyapunov_spectrum(body, start, 20.0, 1000, throw=False)
    assert coarse.result == jr.RESULTS.inaccurate
    fine = st.lyapunov_spectrum(body, start, 20.0, 4000)
    rates = jr.stability.linearize(body, start).matrix
    np.testing.assert_allclose(fine.exponents.sum(), np.trace(rates), rtol=1e-6)


def test_small_motions_that_become_parallel_are_refused():
    lever = jnp.array([0.1, 0.2, 1.0])
    torque = jr.torques.UniformGravity(1.0, lever, jnp.array([0.0, 0.0, -1.0]))
    body = jr.RigidBody(jnp.array([1.0, 1.5, 0.7]), torque)
    start = state([1.2, 0, 0], [0.3, 0.2, 0.8])

    def found(every):
        return st.lyapunov_spectrum(
            body, start, 800.0, 6400, every=every, samples=1, throw=False
        )

    assert abs(float(found(100).exponents.sum())) < 1e-9
    assert found(1600).result == jr.RESULTS.inaccurate


def test_vectors_of_a_slow_body_are_told_apart_in_its_own_scale():
    """In SI units they differ by less than what single precision counts as apart."""
    rate = np.float32(3.7e-5)
    sphere = jr.RigidBody(np.ones(3, np.float32))
    start = jr.State(np.eye(1, 4, dtype=np.float32)[0], rate * np.float32([0, 0, 1]))
    vectors = np.float32([[0, 0, 1, 0, 0, 0], [0, 0, 1, 0, 0, 3e-5]])
    found = st.lyapunov_spectrum(
        sphere, start, np.float32(1e5), 200, vectors=vectors, throw=False
    )
    assert found.result == jr.RESULTS.successful
    assert np.all(np.isfinite(found.exponents))


@pytest.mark.parametrize("rate", [0.3, 1.0, 3.9])
def test_vectors_are_in_radians_and_radians_a_second(rate):
    """A free sphere turns by a change of its rate times the time."""
    vector = np.array([0.0, 0.0, 1.0, 0.0, 0.0, rate])
    sphere, start = jr.RigidBody(jnp.ones(3)), state([0, 0, 0], [0, 0, rate])
    found = st.lyapunov_spectrum(
        sphere, start, 2.0, 100, vectors=vector[None], every=100, samples=1
    )
    growth = float(np.exp(2.0 * found.exponents[0]))
    units = 2.0 ** np.arange(-6, 7)
    before, after = (np.hypot(x, rate / units) for x in (1.0, 1.0 + 2.0 * rate))
    # One of the powers of two near the rate is the unit of the length.
    assert (
        np.min(np.abs(after / before - growth)[np.abs(np.log2(units / rate)) < 2])
        < 1e-9
    )


@pytest.mark.parametrize("damped", [False, True])
def test_growth_is_that_of_neighbours_of_the_motion(damped, rng):
    """Over a short time a small motion's growth is the difference of two motions,
    to first order.

    The rate is between 1/2 and 1, where its scale is 1.
    """
    torque = jr.torques.UniformGravity(1.0, HEAVY[1], 0.3 * DOWN)
    if damped:
        torque = torque + jr.torques.InternalDamper(0.3, 0.2)
    body = jr.RigidBody(HEAVY[0], torque)
    start = state(TILTED, [0.3, 0.2, 0.6])
    size = 9 if damped else 6
    vectors = rng.normal(size=(3, size)) + 2 * np.eye(3, size)
    found = st.lyapunov_spectrum(
        body, start, 4.0, 60, vectors=vectors, every=60, samples=1
    )

    def after(x):
        q = jr.rotation.multiply(start.attitude, jr.rotation.exp(x[:3]))
        internal = (start.omega + x[6:],) if damped else ()
        moved = jr.State(q, start.omega + x[3:6], internal)
        return jr.simulate(body, moved, 4.0, rtol=1e-12).states

    reference, h = after(jnp.zeros(size)), 1e-5
    rows = np.linalg.qr(vectors.T)[0].T
    columns = []
    for row in rows:
        ends = []
        for sign in (1, -1):
            end = after(sign * h * jnp.asarray(row))
            turn = jr.rotation.multiply(
                jr.rotation.conjugate(reference.attitude), end.attitude
            )
            parts = [jr.rotation.log(turn), end.omega - reference.omega]
            if damped:
                parts.append(end.internal[0] - reference.internal[0])
            ends.append(np.concatenate(parts))
        columns.append((ends[0] - ends[1]) / (2 * h))
    lengths = np.abs(np.diagonal(np.linalg.qr(np.array(columns).T)[1]))
    np.testing.assert_allclose(
        np.exp(4.0 * np.asarray(found.exponents)), lengths, rtol=1e-7
    )
    np.testing.assert_allclose(found.final_state.omega, reference.omega, atol=1e-9)


# Order


@pytest.mark.parametrize(
    ("body", "start"),
    [
        (jr.RigidBody(MOMENTS), state([0.3, 0.2, 0.1], [0.5, 0.3, 0.8])),
        (jr.RigidBody(MOMENTS), state([0.3, 0.2, 0.1], [0.02, 1.0, 0.01])),
        (
            jr.SymmetricTop(1.0, 0.6, 1.0).as_rigid_body(),
            state([0.9, 0.0, 0.0], [0.1, 0.4, 3.0]),
        ),
        (kovalevskaya(), state([0.9, 0.4, 0.0], [0.3, 0.5, 0.9])),
    ],
    ids=["free", "near the separatrix", "Lagrange", "Kovalevskaya"],
)
def test_integrable_bodies_are_regular_and_their_exponents_vanish_like_log_t_over_t(
    body, start
):
    times = np.array([250.0, 1000.0, 4000.0])
    found = st.lyapunov_spectrum(body, start, times[-1], 32_000, samples=16)
    largest = np.asarray(found.history)[:, 0][[0, 3, 15]]
    # A small motion grows in proportion to the time: its logarithm over the time.
    np.testing.assert_array_less(np.abs(largest), 2.5 * np.log(times) / times)
    assert largest[2] < 0.6 * largest[0]
    assert np.abs(np.sum(found.exponents)) < 1e-6
    np.testing.assert_allclose(
        found.exponents, -found.exponents[::-1], atol=5 / times[-1]
    )
    indicator = st.megno(body, start, times[-1], 32_000)
    assert st.ORDER[indicator.order] == "regular"
    assert 1.5 < float(indicator.megno) < 2.2


@pytest.mark.parametrize("every", [10, 100, 5000])
def test_a_megno_does_not_depend_on_how_often_growth_is_measured(every):
    """Of one measurement it would be 10, and of five 4.4."""
    body, start = jr.RigidBody(MOMENTS), state([0.0, 0.0, 0.0], [0.5, 0.3, 0.8])
    found = st.megno(body, start, 1000.0, 5000, every=every, samples=1)
    assert 1.7 < float(found.megno) < 2.2
    assert st.ORDER[found.order] == "regular"


def test_exponents_without_damping_pair_to_zero():
    _, found = spectrum_of_heavy(32, 6)
    mean = np.asarray(found.exponents).mean(axis=0)
    assert mean[0] > 0.15
    np.testing.assert_allclose(mean, -mean[::-1], atol=0.003)
    # Energy and the momentum about the vertical are constant: four exponents are zero.
    np.testing.assert_array_less(np.abs(mean[1:5]), 2.5 * np.log(1200.0) / 1200.0)
    np.testing.assert_allclose(np.asarray(found.exponents).sum(axis=1), 0, atol=1e-6)


def euler_poisson(y, moments, lever):
    """Rates of (omega, up in the body), (6,) or (6, lanes):
    another way to write the heavy top."""
    (i, j, k), (r, s, t) = moments.tolist(), lever.tolist()
    a, b, c, x, y, z = y
    return np.array(
        [
            ((j - k) * b * c - s * z + t * y) / i,
            ((k - i) * c * a - t * x + r * z) / j,
            ((i - j) * a * b - r * y + s * x) / k,
            y * c - z * b,
            z * a - x * c,
            x * b - y * a,
        ]
    )


@pytest.mark.slow  # half a minute of running
def test_exponent_of_an_asymmetric_top_by_two_trajectories():
    """Neighbours 1e-8 apart, drawn together again and again, by Runge-Kutta in numpy:
    to 2 %.

    The means of 256 motions: each is uncertain by 0.4 %.
    """
    lanes = 256
    turns, found = spectrum_of_heavy(lanes, 1)
    moments, lever = HEAVY
    q = jax.vmap(
        lambda t: jr.rotation.multiply(
            jr.rotation.exp(t), jr.rotation.exp(jnp.asarray(TILTED))
        )
    )(turns)
    up = np.asarray(
        jax.vmap(lambda q: jr.rotation.rotate_inverse(q, jnp.array([0.0, 0, 1])))(q)
    )
    y = np.concatenate([np.broadcast_to(SPINNING, up.shape), up], axis=1).T
    near = y + 1e-8 * np.random.default_rng(0).normal(size=y.shape)
    y, step, total = np.concatenate([y, near], axis=1), 0.03, np.zeros(lanes)
    steps = int(1200 / step)
    for i in range(steps):
        a = euler_poisson(y, moments, lever)
        b = euler_poisson(y + 0.5 * step * a, moments, lever)
        c = euler_poisson(y + 0.5 * step * b, moments, lever)
        d = euler_poisson(y + step * c, moments, lever)
        y = y + step / 6 * (a + 2 * b + 2 * c + d)
        if i % 50 == 49:
            apart = y[:, lanes:] - y[:, :lanes]
            distance = np.linalg.norm(apart, axis=0)
            if i > 500:  # once they lie along the fastest direction
                total += np.log(distance / 1e-8)
            y[:, lanes:] = y[:, :lanes] + 1e-8 * apart / distance
    theirs = total / (step * (steps - 500))
    ours = np.asarray(found.exponents)[:, 0]
    assert theirs.mean() == pytest.approx(ours.mean(), rel=0.02)


# Hyperion


CHAOTIC = np.array([[0.0, 1.3], [np.pi / 2, 1.5], [0.0, 1.8], [np.pi / 2, 1.0]])
REGULAR = np.array([[np.pi / 2, 0.5], [0.0, 0.5], [np.pi / 2, 2.3], [0.3, 2.9]])


@functools.cache
def planar(orbits):
    """Exponents and indicator of motions in the plane of the orbit,
    from the pericentre.

    16 motions that are said to be chaotic, then 8 regular ones.
    """
    body = hyperion()
    plane = np.array([[0, 0, 1.0, 0, 0, 0], [0, 0, 0, 0, 0, 1.0]])
    starts = np.concatenate([np.tile(CHAOTIC, (4, 1)), np.tile(REGULAR, (2, 1))])
    starts[:16, 0] += 1e-6 * np.arange(16)
    starts[16:, 0] += 1e-3 * np.arange(8)

    @jax.jit
    @jax.vmap
    def lane(start):
        axis = jnp.array([0.0, 0.0, 1.0])
        start = jr.State(jr.rotation.exp(axis * start[0]), axis * start[1])
        time, steps = TURN * orbits, 50 * orbits
        spectrum = st.lyapunov_spectrum(
            body, start, time, steps, vectors=plane, throw=False
        )
        indicator = st.megno(
            body, start, time, steps, vector=plane[0] + plane[1], throw=False
        )
        return spectrum, indicator

    found = lane(starts)
    return [
        jax.tree.map(lambda x, s=s: np.asarray(x)[s], found)
        for s in (slice(16), slice(16, 24))
    ]


@pytest.mark.slow  # a map in full size
def test_hyperion_is_chaotic_where_it_is_said_to_be():
    """... and stays in its plane, for 250 orbits."""
    spectrum, indicator = planar(250)[0]
    exponents = spectrum.exponents
    assert np.all(exponents[:, 0] > 0.02)
    assert 1 < 1 / np.median(exponents[:, 0]) / TURN < 2
    np.testing.assert_allclose(exponents.sum(axis=1), 0, atol=1e-7)
    assert np.all(indicator.order._value == st.ORDER.chaotic._value)
    # It stays in the plane to the last bit, as the planar equation does.
    assert np.all(spectrum.final_state.omega[:, :2] == 0)


@pytest.mark.slow
def test_exponent_of_hyperion_is_the_published_one():
    """Wisdom, Peale & Mignard (1984): a large chaotic zone,
    e-folding in one to two orbits.

    Motions stick to islands now and then, so that the median of 16 is what is compared.
    """
    spectrum, indicator = planar(1000)[0]
    exponents = spectrum.exponents
    assert np.all((exponents[:, 0] > 0.02) & (exponents[:, 0] < 0.16))
    median = np.median(exponents[:, 0])
    assert 0.11 < median < 0.132  # 0.12 to 0.13 in another's computation
    assert 1 < 1 / median / TURN < 2
    np.testing.assert_allclose(exponents.sum(axis=1), 0, atol=1e-7)
    assert np.all(indicator.order._value == st.ORDER.chaotic._value)
    assert np.median(indicator.exponent) == pytest.approx(median, rel=0.1)
    assert np.all(spectrum.final_state.omega[:, :2] == 0)


@pytest.mark.parametrize(
    ("orbits", "least"),
    [(250, 0.009), pytest.param(1000, 0.003, marks=pytest.mark.slow)],
)
def test_regular_islands_of_hyperion_are_regular(orbits, least):
    spectrum, indicator = planar(orbits)[1]
    assert np.all(spectrum.exponents[:, 0] < least)
    assert np.all(indicator.order._value == st.ORDER.regular._value)


def test_planar_hyperion_is_the_pendulum_on_an_ellipse():
    """theta'' = -(3/2) (B - A)/C (a/r)^3 sin 2(theta - f), by scipy."""

    def field(t, y):
        mean = np.remainder(t + np.pi, TURN) - np.pi
        anomaly = mean
        for _ in range(50):
            anomaly -= (anomaly - 0.1 * np.sin(anomaly) - mean) / (
                1 - 0.1 * np.cos(anomaly)
            )
        r = 1 - 0.1 * np.cos(anomaly)
        f = np.arctan2(np.sqrt(0.99) * np.sin(anomaly), np.cos(anomaly) - 0.1)
        return [y[1], -1.5 * 0.26 / r**3 * np.sin(2 * (y[0] - f))]

    theirs = solve_ivp(field, (0, 30.0), [0.4, 1.2], rtol=1e-11, atol=1e-12).y[:, -1]
    ours = st.megno(hyperion(), state([0, 0, 0.4], [0, 0, 1.2]), 30.0, 600).final_state
    assert float(ours.omega[2]) == pytest.approx(theirs[1], abs=1e-8)
    turned = 2 * np.arctan2(ours.attitude[3], ours.attitude[0])
    assert np.abs(np.exp(1j * (float(turned) - theirs[0])) - 1) < 1e-8


def test_hyperion_out_of_its_plane_tumbles_in_three_dimensions():
    """Two exponents of about 0.1 n and a spectrum that pairs (Wisdom, Peale & Mignard,
    fig. 8)."""
    start = state([0.01, 0.02, 0.3], [0.02, 0.01, 1.3])
    found = quick_jit(
        lambda s: st.lyapunov_spectrum(hyperion(), s, TURN * 600, 36_000, throw=False)
    )(start)
    exponents = np.asarray(found.exponents)
    assert 0.06 < exponents[0] < 0.16
    np.testing.assert_allclose(exponents, -exponents[::-1], atol=0.006)


# Sections, flips, final states


def test_crossings_are_those_of_scipy_and_keep_the_energy():
    body, start = heavy(*HEAVY), state(TILTED, SPINNING)
    found = st.poincare_section(body, start, FIRST, 12, 0.1)
    assert found.valid.all()
    energy = jax.vmap(lambda s: body.energy(0.0, s, None))(found.states)
    np.testing.assert_allclose(energy, body.energy(0.0, start, None), rtol=1e-8)
    assert np.abs(found.states.omega[:, 0]).max() < 1e-8
    up = np.asarray(
        jr.rotation.rotate_inverse(start.attitude, jnp.array([0.0, 0.0, 1.0]))
    )

    def rises(_, y):
        return y[0]

    rises.direction = 1
    y0 = np.concatenate([SPINNING, up])
    theirs = solve_ivp(
        lambda _, y: euler_poisson(y, *HEAVY),
        (0, float(found.ts[-1]) + 0.1),
        y0,
        method="DOP853",
        rtol=1e-12,
        atol=1e-13,
        events=rises,
    ).t_events[0]
    np.testing.assert_allclose(
        found.ts[:7], theirs[:7], atol=1e-6
    )  # later they part: chaos


def test_crossings_in_either_direction_and_those_there_are_not():
    body, start = jr.RigidBody(MOMENTS), state([0.0, 0.0, 0.0], [0.5, 0.3, 0.8])
    period = float(jr.free.polhode_period(MOMENTS, start.omega))
    up = st.poincare_section(body, start, FIRST, 4, 0.1)
    down = st.poincare_section(body, start, FIRST, 4, 0.1, direction=False)
    both = st.poincare_section(body, start, FIRST, 8, 0.1, direction=None)
    np.testing.assert_allclose(np.diff(up.ts), period, rtol=1e-8)
    np.testing.assert_allclose(
        np.sort(np.concatenate([up.ts, down.ts])), both.ts, atol=1e-8
    )
    none = st.poincare_section(
        body, start, lambda _, s: s.omega[0] - 9, 3, 0.1, steps=50
    )
    assert not none.valid.any()
    assert np.isnan(none.ts).all()


def test_a_condition_that_is_no_floating_point_number_is_refused():
    """A boolean has no zero at which a crossing could be located."""
    body, start = jr.RigidBody(MOMENTS), state([0.0, 0.0, 0.0], [-0.5, 0.3, 0.8])
    for condition in (lambda _, s: s.omega[0] > 0, lambda _, s: jnp.int32(s.omega[0])):
        with pytest.raises(ValueError, match="must return a floating point number"):
            st.poincare_section(body, start, condition, 3, 0.1)


def test_sections_of_many_lanes_and_of_starts_on_the_surface():
    body = jr.RigidBody(MOMENTS)

    def lane(omega):
        start = jr.State(jnp.asarray(UP), omega)
        return st.poincare_section(
            body, start, lambda _, s: s.omega[0], 2, 0.1, steps=300, throw=False
        )

    omegas = np.array(
        [[0.5, 0.3, 0.8], [1, 0.1, 0.1], [np.nan, 0, 0], [0, -0.583, 0.746]]
    )
    found = jax.jit(jax.vmap(lane))(omegas)
    assert found.valid.tolist() == [
        [True, True],
        [False, False],
        [False, False],
        [True, True],
    ]
    assert bool((found.result == jr.RESULTS.invalid_state)[2])
    assert np.isnan(found.ts[1:3]).all()
    for i in (0, 3):
        period = float(jr.free.polhode_period(MOMENTS, omegas[i]))
        np.testing.assert_allclose(np.diff(found.ts[i]), period, rtol=1e-8)
    np.testing.assert_allclose(
        found.ts[3, 0], period, rtol=1e-8
    )  # not the start itself
    single = jr.State(UP.astype(np.float32), omegas[0].astype(np.float32))
    small = jr.RigidBody(MOMENTS.astype(np.float32))
    found = st.poincare_section(small, single, lambda _, s: s.omega[0], 2, 0.1)
    assert found.states.omega.dtype == np.float32
    assert found.valid.all()


@pytest.mark.parametrize("direction", [None, True])
def test_a_start_on_the_surface_at_rest_is_no_crossing(direction):
    """A pendulum that is let go returns to where it was after its period."""
    down = jnp.array([0.0, 0.0, -1.0])
    pendulum = jr.RigidBody(
        jnp.array([1.0, 1.0, 0.2]), jr.torques.UniformGravity(1.0, down, down)
    )
    angle = 0.8
    start = jr.State(
        jr.rotation.from_axis_angle(jnp.array([1.0, 0.0, 0.0]), angle), jnp.zeros(3)
    )
    level = float(start.attitude[1])

    def condition(_, state):
        return state.attitude[1] - 0.5 * level

    def at_start(_, state):
        return state.attitude[1] - level

    found = st.poincare_section(
        pendulum, start, condition, 2, 0.05, steps=400, direction=False
    )
    period = float(np.diff(found.ts)[0])
    exact = 4 * float(jr.elliptic.ellipk(np.sin(angle / 2) ** 2))
    np.testing.assert_allclose(period, exact, rtol=1e-7)
    again = st.poincare_section(
        pendulum, start, at_start, 1, 0.05, steps=150, direction=direction, throw=False
    )
    assert not again.valid.any() or again.ts[0] > 0.9 * period, again.ts


def test_float32_times_that_cannot_be_told_apart_are_refused():
    body = jr.RigidBody(MOMENTS.astype(np.float32))
    omega = np.array([0.5, 0.3, 0.8], np.float32)
    start = jr.State(UP.astype(np.float32), omega)
    found = st.poincare_section(
        body, start, lambda _, s: s.omega[0], 2, 0.1, t0=1e9, throw=False
    )
    assert found.result == jr.RESULTS.unresolved_times


@pytest.mark.parametrize("unit", [1e-7, 1e4])
def test_nothing_depends_on_the_unit_of_time(unit):
    body, omega = jr.RigidBody(MOMENTS), unit * np.array([0.5, 0.3, 0.8])
    start = jr.State(UP, omega)
    found = st.poincare_section(body, start, FIRST, 4, 0.1 / unit)
    period = float(jr.free.polhode_period(MOMENTS, omega))
    np.testing.assert_allclose(np.diff(found.ts), period, rtol=1e-10)
    indicator = st.megno(body, start, 1000.0 / unit, 5000)
    assert st.ORDER[indicator.order] == "regular"
    about = st.linearize(body, jr.State(UP, unit * np.eye(3)[1]))
    assert st.STABILITY[about.stability] == "unstable"
    np.testing.assert_allclose(about.growth_rate, unit / 3**0.5, rtol=1e-12)
    np.testing.assert_allclose(about.margin, -(unit**2) / 3, rtol=1e-12)


@pytest.mark.parametrize("offset", [1e-1, 1e-4])
def test_flip_time_is_that_between_events(offset):
    omega = np.array([offset, 1.0, 0.0])
    closed = float(st.flip_time(MOMENTS, omega))
    body = jr.RigidBody(MOMENTS)
    found = st.poincare_section(
        body, jr.State(UP, omega), lambda _, s: s.omega[1], 3, 0.1, direction=None
    )
    np.testing.assert_allclose(np.diff(found.ts), closed, rtol=1e-7)
    # Near the separatrix: log(4 over the offset in its own measure), twice over the
    # growth rate.
    rate = float(st.growth_rate(MOMENTS, 1, 1.0))
    slow = st.flip_time(MOMENTS, np.array([offset**2, 1.0, 0.0])) - closed
    assert float(slow) == pytest.approx(-2 * np.log(offset) / rate, rel=0.02)


def test_a_body_flips_if_it_now_and_then_turns_mainly_about_its_intermediate_axis(rng):
    """Against the polhode itself; a wobble about a stable axis, or steady rotation,
    never flips."""
    omegas = rng.normal(size=(60, 3))

    @quick_jit
    @jax.vmap
    def lane(omega):
        curve = jr.free.polhode(MOMENTS, omega, 401)
        return curve, 0.5 * jr.free.polhode_period(MOMENTS, omega)

    slopes_of = quick_jit(jax.vmap(jax.value_and_grad(st.flip_time, argnums=1)))

    def flip_times(moments, omegas):
        """Of up to 68 bodies, and their slopes in the rates."""
        omegas, count = np.asarray(omegas, float), len(omegas)
        moments = np.broadcast_to(moments, (count, 3))
        found = slopes_of(*(np.resize(x, (68, 3)) for x in (moments, omegas)))
        return [np.asarray(x)[:count] for x in found]

    curves, half = map(np.asarray, lane(omegas))
    flips = np.any(np.argmax(np.abs(curves), axis=2) == 1, axis=1)
    assert 10 < flips.sum() < 50
    turn = np.asarray(
        jr.rotation.to_matrix(jr.rotation.exp(jnp.array([0.3, -0.8, 0.5])))
    )
    tensor = turn @ np.diag(MOMENTS) @ turn.T
    expected = np.where(flips, half, np.inf)
    steady = [
        [1.0, 0.01, 0.0],
        [0.0, 0.01, 1.0],
        [0.0, 1.0, 0.0],
        [1.0, 0, 0],
        [0.0, 0, 0],
    ]
    others = [[0.1, 1.0, 0.0], [np.nan, 1.0, 0.0]]
    found, slopes = flip_times(MOMENTS, [*omegas, *steady, *others])
    np.testing.assert_allclose(found[:60], expected)
    assert np.isinf(found[60:65]).all()
    assert np.isfinite(found[65])
    assert np.isnan(found[66])
    assert np.isfinite(slopes[65:]).all()
    turned = quick_jit(jax.vmap(lambda w: st.flip_time(tensor, w)))(omegas @ turn.T)
    np.testing.assert_allclose(turned, expected, rtol=1e-9)
    bodies = np.array([[1.0, 1.0, 2.0], [1.0, -2.0, 3.0]])
    found, _ = flip_times(bodies, [[1.0, 0.1, 0.3], [0.1, 1.0, 0.0]])
    assert np.isinf(found[0])
    assert np.isnan(found[1])


def test_compiled_work_has_no_callbacks():
    """So that jax's persistent cache can serve it."""
    body, start = jr.RigidBody(MOMENTS), state([0.0, 0.0, 0.0], [0.5, 0.3, 0.8])
    calls = (
        lambda s: st.megno(body, s, 10.0, 100, throw=False),
        lambda s: st.lyapunov_spectrum(body, s, 10.0, 100, throw=False),
        lambda s: st.final_spin(body, s, 10.0, 100, throw=False),
        lambda s: st.linearize(body, s, throw=False),
        lambda s: st.poincare_section(
            body, s, lambda _, s: s.omega[0], 2, 0.1, throw=False
        ),
        lambda s: st.boundary(lambda x, w: x - w, 0.0, 1.0, s.omega[0], throw=False),
    )
    for call in calls:
        assert "callback" not in str(
            jax.make_jaxpr(lambda s, c=call: jax.tree.leaves(c(s)))(start)
        )


def test_damped_bodies_end_about_the_largest_axis_on_either_side():
    damper = jr.torques.InternalDamper(0.3, 0.2)
    body = jr.RigidBody(MOMENTS, damper)
    angles = np.linspace(0.05, 0.6, 48)

    @jax.jit
    @jax.vmap
    def lane(angle):
        omega = jnp.stack([jnp.cos(angle), 0.3 * jnp.sin(angle), jnp.sin(angle)])
        start = jr.State(jnp.asarray(UP), omega)
        return start, st.final_spin(body, start, 600.0, 3000, throw=False)

    starts, found = lane(angles)
    sides = np.asarray(found.side == st.SIDES.along)
    assert np.all(sides | (found.side == st.SIDES.against))
    assert set(sides) == {True, False}
    assert np.count_nonzero(sides[1:] != sides[:-1]) >= 4
    np.testing.assert_allclose(np.abs(found.alignment), 1, atol=1e-6)
    start = jax.tree.map(lambda x: x[7], starts)
    motion = jr.simulate(body, start, np.linspace(0, 600, 61), rtol=1e-10)
    assert np.all(np.diff(motion.energy) < 1e-12)
    assert np.all(np.diff(motion.energy)[:8] < -1e-3)
    momentum = np.asarray(motion.angular_momentum)
    np.testing.assert_allclose(
        momentum, np.broadcast_to(momentum[0], (61, 3)), atol=1e-7
    )
    assert np.sign(motion.states.omega[-1, 2]) == np.sign(found.alignment[7])
    undamped = st.final_spin(jr.RigidBody(MOMENTS), start, 100.0, 600)
    assert st.SIDES[undamped.side] == "not settled"


# What is asked


def test_bad_requests_are_errors_and_bad_lanes_are_marked(untyped):
    body, start = jr.RigidBody(MOMENTS), state([0.0, 0.0, 0.0], [0.5, 0.3, 0.8])
    with pytest.raises(RuntimeError, match="steps"):
        st.megno(body, start, 1000.0, 300)
    with pytest.raises(RuntimeError, match="duration"):
        st.megno(body, start, -1.0, 300)
    with pytest.raises(RuntimeError, match="finite"):
        st.lyapunov_spectrum(body, state([0.0, 0, 0], [np.nan, 0, 0]), 10.0, 300)
    for options, message in (
        ({"steps": 0}, "steps"),
        ({"steps": 2.5}, "steps"),
        ({"steps": 100, "every": 0}, "every"),
        ({"steps": 100, "samples": 0}, "samples"),
        ({"steps": 100, "count": 7}, "count"),
        ({"steps": 100, "vectors": np.ones((2, 5))}, "vectors"),
        ({"steps": 100, "vectors": np.ones((7, 6))}, "vectors"),
        ({"steps": 100, "vectors": np.eye(6), "count": 2}, "vectors"),
        ({"steps": 100, "solver": "rk4"}, "solver"),
    ):
        with pytest.raises(ValueError, match=message):
            st.lyapunov_spectrum(body, start, 10.0, **options)
    for vector in (np.zeros(6), np.full(6, np.nan)):
        with pytest.raises(RuntimeError, match="independent"):
            st.megno(body, start, 10.0, 100, vector=vector)
    with pytest.raises(RuntimeError, match="independent"):
        st.lyapunov_spectrum(body, start, 10.0, 100, vectors=np.ones((2, 6)))
    with pytest.raises(RuntimeError, match="step"):
        st.poincare_section(heavy(*HEAVY), start, lambda _, s: s.omega[0], 3, 3.0)
    with pytest.raises(RuntimeError, match="condition"):
        st.poincare_section(body, start, lambda _, s: s.omega[0] * np.nan, 3, 0.1)
    with pytest.raises(ValueError, match="system"):
        st.megno(jr.solids.sphere(1.0, 1.0), start, 10.0, 100)
    with pytest.raises(ValueError, match="state0"):
        st.final_spin(body, UP, 10.0, 100)
    with pytest.raises(ValueError, match="direction"):
        st.poincare_section(
            body, start, lambda _, s: s.omega[0], 3, 0.1, direction="up"
        )

    def lane(omega):
        return st.megno(body, jr.State(jnp.asarray(UP), omega), 100.0, 200, throw=False)

    found = quick_jit(jax.vmap(lane))(
        jnp.array([[0.5, 0.3, 0.8], [np.nan, 0, 0], [50.0, 30.0, 80.0]])
    )
    np.testing.assert_array_equal(found.order == st.ORDER.regular, [True, False, False])
    np.testing.assert_array_equal(
        found.order == st.ORDER.undefined, [False, True, True]
    )
    assert bool((found.result == jr.RESULTS.invalid_state)[1])
    assert bool((found.result == jr.RESULTS.inaccurate)[2])
    assert np.isnan(found.history[1:]).all()
    assert np.isfinite(found.history[0]).all()


def test_a_map_of_order_and_chaos_marks_what_fails():
    """A 4 x 4 map of the heavy top: indicator where it could be followed,
    marked where not."""

    def point(tilt, spin):
        start = jr.State(
            jr.rotation.exp(tilt * jnp.array([1.0, 0, 0])),
            spin * jnp.array([0, 0, 1.0]),
        )
        return st.megno(heavy(*HEAVY), start, 200.0, 1000, throw=False).megno

    axes = {"tilt": np.linspace(0.2, 2.8, 4), "spin": np.array([0.5, 1.0, 2.0, 200.0])}
    found = st.stability_map(point, axes, block_size=8)
    assert found.valid[:, :3].all()
    assert not found.valid[:, 3].any()
    assert (found.values[:, :3] > 5).any()


def test_float32_follows_the_motion_as_far_as_it_can():
    body = jr.RigidBody(MOMENTS.astype(np.float32))
    start = jr.State(UP.astype(np.float32), np.array([0.5, 0.3, 0.8], np.float32))
    found = st.megno(body, start, 300.0, 1500)
    assert found.megno.dtype == np.float32
    assert st.ORDER[found.order] == "regular"


class _Kick(jr.torques.AbstractTorque):
    """A torque between two times, which it declares."""

    start: float
    end: float

    def __call__(self, t, state, args):
        del state, args
        third = jnp.array([0.0, 0.0, 1.0])
        return jnp.where((t > self.start) & (t < self.end), third, 0.0)

    @property
    def jumps(self):
        return jnp.array([self.start, self.end])


@pytest.mark.parametrize(
    ("kick", "accurate"),
    [
        (_Kick(1.05, 1.07), False),
        (_Kick(-1.0, 60.0), True),
        # Before the start and after the end nothing is missed.
        (_Kick(-1.0, -0.99), True),
        (_Kick(60.0, 60.01), True),
        # The second one is at the start, which a step reaches but for rounding.
        (_Kick(-4.6, 0.0), True),
    ],
)
def test_steps_longer_than_a_declared_pulse_are_refused(kick, accurate):
    """Steps of 0.2 s, which the short pulse falls between."""
    body = jr.RigidBody(MOMENTS, kick)
    found = st.megno(body, state(TILTED, SPINNING), 4.0, steps=20, throw=False)
    assert (found.result == jr.RESULTS.successful) == accurate


def test_sections_refuse_steps_longer_than_a_pulse_on_the_way():
    """The motion lasts for many steps, of which one is its `step`."""
    found = [
        st.poincare_section(
            jr.RigidBody(MOMENTS, kick),
            state(TILTED, SPINNING),
            lambda _, s: s.omega[0],
            3,
            0.1,
            steps=400,
            throw=False,
        )
        for kick in (_Kick(3.02, 3.05), _Kick(1e4, 1e4 + 0.01))
    ]
    assert found[0].result == jr.RESULTS.inaccurate
    assert found[1].result == jr.RESULTS.successful
    assert float(found[1].ts[-1]) > 3.1
