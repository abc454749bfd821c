"""Trajectories, fits and sweeps as tables of pandas and data sets of xarray."""

from collections.abc import Iterator
from itertools import product
from typing import Any

import jax.tree_util as jtu
import numpy as np

from jrigid._checks import RESULTS, check_type, demand
from jrigid._core.third_party import code_of
from jrigid._extra import extra
from jrigid.identify import FitResult, Status
from jrigid.simulate import Trajectory
from jrigid.sweep import SweepResult

_UNITS = {"attitude": "1", "omega": "rad/s", "position": "m", "velocity": "m/s"}
_LABELS = {"component": list("wxyz"), "axis": list("xyz"), "other_axis": list("xyz")}
_LABELS |= {"moment": ["I1", "I2", "I3"], "ratio": ["I2/I1", "I3/I1"]}


def _dataset(variables: dict[str, Any], **attributes: Any) -> Any:
    """Of (dimensions, values, attributes), with the labels of the dimensions."""
    used = {
        dimension for dimensions, *_ in variables.values() for dimension in dimensions
    }
    labels = {k: x for k, x in _LABELS.items() if k in used}
    return extra("io", "xarray").Dataset(variables, labels, attributes)


def _of_trajectory(motion: Trajectory) -> Any:
    ts, lanes = np.asarray(motion.ts), np.ndim(code_of(motion.result))
    front = tuple(f"lane{i or ''}" for i in range(ts.ndim - 1))
    first = ts[(0,) * len(front)]
    shared = bool(np.all(ts == first))
    along = (*front, *(("time" if shared else "sample",) if ts.ndim else ()))
    variables: dict[str, Any] = {}
    for name, unit in _UNITS.items():
        if (x := getattr(motion.states, name, None)) is not None:
            own = "component" if name == "attitude" else "axis"
            variables[name] = (*along, own), np.asarray(x), {"units": unit}
    for i, x in enumerate(jtu.tree_leaves(motion.states.internal)):
        own = tuple(f"internal{i}_{j}" for j in range(x.ndim - ts.ndim))
        variables[f"internal{i}"] = (*along, *own), np.asarray(x)
    text = RESULTS[motion.result]
    if lanes:
        variables["result"] = front[:lanes], text
    time = (along[-1:], first) if shared else (along, ts)
    dataset = _dataset(variables, **({} if lanes else {"result": text}))
    return dataset.assign_coords(time=(*time, {"units": "s"}))


def _with_errors(fit: FitResult) -> dict[str, tuple[tuple[str, ...], Any, Any]]:
    """Dimensions, values and standard errors of what a fit found."""
    single = np.ndim(fit.chi_square) == 0
    demand(
        single,
        "Argument `x` must be a single fit, but it is many: take one by "
        "`jax.tree.map`.",
    )
    picked = fit.estimates.items()
    return {
        "moments": (
            ("moment",),
            fit.moments,
            np.sqrt(np.diagonal(fit.moments_covariance)),
        ),
        "ratios": (("ratio",), fit.ratios, fit.ratios_errors),
        "shares": (("moment",), fit.shares, fit.shares_errors),
        "numbers": (("number",), fit.numbers, fit.errors),
        **{
            k: (tuple(f"{k}_{i}" for i in range(np.ndim(x))), x, e)
            for k, (x, e) in picked
        },
    }


def _of_fit(fit: FitResult) -> Any:
    variables: dict[str, Any] = {
        "inertia": (
            ("axis", "other_axis"),
            np.asarray(fit.inertia),
            {"units": "kg m^2"},
        ),
        "numbers_covariance": (
            ("number", "other_number"),
            np.asarray(fit.numbers_covariance),
        ),
    }
    for name, (dimensions, *pair) in _with_errors(fit).items():
        about = {"units": "kg m^2"} if name == "moments" else {}
        for key, x in zip((name, f"{name}_error"), pair, strict=True):
            variables[key] = dimensions, np.asarray(x), about
    dataset = _dataset(variables, status=Status[fit.status])
    return dataset.assign_coords(number=list(fit.names), other_number=list(fit.names))


def to_xarray(x: Trajectory | FitResult | SweepResult) -> Any:
    """A trajectory, fit or sweep as an `xarray.Dataset`, with units in the attributes.

    Args:
        x: A trajectory, of many lanes too (dimensions `lane`, `time`; where their times
            differ `lane`, `sample`); a single fit; a sweep.

    Returns:
        The data set: of a trajectory its states, of a fit its moments, ratios, shares,
        numbers and what `free` picked, each with standard errors, of a sweep
        `x.to_xarray()`.

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
    return _of_fit(x) if isinstance(x, FitResult) else _of_trajectory(x)


def to_pandas(x: Trajectory | FitResult | SweepResult) -> Any:
    """A trajectory, fit or sweep as a `pandas.DataFrame`, with units in `attrs["units"]`.

    Args:
        x: A trajectory of one lane; a single fit; a sweep.

    Returns:
        Of a trajectory a row for each time [s], columns `attitude_w`, ..., `omega_x`,
        ...; of a fit a row for each moment, ratio, share and number, columns `value`
        and `error`; of a sweep a row for each point.

    Raises:
        ImportError: Without the extra `jrigid[io]`.
        ValueError: Of many fits or lanes, of a single state.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 2.0, 3.0]))
    >>> state0 = jr.State(jr.rotation.identity(), jnp.array([0.0, 1.0, 0.1]))
    >>> table = jr.io.to_pandas(jr.simulate(body, state0, jnp.linspace(0.0, 5.0, 11)))
    >>> print(table.index.name, list(table.columns[-3:]), table.attrs["units"]["omega_x"])
    time ['omega_x', 'omega_y', 'omega_z'] rad/s
    """
    pandas, dataset = extra("io", "pandas"), to_xarray(x)
    if isinstance(x, SweepResult):
        return dataset.to_dataframe()
    if isinstance(x, FitResult):
        names = [k for k in dataset if f"{k}_error" in dataset]
        pair = [
            {k: v for n in names for k, v in _flat(dataset[n + x], n)}
            for x in ("", "_error")
        ]
        return pandas.DataFrame(dict(zip(("value", "error"), pair, strict=True)))
    message = (
        "Argument `x` must be a trajectory of one lane, its `ts` of shape (n,), but "
        "they have"
    )
    demand(x.ts.ndim == 1, f"{message} shape {x.ts.shape}: use `to_xarray`.")
    columns = [(n, *pair) for n in dataset for pair in _flat(dataset[n], n, keep=1)]
    table = pandas.DataFrame({k: v for _, k, v in columns}, dataset.indexes["time"])
    table.attrs["units"] = {k: dataset[n].attrs.get("units", "") for n, k, _ in columns}
    return table


def _flat(variable: Any, name: str, keep: int = 0) -> Iterator[tuple[str, np.ndarray]]:
    """What a variable holds along its first dimensions, named by it and the labels of the rest."""
    columns = variable.values.reshape(*variable.shape[:keep], -1)
    for i, labels in enumerate(
        product(*(variable[d].values for d in variable.dims[keep:]))
    ):
        yield "_".join([name, *map(str, labels)]), columns.T[i]
