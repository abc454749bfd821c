"""What a textbook says of the heavy top, against other routes to it and printed
numbers."""

import functools
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from helpers import both_ways, quick_jit, ulps
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid import lagrangian, rotation, top

TOP = jr.SymmetricTop(1.0, 0.5, 1.0)
# The kinds of motion, by what is said of their start.
STARTS = {
    "wave": {"theta": 0.7, "omega3": 5.0, "phi_dot": 0.25},
    "cusp": {"theta": 0.7, "omega3": 5.0},
    "loop": {"theta": 0.7, "omega3": 5.0, "phi_dot": -0.4},
    "steady, slow": {"theta": 0.7, "omega3": 5.0, "phi_dot": "slow"},
    "steady, fast": {"theta": 0.7, "omega3": 5.0, "phi_dot": "fast"},
    "below the horizontal": {
        "theta": 2.1,
        "omega3": 1.0,
        "phi_dot": 0.8,
        "theta_dot": 0.3,
    },
    "spherical pendulum": {"theta": 2.0, "phi_dot": 0.7, "theta_dot": 0.2},
    "plane pendulum": {"theta": 2.0, "theta_dot": 0.4},
    "through upright": {"theta": 0.0, "omega3": 1.5, "theta_dot": 0.8},
    "through upside down": {"theta": np.pi, "omega3": 1.5, "theta_dot": 0.8},
    "sleeping": {"theta": 0.0, "omega3": 4.5},
    "hanging": {"theta": np.pi, "omega3": 1.5},
}
# Where Euler's angles stop: of their routes that of the cosine alone goes on.
AT_THE_VERTICAL = {"through upright", "through upside down", "sleeping", "hanging"}
KINDS = {
    "wave": "wave",
    "cusp": "cusp",
    "loop": "loop",
    "steady, slow": "steady",
    "steady, fast": "steady",
    "below the horizontal": "wave",
    "spherical pendulum": "wave",
    "plane pendulum": "pendulum",
    "through upright": "through the vertical",
    "through upside down": "through the vertical",
    "sleeping": "sleeping",
    "hanging": "sleeping",
}


class Nutation(NamedTuple):
    bounds: top.NutationBounds
    period: jax.Array
    advance: top.Advance
    precession: jax.Array
    kind: top.CLASSES


@jax.jit
def nutation(one, state):
    """What is said of a motion, compiled once for all tests."""
    return Nutation(
        top.nutation_bounds(one, state),
        top.nutation_period(one, state),
        top.advance_per_nutation(one, state),
        top.mean_precession(one, state),
        top.motion_class(one, state),
    )


def start(name, **more):
    return top.initial_state(TOP, **STARTS[name], **more)


def angles_of(state):
    return np.asarray(rotation.to_euler(state.attitude))


def state_of_angles(q, q_dot):
    return jr.State(rotation.from_euler(q), rotation.euler_rates_to_omega(q, q_dot))


# --- Four ways
# ----------------------------------------------------------------------------------


TIMES = jnp.linspace(0.0, 12.0, 13)[1:]


def integrated(field, y0, args):
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        diffrax.Dopri8(),
        0.0,
        TIMES[-1],
        1e-3,
        y0,
        args,
        saveat=diffrax.SaveAt(ts=TIMES),
        max_steps=100_000,
        stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12),
    )
    return solution.ys


def by_lagrangian(q0, q_dot0):
    q, q_dot = integrated(lagrangian.vector_field(top.lagrangian), (q0, q_dot0), (TOP,))
    return jax.vmap(state_of_angles)(q, q_dot)


def by_reduction(q0, q_dot0):
    keeps = top.conserved(TOP, state_of_angles(q0, q_dot0))
    y0 = jnp.array([q0[0], q0[1], q0[2], q_dot0[1]])
    y = integrated(top.reduced_vector_field(TOP, keeps), y0, None)

    def to_state(y):
        rates = top.angle_rates(TOP, y[1], keeps.p_phi, keeps.p_psi)
        return state_of_angles(y[:3], jnp.stack([rates.phi, y[3], rates.psi]))

    return jax.vmap(to_state)(y)


def heights_by_cubic(state0):
    """Cosines of the tilt from u'' = f'(u) / 2, regular at the vertical."""
    slope = jnp.polyder(top.cubic(TOP, top.conserved(TOP, state0)))
    up = rotation.rotate_inverse(state0.attitude, jnp.array([0.0, 0.0, 1.0]))
    u0 = jnp.stack([up[2], jnp.cross(up, state0.omega)[2]])
    return integrated(
        lambda _t, y, _: jnp.stack([y[1], 0.5 * jnp.polyval(slope, y[0])]), u0, None
    )


@pytest.fixture(scope="module")
def routes():
    def two(state0):
        by_quaternions = jr.simulate(
            TOP.as_rigid_body(), state0, TIMES, rtol=1e-11
        ).states
        return (
            jr.top_motion(TOP, state0, TIMES),
            by_quaternions,
            heights_by_cubic(state0),
        )

    return quick_jit(two), quick_jit(
        lambda q0, rates: (by_lagrangian(q0, rates), by_reduction(q0, rates))
    )


@pytest.mark.parametrize("name", STARTS)
def test_four_ways_to_the_same_motion(name, routes):
    state0 = start(name)
    exact, by_quaternions, heights = routes[0](state0)
    others = {"Euler-Poisson": by_quaternions}
    if name not in AT_THE_VERTICAL:
        q0 = jnp.asarray(angles_of(state0))
        rates = rotation.omega_to_euler_rates(q0, state0.omega)
        others["Lagrangian"], others["reduced"] = routes[1](q0, rates)
    here = Rotation.from_quat(exact.attitude, scalar_first=True)
    for route, states in others.items():
        away = here.inv() * Rotation.from_quat(states.attitude, scalar_first=True)
        assert np.max(away.magnitude()) < 3e-9, route
        np.testing.assert_allclose(states.omega, exact.omega, atol=3e-8, err_msg=route)
    np.testing.assert_allclose(heights[:, 0], here.as_matrix()[:, 2, 2], atol=1e-8)


def test_where_the_angles_fail_the_accelerations_are_nan():
    q, q_dot = jnp.zeros(3), jnp.array([0.0, 0.0, 5.0])
    assert np.isnan(lagrangian.acceleration(top.lagrangian, q, q_dot, TOP)).all()


# --- Momenta, energy, potential
# -----------------------------------------------------------------

ANGLES, RATES = jnp.array([0.4, 1.1, -0.7]), jnp.array([0.8, -0.5, 2.0])


def test_momenta_and_energy_are_those_of_the_lagrangian():
    keeps = top.conserved(TOP, state_of_angles(ANGLES, RATES))
    p = lagrangian.momenta(top.lagrangian, ANGLES, RATES, TOP)
    energy = lagrangian.energy(top.lagrangian, ANGLES, RATES, TOP)
    np.testing.assert_allclose(
        [keeps.p_phi, keeps.p_psi, keeps.energy], [p[0], p[2], energy], 1e-14
    )
    cyclic = lagrangian.cyclic_coordinates(top.lagrangian, ANGLES, RATES, TOP)
    assert list(np.asarray(cyclic)) == [True, False, True]


def test_potential_cubic_and_rates_of_the_angles():
    keeps = top.conserved(TOP, state_of_angles(ANGLES, RATES))
    _, theta, _ = ANGLES
    rates = top.angle_rates(TOP, theta, keeps.p_phi, keeps.p_psi)
    np.testing.assert_allclose([rates.phi, rates.psi], RATES[::2], rtol=1e-14)
    v = top.effective_potential(TOP, theta, keeps.p_phi, keeps.p_psi)
    spin_energy = 0.5 * keeps.p_psi**2 / TOP.I3
    left = 0.5 * TOP.I1 * RATES[1] ** 2 + v
    np.testing.assert_allclose(left, keeps.energy - spin_energy, rtol=1e-14)
    u_dot = -jnp.sin(theta) * RATES[1]
    np.testing.assert_allclose(
        jnp.polyval(top.cubic(TOP, keeps), jnp.cos(theta)), u_dot**2, 1e-13
    )
    _, theta_dot, _, theta_acceleration = top.reduced_vector_field(TOP, keeps)(
        0.0, jnp.array([*ANGLES, RATES[1]]), None
    )
    slope = jax.grad(top.effective_potential, argnums=1)(
        TOP, theta, keeps.p_phi, keeps.p_psi
    )
    np.testing.assert_allclose(theta_acceleration, -slope / TOP.I1, rtol=1e-13)
    assert theta_dot == RATES[1]


def test_potential_at_the_vertical():
    def v(theta, p_phi, p_psi):
        return top.effective_potential(TOP, theta, p_phi, p_psi)

    assert v(0.0, 2.0, 2.0) == 1.0
    assert v(np.pi, 1.0, 2.0) > 1e30
    assert v(0.0, 1.0, 2.0) == np.inf
    # p^2 tan^2(theta / 2) / (2 I1) + mgl cos theta: curvature p^2 / 4 - mgl
    assert jax.grad(jax.grad(v))(0.0, 3.0, 3.0) == pytest.approx(9 / 4 - 1, rel=1e-13)
    assert np.all(np.isfinite(jax.grad(v, argnums=(0, 1, 2))(0.0, 3.0, 3.0)))


@pytest.fixture(scope="module")
def of_the_momenta():
    def both(p):
        rates = top.angle_rates(TOP, 1.0, p, 3.0)
        return jnp.stack(
            [top.effective_potential(TOP, 1.0, p, 3.0), rates.phi, rates.psi]
        )

    def slope(p):
        value, slope = jax.jvp(both, (p,), (1.0,))
        return slope, (value, slope)

    return quick_jit(jax.jacfwd(slope, has_aux=True))


@pytest.mark.parametrize("p_phi", [3.0, -3.0, 1.0])
def test_slopes_of_potential_and_rates_in_the_momenta(p_phi, of_the_momenta):
    """Also at p_phi = +-p_psi, which all pendulums and passages through the vertical
    have."""
    h = 1e-5
    curvature, (_, found) = of_the_momenta(p_phi)
    up, down = (of_the_momenta(p_phi + step)[1][0] for step in (h, -h))
    np.testing.assert_allclose(found, (up - down) / (2 * h), atol=1e-9)
    np.testing.assert_allclose(curvature, [1 / np.sin(1.0) ** 2, 0, 0], atol=1e-13)


# --- Nutation
# -----------------------------------------------------------------------------------


def quadratures(one, state):
    """Bounds, period and advance of phi and psi by integrals over u = cos theta,
    25 digits."""
    p_phi, p_psi, energy = (mp.mpf(float(x)) for x in top.conserved(one, state))
    i1, i3, mgl = (mp.mpf(float(x)) for x in (one.I1, one.I3, one.mgl))
    alpha, beta, a, b = (
        (2 * energy - p_psi**2 / i3) / i1,
        2 * mgl / i1,
        p_psi / i1,
        p_phi / i1,
    )
    u1, u2, u3 = sorted(
        mp.re(x)
        for x in mp.polyroots(
            [alpha - b * b, 2 * a * b - beta, -alpha - a * a, beta],
            200,
            extraprec=200,
            asc=True,
        )
    )

    def over(f):
        # u = u1 + (u2 - u1) sin^2 x: no singular ends
        def integrand(x):
            u = u1 + (u2 - u1) * mp.sin(x) ** 2
            return 2 * f(u) / mp.sqrt(beta * (u3 - u))

        return 2 * mp.quad(integrand, mp.linspace(0, mp.pi / 2, 5))

    period = over(lambda _: 1)
    phi = over(lambda u: (b - a * u) / (1 - u * u))
    psi = over(lambda u: p_psi / i3 - u * (b - a * u) / (1 - u * u))
    return mp.acos(u2), mp.acos(u1), period, phi, psi


@pytest.mark.parametrize("name", ["wave", "cusp", "loop", "below the horizontal"])
def test_bounds_period_and_advance_are_the_textbook_s_integrals(name):
    with mp.workdps(25):
        low, high, period, phi, psi = (float(x) for x in quadratures(TOP, start(name)))
    state = start(name)
    bounds = nutation(TOP, state).bounds
    np.testing.assert_allclose(
        [bounds.theta_min, bounds.theta_max], [low, high], rtol=1e-13
    )
    assert nutation(TOP, state).period == pytest.approx(period, rel=1e-13)
    advance = nutation(TOP, state).advance
    np.testing.assert_allclose([advance.phi, advance.psi], [phi, psi], rtol=1e-12)
    assert nutation(TOP, state).precession == pytest.approx(phi / period, rel=1e-12)


@pytest.mark.parametrize("mgl", [1.0, -1.0, 0.0])
def test_bounds_and_advance_are_those_of_the_motion(mgl, rng):
    """Any state, either sign of gravity: against the exact motion over one nutation."""
    for _ in range(6):
        one = jr.SymmetricTop(1.3, rng.uniform(0.3, 2), mgl)
        q = rng.normal(size=4)
        state = jr.State(
            q / np.linalg.norm(q), rng.normal(size=3) * rng.choice([0.3, 1, 3])
        )
        period = float(nutation(one, state).period)
        motion = np.asarray(
            jr.top_motion(one, state, np.linspace(0, period, 4001)).attitude
        )
        sum_ = np.unwrap(np.arctan2(motion[:, 3], motion[:, 0]))
        difference = np.unwrap(np.arctan2(motion[:, 2], motion[:, 1]))
        phi, psi = sum_ + difference, sum_ - difference
        tilt = np.arccos(
            np.clip(2 * (motion[:, 0] ** 2 + motion[:, 3] ** 2) - 1, -1, 1)
        )
        bounds = nutation(one, state).bounds
        extent = [tilt.min(), tilt.max()]
        np.testing.assert_allclose(
            [bounds.theta_min, bounds.theta_max], extent, atol=1e-4
        )
        assert tilt[-1] == pytest.approx(tilt[0], abs=1e-11)
        advance = nutation(one, state).advance
        np.testing.assert_allclose(
            advance, [phi[-1] - phi[0], psi[-1] - psi[0]], atol=1e-11
        )
        steps = np.diff(phi)
        kind = (
            top.CLASSES.loop if np.min(steps) < 0 < np.max(steps) else top.CLASSES.wave
        )
        assert nutation(one, state).kind == kind


@pytest.mark.parametrize("name", STARTS)
def test_kinds_of_motion(name):
    state = start(name)
    assert top.CLASSES[nutation(TOP, state).kind] == KINDS[name]
    # Any later state is of the same kind, and so is the same motion with the axis named
    # backward.
    later = jr.top_motion(TOP, state, 1.7).states
    assert top.CLASSES[nutation(TOP, later).kind] == KINDS[name]
    back = rotation.multiply(state.attitude, np.array([0.0, 1, 0, 0]))
    backward = jr.State(back, state.omega * np.array([1.0, -1, -1]))
    reversed_ = jr.SymmetricTop(TOP.I1, TOP.I3, -TOP.mgl)
    assert top.CLASSES[nutation(reversed_, backward).kind] == KINDS[name]


@pytest.mark.parametrize("theta", [0.0, np.pi])
@pytest.mark.parametrize("omega3", [0.0, 3.0, 4.0, 5.0])
def test_a_top_at_the_vertical_sleeps(theta, omega3):
    state = top.initial_state(TOP, theta, omega3=omega3)
    state = jr.State(np.round(state.attitude, 15), state.omega)
    assert nutation(TOP, state).kind == top.CLASSES.sleeping


def test_a_bad_state_has_no_kind():
    state = jr.State(np.eye(4)[0], np.array([np.nan, 0, 0]))
    assert nutation(TOP, state).kind == top.CLASSES.undefined


def test_kinds_are_listed_with_their_texts():
    texts = [
        "wave",
        "cusp",
        "loop",
        "steady",
        "sleeping",
        "pendulum",
        "through the vertical",
    ]
    assert top.CLASSES.texts == [*texts, "undefined"]
    assert {"wave", "through_the_vertical", "undefined"} <= set(dir(top.CLASSES))


@pytest.fixture(scope="module")
def slopes():
    def both(s, direction, state):
        x = jnp.concatenate([jnp.array([1.0, 0.5, 1.0]), state.omega]) + s * direction
        one, moved = jr.SymmetricTop(x[0], x[1], x[2]), jr.State(state.attitude, x[3:])
        return jnp.stack(
            [top.nutation_period(one, moved), top.mean_precession(one, moved)]
        )

    @quick_jit
    def every(s, direction, state):
        """Value, slopes forward and in reverse, by one trace."""
        return both_ways(lambda s: both(s, direction, state), s)

    return every


@pytest.mark.parametrize("name", STARTS)
def test_derivatives_of_period_and_precession_are_differences(name, slopes):
    state = start(name)
    direction = np.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.6])
    if (
        name == "plane pendulum" or name in AT_THE_VERTICAL
    ):  # stay in the plane, or at the vertical
        moves = not name.startswith("plane") and state.omega[0] == 0
        direction[3:] = [0.0, 0.0, 0.4] if moves else [0.4, 0.0, 0.0]

    def both(s):
        return np.asarray(slopes(s, direction, state)[0])

    h = 1e-4
    _, found, reverse = slopes(0.0, direction, state)
    difference = (8 * (both(h) - both(-h)) - (both(2 * h) - both(-2 * h))) / (12 * h)
    np.testing.assert_allclose(found, difference, rtol=0, atol=1e-9)
    np.testing.assert_allclose(reverse, found, rtol=1e-11)


def test_small_swings_keep_their_relative_size():
    """Of a pendulum about hanging, and of a cusp beside the vertical."""
    for small in (1e-3, 1e-7, 1e-12):
        attitude = np.array([np.sin(small / 2), np.cos(small / 2), 0, 0])
        bounds = nutation(TOP, jr.State(attitude, np.zeros(3))).bounds
        assert np.pi - bounds.theta_min == pytest.approx(
            small, rel=1e-12 + 5e-16 / small
        )
        bounds = nutation(TOP, top.initial_state(TOP, small, omega3=6.0)).bounds
        # theta_max^2 / theta_min^2 = spin^2 / (spin^2 - 4 mgl I1 / I3^2)
        assert bounds.theta_max / bounds.theta_min == pytest.approx(
            (36 / 20) ** 0.5, rel=1e-6
        )


def test_the_endless_motion_comes_to_the_vertical_at_its_rate():
    for mgl, sign in ((1.0, 1.0), (-1.0, -1.0)):
        attitude = np.array([1.0, 0, 0, 0]) if mgl > 0 else np.array([0.0, 1, 0, 0])
        one, state = (
            jr.SymmetricTop(1.0, 0.5, mgl),
            jr.State(attitude, np.array([0, 0, 2.0])),
        )
        assert nutation(one, state).period == np.inf
        assert nutation(one, state).precession == pytest.approx(sign * 0.5)


@pytest.mark.parametrize("tilt", [1e-6, 1e-9, 1e-30])
def test_precession_at_the_threshold_of_sleeping(tilt):
    """The slower a nutation, the longer the axis stands upright and turns at I3 omega3
    / (2 I1)."""
    state = top.initial_state(TOP, tilt, omega3=4.0)
    assert nutation(TOP, state).precession == pytest.approx(1.0, abs=tilt**0.5 + 1e-13)


SPECIAL = {
    "steady": {"theta": 0.7, "omega3": 5.0, "phi_dot": "slow"},
    "sleeping": {"theta": 0.0, "omega3": 5.0},
    "threshold": {"theta": 0.0, "omega3": 4.0},
    "upright, unstable": {"theta": 0.0, "omega3": 2.0},
    "through the vertical": {"theta": 0.0, "omega3": 2.0, "theta_dot": 1.0},
    "pendulum": {"theta": 1.0},
    "at rest upright": {"theta": 0.0},
}


@pytest.fixture(scope="module")
def special():
    def everything(x, attitude):
        one, moved = jr.SymmetricTop(x[0], x[1], x[2]), jr.State(attitude, x[3:])
        found = (
            top.nutation_bounds(one, moved),
            top.mean_precession(one, moved),
            top.advance_per_nutation(one, moved),
            top.conserved(one, moved),
            1 / top.nutation_period(one, moved),
        )
        return jnp.stack(jax.tree.leaves(found))

    def with_derivatives(x, attitude):
        values, forward, reverse = both_ways(lambda x: everything(x, attitude), x)
        return values, forward.T, reverse

    return quick_jit(with_derivatives)


@pytest.mark.parametrize("mgl", [1.0, 0.0, -1.0])
@pytest.mark.parametrize("name", SPECIAL)
def test_no_nan_in_any_derivative_at_the_special_motions(name, mgl, special):
    state = top.initial_state(TOP, **SPECIAL[name])
    for found in special(jnp.array([1.0, 0.5, mgl, *state.omega]), state.attitude):
        assert np.all(np.isfinite(found))


# --- Special motions
# ----------------------------------------------------------------------------


@pytest.mark.parametrize("branch", ["slow", "fast"])
@pytest.mark.parametrize("theta", [0.4, 1.3, 2.2])
@pytest.mark.parametrize("spin", [{"omega3": 6.0}, {"psi_dot": -7.0}])
def test_steady_precession_is_steady(branch, theta, spin):
    state0 = top.initial_state(TOP, theta, phi_dot=branch, **spin)
    rate = float(getattr(top.steady_precession(TOP, theta, **spin), branch))
    ts = np.array([0.3, 5.0, 50.0])
    motion = jr.top_motion(TOP, state0, ts)
    axis = Rotation.from_quat(motion.attitude, scalar_first=True).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(axis[:, 2], np.cos(theta), atol=1e-12)
    advance = rate * ts
    expected = np.sin(theta) * np.stack([np.sin(advance), -np.cos(advance)], axis=1)
    np.testing.assert_allclose(axis[:, :2], expected, atol=1e-11)
    assert nutation(TOP, state0).precession == pytest.approx(rate, rel=1e-12)


def test_when_steady_precession_exists():
    theta = 0.7
    least = 2 * np.sqrt(np.cos(theta)) / 0.5
    assert not top.steady_precession(TOP, theta, 0.999 * least).exists
    at_least = top.steady_precession(TOP, theta, least)
    assert at_least.exists
    # Where the two meet their difference is the root of a rounding error.
    np.testing.assert_allclose(at_least.slow, at_least.fast, rtol=1e-7)
    assert top.steady_precession(TOP, 2.0, 0.0).exists
    for mgl in (1.0, -1.0):
        assert not top.steady_precession(
            jr.SymmetricTop(1.0, 0.5, mgl), np.pi / 2, 0.0
        ).exists
    level = top.steady_precession(TOP, np.pi / 2, 5.0)
    assert level.slow == pytest.approx(1 / (0.5 * 5.0))
    assert level.fast == np.inf
    with pytest.raises(
        RuntimeError, match=r"`omega3` must be large enough for steady.*: 1\.0"
    ):
        top.initial_state(TOP, theta, omega3=1.0, phi_dot="slow")
    with pytest.raises(RuntimeError, match="`psi_dot` must be large enough for steady"):
        top.initial_state(TOP, theta, psi_dot=1.0, phi_dot="slow")
    with pytest.raises(RuntimeError, match=r"`theta` must not be level .* infinite"):
        top.initial_state(TOP, np.pi / 2, omega3=5.0, phi_dot="fast")
    slopes = jax.grad(lambda w: top.steady_precession(TOP, theta, w).slow)(6.0)
    assert slopes == pytest.approx(
        float(
            top.steady_precession(TOP, theta, 6.0 + 1e-6).slow
            - top.steady_precession(TOP, theta, 6.0 - 1e-6).slow
        )
        / 2e-6,
        rel=1e-8,
    )


@pytest.mark.parametrize(
    ("factor", "least", "most"), [(0.999, 5.12, 5.13), (1.001, 1e-4, 5e-3)]
)
def test_a_sleeping_top_a_thousandth_below_and_above_its_threshold(factor, least, most):
    """Started at a tilt of 1e-6: below, the largest tilt is arccos(2 0.999^2 - 1) =
    5.125 deg."""
    spin = factor * float(top.sleeping_spin(TOP))
    assert spin == factor * 4.0
    state = top.initial_state(TOP, 1e-6, omega3=spin)
    largest = np.degrees(nutation(TOP, state).bounds.theta_max)
    assert least < largest < most
    if factor < 1:
        assert largest == pytest.approx(
            np.degrees(np.arccos(2 * factor**2 - 1)), rel=1e-6
        )
    times = np.linspace(0.0, 2 * float(nutation(TOP, state).period), 4001)
    motion = np.asarray(jr.top_motion(TOP, state, times).attitude)
    reached = np.degrees(2 * np.arcsin(np.hypot(motion[:, 1], motion[:, 2]).max()))
    assert reached == pytest.approx(largest, rel=1e-4)


def test_gyroscopic_approximation_becomes_exact():
    theta = 0.8
    errors = []
    for omega3 in (40.0, 80.0):
        state = top.initial_state(TOP, theta, omega3=omega3)
        bounds = nutation(TOP, state).bounds
        exact = np.array(
            [
                nutation(TOP, state).precession,
                2 * np.pi / nutation(TOP, state).period,
                bounds.theta_max - bounds.theta_min,
            ]
        )
        errors.append(np.abs(np.array(top.gyroscopic(TOP, theta, omega3)) / exact - 1))
    assert np.all(errors[0] < 4 * 1.0 / (0.5 * 40) ** 2)
    np.testing.assert_allclose(errors[0] / errors[1], 4, rtol=0.05)
    assert np.all(np.isnan(top.gyroscopic(TOP, theta, 0.0)))


def test_starts_mean_what_they_say(untyped):
    state = top.initial_state(
        TOP, 0.7, psi_dot=4.0, phi_dot=0.3, theta_dot=-0.2, phi=0.5, psi=1.1
    )
    angles = angles_of(state)
    np.testing.assert_allclose(angles, [0.5, 0.7, 1.1], atol=1e-14)
    rates = rotation.omega_to_euler_rates(angles, state.omega)
    np.testing.assert_allclose(rates, [0.3, -0.2, 4.0], atol=1e-14)
    by_component = top.initial_state(TOP, 0.7, omega3=5.0, phi_dot=0.3)
    assert by_component.omega[2] == 5.0
    assert np.all(np.asarray(top.initial_state(TOP, 0.7).omega) == 0)
    with pytest.raises(ValueError, match="`psi_dot` must be None where `omega3`"):
        top.initial_state(TOP, 0.7, psi_dot=1.0, omega3=1.0)
    with pytest.raises(ValueError, match="must be one of 'slow', 'fast'"):
        top.initial_state(TOP, 0.7, omega3=5.0, phi_dot="quick")
    for name in ("psi_dot", "omega3", "phi_dot", "theta_dot", "phi", "psi"):
        with pytest.raises(
            RuntimeError, match=f"`{name}` must be finite, but it is not: inf"
        ):
            top.initial_state(TOP, 0.7, **{name: np.inf})
    no_top = jr.SymmetricTop.unchecked(1.0, -0.5, 1.0)
    with pytest.raises(
        RuntimeError, match=r"`top` must have I1 > 0, .* not: \[ 1\. +-0\.5 +1\. \]"
    ):
        top.initial_state(no_top, 0.7)


@pytest.mark.parametrize("theta", [30.0, -0.1, 3.2, np.nan, np.inf])
def test_a_tilt_beyond_half_a_turn_is_an_error_that_says_radians(theta):
    with pytest.raises(
        RuntimeError, match=f"`theta` must be from 0 to pi.*: {theta}.*radians"
    ):
        top.initial_state(TOP, theta)
    with pytest.raises(RuntimeError, match="in lane 1"):
        jax.vmap(lambda x: top.initial_state(TOP, x))(jnp.array([0.5, theta, 0.6]))

    def heights(tilts, omega3):
        states = jax.vmap(
            lambda x: top.initial_state(TOP, x, omega3=omega3, throw=False)
        )(tilts)
        first = states.attitude[:, 0] * states.omega[:, 2]
        return jnp.sum(jnp.where(jnp.isnan(first), 0.0, first)), states

    tilts = jnp.array([0.5, theta, 0.6])
    slopes, states = jax.grad(heights, argnums=(0, 1), has_aux=True)(tilts, 2.0)
    assert list(np.isnan(states.omega[:, 2])) == [False, True, False]
    np.testing.assert_allclose(slopes[0], [-np.sin(0.25), 0, -np.sin(0.3)])
    np.testing.assert_allclose(slopes[1], np.cos(0.25) + np.cos(0.3))


def test_tilts_of_the_vertical_pass_in_either_precision():
    for theta in (
        0.0,
        np.pi,
        np.float32(np.pi),
        float(np.float32(np.pi)),
        np.radians(180),
    ):
        assert np.all(np.isfinite(top.initial_state(TOP, theta).attitude))


def test_a_top_from_mass_properties():
    """A disk on a thin rod: parallel axes by hand."""
    disk = jr.solids.disk(0.3, 0.05).translated(np.array([0.0, 0.0, 0.08]))
    rod = jr.solids.rod(0.1, 0.2).translated(np.array([0.0, 0.0, 0.1]))
    body = disk + rod
    down = np.array([0.0, 0.0, -9.8])
    held = jr.SymmetricTop.from_mass_properties(body, body.center_of_mass, down)
    across = 0.3 * 0.05**2 / 4 + 0.3 * 0.08**2 + 0.1 * 0.2**2 / 3
    np.testing.assert_allclose(held.I1, across, rtol=1e-14)
    np.testing.assert_allclose(held.I3, 0.3 * 0.05**2 / 2, rtol=1e-14)
    np.testing.assert_allclose(held.mgl, 9.8 * (0.3 * 0.08 + 0.1 * 0.1), rtol=1e-14)
    for lever, pull in ((-body.center_of_mass, down), (body.center_of_mass, -down)):
        below = jr.SymmetricTop.from_mass_properties(body, lever, pull)
        np.testing.assert_allclose(
            [below.I1, below.mgl], [held.I1, -held.mgl], rtol=1e-14
        )
    on_earth = jr.SymmetricTop.from_mass_properties(body, body.center_of_mass)
    np.testing.assert_allclose(on_earth.mgl / held.mgl, 9.80665 / 9.8, rtol=1e-14)
    with pytest.raises(
        RuntimeError, match=r"`lever` must lie along body axis 3.*: \[0\.01 0\. "
    ):
        jr.SymmetricTop.from_mass_properties(body, np.array([0.01, 0.0, 0.1]))
    with pytest.raises(RuntimeError, match="`gravity` must lie along z in space"):
        jr.SymmetricTop.from_mass_properties(body, body.center_of_mass, down + 0.1)
    with pytest.raises(RuntimeError, match=r"`gravity` must lie along z in space.*nan"):
        jr.SymmetricTop.from_mass_properties(body, body.center_of_mass, down * np.nan)
    box = jr.solids.box(1.0, np.array([1.0, 2.0, 3.0]))
    with pytest.raises(
        RuntimeError, match=r"`body` .* symmetric about its axis 3.*: \[1\.08"
    ):
        jr.SymmetricTop.from_mass_properties(box, np.array([0.0, 0.0, 1.5]))


def test_a_bad_lever_is_nan_in_its_lane_alone():
    body = jr.solids.disk(0.3, 0.05)

    def weights(mass_scale, levers):
        def one(lever):
            scaled = jr.MassProperties(
                body.mass * mass_scale, np.zeros(3), body.inertia
            )
            return jr.SymmetricTop.from_mass_properties(scaled, lever, throw=False).mgl

        mgl = jax.vmap(one)(levers)
        return jnp.sum(jnp.where(jnp.isnan(mgl), 0.0, mgl)), mgl

    levers = jnp.array([[0, 0, 0.1], [0.01, 0, 0.1], [0, 0, np.nan], [0, 0, 0.2]])
    slope, mgl = jax.grad(weights, has_aux=True)(1.0, levers)
    assert list(np.isnan(mgl)) == [False, True, True, False]
    np.testing.assert_allclose(slope, 0.3 * 9.80665 * 0.3, rtol=1e-13)


def test_a_cone_on_its_tip_is_the_top_of_the_example():
    """About the tip 3 m (R^2 + 4 h^2) / 20 across, and the tip at the pivot."""
    radius, height = 0.03, 0.08
    cone = jr.solids.cone(0.5, radius, height)
    tip_down = cone.rotated(rotation.exp(np.array([np.pi, 0.0, 0.0])))
    one = jr.SymmetricTop.from_mass_properties(
        tip_down, np.array([0.0, 0.0, 0.75 * height])
    )
    np.testing.assert_allclose(
        one.I1, 3 * 0.5 * (radius**2 + 4 * height**2) / 20, rtol=1e-14
    )
    np.testing.assert_allclose(one.I3, 3 * 0.5 * radius**2 / 10, rtol=1e-14)
    # The mean height of its points above the pivot, from those of the solid.
    zs = (np.arange(1000) + 0.5) / 1000 * height
    mean = np.sum(zs * zs**2) / np.sum(zs**2)
    np.testing.assert_allclose(one.mgl, 0.5 * 9.80665 * mean, rtol=1e-6)


BAD_TOPS = {
    "no I1": ((0.0, 0.5, 1.0), "`I1` must be positive and finite, but it is not", "0"),
    "negative I1": ((-1.0, 0.5, 1.0), "`I1` must be positive and finite", "-1.0"),
    "negative I3": ((1.0, -0.5, 1.0), "`I3` must be positive and finite", "-0.5"),
    "infinite I3": ((1.0, np.inf, 1.0), "`I3` must be positive and finite", "inf"),
    "no mgl": ((1.0, 0.5, np.nan), "`mgl` must be finite, but it is not", "nan"),
}


@pytest.mark.parametrize("name", BAD_TOPS)
def test_numbers_that_no_top_has_are_refused(name):
    numbers, message, value = BAD_TOPS[name]
    with pytest.raises(RuntimeError, match=f"{message}.*: {value}"):
        jr.SymmetricTop(*numbers)
    moment = quick_jit(lambda x: jr.SymmetricTop(*x).I1)
    with pytest.raises(RuntimeError, match=message):
        jax.block_until_ready(moment(jnp.asarray(numbers)))
    with pytest.raises(RuntimeError, match=f"{message}.*: {value}.* in lane 1"):
        jax.vmap(lambda x: jr.SymmetricTop(*x))(jnp.array([[1.0, 0.5, 1.0], numbers]))


def test_an_unchecked_lane_of_numbers_that_no_top_has_is_nan():
    lanes = jnp.array([(1.0, 0.5, 1.0), *(x for x, *_ in BAD_TOPS.values())])

    def total(shared):
        tops = jax.vmap(lambda x: jr.SymmetricTop.unchecked(*(shared + x)))(lanes)
        spins = jax.vmap(top.sleeping_spin)(tops)
        return jnp.nansum(spins), (tops, spins)

    slope, (tops, spins) = quick_jit(jax.grad(total, has_aux=True))(0.0)
    np.testing.assert_array_equal(np.isnan(spins), [False] + [True] * len(BAD_TOPS))
    assert slope == pytest.approx(-4.0, rel=1e-13)  # of 2 sqrt(mgl I1) / I3
    np.testing.assert_array_equal(
        jax.vmap(lambda x: x.is_valid)(tops), [True] + [False] * len(BAD_TOPS)
    )


@pytest.mark.parametrize("mgl", [-1.0, 0.0, 1.0])
def test_the_weight_of_a_top_may_have_any_sign(mgl):
    assert jr.SymmetricTop(1.0, 0.5, mgl).is_valid


def test_a_body_without_a_moment_about_its_axis_is_no_top():
    needle = jr.MassProperties(1.0, np.zeros(3), np.array([1.0, 1.0, 0.0]))
    with pytest.raises(RuntimeError, match="`I3` must be positive"):
        jr.SymmetricTop.from_mass_properties(needle, np.array([0.0, 0.0, 1.0]))


def test_a_top_prints_its_numbers():
    assert repr(TOP) == "SymmetricTop(I1=1., I3=0.5, mgl=1.)"
    slope = jax.grad(lambda one: top.sleeping_spin(one))(TOP)
    assert repr(slope) == "SymmetricTop(I1=2., I3=-8., mgl=2.)"


# --- Other integrable bodies
# --------------------------------------------------------------------


def heavy(moments, lever):
    gravity = jr.torques.UniformGravity(
        1.0, np.array(lever), np.array([0.0, 0.0, -1.0])
    )
    return jr.RigidBody(np.array(moments), gravity)


ATTITUDE = np.asarray(rotation.normalize(np.array([0.5, -0.1, 0.7, 0.4])))
LEVEL = np.array([0.6, -0.5, 0.9])


def of_no_vertical_momentum(moments):
    up = Rotation.from_quat(ATTITUDE, scalar_first=True).inv().apply([0.0, 0.0, 1.0])
    momentum = np.array(moments) * LEVEL
    return (momentum - (momentum @ up) * up) / moments


INTEGRABLE = {
    "kovalevskaya": (heavy([2.0, 2.0, 1.0], [0.4, 0.3, 0.0]), LEVEL),
    "goryachev-chaplygin": (
        heavy([4.0, 4.0, 1.0], [0.4, 0.3, 0.0]),
        of_no_vertical_momentum([4.0, 4.0, 1.0]),
    ),
    "lagrange": (heavy([1.0, 1.0, 0.5], [0.0, 0.0, 1.0]), LEVEL),
    "euler": (heavy([1.0, 2.0, 3.0], [0.0, 0.0, 0.0]), LEVEL),
}


LONG = {
    **INTEGRABLE,
    "bruls": (
        heavy([15.234375, 15.234375, 0.46875], [0.0, 0.0, 15.0 * 9.81]),
        np.array([-4.61538, 0.0, 150.0]),
    ),
    "simo": (heavy([5.0, 5.0, 1.0], [0.0, 0.0, 20.0]), np.array([0.0, 0.0, 50.0])),
}
# The axes (3, 1, 2) of Bruls's benchmark are (1, 2, 3): q = q_benchmark * p.
FROM_BENCHMARK = rotation.from_matrix(np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]))
TILTED = rotation.exp(np.array([0.05, 0, 0]))


@functools.cache
def long_motions(turns=100):
    """All of them by one compilation, as lanes: at this size a step of six costs that
    of one."""

    def run(moments, lever, attitude, omega, ts):
        gravity = jr.torques.UniformGravity(1.0, lever, jnp.array([0.0, 0.0, -1.0]))
        body = jr.RigidBody(moments, gravity)
        return jr.simulate(
            body, jr.State(attitude, omega), ts, rtol=1e-13, max_step=0.05
        ).states

    attitudes = [*[ATTITUDE] * len(INTEGRABLE), FROM_BENCHMARK, TILTED]
    ends = [
        turns * 2 * np.pi / np.linalg.norm(omega) for _, omega in INTEGRABLE.values()
    ]
    lanes = (
        np.stack([body.inertia for body, _ in LONG.values()]),
        np.stack([body.torque.lever for body, _ in LONG.values()]),
        np.stack(attitudes),
        np.stack([omega for _, omega in LONG.values()]),
        np.linspace(0.0, [*ends, 2.0, 10.0], 101, axis=1),
    )
    states = jax.tree.map(np.asarray, jax.jit(jax.vmap(run))(*lanes))
    return {
        name: jax.tree.map(lambda x, k=k: x[k], states) for k, name in enumerate(LONG)
    }


@pytest.mark.parametrize("turns", [100, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("case", INTEGRABLE)
def test_extra_integrals_are_constant_to_1e_12(case, turns):
    body, _ = INTEGRABLE[case]
    integrals = quick_jit(jax.vmap(lambda s: top.integrals(body, s, case)))
    for values in map(np.asarray, integrals(long_motions(turns)[case])):
        assert np.max(np.abs(values - values[0])) < 1e-12 * max(
            1.0, abs(float(values[0]))
        )


def test_the_extra_integral_s_rate_is_zero_for_generic_bodies_of_the_case(rng):
    """By the chain rule along the vector field: no integration."""
    for case, ratio in (
        ("kovalevskaya", 2.0),
        ("goryachev-chaplygin", 4.0),
        ("lagrange", None),
    ):
        i3 = rng.uniform(0.5, 2)
        i1 = rng.uniform(0.5, 2) if ratio is None else ratio * i3
        lever = (
            np.array([0, 0, 0.7])
            if ratio is None
            else np.array([*rng.normal(size=2), 0])
        )
        pull = rng.normal(size=3)
        gravity = jr.torques.UniformGravity(1.7, lever, pull)
        body = jr.RigidBody(np.array([i1, i1, i3]), gravity)
        q = rng.normal(size=4)
        q /= np.linalg.norm(q)
        omega = rng.normal(size=3)
        if case == "goryachev-chaplygin":
            up = -Rotation.from_quat(q, scalar_first=True).inv().apply(
                pull
            ) / np.linalg.norm(pull)
            momentum = np.asarray(body.inertia) * omega
            omega = (momentum - (momentum @ up) * up) / np.asarray(body.inertia)
        state = jr.State(q, omega)
        rate = body.vector_field(0.0, state, None)
        values, slopes = jax.jvp(
            lambda s, body=body, case=case: top.integrals(body, s, case),
            (state,),
            (rate,),
        )
        assert np.max(np.abs(jax.tree.leaves(slopes))) < 1e-13
        assert values.energy == pytest.approx(
            float(body.energy(0.0, state, None)), rel=1e-13
        )
        # Of a body that is not of the case, though the check lets it pass, it is not a
        # constant.
        nearly = jr.RigidBody(np.array([i1 * (1 + 1e-8), i1, i3]), gravity)
        rate = nearly.vector_field(0.0, state, None)
        _, moved = jax.jvp(
            lambda s, body=nearly, case=case: top.integrals(body, s, case),
            (state,),
            (rate,),
        )
        assert abs(moved.extra) > 1e-11


def test_a_body_that_is_not_of_the_case_is_nan(untyped):
    body, omega = INTEGRABLE["kovalevskaya"]
    state = jr.State(ATTITUDE, omega)
    others = [(body, "goryachev-chaplygin"), (body, "lagrange"), (body, "euler")]
    others += [(INTEGRABLE["lagrange"][0], "kovalevskaya")]
    others += [(heavy([2.0, 2.1, 1.0], [0.4, 0.3, 0.0]), "kovalevskaya")]
    others += [(heavy([2.0, 2.0, 1.0], [0.4, 0.3, 0.1]), "kovalevskaya")]
    # With angular momentum about the vertical:
    others += [(INTEGRABLE["goryachev-chaplygin"][0], "goryachev-chaplygin")]
    for other, case in others:
        assert np.all(np.isnan(top.integrals(other, state, case))), case
    with pytest.raises(ValueError, match="must be one of"):
        top.integrals(body, state, "steklov")
    with pytest.raises(ValueError, match="UniformGravity"):
        top.integrals(jr.RigidBody(np.ones(3)), state)
    with pytest.raises(ValueError, match="principal moments"):
        top.integrals(heavy(np.eye(3), [0.0, 0, 1]), state, "lagrange")
    assert top.integrals(heavy(np.eye(3), [0.0, 0, 1]), state).extra is None


@pytest.mark.parametrize("case", INTEGRABLE)
def test_integrals_outside_their_domain_are_nan_in_their_lane_alone(case):
    body, omega = INTEGRABLE[case]

    def total(mass, moments, attitude, pull):
        gravity = jr.torques.UniformGravity(mass, body.torque.lever, pull)
        values = top.integrals(
            jr.RigidBody(moments, gravity), jr.State(attitude, omega), case
        )
        return sum(jnp.where(jnp.isnan(x), 0.0, x) for x in values), values

    @quick_jit
    def lanes(mass, *lanes):
        def sum_(mass):
            sums, values = jax.vmap(total, (None, 0, 0, 0))(mass, *lanes)
            return jnp.sum(sums), values

        return jax.value_and_grad(sum_, has_aux=True)(mass)

    moments, down = body.inertia, np.array([0.0, 0.0, -1.0])
    good = moments, ATTITUDE, down
    bad = [
        (-moments, ATTITUDE, down),
        (moments * np.nan, ATTITUDE, down),
        (moments, 2 * ATTITUDE, down),
        (moments, ATTITUDE * np.nan, down),
        (moments, ATTITUDE, down * np.nan),
        (moments, ATTITUDE, np.array([np.inf, 0.0, 0.0])),
    ]
    (_, values), slope = lanes(
        1.0, *(jnp.stack(x) for x in zip(good, *bad, good, strict=True))
    )
    for value in values:
        assert list(np.isnan(value)) == [False, *(True for _ in bad), False]
    _, alone = lanes(1.0, *(jnp.stack([x] * (2 + len(bad))) for x in good))
    np.testing.assert_allclose(slope, alone / 4, rtol=1e-13)
    # A known mass of the wrong sign is refused when the torque is built.
    assert np.all(np.isnan(jax.jit(total)(-1.0, *good)[1]))


# --- Printed numbers
# ----------------------------------------------------------------------------


def test_bruls_cardona_heavy_top_in_closed_form():
    """See tests/test_published.py: symmetric about body axis 2, which is axis 3 here.

    At 1 s and 2 s against the reference solution of github.com/kynema/kynema, whose own
    error is 1.2e-7 m; at 0.03 s and 0.2 s the five digits of EXUDYN.
    """
    bruls = jr.SymmetricTop(15.234375, 0.46875, 15.0 * 9.81)
    p = FROM_BENCHMARK
    state0 = jr.State(p, np.array([-4.61538, 0.0, 150.0]))
    motion = jr.top_motion(bruls, state0, np.array([0.03, 0.2, 1.0, 2.0]))
    attitudes = jax.vmap(lambda q: rotation.multiply(q, rotation.conjugate(p)))(
        motion.attitude
    )
    printed = [
        ([-0.62679, 0.057939, 0.77611, 0.037845], 5e-6),
        ([-0.70828, 0.43878, 0.54573, 0.0894], 5e-6),
        (
            [
                0.7329439942283007,
                -0.2782856278135421,
                0.5318246439927058,
                -0.3201761370231893,
            ],
            5e-7,
        ),
        (
            [
                0.1229471344095339,
                -0.4910798717314375,
                0.3504301068655838,
                -0.7879868665928781,
            ],
            5e-7,
        ),
    ]
    for found, (quaternion, digit) in zip(np.asarray(attitudes), printed, strict=True):
        found = found * np.sign(found @ np.array(quaternion))
        np.testing.assert_allclose(found, quaternion, rtol=0, atol=digit)
    np.testing.assert_allclose(motion.omega[0], [1.8644, -4.2537, 150.0], rtol=1e-5)
    # And against the quaternions' equations, to their accuracy over 300 radians.
    attitudes = long_motions()["bruls"].attitude
    for a, b in zip(np.asarray(motion.attitude[2:]), attitudes[[50, 100]], strict=True):
        np.testing.assert_allclose(a, b * np.sign(a @ b), atol=1e-9)


def test_simo_wong_heavy_top_in_closed_form():
    """See tests/test_published.py: H = 1269.975 as printed, kept;
    the cosine of the tilt 0.99875.

    Beside it the quaternions' equations, and the mean precession by quadrature.
    """
    simo = jr.SymmetricTop(5.0, 1.0, 20.0)
    state0 = jr.State(TILTED, np.array([0.0, 0.0, 50.0]))
    keeps = top.conserved(simo, state0)
    assert keeps.energy == pytest.approx(1269.975, abs=5e-4)
    times = np.linspace(0.0, 10.0, 101)
    states = jr.top_motion(simo, state0, times)
    energies = jax.vmap(lambda s: top.conserved(simo, s).energy)(states.states)
    np.testing.assert_allclose(energies, keeps.energy, rtol=1e-14)
    assert np.cos(nutation(simo, state0).bounds.theta_min) == pytest.approx(
        0.99875, abs=5e-6
    )
    np.testing.assert_allclose(
        states.attitude, long_motions()["simo"].attitude, atol=1e-9
    )
    with mp.workdps(25):
        _, _, period, phi, _ = quadratures(simo, state0)
    assert nutation(simo, state0).period == pytest.approx(float(period), rel=1e-12)
    assert nutation(simo, state0).precession == pytest.approx(
        float(phi / period), rel=1e-11
    )


def test_curtis_example_11_15():
    """Steady precession of a top at 60 degrees and 1000 rpm: 51.93 rpm as printed.

    H. D. Curtis, Orbital Mechanics for Engineering Students, 4th ed., example 11.15:
    moments 12e-4 and 4.5e-4 kg m^2 about the fixed point, 0.5 kg at 5 cm, g = 9.807
    m/s^2.
    """
    curtis = jr.SymmetricTop(12e-4, 4.5e-4, 0.5 * 9.807 * 0.05)
    rpm = 2 * np.pi / 60
    rates = top.steady_precession(curtis, np.radians(60), psi_dot=1000 * rpm)
    assert rates.slow / rpm == pytest.approx(51.93, abs=0.005)
    state = top.initial_state(
        curtis, np.radians(60), psi_dot=1000 * rpm, phi_dot="slow"
    )
    assert nutation(curtis, state).precession / rpm == pytest.approx(51.93, abs=0.005)


# --- Bad input
# ----------------------------------------------------------------------------------


FORMULAS = {
    "conserved": top.conserved,
    "nutation_bounds": top.nutation_bounds,
    "nutation_period": top.nutation_period,
    "mean_precession": top.mean_precession,
    "advance_per_nutation": top.advance_per_nutation,
    "cubic": lambda one, s: top.cubic(
        one, top.Conserved(s.omega[2], 2.0, s.attitude[0])
    ),
    "angle_rates": lambda one, s: top.angle_rates(one, s.attitude[0], s.omega[2], 2.0),
    "effective_potential": lambda one, s: top.effective_potential(
        one, jnp.stack([s.attitude[0], s.attitude[0]]), s.omega[2], 2.0
    ),
    "steady_precession": lambda one, s: top.steady_precession(
        one, s.attitude[0], s.omega[2]
    )[:2],
    "gyroscopic": lambda one, s: top.gyroscopic(one, s.attitude[0], s.omega[2]),
    "sleeping_spin": lambda one, _: top.sleeping_spin(one),
}


@pytest.mark.parametrize("name", FORMULAS)
def test_formulas_are_nan_in_a_bad_lane_and_leave_the_others_and_what_is_shared_alone(
    name,
):
    """Bad tops, then bad states; the slopes of what all lanes share are those of the
    good ones."""
    state = start("wave", psi=0.3, theta_dot=0.1)

    def total(shared, i1, attitudes, omegas):
        def one(i1, attitude, omega):
            own = jr.SymmetricTop.unchecked(
                i1 + shared[0], 0.5 + shared[1], 1 + shared[2]
            )
            return FORMULAS[name](
                own, jr.State(attitude + shared[3], omega + shared[4])
            )

        values = jax.tree.leaves(jax.vmap(one)(i1, attitudes, omegas))
        return sum(jnp.sum(jnp.where(jnp.isnan(x), 0.0, x)) for x in values), values

    both = quick_jit(jax.value_and_grad(total, argnums=(0, 1), has_aux=True))
    i1 = np.array([1.0, 1.0, -1.0, np.nan, np.inf, 1.0, 1.0, 1.2])
    bad = np.array([0, 0, 0, 0, 0, 1, 1, 0], bool)
    attitudes, omegas = (np.tile(x, (8, 1)) for x in (state.attitude, state.omega))
    attitudes[5], omegas[6] = np.nan, np.inf
    (_, values), slopes = both(jnp.zeros(5), i1, attitudes, omegas)
    outside = ~(i1 < 2) | (i1 < 0) | (bad & (name != "sleeping_spin"))
    for value in values:
        isnan = np.isnan(value).reshape(8, -1)
        np.testing.assert_array_equal(
            isnan, np.broadcast_to(outside[:, None], isnan.shape)
        )
    tame = np.flatnonzero(~outside)
    assert np.all(np.isfinite(slopes[0]))
    assert np.all(np.asarray(slopes[1])[outside] == 0)
    alone = sum(
        both(jnp.zeros(5), *(np.stack([x[k]] * 8) for x in (i1, attitudes, omegas)))[1][
            0
        ]
        / 8
        for k in tame
    )
    np.testing.assert_allclose(slopes[0], alone, rtol=1e-12, atol=1e-12)


def test_tilts_that_are_nan_are_so_alone():
    """Of `effective_potential`, which takes tilts of any shape."""
    tilts = jnp.array([[0.3, np.nan], [1.0, np.inf]])

    def total(p_phi, tilts):
        v = top.effective_potential(TOP, tilts, p_phi, 2.0)
        return jnp.nansum(v), v

    both = quick_jit(jax.grad(total, has_aux=True))
    slope, v = both(1.0, tilts)
    np.testing.assert_array_equal(np.isnan(v), [[False, True], [False, True]])
    good, _ = both(1.0, tilts[:, [0, 0]])
    np.testing.assert_allclose(2 * slope, good, rtol=1e-14)


@pytest.mark.parametrize("attitude", [2 * np.eye(4)[0], np.zeros(4)])
def test_an_attitude_that_is_none_is_outside_of_every_formula(attitude):
    state = jr.State(attitude, np.array([0.1, 0.2, 5.0]))
    for name in ("conserved", "nutation_bounds", "nutation_period", "mean_precession"):
        assert np.all(np.isnan(jax.tree.leaves(FORMULAS[name](TOP, state))))
    assert nutation(TOP, state).kind == top.CLASSES.undefined


def test_kinds_of_bad_lanes_are_undefined():
    i1 = jnp.array([1.0, -1.0, np.nan])
    kinds = jax.vmap(
        lambda x: top.motion_class(
            jr.SymmetricTop.unchecked(x, 0.5, 1.0), start("wave")
        )
    )(i1)
    np.testing.assert_array_equal(kinds == top.CLASSES.undefined, [False, True, True])
    np.testing.assert_array_equal(kinds == top.CLASSES.wave, [True, False, False])


def test_no_steady_precession_leaves_shared_slopes_alone():
    def total(i1, spins):
        def one(spin):
            return top.steady_precession(jr.SymmetricTop(i1, 0.5, 1.0), 0.7, spin)[:2]

        rates = jax.vmap(one)(spins)
        return sum(jnp.nansum(x) for x in rates)

    slope = quick_jit(jax.grad(total))
    found = slope(1.0, jnp.array([6.0, 0.1, 0.0, np.nan]))
    np.testing.assert_allclose(found, slope(1.0, jnp.full(4, 6.0)) / 4, rtol=1e-13)


def test_no_spin_is_nan_of_the_fast_top_alone():
    def total(i3, spins):
        fast = jax.vmap(
            lambda w: top.gyroscopic(jr.SymmetricTop(1.0, i3, 1.0), 0.7, w)
        )(spins)
        return sum(jnp.nansum(x) for x in fast)

    slope = jax.grad(total)(0.5, jnp.array([6.0, 0.0, 7.0]))
    np.testing.assert_allclose(
        slope, jax.grad(total)(0.5, jnp.array([6.0, 7.0])), rtol=1e-13
    )


def test_special_motions_outside_their_domain():
    assert np.isnan(top.sleeping_spin(jr.SymmetricTop.unchecked(0.0, 0.5, 1.0)))
    rates = top.steady_precession(TOP, np.nan, 1.0)
    assert np.isnan(rates.slow)
    assert np.isnan(rates.fast)
    assert not rates.exists
    flat = jr.SymmetricTop.unchecked(1.0, 0.0, 1.0)
    assert not top.steady_precession(flat, 0.5, 1.0).exists
    with pytest.raises(ValueError, match="must be given, and one only"):
        top.steady_precession(TOP, 0.5)
    assert top.sleeping_spin(jr.SymmetricTop(1.0, 0.5, -1.0)) == 0
    assert (
        float(jax.grad(lambda m: top.sleeping_spin(jr.SymmetricTop(1.0, 0.5, m)))(-1.0))
        == 0
    )
    assert top.sleeping_spin(TOP) == pytest.approx(4.0, abs=ulps(float, 4))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: top.sleeping_spin(np.ones(3)), "`top` must be a SymmetricTop"),
        (
            lambda: top.conserved(np.ones(3), start("wave")),
            "`top` must be a SymmetricTop",
        ),
        (lambda: top.conserved(TOP, np.ones(7)), "`state` must be a State"),
        (lambda: top.gyroscopic(TOP, np.ones(2), 1.0), "`theta` must have shape"),
        (
            lambda: top.steady_precession(TOP, 0.5, psi_dot=np.ones(2)),
            "`psi_dot` must have shape",
        ),
        (lambda: top.angle_rates(TOP, 0.5, np.ones(2), 1.0), "`p_phi` must have shape"),
        (
            lambda: top.effective_potential(TOP, 0.5, 1.0, np.ones(2)),
            "`p_psi` must have shape",
        ),
        (
            lambda: top.cubic(TOP, top.Conserved(1.0, 2.0, np.ones(2))),
            "`energy` must have shape",
        ),
        (lambda: top.initial_state(TOP, np.ones(2)), "`theta` must have shape"),
        (lambda: top.initial_state(np.ones(3), 0.5), "`top` must be a SymmetricTop"),
        (
            lambda: jr.SymmetricTop.from_mass_properties(
                jr.solids.disk(1.0, 1.0), np.ones(3), 9.8
            ),
            r"`gravity` must have shape \(3,\)",
        ),
    ],
)
def test_wrong_shapes_and_types_are_value_errors(call, message, untyped):
    with pytest.raises(ValueError, match=message):
        call()
