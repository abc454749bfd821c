"""Flips of a free body about its intermediate axis (the tennis racket theorem)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jrigid._checks import INERTIA, all_finite, is_inertia, shaped, where_defined
from jrigid._core.compile import one_program
from jrigid._types import InertiaLike, Scalar, VectorLike
from jrigid.dynamics import angular_momentum, kinetic_energy
from jrigid.free import polhode_period
from jrigid.mass import principal_axes


@one_program
def flip_time(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Time between two flips of a free body about its intermediate axis.

    A body flips if at some point of its polhode it turns faster about the intermediate
    axis than about each of the others. That component of the angular velocity then
    changes its sign twice in a period of the polhode, and the intermediate axis turns
    over against the angular momentum. A body that always turns mainly about the axis of
    its largest or smallest moment only wobbles and never flips.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity at any time, body components [rad/s].

    Returns:
        Half of the period of the polhode [s]. It is infinite where the body never
        flips: a wobble, any steady rotation, the separatrix, rest, a body of two equal
        moments. NaN outside finite, positive definite inertia and finite rates.

    Gradients: those of `jrigid.free.polhode_period`; 0 where it is infinite.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 37. Near the separatrix it
    grows like twice the logarithm of one over the offset, over `growth_rate`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> racket = jnp.array([1.0, 2.0, 3.0])
    >>> print(jr.stability.flip_time(racket, [1e-3, 1.0, 0.0]).round(4))
    28.7314
    >>> print(jr.stability.flip_time(racket, [1e-3, 0.0, 1.0]))
    inf
    """
    inertia, omega = shaped(inertia=(inertia, *INERTIA), omega=(omega, 3))
    ok = is_inertia(inertia) & all_finite(omega)
    return where_defined(ok, _flip_time, inertia, omega)


def _flip_time(inertia: Array, omega: Array) -> Scalar:
    flips = _flips(*jax.lax.stop_gradient((inertia, omega)))
    return jnp.where(flips, 0.5 * polhode_period(inertia, omega), jnp.inf)


def _flips(inertia: Array, omega: Array) -> Bool[Array, ""]:
    """Whether the body at times turns fastest about its intermediate axis."""
    if inertia.ndim == 1:
        i1, i2, i3 = jnp.sort(inertia)
    else:
        i1, i2, i3 = principal_axes(inertia).moments
    square = jnp.sum(angular_momentum(inertia, omega) ** 2)
    twice = 2 * kinetic_energy(inertia, omega)
    # Where |w2| is largest, the component on the side of the separatrix that the
    # motion does not circle is 0, and w2^2 must exceed the square of the third.
    # With w1 = 0, for example, i2 (i3 - i2) w2^2 = 2 E i3 - |L|^2 and i3 (i3 - i2) w3^2
    # = |L|^2 - 2 E i2.
    outer = jnp.where(square > twice * i2, i3, i1)
    faster = jnp.abs(twice * outer - square) * outer > jnp.abs(square - twice * i2) * i2
    # A body with two equal moments has no intermediate axis.
    return faster & (i1 < i2) & (i2 < i3)
