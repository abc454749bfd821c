"""Sections of a motion, its flips, and the side on which a tumbling body ends."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float

from jrigid._checks import (
    INERTIA,
    RESULTS,
    Enumeration,
    Findings,
    all_finite,
    check_option,
    check_shape,
    is_inertia,
    nan_where,
    settle,
    shaped,
    traced_by_jax,
    where_defined,
    whole_number,
)
from jrigid._core.lanes import in_blocks
from jrigid._numerics import safe_norm
from jrigid._types import InertiaLike, Scalar, ScalarLike, VectorLike
from jrigid.dynamics import State, angular_momentum, kinetic_energy
from jrigid.free import polhode_period
from jrigid.mass import principal_axes
from jrigid.stability._maps import place_of_root
from jrigid.stability._steps import Motion, findings_of, motion_of, verdict, walk
from jrigid.systems import RigidBody

_SETTLED = 5.0  # degrees from an axis within which a body counts as turning about it
# Part of a step to which a crossing is located.
_PLACE = {8: 1e-11, 4: 1e-5}


class SIDES(Enumeration):
    """On which side a tumbling body came to spin."""

    along = "along"
    not_settled = "not settled"
    against = "against"
    undefined = "undefined"


class Section(NamedTuple):
    """Where a motion crosses a surface.

    Attributes:
        states: At each crossing; NaN beyond the last.
        ts: Times of the crossings [s]; NaN beyond the last.
        valid: Which there were.
        error: |condition| at the crossings, the largest.
        result: `jrigid.RESULTS` of the input.
    """

    states: State
    ts: Float[Array, " crossings"]
    valid: Bool[Array, " crossings"]
    error: Scalar
    result: Any


def poincare_section(
    system: RigidBody,
    state0: State,
    condition: Callable[[Any, State], Any],
    crossings: int,
    step: ScalarLike,
    args: Any = None,
    *,
    t0: ScalarLike = 0.0,
    direction: bool | None = True,
    steps: int = 10_000,
    solver: Any = None,
    throw: bool = True,
) -> Section:
    """States at which a motion crosses a surface.

    Args:
        system: The body and its torque.
        state0: Where the motion starts.
        condition: `(t, state) -> ()`, zero on the surface and smooth beside it.
        crossings: How many are wanted.
        step: Length of a step [s], the same throughout: some 20 to 60 for each turn of
            the fastest part. Two crossings within one step are missed.
        args: Passed to the torque.
        t0: Time at the start [s].
        direction: True: crossings at which the condition grows; False: falls; None:
            both.
        steps: Most steps from one crossing to the next: the bound on the cost of a
            lane.
        solver: A diffrax solver; `diffrax.Dopri8()` by default.
        throw: False: bad input is a result code and NaN.

    Returns:
        States and times of the crossings; a start on the surface itself is none.

    Raises:
        RuntimeError: Bad value, a step too coarse. Fewer crossings than asked for are
            no error: see `valid`.

    Gradients: none to be relied on.
    Source: M. Henon, Physica D 5 (1982) 412; a crossing is located by bisection of the
    solver's own interpolation.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 0.3, 0.8]))
    >>> section = jr.stability.poincare_section(body, state0, lambda t, s: s.omega[0], 3, 0.1)
    >>> between = jnp.diff(section.ts) / jr.free.polhode_period(body.inertia, state0.omega)
    >>> print(between.round(6))
    [1. 1.]
    """
    check_option("direction", direction, (True, False, None))
    crossings, steps = (
        whole_number("crossings", crossings),
        whole_number("steps", steps),
    )
    motion = motion_of(system, state0, args, t0, step, solver)
    section = _section(motion, condition, crossings, direction, steps)
    return settle(section, throw, _section_findings, motion, condition)


def _section_findings(motion: Motion, condition: Callable) -> Findings:
    findings = findings_of(motion)
    with traced_by_jax("a condition"):
        value = jnp.asarray(condition(motion.t0, motion.state0), motion.t0.dtype)
    check_shape("condition", value, ())
    message = "Argument `condition` must be finite at the start, but it is not."
    findings.require(jnp.isfinite(value), RESULTS.invalid_vector_field, message, value)
    return findings


class _Place(NamedTuple):
    """Where a search for crossings has come to."""

    t: Array
    y: Array
    above: Array  # whether the condition is positive there
    crosses: Array  # whether the motion crosses within a step, or has just crossed
    error: Array


@eqx.filter_jit
def _section(
    motion: Motion,
    condition: Callable,
    crossings: int,
    direction: bool | None,
    steps: int,
) -> Section:
    findings = _section_findings(motion, condition)
    path = walk(motion, 1, findings.ok)

    def value(t: Array, y: Array) -> Array:
        return jnp.asarray(condition(t, path.state(y)), y.dtype)

    def before_crossing(start: _Place) -> _Place:
        """The start of the step in which the motion crosses, if it ever does."""

        def step(search: tuple[_Place, Array]) -> tuple[_Place, Array]:
            (t, y, above, _, error), count = search
            after, local = path.advance(t, y)
            later = start.t + path.step * (count + 1).astype(t.dtype)
            higher = value(later, after) >= 0
            crosses = (higher != above) & (direction is None or higher == direction)
            here, ahead = (t, y, above), (later, after, higher)
            t, y, above = jtu.tree_map(partial(jnp.where, crosses), here, ahead)
            return _Place(t, y, above, crosses, jnp.maximum(error, local)), count + 1

        def goes_on(search: tuple[_Place, Array]) -> Array:
            return ~search[0].crosses & (search[1] < steps)

        begin = start._replace(crosses=jnp.zeros_like(start.crosses))
        return jax.lax.while_loop(
            goes_on, step, (begin, jnp.where(start.crosses, 0, steps))
        )[0]

    def crossing(place: _Place, _: None) -> tuple[_Place, tuple]:
        t, y, above, crosses, error = before_crossing(place)
        state = path.within(t, y)

        def rising(part: Array, _: Any) -> Array:
            ahead = value(t + part * path.step, state(part))
            return jnp.where(above, -ahead, ahead)

        part = place_of_root(rising, None, _PLACE[y.dtype.itemsize], y.dtype)
        t, y = t + part * path.step, state(part)
        crossed = (t, path.state(y), crosses, jnp.abs(value(t, y)))
        return _Place(t, y, ~above, crosses, error), crossed

    t, y = path.motion.t0, path.start
    # A start on the surface itself is no crossing: the motion is where it goes from
    # there.
    now, small = value(t, y), 1e-3 * path.step
    ahead = value(t + small, y + small * path.rates(t, y))
    above = jnp.where(now == 0, ahead > now, now > 0)
    begin = _Place(t, y, above, findings.ok, jnp.zeros_like(t))
    place, (ts, states, valid, left) = jax.lax.scan(
        crossing, begin, None, length=crossings
    )
    ts, states = verdict(findings, place.error, (ts, states))
    valid = valid & findings.ok
    ts, states = jax.vmap(nan_where)(~valid, (ts, states))
    return Section(
        states, ts, valid, jnp.max(jnp.where(valid, left, 0)), findings.result
    )


def flip_time(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Time between two flips of a free body about its intermediate axis: the tennis racket's.

    A body flips if, on its polhode, it now and then turns faster about the intermediate
    axis than about each of the others. That component of the angular velocity then
    changes its sign twice in a period of the polhode, and the body's intermediate axis
    turns over against the angular momentum. A body that always turns mainly about the
    axis of its largest or smallest moment only wobbles, and never flips.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity at any time, body components [rad/s].

    Returns:
        Half of the period of the polhode [s]; infinite where the body never flips: such
        a wobble, any steady rotation, the separatrix, rest, a body of two equal
        moments. NaN outside finite, positive definite inertia and finite rates.

    Gradients: those of `jrigid.free.polhode_period`; 0 where it is infinite.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 37; near the separatrix it
    grows like twice the logarithm of one over the offset, over `growth_rate`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> racket = jnp.array([1.0, 2.0, 3.0])
    >>> print(jr.stability.flip_time(racket, [1e-3, 1.0, 0.0]).round(4))
    28.7314
    >>> print(jr.stability.flip_time(racket, [1e-3, 0.0, 1.0]))
    inf
    """
    inertia, omega = shaped(inertia=(inertia, *INERTIA), omega=(omega, 3))

    def formula(inertia: Array, omega: Array) -> Scalar:
        known, rates = jax.lax.stop_gradient((inertia, omega))
        i1, i2, i3 = (
            jnp.sort(known) if known.ndim == 1 else principal_axes(known).moments
        )
        square = jnp.sum(angular_momentum(known, rates) ** 2)
        twice = 2 * kinetic_energy(known, rates)
        # Where w2 is largest one of the others is 0, and w2^2 exceeds the square of the
        # third.
        outer = jnp.where(square > twice * i2, i3, i1)
        faster = (
            jnp.abs(twice * outer - square) * outer > jnp.abs(square - twice * i2) * i2
        )
        flips = faster & (i1 < i2) & (i2 < i3)
        return jnp.where(flips, 0.5 * polhode_period(inertia, omega), jnp.inf)

    return where_defined(
        is_inertia(inertia) & all_finite(omega), formula, inertia, omega
    )


class FinalSpin(NamedTuple):
    """On which side a tumbling body came to spin.

    Attributes:
        side: One of `SIDES`: whether it turns along the axis of largest moment, against
            it, or is not within 5 degrees of either.
        alignment: Cosine of the angle between the angular velocity and that axis.
        state: At the end.
        error: Largest local error of a step, in the scales of the variables.
        result: `jrigid.RESULTS`.
    """

    side: SIDES
    alignment: Scalar
    state: State
    error: Scalar
    result: Any


def final_spin(
    system: RigidBody,
    state0: State,
    duration: ScalarLike,
    steps: int,
    args: Any = None,
    *,
    t0: ScalarLike = 0.0,
    solver: Any = None,
    throw: bool = True,
) -> FinalSpin:
    """The side on which a body that loses energy ends: the major-axis rule, and its coin.

    What is lost inside, such as by a `torques.InternalDamper`, takes energy but no
    angular momentum from a body, until it spins about the axis of largest moment.
    Whether along it or against it is decided where the motion crosses the separatrix,
    and looks like chance. The axis and its sign are those of `principal_axes` (of
    moments, the body axis itself): two equal largest moments leave no axis to settle
    about.

    Args:
        system: The body and what damps it.
        state0: Where the motion starts.
        duration: How long it is followed [s].
        steps: Number of steps, equal ones; some 20 to 60 for each turn of the fastest
            part.
        args: Passed to the torque.
        t0: Time at the start [s].
        solver: A diffrax solver with an error estimate; `diffrax.Dopri8()` by default.
        throw: False: a bad or an inaccurate lane is a result code and NaN.

    Returns:
        The side, or that it has not settled.

    Raises:
        RuntimeError: Bad value, steps too coarse.

    Gradients: of the state and the alignment, in forward mode; the side has none.
    Source: R. N. Bracewell, O. K. Garriott, Nature 182 (1958) 760, for the rule.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> damper = jr.torques.InternalDamper(0.3, 0.2)
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]), damper)
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 0.1, 0.2]))
    >>> final = jr.stability.final_spin(body, state0, 500.0, 2000)
    >>> print(abs(final.alignment).round(6), jr.stability.SIDES[final.side])
    1.0 against
    """
    steps = whole_number("steps", steps)
    motion = motion_of(system, state0, args, t0, duration, solver)
    return settle(_final_spin(motion, steps), throw, findings_of, motion)


@eqx.filter_jit
def _final_spin(motion: Motion, steps: int) -> FinalSpin:
    findings = findings_of(motion)
    path = walk(motion, steps, findings.ok)
    y, error = in_blocks(lambda path, y: path.follow(0, steps, y), path, path.start)
    state, inertia = path.state(y), path.motion.system.inertia
    if inertia.ndim == 1:
        axis = jnp.eye(3, dtype=y.dtype)[jnp.argmax(inertia)]
    else:
        axis = principal_axes(inertia).axes[:, 2].astype(y.dtype)
    rate = safe_norm(state.omega)
    alignment = jnp.sum(state.omega * axis) / jnp.where(rate > 0, rate, 1.0)
    alignment, state = verdict(findings, error, (alignment, state))
    settled = jnp.abs(alignment) > math.cos(math.radians(_SETTLED))
    side = SIDES.where(alignment > 0, SIDES.along, SIDES.against)
    side = SIDES.where(settled, side, SIDES.not_settled)
    side = SIDES.where(findings.ok, side, SIDES.undefined)
    return FinalSpin(side, alignment, state, error, findings.result)
