"""Inertia models: what is known of a tensor before a fit, and the unknown numbers."""
# ruff: noqa: ARG002 (each model has the arguments that some models need)

import abc
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jrigid._checks import RESULTS, Findings, all_finite, check_option, demand
from jrigid._numerics import product, without_gradient
from jrigid._types import AnyArray, AnyMatrix, Readable, ScalarLike
from jrigid.identify import _parameters
from jrigid.identify._host import cholesky, principal_axes, with_signs
from jrigid.mass import MassProperties, inertia_of_second_moment

LOG_CHOLESKY = ("alpha", "d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2", "t3")
# Second moments of the mass, over their trace, below which a fit is at a boundary.
BOUNDARY = 1e-7
# Which numbers of a `Tensor` are logarithms.
LOGARITHMS = slice(2)


def real_body(tensor: AnyArray, flattest: ScalarLike) -> AnyArray:
    """Second moments of trace 1 of the nearest body with extent in three directions.

    Args:
        tensor: Inertia tensor.
        flattest: Least second moment.
    """
    xp = tensor.__array_namespace__()
    # The second moments are tr(I) / 2 - I. Their trace is half that of I.
    second = xp.eye(3, dtype=tensor.dtype) - 2 * tensor / xp.trace(tensor)
    values, axes = principal_axes(second)
    # The numbers of a flat body are infinite, since they contain logarithms.
    values = xp.maximum(values, flattest)
    return product("ik,k,jk->ij", axes, values / xp.sum(values), axes)


class AbstractInertiaModel(Readable):
    """A tensor as a function of a few unbounded numbers.

    A subclass defines the names of the numbers, their initial values and the tensor. If
    `absolute` is True that is the tensor of the body [kg m^2]. Otherwise its trace has
    no effect, and `fit` sets it.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> class Ballast(jr.identify.AbstractInertiaModel):
    ...     # A body with an unknown mass at a known place.
    ...     empty: jnp.ndarray
    ...     place: jnp.ndarray
    ...     absolute = True
    ...     names = ("log mass",)
    ...
    ...     def start(self, tensor, known, flattest):
    ...         return self, jnp.zeros(1)
    ...
    ...     def inertia(self, numbers):
    ...         masses = jnp.exp(numbers)
    ...         return self.empty + jr.inertia_tensor(masses, self.place[None])
    >>> loaded = Ballast(jnp.eye(3), jnp.array([0.1, 0.0, 0.0])).inertia(jnp.zeros(1))
    >>> print(jnp.diagonal(loaded))
    [1.   1.01 1.01]
    """

    absolute: ClassVar[bool] = False
    names: eqx.AbstractClassVar[tuple[str, ...]]

    @abc.abstractmethod
    def start(
        self, tensor: AnyArray, known: AnyArray, flattest: ScalarLike
    ) -> tuple["AbstractInertiaModel", AnyArray]:
        """Choose a frame for a tensor; return the model in it and the initial numbers.

        Args:
            tensor: Initial tensor, a numpy array in a fit and a JAX array in a plan.
                The functions of `tensor.__array_namespace__()` work for both.
            known: Tensor of the system, which may be known in part.
            flattest: Least second moment of the mass, over the trace of the three.
        """

    @abc.abstractmethod
    def inertia(self, numbers: Array) -> Array:
        """Tensor that the numbers describe."""

    def in_frame(
        self, numbers: np.ndarray, like: "AbstractInertiaModel | None" = None
    ) -> tuple["AbstractInertiaModel", np.ndarray]:
        """The same tensor, by numbers in another frame.

        Args:
            numbers: In the frame of this model.
            like: A model of this kind in the other frame; None chooses the frame in
                which a search moves best. A model with one frame stays as it is.
        """
        del like
        return self, numbers

    def moved(self, numbers: Array, change: Array) -> Array:
        """Numbers after a step of the search: for small steps `numbers + change`."""
        return numbers + change

    def units(self) -> Array:
        """Natural units of the numbers: sizes at which an error counts as large."""
        return jnp.ones(len(self.names))

    def body(self, numbers: Array) -> MassProperties | None:
        """Body about its fixed point; None for a model of the tensor alone."""
        return None


def _names(count: int) -> tuple[str, ...]:
    """Names of several numbers of a tensor."""
    return tuple(f"inertia[{i}]" for i in range(count))


class _InFrame(AbstractInertiaModel):
    """A model whose numbers describe second moments in a frame of its own.

    Attributes:
        frame: Its axes, as columns. `start` chooses them; None means the body axes.
    """

    frame: AnyMatrix | None = None

    def sigma(self, numbers: Array) -> Array:
        """Second moments in the frame, by default with logarithms as the numbers."""
        # The scale has no effect, so that the first axes may have second moments of
        # one.
        return jnp.diag(jnp.exp(jnp.pad(numbers, (3 - numbers.size, 0))))

    def inertia(self, numbers: Array) -> Array:
        """Tensor of an arbitrary trace."""
        frame = jnp.eye(3, dtype=numbers.dtype) if self.frame is None else self.frame
        second = product("ik,kl,jl->ij", frame, self.sigma(numbers), frame)
        return inertia_of_second_moment(second)


class Tensor(_InFrame):
    """Any real body, by five numbers.

    The second moments of the mass in the frame are L L^T with L11 = 1. The numbers are
    log L22, log L33, L21, L31 and L32.

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
        """Return the numbers of the nearest real body in its principal axes."""
        body = real_body(tensor, flattest)
        # The numbers of a plan have no derivatives by way of the frame.
        _, axes = principal_axes(without_gradient(body))
        # The largest second moment is the first, since it is the one left out.
        frame = axes[:, ::-1]
        sigma = product("ki,kl,lj->ij", frame, body, frame)
        xp = tensor.__array_namespace__()
        lower = cholesky(sigma) / xp.sqrt(sigma[0, 0])
        logarithms = xp.log(xp.diagonal(lower)[1:])
        return Tensor(frame), xp.concatenate([logarithms, lower[_parameters.SIDES]])

    def sigma(self, numbers: Array) -> Array:
        """Second moments L L^T."""
        diagonal = jnp.exp(jnp.pad(numbers[:2], (1, 0)))
        return _parameters.squared(diagonal, numbers[2:])

    def in_frame(
        self, numbers: np.ndarray, like: "AbstractInertiaModel | None" = None
    ) -> tuple["AbstractInertiaModel", np.ndarray]:
        """The same body by numbers in another frame, by default its principal axes."""
        lower = np.diag(np.exp(np.pad(numbers[:2], (1, 0))))
        lower[_parameters.SIDES] = numbers[2:]
        if self.frame is None or not np.all(np.isfinite(lower)):
            return self, numbers
        # A decomposition of L instead of L L^T keeps the digits of a thin body.
        lower = self.frame @ lower
        if isinstance(like, Tensor) and like.frame is not None:
            frame = np.asarray(like.frame)
        else:
            axes, _, _ = np.linalg.svd(lower)
            # Signs of their own make the numbers of similar fits similar.
            frame = with_signs(axes[:, ::-1])[:, ::-1]
        upper = np.asarray(np.linalg.qr(lower.T @ frame, mode="r"))
        sizes = np.abs(np.diagonal(upper))
        lower = upper.T * np.sign(np.diagonal(upper)) / sizes[0]
        thin = np.finfo(numbers.dtype).eps
        logarithms = np.log(np.maximum(sizes[1:] / sizes[0], thin))
        return Tensor(frame), np.concatenate([logarithms, lower[_parameters.SIDES]])

    def moved(self, numbers: Array, change: Array) -> Array:
        """Numbers after a step that is straight in second moments.

        The motion of a thin body is nearly linear in its small second moments: it is
        in L22^2 over L11^2, and in what one of the two thin directions has of the
        other, L33^2 over L22^2 and L32 over L22.
        """
        # The logarithms are those of roots of second moments.
        first = _grown(2 * change[0]) / 2
        second = _grown(2 * (change[1] - change[0])) / 2
        side = numbers[4] + (change[4] - numbers[4] * change[0])
        return jnp.concatenate(
            [
                numbers[:2] + jnp.stack([first, first + second]),
                numbers[2:4] + change[2:4],
                (side * jnp.exp(first))[None],
            ]
        )


def _grown(part: Array) -> Array:
    """Change of the logarithm of a size that grows by this part of itself.

    Below half of it the size falls ever more slowly, since none is negative.
    """
    followed = jnp.maximum(part, -0.5)
    return jnp.log1p(followed) - jnp.log1p(2 * (followed - part))


class Moments(_InFrame):
    """A body whose principal axes are those of the system's tensor, by two numbers.

    The numbers are logarithms of ratios of second moments.
    """

    names: ClassVar[tuple[str, ...]] = _names(2)

    def start(
        self, tensor: AnyArray, known: AnyArray, flattest: ScalarLike
    ) -> tuple["Moments", AnyArray]:
        """Return the numbers of the nearest real body."""
        xp = tensor.__array_namespace__()
        eye = xp.eye(3, dtype=tensor.dtype)
        # Axes of a diagonal tensor stay in the order of the body axes.
        is_diagonal = xp.all(known * (1 - eye) == 0)
        frame = xp.where(is_diagonal, eye, principal_axes(known)[1])
        values = product("ki,kl,li->i", frame, real_body(tensor, flattest), frame)
        return Moments(frame), xp.log(values[1:] / values[0])


class Symmetric(_InFrame):
    """A body with two equal moments about an unknown axis, by three numbers.

    The first number is the logarithm of the second moment along the axis of symmetry
    over the other two. The others are the direction of that axis, (x, y, 1) in the
    frame.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> model = jr.identify.Symmetric(jnp.eye(3))
    >>> inertia = model.inertia(jnp.array([jnp.log(2.0), 0.1, -0.2]))
    >>> print(jnp.linalg.eigvalsh(inertia).round(6))
    [2. 3. 3.]
    """

    names: ClassVar[tuple[str, ...]] = _names(3)

    def start(
        self, tensor: AnyArray, known: AnyArray, flattest: ScalarLike
    ) -> tuple["Symmetric", AnyArray]:
        """Choose a frame whose axis 3 is the axis of symmetry."""
        xp = tensor.__array_namespace__()
        values, frame = principal_axes(real_body(tensor, flattest))
        # The two closest values are taken for the equal ones.
        last = values[2] - values[1] > values[1] - values[0]
        # The reversed axes are left-handed, which second moments do not notice.
        frame = xp.where(last, frame, frame[:, ::-1])
        values = xp.where(last, values, values[::-1])
        size = xp.log(2 * values[2:] / (values[0] + values[1]))
        return Symmetric(frame), xp.pad(size, (0, 2))

    def sigma(self, numbers: Array) -> Array:
        """Second moments of a body that is symmetric about an axis near axis 3."""
        axis = jnp.append(numbers[1:], jnp.ones_like(numbers[0]))
        dyad = axis[:, None] * axis[None, :] / jnp.sum(axis * axis)
        return jnp.eye(3, dtype=numbers.dtype) + (jnp.exp(numbers[0]) - 1) * dyad


class Top(_InFrame):
    """A body with two equal moments about body axis 3, by one number.

    The number is the logarithm of the second moment along that axis over the others.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> print(jnp.diagonal(jr.identify.Top().inertia(jnp.log(jnp.array([2.0])))))
    [3. 3. 2.]
    """

    names: ClassVar[tuple[str, ...]] = ("inertia",)

    def start(
        self, tensor: AnyArray, known: AnyArray, flattest: ScalarLike
    ) -> tuple["Top", AnyArray]:
        """Return the number of the nearest real body."""
        xp = tensor.__array_namespace__()
        values = xp.diagonal(real_body(tensor, flattest))
        return self, xp.log(2 * values[2:] / (values[0] + values[1]))


class Flat(_InFrame):
    """A flat body in an unknown plane, by four numbers.

    The second moments are L L^T in the frame, where the third column of L is zero.

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
        """Choose a frame with the largest second moment first, the thickness last."""
        xp = tensor.__array_namespace__()
        values, frame = principal_axes(real_body(tensor, flattest))
        # The numbers are those of L, and these are elements of L L^T.
        size = 0.5 * xp.log(values[1:2] / values[2:])
        return Flat(frame[:, ::-1]), xp.pad(size, (0, 3))

    def sigma(self, numbers: Array) -> Array:
        """Second moments L L^T."""
        sizes = jnp.exp(jnp.pad(numbers[:1], (1, 0)))
        return _parameters.squared(jnp.pad(sizes, (0, 1)), numbers[1:])


class Fixed(AbstractInertiaModel):
    """A body whose tensor is known: it is that of the system.

    Attributes:
        known: The tensor [kg m^2], which `fit` sets.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> model = jr.identify.Fixed(jnp.eye(3))
    >>> print(jnp.diagonal(model.inertia(jnp.zeros(0))))
    [1. 1. 1.]
    """

    absolute: ClassVar[bool] = True
    names: ClassVar[tuple[str, ...]] = ()
    known: AnyMatrix | None = None

    def start(
        self, tensor: AnyArray, known: AnyArray, flattest: ScalarLike
    ) -> tuple["Fixed", AnyArray]:
        """Return no numbers."""
        return Fixed(known), tensor.__array_namespace__().zeros(0, tensor.dtype)

    def inertia(self, numbers: Array) -> Array:
        """Known tensor."""
        assert self.known is not None
        return self.known.astype(numbers.dtype)


class LogCholesky(AbstractInertiaModel):
    """A body about a fixed point, by its ten log-Cholesky numbers.

    The fixed point is the origin of the body's coordinates. The ten numbers determine
    the inertia about it, and the mass and the lever of any `torques.UniformGravity` of
    the system.

    Motion under gravity determines eight numbers: the inertia about the fixed point
    over the mass times the lever. Freeze two numbers at least, such as "alpha", half
    the logarithm of the mass, and a length. A rotor or a torque of known size
    determines one more.

    Attributes:
        parameters: Initial (alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3).
        frozen: Names of those that are known.

    Raises:
        ValueError: A name is unknown, or all numbers are frozen.
        RuntimeError: The body is flat.

    Gradients: as `body_from_log_cholesky`.
    Source: as `body_from_log_cholesky`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> box = jr.solids.box(8.0, jnp.array([1.0, 2.0, 3.0]))
    >>> arm = box.translated(jnp.array([0.0, 0.0, 1.5]))
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
        demand(
            bool(self.names),
            "Argument `frozen` must leave a number to seek, but it does not.",
        )
        parameters = _parameters.log_cholesky_from_body(body)
        findings = Findings()
        findings.require(
            all_finite(parameters),
            RESULTS.unphysical_inertia,
            "Argument `body` must have extent in three directions, I3 < I1 + I2, but "
            "it has not.",
            body.inertia,
        )
        self.parameters = findings.guard(parameters, throw=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers that are not frozen."""
        return tuple(name for name in LOG_CHOLESKY if name not in self.frozen)

    def units(self) -> Array:
        """The size of the body for numbers in metres, 1 for the others."""
        body = _parameters.body_from_log_cholesky(self.parameters)
        # Half the trace over the mass is the mean square distance from the centre of
        # mass.
        about_center = 0.5 * jnp.trace(body.inertia) / body.mass
        size = jnp.sqrt(about_center + jnp.sum(body.center_of_mass**2))
        # The triangle without its factor exp(alpha) is that of second moments over the
        # mass, so that s and t are lengths.
        is_length = np.array([name[0] in "st" for name in self.names])
        return jnp.where(is_length, size, 1.0)

    def start(
        self, tensor: AnyArray, known: AnyArray, flattest: ScalarLike
    ) -> tuple["LogCholesky", AnyArray]:
        """Return the numbers of the body that was given, except frozen ones."""
        return self, self.parameters[self._indices()].astype(tensor.dtype)

    def inertia(self, numbers: Array) -> Array:
        """Tensor about the fixed point [kg m^2]."""
        return self.body(numbers).about(jnp.zeros(3, numbers.dtype))

    def body(self, numbers: Array) -> MassProperties:
        """Body with new values for the numbers that are not frozen."""
        whole = self.parameters.astype(numbers.dtype).at[self._indices()].set(numbers)
        return _parameters.body_from_log_cholesky(whole)

    def _indices(self) -> np.ndarray:
        """Positions of the numbers that are not frozen."""
        return np.array([LOG_CHOLESKY.index(name) for name in self.names])
