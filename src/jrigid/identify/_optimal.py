"""The trial that tells most: a plan improved by the gradients of its bound."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jrigid._checks import demand
from jrigid._numerics import or_one
from jrigid._types import Scalar
from jrigid.identify._compile import quick_jit
from jrigid.identify._design import Bound, Plan


class Optimum(NamedTuple):
    """A plan that is better than its neighbours, and than those the other starts led to.

    Attributes:
        plan: The plan, whose `bound` and `predicted` say what it promises.
        score: What was made small.
        start_score: Of the plan that was given.
        slope: Length of the step that the gradient still asks for, within the limits,
            in units of these: small at an optimum.
        history: Score from each start, the given plan first, after each step.
    """

    plan: Plan
    score: Scalar
    start_score: Scalar
    slope: Scalar
    history: Float[Array, "starts steps"]


def _log_error(bound: Bound) -> Array:
    return jnp.log(jnp.trace(bound.ratios_covariance)) / 2


def optimal_trial(
    plan: Plan,
    choose: Callable[[Plan], Any],
    limits: Any,
    *,
    score: Callable[[Bound], Array] = _log_error,
    starts: int = 8,
    steps: int = 100,
) -> Optimum:
    """The spin, the sampling times, a wheel's profile that tell most, by gradients of the bound.

    Spectral projected gradients from several starts, since there are many optima. A
    bound holds near the body that was thought of.

    Args:
        plan: What to begin with, and all that stays as it is.
        choose: Picks an array of the plan, or a tuple of arrays,
            `lambda plan: plan.state.omega`,
            `lambda plan: (plan.state.omega, plan.observations.ts)`.
        limits: What the array must keep to, or a tuple with an entry for each array:
            `(low, high)`, in which numbers or arrays bound each element; a number, the
            greatest length along the last axis; or a function that brings an array back
            within its limits.
        score: What is to be small, of the bound. By default the logarithm of the root
            of the summed variances of I2/I1 and I3/I1.
        starts: The given plan and others at random within the limits, of a function
            near the plan.
        steps: Evaluations from each start.

    Returns:
        The best plan found. Times that were chosen may come in another order, and run
        together where much is told: sort them, or give limits that keep each near its
            own.

    Raises:
        ValueError: As many limits as arrays were not given.

    Gradients: none.
    Source: E. G. Birgin, J. M. Martinez, M. Raydan, SIAM Journal on Optimization 10
        (2000) 1196.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record = jr.identify.Rates(jnp.linspace(0.0, 20.0, 100), None, 0.01)
    >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.1, 1.0]))
    >>> plan = jr.identify.Plan(jr.RigidBody(jnp.array([1.0, 1.7, 2.3])), start, record)
    >>> best = jr.identify.optimal_trial(plan, lambda plan: plan.state.omega, 1.0)
    >>> errors = jnp.exp(jnp.stack([best.start_score, best.score]))
    >>> print(errors.round(4), abs(best.plan.state.omega).round(2))
    [0.2349 0.0047] [0.41 0.91 0.02]
    """
    leaves = jtu.tree_leaves(choose(plan))
    given = [limits] if len(leaves) == 1 else list(limits)
    demand(
        len(given) == len(leaves),
        f"Argument `limits` must have an entry for each of {len(leaves)} arrays that `choose` "
        f"picks, but it has {len(given)}.",
    )
    given = jtu.tree_map(lambda x: x if callable(x) else jnp.asarray(x), given)
    return _optimum(plan, choose, given, score, starts, steps)


def _limited(limit: Any, x: Array) -> tuple[Any, Array, Array]:
    """What brings an array back within its limits, their middle and their size."""
    if callable(limit):
        return limit, x, jnp.full_like(x, jnp.sqrt(jnp.mean(x**2)))
    if isinstance(limit, tuple):
        low, high = (jnp.broadcast_to(y.astype(x.dtype), x.shape) for y in limit)
        return lambda x: jnp.clip(x, low, high), (low + high) / 2, (high - low) / 2
    length = lambda x: jnp.linalg.norm(x, axis=-1, keepdims=True)  # noqa: E731
    most = jnp.full_like(x, limit)
    return lambda x: x * most / jnp.maximum(most, length(x)), jnp.zeros_like(x), most


@quick_jit
def _optimum(
    plan: Plan,
    choose: Callable[[Plan], Any],
    limits: list[Any],
    score: Callable[[Bound], Array],
    starts: int,
    steps: int,
) -> Optimum:
    given, place = ravel_pytree(choose(plan))
    pairs = zip(limits, jtu.tree_leaves(place(given)), strict=True)
    within, *sizes = zip(*(_limited(limit, x) for limit, x in pairs), strict=True)
    middle, unit = (ravel_pytree(x)[0] for x in sizes)
    unit, start = or_one(unit), (starts - 1, given.size)

    def project(x: Array) -> Array:
        arrays = zip(within, jtu.tree_leaves(place(middle + unit * x)), strict=True)
        return (
            ravel_pytree([back(array) for back, array in arrays])[0] - middle
        ) / unit

    def planned(x: Array) -> Plan:
        return eqx.tree_at(choose, plan, place(middle + unit * x))

    scored = lambda x: (score(planned(x).bound),) * 2  # noqa: E731
    # Under a torque forward alone.
    derive = (jax.grad if plan.system.is_free else jax.jacfwd)(scored, has_aux=True)

    def step(now: tuple[Array, ...], _: None) -> tuple[tuple[Array, ...], Array]:
        x, value, slope, size, share = now
        move = share * (project(x - size * slope) - x)
        ahead_slope, ahead = derive(x + move)
        bend = jnp.sum(move * (ahead_slope - slope))
        size = jnp.where(bend > 0, jnp.sum(move**2) / or_one(bend), 10 * size)
        after = (
            x + move,
            ahead,
            ahead_slope,
            jnp.clip(size, 1e-6, 1e6),
            jnp.ones_like(share),
        )
        better = ahead <= value + 1e-4 * jnp.sum(slope * move)
        now = jtu.tree_map(
            lambda a, b: jnp.where(better, a, b), after, (*now[:4], share / 4)
        )
        return now, now[1]

    def descend(x: Array) -> tuple[tuple[Array, ...], Array]:
        begin = (
            jnp.asarray(y, x.dtype) for y in (x, jnp.inf, jnp.zeros_like(x), 0.1, 1.0)
        )
        return jax.lax.scan(step, tuple(begin), None, steps)

    others = jax.random.uniform(jax.random.key(0), start, given.dtype, -1.0, 1.0)
    begin = jnp.concatenate([((given - middle) / unit)[None], others])
    (x, values, slopes, *_), history = jax.lax.map(descend, jax.vmap(project)(begin))
    best = jnp.argmin(values)
    slope = jnp.linalg.norm(project(x[best] - slopes[best]) - x[best])
    return Optimum(planned(x[best]), values[best], history[0, 0], slope, history)
