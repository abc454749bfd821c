"""Conventions in which a record would fit, where it does not as it was passed.

Quaternions of other programs may be scalar last, or turn space axes to body axes.
Rates may be in degrees a second or along space axes. A fit of such a record ends far
from it. Then the record is read in these ways, too, and the report says which one fits.
"""

from collections.abc import Callable, Iterator

import equinox as eqx
import numpy as np

from jrigid.identify import _host as host
from jrigid.identify._quality import FOLLOWED, Fit, misfit, sums_of, unexplained
from jrigid.identify._records import Record
from jrigid.identify._sensors import AttitudeSensor, Gyro

# Chi-square for each degree of freedom beyond which another reading is worth a try, and
# the part of it that is left if that reading is right.
_FAR = 10.0
_LEFT = 0.25

Records = tuple[Record, ...]
# Returns None for records to which the convention does not apply.
Reading = Callable[[Records], Records | None]


def _changed(
    records: Records, sensor: type, change: Callable[[np.ndarray], np.ndarray]
) -> Records | None:
    """Records of which the values of one kind of sensor are changed."""
    if not any(isinstance(x.sensor, sensor) for x in records):
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
    """Rates in degrees a second, beside a sensor that is no gyro."""
    # The inertia of a free body does not tell in which unit all rates are.
    if all(isinstance(x.sensor, Gyro) for x in records):
        return None
    return _changed(records, Gyro, np.radians)


def _space_axes(records: Records) -> Records | None:
    """Rates along space axes, beside attitudes at the same times."""
    trackers = [x for x in records if isinstance(x.sensor, AttitudeSensor)]
    gyros = [x for x in records if isinstance(x.sensor, Gyro)]
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
COUNT = len(_READINGS)


def readings(records: Records) -> Iterator[tuple[int, Records]]:
    """The records as they would be in other conventions, and the index of each."""
    for index, reading in enumerate(_READINGS):
        changed = reading(records)
        if changed is not None:
            yield index, changed


def is_far(fit: Fit) -> bool:
    """Whether a fit is so wrong that another convention is worth a try."""
    return misfit(fit) > _FAR or unexplained(fit) > FOLLOWED


def explains(other: Fit, fit: Fit) -> bool:
    """Whether the record fits in another convention, where it did not before."""
    falls = sums_of(other).residual < _LEFT * sums_of(fit).residual
    return bool(falls and unexplained(other) <= FOLLOWED)


def in_words(conventions: np.ndarray) -> str:
    """Which conventions would fit and what to pass, or an empty text without any."""
    is_scalar_last, is_space_to_body, is_in_degrees, is_along_space = conventions
    if is_scalar_last and is_space_to_body:
        return (
            "The attitudes would fit if they were scalar last, or from space to body; "
            "they do not tell which. Pass (w, x, y, z) from body to space "
            "(`jr.rotation.from_scipy`, `jr.rotation.conjugate`)."
        )
    if is_scalar_last:
        return (
            "The attitudes would fit if they were scalar last: pass (w, x, y, z), by "
            "`jr.rotation.from_scipy`."
        )
    if is_space_to_body:
        return (
            "The attitudes would fit if they turned space to body: pass those from body "
            "to space, by `jr.rotation.conjugate`."
        )
    if is_in_degrees:
        return (
            "The rates would fit if they were in degrees a second: multiply them by "
            "pi / 180."
        )
    if is_along_space:
        return (
            "The rates would fit if they were along space axes: pass them along body "
            "axes, by `jr.rotation.rotate_inverse`."
        )
    return ""
