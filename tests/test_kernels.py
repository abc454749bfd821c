"""The size of the compiled programs: kernels of `simulate` with a user's torque.

What a first call costs grows with the number of kernels that XLA makes, which, unlike
times, is exact and repeatable. `benchmarks/bench_first_call.py` measures both.
"""

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import pytest
from helpers import kernels

import jrigid as jr

# The largest number of kernels allowed. Hand-written diffrax has 45, 302, 63 and 426.
MOST_KERNELS = {
    "value": 85,
    "gradient": 240,
    "vmapped value": 130,
    "vmapped gradient": 320,
}
TIMES = np.linspace(0.0, 20.0, 11)
DIPOLE = np.array([0.3, 0.1, 0.5])
OMEGA = np.array([0.3, 0.5, 0.8])
LANES = np.random.default_rng(0).normal(size=(1000, 3))

# The flags that conftest.py sets for older versions of XLA change the counts. Users
# have the defaults, which these options restore.
_DEFAULTS = None
if jaxlib.version.__version_info__ < (0, 11):
    _DEFAULTS = {"xla_cpu_use_fusion_emitters": True, "xla_disable_hlo_passes": ""}


def torque(t, state, args):
    """A dipole, `args`, in a field that turns about the vertical."""
    field = jnp.stack([jnp.cos(0.7 * t), jnp.sin(0.7 * t), jnp.zeros_like(t)])
    return jnp.cross(args, jr.rotation.rotate_inverse(state.attitude, field))


def states(dipole, omega):
    state0 = jr.State(np.array([1.0, 0.0, 0.0, 0.0]), omega)
    body = jr.RigidBody(np.array([1.0, 2.0, 3.0]), torque)
    found = jr.simulate(body, state0, TIMES, dipole, throw=False).states
    return jnp.concatenate([found.attitude, found.omega], axis=1)


def weighted_sum(dipole, omega):
    weights = np.cos(np.arange(77)).reshape(11, 7)
    return jnp.sum(weights * states(dipole, omega))


def count(function, *arguments):
    lowered = jax.jit(function).lower(*map(jnp.asarray, arguments))
    return kernels(lowered.compile(compiler_options=_DEFAULTS).as_text())


@pytest.fixture(scope="module")
def counts():
    gradient = jax.grad(weighted_sum)
    return {
        "value": count(states, DIPOLE, OMEGA),
        "gradient": count(gradient, DIPOLE, OMEGA),
        "vmapped value": count(jax.vmap(states, (None, 0)), DIPOLE, LANES),
        "vmapped gradient": count(jax.vmap(gradient, (None, 0)), DIPOLE, LANES),
    }


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="counted for CPUs")
@pytest.mark.parametrize("program", MOST_KERNELS)
def test_a_program_has_few_kernels(counts, program):
    assert counts[program] <= MOST_KERNELS[program], counts
