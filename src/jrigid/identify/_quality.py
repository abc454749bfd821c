"""Quality of a fit: scales, outliers, misfits and boundaries.

Plain numpy, on the host.
"""

import dataclasses
from collections.abc import Callable
from functools import wraps
from typing import Any, NamedTuple, TypeVar

import numpy as np

from jrigid._numerics import or_one
from jrigid.identify._colour import loudest_band, stands_out
from jrigid.identify._disturbance import Disturbance
from jrigid.identify._filter import Linearised
from jrigid.identify._inertia_models import BOUNDARY, Fixed, Flat
from jrigid.identify._layout import Layout
from jrigid.identify._minimise import Minimum
from jrigid.identify._problem import Problem
from jrigid.identify._smoother import Rows

GATE = 5.0  # standard deviations of chi-square
FOLLOWED = 0.3  # of the square of the record: a fit that leaves more does not follow it
# Whitened square of a sample, above its degrees of freedom, that is no noise.
_REJECTED = 16.0
_ROUNDING = 100.0  # times the resolution of numbers
_MOST_REJECTED = 0.25  # fraction of samples rejected that excludes a trial
_AT_BOUNDARY = 1e-3  # how wrong a fit counts that ended at a boundary
_MAD = 1.4826  # standard deviations of a normal number in its median size


class Probe(NamedTuple):
    """The best fit with one direction held: a body that describes the record less well.

    Attributes:
        tensor: Of that body.
        distance: From the fit, in standard errors: the root of the growth of
            chi-square.
        error: Of the direction held, in natural units, as this probe shows it.
    """

    tensor: np.ndarray
    distance: float
    error: float


@dataclasses.dataclass(frozen=True)
class Fit:
    """A minimum and what was decided on the way to it.

    Attributes:
        problem: The record, with the frame of the inertia model in which it ended.
        minimum: Of one record.
        layout: Its segments.
        kept: 1 for each sample that took part, 0 for the others (trials, samples).
        scales: Sizes of the residuals of each record, in units of the noise.
        disturbance: The unmodelled torque.
        torque: The same as it was sought, None where it was known.
        history: Sums of squares after each step of all stages.
        ambiguous: Whether bodies far from this one describe the record nearly as well.
        probes: Bodies along the weakest direction, within six standard errors.
        thicker: Of a body that may be flat or a rod for all that is known, the rows of
            a thicker body, which show all errors. None for others.
        computed: Values of functions marked `once_for_each_fit`, by function.
    """

    problem: Problem
    minimum: Minimum
    layout: Layout
    kept: np.ndarray
    scales: np.ndarray
    disturbance: Disturbance
    torque: Any
    history: np.ndarray
    ambiguous: bool = False
    probes: tuple[Probe, ...] = ()
    thicker: "Fit | None" = None
    computed: dict[Any, Any] = dataclasses.field(default_factory=dict)

    @property
    def residual(self) -> np.ndarray:
        """Whitened residuals of the samples (trials, samples, degrees)."""
        return self.minimum.rows.residual[:, : self.kept.shape[1]]


_Value = TypeVar("_Value")


def once_for_each_fit(
    function: Callable[[Fit], _Value],
) -> Callable[[Fit], _Value]:
    """Keep the value of a function of the minimum with the fit.

    The search and the conclusion ask the same questions. The function must not depend
    on `ambiguous` and `probes`, which change after the value was computed.
    """

    @wraps(function)
    def call(fit: Fit) -> _Value:
        if function not in fit.computed:
            fit.computed[function] = function(fit)
        return fit.computed[function]

    return call


def linearised(fit: Fit) -> Linearised:
    """A record where a fit ended."""
    minimum = fit.minimum
    count = fit.kept.shape[1]
    return Linearised(
        fit.layout,
        minimum.tensor,
        Rows(*(x[:, :count] for x in minimum.rows)),
        minimum.links,
        minimum.weight[:, :count],
        minimum.point.own,
    )


def columns_of_prior(fit: Fit) -> np.ndarray:
    """Prior knowledge as columns of innovations.

    Returns:
        Columns (trials, known, degrees, columns): residual, state, border.
    """
    minimum = fit.minimum
    count = fit.kept.shape[1]
    local = minimum.links.gap.shape[-1]
    root = np.sqrt(minimum.weight[:, count:, None, None])
    residual = minimum.rows.residual[:, count:, :, None]
    of_state = np.zeros((*residual.shape[:-1], local), residual.dtype)
    columns = [residual, of_state, minimum.rows.of_border[:, count:]]
    return root * np.concatenate(columns, axis=-1)


def of_samples(problem: Problem, of_records: np.ndarray) -> np.ndarray:
    """Repeat a number of each record for each of its samples."""
    return np.repeat(of_records, [x.stop - x.start for x in problem.samples.parts])


def scales_of(problem: Problem, residual: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Size of each record's residuals over the noise, from their median.

    At least 1 where the noise is known.
    """
    counted = (kept[..., None] > 0) & (problem.samples.weight > 0)
    sizes = [np.abs(residual[:, x])[counted[:, x]] for x in problem.samples.parts]
    scales = np.array([_MAD * np.median(x) if x.size else 1.0 for x in sizes])
    scales = np.where(scales > 0, scales, 1.0).astype(residual.dtype)
    return np.maximum(scales, 1.0) if problem.options.noise_known else scales


def without_outliers(
    problem: Problem, residual: np.ndarray, kept: np.ndarray, scales: np.ndarray
) -> np.ndarray:
    """`kept` without outliers, and without trials that have many of them."""
    width = np.sum(problem.samples.weight, axis=-1)
    square = np.sum(residual**2, axis=-1)
    good = square / of_samples(problem, scales**2) < width + _REJECTED
    excluded = np.zeros(kept.shape[0], bool)
    for part in problem.samples.parts:  # a trial that one record excludes is excluded
        bad = np.sum(np.where(good, 0.0, kept)[:, part], axis=1)
        excluded |= bad > _MOST_REJECTED * np.sum(kept[:, part], axis=1)
    # A fit of nothing says nothing: if all trials are bad, each keeps what is good.
    excluded &= ~np.all(excluded)
    return np.where(good & ~excluded[:, None], kept, 0.0)


def weights_of(problem: Problem, kept: np.ndarray) -> np.ndarray:
    """1 for each number that is there, is kept and is not saturated, else 0."""
    # The residual of a saturated number is the root of a -2 log probability, whose
    # variance is not one.
    samples = problem.samples
    return np.where(samples.sign == 0, samples.weight, 0.0) * kept[..., None]


class Sums(NamedTuple):
    """Sums over the numbers that are seen, kept and not saturated.

    Attributes:
        count: How many there are.
        residual: Of the squares of their residuals.
        signal: Of the squares of `signal_of`.
    """

    count: float
    residual: float
    signal: float


@once_for_each_fit
def sums_of(fit: Fit) -> Sums:
    """Sums over the samples that a fit is judged by."""
    weight = weights_of(fit.problem, fit.kept)
    return Sums(
        count=float(np.sum(weight)),
        residual=float(np.sum(weight * fit.residual**2)),
        signal=float(np.sum(weight * signal_of(fit.problem, weight) ** 2)),
    )


@once_for_each_fit
def _square_of_rounding(fit: Fit) -> float:
    """Sum of squares that rounding of the values may leave."""
    problem = fit.problem
    weight = weights_of(problem, fit.kept)
    unit = np.diagonal(problem.samples.whitener, axis1=-2, axis2=-1)
    square = 0.0
    for part, values in zip(problem.samples.parts, problem.samples.values, strict=True):
        # Values that were not seen weigh nothing.
        size = np.sqrt(np.nansum(values**2, axis=-1, keepdims=True))
        square += float(np.sum(weight[:, part] * (unit[:, part] * size) ** 2))
    return float((_ROUNDING * np.finfo(unit.dtype).eps) ** 2 * square)


def is_exact(fit: Fit) -> bool:
    """Whether a fit leaves no more than rounding of a record without a stated noise.

    Its residuals then have neither a size nor a colour that would say anything.
    """
    # A stated noise says what is little. A plan, which leaves nothing, has one.
    if fit.problem.options.noise_known:
        return False
    return sums_of(fit).residual <= _square_of_rounding(fit)


@once_for_each_fit
def loudest_band_of(fit: Fit) -> tuple[float, float]:
    """`loudest_band` of the residuals, without those of saturated numbers."""
    white = np.sqrt(weights_of(fit.problem, fit.kept)) * fit.residual
    return loudest_band(white, fit.problem.samples.parts)


def misfit(fit: Fit) -> float:
    """0 for a fit that may be kept; else how wrong it is."""
    problem = fit.problem
    sums = sums_of(fit)
    numbers = fit.minimum.point.numbers.size
    # An approximate count: of a trial's own unknowns only its three rates.
    freedom = max(sums.count - numbers - 3.0 * fit.kept.shape[0], 1.0)
    ratio = sums.residual / freedom
    good = is_exact(fit) or (bool(fit.minimum.settled) and np.isfinite(ratio))
    if problem.options.noise_known and not problem.options.robust:
        good = good and ratio < 1 + GATE * np.sqrt(2 / freedom)
        if good and not problem.options.dense:
            good = not stands_out(*loudest_band_of(fit))
    if good:
        # So small a number that a good fit inside replaces this one, but no misfit
        # does.
        return _AT_BOUNDARY if is_at_boundary(fit) else 0.0
    return ratio if np.isfinite(ratio) else np.finfo(float).max


def signal_of(problem: Problem, weight: np.ndarray) -> np.ndarray:
    """Signal that a fit should explain, in units of the noise.

    It is a radian for attitudes and directions, and the variation of values for others.
    """
    white = np.diagonal(problem.samples.whitener, axis1=-2, axis2=-1)
    sensors = problem.unknowns.original(0)[1:]
    samples = problem.samples
    signals = []
    for sensor, part, values in zip(
        sensors, samples.parts, samples.values, strict=True
    ):
        w = weight[:, part]
        unit = white[:, part]
        # Attitudes and directions have more values than degrees of freedom.
        if sensor.degrees not in (None, values.shape[-1]):
            signals.append(unit)
            continue
        values = np.pad(values, ((0, 0), (0, 0), (0, w.shape[-1] - values.shape[-1])))
        total = np.sum(w * unit**2, axis=1, keepdims=True)
        mean = np.sum(w * unit**2 * values, axis=1, keepdims=True)
        signals.append(unit * (values - mean / or_one(total)))
    return np.concatenate(signals, axis=1)


def unexplained(fit: Fit, kicks: float = 0.0) -> float:
    """Fraction of the square of the record that the fit does not explain.

    It counts what is beyond the noise if that is known.
    """
    sums = sums_of(fit)
    excess = sums.residual + kicks
    if fit.problem.options.noise_known:
        excess = excess - sums.count
    return excess / (sums.signal if sums.signal > 0 else 1.0)


@once_for_each_fit
def is_at_boundary(fit: Fit) -> bool:
    """Whether all mass lies in a plane or on a line, though it need not."""
    if isinstance(fit.problem.unknowns.inertia_model, Fixed | Flat):
        return False
    tensor = np.asarray(fit.minimum.tensor, float)
    if not np.all(np.isfinite(tensor)):
        return False
    # The second moments of mass, of trace one, are 1 - 2 I / trace(I). The least one
    # belongs to the largest moment.
    shares = np.linalg.eigvalsh(tensor) / np.trace(tensor)
    return bool(1 - 2 * shares[-1] < BOUNDARY)


def is_pure(fit: Fit, noise: float) -> bool:
    """Whether a constant rate in each trial describes a gyro's record as well.

    Where the rates do not vary the Fisher information at the estimate is no guide: a
    motion fitted to the noise seems to determine what the true one does not. The best
    of many wobbles gains something from any noise, the more the longer the record.
    """
    if not _may_be_pure(fit):
        return False
    sums = sums_of(fit)
    # Five numbers gain chi-square of five degrees of freedom from noise: its mean is 5
    # and its standard deviation sqrt(10).
    chance = 5 + GATE * 10**0.5 + 4 * np.log(max(sums.count, 1.0))
    if is_exact(fit):
        # The noise is that of rounding.
        return sums.signal <= _square_of_rounding(fit)
    return bool(sums.signal - sums.residual <= noise * chance)


@once_for_each_fit
def _may_be_pure(fit: Fit) -> bool:
    """Whether the inertia is sought from sensors whose values are rates."""
    sensors = fit.problem.unknowns.original(0)[1:]
    return bool(fit.problem.unknowns.inertia_model.names) and not any(
        x.depends_on_attitude or x.width != 3 for x in sensors
    )
