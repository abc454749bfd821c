"""Input validation of a fit: options at trace time, values at run time."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from jrigid._checks import (
    INERTIA,
    RESULTS,
    Findings,
    all_finite,
    array_of_shape,
    check_option,
    demand,
    is_good,
    is_inertia,
    is_unit,
    settle,
)
from jrigid._core.compile import small_program
from jrigid._numerics import as_tensor, or_one, rms, without_gradient
from jrigid._types import AnyArray
from jrigid.dynamics import State
from jrigid.identify._inertia_models import AbstractInertiaModel
from jrigid.identify._readings import DirectReadings
from jrigid.identify._records import Record, Samples, check_records, tells
from jrigid.identify._sensors import MomentumSensor
from jrigid.systems import RigidBody
from jrigid.torques import GravityGradient, Rotor, Sampled, SpinningMass, Sum

GUESS = 0.02  # of the size of values, for a noise that is not known


def systems_of(system: Any, trials: int) -> tuple[RigidBody, ...]:
    """One body, or one for each trial."""
    systems = tuple(system) if isinstance(system, Sequence) else (system,)
    for x in systems:
        demand(
            isinstance(x, RigidBody),
            "Argument `system` must be a RigidBody (of a body in flight, rotation "
            f"about its centre of mass), but it is {type(x).__name__}.",
        )
    demand(
        len(systems) in (1, trials),
        f"Argument `system` must hold one body for each of {trials} trials, but it "
        f"holds {len(systems)}.",
    )
    # The arrays of trials are stacked, for which they need one length. Bodies of
    # different kinds are refused by `_arrays_of`.
    alike = len(set(map(jtu.tree_structure, systems))) == 1
    return _padded(systems) if alike and len(systems) > 1 else systems


def _padded(systems: tuple[RigidBody, ...]) -> tuple[RigidBody, ...]:
    """The systems, with samples padded to one length where those of trials differ."""

    def is_sampled(x: object) -> bool:
        return isinstance(x, Sampled)

    leaves, trees = zip(
        *(jtu.tree_flatten(x, is_leaf=is_sampled) for x in systems), strict=True
    )

    def alike(*column: Any) -> list[Any]:
        counts = [x.ts.size if is_sampled(x) else 0 for x in column]
        return [
            _longer(x, max(counts) - n) for x, n in zip(column, counts, strict=True)
        ]

    columns = map(alike, *leaves)
    return tuple(map(jtu.tree_unflatten, trees, zip(*columns, strict=True)))


def _longer(function: Any, count: int) -> Any:
    """The same function, with its last sample repeated so many times."""
    if not count:
        return function

    def longer(x: Array) -> Array:
        return jnp.concatenate([x, jnp.repeat(x[-1:], count, axis=0)])

    return eqx.tree_at(lambda x: (x.ts, x.values), function, replace_fn=longer)


def start_of(start: Any, trials: int) -> tuple[Any, State | None, Any]:
    """The tensor to start from, the state of each trial and that of internal parts.

    Each is None if it is not given.
    """
    inertia, state = (
        start if isinstance(start, tuple) and len(start) == 2 else (None, start)
    )
    inertia = inertia.inertia if isinstance(inertia, RigidBody) else inertia
    demand(
        state is None or isinstance(state, State),
        "Argument `start` must be a State, or a tuple of an inertia and a State "
        f"(either may be None), but it is {start!r}.",
    )
    internal = None
    if isinstance(state, State):
        internal = state.internal
        attitude = jnp.broadcast_to(state.attitude, (trials, 4))
        state = State(attitude, jnp.broadcast_to(state.omega, (trials, 3)))
    tensor = None
    if inertia is not None:
        tensor = as_tensor(array_of_shape("start", inertia, *INERTIA))
    # pyright does not know that `demand` has refused what is not a State.
    return tensor, state, internal  # pyright: ignore[reportReturnType]


def refuse(
    system: RigidBody,
    records: Sequence[Record],
    scale: str,
    inertia_model: AbstractInertiaModel,
) -> None:
    """Raise ValueError for a scale that nothing sets, or that is set twice."""
    check_option("scale", scale, ("trace", "known", "rotor"))
    demand(
        # `Fixed` is absolute too, but has no numbers, so that no scale is sought.
        not (inertia_model.absolute and inertia_model.names and scale == "trace"),
        "Argument `scale` must be 'known' or 'rotor' where `inertia_model` is a "
        f"{type(inertia_model).__name__}, whose numbers hold the scale, but it is "
        "'trace'.",
    )
    terms = system.torque.terms if isinstance(system.torque, Sum) else (system.torque,)
    has_rotor = any(isinstance(x, Rotor | SpinningMass) for x in terms)
    demand(
        scale != "trace" or not has_rotor or inertia_model.absolute,
        "Argument `scale` must be 'rotor' for a system with a `Rotor` or a "
        "`SpinningMass`, whose momentum sets the scale of the tensor, but it is "
        "'trace', which would keep the trace of `system`.",
    )
    demand(
        scale != "rotor" or has_rotor,
        "Argument `scale` must not be 'rotor' for a system without a `Rotor` or a "
        "`SpinningMass`, but it is: nothing sets the scale of the tensor.",
    )
    momenta = any(isinstance(x.sensor, MomentumSensor) for x in records)
    demand(
        scale != "known" or not system.is_free or momenta or inertia_model.absolute,
        "Argument `scale` must be 'trace' for a body without torque, but it is "
        "'known': free motion tells ratios of the moments, never their scale.",
    )
    in_proportion = all(isinstance(x, GravityGradient) for x in terms)
    demand(
        scale != "known" or not (terms and in_proportion) or momenta,
        "Argument `scale` must be 'trace' where `GravityGradient` is the only torque, "
        "but it is 'known': in proportion to the inertia, it tells ratios of the "
        "moments, never their scale.",
    )


def typical_rate(
    readings: DirectReadings | None, state: State | None, dtype: Any
) -> AnyArray:
    """Rms of the rates, 1 where there are none."""
    if readings is not None:
        return rms(readings.omega, readings.valid)
    assert state is not None
    # This is a natural unit, whose choice must not change the derivatives of a plan.
    omega = without_gradient(state.omega.astype(dtype))
    xp = omega.__array_namespace__()
    return rms(omega, xp.ones(omega.shape[:-1], bool))


def sizes_of(samples: Samples) -> tuple[AnyArray, ...]:
    """Rms of the values of each record; 1 where they are zero."""
    pairs = zip(samples.values, samples.parts, strict=True)
    return tuple(rms(values, samples.seen[:, part]) for values, part in pairs)


def noise_of(
    records: tuple[Record, ...], samples: Samples, rate: AnyArray
) -> np.ndarray:
    """Noise of rates [rad/s] and of turns [rad], (6,), as far as records state it."""
    white = np.diagonal(samples.whitener, axis1=-2, axis2=-1)
    # For independent components the diagonal of the whitener is 1 / sigma.
    sigma = np.where(samples.weight > 0, 1 / or_one(white), np.nan)
    pairs = [
        (x, _median(sigma[:, y])) for x, y in zip(records, samples.parts, strict=True)
    ]
    rates = [median for x, median in pairs if tells(x, "rates")]
    angles = [median for x, median in pairs if x.sensor.unit_length]
    # Without attitudes the noise of a turn is that of a rate over the time of one
    # radian.
    angle = [*angles, *(x / rate for x in rates), GUESS][0]
    # Without rates the noise of one is that of a turn over the same time.
    noise = np.repeat([[*rates, angle * rate][0], angle], 3).astype(sigma.dtype)
    return np.where(np.isfinite(noise), noise, GUESS * rate)


def _median(x: np.ndarray) -> np.floating:
    """Median of the numbers that are not NaN; NaN where there are none."""
    known = x[~np.isnan(x)]
    return np.median(known) if known.size else x.dtype.type(np.nan)


@small_program
def result_of_start(
    systems: tuple[RigidBody, ...], tensor: Any, state: State | None
) -> Any:
    """The result code of `findings_of_start`."""
    return findings_of_start(systems, tensor, state).result


def findings_of_start(
    systems: tuple[RigidBody, ...], tensor: Any, state: State | None
) -> Findings:
    """Findings about the values of the systems and of `start`."""
    findings = Findings()
    for system in systems:
        system.check(findings)
    if tensor is not None:
        findings.require(is_inertia(tensor), RESULTS.invalid_inertia)
    if state is not None:
        findings.require(all_finite(state), RESULTS.invalid_state)
        findings.require(
            jnp.all(jax.vmap(is_unit)(state.attitude)), RESULTS.invalid_attitude
        )
    return findings


def findings_of_records(
    records: tuple[Record, ...], readings: DirectReadings | None
) -> Findings:
    """Findings about records, whose arrays are numpy's."""
    findings = Findings()
    check_records(findings, records)
    # Attitudes may be sampled sparsely: their aliases are looked for by several
    # attempts.
    known = any(tells(x, "attitude") for x in records)
    if readings is not None and readings.ts.shape[1] > 1 and not known:
        findings.require(_between(readings) < np.pi, RESULTS.undersampled_rates)
    return findings


def judge(
    systems: tuple[RigidBody, ...],
    records: tuple[Record, ...],
    tensor: Any,
    state: State | None,
    readings: DirectReadings | None,
    throw: bool,
    of_start: Any = None,
) -> Any:
    """The result code of the arguments of a fit; RuntimeError for a bad one if `throw`.

    Args:
        systems: One, or one for each trial.
        records: With numpy arrays.
        tensor: Where to start, or None.
        state: Where each trial starts, or None.
        readings: Rates and attitudes that the records tell.
        throw: Whether to raise an error.
        of_start: `result_of_start` of these arguments, if it is known.
    """
    known = of_start is not None
    result = of_start if known else result_of_start(systems, tensor, state)
    if not is_good(result):
        settle(_Judged(result), throw, findings_of_start, systems, tensor, state)
        return result
    findings = findings_of_records(records, readings)
    # These values are concrete, so that the error is raised in Python.
    if throw and not findings.ok:
        findings.guard(None, throw)
    return findings.result


class _Judged(NamedTuple):
    """Object with a result code, the only part that `settle` reads."""

    result: Any


def _between(readings: DirectReadings) -> np.floating:
    """Angle turned between neighbouring samples, as a median."""
    ok = readings.valid[:, 1:] & readings.valid[:, :-1]
    speed = np.sqrt(np.sum(readings.omega[:, 1:] ** 2, axis=-1))
    turned = np.diff(readings.ts, axis=1) * speed
    # In a median, gaps between samples do not matter.
    return np.nan_to_num(_median(turned[ok]))
