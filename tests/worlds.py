"""Records as real sensors see them: bodies, trials, drag, loose parts, wheels, gyros.

An independent judge of what is identified from records: numpy and scipy alone.
Everything is in the body's frame; L = I omega + (what turns inside) is its angular
momentum, and

    L' = L x omega + torque,    R' = R hat(omega),

R from body to space. Everything random takes a generator and repeats itself with its
seed.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

_TOLERANCE = 1e-10
_LARGEST_TURN = 0.05  # [rad] of a step of Runge-Kutta's: its error is 3e-9 of omega
KINDS = ("general", "symmetric", "nearly sphere", "flat", "rod")


@dataclass(frozen=True)
class Motion:
    """What the body did.

    Attributes:
        ts: Times (samples,) [s].
        omega: Rates (..., samples, 3) [rad/s].
        alpha: Their derivatives without the part of white or held torque [rad/s^2].
        attitude: Quaternions body to space, scalar first (..., samples, 4), or None.
        inner: Angles and rates of the loose part (..., samples, 6) [rad, rad/s], or
            None.
    """

    ts: np.ndarray
    omega: np.ndarray
    alpha: np.ndarray
    attitude: np.ndarray | None = None
    inner: np.ndarray | None = None


@dataclass(frozen=True)
class LoosePart:
    """A ball inside the body on a spring and a damper, free to turn a little about any axis.

    The body's tensor is with the ball locked. Angles phi' = nu of the ball against the
    body are small; j (omega' + nu' + omega x nu) = -k phi - c nu with k = j (2 pi
    frequency)^2 and c = 2 damping sqrt(j k). Momentum I omega + j nu is conserved in
    space, energy falls by c nu^2. Locked until ts[0], it rings from there: a stiff
    spring moves the body's rates by some (inertia / I) times spin / (2 pi frequency) of
    themselves.

    Attributes:
        inertia: j [kg m^2], a number below every moment of the body.
        frequency: Of the ball alone on its spring [Hz].
        damping: Fraction of critical damping.
    """

    inertia: float
    frequency: float
    damping: float = 0.05

    @property
    def stiffness(self):
        return self.inertia * (2 * np.pi * self.frequency) ** 2

    def torque(self, inner):
        """Of the spring and the damper on the ball, from its angles and rates."""
        damper = 2 * self.damping * np.sqrt(self.inertia * self.stiffness)
        return -self.stiffness * inner[..., :3] - damper * inner[..., 3:]


def cross(a, b):
    """a x b along the last axis, at a tenth of the price of numpy's."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=-1)


def times(matrix, vector):
    """Matrix (..., 3, 3) times vector (..., 3)."""
    return (matrix @ vector[..., None])[..., 0]


def turned(quaternion, vector):
    """The vector in space of one in the body."""
    scalar, axis = quaternion[..., :1], quaternion[..., 1:]
    across = cross(
        np.broadcast_to(axis, np.broadcast_shapes(axis.shape, vector.shape)), vector
    )
    return vector + 2 * (scalar * across + cross(axis, across))


def _attitude_rate(quaternion, omega):
    scalar, axis = quaternion[..., :1], quaternion[..., 1:]
    first = -np.sum(axis * omega, axis=-1, keepdims=True)
    return np.concatenate([first, scalar * omega + cross(axis, omega)], axis=-1) / 2


class _Body:
    """The right-hand side: state of momentum, quaternion (if followed), loose part (if any)."""

    def __init__(self, tensor, torque, wheel, part, followed):
        self.tensor, self.inverse = tensor, np.linalg.inv(tensor)
        self.torque, self.wheel, self.part, self.followed = (
            torque,
            wheel,
            part,
            followed,
        )
        self.size = 3 + 4 * followed + 6 * (part is not None)
        if part is not None:
            self.outer = np.linalg.inv(tensor - part.inertia * np.eye(3))

    def omega(self, t, state):
        inside = 0.0 if self.wheel is None else self.wheel(t)[0]
        if self.part is not None:
            inside = inside + self.part.inertia * state[..., -3:]
        return times(self.inverse, state[..., :3] - inside)

    def rates(self, t, state, held=0.0):
        """Derivatives of the rates and of the state; a held torque adds to that of the motion."""
        omega, momentum = self.omega(t, state), state[..., :3]
        torque = held if self.torque is None else held + self.torque(t, omega)
        wheel = 0.0 if self.wheel is None else self.wheel(t)[1]
        out = [cross(momentum, omega) + torque]
        if self.followed:
            out.append(_attitude_rate(state[..., 3:7], omega))
        if self.part is None:
            return times(self.inverse, out[0] - wheel), np.concatenate(out, axis=-1)
        inertia, inner = self.part.inertia, state[..., -6:]
        nu, spring = inner[..., 3:], self.part.torque(inner)
        # The body without the ball, whose momentum is j (omega + nu):
        outer = momentum - inertia * (omega + nu)
        alpha = times(self.outer, cross(outer, omega) + torque - wheel - spring)
        out += [nu, spring / inertia - alpha - cross(omega, nu)]
        return alpha, np.concatenate(out, axis=-1)

    def step(self, t, dt, state, held=0.0):
        """One step of the classical Runge-Kutta method of order 4."""
        one = self.rates(t, state, held)[1]
        two = self.rates(t + dt / 2, state + dt / 2 * one, held)[1]
        three = self.rates(t + dt / 2, state + dt / 2 * two, held)[1]
        four = self.rates(t + dt, state + dt * three, held)[1]
        return state + dt / 6 * (one + 2 * two + 2 * three + four)


def _smooth(body, state, ts):
    """States at the times, by DOP853 over all trials at once."""
    shape = state.shape
    scale = np.max(np.abs(state[..., :3]))

    def rates(t, flat):
        return body.rates(t, flat.reshape(shape))[1].ravel()

    atol = np.full(shape, _TOLERANCE)
    atol[..., :3] *= scale
    done = solve_ivp(
        rates,
        (ts[0], ts[-1]),
        state.ravel(),
        "DOP853",
        ts,
        rtol=_TOLERANCE,
        atol=atol.ravel(),
    )
    assert done.success, done.message
    return np.moveaxis(done.y.reshape(*shape, len(ts)), -1, -2)


def _kicked(body, state, ts, kick, rng, substeps, held):
    """States at the times; each substep a half kick, a Runge-Kutta step, a half kick."""
    states = [state]
    turn = np.max(np.linalg.norm(body.omega(ts[0], state), axis=-1))
    if body.part is not None:
        turn = max(turn, 2 * np.pi * body.part.frequency)
    for row, (start, end) in enumerate(pairwise(ts)):
        torque = 0.0 if held is None else held[..., row, :]
        count = substeps or max(1, int(np.ceil(turn * (end - start) / _LARGEST_TURN)))
        dt = (end - start) / count
        sizes = kick * np.sqrt(dt / 2)
        for i in range(count):
            noise = np.zeros(2)
            if np.any(kick):
                noise = rng.normal(size=(2, *state.shape[:-1], 3)) * sizes
            state = state.copy()
            state[..., :3] += noise[0]
            state = body.step(start + i * dt, dt, state, torque)
            state[..., :3] += noise[1]
            if body.followed:
                state[..., 3:7] /= np.linalg.norm(
                    state[..., 3:7], axis=-1, keepdims=True
                )
        states.append(state)
    return np.stack(states, axis=-2)


def tumble(
    tensor,
    omega0,
    ts,
    torque=None,
    wheel=None,
    kick=0.0,
    rng=None,
    substeps=None,
    attitude0=None,
    part=None,
    held=None,
):
    """A rigid body turns about its centre of mass: I w' = (I w + h) x w - h' + torque + noise.

    Without noise one DOP853 over all trials, relative tolerance 1e-10. With it each
    substep is half a kick, a step of Runge-Kutta's order 4, half a kick: the momentum
    gets N(0, kick^2 dt) in all, so its sum between two samples has the variance kick^2
    (t' - t) whatever the substeps; where in a substep it falls is right to second order
    in the angle turned.

    Args:
        tensor: Inertia about the centre of mass (3, 3), or of each trial (trials, 3, 3)
            [kg m^2].
        omega0: Rates at ts[0], (3,) or (trials, 3) [rad/s].
        ts: Times, growing, of all trials (samples,) [s].
        torque: A function of t and omega (..., 3) in body axes [N m]; smooth.
        wheel: A function of t, the momentum (3,) of wheels along body axes and its
            derivative; see `wheel_profile`.
        kick: White torque, the root of its spectral density, a number or (3,) [N m
            sqrt(s)].
        rng: A generator, for the kick.
        substeps: Of each sample with a kick; None: at most 0.05 rad of the first rates
            each.
        attitude0: Quaternion at ts[0], (4,) or (trials, 4), if attitudes are wanted.
        part: A LoosePart, at rest in the body at ts[0].
        held: A torque in body axes (..., samples - 1, 3) [N m], constant from each time
            to the next; steps are as with a kick. See `ou_torque`.

    Returns:
        Motion.
    """
    tensor, omega, ts = (np.asarray(x, float) for x in (tensor, omega0, ts))
    lead = np.broadcast_shapes(tensor.shape[:-2], omega.shape[:-1])
    body = _Body(tensor, torque, wheel, part, attitude0 is not None)
    state = np.zeros((*lead, body.size))
    state[..., :3] = times(tensor, omega) + (0.0 if wheel is None else wheel(ts[0])[0])
    if attitude0 is not None:
        state[..., 3:7] = attitude0
    if np.any(kick) or held is not None:
        states = _kicked(body, state, ts, np.asarray(kick), rng, substeps, held)
    else:
        states = _smooth(body, state, ts)
    at = [(t, states[..., i, :]) for i, t in enumerate(ts)]
    attitude = states[..., 3:7] if body.followed else None
    if attitude is not None:
        attitude = attitude / np.linalg.norm(attitude, axis=-1, keepdims=True)
    return Motion(
        ts,
        np.stack([body.omega(t, s) for t, s in at], axis=-2),
        np.stack([body.rates(t, s)[0] for t, s in at], axis=-2),
        attitude,
        None if part is None else states[..., -6:],
    )


def quadratic_drag(coefficient):
    """The air's torque -|w| C w; C [kg m^2] a number, (3,) along the axes or (3, 3).

    About a principal axis of moment I the rate falls as w0 / (1 + C w0 t / I).
    """
    matrix = np.asarray(coefficient, float)
    matrix = np.diag(np.broadcast_to(matrix, 3)) if matrix.ndim < 2 else matrix
    return lambda _t, w: -np.linalg.norm(w, axis=-1, keepdims=True) * times(matrix, w)


def wobble_torque(rng, tensor, omega0, size, frequencies=(0.3, 2.0)):
    """An unmodelled torque, smooth: along each axis three sines of random phase.

    Args:
        rng: A generator.
        tensor: Inertia (3, 3) [kg m^2].
        omega0: Rates (3,) or (trials, 3) [rad/s]; each trial has a torque of its own.
        size: Root mean square over |(I w) x w| averaged over the trials.
        frequencies: Least and largest, in turns of the mean rate.
    """
    omega0 = np.asarray(omega0, float)
    spin = np.mean(np.linalg.norm(omega0, axis=-1))
    gyroscopic = np.linalg.norm(cross(times(tensor, omega0), omega0), axis=-1)
    shape = (*omega0.shape, 3)
    rates = spin * rng.uniform(*frequencies, size=shape)
    phases = rng.uniform(0, 2 * np.pi, size=shape)
    # Nine sines, each of mean square 1/2.
    amplitude = size * np.mean(gyroscopic) / np.sqrt(4.5)
    return lambda t, _w: amplitude * np.sum(np.sin(rates * t + phases), axis=-1)


def ou_torque(rng, ts, size, tau):
    """An unmodelled torque: along each axis an Ornstein-Uhlenbeck process, held between times.

    The process is stationary and sampled exactly: neighbours correlate by a = exp(-dt /
    tau). Its variance is size^2 (1 - a) / (1 + a) / dt, so that the spectral density of
    the held torque at frequency 0 is size^2 whatever tau; where dt is much smaller than
    tau, that is the variance size^2 / (2 tau) of the process.

    Args:
        rng: A generator.
        ts: Times, uniform (samples,) [s].
        size: Root of the spectral density at frequency 0 (..., 3) [N m sqrt(s)].
        tau: Correlation time [s]; 0: white.

    Returns:
        Torques (..., samples - 1, 3) [N m], as `tumble` takes them.
    """
    step = ts[1] - ts[0]
    memory = np.exp(-step / tau) if tau else 0.0
    size = np.asarray(size, float)[..., None, :]
    noise = rng.normal(size=(*size.shape[:-2], len(ts) - 1, 3))
    noise[..., 1:, :] *= np.sqrt(1 - memory**2)
    path = lfilter([1.0], [1.0, -memory], noise, axis=-2)
    return size * np.sqrt((1 - memory) / (1 + memory) / step) * path


def wheel_profile(axis, size, start, duration, scale=1.0, delay=0.0):
    """A wheel runs up, and what its drive reports.

    Along the axis the momentum grows from 0 to `size` as s = 10 u^3 - 15 u^4 + 6 u^5 of
    u = (t - start) / duration, twice differentiable.

    Args:
        axis: Of the wheel (3,), made a unit vector.
        size: Final momentum [kg m^2 / s].
        start: Of the run [s].
        duration: Of the run [s].
        scale: Reported momentum over the true one.
        delay: Of the report [s]: it tells scale h(t - delay).

    Returns:
        Two functions of t (a number or (samples,)) that give h and h' (..., 3): true,
        reported.
    """
    axis = np.asarray(axis, float) / np.linalg.norm(axis)

    def true(t):
        u = np.clip((np.asarray(t, float) - start) / duration, 0.0, 1.0)[..., None]
        run = u**3 * (10 - 15 * u + 6 * u**2)
        rate = 30 * (u * (1 - u)) ** 2 / duration
        return size * run * axis, size * rate * axis

    def reported(t):
        momentum, rate = true(np.asarray(t) - delay)
        return scale * momentum, scale * rate

    return true, reported


def lagged(values, step, time_constant):
    """First-order low-pass y' = (x - y) / T of samples (..., n, 3) on a uniform grid.

    Exact for x linear between the samples; y has settled on the first slope at the
    start.
    """
    if not time_constant:
        return values
    left = np.exp(-step / time_constant)
    gain = (1 - left) * time_constant / step
    coefficients = [1 - gain, gain - left]
    first, second = values[..., :1, :], values[..., 1:2, :]
    settled = first - (second - first) / step * time_constant
    # lfilter's state before the first sample of the output, so that y[0] is `settled`:
    state = settled - coefficients[0] * first
    return lfilter(coefficients, [1.0, -left], values, axis=-2, zi=state)[0]


def gyro(
    source,
    ts,
    rng,
    sigma,
    bias=0.0,
    drift=0.0,
    walk=0.0,
    matrix=None,
    delay=0.0,
    time_constant=0.0,
    limit=None,
    quantum=None,
):
    """Readings of a gyro: matrix (lagged rates at t - delay) + bias + drift (t - ts[0]) + noise.

    Args:
        source: A function that gives the rates (..., n, 3) at times (n,), or a pair of
            a uniform grid of times and the rates on it (cubic splines between). It
            should begin a few time constants and the delay before ts[0]; a function is
            asked there.
        ts: Times of the readings (samples,) [s].
        rng: A generator.
        sigma: Standard deviation of each reading, a number or (3,) [rad/s].
        bias: At ts[0], a number or (3,) [rad/s].
        drift: Of the bias, linear in time [rad/s^2].
        walk: Of the bias at random, the root of the spectral density [rad/s / sqrt(s)].
        matrix: Scale factors, misalignment (3, 3); None is 1.
        delay: [s].
        time_constant: Of a first-order low-pass [s]: a slow sinusoid of rate f lags by
            arctan(f T) and shrinks by 1 / sqrt(1 + (f T)^2).
        limit: Readings stop at +-limit [rad/s].
        quantum: Readings are whole multiples of it [rad/s].

    Returns:
        Readings (..., samples, 3) [rad/s].
    """
    ts = np.asarray(ts, float)
    if callable(source):
        if not time_constant:
            values = np.asarray(source(ts - delay))
        else:
            lead = 20 * time_constant
            count = int(np.ceil((ts[-1] - ts[0] + lead) / (time_constant / 100))) + 1
            grid = np.linspace(ts[0] - delay - lead, ts[-1] - delay, count)
            values = _at(grid, np.asarray(source(grid)), ts - delay, time_constant)
    else:
        values = _at(*source, ts - delay, time_constant)
    values = values if matrix is None else times(np.asarray(matrix), values)
    since = (ts - ts[0])[:, None]
    values = values + bias + drift * since + sigma * rng.normal(size=values.shape)
    if walk:
        steps = np.sqrt(np.diff(ts, prepend=ts[0]))[:, None]
        values = values + walk * np.cumsum(
            steps * rng.normal(size=values.shape), axis=-2
        )
    if quantum is not None:
        values = quantum * np.round(values / quantum)
    return values if limit is None else np.clip(values, -limit, limit)


def _at(grid, values, ts, time_constant):
    """Lagged values of a grid at times within it."""
    assert grid[0] <= ts[0] + 1e-12, "the grid begins too late"
    assert ts[-1] <= grid[-1] + 1e-12, "the grid ends too early"
    return CubicSpline(grid, lagged(values, grid[1] - grid[0], time_constant), axis=-2)(
        ts
    )


def accelerometer(motion, lever, rng, sigma, bias=0.0, gravity=None):
    """Specific force (..., samples, 3) [m/s^2] of a thrown body: alpha x r + w x (w x r).

    Args:
        motion: Of `tumble`.
        lever: r, from the centre of mass to the sensor (3,) [m].
        rng: A generator.
        sigma: Standard deviation of each reading [m/s^2].
        bias: A number or (3,) [m/s^2].
        gravity: Of a body that is held at its centre of mass, in space (3,) [m/s^2]: -g
            in body axes is added. None: free fall.
    """
    lever, omega = np.asarray(lever, float), motion.omega
    force = cross(motion.alpha, lever) + cross(omega, cross(omega, lever))
    if gravity is not None:
        back = motion.attitude * np.array([1.0, -1.0, -1.0, -1.0])
        force = force - turned(back, np.asarray(gravity, float))
    return force + bias + sigma * rng.normal(size=force.shape)


def random_axes(rng):
    """A rotation (3, 3), uniform."""
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return axes * np.linalg.det(axes)


def of_second_moments(second, axes):
    """Inertia of a body whose masses have these second moments along these axes (columns)."""
    return axes @ np.diag(np.sum(second) - np.asarray(second)) @ axes.T


def random_body(rng, kind="general"):
    """Inertia (3, 3) of a body that can be, of mean moment 1, its axes at random.

    Drawn by second moments of mass, which are positive: the triangle inequalities hold.

    Args:
        rng: A generator.
        kind: "general"; "symmetric", two moments equal; "nearly sphere", moments within
            a few per cent; "flat", a plate with no thickness to speak of; "rod", the
            smallest moment below a tenth of the others.
    """
    if kind == "general":
        second = np.exp(rng.normal(scale=0.7, size=3))
    elif kind == "symmetric":
        second = np.exp(rng.normal(scale=0.7, size=2))[[0, 0, 1]]
    elif kind == "nearly sphere":
        second = np.exp(rng.normal(scale=0.02, size=3))
    elif kind == "flat":
        second = np.array(
            [*np.exp(rng.normal(scale=0.5, size=2)), np.exp(rng.uniform(-9, -4))]
        )
    elif kind == "rod":
        second = np.array([1.0, *np.exp(rng.uniform(-7, -3.2, size=2))])
    else:
        raise ValueError(f"kind must be one of {KINDS}, but is {kind!r}")
    return of_second_moments(1.5 * second / np.sum(second), random_axes(rng))


def random_times(rng, count, mean_step, jitter=0.3, gaps=0.01):
    """Growing times from 0: steps of mean_step times 1 +- jitter, a few of them 5 to 50 steps."""
    steps = mean_step * (1 + jitter * rng.uniform(-1, 1, size=count - 1))
    long = rng.uniform(size=count - 1) < gaps
    steps[long] *= rng.uniform(5, 50, size=np.count_nonzero(long))
    return np.concatenate([[0.0], np.cumsum(steps)])


@dataclass(frozen=True)
class Record:
    """Readings of a gyro in one motion, and the truth.

    Attributes:
        tensor: Inertia (3, 3), mean moment 1 unless given.
        ts: Times (samples,) [s].
        omega: True rates at the times (samples, 3) [rad/s].
        readings: Of the gyro (samples, 3) [rad/s].
        sigma: Their standard deviation [rad/s].
        alpha: True derivatives of the rates (samples, 3) [rad/s^2].
        kind: Of the body.
    """

    tensor: np.ndarray
    ts: np.ndarray
    omega: np.ndarray
    readings: np.ndarray
    sigma: float
    alpha: np.ndarray
    kind: str = ""


def random_record(rng, kind=None, largest=3000):
    """A free body of any kind and size of time: what a fit may be given without warning.

    5 to `largest` samples, 0.03 to 1.5 rad each but at most 1000 rad in all, jitter up
    to 90 % of a step, gaps; rates of 1 rad/s times 10^(-3 to 3); noise 0.1 to 5 % of
    the rate.
    """
    kind = kind or str(rng.choice(KINDS))
    tensor = random_body(rng, kind)
    count = int(np.exp(rng.uniform(np.log(5), np.log(largest + 1))))
    spin = 10 ** rng.uniform(-3, 3)
    a_sample = min(np.exp(rng.uniform(np.log(0.03), np.log(1.5))), 1000 / count)
    ts = random_times(
        rng, count, a_sample / spin, rng.uniform(0, 0.9), rng.choice([0.0, 0.01, 0.05])
    )
    ts *= min(1.0, 1000 / (spin * ts[-1]))
    direction = rng.normal(size=3)
    motion = tumble(tensor, spin * direction / np.linalg.norm(direction), ts)
    sigma = spin * np.exp(rng.uniform(np.log(0.001), np.log(0.05)))
    readings = motion.omega + sigma * rng.normal(size=motion.omega.shape)
    return Record(tensor, ts, motion.omega, readings, sigma, motion.alpha, kind)


# Smallest to largest [kg m^2]: a box of 147 x 72 x 8 mm and 0.19 kg; a tennis racquet.
THROWN = {"phone": (8.2e-5, 3.43e-4, 4.24e-4), "racquet": (1.5e-3, 1.50e-2, 1.64e-2)}


def trials(
    rng,
    count=100,
    body="phone",
    rate=100.0,
    duration=(0.3, 1.0),
    spin=(6.0, 14.0),
    drag=0.01,
    wobble=0.01,
    wobble_frequency=15.0,
    kick=0.0,
    time_constant=0.005,
    sigma=0.005,
    bias=0.0,
    delay=0.0,
    limit=None,
    quantum=None,
    ou=None,
    tau=0.1,
    ou_scatter=0.0,
    axes=None,
):
    """One body thrown many times: the scene of most home-made records.

    Each trial turns about a direction of its own, half of them within 0.3 rad of a
    principal axis; its gyro has run before the first sample (no jump of the low-pass at
    the start).

    Args:
        rng: A generator.
        count: Trials.
        body: "phone", "racquet", or principal moments (3,) [kg m^2]; its axes are at
            random.
        rate: Samples a second [Hz].
        duration: Least and largest of a trial [s].
        spin: Least and largest [rad/s].
        drag: C of quadratic drag over the mean moment: the loss of rate in one radian.
        wobble: Inertia of a loose part over the smallest moment; 0 for none.
        wobble_frequency: Of its spring [Hz].
        kick: White torque over the mean moment [rad / s^1.5].
        time_constant: Of the gyro's low-pass [s].
        sigma: Noise of the gyro over each trial's spin.
        bias: Of the gyro [rad/s].
        delay: Of the gyro [s].
        limit: Of the gyro [rad/s].
        quantum: Of the gyro [rad/s].
        ou: Ornstein-Uhlenbeck torque along each principal axis (3,), or None: the root
            of its spectral density at frequency 0 over the mean moment and over the
            trial's spin [1 / sqrt(s)].
        tau: Its correlation time [s]; 0: white.
        ou_scatter: Of the logarithm of its level from trial to trial.
        axes: Principal axes in body axes (3, 3), columns; None: at random.

    Returns:
        A Record of each trial, with rates in true body axes at the times of its
        samples.
    """
    moments = np.asarray(THROWN[body] if isinstance(body, str) else body, float)
    axes = random_axes(rng) if axes is None else np.asarray(axes, float)
    mean = np.mean(moments)
    tensor = axes @ np.diag(moments) @ axes.T
    directions = rng.normal(size=(count, 3))
    near = rng.uniform(size=count) < 0.5
    directions[near] = np.eye(3)[rng.integers(3, size=count)][near] + 0.3 * rng.uniform(
        -1, 1, size=(np.count_nonzero(near), 3)
    )
    spins = rng.uniform(*spin, size=count)
    omega0 = (
        spins[:, None]
        * (directions / np.linalg.norm(directions, axis=1)[:, None])
        @ axes.T
    )
    lengths = np.maximum(5, np.round(rng.uniform(*duration, size=count) * rate)).astype(
        int
    )
    # The dense grid leads the samples by whole samples, enough for the low-pass and the
    # delay.
    fine = max(
        4,
        int(np.ceil(20 * np.max(spins) / rate)),
        int(np.ceil(8 / rate / time_constant)) if time_constant else 0,
    )
    lead = int(np.ceil((delay + 5 * time_constant) * rate))
    grid = np.arange(-lead * fine, (np.max(lengths) - 1) * fine + 1) / (rate * fine)
    held = None
    if ou is not None:
        levels = mean * spins * np.exp(ou_scatter * rng.normal(size=count))
        held = (
            ou_torque(rng, grid, levels[:, None] * np.asarray(ou, float), tau) @ axes.T
        )
    motion = tumble(
        tensor,
        omega0,
        grid,
        quadratic_drag(drag * mean) if drag else None,
        kick=kick * mean,
        rng=rng,
        held=held,
        part=LoosePart(wobble * moments[0], wobble_frequency) if wobble else None,
    )
    first = lead * fine
    records = []
    for i, length in enumerate(lengths):
        ts = np.arange(length) / rate
        rows = slice(first, first + (length - 1) * fine + 1, fine)
        noise = sigma * spins[i]
        readings = gyro(
            (grid, motion.omega[i]),
            ts,
            rng,
            noise,
            bias,
            delay=delay,
            time_constant=time_constant,
            limit=limit,
            quantum=quantum,
        )
        omega, alpha = motion.omega[i, rows], motion.alpha[i, rows]
        records.append(Record(tensor, ts, omega, readings, noise, alpha, str(body)))
    return records
