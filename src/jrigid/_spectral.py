"""Symmetric 3x3 tensors: moments, axes and functions, and their derivatives."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._numerics import gauss_legendre, power_of_two, product

# Six sweeps: convergence is quadratic, and four reach the rounding of float64.
_ROTATIONS = 18
# Differences over gaps below this fraction of the moment are integrated, others are
# divided.
_CLOSE = 0.1
# Nodes of the quadrature: the error of 1/x across such a gap is below 1e-24.
_NODES = 8


def _rotate(_: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
    """One Jacobi rotation in the plane (1, 2); then axes 2, 3, 1 are called 1, 2, 3.

    Source: Golub and Van Loan, Matrix Computations, 4th ed., 8.5.2; Numerical Recipes
    11.1.
    """
    a11, a22, a33, a12, a13, a23, x1, x2, x3, y1, y2, y3, z1, z2, z3 = state
    gap = a22 - a11
    # Of the two tangents the smaller one is taken. It turns by at most 45 degrees, so
    # that the sweeps converge.
    below = jnp.abs(gap) + jnp.sqrt(gap * gap + 4 * a12 * a12)
    above = jnp.where(gap < 0, -2 * a12, 2 * a12)
    t = jnp.where(below > 0, above / jnp.where(below > 0, below, 1.0), 0.0)
    cosine = 1 / jnp.sqrt(1 + t * t)
    sine = t * cosine
    tau = sine / (1 + cosine)
    a11, a22 = a11 - t * a12, a22 + t * a12

    def turn(p: Array, q: Array) -> tuple[Array, Array]:
        # This form of Numerical Recipes adds a small change, which rounds less than a
        # product with the cosine.
        return p - sine * (q + tau * p), q + sine * (p - tau * q)

    (a13, a23), (x1, x2), (y1, y2), (z1, z2) = (
        turn(p, q) for p, q in ((a13, a23), (x1, x2), (y1, y2), (z1, z2))
    )
    # The rotation makes this entry zero. Its rounding is not carried on.
    zero = jnp.zeros_like(a12)
    return a22, a33, a11, a23, zero, a13, x2, x3, x1, y2, y3, y1, z2, z3, z1


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def eigh(
    tensor: Float[Array, "3 3"], distinct: bool = False
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Moments, ascending, and axes, the columns of a rotation, of a symmetric tensor.

    The method of Jacobi gives small moments a high relative accuracy, and needs no
    LAPACK on a GPU. In axes 1 and 3 the first component of at least 0.9 of the largest
    magnitude is positive; axis 2 completes the rotation.

    Gradients: d moments = diag(axes^T dI axes), which is right for symmetric functions
    of the moments also where they repeat. In d axes 1 / gap is replaced by 0 where the
    gap is below rounding. With `distinct` it is replaced by NaN where the gap is below
    1e-6 of the largest moment.
    """
    del distinct  # the derivatives need it
    # The rotations square the entries, which must stay in the range of the dtype.
    unit = power_of_two(jnp.max(jnp.abs(tensor)))
    scaled = tensor / unit
    columns = _ascending(_diagonalized(0.5 * (scaled + scaled.T)))
    moments = unit * jnp.stack([column[0] for column in columns])
    return moments, _signed_axes(*(jnp.stack(column[1:]) for column in columns))


def _diagonalized(tensor: Array) -> list[list[Array]]:
    """Cyclic Jacobi: a list (moment, x, y, z) of each axis."""
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    entries = [tensor[i, j] for i, j in pairs]
    identity = [jnp.asarray(x, tensor.dtype) for x in np.eye(3).ravel()]
    state = jax.lax.fori_loop(0, _ROTATIONS, _rotate, (*entries, *identity))
    return [[state[j], *state[6 + j :: 3]] for j in range(3)]


def _ascending(columns: list[list[Array]]) -> list[list[Array]]:
    """The axes in the order of their moments, by three exchanges."""
    columns = list(columns)
    for low, high in ((0, 1), (1, 2), (0, 1)):
        swap = columns[low][0] > columns[high][0]
        pairs = list(zip(columns[low], columns[high], strict=True))
        columns[low] = [jnp.where(swap, y, x) for x, y in pairs]
        columns[high] = [jnp.where(swap, x, y) for x, y in pairs]
    return columns


def _signed_axes(first: Array, second: Array, third: Array) -> Array:
    """A right-handed rotation of columns with deterministic signs."""
    first = first * _sign(first)
    third = third * _sign(third)
    handed = jnp.sum(second * jnp.cross(third, first))
    second = second * jnp.where(handed < 0, -1.0, 1.0)
    return jnp.stack([first, second, third], axis=1)


def _sign(axis: Float[Array, "3"]) -> Float[Array, ""]:
    """Sign of the first component that has at least 0.9 of the largest magnitude."""
    x, y, z = axis
    # With 1 in place of 0.9 the last bit would decide between two components that tie.
    enough = 0.9 * jnp.max(jnp.abs(axis))
    y_or_z = jnp.where(jnp.abs(y) >= enough, y, z)
    leading = jnp.where(jnp.abs(x) >= enough, x, y_or_z)
    return jnp.where(leading < 0, -1.0, 1.0)


@eigh.defjvp
def _eigh_jvp(distinct: bool, primals: tuple, tangents: tuple) -> tuple:
    (tensor,) = primals
    (change,) = tangents
    moments, axes = eigh(tensor)
    inside = product("ki,kl,lj->ij", axes, 0.5 * (change + change.T), axes)
    # First-order perturbation: d axes = axes C with C_ij = inside_ij / (m_j - m_i).
    gap = moments[None, :] - moments[:, None]
    least_gap = 1e-6 if distinct else 4 * jnp.finfo(gap.dtype).eps
    resolved = jnp.abs(gap) > least_gap * jnp.max(jnp.abs(moments))
    substitute = jnp.nan if distinct else 0.0
    # A unit vector does not change along itself.
    unresolved = jnp.where(np.eye(3, dtype=bool), 0.0, substitute)
    inverse = jnp.where(resolved, 1 / jnp.where(resolved, gap, 1.0), unresolved)
    return (moments, axes), (
        jnp.diagonal(inside),
        product("ik,kj->ij", axes, inverse * inside),
    )


def from_principal_axes(
    axes: Array, quaternion: Array, vector: Array
) -> tuple[Array, Array]:
    """Transform a quaternion and a vector from principal axes to body axes."""
    turned = product("ij,j->i", axes, quaternion[1:])
    return jnp.concatenate([quaternion[:1], turned]), product("ij,j->i", axes, vector)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def spectral_function(
    f: Callable[..., Array], tensor: Float[Array, "3 3"], *parameters: Array
) -> Float[Array, "3 3"]:
    """Tensor axes diag(f(moments, *parameters)) axes^T of a symmetric tensor.

    Gradients: first and second, in every mode and in `parameters`, at any moments at
    which f is smooth. A third derivative in the tensor raises NotImplementedError.
    """
    moments, axes = eigh(tensor)
    values = jax.vmap(lambda moment: f(moment, *parameters))(moments)
    return product("ik,k,jk->ij", axes, values, axes)


@spectral_function.defjvp
def _spectral_function_jvp(
    f: Callable[..., Array], primals: tuple, tangents: tuple
) -> tuple:
    # The rule is plain algebra, which every mode can differentiate again.
    _, tangent = jax.jvp(functools.partial(_expansion, f), primals, tangents)
    return spectral_function(f, *primals), tangent


def _expansion(f: Callable[..., Array], tensor: Array, *parameters: Array) -> Array:
    """Taylor series to second order of f(tensor) about the value of `tensor` itself.

    Let E = axes^T (tensor - its value) axes, which is zero but not constant. The series
    is axes M axes^T, M_ij = f[i] delta_ij + f[i, j] E_ij + sum_k f[i, k, j] E_ik E_kj.
    Source: Higham, Functions of Matrices (2008), theorem 3.11 (Daleckii-Krein) and 3.4.
    """
    fixed = jax.lax.stop_gradient(tensor)
    moments, axes = jax.lax.stop_gradient(eigh(fixed))
    change = tensor - fixed
    inside = product("ki,kl,lj->ij", axes, 0.5 * (change + change.T), axes)

    def g(moment: Array) -> Array:
        return f(moment, *parameters)

    def differences(count: int) -> Array:
        """Divided differences of all sets of `count` moments, each computed once."""
        # A divided difference does not depend on the order of its moments.
        # `_difference` needs them ascending.
        wanted = np.sort(np.moveaxis(np.indices((3,) * count), 0, -1), axis=-1)
        sets, which = np.unique(wanted.reshape(-1, count), axis=0, return_inverse=True)
        values = jax.vmap(functools.partial(_difference, g))(
            *(moments[k] for k in sets.T)
        )
        return values[which.reshape(wanted.shape[:-1])]

    matrix = (
        jnp.diag(differences(1))
        + differences(2) * inside
        + product("ikj,ik,kj->ij", differences(3), inside, inside)
        + _zero_with_derivatives(2, inside)
    )
    return product("ik,kl,jl->ij", axes, matrix, axes)


def _derivative(f: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """The derivative of a function of a scalar."""
    return lambda x: jax.jvp(f, (x,), (jnp.ones_like(x),))[1]


def _difference(f: Callable[[Array], Array], *moments: Array) -> Array:
    """Divided difference f[a, b, ...] of ascending moments, also of close ones."""
    if len(moments) == 1:
        return f(moments[0])
    first, *_, last = moments
    gap = last - first
    near = jnp.abs(gap) <= _CLOSE * jnp.maximum(jnp.abs(first), jnp.abs(last))
    # Distant moments are replaced by the first one, so that the branch that is not
    # taken stays finite.
    integral = _hermite_genocchi(f, *(jnp.where(near, x, first) for x in moments))
    # f[a, ..., z] = (f[b, ..., z] - f[a, ..., y]) / (z - a) of moments a to z.
    quotient = _difference(f, *moments[1:]) - _difference(f, *moments[:-1])
    return jnp.where(near, integral, quotient / jnp.where(near, 1.0, gap))


def _hermite_genocchi(
    f: Callable[[Array], Array], first: Array, *others: Array
) -> Array:
    """f[a, b, ...], the integral of s^n f'[a + s (b - a), ...] over s from 0 to 1.

    The difference is that of n + 2 moments.
    """
    if not others:
        return f(first)

    def integrand(s: Array) -> Array:
        return _hermite_genocchi(
            _derivative(f), *(first + s * (x - first) for x in others)
        )

    nodes, weights = gauss_legendre(_NODES, first.dtype)
    return jnp.sum(weights * nodes ** (len(others) - 1) * jax.vmap(integrand)(nodes))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _zero_with_derivatives(_orders: int, x: Array) -> Array:
    """A zero that counts derivatives: the series has no third one, which is not 0."""
    return jnp.zeros((), x.dtype)


@_zero_with_derivatives.defjvp
def _zero_with_derivatives_jvp(orders: int, primals: tuple, tangents: tuple) -> tuple:
    if orders == 0:
        raise NotImplementedError(
            "Third derivatives of `jrigid.tensor_function` in its tensor are not "
            "available."
        )
    change = _zero_with_derivatives(orders - 1, *primals) * jnp.sum(tangents[0])
    return _zero_with_derivatives(orders, *primals), change
