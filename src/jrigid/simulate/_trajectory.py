"""Trajectory: the states of an integrated motion, and its invariants when asked."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from jrigid._core.third_party import code_of
from jrigid._types import Readable
from jrigid.systems import AbstractSystem


class Trajectory(Readable):
    """States at the times asked for, and what became of the integration.

    Attributes:
        ts: Times [s], in the shape they were given.
        states: State at each time; the leading axes of its leaves are those of `ts`.
            NaN where the integration did not get to; attitudes are normalised.
        result: Result code, `jrigid.RESULTS.successful` if all went well; one for each
            lane under vmap. After an event it is `event_occurred`. Test it by
            `trajectory.result == jrigid.RESULTS.successful`, an array of booleans under
            vmap; `jrigid.RESULTS[trajectory.result]` is the message of a single one.
        stats: Counts of steps: `num_steps`, `num_accepted_steps`, `num_rejected_steps`.
        final_time: Where the integration ended [s]: the last of `ts`, the event, or
            where it failed.
        final_state: The state there; NaN if it failed.
    """

    ts: Float[Array, "..."]
    states: Any
    result: Any
    stats: dict[str, Array] = eqx.field(repr=False)
    final_time: Float[Array, "..."]
    final_state: Any
    # Of system and args: functions are kept apart, so that jit and vmap can return it.
    _arrays: Any = eqx.field(repr=False)
    _functions: Any = eqx.field(static=True, repr=False)

    @property
    def system(self) -> AbstractSystem:
        """The system that moved."""
        return eqx.combine(self._arrays, self._functions)[0]

    @property
    def args(self) -> Any:
        """What its torques were given."""
        return eqx.combine(self._arrays, self._functions)[1]

    @property
    def energy(self) -> Float[Array, "..."]:
        """Total energy at each time [J]."""
        return self._each(lambda system, t, state, args: system.energy(t, state, args))

    @property
    def angular_momentum(self) -> Float[Array, "... 3"]:
        """Total angular momentum at each time [kg m^2/s], space components."""
        return self._each(
            lambda system, t, state, args: system.angular_momentum(t, state, args)
        )

    def _each(self, fn: Callable[..., Array]) -> Array:
        lanes = jnp.ndim(code_of(self.result))

        def one(ts: Array, states: Any, system: Any, args: Any) -> Array:
            flat = jtu.tree_map(lambda x: x.reshape(-1, *x.shape[ts.ndim :]), states)
            # Torques see time in the precision of the state, as they did on the way.
            times = ts.reshape(-1).astype(flat.omega.dtype)
            values = jax.vmap(lambda t, state: fn(system, t, state, args))(times, flat)
            return values.reshape(*ts.shape, *values.shape[1:])

        for _ in range(lanes):
            one = eqx.filter_vmap(one)
        return one(self.ts, self.states, self.system, self.args)
