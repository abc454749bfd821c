"""A triaxial ellipsoid: its facets, and its brightness in closed form."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._checks import array_of_shape, demand, is_concrete, whole_number
from jrigid._numerics import polynomial, safe_norm, sum_of_squares
from jrigid._types import Readable, Scalar, Vector
from jrigid.photometry._facets import Facets, facets_from_mesh
from jrigid.photometry._scattering import AbstractScattering, LommelSeeliger

# (r - (1 - r^2) artanh r) / r^3 in powers of r^2. Below this r^2 the closed form loses
# digits, and so many terms reach the rounding of float64.
_SERIES_BELOW = 0.1
_LUNE = [2 / ((2 * k + 1) * (2 * k + 3)) for k in range(15)]


class Ellipsoid(Readable):
    """A triaxial ellipsoid with its axes along the body axes.

    Attributes:
        semi_axes: Half lengths along the body axes [m], positive.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> cigar = jr.photometry.Ellipsoid(jnp.array([3.0, 1.0, 1.0]))
    >>> print(cigar.facets(8).areas.shape)
    (224,)
    """

    semi_axes: Float[Array, "3"] = eqx.field(
        converter=lambda value: array_of_shape("semi_axes", value, (3,))
    )

    def __check_init__(self):
        """Reject lengths that are not positive, where they are known."""
        demand(
            not is_concrete(self.semi_axes) or not np.any(self.semi_axes <= 0),
            f"Argument `semi_axes` must be positive, but it is {self.semi_axes}.",
        )

    @property
    def moments(self) -> Vector:
        """Principal moments of inertia of a homogeneous ellipsoid of mass 1 [m^2]."""
        square = self.semi_axes**2
        # About the axis a of an ellipsoid the moment is m (b^2 + c^2) / 5.
        return (jnp.sum(square) - square) / 5

    def facets(self, rows: int = 64) -> Facets:
        """Triangles with their corners on the ellipsoid.

        Args:
            rows: Rings of triangles from pole to pole. The number of triangles is about
                four times the square of this one.
        """
        vertices, faces = _sphere(whole_number("rows", rows, least=4))
        corners = jnp.asarray(vertices, self.semi_axes.dtype) * self.semi_axes[None]
        return facets_from_mesh(corners, faces)

    def brightness(
        self, scattering: AbstractScattering, to_sun: Vector, to_observer: Vector
    ) -> Scalar:
        """Brightness by Lommel-Seeliger's law, without the phase function.

        Args:
            scattering: The law, which must be `LommelSeeliger`.
            to_sun: Unit vector to the Sun, body axes.
            to_observer: Unit vector to the observer, body axes.

        Gradients: exact. Where Sun and observer are in the same direction the second
        derivatives in it grow without bound, as the logarithm of the phase angle; at a
        phase angle of 0 itself finite ones are returned. Where the Sun is straight
        behind the body, the value and the gradient are 0.
        Source: K. Muinonen and K. Lumme, Astron. Astrophys. 584 (2015) A23, eq. 13;
        derived again from the integral over the unit sphere.
        """
        demand(
            # A subclass may be another law.
            type(scattering) is LommelSeeliger,
            "Argument `scattering` must be `LommelSeeliger()` for an ellipsoid, whose "
            f"brightness is known by that law alone, but it is {scattering!r}: take "
            "`shape.facets()`.",
        )
        return lommel_seeliger_brightness(self.semi_axes, to_sun, to_observer)


def _sphere(rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners on the unit sphere and triangles: `rows` of them from pole to pole."""
    columns = 2 * rows
    polar = np.pi * np.arange(1, rows) / rows
    around = 2 * np.pi * np.arange(columns) / columns
    polar, around = np.meshgrid(polar, around, indexing="ij")
    rings = [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around)]
    rings = np.stack([*rings, np.cos(polar)], axis=-1).reshape(-1, 3)
    vertices = np.concatenate([rings, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    north = len(rings)
    index = np.arange(len(rings)).reshape(rows - 1, columns)
    right = np.roll(index, -1, axis=1)
    upper, lower = index[:-1], index[1:]
    upper_right, lower_right = right[:-1], right[1:]
    # Corners run counter-clockwise seen from outside, as `facets_from_mesh` takes them.
    faces = [
        np.stack([np.full(columns, north), index[0], right[0]], axis=-1),
        np.stack([upper, lower, upper_right], axis=-1).reshape(-1, 3),
        np.stack([upper_right, lower, lower_right], axis=-1).reshape(-1, 3),
        np.stack([np.full(columns, north + 1), right[-1], index[-1]], axis=-1),
    ]
    return vertices, np.concatenate(faces)


def lommel_seeliger_brightness(
    semi_axes: Vector, to_sun: Vector, to_observer: Vector
) -> Scalar:
    """Integral of mu0 mu / (mu0 + mu) over the lit and visible surface.

    A point of the ellipsoid is A n, with n on the unit sphere and A the diagonal matrix
    of the semi-axes; an element of the surface with its normal is |A| A^-1 n dn. With
    unit vectors u0 and u along A^-1 e0 and A^-1 e, of lengths s0 and s, the integrand
    is |A| s0 s (u0 n) (u n) / (s0 u0 n + s u n): a lune of the sphere between two great
    circles, over which the integral is elementary. With the ratio
    r = |s0 u0 + s u| / (s0 + s) it is
    pi / 4 |A| s0 s / (s0 + s) |u0 + u|^2 (r - (1 - r^2) artanh r) / r^3.
    """
    sun = to_sun / semi_axes
    observer = to_observer / semi_axes
    s0 = safe_norm(sun)
    s = safe_norm(observer)
    sun = sun / s0
    observer = observer / s
    weight = s0 * s / (s0 + s)
    # 1 - r^2, by |u0 - u|^2: a difference of numbers near 1 would lose digits.
    rest = weight / (s0 + s) * sum_of_squares(sun - observer)
    volume = jnp.prod(semi_axes)
    light = sum_of_squares(sun + observer) * _share_of_lune(rest)
    return jnp.pi / 4 * volume * weight * light


def _share_of_lune(rest: Scalar) -> Scalar:
    """(r - (1 - r^2) artanh r) / r^3 for 1 - r^2 from 0 to 1, analytic at r = 0.

    The slope in 1 - r^2 is infinite at r = 1, where that of the closed form without the
    logarithm is returned.
    """
    square = 1 - rest
    small = square < _SERIES_BELOW
    series = polynomial(_LUNE, jnp.where(small, square, 0.0))
    rest = jnp.where(small, 0.5, rest)
    r = jnp.sqrt(1 - rest)
    # artanh r is this less half the logarithm of 1 - r^2.
    artanh = jnp.log1p(r) - jnp.log(jnp.where(rest > 0, rest, 1.0)) / 2
    return jnp.where(small, series, (r - rest * artanh) / r**3)
