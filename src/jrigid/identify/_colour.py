"""Whether what is left of a record is white: no band of frequencies stands out.

A sum of squares sees how much is left, not how it is arranged. A torque at the spin
rate that changes it by less than its scatter moves the answer by many errors: its power
is in a few frequencies, where nothing but noise should be.
"""

from collections.abc import Sequence

import numpy as np

SURE = 5.5  # standard deviations: one white record in 5 x 10^7, for each band
STRONG = 2.0  # times the mean power of what is left
_FEWEST = 16  # samples with a spectrum


def stands_out(power: float, deviations: float) -> bool:
    """Whether a band of frequencies has more than noise has."""
    return bool(power > STRONG and deviations > SURE)


def loudest_band(residuals: np.ndarray, parts: Sequence[slice]) -> tuple[float, float]:
    """Power in the band that stands out most, and by how many standard deviations it does.

    Bands have 1, 2, 4, ... neighbouring frequencies, of one record in one trial or of
    all trials. The mean power is that of the residuals, whatever their size.

    Args:
        residuals: Whitened (trials, samples, degrees), zero where nothing was seen.
        parts: Where each record's samples are.

    Returns:
        The power over the mean, and the deviations; (1, 0) where there are too few
        samples.
    """
    best = 1.0, 0.0
    for part in parts:
        for spectrum, count in _spectra(residuals[:, part]):
            width = 1
            while width <= spectrum.size // 2:
                power = np.convolve(spectrum, np.ones(width), "valid") / (width * count)
                i = int(np.argmax(power))
                deviations = _deviations(float(power[i]), width * count)
                if deviations > best[1]:
                    best = float(power[i]), float(deviations)
                width *= 2
    return best


def _spectra(residuals: np.ndarray) -> list[tuple[np.ndarray, int]]:
    """Power at each frequency, the components of a trial, or of all, added; and how many."""
    found, whole = [], []
    for trial in residuals:
        seen = np.any(trial != 0, axis=-1)
        if np.sum(seen) < _FEWEST:
            continue
        # Gaps are closed: what is white stays white.
        rows = trial[seen][:, np.any(trial != 0, axis=0)]
        power = np.abs(np.fft.rfft(rows, axis=0)[1:-1]) ** 2
        mean = np.mean(power)
        if not mean > 0:
            continue
        spectrum = np.sum(power / mean, axis=1)
        found.append((spectrum, rows.shape[1]))
        whole.append(spectrum)
    if len({x.size for x in whole}) == 1 and len(whole) > 1:
        found.append((np.sum(whole, axis=0), sum(count for _, count in found)))
    return found


def _deviations(power: float, count: int) -> float:
    """Of the mean of `count` exponential numbers: Wilson and Hilferty's normal deviate."""
    spread = 1 / (3 * np.sqrt(count))
    return (power ** (1 / 3) - (1 - spread**2)) / spread
