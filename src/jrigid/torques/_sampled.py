"""A function of time from samples: a wheel's measured momentum, a commanded torque."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jrigid._checks import check_shape, float_arrays
from jrigid._types import Readable, ScalarLike
from jrigid.torques._base import FINITE, POSITIVE, array


class Sampled(Readable):
    """A function of time from samples: scale values(t - delay), smooth between them.

    Cubic between neighbouring samples, with the slope of the parabola through each and
    its neighbours; held before the first and after the last. Give it where a torque
    takes a function of time, `Rotor(Sampled(ts, momenta))`; `jrigid.identify.fit` can
    seek its scale, its delay and its values.

    Attributes:
        ts: Times [s] (n,), increasing; repeated ones at the end pad.
        values: One row for each time (n, ...).
        scale: Factor of the values, positive.
        delay: By which the function is later than the samples [s], as a torque that
            follows its command; of samples that lag behind what they measure it is
            negative.

    Gradients: those of the cubics, in everything; the second derivative in time jumps.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> speed = jr.torques.Sampled(jnp.array([0.0, 1.0, 2.0]), jnp.array([[0.0], [1.0], [4.0]]))
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
        """Raise ValueError for shapes that do not belong together."""
        check_shape("values", self.values, (*self.ts.shape, *self.values.shape[1:]))

    @property
    def jumps(self) -> Float[Array, " n"]:
        """Times at which the function is not smooth: those of the samples [s]."""
        return self.ts + self.delay.astype(self.ts.dtype)

    def __call__(self, t: ScalarLike) -> Array:
        """The value at a time."""
        ts, values = self.ts, self.values
        t = jnp.clip(
            jnp.asarray(t, ts.dtype) - self.delay.astype(ts.dtype), ts[0], ts[-1]
        )
        last = ts.size - 1
        i = jnp.clip(jnp.searchsorted(ts, t, side="right") - 1, 0, last - 1)

        def steepness(j: Array) -> tuple[Array, Array]:
            """Mean slope from sample j to the next, and how long that is; 0 beyond the ends."""
            inside = (j >= 0) & (j < last)
            j = jnp.clip(j, 0, last - 1)
            span = jnp.where(inside, ts[j + 1] - ts[j], 0.0).astype(values.dtype)
            return (values[j + 1] - values[j]) / jnp.where(span > 0, span, 1.0), span

        (before, a), (within, b), (after, c) = (steepness(i + k) for k in (-1, 0, 1))
        # Parabolas through three samples; at an end that of the last three, of two a
        # chord.
        ab, bc = (jnp.where(x > 0, x + b, 1.0) for x in (a, c))
        bend_before = jnp.where(a > 0, (within - before) / ab, 0.0)
        bend_after = jnp.where(c > 0, (after - within) / bc, 0.0)
        left = within - b * jnp.where(a > 0, bend_before, bend_after)
        right = within + b * jnp.where(c > 0, bend_after, bend_before)
        since = (t - ts[i]).astype(values.dtype)
        u = jnp.where(b > 0, since / jnp.where(b > 0, b, 1.0), 0.0)
        bend = u * (1 - u) * b
        value = values[i] + u * b * within
        value = value + bend * ((1 - u) * (left - within) - u * (right - within))
        return self.scale.astype(values.dtype) * value
