"""Symplectic splitting: free motion, exactly, between kicks by the torque of a potential."""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from jrigid._checks import check_type
from jrigid.dynamics import angular_momentum, euler_equations
from jrigid.rotation import normalize
from jrigid.solvers._dense import Dense
from jrigid.solvers._exact import FreeRotation
from jrigid.systems import RigidBody

# Steps of order 2 that make one of a higher order, the first half of them and the
# middle one: M. Suzuki, Phys. Lett. A 146 (1990) 319; W. Kahan, R.-C. Li, Math. Comp.
# 66 (1997) 1089.
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
    """What is no array, for a loop to carry."""

    value: Any = eqx.field(static=True)


class _ShorterStep(Dense):
    """Dense output that is a step as far as is asked for."""

    t0: Any
    t1: Any
    y0: Any
    arrays: Any
    rest: _Rest

    def at(self, t: Any) -> Any:
        """The state at t."""
        solver, terms, args = eqx.combine(self.arrays, self.rest.value)
        return solver._moved(terms, self.t0, t, self.y0, args)


def _kick(body: RigidBody, t: Any, y: Any, args: Any) -> Any:
    """What the torque does alone."""
    rest = jtu.tree_map(jnp.zeros_like, y)
    inertia = body.inertia.astype(y.omega.dtype)
    rate = euler_equations(inertia, rest.omega, body.torque_on(t, y, args))
    return eqx.tree_at(lambda y: y.omega, rest, rate)


def _unbiased(inertia: Any, before: Any, after: Any) -> Any:
    """A free motion whose rounding does not add up over millions of steps.

    Size of the momentum, energy and norm of the attitude are what they were, to a
    rounding that is as often up as down.
    """
    old, new = jax.lax.stop_gradient((before.omega, after.omega))
    inertia = jax.lax.stop_gradient(inertia).astype(new.dtype)
    inertia = inertia / jnp.max(jnp.abs(inertia))  # whose unit drops out
    step, mean = (
        angular_momentum(inertia, new - old),
        angular_momentum(inertia, new + old),
    )
    momentum = angular_momentum(inertia, new)
    square = jnp.sum(momentum**2)
    excess, energy = 0.5 * jnp.sum(step * mean), 0.5 * jnp.sum((new - old) * mean)
    safe = jnp.where(square > 0, square, 1.0)
    energy = energy - excess / safe * jnp.sum(new * momentum)
    across = new - jnp.sum(new * momentum) / safe * momentum
    width = jnp.sum(across**2) + 1e-20 * jnp.sum(new**2)
    change = (
        excess / safe * momentum + energy / jnp.where(width > 0, width, 1.0) * across
    )
    omega = after.omega - euler_equations(inertia, 0 * new, change)
    return dataclasses.replace(after, attitude=normalize(after.attitude), omega=omega)


class Splitting(diffrax.AbstractSolver):
    r"""Symplectic steps for a body in a potential: kicks by the torque between exact free motions.

    Steps are of one length. They preserve the symplectic form and are their own inverse
    backward in time, so the energy does not drift: its error stays of the order of
    step^order, whatever the time, until rounding adds up, nearly as a random walk. A
    momentum about an axis of symmetry of the potential and |q| = 1 are kept to
    rounding. An adaptive method of the same price is ahead for longer the stronger the
    torque (docs/simulate.md). `simulate(body, ..., solver=Splitting(), max_step=h)`
    divides the time from each output to the next into equal steps no longer than h; of
    `rtol` it knows nothing. A torque may depend on attitude and time alone: any other
    is an error there.

    In `diffrax.diffeqsolve` it solves the pair of terms `Splitting.terms(body)` by
    constant steps; its dense output is a shorter step, which costs as much as one.

    Gradients: those of the method. A torque that turns NaN on the way makes NaN of the
    gradients of what lanes share, too.
    Source: A. Dullweber, B. Leimkuhler, R. McLachlan, J. Chem. Phys. 107 (1997) 5840,
    with the free motion in closed form; composed after Suzuki (order 4) and Kahan and
    Li (order 6).

    >>> import jax.numpy as jnp, jrigid as jr
    >>> weight = jr.torques.UniformGravity(1.0, jnp.array([0.3, 0.1, 0.5]), jnp.array([0, 0, -1.0]))
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]), weight)
    >>> state0 = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.1, 1.0, 0.3]))
    >>> solver = jr.solvers.Splitting(order=6)
    >>> motion = jr.simulate(body, state0, jnp.array([0, 1e3]), solver=solver, max_step=0.2)
    >>> print(abs(motion.energy[1] / motion.energy[0] - 1) < 1e-6)
    True
    """

    _order: int = eqx.field(static=True)
    term_structure: ClassVar = diffrax.MultiTerm[
        tuple[FreeRotation, diffrax.AbstractTerm]
    ]
    interpolation_cls: ClassVar[Callable[..., _ShorterStep]] = _ShorterStep

    def __init__(self, order: int = 4):
        """Steps of an order.

        Args:
            order: 2, 4 or 6, for one, five or nine free motions a step.

        Raises:
            ValueError: Another order.
        """
        if order not in _HALVES:
            raise ValueError(
                f"Argument `order` must be 2, 4 or 6, but it is {order!r}."
            )
        self._order = order

    def order(self, terms: Any) -> int:
        """That of the steps."""
        del terms
        return self._order

    @staticmethod
    def terms(body: RigidBody) -> diffrax.MultiTerm:
        """The free body, and what its torque does to the angular velocity."""
        check_type("body", body, RigidBody)
        kicks = diffrax.ODETerm(jtu.Partial(_kick, body))
        return diffrax.MultiTerm(FreeRotation(body.inertia), kicks)

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> None:
        """Nothing is carried from step to step."""
        del terms, t0, t1, y0, args

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        """The vector field."""
        return jtu.tree_map(jnp.add, *terms.vf(t0, y0, args))

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: Any,
        args: Any,
        solver_state: Any,
        made_jump: Any,
    ) -> tuple[Any, None, dict[str, Any], None, Any]:
        """The state at t1, with no error estimate."""
        del solver_state, made_jump
        arrays, rest = eqx.partition((self, terms, args), eqx.is_array)
        info = {"y0": y0, "arrays": arrays, "rest": _Rest(rest)}
        return (
            self._moved(terms, t0, t1, y0, args),
            None,
            info,
            None,
            diffrax.RESULTS.successful,
        )

    def _moved(self, terms: Any, t0: Any, t1: Any, y: Any, args: Any) -> Any:
        """The state at t1: kicks, with free motions between them."""
        # diffeqsolve lets time grow, and wraps the terms in ones that know its
        # direction.
        direction = getattr(terms.terms[0], "direction", 1)
        free, push = (getattr(term, "term", term) for term in terms.terms)
        start, h = direction * t0, direction * (t1 - t0)
        half = _HALVES[self._order]
        drifts = np.array([*half, *half[-2::-1]])
        kicks = 0.5 * (np.append(drifts, 0.0) + np.append(0.0, drifts))

        def kicked(y: Any, weight: Any, passed: Any) -> Any:
            t = start + passed * h
            change = push.prod(push.vf(t, y, args), push.contr(0 * h, weight * h))
            return jtu.tree_map(jnp.add, y, change)

        def stage(y: Any, numbers: Any) -> tuple[Any, None]:
            weight, passed, drift = numbers
            before = kicked(y, weight, passed)
            return _unbiased(free.inertia, before, free.after(before, drift * h)), None

        passed = np.append(0.0, np.cumsum(drifts)[:-1])
        numbers = [jnp.asarray(x, h.dtype) for x in (kicks[:-1], passed, drifts)]
        y, _ = jax.lax.scan(stage, y, tuple(numbers))
        return kicked(y, numbers[0][0], 1.0)
