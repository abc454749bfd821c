"""A jit that spends less on compiling, on CPUs.

The first call of a function compiles it, which takes longer than most motions take to
compute. XLA's options for CPUs change that by factors.
"""

import gc
from collections.abc import Callable
from functools import cache, wraps
from inspect import signature
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from jrigid._core.third_party import outside_of_jit

# On a CPU half of the time goes into code that runs no faster for it, or into many
# parts.
_ON_CPU: dict[str, Any] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": 2,
    # It moves hardly anything out of our loops, and takes a twelfth of the time.
    "xla_disable_hlo_passes": "while-loop-invariant-code-motion",
}
# Levels of LLVM's optimisation. The third is XLA's own, and makes a batch of motions
# 1.4 times as fast as the second. Beyond the first a fit is 3 % faster, for a fifth of
# the time to compile. Programs that run once in a fit are not optimised: they compile
# in a third of the time and run half as fast.
FULL = 3
SOME = 1
_NONE = 0

_P = ParamSpec("_P")
_T = TypeVar("_T")


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


def _without_collection(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, during which Python's garbage collector stands still.

    JAX calls a function that it compiles once, to trace it. Tracing makes objects by
    the million, nearly all of which stay. The collector would look through them for
    cycles again and again, in a seventh of the time of a first fit.
    """

    @wraps(function)
    def call(*arguments: Any) -> Any:
        if not gc.isenabled():
            return function(*arguments)
        gc.disable()
        try:
            return function(*arguments)
        finally:
            gc.enable()

    return call


def quick_jit(function: Callable[..., Any], level: int = FULL) -> Callable[..., Any]:
    """`equinox.filter_jit` with options for the CPU's compiler.

    Within another jit and under derivatives it is the plain one, since options are for
    whole programs.

    Args:
        function: The function.
        level: Of LLVM's optimisation, on a CPU.
    """
    traced = _without_collection(function)
    plain = eqx.filter_jit(traced)

    @cache
    def quick() -> Any:
        # The options ask for the backend, and asking starts it. This must not happen
        # while modules are imported.
        options: dict[str, Any] = {"compiler_options": _options(level)}
        return eqx.filter_jit(traced, **options)

    @wraps(function)
    def call(*args: Any) -> Any:
        return quick()(*args) if outside_of_jit() else plain(*args)

    return call


def small_jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """A `quick_jit` of what is evaluated once or twice."""
    return quick_jit(function, _NONE)


def program(function: Callable[..., Any], level: int = SOME) -> Any:
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
        return jax.jit(_without_collection(of_leaves), compiler_options=_options(level))

    @wraps(function)
    def call(*arguments: Any) -> Any:
        leaves, structure = jtu.tree_flatten(arguments)
        # Functions, of a `FunctionSensor` say, fix what is compiled.
        others = tuple(x if callable(x) else None for x in leaves)
        # The same functions in the same structure make equal arguments for `jax.jit`,
        # which then compiles nothing.
        arrays = [None if callable(x) else x for x in leaves]
        return compiled()(arrays, Static((structure, others)))

    return call


def small_program(function: Callable[..., Any]) -> Any:
    """A `program` that runs once or twice in a fit."""
    return program(function, _NONE)


def one_program(
    function: Callable[_P, _T], static: str | None = None
) -> Callable[_P, _T]:
    """The function, compiled as one program where it is called outside of jit.

    Otherwise each operation of such a call is a program of its own. Sixty of them take
    a second to compile, ten times as long as one, and then longer to run. Within jit,
    under derivatives and for arguments that are no numbers nothing changes.

    Args:
        function: A function of numbers and of pytrees of arrays.
        static: Name of an argument that fixes what is compiled, like an axis.
    """
    untyped: Callable[..., _T] = function
    parameters = signature(function)

    @wraps(function)
    def of_all(numbers: dict[str, Any], fixed: Static) -> _T:
        return untyped(**numbers, **dict(fixed.value))

    compiled = program(of_all, FULL)

    @wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        if outside_of_jit():
            given = parameters.bind(*args, **kwargs).arguments
            fixed = tuple((name, x) for name, x in given.items() if name == static)
            numbers = {k: _as_array(x) for k, x in given.items() if k != static}
            is_one = all(map(_is_number, jtu.tree_leaves(numbers)))
            if is_one and all(isinstance(x, int | str | None) for _, x in fixed):
                return compiled(numbers, Static(fixed))
        return function(*args, **kwargs)

    return call


def floats_as_arrays(tree: Any, dtype: Any) -> Any:
    """The tree with arrays in place of Python's floats.

    `equinox.filter_jit` takes a Python float for a constant, and compiles anew for each
    value.
    """

    def convert(x: Any) -> Any:
        return jnp.asarray(x, dtype) if isinstance(x, float) else x

    return jtu.tree_map(convert, tree)


def _as_array(x: Any) -> Any:
    """A list or a tuple of numbers as an array, which JAX traces as one."""
    return np.asarray(x) if type(x) in (list, tuple) else x


def _is_number(x: Any) -> bool:
    """Whether this is a real number, or an array of them."""
    if isinstance(x, np.ndarray | np.generic):
        return x.dtype.kind in "biuf"
    return isinstance(x, jax.Array | int | float)


class Static:
    """A hashable argument of a `program` that fixes what is compiled."""

    def __init__(self, value: Any):
        """Wrap a value."""
        self.value = value


jtu.register_pytree_node(
    Static, lambda x: ((), x.value), lambda value, _: Static(value)
)
