"""Symplectic splitting: exact free motions between kicks by a torque."""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from jrigid._checks import check_type
from jrigid._core.third_party import unwrapped_term
from jrigid._types import RotationState, TimeLike
from jrigid.dynamics import State, angular_momentum, euler_equations
from jrigid.rotation import normalize
from jrigid.solvers._dense import Dense
from jrigid.solvers._exact import FreeRotation
from jrigid.systems import RigidBody

# Lengths of the steps of order 2 that make one of a higher order: the first half of
# them and the middle one. M. Suzuki, Phys. Lett. A 146 (1990) 319; W. Kahan, R.-C. Li,
# Math. Comp. 66 (1997) 1089.
# Steps of length s, s, 1 - 4 s, s, s have no error of third order: this is the solution
# of 4 s^3 + (1 - 4 s)^3 = 0.
_SUZUKI = 1 / (4 - 4 ** (1 / 3))
_HALVES = {
    2: [1.0],
    4: [_SUZUKI, _SUZUKI, 1 - 4 * _SUZUKI],
    6: [
        0.39216144400731413928,
        0.33259913678935943860,
        -0.70624617255763935981,
        0.082213596293550800230,
        0.79854399093482996340,
    ],
}


class _Rest(eqx.Module):
    """The parts of a pytree that are no arrays, for a loop to carry."""

    value: Any = eqx.field(static=True)


class _ShorterStep(Dense):
    """Dense output by a step to the time of the output."""

    t0: TimeLike
    t1: TimeLike
    y0: RotationState
    arrays: PyTree
    rest: _Rest

    def at(self, t: TimeLike) -> RotationState:
        """The state at t."""
        solver, terms, args = eqx.combine(self.arrays, self.rest.value)
        return solver._moved(terms, self.t0, t, self.y0, args)


def _kick(body: RigidBody, t: TimeLike, y: State, args: PyTree) -> State:
    """Rate of the state by the torque alone."""
    rest = jtu.tree_map(jnp.zeros_like, y)
    inertia = body.inertia.astype(y.omega.dtype)
    # At zero rates Euler's equations have no term but the torque.
    rate = euler_equations(inertia, rest.omega, body.torque_on(t, y, args))
    return eqx.tree_at(lambda y: y.omega, rest, rate)


def _unbiased(
    inertia: Array, before: RotationState, after: RotationState
) -> RotationState:
    """Correct a free motion so that its rounding does not add up over many steps.

    The size of the angular momentum, the energy and the norm of the attitude become
    what they were before, to a rounding that is as often up as down.
    """
    # The correction is of the size of rounding, so its derivative does not matter.
    old, new = jax.lax.stop_gradient((before.omega, after.omega))
    inertia = jax.lax.stop_gradient(inertia).astype(new.dtype)
    # The unit of the inertia cancels.
    inertia = inertia / jnp.max(jnp.abs(inertia))
    step = angular_momentum(inertia, new - old)
    mean = angular_momentum(inertia, new + old)
    momentum = angular_momentum(inertia, new)
    square = jnp.sum(momentum**2)
    # Changes of |L|^2 / 2 and of the energy: a product of difference and sum loses
    # fewer digits than a difference of squares.
    excess = 0.5 * jnp.sum(step * mean)
    energy = 0.5 * jnp.sum((new - old) * mean)
    safe = jnp.where(square > 0, square, 1.0)
    # The correction along L changes the energy as well, by this amount to first order.
    energy = energy - excess / safe * jnp.sum(new * momentum)
    # The part of omega normal to L: a change of L along it changes the energy alone.
    across = new - jnp.sum(new * momentum) / safe * momentum
    # Zero for rotation about a principal axis, where the energy needs no correction.
    width = jnp.sum(across**2) + 1e-20 * jnp.sum(new**2)
    # To first order this change of L removes both errors: `across` is normal to L.
    change = (
        excess / safe * momentum + energy / jnp.where(width > 0, width, 1.0) * across
    )
    # At zero rates Euler's equations return I^-1 times the change of L.
    omega = after.omega - euler_equations(inertia, 0 * new, change)
    return dataclasses.replace(after, attitude=normalize(after.attitude), omega=omega)


class Splitting(diffrax.AbstractSolver):
    r"""Symplectic steps for a body in a potential: kicks between exact free motions.

    Steps have one length. They preserve the symplectic form and are their own inverse
    backward in time, so the energy does not drift. Its error stays of the order of
    step^order at any time, until rounding adds up, nearly as a random walk. The angular
    momentum about an axis of symmetry of the potential and |q| = 1 hold to rounding. An
    adaptive method of the same cost is more accurate for some time, which is longer for
    a stronger torque (docs/simulate.md).

    `simulate(body, ..., solver=Splitting(), max_step=h)` divides the time from each
    output to the next into equal steps no longer than h, without regard to `rtol`. The
    torque may depend on attitude and time alone; `simulate` raises an error for any
    other.

    In `diffrax.diffeqsolve` the solver solves the pair of terms `Splitting.terms(body)`
    by constant steps. Its dense output is a shorter step, which costs as much as a
    step.

    Gradients: those of the method. If a torque becomes NaN during the motion, the
    gradients of what lanes share are NaN too.
    Source: A. Dullweber, B. Leimkuhler, R. McLachlan, J. Chem. Phys. 107 (1997) 5840,
    with the free motion in closed form; composed after Suzuki (order 4) and Kahan and
    Li (order 6).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> lever, gravity = jnp.array([0.3, 0.1, 0.5]), jnp.array([0, 0, -1.0])
    >>> weight = jr.torques.UniformGravity(1.0, lever, gravity)
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]), weight)
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.1, 1.0, 0.3]))
    >>> solver = jr.solvers.Splitting(order=6)
    >>> ts = jnp.array([0, 1e3])
    >>> motion = jr.simulate(body, state0, ts, solver=solver, max_step=0.2)
    >>> print(abs(motion.energy[1] / motion.energy[0] - 1) < 1e-6)
    True
    """

    _order: int = eqx.field(static=True)
    term_structure: ClassVar = diffrax.MultiTerm[
        tuple[FreeRotation, diffrax.AbstractTerm]
    ]
    interpolation_cls: ClassVar[Callable[..., _ShorterStep]] = _ShorterStep

    def __init__(self, order: int = 4):
        """A splitting of some order.

        Args:
            order: 2, 4 or 6; a step then has one, five or nine free motions.

        Raises:
            ValueError: Another order.
        """
        if order not in _HALVES:
            raise ValueError(
                f"Argument `order` must be 2, 4 or 6, but it is {order!r}."
            )
        self._order = order

    def order(self, terms: PyTree) -> int:
        """Order of the steps."""
        del terms
        return self._order

    @staticmethod
    def terms(body: RigidBody) -> diffrax.MultiTerm:
        """The free body, and what its torque does to the angular velocity."""
        check_type("body", body, RigidBody)
        kicks = diffrax.ODETerm(jtu.Partial(_kick, body))
        return diffrax.MultiTerm(FreeRotation(body.inertia), kicks)

    def init(
        self,
        terms: diffrax.MultiTerm,
        t0: TimeLike,
        t1: TimeLike,
        y0: RotationState,
        args: PyTree,
    ) -> None:
        """The solver has no state."""
        del terms, t0, t1, y0, args

    def func(
        self,
        terms: diffrax.MultiTerm,
        t0: TimeLike,
        y0: RotationState,
        args: PyTree,
    ) -> RotationState:
        """The vector field."""
        return jtu.tree_map(jnp.add, *terms.vf(t0, y0, args))

    def step(
        self,
        terms: diffrax.MultiTerm,
        t0: TimeLike,
        t1: TimeLike,
        y0: RotationState,
        args: PyTree,
        solver_state: None,
        made_jump: ArrayLike,
    ) -> tuple[RotationState, None, dict[str, PyTree], None, diffrax.RESULTS]:
        """The state at t1, with no error estimate."""
        del solver_state, made_jump
        arrays, rest = eqx.partition((self, terms, args), eqx.is_array)
        info = {"y0": y0, "arrays": arrays, "rest": _Rest(rest)}
        y1 = self._moved(terms, t0, t1, y0, args)
        return y1, None, info, None, diffrax.RESULTS.successful

    def _moved(
        self,
        terms: diffrax.MultiTerm,
        t0: TimeLike,
        t1: TimeLike,
        y: RotationState,
        args: PyTree,
    ) -> RotationState:
        """The state at t1: kicks, with free motions between them."""
        free, direction = unwrapped_term(terms.terms[0])
        torque, _ = unwrapped_term(terms.terms[1])
        start = direction * t0
        h: Array = direction * (t1 - t0)
        drifts, kicks, passed = _fractions(self._order)

        def kicked(y: RotationState, weight: Array, passed: TimeLike) -> RotationState:
            t = start + passed * h
            rate = torque.vf(t, y, args)
            # Far from time 0 the difference of two times would lose digits of the step.
            change = torque.prod(rate, torque.contr(0 * h, weight * h))
            return jtu.tree_map(jnp.add, y, change)

        def stage(
            y: RotationState, fractions: tuple[Array, Array, Array]
        ) -> tuple[RotationState, None]:
            weight, passed, drift = fractions
            before = kicked(y, weight, passed)
            return _unbiased(free.inertia, before, free.after(before, drift * h)), None

        weights, passed, drifts = (
            jnp.asarray(x, h.dtype) for x in (kicks[:-1], passed, drifts)
        )
        y, _ = jax.lax.scan(stage, y, (weights, passed, drifts))
        # The last kick is as long as the first one.
        return kicked(y, weights[0], 1.0)


def _fractions(order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The parts of a step: free motions, kicks, and when each free motion starts.

    There is a kick before each free motion and one after the last.
    """
    half = _HALVES[order]
    # A symmetric composition is its own inverse backward in time.
    drifts = np.array([*half, *half[-2::-1]])
    # Steps of order 2 begin and end with half a kick. Halves that meet are joined.
    kicks = 0.5 * (np.append(drifts, 0.0) + np.append(0.0, drifts))
    passed = np.append(0.0, np.cumsum(drifts)[:-1])
    return drifts, kicks, passed
