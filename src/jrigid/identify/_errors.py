"""What a fit determines: errors, what the record leaves open, and how the fit ended.

Plain numpy, on the host: small matrices, once for each fit.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.tree_util as jtu
import numpy as np

from jrigid._checks import RESULTS, is_good
from jrigid.dynamics import State
from jrigid.identify import _colour as colour
from jrigid.identify import _levels as levels
from jrigid.identify import _quality as quality
from jrigid.identify._filter import innovations
from jrigid.identify._layout import Layout
from jrigid.identify._minimise import spectrum, tensors_at
from jrigid.identify._problem import Problem
from jrigid.identify._quality import Fit
from jrigid.identify._records import Samples
from jrigid.identify._result import LARGEST_ERROR, Status, errors_of
from jrigid.identify._smoother import Links, Rows

SHOWN = (
    1e-9  # of the largest singular value: a change of the state that the record shows
)
_FAR = 1.0  # a change of a number beyond which the tensor is another one
HISTORY = 512  # steps whose sums of squares are returned
_FEWEST = 8  # trials whose scatter says how large errors are
_DISAGREEING = (
    3.0  # times the errors stated: the scatter of trials of which something is missing
)
_TRIED = (
    0.03  # of the level that moves a rate by its noise: where one of zero is judged
)


def condensed(rows: Rows, links: Links) -> Rows:
    """Rows in the first state of each trial: along the links, as if nothing came between."""
    if not np.any(rows.node):
        return rows
    trials, nodes, local = links.gap.shape
    border = rows.of_border.shape[-1]
    state = np.zeros((trials, local, border + local), links.gap.dtype)
    state[:, :, border:] = np.eye(local)
    states = np.zeros((trials, nodes, local, border + local), links.gap.dtype)
    for node in range(nodes):
        states[:, node] = state
        state = links.of_state[:, node] @ state
        state[:, :, :border] += links.of_border[:, node]
    through = rows.of_state @ np.take_along_axis(
        states, rows.node[:, :, None, None], axis=1
    )
    of_border = rows.of_border + through[..., :border]
    return Rows(
        rows.residual, of_border, through[..., border:], np.zeros_like(rows.node)
    )


class Precision(NamedTuple):
    """What rows determine of the numbers.

    Attributes:
        values: Singular values of the derivatives in natural units, descending; the
            inverse of each is an error.
        directions: In the numbers, columns for the values.
        covariance: Of the numbers.
        local: Of a trial's first state and own numbers beside given numbers.
        follow: How these follow the numbers, with the sign turned.
        of_state: Singular values of each trial's state, of unit columns, descending.
        scores: What each trial adds to the gradient of half the squares in the numbers.
    """

    values: np.ndarray
    directions: np.ndarray
    covariance: np.ndarray
    local: np.ndarray
    follow: np.ndarray
    of_state: np.ndarray
    scores: np.ndarray


def precision_of_rows(
    rows: Rows, weight: np.ndarray, own: int, units: np.ndarray
) -> Precision:
    """By a QR decomposition of weighted rows in first states: their squares would lose digits."""
    root = np.sqrt(weight)[..., None]
    trials, count, width = rows.residual.shape
    residual = (root * rows.residual).reshape(trials, count * width)
    local = np.concatenate([rows.of_state, rows.of_border[..., :own]], axis=-1)
    local = (root[..., None] * local).reshape(trials, count * width, local.shape[-1])
    shared = root[..., None] * rows.of_border[..., own:]
    shared = shared.reshape(trials, count * width, units.size)
    shared = np.nan_to_num(shared * units)
    local = np.nan_to_num(local)
    eps, size = np.finfo(units.dtype).eps, units.size
    scale = quality.or_one(np.linalg.norm(local, axis=1))
    u, s, vt = np.linalg.svd(local / scale[:, None], full_matrices=False)
    shown = s > SHOWN * s[:, :1]
    u = np.where(shown[:, None], u, 0.0)
    inverse = 1 / np.where(shown, s, eps * np.maximum(s[:, :1], 1.0))
    half = np.swapaxes(vt, 1, 2) * inverse[:, None] / scale[:, :, None]
    along = np.swapaxes(u, 1, 2) @ shared
    follow = np.where(shown[:, None], half, 0.0) @ along
    rest = shared - u @ along
    scores = (residual[:, None] @ rest)[:, 0] / units
    r = np.linalg.qr(rest.reshape(trials * count * width, size), mode="r")
    sound = np.all(np.isfinite(r))
    _, values, vt = np.linalg.svd(r if sound else np.zeros_like(r), full_matrices=False)
    floor = 16 * eps * np.max(values, initial=0.0) + 1e-150
    root = vt / np.maximum(values, floor)[:, None] * (units if sound else np.nan)
    return Precision(
        values=values,
        directions=vt.T,
        covariance=root.T @ root,
        local=half @ np.swapaxes(half, 1, 2),
        follow=follow / units,
        of_state=s,
        scores=scores,
    )


class Independent(NamedTuple):
    """Independent rows of a fit, in first states, own numbers and numbers.

    Attributes:
        rows: Innovations where a torque may have acted, else residuals.
        weight: Of each row.
        log_determinant: Of the covariance of what was observed, in units of the noise:
            with the sum of squares it makes -2 log likelihood.
    """

    rows: Rows
    weight: np.ndarray
    log_determinant: float


@quality.once_for_each_fit
def independent_rows(problem: Problem, fit: Fit) -> Independent:
    """The rows of a fit by which it is judged, those of what is known beforehand last."""
    minimum = fit.minimum
    if not problem.options.dense:
        return Independent(condensed(minimum.rows, minimum.links), minimum.weight, 0.0)
    found = innovations(quality.linearised(fit), fit.disturbance)
    columns = np.concatenate(
        [np.asarray(found.rows), quality.columns_of_prior(fit)], axis=1
    )
    border = 1 + minimum.links.gap.shape[-1]
    of_border, of_state = columns[..., border:], columns[..., 1:border]
    rows = Rows(columns[..., 0], of_border, of_state, np.zeros_like(minimum.rows.node))
    # They have their weights already.
    return Independent(
        rows, np.ones_like(minimum.weight), float(np.sum(found.log_determinant))
    )


class Weakest(NamedTuple):
    """Chi-square of a fit, its unit, and what the record determines least of the inertia.

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


@quality.once_for_each_fit
def precision(problem: Problem, fit: Fit) -> Precision:
    """What a fit determines of the numbers."""
    own, units = fit.minimum.point.own.shape[-1], fit.minimum.units
    rows, weight, _ = independent_rows(problem, fit)
    return precision_of_rows(rows, weight, own, units)


def weakest(problem: Problem, fit: Fit) -> Weakest:
    """The direction in the numbers that the record determines least."""
    minimum, units = fit.minimum, fit.minimum.units
    square, noise = float(minimum.square + minimum.kicks), 1.0
    if not problem.options.noise_known:
        trials, local = minimum.links.gap.shape[0], minimum.links.gap.shape[-1]
        counted = np.sum(quality.weights_of(problem, fit.kept))
        noise = square / max(float(counted) - units.size - local * trials, 1.0)
    covariance = precision(problem, fit).covariance
    error, normal, direction = weakest_of(problem.unknowns.judged, covariance, units)
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
    normal, direction = np.zeros_like(units), np.zeros_like(units)
    inside = covariance[part, part] / (units[part, None] * units[part])
    if not units.size or not np.all(np.isfinite(inside)):
        return 0.0 if not units.size else np.inf, normal, direction
    values, axes = np.linalg.eigh(inside)
    normal[part] = axes[:, -1] / units[part]
    # Others follow as far as they are known to, and no farther than a start need be.
    follow = covariance @ normal / max(values[-1], 1e-300)
    direction = np.clip(follow, -units, units)
    direction[part] = axes[:, -1] * units[part]
    return float(np.sqrt(max(values[-1], 0.0))), normal, direction


def first_level(problem: Problem, layout: Layout, tensor: np.ndarray) -> float:
    """The level of a torque that moves a rate by its noise from node to node."""
    span = np.sum(np.where(layout.linked, layout.end - layout.start, 0.0))
    mean = span / max(np.sum(layout.linked), 1)
    size = np.trace(tensor) / 3
    return float(problem.noise[0] * size / np.sqrt(mean if mean > 0 else 1.0))


def _of_torque(problem: Problem, fit: Fit, inflation: float) -> dict[str, Any]:
    """Level and correlation time of the unmodelled torque, with errors."""
    trials, none = fit.kept.shape[0], np.zeros(3)
    fields = {
        "level": none,
        "level_errors": none,
        "correlation_time": none,
        "correlation_time_errors": none,
        "level_by_trial": np.ones(trials),
    }
    if not problem.options.dense:
        return fields
    # A level was relative to a noise that was not known.
    size = 1.0 if problem.options.noise_known else np.sqrt(inflation)
    first = first_level(problem, fit.layout, fit.minimum.tensor)
    search = levels.Search(problem, fit.layout, first)
    torque = fit.torque
    if torque is None:
        given = fit.disturbance
        torque = levels.known(
            np.asarray(given.level[0], float), np.asarray(given.time, float)
        )
    faint = search.are_faint(torque)
    tried = torque.with_levels(np.where(faint, _TRIED * first, torque.levels))
    typical, errors = tried.typical, search.errors(tried, fit)
    of_levels, of_times = np.split(errors, [torque.form.levels])
    # Near none the likelihood is quadratic in the level squared: the least to be seen.
    of_levels = np.where(faint, np.sqrt(2 * of_levels), of_levels)
    level = size * typical.level
    if fit.torque is not None:
        level = np.where(search.are_unbounded(tried, of_levels), np.inf, level)
    fields |= {"level": np.where(faint, 0.0, level), "level_errors": level * of_levels}
    if np.all(faint):
        return fields
    fields |= {
        "correlation_time": typical.time,
        "level_by_trial": np.exp(torque.trials),
    }
    if torque.form.times:
        fields["correlation_time_errors"] = typical.time * of_times
    return fields


def derive(
    problem: Problem, numbers: np.ndarray, covariance: np.ndarray
) -> dict[str, Any]:
    """Moments, axes and ratios, with errors, from the numbers and their covariance."""
    found = jtu.tree_map(np.asarray, spectrum(problem.unknowns, numbers))
    tensor, moments, axes, slopes = found
    elements = slopes.reshape(9, numbers.size)
    gaps = np.roll(moments, -1) - np.roll(moments, 1)
    floor = np.finfo(gaps.dtype).eps * moments[2]
    gaps = np.where(np.abs(gaps) > floor, gaps, floor)
    sides = np.roll(axes, -1, axis=1), np.roll(axes, 1, axis=1)
    turns = np.einsum("ki,kln,li->in", sides[0], slopes, sides[1]) / gaps[:, None]
    spread = _spread_of_moments(problem, numbers, covariance)
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
        "axes_errors": np.sqrt(
            np.maximum(np.sum((turns @ covariance) * turns, axis=1), 0.0)
        ),
    }


def _of_moments(moments: np.ndarray) -> np.ndarray:
    """Moments, ratios and shares (..., 8)."""
    total = np.sum(moments, axis=-1, keepdims=True)
    ratios = moments[..., 1:] / moments[..., :1]
    return np.concatenate([moments, ratios, moments / total], axis=-1)


def _spread_of_moments(
    problem: Problem, numbers: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Covariance of moments, ratios and shares: as `FitResult.spread`."""
    size = problem.unknowns.of_inertia.stop
    inside = covariance[:size, :size]
    if not size or not np.all(np.isfinite(inside)):
        return np.full((8, 8), 0.0 if not size else np.nan, numbers.dtype)
    values, axes = np.linalg.eigh(inside)
    sizes = np.sqrt(np.maximum(values, 0.0) * size)
    near = np.minimum(
        sizes, _FAR
    )  # what is known worse is continued as a straight line
    steps = np.pad((axes * near).T, ((0, 0), (0, numbers.size - size)))
    points = numbers + np.concatenate([steps, -steps, np.zeros((1, numbers.size))])
    tensors = np.asarray(tensors_at(problem.unknowns, points.astype(numbers.dtype)))
    if not np.all(np.isfinite(tensors)):
        return np.full((8, 8), np.nan, numbers.dtype)
    values = _of_moments(np.linalg.eigvalsh(tensors))
    moves = values[:-1] - values[-1]
    moves = moves * np.tile(sizes / np.where(near > 0, near, 1.0), 2)[:, None]
    return moves.T @ moves / (2 * max(size, 1))


@np.errstate(all="ignore")  # what is not finite is judged below
def conclude(
    problem: Problem,
    fit: Fit,
    lengths: Sequence[int],
    input_result: Any = RESULTS.successful,
) -> dict[str, Any]:
    """The fields of a `FitResult`, in numpy, from a fit at its minimum.

    Args:
        problem: The record, filled up to a rounded number of samples.
        fit: The minimum.
        lengths: How many samples of each record to return.
        input_result: What is wrong with the input.
    """
    minimum, options = fit.minimum, problem.options
    point, units, own = minimum.point, minimum.units, minimum.point.own.shape[-1]
    independent = independent_rows(problem, fit)
    known = precision(problem, fit)
    rows, sensor = independent.rows, known
    if options.dense:
        rows = condensed(minimum.rows, minimum.links)
        sensor = precision_of_rows(rows, minimum.weight, own, units)
    residuals, jacobian = _weighted(fit, rows, own)
    parts, count = problem.samples.parts, fit.kept.shape[1]
    # Weights of innovations are ones.
    judged_by = (np.sqrt(independent.weight)[..., None] * independent.rows.residual)[
        :, :count
    ]
    judged = _judged(problem, fit, known, judged_by)
    inflation, covariance = judged["inflation"], judged["numbers_covariance"]
    derived = derive(problem, point.numbers, covariance)
    loose = np.any(
        errors_of(derived["ratios_covariance"]) > LARGEST_ERROR * derived["ratios"]
    )
    if not is_good(input_result):
        judged["status"] = "BAD_INPUT"
    elif loose and judged["status"] == "OK":
        judged["status"] = "UNIDENTIFIABLE"
    of_torque = _of_torque(problem, fit, float(inflation))
    if not np.all(np.isfinite([of_torque["level"], of_torque["level_errors"]])):
        judged["status"] = "NOT_CONVERGED"
    fields = judged | derived | of_torque
    fields |= {
        "numbers": point.numbers,
        "own_numbers": point.own,
        "sensor_covariance": inflation * sensor.covariance,
        "local_covariance": inflation * known.local,
        "follow": known.follow,
        "scores": known.scores,
        "state": State(point.attitude[:, 0], point.omega[:, 0]),
        "t0": fit.layout.start[:, 0],
        "residuals": _resized(residuals, parts, lengths),
        "jacobian": _resized(jacobian, parts, lengths),
        "state_singular_values": sensor.of_state,
        "scales": fit.scales,
        "kept": _resized(fit.kept, parts, lengths) > 0,
        "history": np.pad(fit.history, (0, HISTORY), constant_values=np.nan)[:HISTORY],
        "ambiguous": np.asarray(fit.ambiguous),
        "log_determinant": np.asarray(independent.log_determinant),
        "torque_numbers": np.asarray(0 if fit.torque is None else fit.torque.size),
        "problem": dataclasses.replace(
            problem,
            options=options._replace(nodes=1),
            samples=_of_lengths(problem.samples, lengths),
        ),
    }
    status = getattr(Status, fields.pop("status"))
    fields = _of_dtype(fields, is_good(input_result), units.dtype)
    return fields | {"status": status, "input_result": input_result}


def _weighted(fit: Fit, rows: Rows, own: int) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of the samples, and their derivatives in the numbers and the first state."""
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
    mode: str = "constant",
) -> np.ndarray:
    """The samples of each record (trials, samples, ...), so many: cut, or filled with zeros."""
    resized = []
    for part, n in zip(parts, lengths, strict=True):
        own = x[:, part][:, :n]
        if own.shape[1] < n:
            missing = [(0, 0), (0, n - own.shape[1])] + [(0, 0)] * (x.ndim - 2)
            own = np.pad(own, missing, mode)  # type: ignore[call-overload]
        resized.append(own)
    return np.concatenate(resized, axis=1)


def _of_lengths(samples: Samples, lengths: Sequence[int]) -> Samples:
    """Without the samples that fill a record up to a rounded number."""
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
    """With an error of the inertia's weakest direction, in natural units, of at least this size."""
    before, _, direction = weakest_of(part, covariance, units)
    return covariance + max(error**2 - before**2, 0.0) * np.outer(direction, direction)


def _with_larger_errors(
    known: Precision, factors: np.ndarray, units: np.ndarray
) -> np.ndarray:
    """The covariance with errors so many times larger along each direction."""
    directions = known.directions * units[:, None] / np.maximum(known.values, 1e-150)
    more = directions * np.sqrt(factors**2 - 1)
    return known.covariance + more @ more.T


def _scatter_of_trials(
    known: Precision, alive: np.ndarray, units: np.ndarray
) -> np.ndarray:
    """Errors by the scatter of trials over those stated, along each direction; 1 of few trials."""
    trials = np.sum(alive)
    if trials < _FEWEST or not np.all(np.isfinite(known.scores)):
        return np.ones(units.size)
    along = (
        (known.scores[alive] * units)
        @ known.directions
        / np.maximum(known.values, 1e-150)
    )
    return np.sqrt(np.sum(along**2, axis=0) * trials / (trials - 1))


def _whiteness(rows: np.ndarray, parts: Sequence[slice]) -> tuple[float, float]:
    """Correlation of neighbours, and how many standard deviations that is from 0."""
    left = np.concatenate([rows[:, x.start : x.stop - 1] for x in parts], axis=1)
    right = np.concatenate([rows[:, x.start + 1 : x.stop] for x in parts], axis=1)
    both = (left != 0) & (right != 0)
    square = np.sum(both * (left**2 + right**2) / 2)
    like = np.sum(left * right) / max(square, np.finfo(rows.dtype).tiny)
    return like, np.abs(like) * np.sqrt(np.sum(both))


def _kicks(problem: Problem, fit: Fit) -> float:
    """Sum of squares of what an unmodelled torque did; 0 where there is none."""
    return float(fit.minimum.kicks) if problem.options.dense else 0.0


class _Left(NamedTuple):
    """What a fit leaves of its record.

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


def _what_is_left(
    problem: Problem, fit: Fit, known: Precision, residuals: np.ndarray
) -> _Left:
    count = fit.kept.shape[1]
    weight = quality.weights_of(problem, fit.kept)
    alive = np.any(fit.kept > 0, axis=1)[:, None]
    shown = np.sum((known.of_state > SHOWN * known.of_state[:, :1]) & alive)
    rows = fit.minimum.rows.residual
    prior = rows[:, count : rows.shape[1] - problem.held]
    freedom = np.sum(weight) + np.sum(prior != 0) - fit.minimum.units.size - shown
    chi_square = np.sum(weight * fit.residual**2) + np.sum(prior**2)
    chi_square = chi_square + _kicks(problem, fit)
    noise = chi_square / max(freedom, 1.0)
    band, sure = colour.loudest_band(residuals, problem.samples.parts)
    coloured = colour.stands_out(band, sure)
    more = less = False
    if problem.options.noise_known:
        gate = quality.GATE * np.sqrt(2 / max(freedom, 1.0))
        more = noise > 1 + gate or np.max(fit.scales) > 2
        less = 0 < noise < 1 - gate  # a plan has no residuals
    inflation = (
        noise if not problem.options.noise_known else max(noise, 1.0) if more else 1.0
    )
    # A band that stands out may be the one that tells the numbers.
    inflation = inflation * band if coloured else inflation
    misfit = bool(more or coloured)
    return _Left(
        chi_square, freedom, noise, (band, sure), misfit, bool(less), inflation
    )


def _judged(
    problem: Problem, fit: Fit, known: Precision, residuals: np.ndarray
) -> dict[str, Any]:
    """How well a fit describes the record, by residuals or innovations, and its name."""
    units, settled, unknowns = (
        fit.minimum.units,
        bool(fit.minimum.settled),
        problem.unknowns,
    )
    left = _what_is_left(problem, fit, known, residuals)
    apart = _scatter_of_trials(known, np.any(fit.kept > 0, axis=1), units)
    apart = apart / np.sqrt(left.inflation)
    misfit = left.misfit or np.any(apart > _DISAGREEING)
    covariance = left.inflation * _with_larger_errors(
        known, np.maximum(apart, 1.0), units
    )
    if fit.probed_error > 0:
        covariance = _with_error(unknowns.judged, covariance, units, fit.probed_error)
    pure = quality.is_pure(problem, fit, left.inflation)
    unexplained = quality.unexplained(problem, fit, _kicks(problem, fit))
    flat = quality.is_at_boundary(problem, fit)
    largest = weakest_of(unknowns.judged, covariance, units)[0]
    sound = np.all(np.isfinite(covariance)) and left.freedom > 0
    if not (sound and np.isfinite(left.chi_square)):
        status = "NOT_CONVERGED"
    elif misfit:
        follows = unexplained <= quality.FOLLOWED and not flat
        status = (
            "MISFIT" if follows else ("WRONG_BASIN" if settled else "NOT_CONVERGED")
        )
    elif pure or fit.ambiguous:
        status = "UNIDENTIFIABLE"
    elif flat:
        status = "AT_BOUNDARY"
    elif (
        largest > LARGEST_ERROR
    ):  # a fit that creeps along what is not determined is good
        status = "UNIDENTIFIABLE"
    elif not settled:
        status = "NOT_CONVERGED"
    else:
        status = "MISFIT" if left.overstated else "OK"
    seen = np.maximum(np.sum(residuals != 0, axis=(1, 2)), 1)
    return {
        "status": status,
        "chi_square": left.chi_square,
        "degrees_of_freedom": np.asarray(int(left.freedom)),
        "whiteness": _whiteness(residuals, problem.samples.parts),
        "loudest_band": left.band,
        "chi_square_by_trial": np.sum(residuals**2, axis=(1, 2)) / seen,
        "inflation": np.asarray(left.inflation),
        "unexplained": np.asarray(unexplained),
        "pure_spin": np.asarray(pure),
        "singular_values": known.values,
        "directions": known.directions,
        "numbers_covariance": covariance,
    }
