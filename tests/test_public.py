"""Public modules show public names alone."""

import inspect
import pydoc
import types

import pytest

import jrigid as jr

MODULES = [
    x
    for name, x in vars(jr).items()
    if inspect.ismodule(x)
    and x.__name__ == f"jrigid.{name}"
    and not name.startswith("_")
]


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.__name__)
def test_dir_help_and_star_import_show_the_modules_own_names(module):
    assert dir(module) == sorted(module.__all__)
    assert not any(name.startswith("_") for name in module.__all__)
    shown = [getattr(module, name) for name in module.__all__]
    homes = {x.__module__ for x in shown if isinstance(x, type | types.FunctionType)}
    assert homes
    assert all(home.startswith("jrigid") for home in homes)
    first = next(x.__name__ for x in shown if isinstance(x, type | types.FunctionType))
    assert first in pydoc.plain(pydoc.render_doc(module))


def test_names_of_dynamics():
    assert {"State", "angular_momentum", "kinetic_energy"} <= set(dir(jr.dynamics))
    assert not {"Any", "eqx", "jnp", "check_shape", "Array"} & set(dir(jr.dynamics))
