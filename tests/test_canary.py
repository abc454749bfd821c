"""What the package stands on: a jax that multiplies right,
versions that are what they say."""

import importlib.metadata
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

import jrigid as jr


def test_jitted_vmapped_product_with_a_shared_matrix_is_right():
    """jax 0.10.2 on CPU gets this wrong above 16384 rows,
    silently (jax-ml/jax#39103)."""
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(3, 3))
    omegas = rng.normal(size=(20000, 3))
    ours = jax.jit(jax.vmap(lambda w: jnp.sum((jnp.asarray(matrix) @ w) ** 2)))(omegas)
    np.testing.assert_allclose(
        ours, np.sum((omegas @ matrix.T) ** 2, axis=1), rtol=1e-12
    )


def test_kinetic_energy_of_many_lanes_is_right():
    rng = np.random.default_rng(1)
    tensor = np.array([[2.0, -0.3, 0.2], [-0.3, 2.5, 0.4], [0.2, 0.4, 1.7]])
    omegas = rng.normal(size=(20000, 3))
    ours = jax.jit(jax.vmap(jr.kinetic_energy, in_axes=(None, 0)))(tensor, omegas)
    exact = 0.5 * np.einsum("ni,ij,nj->n", omegas, tensor, omegas)
    np.testing.assert_allclose(ours, exact, rtol=1e-12)


def test_the_broken_jax_is_excluded():
    requirements = importlib.metadata.requires("jrigid")
    for name in ("jax", "jaxlib"):
        (requirement,) = [r for r in requirements if re.match(rf"{name}\b[^-]", r)]
        assert "!=0.10.2" in requirement
    assert importlib.metadata.version("jax") != "0.10.2"


def test_version_is_that_of_the_distribution():
    assert jr.__version__ == importlib.metadata.version("jrigid")


def test_import_leaves_jax_configuration_alone():
    code = (
        "import diffrax, jax; before = dict(jax.config.values); import jrigid; "
        "assert dict(jax.config.values) == before; "
        "import jax.numpy as jnp; assert jnp.ones(3).dtype == jnp.float32"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
