"""The function `free_rotation`, for moments and for a tensor."""

import math
from collections.abc import Callable
from typing import NamedTuple, TypeVar

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
from jrigid._core.compile import one_program
from jrigid._core.lanes import as_lanes, some_at_a_time
from jrigid._core.third_party import unvmap_any
from jrigid._motion_inputs import exact_motion, plain_state
from jrigid._numerics import product, safe_norm
from jrigid._spectral import eigh, from_principal_axes
from jrigid._types import InertiaLike, Quaternion, Real, ScalarLike, Vector, VectorLike
from jrigid.dynamics import ExactStates, State
from jrigid.free._jacobi_solution import Invariants, after, invariants
from jrigid.rotation import multiply, normalize

Tree = TypeVar("Tree")

# A gap of two moments is close if it turns the motion by less than this [rad]. A
# quotient over a wider gap loses no more than an interpolation, 1e-13.
_CLOSE = {8: 2e-3, 4: 3e-2}
# The interpolation uses gaps wider by these factors.
_NODES = (-4.0, -3.0, -2.0, 2.0, 3.0, 4.0)
# Factor and weight of each evaluation. The first two measure how fast the motion
# changes, the others are Lagrange's interpolation to a gap of zero.
_EVALUATIONS = [
    (0.0, 0.0),
    (1.0, 0.0),
    *((x, math.prod(y / (y - x) for y in _NODES if y != x)) for x in _NODES),
]
# The gap of the second evaluation is this over the square of the radians. No motion
# changes within it.
_PROBE = 1e-2


def free_rotation(
    inertia: InertiaLike,
    state0: State,
    ts: Real[ArrayLike, "..."],
    *,
    t0: ScalarLike = 0.0,
    throw: bool = True,
) -> ExactStates:
    r"""Exact state of a free body at any times.

    The cost does not depend on the time. One formula serves every body and every
    motion: any order of the moments, symmetric and spherical bodies and their
    neighbours, spin about any axis, the separatrix, rest. The moments need not obey the
    triangle inequality.

    Args:
        inertia: Principal moments, or a symmetric tensor in body axes [kg m^2].
        state0: State at `t0`, without internal parts.
        ts: Times [s], in any order, before or after `t0`, of any shape.
        t0: Time of `state0` [s].
        throw: With False, bad values give NaN states in their lane instead of an error;
            `result` holds the reason.

    Returns:
        Attitude and angular velocity, with the shape of `ts` in front. In float64 the
        error is below 1e-13 (1 + radians turned), plus the effect of rounding in the
        arguments. Energy and angular momentum are constant to 1e-14, whatever the time.

    Gradients: those of the motion, of any order and in every mode, also at equal
    moments, at spin about an axis, on the separatrix and at rest. Reverse mode costs a
    few values. In a (3, 3) tensor first derivatives are right everywhere. Second ones
    need distinct moments, and are NaN where the gap is below 1e-6 of the largest.
    Source: Jacobi's solution in the form derived in docs/free_rotation.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.01, 1.0, 0.0]))
    >>> ts = jnp.array([0.0, 10.0, 1e6])
    >>> motion = jr.free_rotation(jnp.array([1.0, 2.0, 3.0]), state0, ts)
    >>> print(motion.omega.shape, motion.omega[1].round(4))
    (3, 3) [ 0.9768  0.2145 -0.5639]
    """
    state0, (inertia, ts, t0) = plain_state("state0", state0, inertia, ts, t0)
    check_shape("inertia", inertia, *INERTIA)
    return exact_motion(_check, _flow, throw, inertia, state0, ts, t0)


def _check(findings: Findings, inertia: Array) -> None:
    """Note whether the inertia is not valid."""
    findings.require(is_inertia(inertia), RESULTS.invalid_inertia, value=inertia)


def _flow(inertia: Array, state0: State, t: Array) -> tuple[Array, Array]:
    """Attitude and angular velocity at a time t after `state0`."""
    turn, omega = _turn(inertia, state0.omega, t)
    # The rotation since the start is in body axes, so it is the factor on the right.
    return multiply(normalize(state0.attitude), turn), omega


@one_program
def relative_rotation(
    inertia: InertiaLike, omega: VectorLike, duration: ScalarLike
) -> tuple[Quaternion, Vector]:
    """Rotation of a free body since the start, and its angular velocity.

    Args:
        inertia: Principal moments, or a symmetric tensor in body axes [kg m^2].
        omega: Angular velocity at the start, body components [rad/s].
        duration: Time since then [s], of either sign.

    Returns:
        The unit quaternion p of the rotation, with q(t) = q(0) p(t), and the angular
        velocity, body components [rad/s]. NaN outside positive definite inertia and
        finite values.

    Gradients: as those of `free_rotation`.
    Source: as `free_rotation`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> spin = jnp.array([0.0, 0.0, 1.0])
    >>> turn, omega = jr.free.relative_rotation(jnp.ones(3), spin, jnp.pi)
    >>> print(turn.round(6), omega)
    [0. 0. 0. 1.] [0. 0. 1.]
    """
    return where_moving(_turn, inertia, omega=omega, duration=duration)


def from_invariants(
    formula: Callable[[Invariants], Tree], inertia: InertiaLike, omega: VectorLike
) -> Tree:
    """Apply a formula of the invariants; NaN outside positive inertia, finite rates."""

    def of_body(inertia: Array, omega: Array) -> Tree:
        return formula(invariants(*in_principal_axes(inertia, omega)))

    return where_moving(of_body, inertia, omega=omega)


def where_moving(
    formula: Callable[..., Tree], inertia: InertiaLike, **others: ArrayLike
) -> Tree:
    """Apply a formula of inertia, `omega` and scalars.

    NaN outside positive definite inertia and finite numbers.
    """
    shapes = {
        name: (value, 3) if name == "omega" else (value,)
        for name, value in others.items()
    }
    inertia, *numbers = shaped(inertia=(inertia, *INERTIA), **shapes)
    ok = is_inertia(inertia) & all_finite(numbers)
    return where_defined(ok, formula, inertia, *numbers)


def in_principal_axes(inertia: Array, omega: Array) -> tuple[Array, Array]:
    """Principal moments, and the angular velocity in their axes."""
    if inertia.ndim == 1:
        return inertia, omega
    moments, axes = eigh(inertia)
    # The columns of `axes` are the principal axes, so this is axes^T omega.
    return moments, product("ji,j->i", axes, omega)


@jax.jit
def _turn(inertia: Array, omega: Array, t: Array) -> tuple[Array, Array]:
    """Rotation since the start, and angular velocity."""
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
    # In the principal axes a change of the tensor changes the moments. Its elements off
    # the diagonal turn the axes, and a motion about turned axes is the turned motion.
    (tensor, omega, t), (change, omega_change, t_change) = primals, tangents
    moments, axes = eigh(tensor, distinct=True)
    inside = product("ki,kl,lj->ij", axes, 0.5 * (change + change.T), axes)
    omega, omega_change = (product("ji,j->i", axes, x) for x in (omega, omega_change))
    value, slopes = _with_slopes(moments, omega, t)
    # In the order of the axes about which they turn the body.
    elements = jnp.stack([inside[1, 2], inside[2, 0], inside[0, 1]])
    changes = jnp.concatenate(
        [jnp.diagonal(inside), omega_change, t_change[None], elements]
    )
    tangent = product("k,kn->n", changes, slopes)
    return tuple(from_principal_axes(axes, x[:4], x[4:]) for x in (value, tangent))


@jax.custom_jvp
def _with_slopes(*arguments: Array) -> tuple[Array, Array]:
    """The result of `_evaluate`, for many lanes a few at a time.

    Lanes with close moments come first, so that the others need not wait for them.
    """

    def any_close(moments: Array, omega: Array, t: Array) -> Array:
        return jnp.any(_widening(moments, omega, t))

    def of_lanes(_: None, __: None, *lanes: Array) -> tuple[Array, Array]:
        order = jnp.argsort(~jax.vmap(any_close)(*lanes))
        return some_at_a_time(jax.vmap(_evaluate, -1, -1), order, *lanes)

    return as_lanes(of_lanes, None, *arguments)


@_with_slopes.defjvp
def _with_slopes_jvp(primals: tuple, tangents: tuple) -> tuple:
    # A loop over a few lanes at a time has no reverse mode.
    return _with_slopes(*primals), jax.jvp(_evaluate, primals, tangents)[1]


class _Interpolation(NamedTuple):
    """The evaluations made so far."""

    widening: Array  # of the moments, per unit of a node
    steepness: Array  # of the attitude in the moments, and in the close elements
    value: Array
    slopes: Array
    quotients: Array  # interpolated


# Long: a scan with its body, whose pieces all belong to one interpolation.
def _evaluate(moments: Array, omega: Array, t: Array) -> tuple[Array, Array]:
    """The motion with a diagonal tensor, as seven numbers, and its derivatives (10, 7).

    The derivatives are those in the moments, which ascend, in `omega` and t, and in the
    elements 23, 31 and 12 of the tensor. Each of the last three is the effect of a turn
    of the body's axes divided by the gap of two moments. Both vanish together. Across a
    close gap the quotient is interpolated from wider ones, which costs seven more
    evaluations of the motion, unless no lane needs them. Which gaps are close depends
    on how fast the motion changes with a gap; the first two evaluations measure it.
    """

    def evaluate(node: Array, weight: Array, known: _Interpolation) -> _Interpolation:
        moved = moments + node * known.widening
        value, columns, quotients = _slopes_at(moved, omega, t)
        first = node == 0
        second = node == 1
        of_moments = _steepest(columns[:3])
        steepness = jnp.where(first, of_moments, known.steepness)
        of_quotients = _steepest(
            jnp.where(_close_pairs(known.widening), quotients, 0.0)
        )
        steepness = jnp.where(second, steepness + of_quotients, steepness)
        probe = _widening(moments, omega, t, steepness, probing=True)
        reach = _widening(moments, omega, t, steepness, probing=False)
        slopes = jnp.concatenate([columns, quotients])
        weighted = jnp.where(weight == 0, 0.0, weight * quotients)
        return _Interpolation(
            widening=jnp.where(first, probe, jnp.where(second, reach, known.widening)),
            steepness=steepness,
            value=jnp.where(first, value, known.value),
            slopes=jnp.where(first, slopes, known.slopes),
            quotients=known.quotients + weighted,
        )

    def skip(_: Array, __: Array, known: _Interpolation) -> _Interpolation:
        return known

    def visit(
        known: _Interpolation, node_and_weight: Array
    ) -> tuple[_Interpolation, None]:
        node, weight = node_and_weight
        # Under vmap a condition of each lane would turn `cond` into a select, which
        # evaluates both sides. This one is common to all lanes.
        needed = (node == 0) | unvmap_any(known.widening != 0)
        return jax.lax.cond(needed, evaluate, skip, node, weight, known), None

    shapes = (3, (), 7, (10, 7), (3, 7))
    nothing = _Interpolation(*(jnp.zeros(shape, t.dtype) for shape in shapes))
    known, _ = jax.lax.scan(visit, nothing, jnp.asarray(_EVALUATIONS, t.dtype))
    close = _close_pairs(known.widening)
    of_elements = jnp.where(close, known.quotients, known.slopes[7:])
    return known.value, known.slopes.at[7:].set(of_elements)


def _slopes_at(moments: Array, omega: Array, t: Array) -> tuple[Array, Array, Array]:
    """The motion, and its derivatives in (moments, rates, t) and in the elements."""

    def motion(x: Array) -> Array:
        return jnp.concatenate(_of_moments(x[:3], x[3:6], x[6]))

    def along(direction: Array) -> tuple[Array, Array]:
        return jax.jvp(motion, (arguments,), (direction,))

    directions = jnp.eye(7, dtype=t.dtype)
    arguments = jnp.concatenate([moments, omega, t[None]])
    value, columns = jax.vmap(along, out_axes=(None, 0))(directions)
    # I2 - I3, I3 - I1 and I1 - I2, for the elements 23, 31 and 12.
    gaps = jnp.roll(moments, -1) - jnp.roll(moments, -2)
    quotients = jax.vmap(_turned, (0, 0, None, None, None))(
        directions[:3, :3],
        jnp.where(gaps == 0, 1.0, gaps),
        omega,
        value,
        columns[3:6],
    )
    return value, columns, quotients


def _steepest(slopes: Array) -> Array:
    """Largest derivative of the attitude."""
    return jax.lax.stop_gradient(jnp.max(jnp.abs(slopes[:, :4])))


def _close_pairs(widening: Array) -> Array:
    """Whether each pair of moments, 23, 31 and 12, has a close gap."""
    # The gap between I1 and I3 is close only where both others are.
    low, _, high = widening != 0
    return jnp.stack([high, low & high, low])[:, None]


def _widening(
    moments: Array,
    omega: Array,
    t: Array,
    steepness: Array | float = 0.0,
    *,
    probing: bool = False,
) -> Array:
    """Changes of the moments that widen the close gaps; zero where none is close."""
    low = moments[:2]
    phase = safe_norm(omega) * jnp.abs(t)
    # A gap x turns the motion by about x times the sum in this denominator.
    reach = _CLOSE[t.dtype.itemsize] / ((1 + phase) / low + steepness)
    distance = _PROBE * low / (1 + phase * phase) if probing else reach
    low, high = jnp.where(moments[1:] - moments[:2] < reach, distance, 0.0)
    return jnp.stack([-low, jnp.zeros_like(t), high])


def _turned(
    axis: Array, gap: Array, omega: Array, value: Array, columns: Array
) -> Array:
    """Effect on the motion of a turn of the body's axes, divided by a gap."""
    # A small turn R changes the element 23 of a diagonal tensor by its angle about axis
    # 1 times I2 - I3. The motion F obeys F(R I R^T, omega) = R F(I, R^T omega).
    turned = jnp.cross(axis, value[1:].reshape(2, 3)).reshape(6)
    change = product("k,kn->n", jnp.cross(axis, omega), columns)
    return jnp.concatenate([-change[:1], turned - change[1:]]) / gap
