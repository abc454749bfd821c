"""A fit in words."""

import math
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from jrigid.identify._observations import Rates
from jrigid.identify._result import LARGEST_ERROR, STATUSES, FitResult, Status

_NEARLY_A_SPHERE = 1.03  # degrees for radians shrink the gaps of the moments by 57
_SPEAKING = {
    "scale": "overall scale",
    "gyro_bias": "gyro bias",
    "gyro_scale": "gyro scale",
    "gyro_scales": "gyro scale factors",
    "gyro_misalignment": "gyro misalignment",
    "gyro_matrix": "gyro matrix",
}


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


def null_directions(result: FitResult) -> tuple[str, ...]:
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
            if name == "leaves" or (name == "shape" and result.unknowns.ten is not None):
                names = np.array(result.names[s])[np.abs(direction[s]) > 0.2]
                parts.append((size, ", ".join(names)))
            elif name == "shape":
                only = np.zeros_like(direction)
                only[s] = direction[s]
                told = "ratios" if pure else _of_shape(result, only)
                parts.append((size, told))
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
    observed = any(isinstance(x, Rates) for x in result.problem.observations)
    if observed and ratios[1] < _NEARLY_A_SPHERE:
        found.append(
            "nearly a sphere: so would any body look whose rates are in degrees a second, or whose "
            "times are not in seconds"
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


def _of_tensor(result: FitResult, moments: np.ndarray, errors: np.ndarray) -> list[str]:
    pairs = zip(np.asarray(result.ratios), np.asarray(result.ratios_errors), strict=True)
    lines = ["  ratios   I2/I1 = " + "   I3/I1 = ".join(_with_error(*pair) for pair in pairs)]
    scaled = result.unknowns.scaled or result.unknowns.ten is not None
    unit = " kg m^2" if scaled else " (trace as declared)"
    listed = [_with_error(v, e) for v, e in zip(moments, errors, strict=True)]
    lines.append("  moments  " + ", ".join(listed) + unit)
    for i in range(3):
        axis = ", ".join(f"{x: .4f}" for x in np.asarray(result.axes)[:, i])
        lines.append(f"  axis of I{i + 1}  ({axis})")
    turns = [
        f"{np.degrees(float(e)):.2g}" if e < 1 else "not determined" for e in result.axes_errors
    ]
    if result.unknowns.shape in ("tensor", "flat", "symmetric"):
        lines.append(f"  errors of the axes, as turns about each [deg]: {', '.join(turns)}")
    return lines + [f"  {note}" for note in remarks(result)]


def report(result: FitResult) -> str:
    """The fit in words."""
    status = result.status
    if jnp.ndim(status._value) or isinstance(result.chi_square, jax.core.Tracer):
        if isinstance(result.chi_square, jax.core.Tracer):
            return "FitResult under a transformation"
        codes = np.asarray(status._value).reshape(-1)
        counts = {
            name: int(np.sum(codes == int(getattr(Status, name)._value))) for name in STATUSES
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
    steps = int(np.sum(np.isfinite(result.history)))
    chi_square, freedom = float(result.chi_square), int(result.degrees_of_freedom)
    noise = "" if result.noise_known else " (noise taken from the residuals)"
    lines.append(
        f"  {seen}, {steps} steps; chi-square {chi_square:.1f} for {freedom} degrees of freedom"
        + noise
    )
    spoilt = np.flatnonzero(np.asarray(result.spoilt))
    if spoilt.size:
        lines.append("  throws left out: " + ", ".join(str(i) for i in spoilt))
    if bool(result.pure_spin):
        lines.append("  ratios   not determined")
    else:
        lines.extend(_of_tensor(result, moments, errors))
    for title, group in (("", result.leaves), ("", result.nuisances)):
        for label, (value, error) in group.items():
            pairs = zip(np.atleast_1d(value), np.atleast_1d(error), strict=True)
            lines.append(f"  {title}{label} = " + ", ".join(_with_error(v, e) for v, e in pairs))
    if result.state.omega.shape[0] == 1:
        omega = ", ".join(f"{x:.5g}" for x in np.asarray(result.state.omega)[0])
        lines.append(f"  rates at t = {float(result.t0[0]):.6g} s: ({omega}) rad/s")
    untold = result.null_directions
    lines.append("  not told by the record: " + ("; ".join(untold) if untold else "nothing"))
    if "gyro_handedness" in result.unknowns.nuisances:
        mirror = np.asarray(result.mirror)
        lines.append(
            "  mirror body, moments about the same axes: " + ", ".join(f"{x:.5g}" for x in mirror)
        )
    return "\n".join(lines)
