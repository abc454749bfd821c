"""The house stays in order: doors, borders, what of other packages is used."""

import ast
from graphlib import TopologicalSorter

import house
import pytest


def package(module):
    return module.split(".")[0]


def test_few_public_functions_take_throw():
    throwing = house.with_throw()
    assert len(throwing) <= 20, throwing


def test_no_function_is_long_without_a_reason_at_its_head():
    def has_reason(node, path):
        first = min([node.lineno, *(x.lineno for x in node.decorator_list)])
        return path.read_text().splitlines()[first - 2].strip().startswith("# Long: ")

    long = [
        (name, lines)
        for name, node, lines, path in house.functions()
        if lines > 60 and not has_reason(node, path)
    ]
    assert not long


def test_no_package_imports_a_private_name_of_another():
    def is_private(source, names):
        return any(x.startswith("_") for x in [*source.split(".")[1:], *names])

    foreign = [
        (module, source, names)
        for module, source, names in house.imports()
        if package(module) not in ("__init__", package(source)) and is_private(source, names)
    ]
    assert not foreign


# What jax, equinox and diffrax do not document, and the one module that may use it.
_THIRD_PARTY = "_core.third_party"
_UNDOCUMENTED_MODULES = ("equinox.internal", "jax.extend", "jax.interpreters")
_PACKAGES = ("jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax")
_UNDOCUMENTED_NAMES = {
    "_enumeration",
    "_index_to_message",
    "_name_to_item",
    "_value",
    "get_bind_params",
    "primitive_batchers",
}


def _undocumented(tree):
    """Uses of undocumented parts in a source file."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [x.name for x in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{x.name}" for x in node.names]
        elif isinstance(node, ast.Attribute):
            names = [ast.unparse(node)]
            if node.attr in _UNDOCUMENTED_NAMES:
                yield node.attr
        elif isinstance(node, ast.Constant) and node.value in _UNDOCUMENTED_NAMES:
            yield node.value
            continue
        else:
            continue
        for name in names:
            package, _, rest = name.partition(".")
            foreign = package in _PACKAGES
            private = foreign and any(x.startswith("_") for x in rest.split("."))
            if private or name.startswith(_UNDOCUMENTED_MODULES):
                yield name


def test_undocumented_parts_of_other_packages_are_used_in_one_module():
    users = {name for name, _, tree in house.modules() if list(_undocumented(tree))}
    assert users == {_THIRD_PARTY}


def test_no_circle_between_packages():
    above = {}
    for module, source, _ in house.imports():
        if module != "__init__" and package(module) != package(source) and source:
            above.setdefault(package(module), set()).add(package(source))
    assert list(TopologicalSorter(above).static_order())


@pytest.mark.parametrize("module", ["jrigid", "jrigid.dynamics", "jrigid.rotation"])
def test_public_modules_show_public_names_alone(module):
    import importlib

    shown = [x for x in dir(importlib.import_module(module)) if not x.startswith("_")]
    for name in ("jnp", "jax", "eqx", "Any", "float_arrays", "check_shape"):
        assert name not in shown
