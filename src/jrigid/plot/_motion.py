"""A trajectory, and how well it keeps what it should."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jrigid._checks import demand
from jrigid._types import VectorLike
from jrigid.plot._common import label, looks, pyplot, states_of, times_of


def motion(
    motion: Any,
    axes: Mapping[str, Any] | None = None,
    *,
    system: Any = None,
    ts: Any = None,
    along: VectorLike | None = None,
) -> dict[str, Any]:
    """The angular velocity of a motion, and the drift of its energy and angular momentum.

    "omega": body components. "drift": changes since the first finite state, relative to
    the largest value on the way: rounding and the errors of the integration where they
    are conserved, the work of the torques where they are not.

    Args:
        motion: What `simulate` returned; or `free_rotation` or `top_motion`, with
            system and times.
        axes: Matplotlib's axes by the names above, to draw only these; None: a new
            figure.
        system: The `RigidBody` or `SymmetricTop`; of a trajectory its own.
        ts: The times [s]; of a trajectory its own.
        along: Direction in space along which the momentum is compared, (0, 0, 1) for
            that about the vertical; None: the vector.

    Returns:
        The axes by their names.

    Raises:
        ImportError: Without the extra `jrigid[plot]`.
        ValueError: No system, no times, or more than one motion.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.1, 1.0, 0.2]))
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> axes = jr.plot.motion(jr.simulate(body, state0, jnp.linspace(0.0, 20.0, 200)))
    >>> print(axes["drift"].get_ylabel())
    relative change
    """
    system = getattr(motion, "system", None) if system is None else system
    demand(
        system is not None,
        "Argument `system` must be given for this motion, but it is not.",
    )
    system = system.as_rigid_body() if hasattr(system, "as_rigid_body") else system
    ts, states = times_of(motion, ts), states_of(motion)
    if axes is None:
        figure: Any = pyplot().figure(figsize=(8, 6), layout="constrained")
        axes = dict(figure.subplot_mosaic([["omega"], ["drift"]], sharex=True))
    if "omega" in axes:
        columns = zip("xyz", ("-", "--", "-."), np.asarray(states.omega).T, strict=True)
        for (colour, _), (name, style, column) in looks(columns):
            axes["omega"].plot(ts, column, style, color=colour, lw=1.2, label=name)
        label(axes["omega"], "Angular velocity", "time [s]", "in the body [rad/s]")
    if "drift" in axes:
        args, times = (
            getattr(motion, "args", None),
            jax.numpy.asarray(ts, states.omega.dtype),
        )
        kept = {"energy": system.energy, "angular momentum": system.angular_momentum}
        for (colour, marker), (name, of) in looks(kept.items()):
            each = jax.vmap(lambda t, state, of=of: of(t, state, args))
            values = np.asarray(each(times, states)).reshape(ts.size, -1)
            if along is not None and values.shape[1] > 1:
                values = values @ np.asarray(along)[:, None] / np.linalg.norm(along)
            first = values[np.argmax(np.all(np.isfinite(values), axis=1))]
            sizes, changes = (
                np.linalg.norm(x, axis=1) for x in (values, values - first)
            )
            changes = np.where(changes > 0, changes, np.nan) / (np.nanmax(sizes) or 1.0)
            axes["drift"].plot(ts, changes, marker, color=colour, ms=3, label=name)
        eps = np.finfo(times.dtype).eps
        axes["drift"].axhline(eps, color="0.5", lw=1, ls=":", label="rounding")
        axes["drift"].set_yscale("log")
        label(axes["drift"], "Drift", "time [s]", "relative change")
    return dict(axes)
