"""Inertia tensors: checks, parallel axes, principal axes, functions of a tensor."""

from collections.abc import Callable
from typing import final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jrigid._checks import (
    INERTIA,
    all_finite,
    check_shape,
    float_arrays,
    is_symmetric,
    scaled_together,
    shaped,
    where_defined,
)
from jrigid._core.compile import one_program
from jrigid._numerics import as_tensor
from jrigid._spectral import eigh, spectral_function
from jrigid._types import (
    InertiaLike,
    Matrix,
    Readable,
    Scalar,
    ScalarLike,
    Vector,
    VectorLike,
)

#: Rounding that is allowed in "not negative" and "I3 <= I1 + I2".
ULPS = 64


def _checked_tensor(inertia: Array) -> Matrix:
    """The tensor of moments or of a tensor, or ValueError for another shape."""
    check_shape("inertia", inertia, *INERTIA)
    return as_tensor(inertia)


def inertia_of_second_moment(second: Matrix) -> Matrix:
    """Inertia tensor of a second moment of the mass, tr(S) 1 - S.

    Diagonal elements are sums of two numbers. The difference tr(S) - S_zz would leave
    no digits to a needle along z.

    Args:
        second: S, the integral of r r^T over the mass [kg m^2].

    Gradients: linear.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> second = jnp.diag(jnp.array([1.0, 2.0, 3.0]))
    >>> print(jnp.diag(jr.mass.inertia_of_second_moment(second)))
    [5. 4. 3.]
    """
    x, y, z = jnp.diagonal(second)
    outside = jnp.where(np.eye(3, dtype=bool), 0.0, second)
    return jnp.diag(jnp.stack([y + z, x + z, x + y])) - outside


def second_moment(inertia: Matrix) -> Matrix:
    """Second moment of the mass of an inertia tensor, (tr(I) / 2) 1 - I.

    A body is real if it is positive semi-definite, flat if it is singular.

    Args:
        inertia: Tensor [kg m^2].

    Gradients: linear.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.mass.second_moment(jnp.diag(jnp.array([5.0, 4.0, 3.0])))))
    [1. 2. 3.]
    """
    # I = tr(S) 1 - S has the trace 2 tr(S).
    return 0.5 * jnp.trace(inertia) * jnp.eye(3, dtype=inertia.dtype) - inertia


def steiner(displacement: Vector) -> Matrix:
    """Inertia tensor of a unit mass at a place d, |d|^2 1 - d d^T."""
    return inertia_of_second_moment(displacement[:, None] * displacement[None, :])


def is_semidefinite(tensor: Matrix, scale: Scalar) -> Bool[Array, ""]:
    """Whether no moment is below -64 ulps of a scale, by Cholesky with pivoting.

    Entries and scale must be about 1: products of much larger or smaller ones leave the
    range of the dtype.
    """
    # The pivots are good to a few ulps whatever the moments are. The roots of the
    # characteristic cubic lose half the digits where moments nearly coincide.
    shift = ULPS * jnp.finfo(tensor.dtype).eps * scale
    remainder = tensor + shift * jnp.eye(3, dtype=tensor.dtype)
    remaining = jnp.ones(3, bool)
    is_fine = jnp.asarray(True)
    for _ in range(3):
        k = jnp.argmax(jnp.where(remaining, jnp.diagonal(remainder), -jnp.inf))
        row = remainder[k]
        pivot = row[k]
        is_fine = is_fine & (pivot >= 0)
        # In a semi-definite tensor the row of a zero pivot is zero. If it is not, what
        # it subtracts makes a later pivot negative.
        divisor = jnp.where(pivot > 0, pivot, 1.0)
        remainder = remainder - row[:, None] * row[None, :] / divisor
        remaining = remaining & (jnp.arange(3) != k)
    return is_fine


@jax.jit
def is_physical(tensor: Matrix) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether a tensor is symmetric and semi-definite, and whether I3 <= I1 + I2."""
    tensor = jax.lax.stop_gradient(tensor)
    (unit,) = scaled_together(tensor)
    trace = jnp.trace(unit)
    is_positive = is_symmetric(tensor) & is_semidefinite(unit, trace)
    # The second moments are (I2 + I3 - I1) / 2 and so on, so the triangle inequality
    # holds exactly where none is negative.
    obeys_triangle = is_semidefinite(second_moment(unit), trace)
    return is_positive, obeys_triangle


def body_arrays(
    inertia: ArrayLike, mass: ArrayLike, **vector: ArrayLike
) -> tuple[Matrix, Scalar, Vector]:
    """Convert a tensor, a mass and a vector to one dtype, or raise ValueError.

    The vector is a keyword argument: errors call it by that name.
    """
    ((name, value),) = vector.items()
    inertia, mass, value = shaped(
        inertia=(inertia, *INERTIA), mass=(mass,), **{name: (value, 3)}
    )
    return _checked_tensor(inertia), mass, value


def _from_center(tensor: Matrix, mass: Scalar, displacement: Vector) -> Matrix:
    return tensor + mass * steiner(displacement)


def _to_center(tensor: Matrix, mass: Scalar, displacement: Vector) -> Matrix:
    return tensor - mass * steiner(displacement)


def _can_be_displaced(
    tensor: Matrix, mass: Scalar, displacement: Vector
) -> Bool[Array, ""]:
    return is_symmetric(tensor) & (mass >= 0) & all_finite((mass, displacement))


@one_program
def parallel_axis(
    inertia: InertiaLike, mass: ScalarLike, displacement: VectorLike
) -> Matrix:
    r"""Inertia tensor about a point displaced from the centre of mass.

    $I = I_{com} + m (|d|^2 1 - d d^T)$. NaN where the tensor is not symmetric or the
    mass negative.

    Args:
        inertia: Moments or tensor about the centre of mass [kg m^2].
        mass: Mass [kg].
        displacement: Between centre of mass and point, either way round [m].

    Returns:
        Tensor about the point, same axes [kg m^2].

    Gradients: polynomial, finite everywhere.
    Source: Goldstein, Classical Mechanics, 3rd ed., 5.3 (Steiner).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> d = jnp.array([0.0, 0.0, 2.0])
    >>> print(jnp.diag(jr.parallel_axis(jnp.array([1.0, 1.0, 0.0]), 3.0, d)))
    [13. 13.  0.]
    """
    arguments = body_arrays(inertia, mass, displacement=displacement)
    ok = _can_be_displaced(*jax.lax.stop_gradient(arguments))
    return where_defined(ok, _from_center, *arguments)


@one_program
def to_center_of_mass(
    inertia: InertiaLike, mass: ScalarLike, displacement: VectorLike
) -> Matrix:
    r"""Inertia tensor about the centre of mass, from that about a displaced point.

    The inverse of `parallel_axis`: $I_{com} = I - m (|d|^2 1 - d d^T)$. NaN where the
    tensor is not symmetric or the mass negative, and where a moment about the centre of
    mass comes out negative: no body with `mass` at `displacement` has so small a
    tensor.

    Args:
        inertia: Moments or tensor about the point [kg m^2].
        mass: Mass [kg].
        displacement: Between centre of mass and point, either way round [m].

    Returns:
        Tensor about the centre of mass, same axes [kg m^2].

    Gradients: polynomial, finite everywhere.
    Source: Goldstein, Classical Mechanics, 3rd ed., 5.3 (Steiner).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> d = jnp.array([0.0, 0.0, 2.0])
    >>> print(jnp.diag(jr.to_center_of_mass(jnp.array([13.0, 13.0, 0.0]), 3.0, d)))
    [1. 1. 0.]
    """
    arguments = body_arrays(inertia, mass, displacement=displacement)
    known = jax.lax.stop_gradient(arguments)
    about_point, about_center = scaled_together(known[0], _to_center(*known))
    # Rounding of the difference is that of the larger tensor.
    is_real = is_semidefinite(about_center, jnp.trace(about_point))
    return where_defined(_can_be_displaced(*known) & is_real, _to_center, *arguments)


@final
class PrincipalAxes(Readable):
    """Principal moments and axes of an inertia tensor.

    Attributes:
        moments: Principal moments, ascending [kg m^2].
        axes: Rotation whose columns are the principal axes: v_body = axes @
            v_principal.
    """

    moments: Float[Array, "3"]
    axes: Float[Array, "3 3"]


@one_program
def principal_axes(inertia: InertiaLike) -> PrincipalAxes:
    """Principal moments and axes of an inertia tensor; NaN where it is not symmetric.

    Moments ascend; axes are the columns of a right-handed rotation. In axes 1 and 3 the
    first component that has at least 0.9 of the largest magnitude is positive, so that
    the signs do not hang on the last bit where two components tie; axis 2 completes the
    rotation.

    Args:
        inertia: Moments or tensor [kg m^2]; any symmetric tensor will do.

    Returns:
        Moments and axes, tensor = axes diag(moments) axes^T to a few ulps of the
        largest.

    Gradients: d moments = diag(axes^T dI axes). First derivatives of symmetric
    functions of the moments (`sum(1 / moments)`) are right everywhere, repeated moments
    included. The moments one by one, and the axes, have no derivative where moments
    repeat: there d axes is finite and leaves out the axes of equal moments, so
    functions composed of moments and axes by hand, and second derivatives, cannot be
    right there. Use `tensor_function` for them.
    Source: Golub and Van Loan, Matrix Computations, 4th ed., 8.5 (Jacobi).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.principal_axes(jnp.array([3.0, 1.0, 2.0])).moments)
    [1. 2. 3.]
    """
    tensor = _checked_tensor(float_arrays(inertia)[0])
    return where_defined(
        is_symmetric(tensor), lambda x: PrincipalAxes(*eigh(x)), tensor
    )


def tensor_function(f: Callable[[Scalar], Scalar], inertia: InertiaLike) -> Matrix:
    """Function of a tensor, axes diag(f(moments)) axes^T, with right derivatives.

    NaN where the tensor is not symmetric, and where f is.

    Args:
        f: Maps a scalar to a scalar, smooth on the range of the moments, by jax
            operations; forward-differentiable. It may close over parameters that are
            differentiated. Across gaps below a tenth of a moment its derivatives are
            integrated with eight nodes.
        inertia: Moments or tensor [kg m^2]; any symmetric tensor in the domain of f.

    Returns:
        Symmetric tensor in the units of f.

    Raises:
        ValueError: f does not map scalars to scalars.
        NotImplementedError: A third derivative in the tensor.

    Gradients: first and second, in every mode, in the tensor and in what f closes over,
    right at repeated and nearly repeated moments (divided differences), where moments
    and axes composed by hand give NaN or finite wrong numbers. So are those of its
    trace.
    Source: Higham, Functions of Matrices (2008), theorem 3.11 (Daleckii and Krein).

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> trace = lambda inertia: jnp.trace(jr.tensor_function(jnp.sqrt, inertia))
    >>> print(jax.grad(trace)(4 * jnp.eye(3)))
    [[0.25 0.   0.  ]
     [0.   0.25 0.  ]
     [0.   0.   0.25]]
    """
    tensor = _checked_tensor(float_arrays(inertia)[0])
    moment = jax.ShapeDtypeStruct((), tensor.dtype)
    shape = jax.eval_shape(f, moment)
    if getattr(shape, "shape", None) != () or shape.dtype != tensor.dtype:
        raise ValueError(
            f"Argument `f` must map {moment} to the same, but it gives {shape}."
        )
    # A custom derivative rule takes what f closes over only as an argument.
    hoisted, parameters = jax.closure_convert(f, jnp.zeros((), tensor.dtype))
    # In a bad lane f is evaluated at 1, which is in the domain of most functions.
    return where_defined(
        is_symmetric(tensor),
        lambda x: spectral_function(hoisted, x, *parameters),
        tensor,
    )
