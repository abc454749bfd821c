"""Order and chaos: the spectrum of Lyapunov exponents, and an indicator that tells early."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int, Real

from jrigid._checks import RESULTS, Findings, check_shape, float_arrays, whole_number
from jrigid._types import Scalar, ScalarLike
from jrigid.dynamics import State
from jrigid.stability._steps import (
    Walk,
    checked_body,
    follow,
    orthonormal,
    solver_of,
    verdict,
    walk,
)
from jrigid.systems import RigidBody

ORDER = ("regular", "undecided", "chaotic")
_REGULAR, _CHAOTIC = 3.0, 5.0


class LyapunovSpectrum(NamedTuple):
    """Lyapunov exponents, and how they settled.

    Attributes:
        exponents: Mean rates of growth over the whole time, the largest first [1/s].
        ts: Times since the start [s].
        history: Exponents up to each of these times [1/s].
        final_state: Where the motion ended.
        error: Largest local error of a step, in the scales of the variables.
        result: `jrigid.RESULTS`.
    """

    exponents: Float[Array, " count"]
    ts: Float[Array, " samples"]
    history: Float[Array, "samples count"]
    final_state: State
    error: Scalar
    result: Any


class Megno(NamedTuple):
    """Mean exponential growth of nearby orbits.

    Attributes:
        megno: Mean Y over the whole time: tends to 2 for a regular motion (less for one near a
            periodic orbit), and to half the exponent times the time for a chaotic one.
        exponent: 2 / time of it: an estimate of the largest exponent [1/s].
        order: Index into `ORDER`: "regular" below 3, "chaotic" above 5, between "undecided". It
            starts at "regular" and needs some ten e-folding times to leave it.
        ts: Times since the start [s].
        history: `megno` up to each of these times.
        final_state: Where the motion ended.
        error: Largest local error of a step, in the scales of the variables.
        result: `jrigid.RESULTS`.
    """

    megno: Scalar
    exponent: Scalar
    order: Int[Array, ""]
    ts: Float[Array, " samples"]
    history: Float[Array, " samples"]
    final_state: State
    error: Scalar
    result: Any


def _starting_vectors(vectors: Any, count: int | None, dimension: int, dtype: Any) -> Array:
    """Rows to start from: those given, or some that lie along no axis."""
    if vectors is None:
        assert count is not None
        i = jnp.arange(dimension, dtype=dtype)
        rows = jnp.cos((1.0 + jnp.arange(count, dtype=dtype))[:, None] * (0.9 * i + 0.45)[None, :])
        return rows + 0.3 * jnp.eye(count, dimension, dtype=dtype)
    rows = float_arrays(vectors)[0].astype(dtype)
    check_shape("vectors", rows, (None, dimension))
    if len(rows) > dimension or len(rows) != (count or len(rows)):
        raise ValueError(
            f"Argument `vectors` must have as many rows as `count` and at most {dimension}, but it "
            f"has {len(rows)}."
        )
    return rows


def _independent(findings: Findings, rows: Array) -> Array:
    """Orthonormal rows; those that depend on each other, or are not finite, are noted."""
    rows = rows / jnp.sqrt(jnp.sum(rows**2, axis=1, keepdims=True))
    rows, lengths = orthonormal(rows)
    findings.require(
        jnp.all(lengths > 1e3 * jnp.finfo(rows.dtype).eps),
        RESULTS.invalid_state,
        "Arguments `vector` and `vectors` must be finite and linearly independent, but they are "
        "not.",
    )
    return rows


def _plan(steps: Any, every: Any, samples: Any) -> tuple[int, int, int]:
    """Samples, renormalisations of each, steps of each: all of one length, at least `steps`."""
    steps, every = whole_number("steps", steps), whole_number("every", every)
    samples = min(whole_number("samples", samples), steps)
    every = min(every, -(-steps // samples))
    each = -(-steps // (samples * every))
    return samples, each, every


def _followed(
    path: Walk, plan: tuple[int, int, int], rows: Array, tally: Any, add: Callable[..., Any]
) -> tuple[Array, Any, State, Array]:
    """Times and tallies of each sample, the state at the end, the largest local error.

    After some steps the rows are made orthonormal, and `add(tally, logs, number)` takes in the
    logarithms of their growth, of NaN or of nothing not finite, and the number of the interval.
    """
    samples, each, every = plan
    dtype = path.start.dtype

    def sample(carry: tuple, k: Array) -> tuple[tuple, Any]:
        def interval(carry: tuple, j: Array) -> tuple[tuple, None]:
            y, rows, tally, error = carry
            index = k * each + j
            y, rows, local = follow(path, index * every, every, y, rows)
            rows, lengths = orthonormal(rows)
            tally = add(tally, jnp.log(lengths), (1 + index).astype(dtype))
            return (y, rows, tally, jnp.maximum(error, local)), None

        carry, _ = jax.lax.scan(interval, carry, jnp.arange(each))
        return carry, carry[2]

    begin = (path.start, rows, tally, jnp.zeros((), dtype))
    (y, _, _, error), tallies = jax.lax.scan(sample, begin, jnp.arange(samples))
    ts = path.step * (each * every * (1 + jnp.arange(samples))).astype(dtype)
    return ts, tallies, path.to_state(y), error


def lyapunov_spectrum(
    system: RigidBody,
    state0: State,
    duration: ScalarLike,
    steps: int,
    args: Any = None,
    *,
    t0: ScalarLike = 0.0,
    count: int | None = None,
    vectors: Real[ArrayLike, "count n"] | None = None,
    every: int = 10,
    samples: int = 50,
    solver: Any = None,
    throw: bool = True,
) -> LyapunovSpectrum:
    """Lyapunov exponents of a motion, by small motions beside it that are kept orthogonal.

    The small motions live where they belong, a turn of the attitude and a change of the angular
    velocity (and of internal parts): six exponents for a plain body, none of the quaternion's norm.
    The steps are equal and their number is given, so that every lane of a map costs the same.

    Args:
        system: The body and its torque.
        state0: Where the motion starts.
        duration: How long it is followed [s]: an exponent is uncertain by a few over the duration.
        steps: Number of steps; some 20 to 60 for each turn of the fastest part. A step too coarse
            is an error, not a wrong number.
        args: Passed to the torque.
        t0: Time at the start [s].
        count: How many exponents, from the largest; all by default.
        vectors: Small motions to start from, rows of (turn about the body axes, change of the rate
            over the initial one, ...); they stay in any set that the motion keeps invariant, such
            as that of a planar motion. Gives `count`.
        every: Steps between two orthogonalisations.
        samples: How many times of `history`.
        solver: A diffrax solver with an error estimate; `diffrax.Dopri8()` by default.
        throw: False: a bad or an inaccurate lane is a result code and NaN.

    Returns:
        The exponents, and their means up to each of the times. (`steps` is rounded up to fill
        all intervals.)

    Raises:
        ValueError: Wrong shape or option (trace time).
        RuntimeError: Bad value, steps too coarse (run time, any lane).

    Gradients: none to be relied on: those of a chaotic motion grow as fast as it does.
    Source: G. Benettin, L. Galgani, A. Giorgilli, J.-M. Strelcyn, Meccanica 15 (1980) 9.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))  # integrable: none grows
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 0.3, 0.8]))
    >>> found = jr.stability.lyapunov_spectrum(body, state0, 1000.0, 5000)
    >>> print(bool(jnp.all(jnp.abs(found.exponents) < 0.02)), found.history.shape)
    True (50, 6)
    """
    state0, duration, t0 = checked_body(system, state0, duration, t0)
    plan, solver = _plan(steps, every, samples), solver_of(solver)
    if count is not None:
        count = whole_number("count", count)
    return _spectrum(system, state0, duration, plan, args, t0, count, vectors, solver, throw)


@eqx.filter_jit
def _spectrum(
    system: RigidBody,
    state0: State,
    duration: Array,
    plan: tuple[int, int, int],
    args: Any,
    t0: Array,
    count: int | None,
    vectors: Any,
    solver: Any,
    throw: bool,
) -> LyapunovSpectrum:
    samples, each, every = plan
    path = walk(system, state0, duration, samples * each * every, args, t0, solver)
    if count is not None and count > path.dimension:
        raise ValueError(f"Argument `count` must be at most {path.dimension}, but it is {count}.")
    dtype = path.start.dtype
    if vectors is None and count is None:
        count = path.dimension
    rows = _starting_vectors(vectors, count, path.dimension, dtype)
    rows = _independent(path.findings, rows)

    none = jnp.zeros(rows.shape[0], dtype)
    ts, totals, state, error = _followed(
        path, plan, rows, none, lambda total, logs, _: total + logs
    )
    found = (ts, totals / ts[:, None], state)
    result, _, (ts, history, state) = verdict(path.findings, error, found, throw)
    return LyapunovSpectrum(history[-1], ts, history, state, error, result)


def megno(
    system: RigidBody,
    state0: State,
    duration: ScalarLike,
    steps: int,
    args: Any = None,
    *,
    t0: ScalarLike = 0.0,
    vector: Real[ArrayLike, " n"] | None = None,
    every: int = 10,
    samples: int = 50,
    solver: Any = None,
    throw: bool = True,
) -> Megno:
    """Mean exponential growth of nearby orbits: tells order from chaos long before an exponent.

    One small motion beside the motion is enough, and 2 is what it tends to for order of any kind,
    without a constant of the system's own: that is why this one of the fast indicators is here. It
    also gives the exponent of what is chaotic, in the same pass.

    Args:
        system: The body and its torque.
        state0: Where the motion starts.
        duration: How long it is followed [s].
        steps: Number of steps; some 20 to 60 for each turn of the fastest part. A step too coarse
            is an error, not a wrong number.
        args: Passed to the torque.
        t0: Time at the start [s].
        vector: The small motion to start from, as for `lyapunov_spectrum`.
        every: Steps between two looks at its growth.
        samples: How many times of `history`.
        solver: A diffrax solver with an error estimate; `diffrax.Dopri8()` by default.
        throw: False: a bad or an inaccurate lane is a result code and NaN.

    Returns:
        The mean, the exponent it stands for, and the verdict. (`steps` is rounded up to fill all
        intervals.)

    Raises:
        ValueError: Wrong shape or option (trace time).
        RuntimeError: Bad value, steps too coarse (run time, any lane).

    Gradients: none to be relied on.
    Source: P. M. Cincotta, C. Simo, Astronomy & Astrophysics Supplement 147 (2000) 205; in steps,
    P. M. Cincotta, C. M. Giordano, C. Simo, Physica D 182 (2003) 151.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 0.3, 0.8]))
    >>> found = jr.stability.megno(body, state0, 1000.0, 5000)
    >>> print(found.megno.round(), jr.stability.ORDER[found.order])
    2.0 regular
    """
    state0, duration, t0 = checked_body(system, state0, duration, t0)
    plan, solver = _plan(steps, every, samples), solver_of(solver)
    return _megno(system, state0, duration, plan, args, t0, vector, solver, throw)


@eqx.filter_jit
def _megno(
    system: RigidBody,
    state0: State,
    duration: Array,
    plan: tuple[int, int, int],
    args: Any,
    t0: Array,
    vector: Any,
    solver: Any,
    throw: bool,
) -> Megno:
    samples, each, every = plan
    path = walk(system, state0, duration, samples * each * every, args, t0, solver)
    dtype = path.start.dtype
    if vector is not None:
        vector = float_arrays(vector)[0]
        check_shape("vector", vector, (path.dimension,))
        vector = vector[None]
    rows = _independent(path.findings, _starting_vectors(vector, 1, path.dimension, dtype))

    def add(tally: tuple[Array, Array], logs: Array, number: Array) -> tuple[Array, Array]:
        weighted, total = tally
        weighted = weighted + number * logs[0]
        return weighted, total + 2 * weighted / number

    none = jnp.zeros((), dtype)
    ts, (_, totals), state, error = _followed(path, plan, rows, (none, none), add)
    history = totals / (each * (1 + jnp.arange(samples))).astype(dtype)
    found = (ts, history, state)
    result, ok, (ts, history, state) = verdict(path.findings, error, found, throw)
    mean = history[-1]
    order = jnp.where(mean > _CHAOTIC, 2, jnp.where(mean > _REGULAR, 1, 0))
    order = jnp.where(ok, order, -1)
    return Megno(mean, 2 * mean / ts[-1], order, ts, history, state, error, result)
