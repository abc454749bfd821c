"""Guards raise an error for a mode of differentiation that an adjoint does not support.

Each guard is the identity on values. Its derivative rules are a linear map that can be
transposed but not evaluated (reverse mode only), or evaluated but not transposed
(forward mode only).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn, TypeVar

import diffrax
import equinox as eqx
import jax.tree_util as jtu

from jrigid._core.third_party import Primitive, ad, mlir, set_vmap_rule

Tree = TypeVar("Tree")

_MESSAGE = (
    "This adjoint of `jrigid.simulate` cannot serve the derivative that is asked for. "
    "Left out, or as `adjoint=diffrax.RecursiveCheckpointAdjoint()`, it serves first "
    "derivatives in reverse mode (jax.grad, jax.vjp, jax.jacrev); "
    "`adjoint=diffrax.ForwardMode()` serves jax.jvp, jax.jacfwd and forward over "
    "forward (jax.jacfwd of jax.jacfwd); `adjoint=diffrax.DirectAdjoint()` serves "
    "every mode and order."
)


class UnsupportedDerivative(TypeError):
    """The adjoint in use does not support a mode of differentiation."""


def _refuse(*_: object) -> NoReturn:
    """Raise the error, as the derivative rule that a guard does not have."""
    raise UnsupportedDerivative(_MESSAGE)


def _identity(x: Any) -> Any:
    """The argument itself."""
    return x


def _primitive(name: str, run: Callable[[Any], Any] = _identity) -> Primitive:
    """An identity; with `run=_refuse` one that cannot be evaluated."""
    primitive = Primitive(name)
    primitive.def_impl(run)
    primitive.def_abstract_eval(_identity)
    mlir.register_lowering(primitive, mlir.lower_fun(run, multiple_results=False))
    set_vmap_rule(primitive, lambda args, dims: (primitive.bind(*args), dims[0]))
    return primitive


# Forward mode only: a linear map that can be evaluated, not transposed.
_forward_only = _primitive("jrigid_forward_only")
ad.deflinear2(_forward_only, _refuse)
# Reverse mode only: the tangent map can be transposed, not evaluated. The result of the
# transposed map, the first derivative, cannot be differentiated again.
_reverse_only = _primitive("jrigid_reverse_only")
_tangent = _primitive("jrigid_reverse_only_tangent", _refuse)
_cotangent = _primitive("jrigid_reverse_only_cotangent")
ad.defjvp(_reverse_only, lambda tangent, _: _tangent.bind(tangent))
ad.deflinear2(_tangent, lambda cotangent, _: [_cotangent.bind(cotangent)])
ad.primitive_jvps[_tangent] = ad.primitive_jvps[_cotangent] = _refuse
# `jax.jacfwd` maps the tangents with vmap before anything evaluates them.
set_vmap_rule(_tangent, _refuse)


def _through(primitive: Primitive, tree: Tree) -> Tree:
    """Apply a guard to all floating point arrays of a pytree."""
    return jtu.tree_map(
        lambda x: primitive.bind(x) if eqx.is_inexact_array(x) else x, tree
    )


@contextmanager
def forward_only(adjoint: diffrax.AbstractAdjoint) -> Iterator[None]:
    """Raise `UnsupportedDerivative` for reverse mode through a `ForwardMode` run.

    JAX linearises such a run before it reaches the guard of its outputs.
    """
    try:
        yield
    except ValueError as error:
        is_linearized = "Linearization failed" in str(error)
        if isinstance(adjoint, diffrax.ForwardMode) and is_linearized:
            raise UnsupportedDerivative(_MESSAGE) from error
        raise


def guard_inputs(adjoint: diffrax.AbstractAdjoint, tree: Tree) -> Tree:
    """Guard the inputs of an integration if its adjoint serves reverse mode only."""
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        return _through(_reverse_only, tree)
    return tree


def guard_derivative(tree: Tree) -> Tree:
    """Guard the operands of a first derivative in reverse mode: there is no second."""
    return _through(_cotangent, tree)


def guard_outputs(adjoint: diffrax.AbstractAdjoint, tree: Tree) -> Tree:
    """Guard the outputs of an integration if its adjoint serves forward mode only."""
    if isinstance(adjoint, diffrax.ForwardMode):
        return _through(_forward_only, tree)
    return tree
