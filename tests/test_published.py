"""Published motions, made by others: each test is named after its source and cites it
in full.

References are compared through scipy's rotations, not this package's own.
"""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import jrigid as jr
from jrigid.mass import MassProperties

DATA = Path(__file__).parent / "data"
SLUG_FT2 = 14.593902937206364 * 0.3048**2  # in kg m^2
MU_EARTH = 3.986004415e14


def scipy_rotation(attitudes):
    """scipy's rotation of scalar-first quaternions."""
    return Rotation.from_quat(np.roll(np.asarray(attitudes), -1, axis=-1))


def degrees_between(attitudes, rotations):
    """Angle between attitudes of this package and scipy's rotations [deg]."""
    return np.degrees((scipy_rotation(attitudes).inv() * rotations).magnitude())


def quaternion_of(rotation):
    """Scalar-first quaternion of a scipy rotation."""
    return np.roll(rotation.as_quat(), 1)


# --- NASA Engineering and Safety Center: a tumbling brick
# --------------------------------------

BRICK = np.array([0.001894220, 0.006211019, 0.007194665]) * SLUG_FT2
EARTH_RATE = 7.292115e-5  # rad/s, WGS-84


def nesc_record(name):
    """Times, attitudes and rates relative to inertial space of a NESC record,
    and its columns."""
    lines = [x for x in (DATA / name).read_text().splitlines() if not x.startswith("#")]
    data = np.genfromtxt(lines, delimiter=",", names=True)
    yaw_pitch_roll = [data[f"eulerAngle_deg_{x}"] for x in ("Yaw", "Pitch", "Roll")]
    local = Rotation.from_euler("ZYX", np.stack(yaw_pitch_roll, 1), degrees=True)
    # On the equator at longitude 0: north is z, east is y, down is -x of the inertial
    # frame.
    north_east_down = Rotation.from_matrix([[0, 0, -1], [0, 1, 0], [1, 0, 0]])
    turned = EARTH_RATE * data["time"] + np.radians(data["longitude_deg"])
    inertial = Rotation.from_euler("z", turned[:, None]) * north_east_down * local
    rates = [data[f"bodyAngularRateWrtEi_deg_s_{x}"] for x in ("Roll", "Pitch", "Yaw")]
    return data["time"], inertial, np.stack(rates, 1), data


@pytest.mark.parametrize("simulation", ["01", "04"])
def test_nesc_case_02_dragless_tumbling_brick(simulation):
    """Free asymmetric body over 30 s, two independent NASA programs.

    D. G. Murri, E. B. Jackson, R. O. Shelton, "Check-Cases for Verification of
    6-Degree-of-Freedom Flight Vehicle Simulations", NASA/TM-2015-218675
    (NESC-RP-12-00770), 2015, atmospheric case 02;
    https://nescacademy.nasa.gov/flightsim/2015/atmospheric/acc02. Public domain.
    """
    ts, attitudes, rates, _ = nesc_record(f"nesc_case_02_sim_{simulation}.csv")
    state0 = jr.State(quaternion_of(attitudes[0]), np.radians([10.0, 20.0, 30.0]))
    states = jr.simulate(jr.RigidBody(BRICK), state0, ts, rtol=1e-11).states
    # 12 digits are printed of angles up to 180 degrees; the programs' own errors are
    # 5e-9.
    assert degrees_between(states.attitude, attitudes).max() < 1e-8
    assert np.abs(np.degrees(states.omega) - rates).max() < 1e-9


class FallingDrag(eqx.Module):
    """Rate damping in proportion to (density times airspeed),
    interpolated from a record."""

    knots: jax.Array
    coefficients: jax.Array  # (4, intervals), highest power first
    per_density_speed: jax.Array

    def density_speed(self, t):
        interval = jnp.clip(jnp.searchsorted(self.knots, t) - 1, 0, self.knots.size - 2)
        a, b, c, d = self.coefficients[:, interval]
        s = t - self.knots[interval]
        return ((a * s + b) * s + c) * s + d

    def __call__(self, t, state, args):
        drag = jr.torques.LinearDrag(self.per_density_speed * self.density_speed(t))
        return drag(t, state, args)


def test_nesc_case_03_damped_tumbling_brick():
    """A forced body: rate damping that grows as the brick falls, over 15 s.

    Torque -(1/4) rho V S diag(b^2, c^2, b^2) omega with S = 2/9 ft^2, b = 1/3 ft, c =
    2/3 ft. D. G. Murri, E. B. Jackson, R. O. Shelton, "Check-Cases for Verification of
    6-Degree-of-Freedom Flight Vehicle Simulations", NASA/TM-2015-218675
    (NESC-RP-12-00770), 2015, atmospheric case 03, simulation 04;
    https://nescacademy.nasa.gov/flightsim/2015/atmospheric/acc03. Public domain.
    """
    ts, attitudes, rates, data = nesc_record("nesc_case_03_sim_04.csv")
    # slug/ft^3 times ft/s, as a function of time; lengths in feet
    density_speed = (
        data["airDensity_slug_ft3"] * data["mach"] * data["speedOfSound_ft_s"]
    )
    area, span, chord = 2 / 9, 1 / 3, 2 / 3
    damping = 0.25 * area * np.array([span**2, chord**2, span**2]) * SLUG_FT2
    spline = CubicSpline(ts, density_speed)
    torque = FallingDrag(jnp.asarray(ts), jnp.asarray(spline.c), jnp.asarray(damping))

    state0 = jr.State(quaternion_of(attitudes[0]), np.radians([10.0, 20.0, 30.0]))
    states = jr.simulate(jr.RigidBody(BRICK, torque), state0, ts, rtol=1e-11).states
    # 12 digits printed, and a spline through 76 of them.
    assert degrees_between(states.attitude, attitudes).max() < 2e-8
    assert np.abs(np.degrees(states.omega) - rates).max() < 5e-9
    # By then damping has taken 96 per cent of the rates: this record tests nothing else
    # so much.
    assert np.linalg.norm(rates[-1]) < 0.05 * np.linalg.norm(rates[0])

    columns = [data[f"aero_bodyMoment_ftlbf_{x}"] for x in "LMN"]
    published = np.stack(columns, 1)[1:] * SLUG_FT2  # ft lbf = slug ft^2/s^2
    each = jax.vmap(lambda t, omega: torque(t, jr.State(state0.attitude, omega), None))
    moments = each(jnp.asarray(ts[1:]), jnp.asarray(np.radians(rates[1:])))
    np.testing.assert_allclose(moments, published, rtol=1e-9)


# --- NASA JEOD: the Space Station, and a cylinder in the gradient of gravity
# -------------------- NASA, JSC Engineering Orbital Dynamics (JEOD) v5,
# github.com/nasa/jeod, commit 6550cf4e,
# verif/SIM_dyncomp/SET_test_val/RUN_{9B,10A}/log_state_ASCII.csv; NASA Open Source
# Agreement 1.3. A few rows are quoted: omega [rad/s], body components; matrix from
# inertial space to the body.

STATION = np.array(
    [[1.02e8, -6.96e6, -5.48e6], [-6.96e6, 0.91e8, 5.90e5], [-5.48e6, 5.90e5, 1.64e8]]
)
RUN_9B = {
    0.0: (
        [0.0, -0.001134454274550824, 0.0],
        [
            [0.1412307175854335, -0.9892782736897275, 0.03718039289432368],
            [-0.772691975098125, -0.1336331223242703, -0.6205556383087864],
            [0.6188707425862547, 0.05891252687959725, -0.7832804849780175],
        ],
    ),
    300.0: (
        [-5.106463907717681e-06, -0.001134509943563471, -1.660053348917274e-05],
        [
            [0.3415658073139367, -0.9125430205269727, -0.2249400697107739],
            [-0.7723818914715976, -0.1361788701315136, -0.6203882083473713],
            [0.5354988450041099, 0.3856430357431772, -0.7513457499593983],
        ],
    ),
    28380.0: (
        [-0.0006751510826350463, -0.0008761232217911557, -0.0002500148631562042],
        [
            [-0.06278799948222935, -0.3936799236910871, -0.9171007495382389],
            [-0.95935119155823, -0.2295239221394971, 0.1642073701802287],
            [-0.2751417059931559, 0.8901319491223096, -0.3632659559811431],
        ],
    ),
    28800.0: (
        [-0.0007282187220568775, -0.0008332384627087039, -0.0002424925044840342],
        [
            [-0.110781359605145, -0.0346505107912517, -0.9932405712947602],
            [-0.8498349541130382, -0.5148480361227724, 0.1127477293262038],
            [-0.5152747239402747, 0.8565809020766398, 0.02758835018344352],
        ],
    ),
}


def jeod_state(row):
    """Angular velocity and scipy rotation, body to space, of a quoted row."""
    return np.array(row[0]), Rotation.from_matrix(np.array(row[1]).T)


def test_jeod_run_9b_published_angular_acceleration():
    """Euler's equations with products of inertia, to the last digit.

    NASA JEOD v5 (commit 6550cf4e), verif/SIM_dyncomp RUN_9B, "Rotational State
    Comparison: Torque, Initial Rate": the angular acceleration logged at t = 0.
    """
    omega, _ = jeod_state(RUN_9B[0.0])
    published = [-1.042747386314226e-08, -4.411614753593177e-10, -5.496529462673259e-08]
    acceleration = jr.euler_equations(STATION, omega)
    # Cancellation of terms a hundred times larger costs two digits.
    np.testing.assert_allclose(acceleration, published, rtol=1e-13)


def test_jeod_run_9b_space_station_with_torque_pulse():
    """Tensor with products of inertia; 10 N m about body x from 1000 s to 2000 s;
    8 hours.

    NASA JEOD v5 (commit 6550cf4e), verif/SIM_dyncomp RUN_9B, "Rotational State
    Comparison: Torque, Initial Rate", of the same family as the NESC exo-atmospheric
    check-cases of NASA/TM-2015-218675. The integration stops and starts where the
    torque jumps.
    """

    def leg(state, begin, ends, push):
        body = jr.RigidBody(STATION, jr.torques.Constant(np.array([push, 0.0, 0.0])))
        return jr.simulate(body, state, np.array(ends), t0=begin, rtol=1e-12)

    def check(state, time, degrees):
        omega, rotation = jeod_state(RUN_9B[time])
        assert degrees_between(state.attitude, rotation) < degrees
        # 1e-12 of the rates: five times what JEOD's integration is off by
        np.testing.assert_allclose(state.omega, omega, rtol=0, atol=1e-15)

    omega, rotation = jeod_state(RUN_9B[0.0])
    free = leg(jr.State(quaternion_of(rotation), omega), 0.0, [300.0, 1000.0], 0.0)
    pushed = leg(free.final_state, 1000.0, [1500.0, 2000.0], 10.0)
    late = leg(pushed.final_state, 2000.0, [28380.0, 28800.0], 0.0)
    # Bounds: ten times the disagreement, 1e-12 and 9e-11 degrees, which is JEOD's own
    # error (an independent integration finds the same). Without the pulse the end is
    # off by 5.2 degrees.
    check(jax.tree.map(lambda x: x[0], free.states), 300.0, 1e-11)
    check(jax.tree.map(lambda x: x[0], late.states), 28380.0, 1e-9)
    check(late.final_state, 28800.0, 1e-9)


CYLINDER = np.array([500.0, 12250.0, 12250.0])
RUN_10A_START = (
    [-1.97989570839746e-05, -0.001134281491669957, 0.0],
    [
        [-0.6443912270931274, 0.05284210190675609, 0.7628680480341864],
        [-0.7615617870471506, -0.1345758407161209, -0.6339660776454052],
        [0.06916350883930189, -0.9894933326514259, 0.1269620166955875],
    ],
)
RUN_10A_POSITION = np.array([-4292653.41, 955168.47, 5139356.57])
RUN_10A_VELOCITY = np.array([109.649663, -7527.72649, 1484.521489])
RUN_10A_END = {
    300.0: (
        [-1.97989570839746e-05, -0.001042888574458625, -2.40799696123295e-05],
        [
            [-0.5861515024150195, -0.2666556032407258, 0.7650628768127101],
            [-0.7648570200749972, -0.1293549559252893, -0.6310792614399254],
            [0.2672454958621582, -0.9550717693649473, -0.1281318083205654],
        ],
        [-4013924.982713786, -1314597.200719335, 5281075.779524183],
    ),
    28800.0: (
        [-1.97989570839746e-05, -0.001080027400090759, -0.0007098670173048437],
        [
            [-0.1303977224153033, -0.9235551691194414, 0.3606137595567613],
            [-0.9835635249313684, 0.0746803593168579, -0.1643947576928366],
            [0.1248968631050554, -0.3761232424685627, -0.9181133263717784],
        ],
        [-1024262.411095882, -6151093.565368023, 2599975.06217899],
    ),
}


class KeplerOrbit(eqx.Module):
    """Position on the elliptic orbit through a position and a velocity at t = 0."""

    position0: jax.Array
    velocity0: jax.Array

    def __call__(self, t):
        r0, v0 = self.position0, self.velocity0
        distance = jnp.sqrt(jnp.sum(r0**2))
        a = 1 / (2 / distance - jnp.sum(v0**2) / MU_EARTH)
        n = jnp.sqrt(MU_EARTH / a**3)
        c, s = 1 - distance / a, jnp.sum(r0 * v0) / jnp.sqrt(MU_EARTH * a)
        # Kepler's equation in the difference of eccentric anomalies x, by Newton's
        # method
        x = n * t
        for _ in range(4):  # eccentricity 0.001
            sin, cos = jnp.sin(x), jnp.cos(x)
            x = x - (x - c * sin + s * (1 - cos) - n * t) / (1 - c * cos + s * sin)
        f = 1 - a / distance * (1 - jnp.cos(x))
        g = t - (x - jnp.sin(x)) / n
        return f * r0 + g * v0


def flying_cylinder():
    """The orbit integrated with the attitude, the torque from the state's own
    position."""
    body = MassProperties(1000.0, np.zeros(3), CYLINDER)

    def gravity(t, state, args):
        r = state.position
        return -MU_EARTH * body.mass * r / jnp.sum(r**2) ** 1.5

    def gradient(t, state, args):
        torque = jr.torques.GravityGradient(MU_EARTH, lambda _: state.position)
        return torque.of_body(CYLINDER)(t, state, args)

    omega, rotation = jeod_state(RUN_10A_START)
    attitude = quaternion_of(rotation)
    state0 = jr.FloatingState(RUN_10A_POSITION, RUN_10A_VELOCITY, attitude, omega)
    return jr.FloatingBody(body, gravity, gradient), state0


def guided_cylinder():
    """The orbit given as a function of time."""
    orbit = KeplerOrbit(jnp.asarray(RUN_10A_POSITION), jnp.asarray(RUN_10A_VELOCITY))
    torque = jr.torques.GravityGradient(MU_EARTH, orbit)
    omega, rotation = jeod_state(RUN_10A_START)
    return jr.RigidBody(CYLINDER, torque), jr.State(quaternion_of(rotation), omega)


@pytest.mark.parametrize("case", [flying_cylinder, guided_cylinder])
def test_jeod_run_10a_gravity_gradient_cylinder(case):
    """Libration in the gradient of a spherical Earth's gravity over 8 hours,
    five orbits.

    NASA JEOD v5 (commit 6550cf4e), verif/SIM_dyncomp RUN_10A, "Rot State Comparison:
    Gravity Gradient, Circular, 0 Rate": 85 degrees pitch, 1 degree yaw from local
    vertical.
    """
    system, state0 = case()
    ts = np.array(list(RUN_10A_END))
    states = jr.simulate(system, state0, ts, rtol=1e-14).states
    for i, row in enumerate(RUN_10A_END.values()):
        omega, rotation = jeod_state(row)
        # Ten times the disagreement after eight hours: 6e-11 deg, 2e-16 rad/s, 4e-6 m.
        assert degrees_between(states.attitude[i], rotation) < 6e-10
        np.testing.assert_allclose(states.omega[i], omega, rtol=0, atol=2e-15)
        if hasattr(states, "position"):
            np.testing.assert_allclose(states.position[i], row[2], rtol=0, atol=4e-5)


def test_hughes_libration_periods():
    """Small libration of RUN_10A's cylinder on a circular orbit has the printed
    periods.

    Printed in NASA JEOD v5 (commit 6550cf4e),
    verif/SIM_dyncomp/SET_test/RUN_10A/input.py: 3257.94 s in the plane of the orbit and
    2821.46 s out of it, after P. C. Hughes, Spacecraft Attitude Dynamics, Dover 2004,
    pp. 232-353. The orbit is the one the second belongs to, so that the first is a
    prediction.

    With k = (12250 - 500)/12250 and the mean motion n, the first is 2 pi / (n sqrt(3
    k)). The second, printed as 2 pi / (2 n sqrt(k)), leaves out the coupling of roll
    with yaw, which for a body that does not spin about its axis makes it 2 pi / (n
    sqrt(1 + 3 k)), half a percent less.
    """
    k = (12250 - 500) / 12250
    n = np.pi / (2821.46 * np.sqrt(k))
    radius = (MU_EARTH / n**2) ** (1 / 3)
    orbit = KeplerOrbit(
        jnp.array([radius, 0.0, 0.0]), jnp.array([0.0, n * radius, 0.0])
    )
    body = jr.RigidBody(CYLINDER, jr.torques.GravityGradient(MU_EARTH, orbit))
    # 6e-6 rad: small enough for linear theory, large enough to stand above the
    # tolerance
    push = 1e-5 * n
    state0 = jr.State(np.array([1.0, 0, 0, 0]), np.array([0.0, -push, n + push]))
    coupled = 2821.46 * 2 * np.sqrt(k / (1 + 3 * k))
    ts = np.sort([coupled, 3257.94])

    states = jr.simulate(body, state0, ts, rtol=1e-12).states
    axis = Rotation.from_euler("z", -n * ts[:, None]) * scipy_rotation(states.attitude)
    _, along, across = axis.apply(
        [1.0, 0.0, 0.0]
    ).T  # of the long axis, on the turning vertical
    # After one period each displacement is back at 0, with its first rate: the rest is
    # time.
    assert ts[1] - along[1] / push == pytest.approx(
        3257.94, abs=0.01
    )  # the last digits printed
    assert ts[0] - across[0] / push == pytest.approx(coupled, abs=0.01)


# --- Heavy tops
# ---------------------------------------------------------------------------------


def heavy_top(moments, mass, lever, gravity):
    """A body with a fixed point under gravity along -z."""
    torque = jr.torques.UniformGravity(
        mass, np.array(lever), np.array([0.0, 0.0, -gravity])
    )
    return jr.RigidBody(np.array(moments), torque)


# About the pivot: diag(0.234375, 0.46875, 0.234375) about the centre of mass, 15 kg at
# 1 m.
BRULS_TOP = ([15.234375, 0.46875, 15.234375], 15.0, [0.0, 1.0, 0.0], 9.81)


def test_bruls_cardona_heavy_top():
    """The heavy top by which integrators on Lie groups are compared.

    O. Bruels, A. Cardona, "On the Use of Lie Group Time Integrators in Multibody
    Dynamics", J. Comput. Nonlinear Dyn. 5 (2010) 031002, doi 10.1115/1.4001370; O.
    Bruels, A. Cardona, M. Arnold, Mech. Mach. Theory 48 (2012) 121-137.

    t = 1 s and 2 s: reference solution of github.com/kynema/kynema (commit d3b403dc),
    heavy_top_kynema_material_0pt000002s.csv, at second order with a step of 2e-6 s,
    whose error is 1.2e-7 m. t = 0.03 s and 0.2 s: github.com/jgerstmayr/EXUDYN,
    docs/verification/HeavyTopSolution, RK4, five digits.
    """
    # -4.61538 as printed: -60/13 would end 2.5e-6 away.
    state0 = jr.State(np.array([1.0, 0, 0, 0]), np.array([0.0, 150.0, -4.61538]))
    ts = np.array([0.03, 0.2, 1.0, 2.0])
    states = jr.simulate(heavy_top(*BRULS_TOP), state0, ts, rtol=1e-11).states
    attitudes = np.asarray(states.attitude)

    exudyn = [
        [-0.62679, 0.057939, 0.77611, 0.037845],
        [-0.70828, 0.43878, 0.54573, 0.0894],
    ]
    for attitude, printed in zip(attitudes[:2], np.array(exudyn), strict=True):
        np.testing.assert_allclose(
            attitude * np.sign(attitude @ printed), printed, rtol=1e-5
        )
    np.testing.assert_allclose(states.omega[0], [-4.2537, 150.0, 1.8644], rtol=1e-5)

    displacements = [
        [0.1733440435722807, -0.3599112987333657, -0.7484906793466106],
        [-0.1504168894608856, -1.7241654846852867, -0.6730223697288009],
    ]
    quaternions = [
        [
            0.7329439942283007,
            -0.2782856278135421,
            0.5318246439927058,
            -0.3201761370231893,
        ],
        [
            0.1229471344095339,
            -0.4910798717314375,
            0.3504301068655838,
            -0.7879868665928781,
        ],
    ]
    lever = np.array([0.0, 1.0, 0.0])
    for attitude, displacement, quaternion in zip(
        attitudes[2:], displacements, np.array(quaternions), strict=True
    ):
        moved = scipy_rotation(attitude).apply(lever) - lever
        np.testing.assert_allclose(moved, displacement, rtol=0, atol=5e-7)
        close = attitude * np.sign(attitude @ quaternion)
        np.testing.assert_allclose(close, quaternion, rtol=0, atol=5e-7)


def test_simo_wong_heavy_top_energy():
    """Energy of a fast top as printed, and kept.

    J. C. Simo, K. K. Wong, "Unconditionally Stable Algorithms for Rigid Body Dynamics
    that Exactly Preserve Energy and Momentum", Int. J. Numer. Methods Eng. 31 (1991)
    19-52, as set up and printed in github.com/parmes/parmes,
    solfec/validation/heavy_symmetrical_top.rst: H = 1269.975, cosine of the tilt
    0.99875.
    """
    body = heavy_top([5.0, 5.0, 1.0], 20.0, [0.0, 0.0, 1.0], 1.0)
    state0 = jr.State(
        jr.rotation.exp(np.array([0.05, 0, 0])), np.array([0.0, 0.0, 50.0])
    )
    trajectory = jr.simulate(body, state0, np.array([0.5, 1.0, 5.0, 10.0]), rtol=1e-11)
    tilt = scipy_rotation(state0.attitude).as_matrix()[2, 2]
    assert tilt == pytest.approx(0.99875, abs=5e-6)
    assert body.energy(0.0, state0, None) == pytest.approx(1269.975, abs=5e-4)
    # 500 radians at rtol 1e-11
    np.testing.assert_allclose(
        trajectory.energy, body.energy(0.0, state0, None), rtol=5e-9
    )


@pytest.mark.parametrize("root", [0, 1])
def test_curtis_example_11_26_steady_precession(root):
    """A top set going at a root of the steady-precession equation precesses at that
    rate.

    H. D. Curtis, Orbital Mechanics for Engineering Students, 4th ed., examples 11.15
    and 11.26: 0.5 kg at 5 cm, moments 12e-4 and 4.5e-4 kg m^2 about the pivot, spin
    psi' = 1000 rpm, tilt 60 degrees, g = 9.807 m/s^2; steady precession printed as
    51.93 rpm. The other root is fast.
    """
    transverse, axial, weight, tilt = (
        12e-4,
        4.5e-4,
        0.5 * 9.807 * 0.05,
        np.radians(60.0),
    )
    spin = 1000 * 2 * np.pi / 60
    equation = [(transverse - axial) * np.cos(tilt), -axial * spin, weight]
    precession = np.sort(np.roots(equation))[root]
    angles = np.array([0.3, tilt, 0.1])
    rates = np.array([precession, 0.0, spin])
    state0 = jr.State(
        jr.rotation.from_euler(angles), jr.rotation.euler_rates_to_omega(angles, rates)
    )
    body = heavy_top([transverse, transverse, axial], 0.5, [0.0, 0.0, 0.05], 9.807)
    ts = 2 * np.pi / precession * np.array([0.25, 0.5, 0.75, 1.0])

    states = jr.simulate(body, state0, ts, rtol=1e-11).states
    x, y, z = scipy_rotation(states.attitude).apply([0.0, 0.0, 1.0]).T
    advance = np.unwrap(np.concatenate([[0.3], np.arctan2(x, -y)]))[1:] - 0.3
    rpm = advance / ts * 60 / (2 * np.pi)
    # 120 radians of spin in one slow turn at rtol 1e-11; nutation grows from rounding
    # only.
    np.testing.assert_allclose(np.arccos(z), tilt, rtol=0, atol=1e-8)
    np.testing.assert_allclose(rpm, precession * 60 / (2 * np.pi), rtol=1e-8)
    if root == 0:
        np.testing.assert_allclose(rpm, 51.93, rtol=0, atol=0.005)


# --- Asteroid 4179 Toutatis
# ---------------------------------------------------------------------

# days since 1992-11-09T17:49:47 UTC, z-x-z angles [deg] of the body in the ecliptic
# frame
TOUTATIS = np.array(
    [
        [23.159872685185185, 122.2, 86.5, 107.0],
        [24.069594907407406, 86.3, 81.8, 24.5],
        [25.014039351851853, 47.8, 60.7, 284.0],
        [26.041817129629628, 14.6, 39.4, 207.1],
        [26.986261574074074, 331.3, 23.7, 151.6],
        [27.979317129629628, 222.5, 25.4, 143.9],
        [28.951539351851853, 169.8, 45.5, 106.9],
        [30.000150462962964, 137.3, 71.3, 22.3],
        [30.979317129629628, 103.1, 85.2, 292.6],
        [31.659872685185185, 77.0, 85.7, 225.5],
        [32.6459837962963, 42.8, 70.2, 133.2],
        [33.597372685185185, 13.7, 44.4, 51.9],
        [34.5834837962963, 323.7, 14.0, 0.0],
        [35.5834837962963, 193.2, 24.4, 21.4],
        [36.55570601851852, 165.1, 46.4, 310.6],
        [37.54112268518519, 130.6, 76.1, 234.9],
        [38.55501157407407, 91.6, 81.6, 142.4],
    ]
)


def test_takahashi_toutatis_radar_attitudes():
    """Free rotation from the published epoch state meets the radar attitudes of 1992.

    Y. Takahashi, M. W. Busch, D. J. Scheeres, "Spin State and Moment of Inertia
    Characterization of 4179 Toutatis", Astron. J. 146:95 (2013), tables 1 and 2:
    moments (3.0836, 3.235, 1) about the intermediate, short and long axes, epoch
    attitude (145.498, 65.865, 241.524) degrees, epoch spin (14.51, 33.529, -98.709)
    degrees a day; observations by S. J. Ostro, R. S. Hudson et al.
    """
    day = 86400.0
    body = jr.RigidBody(np.array([3.0836, 3.235, 1.0]))
    attitude0 = jr.rotation.from_euler(np.radians([145.498, 65.865, 241.524]))
    omega0 = np.radians([14.51, 33.529, -98.709]) / day
    states = jr.simulate(body, jr.State(attitude0, omega0), TOUTATIS[:, 0] * day).states
    observed = Rotation.from_euler("ZXZ", TOUTATIS[:, 1:], degrees=True)
    residuals = degrees_between(states.attitude, observed)

    # The body has turned 11 times by the end; the radar's errors are 3 to 15 degrees a
    # row.
    assert np.sqrt(np.mean(residuals**2)) < 8.0
    assert np.median(residuals) < 6.0
    assert residuals.max() < 16.0
    # The same residuals from scipy's DOP853, to the two digits kept.
    independent = [
        7.96,
        7.90,
        15.88,
        9.41,
        2.13,
        15.30,
        3.30,
        3.46,
        3.40,
        2.96,
        3.21,
        5.60,
        5.11,
        8.39,
        8.70,
        1.27,
        6.59,
    ]
    np.testing.assert_allclose(residuals, independent, rtol=0, atol=0.0051)
