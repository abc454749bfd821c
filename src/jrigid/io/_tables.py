"""Trajectories, fits and sweeps as tables of pandas and data sets of xarray."""

from collections.abc import Iterator
from itertools import product
from typing import Any

import jax.tree_util as jtu
import numpy as np

from jrigid._checks import RESULTS, check_type, demand
from jrigid.identify import FitResult, Status
from jrigid.io._extra import extra
from jrigid.simulate import Trajectory
from jrigid.sweep import SweepResult

_COLUMNS = {  # of a state: the dimension along it, its unit, what it is
    "attitude": ("component", "1", "unit quaternion, scalar first, body to space"),
    "omega": ("axis", "rad/s", "angular velocity, body components"),
    "position": ("axis", "m", "centre of mass, space components"),
    "velocity": ("axis", "m/s", "velocity of the centre of mass, space components"),
}
_INVARIANTS = {
    "energy": ((), "J", "total energy"),
    "angular_momentum": (("axis",), "kg m^2/s", "total angular momentum, space components"),
}
_AXES = {"component": list("wxyz"), "axis": list("xyz"), "other_axis": list("xyz")}
_AXES |= {"moment": ["I1", "I2", "I3"], "ratio": ["I2/I1", "I3/I1"]}


def _about(unit: str, what: str) -> dict[str, str]:
    return {"units": unit, "long_name": what}


def _dataset(variables: dict[str, Any], **attributes: Any) -> Any:
    """Of (dimensions, values, attributes), with the labels of the dimensions."""
    used = {d for dimensions, *_ in variables.values() for d in dimensions}
    labels = {d: (d, labels) for d, labels in _AXES.items() if d in used}
    return extra("xarray").Dataset(variables, labels, attributes)


def _of_trajectory(motion: Trajectory, invariants: bool) -> Any:
    ts, code = np.asarray(motion.ts), motion.result
    front = tuple(f"lane{i or ''}" for i in range(ts.ndim - 1))
    same = ts.ndim < 2 or bool(np.all(ts == ts[(0,) * (ts.ndim - 1)]))
    along = (*front, *(("time" if same else "sample",) if ts.ndim else ()))
    known = {k: getattr(motion.states, k, None) for k in _COLUMNS}
    variables: dict[str, Any] = {
        k: ((*along, _COLUMNS[k][0]), np.asarray(x), _about(*_COLUMNS[k][1:]))
        for k, x in known.items()
        if x is not None
    }
    for i, leaf in enumerate(jtu.tree_leaves(motion.states.internal)):
        own = tuple(f"internal{i}_{j}" for j in range(leaf.ndim - ts.ndim))
        variables[f"internal{i}"] = (*along, *own), np.asarray(leaf)
    for name, (own, unit, what) in _INVARIANTS.items() if invariants else ():
        values = np.asarray(getattr(motion, name))
        variables[name] = (*along, *own), values, _about(unit, what)
    text = RESULTS[code]
    if np.ndim(code._value):
        variables["result"] = front[: np.ndim(code._value)], text
        text = "see the variable `result`"
    dataset = _dataset(variables, result=text)
    time = ts[(0,) * (ts.ndim - 1)] if same and ts.ndim else ts
    return dataset.assign_coords(time=(along[-1:] if same else along, time, _about("s", "time")))


def _of_fit(fit: FitResult) -> Any:
    demand(
        np.ndim(fit.chi_square) == 0,
        "Argument `x` must be a single fit, but it is many: take one by `jax.tree.map`.",
    )
    variables: dict[str, Any] = {}
    unit, error = {"moments": "kg m^2"}, "standard error"
    pairs = {
        "moments": (("moment",), fit.moments, np.sqrt(np.diag(fit.moments_covariance))),
        "ratios": (("ratio",), fit.ratios, fit.ratios_errors),
        "shares": (("moment",), fit.shares, fit.shares_errors),
        "numbers": (("number",), fit.numbers, fit.errors),
    }
    for name, (value, errors) in fit.leaves.items():
        pairs[name] = tuple(f"{name}_{i}" for i in range(np.ndim(value))), value, errors
    for name, (dimensions, value, errors) in pairs.items():
        about = {"units": unit[name]} if name in unit else {}
        variables[name] = dimensions, np.asarray(value), about
        variables[f"{name}_error"] = dimensions, np.asarray(errors), about | {"long_name": error}
    inertia = _about("kg m^2", "inertia tensor, body axes")
    variables["inertia"] = ("axis", "other_axis"), np.asarray(fit.inertia), inertia
    covariance = np.asarray(fit.numbers_covariance)
    variables["numbers_covariance"] = ("number", "other_number"), covariance
    dataset = _dataset(
        variables,
        status=Status[fit.status],
        reduced_chi_square=float(fit.reduced_chi_square),
        degrees_of_freedom=int(fit.degrees_of_freedom),
    )
    names = list(fit.names)
    return dataset.assign_coords(number=names, other_number=names)


def to_xarray(x: Trajectory | FitResult | SweepResult, *, invariants: bool = False) -> Any:
    """A trajectory, fit or sweep as an `xarray.Dataset`, with units in the attributes.

    Args:
        x: A trajectory, of many lanes too (dimensions `lane`, `time`; where their times differ
            `lane`, `sample`); a single fit; a sweep.
        invariants: Whether to add a trajectory's energy and angular momentum.

    Returns:
        The data set: of a trajectory its states, of a fit its moments, ratios, shares, numbers and
        what `free` picked, each with standard errors, of a sweep `x.to_xarray()`.

    Raises:
        ImportError: Without the extra `jrigid[io]`.
        ValueError: Of many fits.

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
    return _of_fit(x) if isinstance(x, FitResult) else _of_trajectory(x, invariants)


def to_pandas(x: Trajectory | FitResult | SweepResult, *, invariants: bool = False) -> Any:
    """A trajectory, fit or sweep as a `pandas.DataFrame`, with units in `attrs["units"]`.

    Args:
        x: A trajectory of one lane; a single fit; a sweep.
        invariants: Whether to add a trajectory's energy and angular momentum.

    Returns:
        Of a trajectory a row for each time [s], columns `attitude_w`, ..., `omega_x`, ...; of a
        fit a row for each moment, ratio, share and number, columns `value` and `error`; of a sweep
        a row for each point.

    Raises:
        ImportError: Without the extra `jrigid[io]`.
        ValueError: Of many fits or lanes.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state0 = jr.State(jr.rotation.identity(), jnp.array([0.0, 1.0, 0.1]))
    >>> table = jr.io.to_pandas(jr.simulate(body, state0, jnp.linspace(0.0, 5.0, 11)))
    >>> print(table.index.name, list(table.columns[-3:]), table.attrs["units"]["omega_x"])
    time ['omega_x', 'omega_y', 'omega_z'] rad/s
    """
    pandas = extra("pandas")
    dataset = to_xarray(x, invariants=invariants)
    if isinstance(x, SweepResult):
        return dataset.to_dataframe()
    if isinstance(x, FitResult):
        names = [k for k in dataset if f"{k}_error" in dataset]
        table = pandas.DataFrame(
            {
                column: {k: v for n in names for k, v in _flat(dataset, n + of, n)}
                for column, of in (("value", ""), ("error", "_error"))
            }
        )
        table.attrs = {
            "units": {f"moments_{k}": "kg m^2" for k in _AXES["moment"]},
            **dataset.attrs,
        }
        return table
    demand(
        x.ts.ndim == 1,
        "Argument `x` must be a trajectory of one lane, but it has more: use `to_xarray(x)`.",
    )
    columns = {k: (v, n) for n in dataset for k, v in _flat(dataset, n, n, skip=1)}
    index = pandas.Index(np.asarray(x.ts), name="time")
    table = pandas.DataFrame({k: v for k, (v, _) in columns.items()}, index)
    units = {k: dataset[n].attrs.get("units", "") for k, (_, n) in columns.items()}
    table.attrs = {"units": {"time": "s", **units}, **dataset.attrs}
    return table


def _flat(dataset: Any, name: str, called: str, skip: int = 0) -> Iterator[tuple[str, np.ndarray]]:
    """Columns of a variable, each with a name made of that of the variable and its labels."""
    variable = dataset[name]
    labels = [
        dataset[d].values if d in dataset.coords else range(dataset.sizes[d])
        for d in variable.dims[skip:]
    ]
    flat = variable.values.reshape(*variable.shape[:skip], -1)
    for i, each in enumerate(product(*labels)):
        yield "_".join([called, *map(str, each)]), flat[..., i]
