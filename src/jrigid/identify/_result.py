"""FitResult: what a fit found, how well it is known, and what the record cannot tell, in words."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jrigid._checks import Enumeration
from jrigid._types import Matrix, Scalar, Vector
from jrigid.dynamics import State
from jrigid.identify._unknowns import Unknowns
from jrigid.mass import MassProperties
from jrigid.systems import RigidBody


class Status(Enumeration):  # pyright: ignore[reportGeneralTypeIssues]
    """What became of a fit."""

    OK = "The fit describes the record, and the record tells what was asked."
    UNIDENTIFIABLE = (
        "The fit describes the record, but the record does not tell all that was asked: see "
        "`null_directions`."
    )
    WRONG_BASIN = (
        "The fit does not describe the record: chi-square is too large for the noise that was "
        "stated. It ended in a wrong minimum, or the model or the noise is wrong. With "
        "`throw=False` it can be looked at."
    )
    AT_BOUNDARY = (
        "The fit has run into the boundary of real bodies: all mass in a plane or on a line. The "
        "record asks for a tensor that no body has, or hardly tells it."
    )
    NOT_CONVERGED = (
        "The fit has not converged in the steps allowed. With `throw=False` it can be looked at."
    )
    BAD_INPUT = "The observations, or another argument, are not usable."


STATUSES = ("OK", "UNIDENTIFIABLE", "WRONG_BASIN", "AT_BOUNDARY", "NOT_CONVERGED", "BAD_INPUT")
# An error above this, in natural units, and a direction is not told.
LARGEST_ERROR = 0.3


def _errors(covariance: Array) -> Array:
    return jnp.sqrt(jnp.diagonal(covariance, axis1=-2, axis2=-1))


class FitResult(eqx.Module):
    """Inertia, state and nuisances with errors; what is a number in one fit is a lane's under vmap.

    `print` shows it in words. Errors are standard errors; if no noise was stated, its level is that
    of the residuals.

    Attributes:
        status: A `jrigid.identify.Status`.
        inertia: The tensor, in the axes of the sensor or body [kg m^2]; with `scale="trace"` of the
            trace of the system's.
        moments: Principal moments, ascending.
        axes: Principal axes, columns, body from principal.
        moments_covariance: Of the moments.
        axes_errors: Errors of the turn about each principal axis [rad].
        ratios: I2/I1 and I3/I1.
        ratios_covariance: Of the ratios.
        state: State at `t0`, not at time 0, with an axis of throws in front: see `start`.
        t0: Time of each throw's state [s]: that of its first sample, in a fit.
        numbers: The global numbers sought: see `names`.
        covariance: Of `numbers`, then of the states: for each throw the rate, and, if it matters,
            a small turn of the attitude about the body axes.
        residuals: Whitened, (throws, rows); zero where nothing was seen.
        jacobian: Their derivatives in the numbers and in the state of the throw.
        chi_square: Sum of their squares.
        degrees_of_freedom: Residuals less what was sought.
        singular_values: Of the derivatives in the numbers, the states' part removed, descending.
        directions: In the numbers, columns for the singular values.
        state_singular_values: Of the derivatives in each throw's state, of unit columns; a zero is
            a change of the state that the record does not show.
        kept: For each kind of observation, which samples were (throws, n).
        spoilt: Throws that a robust fit gave up.
        history: Sum of squares of the record after each step, NaN beyond the last.
        pure_spin: Whether constant rates describe a gyro's record as well.
        input_result: `jrigid.RESULTS` of the input.
        unknowns: What the numbers mean: `unknowns.inertia(numbers)` is the tensor, to carry
            `covariance` over to anything that follows from it.
        problem: The record as it was fitted.
        options: How it was fitted.
        noise_known: Whether errors follow from the noise stated, not from the residuals.
        free_motion: Whether the motion is that of a body without torque.
    """

    status: Any
    inertia: Matrix
    moments: Vector
    axes: Matrix
    moments_covariance: Matrix
    axes_errors: Vector
    ratios: Float[Array, " 2"]
    ratios_covariance: Float[Array, "2 2"]
    state: State
    t0: Float[Array, " throws"]
    numbers: Float[Array, " numbers"]
    covariance: Float[Array, "all all"]
    residuals: Float[Array, "throws rows"]
    jacobian: Float[Array, "throws rows unknowns"]
    chi_square: Scalar
    degrees_of_freedom: Int[Array, ""]
    singular_values: Float[Array, " numbers"]
    directions: Float[Array, "numbers numbers"]
    state_singular_values: Float[Array, "throws state"]
    kept: tuple[Array, ...]
    spoilt: Bool[Array, " throws"]
    history: Float[Array, " steps"]
    pure_spin: Bool[Array, ""]
    input_result: Any
    unknowns: Unknowns
    problem: Any
    options: Any = eqx.field(static=True)
    noise_known: bool = eqx.field(static=True)
    free_motion: bool = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        """What each of `numbers` is."""
        return self.unknowns.names()

    @property
    def system(self) -> RigidBody:
        """The body that was found."""
        return self.unknowns.system_and_gyro(self.numbers)[0]  # pyright: ignore

    def start(self, index: int = 0) -> tuple[State, Float[Array, "*fits"]]:
        """The state of a throw and its time [s], which whoever moves the state needs.

        Args:
            index: Which throw.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> record = jr.datasets.gyro_example()
        >>> readings = jr.identify.Rates(record.times + 50, record.omegas, record.sigma)
        >>> found = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
        >>> state0, t0 = found.start()
        >>> later = jr.simulate(found.system, state0, jnp.array([100.0]), t0=t0)
        >>> print(t0)
        50.0
        """
        attitude, omega = self.state.attitude[..., index, :], self.state.omega[..., index, :]
        return State(attitude, omega), self.t0[..., index]

    @property
    def body(self) -> MassProperties:
        """The body that was found, about its fixed point, by a `LogCholesky`.

        Raises:
            ValueError: The shape that was sought was another one.
        """
        if self.unknowns.ten is None:
            raise ValueError(
                "Argument `shape` of the fit must be a LogCholesky for a mass and a centre of mass "
                "to follow, but it was not."
            )
        return self.unknowns.ten.body(self.numbers[self.unknowns.slices["shape"]])

    @property
    def errors(self) -> Float[Array, "*fits numbers"]:
        """Standard errors of `numbers`."""
        return _errors(self.covariance)[..., : self.numbers.shape[-1]]

    @property
    def correlation(self) -> Float[Array, "*fits all all"]:
        """The covariance with ones on its diagonal."""
        error = _errors(self.covariance)
        return self.covariance / error[..., :, None] / error[..., None, :]

    @property
    def ratios_errors(self) -> Float[Array, "*fits 2"]:
        """Standard errors of `ratios`."""
        return _errors(self.ratios_covariance)

    @property
    def reduced_chi_square(self) -> Float[Array, "*fits"]:
        """Chi-square for each degree of freedom."""
        freedom = jnp.maximum(self.degrees_of_freedom, 1).astype(self.chi_square.dtype)
        return self.chi_square / freedom

    @property
    def nuisances(self) -> dict[str, tuple[Array, Array]]:
        """Value and error of each nuisance: biases in rad/s, scales as logarithms, turns in rad."""
        found = {}
        for name in self.unknowns.nuisances:
            s = self.unknowns.slices[name]
            if s.stop > s.start:
                unit = self.unknowns.rate[..., None] if name == "gyro_bias" else 1.0
                found[name] = unit * self.numbers[..., s], unit * self.errors[..., s]
        return found

    @property
    def leaves(self) -> dict[str, tuple[Array, Array]]:
        """Value and error of each leaf of the system that was free, of a single fit."""
        found = {}
        s = self.unknowns.slices["leaves"]
        values = self.unknowns.leaf_values(self.numbers)
        errors = self.unknowns.leaf_units() * self.errors[s]
        for name, value, error in zip(self.names[s], values, errors, strict=True):
            found[name] = value, error
        return found

    @property
    def mirror(self) -> Float[Array, "*fits 3"]:
        """Moments, about the same axes, of the body that fits the mirrored readings of a gyro.

        With all axes of the gyro reversed, or one that is a principal axis, the rates obey Euler's
        equations of another body, whose (I2 - I3)/I1 and cyclic ones have the opposite sign: a gyro
        of unknown handedness cannot tell the two apart.
        """
        first, second, third = jnp.moveaxis(self.moments, -1, 0)
        a, b = (second - third) / first, (third - first) / second
        other = (1 - a) / (1 + b)
        found = jnp.stack([jnp.ones_like(a), other, other + a], axis=-1)
        total = jnp.sum(found, axis=-1, keepdims=True)
        return found * jnp.sum(self.moments, axis=-1, keepdims=True) / total

    @property
    def null_directions(self) -> tuple[str, ...]:
        """What the record does not tell, in words; of a single fit, outside of jit."""
        from jrigid.identify._words import null_directions

        return null_directions(self)

    def __str__(self) -> str:
        """The fit in words; of many fits, how they ended."""
        from jrigid.identify._words import report

        return report(self)
