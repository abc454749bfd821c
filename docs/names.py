"""Write the table of all public names in docs/api.md.

`python docs/names.py` writes it, and `python docs/names.py --check` says whether it is
current.
"""

import inspect
import pathlib
import re
import sys

import jrigid

PAGE = pathlib.Path(__file__).parent / "api.md"
HEAD = "## All names\n"


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
    modules = {
        name: module
        for name, module in inspect.getmembers(jrigid)
        if inspect.ismodule(module) and hasattr(module, "__all__")
    }
    members = dict(inspect.getmembers(jrigid))
    own = [k for k, x in members.items() if k[0] != "_" and not inspect.ismodule(x)]
    parts = [f"### jrigid\n\n{table(jrigid, own)}\n"]
    for name, module in modules.items():
        parts.append(f"### jrigid.{name}\n\n{table(module, module.__all__)}\n")
    before = PAGE.read_text().split(HEAD)[0].rstrip()
    return before + "\n\n" + HEAD + "\n" + "\n".join(parts)


if __name__ == "__main__":
    if "--check" not in sys.argv:
        PAGE.write_text(written())
    elif PAGE.read_text() != written():
        sys.exit("docs/api.md is not current: run `python docs/names.py`.")
