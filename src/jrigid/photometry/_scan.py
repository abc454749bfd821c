"""Chi-square of many tumblers at once: where a search begins.

A scan looks at one block of epochs: more do not change which starting points are best.

The motion of a lane serves all directions of the momentum in space and all angles of
precession, since these only turn the directions of the Sun and of the observer.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._numerics import product
from jrigid._types import Vector
from jrigid.photometry._curve_readings import EPOCHS, Readings, filled, orthonormal
from jrigid.photometry._ellipsoid import lommel_seeliger_brightness
from jrigid.photometry._model import (
    Task,
    directions_of_axes,
    geometry_of,
    unpacked,
)

POLES = 24
ANGLES = 8
_LANES = 4  # motions at once: each has all directions as lanes of its own


def attitudes_tried() -> Float[np.ndarray, "many 3 3"]:
    """Axes with z along the momentum, rows in space: even poles, and turns about them.

    Those of one pole follow each other.
    """
    # Imported where it is used: scipy takes a second, which `import jrigid` must not.
    from scipy.spatial.transform import Rotation

    index = np.arange(POLES) + 0.5
    # Equal steps of the sine of the latitude are equal areas of the sphere, and the
    # golden ratio spreads the longitudes.
    latitude = np.arcsin(1 - 2 * index / POLES)
    longitude = np.pi * (1 + 5**0.5) * index
    turns = 2 * np.pi * np.arange(ANGLES) / ANGLES
    angles = [
        (b, np.pi / 2 - a, turn)
        for a, b in zip(latitude, longitude, strict=True)
        for turn in turns
    ]
    return Rotation.from_euler("ZYZ", angles).inv().as_matrix()


def fewer_epochs(readings: Readings, count: int = EPOCHS) -> Readings:
    """So many of the epochs, evenly chosen, with the basis of their own."""
    there = np.flatnonzero(readings.weights)
    even = np.linspace(0, len(there) - 1, min(count, len(there)))
    chosen = there[even.astype(int)]
    basis = orthonormal(readings.basis[chosen])
    values = readings.values[chosen]
    few = Readings(
        ts=readings.ts[chosen],
        to_sun=readings.to_sun[chosen],
        to_observer=readings.to_observer[chosen],
        values=values - basis @ (basis.T @ values),
        weights=readings.weights[chosen],
        basis=basis,
        span=readings.span,
    )
    return filled(few)


@jax.jit
def scanned(
    numbers: Float[Array, "lanes 11"],
    tasks: Task,
    turned: Float[Array, "many 3 3"],
    readings: Readings,
) -> Float[Array, "lanes many"]:
    """Chi-square of each lane in all attitudes, in single precision.

    Args:
        numbers: Their poles and angles of precession are not used.
        tasks: One for each lane; the frame is not used.
        turned: Orientations to try.
        readings: A part of the light curves.
    """
    to_sun = product("dij,ej->dei", turned, readings.to_sun).astype(jnp.float32)
    to_observer = product("dij,ej->dei", turned, readings.to_observer)
    to_observer = to_observer.astype(jnp.float32)
    few = jax.tree.map(lambda x: x.astype(jnp.float32), readings)
    times = readings.ts / readings.span

    def of_lane(lane: tuple[Array, Task]) -> Array:
        vector, task = lane
        geometry = geometry_of(unpacked(vector), task)
        of_time = functools.partial(directions_of_axes, geometry, task.mode)
        # The phases count many turns and are evaluated in full precision. Directions
        # need less.
        axes = jax.vmap(of_time)(times).astype(jnp.float32)
        semi_axes = geometry.axes.astype(jnp.float32)
        each = functools.partial(_chi_square, semi_axes, axes, few)
        values = jax.vmap(each)(to_sun, to_observer)
        return jnp.where(jnp.isfinite(values), values, jnp.inf)

    return jax.lax.map(of_lane, (numbers, tasks), batch_size=_LANES)


def _chi_square(
    semi_axes: Vector,
    axes: Float[Array, "epochs 3 3"],
    readings: Readings,
    to_sun: Float[Array, "epochs 3"],
    to_observer: Float[Array, "epochs 3"],
) -> Float[Array, ""]:
    """Chi-square of one orientation."""
    sun = jnp.einsum("eij,ej->ei", axes, to_sun)
    observer = jnp.einsum("eij,ej->ei", axes, to_observer)
    each = jax.vmap(lommel_seeliger_brightness, (None, 0, 0))
    rows = readings.values - readings.projected(jnp.log(each(semi_axes, sun, observer)))
    return jnp.sum(rows * rows)


def frame_of(turned: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Axes of a fit for an orientation: its pole lies on the x axis.

    With longitude, latitude and angle of precession 0 in these axes the body has the
    given orientation.
    """
    # Longitude 0 and latitude 0 put the axis "south" along -z and "along" along x.
    return np.stack([turned[2], turned[1], -turned[0]])
