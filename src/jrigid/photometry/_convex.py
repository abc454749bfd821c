"""Light curves of a convex body, in the numbers of a fit.

The shape is its Gaussian image: normals are even on the sphere, and the logarithm of
the area of each facet is a sum of spherical harmonics at its normal.

Source: M. Kaasalainen and J. Torppa, Icarus 153 (2001) 24; M. Kaasalainen, J. Torppa
and K. Muinonen, Icarus 153 (2001) 37.
"""

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jrigid._numerics import product
from jrigid._types import AnyArray, Matrix, Scalar, Vector
from jrigid.photometry._curve_readings import EPOCHS, Readings
from jrigid.photometry._facets import Facets
from jrigid.photometry._light_curve import phase_angle
from jrigid.photometry._many_starts import Quadratic
from jrigid.photometry._model import Rows, axes_of_momentum
from jrigid.photometry._scattering import Mixture

SCATTERING = ("lambert", "amplitude", "width", "slope")
# These are sought by their logarithms, so that they stay positive.
_POSITIVE = np.array([True, False, True, False])
_LEAST = 1e-12  # of a weight that is given as 0
# Standard deviations of what is known beforehand: of each harmonic of the logarithm of
# the areas, of the slope of the logarithm of the albedo, and of logarithms of positive
# scattering parameters. They matter where the light says nothing.
_SPREAD_OF_SHAPE = 1.0
_SPREAD_OF_ALBEDO = 1.0
_SPREAD_OF_SCATTERING = (2.0, np.inf, 1.0, np.inf)
# Semi-axes of the first body: a sphere has no long axis from which the first step could
# begin.
FIRST_AXES = np.array([1.05, 1.0, 0.95])


# Numbers of the motion of a steady rotation: turns within the span, and longitude and
# latitude of the pole, in the axes of the fit [rad].
SPIN = 3
# Numbers of the albedo and of the scattering, which follow those of the motion.
_OF_SURFACE = 7


class ConvexNumbers(NamedTuple):
    """Numbers that a fit seeks; leaves may have lanes in front.

    Attributes:
        motion: Numbers of the motion, at least.
        albedo: The logarithm of the albedo is the product of this and the normal.
        scattering: Logarithm of lambert, amplitude, logarithm of width, slope.
        shape: Coefficients of the harmonics of degree 1 and more.
    """

    motion: Float[AnyArray, "*lanes motion"]
    albedo: Float[AnyArray, "*lanes 3"]
    scattering: Float[AnyArray, "*lanes 4"]
    shape: Float[AnyArray, "*lanes harmonics"]


def unpacked_convex(
    vector: Float[AnyArray, "*lanes numbers"], motion: int
) -> ConvexNumbers:
    """The numbers of a vector, of which so many are those of the motion."""
    ends = (0, motion, motion + 3, motion + _OF_SURFACE, None)
    return ConvexNumbers(*(vector[..., i:j] for i, j in itertools.pairwise(ends)))


class Surface(NamedTuple):
    """The facets of all bodies of a fit, and what is known of their numbers.

    Attributes:
        normals: Unit vectors, body axes.
        harmonics: At each normal, of degree 1 and more, of mean square 1.
        sought: Which numbers a fit seeks.
        centre: Expected numbers.
        stiffness: 1 over the standard deviations of the numbers from `centre`.
        closure: 1 over the standard deviation of the sum of the areas as vectors, over
            their sum as numbers. It is 0 for every closed surface.
    """

    normals: Float[AnyArray, "facets 3"]
    harmonics: Float[AnyArray, "facets harmonics"]
    sought: Bool[AnyArray, " numbers"]
    centre: Float[AnyArray, " numbers"]
    stiffness: Float[AnyArray, " numbers"]
    closure: Float[AnyArray, ""]

    @property
    def motion(self) -> int:
        """Count of the numbers that describe the motion."""
        return self.sought.shape[-1] - _OF_SURFACE - self.harmonics.shape[-1]


def surface_of(
    motion: Bool[np.ndarray, " motion"],
    degree: int,
    facets: int,
    scattering: Mixture,
    fitted: tuple[str, ...],
    albedo: bool,
    closure: float,
) -> Surface:
    """The facets of a fit, whose `centre` is where it starts but for the motion.

    Args:
        motion: Which numbers of the motion are sought.
        degree: Largest degree of the harmonics.
        facets: How many.
        scattering: The law, or where its fit starts.
        fitted: Names of its parameters that are fitted.
        albedo: Whether the albedo is fitted.
        closure: Standard deviation of the sum of the areas as vectors, over their sum
            as numbers.
    """
    normals = even_directions(facets)
    harmonics = real_harmonics(normals, degree)
    given = np.array([float(getattr(scattering, name)) for name in SCATTERING])
    logarithms = np.log(np.where(_POSITIVE, np.maximum(given, _LEAST), 1.0))
    given = np.where(_POSITIVE, logarithms, given)
    coefficients = harmonics.shape[1]
    is_fitted = np.array([name in fitted for name in SCATTERING])
    return Surface(
        normals=normals,
        harmonics=harmonics,
        sought=np.concatenate(
            [
                motion,
                np.full(3, albedo),
                is_fitted,
                np.ones(coefficients, bool),
            ]
        ),
        centre=np.concatenate(
            [np.zeros(len(motion) + 3), given, np.zeros(coefficients)]
        ),
        stiffness=np.concatenate(
            [
                # Nothing is known beforehand of the motion.
                np.zeros(len(motion)),
                np.full(3, 1 / _SPREAD_OF_ALBEDO),
                1 / np.array(_SPREAD_OF_SCATTERING),
                np.full(coefficients, 1 / _SPREAD_OF_SHAPE),
            ]
        ),
        closure=np.asarray(1 / closure),
    )


def even_directions(count: int) -> Float[np.ndarray, "many 3"]:
    """Unit vectors that cover the sphere evenly, in pairs of opposite ones.

    Half of them lie on a spiral of the golden ratio. With opposite ones a sphere is
    closed and the mirror of a body is a body.
    """
    half = (count + 1) // 2
    index = np.arange(half) + 0.5
    # Equal steps of the height cut the sphere into zones of equal area.
    height = 1 - index / half
    longitude = np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - height**2)
    upper = np.stack(
        [radius * np.cos(longitude), radius * np.sin(longitude), height], axis=1
    )
    return np.concatenate([upper, -upper])


def real_harmonics(
    directions: Float[np.ndarray, "many 3"], degree: int
) -> Float[np.ndarray, "many harmonics"]:
    """Real spherical harmonics of degree 1 to `degree`, of mean square 1 on the sphere.

    Columns are in rising order of the degree, and of the order from -degree to degree
    within. Negative orders are sines of the longitude.

    Source: the recurrences of W. H. Press et al., Numerical Recipes, 3rd ed., 6.7.
    """
    x, y, z = directions.T
    columns: dict[tuple[int, int], np.ndarray] = {}
    highest = np.ones_like(z)
    for m in range(degree + 1):
        if m > 0:
            # The mean of sin(polar angle)^(2 m) on the sphere is 2 m / (2 m + 1) of
            # that of the order before.
            highest = highest * np.sqrt((2 * m + 1) / (2 * m))
        # Squares of cosines and sines have the mean 1/2, hence the root of 2.
        turned = (x + 1j * y) ** m * (1 if m == 0 else np.sqrt(2))
        for n, legendre in enumerate(_legendre(highest, z, m, degree), m):
            # The cosine is stored last: order 0 has one key for both, and no sine.
            columns[n, -m] = legendre * turned.imag
            columns[n, m] = legendre * turned.real
    order = [(n, m) for n in range(1, degree + 1) for m in range(-n, n + 1)]
    return np.stack([columns[key] for key in order], axis=1)


def _legendre(
    highest: np.ndarray, z: np.ndarray, m: int, degree: int
) -> list[np.ndarray]:
    """Legendre functions of order m and degrees from m, over the sine to the power m.

    The next one is w(n + 1) (z P(n) - P(n - 1) / w(n)).
    """
    functions = [highest]
    before = np.zeros_like(z)
    for n in range(m + 1, degree + 1):
        weight = np.sqrt((4 * n**2 - 1) / (n**2 - m**2))
        following = weight * (z * functions[-1] - before)
        before = functions[-1] / weight
        functions.append(following)
    return functions


def degrees_of_harmonics(count: int) -> np.ndarray:
    """The degree of each of so many harmonics."""
    # The degrees 1 to n have (n + 1)^2 - 1 harmonics.
    return np.floor(np.sqrt(np.arange(1, count + 1))).astype(int)


def ellipsoid_harmonics(
    surface: Surface, axes: Float[np.ndarray, "3"]
) -> Float[np.ndarray, " harmonics"]:
    """Harmonics of an ellipsoid with given semi-axes.

    The area of an ellipsoid with semi-axes a for a unit of solid angle of its normals n
    is (product of a)^2 / (sum of a^2 n^2)^2.
    """
    logarithms = -2 * np.log(np.square(surface.normals) @ np.square(axes))
    centred = logarithms - logarithms.mean()
    return np.linalg.lstsq(surface.harmonics, centred, rcond=None)[0]


def facets_of(vector: Float[Array, " numbers"], surface: Surface) -> Facets:
    """The body; the sum of its areas is that of a unit sphere."""
    numbers = unpacked_convex(vector, surface.motion)
    areas = _areas(numbers.shape, surface)
    # Curves have unknown factors, so that the size of the body is arbitrary.
    areas = areas * (4 * jnp.pi / jnp.sum(areas))
    return Facets(areas, surface.normals, _albedo(numbers.albedo, surface))


def law_of(scattering: Float[Array, "4"]) -> Mixture:
    """The scattering law of a fit."""
    return Mixture(*jnp.where(_POSITIVE, jnp.exp(scattering), scattering))


def _areas(shape: Float[Array, " harmonics"], surface: Surface) -> Array:
    """Areas of the facets, relative."""
    return jnp.exp(product("fh,h->f", surface.harmonics, shape))


def _albedo(slope: Vector, surface: Surface) -> Array:
    """Albedo of the facets: what closure can determine of it, and no more."""
    return jnp.exp(product("fi,i->f", surface.normals, slope))


def openness(shape: Float[Array, " harmonics"], surface: Surface) -> Float[Array, "3"]:
    """The sum of the areas as vectors, over their sum as numbers."""
    areas = _areas(shape, surface)
    return product("f,fi->i", areas, surface.normals) / jnp.sum(areas)


class Placed(NamedTuple):
    """Directions and gaps that follow from the numbers of the motion.

    Attributes:
        directions: To the Sun and to the observer at each epoch, body axes.
        gaps: What should be 0, over its spread: equations between the numbers.
    """

    directions: Float[Array, "epochs 2 3"]
    gaps: Float[Array, " gaps"]


# Where the Sun and the observer are, as a function of the numbers of the motion.
Motion = Callable[[Array], Placed]


def _steady(motion: Float[Array, "3"], frame: Matrix, readings: Readings) -> Placed:
    """Directions under a steady rotation about the z axis of the body.

    At time 0 the x axis of the body points south of the pole, in the axes of the fit.
    """
    axes = product("ij,jk->ik", axes_of_momentum(motion[1:]), frame)
    lines = jnp.stack([readings.to_sun, readings.to_observer], axis=1)
    x, y, z = jnp.moveaxis(product("esj,ij->esi", lines, axes), -1, 0)
    angle = 2 * jnp.pi * motion[0] * readings.ts[:, None] / readings.span
    cosine = jnp.cos(angle)
    sine = jnp.sin(angle)
    # Seen from the body, directions in space turn the other way.
    turned = jnp.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=-1)
    return Placed(turned, jnp.zeros(0, turned.dtype))


class _Light(NamedTuple):
    """Brightness of some epochs, and its derivatives."""

    value: Float[Array, " epochs"]
    of_lambert: Float[Array, " epochs"]
    of_sun: Float[Array, "epochs 3"]
    of_observer: Float[Array, "epochs 3"]
    of_logarithms: Float[Array, "epochs columns"]


def _light(
    reflecting: Float[Array, " facets"],
    lambert: Scalar,
    columns: Float[Array, "facets columns"],
    normals: Float[Array, "facets 3"],
    directions: Float[Array, "epochs 2 3"],
) -> _Light:
    """Brightness for directions in body axes.

    Light is linear in what the facets reflect, so its derivative in that is the light
    of a unit of area, and a matrix product takes it to the harmonics. By hand this is
    four times faster than derivatives of `Facets.brightness`.

    Args:
        reflecting: Albedo times area.
        lambert: Weight of Lambert's law.
        columns: Derivatives of `reflecting` in the numbers of albedo and shape.
        normals: Of the facets.
        directions: To the Sun and to the observer.
    """
    cos_sun = jnp.maximum(product("ei,fi->ef", directions[:, 0], normals), 0.0)
    cos_observer = jnp.maximum(product("ei,fi->ef", directions[:, 1], normals), 0.0)
    both = cos_sun * cos_observer
    counted = both > 0
    # Where a facet is neither lit nor visible the sum of the cosines is 0.
    inverse = 1 / jnp.where(counted, cos_sun + cos_observer, 1.0)
    of_area = both * (inverse + lambert)
    # The derivative of mu0 mu / (mu0 + mu) in mu0 is (mu / (mu0 + mu))^2.
    of_sun = jnp.square(cos_observer * inverse) + lambert * cos_observer
    of_sun = jnp.where(counted, of_sun, 0.0)
    of_observer = jnp.square(cos_sun * inverse) + lambert * cos_sun
    of_observer = jnp.where(counted, of_observer, 0.0)
    along = normals * reflecting[:, None]
    return _Light(
        value=product("ef,f->e", of_area, reflecting),
        of_lambert=product("ef,f->e", both, reflecting),
        of_sun=product("ef,fi->ei", of_sun, along),
        of_observer=product("ef,fi->ei", of_observer, along),
        of_logarithms=product("ef,fc->ec", of_area, columns),
    )


def _light_in_blocks(
    numbers: ConvexNumbers, surface: Surface, directions: Float[Array, "epochs 2 3"]
) -> _Light:
    """Brightness at all epochs, a block of them at a time, which fits in the cache."""
    reflecting = _areas(numbers.shape, surface) * _albedo(numbers.albedo, surface)
    # The logarithm of albedo times area is linear in the numbers, with these slopes.
    columns = jnp.concatenate([surface.normals, surface.harmonics], axis=1)
    of_block = functools.partial(
        _light,
        reflecting,
        law_of(numbers.scattering).lambert,
        columns * reflecting[:, None],
        surface.normals,
    )
    # The readings are filled up to whole blocks of epochs.
    blocks = directions.reshape(-1, EPOCHS, 2, 3)
    light = jax.lax.map(of_block, blocks)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), light)


def _log_phase(scattering: Float[Array, "4"], angle: Scalar) -> Scalar:
    """Logarithm of the phase function."""
    return jnp.log(law_of(scattering).phase_factor(angle))


def convex_rows(
    vector: Float[Array, " numbers"],
    placed: Motion,
    surface: Surface,
    readings: Readings,
) -> Rows:
    """Readings less the model, over the noise, and derivatives in the numbers.

    Gaps of the motion come last.
    """
    numbers = unpacked_convex(vector, surface.motion)
    directions, gaps = placed(numbers.motion)
    moved = jax.jacfwd(placed)(numbers.motion)
    light = _light_in_blocks(numbers, surface, directions)
    # The phase angle is that of the vectors in space: the motion does not change it, so
    # that `of_motion` has no part from the phase function.
    angles = jax.vmap(phase_angle)(readings.to_sun, readings.to_observer)
    phases = jax.vmap(_log_phase, (None, 0))(numbers.scattering, angles)
    of_phases = jax.vmap(jax.jacfwd(_log_phase), (None, 0))(numbers.scattering, angles)
    of_directions = jnp.stack([light.of_sun, light.of_observer], axis=1)
    of_motion = jnp.sum(of_directions[..., None] * moved.directions, axis=(1, 2))
    lambert = law_of(numbers.scattering).lambert
    # The readings are logarithms, whose derivatives are those of the light over it.
    inverse = 1 / light.value[:, None]
    # Lambert's weight is the first number of the scattering.
    of_lambert = jnp.pad(light.of_lambert[:, None] * lambert, ((0, 0), (0, 3)))
    slopes = jnp.concatenate(
        [
            of_motion * inverse,
            light.of_logarithms[:, :3] * inverse,
            of_phases + of_lambert * inverse,
            light.of_logarithms[:, 3:] * inverse,
        ],
        axis=1,
    )
    model = readings.projected(jnp.log(light.value) + phases)
    projected = jax.vmap(readings.projected, -1, -1)(slopes)
    of_gaps = jnp.pad(moved.gaps, ((0, 0), (0, vector.size - numbers.motion.size)))
    return Rows(
        residuals=jnp.concatenate([readings.values - model, gaps]),
        slopes=jnp.concatenate([-projected, of_gaps]),
    )


def convex_quadratic(
    vector: Float[Array, " numbers"],
    placed: Motion,
    surface: Surface,
    readings: Readings,
) -> Quadratic:
    """Chi-square of one lane and its derivatives, with closure and expectations."""
    residuals, slopes = convex_rows(vector, placed, surface, readings)
    sought = surface.sought
    of_shape = functools.partial(openness, surface=surface)
    shape = unpacked_convex(vector, surface.motion).shape
    gap = surface.closure * of_shape(shape)
    # Three results depend on many numbers, hence reverse mode.
    of_gap = surface.closure * jax.jacrev(of_shape)(shape)
    of_gap = jnp.pad(of_gap, ((0, 0), (vector.size - shape.size, 0)))
    # Numbers that are not sought never leave the centre, and add nothing.
    strain = surface.stiffness * (vector - surface.centre)
    rows = jnp.concatenate([residuals, gap])
    slopes = jnp.where(sought, jnp.concatenate([slopes, of_gap]), 0.0)
    stiffness = jnp.where(sought, surface.stiffness, 0.0)
    return Quadratic(
        chi_square=jnp.sum(rows * rows) + jnp.sum(strain * strain),
        slope=product("rn,r->n", slopes, rows) + stiffness * strain,
        normal=product("rn,rm->nm", slopes, slopes) + jnp.diag(stiffness**2),
    )


def spin_rows(
    vector: Float[Array, " numbers"],
    frame: Matrix,
    surface: Surface,
    readings: Readings,
) -> Rows:
    """`convex_rows` of a steady rotation, in the axes of a frame."""
    placed = functools.partial(_steady, frame=frame, readings=readings)
    return convex_rows(vector, placed, surface, readings)


def spin_quadratic(
    vector: Float[Array, " numbers"],
    frame: Matrix,
    surface: Surface,
    readings: Readings,
) -> Quadratic:
    """`convex_quadratic` of a steady rotation, in the axes of a frame."""
    placed = functools.partial(_steady, frame=frame, readings=readings)
    return convex_quadratic(vector, placed, surface, readings)
