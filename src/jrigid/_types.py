"""Aliases for the array types of public signatures, and modules that print their numbers."""

import dataclasses
from typing import Any, TypeAlias

import equinox as eqx
import jax.core
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Real

Scalar: TypeAlias = Float[Array, ""]
ScalarLike: TypeAlias = Real[ArrayLike, ""]
Vector: TypeAlias = Float[Array, "3"]
VectorLike: TypeAlias = Real[ArrayLike, "3"]
Quaternion: TypeAlias = Float[Array, "4"]
QuaternionLike: TypeAlias = Real[ArrayLike, "4"]
Matrix: TypeAlias = Float[Array, "3 3"]
MatrixLike: TypeAlias = Real[ArrayLike, "3 3"]
InertiaLike: TypeAlias = Real[ArrayLike, "3"] | Real[ArrayLike, "3 3"]

_FEW = 12  # numbers that an array is shown with


class Readable(eqx.Module):
    """A module whose `repr` shows numbers, not only their type."""

    def __repr__(self) -> str:
        """The fields, briefly."""
        fields = (f.name for f in dataclasses.fields(self) if f.repr)
        shown = ", ".join(f"{name}={_brief(getattr(self, name))}" for name in fields)
        return f"{type(self).__name__}({shown})"


def _brief(value: Any) -> str:
    if isinstance(value, Readable):
        return repr(value)
    known = isinstance(value, Array | np.ndarray) and not isinstance(value, jax.core.Tracer)
    if not known or value.size > _FEW:
        return eqx.tree_pformat(value)
    text = np.array2string(np.asarray(value), precision=6, separator=", ")
    return " ".join(text.split())
