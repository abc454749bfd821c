"""The symmetric top in Euler angles: Lagrangian, momenta, reduced motion."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jrigid._checks import check_type, float_arrays, shaped
from jrigid._core.compile import one_program
from jrigid._numerics import product
from jrigid._types import Real, Scalar, ScalarLike
from jrigid.dynamics import State
from jrigid.rotation import rotate_inverse
from jrigid.top._symmetric_top import SymmetricTop, of_motion, where_valid


class Conserved(NamedTuple):
    """Constants of a symmetric top's motion.

    Attributes:
        p_phi: Angular momentum about the vertical [kg m^2/s].
        p_psi: Angular momentum about the axis, I3 omega3 [kg m^2/s].
        energy: Kinetic plus potential energy, the latter zero with the axis level [J].
    """

    p_phi: Scalar
    p_psi: Scalar
    energy: Scalar


class AngleRates(NamedTuple):
    """Rates of the angles about the vertical and about the axis [rad/s]."""

    phi: Scalar
    psi: Scalar


@one_program
def lagrangian(q: Real[Any, "3"], q_dot: Real[Any, "3"], top: SymmetricTop) -> Scalar:
    """Kinetic less potential energy in z-x-z Euler angles, for `jrigid.lagrangian`.

    Args:
        q: Angles (phi, theta, psi) [rad].
        q_dot: Their rates [rad/s].
        top: The top.

    Returns:
        The Lagrangian [J].

    Gradients: analytic; the mass matrix is singular at theta = 0 and pi.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 5.7.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 2.0)
    >>> q, q_dot = jnp.array([0.0, jnp.pi / 3, 0.0]), jnp.array([0.0, 1.0, 2.0])
    >>> print(jr.top.lagrangian(q, q_dot, top).round(6))
    0.5
    """
    check_type("top", top, SymmetricTop)
    own = {name: (value,) for name, value in vars(top).items()}
    i1, i3, mgl, q, q_dot = shaped(**own, q=(q, 3), q_dot=(q_dot, 3))
    _, theta, _ = q
    phi_dot, theta_dot, psi_dot = q_dot
    cos = jnp.cos(theta)
    sin = jnp.sin(theta)
    spin = psi_dot + phi_dot * cos
    across = theta_dot * theta_dot + (phi_dot * sin) ** 2
    return 0.5 * (i1 * across + i3 * spin * spin) - mgl * cos


@one_program
def conserved(top: SymmetricTop, state: State) -> Conserved:
    """Angular momenta about the vertical and the axis, and the energy.

    Args:
        top: The top.
        state: Any state of the motion.

    Returns:
        The three constants of the motion; NaN where the top or the state is not valid.

    Gradients: analytic.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 2.0)
    >>> state = jr.top.initial_state(top, jnp.pi / 3, psi_dot=4.0)
    >>> print(*(x.round(6) for x in jr.top.conserved(top, state)))
    1.0 2.0 5.0
    """

    def constants(top: SymmetricTop, state: State) -> Conserved:
        # The vertical in body axes has no poles, which Euler angles have.
        up = rotate_inverse(
            state.attitude, jnp.array([0.0, 0.0, 1.0], state.omega.dtype)
        )
        momentum = jnp.stack([top.I1, top.I1, top.I3]) * state.omega
        energy = 0.5 * product("i,i->", momentum, state.omega) + top.mgl * up[2]
        return Conserved(product("i,i->", momentum, up), momentum[2], energy)

    return of_motion(constants, top, state)


def _over(momentum: Array, side: Array) -> Array:
    """Half the quotient, with 0 / 0 = 0 for an axis that can pass the vertical."""
    zero = (momentum == 0) & (side == 0)
    return jnp.where(zero, 0.0, 0.5 * momentum / jnp.where(zero, 1.0, side))


def _angle_rates(
    i1: Array, i3: Array, _mgl: Array, theta: Array, p_phi: Array, p_psi: Array
) -> AngleRates:
    # p_phi - p_psi cos theta = (p_phi - p_psi) cos^2 + (p_phi + p_psi) sin^2 of half
    # the angle, over sin^2 theta = 4 sin^2 cos^2.
    sin = jnp.sin(0.5 * theta)
    cos = jnp.cos(0.5 * theta)
    # The part that is large near upright, and the part that is large near upside down.
    upper = _over(p_phi - p_psi, sin * sin)
    lower = _over(p_phi + p_psi, cos * cos)
    phi = 0.5 * (upper + lower) / i1
    return AngleRates(phi, p_psi / i3 - phi * jnp.cos(theta))


@one_program
def angle_rates(
    top: SymmetricTop, theta: ScalarLike, p_phi: ScalarLike, p_psi: ScalarLike
) -> AngleRates:
    """Precession phi' and spin psi' of a top at a tilt.

    Args:
        top: The top.
        theta: Tilt of the axis from the vertical [rad].
        p_phi: Angular momentum about the vertical [kg m^2/s].
        p_psi: Angular momentum about the axis [kg m^2/s].

    Returns:
        phi' = (p_phi - p_psi cos theta) / (I1 sin^2 theta) and psi' = p_psi / I3 - phi'
        cos theta [rad/s]. At the vertical they are infinite, unless the momenta let the
        axis pass: then they are the mean of the two sides. No floating point number
        equals pi, so they are large there in place of infinite. NaN where the top is
        not valid or a number is not finite.

    Gradients: right inside 0 < theta < pi. Those in the momenta at the vertical leave
    out the singular part.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 5.7.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> rates = jr.top.angle_rates(jr.SymmetricTop(1.0, 0.5, 2.0), jnp.pi / 2, 3.0, 1.0)
    >>> print(rates.phi.round(6), rates.psi.round(6))
    3.0 2.0
    """
    return where_valid(_angle_rates, top, theta=theta, p_phi=p_phi, p_psi=p_psi)


@one_program
def effective_potential(
    top: SymmetricTop,
    theta: Real[ArrayLike, "..."],
    p_phi: ScalarLike,
    p_psi: ScalarLike,
) -> Float[Array, "..."]:
    """Potential of the tilt alone: I1 theta'^2 / 2 + V(theta) = E - p_psi^2 / (2 I3).

    Args:
        top: The top.
        theta: Tilts of the axis from the vertical [rad], of any shape.
        p_phi: Angular momentum about the vertical [kg m^2/s].
        p_psi: Angular momentum about the axis [kg m^2/s].

    Returns:
        V = (p_phi - p_psi cos theta)^2 / (2 I1 sin^2 theta) + mgl cos theta [J]. It is
        infinite at the vertical unless the momenta let the axis pass. NaN where the top
        is not valid or a number is not finite.

    Gradients: right where V is finite. Those in the momenta at the vertical leave out
    the singular part.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 5.7.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 2.0)
    >>> print(jr.top.effective_potential(top, jnp.pi / 2, 1.0, 3.0).round(6))
    0.5
    """

    def potential(
        i1: Array, _i3: Array, mgl: Array, theta: Array, p_phi: Array, p_psi: Array
    ) -> Array:
        sin = jnp.sin(0.5 * theta)
        cos = jnp.cos(0.5 * theta)
        # (p_phi - p_psi cos theta) / sin theta, split as in `_angle_rates`, so that no
        # part has a pole where the axis can pass.
        across = _over(p_phi - p_psi, sin) * cos + _over(p_phi + p_psi, cos) * sin
        return 0.5 * across * across / i1 + mgl * jnp.cos(theta)

    def at_tilt(theta: Array) -> Array:
        return where_valid(potential, top, theta=theta, p_phi=p_phi, p_psi=p_psi)

    return jnp.vectorize(at_tilt)(theta)


@one_program
def cubic(top: SymmetricTop, conserved: Conserved) -> Float[Array, "4"]:
    """Coefficients of the cubic of the reduced motion: u'^2 = f(u), u = cos theta.

    Args:
        top: The top.
        conserved: Its momenta and energy.

    Returns:
        Coefficients of f [1/s^2], the highest power first, as `jnp.polyval` takes them:
        f = (1 - u^2) (2 E - p_psi^2 / I3 - 2 mgl u) / I1 - ((p_phi - p_psi u) / I1)^2.
        NaN where the top is not valid or a constant is not finite.

    Gradients: analytic.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 5.7.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 2.0)
    >>> print(jr.top.cubic(top, jr.top.Conserved(1.0, 2.0, 5.0)))
    [ 4. -6.  0.  1.]
    """

    # The letters are Goldstein's.
    def coefficients(
        i1: Array, i3: Array, mgl: Array, p_phi: Array, p_psi: Array, energy: Array
    ) -> Array:
        alpha = (2 * energy - p_psi * p_psi / i3) / i1
        beta = 2 * mgl / i1
        a = p_psi / i1
        b = p_phi / i1
        return jnp.stack([beta, -alpha - a * a, 2 * a * b - beta, alpha - b * b])

    return where_valid(coefficients, top, **Conserved(*conserved)._asdict())


def reduced_vector_field(
    top: SymmetricTop, conserved: Conserved
) -> Callable[[ScalarLike, Float[Array, "4"], object], Float[Array, "4"]]:
    """Vector field of the tilt, and of the angles that follow from it, for diffrax.

    Args:
        top: The top.
        conserved: Its momenta; the energy is not used.

    Returns:
        The rates `(t, y, args) -> y'` of y = (phi, theta, psi, theta') [rad, rad/s]:
        theta'' = -V'(theta) / I1, and phi', psi' of `angle_rates`. They are singular at
        the vertical. An axis that can pass there (p_phi = +-p_psi) does pass: theta
        changes its sign (or exceeds pi).

    Gradients: analytic inside 0 < theta < pi.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 5.7.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 2.0)
    >>> rates = jr.top.reduced_vector_field(top, jr.top.Conserved(1.0, 2.0, 5.0))
    >>> print(rates(0.0, jnp.array([0.0, jnp.pi / 2, 0.0, 0.3]), None).round(6))
    [1.  0.3 4.  0. ]
    """
    check_type("top", top, SymmetricTop)
    i1, i3, mgl, p_phi, p_psi, _ = float_arrays(top.I1, top.I3, top.mgl, *conserved)

    def rates(t: ScalarLike, y: Float[Array, "4"], args: object) -> Float[Array, "4"]:
        del t, args
        _, theta, _, theta_dot = y
        phi_dot, psi_dot = _angle_rates(i1, i3, mgl, theta, p_phi, p_psi)
        # Lagrange's equation of theta, in which p_psi replaces I3 omega3.
        centrifugal = phi_dot * (i1 * phi_dot * jnp.cos(theta) - p_psi)
        theta_ddot = (mgl + centrifugal) * jnp.sin(theta) / i1
        return jnp.stack([phi_dot, theta_dot, psi_dot, theta_ddot])

    return rates
