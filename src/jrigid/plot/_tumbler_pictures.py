"""Parts that pictures of light curves share: a tumbler at times, curves beside it."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from jrigid._checks import check_option, demand
from jrigid._core.compile import quick_jit
from jrigid._core.host_rows import in_batches
from jrigid._types import AnyArray
from jrigid.dynamics import State
from jrigid.free import free_rotation
from jrigid.photometry import (
    AbstractScattering,
    Ellipsoid,
    Facets,
    Inversion,
    LightCurve,
    Tumbler,
    brightness,
)
from jrigid.rotation import rotate_inverse

DAY = 86400.0
# Units of time, the largest first: seconds in one, and its name.
_UNITS = ((DAY, "d"), (3600.0, "h"), (60.0, "min"), (1.0, "s"))
_LEAST_UNITS = 3.0  # of a unit in what is shown by it
# Epochs in one call: programs of one size serve all pictures.
_BLOCK = 512

Numbers = Float[np.ndarray, " epochs"]
Vectors = Float[np.ndarray, "epochs 3"]


class Model(NamedTuple):
    """A tumbler beside light curves.

    Attributes:
        tumbler: The body.
        epoch: Julian date of its time 0.
        noise: Standard deviation of a point [mag], if it is known.
    """

    tumbler: Tumbler
    epoch: float
    noise: float | None


def model_of(
    curves: Sequence[LightCurve],
    model: Inversion | Tumbler,
    alias: int,
    epoch: float | None,
) -> Model:
    """The tumbler that a picture is asked for."""
    message = "Argument `curves` must hold a light curve, but it is empty."
    demand(len(curves) > 0, message)
    if isinstance(model, Tumbler):
        return Model(model, curves[0].epoch if epoch is None else epoch, None)
    check_option("alias", alias, range(len(model.aliases)))
    message = "Argument `epoch` must be left out for an `Inversion`, but it is not."
    demand(epoch is None, message)
    return Model(model.aliases[alias].tumbler, model.epoch, model.noise)


class Points(NamedTuple):
    """All points of light curves and what a model says of them, in the order of time.

    Attributes:
        ts: Times since time 0 of the model [s].
        magnitudes: Of the points, moved by the unknown factors to those of the model.
        predicted: Magnitudes of the model; their mean is 0.
        to_sun: Vectors to the Sun, space axes.
        to_observer: Vectors to the observer, space axes.
        curve: Index of the light curve of each point.
        zero: What was taken off the magnitudes of the model.
    """

    ts: Numbers
    magnitudes: Numbers
    predicted: Numbers
    to_sun: Vectors
    to_observer: Vectors
    curve: np.ndarray
    zero: float

    @property
    def residuals(self) -> Numbers:
        """Points less the model [mag]."""
        return self.magnitudes - self.predicted


def points_of(curves: Sequence[LightCurve], model: Model) -> Points:
    """The points of light curves beside a model."""
    ts = np.concatenate([x.ts + DAY * (x.epoch - model.epoch) for x in curves])
    light = np.concatenate([x.brightness for x in curves])
    positive = bool(np.all(np.isfinite(light) & (light > 0)))
    message = "Argument `curves` must hold positive brightness, but a point is not."
    demand(positive, message)
    to_sun = np.concatenate([x.to_sun for x in curves])
    to_observer = np.concatenate([x.to_observer for x in curves])
    predicted = magnitudes_at(model.tumbler, ts, to_sun, to_observer)
    # The unknown size of the body shifts all magnitudes, so that their mean is
    # arbitrary.
    zero = float(np.mean(predicted))
    predicted = predicted - zero
    magnitudes = -2.5 * np.log10(light)
    # Each relative curve has a factor, and calibrated curves of a band share one.
    keys = [(x.band, i if x.is_relative else -1) for i, x in enumerate(curves)]
    curve = np.repeat(np.arange(len(curves)), [len(x.ts) for x in curves])
    factor = np.array([sorted(set(keys)).index(x) for x in keys])[curve]
    for k in np.unique(factor):
        own = factor == k
        magnitudes[own] -= np.mean(magnitudes[own] - predicted[own])
    order = np.argsort(ts, kind="stable")
    return Points(
        ts=ts[order],
        magnitudes=magnitudes[order],
        predicted=predicted[order],
        to_sun=to_sun[order],
        to_observer=to_observer[order],
        curve=curve[order],
        zero=zero,
    )


def attitudes_at(tumbler: Tumbler, ts: AnyArray) -> Float[np.ndarray, "epochs 4"]:
    """Attitudes of a tumbler at times [s]."""
    state = _state_of(tumbler)
    return in_batches(
        _BLOCK,
        lambda block: _attitudes(tumbler.moments, state, block),
        np.asarray(ts, float),
    )


def magnitudes_at(
    tumbler: Tumbler, ts: AnyArray, to_sun: AnyArray, to_observer: AnyArray
) -> Numbers:
    """Magnitudes of a tumbler, those of unit brightness being 0."""
    light = in_batches(
        _BLOCK,
        lambda *block: _brightness(tumbler.shape, tumbler.scattering, *block),
        attitudes_at(tumbler, ts),
        np.asarray(to_sun, float),
        np.asarray(to_observer, float),
    )
    return -2.5 * np.log10(light)


def between(
    ts: Numbers,
    known: Float[np.ndarray, " known"],
    vectors: Float[np.ndarray, "known 3"],
) -> Vectors:
    """Vectors at times between those at which they are known."""
    return np.stack([np.interp(ts, known, x) for x in vectors.T], axis=1)


def unit_of(seconds: float) -> tuple[float, str]:
    """The unit in which a time is a number that reads well."""
    found = (x for x in _UNITS if seconds >= _LEAST_UNITS * x[0])
    return next(found, _UNITS[-1])


@quick_jit
def _state_of(tumbler: Tumbler) -> State:
    """The state at time 0."""
    return tumbler.state


@jax.jit
def _attitudes(moments: Array, state: State, ts: Array) -> Float[Array, "epochs 4"]:
    """Attitudes of a free body."""
    return free_rotation(moments, state, ts, throw=False).attitude


@quick_jit
def _brightness(
    shape: Ellipsoid | Facets,
    scattering: AbstractScattering,
    attitudes: Array,
    to_sun: Array,
    to_observer: Array,
) -> Float[Array, " epochs"]:
    """Brightness for attitudes and vectors in space axes."""

    def at(attitude: Array, sun: Array, observer: Array) -> Array:
        sun_in_body = rotate_inverse(attitude, sun)
        observer_in_body = rotate_inverse(attitude, observer)
        return brightness(shape, sun_in_body, observer_in_body, scattering)

    return jax.vmap(at)(attitudes, to_sun, to_observer)
