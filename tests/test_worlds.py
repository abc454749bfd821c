"""The worlds that records come from keep the laws they state."""

import numpy as np
import pytest
import worlds
from worlds import cross, times, turned

TENSOR = np.array([[2.0, -0.3, 0.2], [-0.3, 2.5, 0.4], [0.2, 0.4, 1.7]])
OMEGA = np.array([[0.3, -0.5, 0.8], [1.0, 0.1, -0.2], [-0.6, 0.9, 0.1]])
UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])
TS = np.linspace(0.0, 20.0, 101)


def spread(values):
    """Largest deviation from the first of each trial."""
    return np.max(np.abs(values - values[..., :1, :]))


def in_space(motion, tensor, inside=0.0):
    return turned(motion.attitude, times(tensor, motion.omega) + inside)


def about(axis, angle):
    """Quaternions of a turn about an axis (3,) by angles (...)."""
    axis = np.asarray(axis) / np.linalg.norm(axis)
    half = np.asarray(angle)[..., None] / 2
    return np.concatenate([np.cos(half), np.sin(half) * axis], axis=-1)


def test_a_free_body_keeps_energy_and_momentum():
    motion = worlds.tumble(TENSOR, OMEGA, TS, attitude0=UNTURNED)
    energy = np.sum(motion.omega * times(TENSOR, motion.omega), axis=-1, keepdims=True)
    assert motion.omega.shape == (3, 101, 3)
    assert spread(energy) < 1e-8
    assert spread(in_space(motion, TENSOR)) < 1e-8


def test_the_symmetric_top_is_two_steady_turns():
    tensor, omega0 = np.diag([1.0, 1.0, 1.6]), np.array([0.6, 0.0, 0.8])
    motion = worlds.tumble(tensor, omega0, TS, attitude0=UNTURNED)
    # About the momentum by L / I_1, about the figure axis back by (I_3 - I_1) omega_3 /
    # I_1.
    momentum, slip = tensor @ omega0, 0.6 * 0.8
    figure = np.array([0.0, 0.0, 1.0])
    back = turned(about(figure, slip * TS), omega0)
    assert np.max(np.abs(motion.omega - back)) < 1e-8
    v = np.array([0.2, -0.7, 0.4])
    expected = turned(
        about(momentum, np.linalg.norm(momentum) * TS),
        turned(about(figure, -slip * TS), v),
    )
    assert np.max(np.abs(turned(motion.attitude, v) - expected)) < 1e-8


@pytest.mark.parametrize("part", [None, worlds.LoosePart(0.2, 1.0)])
def test_alpha_is_the_derivative_of_the_rates(part):
    true, _ = worlds.wheel_profile([1.0, 1.0, 0.0], 0.5, 0.0, 4.0)
    ts, drag = np.arange(0.0, 4.0, 0.01), worlds.quadratic_drag(0.1)
    motion = worlds.tumble(TENSOR, OMEGA, ts, drag, true, part=part)
    differences = (motion.omega[:, 2:] - motion.omega[:, :-2]) / 0.02
    # h^2 / 6 times the third derivative, some (2 pi)^2 times alpha
    assert np.max(np.abs(differences - motion.alpha[:, 1:-1])) < 1e-3


def test_a_wheel_inside_takes_momentum_and_reports_it_with_its_errors():
    true, reported = worlds.wheel_profile(
        [1.0, 2.0, 2.0], 1.5, 2.0, 6.0, scale=1.03, delay=0.2
    )
    motion = worlds.tumble(TENSOR, OMEGA, TS, wheel=true, attitude0=UNTURNED)
    momentum, rate = true(TS)
    assert spread(in_space(motion, TENSOR, momentum)) < 1e-8
    assert np.linalg.norm(momentum[-1]) == pytest.approx(1.5)
    differences = (true(TS + 1e-6)[0] - true(TS - 1e-6)[0]) / 2e-6
    assert np.max(np.abs(differences - rate)) < 1e-8
    assert reported(5.0)[0] == pytest.approx(1.03 * true(4.8)[0])


@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_a_loose_part_keeps_momentum_and_loses_energy_to_its_damper_alone(damping):
    part = worlds.LoosePart(0.3, 0.4, damping)
    motion = worlds.tumble(TENSOR, OMEGA, TS, attitude0=UNTURNED, part=part)
    angles, rates = motion.inner[..., :3], motion.inner[..., 3:]
    assert spread(in_space(motion, TENSOR, part.inertia * rates)) < 1e-8
    outer = TENSOR - part.inertia * np.eye(3)
    ball = motion.omega + rates
    energy = np.sum(motion.omega * times(outer, motion.omega), axis=-1)
    energy = energy + part.inertia * np.sum(ball**2, axis=-1)
    energy = energy + part.stiffness * np.sum(angles**2, axis=-1)
    if damping:
        assert np.all(energy[:, 25:] < energy[:, :-25])
    else:
        assert spread(energy[..., None]) < 1e-8


def test_a_stiffer_part_moves_the_body_less():
    free = worlds.tumble(TENSOR, OMEGA, TS[:20])
    moved = [
        np.max(
            np.abs(worlds.tumble(TENSOR, OMEGA, TS[:20], part=part).omega - free.omega)
        )
        for part in (worlds.LoosePart(0.05, 2.0), worlds.LoosePart(0.05, 4.0))
    ]
    assert moved[0] < 0.01
    assert moved[0] / moved[1] == pytest.approx(2.0, rel=0.2)


def test_drag_about_a_principal_axis_decays_as_it_should():
    tensor, c, ts = np.diag([1.0, 2.0, 2.5]), 0.3, np.linspace(0.0, 5.0, 11)
    axes = worlds.random_axes(np.random.default_rng(0))
    motion = worlds.tumble(
        axes @ tensor @ axes.T, 3.0 * axes[:, 2], ts, worlds.quadratic_drag(c)
    )
    expected = 3.0 / (1 + c * 3.0 * ts / 2.5)
    assert motion.omega @ axes[:, 2] == pytest.approx(expected, rel=1e-8)


def test_a_wobble_torque_has_its_size(rng):
    omega0 = 5 * rng.normal(size=(40, 3))
    torque = worlds.wobble_torque(rng, TENSOR, omega0, 0.03)
    squares = [np.mean(torque(t, None) ** 2) * 3 for t in np.linspace(0, 50, 400)]
    gyroscopic = np.mean(np.linalg.norm(cross(times(TENSOR, omega0), omega0), axis=-1))
    assert np.sqrt(np.mean(squares)) == pytest.approx(0.03 * gyroscopic, rel=0.05)


@pytest.mark.parametrize("substeps", [1, 3, None])
def test_kicks_between_samples_have_their_variance(rng, substeps):
    # A ball at rest keeps each kick; another turns, and keeps them in space.
    ts = worlds.random_times(rng, 60, 0.1)
    kick = np.array([0.01, 0.02, 0.05])
    still = worlds.tumble(
        2 * np.eye(3), np.zeros((200, 3)), ts, kick=kick, rng=rng, substeps=substeps
    )
    scaled = np.diff(2 * still.omega, axis=1) / (kick * np.sqrt(np.diff(ts))[:, None])
    # Of 200 * 59 squares of standard normals: one standard error is 1.3 %.
    assert np.mean(scaled**2, axis=(0, 1)) == pytest.approx(1.0, abs=0.05)
    motion = worlds.tumble(
        TENSOR,
        np.tile(OMEGA[:2], (50, 1)),
        ts,
        kick=0.01,
        rng=rng,
        substeps=substeps,
        attitude0=UNTURNED,
    )
    scaled = np.diff(in_space(motion, TENSOR), axis=1) / (
        0.01 * np.sqrt(np.diff(ts))[:, None]
    )
    assert np.mean(scaled**2, axis=(0, 1)) == pytest.approx(1.0, abs=0.07)
    flat = (scaled - np.mean(scaled, axis=0)).reshape(-1, 3)
    assert np.corrcoef(flat.T) == pytest.approx(np.eye(3), abs=0.07)


def test_small_kicks_move_a_free_motion_little(rng):
    free = worlds.tumble(TENSOR, OMEGA, TS)
    kicked = worlds.tumble(TENSOR, OMEGA, TS, kick=1e-9, rng=rng)
    assert np.max(np.abs(kicked.omega - free.omega)) < 1e-6


@pytest.mark.parametrize("tau", [0.0, 0.05, 0.5])
def test_a_held_torque_forgets_itself_within_its_time(rng, tau):
    size, step = np.array([0.01, 0.02, 0.05]), 0.01
    ts = step * np.arange(401)
    torque = worlds.ou_torque(rng, ts, np.tile(size, (2000, 1)), tau)
    assert torque.shape == (2000, 400, 3)
    like = np.exp(-step / tau) if tau else 0.0
    variance = size**2 * (1 - like) / (1 + like) / step
    if tau:
        assert variance == pytest.approx(size**2 / (2 * tau), rel=0.01)
    # Of 2000 trials: of a variance one standard error is 3.2 %.
    for row in (0, 200, 399):
        assert np.var(torque[:, row], axis=0) == pytest.approx(variance, rel=0.15)
    product = np.mean(torque[:, 1:] * torque[:, :-1], axis=(0, 1))
    assert product / variance == pytest.approx(like, abs=0.05)
    # A ball keeps what it was given.
    few = torque[:100]
    still = worlds.tumble(2 * np.eye(3), np.zeros((100, 3)), ts, held=few)
    given = step * np.cumsum(few, axis=1)
    assert 2 * still.omega[:, 1:] == pytest.approx(given, abs=1e-12)


def test_a_held_torque_is_one_of_the_body(rng):
    axis = np.array([0.0, 0.0, 1.0])
    held = np.zeros((3, 100, 3))
    free = worlds.tumble(TENSOR, OMEGA, TS)
    assert worlds.tumble(TENSOR, OMEGA, TS, held=held).omega == pytest.approx(
        free.omega, abs=1e-5
    )
    # Constant, it does work on the body at the rate of torque times omega.
    ts = np.linspace(0.0, 5.0, 2001)
    held = np.broadcast_to(0.3 * axis, (3, 2000, 3))
    motion = worlds.tumble(TENSOR, OMEGA, ts, held=held)
    energy = np.sum(motion.omega * times(TENSOR, motion.omega), axis=-1) / 2
    rate = 0.3 * motion.omega[..., 2]
    work = np.sum((rate[:, 1:] + rate[:, :-1]) / 2 * np.diff(ts), axis=1)
    assert energy[:, -1] - energy[:, 0] == pytest.approx(work, abs=1e-4)


@pytest.mark.parametrize("dense", [True, False])
def test_a_lag_turns_and_shrinks_a_sinusoid(rng, dense):
    rate, constant, delay = 12.0, 0.02, 0.015
    ts = 1.0 + np.sort(rng.uniform(0, 2, size=300))

    def source(t):
        return np.sin(rate * t)[:, None] * np.array([1.0, 2.0, -1.0])

    grid = np.linspace(-1.0, 3.0, 20001)
    readings = worlds.gyro(
        (grid, source(grid)) if dense else source,
        ts,
        rng,
        0.0,
        delay=delay,
        time_constant=constant,
    )
    x = rate * constant
    expected = source(ts - delay - np.arctan(x) / rate) / np.sqrt(1 + x**2)
    assert np.max(np.abs(readings - expected)) < 1e-4


def test_a_lagged_ramp_has_settled_from_the_first_sample():
    t = np.arange(50) * 0.1
    ramp = t[:, None] * np.array([1.0, -2.0, 0.0])
    assert worlds.lagged(ramp, 0.1, 0.3) == pytest.approx(
        ramp - 0.3 * np.array([1.0, -2.0, 0.0])
    )


def test_a_gyro_adds_its_errors(rng):
    ts = np.arange(4000) * 0.01

    def rest(t):
        return np.zeros((len(t), 3))

    turn = np.array([[1.02, 0.0, 0.0], [0.01, 0.98, 0.0], [0.0, 0.0, 1.0]])

    def steady(t):
        return np.tile([1.0, 2.0, 3.0], (len(t), 1))

    noisy = worlds.gyro(rest, ts, rng, [0.1, 0.2, 0.3], bias=[1.0, 2.0, 3.0], drift=0.5)
    free = noisy - 0.5 * ts[:, None] - np.array([1.0, 2.0, 3.0])
    assert np.std(free, axis=0) == pytest.approx([0.1, 0.2, 0.3], rel=0.05)
    assert worlds.gyro(steady, ts[:5], rng, 0.0, matrix=turn)[0] == pytest.approx(
        [1.02, 1.97, 3.0]
    )
    stopped = worlds.gyro(steady, ts, rng, 0.5, limit=2.0, quantum=0.25)
    assert np.max(np.abs(stopped)) == 2.0
    assert np.all(stopped % 0.25 == 0)
    assert np.mean(stopped[:, 1] == 2.0) > 0.5
    walk = worlds.gyro(rest, ts, rng, 0.0, walk=0.3)
    assert walk[0] == pytest.approx(0.0)
    assert np.mean(np.diff(walk, axis=0) ** 2) == pytest.approx(0.3**2 * 0.01, rel=0.05)


def test_an_accelerometer_feels_what_a_point_of_the_body_does(rng):
    ts = np.arange(0.0, 2.0, 0.002)
    lever = np.array([0.1, -0.05, 0.2])
    motion = worlds.tumble(TENSOR, OMEGA[0], ts, attitude0=UNTURNED)
    place = turned(motion.attitude, lever)
    second = (place[2:] - 2 * place[1:-1] + place[:-2]) / 0.002**2
    felt = turned(motion.attitude, worlds.accelerometer(motion, lever, rng, 0.0))
    assert np.max(np.abs(felt[1:-1] - second)) < 1e-6
    held = worlds.accelerometer(motion, np.zeros(3), rng, 0.0, gravity=[0.0, 0.0, -9.8])
    up = np.broadcast_to([0.0, 0.0, 9.8], held.shape)
    assert turned(motion.attitude, held) == pytest.approx(up, abs=1e-9)


@pytest.mark.parametrize("kind", worlds.KINDS)
def test_random_bodies_can_be(rng, kind):
    for _ in range(50):
        moments = np.linalg.eigvalsh(worlds.random_body(rng, kind))
        assert np.mean(moments) == pytest.approx(1.0)
        assert moments[0] > 0
        assert moments[0] + moments[1] >= moments[2] * (1 - 1e-12)
        gaps = np.diff(moments)
        assert (np.min(gaps) < 1e-12) == (kind == "symmetric")
        if kind == "nearly sphere":
            assert np.sum(gaps) < 0.15
        if kind == "flat":
            assert moments[0] + moments[1] - moments[2] < 0.1
        if kind == "rod":
            assert moments[0] < 0.1 * moments[1]
    with pytest.raises(ValueError, match="kind must be one of"):
        worlds.random_body(rng, "cube")


def test_random_records_are_of_every_sort_and_repeat_themselves():
    kinds, counts = set(), []
    for seed in range(8):
        record = worlds.random_record(np.random.default_rng(seed), largest=200)
        again = worlds.random_record(np.random.default_rng(seed), largest=200)
        assert np.array_equal(record.readings, again.readings)
        assert np.all(np.diff(record.ts) > 0)
        assert np.all(np.isfinite(record.readings))
        noise = np.std(record.readings - record.omega)
        assert noise == pytest.approx(record.sigma, rel=0.5)
        kinds.add(record.kind)
        counts.append(len(record.ts))
    assert len(kinds) > 2
    assert min(counts) >= 5
    assert max(counts) <= 200


@pytest.mark.parametrize("kick", [0.0, 0.01])
def test_trials_are_what_they_say(kick):
    clean = {"drag": 0.0, "wobble": 0.0, "time_constant": 0.0, "kick": kick}
    records = worlds.trials(np.random.default_rng(1), 8, "racquet", **clean)
    moments = np.linalg.eigvalsh(records[0].tensor)
    assert moments == pytest.approx(worlds.THROWN["racquet"])
    for record in records:
        assert 0.29 < len(record.ts) / 100 < 1.01
        noise = (record.readings - record.omega) / record.sigma
        assert np.mean(noise**2) == pytest.approx(1.0, abs=0.5)
        momentum = np.linalg.norm(times(record.tensor, record.omega), axis=-1)
        steady = np.max(np.abs(momentum / momentum[0] - 1))
        assert steady < 1e-8 if kick == 0 else 1e-4 < steady < 0.1


def test_trials_under_a_held_torque_gain_momentum_with_their_spin():
    axes = worlds.random_axes(np.random.default_rng(3))
    clean = {
        "drag": 0.0,
        "wobble": 0.0,
        "time_constant": 0.0,
        "sigma": 0.0,
        "axes": axes,
    }
    size = np.array([0.0, 0.0, 0.01])
    records = worlds.trials(
        np.random.default_rng(1),
        200,
        "racquet",
        spin=(2.0, 40.0),
        duration=(0.5, 0.5),
        rate=200.0,
        ou=size,
        tau=0.0,
        **clean,
    )
    gained = []
    for record in records:
        mean = np.trace(record.tensor) / 3
        spin = np.linalg.norm(record.omega[0])
        push = times(record.tensor, np.gradient(record.omega, record.ts, axis=0))
        push -= cross(times(record.tensor, record.omega), record.omega)
        gained.append(np.std(push @ axes, axis=0) / mean / spin)
    across, _, along = np.median(gained, axis=0)
    # Differences over two steps of 5 ms each average white torque over 10 ms.
    assert along == pytest.approx(0.01 / np.sqrt(0.01), rel=0.2)
    assert across < 0.1 * along


def test_a_phone_in_the_air_is_measured_late():
    records = worlds.trials(np.random.default_rng(2), 6, sigma=0.0, time_constant=0.005)
    for record in records:
        # The second term of the low-pass is (T turned)^2 times the rate.
        late = record.omega - 0.005 * record.alpha
        assert np.max(np.abs(record.readings - late)) < 0.1
        assert np.max(np.abs(record.readings - record.omega)) > 3 * np.max(
            np.abs(record.readings - late)
        )
        spin = np.linalg.norm(record.omega, axis=-1)
        assert spin[-1] != spin[0]
