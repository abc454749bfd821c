"""The inertia of a symmetric top from its body rates: a synthetic check with a known answer.

A body with I1 = I2 tumbles freely and a gyro reads its rates with 2 % noise. From nothing but the
readings, and starting from a sphere, I1/I3 comes back with an error bar that can be trusted: over
many records, (estimate - truth) / error is a unit normal variable.

Run it: `python symmetric_top.py`.
"""

import math
from typing import cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

import jrigid as jr
from jrigid import _fit

TRUE_RATIO = 0.625  # I1/I3
TRUE_OMEGA = (1.0, 0.5, 2 * math.pi)  # rad/s at time 0: about one turn a second
TIMES = np.arange(401) * 0.05  # s: 20 turns, in which the body wobbles 12 times
NOISE = 0.02  # of the rate
HALF_TURN = 0.5  # s: any gyro shows how fast its body spins


class Top(eqx.Module):
    """Parameters of the motion.

    Attributes:
        log_ratio: log(I3/I1): any number is a body, a sphere is 0.
        omega: Angular velocity at time 0 [rad/s], body components.
    """

    log_ratio: Float[Array, ""]
    omega: Float[Array, " 3"]


def rates(top: Top, times: Float[Array, " times"]) -> Float[Array, "times 3"]:
    """Body rates [rad/s] at equally spaced times: Euler's equations, integrated in fixed steps."""
    inertia = jnp.stack([jnp.ones_like(top.log_ratio)] * 2 + [jnp.exp(top.log_ratio)])
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda _, omega, inertia: jr.euler_equations(inertia, omega)),
        diffrax.Tsit5(),
        times[0],
        times[-1],
        None,
        top.omega,
        inertia,
        stepsize_controller=diffrax.StepTo(times),
        saveat=diffrax.SaveAt(t0=True, steps=True),
        adjoint=diffrax.ForwardMode(),
        max_steps=len(times) - 1,
    )
    return cast(Array, solution.ys)


def read_gyro(key: PRNGKeyArray) -> Float[Array, "times 3"]:
    """Noisy readings of the true top [rad/s]."""
    truth = Top(-jnp.log(jnp.asarray(TRUE_RATIO)), jnp.asarray(TRUE_OMEGA))
    sigma = NOISE * jnp.linalg.norm(truth.omega)
    clean = rates(truth, jnp.asarray(TIMES))
    return clean + sigma * jax.random.normal(key, clean.shape, clean.dtype)


def recover(readings: Float[Array, "times 3"]) -> tuple[Array, Array, Array]:
    """I1/I3 from body rates alone, blind: the start is a sphere that spins as first read.

    No real body wobbles faster than it spins, so half a turn is a horizon short enough for any.

    Returns:
        Estimate, its standard error, and whether the fit converged.
    """
    times = jnp.asarray(TIMES)
    start = Top(jnp.zeros_like(readings[0, 0]), readings[0])
    fit = _fit.doubling_horizon(
        lambda top, readings: rates(top, times) - readings,
        start,
        readings,
        times,
        _fit.doublings(TIMES, HALF_TURN),
    )
    ratio = jnp.exp(-fit.params.log_ratio)
    error = ratio * jnp.sqrt(_fit.covariance(fit.jacobian, fit.residuals)[0, 0])
    return ratio, error, fit.converged


def report(ratio: float, error: float) -> str:
    """One line."""
    off = (ratio - TRUE_RATIO) / error
    return (
        f"A synthetic top, 2 % noise, started from a sphere: I1/I3 = {ratio:.5f} +- {error:.5f}, "
        f"true {TRUE_RATIO} ({off:+.1f} standard errors)"
    )


def main() -> None:
    """Recover one top and print it."""
    jax.config.update("jax_enable_x64", True)
    ratio, error, converged = jax.jit(lambda key: recover(read_gyro(key)))(jax.random.key(0))
    if not bool(converged):
        raise RuntimeError("The fit of the synthetic top did not converge.")
    print(report(float(ratio), float(error)))


if __name__ == "__main__":
    main()
