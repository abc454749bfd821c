"""One step of an explicit Runge-Kutta method, its stages written out."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jrigid._numerics import materialize


def _combined(y: Any, coefficients: Any, ks: list[Array]) -> Array:
    """`y` and a combination of `ks`, in the order of their numbers; coefficients of 0 cost nothing.

    Neither do they make a NaN of a stage that they do not use.
    """
    used = [(float(a), k) for a, k in zip(coefficients, ks, strict=True) if a]
    total = sum((k * jnp.asarray(a, k.dtype) for a, k in used[1:]), used[0][1] * used[0][0])
    return total if y is None else y + total


def runge_kutta_step(
    tableau: Any, rate: Callable[[float, Array], Array], h: Array, y: Array, before: Array
) -> tuple[Array, Array, Array, list[Array]]:
    """One explicit step with its stages written out, on an array of any shape.

    Args:
        tableau: Of diffrax.
        rate: At a place, by the fraction of the step that has passed.
        h: The step.
        y: Where it begins.
        before: The rate there.

    Returns:
        Where it ends, its error, the rate at its end, the increments of all stages.
    """
    ks = [h * before]
    after = before
    for fraction, row in zip(tableau.c, tableau.a_lower, strict=True):
        (place,) = materialize(_combined(y, row, ks))
        (after,) = materialize(rate(float(fraction), place))
        ks.append(h * after)
    y1 = _combined(y, tableau.b_sol, ks)
    return y1, _combined(None, tableau.b_error, ks), after if tableau.fsal else rate(1.0, y1), ks
