"""What is wrong with an inertia tensor, in words, and the nearest that a body can have."""

import jax.numpy as jnp
import numpy as np

from jrigid._checks import INERTIA, shaped
from jrigid._types import InertiaLike, Matrix, ScalarLike
from jrigid.mass import (
    MassProperties,
    inertia_of_second_moment,
    second_moment,
    tensor_function,
)

_ULPS = 64  # of the trace: as MassProperties allows
_ROUNDING = 1e-6  # of the tensor, in its symmetry
_DIGITS = 1e-3  # of the trace: what three digits in a file round
_SIZES = 1e-3, 10.0  # radii of gyration of machines and their parts [m]
_FAR = 100.0  # radii of gyration
# About the origin m c^T S^-1 c is at most 1 whatever the body, and about the centre of
# mass 3 for a rod whose end is the origin, 5 for a ball that touches it: 3/4 and 5/6
# where they are mistaken.
_MISTAKEN = 0.7


def _is_real(tensor: np.ndarray) -> bool:
    """Whether no principal moment of the second moment of mass is below 0, to rounding."""
    trace = np.trace(tensor)
    least = np.linalg.eigvalsh(0.5 * trace * np.eye(3) - tensor)[0]
    return bool(trace >= 0 and least >= -_ULPS * np.finfo(tensor.dtype).eps * trace)


def _shift(mass: float, center: np.ndarray) -> np.ndarray:
    return mass * (
        center @ center * np.eye(3, dtype=center.dtype) - np.outer(center, center)
    )


def _explanations(tensor: np.ndarray, mass: float, center: np.ndarray) -> str:
    """What, if it were so, would make a tensor that no body has a real one."""
    (a, b, c), (_, d, e), (_, _, f) = tensor
    guesses = {
        "its products of inertia are negated (CAD programs print +sum m x y; ixy of "
        "URDF, MJCF and SDF is -sum m x y)": 2 * np.diag(np.diag(tensor)) - tensor,
        "its numbers are in the order xx yy zz xy xz yz of MJCF's `fullinertia` "
        "where ixx ixy ixz iyy iyz izz are asked for": np.array(
            [[a, d, e], [d, b, f], [e, f, c]]
        ),
        "its numbers are in the order xx xy xz yy yz zz where MJCF's `fullinertia` "
        "is xx yy zz xy xz yz": np.array([[a, d, f], [d, b, c], [f, c, e]]),
        "it was already about the centre of mass when m (|d|^2 1 - d d^T) was "
        "subtracted to bring it there (add it back)": tensor + _shift(mass, center),
    }
    guesses = {
        k: x for k, x in guesses.items() if not np.allclose(x, tensor) and _is_real(x)
    }
    return "".join(f" It is that of a body if {words}." for words in guesses)


def faults(mass: float, center: np.ndarray, tensor: np.ndarray) -> tuple[str, ...]:
    """Why no body has these, each with what to do."""
    if not all(np.all(np.isfinite(x)) for x in (mass, center, tensor)):
        return ("A number is not finite: write it, or delete the whole inertial.",)
    moments = np.linalg.eigvalsh(0.5 * (tensor + tensor.T))
    shown, over = (
        ", ".join(f"{x:.4g}" for x in moments),
        2 * moments[2] - np.sum(moments),
    )
    what = f"largest exceeds the sum of the others by {over:.4g}"
    what = "smallest is negative" if moments[0] < 0 else what
    why = _explanations(tensor, mass, center)
    if 0 < over < _DIGITS * np.sum(moments):
        why = " That is as little as rounding to few digits makes: write more digits."
    size = np.linalg.norm(tensor)
    change = (
        100
        * np.linalg.norm(np.asarray(nearest_physical(tensor)) - tensor)
        / (size or 1.0)
    )
    words = {
        f"The mass is {mass:.4g} kg, which is not positive: give a mass to what "
        "moves, and to a mere frame no inertial at all.": mass <= 0,
        "The tensor is not symmetric.": np.linalg.norm(tensor - tensor.T)
        > _ROUNDING * size,
        f"The principal moments are {shown} kg m^2, of which the {what}: no body has "
        f"them, as each is a sum of m (y^2 + z^2).{why} Else take it from the mesh "
        "(`jrigid.io.read_mesh`), or the nearest that a body has "
        f"(`jrigid.io.nearest_physical`), which changes it by {change:.3g} %.": not _is_real(
            tensor
        ),
    }
    return tuple(text for text, wrong in words.items() if wrong)


def doubts(mass: float, center: np.ndarray, tensor: np.ndarray) -> tuple[str, ...]:
    """What a real body's numbers look as though they were, each with what to do."""
    if np.trace(tensor) <= 0:
        return ()
    radius, distance = np.sqrt(0.5 * np.trace(tensor) / mass), np.linalg.norm(center)
    shift = _shift(mass, center)
    mistaken = _is_real(tensor - shift) and not _is_real(tensor - shift / _MISTAKEN)
    words = {
        "The tensor is 1 kg m^2 about every axis, which programs write where they "
        "know none: take it from the mesh (`jrigid.io.read_mesh`).": np.array_equal(
            tensor, np.eye(3)
        ),
        f"The radius of gyration is {radius:.2g} m. If that is not about the size of "
        f"the body, its units are not kg and kg m^2: it is {1e-3 * radius:.2g} m if "
        f"the tensor is in kg mm^2, {1e-9**0.5 * radius:.2g} m if in g mm^2, "
        f"{1e3**0.5 * radius:.2g} m if the mass is in g.": not _SIZES[0]
        < radius
        < _SIZES[1],
        f"The centre of mass is {distance:.2g} m from the origin, "
        f"{distance / radius:.0f} radii of gyration: is it in mm?": distance
        > _FAR * radius,
        "The tensor may be about the origin of the link, not about the centre of "
        "mass as it should be: it is larger than the m (|d|^2 1 - d d^T) between "
        "them, by little. If so, `jrigid.to_center_of_mass(inertia, mass, "
        "center_of_mass)` mends it.": mistaken,
    }
    return tuple(text for text, odd in words.items() if odd)


def values_of(body: MassProperties) -> tuple[float, np.ndarray, np.ndarray]:
    """What `faults` and `doubts` judge, in the precision of the body."""
    return float(body.mass), np.asarray(body.center_of_mass), np.asarray(body.inertia)


def diagnose(body: MassProperties | InertiaLike) -> tuple[str, ...]:
    """What is wrong, or looks wrong, with a body's mass properties, in words that say what to do.

    First what no real body can have: a mass that is not positive, a tensor with a
    negative moment or with I3 > I1 + I2, with the conventions, if any, in which it
    would be a body's (signs of the products, order of the six numbers, a shift between
    points made twice). Of what a body can have, what looks odd: about the link's origin
    instead of the centre of mass, in other units.

    Args:
        body: As `jrigid.MassProperties.unchecked` makes it of any numbers, or moments
            or a tensor about the centre of mass [kg m^2].

    Returns:
        A text for each point; none, if nothing is wrong.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> [text] = jr.io.diagnose(jnp.array([1.0, 1.0, 2.5]))
    >>> print(text.partition(", of")[0])
    The principal moments are 1, 1, 2.5 kg m^2
    >>> jr.io.diagnose(jr.solids.sphere(1.0, 0.1))
    ()
    """
    if not isinstance(body, MassProperties):
        (inertia,) = shaped(inertia=(body, *INERTIA))
        tensor = np.asarray(jnp.diag(inertia) if inertia.ndim == 1 else inertia)
        return faults(1.0, np.zeros(3), tensor)
    known = values_of(body)
    return faults(*known) or doubts(*known)


def nearest_physical(
    inertia: InertiaLike, mass: ScalarLike = 0.0, thickness: ScalarLike = 0.0
) -> Matrix:
    r"""The tensor of a real body that is nearest to any tensor.

    A tensor is a body's if its second moment $S = \sum m r r^T = (tr I / 2) 1 - I$ has
    no negative principal moment. Of all such the one whose S is nearest in the
    Frobenius norm is taken: what is below 0 in S becomes 0, and its axes stay. That
    body is flat. With a mass and a thickness no direction is thinner than a plate of
    that thickness: no moment of S is below m h^2 / 12.

    Args:
        inertia: Moments or tensor [kg m^2]; of a tensor the symmetric part counts.
        mass: Mass [kg], for the thickness.
        thickness: Least thickness h [m], 0 for bodies that may be flat.

    Returns:
        The tensor [kg m^2], the same to the last bit if it was that of a body.

    Gradients: finite; right where no moment of S is at its least value.
    Source: N. Higham, Linear Algebra Appl. 103 (1988) 103-118; P. Wensing, S. Kim and
    J.-J. Slotine, IEEE Robotics and Automation Letters 3 (2018) 60-67.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.io.nearest_physical(jnp.array([1.0, 1.0, 2.5]))))
    [1.25 1.25 2.5 ]
    """
    known = {"inertia": (inertia, *INERTIA), "mass": (mass,), "thickness": (thickness,)}
    tensor, mass, thickness = shaped(**known)
    tensor = jnp.diag(tensor) if tensor.ndim == 1 else tensor
    tensor = 0.5 * (tensor + tensor.T)
    least = mass * thickness * thickness / 12
    added = tensor_function(lambda x: jnp.maximum(least - x, 0), second_moment(tensor))
    return tensor + inertia_of_second_moment(added)
