"""Bisection that asks for the place of a change of sign, whatever the unit of the function."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array


class _Interval(NamedTuple):
    lower: Array
    upper: Array
    falls: Array


class PlaceOfRoot(optx.AbstractRootFinder):
    """Bisection that ends by the length of the interval alone, and that raises nothing.

    `optimistix.Bisection` also bounds the function's value, in units that only its user knows, and
    raises where the ends have one sign, which under vmap are also lanes that look for no root.
    """

    rtol: Any
    atol: Any
    norm: Any = optx.max_norm

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> _Interval:
        """The interval, and whether the function falls in it."""
        del y, f_struct, aux_struct, tags
        lower, upper = jnp.asarray(options["lower"]), jnp.asarray(options["upper"])
        return _Interval(lower, upper, fn(lower, args)[0] > fn(upper, args)[0])

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: _Interval, tags: Any
    ) -> tuple[Array, _Interval, Any]:
        """Half of the interval."""
        del y, options, tags
        middle = state.lower + 0.5 * (state.upper - state.lower)
        value, aux = fn(middle, args)
        below = state.falls ^ (value < 0)
        lower = jnp.where(below, middle, state.lower)
        upper = jnp.where(below, state.upper, middle)
        return lower + 0.5 * (upper - lower), _Interval(lower, upper, state.falls), aux

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: _Interval, tags: Any
    ) -> tuple[Array, optx.RESULTS]:
        """Whether the interval is short enough."""
        del fn, args, options, tags
        scale = self.atol + self.rtol * jnp.abs(y)
        return jnp.abs(state.upper - state.lower) <= scale, optx.RESULTS.successful

    def postprocess(
        self,
        fn: Any,
        y: Any,
        aux: Any,
        args: Any,
        options: Any,
        state: _Interval,
        tags: Any,
        result: Any,
    ) -> tuple[Any, Any, dict[str, Any]]:
        """Nothing more."""
        del fn, args, options, state, tags, result
        return y, aux, {}
