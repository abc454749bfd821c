"""Precision of the numbers and of each trial's state, from independent rows.

Plain numpy, on the host: small matrices, once for each fit.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jrigid._numerics import or_one
from jrigid.identify import _quality as quality
from jrigid.identify._independent import independent_rows
from jrigid.identify._minimise import spectrum
from jrigid.identify._quality import Fit
from jrigid.identify._smoother import Rows
from jrigid.identify._unknowns import Unknowns

# Of the largest singular value: a change of the state that the record shows.
SHOWN = 1e-9
# Of the change of the tensor: the part that changes moments where it only turns.
_NO_CHANGE = 1e-5
# Natural units that the error of a turn has if the record does not show it. A larger
# one would leave what is known of other numbers no digits in a covariance.
_OF_TURN = 100.0


class Precision(NamedTuple):
    """Precision with which rows determine the numbers.

    Attributes:
        values: Singular values of the derivatives in natural units, descending; the
            inverse of each is an error.
        directions: In the numbers, columns for the values.
        covariance: Of the numbers.
        local: Of a trial's first state and own numbers beside given numbers.
        sensitivity: Derivative of these in the numbers (trials, local, numbers).
        of_state: Singular values of each trial's state, of unit columns, descending.
        scores: What each trial adds to the gradient of half the squares in the numbers.
    """

    values: np.ndarray
    directions: np.ndarray
    covariance: np.ndarray
    local: np.ndarray
    sensitivity: np.ndarray
    of_state: np.ndarray
    scores: np.ndarray


def precision_of(reduced: "Reduced", units: np.ndarray) -> Precision:
    """Decompose rows without what the states explain.

    Args:
        reduced: Those rows.
        units: Natural units of the numbers.
    """
    scores = (reduced.residual[:, None] @ reduced.of_numbers)[:, 0] / units
    values, directions, covariance = of_numbers(reduced.of_numbers, units)
    states = reduced.states
    half = states.half
    seen = np.where(states.shown[:, None], half, 0.0)
    return Precision(
        values=values,
        directions=directions,
        covariance=covariance,
        local=half @ np.swapaxes(half, 1, 2),
        sensitivity=-(seen @ reduced.along) / units,
        of_state=states.values,
        scores=scores,
    )


class Reduced(NamedTuple):
    """Weighted rows, without what changes of the states and own numbers can do.

    Attributes:
        residual: As it was, weighted (trials, rows).
        of_numbers: Derivatives in natural units, that part removed (trials, rows,
            numbers).
        along: What was removed, in the basis of the states.
        states: The decomposition of the derivatives in the states.
    """

    residual: np.ndarray
    of_numbers: np.ndarray
    along: np.ndarray
    states: "_States"

    def rest(self, columns: np.ndarray) -> np.ndarray:
        """Columns (trials, rows, n) without what changes of the states can do."""
        basis = self.states.basis
        return columns - basis @ (np.swapaxes(basis, 1, 2) @ columns)


def without_states(fit: Fit, rows: Rows, weight: np.ndarray) -> Reduced:
    """Rows as the numbers alone move them.

    Args:
        fit: Where the rows were computed.
        rows: In the first state of each trial, own numbers and numbers.
        weight: Of each row.
    """
    own = fit.minimum.point.own.shape[-1]
    units = fit.minimum.units
    root = np.sqrt(weight)[..., None]
    trials, count, width = rows.residual.shape
    flat = (trials, count * width)
    residual = (root * rows.residual).reshape(flat)
    local = np.concatenate([rows.of_state, rows.of_border[..., :own]], axis=-1)
    local = (root[..., None] * local).reshape(*flat, local.shape[-1])
    shared = root[..., None] * rows.of_border[..., own:]
    # numpy's SVD raises an error for NaN. The status then follows from chi-square.
    shared = np.nan_to_num(shared.reshape(*flat, units.size) * units)
    states = _decomposed(np.nan_to_num(local))
    along = np.swapaxes(states.basis, 1, 2) @ shared
    return Reduced(residual, shared - states.basis @ along, along, states)


class _States(NamedTuple):
    """Singular value decomposition of derivatives in the state and own numbers.

    Attributes:
        basis: Columns of what the record shows of them (trials, rows, local).
        values: Singular values of unit columns, descending.
        shown: Which of them the record shows.
        half: Of the covariance, which is its product with its transpose.
    """

    basis: np.ndarray
    values: np.ndarray
    shown: np.ndarray
    half: np.ndarray


def _decomposed(local: np.ndarray) -> _States:
    """Decompose derivatives (trials, rows, local).

    What the record does not show has large errors.
    """
    # Rates, turns and own numbers have different units, which would decide what counts
    # as small beside the largest singular value.
    scale = or_one(np.linalg.norm(local, axis=1))
    basis, values, vt = np.linalg.svd(local / scale[:, None], full_matrices=False)
    shown = values > SHOWN * values[:, :1]
    eps = np.finfo(local.dtype).eps
    inverse = 1 / np.where(shown, values, eps * np.maximum(values[:, :1], 1.0))
    return _States(
        basis=np.where(shown[:, None], basis, 0.0),
        values=values,
        shown=shown,
        half=np.swapaxes(vt, 1, 2) * inverse[:, None] / scale[:, :, None],
    )


def of_numbers(
    rest: np.ndarray, units: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Singular values, directions and covariance of the numbers.

    Args:
        rest: Derivatives in natural units, without what states can do (trials, rows,
            numbers).
        units: Natural units of the numbers.
    """
    trials, count, _ = rest.shape
    # There may be no numbers, so no length can be left to numpy.
    r = np.linalg.qr(rest.reshape(trials * count, units.size), mode="r")
    # The triangle has the singular values of all rows and is small.
    sound = np.all(np.isfinite(r))
    _, values, vt = np.linalg.svd(r if sound else np.zeros_like(r), full_matrices=False)
    covariance = _covariance(values, vt.T, units if sound else np.nan * units)
    return values, vt.T, covariance


def _covariance(
    values: np.ndarray, directions: np.ndarray, units: np.ndarray
) -> np.ndarray:
    """Covariance of the numbers, by `Precision.values` and its directions."""
    eps = np.finfo(units.dtype).eps
    floor = 16 * eps * np.max(values, initial=0.0) + least_value(units.dtype)
    half = units[:, None] * directions / np.maximum(values, floor)
    return half @ half.T


def least_value(dtype: np.dtype) -> float:
    """The least singular value to divide by: the square of the inverse is finite."""
    # The factor leaves room for sums of such squares.
    return 1e4 * float(np.sqrt(np.finfo(dtype).tiny))


@quality.once_for_each_fit
def reduced(fit: Fit) -> Reduced:
    """Independent rows of a fit, without what changes of the states can do."""
    rows, weight, _ = independent_rows(fit)
    return without_states(fit, rows, weight)


@quality.once_for_each_fit
def precision(fit: Fit) -> Precision:
    """Precision with which a fit determines the numbers."""
    units = fit.minimum.units
    found = precision_of(reduced(fit), units)
    # Rounding leaves less than this of a direction that the record does not show.
    rounding = np.finfo(found.values.dtype).eps ** (2 / 3)
    is_hidden = found.values < rounding * np.max(found.values, initial=0.0)
    if not np.any(is_hidden):
        return found
    is_turn = turns_of(fit.problem.unknowns, fit.minimum.point.numbers)
    bounded = [
        max(value, 1 / _OF_TURN) if hidden and is_turn(units * direction) else value
        for value, hidden, direction in zip(
            found.values, is_hidden, found.directions.T, strict=True
        )
    ]
    values = np.array(bounded, found.values.dtype)
    covariance = _covariance(values, found.directions, units)
    return found._replace(values=values, covariance=covariance)


def turns_of(unknowns: Unknowns, numbers: np.ndarray) -> Callable[[np.ndarray], bool]:
    """Whether a change of the numbers turns the body, and changes no moment."""
    _, moments, axes, slopes = map(np.asarray, spectrum(unknowns, numbers))

    def is_turn(change: np.ndarray) -> bool:
        inside = axes.T @ (slopes @ change) @ axes
        size = np.linalg.norm(inside)
        others = np.linalg.norm(change[unknowns.of_inertia.stop :])
        is_small = size < np.linalg.norm(change) * moments[0] * 1e-3
        if is_small or others > _NO_CHANGE * np.linalg.norm(change):
            return False
        return bool(np.linalg.norm(np.diagonal(inside)) < _NO_CHANGE * size)

    return is_turn
