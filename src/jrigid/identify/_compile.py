"""A jit that spends less time on compiling."""

import contextlib
import gc
from collections.abc import Callable, Iterator
from functools import cache, wraps
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu

# On a CPU a third of the time goes into code that runs no faster for it, or into many
# parts.
_ON_CPU: dict[str, Any] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": 2,
    # It moves nothing of a fit out of its loops, and takes a twelfth of the time.
    "xla_disable_hlo_passes": "while-loop-invariant-code-motion",
}
# LLVM's second level of optimisation takes a fifth of the time to compile, and makes a
# fit 3 % faster. Programs that run once in a fit are not optimised: they compile in a
# third of the time and run half as fast.
_LEVEL = 1
_LEVEL_ONCE = 0


@cache
def _known(name: str) -> bool:
    """Whether this jaxlib has an option: they come and go with its versions."""
    try:
        jax.jit(lambda: 0).lower().compile(compiler_options={name: _ON_CPU[name]})
    except jax.errors.JaxRuntimeError:
        return False
    return True


def _options(level: int) -> dict[str, Any] | None:
    """Options of the compiler; None where it is not that of a CPU."""
    if jax.default_backend() != "cpu":
        return None
    known = {name: value for name, value in _ON_CPU.items() if _known(name)}
    return known | {"xla_backend_optimization_level": level}


@contextlib.contextmanager
def _without_collection() -> Iterator[None]:
    """Python's garbage collector stands still.

    Tracing makes objects by the million, nearly all of which stay. The collector would
    look through them for cycles again and again, in a seventh of the time of a first
    fit.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def quick_jit(function: Callable[..., Any], level: int = _LEVEL) -> Callable[..., Any]:
    """`equinox.filter_jit` with options for the CPU's compiler.

    Within another jit, vmap or derivative it is the plain one, since options are for
    whole programs.

    Args:
        function: The function.
        level: Of LLVM's optimisation, on a CPU.
    """
    plain = eqx.filter_jit(function)

    @cache
    def quick() -> Any:
        # The options ask for the backend, and asking starts it. This must not happen
        # while modules are imported.
        options: dict[str, Any] = {"compiler_options": _options(level)}
        return eqx.filter_jit(function, **options)

    @wraps(function)
    def call(*args: Any) -> Any:
        # Under jit even a constant becomes a tracer once something is done to it.
        values = [*jax.tree_util.tree_leaves(args), jnp.zeros(()) + 0]
        if any(isinstance(x, jax.core.Tracer) for x in values):
            return plain(*args)
        with _without_collection():
            return quick()(*args)

    return call


def small_jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """A `quick_jit` of what is evaluated once or twice."""
    return quick_jit(function, _LEVEL_ONCE)


def program(function: Callable[..., Any], level: int = _LEVEL) -> Any:
    """`jax.jit` of a function of pytrees of arrays, numpy's or JAX's, and functions.

    Args:
        function: The function.
        level: Of LLVM's optimisation, on a CPU.
    """

    def of_leaves(arrays: list[Any], static: Static) -> Any:
        structure, others = static.value
        leaves = [x if y is None else y for x, y in zip(arrays, others, strict=True)]
        return function(*structure.unflatten(leaves))

    of_leaves.__name__ = function.__name__  # in profiles and logs of compilations

    @cache
    def compiled() -> Any:
        return jax.jit(of_leaves, compiler_options=_options(level))

    @wraps(function)
    def call(*arguments: Any) -> Any:
        leaves, structure = jtu.tree_flatten(arguments)
        # Functions, of a `FunctionSensor` say, fix what is compiled.
        others = tuple(x if callable(x) else None for x in leaves)
        # The same functions in the same structure make equal arguments for `jax.jit`,
        # which then compiles nothing.
        arrays = [None if callable(x) else x for x in leaves]
        with _without_collection():
            return compiled()(arrays, Static((structure, others)))

    return call


def small_program(function: Callable[..., Any]) -> Any:
    """A `program` that runs once or twice in a fit."""
    return program(function, _LEVEL_ONCE)


class Static:
    """A hashable argument of a `program` that fixes what is compiled."""

    def __init__(self, value: Any):
        """Wrap a value."""
        self.value = value


jtu.register_pytree_node(
    Static, lambda x: ((), x.value), lambda value, _: Static(value)
)
