"""Inertia by linear regression, from rates, attitudes or a wheel.

The estimates are initial values for a fit: errors of the samples stand on both sides of
these equations and bias what comes out.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jrigid import rotation
from jrigid._checks import (
    RESULTS,
    Findings,
    demand,
    nan_where,
    settle,
    shaped,
    whole_number,
)
from jrigid._core.compile import small_program
from jrigid._numerics import or_one, product, rms
from jrigid._types import AnyArray, Matrix, Readable, Real, Vector
from jrigid.dynamics import State
from jrigid.identify import _host as host
from jrigid.identify._inertia_models import LogCholesky
from jrigid.identify._problem import Options
from jrigid.identify._readings import DirectReadings
from jrigid.identify._records import first_and_last
from jrigid.identify._unknowns import Unknowns

_Times = Real[ArrayLike, " n"]
_Vectors = Real[ArrayLike, "n 3"]
_LEAST_SAMPLES = 8  # to a window
_FEW_ATTITUDES = 40  # fewer than these do without the weak form
_WINDOWS = 128
_RADIANS = 3.0  # length of a window
_EDGE = 1 - 1e-5  # of a window's half width
# Weights of samples in windows that are computed together. BLAS would compute larger
# products in several threads, which wait for each other for longer than they compute.
_LARGEST_BLOCK = 2**13
_TIMES = "Argument `ts` must be finite and increasing, but it is not."
_FEW = (
    "Argument `omegas` must hold four samples that are finite at least, but it holds "
    "fewer."
)
# A tensor is `_OF_SIX` times (Ixx, Iyy, Izz, Ixy, Ixz, Iyz). The rows of `_TRACELESS`
# span tensors without a trace.
_OF_SIX = np.eye(6)[[[0, 3, 4], [3, 1, 5], [4, 5, 2]]]
_TRACELESS = np.eye(6)[1:]
_TRACELESS[:2, :3] = [[6**-0.5, 6**-0.5, -2 * 6**-0.5], [0.5**0.5, -(0.5**0.5), 0]]


class LinearEstimate(Readable):
    """Inertia from a linear regression, and how it went.

    Attributes:
        inertia: Tensor; of trace 1 where only ratios can be known, [kg m^2] beside a
            known rotor. It need not be positive definite where the samples say little.
        singular_values: Of the regression's matrix, with columns of unit scale,
            descending. The last is the misfit where ratios are sought; those nearly as
            small are directions that the samples do not tell.
        result: `jrigid.RESULTS.successful`, or what is wrong with the samples.
        momentum: That in space which belongs to the tensor, from `momentum`; else None.
        covariance: Of (Ixx, Iyy, Izz, Ixy, Ixz, Iyz), from `gyrostat`; else None.
    """

    inertia: Matrix
    singular_values: Float[Array, " n"]
    result: Any
    momentum: Vector | None = None
    covariance: Float[Array, "6 6"] | None = None


def _tensor(six: AnyArray) -> AnyArray:
    xp = six.__array_namespace__()
    return product("ijk,k->ij", xp.asarray(_OF_SIX, six.dtype), six)


def _momenta(omegas: AnyArray, turns: AnyArray | None = None) -> AnyArray:
    """I omega as matrices (..., 3, 6) times the six of the tensor.

    Args:
        omegas: Rates, body components.
        turns: Rotation matrices from body to space, for momenta in space.
    """
    xp = omegas.__array_namespace__()
    matrices = product("ijk,...j->...ik", xp.asarray(_OF_SIX, omegas.dtype), omegas)
    return matrices if turns is None else product("...ij,...jk->...ik", turns, matrices)


def _weak_rows(
    windows: int,
    radians: float,
    ts: AnyArray,
    known: AnyArray,
    omega: AnyArray,
    rotor: AnyArray,
    torque: AnyArray,
) -> AnyArray:
    """Equations (3 windows, 7) of a trial, the right side last: smooth bumps, by parts.

    Samples that are not known are zero, and repeat a time where theirs is not known.
    """
    xp = ts.__array_namespace__()
    span = ts[-1] - ts[0]
    least = _LEAST_SAMPLES * span / (ts.shape[0] - 1)
    half = or_one(
        0.5 * xp.minimum(xp.maximum(radians / rms(omega, known), least), span)
    )
    centers = xp.linspace(ts[0] + half, ts[-1] - half, windows)
    step = xp.pad(xp.diff(ts), 1)
    # Weights of the trapezium rule: half of the steps on both sides.
    samples = ts, 0.5 * (step[1:] + step[:-1]), known, omega, rotor, torque
    if not isinstance(ts, np.ndarray):
        return _rows_of_windows(centers, half, *samples)
    # Neighbouring windows together see few of the samples of a long record.
    parts = min(windows, -(-windows * ts.size // _LARGEST_BLOCK))
    rows = []
    for block in np.array_split(centers, parts):
        inside = slice(*np.searchsorted(ts, [block[0] - half, block[-1] + half]))
        rows.append(_rows_of_windows(block, half, *(x[inside] for x in samples)))
    return np.concatenate(rows)


def _rows_of_windows(
    centers: AnyArray,
    half: AnyArray,
    ts: AnyArray,
    step: AnyArray,
    known: AnyArray,
    omega: AnyArray,
    rotor: AnyArray,
    torque: AnyArray,
) -> AnyArray:
    """Equations (3 windows, 7) of windows with these centers and half widths [s]."""
    xp = ts.__array_namespace__()
    s = (ts[None] - centers[:, None]) / half
    # Samples at the very edge weigh nothing, but by rounding one that is not known,
    # such as those that fill up a record, would count as a gap.
    inside = xp.abs(s) < _EDGE
    s = xp.where(inside, s, 1.0)
    # A window with a gap says nothing.
    whole = ~xp.any(inside & ~known[None], axis=1)
    whole = (whole & (xp.sum(inside, axis=1) >= _LEAST_SAMPLES // 2))[:, None]
    weight = xp.where(whole & inside, step[None], 0.0)
    height = 1 - s * s
    cube = weight * height * height * height
    bump = cube * height
    fall = cube * 8 * s / half  # less the derivative of the bump
    # The bump vanishes at both ends, so that by parts the derivative of I omega + h
    # becomes minus one of the bump.
    parts = xp.concatenate([_momenta(omega), rotor[..., None]], axis=-1)
    turned = xp.cross(omega[..., None], parts, axis=1)
    rows = product("wn,nij->wij", fall, parts) + product("wn,nij->wij", bump, turned)
    # The angular momentum of the rotor is known and belongs on the right.
    right = product("wn,ni->wi", bump, torque) - rows[..., 6]
    return xp.concatenate([rows[..., :6], right[..., None]], axis=-1).reshape(-1, 7)


def _samples(
    padded: bool, ts: Array, *columns: Array
) -> tuple[Findings, Array, list[Array]]:
    """Findings about trials (trials, n), whether samples are known, and their values.

    Values of unknown samples are zero.
    """
    findings = Findings()
    known = jnp.all(jnp.isfinite(jnp.concatenate(columns, axis=-1)), axis=-1)
    least = jnp.min(jnp.sum(known, axis=1))
    step = jnp.diff(ts)
    rising = (step > 0) & (step < jnp.inf) | padded & jnp.isnan(ts[:, 1:])
    rising = jnp.all(rising) & jnp.all(jnp.isfinite(ts[:, 0]))
    findings.require(rising, RESULTS.invalid_times, _TIMES)
    findings.require(least >= 4, RESULTS.invalid_state, _FEW, least)
    ts = jnp.where(jnp.isnan(ts), jnp.nanmax(ts, axis=1, keepdims=True), ts)
    ts = jnp.where(findings.ok, ts, jnp.arange(ts.shape[1], dtype=ts.dtype)[None])
    good = (findings.ok & known)[..., None]
    return findings, known, [ts, *(jnp.where(good, x, 0.0) for x in columns)]


def _findings(padded: bool, *given: Array) -> Findings:
    """Findings about samples."""
    return _samples(padded, *given)[0]


@eqx.filter_jit
def _solved(
    solve: Callable[..., Any], padded: bool, size: Any, *given: Array
) -> LinearEstimate:
    """Solve by a function of samples that are known; NaN where they are not good."""
    findings, known, samples = _samples(padded, *given)
    inertia, values, *others = solve(size, known, *samples)
    return findings.guard(
        LinearEstimate(inertia, values, findings.result, *others), False
    )


def _answer(
    solve: Callable[..., Any],
    throw: bool,
    size: Any,
    ts: Any,
    padded: bool = False,
    **columns: Any,
) -> LinearEstimate:
    """Check the arguments, put an axis of trials in front of them, and solve."""
    shape = np.shape(ts)
    width = {"attitudes": 4}
    wanted = {name: (x, *shape, width.get(name, 3)) for name, x in columns.items()}
    ts, *arrays = shaped(ts=(ts, (None,), *[(None, None)] * padded), **wanted)
    count = ts.shape[-1]
    demand(
        count >= 4,
        f"Argument `ts` must hold four times at least, but it holds {count}.",
    )
    given = [ts, *arrays] if ts.ndim == 2 else [x[None] for x in (ts, *arrays)]
    estimate = _solved(solve, padded, size, *given)
    return settle(estimate, throw, _findings, padded, *given)


def _with_rows(rows: Array, unknowns: int) -> Array:
    """Equations, and rows of zeros up to as many as there are unknowns.

    A single window has three, and a decomposition of these has no null vectors.
    """
    return jnp.pad(rows, ((0, max(unknowns - rows.shape[0], 0)), (0, 0)))


def _null_vector(rows: Array) -> tuple[Array, Array]:
    """Null vector of unit trace, and the singular values."""
    rows = _with_rows(rows, rows.shape[1])
    size = or_one(jnp.max(jnp.abs(jax.lax.stop_gradient(rows))))
    _, values, right = jnp.linalg.svd(rows / size, full_matrices=False)
    trace = jnp.sum(right[-1, :3])
    return right[-1] / jnp.where(trace == 0, 1.0, trace), values


def weak_form(
    ts: _Times,
    omegas: _Vectors,
    *,
    windows: int = _WINDOWS,
    radians: float = _RADIANS,
    throw: bool = True,
) -> LinearEstimate:
    """Ratios of inertia from sampled rates of a free body.

    No derivatives of the samples are needed. Euler's equations I omega' + omega x I
    omega = 0 are multiplied by smooth bumps, (1 - s^2)^4 on windows of some radians,
    and integrated by parts. This gives linear equations for I.

    Args:
        ts: Times, increasing [s].
        omegas: Angular velocities, sensor axes [rad/s]; samples with NaN are left out,
            with the windows they are in.
        windows: How many, spread over the record.
        radians: Length of a window, in radians turned; at least eight samples.
        throw: False: bad samples give NaN and a `result` instead of an error.

    Returns:
        The tensor of trace 1 in the sensor's axes, and singular values.

    Raises:
        ValueError: Fewer than four samples.
        RuntimeError: Times that do not increase, or fewer than four finite samples.

    Gradients: those of the singular vector, where the last two singular values differ.
    Source: the weak form of system identification, D. A. Messenger, D. M. Bortz,
    Multiscale Modeling & Simulation 19 (2021) 1474.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> ts = jnp.linspace(0.0, 40.0, 801)
    >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 1.0, 0.3]))
    >>> omegas = jr.free_rotation(jnp.array([1.0, 1.7, 2.3]), start, ts).omega
    >>> tensor = jr.identify.weak_form(ts, omegas).inertia
    >>> print((jnp.diagonal(tensor) / tensor[0, 0]).round(3))
    [1.  1.7 2.3]
    """
    size = whole_number("windows", windows), radians
    return _answer(_weak_form, throw, size, ts, omegas=omegas)


def _weak_form(size: Any, known: Array, ts: Array, omegas: Array) -> tuple[Array, ...]:
    zero = jnp.zeros_like(omegas)
    rows = jax.vmap(partial(_weak_rows, *size))(ts, known, omegas, zero, zero)
    six, values = _null_vector(rows[..., :6].reshape(-1, 6))
    return _tensor(six), values


def momentum(
    ts: _Times,
    attitudes: Real[ArrayLike, "n 4"],
    omegas: _Vectors,
    *,
    throw: bool = True,
) -> LinearEstimate:
    """Ratios of inertia from attitudes and rates of a free body.

    Its angular momentum stays in space: R I omega = L is linear in I and L.

    Args:
        ts: Times, increasing [s]; only their order is used.
        attitudes: Unit quaternions, body to space; samples with NaN are left out.
        omegas: Angular velocities, body components [rad/s]; likewise.
        throw: False: bad samples give NaN and a `result` instead of an error.

    Returns:
        The tensor of trace 1 in the body's axes, singular values, and the momentum in
        space.

    Raises:
        ValueError: Fewer than four samples.
        RuntimeError: Times that do not increase, or fewer than four finite samples.

    Gradients: those of the singular vector, where the last two singular values differ.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> ts = jnp.linspace(0.0, 40.0, 101)
    >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 1.0, 0.3]))
    >>> motion = jr.free_rotation(jnp.array([1.0, 1.7, 2.3]), start, ts)
    >>> tensor = jr.identify.momentum(ts, motion.attitude, motion.omega).inertia
    >>> print((jnp.diagonal(tensor) / tensor[0, 0]).round(3))
    [1.  1.7 2.3]
    """
    return _answer(_momentum, throw, None, ts, attitudes=attitudes, omegas=omegas)


def _momentum(
    _: Any, known: Array, ts: Array, attitudes: Array, omegas: Array
) -> tuple:
    known = known[..., None]
    size = rms(omegas, jnp.isfinite(ts))
    unit = jnp.zeros_like(attitudes).at[..., 0].set(1)
    attitudes = jnp.where(known, attitudes, unit)
    turns = jnp.vectorize(rotation.to_matrix, signature="(4)->(3,3)")(attitudes)
    # Angular momenta of unit rates make the columns of the tensor as large as those of
    # the total.
    turned = _momenta(omegas, turns) / size
    total = jnp.broadcast_to(-jnp.eye(3, dtype=ts.dtype), (*ts.shape, 3, 3))
    rows = jnp.where(known[..., None], jnp.concatenate([turned, total], axis=-1), 0.0)
    vector, values = _null_vector(rows.reshape(-1, 9))
    return _tensor(vector[:6]), values, vector[6:] * size


def gyrostat(
    ts: Real[ArrayLike, "*trials n"],
    omegas: Real[ArrayLike, "*trials n 3"],
    rotor: Real[ArrayLike, "*trials n 3"],
    *,
    windows: int = _WINDOWS,
    radians: float = _RADIANS,
    throw: bool = True,
) -> LinearEstimate:
    """The whole inertia tensor, scale included, from rates beside a known rotor.

    The weak form of I omega' + h' + omega x (I omega + h) = 0, solved by least squares
    over all trials. Short windows do best where something smooth is not modelled.

    Args:
        ts: Times, increasing [s]; of trials, shorter ones end in NaN.
        omegas: Angular velocities, sensor axes [rad/s]; samples with NaN are left out.
        rotor: Momentum h of the rotor about its own axis, same axes [kg m^2/s];
            likewise.
        windows: How many, spread over each record.
        radians: Length of a window, in radians turned; at least eight samples.
        throw: False: bad samples give NaN and a `result` instead of an error.

    Returns:
        The tensor [kg m^2], singular values, and errors by how trials, or the parts of
        a single one, scatter. The errors are NaN where the equations, three for each
        window, are no more than the six unknowns.

    Raises:
        ValueError: Fewer than four samples.
        RuntimeError: Times that do not increase, or fewer than four finite samples.

    Gradients: those of the least-squares solution, where it is unique.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> wheel = jr.torques.Rotor(lambda t: jnp.array([0.0, 0.0, 0.5 * t]))
    >>> body = jr.RigidBody(jnp.array([1.0, 1.7, 2.3]), wheel)
    >>> ts = jnp.linspace(0.0, 20.0, 801)
    >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 1.0, 0.3]))
    >>> omegas = jr.simulate(body, start, ts).states.omega
    >>> h = jnp.stack([0 * ts, 0 * ts, 0.5 * ts], axis=1)
    >>> print(jnp.diagonal(jr.identify.gyrostat(ts, omegas, h).inertia).round(2))
    [1.  1.7 2.3]
    """
    size = whole_number("windows", windows), radians
    return _answer(_gyrostat, throw, size, ts, padded=True, omegas=omegas, rotor=rotor)


def _gyrostat(size: Any, known: Array, ts: Array, omegas: Array, rotor: Array) -> tuple:
    trials = ts.shape[0]
    windows, _ = size
    rows_of_trials = jax.vmap(partial(_weak_rows, *size))
    rows = rows_of_trials(ts, known, omegas, rotor, jnp.zeros_like(rotor))
    rows = rows.reshape(-1, 7)
    rows = _with_rows(rows, 6)
    rows = rows / or_one(jnp.max(jnp.abs(jax.lax.stop_gradient(rows[:, :6]))))
    left, values, vt, determined = _singular(rows[:, :6])
    inverse = jnp.where(determined, 1 / jnp.where(determined, values, 1.0), 0.0)
    half = vt.T * inverse[None]
    six = product("jk,rk,r->j", half, left, rows[:, 6])
    misfit = rows[:, 6] - product("rj,j->r", rows[:, :6], six)
    # Errors of neighbouring windows hang together: trials, or eight parts of one, are
    # independent.
    clusters = trials if trials > 1 else min(8, windows)
    whole = misfit.size // clusters * clusters
    parts = (left * misfit[:, None])[:whole].reshape(clusters, -1, 6).sum(axis=1)
    shift = product("jk,ck->jc", half, parts)
    covariance = product("ic,jc->ij", shift, shift) * clusters / max(clusters - 1, 1)
    # Equations that are no more than the unknowns leave no misfit to scatter.
    equations = jnp.sum(jnp.any(rows != 0, axis=1))
    covariance = nan_where(equations <= 6, covariance)
    return _tensor(six), values, None, covariance


def _singular(rows: AnyArray) -> tuple[AnyArray, ...]:
    """The decomposition, and which values are more than rounding."""
    xp = rows.__array_namespace__()
    left, values, vt = xp.linalg.svd(rows, full_matrices=False)
    return left, values, vt, values > 64 * xp.finfo(values.dtype).eps * values[0]


def linear_starts(
    options: Options,
    unknowns: Unknowns,
    readings: DirectReadings | None,
    given: np.ndarray | None,
) -> np.ndarray:
    """Tensors to start from (attempts, 3, 3), one attempt after the other.

    From attitudes, if there are few, since R I omega is constant in each trial of a
    free body; else from the weak form, with torques as they are at the samples.

    Args:
        options: Of the fit.
        unknowns: What is sought.
        readings: Rates, and attitudes if there are any, that the record tells.
        given: A tensor to start from, if there is one.
    """
    dtype = unknowns.rate.dtype
    known = unknowns.known_tensor.astype(dtype)
    model = unknowns.inertia_model
    linear = bool(model.names) and not isinstance(model, LogCholesky)
    if (
        given is not None
        or readings is None
        or not linear
        or options.motion is not None
    ):
        # Without linear equations the search begins at the tensor that is given or
        # known, and then half way to a sphere.
        first = known if given is None else given.astype(dtype)
        return np.stack([first, _rounder(first)])
    free = options.free_motion
    if free and readings.attitude is not None and readings.ts.shape[1] < _FEW_ATTITUDES:
        rows = _rows_of_attitudes(readings)
    else:
        rows = _rows_of_rates(
            readings, None if free else _torques_at(unknowns, readings)
        )
    # A torque or a square may be out of range.
    rows = np.where(np.isfinite(rows), rows, 0.0)
    trace = None if unknowns.scaled and not free else np.trace(known)
    plain, leaning = _least_squares(rows, trace, np.trace(known))
    both = [plain, leaning] if trace is None else [leaning, _rounder(leaning)]
    return np.concatenate([np.stack(both), _plain_bodies(readings, leaning)])


def _rows_of_rates(readings: DirectReadings, torques: np.ndarray | None) -> np.ndarray:
    """Equations (n, 7) of the weak form, of all trials."""
    is_known = readings.valid[..., None]
    zero = np.zeros_like(readings.omega)
    omegas = np.where(is_known, readings.omega, zero)
    torques = zero if torques is None else np.where(is_known, torques, zero)
    # Times of samples that are not known repeat one.
    first = first_and_last(readings.ts, readings.valid)[0]
    times = np.where(readings.valid, readings.ts, first[:, None])
    times = np.maximum.accumulate(times, axis=1)
    trials = zip(times, readings.valid, omegas, zero, torques, strict=True)
    return np.concatenate([_weak_rows(_WINDOWS, _RADIANS, *x) for x in trials])


def _rows_of_attitudes(readings: DirectReadings) -> np.ndarray:
    """Equations (n, 7): the momentum in space at a sample is the trial's mean one."""
    assert readings.attitude is not None
    weight = readings.valid[..., None, None].astype(readings.omega.dtype)
    turned = weight * _momenta(readings.omega, host.to_matrix(readings.attitude))
    count = np.maximum(np.sum(weight, axis=1, keepdims=True), 1.0)
    mean = np.sum(turned, axis=1, keepdims=True) / count
    rows = np.pad(turned - weight * mean, [(0, 0)] * 3 + [(0, 1)])
    return rows.reshape(-1, 7)


def _rounder(tensor: np.ndarray) -> np.ndarray:
    """The tensor of a body half way to a sphere."""
    third = np.trace(tensor) / 3
    return 0.5 * (tensor + third * np.eye(3, dtype=tensor.dtype))


def _plain_bodies(readings: DirectReadings, like: np.ndarray) -> np.ndarray:
    """A sphere, and bodies of revolution along the axes of the rates.

    They are as large as the body whose tensor is given.
    """
    shown = np.where(readings.valid[..., None], readings.omega, 0.0).reshape(-1, 3)
    # These are the principal axes of the second moments of the rates, in units of the
    # largest one, since squares of absurd readings overflow.
    largest = np.maximum(np.max(np.abs(shown), initial=0.0), np.finfo(shown.dtype).tiny)
    shown = shown / largest
    axes = np.linalg.eigh(shown.T @ shown)[1]
    # Moments in the ratios 1 : 2 : 2 and 3 : 2 : 2, each axis in turn being the odd
    # one.
    shapes = np.concatenate([np.ones((1, 3)), 1 - 0.5 * np.eye(3), 1 + 0.5 * np.eye(3)])
    shapes = (shapes / shapes.sum(axis=1, keepdims=True)).astype(axes.dtype)
    return product("ik,sk,jk->sij", axes, np.trace(like) * shapes, axes)


def _torques_at(unknowns: Unknowns, readings: DirectReadings) -> np.ndarray:
    """Torques at the samples; where attitudes are not known, at the unit quaternion."""
    attitude = readings.attitude
    if attitude is None:
        unit = np.eye(1, 4, dtype=readings.ts.dtype)[0]
        attitude = np.broadcast_to(unit, (*readings.ts.shape, 4))
    return np.asarray(_torques(unknowns, readings.ts, attitude, readings.omega))


@small_program
def _torques(
    unknowns: Unknowns, ts: AnyArray, attitude: AnyArray, omega: AnyArray
) -> Array:
    """Torques at the samples, evaluated with the initial parameters."""

    def at(trial: Array, t: Array, q: Array, w: Array) -> Array:
        system = unknowns.original(trial)[0]
        state = system.with_parts(State(q, w))
        return jnp.asarray(system.torque_on(t, state, None), w.dtype)

    of_trial = jax.vmap(at, (None, 0, 0, 0))
    return jax.vmap(of_trial)(jnp.arange(len(ts)), ts, attitude, omega)


def _least_squares(
    rows: np.ndarray, trace: np.floating | None, like: np.floating
) -> tuple[np.ndarray, np.ndarray]:
    """Tensors of a given trace, or, None, of any, from equations (n, 7).

    The first is the least-squares solution if that is a body; the second leans to a
    sphere where the record says little.
    """
    rows = rows / or_one(np.max(np.abs(rows[:, :6])))
    right = rows[:, 6]
    rows = rows[:, :6]
    sphere = np.asarray([1.0, 1, 1, 0, 0, 0], rows.dtype) / 3
    if trace is None and not np.any(right):
        # Without a known torque the equations hold for any multiple of a tensor.
        trace = like
    if trace is None:
        # The sphere that does best, or one like the system's own.
        basis = np.eye(6, dtype=rows.dtype)
        along = rows @ sphere
        best_trace = np.sum(along * right) / or_one(np.sum(along * along))
        size = best_trace if best_trace > 0 else like
    else:
        basis = np.asarray(_TRACELESS, rows.dtype)
        size = trace
    wanted = right - rows @ (size * sphere)
    left, values, vt, determined = _singular(rows @ basis.T)
    along = wanted @ left
    best = np.where(determined, along, 0.0)
    # The misfit of the best answer is how far rows can be trusted.
    misfit = wanted - left @ best
    floor = 2 * np.sqrt(np.sum(misfit * misfit)) / size

    def tensor(weights: np.ndarray) -> np.ndarray:
        return _tensor(size * sphere + weights @ vt @ basis)

    # Along a direction that the rows show less than their misfit, this stays near the
    # sphere.
    leaning = tensor(values * along / or_one(values * values + floor * floor))
    plain = tensor(best / np.where(determined, values, 1.0))
    good = np.all(np.linalg.eigvalsh(plain) > 0)
    return plain if good else leaning, leaning
