"""The numbers a fit seeks: of the model and scale of the inertia, and arrays picked by `free`.

They are one flat vector for all trials, and one more for each trial; `Unknowns.parts`
turns them into a system and sensors.
"""

import abc
import dataclasses
import inspect
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from jrigid._checks import demand, is_concrete
from jrigid._numerics import or_one, product, without_gradient
from jrigid._types import AnyArray, Readable
from jrigid.identify._host import cholesky
from jrigid.identify._inertia_models import AbstractInertiaModel, as_tensor
from jrigid.identify._parameters import SIDES, squared
from jrigid.identify._records import one_after_another
from jrigid.mass import MassProperties
from jrigid.torques import Sum, UniformGravity

_LEAST = 1e-3  # of its unit, for a positive number to start from


@dataclasses.dataclass(frozen=True)
class _Pick:
    """In the place of an array, for `free`: which it is, and how it is sought."""

    index: int
    sigma: Any = None
    own: bool = False
    groups: tuple[int, ...] | None = None


def prior(array: Any, sigma: Any) -> Any:
    """Within `free`: an array that is sought, known beforehand to within `sigma` of its value.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> found = jr.identify.fit(
    ...     jr.RigidBody(jnp.ones(3)), readings,
    ...     free=lambda body, gyro: jr.identify.prior(gyro.bias, 1e-3))
    >>> print(found.names[5:])
    ('gyro.bias[0]', 'gyro.bias[1]', 'gyro.bias[2]')
    """
    return jtu.tree_map(lambda x: dataclasses.replace(x, sigma=sigma), array)


def each(array: Any, groups: Sequence[int] | None = None) -> Any:
    """Within `free`: an array that is sought anew in each trial, or in each group of trials.

    A group is a session at a table: between two of them a gyro was taken off and put
    back, and sits a few degrees off. Nothing tells the turn that all share from that of
    the body, so one group keeps the misalignment that was given, and the axes are those
    of its gyro.

    Args:
        array: What is sought, or `prior(array, sigma)`.
        groups: For each trial the number of its group, from 0 on; -1 for trials in
            which the array is as it was given. None: each trial is a group.

    >>> import jrigid as jr
    >>> free = lambda body, gyro: jr.identify.each(gyro.bias)
    >>> sessions = [-1, -1, -1, 0, 0, 0, 1, 1]  # of eight trials
    >>> free = lambda body, gyro: jr.identify.each(gyro.misalignment, sessions)
    """
    groups = None if groups is None else tuple(int(x) for x in groups)
    change = {"own": True} if groups is None else {"groups": groups}
    return jtu.tree_map(lambda x: dataclasses.replace(x, **change), array)


class AbstractSought(Readable):
    """An array that is sought, by numbers without bounds; `unit` is its natural size."""

    index: int = eqx.field(static=True)
    name: str = eqx.field(static=True)
    own: bool = eqx.field(static=True)
    base: AnyArray  # as it was given; sought by groups, with an axis of groups in front
    unit: AnyArray
    sigma: AnyArray | None

    @property
    def size(self) -> int:
        """Of the numbers."""
        return self.base.size

    @property
    def names(self) -> tuple[str, ...]:
        """One for each number."""
        indices = np.ndindex(*self.base.shape)
        return tuple(self.name + "".join(f"[{j}]" for j in index) for index in indices)

    @abc.abstractmethod
    def start(self) -> AnyArray:
        """The numbers at the start."""

    @abc.abstractmethod
    def value(self, x: Array) -> Array:
        """The array."""

    def natural_units(self, x: Array) -> Array:
        """Units in which an error is large or small."""
        return jnp.ones_like(x)

    def with_errors(self, x: Array, covariance: Array) -> tuple[Array, Array]:
        """The array and its standard errors."""
        slopes = jax.jacfwd(self.value)(x)
        square = jnp.einsum("...n,nm,...m->...", slopes, covariance, slopes)
        return self.value(x), jnp.sqrt(jnp.maximum(square, 0.0))

    def log_volume(self, x: Array) -> Array:
        """Logarithm of the volume of arrays that a volume of numbers makes."""
        slopes = jax.jacfwd(self.value)(x).reshape(self.base.size, self.size)
        return 0.5 * jnp.linalg.slogdet(slopes.T @ slopes)[1]

    def prior_rows(self, x: Array) -> Array:
        """What is known of it beforehand, as residuals."""
        if self.sigma is None:
            return jnp.zeros(0, x.dtype)
        return ((self.value(x) - self.base) / self.sigma).reshape(-1)


class _Any(AbstractSought):
    """Of either sign."""

    def start(self) -> AnyArray:
        return self.unit.__array_namespace__().zeros(self.size, self.unit.dtype)

    def value(self, x: Array) -> Array:
        return self.base + self.unit * x.reshape(self.base.shape)

    def natural_units(self, x: Array) -> Array:
        return jnp.maximum(jnp.abs(self.value(x)) / self.unit, 1.0).reshape(-1)


class _Positive(AbstractSought):
    """Positive: linear in the number where it is large, exponential where it is small."""

    def start(self) -> AnyArray:
        xp = self.base.__array_namespace__()
        return xp.log(xp.expm1(xp.maximum(self.base / self.unit, _LEAST))).reshape(-1)

    def value(self, x: Array) -> Array:
        return self.unit * jax.nn.softplus(x.reshape(self.base.shape))


class _Definite(AbstractSought):
    """A symmetric, positive definite tensor: L L^T, the logarithms of L's diagonal first."""

    @property
    def size(self) -> int:
        return 6

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"{self.name}[{j}]" for j in range(6))

    def start(self) -> AnyArray:
        xp = self.base.__array_namespace__()
        eye = _LEAST * xp.eye(3, dtype=self.unit.dtype)
        lower = cholesky(self.base / xp.max(self.unit) + eye)
        return xp.concatenate([xp.log(xp.diagonal(lower)), lower[SIDES]])

    def value(self, x: Array) -> Array:
        return jnp.max(self.unit) * squared(jnp.exp(x[:3]), x[3:])


def _field(tree: Any, path: Sequence[Any]) -> Any:
    """The metadata of the field where a path ends."""
    metadata: Any = {}
    for key in path:
        if isinstance(key, jtu.GetAttrKey):
            metadata = type(tree).__dataclass_fields__[key.name].metadata
            tree = getattr(tree, key.name)
        else:
            tree = tree[key.idx if isinstance(key, jtu.SequenceKey) else key.key]
    return metadata


def _named(tree: Any, path: Sequence[Any]) -> str:
    """`torque.coefficient` of a system, `gyro.bias` of a sensor."""
    text, index = jtu.keystr(tuple(path[1:])).lstrip("."), path[0].idx
    if index == 0:
        return text
    kinds = [type(x).__name__.lower() for x in tree]
    name = kinds[index]
    return f"{name if kinds[1:].count(name) == 1 else f'{name}{index}'}.{text}"


def _picks(
    paths: Any, tree: Any, rest: Any, free: Callable[..., Any] | None
) -> list[_Pick]:
    """What `free` picks among the arrays of the system and the sensors, in their order."""
    if free is None:
        return []
    marked = eqx.combine(tree.unflatten(map(_Pick, range(len(paths)))), rest)
    accepts = inspect.signature(free).parameters.values()
    several = any(x.kind == x.VAR_POSITIONAL for x in accepts)
    chosen = jtu.tree_leaves(free(*marked[: None if several else len(accepts)]))
    known = {x.index: x for x in chosen if isinstance(x, _Pick)}
    known = {
        i: x for i, x in known.items() if jtu.keystr(paths[i][0][:2]) != "[0].inertia"
    }
    demand(
        bool(known) and all(isinstance(x, _Pick) for x in chosen),
        "Argument `free` must be a function of the system and the sensors that picks floating "
        "point arrays of theirs, beside the inertia, which is always sought, but it is not.",
    )
    return [known[i] for i in sorted(known)]


class Unknowns(eqx.Module):
    """What is sought, in what numbers, around what system and sensors."""

    given: tuple[
        Any, ...
    ]  # arrays of system and sensors, some with an axis of trials in front
    rest: tuple[Any, ...] = eqx.field(static=True)  # what is no array
    stacked: tuple[bool, ...] = eqx.field(static=True)  # which of `leaves` have
    sought: tuple[AbstractSought, ...]
    # Of what is sought by groups, by name: 1 for each trial in its group, else 0.
    groups: dict[str, AnyArray]
    inertia_model: AbstractInertiaModel
    scaled: bool = eqx.field(static=True)
    trace: AnyArray
    rate: AnyArray  # rms of the rates [rad/s]
    hold: Any = (
        None  # held at zero: a pytree that is called with these unknowns and numbers
    )

    @property
    def shared(self) -> tuple[AbstractSought, ...]:
        """What is sought for all trials."""
        return tuple(x for x in self.sought if not x.own)

    @property
    def slices(self) -> dict[str, slice]:
        """Where each part is in the vector for all trials."""
        sizes = {"inertia": len(self.inertia_model.names), "scale": int(self.scaled)}
        sizes |= {x.name: x.size for x in self.shared}
        return dict(zip(sizes, one_after_another(sizes.values()), strict=True))

    @property
    def of_inertia(self) -> slice:
        """Where the numbers are that move the tensor."""
        return slice(self.slices["scale"].stop)

    @property
    def judged(self) -> slice:
        """Where the numbers are by which a fit is judged: of the inertia; all if that is known."""
        return self.of_inertia if self.of_inertia.stop else slice(self.size)

    @property
    def size(self) -> int:
        """Of the vector for all trials."""
        return max(s.stop for s in self.slices.values())

    @property
    def own_slices(self) -> list[tuple[AbstractSought, slice]]:
        """What is sought in each trial, and where it is in that trial's vector."""
        own = [x for x in self.sought if x.own]
        return list(zip(own, one_after_another(x.size for x in own), strict=True))

    def names(self) -> tuple[str, ...]:
        """One for each number."""
        scale = ("scale",) * self.scaled
        return (
            *self.inertia_model.names,
            *scale,
            *(name for x in self.shared for name in x.names),
        )

    def inertia(self, numbers: AnyArray) -> Array:
        """The tensor."""
        tensor = self.inertia_model.inertia(numbers[self.slices["inertia"]]).astype(
            numbers.dtype
        )
        if not self.inertia_model.absolute:
            tensor = self.trace * tensor / jnp.trace(tensor)
        return (
            tensor * jnp.exp(numbers[self.slices["scale"].start])
            if self.scaled
            else tensor
        )

    @property
    def known_tensor(self) -> AnyArray:
        """The system's own tensor, of the first trial."""
        return as_tensor(self.original(0)[0].inertia)

    def start(
        self, tensor: AnyArray, flattest: AnyArray | float = 1e-3
    ) -> tuple["Unknowns", AnyArray]:
        """Numbers for a tensor; the frame of the model is chosen for it."""
        unknowns, numbers = self.starts(tensor[None], [flattest])
        return unknowns, numbers[0]

    def starts(
        self, tensors: AnyArray, flattest: Sequence[AnyArray | float]
    ) -> tuple["Unknowns", AnyArray]:
        """Numbers for each of several tensors; the frame of the model is chosen for the first."""
        xp = tensors.__array_namespace__()
        known = self.known_tensor.astype(tensors.dtype)
        pairs = zip(tensors, flattest, strict=True)
        models = [
            self.inertia_model.start(tensor, known, least) for tensor, least in pairs
        ]
        factors = xp.trace(tensors, axis1=1, axis2=2) / self.trace
        scales = xp.log(xp.where(factors > 0, factors, 1.0))
        others = [x.start() for x in self.shared]
        rows = []
        for (_, of_model), scale in zip(models, scales, strict=True):
            parts = [of_model, scale[None][: int(self.scaled)], *others]
            rows.append(xp.concatenate([xp.asarray(x, tensors.dtype) for x in parts]))
        return dataclasses.replace(self, inertia_model=models[0][0]), xp.stack(rows)

    def own_start(self, trials: int, dtype: Any) -> AnyArray:
        """Numbers of each trial."""
        xp = self.rate.__array_namespace__()
        parts = [
            xp.zeros(0, dtype),
            *(x.start().astype(dtype) for x, _ in self.own_slices),
        ]
        return xp.tile(xp.concatenate(parts), (trials, 1))

    @property
    def leaves(self) -> tuple[AnyArray, ...]:
        """The arrays of the system and the sensors, then those of `groups`."""
        return (*jtu.tree_leaves(self.given), *self.groups.values())

    def leaves_of(self, trial: int | AnyArray) -> tuple[AnyArray, ...]:
        """The same of one trial."""
        pairs = zip(self.leaves, self.stacked, strict=True)
        return tuple(x[trial] if own else x for x, own in pairs)

    def original(self, trial: int | AnyArray) -> tuple[Any, ...]:
        """System and sensors of a trial as they were given."""
        return self._built(self.leaves_of(trial)[: self._arrays])

    @property
    def _arrays(self) -> int:
        """How many arrays the system and the sensors have."""
        return len(self.stacked) - len(self.groups)

    def _built(self, leaves: Sequence[AnyArray]) -> tuple[Any, ...]:
        return eqx.combine(jtu.tree_structure(self.given).unflatten(leaves), self.rest)

    def parts(
        self, numbers: AnyArray, own: AnyArray, leaves: tuple[AnyArray, ...]
    ) -> tuple[Any, ...]:
        """System and sensors of a trial: of its own numbers and the arrays given for it."""
        arrays, slices = list(leaves[: self._arrays]), self.slices
        member = dict(zip(self.groups, leaves[self._arrays :], strict=True))
        found = [(x, numbers[slices[x.name]]) for x in self.shared]
        for x, part in found + [(x, own[s]) for x, s in self.own_slices]:
            value = x.value(part).astype(numbers.dtype)
            if x.name in member:  # as it was given in a trial that is in no group
                given, weights = arrays[x.index].astype(numbers.dtype), member[x.name]
                value = (
                    product("g,g...->...", weights, value)
                    + (1 - jnp.sum(weights)) * given
                )
            arrays[x.index] = value
        system, *sensors = self._built(arrays)
        mass = self.inertia_model.body(numbers[slices["inertia"]])
        changed = self.inertia(numbers), _of_body(system.torque, mass)
        return eqx.tree_at(lambda x: (x.inertia, x.torque), system, changed), *sensors

    def natural_units(self, numbers: AnyArray) -> Array:
        """Units in which an error is large or small: for what is picked, its size."""
        units = [self.inertia_model.units(), jnp.ones(int(self.scaled))]
        units += [x.natural_units(numbers[self.slices[x.name]]) for x in self.shared]
        return jnp.concatenate([x.astype(numbers.dtype) for x in units])

    def prior_rows(self, numbers: AnyArray) -> Array:
        """What is known beforehand of the numbers for all trials, as residuals."""
        rows = [jnp.zeros(0, numbers.dtype)]
        rows += [x.prior_rows(numbers[self.slices[x.name]]) for x in self.shared]
        rows += [] if self.hold is None else [self.hold(self, numbers)[None]]
        return jnp.concatenate(rows)

    def own_prior_rows(self, own: AnyArray) -> Array:
        """What is known beforehand of a trial's own numbers."""
        rows = [x.prior_rows(own[s]) for x, s in self.own_slices]
        return jnp.concatenate([jnp.zeros(0, own.dtype), *rows])

    def holding(self, hold: Any) -> "Unknowns":
        """The same, with something held."""
        return dataclasses.replace(self, hold=hold)


def _of_body(torque: Any, body: MassProperties | None) -> Any:
    """The torque, with the body's mass and lever where it has some of its own."""
    if isinstance(torque, Sum):
        return Sum(tuple(_of_body(term, body) for term in torque.terms))
    if isinstance(torque, UniformGravity) and body is not None:
        return UniformGravity(body.mass, body.center_of_mass, torque.gravity)
    return torque


def unknowns_of(
    systems: Sequence[Any],
    sensors: tuple[Any, ...],
    sizes: Sequence[AnyArray],
    free: Callable[..., Any] | None,
    inertia_model: AbstractInertiaModel,
    scaled: bool,
    rate: AnyArray,
    trials: int,
) -> Unknowns:
    """Set up the numbers.

    Args:
        systems: One, or one for each trial.
        sensors: Those of the records.
        sizes: Rms of the values of each.
        free: What is sought beside the inertia.
        inertia_model: What is known of the tensor.
        scaled: Whether the tensor's scale is sought.
        rate: Rms of the rates.
        trials: How many there are.
    """
    dtype, parts = rate.dtype, (systems[0], *sensors)
    arrays, rest = eqx.partition(parts, eqx.is_inexact_array)
    paths, tree = jtu.tree_flatten_with_path(arrays)
    rows = [
        jtu.tree_leaves(eqx.filter((x, *sensors), eqx.is_inexact_array))
        for x in systems
    ]
    text = "must hold bodies of the same kind for all trials, but it does not."
    demand(all(len(x) == len(paths) for x in rows), f"Argument `system` {text}")
    columns = list(zip(*rows, strict=True))  # of each array
    stacked = tuple(any(x is not column[0] for x in column) for column in columns)
    xp = rate.__array_namespace__()
    leaves = [
        xp.stack(x) if own else x[0] for x, own in zip(columns, stacked, strict=True)
    ]
    picks = _picks(paths, tree, rest, free)
    if picks:
        units = [x.units(rate, size) for x, size in zip(sensors, sizes, strict=True)]
        units = jtu.tree_leaves(eqx.filter((systems[0], *units), eqx.is_inexact_array))
    sought, groups = [], {}
    for pick in picks:
        path, base = paths[pick.index]
        base, largest = base.astype(dtype), xp.max(xp.abs(base)).astype(dtype)
        of_system = path[0].idx == 0  # type: ignore[union-attr]
        unit = or_one(largest) if of_system else xp.asarray(units[pick.index], dtype)
        unit = without_gradient(xp.broadcast_to(unit, base.shape).astype(dtype))
        sigma = None if pick.sigma is None else xp.asarray(pick.sigma, dtype)
        positive = _Definite if base.shape == (3, 3) else _Positive
        kind = positive if _field(parts, path).get("positive") else _Any
        name = _named(parts, path)
        if pick.groups is not None:
            groups[name] = member = _members(pick.groups, trials, dtype)
            demand(
                kind is not _Definite,
                f"Argument `free` must not seek the tensor {name} by groups, but it does.",
            )
            base, unit = (
                np.tile(x, (member.shape[1],) + (1,) * x.ndim) for x in (base, unit)
            )
        sought.append(kind(pick.index, name, pick.own, base, unit, sigma))
    inertia = systems[0].inertia
    inertia = (
        np.asarray(inertia, dtype) if is_concrete(inertia) else inertia.astype(dtype)
    )
    trace = inertia.sum() if inertia.ndim == 1 else inertia.trace()
    given = tree.unflatten(leaves)
    stacked = (*stacked, *(True for _ in groups))
    return Unknowns(
        given, rest, stacked, tuple(sought), groups, inertia_model, scaled, trace, rate
    )


def _members(groups: tuple[int, ...], trials: int, dtype: Any) -> np.ndarray:
    """1 for each trial in its group, else 0 (trials, groups)."""
    count = max(groups, default=-1) + 1
    demand(
        len(groups) == trials
        and count > 0
        and set(range(count)) <= set(groups) <= {-1, *range(count)},
        f"Argument `groups` of `each` must number the groups of {trials} trials from 0 on, with -1 "
        f"for trials in none, but it is {groups}.",
    )
    return (np.asarray(groups)[:, None] == np.arange(count)).astype(dtype)
