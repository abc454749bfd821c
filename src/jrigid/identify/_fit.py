"""fit(): inertia, and what else is asked for, from what was observed."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._checks import Findings, check_option, settle
from jrigid.dynamics import State
from jrigid.identify._compile import quick_jit
from jrigid.identify._errors import GATE, conclude
from jrigid.identify._flow import depends_on_attitude
from jrigid.identify._inputs import findings_of, local_scales, refuse, start_of, typical_rate
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
    Attitudes,
    Rates,
    known,
    of_throws,
)
from jrigid.identify._parameters import LogCholesky
from jrigid.identify._residuals import Args, Options, evaluation
from jrigid.identify._result import FitResult, Status
from jrigid.identify._shooting import ACCURACY, Point, Rows, Stage, levenberg_marquardt
from jrigid.identify._starts import linear_start
from jrigid.identify._unknowns import Unknowns, as_tensor, unknowns_of
from jrigid.systems import RigidBody

_LOSSES = ("squares", "robust")
# Weights of the links, in units of the noise; and a slower way for fits that went wrong.
_WEIGHTS = (1.0, 10.0, 100.0, 1e3, 1e4)
_SLOW_WEIGHTS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4)
_IN_A_STAGE = 15
_REJECTED = 16.0  # whitened square of a sample, above its degrees of freedom, that is no noise
_SPOILT = 0.25  # fraction of samples rejected that gives a throw up
_HISTORY = 1024


def fit(
    system: RigidBody,
    observations: Any,
    *,
    free: Any = None,
    nuisances: Sequence[str] | Mapping[str, Any] = (),
    scale: str = "trace",
    shape: str | LogCholesky = "tensor",
    start: tuple[Any, State | None] | State | None = None,
    loss: str = "squares",
    absolute_sigma: bool = True,
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
            `shape`); the tensor itself is only a start, and none is needed for a free body.
        observations: A `Rates`, `Attitudes`, `Directions`, `AngularMomenta` or `Observed`; a tuple
            of several of one motion; or a list with one entry (a tuple, or a single one) for each
            throw of the same body. Observations with an axis of throws in front of their times do
            as well as a list.
        free: Further parameters that are sought: a function of the system that picks arrays
            (`lambda body: body.torque.coefficient`), or a filter, a tree of booleans as for
            `equinox.filter`.
        nuisances: Errors of the gyro that are sought too: "gyro_bias", "gyro_scale" (one factor),
            "gyro_scales" (one for each axis), "gyro_misalignment" (a small turn from the axes of
            everything else), "gyro_matrix", "gyro_handedness". In a mapping each may have a
            standard deviation known beforehand.
        scale: What sets the scale of the tensor. "trace": nothing does, it keeps the trace of the
            system's; "known": a torque or a momentum whose size is known; "rotor": the known
            momentum of a `torques.Rotor`.
        shape: What is known of the tensor. "tensor": nothing, any real body; "moments": the
            principal axes, those of the system's; "symmetric": two moments are equal; "top": they
            are, and the axis is body axis 3; "flat": all mass in a plane; "fixed": all of it. Or a
            `LogCholesky`: ten numbers of the body about a fixed point, of which any are frozen.
        start: Where to start: a `State` at each throw's first sample (`t0` of what is returned), of
            one throw or with an axis of throws in front; or (inertia or None, State or None).
            Needed where the attitude matters and was not observed: an attitude nearer than about
            half a turn will do.
        loss: "squares", or "robust": Cauchy's loss, then samples beyond four standard deviations
            are left out, throws with more than a quarter of such samples altogether, and the rest
            is fitted by squares.
        absolute_sigma: False: the noise stated is relative, its level is that of the residuals.
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
    check_option("loss", loss, _LOSSES)
    if not isinstance(system, RigidBody):
        raise ValueError(
            "Argument `system` must be a RigidBody (of a body in flight, rotation about its centre "
            f"of mass), but it is {type(system).__name__}."
        )
    stacked = of_throws(observations)
    start_tensor, start_state = start_of(start)
    torque_free = system.is_free
    refuse(system, stacked, scale, torque_free)
    throws = stacked[0].ts.shape[0]
    on_attitude = any(x.on_attitude for x in stacked) or depends_on_attitude(system)
    if on_attitude and start_state is None and not any(isinstance(x, Attitudes) for x in stacked):
        raise ValueError(
            "Argument `start` must hold a State whose attitude the fit can start from, since the "
            "motion or an observation depends on the attitude and none was observed, but it does "
            "not."
        )
    observed = any(isinstance(x, Rates | Attitudes) for x in stacked)
    internal = system.with_parts(State(jnp.zeros(4), jnp.zeros(3))).internal is not None
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
    prepared = _prepare(system, stacked, start_tensor, start_state, on_attitude)
    given = system, stacked, prepared.samples, start_tensor, start_state
    stacked, samples, rate, angle, input_result = settle(
        prepared, throw, lambda: findings_of(*given)
    )
    stated = all(x.sigma is not None or x.covariance is not None for x in stacked)
    noise_known = absolute_sigma and stated
    if not stated and len(stacked) > 1:
        raise ValueError(
            "Argument `observations` must state the noise of each kind where there are several, "
            "but one has neither `sigma` nor `covariance`: they cannot be weighed."
        )
    if not noise_known and loss == "robust":
        raise ValueError(
            "Argument `loss` must be 'squares' where the noise is not stated or only relative, but "
            "it is 'robust': nothing says what is too far off."
        )
    unknowns = unknowns_of(system, free, nuisances, shape, scale, rate)
    if not noise_known and any(prior is not None for prior in unknowns.priors):
        raise ValueError(
            "Argument `nuisances` must not state what is known beforehand where the noise of the "
            "record is not stated or only relative, but it does: the two cannot be weighed."
        )
    nodes = 1
    if shooting and samples is not None:
        nodes = segments_needed(angle, samples.ts.shape[1])
    options = Options(
        torque_free and motion is None, on_attitude, shooting,
        nodes, loss, max_steps, noise_known, motion, doublings, progress,
    )  # fmt: skip
    found = _fit(options, unknowns, stacked, samples, start_tensor, start_state, input_result)
    if not throw:
        return found
    findings = Findings()
    for status in (Status.WRONG_BASIN, Status.NOT_CONVERGED):
        findings.require(found.status != status, None, Status[status])
    return findings.guard(found, throw)


class _Prepared(NamedTuple):
    """Observations, what tells the state on the way, the angle it turns, and what is wrong."""

    observations: tuple[AbstractObservation, ...]
    samples: Samples | None
    rate: Array
    angle: Array
    result: Any


@eqx.filter_jit
def _prepare(
    system: Any,
    stacked: tuple[AbstractObservation, ...],
    tensor: Any,
    state: State | None,
    on_attitude: bool,
) -> _Prepared:
    ts, _ = times_of(stacked)
    attitude0 = None if state is None or not on_attitude else state.attitude.astype(ts.dtype)
    samples = samples_of(stacked, attitude0)
    rate = typical_rate(samples, state, ts.dtype)
    findings = findings_of(system, stacked, samples, tensor, state)
    angle = jnp.zeros(()) if samples is None else jnp.max(angle_turned(samples)[:, -1])
    return _Prepared(stacked, samples, rate, angle, findings.result)


class _Phase(NamedTuple):
    """One pass: segments, stages, whether only for fits that went wrong, and after a rejection."""

    layout: Layout
    stages: Stage
    again: Array
    reject: Array


def _schedule(stages: list[tuple[float, float, int]], robust: bool, length: int, dtype: Any) -> Any:
    """Stages (weight of the links, horizon, steps), filled up to a length with none."""
    filled = stages + [(0.0, 2.0, 0)] * (length - len(stages))
    weight, horizon, steps = (jnp.asarray(x) for x in zip(*filled, strict=True))
    return Stage(
        weight.astype(dtype), horizon.astype(dtype), jnp.full(length, robust), steps.astype(int)
    )


@quick_jit
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
        sought = unknowns.shape != "fixed" and unknowns.ten is None
        if samples is not None and sought and options.motion is None:
            by_torque = unknowns.scaled and not options.free_motion
            trace = None if by_torque else jnp.trace(tensor)
            tensor = _linear_start(options, unknowns, samples, trace)
    unknowns, numbers = unknowns.start(tensor.astype(dtype))
    rounder = unknowns.rounder(tensor.astype(dtype), numbers)

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

    of_rates, of_angles, guess = local_scales(stacked, unknowns.rate)
    local = jnp.concatenate([jnp.full(3, of_rates), jnp.full(3, of_angles)])
    weights = tuple(known(x).astype(dtype) for x in stacked)
    args = Args(unknowns, stacked, weights, local, guess)
    evaluate = evaluation(options)

    robust = options.loss == "robust"
    links = [(w, 2.0, _IN_A_STAGE) for w in _WEIGHTS]
    free = [(0.0, 2.0, options.max_steps)]
    if not options.shooting:  # the beginning first, then each time twice as much
        early = [2.0**-k for k in range(options.doublings, 0, -1)]
        free = [(0.0, part, _IN_A_STAGE) for part in early] + free
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
        return ACCURACY * rows.cost / jnp.maximum(jnp.sum(rows.residual != 0), 1).astype(dtype)

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
            rejected = jnp.sum(seen & ~good, axis=1).astype(dtype)
            bad = rejected > _SPOILT * jnp.sum(seen, axis=1).astype(dtype)
            good = (good & ~bad[:, None]).astype(dtype)
            found.append(weight * good[..., None])
        # A throw given up by one kind of observation is given up by all.
        left = jnp.stack([jnp.any(w > 0, axis=(1, 2)) for w in found])
        had = jnp.stack([jnp.any(w > 0, axis=(1, 2)) for w in weights])
        spoilt = jnp.any(had & ~left, axis=0)
        alive = (~spoilt).astype(dtype)[:, None, None]
        return tuple(w * alive for w in found)

    total = sum(jnp.sum(w) for w in weights)

    def went_wrong(rows: Rows, settled: Array) -> Array:
        if not options.noise_known or robust:
            return ~settled
        freedom = jnp.maximum(total - numbers.size - 3 * throws, 1.0)
        return rows.cost > freedom * (1 + GATE * jnp.sqrt(2 / freedom))

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
            # A second attempt, for those that need it, begins at a body further from flat.
            linked = phase.stages.weight[0] > 0
            wrong = jnp.where(phase.again & linked, went_wrong(rows, settled), wrong)
            skip = phase.again & ~wrong
            begin = jtu.tree_map(
                lambda x, y: jnp.where(phase.again & linked & wrong, x, y),
                point._replace(numbers=rounder),
                now,
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
            point, rows, settled, steps, history = run(point, weights_kept, phase, steps, history)
    assert rows is not None
    final = args._replace(weights=weights_kept)
    return conclude(
        options, final, point, rows, weights, settled, history, single, input_result,
    )  # fmt: skip


def _linear_start(
    options: Options, unknowns: Unknowns, samples: Samples, trace: Array | None
) -> Array:
    """A tensor from linear equations in it: the weak form, or, by attitudes, the momentum."""
    by_attitude = options.free_motion and samples.attitude is not None and samples.ts.shape[1] < 40
    torque = None
    if not options.free_motion:
        torque_of = unknowns.original.torque_on

        def at(t: Array, q: Array, w: Array) -> Array:
            return jnp.asarray(torque_of(t, State(q, w), None), w.dtype)

        unit = jnp.zeros((*samples.ts.shape, 4), samples.ts.dtype).at[..., 0].set(1)
        attitude = unit if samples.attitude is None else samples.attitude
        torque = jax.vmap(jax.vmap(at))(samples.ts, attitude, samples.omega)
    return linear_start(
        samples.ts, samples.there, samples.omega,
        samples.attitude if by_attitude else None, torque, trace,
    )  # fmt: skip
