"""Any explicit Runge-Kutta method of diffrax, its stages written out."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jrigid._checks import check_type
from jrigid._numerics import materialize
from jrigid._runge_kutta import runge_kutta_step


class Unrolled(diffrax.AbstractAdaptiveSolver):
    """An explicit Runge-Kutta method of diffrax, its stages written out: the same steps, sooner.

    On CPUs, where the state is some numbers and the field cheap, most of a step's time is spent
    between the stages. Here the state is one array and stages are kept apart from each other.

    Attributes:
        solver: The method: `diffrax.Dopri8()`, `diffrax.Tsit5()` or any other explicit one.

    Gradients: those of the method.
    Source: the tableaus and dense outputs of diffrax.

    >>> import diffrax, jax.numpy as jnp, jrigid as jr
    >>> term = diffrax.ODETerm(lambda t, y, args: -y)
    >>> solver = jr.solvers.Unrolled(diffrax.Tsit5())
    >>> print(diffrax.diffeqsolve(term, solver, 0.0, 1.0, 0.1, jnp.ones(1)).ys.round(6))
    [[0.367879]]
    """

    solver: diffrax.AbstractERK
    term_structure: ClassVar = diffrax.AbstractTerm

    def __init__(self, solver: diffrax.AbstractERK):
        """The method."""
        check_type("solver", solver, diffrax.AbstractERK)
        self.solver = solver

    @property
    def interpolation_cls(self) -> Callable[..., diffrax.AbstractLocalInterpolation]:
        """The dense output of the method."""
        return self.solver.interpolation_cls

    def order(self, terms: Any) -> Any:
        """That of the method."""
        return self.solver.order(terms)

    def error_order(self, terms: Any) -> Any:
        """That of the method."""
        return self.solver.error_order(terms)

    def func(self, terms: Any, t0: Any, y0: Any, args: Any) -> Any:
        """The vector field."""
        return terms.vf(t0, y0, args)

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any) -> Any:
        """The rate at the start, which each step hands on to the next."""
        del t1
        return self.func(terms, t0, y0, args)

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Any, Any, dict[str, Any], Any, Any]:
        """One step: its end, its error, what interpolates it, the rate at its end."""
        before = jax.lax.cond(
            eqxi.unvmap_any(made_jump), lambda: terms.vf(t0, y0, args), lambda: solver_state
        )
        flat, unravel = ravel_pytree(y0)

        def rate(fraction: float, place: Array) -> Array:
            (place,) = materialize(place)
            rates = terms.vf(t0 + fraction * (t1 - t0), unravel(place), args)
            return materialize(ravel_pytree(rates)[0])[0]

        h, first = terms.contr(t0, t1), ravel_pytree(before)[0]
        step = runge_kutta_step(self.solver.tableau, rate, h, flat, first)
        y1, error, after = (unravel(x) for x in step[:3])
        info = {"y0": y0, "y1": y1, "k": jax.vmap(unravel)(h * jnp.stack(step.rates))}
        return y1, error, info, after, diffrax.RESULTS.successful
