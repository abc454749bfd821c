"""The free body: its equations, and a diffrax solver that solves them exactly."""

import dataclasses
from collections.abc import Callable
from typing import ClassVar

import diffrax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Float, PyTree

from jrigid._checks import INERTIA, array_of_shape, float_arrays
from jrigid._core.third_party import unwrapped_term
from jrigid._types import InertiaLike, RotationState, TimeLike
from jrigid.dynamics import euler_equations
from jrigid.free import relative_rotation
from jrigid.rotation import attitude_rate, multiply
from jrigid.solvers._dense import Dense


class FreeRotation(diffrax.AbstractTerm):
    """The equations of a free body, for any diffrax solver and for `ExactFree`.

    The state is a `State`, or any dataclass with `attitude` and `omega`. Its other
    fields are constant.

    Attributes:
        inertia: Principal moments or tensor [kg m^2]; not checked.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> term = jr.solvers.FreeRotation(jnp.array([1.0, 2.0, 3.0]))
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 1.0, 1.0]))
    >>> print(term.vf(0.0, state, None).omega.round(6))
    [-1.        1.       -0.333333]
    """

    inertia: Float[Array, "..."]

    def __init__(self, inertia: InertiaLike):
        """The free body with this inertia."""
        self.inertia = array_of_shape("inertia", inertia, *INERTIA)

    def vf(self, t: TimeLike, y: RotationState, args: PyTree) -> RotationState:
        """Time derivative of the state."""
        del t, args
        rest = jtu.tree_map(lambda x: 0 * x, y)
        omega = euler_equations(self.inertia.astype(y.omega.dtype), y.omega)
        attitude = attitude_rate(y.attitude, y.omega)
        return dataclasses.replace(rest, attitude=attitude, omega=omega)

    def contr(self, t0: TimeLike, t1: TimeLike, **_: object) -> TimeLike:
        """The step of time."""
        return t1 - t0

    def prod(self, vf: RotationState, control: TimeLike) -> RotationState:
        """Derivative times step."""
        return jtu.tree_map(lambda rate: control * rate, vf)

    def after(self, y: RotationState, step: TimeLike) -> RotationState:
        """The state a time `step` later [s], exactly."""
        inertia, omega, step = (
            x.astype(y.omega.dtype) for x in float_arrays(self.inertia, y.omega, step)
        )
        turn, omega = relative_rotation(inertia, omega, step)
        return dataclasses.replace(y, attitude=multiply(y.attitude, turn), omega=omega)


class _ExactInterpolation(Dense):
    """Dense output that is the exact motion."""

    t0: TimeLike
    t1: TimeLike
    y0: RotationState
    inertia: Float[Array, "..."]
    direction: Float[Array, ""]

    def at(self, t: TimeLike) -> RotationState:
        """The state at t."""
        return FreeRotation(self.inertia).after(self.y0, self.direction * (t - self.t0))


class ExactFree(diffrax.AbstractSolver):
    """The exact flow of the free body as a diffrax solver: a step has any length.

    `simulate(RigidBody(inertia), ..., solver=ExactFree())` evaluates the closed form at
    the output times. In `diffrax.diffeqsolve` the solver solves the term
    `FreeRotation(inertia)`, and its dense output is exact too. A splitting scheme can
    call its `step`, or `FreeRotation.after`, as a stage. The norm of an attitude does
    not change.

    Gradients: those of the motion, see `jrigid.free_rotation`.
    Source: docs/free_rotation.md; as a stage: A. Dullweber, B. Leimkuhler, R.
    McLachlan, J. Chem. Phys. 107 (1997) 5840.

    >>> import diffrax, jax.numpy as jnp, jrigid as jr
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 2.0]))
    >>> solution = diffrax.diffeqsolve(
    ...     jr.solvers.FreeRotation(jnp.array([1.0, 2.0, 3.0])), jr.solvers.ExactFree(),
    ...     t0=0.0, t1=jnp.pi, dt0=jnp.pi, y0=state)
    >>> print(solution.ys.attitude[-1].round(6))
    [-1.  0.  0.  0.]
    """

    term_structure: ClassVar = FreeRotation
    interpolation_cls: ClassVar[Callable[..., _ExactInterpolation]] = (
        _ExactInterpolation
    )

    def order(self, terms: PyTree) -> None:
        """None, since the error does not depend on the step."""
        del terms

    def init(
        self,
        terms: diffrax.AbstractTerm,
        t0: TimeLike,
        t1: TimeLike,
        y0: RotationState,
        args: PyTree,
    ) -> None:
        """The solver has no state."""
        del terms, t0, t1, y0, args

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: TimeLike,
        t1: TimeLike,
        y0: RotationState,
        args: PyTree,
        solver_state: None,
        made_jump: ArrayLike,
    ) -> tuple[RotationState, None, dict[str, PyTree], None, diffrax.RESULTS]:
        """The state at t1, with no error estimate."""
        del args, solver_state, made_jump
        # In a run backward in time `diffeqsolve` passes growing times, and the term
        # holds the direction.
        term, direction = unwrapped_term(terms)
        direction = jnp.asarray(direction, y0.omega.dtype)
        info = {"y0": y0, "inertia": term.inertia, "direction": direction}
        y1 = term.after(y0, direction * (t1 - t0))
        return y1, None, info, None, diffrax.RESULTS.successful

    def func(
        self,
        terms: diffrax.AbstractTerm,
        t0: TimeLike,
        y0: RotationState,
        args: PyTree,
    ) -> RotationState:
        """The vector field."""
        return terms.vf(t0, y0, args)
