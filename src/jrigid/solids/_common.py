"""What all solids share: the way from a mass and lengths to mass properties."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

from jrigid._checks import all_positive, check_shape, float_arrays, where_defined
from jrigid.mass import MassProperties


def solid(
    moments: Callable[..., tuple[Array, Array, Array]],
    mass: ArrayLike,
    *,
    shape: tuple[int, ...] = (),
    fits: Callable[..., Bool[Array, ""]] | None = None,
    **lengths: Any,
) -> MassProperties:
    """The body about its centre; NaN where its mass or a length is not positive and finite.

    Args:
        moments: The moments for a mass of 1, of the lengths.
        mass: Mass.
        shape: That of each of the lengths.
        fits: Whether lengths that are positive go together.
        **lengths: By the names that they have as arguments.
    """
    mass, *sizes = float_arrays(mass, *lengths.values())
    check_shape("mass", mass, ())
    for name, size in zip(lengths, sizes, strict=True):
        check_shape(name, size, shape)
    ok = all_positive((mass, sizes))
    if fits is not None:
        ok = ok & fits(*sizes)

    def body(mass: Array, *sizes: Array) -> MassProperties:
        return MassProperties.unchecked(
            mass, jnp.zeros(3, mass.dtype), mass * jnp.stack(moments(*sizes))
        )

    return where_defined(ok, body, mass, *sizes)
