"""fit(): inertia, and what else is asked for, from what was observed."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from jrigid._checks import check_option, check_type, demand, is_good
from jrigid._types import AnyArray
from jrigid.dynamics import State
from jrigid.identify._disturbance import GaussMarkov
from jrigid.identify._errors import conclude
from jrigid.identify._flow import needs_attitude
from jrigid.identify._host import on_host
from jrigid.identify._inertia_models import AbstractInertiaModel, Tensor
from jrigid.identify._inputs import (
    GUESS,
    judge,
    noise_of,
    refuse,
    sizes_of,
    start_of,
    systems_of,
    typical_rate,
)
from jrigid.identify._layout import (
    DirectReadings,
    Layout,
    angle_turned,
    direct_readings_of,
    longest_turn,
    node_states,
    segments,
    segments_needed,
    whole,
)
from jrigid.identify._minimise import tensors_at
from jrigid.identify._problem import Options, Problem
from jrigid.identify._records import (
    Record,
    Samples,
    lengthened,
    of_trials,
    samples_of,
    tells,
)
from jrigid.identify._result import FitResult, Status, arrays_of, result_of
from jrigid.identify._search import Case, Effort, Line, no_search, run, search
from jrigid.identify._smoother import Point
from jrigid.identify._starts import linear_starts
from jrigid.identify._unknowns import Unknowns, unknowns_of
from jrigid.systems import RigidBody

_LENGTHS = {
    True: 3.0,
    False: 0.75,
}  # radians of a segment, of free motion and of forced
_LONG = 60.0  # radians
_PATIENCE = 2.0  # seconds without a sign of life
_FLAT = 1e-3  # least second moment of a body to start from
_ROUND = 0.1  # ... where the first start led nowhere


def fit(
    system: RigidBody | Sequence[RigidBody],
    observations: Any,
    *,
    free: Callable[..., Any] | None = None,
    scale: str = "trace",
    inertia_model: AbstractInertiaModel | None = None,
    start: tuple[Any, State | None] | State | None = None,
    unmodelled: Any = 0.0,
    loss: str = "squares",
    absolute_sigma: bool = True,
    motion: Callable[..., State] | None = None,
    doublings: int = 8,
    max_steps: int = 400,
    progress: bool | None = None,
    throw: bool = True,
) -> FitResult:
    r"""Inertia, and what else is asked for, from what was observed of a rotating body.

    No start and no knobs are needed where rates or attitudes were observed: linear
    equations in the tensor give a start, multiple shooting brings it into the basin of
    the answer, and Levenberg-Marquardt ends there, with the exact flow where the motion
    is free.

    Args:
        system: The body: its torque, and what is known beforehand of the tensor (see
            `scale` and `inertia_model`); the tensor itself is only a start, and none is
            needed for a free body. A sequence has one for each trial, of the same kind:
                its own record of a wheel, say.
        observations: A `Record` (`Rates`, `Attitudes`, ...); a tuple of several of one
            motion; or a list with one entry (a tuple, or a single one) for each trial.
            Records with an axis of trials in front of their times do as well as a list.
        free: What is sought beside the inertia: a function of the system and the
            sensors that picks arrays of theirs,
            `lambda body, gyro: (body.torque.coefficient, gyro.bias)`; of those
            `prior(array, sigma)` is known beforehand, `each(array)` sought anew in each
            trial. Drags and what else cannot be negative are kept positive.
        scale: What sets the scale of the tensor. "trace": nothing does, it keeps the
            trace of the system's; "known": a torque or a momentum whose size is known;
            "rotor": the known momentum of a `torques.Rotor`.
        inertia_model: What is known of the tensor: `Tensor()`, nothing, any real body;
            `Moments()`, `Symmetric()`, `Top()`, `Flat()`, `Fixed()`, a `LogCholesky` of
            ten numbers about a fixed point, or one's own.
        start: Where to start: a `State` at each trial's first sample (`t0` of what is
            returned), of one trial or with an axis of trials in front; or (inertia or
            None, State or None). Needed where the attitude matters and was not
            observed: an attitude nearer than about half a turn will do.
        unmodelled: A torque that no model has: the level [N m sqrt(s)] of a white one
            (its spectral density is the level squared), for all body axes or for each;
            a `GaussMarkov`, which has a memory; or "estimate": of white torques and
            those with a memory, with levels and times for all axes or for each, and
            levels in proportion to the spin of a trial or of its own, the one whose
            likelihood asks for it.
        loss: "squares", or "robust": Cauchy's loss, then samples beyond four standard
            deviations are left out, trials with more than a quarter of such samples
            altogether, and the rest is fitted by squares.
        absolute_sigma: False: the noise stated is relative, its level is that of the
            residuals.
        motion: `(system, state, ts, t0) -> State` in place of the exact flow or
            `simulate`; it must allow forward mode.
        doublings: Where no start can be made from the observations, the first
            2^-doublings of the record is fitted first, then twice as much, and so on.
        max_steps: Steps of the last stage.
        progress: Print each stage as it ends. None: where the standard error is a
            terminal, show it there from two seconds on, in a bar if tqdm is installed.
        throw: True: bad input, and fits that end WRONG_BASIN or NOT_CONVERGED, are
            errors. False: they are results with that status (bad input: of NaN).

    Returns:
        What was found, with errors, and what the record does not tell; `print` it. Its
        `state` is at its `t0`, the first sample of each trial:
        `state0, t0 = found.initial_state()` hands out both.

    Raises:
        ValueError: A request that no record could answer.
        RuntimeError: A failed fit.

    Gradients: none to be relied on; `residuals` and `Plan.bound` have theirs.
    Source: H. G. Bock, multiple shooting (1983); J. J. More, Levenberg-Marquardt
    (1978); docs/identify.md.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> found = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
    >>> print(found.ratios.round(3), found.ratios_errors.round(3))  # 1.5 and 2 in truth
    [1.496 1.995] [0.004 0.005]
    >>> print(found.null_directions)
    ('overall scale',)
    """
    request = _asked(
        system,
        observations,
        free,
        scale,
        inertia_model,
        start,
        unmodelled,
        loss,
        absolute_sigma,
        motion,
    )
    with _reporter(progress) as report:
        (fields,) = _fits([request], Effort(max_steps, doublings, report), throw)
    return result_of(fields)


def fit_each(
    system: RigidBody | Sequence[Any],
    observations: Sequence[Any],
    *,
    free: Callable[..., Any] | None = None,
    scale: str = "trace",
    inertia_model: AbstractInertiaModel | None = None,
    start: Sequence[Any] | None = None,
    unmodelled: Any = 0.0,
    loss: str = "squares",
    absolute_sigma: bool = True,
    motion: Callable[..., State] | None = None,
    doublings: int = 8,
    max_steps: int = 400,
    throw: bool = False,
) -> FitResult:
    """Fit each of many records, which share compiled programs and run side by side.

    It is `fit` in a loop, with the same results, in a fraction of the time: for studies
    of coverage, or a catalogue of bodies. Records may differ in length.

    Args:
        system: The body for all fits; or a sequence of what `fit` takes, once for each
            fit.
        observations: What `fit` takes, once for each fit; the same sensors in all.
        free: As for `fit`.
        scale: As for `fit`.
        inertia_model: As for `fit`.
        start: What `fit` takes, once for each fit.
        unmodelled: As for `fit`.
        loss: As for `fit`.
        absolute_sigma: As for `fit`.
        motion: As for `fit`.
        doublings: As for `fit`.
        max_steps: As for `fit`.
        throw: True: the first fit that fails is an error. False: it has its status.

    Returns:
        One result whose arrays have an axis of fits in front. `residuals`, `kept` and
        `jacobian` are as long as the longest record.

    Raises:
        ValueError: A request that no record could answer, or records of different
            kinds.

    Gradients: none.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> noise = record.sigma * jax.random.normal(jax.random.key(0), (4, 200, 3))
    >>> records = [jr.identify.Rates(record.times, record.omegas + x, 1.4 * record.sigma)
    ...            for x in noise]
    >>> found = jr.identify.fit_each(jr.RigidBody(jnp.ones(3)), records)
    >>> print(found.ratios.shape, found)
    (4, 2) 4 fits: 4 OK
    """
    demand(
        len(observations) > 0, "Argument `observations` must not be empty, but it is."
    )
    count = len(observations)
    systems = [system] * count if isinstance(system, RigidBody) else system
    starts = [None] * count if start is None else start
    demand(
        len(systems) == len(starts) == count,
        "Arguments `system` and `start` must have an entry for each of "
        f"{count} fits, but they have {len(systems)} and {len(starts)}.",
    )
    requests = [
        _asked(
            x,
            y,
            free,
            scale,
            inertia_model,
            z,
            unmodelled,
            loss,
            absolute_sigma,
            motion,
        )
        for x, y, z in zip(systems, observations, starts, strict=True)
    ]
    found = _fits(requests, Effort(max_steps, doublings), throw)
    return _side_by_side(found)


@contextlib.contextmanager
def _reporter(progress: bool | None) -> Iterator[Callable[[str], Any] | None]:
    """What is called with a line after each stage: a bar on a terminal where there is tqdm."""
    if progress is not None or not sys.stderr.isatty():
        yield print if progress else None
        return
    try:
        from tqdm import tqdm
    except ModuleNotFoundError:
        yield _late_lines()
        return
    with tqdm(unit=" stages", delay=_PATIENCE, leave=False) as bar:

        def show(line: str) -> None:
            bar.set_postfix_str(line, refresh=False)
            bar.update()

        yield show


def _late_lines() -> Callable[[str], None]:
    start = time.perf_counter()

    def show(line: str) -> None:
        if time.perf_counter() - start > _PATIENCE:
            print(line, file=sys.stderr)

    return show


class _Asked(NamedTuple):
    """What is asked of a record, after its arguments were checked at trace time."""

    systems: tuple[RigidBody, ...]
    records: tuple[Record, ...]
    options: Options
    tensor: Any
    state: State | None
    torque: GaussMarkov
    free: Callable[..., Any] | None
    scale: str
    inertia_model: AbstractInertiaModel


def _asked(
    system: Any,
    observations: Any,
    free: Callable[..., Any] | None,
    scale: str,
    inertia_model: AbstractInertiaModel | None,
    start: Any,
    unmodelled: Any,
    loss: str,
    absolute_sigma: bool,
    motion: Callable[..., State] | None,
) -> _Asked:
    """Check options and shapes of arguments; ValueError for what no record could answer."""
    records = of_trials(observations)
    trials = records[0].ts.shape[0]
    inertia_model = Tensor() if inertia_model is None else inertia_model
    systems = systems_of(system, trials)
    check_type("inertia_model", inertia_model, AbstractInertiaModel)
    check_option("loss", loss, ("squares", "robust"))
    refuse(systems[0], records, scale, inertia_model)
    tensor, state = start_of(start, trials)
    stated = all(x.states_noise for x in records)
    kind, torque = _torque(unmodelled, absolute_sigma and stated)
    demand(
        stated or len(records) == 1,
        "Argument `observations` must state the noise of each kind where there are several, but "
        "one has neither `sigma` nor `covariance`: they cannot be weighed.",
    )
    options = Options(
        free_motion=systems[0].is_free and motion is None,
        depends_on_attitude=any(x.sensor.depends_on_attitude for x in records)
        or needs_attitude(systems[0]),
        unmodelled=kind,
        robust=loss == "robust",
        noise_known=absolute_sigma and stated,
        motion=motion,
    )
    options = options._replace(shooting=_shoots(options, systems[0], records, state))
    return _Asked(
        systems, records, options, tensor, state, torque, free, scale, inertia_model
    )


def _torque(unmodelled: Any, stated: bool) -> tuple[str, GaussMarkov]:
    """What is to be done about the unmodelled torque, and the torque if it is known."""
    if isinstance(unmodelled, str):
        check_option("unmodelled", unmodelled, ("estimate",))
        return "estimate", GaussMarkov(0.0)
    text = (
        "Argument `unmodelled` must be 0, a positive level, one for each body axis, a "
        f"`GaussMarkov` or 'estimate', but it is {unmodelled!r}."
    )
    torque = unmodelled
    if not isinstance(torque, GaussMarkov):
        demand(np.shape(unmodelled) in ((), (3,)), text)
        torque = GaussMarkov(unmodelled)
    level, time = np.asarray(torque.level), np.asarray(torque.time)
    good = np.all(level == 0) or np.all(level > 0)
    demand(bool(good and np.all(np.isfinite(level)) and np.all(time >= 0)), text)
    known = bool(np.any(level > 0))
    text = "Argument `unmodelled` must be 0 or estimated where the noise is not known, but it is "
    demand(stated or not known, text + "given.")
    return "known" if known else "none", torque


def _shoots(
    options: Options,
    system: RigidBody,
    records: tuple[Record, ...],
    state: State | None,
) -> bool:
    """Whether each segment has a state of its own; ValueError for a fit that cannot be begun."""
    by_attitude = any(tells(x, "attitude") for x in records)
    demand(
        not options.depends_on_attitude or state is not None or by_attitude,
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


class _Observed(NamedTuple):
    """What the records say of the state on the way, and of the size of rates and values."""

    samples: Samples
    readings: DirectReadings | None
    rate: AnyArray
    sizes: tuple[AnyArray, ...]
    angle: float
    coarse: bool
    noise: np.ndarray


def _observed(
    records: tuple[Record, ...], state: State | None, attitude0: np.ndarray | None
) -> _Observed:
    """Read the records of one fit, whose arrays are numpy's."""
    samples = samples_of(records, np.ones((), records[0].values.dtype))
    sizes = sizes_of(samples)
    if not records[0].states_noise:
        samples = samples._replace(whitener=samples.whitener / (GUESS * sizes[0]))
    readings = direct_readings_of(records, samples, attitude0)
    rate = typical_rate(readings, state, samples.ts.dtype)
    angle, coarse = 0.0, False
    if readings is not None:
        angle = float(np.max(angle_turned(readings)[:, -1]))
        coarse = longest_turn(readings) > np.pi
    return _Observed(
        samples, readings, rate, sizes, angle, coarse, noise_of(records, samples, rate)
    )


class _Begun(NamedTuple):
    """Numbers of each attempt, the segments, and the states at their starts."""

    unknowns: Unknowns
    numbers: np.ndarray
    single: Layout
    cut: Layout
    point: Point
    tensor: np.ndarray


def _begun(
    unknowns: Unknowns,
    observed: _Observed,
    tensor: np.ndarray | None,
    state: State | None,
    options: Options,
    length: float,
) -> _Begun:
    """Where the search begins."""
    readings, samples = observed.readings, observed.samples
    trials, dtype = samples.ts.shape[0], samples.ts.dtype
    tensors = linear_starts(options, unknowns, readings, tensor)
    unknowns, numbers = unknowns.starts(
        tensors, [_FLAT] + [_ROUND] * (len(tensors) - 1)
    )
    unknowns = on_host(unknowns)
    single = cut = whole(samples, options.nodes)
    attitude = np.zeros((trials, options.nodes, 4), dtype)
    attitude[..., 0] = 1
    if options.shooting and readings is not None:
        cut, opening = segments(samples, readings, options.nodes, length)
        omega, seen = node_states(readings, opening, cut.start)
        attitude = attitude if seen is None else seen
    else:
        assert state is not None
        omega, attitude = (
            np.broadcast_to(
                x.astype(dtype)[:, None], (trials, options.nodes, x.shape[-1])
            )
            for x in (state.omega, state.attitude)
        )
    torque = np.zeros_like(omega if options.dense else omega[..., :0])
    own = unknowns.own_start(trials, dtype)
    point = Point(numbers[0], own, attitude, omega, torque)
    return _Begun(unknowns, numbers, single, cut, point, tensors[0])


@np.errstate(all="ignore")  # values that are bad or out of range
def _case(asked: _Asked, effort: Effort, throw: bool) -> tuple[Case, Any]:
    """Where the search of a record begins, and the result code of the input."""
    options = asked.options
    records, state, tensor = on_host((asked.records, asked.state, asked.tensor))
    if options.motion is None:  # which may ask for times that increase
        records = tuple(lengthened(x) for x in records)
    dtype = records[0].values.dtype
    attitude0 = None
    if state is not None and options.depends_on_attitude:
        attitude0 = state.attitude.astype(dtype)
    observed = _observed(records, state, attitude0)
    result = judge(asked.systems, records, tensor, state, observed.readings, throw)
    length = 0.0 if options.dense else _LENGTHS[options.free_motion]
    if options.shooting and observed.readings is not None:
        count = observed.readings.ts.shape[1]
        options = options._replace(nodes=segments_needed(observed.angle, count, length))
    unknowns = unknowns_of(
        on_host(asked.systems),
        tuple(x.sensor for x in records),
        observed.sizes,
        asked.free,
        on_host(asked.inertia_model),
        asked.scale != "trace" and not asked.inertia_model.absolute,
        observed.rate,
        records[0].ts.shape[0],
    )
    demand(
        options.noise_known or all(x.sigma is None for x in unknowns.sought),
        "Argument `free` must not state what is known beforehand where the noise of the record is "
        "not stated or only relative, but it does: the two cannot be weighed.",
    )
    begun = _begun(unknowns, observed, tensor, state, options, length)
    line = Line(np.zeros_like(begun.point.numbers), np.zeros((), dtype))
    unknowns = begun.unknowns.holding(line)
    tensor = begun.tensor
    if options.dense:  # a level is sought, in proportion to it
        tensor = np.asarray(tensors_at(unknowns, begun.numbers[:2]))[0]
    case = Case(
        problem=Problem(options, unknowns, observed.samples, observed.noise),
        single=begun.single,
        cut=begun.cut,
        point=begun.point,
        starts=begun.numbers,
        tensor=tensor,
        torque=asked.torque,
        coarse=observed.coarse,
        long=observed.angle > _LONG,
        effort=effort,
    )
    return case, result


def _fits(
    requests: Sequence[_Asked], effort: Effort, throw: bool
) -> list[dict[str, Any]]:
    """Fit records side by side: the fields of each result."""
    cases = [_case(x, effort, throw) for x in requests]
    searches = [
        search(case) if is_good(result) else no_search(case) for case, result in cases
    ]
    lengths = [
        max(x) for x in zip(*(_lengths(y.records) for y in requests), strict=True)
    ]
    results = []
    for (case, input_result), found in zip(cases, run(searches), strict=True):
        fields = conclude(case.problem, found, lengths, input_result)
        for status in (Status.WRONG_BASIN, Status.NOT_CONVERGED):
            if throw and int(fields["status"]) == int(status):
                raise RuntimeError(Status[status])
        results.append(fields)
    return results


def _side_by_side(results: Sequence[dict[str, Any]]) -> FitResult:
    """One result with an axis of fits in front, from the fields of each."""
    columns = zip(*map(arrays_of, results), strict=True)
    stacked = jax.device_put([np.stack(x) for x in columns])
    return jtu.tree_structure(result_of(results[0])).unflatten(stacked)


def _lengths(records: tuple[Record, ...]) -> list[int]:
    """Samples of each record."""
    return [x.ts.shape[-1] for x in records]
