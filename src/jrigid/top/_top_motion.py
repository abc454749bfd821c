"""The function `top_motion`: the exact state of Lagrange's top at any times."""

import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import ArrayLike

from jrigid._checks import RESULTS, Findings, check_type
from jrigid._motion_inputs import exact_motion, plain_state
from jrigid._types import Quaternion, Real, Scalar, ScalarLike, Vector
from jrigid.dynamics import ExactStates, State
from jrigid.top._lame_solution import invariants, state_after
from jrigid.top._symmetric_top import SymmetricTop


def top_motion(
    top: SymmetricTop,
    state0: State,
    ts: Real[ArrayLike, "..."],
    *,
    t0: ScalarLike = 0.0,
    throw: bool = True,
) -> ExactStates:
    r"""Exact state of Lagrange's top at any times.

    The cost does not depend on the time. One formula without Euler angles serves every
    motion: waves, cusps and loops, steady and sleeping tops, pendulums, passages
    through the vertical, and tops without weight.

    Args:
        top: The top. Its mgl may have any sign.
        state0: State at `t0`, without internal parts. Gravity acts along -z in space.
        ts: Times [s], in any order, before or after `t0`, of any shape.
        t0: Time of `state0` [s].
        throw: With False, a bad value gives NaN in its lane and a code in `result`
            instead of an error.

    Returns:
        Attitude and angular velocity (`.states`, or `.attitude` and `.omega`), with the
        shape of `ts` in front, and `result`. In float64 the error is below
        1e-13 (1 + radians turned), plus the effect of rounding in the arguments.

    Raises:
        RuntimeError: A value is bad, or the angles turned overflow.

    Gradients: those of the motion, of any order and in every mode. This holds also for
    a sleeping, steady, weightless or hanging top and through the vertical. Reverse mode
    costs a few values.
    Source: Lagrange's solution in the form derived in docs/top.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(I1=1.0, I3=0.5, mgl=1.0)
    >>> state0 = jr.top.initial_state(top, 0.5, omega3=5.0)
    >>> motion = jr.top_motion(top, state0, jnp.array([0.0, 1.0, 1e6]))
    >>> print(motion.omega.shape, motion.omega[1].round(4))
    (3, 3) [-0.3481  0.2425  5.    ]
    """
    check_type("top", top, SymmetricTop)
    numbers = top.I1, top.I3, top.mgl, ts, t0
    state0, (i1, i3, mgl, ts, t0) = plain_state("state0", state0, *numbers)
    # The same top in the dtype that it has in common with the state and the times.
    # `_check` looks at its values.
    top = SymmetricTop.unchecked(i1, i3, mgl)
    return exact_motion(_check, _flow, throw, top, state0, ts, t0)


def _check(findings: Findings, top: SymmetricTop) -> None:
    """Note whether the top is not valid."""
    findings.require(
        top.is_valid, RESULTS.invalid_top, value=jnp.stack(jtu.tree_leaves(top))
    )


def _flow(top: SymmetricTop, state0: State, t: Scalar) -> tuple[Quaternion, Vector]:
    """Attitude and angular velocity at a time t after `state0`."""
    return state_after(invariants(top, state0), t)
