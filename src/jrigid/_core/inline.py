"""A function traced once, without the calls of jitted functions within it."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.tree_util as jtu

from jrigid._core import third_party


def inlined(function: Callable[..., Any], *arguments: Any) -> Any:
    """The results of a function of arrays, as `function(*arguments)`.

    Under several nested vmaps JAX traces each call of a jitted function (each
    `jnp.where`) once more for every vmap. Here the function is traced once by itself,
    and what surrounds it sees its arithmetic only: half of the time to trace a fit.
    """
    leaves, structure = jtu.tree_flatten(arguments)
    shapes = [
        jax.ShapeDtypeStruct(jax.numpy.shape(x), jax.numpy.result_type(x))
        for x in leaves
    ]

    def flat(*leaves: Any) -> Any:
        return function(*structure.unflatten(leaves))

    program, results = jax.make_jaxpr(flat, return_shape=True)(*shapes)
    found = _evaluate(program.jaxpr, program.consts, leaves)
    return jtu.tree_structure(results).unflatten(found)


def _evaluate(
    jaxpr: Any, constants: Sequence[Any], arguments: Sequence[Any]
) -> list[Any]:
    """Evaluate a program, and within it the programs that it calls."""
    values = dict(
        zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *arguments], strict=True)
    )

    def read(variable: Any) -> Any:
        return (
            variable.val
            if isinstance(variable, third_party.Literal)
            else values[variable]
        )

    for equation in jaxpr.eqns:
        inputs = [read(x) for x in equation.invars]
        called = third_party.called_program(equation)
        if called is None:
            results = third_party.apply(equation.primitive, equation.params, *inputs)
        elif isinstance(called, third_party.ClosedJaxpr):
            results = _evaluate(called.jaxpr, called.consts, inputs)
        else:
            results = _evaluate(called, (), inputs)
        values |= dict(zip(equation.outvars, results, strict=True))
    return [read(x) for x in jaxpr.outvars]
