"""What is known of a tensor beforehand: inertia models, each with its unknown numbers."""
# ruff: noqa: ARG002 (all take what one of them needs)

import abc
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._checks import RESULTS, Findings, all_finite, check_option, demand
from jrigid._numerics import product
from jrigid._types import AnyArray, AnyMatrix, Readable, ScalarLike
from jrigid.identify import _parameters
from jrigid.identify._host import cholesky, principal_axes
from jrigid.mass import MassProperties, inertia_of_second_moment

LOG_CHOLESKY = ("alpha", "d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2", "t3")
# Second moments of the mass, of their trace, below which a fit has run into a boundary.
BOUNDARY = 1e-7


def as_tensor(inertia: AnyArray) -> AnyArray:
    """A tensor, of moments or itself."""
    return inertia.__array_namespace__().diag(inertia) if inertia.ndim == 1 else inertia


def real_body(tensor: AnyArray, flattest: ScalarLike) -> AnyArray:
    """The nearest shape of a body with extent in three directions: second moments of trace 1."""
    xp = tensor.__array_namespace__()
    # Second moments are tr(I) / 2 - I, of half the trace of I.
    values, axes = principal_axes(
        xp.eye(3, dtype=tensor.dtype) - 2 * tensor / xp.trace(tensor)
    )
    values = xp.maximum(values, flattest)
    return product("ik,k,jk->ij", axes, values / xp.sum(values), axes)


class AbstractInertiaModel(Readable):
    """What is known of a tensor: a few numbers without bounds, and the tensor that they make.

    A subclass says how many numbers there are, where to start and what tensor they make. With
    `absolute` that tensor is the body's, [kg m^2]; otherwise its trace does not matter, and `fit`
    sets it.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> class Ballast(jr.identify.AbstractInertiaModel):  # an unknown mass at a known place
    ...     empty: jnp.ndarray
    ...     place: jnp.ndarray
    ...     absolute = True
    ...     names = ("log mass",)
    ...
    ...     def start(self, tensor, known, flattest):
    ...         return self, jnp.zeros(1)
    ...
    ...     def inertia(self, numbers):
    ...         return self.empty + jr.inertia_tensor(jnp.exp(numbers), self.place[None])
    >>> loaded = Ballast(jnp.eye(3), jnp.array([0.1, 0.0, 0.0])).inertia(jnp.zeros(1))
    >>> print(jnp.diagonal(loaded))
    [1.   1.01 1.01]
    """

    absolute: ClassVar[bool] = False
    names: eqx.AbstractClassVar[tuple[str, ...]]

    @abc.abstractmethod
    def start(
        self, tensor: AnyArray, known: AnyArray, flattest: ScalarLike
    ) -> tuple[Any, AnyArray]:
        """The model, in a frame chosen for a tensor, and its numbers there.

        Args:
            tensor: Where to start: of numpy in a fit, of JAX in a plan. `tensor.
                __array_namespace__()` is the module whose functions serve both.
            known: The system's own tensor, which may be known in part.
            flattest: Least second moment of the mass, of the trace of the three.
        """

    @abc.abstractmethod
    def inertia(self, numbers: Array) -> Array:
        """The tensor."""

    def units(self) -> Array:
        """Sizes of the numbers in which an error is large or small."""
        return jnp.ones(len(self.names))

    def body(self, numbers: Array) -> MassProperties | None:
        """The body about its fixed point, of a model that determines the mass and where it is."""
        return None


def _names(count: int) -> tuple[str, ...]:
    return (
        tuple(f"inertia[{i}]" for i in range(count))
        if count > 1
        else ("inertia",) * count
    )


class Tensor(AbstractInertiaModel):
    """Nothing is known: any real body, by five numbers.

    The second moments of the mass are L L^T with L11 = 1: log L22, log L33, L21, L31, L32.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jr.identify.Tensor().inertia(jnp.array([0.0, 0.0, 0.5, 0.0, 0.0])))
    [[ 2.25 -0.5   0.  ]
     [-0.5   2.    0.  ]
     [ 0.    0.    2.25]]
    """

    names: ClassVar[tuple[str, ...]] = _names(5)

    def start(
        self, tensor: AnyArray, known: AnyArray, flattest: ScalarLike
    ) -> tuple["Tensor", AnyArray]:
        """The numbers of the nearest real body."""
        xp = tensor.__array_namespace__()
        sigma = real_body(tensor, flattest)
        lower = cholesky(sigma) / xp.sqrt(sigma[0, 0])
        return self, xp.concatenate(
            [xp.log(xp.diagonal(lower)[1:]), lower[_parameters.SIDES]]
        )

    def inertia(self, numbers: Array) -> Array:
        """The tensor, of whatever trace."""
        return inertia_of_second_moment(
            _parameters.squared(jnp.exp(jnp.pad(numbers[:2], (1, 0))), numbers[2:])
        )


class _InFrame(AbstractInertiaModel):
    """A model in axes of its own."""

    frame: AnyMatrix | None = None

    def sigma(self, numbers: Array) -> Array:
        """Second moments in the frame, of whatever trace: by default of its axes, the last ones."""
        return jnp.diag(jnp.exp(jnp.pad(numbers, (3 - numbers.size, 0))))

    def inertia(self, numbers: Array) -> Array:
        """The tensor, of whatever trace."""
        frame = jnp.eye(3, dtype=numbers.dtype) if self.frame is None else self.frame
        return inertia_of_second_moment(
            product("ik,kl,jl->ij", frame, self.sigma(numbers), frame)
        )


class Moments(_InFrame):
    """The principal axes are known, those of the system's tensor: two numbers."""

    names: ClassVar[tuple[str, ...]] = _names(2)

    def start(
        self, tensor: AnyArray, known: AnyArray, flattest: ScalarLike
    ) -> tuple["Moments", AnyArray]:
        """Logarithms of ratios of second moments, in the system's axes."""
        xp = tensor.__array_namespace__()
        eye = xp.eye(3, dtype=tensor.dtype)
        frame = xp.where(xp.all(known * (1 - eye) == 0), eye, principal_axes(known)[1])
        values = product("ki,kl,li->i", frame, real_body(tensor, flattest), frame)
        return Moments(frame), xp.log(values[1:] / values[0])


class Symmetric(_InFrame):
    """Two moments are equal, about an axis that is sought: three numbers.

    The logarithm of the odd second moment over the others, and where axis 3 of the frame turns to.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> model = jr.identify.Symmetric(jnp.eye(3))
    >>> print(jnp.linalg.eigvalsh(model.inertia(jnp.array([jnp.log(2.0), 0.1, -0.2]))).round(6))
    [2. 3. 3.]
    """

    names: ClassVar[tuple[str, ...]] = _names(3)

    def start(
        self, tensor: AnyArray, known: AnyArray, flattest: ScalarLike
    ) -> tuple["Symmetric", AnyArray]:
        """The odd moment's axis as axis 3 of the frame."""
        xp = tensor.__array_namespace__()
        values, frame = principal_axes(real_body(tensor, flattest))
        last = values[2] - values[1] > values[1] - values[0]
        frame = xp.where(last, frame, frame[:, ::-1])
        values = xp.where(last, values, values[::-1])
        size = xp.log(2 * values[2:] / (values[0] + values[1]))
        return Symmetric(frame), xp.pad(size, (0, 2))

    def sigma(self, numbers: Array) -> Array:
        """Of an axis near axis 3."""
        axis = jnp.append(numbers[1:], jnp.ones_like(numbers[0]))
        dyad = axis[:, None] * axis[None, :] / jnp.sum(axis * axis)
        return jnp.eye(3, dtype=numbers.dtype) + (jnp.exp(numbers[0]) - 1) * dyad


class Top(_InFrame):
    """Two moments are equal, and the axis is body axis 3: one number.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diagonal(jr.identify.Top().inertia(jnp.log(jnp.array([2.0])))))
    [3. 3. 2.]
    """

    names: ClassVar[tuple[str, ...]] = _names(1)

    def start(
        self, tensor: AnyArray, known: AnyArray, flattest: ScalarLike
    ) -> tuple["Top", AnyArray]:
        """Of the body's own axes."""
        xp = tensor.__array_namespace__()
        values = xp.diagonal(real_body(tensor, flattest))
        return self, xp.log(2 * values[2:] / (values[0] + values[1]))


class Flat(_InFrame):
    """All mass is in a plane, which is sought: four numbers.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> tensor = jr.identify.Flat(jnp.eye(3)).inertia(jnp.array([0.3, 0.1, 0.2, -0.1]))
    >>> small, middle, large = jnp.linalg.eigvalsh(tensor)
    >>> print((large - small - middle).round(6) + 0.0)
    0.0
    """

    names: ClassVar[tuple[str, ...]] = _names(4)

    def start(
        self, tensor: AnyArray, known: AnyArray, flattest: ScalarLike
    ) -> tuple["Flat", AnyArray]:
        """The largest second moment first, the thickness last."""
        xp = tensor.__array_namespace__()
        values, frame = principal_axes(real_body(tensor, flattest))
        return Flat(frame[:, ::-1]), xp.pad(
            0.5 * xp.log(values[1:2] / values[2:]), (0, 3)
        )

    def sigma(self, numbers: Array) -> Array:
        """L L^T, the third column of L zero."""
        sizes = jnp.exp(jnp.pad(numbers[:1], (1, 0)))
        return _parameters.squared(jnp.pad(sizes, (0, 1)), numbers[1:])


class Fixed(AbstractInertiaModel):
    """All of the tensor is known, the system's; nothing of it is sought.

    Attributes:
        known: The tensor [kg m^2]; `fit` sets it.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diagonal(jr.identify.Fixed(jnp.eye(3)).inertia(jnp.zeros(0))))
    [1. 1. 1.]
    """

    absolute: ClassVar[bool] = True
    names: ClassVar[tuple[str, ...]] = ()
    known: AnyMatrix | None = None

    def start(
        self, tensor: AnyArray, known: AnyArray, flattest: ScalarLike
    ) -> tuple["Fixed", AnyArray]:
        """No numbers."""
        return Fixed(known), tensor.__array_namespace__().zeros(0, tensor.dtype)

    def inertia(self, numbers: Array) -> Array:
        """The tensor that is known."""
        assert self.known is not None
        return self.known.astype(numbers.dtype)


class LogCholesky(AbstractInertiaModel):
    """A body about a fixed point, sought by `fit` in its ten log-Cholesky numbers.

    The origin of the body's coordinates is the fixed point; the inertia about it, and the mass and
    the lever of any `torques.UniformGravity` of the system, all follow from the ten numbers. Motion
    under gravity tells the inertia about the point over the mass times the lever, eight numbers:
    freeze two at least, such as "alpha", half the logarithm of the mass, and a length. A rotor or
    a torque of known size tells one more.

    Attributes:
        parameters: (alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3) to start from.
        frozen: Names of those that are known.

    Raises:
        RuntimeError: A flat body.

    Gradients: as `body_from_log_cholesky`.
    Source: as `body_from_log_cholesky`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> arm = jr.solids.box(8.0, jnp.array([1.0, 2.0, 3.0])).translated(jnp.array([0.0, 0.0, 1.5]))
    >>> print(jr.identify.LogCholesky(arm, frozen=("alpha", "t1", "t2")).names)
    ('d1', 'd2', 'd3', 's12', 's23', 's13', 't3')
    """

    absolute: ClassVar[bool] = True
    parameters: Float[Array, "10"]
    frozen: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, body: MassProperties, frozen: Sequence[str] = ()):
        self.frozen = (frozen,) if isinstance(frozen, str) else tuple(frozen)
        for name in self.frozen:
            check_option("frozen", name, LOG_CHOLESKY)
        text = "Argument `frozen` must leave a number to seek, but it does not."
        demand(bool(self.names), text)
        parameters, findings = _parameters.log_cholesky_from_body(body), Findings()
        text = "Argument `body` must have extent in three directions, I3 < I1 + I2, but it has not."
        ok, code = all_finite(parameters), RESULTS.unphysical_inertia
        findings.require(ok, code, text, body.inertia)
        self.parameters = findings.guard(parameters, throw=True)

    @property
    def names(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Names of the numbers that are not frozen."""
        return tuple(name for name in LOG_CHOLESKY if name not in self.frozen)

    def units(self) -> Array:
        """1, or, of numbers in metres, the size of the body."""
        body = _parameters.body_from_log_cholesky(self.parameters)
        square = 0.5 * jnp.trace(body.inertia) / body.mass + jnp.sum(
            body.center_of_mass**2
        )
        of_length = np.array([name[0] in "st" for name in self.names])
        return jnp.where(of_length, jnp.sqrt(square), 1.0)

    def start(
        self, tensor: AnyArray, known: AnyArray, flattest: ScalarLike
    ) -> tuple["LogCholesky", AnyArray]:
        """The numbers sought, as they were given."""
        return self, self.parameters[self._indices()].astype(tensor.dtype)

    def inertia(self, numbers: Array) -> Array:
        """The tensor about the fixed point [kg m^2]."""
        return self.body(numbers).about(jnp.zeros(3, numbers.dtype))

    def body(self, numbers: Array) -> MassProperties:
        """The body, of other numbers for those that are sought."""
        whole = self.parameters.astype(numbers.dtype).at[self._indices()].set(numbers)
        return _parameters.body_from_log_cholesky(whole)

    def _indices(self) -> Any:
        return np.array([LOG_CHOLESKY.index(name) for name in self.names])
