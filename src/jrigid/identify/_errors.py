"""What a fit tells: errors, what the record does not determine, and how the fit ended."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._checks import RESULTS, nan_where
from jrigid._numerics import product
from jrigid.dynamics import State
from jrigid.identify._layout import Layout
from jrigid.identify._records import Samples
from jrigid.identify._residuals import Args, Options
from jrigid.identify._result import LARGEST_ERROR, FitResult, Status
from jrigid.identify._smoother import Blocks, Found, Links, Rows, blocks_of, eliminated, reduced
from jrigid.identify._stages import (
    FAINT,
    GATE,
    evidence_of,
    first_level,
    is_at_boundary,
    link_whitener,
    parts_of,
    schedule,
    weigher,
)

_TOLD = 1e-9  # of the largest singular value: a change of the state that the record shows
_WHITE = 6.0  # standard deviations of the correlation of neighbouring residuals
_COLOURED = 0.25  # ... and its size, for residuals that are no noise
_EXPLAINED = 0.1  # of the square of the record, beyond which a misfit is none of the model's


def condensed(rows: Rows, links: Links) -> Rows:
    """Rows in the first state of each throw: along the links, as if nothing came between."""
    border = rows.of_border.shape[-1]

    def throw(rows: Rows, links: Links) -> Rows:
        local = links.gap.shape[-1]
        first = jnp.concatenate([jnp.zeros((local, border)), jnp.eye(local)], axis=1)
        first = first.astype(rows.residual.dtype)

        def follow(state: Array, link: Links) -> tuple[Array, Array]:
            after = product("ij,jk->ik", link.of_state, state)
            return after.at[:, :border].add(link.of_border), state

        _, states = jax.lax.scan(follow, first, links)
        through = product("rl,rlk->rk", rows.of_state, states[rows.node])
        of_border = rows.of_border + through[:, :border]
        return Rows(rows.residual, of_border, through[:, border:], jnp.zeros_like(rows.node))

    return jax.vmap(throw)(rows, links)


class Told(NamedTuple):
    """What rows tell: singular values and directions of the numbers, and covariances.

    `local` is that of a throw's first state and own numbers beside given numbers, which they
    `follow`; last the singular values of each throw's state, descending.
    """

    values: Array
    directions: Array
    covariance: Array
    local: Array
    follow: Array
    of_state: Array


def told_by_rows(rows: Rows, own: int, units: Array) -> Told:
    """By singular values of weighted rows in first states: their squares would lose digits."""
    jg = product("trg,g->trg", rows.of_border[..., own:], units)
    jl = jnp.concatenate([rows.of_state, rows.of_border[..., :own]], axis=-1)
    size, eps = jg.shape[-1], jnp.finfo(jg.dtype).eps

    def throw(jg: Array, jl: Array) -> tuple[Array, Array, Array, Array]:
        scale = jnp.sqrt(jnp.sum(jl * jl, axis=0))
        scale = jnp.where(scale > 0, scale, 1.0)
        u, s, vt = jnp.linalg.svd(jl / scale[None, :], full_matrices=False)
        told = s > _TOLD * s[0]
        u = jnp.where(told[None, :], u, 0.0)
        inverse = jnp.where(told, 1 / jnp.where(told, s, 1.0), 1 / (eps * jnp.maximum(s[0], 1.0)))
        half = vt.T * inverse[None, :] / scale[:, None]
        of_told = jnp.where(told[None, :], half, 0.0)
        follow = product("lk,rk,rg->lg", of_told, u, jg)
        rest = jg - product("rk,sk,sg->rg", u, u, jg)
        return jnp.linalg.qr(rest, mode="r") if size else rest[:0], half, follow, s

    r, half, follow, of_state = jax.vmap(throw)(jg, jl)
    return _told(r.reshape(-1, size), product("tik,tjk->tij", half, half), follow, of_state, units)


def told_by_equations(blocks: Blocks, own: int, units: Array) -> tuple[Told, Array]:
    """By the smoother's normal equations; and each throw's part of the numbers' gradient."""
    count = own + blocks.state.shape[-1]
    left = reduced(blocks, jnp.zeros((), units.dtype))
    rest = eliminated(left, count)
    inner = left.matrix[:, :count, :count]
    scale = jnp.sqrt(jnp.maximum(jnp.diagonal(inner, axis1=1, axis2=2), 1e-300))
    values, axes = jnp.linalg.eigh(inner / scale[:, :, None] / scale[:, None, :])
    values = jnp.maximum(values, jnp.finfo(units.dtype).eps)
    half = axes / jnp.sqrt(values)[:, None, :] / scale[:, :, None]
    s, axes = jnp.linalg.eigh(rest.numbers * units[:, None] * units[None, :])
    r = jnp.sqrt(jnp.maximum(s, 0.0))[:, None] * axes.T
    local = product("tik,tjk->tij", half, half)
    singular = jnp.sqrt(values)[:, ::-1]
    return _told(r, local, product("tlg,g->tlg", rest.follow, units), singular, units), rest.right


def _told(r: Array, local: Array, follow: Array, of_state: Array, units: Array) -> Told:
    """With numbers in their own units, of what is told in natural ones."""
    if units.size:
        eps = jnp.finfo(r.dtype).eps
        _, values, vt = jnp.linalg.svd(r, full_matrices=False)
        floor = jnp.maximum(values, 16 * eps * values[0] + 1e-150)
        covariance = product("ki,kj->ij", vt / floor[:, None], vt / floor[:, None])
    else:
        values, vt = jnp.zeros(0, r.dtype), jnp.zeros((0, 0), r.dtype)
        covariance = vt
    covariance = covariance * units[:, None] * units[None, :]
    follow = product("tlg,g->tlg", follow, 1 / units)
    return Told(values, vt.T, covariance, local, follow, of_state)


def conclude(
    options: Options,
    args: Args,
    layout: Layout,
    found: Found,
    kept: tuple[Array, ...],
    scales: Array,
    level: Array,
    input_result: Any,
) -> FitResult:
    """The result of a fit at a minimum."""
    unknowns, numbers, own = args.unknowns, found.point.numbers, found.point.own.shape[-1]
    units = unknowns.natural_units(numbers)
    end = jtu.tree_map(lambda x: x[0, -1], schedule(options, numbers.dtype))
    weight, _ = weigher(options, args, layout, kept, scales, end)(found.rows)
    root = jnp.sqrt(weight)[..., None]
    of_border, of_state = root * found.rows.of_border, root * found.rows.of_state
    rows = Rows(root[..., 0] * found.rows.residual, of_border, of_state, found.rows.node)
    rows = condensed(rows, found.links)
    told = sensor = told_by_rows(rows, own, units)
    scores, level_errors = _scores(rows, own, sensor.follow), jnp.zeros_like(level)
    kicks = jnp.zeros((), numbers.dtype)
    if options.dense:
        white = link_whitener(options, args, layout, numbers, end.weight, level)
        blocks = blocks_of(found.rows, found.links, weight, white)
        told, scores = told_by_equations(blocks, own, units)
        seen = evidence_of(layout, found, weight, white)
        level_errors = seen.errors(options, level)
        # Links this hard are those of no torque at all.
        level = jnp.where(level <= 1.01 * FAINT * first_level(args, layout, numbers), 0.0, level)
        kicks = jnp.sum(product("tsij,tsj->tsi", white, found.links.gap) ** 2)
    seen = _judged(options, args, found, kept, scales, told, kicks)
    pure = _is_pure(options, args, found, kept, seen.inflation)
    largest = jnp.sqrt(seen.inflation) / jnp.min(told.values, initial=jnp.inf)
    status = _status(options, args, found, seen, told, pure | (largest > LARGEST_ERROR), pure)
    status = Status.where(input_result == RESULTS.successful, status, Status.BAD_INPUT)
    had = jnp.any(jnp.stack([jnp.any(x.weight > 0, axis=(1, 2)) for x in args.samples]), axis=0)
    spoilt = had & ~jnp.any(jnp.stack([jnp.any(w > 0, axis=1) for w in kept]), axis=0)
    first = State(found.point.attitude[:, 0], found.point.omega[:, 0])
    count = sum(x.weight[0].size for x in args.samples)  # then what was known beforehand
    jacobian = jnp.concatenate([rows.of_border[..., own:], rows.of_state], axis=-1)
    result = FitResult(
        status=status, numbers=numbers, own_numbers=found.point.own,
        numbers_covariance=seen.inflation * told.covariance,
        sensor_covariance=seen.inflation * sensor.covariance,
        local_covariance=seen.inflation * told.local, follow=told.follow, scores=scores,
        inflation=seen.inflation, state=first, t0=layout.start[:, 0],
        residuals=rows.residual[:, :count], jacobian=jacobian[:, :count],
        chi_square=seen.chi_square, degrees_of_freedom=seen.freedom, unexplained=seen.unexplained,
        singular_values=told.values, directions=told.directions,
        state_singular_values=sensor.of_state, level=level, level_errors=level_errors,
        scales=scales, kept=tuple(w > 0 for w in kept), spoilt=spoilt, history=found.history,
        pure_spin=pure, input_result=input_result, unknowns=unknowns, problem=args,
        options=options,
    )  # fmt: skip
    return nan_where(input_result != RESULTS.successful, result)


def _scores(rows: Rows, own: int, follow: Array) -> Array:
    """What each throw adds to the gradient of half the squares in the numbers."""
    jl = jnp.concatenate([rows.of_state, rows.of_border[..., :own]], axis=-1)
    free = rows.of_border[..., own:] - product("trl,tlg->trg", jl, follow)
    return product("trg,tr->tg", free, rows.residual)


class _Judged(NamedTuple):
    """How well a fit describes the record."""

    chi_square: Array
    freedom: Array
    noise: Array  # chi-square for each degree of freedom
    inflation: Array  # of the covariance
    unexplained: Array  # of the square of the record
    misfit: Array  # whether that is no noise


def _judged(
    options: Options,
    args: Args,
    found: Found,
    kept: tuple[Array, ...],
    scales: Array,
    told: Told,
    kicks: Array,
) -> _Judged:
    """Of the residuals, and the squares of the kicks between nodes."""
    dtype = found.point.numbers.dtype
    squares = signal = turns = pairs = jnp.zeros((), dtype)
    count, of_state = jnp.asarray(0), told.of_state
    parts = parts_of(args, found.rows.residual)
    for x, part, keep in zip(args.samples, parts, kept, strict=True):
        weight = jnp.where(x.sign == 0, x.weight * keep[..., None], 0.0)
        squares = squares + jnp.sum(weight * part * part)
        count = count + jnp.sum(weight > 0)
        signal = signal + jnp.sum(weight * _signal(x, weight) ** 2)
        both = weight[:, 1:] * weight[:, :-1]
        turns = turns + jnp.sum(both * part[:, 1:] * part[:, :-1])
        pairs = pairs + jnp.sum(both)
    alive = jnp.any(jnp.stack([jnp.any(w > 0, axis=1) for w in kept]), axis=0)[:, None]
    shown = (of_state > _TOLD * of_state[:, :1]) & alive
    prior = found.rows.residual[:, sum(x.shape[1] * x.shape[2] for x in parts) :]
    held = args.unknowns.size - args.unknowns.slices["scale"].stop
    prior = prior[:, : prior.shape[1] - held]
    known = prior.shape[1] - args.unknowns.prior_rows(found.point.numbers).size
    freedom = count - found.point.numbers.size - jnp.sum(shown)
    freedom = freedom + prior.shape[1] + (prior.shape[0] - 1) * known
    chi_square = squares + jnp.sum(prior**2) + kicks
    noise = chi_square / jnp.maximum(freedom, 1).astype(dtype)
    mean = squares / jnp.maximum(count, 1).astype(dtype)
    like = turns / jnp.where(pairs > 0, pairs, 1.0) / jnp.where(mean > 0, mean, 1.0)
    if options.noise_known:
        gate = 1 + GATE * jnp.sqrt(2 / jnp.maximum(freedom, 1).astype(dtype))
        misfit = (noise > gate) | (jnp.max(scales) > 2)
        excess = squares + kicks - count.astype(dtype)
    else:
        misfit = (like > _COLOURED) & (like * jnp.sqrt(pairs) > _WHITE)
        excess = squares
    inflate = jnp.where(misfit, jnp.maximum(noise, 1.0), 1.0) if options.noise_known else noise
    unexplained = excess / jnp.where(signal > 0, signal, 1.0)
    return _Judged(chi_square, freedom, noise, inflate, unexplained, misfit)


def _signal(x: Samples, weight: Array) -> Array:
    """What there is to explain of values, in units of their noise: a radian, or the variation."""
    white = jnp.diagonal(x.whitener, axis1=-2, axis2=-1)
    if x.values.shape != x.weight.shape:
        return white
    total = jnp.sum(weight * white**2, axis=1, keepdims=True)
    mean = jnp.sum(weight * white**2 * x.values, axis=1, keepdims=True)
    return white * (x.values - mean / jnp.where(total > 0, total, 1.0))


def _is_pure(
    options: Options, args: Args, found: Found, kept: tuple[Array, ...], noise: Array
) -> Array:
    """Whether a constant rate in each throw describes a gyro's record as well.

    Where the rates do not vary the Fisher information at the estimate is no guide: a motion fitted
    to the noise seems to tell what the true one does not. The best of many wobbles gains something
    from any noise, the more the longer the record.
    """
    sensors = args.unknowns.original(0)[1:]
    sought = any(x.names for x in args.unknowns.shapes)
    if options.on_attitude or not sought or not all(x.width == 3 for x in sensors):
        return jnp.asarray(False)
    constant = fitted = jnp.zeros((), noise.dtype)
    count = 0
    for x, part, keep in zip(args.samples, parts_of(args, found.rows.residual), kept, strict=True):
        weight = jnp.where(x.sign == 0, x.weight * keep[..., None], 0.0)
        constant = constant + jnp.sum(weight * _signal(x, weight) ** 2)
        fitted = fitted + jnp.sum(weight * part**2)
        count = count + jnp.sum(weight)
    chance = 5 + GATE * 10**0.5 + 4 * jnp.log(jnp.maximum(count, 1.0))  # of the shape's five
    return constant - fitted < noise * chance


def _status(
    options: Options,
    args: Args,
    found: Found,
    seen: _Judged,
    told: Told,
    untold: Array,
    pure: Array,
) -> Any:
    """How the fit ended; the last word counts."""
    del options
    # A fit that creeps along a direction which the record does not tell is as good as any.
    status = Status.where(found.settled, Status.OK, Status.NOT_CONVERGED)
    status = Status.where(untold, Status.UNIDENTIFIABLE, status)
    status = Status.where(is_at_boundary(args, found), Status.AT_BOUNDARY, status)
    status = Status.where(pure, Status.UNIDENTIFIABLE, status)
    lost = Status.where(found.settled, Status.WRONG_BASIN, Status.NOT_CONVERGED)
    wrong = Status.where(seen.unexplained > _EXPLAINED, lost, Status.MISFIT)
    status = Status.where(seen.misfit, wrong, status)
    sound = jnp.all(jnp.isfinite(told.covariance)) & (seen.freedom > 0)
    sound = sound & jnp.isfinite(seen.chi_square)
    return Status.where(sound, status, Status.NOT_CONVERGED)
