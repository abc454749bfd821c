"""What the site adds to Sphinx: pages of modules, formulas, notebooks, links."""

import base64
import inspect
import io
import logging
import pathlib
import re
import sys

import math_core
import nbformat
from docutils import nodes
from names import MODULES, TOP
from PIL import Image
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.logging import getLogger
from sphinx.util.nodes import make_refnode

ROOT = pathlib.Path(__file__).parents[1]
API, THUMBNAILS = ROOT / "docs" / "api", ROOT / "docs" / "thumbnails"
EXECUTED = ROOT / "outputs" / "notebooks"


def home(name: str) -> str | None:
    """The public module that has what the package has by this name, if one does."""
    return next((k for k, x in MODULES.items() if name in x.__all__), None)


# Pages of modules.


def heading(text: str, line: str = "=") -> str:
    """A title in reStructuredText."""
    return f"{text}\n{line * len(text)}\n\n"


def listing(names: list[str]) -> str:
    """A table of names with the first sentence of each."""
    lines = "".join(f"   {name}\n" for name in names)
    return f".. autosummary::\n   :nosignatures:\n\n{lines}\n"


def write_api(app) -> None:
    """A page for each public module, and one for the package."""
    API.mkdir(exist_ok=True)
    pages = {}
    for name, module in MODULES.items():
        pages[name] = (
            heading(name)
            + f".. automodule:: {name}\n\n"
            + listing(module.__all__)
            + "".join(directive(name, x) for x in module.__all__)
        )
    own = [x for x in TOP if not home(x)]
    pages["jrigid"] = (
        heading("jrigid")
        + ".. automodule:: jrigid\n\n"
        + listing(TOP)
        + "".join(directive("jrigid", x) for x in own)
    )
    for name, text in pages.items():
        page = API / f"{name}.rst"
        if not page.exists() or page.read_text() != text:
            page.write_text(text)
    for page in API.glob("*.rst"):
        if page.stem not in pages:
            page.unlink()


def directive(module: str, name: str) -> str:
    """The directive that documents a name."""
    shown = getattr(sys.modules[module], name)
    if inspect.isclass(shown):
        return f".. autoclass:: {module}.{name}\n   :members:\n\n"
    kind = "function" if inspect.isroutine(inspect.unwrap(shown)) else "data"
    return f".. auto{kind}:: {module}.{name}\n\n"


def skip_numbered_fields(app, what, name, thing, skip, options):
    """Fields of named tuples are described by their class."""
    return True if type(thing).__name__ == "_tuplegetter" else None


def mark_up(app, what, name, thing, options, lines) -> None:
    """Write formulas, code, names and last words of docstrings in reStructuredText."""
    module = next((k for k in MODULES if f"{name}.".startswith(f"{k}.")), "jrigid")

    def code(match: re.Match) -> str:
        """A link where it is a name of this module, or of one that it names."""
        for target in (f"{module}.{match[1]}", f"jrigid.{match[1]}"):
            parent, _, last = target.rpartition(".")
            if last in getattr(
                MODULES.get(parent), "__all__", TOP if parent == "jrigid" else []
            ):
                return f":py:obj:`{match[1]} <{target}>`"
        return f"``{match[1]}``"

    text = "\n".join(lines)
    last = r"^(Gradients|Source): (.+(?:\n(?!Gradients:|Source:).*\S.*)*)"
    text = re.sub(last, last_words, text, flags=re.M)
    parts = re.split(r"(`[^`]*`|\$[^$]+\$|^ *>>>(?:.*\S.*\n?)*)", text, flags=re.M)
    for i, part in enumerate(parts):
        if part.startswith("`") and not parts[i - 1].endswith(":"):
            parts[i] = re.sub(r"`([^`]*)`", code, " ".join(part.split()))
        elif part.startswith("$"):
            parts[i] = f":math:`{' '.join(part[1:-1].split())}`"
        elif not i % 2:  # stars, bars and underscores mean nothing there
            parts[i] = re.sub(r"(?<!\*)\*(?=\w)|\||_\b", r"\\\g<0>", part)
    lines[:] = "".join(parts).split("\n")


def last_words(match: re.Match) -> str:
    """A paragraph of its own."""
    return f"**{match[1]}:** {' '.join(match[2].split())}\n"


def name_in_the_package(app, env) -> None:
    """`jrigid.State` is a name of `jrigid.dynamics.State`."""
    objects = env.domains.python_domain.objects
    for name in TOP:
        if home(name):
            objects[f"jrigid.{name}"] = objects[f"{home(name)}.{name}"]


class LinkNames(SphinxPostTransform):
    """Code in a text that is a public name becomes a link."""

    default_priority = 500

    def run(self, **_) -> None:
        """Look at every literal outside a link."""
        objects = self.env.domains.python_domain.objects
        for node in list(self.document.findall(nodes.literal)):
            named = re.fullmatch(r"jr(?:igid)?\.([\w.]+)(\(.*\))?", node.astext())
            inside = isinstance(node.parent, nodes.reference | nodes.title)
            if named is None or inside or f"jrigid.{named[1]}" not in objects:
                continue
            target = objects[f"jrigid.{named[1]}"]
            here, there = self.env.current_document.docname, target.docname
            if here != there:
                link = make_refnode(
                    self.app.builder, here, there, target.node_id, node.deepcopy()
                )
                node.replace_self(link)


def mark_numbers(app, doctree) -> None:
    """Numbers in tables are not broken at a minus sign."""
    for entry in doctree.findall(nodes.entry):
        if re.fullmatch(r"[-+.\de]+", entry.astext()):
            entry["classes"].append("number")


# Formulas: MathML, which needs neither script nor network.

CONVERTER = math_core.LatexToMathML()
_LONG = 50  # characters of LaTeX that are wider than a telephone


def visit_formula(self, node) -> None:
    """Write a formula, in a line or on its own."""
    block = isinstance(node, nodes.math_block)
    try:
        text = CONVERTER.convert_with_local_state(node.astext(), displaystyle=block)
    except math_core.LatexError as error:
        getLogger(__name__).warning("formula: %s", error, location=node)
        text = ""
    if block:
        text = f'<div class="formula">{text}</div>'
    elif len(node.astext()) > _LONG:
        text = f'<span class="formula">{text}</span>'
    self.body.append(text)
    raise nodes.SkipNode


# Notebooks: their executed copies, and the last picture of each.


def read_executed(app, docname: str, source: list[str]) -> None:
    """In place of a notebook its executed copy."""
    path = ROOT / f"{docname}.ipynb"
    if path.parent.name == "notebooks" and path.exists():
        copy = EXECUTED / path.name
        app.env.note_dependency(str(copy))
        source[0] = copy.read_text()


def gallery() -> str:
    """Cards with the title of each notebook and its last picture."""
    THUMBNAILS.mkdir(exist_ok=True)
    cards = []
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = nbformat.read(EXECUTED / path.name, as_version=4).cells
        title = next(
            x for x in cells[0].source.splitlines() if x.startswith("# ")
        ).lstrip("# ")
        outputs = [x.get("data", {}) for cell in cells for x in cell.get("outputs", [])]
        pictures = [x["image/png"] for x in outputs if "image/png" in x]
        shown = ""
        if pictures:
            image = Image.open(io.BytesIO(base64.b64decode(pictures[-1]))).convert(
                "RGB"
            )
            image.thumbnail((640, 640))
            image.save(THUMBNAILS / f"{path.stem}.png")
            shown = f":img-top: thumbnails/{path.stem}.png\n:img-alt: {title}\n"
        cards.append(
            f":::{{grid-item-card}} {title}\n"
            f":link: ../notebooks/{path.stem}\n"
            ":link-type: doc\n"
            f"{shown}:::\n"
        )
    return f"::::{{grid}} 1 2 2 3\n:gutter: 3\n\n{''.join(cards)}::::\n"


def fill_gallery(app, config) -> None:
    """`{{ gallery }}` in a page."""
    config.myst_substitutions["gallery"] = gallery()


def to_the_front(app, docname: str, source: list[str]) -> None:
    """README.md is in the front page and the start: links to it lead there."""
    text = re.sub(
        r"\]\((?:\.\./)*README\.md#install",
        "](/docs/getting_started.md#install",
        source[0],
    )
    source[0] = re.sub(r"\]\((?:\.\./)*README\.md", "](/docs/index.md", text)


def from_the_root(app, path, parent, content: list[str]) -> None:
    """Links of README.md where a page of docs/ includes it."""
    if path.name == "README.md":
        content[0] = re.sub(r"\]\((?!https?:)", "](../", content[0])


def setup(app) -> dict[str, bool]:
    """Called by Sphinx."""
    quiet = logging.getLogger(
        "sphinx.sphinx.directives.other"
    )  # of pages that may come
    quiet.addFilter(lambda record: "toctree glob pattern" not in str(record.msg))
    app.connect("config-inited", fill_gallery)
    app.connect("builder-inited", write_api)
    app.connect("source-read", read_executed)
    app.connect("source-read", to_the_front)
    app.connect("include-read", from_the_root)
    app.connect("autodoc-skip-member", skip_numbered_fields)
    app.connect("autodoc-process-docstring", mark_up)
    app.connect("doctree-read", mark_numbers)
    app.connect("env-updated", name_in_the_package)
    app.add_post_transform(LinkNames)
    app.add_html_math_renderer("mathml", (visit_formula, None), (visit_formula, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
