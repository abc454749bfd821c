"""Residuals of a record, whitened, with their derivatives in everything that is sought."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from jrigid._numerics import product
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
    on_attitude: bool
    shooting: bool  # from a state of each segment, or from one of each throw
    nodes: int
    dense: bool  # a node at each sample
    robust: bool
    noise_known: bool
    level: str  # of the unmodelled torque: "none", "known" or "sought"
    motion: Any
    doublings: int
    max_steps: int
    progress: bool


class Args(NamedTuple):
    """A record as it is fitted."""

    unknowns: Unknowns
    samples: tuple[Samples, ...]
    bodies: Array  # of each throw
    noise: Array  # of rates [rad/s] and turns [rad], (6,), for the links


def in_any_order(motion: Callable[[Array], State], ts: Array) -> State:
    """States of a motion that wants its times in order."""
    order = jnp.argsort(ts)
    states = motion(ts[order])
    back = jnp.argsort(order)
    return State(states.attitude[back], states.omega[back])


def _flow(options: Options, system: Any, before: State, start: Array, end: Array) -> State:
    """States a short time later, or earlier, each of its own start."""
    if not options.free_motion:
        one = lambda q, w, a, b: forced_flow(  # noqa: E731
            system, State(q, w), a, b, options.on_attitude
        )
        return jax.vmap(one)(before.attitude, before.omega, start, end)
    turn, omega = jax.vmap(lambda w, t: free_flow(system.inertia, w, t))(before.omega, end - start)
    if options.on_attitude:
        turn = jax.vmap(multiply)(before.attitude, turn)
    return State(turn, omega)


def _integrated(options: Options, system: Any, first: State, ts: Array, t0: Array) -> State:
    """A throw from its first state, by `simulate`, or by the motion that was given."""
    first = State(normalize(first.attitude), first.omega)

    def motion(times: Array) -> State:
        if options.motion is not None:
            return options.motion(system, first, times, t0)
        return simulate(
            system, first, times, t0=t0, rtol=RTOL[times.dtype.itemsize], throw=False,
            adjoint=diffrax.ForwardMode(), max_steps=100_000,
        ).states  # fmt: skip

    return in_any_order(motion, ts)


class _Throw(NamedTuple):
    """What is a throw's own: (nodes, ...), (samples, ...)."""

    layout: Layout
    samples: tuple[Samples, ...]
    leaves: tuple[Array, ...]
    body: Array
    first: Array  # 1 for the first throw


def _picked(state: State, index: Any) -> State:
    return jtu.tree_map(lambda x: x[index], state)


def _sample_states(
    options: Options, system: Any, sensors: Any, nodes: State, throw: _Throw
) -> tuple[list[Any], State]:
    """For each sensor, states (lags, n) that it looks at and their weights; states at link ends."""
    layout, dtype, first = throw.layout, throw.layout.ts.dtype, 0
    samples, lags, weights = [], [], []
    for sensor, x in zip(sensors, throw.samples, strict=True):
        late, weight = sensor.memory() or (jnp.zeros(1), jnp.ones(1))
        samples.append(jnp.tile(jnp.arange(first, first + x.ts.size), late.size))
        lags.append(jnp.repeat(late.astype(dtype), x.ts.size))
        weights.append(weight.astype(dtype))
        first += x.ts.size
    sample = jnp.concatenate(samples)
    times, node = layout.ts[sample] - jnp.concatenate(lags), layout.node[sample]
    if options.shooting or options.free_motion:
        begin = jnp.concatenate([layout.start[node], layout.start])
        end = jnp.concatenate([times, layout.end])
        before = jtu.tree_map(lambda x: jnp.concatenate([x[node], x]), nodes)
        states = _flow(options, system, before, begin, end)
        ends = _picked(states, slice(sample.size, None))
    else:
        whole = _integrated(options, system, _picked(nodes, 0), layout.ts, layout.start[0])
        states, ends = _picked(whole, sample), nodes
        if any(x.memory() is not None for x in sensors):
            states = _flow(options, system, states, layout.ts[sample], times)
    found, first = [], 0
    for x, weight in zip(samples, weights, strict=True):
        part = _picked(states, slice(first, first + x.size))
        lanes = [y.reshape(weight.size, -1, y.shape[-1]) for y in (part.attitude, part.omega)]
        found.append((State(*lanes), weight))
        first += x.size
    return found, ends


def _shown(sensor: Any, system: Any, t: Array, states: State, weight: Array) -> Array:
    """What a sensor shows at a time, of states (lags, ...) and their weights."""
    shown = jax.vmap(lambda q, w: sensor.predict(t, State(q, w), system))
    values = shown(states.attitude, states.omega)
    return product("l,lk->k", weight, values) if weight.size > 1 else values[0]


def predictions(options: Options, args: Args, layout: Layout, point: Point) -> list[Array]:
    """Values of each record (throws, n, k) as its sensor would show them; nothing of each throw."""
    system, *sensors = args.unknowns.parts(point.numbers, point.own[0], args.unknowns.leaves, 0)

    def throw(attitude: Array, omega: Array, data: _Throw) -> list[Array]:
        seen, _ = _sample_states(options, system, sensors, State(attitude, omega), data)
        of_sample: Any = jax.vmap(_shown, in_axes=(None, None, 0, 1, None))
        triples = zip(sensors, data.samples, seen, strict=True)
        return [of_sample(sensor, system, x.ts, *y) for sensor, x, y in triples]

    data = _Throw(layout, args.samples, (), args.bodies, jnp.zeros(args.bodies.shape))
    return jax.vmap(throw)(point.attitude, point.omega, data)


def residual_of(sensor: Any, system: Any, x: Samples, states: State, weight: Array) -> Array:
    """Of one sensor in one throw, (n, d), in units of its noise; zero where nothing was seen."""

    def one(t: Array, value: Array, white: Array, sign: Array, q: Array, w: Array) -> Array:
        predicted = _shown(sensor, system, t, State(q, w), weight)
        if predicted.shape != value.shape:
            raise ValueError(
                f"Argument `function` of `{type(sensor).__name__}` must return shape "
                f"{value.shape}, but it returns {predicted.shape}."
            )
        row = white @ sensor.difference(value, predicted)
        if sensor.largest() is None:
            return row
        # A saturated number says "at least": the square is -2 log of its probability.
        beyond = jnp.where(sign != 0, jnp.clip(sign * row, -1e3, _SURE), 0.0)
        likely = jax.scipy.special.log_ndtr(beyond)
        return jnp.where(sign != 0, -sign * jnp.sqrt(-2 * likely), row)

    of_sample = jax.vmap(one, in_axes=(0, 0, 0, 0, 1, 1))
    rows = of_sample(x.ts, x.values, x.whitener, x.sign, states.attitude, states.omega)
    return rows * x.weight


def evaluation(
    options: Options, args: Args, layout: Layout
) -> Callable[[Point], tuple[Rows, Links]]:
    """Residuals and links, with their derivatives in the border and the states of the nodes.

    Rows stand in the order of the records, then what is known beforehand: of the throw, and, beside
    the first throw, of all; last the numbers themselves, which hold a fit near its start while
    little of the record takes part.
    """
    unknowns = args.unknowns
    held = unknowns.slices["scale"].stop

    def residuals(
        numbers: Array, own: Array, move: Array, point: Point, leaves: Any, throw: _Throw
    ) -> tuple[Array, Array]:
        """Of one throw."""
        system, *sensors = unknowns.parts(numbers, own, leaves, throw.body)
        attitude = point.attitude
        if options.on_attitude:
            attitude = jax.vmap(lambda q, v: multiply(q, exp(v)))(attitude, move[:, 3:])
        nodes = State(attitude, point.omega + move[:, :3])
        states, ends = _sample_states(options, system, sensors, nodes, throw)
        rows = [
            residual_of(sensor, system, x, *seen).reshape(-1)
            for sensor, x, seen in zip(sensors, throw.samples, states, strict=True)
        ]
        shared = jnp.concatenate([unknowns.prior_rows(numbers), numbers[held:]])
        rows += [unknowns.own_prior_rows(own), throw.first * shared]
        gap = ends.omega - jnp.roll(point.omega, -1, axis=0)
        if options.on_attitude:
            following = jnp.roll(point.attitude, -1, axis=0)
            turn = jax.vmap(lambda a, b: multiply(conjugate(a), b))(following, ends.attitude)
            side = jnp.where(turn[:, :1] < 0, -1.0, 1.0)
            gap = jnp.concatenate([gap, 2 * side * turn[:, 1:]], axis=-1)
        return jnp.concatenate(rows), jnp.where(throw.layout.linked[:, None], gap, 0.0)

    def evaluate(point: Point) -> tuple[Rows, Links]:
        dtype, size = point.omega.dtype, point.numbers.size
        throws, own = point.own.shape
        locals_ = 6 if options.on_attitude else 3
        directions = jnp.eye(own + size + locals_, dtype=dtype)
        first = jnp.zeros(throws, dtype).at[0].set(1)
        data = _Throw(layout, args.samples, (), args.bodies, first)
        axes = tuple(0 if own else None for own in unknowns.stacked)
        of_throws: Any = Point(None, 0, 0, 0)  # type: ignore[arg-type]

        def throw(point: Point, leaves: Any, data: _Throw) -> tuple[Any, Any]:
            still = jnp.zeros((point.omega.shape[0], locals_), dtype)

            def along(direction: Array) -> Any:
                of_own, of_numbers, of_state = jnp.split(direction, [own, own + size])
                changes = of_numbers, of_own, jnp.broadcast_to(of_state, still.shape)
                moving = lambda n, o, m: residuals(n, o, m, point, leaves, data)  # noqa: E731
                return jax.jvp(moving, (point.numbers, point.own, still), changes)

            return jax.vmap(along, out_axes=(None, -1))(directions)

        (rows, gap), (d_rows, d_gap) = jax.vmap(throw, in_axes=(of_throws, axes, 0))(
            point, unknowns.leaves, data
        )
        border = own + size
        node = [
            jnp.repeat(part, x.weight.shape[-1], axis=1)
            for part, x in zip(_split(layout.node, args.samples), args.samples, strict=True)
        ]
        node = jnp.concatenate(node, axis=1)
        node = jnp.pad(node, ((0, 0), (0, rows.shape[1] - node.shape[1])))
        return (
            Rows(rows, d_rows[..., :border], d_rows[..., border:], node),
            Links(gap, d_gap[..., :border], d_gap[..., border:]),
        )

    return evaluate


def _split(side_by_side: Array, samples: tuple[Samples, ...]) -> list[Array]:
    """Of each record, (throws, n), of what stands side by side."""
    ends = np.cumsum([x.ts.shape[-1] for x in samples])
    return jnp.split(side_by_side, ends[:-1], axis=1)
