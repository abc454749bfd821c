"""A fit in words."""

import math
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from jrigid.identify._result import LARGEST_ERROR, FitResult, Status
from jrigid.identify._shapes import Fixed, Flat, Symmetric, Tensor, Top
from jrigid.identify._unknowns import AbstractSought

_NEARLY_A_SPHERE = 1.03  # degrees for radians shrink the gaps of the moments by 57
_FAINT = 0.02  # relative change of a tensor by a unit of one of its numbers: of a thickness
_AXES = ((1, 2), (2, 0), (0, 1))


def _of_shape(result: FitResult, direction: np.ndarray) -> str:
    """What a change of the shape's numbers does to the body."""
    unknowns, index = result.unknowns, result.index
    slope = jax.jvp(
        lambda x: unknowns.inertia(x, index), (result.numbers,), (jnp.asarray(direction),)
    )[1]
    axes, moments = np.asarray(result.axes), np.asarray(result.moments)
    inside = axes.T @ np.asarray(slope) @ axes
    if np.abs(inside).max() < _FAINT * moments.max():
        return "thickness"
    relative = np.diag(inside) / moments
    relative = relative - relative.mean()
    turns = np.array([inside[i, j] / moments.mean() for i, j in _AXES])
    if np.abs(turns).max() > np.abs(relative).max():
        i, j = sorted(_AXES[int(np.abs(turns).argmax())])
        return f"directions of the axes of I{i + 1} and I{j + 1}"
    gaps = np.sort(np.diff(moments))
    if gaps[0] < 0.1 * gaps[1]:  # of a symmetric body I3 is the odd one
        return "I3/I1"
    return f"I{int(np.abs(relative).argmax()) + 1}'s ratio to the others"


def _of_sought(result: FitResult, sought: AbstractSought, direction: np.ndarray) -> str:
    """What a change of an array's numbers is."""
    owner, _, name = sought.name.rpartition(".")
    text = f"{owner} {name}"
    if direction.size == 3 and name == "bias":
        axis = int(np.abs(np.asarray(result.axes).T @ direction).argmax())
        return f"{text} along the axis of I{axis + 1}"
    if owner.startswith("torque"):
        chosen = np.abs(direction) > 0.2 * np.abs(direction).max()
        return ", ".join(np.array(sought.names)[chosen])
    return text


def _untold(result: FitResult, direction: np.ndarray) -> str:
    """A direction of the numbers, in words, the largest part first."""
    unknowns, parts = result.unknowns, []
    named = {x.name: x for x in unknowns.sought}
    for name, s in unknowns.slices.items():
        size = float(np.sqrt(np.sum(direction[s] ** 2)))
        if s.stop == s.start or size < 0.2:
            continue
        if name == "scale":
            parts.append((size, "overall scale"))
        elif name in named:
            parts.append((size, _of_sought(result, named[name], direction[s])))
        elif unknowns.shapes[0].absolute:
            chosen = np.array(result.names[s])[np.abs(direction[s]) > 0.2]
            parts.append((size, ", ".join(chosen)))
        elif not bool(result.pure_spin):
            only = np.where(np.arange(direction.size) < s.stop, direction, 0.0)
            parts.append((size, _of_shape(result, only)))
    return " against ".join(text for _, text in sorted(parts, reverse=True))


def null_directions(result: FitResult) -> tuple[str, ...]:
    """What the record does not tell."""
    found, unknowns = [], result.unknowns
    absolute = any(x.absolute for x in unknowns.shapes)
    if not unknowns.scaled and not absolute:
        torque = not result.problem.options.free_motion and any(
            x.name.startswith("torque") for x in unknowns.sought
        )
        follow = ", which what is sought of the torque follows" if torque else ""
        if torque or result.problem.options.free_motion:
            found.append("overall scale" + follow)
    if bool(result.pure_spin):
        found.append("spin is pure: ratios not determined")
    noise = math.sqrt(float(result.inflation))
    values = np.asarray(result.singular_values)
    for value, direction in zip(values, np.asarray(result.directions).T, strict=True):
        if noise > LARGEST_ERROR * value:
            text = _untold(result, direction)
            found += [text] * bool(text and text not in found)
    smallest = "I1's ratio to the others"
    loose = any(np.any(x.ratios_errors > LARGEST_ERROR * x.ratios) for x in result.bodies)
    found += [smallest] * (loose and smallest not in found)
    if bool(result.doubtful):
        text = _untold(result, np.asarray(result.directions)[:, -1])
        found.append(f"{text}, which far from here is as good or nearly")
    of_state = np.asarray(result.state_singular_values)
    if result.problem.options.on_attitude and (of_state[..., -1] < 1e-6 * of_state[..., 0]).any():
        count = int((of_state < 1e-6 * of_state[..., :1]).sum(axis=-1).max())
        found.append("heading about the vertical" if count == 1 else "attitude in space")
    return tuple(found)


def _size(x: float) -> str:
    return f"{x:.2g}"


def _of_residuals(result: FitResult) -> list[str]:
    """How far what is left is from noise of the size stated."""
    found = []
    size = max(math.sqrt(float(result.reduced_chi_square)), float(np.max(result.scales)))
    if result.problem.options.noise_known and size > 1.3:
        found.append(f"residuals are {_size(size)} times the stated noise")
    like, sure = result.whiteness
    if abs(like) > 0.1 and sure > 5:
        found.append(
            f"residuals are not white: neighbours correlate by {like:.2f}, {sure:.0f} standard "
            "deviations from none"
        )
    by_throw = np.asarray(result.chi_square_by_throw)
    if by_throw.size > 2:
        spread = float(np.quantile(by_throw, 0.9) / max(np.quantile(by_throw, 0.1), 1e-300))
        if spread > 4:
            found.append(f"throws differ: chi-square of nine tenths spreads by {_size(spread)}")
    if by_throw.size >= 8 and result.numbers.size:
        clustered = np.diagonal(np.asarray(result.clustered_covariance))
        stated = np.diagonal(np.asarray(result.numbers_covariance))
        worst = math.sqrt(float(np.max(clustered / np.maximum(stated, 1e-300))))
        if worst > 1.6:
            found.append(
                f"throws scatter more than the errors say: by up to {_size(worst)} times "
                "(`clustered_covariance`)"
            )
    return found


def _of_priors(result: FitResult) -> list[str]:
    """What ended far from what was known of it beforehand."""
    found = []
    for x in result.unknowns.sought:
        if x.own or x.sigma is None:
            continue
        far = np.max(
            np.abs(np.asarray(x.prior_rows(result.numbers[result.unknowns.slices[x.name]])))
        )
        if far > 3:
            found.append(f"{x.name} is {far:.1f} standard deviations from what was known of it")
    return found


def _of_clipping(result: FitResult) -> list[str]:
    """Values that repeat their largest one, as a saturated sensor's do."""
    found = []
    sensors = result.parts()[1:]
    for sensor, values in zip(sensors, result.problem.samples.values, strict=True):
        values = np.asarray(values)
        largest = np.abs(values).max()
        count = int(np.sum(np.abs(values) >= largest * (1 - 1e-9)))
        if count > 3 and largest > 0 and sensor.largest() is None and not sensor.unit_length:
            name = type(sensor).__name__
            found.append(f"{count} values of {name} are its largest: saturated? (`limit`)")
    return found


def remarks(result: FitResult) -> tuple[str, ...]:
    """What to bear in mind."""
    found = _of_residuals(result) + _of_priors(result) + _of_clipping(result)
    if isinstance(result.unknowns.shapes[result.index], Symmetric | Top | Fixed):
        return tuple(found)
    ratios, errors = np.asarray(result.ratios), np.asarray(result.ratios_errors)
    if (errors > 0.03 * ratios).any():
        found.append("the ratios are weakly constrained: errors of 3 % or more")
    covariance, moments = np.asarray(result.moments_covariance), np.asarray(result.moments)
    for i, j in ((0, 1), (1, 2)):
        gap = moments[j] - moments[i]
        error = math.sqrt(max(covariance[i, i] + covariance[j, j] - 2 * covariance[i, j], 0.0))
        if gap < 2 * error:
            found.append(
                f"I{i + 1} and I{j + 1} are equal within their errors: which is the larger, and "
                "the axes of each, are not determined"
            )
    by_rates = not any(x.on_attitude for x in result.parts()[1:])
    if by_rates and ratios[1] < _NEARLY_A_SPHERE:
        found.append(
            "nearly a sphere: so would any body look whose rates are in degrees a second, or whose "
            "times are not in seconds"
        )
    mirror = np.sort(np.asarray(result.mirror))
    if (
        by_rates
        and result.problem.options.free_motion
        and mirror[0] > 0
        and mirror[2] < mirror[:2].sum()
    ):
        found.append(
            "with one axis of the gyro reversed the same record is that of a body with "
            f"I2/I1 = {mirror[1] / mirror[0]:.4g}, I3/I1 = {mirror[2] / mirror[0]:.4g}"
        )
    return tuple(found)


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


def _of_tensor(result: FitResult) -> list[str]:
    pairs = zip(np.asarray(result.ratios), np.asarray(result.ratios_errors), strict=True)
    lines = ["  ratios   I2/I1 = " + "   I3/I1 = ".join(_with_error(*pair) for pair in pairs)]
    shape = result.unknowns.shapes[result.index]
    unit = " kg m^2" if result.unknowns.scaled or shape.absolute else " (trace as declared)"
    errors = np.sqrt(np.diagonal(np.asarray(result.moments_covariance)))
    listed = zip(np.asarray(result.moments), errors, strict=True)
    lines.append("  moments  " + ", ".join(_with_error(*x) for x in listed) + unit)
    for i in range(3):
        axis = ", ".join(f"{x: .4f}" for x in np.asarray(result.axes)[:, i])
        lines.append(f"  axis of I{i + 1}  ({axis})")
    turns = [
        f"{np.degrees(float(e)):.2g}" if e < 1 else "not determined" for e in result.axes_errors
    ]
    if isinstance(shape, Tensor | Flat | Symmetric):
        lines.append(f"  errors of the axes, as turns about each [deg]: {', '.join(turns)}")
    return lines


def _of_level(result: FitResult) -> list[str]:
    """The unmodelled torque, and what of the errors it makes."""
    if result.problem.options.level == "none":
        return []
    pairs = list(zip(np.asarray(result.level), np.asarray(result.level_errors), strict=True))
    if result.problem.options.level != "estimate per axis":
        pairs = pairs[:1]
    level = ", ".join(
        _with_error(*x) if x[0] > 0 else f"0 (of {_size(float(x[1]))} nothing would be seen)"
        for x in pairs
    )
    own, whole = (np.diagonal(np.asarray(x)) for x in
                  (result.sensor_covariance, result.numbers_covariance))  # fmt: skip
    part = 100 * math.sqrt(float(np.median(own / np.maximum(whole, 1e-300)))) if own.size else 100
    return [
        f"  unmodelled torque {level} N m s^1/2; the sensors alone would make {part:.0f} % of the "
        "errors"
    ]


def report(result: FitResult) -> str:
    """The fit in words."""
    if isinstance(result.chi_square, jax.core.Tracer):
        return "FitResult under a transformation"
    names = [x for x in dir(Status) if x.isupper()]
    codes = {int(getattr(Status, name)._value): name for name in names}
    value = np.asarray(result.status._value)
    if value.ndim:
        counts = {name: int(np.sum(value == code)) for code, name in sorted(codes.items())}
        text = ", ".join(f"{n} {name}" for name, n in counts.items() if n)
        return f"{value.size} fits: {text}"
    lines = [f"{codes[int(value)]}: {Status[result.status]}"]
    kept = int(np.sum(result.kept))
    throws = result.state.omega.shape[0]
    seen = f"{kept} samples" + (f" of {throws} throws" if throws > 1 else "")
    steps = int(np.sum(np.isfinite(result.history)))
    freedom, noise = int(result.degrees_of_freedom), " (noise taken from the residuals)"
    lines.append(
        f"  {seen}, {steps} steps; chi-square {float(result.chi_square):.1f} for {freedom} degrees "
        "of freedom" + noise * (not result.problem.options.noise_known)
    )
    spoilt = np.flatnonzero(np.asarray(result.spoilt))
    if spoilt.size:
        lines.append("  throws left out: " + ", ".join(str(i) for i in spoilt))
    several = len(result.unknowns.shapes) > 1
    for i, body in enumerate(result.bodies):
        lines += [f"  body {i}"] * several
        lines += ["  ratios   not determined"] if bool(result.pure_spin) else _of_tensor(body)
    lines += _of_level(result)
    for name, (value, error) in result.leaves.items():
        if np.shape(value)[:1] == (throws,) and throws > 1 and np.ndim(value) > 1:
            continue
        pairs = zip(np.ravel(value), np.ravel(error), strict=True)
        lines.append(f"  {name} = " + ", ".join(_with_error(v, e) for v, e in pairs))
    if throws == 1:
        omega = ", ".join(f"{x:.5g}" for x in np.asarray(result.state.omega)[0])
        lines.append(f"  rates at t = {float(result.t0[0]):.6g} s: ({omega}) rad/s")
    untold = result.null_directions
    lines.append("  not told by the record: " + ("; ".join(untold) if untold else "nothing"))
    return "\n".join(lines + [f"  {note}" for note in remarks(result)])
