"""The size and the order of the house: `python tests/house.py [FOLDER ...]` prints
it."""

import ast
import inspect
import io
import sys
import tokenize
from collections import Counter
from pathlib import Path

import jrigid

ROOT = Path(__file__).parents[1] / "src" / "jrigid"


def modules():
    """Every source file by its dotted name below the package."""
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        yield ".".join(parts), path, ast.parse(path.read_text())


def docstring_lines(tree):
    """Lines of docstrings."""
    lines = set()
    for node in ast.walk(tree):
        if isinstance(
            node, ast.Module | ast.ClassDef | ast.FunctionDef
        ) and ast.get_docstring(node, clean=False):
            first = node.body[0]
            lines |= set(range(first.lineno, first.end_lineno + 1))
    return lines


COUNTED = {tokenize.NAME, tokenize.OP, tokenize.NUMBER}


def tokens_by_line(path):
    """Tokens of each line that has some: names, operators and numbers."""
    readline = io.StringIO(path.read_text()).readline
    tokens = tokenize.generate_tokens(readline)
    return Counter(x.start[0] for x in tokens if x.type in COUNTED)


def comment_lines(path):
    """How many lines hold a comment."""
    readline = io.StringIO(path.read_text()).readline
    tokens = tokenize.generate_tokens(readline)
    return len({x.start[0] for x in tokens if x.type == tokenize.COMMENT})


def functions():
    """(name, definition, tokens, path) of every function."""
    for name, path, tree in modules():
        tokens = tokens_by_line(path)
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                lines = range(node.lineno, node.end_lineno + 1)
                yield f"{name}.{node.name}", node, sum(tokens[x] for x in lines), path


def is_parallel(node):
    """Whether an assignment gives several names values that are written side by
    side."""
    return (
        isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Tuple)
        and isinstance(node.value, ast.Tuple)
    )


def is_any(annotation):
    """Whether an argument is annotated `Any`, alone."""
    return isinstance(annotation, ast.Name) and annotation.id == "Any"


def reading(root=ROOT):
    """How the code below a folder reads: the numbers of the table in the style
    guide."""
    lines = tokens = comments = assigned = parallel = arguments = anything = 0
    sizes = []
    for path in sorted(root.rglob("*.py")):
        tree = ast.parse(path.read_text())
        by_line = tokens_by_line(path)
        lines += len(by_line.keys() - docstring_lines(tree))
        tokens += sum(by_line.values())
        comments += comment_lines(path)
        for node in ast.walk(tree):
            assigned += isinstance(node, ast.Assign)
            parallel += is_parallel(node)
            if isinstance(node, ast.FunctionDef):
                inside = range(node.lineno, node.end_lineno + 1)
                sizes.append(sum(by_line[x] for x in inside))
                given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                annotated = [x.annotation for x in given if x.annotation is not None]
                arguments += len(annotated)
                anything += sum(map(is_any, annotated))
    sizes.sort()
    return {
        "code lines": lines,
        "tokens": tokens,
        "tokens a line": tokens / lines,
        "tokens a function, median": sizes[len(sizes) // 2],
        "tokens a function, 90 %": sizes[len(sizes) * 9 // 10],
        "tokens a function, longest": sizes[-1],
        "parallel assignments [%]": 100 * parallel / assigned,
        "arguments annotated `Any` [%]": 100 * anything / arguments,
        "comment lines to code lines": comments / lines,
    }


def public_modules():
    """Public modules by their names."""
    return {
        name: module
        for name, module in inspect.getmembers(jrigid)
        if inspect.ismodule(module) and hasattr(module, "__all__")
    }


def public_objects(module):
    """(name, object) of everything public in a module, and of what its classes add."""
    for name in module.__all__:
        value = getattr(module, name)
        yield name, value
        if inspect.isclass(value):
            for key, member in vars(value).items():
                if not key.startswith("_"):
                    yield f"{name}.{key}", inspect.unwrap(member)


def with_throw():
    """Public functions, constructors and methods that take `throw`."""
    parts = inspect.getmembers(jrigid, inspect.ismodule)
    modules = [jrigid, *(x for name, x in parts if not name.startswith("_"))]
    found = set()
    for module in modules:
        for name, value in inspect.getmembers(module):
            if name.startswith("_") or not getattr(value, "__module__", "").startswith(
                "jrigid"
            ):
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
                if "throw" in inspect.signature(function).parameters:
                    found.add(label)
    return sorted(found)


def imports():
    """(importing module, imported module, imported names) within the package."""
    names = {name for name, _, _ in modules()}
    for name, _, tree in modules():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
                "jrigid"
            ):
                source = node.module.removeprefix("jrigid").removeprefix(".")
                found = [x.name for x in node.names]
                if not source:
                    for one in found:
                        yield (
                            name,
                            one if one in names or f"{one}.__init__" in names else "",
                            [one],
                        )
                else:
                    yield name, source, found


if __name__ == "__main__":
    folders = [Path(x) for x in sys.argv[1:]] or [ROOT]
    for folder in folders:
        print(folder)
        for label, number in reading(folder).items():
            print(f"  {label:34} {number:10.4g}")
