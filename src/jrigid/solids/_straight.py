"""Solids with plane faces, and the rod."""

import jax.numpy as jnp
from jaxtyping import ArrayLike, Real

from jrigid._checks import RESULTS, Findings, all_finite, check_shape, float_arrays
from jrigid._types import ScalarLike, VectorLike
from jrigid.mass import MassProperties
from jrigid.mass._points import inertia_of_second_moment
from jrigid.solids._common import checked_mass, mass_and_lengths, solid


def box(mass: ScalarLike, lengths: VectorLike, *, throw: bool = True) -> MassProperties:
    """Homogeneous rectangular box, edges along x, y, z.

    Args:
        mass: Mass [kg].
        lengths: Full edge lengths along x, y, z [m].
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, centre at the origin.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Mass or a length not positive and finite (run time, any lane).

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.box(12.0, jnp.array([1.0, 2.0, 3.0])).inertia))
    [13. 10.  5.]
    """
    found, (mass, lengths) = mass_and_lengths(mass, lengths=(lengths, (3,)))
    x, y, z = lengths * lengths
    return solid(found, mass, jnp.stack([y + z, x + z, x + y]) / 12, throw)


def rod(mass: ScalarLike, length: ScalarLike, *, throw: bool = True) -> MassProperties:
    """Infinitely thin homogeneous rod along z; its moment about z is zero.

    Args:
        mass: Mass [kg].
        length: Full length [m].
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, centre at the origin.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Mass or length not positive and finite (run time, any lane).

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.rod(12.0, 1.0).inertia))
    [1. 1. 0.]
    """
    found, (mass, length) = mass_and_lengths(mass, length=(length, ()))
    moment = length * length / 12
    moments = jnp.stack([moment, moment, jnp.zeros_like(moment)])
    return solid(found, mass, moments, throw)


def lamina(
    mass: ScalarLike, lengths: Real[ArrayLike, "2"], *, throw: bool = True
) -> MassProperties:
    """Infinitely thin homogeneous rectangle in the plane z = 0.

    Args:
        mass: Mass [kg].
        lengths: Full edge lengths along x and y [m].
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, centre at the origin; I3 = I1 + I2.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Mass or a length not positive and finite (run time, any lane).

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.lamina(12.0, jnp.array([1.0, 2.0])).inertia))
    [4. 1. 5.]
    """
    found, (mass, lengths) = mass_and_lengths(mass, lengths=(lengths, (2,)))
    x, y = lengths * lengths / 12
    return solid(found, mass, jnp.stack([y, x, x + y]), throw)


def tetrahedron(
    mass: ScalarLike, vertices: Real[ArrayLike, "4 3"], *, throw: bool = True
) -> MassProperties:
    """Homogeneous tetrahedron with given corners, in their coordinates.

    Args:
        mass: Mass [kg].
        vertices: Coordinates of the corners, in any order [m]. A flat one is a plate.
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, centre of mass at the mean of the corners.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Mass not positive and finite, or a corner not finite (run time, any lane).

    Gradients: polynomial, finite everywhere.
    Source: Tonon, J. Math. Stat. 1 (2005) 8-11.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> corners = jnp.array([[0.0, 0, 0], [4.0, 0, 0], [0, 4.0, 0], [0, 0, 4.0]])
    >>> print(jr.solids.tetrahedron(5.0, corners).inertia)
    [[6. 1. 1.]
     [1. 6. 1.]
     [1. 1. 6.]]
    """
    mass, vertices = float_arrays(mass, vertices)
    check_shape("mass", mass, ())
    check_shape("vertices", vertices, (4, 3))
    found = Findings()
    mass = checked_mass(found, mass)
    finite = all_finite(vertices)
    message = "Argument `vertices` must be finite, but it is not."
    found.require(finite, RESULTS.invalid_position, message)
    vertices = jnp.where(finite, vertices, 0.0)
    origin = vertices[0]
    center = origin + jnp.sum(vertices - origin[None, :], axis=0) / 4
    arms = vertices - center[None, :]
    second = jnp.sum(arms[:, :, None] * arms[:, None, :], axis=0) / 20
    return solid(found, mass, inertia_of_second_moment(second), throw, center=center)
