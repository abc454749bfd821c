"""Flights: the parts of a reading in which nothing touches the body."""

import dataclasses
import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jrigid._checks import check_option
from jrigid.records._found_in_records import Reading, runs

# Time over which a lever or a tensor is guessed [s], and how many guesses are tried.
_WINDOW = 0.2
_GUESSES = 300
# A guess is tried on all rows if it explains this part of its own window.
_SOUND = 0.9
# An equation looks at readings so far to either side [s].
_REACH = {"forces": 0.01, "momentum": 0.05}
# Usual size of a lever, from the mass centre to an accelerometer [m]; and of what
# distinguishes moments from equal ones, for a trace of 1.
_USUAL = 0.2
# Noise, drag of the air and a wrong scale change the specific force by so much [m/s^2],
# and by this part of it.
_FORCE = (3.0, 0.05)
# The momentum may change by this part over the reach, and by so many deviations of the
# gyro's noise.
_KEPT = (0.02, 6.0)
# Slower spins determine no momentum [rad/s].
_SPIN = 2.0
# Largest moment for a trace of 1: half for a flat body, and some noise.
_LARGEST = 0.55
# Delays of the accelerometer after the gyro [s]: each filters its readings.
_DELAYS = (0.0, 0.002, -0.002, 0.004, -0.004, 0.006, -0.006, 0.008, -0.008)
# A delay must explain so many times the rows to be preferred to none.
_BETTER = 1.05
# Bias of an accelerometer [m/s^2]. If it is larger, a hand holds the body.
_BIAS = 1.0
# A flight without noise may differ from its lever by so much [m/s^2].
_QUIET = 1.5
# A flight with noise may differ by so many medians, and by so much at most [m/s^2].
_NOISY = (3.5, 7.0)
# Ends of a flight may differ by so much [m/s^2], by so many medians, and by this part
# of the force.
_EDGE = (1.0, 2.0, 0.03)
# If so many readings equal the largest one, the accelerometer was at the end of its
# range, which is 2 g at least [m/s^2].
_CLIPPED = 4
_LEAST_RANGE = 19.0
# A step of the rates is a blow if the slopes leave so many medians of it unexplained,
# and this part of the rate.
_JUMP = (8.0, 0.15)
# So much of a flight may be unexplained [s], if by less than twice what is allowed.
_HOLE = 0.06
# Rounds of fitting a lever to a flight and finding where the flight ends.
_ROUNDS = 3


def flights(
    reading: Reading,
    *,
    min_duration: float = 0.2,
    margin: float = 0.01,
    by: str | None = None,
) -> list[Reading]:
    r"""Find the parts of a reading in which nothing touches the body: trials.

    With an accelerometer: in free fall it shows
    $\dot\omega \times r + \omega \times (\omega \times r)$, where $r$ is its lever from
    the mass centre, whatever that is; a hand adds gravity and more. The lever that
    explains the longest part of the record gives the flights; then each flight gets a
    lever and a bias of its own, and ends where these no longer explain the readings. A
    delay of up to 8 ms between gyro and accelerometer is accounted for.

    Without an accelerometer: the momentum of one tensor stays the same in space but for
    a linear drag,
    $I (\omega_b - \omega_a) + \int \omega \times I \omega\, dt + c \int \omega\, dt =
    0$ from any time to any other. This misses a fifth of the flights, and most of those
    in which a wheel changes the momentum; a smooth slow turn in the hand, or a spin in
    a bearing, looks like a flight.

    Args:
        reading: With rates, and specific forces if there are any. No flight goes over a
            break.
        min_duration: Shorter parts are dropped [s].
        margin: Readings closer than this to one with contact are cut off [s].
        by: `"forces"`, `"momentum"`, or None for forces where there are any.

    Returns:
        A reading for each flight, with a note. The list is empty where there is none.

    Raises:
        ValueError: No rates, or no specific forces for `by="forces"`.

    >>> import numpy as np
    >>> import jrigid as jr
    >>> times = np.arange(200) / 100
    >>> flying = (times > 0.5) & (times < 1.2)
    >>> forces = np.where(flying[:, None], 0.0, [0.0, 0.0, 9.8])
    >>> reading = jr.records.Reading(times, np.zeros((200, 3)), forces)
    >>> [flight] = jr.records.flights(reading)
    >>> print(*flight.notes)
    flight 1 of 1, 0.51 s to 1.19 s: no contact by the specific forces

    Source: the consensus of guesses is that of Fischler and Bolles, Comm. ACM 24, 381
    (1981).
    """
    check_option("by", by, (None, "forces", "momentum"))
    rates = reading.rates
    forces = reading.specific_forces
    t = reading.times
    if rates is None or (by == "forces" and forces is None):
        needed = "rates" if rates is None else "specific forces"
        raise ValueError(f"Argument `reading` must have {needed}, but it has none.")
    by = "momentum" if forces is None else by or "forces"
    size = max(4, round(_WINDOW / reading.interval)) if t.size > 4 else t.size
    if t.size <= size:
        return []
    if forces is None or by == "momentum":
        spans = _by_momentum(reading, rates, size, min_duration)
    else:
        spans = _by_forces(reading, rates, forces, size, min_duration)
    flown = []
    for first, last in spans:
        rows = _inside(reading, first, last, margin, by)
        if rows.size and t[last - 1] - t[first] >= min_duration:
            flown.append(reading[int(rows[0]) : int(rows[-1]) + 1])
    reason = f"no contact by the {by.replace('forces', 'specific forces')}"
    for i, x in enumerate(flown):
        span = f"{x.times[0]:.6g} s to {x.times[-1]:.6g} s"
        note = f"flight {i + 1} of {len(flown)}, {span}: {reason}"
        flown[i] = dataclasses.replace(x, notes=(*x.notes, note))
    return flown


def _inside(
    reading: Reading, first: int, last: int, margin: float, by: str
) -> np.ndarray:
    """Rows of a flight that are farther than the margin from readings with contact."""
    t = reading.times
    before = first
    after = last - 1
    if by == "forces":
        # The readings outside have contact, but across a break nobody knows. By the
        # momentum the edges themselves are uncertain, and the margin counts from there.
        before -= first not in (0, *reading.breaks)
        after += last not in (t.size, *reading.breaks)
    rows = np.arange(first, last)
    return rows[(t[rows] >= t[before] + margin) & (t[rows] <= t[after] - margin)]


def _by_momentum(
    reading: Reading, rates: np.ndarray, size: int, min_duration: float
) -> list[tuple[int, int]]:
    """Spans of rows in which one tensor keeps its momentum."""
    reach = max(1, round(_REACH["momentum"] / reading.interval))
    law = _of_a_tensor(reading.times, rates, reach)
    _forget_breaks(law, reading, reach)
    # Equations at the ends of a flight look beyond it, so that fewer of them hold.
    shortest = max(2, round(min_duration / reading.interval)) - 2 * reach
    free = _consensus(law, size, shortest)
    # An equation holds for all that it looks at, and hardly for its ends.
    free = np.convolve(free, np.ones(2 * (4 * reach // 5) + 1), mode="same") > 0.5
    return runs(free)


def _by_forces(
    reading: Reading,
    rates: np.ndarray,
    forces: np.ndarray,
    size: int,
    min_duration: float,
) -> list[tuple[int, int]]:
    """Spans of rows in which a lever explains the specific forces."""
    t = reading.times
    reach = max(1, round(_REACH["forces"] / reading.interval))
    shortest = max(2, round(min_duration / 2 / reading.interval)) - 2 * reach
    best = np.zeros(t.size, bool)
    delay = 0.0
    for tried in _DELAYS:
        shifted = _shifted(reading, forces, tried)
        law = _of_a_lever(t, rates, shifted, reach)
        _forget_breaks(law, reading, reach)
        free = _consensus(law, size, max(2, shortest))
        if free.sum() > (_BETTER if tried else 1.0) * best.sum():
            best = free
            delay = tried
    spans = []
    for piece in itertools.pairwise((0, *reading.breaks, t.size)):
        rows = slice(*piece)
        # Slopes need some rows to either side.
        if piece[1] - piece[0] <= 4 * reach or not best[rows].any():
            continue
        part = _Part.of(reading[rows], delay, best[rows])
        for first, last in part.parted(best[rows]):
            span = part.span(first, last)
            if span:
                spans.append((span[0] + piece[0], span[1] + piece[0]))
    return _joined(spans)


def _shifted(reading: Reading, forces: np.ndarray, delay: float) -> np.ndarray:
    """Specific forces at the gyro's times, from an accelerometer with a delay."""
    if delay == 0.0:
        return forces
    t = reading.times
    columns = [np.interp(t + delay, t, column) for column in forces.T]
    return np.stack(columns, axis=1)


def _forget_breaks(law: "_Law", reading: Reading, reach: int) -> None:
    """Drop, in place, the equations that look across a break or an end."""
    for row in (0, *reading.breaks, reading.times.size):
        law.wanted[max(row - reach, 0) : row + reach] = np.nan


def _joined(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Spans in order, those that overlap as one."""
    joined: list[tuple[int, int]] = []
    for first, last in sorted(spans):
        if joined and first < joined[-1][1]:
            joined[-1] = (joined[-1][0], max(last, joined[-1][1]))
        else:
            joined.append((first, last))
    return joined


class _Part(NamedTuple):
    """A part of a reading without a break, and the equations of a lever in it.

    Attributes:
        times: [s].
        forces: Specific forces at the times of the gyro [m/s^2].
        models: What a lever of 1 m along each axis shows, (slopes, rows, 3, 3), for
            angular accelerations from readings on both sides, before and after alone.
        hole: Rows that a flight may lack within.
        jumps: Rows before which the rates jump: the body hit something between two
            readings.
    """

    times: Float[np.ndarray, " rows"]
    forces: Float[np.ndarray, "rows 3"]
    models: Float[np.ndarray, "slopes rows 3 3"]
    hole: int
    jumps: Bool[np.ndarray, " rows"]

    @classmethod
    def of(
        cls, reading: Reading, delay: float, free: Bool[np.ndarray, " rows"]
    ) -> "_Part":
        """Prepare the equations of a part in which some rows are known to be free."""
        rates = reading.rates
        forces = reading.specific_forces
        t = reading.times
        assert rates is not None
        assert forces is not None
        reach = 1
        hole = 0
        if t.size > 1:
            reach = max(1, round(_REACH["forces"] / reading.interval))
            hole = round(_HOLE / reading.interval)
        slopes = [_slope(t, rates, reach), *_one_sided(t, rates, reach)]
        # omega' x r + omega x (omega x r), as a matrix that acts on the lever r.
        models = np.array([_cross(x) + _cross(rates) @ _cross(rates) for x in slopes])
        jumps = np.zeros(t.size, bool)
        if reach == 1:
            # A blow that falls between two readings of a slow clock.
            jumps = _jumps(t, rates, slopes[1:], free)
        return cls(t, _shifted(reading, forces, delay), models, hole, jumps)

    def parted(self, free: Bool[np.ndarray, " rows"]) -> list[tuple[int, int]]:
        """Runs of rows without a jump inside."""
        spans = []
        for first, last in runs(free):
            inside = first + 1 + np.flatnonzero(self.jumps[first + 1 : last])
            spans += itertools.pairwise((first, *inside.tolist(), last))
        return spans

    def span(self, first: int, last: int) -> tuple[int, int] | None:
        """Grow a flight from rows that are known to be in it; None if it is none."""
        core = np.zeros(self.times.size, bool)
        core[first:last] = True
        for _ in range(_ROUNDS):
            fit = self.fit(core)
            residuals = self.residuals(fit)
            # At an end of a flight only one of the slopes is made of readings in it.
            least = residuals.min(axis=0)
            median = float(np.median(least[core]))
            allowed = min(max(_QUIET, _NOISY[0] * median), _NOISY[1])
            shown = np.nan_to_num(np.linalg.norm(self.forces, axis=1))
            allowed = allowed + _FORCE[1] * shown
            free = self.without_holes(least < allowed, least < 2 * allowed)
            spans = self.parted(free)
            if not spans:
                return None
            first, last = max(spans, key=lambda span: core[slice(*span)].sum())
            if not core[first:last].any():
                return None
            allowed = max(_EDGE[0], _EDGE[1] * median) + _EDGE[2] * shown
            first, last = _trimmed(residuals < allowed, first, last)
            same = core.sum() == last - first and core[first:last].all()
            core[:] = False
            core[first:last] = True
            if same:
                break
        return first, last

    def fit(self, core: Bool[np.ndarray, " rows"]) -> Float[np.ndarray, "6"]:
        """Lever [m] and bias [m/s^2]: least squares, twice without the worst rows."""
        of_bias = np.broadcast_to(np.eye(3), (core.size, 3, 3))
        model = np.concatenate([self.models[0], of_bias], axis=2)
        known = core & np.isfinite(self.forces.sum(axis=1) + model.sum(axis=(1, 2)))
        noise = _FORCE[0]
        # Usual sizes fill in what the rows do not determine.
        drawn = np.repeat([_USUAL, _BIAS / 2], 3) ** -2.0
        fit = np.zeros(6)
        use = known
        at_end = _at_the_end(self.forces)
        read = ~at_end
        for _ in range(3):
            if use.sum() < 3:
                break
            weights = read[use] / noise
            a = (model[use] * weights[..., None]).reshape(-1, 6)
            b = (self.forces[use] * weights).ravel()
            fit = np.linalg.solve(a.T @ a + np.diag(drawn), a.T @ b)
            shown = model @ fit
            # The end of the range bounds the force from below: it counts where less is
            # shown.
            read = ~at_end | (np.sign(self.forces) * shown < np.abs(self.forces))
            beside = np.linalg.norm(self.clipped(shown) - self.forces, axis=1)
            use = known & (beside <= 3 * np.median(beside[use]))
        size = np.linalg.norm(fit[3:])
        fit[3:] *= min(1.0, _BIAS / size) if size > 0 else 1.0
        return fit

    def residuals(
        self, fit: Float[np.ndarray, "6"]
    ) -> Float[np.ndarray, "slopes rows"]:
        """Residuals of lever and bias [m/s^2]; infinite where nothing is read."""
        shown = self.models @ fit[:3] + fit[3:]
        residuals = np.linalg.norm(self.clipped(shown) - self.forces, axis=2)
        return np.where(np.isfinite(residuals), residuals, np.inf)

    def clipped(self, shown: np.ndarray) -> np.ndarray:
        """Clip specific forces to the range of the accelerometer, as it does."""
        most = np.nanmax(np.abs(self.forces), initial=0.0)
        return np.clip(shown, -most, most)

    def without_holes(
        self, free: Bool[np.ndarray, " rows"], nearly: Bool[np.ndarray, " rows"]
    ) -> Bool[np.ndarray, " rows"]:
        """Rows that fit, and short stretches between them that nearly do."""
        filled = free.copy()
        for first, last in runs(~free):
            inside = first > 0 and last < free.size
            if inside and last - first <= self.hole and nearly[first:last].all():
                filled[first:last] = True
        return filled


def _trimmed(
    fits: Bool[np.ndarray, "slopes rows"], first: int, last: int
) -> tuple[int, int]:
    """A flight without rows at its ends that do not fit by slopes from inside."""
    central, before, after = fits[:, first:last]
    starts = np.argmax(central | after)
    ends = np.argmax((central | before)[::-1])
    return first + int(starts), last - int(ends)


def _jumps(
    t: np.ndarray, rates: np.ndarray, slopes: list[np.ndarray], free: np.ndarray
) -> np.ndarray:
    """Rows before which rates change by more than the slopes on either side explain."""
    before, after = slopes
    steps = np.diff(t)[:, None]
    # The trapezoidal rule, with slopes that do not look across the step.
    beside = np.diff(rates, axis=0) - steps / 2 * (before[:-1] + after[1:])
    size = np.append(0.0, np.nan_to_num(np.linalg.norm(beside, axis=1)))
    usual = float(np.median(size[free])) if free.any() else 0.0
    # The parabolas of the neighbours look across a jump, too: it is where most is left.
    around = np.lib.stride_tricks.sliding_window_view(np.pad(size, 2), 5)
    is_largest = size == around.max(axis=1)
    spin = np.linalg.norm(rates, axis=1)
    return is_largest & (size > np.maximum(_JUMP[0] * usual, _JUMP[1] * spin))


#: Function of the unknowns and the rows.
_Bound = Callable[[np.ndarray, slice], np.ndarray | float]


class _Law(NamedTuple):
    """Equations of each row that hold in flight, |model x - wanted| < bound(x, rows).

    Attributes:
        model: Over the errors (rows, equations, unknowns).
        wanted: Over the errors (rows, equations); NaN where nothing is known.
        bound: By the unknowns and the rows.
    """

    model: np.ndarray
    wanted: np.ndarray
    bound: _Bound


def _constant_bound(_unknowns: np.ndarray, _rows: slice) -> float:
    """Errors are in units of what is allowed."""
    return 1.0


def _of_a_lever(
    t: np.ndarray, rates: np.ndarray, forces: np.ndarray, reach: int
) -> _Law:
    """The specific force is that of a lever."""
    absolute, relative = _FORCE
    tolerance = absolute + relative * np.linalg.norm(forces, axis=1, keepdims=True)
    model = _cross(_slope(t, rates, reach)) + _cross(rates) @ _cross(rates)
    # An axis at the end of its range tells nothing here: 0 = 0.
    read = ~_at_the_end(forces)
    model = model * read[..., None]
    wanted = forces * read / tolerance
    return _Law(model / tolerance[..., None], wanted, _constant_bound)


def _at_the_end(forces: np.ndarray) -> np.ndarray:
    """Samples at the end of an accelerometer's range; none unless there are several."""
    size = np.abs(np.nan_to_num(forces))
    at_end = size >= max((1 - 1e-6) * size.max(initial=0.0), _LEAST_RANGE)
    return at_end & (at_end.sum() >= _CLIPPED)


def _cross(vectors: np.ndarray) -> np.ndarray:
    """Matrices that take the cross product with vectors, one for each row."""
    # Row i is e_i x v, and (e_i x v) . r is component i of v x r.
    return np.cross(np.eye(3), vectors[:, None])


def _slope(t: np.ndarray, rates: np.ndarray, reach: int) -> np.ndarray:
    """Angular accelerations from readings on both sides."""
    near = _across(rates, reach) / _across(t, reach)[:, None]
    if reach > 1:
        return near
    # Slow clocks miss curvature: the error of fourth order instead of second.
    far = _across(rates, 2) / _across(t, 2)[:, None]
    return (4 * near - far) / 3


def _one_sided(t: np.ndarray, rates: np.ndarray, reach: int) -> list[np.ndarray]:
    """Angular accelerations from earlier readings alone and from later ones alone."""
    earlier = _from_one_side(t, rates, reach)
    earlier[: 2 * reach] = np.nan  # rolled in from the other end
    later = _from_one_side(t, rates, -reach)
    later[max(t.size - 2 * reach, 0) :] = np.nan
    return [earlier, later]


def _from_one_side(t: np.ndarray, rates: np.ndarray, shift: int) -> np.ndarray:
    """Slopes of the parabola through a reading and two others on one side of it."""
    t1 = np.roll(t, shift)
    t2 = np.roll(t, 2 * shift)
    w1 = np.roll(rates, shift, axis=0)
    w2 = np.roll(rates, 2 * shift, axis=0)
    # Derivatives at t of Lagrange's three polynomials.
    a = (2 * t - t1 - t2) / ((t - t1) * (t - t2))
    b = (t - t2) / ((t1 - t) * (t1 - t2))
    c = (t - t1) / ((t2 - t) * (t2 - t1))
    return a[:, None] * rates + b[:, None] * w1 + c[:, None] * w2


class _MomentumBound(NamedTuple):
    """The angular momentum, in parts of that of the sphere.

    Attributes:
        tensors: A sphere, and five tensors without a trace.
        rates: Angular velocities [rad/s].
        spin: Their sizes [rad/s].
    """

    tensors: np.ndarray
    rates: np.ndarray
    spin: np.ndarray

    def __call__(self, x: np.ndarray, rows: slice) -> np.ndarray | float:
        """Zero for a tensor that no body has, which then explains nothing."""
        tensor = self.tensors[0] + np.tensordot(x[:-1], self.tensors[1:], 1)
        moments = np.linalg.eigvalsh(tensor)
        if moments[0] <= 0 or moments[2] > _LARGEST:
            return 0.0
        sizes = 3 * np.linalg.norm(self.rates[rows] @ tensor, axis=1)
        return sizes / np.maximum(self.spin[rows], _SPIN)


def _of_a_tensor(t: np.ndarray, rates: np.ndarray, reach: int) -> _Law:
    """The angular momentum of a tensor of trace 1 stays, but for a linear drag.

    The unknowns are five numbers of the tensor and the drag [1/s]; errors are in parts
    of the angular momentum.
    """
    # A sphere and five tensors without a trace make up all others.
    x, y, z = np.eye(3)
    off = [np.outer(a, b) + np.outer(b, a) for a, b in ((x, y), (x, z), (y, z))]
    tensors = np.array([np.eye(3) / 3, np.diag(x - y), np.diag(y - z), *off])
    momenta = np.einsum("kij,tj->tik", tensors, rates)
    # Euler's equation with drag, I omega' + omega x I omega + c omega = 0, integrated.
    turning = np.cross(rates[:, :, None], momenta, axis=1)
    in_space = momenta + _integral(t, turning)
    dragged = _integral(t, rates)
    whole = np.concatenate([in_space, dragged[..., None]], axis=2)
    spin = np.linalg.norm(rates, axis=1)
    relative, times_noise = _KEPT
    # The moments of a sphere of trace 1 are 1/3.
    tolerance = (relative * spin + times_noise * _noise_of(rates)) / 3
    tolerance = np.where(spin > _SPIN, tolerance, np.nan)
    change = _across(whole, reach) / tolerance[:, None, None]
    bound = _MomentumBound(tensors, rates, spin)
    # The sphere has the coefficient 1, which fixes the trace: its part is known.
    return _Law(change[..., 1:], -change[..., 0], bound)


def _noise_of(rates: np.ndarray) -> float:
    """Standard deviation of the noise of smooth rates [rad/s].

    Their third differences are noise of 20 times its variance. 2.37 is the median of
    chi-square with three degrees of freedom, one for each axis.
    """
    sizes = np.linalg.norm(np.diff(rates, 3, axis=0), axis=1)
    return np.median(sizes) / np.sqrt(20 * 2.37)


def _integral(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Integrals up to each time, by the trapezoidal rule."""
    steps = np.gradient(t).reshape(-1, *(1,) * (x.ndim - 1)) * x
    return np.cumsum(steps, axis=0) - steps / 2


def _across(x: np.ndarray, reach: int) -> np.ndarray:
    """Changes from some rows before to as many after; of no meaning at the ends."""
    return np.roll(x, -reach, axis=0) - np.roll(x, reach, axis=0)


class _Equations(NamedTuple):
    """The equations of a law, with zeros in rows of which nothing is known.

    Attributes:
        law: With finite numbers.
        known: Rows of which something is known.
        shortest: Rows that a run must have to count.
    """

    law: _Law
    known: np.ndarray
    shortest: int

    @classmethod
    def of(cls, law: _Law, shortest: int) -> "_Equations":
        """Put zeros where numbers are missing."""
        model, wanted, bound = law
        known = np.isfinite(wanted.sum(axis=1) + model.sum(axis=(1, 2)))
        model = np.where(known[:, None, None], model, 0.0)
        wanted = np.where(known[:, None], wanted, 0.0)
        return cls(_Law(model, wanted, bound), known, shortest)

    @property
    def unknowns(self) -> int:
        """Count of the numbers that are sought."""
        return self.law.model.shape[2]

    def solve(self, rows: slice | np.ndarray) -> np.ndarray:
        """Solve least squares; usual values fill in what rows do not determine."""
        drawn = np.eye(self.unknowns) / _USUAL**2
        a = self.law.model[rows].reshape(-1, self.unknowns)
        return np.linalg.solve(a.T @ a + drawn, a.T @ self.law.wanted[rows].ravel())

    def explained(self, x: np.ndarray, rows: slice = slice(None)) -> np.ndarray:
        """Rows whose equations hold with these unknowns."""
        residuals = self.law.model[rows] @ x - self.law.wanted[rows]
        sizes = np.linalg.norm(residuals, axis=1)
        return self.known[rows] & (sizes < self.law.bound(x, rows))

    def in_runs(self, x: np.ndarray) -> np.ndarray:
        """Rows that these unknowns explain in runs that are long enough."""
        explained = self.explained(x)
        for first, last in runs(explained):
            explained[first:last] = last - first >= self.shortest
        return explained


def _consensus(law: _Law, size: int, shortest: int) -> np.ndarray:
    """Rows that the best unknowns explain: those that explain most rows in long runs.

    Unknowns are guessed from windows of `size` rows.
    """
    equations = _Equations.of(law, shortest)
    count = len(equations.known)
    firsts = range(0, count - size, max(size // 2, count // _GUESSES))
    # Zeros are a guess, too: an accelerometer in the mass centre, or a sphere.
    guesses = [np.zeros(equations.unknowns)]
    for window in (slice(first, first + size) for first in firsts):
        guess = equations.solve(window)
        # A guess that does not explain its own window is not tried on the rest.
        if equations.explained(guess, window).mean() >= _SOUND:
            guesses.append(guess)
    best = max(map(equations.in_runs, guesses), key=np.sum)
    # A fit to all rows that are explained may explain fewer than the guess.
    return max(equations.in_runs(equations.solve(best)), best, key=np.sum)
