"""Starts and special motions of the symmetric top: steady, sleeping, fast."""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jrigid._checks import RESULTS, Findings, all_finite, check_option, check_shape, nan_where
from jrigid._numerics import root_of_positive
from jrigid._types import Scalar, ScalarLike
from jrigid.dynamics import State
from jrigid.rotation import euler_rates_to_omega, from_euler
from jrigid.top._top import SymmetricTop, as_arrays, require_top

_NO_STEADY = (
    "Arguments `omega3` or `psi_dot` must be large enough for steady precession at `theta`, at one "
    "rate that is finite, but they are not: see `steady_precession`."
)


class SteadyPrecession(NamedTuple):
    """The two rates at which a top precesses at a constant tilt.

    Attributes:
        slow: The one of smaller magnitude [rad/s], mgl / (I3 omega3) for fast spin.
        fast: The other [rad/s], I3 omega3 / (I1 cos theta) for fast spin; infinite with the axis
            level, where there is one rate only.
        exists: Whether the spin is fast enough; the rates are NaN where not.
    """

    slow: Scalar
    fast: Scalar
    exists: Bool[Array, ""]


class Gyroscopic(NamedTuple):
    """The fast top, to leading order in mgl I1 / (I3 omega3)^2.

    Attributes:
        precession: Mean rate of precession mgl / (I3 omega3) [rad/s].
        nutation: Angular frequency of nutation I3 omega3 / I1 [rad/s].
        amplitude: By how much a top released from rest falls before it rises again [rad],
            2 mgl I1 sin theta / (I3 omega3)^2.
    """

    precession: Scalar
    nutation: Scalar
    amplitude: Scalar


def _steady(
    i1: Array, i3: Array, mgl: Array, theta: Array, spin: Array, *, of_psi: bool
) -> tuple[Array, Array, Array]:
    momentum = i3 * spin
    # psi' = omega3 - p cos(theta) in place of omega3 takes I3 off I1.
    i1 = i1 - i3 if of_psi else i1
    eps = jnp.finfo(theta.dtype).eps
    cos = jnp.cos(theta)
    # Level within rounding there is one rate.
    level = (jnp.abs(cos) <= 4 * eps) | (i1 == 0)
    slant = jnp.where(level, 0.0, i1 * cos)
    square = momentum * momentum - 4 * slant * mgl
    root = root_of_positive(square)
    total = momentum + jnp.where(momentum < 0, -root, root)
    still = total == 0
    slow = jnp.where(still, 0.0, 2 * mgl / jnp.where(still, 1.0, total))
    fast = 0.5 * total / jnp.where(level, 1.0, slant)
    fast = jnp.where(level, jnp.where(total < 0, -jnp.inf, jnp.inf), fast)
    # At the threshold itself the square is zero to rounding only.
    exists = (square >= -8 * eps * momentum * momentum) & (~still | (mgl == 0))
    return slow, fast, exists


def steady_precession(
    top: SymmetricTop,
    theta: ScalarLike,
    omega3: ScalarLike | None = None,
    *,
    psi_dot: ScalarLike | None = None,
    throw: bool = True,
) -> SteadyPrecession:
    """The rates at which a top may precess at a constant tilt.

    They solve I1 cos(theta) p^2 - I3 omega3 p + mgl = 0, which has solutions if (I3 omega3)^2 >=
    4 I1 mgl cos theta: above the horizontal a top needs spin, below it none.

    Args:
        top: The top.
        theta: Tilt of the axis from the vertical [rad].
        omega3: Third component of the angular velocity, psi' + phi' cos theta [rad/s]; or
        psi_dot: spin about the axis, as seen by one who precesses with it [rad/s]; one of the two.
            Then I1 - I3 takes the place of I1.
        throw: False: bad values give NaN instead of an error.

    Returns:
        Both rates, and whether there are any.

    Raises:
        ValueError: Wrong shape; omega3 and psi_dot both given, or neither (trace time).
        RuntimeError: Bad value (run time, any lane). Too little spin is none: see `exists`.

    Gradients: right where the two rates differ; where they meet, without the infinite part.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 5.7.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> rates = jr.top.steady_precession(jr.SymmetricTop(1.0, 0.5, 1.0), jnp.pi / 3, 6.0)
    >>> print(rates.slow.round(6), rates.fast.round(6), rates.exists)
    0.354249 5.645751 True
    """
    spin = psi_dot if omega3 is None else omega3
    if spin is None or (omega3 is not None and psi_dot is not None):
        raise ValueError("One of the arguments `omega3` and `psi_dot` must be given, and one only.")
    findings, values = _checked(top, theta, spin)
    slow, fast, exists = _steady(*findings.apply(values, throw), of_psi=omega3 is None)
    exists = exists & findings.ok
    slow, fast = nan_where(~exists, (slow, fast))
    return SteadyPrecession(slow, fast, exists)


def _checked(top: SymmetricTop, *angle_and_spin: ScalarLike) -> tuple[Findings, tuple[Array, ...]]:
    i1, i3, mgl, *values = as_arrays(top, *angle_and_spin)
    for name, value in zip(("theta", "omega3"), values, strict=False):
        check_shape(name, value, ())
    findings = Findings()
    require_top(findings, SymmetricTop(i1, i3, mgl))
    findings.require(
        all_finite(tuple(values)),
        RESULTS.invalid_state,
        "Arguments `theta` and `omega3` must be finite, but one is not.",
    )
    one = jnp.ones_like(i1)
    return findings, tuple(jnp.where(findings.ok, x, one) for x in (i1, i3, mgl, *values))


def sleeping_spin(top: SymmetricTop, *, throw: bool = True) -> Scalar:
    """Spin above which a top stands upright stably, 2 sqrt(mgl I1) / I3.

    Args:
        top: The top.
        throw: False: bad values give NaN instead of an error.

    Returns:
        |omega3| at the threshold [rad/s]; 0 if mgl <= 0: such a top hangs.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value (run time, any lane).

    Gradients: right for mgl > 0; zero at mgl <= 0.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 5.7.

    >>> import jrigid as jr
    >>> print(jr.top.sleeping_spin(jr.SymmetricTop(1.0, 0.5, 1.0)))
    4.0
    """
    findings, values = _checked(top)
    i1, i3, mgl = findings.apply(values, throw)
    falls = mgl > 0
    spin = 2 * jnp.sqrt(i1 * jnp.where(falls, mgl, 1.0)) / i3
    return nan_where(~findings.ok, jnp.where(falls, spin, 0.0))


def gyroscopic(
    top: SymmetricTop, theta: ScalarLike, omega3: ScalarLike, *, throw: bool = True
) -> Gyroscopic:
    """The textbook's fast top, to compare with the exact one.

    The exact values are `mean_precession`, `nutation_period` and `nutation_bounds`.

    Args:
        top: The top.
        theta: Tilt of the axis from the vertical at which it is released [rad].
        omega3: Third component of the angular velocity, not zero [rad/s].
        throw: False: bad values give NaN instead of an error.

    Returns:
        Precession, nutation and the amplitude of nutation, with relative errors of the order of
        mgl I1 / (I3 omega3)^2.

    Raises:
        ValueError: Wrong shape (trace time).
        RuntimeError: Bad value, no spin (run time, any lane).

    Gradients: analytic.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 5.7.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> fast = jr.top.gyroscopic(jr.SymmetricTop(1.0, 0.5, 1.0), jnp.pi / 6, 100.0)
    >>> print(fast.precession, fast.nutation, fast.amplitude.round(5))
    0.02 50.0 0.0004
    """
    findings, values = _checked(top, theta, omega3)
    spins = values[-1] != 0
    findings.require(spins, RESULTS.invalid_state, "Argument `omega3` must not be zero, but it is.")
    i1, i3, mgl, tilt, spin = findings.apply(values, throw)
    momentum = i3 * jnp.where(spins, spin, 1.0)
    fall = 2 * mgl * i1 * jnp.sin(tilt) / (momentum * momentum)
    found = Gyroscopic(mgl / momentum, momentum / i1, fall)
    return nan_where(~findings.ok, found)


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
    """A state from what people say of a top: its angles and their rates.

    With the defaults, released from rest at a tilt with a spin psi' = omega3.

    Args:
        top: The top.
        theta: Tilt of the axis from the vertical [rad].
        psi_dot: Spin about the axis, as seen by one who precesses with it [rad/s]; or
        omega3: third component of the angular velocity, psi' + phi' cos theta [rad/s]; one of the
            two, or neither for no spin (omega3 = 0).
        phi_dot: Precession [rad/s], or "slow" or "fast" for that of steady precession with the
            given spin (see `steady_precession`).
        theta_dot: Rate of the tilt [rad/s].
        phi: Azimuth of the axis, from -y towards +x [rad].
        psi: Angle about the axis [rad].
        throw: False: bad values give NaN instead of an error.

    Returns:
        Attitude and angular velocity.

    Raises:
        ValueError: Wrong shape, psi_dot and omega3 both given (trace time).
        RuntimeError: Bad value, or too little spin for steady precession (run time, any lane).

    Gradients: analytic; of a steady precession those of its rate.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(1.0, 0.5, 1.0)
    >>> state = jr.top.initial_state(top, 0.5, omega3=6.0, phi_dot="slow")
    >>> print(state.omega.round(4))
    [0.     0.1795 6.    ]
    """
    if psi_dot is not None and omega3 is not None:
        raise ValueError("Argument `psi_dot` must be None where `omega3` is given, but it is not.")
    steady = phi_dot if isinstance(phi_dot, str) else None
    if steady is not None:
        check_option("phi_dot", steady, ("slow", "fast"))
    spin = 0.0 if psi_dot is None and omega3 is None else (omega3 if psi_dot is None else psi_dot)
    rate = 0.0 if steady is not None else phi_dot
    i1, i3, mgl, *values = as_arrays(top, theta, spin, rate, theta_dot, phi, psi)
    names = (
        "theta",
        "psi_dot" if omega3 is None else "omega3",
        "phi_dot",
        "theta_dot",
        "phi",
        "psi",
    )
    for name, value in zip(names, values, strict=True):
        check_shape(name, value, ())
    findings = Findings()
    require_top(findings, SymmetricTop(i1, i3, mgl))
    findings.require(
        all_finite(tuple(values)),
        RESULTS.invalid_state,
        "The angles and rates of a top must be finite, but one is not.",
    )
    ok = findings.ok
    i1, i3, mgl = (jnp.where(ok, x, 1.0) for x in (i1, i3, mgl))
    theta, spin, rate, theta_dot, phi, psi = (jnp.where(ok, x, 0.0) for x in values)
    if steady is not None:
        slow, fast, exists = _steady(i1, i3, mgl, theta, spin, of_psi=psi_dot is not None)
        rate = slow if steady == "slow" else fast
        findings.require(
            exists & jnp.isfinite(jax.lax.stop_gradient(rate)), RESULTS.invalid_state, _NO_STEADY
        )
        rate = jnp.where(findings.ok, rate, 0.0)
    angles = jnp.stack([phi, theta, psi])
    omega = euler_rates_to_omega(angles, jnp.stack([rate, theta_dot, spin]))
    if psi_dot is None:
        omega = omega.at[2].set(spin)
    state = State(from_euler(angles), omega)
    return findings.apply(nan_where(~findings.ok, state), throw)
