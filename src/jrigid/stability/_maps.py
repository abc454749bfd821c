"""Maps of stability over any parameters, in blocks, and the boundaries between their regions."""

import math
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    array_of_shape,
    float_arrays,
    shaped,
    whole_number,
)
from jrigid._types import Scalar, ScalarLike

_Code = type(RESULTS.successful)  # an item of any enumeration
# Part of the larger end value that a function may have left at a root; at a pole it has more.
_ROOT = 1e-3


class StabilityMap(NamedTuple):
    """Values of a function on a grid.

    Attributes:
        values: As the function returned them, with the axes of the grid in front; numpy arrays.
        valid: Where all numbers are finite and no code is `undefined`: a mask of the shape of the
            grid.
        axes: Names and points of the axes, in their order.
    """

    values: Any
    valid: np.ndarray
    axes: dict[str, np.ndarray]

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(self.axes)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Of a map over two axes, for matplotlib's `imshow(values.T, origin="lower", extent=...)`.

        Raises:
            ValueError: The map is over more or fewer axes.
        """
        if len(self.axes) != 2:
            raise ValueError(f"Property `extent` is for two axes, but there are {len(self.axes)}.")
        ends: list[float] = []
        for x in self.axes.values():
            half = 0.5 * (x[-1] - x[0]) / max(x.size - 1, 1)
            ends += [float(x[0] - half), float(x[-1] + half)]
        return ends[0], ends[1], ends[2], ends[3]


def stability_map(
    function: Callable[..., Any],
    axes: Mapping[str, ArrayLike],
    *,
    block_size: int = 2**16,
    progress: bool = False,
) -> StabilityMap:
    """Evaluate a function of some parameters on the grid they span.

    The grid is cut into blocks of one size, which are evaluated one after the other by one compiled
    and vmapped call, so that memory is that of a block and of the result. The call is kept for the
    next map of the same function with blocks of the same size.

    Args:
        function: A pure function (as for `jax.jit`: what it closes over must not change) of one
            number for each axis, given by name, for a single point: a growth rate, an indicator of
            chaos, a region, a tree of several. With `throw=False` inside where it takes it, so
            that points that fail are NaN.
        axes: Name and points of each axis, two or more as a rule; the last one runs fastest.
        block_size: Points of a block. Large for what is cheap; for long integrations some hundreds,
            since a block takes as long as its slowest lane.
        progress: Print how many points are done, every few seconds.

    Returns:
        Values on the grid, and where they are valid.

    Raises:
        ValueError: An axis that is not one array of numbers, or a function that returns integers or
            booleans only, which cannot say that they are undefined: return floats, NaN where they
            are.

    Gradients: none; differentiate the function, or a `boundary`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> def square(second, third):
    ...     return jr.stability.growth_rate_squared(jnp.stack([1.0, second, third]), 2, 1.0)
    >>> ratios = jnp.linspace(0.5, 2.0, 4)
    >>> grid = jr.stability.stability_map(square, {"second": ratios, "third": ratios})
    >>> print(grid.values.shape, grid.labels, (grid.values > 0).sum())
    (4, 4) ('second', 'third') 1
    """
    points = {name: np.asarray(x) for name, x in axes.items()}
    for name, x in points.items():
        if x.ndim != 1 or x.size == 0 or x.dtype.kind not in "iuf":
            raise ValueError(
                f"Argument `axes` must hold arrays of numbers of shape (n,), but {name!r} has "
                f"shape {x.shape} and type {x.dtype}."
            )
    if not points:
        raise ValueError("Argument `axes` must name at least one axis, but it is empty.")
    shape = tuple(x.size for x in points.values())
    total = math.prod(shape)
    size = min(whole_number("block_size", block_size), total)
    # One dtype, that of all axes taken together.
    arrays = float_arrays(*points.values())
    whole: Any = None
    printed = time.monotonic()
    for start in range(0, total, size):
        first = jnp.array(np.unravel_index(start, shape), jnp.int32)
        block = _block(function, tuple(points), size, arrays, first)
        if whole is None:
            whole = jtu.tree_map(lambda x: np.empty((total, *x.shape[1:]), x.dtype), block)
        stop = min(start + size, total)
        for leaf, part in zip(jtu.tree_leaves(whole), jtu.tree_leaves(block), strict=True):
            leaf[start:stop] = np.asarray(part)[: stop - start]
        if progress and time.monotonic() - printed > 5:
            printed = time.monotonic()
            print(f"{stop} of {total} points", flush=True)
    values, valid = jtu.tree_map(lambda x: x.reshape(*shape, *x.shape[1:]), whole)
    return StabilityMap(values, valid, dict(zip(points, map(np.asarray, arrays), strict=True)))


def _defined(values: Any) -> Bool[Array, ""]:
    """Whether all numbers are finite and no code is `undefined`."""
    leaves = jtu.tree_leaves(values, is_leaf=lambda x: isinstance(x, _Code))
    codes = [x for x in leaves if isinstance(x, _Code)]
    if not codes and not any(eqx.is_inexact_array(x) for x in leaves):
        raise ValueError(
            "Argument `function` must return floats, NaN where it is undefined, or codes, but it "
            "returns nothing that could say so."
        )
    defined = all_finite(leaves)
    for code in codes:
        undefined = getattr(code._enumeration, "undefined", None)
        defined = defined if undefined is None else defined & (code != undefined)
    return defined


@eqx.filter_jit
def _block(
    function: Callable, names: tuple[str, ...], size: int, axes: tuple[Array, ...], first: Array
) -> tuple[Any, Array]:
    """One block of the grid: values at `size` points that follow a first one; if defined."""
    # Digits of the index in the grid's own bases: no number beyond 32 bits is needed.
    carry = jnp.arange(size, dtype=jnp.int32)
    point = {}
    for name, x, digit in zip(names[::-1], axes[::-1], first[::-1], strict=True):
        index = carry + digit
        carry = index // x.size
        point[name] = x[index % x.size]

    def evaluate(point: dict[str, Array]) -> tuple[Any, Array]:
        values = jtu.tree_map(jnp.asarray, function(**point))
        return values, _defined(values)

    return jax.vmap(evaluate)(point)


def place_of_root(
    rising: Callable[[Array, Any], Array], args: Any, tolerance: float, dtype: Any
) -> Scalar:
    """Place between 0 and 1 at which `rising(x, args)` goes from negative to positive.

    So many halvings as the place asks for, and no look at the size of the values. A function that
    is known to rise (`flip=False`) needs no check of its ends, which would raise in a lane of vmap
    that looks for no root.

    Gradients: by the implicit function theorem in `args`.
    """
    bisection = optx.Bisection(rtol=0.0, atol=tolerance, flip=False)
    zero = jnp.zeros((), dtype)
    return optx.root_find(
        rising, bisection, zero + 0.5, args, options={"lower": zero, "upper": zero + 1},
        max_steps=1 - math.floor(math.log2(tolerance)), throw=False,
    ).value  # fmt: skip


def boundary(
    function: Callable[..., Any],
    lower: ScalarLike,
    upper: ScalarLike,
    *args: Any,
    rtol: float | None = None,
    throw: bool = True,
) -> Scalar:
    """Where a function of one parameter changes its sign: the edge of a region of stability.

    Args:
        function: `function(parameter, *args)`, a number that is positive on one side and negative
            on the other, smooth between: a `growth_rate_squared`, one of the margins.
        lower: An end of the interval to look in, where the function has one sign.
        upper: The other end, where it has the other.
        *args: Passed to the function: what the boundary depends on.
        rtol: Accuracy, as a part of the interval; by default 64 eps.
        throw: False: NaN where there is no change of sign.

    Returns:
        The parameter at the boundary.

    Raises:
        RuntimeError: The function has the same sign at both ends, is not finite there, or jumps
            where its sign changes, as at a pole.

    Gradients: by the implicit function theorem in `args`, not in what the function closes over.
    Infinite where the slope of the function is 0.
    Source: bisection (`optimistix.Bisection`).

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> def upright(omega3, mgl):
    ...     top = jr.SymmetricTop(1.0, 0.5, mgl)
    ...     return jr.stability.top_stability(top, omega3).growth_rate_squared
    >>> print(jr.stability.boundary(upright, 1.0, 9.0, 1.0).round(9))
    4.0
    >>> print(jax.grad(lambda mgl: jr.stability.boundary(upright, 1.0, 9.0, mgl))(1.0).round(9))
    2.0
    """
    lower, upper = shaped(lower=(lower,), upper=(upper,))
    fixed = jtu.tree_map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, args)
    ends = jax.lax.stop_gradient(jnp.stack([lower, upper]))
    values = [array_of_shape("function", function(x, *fixed)) for x in ends]
    known = jax.lax.stop_gradient(jnp.stack(values).astype(lower.dtype))
    ok = all_finite(known) & (jnp.sign(known[0]) * jnp.sign(known[1]) <= 0)
    falls = known[0] > known[1]

    def rising(x: Array, args: tuple) -> Array:
        value = jnp.asarray(function(lower + (upper - lower) * x, *args), lower.dtype)
        return jnp.where(ok, jnp.where(falls, -value, value), x - 0.5)

    tolerance = 64 * float(jnp.finfo(lower.dtype).eps) if rtol is None else rtol
    place = place_of_root(rising, args, tolerance, lower.dtype)
    # At a pole, or a jump, or where it is NaN between the ends, there is no root.
    left = jnp.abs(jax.lax.stop_gradient(rising(jax.lax.stop_gradient(place), fixed)))
    findings = Findings()
    message = (
        "Arguments `lower` and `upper` must be on either side of a change of sign of the function, "
        "which must be continuous there, but they are not."
    )
    findings.require(ok & (left <= _ROOT * jnp.max(jnp.abs(known))), None, message, ends)
    return findings.guard(lower + (upper - lower) * place, throw)
