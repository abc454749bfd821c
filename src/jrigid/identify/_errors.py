"""What a fit tells: errors, what the record does not determine, and how the fit ended."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._checks import RESULTS, nan_where
from jrigid._numerics import or_one, product
from jrigid.dynamics import State
from jrigid.identify import _stages as stages
from jrigid.identify._layout import Layout
from jrigid.identify._problem import Problem
from jrigid.identify._result import LARGEST_ERROR, FitResult, Status, derive, errors_of
from jrigid.identify._smoother import Blocks, Links, Rows, blocks_of, eliminated, reduced

_TOLD = 1e-9  # of the largest singular value: a change of the state that the record shows
_TRIED = 0.03  # of the level that moves a rate by its noise: where one of zero is judged
_WHITE = 6.0  # standard deviations of the correlation of neighbouring residuals
_COLOURED = 0.25  # ... and its size, for residuals that are no noise


def condensed(rows: Rows, links: Links) -> Rows:
    """Rows in the first state of each throw: along the links, as if nothing came between."""
    border, local = rows.of_border.shape[-1], links.gap.shape[-1]

    def throw(rows: Rows, links: Links) -> Rows:
        first = jnp.eye(local, border + local, border, dtype=links.gap.dtype)

        def follow(state: Array, link: Links) -> tuple[Array, Array]:
            after = product("ij,jk->ik", link.of_state, state)
            return after.at[:, :border].add(link.of_border), state

        _, states = jax.lax.scan(follow, first, links)
        through = product("ndl,nlk->ndk", rows.of_state, states[rows.node])
        of_border = rows.of_border + through[..., :border]
        return Rows(rows.residual, of_border, through[..., border:], jnp.zeros_like(rows.node))

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


def in_rows(rows: Rows, own: int) -> tuple[Array, Array, Array]:
    """Derivatives (throws, rows, ...) in the numbers, and in what is a throw's; and residuals."""
    jl = jnp.concatenate([rows.of_state, rows.of_border[..., :own]], axis=-1)
    parts = rows.of_border[..., own:], jl, rows.residual[..., None]
    throws, count, width = rows.residual.shape
    jg, jl, r = (x.reshape(throws, count * width, x.shape[-1]) for x in parts)
    return jg, jl, r[..., 0]


def told_by_rows(rows: Rows, own: int, units: Array) -> tuple[Told, Array]:
    """By singular values of weighted rows in first states: their squares would lose digits.

    And what each throw adds to the gradient of half the squares in the numbers.
    """
    jg, jl, residual = in_rows(rows, own)
    jg = product("trg,g->trg", jg, units)
    size, eps = jg.shape[-1], jnp.finfo(jg.dtype).eps

    def throw(jg: Array, jl: Array, residual: Array) -> tuple[Array, ...]:
        scale = or_one(jnp.sqrt(jnp.sum(jl * jl, axis=0)))
        u, s, vt = jnp.linalg.svd(jl / scale[None, :], full_matrices=False)
        told = s > _TOLD * s[0]
        u = jnp.where(told[None, :], u, 0.0)
        inverse = 1 / jnp.where(told, s, eps * jnp.maximum(s[0], 1.0))
        half = vt.T * inverse[None, :] / scale[:, None]
        follow = product("lk,rk,rg->lg", jnp.where(told[None, :], half, 0.0), u, jg)
        rest = jg - product("rk,sk,sg->rg", u, u, jg)
        scores = product("rg,r->g", rest, residual) / units
        return jnp.linalg.qr(rest, mode="r"), half, follow, s, scores

    r, half, follow, of_state, scores = jax.vmap(throw)(jg, jl, residual)
    r = r.reshape(r.shape[0] * r.shape[1], size)
    return _told(r, half, follow, of_state, units), scores


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
    follow, singular = product("tlg,g->tlg", rest.follow, units), jnp.sqrt(values)[:, ::-1]
    return _told(r, half, follow, singular, units), rest.right


def _told(r: Array, half: Array, follow: Array, of_state: Array, units: Array) -> Told:
    """With numbers in their own units, of what is told in natural ones."""
    _, values, vt = jnp.linalg.svd(r, full_matrices=False)
    largest = jnp.max(values, initial=0.0)
    floor = jnp.maximum(values, 16 * jnp.finfo(r.dtype).eps * largest + 1e-150)
    covariance = product("ki,kj->ij", vt / floor[:, None], vt / floor[:, None])
    covariance = covariance * units[:, None] * units[None, :]
    follow, local = product("tlg,g->tlg", follow, 1 / units), product("tik,tjk->tij", half, half)
    return Told(values, vt.T, covariance, local, follow, of_state)


def conclude(problem: Problem, layout: Layout, way: stages.Way, input_result: Any) -> FitResult:
    """The result of a fit at a minimum."""
    found, kept, level, point = way.found, way.kept, way.level, way.found.point
    numbers, own, unknowns = point.numbers, point.own.shape[-1], problem.unknowns
    units = unknowns.natural_units(numbers)
    end = jtu.tree_map(lambda x: x[0, -1], stages.schedule(problem.options, numbers.dtype))
    weight, _ = stages.weigher(problem, layout, kept, way.scales, end)(found.rows)
    scaled = [product("tn,tn...->tn...", jnp.sqrt(weight), x) for x in found.rows[:3]]
    rows = condensed(Rows(*scaled, node=found.rows.node), found.links)
    sensor, scores = told_by_rows(rows, own, units)
    told, kicks, level_errors = sensor, jnp.zeros((), numbers.dtype), jnp.zeros_like(level)
    level = level if problem.options.dense else level_errors
    if problem.options.dense:
        white = stages.link_whitener(problem, layout, numbers, end.weight, level)
        blocks = blocks_of(found.rows, found.links, weight, white)
        told, scores = told_by_equations(blocks, own, units)
        first = stages.first_level(problem, layout, numbers)
        faint = stages.is_faint(level, first)
        tried = jnp.where(faint, _TRIED * first, level)
        tell = stages.link_whitener(problem, layout, numbers, end.weight, tried)
        information = stages.evidence_of(problem, found, weight, tell).information
        # That of a level near zero is in proportion to its fourth power: the least to be seen.
        level_errors = tried * jnp.where(faint, information**-0.25, 0.5 * information**-0.5)
        level = jnp.where(faint, 0.0, level)
        kicks = jnp.sum(product("tsij,tsj->tsi", white, found.links.gap) ** 2)
    jacobian = jnp.concatenate([rows.of_border[..., own:], rows.of_state], axis=-1)
    residuals, jacobian = (x[:, : kept.shape[1]] for x in (rows.residual, jacobian))
    judged = _judged(problem, way, told, kicks, units, residuals)
    inflation, covariance = judged["inflation"], judged["numbers_covariance"]
    status, good = judged["status"], input_result == RESULTS.successful
    if not problem.options.noise_known:  # the level was relative to the noise
        level, level_errors = (jnp.sqrt(inflation) * x for x in (level, level_errors))
    count = len(unknowns.shapes)
    derived = tuple(derive(unknowns, i, numbers, covariance) for i in range(count))
    loose = [jnp.any(x["ratios_errors"] > LARGEST_ERROR * x["ratios"]) for x in derived]
    loose = jnp.any(jnp.stack(loose)) & (status == Status.OK)
    status = Status.where(loose, Status.UNIDENTIFIABLE, status)
    judged["status"] = Status.where(good, status, Status.BAD_INPUT)
    result = FitResult(
        **judged, **derived[0], numbers=numbers, own_numbers=point.own,
        errors=errors_of(covariance), sensor_covariance=inflation * sensor.covariance,
        local_covariance=inflation * told.local, follow=told.follow, scores=scores,
        state=State(point.attitude[:, 0], point.omega[:, 0]), t0=layout.start[:, 0],
        residuals=residuals, jacobian=jacobian, state_singular_values=sensor.of_state,
        level=level, level_errors=level_errors, scales=way.scales, kept=kept > 0,
        history=found.history, doubtful=way.doubtful, input_result=input_result, problem=problem,
        derived=derived,
    )  # fmt: skip
    return nan_where(~good, result)


def _widened(told: Told, error: Array, units: Array) -> Told:
    """With the error of what is told least, in natural units, at least this large."""
    last, direction = told.values[-1], told.directions[:, -1] * units
    more = jnp.maximum(error**2 - 1 / jnp.maximum(last, 1e-150) ** 2, 0.0)
    values = told.values.at[-1].min(1 / jnp.where(error > 0, error, 1e-300))
    covariance = told.covariance + more * direction[:, None] * direction[None, :]
    return told._replace(values=values, covariance=covariance)


def _whiteness(rows: Array, parts: Sequence[slice]) -> tuple[Array, Array]:
    """Correlation of neighbours, and how many standard deviations that is from 0."""
    left = jnp.concatenate([rows[:, x.start : x.stop - 1] for x in parts], axis=1)
    right = jnp.concatenate([rows[:, x.start + 1 : x.stop] for x in parts], axis=1)
    both = ((left != 0) & (right != 0)).astype(rows.dtype)
    square = jnp.sum(both * (left**2 + right**2) / 2)
    like = jnp.sum(left * right) / jnp.maximum(square, jnp.finfo(rows.dtype).tiny)
    return like, jnp.abs(like) * jnp.sqrt(jnp.sum(both))


def _judged(
    problem: Problem, way: stages.Way, told: Told, kicks: Array, units: Array, residuals: Array
) -> dict[str, Any]:
    """How well a fit describes the record, by residuals and the squares of kicks; how it ended."""
    found, options, count = way.found, problem.options, way.kept.shape[1]
    whiteness = _whiteness(residuals, problem.samples.parts)
    rows, weight = found.rows.residual[:, :count], stages.weights_of(problem, way.kept)
    alive = jnp.any(way.kept > 0, axis=1)[:, None]
    shown = jnp.sum((told.of_state > _TOLD * told.of_state[:, :1]) & alive)
    known = found.rows.residual[:, count : found.rows.residual.shape[1] - problem.held]
    freedom = jnp.sum(weight) + (jnp.sum(known != 0) - units.size - shown).astype(kicks.dtype)
    chi_square = jnp.sum(weight * rows * rows) + jnp.sum(known**2) + kicks
    noise = chi_square / jnp.maximum(freedom, 1.0)
    if options.noise_known:
        gate = 1 + stages.GATE * jnp.sqrt(2 / jnp.maximum(freedom, 1))
        misfit = (noise > gate) | (jnp.max(way.scales) > 2)
        inflation = jnp.where(misfit, jnp.maximum(noise, 1.0), 1.0)
    else:
        like, sure = whiteness
        misfit = (like > _COLOURED) & (sure > _WHITE)
        inflation = noise
    told = _widened(told, way.wide / jnp.sqrt(inflation), units) if units.size else told
    pure, left = stages.is_pure(problem, way, inflation), stages.unexplained(problem, way, kicks)
    flat = stages.is_at_boundary(problem, found)
    # The last word counts. A fit that creeps along what the record does not tell is as good as any.
    largest = jnp.sqrt(inflation) / jnp.min(told.values, initial=jnp.inf)
    status = Status.where(found.settled, Status.OK, Status.NOT_CONVERGED)
    status = Status.where(largest > LARGEST_ERROR, Status.UNIDENTIFIABLE, status)
    status = Status.where(flat, Status.AT_BOUNDARY, status)
    status = Status.where(pure | way.doubtful, Status.UNIDENTIFIABLE, status)
    lost = Status.where(found.settled, Status.WRONG_BASIN, Status.NOT_CONVERGED)
    wrong = Status.where((left > stages.EXPLAINED) | flat, lost, Status.MISFIT)
    status = Status.where(misfit, wrong, status)
    seen = jnp.maximum(jnp.sum(residuals != 0, axis=(1, 2)), 1).astype(kicks.dtype)
    sound = jnp.all(jnp.isfinite(told.covariance)) & (freedom > 0) & jnp.isfinite(chi_square)
    return {
        "status": Status.where(sound, status, Status.NOT_CONVERGED), "chi_square": chi_square,
        "degrees_of_freedom": freedom.astype(int), "reduced_chi_square": noise,
        "whiteness": whiteness, "chi_square_by_throw": jnp.sum(residuals**2, axis=(1, 2)) / seen,
        "inflation": inflation, "unexplained": left, "pure_spin": pure,
        "singular_values": told.values, "directions": told.directions,
        "numbers_covariance": inflation * told.covariance,
    }  # fmt: skip
