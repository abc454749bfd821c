"""Conventions in which a record would fit, where it does not as it was passed.

Quaternions of other programs may be scalar last, or turn space axes to body axes.
Rates may be in degrees a second or along space axes. A fit of such a record ends far
from it. Then the record is read in these ways, too, and the report says which one is
right. Attitudes and rates of one motion tell it by themselves, whatever the torque: the
body must turn from one attitude to the next as the rates say. Attitudes alone are
fitted anew.
"""

from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, PyTree

from jrigid._types import BodyState, ScalarLike, Vector
from jrigid.identify import _host as host
from jrigid.identify._quality import FOLLOWED, Fit, misfit, sums_of, unexplained
from jrigid.identify._records import Record
from jrigid.identify._sensors import AttitudeSensor, Gyro
from jrigid.systems import RigidBody
from jrigid.torques import Rotor

# Chi-square for each degree of freedom beyond which another reading is worth a try, and
# the part of it that is left if that reading is right.
_LARGE_MISFIT = 10.0
_LEFT = 0.25
# Turns of attitudes and of rates are compared over a radian. They agree to this, in
# which there is room for noise, for errors of a gyro and for other times of samples.
_WINDOW = 1.0
_AGREE = 0.3
_COARSE = 2.0  # radians between samples of a gyro
_MOST = 2000  # samples of a trial that are compared

Records = tuple[Record, ...]
# Returns None for records to which the convention does not apply.
Reading = Callable[[Records], Records | None]


def _of_kind(records: Records, sensor: type) -> list[Record]:
    """Records of one kind of sensor."""
    return [x for x in records if isinstance(x.sensor, sensor)]


def _changed(
    records: Records, sensor: type, change: Callable[[np.ndarray], np.ndarray]
) -> Records | None:
    """Records of which the values of one kind of sensor are changed."""
    if not _of_kind(records, sensor):
        return None
    return tuple(
        _with_values(x, change(np.asarray(x.values)))
        if isinstance(x.sensor, sensor)
        else x
        for x in records
    )


def _with_values(record: Record, values: np.ndarray) -> Record:
    """A record of the same sensor and noise."""
    return eqx.tree_at(lambda x: x.values, record, values)


def _scalar_last(records: Records) -> Records | None:
    """Attitudes that were passed as (x, y, z, w)."""
    return _changed(records, AttitudeSensor, lambda q: np.roll(q, 1, axis=-1))


def _space_to_body(records: Records) -> Records | None:
    """Attitudes that were passed as turns of space axes to body axes."""
    return _changed(records, AttitudeSensor, host.conjugate)


def _degrees(records: Records) -> Records | None:
    """Rates in degrees a second, beside attitudes."""
    # The inertia of a free body does not tell in which unit all rates are.
    if not _of_kind(records, AttitudeSensor):
        return None
    return _changed(records, Gyro, np.radians)


def _space_axes(records: Records) -> Records | None:
    """Rates along space axes, beside attitudes at the same times."""
    trackers = _of_kind(records, AttitudeSensor)
    gyros = _of_kind(records, Gyro)
    if len(trackers) != 1 or not gyros:
        return None
    times = np.asarray(trackers[0].ts)
    if any(not np.array_equal(np.asarray(x.ts), times, equal_nan=True) for x in gyros):
        return None
    attitudes = host.normalize(np.asarray(trackers[0].values))
    to_space = host.to_matrix(attitudes)
    return _changed(
        records, Gyro, lambda rates: np.einsum("...ji,...j->...i", to_space, rates)
    )


_READINGS: tuple[Reading, ...] = (_scalar_last, _space_to_body, _degrees, _space_axes)
# The last one is that of wheels.
COUNT = len(_READINGS) + 1
WHEELS = COUNT - 1


class _Reversed(Rotor):
    """A rotor that turns the other way, with the arrays that `free` may pick."""

    def internal_momentum(
        self, t: ScalarLike, state: BodyState, args: PyTree
    ) -> Vector:
        return -super().internal_momentum(t, state, args)


def wheels_reversed(systems: tuple[RigidBody, ...]) -> tuple[RigidBody, ...] | None:
    """The bodies with rotors that turn the other way; None if there is no rotor."""

    def is_rotor(part: Any) -> bool:
        return isinstance(part, Rotor)

    def turned(part: Any) -> Any:
        return _Reversed(part.momentum) if is_rotor(part) else part

    if not any(map(is_rotor, jax.tree.leaves(systems, is_leaf=is_rotor))):
        return None
    return jax.tree.map(turned, systems, is_leaf=is_rotor)


def readings(records: Records) -> Iterator[tuple[int, Records]]:
    """The records as they would be in other conventions, and the index of each."""
    for index, reading in enumerate(_READINGS):
        changed = reading(records)
        if changed is not None:
            yield index, changed


def is_far(fit: Fit) -> bool:
    """Whether a fit is so wrong that another convention is worth a try."""
    return misfit(fit) > _LARGE_MISFIT or unexplained(fit) > FOLLOWED


def explains(other: Fit, fit: Fit) -> bool:
    """Whether the record fits in another convention, where it did not before."""
    falls = sums_of(other).residual < _LEFT * sums_of(fit).residual
    return bool(falls and unexplained(other) <= FOLLOWED)


def of_turns(records: Records) -> Bool[np.ndarray, " conventions"] | None:
    """The convention in which turns of attitudes and of rates agree best, if in one.

    Returns:
        None for records without both.
    """
    agree = turns_agree(records)
    if agree is None:
        return None
    found = np.zeros(COUNT, bool)
    if agree:
        return found
    differences = np.full(COUNT, np.inf)
    for index, changed in readings(records):
        differences[index] = _difference(changed)
    # Another convention may come near by chance.
    best = np.argmin(differences)
    found[best] = differences[best] < _AGREE
    return found


def turns_agree(records: Records) -> bool | None:
    """Whether a body turns from attitude to attitude as the rates of its gyro say.

    Returns:
        None for records without both.
    """
    difference = _difference(records)
    return None if difference is None else difference < _AGREE


def _difference(records: Records) -> float | None:
    """Median angle between turns of attitudes and of rates over a radian [rad].

    Returns:
        None for records without both, infinity where nothing can be compared.
    """
    trackers = _of_kind(records, AttitudeSensor)
    gyros = _of_kind(records, Gyro)
    if not trackers or not gyros:
        return None
    attitudes = np.asarray(_attitudes(trackers[0]))
    rates = np.asarray(_rates(gyros[0]))
    differences = [
        _differences(*of_trial)
        for of_trial in zip(
            np.asarray(trackers[0].ts),
            attitudes,
            np.asarray(gyros[0].ts),
            rates,
            strict=True,
        )
    ]
    # The median, since a few attitudes may have leapt.
    together = np.concatenate(differences)
    return float(np.median(together)) if together.size > 0 else np.inf


@jax.jit
def _attitudes(record: Record) -> Any:
    """Attitudes of the body (trials, n, 4)."""
    return jax.vmap(jax.vmap(record.sensor.attitude))(record.values)


@jax.jit
def _rates(record: Record) -> Any:
    """Angular velocities of the body (trials, n, 3)."""
    return jax.vmap(jax.vmap(record.sensor.rates))(record.values)


def _differences(
    tracker_times: Float[np.ndarray, " m"],
    attitudes: Float[np.ndarray, "m 4"],
    gyro_times: Float[np.ndarray, " n"],
    rates: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, " pairs"]:
    """Angles between the turns of pairs of attitudes and those of the rates [rad]."""
    tracker_times, attitudes = _seen(tracker_times, attitudes)
    gyro_times, rates = _seen(gyro_times, rates)
    if min(len(attitudes), len(rates)) < 2:
        return np.zeros(0)
    vectors = np.diff(gyro_times)[:, None] * (rates[1:] + rates[:-1]) / 2
    angles = np.linalg.norm(vectors, axis=1)
    if np.median(angles) > _COARSE:
        # Whole turns between samples would agree by chance.
        return np.full(1, np.pi)
    turned = np.array([0.0, *np.cumsum(angles)])
    # From the first sample of the gyro to each.
    turns = np.empty((len(rates), 4))
    turns[0] = [1.0, 0.0, 0.0, 0.0]
    for index, step in enumerate(host.exp(vectors)):
        turns[index + 1] = host.multiply(turns[index], step)
    # The sample of the gyro that is nearest to each attitude.
    middles = (gyro_times[1:] + gyro_times[:-1]) / 2
    nearest = np.searchsorted(middles, tracker_times)
    ends = np.searchsorted(turned[nearest], turned[nearest] + _WINDOW)
    begins = np.flatnonzero(ends < len(nearest))
    ends = ends[begins]
    by_rates = host.multiply(
        host.conjugate(turns[nearest[begins]]), turns[nearest[ends]]
    )
    by_attitudes = host.multiply(host.conjugate(attitudes[begins]), attitudes[ends])
    between = host.log(host.multiply(host.conjugate(by_attitudes), by_rates))
    return np.linalg.norm(between, axis=1)


def _seen(times: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first rows of which every number is there."""
    is_seen = np.isfinite(times) & np.all(np.isfinite(values), axis=1)
    return times[is_seen][:_MOST], values[is_seen][:_MOST]


def in_words(conventions: np.ndarray) -> str:
    """Name the conventions that the record seems to have; empty without any."""
    is_scalar_last, is_space_to_body, is_in_degrees, is_along_space, reverse = (
        conventions
    )
    if is_scalar_last and is_space_to_body:
        return (
            "The attitudes seem to be scalar last, or from space to body; they do not "
            "tell which. Pass (w, x, y, z) from body to space "
            "(`jr.rotation.from_scipy`, `jr.rotation.conjugate`)."
        )
    if is_scalar_last:
        return (
            "The attitudes seem to be scalar last: pass (w, x, y, z), by "
            "`jr.rotation.from_scipy`."
        )
    if is_space_to_body:
        return (
            "The attitudes seem to be from space to body: pass those from body to "
            "space, by `jr.rotation.conjugate`."
        )
    if is_in_degrees:
        return "The rates seem to be in degrees a second: multiply them by pi / 180."
    if is_along_space:
        return (
            "The rates seem to be along space axes: pass them along body axes, by "
            "`jr.rotation.rotate_inverse`."
        )
    if reverse:
        return (
            "The momentum of the rotor seems to have the wrong sign: pass minus the "
            "momentum, or turn the axis of the wheel."
        )
    return ""
