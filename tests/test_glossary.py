"""One word for one thing: the glossary is in order,
and retired words are used nowhere."""

import inspect
import json
import re
from pathlib import Path

import house
import pytest

ROOT = Path(__file__).parents[1]
GLOSSARY = ROOT / "docs" / "contributing" / "glossary.md"

# Every entry of the third column, with an expression that finds it in prose. None: the
# word is also ordinary English or a name in jax (start, shape, a leaf of a pytree), so
# no expression can tell the retired use from others.
RETIRED = {
    "closed flow": r"closed flow",
    "door": r"doors?",
    "doors to other packages": r"doors? to other",
    "doubtful": r"doubtful",
    "face": None,
    "follow": None,
    "knot": None,
    "lane that is through": (
        "(lanes?|motions?) (that )?(is|are) through|is through, when"
    ),
    "leaf": None,
    "middle axis": r"middle axis",
    "momentum": None,
    "orientation": None,
    "pose": None,
    "shape": None,
    "spoilt throw": r"spoilt",
    "start": None,
    "throw": (
        r"(an?|the|this|that|these|those|each|every|one|two|its|best|first|last|other"
        r"|of|all|many|both|several|few|real|simulated|\d+) throws?(?! (flag|an))"
    ),
    "told": r"(un)?told(?! apart)",
    "torque-free motion": r"torque-free motion",
    "what is left": r"what (is|was|are|were) left(?! (of|out|at first))",
    "world axes": r"world axes",
}
EXPRESSIONS = {
    entry: re.compile(rf"\b(?:{expression})\b", re.IGNORECASE)
    for entry, expression in RETIRED.items()
    if expression is not None
}

# Words that no public name or parameter contains. `throw` by itself is a flag.
RETIRED_IN_NAMES = {"told", "doubtful", "spoilt", "door", "doors", "throws", "follow"}


def tables():
    """The rows (term, meaning, retired) of each table of the glossary."""
    for section in GLOSSARY.read_text().split("\n## ")[1:]:
        lines = [x for x in section.splitlines() if x.startswith("| ")]
        yield [[x.strip() for x in line.strip("| ").split(" | ")] for line in lines[1:]]


def retired_entries():
    """The entries of the third column, without what stands in brackets."""
    for table in tables():
        for row in table:
            if len(row) == 3:
                text = re.sub(r"\([^)]*\)", "", row[2])
                yield from (x.strip(" |") for x in text.split(",") if x.strip(" |"))


def found_in(text):
    """Retired words in a text, each with the words around it."""
    flat = " ".join(text.split())
    return [
        (entry, flat[max(match.start() - 30, 0) : match.end() + 30])
        for entry, expression in EXPRESSIONS.items()
        for match in expression.finditer(flat)
    ]


def parameters_of(value):
    """Names of the parameters of a function or a class."""
    try:
        return list(inspect.signature(value).parameters)
    except (TypeError, ValueError):
        return []


MODULES = house.public_modules()
PAGES = [
    ROOT / "README.md",
    *(x for x in sorted((ROOT / "docs").rglob("*.md")) if x != GLOSSARY),
]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def test_terms_are_unique():
    terms = [row[0] for table in tables() for row in table]
    assert len(terms) == len(set(terms))


def test_terms_are_sorted():
    for table in tables():
        terms = [row[0].strip("`").lower() for row in table]
        assert terms == sorted(terms)


def test_every_retired_word_is_searched_for_or_known_to_be_ordinary():
    assert set(retired_entries()) == set(RETIRED)


@pytest.mark.parametrize("name", MODULES)
def test_public_names_hold_no_retired_word(name):
    for label, value in house.public_objects(MODULES[name]):
        for identifier in [*label.split("."), *parameters_of(value)]:
            words = identifier.lower().split("_")
            assert not RETIRED_IN_NAMES & set(words), (label, identifier)
            assert words == ["throw"] or "throw" not in words, (label, identifier)


@pytest.mark.parametrize("name", MODULES)
def test_docstrings_hold_no_retired_word(name):
    module = MODULES[name]
    texts = {
        label: inspect.getdoc(x) or "" for label, x in house.public_objects(module)
    }
    texts["module"] = module.__doc__ or ""
    assert not {k: found_in(text) for k, text in texts.items() if found_in(text)}


@pytest.mark.parametrize(
    "page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix()
)
def test_pages_hold_no_retired_word(page):
    assert not found_in(page.read_text())


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_hold_no_retired_word(path):
    cells = json.loads(path.read_text())["cells"]
    assert not found_in(" ".join(x for cell in cells for x in cell["source"]))


@pytest.mark.parametrize(
    "folder", ["src", "tests", "benchmarks", "examples", "docs", "notebooks"]
)
def test_code_holds_no_retired_word(folder):
    """Names, comments, error messages and docstrings, also private ones."""
    files = [x for x in (ROOT / folder).rglob("*.py") if x.name != "test_glossary.py"]
    found = {x.relative_to(ROOT): found_in(x.read_text()) for x in files}
    assert not {k: words for k, words in found.items() if words}


@pytest.mark.parametrize(
    "text",
    [
        "a lane that is through",
        "what is not told by a record",
        "a hundred trials, and of throws",
        "the middle axis",
    ],
)
def test_retired_words_are_found(text):
    assert found_in(text)


@pytest.mark.parametrize(
    "text",
    [
        "with `throw=False` no error is raised",
        "to throw an error",
        "a body thrown outdoors",
        "they can be told apart",
    ],
)
def test_ordinary_words_are_not_found(text):
    assert not found_in(text)
