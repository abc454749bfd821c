"""Order and chaos: the spectrum of Lyapunov exponents, and an indicator that tells early."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Real

from jrigid._checks import (
    RESULTS,
    Enumeration,
    Findings,
    check_shape,
    float_arrays,
    settle,
    whole_number,
)
from jrigid._types import Scalar, ScalarLike
from jrigid.dynamics import State
from jrigid.stability._steps import (
    Motion,
    findings_of,
    motion_of,
    orthonormal,
    solver_of,
    verdict,
    walk,
)
from jrigid.systems import RigidBody

_REGULAR, _CHAOTIC = 3.0, 5.0  # between them MEGNO has not decided
_INDEPENDENT = 1e3  # eps that must be left of a small motion once those before it are taken off


class ORDER(Enumeration):
    """What MEGNO says of a motion."""

    regular = "regular"
    undecided = "undecided"
    chaotic = "chaotic"
    undefined = "undefined"


class _Plan(NamedTuple):
    """Samples, intervals between renormalisations in each, steps in each of those."""

    samples: int
    each: int
    every: int

    @property
    def steps(self) -> int:
        return self.samples * self.each * self.every


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
        order: One of `ORDER`: "regular" below 3, "chaotic" above 5, between "undecided". It starts
            at "regular" and needs some ten e-folding times to leave it.
        ts: Times since the start [s].
        history: `megno` up to each of these times.
        final_state: Where the motion ended.
        error: Largest local error of a step, in the scales of the variables.
        result: `jrigid.RESULTS`.
    """

    megno: Scalar
    exponent: Scalar
    order: ORDER
    ts: Float[Array, " samples"]
    history: Float[Array, " samples"]
    final_state: State
    error: Scalar
    result: Any


def _starting_vectors(motion: Motion, vectors: Any, count: int | None) -> Array:
    """Rows to start from: those given, or some that lie along no axis."""
    dimension, dtype = motion.dimension, motion.t0.dtype
    if vectors is None:
        count = dimension if count is None else whole_number("count", count)
        angles = np.outer(np.arange(1, count + 1), 0.9 * np.arange(dimension) + 0.45)
        rows = jnp.asarray(np.cos(angles) + 0.3 * np.eye(count, dimension), dtype)
    else:
        rows = float_arrays(vectors)[0].astype(dtype)
        check_shape("vectors", rows, (count, dimension))
    if len(rows) > dimension:
        raise ValueError(
            f"Arguments `count` and `vectors` must name at most {dimension} small motions, but "
            f"they name {len(rows)}."
        )
    return rows


def _unit_rows(rows: Array) -> tuple[Array, Array]:
    """Orthonormal rows, and what was left of the length of each."""
    return orthonormal(rows / jnp.sqrt(jnp.sum(rows**2, axis=1, keepdims=True)))


def _findings(motion: Motion, rows: Array) -> Findings:
    findings = findings_of(motion)
    _, lengths = _unit_rows(rows)
    findings.require(
        jnp.all(lengths > _INDEPENDENT * jnp.finfo(rows.dtype).eps),
        RESULTS.invalid_state,
        "Arguments `vector` and `vectors` must be finite and linearly independent, but they are "
        "not.",
    )
    return findings


def _plan(steps: Any, every: Any, samples: Any) -> _Plan:
    """All samples of one length, in at least `steps` steps."""
    steps, every = whole_number("steps", steps), whole_number("every", every)
    samples = min(whole_number("samples", samples), steps)
    every = min(every, -(-steps // samples))
    return _Plan(samples, -(-steps // (samples * every)), every)


class _Growth(NamedTuple):
    """How small motions beside a motion grew, up to each of some times."""

    ts: Array
    exponents: Array
    megno: Array
    final_state: State
    error: Array
    result: Any


@eqx.filter_jit
def _growth(motion: Motion, plan: _Plan, rows: Array, solver: Any) -> _Growth:
    """Orthonormal again after each interval; the indicator is that of the first one."""
    findings = _findings(motion, rows)
    path = walk(motion, plan.steps, solver, findings.ok)
    samples, each, every = plan
    dtype = rows.dtype

    def interval(carry: tuple, index: Array) -> tuple[tuple, None]:
        y, rows, (totals, weighted, indicator), error = carry
        y, rows, local = path.follow(index * every, every, y, rows)
        rows, lengths = orthonormal(rows)
        logs, number = jnp.log(lengths), (1 + index).astype(dtype)
        weighted = weighted + number * logs[0]
        tally = (totals + logs, weighted, indicator + 2 * weighted / number)
        return (y, rows, tally, jnp.maximum(error, local)), None

    def sample(carry: tuple, first: Array) -> tuple[tuple, Any]:
        carry, _ = jax.lax.scan(interval, carry, first + jnp.arange(each))
        return carry, carry[2]

    none = jnp.zeros((), dtype)
    tally = (jnp.zeros(len(rows), dtype), none, none)
    begin = (path.start, _unit_rows(rows)[0], tally, none)
    firsts = each * jnp.arange(samples)
    (y, *_, error), (totals, _, indicator) = jax.lax.scan(sample, begin, firsts)
    counts = (firsts + each).astype(dtype)
    ts = path.step * every * counts
    answer = (ts, totals / ts[:, None], indicator / counts, path.state(y))
    result, _, (ts, exponents, mean, state) = verdict(findings, error, answer)
    return _Growth(ts, exponents, mean, state, error, result)


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
        RuntimeError: Bad value, steps too coarse.

    Gradients: none to be relied on: those of a chaotic motion grow as fast as it does.
    Source: G. Benettin, L. Galgani, A. Giorgilli, J.-M. Strelcyn, Meccanica 15 (1980) 9.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))  # integrable: none grows
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 0.3, 0.8]))
    >>> spectrum = jr.stability.lyapunov_spectrum(body, state0, 1000.0, 5000)
    >>> print(bool(jnp.all(jnp.abs(spectrum.exponents) < 0.02)), spectrum.history.shape)
    True (50, 6)
    """
    motion = motion_of(system, state0, args, t0, duration)
    plan, rows = _plan(steps, every, samples), _starting_vectors(motion, vectors, count)
    growth = _growth(motion, plan, rows, solver_of(solver))
    ts, history, _, state, error, result = settle(growth, throw, lambda: _findings(motion, rows))
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
        RuntimeError: Bad value, steps too coarse.

    Gradients: none to be relied on.
    Source: P. M. Cincotta, C. Simo, Astronomy & Astrophysics Supplement 147 (2000) 205; in steps,
    P. M. Cincotta, C. M. Giordano, C. Simo, Physica D 182 (2003) 151.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 0.3, 0.8]))
    >>> indicator = jr.stability.megno(body, state0, 1000.0, 5000)
    >>> print(indicator.megno.round(), jr.stability.ORDER[indicator.order])
    2.0 regular
    """
    motion = motion_of(system, state0, args, t0, duration)
    plan = _plan(steps, every, samples)
    if vector is not None:
        (vector,) = float_arrays(vector)
        check_shape("vector", vector, (motion.dimension,))
        vector = vector[None]
    rows = _starting_vectors(motion, vector, 1)
    growth = _growth(motion, plan, rows, solver_of(solver))
    ts, _, history, state, error, result = settle(growth, throw, lambda: _findings(motion, rows))
    mean = history[-1]
    order = ORDER.where(mean > _REGULAR, ORDER.undecided, ORDER.regular)
    order = ORDER.where(mean > _CHAOTIC, ORDER.chaotic, order)
    order = ORDER.where(jnp.isnan(mean), ORDER.undefined, order)
    return Megno(mean, 2 * mean / ts[-1], order, ts, history, state, error, result)
