"""What a motion is to JAX: lanes under `jax.vmap`, and derivatives."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._as_lanes import as_lanes
from jrigid.simulate._adjoint import guard_derivative
from jrigid.simulate._controller import constant
from jrigid.simulate._lanes import Ends, Problem, Steps, in_lanes
from jrigid.simulate._pull import pull_in_lanes


def motion_in_lanes(problem: Problem, steps: Steps, forward: bool) -> Ends:
    """A motion in a lane, many under vmap, with derivatives in forward mode or in reverse."""
    times, end = problem.times, problem.end
    fixed = constant({x: getattr(problem, x) for x in ("controller", "finer", "times", "end")})
    problem = problem._replace(**fixed)
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
        ends = _solved(guard_derivative(problem).finely, steps)
        return ends, (ends.t, ends.stats["num_steps"])

    def backwards(reached: Any, change: Ends, perturbed: Any, problem: Problem) -> Any:
        problem, change = guard_derivative((problem, change))
        zeros = jnp.zeros((*problem.times.shape, *problem.y0.shape), problem.y0.dtype)
        last = jnp.zeros_like(problem.y0) if change.y is None else change.y
        changes = last, zeros if change.ys is None else change.ys
        pull = partial(pull_in_lanes, steps)
        moved, rest = _moved(problem.finely, perturbed)
        return as_lanes(pull, rest, moved, changes, reached)

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
        moved, rest = _moved(problem.finely, perturbed)
        tangent = eqx.combine(tangent, jtu.tree_map(jnp.zeros_like, moved))
        return as_lanes(push, rest, moved, tangents=tangent)

    return solved(problem)


def _moved(problem: Problem, perturbed: Any) -> tuple[Problem, Problem]:
    """What of a motion changes, and what does not."""
    which = jtu.tree_map(lambda _: False, problem)
    which = which._replace(term=perturbed.term, args=perturbed.args, y0=True)
    return eqx.partition(problem, which)


def _solved(problem: Problem, steps: Steps) -> Ends:
    def solve(shared: Any, each: Any, y0: Array) -> Ends:
        return in_lanes(shared, each._replace(y0=y0), steps)

    return as_lanes(solve, problem._replace(y0=None), problem.y0)
