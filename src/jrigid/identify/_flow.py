"""Where a body is some time later, with derivatives made for least squares.

The free motion's derivative in a tensor is put together from the one in moments and rates, which
takes a tenth of the time of `free_rotation`'s, whose every digit holds at repeated moments: moments
nearer than a ten-millionth are taken that far apart, in the derivatives alone.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._motion import depends_on
from jrigid._numerics import product
from jrigid._spectral import eigh, from_principal_axes
from jrigid.dynamics import State
from jrigid.free import relative_rotation
from jrigid.rotation import attitude_rate, normalize
from jrigid.systems import AbstractSystem, RigidBody

_APART = {8: 1e-7, 4: 1e-3}


@jax.custom_jvp
def free_flow(tensor: Array, omega: Array, t: Array) -> tuple[Array, Array]:
    """Attitude relative to that at the start and angular velocity, of a tensor; unchecked."""
    moments, axes = eigh(tensor)
    turned = relative_rotation(moments, product("ji,j->i", axes, omega), t)
    return from_principal_axes(axes, *turned)


@free_flow.defjvp
def _free_flow_jvp(primals: tuple, tangents: tuple) -> tuple:
    (tensor, omega, t), (change, omega_change, t_change) = primals, tangents
    moments, axes = eigh(tensor)
    omega, omega_change = (product("ji,j->i", axes, x) for x in (omega, omega_change))
    apart = 1 + _APART[moments.dtype.itemsize]
    middle = jnp.maximum(moments[1], apart * moments[0])
    moments = jnp.stack([moments[0], middle, jnp.maximum(moments[2], apart * middle)])
    motion, point = lambda x: relative_rotation(x[:3], x[3:], t), jnp.concatenate([moments, omega])
    along = jax.vmap(lambda x: jax.jvp(motion, (point,), (x,)), out_axes=(None, -1))
    (p, w), (p_columns, w_columns) = along(jnp.eye(6, dtype=point.dtype))
    # Off the diagonal a change of the tensor turns the principal axes.
    inside = product("ki,kl,lj->ij", axes, 0.5 * (change + change.T), axes)
    a, b, c = moments
    turn = jnp.stack([inside[1, 2] / (b - c), inside[2, 0] / (c - a), inside[0, 1] / (a - b)])
    columns = jnp.concatenate([jnp.diagonal(inside), omega_change - jnp.cross(turn, omega)])
    p_change, w_change = (product("ij,j->i", x, columns) for x in (p_columns, w_columns))
    vector = p_change[1:] + jnp.cross(turn, p[1:])
    p_change = jnp.concatenate([p_change[:1], vector]) + t_change * attitude_rate(p, w)
    slope = jnp.cross(moments * w, w) / moments
    w_change = w_change + jnp.cross(turn, w) + t_change * slope
    return from_principal_axes(axes, p, w), from_principal_axes(axes, p_change, w_change)


def forced_flow(
    system: AbstractSystem, state: State, t0: Array, t1: Array, on_attitude: bool, reverse: bool
) -> State:
    """State at t1, by one fixed step: for times of a part of a turn, forward or back.

    Where nothing depends on the attitude it stays as it is. What allows reverse mode is slower.
    """
    span, zero, one = t1 - t0, jnp.zeros_like(t0), jnp.ones_like(t0)

    def rate(s: Any, y: Any, args: Any) -> Any:
        now = State(y[0] if on_attitude else state.attitude, y[-1])
        slope = system.vector_field(t0 + s * span, now, args)
        return tuple(span * x for x in (slope.attitude, slope.omega)[-len(y) :])

    term, start = diffrax.ODETerm(rate), (state.attitude, state.omega)[not on_attitude :]
    # 1e-7 of the state in a segment of 0.75 radians.
    solver = diffrax.Dopri8(scan_kind="bounded" if reverse else "lax")
    begin = solver.init(term, zero, one, start, None)
    end, *_ = solver.step(term, zero, one, start, None, begin, False)
    return State(normalize(end[0]) if on_attitude else state.attitude, end[-1])


def depends_on_attitude(system: RigidBody) -> bool:
    """Whether the torque looks at the attitude, as far as its program shows."""

    def torque(q: Array) -> Array:
        state = system.with_parts(State(q, jnp.zeros(3)))
        return system.torque_on(jnp.zeros(()), state, None)

    return not system.is_free and depends_on(torque, jnp.array([1.0, 0, 0, 0]))
