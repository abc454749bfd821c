"""Solids with curved faces."""

from jaxtyping import Array, Bool

from jrigid._core.compile import one_program
from jrigid._types import Scalar, ScalarLike, VectorLike
from jrigid.mass import MassProperties
from jrigid.solids._mean_squares import MeanSquares, solid


def _round(across: ScalarLike, along: ScalarLike) -> MeanSquares:
    """The mean squares of a body of revolution about z."""
    return across, across, along


def _in_order(inner: Scalar, outer: Scalar, *_: Scalar) -> Bool[Array, ""]:
    return inner <= outer


@one_program
def sphere(mass: ScalarLike, radius: ScalarLike) -> MassProperties:
    """Homogeneous ball.

    Args:
        mass: Mass [kg].
        radius: Radius [m].

    Returns:
        The body, centre at the origin.

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.sphere(5.0, 1.0).inertia))
    [2. 2. 2.]
    """
    # The mean of |r|^2 over a ball is 3 R^2 / 5, a third of it for each coordinate.
    return solid(lambda r: _round(r * r / 5, r * r / 5), mass, radius=radius)


@one_program
def shell(
    mass: ScalarLike, inner_radius: ScalarLike, outer_radius: ScalarLike
) -> MassProperties:
    """Spherical shell: a ball with a concentric spherical cavity.

    Args:
        mass: Mass [kg].
        inner_radius: Radius of the cavity [m].
        outer_radius: Outer radius [m], not below the inner; equal radii are a thin
            shell.

    Returns:
        The body, centre at the origin.

    Gradients: finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.shell(3.0, 1.0, 1.0).inertia))
    [2. 2. 2.]
    """

    def mean_squares(inner: Scalar, outer: Scalar) -> MeanSquares:
        # (R^5 - r^5) / (R^3 - r^3), without the common factor R - r: a thin shell,
        # r = R, is no exception and gives 5/3 R^2.
        q = inner / outer
        ratio = (1 + q * (1 + q * (1 + q * (1 + q)))) / (1 + q * (1 + q))
        square = outer * outer / 5 * ratio
        return square, square, square

    return solid(
        mean_squares,
        mass,
        inner_radius=inner_radius,
        outer_radius=outer_radius,
        fits=_in_order,
    )


@one_program
def ellipsoid(mass: ScalarLike, semi_axes: VectorLike) -> MassProperties:
    """Homogeneous ellipsoid, axes along x, y, z.

    Args:
        mass: Mass [kg].
        semi_axes: Semi-axes along x, y, z [m].

    Returns:
        The body, centre at the origin.

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.ellipsoid(5.0, jnp.array([1.0, 2.0, 3.0])).inertia))
    [13. 10.  5.]
    """
    return solid(lambda axes: axes * axes / 5, mass, shape=(3,), semi_axes=semi_axes)


@one_program
def cylinder(
    mass: ScalarLike, radius: ScalarLike, height: ScalarLike
) -> MassProperties:
    """Homogeneous circular cylinder along z.

    Args:
        mass: Mass [kg].
        radius: Radius [m].
        height: Full height [m].

    Returns:
        The body, centre at the origin. The transverse moment is M h^2 / 12 + M r^2 / 4
        (a source in circulation prints M h^2 / 2).

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.cylinder(12.0, 2.0, 1.0).inertia))
    [13. 13. 24.]
    """
    return solid(
        lambda r, h: _round(r * r / 4, h * h / 12), mass, radius=radius, height=height
    )


@one_program
def tube(
    mass: ScalarLike,
    inner_radius: ScalarLike,
    outer_radius: ScalarLike,
    height: ScalarLike,
) -> MassProperties:
    """Homogeneous circular tube along z.

    Args:
        mass: Mass [kg].
        inner_radius: Radius of the bore [m].
        outer_radius: Outer radius [m], not below the inner; equal radii are a thin
            wall.
        height: Full height [m].

    Returns:
        The body, centre at the origin.

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.tube(12.0, 1.0, 3.0, 2.0).inertia))
    [34. 34. 60.]
    """

    def mean_squares(inner: Scalar, outer: Scalar, height: Scalar) -> MeanSquares:
        return _round((inner * inner + outer * outer) / 4, height * height / 12)

    return solid(
        mean_squares,
        mass,
        inner_radius=inner_radius,
        outer_radius=outer_radius,
        height=height,
        fits=_in_order,
    )


@one_program
def cone(mass: ScalarLike, radius: ScalarLike, height: ScalarLike) -> MassProperties:
    """Homogeneous circular cone along z, apex up.

    Args:
        mass: Mass [kg].
        radius: Radius of the base [m].
        height: From base to apex [m].

    Returns:
        The body, centre of mass at the origin: the apex is at z = 3 height / 4, the
        base at z = -height / 4.

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.cone(80.0, 2.0, 4.0).inertia))
    [96. 96. 96.]
    """
    return solid(
        # About the centre of mass: the mean of z^2 about the apex is 3 h^2 / 5, less
        # the square of the distance 3 h / 4.
        lambda r, h: _round(3 * r * r / 20, 3 * h * h / 80),
        mass,
        radius=radius,
        height=height,
    )


@one_program
def disk(mass: ScalarLike, radius: ScalarLike) -> MassProperties:
    """Infinitely thin homogeneous disk in the plane z = 0.

    Args:
        mass: Mass [kg].
        radius: Radius [m].

    Returns:
        The body, centre at the origin; I3 = I1 + I2.

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.disk(4.0, 1.0).inertia))
    [1. 1. 2.]
    """
    return solid(lambda r: _round(r * r / 4, 0.0), mass, radius=radius)


@one_program
def hoop(mass: ScalarLike, radius: ScalarLike) -> MassProperties:
    """Infinitely thin homogeneous circular hoop in the plane z = 0.

    Args:
        mass: Mass [kg].
        radius: Radius [m].

    Returns:
        The body, centre at the origin; I3 = I1 + I2.

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.hoop(2.0, 1.0).inertia))
    [1. 1. 2.]
    """
    return solid(lambda r: _round(r * r / 2, 0.0), mass, radius=radius)


@one_program
def torus(
    mass: ScalarLike, ring_radius: ScalarLike, tube_radius: ScalarLike
) -> MassProperties:
    """Homogeneous solid torus around z.

    Args:
        mass: Mass [kg].
        ring_radius: From the centre of the torus to the centre of the tube [m].
        tube_radius: Radius of the tube [m], not above the ring's.

    Returns:
        The body, centre at the origin.

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.torus(8.0, 3.0, 2.0).inertia))
    [56. 56. 96.]
    """

    def mean_squares(tube: Scalar, ring: Scalar) -> MeanSquares:
        # A point of the cross-section at a distance rho from z counts in proportion to
        # rho. Then the mean of rho^2 is ring^2 + 3 tube^2 / 4.
        return _round(ring * ring / 2 + 3 * tube * tube / 8, tube * tube / 4)

    return solid(
        mean_squares,
        mass,
        # `fits` compares the first two lengths, so the tube comes first.
        tube_radius=tube_radius,
        ring_radius=ring_radius,
        fits=_in_order,
    )


@one_program
def capsule(mass: ScalarLike, radius: ScalarLike, height: ScalarLike) -> MassProperties:
    """Homogeneous cylinder along z with a half ball at each end.

    Args:
        mass: Mass of the whole [kg].
        radius: Radius of the cylinder and of the half balls [m].
        height: Of the cylinder alone [m]; the whole is longer by two radii.

    Returns:
        The body, centre at the origin.

    Gradients: finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.capsule(140.0, 1.0, 2.0).inertia).round(3))
    [169.4 169.4  64.4]
    """

    def mean_squares(r: Scalar, h: Scalar) -> MeanSquares:
        # Shares of the mass: volumes pi r^2 h and 4 pi r^3 / 3.
        whole = h + 4 * r / 3
        middle = h / whole
        ends = 4 * r / (3 * whole)
        # Height z above the base of a half ball has the mean 3 r / 8 and the mean
        # square r^2 / 5. The mean of (h / 2 + z)^2 follows.
        along = middle * h * h / 12 + ends * (r * r / 5 + h * h / 4 + 3 * r * h / 8)
        return _round(middle * r * r / 4 + ends * r * r / 5, along)

    return solid(mean_squares, mass, radius=radius, height=height)
