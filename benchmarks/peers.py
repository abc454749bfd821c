"""Integrators that jrigid is measured beside."""

import contextlib
import importlib
import time
from collections.abc import Callable
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np


def package(name: str) -> Any:
    """A package, or None where it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def _heyoka() -> Any:
    """Heyoka without its cache on disk, which would hide compile times."""
    hy = package("heyoka")
    if hy is not None:
        with contextlib.suppress(AttributeError):  # of older versions, which keep none
            hy.llvm_state.set_diskcache_enabled(False)
    return hy


def by_heyoka(
    rates: Callable[..., list[Any]], starts: np.ndarray, end: float, tolerance: float
) -> tuple[Callable[[], np.ndarray], float] | tuple[None, None]:
    """The batch Taylor integrator of heyoka, on one thread, in its widest vectors.

    Args:
        rates: Of the symbolic variables, one each, their right-hand sides.
        starts: States (bodies, n).
        end: Final time.
        tolerance: Of the integrator.

    Returns:
        The compiled integrator as a function without arguments, and the milliseconds
        that took; None where heyoka is missing.
    """
    hy = _heyoka()
    if hy is None:
        return None, None
    bodies, n = starts.shape
    variables = hy.make_vars(*(f"x{i}" for i in range(n)))
    equations = list(zip(variables, rates(*variables), strict=True))
    width = hy.recommended_simd_size()
    start = time.perf_counter()
    integrator = hy.taylor_adaptive_batch(
        equations, np.zeros((n, width)), tol=tolerance
    )
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


def by_heyoka_singly(
    rates: Callable[..., list[Any]],
    starts: np.ndarray,
    end: float,
    tolerance: float,
    number: type = float,
) -> tuple[Callable[[], np.ndarray], float] | tuple[None, None]:
    """As `by_heyoka`, one state after the other; `number` may be `np.longdouble`."""
    hy = _heyoka()
    if hy is None:
        return None, None
    variables = hy.make_vars(*(f"x{i}" for i in range(starts.shape[1])))
    equations = list(zip(variables, rates(*variables), strict=True))
    begin, states = time.perf_counter(), starts.astype(number)
    integrator = hy.taylor_adaptive(
        equations, states[0].copy(), tol=number(tolerance), fp_type=number
    )
    compile_ms = (time.perf_counter() - begin) * 1e3

    def last(state: np.ndarray) -> np.ndarray:
        integrator.time = number(0)
        integrator.state[:] = state
        integrator.propagate_until(number(end))
        return integrator.state.copy()

    return lambda: np.stack([last(state) for state in states]), compile_ms


def by_scipy(
    rates: Callable[..., list[Any]],
    starts: np.ndarray,
    end: float,
    tolerance: float,
    method: str,
) -> tuple[Callable[[], np.ndarray], float] | tuple[None, None]:
    """`solve_ivp`, one state after the other; `rates` takes time and floats."""
    integrate = package("scipy.integrate")
    if integrate is None:
        return None, None
    rtol = max(tolerance, 100 * np.finfo(float).eps)  # scipy's least

    def last(state: np.ndarray) -> np.ndarray:
        solution = integrate.solve_ivp(
            lambda t, y: rates(t, *y.tolist()),
            (0.0, end),
            state,
            method,
            rtol=rtol,
            atol=tolerance,
        )
        return solution.y[:, -1] if solution.success else np.full_like(state, np.nan)

    return lambda: np.stack([last(state) for state in starts]), 0.0


_BALL = """<mujoco><option integrator="RK4" gravity="0 0 0">
<flag constraint="disable" contact="disable"/></option>
<worldbody><body><joint type="ball"/>
<inertial pos="0 0 0" mass="1" diaginertia="{} {} {}"/></body></worldbody></mujoco>"""


def by_mujoco(
    moments: Any, starts: np.ndarray, end: float, steps: int
) -> tuple[Callable[[], np.ndarray], float] | tuple[None, None]:
    """A free body in `steps` steps of MuJoCo's RK4: rates and attitudes."""
    mujoco = package("mujoco")
    if mujoco is None:
        return None, None
    model = mujoco.MjModel.from_xml_string(_BALL.format(*moments))
    model.opt.timestep = end / steps
    data = mujoco.MjData(model)

    def last(state: np.ndarray) -> np.ndarray:
        mujoco.mj_resetData(model, data)
        data.qvel[:], data.qpos[:] = state[:3], state[3:]
        mujoco.mj_step(model, data, nstep=steps)
        return np.concatenate([data.qvel, data.qpos])

    return lambda: np.stack([last(state) for state in starts]), 0.0


def by_diffrax(
    rates: Callable[..., list[Any]],
    start: Any,
    end: float,
    tolerance: Any = 1e-9,
    solver: diffrax.AbstractSolver | None = None,
    timed: bool = False,
) -> Any:
    """Hand-written diffrax on one array; `timed` if `rates` takes the time too."""
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(
            lambda t, y, _args: jnp.stack(rates(t, *y) if timed else rates(*y))
        ),
        solver or diffrax.Dopri8(),
        0.0,
        end,
        0.01,
        start,
        max_steps=100_000,
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
    )
    return jnp.asarray(solution.ys)[0]
