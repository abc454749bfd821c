"""Order and chaos: Lyapunov exponents, and MEGNO, a fast indicator of chaos."""

from typing import Any, NamedTuple

import diffrax
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
from jrigid._core.compile import quick_jit
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

# A MEGNO below the first is regular and above the second chaotic.
# In the limit a regular motion has 2, and a chaotic one grows without bound.
_REGULAR = 3.0
_CHAOTIC = 5.0
# The fewest measurements of growth of a MEGNO. With so many a regular motion is within
# a tenth of 2; with ten it would have 4.
_FEWEST = 100
# A small motion is independent of those before it if its part orthogonal to them has a
# length of this many eps.
_INDEPENDENT = 1e3


class ORDER(Enumeration):
    """Kind of a motion according to MEGNO."""

    regular = "regular"
    undecided = "undecided"
    chaotic = "chaotic"
    undefined = "undefined"


class LyapunovSpectrum(NamedTuple):
    """Lyapunov exponents and their convergence.

    Attributes:
        exponents: Mean rates of growth over the whole time [1/s]. After a long time the
            largest is first; exponents that are nearly equal may change places.
        ts: Times since the start [s].
        history: Exponents up to each of these times [1/s].
        final_state: State at the end.
        error: Largest local error of a step: in the scales of the variables, and that
            of a small motion relative to its length.
        result: `jrigid.RESULTS`.
    """

    exponents: Float[Array, " count"]
    ts: Float[Array, " samples"]
    history: Float[Array, "samples count"]
    final_state: State
    error: Scalar
    result: RESULTS


class Megno(NamedTuple):
    """Mean exponential growth of nearby orbits.

    Attributes:
        megno: Mean Y over the whole time. It tends to 2 for a regular motion (less near
            a periodic orbit), and to half the exponent times the time for a chaotic
            one.
        exponent: Twice `megno` over the time: an estimate of the largest exponent
            [1/s].
        order: One of `ORDER`: "regular" below 3, "chaotic" above 5, "undecided"
            between. A chaotic motion counts as regular for the first ten or so
            e-folding times.
        ts: Times since the start [s].
        history: `megno` up to each of these times.
        final_state: State at the end.
        error: Largest local error of a step: in the scales of the variables, and that
            of a small motion relative to its length.
        result: `jrigid.RESULTS`.
    """

    megno: Scalar
    exponent: Scalar
    order: ORDER
    ts: Float[Array, " samples"]
    history: Float[Array, " samples"]
    final_state: State
    error: Scalar
    result: RESULTS


class _Schedule(NamedTuple):
    """Division of the steps of a motion."""

    samples: int
    intervals: int  # in each sample; the tangents are orthonormalised after each
    steps: int  # in each interval

    @property
    def total(self) -> int:
        """Number of steps."""
        return self.samples * self.intervals * self.steps


def _schedule(steps: int, every: int, samples: int, fewest: int = 1) -> _Schedule:
    """Divide the steps into samples of one length, rounding their number up.

    Args:
        steps: Number of steps.
        every: Number of steps of an interval.
        samples: Number of samples.
        fewest: The fewest intervals; they are shorter where there would be fewer.
    """
    steps = whole_number("steps", steps)
    every = whole_number("every", every)
    samples = min(whole_number("samples", samples), steps)
    # An interval is not longer than a sample.
    every = min(every, -(-steps // max(samples, fewest)))
    # The duration is kept, so more steps are shorter ones, and no result is less
    # accurate than was asked for.
    return _Schedule(samples, -(-steps // (samples * every)), every)


def _starting_vectors(
    motion: Motion, vectors: ArrayLike | None, count: int | None
) -> Array:
    """Small motions to start from: the given rows, or generic ones along no axis.

    Those that are given are in SI units, and the others in the scales of the motion.
    """
    dimension = motion.dimension
    if vectors is None:
        count = dimension if count is None else whole_number("count", count)
        # A vector in a set that the motion keeps invariant would stay in it, and miss
        # the growth across it.
        angles = np.outer(np.arange(1, count + 1), 0.9 * np.arange(dimension) + 0.45)
        vectors = np.cos(angles) + 0.3 * np.eye(count, dimension)
    # A count that was given must be that of the vectors.
    rows = array_of_shape("vectors", vectors, count, dimension).astype(motion.t0.dtype)
    if len(rows) > dimension:
        raise ValueError(
            f"Arguments `count` and `vectors` must name at most {dimension} small "
            f"motions, but they name {len(rows)}."
        )
    return rows


def _findings(motion: Motion, rows: Array, given: bool) -> Findings:
    """Findings about the values of a motion and of its starting vectors."""
    findings = findings_of(motion)
    if given:
        rows = _scaled(walk(motion, 1, findings.ok), rows)
    message = (
        "Arguments `vector(s)` must be finite and linearly independent, but they are "
        "not."
    )
    independent = _are_independent(rows, orthonormal(rows)[1])
    findings.require(independent, RESULTS.invalid_state, message)
    return findings


def _scaled(path: Walk, rows: Array) -> Array:
    """Starting vectors in SI units, in the scales of the motion."""
    return rows / path.units_of_tangents[None]


def _are_independent(rows: Array, lengths: Array) -> Array:
    """Whether rows are independent, from the lengths of their orthogonal parts."""
    least = _INDEPENDENT * jnp.finfo(rows.dtype).eps
    return jnp.all(lengths > least * jnp.sqrt(jnp.sum(rows**2, axis=1)))


class _Growth(NamedTuple):
    """Growth of the small motions up to a time."""

    logarithms: Array  # of the growth of each, summed over the intervals
    weighted: Array  # the same of the first, each interval times its number
    indicator: Array  # sum of 2 weighted / number: MEGNO times the number


def _follow(
    path: Walk, y: Array, schedule: _Schedule
) -> tuple[Array, Array, Array, Array]:
    """State at the end, logarithms and indicator at each sample, largest local error.

    The sum of 2 weighted / number is the discrete MEGNO of Cincotta, Giordano and Simo.
    """

    def interval(
        carry: tuple[Array, _Growth, Array], index: Array
    ) -> tuple[tuple[Array, _Growth, Array], None]:
        y, growth, error = carry
        y, local = path.follow(index * schedule.steps, schedule.steps, y)
        # Otherwise all tangents would turn into the direction of fastest growth.
        rows, lengths = orthonormal(path.tangents(y))
        # Nearly parallel tangents differ by rounding alone.
        apart = _are_independent(path.tangents(y), lengths)
        local = jnp.where(apart, local, jnp.inf)
        # The rows had length 1 at the start of the interval.
        logs = jnp.log(lengths)
        number = (1 + index).astype(y.dtype)
        weighted = growth.weighted + number * logs[0]
        growth = _Growth(
            growth.logarithms + logs,
            weighted,
            growth.indicator + 2 * weighted / number,
        )
        return (path.with_tangents(y, rows), growth, jnp.maximum(error, local)), None

    def sample(
        carry: tuple[Array, _Growth, Array], first: Array
    ) -> tuple[tuple[Array, _Growth, Array], _Growth]:
        indices = first + jnp.arange(schedule.intervals)
        carry, _ = jax.lax.scan(interval, carry, indices)
        return carry, carry[1]

    # Two nested scans store the growth at the samples only, and not after each
    # interval.
    zero = jnp.zeros((), y.dtype)
    no_growth = _Growth(jnp.zeros(len(path.tangents(y)), y.dtype), zero, zero)
    firsts = schedule.intervals * jnp.arange(schedule.samples)
    (y, _, error), growth = jax.lax.scan(sample, (y, no_growth, zero), firsts)
    return y, growth.logarithms, growth.indicator, error


class _Indicators(NamedTuple):
    """Both indicators, which one pass over the motion gives."""

    spectrum: LyapunovSpectrum
    megno: Megno
    result: RESULTS


@quick_jit
def _indicators(
    motion: Motion, schedule: _Schedule, rows: Array, given: bool
) -> _Indicators:
    findings = _findings(motion, rows, given)
    path = walk(motion, schedule.total, findings.ok)
    rows = _scaled(path, rows) if given else rows
    y = path.with_tangents(path.start, orthonormal(rows)[0])

    def follow(path: Walk, y: Array) -> tuple[Array, Array, Array, Array]:
        return _follow(path, y, schedule)

    y, logarithms, indicator, error = in_blocks(follow, path, y)
    samples = 1 + jnp.arange(schedule.samples)
    counts = (schedule.intervals * samples).astype(rows.dtype)
    ts = path.step * schedule.steps * counts
    # MEGNO is the mean of the indicator over the intervals so far.
    values = (ts, logarithms / ts[:, None], indicator / counts, path.state(y))
    ts, exponents, means, state = verdict(findings, path, path.end, error, values)
    mean = means[-1]
    order = ORDER.where(mean > _REGULAR, ORDER.undecided, ORDER.regular)
    order = ORDER.where(mean > _CHAOTIC, ORDER.chaotic, order)
    order = ORDER.where(jnp.isnan(mean), ORDER.undefined, order)
    end = (state, error, findings.result)
    return _Indicators(
        LyapunovSpectrum(exponents[-1], ts, exponents, *end),
        # For chaos MEGNO grows as the exponent times half the time.
        Megno(mean, 2 * mean / ts[-1], order, ts, means, *end),
        findings.result,
    )


def _settled_indicators(
    motion: Motion,
    schedule: _Schedule,
    vectors: ArrayLike | None,
    count: int | None,
    throw: bool,
) -> _Indicators:
    """Both indicators of a motion, or an error."""
    rows = _starting_vectors(motion, vectors, count)
    given = vectors is not None
    indicators = _indicators(motion, schedule, rows, given)
    return settle(indicators, throw, _findings, motion, rows, given)


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
    solver: diffrax.AbstractSolver | None = None,
    throw: bool = True,
) -> LyapunovSpectrum:
    """Lyapunov exponents of a motion, from small motions that are kept orthogonal.

    A small motion is a rotation of the attitude and a change of the angular velocity
    (and of internal parts). A body without internal parts has six exponents; the norm
    of the quaternion has none. The steps are equal and their number is given, so every
    lane of a map costs the same.

    Args:
        system: The body and its torque.
        state0: State at which the motion starts.
        duration: Length of the motion [s]. The error of an exponent is a few over the
            duration.
        steps: Number of steps. Each turn of the fastest part needs some 20 to 60. Steps
            that are too coarse raise an error.
        args: Passed to the torque.
        t0: Time at the start [s].
        count: Number of exponents, from the largest; all by default.
        vectors: Small motions to start from, which give `count`: rows of (rotation
            vector in body axes [rad], change of the rate [rad/s], changes of internal
            parts). They stay in any set that the motion keeps invariant, such as that
            of a planar motion. Their growth is that of a length in which rates count in
            a unit near the largest rate of the motion, a power of two.
        every: Number of steps between two orthogonalisations. Vectors that become
            parallel in between raise an error.
        samples: Number of times in `history`.
        solver: A diffrax solver with an error estimate; `diffrax.Dopri8()` by default.
        throw: With False, a bad or an inaccurate lane gives a result code and NaN.

    Returns:
        The exponents, and their means up to each of the times. `steps` is rounded up to
        fill all intervals.

    Raises:
        RuntimeError: A value is bad, the steps are too coarse, or `every` is too large.

    Gradients: none to be relied on. Those of a chaotic motion grow as fast as it does.
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
    schedule = _schedule(steps, every, samples)
    return _settled_indicators(motion, schedule, vectors, count, throw).spectrum


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
    solver: diffrax.AbstractSolver | None = None,
    throw: bool = True,
) -> Megno:
    """Mean exponential growth of nearby orbits (MEGNO), a fast indicator of chaos.

    It separates order from chaos long before an exponent converges. It needs one small
    motion, and tends to 2 for regular motion of any kind, without a constant that
    depends on the system. The same pass gives the exponent of a chaotic motion.

    Args:
        system: The body and its torque.
        state0: State at which the motion starts.
        duration: Length of the motion [s].
        steps: Number of steps. Each turn of the fastest part needs some 20 to 60. Steps
            that are too coarse raise an error.
        args: Passed to the torque.
        t0: Time at the start [s].
        vector: The small motion to start from, as for `lyapunov_spectrum`.
        every: Number of steps between two measurements of its growth; fewer where there
            would be fewer than 100 measurements, since their mean tends to 2 only if
            there are many.
        samples: Number of times in `history`.
        solver: A diffrax solver with an error estimate; `diffrax.Dopri8()` by default.
        throw: With False, a bad or an inaccurate lane gives a result code and NaN.

    Returns:
        The mean, the exponent it corresponds to, and the kind of motion. `steps` is
        rounded up to fill all intervals.

    Raises:
        RuntimeError: A value is bad, or the steps are too coarse.

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
    schedule = _schedule(steps, every, samples, _FEWEST)
    return _settled_indicators(motion, schedule, vector, 1, throw).megno
