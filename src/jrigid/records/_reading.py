"""What a file of sensors says, in SI units on one clock."""

import dataclasses
import itertools

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jrigid._types import Readable


class Reading(Readable):
    """Readings of the sensors in one box, in SI units and body axes, on one clock.

    `print(reading)` is a report in words; `reading[first:last]` are some of its rows. It holds
    NumPy arrays in float64 whatever JAX's precision is set to.

    Attributes:
        times: When it was read [s], increasing.
        rates: Angular velocity, body components [rad/s]; None where there is no gyro.
        specific_forces: What an accelerometer shows [m/s^2]: acceleration minus gravity, so 9.8
            upward at rest and zero in free fall. NaN where it was silent; None without one.
        magnetic_fields: Magnetic field, body components [T]; NaN where silent; None without.
        columns: What else is in the file, by its header there and in the file's units; columns that
            were asked for by a name, in SI where their header states a unit.
        breaks: Rows before which time is missing (a gap) or of unknown length (a reset clock).
        notes: In words what was recognised, converted and repaired.
    """

    times: Float[np.ndarray, " rows"]
    rates: Float[np.ndarray, "rows 3"] | None = None
    specific_forces: Float[np.ndarray, "rows 3"] | None = None
    magnetic_fields: Float[np.ndarray, "rows 3"] | None = None
    columns: dict[str, Float[np.ndarray, " rows"]] = eqx.field(default_factory=dict)
    breaks: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def interval(self) -> float:
        """Median time from a row to the next [s]; NaN for less than two rows."""
        return float(np.median(np.diff(self.times))) if self.times.size > 1 else float("nan")

    def __getitem__(self, rows: slice) -> "Reading":
        """Consecutive rows, with the notes of the whole."""
        first, last, step = rows.indices(self.times.size)
        if step != 1:
            raise ValueError(f"Argument `rows` must be consecutive, but their step is {step}.")

        def part(array: np.ndarray | None) -> np.ndarray | None:
            return None if array is None else array[first:last]

        return dataclasses.replace(
            self,
            times=self.times[first:last],
            rates=part(self.rates),
            specific_forces=part(self.specific_forces),
            magnetic_fields=part(self.magnetic_fields),
            columns={name: column[first:last] for name, column in self.columns.items()},
            breaks=tuple(row - first for row in self.breaks if first < row < last),
        )

    def pieces(self) -> list["Reading"]:
        """The stretches between breaks: within each of them no time is missing."""
        ends = [0, *self.breaks, self.times.size]
        return [self[a:b] for a, b in itertools.pairwise(ends)]

    def with_notes(self, *notes: str) -> "Reading":
        """The same with more notes."""
        return dataclasses.replace(self, notes=(*self.notes, *notes))

    def __str__(self) -> str:
        """A report in words."""
        size = self.times.size
        lines = [f"{size} readings"]
        if size > 1:
            length, interval = self.times[-1] - self.times[0], self.interval
            lines[0] += f" over {length:.4g} s, one in {1e3 * interval:.4g} ms"
        for what, array, unit in (
            ("rates", self.rates, "rad/s"),
            ("specific forces", self.specific_forces, "m/s^2"),
            ("magnetic fields", self.magnetic_fields, "T"),
        ):
            if array is not None and np.isfinite(array).any():
                largest = np.sqrt(np.nanmax(np.sum(array**2, axis=1)))
                lines.append(f"  {what}: {largest:.4g} {unit} at most")
        if self.columns:
            lines.append(f"  other columns: {', '.join(self.columns)}")
        if self.breaks:
            lines.append(f"  pieces without a break: {len(self.breaks) + 1}")
        return "\n".join([*lines, *(f"  - {note}" for note in self.notes)])
