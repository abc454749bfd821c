"""Random torques that are not smooth, and reference motions under them by scipy.

Every kind of torque is written twice: for `jrigid.simulate`, with its parameters in
`args`, and in plain Python between two neighbouring breaks, where it is smooth. The
reference integrates from break to break with DOP853 and starts anew at each.

The breaks are known times for all kinds but "kinked", whose torque has kinks where a
component of the angular velocity, or a threshold of its magnitude, is crossed. Those
times are located as events.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jrigid as jr

KINDS = ("interpolated", "sampled", "switched", "kinked", "smooth")
# Times at which a motion is compared with its reference.
CHECKS = 20
# Lengths of the arrays that describe a torque: knots of a table, breaks, switches. They
# are the same for all durations, so that one compiled program serves all of them.
KNOTS, SWITCHES = 2048, 12
# Runs up to this long [s] get strong torques. In longer ones the spin would run away.
SHORT = 20.0
_OF_MOTION = ("moments", "attitude", "omega", "breaks")
# DOP853 at the smallest tolerance that scipy takes. Its estimate can be a thousand
# times too small, so its steps [s] are short as well.
ACCURATE = {"rtol": 3e-14, "atol": 1e-15, "max_step": 0.03}
# Tolerance and size of the disturbance for the test of whether a motion is regular.
LOOSE, DISTURBANCE = 1e-9, 1e-5


class Motion(NamedTuple):
    """A body, its start, the parameters of its torque, and where that is not smooth."""

    moments: np.ndarray
    attitude: np.ndarray
    omega: np.ndarray
    parameters: dict[str, np.ndarray]
    breaks: np.ndarray  # increasing times; those past the end of the run pad


class Reference(NamedTuple):
    """States of a motion at the times of comparison."""

    ts: np.ndarray
    attitude: np.ndarray
    omega: np.ndarray
    radians: np.ndarray  # the angle turned so far


# Torques for jrigid.simulate ---------------------------------------------------------


def interpolated(t, state, args):
    """Linear interpolation in a table of times."""
    columns = [jnp.interp(t, args["ts"], args["values"][:, i]) for i in range(3)]
    return jnp.stack(columns) - args["drag"] * state.omega


def sampled(t, state, args):
    """The package's own cubic interpolation."""
    table = jr.torques.Sampled(args["ts"], args["values"])
    return table(t) - args["drag"] * state.omega


def switched(t, state, args):
    """Constant torques that are switched on in turn, and a train of pulses."""
    on = t > args["times"]
    total = jnp.sum(jnp.where(on[:, None], args["changes"], 0.0), axis=0)
    phase = jnp.mod(t - args["first"], args["period"])
    total = total + jnp.where(phase < args["width"], args["pulse"], 0.0)
    return total - args["drag"] * state.omega


def kinked(t, state, args):
    """Terms in |omega_i|, and friction that sets in above a threshold of |omega|."""
    omega = state.omega
    magnitudes = jnp.abs(omega)
    speed = jnp.sqrt(jnp.sum(omega**2))
    excess = jnp.where(speed > args["threshold"], speed - args["threshold"], 0.0)
    return (
        args["pump"] @ magnitudes
        + jnp.cross(args["gyro"] * magnitudes, omega)
        - args["friction"] * excess / speed * omega
        + args["amplitude"] * jnp.sin(args["rate"] * t + args["phase"])
        - args["drag"] * omega
    )


def smooth(t, state, args):
    """Periodic torques fixed in the body, and a dipole in a turning field."""
    angle = args["field_rate"] * t
    field = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)])
    in_body = jr.rotation.rotate_inverse(state.attitude, field)
    return (
        jnp.cross(args["dipole"], in_body)
        + args["amplitude"] * jnp.sin(args["rate"] * t + args["phase"])
        - args["drag"] * state.omega
    )


TORQUES: dict[str, Callable[..., Any]] = {
    "interpolated": interpolated,
    "sampled": sampled,
    "switched": switched,
    "kinked": kinked,
    "smooth": smooth,
}


# Random motions ----------------------------------------------------------------------


def candidate(kind: str, number: int, duration: float, knots: int = KNOTS) -> Motion:
    """A random motion, the same for the same arguments; regular or not.

    Args:
        kind: One of `KINDS`.
        number: Of the motion.
        duration: Length of the run [s].
        knots: Length of the arrays of knots and breaks.
    """
    rng = np.random.default_rng([KINDS.index(kind), number, round(1000 * duration)])
    masses = rng.uniform(0.3, 1.0, 3)
    attitude = rng.normal(size=4)
    omega = rng.normal(size=3)
    omega *= rng.uniform(0.6, 1.5) / np.linalg.norm(omega)
    # Half of the long runs have drag, which lets strong torques be regular. The torques
    # of the others are weak, as are all in motions that nothing random keeps going.
    strength = rng.uniform(0.3, 1.0)
    drag = 0.0
    if duration > SHORT:
        has_drag = number % 2 == 0
        is_random = kind not in ("kinked", "smooth")
        strength *= 0.3 if has_drag and is_random else 0.03
        longest = 0.1 if is_random else 0.003
        drag = rng.uniform(0.3, 1.0) * longest if has_drag else 0.0
    draw = {"interpolated": _table, "sampled": _table, "switched": _switches}
    draw |= {"kinked": _kinks, "smooth": _waves}
    parameters, breaks = draw[kind](rng, number, duration, strength, omega, knots)
    parameters["drag"] = np.asarray(drag)
    moments = masses.sum() - masses  # which satisfy the triangle inequality
    attitude /= np.linalg.norm(attitude)
    return Motion(moments, attitude, omega, parameters, breaks)


def _padded(times: Any, length: int, duration: float) -> np.ndarray:
    """Times before the end of a run, sorted, with later ones up to a length."""
    times = np.unique(np.asarray(times, float))
    times = times[(times > 0) & (times < duration)]
    assert times.size <= length
    rest = np.linspace(2 * duration, 3 * duration, length - times.size)
    return np.concatenate([times, rest])


def _table(rng, number, duration, strength, omega, knots):
    """A table with knots denser or sparser than a radian, evenly spaced or not."""
    del omega
    shortest = max(0.05, 3 * duration / knots)
    spacing = math.exp(rng.uniform(math.log(shortest), math.log(3.0)))
    spacings = np.full(knots, spacing)
    if number % 4 >= 2:
        spacings *= rng.uniform(0.5, 1.5, knots)
    ts = np.cumsum(spacings) - rng.uniform(0.2, 1.0) * spacings[0]
    ts[0] = min(ts[0], 0.0)
    # Dense tables turn the body as little as sparse ones.
    size = strength * min(1.0, spacing**-0.5)
    values = size * rng.uniform(-1.0, 1.0, (knots, 3))
    breaks = _padded(ts, knots, duration)
    return {"ts": ts, "values": values}, breaks


def _switches(rng, number, duration, strength, omega, knots):
    """Switches at random times, with pulses in two of three motions.

    A step can miss a pulse, or a pause, that is much shorter than a radian: these take
    half a second or more.
    """
    del omega
    shortest = 0.5
    most = min(SWITCHES, int(duration / shortest / 2))
    count = rng.integers(3, most)
    times = np.full(SWITCHES, 2 * duration)
    free = duration - count * shortest
    spaced = np.sort(rng.uniform(0.0, free, count)) + shortest * np.arange(count)
    times[:count] = spaced
    levels = strength * rng.uniform(-1.0, 1.0, (SWITCHES, 3))
    changes = np.diff(levels, axis=0, prepend=np.zeros((1, 3)))
    longest = 2.5 if duration <= SHORT else 20.0
    period = rng.uniform(2.2 * shortest, longest)
    width = rng.uniform(shortest, period - shortest)
    first = rng.uniform(0.0, period)
    has_pulses = number % 3 > 0
    pulse = strength * rng.uniform(-1.0, 1.0, 3) * has_pulses
    starts = first + period * np.arange(-1, duration / period + 1)
    breaks = times[:count]
    if has_pulses:
        breaks = np.concatenate([breaks, starts, starts + width])
    parameters = {"times": times, "changes": changes, "pulse": pulse}
    parameters |= {"period": period, "width": width, "first": first}
    parameters = {name: np.asarray(value) for name, value in parameters.items()}
    return parameters, _padded(breaks, knots, duration)


def _kinks(rng, number, duration, strength, omega, knots):
    """One of three kinds of kink: gyroscopic, friction above a threshold, pumping."""
    parameters, breaks = _waves(rng, number, duration, 0.3 * strength, omega, knots)
    del parameters["dipole"], parameters["field_rate"]
    speed = np.linalg.norm(omega)
    which = number % 3
    # More than this over a long run would speed the body up without bound.
    pump = min(0.5 * strength, 5 / duration) * rng.uniform(-1.0, 1.0, (3, 3))
    parameters |= {
        "gyro": rng.uniform(-1.0, 1.0, 3) * (which == 0),
        "friction": rng.uniform(0.2, 1.0) * np.array(which == 1),
        "threshold": rng.uniform(0.9, 1.0) * speed,
        "pump": pump * (which == 2),
    }
    return parameters, breaks


def _waves(rng, number, duration, strength, omega, knots):
    """Sines in the body in two motions, a dipole in a turning field in the next two."""
    del omega, knots
    has_sines = number % 4 < 2
    parameters = {
        "amplitude": strength * rng.uniform(-1.0, 1.0, 3) * has_sines,
        "rate": rng.uniform(0.2, 1.5, 3),
        "phase": rng.uniform(0.0, 2 * np.pi, 3),
        "dipole": strength * rng.uniform(-1.0, 1.0, 3) * (not has_sines),
        "field_rate": np.asarray(rng.uniform(0.1, 1.0)),
    }
    return parameters, _padded([], 1, duration)


# References --------------------------------------------------------------------------


def rotated_back(q, v):
    """A vector of space in body components."""
    a, b, c, d = q
    rows = (
        (a * a + b * b - c * c - d * d, 2 * (b * c + a * d), 2 * (b * d - a * c)),
        (2 * (b * c - a * d), a * a - b * b + c * c - d * d, 2 * (c * d + a * b)),
        (2 * (b * d + a * c), 2 * (c * d - a * b), a * a - b * b - c * c + d * d),
    )
    return tuple(sum(r * x for r, x in zip(row, v, strict=True)) for row in rows)


def _cross(u, v):
    return (
        u[1] * v[2] - u[2] * v[1],
        u[2] * v[0] - u[0] * v[2],
        u[0] * v[1] - u[1] * v[0],
    )


def _interpolated_between(parameters, start, end):
    ts, values = parameters["ts"], parameters["values"]
    i = int(np.searchsorted(ts, 0.5 * (start + end))) - 1
    t0 = float(ts[i])
    length = float(ts[i + 1] - ts[i])
    before, after = values[i].tolist(), values[i + 1].tolist()

    def torque(t, _omega, _q, _signs):
        u = (t - t0) / length
        return [a + u * (b - a) for a, b in zip(before, after, strict=True)]

    return torque


def _sampled_between(parameters, start, end):
    """A cubic in Hermite's form, with the slopes of parabolas through three samples."""
    ts, values = parameters["ts"], parameters["values"]
    i = int(np.searchsorted(ts, 0.5 * (start + end))) - 1

    def slope(j):
        first = min(max(j - 1, 0), ts.size - 3)
        x = ts[first : first + 3] - ts[j]
        rows = values[first : first + 3].T
        parabolas = [np.polynomial.Polynomial.fit(x, row, 2) for row in rows]
        return [float(parabola.deriv()(0.0)) for parabola in parabolas]

    t0, length = float(ts[i]), float(ts[i + 1] - ts[i])
    before, after = values[i].tolist(), values[i + 1].tolist()
    corners = tuple(zip(before, after, slope(i), slope(i + 1), strict=True))

    def torque(t, _omega, _q, _signs):
        u = (t - t0) / length
        v = 1.0 - u
        to_before, to_after = v * v * (1 + 2 * u), u * u * (1 + 2 * v)
        bend = length * u * v
        return [
            to_before * value0 + to_after * value1 + bend * (v * slope0 - u * slope1)
            for value0, value1, slope0, slope1 in corners
        ]

    return torque


def _switched_between(parameters, start, end):
    middle = 0.5 * (start + end)
    total = parameters["changes"][parameters["times"] < middle].sum(axis=0)
    if np.mod(middle - parameters["first"], parameters["period"]) < parameters["width"]:
        total = total + parameters["pulse"]
    constant = total.tolist()
    return lambda _t, _omega, _q, _signs: constant


def _kinked_between(parameters, _start, _end):
    pump, gyro = parameters["pump"].tolist(), parameters["gyro"].tolist()
    friction, threshold = float(parameters["friction"]), float(parameters["threshold"])
    sines = _sines(parameters)

    def torque(t, omega, _q, signs):
        magnitudes = [s * w for s, w in zip(signs[:3], omega, strict=True)]
        turned = _cross([g * m for g, m in zip(gyro, magnitudes, strict=True)], omega)
        slowing = 0.0
        if signs[3] > 0:
            slowing = friction * (1 - threshold / math.hypot(*omega))
        x, y, z = magnitudes
        pumped = [p * x + q * y + r * z for p, q, r in pump]
        parts = zip(pumped, turned, sines(t), omega, strict=True)
        return [a + b + c - slowing * w for a, b, c, w in parts]

    return torque


def _sines(parameters):
    terms = [parameters[name].tolist() for name in ("amplitude", "rate", "phase")]
    terms = tuple(zip(*terms, strict=True))
    return lambda t: [a * math.sin(rate * t + phase) for a, rate, phase in terms]


def _smooth_between(parameters, _start, _end):
    dipole, rate = parameters["dipole"].tolist(), float(parameters["field_rate"])
    sines = _sines(parameters)

    def torque(t, _omega, q, _signs):
        field = rotated_back(q, (math.cos(rate * t), math.sin(rate * t), 0.0))
        return [x + y for x, y in zip(_cross(dipole, field), sines(t), strict=True)]

    return torque


_BETWEEN = {
    "interpolated": _interpolated_between,
    "sampled": _sampled_between,
    "switched": _switched_between,
    "kinked": _kinked_between,
    "smooth": _smooth_between,
}


def rates_of(motion: Motion, torque: Callable[..., Any]) -> Callable[..., list[float]]:
    """Rates of angular velocity, attitude and the angle turned, in plain numbers."""
    moments = motion.moments.tolist()
    drag = float(motion.parameters["drag"])

    def rates(t, y, signs):
        *omega, a, b, c, d, _ = y.tolist()
        p, q, r = omega
        inner = _cross([m * w for m, w in zip(moments, omega, strict=True)], omega)
        outer = torque(t, omega, (a, b, c, d), signs)
        parts = zip(inner, outer, omega, moments, strict=True)
        spin_up = [(x + y - drag * w) / m for x, y, w, m in parts]
        turning = (
            -0.5 * (b * p + c * q + d * r),
            0.5 * (a * p + c * r - d * q),
            0.5 * (a * q + d * p - b * r),
            0.5 * (a * r + b * q - c * p),
        )
        return [*spin_up, *turning, math.sqrt(p * p + q * q + r * r)]

    return rates


def switching_functions(motion: Motion, y: np.ndarray) -> np.ndarray:
    """What changes its sign where a kinked torque has its kinks."""
    speed = np.linalg.norm(y[:3]) - motion.parameters["threshold"]
    return np.append(y[:3], speed)


def _events(motion: Motion, signs: list[float]) -> list[Callable[..., float]]:
    """Events that end a stretch on which a kinked torque is smooth."""

    def event_of(i: int) -> Callable[..., float]:
        def event(_t, y, _signs):
            return float(switching_functions(motion, y)[i])

        event.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
        # A stretch begins at a zero of the function that ended the one before. That
        # zero, and rounding around it, is passed in the other direction.
        event.direction = -signs[i]  # pyright: ignore[reportFunctionMemberAccess]
        return event

    return [event_of(i) for i in range(4)]


def _stretch(motion, rates, y, start, end, signs, **options):
    """From one time to a later one, through the kinks between them."""
    if signs is None:
        return solve_ivp(rates, (start, end), y, args=(None,), **options).y[:, -1]
    while True:
        events = _events(motion, signs)
        run = solve_ivp(rates, (start, end), y, args=(signs,), events=events, **options)
        y = run.y[:, -1]
        if run.status == 0:
            return y
        start = run.t[-1]
        for i, times in enumerate(run.t_events):
            if times.size:
                signs[i] = -signs[i]


def states_at(
    kind: str,
    motion: Motion,
    ts: np.ndarray,
    omega: np.ndarray | None = None,
    **options,
) -> np.ndarray:
    """Angular velocity, attitude and angle turned at increasing times (n, 8).

    Args:
        kind: One of `KINDS`.
        motion: What moves.
        ts: Times after 0.
        omega: Where it starts, if not at `motion.omega`.
        options: For `solve_ivp`, in place of those of a reference.
    """
    options = {"method": "DOP853"} | (options or ACCURATE)
    omega = motion.omega if omega is None else omega
    y = np.concatenate([omega, motion.attitude, [0.0]])
    signs = None
    if kind == "kinked":
        signs = np.sign(switching_functions(motion, y)).tolist()
    states = []
    for start, end, is_asked in _stretches(motion.breaks, ts):
        torque = _BETWEEN[kind](motion.parameters, start, end)
        y = _stretch(motion, rates_of(motion, torque), y, start, end, signs, **options)
        y[3:7] /= np.linalg.norm(y[3:7])
        if is_asked:
            states.append(y)
    return np.stack(states)


def _stretches(breaks: np.ndarray, ts: np.ndarray) -> Iterator[tuple]:
    """Start and end of each stretch from break to break; whether a time ends it."""
    ends = np.unique(np.concatenate([breaks[breaks < ts[-1]], ts])).tolist()
    asked = set(ts.tolist())
    for start, end in zip([0.0, *ends[:-1]], ends, strict=True):
        yield start, end, end in asked


def reference_of(kind: str, motion: Motion, duration: float) -> Reference:
    """The motion at `CHECKS` equally spaced times after 0, the last at the end."""
    ts = np.linspace(0.0, duration, CHECKS + 1)[1:]
    states = states_at(kind, motion, ts)
    return Reference(ts, states[:, 3:7], states[:, :3], states[:, 7])


def is_regular(kind: str, motion: Motion, duration: float) -> bool:
    """Whether disturbances grow by no more than 1 + radians, and the spin stays near 1.

    A motion that is not regular is no test of the promise about states.
    """
    ts = np.linspace(0.0, duration, CHECKS + 1)[1:]
    options = {"rtol": LOOSE, "atol": LOOSE}
    plain = states_at(kind, motion, ts, **options)
    speed = np.linalg.norm(plain[:, :3], axis=1)
    if speed.min() < 0.3 or speed.max() > 3.0:
        return False
    for nudge in DISTURBANCE * np.eye(3):
        disturbed = states_at(kind, motion, ts, motion.omega + nudge, **options)
        growth = np.linalg.norm((disturbed - plain)[:, :7], axis=1) / DISTURBANCE
        if np.any(growth > 1 + plain[:, 7]):
            return False
    return True


def regular_motions(
    kind: str,
    count: int,
    duration: float,
    knots: int = KNOTS,
) -> Iterator[Motion]:
    """The first so many random motions that are regular."""
    number = 0
    while count > 0:
        motion = candidate(kind, number, duration, knots)
        number += 1
        if is_regular(kind, motion, duration):
            count -= 1
            yield motion


def arrays_of(
    kind: str,
    count: int,
    duration: float,
    knots: int = KNOTS,
) -> dict[str, np.ndarray]:
    """Regular motions and their references as arrays, a motion to each first index."""
    motions = list(regular_motions(kind, count, duration, knots))
    references = [reference_of(kind, motion, duration) for motion in motions]
    arrays = {}
    for name in motions[0].parameters:
        arrays[f"torque_{name}"] = [motion.parameters[name] for motion in motions]
    for name in _OF_MOTION:
        arrays[f"motion_{name}"] = [getattr(motion, name) for motion in motions]
    for name in Reference._fields:
        arrays[f"reference_{name}"] = [getattr(x, name) for x in references]
    return {name: np.stack(value) for name, value in arrays.items()}


def from_arrays(arrays: dict[str, np.ndarray]) -> tuple[Motion, Reference]:
    """What `arrays_of` made arrays of: all motions in one, all references in one."""
    groups: dict[str, Any] = {"motion": {}, "torque": {}, "reference": {}}
    for key, array in arrays.items():
        group, name = key.split("_", 1)
        groups[group][name] = array
    motion = Motion(parameters=groups["torque"], **groups["motion"])
    return motion, Reference(**groups["reference"])
