"""Integrals of motion of a heavy body, with the extra one of the integrable cases."""

from functools import partial
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._checks import (
    all_finite,
    check_option,
    check_type,
    is_inertia,
    is_unit,
    where_defined,
)
from jrigid._core.compile import one_program
from jrigid._motion_inputs import HasRigidBody, plain_state
from jrigid._numerics import product, safe_norm
from jrigid._types import Scalar
from jrigid.dynamics import State, angular_momentum, kinetic_energy
from jrigid.rotation import rotate_inverse
from jrigid.systems import RigidBody
from jrigid.top._lame_solution import square_of
from jrigid.torques import UniformGravity

Case = Literal["euler", "lagrange", "kovalevskaya", "goryachev-chaplygin"]
_RATIOS = {"kovalevskaya": 2.0, "goryachev-chaplygin": 4.0}  # I1 / I3


class Integrals(NamedTuple):
    """Integrals of motion of a heavy body with a fixed point.

    Attributes:
        energy: Kinetic plus potential energy; the latter is zero with the centre of
            mass level with the fixed point [J].
        vertical_momentum: Angular momentum along the vertical, against gravity [kg
            m^2/s].
        extra: The third integral of the requested case, or None: Euler's |L|^2
            [kg^2 m^4/s^2], Lagrange's I3 omega3 [kg m^2/s], Kovalevskaya's [1/s^4],
            that of Goryachev and Chaplygin [1/s^3].
    """

    energy: Scalar
    vertical_momentum: Scalar
    extra: Scalar | None


@partial(one_program, static="case")
def integrals(
    body: RigidBody | HasRigidBody, state: State, case: Case | None = None
) -> Integrals:
    """Energy, vertical angular momentum and the extra integral of a heavy body.

    With w = omega1 + i omega2, c = lever1 + i lever2, G = gamma1 + i gamma2 (gamma the
    vertical in the body) and k = mass |gravity| / I3 Kovalevskaya's integral is |w^2 -
    k c G|^2, and that of Goryachev and Chaplygin omega3 |w|^2 - k gamma3 Re(c* w).

    Args:
        body: A `SymmetricTop`, a body under `torques.UniformGravity` alone, or for
            "euler" one without a torque; moments, not a tensor, where a case is
            requested.
        state: Any state of the motion.
        case: "euler" (no torque), "lagrange" (I1 = I2, lever along axis 3),
            "kovalevskaya" (I1 = I2 = 2 I3, lever across axis 3), "goryachev-chaplygin"
            (I1 = I2 = 4 I3, lever across axis 3, no vertical angular momentum), or
            None.

    Returns:
        The integrals. NaN for a body that is not of the case to 1e-8 (float32: 3e-4),
        and where the inertia or the state is not valid.

    Raises:
        ValueError: The torque is another one, the case is unknown, or the inertia is a
            tensor and a case is requested.

    Gradients: analytic. Without gravity those of the vertical momentum are zero.
    Source: V. V. Golubev, Lectures on the Integration of the Equations of Motion of a
    Rigid Body about a Fixed Point (1960); signs from Euler's and Poisson's equations.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> gravity = jr.torques.UniformGravity(
    ...     1.0, jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 0.0, -1.0]))
    >>> body = jr.RigidBody(jnp.array([2.0, 2.0, 1.0]), gravity)
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 0.0, 3.0]))
    >>> print(jr.top.integrals(body, state, "kovalevskaya").extra)
    1.0
    """
    if isinstance(body, HasRigidBody):
        body = body.as_rigid_body()
    check_type("body", body, RigidBody)
    gravity = body.torque
    # Without gravity no direction is vertical, which only Euler's case does not need.
    if body.is_free and case == "euler":
        zero = jnp.zeros(3, body.inertia.dtype)
        gravity = UniformGravity(zero[0], zero, zero)
    check_type("body.torque", gravity, UniformGravity)
    check_option("case", case, (None, *get_args(Case)))
    if case is not None and body.inertia.ndim != 1:
        raise ValueError(
            "Argument `body` must have principal moments where a case is requested, "
            "but it has a tensor."
        )
    pull, structure = jtu.tree_flatten(gravity)
    state, (inertia, *pull) = plain_state("state", state, body.inertia, *pull)
    arguments = inertia, structure.unflatten(pull), state
    ok = is_inertia(inertia) & all_finite(arguments) & is_unit(state.attitude)
    ok = ok & _is_of_case(case, *jax.lax.stop_gradient(arguments))
    return where_defined(ok, partial(_integrals, case), *arguments)


def _integrals(
    case: Case | None, inertia: Array, gravity: UniformGravity, state: State
) -> Integrals:
    """The integrals of a body that is of the case."""
    strength = safe_norm(gravity.gravity)
    # Without gravity no direction is vertical, and its angular momentum counts as 0.
    pulls = strength > 0
    down = rotate_inverse(
        state.attitude, gravity.gravity / jnp.where(pulls, strength, 1.0)
    )
    up = jnp.where(pulls, -down, 0.0)
    # Body components. The product with `up` is the component along the vertical.
    momentum = angular_momentum(inertia, state.omega)
    energy = kinetic_energy(inertia, state.omega) + gravity.potential(0.0, state, None)
    rate = gravity.mass * strength / inertia[2]
    w = jax.lax.complex(*state.omega[:2])
    # The factor k of the docstring is part of c here.
    c = jax.lax.complex(*(rate * gravity.lever)[:2])
    g = jax.lax.complex(*up[:2])
    extra = None
    if case == "euler":
        extra = product("i,i->", momentum, momentum)
    elif case == "lagrange":
        # With I1 = I2 and the lever along axis 3 no torque acts about that axis.
        extra = momentum[2]
    elif case == "kovalevskaya":
        # Euler's and Poisson's equations give (w^2 - c g)' = -i omega3 (w^2 - c g),
        # which changes the phase alone.
        extra = square_of(w * w - c * g)
    elif case == "goryachev-chaplygin":
        # Its rate is proportional to the vertical angular momentum, so it is constant
        # only where that is zero.
        extra = state.omega[2] * square_of(w) - up[2] * (jnp.conj(c) * w).real
    return Integrals(energy, product("i,i->", momentum, up), extra)


def _is_of_case(
    case: Case | None, inertia: Array, gravity: UniformGravity, state: State
) -> Array:
    """Whether a body and its state are of the case."""

    def vanishes(x: Array, beside: Array) -> Array:
        tolerance = jnp.sqrt(jnp.finfo(inertia.dtype).eps)
        return jnp.max(jnp.abs(x)) <= tolerance * jnp.max(jnp.abs(beside))

    i1, i2, i3 = inertia
    of_case = gravity.mass >= 0
    if case == "euler":
        of_case &= (
            gravity.mass * safe_norm(gravity.gravity) * safe_norm(gravity.lever) == 0
        )
    elif case is not None:
        # The lever is along axis 3 in the case of Lagrange, and across it in the other
        # two.
        off = gravity.lever[:2] if case == "lagrange" else gravity.lever[2]
        of_case &= vanishes(i1 - i2, i1) & vanishes(off, gravity.lever)
    if case in _RATIOS:
        of_case &= vanishes(i1 - _RATIOS[case] * i3, i1)
    if case == "goryachev-chaplygin":
        # The extra integral is one only in motions without this angular momentum.
        vertical = _integrals(None, inertia, gravity, state).vertical_momentum
        of_case &= vanishes(vertical, inertia * state.omega)
    return of_case
