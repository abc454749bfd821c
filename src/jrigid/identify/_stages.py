"""The way of a fit: its stages, what links and rows weigh in each, and the unmodelled torque."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jrigid._numerics import product
from jrigid.identify._layout import Layout
from jrigid.identify._residuals import Args, Options
from jrigid.identify._shapes import Fixed, Flat, is_near_flat
from jrigid.identify._smoother import Found, Rows, blocks_of, eliminated, reduced

GATE = 5.0  # standard deviations of chi-square
ACCURACY = 1e-6  # of the sum of squares a step would gain: a thousandth of the standard errors
_ROUGH = 0.3  # ... where a stage only has to start the next one
# Weights of the links, in units of the noise; and a slower way for fits that went wrong.
_WEIGHTS = {True: (1.0, 30.0, 1e3), False: (1.0, 10.0, 100.0, 1e3, 1e4)}
_SLOW = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4)
_IN_A_STAGE = 15
_LEVELS = 40  # stages in which the level of a torque is sought
_FACES = 4.0  # where Cauchy's loss bends, in units of the noise, squared, of each number
_REJECTED = 16.0  # whitened square of a sample, above its degrees of freedom, that is no noise
_SPOILT = 0.25  # fraction of samples rejected that gives a throw up
FAINT = 1e-4  # of the level that links of weight 1 stand for: no torque at all
_FLAT = 1e-3  # how far off a fit is that ended at a boundary
_MAD = 1.4826  # standard deviations of a normal number in its median size


class Stage(NamedTuple):
    """One minimisation; all stages of a fit have an axis in front, and its attempts another."""

    weight: Any  # of the links, in units of the noise; of a level sought, how far it has come
    horizon: Any  # how much of each record takes part
    whole: Any  # from one state a throw
    fresh: Any  # rows have changed
    soft: Any  # Cauchy's loss
    reject: Any  # samples too far off are left out from here on
    last: Any
    steps: Any
    enough: Any


def schedule(options: Options, dtype: Any) -> Stage:
    """The stages of each attempt."""
    robust, slow, stage = options.robust, (2 * _IN_A_STAGE, _ROUGH), (_IN_A_STAGE, _ROUGH)
    end = (options.max_steps, ACCURACY)

    def linked(weights: tuple[float, ...], effort: tuple[int, float]) -> list[Stage]:
        return [
            Stage(w, 2.0, False, i == 0, robust, False, False, *effort)
            for i, w in enumerate(weights)
        ]

    last = Stage(1.0, 2.0, True, True, robust, False, True, *end)
    if options.dense:
        count = _LEVELS if options.level != "known" else 6
        way = tuple(float(x) for x in np.linspace(0, 1, count))
        attempts = [[*linked(way, (8, 1e-2)), last._replace(whole=False, fresh=False)]] * 2
    elif not options.shooting:
        early = [2.0**-k for k in range(options.doublings, 0, -1)]
        first = [last._replace(horizon=x, steps=_IN_A_STAGE, last=False) for x in early]
        attempts = [[*(x._replace(fresh=i == 0) for i, x in enumerate(first)),
                     last._replace(fresh=not first)]]  # fmt: skip
    else:
        weights = (_WEIGHTS[options.free_motion], _SLOW)
        if dtype == jnp.float32:  # whose squares end at 1e7
            weights = tuple(tuple(min(w, 100.0) for w in x) for x in weights)
        attempts = [linked(w, x) for w, x in zip(weights, (stage, slow), strict=True)]
        if options.free_motion:
            attempts = [[*x, last] for x in attempts]
        else:
            attempts = [[*x[:-1], last._replace(weight=x[-1].weight, whole=False, fresh=False)]
                        for x in attempts]  # fmt: skip
    if robust:
        attempts = [[*x, x[-1]._replace(soft=False, reject=True, fresh=False)] for x in attempts]
    longest = max(map(len, attempts))
    none = last._replace(steps=0, last=False, fresh=False)
    attempts = [[none] * (longest - len(x)) + x for x in attempts]
    flat = [jnp.asarray([[s[i] for s in x] for x in attempts]) for i in range(len(last))]
    return Stage(*(x.astype(dtype) if x.dtype == jnp.float64 else x for x in flat))


def parts_of(args: Args, rows: Array) -> list[Array]:
    """Of each record (throws, n, d, ...), of rows of the record."""
    parts, end = [], 0
    for x in args.samples:
        count = x.weight.shape[1] * x.weight.shape[2]
        part = rows[:, end : end + count]
        parts.append(part.reshape(*x.weight.shape, *rows.shape[2:]))
        end += count
    return parts


def scales_of(options: Options, args: Args, found: Found, kept: tuple[Array, ...]) -> Array:
    """By how much residuals exceed the noise stated, in the median; of noise not stated, at all."""
    scales = []
    for part, weight in zip(parts_of(args, found.rows.residual), kept, strict=True):
        size = jnp.where((weight[..., None] > 0) & (part != 0), jnp.abs(part), jnp.nan)
        scales.append(_MAD * jnp.nanmedian(size))
    scale = jnp.where(found.fresh | ~jnp.isfinite(jnp.stack(scales)), 1.0, jnp.stack(scales))
    return jnp.maximum(scale, 1.0) if options.noise_known else scale


def weigher(
    options: Options,
    args: Args,
    layout: Layout,
    kept: tuple[Array, ...],
    scales: Array,
    stage: Stage,
) -> Callable[[Rows], tuple[Array, Array]]:
    """Weights of rows, and their sum of squares, or what stands for it."""
    since, start = [], 0
    for x in args.samples:
        since.append(layout.since[:, start : start + x.ts.shape[1]])
        start += x.ts.shape[1]

    def weigh(rows: Rows) -> tuple[Array, Array]:
        weights, cost = [], jnp.zeros((), rows.residual.dtype)
        parts = parts_of(args, rows.residual)
        for i, (part, weight) in enumerate(zip(parts, kept, strict=True)):
            within = weight * (since[i] <= stage.horizon).astype(part.dtype)
            square, soft = jnp.sum(part * part, axis=-1), _FACES * part.shape[-1]
            if options.robust:
                soft = soft * scales[i] ** 2
                root = jnp.where(stage.soft, 1 / (1 + square / soft), 1.0)
                square = jnp.where(stage.soft, soft * jnp.log1p(square / soft), square)
                within, cost = root * within, cost + jnp.sum(square * within)
            else:
                cost = cost + jnp.sum(square * within)
            weights.append(jnp.repeat(within, part.shape[-1], axis=1))
        # What is known beforehand; then what holds a fit near its start at first.
        rest = rows.residual[:, sum(x.shape[1] for x in weights) :]
        held = args.unknowns.size - args.unknowns.slices["scale"].stop
        early = (stage.horizon < 1).astype(rest.dtype)
        weight = jnp.ones_like(rest).at[:, rest.shape[1] - held :].set(early)
        cost = cost + jnp.sum(weight * rest * rest)
        return jnp.concatenate([*weights, weight], axis=1), cost

    return weigh


def rejected(args: Args, rows: Rows, kept: tuple[Array, ...], scales: Array) -> tuple[Array, ...]:
    """Which samples are kept of those that were, by how far off they are."""
    found = []
    parts = parts_of(args, rows.residual)
    for part, weight, scale in zip(parts, kept, scales, strict=True):
        square = jnp.sum(part * part, axis=-1) / scale**2
        good = square < part.shape[-1] + _REJECTED
        bad = jnp.sum(jnp.where(good, 0.0, weight), axis=1) > _SPOILT * jnp.sum(weight, axis=1)
        found.append(jnp.where(good & ~bad[:, None], weight, 0.0))
    # A throw given up by one kind of observation is given up by all.
    left, had = (jnp.stack([jnp.any(w > 0, axis=1) for w in x]) for x in (found, kept))
    spoilt = jnp.any(had & ~left, axis=0)
    return tuple(w * (~spoilt).astype(w.dtype)[:, None] for w in found)


def link_whitener(
    options: Options, args: Args, layout: Layout, numbers: Array, weight: Array, level: Array
) -> Array:
    """What turns gaps of links (throws, nodes, local) into units of what they are allowed.

    Between nodes dt apart a white torque of spectral density s^2 makes a random walk of the
    momentum, s sqrt(dt), and of its integral.
    """
    linked = layout.linked.astype(level.dtype)
    dt = jnp.where(layout.linked, layout.end - layout.start, 1.0)
    locals_ = 6 if options.on_attitude else 3
    if not options.dense:
        noise = jnp.diag(weight / args.noise[:locals_])
        return product("ts,ij->tsij", linked, noise)
    tensors = jax.vmap(lambda body: args.unknowns.inertia(numbers, body))(args.bodies)
    of_rate = product("ts,i,tij->tsij", linked / jnp.sqrt(dt), 1 / level, tensors)
    if locals_ == 3:
        return of_rate
    none, root12 = jnp.zeros_like(of_rate), 12**0.5
    of_turn = of_rate * root12 / dt[..., None, None]
    lower = jnp.concatenate([-root12 / 2 * of_rate, of_turn], axis=-1)
    return jnp.concatenate([jnp.concatenate([of_rate, none], axis=-1), lower], axis=-2)


def first_level(args: Args, layout: Layout, numbers: Array) -> Array:
    """The torque's level that moves a rate by its noise from node to node."""
    span = jnp.sum(jnp.where(layout.linked, layout.end - layout.start, 0.0))
    mean = span / jnp.maximum(jnp.sum(layout.linked), 1).astype(span.dtype)
    size = jnp.trace(args.unknowns.inertia(numbers)) / 3
    level = args.noise[0] * size / jnp.sqrt(jnp.where(mean > 0, mean, 1.0))
    return jnp.broadcast_to(level, (3,))


class Evidence(NamedTuple):
    """What a record says of the level of an unmodelled torque, of each axis.

    `squares` of the whitened kicks; how many of them the record tells, `effective`; and the
    information about the logarithm of the level squared.
    """

    squares: Array
    effective: Array
    information: Array

    def errors(self, options: Options, level: Array) -> Array:
        """Of the level."""
        information = self.information
        if options.level != "estimate per axis":
            information = jnp.broadcast_to(jnp.sum(information), (3,))
        return 0.5 * level / jnp.sqrt(jnp.maximum(information, 1e-12))


def misfit(options: Options, args: Args, found: Found, kept: tuple[Array, ...]) -> Array:
    """0 for a fit that may be kept; else how far off it is, infinite if it is none."""
    parts = parts_of(args, found.rows.residual)
    squares = sum(jnp.sum(jnp.where(x.sign == 0, part * part, 0.0) * weight[..., None])
                  for x, part, weight in zip(args.samples, parts, kept, strict=True))  # fmt: skip
    count = sum(
        jnp.sum(x.weight * weight[..., None]) for x, weight in zip(args.samples, kept, strict=True)
    )
    freedom = jnp.maximum(count - found.point.numbers.size - 3.0 * kept[0].shape[0], 1.0)
    ratio = squares / freedom
    good = found.settled & jnp.isfinite(ratio)
    if options.noise_known and not options.robust:
        good = good & (ratio < 1 + GATE * jnp.sqrt(2 / freedom))
    off = jnp.where(jnp.isfinite(ratio), ratio, jnp.finfo(ratio.dtype).max)
    return jnp.where(good, jnp.where(is_at_boundary(args, found), _FLAT, 0.0), off)


def is_at_boundary(args: Args, found: Found) -> Array:
    """Whether a body that need not be is flat."""
    flat = jnp.asarray(False)
    for i, shape in enumerate(args.unknowns.shapes):
        if not isinstance(shape, Fixed | Flat):
            flat = flat | is_near_flat(args.unknowns.inertia(found.point.numbers, i))
    return flat


def evidence_of(
    layout: Layout,
    found: Found,
    weights: Array,
    whitener: Array,
) -> Evidence:
    """By the marginal likelihood of the smoother: -2 log p has log det of its normal equations.

    Its derivatives in the logarithm of the kicks' precision are differences: it is smooth.
    """
    count, h = found.point.own.shape[-1] + found.links.gap.shape[-1], 0.1
    gap = product("tsij,tsj->tsi", whitener, found.links.gap)
    kinds = whitener.shape[-1] // 3

    def log_determinant(shift: Array) -> Array:
        white = product("i,tsij->tsij", jnp.tile(jnp.exp(shift / 2), kinds), whitener)
        blocks = blocks_of(found.rows, found.links, weights, white)
        left = eliminated(reduced(blocks, jnp.zeros(())), count)
        return left.log_determinant + jnp.linalg.slogdet(left.numbers)[1]

    moves = h * jnp.concatenate([jnp.eye(3), -jnp.eye(3), jnp.zeros((1, 3))])
    up, down, middle = jnp.split(jax.lax.map(log_determinant, moves.astype(gap.dtype)), [3, 6])
    slope, bend = (up - down) / (2 * h), (up - 2 * middle + down) / h**2
    links = kinds * jnp.sum(layout.linked).astype(gap.dtype)
    squares = jnp.sum(gap * gap, axis=(0, 1)).reshape(kinds, 3).sum(axis=0)
    return Evidence(squares, links - slope, 0.5 * jnp.maximum(links - slope - bend, 0.0))


def next_level(options: Options, level: Array, least: Array, seen: Evidence) -> tuple[Array, Array]:
    """Fisher's scoring for the logarithm of the level; and whether it has come to rest."""
    score, information = 0.5 * (seen.squares - seen.effective), seen.information
    if options.level == "estimate":  # one for all axes
        score, information = (jnp.broadcast_to(jnp.sum(x), (3,)) for x in (score, information))
    move = jnp.clip(score / jnp.maximum(information, 1e-9), -3.0, 3.0)
    move = jnp.where(jnp.isfinite(move), move, 0.0)
    new = jnp.maximum(level * jnp.exp(move / 2), least)
    # Kicks of which less than one is told, and of those too many: there is no torque.
    none = (jnp.sum(seen.effective) < 1) & (jnp.sum(score) < 0)
    new = jnp.where(none, least, new)
    still = jnp.abs(jnp.log(new / level)) < 0.01
    return new, jnp.all(still)
