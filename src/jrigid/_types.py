"""Aliases for the array types that appear in public signatures."""

from typing import TypeAlias

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
