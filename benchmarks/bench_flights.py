"""How well `records.flights` finds simulated trials of known release and catch.

A rigid body lies in a hand, is shaken, wound up and thrown. It flies for 0.3 to 1 s
with a spin of 2 to 30 rad/s and is caught, or bounces (40 %) and flies again. In flight
there may be drag on the spin (60 %), drag of the air on the flight, and a wheel that is
switched on and vibrates (25 %). The clock has 50 to 500 Hz. The accelerometer is at a
lever of up to 12 cm; it has noise, a bias, a wrong scale, a wrong alignment, a range of
4, 8 or 16 g, a low-pass filter of up to 6 ms and a delay of up to 3 ms; the gyro has a
low-pass filter of up to 3 ms. The integrator is an explicit Runge-Kutta method of this
file, with steps of 1 ms.

Missed: of the flights of at least 0.25 s, those of which less than half is found.
False: parts found, of which less than half is a flight. Errors are those of the first
and the last row found; an early start and a late end have contact in them. "Both" is
the part of all flights of which start and end are within 30 ms, those missed included.
"""

import dataclasses
import time

import common
import numpy as np
import scipy.signal

import jrigid as jr

GRAVITY = 9.80665
STEP = 1e-3  # [s] of the integrator
TOTAL = 5.0  # [s] of a record
SHORTEST = 0.25  # [s] shorter flights count neither as found nor as missed
WITHIN = 0.03  # [s]
NOISE_FLOOR = 1e-9  # [s] rounding of times
LITTLE = 5e-3  # [s] of contact are not counted


def directions(rng, count):
    """Unit vectors, uniformly distributed."""
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def rotations(rng, count):
    """Quaternions w, x, y, z, uniformly distributed."""
    quaternions = rng.normal(size=(count, 4))
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def matrices(quaternions):
    """Rotation matrices from body to space."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def times_vector(matrix, vectors):
    """Matrices times vectors, trial by trial."""
    return np.einsum("nij,nj->ni", matrix, vectors)


def smooth_step(x):
    """From 0 at x = 0 to 1 at x = 1, with no slope at either end."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def half_sine(x):
    """One arch of a sine between x = 0 and x = 1, else zero."""
    return np.where((x > 0) & (x < 1), np.sin(np.pi * np.clip(x, 0, 1)), 0.0)


class Trials:
    """Bodies, hands and flights, drawn at random; vectorised over the trials."""

    def __init__(self, rng, count):
        """Draw `count` trials."""
        self.count = count
        self.draw_bodies(rng)
        self.draw_flights(rng)
        self.draw_hands(rng)
        self.draw_wheels(rng)

    def draw_bodies(self, rng):
        """Tensors with moments that a body can have, and drag on the spin."""
        parts = rng.uniform(0.05, 1.0, (self.count, 3))
        moments = parts.sum(axis=1, keepdims=True) - parts
        axes = matrices(rotations(rng, self.count))
        self.inertia = np.einsum("nij,nj,nkj->nik", axes, moments, axes)
        self.inverse = np.linalg.inv(self.inertia)
        size = moments.mean(axis=1)
        has_drag = rng.uniform(size=self.count) < 0.6
        self.linear_drag = has_drag * rng.uniform(0, 0.3, self.count) * size
        self.quadratic_drag = has_drag * rng.uniform(0, 0.01, self.count) * size

    def draw_flights(self, rng):
        """Release, contact, and a second flight after a bounce; drag of the air."""
        draw = rng.uniform
        self.release = np.round(draw(1.5, 2.2, self.count), 3)
        self.contact = self.release + np.round(draw(0.3, 1.0, self.count), 3)
        self.bounces = draw(size=self.count) < 0.4
        self.bounce_width = np.where(
            self.bounces, np.round(draw(0.008, 0.02, self.count), 3), 0
        )
        again = np.round(draw(0.15, 0.4, self.count), 3)
        self.catch = self.contact + self.bounces * (self.bounce_width + again)
        spin = 2.0 * 15.0 ** draw(size=self.count)
        self.spin = spin[:, None] * directions(rng, self.count)
        self.speed = draw(1.0, 5.0, self.count)
        self.air_drag = draw(0.0, 0.03, self.count)

    def draw_hands(self, rng):
        """Shaking, winding up, catching."""
        draw = rng.uniform
        shape = (2, self.count, 3, 3)
        self.frequency = 2 * np.pi * draw(0.7, 4.0, shape)
        self.phase = draw(0, 2 * np.pi, shape)
        self.amplitude = draw(0.3, 2.0, shape)
        self.windup = draw(0.2, 0.5, self.count)
        self.letting_go = draw(0.02, 0.05, self.count)
        self.trial_force = draw(8.0, 30.0, self.count)
        self.stiffness = 1 / draw(0.015, 0.04, self.count)
        self.catch_width = draw(0.03, 0.1, self.count)
        self.catch_force = draw(20.0, 120.0, self.count)
        self.bounce_force = draw(80.0, 300.0, self.count)
        kicks = 0.4 * np.linalg.norm(self.spin, axis=1, keepdims=True)
        self.bounce_kick = kicks * directions(rng, self.count)
        tilt = np.array([0.0, 0.0, 1.0]) + 0.3 * rng.normal(size=(self.count, 3))
        self.push = tilt / np.linalg.norm(tilt, axis=1, keepdims=True)

    def draw_wheels(self, rng):
        """A wheel that takes some of the momentum, in a quarter of the trials."""
        draw = rng.uniform
        self.has_wheel = draw(size=self.count) < 0.25
        momentum = np.linalg.norm(times_vector(self.inertia, self.spin), axis=1)
        size = self.has_wheel * draw(0.2, 0.8, self.count) * momentum
        self.wheel = size[:, None] * directions(rng, self.count)
        self.wheel_on = self.release + draw(0.1, 0.5, self.count) * (
            self.contact - self.release
        )
        self.wheel_time = draw(0.1, 0.4, self.count)
        self.vibration = self.has_wheel * draw(0.3, 4.0, self.count)
        self.vibration_frequency = draw(50.0, 120.0, self.count)

    def in_flight(self, t):
        """Whether nothing touches a body at a time."""
        first = (t >= self.release) & (t < self.contact)
        second = (t >= self.contact + self.bounce_width) & (t < self.catch)
        return first | second

    def shaking(self, t, which):
        """A sum of sines: 0 for the rates of a hand, 1 for its accelerations."""
        waves = np.sin(self.frequency[which] * t + self.phase[which])
        return np.sum(self.amplitude[which] * waves, axis=2)

    def change_of_rate(self, t, omega):
        """Angular acceleration: of a free body, or of one in a hand."""
        running = (t - self.wheel_on) / self.wheel_time
        stored = np.clip(running, 0, 1)[:, None] * self.wheel
        taken = (((running > 0) & (running < 1)) / self.wheel_time)[
            :, None
        ] * self.wheel
        momentum = times_vector(self.inertia, omega) + stored
        speed = np.linalg.norm(omega, axis=1)
        drag = (self.linear_drag + self.quadratic_drag * speed)[:, None] * omega
        free = times_vector(self.inverse, -np.cross(omega, momentum) - drag - taken)
        ramp = smooth_step(1 - (self.release - t) / self.windup)[:, None]
        hold = smooth_step((t - self.catch) / 0.02)[:, None]
        before = (1 - ramp) * self.shaking(t, 0) + ramp * self.spin
        target = np.where((t < self.release)[:, None], before, 0.5 * self.shaking(t, 0))
        grip = np.where((t < self.release)[:, None], 1.0, hold)
        held = self.stiffness[:, None] * grip * (target - omega) + (1 - grip) * free
        width = np.maximum(self.bounce_width, STEP)
        arch = half_sine((t - self.contact) / width)
        bounced = free + (np.pi / 2 * arch / width)[:, None] * self.bounce_kick
        touching = (t >= self.contact) & (t < self.contact + self.bounce_width)
        change = np.where(self.in_flight(t)[:, None], free, held)
        return np.where(touching[:, None], bounced, change)

    def specific_force(self, t):
        """Acceleration of the mass centre less gravity, in space."""
        hand = np.array([0.0, 0.0, GRAVITY]) + self.shaking(t, 1)
        trial = self.trial_force * half_sine((t - self.release) / self.windup + 1)
        before = hand + trial[:, None] * self.push
        before = smooth_step((self.release - t) / self.letting_go)[:, None] * before
        caught = self.catch_force * half_sine((t - self.catch) / self.catch_width)
        after = smooth_step((t - self.catch) / self.catch_width)[:, None] * hand
        after = after + caught[:, None] * self.push
        arch = half_sine((t - self.contact) / np.maximum(self.bounce_width, STEP))
        bounce = (self.bounces * self.bounce_force * arch)[:, None] * self.push
        velocity = self.speed - GRAVITY * (t - self.release)
        air = np.zeros((self.count, 3))
        air[:, 2] = -self.air_drag * velocity * np.abs(velocity)
        force = np.where((t < self.release)[:, None], before, after)
        touching = (t >= self.contact) & (t < self.contact + self.bounce_width)
        force = np.where(touching[:, None], bounce, force)
        return np.where(self.in_flight(t)[:, None], air, force)


def motions(rng, trials):
    """Rates, their changes and specific forces in the body, at steps of 1 ms."""
    times = STEP * np.arange(round(TOTAL / STEP))
    omega = np.zeros((trials.count, 3))
    attitude = rotations(rng, trials.count)
    shape = (times.size, trials.count, 3)
    rates, changes, forces = np.zeros(shape), np.zeros(shape), np.zeros(shape)

    def slope(t, omega, attitude):
        w, vector = attitude[:, :1], attitude[:, 1:]
        real = -np.sum(vector * omega, axis=1, keepdims=True)
        turn = 0.5 * np.concatenate([real, w * omega + np.cross(vector, omega)], axis=1)
        return trials.change_of_rate(t, omega), turn

    for i, t in enumerate(times):
        middle, last = t + STEP / 2, t + STEP - 1e-9
        k1 = slope(t, omega, attitude)
        k2 = slope(middle, omega + STEP / 2 * k1[0], attitude + STEP / 2 * k1[1])
        k3 = slope(middle, omega + STEP / 2 * k2[0], attitude + STEP / 2 * k2[1])
        k4 = slope(last, omega + STEP * k3[0], attitude + STEP * k3[1])
        rates[i], changes[i] = omega, k1[0]
        to_body = np.swapaxes(matrices(attitude), 1, 2)
        forces[i] = times_vector(to_body, trials.specific_force(t))
        omega = omega + STEP / 6 * (k1[0] + 2 * k2[0] + 2 * k3[0] + k4[0])
        attitude = attitude + STEP / 6 * (k1[1] + 2 * k2[1] + 2 * k3[1] + k4[1])
        attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    return times, rates, changes, forces


@dataclasses.dataclass
class Case:
    """A record and what is true of it."""

    reading: jr.records.Reading
    flights: list[tuple[float, float]]
    rate: float
    spin: float
    wheel: bool
    bounces: bool


def low_passed(values, time_constant):
    """What a sensor of first order shows; the filter starts at the first value."""
    decay = np.exp(-STEP / max(time_constant, 1e-6))
    start = decay * values[:1]
    return scipy.signal.lfilter([1 - decay], [1, -decay], values, axis=0, zi=start)[0]


def read_by_sensors(rng, fine, rates, changes, forces, vibration, frequency):
    """What a gyro and an accelerometer at a lever show of a motion."""
    rate = 50.0 * 10.0 ** rng.uniform()
    times = np.arange(0.01, TOTAL - 0.02, 1 / rate)
    times = times + rng.choice([0.0, 0.02]) / rate * rng.uniform(-1, 1, times.size)
    lever = rng.uniform(0, 0.12) * directions(rng, 1)[0]
    shown = forces + np.cross(changes, lever) + np.cross(rates, np.cross(rates, lever))
    wrong = np.eye(3) + 0.01 * rng.normal(size=(3, 3))
    shown = low_passed(shown, rng.uniform(0, 0.006))
    delay = rng.uniform(-0.003, 0.003)
    columns = [np.interp(times - delay, fine, x) for x in shown.T]
    force = np.stack(columns, axis=1) @ wrong.T + 0.15 * rng.normal(size=3)
    force += rng.uniform(0.03, 0.3) * rng.normal(size=force.shape)
    wave = np.interp(times, fine, vibration) * np.sin(2 * np.pi * frequency * times)
    force += wave[:, None] * directions(rng, 1)
    reach = GRAVITY * rng.choice([4, 8, 16], p=[0.1, 0.2, 0.7])
    rates = low_passed(rates, rng.uniform(0, 0.003))
    omega = np.stack([np.interp(times, fine, x) for x in rates.T], axis=1)
    omega += 0.01 * rng.normal(size=3) + rng.uniform(0.003, 0.03) * rng.normal(
        size=omega.shape
    )
    omega += 0.01 * wave[:, None] * directions(rng, 1)
    reading = jr.records.Reading(times, omega.clip(-35, 35), force.clip(-reach, reach))
    return reading, rate


def cases(count, seed):
    """Simulate `count` trials."""
    rng = np.random.default_rng(seed)
    trials = Trials(rng, count)
    fine, rates, changes, forces = motions(rng, trials)
    made = []
    for i in range(count):
        spun_up = np.clip((fine - trials.wheel_on[i]) / trials.wheel_time[i], 0, 1)
        vibration = trials.vibration[i] * spun_up
        of_one = (rates[:, i], changes[:, i], forces[:, i])
        frequency = trials.vibration_frequency[i]
        reading, rate = read_by_sensors(rng, fine, *of_one, vibration, frequency)
        flights = [(float(trials.release[i]), float(trials.contact[i]))]
        if trials.bounces[i]:
            second = trials.contact[i] + trials.bounce_width[i]
            flights.append((float(second), float(trials.catch[i])))
        spin = float(np.linalg.norm(trials.spin[i]))
        case = Case(
            reading, flights, rate, spin, bool(trials.has_wheel[i]), len(flights) > 1
        )
        made.append(case)
    return made


def overlap(a, b):
    """Time that two intervals share."""
    return max(0.0, min(a[1], b[1]) - max(a[0], b[0]))


def compare(case, found):
    """Errors of both ends of each flight, NaN if missed; number of false parts."""
    spans = [(float(x.times[0]), float(x.times[-1])) for x in found]
    errors = []
    for flight in case.flights:
        length = flight[1] - flight[0]
        if length < SHORTEST:
            continue
        best = max(spans, key=lambda span: overlap(span, flight), default=(0.0, 0.0))
        if overlap(best, flight) < length / 2:
            errors.append((np.nan, np.nan))
        else:
            errors.append((best[0] - flight[0], best[1] - flight[1]))
    covered = [sum(overlap(span, x) for x in case.flights) for span in spans]
    false = sum(c < (b - a) / 2 for c, (a, b) in zip(covered, spans, strict=True))
    return np.reshape(errors, (-1, 2)), false


def summary(results):
    """One row of the table: counts, parts in %, errors in ms."""
    errors = np.concatenate([x for x, _ in results])
    false = sum(x for _, x in results)
    missed = np.isnan(errors[:, 0])
    within = np.abs(errors) <= WITHIN + NOISE_FLOOR
    good = errors[~missed]
    contact = (good[:, 0] < -LITTLE) | (good[:, 1] > LITTLE)
    # start: 90 % of the errors lie between these two; likewise the end
    low, high = np.quantile(1e3 * good, (0.05, 0.95), axis=0)
    return [
        len(errors),
        f"{100 * missed.mean():.1f}",
        false,
        f"{100 * within[:, 0].mean():.1f}",
        f"{100 * within[:, 1].mean():.1f}",
        f"{100 * within.all(axis=1).mean():.1f}",
        f"{low[0]:.0f} to {high[0]:.0f}",
        f"{low[1]:.0f} to {high[1]:.0f}",
        f"{100 * contact.mean():.1f}",
    ]


GROUPS = {
    "all": lambda _: True,
    "50 to 100 Hz": lambda x: x.rate < 100,
    "100 to 200 Hz": lambda x: 100 <= x.rate < 200,
    "200 to 500 Hz": lambda x: x.rate >= 200,
    "2 to 5 rad/s": lambda x: x.spin < 5,
    "5 to 15 rad/s": lambda x: 5 <= x.spin < 15,
    "15 to 30 rad/s": lambda x: x.spin >= 15,
    "with a wheel": lambda x: x.wheel,
    "with a bounce": lambda x: x.bounces,
}


def main():
    parser = common.arguments(__doc__)
    parser.add_argument("--count", type=int, default=400, help="trials")
    parser.add_argument(
        "--seed", type=int, default=7, help="0 and 1 were used for tuning"
    )
    parser.add_argument("--by", nargs="+", default=["forces", "momentum"])
    given = parser.parse_args()
    made = cases(given.count, given.seed)
    rows = []
    for by in given.by:
        start = time.perf_counter()
        results = [compare(x, jr.records.flights(x.reading, by=by)) for x in made]
        each = 1e3 * (time.perf_counter() - start) / len(made)
        for name, belongs in GROUPS.items():
            chosen = [x for x, case in zip(results, made, strict=True) if belongs(case)]
            rows.append([by, name, *summary(chosen)])
        print(f"{by}: {each:.0f} ms a record", flush=True)
    header = [
        "by",
        "trials",
        "flights",
        "missed %",
        "false",
        "start within 30 ms %",
        "end within 30 ms %",
        "both %",
        "start, 5 to 95 % [ms]",
        "end, 5 to 95 % [ms]",
        "with contact %",
    ]
    about = [" ".join(x.split()) for x in (__doc__ or "").split("\n\n")[1:]]
    about.append(f"{given.count} trials, seed {given.seed}.")
    text = "\n\n".join([*about, common.table(header, rows)])
    title = "Flights found in simulated trials"
    common.report("flights", title, text, ("jax", "numpy"), given.write)


if __name__ == "__main__":
    main()
