"""Code in README and docs/ runs: the blocks of a page, after the usual imports."""

import functools
import importlib.util
import json
import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import pytest

import jrigid as jr

matplotlib.use("Agg")
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
ROOT = Path(__file__).parents[1]
PAGES = [
    x
    for x in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    if BLOCK.search(x.read_text())
]


# What takes long in CI; recipes are all run.
LONG = re.compile(
    r"jr\.identify\.(fit|optimal_trial)\(|optax.*jr\.simulate"
    r"|photometry\.fit_shape\(|fit\.tumbler",
    re.DOTALL,
)
# What takes minutes to compile, in recipes too.
SLOW = re.compile(r"jr\.photometry\.find_tumblers\(")
LONG_PAGES = [
    x
    for x in PAGES
    # The block of identify.md is the example in the docstring of `fit`, but for what it
    # seeks.
    if x.parent.name != "recipes" and x.stem != "identify"
    if any(map(LONG.search, BLOCK.findall(x.read_text())))
]
SLOW_PAGES = [x for x in PAGES if any(map(SLOW.search, BLOCK.findall(x.read_text())))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_code_blocks_run_and_print_what_is_written_beside(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where they write their pictures
    is_short = page.parent.name == "recipes"

    def is_wanted(code):
        return not SLOW.search(code) and (is_short or not LONG.search(code))

    assert run(page, is_wanted)


@pytest.mark.slow
@pytest.mark.parametrize("page", LONG_PAGES + SLOW_PAGES, ids=lambda page: page.stem)
def test_code_blocks_that_take_long_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(page, lambda _: True)


def run(page, wanted):
    """How many blocks of a page were run."""
    text, count = page.read_text(), 0
    said = functools.partial(compare, text.splitlines())
    namespace = {"jax": jax, "jnp": jnp, "jr": jr, "print": said}
    for block in BLOCK.finditer(text):
        if not wanted(block[1]):
            continue
        above = text[: block.start(1)].count(
            "\n"
        )  # so that an error names the page's line
        code = compile("\n" * above + block[1], str(page), "exec")
        with jax.numpy_dtype_promotion(
            "standard"
        ):  # as users have it, and as optax needs it
            exec(code, namespace)
        count += 1
    if pyplot := sys.modules.get("matplotlib.pyplot"):
        pyplot.close("all")
    return count


NUMBER = re.compile(r"(?<![\w.^])[-+]?\d+\.?\d*(?:e[-+]?\d+)?")


def compare(page, *printed):
    """`print` in a block: numbers are those of the comment beside it,
    or on the next line."""
    line = sys._getframe(1).f_lineno
    comment = (
        "#".join(page[line - 1].split("#")[1:]) or page[line].strip().partition("# ")[2]
    )
    found, written = (
        NUMBER.findall(" ".join(map(str, printed))),
        NUMBER.findall(comment),
    )
    for x in found[: len(written)]:  # a loop's comment has the numbers of all its turns
        assert any(is_rounded(x, y) for y in written), (page[line - 1], printed)


def is_rounded(x, y):
    digits, _, power = y.partition("e")
    last = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
    return abs(float(x) - float(y)) <= last


DRAWS = re.compile(
    r"\b(plt|jr\.plot)\.\w|\.(plot|legend|annotate|scatter|hist|axvline)\("
)


@pytest.mark.parametrize(
    "path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem
)
def test_notebooks_draw_in_ten_lines(path):
    """A cell draws last: from where it begins to its end there are ten lines of code at
    most."""
    for cell in json.loads(path.read_text())["cells"]:
        code = [
            line for line in map(str.strip, cell["source"]) if line and line[0] != "#"
        ]
        drawing = [i for i, line in enumerate(code) if DRAWS.search(line)]
        if cell["cell_type"] == "code" and drawing:
            assert len(code) - drawing[0] <= 10, (cell["id"], code[drawing[0]])


def test_the_table_of_all_names_is_current():
    path = ROOT / "docs" / "names.py"
    spec = importlib.util.spec_from_file_location("names", path)
    names = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(names)
    message = "run `python docs/names.py`"
    assert names.PAGE.read_text() == names.written(), message
