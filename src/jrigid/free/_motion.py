"""free_rotation(): the state of a free body at any times, for moments or a tensor."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Real

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_inertia_shape,
    check_shape,
    float_arrays,
    is_inertia,
    is_unit,
    nan_where,
)
from jrigid._numerics import product, safe_norm
from jrigid._spectral import eigh, eigh_of_distinct
from jrigid._types import InertiaLike, Quaternion, Scalar, ScalarLike, Vector
from jrigid.dynamics import State
from jrigid.free._flow import at, invariants
from jrigid.rotation import multiply, normalize

# Moments whose gap turns the motion by less than this [rad] are near.
_NEAR = 1e-2
_NODES = (0.5 - 0.5 / 3**0.5, 0.5 + 0.5 / 3**0.5)  # Gauss-Legendre: error of 1e-12 when near

_TIMES = "Argument `ts` must be finite, and `t0` too, but it is not."


def motion_validity(
    inertia: InertiaLike, state0: State, ts: Real[ArrayLike, "..."], *, t0: ScalarLike = 0.0
) -> Any:
    """What `free_rotation` finds wrong with its arguments.

    Args:
        inertia: As for `free_rotation`, and so on.
        state0: State at `t0`.
        ts: Times [s].
        t0: Time of `state0` [s].

    Returns:
        A `jrigid.RESULTS`, `RESULTS.successful` if nothing is; the lane's code under vmap.

    Raises:
        ValueError: Wrong shape or dtype (trace time).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.1]))
    >>> code = jr.free.motion_validity(jnp.array([1.0, -2.0, 3.0]), state, 1.0)
    >>> code == jr.RESULTS.invalid_inertia
    Array(True, dtype=bool)
    """
    return _findings(*_arguments(inertia, state0, ts, t0)).result


def free_rotation(
    inertia: InertiaLike,
    state0: State,
    ts: Real[ArrayLike, "..."],
    *,
    t0: ScalarLike = 0.0,
    throw: bool = True,
) -> State:
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
            `free.motion_validity` tells why.

    Returns:
        Attitude and angular velocity, with the shape of `ts` in front. The error is below
        1e-13 (1 + radians turned) in float64, plus what the last bits of the arguments do; energy
        and angular momentum keep their values to 1e-14, whatever the time.

    Raises:
        ValueError: Wrong shape or dtype (trace time).
        RuntimeError: Bad value, with `throw=True` (run time, any lane).

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
    inertia, state0, ts, t0 = _arguments(inertia, state0, ts, t0)
    findings = _findings(inertia, state0, ts, t0)
    ok = findings.ok
    # A bad lane moves harmlessly instead: no NaN reaches the derivatives of what lanes share.
    one = jnp.ones(3, inertia.dtype) if inertia.ndim == 1 else jnp.eye(3, dtype=inertia.dtype)
    inertia = jnp.where(ok, inertia, one)
    identity = jnp.zeros(4, inertia.dtype).at[0].set(1)
    attitude = normalize(jnp.where(ok, state0.attitude, identity))
    omega, times = (jnp.where(ok, x, jnp.zeros_like(x)) for x in (state0.omega, ts - t0))
    state = State(*_states(inertia, attitude, omega, times.reshape(-1)))
    state = jtu.tree_map(lambda x: x.reshape(*ts.shape, x.shape[-1]), state)
    return findings.apply(nan_where(~ok, state), throw)


def _arguments(inertia: Any, state0: Any, ts: Any, t0: Any) -> tuple[Array, State, Array, Array]:
    if not isinstance(state0, State):
        raise ValueError(f"Argument `state0` must be a State, but it is {type(state0).__name__}.")
    if jtu.tree_leaves(state0.internal):
        raise ValueError(
            "Argument `state0.internal` must be empty, but it is not: a body with moving parts is "
            "not free; use `jrigid.simulate`."
        )
    inertia, attitude, omega, ts, t0 = float_arrays(inertia, state0.attitude, state0.omega, ts, t0)
    check_inertia_shape(inertia)
    check_shape("state0.attitude", attitude, (4,))
    check_shape("state0.omega", omega, (3,))
    check_shape("t0", t0, ())
    if inertia.dtype not in (jnp.float32, jnp.float64):
        raise ValueError(f"Arguments must be float32 or float64, but they are {inertia.dtype}.")
    return inertia, State(attitude, omega), ts, t0


def _findings(inertia: Array, state0: State, ts: Array, t0: Array) -> Findings:
    findings = Findings()
    findings.require(is_inertia(inertia), RESULTS.invalid_inertia)
    findings.require(all_finite(state0), RESULTS.invalid_state)
    findings.require(is_unit(state0.attitude), RESULTS.invalid_attitude)
    findings.require(all_finite((ts, t0)), RESULTS.invalid_times, _TIMES)
    return findings


@jax.jit
def _states(inertia: Array, attitude: Array, omega: Array, times: Array) -> tuple[Array, Array]:
    relative, rates = jax.vmap(lambda t: relative_motion(inertia, omega, t))(times)
    return jax.vmap(lambda p: multiply(attitude, p))(relative), rates


@jax.jit
def relative_motion(inertia: Array, omega: Vector, t: Scalar) -> tuple[Quaternion, Vector]:
    """Attitude relative to that at the start, q(t) = q(0) p(t), and angular velocity; unchecked."""
    if inertia.ndim == 1:
        return of_moments(inertia, omega, t)
    return _of_tensor(inertia, omega, t)


def of_moments(moments: Vector, omega: Vector, t: Scalar) -> tuple[Quaternion, Vector]:
    """Attitude relative to that at the start and angular velocity, in the principal axes."""
    return at(invariants(moments, omega), t)


def turned(axes: Array, attitude: Array, omega: Array) -> tuple[Array, Array]:
    vector = product("ij,j->i", axes, attitude[1:])
    return jnp.concatenate([attitude[:1], vector]), product("ij,j->i", axes, omega)


@jax.custom_jvp
def _of_tensor(tensor: Array, omega: Array, t: Array) -> tuple[Array, Array]:
    moments, axes = eigh(tensor)
    return turned(axes, *of_moments(moments, product("ji,j->i", axes, omega), t))


@_of_tensor.defjvp
def _of_tensor_jvp(primals: tuple, tangents: tuple) -> tuple:
    # In the principal axes a change of the tensor changes the moments, and, off its diagonal, turns
    # the axes: a motion about turned axes is the turned motion.
    (tensor, omega, t), (change, omega_change, t_change) = primals, tangents
    moments, axes = eigh_of_distinct(tensor)
    inside = product("ki,kl,lj->ij", axes, 0.5 * (change + change.T), axes)
    omega, omega_change = (product("ji,j->i", axes, x) for x in (omega, omega_change))
    value, tangent = jax.jvp(
        of_moments, (moments, omega, t), (jnp.diagonal(inside), omega_change, t_change)
    )
    axis = jnp.eye(3, dtype=moments.dtype)
    after, before = jnp.roll(axis, -1, axis=0), jnp.roll(axis, 1, axis=0)
    elements = product("ki,ij,kj->k", after, inside, before)
    slopes = jax.vmap(functools.partial(_slope_off_diagonal, moments, omega, t))(
        axis, 0.5 * (after - before)
    )
    tangent = jtu.tree_map(lambda x, y: x + product("k,kn->n", elements, y), tangent, slopes)
    return turned(axes, *value), turned(axes, *tangent)


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
            lambda omega: of_moments(moments, omega, t), (omega,), (jnp.cross(axis, omega),)
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
