"""top_motion(): the state of Lagrange's top at any times."""

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_shape,
    harmless,
    is_unit,
    nan_where,
    settle,
)
from jrigid._motion import resolves
from jrigid._numerics import safe_norm
from jrigid._types import Real, ScalarLike
from jrigid.dynamics import ExactStates, State
from jrigid.top._flow import invariants, state_after
from jrigid.top._top import SymmetricTop, top_and_state

_BAD_TIMES = "Argument `ts` must be finite, but it is not."
_BAD_START = "Argument `t0` must be finite, but it is not."


def top_motion(
    top: SymmetricTop,
    state0: State,
    ts: Real[ArrayLike, "..."],
    *,
    t0: ScalarLike = 0.0,
    throw: bool = True,
) -> ExactStates:
    r"""Exact state of Lagrange's top at any times, at a cost that does not depend on the time.

    One formula serves every motion: waves, cusps and loops, steady and sleeping tops, pendulums,
    passages through the vertical, no gravity; without Euler angles.

    Args:
        top: Moments about the fixed point and mgl of any sign.
        state0: State at `t0`, without internal parts; gravity pulls along -z in space.
        ts: Times [s], in any order, before or after `t0`, of any shape.
        t0: Time of `state0` [s].
        throw: False: a bad value gives NaN and its code in `result` instead of an error, in its
            lane alone.

    Returns:
        Attitude and angular velocity (`.states`, or `.attitude` and `.omega`), with the shape of
        `ts` in front, and `result`. The error is below 1e-13 (1 + radians turned) in float64, plus
        what the last bits of the arguments do.

    Raises:
        RuntimeError: Bad value, or angles turned that overflow.

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
    _, top, state0, (ts, t0) = top_and_state("state0", top, state0, ts, t0)
    check_shape("t0", t0, ())
    return settle(_motion(top, state0, ts, t0), throw, lambda: _findings(top, state0, ts, t0))


def _findings(top: SymmetricTop, state0: State, ts: Array, t0: Array) -> Findings:
    findings = Findings()
    numbers = jnp.stack(jtu.tree_leaves(top))
    findings.require(top.is_valid, RESULTS.invalid_top, value=numbers)
    components = jnp.concatenate([state0.attitude, state0.omega])
    findings.require(all_finite(state0), RESULTS.invalid_state, value=components)
    findings.require(is_unit(state0.attitude), RESULTS.invalid_attitude, value=state0.attitude)
    findings.require(all_finite(ts), RESULTS.invalid_times, _BAD_TIMES, jnp.sum(ts))
    findings.require(all_finite(t0), RESULTS.invalid_times, _BAD_START, t0)
    told_apart = resolves(t0, safe_norm(state0.omega))
    findings.require(told_apart, RESULTS.unresolved_times, value=t0)
    return findings


@jax.jit
def _motion(top: SymmetricTop, state0: State, ts: Array, t0: Array) -> ExactStates:
    findings = _findings(top, state0, ts, t0)
    top, state0, times = harmless(findings.ok, (top, state0, ts - t0))
    kept = invariants(top, state0)
    states = jax.vmap(lambda t: state_after(kept, t))(times.reshape(-1))
    states = jtu.tree_map(lambda x: x.reshape(*ts.shape, x.shape[-1]), State(*states))
    findings.require(all_finite(states), RESULTS.nonfinite_state)
    return ExactStates(nan_where(~findings.ok, states), findings.result)
