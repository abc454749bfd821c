"""Residuals of a record, whitened, with their derivatives in everything that is sought."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid.dynamics import State
from jrigid.identify._flow import forced_flow, free_flow
from jrigid.identify._layout import Layout
from jrigid.identify._observations import AbstractObservation, whitened
from jrigid.identify._shooting import Links, Point, Rows, Stage
from jrigid.identify._unknowns import Unknowns
from jrigid.rotation import conjugate, exp, multiply, normalize
from jrigid.simulate import simulate

RTOL = {8: 1e-9, 4: 1e-5}  # of the integration of a whole record


class Options(NamedTuple):
    """What is fixed when a fit is compiled."""

    free_motion: bool
    on_attitude: bool
    shooting: bool
    nodes: int
    loss: str
    max_steps: int
    noise_known: bool
    motion: Any
    doublings: int
    progress: bool


class Args(NamedTuple):
    unknowns: Unknowns
    observations: tuple[AbstractObservation, ...]
    weights: tuple[Array, ...]  # of each number of each residual, 0 or 1
    local: Array  # noise of the local numbers, for the links
    unit: Array  # of residuals whose noise is not known


def in_any_order(motion: Callable[[Array], State], ts: Array) -> State:
    """States of a motion that wants its times in order."""
    order = jnp.argsort(ts)
    states = motion(ts[order])
    back = jnp.argsort(order)
    return State(states.attitude[back], states.omega[back])


def by_kind(
    observations: tuple[AbstractObservation, ...], states: State
) -> list[tuple[AbstractObservation, State]]:
    """Each kind of observation with its states, which stand side by side."""
    found, at = [], 0
    for x in observations:
        end = at + x.ts.shape[1]
        found.append((x, State(states.attitude[:, at:end], states.omega[:, at:end])))
        at = end
    return found


def _sample_states(
    options: Options, args: Args, layout: Layout, point: Point
) -> tuple[State, State]:
    """States at the samples and at the links' ends."""
    system, _ = args.unknowns.system_and_gyro(point.numbers)
    throws, nodes = layout.start.shape
    count = layout.ts.shape[1]

    def pick(x: Array) -> Array:
        return jax.vmap(lambda values, node: values[node])(x, layout.node)

    if options.free_motion:
        inertia = args.unknowns.inertia(point.numbers)
        span = jnp.concatenate([layout.ts - pick(layout.start), layout.end - layout.start], axis=1)
        omega = jnp.concatenate([pick(point.omega), point.omega], axis=1)
        turn, omega = jax.vmap(lambda w, t: free_flow(inertia, w, t))(
            omega.reshape(-1, 3), span.reshape(-1)
        )
        turn, omega = turn.reshape(throws, -1, 4), omega.reshape(throws, -1, 3)
        if options.on_attitude:
            before = jnp.concatenate([pick(point.attitude), point.attitude], axis=1)
            turn = jax.vmap(jax.vmap(multiply))(before, turn)
        states = State(turn, omega)
    elif nodes == 1:
        states = _integrated(options, system, layout, point)
        return states, State(point.attitude, point.omega)
    else:
        begin = jnp.concatenate([pick(layout.start), layout.start], axis=1)
        end = jnp.concatenate([layout.ts, layout.end], axis=1)
        omega = jnp.concatenate([pick(point.omega), point.omega], axis=1)
        attitude = jnp.concatenate([pick(point.attitude), point.attitude], axis=1)
        states = jax.vmap(
            jax.vmap(lambda q, w, a, b: forced_flow(system, State(q, w), a, b, options.on_attitude))
        )(attitude, omega, begin, end)
    return (
        jtu.tree_map(lambda x: x[:, :count], states),
        jtu.tree_map(lambda x: x[:, count:], states),
    )


def _integrated(options: Options, system: Any, layout: Layout, point: Point) -> State:
    """Every throw from its first state, by `simulate`, or by the motion that was given."""

    def throw(q: Array, w: Array, ts: Array, t0: Array) -> State:
        state = State(normalize(q), w)

        def motion(times: Array) -> State:
            if options.motion is not None:
                return options.motion(system, state, times, t0)
            return simulate(
                system, state, times, t0=t0, rtol=RTOL[times.dtype.itemsize], throw=False,
                adjoint=diffrax.ForwardMode(), max_steps=100_000,
            ).states  # fmt: skip

        return in_any_order(motion, ts)

    return jax.vmap(throw)(point.attitude[:, 0], point.omega[:, 0], layout.ts, layout.start[:, 0])


def whole_motion(options: Options, args: Args, layout: Layout, point: Point) -> State:
    """States at the samples."""
    return _sample_states(options, args, layout, point)[0]


def evaluation(options: Options) -> Callable[[Point, Args, Layout, Stage], tuple[Rows, Links]]:
    """Residuals and links, with their derivatives in the numbers and the states of the nodes."""

    def evaluate(point: Point, args: Args, layout: Layout, stage: Stage) -> tuple[Rows, Links]:
        throws, nodes = layout.start.shape
        dtype = point.omega.dtype
        locals_ = 6 if options.on_attitude else 3
        size = point.numbers.size

        def residuals(numbers: Array, move: Array) -> tuple[tuple[Array, ...], Array, Array]:
            attitude = point.attitude
            if options.on_attitude:
                attitude = jax.vmap(jax.vmap(lambda q, v: multiply(q, exp(v))))(
                    attitude, move[..., 3:]
                )
            moved = Point(numbers, attitude, point.omega + move[..., :3])
            states, ends = _sample_states(options, args, layout, moved)
            system, gyro = args.unknowns.system_and_gyro(numbers)
            blocks = []
            kinds = by_kind(args.observations, states)
            for (x, part), weight in zip(kinds, args.weights, strict=True):
                rows = whitened(x, part, gyro, system)
                unit = args.unit if x.sigma is None and x.covariance is None else 1.0
                blocks.append(rows * weight / unit)
            now = State(point.attitude, point.omega)
            following = jtu.tree_map(lambda s: jnp.roll(s, -1, axis=1), now)
            gap = ends.omega - following.omega
            if options.on_attitude:
                turn = jax.vmap(jax.vmap(lambda a, b: multiply(conjugate(a), b)))(
                    following.attitude, ends.attitude
                )
                side = jnp.where(turn[..., :1] < 0, -1.0, 1.0)
                gap = jnp.concatenate([gap, 2 * side * turn[..., 1:]], axis=-1)
            noise = args.local[None, None, :locals_]
            gap = jnp.where(layout.linked[..., None], gap / noise, 0.0)
            # While little of the record takes part, nuisances must not imitate the motion.
            held = numbers[args.unknowns.slices["leaves"].start :]
            held = jnp.where(stage.horizon < 1, held, 0.0)
            prior = jnp.concatenate([args.unknowns.prior_rows(numbers), held])
            return tuple(blocks), gap, prior

        still = jnp.zeros((throws, nodes, locals_), dtype)
        directions = jnp.eye(size + locals_, dtype=dtype)

        def along(direction: Array) -> Any:
            changes = direction[:size], jnp.broadcast_to(direction[size:], still.shape)
            return jax.jvp(residuals, (point.numbers, still), changes)

        (blocks, gap, prior), (d_blocks, d_gap, d_prior) = jax.vmap(along, out_axes=(None, -1))(
            directions
        )
        flat, slopes, nodes_of, cost, at = [], [], [], jnp.zeros((), dtype), 0
        for x, slope in zip(blocks, d_blocks, strict=True):
            count, width = x.shape[1:]
            within = layout.since[:, at : at + count] <= stage.horizon
            within = within.astype(dtype)
            at += count
            square = jnp.sum(x * x, axis=-1)
            soft = 4.0 * width
            weight = jnp.where(stage.robust, 1 / (1 + square / soft), 1.0) * within
            loss = jnp.where(stage.robust, soft * jnp.log1p(square / soft), square)
            cost = cost + jnp.sum(loss * within)
            root = jnp.sqrt(weight)[..., None]
            flat.append((root * x).reshape(throws, -1))
            slopes.append((root[..., None] * slope).reshape(throws, -1, size + locals_))
            node = layout.node[:, at - count : at]
            nodes_of.append(jnp.repeat(node, width, axis=1))
        # What is known beforehand stands with the first throw, whose state it does not touch.
        padded = jnp.zeros((throws, prior.size), dtype).at[0].set(prior)
        flat.append(padded)
        slopes.append(jnp.zeros((throws, prior.size, size + locals_), dtype).at[0].set(d_prior))
        nodes_of.append(jnp.zeros((throws, prior.size), int))
        cost = cost + jnp.sum(prior * prior)
        jacobian = jnp.concatenate(slopes, axis=1)
        rows = Rows(
            jnp.concatenate(flat, axis=1),
            jacobian[..., :size],
            jacobian[..., size:],
            jnp.concatenate(nodes_of, axis=1),
            cost,
        )
        of_next = -jnp.eye(locals_, dtype=dtype) / args.local[:locals_, None]
        of_next = jnp.where(layout.linked[..., None, None], of_next[None, None], 0.0)
        return rows, Links(gap, d_gap[..., :size], d_gap[..., size:], of_next)

    return eqx.filter_jit(evaluate)  # traced once
