"""A step of an explicit Runge-Kutta method as a loop over its stages, and its reverse.

The loop evaluates the vector field in one place, so the compiled program does not grow
with the number of stages. The reverse of a step is another Runge-Kutta step (E. Hairer,
C. Lubich, G. Wanner, Geometric Numerical Integration, 2nd ed., section VI.3). It is
written out here, as a loop too.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from jrigid._core.third_party import arithmetic_operations
from jrigid._stepping.method import Groups, Method
from jrigid._types import AnyArray

# A vector field with at most this many operations is short. That of a heavy top has
# 179, that of a heavy top with a tangent beside it 474.
_SHORT = 250

#: A pytree of arrays.
Parameters = TypeVar("Parameters")

Field = Callable[[Float[Array, ""], Float[Array, " n"]], Float[Array, " n"]]


def combine(
    row: Float[np.ndarray, " stages"], rates: Float[Array, "stages n"]
) -> Array:
    """The sum of the rates of the stages with the coefficients of a row."""
    used = np.flatnonzero(row)
    return _sum([row[i] for i in used], [rates[i] for i in used])


class _Sums(NamedTuple):
    """Weighted sums over the stages, one for each iteration of a loop.

    XLA's CPU runtime executes up to 8 operations of a loop one after the other. If a
    loop has more, each takes several times longer. Therefore as much as possible is
    computed in the branch of a group, the index of the row too.

    Attributes:
        tables: Tables of coefficients with a row for each sum. The sums by several
            tables are computed together.
        groups: Of the rows. In lanes, where sums take a large part of the time of a
            step, a sum has the terms of its group. Elsewhere it has a term for each
            stage, zeros included.
        row: The row for an iteration of the loop.
        in_lanes: Whether there are many lanes.
    """

    tables: tuple[np.ndarray, ...]
    groups: Groups
    row: Callable[[Array], Array]
    in_lanes: bool

    def then(
        self,
        function: Callable[..., Any],
        iteration: Array,
        terms: tuple[Array, ...],
        *arguments: Array,
    ) -> Any:
        """`function(*totals, *arguments)` of the sums for an iteration of the loop.

        Args:
            function: Of the sum by each table, and of the arguments.
            iteration: The number of the iteration.
            terms: What the rows of each table sum.
            arguments: Of the function.
        """
        if not self.in_lanes:
            pairs = self._weights_and_terms(iteration, terms)
            totals = (jnp.sum(a[:, None] * x, axis=0) for a, x in pairs)
            return function(*totals, *arguments)

        def branch_of(columns: tuple[tuple[int, ...], ...]) -> Callable[..., Any]:
            def branch(
                iteration: Array, terms: tuple[Array, ...], *arguments: Array
            ) -> Any:
                totals = self._totals(iteration, terms, columns)
                return function(*totals, *arguments)

            return branch

        # The group of a row is the number of later groups that begin at or before it.
        group = jnp.zeros((), jnp.int32)
        for first, _ in self.groups[1:]:
            group = group + (self.row(iteration) >= first).astype(group.dtype)
        branches = [branch_of(columns) for _, columns in self.groups]
        return jax.lax.switch(group, branches, iteration, terms, *arguments)

    def _weights_and_terms(
        self, iteration: Array, terms: tuple[Array, ...]
    ) -> list[tuple[Array, Array]]:
        """Coefficients of a row and the terms that they weight, for each table."""
        row = self.row(iteration)
        return [
            # `equal_steps` evaluates one stage less than a table has columns.
            (_row(table[:, : len(x)], row, x.dtype), x)
            for table, x in zip(self.tables, terms, strict=True)
        ]

    def _totals(
        self,
        iteration: Array,
        terms: tuple[Array, ...],
        columns: tuple[tuple[int, ...], ...],
    ) -> list[Array]:
        """The sums by each table, over the columns that its group uses."""
        pairs = self._weights_and_terms(iteration, terms)
        return [
            _sum([a[i] for i in used], [x[i] for i in used])
            for (a, x), used in zip(pairs, columns, strict=True)
        ]


def _sum(weights: Sequence[AnyArray], rates: list[Array]) -> Array:
    """A sum written out term by term, which XLA fuses with the code around it."""
    terms = [jnp.asarray(a, k.dtype) * k for a, k in zip(weights, rates, strict=True)]
    return sum(terms[1:], terms[0])


def _row(table: np.ndarray, row: Array, dtype: np.dtype) -> Array:
    """A row of a table of constants."""
    return jax.lax.dynamic_index_in_dim(
        jnp.asarray(table, dtype), row, keepdims=False, allow_negative_indices=False
    )


def put(table: Array, entry: Array, row: Array) -> Array:
    """The table with an entry in a row, whose index is not negative."""
    # Indices from the end would cost a kernel.
    return jax.lax.dynamic_update_index_in_dim(
        table, entry, row, 0, allow_negative_indices=False
    )


def apart(function: Callable[..., Any], true: Array, *arguments: Any) -> Any:
    """The result of a function, computed in a branch of its own within a loop.

    XLA's CPU runtime executes the operations of a loop one after the other, at 25 ns
    each, if all of their arrays are small (512 bytes) or if there are few operations.
    Otherwise each takes several times longer. The rule is applied to a branch and to
    the loop around it separately.

    Args:
        function: Of the arguments.
        true: A traced boolean that is always True, so that XLA cannot remove the
            branch. Must not be batched.
        arguments: Of the function.
    """
    shapes = jax.eval_shape(function, *arguments)

    def never(*arguments: Any) -> Any:
        inputs = jtu.tree_leaves(arguments)

        def anything(shape: jax.ShapeDtypeStruct) -> Array:
            # An input of the right shape costs no kernel; a new array does.
            alike = (
                x for x in inputs if x.shape == shape.shape and x.dtype == shape.dtype
            )
            return next(alike, jnp.zeros(shape.shape, shape.dtype))

        return jtu.tree_map(anything, shapes)

    return jax.lax.cond(true, function, never, *arguments)


def _is_short(field: Field, t: Array, y: Array) -> bool:
    """Whether a vector field is a short computation without elementary functions."""
    program = jax.make_jaxpr(field)(t, y)
    count = arithmetic_operations(program.jaxpr)
    return count is not None and count <= _SHORT


def stages(
    method: Method,
    field: Field,
    t: Float[Array, ""],
    h: Float[Array, ""],
    y: Array,
    in_lanes: bool = False,
) -> tuple[Float[Array, "stages n"], Float[Array, " n"]]:
    """The rates of all stages of a step, and the state at its end.

    Args:
        method: The method.
        field: The vector field.
        t: Start of the step.
        h: Length of the step.
        y: State at the start.
        in_lanes: Whether the step will have many lanes.
    """
    joined = in_lanes and _is_short(field, t, y)
    return _loop(method, field, (t, h, y), method.stages, in_lanes, joined)


def _loop(
    method: Method,
    field: Field,
    step: tuple[Float[Array, ""], Float[Array, ""], Array],
    count: int,
    in_lanes: bool,
    joined: bool,
) -> tuple[Float[Array, "count n"], Float[Array, " n"]]:
    """The rates of the first `count` stages, and the state at the stage after them.

    The state at the last stage is the result of the step. If `joined`, the kernel that
    computes a rate also stores it in the table. In lanes this takes less time for a
    short field. For a longer one LLVM compiles such a kernel to slow code.
    """
    t, h, y = step

    def next_row(i: Array) -> Array:
        # The last iteration repeats the last row, which gives the result of the step.
        return jnp.minimum(i + 1, method.stages - 1)

    sums = _Sums((method.rows,), method.groups, next_row, in_lanes)

    def place_of(total: Array, h: Array, y: Array) -> Array:
        return y + h * total

    def stage(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        rates, place = carry
        at = t + _row(method.times, i, y.dtype) * h
        rate = field(at, place) if joined else apart(field, i >= 0, at, place)
        rates = put(rates, rate, i)
        return rates, sums.then(place_of, i, (rates,), h, y)

    # Outside of lanes a sum includes the stages to come, with coefficients of zero.
    # Their rates must be finite.
    rates = jnp.zeros((count, *y.shape), y.dtype)
    return jax.lax.fori_loop(0, count, stage, (rates, y))


def equal_steps(
    method: Method,
    field: Field,
    t: Float[Array, ""],
    h: Float[Array, ""],
    y: Array,
    count: int | Array = 1,
) -> Float[Array, " n"]:
    """The state after a number of equal steps, without an error estimate.

    A number that is no array gives loops of known length, which JAX differentiates as
    scans.

    Args:
        method: The method.
        field: The vector field.
        t: Where the first step starts.
        h: Length of a step, negative for one back in time.
        y: The state at the start.
        count: Number of steps.

    Gradients: in every mode, of every order; forward alone where `count` is an array.
    """
    # Only the error estimate needs the rate of the last stage, at the end of a step.
    needed = method.stages - 1

    def step(i: Array, y: Array) -> Array:
        start = t + i.astype(h.dtype) * h
        return _loop(method, field, (start, h, y), needed, True, True)[1]

    if isinstance(count, int) and count == 1:
        return step(jnp.zeros((), int), y)
    return jax.lax.fori_loop(0, count, step, y)


def error_of(method: Method, rates: Float[Array, "stages n"], h: Array) -> Array:
    """The estimate of the size of the error of a step: the larger of two estimates."""
    size = jnp.abs(combine(method.rows[method.stages], rates))
    if np.any(method.second_row):
        size = jnp.maximum(size, jnp.abs(combine(method.second_row, rates)))
    return h * size


def pull_back(
    method: Method,
    field: Callable[[Parameters, Array, Array], Array],
    parameters: Parameters,
    step: tuple[Float[Array, ""], Float[Array, ""], Float[Array, " n"]],
    rates: Float[Array, "stages n"],
    change: Float[Array, " n"],
    in_lanes: bool = False,
) -> tuple[Parameters, Float[Array, " n"]]:
    """Cotangents of the parameters and of the start of a step, from that of its result.

    With the states Y_i of the stages, p_i the cotangent of Y_i, and p of the last stage
    given: u_i = h sum_j a_ji p_j, p_i = J(Y_i)^T u_i, and that of the start is the sum
    of all p_i.

    Args:
        method: The method.
        field: The vector field, of parameters, time and state.
        parameters: The parameters whose cotangents are needed.
        step: Start, length, and state at the start. A step of length 0 was not taken:
            its rates do not matter.
        rates: Of its stages.
        change: Cotangent of its result.
        in_lanes: Whether the step will have many lanes.
    """
    t, h, y = step
    last = method.stages - 1

    def row(k: Array) -> Array:
        return last - 1 - k

    sums = _Sums(method.reverse_rows, method.reverse_groups, row, in_lanes)

    def of_rate(weighted: Array, at: Array, place: Array) -> tuple[Parameters, Array]:
        _, pull = jax.vjp(lambda x, y: field(x, at, y), parameters, place)
        return pull(weighted)

    def stage(k: Array, carry: tuple[Array, Parameters]) -> tuple[Array, Parameters]:
        cotangents, total = carry
        i = row(k)
        place, weighted = sums.then(_place_and_weighted, k, (rates, cotangents), h, y)
        of_stage = (weighted, t + _row(method.times, i, y.dtype) * h, place)
        # The reverse of a field is never short (see `_loop`).
        of_parameters, of_place = apart(of_rate, k >= 0, *of_stage)
        cotangents = put(cotangents, of_place, i)
        return cotangents, jtu.tree_map(jnp.add, total, of_parameters)

    cotangents = jnp.zeros_like(rates).at[last].set(change)
    zeros = jtu.tree_map(jnp.zeros_like, parameters)
    cotangents, total = jax.lax.fori_loop(0, last, stage, (cotangents, zeros))
    return total, jnp.sum(cotangents, axis=0)


def _place_and_weighted(
    total: Array, total_back: Array, h: Array, y: Array
) -> tuple[Array, Array]:
    """The state at a stage, and the cotangent of the rate there."""
    # The rates of a rejected step may be infinite, and zero times infinity is NaN.
    return y + jnp.where(h != 0, h * total, 0.0), h * total_back
