"""Initial states and special motions of the symmetric top: steady, sleeping, fast."""

from functools import partial
from typing import Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from jrigid._checks import (
    RESULTS,
    Findings,
    check_option,
    check_type,
    harmless,
    nan_where,
    shaped,
    where_defined,
)
from jrigid._core.compile import one_program
from jrigid._numerics import root_of_positive
from jrigid._types import Scalar, ScalarLike
from jrigid.dynamics import State
from jrigid.rotation import euler_rates_to_omega, from_euler
from jrigid.top._symmetric_top import SymmetricTop, where_valid

_ROUNDING = 1e-6  # [rad], of 180 degrees in float32
_BAD_TILT = (
    "Argument `theta` must be from 0 to pi, but it is not. (Angles are in radians: "
    "`jnp.radians` takes degrees.)"
)
_TOO_SLOW = (
    "Argument `{}` must be large enough for steady precession at `theta`, but it is "
    "not. (See `steady_precession`.)"
)
_LEVEL = (
    "Argument `theta` must not be level for the fast precession, nor I1 = I3 where "
    "`psi_dot` is given: it is infinite."
)


class SteadyPrecession(NamedTuple):
    """Both rates at which a top precesses at a constant tilt.

    Attributes:
        slow: The rate of smaller magnitude [rad/s]; mgl / (I3 omega3) for fast spin.
        fast: The other rate [rad/s]; I3 omega3 / (I1 cos theta) for fast spin. It is
            infinite for a level axis, where there is one rate only.
        exists: Whether the spin is fast enough. The rates are NaN where it is not.
    """

    slow: Scalar
    fast: Scalar
    exists: Bool[Array, ""]


class Gyroscopic(NamedTuple):
    """The fast top, to leading order in mgl I1 / (I3 omega3)^2.

    Attributes:
        precession: Mean rate of precession mgl / (I3 omega3) [rad/s].
        nutation: Angular frequency of nutation I3 omega3 / I1 [rad/s].
        amplitude: Angle by which a top released from rest falls before it rises again,
            2 mgl I1 sin theta / (I3 omega3)^2 [rad].
    """

    precession: Scalar
    nutation: Scalar
    amplitude: Scalar


def _steady(
    i1: Array, i3: Array, mgl: Array, theta: Array, spin: Array, *, of_psi: bool
) -> tuple[Array, Array]:
    """The slow and the fast rate; NaN where there is none.

    `spin` is omega3, or psi' if `of_psi`.
    """
    momentum = i3 * spin
    # With psi' = omega3 - p cos(theta) in place of omega3, I1 - I3 replaces I1.
    i1 = i1 - i3 if of_psi else i1
    eps = jnp.finfo(theta.dtype).eps
    cos = jnp.cos(theta)
    # A level axis has one rate only. So has any axis where psi_dot is given and I1 =
    # I3: the equation for p is linear.
    level = (jnp.abs(cos) <= 4 * eps) | (i1 == 0)
    slant = jnp.where(level, 0.0, i1 * cos)
    # The discriminant of slant p^2 - momentum p + mgl = 0.
    square = momentum * momentum - 4 * slant * mgl
    root = root_of_positive(square)
    # Both terms have one sign, so that the sum does not cancel. The other root follows
    # from the product of the roots.
    total = momentum + jnp.where(momentum < 0, -root, root)
    still = total == 0
    slow = jnp.where(still, 0.0, 2 * mgl / jnp.where(still, 1.0, total))
    fast = 0.5 * total / jnp.where(level, 1.0, slant)
    fast = jnp.where(level, jnp.where(total < 0, -jnp.inf, jnp.inf), fast)
    # At the threshold itself the square is zero to rounding only.
    exists = (square >= -8 * eps * momentum * momentum) & (~still | (mgl == 0))
    return nan_where(~exists, (slow, fast))


@one_program
def steady_precession(
    top: SymmetricTop,
    theta: ScalarLike,
    omega3: ScalarLike | None = None,
    *,
    psi_dot: ScalarLike | None = None,
) -> SteadyPrecession:
    """Rates at which a top can precess at a constant tilt.

    They solve I1 cos(theta) p^2 - I3 omega3 p + mgl = 0. Solutions exist if
    (I3 omega3)^2 >= 4 I1 mgl cos theta, so a top above the horizontal needs spin, and
    one below it does not. Pass either `omega3` or `psi_dot`.

    Args:
        top: The top.
        theta: Tilt of the axis from the vertical [rad].
        omega3: Third component of the angular velocity, psi' + phi' cos theta [rad/s].
        psi_dot: Spin about the axis relative to the precession [rad/s]. With it I1 - I3
            replaces I1 in the equation.

    Returns:
        Both rates, and whether they exist. They do not exist with too little spin, and
        where the top is not valid or a number is not finite.

    Raises:
        ValueError: omega3 and psi_dot are both given, or neither.

    Gradients: right where the two rates differ. Where they meet the infinite part is
    left out.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 5.7.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> rates = jr.top.steady_precession(top, jnp.pi / 3, 6.0)
    >>> print(rates.slow.round(6), rates.fast.round(6), rates.exists)
    0.354249 5.645751 True
    """
    given = {"omega3": omega3, "psi_dot": psi_dot}
    spin = {name: value for name, value in given.items() if value is not None}
    if len(spin) != 1:
        raise ValueError(
            "One of the arguments `omega3` and `psi_dot` must be given, and one only."
        )
    slow, fast = where_valid(
        partial(_steady, of_psi=omega3 is None), top, theta=theta, **spin
    )
    return SteadyPrecession(slow, fast, ~jnp.isnan(slow))


@one_program
def sleeping_spin(top: SymmetricTop) -> Scalar:
    """Least spin of a stable upright top, 2 sqrt(mgl I1) / I3.

    Args:
        top: The top.

    Returns:
        |omega3| at the threshold [rad/s]; 0 if mgl <= 0, where such a top hangs. NaN
        where the top is not valid.

    Gradients: right for mgl > 0; zero at mgl <= 0.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 5.7.

    >>> import jrigid as jr
    >>> print(jr.top.sleeping_spin(jr.SymmetricTop(1.0, 0.5, 1.0)))
    4.0
    """

    def threshold(i1: Array, i3: Array, mgl: Array) -> Array:
        return 2 * root_of_positive(i1 * mgl) / i3

    return where_valid(threshold, top)


@one_program
def gyroscopic(top: SymmetricTop, theta: ScalarLike, omega3: ScalarLike) -> Gyroscopic:
    """Approximate motion of a fast top, as in textbooks.

    The exact values are `mean_precession`, `nutation_period` and `nutation_bounds`.

    Args:
        top: The top.
        theta: Tilt of the axis from the vertical at which it is released [rad].
        omega3: Third component of the angular velocity, not zero [rad/s].

    Returns:
        Precession, nutation and the amplitude of nutation, with relative errors of the
        order of mgl I1 / (I3 omega3)^2. NaN without spin, and where the top is not
        valid or a number is not finite.

    Gradients: analytic.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 5.7.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> fast = jr.top.gyroscopic(jr.SymmetricTop(1.0, 0.5, 1.0), jnp.pi / 6, 100.0)
    >>> print(fast.precession, fast.nutation, fast.amplitude.round(5))
    0.02 50.0 0.0004
    """

    def fast(
        i1: Array, i3: Array, mgl: Array, theta: Array, omega3: Array
    ) -> Gyroscopic:
        momentum = i3 * omega3
        # Released from rest, a top falls from the cusp by twice the amplitude of the
        # small nutation about steady precession.
        fall = 2 * mgl * i1 * jnp.sin(theta) / (momentum * momentum)
        return Gyroscopic(mgl / momentum, momentum / i1, fall)

    def fast_if_spinning(*numbers: Array) -> Gyroscopic:
        *_, omega3 = numbers
        return where_defined(omega3 != 0, fast, *numbers)

    return where_valid(fast_if_spinning, top, theta=theta, omega3=omega3)


# Long: eight arguments, of which two say the same and one may be a word.
def initial_state(
    top: SymmetricTop,
    theta: ScalarLike,
    *,
    psi_dot: ScalarLike | None = None,
    omega3: ScalarLike | None = None,
    phi_dot: ScalarLike | Literal["slow", "fast"] = 0.0,
    theta_dot: ScalarLike = 0.0,
    phi: ScalarLike = 0.0,
    psi: ScalarLike = 0.0,
    throw: bool = True,
) -> State:
    """State of a top from its Euler angles and their rates.

    By default the axis is released from rest, with a spin psi' = omega3. Pass either
    `psi_dot` or `omega3`, or neither for no spin (omega3 = 0).

    Args:
        top: The top.
        theta: Tilt of the axis from the vertical, from 0 to pi [rad].
        psi_dot: Spin about the axis relative to the precession [rad/s].
        omega3: Third component of the angular velocity, psi' + phi' cos theta [rad/s].
        phi_dot: Precession [rad/s], or "slow" or "fast" for that of steady precession
            with the given spin (see `steady_precession`).
        theta_dot: Rate of the tilt [rad/s].
        phi: Azimuth of the axis, from -y towards +x [rad].
        psi: Angle about the axis [rad].
        throw: With False, bad values give NaN instead of an error.

    Returns:
        Attitude and angular velocity.

    Raises:
        ValueError: psi_dot and omega3 are both given.
        RuntimeError: The tilt is outside of its range, a value is not finite, the spin
            is too small for steady precession, or the fast precession of a level axis
            is requested, which is infinite.

    Gradients: analytic. For a steady precession they include those of its rate.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> state = jr.top.initial_state(top, 0.5, omega3=6.0, phi_dot="slow")
    >>> print(state.omega.round(4))
    [0.     0.1795 6.    ]
    """
    check_type("top", top, SymmetricTop)
    if psi_dot is not None and omega3 is not None:
        raise ValueError(
            "Argument `psi_dot` must be None where `omega3` is given, but it is not."
        )
    spin_name, spin = ("omega3", omega3) if psi_dot is None else ("psi_dot", psi_dot)
    steady = isinstance(phi_dot, str)
    arguments = {
        "theta": theta,
        spin_name: 0.0 if spin is None else spin,
        "phi_dot": 0.0 if steady else phi_dot,
        "theta_dot": theta_dot,
        "phi": phi,
        "psi": psi,
    }
    by_name = {name: (x,) for name, x in (vars(top) | arguments).items()}
    numbers = shaped(**by_name)
    findings = Findings()
    findings.require(top.is_valid, RESULTS.invalid_top, value=jnp.stack(numbers[:3]))
    for name, value in zip(arguments, numbers[3:], strict=True):
        _require_in_domain(findings, name, value)
    i1, i3, mgl, theta, spin, rate, theta_dot, phi, psi = harmless(findings.ok, numbers)
    if steady:
        check_option("phi_dot", phi_dot, ("slow", "fast"))
        slow, fast = _steady(i1, i3, mgl, theta, spin, of_psi=psi_dot is not None)
        rate = slow if phi_dot == "slow" else fast
        too_slow = _TOO_SLOW.format(spin_name)
        findings.require(~jnp.isnan(rate), RESULTS.invalid_state, too_slow, spin)
        findings.require(~jnp.isinf(rate), RESULTS.invalid_state, _LEVEL, theta)
        # A rate that does not exist is NaN, which must not reach the derivatives of
        # other lanes.
        rate = harmless(findings.ok, rate)
    angles = jnp.stack([phi, theta, psi])
    omega = euler_rates_to_omega(angles, jnp.stack([rate, theta_dot, spin]))
    if psi_dot is None:
        # Only the third component depends on psi', for which omega3 was passed above.
        omega = omega.at[2].set(spin)
    return findings.guard(State(from_euler(angles), omega), throw)


def _require_in_domain(findings: Findings, name: str, value: Array) -> None:
    """Note whether an argument of `initial_state` is out of its domain."""
    if name == "theta":
        in_domain = (value >= -_ROUNDING) & (value <= jnp.pi + _ROUNDING)
        message = _BAD_TILT
    else:
        in_domain = jnp.isfinite(value)
        message = f"Argument `{name}` must be finite, but it is not."
    findings.require(in_domain, RESULTS.invalid_state, message, value)
