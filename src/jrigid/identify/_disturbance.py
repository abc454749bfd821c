"""A torque that no model has: what it adds to the body's momentum between two nodes.

Along each body axis it is a Gauss-Markov process (Ornstein-Uhlenbeck), which forgets
itself within a correlation time; white torque is the limit of none. Its value at each
node, in units of its rms, is one more state of the smoother.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jrigid._numerics import product
from jrigid._types import AnyArray
from jrigid.identify._smoother import Links, Rows

# Steps, in correlation times, beyond which the torque counts as white, or as constant.
_LONGEST, _SHORTEST = 1e6, 1e-4
_POINTS = (
    8  # of a quadrature that is exact to rounding for steps below a correlation time
)


class GaussMarkov(eqx.Module):
    """A random torque along the body axes, for `fit(unmodelled=...)`.

    Its spectral density is level^2 at low frequencies, and half of that at 1 / time
    [rad/s]; the rms of the torque is level / sqrt(2 time). A time of zero is white
    torque.

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
    >>> found = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings, unmodelled=torque)
    >>> print(found.correlation_time)
    [0.5 0.5 0.5]
    """

    level: AnyArray
    time: AnyArray

    def __init__(self, level: Any, time: Any = 0.0):
        """Repeat what is given for all axes."""
        self.level = np.broadcast_to(np.asarray(level, float), 3)
        self.time = np.broadcast_to(np.asarray(time, float), 3)


class Disturbance(NamedTuple):
    """The torque of a fit.

    Attributes:
        level: Root of its spectral density at low frequencies, of each trial about each
            axis (trials, 3) [N m sqrt(s)].
        time: Correlation time about each axis (3,) [s].
    """

    level: AnyArray
    time: AnyArray


class Push(NamedTuple):
    """What the torque does over each link, in rates and turns.

    Attributes:
        covariance: Of what it adds at random (trials, nodes, local, local).
        whitener: Turns that into independent numbers of unit variance; zero where no
            link is.
        carried: How the state at the end follows the torque at the start, in units of
            its rms (trials, nodes, local, 3).
    """

    covariance: Array
    whitener: Array
    carried: Array


def _of_a_step(steps: Array) -> tuple[Array, Array]:
    """Covariance of momentum, its integral and the torque, and how they follow the torque.

    Args:
        steps: Lengths in correlation times.

    Returns:
        Matrices (..., 3, 3) and columns (..., 3), in units of level dt^(1/2) for the
        momentum, level dt^(3/2) for its integral and the rms for the torque.
    """
    a = jnp.clip(steps, _SHORTEST, _LONGEST)
    x = -jnp.expm1(-a)
    root = jnp.sqrt(2 * a)
    # Responses to a kick that came a fraction r of the step ago.
    points, weights = np.polynomial.legendre.leggauss(_POINTS)
    r = jnp.asarray(0.5 + 0.5 * points, a.dtype)
    r = jnp.broadcast_to(r, (*a.shape, r.size))
    faded = -jnp.expm1(-a[..., None] * r)
    responses = jnp.stack(
        [faded, r - faded / a[..., None], root[..., None] * (1 - faded)], axis=-1
    )
    weights = jnp.asarray(0.5 * weights, a.dtype)
    short = product("r,...ri,...rj->...ij", weights, responses, responses)
    # The same integrals in closed form lose their digits in short steps.
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
    closed = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    covariance = jnp.where((a < 1)[..., None, None], short, closed)
    carried = jnp.stack([x / root, (a - x) / (root * a), 1 - x], axis=-1)
    return covariance, carried


def push_of(
    disturbance: Disturbance,
    span: Array,
    linked: Array,
    tensor: Array,
    depends_on_attitude: bool,
) -> Push:
    """What the torque does over links.

    Args:
        disturbance: The torque.
        span: Length of each link (trials, nodes) [s].
        linked: Which links there are.
        tensor: Inertia, which turns momentum into rates.
        depends_on_attitude: Whether the state has an attitude.
    """
    kinds = [0, 1, 2] if depends_on_attitude else [0, 2]
    dt = jnp.where(linked, span, 1.0)
    time = jnp.maximum(disturbance.time, jnp.finfo(dt.dtype).tiny)
    covariance, carried = _of_a_step(
        jnp.minimum(dt[..., None] / time[None, None], _LONGEST)
    )
    level = disturbance.level[:, None, :] * jnp.sqrt(dt)[..., None]
    units = [level, level * dt[..., None], jnp.ones_like(level)]
    eye = jnp.eye(3, dtype=dt.dtype)
    momenta = [tensor, tensor, eye]  # from rates and turns
    rates = [jnp.linalg.inv(tensor), jnp.linalg.inv(tensor), eye]  # and back
    whitener = _inverse_cholesky(
        [[covariance[..., i, j] for j in kinds] for i in kinds]
    )

    # Matrices of blocks of three by three, for rates, turns and torques.
    def spread(i: int, j: int) -> Array:
        size = units[i] * covariance[..., i, j] * units[j]
        return product("ak,...k,bk->...ab", rates[i], size, rates[j])

    def white(i: int, j: int) -> Array:
        row = whitener[kinds.index(i)]
        size = row[kinds.index(j)] / units[j]
        return product("...a,ab->...ab", size, momenta[j])

    def assembled(block: Callable[[int, int], Array]) -> Array:
        rows = [jnp.concatenate([block(i, j) for j in kinds], axis=-1) for i in kinds]
        return jnp.concatenate(rows, axis=-2)

    there = linked.astype(dt.dtype)[..., None, None]
    along = [
        product("ab,...b->...ab", rates[i], units[i] * carried[..., i]) for i in kinds
    ]
    return Push(
        covariance=there * assembled(spread),
        whitener=there * assembled(white),
        carried=there * jnp.concatenate(along, axis=-2),
    )


def _inverse_cholesky(matrix: list[list[Array]]) -> list[list[Array]]:
    """Of a small matrix of arrays: the lower triangle that makes it the unit matrix."""
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
            sum_ = sum(lower[i][k] * inverse[k][j] for k in range(j, i))
            inverse[i][j] = -sum_ / lower[i][i]
    return inverse


def with_torque(
    rows: Rows, links: Links, push: Push, torque: Array
) -> tuple[Rows, Links]:
    """Rows and links of states that hold the torque too.

    Args:
        rows: Of states without the torque.
        links: Between them.
        push: What the torque does over each link.
        torque: At each node (trials, nodes, 3), in units of its rms.
    """
    local = links.gap.shape[-1]
    linked = jnp.any(push.whitener != 0, axis=(-2, -1))[..., None]
    following = jnp.where(linked, jnp.roll(torque, -1, axis=1), 0.0)
    gap = jnp.pad(links.gap, [(0, 0), (0, 0), (0, 3)])
    gap = gap + product("tnij,tnj->tni", push.carried, torque)
    gap = gap.at[..., local:].add(-following)
    more = [(0, 0), (0, 0), (0, 3), (0, 0)]
    of_state = jnp.concatenate([jnp.pad(links.of_state, more), push.carried], axis=-1)
    wider = jnp.pad(rows.of_state, [(0, 0), (0, 0), (0, 0), (0, 3)])
    links = Links(gap, jnp.pad(links.of_border, more), of_state, torque[:, 0])
    return rows._replace(of_state=wider), links


def no_disturbance(trials: int, dtype: Any) -> Disturbance:
    """White, of level one: for fits that have no such torque."""
    return Disturbance(np.ones((trials, 3), dtype), np.zeros(3, dtype))
