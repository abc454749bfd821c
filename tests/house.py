"""The size and the order of the house, counted: `python tests/house.py` prints them."""

import ast
import inspect
import io
import tokenize
from collections import Counter
from pathlib import Path

import jrigid

ROOT = Path(__file__).parents[1] / "src" / "jrigid"
LAYOUT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE}
LAYOUT |= {tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def modules():
    """Every source file by its dotted name below the package."""
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        yield ".".join(parts), path, ast.parse(path.read_text())


def docstring_lines(tree):
    """Lines of docstrings."""
    lines = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node, clean=False
        ):
            first = node.body[0]
            lines |= set(range(first.lineno, first.end_lineno + 1))
    return lines


def code_lines(path, tree):
    """Lines that hold code: no docstrings, comments or blank lines."""
    lines = set()
    for token in tokenize.generate_tokens(io.StringIO(path.read_text()).readline):
        if token.type not in LAYOUT:
            lines |= set(range(token.start[0], token.end[0] + 1))
    return lines - docstring_lines(tree)


def size():
    """Code lines of each room."""
    lines = Counter()
    for name, path, tree in modules():
        lines[name.split(".")[0]] += len(code_lines(path, tree))
    return lines


def functions():
    """(name, definition, its code lines) of every function."""
    for name, path, tree in modules():
        code = code_lines(path, tree)
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                own = code & set(range(node.lineno, node.end_lineno + 1))
                yield f"{name}.{node.name}", node, len(own), path


def with_throw():
    """Public functions, constructors and methods that take `throw`."""
    parts = inspect.getmembers(jrigid, inspect.ismodule)
    modules = [jrigid, *(x for name, x in parts if not name.startswith("_"))]
    found = set()
    for module in modules:
        for name, value in inspect.getmembers(module):
            if name.startswith("_") or not getattr(value, "__module__", "").startswith("jrigid"):
                continue
            own = {name: value} if inspect.isfunction(value) else {}
            if inspect.isclass(value):
                own = {
                    f"{name}.{x}": getattr(value, x)
                    for x in vars(value)
                    if x == "__init__" or not x.startswith("_")
                }
            for label, function in own.items():
                if not callable(function):
                    continue
                throw = inspect.signature(function).parameters.get("throw")
                if throw and throw.default is True:  # elsewhere it is the number of a throw
                    found.add(label)
    return sorted(found)


def imports():
    """(importing module, imported module, imported names) within the package."""
    names = {name for name, _, _ in modules()}
    for name, _, tree in modules():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jrigid"):
                source = node.module.removeprefix("jrigid").removeprefix(".")
                found = [x.name for x in node.names]
                if not source:
                    for one in found:
                        yield name, one if one in names or f"{one}.__init__" in names else "", [one]
                else:
                    yield name, source, found


if __name__ == "__main__":
    lines = size()
    for room, count in sorted(lines.items()):
        print(f"{count:6} {room}")
    whole = sum(lines.values())
    print(f"{whole:6} in all, {whole - lines['identify']} without identify")
    throwing = with_throw()
    print(f"{len(throwing):6} public functions with `throw`:", *throwing)
    for name, _, count, _ in functions():
        if count > 60:
            print(f"{count:6} lines in {name}")
