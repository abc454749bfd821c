"""Every use of what jax, equinox and diffrax do not document.

Such parts may change with any release. Therefore all of them are in this module, with
the versions with which they were tested, and pyproject.toml bounds equinox and diffrax
below the next minor release. `tests/test_third_party.py` checks the tables of
primitives. `tests/test_house.py` checks that no other module uses private parts.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import numpy as np
from equinox.internal import unvmap_any as unvmap_any
from jax._src.core import EvalTrace, trace_ctx
from jax._src.interpreters.batching import BatchTrace
from jax.extend import core
from jax.interpreters import ad as ad
from jax.interpreters import batching, partial_eval
from jax.interpreters import mlir as mlir
from jaxtyping import PyTree

#: Oldest and newest versions with which the test suite has passed.
TESTED_WITH = {
    "jax": ("0.9.0", "0.12.0.1"),
    "equinox": ("0.13.3", "0.13.8"),
    "diffrax": ("0.7.2", "0.7.2"),
}

# equinox: enumerations ----------------------------------------------------------------

#: The metaclass of `equinox.Enumeration`, as a base of metaclasses.
EnumerationMeta = type(eqx.Enumeration)

#: The class of the items of every enumeration.
EnumerationItem = type(diffrax.RESULTS.successful)


def code_of(item: PyTree) -> Any:
    """The integer code of an item of an enumeration, or the codes of many lanes.

    It is an array, or its substitute in a pytree of shapes.
    """
    return item._value


# pyright takes equinox's enumerations and their items for those of `enum`.
class _Code(EnumerationItem):  # pyright: ignore[reportGeneralTypeIssues]
    """An item that `int` and numpy convert to its code."""

    def __index__(self) -> int:
        return int(code_of(self))

    def __array__(
        self, dtype: np.dtype | type | None = None, copy: bool | None = None
    ) -> np.ndarray:
        del copy
        return np.array(code_of(self), dtype)


def with_codes(enumeration: type) -> Any:
    """The same enumeration, with items that `int` and numpy convert to codes."""
    items = vars(enumeration)["_name_to_item"]
    for name, item in items.items():
        code: Any = code_of(item)
        items[name] = _Code(code, enumeration)  # pyright: ignore[reportCallIssue]
    return enumeration


def enumeration_of(item: PyTree) -> Any:
    """The enumeration that an item belongs to."""
    return item._enumeration


def names_of(enumeration: type) -> tuple[str, ...]:
    """The names of an enumeration's items, in the order of their codes."""
    return tuple(vars(enumeration)["_name_to_item"])


def messages_of(enumeration: type) -> tuple[str, ...]:
    """The messages of an enumeration's items, in the order of their codes."""
    return tuple(vars(enumeration)["_index_to_message"])


# diffrax: terms -----------------------------------------------------------------------


def unwrapped_term(term: Any) -> tuple[Any, Any]:
    """A term as the user passed it, and the direction of time.

    In `diffeqsolve` time always grows. It passes each term to the solver in a wrapper
    with the direction of time, 1 or -1.
    """
    return getattr(term, "term", term), getattr(term, "direction", 1)


# jax: programs ------------------------------------------------------------------------

ClosedJaxpr = core.ClosedJaxpr
Jaxpr = core.Jaxpr
JaxprEqn = core.JaxprEqn
Literal = core.Literal
Primitive = core.Primitive
jaxpr_as_fun = core.jaxpr_as_fun

#: The parameters of an operation, by their names.
Parameters = dict[str, Any]


def outside_of_jit() -> bool:
    """Whether values are known at this place: nothing is compiled or differentiated.

    Under `jax.vmap` alone the values of all lanes are known.
    """
    trace = trace_ctx.trace
    while isinstance(trace, BatchTrace):
        trace = trace.parent_trace
    return isinstance(trace, EvalTrace)


def shape_of(variable: Any) -> tuple[int, ...]:
    """The shape of an input or an output of an operation in a program."""
    return variable.aval.shape


def used_inputs(program: core.ClosedJaxpr) -> list[bool]:
    """Whether an output of a program depends on each of its inputs."""
    jaxpr = program.jaxpr
    _, used = partial_eval.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    return used


def set_vmap_rule(primitive: core.Primitive, rule: Callable[..., Any]) -> None:
    """Set the rule of `jax.vmap` for a primitive.

    Args:
        primitive: The primitive.
        rule: `rule(arguments, axes)` returns the result and its axis.
    """
    batching.primitive_batchers[primitive] = rule


def apply(primitive: core.Primitive, parameters: Parameters, *values: Any) -> list[Any]:
    """The results of a primitive with the parameters that it has in a program."""
    bound = primitive.get_bind_params(parameters)
    # jax 0.9 returns functions beside the parameters.
    functions, parameters = bound if isinstance(bound, tuple) else ((), bound)
    results = primitive.bind(*functions, *values, **parameters)
    return list(results) if primitive.multiple_results else [results]


def known_primitives(names: str) -> frozenset[core.Primitive]:
    """The primitives of these names, as far as this version of jax has them.

    Primitives are compared as objects, since another package may use the same name.
    """
    primitives = set()
    for name in names.split():
        attribute = f"{name}_p"
        for module in (core.primitives, jax.lax):
            if hasattr(module, attribute):
                primitives.add(getattr(module, attribute))
    return frozenset(primitives)


# jax: primitives on arrays with one more axis, at the end -----------------------------

#: These compute each number of the result from the numbers at the same place of the
#: arguments, unless the shapes differ (see `is_elementwise`).
ELEMENTWISE_NAMES = """
abs acos acosh add add_jaxvals and asin asinh atan atan2 atanh bitcast_convert_type cbrt
ceil clamp convert_element_type copy cos cosh div eq erf exp exp2 expm1 floor ge gt
integer_pow is_finite le log log1p log2 logistic lt max min mul ne neg nextafter not or
pow reduce_precision rem round rsqrt select_n sign sin sinh sqrt square sub tan tanh xor
"""
ELEMENTWISE = known_primitives(ELEMENTWISE_NAMES)

#: These count axes from the front, so that one more at the end changes nothing.
AXES_FROM_FRONT_NAMES = """
concatenate reduce_and reduce_max reduce_min reduce_or reduce_prod reduce_sum rev split
squeeze stack unstack
"""
AXES_FROM_FRONT = known_primitives(AXES_FROM_FRONT_NAMES)


def _broadcast_with_axis(parameters: Parameters, size: int) -> Parameters:
    shape = parameters["shape"]
    return {
        "shape": (*shape, size),
        "broadcast_dimensions": (*parameters["broadcast_dimensions"], len(shape)),
    }


def _reshape_with_axis(parameters: Parameters, size: int) -> Parameters:
    order = parameters["dimensions"]
    return {
        "new_sizes": (*parameters["new_sizes"], size),
        "dimensions": None if order is None else (*order, len(order)),
    }


def _transpose_with_axis(parameters: Parameters, size: int) -> Parameters:
    del size
    permutation = parameters["permutation"]
    return {"permutation": (*permutation, len(permutation))}


def _slice_with_axis(parameters: Parameters, size: int) -> Parameters:
    strides = parameters["strides"]
    return {
        "start_indices": (*parameters["start_indices"], 0),
        "limit_indices": (*parameters["limit_indices"], size),
        "strides": None if strides is None else (*strides, 1),
    }


#: The parameters of these hold an entry for each axis: the entries with one axis more.
CHANGED_BY_AXIS = {
    "broadcast_in_dim": _broadcast_with_axis,
    "reshape": _reshape_with_axis,
    "transpose": _transpose_with_axis,
    "slice": _slice_with_axis,
}

#: Slices at places that are computed, and how many arrays come before the places.
DYNAMIC_SLICES = {"dynamic_slice": 1, "dynamic_update_slice": 2}

#: Calls of other programs, and the parameter that holds the program. Other parameters
#: of a call, such as a derivative rule, do not affect its values.
CALLS = {
    "jit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "remat": "jaxpr",
}


def _by_primitive(table: dict[str, Any]) -> dict[core.Primitive, Any]:
    """A table by primitives instead of their names."""
    return {
        primitive: value
        for name, value in table.items()
        for primitive in known_primitives(name)
    }


#: What reductions do with two numbers.
FOLDS = _by_primitive(
    {
        "reduce_max": jax.lax.max,
        "reduce_min": jax.lax.min,
        "reduce_prod": jax.lax.mul,
        "reduce_sum": jax.lax.add,
    }
)

_CHANGED_BY_AXIS = _by_primitive(CHANGED_BY_AXIS)
_DYNAMIC_SLICES = _by_primitive(DYNAMIC_SLICES)
_CALLS = _by_primitive(CALLS)
#: The rule that vmap has for these is right only where the mapped axis is the first.
LANES_IN_FRONT = known_primitives("bitcast_convert_type")

_SHARDINGS = ("sharding", "out_sharding")


def _is_sharded(parameters: dict[str, Any]) -> bool:
    """Whether there is a layout over devices, which has an entry for each axis."""
    return any(parameters.get(name) is not None for name in _SHARDINGS)


def is_elementwise(equation: core.JaxprEqn) -> bool:
    """Whether each number of the result depends on those at the same place alone.

    Arguments have the shape of the result, or are single numbers. This excludes a
    `bitcast_convert_type` to numbers of another size, which changes the shape.
    """
    if equation.primitive not in ELEMENTWISE or _is_sharded(equation.params):
        return False
    shape = shape_of(equation.outvars[0])
    shapes = [shape_of(x) for x in equation.invars]
    return shape in shapes and all(x in ((), shape) for x in shapes)


def with_last_axis(equation: core.JaxprEqn, size: int) -> Parameters | None:
    """Parameters with which an operation does the same to arrays with one more axis.

    The axis is the last one and of this size. None for a primitive that is not in the
    tables.
    """
    primitive, parameters = equation.primitive, equation.params
    if _is_sharded(parameters):
        return None
    if primitive in AXES_FROM_FRONT:
        return parameters
    if primitive in _CHANGED_BY_AXIS:
        return parameters | _CHANGED_BY_AXIS[primitive](parameters, size)
    return None


def dynamic_slice_of(equation: core.JaxprEqn) -> int | None:
    """Number of arrays that a slice at a computed place takes, or None for no slice."""
    return _DYNAMIC_SLICES.get(equation.primitive)


def slice_with_last_axis(equation: core.JaxprEqn, size: int, *values: Any) -> Any:
    """A slice, read or written, of arrays with one more axis at their end."""
    arrays = _DYNAMIC_SLICES[equation.primitive]
    # The slice takes all lanes, so that it starts at the first one.
    starts = [*values[arrays:], jax.numpy.zeros_like(values[-1])]
    if arrays == 1:
        sizes = (*equation.params["slice_sizes"], size)
        return jax.lax.dynamic_slice(
            values[0], starts, sizes, allow_negative_indices=False
        )
    return jax.lax.dynamic_update_slice(
        values[0], values[1], starts, allow_negative_indices=False
    )


def called_program(
    equation: core.JaxprEqn,
) -> core.ClosedJaxpr | core.Jaxpr | None:
    """The program that an operation calls, a `ClosedJaxpr` or a `Jaxpr`, or None."""
    return equation.params.get(_CALLS.get(equation.primitive, ""))


def jaxpr_of(program: core.ClosedJaxpr | core.Jaxpr) -> core.Jaxpr:
    """The program without its constants."""
    return program.jaxpr if isinstance(program, core.ClosedJaxpr) else program


class Scan(NamedTuple):
    """The parts of a `jax.lax.scan` in a program."""

    body: core.ClosedJaxpr
    length: int
    reverse: bool
    constants: slice  # of the arguments
    carry: slice
    rows: slice


_SCANS = known_primitives("scan")
_CONDS = known_primitives("cond")


def _scan_counts(parameters: Parameters) -> tuple[int, int] | None:
    """Numbers of constants and of arrays in the carry, the first inputs of a scan."""
    if "num_consts" in parameters and "num_carry" in parameters:
        return parameters["num_consts"], parameters["num_carry"]
    if "ft_in" in parameters:  # from jax 0.12 on
        constants, carry, _ = parameters["ft_in"].unpack()
        return len(constants), len(carry)
    return None


def scan_of(equation: core.JaxprEqn) -> Scan | None:
    """The parts of a loop of a known length; None for anything else."""
    if equation.primitive not in _SCANS:
        return None
    parameters = equation.params
    counts = _scan_counts(parameters)
    if counts is None:
        return None
    first = counts[0]
    last = first + counts[1]
    return Scan(
        body=parameters["jaxpr"],
        length=parameters["length"],
        reverse=parameters["reverse"],
        constants=slice(first),
        carry=slice(first, last),
        rows=slice(last, None),
    )


def branches_of(equation: core.JaxprEqn) -> Sequence[core.ClosedJaxpr] | None:
    """The branches of a `jax.lax.cond` or `switch`, or None.

    The first argument chooses the branch; the others are its arguments.
    """
    if equation.primitive not in _CONDS:
        return None
    return equation.params.get("branches")


#: For elementary functions XLA's CPU compiler calls the C library for each number.
_NO_ARITHMETIC = known_primitives(
    "acos acosh asin asinh atan atan2 atanh cbrt cos cosh erf exp exp2 expm1 log log1p "
    "log2 logistic pow sin sinh tan tanh cond scan while"
)


def arithmetic_operations(jaxpr: core.Jaxpr) -> int | None:
    """Number of operations of a program if all are arithmetic, else None.

    Elementary functions, loops and branches are not arithmetic.
    """
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive in _NO_ARITHMETIC:
            return None
        called = called_program(equation)
        if called is None:
            total += 1
            continue
        count = arithmetic_operations(jaxpr_of(called))
        if count is None:
            return None
        total += count
    return total
