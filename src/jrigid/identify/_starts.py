"""Inertia by linear regression from rates, attitudes or a wheel: starts for a fit, not answers.

Errors of the samples stand on both sides of these equations and bias what comes out.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from jrigid._checks import (
    RESULTS,
    Findings,
    check_shape,
    float_arrays,
    nan_where,
    settle,
    whole_number,
)
from jrigid._numerics import product, safe_norm
from jrigid._types import Matrix, Readable, Real, Vector
from jrigid.dynamics import State
from jrigid.identify._layout import Told
from jrigid.identify._shapes import LogCholesky, as_tensor
from jrigid.rotation import to_matrix

_LEAST_SAMPLES = 8  # to a window
_FEW_ATTITUDES = 40  # fewer than these do without the weak form
_TIMES = "Argument `ts` must be finite and increasing, but it is not."
_FEW = "Argument `omegas` must hold four samples that are finite at least, but it holds fewer."


class LinearStart(Readable):
    """Inertia from a linear regression, and how it went.

    Attributes:
        inertia: Tensor; of trace 1 where only ratios can be known, [kg m^2] beside a known rotor.
            It need not be positive definite where the samples say little.
        singular_values: Of the regression's matrix, with columns of unit scale, descending. The
            last is the misfit where ratios are sought; those nearly as small are directions that
            the samples do not tell.
        result: `jrigid.RESULTS.successful`, or what is wrong with the samples.
        momentum: That in space which belongs to the tensor, from `momentum`; else None.
        covariance: Of (Ixx, Iyy, Izz, Ixy, Ixz, Iyz), from `gyrostat`; else None.
    """

    inertia: Matrix
    singular_values: Float[Array, " n"]
    result: Any
    momentum: Vector | None = None
    covariance: Float[Array, "6 6"] | None = None


def _momentum_matrix(omega: Array) -> Array:
    """I omega as a (3, 6) matrix times (Ixx, Iyy, Izz, Ixy, Ixz, Iyz)."""
    x, y, z = omega
    o = jnp.zeros_like(x)
    rows = [[x, o, o, y, z, o], [o, y, o, x, o, z], [o, o, z, o, x, y]]
    return jnp.stack([jnp.stack(row) for row in rows])


def _tensor(six: Array) -> Matrix:
    xx, yy, zz, xy, xz, yz = six
    return jnp.stack([jnp.stack(row) for row in ([xx, xy, xz], [xy, yy, yz], [xz, yz, zz])])


def _samples(ts: Any, omegas: Any, *others: Any) -> tuple[Findings, Bool[Array, " n"], list[Array]]:
    ts, omegas, *rest = float_arrays(ts, omegas, *others)
    check_shape("ts", ts, (None,))
    count = ts.shape[0]
    check_shape("omegas", omegas, (count, 3))
    if count < 4:
        raise ValueError(f"Argument `ts` must hold four times at least, but it holds {count}.")
    known = jnp.all(jnp.isfinite(omegas), axis=1)
    for other in rest:
        known = known & jnp.all(jnp.isfinite(other), axis=1)
    steps = jnp.diff(jax.lax.stop_gradient(ts))
    findings = Findings()
    increasing = jnp.all(jnp.isfinite(ts)) & jnp.all(steps > 0)
    findings.require(increasing, RESULTS.invalid_times, _TIMES)
    findings.require(jnp.sum(known) >= 4, RESULTS.invalid_state, _FEW, jnp.sum(known))
    ok = findings.ok
    ts = jnp.where(ok, ts, jnp.arange(count, dtype=ts.dtype))
    good = (ok & known)[:, None]
    return findings, known, [ts, *(jnp.where(good, x, 0.0) for x in (omegas, *rest))]


def _answer(
    findings: Findings, inertia: Matrix, singular_values: Array, momentum: Vector | None = None
) -> LinearStart:
    start = LinearStart(inertia, singular_values, findings.result, momentum)
    return nan_where(~findings.ok, start)


def _windows(
    omegas: Array, ts: Array, known: Array, windows: int, radians: float
) -> tuple[Array, Array]:
    """Weights (windows, n) of smooth bumps and of minus their slopes, for integrals over time."""
    # Samples left out are zero.
    count = jnp.maximum(jnp.sum(known), 1).astype(ts.dtype)
    speed = safe_norm(omegas.reshape(-1)) / jnp.sqrt(count)
    speed = jnp.where(speed > 0, speed, 1.0)
    span = ts[-1] - ts[0]
    typical = span / (ts.shape[0] - 1)
    width = jnp.maximum(radians / speed, _LEAST_SAMPLES * typical)
    width = jnp.minimum(width, span)
    centers = jnp.linspace(ts[0] + 0.5 * width, ts[-1] - 0.5 * width, windows)
    s = (ts[None, :] - centers[:, None]) / (0.5 * width)
    inside = jnp.abs(s) < 1
    s = jnp.where(inside, s, 1.0)
    bump = (1 - s * s) ** 4
    slope = -8 * s * (1 - s * s) ** 3 / (0.5 * width)
    step = jnp.diff(ts)
    trapezoid = 0.5 * (
        jnp.concatenate([step, jnp.zeros(1, ts.dtype)])
        + jnp.concatenate([jnp.zeros(1, ts.dtype), step])
    )
    # A window with a gap says nothing.
    whole = ~jnp.any(inside & ~known[None, :], axis=1) & (
        jnp.sum(inside, axis=1) >= _LEAST_SAMPLES // 2
    )
    weight = jnp.where(whole[:, None] & inside, trapezoid[None, :], 0.0)
    return weight * bump, -weight * slope


def _weak_rows(
    omegas: Array, ts: Array, known: Array, windows: int, radians: float
) -> tuple[Array, tuple[Array, Array]]:
    bump, fall = _windows(omegas, ts, known, windows, radians)
    matrices = jax.vmap(_momentum_matrix)(omegas)
    turned = jnp.cross(omegas[:, :, None], matrices, axis=1)
    rows = product("wn,nij->wij", fall, matrices) + product("wn,nij->wij", bump, turned)
    return rows.reshape(-1, 6), (bump, fall)


def _null_vector(rows: Array) -> tuple[Array, Array]:
    size = jnp.max(jnp.abs(jax.lax.stop_gradient(rows)))
    _, values, right = jnp.linalg.svd(rows / jnp.where(size > 0, size, 1.0), full_matrices=False)
    return right[-1], values


def _of_unit_trace(six: Array) -> Matrix:
    tensor = _tensor(six)
    trace = jnp.trace(tensor)
    return tensor / jnp.where(trace == 0, 1.0, trace)


def weak_form(
    ts: Real[ArrayLike, " n"],
    omegas: Real[ArrayLike, "n 3"],
    *,
    windows: int = 128,
    radians: float = 3.0,
    throw: bool = True,
) -> LinearStart:
    """Ratios of inertia from sampled rates of a free body, without derivatives of the samples.

    Euler's equations I omega' + omega x I omega = 0 are multiplied by smooth bumps, (1 - s^2)^4 on
    windows of some radians, and integrated by parts: linear equations for I.

    Args:
        ts: Times, increasing [s].
        omegas: Angular velocities, sensor axes [rad/s]; samples with NaN are left out, with the
            windows they are in.
        windows: How many, spread over the record.
        radians: Length of a window, in radians turned; at least eight samples.
        throw: False: bad samples give NaN and a `result` instead of an error.

    Returns:
        The tensor of trace 1 in the sensor's axes, and singular values.

    Raises:
        ValueError: Fewer than four samples.

    Gradients: those of the singular vector, where the last two singular values differ.
    Source: the weak form of system identification, D. A. Messenger, D. M. Bortz, Multiscale
    Modeling & Simulation 19 (2021) 1474.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> ts = jnp.linspace(0.0, 40.0, 801)
    >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 1.0, 0.3]))
    >>> omegas = jr.free_rotation(jnp.array([1.0, 1.7, 2.3]), start, ts).omega
    >>> tensor = jr.identify.weak_form(ts, omegas).inertia
    >>> print((jnp.diagonal(tensor) / tensor[0, 0]).round(3))
    [1.  1.7 2.3]
    """
    ts, omegas = float_arrays(ts, omegas)
    found = _weak_form(ts, omegas, whole_number("windows", windows), radians)
    return settle(found, throw, lambda: _samples(ts, omegas)[0])


@eqx.filter_jit
def _weak_form(ts: Array, omegas: Array, windows: int, radians: float) -> LinearStart:
    findings, known, (ts, omegas) = _samples(ts, omegas)
    rows, _ = _weak_rows(omegas, ts, known, windows, radians)
    six, values = _null_vector(rows)
    return _answer(findings, _of_unit_trace(six), values)


def momentum(
    ts: Real[ArrayLike, " n"],
    attitudes: Real[ArrayLike, "n 4"],
    omegas: Real[ArrayLike, "n 3"],
    *,
    throw: bool = True,
) -> LinearStart:
    """Ratios of inertia from attitudes and rates of a free body: its momentum stays in space.

    R I omega = L is linear in I and L.

    Args:
        ts: Times, increasing [s]; only their order is used.
        attitudes: Unit quaternions, body to space; samples with NaN are left out.
        omegas: Angular velocities, body components [rad/s]; likewise.
        throw: False: bad samples give NaN and a `result` instead of an error.

    Returns:
        The tensor of trace 1 in the body's axes, singular values, and the momentum in space.

    Raises:
        ValueError: Fewer than four samples.

    Gradients: those of the singular vector, where the last two singular values differ.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> ts = jnp.linspace(0.0, 40.0, 101)
    >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 1.0, 0.3]))
    >>> motion = jr.free_rotation(jnp.array([1.0, 1.7, 2.3]), start, ts)
    >>> tensor = jr.identify.momentum(ts, motion.attitude, motion.omega).inertia
    >>> print((jnp.diagonal(tensor) / tensor[0, 0]).round(3))
    [1.  1.7 2.3]
    """
    ts, attitudes, omegas = float_arrays(ts, attitudes, omegas)
    check_shape("attitudes", attitudes, (*ts.shape, 4))
    found = _momentum(ts, attitudes, omegas)
    return settle(found, throw, lambda: _samples(ts, omegas, attitudes)[0])


@eqx.filter_jit
def _momentum(ts: Array, attitudes: Array, omegas: Array) -> LinearStart:
    findings, known, (ts, omegas, attitudes) = _samples(ts, omegas, attitudes)
    identity = jnp.zeros_like(attitudes).at[:, 0].set(1)
    matrices = jax.vmap(to_matrix)(jnp.where(known[:, None], attitudes, identity))
    turned = product("nij,njk->nik", matrices, jax.vmap(_momentum_matrix)(omegas))
    size = safe_norm(omegas.reshape(-1))
    size = jnp.where(size > 0, size, 1.0) / ts.shape[0] ** 0.5
    total = jnp.broadcast_to(-jnp.eye(3, dtype=ts.dtype), (ts.shape[0], 3, 3))
    rows = jnp.concatenate([turned / size, total], axis=2)
    rows = jnp.where(known[:, None, None], rows, 0.0)
    vector, values = _null_vector(rows.reshape(-1, 9))
    trace = vector[0] + vector[1] + vector[2]
    scale = 1 / jnp.where(trace == 0, 1.0, trace)
    return _answer(findings, _of_unit_trace(vector[:6]), values, vector[6:] * size * scale)


def gyrostat(
    ts: Real[ArrayLike, "*throws n"],
    omegas: Real[ArrayLike, "*throws n 3"],
    rotor: Real[ArrayLike, "*throws n 3"],
    *,
    windows: int = 128,
    radians: float = 3.0,
    throw: bool = True,
) -> LinearStart:
    """The whole inertia tensor, scale included, from rates beside a rotor of known momentum.

    The weak form of I omega' + h' + omega x (I omega + h) = 0, solved by least squares over all
    throws. Short windows do best where something smooth is not modelled.

    Args:
        ts: Times, increasing [s]; of throws, shorter ones end in NaN.
        omegas: Angular velocities, sensor axes [rad/s]; samples with NaN are left out.
        rotor: Momentum h of the rotor about its own axis, same axes [kg m^2/s]; likewise.
        windows: How many, spread over each record.
        radians: Length of a window, in radians turned; at least eight samples.
        throw: False: bad samples give NaN and a `result` instead of an error.

    Returns:
        The tensor [kg m^2], singular values, and errors by how throws, or the parts of a single
        one, scatter.

    Raises:
        ValueError: Fewer than four samples.

    Gradients: those of the least-squares solution, where it is unique.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> wheel = jr.torques.Rotor(lambda t: jnp.array([0.0, 0.0, 0.5 * t]))
    >>> body, ts = jr.RigidBody(jnp.array([1.0, 1.7, 2.3]), wheel), jnp.linspace(0.0, 20.0, 801)
    >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 1.0, 0.3]))
    >>> omegas = jr.simulate(body, start, ts).states.omega
    >>> h = jnp.stack([0 * ts, 0 * ts, 0.5 * ts], axis=1)
    >>> print(jnp.diagonal(jr.identify.gyrostat(ts, omegas, h).inertia).round(2))
    [1.  1.7 2.3]
    """
    ts, omegas, rotor = float_arrays(ts, omegas, rotor)
    check_shape("rotor", rotor, (*ts.shape, 3))
    check_shape("omegas", omegas, (*ts.shape, 3))
    if ts.ndim == 1:
        ts, omegas, rotor = ts[None], omegas[None], rotor[None]
    check_shape("ts", ts, (None, None))
    found = _gyrostat(ts, omegas, rotor, whole_number("windows", windows), radians)

    def findings() -> Findings:
        found = Findings()
        for t, w, h in zip(ts, omegas, rotor, strict=True):
            each = _samples(_filled(t), w, h)[0]
            for x in each.all:
                found.require(~x.failed, RESULTS.invalid_state, x.message, x.value)
        return found

    return settle(found, throw, findings)


def _filled(ts: Array) -> Array:
    """Times with an end of NaN, which pads, filled up."""
    last = jnp.nanmax(jnp.where(jnp.isfinite(ts), ts, -jnp.inf))
    late = jnp.arange(ts.size, dtype=ts.dtype) * jnp.maximum(jnp.abs(last), 1.0)
    return jnp.where(jnp.isnan(ts), last + late, ts)


@eqx.filter_jit
def _gyrostat(ts: Array, omegas: Array, rotor: Array, windows: int, radians: float) -> LinearStart:
    def of_throw(ts: Array, omegas: Array, rotor: Array) -> tuple[Any, ...]:
        # Padding repeats the last time: such samples weigh nothing.
        findings, known, (_, omegas, rotor) = _samples(_filled(ts), omegas, rotor)
        ts = jnp.where(jnp.isnan(ts), jnp.nanmax(ts), ts)
        rows, (bump, fall) = _weak_rows(omegas, ts, known, windows, radians)
        given = product("wn,ni->wi", fall, rotor)
        given = given + product("wn,ni->wi", bump, jnp.cross(omegas, rotor))
        return findings.result._value, rows, -given.reshape(-1)

    codes, rows, right = jax.vmap(of_throw)(ts, omegas, rotor)
    size = jnp.max(jnp.abs(jax.lax.stop_gradient(rows)))
    size = jnp.where(size > 0, size, 1.0)
    flat = rows.reshape(-1, 6) / size
    left, values, vt = jnp.linalg.svd(flat, full_matrices=False)
    told = values > jnp.finfo(values.dtype).eps * 64 * values[0]
    inverse = jnp.where(told, 1 / jnp.where(told, values, 1.0), 0.0)
    pseudo = product("kj,k,rk->jr", vt, inverse, left)
    six = product("jr,r->j", pseudo, right.reshape(-1) / size)
    misfit = right.reshape(-1) / size - product("rj,j->r", flat, six)
    # Errors of neighbouring windows hang together: throws, or eight parts of one, are independent.
    clusters = codes.shape[0] if codes.shape[0] > 1 else 8
    whole = misfit.size // clusters * clusters
    shift = (pseudo * misfit[None])[:, :whole].reshape(6, clusters, -1).sum(axis=-1)
    covariance = product("ik,jk->ij", shift, shift) * clusters / (clusters - 1)
    bad = jnp.max(codes)
    start = LinearStart(_tensor(six), values, _result_of(bad), None, covariance)
    return nan_where(bad != 0, start)


def _result_of(code: Array) -> Any:
    result: Any = RESULTS.successful
    return eqx.tree_at(lambda x: x._value, result, code)


def linear_starts(
    options: Any, unknowns: Any, told: Told | None, bodies: Array, given: Array | None
) -> Array:
    """Tensors of each body (attempts, bodies, 3, 3) to start from, one attempt after the other."""
    dtype, count = unknowns.rate.dtype, len(unknowns.shapes)
    known = as_tensor(unknowns.original(0)[0].inertia.astype(dtype))
    sought = any(x.names and not isinstance(x, LogCholesky) for x in unknowns.shapes)
    if given is not None or told is None or not sought or options.motion is not None:
        tensor = known if given is None else given.astype(dtype)
        first = jnp.broadcast_to(tensor, (count, 3, 3))
        return jnp.stack([first, _rounder(first)])
    torques = None if options.free_motion else _torques(unknowns, told)
    attitudes = told.attitude if options.free_motion and told.ts.shape[1] < _FEW_ATTITUDES else None
    trace = None if unknowns.scaled and not options.free_motion else jnp.trace(known)

    def start(body: Array) -> tuple[Array, Array]:
        there = told.there & (bodies == body)[:, None]
        return _linear_start(told.ts, there, told.omega, attitudes, torques, trace, known)

    firsts, leaning = jax.vmap(start)(jnp.arange(count))
    other = _rounder(leaning) if trace is not None else leaning
    first = leaning if trace is not None else firsts
    return jnp.concatenate([first[None], other[None], _plain_bodies(told, leaning)])


def _rounder(tensors: Array) -> Array:
    """Of bodies half way to a sphere."""
    sphere = lambda x: jnp.trace(x) / 3 * jnp.eye(3, dtype=x.dtype)  # noqa: E731
    return jax.vmap(lambda x: 0.5 * (x + sphere(x)))(tensors)


def _plain_bodies(told: Told, like: Array) -> Array:
    """A sphere, and bodies of revolution along the axes of the rates, as large as those given."""
    shown = jnp.where(told.there[..., None], told.omega, 0.0)
    axes = jnp.linalg.eigh(product("tni,tnj->ij", shown, shown))[1]
    shapes = jnp.concatenate([jnp.ones((1, 3)), 1 - 0.5 * jnp.eye(3), 1 + 0.5 * jnp.eye(3)])
    tensors = product("ik,sk,jk->sij", axes, shapes.astype(axes.dtype), axes)
    return jax.vmap(lambda x: jax.vmap(lambda y: x * jnp.trace(y) / jnp.trace(x))(like))(tensors)


def _torques(unknowns: Any, told: Told) -> Array:
    """As they are at the samples, by what is known of the system beforehand."""
    unit = jnp.zeros((*told.ts.shape, 4), told.ts.dtype).at[..., 0].set(1)
    attitude = unit if told.attitude is None else told.attitude
    throws = [unknowns.original(i)[0] for i in range(told.ts.shape[0] * any(unknowns.stacked))]

    def of_throw(system: Any, ts: Array, q: Array, w: Array) -> Array:
        at = lambda t, q, w: jnp.asarray(system.torque_on(t, State(q, w), None), w.dtype)  # noqa: E731
        return jax.vmap(at)(ts, q, w)

    seen = told.ts, attitude, told.omega
    if throws:
        parts = zip(throws, *seen, strict=True)
        return jnp.stack([of_throw(*x) for x in parts])
    system = unknowns.original(0)[0]
    return jax.vmap(lambda *x: of_throw(system, *x))(*seen)


def _linear_start(
    ts: Array,
    known: Array,
    omegas: Array,
    attitudes: Array | None,
    torques: Array | None,
    trace: Array | None,
    like: Array,
    windows: int = 128,
) -> tuple[Array, Array]:
    """Tensors from throws of one body, samples (throws, n): of a given trace, or, None, of any.

    By attitudes, if there are any, R I omega is constant in each throw of a free body; else the
    weak form, torques as they are at the samples. The first is the least-squares solution; the
    second leans to a sphere where the record says little.
    """
    shown = known[..., None]
    omegas = jnp.where(shown, omegas, 0.0)
    given = jnp.zeros_like(omegas) if torques is None else jnp.where(shown, torques, 0.0)
    if attitudes is None:

        def of_throw(t: Array, ok: Array, omega: Array, torque: Array) -> tuple[Array, Array]:
            # Samples that are not there repeat a time; they weigh nothing.
            t = jax.lax.cummax(jnp.where(ok, t, -jnp.inf))
            t = jnp.where(jnp.isfinite(t), t, jnp.min(jnp.where(jnp.isfinite(t), t, jnp.inf)))
            rows, (bump, _) = _weak_rows(omega, t, ok, windows, 3.0)
            return rows, product("wn,ni->wi", bump, torque).reshape(-1)

        rows, right = jax.vmap(of_throw)(ts, known, omegas, given)
    else:
        turned = product(
            "tnij,tnjk->tnik",
            jax.vmap(jax.vmap(to_matrix))(attitudes),
            jax.vmap(jax.vmap(_momentum_matrix))(omegas),
        )
        weight = shown[..., None].astype(ts.dtype)
        count = jnp.maximum(jnp.sum(weight, axis=1, keepdims=True), 1.0)
        rows = weight * (turned - jnp.sum(weight * turned, axis=1, keepdims=True) / count)
        right = jnp.zeros(rows.shape[:-1], ts.dtype)
    rows, right = rows.reshape(-1, 6), right.reshape(-1)
    finite = jnp.all(jnp.isfinite(rows), axis=1) & jnp.isfinite(right)
    rows, right = jnp.where(finite[:, None], rows, 0.0), jnp.where(finite, right, 0.0)
    size = jnp.max(jnp.abs(rows))
    size = jnp.where(size > 0, size, 1.0)
    rows, right = rows / size, right / size
    sphere = jnp.asarray([1.0, 1, 1, 0, 0, 0], rows.dtype) / 3
    basis, start = jnp.eye(6, dtype=rows.dtype), jnp.zeros(6, rows.dtype)
    if trace is None:  # the sphere that does best, or one like the system's own
        along = product("ri,i->r", rows, sphere)
        square = jnp.sum(along * along)
        trace = jnp.sum(along * right) / jnp.where(square > 0, square, 1.0)
        trace = jnp.where(trace > 0, trace, jnp.trace(like))
    else:  # five directions
        third, half = 1 / 6**0.5, 1 / 2**0.5
        flat = [[third, third, -2 * third, 0, 0, 0], [half, -half, 0, 0, 0, 0]]
        basis = jnp.concatenate([jnp.asarray(flat, rows.dtype), basis[3:]])
    start = trace * sphere
    wanted = right - product("ri,i->r", rows, start)
    u, values, vt = jnp.linalg.svd(product("ri,ki->rk", rows, basis), full_matrices=False)
    along = product("rk,r->k", u, wanted)
    # The misfit of the best answer is how far rows can be trusted.
    told = values > 64 * jnp.finfo(values.dtype).eps * values[0]
    best = jnp.where(told, along, 0.0)
    floor = 2 * safe_norm(wanted - product("rk,k->r", u, best)) / trace

    def tensor(weights: Array) -> Array:
        return _tensor(start + product("k,kj,ji->i", weights, vt, basis))

    square = values * values + floor * floor
    leaning = tensor(values * along / jnp.where(square > 0, square, 1.0))
    plain = tensor(best / jnp.where(told, values, 1.0))
    good = jnp.all(jnp.linalg.eigvalsh(jnp.where(jnp.isfinite(plain), plain, 0.0)) > 0)
    return jnp.where(good, plain, leaning), leaning
