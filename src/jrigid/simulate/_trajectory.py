"""Trajectory: the states of an integrated motion, its energy and angular momentum."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PyTree

from jrigid._core.third_party import code_of
from jrigid._types import BodyState, Readable, ScalarLike
from jrigid.systems import AbstractSystem


class Trajectory(Readable):
    """States at the output times, and the result code of the integration.

    Attributes:
        ts: Times [s], in the shape of the argument.
        states: State at each time; the leading axes of its leaves are those of `ts`.
            NaN at times that were not reached; attitudes are normalised.
        result: Result code, `jrigid.RESULTS.successful` if all went well; one for each
            lane under vmap. After an event it is `event_occurred`. Test it by
            `trajectory.result == jrigid.RESULTS.successful`, an array of booleans under
            vmap; `jrigid.RESULTS[trajectory.result]` is the message of a single one.
        stats: Counts of steps: `num_steps`, `num_accepted_steps`, `num_rejected_steps`.
        final_time: Time at which the integration ended [s]: the last of `ts`, the time
            of the event, or that of the failure.
        final_state: State at that time; NaN if the integration failed.
    """

    ts: Float[Array, "..."]
    states: Any
    result: Any
    stats: dict[str, Array] = eqx.field(repr=False)
    final_time: Float[Array, "..."]
    final_state: Any
    # System and args: functions are static, so that jit and vmap can return the object.
    _arrays: Any = eqx.field(repr=False)
    _functions: Any = eqx.field(static=True, repr=False)

    @property
    def system(self) -> AbstractSystem:
        """The system that moved."""
        return eqx.combine(self._arrays, self._functions)[0]

    @property
    def args(self) -> Any:
        """The argument `args` of its torques."""
        return eqx.combine(self._arrays, self._functions)[1]

    @property
    def energy(self) -> Float[Array, "..."]:
        """Total energy at each time [J]."""

        def energy(
            system: AbstractSystem, t: ScalarLike, state: BodyState, args: PyTree
        ) -> Array:
            return system.energy(t, state, args)

        return self._each(energy)

    @property
    def angular_momentum(self) -> Float[Array, "... 3"]:
        """Total angular momentum at each time [kg m^2/s], space components."""

        def angular_momentum(
            system: AbstractSystem, t: ScalarLike, state: BodyState, args: PyTree
        ) -> Array:
            return system.angular_momentum(t, state, args)

        return self._each(angular_momentum)

    def _each(self, fn: Callable[..., Array]) -> Array:
        """The values of a function at all times, of all lanes."""
        lanes = jnp.ndim(code_of(self.result))

        def one(
            ts: Array, states: BodyState, system: AbstractSystem, args: PyTree
        ) -> Array:
            flat = jtu.tree_map(lambda x: x.reshape(-1, *x.shape[ts.ndim :]), states)
            # Torques receive the time in the precision of the state, as in the run.
            times = ts.reshape(-1).astype(flat.omega.dtype)
            values = jax.vmap(lambda t, state: fn(system, t, state, args))(times, flat)
            return values.reshape(*ts.shape, *values.shape[1:])

        # Each `jax.vmap` around the call of `simulate` has given the code one axis.
        for _ in range(lanes):
            one = eqx.filter_vmap(one)
        return one(self.ts, self.states, self.system, self.args)
