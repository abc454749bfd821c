"""Tolerances by dtype, and motions that several test files share."""

import os
import re
import subprocess
import sys
from functools import wraps
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jrigid as jr

# A tumbling asymmetric body whose axes are not principal: what an isotropic one cannot
# show.
TENSOR = np.array([[2.0, -0.3, 0.2], [-0.3, 2.5, 0.4], [0.2, 0.4, 1.7]])
MOMENTS = np.array([1.0, 2.0, 3.0])
ATTITUDE = np.array([0.5, -0.1, 0.7, 0.5])
OMEGA = np.array([0.3, -0.5, 0.8])
DTYPES = (np.float32, np.float64)


def ulps(dtype, count):
    """`count` units in the last place of 1."""
    return count * float(np.finfo(dtype).eps)


def central_difference(function, x, direction, step=None):
    """Directional derivative of a function of an array, to about eps^(2/3)."""
    x = np.asarray(x)
    if step is None:
        step = float(np.finfo(x.dtype).eps) ** (1 / 3)
    up, down = function(x + step * direction), function(x - step * direction)
    return (np.asarray(up) - np.asarray(down)) / (2 * step)


_KERNEL = re.compile(r"\s(fusion|call|conditional|while|custom-call)\(")


def kernels(optimised_hlo):
    """Count fusions, calls, conditionals, loops and custom calls in the optimised
    HLO."""
    instructions = (line.split(", metadata=")[0] for line in optimised_hlo.splitlines())
    return sum(bool(_KERNEL.search(line)) for line in instructions)


def quick_jit(function):
    """jax.jit that spends less on compiling: for large derivatives that are run
    once."""
    if jax.default_backend() != "cpu":
        return jax.jit(function)
    options = {
        "xla_backend_optimization_level": 0,
        "xla_cpu_use_fusion_emitters": False,
    }
    quick, plain = jax.jit(function, compiler_options=options), jax.jit(function)
    known = True

    @wraps(function)
    def call(*args):
        nonlocal known
        if known:
            try:
                return quick(*args)
            except jax.errors.JaxRuntimeError as error:
                if "xla_" not in str(error):
                    raise
                known = False  # an older or newer jaxlib does not know an option
        return plain(*args)

    return call


def in_a_process(script, **environment):
    """What a script prints and complains of in a process of its own,
    quickly compiled."""
    # The compiler's time is not the point.
    own = {
        "XLA_FLAGS": "--xla_backend_optimization_level=0",
        "PYTHONPATH": str(Path(jr.__file__).parents[1]),
    }
    environment = os.environ | own | environment
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def both_ways(function, x):
    """Value and Jacobian, by columns and by rows, from one trace."""
    value, push = jax.linearize(function, x)
    pull = jax.linear_transpose(push, x)
    basis = jnp.eye(x.size).reshape(x.size, *x.shape)
    columns = jnp.moveaxis(jax.vmap(push)(basis), 0, -1).reshape(*value.shape, *x.shape)
    return value, columns, jax.vmap(lambda row: pull(row)[0])(jnp.eye(value.size))


def reference_attitude(omega, ts, attitude0=(1.0, 0.0, 0.0, 0.0)):
    """Attitude from a rate that is known at every time, by scipy."""

    def rate(t, q):
        w, x, y, z = q
        a, b, c = omega(t)
        return 0.5 * np.array(
            [
                -x * a - y * b - z * c,
                w * a + y * c - z * b,
                w * b + z * a - x * c,
                w * c + x * b - y * a,
            ]
        )

    solution = solve_ivp(
        rate, (ts[0], ts[-1]), attitude0, "DOP853", ts, rtol=1e-13, atol=1e-14
    )
    return solution.y.T
