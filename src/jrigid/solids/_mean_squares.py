"""Mass properties of a solid from the mean squares of its coordinates."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

from jrigid._checks import all_positive, shaped, where_defined
from jrigid._types import ScalarLike, Vector
from jrigid.mass import MassProperties

#: The means of x^2, y^2 and z^2 over a body.
MeanSquares = Sequence[ScalarLike] | Vector


def _always(*_: Array) -> Bool[Array, ""]:
    return jnp.asarray(True)


def solid(
    mean_squares: Callable[..., MeanSquares],
    mass: ScalarLike,
    *,
    shape: tuple[int, ...] = (),
    fits: Callable[..., Bool[Array, ""]] = _always,
    **lengths: ArrayLike,
) -> MassProperties:
    """Make the body about its centre.

    The body is NaN where its mass or a length is not positive and finite.

    Args:
        mean_squares: Function of the lengths, in the order of `lengths`.
        mass: Mass.
        shape: That of each of the lengths.
        fits: Function of the lengths: whether lengths that are positive fit together.
        **lengths: By the names that they have as arguments, for errors.
    """
    shapes = {name: (length, *shape) for name, length in lengths.items()}
    mass, *sizes = shaped(mass=(mass,), **shapes)

    def body(mass: Array, *sizes: Array) -> MassProperties:
        x, y, z = mean_squares(*sizes)
        # About the centre, in principal axes: I1 is the mass times the mean of y^2 +
        # z^2.
        moments = mass * jnp.stack([y + z, x + z, x + y])
        return MassProperties.unchecked(mass, jnp.zeros(3, mass.dtype), moments)

    ok = all_positive((mass, sizes)) & fits(*sizes)
    return where_defined(ok, body, mass, *sizes)
