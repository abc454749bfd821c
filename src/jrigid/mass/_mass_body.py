"""The mass properties of a body: checks, composition, motion."""

from typing import Any, final

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    check_shape,
    float_arrays,
    where_defined,
)
from jrigid._numerics import product
from jrigid._types import (
    InertiaLike,
    Matrix,
    Quaternion,
    QuaternionLike,
    Readable,
    ScalarLike,
    VectorLike,
)
from jrigid.mass._axes import (
    PrincipalAxes,
    body_arrays,
    is_physical,
    parallel_axis,
    principal_axes,
    steiner,
)
from jrigid.rotation import to_matrix

_NOT_A_BODY = (
    "Argument `inertia` must hold three finite, non-negative principal moments or be "
    "a finite, symmetric, positive semi-definite (3, 3) tensor, but it is not. "
    "(Three bodies are three lanes of `jax.vmap`, not the rows of a (3, 3) array.)"
)


@final
class MassProperties(Readable):
    """Mass, centre of mass and inertia tensor about it, of a real body.

    Thin bodies are bodies too: a plate may have I3 = I1 + I2, a rod one zero moment, a
    point three. `a + b` joins two bodies rigidly; both use the same coordinates. `sum`
    joins many. All results computed from a body of NaN are NaN.

    Attributes:
        mass: Mass [kg].
        center_of_mass: Coordinates of the centre of mass [m].
        inertia: Tensor about the centre of mass [kg m^2].

    >>> import jax.numpy as jnp, jrigid as jr
    >>> center = jnp.array([0.0, 0.0, 1.0])
    >>> rod = jr.MassProperties(3.0, center, jnp.array([1.0, 1.0, 0.0]))
    >>> print(rod.about(jnp.zeros(3)))
    [[4. 0. 0.]
     [0. 4. 0.]
     [0. 0. 0.]]
    """

    mass: Float[Array, ""]
    center_of_mass: Float[Array, "3"]
    inertia: Float[Array, "3 3"]

    def __init__(
        self,
        mass: ScalarLike,
        center_of_mass: VectorLike,
        inertia: InertiaLike,
        *,
        throw: bool = True,
    ) -> None:
        """Check and store; principal moments become a diagonal tensor.

        Args:
            mass: Mass [kg], positive.
            center_of_mass: Coordinates of the centre of mass [m].
            inertia: Moments or tensor about the centre of mass [kg m^2], positive
                semi-definite, with I3 <= I1 + I2, to rounding. It is stored
                symmetrised.
            throw: False: a bad value makes the body of its lane NaN instead of an
                error.

        Raises:
            RuntimeError: Mass not positive, a value not finite, a tensor that is not
                symmetric or has a negative moment or violates I3 <= I1 + I2.

        Gradients: the identity, on symmetric tensors.
        """
        values = body_arrays(inertia, mass, center_of_mass=center_of_mass)
        tensor, mass, center_of_mass = jax.lax.stop_gradient(values)
        findings = Findings()
        is_mass = (mass > 0) & jnp.isfinite(mass)
        findings.require(is_mass, RESULTS.invalid_mass, value=mass)
        message = "Argument `center_of_mass` must be finite, but it is not."
        findings.require(all_finite(center_of_mass), None, message, center_of_mass)
        is_positive, obeys_triangle = is_physical(tensor)
        findings.require(is_positive, None, _NOT_A_BODY, inertia)
        findings.require(obeys_triangle, RESULTS.unphysical_inertia, value=inertia)
        tensor, self.mass, self.center_of_mass = findings.guard(values, throw)
        # The check allows rounding, which would otherwise stay in the tensor.
        self.inertia = _symmetrised(tensor)

    @classmethod
    def unchecked(
        cls, mass: ScalarLike, center_of_mass: VectorLike, inertia: InertiaLike
    ) -> "MassProperties":
        """Make a body without checks, from values that a formula makes physical.

        Args:
            mass: Mass [kg].
            center_of_mass: Coordinates of the centre of mass [m].
            inertia: Moments or tensor about the centre of mass [kg m^2], stored
                symmetrised.

        Returns:
            The body; NaN stays NaN.

        Gradients: the identity, on symmetric tensors.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> print(jr.MassProperties.unchecked(1.0, jnp.zeros(3), jnp.ones(3)).mass)
        1.0
        """
        tensor, mass, center = body_arrays(inertia, mass, center_of_mass=center_of_mass)
        # equinox forbids a second constructor and assignments outside of the first.
        body = object.__new__(cls)
        object.__setattr__(body, "mass", mass)
        object.__setattr__(body, "center_of_mass", center)
        object.__setattr__(body, "inertia", _symmetrised(tensor))
        return body

    def about(self, point: VectorLike) -> Matrix:
        """Inertia tensor about any point.

        Args:
            point: Coordinates, not relative to the centre of mass [m].

        Returns:
            Tensor about the point, same axes [kg m^2].

        Gradients: polynomial, finite everywhere.
        Source: Goldstein, Classical Mechanics, 3rd ed., 5.3 (Steiner).

        >>> import jax.numpy as jnp, jrigid as jr
        >>> ball = jr.MassProperties(2.0, jnp.array([1.0, 0.0, 0.0]), jnp.ones(3))
        >>> print(ball.about(jnp.zeros(3))[2, 2])
        3.0
        """
        body, place = _in_one_dtype(self, point)
        check_shape("point", place, (3,))
        return parallel_axis(body.inertia, body.mass, place - body.center_of_mass)

    def translated(self, displacement: VectorLike) -> "MassProperties":
        """The body moved by a displacement, without turning it.

        Args:
            displacement: Added to the centre of mass [m].

        Returns:
            The moved body.

        Gradients: linear, finite everywhere.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> ball = jr.MassProperties(1.0, jnp.zeros(3), jnp.ones(3))
        >>> print(ball.translated(jnp.array([0.0, 2.0, 0.0])).center_of_mass)
        [0. 2. 0.]
        """
        body, shift = _in_one_dtype(self, displacement)
        check_shape("displacement", shift, (3,))
        center = body.center_of_mass + shift
        return MassProperties.unchecked(body.mass, center, body.inertia)

    def rotated(self, attitude: QuaternionLike) -> "MassProperties":
        """The body turned about the origin of the coordinates.

        Args:
            attitude: Quaternion of the turn; its norm drops out. Of a zero quaternion:
                NaN.

        Returns:
            The turned body: centre of mass R c, tensor R I R^T.

        Gradients: finite for any non-zero quaternion.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> rod = jr.solids.rod(1.0, 2.0).translated(jnp.array([0.0, 0.0, 1.0]))
        >>> turned = rod.rotated(jr.rotation.exp(jnp.array([jnp.pi, 0.0, 0.0])))
        >>> print(turned.center_of_mass.round(6)[2])
        -1.0
        """
        body, turn = _in_one_dtype(self, attitude)
        check_shape("attitude", turn, (4,))
        return _rotated(body, turn)

    def principal_axes(self) -> PrincipalAxes:
        """Principal moments and axes about the centre of mass.

        See `jrigid.principal_axes`.

        Returns:
            Moments and axes.

        Gradients: as those of `jrigid.principal_axes`.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> box = jr.solids.box(12.0, jnp.array([1.0, 2.0, 3.0]))
        >>> print(box.principal_axes().moments)
        [ 5. 10. 13.]
        """
        return principal_axes(self.inertia)

    def __add__(self, other: "MassProperties") -> "MassProperties":
        """Join two bodies rigidly."""
        if not isinstance(other, MassProperties):
            return NotImplemented
        return _joined(*_in_one_dtype(self, other))

    def __radd__(self, other: int) -> "MassProperties":
        """Return the body itself for 0, the start of `sum`."""
        if isinstance(other, int) and other == 0:
            return self
        return NotImplemented


def _symmetrised(tensor: Matrix) -> Matrix:
    # Halves first: the sum of the largest numbers would be infinite.
    return 0.5 * tensor + 0.5 * tensor.T


def _in_one_dtype(*trees: Any) -> Any:
    # Under strict promotion a float32 body and a float64 vector would be an error.
    leaves, structure = jtu.tree_flatten(trees, lambda x: isinstance(x, list))
    return jtu.tree_unflatten(structure, float_arrays(*leaves))


@jax.jit
def _rotated(body: MassProperties, attitude: Quaternion) -> MassProperties:
    def turned(body: MassProperties, attitude: Quaternion) -> MassProperties:
        turn = to_matrix(attitude)
        center = product("ij,j->i", turn, body.center_of_mass)
        tensor = product("ij,jk,lk->il", turn, body.inertia, turn)
        return MassProperties.unchecked(body.mass, center, tensor)

    # The rotation of a zero quaternion is 0 / 0.
    ok = all_finite((body, attitude)) & jnp.any(attitude != 0)
    return where_defined(ok, turned, body, attitude)


@jax.jit
def _joined(body: MassProperties, other: MassProperties) -> MassProperties:
    def joined(a: MassProperties, b: MassProperties) -> MassProperties:
        mass = a.mass + b.mass
        share = b.mass / mass
        # The difference comes first, so that bodies far from the origin lose no digits.
        apart = b.center_of_mass - a.center_of_mass
        # Both parallel-axis terms together are those of the reduced mass at the
        # distance.
        tensor = a.inertia + b.inertia + a.mass * share * steiner(apart)
        return MassProperties.unchecked(mass, a.center_of_mass + share * apart, tensor)

    return where_defined(all_finite((body, other)), joined, body, other)
