"""Trace a function once, without the calls of jitted functions within it."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.tree_util as jtu

from jrigid._core import third_party


def inlined(function: Callable[..., Any], *arguments: Any) -> Any:
    """`function(*arguments)`, as a sequence of operations without calls.

    Under nested vmaps JAX traces each call of a jitted function, such as `jnp.where`,
    once for every vmap. Here the function is traced once by itself, and the vmaps see
    its operations only. This halves the time to trace a fit.

    Gradients: those of the operations. Rules of functions that have derivatives of
    their own (`jax.custom_jvp` and the like) are lost.
    """
    leaves, structure = jtu.tree_flatten(arguments)
    shapes = [
        jax.ShapeDtypeStruct(jax.numpy.shape(x), jax.numpy.result_type(x))
        for x in leaves
    ]

    def flat(*leaves: Any) -> Any:
        return function(*structure.unflatten(leaves))

    program, results = jax.make_jaxpr(flat, return_shape=True)(*shapes)
    values = _evaluate(program.jaxpr, program.consts, leaves)
    return jtu.tree_structure(results).unflatten(values)


def _evaluate(
    jaxpr: third_party.Jaxpr, constants: Sequence[Any], arguments: Sequence[Any]
) -> list[Any]:
    """Evaluate a program, and within it the programs that it calls."""
    variables = [*jaxpr.constvars, *jaxpr.invars]
    values = dict(zip(variables, [*constants, *arguments], strict=True))

    def read(variable: Any) -> Any:
        if isinstance(variable, third_party.Literal):
            return variable.val
        return values[variable]

    for equation in jaxpr.eqns:
        inputs = [read(x) for x in equation.invars]
        # The operations of a call are evaluated in its place, so that no call remains.
        called = third_party.called_program(equation)
        if called is None:
            results = third_party.apply(equation.primitive, equation.params, *inputs)
        elif isinstance(called, third_party.ClosedJaxpr):
            results = _evaluate(called.jaxpr, called.consts, inputs)
        else:
            results = _evaluate(called, (), inputs)
        values |= dict(zip(equation.outvars, results, strict=True))
    return [read(x) for x in jaxpr.outvars]
