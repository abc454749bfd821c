"""Final spin of a body with internal dissipation (major-axis rule)."""

import math
from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._checks import RESULTS, Enumeration, settle, whole_number
from jrigid._core.compile import quick_jit
from jrigid._core.lanes import in_blocks
from jrigid._numerics import safe_norm
from jrigid._types import Scalar, ScalarLike
from jrigid.dynamics import State
from jrigid.mass import principal_axes
from jrigid.stability._stepped_motion import (
    Motion,
    Walk,
    findings_of,
    motion_of,
    verdict,
    walk,
)
from jrigid.systems import RigidBody

_SETTLED = 5.0  # degrees from an axis within which a body counts as turning about it


class SIDES(Enumeration):
    """Direction of the final spin along the axis of largest moment."""

    along = "along"
    not_settled = "not settled"
    against = "against"
    undefined = "undefined"


class FinalSpin(NamedTuple):
    """Spin of a tumbling body after a time.

    Attributes:
        side: One of `SIDES`: whether the body turns along the axis of largest moment,
            against it, or is not within 5 degrees of either.
        alignment: Cosine of the angle between the angular velocity and that axis.
        state: State at the end.
        error: Largest local error of a step, in the scales of the variables.
        result: `jrigid.RESULTS`.
    """

    side: SIDES
    alignment: Scalar
    state: State
    error: Scalar
    result: RESULTS


def final_spin(
    system: RigidBody,
    state0: State,
    duration: ScalarLike,
    steps: int,
    args: Any = None,
    *,
    t0: ScalarLike = 0.0,
    solver: diffrax.AbstractSolver | None = None,
    throw: bool = True,
) -> FinalSpin:
    """Final spin direction of a body with internal dissipation (major-axis rule).

    A loss inside the body, such as in a `torques.InternalDamper`, takes energy but no
    angular momentum from it, until it spins about the axis of largest moment. The
    direction along that axis is decided where the motion crosses the separatrix, and
    depends so finely on the initial state that it looks random. The axis and its sign
    are those of `principal_axes` (of moments, the body axis itself). A body with two
    equal largest moments has no axis to settle about.

    Args:
        system: The body and its damping.
        state0: State at which the motion starts.
        duration: Length of the motion [s].
        steps: Number of equal steps. Each turn of the fastest part needs some 20 to 60.
        args: Passed to the torque.
        t0: Time at the start [s].
        solver: A diffrax solver with an error estimate; `diffrax.Dopri8()` by default.
        throw: With False, a bad or an inaccurate lane gives a result code and NaN.

    Returns:
        The side, or that the body has not settled.

    Raises:
        RuntimeError: A value is bad, or the steps are too coarse.

    Gradients: of the state and the alignment, in forward mode. The side has none.
    Source: R. N. Bracewell, O. K. Garriott, Nature 182 (1958) 760, for the rule.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> damper = jr.torques.InternalDamper(0.3, 0.2)
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]), damper)
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 0.1, 0.2]))
    >>> final = jr.stability.final_spin(body, state0, 500.0, 2000)
    >>> print(abs(final.alignment).round(6), jr.stability.SIDES[final.side])
    1.0 against
    """
    steps = whole_number("steps", steps)
    motion = motion_of(system, state0, args, t0, duration, solver)
    return settle(_final_spin(motion, steps), throw, findings_of, motion)


@quick_jit
def _final_spin(motion: Motion, steps: int) -> FinalSpin:
    findings = findings_of(motion)
    path = walk(motion, steps, findings.ok)

    def end_of(path: Walk, y: Array) -> tuple[Array, Array]:
        return path.follow(0, steps, y)

    y, error = in_blocks(end_of, path, path.start)
    state = path.state(y)
    alignment = _alignment(path.motion.system.inertia, state.omega)
    alignment, state = verdict(findings, path, path.end, error, (alignment, state))
    # From here on `findings` includes the accuracy, which `verdict` has noted.
    settled = jnp.abs(alignment) > math.cos(math.radians(_SETTLED))
    side = SIDES.where(alignment > 0, SIDES.along, SIDES.against)
    side = SIDES.where(settled, side, SIDES.not_settled)
    # A comparison with NaN is False, which would read as not settled.
    side = SIDES.where(findings.ok, side, SIDES.undefined)
    return FinalSpin(side, alignment, state, error, findings.result)


def _alignment(inertia: Array, omega: Array) -> Scalar:
    """Cosine of the angle between spin and axis of largest moment; 0 at rest."""
    if inertia.ndim == 1:
        # Given moments may be in any order; those of `principal_axes` ascend.
        axis = jnp.eye(3, dtype=omega.dtype)[jnp.argmax(inertia)]
    else:
        # The inertia of a system need not have the dtype of the state.
        axis = principal_axes(inertia).axes[:, 2].astype(omega.dtype)
    rate = safe_norm(omega)
    return jnp.sum(omega * axis) / jnp.where(rate > 0, rate, 1.0)
