"""Records of a rotating body: a sensor, times, values and their noise."""

from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float
from jaxtyping import ArrayLike as _ArrayLike

from jrigid._checks import (
    RESULTS,
    Findings,
    check_type,
    demand,
    float_arrays,
    is_concrete,
)
from jrigid._types import AnyArray, Readable, Real, VectorLike
from jrigid.identify import _sensors as sensors

Times = Real[_ArrayLike, "*trials n"]
Values = Real[_ArrayLike, "*trials n k"] | None
Noise = Real[_ArrayLike, "..."] | None


class Record(Readable):
    """Times, values and noise of one sensor, in one trial or in several.

    NaN, infinity, or an entry that numpy masks, stands for "not seen". It may stand in
    a component of `values`, in a whole row, or in `ts` and its row (padding, which
    brings trials to one length). Then that number is left out, or the whole sample
    where its components belong together: in attitudes, in directions and beside a
    `covariance`. What was not seen weighs nothing, and its `sigma` may be NaN. It costs
    as much time as any sample.

    Attributes:
        sensor: What showed the values.
        ts: Times [s] (n,), increasing among the samples seen, their origin that of `t0`
            elsewhere; with an axis of trials in front, (trials, n).
        values: One row for each time (n, k). A plan needs none and takes None.
        sigma: Standard deviation of the noise, in units of the residual: one number for
            all, (k,) for each component, (n,) for each sample, or (n, k), which is how
            it is stored. None where it is not known: `fit` takes it from the residuals.
        covariance: Of the components of a sample, (k, k) or (n, k, k), stored as the
            latter; then no `sigma`.

    Raises:
        ValueError: Shapes that do not belong together.

    >>> import jrigid as jr
    >>> seen = jr.datasets.gyro_example()
    >>> record = jr.identify.Record(jr.identify.Gyro(), seen.times, seen.omegas, 0.01)
    >>> print(record.values.shape)
    (200, 3)
    """

    sensor: sensors.AbstractSensor
    ts: Float[Array, "*trials n"]
    values: Float[Array, "*trials n k"]
    sigma: Float[Array, "..."] | None
    covariance: Float[Array, "..."] | None

    def __init__(
        self,
        sensor: sensors.AbstractSensor,
        ts: Times,
        values: Values,
        sigma: Noise = None,
        *,
        covariance: Noise = None,
    ):
        """Values of a sensor with noise `sigma` or `covariance`."""
        check_type("sensor", sensor, sensors.AbstractSensor)
        of = f"of `{type(sensor).__name__}` must"
        self.sensor = sensor
        self.ts, self.values = _times_and_values(sensor, ts, values, of)
        demand(
            sigma is None or covariance is None,
            f"Arguments `sigma` and `covariance` {of} not both be given, but they are.",
        )
        demand(
            # The probability of a saturated number is computed for that number alone,
            # which asks for independent noise.
            covariance is None or sensor.saturation() is None,
            f"Argument `covariance` {of} not be given beside a sensor's `limit`, but "
            "it is: give `sigma`.",
        )
        shape = (*self.ts.shape, self.degrees)
        self.sigma = None if sigma is None else _sigma(sigma, shape, of)
        self.covariance = None
        if covariance is not None:
            self.covariance = _covariance(covariance, shape, of)

    @property
    def degrees(self) -> int:
        """Numbers of a residual."""
        return (
            self.values.shape[-1]
            if self.sensor.degrees is None
            else self.sensor.degrees
        )

    @property
    def states_noise(self) -> bool:
        """Whether the noise is stated."""
        return self.sigma is not None or self.covariance is not None

    @property
    def known(self) -> AnyArray:
        """Whether each number of the residual was seen."""
        xp = self.values.__array_namespace__()
        is_finite = xp.isfinite(self.values) & xp.isfinite(self.ts)[..., None]
        if self.sensor.degrees is None and self.covariance is None:
            return is_finite
        whole = xp.all(is_finite, axis=-1, keepdims=True)
        # A residual may have fewer numbers than its value: that of a quaternion has
        # three.
        return xp.repeat(whole, self.degrees, axis=-1)

    def with_values(self, values: Array) -> "Record":
        """The record with other values, where there are times."""
        values = jnp.where(jnp.isfinite(self.ts)[..., None], values, jnp.nan)
        return eqx.tree_at(lambda x: x.values, self, values)


def _times_and_values(
    sensor: sensors.AbstractSensor, ts: Times, values: Values, of: str
) -> tuple[Array, Array]:
    """Times (..., n) and values (..., n, k) as arrays of one dtype.

    Args:
        sensor: What showed the values.
        ts: Times [s].
        values: None in a plan.
        of: Words for errors, after the name of an argument.
    """
    width = sensor.width
    if values is None:
        demand(width is not None, f"Argument `values` {of} be given, but it is None.")
        (ts,) = float_arrays(ts)
        # Of unit length, for sensors whose values are.
        values = jnp.ones((*ts.shape, width or 0), ts.dtype) / (width or 1) ** 0.5
    if isinstance(values, np.ma.MaskedArray):
        # JAX would drop the mask and take the numbers below it.
        values = np.ma.filled(values.astype(float), np.nan)
    ts, values = float_arrays(ts, values)
    demand(
        ts.ndim in (1, 2)
        and values.ndim == ts.ndim + 1
        and values.shape[:-1] == ts.shape,
        f"Arguments `ts` and `values` {of} have shapes (n,) and (n, k), but they have "
        f"shapes {ts.shape} and {values.shape}.",
    )
    demand(
        width in (None, values.shape[-1]),
        f"Argument `values` {of} have {width} columns, but it has {values.shape[-1]}.",
    )
    return ts, values


def _sigma(sigma: Any, shape: tuple[int, ...], of: str) -> Array:
    """Standard deviations of each component of each sample, (..., n, k)."""
    (sigma,) = float_arrays(sigma)
    *of_ts, k = shape
    n = of_ts[-1]
    of_components = ((), (k,), (n, k), shape)
    of_samples = ((n,), tuple(of_ts))
    demand(
        sigma.shape in of_components + of_samples,
        f"Argument `sigma` {of} have shape (), ({k},), ({n},) or ({n}, {k}), but it "
        f"has shape {sigma.shape}.",
    )
    # Where there are as many samples as components, one number for each component is
    # meant.
    if sigma.shape in of_samples and sigma.shape != (k,):
        sigma = sigma[..., None]
    return _repeated(sigma, shape)


def _covariance(covariance: Any, shape: tuple[int, ...], of: str) -> Array:
    """Covariances of the components of each sample, (..., n, k, k)."""
    (covariance,) = float_arrays(covariance)
    *_, n, k = shape
    demand(
        covariance.shape in ((k, k), (n, k, k), (*shape, k)),
        f"Argument `covariance` {of} have shape ({k}, {k}) or ({n}, {k}, {k}), but it "
        f"has shape {covariance.shape}.",
    )
    return _repeated(covariance, (*shape, k))


def _repeated(x: Array, shape: tuple[int, ...]) -> Array:
    """Broadcast, without a compiled program where the numbers are known."""
    if not is_concrete(x):
        return jnp.broadcast_to(x, shape)
    return jnp.asarray(np.broadcast_to(np.asarray(x), shape))


def Rates(ts: Times, values: Values, sigma: Noise = None, **noise: Any) -> Record:
    """The record of a perfect `Gyro`: angular velocities along its axes [rad/s].

    Times are in seconds and `sigma` is in rad/s, as for `Record`.

    >>> import jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> print(jr.identify.Rates(record.times, record.omegas, record.sigma).values.shape)
    (200, 3)
    """
    return Record(sensors.Gyro(), ts, values, sigma, **noise)


def Attitudes(ts: Times, values: Values, sigma: Noise = None, **noise: Any) -> Record:
    """The record of an `AttitudeSensor`: unit quaternions.

    The noise is in radians about the body axes.

    >>> import jrigid as jr
    >>> record = jr.datasets.toutatis_1992()
    >>> print(jr.identify.Attitudes(record.times, record.attitudes, 0.1).values.shape)
    (18, 4)
    """
    return Record(sensors.AttitudeSensor(), ts, values, sigma, **noise)


def Directions(
    ts: Times,
    values: Values,
    sigma: Noise = None,
    *,
    of: VectorLike,
    frame: str = "body",
    **noise: Any,
) -> Record:
    """The record of a `DirectionSensor`: unit vectors, noise in radians across them.

    With `frame="body"` the values are body components of `of`, a vector in space axes;
    with `frame="space"` space components of `of`, a vector in body axes.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> star = jnp.array([1.0, 0.0, 0.0])
    >>> values = jnp.tile(star, (5, 1))
    >>> record = jr.identify.Directions(jnp.arange(5.0), values, 1e-3, of=star)
    """
    sensor = sensors.DirectionSensor(float_arrays(of)[0], frame)
    return Record(sensor, ts, values, sigma, **noise)


def AngularMomenta(
    ts: Times,
    values: Values,
    sigma: Noise = None,
    *,
    frame: str = "space",
    **noise: Any,
) -> Record:
    """The record of a `MomentumSensor` [kg m^2/s].

    It sets the scale of the inertia: `fit(..., scale="known")`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record = jr.identify.AngularMomenta(
    ...     jnp.arange(4.0), jnp.ones((4, 3)), 1e-3, frame="body")
    """
    return Record(sensors.MomentumSensor(frame), ts, values, sigma, **noise)


def Observed(
    function: Callable[[Any, Any, Any], Any],
    ts: Times,
    values: Values,
    sigma: Noise = None,
    *,
    depends_on_attitude: bool = True,
    **noise: Any,
) -> Record:
    """The record of a `FunctionSensor`: any function `(t, state, system) -> (k,)`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> def spin(t, state, system):
    ...     return state.omega[2:]
    >>> record = jr.identify.Observed(spin, jnp.arange(4.0), jnp.ones((4, 1)), 0.01)
    """
    return Record(
        sensors.FunctionSensor(function, depends_on_attitude),
        ts,
        values,
        sigma,
        **noise,
    )


def one_after_another(sizes: Iterable[int]) -> list[slice]:
    """Slices of parts of these sizes, one after another."""
    ends = [0, *accumulate(sizes)]
    return list(map(slice, ends, ends[1:]))


def first_and_last(ts: AnyArray, there: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Times of the first and last samples of each trial; zero if there are none."""
    xp = ts.__array_namespace__()
    first = xp.min(xp.where(there, ts, xp.inf), axis=1)
    last = xp.max(xp.where(there, ts, -xp.inf), axis=1)
    return xp.where(xp.isfinite(first), first, 0.0), xp.where(
        xp.isfinite(last), last, 0.0
    )


class Samples(NamedTuple):
    """All records as a fit reads them, side by side.

    Arrays are finite, and of weight zero where nothing was seen.
    Residuals have as many numbers as the widest record's, D. `whitener` (trials, n, D,
    D) turns one into units of its noise; `sign` (trials, n, D) is that of a saturated
    number, 0 elsewhere.
    """

    ts: AnyArray  # (trials, n)
    values: tuple[AnyArray, ...]  # of each record
    whitener: AnyArray
    weight: AnyArray  # (trials, n, D)
    sign: AnyArray

    @property
    def seen(self) -> AnyArray:
        """Whether each sample was seen, at least in part."""
        return (self.weight > 0).any(axis=-1)

    @property
    def parts(self) -> list[slice]:
        """Slice of each record's samples."""
        return one_after_another(x.shape[-2] for x in self.values)


def samples_of(records: Sequence[Record], guess: AnyArray) -> Samples:
    """Records as a fit reads them; a noise that is not known is `guess`.

    Of records with numpy arrays (`lengthened`, `on_host`) the samples are numpy arrays
    too.
    """
    width = max(x.degrees for x in records)
    values, *rest = zip(*(_normalised(x, guess, width) for x in records), strict=True)
    xp = records[0].values.__array_namespace__()
    ts, whitener, weight, sign = (xp.concatenate(x, axis=1) for x in rest)
    is_seen = xp.any(weight > 0, axis=-1)
    # Missing times become finite, since NaN would spread to the motion and its
    # derivatives.
    ts = xp.where(is_seen, ts, first_and_last(ts, is_seen)[0][:, None])
    return Samples(ts, values, whitener, weight, sign)


def _normalised(record: Record, guess: AnyArray, width: int) -> tuple[AnyArray, ...]:
    """Values, times, whitener, weight and sign of a record.

    The last three are as wide as those of the widest record.
    """
    known = record.known
    values = record.values
    xp = values.__array_namespace__()
    is_seen = xp.any(known, axis=-1, keepdims=True)
    # A value that was not seen is zero, or the first unit vector.
    is_first = xp.arange(values.shape[-1]) == 0
    one = xp.ones((), values.dtype)
    harmless = xp.where(is_first & record.sensor.unit_length, one, 0.0)
    values = xp.where(is_seen & xp.isfinite(values), values, harmless)
    whitener = _whitener(record, known, guess)
    weight = known.astype(values.dtype)
    sign = _saturation_sign(record, known, values)
    if record.degrees < width:
        pad = [(0, 0), (0, 0), (0, width - record.degrees)]
        weight = xp.pad(weight, pad)
        sign = xp.pad(sign, pad)
        whitener = xp.pad(whitener, [*pad, pad[-1]])
    return values, record.ts, whitener, weight, sign


def _whitener(record: Record, known: AnyArray, guess: AnyArray) -> AnyArray:
    """Matrices that turn a residual into units of its noise (trials, n, k, k)."""
    xp = record.values.__array_namespace__()
    dtype = record.values.dtype
    eye = xp.eye(record.degrees, dtype=dtype)
    eye = xp.broadcast_to(eye, (*known.shape, record.degrees))
    if record.covariance is not None:
        is_seen = xp.any(known, axis=-1)[..., None, None]
        return _inverse_factor(xp.where(is_seen, record.covariance, eye))
    # The noise of what was not seen may be NaN.
    sigma = xp.where(known, guess if record.sigma is None else record.sigma, 1.0)
    return eye / sigma[..., None].astype(dtype)


def _saturation_sign(record: Record, known: AnyArray, values: AnyArray) -> AnyArray:
    """The sign of each number that is saturated, 0 elsewhere."""
    xp = values.__array_namespace__()
    largest = record.sensor.saturation()
    if largest is None:
        return xp.zeros(known.shape, values.dtype)
    # The limit itself may have been rounded.
    least = xp.asarray(largest, values.dtype) * (1 - 1e-6)
    least = xp.broadcast_to(least, values.shape)
    return xp.where(known & (xp.abs(values) >= least), xp.sign(values), 0.0)


def _inverse_factor(covariance: AnyArray) -> AnyArray:
    """L^-1 of covariances L L^T (..., k, k), with L lower triangular.

    It is NaN where there is no L.
    By Gram and Schmidt: its rows are orthonormal in the product that the covariance
    makes.
    """
    xp = covariance.__array_namespace__()
    eye = xp.eye(covariance.shape[-1], dtype=covariance.dtype)
    rows = []
    for i, unit in enumerate(eye):
        row = xp.broadcast_to(unit, covariance.shape[:-1])
        for other in rows:
            row = (
                row
                - xp.sum(covariance[..., i, :] * other, axis=-1, keepdims=True) * other
            )
        image = xp.sum(covariance * row[..., None, :], axis=-1)
        rows.append(row / xp.sqrt(xp.sum(row * image, axis=-1, keepdims=True)))
    return xp.stack(rows, axis=-2)


def of_trials(observations: Any) -> tuple[Record, ...]:
    """Records with an axis of trials in front, and sensors that know when they begin.

    Trials of a list are filled up with NaN to one length. A single trial makes an axis
    of length one.
    """
    if isinstance(observations, list):
        trials = [_as_tuple(x) for x in observations]
        demand(bool(trials), "Argument `observations` must not be empty, but it is.")
        kinds = [[jtu.tree_structure(x.sensor) for x in trial] for trial in trials]
        demand(
            all(x == kinds[0] for x in kinds),
            "Argument `observations` must hold records of the same sensors for each "
            "trial, but it does not.",
        )
        return tuple(_stacked(x) for x in zip(*trials, strict=True))
    single = _as_tuple(observations)
    shapes = {x.ts.shape[:-1] for x in single}
    demand(
        len(shapes) == 1,
        f"Arguments `observations` must have the same trials, but they have {shapes}.",
    )
    if shapes == {()}:
        return tuple(_stacked([x]) for x in single)
    return tuple(_with_arrays(x, _arrays(x)) for x in single)


def _arrays(record: Record) -> list[Any]:
    """Times, values, sigma and covariance; the last two may be None."""
    return [record.ts, record.values, record.sigma, record.covariance]


def _with_arrays(record: Record, arrays: list[Any]) -> Record:
    """The record with other arrays, and a sensor that knows when the record begins."""
    ts = arrays[0]
    times = np.asarray(ts) if is_concrete(ts) else ts
    xp = times.__array_namespace__()
    # The drift of a gyro counts from here, in all trials from the same time.
    first = xp.min(xp.where(xp.isfinite(times), times, xp.inf))
    first = jnp.asarray(xp.where(xp.isfinite(first), first, 0.0), times.dtype)
    # `sigma` and `covariance` may be None, which is no leaf unless it is declared one.
    return eqx.tree_at(
        lambda x: [x.sensor, *_arrays(x)],
        record,
        [record.sensor.started_at(first), *arrays],
        is_leaf=lambda x: x is None,
    )


def rounded(count: int) -> int:
    """The number of samples to which a record is filled up.

    Few compiled programs then serve all lengths. Where more samples cost little it is
    16, 64 or 256; above, a power of two or half as much again.
    """
    if count <= 256:
        return next(x for x in (16, 64, 256) if count <= x)
    power = 1 << (count - 1).bit_length()
    return 3 * power // 4 if count <= 3 * power // 4 else power


def tells(record: Record, what: str) -> bool:
    """Whether its sensor has a method of its own for "rates" or "attitude"."""
    return getattr(type(record.sensor), what) is not getattr(
        sensors.AbstractSensor, what
    )


def lengthened(record: Record) -> Record:
    """The record with unseen samples added at its end; its arrays are numpy's."""
    more = rounded(record.ts.shape[-1]) - record.ts.shape[-1]

    def filled(x: Any, axis: int) -> Any:
        x = np.asarray(x)
        shape = list(x.shape)
        shape[axis] = more
        return np.concatenate([x, np.full(shape, np.nan, x.dtype)], axis)

    arrays = [None if x is None else filled(x, 1) for x in _arrays(record)]
    return eqx.tree_at(_arrays, record, arrays, is_leaf=lambda x: x is None)


def _as_tuple(observations: Any) -> tuple[Record, ...]:
    if isinstance(observations, Record):
        return (observations,)
    demand(
        isinstance(observations, Sequence) and len(observations) > 0,
        "Argument `observations` must be a record (jr.identify.Rates, ...), a tuple of "
        "them, or a list with one entry for each trial, but it is "
        f"{type(observations).__name__}.",
    )
    for x in observations:
        check_type("observations", x, Record)
    return tuple(observations)


def _stacked(parts: Sequence[Record]) -> Record:
    """One record of all trials; shorter ones are filled up with NaN."""
    demand(
        all(x.ts.ndim == 1 for x in parts),
        "Argument `observations` must hold times of shape (n,) for each trial of a "
        "list, but it does not.",
    )
    demand(
        all(_same(x.sensor, parts[0].sensor) for x in parts),
        "Argument `observations` must have the same sensor in every trial of a list, "
        "but it has not: `jr.identify.each` seeks an error anew in each trial.",
    )
    demand(
        len({jtu.tree_structure(_arrays(x)) for x in parts}) == 1,
        "Argument `observations` must state the noise for all trials or for none, but "
        "it does for some.",
    )
    longest = max(x.ts.size for x in parts)

    columns = zip(*map(_arrays, parts), strict=True)
    arrays = [None if x[0] is None else _stack(x, longest) for x in columns]
    return _with_arrays(parts[0], arrays)


def _stack(trials: Sequence[Array], longest: int) -> Array:
    """Stack arrays of trials, shorter ones filled up with NaN."""
    xp = jnp
    rows = list(trials)
    if all(map(is_concrete, trials)):
        # NumPy needs no compiled program for each length.
        xp = np
        rows = [np.asarray(x) for x in trials]
    filled = []
    for row in rows:
        missing = [(0, longest - row.shape[0])] + [(0, 0)] * (row.ndim - 1)
        short = missing[0][1] > 0
        filled.append(xp.pad(row, missing, constant_values=np.nan) if short else row)
    return jnp.asarray(xp.stack(filled))


def _same(a: Any, b: Any) -> bool:
    """Whether two sensors are equal, as far as that is known now."""
    pairs = zip(jtu.tree_leaves(a), jtu.tree_leaves(b), strict=True)
    unlike = (
        not jnp.array_equal(x, y) for x, y in pairs if is_concrete(x) and is_concrete(y)
    )
    return a is b or not any(unlike)


def check_records(findings: Findings, records: tuple[Record, ...]) -> None:
    """Note what is wrong with values, times and noise of records with numpy arrays."""
    code = RESULTS.invalid_observations
    for x in records:
        of = f"of `{type(x.sensor).__name__}` must"
        known = x.known
        is_seen = np.any(known, axis=-1)
        text = f"Argument `values` {of} hold values, but all are NaN."
        findings.require(np.any(known), code, text)
        text = (
            f"Argument `ts` {of} be finite where there are values, and increasing, "
            "each time once, but it is not."
        )
        findings.require(_is_ordered(x, is_seen), RESULTS.invalid_times, text)
        text = f"Arguments `sigma` and `covariance` {of} be positive, but one is not."
        findings.require(_is_noise(x, known), code, text)
        if x.sensor.unit_length:
            text = f"Argument `values` {of} be of unit length, but one is not."
            findings.require(_is_unit(x, is_seen), code, text)
    # A tensor without its scale has 5 numbers, and a state has at most 6.
    enough = np.bool_(sum(np.sum(x.known) for x in records) >= 12)
    text = "hold more numbers than a body and its state have, but it holds too few."
    findings.require(enough, code, f"Argument `observations` must {text}")


def _is_ordered(x: Record, is_seen: np.ndarray) -> np.bool_:
    """Whether times of samples increase, and are there where values are."""
    # Each time is compared with the latest one before, since samples between may be
    # missing.
    before = np.maximum.accumulate(np.where(is_seen, x.ts, -np.inf), axis=1)
    increasing = np.all(~is_seen[:, 1:] | (x.ts[:, 1:] > before[:, :-1]))
    without_time = ~np.isfinite(x.ts) & np.all(np.isfinite(x.values), axis=-1)
    return increasing & ~np.any(without_time)


def _is_unit(x: Record, is_seen: np.ndarray) -> np.bool_:
    """Whether values are of unit length: quaternions closely, directions roughly."""
    square = np.sum(np.where(is_seen[..., None], x.values, 0.0) ** 2, axis=-1)
    near = 1e-3 if x.values.shape[-1] == 4 else 0.5
    return np.all(~is_seen | (np.abs(square - 1) < near))


def _is_noise(x: Record, known: AnyArray) -> np.bool_:
    """Whether `sigma` is positive, or `covariance` positive definite, where seen."""
    if x.covariance is not None:
        is_seen = np.any(known, axis=-1)[..., None, None]
        noise = np.where(is_seen, x.covariance, np.eye(x.degrees, dtype=x.values.dtype))
        even = np.abs(noise - np.swapaxes(noise, -1, -2)) <= 1e-6 * np.abs(noise)
        # The factor is NaN where the covariance is not positive definite.
        return np.all(even) & np.all(np.isfinite(_inverse_factor(noise)))
    if x.sigma is None:
        return np.True_
    return np.all(~known | ((x.sigma > 0) & np.isfinite(x.sigma)))
