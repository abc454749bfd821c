"""Argument checks: shapes at trace time, values at run time, and the result codes they set."""

from collections.abc import Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float


class RESULTS(diffrax.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """What became of a computation: `diffrax.RESULTS` and the ways an input can be wrong."""

    invalid_inertia = (
        "Argument `inertia` must hold three positive, finite principal moments or be a finite, "
        "symmetric, positive definite (3, 3) tensor, but it is not. (Three bodies are three lanes "
        "of `jax.vmap`, not the rows of a (3, 3) array.)"
    )
    unphysical_inertia = (
        "Argument `inertia` must be the tensor of a real body, whose principal moments satisfy "
        "I3 <= I1 + I2, but they do not."
    )
    invalid_mass = "Argument `mass` must be positive and finite, but it is not."
    invalid_masses = (
        "Argument `masses` must be finite and non-negative, with a positive sum, but it is not."
    )
    invalid_position = "Argument `positions` must be finite, but it is not."
    invalid_density = (
        "Argument `density` must be finite and non-negative, with a positive integral over a box "
        "with `lower` < `upper`, but it is not."
    )
    open_mesh = (
        "Argument `faces` must describe a closed surface in which every edge is shared by two "
        "faces that run through it in opposite directions, but an edge is not."
    )
    inside_out_mesh = (
        "Argument `faces` must be ordered counter-clockwise seen from outside, enclosing a "
        "positive volume, but the enclosed volume is not positive: the mesh is inside out or flat."
    )
    invalid_torque = (
        "A parameter of a torque must be finite, and masses, moments, couplings and drag "
        "coefficients must not be negative, but one is."
    )
    invalid_length = (
        "The lengths of a solid must be positive and finite, and fit together, but they do not."
    )
    invalid_attitude = (
        "Argument `attitude` must be a unit quaternion, but its norm is not 1: "
        "use `jrigid.rotation.normalize`."
    )
    invalid_state = "Argument `state0` must be finite, but a component is not."
    invalid_times = (
        "Argument `ts` must be finite, non-decreasing and not earlier than `t0`, but it is not."
    )
    invalid_max_step = "Argument `max_step` must be positive, but it is not."
    invalid_vector_field = (
        "Argument `system` must have a finite vector field at the initial state, but it is not: "
        "a torque, force or parameter is NaN or infinite there."
    )
    nonfinite_state = "The motion ran out of the range of floating point numbers."
    no_equilibrium = (
        "Argument `state` must be an equilibrium in a frame in which the system does not change, "
        "but it is not."
    )
    inaccurate = (
        "Arguments `steps` or `step` must be fine enough for the accuracy of the motion, but they "
        "are not."
    )
    invalid_tolerance = (
        "Arguments `rtol` and `atol` must be below 1 and at least 1e-14 (1e-7 in float32), but "
        "one is not."
    )


def float_arrays(*values: Any) -> tuple[Array, ...]:
    """Convert to arrays of one floating point dtype, that of the inputs taken together."""
    values = tuple(v if eqx.is_array_like(v) else np.asarray(v) for v in values)
    with jax.numpy_dtype_promotion("standard"):
        dtype = jnp.result_type(*values, float)
    return tuple(jnp.asarray(value, dtype) for value in values)


def state_array(value: Any) -> Any:
    """A floating point array; None and integers pass, for the `in_axes` of a state under vmap."""
    return value if value is None or isinstance(value, int) else float_arrays(value)[0]


def internal_parts(internal: Any) -> Any:
    """An internal state; None for `()`, which diffrax cannot save (equinox takes it for a leaf)."""
    return None if isinstance(internal, tuple) and not internal else internal


def check_shape(name: str, value: Array | np.ndarray, shape: tuple[int | None, ...]) -> None:
    """Raise ValueError unless `value` has the shape; None stands for any length."""
    fits = value.ndim == len(shape) and all(
        want is None or have == want for have, want in zip(value.shape, shape, strict=True)
    )
    if not fits:
        wanted = "(" + ", ".join("n" if n is None else str(n) for n in shape)
        wanted += ",)" if len(shape) == 1 else ")"
        raise ValueError(
            f"Argument `{name}` must have shape {wanted}, but it has shape {value.shape}."
        )


def array_of_shape(name: str, value: Any, *shape: int | None) -> Array:
    """Convert to a floating point array, or raise ValueError if the shape is wrong."""
    (array,) = float_arrays(value)
    check_shape(name, array, shape)
    return array


def pair_of_shapes(
    name_a: str,
    a: Any,
    shape_a: tuple[int | None, ...],
    name_b: str,
    b: Any,
    shape_b: tuple[int | None, ...],
) -> tuple[Array, Array]:
    """Convert two arguments to one dtype, or raise ValueError if a shape is wrong."""
    array_a, array_b = float_arrays(a, b)
    check_shape(name_a, array_a, shape_a)
    check_shape(name_b, array_b, shape_b)
    return array_a, array_b


def check_inertia_shape(inertia: Array, name: str = "inertia") -> None:
    """Raise ValueError unless `inertia` is three moments or a (3, 3) tensor."""
    if inertia.shape not in ((3,), (3, 3)):
        raise ValueError(
            f"Argument `{name}` must have shape (3,) or (3, 3), but it has shape {inertia.shape}."
        )


def check_option(name: str, value: Any, options: Sequence[Any]) -> None:
    """Raise ValueError unless `value` is one of `options`."""
    if value not in options:
        listed = ", ".join(repr(option) for option in options)
        raise ValueError(f"Argument `{name}` must be one of {listed}, but it is {value!r}.")


def all_finite(tree: Any) -> Bool[Array, ""]:
    """True where every inexact leaf of a pytree is finite."""
    leaves = [x for x in jtu.tree_leaves(tree) if eqx.is_inexact_array(x)]
    ok = jnp.array(True)
    for leaf in leaves:
        ok = ok & jnp.all(jnp.isfinite(leaf))
    return ok


def is_unit(quaternion: Float[Array, "4"]) -> Bool[Array, ""]:
    """True where a quaternion is of norm 1 to rounding, be it float32's in float64.

    Four digits typed by hand are not in float64.
    """
    excess = jnp.abs(jnp.sum(quaternion**2) - 1)
    return excess < max(300 * float(jnp.finfo(quaternion.dtype).eps), 4.5e-7)


def is_symmetric(tensor: Float[Array, "3 3"]) -> Bool[Array, ""]:
    """True where a tensor equals its transpose to rounding."""
    tolerance = 64 * jnp.finfo(tensor.dtype).eps * jnp.max(jnp.abs(tensor))
    return jnp.all(jnp.abs(tensor - tensor.T) <= tolerance)


def of_unit_size(
    tensor: Float[Array, "3 3"], *others: Float[Array, "3 3"]
) -> tuple[Float[Array, "3 3"], ...]:
    """Divide tensors by the largest magnitude of the first one's entries, unless 0 or infinite."""
    largest = jnp.max(jnp.abs(tensor))
    # In two steps: XLA flushes the reciprocals of the largest numbers to zero.
    step = jnp.where(largest > 1, 1 / 256, 256).astype(tensor.dtype)
    usable = (largest > 0) & jnp.isfinite(largest)
    divisor = jnp.where(usable, largest * step, 1.0)
    return tuple(x * step / divisor for x in (tensor, *others))


def is_positive_definite(tensor: Float[Array, "3 3"]) -> Bool[Array, ""]:
    """True where the pivots of a symmetric tensor, of whatever scale, are positive."""
    (a, d, e), (_, b, f), (_, _, c) = of_unit_size(tensor)[0]
    first = jnp.where(a > 0, a, 1.0)
    b, c, f = b - d * (d / first), c - e * (e / first), f - d * (e / first)
    second = jnp.where(b > 0, b, 1.0)
    return (a > 0) & (b > 0) & (c - f * (f / second) > 0)


def is_inertia(inertia: Array) -> Bool[Array, ""]:
    """True where moments or a tensor can drive the dynamics: finite, symmetric, positive."""
    inertia = jax.lax.stop_gradient(inertia)
    if inertia.ndim == 1:
        return all_finite(inertia) & jnp.all(inertia > 0)
    return all_finite(inertia) & is_symmetric(inertia) & is_positive_definite(inertia)


class Findings:
    """Collects what is wrong with the inputs of one call; the first finding wins.

    `apply` either raises (throw=True, in eager code and under jit) or gives back the result code,
    so that the caller can answer a bad lane with NaN and leave the others alone.
    """

    def __init__(self) -> None:
        """Start with nothing found."""
        self.result: Any = RESULTS.successful
        self._failed: list[Array] = []
        self._messages: list[str] = []

    @property
    def ok(self) -> Bool[Array, ""]:
        """True where nothing has been found."""
        return self.result == RESULTS.successful

    def require(self, ok: Bool[Array, ""], code: Any, message: str | None = None) -> None:
        """Note that `code` is what is wrong where `ok` is False."""
        self.result = RESULTS.where(self.ok & ~ok, code, self.result)
        self._failed.append(~ok)
        self._messages.append(RESULTS[code] if message is None else message)

    def apply(self, value: Any, throw: bool) -> Any:
        """Return `value`, guarded by the error if `throw`."""
        if not throw or not self._failed:
            return value
        failed = jnp.stack(self._failed)
        return eqx.branched_error_if(value, jnp.any(failed), jnp.argmax(failed), self._messages)


def nan_where(bad: Bool[Array, ""], tree: Any) -> Any:
    """Replace the inexact leaves of a pytree by NaN where `bad`."""
    return jtu.tree_map(
        lambda x: (
            jnp.where(bad, jnp.asarray(jnp.nan, x.dtype), x) if eqx.is_inexact_array(x) else x
        ),
        tree,
    )


def is_concrete(value: Any) -> bool:
    """True for a value known now, not a tracer."""
    return isinstance(value, int | float | np.ndarray | np.generic) or (
        eqx.is_array(value) and not isinstance(value, jax.core.Tracer)
    )
