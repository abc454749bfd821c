"""A function of one lane, on many lanes along the last axis.

`jax.vmap(..., in_axes=-1, out_axes=-1)` means the same, but its rules move the lanes to the front
and back again, which takes longer than the work where the work is a few numbers a lane. Here what
goes number by number, or takes arrays apart and puts them together, leaves the lanes where they
are; all else is left to `vmap`.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.extend import core

_NUMBER_BY_NUMBER = {
    "abs", "acos", "acosh", "add", "add_any", "and", "asin", "asinh", "atan", "atan2", "atanh",
    "bitcast_convert_type", "cbrt", "ceil", "convert_element_type", "copy", "cos", "cosh",
    "div", "eq", "erf", "exp", "exp2", "expm1", "floor", "ge", "gt", "integer_pow",
    "is_finite", "le", "log", "log1p", "logistic", "lt", "max", "min", "mul", "ne", "neg",
    "nextafter", "not", "or", "pow", "rem", "round", "rsqrt", "select_n", "sign", "sin",
    "sinh", "sqrt", "square", "sub", "tan", "tanh", "xor",
}  # fmt: skip
# These count axes from the front.
_AS_THEY_ARE = {
    "concatenate", "reduce_and", "reduce_max", "reduce_min", "reduce_or", "reduce_prod",
    "reduce_sum", "rev", "split", "squeeze", "stack", "unstack",
}  # fmt: skip
# Of so few terms these are written out, to be computed with what is around them.
_FEW = 8
_FOLDS = {
    "reduce_max": jax.lax.max,
    "reduce_min": jax.lax.min,
    "reduce_prod": jax.lax.mul,
    "reduce_sum": jax.lax.add,
}


def _changed(name: str, ndim: int, lanes: int, params: dict) -> dict | None:
    """The parameters of an operation on an array with one more axis at its end; None if unknown."""
    if any(params.get(x) is not None for x in ("sharding", "out_sharding", "dimensions")):
        return params if name == "squeeze" else None
    if name in _AS_THEY_ARE:
        return params
    if name == "broadcast_in_dim":
        dimensions = (*params["broadcast_dimensions"], len(params["shape"]))
        return params | {"shape": (*params["shape"], lanes), "broadcast_dimensions": dimensions}
    if name == "reshape":
        return params | {"new_sizes": (*params["new_sizes"], lanes)}
    if name == "transpose":
        return params | {"permutation": (*params["permutation"], ndim)}
    if name == "slice":
        strides = params["strides"] and (*params["strides"], 1)
        start, limit = (*params["start_indices"], 0), (*params["limit_indices"], lanes)
        return params | {"start_indices": start, "limit_indices": limit, "strides": strides}
    return None


def _bind(primitive: Any, params: dict, *values: Any) -> list:
    bound = primitive.get_bind_params(params)
    functions, params = bound if isinstance(bound, tuple) else ((), bound)  # jax 0.9 has the pair
    results = primitive.bind(*functions, *values, **params)
    return list(results) if primitive.multiple_results else [results]


def _apply(eqn: Any, values: list, batched: list[bool], lanes: int) -> list:
    """An operation on values some of which have lanes; its results have."""
    primitive, params = eqn.primitive, eqn.params
    shapes = [x.aval.shape for x in eqn.invars]

    def spread(x: Any, has: bool, shape: tuple[int, ...]) -> Any:
        """In all lanes, and of the shape that the others have, if it is a number."""
        x = x if has else jnp.asarray(x)[..., None]
        x = x.reshape((1,) * (len(shape) + 1 - x.ndim) + x.shape)
        return jnp.broadcast_to(x, (*shape, lanes))

    shape = eqn.outvars[0].aval.shape
    if primitive.name in _NUMBER_BY_NUMBER and all(x in ((), shape) for x in shapes):
        values = [spread(x, has, shape) for x, has in zip(values, batched, strict=True)]
        return _bind(primitive, params, *values)
    changed = _changed(primitive.name, len(shapes[0]), lanes, params)
    if changed is not None:
        values = [spread(*each) for each in zip(values, batched, shapes, strict=True)]
        fold = _FOLDS.get(primitive.name)
        few = values[0].ndim == 2 and 0 < values[0].shape[0] <= _FEW
        if fold is not None and few and params["axes"] == (0,):
            return [functools.reduce(fold, values[0])]
        return _bind(primitive, changed, *values)
    axes = [-1 if has else None for has in batched]
    return jax.vmap(lambda *x: _bind(primitive, params, *x), axes, -1)(*values)


_OF_SCANS = {"jaxpr", "length", "num_carry", "num_consts", "reverse"}
# Calls, and where they keep what they call; derivatives are taken elsewhere.
_CALLS = {
    "jit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "remat2": "jaxpr",
    "checkpoint": "jaxpr",
}


def _in_lanes(x: Any, has: bool, lanes: int) -> Any:
    return x if has else jnp.broadcast_to(jnp.asarray(x)[..., None], (*jnp.shape(x), lanes))


class _Evaluation:
    """A jaxpr on values some of which have lanes."""

    def __init__(self, lanes: int):
        """So many lanes."""
        self.lanes = lanes
        self.functions: dict[Any, Any] = {}

    def __call__(self, jaxpr: Any, consts: Any, arguments: Any) -> list[tuple[Any, bool]]:
        """Values, and whether they have lanes."""
        known: dict[Any, tuple[Any, bool]] = {}

        def read(x: Any) -> tuple[Any, bool]:
            return (x.val, False) if isinstance(x, core.Literal) else known[x]

        known.update(zip(jaxpr.constvars, ((x, False) for x in consts), strict=True))
        known.update(zip(jaxpr.invars, arguments, strict=True))
        for eqn in jaxpr.eqns:
            pairs = [read(x) for x in eqn.invars]
            known.update(zip(eqn.outvars, self.results(eqn, pairs), strict=True))
        return [read(x) for x in jaxpr.outvars]

    def results(self, eqn: Any, pairs: list[tuple[Any, bool]]) -> list[tuple[Any, bool]]:
        """Those of an operation."""
        values, batched = [x for x, _ in pairs], [has for _, has in pairs]
        name, params = eqn.primitive.name, eqn.params
        if not any(batched):
            return [(x, False) for x in _bind(eqn.primitive, params, *values)]
        if name == "scan" and params.keys() >= _OF_SCANS:
            return self.scan(params, pairs)
        if name == "cond" and not batched[0]:
            return self.cond(params, values, batched)
        called = params.get(_CALLS.get(name, ""))
        if called is not None:
            return self.call(called, values, tuple(batched))
        return [(x, True) for x in _apply(eqn, values, batched, self.lanes)]

    def call(self, called: Any, values: list, batched: tuple[bool, ...]) -> list[tuple[Any, bool]]:
        """A function's; one that is called often is traced once."""
        key = id(called), batched
        if key not in self.functions:
            closed = isinstance(called, core.ClosedJaxpr)
            inner, consts = (called.jaxpr, called.consts) if closed else (called, ())
            flags: list[bool] = []

            @jax.jit
            def function(*values: Any) -> list:
                found = self(inner, consts, zip(values, batched, strict=True))
                flags[:] = [has for _, has in found]
                return [x for x, _ in found]

            self.functions[key] = function, flags
        function, flags = self.functions[key]
        return list(zip(function(*values), flags, strict=True))

    def whole(self, closed: Any, arguments: Any) -> list:
        """All results of a branch or a body, in all lanes."""
        found = self(closed.jaxpr, closed.consts, arguments)
        return [_in_lanes(*x, self.lanes) for x in found]

    def scan(self, params: dict, pairs: list[tuple[Any, bool]]) -> list[tuple[Any, bool]]:
        """A loop of a known length."""
        first, last = params["num_consts"], params["num_consts"] + params["num_carry"]
        consts, carry, rows = pairs[:first], pairs[first:last], pairs[last:]

        def step(carry: list, values: list) -> tuple[list, list]:
            row = zip(values, (has for _, has in rows), strict=True)
            found = self.whole(params["jaxpr"], [*consts, *((x, True) for x in carry), *row])
            return found[: len(carry)], found[len(carry) :]

        start = [_in_lanes(*x, self.lanes) for x in carry]
        how = {x: params[x] for x in ("length", "reverse")}
        end, stacked = jax.lax.scan(step, start, [x for x, _ in rows], **how)
        return [(x, True) for x in (*end, *stacked)]

    def cond(self, params: dict, values: list, batched: list[bool]) -> list[tuple[Any, bool]]:
        """A branch that all lanes take."""

        def branch(closed: Any) -> Callable[..., list]:
            return lambda *values: self.whole(closed, zip(values, batched[1:], strict=True))

        branches = [branch(x) for x in params["branches"]]
        return [(x, True) for x in jax.lax.switch(values[0], branches, *values[1:])]


def lanes_last(function: Callable[..., Any], *arguments: Any) -> Any:
    """The results of a function of arrays, all of which have lanes along their last axis."""
    leaves, structure = jtu.tree_flatten(arguments)
    lanes = leaves[0].shape[-1]
    shapes = [jax.ShapeDtypeStruct(x.shape[:-1], x.dtype) for x in leaves]

    def flat(*leaves: Any) -> Any:
        return function(*structure.unflatten(leaves))

    jaxpr, results = jax.make_jaxpr(flat, return_shape=True)(*shapes)
    found = _Evaluation(lanes).whole(jaxpr, [(x, True) for x in leaves])
    return jtu.tree_structure(results).unflatten(found)
