"""Aliases of array types, protocols of states, and modules that print their numbers."""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

import equinox as eqx
import jax.core
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray
from jaxtyping import Real as _Real
from typing_extensions import TypeAliasType

# `help` shows such an alias by its name, where it would spell a union out.
Scalar = TypeAliasType("Scalar", Float[Array, ""])
ScalarLike = TypeAliasType("ScalarLike", _Real[ArrayLike, ""])
Vector = TypeAliasType("Vector", Float[Array, "3"])
VectorLike = TypeAliasType("VectorLike", _Real[ArrayLike, "3"])
Quaternion = TypeAliasType("Quaternion", Float[Array, "4"])
QuaternionLike = TypeAliasType("QuaternionLike", _Real[ArrayLike, "4"])
Matrix = TypeAliasType("Matrix", Float[Array, "3 3"])
MatrixLike = TypeAliasType("MatrixLike", _Real[ArrayLike, "3 3"])
RandomKey = TypeAliasType("RandomKey", PRNGKeyArray)
InertiaLike = TypeAliasType(
    "InertiaLike", _Real[ArrayLike, "3"] | _Real[ArrayLike, "3 3"]
)

if TYPE_CHECKING:
    from jaxtyping import Real as Real

    AnyArray = Any
    AnyMatrix = Any
    TimeLike = float | Array
else:
    #: An array of JAX, or of numpy on the host. To a type checker the two have nothing
    #: in common.
    AnyArray = Array | np.ndarray | np.generic
    #: A time or a step that diffrax passes to a solver. Type checkers reject arithmetic
    #: with `ScalarLike`, which includes numbers of numpy.
    TimeLike = TypeAliasType("TimeLike", _Real[ArrayLike, ""])
    #: A matrix of either kind, shown in signatures by this name.
    AnyMatrix = TypeAliasType(
        "AnyMatrix", Float[Array, "3 3"] | Float[np.ndarray, "3 3"]
    )

    class Real:
        """`jaxtyping.Real[ArrayLike, "..."]`, shown as it is written."""

        def __class_getitem__(cls, item: tuple[Any, str]) -> TypeAliasType:
            """An alias of that name."""
            return TypeAliasType(f"Real[ArrayLike, '{item[1]}']", _Real[item])


@runtime_checkable
class RotationState(Protocol):
    """A dataclass with an attitude and an angular velocity."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    # Any, since type checkers take a field with an equinox converter for a descriptor.
    @property
    def attitude(self) -> Any:
        """Unit quaternion, scalar first, body to space, an array (4,)."""
        ...

    @property
    def omega(self) -> Any:
        """Angular velocity, body components [rad/s], an array (3,)."""
        ...


@runtime_checkable
class BodyState(RotationState, Protocol):
    """State of a body: a `State`, a `FloatingState`, or that of a user's system."""

    @property
    def internal(self) -> Any:
        """States of internal parts, an entry for each torque that carries some."""
        ...


# Largest size of an array whose numbers are shown.
_FEW = 12


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
    known = isinstance(value, Array | np.ndarray) and not isinstance(
        value, jax.core.Tracer
    )
    if not known or value.size > _FEW:
        return eqx.tree_pformat(value)
    text = np.array2string(np.asarray(value), precision=6, separator=", ")
    return " ".join(text.split())
