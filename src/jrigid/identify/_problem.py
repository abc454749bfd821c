"""The least-squares problem of a record: residuals, their derivatives, and what links may gap."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._core.inline import inlined
from jrigid._numerics import product
from jrigid._types import AnyArray
from jrigid.dynamics import State
from jrigid.identify._flow import forced_flow, free_flow
from jrigid.identify._layout import Layout
from jrigid.identify._records import Samples
from jrigid.identify._smoother import Links, Point, Rows
from jrigid.identify._unknowns import Unknowns
from jrigid.rotation import conjugate, exp, multiply, normalize
from jrigid.simulate import simulate

RTOL = {8: 1e-9, 4: 1e-5}  # of the integration of a whole record
_SURE = 6.0  # standard deviations beyond a limit, where nothing more is learnt


class Options(NamedTuple):
    """What is fixed when a fit is compiled."""

    free_motion: bool
    depends_on_attitude: bool
    shooting: bool = False  # from a state of each segment, or from one of each trial
    nodes: int = 1
    unmodelled: str = "none"  # a torque that no model has: or "known", "estimate"
    robust: bool = False
    noise_known: bool = True
    motion: Any = None

    @property
    def dense(self) -> bool:
        """Whether each sample has a node."""
        return self.unmodelled != "none"


class Problem(eqx.Module):
    """A record as it is fitted."""

    options: Options = eqx.field(static=True)
    unknowns: Unknowns
    samples: Samples
    noise: AnyArray  # of rates [rad/s] and turns [rad], (6,), for the links

    @property
    def known(self) -> int:
        """How many samples stand for what is known beforehand, and for a fit held near its start.

        Those of the trial come first, then, beside the first trial, those of all
        trials.
        """
        x = self.unknowns
        count = sum(y.base.size for y in x.sought if y.sigma is not None) + (
            x.hold is not None
        )
        return count + self.held

    @property
    def held(self) -> int:
        """How many numbers hold a fit near its start while little of the record takes part."""
        return self.unknowns.size - self.unknowns.slices["scale"].stop


def in_any_order(motion: Callable[[Array], State], ts: Array) -> State:
    """States of a motion that wants its times in order."""
    order = jnp.argsort(ts)
    states = motion(ts[order])
    back = jnp.argsort(order)
    return State(states.attitude[back], states.omega[back])


def _flow(
    options: Options, system: Any, before: State, start: Array, end: Array
) -> State:
    """States a short time later, or earlier, each of its own start."""
    if not options.free_motion:

        def flow(state: State, start: Array, end: Array) -> State:
            return forced_flow(system, state, start, end, options.depends_on_attitude)

        return jax.vmap(flow)(before, start, end)
    turn, omega = jax.vmap(lambda w, t: free_flow(system.inertia, w, t))(
        before.omega, end - start
    )
    if options.depends_on_attitude:
        turn = jax.vmap(multiply)(before.attitude, turn)
    return State(turn, omega)


def _integrated(
    options: Options, system: Any, first: State, ts: Array, t0: Array
) -> State:
    """A trial from its first state, by `simulate`, or by the motion that was given."""
    first = State(normalize(first.attitude), first.omega)

    def motion(times: Array) -> State:
        if options.motion is not None:
            return options.motion(system, first, times, t0)
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

    return in_any_order(motion, ts)


class _Trial(NamedTuple):
    """What is a trial's own: (nodes, ...), (samples, ...)."""

    layout: Layout
    samples: Samples
    first: Array  # 1 for the first trial


def _picked(state: State, index: Any) -> State:
    return State(state.attitude[index], state.omega[index])


def _seen(
    options: Options, system: Any, sensors: Any, nodes: State, trial: _Trial
) -> tuple[list[Array], State]:
    """What each sensor shows at its times (n, k); states at the ends of the links."""
    layout, dtype = trial.layout, trial.layout.ts.dtype
    samples, lags, weights = [], [], []
    for sensor, part in zip(sensors, trial.samples.parts, strict=True):
        late, weight = sensor.memory() or (jnp.zeros(1), jnp.ones(1))
        samples.append(jnp.tile(jnp.arange(part.start, part.stop), late.size))
        lags.append(jnp.repeat(late.astype(dtype), part.stop - part.start))
        weights.append(weight.astype(dtype))
    sample = jnp.concatenate(samples)
    times, node = layout.ts[sample] - jnp.concatenate(lags), layout.node[sample]
    if options.shooting or options.free_motion:
        begin = jnp.concatenate([layout.start[node], layout.start])
        end = jnp.concatenate([times, layout.end])
        before = jtu.tree_map(lambda x: jnp.concatenate([x[node], x]), nodes)
        states = _flow(options, system, before, begin, end)
        ends = _picked(states, slice(sample.size, None))
    else:
        whole = _integrated(
            options, system, _picked(nodes, 0), layout.ts, layout.start[0]
        )
        states, ends = _picked(whole, sample), nodes
        if any(x.memory() is not None for x in sensors):
            states = _flow(options, system, states, layout.ts[sample], times)
    shown, first = [], 0
    for sensor, index, weight in zip(sensors, samples, weights, strict=True):
        part = slice(first, first + index.size)
        first = part.stop
        one = lambda t, q, w, sensor=sensor: sensor.predict(t, State(q, w), system)  # noqa: E731
        values = jax.vmap(one)(
            layout.ts[index], states.attitude[part], states.omega[part]
        )
        values = values.reshape(weight.size, -1, *values.shape[1:])
        shown.append(
            product("l,lnk->nk", weight, values) if weight.size > 1 else values[0]
        )
    return shown, ends


def shown_by(
    options: Options,
    system: Any,
    sensors: Any,
    start: State,
    t0: Array,
    samples: Samples,
) -> list[Array]:
    """What sensors show at their times (n, k) of the motion from a state at t0."""
    first, ts = t0[None], samples.ts
    layout = Layout(ts, jnp.zeros(ts.shape, int), first, first, first > t0, ts)
    nodes = State(start.attitude[None], start.omega[None])
    trial = _Trial(layout, samples, t0)
    return _seen(options._replace(shooting=False), system, sensors, nodes, trial)[0]


def whitened(sensors: Any, samples: Samples, shown: list[Array]) -> Array:
    """Residuals of a trial (n, D) in units of their noise; zero where nothing was seen."""
    parts, width = [], samples.weight.shape[-1]
    for sensor, values, predicted in zip(sensors, samples.values, shown, strict=True):
        if predicted.shape != values.shape:
            raise ValueError(
                f"Argument `function` of `{type(sensor).__name__}` must return shape "
                f"{values.shape[1:]}, but it returns {predicted.shape[1:]}."
            )
        part = jax.vmap(sensor.difference)(values, predicted)
        parts.append(jnp.pad(part, ((0, 0), (0, width - part.shape[1]))))
    rows = product("nij,nj->ni", samples.whitener, jnp.concatenate(parts))
    if any(x.saturation() is not None for x in sensors):
        # A saturated number says "at least": the square is -2 log of its probability.
        beyond = jnp.where(
            samples.sign != 0, jnp.clip(samples.sign * rows, -1e3, _SURE), 0.0
        )
        likely = jnp.sqrt(-2 * jax.scipy.special.log_ndtr(beyond))
        rows = jnp.where(samples.sign != 0, -samples.sign * likely, rows)
    return rows * samples.weight


def predictions(problem: Problem, layout: Layout, point: Point) -> list[Array]:
    """Values of each record (trials, n, k) as its sensor would show them, one body for all."""
    unknowns = problem.unknowns
    system, *sensors = unknowns.parts(
        point.numbers, point.own[0], unknowns.leaves_of(0)
    )

    def trial(attitude: Array, omega: Array, data: _Trial) -> list[Array]:
        return _seen(problem.options, system, sensors, State(attitude, omega), data)[0]

    data = _Trial(layout, problem.samples, layout.start[:, 0])
    return jax.vmap(trial)(point.attitude, point.omega, data)


def _of_trial(
    problem: Problem,
    moves: tuple[Array, Array, Array],
    point: Point,
    leaves: Any,
    trial: _Trial,
) -> tuple[Array, Array]:
    """Rows and gaps of one trial, of numbers, own numbers and states moved from those of a point.

    Rows are those of the samples; then each number that is known beforehand has one;
    last come the numbers themselves, which hold a fit near its start.
    """
    options, unknowns, (numbers, own, move) = problem.options, problem.unknowns, moves
    system, *sensors = unknowns.parts(numbers, own, leaves)
    attitude = point.attitude
    if options.depends_on_attitude:
        attitude = jax.vmap(lambda q, v: multiply(q, exp(v)))(attitude, move[:, 3:])
    nodes = State(attitude, point.omega + move[:, :3])
    shown, ends = _seen(options, system, sensors, nodes, trial)
    held = numbers[unknowns.slices["scale"].stop :]
    shared = trial.first * jnp.concatenate([unknowns.prior_rows(numbers), held])
    known = jnp.concatenate([unknowns.own_prior_rows(own), shared])[:, None]
    width = trial.samples.weight.shape[-1]
    rows = [
        whitened(sensors, trial.samples, shown),
        jnp.pad(known, ((0, 0), (0, width - 1))),
    ]
    gap = ends.omega - jnp.roll(point.omega, -1, axis=0)
    if options.depends_on_attitude:
        following = jnp.roll(point.attitude, -1, axis=0)
        turn = jax.vmap(lambda a, b: multiply(conjugate(a), b))(
            following, ends.attitude
        )
        side = jnp.where(turn[:, :1] < 0, -1.0, 1.0)
        gap = jnp.concatenate([gap, 2 * side * turn[:, 1:]], axis=-1)
    return jnp.concatenate(rows), jnp.where(trial.layout.linked[:, None], gap, 0.0)


def _over_trials(function: Callable[..., Any], problem: Problem, layout: Layout) -> Any:
    """A function of a trial's point, arrays and data, and of moves, over all trials."""
    stacked = tuple(0 if own else None for own in problem.unknowns.stacked)
    first = jnp.zeros(layout.start.shape[0], layout.ts.dtype).at[0].set(1)
    data = _Trial(layout, problem.samples, first)
    of_trials: Any = Point(None, 0, 0, 0, 0)  # type: ignore[arg-type]

    def over(point: Point, *moves: Array) -> Any:
        axes = of_trials, stacked, 0, *(0 for _ in moves)
        one = partial(inlined, function)
        return jax.vmap(one, in_axes=axes)(point, problem.unknowns.leaves, data, *moves)

    return over


def rows_at(problem: Problem, layout: Layout) -> Callable[[Point, Array], Array]:
    """Rows (trials, n, D) at a point, its states (trials, nodes, local) moved."""

    def trial(point: Point, leaves: Any, data: _Trial, move: Array) -> Array:
        return _of_trial(
            problem, (point.numbers, point.own, move), point, leaves, data
        )[0]

    return _over_trials(trial, problem, layout)


def evaluation(
    problem: Problem, layout: Layout
) -> Callable[[Point], tuple[Rows, Links]]:
    """Rows and links, with their derivatives in the border and the states of the nodes."""
    local = 6 if problem.options.depends_on_attitude else 3

    def trial(point: Point, leaves: Any, data: _Trial) -> tuple[Rows, Links]:
        border = [point.own.size, point.own.size + point.numbers.size]
        still = jnp.zeros((point.omega.shape[0], local), point.omega.dtype)
        start = point.numbers, point.own, still

        def along(direction: Array) -> Any:
            own, numbers, state = jnp.split(direction, border)
            change = numbers, own, jnp.broadcast_to(state, still.shape)
            moved = lambda x: _of_trial(problem, x, point, leaves, data)  # noqa: E731
            return jax.jvp(moved, (start,), (change,))

        directions = jnp.eye(border[1] + local, dtype=still.dtype)
        (rows, gap), (d_rows, d_gap) = jax.vmap(along, out_axes=(None, -1))(directions)
        node = jnp.pad(data.layout.node, (0, rows.shape[0] - data.layout.node.size))
        of_border, of_state = jnp.split(d_rows, border[1:], axis=-1)
        gap_of_border, gap_of_state = jnp.split(d_gap, border[1:], -1)
        links = Links(gap, gap_of_border, gap_of_state, jnp.zeros(0, gap.dtype))
        return Rows(rows, of_border, of_state, node), links

    return _over_trials(trial, problem, layout)
