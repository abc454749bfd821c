"""Numbers without bounds for the inertia of a real body: physical by construction."""

from typing import Any

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
from jrigid._numerics import product
from jrigid._types import InertiaLike, Matrix, Real, Scalar, Vector
from jrigid.mass import MassProperties, inertia_of_second_moment, second_moment

SIDES = [1, 2, 2], [0, 0, 1]  # of a lower triangle, below its diagonal
_LOWER, _UPPER = ([1, 0, 0], [4, 2, 0], [5, 6, 3]), ([1, 4, 6], [0, 2, 5], [0, 0, 3])


def squared(diagonal: Array, sides: Array, places: Any = _LOWER) -> Matrix:
    """L L^T of a triangle, whose numbers have places in (0, diagonal, sides)."""
    factor = jnp.concatenate([jnp.zeros_like(sides[:1]), diagonal, sides])[
        np.array(places)
    ]
    return product("ik,jk->ij", factor, factor)


def inertia_from_parameters(parameters: Real[ArrayLike, "6"]) -> Matrix:
    """Inertia tensor of a real body from six numbers without bounds.

    The tensor of second moments of the mass, Sigma = (trace I / 2) 1 - I, is L L^T, L
    lower triangular with a positive diagonal: then I is positive definite and its
    principal moments obey I3 < I1 + I2, whatever the numbers are. The first is the
    scale, log L11; the others are the shape, which is what free motion tells: log(L22 /
    L11), log(L33 / L11), L21 / L11, L31 / L11, L32 / L11. All zero is a sphere of
    moments 2.

    Args:
        parameters: The six numbers [-], the first the logarithm of a number in sqrt(kg)
            m.

    Returns:
        Inertia tensor [kg m^2]; NaN unless all six are finite.

    Gradients: analytic; every tensor of a body with extent in three directions is
    reached by one set of numbers, so that nothing singular is in the way.
    Source: P. M. Wensing, S. Kim, J.-J. Slotine, IEEE Robotics and Automation Letters 3
    (2018) 60, for the second moments; docs in `parameters_from_inertia`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.identify.inertia_from_parameters(jnp.zeros(6)))
    [[2. 0. 0.]
     [0. 2. 0.]
     [0. 0. 2.]]
    """
    (parameters,) = shaped(parameters=(parameters, 6))

    def tensor(p: Array) -> Matrix:
        scale, sizes = jnp.exp(p[0]), jnp.exp(p[:3].at[0].set(0))
        return inertia_of_second_moment(squared(scale * sizes, scale * p[3:]))

    return where_defined(all_finite(parameters), tensor, parameters)


def parameters_from_inertia(inertia: InertiaLike) -> Float[Array, "6"]:
    """Six numbers without bounds for the inertia of a real body: see `inertia_from_parameters`.

    Args:
        inertia: Principal moments, or tensor [kg m^2], with I3 < I1 + I2.

    Returns:
        The numbers; NaN for a tensor that is not symmetric, or of no body with extent
        in three directions.

    Gradients: right for symmetric changes of the tensor; they grow as the body gets
        flat.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> numbers = jr.identify.parameters_from_inertia(jnp.array([1.0, 2.0, 2.5]))
    >>> print(jr.identify.inertia_from_parameters(numbers).round(6))
    [[1.  0.  0. ]
     [0.  2.  0. ]
     [0.  0.  2.5]]
    """
    (inertia,) = shaped(inertia=(inertia, *INERTIA))
    tensor = jnp.diag(inertia) if inertia.ndim == 1 else inertia
    second = second_moment(0.5 * (tensor + tensor.T))
    solid = is_inertia(tensor) & is_inertia(second)

    def numbers(second: Matrix) -> Array:
        lower = jnp.linalg.cholesky(second)
        diagonal, scale = jnp.diagonal(lower), lower[0, 0]
        sizes = jnp.log(diagonal / scale).at[0].set(jnp.log(scale))
        return jnp.concatenate([sizes, lower[SIDES] / scale])

    return where_defined(solid, numbers, second)


def body_from_log_cholesky(parameters: Real[ArrayLike, "10"]) -> MassProperties:
    """Mass properties of a real body from the ten numbers of its log-Cholesky parametrisation.

    The pseudo-inertia [[Sigma, m c], [m c^T, m]], Sigma the second moments of the mass
    about the origin of the coordinates, is U U^T with U = exp(alpha) [[exp(d1), s12,
    s13, t1], [0, exp(d2), s23, t2], [0, 0, exp(d3), t3], [0, 0, 0, 1]]. The numbers are
    (alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3), in the order of the source (and of
    Pinocchio and MuJoCo); t is the centre of mass.

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


def log_cholesky_from_body(body: MassProperties) -> Float[Array, "10"]:
    """The ten numbers of a body's log-Cholesky parametrisation: see `body_from_log_cholesky`.

    Args:
        body: A body with extent in three directions.

    Returns:
        (alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3); NaN for a flat body.

    Gradients: right for symmetric changes of the tensor; they grow as the body gets
        flat.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> numbers = jr.identify.log_cholesky_from_body(jr.solids.box(8.0, jnp.array([1.0, 2.0, 3.0])))
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
        sides = upper[np.array([0, 1, 0]), np.array([1, 2, 2])]
        return jnp.concatenate([sizes, sides, center_of_mass])

    return where_defined(solid, numbers, body.mass, body.center_of_mass, second)
