"""Solids with curved faces."""

import jax.numpy as jnp

from jrigid._types import ScalarLike, VectorLike
from jrigid.mass import MassProperties
from jrigid.solids._common import mass_and_lengths, solid


def sphere(mass: ScalarLike, radius: ScalarLike, *, throw: bool = True) -> MassProperties:
    """Homogeneous ball.

    Args:
        mass: Mass [kg].
        radius: Radius [m].
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, centre at the origin.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Mass or radius not positive and finite (run time, any lane).

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.sphere(5.0, 1.0).inertia))
    [2. 2. 2.]
    """
    found, (mass, radius) = mass_and_lengths(mass, radius=(radius, ()))
    moment = 0.4 * radius * radius
    return solid(found, mass, jnp.stack([moment] * 3), throw)


def shell(
    mass: ScalarLike,
    radius: ScalarLike,
    *,
    inner_radius: ScalarLike | None = None,
    throw: bool = True,
) -> MassProperties:
    """Spherical shell: infinitely thin, or a ball with a concentric spherical cavity.

    Args:
        mass: Mass [kg].
        radius: Outer radius [m].
        inner_radius: Radius of the cavity [m], below `radius`; None for a thin shell.
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, centre at the origin.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Mass or a radius not positive and finite, or `inner_radius` not below
            `radius` (run time, any lane).

    Gradients: finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.shell(3.0, 1.0).inertia))
    [2. 2. 2.]
    """
    if inner_radius is None:
        found, (mass, radius) = mass_and_lengths(mass, radius=(radius, ()))
        moment = 2 * radius * radius / 3
        return solid(found, mass, jnp.stack([moment] * 3), throw)
    found, (mass, radius, inner) = mass_and_lengths(
        mass, radius=(radius, ()), inner_radius=(inner_radius, ())
    )
    # (R^5 - r^5) / (R^3 - r^3) with the common factor R - r divided out: 5/3 R^2 in the limit.
    q = inner / radius
    ratio = (1 + q * (1 + q * (1 + q * (1 + q)))) / (1 + q * (1 + q))
    moment = 0.4 * radius * radius * ratio
    return solid(
        found,
        mass,
        jnp.stack([moment] * 3),
        throw,
        fits=(inner < radius, "Argument `inner_radius` must be below `radius`, but it is not."),
    )


def ellipsoid(mass: ScalarLike, semi_axes: VectorLike, *, throw: bool = True) -> MassProperties:
    """Homogeneous ellipsoid, axes along x, y, z.

    Args:
        mass: Mass [kg].
        semi_axes: Semi-axes along x, y, z [m].
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, centre at the origin.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Mass or a semi-axis not positive and finite (run time, any lane).

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.ellipsoid(5.0, jnp.array([1.0, 2.0, 3.0])).inertia))
    [13. 10.  5.]
    """
    found, (mass, semi_axes) = mass_and_lengths(mass, semi_axes=(semi_axes, (3,)))
    x, y, z = semi_axes * semi_axes
    moments = jnp.stack([y + z, x + z, x + y]) / 5
    return solid(found, mass, moments, throw)


def cylinder(
    mass: ScalarLike, radius: ScalarLike, height: ScalarLike, *, throw: bool = True
) -> MassProperties:
    """Homogeneous circular cylinder along z.

    Args:
        mass: Mass [kg].
        radius: Radius [m].
        height: Full height [m].
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, centre at the origin. The transverse moment is M h^2 / 12 + M r^2 / 4 (a source
        in circulation prints M h^2 / 2).

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Mass or a length not positive and finite (run time, any lane).

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.cylinder(12.0, 2.0, 1.0).inertia))
    [13. 13. 24.]
    """
    found, (mass, radius, height) = mass_and_lengths(mass, radius=(radius, ()), height=(height, ()))
    transverse = height * height / 12 + radius * radius / 4
    moments = jnp.stack([transverse, transverse, radius * radius / 2])
    return solid(found, mass, moments, throw)


def tube(
    mass: ScalarLike,
    inner_radius: ScalarLike,
    outer_radius: ScalarLike,
    height: ScalarLike,
    *,
    throw: bool = True,
) -> MassProperties:
    """Homogeneous circular tube along z.

    Args:
        mass: Mass [kg].
        inner_radius: Radius of the bore [m].
        outer_radius: Outer radius [m], not below the inner; equal radii are a thin wall.
        height: Full height [m].
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, centre at the origin.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Mass or a length not positive and finite, or `inner_radius` above
            `outer_radius` (run time, any lane).

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.tube(12.0, 1.0, 3.0, 2.0).inertia))
    [34. 34. 60.]
    """
    found, (mass, inner, outer, height) = mass_and_lengths(
        mass, inner_radius=(inner_radius, ()), outer_radius=(outer_radius, ()), height=(height, ())
    )
    squares = inner * inner + outer * outer
    transverse = height * height / 12 + squares / 4
    message = "Argument `inner_radius` must not exceed `outer_radius`, but it does."
    return solid(
        found,
        mass,
        jnp.stack([transverse, transverse, squares / 2]),
        throw,
        fits=(inner <= outer, message),
    )


def cone(
    mass: ScalarLike, radius: ScalarLike, height: ScalarLike, *, throw: bool = True
) -> MassProperties:
    """Homogeneous circular cone along z, apex up.

    Args:
        mass: Mass [kg].
        radius: Radius of the base [m].
        height: From base to apex [m].
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, centre of mass at the origin: the apex is at z = 3 height / 4, the base at
        z = -height / 4.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Mass or a length not positive and finite (run time, any lane).

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.cone(80.0, 2.0, 4.0).inertia))
    [96. 96. 96.]
    """
    found, (mass, radius, height) = mass_and_lengths(mass, radius=(radius, ()), height=(height, ()))
    transverse = 3 * (4 * radius * radius + height * height) / 80
    moments = jnp.stack([transverse, transverse, 3 * radius * radius / 10])
    return solid(found, mass, moments, throw)


def disk(mass: ScalarLike, radius: ScalarLike, *, throw: bool = True) -> MassProperties:
    """Infinitely thin homogeneous disk in the plane z = 0.

    Args:
        mass: Mass [kg].
        radius: Radius [m].
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, centre at the origin; I3 = I1 + I2.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Mass or radius not positive and finite (run time, any lane).

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.disk(4.0, 1.0).inertia))
    [1. 1. 2.]
    """
    found, (mass, radius) = mass_and_lengths(mass, radius=(radius, ()))
    moment = radius * radius / 4
    moments = jnp.stack([moment, moment, 2 * moment])
    return solid(found, mass, moments, throw)


def hoop(mass: ScalarLike, radius: ScalarLike, *, throw: bool = True) -> MassProperties:
    """Infinitely thin homogeneous circular hoop in the plane z = 0.

    Args:
        mass: Mass [kg].
        radius: Radius [m].
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, centre at the origin; I3 = I1 + I2.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Mass or radius not positive and finite (run time, any lane).

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.hoop(2.0, 1.0).inertia))
    [1. 1. 2.]
    """
    found, (mass, radius) = mass_and_lengths(mass, radius=(radius, ()))
    moment = radius * radius / 2
    moments = jnp.stack([moment, moment, 2 * moment])
    return solid(found, mass, moments, throw)


def torus(
    mass: ScalarLike, ring_radius: ScalarLike, tube_radius: ScalarLike, *, throw: bool = True
) -> MassProperties:
    """Homogeneous solid torus around z.

    Args:
        mass: Mass [kg].
        ring_radius: From the centre of the torus to the centre of the tube [m].
        tube_radius: Radius of the tube [m], not above the ring's.
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, centre at the origin.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Mass or a radius not positive and finite, or `tube_radius` above
            `ring_radius` (run time, any lane).

    Gradients: polynomial, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.torus(8.0, 3.0, 2.0).inertia))
    [56. 56. 96.]
    """
    found, (mass, ring, tube_) = mass_and_lengths(
        mass, ring_radius=(ring_radius, ()), tube_radius=(tube_radius, ())
    )
    ring2, tube2 = ring * ring, tube_ * tube_
    transverse = ring2 / 2 + 5 * tube2 / 8
    message = "Argument `tube_radius` must not exceed `ring_radius`, but it does."
    return solid(
        found,
        mass,
        jnp.stack([transverse, transverse, ring2 + 3 * tube2 / 4]),
        throw,
        fits=(tube_ <= ring, message),
    )


def capsule(
    mass: ScalarLike, radius: ScalarLike, height: ScalarLike, *, throw: bool = True
) -> MassProperties:
    """Homogeneous cylinder along z with a half ball at each end.

    Args:
        mass: Mass of the whole [kg].
        radius: Radius of the cylinder and of the half balls [m].
        height: Of the cylinder alone [m]; the whole is longer by two radii.
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        The body, centre at the origin.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Mass or a length not positive and finite (run time, any lane).

    Gradients: finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.solids.capsule(140.0, 1.0, 2.0).inertia).round(3))
    [169.4 169.4  64.4]
    """
    found, (mass, radius, height) = mass_and_lengths(mass, radius=(radius, ()), height=(height, ()))
    # Shares of the mass: volumes pi r^2 h and 4 pi r^3 / 3.
    whole = height + 4 * radius / 3
    middle, ends = height / whole, 4 * radius / (3 * whole)
    r2, h2 = radius * radius, height * height
    along = middle * r2 / 2 + ends * 2 * r2 / 5
    # A half ball has its centre of mass 3 r / 8 above its base and 2/5 m r^2 about the base.
    transverse = middle * (h2 / 12 + r2 / 4) + ends * (
        2 * r2 / 5 + h2 / 4 + 3 * radius * height / 8
    )
    moments = jnp.stack([transverse, transverse, along])
    return solid(found, mass, moments, throw)
