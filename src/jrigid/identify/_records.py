"""What was seen of a rotating body: a sensor, times, values and their noise, one throw or many."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float
from jaxtyping import ArrayLike as _ArrayLike

from jrigid._checks import RESULTS, Findings, check_type, demand, float_arrays, is_concrete
from jrigid._types import Readable, Real, VectorLike
from jrigid.identify._sensors import (
    AbstractSensor,
    AttitudeSensor,
    DirectionSensor,
    FunctionSensor,
    Gyro,
    MomentumSensor,
)

Times = Real[_ArrayLike, "*throws n"]
Values = Real[_ArrayLike, "*throws n k"] | None
Noise = Real[_ArrayLike, "..."] | None


class Record(Readable):
    """What a sensor showed at some times, and how well.

    NaN stands for "not seen": in a component of `values` (that number is left out; the whole sample
    where the components hang together, in attitudes, directions and beside a `covariance`), in a
    whole row, or in `ts` and its row (padding, which brings throws to one length). What was not
    seen weighs nothing, and its `sigma` may be NaN; it costs what any sample costs.

    Attributes:
        sensor: What showed the values.
        ts: Times [s] (n,), increasing among the samples seen, their origin that of `t0` elsewhere;
            with an axis of throws in front, (throws, n).
        values: One row for each time (n, k); a plan, whose values play no role, takes None.
        sigma: Standard deviation of the noise, in units of the residual: one number for all, (k,)
            for each component, (n,) for each sample, or (n, k); kept as (n, k). None where it is
            not known: `fit` takes it from the residuals.
        covariance: Of the components of a sample, (k, k) or (n, k, k), kept as the latter; then no
            `sigma`.

    Raises:
        ValueError: Shapes that do not belong together.

    >>> import jrigid as jr
    >>> seen = jr.datasets.gyro_example()
    >>> print(jr.identify.Record(jr.identify.Gyro(), seen.times, seen.omegas, 0.01).values.shape)
    (200, 3)
    """

    sensor: AbstractSensor
    ts: Float[Array, "*throws n"]
    values: Float[Array, "*throws n k"]
    sigma: Float[Array, "..."] | None
    covariance: Float[Array, "..."] | None

    def __init__(
        self, sensor: AbstractSensor, ts: Times, values: Values, sigma: Noise = None, *,
        covariance: Noise = None,
    ):  # fmt: skip
        """Values of a sensor with noise `sigma` or `covariance`."""
        check_type("sensor", sensor, AbstractSensor)
        name, width = type(sensor).__name__, sensor.width
        if values is None:  # a plan
            if width is None:
                raise ValueError(f"Argument `values` of `{name}` must be given, but it is None.")
            (ts,) = float_arrays(ts)
            values = jnp.ones((*ts.shape, width), ts.dtype) / width**0.5
        ts, values = float_arrays(ts, values)
        demand(
            ts.ndim in (1, 2) and values.ndim == ts.ndim + 1 and values.shape[:-1] == ts.shape,
            f"Arguments `ts` and `values` of `{name}` must have shapes (n,) and (n, k), but they "
            f"have shapes {ts.shape} and {values.shape}.",
        )
        demand(
            width in (None, values.shape[-1]),
            f"Argument `values` of `{name}` must have {width} columns, but it has "
            f"{values.shape[-1]}.",
        )
        demand(
            sigma is None or covariance is None,
            f"Arguments `sigma` and `covariance` of `{name}` must not both be given, but they are.",
        )
        self.sensor, self.ts, self.values = sensor, ts, values
        k, n, self.sigma, self.covariance = self.degrees, ts.shape[-1], None, None
        if sigma is not None:
            (sigma,) = float_arrays(sigma)
            demand(
                sigma.shape in ((), (k,), (n,), ts.shape, (n, k), (*ts.shape, k)),
                f"Argument `sigma` of `{name}` must have shape (), ({k},), ({n},) or ({n}, {k}), "
                f"but it has shape {sigma.shape}.",
            )
            of_samples = sigma.shape in ((n,), ts.shape) and sigma.shape != (k,)
            sigma = sigma[..., None] if of_samples else sigma
            self.sigma = jnp.broadcast_to(sigma, (*ts.shape, k))
        if covariance is not None:
            (covariance,) = float_arrays(covariance)
            demand(
                covariance.shape in ((k, k), (n, k, k), (*ts.shape, k, k)),
                f"Argument `covariance` of `{name}` must have shape ({k}, {k}) or ({n}, {k}, {k}), "
                f"but it has shape {covariance.shape}.",
            )
            self.covariance = jnp.broadcast_to(covariance, (*ts.shape, k, k))

    @property
    def degrees(self) -> int:
        """Numbers of a residual."""
        return self.values.shape[-1] if self.sensor.degrees is None else self.sensor.degrees

    @property
    def states_noise(self) -> bool:
        """Whether the noise is stated."""
        return self.sigma is not None or self.covariance is not None

    @property
    def known(self) -> Bool[Array, "*throws n degrees"]:
        """Which numbers of the residual are there."""
        at_all = jnp.isfinite(self.ts)[..., None]
        there = jnp.isfinite(self.values)
        if self.sensor.degrees is None and self.covariance is None:
            return at_all & there
        whole = jnp.all(there, axis=-1, keepdims=True) & at_all
        return jnp.broadcast_to(whole, (*whole.shape[:-1], self.degrees))

    def with_values(self, values: Array) -> "Record":
        """With other values, where there are times."""
        values = jnp.where(jnp.isfinite(self.ts)[..., None], values, jnp.nan)
        return eqx.tree_at(lambda x: x.values, self, values)


def Rates(ts: Times, values: Values, sigma: Noise = None, **noise: Any) -> Record:
    """The record of a perfect `Gyro`: angular velocities along its axes [rad/s].

    >>> import jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> print(jr.identify.Rates(record.times, record.omegas, record.sigma).values.shape)
    (200, 3)
    """
    return Record(Gyro(), ts, values, sigma, **noise)


def Attitudes(ts: Times, values: Values, sigma: Noise = None, **noise: Any) -> Record:
    """The record of an `AttitudeSensor`: unit quaternions, noise in radians about body axes.

    >>> import jrigid as jr
    >>> record = jr.datasets.toutatis_1992()
    >>> print(jr.identify.Attitudes(record.times, record.attitudes, 0.1).values.shape)
    (18, 4)
    """
    return Record(AttitudeSensor(), ts, values, sigma, **noise)


def Directions(
    ts: Times, values: Values, sigma: Noise = None, *, of: VectorLike, seen_from: str = "body",
    **noise: Any,
) -> Record:  # fmt: skip
    """The record of a `DirectionSensor`: unit vectors, noise in radians across them.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> star = jnp.array([1.0, 0.0, 0.0])
    >>> seen = jr.identify.Directions(jnp.arange(5.0), jnp.tile(star, (5, 1)), 1e-3, of=star)
    """
    sensor = DirectionSensor(float_arrays(of)[0], seen_from)
    return Record(sensor, ts, values, sigma, **noise)


def AngularMomenta(
    ts: Times, values: Values, sigma: Noise = None, *, axes: str = "space", **noise: Any
) -> Record:
    """The record of a `MomentumSensor` [kg m^2/s]; it sets the scale: `fit(..., scale="known")`."""
    return Record(MomentumSensor(axes), ts, values, sigma, **noise)


def Observed(
    function: Callable[[Any, Any, Any], Any], ts: Times, values: Values, sigma: Noise = None, *,
    on_attitude: bool = True, **noise: Any,
) -> Record:  # fmt: skip
    """The record of a `FunctionSensor`: any function `(t, state, system) -> (k,)`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> spin = jr.identify.Observed(
    ...     lambda t, state, system: state.omega[2:], jnp.arange(4.0), jnp.ones((4, 1)), 0.01)
    """
    return Record(FunctionSensor(function, on_attitude), ts, values, sigma, **noise)


class Samples(NamedTuple):
    """All records as a fit reads them, side by side: finite, of weight zero where nothing is.

    Residuals have as many numbers as the widest record's, D. `whitener` (throws, n, D, D) turns one
    into units of its noise; `sign` (throws, n, D) is that of a saturated number, 0 elsewhere.
    """

    ts: Array  # (throws, n)
    values: tuple[Array, ...]  # of each record
    whitener: Array
    weight: Array  # (throws, n, D)
    sign: Array

    @property
    def seen(self) -> Array:
        """Which samples are there."""
        return jnp.any(self.weight > 0, axis=-1)

    @property
    def parts(self) -> list[slice]:
        """Where each record's samples are."""
        ends = np.cumsum([0, *(x.shape[-2] for x in self.values)])
        return [slice(int(a), int(b)) for a, b in pairwise(ends)]


def samples_of(records: Sequence[Record], guess: Array) -> Samples:
    """Records as a fit reads them; a noise that is not known is `guess`."""
    width = max(x.degrees for x in records)
    each = [_normalised(x, guess) for x in records]

    def wide(x: Array, axes: int) -> Array:
        pad = [(0, 0)] * (x.ndim - axes) + [(0, width - x.shape[-1])] * axes
        return jnp.pad(x, pad)

    ts, values, whitener, weight, sign = zip(*each, strict=True)
    columns = [jnp.concatenate([wide(x, 1) for x in y], axis=1) for y in (weight, sign)]
    whitener = jnp.concatenate([wide(x, 2) for x in whitener], axis=1)
    ts, there = jnp.concatenate(ts, axis=1), jnp.any(columns[0] > 0, axis=-1)
    first = jnp.min(jnp.where(there, ts, jnp.inf), axis=1, keepdims=True)
    ts = jnp.where(there, ts, jnp.where(jnp.isfinite(first), first, 0.0))
    return Samples(ts, values, whitener, *columns)


def _normalised(record: Record, guess: Array) -> tuple[Array, ...]:
    known, dtype = record.known, record.values.dtype
    seen = jnp.any(known, axis=-1, keepdims=True)
    harmless = jnp.zeros_like(record.values)
    if record.sensor.unit_length:
        harmless = harmless.at[..., 0].set(1)
    there = seen & jnp.isfinite(record.values) if record.sensor.degrees is None else seen
    values = jnp.where(there, record.values, harmless)
    eye = jnp.eye(record.degrees, dtype=dtype)
    eye = jnp.broadcast_to(eye, (*known.shape, record.degrees))
    if record.covariance is not None:
        lower = jnp.linalg.cholesky(jnp.where(seen[..., None], record.covariance, eye))
        whitener = jax.scipy.linalg.solve_triangular(lower, eye, lower=True)
    else:
        sigma = jnp.broadcast_to(guess, known.shape) if record.sigma is None else record.sigma
        whitener = eye / jnp.where(known, sigma, 1.0)[..., None].astype(dtype)
    largest, sign = record.sensor.largest(), jnp.zeros(known.shape, dtype)
    if largest is not None:
        most = jnp.broadcast_to(largest.astype(dtype) * (1 - 1e-6), values.shape)
        beyond = known & (jnp.abs(values) >= most)
        sign = jnp.where(beyond, jnp.sign(values), 0.0)
    return record.ts, values, whitener, known.astype(dtype), sign


def of_throws(observations: Any) -> tuple[Record, ...]:
    """Records with an axis of throws in front: a list's, padded with NaN, or of length one."""
    if isinstance(observations, list):
        throws = [_as_tuple(x) for x in observations]
        demand(bool(throws), "Argument `observations` must not be empty, but it is.")
        kinds = [[jtu.tree_structure(x.sensor) for x in throw] for throw in throws]
        demand(
            all(kind == kinds[0] for kind in kinds),
            "Argument `observations` must hold records of the same sensors for each throw, but it "
            "does not.",
        )
        return tuple(_stacked(parts) for parts in zip(*throws, strict=True))
    single = _as_tuple(observations)
    shapes = {x.ts.shape[:-1] for x in single}
    text = f"Arguments `observations` must have the same throws, but they have {shapes}."
    demand(len(shapes) == 1, text)
    return tuple(_stacked([x]) for x in single) if shapes == {()} else single


def _as_tuple(observations: Any) -> tuple[Record, ...]:
    if isinstance(observations, Record):
        observations = (observations,)
    demand(
        isinstance(observations, Sequence) and len(observations) > 0,
        "Argument `observations` must be a record (jr.identify.Rates, ...), a tuple of them, or a "
        f"list with one entry for each throw, but it is {observations!r}.",
    )
    for x in observations:
        check_type("observations", x, Record)
    return tuple(observations)


def _stacked(parts: Sequence[Record]) -> Record:
    """One record of all throws; shorter ones are filled up with NaN."""
    names = ("ts", "values", "sigma", "covariance")
    longest = max(x.ts.shape[-1] for x in parts)

    def column(name: str) -> Array | None:
        leaves = [getattr(x, name) for x in parts]
        demand(
            len({leaf is None for leaf in leaves}) == 1,
            "Argument `observations` must state the noise for all throws or for none, but it does "
            "for some.",
        )
        if leaves[0] is None:
            return None
        pads = [[(0, longest - x.shape[0])] + [(0, 0)] * (x.ndim - 1) for x in leaves]
        pairs = zip(leaves, pads, strict=True)
        return jnp.stack([jnp.pad(x, pad, constant_values=jnp.nan) for x, pad in pairs])

    demand(
        all(x.ts.ndim == 1 for x in parts),
        "Argument `observations` must hold times of shape (n,) for each throw of a list, but it "
        "does not.",
    )
    demand(
        all(_same(x.sensor, parts[0].sensor) for x in parts),
        "Argument `observations` must have the same sensor in every throw of a list, but it has "
        "not: `jr.identify.each` seeks an error anew in each throw.",
    )
    pick = lambda x: tuple(getattr(x, name) for name in names)  # noqa: E731
    return eqx.tree_at(pick, parts[0], tuple(map(column, names)), is_leaf=lambda x: x is None)


def _same(a: Any, b: Any) -> bool:
    """Whether two sensors are equal, as far as that is known now."""
    if a is b:
        return True
    pairs = zip(jtu.tree_leaves(a), jtu.tree_leaves(b), strict=True)
    return all(
        x is y or not (is_concrete(x) and is_concrete(y)) or bool(jnp.array_equal(x, y))
        for x, y in pairs
    )


def check_records(findings: Findings, records: tuple[Record, ...]) -> None:
    """Note what is wrong with values, times and noise."""
    for x in records:
        name, known = type(x.sensor).__name__, x.known
        seen = jnp.any(known, axis=-1)
        findings.require(
            jnp.any(known),
            RESULTS.invalid_state,
            f"Argument `values` of `{name}` must hold values, but all are NaN.",
        )
        running = jax.lax.cummax(jnp.where(seen, x.ts, -jnp.inf), axis=1)
        before = jnp.concatenate([jnp.full_like(running[:, :1], -jnp.inf), running[:, :-1]], axis=1)
        padded = jnp.isnan(x.ts) & jnp.all(jnp.isfinite(x.values), axis=-1)
        findings.require(
            jnp.all(~seen | (x.ts > before)) & ~jnp.any(padded),
            RESULTS.invalid_times,
            f"Argument `ts` of `{name}` must be finite where there are values, and increasing, "
            "each time once, but it is not.",
        )
        findings.require(
            _is_noise(x, known),
            RESULTS.invalid_state,
            f"Arguments `sigma` and `covariance` of `{name}` must be positive, but one is not.",
        )
        if x.sensor.unit_length:
            square = jnp.sum(jnp.where(seen[..., None], x.values, 0.0) ** 2, axis=-1)
            near = 1e-3 if x.values.shape[-1] == 4 else 0.5
            findings.require(
                jnp.all(~seen | (jnp.abs(square - 1) < near)),
                RESULTS.invalid_state,
                f"Argument `values` of `{name}` must be of unit length, but one is not.",
            )

    count = sum(jnp.sum(x.known) for x in records)
    findings.require(
        jnp.asarray(count >= 12),
        RESULTS.invalid_state,
        "Argument `observations` must hold more numbers than a body and its state have, but it "
        "holds too few.",
    )


def _is_noise(x: Record, known: Array) -> Array:
    if x.sigma is not None:
        return jnp.all(~known | ((x.sigma > 0) & jnp.isfinite(x.sigma)))
    if x.covariance is None:
        return jnp.asarray(True)
    seen = jnp.any(known, axis=-1)[..., None, None]
    eye = jnp.broadcast_to(jnp.eye(x.degrees, dtype=x.values.dtype), x.covariance.shape)
    noise = jnp.where(seen, x.covariance, eye)
    even = jnp.abs(noise - jnp.swapaxes(noise, -1, -2)) <= 1e-6 * jnp.abs(noise)
    return jnp.all(even) & jnp.all(jnp.isfinite(jnp.linalg.cholesky(noise)))
