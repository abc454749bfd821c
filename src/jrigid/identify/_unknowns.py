"""The numbers a fit seeks: of the shape and scale of the inertia, and arrays picked by `free`.

They are one flat vector for all throws, and one more for each throw; `Unknowns.parts` turns them
into a system and sensors.
"""

import abc
import dataclasses
import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array

from jrigid._types import Readable
from jrigid.identify._shapes import AbstractShape, as_tensor
from jrigid.mass import MassProperties
from jrigid.torques import Sum, UniformGravity

_LEAST = 1e-3  # of its unit, for a positive number to start from


class _Pick(NamedTuple):
    """An array that `free` picked: its place among the arrays, and how it is sought."""

    index: int
    sigma: Any = None
    own: bool = False


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
    return jtu.tree_map(lambda x: x._replace(sigma=sigma), array, is_leaf=_is_pick)


def each(array: Any) -> Any:
    """Within `free`: an array that is sought anew in each throw; `each(prior(array, sigma))` too.

    >>> import jrigid as jr
    >>> free = lambda body, gyro: jr.identify.each(gyro.bias)
    """
    return jtu.tree_map(lambda x: x._replace(own=True), array, is_leaf=_is_pick)


def _is_pick(x: Any) -> bool:
    return isinstance(x, _Pick)


class AbstractSought(Readable):
    """An array that is sought, by numbers without bounds; `unit` is its natural size."""

    index: int = eqx.field(static=True)
    name: str = eqx.field(static=True)
    own: bool = eqx.field(static=True)
    base: Array
    unit: Array
    sigma: Array | None

    @property
    def size(self) -> int:
        """Of the numbers."""
        return self.base.size

    @property
    def names(self) -> tuple[str, ...]:
        """One for each number."""
        whole = self.base.ndim == 0
        return (self.name,) if whole else tuple(f"{self.name}[{j}]" for j in range(self.size))

    @abc.abstractmethod
    def start(self) -> Array:
        """The numbers at the start."""

    @abc.abstractmethod
    def value(self, x: Array) -> Array:
        """The array."""

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

    def start(self) -> Array:
        return jnp.zeros(self.size, self.unit.dtype)

    def value(self, x: Array) -> Array:
        return self.base + self.unit * x.reshape(self.base.shape)


class _Positive(AbstractSought):
    """Positive: linear in the number where it is large, exponential where it is small."""

    def start(self) -> Array:
        return jnp.log(jnp.expm1(jnp.maximum(self.base / self.unit, _LEAST))).reshape(-1)

    def value(self, x: Array) -> Array:
        return self.unit * jax.nn.softplus(x.reshape(self.base.shape))


class _Definite(AbstractSought):
    """A symmetric, positive definite tensor: L L^T, the logarithms of L's diagonal first."""

    @property
    def size(self) -> int:
        return 6

    def start(self) -> Array:
        eye = _LEAST * jnp.eye(3, dtype=self.unit.dtype)
        lower = jnp.linalg.cholesky(self.base / jnp.max(self.unit) + eye)
        sides = jnp.stack([lower[1, 0], lower[2, 0], lower[2, 1]])
        return jnp.concatenate([jnp.log(jnp.diagonal(lower)), sides])

    def value(self, x: Array) -> Array:
        zero, size = jnp.zeros_like(x[0]), jnp.exp(x[:3])
        rows = [[size[0], zero, zero], [x[3], size[1], zero], [x[4], x[5], size[2]]]
        lower = jnp.stack([jnp.stack(row) for row in rows])
        return jnp.max(self.unit) * (lower @ lower.T)


def _field(tree: Any, path: Sequence[Any]) -> Any:
    """The metadata of the field where a path ends."""
    metadata: Any = {}
    for key in path:
        if isinstance(key, jtu.GetAttrKey):
            fields = {x.name: x.metadata for x in dataclasses.fields(tree)}
            metadata = fields[key.name]
            tree = getattr(tree, key.name)
        else:
            tree = tree[key.idx if isinstance(key, jtu.SequenceKey) else key.key]
    return metadata


def _named(tree: Any, path: Sequence[Any]) -> str:
    """`torque.coefficient` of a system, `gyro.bias` of a sensor."""
    part, *inner = path
    text = jtu.keystr(tuple(inner)).lstrip(".")
    if part.idx == 0:
        return text
    sensors = [type(x).__name__.lower() for x in tree[1:]]
    name = sensors[part.idx - 1]
    return f"{name if sensors.count(name) == 1 else f'{name}{part.idx}'}.{text}"


def _picks(parts: tuple[Any, ...], free: Callable[..., Any] | None) -> list[_Pick]:
    """What `free` picks among the arrays of the system and the sensors, in their order."""
    if free is None:
        return []
    arrays, rest = eqx.partition(parts, eqx.is_inexact_array)
    flat, tree = jtu.tree_flatten(arrays)
    marked = eqx.combine(tree.unflatten([_Mark(i) for i in range(len(flat))]), rest)
    marked = jtu.tree_map(lambda x: _Pick(x.index) if isinstance(x, _Mark) else x, marked)
    accepts = inspect.signature(free).parameters.values()
    if any(x.kind == x.VAR_POSITIONAL for x in accepts):
        count = len(parts)
    else:
        count = min(len(parts), len(accepts))
    chosen = jtu.tree_leaves(free(*marked[:count]), is_leaf=_is_pick)
    paths = [path for path, _ in jtu.tree_leaves_with_path(arrays)]
    known = {x.index: x for x in chosen if _is_pick(x)}
    known = {i: x for i, x in known.items() if not jtu.keystr(paths[i]).startswith("[0].inertia")}
    if not known or not all(map(_is_pick, chosen)):
        raise ValueError(
            "Argument `free` must be a function of the system and the sensors that picks floating "
            "point arrays of theirs, beside the inertia, which is always sought, but it is not."
        )
    return [known[i] for i in sorted(known)]


class _Mark:
    """In the place of an array."""

    def __init__(self, index: int):
        self.index = index


class Unknowns(eqx.Module):
    """What is sought, in what numbers, around what system and sensors."""

    given: tuple[Any, ...]  # arrays of system and sensors, some with an axis of throws in front
    rest: tuple[Any, ...] = eqx.field(static=True)  # what is no array
    stacked: tuple[bool, ...] = eqx.field(static=True)  # which arrays have
    sought: tuple[AbstractSought, ...]
    shapes: tuple[AbstractShape, ...]  # of each body
    scaled: bool = eqx.field(static=True)
    trace: Array
    rate: Array  # rms of the rates [rad/s]
    hold: Any = None  # what of the numbers is held at zero: a function that is a pytree

    @property
    def slices(self) -> dict[str, slice]:
        """Where each part is in the vector for all throws."""
        parts = {"shape": sum(len(x.names) for x in self.shapes)}
        parts["scale"] = len(self.shapes) * self.scaled
        parts.update({x.name: x.size for x in self.sought if not x.own})
        found, end = {}, 0
        for name, size in parts.items():
            found[name] = slice(end, end + size)
            end += size
        return found

    @property
    def size(self) -> int:
        """Of the vector for all throws."""
        return max(s.stop for s in self.slices.values())

    @property
    def own(self) -> tuple[AbstractSought, ...]:
        """What is sought in each throw."""
        return tuple(x for x in self.sought if x.own)

    @property
    def own_slices(self) -> list[tuple[AbstractSought, slice]]:
        """What is sought in each throw, and where it is in that throw's vector."""
        ends = np.cumsum([0, *(x.size for x in self.own)])
        return [(x, slice(int(a), int(a) + x.size)) for x, a in zip(self.own, ends, strict=False)]

    def names(self) -> tuple[str, ...]:
        """One for each number."""
        several = len(self.shapes) > 1
        end = [f" of body {i}" if several else "" for i in range(len(self.shapes))]
        found = [name + end[i] for i, x in enumerate(self.shapes) for name in x.names]
        found += ["scale" + x for x in end] * self.scaled
        return (*found, *(name for x in self.sought if not x.own for name in x.names))

    def inertia(self, numbers: Array, body: int | Array = 0) -> Array:
        """The tensor of a body."""
        dtype, end, found = numbers.dtype, 0, []
        for i, shape in enumerate(self.shapes):
            start, end = end, end + len(shape.names)
            tensor = shape.inertia(numbers[start:end]).astype(dtype)
            if not shape.absolute:
                tensor = self.trace * tensor / jnp.trace(tensor)
            if self.scaled:
                tensor = tensor * jnp.exp(numbers[self.slices["scale"]][i])
            found.append(tensor)
        return found[0] if len(found) == 1 else jnp.stack(found)[body]

    def start(self, tensors: Array, flattest: float = 1e-3) -> tuple["Unknowns", Array]:
        """Numbers for the bodies' tensors; the frames of their shapes are chosen for them."""
        known = as_tensor(self.original(0)[0].inertia.astype(tensors.dtype))
        pairs = [
            shape.start(tensor, known, flattest)
            for shape, tensor in zip(self.shapes, tensors, strict=True)
        ]
        factors = jnp.trace(tensors, axis1=-2, axis2=-1) / self.trace
        scales = jnp.log(jnp.where(factors > 0, factors, 1.0))[: len(pairs) * self.scaled]
        shared = [x.start() for x in self.sought if not x.own]
        numbers = [*(x for _, x in pairs), scales, *shared]
        unknowns = eqx.tree_at(
            lambda u: u.shapes, self, tuple(shape for shape, _ in pairs),
            is_leaf=lambda x: x is None,
        )  # fmt: skip
        return unknowns, jnp.concatenate([x.astype(tensors.dtype) for x in numbers])

    def own_start(self, throws: int, dtype: Any) -> Array:
        """Numbers of each throw."""
        parts = [jnp.zeros(0, dtype), *(x.start().astype(dtype) for x in self.own)]
        return jnp.tile(jnp.concatenate(parts), (throws, 1))

    @property
    def leaves(self) -> tuple[Array, ...]:
        """The arrays of the system and the sensors."""
        return tuple(jtu.tree_leaves(self.given))

    def original(self, throw: int) -> tuple[Any, ...]:
        """System and sensors of a throw as they were given."""
        pairs = zip(self.leaves, self.stacked, strict=True)
        return self._built([x[throw] if own else x for x, own in pairs])

    def _built(self, leaves: Sequence[Array]) -> tuple[Any, ...]:
        arrays = jtu.tree_unflatten(jtu.tree_structure(self.given), leaves)
        return eqx.combine(arrays, self.rest)

    def parts(
        self, numbers: Array, own: Array, leaves: tuple[Array, ...], body: int | Array
    ) -> tuple[Any, ...]:
        """System and sensors of a throw: of its own numbers, the arrays given for it, its body."""
        leaves_, slices = list(leaves), self.slices
        found = [(x, numbers[slices[x.name]]) for x in self.sought if not x.own]
        found += [(x, own[s]) for x, s in self.own_slices]
        for x, part in found:
            leaves_[x.index] = x.value(part).astype(numbers.dtype)
        system, *sensors = self._built(leaves_)
        mass = None
        if len(self.shapes) == 1:
            mass = self.shapes[0].body(numbers[: len(self.shapes[0].names)])
        torque = _of_body(system.torque, mass)
        inertia = self.inertia(numbers, body)
        return eqx.tree_at(lambda x: (x.inertia, x.torque), system, (inertia, torque)), *sensors

    def natural_units(self, numbers: Array) -> Array:
        """Units in which an error is large or small: for what is picked, its size."""
        units = [x.units() for x in self.shapes] + [jnp.ones(len(self.shapes) * self.scaled)]
        for x in self.sought:
            if isinstance(x, _Any) and not x.own:
                size = jnp.abs(x.value(numbers[self.slices[x.name]])) / x.unit
                units.append(jnp.maximum(size, 1.0).reshape(-1))
            elif not x.own:
                units.append(jnp.ones(x.size))
        return jnp.concatenate([x.astype(numbers.dtype) for x in units])

    def prior_rows(self, numbers: Array) -> Array:
        """What is known beforehand of the numbers for all throws, as residuals."""
        rows = [jnp.zeros(0, numbers.dtype)]
        rows += [x.prior_rows(numbers[self.slices[x.name]]) for x in self.sought if not x.own]
        if self.hold is not None:
            rows.append(self.hold(numbers)[None])
        return jnp.concatenate(rows)

    def own_prior_rows(self, own: Array) -> Array:
        """What is known beforehand of a throw's own numbers."""
        rows = [x.prior_rows(own[s]) for x, s in self.own_slices]
        return jnp.concatenate([jnp.zeros(0, own.dtype), *rows])

    def holding(self, hold: Any) -> "Unknowns":
        """The same, with something held."""
        return eqx.tree_at(lambda x: x.hold, self, hold, is_leaf=lambda x: x is None)


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
    sizes: Sequence[Array],
    free: Callable[..., Any] | None,
    shapes: tuple[AbstractShape, ...],
    scaled: bool,
    rate: Array,
) -> Unknowns:
    """Set up the numbers.

    Args:
        systems: One, or one for each throw.
        sensors: Those of the records.
        sizes: Rms of the values of each.
        free: What is sought beside the inertia.
        shapes: Of each body.
        scaled: Whether the tensor's scale is sought.
        rate: Rms of the rates.
    """
    dtype, parts = rate.dtype, (systems[0], *sensors)
    arrays, rest = eqx.partition(parts, eqx.is_inexact_array)
    flat, tree = jtu.tree_flatten(arrays)
    others = [jtu.tree_leaves(eqx.filter((x, *sensors), eqx.is_inexact_array)) for x in systems]
    if any(len(x) != len(flat) for x in others):
        raise ValueError(
            "Argument `system` must hold bodies of the same kind for all throws, but it does not."
        )
    stacked = tuple(any(x[i] is not leaf for x in others) for i, leaf in enumerate(flat))
    leaves = tuple(
        jnp.stack([x[i] for x in others]) if own else leaf
        for i, (leaf, own) in enumerate(zip(flat, stacked, strict=True))
    )
    units = [x.units(rate, size) for x, size in zip(sensors, sizes, strict=True)]
    units = jtu.tree_leaves(eqx.filter((systems[0], *units), eqx.is_inexact_array))
    paths = [path for path, _ in jtu.tree_leaves_with_path(arrays)]
    sought = []
    for pick in _picks(parts, free):
        base, path = flat[pick.index].astype(dtype), paths[pick.index]
        of_system = path[0].idx == 0  # type: ignore[union-attr]
        largest = jnp.max(jnp.abs(base))
        unit = jnp.where(largest > 0, largest, 1.0) if of_system else units[pick.index]
        unit = jax.lax.stop_gradient(jnp.broadcast_to(unit, base.shape).astype(dtype))
        sigma = None if pick.sigma is None else jnp.asarray(pick.sigma, dtype)
        kind = _Any
        if _field(parts, path).get("positive"):
            kind = _Definite if base.shape == (3, 3) else _Positive
        sought.append(kind(pick.index, _named(parts, path), pick.own, base, unit, sigma))
    inertia = as_tensor(systems[0].inertia.astype(dtype))
    given = tree.unflatten(leaves)
    return Unknowns(given, rest, stacked, tuple(sought), shapes, scaled, jnp.trace(inertia), rate)
