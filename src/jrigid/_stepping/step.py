"""A step of an explicit Runge-Kutta method as a loop over its stages, and its reverse.

The vector field stands once in the loop, so the compiled program does not grow with the
number of stages. The reverse of a step is another Runge-Kutta step (E. Hairer, C.
Lubich, G. Wanner, Geometric Numerical Integration, 2nd ed., section VI.3): it is
written out here, as a loop too.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from jrigid._core.third_party import arithmetic_operations
from jrigid._stepping.method import Groups, Method

# A computation of so many operations is short. The field of a heavy top has 179, that
# of a heavy top with a tangent beside it 474.
_SHORT = 250

Field = Callable[[Float[Array, ""], Float[Array, " n"]], Float[Array, " n"]]


def combine(method: Method, rates: Float[Array, "stages n"], row: int) -> Array:
    """The sum of the rates of the stages with the coefficients of a row."""
    used = np.flatnonzero(method.rows[row])
    return _sum([method.rows[row, i] for i in used], [rates[i] for i in used])


class _Sums(NamedTuple):
    """Sums over the stages, of which a loop computes one after another.

    XLA's CPU runtime executes up to 8 operations of a loop one after the other; where
    there are more, each costs several times as much. So what can be computed in the
    branch of a group is computed there, the number of the row too.

    Attributes:
        tables: A row of coefficients for each sum. Those of several tables are computed
            together.
        groups: Of the rows. In lanes, where sums take a large part of the time of a
            step, a sum has the terms of its group. Elsewhere it has all of its zeros.
        row: The row for a trip of the loop.
        in_lanes: Whether there are many lanes.
    """

    tables: tuple[np.ndarray, ...]
    groups: Groups
    row: Callable[[Array], Array]
    in_lanes: bool

    def then(
        self,
        function: Callable[..., Any],
        trip: Array,
        terms: tuple[Array, ...],
        *arguments: Array,
    ) -> Any:
        """`function(*totals, *arguments)` of the sums for a trip of the loop.

        Args:
            function: Of the sum by each table, and of the arguments.
            trip: The number of the trip.
            terms: What the rows of each table sum.
            arguments: Of the function.
        """

        def weighted(
            trip: Array, terms: tuple[Array, ...]
        ) -> list[tuple[Array, Array]]:
            number = self.row(trip)
            return [
                (_row(table[:, : len(x)], number, x.dtype), x)
                for table, x in zip(self.tables, terms, strict=True)
            ]

        if not self.in_lanes:
            pairs = weighted(trip, terms)
            return function(
                *(jnp.sum(a[:, None] * x, axis=0) for a, x in pairs), *arguments
            )

        def of_group(columns: tuple[tuple[int, ...], ...]) -> Callable[..., Any]:
            def result(trip: Array, terms: tuple[Array, ...], *arguments: Array) -> Any:
                pairs = zip(weighted(trip, terms), columns, strict=True)
                totals = [
                    _sum([a[i] for i in used], [x[i] for i in used])
                    for (a, x), used in pairs
                ]
                return function(*totals, *arguments)

            return result

        group = jnp.zeros((), jnp.int32)
        for first, _ in self.groups[1:]:
            group = group + (self.row(trip) >= first).astype(group.dtype)
        branches = [of_group(columns) for _, columns in self.groups]
        return jax.lax.switch(group, branches, trip, terms, *arguments)


def _sum(weights: list, rates: list[Array]) -> Array:
    """A sum written out, which is compiled together with what is around it."""
    terms = [jnp.asarray(a, k.dtype) * k for a, k in zip(weights, rates, strict=True)]
    return sum(terms[1:], terms[0])


def _row(table: np.ndarray, row: Array, dtype: Any) -> Array:
    """A row of a table of constants."""
    return jax.lax.dynamic_index_in_dim(jnp.asarray(table, dtype), row, keepdims=False)


def apart(function: Callable[..., Any], true: Array, *arguments: Any) -> Any:
    """A function's result, computed as a program of its own within a loop.

    XLA's CPU runtime executes the operations of a loop one after the other, at 25 ns
    each, only where all of their arrays are small (512 bytes) or there are few; others
    cost several times more. Operations in a branch are judged apart from the loop
    around it.

    Args:
        function: Of the arguments.
        true: A condition that holds, though the compiler cannot know it.
        arguments: Of the function.
    """
    shapes = jax.eval_shape(function, *arguments)

    def never(*arguments: Any) -> Any:
        given = jtu.tree_leaves(arguments)

        def anything(shape: Any) -> Array:
            # An array that is there already costs no kernel, as a new one would.
            alike = (
                x for x in given if x.shape == shape.shape and x.dtype == shape.dtype
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
    """The rates of all stages of a step, and its result.

    Args:
        method: The method.
        field: The vector field.
        t: Where the step starts.
        h: Its length.
        y: The state there.
        in_lanes: Whether it will have many lanes.
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
    """The rates of the first `count` stages, and the place of the stage after them.

    The place of the last stage is the result of the step. If `joined`, the kernel that
    computes a rate also puts it into the table: this takes less time in lanes, unless
    the field is not short. Of such a kernel LLVM makes slow code.
    """
    t, h, y = step

    def following(i: Array) -> Array:
        return jnp.minimum(i + 1, method.stages - 1)

    sums = _Sums((method.rows,), method.groups, following, in_lanes)

    def place_of(total: Array, h: Array, y: Array) -> Array:
        return y + h * total

    def stage(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        rates, place = carry
        at = t + _row(method.times, i, y.dtype) * h
        rate = field(at, place) if joined else apart(field, i >= 0, at, place)
        rates = jax.lax.dynamic_update_index_in_dim(rates, rate, i, 0)
        return rates, sums.then(place_of, i, (rates,), h, y)

    rates = jnp.zeros((count, *y.shape), y.dtype)
    return jax.lax.fori_loop(0, count, stage, (rates, y))


def equal_steps(
    method: Method,
    field: Field,
    t: Float[Array, ""],
    h: Float[Array, ""],
    y: Array,
    count: int = 1,
) -> Float[Array, " n"]:
    """The state after a fixed number of equal steps, without an error estimate.

    All loops have a known length, so JAX differentiates them as scans.

    Args:
        method: The method.
        field: The vector field.
        t: Where the first step starts.
        h: Length of a step, negative for one back in time.
        y: The state at the start.
        count: Number of steps.

    Gradients: in every mode, of every order.
    """
    # The rate of the last stage, at the end of a step, serves the error estimate alone.
    needed = method.stages - 1

    def step(i: Array, y: Array) -> Array:
        start = t + i.astype(h.dtype) * h
        return _loop(method, field, (start, h, y), needed, True, True)[1]

    if count == 1:
        return step(jnp.zeros((), int), y)
    return jax.lax.fori_loop(0, count, step, y)


def error_of(method: Method, rates: Float[Array, "stages n"], h: Array) -> Array:
    """The estimate of the error of a step."""
    return h * combine(method, rates, method.stages)


def pull_back(
    method: Method,
    field: Callable[[Any, Array, Array], Array],
    parameters: Any,
    step: tuple[Float[Array, ""], Float[Array, ""], Float[Array, " n"]],
    rates: Float[Array, "stages n"],
    change: Float[Array, " n"],
    in_lanes: bool = False,
) -> tuple[Any, Float[Array, " n"]]:
    """Cotangents of the parameters and of the start of a step, from that of its result.

    With the places Y_i of the stages, p_i the cotangent of Y_i, and p of the last place
    given: u_i = h sum_j a_ji p_j, p_i = J(Y_i)^T u_i, and that of the start is the sum
    of all p_i.

    Args:
        method: The method.
        field: The vector field, of parameters, time and state.
        parameters: Those whose cotangents are asked for.
        step: Where it starts, its length, the state at its start. A step of length 0
            was not taken: its rates do not matter.
        rates: Of its stages.
        change: Cotangent of its result.
        in_lanes: Whether it will have many lanes.
    """
    t, h, y = step
    last = method.stages - 1

    def number(k: Array) -> Array:
        return last - 1 - k

    sums = _Sums(method.reverse_rows, method.reverse_groups, number, in_lanes)

    def place_and_weighted(
        total: Array, total_back: Array, h: Array, y: Array
    ) -> tuple[Array, Array]:
        return y + jnp.where(h != 0, h * total, 0.0), h * total_back

    def of_rate(weighted: Array, at: Array, place: Array) -> tuple[Any, Array]:
        _, pull = jax.vjp(lambda x, y: field(x, at, y), parameters, place)
        return pull(weighted)

    def stage(k: Array, carry: tuple[Array, Any]) -> tuple[Array, Any]:
        places, total = carry
        i = number(k)
        place, weighted = sums.then(place_and_weighted, k, (rates, places), h, y)
        of_stage = weighted, t + _row(method.times, i, y.dtype) * h, place
        # The reverse of a field is never short (see `_loop`).
        of_parameters, of_place = apart(of_rate, k >= 0, *of_stage)
        places = jax.lax.dynamic_update_index_in_dim(places, of_place, i, 0)
        return places, jtu.tree_map(jnp.add, total, of_parameters)

    places = jnp.zeros_like(rates).at[last].set(change)
    zeros = jtu.tree_map(jnp.zeros_like, parameters)
    places, total = jax.lax.fori_loop(0, last, stage, (places, zeros))
    return total, jnp.sum(places, axis=0)
