"""A fit in words."""

import math
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from jrigid._core.third_party import names_of
from jrigid.identify._errors import weakest_of
from jrigid.identify._inertia_models import Fixed, Flat, Symmetric, Tensor, Top
from jrigid.identify._reasons import reason
from jrigid.identify._result import LARGEST_ERROR, FitResult, Status

_LIKE, _SURE = (
    0.1,
    5.0,
)  # correlation of neighbours, and its standard deviations, of no noise
_FAINT = (
    0.02  # relative change of a tensor by a unit of one of its numbers: of a thickness
)


def _of_shape(result: FitResult, direction: np.ndarray) -> str:
    """What a change of the inertia model does to the body."""
    tensor_of = lambda x: result.unknowns.inertia(x)  # noqa: E731
    slope = jax.jvp(tensor_of, (result.numbers,), (jnp.asarray(direction),))[1]
    axes, moments = np.asarray(result.axes), np.asarray(result.moments)
    inside = axes.T @ np.asarray(slope) @ axes
    if np.abs(inside).max() < _FAINT * moments.max():
        return "thickness"
    relative = np.diag(inside) / moments
    relative = np.abs(relative - relative.mean())
    turns = np.abs(inside[[1, 2, 0], [2, 0, 1]] / moments.mean())
    if turns.max() > relative.max():
        i, j = sorted({1, 2, 3} - {int(turns.argmax()) + 1})
        return f"directions of the axes of I{i} and I{j}"
    gaps = np.sort(np.diff(moments))
    if gaps[0] < 0.1 * gaps[1]:  # of a symmetric body I3 is the odd one
        return "I3/I1"
    return f"I{relative.argmax() + 1}'s ratio to the others"


def _of_part(result: FitResult, name: str, direction: np.ndarray) -> str:
    """What a change of the inertia model, the scale's or an array's numbers is."""
    unknowns, s = result.unknowns, result.unknowns.slices[name]
    names, sizes, (owner, _, field) = (
        result.names[s],
        np.abs(direction[s]),
        name.rpartition("."),
    )
    if name == "scale":
        return "overall scale"
    if name == "inertia" and not unknowns.inertia_model.absolute:
        only = np.where(np.arange(direction.size) < s.stop, direction, 0.0)
        return "" if result.diagnostics.pure_spin else _of_shape(result, only)
    if sizes.size == 3 and field == "bias":
        axis = np.abs(np.asarray(result.axes).T @ direction[s]).argmax()
        return f"{owner} bias along the axis of I{axis + 1}"
    if name == "inertia" or owner.startswith("torque"):
        least = 0.2 if name == "inertia" else 0.2 * sizes.max()
        return ", ".join(np.array(names)[sizes > least])
    return f"{owner} {field}"


def _untold(result: FitResult, direction: np.ndarray) -> str:
    """A direction of the numbers, in words, the largest part first."""
    parts = result.unknowns.slices.items()
    sizes = {name: float(np.sqrt(np.sum(direction[s] ** 2))) for name, s in parts}
    texts = [
        (x, _of_part(result, name, direction)) for name, x in sizes.items() if x >= 0.2
    ]
    return " against ".join(text for _, text in sorted(texts, reverse=True) if text)


def null_directions(result: FitResult) -> tuple[str, ...]:
    """What the record does not tell."""
    unknowns, options, seen = (
        result.unknowns,
        result.problem.options,
        result.diagnostics,
    )
    known = unknowns.scaled or unknowns.inertia_model.absolute
    driven = any(x.name.startswith("torque") for x in unknowns.sought)
    follow = (
        "" if options.free_motion else ", which what is sought of the torque follows"
    )
    found = ["overall scale" + follow] * (not known and (driven or options.free_motion))
    found += ["spin is pure: ratios not determined"] * bool(seen.pure_spin)
    directions = np.asarray(seen.directions).T
    weak = math.sqrt(seen.inflation) > LARGEST_ERROR * np.asarray(seen.singular_values)
    found += [_untold(result, x) for x in directions[weak]]
    loose = bool(np.any(result.ratios_errors > LARGEST_ERROR * result.ratios))
    found += ["I1's ratio to the others"] * (
        loose and not weak.any() and not seen.pure_spin
    )
    if seen.ambiguous and not seen.pure_spin:
        covariance, numbers = np.asarray(result.numbers_covariance), result.numbers
        units = np.asarray(unknowns.natural_units(numbers))
        weakest = weakest_of(unknowns.judged, covariance, units)[1] * units
        found.append(
            f"{_untold(result, weakest)}: others far from it are nearly as good"
        )
    of_state = np.asarray(seen.state_singular_values)
    count = (of_state < 1e-6 * of_state[:, :1]).sum(axis=-1).max()
    if options.depends_on_attitude and count:
        found.append(
            "heading about the vertical" if count == 1 else "attitude in space"
        )
    return tuple(dict.fromkeys(filter(None, found)))


def _diagonal(matrix: Any) -> np.ndarray:
    return np.maximum(np.diagonal(np.asarray(matrix)), 1e-300)


def _of_record(result: FitResult) -> list[tuple[Any, str]]:
    """What residuals, and values that repeat their largest one, would say, and if it is so."""
    seen, known = result.diagnostics, result.problem.options.noise_known
    by_trial = np.asarray(seen.chi_square_by_trial)
    size = max(math.sqrt(result.reduced_chi_square), float(np.max(seen.scales)))
    like, sure = seen.whiteness
    low, high = np.maximum(np.quantile(by_trial, [0.1, 0.9]), 1e-300)
    notes = [
        (known and size > 1.3, f"residuals are {size:.2g} times the stated noise"),
        (
            abs(like) > _LIKE and sure > _SURE,
            "residuals are not white: neighbours correlate by "
            f"{like:.2f}, {sure:.0f} standard deviations from none",
        ),
        (
            by_trial.size > 2 and high > 4 * low,
            f"trials differ: chi-square of nine tenths spreads by {high / low:.2g}",
        ),
    ]
    for x in result.unknowns.sought:
        if not x.own and x.sigma is not None:
            numbers = result.numbers[result.unknowns.slices[x.name]]
            far = float(jnp.max(jnp.abs(x.prior_rows(numbers))))
            text = (
                f"{x.name} is {far:.1f} standard deviations from what was known of it"
            )
            notes.append((far > 3, text))
    for sensor, values in zip(
        result.fitted()[1:], result.problem.samples.values, strict=True
    ):
        sizes, free = (
            np.abs(values),
            sensor.saturation() is None and not sensor.unit_length,
        )
        count = np.sum(sizes >= sizes.max() * (1 - 1e-9))
        text = f"{count} values of {type(sensor).__name__} are its largest: saturated? (`limit`)"
        notes.append((count > 3 and sizes.max() > 0 and free, text))
    return notes


def remarks(result: FitResult) -> tuple[str, ...]:
    """What to bear in mind."""
    notes, free_motion = _of_record(result), result.problem.options.free_motion
    covariance = np.asarray(result.moments_covariance)
    by_rates = not any(x.depends_on_attitude for x in result.fitted()[1:])
    if not isinstance(result.unknowns.inertia_model, Symmetric | Top | Fixed):
        ratios, moments = np.asarray(result.ratios), np.asarray(result.moments)
        loose = (np.asarray(result.ratios_errors) > 0.03 * ratios).any()
        notes.append(
            (loose, "the ratios are weakly constrained: errors of 3 % or more")
        )
        for i in (0, 1):
            (first, across), (_, second) = covariance[i : i + 2, i : i + 2]
            error = math.sqrt(max(first + second - 2 * across, 0.0))
            text = f"I{i + 1} and I{i + 2} are equal within their errors: which is the larger, and "
            text += "the axes of each, are not determined"
            notes.append((moments[i + 1] - moments[i] < 2 * error, text))
        least, middle, most = np.sort(np.asarray(result.mirror_moments, float))
        real, unit = least > 0 and most < least + middle, max(least, 1e-300)
        notes += [
            (
                by_rates and free_motion and real,
                "with one axis of the gyro reversed the same record is that of a body "
                f"with I2/I1 = {middle / unit:.4g}, I3/I1 = {most / unit:.4g}",
            ),
        ]
    return tuple(text for holds, text in notes if holds)


def _with_error(value: Any, error: Any) -> str:
    value, error = float(value), float(error)
    if not error > 1e-9 * abs(value):
        return f"{value:.6g}"
    if not error < 10 * max(abs(value), 1e-300):
        return f"{value:.3g} (not determined)"
    digits = 1 - math.floor(math.log10(error))
    if digits > 6 and abs(value) < 1e-3:
        return f"{value:.6g} +- {error:.2g}"
    digits = min(max(0, digits), 15)
    return f"{value:.{digits}f} +- {error:.{digits}f}"


def _with_errors(values: Any, errors: Any, between: str = ", ") -> str:
    return between.join(map(_with_error, np.ravel(values), np.ravel(errors)))


def _of_tensor(result: FitResult) -> list[str]:
    model = result.unknowns.inertia_model
    unit = (
        " kg m^2"
        if result.unknowns.scaled or model.absolute
        else " (trace as declared)"
    )
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
    level, times = np.asarray(result.level), np.asarray(result.correlation_time)
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
    part = 100 * np.sqrt(np.median(shares)) if own.size else 100
    lines = [
        f"  unmodelled torque {levels} N m s^1/2, {memory}; the sensors alone would "
        f"make {part:.0f} % of the errors"
    ]
    by_trial = np.asarray(result.level_by_trial)
    if np.any(by_trial != by_trial[0]):
        least, most = by_trial.min(), by_trial.max()
        lines.append(f"  its level in trials: {least:.2g} to {most:.2g} times that")
    return lines


def report(result: FitResult) -> str:
    """The fit in words."""
    if isinstance(result.chi_square, jax.core.Tracer):
        return "FitResult under a transformation"
    codes = dict(enumerate(names_of(Status)))
    value = np.asarray(result.status)
    if value.ndim:
        counts = {codes[code]: np.sum(value == code) for code in sorted(codes)}
        text = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
        return f"{value.size} fits: {text}"
    trials, steps = (
        result.state.omega.shape[0],
        np.sum(np.isfinite(result.diagnostics.history)),
    )
    seen = f"{np.sum(result.kept)} samples" + f" of {trials} trials" * (trials > 1)
    known = result.problem.options.noise_known
    left = None if known else jnp.sqrt(jnp.nanmean(result.residuals() ** 2))
    noise = "" if known else f" (noise taken from the residuals: {left:.3g} rms)"
    lines = [
        " ".join(
            filter(
                None, [f"{codes[int(value)]}: {Status[result.status]}", reason(result)]
            )
        ),
        f"  {seen}, {steps} steps; chi-square {result.chi_square:.1f} for "
        f"{result.degrees_of_freedom} degrees of freedom{noise}",
    ]
    spoilt = ", ".join(map(str, np.flatnonzero(result.rejected_trials)))
    lines += [f"  trials left out: {spoilt}"] * bool(spoilt)
    lines += (
        ["  ratios   not determined"]
        if result.diagnostics.pure_spin
        else _of_tensor(result)
    )
    lines += _of_torque(result)
    own = [x for x in result.unknowns.sought if x.own and x.base.ndim]
    each = {x.name for x in own if trials > 1}  # too many to print
    pairs = {name: pair for name, pair in result.estimates.items() if name not in each}
    lines += [f"  {name} = {_with_errors(*pair)}" for name, pair in pairs.items()]
    if trials == 1:
        omega = ", ".join(f"{x:.5g}" for x in np.asarray(result.state.omega)[0])
        lines.append(f"  rates at t = {result.t0[0]:.6g} s: ({omega}) rad/s")
    lines.append(
        "  not told by the record: " + ("; ".join(result.null_directions) or "nothing")
    )
    return "\n".join(lines + [f"  {note}" for note in remarks(result)])
