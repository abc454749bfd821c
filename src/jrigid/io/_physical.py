"""Diagnosis of mass properties, and the nearest tensor that a body can have."""

import jax.numpy as jnp
import numpy as np

from jrigid._checks import INERTIA, shaped
from jrigid._core.compile import one_program
from jrigid._numerics import as_tensor
from jrigid._types import InertiaLike, Matrix, ScalarLike
from jrigid.mass import (
    MassProperties,
    inertia_of_second_moment,
    second_moment,
    tensor_function,
)

# Rounding that is allowed, in units of the trace, as MassProperties allows it.
_ULPS = 64
# Rounding that is allowed in the symmetry of a tensor, relative to its norm.
_ROUNDING = 1e-6
# What three digits in a file round, in units of the trace.
_DIGITS = 1e-3
# Radii of gyration of machines and their parts [m].
_SIZES = (1e-3, 10.0)
# A centre of mass so many radii of gyration away is rarely meant.
_FAR = 100.0
# About the origin m c^T S^-1 c is at most 1 whatever the body, and about the centre of
# mass 3 for a rod whose end is the origin, 5 for a ball that touches it. A tensor that
# is not real any more with the shift over 0.7 is taken for one about the origin.
_MISTAKEN = 0.7


def _is_real(tensor: np.ndarray) -> bool:
    """Whether the second moment of the mass is positive semi-definite, to rounding."""
    trace = np.trace(tensor)
    # The second moment is S = (tr I / 2) 1 - I.
    least = np.linalg.eigvalsh(0.5 * trace * np.eye(3) - tensor)[0]
    return bool(trace >= 0 and least >= -_ULPS * np.finfo(tensor.dtype).eps * trace)


def _shift(mass: float, center: np.ndarray) -> np.ndarray:
    """Tensor of a point of the whole mass in the centre of mass."""
    unit = np.eye(3, dtype=center.dtype)
    return mass * (center @ center * unit - np.outer(center, center))


def _explanations(tensor: np.ndarray, mass: float, center: np.ndarray) -> str:
    """Name the usual mistakes that would explain why no body has a tensor."""
    # In this order they are xx xy xz yy yz zz.
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
    return "".join(
        f" It is that of a body if {mistake}."
        for mistake, meant in guesses.items()
        if not np.allclose(meant, tensor) and _is_real(meant)
    )


def _why_not_real(tensor: np.ndarray, mass: float, center: np.ndarray) -> str:
    """Say why no body has a tensor, and what to do."""
    moments = np.linalg.eigvalsh(0.5 * (tensor + tensor.T))
    total = np.sum(moments)
    excess = 2 * moments[2] - total
    if moments[0] < 0:
        fault = "smallest is negative"
    else:
        fault = f"largest exceeds the sum of the others by {excess:.4g}"
    if 0 < excess < _DIGITS * total:
        why = " That is as little as rounding to few digits makes: write more digits."
    else:
        why = _explanations(tensor, mass, center)
    shown = ", ".join(f"{x:.4g}" for x in moments)
    distance = np.linalg.norm(np.asarray(nearest_physical(tensor)) - tensor)
    change = 100 * distance / (np.linalg.norm(tensor) or 1.0)
    return (
        f"The principal moments are {shown} kg m^2, of which the {fault}: no body has "
        f"them, as each is a sum of m (y^2 + z^2).{why} Else take it from the mesh "
        "(`jrigid.io.read_mesh`), or the nearest that a body has "
        f"(`jrigid.io.nearest_physical`), which changes it by {change:.3g} %."
    )


def faults(mass: float, center: np.ndarray, tensor: np.ndarray) -> tuple[str, ...]:
    """Say why no body has these mass properties, and what to do."""
    if not all(np.all(np.isfinite(x)) for x in (mass, center, tensor)):
        return ("A number is not finite: write it, or delete the whole inertial.",)
    found: list[str] = []
    if mass <= 0:
        found.append(
            f"The mass is {mass:.4g} kg, which is not positive: give a mass to what "
            "moves, and to a mere frame no inertial at all."
        )
    if np.linalg.norm(tensor - tensor.T) > _ROUNDING * np.linalg.norm(tensor):
        found.append("The tensor is not symmetric.")
    if not _is_real(tensor):
        found.append(_why_not_real(tensor, mass, center))
    return tuple(found)


def doubts(mass: float, center: np.ndarray, tensor: np.ndarray) -> tuple[str, ...]:
    """Say what looks mistaken in the numbers of a real body, and what to do."""
    if np.trace(tensor) <= 0:
        return ()
    # Half the trace is the sum of m r^2, with r the distance from the centre of mass.
    radius = np.sqrt(0.5 * np.trace(tensor) / mass)
    distance = np.linalg.norm(center)
    shift = _shift(mass, center)
    found: list[str] = []
    if np.array_equal(tensor, np.eye(3)):
        found.append(
            "The tensor is 1 kg m^2 about every axis, which programs write where they "
            "know none: take it from the mesh (`jrigid.io.read_mesh`)."
        )
    if not _SIZES[0] < radius < _SIZES[1]:
        found.append(
            f"The radius of gyration is {radius:.2g} m. If that is not about the size "
            "of the body, its units are not kg and kg m^2: it is "
            f"{1e-3 * radius:.2g} m if the tensor is in kg mm^2, "
            f"{1e-9**0.5 * radius:.2g} m if in g mm^2, {1e3**0.5 * radius:.2g} m if "
            "the mass is in g."
        )
    if distance > _FAR * radius:
        found.append(
            f"The centre of mass is {distance:.2g} m from the origin, "
            f"{distance / radius:.0f} radii of gyration: is it in mm?"
        )
    if _is_real(tensor - shift) and not _is_real(tensor - shift / _MISTAKEN):
        found.append(
            "The tensor may be about the origin of the link, not about the centre of "
            "mass as it should be: it is larger than the m (|d|^2 1 - d d^T) between "
            "them, by little. If so, `jrigid.to_center_of_mass(inertia, mass, "
            "center_of_mass)` mends it."
        )
    return tuple(found)


def values_of(body: MassProperties) -> tuple[float, np.ndarray, np.ndarray]:
    """The arguments of `faults` and `doubts`, in the precision of the body."""
    return float(body.mass), np.asarray(body.center_of_mass), np.asarray(body.inertia)


def diagnose(body: MassProperties | InertiaLike) -> tuple[str, ...]:
    """Say what is or looks wrong with the mass properties of a body, and what to do.

    Errors are what no real body can have: a mass that is not positive, a tensor with a
    negative moment or with I3 > I1 + I2. The text names the conventions, if any, in
    which the tensor would be that of a body: signs of the products, order of the six
    numbers, a shift between points made twice. If there is no error, the texts name
    what looks odd: a tensor about the link's origin instead of the centre of mass, or
    in other units.

    Args:
        body: As `jrigid.MassProperties.unchecked` makes it of any numbers, or moments
            or a tensor about the centre of mass [kg m^2].

    Returns:
        A text for each fault; an empty tuple if nothing is wrong.

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


@one_program
def nearest_physical(
    inertia: InertiaLike, mass: ScalarLike = 0.0, thickness: ScalarLike = 0.0
) -> Matrix:
    r"""The tensor of a real body that is nearest to any tensor.

    A tensor is that of a body if its second moment
    $S = \sum m r r^T = (tr I / 2) 1 - I$ has no negative principal moment. The nearest
    S in the Frobenius norm has the same axes, with 0 in place of negative moments. That
    body is flat. With a mass and a thickness the body is nowhere thinner than a plate
    of that thickness: no moment of S is below m h^2 / 12.

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
    tensor = as_tensor(tensor)
    tensor = 0.5 * (tensor + tensor.T)
    least = mass * thickness * thickness / 12
    added = tensor_function(lambda x: jnp.maximum(least - x, 0), second_moment(tensor))
    return tensor + inertia_of_second_moment(added)
