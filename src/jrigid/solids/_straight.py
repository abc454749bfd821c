"""Solids with plane faces, and the rod."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jrigid._checks import all_finite, all_positive, shaped, where_defined
from jrigid._core.compile import one_program
from jrigid._types import Real, ScalarLike, VectorLike
from jrigid.mass import MassProperties, inertia_tensor
from jrigid.solids._mean_squares import MeanSquares, solid


@one_program
def box(mass: ScalarLike, lengths: VectorLike) -> MassProperties:
    """Homogeneous rectangular box, edges along x, y, z.

    Args:
        mass: Mass [kg].
        lengths: Full edge lengths along x, y, z [m].

    Returns:
        The body, centre at the origin.

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.box(12.0, jnp.array([1.0, 2.0, 3.0])).inertia))
    [13. 10.  5.]
    """
    return solid(lambda edges: edges * edges / 12, mass, shape=(3,), lengths=lengths)


@one_program
def rod(mass: ScalarLike, length: ScalarLike) -> MassProperties:
    """Infinitely thin homogeneous rod along z; its moment about z is zero.

    Args:
        mass: Mass [kg].
        length: Full length [m].

    Returns:
        The body, centre at the origin.

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.rod(12.0, 1.0).inertia))
    [1. 1. 0.]
    """
    return solid(lambda z: (0.0, 0.0, z * z / 12), mass, length=length)


@one_program
def lamina(mass: ScalarLike, lengths: Real[ArrayLike, "2"]) -> MassProperties:
    """Infinitely thin homogeneous rectangle in the plane z = 0.

    Args:
        mass: Mass [kg].
        lengths: Full edge lengths along x and y [m].

    Returns:
        The body, centre at the origin; I3 = I1 + I2.

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.lamina(12.0, jnp.array([1.0, 2.0])).inertia))
    [4. 1. 5.]
    """

    def mean_squares(edges: Float[Array, "2"]) -> MeanSquares:
        x, y = edges
        return x * x / 12, y * y / 12, 0.0

    return solid(mean_squares, mass, shape=(2,), lengths=lengths)


@one_program
def tetrahedron(mass: ScalarLike, vertices: Real[ArrayLike, "4 3"]) -> MassProperties:
    """Homogeneous tetrahedron with given corners, in their coordinates.

    Args:
        mass: Mass [kg].
        vertices: Coordinates of the corners, in any order [m]. A flat one is a plate.

    Returns:
        The body, centre of mass at the mean of the corners.

    Gradients: polynomial, finite everywhere.
    Source: Tonon, J. Math. Stat. 1 (2005) 8-11.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> corners = jnp.array([[0.0, 0, 0], [4.0, 0, 0], [0, 4.0, 0], [0, 0, 4.0]])
    >>> print(jr.solids.tetrahedron(5.0, corners).inertia)
    [[6. 1. 1.]
     [1. 6. 1.]
     [1. 1. 6.]]
    """
    mass, vertices = shaped(mass=(mass,), vertices=(vertices, 4, 3))

    def body(mass: Array, vertices: Array) -> MassProperties:
        origin = vertices[0]
        center = origin + jnp.sum(vertices - origin[None, :], axis=0) / 4
        # A point of a twentieth of the mass at each corner has the same tensor about
        # the centre.
        corners = jnp.broadcast_to(mass / 20, (4,))
        inertia = inertia_tensor(corners, vertices - center[None, :])
        return MassProperties.unchecked(mass, center, inertia)

    ok = all_positive(mass) & all_finite(vertices)
    return where_defined(ok, body, mass, vertices)
