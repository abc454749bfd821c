"""What a motion is to JAX: its value and `jax.vmap` by lanes, its derivatives by diffrax."""

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
    """The motion in a lane; under vmap all motions in lanes; derivatives of `alone`."""

    def value(problem: Problem) -> Ends:
        return _value(solver, max_steps, problem)

    if forward:
        differentiable = eqx.filter_custom_jvp(value)
        differentiable.def_jvp(lambda x, dx: eqx.filter_jvp(alone, x, dx))
        return differentiable(problem)
    differentiable = eqx.filter_custom_vjp(value)

    def forwards(perturbed: Any, problem: Problem) -> tuple[Ends, Any]:
        moved, fixed = eqx.partition(guard_derivative(problem), perturbed)
        ends, pull = eqx.filter_vjp(lambda moved: alone(eqx.combine(moved, fixed)), moved)
        return ends, (pull, eqx.filter(ends, eqx.is_inexact_array))

    def backwards(residual: Any, change: Ends, *_: Any) -> Any:
        pull, ends = residual
        zero = jtu.tree_map(jnp.zeros_like, ends)  # of what is not asked for there is None
        return pull(guard_derivative(eqx.combine(eqx.filter(change, eqx.is_array), zero)))[0]

    differentiable.def_fwd(forwards)
    differentiable.def_bwd(backwards)
    return differentiable(problem)


def _value(solver: Any, max_steps: int, problem: Problem) -> Ends:
    arrays, static = eqx.partition(problem, eqx.is_array)

    @jax.custom_batching.custom_vmap
    def one(arrays: Any) -> Ends:
        each, shared = eqx.partition(arrays, jtu.tree_map(lambda x: x is arrays.y0, arrays))
        each = jtu.tree_map(lambda x: x[None], each)
        ends = in_lanes(eqx.combine(shared, static), each, solver, max_steps)
        return jtu.tree_map(lambda x: x[0], ends)

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

    @one.def_vmap
    def _(_: int, batched: Any, arrays: Any) -> tuple[Ends, Any]:
        ends = batch(arrays, batched[0])
        return ends, jtu.tree_map(lambda _: True, ends)

    return one(arrays)
