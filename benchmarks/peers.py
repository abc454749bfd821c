"""Integrators that the exact flows are measured beside."""

import time
from collections.abc import Callable
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np


def by_heyoka(
    rates: Callable[..., list[Any]], starts: np.ndarray, end: float, tolerance: float
) -> tuple[Callable[[], np.ndarray], float] | tuple[None, None]:
    """The batch Taylor integrator of heyoka, on one thread, the widest vectors it recommends.

    Args:
        rates: Of the symbolic variables, one each, their right-hand sides.
        starts: States (bodies, n).
        end: Final time.
        tolerance: Of the integrator.

    Returns:
        The compiled integrator as a function without arguments, and the milliseconds that took;
        None where heyoka is missing.
    """
    try:
        import heyoka as hy  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None, None
    bodies, n = starts.shape
    variables = hy.make_vars(*(f"x{i}" for i in range(n)))
    equations = list(zip(variables, rates(*variables), strict=True))
    width = hy.recommended_simd_size()
    start = time.perf_counter()
    integrator = hy.taylor_adaptive_batch(equations, np.zeros((n, width)), tol=tolerance)
    compile_ms = (time.perf_counter() - start) * 1e3

    def run() -> np.ndarray:
        states = np.empty((bodies, n))
        for first in range(0, bodies, width):
            rows = slice(first, first + width)
            count = len(starts[rows])
            integrator.set_time(0.0)
            integrator.state[:] = starts[first][:, None]
            integrator.state[:, :count] = starts[rows].T
            integrator.propagate_until(end)
            states[rows] = integrator.state[:, :count].T
        return states

    return run, compile_ms


def by_diffrax(rates: Callable[..., list[Any]], start: Any, end: float) -> Any:
    """What a user of diffrax writes by hand: Dopri8 at 1e-9 on one array."""
    term = diffrax.ODETerm(lambda _t, y, _args: jnp.stack(rates(*y)))
    solution = diffrax.diffeqsolve(
        term, diffrax.Dopri8(), 0.0, end, 0.01, start, max_steps=100_000,
        stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
    )  # fmt: skip
    return jnp.asarray(solution.ys)[0]
