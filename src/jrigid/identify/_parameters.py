"""Numbers without bounds for the inertia of a real body: physical by construction."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jrigid._checks import (
    INERTIA,
    RESULTS,
    Findings,
    all_finite,
    array_of_shape,
    check_option,
    check_type,
    is_positive_definite,
    is_symmetric,
    where_defined,
)
from jrigid._numerics import product
from jrigid._types import InertiaLike, Matrix, Readable, Real, Scalar, Vector
from jrigid.mass import MassProperties

LOG_CHOLESKY = ("alpha", "d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2", "t3")


def _second_moments(tensor: Matrix) -> Matrix:
    """Sigma = (trace I / 2) 1 - I, the integral of r r^T over the mass."""
    half = 0.5 * jnp.trace(tensor)
    return half * jnp.eye(3, dtype=tensor.dtype) - tensor


def _tensor(second_moments: Matrix) -> Matrix:
    """I = (trace Sigma) 1 - Sigma."""
    trace = jnp.trace(second_moments)
    return trace * jnp.eye(3, dtype=second_moments.dtype) - second_moments


def inertia_from_parameters(parameters: Real[ArrayLike, "6"]) -> Matrix:
    """Inertia tensor of a real body from six numbers without bounds.

    The tensor of second moments of the mass, Sigma = (trace I / 2) 1 - I, is L L^T, L lower
    triangular with a positive diagonal: then I is positive definite and its principal moments obey
    I3 < I1 + I2, whatever the numbers are. The first is the scale, log L11; the others are the
    shape, which is what free motion tells: log(L22 / L11), log(L33 / L11), L21 / L11, L31 / L11,
    L32 / L11. All zero is a sphere of moments 2.

    Args:
        parameters: The six numbers [-], the first the logarithm of a number in sqrt(kg) m.

    Returns:
        Inertia tensor [kg m^2]; NaN unless all six are finite.

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
    parameters = array_of_shape("parameters", parameters, 6)

    def tensor(p: Array) -> Matrix:
        zero, one = jnp.zeros_like(p[0]), jnp.ones_like(p[0])
        rows = [[one, zero, zero], [p[3], jnp.exp(p[1]), zero], [p[4], p[5], jnp.exp(p[2])]]
        lower = jnp.exp(p[0]) * jnp.stack([jnp.stack(row) for row in rows])
        return _tensor(product("ik,jk->ij", lower, lower))

    return where_defined(all_finite(parameters), tensor, parameters)


def parameters_from_inertia(inertia: InertiaLike) -> Float[Array, "6"]:
    """Six numbers without bounds for the inertia of a real body: see `inertia_from_parameters`.

    Args:
        inertia: Principal moments, or tensor [kg m^2], with I3 < I1 + I2.

    Returns:
        The numbers; NaN for a tensor that is not symmetric, or of no body with extent in three
        directions.

    Gradients: right for symmetric changes of the tensor; they grow as the body gets flat.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> numbers = jr.identify.parameters_from_inertia(jnp.array([1.0, 2.0, 2.5]))
    >>> print(jr.identify.inertia_from_parameters(numbers).round(6))
    [[1.  0.  0. ]
     [0.  2.  0. ]
     [0.  0.  2.5]]
    """
    inertia = array_of_shape("inertia", inertia, *INERTIA)
    tensor = jnp.diag(inertia) if inertia.ndim == 1 else inertia
    second = _second_moments(0.5 * (tensor + tensor.T))
    solid = all_finite(tensor) & is_symmetric(tensor) & is_positive_definite(second)

    def numbers(second: Matrix) -> Array:
        lower = jnp.linalg.cholesky(second)
        scale = lower[0, 0]
        sizes = jnp.stack([scale, lower[1, 1] / scale, lower[2, 2] / scale])
        below = jnp.stack([lower[1, 0], lower[2, 0], lower[2, 1]])
        return jnp.concatenate([jnp.log(sizes), below / scale])

    return where_defined(solid, numbers, second)


def body_from_log_cholesky(parameters: Real[ArrayLike, "10"]) -> MassProperties:
    """Mass properties of a real body from the ten numbers of its log-Cholesky parametrisation.

    The pseudo-inertia [[Sigma, m c], [m c^T, m]], Sigma the second moments of the mass about the
    origin of the coordinates, is U U^T with U = exp(alpha) [[exp(d1), s12, s13, t1], [0, exp(d2),
    s23, t2], [0, 0, exp(d3), t3], [0, 0, 0, 1]]. The numbers are (alpha, d1, d2, d3, s12, s23, s13,
    t1, t2, t3), in the order of the source (and of Pinocchio and MuJoCo); t is the centre of mass.

    Args:
        parameters: The ten numbers.

    Returns:
        The body; NaN unless all ten are finite.

    Gradients: analytic.
    Source: C. Rucker, P. M. Wensing, "Smooth parameterization of rigid-body inertia", IEEE Robotics
    and Automation Letters 7 (2022) 2771.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.identify.body_from_log_cholesky(jnp.zeros(10))
    >>> print(body.mass, body.inertia[0])
    1.0 [2. 0. 0.]
    """
    parameters = array_of_shape("parameters", parameters, 10)

    def body(p: Array) -> tuple[Scalar, Vector, Matrix]:
        alpha, d1, d2, d3, s12, s23, s13, *t = p
        zero = jnp.zeros_like(alpha)
        rows = [[jnp.exp(d1), s12, s13], [zero, jnp.exp(d2), s23], [zero, zero, jnp.exp(d3)]]
        upper = jnp.stack([jnp.stack(row) for row in rows])
        mass = jnp.exp(2 * alpha)
        # About the centre of mass the column t drops out.
        return mass, jnp.stack(t), mass * _tensor(product("ik,jk->ij", upper, upper))

    return MassProperties.unchecked(*where_defined(all_finite(parameters), body, parameters))


def log_cholesky_from_body(body: MassProperties) -> Float[Array, "10"]:
    """The ten numbers of a body's log-Cholesky parametrisation: see `body_from_log_cholesky`.

    Args:
        body: A body with extent in three directions.

    Returns:
        (alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3); NaN for a flat body.

    Gradients: right for symmetric changes of the tensor; they grow as the body gets flat.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> numbers = jr.identify.log_cholesky_from_body(jr.solids.box(8.0, jnp.array([1.0, 2.0, 3.0])))
    >>> print(numbers[:4].round(4))
    [ 1.0397 -1.2425 -0.5493 -0.1438]
    """
    check_type("body", body, MassProperties)
    second = _second_moments(body.inertia)
    solid = (body.mass > 0) & all_finite(body) & is_positive_definite(second)

    def numbers(mass: Scalar, center_of_mass: Vector, second: Matrix) -> Array:
        second = second / mass
        # The upper factor is the lower one with rows and columns reversed.
        upper = jnp.linalg.cholesky(second[::-1, ::-1])[::-1, ::-1]
        sides = jnp.stack([upper[0, 1], upper[1, 2], upper[0, 2]])
        return jnp.concatenate(
            [0.5 * jnp.log(mass)[None], jnp.log(jnp.diagonal(upper)), sides, center_of_mass]
        )

    return where_defined(solid, numbers, body.mass, body.center_of_mass, second)


class LogCholesky(Readable):
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
        RuntimeError: A flat body.

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
        parameters = log_cholesky_from_body(body)
        findings = Findings()
        findings.require(
            all_finite(parameters),
            RESULTS.unphysical_inertia,
            "Argument `body` must have extent in three directions, I3 < I1 + I2, but it has not.",
            body.inertia,
        )
        self.parameters = findings.guard(parameters, throw=True)

    @property
    def sought(self) -> tuple[str, ...]:
        """Names of the numbers that are not frozen."""
        return tuple(name for name in LOG_CHOLESKY if name not in self.frozen)

    @property
    def units(self) -> Array:
        """Sizes of the numbers sought: 1, or for those in metres that of the body."""
        body = body_from_log_cholesky(self.parameters)
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
        return body_from_log_cholesky(whole)

    def _indices(self) -> Any:
        return np.array([LOG_CHOLESKY.index(name) for name in self.sought])
