"""A trajectory, and how well it keeps what it should."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from jrigid._checks import check_option, check_shape, demand
from jrigid._motion_inputs import HasRigidBody
from jrigid._types import AnyArray, VectorLike
from jrigid.plot._drawing import (
    Axes,
    Motion,
    label,
    looks,
    pyplot,
    states_of,
    times_of,
)
from jrigid.simulate import Trajectory
from jrigid.systems import AbstractSystem


def motion(
    motion: Motion,
    axes: Mapping[str, Axes] | None = None,
    *,
    system: AbstractSystem | HasRigidBody | None = None,
    ts: AnyArray | None = None,
    along: VectorLike | None = None,
) -> dict[str, Axes]:
    """Draw the angular velocity of a motion, and the drift of what it may conserve.

    "omega" shows body components. "drift" shows changes of energy and angular momentum
    since the first finite state, relative to the largest value on the way. Where they
    are conserved these are rounding and the errors of the integration; elsewhere they
    are the work of the torques.

    Args:
        motion: What `simulate` returned; or `free_rotation` or `top_motion`, with
            system and times.
        axes: Matplotlib's axes by the names above, to draw only these; None: a new
            figure.
        system: The `RigidBody` or `SymmetricTop`; of a trajectory its own.
        ts: The times [s]; of a trajectory its own.
        along: Direction in space along which the angular momentum is compared, (0, 0,
            1) for that about the vertical; None: the vector.

    Returns:
        The axes by their names.

    Raises:
        ImportError: Without the extra `jrigid[plot]`.
        ValueError: No system, no times, more than one motion, axes of another name, or
            no direction.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.1, 1.0, 0.2]))
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> axes = jr.plot.motion(jr.simulate(body, state0, jnp.linspace(0.0, 20.0, 200)))
    >>> print(axes["drift"].get_ylabel())
    relative change
    """
    for name in axes or {}:
        check_option("axes", name, ("omega", "drift"))
    if along is not None:
        along = np.asarray(along, float)
        check_shape("along", along, (3,))
        message = "Argument `along` must be a direction, but its length is 0 or NaN."
        demand(bool(np.linalg.norm(along) > 0), message)
    body = _system_of(motion, system)
    times = times_of(motion, ts)
    omegas = np.asarray(states_of(motion).omega)
    if axes is None:
        figure: Any = pyplot().figure(figsize=(8, 6), layout="constrained")
        axes = dict(figure.subplot_mosaic([["omega"], ["drift"]], sharex=True))
    if "omega" in axes:
        _draw_rates(axes["omega"], times, omegas)
    if "drift" in axes:
        _draw_drift(axes["drift"], body, motion, times, along)
    return dict(axes)


def _system_of(
    motion: Motion, system: AbstractSystem | HasRigidBody | None
) -> AbstractSystem:
    """The system given, or that of a trajectory."""
    if system is None and isinstance(motion, Trajectory):
        system = motion.system
    if system is None:
        raise ValueError(
            "Argument `system` must be given for this motion, but it is not."
        )
    return system.as_rigid_body() if isinstance(system, HasRigidBody) else system


def _draw_rates(ax: Axes, times: np.ndarray, omegas: np.ndarray) -> None:
    """Draw the angular velocity in the body."""
    columns = zip("xyz", ("-", "--", "-."), omegas.T, strict=True)
    for (colour, _), (name, style, column) in looks(columns):
        ax.plot(times, column, style, color=colour, lw=1.2, label=name)
    label(ax, "Angular velocity", "time [s]", "in the body [rad/s]")


def _draw_drift(
    ax: Axes,
    system: AbstractSystem,
    motion: Motion,
    ts: np.ndarray,
    along: VectorLike | None,
) -> None:
    """Draw the relative changes of energy and angular momentum."""
    states = states_of(motion)
    times = jax.numpy.asarray(ts, states.omega.dtype)
    args = motion.args if isinstance(motion, Trajectory) else None
    quantities: dict[str, Callable[..., Array]] = {
        "energy": system.energy,
        "angular momentum": system.angular_momentum,
    }
    for (colour, marker), (name, quantity) in looks(quantities.items()):
        each = jax.vmap(quantity, in_axes=(0, 0, None))
        values = np.asarray(each(times, states, args)).reshape(ts.size, -1)
        if along is not None and values.shape[1] > 1:
            values = values @ np.asarray(along)[:, None] / np.linalg.norm(along)
        changes = _relative_changes(values)
        ax.plot(ts, changes, marker, color=colour, ms=3, label=name)
    # This is the dtype of the states, which may be in single precision.
    eps = np.finfo(times.dtype).eps
    ax.axhline(eps, color="0.5", lw=1, ls=":", label="rounding")
    ax.set_yscale("log")
    label(ax, "Drift", "time [s]", "relative change")


def _relative_changes(values: np.ndarray) -> np.ndarray:
    """Changes since the first finite row over the largest; NaN where there is none."""
    first = values[np.argmax(np.all(np.isfinite(values), axis=1))]
    sizes = np.linalg.norm(values, axis=1)
    changes = np.linalg.norm(values - first, axis=1)
    # A logarithmic axis cannot show zero.
    return np.where(changes > 0, changes, np.nan) / (np.nanmax(sizes) or 1.0)
