"""free_rotation(): the state of a free body at any times, for moments or a tensor."""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
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
from jrigid._motion import exact_motion, plain_state
from jrigid._numerics import gauss_legendre, product, safe_norm
from jrigid._spectral import eigh, from_principal_axes
from jrigid._types import InertiaLike, Quaternion, Real, ScalarLike, Vector, VectorLike
from jrigid.dynamics import ExactStates, State
from jrigid.free._flow import Invariants, after, invariants
from jrigid.rotation import multiply, normalize

Tree = TypeVar("Tree")

# Moments whose gap turns the motion by less than this [rad] are near.
_NEAR = 1e-2


def free_rotation(
    inertia: InertiaLike,
    state0: State,
    ts: Real[ArrayLike, "..."],
    *,
    t0: ScalarLike = 0.0,
    throw: bool = True,
) -> ExactStates:
    r"""Exact state of a free body at any times, at a cost that does not depend on the time.

    One formula serves every body and every motion: any order of the moments, symmetric and
    spherical bodies and their neighbours, spin about any axis, the separatrix, rest. The moments
    need not obey the triangle inequality.

    Args:
        inertia: Principal moments, or a symmetric tensor in body axes [kg m^2].
        state0: State at `t0`, without internal parts.
        ts: Times [s], in any order, before or after `t0`, of any shape.
        t0: Time of `state0` [s].
        throw: If False, bad values give NaN states instead of an error, in their lane alone;
            `result` tells why.

    Returns:
        Attitude and angular velocity, with the shape of `ts` in front. The error is below
        1e-13 (1 + radians turned) in float64, plus what the last bits of the arguments do; energy
        and angular momentum keep their values to 1e-14, whatever the time.

    Gradients: of any order and in every mode those of the motion, also at equal moments, at spin
    about an axis, on the separatrix and at rest; reverse mode costs a few values. In a (3, 3)
    tensor first derivatives are right everywhere; second ones need distinct moments, and are NaN
    where the gap is below 1e-6 of the largest.
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
        The unit quaternion p of the rotation since the start, q(t) = q(0) p(t), and the angular
        velocity, body components [rad/s]. NaN outside positive definite inertia and finite values.

    Gradients: as those of `free_rotation`.
    Source: as `free_rotation`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> turn, omega = jr.free.relative_rotation(jnp.ones(3), jnp.array([0.0, 0.0, 1.0]), jnp.pi)
    >>> print(turn.round(6), omega)
    [0. 0. 0. 1.] [0. 0. 1.]
    """
    return where_moving(_turn, inertia, omega=omega, duration=duration)


def from_invariants(formula: Callable[[Invariants], Tree], inertia: Any, omega: Any) -> Tree:
    """A formula of the invariants of a motion; NaN outside positive inertia and finite rates."""

    def of_body(inertia: Array, omega: Array) -> Tree:
        return formula(invariants(*in_principal_axes(inertia, omega)))

    return where_moving(of_body, inertia, omega=omega)


def where_moving(formula: Callable[..., Tree], inertia: Any, **others: Any) -> Tree:
    """A formula of inertia, `omega` and scalars; NaN outside positive definite and finite ones."""
    shapes = {x: (value, 3) if x == "omega" else (value,) for x, value in others.items()}
    inertia, *numbers = shaped(inertia=(inertia, *INERTIA), **shapes)
    return where_defined(is_inertia(inertia) & all_finite(numbers), formula, inertia, *numbers)


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
    return from_principal_axes(axes, *_of_moments(moments, product("ji,j->i", axes, omega), t))


@_of_tensor.defjvp
def _of_tensor_jvp(primals: tuple, tangents: tuple) -> tuple:
    # In the principal axes a change of the tensor changes the moments, and, off its diagonal, turns
    # the axes: a motion about turned axes is the turned motion.
    (tensor, omega, t), (change, omega_change, t_change) = primals, tangents
    moments, axes = eigh(tensor, distinct=True)
    inside = product("ki,kl,lj->ij", axes, 0.5 * (change + change.T), axes)
    omega, omega_change = (product("ji,j->i", axes, x) for x in (omega, omega_change))
    value, tangent = jax.jvp(
        _of_moments, (moments, omega, t), (jnp.diagonal(inside), omega_change, t_change)
    )
    axis = jnp.eye(3, dtype=moments.dtype)
    apart = 0.5 * (jnp.roll(axis, -1, axis=0) - jnp.roll(axis, 1, axis=0))
    elements = jnp.stack([inside[1, 2], inside[2, 0], inside[0, 1]])
    slopes = jax.vmap(partial(_slope_off_diagonal, moments, omega, t))(axis, apart)
    tangent = jtu.tree_map(lambda x, y: x + product("k,kn->n", elements, y), tangent, slopes)
    return from_principal_axes(axes, *value), from_principal_axes(axes, *tangent)


def _slope_off_diagonal(
    moments: Array, omega: Array, t: Array, axis: Array, apart: Array
) -> tuple[Array, Array]:
    """Derivative of the motion with respect to an element off the diagonal of a diagonal tensor.

    It is the effect of turning the body's axes about `axis`, divided by the gap of the two moments
    that `apart` (halves of opposite sign) moves apart. Both vanish with the gap: near there the
    mean derivative of the effect replaces the quotient.
    """

    def effect(moments: Array) -> tuple[Array, Array]:
        (p, w), (dp, dw) = jax.jvp(
            lambda omega: _of_moments(moments, omega, t), (omega,), (jnp.cross(axis, omega),)
        )
        vector = jnp.cross(axis, p[1:]) - dp[1:]
        return jnp.concatenate([-dp[:1], vector]), jnp.cross(axis, w) - dw

    gap, size = 2 * jnp.sum(apart * moments), jnp.sum(jnp.abs(apart) * moments)
    near = jnp.abs(gap) * (1 + safe_norm(omega) * jnp.abs(t)) < _NEAR * size
    nodes, _ = gauss_legendre(2, moments.dtype)  # error of 1e-12 when near
    between = moments[None, :] + (nodes[:, None] - 1) * gap * apart[None, :]
    slopes = jax.vmap(lambda moments: jax.jvp(effect, (moments,), (apart,))[1])(between)
    safe = jnp.where(near, 1.0, gap)
    quotients = jtu.tree_map(lambda x: x / safe, effect(moments))
    return jtu.tree_map(lambda x, y: jnp.where(near, jnp.mean(x, axis=0), y), slopes, quotients)
