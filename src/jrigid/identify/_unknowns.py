"""The unknowns of a fit: the inertia, its scale and the arrays picked by `free`.

They are one vector of numbers for all trials and one more for each trial.
`Unknowns.parts` turns them into a system and sensors.
"""

import abc
import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, ArrayLike, PyTree

from jrigid._checks import demand, is_concrete, whole_number
from jrigid._numerics import as_tensor, or_one, product, without_gradient
from jrigid._types import AnyArray, Readable, Real
from jrigid.identify._host import cholesky
from jrigid.identify._inertia_models import AbstractInertiaModel
from jrigid.identify._parameters import SIDES, squared
from jrigid.identify._records import one_after_another
from jrigid.identify._sensors import AbstractSensor
from jrigid.mass import MassProperties
from jrigid.systems import RigidBody
from jrigid.torques import AbstractTorque, Sum, UniformGravity

_LEAST = 1e-3  # smallest initial value of a positive number, in its unit
# A number of a positive array below which the array is zero: exp(-25) of its unit.
_ZERO = -25.0


# This is not a pytree, so that `tree_map` takes it for a leaf in `prior` and `each`.
@dataclasses.dataclass(frozen=True)
class _Pick:
    """Mark that `free` gets in place of an array: its index and how it is sought.

    Attributes:
        index: Index among the arrays of the system and the sensors.
        sigma: Standard deviation of prior knowledge, if there is any.
        own: Whether each trial has a value of its own.
        groups: For each trial the number of its group, where groups have values.
    """

    index: int
    sigma: ArrayLike | None = None
    own: bool = False
    groups: tuple[int, ...] | None = None


def prior(array: PyTree, sigma: Real[ArrayLike, "..."]) -> PyTree:
    """State prior knowledge of an array that `free` picks: its value within `sigma`.

    Args:
        array: What is sought, an array or several in a pytree.
        sigma: One standard deviation, in the unit of the array.

    Raises:
        ValueError: A sigma that is not positive.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> result = jr.identify.fit(
    ...     jr.RigidBody(jnp.ones(3)), readings,
    ...     free=lambda body, gyro: jr.identify.prior(gyro.bias, 1e-3))
    >>> print(result.names[5:])
    ('gyro.bias[0]', 'gyro.bias[1]', 'gyro.bias[2]')
    """
    demand(
        not is_concrete(sigma) or bool(np.all(np.asarray(sigma) > 0)),
        f"Argument `sigma` of a prior must be positive, but it is {sigma}.",
    )
    return jtu.tree_map(lambda x: dataclasses.replace(x, sigma=sigma), array)


def each(array: PyTree, groups: Sequence[int] | None = None) -> PyTree:
    """Seek an array that `free` picks anew in each trial, or in each group of trials.

    A group can be a session: between two of them a gyro was removed and mounted again,
    a few degrees off. A turn that all sessions share cannot be distinguished from a
    turn of the body. So one session keeps the misalignment that was given, and the body
    axes are those of its gyro.

    Args:
        array: What is sought, or `prior(array, sigma)`.
        groups: For each trial the number of its group, from 0 on; -1 for trials in
            which the array keeps the value that was given. None: each trial is a group.

    >>> import jrigid as jr
    >>> free = lambda body, gyro: jr.identify.each(gyro.bias)
    >>> sessions = [-1, -1, -1, 0, 0, 0, 1, 1]  # of eight trials
    >>> free = lambda body, gyro: jr.identify.each(gyro.misalignment, sessions)
    """
    change: dict[str, Any] = {"own": True}
    if groups is not None:
        numbers = tuple(whole_number("groups", x, least=-1) for x in groups)
        change = {"groups": numbers}
    return jtu.tree_map(lambda x: dataclasses.replace(x, **change), array)


class AbstractSought(Readable):
    """An array that is sought, as a function of numbers without bounds.

    Attributes:
        index: Index among the arrays of the system and the sensors.
        name: Name, as `torque.coefficient` or `gyro.bias`.
        own: Whether each trial has a value of its own.
        base: The value that was given, with an axis of groups in front if groups have
            values of their own.
        unit: Natural size of each entry.
        sigma: Standard deviation of prior knowledge, if there is any.
    """

    index: int = eqx.field(static=True)
    name: str = eqx.field(static=True)
    own: bool = eqx.field(static=True)
    base: AnyArray
    unit: AnyArray
    sigma: AnyArray | None

    @property
    def size(self) -> int:
        """Count of its numbers."""
        return self.base.size

    @property
    def names(self) -> tuple[str, ...]:
        """A name for each number."""
        indices = np.ndindex(*self.base.shape)
        return tuple(self.name + "".join(f"[{j}]" for j in index) for index in indices)

    @abc.abstractmethod
    def start(self) -> AnyArray:
        """Initial values of the numbers."""

    @abc.abstractmethod
    def value(self, x: Array) -> Array:
        """The array that numbers stand for."""

    def natural_units(self, x: Array) -> Array:
        """Natural units of the numbers."""
        return jnp.ones_like(x)

    def with_errors(self, x: Array, covariance: Array) -> tuple[Array, Array]:
        """The array and its standard errors."""
        slopes = jax.jacfwd(self.value)(x)
        # Linear propagation of errors.
        square = product("...n,nm,...m->...", slopes, covariance, slopes)
        return self.value(x), jnp.sqrt(jnp.maximum(square, 0.0))

    def off_zero(self, x: np.ndarray, least: float) -> np.ndarray:
        """The numbers, of which logarithms are no lower than this."""
        del least
        return x

    def log_volume(self, x: Array) -> Array:
        """Logarithm of the volume of arrays over that of the numbers they stand for."""
        # A tensor has more elements than numbers, hence the root of a Gram determinant.
        slopes = jax.jacfwd(self.value)(x).reshape(self.base.size, self.size)
        return 0.5 * jnp.linalg.slogdet(product("in,im->nm", slopes, slopes))[1]

    def prior_rows(self, x: Array) -> Array:
        """Residuals of prior knowledge of the array, none without any."""
        if self.sigma is None:
            return jnp.zeros(0, x.dtype)
        return ((self.value(x) - self.base) / self.sigma).reshape(-1)


class _Real(AbstractSought):
    """An array of either sign: the base, and a number of units more."""

    def start(self) -> AnyArray:
        return self.unit.__array_namespace__().zeros(self.size, self.unit.dtype)

    def value(self, x: Array) -> Array:
        return self.base + self.unit * x.reshape(self.base.shape)

    def natural_units(self, x: Array) -> Array:
        # An array that grew far beyond its initial value is judged by its new size.
        return jnp.maximum(jnp.abs(self.value(x)) / self.unit, 1.0).reshape(-1)


class _Positive(AbstractSought):
    """A positive array: linear in large numbers, exponential in small ones."""

    def start(self) -> AnyArray:
        # The inverse of softplus.
        xp = self.base.__array_namespace__()
        return xp.log(xp.expm1(xp.maximum(self.base / self.unit, _LEAST))).reshape(-1)

    def value(self, x: Array) -> Array:
        return self.unit * jax.nn.softplus(x.reshape(self.base.shape))

    def natural_units(self, x: Array) -> Array:
        # In the linear part an array is judged by its new size. In the exponential part
        # a number is the logarithm of its array.
        return jnp.maximum(jax.nn.softplus(x), 1.0)

    def with_errors(self, x: Array, covariance: Array) -> tuple[Array, Array]:
        values, errors = super().with_errors(x, covariance)
        # At zero the slope, and with it the propagated error, is zero. The record only
        # bounds such an array from above.
        is_zero = (x < _ZERO).reshape(self.base.shape)
        return values, jnp.where(is_zero, jnp.inf, errors)

    def off_zero(self, x: np.ndarray, least: float) -> np.ndarray:
        return np.maximum(x, least)


class _Definite(AbstractSought):
    """A symmetric, positive definite tensor L L^T.

    The numbers are the logarithms of L's diagonal, then its other entries.
    """

    @property
    def size(self) -> int:
        return 6

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"{self.name}[{j}]" for j in range(6))

    def start(self) -> AnyArray:
        xp = self.base.__array_namespace__()
        # Zero, a frequent initial value, has no logarithm.
        eye = _LEAST * xp.eye(3, dtype=self.unit.dtype)
        lower = cholesky(self.base / xp.max(self.unit) + eye)
        return xp.concatenate([xp.log(xp.diagonal(lower)), lower[SIDES]])

    def value(self, x: Array) -> Array:
        return jnp.max(self.unit) * squared(jnp.exp(x[:3]), x[3:])

    def natural_units(self, x: Array) -> Array:
        # The other entries of L are judged by the largest of its diagonal.
        largest = jnp.maximum(jnp.max(jnp.exp(x[:3])), 1.0)
        return jnp.concatenate([jnp.ones_like(x[:3]), jnp.full_like(x[3:], largest)])

    def off_zero(self, x: np.ndarray, least: float) -> np.ndarray:
        return np.concatenate([np.maximum(x[:3], least), x[3:]])


class _Arrays(NamedTuple):
    """The floating point arrays of the systems and the sensors.

    Attributes:
        parts: The first system, and the sensors.
        rest: The same without arrays.
        structure: Structure of their arrays.
        paths: Where each array is in `parts`.
        values: Each array of `parts`.
        leaves: The same, with an axis of trials in front where trials differ.
        stacked: Which of `leaves` have that axis.
    """

    parts: tuple[RigidBody | AbstractSensor, ...]
    rest: tuple[Any, ...]
    structure: Any  # a PyTreeDef, which is no type to pyright
    paths: list[tuple[Any, ...]]
    values: list[AnyArray]
    leaves: list[AnyArray]
    stacked: tuple[bool, ...]


def _arrays_of(
    systems: Sequence[RigidBody], sensors: Sequence[AbstractSensor], xp: ModuleType
) -> _Arrays:
    """Find the arrays of the systems and the sensors; xp stacks those of trials."""
    parts = (systems[0], *sensors)
    arrays, rest = eqx.partition(parts, eqx.is_inexact_array)
    paths_and_values, structure = jtu.tree_flatten_with_path(arrays)
    paths = [path for path, _ in paths_and_values]
    demand(
        are_alike(systems),
        "Argument `system` must hold bodies for all trials that differ in floating "
        "point arrays alone, but their torques, or functions in them, differ.",
    )
    of_trials = [_float_leaves((system, *sensors)) for system in systems]
    leaves = []
    stacked = []
    for values in zip(*of_trials, strict=True):
        # Only the identical array counts as shared: values may be traced.
        differs = any(x is not values[0] for x in values)
        leaves.append(xp.stack(values) if differs else values[0])
        stacked.append(differs)
    return _Arrays(
        parts=parts,
        rest=rest,
        structure=structure,
        paths=paths,
        values=[value for _, value in paths_and_values],
        leaves=leaves,
        stacked=tuple(stacked),
    )


def are_alike(parts: Sequence[Any]) -> bool:
    """Whether pytrees differ in floating point arrays alone."""
    first, *others = (eqx.filter(x, eqx.is_inexact_array, inverse=True) for x in parts)
    return all(bool(eqx.tree_equal(x, first)) for x in others)


def _float_leaves(parts: tuple[Any, ...]) -> list[AnyArray]:
    """The floating point arrays of a system and sensors."""
    return jtu.tree_leaves(eqx.filter(parts, eqx.is_inexact_array))


def _field_metadata(parts: Any, path: Sequence[Any]) -> Mapping[str, Any]:
    """The metadata of the field where a path ends."""
    metadata: Mapping[str, Any] = {}
    for key in path:
        # Only fields have metadata: below tuples and dictionaries it stays the same.
        if isinstance(key, jtu.GetAttrKey):
            metadata = type(parts).__dataclass_fields__[key.name].metadata
            parts = getattr(parts, key.name)
        else:
            parts = parts[key.idx if isinstance(key, jtu.SequenceKey) else key.key]
    return metadata


def _name(parts: Sequence[RigidBody | AbstractSensor], path: Sequence[Any]) -> str:
    """Name of an array: `torque.coefficient` of a system, `gyro.bias` of a sensor."""
    field = jtu.keystr(tuple(path[1:])).lstrip(".")
    index = path[0].idx
    if index == 0:
        return field
    kinds = [type(x).__name__.lower() for x in parts]
    kind = kinds[index]
    # Names are keys of dictionaries, so that two sensors of one kind need different
    # ones.
    if kinds[1:].count(kind) > 1:
        kind = f"{kind}{index}"
    return f"{kind}.{field}"


def _picks(arrays: _Arrays, free: Callable[..., Any] | None) -> list[_Pick]:
    """Arrays that `free` picks, in their order."""
    if free is None:
        return []
    indices = range(len(arrays.paths))
    # `free` is called with objects that have marks in place of their arrays.
    marked = eqx.combine(arrays.structure.unflatten(map(_Pick, indices)), arrays.rest)
    accepts = inspect.signature(free).parameters.values()
    takes_all = any(x.kind == x.VAR_POSITIONAL for x in accepts)
    demand(
        takes_all or len(accepts) <= len(marked),
        f"Argument `free` must be a function of the system and {len(marked) - 1} "
        f"sensor(s), but it takes {len(accepts)} arguments.",
    )
    chosen = jtu.tree_leaves(free(*marked[: None if takes_all else len(accepts)]))
    # A body that is picked as a whole contains the inertia, which the model seeks
    # already.
    picks = {
        pick.index: pick
        for pick in chosen
        if isinstance(pick, _Pick)
        and jtu.keystr(arrays.paths[pick.index][:2]) != "[0].inertia"
    }
    demand(
        bool(picks) and all(isinstance(x, _Pick) for x in chosen),
        "Argument `free` must be a function of the system and the sensors that picks "
        "floating point arrays of theirs, beside the inertia, which is always sought, "
        "but it is not. (What is None there needs a value, as `Gyro(delay=0.0)`.)",
    )
    return [picks[index] for index in sorted(picks)]


class Unknowns(eqx.Module):
    """Numbers that a fit seeks, and the system and sensors that they belong to.

    Attributes:
        given: Arrays of the system and the sensors, some with an axis of trials in
            front.
        rest: The system and the sensors without arrays.
        stacked: Which of `leaves` have an axis of trials.
        sought: Arrays that are sought.
        groups: By name, of arrays that are sought by groups: 1 for each trial in its
            group, else 0 (trials, groups).
        inertia_model: What is known of the tensor.
        scaled: Whether the tensor's scale is sought.
        trace: Trace of the tensor, unless its scale is sought or the model sets it.
        rate: Rms of the rates [rad/s].
        hold: Pytree that is called with these unknowns and the numbers for a residual,
            which holds a fit in one direction; None without one.
    """

    given: tuple[Any, ...]
    rest: tuple[Any, ...] = eqx.field(static=True)
    stacked: tuple[bool, ...] = eqx.field(static=True)
    sought: tuple[AbstractSought, ...]
    groups: dict[str, AnyArray]
    inertia_model: AbstractInertiaModel
    scaled: bool = eqx.field(static=True)
    trace: AnyArray
    rate: AnyArray
    hold: Callable[["Unknowns", Array], Array] | None = None

    @property
    def shared(self) -> tuple[AbstractSought, ...]:
        """Arrays that all trials share."""
        return tuple(x for x in self.sought if not x.own)

    @property
    def slices(self) -> dict[str, slice]:
        """Position of each part in the vector for all trials."""
        sizes = {"inertia": len(self.inertia_model.names), "scale": int(self.scaled)}
        sizes |= {x.name: x.size for x in self.shared}
        return dict(zip(sizes, one_after_another(sizes.values()), strict=True))

    @property
    def has_scale(self) -> bool:
        """Whether the scale of the tensor is sought, or set by the inertia model."""
        return self.scaled or self.inertia_model.absolute

    @property
    def seeks_torque(self) -> bool:
        """Whether an array of the torque is sought."""
        return any(x.name.startswith("torque") for x in self.sought)

    @property
    def of_inertia(self) -> slice:
        """Position of the numbers of the tensor."""
        return slice(self.slices["scale"].stop)

    @property
    def judged(self) -> slice:
        """Position of the numbers that judge a fit: of the inertia, or all if known."""
        return self.of_inertia if self.of_inertia.stop else slice(self.size)

    @property
    def size(self) -> int:
        """Length of the vector for all trials."""
        return max(s.stop for s in self.slices.values())

    @property
    def own_slices(self) -> list[tuple[AbstractSought, slice]]:
        """Arrays of each trial, and their positions in that trial's vector."""
        own = [x for x in self.sought if x.own]
        return list(zip(own, one_after_another(x.size for x in own), strict=True))

    def names(self) -> tuple[str, ...]:
        """A name for each number of all trials."""
        scale = ("scale",) * self.scaled
        return (
            *self.inertia_model.names,
            *scale,
            *(name for x in self.shared for name in x.names),
        )

    def inertia(self, numbers: AnyArray) -> Array:
        """The tensor."""
        tensor = self.inertia_model.inertia(numbers[self.slices["inertia"]])
        tensor = tensor.astype(numbers.dtype)
        # Free motion determines the tensor up to a factor only.
        if not self.inertia_model.absolute:
            tensor = self.trace * tensor / jnp.trace(tensor)
        if self.scaled:
            tensor = tensor * jnp.exp(numbers[self.slices["scale"].start])
        return tensor

    def in_frame(
        self, numbers: np.ndarray, like: "Unknowns | None" = None
    ) -> tuple["Unknowns", np.ndarray]:
        """The same values by numbers in another frame: as the inertia model's."""
        part = self.slices["inertia"]
        model, of_inertia = self.inertia_model.in_frame(
            numbers[part], None if like is None else like.inertia_model
        )
        numbers = np.concatenate([of_inertia, numbers[part.stop :]])
        return dataclasses.replace(self, inertia_model=model), numbers

    def moved(self, numbers: Array, change: Array) -> Array:
        """Numbers after a step of the search."""
        part = self.slices["inertia"]
        of_inertia = self.inertia_model.moved(numbers[part], change[part])
        others = numbers[part.stop :] + change[part.stop :]
        return jnp.concatenate([of_inertia, others]).astype(numbers.dtype)

    @property
    def known_tensor(self) -> AnyArray:
        """The tensor of the system that was given, in the first trial."""
        return as_tensor(self.original(0)[0].inertia)

    def start(
        self, tensor: AnyArray, flattest: AnyArray | float = 1e-3
    ) -> tuple["Unknowns", AnyArray]:
        """Initial numbers for a tensor, for which the model's frame is chosen.

        Args:
            tensor: The tensor.
            flattest: The least second moment of the body to start from.
        """
        xp = tensor.__array_namespace__()
        known = self.known_tensor.astype(tensor.dtype)
        model, of_model = self.inertia_model.start(tensor, known, flattest)
        parts = [of_model]
        if self.scaled:
            # The logarithm of a factor of the trace that was given.
            factor = xp.trace(tensor) / self.trace
            parts.append(xp.log(xp.where(factor > 0, factor, 1.0))[None])
        parts += [x.start() for x in self.shared]
        numbers = xp.concatenate([xp.asarray(x, tensor.dtype) for x in parts])
        return dataclasses.replace(self, inertia_model=model), numbers

    def own_start(self, trials: int, dtype: DTypeLike) -> AnyArray:
        """Initial numbers of each trial (trials, own)."""
        xp = self.rate.__array_namespace__()
        parts = [x.start().astype(dtype) for x, _ in self.own_slices]
        numbers = xp.concatenate([xp.zeros(0, dtype), *parts])
        return xp.tile(numbers, (trials, 1))

    def off_zero(
        self, numbers: np.ndarray, own: np.ndarray, least: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """The numbers, those of positive arrays no lower than this.

        Args:
            numbers: Of all trials.
            own: Of each trial (trials, own).
            least: Logarithm of the least value, in the unit of its array.
        """
        numbers, own = numbers.copy(), own.copy()
        slices = self.slices
        for x in self.shared:
            numbers[slices[x.name]] = x.off_zero(numbers[slices[x.name]], least)
        for x, part in self.own_slices:
            own[:, part] = [x.off_zero(row, least) for row in own[:, part]]
        return numbers, own

    @property
    def leaves(self) -> tuple[AnyArray, ...]:
        """Arrays of the system and the sensors, then those of `groups`."""
        return (*jtu.tree_leaves(self.given), *self.groups.values())

    def leaves_of(self, trial: int | AnyArray) -> tuple[AnyArray, ...]:
        """The leaves of one trial."""
        pairs = zip(self.leaves, self.stacked, strict=True)
        return tuple(x[trial] if own else x for x, own in pairs)

    def original(self, trial: int | AnyArray) -> tuple[Any, ...]:
        """System and sensors of a trial, with the arrays that were given."""
        return self._built(self.leaves_of(trial)[: self._arrays])

    @property
    def _arrays(self) -> int:
        """Number of arrays of the system and the sensors."""
        return len(self.stacked) - len(self.groups)

    def _built(self, leaves: Sequence[AnyArray]) -> tuple[Any, ...]:
        """System and sensors with these arrays."""
        return eqx.combine(jtu.tree_structure(self.given).unflatten(leaves), self.rest)

    def parts(
        self, numbers: AnyArray, own: AnyArray, leaves: tuple[AnyArray, ...]
    ) -> tuple[Any, ...]:
        """System and sensors of one trial.

        Args:
            numbers: Numbers of all trials.
            own: Numbers of the trial.
            leaves: Leaves of the trial.
        """
        slices = self.slices
        sought = [(x, numbers[slices[x.name]]) for x in self.shared]
        sought += [(x, own[part]) for x, part in self.own_slices]
        members = dict(zip(self.groups, leaves[self._arrays :], strict=True))
        arrays = list(leaves[: self._arrays])
        for x, part in sought:
            value = x.value(part).astype(numbers.dtype)
            if x.name in members:
                given = arrays[x.index].astype(numbers.dtype)
                value = _of_group(value, members[x.name], given)
            arrays[x.index] = value
        system, *sensors = self._built(arrays)
        # Some models determine the mass and the lever of the weight, too.
        mass = self.inertia_model.body(numbers[slices["inertia"]])
        changed = self.inertia(numbers), _with_mass(system.torque, mass)
        return eqx.tree_at(lambda x: (x.inertia, x.torque), system, changed), *sensors

    def natural_units(self, numbers: AnyArray) -> Array:
        """Natural units of the numbers of all trials."""
        units = [self.inertia_model.units(), jnp.ones(int(self.scaled))]
        units += [x.natural_units(numbers[self.slices[x.name]]) for x in self.shared]
        return jnp.concatenate([x.astype(numbers.dtype) for x in units])

    def prior_rows(self, numbers: AnyArray) -> Array:
        """Residuals of prior knowledge of the numbers of all trials."""
        rows = [jnp.zeros(0, numbers.dtype)]
        rows += [x.prior_rows(numbers[self.slices[x.name]]) for x in self.shared]
        if self.hold is not None:
            rows.append(self.hold(self, numbers)[None])
        return jnp.concatenate(rows)

    def own_prior_rows(self, own: AnyArray) -> Array:
        """Residuals of prior knowledge of a trial's own numbers."""
        rows = [x.prior_rows(own[part]) for x, part in self.own_slices]
        return jnp.concatenate([jnp.zeros(0, own.dtype), *rows])

    def holding(self, hold: Callable[["Unknowns", Array], Array]) -> "Unknowns":
        """The same unknowns with another `hold`."""
        return dataclasses.replace(self, hold=hold)


def _of_group(values: Array, member: AnyArray, given: AnyArray) -> Array:
    """The value of the group of a trial, or the given one in a trial of no group.

    Args:
        values: Of each group (groups, ...).
        member: 1 for the group of the trial, else 0 (groups,).
        given: The given value.
    """
    return product("g,g...->...", member, values) + (1 - jnp.sum(member)) * given


def _with_mass(torque: AbstractTorque, body: MassProperties | None) -> AbstractTorque:
    """A torque whose weights, if it has some, have the mass and lever of a body."""
    if isinstance(torque, Sum):
        return Sum(tuple(_with_mass(term, body) for term in torque.terms))
    if isinstance(torque, UniformGravity) and body is not None:
        return UniformGravity(body.mass, body.center_of_mass, torque.gravity)
    return torque


def unknowns_of(
    systems: Sequence[RigidBody],
    sensors: Sequence[AbstractSensor],
    sizes: Sequence[AnyArray],
    free: Callable[..., Any] | None,
    inertia_model: AbstractInertiaModel,
    scaled: bool,
    rate: AnyArray,
    trials: int,
) -> Unknowns:
    """Return the unknowns of a fit.

    Args:
        systems: One for all trials, or one for each.
        sensors: Sensors of the records.
        sizes: Rms of the values of each record.
        free: What is sought beside the inertia.
        inertia_model: What is known of the tensor.
        scaled: Whether the tensor's scale is sought.
        rate: Rms of the rates [rad/s].
        trials: How many trials there are.

    Raises:
        ValueError: Systems of different kinds, `free` picks what is no array, or groups
            that are not numbered from 0 on.
    """
    arrays = _arrays_of(systems, sensors, rate.__array_namespace__())
    picks = _picks(arrays, free)
    units = []
    if picks:
        # Errors of sensors may be zero: their units come from the motion.
        of_sensors = [x.units(rate, y) for x, y in zip(sensors, sizes, strict=True)]
        units = _float_leaves((systems[0], *of_sensors))
    sought = []
    groups = {}
    for pick in picks:
        x = _sought(pick, arrays, units[pick.index], rate)
        if pick.groups is not None:
            groups[x.name] = _members(pick.groups, trials, rate.dtype)
            x = _by_groups(x, groups[x.name].shape[1])
        shape = np.shape(0.0 if x.sigma is None else x.sigma)
        demand(
            _fits_into(shape, x.base.shape),
            f"Argument `sigma` of the prior of {x.name} must have shape "
            f"{x.base.shape} or be a number, but it has shape {shape}.",
        )
        sought.append(x)
    inertia = systems[0].inertia
    # The inertia of a fit is known, and numpy compiles nothing. That of a plan is
    # traced.
    if is_concrete(inertia):
        inertia = np.asarray(inertia, rate.dtype)
    inertia = inertia.astype(rate.dtype)
    return Unknowns(
        given=arrays.structure.unflatten(arrays.leaves),
        rest=arrays.rest,
        stacked=(*arrays.stacked, *(True for _ in groups)),
        sought=tuple(sought),
        groups=groups,
        inertia_model=inertia_model,
        scaled=scaled,
        trace=inertia.sum() if inertia.ndim == 1 else inertia.trace(),
        rate=rate,
    )


def _sought(
    pick: _Pick, arrays: _Arrays, unit: AnyArray, rate: AnyArray
) -> AbstractSought:
    """The array that was picked.

    Args:
        pick: Which it is.
        arrays: All arrays.
        unit: Its natural size, if it is a sensor's.
        rate: Rms of the rates.
    """
    xp = rate.__array_namespace__()
    dtype = rate.dtype
    path = arrays.paths[pick.index]
    base = arrays.values[pick.index].astype(dtype)
    is_of_system = path[0].idx == 0
    if is_of_system:
        unit = xp.max(xp.abs(base))
    # An array of zeros has no size to be measured by, nor has one of a sensor that
    # states no unit.
    unit = or_one(xp.asarray(unit, dtype))
    unit = xp.broadcast_to(unit, base.shape).astype(dtype)
    kind = _Real
    if _field_metadata(arrays.parts, path).get("positive"):
        kind = _Definite if base.shape == (3, 3) else _Positive
    return kind(
        index=pick.index,
        name=_name(arrays.parts, path),
        own=pick.own,
        base=base,
        unit=without_gradient(unit),  # its choice must not change a derivative
        sigma=None if pick.sigma is None else xp.asarray(pick.sigma, dtype),
    )


def _fits_into(shape: tuple[int, ...], whole: tuple[int, ...]) -> bool:
    """Whether an array of a shape can be broadcast to another shape."""
    try:
        return np.broadcast_shapes(shape, whole) == whole
    except ValueError:
        return False


def _by_groups(sought: AbstractSought, groups: int) -> AbstractSought:
    """The same array with a value for each group."""
    demand(
        not isinstance(sought, _Definite),
        f"Argument `free` must not seek the tensor {sought.name} by groups, but it "
        "does.",
    )

    def repeated(x: AnyArray) -> np.ndarray:
        return np.tile(x, (groups,) + (1,) * x.ndim)

    return dataclasses.replace(
        sought, base=repeated(sought.base), unit=repeated(sought.unit)
    )


def _members(groups: tuple[int, ...], trials: int, dtype: DTypeLike) -> np.ndarray:
    """1 for each trial in its group, else 0 (trials, groups)."""
    count = max(groups, default=-1) + 1
    demand(
        len(groups) == trials
        and count > 0
        and set(range(count)) <= set(groups) <= {-1, *range(count)},
        f"Argument `groups` of `each` must number the groups of {trials} trials from 0 "
        f"on, with -1 for trials in none, but it is {groups}.",
    )
    return (np.asarray(groups)[:, None] == np.arange(count)).astype(dtype)
