"""What is wrong with an inertia tensor, in words, and the nearest that a body can have."""

import jax.numpy as jnp
import numpy as np

from jrigid._checks import INERTIA, shaped
from jrigid._types import InertiaLike, Matrix, ScalarLike
from jrigid.mass import MassProperties, tensor_function

_ULPS = 64  # of the trace: as MassProperties allows
_DIGITS = 1e-3  # of the trace: what three digits in a file round
_ABOUT_ITS_END = 0.75  # see `_doubts`
_SIZES = 1e-3, 10.0  # radii of gyration of machines and their parts [m]
_UNITS = {"kg mm^2": 1e-6, "g cm^2": 1e-7, "g mm^2": 1e-9}
_FAR = 100.0  # radii of gyration


def _second_moment(tensor: np.ndarray) -> np.ndarray:
    """The tensor of sum m r r^T, which has no negative moment."""
    return 0.5 * np.trace(tensor) * np.eye(3) - tensor


def is_real(tensor: np.ndarray, ulps: float = _ULPS) -> bool:
    """Whether a body can have a tensor, to rounding."""
    slack = ulps * np.finfo(tensor.dtype).eps * abs(np.trace(tensor))
    return bool(np.trace(tensor) >= 0 and np.linalg.eigvalsh(_second_moment(tensor))[0] >= -slack)


def _steiner(place: np.ndarray) -> np.ndarray:
    return np.dot(place, place) * np.eye(3) - np.outer(place, place)


def _shown(*values: float) -> str:
    return ", ".join(f"{x:.4g}" for x in values)


def _explanations(tensor: np.ndarray, mass: float, center: np.ndarray) -> str:
    """What, if it were so, would make a tensor that no body has a real one."""
    (a, b, c), (_, d, e), (_, _, f) = tensor
    guesses = {
        "its products of inertia are negated (CAD programs print +sum m x y; ixy of URDF, MJCF and "
        "SDF is -sum m x y)": 2 * np.diag(np.diag(tensor)) - tensor,
        "its numbers are in the order xx yy zz xy xz yz of MJCF's `fullinertia` where ixx ixy ixz "
        "iyy iyz izz are asked for": np.array([[a, d, e], [d, b, f], [e, f, c]]),
        "its numbers are in the order xx xy xz yy yz zz where MJCF's `fullinertia` is xx yy zz xy "
        "xz yz": np.array([[a, d, f], [d, b, c], [f, c, e]]),
        "it was already about the centre of mass when m (|d|^2 1 - d d^T) was subtracted to bring "
        "it there (add it back)": tensor + mass * _steiner(center),
    }
    guesses = {k: x for k, x in guesses.items() if not np.allclose(x, tensor) and is_real(x)}
    return "".join(f" It is that of a body if {words}." for words in guesses)


def faults(mass: float, center: np.ndarray, tensor: np.ndarray) -> tuple[str, ...]:
    """Why no body has these, each with what to do."""
    if not all(np.all(np.isfinite(x)) for x in (mass, center, tensor)):
        return ("A number is not finite: write the missing ones, or delete the whole inertial.",)
    words = []
    if mass <= 0:
        words.append(
            f"The mass is {mass:.4g} kg, which is not positive: give what moves a mass, and a mere "
            "frame no inertial at all."
        )
    trace, largest = np.trace(tensor), np.max(np.abs(tensor))
    if np.max(np.abs(tensor - tensor.T)) > 1e-6 * largest:
        words.append("The tensor is not symmetric: ixy is both (1, 2) and (2, 1).")
    tensor = 0.5 * (tensor + tensor.T)
    if is_real(tensor):
        return tuple(words)
    moments = np.linalg.eigvalsh(tensor)
    over = moments[2] - moments[0] - moments[1]
    if moments[0] < 0:
        what = "of which one is negative"
    else:
        what = f"of which the largest exceeds the sum of the others by {over:.4g}"
    why = _explanations(tensor, mass, center)
    if 0 < over < _DIGITS * trace:
        why = " That is as little as rounding to few digits makes: write more digits."
    change = np.linalg.norm(_nearest(tensor) - tensor) / largest
    words.append(
        f"The principal moments are {_shown(*moments)} kg m^2, {what}: no body has them, as each "
        f"is a sum of m (y^2 + z^2).{why} Else take it from the mesh (`jrigid.io.read_mesh`), or "
        "the nearest that a body has (`jrigid.io.nearest_physical`), which changes it by "
        f"{100 * change:.2g} %."
    )
    return tuple(words)


def _nearest(tensor: np.ndarray) -> np.ndarray:
    return np.asarray(nearest_physical(tensor))


def doubts(mass: float, center: np.ndarray, tensor: np.ndarray) -> tuple[str, ...]:
    """What a real body's numbers look as though they were, each with what to do."""
    words = []
    if np.array_equal(tensor, np.eye(3)):
        words.append("The tensor is 1 kg m^2 about every axis, which programs write for none.")
    if mass <= 0 or np.trace(tensor) <= 0:
        return tuple(words)
    second = _second_moment(tensor)
    radius = float(np.sqrt(0.5 * np.trace(tensor) / mass))
    if not _SIZES[0] < radius < _SIZES[1]:
        units = ", ".join(f"{k} {radius * x**0.5:.2g} m" for k, x in _UNITS.items())
        words.append(
            f"The radius of gyration is {radius:.2g} m. If the body is not that large, its units "
            f"are not kg and kg m^2. Were the tensor in other units it would be: {units}; were the "
            f"mass in g: {radius * 1000**0.5:.2g} m."
        )
    distance = float(np.linalg.norm(center))
    if distance > _FAR * radius:
        words.append(
            f"The centre of mass is {distance:.2g} m from the origin, {distance / radius:.0f} "
            "radii of gyration: its unit may be mm."
        )
    # About the origin m c^T S^-1 c is below 1 whatever the body, and about the centre of mass 3
    # for a rod whose end is the origin, 5 for a ball that touches it.
    inside = mass * center @ np.linalg.pinv(second, hermitian=True) @ center
    if _ABOUT_ITS_END <= inside <= 1:
        words.append(
            "The tensor may be about the origin of the link, not about the centre of mass as it "
            "should be: it holds m (|d|^2 1 - d d^T) of the way between them. If so, "
            "`jrigid.to_center_of_mass(inertia, mass, center_of_mass)` mends it."
        )
    return tuple(words)


def diagnose(body: MassProperties | InertiaLike) -> tuple[str, ...]:
    """What is wrong, or looks wrong, with a body's mass properties, in words that say what to do.

    First what no real body can have: a mass that is not positive, a tensor with a negative moment
    or with I3 > I1 + I2, with the conventions, if any, in which it would be a body's (signs of the
    products, order of the six numbers, a shift between points made twice). Of what a body can
    have, what looks odd: about the link's origin instead of the centre of mass, in other units.

    Args:
        body: As `jrigid.MassProperties.unchecked` makes it of any numbers, or moments or a tensor
            about the centre of mass [kg m^2].

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
    known = float(body.mass), np.asarray(body.center_of_mass), np.asarray(body.inertia)
    return faults(*known) or doubts(*known)


def nearest_physical(
    inertia: InertiaLike, mass: ScalarLike = 0.0, thickness: ScalarLike = 0.0
) -> Matrix:
    r"""The tensor of a real body that is nearest to any tensor.

    A tensor is a body's if its second moment $S = \sum m r r^T = (tr I / 2) 1 - I$ has no negative
    principal moment. Of all such the one whose S is nearest in the Frobenius norm is taken: what is
    below 0 in S becomes 0, and its axes stay. That body is flat. With a mass and a thickness no
    direction is thinner than a plate of that thickness: no moment of S is below m h^2 / 12.

    Args:
        inertia: Moments or tensor [kg m^2]; of a tensor the symmetric part counts.
        mass: Mass [kg], for the thickness.
        thickness: Least thickness h [m], 0 for bodies that may be flat.

    Returns:
        The tensor [kg m^2], the same to the last bit if it was that of a body.

    Gradients: finite; right where no moment of S is at its least value.
    Source: N. Higham, Linear Algebra Appl. 103 (1988) 103-118; P. Wensing, S. Kim and J.-J.
    Slotine, IEEE Robotics and Automation Letters 3 (2018) 60-67.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diag(jr.io.nearest_physical(jnp.array([1.0, 1.0, 2.5]))))
    [1.25 1.25 2.5 ]
    """
    tensor, mass, thickness = shaped(
        inertia=(inertia, *INERTIA), mass=(mass,), thickness=(thickness,)
    )
    tensor = jnp.diag(tensor) if tensor.ndim == 1 else tensor
    tensor = 0.5 * (tensor + tensor.T)
    eye = jnp.eye(3, dtype=tensor.dtype)
    least = mass * thickness * thickness / 12
    second = 0.5 * jnp.trace(tensor) * eye - tensor
    added = tensor_function(lambda x: jnp.maximum(least - x, 0), second)
    return tensor + jnp.trace(added) * eye - added
