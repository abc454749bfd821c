"""One step of an explicit Runge-Kutta method, its stages written out."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._as_lanes import on_cpu


class Step(NamedTuple):
    """What a step gives."""

    y1: Array
    error: Array
    after: Array  # the rate at y1
    rates: list[Array]  # of all stages


def _sum(coefficients: Any, rates: list[Array]) -> Array:
    """In the order of their numbers; a coefficient of 0 costs nothing.

    Neither does it make a NaN of a stage that it does not use.
    """
    used = [(jnp.asarray(a, k.dtype), k) for a, k in zip(coefficients, rates, strict=True) if a]
    return sum((k * a for a, k in used[1:]), used[0][1] * used[0][0])


def kept_apart(
    rates: Callable[[Array, Array], Array], true: Array
) -> Callable[[Array, Array], Array]:
    """The same rates at a time and a place, for stages written out one after the other.

    Args:
        rates: At a time and a place.
        true: So it is, but the compiler must not know. It is no lane's own.
    """
    if not on_cpu():
        return rates

    @jax.jit  # traced once for all stages
    def apart(t: Array, y: Array) -> Array:
        # What goes into a branch and what comes out of it has been computed, once. Of what is on
        # the way in between, each number would be copied for the way back.
        field = jax.checkpoint(rates, prevent_cse=False)
        return jax.lax.cond(true, field, lambda _, y: jnp.zeros_like(y), t, y)

    return apart


def runge_kutta_step(
    tableau: Any, rate: Callable[[float, Array], Array], h: Array, y: Array, before: Array
) -> Step:
    """One explicit step with its stages written out, on an array of any shape.

    Args:
        tableau: Of diffrax.
        rate: At a place, by the fraction of the step that has passed. XLA's CPU compiler would
            compute what stages share once for each that shares it: a rate keeps them apart.
        h: The step.
        y: Where it begins.
        before: The rate there.
    """
    rates, place = [before], y
    for fraction, row in zip(tableau.c, tableau.a_lower, strict=True):
        place = y + h * _sum(row, rates)
        rates.append(rate(float(fraction), place))
    y1 = place if tableau.ssal else y + h * _sum(tableau.b_sol, rates)
    after = rates[-1] if tableau.fsal else rate(1.0, y1)
    return Step(y1, h * _sum(tableau.b_error, rates), after, rates)
