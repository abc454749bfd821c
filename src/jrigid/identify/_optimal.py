"""Search for the most informative experiment by gradients of its error bound."""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from jrigid._checks import (
    check_type,
    demand,
    float_arrays,
    is_concrete,
    whole_number,
)
from jrigid._core.compile import SOME, quick_jit
from jrigid._numerics import or_one
from jrigid._types import Scalar
from jrigid.identify._design import Bound, Plan

_FIRST_STEP = 0.1  # in units of the limits, along a gradient of length 1
# The spectral step size is kept within bounds, as the method of Birgin, Martinez and
# Raydan asks.
_STEP_SIZES = (1e-6, 1e6)
# Up to so many numbers, derivatives in forward mode are no slower than in reverse mode.
_FEW = 6
_DECREASE = 1e-4  # of what the slope predicts, for a step to be accepted (Armijo)


class Optimum(NamedTuple):
    """A plan that is better than its neighbours and than the other plans found.

    Attributes:
        plan: The plan. Its `bound` and `predicted` state what to expect from it.
        score: The score that was minimised.
        start_score: Score of the plan that was given, moved to within the limits.
        slope: Length of the step that the gradient still asks for within the limits, in
            units of these. It is small at an optimum.
        history: Score after each step from each initial plan, the given plan first.
    """

    plan: Plan
    score: Scalar
    start_score: Scalar
    slope: Scalar
    history: Float[Array, "starts steps"]


def _log_error(bound: Bound) -> Array:
    """Logarithm of the root of the summed variances of the ratios."""
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
    """Find the spin, sampling times or rotor profile that determine most.

    The search uses spectral projected gradients. It begins from several initial plans,
    since there are many optima. A bound holds near the body that the plan assumes.

    Args:
        plan: The plan to begin with. What is not chosen stays as it is.
        choose: Function that picks an array of the plan, or a tuple of arrays, such as
            `lambda plan: plan.state.omega` or
            `lambda plan: (plan.state.omega, plan.observations.ts)`.
        limits: Limits of the array, or a tuple with an entry for each array. An entry
            is `(low, high)`, numbers or arrays that bound each element; or a number,
            the greatest length along the last axis; or a function that returns an array
            within its limits.
        score: Function of the bound that is minimised. By default it is the logarithm
            of the root of the summed variances of I2/I1 and I3/I1.
        starts: Number of initial plans: the given one, and random ones within the
            limits. Where a limit is a function they are near the given plan.
        steps: Number of evaluations from each initial plan.

    Returns:
        The best plan found. Chosen times may be in another order, and several may
        coincide where the motion is most informative. Sort them, or give limits that
        keep each time near its initial value.

    Raises:
        ValueError: The number of limits is not the number of arrays, or a limit is
            none.
        RuntimeError: The score is not finite at any of the initial plans.

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
    check_type("plan", plan, Plan)
    whole_number("starts", starts)
    whole_number("steps", steps)
    arrays = jtu.tree_leaves(choose(plan))
    demand(
        bool(arrays) and all(eqx.is_inexact_array(x) for x in arrays),
        "Argument `choose` must pick floating point arrays of the plan, but it does "
        "not.",
    )
    is_sequence = isinstance(limits, tuple | list)
    is_single = len(arrays) == 1 and not (is_sequence and len(limits) == 1)
    entries = [limits] if is_single else list(limits)
    demand(
        len(entries) == len(arrays),
        f"Argument `limits` must have an entry for each of {len(arrays)} arrays that "
        f"`choose` picks, but it has {len(entries)}.",
    )
    pairs = zip(entries, arrays, strict=True)
    entries = [_checked(entry, array) for entry, array in pairs]
    optimum = _optimum(plan, choose, entries, score, starts, steps)
    # The search keeps a score that is not a number as infinite.
    if is_concrete(optimum.score) and not optimum.score < jnp.inf:
        raise RuntimeError(
            "Argument `score` must be finite at one of the initial plans, but it is "
            "not: look at `plan.predicted`, within the limits."
        )
    return optimum


def _checked(entry: Any, x: Array) -> "_Entry":
    """An entry of the argument `limits` as arrays, whose values jit does not compile.

    Raises:
        ValueError: The entry is no limit of an array like `x`.
    """
    if callable(entry):
        return cast(Callable[[Array], Array], entry)
    is_pair = isinstance(entry, tuple | list)
    demand(
        not is_pair or len(entry) == 2,
        "Argument `limits` must be a pair (low, high), a length or a function for "
        f"each array, but an entry holds {len(entry) if is_pair else 1}.",
    )
    bounds = float_arrays(*entry) if is_pair else float_arrays(entry)
    for bound in bounds:
        fits = bound.ndim <= x.ndim and all(
            a in (1, b) for a, b in zip(bound.shape[::-1], x.shape[::-1], strict=False)
        )
        demand(
            fits,
            f"Argument `limits` must broadcast to an array of shape {x.shape}, but it "
            f"has shape {bound.shape}.",
        )
    if all(map(is_concrete, bounds)):
        low, high = bounds if is_pair else (0.0, bounds[0])
        demand(
            all(np.all(np.isfinite(y)) for y in bounds) and bool(np.all(low <= high)),
            "Argument `limits` must be finite, low at most high and a length not "
            f"negative, but it is {entry}.",
        )
    return (bounds[0], bounds[1]) if is_pair else bounds[0]


# An entry of the argument `limits`.
_Entry = Callable[[Array], Array] | tuple[Array, Array] | Array


class _Limit(NamedTuple):
    """Limits of an array.

    Attributes:
        project: Returns an array within the limits.
        middle: Middle of the limits.
        size: Half of their width.
    """

    project: Callable[[Array], Array]
    middle: Array
    size: Array


def _shortened(most: Array, x: Array) -> Array:
    """Vectors along the last axis, none longer than a length."""
    length = jnp.linalg.norm(x, axis=-1, keepdims=True)
    return x * most / jnp.maximum(most, length)


def _limit(entry: _Entry, x: Array) -> _Limit:
    """Limits that an entry of the argument `limits` states for an array."""
    if callable(entry):
        return _Limit(entry, x, jnp.full_like(x, jnp.sqrt(jnp.mean(x**2))))
    if isinstance(entry, tuple):
        low, high = (jnp.broadcast_to(y.astype(x.dtype), x.shape) for y in entry)
        project = partial(jnp.clip, min=low, max=high)
        return _Limit(project, (low + high) / 2, (high - low) / 2)
    most = jnp.full_like(x, entry)
    return _Limit(partial(_shortened, most), jnp.zeros_like(x), most)


class _Chosen(NamedTuple):
    """The chosen arrays of a plan as one vector, in units of their limits.

    The vector is zero in the middle of the limits.

    Attributes:
        plan: The plan.
        choose: Picks the arrays of a plan.
        arrays_of: The arrays that a vector in their own units holds.
        limits: Limits of each array.
        middle: Middle of the limits, as a vector.
        unit: Half of their width.
    """

    plan: Plan
    choose: Callable[[Plan], Any]
    arrays_of: Callable[[Array], PyTree[Array]]
    limits: list[_Limit]
    middle: Array
    unit: Array

    def plan_at(self, x: Array) -> Plan:
        """The plan with arrays from a vector."""
        arrays = self.arrays_of(self.middle + self.unit * x)
        return eqx.tree_at(self.choose, self.plan, arrays)

    def project(self, x: Array) -> Array:
        """The vector with each array within its limits."""
        arrays = jtu.tree_leaves(self.arrays_of(self.middle + self.unit * x))
        pairs = zip(self.limits, arrays, strict=True)
        inside = _vector(limit.project(array) for limit, array in pairs)
        return (inside - self.middle) / self.unit


def _vector(arrays: Iterable[Array]) -> Array:
    return ravel_pytree(list(arrays))[0]


def _chosen(
    plan: Plan, choose: Callable[[Plan], Any], entries: list[_Entry]
) -> tuple[_Chosen, Array]:
    """The chosen arrays as a vector, and that of the plan itself."""
    given, arrays_of = ravel_pytree(choose(plan))
    pairs = zip(entries, jtu.tree_leaves(arrays_of(given)), strict=True)
    limits = [_limit(entry, array) for entry, array in pairs]
    middle = _vector(x.middle for x in limits)
    # Where both limits of an element coincide its unit has no effect.
    unit = or_one(_vector(x.size for x in limits))
    chosen = _Chosen(plan, choose, arrays_of, limits, middle, unit)
    return chosen, (given - middle) / unit


class _Descent(NamedTuple):
    """Point that a search has reached, with its slope and its next step.

    Attributes:
        x: The vector of chosen arrays.
        score: Score there.
        slope: Its gradient.
        size: Step for a gradient of 1, by the curvature along the last step.
        share: Fraction of the step to try next, less than 1 after failures.
    """

    x: Array
    score: Array
    slope: Array
    size: Array
    share: Array


def _stepped(
    derive: Callable[[Array], tuple[Array, Array]],
    project: Callable[[Array], Array],
    now: _Descent,
) -> _Descent:
    """Try one step; keep the place and shorten the step if the score does not fall."""
    move = now.share * (project(now.x - now.size * now.slope) - now.x)
    slope, score = derive(now.x + move)
    # The step size of Barzilai and Borwein.
    bend = jnp.sum(move * (slope - now.slope))
    # Where the score bends downward there is no such size, and a longer step is tried.
    size = jnp.where(bend > 0, jnp.sum(move**2) / or_one(bend), 10 * now.size)
    size = jnp.clip(size, *_STEP_SIZES)
    after = _Descent(now.x + move, score, slope, size, jnp.ones_like(now.share))
    # A score that is not a number is never better, so that the step is shortened.
    better = score <= now.score + _DECREASE * jnp.sum(now.slope * move)
    shorter = now._replace(share=now.share / 4)
    return jtu.tree_map(lambda a, b: jnp.where(better, a, b), after, shorter)


def _descended(
    derive: Callable[[Array], tuple[Array, Array]],
    project: Callable[[Array], Array],
    steps: int,
    x: Array,
) -> tuple[_Descent, Array]:
    """The end of a search from a vector, and the score after each step."""

    def step(now: _Descent, _: None) -> tuple[_Descent, Array]:
        now = _stepped(derive, project, now)
        return now, now.score

    # Any score is better than this one, so that the first step evaluates `x`.
    initial = _Descent(
        x=x,
        score=jnp.asarray(jnp.inf, x.dtype),
        slope=jnp.zeros_like(x),
        size=jnp.asarray(_FIRST_STEP, x.dtype),
        share=jnp.asarray(1.0, x.dtype),
    )
    return jax.lax.scan(step, initial, None, steps)


@partial(quick_jit, level=SOME)
def _optimum(
    plan: Plan,
    choose: Callable[[Plan], Any],
    entries: list[_Entry],
    score: Callable[[Bound], Array],
    starts: int,
    steps: int,
) -> Optimum:
    chosen, first = _chosen(plan, choose, entries)
    project = chosen.project

    def scored(x: Array) -> tuple[Array, Array]:
        value = score(chosen.plan_at(x).bound)
        # `jacfwd` returns a value only as an auxiliary output.
        return value, value

    # Forward mode compiles in two thirds of the time and costs a value for each number
    # that is chosen. A motion under a torque has no other mode.
    few = first.size <= _FEW or not plan.system.is_free
    grad = jax.jacfwd if few else jax.grad
    derive = grad(scored, has_aux=True)

    descend = partial(_descended, derive, project, steps)
    shape = (starts - 1, first.size)
    # The key is fixed, so that the same call finds the same plan.
    others = jax.random.uniform(jax.random.key(0), shape, first.dtype, -1.0, 1.0)
    initial = jnp.concatenate([first[None], others])
    ends, history = jax.lax.map(descend, jax.vmap(project)(initial))
    index = jnp.argmin(ends.score)
    best = jtu.tree_map(lambda y: y[index], ends)
    # Projected, the gradient step has no part that leads out of the limits.
    slope = jnp.linalg.norm(project(best.x - best.slope) - best.x)
    return Optimum(chosen.plan_at(best.x), best.score, history[0, 0], slope, history)
