"""Conditions that end a motion, and the time at which the first of them is met."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# Halvings of a step that find the time of an event, by the size of a number in bytes.
# They exceed the 53 and 24 bits of a mantissa, so that rounding alone limits the time.
_BISECTIONS = {8: 60, 4: 31}
# Of its value at the ends of a step, what a condition that jumps has at least where it
# changes its sign.
_JUMP = 0.5


class Conditions(NamedTuple):
    """Conditions that end a motion.

    Attributes:
        values: Of (arrays, t, y): one value for each condition.
        boolean: Which of the conditions are booleans.
        direction: Change of sign that ends the motion: any for None, upward for True.
    """

    values: Callable[[list[Array], Array, Array], Float[Array, " conditions"]]
    boolean: tuple[bool, ...]
    direction: tuple[bool | None, ...]

    def happened(self, before: Array, after: Array) -> Bool[Array, " conditions"]:
        """Whether each condition ends the motion, by values before and after a step."""
        old = jnp.sign(before)
        new = jnp.sign(after)
        each = []
        for i, (boolean, up) in enumerate(
            zip(self.boolean, self.direction, strict=True)
        ):
            if boolean:
                each.append(new[i] > 0)
            elif up is None:
                # A condition that is NaN at the start has no sign that could change.
                each.append((old[i] != new[i]) & ~jnp.isnan(old[i]))
            elif up:
                each.append((old[i] <= 0) & (new[i] > 0))
            else:
                each.append((old[i] > 0) & (new[i] <= 0))
        return jnp.stack(each)

    def crossing(
        self,
        observed: list[Array],
        happened: Bool[Array, " conditions"],
        values: tuple[Array, Array],
        ends: tuple[Array, Array],
        state_at: Callable[[Array], Float[Array, " n"]],
        sought: Bool[Array, ""],
    ) -> tuple[Float[Array, ""], Int[Array, ""]]:
        """The time at which the first of the conditions is met within a step.

        There a number changes its sign, or a boolean becomes true. Bisection finds the
        time and cannot miss it.

        Args:
            observed: Arrays that the conditions depend on.
            happened: Which conditions are met in the step.
            values: Of the conditions at the start and at the end of the step.
            ends: Times at which the step starts and ends.
            state_at: The state within the step, as a function of time.
            sought: Whether the time is needed; if not, there is no bisection.

        Returns:
            The time, and the index of the condition that is zero there; -1 where it is
            a boolean, or jumps.
        """
        first, last = values

        def at(t: Array) -> Float[Array, " conditions"]:
            return self.values(observed, t, state_at(t))

        def changed(values: Array) -> Bool[Array, " conditions"]:
            return happened & (jnp.sign(values) == jnp.sign(last))

        count = jnp.where(sought, halvings(ends[0].dtype), 0)
        time = first_change(lambda t: jnp.any(changed(at(t))), ends, count)
        exact = jax.lax.stop_gradient(time)
        found = at(exact)
        which = jnp.argmax(changed(found)).astype(jnp.int32)
        size = jnp.maximum(jnp.abs(first), jnp.abs(last))
        # The value of a continuous condition is almost zero here. NaN is no jump: the
        # motion will end with a state that is not finite.
        jumps = (jnp.abs(found) > _JUMP * size) | jnp.array(self.boolean)
        return exact, jnp.where(jumps[which], -1, which)


def halvings(dtype: Any) -> int:
    """Number of halvings of a step after which only rounding limits a time in it."""
    return _BISECTIONS[jnp.dtype(dtype).itemsize]


def first_change(
    has_changed: Callable[[Array], Bool[Array, ""]],
    ends: tuple[Array, Array],
    count: int | Array,
) -> Float[Array, ""]:
    """The time from which on something has changed, by bisection.

    Args:
        has_changed: Whether it has at a time.
        ends: Times before and after the change.
        count: Number of halvings.
    """

    def halve(_: Int[Array, ""], bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = low + 0.5 * (high - low)
        late = has_changed(middle)
        return jnp.where(late, low, middle), jnp.where(late, middle, high)

    # It has changed at the upper end of the bracket, and not at the lower.
    return jax.lax.fori_loop(0, count, halve, ends)[1]
