"""The adjoint that `simulate` runs diffrax with, and guards of what it can serve.

The guards turn a mode of differentiation that it cannot serve into an error that helps. Each is the
identity on values. What it does is carried by its derivative rules: a linear map that can be
transposed but not evaluated (reverse mode only), or evaluated but not transposed (forward mode
only).
"""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from jrigid.simulate._controller import KnownSteps, constant
from jrigid.simulate._event import where_it_happened

_FORWARD_MESSAGE = (
    "This adjoint of `jrigid.simulate` serves first derivatives in reverse mode only (jax.grad, "
    "jax.vjp, jax.jacrev). For jax.jvp, jax.jacfwd and forward over forward pass "
    "`adjoint=diffrax.ForwardMode()`; for every mode and order `adjoint=diffrax.DirectAdjoint()`."
)
_REVERSE_MESSAGE = (
    "`adjoint=diffrax.ForwardMode()` of `jrigid.simulate` serves forward mode only (jax.jvp, "
    "jax.jacfwd, forward over forward). For jax.grad, jax.vjp and jax.jacrev leave `adjoint` out "
    "or pass `diffrax.RecursiveCheckpointAdjoint()`; for every mode and order "
    "`adjoint=diffrax.DirectAdjoint()`."
)
_SECOND_ORDER_MESSAGE = (
    "This adjoint of `jrigid.simulate` serves first derivatives only. For second derivatives pass "
    "`adjoint=diffrax.ForwardMode()` and use forward over forward (jax.jacfwd of jax.jacfwd), or "
    "`adjoint=diffrax.DirectAdjoint()` with any modes."
)


class UnsupportedDerivative(TypeError):
    """A mode of differentiation was asked for that the adjoint in use cannot serve."""


def _raise(message: str) -> Any:
    raise UnsupportedDerivative(message)


def _identity_primitive(name: str) -> Primitive:
    primitive = Primitive(name)
    primitive.def_impl(lambda x: x)
    primitive.def_abstract_eval(lambda x: x)
    mlir.register_lowering(primitive, mlir.lower_fun(lambda x: x, multiple_results=False))
    batching.primitive_batchers[primitive] = lambda args, dims: (primitive.bind(*args), dims[0])
    return primitive


def _unevaluable(name: str, message: str) -> Primitive:
    """A linear identity that may be transposed away but never run."""
    primitive = Primitive(name)
    primitive.def_impl(lambda _: _raise(message))
    primitive.def_abstract_eval(lambda x: x)
    mlir.register_lowering(primitive, lambda _ctx, _: _raise(message))
    batching.primitive_batchers[primitive] = lambda _args, _dims: _raise(message)
    return primitive


# Reverse mode only: the tangent map can be transposed, not run.
_reverse_only = _identity_primitive("jrigid_reverse_only")
_reverse_only_tangent = _unevaluable("jrigid_reverse_only_tangent", _FORWARD_MESSAGE)
# On the cotangent: the first derivative may not be differentiated again.
_first_order = _identity_primitive("jrigid_first_order")
# Forward mode only: the tangent map can be run, not transposed.
_forward_only = _identity_primitive("jrigid_forward_only")
_forward_only_tangent = _identity_primitive("jrigid_forward_only_tangent")

ad.primitive_jvps[_reverse_only] = lambda primals, tangents: (
    _reverse_only.bind(primals[0]),
    _bind_tangent(_reverse_only_tangent, tangents[0]),
)
ad.primitive_jvps[_reverse_only_tangent] = lambda _primals, _tangents: _raise(_SECOND_ORDER_MESSAGE)
ad.primitive_transposes[_reverse_only_tangent] = lambda cotangent, _: [
    _bind_tangent(_first_order, cotangent)
]
ad.primitive_jvps[_first_order] = lambda _primals, _tangents: _raise(_SECOND_ORDER_MESSAGE)
ad.primitive_jvps[_forward_only] = lambda primals, tangents: (
    _forward_only.bind(primals[0]),
    _bind_tangent(_forward_only_tangent, tangents[0]),
)
ad.primitive_jvps[_forward_only_tangent] = lambda primals, tangents: (
    _forward_only_tangent.bind(primals[0]),
    _bind_tangent(_forward_only_tangent, tangents[0]),
)
ad.primitive_transposes[_forward_only_tangent] = lambda _cotangent, _: _raise(_REVERSE_MESSAGE)


def _bind_tangent(primitive: Primitive, tangent: Any) -> Any:
    return tangent if isinstance(tangent, ad.Zero) else primitive.bind(tangent)


def _map_inexact(primitive: Primitive, tree: Any) -> Any:
    return jtu.tree_map(lambda x: primitive.bind(x) if eqx.is_inexact_array(x) else x, tree)


def guard_inputs(adjoint: diffrax.AbstractAdjoint, tree: Any) -> Any:
    """Guard what goes into an integration whose adjoint serves reverse mode only."""
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        return _map_inexact(_reverse_only, tree)
    return tree


def guard_outputs(adjoint: diffrax.AbstractAdjoint, tree: Any) -> Any:
    """Guard what comes out of an integration whose adjoint serves forward mode only."""
    if isinstance(adjoint, diffrax.ForwardMode):
        return _map_inexact(_forward_only, tree)
    return tree


class WithTimes(diffrax.AbstractAdjoint):
    """An adjoint that hands the loop its times, and finds where an event ended it.

    diffrax would check times that it is given by callbacks, with which no compiled function can be
    kept from one process to the next. It is given none: two places to save the end, of which the
    first is made to hold the times asked for.
    """

    adjoint: diffrax.AbstractAdjoint
    taus: Array
    end: Array

    def loop(self, *, init_state: Any, saveat: Any, t1: Any, event: Any, **others: Any) -> Any:
        """Run the loop to the end, and back to where a condition changed its sign."""
        del t1
        if isinstance(self.adjoint, diffrax.DirectAdjoint):
            init_state, others = self._with_known_steps(init_state, saveat, others)
        init_state, saveat = _saving(init_state, saveat, ts=self.taus)
        final, stats = self.adjoint.loop(
            init_state=init_state, saveat=saveat, t1=self.end, event=event, **others
        )
        if event is None or event.root_finder is not None:
            return final, stats
        names = ("terms", "solver", "t0", "dt0", "stepsize_controller", "max_steps")
        options = {name: others[name] for name in names} | {"saveat": saveat, "t1": self.end}
        tau, y = where_it_happened(final, event, others["args"], options)
        place, last = final.save_state
        place = dataclasses.replace(place, ts=jnp.where(place.ts > tau, jnp.inf, place.ts))
        last = dataclasses.replace(last, ts=tau[None], ys=jtu.tree_map(lambda x: x[None], y))
        return dataclasses.replace(final, save_state=[place, last]), stats

    def _with_known_steps(self, init_state: Any, saveat: Any, others: Any) -> tuple[Any, Any]:
        """The loop with steps that a first run has found, which has no derivatives.

        `DirectAdjoint` computes parts of the loop a second time on its way back. XLA compiles them
        to other roundings, with which a controller takes other steps: then what is kept of the
        first time and what is computed the second time belong to different motions.
        """
        state, saving = _saving(init_state, saveat, steps=others["max_steps"])
        pilot, _ = diffrax.ForwardMode().loop(
            init_state=constant(state), saveat=saving, t1=constant(self.end), event=None,
            **constant(others),
        )  # fmt: skip
        ends = jax.lax.stop_gradient(pilot.save_state[0].ts)
        controller = KnownSteps(ends, pilot.result)
        init_state = dataclasses.replace(
            init_state, tnext=jnp.minimum(ends[0], init_state.tnext), controller_state=jnp.array(1)
        )
        return init_state, others | {"stepsize_controller": controller}


def _saving(state: Any, saveat: Any, ts: Any = None, steps: int | None = None) -> tuple[Any, Any]:
    """The loop's state and what it saves, of two places to save the end: times or all steps."""
    place, last = state.save_state
    size = (steps,) if ts is None else ts.shape
    places = jtu.tree_map(
        lambda x: jnp.full(size + x.shape[1:], jnp.inf, x.dtype), (place.ts, place.ys)
    )
    place = dataclasses.replace(place, ts=places[0], ys=places[1])
    subs = [diffrax.SubSaveAt(ts=ts, steps=ts is None), diffrax.SubSaveAt(t1=True)]
    state = dataclasses.replace(state, save_state=[place, last])
    return state, dataclasses.replace(saveat, subs=subs)
