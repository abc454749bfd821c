"""free_rotation(): the state of a free body at any times, for moments or a tensor."""

import math
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from jrigid._checks import (
    INERTIA,
    RESULTS,
    Findings,
    all_finite,
    check_shape,
    is_inertia,
    shaped,
    where_defined,
)
from jrigid._core.lanes import as_lanes, some_at_a_time
from jrigid._core.third_party import unvmap_any
from jrigid._motion import exact_motion, plain_state
from jrigid._numerics import product, safe_norm
from jrigid._spectral import eigh, from_principal_axes
from jrigid._types import InertiaLike, Quaternion, Real, ScalarLike, Vector, VectorLike
from jrigid.dynamics import ExactStates, State
from jrigid.free._jacobi_solution import Invariants, after, invariants
from jrigid.rotation import multiply, normalize

Tree = TypeVar("Tree")

# Moments whose gap turns the motion by less than this [rad] are near: wider ones
# interpolate to 1e-13, and so much is lost in a quotient.
_NEAR = {8: 2e-3, 4: 3e-2}
# Where to look besides: how many times further apart, and the weight of what is found
# there.
_NODES = (-4.0, -3.0, -2.0, 2.0, 3.0, 4.0)
_LOOKS = [
    *((0.0, 0.0), (1.0, 0.0)),
    *((x, math.prod(y / (y - x) for y in _NODES if y != x)) for x in _NODES),
]
# The second look is at a gap of this, over the square of the radians: no motion changes
# within it.
_PROBE = 1e-2


def free_rotation(
    inertia: InertiaLike,
    state0: State,
    ts: Real[ArrayLike, "..."],
    *,
    t0: ScalarLike = 0.0,
    throw: bool = True,
) -> ExactStates:
    r"""Exact state of a free body at any times, at a cost that does not depend on the time.

    One formula serves every body and every motion: any order of the moments, symmetric
    and spherical bodies and their neighbours, spin about any axis, the separatrix,
    rest. The moments need not obey the triangle inequality.

    Args:
        inertia: Principal moments, or a symmetric tensor in body axes [kg m^2].
        state0: State at `t0`, without internal parts.
        ts: Times [s], in any order, before or after `t0`, of any shape.
        t0: Time of `state0` [s].
        throw: If False, bad values give NaN states instead of an error, in their lane
            alone; `result` tells why.

    Returns:
        Attitude and angular velocity, with the shape of `ts` in front. The error is
        below 1e-13 (1 + radians turned) in float64, plus what the last bits of the
        arguments do; energy and angular momentum keep their values to 1e-14, whatever
        the time.

    Gradients: of any order and in every mode those of the motion, also at equal
    moments, at spin about an axis, on the separatrix and at rest; reverse mode costs a
    few values. In a (3, 3) tensor first derivatives are right everywhere; second ones
    need distinct moments, and are NaN where the gap is below 1e-6 of the largest.
    Source: Jacobi's solution in the form derived in docs/free_rotation.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.01, 1.0, 0.0]))
    >>> motion = jr.free_rotation(jnp.array([1.0, 2.0, 3.0]), state0, jnp.array([0.0, 10.0, 1e6]))
    >>> print(motion.omega.shape, motion.omega[1].round(4))
    (3, 3) [ 0.9768  0.2145 -0.5639]
    """
    state0, (inertia, ts, t0) = plain_state("state0", state0, inertia, ts, t0)
    check_shape("inertia", inertia, *INERTIA)
    return exact_motion(_check, _flow, throw, inertia, state0, ts, t0)


def _check(findings: Findings, inertia: Array) -> None:
    findings.require(is_inertia(inertia), RESULTS.invalid_inertia, value=inertia)


def _flow(inertia: Array, state0: State, t: Array) -> tuple[Array, Array]:
    turn, omega = _turn(inertia, state0.omega, t)
    return multiply(normalize(state0.attitude), turn), omega


def relative_rotation(
    inertia: InertiaLike, omega: VectorLike, duration: ScalarLike
) -> tuple[Quaternion, Vector]:
    """The flow of a free body without its attitude: how it has turned, and its angular velocity.

    Args:
        inertia: Principal moments, or a symmetric tensor in body axes [kg m^2].
        omega: Angular velocity at the start, body components [rad/s].
        duration: Time since then [s], of either sign.

    Returns:
        The unit quaternion p of the rotation since the start, q(t) = q(0) p(t), and the
        angular velocity, body components [rad/s]. NaN outside positive definite inertia
        and finite values.

    Gradients: as those of `free_rotation`.
    Source: as `free_rotation`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> turn, omega = jr.free.relative_rotation(jnp.ones(3), jnp.array([0.0, 0.0, 1.0]), jnp.pi)
    >>> print(turn.round(6), omega)
    [0. 0. 0. 1.] [0. 0. 1.]
    """
    return where_moving(_turn, inertia, omega=omega, duration=duration)


def from_invariants(
    formula: Callable[[Invariants], Tree], inertia: Any, omega: Any
) -> Tree:
    """A formula of the invariants of a motion; NaN outside positive inertia and finite rates."""

    def of_body(inertia: Array, omega: Array) -> Tree:
        return formula(invariants(*in_principal_axes(inertia, omega)))

    return where_moving(of_body, inertia, omega=omega)


def where_moving(formula: Callable[..., Tree], inertia: Any, **others: Any) -> Tree:
    """A formula of inertia, `omega` and scalars; NaN outside positive definite and finite ones."""
    shapes = {
        x: (value, 3) if x == "omega" else (value,) for x, value in others.items()
    }
    inertia, *numbers = shaped(inertia=(inertia, *INERTIA), **shapes)
    return where_defined(
        is_inertia(inertia) & all_finite(numbers), formula, inertia, *numbers
    )


def in_principal_axes(inertia: Array, omega: Array) -> tuple[Array, Array]:
    """Moments, and the angular velocity in their axes."""
    if inertia.ndim == 1:
        return inertia, omega
    moments, axes = eigh(inertia)
    return moments, product("ji,j->i", axes, omega)


@jax.jit
def _turn(inertia: Array, omega: Array, t: Array) -> tuple[Array, Array]:
    return (_of_moments if inertia.ndim == 1 else _of_tensor)(inertia, omega, t)


def _of_moments(moments: Array, omega: Array, t: Array) -> tuple[Array, Array]:
    return after(invariants(moments, omega), t)


@jax.custom_jvp
def _of_tensor(tensor: Array, omega: Array, t: Array) -> tuple[Array, Array]:
    moments, axes = eigh(tensor)
    return from_principal_axes(
        axes, *_of_moments(moments, product("ji,j->i", axes, omega), t)
    )


@_of_tensor.defjvp
def _of_tensor_jvp(primals: tuple, tangents: tuple) -> tuple:
    # In the principal axes a change of the tensor changes the moments, and, off its
    # diagonal, turns the axes: a motion about turned axes is the turned motion.
    (tensor, omega, t), (change, omega_change, t_change) = primals, tangents
    moments, axes = eigh(tensor, distinct=True)
    inside = product("ki,kl,lj->ij", axes, 0.5 * (change + change.T), axes)
    omega, omega_change = (product("ji,j->i", axes, x) for x in (omega, omega_change))
    value, slopes = _with_slopes(moments, omega, t)
    elements = jnp.stack([inside[1, 2], inside[2, 0], inside[0, 1]])
    changes = jnp.concatenate(
        [jnp.diagonal(inside), omega_change, t_change[None], elements]
    )
    found = value, product("k,kn->n", changes, slopes)
    return tuple(from_principal_axes(axes, x[:4], x[4:]) for x in found)


@jax.custom_jvp
def _with_slopes(*arguments: Array) -> tuple[Array, Array]:
    """What `_looks` gives, for many lanes with close moments first, a few at a time."""

    def of_all(_: Any, __: Any, *lanes: Array) -> Any:
        order = jnp.argsort(~jax.vmap(lambda *x: jnp.any(_wider(*x)))(*lanes))
        return some_at_a_time(jax.vmap(_looks, -1, -1), order, *lanes)

    return as_lanes(of_all, None, *arguments)


@_with_slopes.defjvp
def _with_slopes_jvp(primals: tuple, tangents: tuple) -> tuple:
    # Lanes some at a time have no reverse mode.
    return _with_slopes(*primals), jax.jvp(_looks, primals, tangents)[1]


def _looks(moments: Array, omega: Array, t: Array) -> tuple[Array, Array]:
    """The motion with a diagonal tensor, as seven numbers, and its derivatives (10, 7).

    They are those in the moments, which ascend, in `omega` and t, and in the elements
    23, 31 and
    12. Of these each is the effect of turning the body's axes divided by the gap of two
    moments. Both vanish together: across a near gap the quotient is interpolated from
    wider ones, which costs seven looks more at the motion, unless no lane asks for it.
    How near is near depends on how fast the motion changes with a gap, which the first
    two looks tell.
    """
    directions = jnp.eye(7, dtype=t.dtype)

    def motion(x: Array) -> Array:
        return jnp.concatenate(_of_moments(x[:3], x[3:6], x[6]))

    def slopes_at(moments: Array) -> tuple[Array, Array, Array]:
        place = jnp.concatenate([moments, omega, t[None]])
        slope = lambda x: jax.jvp(motion, (place,), (x,))  # noqa: E731
        value, columns = jax.vmap(slope, out_axes=(None, 0))(directions)
        gaps = jnp.roll(moments, -1) - jnp.roll(moments, -2)
        quotients = jax.vmap(_turned, (0, 0, None, None, None))(
            directions[:3, :3],
            jnp.where(gaps == 0, 1.0, gaps),
            omega,
            value,
            columns[3:6],
        )
        return value, columns, quotients

    def steepest(slopes: Array) -> Array:  # of the attitude
        return jax.lax.stop_gradient(jnp.max(jnp.abs(slopes[:, :4])))

    def look(node: Array, weight: Array, known: tuple[Array, ...]) -> tuple[Array, ...]:
        wider, steep, value, slopes, total = known
        first, second = node == 0, node == 1
        found, columns, quotients = slopes_at(moments + node * wider)
        near = _near_pairs(wider)
        steep = jnp.where(first, steepest(columns[:3]), steep)
        steep = jnp.where(
            second, steep + steepest(jnp.where(near, quotients, 0.0)), steep
        )
        probe, reach = (
            _wider(moments, omega, t, steep, probing=x) for x in (True, False)
        )
        wider = jnp.where(first, probe, jnp.where(second, reach, wider))
        slopes = jnp.where(first, jnp.concatenate([columns, quotients]), slopes)
        total = total + jnp.where(weight == 0, 0.0, weight * quotients)
        return wider, steep, jnp.where(first, found, value), slopes, total

    def visit(
        known: tuple[Array, ...], of_node: Array
    ) -> tuple[tuple[Array, ...], None]:
        node, weight = of_node
        asked = (node == 0) | unvmap_any(known[0] != 0)
        unchanged = lambda _, __, known: known  # noqa: E731
        return jax.lax.cond(asked, look, unchanged, node, weight, known), None

    nothing = [jnp.zeros(shape, t.dtype) for shape in (3, (), 7, (10, 7), (3, 7))]
    known, _ = jax.lax.scan(visit, tuple(nothing), jnp.asarray(_LOOKS, t.dtype))
    wider, _, value, slopes, total = known
    return value, slopes.at[7:].set(jnp.where(_near_pairs(wider), total, slopes[7:]))


def _near_pairs(wider: Array) -> Array:
    """Of which pairs of moments, 23, 31 and 12, the gap is near."""
    low, _, high = wider != 0
    return jnp.stack([high, low & high, low])[:, None]


def _wider(
    moments: Array,
    omega: Array,
    t: Array,
    steep: Array | float = 0.0,
    *,
    probing: bool = False,
) -> Array:
    """How moments are moved to widen the gaps that are near, zero where none is."""
    low, phase = moments[:2], safe_norm(omega) * jnp.abs(t)
    reach = _NEAR[t.dtype.itemsize] / ((1 + phase) / low + steep)
    distance = _PROBE * low / (1 + phase * phase) if probing else reach
    low, high = jnp.where(moments[1:] - moments[:2] < reach, distance, 0.0)
    return jnp.stack([-low, jnp.zeros_like(t), high])


def _turned(
    axis: Array, gap: Array, omega: Array, value: Array, columns: Array
) -> Array:
    """The effect of turning the body's axes, divided by a gap."""
    turned = jnp.cross(axis, value[1:].reshape(2, 3)).reshape(6)
    change = product("k,kn->n", jnp.cross(axis, omega), columns)
    return jnp.concatenate([-change[:1], turned - change[1:]]) / gap
