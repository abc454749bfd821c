"""fit(): inertia, and what else is asked for, from what was observed."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jrigid._checks import Findings, check_option, check_type, demand, settle
from jrigid.dynamics import State
from jrigid.identify._compile import quick_jit
from jrigid.identify._errors import conclude
from jrigid.identify._flow import depends_on_attitude
from jrigid.identify._inputs import (
    GUESS,
    bodies_of,
    findings_of,
    noise_of,
    refuse,
    sizes_of,
    start_of,
    systems_of,
    tells,
    typical_rate,
)
from jrigid.identify._layout import (
    Told,
    angle_turned,
    longest_turn,
    node_states,
    segments,
    segments_needed,
    told_by,
    whole,
)
from jrigid.identify._problem import Options, Problem
from jrigid.identify._records import Record, of_throws, samples_of
from jrigid.identify._result import FitResult, Status
from jrigid.identify._search import Line, search
from jrigid.identify._shapes import AbstractShape, Tensor
from jrigid.identify._smoother import Point
from jrigid.identify._starts import linear_starts
from jrigid.identify._unknowns import Unknowns, unknowns_of
from jrigid.systems import RigidBody

_LENGTHS = {True: 3.0, False: 0.75}  # radians of a segment, of free motion and of forced
_LONG = 60.0  # radians
_ROUND = 0.1  # least second moment of a body to start from, where the first start led nowhere


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

    Gradients: none to be relied on; `residuals` and `Plan.bound` have theirs.
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
    records = of_throws(observations)
    throws, shape = records[0].ts.shape[0], Tensor() if shape is None else shape
    systems = systems_of(system, throws)
    check_type("shape", shape, AbstractShape)
    check_option("loss", loss, ("squares", "robust"))
    refuse(systems[0], records, scale, shape)
    tensor, state = start_of(start, throws)
    stated = all(x.states_noise for x in records)
    kind, level = _level(unmodelled, absolute_sigma and stated)
    demand(
        stated or len(records) == 1,
        "Argument `observations` must state the noise of each kind where there are several, but "
        "one has neither `sigma` nor `covariance`: they cannot be weighed.",
    )
    options = Options(
        systems[0].is_free and motion is None,
        any(x.sensor.on_attitude for x in records) or depends_on_attitude(systems[0]),
        level=kind, robust=loss == "robust", noise_known=absolute_sigma and stated, motion=motion,
        doublings=doublings, max_steps=max_steps, progress=progress,
    )  # fmt: skip
    options = options._replace(shooting=_shoots(options, systems[0], records, state))
    each_body = bodies_of(bodies, throws)
    given = systems, records, tensor, state, options.on_attitude
    prepared = _prepare(*given)
    prepared = settle(prepared, throw, findings_of, *given[:-1], prepared.told)
    length = 0.0 if options.dense else _LENGTHS[options.free_motion]
    if options.shooting and prepared.told is not None:
        count = prepared.told.ts.shape[1]
        options = options._replace(nodes=segments_needed(prepared.angle, count, length))
    unknowns = unknowns_of(
        systems, tuple(x.sensor for x in records), prepared.sizes, free,
        (shape,) * (1 if bodies is None else 1 + max(bodies)),
        scale != "trace" and not shape.absolute, prepared.rate,
    )  # fmt: skip
    demand(
        options.noise_known or all(x.sigma is None for x in unknowns.sought),
        "Argument `free` must not state what is known beforehand where the noise of the record is "
        "not stated or only relative, but it does: the two cannot be weighed.",
    )
    level = jnp.asarray(level, prepared.rate.dtype)
    found = _fit(options, length, unknowns, records, prepared, each_body, tensor, state, level)
    return _guarded(found) if throw else found


def _guarded(found: FitResult) -> FitResult:
    """The result, or an error where there is none."""
    findings = Findings()
    for status in (Status.WRONG_BASIN, Status.NOT_CONVERGED):
        findings.require(found.status != status, None, Status[status])
    return findings.guard(found, True)


def _level(unmodelled: Any, stated: bool) -> tuple[str, Any]:
    """What is to be done about the unmodelled torque, and its level for each axis."""
    if isinstance(unmodelled, str):
        check_option("unmodelled", unmodelled, ("estimate", "estimate per axis"))
        return unmodelled, np.zeros(3)
    level = np.asarray(unmodelled, float)
    good = level.shape in ((), (3,)) and (np.all(level == 0) or np.all(level > 0))
    demand(
        bool(good and np.all(np.isfinite(level))),
        "Argument `unmodelled` must be 0, a positive level, one for each body axis, 'estimate' or "
        f"'estimate per axis', but it is {unmodelled!r}.",
    )
    kind, text = "known" if np.any(level > 0) else "none", "where the noise is not known"
    text = f"Argument `unmodelled` must be 0 or estimated {text}, but it is given."
    demand(stated or kind == "none", text)
    return kind, np.broadcast_to(level, 3)


def _shoots(
    options: Options, system: RigidBody, records: tuple[Record, ...], state: State | None
) -> bool:
    """Whether each segment has a state of its own; ValueError for a fit that cannot be begun."""
    by_attitude = any(tells(x, "attitude") for x in records)
    demand(
        not options.on_attitude or state is not None or by_attitude,
        "Argument `start` must hold a State whose attitude the fit can start from, since the "
        "motion or an observation depends on the attitude and none was observed, but it does not.",
    )
    internal = system.with_parts(State(jnp.zeros(4), jnp.zeros(3))).internal is not None
    observed = by_attitude or any(tells(x, "rates") for x in records)
    shooting = observed and options.motion is None and not internal
    demand(
        shooting or state is not None,
        "Argument `start` must hold a State to start from, since neither rates nor attitudes were "
        "observed, or they do not tell the whole state, but it does not.",
    )
    demand(
        shooting or not options.dense,
        "Argument `unmodelled` must be 0 where neither rates nor attitudes were observed, a part "
        "moves inside the body or `motion` is given, but it is not.",
    )
    return shooting


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
    samples = samples_of(records, jnp.ones((), records[0].values.dtype))
    dtype = samples.ts.dtype
    attitude0 = None if state is None or not on_attitude else state.attitude.astype(dtype)
    told = told_by(records, samples, attitude0)
    rate = typical_rate(told, state, dtype)
    findings = findings_of(systems, records, tensor, state, told)
    angle = jnp.zeros(()) if told is None else jnp.max(angle_turned(told)[:, -1])
    return _Prepared(told, rate, sizes_of(samples), angle, findings.result)


@quick_jit
def _fit(options: Options, length: float, *given: Any) -> FitResult:
    """Lane after lane under vmap: none waits for the slowest."""
    arrays, rest = eqx.partition(given, eqx.is_array)

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
    told = prepared.told
    samples = samples_of(records, GUESS * prepared.sizes[0])
    throws, dtype = samples.ts.shape[0], samples.ts.dtype
    starts = linear_starts(options, unknowns, told, bodies, tensor)
    unknowns, numbers = unknowns.start(starts[0])
    others = jax.vmap(lambda tensors: unknowns.start(tensors, _ROUND)[1])(starts[1:])
    numbers = jnp.concatenate([numbers[None], others])
    single = cut = whole(samples, options.nodes)
    attitude = jnp.zeros((throws, options.nodes, 4), dtype).at[..., 0].set(1)
    if options.shooting and told is not None:
        cut, opening = segments(samples, told, options.nodes, length)
        omega, seen = node_states(told, opening, cut.start)
        attitude = attitude if seen is None else seen
    else:
        assert state is not None
        omega, attitude = (
            jnp.broadcast_to(x.astype(dtype)[:, None], (throws, options.nodes, x.shape[-1]))
            for x in (state.omega, state.attitude)
        )
    point = Point(numbers[0], unknowns.own_start(throws, dtype), attitude, omega)
    noise = noise_of(records, samples, prepared.rate)
    unknowns = unknowns.holding(Line(jnp.zeros_like(point.numbers), jnp.zeros((), dtype)))
    problem = Problem(options, unknowns, samples, bodies, noise)
    coarse = jnp.asarray(False) if told is None else longest_turn(told) > jnp.pi
    way = search(problem, single, cut, point, numbers, level, coarse, prepared.angle > _LONG)
    layout = cut if options.dense or not options.free_motion else single
    return conclude(problem, layout, way, prepared.result)
