"""Numbers without bounds for the inertia of a real body: physical by construction."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Real

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    array_of_shape,
    check_inertia_shape,
    check_option,
    float_arrays,
    is_positive_definite,
    is_symmetric,
    nan_where,
)
from jrigid._numerics import product
from jrigid._types import InertiaLike, Matrix, Scalar
from jrigid.mass import MassProperties

_NOT_SOLID = (
    "Argument `inertia` must be the symmetric tensor of a body with extent in three directions, "
    "I3 < I1 + I2, but it is not."
)
_NOT_FINITE = "Argument `parameters` must be finite, but it is not."


LOG_CHOLESKY = ("alpha", "d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2", "t3")


def _second_moments(tensor: Matrix) -> Matrix:
    """Sigma = (trace I / 2) 1 - I, the integral of r r^T over the mass."""
    half = 0.5 * jnp.trace(tensor)
    return half * jnp.eye(3, dtype=tensor.dtype) - tensor


def _tensor(second_moments: Matrix) -> Matrix:
    """I = (trace Sigma) 1 - Sigma."""
    trace = jnp.trace(second_moments)
    return trace * jnp.eye(3, dtype=second_moments.dtype) - second_moments


def _checked(parameters: Any, count: int, throw: bool) -> tuple[Findings, Array]:
    parameters = array_of_shape("parameters", parameters, count)
    findings = Findings()
    findings.require(all_finite(parameters), RESULTS.invalid_inertia, _NOT_FINITE)
    parameters = findings.apply(parameters, throw)
    return findings, jnp.where(findings.ok, parameters, 0.0)


def inertia_from_parameters(parameters: Real[ArrayLike, "6"], *, throw: bool = True) -> Matrix:
    """Inertia tensor of a real body from six numbers without bounds.

    The tensor of second moments of the mass, Sigma = (trace I / 2) 1 - I, is L L^T, L lower
    triangular with a positive diagonal: then I is positive definite and its principal moments obey
    I3 < I1 + I2, whatever the numbers are. The first is the scale, log L11; the others are the
    shape, which is what free motion tells: log(L22 / L11), log(L33 / L11), L21 / L11, L31 / L11,
    L32 / L11. All zero is a sphere of moments 2.

    Args:
        parameters: The six numbers [-], the first the logarithm of a number in sqrt(kg) m.
        throw: False: bad values give NaN instead of an error.

    Returns:
        Inertia tensor [kg m^2].

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: A number that is not finite (run time, any lane).

    Gradients: analytic; every tensor of a body with extent in three directions is reached by one
    set of numbers, so that nothing singular is in the way.
    Source: P. M. Wensing, S. Kim, J.-J. Slotine, IEEE Robotics and Automation Letters 3 (2018) 60,
    for the second moments; docs in `parameters_from_inertia`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.identify.inertia_from_parameters(jnp.zeros(6)))
    [[2. 0. 0.]
     [0. 2. 0.]
     [0. 0. 2.]]
    """
    findings, p = _checked(parameters, 6, throw)
    zero, one = jnp.zeros_like(p[0]), jnp.ones_like(p[0])
    rows = [[one, zero, zero], [p[3], jnp.exp(p[1]), zero], [p[4], p[5], jnp.exp(p[2])]]
    lower = jnp.exp(p[0]) * jnp.stack([jnp.stack(row) for row in rows])
    return nan_where(~findings.ok, _tensor(product("ik,jk->ij", lower, lower)))


def parameters_from_inertia(inertia: InertiaLike, *, throw: bool = True) -> Float[Array, "6"]:
    """Six numbers without bounds for the inertia of a real body: see `inertia_from_parameters`.

    Args:
        inertia: Principal moments, or tensor [kg m^2], with I3 < I1 + I2.
        throw: False: bad values give NaN instead of an error.

    Returns:
        The numbers.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: A tensor that is no body's, or that of a flat one (run time, any lane).

    Gradients: right for symmetric changes of the tensor; they grow as the body gets flat.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> numbers = jr.identify.parameters_from_inertia(jnp.array([1.0, 2.0, 2.5]))
    >>> print(jr.identify.inertia_from_parameters(numbers).round(6))
    [[1.  0.  0. ]
     [0.  2.  0. ]
     [0.  0.  2.5]]
    """
    (inertia,) = float_arrays(inertia)
    check_inertia_shape(inertia)
    tensor = jnp.diag(inertia) if inertia.ndim == 1 else inertia
    second = _second_moments(0.5 * (tensor + tensor.T))
    findings = Findings()
    known = jax.lax.stop_gradient((tensor, second))
    solid = all_finite(known[0]) & is_symmetric(known[0]) & is_positive_definite(known[1])
    findings.require(solid, RESULTS.unphysical_inertia, _NOT_SOLID)
    second = findings.apply(second, throw)
    second = jnp.where(findings.ok, second, jnp.eye(3, dtype=second.dtype))
    lower = jnp.linalg.cholesky(second)
    scale = lower[0, 0]
    numbers = jnp.stack(
        [
            jnp.log(scale),
            jnp.log(lower[1, 1] / scale),
            jnp.log(lower[2, 2] / scale),
            lower[1, 0] / scale,
            lower[2, 0] / scale,
            lower[2, 1] / scale,
        ]
    )
    return nan_where(~findings.ok, numbers)


def body_from_log_cholesky(
    parameters: Real[ArrayLike, "10"], *, throw: bool = True
) -> MassProperties:
    """Mass properties of a real body from the ten numbers of its log-Cholesky parametrisation.

    The pseudo-inertia [[Sigma, m c], [m c^T, m]], Sigma the second moments of the mass about the
    origin of the coordinates, is U U^T with U = exp(alpha) [[exp(d1), s12, s13, t1], [0, exp(d2),
    s23, t2], [0, 0, exp(d3), t3], [0, 0, 0, 1]]. The numbers are (alpha, d1, d2, d3, s12, s23, s13,
    t1, t2, t3), in the order of the source (and of Pinocchio and MuJoCo); t is the centre of mass.

    Args:
        parameters: The ten numbers.
        throw: False: bad values give NaN instead of an error.

    Returns:
        The body.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: A number that is not finite (run time, any lane).

    Gradients: analytic.
    Source: C. Rucker, P. M. Wensing, "Smooth parameterization of rigid-body inertia", IEEE Robotics
    and Automation Letters 7 (2022) 2771.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.identify.body_from_log_cholesky(jnp.zeros(10))
    >>> print(body.mass, body.inertia[0])
    1.0 [2. 0. 0.]
    """
    findings, p = _checked(parameters, 10, throw)
    alpha, d1, d2, d3, s12, s23, s13, *t = p
    zero = jnp.zeros_like(alpha)
    rows = [[jnp.exp(d1), s12, s13], [zero, jnp.exp(d2), s23], [zero, zero, jnp.exp(d3)]]
    upper = jnp.stack([jnp.stack(row) for row in rows])
    mass = jnp.exp(2 * alpha)
    # About the centre of mass the column t drops out.
    inertia = mass * _tensor(product("ik,jk->ij", upper, upper))
    body = nan_where(~findings.ok, (mass, jnp.stack(t), inertia))
    return MassProperties.unchecked(*body)


def log_cholesky_from_body(body: MassProperties, *, throw: bool = True) -> Float[Array, "10"]:
    """The ten numbers of a body's log-Cholesky parametrisation: see `body_from_log_cholesky`.

    Args:
        body: A body with extent in three directions.
        throw: False: bad values give NaN instead of an error.

    Returns:
        (alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3).

    Raises:
        ValueError: Not mass properties (trace time).
        RuntimeError: A flat body (run time, any lane).

    Gradients: right for symmetric changes of the tensor; they grow as the body gets flat.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> numbers = jr.identify.log_cholesky_from_body(jr.solids.box(8.0, jnp.array([1.0, 2.0, 3.0])))
    >>> print(numbers[:4].round(4))
    [ 1.0397 -1.2425 -0.5493 -0.1438]
    """
    if not isinstance(body, MassProperties):
        raise ValueError(
            f"Argument `body` must be MassProperties, but it is {type(body).__name__}."
        )
    second = _second_moments(body.inertia) / body.mass
    findings = Findings()
    known = jax.lax.stop_gradient((body.mass, body.center_of_mass, second))
    solid = (known[0] > 0) & all_finite(known) & is_positive_definite(known[2])
    findings.require(solid, RESULTS.unphysical_inertia, _NOT_SOLID.replace("inertia", "body"))
    ok = findings.ok
    second = jnp.where(ok, second, jnp.eye(3, dtype=second.dtype))
    mass: Scalar = jnp.where(ok, body.mass, 1.0)
    # The upper factor is the lower one with rows and columns reversed.
    upper = jnp.linalg.cholesky(second[::-1, ::-1])[::-1, ::-1]
    numbers = jnp.concatenate(
        [
            0.5 * jnp.log(mass)[None],
            jnp.log(jnp.diagonal(upper)),
            jnp.stack([upper[0, 1], upper[1, 2], upper[0, 2]]),
            body.center_of_mass,
        ]
    )
    return findings.apply(nan_where(~ok, numbers), throw)


class LogCholesky(eqx.Module):
    """A body about a fixed point, sought by `fit` in its ten log-Cholesky numbers.

    The origin of the body's coordinates is the fixed point; the inertia about it, and the mass and
    the lever of any `torques.UniformGravity` of the system, all follow from the ten numbers. Motion
    under gravity tells the inertia about the point over the mass times the lever, eight numbers:
    freeze two at least, such as "alpha", half the logarithm of the mass, and a length. A rotor or
    a torque of known size tells one more.

    Attributes:
        parameters: (alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3) to start from.
        frozen: Names of those that are known.

    Raises:
        ValueError: Not mass properties, or a name that is none of the ten (trace time).
        RuntimeError: A flat body (run time, any lane).

    Gradients: as `body_from_log_cholesky`.
    Source: as `body_from_log_cholesky`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> arm = jr.solids.box(8.0, jnp.array([1.0, 2.0, 3.0])).translated(jnp.array([0.0, 0.0, 1.5]))
    >>> print(jr.identify.LogCholesky(arm, frozen=("alpha", "t1", "t2")).sought)
    ('d1', 'd2', 'd3', 's12', 's23', 's13', 't3')
    """

    parameters: Float[Array, "10"]
    frozen: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, body: MassProperties, frozen: Sequence[str] = ()):
        self.frozen = (frozen,) if isinstance(frozen, str) else tuple(frozen)
        for name in self.frozen:
            check_option("frozen", name, LOG_CHOLESKY)
        if not self.sought:
            raise ValueError("Argument `frozen` must leave a number to seek, but it does not.")
        self.parameters = log_cholesky_from_body(body)

    @property
    def sought(self) -> tuple[str, ...]:
        """Names of the numbers that are not frozen."""
        return tuple(name for name in LOG_CHOLESKY if name not in self.frozen)

    @property
    def units(self) -> Array:
        """Sizes of the numbers sought: 1, or for those in metres that of the body."""
        body = body_from_log_cholesky(self.parameters, throw=False)
        square = 0.5 * jnp.trace(body.inertia) / body.mass + jnp.sum(body.center_of_mass**2)
        lengths = {"s12", "s23", "s13", "t1", "t2", "t3"}
        one = jnp.ones_like(square)
        return jnp.stack([jnp.sqrt(square) if name in lengths else one for name in self.sought])

    @property
    def start(self) -> Array:
        """The numbers sought, as they were given."""
        return self.parameters[self._indices()]

    def body(self, numbers: Array) -> MassProperties:
        """The body, of other numbers for those that are sought."""
        whole = self.parameters.astype(numbers.dtype).at[self._indices()].set(numbers)
        return body_from_log_cholesky(whole, throw=False)

    def _indices(self) -> Any:
        return np.array([LOG_CHOLESKY.index(name) for name in self.sought])
