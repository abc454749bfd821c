"""Guards: a mode of differentiation that an adjoint cannot serve raises an error that helps.

Each guard is the identity on values. What it does is carried by its derivative rules: a
linear map that can be transposed but not evaluated (reverse mode only), or evaluated
but not transposed (forward mode only).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import diffrax
import equinox as eqx
import jax.tree_util as jtu

from jrigid._core.third_party import Primitive, ad, mlir, set_vmap_rule

_MESSAGE = (
    "This adjoint of `jrigid.simulate` cannot serve the derivative that is asked for. Left out, or "
    "as `adjoint=diffrax.RecursiveCheckpointAdjoint()`, it serves first derivatives in reverse "
    "mode (jax.grad, jax.vjp, jax.jacrev); `adjoint=diffrax.ForwardMode()` serves jax.jvp, "
    "jax.jacfwd and forward over forward (jax.jacfwd of jax.jacfwd); "
    "`adjoint=diffrax.DirectAdjoint()` serves every mode and order."
)


class UnsupportedDerivative(TypeError):
    """A mode of differentiation was asked for that the adjoint in use cannot serve."""


def _refuse(*_: Any) -> Any:
    raise UnsupportedDerivative(_MESSAGE)


def _primitive(name: str, run: Callable[[Any], Any] = lambda x: x) -> Primitive:
    """An identity, which refuses to be evaluated if told to."""
    primitive = Primitive(name)
    primitive.def_impl(run)
    primitive.def_abstract_eval(lambda x: x)
    mlir.register_lowering(primitive, mlir.lower_fun(run, multiple_results=False))
    set_vmap_rule(primitive, lambda args, dims: (primitive.bind(*args), dims[0]))
    return primitive


# Forward mode only: a linear map that can be evaluated, not transposed.
_forward_only = _primitive("jrigid_forward_only")
ad.deflinear2(_forward_only, _refuse)
# Reverse mode only: the tangent map can be transposed, not run; and the cotangent that
# it gives, the first derivative, cannot be differentiated again.
_reverse_only = _primitive("jrigid_reverse_only")
_tangent = _primitive("jrigid_reverse_only_tangent", _refuse)
_cotangent = _primitive("jrigid_reverse_only_cotangent")
ad.defjvp(_reverse_only, lambda tangent, _: _tangent.bind(tangent))
ad.deflinear2(_tangent, lambda cotangent, _: [_cotangent.bind(cotangent)])
ad.primitive_jvps[_tangent] = ad.primitive_jvps[_cotangent] = _refuse
set_vmap_rule(_tangent, _refuse)


def _through(primitive: Primitive, applies: bool, tree: Any) -> Any:
    return jtu.tree_map(
        lambda x: primitive.bind(x) if applies and eqx.is_inexact_array(x) else x, tree
    )


@contextmanager
def forward_only(adjoint: diffrax.AbstractAdjoint) -> Iterator[None]:
    """Reverse mode through an integration that serves forward mode only fails before its exit."""
    try:
        yield
    except ValueError as error:
        if isinstance(adjoint, diffrax.ForwardMode) and "Linearization failed" in str(
            error
        ):
            raise UnsupportedDerivative(_MESSAGE) from error
        raise


def guard_inputs(adjoint: diffrax.AbstractAdjoint, tree: Any) -> Any:
    """Guard what goes into an integration whose adjoint serves reverse mode only."""
    return _through(
        _reverse_only, isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint), tree
    )


def guard_derivative(tree: Any) -> Any:
    """Guard what a first derivative in reverse mode is made from: there is no second."""
    return _through(_cotangent, True, tree)


def guard_outputs(adjoint: diffrax.AbstractAdjoint, tree: Any) -> Any:
    """Guard what comes out of an integration whose adjoint serves forward mode only."""
    return _through(_forward_only, isinstance(adjoint, diffrax.ForwardMode), tree)
