"""Maps of stability over parameters, and the boundaries between their regions."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import Array, ArrayLike

from jrigid._checks import Findings, all_finite, array_of_shape, demand, shaped
from jrigid._core.compile import floats_as_arrays
from jrigid._types import Scalar, ScalarLike
from jrigid.sweep import SweepResult, sweep

# Part of the larger end value that a function may have left at a root; at a pole it has
# more.
_ROOT = 1e-3


def stability_map(
    function: Callable[..., Any],
    axes: Mapping[str, ArrayLike],
    *,
    block_size: int | None = None,
    progress: bool = False,
) -> SweepResult:
    """Evaluate a function of some parameters on the grid they span.

    This is `jrigid.sweep` in memory and on this machine, which also keeps what it has
    done, or sends it elsewhere. The compiled call is kept for the next map of the same
    function with blocks of the same shape.

    Args:
        function: A pure function (as for `jax.jit`: what it closes over must not
            change) of one number for each axis, given by name, for a single point: a
            growth rate, an indicator of chaos, a region, a tree of several. With
            `throw=False` inside where it takes it, so that points that fail are NaN.
        axes: Name and points of each axis, two or more as a rule; the last one runs
            fastest.
        block_size: Points of a block, 65,536 at most by default.
        progress: Show how many points are done.

    Returns:
        Values on the grid, and where they are valid.

    Raises:
        ValueError: An axis that is not one array of numbers, or a function that returns
            integers or booleans only, which cannot say that they are undefined: return
            floats, NaN where they are.

    Gradients: none; differentiate the function, or a `boundary`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> def square(second, third):
    ...     moments = jnp.stack([1.0, second, third])
    ...     return jr.stability.growth_rate_squared(moments, 2, 1.0)
    >>> ratios = jnp.linspace(0.5, 2.0, 4)
    >>> grid = jr.stability.stability_map(square, {"second": ratios, "third": ratios})
    >>> print(grid.values.shape, grid.labels, (grid.values > 0).sum())
    (4, 4) ('second', 'third') 1
    """
    return sweep(function, axes, block_size=block_size, progress=progress)


def place_of_root(
    rising: Callable[[Array, Any], Array], args: Any, tolerance: float, dtype: Any
) -> Scalar:
    """Place between 0 and 1 at which `rising(x, args)` goes from negative to positive.

    The number of bisections follows from the tolerance of the place alone. A function
    that is known to rise (`flip=False`) needs no check of its ends, which would raise
    an error in a lane of vmap that has no root.

    Gradients: by the implicit function theorem in `args`.
    """
    bisection = optx.Bisection(rtol=0.0, atol=tolerance, flip=False)
    zero = jnp.zeros((), dtype)
    return optx.root_find(
        rising,
        bisection,
        zero + 0.5,
        args,
        options={"lower": zero, "upper": zero + 1},
        # Each step halves an interval of length 1.
        max_steps=1 - math.floor(math.log2(tolerance)),
        throw=False,
    ).value


def boundary(
    function: Callable[..., Any],
    lower: ScalarLike,
    upper: ScalarLike,
    *args: Any,
    rtol: float | None = None,
    throw: bool = True,
) -> Scalar:
    """Parameter at which a function changes its sign: the edge of a stable region.

    Args:
        function: `function(parameter, *args)`, positive on one side, negative on the
            other and smooth between, such as a `growth_rate_squared` or a margin.
        lower: One end of the interval.
        upper: The other end, where the function has the other sign.
        *args: Passed to the function: parameters that the boundary depends on.
        rtol: Accuracy, as a fraction of the interval; by default 64 eps.
        throw: With False, NaN where there is no change of sign.

    Returns:
        The parameter at the boundary.

    Raises:
        ValueError: rtol is not between 0 and 1.
        RuntimeError: The function has the same sign at both ends, is not finite there,
            or jumps where its sign changes, as at a pole.

    Gradients: by the implicit function theorem in `args`, not in what the function
    closes over. Infinite where the slope of the function is 0.
    Source: bisection (`optimistix.Bisection`).

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> def upright(omega3, mgl):
    ...     top = jr.SymmetricTop(1.0, 0.5, mgl)
    ...     return jr.stability.top_stability(top, omega3).growth_rate_squared
    >>> print(jr.stability.boundary(upright, 1.0, 9.0, 1.0).round(9))
    4.0
    >>> threshold = lambda mgl: jr.stability.boundary(upright, 1.0, 9.0, mgl)
    >>> print(jax.grad(threshold)(1.0).round(9))
    2.0
    """
    lower, upper = shaped(lower=(lower,), upper=(upper,))
    args = floats_as_arrays(args, lower.dtype)
    fixed = jtu.tree_map(
        lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, args
    )
    ends = jax.lax.stop_gradient(jnp.stack([lower, upper]))
    known = jax.lax.stop_gradient(_values(function, ends, fixed))
    # A zero at an end of the interval is a boundary, too.
    ok = all_finite(known) & (jnp.sign(known[0]) * jnp.sign(known[1]) <= 0)
    falls = known[0] > known[1]

    # No closure, which would be compiled anew, and kept in memory, at each call.
    rising = eqx.Partial(_rising, function)
    interval = lower, upper, ok, falls
    tolerance = 64 * float(jnp.finfo(lower.dtype).eps) if rtol is None else rtol
    demand(
        0 < tolerance < 1,
        f"Argument `rtol` must be between 0 and 1, but it is {rtol}.",
    )
    place = place_of_root(rising, (interval, args), tolerance, lower.dtype)
    # At a pole, or a jump, or where it is NaN between the ends, there is no root.
    at_root = rising(jax.lax.stop_gradient(place), (interval, fixed))
    left = jnp.abs(jax.lax.stop_gradient(at_root))
    findings = Findings()
    message = (
        "Arguments `lower` and `upper` must be on either side of a change of sign of "
        "the function, which must be continuous there, but they are not."
    )
    findings.require(
        ok & (left <= _ROOT * jnp.max(jnp.abs(known))), None, message, ends
    )
    return findings.guard(lower + (upper - lower) * place, throw)


@eqx.filter_jit
def _values(function: Callable[..., Any], points: Array, args: Any) -> Array:
    """The function at several points; a loop compiles it once, not once for each."""

    def value(point: Array) -> Array:
        return jnp.asarray(
            array_of_shape("function", function(point, *args)), points.dtype
        )

    return jax.lax.map(value, points)


def _rising(
    function: Callable[..., Any], x: Array, arguments: tuple[Any, Any]
) -> Array:
    """The function at a place in the interval, its sign such that it rises.

    Where the interval holds no change of sign it is some function that has a root.
    """
    (lower, upper, ok, falls), args = arguments
    value = jnp.asarray(function(lower + (upper - lower) * x, *args), lower.dtype)
    return jnp.where(ok, jnp.where(falls, -value, value), x - 0.5)
