"""Public modules show public names alone."""

import inspect
import pydoc
import re
import types

import house
import pytest

import jrigid as jr

MODULES = list(house.public_modules().values())


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


def _words_of_examples_and_results(objects):
    """Words in the examples of docstrings, and in what functions return."""
    lines = [
        line
        for value in objects
        for line in (value.__doc__ or "").splitlines()
        if line.strip().startswith((">>>", "..."))
    ]
    results = [
        str(inspect.signature(value).return_annotation)
        for value in objects
        if inspect.isfunction(value)
    ]
    return set(re.findall(r"\w+", " ".join([*lines, *results])))


def test_every_public_class_and_function_has_an_example_that_runs():
    """Of its own, or as a part of others; results have those of their functions.

    The examples are run by `make doctest`.
    """
    objects = [pair for module in MODULES for pair in house.public_objects(module)]
    known = _words_of_examples_and_results([value for _, value in objects])
    without = {
        name
        for name, value in objects
        if "." not in name
        and isinstance(value, type | types.FunctionType)
        and ">>>" not in (value.__doc__ or "")
        and name not in known
    }
    assert not without, f"no example (`>>>`) in the docstring of {sorted(without)}"


def _descendants(kind):
    for child in kind.__subclasses__():
        yield child
        yield from _descendants(child)


@pytest.mark.parametrize(
    ("module", "base"),
    [
        (jr.torques, "AbstractTorque"),
        (jr.identify, "AbstractSensor"),
        (jr.identify, "AbstractInertiaModel"),
    ],
)
def test_torques_sensors_and_inertia_models_are_public(module, base):
    own = [
        x
        for x in _descendants(getattr(module, base))
        if x.__module__.startswith(module.__name__) and not x.__name__.startswith("_")
    ]
    hidden = {x.__name__ for x in own} - set(module.__all__)
    home = module.__name__.replace(".", "/")
    assert not hidden, f"add {sorted(hidden)} to {home}/__init__.py"


def test_names_of_dynamics():
    assert {"State", "angular_momentum", "kinetic_energy"} <= set(dir(jr.dynamics))
    assert not {"Any", "eqx", "jnp", "check_shape", "Array"} & set(dir(jr.dynamics))
