"""A fit in words."""

import math
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from jrigid._core.third_party import names_of
from jrigid._types import AnyArray
from jrigid.identify._errors import weakest_of
from jrigid.identify._inertia_models import Fixed, Flat, Symmetric, Tensor, Top
from jrigid.identify._reasons import CORRELATED, SURELY_CORRELATED, reason
from jrigid.identify._result import LARGEST_ERROR, FitResult, Status

# Relative change of a tensor by a unit of one of its numbers: of a thickness.
_NO_CHANGE = 0.02


def _of_shape(result: FitResult, direction: np.ndarray) -> str:
    """Name the effect on the body of a change of the inertia model."""
    tensor_of = result.unknowns.inertia
    slope = jax.jvp(tensor_of, (result.numbers,), (jnp.asarray(direction),))[1]
    axes = np.asarray(result.axes)
    moments = np.asarray(result.moments)
    inside = axes.T @ np.asarray(slope) @ axes
    if np.abs(inside).max() < _NO_CHANGE * moments.max():
        return "thickness"
    relative = np.diag(inside) / moments
    # A common factor of all moments does not change their ratios.
    relative = np.abs(relative - relative.mean())
    # An element off the diagonal turns the two axes that it stands between.
    turns = np.abs(inside[[1, 2, 0], [2, 0, 1]] / moments.mean())
    if turns.max() > relative.max():
        i, j = sorted({1, 2, 3} - {int(turns.argmax()) + 1})
        return f"directions of the axes of I{i} and I{j}"
    gaps = np.sort(np.diff(moments))
    if gaps[0] < 0.1 * gaps[1]:  # of a symmetric body I3 is the odd one
        return "I3/I1"
    return f"I{relative.argmax() + 1}'s ratio to the others"


def _of_part(result: FitResult, name: str, direction: np.ndarray) -> str:
    """Name a change of the numbers of the inertia model, the scale or an array."""
    unknowns = result.unknowns
    part = unknowns.slices[name]
    sizes = np.abs(direction[part])
    owner, _, field = name.rpartition(".")
    if name == "scale":
        return "overall scale"
    if name == "inertia" and not unknowns.inertia_model.absolute:
        only = np.where(np.arange(direction.size) < part.stop, direction, 0.0)
        return "" if result.diagnostics.pure_spin else _of_shape(result, only)
    if sizes.size == 3 and field == "bias":
        axis = np.abs(np.asarray(result.axes).T @ direction[part]).argmax()
        return f"{owner} bias along the axis of I{axis + 1}"
    if name == "inertia" or owner.startswith("torque"):
        least = 0.2 if name == "inertia" else 0.2 * sizes.max()
        return ", ".join(np.array(result.names[part])[sizes > least])
    return f"{owner} {field}"


def _undetermined(result: FitResult, direction: np.ndarray) -> str:
    """A direction of the numbers, in words, the largest part first."""
    parts = result.unknowns.slices.items()
    sizes = {name: float(np.sqrt(np.sum(direction[s] ** 2))) for name, s in parts}
    # Directions have unit length. Parts below 0.2 are too small to be named.
    texts = [
        (x, _of_part(result, name, direction)) for name, x in sizes.items() if x >= 0.2
    ]
    return " against ".join(text for _, text in sorted(texts, reverse=True) if text)


def null_directions(result: FitResult) -> tuple[str, ...]:
    """Quantities that the record does not determine, in words."""
    texts = [
        *_undetermined_scale(result),
        *_undetermined_numbers(result),
        *_undetermined_attitude(result),
    ]
    return tuple(dict.fromkeys(filter(None, texts)))


def _undetermined_scale(result: FitResult) -> list[str]:
    """The overall scale, where nothing sets it."""
    unknowns = result.unknowns
    free_motion = result.problem.options.free_motion
    if unknowns.has_scale:
        return []
    if free_motion:
        return ["overall scale"]
    if unknowns.seeks_torque:
        return ["overall scale, which what is sought of the torque follows"]
    return []


def _undetermined_numbers(result: FitResult) -> list[str]:
    """Directions of the numbers whose errors are large."""
    unknowns = result.unknowns
    diagnostics = result.diagnostics
    texts = ["spin is pure: ratios not determined"] * bool(diagnostics.pure_spin)
    directions = np.asarray(diagnostics.directions).T
    values = np.asarray(diagnostics.singular_values)
    weak = math.sqrt(diagnostics.inflation) > LARGEST_ERROR * values
    texts += [_undetermined(result, x) for x in directions[weak]]
    if diagnostics.pure_spin:
        return texts
    loose = bool(np.any(result.ratios_errors > LARGEST_ERROR * result.ratios))
    if loose and not weak.any():
        texts.append("I1's ratio to the others")
    if diagnostics.ambiguous:
        units = np.asarray(unknowns.natural_units(result.numbers))
        covariance = np.asarray(result.numbers_covariance)
        _, normal, _ = weakest_of(unknowns.judged, covariance, units)
        weakest = _undetermined(result, normal * units)
        texts.append(f"{weakest}: others far from it are nearly as good")
    return texts


def _undetermined_attitude(result: FitResult) -> list[str]:
    """The heading, or the attitude, where no observation tells it."""
    of_state = np.asarray(result.diagnostics.state_singular_values)
    count = (of_state < 1e-6 * of_state[:, :1]).sum(axis=-1).max()
    if not (result.problem.options.depends_on_attitude and count):
        return []
    # A weight shows the vertical, so that only the turn about it can be missing.
    return ["heading about the vertical" if count == 1 else "attitude in space"]


def _diagonal(matrix: Any) -> np.ndarray:
    """The diagonal, positive, in float64: 1e-300 is zero in float32."""
    return np.maximum(np.diagonal(np.asarray(matrix, np.float64)), 1e-300)


def _spread_of_trials(result: FitResult) -> float:
    """Ratio of the largest to the least chi-square of a trial, without extreme tenths.

    The ratio is 1 if there are fewer than three trials. Trials that were left out have
    no residuals.
    """
    by_trial = np.asarray(result.diagnostics.chi_square_by_trial, np.float64)
    by_trial = by_trial[~np.asarray(result.rejected_trials)]
    if by_trial.size < 3:
        return 1.0
    low, high = np.maximum(np.quantile(by_trial, [0.1, 0.9]), 1e-300)
    return float(high / low)


def _of_record(result: FitResult) -> list[tuple[Any, str]]:
    """Notes on residuals, prior knowledge and saturation, and whether each holds."""
    diagnostics = result.diagnostics
    noise_known = result.problem.options.noise_known
    spread = _spread_of_trials(result)
    size = max(math.sqrt(result.reduced_chi_square), float(np.max(diagnostics.scales)))
    like, sure = diagnostics.whiteness
    notes = [
        (
            noise_known and size > 1.3,
            f"residuals are {size:.2g} times the stated noise",
        ),
        (
            abs(like) > CORRELATED and sure > SURELY_CORRELATED,
            "residuals are not white: neighbours correlate by "
            f"{like:.2f}, {sure:.0f} standard deviations from none",
        ),
        (
            spread > 4,
            f"trials differ: chi-square of nine tenths spreads by {spread:.2g}",
        ),
    ]
    return [*notes, *_of_priors(result), *_of_saturation(result)]


def _of_priors(result: FitResult) -> list[tuple[Any, str]]:
    """Notes on arrays that end far from what was known of them beforehand."""
    notes = []
    for x in result.unknowns.sought:
        if not x.own and x.sigma is not None:
            numbers = result.numbers[result.unknowns.slices[x.name]]
            far = float(jnp.max(jnp.abs(x.prior_rows(numbers))))
            text = (
                f"{x.name} is {far:.1f} standard deviations from what was known of it"
            )
            notes.append((far > 3, text))
    return notes


def _of_saturation(result: FitResult) -> list[tuple[Any, str]]:
    """Notes on records with values that repeat their largest one."""
    notes = []
    records = zip(result.fitted()[1:], result.problem.samples.values, strict=True)
    for sensor, values in records:
        sizes = np.abs(values)
        largest = sizes.max()
        may_saturate = sensor.saturation() is None and not sensor.unit_length
        # Readings seldom repeat their largest value, except at a limit of the sensor.
        count = np.sum(sizes >= largest * (1 - 1e-9))
        name = type(sensor).__name__
        text = f"{count} values of {name} are its largest: saturated? (`limit`)"
        notes.append((count > 3 and largest > 0 and may_saturate, text))
    return notes


def remarks(result: FitResult) -> tuple[str, ...]:
    """Remarks that a reader of the result should bear in mind."""
    notes = _of_record(result)
    # These models assume equal moments, or know them, and a pure spin tells no ratio.
    assumes = isinstance(result.unknowns.inertia_model, Symmetric | Top | Fixed)
    if not (assumes or result.diagnostics.pure_spin):
        notes += _of_ratios(result)
        notes += _of_mirror(result)
    return tuple(text for holds, text in notes if holds)


def _of_ratios(result: FitResult) -> list[tuple[Any, str]]:
    """Notes on ratios with large errors, and on moments that may be equal."""
    ratios = np.asarray(result.ratios)
    # Shares of the trace are known where the scale of the moments is not.
    shares = np.asarray(result.shares)
    covariance = np.asarray(result.shares_covariance)
    loose = (np.asarray(result.ratios_errors) > 0.03 * ratios).any()
    notes = [(loose, "the ratios are weakly constrained: errors of 3 % or more")]
    for i in (0, 1):
        (first, across), (_, second) = covariance[i : i + 2, i : i + 2]
        # This is the error of the difference of two shares, whose estimates are
        # correlated.
        error = math.sqrt(max(first + second - 2 * across, 0.0))
        text = (
            f"I{i + 1} and I{i + 2} are equal within their errors: which is the "
            "larger, and the axes of each, are not determined"
        )
        notes.append((shares[i + 1] - shares[i] < 2 * error, text))
    return notes


def _of_mirror(result: FitResult) -> list[tuple[Any, str]]:
    """A note on the body that fits the readings of a gyro of the other handedness."""
    by_rates = not any(x.depends_on_attitude for x in result.fitted()[1:])
    least, middle, most = np.sort(np.asarray(result.mirror_moments, float))
    is_real = least > 0 and most < least + middle
    unit = max(least, 1e-300)
    return [
        (
            by_rates and result.problem.options.free_motion and is_real,
            "with one axis of the gyro reversed the same record is that of a body "
            f"with I2/I1 = {middle / unit:.4g}, I3/I1 = {most / unit:.4g}",
        )
    ]


def _with_error(value: np.floating, error: np.floating, unit: float = 0.0) -> str:
    """A number with as many digits as its error leaves it.

    An error of ten times the number, or of ten units, means that it is not determined.
    """
    value = np.float64(value)
    error = np.float64(error)
    # Written with `not`, so that an error of NaN prints the value alone.
    if not error > 1e-9 * abs(value):
        return f"{value:.6g}"
    if not error < 10 * max(abs(value), unit, 1e-300):
        return f"{value:.3g} (not determined)"
    # The error keeps two significant digits.
    digits = 1 - math.floor(math.log10(error))
    if digits > 6 and abs(value) < 1e-3:
        return f"{value:.6g} +- {error:.2g}"
    digits = min(max(0, digits), 15)
    return f"{value:.{digits}f} +- {error:.{digits}f}"


def _with_errors(
    values: AnyArray, errors: AnyArray, between: str = ", ", unit: float = 0.0
) -> str:
    """Numbers with their errors."""
    pairs = zip(np.ravel(values), np.ravel(errors), strict=True)
    return between.join(_with_error(*x, unit) for x in pairs)


def _of_tensor(result: FitResult) -> list[str]:
    """Ratios, moments and axes."""
    model = result.unknowns.inertia_model
    unit = " kg m^2" if result.unknowns.has_scale else " (trace as declared)"
    errors = np.sqrt(np.diagonal(np.asarray(result.moments_covariance)))
    lines = [
        "  ratios   I2/I1 = "
        + _with_errors(result.ratios, result.ratios_errors, "   I3/I1 = "),
        "  moments  " + _with_errors(result.moments, errors) + unit,
    ]
    for i, axis in enumerate(np.asarray(result.axes).T):
        lines.append(f"  axis of I{i + 1}  ({', '.join(f'{x: .4f}' for x in axis)})")
    turns = (
        f"{np.degrees(e):.2g}" if e < 1 else "not determined"
        for e in result.axes_errors
    )
    if isinstance(model, Tensor | Flat | Symmetric):
        lines.append(
            f"  errors of the axes, as turns about each [deg]: {', '.join(turns)}"
        )
    return lines


def _of_torque(result: FitResult) -> list[str]:
    """The unmodelled torque, and what of the errors it makes."""
    if result.problem.options.unmodelled == "none":
        return []
    level = np.asarray(result.level)
    times = np.asarray(result.correlation_time)
    alike = np.all(level == level[0]) and np.all(times == times[0])
    axes = slice(0, 1 if alike else 3)
    pairs = list(zip(level[axes], np.asarray(result.level_errors)[axes], strict=True))
    unseen = "0 (of {:.2g} nothing would be seen)"
    levels = ", ".join(
        _with_error(*x) if x[0] > 0 else unseen.format(x[1]) for x in pairs
    )
    memory = "white"
    if np.any(times > 0):
        errors = np.asarray(result.correlation_time_errors)[axes]
        memory = f"correlation time {_with_errors(times[axes], errors)} s"
    own = np.diagonal(np.asarray(result.diagnostics.sensor_covariance))
    shares = own / _diagonal(result.numbers_covariance)
    # These are shares of variances, and the report states one of errors.
    part = 100 * np.sqrt(np.median(shares)) if own.size else 100
    lines = [
        f"  unmodelled torque {levels} N m s^1/2, {memory}; the sensors alone would "
        f"make {part:.0f} % of the errors"
    ]
    by_trial = np.asarray(result.level_by_trial)[~np.asarray(result.rejected_trials)]
    if np.any(by_trial != by_trial[0]):
        limits = f"{by_trial.min():.2g} to {by_trial.max():.2g}"
        lines.append(f"  its level in trials: {limits} times that")
    return lines


def report(result: FitResult) -> str:
    """The fit in words."""
    if isinstance(result.chi_square, jax.core.Tracer):
        return "FitResult under a transformation"
    value = np.asarray(result.status)
    if value.ndim:
        return _of_many(value)
    lines = _of_fit(result)
    if result.status == Status.BAD_INPUT:
        return lines[0]
    rejected = ", ".join(map(str, np.flatnonzero(result.rejected_trials)))
    lines += [f"  trials left out: {rejected}"] * bool(rejected)
    if result.diagnostics.pure_spin:
        lines.append("  ratios   not determined")
    else:
        lines += _of_tensor(result)
    lines += _of_torque(result)
    lines += _of_estimates(result)
    undetermined = "; ".join(result.null_directions) or "nothing"
    lines.append(f"  not determined by the record: {undetermined}")
    return "\n".join(lines + [f"  {note}" for note in remarks(result)])


def _of_many(codes: np.ndarray) -> str:
    """Counts of fits by their status, in words."""
    names = dict(enumerate(names_of(Status)))
    counts = {names[code]: np.sum(codes == code) for code in sorted(names)}
    text = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
    return f"{codes.size} fits: {text}"


def _of_fit(result: FitResult) -> list[str]:
    """The status with its reason; samples, steps and chi-square."""
    trials = result.state.omega.shape[0]
    steps = np.sum(np.isfinite(result.diagnostics.history))
    samples = f"{np.sum(result.kept)} samples"
    if trials > 1:
        samples += f" of {trials} trials"
    # A chi-square in units of a noise that nobody stated would say nothing.
    rms = jnp.sqrt(jnp.nanmean(result.residuals() ** 2))
    sum_of_squares = f"noise taken from the residuals: {rms:.3g} rms,"
    if result.problem.options.noise_known:
        sum_of_squares = f"chi-square {result.chi_square:.1f} for"
    name = names_of(Status)[int(np.asarray(result.status))]
    sentences = [f"{name}: {Status[result.status]}", reason(result)]
    return [
        " ".join(filter(None, sentences)),
        f"  {samples}, {steps} steps; {sum_of_squares} "
        f"{result.degrees_of_freedom} degrees of freedom",
    ]


def _of_estimates(result: FitResult) -> list[str]:
    """Arrays that were sought beside the inertia, and the rates of a single trial."""
    is_single = result.state.omega.shape[0] == 1
    # Arrays of each trial are too many to print.
    own = {x.name for x in result.unknowns.sought if x.own and x.base.ndim}
    lines = [
        f"  {name} = {_with_errors(*pair, unit=1.0)}"
        for name, pair in result.estimates.items()
        if is_single or name not in own
    ]
    if is_single:
        omega = ", ".join(f"{x:.5g}" for x in np.asarray(result.state.omega)[0])
        lines.append(f"  rates at t = {result.t0[0]:.6g} s: ({omega}) rad/s")
    return lines
