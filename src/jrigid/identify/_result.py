"""FitResult: what a fit found, how well it is known, and what the record cannot tell, in words."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jrigid._types import Matrix, Scalar, Vector
from jrigid.dynamics import State
from jrigid.identify._unknowns import Unknowns
from jrigid.systems import RigidBody


class Status(eqx.Enumeration):  # pyright: ignore[reportGeneralTypeIssues]
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
        state: State at `t0`, with an axis of throws in front.
        t0: First time of each throw [s].
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
    kept: tuple[Bool[Array, "throws n"], ...]
    spoilt: Bool[Array, " throws"]
    history: Float[Array, " steps"]
    pure_spin: Bool[Array, ""]
    input_result: Any
    unknowns: Unknowns
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

    @property
    def errors(self) -> Float[Array, " numbers"]:
        """Standard errors of `numbers`."""
        return jnp.sqrt(jnp.diagonal(self.covariance)[: self.numbers.size])

    @property
    def correlation(self) -> Float[Array, "all all"]:
        """The covariance with ones on its diagonal."""
        error = jnp.sqrt(jnp.diagonal(self.covariance))
        return self.covariance / error[:, None] / error[None, :]

    @property
    def ratios_errors(self) -> Float[Array, " 2"]:
        """Standard errors of `ratios`."""
        return jnp.sqrt(jnp.diagonal(self.ratios_covariance))

    @property
    def reduced_chi_square(self) -> Scalar:
        """Chi-square for each degree of freedom."""
        return self.chi_square / jnp.maximum(self.degrees_of_freedom, 1)

    @property
    def nuisances(self) -> dict[str, tuple[Array, Array]]:
        """Value and error of each nuisance: biases in rad/s, scales as logarithms, turns in rad."""
        found = {}
        for name in self.unknowns.nuisances:
            s = self.unknowns.slices[name]
            if s.stop > s.start:
                unit = self.unknowns.rate if name == "gyro_bias" else 1.0
                found[name] = unit * self.numbers[s], unit * self.errors[s]
        return found

    @property
    def leaves(self) -> dict[str, tuple[Array, Array]]:
        """Value and error of each leaf of the system that was free."""
        found = {}
        s = self.unknowns.slices["leaves"]
        values = self.unknowns.leaf_values(self.numbers)
        errors = self.unknowns.leaf_units() * self.errors[s]
        for name, value, error in zip(self.names[s], values, errors, strict=True):
            found[name] = value, error
        return found

    @property
    def mirror(self) -> Vector:
        """Moments, about the same axes, of the body that fits the mirrored readings of a gyro.

        With one axis of the gyro reversed the rates obey Euler's equations of another body, whose
        (I2 - I3)/I1 and cyclic ones have the opposite sign: a gyro of unknown handedness cannot
        tell the two apart.
        """
        a = (self.moments[1] - self.moments[2]) / self.moments[0]
        b = (self.moments[2] - self.moments[0]) / self.moments[1]
        second = (1 - a) / (1 + b)
        found = jnp.stack([jnp.ones_like(a), second, second + a])
        return found * jnp.sum(self.moments) / jnp.sum(found)

    @property
    def null_directions(self) -> tuple[str, ...]:
        """What the record does not tell, in words; of a single fit, outside of jit."""
        return words(self)

    def __str__(self) -> str:
        """The fit in words; of many fits, how they ended."""
        return report(self)


def _of_shape(result: FitResult, direction: np.ndarray) -> str:
    """What a change of the shape's numbers does to the body."""
    change = np.asarray(
        jax.jvp(result.unknowns.inertia, (result.numbers,), (jnp.asarray(direction),))[1]
    )
    axes, moments = np.asarray(result.axes), np.asarray(result.moments)
    inside = axes.T @ change @ axes
    relative = np.diag(inside) / moments
    relative = relative - relative.mean()
    gaps = [(1, 2), (2, 0), (0, 1)]
    turns = np.array([inside[i, j] / moments.mean() for i, j in gaps])
    if np.abs(turns).max() > np.abs(relative).max():
        axis = int(np.abs(turns).argmax())
        i, j = sorted(gaps[axis])
        return f"directions of the axes of I{i + 1} and I{j + 1}"
    return _ratio(moments, relative)


def _ratio(moments: np.ndarray, relative: np.ndarray) -> str:
    """The ratio that changes most; I3/I1 of a symmetric body, whose I3 is the odd one."""
    order = np.sort(np.diff(moments))
    if order[0] < 0.1 * order[1]:
        return "I3/I1"
    odd = int(np.abs(relative).argmax())
    return f"I{odd + 1}'s ratio to the others"


_SPEAKING = {
    "scale": "overall scale",
    "gyro_bias": "gyro bias",
    "gyro_scale": "gyro scale",
    "gyro_scales": "gyro scale factors",
    "gyro_misalignment": "gyro misalignment",
    "gyro_matrix": "gyro matrix",
}


def words(result: FitResult) -> tuple[str, ...]:
    """What the record does not tell."""
    found: list[str] = []
    if result.free_motion and not result.unknowns.scaled and result.unknowns.shape != "fixed":
        found.append("overall scale")
    noise = 1.0 if result.noise_known else float(np.sqrt(result.reduced_chi_square))
    values = np.asarray(result.singular_values)
    slices = result.unknowns.slices
    pure = bool(result.pure_spin)
    if pure:
        found.append("spin is pure: ratios not determined")
    for value, direction in zip(values, np.asarray(result.directions).T, strict=True):
        if noise <= LARGEST_ERROR * value:
            continue
        parts: list[tuple[float, str]] = []
        for name, s in slices.items():
            size = float(np.sqrt(np.sum(direction[s] ** 2)))
            if s.stop == s.start or size < 0.2:
                continue
            if name == "shape":
                only = np.zeros_like(direction)
                only[s] = direction[s]
                told = "ratios" if pure else _of_shape(result, only)
                parts.append((size, told))
            elif name == "leaves":
                names = np.array(result.names[s])[np.abs(direction[s]) > 0.2]
                parts.append((size, ", ".join(names)))
            else:
                text = _SPEAKING[name]
                if name == "gyro_bias":
                    axes = np.asarray(result.axes)
                    along = int(np.abs(axes.T @ direction[s]).argmax())
                    text += f" along the axis of I{along + 1}"
                parts.append((size, text))
        parts.sort(reverse=True)
        names = [name for _, name in parts]
        names = [name for name in names if name != "ratios"]
        text = " against ".join(names)
        if text and text not in found:
            found.append(text)
    of_state = np.asarray(result.state_singular_values)
    if of_state.shape[-1] == 6 and (of_state[..., -1] < 1e-6 * of_state[..., 0]).any():
        count = int((of_state < 1e-6 * of_state[..., :1]).sum(axis=-1).max())
        found.append("heading about the vertical" if count == 1 else "attitude in space")
    if "gyro_handedness" in result.unknowns.nuisances:
        found.append("mirror body fits equally: handedness of the gyro")
    return tuple(found)


def remarks(result: FitResult) -> tuple[str, ...]:
    """What to bear in mind of the ratios."""
    found = []
    ratios, errors = np.asarray(result.ratios), np.asarray(result.ratios_errors)
    if result.unknowns.shape in ("symmetric", "top", "fixed"):
        return ()
    weak = errors > 0.03 * ratios
    if weak.any():
        found.append("the ratios are weakly constrained: errors of 3 % or more")
    covariance = np.asarray(result.moments_covariance)
    moments = np.asarray(result.moments)
    for i, j in ((0, 1), (1, 2)):
        gap = moments[j] - moments[i]
        error = math.sqrt(max(covariance[i, i] + covariance[j, j] - 2 * covariance[i, j], 0.0))
        if gap < 2 * error:
            found.append(
                f"I{i + 1} and I{j + 1} are equal within their errors: which is the larger, and "
                "the axes of each, are not determined"
            )
    return tuple(found)


def _with_error(value: Any, error: Any) -> str:
    value, error = float(value), float(error)
    if not error > 1e-9 * abs(value):
        return f"{value:.6g}"
    if not error < 10 * max(abs(value), 1e-300):
        return f"{value:.3g} (not determined)"
    digits = min(max(0, 1 - math.floor(math.log10(error))), 15)
    return f"{value:.{digits}f} +- {error:.{digits}f}"


def report(result: FitResult) -> str:
    """The fit in words."""
    status = result.status
    if jnp.ndim(status._value) or isinstance(result.chi_square, jax.core.Tracer):
        if isinstance(result.chi_square, jax.core.Tracer):
            return "FitResult under a transformation"
        codes = np.asarray(status._value).reshape(-1)
        counts = {
            name: int(np.sum(codes == int(getattr(Status, name)._value)))
            for name in STATUSES
        }
        text = ", ".join(f"{n} {name}" for name, n in counts.items() if n)
        return f"{codes.size} fits: {text}"
    name = next(n for n in STATUSES if bool(status == getattr(Status, n)))
    lines = [f"{name}: {Status[status]}"]
    moments = np.asarray(result.moments)
    errors = np.sqrt(np.diagonal(np.asarray(result.moments_covariance)))
    kept = sum(int(np.sum(np.asarray(k))) for k in result.kept)
    seen = f"{kept} samples"
    if result.state.omega.shape[0] > 1:
        seen += f" of {result.state.omega.shape[0]} throws"
    lines.append(
        f"  {seen}, {int(np.sum(np.isfinite(result.history)))} steps; chi-square {float(result.chi_square):.1f} for "
        f"{int(result.degrees_of_freedom)} degrees of freedom"
        + ("" if result.noise_known else " (noise taken from the residuals)")
    )
    spoilt = np.flatnonzero(np.asarray(result.spoilt))
    if spoilt.size:
        lines.append("  throws left out: " + ", ".join(str(i) for i in spoilt))
    lines.append(
        "  ratios   I2/I1 = "
        + "   I3/I1 = ".join(
            _with_error(v, e) for v, e in zip(result.ratios, result.ratios_errors, strict=True)
        )
    )
    unit = " kg m^2" if result.unknowns.scaled else " (trace as declared)"
    listed = [_with_error(v, e) for v, e in zip(moments, errors, strict=True)]
    lines.append("  moments  " + ", ".join(listed) + unit)
    for i in range(3):
        axis = ", ".join(f"{x: .4f}" for x in np.asarray(result.axes)[:, i])
        lines.append(f"  axis of I{i + 1}  ({axis})")
    turns = ", ".join(
        f"{np.degrees(float(e)):.2g}" if e < 1 else "not determined" for e in result.axes_errors
    )
    lines.append(f"  errors of the axes, as turns about each [deg]: {turns}")
    for title, group in (("", result.leaves), ("", result.nuisances)):
        for label, (value, error) in group.items():
            pairs = zip(np.atleast_1d(value), np.atleast_1d(error), strict=True)
            lines.append(f"  {title}{label} = " + ", ".join(_with_error(v, e) for v, e in pairs))
    if result.state.omega.shape[0] == 1:
        omega = ", ".join(f"{x:.5g}" for x in np.asarray(result.state.omega)[0])
        lines.append(f"  rates at t = {float(result.t0[0]):.6g} s: ({omega}) rad/s")
    lines.extend(f"  {note}" for note in remarks(result))
    untold = result.null_directions
    lines.append("  not told by the record: " + ("; ".join(untold) if untold else "nothing"))
    if "gyro_handedness" in result.unknowns.nuisances:
        mirror = np.asarray(result.mirror)
        lines.append(
            "  mirror body, moments about the same axes: " + ", ".join(f"{x:.5g}" for x in mirror)
        )
    return "\n".join(lines)

