"""External torques: gravity and its gradient, magnetism, sunlight, drag, friction."""
# ruff: noqa: ARG002

# All torques have the arguments t, state and args, which some of them do not use.

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jrigid._checks import (
    INERTIA,
    RESULTS,
    Findings,
    array_of_shape,
    check_shape,
    float_arrays,
    is_inertia,
    scaled_together,
)
from jrigid._numerics import safe_norm
from jrigid._types import BodyState, InertiaLike, Scalar, ScalarLike, Vector
from jrigid.dynamics import angular_momentum
from jrigid.rotation import rotate, rotate_inverse
from jrigid.torques._base import (
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    AbstractTorque,
    Rule,
    array,
    check_parameters,
    direction,
    has_negative,
    in_dtype_of,
    value_of,
    vector_or_function,
)

# Total solar irradiance at 1 au [W/m^2] (nominal value of IAU 2015 Resolution B3) over
# the speed of light [m/s].
_PRESSURE_AT_EARTH = 1361 / 299_792_458


class UniformGravity(AbstractTorque):
    """Torque of uniform gravity on a body with a fixed point: lever x (m g).

    Attributes:
        mass: Mass [kg], not negative.
        lever: From the pivot to the centre of mass, body components [m].
        gravity: Acceleration of gravity, space components [m/s^2].

    Gradients: analytic in the attitude, linear in each parameter.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> lever, g = jnp.array([0.0, 0.0, 0.1]), jnp.array([0.0, 0.0, -9.8])
    >>> gravity = jr.torques.UniformGravity(2.0, lever, g)
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    >>> print(gravity.potential(0.0, state, None).round(6))
    1.96
    """

    mass: Float[Array, ""] = eqx.field(converter=array("mass"), metadata=NOT_NEGATIVE)
    lever: Float[Array, "3"] = eqx.field(converter=array("lever", 3), metadata=FINITE)
    gravity: Float[Array, "3"] = eqx.field(
        converter=array("gravity", 3), metadata=FINITE
    )

    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Torque on the body [N m], body components."""
        mass, lever, gravity = in_dtype_of(state, self.mass, self.lever, self.gravity)
        return jnp.cross(lever, rotate_inverse(state.attitude, mass * gravity))

    def potential(self, t: ScalarLike, state: BodyState, args: PyTree) -> Scalar:
        """Potential energy [J], zero with the centre of mass level with the pivot."""
        mass, lever, gravity = in_dtype_of(state, self.mass, self.lever, self.gravity)
        return -mass * jnp.sum(gravity * rotate(state.attitude, lever))


class GravityGradient(AbstractTorque):
    """Gravity-gradient torque of a distant attractor: 3 mu / r^3 (n x I n).

    First order in body size over distance; n is the direction of the attractor in the
    body, I the inertia about the centre of mass, which the torque receives from the
    body on which it acts, with that of each `SpinningMass` in the same sum.
    `GravityGradient(mu, position).of_body(inertia)` can be called without a body.

    The body turns the field's energy into rotation, but its orbit does not lose it: of
    a `FloatingBody` the energy and the angular momentum are therefore constant only to
    the square of its size over the distance. Where that matters, give `systems.Force`
    the force -grad V beside that of the attractor, V being `potential`, with the
    potential energy of the other forces alone.

    Attributes:
        mu: Gravitational parameter of the attractor [m^3/s^2].
        position: `position(t) -> (3,)`, from the attractor to the body, space
            components [m]; None for the body's own position, that of a `FloatingState`
            with the attractor at the origin.
        inertia: Set by `of_body` [kg m^2]; None before.

    Gradients: finite; torque and gradients are NaN if the attractor is at the body.
    Source: Hughes, Spacecraft Attitude Dynamics (1986), section 8.1.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> def orbit(t):
    ...     return 7e6 * jnp.stack([jnp.cos(1e-3 * t), jnp.sin(1e-3 * t), 0 * t])
    >>> torque = jr.torques.GravityGradient(3.986e14, orbit)
    >>> body = jr.RigidBody(jnp.array([10.0, 20.0, 25.0]), torque)
    >>> turned = jr.rotation.exp(jnp.array([0.0, 0.0, jnp.pi / 4]))
    >>> state = jr.State(turned, jnp.zeros(3))
    >>> print((1e5 * body.torque_on(0.0, state, None)).round(3))
    [ 0.     0.    -1.743]
    """

    mu: Float[Array, ""] = eqx.field(converter=array("mu"), metadata=NOT_NEGATIVE)
    position: Callable[[ScalarLike], Vector] | None = None
    inertia: Float[Array, "..."] | None = None

    def of_body(self, inertia: InertiaLike) -> "GravityGradient":
        """The torque on a body of this inertia.

        Args:
            inertia: Moments or a tensor about the centre of mass [kg m^2].
        """
        inertia = array_of_shape("inertia", inertia, *INERTIA)
        return GravityGradient(self.mu, self.position, inertia)

    def _position(self, t: ScalarLike, state: BodyState) -> Vector:
        """Position of the body from the attractor, space components [m]."""
        if self.position is not None:
            return value_of("position", self.position, state, t)
        position = getattr(state, "position", None)
        if position is None:
            raise ValueError(
                "Argument `position` of `GravityGradient` must be a function of time "
                "for a body without a position of its own, but it is None."
            )
        return value_of("position", position, state, t)

    def _seen(self, t: ScalarLike, state: BodyState) -> tuple[Array, Array, Array]:
        """Inertia, direction of the attractor in the body, mu / r^3."""
        if self.inertia is None:
            raise ValueError(
                "Argument `torque` must know the inertia of its body, but this "
                "`GravityGradient` does not: call `system.torque_on(t, state, args)`, "
                "or the torque that `.of_body(inertia)` returns."
            )
        inertia, mu = in_dtype_of(state, self.inertia, self.mu)
        position = self._position(t, state)
        distance = safe_norm(position)
        # Divided three times, since r^3 can overflow in float32.
        strength = mu / distance / distance / distance
        # This direction is opposite to n. Torque and energy are even in n, so that its
        # sign has no effect.
        return inertia, rotate_inverse(state.attitude, position / distance), strength

    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Torque on the body [N m], body components."""
        inertia, n, strength = self._seen(t, state)
        return 3 * strength * jnp.cross(n, angular_momentum(inertia, n))

    def potential(self, t: ScalarLike, state: BodyState, args: PyTree) -> Scalar:
        """Attitude-dependent potential energy [J]: -mu / (2 r^3) (tr I - 3 n . I n)."""
        inertia, n, strength = self._seen(t, state)
        trace = jnp.sum(inertia) if inertia.ndim == 1 else jnp.trace(inertia)
        return -0.5 * strength * (trace - 3 * jnp.sum(n * angular_momentum(inertia, n)))


class MagneticDipole(AbstractTorque):
    """Torque of a magnetic field on a dipole fixed in the body: m x B.

    The energy of a motion contains -m . B. For a body in flight in a field that changes
    from place to place, give `systems.Force` the force grad (m . B) with the potential
    energy of the other forces alone.

    Attributes:
        moment: Dipole moment m, body components [A m^2].
        field: Flux density B, space components [T]: an array, or
            `field(t, state) -> (3,)`.

    Gradients: analytic in the attitude, linear in m and B.
    Source: Wertz, Spacecraft Attitude Determination and Control (1978), section 17.2.4.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> moment, field = jnp.array([0.0, 0.0, 2.0]), jnp.array([3e-5, 0.0, 0.0])
    >>> rod = jr.torques.MagneticDipole(moment, field)
    >>> upright = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    >>> print((1e5 * rod(0.0, upright, None)).round(6))
    [0. 6. 0.]
    """

    moment: Float[Array, "3"] = eqx.field(converter=array("moment", 3), metadata=FINITE)
    field: Float[Array, "3"] | Callable[[ScalarLike, Any], Vector] = eqx.field(
        **vector_or_function("field")
    )

    def _moment_and_field(self, t: ScalarLike, state: BodyState) -> tuple[Array, Array]:
        """Dipole moment and flux density, body components."""
        field = value_of("field", self.field, state, t, state)
        return self.moment.astype(field.dtype), rotate_inverse(state.attitude, field)

    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Torque on the body [N m], body components."""
        return jnp.cross(*self._moment_and_field(t, state))

    def potential(self, t: ScalarLike, state: BodyState, args: PyTree) -> Scalar:
        """Potential energy -m . B [J], if B depends on time and position alone."""
        moment, field = self._moment_and_field(t, state)
        return -jnp.sum(moment * field)


def _fraction(name: str) -> Any:
    """A field for a fraction of the light, a number or one for each plate."""
    return eqx.field(
        default=0.0, converter=array(name, (), (None,)), metadata=NOT_NEGATIVE
    )


class SolarPressure(AbstractTorque):
    r"""Torque of sunlight on flat plates: the sum of r x F over those in the light.

    With n the normal of a plate's bright side, s the direction of the Sun and c = n . s
    > 0, $F = -P A c [(1 - \rho_s) s + 2 (\rho_s c + \rho_d / 3) n]$: a fraction rho_s
    of the light is reflected as by a mirror, rho_d as by paper, and the rest is
    absorbed. Light from behind exerts no force: a plate with two bright sides is two
    plates. Plates cast no shadow on each other.

    Attributes:
        areas: A [m^2], one for each plate.
        normals: n, body components, of any length but zero.
        centers: r, from the centre of mass to the centre of each plate, body components
            [m].
        sun: From the body to the Sun, space components, of any length; an array, or
            `sun(t) -> (3,)`. Where it is zero there is no light, as in an eclipse.
        specular: rho_s, a number or one for each plate.
        diffuse: rho_d, a number or one for each plate; rho_s + rho_d is at most 1.
        pressure: P [N/m^2]; at the Earth by default.

    Gradients: finite everywhere. The torque has a kink where a plate is seen edge on;
    derivatives are there those of its dark side, zero.
    Source: Wertz, Spacecraft Attitude Determination and Control (1978), section 17.2.2.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> side, arm, sun = jnp.array([[[1.0, 0, 0]], [[0, 0.5, 0]], [[1.0, 0, 0]]])
    >>> mirror = jr.torques.SolarPressure(
    ...     jnp.array([10.0]), side, arm, sun[0], specular=1.0
    ... )
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    >>> print((1e6 * mirror(0.0, state, None)).round(3))
    [ 0.     0.    45.398]
    """

    areas: Float[Array, " n"] = eqx.field(
        converter=array("areas", None), metadata=NOT_NEGATIVE
    )
    normals: Float[Array, "n 3"] = eqx.field(**direction("normals", None, 3))
    centers: Float[Array, "n 3"] = eqx.field(
        converter=array("centers", None, 3), metadata=FINITE
    )
    sun: Float[Array, "3"] | Callable[[ScalarLike], Vector] = eqx.field(
        **vector_or_function("sun")
    )
    specular: Float[Array, "..."] = _fraction("specular")
    diffuse: Float[Array, "..."] = _fraction("diffuse")
    pressure: Float[Array, ""] = eqx.field(
        default=_PRESSURE_AT_EARTH, converter=array("pressure"), metadata=NOT_NEGATIVE
    )

    def __check_init__(self):
        """Raise ValueError unless each plate has an area and all the rest."""
        rows = {"normals": (3,), "centers": (3,), "specular": (), "diffuse": ()}
        for name, row in rows.items():
            value = getattr(self, name)
            # A single number holds for all plates.
            if value.ndim:
                check_shape(name, value, (self.areas.size, *row))

    def _forces(self, t: ScalarLike, state: BodyState) -> Array:
        """Force on each plate [N], body components."""
        sun = value_of("sun", self.sun, state, t)
        distance = safe_norm(sun)
        to_sun = sun / jnp.where(distance > 0, distance, 1.0)
        s = rotate_inverse(state.attitude, to_sun)[None]
        n, areas, pressure = in_dtype_of(state, self.normals, self.areas, self.pressure)
        specular, diffuse = in_dtype_of(state, self.specular, self.diffuse)
        cosine = jnp.sum(n * s, axis=-1)
        # At 0 `jnp.maximum` would have half the slope of the bright side, not the slope
        # 0 of the dark side.
        cosine = jnp.where(cosine > 0, cosine, 0.0)
        pushed = -pressure * areas * cosine
        along = pushed * (1 - specular)
        across = 2 * pushed * (specular * cosine + diffuse / 3)
        return along[:, None] * s + across[:, None] * n

    def force(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Force on the body [N], space components; the `force` of a `FloatingBody`."""
        return rotate(state.attitude, jnp.sum(self._forces(t, state), axis=0))

    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Torque on the body [N m], body components."""
        (centers,) = in_dtype_of(state, self.centers)
        return jnp.sum(jnp.cross(centers, self._forces(t, state)), axis=0)

    def check(self, findings: Findings) -> None:
        """Note bad parameters, and plates that reflect more light than they receive."""
        check_parameters(findings, self)
        reflected = sum(float_arrays(self.specular, self.diffuse))
        message = (
            "Arguments `specular` and `diffuse` must add up to at most 1, "
            "but they do not."
        )
        # The excess is the rounding of float32.
        possible = jnp.all(reflected <= 1 + 1e-6)
        findings.require(possible, RESULTS.invalid_torque, message, reflected)


def _dissipates(coefficient: Array) -> Bool[Array, ""]:
    """True where a drag never adds energy: no negative number, axis or eigenvalue."""
    if coefficient.ndim < 2:
        return jnp.all((coefficient >= 0) & (coefficient < jnp.inf))
    (unit,) = scaled_together(coefficient)
    # Eigenvalues may be negative by rounding.
    rounding = _ROUNDING * jnp.finfo(unit.dtype).eps
    return is_inertia(unit + rounding * jnp.eye(3, dtype=unit.dtype))


def _adds_energy(coefficient: np.ndarray) -> bool | np.bool_:
    """Whether a drag adds energy: it has a negative number, axis or eigenvalue."""
    if coefficient.ndim < 2:
        return has_negative(coefficient)
    largest = np.max(np.abs(coefficient))
    if not 0 < largest < np.inf:
        return False
    unit = coefficient / largest
    # Only the symmetric part of a tensor changes the energy.
    lowest = np.linalg.eigvalsh(0.5 * (unit + unit.T))[0]
    return lowest < -_ROUNDING * np.finfo(unit.dtype).eps


# In eps of the largest entry of a tensor.
_ROUNDING = 64
_DISSIPATIVE: dict[str, Any] = {
    "converter": array("coefficient", (), *INERTIA),
    "metadata": {
        "rule": Rule(
            "finite and not negative (a tensor symmetric and positive semi-definite)",
            _dissipates,
            _adds_energy,
        ),
        "positive": True,
    },
}


def _linear_drag(coefficient: Array, state: BodyState) -> Vector:
    """The torque -c omega of a number, numbers for the body axes, or a tensor."""
    # `angular_momentum` multiplies omega by three numbers or by a tensor.
    (c,) = in_dtype_of(state, coefficient)
    return -(angular_momentum(c, state.omega) if c.ndim else c * state.omega)


class LinearDrag(AbstractTorque):
    """Drag proportional to the angular velocity: -c omega.

    Attributes:
        coefficient: c [N m s]: a number or one for each body axis, not negative, or a
            tensor, symmetric and positive semi-definite.

    Raises:
        RuntimeError: The coefficient is negative, and known when the drag is built.

    Gradients: linear in the coefficient and in omega.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> drag = jr.torques.LinearDrag(0.1)
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([3.0, 0.0, 4.0]))
    >>> print(drag(0.0, state, None).round(6))
    [-0.3 -0.  -0.4]
    """

    coefficient: Float[Array, "..."] = eqx.field(**_DISSIPATIVE)

    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Torque on the body [N m], body components."""
        return _linear_drag(self.coefficient, state)


class QuadraticDrag(AbstractTorque):
    """Drag quadratic in the angular velocity: -|omega| c omega.

    Attributes:
        coefficient: c [N m s^2]: a number or one for each body axis, not negative, or a
            tensor, symmetric and positive semi-definite.

    Raises:
        RuntimeError: The coefficient is negative, and known when the drag is built.

    Gradients: finite everywhere; at rest the torque and its gradient in omega are zero.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> drag = jr.torques.QuadraticDrag(0.1)
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([3.0, 0.0, 4.0]))
    >>> print(drag(0.0, state, None).round(6))
    [-1.5 -0.  -2. ]
    """

    coefficient: Float[Array, "..."] = eqx.field(**_DISSIPATIVE)

    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Torque on the body [N m], body components."""
        return safe_norm(state.omega) * _linear_drag(self.coefficient, state)


class CoulombFriction(AbstractTorque):
    """Dry friction, of one size at any speed: -c omega / sqrt(|omega|^2 + width^2).

    Coulomb's law jumps where the motion reverses, and no integrator steps over the
    jump. Here it is spread over a width of the speed. Far above the width the torque is
    c, at the width it is 0.71 c. Below the width it is a linear drag c / width, in
    which a body comes to rest with the time constant I width / c. Under a load that
    Coulomb friction would hold, the body creeps at a speed of about the width. At rest
    `simulate` takes some three steps in each time constant. If the width is a
    thousandth of the initial speed, these are 3000 steps in the time that the body took
    to stop. An event at |omega| = width avoids them.

    Attributes:
        magnitude: c [N m], not negative.
        width: Speed at which the law is rounded off [rad/s], positive.
        axis: Of a bearing, body components, of any length: friction acts on the
            rotation about this axis only. None for a ball joint.

    Raises:
        RuntimeError: The magnitude is negative, or the width is not positive, and the
            value is known when the torque is built.

    Gradients: finite everywhere; the torque is analytic.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> bearing = jr.torques.CoulombFriction(0.1, 1e-3, jnp.array([0.0, 0.0, 1.0]))
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([3.0, 0.0, 4.0]))
    >>> print(bearing(0.0, state, None).round(6))
    [-0.  -0.  -0.1]
    """

    magnitude: Float[Array, ""] = eqx.field(
        converter=array("magnitude"), metadata=NOT_NEGATIVE
    )
    width: Float[Array, ""] = eqx.field(converter=array("width"), metadata=POSITIVE)
    axis: Float[Array, "3"] | None = eqx.field(
        default=None, **direction("axis", 3, optional=True)
    )

    def __call__(self, t: ScalarLike, state: BodyState, args: PyTree) -> Vector:
        """Torque on the body [N m], body components."""
        magnitude, width = in_dtype_of(state, self.magnitude, self.width)
        omega = state.omega
        if self.axis is not None:
            axis = self.axis.astype(omega.dtype)
            omega = axis * jnp.sum(axis * omega)
        # The root of |omega|^2 + width^2 is the norm of these four numbers. It cannot
        # overflow, and it is positive.
        return -magnitude * (omega / safe_norm(jnp.append(omega, width)))
