"""Linearisation about an equilibrium, or a motion that is one in a turning frame."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Complex, Float, Int

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_shape,
    float_arrays,
    is_unit,
    nan_where,
)
from jrigid._numerics import product, safe_norm
from jrigid._scales import ravel, unravel
from jrigid._types import ScalarLike, VectorLike
from jrigid.dynamics import State
from jrigid.rotation import exp, multiply, normalize, rotate, rotate_inverse
from jrigid.stability._eigen import eigenvalues
from jrigid.stability._steps import checked_state
from jrigid.systems import RigidBody

STABILITY = ("unstable", "marginal", "stable")
_NO_EQUILIBRIUM = (
    "Argument `state` must be an equilibrium, at rest or in the frame that turns with `body_rate` "
    "and with the motion, but it is not: the state changes there."
)
_NOT_STATIONARY = (
    "The system must look the same at all times in the frame that turns with the motion, but it "
    "does not: what is linear about `state` has no constant matrix."
)


class Linearization(eqx.Module):
    """Small motions about an equilibrium: x' = matrix x.

    The components of x are a small turn of the attitude about the body axes (q = q0 exp(x)) [rad],
    the change of the angular velocity, body components [rad/s], and that of the internal state, all
    as seen in a frame that turns with the motion.

    Attributes:
        matrix: Its matrix.
        eigenvalues: Rates [1/s], the one of largest real part first.
        eigenvectors: Columns, in the order of the eigenvalues; without derivatives.
        stability: Index into `STABILITY`: "unstable" where a part grows exponentially; "stable"
            where none does and none drifts; "marginal" between: two eigenvalues that share an
            eigenvector, beside those that come with every motion of a symmetric system (it may turn
            a little further, at a slightly other rate). Rates below 1e-6 of that of the motion (in
            float64; 2e-2 in float32) count as 0.
        result: `jrigid.RESULTS` of the input.
    """

    matrix: Float[Array, "n n"]
    eigenvalues: Complex[Array, " n"]
    eigenvectors: Complex[Array, "n n"]
    stability: Int[Array, ""]
    result: Any

    @property
    def growth_rate(self) -> Float[Array, "*batch"]:
        """Largest real part of an eigenvalue [1/s]."""
        return jnp.max(self.eigenvalues.real, axis=-1)


def linearize(
    system: RigidBody,
    state: State,
    args: Any = None,
    *,
    t: ScalarLike = 0.0,
    body_rate: VectorLike | None = None,
    space_axis: VectorLike | None = None,
    throw: bool = True,
) -> Linearization:
    """Linearise a system about an equilibrium, or about a motion that is one in a turning frame.

    Without `body_rate` the frame turns with the body: right for rest, for the spin of a free body
    or of a gyrostat, for a sleeping or hanging top, for a satellite that keeps its face to the
    Earth on a circular orbit. A top in steady precession also turns about its own axis, as seen by
    one who precesses with it: `body_rate` is that turning.

    Args:
        system: The body and its torque.
        state: Its state, an equilibrium in the frame.
        args: Passed to the torque.
        t: Time of the state [s].
        body_rate: Turning of the body seen from the frame, body components [rad/s]; about an axis
            of symmetry of the body and its torque.
        space_axis: A direction in space about which the system is symmetric, where it is at rest:
            up, for what hangs still. A motion that turns has its own.
        throw: False: bad input is a result code and NaN.

    Returns:
        Matrix, eigenvalues, eigenvectors, and what they mean.

    Raises:
        ValueError: Wrong shape; `body_rate` with internal parts (trace time).
        RuntimeError: Bad value; a state that is no equilibrium; a system that changes in the frame,
            such as a body on an eccentric orbit (run time, any lane).

    Gradients: of matrix and eigenvalues, in all parameters of the system and in the state; where
    eigenvalues meet see `eigenvalues`. None of the eigenvectors.
    Source: J. E. Marsden, T. S. Ratiu, Introduction to Mechanics and Symmetry, 2nd ed. (1999), for
    relative equilibria; docs/stability.md. Eigenvalues on a GPU need a jaxlib that has them there.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> spin = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 2.0, 0.0]))
    >>> about = jr.stability.linearize(body, spin)
    >>> print(about.growth_rate.round(6), jr.stability.STABILITY[about.stability])
    1.154701 unstable
    """
    state = checked_state(system, state, "state")
    dtype = state.omega.dtype
    none = jnp.zeros(3, dtype)
    own, up = (none if x is None else x for x in (body_rate, space_axis))
    time, own, up = (float_arrays(x)[0].astype(dtype) for x in (t, own, up))
    check_shape("t", time, ())
    check_shape("body_rate", own, (3,))
    check_shape("space_axis", up, (3,))
    if body_rate is not None and state.internal is not None:
        raise ValueError(
            "Argument `body_rate` must be None for a body with internal parts, which turn with it, "
            "but it is not."
        )
    return _linearize(system, state, args, time, own, up, throw)


@eqx.filter_jit
def _linearize(
    system: RigidBody,
    state: State,
    args: Any,
    time: Array,
    own: Array,
    up: Array,
    throw: bool,
) -> Linearization:
    dtype = state.omega.dtype
    findings = Findings()
    system.check(findings)
    findings.require(all_finite((state, time, own, up)), RESULTS.invalid_state)
    findings.require(is_unit(jax.lax.stop_gradient(state.attitude)), RESULTS.invalid_attitude)
    state = dataclasses.replace(state, attitude=normalize(state.attitude))
    across = rotate(state.attitude, state.omega - own)  # turning of the frame in space

    def rates(x: Array, later: Array) -> Array:
        """Rates of the components, at a state x away, as seen in the frame some time later."""
        turn, change, parts = x[:3], x[3:6], x[6:]
        seen = multiply(state.attitude, exp(turn))
        spin = state.omega + change
        on = exp(later * own)
        attitude = multiply(exp(later * across), multiply(seen, on))
        inside = unravel(ravel(state.internal) + parts, state.internal) if parts.size else None
        actual = State(attitude, rotate_inverse(on, spin), inside)
        found = system.vector_field(time + later, actual, args)
        turning = spin - own - rotate_inverse(seen, across)
        change = rotate(on, found.omega) + jnp.cross(own, spin)
        inner = ravel(found.internal) if parts.size else parts
        return jnp.concatenate([turning, change, inner])

    extra = sum(x.size for x in jtu.tree_leaves(state.internal))
    still, now = jnp.zeros(6 + extra, dtype), jnp.zeros((), dtype)
    matrix = jax.jacfwd(rates)(still, now)
    # The rate to measure by: of the motion, or of what the torque does to a turn; not of what damps
    # it, beside which all the rest may be slow.
    known = jax.lax.stop_gradient
    fixed = known(matrix)
    stiff = jnp.sqrt(jnp.max(jnp.abs(fixed[3:6, :3])))
    rate = known(jnp.max(jnp.stack([*(safe_norm(v) for v in (state.omega, own, across)), stiff])))
    findings.require(all_finite(fixed), RESULTS.invalid_vector_field)
    rests = rate == 0  # and nothing holds it: then it must not move at all
    rate = jnp.where(jnp.isfinite(rate) & ~rests, rate, 1.0)
    units = jnp.concatenate([jnp.ones(3, dtype), jnp.full(3, rate)])
    if extra:
        scale = system.torque.internal_scale(rate)
        full = jtu.tree_map(lambda s, x: jnp.broadcast_to(s, x.shape), scale, state.internal)
        units = jnp.concatenate([units, ravel(full).astype(dtype)])

    def measured(x: Array) -> Array:
        return x * units[None, :] / units[:, None] / rate

    def moved(later: Array) -> Array:
        return jnp.max(jnp.abs(known(rates(still, later)) / units / rate))

    accuracy = 64 * jnp.sqrt(jnp.finfo(dtype).eps)
    largest = jnp.where(rests, 0.0, accuracy)
    findings.require(moved(now) <= largest, RESULTS.no_equilibrium, _NO_EQUILIBRIUM)
    for later in (0.7 / rate, 1.9 / rate):
        there = known(jax.jacfwd(rates)(still, later))
        differs = jnp.abs(measured(there - fixed))
        same = jnp.all(differs <= accuracy * jnp.maximum(jnp.abs(measured(fixed)), 1.0))
        same = same & (moved(later) <= largest)
        findings.require(same, RESULTS.no_equilibrium, _NOT_STATIONARY)
    ok = findings.ok
    plain = jnp.where(ok, measured(matrix), jnp.eye(6 + extra, dtype=dtype))
    values = eigenvalues(plain)
    vectors = _vectors(known(plain), known(values))
    along = jnp.where(safe_norm(up) > 0, up, across)
    neutral = [
        jnp.concatenate([rotate_inverse(state.attitude, along), jnp.zeros_like(still[3:])]),
        jnp.concatenate([own, jnp.cross(state.omega, own) / rate, jnp.zeros_like(still[6:])]),
    ]
    stability = _classify(known(plain), known(values), vectors, known(jnp.stack(neutral)), accuracy)
    of_units = units.astype(vectors.dtype)[:, None] * vectors
    length = jnp.sqrt(jnp.sum(jnp.abs(of_units) ** 2, axis=0))
    of_units = of_units / length.astype(values.dtype)[None, :]
    found = (matrix, rate.astype(values.dtype) * values, of_units)
    matrix, values, vectors = findings.apply(nan_where(~ok, found), throw)
    return Linearization(matrix, values, vectors, jnp.where(ok, stability, -1), findings.result)


def _vectors(matrix: Array, values: Array) -> Array:
    """Eigenvectors in the order of the eigenvalues."""
    found, columns = jnp.linalg.eig(matrix)
    gaps = jnp.abs(found[None, :] - values[:, None])
    # Each eigenvalue takes the nearest that is left.
    order = []
    for i in range(values.size):
        nearest = jnp.argmin(gaps[i])
        order.append(nearest)
        gaps = jnp.where(jnp.arange(values.size)[None, :] == nearest, jnp.inf, gaps)
    return columns[:, jnp.stack(order)]


def _classify(
    matrix: Array, values: Array, vectors: Array, neutral: Array, accuracy: Array
) -> Int[Array, ""]:
    # Rounding of the largest entries splits a double zero by the root of it.
    largest = jnp.maximum(jnp.max(jnp.abs(values)), 1.0)
    tiny = jnp.maximum(accuracy, 4 * jnp.sqrt(jnp.finfo(values.real.dtype).eps * largest))
    grows = jnp.max(values.real) > tiny
    # Directions along which the motion only turns further, at a rate that a neighbour may change.
    length = jnp.sqrt(jnp.sum(neutral**2, axis=1))
    there = length > 0
    neutral = neutral / jnp.where(there, length, 1.0)[:, None]
    kept = jnp.sqrt(jnp.sum(product("ij,kj->ki", matrix, neutral) ** 2, axis=1)) <= tiny
    there = there & kept
    twins = jnp.abs(jnp.sum(neutral[0] * neutral[1])) > 1 - 1e-6
    explained = jnp.where(there[0] & there[1] & twins, 1, jnp.sum(there))
    # A zero with an eigenvector of its own stays where it is; the others drift.
    zeros = jnp.sum(jnp.abs(values) <= tiny)
    rest = jnp.sum(jnp.linalg.svd(matrix, compute_uv=False) <= tiny)
    gaps = jnp.abs(values[:, None] - values[None, :])
    overlap = jnp.abs(product("ki,kj->ij", jnp.conj(vectors), vectors))
    others = ~jnp.eye(values.size, dtype=bool)
    on_axis = (jnp.abs(values.real) <= tiny) & (jnp.abs(values) > tiny)
    pairs = others & on_axis[:, None] & on_axis[None, :] & (gaps <= tiny) & (overlap > 0.999)
    drifts = (zeros - rest > explained) | jnp.any(pairs)
    return jnp.where(grows, 0, jnp.where(drifts, 1, 2))
