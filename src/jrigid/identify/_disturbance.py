"""The unmodelled torque: what it adds to a body's angular momentum between two nodes.

Along each body axis it is a Gauss-Markov process (Ornstein-Uhlenbeck) with a
correlation time. White torque is the limit of correlation time zero. The torque at each
node, in units of its rms, is part of the smoother's state.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, ArrayLike

from jrigid._numerics import product
from jrigid._types import AnyArray, Real
from jrigid.identify._smoother import Links, Rows

# Steps, in correlation times, beyond which the torque counts as white, or as constant,
# by the size of the dtype in bytes. Over `MOST_NODES` of the shortest steps a torque in
# float64 changes by 6 % of its rms. In float32 the gaps of shorter steps, which are
# whitened by what little such a torque adds at random, would be rounding errors.
_LONGEST = 1e6
_SHORTEST = {8: 1e-6, 4: 1e-4}
# Points of a quadrature that is exact to rounding for steps below a correlation time.
_POINTS = 8
_TERMS = 18  # of a series that is exact to rounding for the same steps


class GaussMarkov(eqx.Module):
    """A random torque along the body axes, for `fit(unmodelled=...)`.

    Its spectral density is level^2 at low frequencies, and half of that at 1 / time
    [rad/s]. The rms of the torque is level / sqrt(2 time). A time of zero means white
    torque. A time above a million steps (in float32 ten thousand) counts as so many
    steps, of a torque with the same rms.

    Args:
        level: Root of the spectral density [N m sqrt(s)], for all axes or for each.
        time: Correlation time [s], for all axes or for each.

    Source: R. A. Singer, "Estimating optimal tracking filter performance for manned
    maneuvering targets", IEEE Transactions on Aerospace and Electronic Systems 6 (1970)
    473.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> torque = jr.identify.GaussMarkov(level=1e-3, time=0.5)
    >>> result = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings, unmodelled=torque)
    >>> print(result.correlation_time)
    [0.5 0.5 0.5]
    """

    level: AnyArray
    time: AnyArray

    def __init__(
        self, level: Real[ArrayLike, "..."], time: Real[ArrayLike, "..."] = 0.0
    ):
        """Broadcast both arguments to three axes."""
        self.level = np.broadcast_to(np.asarray(level, float), 3)
        self.time = np.broadcast_to(np.asarray(time, float), 3)


class Disturbance(NamedTuple):
    """The unmodelled torque of a fit.

    Attributes:
        level: Root of its spectral density at low frequencies, in each trial along each
            axis (trials, 3) [N m sqrt(s)].
        time: Correlation time along each axis (3,) [s].
    """

    level: AnyArray
    time: AnyArray


class Push(NamedTuple):
    """Change of the state over each link that is due to the torque.

    The state has rates, turns if it has an attitude, and the torque.

    Attributes:
        covariance: Covariance of the random part (trials, nodes, local, local).
        whitener: Matrix that turns the random part into independent numbers of unit
            variance; zero where there is no link.
        carried: Derivative of the state at the end in the torque at the start, in units
            of its rms (trials, nodes, local, 3).
    """

    covariance: Array
    whitener: Array
    carried: Array


def _torque_over_a_step(steps: Array) -> tuple[Array, Array]:
    """Covariance of momentum, its integral and the torque, and their response to it.

    Args:
        steps: Lengths in correlation times.

    Returns:
        Covariance (..., 3, 3) of what is added at random, and response (..., 3) to the
        torque at the start. Units are level dt^(1/2) for the momentum, level dt^(3/2)
        for its integral and the rms for the torque.
    """
    a = jnp.clip(steps, _SHORTEST[steps.dtype.itemsize], _LONGEST)
    x = -jnp.expm1(-a)
    root = jnp.sqrt(2 * a)
    is_short = a < 1
    short_a = jnp.where(is_short, a, 1.0)
    short = _covariance_of_short_steps(short_a)
    long = _covariance_of_long_steps(a, x, root)
    covariance = jnp.where(is_short[..., None, None], short, long)
    # The torque fades as exp(-t / time). These are its integral, the integral of that,
    # and its value after the step, from a torque of one rms at its start.
    second = jnp.where(is_short, _integral_of_fading(short_a), (a - x) / a) / root
    response = jnp.stack([x / root, second, 1 - x], axis=-1)
    return covariance, response


def _integral_of_fading(z: Array) -> Array:
    """1 - (1 - exp(-z)) / z for z from 0 to 1, the mean of 1 - exp(-s) up to z."""
    # The terms of the formula cancel at small z. Those of its power series do not.
    series = jnp.ones_like(z)
    for n in range(_TERMS, 2, -1):
        series = 1 - z / n * series
    return 0.5 * z * series


def _covariance_of_short_steps(a: Array) -> Array:
    """Covariance over steps of lengths a, at most 1, by quadrature."""
    points, weights = np.polynomial.legendre.leggauss(_POINTS)
    # Responses to a kick that came a fraction r of the step before its end.
    r = jnp.asarray(0.5 + 0.5 * points, a.dtype)
    r = jnp.broadcast_to(r, (*a.shape, r.size))
    z = a[..., None] * r
    torque = jnp.sqrt(2 * a)[..., None] * jnp.exp(-z)
    responses = jnp.stack([-jnp.expm1(-z), r * _integral_of_fading(z), torque], axis=-1)
    weights = jnp.asarray(0.5 * weights, a.dtype)
    return product("r,...ri,...rj->...ij", weights, responses, responses)


def _covariance_of_long_steps(a: Array, x: Array, root: Array) -> Array:
    """Covariance over steps of lengths a; x is 1 - exp(-a), root that of 2 a.

    These are the same integrals in closed form, which loses its digits in short steps.
    """
    # Each entry is the integral over r of a product of two of the responses to a kick.
    momentum = (2 * a - 2 * x - x**2) / (2 * a)
    across = (a - x) ** 2 / (2 * a**2)
    integral = (x * (2 - x) - 2 * a - 2 * a**2 + 2 * a**3 / 3 + 4 * a * x) / (2 * a**3)
    with_torque = x**2 / root
    integral_with_torque = (x * (2 - x) - 2 * a * (1 - x)) / (root * a)
    torque = x * (2 - x)
    rows = [
        [momentum, across, with_torque],
        [across, integral, integral_with_torque],
        [with_torque, integral_with_torque, torque],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def push_of(
    disturbance: Disturbance,
    span: Array,
    linked: Array,
    tensor: Array,
    depends_on_attitude: bool,
) -> Push:
    """Return what the torque adds over links.

    Args:
        disturbance: The torque.
        span: Length of each link (trials, nodes) [s].
        linked: Whether there is a link.
        tensor: Inertia.
        depends_on_attitude: Whether the state has an attitude.
    """
    # Nodes without a link have a length too, so that no division by zero occurs.
    dt = jnp.where(linked, span, 1.0)
    time = jnp.maximum(disturbance.time, jnp.finfo(dt.dtype).tiny)
    steps = jnp.minimum(dt[..., None] / time[None, None], _LONGEST)
    covariance, response = _torque_over_a_step(steps)
    # Rates, turns and torques, of which the state may have no turns.
    kinds = [0, 1, 2] if depends_on_attitude else [0, 2]
    entries = [[covariance[..., i, j] for j in kinds] for i in kinds]
    # How the motion changes a kick within a link is neglected. Links are short: each
    # reading has a node, up to `MOST_NODES`.
    level = disturbance.level[:, None, :] * jnp.sqrt(dt)[..., None]
    # A correlation time that is shortened keeps the rms of the torque, not its level.
    shortened = jnp.minimum(steps / _SHORTEST[steps.dtype.itemsize], 1.0)
    level = level * jnp.sqrt(shortened)
    # These turn the units of `_torque_over_a_step` into SI units, except for the
    # torque, which stays in units of its rms.
    units = [level, level * dt[..., None], jnp.ones_like(level)]
    units = [units[i] for i in kinds]
    # Angular momentum over inertia is a rate; a torque stays as it is.
    eye = jnp.eye(3, dtype=dt.dtype)
    momentum = [tensor] * (len(kinds) - 1) + [eye]
    rates = [jnp.linalg.inv(tensor)] * (len(kinds) - 1) + [eye]
    carried = [
        product("ab,...b->...ab", rate, unit * response[..., kind])
        for rate, unit, kind in zip(rates, units, kinds, strict=True)
    ]
    is_link = linked.astype(dt.dtype)[..., None, None]
    return Push(
        covariance=is_link * _covariance_matrix(entries, units, rates),
        whitener=is_link * _whitening_matrix(entries, units, momentum),
        carried=is_link * jnp.concatenate(carried, axis=-2),
    )


def _covariance_matrix(
    entries: list[list[Array]], units: list[Array], rates: list[Array]
) -> Array:
    """Covariance of rates, turns and torques.

    Args:
        entries: Covariance of each pair of kinds along each axis (..., 3).
        units: Their units along each axis.
        rates: Matrices that turn momenta into rates, of each kind.
    """

    def block(i: int, j: int) -> Array:
        size = units[i] * entries[i][j] * units[j]
        return product("ak,...k,bk->...ab", rates[i], size, rates[j])

    return _assembled(block, len(units))


def _whitening_matrix(
    entries: list[list[Array]], units: list[Array], momentum: list[Array]
) -> Array:
    """Matrix that makes the same covariance the unit matrix.

    Args:
        entries: Covariance of each pair of kinds along each axis (..., 3).
        units: Their units along each axis.
        momentum: Matrices that turn rates into momenta, of each kind.
    """
    # Along each axis the kinds are correlated, but the axes are not.
    inverse = _inverse_cholesky(entries)

    def block(i: int, j: int) -> Array:
        return product("...a,ab->...ab", inverse[i][j] / units[j], momentum[j])

    return _assembled(block, len(units))


def _assembled(block: Callable[[int, int], Array], count: int) -> Array:
    """A matrix of `count` by `count` blocks."""
    kinds = range(count)
    rows = [jnp.concatenate([block(i, j) for j in kinds], axis=-1) for i in kinds]
    return jnp.concatenate(rows, axis=-2)


def _inverse_cholesky(matrix: list[list[Array]]) -> list[list[Array]]:
    """Inverse of the Cholesky factor of a small matrix, whose entries are arrays."""
    # Written out for matrices of two or three rows, where LAPACK would be called once
    # for each link.
    size = len(matrix)
    zero = jnp.zeros_like(matrix[0][0])
    lower = [[zero] * size for _ in range(size)]
    inverse = [[zero] * size for _ in range(size)]
    for i in range(size):
        for j in range(i + 1):
            rest = matrix[i][j] - sum(lower[i][k] * lower[j][k] for k in range(j))
            lower[i][j] = jnp.sqrt(rest) if i == j else rest / lower[j][j]
        inverse[i][i] = 1 / lower[i][i]
        for j in range(i):
            off_diagonal = sum(lower[i][k] * inverse[k][j] for k in range(j, i))
            inverse[i][j] = -off_diagonal / lower[i][i]
    return inverse


def with_torque(
    rows: Rows, links: Links, push: Push, torque: Array
) -> tuple[Rows, Links]:
    """Rows and links of states that hold the torque too.

    Args:
        rows: Rows of states without the torque.
        links: Links between them.
        push: What the torque adds over each link.
        torque: Torque at each node (trials, nodes, 3), in units of its rms.
    """
    local = links.gap.shape[-1]
    linked = jnp.any(push.whitener != 0, axis=(-2, -1))[..., None]
    # The last node has no link: `roll` would bring it the torque of the first one.
    next_torque = jnp.where(linked, jnp.roll(torque, -1, axis=1), 0.0)
    gap = jnp.pad(links.gap, [(0, 0), (0, 0), (0, 3)])
    gap = gap + product("tnij,tnj->tni", push.carried, torque)
    # The gap of the torque: what is left of it at the end, less the next one.
    gap = gap.at[..., local:].add(-next_torque)
    three_rows = [(0, 0), (0, 0), (0, 3), (0, 0)]
    of_state = jnp.pad(links.of_state, three_rows)
    links = Links(
        gap=gap,
        of_border=jnp.pad(links.of_border, three_rows),
        of_state=jnp.concatenate([of_state, push.carried], axis=-1),
        torque=torque[:, 0],
    )
    rows_of_state = jnp.pad(rows.of_state, [(0, 0), (0, 0), (0, 0), (0, 3)])
    return rows._replace(of_state=rows_of_state), links


def no_disturbance(trials: int, dtype: DTypeLike) -> Disturbance:
    """White torque of level one, which fits without an unmodelled torque ignore."""
    return Disturbance(np.ones((trials, 3), dtype), np.zeros(3, dtype))
