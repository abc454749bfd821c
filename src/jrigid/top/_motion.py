"""top_motion(): the state of Lagrange's top at any times."""

from typing import Any

import jax
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Real

from jrigid._checks import RESULTS, Findings, all_finite, check_shape, nan_where
from jrigid._types import ScalarLike
from jrigid.dynamics import State
from jrigid.rotation import normalize
from jrigid.top._flow import at, invariants
from jrigid.top._top import SymmetricTop, checked_with


def motion_validity(
    top: SymmetricTop, state0: State, ts: Real[ArrayLike, "..."], *, t0: ScalarLike = 0.0
) -> Any:
    """What `top_motion` finds wrong with its arguments.

    Args:
        top: As for `top_motion`, and so on.
        state0: State at `t0`.
        ts: Times [s].
        t0: Time of `state0` [s].

    Returns:
        A `jrigid.RESULTS`, `RESULTS.successful` if nothing is; the lane's code under vmap.

    Raises:
        ValueError: Wrong shape or dtype (trace time).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.1]))
    >>> code = jr.top.motion_validity(jr.SymmetricTop(1.0, -0.5, 1.0), state, 1.0)
    >>> code == jr.RESULTS.invalid_inertia
    Array(True, dtype=bool)
    """
    findings, _ = _motion(top, state0, ts, t0)
    return findings.result


def top_motion(
    top: SymmetricTop,
    state0: State,
    ts: Real[ArrayLike, "..."],
    *,
    t0: ScalarLike = 0.0,
    throw: bool = True,
) -> State:
    r"""Exact state of Lagrange's top at any times, at a cost that does not depend on the time.

    One formula serves every motion: waves, cusps and loops, steady and sleeping tops, pendulums,
    passages through the vertical, no gravity; without Euler angles.

    Args:
        top: Moments about the fixed point and mgl of any sign.
        state0: State at `t0`, without internal parts; gravity pulls along -z in space.
        ts: Times [s], in any order, before or after `t0`, of any shape.
        t0: Time of `state0` [s].
        throw: If False, bad values give NaN states instead of an error, in their lane alone;
            `top.motion_validity` tells why.

    Returns:
        Attitude and angular velocity, with the shape of `ts` in front. The error is below
        1e-13 (1 + radians turned) in float64, plus what the last bits of the arguments do.

    Raises:
        ValueError: Wrong shape or dtype (trace time).
        RuntimeError: Bad value, or angles turned that overflow, with `throw=True` (run time, any
            lane).

    Gradients: of any order and in every mode those of the motion, also for a sleeping, steady,
    weightless or hanging top and through the vertical; reverse mode costs a few values.
    Source: Lagrange's solution in the form derived in docs/top.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(I1=1.0, I3=0.5, mgl=1.0)
    >>> state0 = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> motion = jr.top_motion(top, state0, jnp.array([0.0, 1.0, 1e6]))
    >>> print(motion.omega.shape, motion.omega[1].round(4))
    (3, 3) [-0.3481  0.2425  5.    ]
    """
    findings, state = _motion(top, state0, ts, t0)
    return findings.apply(nan_where(~findings.ok, state), throw)


def _motion(top: Any, state0: Any, ts: Any, t0: Any) -> tuple[Findings, State]:
    findings, top, state0, (times, t0) = checked_with(top, state0, ts, t0)
    check_shape("t0", t0, ())
    state = State(*_states(top, normalize(state0.attitude), state0.omega, times - t0))
    findings.require(all_finite(state), RESULTS.nonfinite_state)
    return findings, state


@jax.jit
def _states(top: SymmetricTop, attitude: Array, omega: Array, times: Array) -> tuple[Array, Array]:
    motion = invariants(top.I1, top.I3, top.mgl, attitude, omega)
    states = jax.vmap(lambda t: at(motion, t))(times.reshape(-1))
    return jtu.tree_map(lambda x: x.reshape(*times.shape, x.shape[-1]), states)
