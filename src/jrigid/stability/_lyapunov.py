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
    array_of_shape,
    settle,
    whole_number,
)
from jrigid._core.lanes import in_blocks
from jrigid._types import Scalar, ScalarLike
from jrigid.dynamics import State
from jrigid.stability._stepped_motion import (
    Motion,
    Walk,
    findings_of,
    motion_of,
    orthonormal,
    verdict,
    walk,
)
from jrigid.systems import RigidBody

_REGULAR, _CHAOTIC = 3.0, 5.0  # between them MEGNO has not decided
_INDEPENDENT = (
    1e3  # eps that must be left of a small motion once those before it are taken off
)


class ORDER(Enumeration):
    """What MEGNO says of a motion."""

    regular = "regular"
    undecided = "undecided"
    chaotic = "chaotic"
    undefined = "undefined"


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
        megno: Mean Y over the whole time: tends to 2 for a regular motion (less for one
            near a periodic orbit), and to half the exponent times the time for a
            chaotic one.
        exponent: 2 / time of it: an estimate of the largest exponent [1/s].
        order: One of `ORDER`: "regular" below 3, "chaotic" above 5, between
            "undecided". It starts at "regular" and needs some ten e-folding times to
            leave it.
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
    dimension = motion.dimension
    if vectors is None:
        count = dimension if count is None else whole_number("count", count)
        angles = np.outer(np.arange(1, count + 1), 0.9 * np.arange(dimension) + 0.45)
        vectors = np.cos(angles) + 0.3 * np.eye(count, dimension)
    rows = array_of_shape("vectors", vectors, count, dimension).astype(motion.t0.dtype)
    if len(rows) > dimension:
        raise ValueError(
            f"Arguments `count` and `vectors` must name at most {dimension} small motions, but "
            f"they name {len(rows)}."
        )
    return rows


def _findings(motion: Motion, rows: Array) -> Findings:
    findings = findings_of(motion)
    least = (
        _INDEPENDENT * jnp.finfo(rows.dtype).eps * jnp.sqrt(jnp.sum(rows**2, axis=1))
    )
    message = "Arguments `vector(s)` must be finite and linearly independent, but they are not."
    findings.require(
        jnp.all(orthonormal(rows)[1] > least), RESULTS.invalid_state, message
    )
    return findings


def _plan(steps: Any, every: Any, samples: Any) -> tuple[int, int, int]:
    """Samples, all of one length; intervals between renormalisations in each; steps in each."""
    steps, every = whole_number("steps", steps), whole_number("every", every)
    samples = min(whole_number("samples", samples), steps)
    every = min(every, -(-steps // samples))
    return samples, -(-steps // (samples * every)), every


def _followed(path: Walk, y: Array, plan: tuple[int, int, int]) -> tuple[Array, ...]:
    """Where the motion ends, sums of the growth up to each sample, the largest local error.

    Orthonormal again after each interval; the indicator is that of the first one.
    """
    samples, each, every = plan
    none = jnp.zeros((), y.dtype)

    def interval(carry: tuple, index: Array) -> tuple[tuple, None]:
        y, (totals, weighted, indicator), error = carry
        y, local = path.follow(index * every, every, y)
        rows, lengths = orthonormal(path.tangents(y))
        logs, number = jnp.log(lengths), (1 + index).astype(y.dtype)
        weighted = weighted + number * logs[0]
        tally = (totals + logs, weighted, indicator + 2 * weighted / number)
        return (path.with_tangents(y, rows), tally, jnp.maximum(error, local)), None

    def sample(carry: tuple, first: Array) -> tuple[tuple, Any]:
        carry, _ = jax.lax.scan(interval, carry, first + jnp.arange(each))
        return carry, carry[1]

    begin = (y, (jnp.zeros(len(path.tangents(y)), y.dtype), none, none), none)
    (y, _, error), (totals, _, indicator) = jax.lax.scan(
        sample, begin, each * jnp.arange(samples)
    )
    return y, totals, indicator, error


@eqx.filter_jit
def _growth(
    motion: Motion, plan: tuple[int, int, int], rows: Array
) -> tuple[LyapunovSpectrum, Megno]:
    findings, (samples, each, every) = _findings(motion, rows), plan
    path = walk(motion, samples * each * every, findings.ok)
    y = path.with_tangents(path.start, orthonormal(rows)[0])
    y, totals, indicator, error = in_blocks(
        lambda path, y: _followed(path, y, plan), path, y
    )
    counts = (each * (1 + jnp.arange(samples))).astype(rows.dtype)
    ts = path.step * every * counts
    answer = (ts, totals / ts[:, None], indicator / counts, path.state(y))
    ts, exponents, means, state = verdict(findings, error, answer)
    mean, end = means[-1], (state, error, findings.result)
    order = ORDER.where(mean > _REGULAR, ORDER.undecided, ORDER.regular)
    order = ORDER.where(mean > _CHAOTIC, ORDER.chaotic, order)
    order = ORDER.where(jnp.isnan(mean), ORDER.undefined, order)
    spectrum = LyapunovSpectrum(exponents[-1], ts, exponents, *end)
    return spectrum, Megno(mean, 2 * mean / ts[-1], order, ts, means, *end)


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

    The small motions live where they belong, a turn of the attitude and a change of the
    angular velocity (and of internal parts): six exponents for a plain body, none of
    the quaternion's norm. The steps are equal and their number is given, so that every
    lane of a map costs the same.

    Args:
        system: The body and its torque.
        state0: Where the motion starts.
        duration: How long it is followed [s]: an exponent is uncertain by a few over
            the duration.
        steps: Number of steps; some 20 to 60 for each turn of the fastest part. A step
            too coarse is an error, not a wrong number.
        args: Passed to the torque.
        t0: Time at the start [s].
        count: How many exponents, from the largest; all by default.
        vectors: Small motions to start from, rows of (turn about the body axes, change
            of the rate over the initial one, ...); they stay in any set that the motion
            keeps invariant, such as that of a planar motion. Gives `count`.
        every: Steps between two orthogonalisations.
        samples: How many times of `history`.
        solver: A diffrax solver with an error estimate; `diffrax.Dopri8()` by default.
        throw: False: a bad or an inaccurate lane is a result code and NaN.

    Returns:
        The exponents, and their means up to each of the times. (`steps` is rounded up
        to fill all intervals.)

    Raises:
        RuntimeError: Bad value, steps too coarse.

    Gradients: none to be relied on: those of a chaotic motion grow as fast as it does.
    Source: G. Benettin, L. Galgani, A. Giorgilli, J.-M. Strelcyn, Meccanica 15 (1980)
        9.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))  # integrable: none grows
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 0.3, 0.8]))
    >>> spectrum = jr.stability.lyapunov_spectrum(body, state0, 1000.0, 5000)
    >>> print(bool(jnp.all(jnp.abs(spectrum.exponents) < 0.02)), spectrum.history.shape)
    True (50, 6)
    """
    motion = motion_of(system, state0, args, t0, duration, solver)
    plan, rows = _plan(steps, every, samples), _starting_vectors(motion, vectors, count)
    return settle(_growth(motion, plan, rows)[0], throw, _findings, motion, rows)


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

    One small motion beside the motion is enough, and 2 is what it tends to for order of
    any kind, without a constant of the system's own: that is why this one of the fast
    indicators is here. It also gives the exponent of what is chaotic, in the same pass.

    Args:
        system: The body and its torque.
        state0: Where the motion starts.
        duration: How long it is followed [s].
        steps: Number of steps; some 20 to 60 for each turn of the fastest part. A step
            too coarse is an error, not a wrong number.
        args: Passed to the torque.
        t0: Time at the start [s].
        vector: The small motion to start from, as for `lyapunov_spectrum`.
        every: Steps between two looks at its growth.
        samples: How many times of `history`.
        solver: A diffrax solver with an error estimate; `diffrax.Dopri8()` by default.
        throw: False: a bad or an inaccurate lane is a result code and NaN.

    Returns:
        The mean, the exponent it stands for, and the verdict. (`steps` is rounded up to
        fill all intervals.)

    Raises:
        RuntimeError: Bad value, steps too coarse.

    Gradients: none to be relied on.
    Source: P. M. Cincotta, C. Simo, Astronomy & Astrophysics Supplement 147 (2000) 205;
    in steps, P. M. Cincotta, C. M. Giordano, C. Simo, Physica D 182 (2003) 151.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 0.3, 0.8]))
    >>> indicator = jr.stability.megno(body, state0, 1000.0, 5000)
    >>> print(indicator.megno.round(), jr.stability.ORDER[indicator.order])
    2.0 regular
    """
    motion = motion_of(system, state0, args, t0, duration, solver)
    if vector is not None:
        vector = array_of_shape("vector", vector, motion.dimension)[None]
    plan, rows = _plan(steps, every, samples), _starting_vectors(motion, vector, 1)
    return settle(_growth(motion, plan, rows)[1], throw, _findings, motion, rows)
