"""Linearisation about an equilibrium, at rest or in a turning frame."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float

from jrigid._checks import (
    RESULTS,
    Enumeration,
    Findings,
    all_finite,
    harmless,
    nan_where,
    settle,
    shaped,
)
from jrigid._core.compile import quick_jit
from jrigid._motion_inputs import harmless_motion
from jrigid._numerics import safe_norm
from jrigid._stepping.scales import spread
from jrigid._types import Readable, Scalar, ScalarLike, VectorLike
from jrigid.dynamics import State
from jrigid.rotation import exp, multiply, rotate, rotate_inverse
from jrigid.stability._eigen import eigensystem, margin, null_directions, pairs
from jrigid.stability._stepped_motion import Motion, findings_of, motion_of
from jrigid.systems import RigidBody

# Times, in units of the motion, at which the system is looked at again.
_LATER = (0.7, 1.9)
_NO_EQUILIBRIUM = (
    "Argument `state0` must be an equilibrium, at rest or in the frame that turns with "
    "`body_rate` and with the motion, but it is not: the state changes there."
)
_NOT_STATIONARY = (
    "The system must look the same at all times in the frame that turns with the "
    "motion, but it does not: what is linear about `state0` has no constant matrix."
)


class STABILITY(Enumeration):
    """Stability of an equilibrium according to its linearisation."""

    unstable = "unstable"
    marginal = "marginal"
    stable = "stable"
    undefined = "undefined"


class Linearization(Readable):
    """Small motions about an equilibrium: x' = matrix x.

    The components of x are a small turn of the attitude about the body axes (q = q0
    exp(x)) [rad], the change of the angular velocity, body components [rad/s], and that
    of the internal state, all as seen in a frame that turns with the motion.

    Attributes:
        matrix: Its matrix.
        eigenvalues: Rates [1/s], the one of largest real part first.
        eigenvectors: Columns, in the order of the eigenvalues; without derivatives.
        stability: One of `STABILITY`: "unstable" where a part grows exponentially;
            "stable" where none does and none drifts; "marginal" between: two
            eigenvalues that share an eigenvector, beside those that come with every
            motion of a symmetric system (it may turn a little further, at a slightly
            other rate). Rates below 1e-6 of that of the motion (in float64; 2e-2 in
            float32) count as 0.
        margin: Positive where stable, negative where unstable, smooth where it changes
            its sign, which is where `boundary` looks [1/s^2]. Without damping, minus
            the square of the largest growth rate where something grows, else the square
            of half the smallest difference of two frequencies (of one and its own
            negative: of the frequency), which also touches zero where two pass through
            each other. With damping, minus the largest real part times the rate of the
            motion. What every motion of a symmetric system does counts for neither, nor
            does the turning of the momentum of a free body in space.
        result: `jrigid.RESULTS` of the input.
    """

    matrix: Float[Array, "n n"]
    eigenvalues: Complex[Array, " n"]
    eigenvectors: Complex[Array, "n n"]
    stability: STABILITY
    margin: Scalar
    result: Any

    @property
    def growth_rate(self) -> Float[Array, "*batch"]:
        """Largest real part of an eigenvalue [1/s]."""
        return jnp.max(self.eigenvalues.real, axis=-1)


def linearize(
    system: RigidBody,
    state0: State,
    args: Any = None,
    *,
    t0: ScalarLike = 0.0,
    body_rate: VectorLike | None = None,
    space_axis: VectorLike | None = None,
    throw: bool = True,
) -> Linearization:
    """Linearise a system about an equilibrium, at rest or in a turning frame.

    Without `body_rate` the frame turns with the body. This is right for rest, for the
    spin of a free body or of a gyrostat, for a sleeping or hanging top, and for a
    satellite that keeps one side to the Earth on a circular orbit. A top in steady
    precession also turns about its own axis relative to the precessing frame. That
    rate is `body_rate`.

    Args:
        system: The body and its torque.
        state0: Its state, an equilibrium in the frame.
        args: Passed to the torque.
        t0: Time of the state [s].
        body_rate: Turning of the body seen from the frame, body components [rad/s];
            about an axis of symmetry of the body and its torque.
        space_axis: A direction in space about which the system is symmetric, where it
            is at rest: up, for what hangs still. A motion that turns has its own.
        throw: False: bad input is a result code and NaN.

    Returns:
        Matrix, eigenvalues, eigenvectors, and what they mean.

    Raises:
        ValueError: `body_rate` with internal parts.
        RuntimeError: Bad value; a state that is no equilibrium; a system that changes
            in the frame, such as a body on an eccentric orbit.

    Gradients: of matrix, eigenvalues and margin, in all parameters of the system and in
    the state; where eigenvalues meet see `eigenvalues`. None of the eigenvectors.
    Source: J. E. Marsden, T. S. Ratiu, Introduction to Mechanics and Symmetry, 2nd ed.
    (1999), for relative equilibria; docs/stability.md. Eigenvalues on a GPU need a
    jaxlib that has them there.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> spin = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 2.0, 0.0]))
    >>> about = jr.stability.linearize(body, spin)
    >>> print(about.growth_rate.round(6), jr.stability.STABILITY[about.stability])
    1.154701 unstable
    """
    motion = motion_of(system, state0, args, t0)
    none = jnp.zeros(3, motion.t0.dtype)
    own, up = (none if x is None else x for x in (body_rate, space_axis))
    turns = shaped(body_rate=(own, 3), space_axis=(up, 3))
    frame = _Frame(motion, *(x.astype(none.dtype) for x in turns))
    if body_rate is not None and motion.dimension > 6:
        raise ValueError(
            "Argument `body_rate` must be None for a body with internal parts, which "
            "turn with it, but it is not."
        )
    return settle(_linearize(frame), throw, _findings, frame)


class _Frame(NamedTuple):
    """A motion as seen in a frame that turns with it: an equilibrium, if all is well.

    Small motions beside it are x; in `units` all their components are angles.
    """

    motion: Motion
    own: Array
    up: Array

    @property
    def across(self) -> Array:
        """Turning of the frame in space."""
        state = self.motion.state0
        return rotate(state.attitude, state.omega - self.own)

    def state(self, x: Array, later: Array) -> State:
        """The state of the body some time later."""
        state = self.motion.state0
        parts, unravel = ravel_pytree(state.internal)
        internal = unravel(parts.astype(x.dtype) + x[6:])
        # q = exp(A t) q0 exp(x) exp(s t) and omega = R(-s t)(omega0 + y), with A =
        # `across` and s = `own` (docs/stability.md).
        on = exp(later * self.own)
        seen = multiply(state.attitude, exp(x[:3]))
        attitude = multiply(exp(later * self.across), multiply(seen, on))
        return State(attitude, rotate_inverse(on, state.omega + x[3:6]), internal)

    def rates(self, x: Array, later: Array) -> Array:
        """Rates of the small motion, some time later."""
        system, state, args, t0, *_ = self.motion
        rates = system.vector_field(t0 + later, self.state(x, later), args)
        # Terms of second order in x are omitted: at an equilibrium `turning` is zero.
        spin = state.omega + x[3:6]
        seen = multiply(state.attitude, exp(x[:3]))
        turning = spin - self.own - rotate_inverse(seen, self.across)
        change = rotate(exp(later * self.own), rates.omega) + jnp.cross(self.own, spin)
        inner = ravel_pytree(rates.internal)[0].astype(x.dtype)
        return jnp.concatenate([turning, change, inner])

    def look(self, later: Array) -> tuple[Array, Array]:
        """Matrix of the linearised motion some time later, and rates at zero."""
        still = jnp.zeros(self.motion.dimension, later.dtype)
        # The second one is passed through as a value, so one evaluation gives both.
        return jax.jacfwd(lambda x: (self.rates(x, later),) * 2, has_aux=True)(still)

    def symmetries(self, rate: Scalar) -> tuple[Array, Array]:
        """Directions of a system's symmetries, and slopes of the conserved momenta.

        Every motion of a symmetric system may turn about an axis in space, and about
        one in the body. The angular momentum along each of them is conserved.
        """
        system, state, args, t0, *_ = self.motion
        own = self.own
        none = jnp.zeros(self.motion.dimension, rate.dtype)
        # The axis of symmetry of the system in space.
        along = jnp.where(safe_norm(self.up) > 0, self.up, self.across)
        # These are the directions (R^-1 A, 0) and (s, omega0 x s) of docs/stability.md.
        turned = none.at[:3].set(rotate_inverse(state.attitude, along))
        slewed = none.at[:6].set(
            jnp.concatenate([own, jnp.cross(state.omega, own) / rate])
        )

        def momenta(x: Array) -> Array:
            state = self.state(x, jnp.zeros_like(t0))
            momentum = system.angular_momentum(t0, state, args)
            in_body = rotate_inverse(state.attitude, momentum)
            return jnp.stack([jnp.sum(along * momentum), jnp.sum(own * in_body)])

        return jnp.stack([turned, slewed]), jax.jacfwd(momenta)(none)

    def rate(self, matrix: Array) -> Scalar:
        """The rate to measure by: of the motion, or of what the torque does to a turn.

        Not of what damps it, beside which all the rest may be slow.
        """
        # The angular acceleration for a turn of one radian has the unit 1/s^2.
        stiff = jnp.sqrt(jnp.max(jnp.abs(matrix[3:6, :3])))
        turns = (self.motion.state0.omega, self.own, self.across)
        return jnp.max(jnp.stack([*(safe_norm(v) for v in turns), stiff]))

    def units(self, rate: Scalar) -> Array:
        """Size of each component of x for an angle of 1."""
        system, state, *_ = self.motion
        # A small rotation has one component less than a quaternion.
        return spread(system, state, rate)[1:]


def _accuracy(dtype: Any) -> Scalar:
    """Size below which a number counts as zero beside the motion."""
    return 64 * jnp.sqrt(jnp.finfo(dtype).eps)


def _findings(frame: _Frame) -> Findings:
    return _looked_at(frame)[0]


def _looked_at(frame: _Frame) -> tuple[Findings, _Frame, Array, Scalar]:
    """Findings; the frame, harmless in a bad lane; the matrix in it; and the rate."""
    findings = findings_of(frame.motion)
    for name, value in (("body_rate", frame.own), ("space_axis", frame.up)):
        message = f"Argument `{name}` must be finite, but it is not."
        findings.require(all_finite(value), RESULTS.invalid_state, message, value)
    motion, *turns = harmless(findings.ok, frame)
    frame = _Frame(harmless_motion(findings.ok, motion), *turns)
    known = jax.lax.stop_gradient
    matrix, moves = frame.look(jnp.zeros_like(motion.t0))
    fixed = known(matrix)
    findings.require(all_finite(fixed), RESULTS.invalid_vector_field)
    rate = known(frame.rate(fixed))
    rests = rate == 0  # and nothing holds it: then it must not move at all
    rate = jnp.where(jnp.isfinite(rate) & ~rests, rate, 1.0)
    units = frame.units(rate)
    accuracy = _accuracy(rate.dtype)
    # In these units an entry is an angle for an angle, per radian of the motion.
    size = units[None, :] / units[:, None] / rate
    largest = jnp.where(rests, 0.0, accuracy) * units * rate
    stays = jnp.all(jnp.abs(known(moves)) <= largest)
    findings.require(stays, RESULTS.no_equilibrium, _NO_EQUILIBRIUM)
    others, moves = known(jax.vmap(frame.look)(jnp.asarray(_LATER, rate.dtype) / rate))
    change = jnp.abs((others - fixed[None]) * size[None])
    # The change of an entry below 1, which is slower than the motion, is compared with
    # the rate of the motion.
    same = jnp.all(change <= accuracy * jnp.maximum(jnp.abs(fixed * size), 1.0)[None])
    same = same & jnp.all(jnp.abs(moves) <= largest[None])
    findings.require(same, RESULTS.no_equilibrium, _NOT_STATIONARY)
    return findings, frame, matrix, rate


@quick_jit
def _linearize(frame: _Frame) -> Linearization:
    findings, frame, matrix, rate = _looked_at(frame)
    ok = findings.ok
    units = frame.units(rate)
    accuracy = _accuracy(rate.dtype)
    known = jax.lax.stop_gradient
    eye = jnp.eye(units.size, dtype=units.dtype)
    # NaN of a bad lane would reach the derivatives of what lanes share.
    plain = jnp.where(ok, matrix * units[None, :] / units[:, None] / rate, eye)
    values, vectors = eigensystem(plain)
    neutral, conserved = frame.symmetries(rate)
    stability = _classify(
        known(plain), known(values), vectors, known(neutral), accuracy
    )
    left = margin(plain, neutral, conserved * units[None, :], accuracy) * rate * rate
    shapes = units.astype(vectors.dtype)[:, None] * vectors
    shapes = shapes / jnp.linalg.norm(shapes, axis=0, keepdims=True).astype(
        shapes.dtype
    )
    stability = STABILITY.where(ok, stability, STABILITY.undefined)
    values = rate.astype(values.dtype) * values
    answer = Linearization(matrix, values, shapes, stability, left, findings.result)
    return nan_where(~ok, answer)


def _classify(
    matrix: Array, values: Array, vectors: Array, neutral: Array, accuracy: Array
) -> STABILITY:
    # Rounding of the largest entries splits a double zero by the root of it.
    largest = jnp.maximum(jnp.max(jnp.abs(values)), 1.0)
    tiny = jnp.maximum(accuracy, 4 * jnp.sqrt(jnp.finfo(matrix.dtype).eps * largest))
    # Directions along which the motion only turns further, at a rate that a neighbour
    # may change.
    turning = jnp.sum(jnp.any(null_directions(neutral, matrix.T, tiny) != 0, axis=1))
    # A zero with an eigenvector of its own stays where it is; the others drift.
    zero = jnp.abs(values) <= tiny
    # Zero has as many eigenvectors as the matrix has singular values of zero. They are
    # fewer than its eigenvalues of zero where the motion drifts.
    staying = jnp.sum(jnp.linalg.svd(matrix, compute_uv=False) <= tiny)
    on_axis = (jnp.abs(values.real) <= tiny) & ~zero
    gaps, alike = pairs(values, vectors)
    # Motions grow like t where two frequencies share an eigenvector (Krein collision).
    shared = on_axis[:, None] & on_axis[None, :] & (gaps <= tiny) & alike
    drifts = (jnp.sum(zero) - staying > turning) | jnp.any(shared)
    steady = STABILITY.where(drifts, STABILITY.marginal, STABILITY.stable)
    return STABILITY.where(jnp.max(values.real) > tiny, STABILITY.unstable, steady)
