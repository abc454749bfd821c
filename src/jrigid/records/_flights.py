"""Throws: where nothing touches the body."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jrigid._checks import check_option
from jrigid.records._reading import Reading

_WINDOW = 0.2  # [s] over which a lever or a tensor is guessed
_GUESSES = 300  # windows that are tried, at most
_SOUND = 0.9  # of the rows of a window that its own guess must explain to be tried on the rest
_SLOPE = 0.02  # [s] over which rates are differentiated
_LEVER = 0.2  # [m] how far from the mass centre an accelerometer usually is
_FORCE = 2.0, 0.05  # [m/s^2], and of the force itself: noise, drag of the air, a wrong scale
_TURN = 0.1  # [s] over which a momentum must stay the same
_KEPT = 0.02, 6.0  # of a momentum that may come or go in that time, and of the gyro's noise
_SPIN = 2.0  # [rad/s] slower spins tell nothing of a momentum
_SHARE = 0.2  # how far moments usually are from equal, of a trace of 1
_LARGEST = 0.55  # moment of a trace of 1: half for a flat body, and some noise


class _Law(NamedTuple):
    """Equations, one for each row, that hold in flight: |model x - wanted| < tolerance."""

    model: np.ndarray
    wanted: np.ndarray
    tolerance: np.ndarray
    usual: float  # size of the unknowns
    reach: int  # rows to either side that an equation looks at
    # By the unknowns, for some rows: what the tolerance is in parts of; 0 if they are of no body.
    scale: Callable[[np.ndarray, slice], np.ndarray | float]


def flights(
    reading: Reading, *, least: float = 0.2, margin: float = 0.01, by: str | None = None
) -> list[Reading]:
    r"""The parts of a reading in which nothing touches the body: throws, without hand and catch.

    With an accelerometer: in free fall it shows $\dot\omega \times r + \omega \times (\omega \times
    r)$, where $r$ is its lever from the mass centre, whatever that is; a hand adds gravity and
    more. Without: the momentum of one tensor stays the same in space, $I (\omega_b - \omega_a) +
    \int \omega \times I \omega\, dt = 0$ from any time to any other. Lever or tensor, both linear
    here, are those that explain the longest part of the record. By its momentum a smooth slow turn
    in the hand, or a spin in a bearing, looks like a flight.

    Args:
        reading: With rates, and specific forces if there are any. No flight goes over a break.
        least: Shorter parts are dropped [s].
        margin: Cut off at both ends of each [s].
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
    flight 1 of 1, 0.52 s to 1.18 s: no contact by the specific forces

    Source: the consensus of guesses is that of Fischler and Bolles, Comm. ACM 24, 381 (1981).
    """
    check_option("by", by, (None, "forces", "momentum"))
    rates, forces = reading.rates, reading.specific_forces
    if rates is None or (by == "forces" and forces is None):
        needed = "rates" if rates is None else "specific forces"
        raise ValueError(f"Argument `reading` must have {needed}, but it has none.")
    by = "momentum" if forces is None else by or "forces"
    interval = reading.interval
    size = max(4, round(_WINDOW / interval)) if interval > 0 else 0
    if reading.times.size <= size:
        return []
    with np.errstate(divide="ignore", invalid="ignore"):  # NaN where nothing is known
        if by == "forces" and forces is not None:
            law = _law_of_forces(reading.times, rates, forces, max(1, round(_SLOPE / 2 / interval)))
        else:
            law = _law_of_momentum(reading.times, rates, max(1, round(_TURN / 2 / interval)))
        for row in (0, *reading.breaks, reading.times.size):
            law.wanted[max(row - law.reach, 0) : row + law.reach] = np.nan
        free = _consensus(law, size, max(2, round(least / interval)))
    if by == "momentum":  # an equation holds for all that it looks at, and hardly for its ends
        free = np.convolve(free, np.ones(2 * (4 * law.reach // 5) + 1), mode="same") > 0.5
    flown = []
    for first, last in _runs(free):
        a, b = reading.times[[first, last - 1]] + [margin, -margin]
        rows = np.flatnonzero((reading.times >= a) & (reading.times <= b))
        if rows.size and b - a >= least - 2 * margin:
            flown.append(reading[int(rows[0]) : int(rows[-1]) + 1])
    what = {"forces": "specific forces", "momentum": "momentum"}[by]
    return [
        flight.with_notes(
            f"flight {i} of {len(flown)}, {flight.times[0]:.6g} s to {flight.times[-1]:.6g} s: "
            f"no contact by the {what}"
        )
        for i, flight in enumerate(flown, 1)
    ]


def _law_of_forces(t: np.ndarray, rates: np.ndarray, forces: np.ndarray, reach: int) -> _Law:
    """The specific force is that of a lever; in the columns of the model, those of a unit lever."""
    slope = np.full_like(rates, np.nan)
    across = (t[2 * reach :] - t[: -2 * reach])[:, None]
    slope[reach:-reach] = (rates[2 * reach :] - rates[: -2 * reach]) / across
    axes = np.eye(3)
    inward = np.cross(rates[:, None], np.cross(rates[:, None], axes))
    model = np.swapaxes(np.cross(slope[:, None], axes) + inward, 1, 2)
    absolute, relative = _FORCE
    tolerance = absolute + relative * np.linalg.norm(forces, axis=1)
    return _Law(model, forces.copy(), tolerance, _LEVER, reach, lambda *_: 1.0)


def _law_of_momentum(t: np.ndarray, rates: np.ndarray, reach: int) -> _Law:
    """The momentum of a tensor of trace 1 stays, in parts of that of a sphere."""
    w = rates[:, :, None]
    # Angular momenta of a sphere and of five tensors without a trace, which make up all others.
    third, off = np.eye(3) / 3, [np.zeros((3, 3)) for _ in range(3)]
    for tensor, (i, j) in zip(off, ((0, 1), (0, 2), (1, 2)), strict=True):
        tensor[i, j] = tensor[j, i] = 1.0
    tensors = np.array([third, np.diag([1.0, -1.0, 0.0]), np.diag([0.0, 1.0, -1.0]), *off])
    momenta = (tensors @ w[:, None])[..., 0]  # rows, tensors, 3
    turning = np.cross(rates[:, None], momenta)
    steps = 0.5 * (turning[1:] + turning[:-1]) * np.diff(t)[:, None, None]
    sums = np.concatenate([np.zeros((1, 6, 3)), np.cumsum(steps, axis=0)])
    whole = momenta + sums
    change = np.full_like(whole, np.nan)
    change[reach:-reach] = whole[2 * reach :] - whole[: -2 * reach]
    spin = np.linalg.norm(rates, axis=1)
    change = np.where(spin[:, None, None] > _SPIN, change / (spin[:, None, None] / 3), np.nan)
    model = np.swapaxes(change[:, 1:], 1, 2)

    def scale(x: np.ndarray, rows: slice) -> np.ndarray | float:
        """The momentum, in parts of the sphere's; moments are positive and none exceeds others."""
        tensor = tensors[0] + np.tensordot(x, tensors[1:], 1)
        moments = np.linalg.eigvalsh(tensor)
        if moments[0] <= 0 or moments[2] > _LARGEST:
            return 0.0
        return np.linalg.norm(rates[rows] @ tensor, axis=1) / (spin[rows] / 3)

    # Third differences of smooth rates are noise, of 20 times its variance; the median of 3 axes.
    noise = np.median(np.linalg.norm(np.diff(rates, 3, axis=0), axis=1)) / np.sqrt(20 * 2.37)
    relative, times_noise = _KEPT
    tolerance = relative + times_noise * noise / np.maximum(spin, _SPIN)
    return _Law(model, -change[:, 0], tolerance, _SHARE, reach, scale)


def _consensus(law: _Law, size: int, least: int) -> np.ndarray:
    """Rows that the best unknowns explain: those that explain the longest part in long runs."""
    equations = np.concatenate([law.wanted[..., None], law.model], axis=2)
    known = np.isfinite(equations.sum(axis=(1, 2)))
    model = np.where(known[:, None, None], law.model, 0.0)
    wanted = np.where(known[:, None], law.wanted, 0.0)
    unknowns = model.shape[2]

    def solve(rows: slice | np.ndarray) -> np.ndarray:
        """Least squares, drawn to zero by what is usual where the rows do not tell."""
        a = (model[rows] / law.tolerance[rows, None, None])[known[rows]].reshape(-1, unknowns)
        b = (wanted[rows] / law.tolerance[rows, None])[known[rows]].ravel()
        return np.linalg.solve(a.T @ a + np.eye(unknowns) / law.usual**2, a.T @ b)

    def explained(x: np.ndarray, rows: slice = slice(None)) -> np.ndarray:
        beside = np.linalg.norm(model[rows] @ x - wanted[rows], axis=1)
        return known[rows] & (beside < law.tolerance[rows] * law.scale(x, rows))

    def in_runs(good: np.ndarray) -> np.ndarray:
        kept = np.zeros_like(good)
        for first, last in _runs(good):
            kept[first:last] = last - first + 2 * law.reach >= least
        return kept

    best = in_runs(explained(np.zeros(unknowns)))
    for first in range(0, known.size - size, max(size // 2, known.size // _GUESSES)):
        window = slice(first, first + size)
        x = solve(window)
        if explained(x, window).mean() >= _SOUND:
            free = in_runs(explained(x))
            best = free if free.sum() > best.sum() else best
    again = in_runs(explained(solve(best)))
    return again if again.sum() >= best.sum() else best


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """First and last plus one of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
