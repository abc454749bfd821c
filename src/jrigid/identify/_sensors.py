"""What sensors show of the motion, and the errors they make: objects with arrays to seek."""
# ruff: noqa: ARG002 (all take what one of them needs)

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jrigid import rotation
from jrigid._checks import array_of_shape, check_option, demand
from jrigid._numerics import product, safe_norm
from jrigid._types import AnyArray, Readable
from jrigid.dynamics import State, angular_momentum
from jrigid.systems import AbstractSystem

# Gauss and Laguerre's rule: the mean over a memory that fades as exp(-u), to u^5.
_FADING = (
    (0.4157745567834791, 2.294280360279042, 6.289945082937479),
    (0.711093009929173, 0.2785177335692409, 0.0103892565015861),
)
_EYE = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


def _array(
    name: str, unit: Any, default: Any = (0.0,) * 3, *shapes: Any, **metadata: Any
) -> Any:
    """A field that holds an array of one of these shapes, or None.

    The unit of its errors is in powers of the rms of the rates [rad/s] and of that of
    the values.
    """
    shapes = shapes or ((3,),)
    convert = lambda x: None if x is None else array_of_shape(name, x, *shapes)  # noqa: E731
    return eqx.field(
        default=default, converter=convert, metadata=metadata | {"unit": unit}
    )


def _vector(name: str) -> Any:
    return lambda value: array_of_shape(name, value, 3)


class AbstractSensor(Readable):
    """What a sensor makes of time, state and body; its arrays are its errors, known or sought.

    A subclass gives `predict`, and says more where the defaults do not hold.
    `fit(..., free=...)` picks arrays of sensors as it does of the system.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> class SpinMeter(jr.identify.AbstractSensor):
    ...     offset: float = 0.0
    ...     width = 1
    ...     depends_on_attitude = False
    ...
    ...     def predict(self, t, state, system):
    ...         return state.omega[2:] + self.offset
    >>> record = jr.identify.Record(SpinMeter(), jnp.arange(4.0), jnp.ones((4, 1)), 0.01)
    """

    width: ClassVar[int | None] = 3  # of a value; None: any
    degrees: ClassVar[int | None] = None  # of freedom of a value, its width if None
    unit_length: ClassVar[bool] = (
        False  # of values, to within a thousandth (attitudes) or a half
    )
    depends_on_attitude: ClassVar[bool] = True

    @abc.abstractmethod
    def predict(self, t: Array, state: State, system: AbstractSystem) -> Array:
        """The value that a state shows."""

    def difference(self, value: Array, predicted: Array) -> Array:
        """Predicted less observed, one number for each degree of freedom."""
        return predicted - value

    def started_at(self, t: Array) -> "AbstractSensor":
        """The sensor of a record whose first sample is at a time."""
        return self

    def memory(self) -> tuple[Array, Array] | None:
        """How long before a time the motion is shown at it [s], and with what weights."""
        return None

    def saturation(self) -> Array | None:
        """Values of this size stand for it and anything beyond: the sensor is saturated."""
        return None

    def units(self, rate: AnyArray, size: AnyArray) -> "AbstractSensor":
        """Sizes of its errors [as they are], where they are zero: of a body that turns at `rate`.

        Args:
            rate: Of the record, rms [rad/s].
            size: Of the values, rms.
        """
        sizes = {}
        for x in dataclasses.fields(self):
            value, powers = getattr(self, x.name), x.metadata.get("unit")
            if powers and value is not None:
                unit = rate ** powers[0] * size ** powers[1]
                xp = unit.__array_namespace__()
                sizes[x.name] = jnp.asarray(xp.broadcast_to(unit, value.shape))
        return dataclasses.replace(self, **sizes) if sizes else self

    def rates(self, value: Array) -> Array | None:
        """The body's rates that a value tells of by itself, or None."""
        return None

    def attitude(self, value: Array) -> Array | None:
        """The attitude that a value tells of by itself, or None."""
        return None


class Gyro(AbstractSensor):
    """Angular velocity in the axes of the sensor, which are the body axes unless it is turned.

    The reading is matrix scale R(misalignment)^-1 omega + bias + drift (t - since),
    late by `delay` and a first-order filter, and ends at `limit`.

    Attributes:
        bias: [rad/s].
        drift: Of the bias [rad/s^2].
        scale: One factor (), or one an axis (3,).
        misalignment: Rotation vector, from the body's axes to the sensor's [rad].
        matrix: Whatever else is linear (3, 3); `diag(1, 1, -1)` is a left-handed gyro.
        delay: Of its clock behind that of the record [s]; None: none.
        time_constant: Of a first-order filter [s], a small part of a turn; None: none.
        limit: Readings of this size are saturated and say "at least" [rad/s], () or
            (3,).
        since: When the bias is `bias` [s]; None: at the first sample of the record.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> gyro = jr.identify.Gyro(bias=jnp.array([0.1, 0.0, 0.0]))
    >>> still = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    >>> print(gyro.predict(0.0, still, jr.RigidBody(jnp.ones(3))))
    [0.1 0.  0. ]
    """

    depends_on_attitude: ClassVar[bool] = False
    bias: Float[Array, "3"] = _array("bias", (1, 0))
    drift: Float[Array, "3"] = _array("drift", (2, 0))
    scale: Float[Array, "..."] = _array("scale", (0, 0), 1.0, (), (3,))
    misalignment: Float[Array, "3"] = _array("misalignment", (0, 0))
    matrix: Float[Array, "3 3"] = _array("matrix", (0, 0), _EYE, (3, 3))
    delay: Float[Array, ""] | None = _array("delay", (-1, 0), None, ())
    time_constant: Float[Array, ""] | None = _array(
        "time_constant", (-1, 0), None, (), positive=True
    )
    limit: Float[Array, "..."] | None = _array("limit", None, None, (), (3,))
    since: Float[Array, ""] | None = _array("since", None, None, ())

    def _matrix(self, dtype: Any) -> Array:
        turn = rotation.to_matrix(rotation.exp(self.misalignment.astype(dtype)))
        scale = jnp.broadcast_to(self.scale, (3,)).astype(dtype)
        return product("ij,j,kj->ik", self.matrix.astype(dtype), scale, turn)

    def predict(self, t: Array, state: State, system: AbstractSystem) -> Array:
        """The reading [rad/s], without delay and limit."""
        dtype = state.omega.dtype
        since = jnp.asarray(t - (0.0 if self.since is None else self.since), dtype)
        offset = self.bias.astype(dtype) + self.drift.astype(dtype) * since
        return product("ij,j->i", self._matrix(dtype), state.omega) + offset

    def started_at(self, t: Array) -> "Gyro":
        """With its bias at that time, unless another was given."""
        return dataclasses.replace(self, since=t) if self.since is None else self

    def memory(self) -> tuple[Array, Array] | None:
        """Its delay, and the fading memory of its filter."""
        if self.delay is None and self.time_constant is None:
            return None
        lags, weights = jnp.zeros(1), jnp.ones(1)
        if self.time_constant is not None:
            lags, weights = jnp.asarray(_FADING, self.time_constant.dtype)
            lags = lags * self.time_constant
        if self.delay is not None:
            lags = lags.astype(self.delay.dtype) + self.delay
        return lags, weights.astype(lags.dtype)

    def saturation(self) -> Array | None:
        """The limit."""
        return None if self.limit is None else jnp.broadcast_to(self.limit, (3,))

    def rates(self, value: Array) -> Array:
        """The reading, less what is known of the errors."""
        first, second, third = self._matrix(value.dtype)
        # Columns of the inverse, but for the determinant: a third of the time that LU
        # compiles.
        columns = (
            jnp.cross(second, third),
            jnp.cross(third, first),
            jnp.cross(first, second),
        )
        inverse = jnp.stack(columns, axis=1) / jnp.sum(first * columns[0])
        return product("ij,j->i", inverse, value - self.bias.astype(value.dtype))


class Accelerometer(AbstractSensor):
    """Specific force at a lever from the centre of mass of a thrown body.

    In free fall nothing else is felt: alpha x r + omega x (omega x r) + bias.

    Attributes:
        lever: r, from the centre of mass to the sensor, body components [m].
        bias: [m/s^2].

    >>> import jax.numpy as jnp, jrigid as jr
    >>> sensor = jr.identify.Accelerometer(jnp.array([0.1, 0.0, 0.0]))
    >>> spin = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 10.0]))
    >>> print(sensor.predict(0.0, spin, jr.RigidBody(jnp.ones(3))))
    [-10.   0.   0.]
    """

    depends_on_attitude: ClassVar[bool] = False
    lever: Float[Array, "3"] = _array("lever", (-2, 1))
    bias: Float[Array, "3"] = _array("bias", (0, 1))

    def predict(self, t: Array, state: State, system: AbstractSystem) -> Array:
        """The specific force [m/s^2]."""
        omega = state.omega
        lever, bias = self.lever.astype(omega.dtype), self.bias.astype(omega.dtype)
        rate = system.vector_field(t, system.with_parts(state), None).omega
        return jnp.cross(rate, lever) + jnp.cross(omega, jnp.cross(omega, lever)) + bias


class Magnetometer(AbstractSensor):
    """A field that is the same everywhere in space, seen in body axes: R^T field + bias.

    Attributes:
        field: Space components, in whatever unit the values have.
        bias: In the same unit, body components: of what turns with the body.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> north = jr.identify.Magnetometer(jnp.array([20.0, 0.0, -40.0]))
    """

    field: Float[Array, "3"] = eqx.field(
        converter=_vector("field"), metadata={"unit": (0, 1)}
    )
    bias: Float[Array, "3"] = _array("bias", (0, 1))

    def predict(self, t: Array, state: State, system: AbstractSystem) -> Array:
        """The field in the body, in its own unit."""
        dtype = state.omega.dtype
        field = rotation.rotate_inverse(state.attitude, self.field.astype(dtype))
        return field + self.bias.astype(dtype)


class AttitudeSensor(AbstractSensor):
    """Attitudes, unit quaternions from body to space: a star tracker, or pictures.

    The residual is the rotation vector from the observed to the predicted attitude,
    about the body axes; q and -q are the same.

    Attributes:
        misalignment: Rotation vector, from the body's axes to those whose attitude is
            seen [rad].

    >>> import jax.numpy as jnp, jrigid as jr
    >>> tracker = jr.identify.AttitudeSensor(misalignment=jnp.array([0.0, 0.0, 0.1]))
    >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    >>> seen = tracker.predict(0.0, start, jr.RigidBody(jnp.ones(3)))
    >>> print(tracker.difference(start.attitude, seen))
    [0.  0.  0.1]
    """

    width: ClassVar[int | None] = 4
    degrees: ClassVar[int | None] = 3
    unit_length: ClassVar[bool] = True
    misalignment: Float[Array, "3"] = _array("misalignment", (0, 0))

    def predict(self, t: Array, state: State, system: AbstractSystem) -> Array:
        """The attitude."""
        q = state.attitude
        return rotation.multiply(q, rotation.exp(self.misalignment.astype(q.dtype)))

    def difference(self, value: Array, predicted: Array) -> Array:
        """Rotation vector from the observed to the predicted attitude, body axes."""
        return rotation.log(rotation.multiply(rotation.conjugate(value), predicted))

    def attitude(self, value: Array) -> Array:
        """The attitude, less the misalignment."""
        turn = rotation.exp(-self.misalignment.astype(value.dtype))
        return rotation.normalize(rotation.multiply(value, turn))


class DirectionSensor(AbstractSensor):
    """Unit vectors: of something at rest in space seen from the body, or the other way round.

    The residual is along two axes across the observed direction; its length is the
    chord.

    Attributes:
        of: What is seen: a vector in space axes (a star, the Sun), or, with
            `frame="space"`, a vector in body axes (a mark on the body).
        frame: "body" or "space": the axes of the values.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> sun = jr.identify.DirectionSensor(jnp.array([2.0, 0.0, 0.0]))
    >>> start = jr.State(jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.zeros(3))
    >>> print(sun.predict(0.0, start, jr.RigidBody(jnp.ones(3))))
    [-1.  0.  0.]
    """

    degrees: ClassVar[int | None] = 2
    unit_length: ClassVar[bool] = True
    of: Float[Array, "3"] = eqx.field(converter=_vector("of"))
    frame: str = eqx.field(static=True, default="body")

    def __check_init__(self) -> None:
        """Raise ValueError for axes that are none."""
        check_option("frame", self.frame, ("body", "space"))

    def predict(self, t: Array, state: State, system: AbstractSystem) -> Array:
        """The direction."""
        of = self.of.astype(state.omega.dtype)
        turn = rotation.rotate_inverse if self.frame == "body" else rotation.rotate
        return turn(state.attitude, of / safe_norm(of))

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


class MomentumSensor(AbstractSensor):
    """Angular momenta [kg m^2/s], internal parts included; they set the scale of the inertia.

    Attributes:
        frame: "space" or "body": the axes of the values.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> start = jr.State(jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array([1.0, 2.0, 3.0]))
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 2.5]))
    >>> print(jr.identify.MomentumSensor().predict(0.0, start, body))
    [-1.  -4.   7.5]
    """

    frame: str = eqx.field(static=True, default="space")

    def __check_init__(self) -> None:
        """Raise ValueError for axes that are none."""
        check_option("frame", self.frame, ("space", "body"))

    def predict(self, t: Array, state: State, system: AbstractSystem) -> Array:
        """The momentum."""
        if self.frame == "space":
            return system.angular_momentum(t, state, None)
        inner = system.torque.internal_momentum(t, state, None)
        return (
            angular_momentum(system.inertia.astype(state.omega.dtype), state.omega)
            + inner
        )


class FunctionSensor(AbstractSensor):
    """Any function of time, state and system.

    Attributes:
        function: `(t, state, system) -> (k,)`. Define it once: a new function is
            compiled anew.
        depends_on_attitude: Whether the function looks at the attitude.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> rpm = jr.identify.FunctionSensor(lambda t, state, system: 9.549297 * state.omega[2:], False)
    >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 2.0]))
    >>> print(rpm.predict(0.0, start, jr.RigidBody(jnp.ones(3))))
    [19.098594]
    """

    width: ClassVar[int | None] = None
    function: Callable[[Any, Any, Any], Any]
    # Of an instance here, of the class elsewhere.
    depends_on_attitude: bool = eqx.field(  # pyright: ignore
        static=True
    )

    def __init__(
        self,
        function: Callable[[Any, Any, Any], Any],
        depends_on_attitude: bool = True,
    ):
        """Raise ValueError for what is not a function."""
        text = f"a callable (t, state, system) -> (k,), but it is {function!r}."
        demand(callable(function), f"Argument `function` must be {text}")
        self.function = function
        self.depends_on_attitude = depends_on_attitude

    def predict(self, t: Array, state: State, system: AbstractSystem) -> Array:
        """What the function gives."""
        return jnp.asarray(self.function(t, state, system), state.omega.dtype)
