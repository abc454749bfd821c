"""Tensors: parallel axis, principal axes, functions of a tensor."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_inertia_shape,
    check_shape,
    float_arrays,
    nan_where,
    of_unit_size,
)
from jrigid._spectral import eigh, spectral_function
from jrigid._types import (
    InertiaLike,
    Matrix,
    Scalar,
    ScalarLike,
    Vector,
    VectorLike,
)
from jrigid.mass._body import (
    PrincipalAxes,
    as_tensor,
    unit_steiner,
)
from jrigid.mass._validity import NOT_SYMMETRIC, is_finite_symmetric, is_semidefinite


def _tensor(inertia: ArrayLike, *others: ArrayLike) -> tuple[Findings, Matrix, list[Array]]:
    inertia, *rest = float_arrays(inertia, *others)
    check_inertia_shape(inertia)
    tensor = as_tensor(inertia)
    findings = Findings()
    findings.require(is_finite_symmetric(tensor), RESULTS.invalid_inertia, NOT_SYMMETRIC)
    return findings, tensor, rest


def _steiner_arguments(
    inertia: ArrayLike, mass: ArrayLike, displacement: ArrayLike
) -> tuple[Findings, tuple[Matrix, Scalar, Vector]]:
    """What is wrong, and the arguments; zeros, whose derivatives are finite, where it is."""
    findings, tensor, (mass, displacement) = _tensor(inertia, mass, displacement)
    check_shape("mass", mass, ())
    check_shape("displacement", displacement, (3,))
    findings.require(
        (mass >= 0) & jnp.isfinite(mass),
        RESULTS.invalid_mass,
        "Argument `mass` must be finite and non-negative, but it is not.",
    )
    findings.require(
        all_finite(displacement),
        RESULTS.invalid_position,
        "Argument `displacement` must be finite, but it is not.",
    )
    tensor, mass, displacement = (
        jnp.where(findings.ok, x, 0.0) for x in (tensor, mass, displacement)
    )
    return findings, (tensor, mass, displacement)


def _answer(findings: Findings, tensor: Matrix, throw: bool) -> Matrix:
    return findings.apply(tensor, True) if throw else nan_where(~findings.ok, tensor)


def parallel_axis(
    inertia_com: InertiaLike, mass: ScalarLike, displacement: VectorLike, *, throw: bool = True
) -> Matrix:
    r"""Inertia tensor about a point displaced from the centre of mass.

    $I = I_{com} + m (|d|^2 1 - d d^T)$.

    Args:
        inertia_com: Moments or tensor about the centre of mass [kg m^2].
        mass: Mass [kg], not negative.
        displacement: Between centre of mass and point, either way round [m].
        throw: False: a bad value makes the tensor of its lane NaN instead of an error.

    Returns:
        Tensor about the point, same axes [kg m^2].

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: The tensor is not finite or not symmetric, the mass is negative, or mass or
            displacement is not finite (run time, any lane).

    Gradients: polynomial, finite everywhere.
    Source: Goldstein, Classical Mechanics, 3rd ed., 5.3 (Steiner).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> d = jnp.array([0.0, 0.0, 2.0])
    >>> print(jnp.diag(jr.parallel_axis(jnp.array([1.0, 1.0, 0.0]), 3.0, d)))
    [13. 13.  0.]
    """
    findings, (tensor, mass, displacement) = _steiner_arguments(inertia_com, mass, displacement)
    return _answer(findings, tensor + mass * unit_steiner(displacement), throw)


def to_center_of_mass(
    inertia: InertiaLike, mass: ScalarLike, displacement: VectorLike, *, throw: bool = True
) -> Matrix:
    r"""Inertia tensor about the centre of mass, from that about a displaced point.

    The inverse of `parallel_axis`: $I_{com} = I - m (|d|^2 1 - d d^T)$.

    Args:
        inertia: Moments or tensor about the point [kg m^2].
        mass: Mass [kg], not negative.
        displacement: Between centre of mass and point, either way round [m].
        throw: False: a bad value makes the tensor of its lane NaN instead of an error.

    Returns:
        Tensor about the centre of mass, same axes [kg m^2].

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: The tensor is not finite or not symmetric, the mass is negative, mass or
            displacement is not finite, or the tensor is less than `mass` at `displacement` has,
            so that a moment comes out negative (run time, any lane).

    Gradients: polynomial, finite everywhere.
    Source: Goldstein, Classical Mechanics, 3rd ed., 5.3 (Steiner).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> d = jnp.array([0.0, 0.0, 2.0])
    >>> print(jnp.diag(jr.to_center_of_mass(jnp.array([13.0, 13.0, 0.0]), 3.0, d)))
    [1. 1. 0.]
    """
    findings, (tensor, mass, displacement) = _steiner_arguments(inertia, mass, displacement)
    reduced = tensor - mass * unit_steiner(displacement)
    whole, fixed = of_unit_size(*jax.lax.stop_gradient((tensor, reduced)))
    findings.require(
        is_semidefinite(fixed, jnp.trace(whole)),
        RESULTS.invalid_inertia,
        "Argument `inertia` must be at least that of `mass` at `displacement`, but a moment about "
        "the centre of mass comes out negative.",
    )
    return _answer(findings, reduced, throw)


def principal_axes(inertia: InertiaLike, *, throw: bool = True) -> PrincipalAxes:
    """Principal moments and axes of an inertia tensor.

    Moments ascend; axes are the columns of a right-handed rotation. In axes 1 and 3 the first
    component that has at least 0.9 of the largest magnitude is positive, so that the signs do not
    hang on the last bit where two components tie; axis 2 completes the rotation.

    Args:
        inertia: Moments or tensor [kg m^2]; any finite symmetric tensor will do.
        throw: False: bad values give NaN and a code in `.result` instead of an error.

    Returns:
        Moments and axes, tensor = axes diag(moments) axes^T to a few ulps of the largest.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: The tensor is not finite or not symmetric (run time, any lane).

    Gradients: d moments = diag(axes^T dI axes). First derivatives of symmetric functions of
    the moments (`sum(1 / moments)`) are right everywhere, repeated moments included. The moments
    one by one, and the axes, have no derivative where moments repeat: there d axes is finite and
    leaves out the axes of equal moments, so functions composed of moments and axes by hand, and
    second derivatives, cannot be right there. Use `tensor_function` for them.
    Source: Golub and Van Loan, Matrix Computations, 4th ed., 8.5 (Jacobi).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.principal_axes(jnp.array([3.0, 1.0, 2.0])).moments)
    [1. 2. 3.]
    """
    findings, tensor, _ = _tensor(inertia)
    tensor = findings.apply(tensor, throw)
    return PrincipalAxes(*eigh(jnp.where(findings.ok, tensor, jnp.nan)))


def tensor_function(f: Callable[[Any], Any], inertia: InertiaLike, *, throw: bool = True) -> Matrix:
    """Function of a tensor, axes diag(f(moments)) axes^T, with derivatives right everywhere.

    Args:
        f: Maps a scalar to a scalar, smooth on the range of the moments, by jax operations;
            forward-differentiable. It may close over parameters that are differentiated. Across
            gaps below a tenth of a moment its derivatives are integrated with eight nodes.
        inertia: Moments or tensor [kg m^2]; any finite symmetric tensor in the domain of f.
        throw: False: a bad tensor makes the answer of its lane NaN instead of an error;
            `principal_axes` gives the code.

    Returns:
        Symmetric tensor in the units of f.

    Raises:
        ValueError: Wrong shape, or f does not map scalars to scalars (trace time).
        RuntimeError: The tensor is not finite or not symmetric (run time, any lane).
        NotImplementedError: A third derivative in the tensor (trace time).

    Gradients: first and second, in every mode, in the tensor and in what f closes over, right at
    repeated and nearly repeated moments (divided differences), where moments and axes composed by
    hand give NaN or finite wrong numbers. So are those of its trace.
    Source: Higham, Functions of Matrices (2008), theorem 3.11 (Daleckii and Krein).

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> trace = lambda inertia: jnp.trace(jr.tensor_function(jnp.sqrt, inertia))
    >>> print(jax.grad(trace)(4 * jnp.eye(3)))
    [[0.25 0.   0.  ]
     [0.   0.25 0.  ]
     [0.   0.   0.25]]
    """
    findings, tensor, _ = _tensor(inertia)
    moment = jax.ShapeDtypeStruct((), tensor.dtype)
    shape = jax.eval_shape(f, moment)
    if getattr(shape, "shape", None) != () or shape.dtype != tensor.dtype:
        raise ValueError(f"Argument `f` must map {moment} to the same, but it gives {shape}.")
    hoisted, parameters = jax.closure_convert(f, jnp.zeros((), tensor.dtype))
    # NaN would reach the derivatives in the parameters; 1 is in the domain of most functions.
    good = jnp.where(findings.ok, tensor, jnp.eye(3, dtype=tensor.dtype))
    return _answer(findings, spectral_function(hoisted, good, *parameters), throw)
