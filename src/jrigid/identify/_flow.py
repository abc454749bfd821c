"""State of a body some time later, with derivatives made for least squares.

The derivative of free motion in a tensor is assembled from those in moments and rates.
This takes a tenth of the time of `free_rotation`'s derivative, which is exact at
repeated moments too. Here moments nearer to each other than one part in 1e8 (in float32
in 1e3) are taken to be that far apart in the derivative.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._core.inline import inlined
from jrigid._motion_inputs import depends_on
from jrigid._numerics import product
from jrigid._spectral import eigh, from_principal_axes
from jrigid._stepping.method import Method, method_of
from jrigid._stepping.step import Field, equal_steps
from jrigid.dynamics import State
from jrigid.free import relative_rotation
from jrigid.rotation import attitude_rate, normalize
from jrigid.systems import AbstractSystem, RigidBody

# Least relative distance of moments in derivatives, by the size of the dtype in bytes.
_APART = {8: 1e-8, 4: 1e-3}
# A step of 0.75 radians has an error of 1e-7 of the state.
ONE_STEP = method_of(diffrax.Dopri8())


@jax.custom_jvp
def free_flow(tensor: Array, omega: Array, t: Array) -> tuple[Array, Array]:
    """Turn since time 0 and angular velocity at t of a free body; unchecked."""
    moments, axes = eigh(tensor)
    turned = relative_rotation(moments, product("ji,j->i", axes, omega), t)
    return from_principal_axes(axes, *turned)


def _motion_and_columns(
    point: Array, t: Array
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Motion in principal axes, and its derivatives in moments and rates as columns.

    Args:
        point: Moments and rates (6,).
        t: Time.
    """

    def motion(point: Array) -> tuple[Array, Array]:
        # `inlined` saves tracing time: a fit evaluates this under nested vmaps.
        return inlined(relative_rotation, point[:3], point[3:], t)

    def derivative(
        direction: Array,
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        return jax.jvp(motion, (point,), (direction,))

    # The motion is the same for all directions, and is computed once.
    directions = jnp.eye(6, dtype=point.dtype)
    return jax.vmap(derivative, out_axes=(None, -1))(directions)


def _kept_apart(moments: Array) -> Array:
    """Ascending moments, moved apart where they nearly coincide."""
    apart = 1 + _APART[moments.dtype.itemsize]
    middle = jnp.maximum(moments[1], apart * moments[0])
    return jnp.stack([moments[0], middle, jnp.maximum(moments[2], apart * middle)])


def _turn_of_axes(moments: Array, change: Array) -> Array:
    """Rotation vector of the principal axes, along them, for a change of the tensor.

    To first order the off-diagonal change of a tensor in its principal axes turns them
    by change[i, j] / (moments[i] - moments[j]).

    Args:
        moments: Moments, all different.
        change: Change of the tensor in principal axes.
    """
    a, b, c = moments
    return jnp.stack(
        [change[1, 2] / (b - c), change[2, 0] / (c - a), change[0, 1] / (a - b)]
    )


@free_flow.defjvp
def _free_flow_jvp(
    primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Derivative of `free_flow`.

    A change of the tensor changes the moments and turns the principal axes. As seen
    from the axes, the initial rates turn the other way, and the result turns with them.
    """
    tensor, omega, t = primals
    change, omega_change, t_change = tangents
    moments, axes = eigh(tensor)
    omega = product("ji,j->i", axes, omega)
    omega_change = product("ji,j->i", axes, omega_change)
    exact = jnp.concatenate([moments, omega])
    # The turn of the axes divides by the gaps.
    moments = _kept_apart(moments)
    apart = jnp.concatenate([moments, omega])
    (p, w), (p_columns, w_columns) = inlined(_motion_and_columns, apart, t)
    if p.dtype == jnp.float64:
        # A second evaluation would take as long again. The next order of this step is
        # 1e-16 of the square of the angle turned.
        step = exact - apart
        value = (
            p + product("ij,j->i", p_columns, step),
            w + product("ij,j->i", w_columns, step),
        )
    else:
        value = inlined(relative_rotation, exact[:3], omega, t)
    # `eigh` reads the symmetric part of a tensor alone.
    inside = product("ki,kl,lj->ij", axes, 0.5 * (change + change.T), axes)
    turn = _turn_of_axes(moments, inside)
    columns = jnp.concatenate(
        [jnp.diagonal(inside), omega_change - jnp.cross(turn, omega)]
    )
    # The columns are derivatives in the frame of the axes. The turn of that frame
    # follows.
    p_change = product("ij,j->i", p_columns, columns)
    w_change = product("ij,j->i", w_columns, columns)
    vector = p_change[1:] + jnp.cross(turn, p[1:])
    p_change = jnp.concatenate([p_change[:1], vector]) + t_change * attitude_rate(p, w)
    # Euler's equations: the time derivative of the rates.
    slope = jnp.cross(moments * w, w) / moments
    w_change = w_change + jnp.cross(turn, w) + t_change * slope
    return (
        from_principal_axes(axes, *value),
        from_principal_axes(axes, p_change, w_change),
    )


def forced_flow(
    system: AbstractSystem,
    state: State,
    t0: Array,
    t1: Array,
    depends_on_attitude: bool,
    method: Method = ONE_STEP,
    steps: int | Array = 1,
    jumps: int = 0,
) -> State:
    """State at t1, before or after t0, by equal steps without an error estimate.

    The default is one step, which suffices for a part of a turn where the torque
    changes no faster than the body turns. If nothing depends on the attitude, the
    attitude stays as it is.

    Args:
        system: The body.
        state: State at t0.
        t0: Time of the given state [s].
        t1: Time of the result [s].
        depends_on_attitude: Whether the attitude is integrated.
        method: Runge-Kutta method.
        steps: How many steps are made, from each jump to the next.
        jumps: At how many of the times steps end that the system declares as jumps: the
            first ones after t0.

    Gradients: in every mode, of every order; forward alone where `steps` is an array.
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
    pieces = steps if isinstance(steps, int) else steps.astype(t0.dtype)

    def smooth_part(field: Field, y: Array, start: Array, end: Array) -> Array:
        return equal_steps(method, field, start, (end - start) / pieces, y, steps)

    def to_jump(place: tuple[Array, Array], jump: Array) -> tuple[Any, None]:
        y, t = place
        return (smooth_part(_between(rates, t, jump), y, t, jump), jump), None

    if jumps:
        stops = _stops(system.jumps.astype(t0.dtype), t0, t1, jumps)
        (end, _), _ = jax.lax.scan(to_jump, (start, t0), stops)
    else:
        end = smooth_part(rates, start, t0, t1)
    # Runge-Kutta steps do not keep the norm of a quaternion.
    attitude = normalize(end[:4]) if depends_on_attitude else state.attitude
    return State(attitude, end[-3:])


def _stops(jumps: Array, t0: Array, t1: Array, count: int) -> Array:
    """The first jumps on the way from t0 to t1, then t1 (count + 1,)."""
    way = jnp.where(t1 < t0, t0 - jumps, jumps - t0)
    passed = (way >= 0) & (way <= jnp.abs(t1 - t0))
    nearest = jnp.argsort(jnp.where(passed, way, jnp.inf))[:count]
    # Where there are fewer, the steps to the last ones have no length.
    stops = jnp.where(passed, jumps, t1)[nearest]
    return jnp.concatenate([stops, t1[None]])


def _between(field: Field, start: Array, end: Array) -> Field:
    """The vector field between two jumps, on their inner sides at the jumps."""
    beside = 4 * jnp.finfo(start.dtype).eps * jnp.maximum(jnp.abs(start), jnp.abs(end))
    first = jnp.minimum(start, end) + beside
    last = jnp.maximum(start, end) - beside

    def inside(t: Array, y: Array) -> Array:
        # The shift is rounding, and derivatives in time are those of t.
        return field(t + jax.lax.stop_gradient(jnp.clip(t, first, last) - t), y)

    return inside


def needs_attitude(system: RigidBody) -> bool:
    """Whether the torque depends on the attitude, by its traced program."""

    def torque(q: Array) -> Array:
        state = system.with_parts(State(q, jnp.zeros(3)))
        return system.torque_on(jnp.zeros(()), state, None)

    return not system.is_free and depends_on(torque, jnp.array([1.0, 0, 0, 0]))
