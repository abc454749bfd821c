"""Code in README and docs/ runs: the blocks of a page, after the usual imports."""

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


LONG = re.compile(r"jr\.identify\.(fit|optimal_throw)\(|optax.*jr\.simulate", re.DOTALL)
LONG_PAGES = [x for x in PAGES if any(map(LONG.search, BLOCK.findall(x.read_text())))]
# The block of this page is the example in the docstring of `fit`, but for what it seeks beside.
LONG_PAGES.remove(ROOT / "docs" / "identify.md")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_code_blocks_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where they write their pictures
    run(page, lambda code: not LONG.search(code))


@pytest.mark.slow
@pytest.mark.parametrize("page", LONG_PAGES, ids=lambda page: page.stem)
def test_code_blocks_that_take_long_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run(page, lambda _: True)


def run(page, wanted):
    text, namespace = page.read_text(), {"jax": jax, "jnp": jnp, "jr": jr}
    for block in BLOCK.finditer(text):
        if not wanted(block[1]):
            continue
        above = text[: block.start(1)].count("\n")  # so that an error names the page's line
        code = compile("\n" * above + block[1], str(page), "exec")
        with jax.numpy_dtype_promotion("standard"):  # as users have it, and as optax needs it
            exec(code, namespace)
    if pyplot := sys.modules.get("matplotlib.pyplot"):
        pyplot.close("all")


DRAWS = re.compile(r"\b(plt|jr\.plot|ax|axes)\.\w")


@pytest.mark.parametrize(
    "path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem
)
def test_notebooks_draw_in_ten_lines(path):
    """A cell draws last: from where it begins to its end there are ten lines of code at most."""
    for cell in json.loads(path.read_text())["cells"]:
        code = [line for line in map(str.strip, cell["source"]) if line and line[0] != "#"]
        drawing = [i for i, line in enumerate(code) if DRAWS.search(line)]
        if cell["cell_type"] == "code" and drawing:
            assert len(code) - drawing[0] <= 10, (cell["id"], code[drawing[0]])
