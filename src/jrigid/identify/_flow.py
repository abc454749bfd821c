"""Where a body is some time later, with derivatives made for least squares.

The free motion's derivative in a tensor is put together from the one in moments and
rates, which takes a tenth of the time of `free_rotation`'s, whose every digit holds at
repeated moments: moments nearer than a ten-millionth are taken that far apart, in the
derivatives alone.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._core.inline import inlined
from jrigid._motion import depends_on
from jrigid._numerics import product
from jrigid._spectral import eigh, from_principal_axes
from jrigid._stepping.method import Method, method_of
from jrigid._stepping.step import equal_steps
from jrigid.dynamics import State
from jrigid.free import relative_rotation
from jrigid.rotation import attitude_rate, normalize
from jrigid.systems import AbstractSystem, RigidBody

_APART = {8: 1e-7, 4: 1e-3}
# A step of 0.75 radians has an error of 1e-7 of the state.
ONE_STEP = method_of(diffrax.Dopri8())


@jax.custom_jvp
def free_flow(tensor: Array, omega: Array, t: Array) -> tuple[Array, Array]:
    """Attitude relative to that at the start and angular velocity, of a tensor; unchecked."""
    moments, axes = eigh(tensor)
    turned = relative_rotation(moments, product("ji,j->i", axes, omega), t)
    return from_principal_axes(axes, *turned)


def _with_columns(point: Array, t: Array) -> Any:
    """The motion in principal axes, and its derivatives in moments and rates, as columns."""

    def along(direction: Array) -> Any:
        motion = lambda x: inlined(relative_rotation, x[:3], x[3:], t)  # noqa: E731
        return jax.jvp(motion, (point,), (direction,))

    return jax.vmap(along, out_axes=(None, -1))(jnp.eye(6, dtype=point.dtype))


@free_flow.defjvp
def _free_flow_jvp(primals: tuple, tangents: tuple) -> tuple:
    (tensor, omega, t), (change, omega_change, t_change) = primals, tangents
    moments, axes = eigh(tensor)
    omega, omega_change = (product("ji,j->i", axes, x) for x in (omega, omega_change))
    apart = 1 + _APART[moments.dtype.itemsize]
    middle = jnp.maximum(moments[1], apart * moments[0])
    moments = jnp.stack([moments[0], middle, jnp.maximum(moments[2], apart * middle)])
    point = jnp.concatenate([moments, omega])
    (p, w), (p_columns, w_columns) = inlined(_with_columns, point, t)
    # Off the diagonal a change of the tensor turns the principal axes.
    inside = product("ki,kl,lj->ij", axes, 0.5 * (change + change.T), axes)
    a, b, c = moments
    turn = jnp.stack(
        [inside[1, 2] / (b - c), inside[2, 0] / (c - a), inside[0, 1] / (a - b)]
    )
    columns = jnp.concatenate(
        [jnp.diagonal(inside), omega_change - jnp.cross(turn, omega)]
    )
    p_change, w_change = (
        product("ij,j->i", x, columns) for x in (p_columns, w_columns)
    )
    vector = p_change[1:] + jnp.cross(turn, p[1:])
    p_change = jnp.concatenate([p_change[:1], vector]) + t_change * attitude_rate(p, w)
    slope = jnp.cross(moments * w, w) / moments
    w_change = w_change + jnp.cross(turn, w) + t_change * slope
    return from_principal_axes(axes, p, w), from_principal_axes(
        axes, p_change, w_change
    )


def forced_flow(
    system: AbstractSystem,
    state: State,
    t0: Array,
    t1: Array,
    depends_on_attitude: bool,
    method: Method = ONE_STEP,
    steps: int = 1,
) -> State:
    """State at t1, later or earlier than t0, by equal steps without an error estimate.

    The default is one step, for a part of a turn. Where nothing depends on the
    attitude, the attitude stays as it is.

    Gradients: in every mode, of every order.
    """

    def rates(t: Array, y: Array) -> Array:
        attitude = y[:4] if depends_on_attitude else state.attitude
        slope = system.vector_field(t, State(attitude, y[-3:]), None)
        if not depends_on_attitude:
            return slope.omega
        return jnp.concatenate([slope.attitude, slope.omega])

    start = state.omega
    if depends_on_attitude:
        start = jnp.concatenate([state.attitude, state.omega])
    end = equal_steps(method, rates, t0, (t1 - t0) / steps, start, steps)
    attitude = normalize(end[:4]) if depends_on_attitude else state.attitude
    return State(attitude, end[-3:])


def needs_attitude(system: RigidBody) -> bool:
    """Whether the torque looks at the attitude, as far as its program shows."""

    def torque(q: Array) -> Array:
        state = system.with_parts(State(q, jnp.zeros(3)))
        return system.torque_on(jnp.zeros(()), state, None)

    return not system.is_free and depends_on(torque, jnp.array([1.0, 0, 0, 0]))
