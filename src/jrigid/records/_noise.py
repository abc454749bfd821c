"""What a sensor shows while nothing moves: its noise, its bias and how that wanders."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jrigid._checks import check_shape
from jrigid._types import Readable
from jrigid.records._reading import Reading

_FLICKER = np.sqrt(2 * np.log(2) / np.pi)  # Allan deviation of 1/f noise of a unit instability
_WINDOW = 0.25  # [s] over which it is judged whether the body rests
_STILL = 0.1  # [rad/s] standard deviation above which a body does not rest, whatever else it does
_BIAS = 0.2  # [rad/s] mean above which it turns: biases of gyros are below
_FLOOR = 0.1, 3.0  # the quietest tenth of the windows, and how much noisier others at rest may be
_PER_OCTAVE = 4  # averaging times in a factor of two


class Allan(NamedTuple):
    """Overlapping Allan deviations.

    Attributes:
        times: Averaging times [s].
        deviations: In the unit of the values, for each averaging time and column.
        counts: Differences averaged over; longer times have fewer independent ones.
    """

    times: Float[np.ndarray, " n"]
    deviations: Float[np.ndarray, "n columns"]
    counts: Float[np.ndarray, " n"]


class Noise(Readable):
    """Noise of a gyro at rest, each of three axes.

    Attributes:
        interval: Between readings [s].
        bias: Mean at rest [rad/s].
        sigma: White noise of one reading [rad/s]: Allan deviation over one interval.
        density: White noise [rad/s/sqrt(Hz)], from where the Allan deviation falls as it should for
            white noise. In a gyro that filters its output it exceeds `sigma` sqrt(interval).
        instability: Bias instability [rad/s]: the least Allan deviation over 0.664; an upper bound
            where `instability_times` is the longest that was looked at.
        instability_times: Averaging times of the least deviation [s].
        allan: The Allan deviations that it is taken from.
        notes: In words.
    """

    interval: float
    bias: Float[np.ndarray, " 3"]
    sigma: Float[np.ndarray, " 3"]
    density: Float[np.ndarray, " 3"]
    instability: Float[np.ndarray, " 3"]
    instability_times: Float[np.ndarray, " 3"]
    allan: Allan
    notes: tuple[str, ...]


def allan(values: Float[np.ndarray, "rows columns"] | list[np.ndarray], interval: float) -> Allan:
    r"""Overlapping Allan deviations of even readings.

    $\sigma^2(m \tau) = \langle (\theta_{k+2m} - 2 \theta_{k+m} + \theta_k)^2 \rangle / (2 m^2
    \tau^2)$ with $\theta$ the integral of the values, for averages over up to a third of the
    readings. White noise of standard deviation s gives s / sqrt(m), a bias that wanders as a random
    walk rises as sqrt(m), and 1/f noise of instability B lies level at 0.664 B.

    Args:
        values: Readings, or a list of stretches of them, whose squares are pooled.
        interval: Between readings [s].

    Raises:
        ValueError: Fewer than three readings.

    >>> import numpy as np
    >>> import jrigid as jr
    >>> noise = np.random.default_rng(0).normal(size=(20000, 1))
    >>> print(jr.records.allan(noise, 0.01).deviations[0].round(2))
    [1.]

    Source: IEEE Std 952-1997, annex C; Riley, NIST SP 1065 (2008), section 5.2.
    """
    pieces = [np.asarray(x, float) for x in (values if isinstance(values, list) else [values])]
    for piece in pieces:
        check_shape("values", piece, (None, None))
    longest = max((x.shape[0] for x in pieces), default=0)
    if longest < 3:
        raise ValueError(f"Argument `values` must have 3 readings, but it has {longest}.")
    octaves = np.arange(0, np.log2(longest / 3) + 1e-9, 1 / _PER_OCTAVE)
    averaged = np.unique(np.round(2**octaves).astype(int))
    squares = np.zeros((averaged.size, pieces[0].shape[1]))
    counts = np.zeros(averaged.size)
    for piece in pieces:
        # the mean changes nothing but the rounding of the sums
        sums = np.cumsum(piece - piece.mean(axis=0), axis=0)
        sums = np.concatenate([np.zeros((1, piece.shape[1])), sums])
        for i, m in enumerate(averaged):
            if 2 * m < sums.shape[0]:
                second = sums[2 * m :] - 2 * sums[m:-m] + sums[: -2 * m]
                squares[i] += np.sum(second**2, axis=0)
                counts[i] += second.shape[0]
    deviations = np.sqrt(squares / (2 * counts * averaged**2)[:, None])
    return Allan(averaged * interval, deviations, counts)


def rests(reading: Reading, *, least: float = 1.0) -> list[Reading]:
    """The parts of a reading in which the body rests: as quiet as its quietest, and not turning.

    Args:
        reading: With rates.
        least: Shorter parts are dropped [s].

    Raises:
        ValueError: No rates.
    """
    if reading.rates is None:
        raise ValueError("Argument `reading` must have rates, but it has none.")
    size = max(4, round(_WINDOW / reading.interval)) if reading.times.size > 1 else 4
    windows = []
    for piece in reading.pieces():
        whole = piece.times.size // size
        parts = np.asarray(piece.rates)[: whole * size].reshape(whole, size, 3)
        windows.append((piece, np.linalg.norm(parts.std(axis=1), axis=1), parts.mean(axis=1)))
    spreads = np.concatenate([x for _, x, _ in windows])
    if not spreads.size:
        return []
    quantile, factor = _FLOOR
    loudest = min(_STILL, factor * float(np.quantile(spreads, quantile)))
    quiet_parts = []
    for piece, spread, mean in windows:
        quiet = (spread <= loudest) & (np.linalg.norm(mean, axis=1) < _BIAS)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], quiet, [False]]).astype(int)))
        for first, last in zip(edges[::2] * size, edges[1::2] * size, strict=True):
            if piece.times[last - 1] - piece.times[first] >= least - reading.interval:
                quiet_parts.append(piece[int(first) : int(last)])
    return quiet_parts


def noise(reading: Reading, *, at_rest: bool = False, least: float = 1.0) -> Noise:
    """Noise of the gyro from the rest in a reading: white noise, bias, bias instability.

    Args:
        reading: With rates.
        at_rest: All of the reading is rest; else `rests` looks for it.
        least: Shorter rests are not used [s].

    Raises:
        ValueError: No rates, or no rest.

    >>> import numpy as np
    >>> import jrigid as jr
    >>> rates = 0.02 + 0.01 * np.random.default_rng(0).normal(size=(6000, 3))
    >>> gyro = jr.records.noise(jr.records.Reading(np.arange(6000) / 100, rates))
    >>> print(gyro.bias.round(3), gyro.sigma.round(3), gyro.density.round(4))
    [0.02 0.02 0.02] [0.01 0.01 0.01] [0.001 0.001 0.001]
    """
    pieces = reading.pieces() if at_rest else rests(reading, least=least)
    parts = [np.asarray(x.rates) for x in pieces if x.rates is not None and x.times.size > 2]
    if not parts:
        raise ValueError(
            f"Argument `reading` must have rates at rest for {least:g} s, but it has none."
        )
    curve = allan(parts, reading.interval)
    least_at = np.argmin(curve.deviations, axis=0)
    steps = np.diff(np.log(curve.times))[:, None]
    slopes = np.diff(np.log(np.maximum(curve.deviations, np.finfo(float).tiny)), axis=0) / steps
    density = []
    for axis, until in enumerate(least_at):
        white = np.abs(slopes[: max(until, 1), axis] + 0.5) < 0.1
        white = white if white.any() else np.ones_like(white)
        scaled = curve.deviations[: white.size, axis] * np.sqrt(curve.times[: white.size])
        density.append(float(np.median(scaled[white])))
    total = sum(len(x) for x in parts) * reading.interval
    notes = [f"{len(parts)} rest{'s' if len(parts) > 1 else ''}, {total:.4g} s in all"]
    if (least_at == curve.times.size - 1).any():
        notes.append("the rest is too short for the bias instability: an upper bound")
    return Noise(
        reading.interval,
        np.concatenate(parts).mean(axis=0),
        curve.deviations[0],
        np.array(density),
        curve.deviations.min(axis=0) / _FLICKER,
        curve.times[least_at],
        curve,
        tuple(notes),
    )
