"""The way of a fit: its stages, what links and rows weigh in each, and the unmodelled torque."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jrigid._numerics import or_one, product
from jrigid.identify._layout import Layout
from jrigid.identify._problem import Options, Problem
from jrigid.identify._shapes import Fixed, Flat, is_near_flat
from jrigid.identify._smoother import Found, Rows, blocks_of, eliminated, reduced

GATE = 5.0  # standard deviations of chi-square
ACCURACY = 1e-6  # of the sum of squares a step would gain: a thousandth of the standard errors
_ROUGH = 0.3  # ... where a stage only has to start the next one
# Weights of the links, in units of the noise; and a slower way for fits that went wrong.
_WEIGHTS = {True: (1.0, 30.0, 1e3), False: (1.0, 10.0, 100.0, 1e3, 1e4)}
_SLOW = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4)
_LARGEST = {8: 1e4, 4: 100.0}  # whose square is still far from the digits' end
_IN_A_STAGE = 15
_LEVELS = 40  # stages in which the level of a torque is sought
_FACES = 4.0  # where Cauchy's loss bends, in units of the noise, squared, of each number
_REJECTED = 16.0  # whitened square of a sample, above its degrees of freedom, that is no noise
_SPOILT = 0.25  # fraction of samples rejected that gives a throw up
_FAINT = 1e-4  # of the level that links of weight 1 stand for: no torque at all
_FLAT = 1e-3  # how far off a fit is that ended at a boundary
EXPLAINED = 0.3  # of the square of the record: one left over by more is not followed
_MAD = 1.4826  # standard deviations of a normal number in its median size


class Stage(NamedTuple):
    """One minimisation; all stages of a fit have an axis in front, and its attempts another."""

    weight: Any  # of the links, in units of the noise; of a level known, how far it has come
    steps: Any
    enough: Any  # what a step gains that is not worth taking
    horizon: Any = 2.0  # how much of each record takes part
    whole: Any = False  # from one state a throw
    fresh: Any = False  # rows have changed
    soft: Any = False  # Cauchy's loss
    reject: Any = False  # samples too far off are left out from here on
    last: Any = False


class Way(NamedTuple):
    """Where a search stands."""

    found: Found
    kept: Array  # 1 or 0 for each sample
    scales: Array  # of the residuals of each record, in units of the noise
    level: Array  # of the unmodelled torque
    done: Array  # the level has come to rest
    doubtful: Array  # bodies far from this one describe the record nearly as well
    wide: Array  # error of what is told least, by probes, in natural units


def schedule(options: Options, dtype: Any) -> Stage:
    """The stages of each attempt."""
    whole = not options.dense and (options.free_motion or not options.shooting)
    end = Stage(_LARGEST[dtype.itemsize], options.max_steps, ACCURACY, whole=whole, last=True)
    if options.dense:
        count = _LEVELS if options.level != "known" else 6
        way = [Stage(float(x), 8, 0.01) for x in np.linspace(0, 1, count)]
        attempts = [[*way, end._replace(weight=1.0)]] * 2
    elif not options.shooting:
        early = [2.0**-k for k in range(options.doublings, 0, -1)]
        attempts = [[*(Stage(0.0, _IN_A_STAGE, ACCURACY, horizon=x) for x in early), end]]
    else:
        ways = (_WEIGHTS[options.free_motion], _IN_A_STAGE), (_SLOW, 2 * _IN_A_STAGE)
        attempts = [
            [*(Stage(min(w, end.weight), n, _ROUGH) for w in x), end._replace(fresh=whole)]
            for x, n in ways
        ]
    attempts = [[x[0]._replace(fresh=True), *x[1:]] for x in attempts]
    attempts = [[x._replace(soft=options.robust) for x in y] for y in attempts]
    if options.robust:
        attempts = [[*x, x[-1]._replace(soft=False, reject=True, fresh=False)] for x in attempts]
    longest = max(map(len, attempts))
    attempts = [[Stage(0.0, 0, 1.0)] * (longest - len(x)) + x for x in attempts]
    flat = [jnp.asarray([[s[i] for s in x] for x in attempts]) for i in range(len(end))]
    return Stage(*(x.astype(dtype) if x.dtype.kind == "f" else x for x in flat))


def scales_of(problem: Problem, found: Found, kept: Array) -> Array:
    """By how much residuals exceed the noise, in the median, of each record; at least 1 of one."""
    scales = []
    for part in problem.samples.parts:
        rows, seen = found.rows.residual[:, part], kept[:, part, None] > 0
        size = jnp.where(seen & (problem.samples.weight[:, part] > 0), jnp.abs(rows), jnp.nan)
        scales.append(_MAD * jnp.nanmedian(size))
    scale = jnp.stack(scales)
    scale = jnp.where(found.fresh | ~(scale > 0), 1.0, scale)
    return jnp.maximum(scale, 1.0) if problem.options.noise_known else scale


def of_samples(problem: Problem, of_records: Array) -> Array:
    """A number for each record, for each sample."""
    sizes = np.array([x.stop - x.start for x in problem.samples.parts])
    return jnp.repeat(of_records, sizes, total_repeat_length=int(sizes.sum()))


def weigher(
    problem: Problem, layout: Layout, kept: Array, scales: Array, stage: Stage
) -> Callable[[Rows], tuple[Array, Array]]:
    """Weights of rows (throws, n), and their sum of squares, or what stands for it."""

    def weigh(rows: Rows) -> tuple[Array, Array]:
        square, count = jnp.sum(rows.residual**2, axis=-1), kept.shape[1]
        weight = jnp.where(layout.since <= stage.horizon, kept, 0.0)
        # What is known beforehand; then what holds a fit near its start at first.
        known = jnp.ones_like(square[:, count:])
        early = jnp.where(stage.horizon < 1, 1.0, 0.0)
        known = known.at[:, known.shape[1] - problem.held :].set(early)
        weight, loss = jnp.concatenate([weight, known], axis=1), square
        if problem.options.robust:
            width = jnp.sum(problem.samples.weight, axis=-1)
            soft = jnp.maximum(_FACES * width * of_samples(problem, scales**2)[None], 1e-30)
            soft = jnp.where(stage.soft, soft, jnp.inf)
            soft = jnp.pad(soft, ((0, 0), (0, known.shape[1])), constant_values=jnp.inf)
            weight = weight / (1 + square / soft)
            bent = jnp.where(jnp.isinf(soft), 1.0, soft)
            loss = jnp.where(jnp.isinf(soft), square, bent * jnp.log1p(square / bent))
            return weight, jnp.sum(jnp.where(weight > 0, loss, 0.0))
        return weight, jnp.sum(weight * loss)

    return weigh


def rejected(problem: Problem, rows: Rows, kept: Array, scales: Array) -> Array:
    """Which samples are kept of those that were, by how far off they are."""
    width = jnp.sum(problem.samples.weight, axis=-1)
    square = jnp.sum(rows.residual[:, : kept.shape[1]] ** 2, axis=-1)
    good = square / of_samples(problem, scales**2)[None] < width + _REJECTED
    spoilt = jnp.zeros(kept.shape[0], bool)
    for part in problem.samples.parts:  # a throw given up by one record is given up by all
        bad = jnp.sum(jnp.where(good, 0.0, kept)[:, part], axis=1)
        spoilt = spoilt | (bad > _SPOILT * jnp.sum(kept[:, part], axis=1))
    return jnp.where(good & ~spoilt[:, None], kept, 0.0)


def misfit(problem: Problem, way: Way) -> Array:
    """0 for a fit that may be kept; else how far off it is."""
    found, weight = way.found, weights_of(problem, way.kept)
    square = jnp.sum(weight * found.rows.residual[:, : way.kept.shape[1]] ** 2)
    freedom = jnp.sum(weight) - found.point.numbers.size - 3.0 * way.kept.shape[0]
    ratio = square / jnp.maximum(freedom, 1.0)
    good = found.settled & jnp.isfinite(ratio)
    if problem.options.noise_known and not problem.options.robust:
        good = good & (ratio < 1 + GATE * jnp.sqrt(2 / jnp.maximum(freedom, 1.0)))
    off = jnp.where(jnp.isfinite(ratio), ratio, jnp.finfo(ratio.dtype).max)
    return jnp.where(good, jnp.where(is_at_boundary(problem, found), _FLAT, 0.0), off)


def weights_of(problem: Problem, kept: Array) -> Array:
    """Of numbers that are there, are kept and are not saturated."""
    return jnp.where(problem.samples.sign == 0, problem.samples.weight, 0.0) * kept[..., None]


def signal_of(problem: Problem, weight: Array) -> Array:
    """What there is to explain of values, in units of their noise: a radian, or the variation."""
    white, parts = jnp.diagonal(problem.samples.whitener, axis1=-2, axis2=-1), []
    for part, values in zip(problem.samples.parts, problem.samples.values, strict=True):
        w, unit = weight[:, part], white[:, part]
        if values.shape[-1] > w.shape[-1]:  # quaternions
            parts.append(unit)
            continue
        values = jnp.pad(values, ((0, 0), (0, 0), (0, w.shape[-1] - values.shape[-1])))
        total = jnp.sum(w * unit**2, axis=1, keepdims=True)
        mean = jnp.sum(w * unit**2 * values, axis=1, keepdims=True)
        parts.append(unit * (values - mean / or_one(total)))
    return jnp.concatenate(parts, axis=1)


def unexplained(problem: Problem, way: Way, kicks: Array | float = 0.0) -> Array:
    """Of the square of the record, beyond the noise if that is known."""
    weight = weights_of(problem, way.kept)
    left = jnp.sum(weight * way.found.rows.residual[:, : way.kept.shape[1]] ** 2) + kicks
    left = left - jnp.sum(weight) if problem.options.noise_known else left
    signal = jnp.sum(weight * signal_of(problem, weight) ** 2)
    return left / or_one(signal)


def is_at_boundary(problem: Problem, found: Found) -> Array:
    """Whether a body that need not be is flat."""
    flat = jnp.asarray(False)
    for i, shape in enumerate(problem.unknowns.shapes):
        if not isinstance(shape, Fixed | Flat):
            flat = flat | is_near_flat(problem.unknowns.inertia(found.point.numbers, i))
    return flat


def is_pure(problem: Problem, way: Way, noise: Array) -> Array:
    """Whether a constant rate in each throw describes a gyro's record as well.

    Where the rates do not vary the Fisher information at the estimate is no guide: a motion fitted
    to the noise seems to tell what the true one does not. The best of many wobbles gains something
    from any noise, the more the longer the record.
    """
    sensors = problem.unknowns.original(0)[1:]
    sought = any(x.names for x in problem.unknowns.shapes)
    if not sought or any(x.on_attitude or x.width != 3 for x in sensors):
        return jnp.asarray(False)
    weight = weights_of(problem, way.kept)
    constant = jnp.sum(weight * signal_of(problem, weight) ** 2)
    fitted = jnp.sum(weight * way.found.rows.residual[:, : way.kept.shape[1]] ** 2)
    chance = 5 + GATE * 10**0.5 + 4 * jnp.log(jnp.maximum(jnp.sum(weight), 1.0))  # of five numbers
    return constant - fitted < noise * chance


def link_whitener(
    problem: Problem, layout: Layout, numbers: Array, weight: Array, level: Array
) -> Array:
    """What turns gaps of links (throws, nodes, local) into units of what they are allowed.

    Between nodes dt apart a white torque of spectral density s^2 makes a random walk of the
    momentum, s sqrt(dt), and of its integral.
    """
    linked, local = layout.linked.astype(level.dtype), 6 if problem.options.on_attitude else 3
    dt = jnp.where(layout.linked, layout.end - layout.start, 1.0)
    if not problem.options.dense:
        return product("ts,ij->tsij", linked, jnp.diag(weight / problem.noise[:local]))
    tensors = jax.vmap(lambda body: problem.unknowns.inertia(numbers, body))(problem.bodies)
    of_rate = product("ts,i,tij->tsij", linked / jnp.sqrt(dt), 1 / level, tensors)
    if local == 3:
        return of_rate
    of_turn = of_rate * 12**0.5 / dt[..., None, None]
    return jnp.block([[of_rate, jnp.zeros_like(of_rate)], [-(3**0.5) * of_rate, of_turn]])


def first_level(problem: Problem, layout: Layout, numbers: Array) -> Array:
    """The torque's level that moves a rate by its noise from node to node, for each axis."""
    span = jnp.sum(jnp.where(layout.linked, layout.end - layout.start, 0.0))
    mean = span / jnp.maximum(jnp.sum(layout.linked), 1).astype(span.dtype)
    size = jnp.trace(problem.unknowns.inertia(numbers)) / 3
    level = problem.noise[0] * size / jnp.sqrt(jnp.where(mean > 0, mean, 1.0))
    return jnp.broadcast_to(level, (3,))


class Evidence(NamedTuple):
    """What a record says of the level of an unmodelled torque, of each axis.

    `squares` of the whitened kicks; how many of them the record tells, `effective`; and the
    information about the logarithm of the level squared.
    """

    squares: Array
    effective: Array
    information: Array


def evidence_of(problem: Problem, found: Found, weights: Array, whitener: Array) -> Evidence:
    """By the marginal likelihood of the smoother: -2 log p has log det of its normal equations.

    Its derivatives in the logarithm of the kicks' precision are differences: it is smooth. A noise
    that is not known is at its most likely beside each level, which is then relative to it.
    """
    inner, h = found.point.own.shape[-1] + found.links.gap.shape[-1], 0.1
    gap, kinds = product("tsij,tsj->tsi", whitener, found.links.gap), whitener.shape[-1] // 3

    def log_determinant(shift: Array) -> Array:
        white = product("i,tsij->tsij", jnp.tile(jnp.exp(shift / 2), kinds), whitener)
        blocks = blocks_of(found.rows, found.links, weights, white)
        left = eliminated(reduced(blocks, jnp.zeros(())), inner)
        return left.log_determinant + jnp.linalg.slogdet(left.numbers)[1]

    moves = h * jnp.concatenate([jnp.eye(3), -jnp.eye(3), jnp.zeros((1, 3))])
    up, down, middle = jnp.split(jax.lax.map(log_determinant, moves.astype(gap.dtype)), [3, 6])
    slope, bend = (up - down) / (2 * h), (up - 2 * middle + down) / h**2
    links = kinds * jnp.sum(jnp.any(whitener != 0, axis=(2, 3))).astype(gap.dtype)
    squares = jnp.sum(gap * gap, axis=(0, 1)).reshape(kinds, 3).sum(axis=0)
    effective, information = links - slope, 0.5 * jnp.maximum(links - slope - bend, 1e-12)
    if not problem.options.noise_known:
        rows = product("tn,tnd->tnd", jnp.sqrt(weights), found.rows.residual)
        unknown = found.point.numbers.size + inner * weights.shape[0]
        freedom = jnp.maximum(jnp.sum(rows != 0).astype(gap.dtype) - unknown, 1.0)
        squares = squares * freedom / (jnp.sum(rows * rows) + jnp.sum(squares))
        information = information - effective**2 / (2 * freedom)
    seen = Evidence(squares, effective, jnp.maximum(information, 1e-12))
    if problem.options.level == "estimate per axis":
        return seen
    return Evidence(*(jnp.broadcast_to(jnp.sum(x), (3,)) for x in seen))  # one for all axes


def next_level(level: Array, first: Array, seen: Evidence) -> tuple[Array, Array]:
    """Fisher's scoring for the logarithm of the level; and whether it has come to rest."""
    score = 0.5 * (seen.squares - seen.effective)
    move = jnp.clip(score / jnp.maximum(seen.information, 1e-9), -3.0, 3.0)
    move = jnp.where(jnp.isfinite(move), move, 0.0)
    # Kicks of which less than one is told, and of those too many: there is no torque.
    none = (seen.effective < 1) & (score < 0)
    new = jnp.where(none, 0.0, level * jnp.exp(move / 2))
    new = jnp.maximum(new, _FAINT * first)
    return new, jnp.all(jnp.abs(jnp.log(new / level)) < 0.01)


def is_faint(level: Array, first: Array) -> Array:
    """Where links are so hard that there is no torque."""
    return level <= 1.01 * _FAINT * first
