"""Rates of an attitude, angular velocity, and dead reckoning from gyro samples."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from jaxtyping import ArrayLike as _ArrayLike

from jrigid._checks import all_finite, is_unit, shaped, where_defined
from jrigid._core.compile import one_program
from jrigid._types import (
    MatrixLike,
    Quaternion,
    QuaternionLike,
    Real,
    Vector,
    VectorLike,
)
from jrigid.rotation._forms import vee
from jrigid.rotation._quaternion import exp, multiply, normalize


@one_program
def attitude_rate(attitude: QuaternionLike, omega: VectorLike) -> Quaternion:
    """Time derivative of the attitude quaternion: q' = q (0, omega) / 2.

    Args:
        attitude: Unit quaternion, body to space.
        omega: Angular velocity, body components [rad/s].

    Returns:
        q' [1/s].

    Gradients: bilinear, finite everywhere.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> q = jnp.array([0.6, 0.0, 0.0, 0.8])
    >>> print(jr.rotation.attitude_rate(q, jnp.array([2.0, 4.0, 6.0])).round(6))
    [-2.4 -1.   2.   1.8]
    """
    (w, x, y, z), (a, b, c) = shaped(attitude=(attitude, 4), omega=(omega, 3))
    # No two sums are built alike: LLVM merges such sums into one whose operands are
    # chosen lane by lane, and then does not vectorise it.
    return 0.5 * jnp.stack(
        [
            -x * a - y * b - z * c,
            w * a + y * c - z * b,
            w * b - x * c + z * a,
            x * b - y * a + w * c,
        ]
    )


@one_program
def angular_velocity(rotation: MatrixLike, rotation_rate: MatrixLike) -> Vector:
    """Angular velocity in body components from a rotation matrix and its rate.

    `hat(omega) = R^T R'`; the space components are `vee(R' R^T)`, which is R omega.

    Args:
        rotation: Rotation matrix R, body to space.
        rotation_rate: R' [1/s].

    Returns:
        omega [rad/s], body components.

    Gradients: bilinear, finite everywhere.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> spin = jnp.array([0.0, 0.0, 2.0])
    >>> turned = lambda t: jr.rotation.to_matrix(jr.rotation.exp(spin * t))
    >>> R, dR = jax.jvp(turned, (0.3,), (1.0,))
    >>> print(jr.rotation.angular_velocity(R, dR).round(5))
    [0. 0. 2.]
    """
    r, dr = shaped(rotation=(rotation, 3, 3), rotation_rate=(rotation_rate, 3, 3))
    # A sum, not a dot, which a GPU may round to ten bits in float32.
    return vee(jnp.sum(r[:, :, None] * dr[:, None, :], axis=0))


@one_program
def euler_rates_to_omega(angles: VectorLike, rates: VectorLike) -> Vector:
    """Body components of the angular velocity from z-x-z Euler angles and their rates.

    Args:
        angles: (phi, theta, psi) [rad].
        rates: (phi', theta', psi') [rad/s].

    Returns:
        omega [rad/s]: (phi' sin theta sin psi + theta' cos psi,
        phi' sin theta cos psi - theta' sin psi, psi' + phi' cos theta).

    Gradients: analytic everywhere.
    Source: Goldstein, Classical Mechanics, 3rd ed., eq. 4.87.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> angles, rates = jnp.array([0.0, 0.0, 0.0]), jnp.array([1.0, 2.0, 3.0])
    >>> print(jr.rotation.euler_rates_to_omega(angles, rates))
    [2. 0. 4.]
    """
    (_, theta, psi), (dphi, dtheta, dpsi) = shaped(angles=(angles, 3), rates=(rates, 3))
    s = jnp.sin(psi)
    c = jnp.cos(psi)
    horizontal = dphi * jnp.sin(theta)
    return jnp.stack(
        [
            horizontal * s + dtheta * c,
            horizontal * c - dtheta * s,
            dpsi + dphi * jnp.cos(theta),
        ]
    )


@one_program
def omega_to_euler_rates(angles: VectorLike, omega: VectorLike) -> Vector:
    """Rates of the z-x-z Euler angles from the angular velocity in body components.

    Where theta is a multiple of pi to rounding, phi and psi turn about the same axis.
    Then psi' is 0, and phi' carries the turning about the vertical. The part of omega
    that no rates can express is dropped.

    Args:
        angles: (phi, theta, psi) [rad].
        omega: Angular velocity, body components [rad/s].

    Returns:
        (phi', theta', psi') [rad/s].

    Gradients: exact for sin theta != 0; at the poles those of the choice, finite.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> angles, rates = jnp.array([0.1, 0.7, 2.0]), jnp.array([1.0, 2.0, 3.0])
    >>> omega = jr.rotation.euler_rates_to_omega(angles, rates)
    >>> print(jr.rotation.omega_to_euler_rates(angles, omega).round(6))
    [1. 2. 3.]
    """
    (_, theta, psi), (a, b, c) = shaped(angles=(angles, 3), omega=(omega, 3))
    sine = jnp.sin(theta)
    # sin(pi) is 1.2e-16 in floating point: at the pole theta is the float that is
    # closest to it.
    at_pole = jnp.abs(sine) <= 0.5 * jnp.finfo(sine.dtype).eps * jnp.abs(theta)
    horizontal = a * jnp.sin(psi) + b * jnp.cos(psi)
    divisor = jnp.where(at_pole, 1.0, sine)
    dphi = jnp.where(at_pole, c * jnp.cos(theta), horizontal / divisor)
    dtheta = a * jnp.cos(psi) - b * jnp.sin(psi)
    dpsi = jnp.where(at_pole, 0.0, c - dphi * jnp.cos(theta))
    return jnp.stack([dphi, dtheta, dpsi])


@one_program
def integrate_rate(
    ts: Real[_ArrayLike, " samples"],
    omegas: Real[_ArrayLike, "samples 3"],
    attitude0: QuaternionLike | None = None,
) -> Float[Array, "samples 4"]:
    r"""Dead-reckon an attitude from sampled gyro rates, to fourth order.

    The rotation is the time-ordered exponential of omega, with new increments on the
    right. Between two samples omega is the cubic through the four nearest ones. The
    increment is the fourth-order Magnus expansion, which corrects for coning, with the
    rates a, b at the two Gauss points:
    $q \to q \exp(h (a + b) / 2 + \sqrt{3} h^2 (a \times b) / 12)$.

    Args:
        ts: Times of two or more samples [s], increasing, not necessarily uniform.
        omegas: Angular velocity at these times, body components [rad/s].
        attitude0: Unit quaternion at the first sample; the identity by default.

    Returns:
        Attitude at each sample, with samples h apart to an error of O(h^4) over a fixed
        span; all NaN unless `ts` is finite and increasing, `omegas` finite and
        `attitude0` of norm 1.

    Gradients: finite everywhere; zero in a record of NaN.
    Source: A. Iserles et al., Lie-group methods, Acta Numerica 9 (2000) 215, section 5
    (for R' = hat(omega) R; the sign of the commutator is the opposite for body rates).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> ts = jnp.linspace(0.0, 1.0, 11)
    >>> omegas = jnp.stack([jnp.zeros(11), jnp.zeros(11), 2 * ts], axis=1)
    >>> attitudes = jr.rotation.integrate_rate(ts, omegas)
    >>> print(jr.rotation.log(attitudes[-1]).round(5))
    [0. 0. 1.]
    """
    start = np.array([1, 0, 0, 0]) if attitude0 is None else attitude0
    vectors = (omegas, *np.shape(ts), 3)
    ts, omegas, start = shaped(ts=(ts, None), omegas=vectors, attitude0=(start, 4))
    if ts.shape[0] < 2:
        raise ValueError(
            "Argument `ts` must hold at least two samples, but it has shape "
            f"{ts.shape}."
        )
    step = ts[1:] - ts[:-1]
    # Then every time is finite, too.
    is_increasing = jnp.all((step > 0) & jnp.isfinite(step))
    ok = is_increasing & all_finite(omegas) & is_unit(start)
    return where_defined(ok, _dead_reckon, ts, omegas, start)


# Jitted for eager callers, for which each level of the scan would be compiled apart.
@jax.jit
def _dead_reckon(
    ts: Float[Array, " samples"],
    omegas: Float[Array, "samples 3"],
    start: Quaternion,
) -> Float[Array, "samples 4"]:
    """The attitudes of `integrate_rate`, of valid arguments."""
    # Between samples i and i + 1 the cubic goes through i - 1 to i + 2, at the ends of
    # the record through the first four or the last four samples.
    count = ts.shape[0]
    width = min(4, count)
    first = jnp.clip(jnp.arange(count - 1) - (width - 2) // 2, 0, count - width)
    window = first[:, None] + jnp.arange(width)[None, :]
    step = ts[1:] - ts[:-1]
    # Times from the middle of the step, in units of it. Differences come first, so that
    # an epoch far from zero costs no digits.
    nodes = (ts[window] - ts[:-1, None]) / step[:, None] - 0.5

    def interpolate(place: float) -> Array:
        weights = jax.vmap(_lagrange_weights, in_axes=(0, None))(nodes, place)
        # A sum, not a dot, which a GPU may round to ten bits in float32.
        return jnp.sum(weights[:, :, None] * omegas[window], axis=1)

    gauss = 3**-0.5 / 2
    a = interpolate(-gauss)
    b = interpolate(gauss)
    h = step[:, None]
    turns = 0.5 * h * (a + b) + (3**0.5 / 12) * h * h * jnp.cross(a, b)
    quaternions = jnp.concatenate([start[None], jax.vmap(exp)(turns)])
    # The product is associative, so a scan of logarithmic depth serves a long record.
    products = jax.lax.associative_scan(jax.vmap(multiply), quaternions)
    # The norm drifts by rounding in each of the products.
    return jax.vmap(normalize)(products)


def _lagrange_weights(
    nodes: Float[Array, " nodes"], place: float
) -> Float[Array, " nodes"]:
    """Weights of values at the nodes in the polynomial through them, at a place."""
    count = nodes.shape[0]
    others = ~jnp.eye(count, dtype=bool)
    numerator = jnp.where(others, place - nodes[None, :], 1.0)
    denominator = jnp.where(others, nodes[:, None] - nodes[None, :], 1.0)
    return jnp.prod(numerator / denominator, axis=1)
