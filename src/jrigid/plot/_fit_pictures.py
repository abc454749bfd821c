"""A fit: record and model, residuals, and what the record determines of the ratios."""

from collections.abc import Callable, Mapping
from textwrap import wrap
from typing import Any

import numpy as np

from jrigid._checks import check_option, check_type
from jrigid.identify import FitResult
from jrigid.plot._drawing import LOOKS, TURN, Axes, label, looks, pyplot

_LAYOUT = [
    ["record"] * 3,
    ["residuals"] * 2 + ["histogram"],
    ["spectrum"] * 2 + ["ratios"],
]
_POINTS = 5000  # times at which a model is drawn, at most
_WAVES = 1000  # frequencies of a spectrum, at most
_BANDS = 40  # averages of a spectrum, at most
_EDGE = 5.0  # of a histogram: what is beyond is counted in its last bins
_LETTERS = 44  # of a line of text
_SURE = 1.96  # standard deviations: 95 %
# The chi-square of two numbers at 68 % and 95 %.
_SQUARE_68 = 2.2789
_SQUARE_95 = 5.9915


def fit(
    result: FitResult,
    axes: Mapping[str, Axes] | None = None,
    *,
    record: int = 0,
    trial: int = 0,
) -> dict[str, Axes]:
    """Draw a fit in five pictures: does the model agree, and are the residuals noise?

    - "record" shows what was read in one trial and the model, with crosses for samples
      that a robust fit left out.
    - "residuals" shows those of all trials, in units of the noise, against the time
      since each trial began. Where no noise was stated, their own size is the unit.
    - "spectrum" shows their power, which is 1 at all frequencies for white noise, with
      the range of 95 %.
    - "histogram" compares them with the normal distribution.
    - "ratios" shows I2/I1 and I3/I1 with ellipses of 68 % and 95 %, and the bounds of
      real bodies in grey: I3 = I1 + I2 dotted, I3 = I2 dashed, I2 = I1. Where errors
      are larger than the stated noise makes them, the ellipse of 95 % of that noise is
      drawn too: the Cramer-Rao bound. A text says what the record does not determine.

    Args:
        result: A single fit.
        axes: Matplotlib's axes by the names above, to draw only these; None: a new
            figure.
        record: Which record.
        trial: Which trial's record is drawn.

    Returns:
        The axes by their names; `axes["record"].figure.savefig("fit.png")`.

    Raises:
        ImportError: Without the extra `jrigid[plot]`.
        ValueError: No such picture, record or trial.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> result = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
    >>> axes = jr.plot.fit(result)
    >>> print(axes["ratios"].get_xlabel())
    I2/I1
    """
    check_type("result", result, FitResult)
    check_option("record", record, range(len(result.fitted()) - 1))
    check_option("trial", trial, range(len(result.t0)))
    if axes is None:
        figure: Any = pyplot().figure(figsize=(10, 8), layout="constrained")
        figure.suptitle(str(result).partition(":")[0])
        axes = dict(figure.subplot_mosaic(_LAYOUT))
    for name, ax in axes.items():
        check_option("axes", name, tuple(_PICTURES))
        _PICTURES[name](ax, result, record, trial)
    return dict(axes)


def _record(ax: Axes, result: FitResult, record: int, trial: int) -> None:
    """Draw the readings of a trial, and the model."""
    observations = result.observations(record)
    values = np.asarray(observations.values[trial])
    rows = np.any(np.isfinite(values), axis=1)
    values = values[rows]
    kept = np.asarray(observations.kept[trial])[rows]
    ts = np.asarray(observations.times[trial])[rows]
    if result.has_unmodelled_torque:
        times = ts
        model = _followed(result, record, trial, rows, values, kept)
    else:
        times = np.linspace(ts[0], ts[-1], max(min(20 * ts.size, _POINTS), ts.size))
        model = np.asarray(result.predict(times, record, trial))
    sensor = result.fitted(trial)[1 + record]
    if sensor.width == 4:
        values = _of_equal_sign(values, ts, model, times)
    names = {3: "xyz", 4: "wxyz"}.get(values.shape[1], "0123456789")
    columns = zip(names, values.T, model.T, strict=False)
    for (colour, marker), (name, column, line) in looks(columns):
        style: dict[str, Any] = {"color": colour, "ms": 3, "alpha": 0.6, "label": name}
        ax.plot(times, line, color=colour, lw=1)
        ax.plot(ts[kept], column[kept], marker, **style)
        ax.plot(ts[~kept], column[~kept], "x", color=colour, ms=5)
    kind = type(sensor).__name__
    count = len(result.t0)
    which = f", trial {trial} of {count}" if count > 1 else ""
    label(ax, f"{kind}{which}, and model", "time [s]", sensor.quantity)


def _of_equal_sign(
    values: np.ndarray, ts: np.ndarray, model: np.ndarray, times: np.ndarray
) -> np.ndarray:
    """Quaternions with the sign of the model's: q and -q are the same attitude."""
    near = np.stack([np.interp(ts, times, x) for x in model.T], axis=1)
    is_opposite = np.sum(near * values, axis=1, keepdims=True) < 0
    return np.where(is_opposite, -values, values)


def _followed(
    result: FitResult,
    record: int,
    trial: int,
    rows: np.ndarray,
    values: np.ndarray,
    kept: np.ndarray,
) -> np.ndarray:
    """The model at the samples, between which an unmodelled torque acts.

    It is NaN where the difference of two values, as of two attitudes, is not one that
    can be added.
    """
    model = np.full_like(values, np.nan)
    if result.fitted(trial)[1 + record].degrees is None:
        residuals = np.asarray(result.residuals(record))[trial, rows]
        # Residuals are predicted less observed.
        model[kept] = (values + residuals)[kept]
    return model


def _white(result: FitResult, record: int) -> tuple[np.ndarray, np.ndarray]:
    """Times since each trial began, and residuals over the noise (trials, n, k)."""
    observations = result.observations(record)
    since = np.asarray(observations.times - result.t0[:, None])
    return since, np.asarray(observations.residuals)


def _residuals(ax: Axes, result: FitResult, record: int, _: int) -> None:
    """Residuals against time."""
    since, residuals = _white(result, record)
    ax.axhspan(-_SURE, _SURE, color="0.9", label="95 % of noise")
    for (colour, marker), column in looks(np.moveaxis(residuals, -1, 0)):
        ax.plot(since.ravel(), column.ravel(), marker, color=colour, ms=3, alpha=0.5)
    label(ax, "Residuals", "time since the first sample [s]", "residual / noise")


def _spectrum(ax: Axes, result: FitResult, record: int, _: int) -> None:
    """Power of the residuals, averaged over bands of frequencies."""
    since, residuals = _white(result, record)
    length, step = _length_and_step(since, residuals)
    # Up to half the rate of sampling, beyond which frequencies repeat.
    last = max(int(0.5 * length / step) - 1, 1)
    waves = np.unique(np.round(np.geomspace(1, last, _WAVES)))
    power = _periodogram(since, residuals, waves, length)
    number = np.digitize(waves, np.geomspace(1, last + 1, _BANDS + 1))
    bands = [number == i for i in np.unique(number)]
    frequencies = [np.mean(waves[x]) / length for x in bands]
    columns = np.count_nonzero(np.any(np.isfinite(residuals), axis=1))
    low, high = _range_of_means(columns * np.array([np.sum(x) for x in bands]))
    ax.fill_between(frequencies, low, high, color="0.9", label="95 % of white noise")
    means = [np.mean(power[x]) for x in bands]
    ax.semilogy(frequencies, means, "o-", color=LOOKS[0][0], ms=3, lw=1)
    ax.axhline(1, color="0.5", lw=1)
    least, most = ax.get_ylim()
    ax.set_ylim(min(least, 0.09), max(most, 11.0))
    label(ax, "Spectrum", "frequency [Hz]", "power / that of the noise")


def _length_and_step(since: np.ndarray, residuals: np.ndarray) -> tuple[float, float]:
    """Median length of trials, and median time between samples [s]."""
    seen = np.any(np.isfinite(residuals), axis=2)
    trials = [t[x] for t, x in zip(since, seen, strict=True) if np.sum(x) > 2]
    length = float(np.median([t[-1] - t[0] for t in trials]))
    return length, float(np.median(np.concatenate([np.diff(t) for t in trials])))


def _periodogram(
    since: np.ndarray, residuals: np.ndarray, waves: np.ndarray, length: float
) -> np.ndarray:
    """Mean power of all columns and trials, `waves` to a length of time.

    Times need not be even. Source: A. Schuster, Terrestrial Magnetism 3 (1898) 13.
    """
    seen = np.isfinite(residuals)
    count = np.sum(seen, axis=1)
    rows = np.where(seen, residuals, 0.0)
    power = np.empty(waves.size)
    for i, k in enumerate(waves):
        turn = np.exp(-2j * np.pi * k / length * since)
        square = np.abs(np.einsum("tn,tnk->tk", turn, rows)) ** 2
        power[i] = np.mean(square[count > 0] / count[count > 0])
    return power


def _range_of_means(count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Range that holds 95 % of the means of so many powers of white noise.

    These are Wilson and Hilferty's quantiles of chi-square over its degrees of freedom,
    of which a power has two. Source: Proc. Natl. Acad. Sci. 17 (1931) 684.
    """
    spread = 1 / (9 * count)
    low = (1 - spread - _SURE * np.sqrt(spread)) ** 3
    high = (1 - spread + _SURE * np.sqrt(spread)) ** 3
    return low, high


def _histogram(ax: Axes, result: FitResult, record: int, _: int) -> None:
    """Residuals beside the normal distribution."""
    residuals = _white(result, record)[1]
    edges: Any = np.linspace(-_EDGE, _EDGE, 41)
    values = np.clip(residuals[np.isfinite(residuals)], -_EDGE, _EDGE)
    normal = np.exp(-(edges**2) / 2) / np.sqrt(2 * np.pi)
    ax.hist(values, edges, density=True, color=LOOKS[0][0], alpha=0.5)
    ax.plot(edges, normal, color="k", lw=1, label="normal")
    label(ax, "Histogram", "residual / noise", "density")


def _ratios(ax: Axes, result: FitResult, *_: int) -> None:
    """The ratios of the moments with their errors, among those of real bodies."""
    are_determined = not result.diagnostics.pure_spin and bool(
        np.all(result.ratios_errors < result.ratios)
    )
    colour, marker = LOOKS[0]
    ax.plot(*result.ratios, marker, color=colour)
    limits = (0.8, 3.0, 0.8, 4.0)
    if are_determined:
        _draw_ellipses(ax, result)
        limits = ax.axis()
    left, right, low, high = limits
    # The bounds of real bodies: I3 = I1 + I2, I3 = I2, I2 = I1.
    ax.axline((1, 2), slope=1, color="0.5", ls=":")
    ax.axline((1, 1), slope=1, color="0.5", ls="--")
    ax.axvline(1, color="0.5", lw=1)
    ax.axis((max(left, 0.8), right, max(low, 0.8), high))
    ax.ticklabel_format(useOffset=False)
    ax.locator_params(nbins=4)
    title = "Ratios" if are_determined else "Ratios: not determined"
    label(ax, title, "I2/I1", "I3/I1")
    text = ""
    if result.null_directions:
        text = "not determined: " + "; ".join(result.null_directions)
    box = {"facecolor": "w", "lw": 0, "pad": 1}
    text = "\n".join(wrap(text, _LETTERS))
    ax.text(0.02, 0.98, text, transform=ax.transAxes, va="top", bbox=box)


def _draw_ellipses(ax: Axes, result: FitResult) -> None:
    """Draw ellipses of 68 % and 95 %, and that of the stated noise if it is smaller."""
    colour, _ = LOOKS[0]
    ellipses = [("68 %", "-", colour, _SQUARE_68), ("95 %", "--", colour, _SQUARE_95)]
    inflation = float(result.diagnostics.inflation)
    if inflation > 1:
        # The covariance has the inflation as a factor. Division of the square of the
        # radius takes it out.
        ellipses.append(("bound", ":", "k", _SQUARE_95 / inflation))
    values, vectors = np.linalg.eigh(result.ratios_covariance)
    unit = vectors * np.sqrt(np.maximum(values, 0)) @ [np.cos(TURN), np.sin(TURN)]
    for name, style, ink, square in ellipses:
        line = np.asarray(result.ratios)[:, None] + np.sqrt(square) * unit
        ax.plot(*line, style, color=ink, label=name)


_Draw = Callable[[Axes, FitResult, int, int], None]  # record and trial
_PICTURES: dict[str, _Draw] = {
    "record": _record,
    "residuals": _residuals,
    "spectrum": _spectrum,
    "histogram": _histogram,
    "ratios": _ratios,
}
