"""What heavy bodies keep, in the four cases in which they keep more than two things."""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_option,
    float_arrays,
    is_inertia,
    is_unit,
    nan_where,
)
from jrigid._numerics import product, safe_norm
from jrigid._types import Scalar
from jrigid.dynamics import State, angular_momentum, kinetic_energy
from jrigid.rotation import rotate_inverse
from jrigid.systems import RigidBody
from jrigid.torques import UniformGravity

CASES = ("euler", "lagrange", "kovalevskaya", "goryachev-chaplygin")
_RATIO = {"lagrange": None, "kovalevskaya": 2.0, "goryachev-chaplygin": 4.0}
_CONDITIONS = {
    "euler": "Argument `body` must have no lever, mass or gravity in Euler's case, but it does.",
    "lagrange": (
        "Argument `body` must have I1 = I2 and a lever along axis 3 in Lagrange's case, but it "
        "does not."
    ),
    "kovalevskaya": (
        "Argument `body` must have I1 = I2 = 2 I3 and a lever across axis 3 in Kovalevskaya's "
        "case, but it does not."
    ),
    "goryachev-chaplygin": (
        "Argument `body` must have I1 = I2 = 4 I3 and a lever across axis 3 in the case of "
        "Goryachev and Chaplygin, but it does not."
    ),
}
_NOT_LEVEL = (
    "Argument `state` must have no angular momentum about the vertical in the case of Goryachev "
    "and Chaplygin, but it has."
)

Case = Literal["euler", "lagrange", "kovalevskaya", "goryachev-chaplygin"]


class Integrals(NamedTuple):
    """What a heavy body with a fixed point keeps.

    Attributes:
        energy: Kinetic and potential, the latter zero with the centre of mass level [J].
        vertical_momentum: Angular momentum along the vertical, against gravity [kg m^2/s].
        extra: The third integral of the case asked for, None without one: Euler's |L|^2
            [kg^2 m^4/s^2], Lagrange's I3 omega3 [kg m^2/s], Kovalevskaya's [1/s^4], that of
            Goryachev and Chaplygin [1/s^3].
    """

    energy: Scalar
    vertical_momentum: Scalar
    extra: Scalar | None


def integrals(
    body: RigidBody, state: State, case: Case | None = None, *, throw: bool = True
) -> Integrals:
    """Energy, vertical angular momentum and the extra integral of a heavy body.

    With w = omega1 + i omega2, c = lever1 + i lever2, G = gamma1 + i gamma2 (gamma the vertical in
    the body) and k = mass |gravity| / I3 Kovalevskaya's integral is |w^2 - k c G|^2, and that of
    Goryachev and Chaplygin omega3 |w|^2 - k gamma3 Re(c* w).

    Args:
        body: A body under `torques.UniformGravity` alone; moments, not a tensor, where a case is
            asked for.
        state: Any state of the motion.
        case: "euler" (no torque), "lagrange" (I1 = I2, lever along axis 3), "kovalevskaya" (I1 =
            I2 = 2 I3, lever across axis 3), "goryachev-chaplygin" (I1 = I2 = 4 I3, lever across
            axis 3, no vertical angular momentum), or None.
        throw: False: bad values, and bodies not of the case, give NaN instead of an error.

    Returns:
        What the motion keeps.

    Raises:
        ValueError: Another torque, another case, a tensor with a case (trace time).
        RuntimeError: Bad value, a body not of the case to 1e-8 (float32: 3e-4) (run time, any
            lane).

    Gradients: analytic; without gravity those of the vertical momentum are zero.
    Source: V. V. Golubev, Lectures on the Integration of the Equations of Motion of a Rigid Body
    about a Fixed Point (1960); signs from Euler's and Poisson's equations.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> gravity = jr.torques.UniformGravity(
    ...     1.0, jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 0.0, -1.0]))
    >>> body = jr.RigidBody(jnp.array([2.0, 2.0, 1.0]), gravity)
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 0.0, 3.0]))
    >>> print(jr.top.integrals(body, state, "kovalevskaya").extra)
    1.0
    """
    if not isinstance(body, RigidBody) or not isinstance(body.torque, UniformGravity):
        raise ValueError(
            "Argument `body` must be a RigidBody under torques.UniformGravity alone, but it is not."
        )
    if case is not None:
        check_option("case", case, CASES)
        if body.inertia.ndim != 1:
            raise ValueError(
                "Argument `body` must have principal moments where a case is asked for, but it has "
                "a tensor."
            )
    inertia, attitude, omega, mass, lever, pull = float_arrays(
        body.inertia, state.attitude, state.omega, *jtu.tree_leaves(body.torque)
    )
    strength = safe_norm(pull)
    weight = mass * strength
    findings = Findings()
    findings.require(is_inertia(inertia), RESULTS.invalid_inertia)
    findings.require(all_finite((attitude, omega)), RESULTS.invalid_state)
    findings.require(is_unit(attitude), RESULTS.invalid_attitude)
    findings.require(all_finite((mass, lever, pull)) & (mass >= 0), RESULTS.invalid_torque)
    pulls = strength > 0
    down = rotate_inverse(attitude, pull / jnp.where(pulls, strength, 1.0))
    up = jnp.where(pulls, -down, 0.0)
    momentum = angular_momentum(inertia, omega)
    vertical = product("i,i->", momentum, up)
    energy = kinetic_energy(inertia, omega) + weight * product("i,i->", lever, up)
    if case is None:
        inertia, energy, vertical = findings.apply((inertia, energy, vertical), throw)
        energy, vertical = nan_where(~findings.ok, (energy, vertical))
        return Integrals(energy, vertical, None)
    _require_case(findings, case, inertia, weight, lever, momentum, vertical)
    extra = _extra(case, inertia, omega, momentum, weight, lever, up)
    found = nan_where(~findings.ok, Integrals(energy, vertical, extra))
    return findings.apply(found, throw)


def _require_case(
    findings: Findings,
    case: Case,
    inertia: Array,
    weight: Array,
    lever: Array,
    momentum: Array,
    vertical: Array,
) -> None:
    inertia, weight, lever, momentum, vertical = jax.lax.stop_gradient(
        (inertia, weight, lever, momentum, vertical)
    )
    tolerance = jnp.sqrt(jnp.finfo(inertia.dtype).eps)
    i1, i2, i3 = inertia
    length = jnp.max(jnp.abs(lever))
    if case == "euler":
        of_case = weight * length == 0
    else:
        ratio = _RATIO[case]
        of_case = jnp.abs(i1 - i2) <= tolerance * i1
        if ratio is None:
            of_case = of_case & (jnp.max(jnp.abs(lever[:2])) <= tolerance * length)
        else:
            of_case = of_case & (jnp.abs(i1 - ratio * i3) <= tolerance * i1)
            of_case = of_case & (jnp.abs(lever[2]) <= tolerance * length)
    findings.require(of_case, RESULTS.invalid_inertia, _CONDITIONS[case])
    if case == "goryachev-chaplygin":
        level = jnp.abs(vertical) <= tolerance * jnp.max(jnp.abs(momentum))
        findings.require(level, RESULTS.invalid_state, _NOT_LEVEL)


def _extra(
    case: Case,
    inertia: Array,
    omega: Array,
    momentum: Array,
    weight: Array,
    lever: Array,
    up: Array,
) -> Array:
    if case == "euler":
        return product("i,i->", momentum, momentum)
    if case == "lagrange":
        return momentum[2]
    pull = weight / inertia[2]
    w1, w2, w3 = omega
    if case == "kovalevskaya":
        real = w1 * w1 - w2 * w2 - pull * (lever[0] * up[0] - lever[1] * up[1])
        imaginary = 2 * w1 * w2 - pull * (lever[0] * up[1] + lever[1] * up[0])
        return real * real + imaginary * imaginary
    along = lever[0] * w1 + lever[1] * w2
    return w3 * (w1 * w1 + w2 * w2) - pull * up[2] * along
