"""Where a function of one number changes its sign, whatever the unit of its values."""

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array

from jrigid._types import Scalar


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
