"""Save fits to files and load them."""

import os
import pickle
from pathlib import Path

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from jrigid._checks import check_type, demand
from jrigid.identify._result import FitResult


def save(path: str | os.PathLike[str], result: FitResult) -> None:
    """Write a fit, with the record that it was made from, to a file for `load`.

    The file is a pickle. It holds functions and classes of one's own (the function of a
    `FunctionSensor`, a torque, an inertia model) by their names only, and they must be
    importable where it is read.

    Args:
        path: Of the file.
        result: A fit, or many by `fit_each`.

    Raises:
        ValueError: A function that has no name to be found by: a lambda, or one within
            another.
        OSError: The file cannot be written.

    >>> import tempfile, jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> found = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
    >>> with tempfile.NamedTemporaryFile() as file:
    ...     jr.identify.save(file.name, found)
    ...     print(jr.identify.load(file.name).ratios.round(3))
    [1.496 1.995]
    """
    check_type("result", result, FitResult)
    try:
        data = pickle.dumps(jtu.tree_map(np.asarray, result))
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(
            "Argument `result` must hold functions and classes that can be imported by "
            "their names, no lambda and none within a function, but one cannot: "
            f"{error}."
        ) from error
    Path(path).write_bytes(data)


def load(path: str | os.PathLike[str]) -> FitResult:
    """Read a fit that `save` wrote with this version of jrigid.

    The result can do all that the original could. A pickle can run any code: load only
    files whose origin you trust.

    Args:
        path: Of the file.

    Raises:
        ValueError: No such fit, functions or classes that are not found here, or
            numbers in float64 where `jax_enable_x64` is off.
        OSError: The file cannot be read.
    """
    data = Path(path).read_bytes()
    try:
        result = pickle.loads(data)
    # Unpickling runs code of other packages, which may raise any error.
    except Exception as error:
        raise ValueError(
            "Argument `path` must be a file that `save` wrote, whose functions and "
            f"classes can be imported, but it cannot be read: {error}."
        ) from error
    check_type("path", result, FitResult)
    arrays = jtu.tree_map(jnp.asarray, result)
    same = jtu.tree_map(lambda x, y: x.dtype == y.dtype, result, arrays)
    demand(
        jtu.tree_all(same),
        "Argument `path` must be read with `jax_enable_x64` on, since it holds numbers "
        "of 64 bits, but it is off.",
    )
    return arrays
