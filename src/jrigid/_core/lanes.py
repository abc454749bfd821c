"""What `jax.vmap` of a motion calls: lanes, some at a time."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._core.lanes_last import lanes_last

# So many lanes have their stages in a core's second-level cache; a vector register
# holds 8 of them. Elsewhere than on a CPU many more are needed to keep it busy.
_WIDTH, _WIDTH_ELSEWHERE, _REGISTER = 128, 2**14, 8


def on_cpu() -> bool:
    """Whether that is where it will run."""
    return jax.default_backend() == "cpu"


def width_of(count: int) -> int:
    """How many lanes so many motions take."""
    widest = _WIDTH if on_cpu() else _WIDTH_ELSEWHERE
    # Beside full registers a compiler rounds differently.
    return min(widest, -(-count // _REGISTER) * _REGISTER if count > 1 else count)


def in_blocks(function: Callable[..., Any], problem: Any, *own: Any) -> Any:
    """`function(problem, *own)`; under vmap some lanes at a time, along the last axis."""

    def of_all(shared: Any, each: Any, *own: Any) -> Any:
        def block(each: Any, own: Any) -> Any:
            whole = lambda each, own: function(eqx.combine(each, shared), *own)  # noqa: E731
            return lanes_last(whole, each, own)

        return some_at_a_time(
            block, jnp.arange(jtu.tree_leaves(own)[0].shape[0]), each, own
        )

    return as_lanes(of_all, problem, *own)


def some_at_a_time(function: Callable[..., Any], order: Array, *lanes: Any) -> Any:
    """`function(*lanes)` of blocks of lanes, which it has last, taken in this order."""
    count = order.size
    width = width_of(count)
    order = order[jnp.minimum(jnp.arange(-(-count // width) * width), count - 1)]

    def block(numbers: Array) -> Any:
        found = function(
            *jtu.tree_map(lambda x: jnp.moveaxis(x[numbers], 0, -1), lanes)
        )
        return jtu.tree_map(lambda x: jnp.moveaxis(x, -1, 0), found)

    def in_place(x: Array) -> Array:
        x = x.reshape(-1, *x.shape[2:])
        return jnp.zeros((count, *x.shape[1:]), x.dtype).at[order].set(x)

    return jtu.tree_map(in_place, jax.lax.map(block, order.reshape(-1, width)))


def as_lanes(
    function: Callable[..., Any],
    problem: Any,
    *own: Any,
    tangents: Any = None,
    alone: Callable[..., Any] | None = None,
) -> Any:
    """`function(problem, nothing, *own)`; under vmap `function(shared, each, *own)` of all lanes.

    The leaves of `each` and of `own` have a lane to each index in front; what is shared
    has none. With tangents `function` takes one argument more and gives a pair, of
    which the second depends on it: where only they have another axis it is they alone
    that are mapped. `alone` serves what is not mapped, as `alone(problem, *own)`, where
    that is another function.
    """
    arrays, static = eqx.partition(problem, eqx.is_array)
    leaves, structure = jtu.tree_flatten((arrays, own, tangents))
    motions = len(leaves) - len(jtu.tree_leaves(tangents))
    call = _Call(function, alone, static, structure, motions, tangents is not None)
    of_one = jax.custom_batching.custom_vmap(call.single)

    @of_one.def_vmap
    def _(size: int, batched: Any, *leaves: Any) -> tuple[Any, Any]:
        if not any(batched):
            return _without_axis(call.single(*leaves))
        if not any(batched[:motions]):
            spread = [
                x if has or i < motions else jnp.broadcast_to(x, (size, *x.shape))
                for i, (x, has) in enumerate(zip(leaves, batched, strict=True))
            ]
            return _of_tangents(call.several(*spread))
        found = call.batch(leaves, batched)
        return found, jtu.tree_map(lambda _: True, found)

    return of_one(*leaves)


class _Call(NamedTuple):
    """A call of `as_lanes`, whose arguments come as their leaves.

    Attributes:
        function: Of what lanes share, what is their own, and more that is their own.
        alone: In place of it for one motion, or None.
        static: The parts of the problem that are no arrays.
        structure: Of the arguments: the problem, what is a lane's own, tangents.
        motions: How many of the leaves are no tangents.
        with_tangents: Whether there are tangents.
    """

    function: Callable[..., Any]
    alone: Callable[..., Any] | None
    static: Any
    structure: Any
    motions: int
    with_tangents: bool

    def called(self, problem: Any, each: Any, own: Any, tangents: Any) -> Any:
        """The function's result for lanes."""
        more = (tangents,) if self.with_tangents else ()
        return self.function(eqx.combine(problem, self.static), each, *own, *more)

    def single(self, *leaves: Any) -> Any:
        """The result for one motion."""
        problem, own, tangents = self.structure.unflatten(leaves)
        if self.alone is not None:
            more = (tangents,) if self.with_tangents else ()
            return self.alone(eqx.combine(problem, self.static), *own, *more)
        own = (own, tangents)
        nothing = jtu.tree_map(lambda _: None, problem)
        found = self.called(problem, nothing, *jtu.tree_map(lambda x: x[None], own))
        return jtu.tree_map(lambda x: x[0], found)

    def several(self, *leaves: Any) -> Any:
        """The result for several tangents of one motion."""
        problem, own, tangents = self.structure.unflatten(leaves)

        def push(shared: Any, each: Any, *own: Any) -> Any:
            shared = eqx.filter(shared, eqx.is_array)
            along = lambda x: self.called(shared, each, own[:-1], x)  # noqa: E731
            return jax.vmap(along, in_axes=1, out_axes=(None, 1))(own[-1])

        def push_alone(problem: Any, *own: Any) -> Any:
            assert self.alone is not None
            along = partial(self.alone, problem, *own[:-1])
            return jax.vmap(along, out_axes=(None, 0))(own[-1])

        problem = eqx.combine(problem, self.static)
        one = None if self.alone is None else push_alone
        return as_lanes(push, problem, *own, tangents=tangents, alone=one)

    def of_all(self, leaves: Any, batched: Any) -> Any:
        """The result for lanes, from leaves some of which have an axis of lanes in front."""
        count = next(x.shape[0] for x, has in zip(leaves, batched, strict=True) if has)
        (problem, *own), (has, *own_has) = (
            self.structure.unflatten(x) for x in (leaves, batched)
        )
        each, shared = eqx.partition(problem, has)
        own = jtu.tree_map(
            lambda x, has: x if has else jnp.broadcast_to(x, (count, *x.shape)),
            own,
            own_has,
        )
        return self.called(shared, each, *own)

    def batch(self, leaves: Any, batched: Any) -> Any:
        """The same, which can be mapped again."""

        @jax.custom_batching.custom_vmap
        def lanes(*leaves: Any) -> Any:
            return self.of_all(leaves, batched)

        @lanes.def_vmap
        def _(size: int, again: Any, *leaves: Any) -> tuple[Any, Any]:
            """Lanes of lanes are lanes."""
            if not any(again):
                return _without_axis(self.of_all(leaves, batched))
            if not any(again[: self.motions]):
                axes = [0 if has else None for has in again]
                each = jax.vmap(lambda *x: self.of_all(x, batched), axes, (None, 0))
                return _of_tangents(each(*leaves))
            flags = list(zip(leaves, batched, again, strict=True))
            count = next(x.shape[1 if out else 0] for x, has, out in flags if has)
            flat = [_flat(*x, size, count) for x in flags]
            found = self.batch(flat, [has or out for _, has, out in flags])
            found = jtu.tree_map(lambda x: x.reshape(size, count, *x.shape[1:]), found)
            return found, jtu.tree_map(lambda _: True, found)

        return lanes(*leaves)


def _without_axis(found: Any) -> tuple[Any, Any]:
    """What only derivatives of derivatives give an axis to: they are mapped, not lanes."""
    return found, jtu.tree_map(lambda _: False, found)


def _of_tangents(found: tuple[Any, Any]) -> tuple[Any, Any]:
    motion, tangent = found
    return found, (
        jtu.tree_map(lambda _: False, motion),
        jtu.tree_map(lambda _: True, tangent),
    )


def _flat(x: Array, has: bool, out: bool, size: int, count: int) -> Array:
    """Two axes of lanes as one; none where there is neither."""
    if not (has or out):
        return x
    x = x if out else x[None]
    x = x if has else x[:, None]
    x = jnp.broadcast_to(x, (size, count, *x.shape[2:]))
    return x.reshape(size * count, *x.shape[2:])
