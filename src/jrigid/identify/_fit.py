"""fit(): estimates of inertia and other parameters from observations."""

import dataclasses
import math
from collections.abc import Callable, Generator, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool

from jrigid._checks import check_option, check_type, demand, is_good
from jrigid._types import AnyArray
from jrigid.dynamics import State
from jrigid.identify import _conventions as conventions
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
    result_of_start,
    sizes_of,
    start_of,
    systems_of,
    typical_rate,
)
from jrigid.identify._layout import (
    Layout,
    node_states,
    segments,
    segments_needed,
    whole,
)
from jrigid.identify._minimise import Minimum, tensors_at
from jrigid.identify._problem import Options, Problem, SimulatedWithParts
from jrigid.identify._progress import reporter
from jrigid.identify._quality import Fit
from jrigid.identify._readings import (
    DirectReadings,
    angle_turned,
    direct_readings_of,
    longest_turn,
    other_way_round,
    vector_in_space,
)
from jrigid.identify._reasons import reason
from jrigid.identify._records import (
    Record,
    Samples,
    lengthened,
    of_trials,
    samples_of,
    tells,
)
from jrigid.identify._resolution import is_resolved, jumps_in_a_segment
from jrigid.identify._result import FitResult, Status, arrays_of, result_of
from jrigid.identify._search import (
    Case,
    Effort,
    Line,
    Request,
    Starts,
    attempt,
    no_search,
    run,
    search,
)
from jrigid.identify._sensors import AbstractSensor
from jrigid.identify._smoother import Point
from jrigid.identify._starts import linear_starts
from jrigid.identify._unknowns import Unknowns, are_alike, unknowns_of
from jrigid.systems import RigidBody

# Radians of a segment, of free motion and of forced.
# The exact flow holds over any length, and 3 is below half a turn. A forced segment is
# a single Runge-Kutta step, unless its torque asks for shorter ones.
_LENGTHS = {True: 3.0, False: 0.75}
_STEPS = (4, 16, 64)  # of a segment, where one is too long for a torque
# After so many turns the valley of the minimum is so narrow that probes go slowly, too.
_MOST_JUMPS = 16  # of a torque in a segment at which steps may end
_LONG = 60.0  # radians


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
    r"""Estimate the inertia of a rotating body and other parameters from observations.

    No initial values are needed where rates or attitudes were observed. Linear
    equations in the tensor give them, multiple shooting brings them into the basin of
    the minimum, and Levenberg-Marquardt ends there. Beside rates, known directions and
    fields tell the attitude of a free body. Free motion is evaluated by the exact flow.

    Args:
        system: The body, with its torque. What is known of its tensor is said by
            `scale` and `inertia_model`; the tensor itself is an initial value, which a
            free body does not need. A sequence has one body for each trial, of the same
            kind, with its own record of a wheel, say.
        observations: A `Record` (`Rates`, `Attitudes`, ...); a tuple of several of one
            motion; or a list with one entry (a tuple, or a single one) for each trial.
            Records with an axis of trials in front of their times may replace a list.
        free: What is sought beside the inertia. It is a function of the system and the
            sensors that picks arrays of theirs,
            `lambda body, gyro: (body.torque.coefficient, gyro.bias)`. Of those,
            `prior(array, sigma)` is known beforehand, and `each(array)` is sought anew
            in each trial, `each(array, groups)` in each group of trials. Drags, and
            what else cannot be negative, are kept positive.
        scale: What sets the scale of the tensor. "trace": nothing, it keeps the trace
            of the system's tensor; "known": a torque or a momentum whose size is known;
            "rotor": the known momentum of a `torques.Rotor`.
        inertia_model: What is known of the tensor. `Tensor()`: nothing, any real body;
            `Moments()`, `Symmetric()`, `Top()`, `Flat()`, `Fixed()`, a `LogCholesky` of
            ten numbers about a fixed point, or a model of one's own.
        start: Initial values: a `State` at each trial's first sample (`t0` of the
            result), of one trial or with an axis of trials in front; or a tuple
            (inertia or None, State or None). A state is needed where the attitude
            matters and no sensor tells it; beside rates that were read its own rates
            may be zero. Attitudes at equal intervals are also those of a body that
            turns the other way round between them: a state says which. Parts that move
            inside the body (`torques.SpinningMass`, `torques.InternalDamper`) begin in
            the state that is given, the same for all trials; they are not sought.
        unmodelled: An unmodelled torque. It is the level [N m sqrt(s)] of a white
            torque, for all body axes or for each (its spectral density is the level
            squared); a `GaussMarkov`, which has a correlation time; or "estimate". A
            level that is given asks for a noise that is stated. With "estimate"
            the likelihood selects one of white torques and those with a
            correlation time, with levels and times for all axes or for each, and with
            levels in proportion to the spin of a trial or of its own.
        loss: "squares" or "robust". A robust fit begins with Cauchy's loss. Then
            samples are left out whose whitened square exceeds its degrees of freedom
            by 16, and trials with more than a quarter of such samples altogether. The
            rest is fitted by squares.
        absolute_sigma: False: the stated noise is relative, and its level is that of
            the residuals.
        motion: `(system, state, ts, t0) -> State` in place of the exact flow or
            `simulate`; it must allow forward mode. A search tries bodies whose motion
            cannot be integrated: give a `simulate` within it `throw=False`.
        doublings: Where the observations give no initial values, the first
            2^-doublings of the record is fitted first, then twice as much, and so on.
        max_steps: Steps of the last stage.
        progress: Print each stage as it ends. None: where the standard error is a
            terminal, show it there from two seconds on, in a bar if tqdm is installed.
        throw: True: bad input, and fits that end WRONG_BASIN or NOT_CONVERGED, are
            errors. False: they are results with that status (bad input: of NaN).

    Returns:
        The estimates with their errors, and what the record does not determine; `print`
        shows them. The `state` is at `t0`, the first sample of each trial, and
        `state0, t0 = found.initial_state()` returns both.

    Raises:
        ValueError: A request that no record could answer.
        RuntimeError: A failed fit, or bad values of a record or a body.

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
    question = _Question(
        free, scale, inertia_model, unmodelled, loss, absolute_sigma, motion
    )
    task = _task(question, _Bodies(system), observations, start)
    with reporter(progress) as report:
        (fields,) = _fits([task], Effort(max_steps, doublings, report), throw)
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
    """Fit each of many records, with shared compiled programs.

    The results are those of `fit` in a loop, with an axis of fits in front. On a GPU
    several records share each call. Use it for studies of coverage, or for a catalogue
    of bodies. Records may differ in length.

    Args:
        system: The body for all fits; or a sequence of what `fit` takes, once for each
            fit.
        observations: What `fit` takes, once for each fit; the same sensors in all.
        free: As for `fit`.
        scale: As for `fit`.
        inertia_model: As for `fit`.
        start: What `fit` takes, once for each fit. States of internal parts must be the
            same in all.
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
        RuntimeError: With `throw=True`, a failed fit or bad values.

    Gradients: none.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> noise = record.sigma * jax.random.normal(jax.random.key(0), (4, 200, 3))
    >>> records = [
    ...     jr.identify.Rates(record.times, record.omegas + x, 1.4 * record.sigma)
    ...     for x in noise]
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
    question = _Question(
        free, scale, inertia_model, unmodelled, loss, absolute_sigma, motion
    )
    # Fits of the same body share what is computed of it alone.
    bodies = {id(x): _Bodies(x) for x in systems}
    tasks = [
        _task(question, bodies[id(body)], observed, first)
        for body, observed, first in zip(systems, observations, starts, strict=True)
    ]
    kinds = [
        (x.systems[0], *(y.sensor for y in x.records), x.options.motion) for x in tasks
    ]
    demand(
        are_alike(kinds),
        "Arguments `system`, `observations` and `start` must be of one kind for all "
        "fits, but torques, sensors, functions in them or states of internal parts "
        "differ: call `fit` for each.",
    )
    return _side_by_side(_fits(tasks, Effort(max_steps, doublings), throw))


class _Question(NamedTuple):
    """Keyword arguments of `fit`, which apply to every record."""

    free: Callable[..., Any] | None
    scale: str
    inertia_model: AbstractInertiaModel | None
    unmodelled: Any
    loss: str
    absolute_sigma: bool
    motion: Callable[..., State] | None


class _Bodies:
    """The argument `system` of a fit, and what follows from it alone."""

    def __init__(self, system: RigidBody | Sequence[RigidBody]):
        """Take a body, or one for each trial."""
        self._system = system
        self._systems: dict[int, tuple[RigidBody, ...]] = {}

    def of_trials(self, trials: int) -> tuple[RigidBody, ...]:
        """One body, or one for each trial; ValueError if there are others."""
        if trials not in self._systems:
            self._systems[trials] = systems_of(self._system, trials)
        return self._systems[trials]

    @cached_property
    def _any(self) -> tuple[RigidBody, ...]:
        """The bodies, however many trials there are."""
        # `_task` has called `of_trials` before it asks for anything else.
        return next(iter(self._systems.values()))

    @cached_property
    def on_host(self) -> tuple[RigidBody, ...]:
        """The bodies with numpy arrays."""
        return on_host(self._any)

    @cached_property
    def need_attitude(self) -> bool:
        """Whether the torque looks at the attitude."""
        return needs_attitude(self._any[0])

    @cached_property
    def carry_parts(self) -> bool:
        """Whether parts move inside the body."""
        # Only the structure of the state matters.
        still = State(jnp.zeros(4), jnp.zeros(3))
        return self._any[0].with_parts(still).internal is not None

    @cached_property
    def result(self) -> Any:
        """The result code of the values of the bodies."""
        return result_of_start(self._any, None, None)


class _Task(NamedTuple):
    """A record to be fitted, after the arguments were checked at trace time.

    Attributes:
        bodies: Those of the fit.
        systems: One, or one for each trial.
        records: With an axis of trials in front.
        options: What is fixed when the fit is compiled.
        tensor: Where to start, if that is given.
        state: Where each trial starts, if that is given.
        torque: Unmodelled, if it is known.
        inertia_model: What is known of the inertia.
        question: What is asked.
    """

    bodies: _Bodies
    systems: tuple[RigidBody, ...]
    records: tuple[Record, ...]
    options: Options
    tensor: Array | None
    state: State | None
    torque: GaussMarkov
    inertia_model: AbstractInertiaModel
    question: _Question


def _task(question: _Question, bodies: _Bodies, observations: Any, start: Any) -> _Task:
    """Check options and shapes; ValueError for what no record could answer."""
    records = of_trials(observations)
    trials = records[0].ts.shape[0]
    inertia_model = question.inertia_model
    inertia_model = Tensor() if inertia_model is None else inertia_model
    systems = bodies.of_trials(trials)
    check_type("inertia_model", inertia_model, AbstractInertiaModel)
    check_option("loss", question.loss, ("squares", "robust"))
    refuse(systems[0], records, question.scale, inertia_model)
    tensor, state, internal = start_of(start, trials)
    motion = question.motion
    if motion is None and bodies.carry_parts:
        demand(
            internal is not None,
            "Argument `start` must hold a State with the state of the parts inside the "
            "body in `internal`, which a fit takes as known, but it does not (at rest: "
            "`system.with_parts(state)`).",
        )
        motion = SimulatedWithParts(internal)
    stated = all(x.states_noise for x in records)
    noise_known = question.absolute_sigma and stated
    kind, torque = _torque(question.unmodelled, noise_known)
    demand(
        stated or len(records) == 1,
        "Argument `observations` must state the noise of each kind where there are "
        "several, but one has neither `sigma` nor `covariance`: they cannot be "
        "weighed.",
    )
    # Without anything that depends on it the attitude is left out of the states: three
    # numbers instead of six for each segment.
    of_sensors = any(x.sensor.depends_on_attitude for x in records)
    options = Options(
        free_motion=systems[0].is_free and motion is None,
        depends_on_attitude=of_sensors or bodies.need_attitude,
        unmodelled=kind,
        robust=question.loss == "robust",
        noise_known=noise_known,
        motion=motion,
    )
    options = options._replace(shooting=_shoots(options, bodies, records, state))
    return _Task(
        bodies=bodies,
        systems=systems,
        records=records,
        options=options,
        tensor=tensor,
        state=state,
        torque=torque,
        inertia_model=inertia_model,
        question=question,
    )


def _torque(unmodelled: Any, noise_known: bool) -> tuple[str, GaussMarkov]:
    """Treatment of the unmodelled torque, and the torque if it is known."""
    if isinstance(unmodelled, str):
        check_option("unmodelled", unmodelled, ("estimate",))
        return "estimate", GaussMarkov(0.0)
    torque = unmodelled
    shown = repr(unmodelled)
    if isinstance(torque, GaussMarkov):
        shown = f"one of level {torque.level} and correlation time {torque.time}"
    text = (
        "Argument `unmodelled` must be 0, a positive level, one for each body axis, a "
        f"`GaussMarkov` or 'estimate', but it is {shown}."
    )
    if not isinstance(torque, GaussMarkov):
        demand(np.shape(unmodelled) in ((), (3,)), text)
        torque = GaussMarkov(unmodelled)
    level = np.asarray(torque.level)
    time = np.asarray(torque.time)
    # The whitener of the torque divides by its levels. A fit without any does not use
    # it.
    good = np.all(level == 0) or np.all(level > 0)
    finite = np.all(np.isfinite(level)) and np.all(np.isfinite(time))
    demand(bool(good and finite and np.all(time >= 0)), text)
    known = bool(np.any(level > 0))
    demand(
        noise_known or not known,
        "Argument `unmodelled` must be 0 or estimated where the noise is not known, "
        "but it is given.",
    )
    return "known" if known else "none", torque


def _shoots(
    options: Options,
    bodies: _Bodies,
    records: tuple[Record, ...],
    state: State | None,
) -> bool:
    """Whether each segment has a state of its own; ValueError if no fit can begin."""
    by_attitude = any(tells(x, "attitude") for x in records)
    by_rates = any(tells(x, "rates") for x in records)
    # A free body looks the same from all sides but for the vectors that sensors show.
    by_vectors = (
        by_rates
        and options.free_motion
        and all(_shows_attitude(x.sensor) for x in records)
    )
    demand(
        not options.depends_on_attitude
        or state is not None
        or by_attitude
        or by_vectors,
        "Argument `start` must hold a State whose attitude the fit can start from, "
        "since the motion or an observation depends on the attitude and none was "
        "observed, but it does not.",
    )
    observed = by_attitude or by_rates
    # The state of a part inside the body is not read directly, so that a segment could
    # not begin with it.
    shooting = observed and options.motion is None and not bodies.carry_parts
    demand(
        shooting or state is not None,
        "Argument `start` must hold a State to start from, since neither rates nor "
        "attitudes were observed, or they do not tell the whole state, but it does "
        "not.",
    )
    demand(
        shooting or not options.dense,
        "Argument `unmodelled` must be 0 where neither rates nor attitudes were "
        "observed, a part moves inside the body or `motion` is given, but it is not.",
    )
    return shooting


def _shows_attitude(sensor: AbstractSensor) -> bool:
    """Whether a sensor shows the attitude by a vector, or does not depend on it."""
    return not sensor.depends_on_attitude or vector_in_space(sensor) is not None


class _Observed(NamedTuple):
    """Estimates from the records: the motion, and the sizes of rates and values.

    Attributes:
        samples: Of all records.
        readings: Rates and attitudes along the way, where a sensor tells them.
        alias: Those of another motion with the same attitudes, if there may be one.
        rate: Rms of the rates [rad/s].
        sizes: Rms of the values of each record.
        angle: Most radians that a trial turns.
        coarse: Whether the body turns by more than half a turn between samples.
        noise: Of rates [rad/s] and turns [rad] (6,).
    """

    samples: Samples
    readings: DirectReadings | None
    alias: DirectReadings | None
    rate: AnyArray
    sizes: tuple[AnyArray, ...]
    angle: float
    coarse: bool
    noise: np.ndarray


def _observed(
    records: tuple[Record, ...],
    state: State | None,
    attitude0: np.ndarray | None,
    robust: bool,
) -> _Observed:
    """Read the records of one fit, whose arrays are numpy's."""
    samples = samples_of(records, np.ones((), records[0].values.dtype))
    sizes = sizes_of(samples)
    if not records[0].states_noise:
        # Only a single record may leave its noise unstated: see `_task`. The guess sets
        # the unit of chi-square and the weights of the links. Errors follow from the
        # residuals.
        samples = samples._replace(whitener=samples.whitener / (GUESS * sizes[0]))
    readings = direct_readings_of(records, samples, attitude0, robust)
    alias = None
    if readings is not None and not any(tells(x, "rates") for x in records):
        alias = other_way_round(readings)
    if readings is not None and alias is not None and state is not None:
        # The initial state says which of the two motions it was. The first rows of a
        # trial may be no readings.
        first = state.omega
        seen = np.argmax(readings.valid, axis=1)
        at = np.arange(seen.size), seen
        off = np.sum((readings.omega[at] - first) ** 2)
        off_alias = np.sum((alias.omega[at] - first) ** 2)
        readings = alias if off_alias < off else readings
        alias = None
    rate = typical_rate(readings, state, samples.ts.dtype)
    angle = 0.0
    coarse = False
    if readings is not None:
        angle = float(np.max(angle_turned(readings)[:, -1]))
        # Readings more than half a turn apart are also those of another motion, an
        # alias.
        coarse = longest_turn(readings) > np.pi
    noise = noise_of(records, samples, rate)
    return _Observed(samples, readings, alias, rate, sizes, angle, coarse, noise)


def _first_attitude(
    records: tuple[Record, ...], state: State | None, options: Options
) -> np.ndarray | None:
    """Attitude of each trial at which integration of rates begins; None if unused."""
    if not options.depends_on_attitude:
        return None
    dtype = records[0].values.dtype
    if state is not None:
        return np.asarray(state.attitude, dtype)
    # Vectors that sensors show turn this one: see `_shoots`.
    upright = np.array([1.0, 0.0, 0.0, 0.0], dtype)
    return np.tile(upright, (len(records[0].ts), 1))


class _Opening(NamedTuple):
    """Unknowns, layouts and initial values with which a search begins.

    Attributes:
        unknowns: What is sought, with the frame of the inertia model chosen.
        starts: Numbers of each attempt.
        single: One segment a trial.
        cut: Many segments.
        point: Numbers of the first attempt, and states as observed.
        tensor: Of the first attempt.
    """

    unknowns: Unknowns
    starts: Starts
    single: Layout
    cut: Layout
    point: Point
    tensor: np.ndarray


def _opening(
    unknowns: Unknowns,
    observed: _Observed,
    tensor: np.ndarray | None,
    state: State | None,
    options: Options,
    length: float,
) -> _Opening:
    """Choose where the search begins, by segments of some length [rad]."""
    readings = observed.readings
    samples = observed.samples
    trials = samples.ts.shape[0]
    dtype = samples.ts.dtype
    tensors = linear_starts(options, unknowns, readings, tensor)
    starts = Starts(unknowns, tensors)
    unknowns = on_host(starts.unknowns)
    single = cut = whole(samples, options.nodes)
    if options.shooting and readings is not None:
        cut, first_samples = segments(samples, readings, options.nodes, length)
        omega, attitude = node_states(readings, first_samples, cut.start)
        if attitude is None:
            # Where no attitude is known nothing depends on it, so that any will do.
            attitude = np.zeros((trials, options.nodes, 4), dtype)
            attitude[..., 0] = 1
    else:
        # `_shoots` has demanded a state where the records do not tell it.
        assert state is not None
        omega, attitude = (
            np.broadcast_to(
                x.astype(dtype)[:, None], (trials, options.nodes, x.shape[-1])
            )
            for x in (state.omega, state.attitude)
        )
    torque = np.zeros_like(omega if options.dense else omega[..., :0])
    own = unknowns.own_start(trials, dtype)
    point = Point(starts[0], own, attitude, omega, torque)
    return _Opening(unknowns, starts, single, cut, point, tensors[0])


@np.errstate(all="ignore")  # values that are bad or out of range
def _case(task: _Task, effort: Effort, throw: bool) -> tuple[Case, Any]:
    """The case to search, with its initial values, and the result code of the input."""
    options = task.options
    records, state, tensor = on_host((task.records, task.state, task.tensor))
    if options.motion is None:  # which may ask for times that increase
        records = tuple(lengthened(x) for x in records)
    attitude0 = _first_attitude(records, state, options)
    observed = _observed(records, state, attitude0, options.robust)
    input_result = _judged(task, records, observed, throw)
    given = _unknowns(task, records, observed)
    usable = is_good(input_result)
    # The first division whose steps follow the torque is taken, since finer ones cost
    # more time. If none does, the last one is, and `integration_error` of the result
    # says how well it does.
    for division, length in _divisions(options, observed):
        options = division
        opening = _opening(given, observed, tensor, state, options, length)
        problem = _problem(options, observed, opening)
        # Of a record that cannot be used nothing is calculated.
        if not usable:
            break
        problem, follows = _along_the_torque(problem, opening)
        if follows:
            break
    case = Case(
        problem=problem,
        single=opening.single,
        cut=opening.cut,
        point=opening.point,
        starts=opening.starts,
        tensor=_first_tensor(problem, opening),
        torque=task.torque,
        coarse=observed.coarse,
        long=observed.angle > _LONG,
        alias=None,
        given=None,
        effort=effort,
    )
    if task.tensor is not None and state is not None:
        case = _with_given(case, state)
    if usable and observed.alias is not None:
        other = observed._replace(readings=observed.alias)
        opening = _opening(given, other, opening.tensor, state, options, length)
        problem = _problem(problem.options, other, opening)
        case = dataclasses.replace(case, alias=_read_anew(case, problem, opening))
    return case, input_result


def _problem(options: Options, observed: _Observed, opening: _Opening) -> Problem:
    """A record as it is fitted, with numbers as they are at the opening."""
    # A probe holds a direction; here none is held, by a line of the same structure.
    numbers = opening.point.numbers
    line = Line(np.zeros_like(numbers), np.zeros((), numbers.dtype))
    unknowns = opening.unknowns.holding(line)
    return Problem(options, unknowns, observed.samples, observed.noise)


def _first_tensor(problem: Problem, opening: _Opening) -> np.ndarray:
    """The tensor in proportion to which the level of a torque is sought."""
    if not problem.options.dense:
        return opening.tensor
    numbers = np.stack([opening.starts[0]] * 2)
    return np.asarray(tensors_at(problem.unknowns, numbers))[0]


def _with_given(case: Case, state: State) -> Case:
    """The case of a record, which may also begin at a state that the user gave.

    Only the exact flow goes on from there in one segment a trial.
    """
    options = case.problem.options
    if options.dense or not options.free_motion:
        return case
    point = case.point
    dtype = point.omega.dtype
    omega = np.broadcast_to(state.omega[:, None], point.omega.shape)
    attitude = np.broadcast_to(state.attitude[:, None], point.attitude.shape)
    point = point._replace(omega=omega.astype(dtype), attitude=attitude.astype(dtype))
    given = dataclasses.replace(case, cut=case.single, point=point)
    return dataclasses.replace(case, given=given)


def _read_anew(case: Case, problem: Problem, opening: _Opening) -> Case:
    """The case of a record, from another reading of it."""
    return dataclasses.replace(
        case,
        problem=problem,
        cut=opening.cut,
        point=opening.point,
        starts=opening.starts,
    )


def _along_the_torque(problem: Problem, opening: _Opening) -> tuple[Problem, bool]:
    """The problem, with steps that end at jumps if needed, and whether they suffice."""
    if is_resolved(problem, opening.cut, opening.point):
        return problem, True
    jumps = jumps_in_a_segment(problem, opening.cut, opening.point)
    if not 0 < jumps <= _MOST_JUMPS:
        return problem, False
    options = problem.options._replace(jumps=jumps)
    problem = dataclasses.replace(problem, options=options)
    return problem, is_resolved(problem, opening.cut, opening.point)


def _divisions(
    options: Options, observed: _Observed
) -> Iterator[tuple[Options, float]]:
    """Ever finer divisions of a record into segments, and their lengths [rad].

    A torque may change faster than the body turns. Then segments become shorter in
    time, as long as they hold two samples, and are passed in several steps.
    """
    # An unmodelled torque may act between any two samples, so that each has a node.
    length = 0.0 if options.dense else _LENGTHS[options.free_motion]
    if not options.shooting or observed.readings is None:
        yield options, length
        return
    count = observed.readings.ts.shape[1]
    nodes = segments_needed(observed.angle, count, length)
    yield options._replace(nodes=nodes), length
    # From here on a length of zero spreads the nodes evenly over the readings.
    most = segments_needed(math.inf, count, length)
    while nodes < most:
        nodes = min(4 * nodes, most)
        yield options._replace(nodes=nodes), 0.0
    for steps in _STEPS:
        yield options._replace(nodes=nodes, steps=steps), 0.0


def _judged(
    task: _Task, records: tuple[Record, ...], observed: _Observed, throw: bool
) -> Any:
    """The result code of the input; RuntimeError for bad input if `throw`."""
    # What the bodies alone decide is computed once for all fits that share them.
    from_bodies = task.tensor is None and task.state is None
    return judge(
        task.systems,
        records,
        task.tensor,
        task.state,
        observed.readings,
        throw,
        of_start=task.bodies.result if from_bodies else None,
    )


def _unknowns(
    task: _Task, records: tuple[Record, ...], observed: _Observed
) -> Unknowns:
    """Unknowns of the fit, around the bodies and sensors as they were given."""
    question = task.question
    unknowns = unknowns_of(
        task.bodies.on_host,
        tuple(x.sensor for x in records),
        observed.sizes,
        question.free,
        on_host(task.inertia_model),
        # An absolute model holds the scale in its own numbers.
        question.scale != "trace" and not task.inertia_model.absolute,
        observed.rate,
        records[0].ts.shape[0],
    )
    demand(
        task.options.noise_known or all(x.sigma is None for x in unknowns.sought),
        "Argument `free` must not state what is known beforehand where the noise of "
        "the record is not stated or only relative, but it does: the two cannot be "
        "weighed.",
    )
    return unknowns


def _fits(tasks: Sequence[_Task], effort: Effort, throw: bool) -> list[dict[str, Any]]:
    """Fit records side by side: the fields of each result."""
    columns = zip(*(_lengths(x.records) for x in tasks), strict=True)
    # Results of many fits are stacked, so that all are as long as the longest record.
    lengths = [max(x) for x in columns]
    return run(_fields(x, effort, throw, lengths) for x in tasks)


def _fields(
    task: _Task, effort: Effort, throw: bool, lengths: Sequence[int]
) -> Generator[Request, Minimum, dict[str, Any]]:
    """Fit a record: the fields of the result, with residuals of these lengths."""
    case, input_result = _case(task, effort, throw)
    # A record that cannot be used takes no steps, but its result has the same arrays.
    good = is_good(input_result)
    best = yield from search(case) if good else no_search(case)
    fields = conclude(best, lengths, input_result)
    if good:
        fields["conventions"] = yield from _conventions(task, best, effort)
    for status in (Status.WRONG_BASIN, Status.NOT_CONVERGED):
        if throw and int(fields["status"]) == int(status):
            text = reason(result_of(fields))
            raise RuntimeError(f"{Status[status]} {text}".strip())
    return fields


def _conventions(
    task: _Task, best: Fit, effort: Effort
) -> Generator[Request, Minimum, Bool[np.ndarray, " conventions"]]:
    """Whether each other convention would fit; all False if the fit is not far off."""
    found = np.zeros(conventions.COUNT, bool)
    if not conventions.is_far(best):
        return found
    records = on_host(task.records)
    by_turns = conventions.of_turns(records)
    if by_turns is None:
        for index, changed in conventions.readings(records):
            other = task._replace(records=changed)
            found[index] = yield from _fits_as(other, best, effort)
    else:
        found |= by_turns
    systems = conventions.wheels_reversed(task.systems)
    if systems is not None:
        one, *others = systems
        bodies = _Bodies(systems if others else one)
        systems = bodies.of_trials(task.records[0].ts.shape[0])
        other = task._replace(bodies=bodies, systems=systems)
        found[conventions.WHEELS] = yield from _fits_as(other, best, effort)
    return found


def _fits_as(
    task: _Task, best: Fit, effort: Effort
) -> Generator[Request, Minimum, bool]:
    """Whether a record fits that was changed, while it did not before."""
    case, input_result = _case(task, effort, False)
    if not is_good(input_result):
        return False
    # A record that is read rightly needs no second search.
    other = yield from attempt(case, case.problem, case.starts[0], slow=False)
    return conventions.explains(other, best)


def _side_by_side(results: Sequence[dict[str, Any]]) -> FitResult:
    """One result with an axis of fits in front, from the fields of each."""
    columns = zip(*map(arrays_of, results), strict=True)
    stacked = jax.device_put([np.stack(x) for x in columns])
    # Each record chose its steps and jumps. The largest numbers do for all.
    options = [x["problem"].options for x in results]
    steps = max(x.steps for x in options)
    jumps = max(x.jumps for x in options)
    problem = dataclasses.replace(
        results[0]["problem"], options=options[0]._replace(steps=steps, jumps=jumps)
    )
    one = result_of(results[0] | {"problem": problem})
    return jtu.tree_structure(one).unflatten(stacked)


def _lengths(records: tuple[Record, ...]) -> list[int]:
    """Samples of each record."""
    return [x.ts.shape[-1] for x in records]
