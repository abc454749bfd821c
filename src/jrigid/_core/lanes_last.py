"""Evaluate a function of one lane on many lanes, which are along the last axis.

`jax.vmap(..., in_axes=-1, out_axes=-1)` has the same result, but its rules move the
lanes to the front and back again. For a few numbers in each lane this takes longer than
the computation. Here elementwise operations, and operations that split and join arrays,
leave the lanes along the last axis. `vmap` does all others.
"""

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from jrigid._core import third_party

# Reductions of at most this many terms are written out, so that XLA fuses them.
_FEW = 8


def _spread(x: PyTree, has_lanes: bool, shape: tuple[int, ...], lanes: int) -> Array:
    """Broadcast a value to all lanes, and a number to this shape in each lane."""
    x = x if has_lanes else jnp.asarray(x)[..., None]
    x = x.reshape((1,) * (len(shape) + 1 - x.ndim) + x.shape)
    return jnp.broadcast_to(x, (*shape, lanes))


def _apply(
    equation: third_party.JaxprEqn, values: list, batched: list[bool], lanes: int
) -> list:
    """The results, with lanes, of an operation on values some of which have lanes."""
    primitive = equation.primitive
    parameters = equation.params
    pairs = list(zip(values, batched, strict=True))
    if third_party.is_elementwise(equation):
        shape = third_party.shape_of(equation.outvars[0])
        values = [_spread(x, has, shape, lanes) for x, has in pairs]
        return third_party.apply(primitive, parameters, *values)
    with_lanes = third_party.with_last_axis(equation, lanes)
    if with_lanes is None:
        return _apply_by_vmap(equation, pairs)
    shapes = [third_party.shape_of(x) for x in equation.invars]
    triples = zip(values, batched, shapes, strict=True)
    values = [_spread(x, has, shape, lanes) for x, has, shape in triples]
    fold = third_party.FOLDS.get(primitive)
    few = values[0].ndim == 2 and 0 < values[0].shape[0] <= _FEW
    if fold is not None and few and parameters["axes"] == (0,):
        return [functools.reduce(fold, values[0])]
    return third_party.apply(primitive, with_lanes, *values)


def _apply_by_vmap(
    equation: third_party.JaxprEqn, pairs: Sequence[tuple[Any, bool]]
) -> list:
    """The results, with lanes, of an operation for which there is no rule here."""
    axis = 0 if equation.primitive in third_party.LANES_IN_FRONT else -1
    axes = [axis if has else None for _, has in pairs]
    values = [jnp.moveaxis(x, -1, axis) if has else x for x, has in pairs]
    alone = functools.partial(third_party.apply, equation.primitive, equation.params)
    return jax.vmap(alone, axes, -1)(*values)


def _in_lanes(x: PyTree, has_lanes: bool, lanes: int) -> Array:
    """Broadcast a value to all lanes if it has none."""
    if has_lanes:
        return x
    return jnp.broadcast_to(jnp.asarray(x)[..., None], (*jnp.shape(x), lanes))


def _results_vary(jaxpr: third_party.Jaxpr, batched: Sequence[bool]) -> list[bool]:
    """Whether each result of a program has lanes if these of its arguments have."""
    known = dict(zip(jaxpr.invars, batched, strict=True))

    def has_lanes(x: Any) -> bool:
        return not isinstance(x, third_party.Literal) and known.get(x, False)

    for equation in jaxpr.eqns:
        flags = [has_lanes(x) for x in equation.invars]
        called = third_party.called_program(equation)
        scan = third_party.scan_of(equation)
        if not any(flags):
            results = [False] * len(equation.outvars)
        elif scan is not None:
            results = _vary(scan, flags)
        elif called is not None:
            inner = third_party.jaxpr_of(called)
            results = _results_vary(inner, flags)
        else:
            results = [True] * len(equation.outvars)
        known.update(zip(equation.outvars, results, strict=True))
    return [has_lanes(x) for x in jaxpr.outvars]


def _vary(scan: third_party.Scan, batched: Sequence[bool]) -> list[bool]:
    """Whether each result of a scan has lanes.

    A part of the carry has lanes if an iteration gives it lanes.
    """
    flags = list(batched)
    # Lanes may reach one more part of the carry in each iteration. A part has the same
    # shape in all iterations, so it has its lanes from the start.
    while True:
        results = _results_vary(scan.body.jaxpr, flags)
        before = flags[scan.carry]
        # After the carry, `results` has the rows that the scan stacks, which do not
        # count.
        carried = [a or b for a, b in zip(before, results, strict=False)]
        if carried == before:
            return carried + results[len(carried) :]
        flags[scan.carry] = carried


class _Evaluation:
    """Evaluates programs on values some of which have lanes."""

    def __init__(self, lanes: int):
        """An evaluation with this number of lanes."""
        self.lanes = lanes
        self.functions: dict[Any, Any] = {}

    def __call__(
        self,
        jaxpr: third_party.Jaxpr,
        consts: Sequence[Any],
        arguments: Iterable[tuple[Any, bool]],
    ) -> list[tuple[Any, bool]]:
        """Values, and whether they have lanes."""
        known: dict[Any, tuple[Any, bool]] = {}

        def read(x: Any) -> tuple[Any, bool]:
            return (x.val, False) if isinstance(x, third_party.Literal) else known[x]

        known.update(zip(jaxpr.constvars, ((x, False) for x in consts), strict=True))
        known.update(zip(jaxpr.invars, arguments, strict=True))
        for eqn in jaxpr.eqns:
            pairs = [read(x) for x in eqn.invars]
            known.update(zip(eqn.outvars, self.results(eqn, pairs), strict=True))
        return [read(x) for x in jaxpr.outvars]

    def results(
        self, eqn: third_party.JaxprEqn, pairs: list[tuple[Any, bool]]
    ) -> list[tuple[Any, bool]]:
        """The results of an operation, and whether they have lanes."""
        values = [x for x, _ in pairs]
        batched = [has for _, has in pairs]
        # What lanes share is computed once.
        if not any(batched):
            alone = third_party.apply(eqn.primitive, eqn.params, *values)
            return [(x, False) for x in alone]
        scan = third_party.scan_of(eqn)
        if scan is not None:
            return self.scan(scan, pairs)
        branches = third_party.branches_of(eqn)
        # If lanes take different branches, vmap evaluates all branches and selects.
        if branches is not None and not batched[0]:
            return self.cond(branches, values, batched)
        arrays = third_party.dynamic_slice_of(eqn)
        # A place that differs between lanes needs a gather, which is left to vmap.
        if arrays is not None and not any(batched[arrays:]):
            values = [
                *(_in_lanes(*x, self.lanes) for x in pairs[:arrays]),
                *values[arrays:],
            ]
            result = third_party.slice_with_last_axis(eqn, self.lanes, *values)
            return [(result, True)]
        called = third_party.called_program(eqn)
        if called is not None:
            return self.call(called, values, tuple(batched))
        return [(x, True) for x in _apply(eqn, values, batched, self.lanes)]

    def call(
        self,
        called: third_party.ClosedJaxpr | third_party.Jaxpr,
        values: list,
        batched: tuple[bool, ...],
    ) -> list[tuple[Any, bool]]:
        """The results of a called function, which is traced once for all its calls."""
        # The id stays valid, since the program that is evaluated holds `called`.
        key = id(called), batched
        if key not in self.functions:
            closed = isinstance(called, third_party.ClosedJaxpr)
            inner, consts = (called.jaxpr, called.consts) if closed else (called, ())
            flags: list[bool] = []

            @jax.jit
            def function(*values: Any) -> list:
                results = self(inner, consts, zip(values, batched, strict=True))
                # A jitted function returns arrays alone, so the flags are stored while
                # it is traced.
                flags[:] = [has for _, has in results]
                return [x for x, _ in results]

            self.functions[key] = function, flags
        function, flags = self.functions[key]
        return list(zip(function(*values), flags, strict=True))

    def whole(
        self, closed: third_party.ClosedJaxpr, arguments: Iterable[tuple[Any, bool]]
    ) -> list:
        """All results of a branch or a body, in all lanes."""
        results = self(closed.jaxpr, closed.consts, arguments)
        return [_in_lanes(*x, self.lanes) for x in results]

    def scan(
        self,
        scan: third_party.Scan,
        pairs: list[tuple[Any, bool]],
    ) -> list[tuple[Any, bool]]:
        """The results of a loop of known length."""
        consts = pairs[scan.constants]
        carry = pairs[scan.carry]
        rows = pairs[scan.rows]
        varies = _vary(scan, [has for _, has in pairs])

        def in_lanes(pairs: list[tuple[Any, bool]]) -> list:
            """Values, in lanes where the results of the loop have lanes."""
            return [
                _in_lanes(x, has, self.lanes) if vary else x
                for (x, has), vary in zip(pairs, varies, strict=False)
            ]

        def step(carry: list, values: list) -> tuple[list, list]:
            carried = zip(carry, varies, strict=False)
            # Rows are along the first axis and lanes along the last, so a row keeps its
            # lanes.
            row = zip(values, (has for _, has in rows), strict=True)
            arguments = [*consts, *carried, *row]
            results = in_lanes(self(scan.body.jaxpr, scan.body.consts, arguments))
            return results[: len(carry)], results[len(carry) :]

        rows_alone = [x for x, _ in rows]
        end, stacked = jax.lax.scan(
            step, in_lanes(carry), rows_alone, scan.length, scan.reverse
        )
        return list(zip((*end, *stacked), varies, strict=True))

    def cond(
        self,
        branches: Sequence[third_party.ClosedJaxpr],
        values: list,
        batched: list[bool],
    ) -> list[tuple[Any, bool]]:
        """The results of a branch that all lanes take."""

        def branch(closed: third_party.ClosedJaxpr) -> Callable[..., list]:
            def results(*values: Any) -> list:
                # All branches must return arrays of the same shapes, so each result
                # gets lanes.
                return self.whole(closed, zip(values, batched[1:], strict=True))

            return results

        in_lanes = [branch(x) for x in branches]
        return [(x, True) for x in jax.lax.switch(values[0], in_lanes, *values[1:])]


def lanes_last(function: Callable[..., Any], *arguments: Any) -> Any:
    """The results of a function of one lane, for arguments with lanes last."""
    leaves, structure = jtu.tree_flatten(arguments)
    lanes = leaves[0].shape[-1]
    shapes = [jax.ShapeDtypeStruct(x.shape[:-1], x.dtype) for x in leaves]

    def flat(*leaves: Any) -> Any:
        return function(*structure.unflatten(leaves))

    jaxpr, results = jax.make_jaxpr(flat, return_shape=True)(*shapes)
    values = _Evaluation(lanes).whole(jaxpr, [(x, True) for x in leaves])
    return jtu.tree_structure(results).unflatten(values)
