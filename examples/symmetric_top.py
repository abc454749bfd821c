"""The inertia of a symmetric top from its rates, a synthetic check with a known answer.

A body with I1 = I2 tumbles freely, and a gyroscope measures its rates with 2 % noise.
The fit uses only the readings and starts from a sphere. It estimates I1/I3 with a valid
error. Over many records, (estimate - truth) / error is a unit normal variable.

Run it: `python symmetric_top.py`.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

import jrigid as jr

TRUE_RATIO = 0.625  # I1/I3
TRUE_OMEGA = (1.0, 0.5, 2 * math.pi)  # rad/s at time 0: about one turn a second
TIMES = np.arange(401) * 0.05  # s: 20 turns, in which the body wobbles 12 times
NOISE = 0.02  # of the rate


def read_gyro(key: PRNGKeyArray) -> Float[Array, "times 3"]:
    """Noisy readings of the true top [rad/s]."""
    omega = jnp.asarray(TRUE_OMEGA)
    start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), omega)
    clean = jr.free_rotation(
        jnp.array([TRUE_RATIO, TRUE_RATIO, 1.0]), start, TIMES
    ).omega
    sigma = NOISE * jnp.linalg.norm(omega)
    return clean + sigma * jax.random.normal(key, clean.shape, clean.dtype)


def recover(readings: Float[Array, "times 3"]) -> tuple[Array, Array, Array]:
    """I1/I3 from rates alone. Only the axis of symmetry is given, and the noise is not.

    Returns:
        Estimate, its standard error, and whether the fit converged.
    """
    found = jr.identify.fit(
        jr.RigidBody(jnp.ones(3)),
        jr.identify.Rates(TIMES, readings, 1.0),
        inertia_model=jr.identify.Top(),
        absolute_sigma=False,
        throw=False,
    )

    def ratio(numbers: Array) -> Array:
        moments = jnp.diagonal(found.unknowns.inertia(numbers))
        return moments[0] / moments[2]

    error = jnp.abs(jax.grad(ratio)(found.numbers)[0]) * found.errors[0]
    return ratio(found.numbers), error, found.status == jr.identify.Status.OK


def report(ratio: float, error: float) -> str:
    """The result in one line."""
    off = (ratio - TRUE_RATIO) / error
    return (
        f"A synthetic top, 2 % noise, started from a sphere: I1/I3 = {ratio:.5f} +- "
        f"{error:.5f}, true {TRUE_RATIO} ({off:+.1f} standard errors)"
    )


def main() -> None:
    """Recover one top and print it."""
    jax.config.update("jax_enable_x64", True)
    ratio, error, converged = recover(read_gyro(jax.random.key(0)))
    if not bool(converged):
        raise RuntimeError("The fit of the synthetic top did not converge.")
    print(report(float(ratio), float(error)))


if __name__ == "__main__":
    main()
