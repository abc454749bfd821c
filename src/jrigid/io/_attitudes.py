"""Attitudes of other packages: scipy, jaxlie, SPICE; modified Rodrigues parameters."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._checks import array_of_shape, check_shape, demand, float_arrays
from jrigid._extra import extra
from jrigid._types import Quaternion, QuaternionLike, Real, Vector, VectorLike
from jrigid.rotation import conjugate

Attitudes = Real[Any, "*batch 4"]
Positions = Real[Any, "*batch 3"]
Pose = tuple[Float[Array, "*batch 4"], Float[Array, "*batch 3"]]


def _one_of(kinds: str, rotation: object, method: str) -> None:
    """Raise ValueError unless a rotation has the method of these kinds."""
    # By its method, not its type: the package need not be imported for that.
    kind = type(rotation).__name__
    demand(
        hasattr(rotation, method),
        f"Argument `rotation` must be {kinds}, but it is a {kind}.",
    )


def _arrays(attitude: Attitudes, position: Positions | None) -> tuple[Array, ...]:
    """Convert attitudes, and as many positions if there are any."""
    arrays = float_arrays(*(x for x in (attitude, position) if x is not None))
    # Without a position there is one array for two names.
    for name, length, x in zip(("attitude", "position"), (4, 3), arrays, strict=False):
        check_shape(name, x, (*arrays[0].shape[:-1], length))
    return arrays


def to_scipy(attitude: Attitudes, position: Positions | None = None) -> Any:
    """Convert attitudes to scipy's rotations, or with positions to rigid transforms.

    `jrigid.rotation.to_scipy` gives the scalar-last quaternion alone, under jit too.

    Args:
        attitude: Quaternions, scalar first; their norm drops out.
        position: Of the body's origin, space components [m].

    Returns:
        A `scipy.spatial.transform.Rotation`, or a `RigidTransform` (scipy 1.16), of as
        many.

    Raises:
        ValueError: An attitude has other than four numbers, or there are not three
            numbers of a position for each attitude.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> turn = jr.io.to_scipy(jr.rotation.exp(jnp.array([0.0, 0.0, jnp.pi / 2])))
    >>> print(turn.as_rotvec(degrees=True).round(6))
    [ 0.  0. 90.]
    """
    transform = extra("io", "scipy.spatial.transform")
    quaternions = np.asarray(_arrays(attitude, position)[0])
    # Quaternions of scipy have the scalar last.
    turn = transform.Rotation.from_quat(np.roll(quaternions, -1, -1))
    if position is None:
        return turn
    return transform.RigidTransform.from_components(np.asarray(position), turn)


def from_scipy(rotation: Any) -> Float[Array, "*batch 4"] | Pose:
    """Attitudes of scipy's rotations, with positions of its rigid transforms.

    Args:
        rotation: `Rotation` or `RigidTransform`, of one or many, taken as body to
            space.

    Returns:
        Unit quaternions, scalar first; of a `RigidTransform` (attitude, position).

    Raises:
        ValueError: `rotation` is neither.

    >>> import jrigid as jr
    >>> from scipy.spatial.transform import Rotation
    >>> turns = Rotation.from_rotvec([[0, 0, 0], [180, 0, 0]], degrees=True)
    >>> print(jr.io.from_scipy(turns).round(6))
    [[1. 0. 0. 0.]
     [0. 1. 0. 0.]]
    """
    # `RigidTransform` came with scipy 1.16, and older versions have no such type.
    turn = rotation.rotation if hasattr(rotation, "translation") else rotation
    _one_of("a scipy.spatial.transform.Rotation or RigidTransform", turn, "as_quat")
    attitude = jnp.roll(jnp.asarray(turn.as_quat()), 1, axis=-1)
    if turn is rotation:
        return attitude
    return attitude, jnp.asarray(rotation.translation)


def to_jaxlie(attitude: Attitudes, position: Positions | None = None) -> Any:
    """Convert attitudes to rotations of jaxlie, or with positions to rigid transforms.

    Quaternions of jaxlie are scalar first, too.

    Args:
        attitude: Unit quaternions, scalar first, body to space.
        position: Of the body's origin, space components [m].

    Returns:
        A `jaxlie.SO3` or `jaxlie.SE3`; `apply` takes body components to space
        components.

    Raises:
        ValueError: An attitude has other than four numbers, or there are not three
            numbers of a position for each attitude.

    Gradients: the identity.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> turn = jr.io.to_jaxlie(jnp.array([0.0, 0.0, 0.0, 1.0]))
    >>> print(turn.apply(jnp.array([1.0, 2.0, 3.0])))
    [-1. -2.  3.]
    """
    jaxlie = extra("io", "jaxlie")
    arrays = _arrays(attitude, position)
    if position is None:
        return jaxlie.SO3(wxyz=arrays[0])
    return jaxlie.SE3(wxyz_xyz=jnp.concatenate(arrays, axis=-1))


def from_jaxlie(rotation: Any) -> Float[Array, "*batch 4"] | Pose:
    """Attitudes of rotations of jaxlie, with positions of its rigid transforms.

    Args:
        rotation: `jaxlie.SO3` or `jaxlie.SE3`, of one or many, taken as body to space.

    Returns:
        Unit quaternions, scalar first; of an `SE3` (attitude, position).

    Raises:
        ValueError: `rotation` is neither.

    Gradients: the identity.

    >>> import jaxlie, jrigid as jr
    >>> print(jr.io.from_jaxlie(jaxlie.SO3.from_x_radians(3.14159265)).round(6))
    [0. 1. 0. 0.]
    """
    if hasattr(rotation, "wxyz_xyz"):
        return rotation.wxyz_xyz[..., :4], rotation.wxyz_xyz[..., 4:]
    _one_of("a jaxlie.SO3 or jaxlie.SE3", rotation, "wxyz")
    return rotation.wxyz


def to_spice(attitude: QuaternionLike) -> Quaternion:
    """SPICE's quaternion of a C-matrix, `m2q(C)` with C from space to body.

    SPICE is scalar first with Hamilton's product, as here, but its C-matrix takes
    components in the reference frame to the instrument's: the conjugate. Its angular
    velocities are in components of the reference frame:
    `jrigid.rotation.rotate(attitude, omega)`.

    Args:
        attitude: Unit quaternion, body to space.

    Returns:
        The quaternion of a C-kernel.

    Gradients: linear, finite everywhere.
    Source: NAIF, Rotation Required Reading, "SPICE Quaternions"; CK Required Reading.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.io.to_spice(jnp.array([0.6, 0.0, 0.0, 0.8])))
    [ 0.6 -0.  -0.  -0.8]
    """
    return conjugate(attitude)


def from_spice(quaternion: QuaternionLike) -> Quaternion:
    """Attitude of SPICE's quaternion of a C-matrix; see `to_spice`.

    Args:
        quaternion: As `spiceypy.m2q(C)` gives it, C from the reference frame to the
            body's.

    Returns:
        Unit quaternion, scalar first, body to space.

    Gradients: linear, finite everywhere.
    Source: NAIF, Rotation Required Reading, "SPICE Quaternions".

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.io.from_spice(jnp.array([0.6, 0.0, 0.0, -0.8])))
    [ 0.6 -0.  -0.   0.8]
    """
    return conjugate(quaternion)


def to_mrp(attitude: QuaternionLike) -> Vector:
    """Modified Rodrigues parameters, axis times tan(angle / 4), of the shorter turn.

    The other set, of the turn the other way round, is `shadow_mrp` of it.

    Args:
        attitude: Quaternion, body to space; its norm drops out, and q and -q give the
            same.

    Returns:
        Parameters, of length at most 1; NaN of the zero quaternion.

    Gradients: finite everywhere. At a half turn (w = 0, length 1) the value jumps to
    its shadow. The derivatives there are those of the set that is returned.
    Source: H. Schaub and J. Junkins, J. Astronautical Sciences 44 (1996) 1-19.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.io.to_mrp(jr.rotation.exp(jnp.array([0.0, 0.0, jnp.pi]))).round(6))
    [0. 0. 1.]
    """
    q = array_of_shape("attitude", attitude, 4)
    # Of q and -q, the same attitude, w >= 0 is the shorter turn. It also keeps the sum
    # below away from 0.
    q = jnp.where(q[0] < 0, -q, q)
    # tan(a / 4) = sin(a / 2) / (1 + cos(a / 2)), with the norm in place of 1.
    return q[1:] / (q[0] + jnp.sqrt(jnp.sum(q * q)))


def shadow_mrp(mrp: VectorLike) -> Vector:
    """The other modified Rodrigues parameters of the same attitude, -mrp / |mrp|^2.

    A record that goes through half a turn stays smooth in one set and jumps in the
    shorter one.

    Args:
        mrp: Parameters of either set. Those of the identity, zeros, give NaN: their
            shadow is infinite.

    Returns:
        Parameters of the other set.

    Gradients: finite except at zero.
    Source: H. Schaub and J. Junkins, J. Astronautical Sciences 44 (1996) 1-19.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.io.shadow_mrp(jnp.array([0.0, 0.0, 0.5])))
    [-0. -0. -2.]
    """
    p = array_of_shape("mrp", mrp, 3)
    return -p / jnp.sum(p * p)


def from_mrp(mrp: VectorLike) -> Quaternion:
    """Attitude of modified Rodrigues parameters, of either set.

    Args:
        mrp: Axis times tan(angle / 4), body to space.

    Returns:
        Unit quaternion, w < 0 where the parameters are longer than 1.

    Gradients: analytic everywhere.
    Source: H. Schaub and J. Junkins, J. Astronautical Sciences 44 (1996) 1-19.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.io.from_mrp(jnp.array([0.0, 1.0, 0.0])))
    [0. 0. 1. 0.]
    """
    p = array_of_shape("mrp", mrp, 3)
    square = jnp.sum(p * p)
    # With t = tan(a / 4), cos(a / 2) is (1 - t^2) / (1 + t^2), and sin(a / 2) is
    # 2 t / (1 + t^2).
    return jnp.concatenate([(1 - square)[None], 2 * p]) / (1 + square)
