"""Test whether residuals are white: no band of frequencies has too much power.

A sum of squares measures how large residuals are, not how they are arranged. A torque
at the spin rate that changes the sum by less than its scatter can move the estimates by
many errors. Its power is in a few frequencies, which should contain only noise.
"""

from collections.abc import Sequence

import numpy as np

SURE = 5.5  # standard deviations: one white record in 5 x 10^7, for each band
STRONG = 2.0  # times the mean power of the residuals
FEWEST = 16  # samples with a spectrum


def stands_out(power: float, deviations: float) -> bool:
    """Whether a band of frequencies has more power than noise has."""
    return bool(power > STRONG and deviations > SURE)


def loudest_band(residuals: np.ndarray, parts: Sequence[slice]) -> tuple[float, float]:
    """Return the power of the most significant band, and its significance.

    Bands have 1, 2, 4, ... neighbouring frequencies, of one record in one trial or of
    all trials. Power is relative to the mean power of the residuals.

    Args:
        residuals: Whitened residuals (trials, samples, degrees), zero where nothing was
            observed.
        parts: Slice of the samples of each record.

    Returns:
        The power over the mean, and by how many standard deviations it is above the
        mean; (1, 0) where there are too few samples.
    """
    power, deviations = 1.0, 0.0
    for part in parts:
        for spectrum, count in _spectra(residuals[:, part]):
            width = 1
            # A band of more than half of the frequencies hardly differs from all of
            # them, whose mean is 1 by construction.
            while width <= spectrum.size // 2:
                band_power, band_deviations = _loudest_of(spectrum, count, width)
                if band_deviations > deviations:
                    power, deviations = band_power, band_deviations
                width *= 2
    return power, deviations


def _loudest_of(spectrum: np.ndarray, count: int, width: int) -> tuple[float, float]:
    """The loudest band of some width: its power and its significance."""
    numbers = width * count
    power = np.convolve(spectrum, np.ones(width), "valid") / numbers
    largest = float(np.max(power))
    return largest, float(_deviations(largest, numbers))


def _spectra(residuals: np.ndarray) -> list[tuple[np.ndarray, int]]:
    """Power at each frequency, summed over components, and how many were summed.

    There is a spectrum for each trial, and, if all have the same length, one that is
    summed over the trials.
    """
    spectra = []
    for trial in residuals:
        observed = np.any(trial != 0, axis=-1)
        if np.sum(observed) < FEWEST:
            continue
        # Removing gaps keeps white noise white.
        rows = trial[observed][:, np.any(trial != 0, axis=0)]
        # Powers at zero frequency and at half the sampling rate are squares of one real
        # number. All others are sums of two squares, which are exponentially
        # distributed in white noise.
        power = np.abs(np.fft.rfft(rows, axis=0)[1:-1]) ** 2
        mean = np.mean(power)
        if not mean > 0:
            continue
        spectra.append((np.sum(power / mean, axis=1), rows.shape[1]))
    if len(spectra) > 1 and len({spectrum.size for spectrum, _ in spectra}) == 1:
        total = np.sum([spectrum for spectrum, _ in spectra], axis=0)
        spectra.append((total, sum(count for _, count in spectra)))
    return spectra


def _deviations(power: float, count: int) -> float:
    """Significance of a mean of `count` exponential numbers, in standard deviations.

    Source: E. B. Wilson, M. M. Hilferty, PNAS 17 (1931) 684.
    """
    # The mean of n exponential numbers is chi-square of 2 n degrees of freedom over 2
    # n. Its cube root is nearly normal.
    spread = 1 / (3 * np.sqrt(count))
    return (power ** (1 / 3) - (1 - spread**2)) / spread
