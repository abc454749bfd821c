"""Bisection that asks for the place of a change of sign, whatever the unit of the function."""

from typing import Any

import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array


class PlaceOfRoot(optx.Bisection):
    """`optimistix.Bisection` that ends by the length of the interval alone.

    Its own bound on the function's value is in units that only the user of the function knows.
    """

    rtol: Any
    atol: Any

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any
    ) -> tuple[Array, optx.RESULTS]:
        """Whether the interval is short enough."""
        del fn, args, options, tags
        scale = self.atol + self.rtol * jnp.abs(y)
        return jnp.abs(state.lower - state.upper) <= scale, optx.RESULTS.successful
