"""free_rotation(): the state of a free body at any times, for moments or a tensor."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_inertia_shape,
    check_shape,
    float_arrays,
    is_inertia,
    is_unit,
    settle,
    where_defined,
)
from jrigid._motion import plain_state, resolves
from jrigid._numerics import product, safe_norm
from jrigid._spectral import eigh, eigh_of_distinct, from_principal_axes
from jrigid._types import InertiaLike, Quaternion, Real, ScalarLike, Vector, VectorLike
from jrigid.dynamics import ExactStates, State
from jrigid.free._flow import Invariants, after, invariants
from jrigid.rotation import multiply, normalize

Tree = TypeVar("Tree")

# Moments whose gap turns the motion by less than this [rad] are near.
_NEAR = 1e-2
_NODES = (0.5 - 0.5 / 3**0.5, 0.5 + 0.5 / 3**0.5)  # Gauss-Legendre: error of 1e-12 when near


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
    check_inertia_shape(inertia)
    check_shape("t0", t0, ())
    answer = _free_rotation(inertia, state0, ts, t0)
    return settle(answer, throw, lambda: _findings(inertia, state0, ts, t0))


def _findings(inertia: Array, state0: State, ts: Array, t0: Array) -> Findings:
    findings = Findings()
    findings.require(is_inertia(inertia), RESULTS.invalid_inertia, value=inertia)
    state = jnp.concatenate([state0.attitude, state0.omega])
    findings.require(all_finite(state), RESULTS.invalid_state, value=state)
    findings.require(is_unit(state0.attitude), RESULTS.invalid_attitude, value=state0.attitude)
    for name, times in (("t0", t0), ("ts", ts)):
        message = f"Argument `{name}` must be finite, but it is not."  # the sum shows in what way
        findings.require(all_finite(times), RESULTS.invalid_times, message, jnp.sum(times))
    told_apart = resolves(t0, safe_norm(state0.omega))
    findings.require(told_apart, RESULTS.unresolved_times, value=t0)
    return findings


@jax.jit
def _free_rotation(inertia: Array, state0: State, ts: Array, t0: Array) -> ExactStates:
    findings = _findings(inertia, state0, ts, t0)
    states = where_defined(findings.ok, _states, inertia, state0, ts - t0)
    return ExactStates(states, findings.result)


def _states(inertia: Array, state0: State, times: Array) -> State:
    start = normalize(state0.attitude)
    turns, rates = jax.vmap(lambda t: _turn(inertia, state0.omega, t))(times.reshape(-1))
    attitudes = jax.vmap(lambda turn: multiply(start, turn))(turns)
    return State(attitudes.reshape(*times.shape, 4), rates.reshape(*times.shape, 3))


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
    inertia, omega, duration = float_arrays(inertia, omega, duration)
    check_inertia_shape(inertia)
    check_shape("omega", omega, (3,))
    check_shape("duration", duration, ())
    ok = is_inertia(inertia) & all_finite((omega, duration))
    return where_defined(ok, _turn, inertia, omega, duration)


def from_invariants(formula: Callable[[Invariants], Tree], inertia: Any, omega: Any) -> Tree:
    """A formula of the invariants of a motion; NaN outside positive inertia and finite rates."""

    def of_body(inertia: Array, omega: Array) -> Tree:
        return formula(invariants(*in_principal_axes(inertia, omega)))

    return where_moving(of_body, inertia, omega)


def where_moving(formula: Callable[[Array, Array], Tree], inertia: Any, omega: Any) -> Tree:
    """A formula of a free body; NaN outside positive definite inertia and finite rates."""
    inertia, omega = float_arrays(inertia, omega)
    check_inertia_shape(inertia)
    check_shape("omega", omega, (3,))
    return where_defined(is_inertia(inertia) & all_finite(omega), formula, inertia, omega)


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
    moments, axes = eigh_of_distinct(tensor)
    inside = product("ki,kl,lj->ij", axes, 0.5 * (change + change.T), axes)
    omega, omega_change = (product("ji,j->i", axes, x) for x in (omega, omega_change))
    value, tangent = jax.jvp(
        _of_moments, (moments, omega, t), (jnp.diagonal(inside), omega_change, t_change)
    )
    axis = jnp.eye(3, dtype=moments.dtype)
    second, third = jnp.roll(axis, -1, axis=0), jnp.roll(axis, 1, axis=0)
    elements = product("ki,ij,kj->k", second, inside, third)
    slopes = jax.vmap(functools.partial(_slope_off_diagonal, moments, omega, t))(
        axis, 0.5 * (second - third)
    )
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

    gap = 2 * jnp.sum(apart * moments)
    radians = 1 + safe_norm(omega) * jnp.abs(t)
    size = jnp.sum(jnp.abs(apart) * moments)
    near = jax.lax.stop_gradient(jnp.abs(gap) * radians < _NEAR * size)
    quotient = jtu.tree_map(lambda x: x / jnp.where(near, 1.0, gap), effect(moments))
    nodes = jnp.asarray(np.array(_NODES), moments.dtype)
    slopes = jax.vmap(
        lambda node: jax.jvp(effect, (moments + (node - 1) * gap * apart,), (apart,))[1]
    )(nodes)
    return jtu.tree_map(lambda x, y: jnp.where(near, 0.5 * (x[0] + x[1]), y), slopes, quotient)
