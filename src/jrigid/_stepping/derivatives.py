"""Derivatives of motions: in reverse mode, in forward mode, and in every mode."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._core.lanes import as_lanes
from jrigid._stepping.engine import Engine
from jrigid._stepping.guards import guard_derivative
from jrigid._stepping.motion import Motion, constant, steps_fixed
from jrigid._stepping.replay import Changes, pull_alone, pull_in_lanes
from jrigid._stepping.run import Ends, record_alone, run_alone, run_in_lanes


def _finely(motion: Motion) -> Motion:
    """A motion in steps for derivatives."""
    return motion._replace(limits=motion.limits.for_derivatives())


def solve(engine: Engine, motion: Motion) -> Ends:
    """A motion; under `jax.vmap` many, in lanes. Without derivatives."""

    def alone(problem: Motion, y0: Array) -> Ends:
        return run_alone(engine, problem._replace(y0=y0))

    def together(shared: Motion, each: Motion, y0: Array) -> Ends:
        return run_in_lanes(engine, shared, each._replace(y0=y0))

    return as_lanes(together, motion._replace(y0=None), motion.y0, alone=alone)


def solve_reverse(engine: Engine, motion: Motion) -> Ends:
    """A motion with first derivatives in reverse mode."""
    solved = eqx.filter_custom_vjp(partial(solve, engine))

    def forwards(perturbed: Any, motion: Motion) -> tuple[Ends, Any]:
        del perturbed
        ends = solve(engine, guard_derivative(_finely(motion)))
        return ends, (ends.t, ends.counts[1])

    def backwards(reached: Any, change: Ends, perturbed: Any, motion: Motion) -> Any:
        motion, change = guard_derivative((motion, change))
        t, tried = reached
        zeros = jnp.zeros((*motion.times.shape, *motion.y0.shape), motion.y0.dtype)
        changes = Changes(
            zeros if change.ys is None else change.ys,
            jnp.zeros_like(motion.y0) if change.y is None else change.y,
        )
        # Run again, the motion ends where it ended: at an event, or where it failed.
        motion = _finely(motion)
        motion = motion._replace(limits=motion.limits._replace(end=t))
        moved, rest = _split(motion, perturbed)
        alone, together = (partial(x, engine) for x in (pull_alone, pull_in_lanes))
        total, y0 = as_lanes(together, rest, moved, changes, tried, alone=alone)
        # The parameters of a motion without steps may be anything.
        total = jtu.tree_map(lambda x: jnp.where(tried > 0, x, 0.0), total)
        return total._replace(y0=y0)

    solved.def_fwd(forwards)
    solved.def_bwd(backwards)
    return solved(steps_fixed(motion))


def solve_forward(engine: Engine, motion: Motion) -> Ends:
    """A motion with derivatives in forward mode, along the steps of its value."""
    solved = eqx.filter_custom_jvp(partial(solve, engine))

    def of_states(value: Ends, tangent: Ends) -> tuple[Ends, Ends]:
        """Only states have tangents: steps are fixed."""
        return value, tangent._replace(t=None, counts=None)

    def alone(rest: Motion, moved: Motion, tangent: Motion) -> tuple[Ends, Ends]:
        def ends(moved: Motion) -> Ends:
            return run_alone(engine, eqx.combine(moved, rest))

        return of_states(*eqx.filter_jvp(ends, (moved,), (tangent,)))

    def together(
        shared: Motion, rest: Motion, moved: Motion, tangent: Motion
    ) -> tuple[Ends, Ends]:
        def ends(moved: Motion) -> Ends:
            return run_in_lanes(engine, shared, eqx.combine(moved, rest))

        return of_states(*eqx.filter_jvp(ends, (moved,), (tangent,)))

    @solved.def_jvp
    def _(primals: Any, tangents: Any) -> tuple[Ends, Ends]:
        (motion,), (tangent,) = primals, tangents
        perturbed = jtu.tree_map(
            lambda x: x is not None, tangent, is_leaf=lambda x: x is None
        )
        moved, rest = _split(_finely(motion), perturbed, start=True)
        tangent = eqx.combine(tangent, jtu.tree_map(jnp.zeros_like, moved))
        return as_lanes(together, rest, moved, tangents=tangent, alone=alone)

    return solved(steps_fixed(motion))


def _split(
    motion: Motion, perturbed: Any, start: bool = False
) -> tuple[Motion, Motion]:
    """The parameters that have derivatives, and the start if asked, apart from the rest."""
    which = jtu.tree_map(lambda _: False, motion)
    which = which._replace(parameters=perturbed.parameters, y0=start)
    return eqx.partition(motion, which)


def solve_direct(engine: Engine, motion: Motion) -> Ends:
    """A motion with derivatives of every mode and order.

    The motion is run once without derivatives. Its steps are then repeated, by a scan.
    """
    motion = _finely(steps_fixed(motion))
    end, record = record_alone(engine, constant(motion))

    def step(y: Array, recorded: tuple[Array, Array]) -> tuple[Array, Array]:
        place, jump = recorded
        t, h = place
        smooth = engine.smooth_field(motion, jump)

        @jax.checkpoint
        def taken(y: Array) -> Array:
            # Lanes that take no step do so at their start, where the field is finite.
            y = jnp.where(h > 0, y, motion.y0)
            return engine.stepper.taken(smooth, motion.parameters, t, h, y)

        after = jax.lax.cond(h > 0, taken, lambda y: y, y)
        y = jnp.where(h > 0, after, y)
        return y, y

    y, all_ = jax.lax.scan(step, motion.y0, (record.places, record.jumps))
    numbers = jnp.arange(len(all_))
    count = motion.times.size
    of_output = jnp.zeros(count + 1, numbers.dtype).at[record.outputs].set(numbers)
    ys = all_[of_output[:count]]
    ys = jnp.where((motion.times <= 0)[:, None], motion.y0, ys)
    return Ends(ys, end.t, y, end.counts)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def moved_by(
    field: Callable[[Any, Array, Array], Array],
    parameters: Any,
    t: Array,
    y: Array,
    dt: Array,
) -> Array:
    """A state a time `dt` later, for its derivatives: dt itself is zero."""
    del field, parameters, t, dt
    return y


@partial(moved_by.defjvp, symbolic_zeros=True)
def _moved_by_jvp(field: Callable, primals: tuple, tangents: tuple) -> tuple:
    parameters, t, y, dt = primals
    _, _, y_dot, dt_dot = tangents
    value = moved_by(field, parameters, t, y, dt)
    total = jnp.zeros_like(y)
    if not isinstance(y_dot, jax.custom_derivatives.SymbolicZero):
        total = total + y_dot
    if not isinstance(dt_dot, jax.custom_derivatives.SymbolicZero):
        total = total + field(parameters, t + dt, value) * dt_dot
    return value, total
