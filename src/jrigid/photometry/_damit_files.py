"""Readers of DAMIT's files: light curves with their geometry, and shapes."""

import dataclasses
import pathlib
from decimal import Decimal, InvalidOperation

import numpy as np
from jaxtyping import Float

from jrigid.photometry._facets import Facets, facets_from_mesh

ASTRONOMICAL_UNIT = 149597870700.0  # m
_DAY = 86400  # s
# Between these are magnitudes of asteroids. Brightness may be, but has any scale. In a
# curve, magnitudes differ by less than this factor, which is 3 mag at 10.
_MAGNITUDES = (5.0, 30.0)
_FACTOR = 1.3


@dataclasses.dataclass(frozen=True)
class LightCurve:
    """Brightness at epochs, with the directions of Sun and observer.

    Attributes:
        epoch: Julian date of time 0.
        ts: Times since then [s]; those of DAMIT are corrected for the light time.
        brightness: At each time; of a relative curve only the ratios matter.
        to_sun: From the body to the Sun, space axes (DAMIT: the ecliptic) [m].
        to_observer: From the body to the observer, space axes [m].
        is_relative: Whether the scale of the brightness is unknown. Curves that are not
            relative have one scale, in each band.
        band: Name of the filter.
        errors: Standard deviations of the points [mag], where they are stated.
    """

    epoch: float
    ts: Float[np.ndarray, " epochs"]
    brightness: Float[np.ndarray, " epochs"]
    to_sun: Float[np.ndarray, "epochs 3"]
    to_observer: Float[np.ndarray, "epochs 3"]
    is_relative: bool
    band: str = ""
    errors: Float[np.ndarray, " epochs"] | None = None

    @property
    def has_magnitudes(self) -> bool:
        """Whether its brightness looks like magnitudes."""
        least, largest = _MAGNITUDES
        brightness = np.asarray(self.brightness)
        inside = np.all((brightness > least) & (brightness < largest))
        return bool(inside and np.max(brightness) < _FACTOR * np.min(brightness))


class _Lines:
    """The lines of a file that are not empty, and where a reader is among them."""

    def __init__(self, path: str | pathlib.Path):
        """Read a text file."""
        self.path = pathlib.Path(path)
        text = self.path.read_text(encoding="utf-8-sig")
        lines = enumerate(text.splitlines(), 1)
        self._left = [(number, line.split()) for number, line in lines if line.strip()]
        # `pop` takes lines off the end.
        self._left.reverse()
        self.number = 0

    def __bool__(self) -> bool:
        """Whether there are lines left."""
        return bool(self._left)

    def error(self, text: str) -> ValueError:
        """An error that names the file and the line."""
        return ValueError(f"{self.path.name}, line {self.number}: {text}")

    def next(self, count: int, what: str) -> list[str]:
        """The words of the next line, of which there must be so many."""
        if not self._left:
            raise ValueError(f"{self.path.name} ends where {what} should be.")
        self.number, words = self._left.pop()
        if len(words) != count:
            raise self.error(
                f"{what} must be {count} numbers, but there are {len(words)}."
            )
        return words

    def numbers(self, count: int, what: str) -> list[Decimal]:
        """The numbers of the next line."""
        words = self.next(count, what)
        try:
            numbers = [Decimal(word) for word in words]
        except InvalidOperation:
            raise self.error(f"{what} must be numbers, but it is {words}.") from None
        # A decimal may be too large for a float.
        if not np.all(np.isfinite(np.array(numbers, dtype=float))):
            raise self.error(f"{what} must be finite, but it is {words}.")
        return numbers

    def integers(self, count: int, what: str) -> list[int]:
        """The integers of the next line."""
        numbers = self.numbers(count, what)
        if any(number != int(number) for number in numbers):
            raise self.error(f"{what} must be integers.")
        return [int(number) for number in numbers]


def read_light_curves(
    path: str | pathlib.Path, epoch: float | None = None
) -> list[LightCurve]:
    r"""Read a file of light curves in the format of DAMIT and convexinv.

    The first line is the number of curves. Each curve begins with its number of points
    and a 1 for absolute or a 0 for relative brightness. Each point is a Julian date,
    corrected for the light time, the brightness (not the magnitude), and the vectors
    from the body to the Sun and to the Earth in the ecliptic [au].

    Args:
        path: The file.
        epoch: Julian date of time 0; that of the first point in the file if None.

    Returns:
        The curves, all with the same epoch.

    Raises:
        ValueError: A line that does not hold what it should; the text names the line.

    >>> import pathlib, tempfile, jrigid as jr
    >>> text = "1\n2 0\n2450000.5 1.0 1 0 0 1 0 0\n2450000.6 1.1 1 0 0 1 0 0\n"
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "curves.txt"
    >>> _ = path.write_text(text)
    >>> print(jr.photometry.read_light_curves(path)[0].ts)
    [   0. 8640.]
    """
    lines = _Lines(path)
    (count,) = lines.integers(1, "the number of light curves")
    if count < 0:
        raise lines.error(f"the number of light curves must not be {count}.")
    # `repr` gives the digits that were typed, not those of the binary fraction.
    zero = None if epoch is None else Decimal(repr(float(epoch)))
    curves = []
    for index in range(count):
        points, absolute = lines.integers(
            2, f"points and kind of light curve {index + 1}"
        )
        if points < 1 or absolute not in (0, 1):
            raise lines.error(
                "a light curve must have at least 1 point and the kind 0 (relative) or "
                f"1 (absolute), but it has {points} and {absolute}."
            )
        rows: list[list[Decimal]] = []
        for _ in range(points):
            row = _point(lines, index)
            if rows and row[0] < rows[-1][0]:
                raise lines.error(
                    f"the dates of light curve {index + 1} must ascend, but {row[0]} "
                    f"follows {rows[-1][0]}."
                )
            rows.append(row)
        zero = rows[0][0] if zero is None else zero
        curve = _curve(rows, zero, absolute == 0)
        if curve.has_magnitudes:
            raise lines.error(
                f"the brightness of light curve {index + 1} looks like magnitudes m: "
                "take 10^(-0.4 m). Fluxes may be divided by any number, the same for "
                "all curves of kind 1."
            )
        curves.append(curve)
    if lines:
        # No line that is kept is empty, so that this always raises an error.
        lines.next(0, f"the end of the file after {count} light curves")
    return curves


def _point(lines: _Lines, index: int) -> list[Decimal]:
    """One point: date, brightness and two vectors."""
    row = lines.numbers(8, f"a point of light curve {index + 1}")
    if row[1] <= 0:
        raise lines.error(f"brightness must be positive, but it is {row[1]}.")
    for name, vector in (("Sun", row[2:5]), ("Earth", row[5:8])):
        if not any(vector):
            raise lines.error(f"the vector to the {name} must not be 0, but it is.")
    return row


def _curve(rows: list[list[Decimal]], epoch: Decimal, is_relative: bool) -> LightCurve:
    """A light curve in SI units. Dates have more digits than a float holds."""
    numbers = np.array(rows, dtype=float)
    return LightCurve(
        epoch=float(epoch),
        ts=np.array([float((row[0] - epoch) * _DAY) for row in rows]),
        brightness=numbers[:, 1],
        to_sun=ASTRONOMICAL_UNIT * numbers[:, 2:5],
        to_observer=ASTRONOMICAL_UNIT * numbers[:, 5:8],
        is_relative=is_relative,
    )


def read_shape(path: str | pathlib.Path, *, hull: bool = False) -> Facets:
    r"""Read a shape file of DAMIT: vertices and triangles that count from 1.

    Args:
        path: The file: numbers of vertices and triangles, then the vertices, then the
            triangles, counter-clockwise seen from outside.
        hull: Take the convex hull of a body that is not convex.

    Returns:
        The facets. Their unit of length is that of the file.

    Raises:
        ValueError: A line that does not hold what it should, or a body that is not
            convex.

    >>> import pathlib, tempfile, jrigid as jr
    >>> text = "4 4\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 3 2\n1 2 4\n1 4 3\n2 3 4\n"
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "shape.txt"
    >>> _ = path.write_text(text)
    >>> print(jr.photometry.read_shape(path).areas.round(3))
    [0.5   0.5   0.5   0.866]
    """
    lines = _Lines(path)
    vertex_count, face_count = lines.integers(2, "numbers of vertices and triangles")
    # A tetrahedron has the fewest of both.
    if min(vertex_count, face_count) < 4:
        raise lines.error("a body must have at least 4 vertices and 4 triangles.")
    vertices = [lines.numbers(3, "a vertex") for _ in range(vertex_count)]
    faces = []
    for _ in range(face_count):
        face = lines.integers(3, "a triangle")
        if not 1 <= min(face) <= max(face) <= vertex_count:
            raise lines.error(
                f"indices must be from 1 to {vertex_count}, but are {face}."
            )
        faces.append(face)
    corners = np.array(vertices, dtype=float)
    return facets_from_mesh(corners, np.array(faces) - 1, hull=hull)
