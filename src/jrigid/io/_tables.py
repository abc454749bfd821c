"""Trajectories, fits and sweeps as tables of pandas and data sets of xarray."""

from collections.abc import Mapping
from itertools import product
from typing import Any, NamedTuple

import jax.tree_util as jtu
import numpy as np

from jrigid._checks import RESULTS, check_type, demand
from jrigid._core.third_party import code_of
from jrigid._extra import extra
from jrigid._types import AnyArray
from jrigid.identify import FitResult, Status
from jrigid.simulate import Trajectory
from jrigid.sweep import SweepResult

_UNITS = {"attitude": "1", "omega": "rad/s", "position": "m", "velocity": "m/s"}
_LABELS = {
    "component": list("wxyz"),
    "axis": list("xyz"),
    "other_axis": list("xyz"),
    "moment": ["I1", "I2", "I3"],
    "ratio": ["I2/I1", "I3/I1"],
}

# xarray and pandas are extras and are not imported before they are used.
DataArray = Any
Dataset = Any
DataFrame = Any


class _Variable(NamedTuple):
    """A variable of a data set, as xarray takes it."""

    dimensions: tuple[str, ...]
    values: np.ndarray
    attributes: dict[str, str]


def _variable(dimensions: tuple[str, ...], values: Any, unit: str = "") -> _Variable:
    attributes = {"units": unit} if unit else {}
    return _Variable(dimensions, np.asarray(values), attributes)


def _dataset(variables: Mapping[str, _Variable], attributes: Mapping[str, Any]) -> Any:
    """Make a data set, with the labels of the dimensions that occur."""
    used = {d for variable in variables.values() for d in variable.dimensions}
    labels = {d: names for d, names in _LABELS.items() if d in used}
    return extra("io", "xarray").Dataset(variables, labels, attributes)


def _of_trajectory(motion: Trajectory) -> Dataset:
    """States over the dimensions lane, lane1, ..., and time, or sample."""
    ts = np.asarray(motion.ts)
    lanes = tuple(f"lane{i or ''}" for i in range(ts.ndim - 1))
    first = ts[(0,) * len(lanes)]
    # Lanes with times of their own have no common coordinate `time`.
    is_shared = np.array_equal(ts, np.broadcast_to(first, ts.shape), equal_nan=True)
    last = ("time" if is_shared else "sample",) if ts.ndim else ()
    along = (*lanes, *last)
    variables: dict[str, _Variable] = {}
    for name, unit in _UNITS.items():
        x = getattr(motion.states, name, None)
        if x is not None:
            own = "component" if name == "attitude" else "axis"
            variables[name] = _variable((*along, own), x, unit)
    for i, x in enumerate(jtu.tree_leaves(motion.states.internal)):
        own = tuple(f"internal{i}_{j}" for j in range(x.ndim - ts.ndim))
        variables[f"internal{i}"] = _variable((*along, *own), x)
    text = RESULTS[motion.result]
    # The code of a single motion is an attribute. Codes of many lanes are a variable.
    depth = np.ndim(code_of(motion.result))
    if depth:
        variables["result"] = _variable(lanes[:depth], text)
    dataset = _dataset(variables, {} if depth else {"result": text})
    time = _variable(last, first, "s") if is_shared else _variable(along, ts, "s")
    return dataset.assign_coords(time=time)


class _Estimate(NamedTuple):
    """Estimate of a fit, with standard errors of the same shape."""

    dimensions: tuple[str, ...]
    values: Any
    errors: Any


def _estimates(fit: FitResult) -> dict[str, _Estimate]:
    """All that a fit found and has standard errors of."""
    demand(
        np.ndim(fit.chi_square) == 0,
        "Argument `x` must be a single fit, but it is many: take one by "
        "`jax.tree.map`.",
    )
    moments_errors = np.sqrt(np.diagonal(fit.moments_covariance))
    found = {
        "moments": _Estimate(("moment",), fit.moments, moments_errors),
        "ratios": _Estimate(("ratio",), fit.ratios, fit.ratios_errors),
        "shares": _Estimate(("moment",), fit.shares, fit.shares_errors),
        "numbers": _Estimate(("number",), fit.numbers, fit.errors),
    }
    for name, (values, errors) in fit.estimates.items():
        dimensions = tuple(f"{name}_{i}" for i in range(np.ndim(values)))
        found[name] = _Estimate(dimensions, values, errors)
    return found


def _of_fit(fit: FitResult) -> Dataset:
    """The estimates of a fit, `x` and `x_error` for each, and covariances."""
    pair = ("number", "other_number")
    variables = {
        "inertia": _variable(("axis", "other_axis"), fit.inertia, "kg m^2"),
        "numbers_covariance": _variable(pair, fit.numbers_covariance),
    }
    for name, (dimensions, values, errors) in _estimates(fit).items():
        unit = "kg m^2" if name == "moments" else ""
        variables[name] = _variable(dimensions, values, unit)
        variables[f"{name}_error"] = _variable(dimensions, errors, unit)
    dataset = _dataset(variables, {"status": Status[fit.status]})
    names = list(fit.names)
    return dataset.assign_coords(number=names, other_number=names)


def to_xarray(x: Trajectory | FitResult | SweepResult) -> Dataset:
    """Convert a trajectory, fit or sweep to an `xarray.Dataset` with units.

    Args:
        x: A trajectory, of many lanes too (dimensions `lane`, `time`; where their times
            differ `lane`, `sample`); a single fit; a sweep.

    Returns:
        The data set: of a trajectory its states, of a fit its moments, ratios, shares,
        numbers and what `free` picked, each with standard errors, of a sweep
        `x.to_xarray()`.

    Raises:
        ImportError: Without the extra `jrigid[io]`.
        ValueError: `x` is many fits.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state0 = jr.State(jr.rotation.identity(), jnp.array([0.0, 1.0, 0.1]))
    >>> motion = jr.io.to_xarray(jr.simulate(body, state0, jnp.linspace(0.0, 5.0, 11)))
    >>> print(dict(motion.sizes), motion.omega.units)
    {'time': 11, 'component': 4, 'axis': 3} rad/s
    """
    check_type("x", x, Trajectory, FitResult, SweepResult)
    if isinstance(x, SweepResult):
        return x.to_xarray()
    return _of_fit(x) if isinstance(x, FitResult) else _of_trajectory(x)


def to_pandas(x: Trajectory | FitResult | SweepResult) -> DataFrame:
    """Convert a trajectory, fit or sweep to a `pandas.DataFrame`.

    The units of a trajectory are in `attrs["units"]`.

    Args:
        x: A trajectory of one lane; a single fit; a sweep.

    Returns:
        Of a trajectory a row for each time [s] with columns `attitude_w`, ...,
        `omega_x`, .... Of a fit a row for each moment, ratio, share and number with
        columns `value` and `error`. Of a sweep a row for each point.

    Raises:
        ImportError: Without the extra `jrigid[io]`.
        ValueError: `x` is many fits, or a trajectory of many lanes or of one state.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state0 = jr.State(jr.rotation.identity(), jnp.array([0.0, 1.0, 0.1]))
    >>> table = jr.io.to_pandas(jr.simulate(body, state0, jnp.linspace(0.0, 5.0, 11)))
    >>> print(table.index.name, list(table.columns[-3:]))
    time ['omega_x', 'omega_y', 'omega_z']
    >>> print(table.attrs["units"]["omega_x"])
    rad/s
    """
    pandas = extra("io", "pandas")
    if isinstance(x, Trajectory):
        demand(
            x.ts.ndim == 1,
            "Argument `x` must be a trajectory of one lane, its `ts` of shape (n,), "
            f"but they have shape {x.ts.shape}: use `to_xarray`.",
        )
    dataset = to_xarray(x)
    if isinstance(x, SweepResult):
        return dataset.to_dataframe()
    if isinstance(x, FitResult):
        values: dict[str, AnyArray] = {}
        errors: dict[str, AnyArray] = {}
        for name in _estimates(x):
            values |= _columns(dataset[name], name)
            errors |= _columns(dataset[f"{name}_error"], name)
        return pandas.DataFrame({"value": values, "error": errors})
    table: dict[str, AnyArray] = {}
    units: dict[str, str] = {}
    for name in dataset:
        variable = dataset[name]
        for column, numbers in _columns(variable, name, keep=1).items():
            table[column] = numbers
            units[column] = variable.attrs.get("units", "")
    frame = pandas.DataFrame(table, dataset.indexes["time"])
    frame.attrs["units"] = units
    return frame


def _columns(variable: DataArray, name: str, keep: int = 0) -> dict[str, AnyArray]:
    """Split a variable into columns.

    Args:
        variable: Of a data set.
        name: With which the names of the columns begin; labels of the dimensions
            follow.
        keep: How many dimensions, from the first, a column has.
    """
    labels = product(*(variable[d].values for d in variable.dims[keep:]))
    names = ["_".join([name, *map(str, x)]) for x in labels]
    # The last axis runs over the labels in the order of `product`: the last dimension
    # fastest.
    columns = np.moveaxis(variable.values.reshape(*variable.shape[:keep], -1), -1, 0)
    return dict(zip(names, columns, strict=True))
