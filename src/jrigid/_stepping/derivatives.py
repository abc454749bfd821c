"""Derivatives of motions: in reverse mode, in forward mode, and in every mode."""

from collections.abc import Callable
from functools import partial
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from jrigid._core.lanes import as_lanes
from jrigid._stepping.engine import Engine
from jrigid._stepping.guards import guard_derivative
from jrigid._stepping.method import method_of
from jrigid._stepping.motion import Motion, constant, steps_fixed
from jrigid._stepping.replay import Cotangents, pull_alone, pull_in_lanes
from jrigid._stepping.run import Ends, record_alone, run_alone, run_in_lanes
from jrigid._stepping.step import equal_steps


def _with_fine_steps(motion: Motion) -> Motion:
    """The motion, with the step bounds that derivatives need."""
    return motion._replace(limits=motion.limits.for_derivatives())


def solve(engine: Engine, motion: Motion) -> Ends:
    """Run a motion without derivatives; under `jax.vmap` many motions, in lanes."""

    def alone(problem: Motion, y0: Array) -> Ends:
        return run_alone(engine, problem._replace(y0=y0))

    def together(shared: Motion, each: Motion, y0: Array) -> Ends:
        return run_in_lanes(engine, shared, each._replace(y0=y0))

    return as_lanes(together, motion._replace(y0=None), motion.y0, alone=alone)


def solve_reverse(engine: Engine, motion: Motion) -> Ends:
    """Run a motion with first derivatives in reverse mode."""
    solved = eqx.filter_custom_vjp(partial(solve, engine))

    def forwards(perturbed: Motion, motion: Motion) -> tuple[Ends, tuple[Array, Array]]:
        del perturbed
        # The value takes the finer steps too, since its own steps are reversed.
        ends = solve(engine, guard_derivative(_with_fine_steps(motion)))
        # The steps are not stored: the backward pass runs the motion again.
        return ends, (ends.t, ends.counts[1])

    def backwards(
        reached: tuple[Array, Array], change: Ends, perturbed: Motion, motion: Motion
    ) -> Motion:
        motion, change = guard_derivative((motion, change))
        return _pulled_back(engine, motion, change, perturbed, *reached)

    solved.def_fwd(forwards)
    solved.def_bwd(backwards)
    return solved(steps_fixed(motion))


def _pulled_back(
    engine: Engine,
    motion: Motion,
    change: Ends,
    perturbed: Motion,
    end: Array,
    tried: Array,
) -> Motion:
    """Cotangents of the parameters and of the start, from those of the results.

    Args:
        engine: Integrates the motion.
        motion: The motion.
        change: Cotangents of its results, None where there is none.
        perturbed: Which parts of the motion have derivatives.
        end: Where the motion ended.
        tried: Number of attempts after which it ended.
    """
    zeros = jnp.zeros((*motion.times.shape, *motion.y0.shape), motion.y0.dtype)
    changes = Cotangents(
        zeros if change.ys is None else change.ys,
        jnp.zeros_like(motion.y0) if change.y is None else change.y,
    )
    # The second run ends where the first one ended: at an event, or where it failed.
    motion = _with_fine_steps(motion)
    motion = motion._replace(limits=motion.limits._replace(end=end))
    varied, rest = _split(motion, perturbed)
    total, y0 = as_lanes(
        partial(pull_in_lanes, engine),
        rest,
        varied,
        changes,
        tried,
        alone=partial(pull_alone, engine),
    )
    # The parameters of a motion without steps need not be finite.
    total = jtu.tree_map(lambda x: jnp.where(tried > 0, x, 0.0), total)
    return total._replace(y0=y0)


def solve_forward(engine: Engine, motion: Motion) -> Ends:
    """Run a motion with derivatives in forward mode, along the steps of its value."""
    solved = eqx.filter_custom_jvp(partial(solve, engine))

    @solved.def_jvp
    def _(primals: tuple[Motion], tangents: tuple[PyTree]) -> tuple[Ends, Ends]:
        (motion,) = primals
        (tangent,) = tangents
        return _pushed_forward(engine, motion, tangent)

    return solved(steps_fixed(motion))


def _is_none(x: PyTree) -> bool:
    """Whether a leaf is None."""
    return x is None


def _pushed_forward(
    engine: Engine, motion: Motion, tangent: Motion
) -> tuple[Ends, Ends]:
    """The results of a motion and their tangents, from a tangent of the motion."""

    def of_states(value: Ends, tangent: Ends) -> tuple[Ends, Ends]:
        """Drop the tangents of steps, which are fixed."""
        return value, tangent._replace(t=None, counts=None)

    def alone(rest: Motion, varied: Motion, tangent: Motion) -> tuple[Ends, Ends]:
        def ends(varied: Motion) -> Ends:
            return run_alone(engine, eqx.combine(varied, rest))

        return of_states(*eqx.filter_jvp(ends, (varied,), (tangent,)))

    def together(
        shared: Motion, rest: Motion, varied: Motion, tangent: Motion
    ) -> tuple[Ends, Ends]:
        def ends(varied: Motion) -> Ends:
            return run_in_lanes(engine, shared, eqx.combine(varied, rest))

        return of_states(*eqx.filter_jvp(ends, (varied,), (tangent,)))

    # equinox passes None as the tangent of an array that has no derivative.
    perturbed = jtu.tree_map(lambda x: x is not None, tangent, is_leaf=_is_none)
    varied, rest = _split(_with_fine_steps(motion), perturbed, start=True)
    # The start is among the varied arrays even if only parameters have tangents.
    tangent = eqx.combine(tangent, jtu.tree_map(jnp.zeros_like, varied))
    return as_lanes(together, rest, varied, tangents=tangent, alone=alone)


def _split(
    motion: Motion, perturbed: Motion, start: bool = False
) -> tuple[Motion, Motion]:
    """Split a motion into the parameters that have derivatives, and the rest.

    Args:
        motion: The motion.
        perturbed: Which parameters have derivatives.
        start: Whether the state at the start goes with the parameters.
    """
    which = jtu.tree_map(lambda _: False, motion)
    which = which._replace(parameters=perturbed.parameters, y0=start)
    return eqx.partition(motion, which)


def solve_direct(engine: Engine, motion: Motion) -> Ends:
    """Run a motion with derivatives of every mode and order.

    The first run has no derivatives and records the steps. A scan repeats them.
    """
    motion = _with_fine_steps(steps_fixed(motion))
    end, record = record_alone(engine, constant(motion))

    def step(y: Array, recorded: tuple[Array, Array]) -> tuple[Array, Array]:
        place, jump = recorded
        t, h = place
        smooth = engine.smooth_field(motion, jump)

        # Reverse mode stores a state for each step and computes the stages again.
        @jax.checkpoint
        def taken(y: Array) -> Array:
            # Under vmap lanes without a step are evaluated too. They start from the
            # start of the motion, where the field is finite.
            y = jnp.where(h > 0, y, motion.y0)
            return engine.stepper.taken(smooth, motion.parameters, t, h, y)

        # Except under vmap, a row of the record without a step costs no evaluation.
        after = jax.lax.cond(h > 0, taken, lambda y: y, y)
        y = jnp.where(h > 0, after, y)
        return y, y

    y, after_steps = jax.lax.scan(step, motion.y0, (record.places, record.jumps))
    numbers = jnp.arange(len(after_steps))
    count = motion.times.size
    # The entry after the last output time takes the steps that reach none.
    of_output = jnp.zeros(count + 1, numbers.dtype).at[record.outputs].set(numbers)
    ys = after_steps[of_output[:count]]
    # No step reaches an output time at the start.
    ys = jnp.where((motion.times <= 0)[:, None], motion.y0, ys)
    return Ends(ys, end.t, y, end.counts)


# A step of length zero, whose derivatives are right up to the order of its method.
_STILL = method_of(diffrax.Tsit5())

# A vector field of (parameters, t, y), of a state that may be several arrays.
_Field = Callable[[PyTree, Array, PyTree], PyTree]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def moved_by(
    field: _Field, parameters: PyTree, t: Array, y: PyTree, dt: Array
) -> PyTree:
    """The state a time `dt` later, where `dt` is zero but has derivatives.

    Gradients: of first order in every mode, and of every order forward over forward.
    Reverse mode keeps of the tangents what was computed, which does not show that a
    change of the state depends on `dt`. Beyond its first order use `moved_in_a_step`.
    """
    del field, parameters, t, dt
    return y


# With symbolic zeros the field is evaluated only where times have derivatives.
@partial(moved_by.defjvp, symbolic_zeros=True)
def _moved_by_jvp(field: _Field, primals: tuple, tangents: tuple) -> tuple:
    parameters, t, y, dt = primals
    *changes, dt_dot = tangents
    value = moved_by(field, parameters, t, y, dt)
    changes = jtu.tree_map(_instantiated, tuple(changes), (parameters, t, y))
    parameters_dot, t_dot, y_dot = changes

    def of_both(parameters: PyTree, t: Array, both: PyTree) -> PyTree:
        """The vector field of a state and of its change."""
        parameters, *dots = parameters
        y, y_dot = both
        return jax.jvp(field, (parameters, t, y), (*dots, y_dot))

    # A change of the state moves in `dt`, too.
    parameters = (parameters, parameters_dot, t_dot)
    _, total = moved_by(of_both, parameters, t, (y, y_dot), dt)
    if not isinstance(dt_dot, jax.custom_derivatives.SymbolicZero):
        rates = field(parameters[0], t + dt, value)
        total = jtu.tree_map(lambda x, rate: x + rate * dt_dot, total, rates)
    return value, total


def _instantiated(tangent: PyTree, value: Array) -> PyTree:
    """The tangent of a value as an array, where it is a symbolic zero."""
    if not isinstance(tangent, jax.custom_derivatives.SymbolicZero):
        return tangent
    aval: Any = tangent.aval
    # The tangents of integers are numpy arrays of no size.
    if aval.dtype == jax.dtypes.float0:
        return np.zeros(aval.shape, aval.dtype)
    zeros = jnp.zeros(aval.shape, aval.dtype)
    # JAX's vmap of a function with a rule takes the output to have an axis of lanes
    # only if the inputs that it is computed from have one. These zeros have the axes of
    # the value, so that what is added to them in a rule may have them.
    return jax.lax.select(value == value, zeros, zeros)


def moved_in_a_step(
    field: _Field, parameters: PyTree, t: Array, y: Array, dt: Array
) -> Array:
    """`moved_by` with derivatives in every mode, up to the order of a step's method."""
    moved = equal_steps(_STILL, partial(field, parameters), t, dt, y)
    # The rates of a state need not be finite, and only derivatives need them.
    return jnp.where(jnp.isfinite(moved), moved, y)
