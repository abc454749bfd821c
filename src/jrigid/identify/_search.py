"""The search for the minimum: attempts from several bodies, and probes of what is told least."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._numerics import or_one, product
from jrigid.identify._layout import Layout
from jrigid.identify._problem import Problem, evaluation
from jrigid.identify._result import LARGEST_ERROR
from jrigid.identify._smoother import Point, blocks_of, eliminated, minimise, reduced, unevaluated
from jrigid.identify._stages import (
    EXPLAINED,
    Stage,
    Way,
    evidence_of,
    first_level,
    is_at_boundary,
    is_pure,
    link_whitener,
    misfit,
    next_level,
    rejected,
    scales_of,
    schedule,
    unexplained,
    weigher,
    weights_of,
)

_HISTORY = 1024
_FAR = 10.0  # of chi-square for each degree of freedom: a misfit worth other starts
_PROBES = [-1.0, 1.0, -0.25, 0.25]  # natural units, along what is told least
_WEAK = 0.01  # an error in natural units that is worth probes
_HARD = 1e4  # weight of what a probe holds, in natural units
_SURE = 36.0  # growth of chi-square, six standard errors, at which a probe is content
_APART = 0.1  # natural units between two minima
_FEW = 32  # numbers of a coarse record, too few to tell aliases
_BENT = 2.0  # times what Fisher's information says: a valley that no covariance describes
_RIVAL = 25.0  # growth of chi-square at which another minimum is none


class Line(eqx.Module):
    """Holds the numbers on a plane: a residual that is zero there."""

    direction: Array
    value: Array

    def __call__(self, numbers: Array) -> Array:
        return jnp.sum(self.direction * numbers) - self.value


class _Weakest(NamedTuple):
    """Chi-square of an answer, its unit, and what it tells least."""

    square: Array
    noise: Array
    error: Array  # in natural units
    direction: Array  # a natural unit along it, in numbers
    normal: Array  # whose product with that is one


class _Hunt(NamedTuple):
    """Where a search stands."""

    tried: Array  # the next attempt: a start, then a probe
    best: Way
    wrong: Array  # 0 for an answer that may be kept, else how far off it is
    weakest: _Weakest
    pure: Array


def search(
    problem: Problem, single: Layout, cut: Layout, point: Point, starts: Array, known: Array,
    coarse: Array, long: Array,
) -> Way:  # fmt: skip
    """Through all stages; if that ends wrong, again, more slowly, from other numbers.

    Fisher's information at a minimum knows nothing of a valley that bends, nor of other minima. So
    an answer that tells some direction weakly is probed: that direction is held a natural unit, and
    a quarter of one, to either side, and all else is fitted anew. By how little chi-square grows
    says what the error is. Of coarse records, which have aliases, several attempts are compared.

    Args:
        problem: The record.
        single: One segment a throw.
        cut: Many.
        point: States at their starts, as observed.
        starts: Numbers for each attempt.
        known: Level of the unmodelled torque, if it is known.
        coarse: Whether the body turns by more than half a turn between samples.
        long: Whether it turns many times, so that probes must go slowly too.
    """
    options, dtype, count = problem.options, point.omega.dtype, starts.shape[0]
    stages, first = schedule(options, dtype), first_level(problem, cut, point.numbers)
    last = jtu.tree_map(lambda x: x[0, -1], stages)
    final = cut if options.dense or not options.free_motion else single
    steps = jnp.asarray([0.0] * count + _PROBES, dtype)
    most = count if options.dense else steps.size  # squares beside levels of their own differ
    # Beside a noise that is not known a level far too large is nearly as likely as another.
    begin = _begun(problem, cut, point, (10 if options.noise_known else 1) * first, coarse)

    def attempt(hunt: _Hunt) -> _Hunt:
        best, weakest, step = hunt.best.found, hunt.weakest, steps[hunt.tried]
        probing = hunt.tried >= count
        numbers = best.point.numbers + step * weakest.direction
        numbers = jnp.where(probing, numbers, starts[jnp.minimum(hunt.tried, count - 1)])
        normal = jnp.where(probing, _HARD * weakest.normal, 0.0)
        held = problem.unknowns.holding(Line(normal, jnp.sum(normal * numbers)))
        now = eqx.tree_at(lambda x: x.unknowns, problem, held)
        slow = jnp.where(probing, long, hunt.tried > 0).astype(int)
        way = jtu.tree_map(lambda x: x[slow % x.shape[0]], stages)

        def one(way: Way, stage: Stage) -> tuple[Way, None]:
            skip = (stage.steps == 0) | (way.done & ~stage.last)
            run = lambda way: _stage(now, single, cut, way, stage, first, known)  # noqa: E731
            return jax.lax.cond(skip, lambda way: way, run, way), None

        at = begin.found._replace(point=point._replace(numbers=numbers))
        at = at._replace(steps=best.steps, history=best.history)
        return _next(hunt, jax.lax.scan(one, begin._replace(found=at), way)[0], probing, step)

    def _next(hunt: _Hunt, end: Way, probing: Array, step: Array) -> _Hunt:
        """What an attempt says, and what comes after it."""
        best, weakest, wrong = hunt.best, hunt.weakest, hunt.wrong
        off, seen = misfit(problem, end), _weakest(problem, final, end, last)
        fall = (weakest.square - seen.square) / weakest.noise
        better = ~probing & ((off < wrong) | ((off <= wrong) & (fall > 0)))
        points = best.found.point.numbers, end.found.point.numbers
        apart = _are_apart(problem, *points, jnp.maximum(weakest.error, seen.error))
        rival = ~probing & apart & (jnp.abs(fall) < _RIVAL)
        doubtful = (best.doubtful & ~(better & (fall > _RIVAL))) | rival | begin.doubtful
        wide = _error_by_probe(problem, *points, weakest.direction, step, -fall)
        wide = jnp.maximum(best.wide, jnp.where(probing & (-fall < _SURE), wide, 0.0))
        bent = wide > _BENT * weakest.error

        best, weakest, wrong = jtu.tree_map(
            lambda a, b: jnp.where(better, a, b), (end, seen, off), (best, weakest, wrong)
        )
        best = best._replace(doubtful=doubtful | bent, wide=wide)
        # A misfit that follows the record has two attempts, any other failure all.
        lost = (wrong > _FAR) | is_at_boundary(problem, best.found)
        lost = lost | (unexplained(problem, best) > EXPLAINED)
        pure = is_pure(problem, best, weakest.noise) & (wrong < 0.5)  # no misfit
        few = jnp.where(wrong > 0, jnp.where(lost, count, 2), jnp.where(coarse, 4, 1))
        few = jnp.minimum(jnp.where(pure | (doubtful & (wrong == 0)), 1, few), count)
        after = hunt.tried + 1
        after = jnp.where(after < few, after, jnp.maximum(after, count))
        return _Hunt(after, best, wrong, weakest, pure)

    def going(hunt: _Hunt) -> Array:
        weak = (hunt.weakest.error > _WEAK) & (hunt.weakest.error < LARGEST_ERROR)
        probes = weak & (hunt.wrong == 0) & ~hunt.best.doubtful & (hunt.tried < most)
        return (hunt.tried < count) | (probes & ~hunt.pure & (hunt.best.wide < LARGEST_ERROR))

    far, none = jnp.asarray(jnp.inf, dtype), jnp.zeros_like(point.numbers)
    nothing = _Weakest(far, jnp.ones((), dtype), far, none, none)
    hunt = _Hunt(jnp.asarray(0), begin, far, nothing, jnp.asarray(False))
    return jax.lax.while_loop(going, attempt, hunt).best


def _begun(problem: Problem, cut: Layout, point: Point, level: Array, coarse: Array) -> Way:
    """Before anything is known; few samples of a coarse record follow any alias."""
    found, dtype = unevaluated(evaluation(problem, cut), point, _HISTORY), level.dtype
    kept, scales = problem.samples.seen.astype(dtype), jnp.ones(len(problem.samples.values), dtype)
    few = coarse & (jnp.sum(weights_of(problem, kept)) < _FEW)
    return Way(found, kept, scales, level, jnp.asarray(False), few, jnp.zeros((), dtype))


def _weakest(problem: Problem, layout: Layout, way: Way, last: Stage) -> _Weakest:
    """By the normal equations."""
    found = way.found
    numbers, own = found.point.numbers, found.point.own.shape[-1]
    weight, square = weigher(problem, layout, way.kept, way.scales, last)(found.rows)
    white = link_whitener(problem, layout, numbers, last.weight, way.level)
    gap = product("tsij,tsj->tsi", white, found.links.gap)
    square = square + jnp.sum(gap * gap)
    freedom = jnp.sum(weights_of(problem, way.kept)) - numbers.size - gap.shape[-1] * gap.shape[0]
    noise = jnp.ones_like(square)
    if not problem.options.noise_known:
        noise = square / jnp.maximum(freedom, 1.0)
    if not numbers.size:
        return _Weakest(square, noise, jnp.zeros_like(square), numbers, numbers)
    left = reduced(blocks_of(found.rows, found.links, weight, white), jnp.zeros_like(square))
    matrix = eliminated(left, own + gap.shape[-1]).numbers
    units = problem.unknowns.natural_units(numbers)
    matrix = matrix * units[:, None] * units[None, :]
    sound = jnp.all(jnp.isfinite(matrix))
    values, axes = jnp.linalg.eigh(jnp.where(sound, matrix, jnp.eye(units.size, dtype=units.dtype)))
    error = jnp.sqrt(noise / jnp.maximum(values[0], 1e-30))
    return _Weakest(square, noise, error, axes[:, 0] * units, axes[:, 0] / units)


def _are_apart(problem: Problem, one: Array, other: Array, error: Array) -> Array:
    """Whether two points are different minima."""
    apart = jnp.abs(one - other) / problem.unknowns.natural_units(other)
    return jnp.max(apart, initial=0.0) > jnp.maximum(_APART, 6 * error)


def _error_by_probe(
    problem: Problem, before: Array, after: Array, direction: Array, step: Array, growth: Array
) -> Array:
    """In natural units, by how far the tensor moved: numbers are logarithms."""
    unknowns = problem.unknowns
    tensors = lambda x: jnp.stack([unknowns.inertia(x, i) for i in range(len(unknowns.shapes))])  # noqa: E731
    slope = jax.jvp(tensors, (before,), (direction,))[1]
    square = jnp.sum(slope * slope)
    along = jnp.sum((tensors(after) - tensors(before)) * slope)
    step = jnp.where(square > 0, along / or_one(square), step)
    return jnp.abs(step) / jnp.sqrt(jnp.maximum(growth, 1e-6))


def _stage(
    problem: Problem, single: Layout, cut: Layout, way: Way, stage: Stage, first: Array,
    known: Array,
) -> Way:  # fmt: skip
    """One minimisation, and what follows from it."""
    options, (found, kept, scales, level, done, *_) = problem.options, way
    layout = jtu.tree_map(lambda a, b: jnp.where(stage.whole, a, b), single, cut)
    if options.robust:
        scales = scales_of(problem, found, kept)
        fewer = rejected(problem, found.rows, kept, scales)
        kept = jnp.where(stage.reject, fewer, kept)
    if options.level == "known":
        level = first * (known / first) ** stage.weight
    weigh = weigher(problem, layout, kept, scales, stage)
    white = link_whitener(problem, layout, found.point.numbers, stage.weight, level)

    def enough(cost: Array) -> Array:
        count = jnp.maximum(jnp.sum(kept[..., None] * problem.samples.weight), 1.0)
        return stage.enough * jnp.where(options.noise_known, 1.0, cost / count)

    found = found._replace(fresh=found.fresh | stage.fresh)
    found = minimise(evaluation(problem, layout), weigh, white, found, enough, stage.steps)
    if options.progress:
        jax.debug.print(
            "fit: {} steps, links {}, record {}: chi-square {}",
            found.steps, stage.weight, jnp.minimum(stage.horizon, 1.0), weigh(found.rows)[1],
        )  # fmt: skip
    if options.level.startswith("estimate"):
        seen = evidence_of(problem, found, weigh(found.rows)[0], white)
        new, still = next_level(level, first, seen)
        level, done = jnp.where(stage.last, level, new), done | still
    return way._replace(found=found, kept=kept, scales=scales, level=level, done=done)
