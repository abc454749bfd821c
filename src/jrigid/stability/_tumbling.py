"""Sections of a motion, its flips, and the side on which a tumbling body ends."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jrigid._checks import RESULTS, check_option, check_shape, nan_where, whole_number
from jrigid._numerics import safe_norm
from jrigid._types import InertiaLike, Scalar, ScalarLike, VectorLike
from jrigid.dynamics import State
from jrigid.free import polhode_period
from jrigid.mass import principal_axes
from jrigid.stability._roots import PlaceOfRoot
from jrigid.stability._steps import (
    checked_body,
    follow,
    solver_of,
    verdict,
    walk,
)
from jrigid.systems import RigidBody

SIDES = ("along", "not settled", "against")


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
        step: Length of a step [s], the same throughout: some 20 to 60 for each turn of the fastest
            part. Two crossings within one step are missed.
        args: Passed to the torque.
        t0: Time at the start [s].
        direction: True: crossings at which the condition grows; False: falls; None: both.
        steps: Most steps from one crossing to the next: the bound on the cost of a lane.
        solver: A diffrax solver; `diffrax.Dopri8()` by default.
        throw: False: bad input is a result code and NaN.

    Returns:
        States and times of the crossings; a start on the surface itself is none.

    Raises:
        ValueError: Wrong shape or option (trace time).
        RuntimeError: Bad value, a step too coarse (run time, any lane). Fewer crossings than asked
            for are none: see `valid`.

    Gradients: none to be relied on.
    Source: M. Henon, Physica D 5 (1982) 412; crossings are located as events of diffrax.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 0.3, 0.8]))
    >>> found = jr.stability.poincare_section(body, state0, lambda t, s: s.omega[0], 3, 0.1)
    >>> between = jnp.diff(found.ts) / jr.free.polhode_period(body.inertia, state0.omega)
    >>> print(between.round(6))
    [1. 1.]
    """
    check_option("direction", direction, (True, False, None))
    crossings, steps = whole_number("crossings", crossings), whole_number("steps", steps)
    state0, step, t0 = checked_body(system, state0, step, t0)
    solver = solver_of(solver)
    return _section(
        system, state0, condition, crossings, step, args, t0, direction, steps, solver, throw
    )


@eqx.filter_jit
def _section(
    system: RigidBody,
    state0: State,
    condition: Callable,
    crossings: int,
    step: Array,
    args: Any,
    t0: Array,
    direction: bool | None,
    steps: int,
    solver: Any,
    throw: bool,
) -> Section:
    path = walk(system, state0, step, 1, args, t0, solver)
    dtype = path.start.dtype
    step, ok = path.step, path.findings.ok
    field: Any = path.field
    term = diffrax.ODETerm(lambda t, y, _: field(t, y))
    eps = float(jnp.finfo(dtype).eps)
    tolerance: Any = step * (1e-11 if eps < 1e-10 else 1e-5)

    def of(t: Array, y: Array) -> Array:
        found = jnp.asarray(condition(t, path.to_state(y)), dtype)
        check_shape("condition", found, ())
        return found

    # Just after a crossing rounding may leave the motion before it: the first instant is taken to
    # lie on the side to which it crossed.
    def crossing(carry: tuple, _: None) -> tuple[tuple, tuple]:
        begun, y, side, alive, error = carry

        def watched(t: Array, y: Array, args: Any, **_: Any) -> Array:
            del args
            value = of(t, y)
            opening = (t <= begun + 1e-6 * step) & (side != 0)
            return jnp.where(opening, side, value).astype(jnp.result_type(float))

        finder = PlaceOfRoot(rtol=4 * eps, atol=tolerance)
        event = diffrax.Event(watched, finder, direction)
        end = begun + jnp.where(alive, step * steps, step)
        solution = diffrax.diffeqsolve(
            term, solver, begun, end, step, y, None,
            saveat=diffrax.SaveAt(t1=True), event=event, max_steps=steps + 2, throw=False,
        )  # fmt: skip
        alive = alive & (solution.result == diffrax.RESULTS.event_occurred)
        assert solution.ts is not None
        assert solution.ys is not None
        at, there = solution.ts[-1], solution.ys[-1]
        there = jnp.where(alive, path.on_sphere(there), path.start)
        at = jnp.where(alive, at, begun)
        left = jnp.abs(of(at, there))
        error = jnp.maximum(error, jnp.where(alive, path.advance(at, there, none)[2], 0.0))
        found = (at, path.to_state(there), alive, left)
        return (at, there, side_of(at, there), alive, error), found

    def side_of(t: Array, y: Array) -> Array:
        """To which side of the surface the motion goes from here."""
        ahead = of(t + 1e-3 * step, y + 1e-3 * step * path.field(t, y))
        return jnp.where(ahead > of(t, y), 1.0, -1.0).astype(dtype)

    none = jnp.zeros((0, path.dimension), dtype)
    value = of(path.t0, path.start)
    path.findings.require(
        jnp.isfinite(jax.lax.stop_gradient(value)) | ~ok,
        RESULTS.invalid_vector_field,
        "Argument `condition` must be finite at the start, but it is not.",
    )
    # A start on the surface itself is no crossing.
    side = jnp.where(value == 0, side_of(path.t0, path.start), 0.0).astype(dtype)
    error = path.advance(path.t0, path.start, none)[2]
    begin = (path.t0, path.start, side, path.findings.ok, error)
    (*_, error), found = jax.lax.scan(crossing, begin, None, length=crossings)
    ts, states, valid, left = found
    result, ok, (ts, states) = verdict(path.findings, error, (ts, states), throw)
    valid = valid & ok
    ts, states = jax.vmap(lambda good, x: nan_where(~good, x))(valid, (ts, states))
    return Section(states, ts, valid, jnp.max(jnp.where(valid, left, 0)), result)


def flip_time(inertia: InertiaLike, omega: VectorLike) -> Scalar:
    """Time between two flips of a free body about its intermediate axis: the tennis racket's.

    A flip is a change of sign of the angular velocity's component along the intermediate axis.

    Args:
        inertia: Principal moments or tensor [kg m^2].
        omega: Angular velocity at any time, body components [rad/s].

    Returns:
        Half of the period of the polhode [s]; infinite on the separatrix and at rest.

    Gradients: those of `jrigid.free.polhode_period`.
    Source: Landau & Lifshitz, Mechanics, 3rd ed., section 37; near the separatrix it grows like
    twice the logarithm of one over the offset, over `growth_rate`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.stability.flip_time([1.0, 2.0, 3.0], [1e-3, 1.0, 0.0]).round(4))
    28.7314
    """
    return 0.5 * polhode_period(inertia, omega)


class FinalSpin(NamedTuple):
    """On which side a tumbling body came to spin.

    Attributes:
        side: Index into `SIDES`: whether it turns along the axis of largest moment, against it, or
            is not within 5 degrees of either.
        alignment: Cosine of the angle between the angular velocity and that axis.
        state: At the end.
        error: Largest local error of a step, in the scales of the variables.
        result: `jrigid.RESULTS`.
    """

    side: Int[Array, ""]
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

    What is lost inside, such as by a `torques.InternalDamper`, takes energy but no angular momentum
    from a body, until it spins about the axis of largest moment. Whether along it or against it is
    decided where the motion crosses the separatrix, and looks like chance. The axis and its sign
    are those of `principal_axes` (of moments, the body axis itself): two equal largest moments
    leave no axis to settle about.

    Args:
        system: The body and what damps it.
        state0: Where the motion starts.
        duration: How long it is followed [s].
        steps: Number of steps, equal ones; some 20 to 60 for each turn of the fastest part.
        args: Passed to the torque.
        t0: Time at the start [s].
        solver: A diffrax solver with an error estimate; `diffrax.Dopri8()` by default.
        throw: False: a bad or an inaccurate lane is a result code and NaN.

    Returns:
        The side, or that it has not settled.

    Raises:
        ValueError: Wrong shape or option (trace time).
        RuntimeError: Bad value, steps too coarse (run time, any lane).

    Gradients: of the state and the alignment, in forward mode; the side has none.
    Source: R. N. Bracewell, O. K. Garriott, Nature 182 (1958) 760, for the rule.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> damper = jr.torques.InternalDamper(0.3, 0.2)
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]), damper)
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 0.1, 0.2]))
    >>> found = jr.stability.final_spin(body, state0, 500.0, 2000)
    >>> print(abs(found.alignment).round(6), jr.stability.SIDES[found.side])
    1.0 against
    """
    steps = whole_number("steps", steps)
    state0, duration, t0 = checked_body(system, state0, duration, t0)
    return _final_spin(system, state0, duration, steps, args, t0, solver_of(solver), throw)


@eqx.filter_jit
def _final_spin(
    system: RigidBody,
    state0: State,
    duration: Array,
    steps: int,
    args: Any,
    t0: Array,
    solver: Any,
    throw: bool,
) -> FinalSpin:
    path = walk(system, state0, duration, steps, args, t0, solver)
    none = jnp.zeros((0, path.dimension), path.start.dtype)
    y, _, error = follow(path, 0, steps, path.start, none)
    state = path.to_state(y)
    inertia = jnp.where(path.findings.ok, system.inertia, jnp.ones_like(system.inertia))
    if inertia.ndim == 1:
        axis = jnp.eye(3, dtype=y.dtype)[jnp.argmax(inertia)]
    else:
        axis = principal_axes(system.inertia).axes[:, 2].astype(y.dtype)
    rate = safe_norm(state.omega)
    alignment = jnp.sum(state.omega * axis) / jnp.where(rate > 0, rate, 1.0)
    result, ok, found = verdict(path.findings, error, (alignment, state), throw)
    alignment, state = found
    settled = jnp.abs(alignment) > jnp.cos(jnp.radians(jnp.asarray(5.0, y.dtype)))
    side = jnp.where(settled, jnp.where(alignment > 0, 0, 2), 1)
    return FinalSpin(jnp.where(ok, side, -1), alignment, state, error, result)
