"""What a motion is to JAX: lanes under `jax.vmap`, and derivatives."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid.simulate._adjoint import guard_derivative
from jrigid.simulate._controller import constant
from jrigid.simulate._lanes import Ends, Problem, Steps, in_lanes
from jrigid.simulate._pull import pull_in_lanes


def motion_in_lanes(problem: Problem, steps: Steps, forward: bool) -> Ends:
    """A motion in a lane, many under vmap, with derivatives in forward mode or in reverse."""
    times, end = problem.times, problem.end
    controller, fixed_times, fixed_end = constant((problem.controller, times, end))
    problem = problem._replace(controller=controller, times=fixed_times, end=fixed_end)
    ends = _forward(problem, steps) if forward else _reversible(problem, steps)
    return _at_their_times(problem, ends, times, end)


def _at_their_times(problem: Problem, ends: Ends, times: Array, end: Array) -> Ends:
    """With the derivatives in the times: steps of length zero, by the midpoint rule.

    Its derivatives are those of the motion to second order.
    """
    zero, none = times - problem.times, end - problem.end

    def moved(t: Array, y: Array, h: Array) -> Array:
        there = jnp.isfinite(t)
        t, y0 = jnp.where(there, t, 0.0), jnp.where(there, y, problem.y0)
        middle = y0 + 0.5 * h * problem.field(t, y0)
        return jnp.where(there, y0 + h * problem.field(t + 0.5 * h, middle), y)

    ys = jax.vmap(moved)(ends.reached, ends.ys, zero)
    through = ends.t == problem.end
    none = jnp.where(through, none, 0.0)
    return ends._replace(
        reached=ends.reached + zero, ys=ys, t=ends.t + none, y=moved(ends.t, ends.y, none)
    )


def _reversible(problem: Problem, steps: Steps) -> Ends:
    """In reverse mode, once."""
    solved = eqx.filter_custom_vjp(lambda problem: _solved(problem, steps))

    def forwards(perturbed: Any, problem: Problem) -> tuple[Ends, Any]:
        del perturbed
        ends = _solved(guard_derivative(problem), steps)
        return ends, (ends.t, ends.stats["num_steps"])

    def backwards(reached: Any, change: Ends, perturbed: Any, problem: Problem) -> Any:
        problem, change = guard_derivative((problem, change))
        zeros = jnp.zeros((*problem.times.shape, *problem.y0.shape), problem.y0.dtype)
        last = jnp.zeros_like(problem.y0) if change.y is None else change.y
        changes = last, zeros if change.ys is None else change.ys
        pull = partial(pull_in_lanes, steps)
        moved, rest = _moved(problem, perturbed)
        return _as_lanes(pull, rest, moved, changes, reached)

    solved.def_fwd(forwards)
    solved.def_bwd(backwards)
    return solved(problem)


def _forward(problem: Problem, steps: Steps) -> Ends:
    """In forward mode: tangents take the steps that their motion takes."""
    solved = eqx.filter_custom_jvp(lambda problem: _solved(problem, steps))

    def push(shared: Any, rest: Any, moved: Any, tangent: Any) -> tuple[Ends, Ends]:
        def ends(moved: Any) -> Ends:
            return in_lanes(shared, eqx.combine(rest, moved), steps)

        return eqx.filter_jvp(ends, (moved,), (tangent,))

    @solved.def_jvp
    def _(primals: Any, tangents: Any) -> tuple[Ends, Ends]:
        (problem,), (tangent,) = primals, tangents
        perturbed = jtu.tree_map(lambda x: x is not None, tangent, is_leaf=lambda x: x is None)
        moved, rest = _moved(problem, perturbed)
        tangent = eqx.combine(tangent, jtu.tree_map(jnp.zeros_like, moved))
        return _as_lanes(push, rest, moved, tangent, firsts=1)

    return solved(problem)


def _moved(problem: Problem, perturbed: Any) -> tuple[Problem, Problem]:
    """What of a motion changes, and what does not."""
    which = jtu.tree_map(lambda _: False, problem)
    which = which._replace(term=perturbed.term, args=perturbed.args, y0=True)
    return eqx.partition(problem, which)


def _solved(problem: Problem, steps: Steps) -> Ends:
    def solve(shared: Any, each: Any, y0: Array) -> Ends:
        return in_lanes(shared, each._replace(y0=y0), steps)

    return _as_lanes(solve, problem._replace(y0=None), problem.y0)


def _as_lanes(function: Callable[..., Any], problem: Problem, *own: Any, firsts: int = 0) -> Any:
    """`function(problem, nothing, *own)`; under vmap `function(shared, each, *own)` of all lanes.

    The leaves of `each` and of `own` have a lane to each index in front; what is shared has none.
    The first so many results depend on `problem` and the first of `own` alone.
    """
    arrays, static = eqx.partition(problem, eqx.is_array)
    leaves, structure = jtu.tree_flatten((arrays, own))

    def single(*leaves: Any) -> Any:
        problem, own = structure.unflatten(leaves)
        own = jtu.tree_map(lambda x: x[None], own)
        nothing = jtu.tree_map(lambda _: None, problem)
        found = function(eqx.combine(problem, static), nothing, *own)
        return jtu.tree_map(lambda x: x[0], found)

    alone = jax.custom_batching.custom_vmap(single)

    def of_all(leaves: Any, batched: Any) -> Any:
        count = next(x.shape[0] for x, has in zip(leaves, batched, strict=True) if has)
        (problem, own), (has, own_has) = structure.unflatten(leaves), structure.unflatten(batched)
        each, shared = eqx.partition(problem, has)
        own = jtu.tree_map(
            lambda x, has: x if has else jnp.broadcast_to(x, (count, *x.shape)), own, own_has
        )
        return function(eqx.combine(shared, static), each, *own)

    def batch(leaves: Any, batched: Any) -> Any:
        @jax.custom_batching.custom_vmap
        def lanes(*leaves: Any) -> Any:
            return of_all(leaves, batched)

        @lanes.def_vmap
        def _(size: int, again: Any, *leaves: Any) -> tuple[Any, Any]:
            """Lanes of lanes are lanes."""
            if not any(again):
                return _without_axis(of_all(leaves, batched))
            flags = list(zip(leaves, batched, again, strict=True))
            count = next(x.shape[1 if out else 0] for x, has, out in flags if has)

            def flat(x: Array, has: bool, out: bool) -> Array:
                if not (has or out):
                    return x
                x = x if out else x[None]
                x = x if has else x[:, None]
                whole = jnp.broadcast_to(x, (size, count, *x.shape[2:]))
                return whole.reshape(-1, *x.shape[2:])

            found = batch([flat(*x) for x in flags], [has or out for _, has, out in flags])
            found = jtu.tree_map(lambda x: x.reshape(size, count, *x.shape[1:]), found)
            return found, jtu.tree_map(lambda _: True, found)

        return lanes(*leaves)

    @alone.def_vmap
    def _(_: int, batched: Any, *leaves: Any) -> tuple[Any, Any]:
        if not any(batched):
            return _without_axis(single(*leaves))
        found = batch(leaves, batched)
        flags = jtu.tree_map(lambda _: True, found)
        has, own_has = structure.unflatten(batched)
        if firsts and not any(jtu.tree_leaves((has, own_has[0]))):
            same, flag = _without_axis(jtu.tree_map(lambda x: x[0], found[:firsts]))
            return (*same, *found[firsts:]), (*flag, *flags[firsts:])
        return found, flags

    return alone(*leaves)


def _without_axis(found: Any) -> tuple[Any, Any]:
    """What only derivatives of derivatives give an axis to: they are mapped, not lanes."""
    return found, jtu.tree_map(lambda _: False, found)
