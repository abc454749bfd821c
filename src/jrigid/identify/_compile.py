"""A jit that spends less time on compiling."""

from collections.abc import Callable
from functools import wraps
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp

# A third of the time goes to code that on a CPU runs no faster for it, or into many parts.
_OPTIONS = {"xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 2}


def quick_jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """`equinox.filter_jit`, with options for the CPU's compiler where it is called by itself.

    Within another jit, vmap or derivative it is the plain one: options are for whole programs.
    """
    plain = eqx.filter_jit(function)
    options: dict[str, Any] = {"compiler_options": _OPTIONS}
    quick = eqx.filter_jit(function, **options)
    known = True

    @wraps(function)
    def call(*args: Any) -> Any:
        nonlocal known
        # Under jit even a constant becomes a tracer once something is done to it.
        values = [*jax.tree_util.tree_leaves(args), jnp.zeros(()) + 0]
        traced = any(isinstance(x, jax.core.Tracer) for x in values)
        if known and not traced and jax.default_backend() == "cpu":
            try:
                return quick(*args)
            except jax.errors.JaxRuntimeError as error:
                if "xla_cpu_use_fusion_emitters" not in str(error):
                    raise
                known = False  # another jaxlib may not have the option
        return plain(*args)

    return call
