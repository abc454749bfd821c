"""A fit: record and model, what is left, and what the record tells of the ratios."""

from collections.abc import Mapping
from textwrap import wrap
from typing import Any

import numpy as np

from jrigid._checks import check_option, check_type
from jrigid.identify import FitResult
from jrigid.plot._common import LOOKS, TURN, label, looks, pyplot

_LAYOUT = [
    ["record"] * 3,
    ["residuals"] * 2 + ["histogram"],
    ["spectrum"] * 2 + ["ratios"],
]
_SHOWN = {
    "Gyro": "rate [rad/s]",
    "Accelerometer": "specific force [m/s$^2$]",
    "AttitudeSensor": "attitude, quaternion",
    "DirectionSensor": "direction, unit vector",
    "MomentumSensor": "angular momentum [kg m$^2$/s]",
}
_MOST = 5000  # times at which a model is drawn
_WAVES, _BANDS = 1000, 40  # of a spectrum, at most
_EDGE = 5.0  # of a histogram: what is beyond is counted in its last bins
_WORDS = 44  # letters of a line of text
_SURE = 1.96  # standard deviations: 95 %


def fit(
    result: FitResult,
    axes: Mapping[str, Any] | None = None,
    *,
    record: int = 0,
    trial: int = 0,
) -> dict[str, Any]:
    """A fit in five pictures: do model and record agree, and is what is left noise?

    "record": what was read in one trial and the model, crosses for what a robust fit
    left out. "residuals": what is left, in units of the noise, of all trials, against
    the time since each began; of a noise that was not stated, in units of their own
    size. "spectrum": their power, 1 at all frequencies for white noise, with the range
    of 95 %. "histogram": against the normal distribution. "ratios": I2/I1 and I3/I1
    with ellipses of 68 % and 95 %, and the bounds of real bodies in grey: I3 = I1 + I2
    dotted, I3 = I2 dashed, I2 = I1. Where errors are larger than the noise stated makes
    them, also the ellipse of 95 % of that noise, Cramer's and Rao's bound. What the
    record does not tell is written there.

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
        ValueError: No such picture, record or throw.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> found = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
    >>> axes = jr.plot.fit(found)
    >>> print(axes["ratios"].get_xlabel())
    I2/I1
    """
    check_type("result", result, FitResult)
    check_option("record", record, range(len(result.problem.samples.parts)))
    check_option("trial", trial, range(len(result.t0)))
    if axes is None:
        figure: Any = pyplot().figure(figsize=(10, 8), layout="constrained")
        figure.suptitle(str(result).partition(":")[0])
        axes = dict(figure.subplot_mosaic(_LAYOUT))
    draw = {
        "record": _record,
        "residuals": _residuals,
        "spectrum": _spectrum,
        "histogram": _histogram,
        "ratios": _ratios,
    }
    for name, ax in axes.items():
        check_option("axes", name, tuple(draw))
        draw[name](ax, result, record, trial)
    return dict(axes)


def _record(ax: Any, result: FitResult, record: int, trial: int) -> None:
    samples, sensor = result.problem.samples, result.fitted(trial)[1 + record]
    part, values = samples.parts[record], np.asarray(samples.values[record][trial])
    seen, kept = (np.asarray(x[trial, part]) for x in (samples.weight > 0, result.kept))
    alone = (
        sensor.degrees is None
    )  # a number may be missing without the others of its sample
    seen = seen[:, : values.shape[1]] if alone else np.max(seen, axis=1, keepdims=True)
    rows = np.max(seen, axis=1)
    values, kept = np.where(seen, values, np.nan)[rows], kept[rows]
    ts = times = np.asarray(samples.ts[trial, part])[rows]
    model = np.full_like(values, np.nan)
    if not result.problem.options.dense:
        times = np.linspace(ts[0], ts[-1], max(min(20 * ts.size, _MOST), ts.size))
        model = np.asarray(result.predict(times, record, trial))
    elif alone:  # kicked from sample to sample
        model[kept] = (values + np.asarray(result.residuals(record))[trial, rows])[kept]
    if sensor.width == 4:  # q and -q are the same attitude
        near = np.stack([np.interp(ts, times, x) for x in model.T], axis=1)
        values = np.where(
            np.sum(near * values, axis=1, keepdims=True) < 0, -values, values
        )
    names = {3: "xyz", 4: "wxyz"}.get(values.shape[1], "0123456789")
    columns = zip(names, values.T, model.T, strict=False)
    for (colour, marker), (name, column, line) in looks(columns):
        ax.plot(times, line, color=colour, lw=1)
        ax.plot(
            ts[kept], column[kept], marker, color=colour, ms=3, alpha=0.6, label=name
        )
        ax.plot(ts[~kept], column[~kept], "x", color=colour, ms=5)
    kind = type(sensor).__name__
    trials = f", trial {trial} of {len(samples.ts)}" if len(samples.ts) > 1 else ""
    label(ax, f"{kind}{trials}, and model", "time [s]", _SHOWN.get(kind, "value"))


def _left(result: FitResult, record: int) -> tuple[np.ndarray, np.ndarray]:
    """Times since each trial began, and residuals (trials, n, k), NaN where there is none."""
    samples, sensor = result.problem.samples, result.fitted()[1 + record]
    part, width = (
        samples.parts[record],
        sensor.degrees or samples.values[record].shape[-1],
    )
    known = result.problem.options.noise_known
    size = 1.0 if known else np.sqrt(float(result.reduced_chi_square))
    left = np.asarray(result.diagnostics.residuals[:, part, :width]) / size
    return np.asarray(samples.ts[:, part] - result.t0[:, None]), np.where(
        left == 0, np.nan, left
    )


def _residuals(ax: Any, result: FitResult, record: int, _: int) -> None:
    since, left = _left(result, record)
    ax.axhspan(-_SURE, _SURE, color="0.9", label="95 % of noise")
    for (colour, marker), column in looks(np.moveaxis(left, -1, 0)):
        ax.plot(since.ravel(), column.ravel(), marker, color=colour, ms=3, alpha=0.5)
    label(ax, "Residuals", "time since the first sample [s]", "residual / noise")


def _spectrum(ax: Any, result: FitResult, record: int, _: int) -> None:
    """Of times that need not be even: Schuster's periodogram, averaged over bands."""
    since, left = _left(result, record)
    seen = np.isfinite(left)
    number, rows = np.sum(seen, axis=1), np.where(seen, left, 0.0)
    trials = [
        t[x] for t, x in zip(since, np.max(seen, axis=2), strict=True) if np.sum(x) > 2
    ]
    length = float(np.median([t[-1] - t[0] for t in trials]))
    step = float(np.median(np.concatenate([np.diff(t) for t in trials])))
    last = max(int(0.5 * length / step) - 1, 1)
    waves = np.unique(np.round(np.geomspace(1, last, _WAVES)))
    power = np.empty(waves.size)
    for i, k in enumerate(waves):
        turn = np.exp(-2j * np.pi * k / length * since)
        square = np.abs(np.einsum("tn,tnk->tk", turn, rows)) ** 2
        power[i] = np.mean(square[number > 0] / number[number > 0])
    band = np.digitize(waves, np.geomspace(1, last + 1, _BANDS + 1))
    bands = [band == i for i in np.unique(band)]
    frequencies = [np.mean(waves[x]) / length for x in bands]
    # Wilson and Hilferty's quantiles of chi-square over its degrees of freedom
    spread = 1 / (9 * np.count_nonzero(number) * np.array([np.sum(x) for x in bands]))
    low, high = ((1 - spread + side * np.sqrt(spread)) ** 3 for side in (-_SURE, _SURE))
    ax.fill_between(frequencies, low, high, color="0.9", label="95 % of white noise")
    ax.semilogy(
        frequencies,
        [np.mean(power[x]) for x in bands],
        "o-",
        color="#0072B2",
        ms=3,
        lw=1,
    )
    ax.axhline(1, color="0.5", lw=1)
    least, most = ax.get_ylim()
    ax.set_ylim(min(least, 0.09), max(most, 11.0))
    label(ax, "Spectrum", "frequency [Hz]", "power / that of the noise")


def _histogram(ax: Any, result: FitResult, record: int, _: int) -> None:
    left, edges = _left(result, record)[1], np.linspace(-_EDGE, _EDGE, 41)
    values = np.clip(left[np.isfinite(left)], -_EDGE, _EDGE)
    ax.hist(values, edges, density=True, color=LOOKS[0][0], alpha=0.5)
    ax.plot(
        edges,
        np.exp(-(edges**2) / 2) / np.sqrt(2 * np.pi),
        color="k",
        lw=1,
        label="normal",
    )
    label(ax, "Histogram", "residual / noise", "density")


def _ratios(ax: Any, result: FitResult, *_: int) -> None:
    told = not result.diagnostics.pure_spin and bool(
        np.all(result.ratios_errors < result.ratios)
    )
    colour, marker = LOOKS[0]
    # the chi-square of two numbers at 68 % and 95 %
    drawn = told * [("68 %", "-", colour, 2.2789), ("95 %", "--", colour, 5.9915)]
    if told and result.diagnostics.inflation > 1:
        drawn.append(("bound", ":", "k", 5.9915 / float(result.diagnostics.inflation)))
    values, vectors = np.linalg.eigh(result.ratios_covariance)
    ellipse = vectors * np.sqrt(np.maximum(values, 0)) @ [np.cos(TURN), np.sin(TURN)]
    ax.plot(*result.ratios, marker, color=colour)
    for name, style, ink, square in drawn:
        line = np.asarray(result.ratios)[:, None] + np.sqrt(square) * ellipse
        ax.plot(*line, style, color=ink, label=name)
    left, right, low, high = ax.axis() if told else (0.8, 3.0, 0.8, 4.0)
    ax.axline((1, 2), slope=1, color="0.5", ls=":")
    ax.axline((1, 1), slope=1, color="0.5", ls="--")
    ax.axvline(1, color="0.5", lw=1)
    ax.axis((max(left, 0.8), right, max(low, 0.8), high))
    ax.ticklabel_format(useOffset=False)
    ax.locator_params(nbins=4)
    label(ax, "Ratios" if told else "Ratios: not determined", "I2/I1", "I3/I1")
    untold = "\n".join(wrap("not told: " + "; ".join(result.null_directions), _WORDS))
    style = {
        "transform": ax.transAxes,
        "va": "top",
        "bbox": {"facecolor": "w", "lw": 0, "pad": 1},
    }
    ax.text(0.02, 0.98, untold * bool(result.null_directions), **style)
