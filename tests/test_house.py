"""The house stays in order: facades, borders, what of other packages is used."""

import ast
from graphlib import TopologicalSorter

import house
import pytest


def package(module):
    return module.split(".")[0]


def test_few_public_functions_take_throw():
    throwing = house.with_throw()
    assert len(throwing) <= 20, throwing


_LONGEST = 400  # tokens of a function that gives no reason


def has_reason(node, path):
    """Whether a comment `# Long: ...` stands above a function."""
    first = min([node.lineno, *(x.lineno for x in node.decorator_list)])
    lines = path.read_text().splitlines()[:first]
    above = lines[first - 2].strip()
    while above.startswith("#") and not above.startswith("# Long: "):
        first -= 1
        above = lines[first - 2].strip()
    return above.startswith("# Long: ")


def test_no_function_is_long_without_a_reason_at_its_head():
    long = {
        name: tokens
        for name, node, tokens, path in house.functions()
        if tokens > _LONGEST and not has_reason(node, path)
    }
    assert not long


def test_the_code_reads_as_the_style_guide_asks():
    """Those of its figures that are reached, so that they stay so."""
    found = house.reading()
    assert found["parallel assignments [%]"] <= 1.5
    assert found["arguments annotated `Any` [%]"] <= 5
    assert found["comment lines to code lines"] >= 0.08


def test_no_package_imports_a_private_name_of_another():
    def is_private(source, names):
        return any(x.startswith("_") for x in [*source.split(".")[1:], *names])

    foreign = [
        (module, source, names)
        for module, source, names in house.imports()
        if package(module) not in ("__init__", package(source))
        and is_private(source, names)
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


# Steps are taken in `_stepping`. Others may call a solver's step for these reasons
# alone.
_STEPPING = "_stepping."
_CALLS_OF_A_STEP = {
    "simulate._equal_steps": (
        "Splitting and FreeRotation are made for rotation: no tableau"
    ),
    "stability._stepped_motion": (
        "a user's solver that is no explicit Runge-Kutta method"
    ),
}
_TABLEAUS = {
    "solvers._verner": "defines one",
}
_OF_A_TABLEAU = {
    "tableau",
    "a_lower",
    "b_sol",
    "b_error",
    "scan_kind",
    "ButcherTableau",
}


def _calls_of_a_step(tree):
    """Calls `x.step(...)`."""
    calls = [x for x in ast.walk(tree) if isinstance(x, ast.Call)]
    return [
        x for x in calls if isinstance(x.func, ast.Attribute) and x.func.attr == "step"
    ]


def _names_of_tableaus(tree):
    """Names that only who evaluates a Runge-Kutta method, or defines one, needs."""
    for node in ast.walk(tree):
        names = {getattr(node, x, None) for x in ("id", "attr", "arg")}
        yield from names & _OF_A_TABLEAU


def _is_field(callee, function):
    """Whether a call may be one of a vector field: given, defined on the spot,
    or a body's."""
    arguments = [x.arg for x in function.args.args]
    inside = [x.name for x in ast.walk(function) if isinstance(x, ast.FunctionDef)]
    return callee in [*arguments, *inside] or callee.endswith(
        (".vector_field", ".rates")
    )


def _longest_chain(function):
    """The most calls of a field of which each takes the result of the one before.

    Stages written by hand are such a chain: two = rate(t + h / 2, y + h / 2 * one).
    """
    depths = {}

    def depth(node, callee):
        if isinstance(node, ast.Name):
            return depths.get((node.id, callee), 0)
        inside = [depth(x, callee) for x in ast.iter_child_nodes(node)]
        own = isinstance(node, ast.Call) and ast.unparse(node.func) == callee
        return max(inside, default=0) + own

    longest = 0
    for node in function.body:
        if not isinstance(node, ast.Assign):
            continue
        calls = [
            ast.unparse(x.func) for x in ast.walk(node.value) if isinstance(x, ast.Call)
        ]
        names = [x.id for x in ast.walk(node.targets[0]) if isinstance(x, ast.Name)]
        for callee in {x for x in calls if _is_field(x, function)}:
            found = depth(node.value, callee)
            longest = max(longest, found)
            depths |= {(name, callee): found for name in names}
    return longest


def test_steps_are_taken_in_one_place():
    elsewhere = [x for x in house.modules() if not x[0].startswith(_STEPPING)]
    callers = {name for name, _, tree in elsewhere if _calls_of_a_step(tree)}
    assert callers == set(_CALLS_OF_A_STEP)
    readers = {name for name, _, tree in elsewhere if list(_names_of_tableaus(tree))}
    assert readers == set(_TABLEAUS)
    chains = [
        name
        for name, node, _, _ in house.functions()
        if not name.startswith(_STEPPING) and _longest_chain(node) > 2
    ]
    assert not chains


def test_stages_written_by_hand_are_seen():
    source = """
def step(rate, t, h, y):
    one = rate(t, y)
    two = rate(t + h / 2, y + h / 2 * one)
    three = rate(t + h / 2, y + h / 2 * two)
    four = rate(t + h, y + h * three)
    return y + h / 6 * (one + 2 * two + 2 * three + four)
"""
    assert _longest_chain(ast.parse(source).body[0]) == 4


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
