"""Code in docs/ runs: the blocks of a page, one after the other, in one namespace."""

import re
from pathlib import Path

import jax
import pytest

PAGES = sorted((Path(__file__).parents[1] / "docs").glob("*.md"))
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_code_blocks_run(page):
    namespace = {}
    for match in BLOCK.finditer(text := page.read_text()):
        line = text[: match.start(1)].count("\n")
        code = compile("\n" * line + match[1], str(page), "exec")
        # optax promotes its counter
        with jax.numpy_dtype_promotion("standard"):
            exec(code, namespace)
