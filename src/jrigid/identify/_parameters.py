"""Unbounded numbers for the inertia of a real body: physical by construction."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jrigid._checks import (
    INERTIA,
    all_finite,
    check_type,
    is_inertia,
    shaped,
    where_defined,
)
from jrigid._core.compile import one_program
from jrigid._numerics import as_tensor, product
from jrigid._types import InertiaLike, Matrix, Real, Scalar, Vector
from jrigid.mass import MassProperties, inertia_of_second_moment, second_moment

# Rows and columns of the elements of a triangle beside its diagonal.
SIDES = [1, 2, 2], [0, 0, 1]
_UPPER_SIDES = np.array([0, 1, 0]), np.array([1, 2, 2])
# Where the elements of a triangle are in (0, diagonal, sides).
_LOWER = ([1, 0, 0], [4, 2, 0], [5, 6, 3])
_UPPER = ([1, 4, 6], [0, 2, 5], [0, 0, 3])


def squared(
    diagonal: Array, sides: Array, places: Sequence[Sequence[int]] = _LOWER
) -> Matrix:
    """L L^T of a triangle L.

    Args:
        diagonal: Its diagonal.
        sides: Its elements beside the diagonal.
        places: Index of each element in (0, diagonal, sides).
    """
    elements = jnp.concatenate([jnp.zeros_like(sides[:1]), diagonal, sides])
    factor = elements[np.array(places)]
    return product("ik,jk->ij", factor, factor)


@one_program
def inertia_from_parameters(parameters: Real[ArrayLike, "6"]) -> Matrix:
    """Return the inertia tensor of a real body from six unbounded numbers.

    The tensor of second moments of the mass, Sigma = (trace I / 2) 1 - I, is L L^T,
    where L is lower triangular with a positive diagonal. For any numbers I is therefore
    positive definite and its principal moments obey I3 < I1 + I2.

    The first number is the scale, log L11. The others are log(L22 / L11), log(L33 /
    L11), L21 / L11, L31 / L11 and L32 / L11, which free motion determines. If all are
    zero the body is a sphere of moments 2.

    Args:
        parameters: The six numbers [-], the first the logarithm of a number in sqrt(kg)
            m.

    Returns:
        Inertia tensor [kg m^2]; NaN unless all six are finite.

    Gradients: analytic. Each tensor of a body with extent in three directions has
    exactly one set of numbers, and there are no singular points.
    Source: P. M. Wensing, S. Kim, J.-J. Slotine, IEEE Robotics and Automation Letters 3
    (2018) 60, for the second moments.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.identify.inertia_from_parameters(jnp.zeros(6)))
    [[2. 0. 0.]
     [0. 2. 0.]
     [0. 0. 2.]]
    """
    (parameters,) = shaped(parameters=(parameters, 6))

    def tensor(p: Array) -> Matrix:
        # The first number multiplies all of L, hence the 0 in its place below.
        scale = jnp.exp(p[0])
        sizes = jnp.exp(p[:3].at[0].set(0))
        return inertia_of_second_moment(squared(scale * sizes, scale * p[3:]))

    return where_defined(all_finite(parameters), tensor, parameters)


@one_program
def parameters_from_inertia(inertia: InertiaLike) -> Float[Array, "6"]:
    """Return six unbounded numbers for the inertia of a real body.

    This is the inverse of `inertia_from_parameters`.

    Args:
        inertia: Principal moments, or tensor [kg m^2], with I3 < I1 + I2.

    Returns:
        The numbers; NaN for a tensor that is not symmetric, or that no body with extent
        in three directions has.

    Gradients: correct for symmetric changes of the tensor. They grow without bound as
    the body becomes flat.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> numbers = jr.identify.parameters_from_inertia(jnp.array([1.0, 2.0, 2.5]))
    >>> print(jr.identify.inertia_from_parameters(numbers).round(6))
    [[1.  0.  0. ]
     [0.  2.  0. ]
     [0.  0.  2.5]]
    """
    (inertia,) = shaped(inertia=(inertia, *INERTIA))
    tensor = as_tensor(inertia)
    second = second_moment(0.5 * (tensor + tensor.T))
    # The second moments of a body with extent in three directions are positive
    # definite, as an inertia is, so that one check serves both.
    solid = is_inertia(tensor) & is_inertia(second)

    def numbers(second: Matrix) -> Array:
        lower = jnp.linalg.cholesky(second)
        diagonal = jnp.diagonal(lower)
        scale = lower[0, 0]
        sizes = jnp.log(diagonal / scale).at[0].set(jnp.log(scale))
        return jnp.concatenate([sizes, lower[SIDES] / scale])

    return where_defined(solid, numbers, second)


@one_program
def body_from_log_cholesky(parameters: Real[ArrayLike, "10"]) -> MassProperties:
    """Return the mass properties of a real body from its ten log-Cholesky numbers.

    The pseudo-inertia [[Sigma, m c], [m c^T, m]], Sigma the second moments of the mass
    about the origin of the coordinates, is U U^T with U = exp(alpha) [[exp(d1), s12,
    s13, t1], [0, exp(d2), s23, t2], [0, 0, exp(d3), t3], [0, 0, 0, 1]]. The numbers are
    (alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3), in the order of the source (and of
    Pinocchio and MuJoCo), where t is the centre of mass.

    Args:
        parameters: The ten numbers.

    Returns:
        The body; NaN unless all ten are finite.

    Gradients: analytic.
    Source: C. Rucker, P. M. Wensing, "Smooth parameterization of rigid-body inertia",
    IEEE Robotics and Automation Letters 7 (2022) 2771.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.identify.body_from_log_cholesky(jnp.zeros(10))
    >>> print(body.mass, body.inertia[0])
    1.0 [2. 0. 0.]
    """
    (parameters,) = shaped(parameters=(parameters, 10))

    def body(p: Array) -> tuple[Scalar, Vector, Matrix]:
        mass = jnp.exp(2 * p[0])
        # About the centre of mass the column t drops out.
        sigma = squared(jnp.exp(p[1:4]), p[4:7], _UPPER)
        return mass, p[7:], mass * inertia_of_second_moment(sigma)

    return MassProperties.unchecked(
        *where_defined(all_finite(parameters), body, parameters)
    )


@one_program
def log_cholesky_from_body(body: MassProperties) -> Float[Array, "10"]:
    """Return the ten log-Cholesky numbers of a body.

    This is the inverse of `body_from_log_cholesky`.

    Args:
        body: A body with extent in three directions.

    Returns:
        (alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3); NaN for a flat body.

    Gradients: correct for symmetric changes of the tensor. They grow without bound as
    the body becomes flat.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> box = jr.solids.box(8.0, jnp.array([1.0, 2.0, 3.0]))
    >>> numbers = jr.identify.log_cholesky_from_body(box)
    >>> print(numbers[:4].round(4))
    [ 1.0397 -1.2425 -0.5493 -0.1438]
    """
    check_type("body", body, MassProperties)
    second = second_moment(body.inertia)
    solid = (body.mass > 0) & all_finite(body) & is_inertia(second + second.T)

    def numbers(mass: Scalar, center_of_mass: Vector, second: Matrix) -> Array:
        # The upper factor is the lower one with rows and columns reversed.
        upper = jnp.linalg.cholesky(second[::-1, ::-1] / mass)[::-1, ::-1]
        sizes = jnp.log(jnp.append(mass**0.5, jnp.diagonal(upper)))
        sides = upper[_UPPER_SIDES]
        return jnp.concatenate([sizes, sides, center_of_mass])

    return where_defined(solid, numbers, body.mass, body.center_of_mass, second)
