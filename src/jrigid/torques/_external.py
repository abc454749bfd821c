"""Torques from outside: gravity, the gradient of gravity, drag."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    array_of_shape,
    check_inertia_shape,
    check_shape,
    float_arrays,
    is_inertia,
    is_symmetric,
)
from jrigid._numerics import safe_norm
from jrigid._types import InertiaLike, Scalar, ScalarLike, Vector
from jrigid.dynamics import angular_momentum
from jrigid.rotation import rotate, rotate_inverse
from jrigid.torques._base import AbstractTorque, require_finite


class UniformGravity(AbstractTorque):
    """Torque of uniform gravity on a body with a fixed point: lever x (m g).

    Attributes:
        mass: Mass [kg].
        lever: From the pivot to the centre of mass, body components [m].
        gravity: Acceleration of gravity, space components [m/s^2].

    Raises:
        ValueError: Wrong shape (trace time). Values (finite, mass not negative) are checked by
            `simulate`.

    Gradients: analytic in the attitude, linear in each parameter.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> lever, g = jnp.array([0.0, 0.0, 0.1]), jnp.array([0.0, 0.0, -9.8])
    >>> gravity = jr.torques.UniformGravity(2.0, lever, g)
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    >>> print(gravity.potential(0.0, state, None).round(6))
    1.96
    """

    mass: Float[Array, ""] = eqx.field(converter=lambda x: array_of_shape("mass", x))
    lever: Float[Array, "3"] = eqx.field(converter=lambda x: array_of_shape("lever", x, 3))
    gravity: Float[Array, "3"] = eqx.field(converter=lambda x: array_of_shape("gravity", x, 3))

    def __call__(self, t: ScalarLike, state: Any, args: Any) -> Vector:
        """Torque on the body [N m], body components."""
        del t, args
        dtype = state.omega.dtype
        weight = self.mass.astype(dtype) * self.gravity.astype(dtype)
        return jnp.cross(self.lever.astype(dtype), rotate_inverse(state.attitude, weight))

    def potential(self, t: ScalarLike, state: Any, args: Any) -> Scalar:
        """Potential energy [J], zero with the centre of mass level with the pivot."""
        del t, args
        dtype = state.omega.dtype
        arm = rotate(state.attitude, self.lever.astype(dtype))
        return -self.mass.astype(dtype) * jnp.sum(self.gravity.astype(dtype) * arm)

    def check(self, findings: Findings) -> None:
        """Note a negative mass and what is not finite."""
        mass = jax.lax.stop_gradient(self.mass)
        findings.require(
            jnp.isfinite(mass) & (mass >= 0),
            RESULTS.invalid_mass,
            "Argument `mass` of `UniformGravity` must be finite and not negative, but it is not.",
        )
        require_finite(findings, self, "lever", "gravity")


class GravityGradient(AbstractTorque):
    """Gravity-gradient torque of a distant attractor: 3 mu / r^3 (n x I n).

    First order in body size over distance; n is the direction of the attractor in the body.

    Attributes:
        inertia: Principal moments or tensor about the centre of mass [kg m^2].
        mu: Gravitational parameter of the attractor [m^3/s^2].
        position: `position(t)`, from the attractor to the body, space components [m]; None for
            the body's own position, that of a `FloatingState` with the attractor at the origin.

    Raises:
        ValueError: Wrong shape (trace time). Values (a valid inertia, a finite mu) are checked by
            `simulate`.

    Gradients: finite except where the attractor is at the body (r = 0), where all is NaN.
    Source: Hughes, Spacecraft Attitude Dynamics (1986), section 8.1.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> orbit = lambda t: 7e6 * jnp.stack([jnp.cos(1e-3 * t), jnp.sin(1e-3 * t), 0 * t])
    >>> torque = jr.torques.GravityGradient(jnp.array([10.0, 20.0, 25.0]), 3.986e14, orbit)
    >>> turned = jr.rotation.exp(jnp.array([0.0, 0.0, jnp.pi / 4]))
    >>> print((1e5 * torque(0.0, jr.State(turned, jnp.zeros(3)), None)).round(3))
    [ 0.     0.    -1.743]
    """

    inertia: Float[Array, "..."]
    mu: Float[Array, ""]
    position: Callable[[Any], Any] | None

    def __init__(
        self,
        inertia: InertiaLike,
        mu: ScalarLike,
        position: Callable[[Any], Any] | None = None,
    ):
        """Attractor seen from the body.

        Args:
            inertia: Principal moments or tensor about the centre of mass [kg m^2].
            mu: Gravitational parameter [m^3/s^2].
            position: `position(t) -> (3,)`, attractor to body, space components [m]; None for the
                body's own.

        Raises:
            ValueError: Wrong shape (trace time). Values are checked by `simulate`.
        """
        self.inertia, self.mu = float_arrays(inertia, mu)
        check_inertia_shape(self.inertia)
        check_shape("mu", self.mu, ())
        self.position = position

    def _direction(self, t: ScalarLike, state: Any) -> tuple[Array, Array]:
        dtype = state.omega.dtype
        where = state.position if self.position is None else self.position(t)
        position = jnp.asarray(where, dtype)
        check_shape("position", position, (3,))
        distance = safe_norm(position)
        # mu / r^3 without overflow in float32
        strength = self.mu.astype(dtype) / distance / distance / distance
        return rotate_inverse(state.attitude, position / distance), strength

    def __call__(self, t: ScalarLike, state: Any, args: Any) -> Vector:
        """Torque on the body [N m], body components."""
        del args
        n, strength = self._direction(t, state)
        moment = angular_momentum(self.inertia.astype(n.dtype), n)
        return 3 * strength * jnp.cross(n, moment)

    def potential(self, t: ScalarLike, state: Any, args: Any) -> Scalar:
        """Attitude-dependent potential energy [J]: -mu / (2 r^3) (tr I - 3 n . I n)."""
        del args
        n, strength = self._direction(t, state)
        inertia = self.inertia.astype(n.dtype)
        trace = jnp.sum(inertia) if inertia.ndim == 1 else jnp.trace(inertia)
        return -0.5 * strength * (trace - 3 * jnp.sum(n * angular_momentum(inertia, n)))

    def check(self, findings: Findings) -> None:
        """Note an inertia that is none and a mu that is not finite."""
        findings.require(
            is_inertia(self.inertia),
            RESULTS.invalid_inertia,
            "Argument `inertia` of `GravityGradient` must hold three positive, finite principal "
            "moments or be a finite, symmetric, positive definite (3, 3) tensor, but it is not.",
        )
        require_finite(findings, self, "mu")


def _apply_coefficient(coefficient: Array, omega: Array) -> Array:
    coefficient = coefficient.astype(omega.dtype)
    if coefficient.ndim == 0:
        return coefficient * omega
    return angular_momentum(coefficient, omega)


def _coefficient(value: Any) -> Array:
    (array,) = float_arrays(value)
    if array.shape not in ((), (3,), (3, 3)):
        raise ValueError(
            "Argument `coefficient` must have shape (), (3,) or (3, 3), "
            f"but it has shape {array.shape}."
        )
    return array


def _is_dissipative(coefficient: Array) -> Bool[Array, ""]:
    """True where a drag takes energy or nothing: no negative number, axis or eigenvalue."""
    c = jax.lax.stop_gradient(coefficient)
    if c.ndim < 2:
        return all_finite(c) & jnp.all(c >= 0)
    largest = jnp.max(jnp.abs(c))
    (a, d, e), (_, b, f), (_, _, g) = m = c / jnp.where(largest > 0, largest, 1.0)
    # Positive semi-definite: no principal minor is negative, to rounding.
    determinant = a * (b * g - f * f) - d * (d * g - f * e) + e * (d * f - b * e)
    minors = jnp.stack([a, b, g, a * b - d * d, a * g - e * e, b * g - f * f, determinant])
    floor = -64 * jnp.finfo(c.dtype).eps
    return all_finite(c) & is_symmetric(m) & jnp.all(minors >= floor)


def _check_coefficient(findings: Findings, drag: Any) -> None:
    findings.require(
        _is_dissipative(drag.coefficient),
        RESULTS.invalid_torque,
        f"Argument `coefficient` of `{type(drag).__name__}` must be finite and not negative (a "
        "tensor symmetric and positive semi-definite), but it is not.",
    )


class LinearDrag(AbstractTorque):
    """Drag proportional to the angular velocity: -c omega.

    Attributes:
        coefficient: c [N m s]: a number, one for each body axis, or a tensor.

    Raises:
        ValueError: Wrong shape (trace time). Values (finite, not negative; a tensor symmetric and
            positive semi-definite) are checked by `simulate`.

    Gradients: linear in the coefficient and in omega.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> drag = jr.torques.LinearDrag(0.1)
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([3.0, 0.0, 4.0]))
    >>> print(drag(0.0, state, None).round(6))
    [-0.3 -0.  -0.4]
    """

    coefficient: Float[Array, "..."] = eqx.field(converter=_coefficient)

    def __call__(self, t: ScalarLike, state: Any, args: Any) -> Vector:
        """Torque on the body [N m], body components."""
        del t, args
        return -_apply_coefficient(self.coefficient, state.omega)

    def check(self, findings: Findings) -> None:
        """Note a coefficient that is negative or not finite."""
        _check_coefficient(findings, self)


class QuadraticDrag(AbstractTorque):
    """Drag quadratic in the angular velocity: -|omega| c omega; at rest zero, its gradient too.

    Attributes:
        coefficient: c [N m s^2]: a number, one for each body axis, or a tensor.

    Raises:
        ValueError: Wrong shape (trace time). Values (finite, not negative; a tensor symmetric and
            positive semi-definite) are checked by `simulate`.

    Gradients: finite everywhere; in omega zero at rest.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> drag = jr.torques.QuadraticDrag(0.1)
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([3.0, 0.0, 4.0]))
    >>> print(drag(0.0, state, None).round(6))
    [-1.5 -0.  -2. ]
    """

    coefficient: Float[Array, "..."] = eqx.field(converter=_coefficient)

    def __call__(self, t: ScalarLike, state: Any, args: Any) -> Vector:
        """Torque on the body [N m], body components."""
        del t, args
        return -safe_norm(state.omega) * _apply_coefficient(self.coefficient, state.omega)

    def check(self, findings: Findings) -> None:
        """Note a coefficient that is negative or not finite."""
        _check_coefficient(findings, self)
