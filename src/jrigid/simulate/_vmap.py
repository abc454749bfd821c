"""What `jax.vmap` and derivatives make of a motion: lanes, and what diffrax does alone."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid.simulate._adjoint import guard_derivative
from jrigid.simulate._lanes import Ends, Problem, in_lanes


def vmappable(
    alone: Callable[[Problem], Ends],
    solver: Any,
    max_steps: int,
    problem: Problem,
    forward: bool,
) -> Ends:
    """`alone(problem)`, by itself; under vmap all motions in lanes; derivatives of `alone`."""

    def value(problem: Problem) -> Ends:
        return _value(alone, solver, max_steps, problem)

    if forward:
        differentiable = eqx.filter_custom_jvp(value)
        differentiable.def_jvp(lambda x, dx: eqx.filter_jvp(alone, x, dx))
        return differentiable(problem)
    differentiable = eqx.filter_custom_vjp(value)
    differentiable.def_fwd(lambda _, problem: (value(guard_derivative(problem)), None))

    def backward(_: Any, change: Ends, __: Any, problem: Problem) -> Any:
        problem, change = guard_derivative((problem, change))
        ends, pull = eqx.filter_vjp(alone, problem)
        ends = eqx.filter(ends, eqx.is_inexact_array)
        zero = jtu.tree_map(jnp.zeros_like, ends)  # of what is not asked for there is None
        return pull(eqx.combine(eqx.filter(change, eqx.is_array), zero))[0]

    differentiable.def_bwd(backward)
    return differentiable(problem)


def _value(alone: Callable[[Problem], Ends], solver: Any, max_steps: int, problem: Problem) -> Ends:
    arrays, static = eqx.partition(problem, eqx.is_array)

    @jax.custom_batching.custom_vmap
    def solve(arrays: Any) -> Ends:
        return alone(eqx.combine(arrays, static))

    def batch(arrays: Any, batched: Any) -> Ends:
        @jax.custom_batching.custom_vmap
        def many(arrays: Any) -> Ends:
            each, shared = eqx.partition(arrays, batched)
            return in_lanes(eqx.combine(shared, static), each, solver, max_steps)

        @many.def_vmap
        def _(size: int, again: Any, arrays: Any) -> tuple[Ends, Any]:
            """Lanes of lanes are lanes."""
            inner, outer = jtu.tree_leaves(batched), jtu.tree_leaves(again[0])
            flags = list(zip(jtu.tree_leaves(arrays), inner, outer, strict=True))
            count = next(x.shape[1 if out else 0] for x, has, out in flags if has)

            def flat(x: Array, has: bool, out: bool) -> Array:
                if not (has or out):
                    return x
                x = x if out else x[None]
                x = x if has else x[:, None]
                whole = jnp.broadcast_to(x, (size, count, *x.shape[2:]))
                return whole.reshape(-1, *x.shape[2:])

            structure = jtu.tree_structure(arrays)
            all_ = structure.unflatten(flat(*each) for each in flags)
            ends = batch(all_, structure.unflatten(has or out for _, has, out in flags))
            ends = jtu.tree_map(lambda x: x.reshape(size, count, *x.shape[1:]), ends)
            return ends, jtu.tree_map(lambda _: True, ends)

        return many(arrays)

    @solve.def_vmap
    def _(_: int, batched: Any, arrays: Any) -> tuple[Ends, Any]:
        ends = batch(arrays, batched[0])
        return ends, jtu.tree_map(lambda _: True, ends)

    return solve(arrays)
