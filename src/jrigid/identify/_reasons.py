"""Reasons why a fit does not describe its record, and what to pass instead.

One sentence for the first line of a report: a unit, a noise, an error of the sensor
that is not sought, or something that swings.
"""

import math

import numpy as np
from numpy.polynomial import polynomial

from jrigid._checks import RESULTS
from jrigid.identify import _conventions as conventions
from jrigid.identify._colour import FEWEST, stands_out
from jrigid.identify._gyro_errors import GyroErrors
from jrigid.identify._inertia_models import AbstractInertiaModel, Flat, Moments, Tensor
from jrigid.identify._levels import FEWEST_TRIALS, MOST_FOREIGN
from jrigid.identify._quality import GATE
from jrigid.identify._resolution import UNRESOLVED
from jrigid.identify._result import FitResult, Status
from jrigid.identify._sensors import (
    AbstractSensor,
    AttitudeSensor,
    Gyro,
    Magnetometer,
)

# I3/I1: degrees for radians shrink the gaps of the moments by a factor of 57.
_NEARLY_A_SPHERE = 1.03
# Radians of a swing while the body turns by one: no free body does that.
_TOO_FAST = 3.0
_LOUD = 0.2  # part of the power that a swing has at its frequency
# Degree of the polynomial that the rates of a body follow while it turns by 2 radians,
# and part of their square that it may leave.
_TREND = 2
_NO_TREND = 0.03
# Difference of chi-square within which two errors of a gyro explain about as much.
_ABOUT_AS_MUCH = 16.0
_OTHER_FIELD = 1.5  # times the size of a field: readings that are not of it
_MUCH_LEFT = 0.05  # of the square of a record, by a fit that follows it
CORRELATED = 0.1  # correlation of neighbours
SURELY_CORRELATED = 5.0  # standard deviations of that
# Trials with so many times the chi-square of the others may be of another body.
_FAR_ABOVE_OTHERS = 5.0
# Readings at the largest value of an axis that show a limit: so many, and so many times
# as many as at the next value, since coarse readings repeat theirs.
_AT_LIMIT = 8
_MORE_THAN_NEXT = 5


def reason(result: FitResult) -> str:
    """The sentences about a single fit, or an empty text without any."""
    sentences = [_reason(result), _of_clocks(result)]
    if result.numbers.dtype == np.float32 and result.status == Status.MISFIT:
        sentences.append(
            "It was computed in float32, whose rounding may be more than the noise: "
            'try `jax.config.update("jax_enable_x64", True)`.'
        )
    return " ".join(filter(None, sentences))


def _reason(result: FitResult) -> str:
    """The first reason why a fit does not describe its record."""
    if result.status == Status.BAD_INPUT:
        return (
            f"{RESULTS[result.diagnostics.input_result]} The error that a fit raises "
            "by default says which argument it is."
        )
    if _lacks_predictions(result):
        return (
            "Predictions are not finite at the initial values: `predict` of each "
            "sensor must be finite wherever there is a reading, and `simulate` from "
            "`start`."
        )
    of_conventions = conventions.in_words(np.asarray(result.diagnostics.conventions))
    if of_conventions:
        return of_conventions
    if result.diagnostics.integration_error > UNRESOLVED:
        return (
            "The torque changes too fast for the steps of a fit. Pass its mean over a "
            "step, or a motion of your own (`motion`, and `start`)."
        )
    if _is_at_rest(result):
        # A noise that is far too large hides any motion.
        return _of_noise(result) or (
            "The body does not turn: the readings are no larger than their noise. "
            "Inertia shows in rates that change."
        )
    if _failed(result) and _is_steady(result):
        return (
            "The rates do not change by more than their noise: those of a spin about "
            "one axis, or of a sphere, say nothing of the inertia."
        )
    swing = 0.0 if result.status == Status.OK else _swing(result)
    if swing > _TOO_FAST:
        return (
            f"The rates swing {swing:.2g} times as fast as the body turns, which no "
            "body does: they are too small. Pass them in rad/s (were they converted "
            "twice, or times not in seconds?)."
        )
    if _is_nearly_a_sphere(result):
        return (
            "Nearly a sphere: so looks any body whose rates are in degrees a second, "
            "or whose times are not in seconds. Multiply rates in deg/s by pi / 180."
        )
    if result.status == Status.OK:
        sentences = [_of_parameters(result), _of_innovations(result)]
        return " ".join(filter(None, sentences))
    if result.status == Status.UNIDENTIFIABLE and _may_turn_the_other_way(result):
        return (
            "Attitudes at equal intervals are also those of a body that turns the "
            "other way round between them. Pass `start` with a state: it says which."
        )
    if not np.all(np.isfinite(np.asarray([result.level, result.level_errors]))):
        return (
            "The level of the unmodelled torque has no bound or no error: the record "
            "does not tell it from noise. Pass `sigma`, or the torque (`unmodelled`)."
        )
    return (
        _of_limit(result)
        or _of_field(result)
        or _of_gyro(result)
        or " ".join(
            filter(None, [_of_scale(result), _of_noise(result), _of_minimum(result)])
        )
    )


def _failed(result: FitResult) -> bool:
    """Whether the fit does not follow the record."""
    return result.status in (Status.WRONG_BASIN, Status.NOT_CONVERGED)


def _readings_of(result: FitResult) -> list[tuple[AbstractSensor, np.ndarray]]:
    """Each sensor as it was found, and the values that were seen (n, width)."""
    samples = result.problem.samples
    is_seen = np.asarray(samples.seen)
    return [
        (sensor, np.asarray(values)[is_seen[:, part]])
        for sensor, values, part in zip(
            result.fitted()[1:], samples.values, samples.parts, strict=True
        )
    ]


def _of_clocks(result: FitResult) -> str:
    """A sentence about records of one motion that have no time in common."""
    samples = result.problem.samples
    for ts, is_seen in zip(
        np.asarray(samples.ts), np.asarray(samples.seen), strict=True
    ):
        times = [ts[part][is_seen[part]] for part in samples.parts]
        spans = [(np.min(x), np.max(x)) for x in times if x.size]
        latest_start = max((first for first, _ in spans), default=0.0)
        earliest_end = min((last for _, last in spans), default=0.0)
        if latest_start > earliest_end:
            return (
                "Two records of the motion have no time in common: one ends "
                f"{latest_start - earliest_end:.3g} s before the other begins. Their "
                "times must be those of one clock."
            )
    return ""


def _of_field(result: FitResult) -> str:
    """Describe a magnetometer whose field has another size than the readings."""
    is_biased = any("magnetometer.bias" in x.name for x in result.unknowns.sought)
    for sensor, values in _readings_of(result):
        if not isinstance(sensor, Magnetometer) or is_biased:
            continue
        read = np.median(np.linalg.norm(values, axis=-1))
        size = np.linalg.norm(np.asarray(sensor.field))
        if not 1 / _OTHER_FIELD < read / max(size, 1e-300) < _OTHER_FIELD:
            return (
                f"The readings of the magnetometer have a size of {read:.3g}, and its "
                f"field one of {size:.3g}: they must be in one unit."
            )
    return ""


def _of_scale(result: FitResult) -> str:
    """A sentence about a tensor whose trace was held beside a torque of known size."""
    options = result.problem.options
    unknowns = result.unknowns
    if result.status == Status.OK or options.free_motion:
        return ""
    if unknowns.has_scale or unknowns.seeks_torque:
        return ""
    return (
        "The trace of the tensor is held at that of the body which was given. If it "
        'is not known, but the torque is, pass `scale="known"`.'
    )


def _of_minimum(result: FitResult) -> str:
    """Advice where the search may have ended in a wrong minimum."""
    is_misfit = result.status == Status.MISFIT
    unexplained = float(result.diagnostics.unexplained)
    sentences = []
    if is_misfit and unexplained > _MUCH_LEFT:
        sentences.append(
            f"A part of {unexplained:.2g} of the square of the record is left: the "
            "search may have ended in a wrong minimum."
        )
    # Where rates or attitudes are read, they show where the search begins.
    is_seen = any(isinstance(x, Gyro | AttitudeSensor) for x in result.fitted()[1:])
    if (_failed(result) or is_misfit) and not is_seen:
        sentences.append(
            "No sensor reads rates or attitudes, so that the search depends on where "
            "it begins: pass a tensor and a state (`start`), or first fit a part of "
            "the record in which the body turns a few times."
        )
    return " ".join(sentences)


def _may_turn_the_other_way(result: FitResult) -> bool:
    """Whether attitudes alone were observed, and other bodies describe them as well."""
    sensors = result.fitted()[1:]
    alone = all(isinstance(x, AttitudeSensor) for x in sensors)
    return alone and bool(result.diagnostics.ambiguous)


def _of_gyro(result: FitResult) -> str:
    """The error of a gyro that explains most, or an empty text without one.

    Those that explain the residuals about as well follow.
    """
    errors = GyroErrors()._asdict()
    for name, error in errors.items():
        value, deviations = getattr(result.diagnostics, name)
        sought = error._replace(value=np.asarray(value), deviations=float(deviations))
        errors[name] = sought
    freedom = float(result.degrees_of_freedom)
    named = GyroErrors(**errors).named(_chi_square(result), freedom)
    if not named:
        return ""
    most = max(error.gained for error in named.values())
    sentences = [
        _of_gyro_error(name, error.value)
        for name, error in named.items()
        if error.gained > most - _ABOUT_AS_MUCH
    ]
    if len(sentences) > 1:
        sentences.append("The record hardly tells which of them it is.")
    return " ".join(sentences)


def _of_limit(result: FitResult) -> str:
    """The limit at which readings of a gyro stand, or an empty text without one."""
    for sensor, values in _readings_of(result):
        if not isinstance(sensor, Gyro) or sensor.saturation() is not None:
            continue
        for sizes in np.abs(values).T:
            # An axis that reads nothing says nothing.
            levels, counts = np.unique(np.append(sizes, 0.0), return_counts=True)
            at_next, at_last = np.append(0, counts)[-2:]
            is_zero = levels[-1] == 0
            few = at_last < max(_AT_LIMIT, _MORE_THAN_NEXT * at_next)
            if not (is_zero or few):
                return (
                    f"{at_last} readings of an axis stand at its largest value, "
                    f"{levels[-1]:.6g} rad/s: the gyro saturates there. Pass it "
                    "(`Gyro(limit=...)`)."
                )
    return ""


def _of_gyro_error(name: str, value: np.ndarray) -> str:
    """The sentence about an error in a field of `GyroErrors`."""
    numbers = ", ".join(f"{x:.2g}" for x in np.atleast_1d(value))
    if name == "lag":
        return (
            f"A low-pass filter of the gyro with a time constant of some {numbers} s "
            "would explain the residuals: pass it (`Gyro(time_constant=...)`), or seek "
            "it (`free`)."
        )
    if name == "delay":
        return (
            f"A delay of the gyro by some {numbers} s, after the other sensors, would "
            "explain most of the residuals: pass it (`Gyro(delay=...)`), or seek it "
            "(`free`). A low-pass filter delays by its time constant."
        )
    if name == "gain":
        return (
            f"A scale of the gyro that is {float(value):.4g} times as large would "
            "explain the residuals: pass it (`Gyro(scale=...)`), or seek it (`free`)."
        )
    return (
        f"A bias of the gyro, some ({numbers}) rad/s, would explain most of what is "
        "left: seek it (`free`), by `free=lambda body, gyro: gyro.bias`."
    )


def _lacks_predictions(result: FitResult) -> bool:
    """Whether predictions were finite nowhere."""
    searched = np.any(np.isfinite(np.asarray(result.diagnostics.history)))
    # A plan makes no search, and is NOT_CONVERGED only where it has no predictions.
    return bool(result.status == Status.NOT_CONVERGED) and not searched


def _by_gyro(result: FitResult) -> bool:
    """Whether nothing but a gyro was read, and the inertia is not known beforehand."""
    sensors = result.fitted()[1:]
    inertia_model: AbstractInertiaModel = result.unknowns.inertia_model
    return all(isinstance(x, Gyro) for x in sensors) and isinstance(
        inertia_model, Tensor | Moments | Flat
    )


def _is_nearly_a_sphere(result: FitResult) -> bool:
    free = result.problem.options.free_motion
    return bool(free and _by_gyro(result) and result.ratios[1] < _NEARLY_A_SPHERE)


def _is_at_rest(result: FitResult) -> bool:
    """Whether the noise and the bias of the gyro explain its readings."""
    if not (_by_gyro(result) and result.problem.options.noise_known):
        return False
    return _is_noise(result, np.asarray(result.fitted()[1].bias))


def _is_steady(result: FitResult) -> bool:
    """Whether the readings of a gyro are constant in each trial but for their noise."""
    if not (_by_gyro(result) and result.problem.options.noise_known):
        return False
    part = result.problem.samples.parts[0]
    is_seen = np.asarray(result.problem.samples.seen)[:, part, None]
    rates = np.where(is_seen, np.asarray(result.problem.samples.values[0]), 0.0)
    count = np.maximum(np.sum(is_seen, axis=1, keepdims=True), 1)
    return _is_noise(result, np.sum(rates, axis=1, keepdims=True) / count)


def _is_noise(result: FitResult, rates: np.ndarray) -> bool:
    """Whether the readings of a gyro differ from some rates by their noise alone."""
    samples = result.problem.samples
    part = samples.parts[0]
    is_seen = np.asarray(samples.seen)[:, part]
    whitener = np.asarray(samples.whitener)[:, part, :, :3][is_seen]
    errors = (np.asarray(samples.values[0]) - rates)[is_seen]
    errors = np.einsum("nij,nj->ni", whitener, errors)
    # The mean square of white errors scatters by sqrt(2 / n).
    return bool(np.mean(errors**2) < 1 + GATE * math.sqrt(2 / errors.size))


def _of_parameters(result: FitResult) -> str:
    """Name the arrays beside the inertia that are not determined."""
    verdicts = result.determined.items()
    names = [name for name, is_determined in verdicts if not is_determined]
    return f"It does not determine {', '.join(names)}." if names else ""


def _of_innovations(result: FitResult) -> str:
    """A sentence about an estimated torque that stands for noise of the sensor.

    Noise changes its sign from reading to reading, which no torque does.
    """
    like, deviations = result.diagnostics.whiteness
    if like > -CORRELATED or deviations < SURELY_CORRELATED:
        return ""
    if not (result.problem.options.dense and result.problem.options.noise_known):
        return ""
    return (
        f"The innovations of neighbours correlate by {like:.2f}, as if noise of the "
        "sensor were taken for a torque: `sigma` is too small. Pass the noise of the "
        "sensor, or none."
    )


def _chi_square(result: FitResult) -> float:
    """Chi-square in units of the noise; an unknown noise is that of the residuals."""
    known = result.problem.options.noise_known
    return float(result.chi_square if known else result.degrees_of_freedom)


def _swing(result: FitResult) -> float:
    """Rate of the largest swing of the readings over their rms.

    Of a free body it is at most about 1.
    """
    if not (result.problem.options.free_motion and _by_gyro(result)):
        return 0.0
    samples = result.problem.samples
    part = samples.parts[0]
    is_seen = np.asarray(samples.seen)[:, part]
    trial = int(np.argmax(np.sum(is_seen, axis=1)))
    ts = np.asarray(samples.ts)[trial, part][is_seen[trial]]
    rates = np.asarray(samples.values[0])[trial][is_seen[trial]]
    if ts.size < FEWEST:
        return 0.0
    power = _spectrum(rates - rates.mean(axis=0))
    peak = int(np.argmax(power))
    # The trend of a short record would look like one period as long as the record.
    at = np.linspace(-1, 1, ts.size)
    trend = polynomial.polyval(at, polynomial.polyfit(at, rates, _TREND)).T
    rest = _spectrum(rates - trend)
    if np.sum(rest) < _NO_TREND * np.sum(power):
        return 0.0
    # In noise, about a constant rate or a trend, no frequency stands out.
    if any(np.max(x) < _LOUD * np.sum(x) for x in (power, rest)):
        return 0.0
    # n samples stand for n steps, one more than lie between the first and the last. A
    # gap in the samples matters little beside a factor of 57.
    duration = float(ts[-1] - ts[0]) * ts.size / (ts.size - 1)
    size = math.sqrt(np.mean(np.sum(rates**2, axis=1)))
    return 2 * math.pi * peak / duration / size if size > 0 and duration > 0 else 0.0


def _spectrum(rates: np.ndarray) -> np.ndarray:
    """Power of rates (n, 3) at each frequency."""
    return np.sum(np.abs(np.fft.rfft(rates, axis=0)) ** 2, axis=1)


def _of_trials(result: FitResult) -> str:
    """A sentence about a few trials with far larger residuals than the others."""
    by_trial = np.asarray(result.diagnostics.chi_square_by_trial, float)
    takes_part = ~np.asarray(result.rejected_trials)
    if np.sum(takes_part) < FEWEST_TRIALS:
        return ""
    usual = float(np.median(by_trial[takes_part]))
    large = takes_part & (by_trial > _FAR_ABOVE_OTHERS * usual)
    if not 0 < np.sum(large) <= MOST_FOREIGN * by_trial.size:
        return ""
    least = float(np.min(by_trial[large])) / usual
    names = ", ".join(map(str, np.flatnonzero(large)))
    advice = '`loss="robust"` leaves such trials out.'
    if result.problem.options.robust:
        advice = "Fit the others without them."
    return (
        f"Chi-square of trial {names} (from 0) is {least:.2g} times that of the "
        f"others: it may be of another body. {advice}"
    )


def _of_noise(result: FitResult) -> str:
    """Explain residuals that are not of the stated size, or that are coloured."""
    if not result.problem.options.noise_known:
        return ""
    square = float(result.reduced_chi_square)
    # The mean square of n white residuals scatters by sqrt(2 / n).
    chance = GATE * math.sqrt(2 / max(int(result.degrees_of_freedom), 1))
    residuals = f"The residuals are {math.sqrt(square):.3g} times the stated noise"
    # A plan has no residuals.
    if 0 < square < 1 - chance:
        return f"{residuals}: {_too_large(result)}"
    band, sure = (float(x) for x in result.diagnostics.loudest_band)
    like, deviations = result.diagnostics.whiteness
    is_coloured = like > CORRELATED and deviations > SURELY_CORRELATED
    has_band = stands_out(band, sure)
    is_large = square > 1 + chance
    if _failed(result):
        # Residuals of a wrong minimum have a colour, which says nothing of the record.
        is_white = not (is_coloured or has_band)
        too_small = f"{residuals}, and white: {_too_small(result)}"
        return too_small if is_white and is_large else ""
    if result.status != Status.MISFIT:
        return ""
    of_trials = _of_trials(result)
    if of_trials:
        return of_trials
    if has_band:
        return (
            f"The residuals have {band:.2g} times their mean power in one band of "
            "frequencies: something that changes slowly, or swings, is missing. See "
            "`unmodelled` and `free`."
        )
    if is_coloured:
        return (
            f"{residuals}, and neighbours correlate by {like:.2f}: see `unmodelled` "
            "and `free`."
        )
    if is_large:
        return f"{residuals}, and white: {_too_small(result)}"
    if len(result.kept) == 1:
        return ""
    return (
        "Trials differ by more than their errors say: they may be of different bodies."
    )


def _too_large(result: FitResult) -> str:
    """Advice on what to pass instead of a noise that is too large."""
    degrees = ""
    # The noise in radians over the same noise in degrees is pi / 180 = 0.017.
    if 0.01 < math.sqrt(result.reduced_chi_square) < 0.03:
        degrees = " (it is 57 times too large if it is in degrees)"
    unit = "in the unit of the readings"
    if all(isinstance(x, Gyro) for x in result.fitted()[1:]):
        unit = "in rad/s"
    return f"`sigma` is too large{degrees}. Pass the noise of the sensor {unit}."


def _too_small(result: FitResult) -> str:
    """Advice on what to pass instead of a noise that is too small."""
    otherwise = ", or `absolute_sigma=False`"
    if result.problem.priors(len(result.kept)):
        # A noise that is only relative cannot be weighed against what is known.
        otherwise = ""
    return f"`sigma` is too small. Pass the noise of the sensor{otherwise}."
