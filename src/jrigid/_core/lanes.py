"""Rules of `jax.vmap` for motions: lanes, some at a time."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from jrigid._core.lanes_last import lanes_last

# Number of lanes whose stages fit into the second-level cache of a core.
_WIDTH = 128
# Number of lanes that keep another device busy.
_WIDTH_ELSEWHERE = 2**14
# Number of lanes in a vector register.
_REGISTER = 8


def on_cpu() -> bool:
    """Whether the default device is a CPU."""
    return jax.default_backend() == "cpu"


def width_of(count: int) -> int:
    """Number of lanes for this number of motions."""
    if count <= 1:
        return count
    widest = _WIDTH if on_cpu() else _WIDTH_ELSEWHERE
    # Registers are full, since compiled code rounds differently in the remainder.
    return min(widest, -(-count // _REGISTER) * _REGISTER)


def in_blocks(function: Callable[..., Any], problem: PyTree, *own: PyTree) -> PyTree:
    """`function(problem, *own)`; under vmap in blocks of lanes, which are last."""

    def of_all(shared: PyTree, each: PyTree, *own: PyTree) -> PyTree:
        def block(each: PyTree, own: PyTree) -> PyTree:
            def whole(each: PyTree, own: PyTree) -> PyTree:
                return function(eqx.combine(each, shared), *own)

            return lanes_last(whole, each, own)

        return some_at_a_time(
            block, jnp.arange(jtu.tree_leaves(own)[0].shape[0]), each, own
        )

    return as_lanes(of_all, problem, *own)


def some_at_a_time(
    function: Callable[..., Any], order: Array, *lanes: PyTree
) -> PyTree:
    """Evaluate a function on blocks of lanes, one block after the other.

    Args:
        function: Of `lanes`, with the lanes of a block along the last axis.
        order: Numbers of the lanes, in the order in which they form blocks.
        lanes: Arguments with lanes in front.
    """
    count = order.size
    width = width_of(count)
    # The last lane is repeated to fill the last block, since blocks have one shape.
    order = order[jnp.minimum(jnp.arange(-(-count // width) * width), count - 1)]

    def block(numbers: Array) -> PyTree:
        arguments = jtu.tree_map(lambda x: jnp.moveaxis(x[numbers], 0, -1), lanes)
        results = function(*arguments)
        return jtu.tree_map(lambda x: jnp.moveaxis(x, -1, 0), results)

    def in_place(x: Array) -> Array:
        x = x.reshape(-1, *x.shape[2:])
        # Repeated lanes have equal results, so the order of storing does not matter.
        return jnp.zeros((count, *x.shape[1:]), x.dtype).at[order].set(x)

    return jtu.tree_map(in_place, jax.lax.map(block, order.reshape(-1, width)))


def as_lanes(
    function: Callable[..., Any],
    problem: PyTree,
    *own: PyTree,
    tangents: PyTree = None,
    alone: Callable[..., Any] | None = None,
) -> PyTree:
    """Call a function of one motion; under vmap call it once for all lanes.

    Args:
        function: Called as `function(problem, nothing, *own)`, with None for all leaves
            of `nothing`. Under vmap it is called as `function(shared, each, *own)`: the
            leaves of `each` and `own` have an axis of lanes in front, those of `shared`
            have none.
        problem: What lanes may share.
        own: What each lane has for itself.
        tangents: A further argument of `function`, which then returns a pair of values
            and tangents. If only tangents are batched, they alone are mapped.
        alone: Called as `alone(problem, *own)` in place of `function` without vmap.
    """
    # `custom_vmap` takes arrays only.
    arrays, static = eqx.partition(problem, eqx.is_array)
    leaves, structure = jtu.tree_flatten((arrays, own, tangents))
    # The tangents are the last of the leaves.
    motions = len(leaves) - len(jtu.tree_leaves(tangents))
    call = _Call(function, alone, static, structure, motions, tangents is not None)
    of_one = jax.custom_batching.custom_vmap(call.single)

    @of_one.def_vmap
    def _(size: int, batched: PyTree, *leaves: PyTree) -> tuple[PyTree, PyTree]:
        if not any(batched):
            return _without_axis(call.single(*leaves))
        # A Jacobian has several tangents of one motion, which is integrated once.
        if not any(batched[:motions]):
            spread = [
                x if has or i < motions else jnp.broadcast_to(x, (size, *x.shape))
                for i, (x, has) in enumerate(zip(leaves, batched, strict=True))
            ]
            return _of_tangents(call.several(*spread))
        results = call.batch(leaves, batched)
        return results, jtu.tree_map(lambda _: True, results)

    return of_one(*leaves)


class _Call(NamedTuple):
    """A call of `as_lanes`, whose arguments are passed as their leaves.

    Attributes:
        function: As in `as_lanes`.
        alone: As in `as_lanes`.
        static: The parts of the problem that are no arrays.
        structure: Of the arguments: problem, own, and tangents.
        motions: Number of leaves that are no tangents.
        with_tangents: Whether there are tangents.
    """

    function: Callable[..., Any]
    alone: Callable[..., Any] | None
    static: Any
    structure: Any
    motions: int
    with_tangents: bool

    def called(
        self, problem: PyTree, each: PyTree, own: PyTree, tangents: PyTree
    ) -> PyTree:
        """The result of the function for lanes."""
        more = (tangents,) if self.with_tangents else ()
        return self.function(eqx.combine(problem, self.static), each, *own, *more)

    def single(self, *leaves: PyTree) -> PyTree:
        """The result for one motion."""
        problem, own, tangents = self.structure.unflatten(leaves)
        if self.alone is not None:
            more = (tangents,) if self.with_tangents else ()
            return self.alone(eqx.combine(problem, self.static), *own, *more)
        own = (own, tangents)
        nothing = jtu.tree_map(lambda _: None, problem)
        results = self.called(problem, nothing, *jtu.tree_map(lambda x: x[None], own))
        return jtu.tree_map(lambda x: x[0], results)

    def several(self, *leaves: PyTree) -> PyTree:
        """The result for several tangents of one motion."""
        problem, own, tangents = self.structure.unflatten(leaves)

        def push(shared: PyTree, each: PyTree, *own: PyTree) -> PyTree:
            shared = eqx.filter(shared, eqx.is_array)

            def along(tangent: PyTree) -> PyTree:
                return self.called(shared, each, own[:-1], tangent)

            # The first axis is that of lanes. The values are the same for all tangents.
            return jax.vmap(along, in_axes=1, out_axes=(None, 1))(own[-1])

        def push_alone(problem: PyTree, *own: PyTree) -> PyTree:
            assert self.alone is not None
            along = partial(self.alone, problem, *own[:-1])
            return jax.vmap(along, out_axes=(None, 0))(own[-1])

        problem = eqx.combine(problem, self.static)
        # `push` serves one motion too if there is no function for it.
        one = None if self.alone is None else push_alone
        return as_lanes(push, problem, *own, tangents=tangents, alone=one)

    def of_all(self, leaves: PyTree, batched: PyTree) -> PyTree:
        """The result for lanes, from leaves of which `batched` have lanes in front."""
        # All batched leaves have the same number of lanes.
        count = next(x.shape[0] for x, has in zip(leaves, batched, strict=True) if has)
        problem, *own = self.structure.unflatten(leaves)
        problem_has, *own_has = self.structure.unflatten(batched)
        each, shared = eqx.partition(problem, problem_has)
        own = jtu.tree_map(
            lambda x, has: x if has else jnp.broadcast_to(x, (count, *x.shape)),
            own,
            own_has,
        )
        return self.called(shared, each, *own)

    def batch(self, leaves: PyTree, batched: PyTree) -> PyTree:
        """The result for lanes, by a function that can be mapped again."""

        @jax.custom_batching.custom_vmap
        def lanes(*leaves: PyTree) -> PyTree:
            return self.of_all(leaves, batched)

        @lanes.def_vmap
        def _(size: int, again: PyTree, *leaves: PyTree) -> tuple[PyTree, PyTree]:
            """Join two axes of lanes to one."""
            if not any(again):
                return _without_axis(self.of_all(leaves, batched))
            if not any(again[: self.motions]):
                axes = [0 if has else None for has in again]
                each = jax.vmap(lambda *x: self.of_all(x, batched), axes, (None, 0))
                return _of_tangents(each(*leaves))
            # Both axes together fill the blocks of lanes; the inner one alone may not.
            flags = list(zip(leaves, batched, again, strict=True))
            count = next(x.shape[1 if out else 0] for x, has, out in flags if has)
            flat = [_flat(*x, size, count) for x in flags]
            results = self.batch(flat, [has or out for _, has, out in flags])
            results = jtu.tree_map(
                lambda x: x.reshape(size, count, *x.shape[1:]), results
            )
            return results, jtu.tree_map(lambda _: True, results)

        return lanes(*leaves)


def _without_axis(results: PyTree) -> tuple[PyTree, PyTree]:
    """Results without an axis of lanes, with their flags for `custom_vmap`.

    Under derivatives of derivatives there is a vmap over none of the arguments.
    """
    return results, jtu.tree_map(lambda _: False, results)


def _of_tangents(results: tuple[PyTree, PyTree]) -> tuple[PyTree, PyTree]:
    """Results whose tangents alone have an axis, with flags for `custom_vmap`."""
    values, tangents = results
    flags = (
        jtu.tree_map(lambda _: False, values),
        jtu.tree_map(lambda _: True, tangents),
    )
    return results, flags


def _flat(x: Array, has: bool, out: bool, size: int, count: int) -> Array:
    """Join two axes of lanes to one.

    Args:
        x: An array with none, one or both of the axes.
        has: Whether it has the inner axis.
        out: Whether it has the outer axis.
        size: Length of the outer axis.
        count: Length of the inner axis.
    """
    if not (has or out):
        return x
    x = x if out else x[None]
    x = x if has else x[:, None]
    x = jnp.broadcast_to(x, (size, count, *x.shape[2:]))
    return x.reshape(size * count, *x.shape[2:])
