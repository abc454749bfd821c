"""The least-squares problem of a record: residuals, gaps and their derivatives."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from jrigid._core.inline import inlined
from jrigid._numerics import product
from jrigid._types import AnyArray
from jrigid.dynamics import State
from jrigid.identify._flow import forced_flow, free_flow
from jrigid.identify._layout import Layout
from jrigid.identify._records import Samples
from jrigid.identify._sensors import AbstractSensor
from jrigid.identify._smoother import Links, Point, Rows
from jrigid.identify._unknowns import Unknowns
from jrigid.rotation import conjugate, exp, multiply, normalize
from jrigid.simulate import simulate
from jrigid.systems import RigidBody

# Tolerance of the integration of a whole record, by the size of the dtype in bytes.
RTOL = {8: 1e-9, 4: 1e-5}
# Standard deviations beyond a limit, where a saturated reading no longer matters.
_DEEPEST = 6.0


class Options(NamedTuple):
    """Options that are fixed when a fit is compiled.

    Attributes:
        free_motion: Whether no torque acts.
        depends_on_attitude: Whether the torque or a sensor depends on the attitude.
        shooting: Whether each segment has a state of its own, not only each trial.
        nodes: How many nodes a trial has.
        steps: Runge-Kutta steps from a node to a sample, or to the next node.
        jumps: How many jumps of the torque may lie between; steps end there.
        unmodelled: Whether there is a torque without a model: "none", "known" or
            "estimate".
        robust: Whether Cauchy's loss may be used.
        noise_known: Whether the noise of the records is stated.
        motion: Function (system, state, times, t0) that returns states, in place of
            `simulate`.
    """

    free_motion: bool
    depends_on_attitude: bool
    shooting: bool = False
    nodes: int = 1
    steps: int = 1
    jumps: int = 0
    unmodelled: str = "none"
    robust: bool = False
    noise_known: bool = True
    motion: Callable[..., State] | None = None

    @property
    def dense(self) -> bool:
        """Whether each sample has a node."""
        return self.unmodelled != "none"

    @property
    def local(self) -> int:
        """Size of a change of the state: three rates, and three of a turn if needed."""
        return 6 if self.depends_on_attitude else 3


class Problem(eqx.Module):
    """A record as it is fitted."""

    options: Options = eqx.field(static=True)
    unknowns: Unknowns
    samples: Samples
    noise: AnyArray  # of rates [rad/s] and turns [rad], (6,), for the links

    @property
    def known(self) -> int:
        """Number of rows that a trial has besides its samples.

        First come those for prior knowledge of the trial's own numbers. Those for all
        trials follow and count in the first trial only: prior knowledge of the numbers,
        and a fit held near its start.
        """
        unknowns = self.unknowns
        known = sum(x.base.size for x in unknowns.sought if x.sigma is not None)
        return known + (unknowns.hold is not None) + self.held

    def priors(self, trials: int) -> int:
        """Number of residuals of prior knowledge, of so many trials.

        A direction that is held is none: it restricts the numbers.
        """
        known = [x for x in self.unknowns.sought if x.sigma is not None]
        own = sum(x.base.size for x in known if x.own)
        shared = sum(x.base.size for x in known if not x.own)
        return trials * own + shared

    @property
    def held(self) -> int:
        """Number of rows that hold a fit near its start on a part of the record.

        They are those of all numbers but the inertia's: a few samples say little of
        a scale, which could go anywhere.
        """
        return self.unknowns.size - self.unknowns.slices["scale"].start


class _Trial(NamedTuple):
    """Data of one trial: (nodes, ...), (samples, ...)."""

    layout: Layout
    samples: Samples
    first: Array  # 1 for the first trial, else 0


class _Memory(NamedTuple):
    """The states that the readings of one sensor depend on.

    A sensor without memory has a single lag of zero.

    Attributes:
        sample: Index of the sample of each state (lags x samples,).
        lag: Time from the state to the sample (lags x samples,) [s].
        weight: Weight of each lag (lags,).
    """

    sample: Array
    lag: Array
    weight: Array


def in_any_order(motion: Callable[[Array], State], ts: Array) -> State:
    """States at unordered times, of a motion that takes ordered ones."""
    # Samples of several records stand side by side, so that their times are not
    # ordered.
    order = jnp.argsort(ts)
    states = motion(ts[order])
    back = jnp.argsort(order)
    return State(states.attitude[back], states.omega[back])


def flow(
    options: Options,
    system: RigidBody,
    before: State,
    start: Array,
    end: Array,
    steps: int | Array,
) -> State:
    """States a short time after, or before, given states (n, ...), one each.

    Args:
        options: Those of the fit.
        system: The body.
        before: The given states.
        start: Their times [s].
        end: Times of the results [s].
        steps: How many steps are made under a torque.
    """
    if not options.free_motion:

        def forced(state: State, start: Array, end: Array) -> State:
            return forced_flow(
                system,
                state,
                start,
                end,
                options.depends_on_attitude,
                steps=steps,
                jumps=options.jumps,
            )

        return jax.vmap(forced)(before, start, end)
    turn, omega = jax.vmap(lambda w, t: free_flow(system.inertia, w, t))(
        before.omega, end - start
    )
    if options.depends_on_attitude:
        turn = jax.vmap(multiply)(before.attitude, turn)
    return State(turn, omega)


def _integrated(
    options: Options, system: RigidBody, first: State, ts: Array, t0: Array
) -> State:
    """States of a trial from its first one, by `simulate` or by the user's motion."""
    first = State(normalize(first.attitude), first.omega)
    motion = simulated if options.motion is None else options.motion
    return in_any_order(lambda times: motion(system, first, times, t0), ts)


def simulated(system: RigidBody, first: State, times: Array, t0: Array) -> State:
    """States at the times, by `simulate`."""
    # Few unknowns meet many residuals, hence forward mode. A motion that cannot be
    # integrated is not finite, and the step that led there is rejected.
    return simulate(
        system,
        first,
        times,
        t0=t0,
        rtol=RTOL[times.dtype.itemsize],
        throw=False,
        adjoint=diffrax.ForwardMode(),
        max_steps=100_000,
    ).states


class SimulatedWithParts:
    """`simulated`, for parts inside the body that begin in a given state.

    Two of them are equal, and serve one compiled program, where the states are.
    """

    def __init__(self, internal: Any):
        """Parts that begin in a state: an entry for each torque that carries parts."""
        self._internal = jtu.tree_map(np.asarray, internal)
        leaves, structure = jtu.tree_flatten(self._internal)
        self._key = structure, tuple((x.tobytes(), x.shape, x.dtype) for x in leaves)

    def __eq__(self, other: object) -> bool:
        """Whether the other one's parts begin in the same state."""
        return isinstance(other, SimulatedWithParts) and self._key == other._key

    def __hash__(self) -> int:
        """Hash of the state of the parts."""
        return hash(self._key)

    def __call__(
        self, system: RigidBody, first: State, times: Array, t0: Array
    ) -> State:
        """States at the times."""
        internal = jtu.tree_map(jnp.asarray, self._internal)
        first = State(first.attitude, first.omega, internal)
        return simulated(system, first, times, t0)


def _picked(state: State, index: Array | slice | int) -> State:
    """The states at an index."""
    return State(state.attitude[index], state.omega[index])


def _memory_of(sensor: AbstractSensor, part: slice, dtype: Any) -> _Memory:
    """The states that a sensor's readings of some samples depend on."""
    lag, weight = sensor.memory() or (jnp.zeros(1), jnp.ones(1))
    # Samples vary fastest, as `_reading` takes them apart again.
    return _Memory(
        sample=jnp.tile(jnp.arange(part.start, part.stop), lag.size),
        lag=jnp.repeat(lag.astype(dtype), part.stop - part.start),
        weight=weight.astype(dtype),
    )


def _states(
    options: Options,
    system: RigidBody,
    nodes: State,
    layout: Layout,
    sample: Array,
    lag: Array | None,
) -> tuple[State, State]:
    """States of a trial near its samples, and at the ends of its links.

    Args:
        options: Of the fit.
        system: The body.
        nodes: States at the nodes.
        layout: The nodes.
        sample: Indices of samples.
        lag: Time from the state to the sample [s]; None if it is zero for all.

    Returns:
        States of which the first are those near the samples, and those at the ends.
    """
    ts = layout.ts[sample]
    times = ts if lag is None else ts - lag
    if options.shooting or options.free_motion:
        node = layout.node[sample]
        # One call evaluates both, which halves the size of the program.
        start = jnp.concatenate([layout.start[node], layout.start])
        end = jnp.concatenate([times, layout.end])
        before = jtu.tree_map(lambda x: jnp.concatenate([x[node], x]), nodes)
        states = flow(options, system, before, start, end, options.steps)
        return states, _picked(states, slice(sample.size, None))
    first = _picked(nodes, 0)
    whole = _integrated(options, system, first, layout.ts, layout.start[0])
    states = _picked(whole, sample)
    # The lags of a sensor are short, so that one step from its samples suffices.
    if lag is not None:
        states = flow(options, system, states, ts, times, options.steps)
    # A trial with one node has no links, so that these ends have no effect.
    return states, nodes


def _reading(
    system: RigidBody, sensor: AbstractSensor, memory: _Memory, ts: Array, states: State
) -> Array:
    """Values (n, k) that a sensor shows, of the states that its memory names."""

    def value(t: Array, attitude: Array, omega: Array) -> Array:
        return sensor.predict(t, State(attitude, omega), system)

    values = jax.vmap(value)(ts[memory.sample], states.attitude, states.omega)
    values = values.reshape(memory.weight.size, -1, *values.shape[1:])
    if memory.weight.size == 1:
        return values[0]
    return product("l,lnk->nk", memory.weight, values)


def _readings(
    options: Options,
    system: RigidBody,
    sensors: Sequence[AbstractSensor],
    nodes: State,
    layout: Layout,
    samples: Samples,
) -> tuple[list[Array], State]:
    """Return what the sensors show in a trial, and its states at the ends of links.

    Args:
        options: Of the fit.
        system: The body.
        sensors: The sensors.
        nodes: States at the nodes.
        layout: The nodes.
        samples: The samples.

    Returns:
        Values of each sensor (n, k), and states (nodes, ...).
    """
    dtype = layout.ts.dtype
    memories = [
        _memory_of(sensor, part, dtype)
        for sensor, part in zip(sensors, samples.parts, strict=True)
    ]
    sample = jnp.concatenate([x.sample for x in memories])
    lag = None
    if any(x.memory() is not None for x in sensors):
        lag = jnp.concatenate([x.lag for x in memories])
    states, ends = _states(options, system, nodes, layout, sample, lag)
    values = []
    start = 0
    for sensor, memory in zip(sensors, memories, strict=True):
        own = _picked(states, slice(start, start + memory.sample.size))
        values.append(_reading(system, sensor, memory, layout.ts, own))
        start += memory.sample.size
    return values, ends


def shown_by(
    options: Options,
    system: RigidBody,
    sensors: Sequence[AbstractSensor],
    start: State,
    t0: Array,
    samples: Samples,
) -> list[Array]:
    """Values (n, k) that sensors show of the motion from a state at t0."""
    first = t0[None]
    ts = samples.ts
    layout = Layout(
        ts=ts,
        node=jnp.zeros(ts.shape, int),
        start=first,
        end=first,
        linked=first > t0,
        since=ts,
    )
    nodes = State(start.attitude[None], start.omega[None])
    options = options._replace(shooting=False)
    return _readings(options, system, sensors, nodes, layout, samples)[0]


def _unlikely(rows: Array, sign: Array) -> Array:
    """Residuals of saturated readings, which say "at least"; others as they are.

    The square of such a residual is -2 log of the probability that noise takes the
    reading beyond the limit.
    """
    beyond = jnp.where(sign != 0, jnp.clip(sign * rows, -1e3, _DEEPEST), 0.0)
    # In float64 and in float32 the bounds of `beyond` keep the root and its slope
    # finite.
    size = jnp.sqrt(-2 * jax.scipy.special.log_ndtr(beyond))
    return jnp.where(sign != 0, -sign * size, rows)


def whitened(
    sensors: Sequence[AbstractSensor], samples: Samples, predicted: list[Array]
) -> Array:
    """Residuals of a trial (n, D) in units of their noise, zero without a reading."""
    width = samples.weight.shape[-1]
    parts = []
    for sensor, observed, values in zip(
        sensors, samples.values, predicted, strict=True
    ):
        if values.shape != observed.shape:
            raise ValueError(
                f"Argument `function` of `{type(sensor).__name__}` must return shape "
                f"{observed.shape[1:]}, but it returns {values.shape[1:]}."
            )
        part = jax.vmap(sensor.difference)(observed, values)
        parts.append(jnp.pad(part, ((0, 0), (0, width - part.shape[1]))))
    # What a sensor predicts where it had no reading may be NaN.
    seen = jnp.where(samples.weight > 0, jnp.concatenate(parts), 0.0)
    rows = product("nij,nj->ni", samples.whitener, seen)
    if any(x.saturation() is not None for x in sensors):
        rows = _unlikely(rows, samples.sign)
    # Missing readings have finite values, so that derivatives stay finite too.
    return rows * samples.weight


def as_read(sensor: AbstractSensor, values: Array) -> Array:
    """Predicted values (..., k) as a sensor reads them, which ends at its limit."""
    largest = sensor.saturation()
    if largest is None:
        return values
    largest = jnp.broadcast_to(largest.astype(values.dtype), values.shape)
    return jnp.clip(values, -largest, largest)


def predictions(problem: Problem, layout: Layout, point: Point) -> list[Array]:
    """Predicted values of each record (trials, n, k), with one body in all trials."""
    unknowns = problem.unknowns
    system, *sensors = unknowns.parts(
        point.numbers, point.own[0], unknowns.leaves_of(0)
    )

    def trial(
        attitude: Array, omega: Array, layout: Layout, samples: Samples
    ) -> list[Array]:
        nodes = State(attitude, omega)
        return _readings(problem.options, system, sensors, nodes, layout, samples)[0]

    return jax.vmap(trial)(point.attitude, point.omega, layout, problem.samples)


def _gaps(options: Options, point: Point, ends: State, linked: Array) -> Array:
    """Ends of segments less the starts of the next ones (nodes, local)."""
    gap = ends.omega - jnp.roll(point.omega, -1, axis=0)
    if options.depends_on_attitude:
        following = jnp.roll(point.attitude, -1, axis=0)
        turn = jax.vmap(lambda a, b: multiply(conjugate(a), b))(
            following, ends.attitude
        )
        # Twice the vector part is the rotation vector of a small turn.
        side = jnp.where(turn[:, :1] < 0, -1.0, 1.0)
        gap = jnp.concatenate([gap, 2 * side * turn[:, 1:]], axis=-1)
    return jnp.where(linked[:, None], gap, 0.0)


def _residuals(
    problem: Problem,
    numbers: Array,
    own: Array,
    move: Array,
    point: Point,
    leaves: tuple[AnyArray, ...],
    trial: _Trial,
) -> tuple[Array, Array]:
    """Rows (n, D) and gaps (nodes, local) of one trial.

    Rows of samples come first, then one for each number that is known beforehand, then
    the numbers that hold a fit near its start.

    Args:
        problem: The record.
        numbers: The numbers.
        own: The trial's own numbers.
        move: Changes of the states at the nodes (nodes, local).
        point: The point at which these states are. The next segments start there.
        leaves: The trial's arrays of system and sensors.
        trial: The trial.
    """
    options, unknowns = problem.options, problem.unknowns
    system, *sensors = unknowns.parts(numbers, own, leaves)
    attitude = point.attitude
    if options.depends_on_attitude:
        attitude = jax.vmap(lambda q, v: multiply(q, exp(v)))(attitude, move[:, 3:])
    nodes = State(attitude, point.omega + move[:, :3])
    values, ends = _readings(
        options, system, sensors, nodes, trial.layout, trial.samples
    )
    # Prior knowledge of the numbers of all trials must count once.
    held = numbers[unknowns.slices["scale"].start :]
    shared = trial.first * jnp.concatenate([unknowns.prior_rows(numbers), held])
    known = jnp.concatenate([unknowns.own_prior_rows(own), shared])[:, None]
    width = trial.samples.weight.shape[-1]
    rows = [
        whitened(sensors, trial.samples, values),
        jnp.pad(known, ((0, 0), (0, width - 1))),
    ]
    gap = _gaps(options, point, ends, trial.layout.linked)
    return jnp.concatenate(rows), gap


def _linearised(
    problem: Problem, point: Point, leaves: tuple[AnyArray, ...], trial: _Trial
) -> tuple[Rows, Links]:
    """Rows and links of one trial, with derivatives in the border and the states."""
    # Derivatives by directions, which share one evaluation of the residuals.
    local = problem.options.local
    still = jnp.zeros((point.omega.shape[0], local), point.omega.dtype)

    def residuals(numbers: Array, own: Array, move: Array) -> tuple[Array, Array]:
        return _residuals(problem, numbers, own, move, point, leaves, trial)

    border = [point.own.size, point.own.size + point.numbers.size]

    def derivative(direction: Array) -> tuple[tuple[Array, Array], ...]:
        """Rows and gaps, and their derivatives along a direction."""
        own, numbers, state = jnp.split(direction, border)
        # A row depends on one node only, so that all nodes can move at once.
        change = numbers, own, jnp.broadcast_to(state, still.shape)
        return jax.jvp(residuals, (point.numbers, point.own, still), change)

    directions = jnp.eye(border[1] + local, dtype=still.dtype)
    (rows, gap), (d_rows, d_gap) = jax.vmap(derivative, out_axes=(None, -1))(directions)
    node = trial.layout.node
    node = jnp.pad(node, (0, rows.shape[0] - node.size))
    rows_of_border, rows_of_state = jnp.split(d_rows, border[1:], axis=-1)
    gap_of_border, gap_of_state = jnp.split(d_gap, border[1:], axis=-1)
    no_torque = jnp.zeros(0, gap.dtype)
    links = Links(gap, gap_of_border, gap_of_state, no_torque)
    return Rows(rows, rows_of_border, rows_of_state, node), links


def over_trials(
    function: Callable[..., Any], problem: Problem, layout: Layout
) -> Callable[..., Any]:
    """A function of a trial's point, leaves, data and changes, over all trials."""
    stacked = tuple(0 if own else None for own in problem.unknowns.stacked)
    first = jnp.zeros(layout.start.shape[0], layout.ts.dtype).at[0].set(1)
    trials = _Trial(layout, problem.samples, first)
    # All trials share the numbers.
    axes_of_point: Any = Point(None, 0, 0, 0, 0)

    def over(point: Point, *changes: Array) -> Any:
        axes = axes_of_point, stacked, 0, *(0 for _ in changes)
        return jax.vmap(function, in_axes=axes)(
            point, problem.unknowns.leaves, trials, *changes
        )

    return over


def rows_at(problem: Problem, layout: Layout) -> Callable[[Point, Array], Array]:
    """Rows (trials, n, D) as a function of a point and changes of its states."""

    def trial(
        point: Point, leaves: tuple[AnyArray, ...], trial: _Trial, move: Array
    ) -> Array:
        numbers, own = point.numbers, point.own
        return _residuals(problem, numbers, own, move, point, leaves, trial)[0]

    return over_trials(trial, problem, layout)


def evaluation(
    problem: Problem, layout: Layout
) -> Callable[[Point], tuple[Rows, Links]]:
    """Rows and links at a point, with derivatives in the border and the states."""
    # `inlined` halves the time that tracing under nested vmaps takes. It drops rules
    # for derivatives, of which none are taken from here on.
    one = partial(inlined, partial(_linearised, problem))
    return over_trials(one, problem, layout)
