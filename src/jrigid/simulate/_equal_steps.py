"""Solvers without an error estimate: steps of equal length, which are all accepted."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from jrigid._motion_inputs import depends_on
from jrigid._stepping.control import SMALLEST_BOUND
from jrigid._stepping.engine import Engine
from jrigid._stepping.motion import Motion
from jrigid._stepping.steppers import EqualSteps
from jrigid._types import BodyState, ScalarLike, Vector
from jrigid.simulate._options import Options
from jrigid.simulate._prepare import Prepared, opened
from jrigid.solvers import FreeRotation, Splitting
from jrigid.systems import RigidBody


def equal_steps(given: Prepared, options: Options) -> tuple[Engine, Motion]:
    """An engine for the steps of a solver, and the motion with its parameters."""
    system = given.inputs.system
    args = given.inputs.args
    solver = options.solver
    motion = given.motion
    limits = motion.limits

    def terms_of(t: Array, h: Array) -> Any:
        """Terms that the solver integrates in a step."""
        if not isinstance(solver, Splitting):
            return FreeRotation(system.inertia.astype(motion.y0.dtype))

        def torque(time: ScalarLike, state: BodyState, args: PyTree) -> Vector:
            if motion.jumps.size:
                # Kicks at the ends of a step belong to its own side of a jump.
                # In a very short step the two ends must not change places.
                beside = jnp.minimum(jnp.max(motion.beside), 0.25 * h)
                time = jnp.clip(time, t + beside, t + h - beside)
            return system.torque_on(given.start + time, state, args)

        return solver.terms(RigidBody(system.inertia, torque))

    if isinstance(solver, Splitting):
        longest = options.max_step
        # The time does not matter here, since only the dependence on omega is examined.
        torque = partial(system.torque_on, limits.end)
        _check_splitting(torque, given.inputs.state0, args)
    else:
        # Steps are short, so that an event rarely misses a change of sign.
        longest = jnp.minimum(SMALLEST_BOUND / given.fastest, options.max_step)

    def advance(t: Array, h: Array, y: Array) -> Array:
        state = given.to_state(y)
        terms = terms_of(t, h)
        after = solver.step(terms, t, t + h, state, args, None, False)[0]
        return ravel_pytree(after)[0]

    # A motion has derivatives in the arrays that are its parameters.
    plain, parameters = opened(advance, limits.end, limits.end, motion.y0)
    # The rate of an invalid motion may be NaN. It takes no step.
    longest = jnp.where(given.findings.ok, longest, 1.0)
    # Derivatives are those of the same steps.
    fine = jnp.full_like(limits.fine, jnp.inf)
    limits = limits._replace(longest=longest, fine=fine)
    motion = motion._replace(parameters=parameters, limits=limits)
    return Engine(given.field, EqualSteps(plain), options.max_steps), motion


def _check_splitting(
    torque: Callable[..., Vector], state0: BodyState, args: PyTree
) -> None:
    """Raise ValueError for a torque that splitting cannot integrate."""

    def of_omega(omega: Array) -> Array:
        return torque(dataclasses.replace(state0, omega=omega), args)

    if depends_on(of_omega, state0.omega) or jtu.tree_leaves(state0.internal):
        raise ValueError(
            "Argument `solver` must not be Splitting where the torque depends on the "
            "angular velocity or the body has moving parts, but it is."
        )
