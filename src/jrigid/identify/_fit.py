"""fit(): inertia, and what else is asked for, from what was observed."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._checks import RESULTS, Findings, all_finite, check_option, is_inertia, is_unit, nan_where
from jrigid._numerics import product, safe_norm
from jrigid._simulate import simulate
from jrigid._spectral import eigh
from jrigid.dynamics import State
from jrigid.identify._flow import depends_on_attitude, forced_flow, free_flow
from jrigid.identify._layout import (
    Layout,
    Samples,
    angle_turned,
    node_states,
    samples_of,
    segments,
    segments_needed,
    times_of,
    whole,
)
from jrigid.identify._observations import (
    AbstractObservation,
    AngularMomenta,
    Attitudes,
    Directions,
    Rates,
    known,
    of_throws,
    whitened,
)
from jrigid.identify._result import LARGEST_ERROR, FitResult, Status
from jrigid.identify._shooting import ACCURACY, Links, Point, Rows, Stage, levenberg_marquardt
from jrigid.identify._starts import linear_start
from jrigid.identify._unknowns import Unknowns, as_tensor, is_near_flat, unknowns_of
from jrigid.rotation import conjugate, exp, multiply, normalize
from jrigid.systems import RigidBody
from jrigid.torques import Rotor, Sum
from jrigid.torques._base import has_parts

_LOSSES = ("squares", "robust")
# Weights of the links, in units of the noise; and a slower way for fits that went wrong.
_WEIGHTS = (1.0, 10.0, 100.0, 1e3, 1e4)
_SLOW_WEIGHTS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4)
_IN_A_STAGE = 15
_GATE = 5.0  # standard deviations of chi-square
_REJECTED = 16.0  # whitened square of a sample, above its degrees of freedom, that is no noise
_HISTORY = 512
_SPOILT = 0.25  # fraction of samples rejected that gives a throw up


class Options(NamedTuple):
    """What is fixed when a fit is compiled."""

    free_motion: bool
    on_attitude: bool
    shooting: bool
    nodes: int
    loss: str
    max_steps: int
    rtol: float
    noise_known: bool
    motion: Any
    doublings: int
    progress: bool
    throw: bool


def fit(
    system: RigidBody,
    observations: Any,
    *,
    free: Any = None,
    nuisances: Sequence[str] | Mapping[str, Any] = (),
    scale: str = "trace",
    shape: str = "tensor",
    start: tuple[Any, State | None] | State | None = None,
    loss: str = "squares",
    absolute_sigma: bool = True,
    motion: Callable[..., State] | None = None,
    doublings: int = 8,
    max_steps: int = 60,
    progress: bool = False,
    throw: bool = True,
) -> FitResult:
    """TODO."""
    check_option("loss", loss, _LOSSES)
    if not isinstance(system, RigidBody):
        raise ValueError(
            "Argument `system` must be a RigidBody (of a body in flight, rotation about its centre "
            f"of mass), but it is {type(system).__name__}."
        )
    stacked = of_throws(observations)
    start_tensor, start_state = _start(system, start)
    torque_free = isinstance(system.torque, Sum) and not system.torque.terms
    _refuse(system, stacked, scale, torque_free)
    throws = stacked[0].ts.shape[0]
    on_attitude = any(x.on_attitude for x in stacked) or depends_on_attitude(system)
    if on_attitude and start_state is None and not any(isinstance(x, Attitudes) for x in stacked):
        raise ValueError(
            "Argument `start` must hold a State whose attitude the fit can start from, since the "
            "motion or an observation depends on the attitude and none was observed, but it does "
            "not."
        )
    observed = any(isinstance(x, Rates | Attitudes) for x in stacked)
    internal = has_parts(system.torque.internal_at_rest(State(jnp.zeros(4), jnp.zeros(3))))
    shooting = observed and motion is None and not internal
    if not shooting and start_state is None:
        raise ValueError(
            "Argument `start` must hold a State to start from, since neither rates nor attitudes "
            "were observed, or they do not tell the whole state, but it does not."
        )
    if start_state is not None:
        start_state = State(
            jnp.broadcast_to(start_state.attitude, (throws, 4)),
            jnp.broadcast_to(start_state.omega, (throws, 3)),
        )
    stacked, samples, rate, angle, input_result = _prepare(
        system, stacked, start_tensor, start_state, on_attitude, throw
    )
    unknowns = unknowns_of(system, free, nuisances, shape, scale, rate)
    options = Options(
        torque_free and motion is None, on_attitude, shooting,
        segments_needed(angle, stacked[0].ts.shape[1]) if shooting else 1, loss, max_steps, 1e-9,
        absolute_sigma and all(x.sigma is not None or x.covariance is not None for x in stacked),
        motion, doublings, progress, throw,
    )  # fmt: skip
    return _fit(options, unknowns, stacked, samples, start_tensor, start_state, input_result)


@eqx.filter_jit
def _prepare(
    system: Any,
    stacked: tuple[AbstractObservation, ...],
    tensor: Any,
    state: State | None,
    on_attitude: bool,
    throw: bool,
) -> tuple[Any, Samples | None, Array, Array, Any]:
    """Checked observations, what tells the state on the way, and the angle it turns."""
    ts, there = times_of(stacked)
    attitude0 = None if state is None or not on_attitude else state.attitude.astype(ts.dtype)
    samples = samples_of(stacked, attitude0)
    rate = _typical_rate(samples, state, ts.dtype)
    findings = _findings(system, stacked, there, samples, tensor, state)
    stacked = findings.apply(stacked, throw)
    angle = jnp.zeros(()) if samples is None else jnp.max(angle_turned(samples)[:, -1])
    return stacked, samples, rate, angle, findings.result


def _start(system: Any, start: Any) -> tuple[Any, State | None]:
    """The tensor to start from, if one is given, and the state."""
    if start is None:
        return None, None
    if isinstance(start, State):
        return None, start
    if isinstance(start, tuple) and len(start) == 2:
        inertia, state = start
        if isinstance(inertia, RigidBody):
            inertia = inertia.inertia
        if state is None or isinstance(state, State):
            return None if inertia is None else as_tensor(jnp.asarray(inertia)), state
    raise ValueError(
        "Argument `start` must be a State, or a tuple of an inertia and a State (either may be "
        f"None), but it is {start!r}."
    )


def _refuse(system: Any, stacked: tuple[AbstractObservation, ...], scale: str, free: bool) -> None:
    momenta = any(isinstance(x, AngularMomenta) for x in stacked)
    if scale == "trace" or not isinstance(system, RigidBody):
        return
    if scale == "rotor":
        terms = system.torque.terms if isinstance(system.torque, Sum) else (system.torque,)
        if not any(isinstance(x, Rotor) for x in terms):
            raise ValueError(
                "Argument `scale` must not be 'rotor' for a system without a `torques.Rotor`, but "
                "it is: nothing sets the scale of the tensor."
            )
    elif free and not momenta:
        raise ValueError(
            "Argument `scale` must be 'trace' for a body without torque, but it is 'known': free "
            "motion tells ratios of the moments, never their scale."
        )


def _typical_rate(samples: Samples | None, state: State | None, dtype: Any) -> Array:
    if samples is None:
        size = safe_norm(state.omega.astype(dtype))  # pyright: ignore
    else:
        count = jnp.maximum(jnp.sum(samples.there), 1).astype(dtype)
        shown = jnp.where(samples.there[..., None], samples.omega, 0.0)
        size = safe_norm(shown.reshape(-1)) / jnp.sqrt(count)
    size = jax.lax.stop_gradient(size)
    return jnp.where(jnp.isfinite(size) & (size > 0), size, 1.0)


def _findings(
    system: Any,
    stacked: tuple[AbstractObservation, ...],
    there: Array,
    samples: Samples | None,
    tensor: Any,
    state: State | None,
) -> Findings:
    findings = Findings()
    findings.require(is_inertia(system.inertia), RESULTS.invalid_inertia)
    system.torque.check(findings)
    if tensor is not None:
        findings.require(is_inertia(tensor), RESULTS.invalid_inertia)
    if state is not None:
        findings.require(all_finite(state), RESULTS.invalid_state)
        findings.require(jnp.all(jax.vmap(is_unit)(state.attitude)), RESULTS.invalid_attitude)
    findings.require(
        jnp.any(there),
        RESULTS.invalid_state,
        "Argument `observations` must hold values, but all are NaN.",
    )
    numbers = sum(jnp.sum(known(x)) for x in stacked)
    findings.require(
        numbers >= 12,
        RESULTS.invalid_state,
        "Argument `observations` must hold more numbers than a body and its state have, but it "
        "holds too few.",
    )
    for x in stacked:
        seen = jnp.any(known(x), axis=-1)
        running = jax.lax.cummax(jnp.where(seen, x.ts, -jnp.inf), axis=1)
        before = jnp.concatenate([jnp.full_like(running[:, :1], -jnp.inf), running[:, :-1]], axis=1)
        findings.require(
            jnp.all(~seen | (x.ts > before)),
            RESULTS.invalid_times,
            f"Argument `ts` of `{type(x).__name__}` must be increasing, each time once, but it is "
            "not.",
        )
        findings.require(
            ~jnp.any(jnp.isnan(x.ts) & jnp.all(jnp.isfinite(x.values), axis=-1)),
            RESULTS.invalid_times,
            f"Argument `ts` of `{type(x).__name__}` must be finite where there are values, but it "
            "is not.",
        )
        noise = x.sigma if x.sigma is not None else x.covariance
        if x.sigma is not None:
            good = jnp.all(~known(x) | ((noise > 0) & jnp.isfinite(noise)))
        elif x.covariance is not None:
            swapped = jnp.swapaxes(noise, -1, -2)
            eye = jnp.eye(noise.shape[-1], dtype=noise.dtype)
            filled = jnp.where(seen[..., None, None], noise, eye)
            positive = jnp.all(jnp.isfinite(jnp.linalg.cholesky(filled)))
            good = positive & jnp.all(
                ~seen[..., None, None] | (jnp.abs(noise - swapped) <= 1e-6 * jnp.abs(noise))
            )
        else:
            good = jnp.asarray(True)
        findings.require(
            good,
            RESULTS.invalid_state,
            f"Arguments `sigma` and `covariance` of `{type(x).__name__}` must be positive, but one "
            "is not.",
        )
        if isinstance(x, Attitudes):
            norm = jnp.sum(jnp.where(seen[..., None], x.values, 0.5) ** 2, axis=-1)
            findings.require(
                jnp.all(jnp.abs(norm - 1) < 1e-3),
                RESULTS.invalid_attitude,
                "Argument `values` of `Attitudes` must be unit quaternions, but one is not.",
            )
        if isinstance(x, Directions):
            shown = jnp.where(seen[..., None], x.values, 1 / 3**0.5)
            findings.require(
                jnp.all(jnp.abs(jnp.sum(shown**2, axis=-1) - 1) < 0.5),
                RESULTS.invalid_state,
                "Argument `values` of `Directions` must be unit vectors, but one is not.",
            )
    if samples is not None and any(isinstance(x, Rates) for x in stacked):
        turned = _between(samples)
        findings.require(
            turned < 2 * jnp.pi,
            RESULTS.invalid_state,
            "Argument `values` of `Rates` must be in radians a second and sampled more than once a "
            "turn, but the body turns more between samples: are the rates in degrees a second?",
        )
    return findings


def _between(samples: Samples) -> Array:
    """Angle turned between neighbouring samples, as a median."""
    ok = samples.there[:, 1:] & samples.there[:, :-1]
    step = jnp.where(ok, jnp.diff(samples.ts, axis=1), jnp.nan)
    speed = jnp.sqrt(jnp.sum(samples.omega[:, 1:] ** 2, axis=-1))
    median = jnp.nanmedian(jnp.where(ok, step * speed, jnp.nan))
    return jnp.where(jnp.isnan(median), 0.0, median)


def _local_scales(
    stacked: tuple[AbstractObservation, ...], rate: Array
) -> tuple[Array, Array, Array]:
    """Noise of rates [rad/s] and of attitudes [rad], and a guess of a sample's if it is unknown."""

    def median(x: AbstractObservation) -> Array:
        if x.sigma is not None:
            noise = x.sigma
        elif x.covariance is not None:
            noise = jnp.sqrt(jnp.diagonal(x.covariance, axis1=-2, axis2=-1))
        else:
            return jnp.full((), 0.02, rate.dtype) * (rate if isinstance(x, Rates) else 1.0)
        return jnp.nanmedian(jnp.where(known(x), noise, jnp.nan))

    of_rates = [median(x) for x in stacked if isinstance(x, Rates)]
    of_angles = [median(x) for x in stacked if isinstance(x, Attitudes | Directions)]
    guess = 0.02 * rate
    rates = of_rates[0] if of_rates else (of_angles[0] * rate if of_angles else guess)
    angles = of_angles[0] if of_angles else rates / rate
    return rates, angles, guess


class _Phase(NamedTuple):
    """One pass: segments, stages, whether only for fits that went wrong, and after a rejection."""

    layout: Layout
    stages: Stage
    again: Array
    reject: Array


class _Args(NamedTuple):
    unknowns: Unknowns
    observations: tuple[AbstractObservation, ...]
    weights: tuple[Array, ...]  # of each number of each residual, 0 or 1
    local: Array  # noise of the local numbers, for the links
    unit: Array  # of residuals whose noise is not known


def _sample_states(
    options: Options, args: _Args, layout: Layout, point: Point
) -> tuple[State, State]:
    """States at the samples and at the links' ends."""
    system, _ = args.unknowns.system_and_gyro(point.numbers)
    throws, nodes = layout.start.shape
    count = layout.ts.shape[1]

    def pick(x: Array) -> Array:
        return jax.vmap(lambda values, node: values[node])(x, layout.node)

    if not options.shooting or not options.free_motion:
        single = nodes == 1
    else:
        single = False
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
    elif single:
        states = _whole_motion(options, system, layout, point)
        ends = State(point.attitude, point.omega)
        return states, ends
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


def _whole_motion(options: Options, system: Any, layout: Layout, point: Point) -> State:
    """Every throw from its first state, by `simulate`, or by the motion that was given."""

    def throw(q: Array, w: Array, ts: Array, t0: Array) -> State:
        order = jnp.argsort(ts)
        state = State(normalize(q), w)
        times = jnp.maximum(ts[order], t0)
        if options.motion is not None:
            states = options.motion(system, state, times, t0)
        else:
            states = simulate(
                system, state, times, t0=t0, rtol=options.rtol, throw=False,
                adjoint=diffrax.ForwardMode(), max_steps=100_000,
            ).states  # fmt: skip
        back = jnp.argsort(order)
        return State(states.attitude[back], states.omega[back])

    return jax.vmap(throw)(
        point.attitude[:, 0], point.omega[:, 0], layout.ts, layout.start[:, 0]
    )


def _evaluate(options: Options) -> Callable[[Point, _Args, Layout, Stage], tuple[Rows, Links]]:
    """Residuals and links, with their derivatives in the numbers and the states of the nodes."""

    def evaluate(point: Point, args: _Args, layout: Layout, stage: Stage) -> tuple[Rows, Links]:
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
            blocks, at = [], 0
            for x, weight in zip(args.observations, args.weights, strict=True):
                count = x.ts.shape[1]
                part = jtu.tree_map(lambda s, a=at, n=count: s[:, a : a + n], states)
                rows = whitened(x, part, gyro, system)
                unit = args.unit if x.sigma is None and x.covariance is None else 1.0
                blocks.append(rows * weight / unit)
                at += count
            now = State(point.attitude, point.omega)
            following = jtu.tree_map(lambda s: jnp.roll(s, -1, axis=1), now)
            gap = ends.omega - following.omega
            if options.on_attitude:
                turn = jax.vmap(jax.vmap(lambda a, b: multiply(conjugate(a), b)))(
                    following.attitude, ends.attitude
                )
                side = jnp.where(turn[..., :1] < 0, -1.0, 1.0)
                gap = jnp.concatenate([gap, 2 * side * turn[..., 1:]], axis=-1)
            gap = jnp.where(layout.linked[..., None], gap / args.local[:locals_], 0.0)
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
        of_next = jnp.where(layout.linked[..., None, None], of_next, 0.0)
        return rows, Links(gap, d_gap[..., :size], d_gap[..., size:], of_next)

    return jax.jit(evaluate)  # traced once


def _horizons(doublings: int) -> list[float]:
    return [2.0**-k for k in range(doublings, 0, -1)] + [2.0]


def _schedule(stages: list[tuple[float, float, int]], robust: bool, length: int, dtype: Any) -> Any:
    """Stages (weight of the links, horizon, steps), filled up to a length with none."""
    filled = stages + [(0.0, 2.0, 0)] * (length - len(stages))
    weight, horizon, steps = (jnp.asarray(x) for x in zip(*filled, strict=True))
    return Stage(
        weight.astype(dtype), horizon.astype(dtype), jnp.full(length, robust), steps.astype(int)
    )


@eqx.filter_jit
def _fit(
    options: Options,
    unknowns: Unknowns,
    stacked: tuple[AbstractObservation, ...],
    samples: Samples | None,
    start_tensor: Any,
    start_state: State | None,
    input_result: Any,
) -> FitResult:
    ts, there = times_of(stacked)
    dtype = ts.dtype
    throws, nodes = ts.shape[0], options.nodes
    tensor = start_tensor
    if tensor is None:
        tensor = as_tensor(unknowns.original.inertia.astype(dtype))
        if samples is not None and unknowns.shape != "fixed" and options.motion is None:
            trace = None if unknowns.scaled else jnp.trace(tensor)
            tensor = _linear_start(options, unknowns, samples, trace)
    unknowns, numbers = unknowns.start(tensor.astype(dtype), unknowns.chart)

    single = whole(ts, there, nodes)
    if options.shooting and samples is not None:
        cut, opening = segments(ts, there, samples, nodes)
        omega, attitude = node_states(samples, opening, cut.start)
    else:
        cut, attitude = single, None
        assert start_state is not None
        omega = jnp.broadcast_to(start_state.omega.astype(dtype)[..., None, :], (throws, nodes, 3))
        attitude = jnp.broadcast_to(
            start_state.attitude.astype(dtype)[..., None, :], (throws, nodes, 4)
        )
    if attitude is None:
        attitude = jnp.zeros((throws, nodes, 4), dtype).at[..., 0].set(1)
    point = Point(numbers, attitude, omega)

    of_rates, of_angles, guess = _local_scales(stacked, unknowns.rate)
    local = jnp.concatenate([jnp.full(3, of_rates), jnp.full(3, of_angles)])
    weights = tuple(known(x).astype(dtype) for x in stacked)
    args = _Args(unknowns, stacked, weights, local, guess)
    evaluate = _evaluate(options)

    robust = options.loss == "robust"
    links = [(w, 2.0, _IN_A_STAGE) for w in _WEIGHTS]
    if options.shooting:
        free = [(0.0, 2.0, options.max_steps)]
    else:
        free = [(0.0, h, _IN_A_STAGE) for h in _horizons(options.doublings)[:-1]] + [(0.0, 2.0, options.max_steps)]
    slow = [(w, 2.0, 2 * _IN_A_STAGE) for w in _SLOW_WEIGHTS]
    length = max(len(slow), len(free))

    def phase_of(layout: Layout, stages: list, soft: bool, again: bool, reject: bool) -> _Phase:
        flags = (jnp.asarray(x) for x in (again, reject))
        return _Phase(layout, _schedule(stages, soft, length, dtype), *flags)

    phases = [phase_of(single, free, robust, False, False)]
    if options.shooting:
        phases = [phase_of(cut, links, robust, False, False), *phases]
        if options.free_motion:
            phases += [
                phase_of(cut, slow, robust, True, False),
                phase_of(single, free, robust, True, False),
            ]
    if robust:
        phases.append(phase_of(single, free[-1:], False, False, True))

    def accuracy(rows: Rows) -> Array:
        if options.noise_known:
            return jnp.asarray(ACCURACY, dtype)
        return ACCURACY * rows.cost / jnp.maximum(jnp.sum(rows.residual != 0), 1)

    def run(
        point: Point, kept: tuple[Array, ...], phase: _Phase, steps: Array, history: Array
    ) -> tuple:
        now = args._replace(weights=kept)
        return levenberg_marquardt(
            evaluate, now, point, phase.layout, phase.stages, accuracy, steps, history,
            options.progress,
        )  # fmt: skip

    counts = [x.ts.shape[1] for x in stacked]
    widths = [w.shape[-1] for w in weights]

    def rejecting(rows: Rows) -> tuple[Array, ...]:
        found, at = [], 0
        for weight, count, width in zip(weights, counts, widths, strict=True):
            part = rows.residual[:, at : at + count * width].reshape(throws, count, width)
            at += count * width
            soft = jnp.sum(part * part, axis=-1)  # s / (1 + s / c)
            square = soft / jnp.maximum(1 - soft / (4.0 * width), 1e-6)
            good = square < width + _REJECTED
            seen = jnp.any(weight > 0, axis=-1)
            bad = jnp.sum(seen & ~good, axis=1) > _SPOILT * jnp.sum(seen, axis=1)
            found.append(weight * (good & ~bad[:, None])[..., None])
        # A throw given up by one kind of observation is given up by all.
        alive = jnp.stack([jnp.any(w > 0, axis=(1, 2)) for w in found])
        had = jnp.stack([jnp.any(w > 0, axis=(1, 2)) for w in weights])
        spoilt = jnp.any(had & ~alive, axis=0)
        return tuple(w * ~spoilt[:, None, None] for w in found)

    total = sum(jnp.sum(w) for w in weights)

    def went_wrong(rows: Rows, settled: Array) -> Array:
        if not options.noise_known or robust:
            return ~settled
        freedom = jnp.maximum(total - numbers.size - 3 * throws, 1.0)
        return rows.cost > freedom * (1 + _GATE * jnp.sqrt(2 / freedom))

    none, blank = jnp.asarray(0), jnp.full(_HISTORY, jnp.nan, dtype)
    if options.free_motion:  # all phases through one loop, compiled once
        stack = jtu.tree_map(lambda *x: jnp.stack(x), *phases)
        shapes = eqx.filter_eval_shape(lambda p: run(p, weights, phases[0], none, blank)[1], point)
        empty = jtu.tree_map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

        def step(carry: tuple, phase: _Phase) -> tuple[tuple, None]:
            now, kept, rows, settled, steps, history, wrong = carry
            if robust:
                new = rejecting(rows)
                kept = tuple(jnp.where(phase.reject, a, b) for a, b in zip(new, kept, strict=True))
            # A second attempt, for those that need it, begins where the first did.
            linked = phase.stages.weight[0] > 0
            wrong = jnp.where(phase.again & linked, went_wrong(rows, settled), wrong)
            skip = phase.again & ~wrong
            begin = jtu.tree_map(
                lambda x, y: jnp.where(phase.again & linked & wrong, x, y), point, now
            )
            stages = phase.stages._replace(steps=jnp.where(skip, 0, phase.stages.steps))
            found = run(begin, kept, phase._replace(stages=stages), steps, history)
            now, rows, settled, steps, history = jtu.tree_map(
                lambda new, old: jnp.where(skip, old, new),
                found,
                (now, rows, settled, steps, history),
            )
            return (now, kept, rows, settled, steps, history, wrong), None

        no = jnp.asarray(False)
        carry = (point, weights, empty, no, none, blank, no)
        (point, weights_kept, rows, settled, steps, history, _), _ = jax.lax.scan(
            step, carry, stack
        )
    else:
        weights_kept, steps, history = weights, none, blank
        rows, settled = None, jnp.asarray(False)
        for phase in phases:
            if rows is not None and robust:
                new = rejecting(rows)
                weights_kept = tuple(
                    jnp.where(phase.reject, a, b) for a, b in zip(new, weights_kept, strict=True)
                )
            if phase.layout is single:  # the whole motion is integrated, from the first node
                first = single._replace(
                    start=single.start[:, :1], end=single.end[:, :1], linked=single.linked[:, :1]
                )
                phase = phase._replace(layout=first)
                point = Point(point.numbers, point.attitude[:, :1], point.omega[:, :1])
            point, rows, settled, steps, history = run(
                point, weights_kept, phase, steps, history
            )
    assert rows is not None
    final = args._replace(weights=weights_kept)
    return _result(
        options, final, point, rows, weights, settled, history, single, input_result,
    )  # fmt: skip


def _linear_start(
    options: Options, unknowns: Unknowns, samples: Samples, trace: Array | None
) -> Array:
    """A tensor from linear equations in it: the weak form, or, by attitudes, the momentum."""
    by_attitude = options.free_motion and samples.attitude is not None and samples.ts.shape[1] < 40
    torque = None
    if not options.free_motion:
        torque_of = unknowns.original.torque

        def at(t: Array, q: Array, w: Array) -> Array:
            return jnp.asarray(torque_of(t, State(q, w), None), w.dtype)

        unit = jnp.zeros((*samples.ts.shape, 4), samples.ts.dtype).at[..., 0].set(1)
        attitude = unit if samples.attitude is None else samples.attitude
        torque = jax.vmap(jax.vmap(at))(samples.ts, attitude, samples.omega)
    return linear_start(
        samples.ts, samples.there, samples.omega,
        samples.attitude if by_attitude else None, torque, trace,
    )  # fmt: skip


def _result(
    options: Options,
    args: _Args,
    point: Point,
    rows: Rows,
    seen: tuple[Array, ...],
    settled: Array,
    history: Array,
    single: Layout,
    input_result: Any,
) -> FitResult:
    unknowns, kept, t0 = args.unknowns, args.weights, single.start[:, 0]
    numbers = point.numbers
    dtype = numbers.dtype
    size, locals_ = numbers.size, rows.of_state.shape[-1]
    throws = t0.shape[0]
    count = sum(jnp.sum(w > 0) for w in kept)
    alive = jnp.any(jnp.stack([jnp.any(w > 0, axis=(1, 2)) for w in kept]), axis=0)
    chi_square = rows.cost
    freedom = count - size - locals_ * jnp.sum(alive)
    noise = chi_square / jnp.maximum(freedom, 1)
    inflate = jnp.ones((), dtype) if options.noise_known else noise
    values, directions, covariance, of_state = _told(rows, inflate)

    tensor = unknowns.inertia(numbers)
    moments, axes = eigh(tensor)
    if size:
        slopes = jax.jacfwd(unknowns.inertia)(numbers)
    else:
        slopes = jnp.zeros((3, 3, 0), dtype)
    inside = product("ki,kln,lj->ijn", axes, slopes, axes)
    cov = covariance[:size, :size]
    of_moments = jnp.stack([inside[i, i] for i in range(3)])
    eps = jnp.finfo(dtype).eps

    def turn(i: int, j: int) -> Array:
        gap = moments[i] - moments[j]
        floor = eps * moments[2]
        return inside[i, j] / jnp.where(jnp.abs(gap) > floor, gap, floor)

    turns = jnp.stack([turn(1, 2), turn(2, 0), turn(0, 1)])
    ratios = moments[1:] / moments[0]
    of_ratios = (of_moments[1:] - ratios[:, None] * of_moments[:1]) / moments[0]

    def spread(x: Array) -> Array:
        return product("in,nm,jm->ij", x, cov, x)

    pure = _is_pure(args, rows, inflate) & (unknowns.shape != "fixed")
    largest = jnp.sqrt(inflate) / jnp.min(values) if size else jnp.zeros((), dtype)
    gate = 1 + _GATE * jnp.sqrt(2 / jnp.maximum(freedom, 1).astype(dtype))
    # A fit that creeps along a direction which the record does not tell is as good as any.
    untold = (largest > LARGEST_ERROR) | pure
    status = Status.where(settled, Status.OK, Status.NOT_CONVERGED)
    status = Status.where(untold, Status.UNIDENTIFIABLE, status)
    if unknowns.shape not in ("flat", "fixed"):
        status = Status.where(is_near_flat(tensor), Status.AT_BOUNDARY, status)
    if options.noise_known:
        wrong = Status.where(settled, Status.WRONG_BASIN, Status.NOT_CONVERGED)
        status = Status.where(noise > gate, wrong, status)
    status = Status.where(input_result == RESULTS.successful, status, Status.BAD_INPUT)
    found = FitResult(
        status, tensor, moments, axes, spread(of_moments),
        jnp.sqrt(jnp.maximum(jnp.diagonal(spread(turns)), 0.0)), ratios, spread(of_ratios),
        State(point.attitude[:, 0], point.omega[:, 0]), t0, numbers, covariance,
        rows.residual, jnp.concatenate([rows.of_numbers, rows.of_state], axis=-1), chi_square,
        freedom, values, directions, of_state, tuple(jnp.any(w > 0, axis=-1) for w in kept),
        ~alive & jnp.any(jnp.stack([jnp.any(w > 0, axis=(1, 2)) for w in seen]), axis=0),
        history, pure, input_result, unknowns, options.noise_known, options.free_motion,
    )  # fmt: skip
    found = nan_where(input_result != RESULTS.successful, found)
    if not options.throw:
        return found
    failed = (status == Status.WRONG_BASIN) | (status == Status.NOT_CONVERGED)
    code = (status == Status.NOT_CONVERGED).astype(int)
    messages = [Status[Status.WRONG_BASIN], Status[Status.NOT_CONVERGED]]
    return eqx.branched_error_if(found, failed, code, messages)


def _is_pure(args: _Args, rows: Rows, noise: Array) -> Array:
    """Whether a constant rate in each throw describes a gyro's record as well.

    Where the rates do not vary the Fisher information at the estimate is no guide: a motion fitted
    to the noise seems to tell what the true one does not.
    """
    at = 0
    for x, weight in zip(args.observations, args.weights, strict=True):
        width = weight.shape[-1] * weight.shape[1]
        if not isinstance(x, Rates):
            at += width
            continue
        fitted = jnp.sum(rows.residual[:, at : at + width] ** 2)
        if x.covariance is not None:
            inverse = 1 / jnp.diagonal(x.covariance, axis1=-2, axis2=-1)
        elif x.sigma is not None:
            inverse = 1 / x.sigma**2
        else:
            inverse = jnp.full(weight.shape, 1.0, weight.dtype) / args.unit**2
        inverse = jnp.where(weight > 0, inverse, 0.0)
        values = jnp.where(weight > 0, x.values, 0.0)
        total = jnp.sum(inverse, axis=1, keepdims=True)
        mean = jnp.sum(inverse * values, axis=1, keepdims=True) / jnp.where(total > 0, total, 1.0)
        constant = jnp.sum(inverse * (values - mean) ** 2)
        return constant - fitted < noise * (5 + _GATE * 10**0.5)  # of the shape's five numbers
    return jnp.asarray(False)


def _told(rows: Rows, inflate: Array) -> tuple[Array, Array, Array, Array]:
    """Singular values and directions of the numbers, states removed, and the whole covariance."""
    jg, jl = rows.of_numbers, rows.of_state
    throws, size, locals_ = jg.shape[0], jg.shape[-1], jl.shape[-1]
    eps = jnp.finfo(jg.dtype).eps

    def throw(jg: Array, jl: Array) -> tuple[Array, Array, Array, Array]:
        scale = jnp.sqrt(jnp.sum(jl * jl, axis=0))
        scale = jnp.where(scale > 0, scale, 1.0)
        u, s, vt = jnp.linalg.svd(jl / scale, full_matrices=False)
        told = s > 1e-9 * s[0]
        u = jnp.where(told, u, 0.0)
        inverse = jnp.where(told, 1 / jnp.where(told, s, 1.0), 1 / (eps * jnp.maximum(s[0], 1.0)))
        half = vt.T * inverse / scale[:, None]
        cause = product("lk,rk,rg->lg", vt.T / scale[:, None] * jnp.where(told, inverse, 0.0), u, jg)
        rest = jg - product("rk,sk,sg->rg", u, u, jg)
        return jnp.linalg.qr(rest, mode="r") if size else rest[:0], half, cause, s

    r, half, cause, of_state = jax.vmap(throw)(jg, jl)
    own = product("tik,tjk->tij", half, half)
    if size:
        _, values, vt = jnp.linalg.svd(r.reshape(-1, size), full_matrices=False)
        floor = jnp.maximum(values, 16 * eps * values[0] + 1e-150)
        cov = product("ki,kj->ij", vt / floor[:, None], vt / floor[:, None])
        directions = vt.T
    else:
        values, cov = jnp.zeros(0, jg.dtype), jnp.zeros((0, 0), jg.dtype)
        directions = cov
    across = -product("tlg,gh->tlh", cause, cov).reshape(-1, size)
    everywhere = product("tlg,gh,smh->tlsm", cause, cov, cause)
    blocks = everywhere + jnp.eye(throws, dtype=jg.dtype)[:, None, :, None] * own[:, :, None, :]
    blocks = blocks.reshape(throws * locals_, throws * locals_)
    whole_ = jnp.concatenate(
        [jnp.concatenate([cov, across.T], axis=1), jnp.concatenate([across, blocks], axis=1)]
    )
    return values, directions, inflate * whole_, of_state
