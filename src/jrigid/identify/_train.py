"""Torques too rich for Levenberg-Marquardt, a network or a table, learnt from trials in batches."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from jrigid._checks import check_type, demand, whole_number
from jrigid._numerics import product
from jrigid._stepping.method import method_of
from jrigid._types import RandomKey
from jrigid.dynamics import State
from jrigid.identify._compile import quick_jit
from jrigid.identify._flow import forced_flow, needs_attitude
from jrigid.identify._host import on_host
from jrigid.identify._inputs import judge
from jrigid.identify._layout import direct_readings_of, longest_turn
from jrigid.identify._problem import Options, shown_by, whitened
from jrigid.identify._records import Record, Samples, of_trials, samples_of
from jrigid.rotation import exp, multiply
from jrigid.systems import RigidBody

_METHOD = method_of(diffrax.Tsit5())
# Longest step [rad]. After 50 gaps of up to 0.2 rad the error is below 1e-6 of the state.
_TURN = 0.2
_NEWTON = 2  # Gauss-Newton steps to a segment's state: the observed one is off by the noise alone
_RIDGE = 1e-12  # of the normal equations, for a turn that no sample shows


class TrainResult(NamedTuple):
    """What `train` learnt, and how it went.

    Attributes:
        system: That of the least validation loss.
        training: Mean loss over the batches of each epoch, while it changes.
        validation: Loss of the validation trials before each epoch; the first is that of the system
            as it was given.
        epoch: How many epochs had passed at the least validation loss.
    """

    system: RigidBody
    training: Float[Array, " epochs"]
    validation: Float[Array, " epochs"]
    epoch: int


class _Data(NamedTuple):
    """All segments: what was seen, and a state at the first sample, as observed."""

    samples: Samples
    guess: State


class _Setting(NamedTuple):
    """What is fixed when an epoch is compiled."""

    optimizer: Any
    batch: int
    depends_on_attitude: bool
    steps: int  # of the motion between two samples


def train(
    system: RigidBody,
    observations: Any,
    optimizer: Any,
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
    r"""A torque with many parameters, from what was observed, by an optimiser of optax.

    Trials are cut into segments. The loss is the sum of a segment's squared residuals, in units of
    their noise, at the state that fits the segment best, over its degrees of freedom: 1 for a
    torque that leaves noise alone. States are no parameters: Gauss and Newton's steps find them
    anew for each torque, so that trials never trained on can be judged in the same way. Of all
    epochs the system with the least loss of the validation trials is returned.

    The inertia is held: a torque that may be anything takes over the gyroscopic one, and no record
    tells the two apart. `fit` seeks it beside a torque with few parameters, and with the one learnt
    here in its place: `fit(train(...).system, observations)`.

    Args:
        system: The body; its torque holds parameters to start from (an `equinox.Module`).
        observations: As for `fit`, of two trials or more. Rates must be told, and attitudes where
            the torque or a sensor looks at them.
        optimizer: An `optax.GradientTransformation`.
        key: For the order of the segments: the same key gives the same bits on the same machine.
        free: Which arrays of the system are trained: a function that picks them, or parts that
            hold them, `lambda body: body.torque.network`; by default all of the torque. What must
            be positive is for the torque to keep so.
        validation: Indices of trials that are not trained on; by default each fifth from the last.
        segment: About how many samples of the first record are in one; long ones tell more.
        batch: How many segments make a step of the optimiser. What is left over in an epoch waits.
        epochs: At most so many.
        patience: Stop when the validation loss has not fallen for so many epochs.
        progress: Print the losses of each epoch.

    Returns:
        The system that was learnt, and both losses of each epoch.

    Raises:
        ValueError: A request that makes no sense.
        RuntimeError: Bad values in the record or the system; a loss that is not finite from the
            first on.

    Gradients: none.

    >>> import jax, jax.numpy as jnp, jrigid as jr, optax
    >>> seen = jr.datasets.gyro_example()
    >>> halves = [jr.identify.Rates(seen.times[i], seen.omegas[i], seen.sigma)
    ...           for i in (slice(0, 100), slice(100, 200))]
    >>> dragged = jr.RigidBody(seen.true_moments, jr.torques.LinearDrag(0.02))  # there is none
    >>> learnt = jr.identify.train(
    ...     dragged, halves, optax.adam(3e-3), key=jax.random.key(0), batch=2, epochs=20)
    >>> print(learnt.validation[0] > 2 * min(learnt.validation))
    True
    """
    import optax

    check_type("system", system, RigidBody)
    check_type("optimizer", optimizer, optax.GradientTransformation)
    for name, value in (("segment", segment), ("batch", batch), ("patience", patience)):
        whole_number(name, value)
    whole_number("epochs", epochs)
    params, rest = _parameters(system, free)
    records = of_trials(observations)
    stated = all(x.states_noise for x in records)
    demand(stated, "Argument `observations` must state the noise, but it does not.")
    held_out = _held_out(validation, records[0].ts.shape[0])
    records, trial = _segments(records, segment)
    data, depends_on_attitude, steps = _prepared(system, records)
    trained = np.flatnonzero(~np.isin(trial, held_out))
    setting = _Setting(optimizer, min(batch, trained.size), depends_on_attitude, steps)
    sensors, judged = (
        [x.sensor for x in records],
        np.flatnonzero(np.isin(trial, held_out)),
    )
    memory, best, since = optimizer.init(params), (params, np.inf), 0
    losses: list[tuple[Array, Array]] = []
    held = rest, sensors, data, trained, judged
    for epoch in range(epochs + 1):
        now = jax.random.fold_in(key, epoch)
        new, memory, mean, loss = _epoch(setting, params, memory, now, *held)
        losses.append((mean, loss))
        if progress:
            print(
                f"epoch {epoch}: training {mean:.4g}, validation {loss:.4g}", flush=True
            )
        if float(loss) < best[1]:
            best, since = (params, float(loss)), epoch
        elif epoch - since >= patience or not np.isfinite(best[1]):
            break
        params = new
    if not np.isfinite(best[1]):
        raise RuntimeError(
            "Argument `system` must have a finite loss to start from, but has none."
        )
    training, seen = (jnp.stack(x) for x in zip(*losses, strict=True))
    return TrainResult(eqx.combine(best[0], rest), training, seen, since)


def _parameters(
    system: RigidBody, free: Callable[[Any], Any] | None
) -> tuple[Any, Any]:
    """The system's arrays that are trained, and the rest."""
    pick = (lambda body: body.torque) if free is None else free
    none = jtu.tree_map(lambda _: False, system)
    mask = eqx.tree_at(pick, none, replace_fn=lambda x: jtu.tree_map(lambda _: True, x))
    mask = jtu.tree_map(
        lambda chosen, x: chosen and eqx.is_inexact_array(x), mask, system
    )
    params, rest = eqx.partition(system, mask)
    demand(
        params.inertia is None and bool(jtu.tree_leaves(params)),
        "Argument `free` must pick floating point arrays of the system, beside the inertia, which "
        "is held, but it does not.",
    )
    return params, rest


def _held_out(validation: Sequence[int] | None, trials: int) -> np.ndarray:
    demand(
        trials > 1,
        "Argument `observations` must hold two trials or more, one of them to judge by, but it "
        "holds one.",
    )
    chosen = (
        np.arange(trials)[::-5]
        if validation is None
        else np.unique(np.asarray(validation))
    )
    demand(
        0 < chosen.size < trials and bool(np.all(np.isin(chosen, np.arange(trials)))),
        f"Argument `validation` must be indices of some of {trials} trials, not all, but it is "
        f"{validation!r}.",
    )
    return chosen


def _segments(
    records: tuple[Record, ...], length: int
) -> tuple[tuple[Record, ...], np.ndarray]:
    """Records whose trials are segments, of equal counts in each trial; and the trial of each."""
    windows, first = [], [np.asarray(x) for x in (records[0].ts, records[0].known)]
    for i, (ts, known) in enumerate(zip(*first, strict=True)):
        seen = ts[np.any(known, axis=-1)]
        parts = np.array_split(seen, max(1, round(seen.size / length)))
        edges = [-np.inf, *(x[0] for x in parts[1:]), np.inf]
        windows += [(i, a, b) for a, b in pairwise(edges)]
    trial = np.array([i for i, _, _ in windows])

    def cut(record: Record) -> Record:
        ts, known = np.asarray(record.ts), np.any(np.asarray(record.known), axis=-1)
        rows = [
            np.flatnonzero(known[i] & (a <= ts[i]) & (ts[i] < b)) for i, a, b in windows
        ]
        most = max(x.size for x in rows)
        index = np.stack(
            [np.pad(x, (0, most - x.size), constant_values=-1) for x in rows]
        )

        def taken(x: Array | None) -> Array | None:
            if x is None:
                return None
            there = (index >= 0).reshape(*index.shape, *[1] * (x.ndim - 2))
            return jnp.asarray(
                np.where(there, np.asarray(x)[trial[:, None], index], np.nan)
            )

        fields = lambda x: (x.ts, x.values, x.sigma, x.covariance)  # noqa: E731
        new = tuple(map(taken, fields(record)))
        return eqx.tree_at(fields, record, new, is_leaf=lambda x: x is None)

    return tuple(map(cut, records)), trial


class _Observed(NamedTuple):
    """What segments tell of their states, and the most that one turns between samples [rad]."""

    data: _Data | None
    has_attitude: bool
    turn: float


@np.errstate(all="ignore")  # values that are bad or out of range
def _observed(system: RigidBody, records: tuple[Record, ...]) -> _Observed:
    records = on_host(records)
    samples = samples_of(records, np.ones((), records[0].values.dtype))
    readings = direct_readings_of(records, samples, None)
    judge((system,), records, None, None, readings, throw=True)
    if readings is None:
        return _Observed(None, False, 0.0)
    trial = np.arange(len(readings.ts))
    first = np.argmax(readings.valid, axis=1)
    if readings.attitude is None:
        attitude = np.tile(np.eye(1, 4, dtype=samples.ts.dtype), (len(trial), 1))
    else:
        attitude = readings.attitude[trial, first]
    data = _Data(samples, State(attitude, readings.omega[trial, first]))
    return _Observed(data, readings.attitude is not None, longest_turn(readings))


def _prepared(
    system: RigidBody, records: tuple[Record, ...]
) -> tuple[_Data, bool, int]:
    """Segments, whether the attitude matters, and steps between two samples."""
    seen = _observed(system, records)
    depends_on_attitude = any(
        x.sensor.depends_on_attitude for x in records
    ) or needs_attitude(system)
    inside = system.with_parts(State(jnp.zeros(4), jnp.zeros(3))).internal is not None
    if seen.data is None or inside or (depends_on_attitude and not seen.has_attitude):
        raise ValueError(
            "Argument `observations` must tell the whole state, rates and, where a torque or a "
            "sensor looks at them, attitudes, and no part may move inside the body, but it is not "
            "so."
        )
    demand(
        bool(
            np.min(np.sum(seen.data.samples.weight, axis=(1, 2)))
            > (6 if depends_on_attitude else 3)
        ),
        "Argument `observations` must hold more numbers in each trial, and `segment` in each "
        "segment, than a state has, but one does not.",
    )
    return seen.data, depends_on_attitude, max(1, int(np.ceil(seen.turn / _TURN)))


@quick_jit
def _epoch(
    setting: _Setting,
    params: Any,
    memory: Any,
    key: Array,
    rest: Any,
    sensors: Any,
    data: _Data,
    trained: Array,
    judged: Array,
) -> tuple[Any, Any, Array, Array]:
    """Parameters and optimiser after each batch; mean loss on the way; validation loss before."""

    def loss(params: Any, index: Array) -> Array:
        some = jtu.tree_map(lambda x: x[index], data)
        of_one = lambda x: _chi_square(setting, params, rest, sensors, x)  # noqa: E731
        squares, freedom = jax.vmap(of_one)(some)
        return jnp.sum(squares) / jnp.sum(freedom)

    def step(carry: tuple[Any, Any], index: Array) -> tuple[tuple[Any, Any], Array]:
        params, memory = carry
        value, slope = jax.value_and_grad(loss)(params, index)
        with jax.numpy_dtype_promotion("standard"):  # optax mixes types
            updates, memory = setting.optimizer.update(slope, memory, params)
            params = eqx.apply_updates(params, updates)
        return (params, memory), value

    count = trained.size // setting.batch * setting.batch
    order = jax.random.permutation(key, trained)[:count].reshape(-1, setting.batch)
    before = loss(params, judged)
    (params, memory), losses = jax.lax.scan(step, (params, memory), order)
    return params, memory, jnp.mean(losses), before


def _chi_square(
    setting: _Setting, params: Any, rest: Any, sensors: Any, data: _Data
) -> tuple[Array, Array]:
    """Squares of a segment at the state that fits it best, and degrees of freedom."""
    guess = data.guess
    options = Options(
        False, setting.depends_on_attitude, motion=partial(_motion, setting)
    )

    def rows(params: Any, move: Array) -> Array:
        system, attitude = eqx.combine(params, rest), guess.attitude
        if setting.depends_on_attitude:
            attitude = multiply(attitude, exp(move[3:]))
        state = State(attitude, guess.omega + move[:3])
        shown = shown_by(
            options, system, sensors, state, data.samples.ts[0], data.samples
        )
        return whitened(sensors, data.samples, shown).reshape(-1)

    # The slope in the parameters at the best state is that with the state held.
    still = jax.lax.stop_gradient(params)

    def newton(_: Any, move: Array) -> Array:
        slopes, left = jax.jacfwd(lambda x: (rows(still, x),) * 2, has_aux=True)(move)
        normal = product("ni,nj->ij", slopes, slopes)
        normal = normal + _RIDGE * jnp.trace(normal) * jnp.eye(
            move.size, dtype=move.dtype
        )
        return move - jnp.linalg.solve(normal, product("ni,n->i", slopes, left))

    none = jnp.zeros(6 if setting.depends_on_attitude else 3, guess.omega.dtype)
    move = jax.lax.fori_loop(0, _NEWTON, newton, none)
    return jnp.sum(rows(params, move) ** 2), jnp.sum(data.samples.weight) - move.size


def _motion(
    setting: _Setting, system: RigidBody, state: State, ts: Array, t0: Array
) -> State:
    """States at the times, of which the first is that of the state."""
    del t0

    def gap(before: State, times: tuple[Array, Array]) -> tuple[State, State]:
        start, end = times
        after = forced_flow(
            system,
            before,
            start,
            end,
            setting.depends_on_attitude,
            _METHOD,
            setting.steps,
        )
        return after, after

    _, later = jax.lax.scan(gap, state, (ts[:-1], ts[1:]))
    return jtu.tree_map(lambda a, b: jnp.concatenate([a[None], b]), state, later)
