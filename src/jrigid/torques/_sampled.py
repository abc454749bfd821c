"""A function of time from samples: a wheel's measured momentum, a commanded torque."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._checks import check_shape, float_arrays, is_concrete
from jrigid._types import Readable, ScalarLike
from jrigid.torques._base import FINITE, POSITIVE, array, refuse_known_parameters


class Sampled(Readable):
    """A function of time from samples: scale values(t - delay), smooth between them.

    The function is cubic between neighbouring samples. Its slope at a sample is that of
    the parabola through the sample and its neighbours. It is constant before the first
    sample and after the last one. Pass it where a torque takes a function of time, as
    in `Rotor(Sampled(ts, momenta))`. `jrigid.identify.fit` can estimate its scale, its
    delay and its values.

    It is for a quantity that is smooth on the scale of the samples. Where it rises
    within an interval that is short beside its neighbours, a cubic overshoots. A step
    is a time that occurs twice: the function has the first of the two values before it
    and the second one from it on, and no cubic reaches across.

    Attributes:
        ts: Times [s] (n,), in order. One that occurs twice is a step; repetitions of
            the last one are padding, with its value.
        values: One row for each time (n, ...).
        scale: Factor of the values, positive.
        delay: Time by which the function is later than the samples [s]: positive for a
            torque that follows its command, negative for samples that lag behind what
            they measure.

    Raises:
        ValueError: There are no samples.
        RuntimeError: The scale is not positive or times are not in order, and they are
            known when the object is built.

    Gradients: those of the cubics, in everything. The second derivative in time jumps
    at the samples, at the first and the last one the first derivative too, and at a
    step the value: the derivative of a motion in `delay` or `ts` misses what a step or
    an end within the run adds to it. For that, use a function of time with `jumps`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> ts, values = jnp.array([0.0, 1.0, 2.0]), jnp.array([[0.0], [1.0], [4.0]])
    >>> speed = jr.torques.Sampled(ts, values)
    >>> print(speed(1.5))
    [2.25]
    """

    ts: Float[Array, " n"] = eqx.field(converter=array("ts", None))
    values: Float[Array, "n ..."] = eqx.field(converter=lambda x: float_arrays(x)[0])
    scale: Float[Array, ""] = eqx.field(
        default=1.0, converter=array("scale"), metadata=POSITIVE
    )
    delay: Float[Array, ""] = eqx.field(
        default=0.0, converter=array("delay"), metadata=FINITE
    )

    def __check_init__(self) -> None:
        """Raise an error for shapes, a scale or an order of times that is refused."""
        refuse_known_parameters(self)
        check_shape("values", self.values, (*self.ts.shape, *self.values.shape[1:]))
        if self.ts.size == 0:
            raise ValueError("Argument `ts` must not be empty, but it is.")
        if is_concrete(self.ts) and np.any(np.diff(np.asarray(self.ts)) < 0):
            raise RuntimeError("Argument `ts` must be in order, but it is not.")

    @property
    def jumps(self) -> Float[Array, " n"]:
        """Times at which the function is not smooth: those of the samples [s]."""
        return self.ts + self.delay.astype(self.ts.dtype)

    @property
    def has_known_step(self) -> bool:
        """Whether a time occurs twice with two values, as far as these are known."""
        if not (is_concrete(self.ts) and is_concrete(self.values)):
            return False
        same = np.diff(np.asarray(self.ts)) == 0
        return bool(np.any(np.diff(np.asarray(self.values), axis=0)[same]))

    def __call__(self, t: ScalarLike) -> Array:
        """The value at a time."""
        ts = self.ts
        values = self.values
        t = jnp.clip(
            jnp.asarray(t, ts.dtype) - self.delay.astype(ts.dtype), ts[0], ts[-1]
        )
        last = ts.size - 1
        # For a single sample i is -1, which is that sample, and all intervals are
        # empty.
        i = jnp.clip(jnp.searchsorted(ts, t, side="right") - 1, 0, last - 1)
        intervals = [self._interval(i + k) for k in (-1, 0, 1)]
        _, (mean, b), _ = intervals
        left, right = _end_slopes(*intervals)
        since = (t - ts[i]).astype(values.dtype)
        u = jnp.where(b > 0, since / jnp.where(b > 0, b, 1.0), 0.0)
        bend = u * (1 - u) * b
        # Hermite's cubic: the chord, and a part that is zero at both ends and gives the
        # slopes there.
        value = values[i] + u * b * mean
        value = value + bend * ((1 - u) * (left - mean) - u * (right - mean))
        return self.scale.astype(values.dtype) * value

    def _interval(self, j: Array) -> tuple[Array, Array]:
        """Mean slope from sample j to the next, and the time between them.

        Both are zero before the first sample and after the last one.
        """
        last = self.ts.size - 1
        inside = (j >= 0) & (j < last)
        j = jnp.clip(j, 0, last - 1)
        span = jnp.where(inside, self.ts[j + 1] - self.ts[j], 0.0)
        span = span.astype(self.values.dtype)
        rise = self.values[j + 1] - self.values[j]
        return rise / jnp.where(span > 0, span, 1.0), span


def _end_slopes(
    before: tuple[Array, Array],
    within: tuple[Array, Array],
    after: tuple[Array, Array],
) -> tuple[Array, Array]:
    """Slopes of the cubic at the ends of an interval, from it and its neighbours.

    They are those of the parabolas through three samples each. In the first and the
    last interval one parabola gives both slopes; of two samples alone it is a line.
    """
    slope_before, a = before
    slope, b = within
    slope_after, c = after
    ab, bc = (jnp.where(x > 0, x + b, 1.0) for x in (a, c))
    # Second divided differences, half the second derivatives of the two parabolas.
    bend_before = jnp.where(a > 0, (slope - slope_before) / ab, 0.0)
    bend_after = jnp.where(c > 0, (slope_after - slope) / bc, 0.0)
    left = slope - b * jnp.where(a > 0, bend_before, bend_after)
    right = slope + b * jnp.where(c > 0, bend_after, bend_before)
    return left, right
