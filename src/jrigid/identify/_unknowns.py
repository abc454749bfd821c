"""The numbers a fit seeks: shape and scale of the inertia, leaves of the system, the gyro's errors.

They are one flat vector; `Unknowns.system_and_gyro` turns it into a body and a sensor.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from jrigid._checks import check_option
from jrigid._numerics import product
from jrigid._spectral import eigh
from jrigid.identify._parameters import LogCholesky
from jrigid.mass import MassProperties
from jrigid.rotation import hat
from jrigid.systems import AbstractSystem
from jrigid.torques import Sum, UniformGravity

SHAPES = {"tensor": 5, "moments": 2, "symmetric": 3, "top": 1, "flat": 4, "fixed": 0}
SCALES = ("trace", "known", "rotor")
NUISANCES = {
    "gyro_bias": 3,  # in units of the record's rms rate
    "gyro_scale": 1,  # common to the three axes
    "gyro_scales": 3,
    "gyro_misalignment": 3,  # a small turn of the gyro from the axes of everything else
    "gyro_matrix": 9,
    "gyro_handedness": 0,  # a discrete one: see `FitResult.mirror`
}
# Second moments of a mass are kept this fraction of their trace from flat, at the start.
_FLATTEST = 1e-3
# ... and where the fit is said to have run into a boundary.
BOUNDARY = 1e-7


def second_moments(tensor: Array) -> Array:
    """Sigma of unit trace: 1 - 2 I / trace I."""
    return jnp.eye(3, dtype=tensor.dtype) - 2 * tensor / jnp.trace(tensor)


def as_tensor(inertia: Array) -> Array:
    """A tensor, of moments or itself."""
    return jnp.diag(inertia) if inertia.ndim == 1 else inertia


def real_body(tensor: Array, flattest: float) -> Array:
    """The nearest shape of a body with extent in three directions: Sigma of unit trace."""
    values, axes = eigh(second_moments(tensor))
    values = jnp.maximum(values, flattest)
    values = values / jnp.sum(values)
    return product("ik,k,jk->ij", axes, values, axes)


class Unknowns(eqx.Module):
    """What is sought, in what numbers, around what system."""

    system: Any  # arrays
    functions: Any = eqx.field(static=True)
    shape: str = eqx.field(static=True)
    scaled: bool = eqx.field(static=True)
    leaves: tuple[int, ...] = eqx.field(static=True)
    nuisances: tuple[str, ...] = eqx.field(static=True)
    priors: tuple[Array | None, ...]
    chart: Array
    trace: Array
    rate: Array  # rms of the rates [rad/s]
    held: Any = eqx.field(static=True, default=None)  # a function of the tensor that is held
    constraint: tuple[Array, Array] | None = None  # at a value, to within a unit
    ten: LogCholesky | None = None  # in place of a shape

    @property
    def slices(self) -> dict[str, slice]:
        """Where each part is in the flat vector."""
        of_shape = SHAPES[self.shape] if self.ten is None else len(self.ten.sought)
        sizes = {"shape": of_shape, "scale": int(self.scaled)}
        flat = jtu.tree_leaves(self.system)
        sizes["leaves"] = sum(flat[i].size for i in self.leaves)
        sizes.update({name: NUISANCES[name] for name in self.nuisances})
        found, at = {}, 0
        for name, size in sizes.items():
            found[name] = slice(at, at + size)
            at += size
        return found

    @property
    def size(self) -> int:
        """Of the flat vector."""
        return max(s.stop for s in self.slices.values())

    @property
    def original(self) -> Any:
        """The system as it was given."""
        return eqx.combine(self.system, self.functions)

    def names(self) -> tuple[str, ...]:
        """One for each number."""
        found: list[str] = []
        paths = jtu.tree_leaves_with_path(self.system)
        for name, s in self.slices.items():
            if name == "leaves":
                for i in self.leaves:
                    path, leaf = paths[i]
                    text = jtu.keystr(path).lstrip(".")
                    parts = [text] if leaf.ndim == 0 else [f"{text}[{j}]" for j in range(leaf.size)]
                    found.extend(parts)
            elif name == "shape" and self.ten is not None:
                found.extend(self.ten.sought)
            elif s.stop - s.start == 1:
                found.append(name)
            else:
                found.extend(f"{name}[{j}]" for j in range(s.stop - s.start))
        return tuple(found)

    def leaf_units(self) -> Array:
        """Sizes of the free leaves at the start, one for each number."""
        flat = jtu.tree_leaves(self.system)
        units = [jnp.zeros(0, self.rate.dtype)]
        for i in self.leaves:
            size = jnp.max(jnp.abs(flat[i])).astype(self.rate.dtype)
            units.append(jnp.full(flat[i].size, jnp.where(size > 0, size, 1.0)))
        return jax.lax.stop_gradient(jnp.concatenate(units))

    def natural_units(self, numbers: Array) -> Array:
        """Units in which an error is large or small: of a leaf its size, at the start or found."""
        s = self.slices["leaves"]
        units = self.leaf_units()
        sizes = jnp.abs(self.leaf_values(numbers)) / units
        found = jnp.ones_like(numbers).at[s].set(jnp.maximum(sizes, 1.0))
        if self.ten is not None:
            found = found.at[self.slices["shape"]].set(self.ten.units.astype(found.dtype))
        return found

    def leaf_values(self, numbers: Array) -> Array:
        """The free leaves, side by side."""
        flat = jtu.tree_leaves(self.system)
        start = [flat[i].reshape(-1).astype(numbers.dtype) for i in self.leaves]
        start = jnp.concatenate([jnp.zeros(0, numbers.dtype), *start])
        return start + self.leaf_units() * numbers[self.slices["leaves"]]

    def inertia(self, numbers: Array) -> Array:
        """The tensor."""
        s = self.slices
        p = numbers[s["shape"]]
        template = self.original.inertia.astype(numbers.dtype)
        if self.ten is not None:
            tensor = self.ten.body(p).about(jnp.zeros(3, p.dtype))
        elif self.shape == "fixed":
            tensor = as_tensor(template)
        else:
            sigma = _shape(self.shape, p)
            sigma = product("ik,kl,jl->ij", self.chart, sigma, self.chart)
            sigma = sigma / jnp.trace(sigma)
            tensor = 0.5 * self.trace * (jnp.eye(3, dtype=sigma.dtype) - sigma)
        return jnp.exp(numbers[s["scale"]][0]) * tensor if self.scaled else tensor

    def start(self, tensor: Array, flattest: float = _FLATTEST) -> tuple["Unknowns", Array]:
        """Numbers for a tensor, of the shape that is sought; the frame is chosen for it."""
        if self.ten is not None:
            start = self.ten.start.astype(tensor.dtype)
            return self, jnp.zeros(self.size, start.dtype).at[self.slices["shape"]].set(start)
        chart, sigma = self.chart, real_body(tensor, flattest)
        p = jnp.zeros(SHAPES[self.shape], sigma.dtype)
        if self.shape == "tensor":
            chart = jnp.eye(3, dtype=sigma.dtype)
            lower = jnp.linalg.cholesky(sigma) / jnp.sqrt(sigma[0, 0])
            p = jnp.stack(
                [
                    jnp.log(lower[1, 1]),
                    jnp.log(lower[2, 2]),
                    lower[1, 0],
                    lower[2, 0],
                    lower[2, 1],
                ]
            )
        elif self.shape in ("moments", "top"):
            sigma = product("ki,kl,li->i", chart, sigma, chart)
            if self.shape == "moments":
                p = jnp.log(sigma[1:] / sigma[0])
            else:
                p = jnp.log(2 * sigma[2:] / (sigma[0] + sigma[1]))
        elif self.shape in ("symmetric", "flat"):
            values, chart = eigh(sigma)
            if self.shape == "flat":  # the largest second moment first
                chart, values = chart[:, ::-1], values[::-1]
                p = p.at[0].set(0.5 * jnp.log(values[1] / values[0]))
            else:  # the odd one out last
                last = values[2] - values[1] > values[1] - values[0]
                chart = jnp.where(last, chart, chart[:, ::-1])
                values = jnp.where(last, values, values[::-1])
                p = p.at[0].set(jnp.log(2 * values[2] / (values[0] + values[1])))
        numbers = jnp.zeros(self.size, sigma.dtype).at[self.slices["shape"]].set(p)
        if self.scaled:
            factor = jnp.trace(tensor) / self.trace
            log_scale = jnp.log(jnp.where(factor > 0, factor, 1.0))
            numbers = numbers.at[self.slices["scale"]].set(log_scale)
        unknowns = eqx.tree_at(lambda u: u.chart, self, chart)
        return unknowns, numbers

    def rounder(self, tensor: Array, numbers: Array) -> Array:
        """Numbers for a body half way to a sphere: another place to start from."""
        if self.ten is not None or self.shape not in ("tensor", "moments", "top"):
            return numbers
        sphere = jnp.eye(3, dtype=tensor.dtype) * jnp.trace(tensor) / 3
        return self.start(0.5 * (tensor + sphere), 0.1)[1]

    def system_and_gyro(self, numbers: Array) -> tuple[AbstractSystem, Callable[[Array], Array]]:
        """The body, and what its gyro makes of an angular velocity."""
        values, tree = jtu.tree_flatten(self.system)
        found, at = self.leaf_values(numbers), 0
        for i in self.leaves:
            size = values[i].size
            values[i] = found[at : at + size].reshape(values[i].shape)
            at += size
        system = eqx.combine(jtu.tree_unflatten(tree, values), self.functions)
        inertia = self.inertia(numbers)
        body = None if self.ten is None else self.ten.body(numbers[self.slices["shape"]])
        torque = _of_body(system.torque, body)
        system = eqx.tree_at(lambda x: (x.inertia, x.torque), system, (inertia, torque))
        return system, self.gyro(numbers)

    def gyro(self, numbers: Array) -> Callable[[Array], Array]:
        """What the gyro makes of an angular velocity."""
        s = self.slices
        matrix = jnp.eye(3, dtype=numbers.dtype)
        bias = jnp.zeros(3, numbers.dtype)
        if "gyro_scale" in s:
            matrix = matrix * jnp.exp(numbers[s["gyro_scale"]][0])
        if "gyro_scales" in s:
            matrix = matrix * jnp.exp(numbers[s["gyro_scales"]])[:, None]
        if "gyro_matrix" in s:
            matrix = matrix + numbers[s["gyro_matrix"]].reshape(3, 3)
        if "gyro_misalignment" in s:
            turn = jnp.eye(3, dtype=numbers.dtype) - hat(numbers[s["gyro_misalignment"]])
            matrix = product("ij,jk->ik", matrix, turn)
        if "gyro_bias" in s:
            bias = self.rate * numbers[s["gyro_bias"]]
        return lambda omega: product("ij,j->i", matrix, omega) + bias

    def prior_rows(self, numbers: Array) -> Array:
        """What is known of the nuisances beforehand, as residuals."""
        rows = [jnp.zeros(0, numbers.dtype)]
        for name, prior in zip(self.nuisances, self.priors, strict=True):
            if prior is not None and NUISANCES[name]:
                unit = self.rate if name == "gyro_bias" else 1.0
                rows.append(unit * numbers[self.slices[name]] / prior)
        if self.held is not None and self.constraint is not None:
            value, unit = self.constraint
            rows.append(((self.held(self.inertia(numbers)) - value) / unit)[None])
        return jnp.concatenate(rows)

    def holding(self, function: Any, value: Array, unit: Array) -> "Unknowns":
        """The same, with a function of the tensor held at a value, to within a unit."""
        fields = {x.name: getattr(self, x.name) for x in dataclasses.fields(self)}
        return Unknowns(**{**fields, "held": function, "constraint": (value, unit)})


def _of_body(torque: Any, body: MassProperties | None) -> Any:
    """The torque, with the body's mass and lever where it has some of its own."""
    if isinstance(torque, Sum):
        return Sum(tuple(_of_body(term, body) for term in torque.terms))
    if isinstance(torque, UniformGravity) and body is not None:
        return UniformGravity(body.mass, body.center_of_mass, torque.gravity)
    return torque


def _shape(shape: str, p: Array) -> Array:
    """Sigma, in the frame of the chart and of any trace."""
    one, zero = jnp.ones((), p.dtype), jnp.zeros((), p.dtype)
    if shape == "moments":
        return jnp.diag(jnp.stack([one, jnp.exp(p[0]), jnp.exp(p[1])]))
    if shape == "top":
        return jnp.diag(jnp.stack([one, one, jnp.exp(p[0])]))
    if shape == "symmetric":
        axis = jnp.stack([p[1], p[2], one])
        axis = axis / jnp.sqrt(1 + p[1] ** 2 + p[2] ** 2)
        dyad = axis[:, None] * axis[None, :]
        return jnp.eye(3, dtype=p.dtype) + (jnp.exp(p[0]) - 1) * dyad
    if shape == "flat":
        rows = [[one, zero, zero], [p[1], jnp.exp(p[0]), zero], [p[2], p[3], zero]]
    else:
        rows = [[one, zero, zero], [p[2], jnp.exp(p[0]), zero], [p[3], p[4], jnp.exp(p[1])]]
    lower = jnp.stack([jnp.stack(row) for row in rows])
    return product("ik,jk->ij", lower, lower)


class _Mark:
    """In the place of an array, to see which a function picks."""

    def __init__(self, index: int):
        self.index = index


def _free_leaves(system: AbstractSystem, free: Any) -> tuple[int, ...]:
    """Indices, among the arrays of the system, of the leaves that `free` chooses."""
    arrays, _ = eqx.partition(system, eqx.is_inexact_array)
    flat = jtu.tree_leaves(arrays)
    if free is None:
        return ()
    if callable(free) and not isinstance(free, eqx.Module):
        marks = [_Mark(i) for i in range(len(flat))]
        marked = jtu.tree_unflatten(jtu.tree_structure(arrays), marks)
        chosen = jtu.tree_leaves(free(eqx.combine(marked, system)))
        if not chosen or not all(isinstance(x, _Mark) for x in chosen):
            raise ValueError(
                "Argument `free` must choose floating point arrays of the system, but it does not."
            )
        found = tuple(sorted({x.index for x in chosen}))
    else:
        chosen_tree = eqx.filter(arrays, free)
        kept = {id(x) for x in jtu.tree_leaves(chosen_tree)}
        found = tuple(i for i, x in enumerate(flat) if id(x) in kept)
    paths = [jtu.keystr(path) for path, _ in jtu.tree_leaves_with_path(arrays)]
    found = tuple(i for i in found if not paths[i].endswith(".inertia"))
    if not found:
        raise ValueError(
            "Argument `free` must choose floating point arrays of the system beside the inertia, "
            "which is always sought, but it does not."
        )
    return found


def unknowns_of(
    system: AbstractSystem,
    free: Any,
    nuisances: Sequence[str] | Mapping[str, Any],
    shape: str | LogCholesky,
    scale: str,
    rate: Array,
) -> Unknowns:
    """Check the options and set up the numbers."""
    ten = shape if isinstance(shape, LogCholesky) else None
    if ten is None:
        check_option("shape", shape, tuple(SHAPES))
    elif scale == "trace":
        raise ValueError(
            "Argument `scale` must be 'known' or 'rotor' where `shape` is a LogCholesky, whose "
            "numbers hold the scale, but it is 'trace'."
        )
    check_option("scale", scale, SCALES)
    if isinstance(nuisances, str):
        nuisances = (nuisances,)
    priors = dict(nuisances) if isinstance(nuisances, Mapping) else dict.fromkeys(nuisances)
    for name in priors:
        check_option("nuisances", name, tuple(NUISANCES))
    dtype = rate.dtype
    arrays, functions = eqx.partition(system, eqx.is_inexact_array)
    inertia, eye = as_tensor(system.inertia.astype(dtype)), jnp.eye(3, dtype=dtype)
    return Unknowns(
        arrays,
        functions,
        shape if isinstance(shape, str) else "tensor",
        ten is None and scale != "trace" and shape != "fixed",
        _free_leaves(system, free),
        tuple(priors),
        tuple(None if p is None else jnp.asarray(p, dtype) for p in priors.values()),
        eigh(inertia)[1] if shape == "moments" and system.inertia.ndim == 2 else eye,
        jnp.trace(inertia),
        rate,
        ten=ten,
    )


def is_near_flat(tensor: Array) -> Array:
    """Whether a fit has run into the boundary of real bodies."""
    return eigh(second_moments(tensor))[0][0] < BOUNDARY
