"""What was observed of a rotating body: times, values and their noise."""

import abc
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from jaxtyping import ArrayLike as _ArrayLike

from jrigid._checks import check_option, float_arrays, is_concrete
from jrigid._numerics import product, safe_norm
from jrigid._types import Readable, Real, VectorLike
from jrigid.dynamics import State, angular_momentum
from jrigid.rotation import conjugate, log, multiply, rotate, rotate_inverse
from jrigid.systems import AbstractSystem


class AbstractObservation(Readable):
    """Values seen at some times; subclasses say what they are of.

    NaN stands for "not seen": in a component of `values` (that number is left out; the whole sample
    where the components hang together, in attitudes, directions and beside a `covariance`), in a
    whole row, or in `ts` and its row (padding, which brings throws to one length). What was not
    seen weighs nothing, and its `sigma` may be NaN; it costs what any sample costs.

    Attributes:
        ts: Times [s] (n,), increasing among the samples seen, their origin that of `t0` elsewhere;
            with an axis of throws in front, (throws, n).
        values: One row for each time (n, k); a plan, whose values play no role, takes None.
        sigma: Standard deviation of the noise, in units of the residual: one number for all, (k,)
            for each component, (n,) for each sample, or (n, k); kept as (n, k). None where it is
            not known: `fit` takes it from the residuals.
        covariance: Of the components of a sample, (k, k) or (n, k, k), kept as the latter; then no
            `sigma`.
    """

    width: ClassVar[int | None] = 3  # of a value
    degrees: ClassVar[int | None] = None  # of freedom of a value, its width if None
    on_attitude: ClassVar[bool] = True

    ts: Float[Array, "*throws n"]
    values: Float[Array, "*throws n k"]
    sigma: Float[Array, "..."] | None
    covariance: Float[Array, "..."] | None

    @abc.abstractmethod
    def predict(self, t: Array, state: State, system: AbstractSystem) -> Array:
        """The value that a state shows."""

    def difference(self, value: Array, predicted: Array) -> Array:
        """Predicted less observed, one number for each degree of freedom."""
        return predicted - value


def _fields(self: Any, ts: Any, values: Any, sigma: Any = None, covariance: Any = None) -> None:
    """Convert, check shapes, and bring the noise into the shape of the values."""
    name = type(self).__name__
    if values is None:  # a plan
        if self.width is None:
            raise ValueError(f"Argument `values` of `{name}` must be given, but it is None.")
        (ts,) = float_arrays(ts)
        values = jnp.ones((*ts.shape, self.width), ts.dtype) / self.width**0.5
    ts, values = float_arrays(ts, values)
    if ts.ndim not in (1, 2) or values.shape[:-1] != ts.shape or values.ndim != ts.ndim + 1:
        raise ValueError(
            f"Arguments `ts` and `values` of `{name}` must have shapes (n,) and (n, k), but they "
            f"have shapes {ts.shape} and {values.shape}."
        )
    width = self.width
    if width is not None and values.shape[-1] != width:
        raise ValueError(
            f"Argument `values` of `{name}` must have {width} columns, but it has "
            f"{values.shape[-1]}."
        )
    if sigma is not None and covariance is not None:
        raise ValueError(
            f"Arguments `sigma` and `covariance` of `{name}` must not both be given, but they are."
        )
    k = values.shape[-1] if self.degrees is None else self.degrees
    n = ts.shape[-1]
    if sigma is not None:
        (sigma,) = float_arrays(sigma)
        if sigma.shape in ((), (k,), (n, k), (*ts.shape, k)):
            sigma = jnp.broadcast_to(sigma, (*ts.shape, k))
        elif sigma.shape in ((n,), ts.shape):
            sigma = jnp.broadcast_to(sigma[..., None], (*ts.shape, k))
        else:
            raise ValueError(
                f"Argument `sigma` of `{name}` must have shape (), ({k},), ({n},) or ({n}, {k}), "
                f"but it has shape {sigma.shape}."
            )
    if covariance is not None:
        (covariance,) = float_arrays(covariance)
        if covariance.shape not in ((k, k), (n, k, k), (*ts.shape, k, k)):
            raise ValueError(
                f"Argument `covariance` of `{name}` must have shape ({k}, {k}) or ({n}, {k}, {k}), "
                f"but it has shape {covariance.shape}."
            )
        covariance = jnp.broadcast_to(covariance, (*ts.shape, k, k))
    self.ts, self.values, self.sigma, self.covariance = ts, values, sigma, covariance


class Rates(AbstractObservation):
    """Angular velocities, components along the axes of the sensor [rad/s]: a gyro.

    The body axes of a fit are those of the sensor.

    Attributes:
        ts: Times [s] (n,), increasing; NaN pads.
        values: Rates [rad/s] (n, 3); NaN in a component that was not seen, which leaves the others.
        sigma: Noise [rad/s]: (), (3,), (n,) or (n, 3); None where it is not known.
        covariance: Of the three components [rad^2/s^2]: (3, 3) or (n, 3, 3); then no `sigma`, and a
            sample with a NaN is left out whole.

    >>> import jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> print(jr.identify.Rates(record.times, record.omegas, record.sigma).values.shape)
    (200, 3)
    """

    on_attitude: ClassVar[bool] = False

    def __init__(
        self,
        ts: Real[_ArrayLike, "*throws n"],
        values: Real[_ArrayLike, "*throws n 3"] | None,
        sigma: Real[_ArrayLike, "..."] | None = None,
        *,
        covariance: Real[_ArrayLike, "..."] | None = None,
    ):
        """Rates with noise `sigma` or `covariance` [rad/s]."""
        _fields(self, ts, values, sigma, covariance)

    def predict(self, t: Array, state: State, system: AbstractSystem) -> Array:
        """The angular velocity; a gyro's errors come in `fit`."""
        del t, system
        return state.omega


class Attitudes(AbstractObservation):
    """Attitudes, unit quaternions from body to space: a star tracker, or pictures.

    The residual is the rotation vector from the observed to the predicted attitude, about the body
    axes; q and -q are the same.

    Attributes:
        ts: Times [s] (n,), increasing; NaN pads.
        values: Unit quaternions, scalar first (n, 4); a sample with a NaN is left out.
        sigma: Noise, an angle about each body axis [rad]: (), (3,), (n,) or (n, 3); None where it
            is not known.
        covariance: Of the three angles [rad^2]: (3, 3) or (n, 3, 3); then no `sigma`.

    >>> import jrigid as jr
    >>> record = jr.datasets.toutatis_1992()
    >>> print(jr.identify.Attitudes(record.times, record.attitudes, 0.1).values.shape)
    (18, 4)
    """

    width: ClassVar[int | None] = 4
    degrees: ClassVar[int | None] = 3

    def __init__(
        self,
        ts: Real[_ArrayLike, "*throws n"],
        values: Real[_ArrayLike, "*throws n 4"] | None,
        sigma: Real[_ArrayLike, "..."] | None = None,
        *,
        covariance: Real[_ArrayLike, "..."] | None = None,
    ):
        """Attitudes with noise `sigma` or `covariance` about the body axes [rad]."""
        _fields(self, ts, values, sigma, covariance)

    def predict(self, t: Array, state: State, system: AbstractSystem) -> Array:
        """The attitude."""
        del t, system
        return state.attitude

    def difference(self, value: Array, predicted: Array) -> Array:
        """Rotation vector from the observed to the predicted attitude, body axes."""
        return log(multiply(conjugate(value), predicted))


class Directions(AbstractObservation):
    """Unit vectors: of something at rest in space seen from the body, or the other way round.

    The residual is along two axes across the observed direction; its length is the chord.

    Attributes:
        ts: Times [s] (n,), increasing; NaN pads.
        values: Directions (n, 3), of a length near 1, which drops out; a sample with a NaN is left
            out.
        sigma: Noise, an angle across the direction [rad]: (), (2,), (n,) or (n, 2); None where it
            is not known.
        covariance: Of the two angles [rad^2]: (2, 2) or (n, 2, 2); then no `sigma`.
        of: What is seen: a vector in space axes (a star, the magnetic field), or, with
            `seen_from="space"`, a vector in body axes (a mark on the body).
        seen_from: "body" or "space": the axes of the values.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> star = jnp.array([1.0, 0.0, 0.0])
    >>> seen = jr.identify.Directions(jnp.arange(5.0), jnp.tile(star, (5, 1)), 1e-3, of=star)
    """

    degrees: ClassVar[int | None] = 2
    of: Float[Array, "3"]
    seen_from: str = eqx.field(static=True)

    def __init__(
        self,
        ts: Real[_ArrayLike, "*throws n"],
        values: Real[_ArrayLike, "*throws n 3"] | None,
        sigma: Real[_ArrayLike, "..."] | None = None,
        *,
        of: VectorLike,
        seen_from: str = "body",
        covariance: Real[_ArrayLike, "..."] | None = None,
    ):
        """Directions with noise `sigma` or `covariance` across them [rad]."""
        check_option("seen_from", seen_from, ("body", "space"))
        _fields(self, ts, values, sigma, covariance)
        self.of, self.seen_from = float_arrays(of)[0], seen_from

    def predict(self, t: Array, state: State, system: AbstractSystem) -> Array:
        """The direction."""
        del t, system
        of = self.of / safe_norm(self.of)
        turn = rotate_inverse if self.seen_from == "body" else rotate
        return turn(state.attitude, of)

    def difference(self, value: Array, predicted: Array) -> Array:
        """Chord from the observed to the predicted direction, along two axes across the former."""
        value = value / safe_norm(value)
        x, y, z = value
        sign = jnp.where(z < 0, -1.0, 1.0)
        a = -1 / (sign + z)
        first = jnp.stack([1 + sign * x * x * a, sign * x * y * a, -sign * x])
        second = jnp.stack([x * y * a, sign + y * y * a, -y])
        half = jnp.maximum(0.5 * (1 + jnp.sum(value * predicted)), 1e-6)
        chord = predicted / jnp.sqrt(half)
        return jnp.stack([jnp.sum(first * chord), jnp.sum(second * chord)])


class AngularMomenta(AbstractObservation):
    """Angular momenta of the body [kg m^2/s], in space axes or, with `axes="body"`, in body axes.

    Their size sets the scale of the inertia: `fit(..., scale="known")`.

    Attributes:
        ts: Times [s] (n,), increasing; NaN pads.
        values: Momenta [kg m^2/s] (n, 3); NaN in a component that was not seen.
        sigma: Noise [kg m^2/s]: (), (3,), (n,) or (n, 3); None where it is not known.
        covariance: Of the three components: (3, 3) or (n, 3, 3); then no `sigma`.
        axes: "space" or "body".
    """

    axes: str = eqx.field(static=True)

    def __init__(
        self,
        ts: Real[_ArrayLike, "*throws n"],
        values: Real[_ArrayLike, "*throws n 3"] | None,
        sigma: Real[_ArrayLike, "..."] | None = None,
        *,
        axes: str = "space",
        covariance: Real[_ArrayLike, "..."] | None = None,
    ):
        """Momenta with noise `sigma` or `covariance` [kg m^2/s]."""
        check_option("axes", axes, ("space", "body"))
        _fields(self, ts, values, sigma, covariance)
        self.axes = axes

    def predict(self, t: Array, state: State, system: AbstractSystem) -> Array:
        """The momentum, internal parts included."""
        if self.axes == "space":
            return system.angular_momentum(t, state, None)
        inner = system.torque.internal_momentum(t, state, None)
        return angular_momentum(system.inertia.astype(state.omega.dtype), state.omega) + inner


class Observed(AbstractObservation):
    """Any function of time, state and system.

    Attributes:
        ts: Times [s] (n,), increasing; NaN pads.
        values: Of the function (n, k); NaN in a component that was not seen.
        sigma: Noise, in the units of the values: (), (k,), (n,) or (n, k); None where it is not
            known.
        covariance: Of the components: (k, k) or (n, k, k); then no `sigma`.
        function: `(t, state, system) -> (k,)`. Define it once: a new function is compiled anew.
        on_attitude: Whether the function looks at the attitude.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> spin = jr.identify.Observed(
    ...     lambda t, state, system: state.omega[2:], jnp.arange(4.0), jnp.ones((4, 1)), 0.01)
    """

    width: ClassVar[int | None] = None
    function: Callable[[Any, Any, Any], Any]
    on_attitude: bool = eqx.field(static=True)  # pyright: ignore

    def __init__(
        self,
        function: Callable[[Any, Any, Any], Any],
        ts: Real[_ArrayLike, "*throws n"],
        values: Real[_ArrayLike, "*throws n k"],
        sigma: Real[_ArrayLike, "..."] | None = None,
        *,
        on_attitude: bool = True,
        covariance: Real[_ArrayLike, "..."] | None = None,
    ):
        """Values of a function with noise `sigma` or `covariance`."""
        if not callable(function):
            raise ValueError(
                "Argument `function` must be a callable (t, state, system) -> (k,), "
                f"but it is {function!r}."
            )
        _fields(self, ts, values, sigma, covariance)
        self.function, self.on_attitude = function, on_attitude

    def predict(self, t: Array, state: State, system: AbstractSystem) -> Array:
        """What the function gives."""
        value = jnp.asarray(self.function(t, state, system), state.omega.dtype)
        if value.shape != self.values.shape[-1:]:
            raise ValueError(
                f"Argument `function` must return shape {self.values.shape[-1:]}, but it returns "
                f"{value.shape}."
            )
        return value


def of_throws(observations: Any) -> tuple[AbstractObservation, ...]:
    """Observations with an axis of throws in front: a list's, padded with NaN, or of length one."""
    if isinstance(observations, list):
        throws = [_as_tuple(x) for x in observations]
        if not throws:
            raise ValueError("Argument `observations` must not be empty, but it is.")
        kinds = [[type(x) for x in throw] for throw in throws]
        if any(kind != kinds[0] for kind in kinds):
            raise ValueError(
                "Argument `observations` must hold the same kinds of observation for each throw, "
                "but it does not."
            )
        return tuple(_stacked(parts) for parts in zip(*throws, strict=True))
    single = _as_tuple(observations)
    shapes = {x.ts.shape[:-1] for x in single}
    if len(shapes) > 1:
        raise ValueError(
            f"Arguments `observations` must have the same throws, but they have {shapes}."
        )
    if shapes == {()}:
        return tuple(_stacked([x]) for x in single)
    return single


def _as_tuple(observations: Any) -> tuple[AbstractObservation, ...]:
    if isinstance(observations, AbstractObservation):
        observations = (observations,)
    if not isinstance(observations, Sequence) or not observations:
        raise ValueError(
            "Argument `observations` must be an observation (jr.identify.Rates, ...), a tuple of "
            f"them, or a list with one entry for each throw, but it is {observations!r}."
        )
    for x in observations:
        if not isinstance(x, AbstractObservation):
            raise ValueError(
                "Argument `observations` must hold observations (jr.identify.Rates, ...), but it "
                f"holds {type(x).__name__}."
            )
    return tuple(observations)


def _stacked(parts: Sequence[AbstractObservation]) -> AbstractObservation:
    """One observation of all throws; shorter ones are filled up with NaN."""
    longest = max(x.ts.shape[-1] for x in parts)

    def padded(*leaves: Array) -> Array:
        fill = [(0, longest - x.shape[0]) for x in leaves]
        filled = [
            jnp.pad(x, [pad] + [(0, 0)] * (x.ndim - 1), constant_values=jnp.nan)
            for x, pad in zip(leaves, fill, strict=True)
        ]
        return jnp.stack(filled)

    first = parts[0]
    names = ("ts", "values", "sigma", "covariance")
    for x in parts:
        if x.ts.ndim != 1:
            raise ValueError(
                "Argument `observations` must hold times of shape (n,) for each throw of a list, "
                f"but it holds {x.ts.shape}."
            )
        for field in dataclasses.fields(x):
            if field.name not in names and not _same(x, first, field.name):
                raise ValueError(
                    f"Argument `observations` must have the same `{field.name}` in every throw of "
                    "a list, but it has not."
                )
        if any((getattr(x, n) is None) != (getattr(first, n) is None) for n in names):
            raise ValueError(
                "Argument `observations` must state the noise for all throws or for none, but it "
                "does for some."
            )
    columns = [[getattr(x, name) for x in parts] for name in names]
    new = tuple(None if column[0] is None else padded(*column) for column in columns)
    return eqx.tree_at(
        lambda x: tuple(getattr(x, name) for name in names),
        first,
        new,
        is_leaf=lambda x: x is None,
    )


def _same(a: Any, b: Any, name: str) -> bool:
    """Whether two observations agree in a field, as far as that is known now."""
    a, b = getattr(a, name), getattr(b, name)
    if a is b or not eqx.is_array(a):
        return a is b or a == b
    return not (is_concrete(a) and is_concrete(b)) or bool(jnp.array_equal(a, b))


def known(observation: AbstractObservation) -> Array:
    """Which numbers of the residual are there: (throws, n, degrees)."""
    at_all = jnp.isfinite(observation.ts)[..., None]
    there = jnp.isfinite(observation.values)
    if observation.degrees is None and observation.covariance is None:
        return at_all & there
    whole = jnp.all(there, axis=-1, keepdims=True) & at_all
    degrees = observation.degrees or observation.values.shape[-1]
    return jnp.broadcast_to(whole, (*whole.shape[:-1], degrees))


def whitened(
    observation: AbstractObservation, states: State, gyro: Callable[[Array], Array], system: Any
) -> Array:
    """Residuals in units of their noise (throws, n, degrees); zero where nothing was seen."""
    there = known(observation)
    seen = jnp.any(there, axis=-1)
    harmless = jnp.where(jnp.isfinite(observation.values), observation.values, 0.0)
    if observation.degrees is not None:  # a direction or an attitude of unit length
        unit = jnp.zeros_like(harmless).at[..., 0].set(1)
        harmless = jnp.where(seen[..., None], harmless, unit)
    ts = jnp.where(jnp.isfinite(observation.ts), observation.ts, 0.0)

    def one(t: Array, value: Array, q: Array, w: Array) -> Array:
        predicted = observation.predict(t, State(q, w), system)
        if isinstance(observation, Rates):
            predicted = gyro(predicted)
        return observation.difference(value, predicted)

    rows = jax.vmap(jax.vmap(one))(ts, harmless, states.attitude, states.omega)
    if observation.covariance is not None:
        eye = jnp.eye(rows.shape[-1], dtype=rows.dtype)
        eye = jnp.broadcast_to(eye, observation.covariance.shape)
        noise = jnp.where(seen[..., None, None], observation.covariance, eye)
        lower = jnp.linalg.cholesky(noise)
        inverse = jax.scipy.linalg.solve_triangular(lower, eye, lower=True)
        rows = product("tnij,tnj->tni", inverse, rows)
    elif observation.sigma is not None:
        rows = rows / jnp.where(there, observation.sigma, 1.0)
    return jnp.where(there, rows, 0.0)
