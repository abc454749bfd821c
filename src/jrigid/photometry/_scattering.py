"""Scattering laws: how much light a small piece of surface sends to the observer."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jrigid._checks import array_of_shape
from jrigid._types import Readable, Scalar


def _number(name: str, default: float) -> Any:  # to a type checker, its value
    """A field that holds one number."""
    return eqx.field(
        default=default, converter=lambda value: array_of_shape(name, value, ())
    )


class AbstractScattering(Readable):
    """Brightness of a unit of area, for cosines of the directions to Sun and observer.

    A subclass defines `of_area`, and `phase_factor` if the law depends on the phase
    angle, the angle between the two directions. `of_area` is called with cosines
    between 0 and 1: areas that are dark or not visible are left out by the caller.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> class Minnaert(jr.photometry.AbstractScattering):
    ...     exponent: float = 0.6
    ...
    ...     def of_area(self, cos_sun, cos_observer):
    ...         return cos_sun**self.exponent * cos_observer**self.exponent
    >>> print(Minnaert().of_area(jnp.array(1.0), jnp.array(1.0)))
    1.0
    """

    @abc.abstractmethod
    def of_area(
        self, cos_sun: Float[Array, "..."], cos_observer: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Brightness of a unit of area.

        Args:
            cos_sun: Cosines of the angles between the normal and the Sun, in (0, 1].
            cos_observer: Cosines of the angles between the normal and the observer, in
                (0, 1].
        """

    def phase_factor(self, phase_angle: Scalar) -> Scalar:
        """Factor of the brightness that depends on the phase angle [rad] alone."""
        return jnp.ones_like(phase_angle)


class Lambert(AbstractScattering):
    """A surface that looks equally bright from all sides: mu0 mu.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.photometry.Lambert().of_area(jnp.array(0.5), jnp.array(0.5)))
    0.25
    """

    def of_area(
        self, cos_sun: Float[Array, "..."], cos_observer: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Brightness of a unit of area."""
        return cos_sun * cos_observer


class LommelSeeliger(AbstractScattering):
    """Single scattering in a dark, porous surface: mu0 mu / (mu0 + mu).

    It describes most asteroids well.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.photometry.LommelSeeliger().of_area(jnp.array(0.5), jnp.array(0.5)))
    0.25
    """

    def of_area(
        self, cos_sun: Float[Array, "..."], cos_observer: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Brightness of a unit of area."""
        return cos_sun * cos_observer / (cos_sun + cos_observer)


class Geometric(AbstractScattering):
    """The projected area of what is lit and visible: mu.

    The brightness has a jump where a piece of surface turns out of the sunlight.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.photometry.Geometric().of_area(jnp.array(0.1), jnp.array(0.5)))
    0.5
    """

    def of_area(
        self, cos_sun: Float[Array, "..."], cos_observer: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Brightness of a unit of area."""
        shape = jnp.broadcast_shapes(cos_sun.shape, cos_observer.shape)
        return jnp.broadcast_to(cos_observer, shape)


class Mixture(AbstractScattering):
    """Lommel-Seeliger's law with a part of Lambert's, and a phase function.

    mu0 mu (1 / (mu0 + mu) + lambert) (1 + amplitude exp(-alpha / width) + slope alpha),
    where alpha is the phase angle. It is the law of DAMIT's models, for the phase
    angles from which its parameters were found: a negative slope makes the brightness
    negative beyond alpha = -1 / slope.

    Attributes:
        lambert: Weight of Lambert's law.
        amplitude: Size of the opposition effect.
        width: Its scale [rad].
        slope: Of the linear part [1/rad].

    Source: M. Kaasalainen, J. Torppa and K. Muinonen, Icarus 153 (2001) 37, eq. 8
    and 12.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> law = jr.photometry.Mixture(0.1, amplitude=0.5, width=0.1, slope=-0.5)
    >>> print(law.phase_factor(jnp.array(0.0)))
    1.5
    """

    lambert: Float[Array, ""] = _number("lambert", 0.1)
    amplitude: Float[Array, ""] = _number("amplitude", 0.0)
    width: Float[Array, ""] = _number("width", 0.1)
    slope: Float[Array, ""] = _number("slope", 0.0)

    def of_area(
        self, cos_sun: Float[Array, "..."], cos_observer: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Brightness of a unit of area."""
        return cos_sun * cos_observer * (1 / (cos_sun + cos_observer) + self.lambert)

    def phase_factor(self, phase_angle: Scalar) -> Scalar:
        """Factor of the brightness that depends on the phase angle [rad] alone."""
        opposition = self.amplitude * jnp.exp(-phase_angle / self.width)
        return 1 + opposition + self.slope * phase_angle
