"""Errors of a fit, directions that the record leaves open, and status of the fit.

Plain numpy, on the host: small matrices, once for each fit.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax.tree_util as jtu
import numpy as np

from jrigid._checks import RESULTS, is_good
from jrigid.dynamics import State
from jrigid.identify import _colour as colour
from jrigid.identify import _conventions as conventions
from jrigid.identify import _quality as quality
from jrigid.identify._gyro_errors import GyroErrors, gyro_errors
from jrigid.identify._independent import (
    Independent,
    condensed_rows,
    independent_rows,
)
from jrigid.identify._minimise import spectrum, tensors_at
from jrigid.identify._precision import (
    SHOWN,
    Precision,
    least_value,
    precision,
    precision_of,
    turns_of,
    without_states,
)
from jrigid.identify._problem import Problem
from jrigid.identify._quality import Fit
from jrigid.identify._records import Samples
from jrigid.identify._resolution import UNRESOLVED, integration_error
from jrigid.identify._result import (
    LARGEST_ERROR,
    Status,
    errors_of,
    of_moments,
    sigma_points,
    spread_of,
)
from jrigid.identify._smoother import Rows
from jrigid.identify._torque_errors import added_by_torque, fields_of_torque

_OPEN = 10.0  # an error of a number of which nothing is known
HISTORY = 512  # steps whose sums of squares are returned
# Names of the fields of `derive` that state errors end so.
_OF_ERRORS = ("_covariance", "_errors")
_FEWEST = 8  # trials whose scatter says how large errors are
# Scatter of trials over the errors stated, above which something is missing.
_DISAGREEING = 3.0


class Weakest(NamedTuple):
    """Chi-square, its unit, and what the record determines least of the inertia.

    Attributes:
        square: Chi-square.
        noise: Its unit: the variance of a residual.
        error: Of the combination of the inertia's numbers with the largest error,
            natural units.
        normal: That combination: its product with a change of all numbers is the change
            of it.
        direction: The change of all numbers, others following, that changes it by one.
    """

    square: float
    noise: float
    error: float
    normal: np.ndarray
    direction: np.ndarray


def weakest(fit: Fit) -> Weakest:
    """The direction in the numbers that the record determines least."""
    minimum = fit.minimum
    units = minimum.units
    square = float(minimum.square + minimum.kicks)
    noise = 1.0
    if not fit.problem.options.noise_known:
        trials, _, local = minimum.links.gap.shape
        count = quality.sums_of(fit).count
        # A noise that is not known has the variance of the residuals.
        noise = square / max(count - units.size - local * trials, 1.0)
    covariance = precision(fit).covariance
    error, normal, direction = weakest_of(
        fit.problem.unknowns.judged, covariance, units
    )
    return Weakest(square, noise, np.sqrt(noise) * error, normal, direction)


def weakest_of(
    part: slice, covariance: np.ndarray, units: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Error, normal and direction of `Weakest`, from a covariance of the numbers.

    Args:
        part: Where the numbers are by which a fit is judged.
        covariance: Of all numbers.
        units: Natural units of the numbers.
    """
    normal = np.zeros_like(units)
    direction = np.zeros_like(units)
    inside = covariance[part, part] / (units[part, None] * units[part])
    if not units.size or not np.all(np.isfinite(inside)):
        return 0.0 if not units.size else np.inf, normal, direction
    values, axes = np.linalg.eigh(inside)
    normal[part] = axes[:, -1] / units[part]
    # Others follow as far as they are known to, and no farther than a start need be.
    change = covariance @ normal / max(values[-1], np.finfo(units.dtype).tiny)
    direction = np.clip(change, -units, units)
    direction[part] = axes[:, -1] * units[part]
    return float(np.sqrt(max(values[-1], 0.0))), normal, direction


def derive(
    problem: Problem,
    numbers: np.ndarray,
    covariance: np.ndarray,
    probes: Sequence[quality.Probe],
) -> dict[str, np.ndarray]:
    """Moments, axes and ratios, with errors, from the numbers and their covariance.

    Args:
        problem: The record.
        numbers: The estimate.
        covariance: Of the numbers.
        probes: Bodies along the weakest direction.
    """
    # Linear propagation is enough for the elements, which are smooth in the numbers.
    # Sorted moments are not: they have kinks where two are equal.
    tensor, moments, axes, slopes = map(np.asarray, spectrum(problem.unknowns, numbers))
    elements = slopes.reshape(9, numbers.size)
    spread = _spread_of_moments(problem, numbers, covariance)
    spread = _at_least_probed(spread, moments, probes)
    return {
        "inertia": tensor,
        "inertia_covariance": elements @ covariance @ elements.T,
        "moments": moments,
        "axes": axes,
        "ratios": moments[1:] / moments[:1],
        "shares": moments / np.sum(moments),
        "moments_covariance": spread[:3, :3],
        "ratios_covariance": spread[3:5, 3:5],
        "shares_covariance": spread[5:, 5:],
        "axes_errors": _errors_of_axes(moments, axes, slopes, covariance),
    }


def _errors_of_axes(
    moments: np.ndarray, axes: np.ndarray, slopes: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Errors of the turn about each principal axis [rad], huge where moments coincide.

    A change dI of the tensor turns two axes j and k about the third by
    j . dI k / (I_k - I_j).
    """
    gaps = np.roll(moments, -1) - np.roll(moments, 1)
    floor = np.finfo(gaps.dtype).eps * moments[2]
    # Equal moments would give errors that are not finite.
    gaps = np.where(np.abs(gaps) > floor, gaps, floor)
    following = np.roll(axes, -1, axis=1)
    preceding = np.roll(axes, 1, axis=1)
    turns = np.einsum("ki,kln,li->in", following, slopes, preceding) / gaps[:, None]
    square = np.sum((turns @ covariance) * turns, axis=1)
    return np.sqrt(np.maximum(square, 0.0))


def _spread_of_moments(
    problem: Problem, numbers: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Covariance of moments, ratios and shares: as `FitResult.spread`."""
    size = problem.unknowns.of_inertia.stop
    unknown = np.full((8, 8), np.nan, numbers.dtype)
    # A tensor without unknown numbers is known exactly.
    if not size:
        return np.zeros_like(unknown)
    if not np.all(np.isfinite(covariance[:size, :size])):
        return unknown
    covariance = _without_turns(problem, numbers, covariance[:size, :size])
    points, scales = sigma_points(numbers, covariance, size)
    tensors = np.asarray(tensors_at(problem.unknowns, points))
    if not np.all(np.isfinite(tensors)):
        return unknown
    return spread_of(of_moments(np.linalg.eigvalsh(tensors)), scales)


def _without_turns(
    problem: Problem, numbers: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """The covariance without turns of the body of which nothing is known.

    They change no moment, but a step along them by numbers does.
    """
    values, directions = np.linalg.eigh(covariance)
    is_open = values > _OPEN**2
    if not np.any(is_open):
        return covariance
    is_turn = turns_of(problem.unknowns, numbers)
    others = np.zeros(numbers.size - len(values), numbers.dtype)
    for value, direction in zip(values[is_open], directions.T[is_open], strict=True):
        if is_turn(np.concatenate([direction, others])):
            covariance = covariance - value * np.outer(direction, direction)
    return covariance


def _at_least_probed(
    spread: np.ndarray, moments: np.ndarray, probes: Sequence[quality.Probe]
) -> np.ndarray:
    """The covariance with errors as large as probes show them.

    In a valley that bends, a ratio may rest at the estimate and move far beyond it. Its
    derivative, and the covariance, know nothing of that. A probe is a body
    some standard errors away, so that no moment or ratio may be off by more of its own.
    """
    estimate = of_moments(moments)
    errors = errors_of(spread)
    factors = np.ones_like(errors)
    for probe in probes:
        move = np.abs(of_moments(np.linalg.eigvalsh(probe.tensor)) - estimate)
        error = move / probe.distance
        # What is known exactly has no error, and no probe moves it beyond rounding.
        ratio = error / np.where(errors > 0, errors, np.inf)
        factors = np.fmax(factors, ratio)
    return factors[:, None] * spread * factors


@np.errstate(all="ignore")  # what is not finite is judged below
def conclude(
    fit: Fit,
    lengths: Sequence[int],
    input_result: Any = RESULTS.successful,
) -> dict[str, Any]:
    """The fields of a `FitResult`, in numpy, from a fit at its minimum.

    Args:
        fit: The minimum.
        lengths: How many samples of each record to return.
        input_result: What is wrong with the input.
    """
    independent = independent_rows(fit)
    known = precision(fit)
    judgement = _judgement(fit, known, _white(fit, independent))
    numbers = fit.minimum.point.numbers
    derived = derive(fit.problem, numbers, judgement.covariance, fit.probes)
    if fit.thicker is not None:
        derived |= _errors_if_thicker(
            fit.thicker, judgement.remainder.inflation, derived
        )
    of_torque = fields_of_torque(fit, judgement.remainder.inflation)
    fields = derived | of_torque
    fields |= _fields_of_judgement(judgement)
    fields |= _fields_of_precision(fit, known, judgement)
    fields |= _fields_of_record(fit, lengths)
    fields["log_determinant"] = np.asarray(independent.log_determinant)
    good = is_good(input_result)
    error = 0.0
    if good:
        error = integration_error(fit.problem, fit.layout, fit.minimum.point)
    fields["integration_error"] = np.asarray(error)
    fields["conventions"] = np.zeros(conventions.COUNT, bool)
    fields = _of_dtype(fields, good, fit.minimum.units.dtype)
    status = _status(judgement.status, good, error, derived, of_torque)
    return fields | {"status": getattr(Status, status), "input_result": input_result}


def _errors_if_thicker(
    thicker: Fit, inflation: float, thin: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Errors of what is derived from the tensor, by the rows of a thicker body.

    Args:
        thicker: Those rows.
        inflation: Of the variances.
        thin: The same errors by the rows of the estimate. Its ratios may be huge, and
            so are their errors.
    """
    known = precision(thicker)
    covariance = _inflated(thicker, known, np.ones_like(known.values), inflation)
    derived = derive(thicker.problem, thicker.minimum.point.numbers, covariance, ())
    if np.trace(thin["ratios_covariance"]) > np.trace(derived["ratios_covariance"]):
        derived["ratios_covariance"] = thin["ratios_covariance"]
    return {name: x for name, x in derived.items() if name.endswith(_OF_ERRORS)}


def _white(fit: Fit, independent: Independent) -> np.ndarray:
    """Whitened residuals or innovations of the samples (trials, samples, degrees)."""
    # Weights of innovations are ones.
    white = np.sqrt(independent.weight)[..., None] * independent.rows.residual
    return white[:, : fit.kept.shape[1]]


def _status(
    status: str,
    good_input: bool,
    error: float,
    derived: dict[str, np.ndarray],
    of_torque: dict[str, np.ndarray],
) -> str:
    """The name of the status, after a look at what else may be wrong.

    Args:
        status: By the residuals.
        good_input: Whether the record could be used.
        error: Of the integration, in units of what is allowed.
        derived: Fields of the tensor.
        of_torque: Fields of the unmodelled torque.
    """
    errors = errors_of(derived["ratios_covariance"])
    # If I1 is nearly zero the ratios can be loose though each number is determined.
    loose = np.any(errors > LARGEST_ERROR * derived["ratios"])
    levels_known = np.isfinite([of_torque["level"], of_torque["level_errors"]])
    if not np.all(levels_known) or error > UNRESOLVED:
        return "NOT_CONVERGED"
    if not good_input:
        return "BAD_INPUT"
    if loose and status in ("OK", "AT_BOUNDARY"):
        return "UNIDENTIFIABLE"
    return status


def _fields_of_precision(
    fit: Fit, known: Precision, judgement: "_Judgement"
) -> dict[str, np.ndarray]:
    """Fields that say what determines the numbers and the states."""
    minimum = fit.minimum
    # Without an unmodelled torque all errors are those of the sensors.
    sensors = known
    if fit.problem.options.dense:
        # What the sensors alone would determine, without an unmodelled torque.
        of_sensors = without_states(fit, condensed_rows(fit), minimum.weight)
        sensors = precision_of(of_sensors, minimum.units)
    inflation = judgement.remainder.inflation
    return {
        "singular_values": known.values,
        "directions": known.directions,
        "scores": known.scores,
        "sensitivity": known.sensitivity,
        "local_covariance": inflation * known.local,
        "sensor_covariance": inflation * sensors.covariance,
        "state_singular_values": sensors.of_state,
    }


def _fields_of_record(fit: Fit, lengths: Sequence[int]) -> dict[str, Any]:
    """Fields that hold the estimates, the residuals and the record as it was given."""
    problem = fit.problem
    minimum = fit.minimum
    point = minimum.point
    parts = problem.samples.parts
    rows = condensed_rows(fit)
    residuals, jacobian = _weighted(fit, rows, point.own.shape[-1])
    history = np.full(HISTORY, np.nan)
    history[: fit.history.size] = fit.history[:HISTORY]
    return {
        "numbers": point.numbers,
        "own_numbers": point.own,
        "state": State(point.attitude[:, 0], point.omega[:, 0]),
        "t0": fit.layout.start[:, 0],
        "residuals": _resized(residuals, parts, lengths),
        "jacobian": _resized(jacobian, parts, lengths),
        "scales": fit.scales,
        "kept": _resized(fit.kept, parts, lengths) > 0,
        "history": history,
        "ambiguous": np.asarray(fit.ambiguous),
        "torque_numbers": np.asarray(0 if fit.torque is None else fit.torque.size),
        "problem": dataclasses.replace(
            problem,
            # This is a static field. Other counts of nodes would give results of other
            # structures, for which `predict` compiles anew.
            options=problem.options._replace(nodes=1),
            samples=_of_lengths(problem.samples, lengths),
        ),
    }


def _weighted(fit: Fit, rows: Rows, own: int) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of the samples, with derivatives in the numbers and the first state."""
    count = fit.kept.shape[1]
    root = np.sqrt(fit.minimum.weight)[:, :count, None]
    jacobian = np.concatenate([rows.of_border[..., own:], rows.of_state], axis=-1)
    return root * rows.residual[:, :count], root[..., None] * jacobian[:, :count]


def _of_dtype(fields: dict[str, Any], good: bool, dtype: Any) -> dict[str, Any]:
    """Fields of one floating point type; NaN of a record that cannot be used."""

    def array(x: Any) -> np.ndarray:
        x = np.asarray(x)
        if x.dtype.kind != "f":
            return x
        return x.astype(dtype) if good else np.full(x.shape, np.nan, dtype)

    return jtu.tree_map(array, fields)


def _resized(
    x: np.ndarray,
    parts: Sequence[slice],
    lengths: Sequence[int],
    mode: Literal["constant", "edge"] = "constant",
) -> np.ndarray:
    """Samples of each record, cut to these lengths, or filled with zeros.

    Args:
        x: Records side by side (trials, samples, ...).
        parts: Where each record's samples are.
        lengths: How many samples of each record to return.
        mode: Of `numpy.pad`.
    """
    resized = []
    for part, n in zip(parts, lengths, strict=True):
        # `part` includes the samples that fill the record up, and a result has none of
        # them.
        own = x[:, part][:, :n]
        if own.shape[1] < n:
            missing = [(0, 0), (0, n - own.shape[1])] + [(0, 0)] * (x.ndim - 2)
            own = np.pad(own, missing, mode)
        resized.append(own)
    return np.concatenate(resized, axis=1)


def _of_lengths(samples: Samples, lengths: Sequence[int]) -> Samples:
    """The samples without those that fill a record up to a rounded number."""
    parts = samples.parts
    values = [
        _resized(x, [slice(None)], [n], "edge")
        for x, n in zip(samples.values, lengths, strict=True)
    ]
    return Samples(
        ts=_resized(samples.ts, parts, lengths, "edge"),
        values=tuple(values),
        whitener=_resized(samples.whitener, parts, lengths),
        weight=_resized(samples.weight, parts, lengths),
        sign=_resized(samples.sign, parts, lengths),
    )


def _with_error(
    part: slice, covariance: np.ndarray, units: np.ndarray, error: float
) -> np.ndarray:
    """The covariance with an error of the weakest direction of at least this size.

    The error is in natural units.
    """
    before, _, direction = weakest_of(part, covariance, units)
    return covariance + max(error**2 - before**2, 0.0) * np.outer(direction, direction)


def _with_larger_errors(
    known: Precision, factors: np.ndarray, units: np.ndarray
) -> np.ndarray:
    """The covariance with errors so many times larger along each direction."""
    values = np.maximum(known.values, least_value(units.dtype))
    directions = known.directions * units[:, None] / values
    # Variances add: a variance of f^2 is the old one and f^2 - 1 more of it.
    more = directions * np.sqrt(factors**2 - 1)
    return known.covariance + more @ more.T


def _scatter_of_trials(
    known: Precision, alive: np.ndarray, units: np.ndarray, inflation: float
) -> np.ndarray:
    """Errors by the scatter of trials over those stated, along each direction.

    Those stated are the inflated ones. Ones where there are few trials.
    """
    trials = np.sum(alive)
    if trials < _FEWEST or not np.all(np.isfinite(known.scores)):
        return np.ones(units.size)
    # The variance of a score along a direction is the square of its value. If trials
    # scatter by their noise alone, the squares of these sum to about one.
    values = np.maximum(known.values, least_value(units.dtype))
    along = (known.scores[alive] * units) @ known.directions / values
    # At the minimum the scores sum to zero, which takes one degree of freedom.
    return np.sqrt(np.sum(along**2, axis=0) * trials / (trials - 1) / inflation)


def _whiteness(rows: np.ndarray, parts: Sequence[slice]) -> tuple[float, float]:
    """Correlation of neighbours, and how many standard deviations that is from 0."""
    left = np.concatenate([rows[:, x.start : x.stop - 1] for x in parts], axis=1)
    right = np.concatenate([rows[:, x.start + 1 : x.stop] for x in parts], axis=1)
    # Residuals of samples that were not observed are zero.
    both = (left != 0) & (right != 0)
    square = np.sum(both * (left**2 + right**2) / 2)
    like = np.sum(left * right) / max(square, np.finfo(rows.dtype).tiny)
    # The correlation of n white residuals scatters by 1 / sqrt(n).
    return float(like), float(np.abs(like) * np.sqrt(np.sum(both)))


def _kicks(fit: Fit) -> float:
    """Sum of squares of what an unmodelled torque did; 0 where there is none."""
    return float(fit.minimum.kicks) if fit.problem.options.dense else 0.0


class _Remainder(NamedTuple):
    """Part of a record that its fit does not explain.

    Attributes:
        chi_square: Sum of squares, of what is known beforehand and of an unmodelled
            torque too.
        freedom: Its degrees of freedom.
        noise: The one over the other.
        band: Power in the band that stands out most, and its standard deviations.
        misfit: Whether it is more than noise, or in a band of frequencies.
        overstated: Whether it is less than noise.
        inflation: Of covariances.
    """

    chi_square: float
    freedom: float
    noise: float
    band: tuple[float, float]
    misfit: bool
    overstated: bool
    inflation: float


def _remainder(fit: Fit, known: Precision, white: np.ndarray) -> _Remainder:
    """Compare chi-square, and the loudest band, with those of noise."""
    chi_square, freedom = _chi_square(fit, known)
    noise = chi_square / max(freedom, 1.0)
    band = _band(fit, white)
    coloured = colour.stands_out(*band)
    more = less = False
    if fit.problem.options.noise_known:
        # Over n degrees of freedom the mean square of white noise scatters by
        # sqrt(2/n).
        gate = quality.GATE * np.sqrt(2 / max(freedom, 1.0))
        more = noise > 1 + gate or np.max(fit.scales) > 2
        less = 0 < noise < 1 - gate  # a plan has no residuals
    inflation = 1.0
    if not fit.problem.options.noise_known:
        inflation = noise
    elif more:
        inflation = max(noise, 1.0)
    if coloured and not quality.is_exact(fit):
        # A band that stands out may be the one that tells the numbers.
        inflation = inflation * band[0]
    return _Remainder(
        chi_square=chi_square,
        freedom=freedom,
        noise=noise,
        band=band,
        misfit=bool(more or coloured) and not quality.is_exact(fit),
        overstated=bool(less),
        inflation=inflation,
    )


def _chi_square(fit: Fit, known: Precision) -> tuple[float, float]:
    """Chi-square and its degrees of freedom."""
    sums = quality.sums_of(fit)
    rows = fit.minimum.rows.residual
    # The last rows only hold a fit near its start.
    prior = rows[:, fit.kept.shape[1] : rows.shape[1] - fit.problem.held]
    takes_part = np.any(fit.kept > 0, axis=1)[:, None]
    # A change of a state that the record does not show takes no degree of freedom.
    is_shown = known.of_state > SHOWN * known.of_state[:, :1]
    sought = fit.minimum.units.size + np.sum(is_shown & takes_part)
    freedom = sums.count + fit.problem.priors(int(np.sum(takes_part))) - sought
    chi_square = sums.residual + float(np.sum(prior**2)) + _kicks(fit)
    return chi_square, float(freedom)


def _band(fit: Fit, white: np.ndarray) -> tuple[float, float]:
    """Power in the band that stands out most, and its standard deviations."""
    problem = fit.problem
    if problem.options.dense or np.any(problem.samples.sign):
        return colour.loudest_band(white, problem.samples.parts)
    # The search has computed it from the same residuals.
    return quality.loudest_band_of(fit)


class _Judgement(NamedTuple):
    """Judgement of how well a fit describes its record.

    Attributes:
        status: Name of the status, as far as it does not depend on the ratios.
        remainder: What it does not explain.
        covariance: Of the numbers.
        pure: Whether constant rates describe a gyro's record as well.
        unexplained: Of the square of what was observed, beyond the noise.
        whiteness: Correlation of neighbours, and its standard deviations from 0.
        by_trial: Mean square of the residuals of each trial.
        gyro: Errors of a gyro, sought among the residuals.
    """

    status: str
    remainder: _Remainder
    covariance: np.ndarray
    pure: bool
    unexplained: float
    whiteness: tuple[float, float]
    by_trial: np.ndarray
    gyro: GyroErrors


def _judgement(fit: Fit, known: Precision, white: np.ndarray) -> _Judgement:
    """Judge a fit by its whitened residuals, or innovations."""
    remainder = _remainder(fit, known, white)
    takes_part = np.any(fit.kept > 0, axis=1)
    units = fit.minimum.units
    scatter = _scatter_of_trials(known, takes_part, units, remainder.inflation)
    covariance = _inflated(fit, known, scatter, remainder.inflation)
    pure = quality.is_pure(fit, remainder.inflation)
    unexplained = quality.unexplained(fit, _kicks(fit))
    misfit = remainder.misfit or bool(np.any(scatter > _DISAGREEING))
    seen = np.maximum(np.sum(white != 0, axis=(1, 2)), 1)
    if misfit:
        status = _status_of_misfit(fit, unexplained)
    else:
        status = _status_of_match(fit, remainder, covariance, pure)
    gyro, factor, moved = _gyro(fit, remainder, status)
    if moved is not None:
        status = "MISFIT"
        inflation = max(remainder.inflation, factor)
        remainder = remainder._replace(inflation=inflation)
        covariance = _inflated(fit, known, scatter, inflation)
        covariance = covariance + np.outer(moved, moved)
    sound = np.all(np.isfinite(covariance)) and remainder.freedom > 0
    # A sum that is not finite: no point was found where all predictions are finite.
    sound = sound and bool(np.isfinite(fit.minimum.square))
    if not (sound and np.isfinite(remainder.chi_square)):
        status = "NOT_CONVERGED"
    return _Judgement(
        status=status,
        remainder=remainder,
        covariance=covariance,
        pure=pure,
        unexplained=unexplained,
        whiteness=_whiteness(white, fit.problem.samples.parts),
        by_trial=np.sum(white**2, axis=(1, 2)) / seen,
        gyro=gyro,
    )


def _gyro(
    fit: Fit, remainder: _Remainder, status: str
) -> tuple[GyroErrors, float, np.ndarray | None]:
    """Errors of a gyro, and if one is named, what it does to errors and numbers.

    Returns:
        The errors; a factor of covariances; by how much the numbers are moved, or None.
    """
    noise = 1.0 if fit.problem.options.noise_known else remainder.noise
    # A fit may describe a record of unknown noise exactly.
    if not noise > 0:
        return GyroErrors(), 1.0, None
    errors = gyro_errors(fit, noise)
    named = errors.named(remainder.chi_square / noise, remainder.freedom)
    if not named or status not in ("OK", "MISFIT"):
        return errors, 1.0, None
    first = next(iter(named.values()))
    return errors, noise * (1 + first.deviations**2), first.moved


def _inflated(
    fit: Fit,
    known: Precision,
    scatter: np.ndarray,
    inflation: float,
) -> np.ndarray:
    """The covariance of the numbers, with errors as large as the fit shows them."""
    units = fit.minimum.units
    factors = np.maximum(scatter, 1.0)
    if fit.problem.priors(len(fit.kept)) and not fit.problem.options.dense:
        # Larger residuals say nothing of what was known beforehand.
        known = precision(_with_noisier_sensors(fit, inflation))
        inflation = 1.0
    covariance = inflation * _with_larger_errors(known, factors, units)
    covariance = covariance + inflation * added_by_torque(fit)
    if fit.probes:
        judged = fit.problem.unknowns.judged
        probed = max(x.error for x in fit.probes)
        covariance = _with_error(judged, covariance, units, probed)
    return covariance


def _with_noisier_sensors(fit: Fit, factor: float) -> Fit:
    """The fit with sensors of so many times the variance, and priors as stated."""
    samples = fit.kept.shape[1]
    weight = np.array(fit.minimum.weight)
    weight[:, :samples] /= factor
    return dataclasses.replace(fit, minimum=fit.minimum._replace(weight=weight))


def _status_of_misfit(fit: Fit, unexplained: float) -> str:
    """The status of a fit whose residuals are more than noise."""
    follows = unexplained <= quality.FOLLOWED
    if follows and not quality.is_at_boundary(fit):
        return "MISFIT"
    return "WRONG_BASIN" if fit.minimum.settled else "NOT_CONVERGED"


def _status_of_match(
    fit: Fit,
    remainder: _Remainder,
    covariance: np.ndarray,
    pure: bool,
) -> str:
    """The status of a fit whose residuals are no more than noise."""
    if pure or fit.ambiguous:
        return "UNIDENTIFIABLE"
    if quality.is_at_boundary(fit):
        return "AT_BOUNDARY"
    judged = fit.problem.unknowns.judged
    largest, _, _ = weakest_of(judged, covariance, fit.minimum.units)
    # A fit that creeps along what is not determined is good.
    if largest > LARGEST_ERROR:
        return "UNIDENTIFIABLE"
    if not (fit.minimum.settled or quality.is_exact(fit)):
        return "NOT_CONVERGED"
    return "MISFIT" if remainder.overstated else "OK"


def _fields_of_judgement(judgement: _Judgement) -> dict[str, Any]:
    """Fields that say how well the fit describes the record."""
    remainder = judgement.remainder
    gyro = {
        name: (error.value, np.asarray(error.deviations))
        for name, error in judgement.gyro._asdict().items()
    }
    return gyro | {
        "chi_square": remainder.chi_square,
        "degrees_of_freedom": np.asarray(int(remainder.freedom)),
        "numbers_covariance": judgement.covariance,
        "whiteness": judgement.whiteness,
        "loudest_band": remainder.band,
        "chi_square_by_trial": judgement.by_trial,
        "inflation": np.asarray(remainder.inflation),
        "unexplained": np.asarray(judgement.unexplained),
        "pure_spin": np.asarray(judgement.pure),
    }
