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
from jrigid.identify import _quality as quality
from jrigid.identify._layout import Layout
from jrigid.identify._minimise import (
    Evidence,
    equations,
    evidence,
    link_whitener_of,
    spectrum,
    tensors_at,
)
from jrigid.identify._problem import Problem
from jrigid.identify._quality import Fit
from jrigid.identify._records import Samples
from jrigid.identify._result import LARGEST_ERROR, Status, errors_of
from jrigid.identify._smoother import Links, Rows

SHOWN = 1e-9  # of the largest singular value: a change of the state that the record shows
_FAR = 1.0  # a change of a number beyond which the tensor is another one
FAINT = 1e-4  # of the level that links of weight 1 stand for: no torque at all
HISTORY = 512  # steps whose sums of squares are returned
_TRIED = 0.03  # of the level that moves a rate by its noise: where one of zero is judged
_WHITE = 6.0  # standard deviations of the correlation of neighbouring residuals
_COLOURED = 0.25  # ... and its size, for residuals that are no noise


def condensed(rows: Rows, links: Links) -> Rows:
    """Rows in the first state of each throw: along the links, as if nothing came between."""
    if not np.any(rows.node):
        return rows
    throws, nodes, local = links.gap.shape
    border = rows.of_border.shape[-1]
    state = np.zeros((throws, local, border + local), links.gap.dtype)
    state[:, :, border:] = np.eye(local)
    states = np.zeros((throws, nodes, local, border + local), links.gap.dtype)
    for node in range(nodes):
        states[:, node] = state
        state = links.of_state[:, node] @ state
        state[:, :, :border] += links.of_border[:, node]
    through = rows.of_state @ np.take_along_axis(states, rows.node[:, :, None, None], axis=1)
    of_border = rows.of_border + through[..., :border]
    return Rows(rows.residual, of_border, through[..., border:], np.zeros_like(rows.node))


class Precision(NamedTuple):
    """What rows determine of the numbers.

    Attributes:
        values: Singular values of the derivatives in natural units, descending; the inverse of
            each is an error.
        directions: In the numbers, columns for the values.
        covariance: Of the numbers.
        local: Of a throw's first state and own numbers beside given numbers.
        follow: How these follow the numbers, with the sign turned.
        of_state: Singular values of each throw's state, of unit columns, descending.
        scores: What each throw adds to the gradient of half the squares in the numbers.
    """

    values: np.ndarray
    directions: np.ndarray
    covariance: np.ndarray
    local: np.ndarray
    follow: np.ndarray
    of_state: np.ndarray
    scores: np.ndarray


def _precision(
    r: np.ndarray,
    half: np.ndarray,
    follow: np.ndarray,
    of_state: np.ndarray,
    scores: np.ndarray,
    units: np.ndarray,
) -> Precision:
    """From the triangular factor of the numbers in natural units."""
    sound = np.all(np.isfinite(r))
    _, values, vt = np.linalg.svd(r if sound else np.zeros_like(r), full_matrices=False)
    largest = np.max(values, initial=0.0)
    floor = np.maximum(values, 16 * np.finfo(r.dtype).eps * largest + 1e-150)
    root = vt / floor[:, None] * units if sound else np.full_like(vt, np.nan)
    local = half @ np.swapaxes(half, 1, 2)
    return Precision(values, vt.T, root.T @ root, local, follow / units, of_state, scores)


def precision_of_rows(rows: Rows, weight: np.ndarray, own: int, units: np.ndarray) -> Precision:
    """By a QR decomposition of weighted rows in first states: their squares would lose digits."""
    root = np.sqrt(weight)[..., None]
    throws, count, width = rows.residual.shape
    residual = (root * rows.residual).reshape(throws, count * width)
    local = np.concatenate([rows.of_state, rows.of_border[..., :own]], axis=-1)
    local = (root[..., None] * local).reshape(throws, count * width, local.shape[-1])
    shared = root[..., None] * rows.of_border[..., own:]
    shared = shared.reshape(throws, count * width, units.size)
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
    r = np.linalg.qr(rest.reshape(throws * count * width, size), mode="r")
    return _precision(np.asarray(r), half, follow, s, scores, units)


def precision_of_fit(fit: Fit, units: np.ndarray) -> Precision:
    """By the normal equations of the smoother, its links included."""
    minimum = fit.minimum
    parts = minimum.point, minimum.rows, minimum.links, minimum.weight, minimum.whitener
    left = jtu.tree_map(np.asarray, equations(*parts))
    scale = np.sqrt(np.maximum(np.diagonal(left.inner, axis1=1, axis2=2), 1e-300))
    inner = left.inner / scale[:, :, None] / scale[:, None, :]
    matrix = left.numbers * units[:, None] * units[None, :]
    sound = np.all(np.isfinite(inner)) and np.all(np.isfinite(matrix))
    if not sound:
        inner, matrix = np.broadcast_to(np.eye(inner.shape[-1]), inner.shape), np.eye(units.size)
    values, axes = np.linalg.eigh(inner)
    values = np.maximum(values, np.finfo(units.dtype).eps)
    half = axes / np.sqrt(values)[:, None, :] / scale[:, :, None]
    s, axes = np.linalg.eigh(matrix)
    r = np.sqrt(np.maximum(s, 0.0))[:, None] * axes.T
    r = r if sound else np.full_like(r, np.nan)
    follow = left.follow * units
    of_state = np.sqrt(values)[:, ::-1]
    return _precision(r, half, follow, of_state, left.scores, units)


class Weakest(NamedTuple):
    """Chi-square of a fit, its unit, and the direction that the record determines least."""

    square: float
    noise: float
    error: float  # in natural units
    direction: np.ndarray  # a natural unit along it, in numbers
    normal: np.ndarray  # whose product with that is one


def precision(problem: Problem, fit: Fit) -> Precision:
    """Of the smoother where there is an unmodelled torque, else of the rows alone."""
    minimum = fit.minimum
    own, units = minimum.point.own.shape[-1], minimum.units
    if problem.options.dense:
        return precision_of_fit(fit, units)
    rows = condensed(minimum.rows, minimum.links)
    return precision_of_rows(rows, minimum.weight, own, units)


def weakest(problem: Problem, fit: Fit) -> Weakest:
    """The direction in the numbers that the record determines least."""
    minimum, units = fit.minimum, fit.minimum.units
    square, noise = float(minimum.square) + fit.kicks, 1.0
    if not problem.options.noise_known:
        throws, local = minimum.links.gap.shape[0], minimum.links.gap.shape[-1]
        counted = np.sum(quality.weights_of(problem, fit.kept))
        noise = square / max(float(counted) - units.size - local * throws, 1.0)
    if not units.size:
        return Weakest(square, noise, 0.0, units, units)
    known = precision(problem, fit)
    error = np.sqrt(noise) / max(float(known.values[-1]), 1e-15)
    direction = known.directions[:, -1]
    return Weakest(square, noise, error, direction * units, direction / units)


def first_level(problem: Problem, layout: Layout, tensor: np.ndarray) -> np.ndarray:
    """The torque's level that moves a rate by its noise from node to node, for each axis."""
    span = np.sum(np.where(layout.linked, layout.end - layout.start, 0.0))
    mean = span / max(np.sum(layout.linked), 1)
    size = np.trace(tensor) / 3
    level = problem.noise[0] * size / np.sqrt(mean if mean > 0 else 1.0)
    return np.full(3, level, problem.noise.dtype)


def evidence_of(problem: Problem, fit: Fit, whitener: Any) -> Evidence:
    """What the record says of the torque's level; of one level for all axes, thrice the same."""
    minimum = fit.minimum
    parts = minimum.point, minimum.rows, minimum.links, minimum.weight, whitener
    seen = jtu.tree_map(np.asarray, evidence(problem, *parts))
    if problem.options.level == "estimate per axis":
        return seen
    return Evidence(*(np.full(3, np.sum(x)) for x in seen))


def _levels(problem: Problem, layout: Layout, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """The level of the unmodelled torque and its errors; zero where the links are rigid."""
    first = first_level(problem, layout, fit.minimum.tensor)
    faint = fit.level <= 1.01 * FAINT * first
    tried = np.where(faint, _TRIED * first, fit.level)
    numbers = fit.minimum.point.numbers
    whitener = link_whitener_of(problem, layout, numbers, tried)
    information = evidence_of(problem, fit, whitener).information
    # That of a level near zero is in proportion to its fourth power: the least to be seen.
    errors = tried * np.where(faint, information**-0.25, 0.5 * information**-0.5)
    return np.where(faint, 0.0, fit.level), errors


def derive(problem: Problem, numbers: np.ndarray, covariance: np.ndarray) -> dict[str, Any]:
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
    errors = errors_of(spread)
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
        "moments_errors": errors[:3],
        "ratios_errors": errors[3:5],
        "shares_errors": errors[5:],
        "axes_errors": np.sqrt(np.maximum(np.sum((turns @ covariance) * turns, axis=1), 0.0)),
    }


def _of_moments(moments: np.ndarray) -> np.ndarray:
    """Moments, ratios and shares (..., 8)."""
    total = np.sum(moments, axis=-1, keepdims=True)
    ratios = moments[..., 1:] / moments[..., :1]
    return np.concatenate([moments, ratios, moments / total], axis=-1)


def _spread_of_moments(problem: Problem, numbers: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Covariance of moments, ratios and shares: as `FitResult.spread`."""
    size = problem.unknowns.slices["scale"].stop  # the others do not move the tensor
    inside = covariance[:size, :size]
    if not size or not np.all(np.isfinite(inside)):
        return np.full((8, 8), 0.0 if not size else np.nan, numbers.dtype)
    values, axes = np.linalg.eigh(inside)
    sizes = np.sqrt(np.maximum(values, 0.0) * size)
    near = np.minimum(sizes, _FAR)  # what is known worse is continued as a straight line
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
    layout: Layout,
    fit: Fit,
    lengths: Sequence[int],
    input_result: Any = RESULTS.successful,
) -> dict[str, Any]:
    """The fields of a `FitResult`, in numpy, from a fit at its minimum.

    Args:
        problem: The record, filled up to a rounded number of samples.
        layout: Of the last stage.
        fit: The minimum.
        lengths: How many samples of each record to return.
        input_result: What is wrong with the input.
    """
    minimum, options = fit.minimum, problem.options
    point, units, own = minimum.point, minimum.units, minimum.point.own.shape[-1]
    rows = condensed(minimum.rows, minimum.links)
    sensor = precision_of_rows(rows, minimum.weight, own, units)
    known, kicks = sensor, 0.0
    level = level_errors = np.zeros(3, units.dtype)
    if options.dense:
        known, kicks = precision_of_fit(fit, units), fit.kicks
        level, level_errors = _levels(problem, layout, fit)
    residuals, jacobian = _weighted(fit, rows, own)
    parts = problem.samples.parts
    judged = _judged(problem, fit, known, kicks, residuals)
    inflation, covariance = judged["inflation"], judged["numbers_covariance"]
    if not options.noise_known:  # the level was relative to the noise
        level, level_errors = (np.sqrt(inflation) * x for x in (level, level_errors))
    derived = derive(problem, point.numbers, covariance)
    loose = np.any(derived["ratios_errors"] > LARGEST_ERROR * derived["ratios"])
    if not is_good(input_result):
        judged["status"] = "BAD_INPUT"
    elif loose and judged["status"] == "OK":
        judged["status"] = "UNIDENTIFIABLE"
    fields = judged | derived
    fields |= {
        "numbers": point.numbers,
        "own_numbers": point.own,
        "errors": errors_of(covariance),
        "sensor_covariance": inflation * sensor.covariance,
        "local_covariance": inflation * known.local,
        "follow": known.follow,
        "scores": known.scores,
        "state": State(point.attitude[:, 0], point.omega[:, 0]),
        "t0": layout.start[:, 0],
        "residuals": _resized(residuals, parts, lengths),
        "jacobian": _resized(jacobian, parts, lengths),
        "state_singular_values": sensor.of_state,
        "level": level,
        "level_errors": level_errors,
        "scales": fit.scales,
        "kept": _resized(fit.kept, parts, lengths) > 0,
        "history": np.pad(fit.history, (0, HISTORY), constant_values=np.nan)[:HISTORY],
        "ambiguous": np.asarray(fit.ambiguous),
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
    x: np.ndarray, parts: Sequence[slice], lengths: Sequence[int], mode: str = "constant"
) -> np.ndarray:
    """The samples of each record (throws, samples, ...), so many: cut, or filled with zeros."""
    resized = []
    for part, n in zip(parts, lengths, strict=True):
        own = x[:, part][:, :n]
        missing = [(0, 0), (0, n - own.shape[1])] + [(0, 0)] * (x.ndim - 2)
        resized.append(np.pad(own, missing, mode))  # type: ignore[call-overload]
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


def _widened(known: Precision, error: float, units: np.ndarray) -> Precision:
    """With an error of the weakest direction, in natural units, of at least this size."""
    if not error > 0:
        return known
    last, direction = known.values[-1], known.directions[:, -1] * units
    more = max(error**2 - 1 / max(last, 1e-150) ** 2, 0.0)
    values = known.values.copy()
    values[-1] = min(values[-1], 1 / error)
    covariance = known.covariance + more * direction[:, None] * direction[None, :]
    return known._replace(values=values, covariance=covariance)


def _whiteness(rows: np.ndarray, parts: Sequence[slice]) -> tuple[float, float]:
    """Correlation of neighbours, and how many standard deviations that is from 0."""
    left = np.concatenate([rows[:, x.start : x.stop - 1] for x in parts], axis=1)
    right = np.concatenate([rows[:, x.start + 1 : x.stop] for x in parts], axis=1)
    both = (left != 0) & (right != 0)
    square = np.sum(both * (left**2 + right**2) / 2)
    like = np.sum(left * right) / max(square, np.finfo(rows.dtype).tiny)
    return like, np.abs(like) * np.sqrt(np.sum(both))


def _judged(
    problem: Problem, fit: Fit, known: Precision, kicks: float, residuals: np.ndarray
) -> dict[str, Any]:
    """How well a fit describes the record, by residuals and the squares of kicks, and its name."""
    options, units, count = problem.options, fit.minimum.units, fit.kept.shape[1]
    settled = bool(fit.minimum.settled)
    whiteness = _whiteness(residuals, problem.samples.parts)
    weight = quality.weights_of(problem, fit.kept)
    alive = np.any(fit.kept > 0, axis=1)[:, None]
    shown = np.sum((known.of_state > SHOWN * known.of_state[:, :1]) & alive)
    rows = fit.minimum.rows.residual
    prior = rows[:, count : rows.shape[1] - problem.held]
    freedom = np.sum(weight) + np.sum(prior != 0) - units.size - shown
    chi_square = np.sum(weight * fit.residual**2) + np.sum(prior**2) + kicks
    noise = chi_square / max(freedom, 1.0)
    if options.noise_known:
        gate = quality.GATE * np.sqrt(2 / max(freedom, 1.0))
        overstated = 0 < noise < 1 - gate  # a plan has no residuals
        misfit = noise > 1 + gate or np.max(fit.scales) > 2
        inflation = max(noise, 1.0) if misfit else 1.0
    else:
        like, sure = whiteness
        misfit = like > _COLOURED and sure > _WHITE
        overstated, inflation = False, noise
    if units.size:
        known = _widened(known, fit.probed_error / np.sqrt(inflation), units)
    pure = quality.is_pure(problem, fit, inflation)
    left = quality.unexplained(problem, fit, kicks)
    flat = quality.is_at_boundary(problem, fit)
    largest = np.sqrt(inflation) / np.min(known.values, initial=np.inf)
    sound = np.all(np.isfinite(known.covariance)) and freedom > 0 and np.isfinite(chi_square)
    if not sound:
        status = "NOT_CONVERGED"
    elif misfit:
        follows = left <= quality.FOLLOWED and not flat
        status = "MISFIT" if follows else ("WRONG_BASIN" if settled else "NOT_CONVERGED")
    elif pure or fit.ambiguous:
        status = "UNIDENTIFIABLE"
    elif flat:
        status = "AT_BOUNDARY"
    elif largest > LARGEST_ERROR:  # a fit that creeps along what is not determined is good
        status = "UNIDENTIFIABLE"
    elif not settled:
        status = "NOT_CONVERGED"
    else:
        status = "MISFIT" if overstated else "OK"
    seen = np.maximum(np.sum(residuals != 0, axis=(1, 2)), 1)
    return {
        "status": status,
        "chi_square": chi_square,
        "degrees_of_freedom": np.asarray(int(freedom)),
        "reduced_chi_square": noise,
        "whiteness": whiteness,
        "chi_square_by_throw": np.sum(residuals**2, axis=(1, 2)) / seen,
        "inflation": np.asarray(inflation),
        "unexplained": np.asarray(left),
        "pure_spin": np.asarray(pure),
        "singular_values": known.values,
        "directions": known.directions,
        "numbers_covariance": inflation * known.covariance,
    }
