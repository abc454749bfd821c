"""All public names; `python docs/names.py` writes their table in docs/api.md."""

import inspect
import pathlib
import re

import jrigid

PAGE = pathlib.Path(__file__).parent / "api.md"
HEAD = "## All names\n"
MODULES = {
    f"jrigid.{name}": module
    for name, module in inspect.getmembers(jrigid)
    if inspect.ismodule(module) and hasattr(module, "__all__")
}
TOP = sorted(
    k for k, x in inspect.getmembers(jrigid) if k[0] != "_" and not inspect.ismodule(x)
)


def first_sentence(thing: object) -> str:
    """The first sentence of a docstring, on one line of a table."""
    # A number or an alias of a type has the docstring of its class, which says nothing.
    has_own = inspect.isclass(thing) or inspect.isroutine(inspect.unwrap(thing))
    paragraph = (inspect.getdoc(thing) or "").split("\n\n")[0] if has_own else ""
    text = " ".join(paragraph.split())
    sentence = re.split(r"(?<=[a-z0-9)`][.])\s+(?=[A-Z`])", text)[0]
    return sentence.replace("|", r"\|")


def table(module: object, names: list[str]) -> str:
    """A table of names of a module, in the order of the alphabet."""
    rows = [f"| `{x}` | {first_sentence(getattr(module, x))} |" for x in sorted(names)]
    return "\n".join(["| name | |", "|---|---|", *rows])


def written() -> str:
    """The page as it should be."""
    names = {"jrigid": TOP} | {name: x.__all__ for name, x in MODULES.items()}
    modules = {"jrigid": jrigid} | MODULES
    parts = [f"### {name}\n\n{table(x, names[name])}\n" for name, x in modules.items()]
    before = PAGE.read_text().split(HEAD)[0].rstrip()
    return before + "\n\n" + HEAD + "\n" + "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(written())
