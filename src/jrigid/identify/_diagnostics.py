"""Diagnostics: residuals of a fit, what determined its numbers, and its history."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int

from jrigid._types import Scalar


class Diagnostics(eqx.Module):
    """Residuals of a fit, what determined its numbers, and how it got there.

    Attributes:
        residuals: Whitened, records side by side; zero where nothing was seen.
        jacobian: Their derivatives in the numbers and in the state of the trial.
        chi_square_by_trial: Mean square of the residuals of each trial.
        whiteness: Correlation of neighbouring residuals, and how many standard
            deviations that is from 0. It is near 0 for noise. What a model leaves out
            changes slowly and brings it near 1.
        loudest_band: Power of the residuals in the band of frequencies that stands out
            most, over the mean power, and how many standard deviations that is from the
            power of noise.
        lag: Time constant [s] of a low-pass filter of the gyroscope that would explain
            residuals, and how many standard errors its effect is from 0, negative for
            what no filter does; zeros where it was not sought.
        gain: Factor in the scale of the gyroscope that would explain residuals, and how
            many standard errors it is from 1; (1, 0) where it was not sought.
        delay: Delay of the gyroscope [s] after other sensors of the motion that would
            explain residuals, and its standard errors from 0; zeros without other
            sensors, or where it was not sought.
        bias: Bias of the gyroscope [rad/s] that would explain residuals, and how many
            standard errors it is from 0; zeros where it was not sought, and where the
            fit seeks a bias.
        unexplained: Fraction of the square of what was observed that the fit does not
            explain, beyond the noise.
        singular_values: Of the derivatives in the numbers, the states' part removed,
            descending.
        directions: In the numbers, columns for the singular values.
        state_singular_values: Of the derivatives in each trial's state, of unit
            columns; a zero is a change of the state that the record does not show.
        sensor_covariance: The part of the numbers' covariance that the sensors' noise
            makes.
        local_covariance: Of each trial's state at `t0` (rate, then, if it matters, a
            small turn of the attitude about the body axes) and own numbers, for given
            numbers.
        sensitivity: Derivative of the state and own numbers of each trial in the
            numbers.
        scores: What each trial adds to the gradient of half the squares, zero in sum.
        inflation: Factor of covariances beyond what the stated noise makes.
        torque_numbers: How many numbers of the unmodelled torque were sought.
        log_determinant: Of the covariance of the record that this torque makes, in
            units of the noise. Its sum with `chi_square` is -2 log likelihood, but for
            a constant. It is 0 without such a torque.
        scales: Of each record's residuals, in units of the noise, in the median of a
            robust fit.
        history: Sum of squares of residuals after each step, NaN beyond the last.
        pure_spin: Whether constant rates describe a gyro's record as well.
        ambiguous: Whether bodies far from this one describe the record nearly as well.
        integration_error: Largest error of the motion over a segment of the record, in
            units of what is allowed. It is 0 where the motion is exact or `simulate`
            integrates it.
        conventions: Whether the attitudes of a record that the fit is far from seem to
            be scalar last, or from space to body; or its rates in degrees a second, or
            along space axes; or the momentum of its rotor to have the wrong sign.
        input_result: `jrigid.RESULTS` of the input.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> found = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
    >>> print(found.diagnostics.residuals.shape)
    (1, 200, 3)
    """

    residuals: Float[Array, "trials samples degrees"]
    jacobian: Float[Array, "trials samples degrees unknowns"]
    chi_square_by_trial: Float[Array, " trials"]
    whiteness: tuple[Scalar, Scalar]
    loudest_band: tuple[Scalar, Scalar]
    lag: tuple[Scalar, Scalar]
    gain: tuple[Scalar, Scalar]
    delay: tuple[Scalar, Scalar]
    bias: tuple[Float[Array, "3"], Scalar]
    unexplained: Scalar
    singular_values: Float[Array, " numbers"]
    directions: Float[Array, "numbers numbers"]
    state_singular_values: Float[Array, "trials local"]
    sensor_covariance: Float[Array, "numbers numbers"]
    local_covariance: Float[Array, "trials local local"]
    sensitivity: Float[Array, "trials local numbers"]
    scores: Float[Array, "trials numbers"]
    inflation: Scalar
    torque_numbers: Int[Array, ""]
    log_determinant: Scalar
    scales: Float[Array, " records"]
    history: Float[Array, " steps"]
    pure_spin: Bool[Array, ""]
    ambiguous: Bool[Array, ""]
    integration_error: Scalar
    conventions: Bool[Array, "5"]
    input_result: Any
