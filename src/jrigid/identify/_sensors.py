"""Sensors, which predict readings from a state. Their arrays are their errors."""
# ruff: noqa: ARG002 (methods have the arguments that one of the classes needs)

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, ArrayLike, Float

from jrigid import rotation
from jrigid._checks import array_of_shape, check_option, demand
from jrigid._numerics import product, safe_norm
from jrigid._types import AnyArray, Readable, ScalarLike
from jrigid.dynamics import State, angular_momentum
from jrigid.systems import AbstractSystem

# Lags and weights of a memory that fades as exp(-u): the quadrature of Gauss and
# Laguerre with three points, exact up to u^5.
_FADING_LAGS = (0.4157745567834791, 2.294280360279042, 6.289945082937479)
_FADING_WEIGHTS = (0.711093009929173, 0.2785177335692409, 0.0103892565015861)
_ZEROS = (0.0, 0.0, 0.0)
_EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def _array(
    name: str,
    unit: tuple[int, int] | None,
    default: ArrayLike | tuple[float, ...] | tuple[tuple[float, ...], ...] | None,
    *shapes: tuple[int, ...],
    positive: bool = False,
) -> Any:
    """A field that holds an array of one of these shapes, or None.

    Args:
        name: Name of the field.
        unit: Natural unit of the array: powers of the rms of the rates [rad/s] and of
            that of the values. None if it is never sought.
        default: Default value.
        *shapes: Shapes that the array may have.
        positive: Whether a fit keeps the array positive.
    """

    # Without annotations, which signatures of sensors would show.
    def convert(value):
        return None if value is None else array_of_shape(name, value, *shapes)

    metadata = {"unit": unit, "positive": positive}
    return eqx.field(default=default, converter=convert, metadata=metadata)


def _vector(name: str) -> Callable[[ArrayLike], Array]:
    """A converter to vectors."""

    def convert(value):
        return array_of_shape(name, value, 3)

    return convert


class AbstractSensor(Readable):
    """Predicts a reading from time, state and body; its arrays are its errors.

    A subclass defines `predict`, and other methods and class variables where their
    defaults do not hold. `fit(..., free=...)` picks arrays of sensors as it picks those
    of the system. The field of such an array states its natural unit, as powers of the
    rms rate [rad/s] and of the rms value: `eqx.field(metadata={"unit": (1, 0)})`.

    Attributes:
        width: Length of a value; None for any.
        degrees: Degrees of freedom of a value; None if they are as many as its width.
        unit_length: Whether values are unit vectors, attitudes to within a thousandth
            and others to within a half.
        depends_on_attitude: Whether the reading depends on the attitude.
        quantity: What a value is and its unit, for the axis of a figure.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> class SpinMeter(jr.identify.AbstractSensor):
    ...     offset: float = 0.0
    ...     width = 1
    ...     depends_on_attitude = False
    ...
    ...     def predict(self, t, state, system):
    ...         return state.omega[2:] + self.offset
    >>> ts = jnp.arange(4.0)
    >>> record = jr.identify.Record(SpinMeter(), ts, jnp.ones((4, 1)), 0.01)
    """

    width: ClassVar[int | None] = 3
    degrees: ClassVar[int | None] = None
    unit_length: ClassVar[bool] = False
    depends_on_attitude: ClassVar[bool] = True
    quantity: ClassVar[str] = "value"

    @abc.abstractmethod
    def predict(self, t: ScalarLike, state: State, system: AbstractSystem) -> Array:
        """Predict the value."""

    def difference(self, value: Array, predicted: Array) -> Array:
        """Return predicted less observed, one number for each degree of freedom."""
        return predicted - value

    def started_at(self, t: Array) -> "AbstractSensor":
        """Return the sensor of a record whose first sample is at a time."""
        return self

    def memory(self) -> tuple[Array, Array] | None:
        """Return lags behind the motion [s] and their weights; None without any."""
        return None

    def saturation(self) -> Array | None:
        """Return the size at which values are saturated; None if they never are."""
        return None

    def units(self, rate: AnyArray, size: AnyArray) -> "AbstractSensor":
        """Return the sensor with the natural units of its arrays in their place.

        Args:
            rate: Rms of the rates [rad/s].
            size: Rms of the values.
        """
        units = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            powers = field.metadata.get("unit")
            if powers and value is not None:
                unit = rate ** powers[0] * size ** powers[1]
                xp = unit.__array_namespace__()
                units[field.name] = jnp.asarray(xp.broadcast_to(unit, value.shape))
        return dataclasses.replace(self, **units) if units else self

    def rates(self, value: Array) -> Array | None:
        """Return the body's rates if a value gives them by itself, else None."""
        return None

    def attitude(self, value: Array) -> Array | None:
        """Return the attitude if a value gives it by itself, else None."""
        return None


class Gyro(AbstractSensor):
    """Angular velocity in the axes of the sensor.

    The reading is matrix scale R(misalignment)^-1 omega + bias + drift (t - since). It
    is late by `delay` and a first-order filter, and saturates at `limit`.

    Attributes:
        bias: [rad/s].
        drift: Rate of change of the bias [rad/s^2].
        scale: One factor (), or one for each axis (3,).
        misalignment: Rotation vector from the body axes to those of the sensor [rad].
        matrix: Any other linear error (3, 3); `diag(1, 1, -1)` is a left-handed gyro.
        delay: Delay of its clock behind that of the record [s]; None without one.
        time_constant: Time constant of a first-order filter [s], which must be short
            against a revolution; None without one.
        limit: Size () or (3,) at which readings are saturated [rad/s], so that they are
            lower bounds; None without one.
        since: Time at which the bias is `bias` [s]; None for the first sample, of
            several trials the earliest one. With a bias for each trial, give each trial
            times of its own that begin near zero.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> gyro = jr.identify.Gyro(bias=jnp.array([0.1, 0.0, 0.0]))
    >>> still = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    >>> print(gyro.predict(0.0, still, jr.RigidBody(jnp.ones(3))))
    [0.1 0.  0. ]
    """

    quantity: ClassVar[str] = "rate [rad/s]"
    depends_on_attitude: ClassVar[bool] = False
    bias: Float[Array, "3"] = _array("bias", (1, 0), _ZEROS, (3,))
    drift: Float[Array, "3"] = _array("drift", (2, 0), _ZEROS, (3,))
    scale: Float[Array, "..."] = _array("scale", (0, 0), 1.0, (), (3,))
    misalignment: Float[Array, "3"] = _array("misalignment", (0, 0), _ZEROS, (3,))
    matrix: Float[Array, "3 3"] = _array("matrix", (0, 0), _EYE, (3, 3))
    delay: Float[Array, ""] | None = _array("delay", (-1, 0), None, ())
    time_constant: Float[Array, ""] | None = _array(
        "time_constant", (-1, 0), None, (), positive=True
    )
    limit: Float[Array, "..."] | None = _array("limit", None, None, (), (3,))
    since: Float[Array, ""] | None = _array("since", None, None, ())

    def _matrix(self, dtype: DTypeLike) -> Array:
        """The matrix that turns rates into a reading without bias."""
        # The columns of this rotation are the axes of the sensor, so that its transpose
        # takes components along them.
        turn = rotation.to_matrix(rotation.exp(self.misalignment.astype(dtype)))
        scale = jnp.broadcast_to(self.scale, (3,)).astype(dtype)
        return product("ij,j,kj->ik", self.matrix.astype(dtype), scale, turn)

    def predict(self, t: ScalarLike, state: State, system: AbstractSystem) -> Array:
        """Predict the reading [rad/s], without delay and limit."""
        dtype = state.omega.dtype
        since = 0.0 if self.since is None else self.since
        duration = jnp.asarray(t - since, dtype)
        offset = self.bias.astype(dtype) + self.drift.astype(dtype) * duration
        return product("ij,j->i", self._matrix(dtype), state.omega) + offset

    def started_at(self, t: Array) -> "Gyro":
        """Return the gyro with `since` at a time, unless it was given."""
        return dataclasses.replace(self, since=t) if self.since is None else self

    def memory(self) -> tuple[Array, Array] | None:
        """Return lags and weights of the delay and of the filter's fading memory."""
        if self.delay is None and self.time_constant is None:
            return None
        lags = jnp.zeros(1)
        weights = jnp.ones(1)
        if self.time_constant is not None:
            dtype = self.time_constant.dtype
            # A first-order filter shows the mean of the past, weighted by exp(-u) for a
            # lag of u time constants.
            lags = jnp.asarray(_FADING_LAGS, dtype) * self.time_constant
            weights = jnp.asarray(_FADING_WEIGHTS, dtype)
        if self.delay is not None:
            lags = lags.astype(self.delay.dtype) + self.delay
        return lags, weights.astype(lags.dtype)

    def saturation(self) -> Array | None:
        """Return the limit of each axis."""
        return None if self.limit is None else jnp.broadcast_to(self.limit, (3,))

    def rates(self, value: Array) -> Array:
        """Return the rates by the matrix and the bias; drift and delay are ignored."""
        first, second, third = self._matrix(value.dtype)
        # The inverse by cross products compiles three times as fast as by LU.
        columns = (
            jnp.cross(second, third),
            jnp.cross(third, first),
            jnp.cross(first, second),
        )
        inverse = jnp.stack(columns, axis=1) / jnp.sum(first * columns[0])
        return product("ij,j->i", inverse, value - self.bias.astype(value.dtype))


class Accelerometer(AbstractSensor):
    """Specific force at a lever from the centre of mass of a body in free fall.

    The reading is alpha x r + omega x (omega x r) + bias, with the angular acceleration
    alpha and the lever r.

    Attributes:
        lever: Vector from the centre of mass to the sensor, body components [m].
        bias: [m/s^2].

    >>> import jax.numpy as jnp, jrigid as jr
    >>> sensor = jr.identify.Accelerometer(jnp.array([0.1, 0.0, 0.0]))
    >>> spin = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 10.0]))
    >>> print(sensor.predict(0.0, spin, jr.RigidBody(jnp.ones(3))))
    [-10.   0.   0.]
    """

    quantity: ClassVar[str] = "specific force [m/s$^2$]"
    depends_on_attitude: ClassVar[bool] = False
    # A lever times the square of a rate is an acceleration.
    lever: Float[Array, "3"] = _array("lever", (-2, 1), _ZEROS, (3,))
    bias: Float[Array, "3"] = _array("bias", (0, 1), _ZEROS, (3,))

    def predict(self, t: ScalarLike, state: State, system: AbstractSystem) -> Array:
        """Predict the specific force [m/s^2]."""
        omega = state.omega
        lever = self.lever.astype(omega.dtype)
        bias = self.bias.astype(omega.dtype)
        rate = system.vector_field(t, system.with_parts(state), None).omega
        return jnp.cross(rate, lever) + jnp.cross(omega, jnp.cross(omega, lever)) + bias


class Magnetometer(AbstractSensor):
    """A uniform field in body axes: R^T field + bias.

    Attributes:
        field: Space components, in the unit of the values.
        bias: Field of the body itself, body components in the same unit.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> north = jr.identify.Magnetometer(jnp.array([20.0, 0.0, -40.0]))
    """

    quantity: ClassVar[str] = "field, in the unit of the values"
    field: Float[Array, "3"] = eqx.field(
        converter=_vector("field"), metadata={"unit": (0, 1)}
    )
    bias: Float[Array, "3"] = _array("bias", (0, 1), _ZEROS, (3,))

    def predict(self, t: ScalarLike, state: State, system: AbstractSystem) -> Array:
        """Predict the field in body axes."""
        dtype = state.omega.dtype
        field = rotation.rotate_inverse(state.attitude, self.field.astype(dtype))
        return field + self.bias.astype(dtype)


class AttitudeSensor(AbstractSensor):
    """Attitudes, unit quaternions from body to space, as of a star tracker.

    The residual is the rotation vector from the observed to the predicted attitude,
    about the body axes. It is the same for q and -q.

    Attributes:
        misalignment: Rotation vector from the body axes to those of the sensor, whose
            attitude is observed [rad].

    >>> import jax.numpy as jnp, jrigid as jr
    >>> tracker = jr.identify.AttitudeSensor(misalignment=jnp.array([0.0, 0.0, 0.1]))
    >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    >>> predicted = tracker.predict(0.0, start, jr.RigidBody(jnp.ones(3)))
    >>> print(tracker.difference(start.attitude, predicted))
    [0.  0.  0.1]
    """

    quantity: ClassVar[str] = "attitude, quaternion"
    width: ClassVar[int | None] = 4
    degrees: ClassVar[int | None] = 3
    unit_length: ClassVar[bool] = True
    misalignment: Float[Array, "3"] = _array("misalignment", (0, 0), _ZEROS, (3,))

    def predict(self, t: ScalarLike, state: State, system: AbstractSystem) -> Array:
        """Predict the attitude of the sensor."""
        q = state.attitude
        return rotation.multiply(q, rotation.exp(self.misalignment.astype(q.dtype)))

    def difference(self, value: Array, predicted: Array) -> Array:
        """Return the rotation vector from the observed to the predicted attitude."""
        return rotation.log(rotation.multiply(rotation.conjugate(value), predicted))

    def attitude(self, value: Array) -> Array:
        """Return the attitude of the body, by the misalignment."""
        turn = rotation.exp(-self.misalignment.astype(value.dtype))
        return rotation.normalize(rotation.multiply(value, turn))


class DirectionSensor(AbstractSensor):
    """Unit vectors: a direction fixed in space in body axes, or the reverse.

    The residual has components along two axes perpendicular to the observed direction.
    Its length is the chord between the two directions.

    Attributes:
        of: The observed direction: a vector in space axes (a star, the Sun), or, with
            `frame="space"`, a vector in body axes (a mark on the body).
        frame: The axes of the values, "body" or "space".

    >>> import jax.numpy as jnp, jrigid as jr
    >>> sun = jr.identify.DirectionSensor(jnp.array([2.0, 0.0, 0.0]))
    >>> start = jr.State(jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.zeros(3))
    >>> print(sun.predict(0.0, start, jr.RigidBody(jnp.ones(3))))
    [-1.  0.  0.]
    """

    quantity: ClassVar[str] = "direction, unit vector"
    degrees: ClassVar[int | None] = 2
    unit_length: ClassVar[bool] = True
    of: Float[Array, "3"] = eqx.field(converter=_vector("of"))
    frame: str = eqx.field(static=True, default="body")

    def __check_init__(self) -> None:
        """Raise ValueError for another frame."""
        check_option("frame", self.frame, ("body", "space"))

    def predict(self, t: ScalarLike, state: State, system: AbstractSystem) -> Array:
        """Predict the direction."""
        of = self.of.astype(state.omega.dtype)
        turn = rotation.rotate_inverse if self.frame == "body" else rotation.rotate
        return turn(state.attitude, of / safe_norm(of))

    def difference(self, value: Array, predicted: Array) -> Array:
        """Return the chord along two axes perpendicular to the observed direction."""
        value = value / safe_norm(value)
        # Source of the two axes: T. Duff et al., "Building an Orthonormal Basis,
        # Revisited", Journal of Computer Graphics Techniques 6 (2017) 1.
        x, y, z = value
        sign = jnp.where(z < 0, -1.0, 1.0)
        a = -1 / (sign + z)
        first = jnp.stack([1 + sign * x * x * a, sign * x * y * a, -sign * x])
        second = jnp.stack([x * y * a, sign + y * y * a, -y])
        across = jnp.stack([jnp.sum(first * predicted), jnp.sum(second * predicted)])
        cosine = jnp.sum(value * predicted)
        # At an angle x this has the length sin(x), which over cos(x / 2) is the chord
        # 2 sin(x / 2). Beyond a right angle it is scaled to that length: there both
        # fall to zero, and opposite directions have a chord of 2 along the first axis.
        is_near = cosine > 0
        half = jnp.where(is_near, 0.5 * (1 + cosine), 1.0)
        opposite = jnp.array([1.0, 0.0], across.dtype)
        across = jnp.where(is_near | jnp.any(across != 0), across, opposite)
        length = jnp.sqrt(jnp.where(is_near, 1.0, jnp.sum(across * across)))
        chord = jnp.sqrt(jnp.where(is_near, 1.0, 2 - 2 * cosine))
        return across * chord / (length * jnp.sqrt(half))


class MomentumSensor(AbstractSensor):
    """Angular momenta [kg m^2/s], with those of internal parts.

    They determine the scale of the inertia.

    Attributes:
        frame: The axes of the values, "space" or "body".

    >>> import jax.numpy as jnp, jrigid as jr
    >>> start = jr.State(jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array([1.0, 2.0, 3.0]))
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 2.5]))
    >>> print(jr.identify.MomentumSensor().predict(0.0, start, body))
    [-1.  -4.   7.5]
    """

    quantity: ClassVar[str] = "angular momentum [kg m$^2$/s]"
    frame: str = eqx.field(static=True, default="space")

    def __check_init__(self) -> None:
        """Raise ValueError for another frame."""
        check_option("frame", self.frame, ("space", "body"))

    # A class variable in other sensors.
    @property
    def depends_on_attitude(self) -> bool:
        """Whether the values are those in space axes."""
        return self.frame == "space"

    def predict(self, t: ScalarLike, state: State, system: AbstractSystem) -> Array:
        """Predict the angular momentum."""
        if self.frame == "space":
            return system.angular_momentum(t, state, None)
        # The angular momentum of the system in space has that of internal parts
        # already.
        internal = system.torque.internal_momentum(t, state, None)
        inertia = system.inertia.astype(state.omega.dtype)
        return angular_momentum(inertia, state.omega) + internal


class FunctionSensor(AbstractSensor):
    """Any function of time, state and system.

    Attributes:
        function: `(t, state, system) -> (k,)`. Define it once, because each new
            function object is compiled.
        depends_on_attitude: Whether the result depends on the attitude.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> rpm = jr.identify.FunctionSensor(
    ...     lambda t, state, system: 9.549297 * state.omega[2:], False)
    >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 2.0]))
    >>> print(rpm.predict(0.0, start, jr.RigidBody(jnp.ones(3))))
    [19.098594]
    """

    width: ClassVar[int | None] = None
    function: Callable[[Any, Any, Any], Any]
    # A field here and a class variable in other sensors.
    depends_on_attitude: bool = eqx.field(static=True)

    def __init__(
        self,
        function: Callable[[Any, Any, Any], Any],
        depends_on_attitude: bool = True,
    ):
        """Raise ValueError for what is not callable."""
        demand(
            callable(function),
            "Argument `function` must be a callable (t, state, system) -> (k,), but it "
            f"is {function!r}.",
        )
        self.function = function
        self.depends_on_attitude = depends_on_attitude

    def predict(self, t: ScalarLike, state: State, system: AbstractSystem) -> Array:
        """Return the result of the function."""
        return jnp.asarray(self.function(t, state, system), state.omega.dtype)
