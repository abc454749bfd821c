"""What all solids share: the way from a mass and lengths to mass properties."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from jrigid._checks import all_positive, shaped, where_defined
from jrigid.mass import MassProperties


def solid(
    mean_squares: Callable[..., Any],
    mass: ArrayLike,
    *,
    shape: tuple[int, ...] = (),
    fits: Callable[..., Any] = lambda *_: True,
    **lengths: Any,
) -> MassProperties:
    """The body about its centre; NaN where its mass or a length is not positive and finite.

    Args:
        mean_squares: The means of x^2, y^2 and z^2 over the body, of the lengths.
        mass: Mass.
        shape: That of each of the lengths.
        fits: Whether lengths that are positive go together.
        **lengths: By the names that they have as arguments.
    """
    shapes = {name: (length, *shape) for name, length in lengths.items()}
    mass, *sizes = shaped(mass=(mass,), **shapes)

    def body(mass: Array, *sizes: Array) -> MassProperties:
        x, y, z = mean_squares(*sizes)
        moments = mass * jnp.stack([y + z, x + z, x + y])
        return MassProperties.unchecked(mass, jnp.zeros(3, mass.dtype), moments)

    return where_defined(all_positive((mass, sizes)) & fits(*sizes), body, mass, *sizes)
