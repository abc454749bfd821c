"""The adjoint that `simulate` runs diffrax with, and guards of what it can serve.

The guards turn a mode of differentiation that it cannot serve into an error that helps. Each is the
identity on values. What it does is carried by its derivative rules: a linear map that can be
transposed but not evaluated (reverse mode only), or evaluated but not transposed (forward mode
only).
"""

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
    batching.primitive_batchers[primitive] = lambda args, dims: (primitive.bind(*args), dims[0])
    return primitive


# Forward mode only: a linear map that can be evaluated, not transposed.
_forward_only = _primitive("jrigid_forward_only")
ad.deflinear2(_forward_only, _refuse)
# Reverse mode only: the tangent map can be transposed, not run; and the cotangent that it gives,
# the first derivative, cannot be differentiated again.
_reverse_only = _primitive("jrigid_reverse_only")
_tangent = _primitive("jrigid_reverse_only_tangent", _refuse)
_cotangent = _primitive("jrigid_reverse_only_cotangent")
ad.defjvp(_reverse_only, lambda tangent, _: _tangent.bind(tangent))
ad.deflinear2(_tangent, lambda cotangent, _: [_cotangent.bind(cotangent)])
ad.primitive_jvps[_tangent] = ad.primitive_jvps[_cotangent] = _refuse
batching.primitive_batchers[_tangent] = _refuse


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
        if isinstance(adjoint, diffrax.ForwardMode) and "Linearization failed" in str(error):
            raise UnsupportedDerivative(_MESSAGE) from error
        raise


def guard_inputs(adjoint: diffrax.AbstractAdjoint, tree: Any) -> Any:
    """Guard what goes into an integration whose adjoint serves reverse mode only."""
    return _through(_reverse_only, isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint), tree)


def guard_derivative(tree: Any) -> Any:
    """Guard what a first derivative in reverse mode is made from: there is no second."""
    return _through(_cotangent, True, tree)


def guard_outputs(adjoint: diffrax.AbstractAdjoint, tree: Any) -> Any:
    """Guard what comes out of an integration whose adjoint serves forward mode only."""
    return _through(_forward_only, isinstance(adjoint, diffrax.ForwardMode), tree)


class WithTimes(diffrax.AbstractAdjoint):
    """An adjoint that hands the loop its times, and finds where an event ended it.

    diffrax would check times that it is given by callbacks, with which no compiled function can be
    kept from one process to the next. It is given none: two places to save the end, of which the
    first is made to hold the times asked for.
    """

    adjoint: diffrax.AbstractAdjoint
    times: Array
    end: Array

    def loop(self, *, init_state: Any, saveat: Any, t1: Any, event: Any, **others: Any) -> Any:
        """Run the loop to the end, and back to where a condition changed its sign."""
        del t1
        if isinstance(self.adjoint, diffrax.DirectAdjoint):
            init_state, others = self._with_known_steps(init_state, saveat, event, others)
        init_state, saveat = _saving(init_state, saveat, ts=self.times)
        final, stats = self.adjoint.loop(
            init_state=init_state, saveat=saveat, t1=self.end, event=event, **others
        )
        if event is None or event.root_finder is not None:
            return final, stats
        names = ("terms", "solver", "t0", "dt0", "stepsize_controller", "max_steps")
        options = {name: others[name] for name in names} | {"saveat": saveat, "t1": self.end}
        t, y = where_it_happened(final, event, others["args"], options)
        place, last = final.save_state
        place = dataclasses.replace(place, ts=jnp.where(place.ts > t, jnp.inf, place.ts))
        last = dataclasses.replace(last, ts=t[None], ys=jtu.tree_map(lambda x: x[None], y))
        return dataclasses.replace(final, save_state=[place, last]), stats

    def _with_known_steps(self, init_state: Any, saveat: Any, event: Any, others: Any) -> Any:
        """The loop with steps that a first run has found, which has no derivatives.

        `DirectAdjoint` computes parts of the loop a second time on its way back. XLA compiles them
        to other roundings, with which a controller takes other steps: then what is kept of the
        first time and what is computed the second time belong to different motions.
        """
        state, saving = _saving(init_state, saveat, steps=others["max_steps"])
        pilot, _ = diffrax.ForwardMode().loop(
            init_state=constant(state), saveat=saving, t1=constant(self.end),
            event=event and dataclasses.replace(event, root_finder=None), **constant(others),
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
