"""Light curves for a fit: one whitened vector, and columns for unknown factors."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from jrigid._checks import demand
from jrigid._numerics import product
from jrigid._types import AnyArray
from jrigid.photometry._damit_files import LightCurve

# Natural logarithm of the brightness in one magnitude.
MAGNITUDE = 0.4 * np.log(10.0)
_DAY = 86400.0
EPOCHS = 128  # arrays are filled up to whole blocks of epochs
_FACTORS = 16  # and of unknown factors
# Of a column of the basis, in the epochs that were chosen; its size in all is 1.
_LEAST_SIZE = 1e-9
# Of the sum of the unit vectors to the Sun and the observer, which is zero where the
# body shows its dark side.
_LEAST_LIT = 1e-6
# Epochs further apart [d] are Julian dates and modified ones.
_LONGEST_AGE = 1e6
# Standard deviations of chi-square, and of a correlation, that are no chance.
_SURE = 4.0


class Readings(NamedTuple):
    """Logarithms of the brightness of all curves, over their noise.

    Each relative curve has an unknown factor, and calibrated curves share one. They
    are a part of the model that is linear, and a projection removes them exactly.

    Rows without weight and columns of zeros fill the arrays up to a few sizes, so that
    one compiled program serves many sets of curves.

    Attributes:
        ts: Times since the middle of the observations [s].
        to_sun: Unit vectors to the Sun, space axes.
        to_observer: Unit vectors to the observer, space axes.
        values: Logarithm of the brightness over the noise, projected.
        weights: 1 over the noise of the logarithm.
        basis: Orthonormal columns that span what the projection removes.
        span: Time from the first epoch to the last [s].
    """

    ts: Float[AnyArray, " epochs"]
    to_sun: Float[AnyArray, "epochs 3"]
    to_observer: Float[AnyArray, "epochs 3"]
    values: Float[AnyArray, " epochs"]
    weights: Float[AnyArray, " epochs"]
    basis: Float[AnyArray, "epochs factors"]
    span: Float[AnyArray, ""]

    def projected(self, logarithms: Float[Array, " epochs"]) -> Float[Array, " epochs"]:
        """Logarithms over the noise, without the unknown factors."""
        whitened = logarithms * self.weights
        return whitened - self.factors(whitened)

    def factor_count(self) -> int:
        """Number of unknown factors."""
        # Columns of zeros fill the array up to a few sizes.
        return int(np.count_nonzero(np.any(self.basis != 0, axis=0)))

    def in_magnitudes(
        self, rows: Float[np.ndarray, " epochs"]
    ) -> Float[np.ndarray, " points"]:
        """Residuals of the points [mag], from those of the logarithm over the noise."""
        there = self.weights > 0
        # A magnitude falls where the logarithm of the brightness grows.
        return -rows[there] / (self.weights[there] * MAGNITUDE)

    def typical_noise(self) -> float:
        """Median of the standard deviations of the points [mag]."""
        # Rows that only fill the arrays have no weight.
        there = np.asarray(self.weights)[np.asarray(self.weights) > 0]
        return float(np.median(1 / (MAGNITUDE * there)))

    def factors(self, whitened: Float[Array, " epochs"]) -> Float[Array, " epochs"]:
        """The part of a whitened vector that unknown factors explain."""
        return product("ef,f->e", self.basis, product("ef,e->f", self.basis, whitened))


def stated_noise(
    curves: Sequence[LightCurve], noise: float | None
) -> float | Float[np.ndarray, " epochs"] | None:
    """The noise that is given, or else that which all curves state, or else None.

    Raises:
        ValueError: Errors of a curve that are not positive, or not one for each point.
    """
    errors = [np.asarray(x.errors) for x in curves if x.errors is not None]
    if noise is not None or not curves or len(errors) < len(curves):
        return noise
    for curve, of_curve in zip(curves, errors, strict=True):
        demand(
            of_curve.shape == np.shape(curve.ts)
            and bool(np.all(np.isfinite(of_curve) & (of_curve > 0))),
            "Argument `curves` must have positive `errors`, one for each point, but a "
            "curve has not: pass `noise`, or leave out such points.",
        )
    return np.concatenate(errors)


def readings_of(
    curves: Sequence[LightCurve], noise: float | Float[np.ndarray, " epochs"]
) -> tuple[Readings, float]:
    """All curves in one vector.

    Args:
        curves: At least one, with three points or more in all.
        noise: Standard deviation of each point [mag], one for all or for each.

    Returns:
        The readings, and the Julian date of their time 0.

    Raises:
        ValueError: Curves from which nothing follows.
    """
    demand(
        len(curves) > 0, "Argument `curves` must hold a light curve, but it is empty."
    )
    _check_curves(curves)
    _check_epochs(curves)
    demand(
        bool(np.all((noise > 0) & np.isfinite(noise))),
        f"Argument `noise` must be positive and finite, but it is {noise}.",
    )
    epoch = curves[0].epoch
    ts = np.concatenate([np.asarray(x.ts) + (x.epoch - epoch) * _DAY for x in curves])
    # Seen from the middle of the span, errors of the frequencies are hardly correlated
    # with those of the phases.
    middle = (ts.min() + ts.max()) / 2
    brightness = np.concatenate([x.brightness for x in curves])
    demand(
        bool(np.all(np.isfinite(brightness) & (brightness > 0))),
        "Argument `curves` must hold positive brightness, but a point is not positive.",
    )
    weights = np.broadcast_to(1 / (noise * MAGNITUDE), ts.shape)
    basis = _basis(curves, weights)
    whitened = np.log(brightness) * weights
    readings = Readings(
        ts=ts - middle,
        to_sun=_unit(np.concatenate([x.to_sun for x in curves])),
        to_observer=_unit(np.concatenate([x.to_observer for x in curves])),
        values=whitened - basis @ (basis.T @ whitened),
        weights=weights,
        basis=basis,
        span=np.asarray(np.ptp(ts)),
    )
    return filled(readings), epoch + middle / _DAY


def _check_curves(curves: Sequence[LightCurve]) -> None:
    """Raise ValueError for curves without points or directions, and for magnitudes."""
    for index, curve in enumerate(curves):
        count = np.size(curve.ts)
        vectors = [np.asarray(x) for x in (curve.to_sun, curve.to_observer)]
        demand(
            count > 0
            and np.shape(curve.brightness) == (count,)
            and all(x.shape == (count, 3) for x in vectors),
            f"Curve {index} of `curves` must have a point or more, and a brightness "
            "and two vectors for each point, but it has not.",
        )
        lengths = np.linalg.norm(vectors, axis=-1)
        demand(
            bool(np.all(np.isfinite(curve.ts)))
            and bool(np.all(np.isfinite(lengths) & (lengths > 0))),
            f"Curve {index} of `curves` must have finite times and vectors other than "
            "0, but it has not.",
        )
        sums = _unit(vectors[0]) + _unit(vectors[1])
        demand(
            bool(np.all(np.linalg.norm(sums, axis=1) > _LEAST_LIT)),
            f"Curve {index} of `curves` must show a body that is lit, but at a point "
            "the Sun is straight behind it: are both vectors from the body?",
        )
    # A body of some metres has brightness of this size, too, but hardly in every curve.
    demand(
        not all(curve.has_magnitudes for curve in curves),
        "Argument `curves` must hold brightness, but it looks like magnitudes m: take "
        "10^(-0.4 m). Fluxes may be divided by any number.",
    )


def check_threshold(threshold: float) -> None:
    """Raise ValueError unless the best of a search is within its threshold."""
    demand(
        threshold >= 0,
        f"Argument `threshold` must not be negative, but is {threshold}.",
    )


def phase_angles(curve: LightCurve) -> Float[np.ndarray, " epochs"]:
    """Angles between the Sun and the observer, seen from the body [rad]."""
    sun, observer = (_unit(np.asarray(x)) for x in (curve.to_sun, curve.to_observer))
    return np.arccos(np.clip(np.sum(sun * observer, axis=-1), -1.0, 1.0))


def _check_epochs(curves: Sequence[LightCurve]) -> None:
    """Raise ValueError for epochs that are not dates of one kind."""
    epochs = np.array([x.epoch for x in curves], float)
    demand(
        bool(np.all(np.isfinite(epochs)) and np.ptp(epochs) < _LONGEST_AGE),
        "Argument `curves` must have Julian dates as epochs, but they are from "
        f"{epochs.min()} to {epochs.max()}: are some modified Julian dates?",
    )


def check_list(curves: Sequence[LightCurve]) -> None:
    """Raise ValueError for a single light curve in place of a list."""
    demand(
        not isinstance(curves, LightCurve),
        "Argument `curves` must be a list of light curves, but it is one: pass a list "
        "of one.",
    )


def follows(
    residuals: Float[np.ndarray, " points"],
    curves: Sequence[LightCurve],
    reduced: float,
    freedom: int,
    stated: bool,
) -> tuple[float, bool]:
    """Whether what a fit leaves of light curves is no more than noise.

    Args:
        residuals: Of all points, in the order of the curves [mag].
        curves: The curves.
        reduced: Chi-square over its degrees of freedom.
        freedom: These.
        stated: Whether the noise was stated.

    Returns:
        The correlation of residuals at neighbouring points, and whether the fit follows
        the curves.
    """
    correlation, deviations = _correlation(residuals, curves)
    # Of noise it is 1, with a standard deviation of sqrt(2 / freedom).
    chance = _SURE * np.sqrt(2 / freedom)
    if stated and reduced > 1 - chance:
        return correlation, bool(reduced < 1 + chance)
    # A noise that was found makes chi-square over its degrees of freedom 1, and one
    # that was stated too large may hide a misfit, which neighbouring points share.
    return correlation, deviations <= _SURE


def _correlation(
    residuals: Float[np.ndarray, " points"], curves: Sequence[LightCurve]
) -> tuple[float, float]:
    """Correlation of residuals at points of a curve that follow each other in time.

    Returns:
        The correlation, and how many standard deviations it is above that of noise.
    """
    ends = np.cumsum([len(x.ts) for x in curves])
    in_order = [
        of_curve[np.argsort(np.asarray(curve.ts), kind="stable")]
        for of_curve, curve in zip(np.split(residuals, ends[:-1]), curves, strict=True)
    ]
    products = np.concatenate([x[1:] * x[:-1] for x in in_order])
    if products.size == 0 or not np.any(residuals):
        return 0.0, 0.0
    correlation = np.mean(products) / np.mean(residuals**2)
    # The correlation of n pairs of white residuals scatters by 1 / sqrt(n).
    return float(correlation), float(correlation * np.sqrt(products.size))


def noise_in_words(noise: float, is_found: bool) -> str:
    """The noise in magnitudes, and whence it is."""
    found = ", found from what the fit leaves" if is_found else ""
    return f"{noise:.4f} mag{found}"


def orthonormal(
    columns: Float[np.ndarray, "rows columns"],
) -> Float[np.ndarray, "rows columns"]:
    """Orthonormal columns that span the same, or zero: rows of a basis are no basis."""
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return left * (sizes > _LEAST_SIZE)


def filled(readings: Readings) -> Readings:
    """The readings, filled up to whole blocks of epochs and of factors."""
    count, factors = readings.basis.shape
    rows = -count % EPOCHS
    basis = np.pad(readings.basis, ((0, rows), (0, -factors % _FACTORS)))
    return Readings(
        ts=np.pad(readings.ts, (0, rows)),
        # A row without weight still needs directions.
        to_sun=np.pad(readings.to_sun, ((0, rows), (0, 0)), mode="edge"),
        to_observer=np.pad(readings.to_observer, ((0, rows), (0, 0)), mode="edge"),
        values=np.pad(readings.values, (0, rows)),
        weights=np.pad(readings.weights, (0, rows)),
        basis=basis,
        span=readings.span,
    )


def _basis(curves: Sequence[LightCurve], weights: np.ndarray) -> np.ndarray:
    """Orthonormal columns for the factor of each relative curve and of all others."""
    keys = [(x.band, index if x.is_relative else -1) for index, x in enumerate(curves)]
    known = sorted(set(keys))
    of_curve = np.array([known.index(key) for key in keys])
    of_point = np.repeat(of_curve, [len(x.ts) for x in curves])
    # A factor adds a constant to the logarithms, which whitening multiplies by the
    # weights. No point has two factors, so that the columns are orthogonal.
    columns = (of_point[:, None] == np.arange(len(known))) * weights[:, None]
    return columns / np.linalg.norm(columns, axis=0)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors over their lengths."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
