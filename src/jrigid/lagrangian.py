"""Mechanics from any Lagrangian: accelerations, momenta, energy, cyclic coordinates.

A Lagrangian is a pure function `L(q, q_dot, *params) -> scalar` of n generalised
coordinates, their rates and whatever parameters it needs (numbers, arrays, any pytree);
one that is not a real scalar is a ValueError. Time is no argument: along a motion the
parameters are constants.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jrigid._checks import (
    all_finite,
    check_shape,
    demand,
    float_arrays,
    is_concrete,
    nan_where,
    shaped,
    where_defined,
)
from jrigid._numerics import power_of_two, product
from jrigid._public import list_public_names
from jrigid._types import Real, Scalar, TimeLike

Lagrangian: TypeAlias = Callable[..., Any]
Coordinates: TypeAlias = Float[Array, " n"]
CoordinatesLike: TypeAlias = Real[ArrayLike, " n"]
#: A Lagrangian whose parameters are bound.
_Bound: TypeAlias = Callable[[Array, Array], Array]

# Each sweep takes the square root of the remaining ratio of scales, 1e16 at first.
_SCALING_SWEEPS = 5
# Points at which `cyclic_coordinates` looks, and rounding errors of a slope that count
# as zero.
_PROBES = 4
_ROUNDING_ERRORS = 64


def _coordinates(q: ArrayLike, q_dot: ArrayLike) -> tuple[Array, Array]:
    """Convert coordinates and rates to arrays (n,) of one dtype, or raise an error."""
    q, q_dot = shaped(q=(q, None), q_dot=(q_dot, *np.shape(q)))
    if q.size == 0:
        raise ValueError(
            "Argument `q` must have one coordinate at least, but it has none."
        )
    return q, q_dot


def _bind(lagrangian: Lagrangian, params: tuple[Any, ...], dtype: np.dtype) -> _Bound:
    """Bind the parameters of a Lagrangian; check that its value is a real scalar."""

    def bound(q: Array, q_dot: Array) -> Array:
        value = jnp.asarray(lagrangian(q, q_dot, *params))
        if value.shape != () or not jnp.issubdtype(value.dtype, jnp.floating):
            raise ValueError(
                "Argument `lagrangian` must return a real scalar, but it returns an "
                f"array of shape {value.shape} and dtype {value.dtype}."
            )
        return value.astype(dtype)

    return bound


def _equations(lagrangian: _Bound, q: Array, q_dot: Array) -> tuple[Array, Array]:
    """Mass matrix M and generalised force f of M q'' = f."""
    momenta = jax.grad(lagrangian, argnums=1)
    mass = jax.jacfwd(momenta, argnums=1)(q, q_dot)
    # dp/dt at constant rates, (d^2 L / dq_dot dq) q_dot, without the mixed Hessian.
    _, carried = jax.jvp(lambda q: momenta(q, q_dot), (q,), (q_dot,))
    force = jax.grad(lagrangian)(q, q_dot) - carried
    # The entries ij and ji round differently.
    return 0.5 * (mass + mass.T), force


def _scales(mass: Array) -> Array:
    """Powers of two s, such that the rows of s_i M_ij s_j are all of order one.

    The diagonal is enough for a definite matrix. Ruiz's iteration (RAL-TR-2001-034)
    serves matrices with zeros on the diagonal. Powers of two do not round.
    """
    mass = jnp.abs(mass)
    diagonal = jnp.diagonal(mass)
    scales = 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    for _ in range(_SCALING_SWEEPS):
        rows = jnp.max(scales[:, None] * mass * scales[None, :], axis=1)
        scales = scales / jnp.sqrt(jnp.where(rows > 0, rows, 1.0))
    return power_of_two(scales)


# Jitted for eager callers: one compilation for each n, not one for each operation.
@jax.jit
def _accelerations(mass: Array, force: Array) -> Array:
    """M^-1 f; NaN without derivatives if M is singular or the result not finite."""
    scales = jax.lax.stop_gradient(_scales(mass))
    mass = scales[:, None] * mass * scales[None, :]
    force = scales * force
    threshold = 16 * force.size * float(jnp.finfo(force.dtype).eps)
    condition = jnp.linalg.cond(jax.lax.stop_gradient(mass), jnp.inf)
    # A condition that is infinite or NaN compares false.
    is_regular = (threshold * condition <= 1) & all_finite(force)
    # By LU: a mass matrix is symmetric but need not be definite.
    result = scales * where_defined(is_regular, jnp.linalg.solve, mass, force)
    return nan_where(~all_finite(result), result)


def acceleration(
    lagrangian: Lagrangian, q: CoordinatesLike, q_dot: CoordinatesLike, *params: Any
) -> Coordinates:
    r"""Accelerations q'' of the motion that a Lagrangian makes stationary.

    Solves $M q'' = \partial L/\partial q - (\partial^2 L/\partial\dot q\,\partial
    q)\,\dot q$ with the mass matrix $M = \partial^2 L/\partial\dot
    q^2$, which need not be positive definite. M counts as singular when, in units that
    bring its rows to order one, its reciprocal condition number (row-sum norm) is below
    16 n rounding errors: the answer would have no correct digit.

    Args:
        lagrangian: Pure `L(q, q_dot, *params) -> scalar` [J, or any unit].
        q: Generalised coordinates [coordinate units].
        q_dot: Their rates [coordinate units/s].
        params: Further arguments of the Lagrangian, constants of the motion. A time
            among them is right where the momenta do not depend on it, as in a driven
            potential; with a moving support write L without the total time derivative,
            as a force of inertia.

    Returns:
        q'' [coordinate units/s^2], in the dtype of `q` and `q_dot`. NaN where M is
        singular, as that of Euler angles is at theta = 0 (`jrigid.RigidBody` turns
        without any), and where coordinates, derivatives of L or q'' itself are not
        finite.

    Gradients: those of the solution, of any order that L has. Zero where M is singular
    or a coordinate is not finite, so that such a lane spoils none of what it shares
    with others; where derivatives of L are not finite those of what it shares are
    NaN.
    Source: Goldstein, Classical Mechanics, 3rd ed., eq. 1.57.

    >>> import jax.numpy as jnp
    >>> from jrigid import lagrangian
    >>> def pendulum(q, q_dot, g, length):
    ...     return 0.5 * length**2 * q_dot[0] ** 2 + g * length * jnp.cos(q[0])
    >>> q, q_dot = jnp.array([jnp.pi / 6]), jnp.array([0.3])
    >>> print(lagrangian.acceleration(pendulum, q, q_dot, 9.81, 2.0))
    [-2.4525]
    """
    q, q_dot = _coordinates(q, q_dot)

    def formula(q: Array, q_dot: Array, params: tuple[Any, ...]) -> Array:
        bound = _bind(lagrangian, params, q.dtype)
        return _accelerations(*_equations(bound, q, q_dot))

    return where_defined(all_finite((q, q_dot)), formula, q, q_dot, params)


def vector_field(
    lagrangian: Lagrangian,
) -> Callable[..., tuple[Coordinates, Coordinates]]:
    """Vector field of the motion for diffrax: `(t, (q, q_dot), args) -> (q_dot, q'')`.

    Where `acceleration` is NaN so is q'' here; it is never infinite or a large wrong
    number. An adaptive solve that meets NaN rejects its steps and ends with an error at
    `max_steps`. A solve with constant steps goes on with NaN. Steps may jump over an
    isolated point such as theta = 0 and not see it.

    Args:
        lagrangian: Pure `L(q, q_dot, *params) -> scalar` [J, or any unit].

    Returns:
        A function of the time, which is not passed on; the pair (q, q_dot) [coordinate
        units, coordinate units/s]; and `args`, the tuple of the Lagrangian's
        parameters, None for none. It gives the pair of rates.

    Gradients: as of `acceleration`.

    >>> import diffrax, jax.numpy as jnp
    >>> from jrigid import lagrangian
    >>> def oscillator(q, q_dot, stiffness):
    ...     return 0.5 * jnp.sum(q_dot**2) - 0.5 * stiffness * jnp.sum(q**2)
    >>> solution = diffrax.diffeqsolve(
    ...     diffrax.ODETerm(lagrangian.vector_field(oscillator)),
    ...     diffrax.Tsit5(),
    ...     t0=0.0,
    ...     t1=jnp.pi,
    ...     dt0=None,
    ...     y0=(jnp.array([1.0]), jnp.array([0.0])),
    ...     args=(4.0,),
    ...     stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8),
    ... )
    >>> q, q_dot = solution.ys
    >>> print(q[-1].round(6))
    [1.]
    """

    # diffrax passes `args` on as they are: None, or what the caller made of them.
    def field(
        t: TimeLike,  # noqa: ARG001 (diffrax passes it)
        y: tuple[CoordinatesLike, CoordinatesLike],
        args: Any,
    ) -> tuple[Coordinates, Coordinates]:
        # A named tuple is a single parameter, and must not be taken apart.
        if args is not None and type(args) not in (tuple, list):
            raise ValueError(
                "Argument `args` must be a tuple of the Lagrangian's parameters or "
                f"None, but it is a {type(args).__name__}: write `(args,)`."
            )
        q, q_dot = _coordinates(*y)
        return q_dot, acceleration(lagrangian, q, q_dot, *(args or ()))

    return field


def momenta(
    lagrangian: Lagrangian, q: CoordinatesLike, q_dot: CoordinatesLike, *params: Any
) -> Coordinates:
    r"""Canonical momenta $p = \partial L / \partial \dot q$.

    Those of cyclic coordinates are constants of the motion: see `cyclic_coordinates`.

    Args:
        lagrangian: Pure `L(q, q_dot, *params) -> scalar` [J, or any unit].
        q: Generalised coordinates [coordinate units].
        q_dot: Their rates [coordinate units/s].
        params: Further arguments of the Lagrangian.

    Returns:
        p [J s/coordinate unit].

    Gradients: those of L.
    Source: Goldstein, Classical Mechanics, 3rd ed., eq. 2.44.

    >>> import jax.numpy as jnp
    >>> from jrigid import lagrangian
    >>> def charge(q, q_dot, field):  # of unit mass and charge, symmetric gauge
    ...     areal_rate = 0.5 * (q[0] * q_dot[1] - q[1] * q_dot[0])
    ...     return 0.5 * jnp.sum(q_dot**2) + field * areal_rate
    >>> print(lagrangian.momenta(charge, jnp.array([1.0, 2.0]), jnp.zeros(2), 3.0))
    [-3.   1.5]
    """
    q, q_dot = _coordinates(q, q_dot)
    return jax.grad(_bind(lagrangian, params, q.dtype), argnums=1)(q, q_dot)


def energy(
    lagrangian: Lagrangian, q: CoordinatesLike, q_dot: CoordinatesLike, *params: Any
) -> Scalar:
    """Energy function q_dot . p - L, constant along a motion of constant parameters.

    It is the kinetic plus the potential energy where the kinetic energy is quadratic in
    q_dot; terms linear in q_dot, as of a magnetic field, drop out.

    Args:
        lagrangian: Pure `L(q, q_dot, *params) -> scalar` [J, or any unit].
        q: Generalised coordinates [coordinate units].
        q_dot: Their rates [coordinate units/s].
        params: Further arguments of the Lagrangian.

    Returns:
        Energy, in the unit of L [J].

    Gradients: those of L.
    Source: Goldstein, Classical Mechanics, 3rd ed., eq. 2.53.

    >>> import jax.numpy as jnp
    >>> from jrigid import lagrangian
    >>> def oscillator(q, q_dot, stiffness):
    ...     return 0.5 * jnp.sum(q_dot**2) - 0.5 * stiffness * jnp.sum(q**2)
    >>> print(lagrangian.energy(oscillator, jnp.array([1.0]), jnp.array([2.0]), 4.0))
    4.0
    """
    q, q_dot = _coordinates(q, q_dot)
    bound = _bind(lagrangian, params, q.dtype)
    value, momentum = jax.value_and_grad(bound, argnums=1)(q, q_dot)
    return product("i,i->", q_dot, momentum) - value


def cyclic_coordinates(
    lagrangian: Lagrangian,
    q: CoordinatesLike,
    q_dot: CoordinatesLike,
    *params: Any,
    reach: Real[ArrayLike, ""] | CoordinatesLike | None = None,
) -> Bool[Array, " n"]:
    """Find the coordinates that L does not depend on, whose momenta are conserved.

    This is a numerical verdict. dL/dq_i must vanish at four fixed generic points about
    `q`, each at rest and in motion: to 64 rounding errors of the largest of the terms
    p_j q_dot_j and reach_j dL/dq_j. So an angle that drops out of L only because cos^2
    + sin^2 = 1 is found to be cyclic. A term of L that is switched off about `q`, or so
    weak that it is lost in rounding, is not seen. If L is not finite at a point, no
    coordinate counts as cyclic. Only the given coordinates are tested, not their
    combinations: of two coupled bodies neither position is cyclic.

    Args:
        lagrangian: Pure `L(q, q_dot, *params) -> scalar` [J, or any unit].
        q: Generalised coordinates where L is defined [coordinate units].
        q_dot: Their rates, of typical size [coordinate units/s]; all zero stands for 1.
        params: Further arguments of the Lagrangian.
        reach: How far the points lie from `q`, at most [coordinate units], one number
            or one a coordinate. By default (1 + |q_i|) / 4, which suits angles.

    Raises:
        ValueError: reach is not positive.

    Returns:
        True for a cyclic coordinate. `jnp.where(cyclic, p, 0)` with p of `momenta` are
        then constants of the motion. False where something is NaN.

    Gradients: none, the answer is boolean.
    Source: Goldstein, Classical Mechanics, 3rd ed., section 2.6.

    >>> import jax.numpy as jnp
    >>> from jrigid import lagrangian
    >>> def kepler(q, q_dot, mu):
    ...     (r, _), (r_dot, angle_dot) = q, q_dot
    ...     return 0.5 * (r_dot**2 + (r * angle_dot) ** 2) + mu / r
    >>> q, q_dot = jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])
    >>> print(lagrangian.cyclic_coordinates(kepler, q, q_dot, 1.0))
    [False  True]
    """
    q, q_dot = _coordinates(q, q_dot)
    bound = _bind(lagrangian, params, q.dtype)
    if reach is None:
        spread = 0.25 * (1 + jnp.abs(q))
    else:
        spread = float_arrays(reach)[0].astype(q.dtype)
        if spread.ndim > 0:
            check_shape("reach", spread, q.shape)
        # Points at no distance tell nothing. NaN makes the answer False.
        spread = jnp.where(spread > 0, spread, jnp.nan)
        demand(
            not is_concrete(spread) or bool(jnp.all(jnp.isfinite(spread))),
            "Argument `reach` must be positive and finite, but it is not.",
        )
    fastest = jnp.max(jnp.abs(q_dot))
    speed = jnp.where(fastest == 0, 1.0, fastest)
    # The same numbers at every call: the verdict must not depend on chance.
    steps = np.random.default_rng(0).uniform(-1, 1, (2, _PROBES, q.size))
    places, changes = jnp.asarray(steps, q.dtype)
    moving = q_dot[None] + changes * speed
    # At rest a weak potential stands alone. Beside fast motion its slope may be below
    # the tolerance.
    rates = jnp.stack([moving, jnp.zeros_like(moving)])

    def flat(place: Array, q_dot: Array) -> Array:
        return _is_flat(bound, q + place * spread, q_dot, spread)

    flat_at_places = jax.vmap(flat)
    return jnp.all(jax.vmap(flat_at_places, (None, 0))(places, rates), axis=(0, 1))


def _is_flat(
    lagrangian: _Bound, q: Array, q_dot: Array, spread: Array
) -> Bool[Array, " n"]:
    """Whether L does not change with each coordinate at a point, to rounding."""
    value_and_slopes = jax.value_and_grad(lagrangian, argnums=(0, 1))
    value, (slope, momentum) = value_and_slopes(q, q_dot)
    # Changes of L over the reach can be compared between coordinates of any unit.
    change = jnp.abs(slope) * spread
    # The terms p q_dot are a measure of the kinetic energy, whose rounding a slope
    # carries.
    largest = jnp.maximum(jnp.max(change), jnp.max(jnp.abs(momentum * q_dot)))
    tolerance = _ROUNDING_ERRORS * float(jnp.finfo(q.dtype).eps)
    return (change <= tolerance * largest) & jnp.isfinite(value)


list_public_names(__name__)
