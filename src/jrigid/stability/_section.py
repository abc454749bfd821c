"""Poincare sections: the states at which a motion crosses a surface."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float

from jrigid._checks import (
    RESULTS,
    Findings,
    check_option,
    check_shape,
    demand,
    nan_where,
    settle,
    traced_by_jax,
    whole_number,
)
from jrigid._core.compile import quick_jit
from jrigid._types import Scalar, ScalarLike
from jrigid.dynamics import State
from jrigid.stability._maps import place_of_root
from jrigid.stability._stepped_motion import (
    Motion,
    Walk,
    findings_of,
    motion_of,
    verdict,
    walk,
)
from jrigid.systems import RigidBody

# Fraction of a step to which a crossing is located.
_CROSSING_TOLERANCE = {8: 1e-11, 4: 1e-5}

Condition = Callable[[Scalar, State], ScalarLike]


class Section(NamedTuple):
    """Points at which a motion crosses a surface.

    Attributes:
        states: States at the crossings; NaN beyond the last.
        ts: Times of the crossings [s]; NaN beyond the last.
        valid: Which entries are crossings.
        error: Largest magnitude of the condition at the crossings.
        result: `jrigid.RESULTS` of the input.
    """

    states: State
    ts: Float[Array, " crossings"]
    valid: Bool[Array, " crossings"]
    error: Scalar
    result: RESULTS


def poincare_section(
    system: RigidBody,
    state0: State,
    condition: Condition,
    crossings: int,
    step: ScalarLike,
    args: Any = None,
    *,
    t0: ScalarLike = 0.0,
    direction: bool | None = True,
    steps: int = 10_000,
    solver: diffrax.AbstractSolver | None = None,
    throw: bool = True,
) -> Section:
    """States at which a motion crosses a surface.

    Args:
        system: The body and its torque.
        state0: State at which the motion starts.
        condition: `(t, state) -> ()`, zero on the surface and smooth beside it.
        crossings: Number of crossings to find.
        step: Length of every step [s]. Each turn of the fastest part needs some 20 to
            60 steps. Two crossings within one step are missed.
        args: Passed to the torque.
        t0: Time at the start [s].
        direction: True for crossings at which the condition grows, False for those at
            which it falls, None for both.
        steps: Largest number of steps between two crossings. It bounds the cost of a
            lane.
        solver: A diffrax solver; `diffrax.Dopri8()` by default.
        throw: With False, bad input gives a result code and NaN.

    Returns:
        States and times of the crossings. A start on the surface is no crossing.

    Raises:
        ValueError: The condition returns no floating point number, such as a boolean.
        RuntimeError: A value is bad, or the step is too coarse. It is no error if there
            are fewer crossings than requested: see `valid`.

    Gradients: none to be relied on.
    Source: M. Henon, Physica D 5 (1982) 412. A crossing is located by bisection of the
    solver's own interpolation.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 0.3, 0.8]))
    >>> crossing = lambda t, state: state.omega[0]
    >>> section = jr.stability.poincare_section(body, state0, crossing, 3, 0.1)
    >>> period = jr.free.polhode_period(body.inertia, state0.omega)
    >>> print((jnp.diff(section.ts) / period).round(6))
    [1. 1.]
    """
    check_option("direction", direction, (True, False, None))
    crossings = whole_number("crossings", crossings)
    steps = whole_number("steps", steps)
    motion = motion_of(system, state0, args, t0, step, solver)
    section = _section(motion, condition, crossings, direction, steps)
    return settle(section, throw, _section_findings, motion, condition)


def _section_findings(motion: Motion, condition: Condition) -> Findings:
    """Findings about the arguments of a section."""
    findings = findings_of(motion)
    with traced_by_jax("a condition"):
        value = jnp.asarray(condition(motion.t0, motion.state0))
    check_shape("condition", value, ())
    demand(
        jnp.issubdtype(value.dtype, jnp.floating),
        "Argument `condition` must return a floating point number that is zero on the "
        f"surface and changes its sign there, but it returns {value.dtype}.",
    )
    message = "Argument `condition` must be finite at the start, but it is not."
    findings.require(jnp.isfinite(value), RESULTS.invalid_vector_field, message, value)
    return findings


class _Position(NamedTuple):
    """Progress of the search for crossings."""

    t: Array
    y: Array
    above: Array  # whether the condition is positive here
    crosses: (
        Array  # whether the motion crosses within the next step, or has just crossed
    )
    error: Array


class _Crossing(NamedTuple):
    """One crossing; not valid where the motion did not cross in time."""

    t: Array
    state: State
    valid: Array
    distance: Array


class _Search(NamedTuple):
    """A search for the crossings of one motion."""

    path: Walk
    condition: Condition
    direction: bool | None
    steps: int

    def value(self, t: Array, y: Array) -> Array:
        """The condition."""
        return jnp.asarray(self.condition(t, self.path.state(y)), y.dtype)

    def start(self, ok: Array) -> _Position:
        """The start of the motion."""
        t = self.path.motion.t0
        y = self.path.start
        # A start on the surface is no crossing. The side that counts there is the one
        # to which the motion goes.
        now = self.value(t, y)
        small = jnp.finfo(y.dtype).eps ** 0.25 * self.path.step
        # A midpoint step, since at rest only the second derivative tells the side.
        half = 0.5 * small
        middle = y + half * self.path.rates(t, y)
        moved = y + small * self.path.rates(t + half, middle)
        ahead = self.value(t + small, moved)
        above = jnp.where(now == 0, ahead > now, now > 0)
        # An invalid motion counts as one without a crossing, and so takes no step.
        return _Position(t, y, above, ok, jnp.zeros_like(t))

    def before_crossing(self, start: _Position) -> _Position:
        """The start of the step in which the motion crosses, if it ever does."""

        def step(carry: tuple[_Position, Array]) -> tuple[_Position, Array]:
            (t, y, above, _, error), count = carry
            after, local = self.path.advance(t, y)
            # In a product rounding does not add up, as it does in a sum of steps.
            later = start.t + self.path.step * (count + 1).astype(t.dtype)
            # The surface itself counts as above it, so a step that ends there crosses
            # it once.
            higher = self.value(later, after) >= 0
            crosses = (higher != above) & (
                self.direction is None or higher == self.direction
            )
            here = (t, y, above)
            ahead = (later, after, higher)
            # The step with the crossing is not taken: the root is sought within it.
            t, y, above = jtu.tree_map(partial(jnp.where, crosses), here, ahead)
            return _Position(t, y, above, crosses, jnp.maximum(error, local)), count + 1

        def goes_on(carry: tuple[_Position, Array]) -> Array:
            return ~carry[0].crosses & (carry[1] < self.steps)

        begin = start._replace(crosses=jnp.zeros_like(start.crosses))
        # Without an earlier crossing there is no later one: no step is taken.
        count = jnp.where(start.crosses, 0, self.steps)
        return jax.lax.while_loop(goes_on, step, (begin, count))[0]

    def next_crossing(self, start: _Position, _: None) -> tuple[_Position, _Crossing]:
        """The next crossing, and the position just after it."""
        t, y, above, crosses, error = self.before_crossing(start)
        # The step is repeated for its interpolation, which the others do not need.
        state_within = self.path.within(t, y)

        def rising(fraction: Array, _: None) -> Array:
            ahead = self.value(t + fraction * self.path.step, state_within(fraction))
            # A motion that is above the surface falls through it.
            return jnp.where(above, -ahead, ahead)

        tolerance = _CROSSING_TOLERANCE[y.dtype.itemsize]
        fraction = place_of_root(rising, None, tolerance, y.dtype)
        t = t + fraction * self.path.step
        y = state_within(fraction)
        distance = jnp.abs(self.value(t, y))
        crossing = _Crossing(t, self.path.state(y), crosses, distance)
        # At a crossing the sign of the condition is rounding, so it is not evaluated.
        return _Position(t, y, ~above, crosses, error), crossing


@quick_jit
def _section(
    motion: Motion,
    condition: Condition,
    crossings: int,
    direction: bool | None,
    steps: int,
) -> Section:
    """The section of a motion whose step is its `duration`."""
    findings = _section_findings(motion, condition)
    search = _Search(walk(motion, 1, findings.ok), condition, direction, steps)
    last, each = jax.lax.scan(
        search.next_crossing, search.start(findings.ok), None, length=crossings
    )
    ts, states = verdict(
        findings, search.path, last.t, last.error, (each.t, each.state)
    )
    valid = each.valid & findings.ok
    ts, states = jax.vmap(nan_where)(~valid, (ts, states))
    error = jnp.max(jnp.where(valid, each.distance, 0))
    return Section(states, ts, valid, error, findings.result)
