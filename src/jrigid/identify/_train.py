"""Training of torques with many parameters, such as a network or a table."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple, Protocol, runtime_checkable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from jrigid._checks import all_finite, check_key, check_type, demand, whole_number
from jrigid._core.compile import SOME, quick_jit
from jrigid._numerics import product
from jrigid._stepping.method import method_of
from jrigid._types import AnyArray, RandomKey
from jrigid.dynamics import State
from jrigid.identify._flow import forced_flow, needs_attitude
from jrigid.identify._host import on_host
from jrigid.identify._inputs import judge
from jrigid.identify._problem import Options, shown_by, whitened
from jrigid.identify._readings import (
    DirectReadings,
    direct_readings_of,
    longest_turn,
)
from jrigid.identify._records import Record, Samples, of_trials, samples_of
from jrigid.identify._sensors import AbstractSensor
from jrigid.rotation import exp, multiply
from jrigid.systems import RigidBody

_METHOD = method_of(diffrax.Tsit5())
# Longest step [rad]. After 50 gaps of up to 0.2 rad the error is below 1e-6 of the
# state.
_TURN = 0.2
# Levenberg-Marquardt steps to the state of a segment. Where the torque is nearly right
# two are enough, because the observed state is off by the noise alone. A wrong torque
# bends a long segment away from its samples, and moves the best state far.
_STEPS_TO_STATE = 30
_FIRST_DAMPING = 1e-3
_FALL, _RISE = 0.1, 10.0  # of the damping after a step that helps, or does not
# The state is found where a step promises less than this part of chi-square: the slope
# in the parameters is that at the best state.
_ENOUGH = 1e-8
_RIDGE = 1e-12  # of the normal equations, for a turn that no sample shows


@runtime_checkable
class _Optimizer(Protocol):
    """An `optax.GradientTransformation`, which is imported only where it is used."""

    @property
    def init(self) -> Callable[..., PyTree]: ...

    @property
    def update(self) -> Callable[..., tuple[PyTree, PyTree]]: ...


class TrainResult(NamedTuple):
    """A trained system and its losses.

    Attributes:
        system: The system with the least validation loss.
        training: Mean loss over the batches of each epoch, while the system changes.
        validation: Loss of the validation trials before each epoch. The first is that
            of the system as it was given.
        epoch: Number of epochs before the least validation loss.
    """

    system: RigidBody
    training: Float[Array, " epochs"]
    validation: Float[Array, " epochs"]
    epoch: int


class _Segments(NamedTuple):
    """Samples of all segments, and the observed state at the first sample of each."""

    samples: Samples
    guess: State


class _Task(NamedTuple):
    """Parts of the training that stay the same in all epochs.

    Attributes:
        optimizer: Optimiser of the parameters.
        rest: The system without the parameters that are trained.
        sensors: Sensor of each record.
        segments: All segments.
        trained: Indices of the segments that are trained on.
        judged: Indices of the segments of validation trials.
        batch: Number of segments in a step of the optimiser.
        depends_on_attitude: Whether the torque or a sensor depends on the attitude.
        steps: Number of integration steps between two samples.
    """

    optimizer: _Optimizer
    rest: PyTree
    sensors: list[AbstractSensor]
    segments: _Segments
    trained: AnyArray
    judged: AnyArray
    batch: int
    depends_on_attitude: bool
    steps: int


class _Best(NamedTuple):
    """Parameters with the least validation loss, and how many epochs precede them."""

    params: PyTree
    loss: float
    epoch: int


def train(
    system: RigidBody,
    observations: Any,
    optimizer: _Optimizer,
    *,
    key: RandomKey,
    free: Callable[[Any], Any] | None = None,
    validation: Sequence[int] | None = None,
    segment: int = 50,
    batch: int = 32,
    epochs: int = 300,
    patience: int = 30,
    progress: bool = False,
) -> TrainResult:
    r"""Fit a torque with many parameters to observations by an optimiser of optax.

    Trials are cut into segments. The loss is the sum of the squared residuals of a
    segment, in units of their noise, over its degrees of freedom. The residuals are
    those at the state that fits the segment best. The loss is 1 for a torque that
    leaves only noise.

    States are not parameters. Gauss-Newton steps compute them again for each torque, so
    that validation trials are judged in the same way. The result is the system with the
    least validation loss of all epochs.

    The inertia is held. An arbitrary torque can replace the gyroscopic one, and no
    record distinguishes the two. `fit` seeks the inertia beside a torque with few
    parameters, or beside the trained torque: `fit(train(...).system, observations)`.

    Args:
        system: The body. Its torque holds the initial parameters (an
            `equinox.Module`).
        observations: As for `fit`, of two trials or more. Rates must be observed, and
            attitudes where the torque or a sensor depends on them. No reading may be
            saturated.
        optimizer: An `optax.GradientTransformation`.
        key: Random key for the order of the segments. The same key gives the same bits
            on the same machine.
        free: Function that picks the arrays of the system that are trained, or parts
            that hold them, such as `lambda body: body.torque.network`. By default the
            whole torque is trained. The torque itself must keep positive what has to be
            positive.
        validation: Indices of trials that are not trained on. By default every fifth
            trial, counted from the last.
        segment: Approximate number of samples of the first record in a segment. Long
            segments determine more.
        batch: Number of segments in a step of the optimiser. Segments that do not fill
            a batch are left out of that epoch.
        epochs: Largest number of epochs.
        patience: Training stops when the validation loss has not fallen for this many
            epochs. It also stops at parameters that are not finite.
        progress: Whether to print the losses of each epoch.

    Returns:
        The trained system, and both losses of each epoch.

    Raises:
        ValueError: An argument has a wrong type, shape or option.
        RuntimeError: The record or the system has bad values, the first loss is not
            finite, or the parameters are not before the validation loss has fallen.

    Gradients: none.

    >>> import jax, jax.numpy as jnp, jrigid as jr, optax
    >>> record = jr.datasets.gyro_example()
    >>> halves = [
    ...     jr.identify.Rates(record.times[i], record.omegas[i], record.sigma)
    ...     for i in (slice(0, 100), slice(100, 200))]
    >>> drag = jr.torques.LinearDrag(0.02)  # which this body does not have
    >>> body = jr.RigidBody(record.true_moments, drag)
    >>> result = jr.identify.train(
    ...     body, halves, optax.adam(3e-3), key=jax.random.key(0), batch=2, epochs=20)
    >>> print(result.validation[0] > 2 * min(result.validation))
    True
    """
    import optax

    check_type("system", system, RigidBody)
    check_type("optimizer", optimizer, optax.GradientTransformation)
    check_key("key", key)
    whole_number("segment", segment)
    whole_number("batch", batch)
    whole_number("patience", patience)
    whole_number("epochs", epochs)
    params, rest = _parameters(system, free)
    records = of_trials(observations)
    demand(
        all(x.states_noise for x in records),
        "Argument `observations` must state the noise, but it does not.",
    )
    held_out = _held_out(validation, records[0].ts.shape[0])
    windows = _windows(records[0], segment)
    records = tuple(_cut(x, windows) for x in records)
    is_held_out = np.isin([x.trial for x in windows], held_out)
    trained = np.flatnonzero(~is_held_out)
    prepared = _prepared(system, records)
    task = _Task(
        optimizer=optimizer,
        rest=rest,
        sensors=[x.sensor for x in records],
        segments=prepared.segments,
        trained=trained,
        judged=np.flatnonzero(is_held_out),
        batch=min(batch, trained.size),
        depends_on_attitude=prepared.depends_on_attitude,
        steps=prepared.steps,
    )
    best, training, judged = _trained(task, params, key, epochs, patience, progress)
    return TrainResult(eqx.combine(best.params, rest), training, judged, best.epoch)


def _trained(
    task: _Task,
    params: PyTree,
    key: RandomKey,
    epochs: int,
    patience: int,
    progress: bool,
) -> tuple[_Best, Array, Array]:
    """The best parameters, and the training and validation losses of each epoch."""
    memory = task.optimizer.init(params)
    best = _Best(params, np.inf, 0)
    losses: list[tuple[Array, Array]] = []
    # An epoch reports the validation loss before its first batch, hence one epoch more.
    for epoch in range(epochs + 1):
        after = _epoch(task, params, memory, jax.random.fold_in(key, epoch))
        losses.append((after.training, after.validation))
        if progress:
            _print_losses(epoch, after)
        if float(after.validation) < best.loss:
            best = _Best(params, float(after.validation), epoch)
        elif epoch - best.epoch >= patience or not np.isfinite(best.loss):
            break
        params = after.params
        memory = after.memory
        # No step leads back from parameters that are not finite.
        if not all_finite(params):
            break
    if not np.isfinite(best.loss):
        raise RuntimeError(
            "Argument `system` must have a finite loss to start from, but has none."
        )
    if best.epoch == 0 and not all_finite(params):
        raise RuntimeError(
            "Argument `optimizer` must keep the parameters finite, but it does not: "
            "pass a lower learning rate."
        )
    training, validation = (jnp.stack(x) for x in zip(*losses, strict=True))
    return best, training, validation


def _parameters(
    system: RigidBody, free: Callable[[Any], Any] | None
) -> tuple[PyTree, PyTree]:
    """The arrays of the system that are trained, and the rest of it."""

    def whole_torque(body: RigidBody) -> Any:
        return body.torque

    def all_of(part: PyTree) -> PyTree:
        return jtu.tree_map(lambda _: True, part)

    nothing = jtu.tree_map(lambda _: False, system)
    mask = eqx.tree_at(
        whole_torque if free is None else free, nothing, replace_fn=all_of
    )
    mask = jtu.tree_map(
        lambda chosen, x: chosen and eqx.is_inexact_array(x), mask, system
    )
    params, rest = eqx.partition(system, mask)
    demand(
        params.inertia is None and bool(jtu.tree_leaves(params)),
        "Argument `free` must pick floating point arrays of the system, beside the "
        "inertia, which is held, but it does not.",
    )
    return params, rest


def _held_out(validation: Sequence[int] | None, trials: int) -> np.ndarray:
    """Indices of the validation trials."""
    demand(
        trials > 1,
        "Argument `observations` must hold two trials or more, one of them to judge "
        "by, but it holds one.",
    )
    if validation is None:
        return np.arange(trials)[::-5]
    chosen = np.unique(np.asarray(validation))
    # A mask of all trials would count as the trials 0 and 1.
    demand(
        np.issubdtype(chosen.dtype, np.integer)
        and 0 < chosen.size < trials
        and bool(np.all(np.isin(chosen, np.arange(trials)))),
        f"Argument `validation` must be indices of some of {trials} trials, not all, "
        f"but it is {chosen}.",
    )
    return chosen


class _Window(NamedTuple):
    """A segment: its trial, and its time from the start to before the end [s]."""

    trial: int
    start: float
    end: float


def _windows(record: Record, length: int) -> list[_Window]:
    """Segments of about equal counts of a record's samples in each trial."""
    windows = []
    pairs = zip(np.asarray(record.ts), np.asarray(record.known), strict=True)
    for trial, (ts, known) in enumerate(pairs):
        observed = ts[np.any(known, axis=-1)]
        parts = np.array_split(observed, max(1, round(observed.size / length)))
        # The outer edges are open, since other records may begin earlier or end later.
        edges = [-np.inf, *(x[0] for x in parts[1:]), np.inf]
        windows += [_Window(trial, start, end) for start, end in pairwise(edges)]
    return windows


def _samples_inside(record: Record, windows: Sequence[_Window]) -> np.ndarray:
    """Indices of the samples of each segment, padded by -1 to the longest."""
    ts = np.asarray(record.ts)
    known = np.any(np.asarray(record.known), axis=-1)
    rows = []
    for trial, start, end in windows:
        inside = known[trial] & (start <= ts[trial]) & (ts[trial] < end)
        rows.append(np.flatnonzero(inside))
    longest = max(x.size for x in rows)
    pads = [(0, longest - x.size) for x in rows]
    return np.stack(
        [np.pad(x, pad, constant_values=-1) for x, pad in zip(rows, pads, strict=True)]
    )


def _cut(record: Record, windows: Sequence[_Window]) -> Record:
    """A record whose trials are the segments, the shorter ones padded by NaN."""
    trial = np.array([x.trial for x in windows])
    index = _samples_inside(record, windows)

    def cut(x: Array | None) -> Array | None:
        if x is None:
            return None
        is_sample = (index >= 0).reshape(*index.shape, *[1] * (x.ndim - 2))
        return jnp.asarray(
            np.where(is_sample, np.asarray(x)[trial[:, None], index], np.nan)
        )

    def arrays(x: Record) -> tuple[Any, ...]:  # not arrays inside `tree_at`
        return x.ts, x.values, x.sigma, x.covariance

    segments = tuple(map(cut, arrays(record)))
    return eqx.tree_at(arrays, record, segments, is_leaf=lambda x: x is None)


class _Prepared(NamedTuple):
    """Segments and how their motion is computed; see `_Task`."""

    segments: _Segments
    depends_on_attitude: bool
    steps: int


@np.errstate(all="ignore")  # values that are bad or out of range
def _prepared(system: RigidBody, records: tuple[Record, ...]) -> _Prepared:
    """Segments, checked for what training needs."""
    records = on_host(records)
    samples = samples_of(records, np.ones((), records[0].values.dtype))
    readings = direct_readings_of(records, samples, None)
    judge((system,), records, None, None, readings, throw=True)
    by_sensor = any(x.sensor.depends_on_attitude for x in records)
    depends_on_attitude = by_sensor or needs_attitude(system)
    state = system.with_parts(State(jnp.zeros(4), jnp.zeros(3)))
    lacks_attitude = depends_on_attitude and (
        readings is None or readings.attitude is None
    )
    if readings is None or state.internal is not None or lacks_attitude:
        raise ValueError(
            "Argument `observations` must show the whole state, rates and, where a "
            "torque or sensor depends on them, attitudes, without parts that move "
            "inside the body, but it does not."
        )
    demand(
        not np.any(samples.sign),
        "Argument `observations` must hold no saturated readings, but it holds some: "
        "leave out their samples.",
    )
    # The loss divides by the degrees of freedom: numbers less those of the state.
    numbers = np.sum(samples.weight, axis=(1, 2))
    demand(
        bool(np.min(numbers) > (6 if depends_on_attitude else 3)),
        "Argument `observations` must hold more numbers in each trial, and `segment` "
        "in each segment, than a state has, but one does not.",
    )
    segments = _Segments(samples, _first_states(readings))
    steps = max(1, int(np.ceil(longest_turn(readings) / _TURN)))
    return _Prepared(segments, depends_on_attitude, steps)


def _first_states(readings: DirectReadings) -> State:
    """The observed state at the first sample of each segment."""
    segment = np.arange(len(readings.ts))
    # A segment begins at its first sample of any record. Where its first rate comes
    # later, the Gauss-Newton steps make up for that.
    first = np.argmax(readings.valid, axis=1)
    omega = readings.omega[segment, first]
    if readings.attitude is None:
        # Nothing depends on the attitude, so that any will do.
        return State(np.tile(np.eye(1, 4, dtype=omega.dtype), (len(omega), 1)), omega)
    return State(readings.attitude[segment, first], omega)


class _AfterEpoch(NamedTuple):
    """Result of an epoch.

    Attributes:
        params: Parameters after the last batch.
        memory: State of the optimiser.
        training: Mean loss of the batches.
        validation: Validation loss before the first batch.
    """

    params: PyTree
    memory: PyTree
    training: Array
    validation: Array


def _print_losses(epoch: int, after: _AfterEpoch) -> None:
    losses = f"training {after.training:.4g}, validation {after.validation:.4g}"
    print(f"epoch {epoch}: {losses}", flush=True)


@partial(quick_jit, level=SOME)
def _epoch(task: _Task, params: PyTree, memory: PyTree, key: Array) -> _AfterEpoch:
    """Take one step of the optimiser for each batch of segments."""

    def loss(params: PyTree, index: AnyArray) -> Array:
        segments = jtu.tree_map(lambda x: x[index], task.segments)
        squares, freedom = jax.vmap(partial(_chi_square, task, params))(segments)
        return jnp.sum(squares) / jnp.sum(freedom)

    def step(
        carry: tuple[PyTree, PyTree], index: Array
    ) -> tuple[tuple[PyTree, PyTree], Array]:
        params, memory = carry
        value, slope = jax.value_and_grad(loss)(params, index)
        # optax mixes types, which fails under strict promotion.
        with jax.numpy_dtype_promotion("standard"):
            updates, memory = task.optimizer.update(slope, memory, params)
            params = eqx.apply_updates(params, updates)
        return (params, memory), value

    # The scan needs batches of one size.
    count = task.trained.size // task.batch * task.batch
    order = jax.random.permutation(key, task.trained)[:count].reshape(-1, task.batch)
    validation = loss(params, task.judged)
    (params, memory), losses = jax.lax.scan(step, (params, memory), order)
    return _AfterEpoch(params, memory, jnp.mean(losses), validation)


def _chi_square(task: _Task, params: PyTree, segment: _Segments) -> tuple[Array, Array]:
    """Sum of squares of a segment at its best state, and its degrees of freedom."""
    samples = segment.samples
    guess = segment.guess
    motion = partial(_motion, task.depends_on_attitude, task.steps)
    options = Options(False, task.depends_on_attitude, motion=motion)

    def rows(params: PyTree, move: Array) -> Array:
        system = eqx.combine(params, task.rest)
        attitude = guess.attitude
        if task.depends_on_attitude:
            attitude = multiply(attitude, exp(move[3:]))
        state = State(attitude, guess.omega + move[:3])
        shown = shown_by(options, system, task.sensors, state, samples.ts[0], samples)
        return whitened(task.sensors, samples, shown).reshape(-1)

    # At the best state chi-square does not change with the state to first order. Its
    # slope in the parameters is therefore that with the state held.
    held = jax.lax.stop_gradient(params)

    def at(move: Array) -> _AtState:
        def rows_twice(move: Array) -> tuple[Array, Array]:
            residuals = rows(held, move)
            # `jacfwd` returns a value only as an auxiliary output.
            return residuals, residuals

        slopes, residuals = jax.jacfwd(rows_twice, has_aux=True)(move)
        return _AtState(
            move=move,
            square=jnp.sum(residuals**2),
            slope=product("ni,n->i", slopes, residuals),
            normal=product("ni,nj->ij", slopes, slopes),
        )

    size = 6 if task.depends_on_attitude else 3
    no_move = jnp.zeros(size, guess.omega.dtype)
    move = jax.lax.stop_gradient(_best_move(at, no_move))
    return jnp.sum(rows(params, move) ** 2), jnp.sum(samples.weight) - size


class _AtState(NamedTuple):
    """Chi-square of a segment about a state: its value, half its slope, its bend."""

    move: Array
    square: Array
    slope: Array
    normal: Array


class _Loop(NamedTuple):
    """The best state so far and what comes next."""

    best: _AtState
    damping: Array
    going: Array
    steps: Array


def _best_move(at: Callable[[Array], _AtState], first: Array) -> Array:
    """The state of a segment with the least chi-square, by Levenberg and Marquardt."""

    def step(loop: _Loop) -> _Loop:
        best = loop.best
        diagonal = loop.damping * jnp.diagonal(best.normal)
        diagonal = diagonal + _RIDGE * jnp.trace(best.normal)
        move = jnp.linalg.solve(best.normal + jnp.diag(diagonal), -best.slope)
        # The quadratic model changes by 2 m.s + m.N m.
        bent = product("i,ij,j->", move, best.normal, move)
        promised = -2 * product("i,i->", move, best.slope) - bent
        new = at(best.move + move)
        better = new.square < best.square
        return _Loop(
            best=jtu.tree_map(lambda a, b: jnp.where(better, a, b), new, best),
            damping=loop.damping * jnp.where(better, _FALL, _RISE),
            # The first turn of the loop has evaluated the start.
            going=(promised > _ENOUGH * best.square) | (loop.steps < 0),
            steps=loop.steps + 1,
        )

    # The loop evaluates the start, too, so that the program holds the motion once. From
    # here its step is zero, and every chi-square is better.
    unknown = _AtState(
        move=first,
        square=jnp.full((), jnp.inf, first.dtype),
        slope=jnp.zeros_like(first),
        normal=jnp.eye(first.size, dtype=first.dtype),
    )
    loop = _Loop(
        best=unknown,
        damping=jnp.asarray(_FIRST_DAMPING / _FALL, first.dtype),
        going=jnp.asarray(True),
        steps=jnp.asarray(-1),
    )
    loop = jax.lax.while_loop(
        lambda loop: loop.going & (loop.steps < _STEPS_TO_STATE), step, loop
    )
    return loop.best.move


def _motion(
    depends_on_attitude: bool,
    steps: int,
    system: RigidBody,
    state: State,
    ts: Array,
    t0: Array,
) -> State:
    """States at the times, of which the first is that of the state."""
    del t0

    # `in_any_order` has sorted the times, in which missing samples repeat the first
    # one.
    def gap(before: State, times: tuple[Array, Array]) -> tuple[State, State]:
        start, end = times
        after = forced_flow(
            system, before, start, end, depends_on_attitude, _METHOD, steps
        )
        return after, after

    _, later = jax.lax.scan(gap, state, (ts[:-1], ts[1:]))
    return jtu.tree_map(lambda a, b: jnp.concatenate([a[None], b]), state, later)
