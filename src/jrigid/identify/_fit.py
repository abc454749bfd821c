"""fit(): inertia, and what else is asked for, from what was observed."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from jrigid._checks import Findings, check_option, check_type, settle
from jrigid.dynamics import State
from jrigid.identify._compile import quick_jit
from jrigid.identify._errors import conclude
from jrigid.identify._flow import depends_on_attitude
from jrigid.identify._inputs import (
    findings_of,
    noise_of,
    refuse,
    sizes_of,
    start_of,
    systems_of,
    typical_rate,
)
from jrigid.identify._layout import (
    Layout,
    Told,
    angle_turned,
    node_states,
    segments,
    segments_needed,
    times_of,
    told_by,
    whole,
)
from jrigid.identify._records import Record, of_throws, samples_of
from jrigid.identify._residuals import Args, Options, evaluation
from jrigid.identify._result import FitResult, Status
from jrigid.identify._sensors import AbstractSensor
from jrigid.identify._shapes import AbstractShape, Tensor
from jrigid.identify._smoother import Found, Point, minimise
from jrigid.identify._stages import (
    FAINT,
    Stage,
    evidence_of,
    first_level,
    link_whitener,
    misfit,
    next_level,
    rejected,
    scales_of,
    schedule,
    weigher,
)
from jrigid.identify._starts import linear_starts
from jrigid.identify._unknowns import Unknowns, unknowns_of
from jrigid.systems import RigidBody

_LENGTHS = {True: 3.0, False: 0.75}  # radians of a segment, of free motion and of forced
_HISTORY = 1024


def fit(
    system: RigidBody | Sequence[RigidBody],
    observations: Any,
    *,
    free: Callable[..., Any] | None = None,
    scale: str = "trace",
    shape: AbstractShape | None = None,
    start: tuple[Any, State | None] | State | None = None,
    unmodelled: Any = 0.0,
    loss: str = "squares",
    absolute_sigma: bool = True,
    bodies: Sequence[int] | None = None,
    motion: Callable[..., State] | None = None,
    doublings: int = 8,
    max_steps: int = 400,
    progress: bool = False,
    throw: bool = True,
) -> FitResult:
    r"""Inertia, and what else is asked for, from what was observed of a rotating body.

    No start and no knobs are needed where rates or attitudes were observed: linear equations in the
    tensor give a start, multiple shooting brings it into the basin of the answer, and
    Levenberg-Marquardt ends there, with the exact flow where the motion is free.

    Args:
        system: The body: its torque, and what is known beforehand of the tensor (see `scale` and
            `shape`); the tensor itself is only a start, and none is needed for a free body. A
            sequence has one for each throw, of the same kind: its own record of a wheel, say.
        observations: A `Record` (`Rates`, `Attitudes`, ...); a tuple of several of one motion; or a
            list with one entry (a tuple, or a single one) for each throw. Records with an axis of
            throws in front of their times do as well as a list.
        free: What is sought beside the inertia: a function of the system and the sensors that picks
            arrays of theirs, `lambda body, gyro: (body.torque.coefficient, gyro.bias)`; of those
            `prior(array, sigma)` is known beforehand, `each(array)` sought anew in each throw.
            Drags and what else cannot be negative are kept positive.
        scale: What sets the scale of the tensor. "trace": nothing does, it keeps the trace of the
            system's; "known": a torque or a momentum whose size is known; "rotor": the known
            momentum of a `torques.Rotor`.
        shape: What is known of the tensor: `Tensor()`, nothing, any real body; `Moments()`,
            `Symmetric()`, `Top()`, `Flat()`, `Fixed()`, a `LogCholesky` of ten numbers about a
            fixed point, or one's own.
        start: Where to start: a `State` at each throw's first sample (`t0` of what is returned), of
            one throw or with an axis of throws in front; or (inertia or None, State or None).
            Needed where the attitude matters and was not observed: an attitude nearer than about
            half a turn will do.
        unmodelled: A torque that no model has, white, of this level s [N m sqrt(s)] (its spectral
            density is s^2), for all body axes or for each; or "estimate", or "estimate per axis".
        loss: "squares", or "robust": Cauchy's loss, then samples beyond four standard deviations
            are left out, throws with more than a quarter of such samples altogether, and the rest
            is fitted by squares.
        absolute_sigma: False: the noise stated is relative, its level is that of the residuals.
        bodies: Which body each throw is of, counted from 0, where there are several; they share
            sensors and what else `free` picks.
        motion: `(system, state, ts, t0) -> State` in place of the exact flow or `simulate`; it must
            allow forward mode.
        doublings: Where no start can be made from the observations, the first 2^-doublings of the
            record is fitted first, then twice as much, and so on.
        max_steps: Steps of the last stage.
        progress: Print each stage as it ends.
        throw: True: bad input, and fits that end WRONG_BASIN or NOT_CONVERGED, are errors. False:
            they are results with that status (bad input: of NaN).

    Returns:
        What was found, with errors, and what the record does not tell; `print` it. Its `state` is
        at its `t0`, the first sample of each throw: `state0, t0 = found.start()` hands out both.

    Raises:
        ValueError: A request that no record could answer.
        RuntimeError: A failed fit.

    Gradients: none to be relied on; `residuals` and `cramer_rao` have theirs.
    Source: H. G. Bock, multiple shooting (1983); J. J. More, Levenberg-Marquardt (1978);
    docs/identify.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> found = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
    >>> print(found.ratios.round(3), found.ratios_errors.round(3))  # 1.5 and 2 in truth
    [1.496 1.995] [0.004 0.005]
    >>> print(found.null_directions)
    ('overall scale',)
    """
    check_option("loss", loss, ("squares", "robust"))
    records = of_throws(observations)
    throws = records[0].ts.shape[0]
    systems = systems_of(system, throws)
    shape = Tensor() if shape is None else shape
    check_type("shape", shape, AbstractShape)
    refuse(systems[0], records, scale, shape)
    level_kind, level = _level(unmodelled)
    tensor, state = start_of(start, throws)
    options = _options(
        systems[0], records, state, motion, level_kind, loss == "robust", absolute_sigma,
        doublings, max_steps, progress,
    )  # fmt: skip
    each_body = jnp.zeros(throws, int) if bodies is None else jnp.asarray(bodies)
    count = 1 if bodies is None else 1 + max(bodies)
    given = systems, records, tensor, state, options.on_attitude
    prepared = settle(_prepare(*given), throw, lambda: findings_of(*given))
    length = 0.0 if options.dense else _LENGTHS[options.free_motion]
    if options.shooting and prepared.told is not None:
        nodes = segments_needed(prepared.angle, prepared.told.ts.shape[1], length)
        options = options._replace(nodes=nodes)
    unknowns = unknowns_of(
        systems, tuple(x.sensor for x in records), prepared.sizes, free, (shape,) * count,
        scale != "trace" and not shape.absolute, prepared.rate,
    )  # fmt: skip
    if not options.noise_known and any(x.sigma is not None for x in unknowns.sought):
        raise ValueError(
            "Argument `free` must not state what is known beforehand where the noise of the record "
            "is not stated or only relative, but it does: the two cannot be weighed."
        )
    found = _fit(
        options, length, unknowns, records, prepared, each_body, tensor, state,
        jnp.asarray(level, prepared.rate.dtype),
    )  # fmt: skip
    if not throw:
        return found
    findings = Findings()
    for status in (Status.WRONG_BASIN, Status.NOT_CONVERGED):
        findings.require(found.status != status, None, Status[status])
    return findings.guard(found, throw)


def _level(unmodelled: Any) -> tuple[str, Any]:
    """What is to be done about the unmodelled torque, and its level for each axis."""
    if isinstance(unmodelled, str):
        check_option("unmodelled", unmodelled, ("estimate", "estimate per axis"))
        return unmodelled, np.zeros(3)
    level = np.asarray(unmodelled, float)
    if level.shape not in ((), (3,)) or not np.all(np.isfinite(level)) or np.any(level < 0):
        raise ValueError(
            "Argument `unmodelled` must be a level that is not negative, one for each body axis, "
            f"'estimate' or 'estimate per axis', but it is {unmodelled!r}."
        )
    level = np.broadcast_to(level, 3)
    if np.any(level > 0) and not np.all(level > 0):
        raise ValueError(
            "Argument `unmodelled` must be positive for all axes or for none, but it is "
            f"{unmodelled!r}."
        )
    return ("known" if np.any(level > 0) else "none"), level


def _options(
    system: RigidBody,
    records: tuple[Record, ...],
    state: State | None,
    motion: Any,
    level: str,
    robust: bool,
    absolute_sigma: bool,
    doublings: int,
    max_steps: int,
    progress: bool,
) -> Options:
    """How the fit goes, as far as that is known beforehand; ValueError if it cannot."""
    sensors = [x.sensor for x in records]
    by_attitude = any(_tells(x, "attitude") for x in records)
    on_attitude = any(x.on_attitude for x in sensors) or depends_on_attitude(system)
    if on_attitude and state is None and not by_attitude:
        raise ValueError(
            "Argument `start` must hold a State whose attitude the fit can start from, since the "
            "motion or an observation depends on the attitude and none was observed, but it does "
            "not."
        )
    internal = system.with_parts(State(jnp.zeros(4), jnp.zeros(3))).internal is not None
    observed = by_attitude or any(_tells(x, "rates") for x in records)
    shooting = observed and motion is None and not internal
    if not shooting and state is None:
        raise ValueError(
            "Argument `start` must hold a State to start from, since neither rates nor attitudes "
            "were observed, or they do not tell the whole state, but it does not."
        )
    if level != "none" and not shooting:
        raise ValueError(
            "Argument `unmodelled` must be 0 where neither rates nor attitudes were observed, a "
            "part moves inside the body or `motion` is given, but it is not."
        )
    stated = all(x.states_noise for x in records)
    if not stated and len(records) > 1:
        raise ValueError(
            "Argument `observations` must state the noise of each kind where there are several, "
            "but one has neither `sigma` nor `covariance`: they cannot be weighed."
        )
    return Options(
        system.is_free and motion is None, on_attitude, shooting, 1, level != "none", robust,
        absolute_sigma and stated, level, motion, doublings, max_steps, progress,
    )  # fmt: skip


def _tells(record: Record, what: str) -> bool:
    """Whether a sensor tells of rates, or attitudes, by itself."""
    return getattr(type(record.sensor), what) is not getattr(AbstractSensor, what)


class _Prepared(NamedTuple):
    """What tells the state on the way, sizes of rates and values, and what is wrong."""

    told: Told | None
    rate: Array
    sizes: tuple[Array, ...]
    angle: Array
    result: Any


@eqx.filter_jit
def _prepare(
    systems: Any, records: tuple[Record, ...], tensor: Any, state: State | None, on_attitude: bool
) -> _Prepared:
    samples = tuple(samples_of(x, jnp.ones((), x.values.dtype)) for x in records)
    dtype = samples[0].ts.dtype
    attitude0 = None if state is None or not on_attitude else state.attitude.astype(dtype)
    told = told_by(records, samples, attitude0)
    rate = typical_rate(told, state, dtype)
    findings = findings_of(systems, records, tensor, state, on_attitude)
    angle = jnp.zeros(()) if told is None else jnp.max(angle_turned(told)[:, -1])
    return _Prepared(told, rate, sizes_of(samples), angle, findings.result)


@quick_jit
def _fit(
    options: Options,
    length: float,
    unknowns: Unknowns,
    records: tuple[Record, ...],
    prepared: _Prepared,
    bodies: Array,
    tensor: Any,
    state: State | None,
    level: Array,
) -> FitResult:
    """Lane after lane under vmap: none waits for the slowest."""
    arrays, rest = eqx.partition(
        (unknowns, records, prepared, bodies, tensor, state, level), eqx.is_array
    )

    @jax.custom_batching.sequential_vmap
    def one(arrays: Any) -> FitResult:
        return _fitted(options, length, *eqx.combine(arrays, rest))

    return one(arrays)


def _fitted(
    options: Options,
    length: float,
    unknowns: Unknowns,
    records: tuple[Record, ...],
    prepared: _Prepared,
    bodies: Array,
    tensor: Any,
    state: State | None,
    level: Array,
) -> FitResult:
    told, rate = prepared.told, prepared.rate
    guess = 0.02 * prepared.sizes[0]
    samples = tuple(samples_of(x, guess) for x in records)
    ts, there = times_of(samples)
    noise = noise_of(records, samples, rate)
    throws, dtype = ts.shape[0], ts.dtype
    starts = linear_starts(options, unknowns, told, bodies, tensor)
    unknowns, numbers = unknowns.start(starts[0])
    other = unknowns.start(starts[1], 0.1)[1]
    single = whole(ts, there, options.nodes)
    cut, attitude, omega = single, None, None
    if options.shooting and told is not None:
        cut, opening = segments(ts, there, told, options.nodes, length)
        omega, attitude = node_states(told, opening, cut.start)
    elif state is not None:
        omega, attitude = (
            jnp.broadcast_to(x.astype(dtype)[:, None], (throws, options.nodes, x.shape[-1]))
            for x in (state.omega, state.attitude)
        )
    assert omega is not None
    if attitude is None:
        attitude = jnp.zeros((throws, options.nodes, 4), dtype).at[..., 0].set(1)
    point = Point(numbers, unknowns.own_start(throws, dtype), attitude, omega)
    args = Args(unknowns, samples, bodies, noise)
    way = _search(options, args, single, cut, point, other, level)
    layout = cut if options.dense or not options.free_motion else single
    return conclude(options, args, layout, way.found, way.kept, way.scales, way.level,
                    prepared.result)  # fmt: skip


class _Way(NamedTuple):
    """Where a search stands."""

    found: Found
    kept: tuple[Array, ...]  # 1 or 0 for each sample
    scales: Array  # of the residuals of each record, in units of the noise
    level: Array  # of the unmodelled torque
    done: Array  # the level has come to rest


def _search(
    options: Options,
    args: Args,
    single: Layout,
    cut: Layout,
    point: Point,
    other: Array,
    level: Array,
) -> _Way:
    """Through all stages; if that ends wrong, once more, more slowly, from other numbers."""
    stages = schedule(options, point.omega.dtype)

    def run(way: _Way, stage: Stage) -> _Way:
        layout = jtu.tree_map(lambda a, b: jnp.where(stage.whole, a, b), single, cut)
        found, kept, scales, level, done = way
        if options.robust:
            scales = scales_of(options, args, found, kept)
            fewer = rejected(args, found.rows, kept, scales)
            kept = jtu.tree_map(lambda a, b: jnp.where(stage.reject, a, b), fewer, kept)
        weigh = weigher(options, args, layout, kept, scales, stage)
        if options.level == "known":
            level = first * (known / first) ** stage.weight
        white = link_whitener(options, args, layout, found.point.numbers, stage.weight, level)

        def enough(cost: Array) -> Array:
            count = jnp.maximum(sum(jnp.sum(w) for w in kept), 1.0)
            return stage.enough * jnp.where(options.noise_known, 1.0, cost / count)

        found = found._replace(fresh=found.fresh | stage.fresh)
        evaluate = evaluation(options, args, layout)
        found = minimise(evaluate, weigh, white, found, enough, stage.steps)
        if options.progress:
            jax.debug.print(
                "fit: {} steps, links {}, record {}: chi-square {}",
                found.steps, stage.weight, jnp.minimum(stage.horizon, 1.0), weigh(found.rows)[1],
            )  # fmt: skip
        if options.level.startswith("estimate"):
            weights, _ = weigh(found.rows)
            seen = evidence_of(layout, found, weights, white)
            new, still = next_level(options, level, FAINT * first, seen)
            level = jnp.where(stage.last, level, new)
            done = done | still
        return _Way(found, kept, scales, level, done)

    def one(way: _Way, stage: Stage) -> tuple[_Way, None]:
        skip = (stage.steps == 0) | (way.done & ~stage.last)
        return jax.lax.cond(skip, lambda way, _: way, run, way, stage), None

    dtype = point.omega.dtype
    first, known = first_level(args, cut, point.numbers), level
    shapes = eqx.filter_eval_shape(evaluation(options, args, cut), point)
    rows, links = jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    no, none = jnp.asarray(False), jnp.asarray(0)
    begin = Found(point, rows, links, ~no, no, none, jnp.full(_HISTORY, jnp.nan, dtype))
    kept = tuple(jnp.any(x.weight > 0, axis=-1).astype(dtype) for x in args.samples)
    begin = _Way(begin, kept, jnp.ones(len(kept), dtype), 10 * first, no)

    def attempt(carry: tuple[Array, _Way, Array]) -> tuple[Array, _Way, Array]:
        tried, best, wrong = carry
        numbers = jnp.where(tried > 0, other, point.numbers)
        start = begin.found._replace(
            point=point._replace(numbers=numbers), steps=best.found.steps,
            history=best.found.history,
        )  # fmt: skip
        now = jtu.tree_map(lambda x: x[tried], stages)
        end, _ = jax.lax.scan(one, begin._replace(found=start), now)
        off = misfit(options, args, end.found, end.kept)
        best = jtu.tree_map(lambda a, b: jnp.where(off < wrong, a, b), end, best)
        return tried + 1, best, jnp.minimum(off, wrong)

    attempts = stages.weight.shape[0]
    carry = none, begin, jnp.asarray(jnp.inf, dtype)
    _, way, _ = jax.lax.while_loop(lambda x: (x[0] < attempts) & (x[2] > 0), attempt, carry)
    return way
