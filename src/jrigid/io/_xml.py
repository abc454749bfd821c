"""Trees of XML files, with comments, and with what MJCF files include."""

import os
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple, cast

from jrigid._checks import demand

_BOM = "\ufeff"
_MACROS = (
    "Argument `path` must be expanded, but it has macros: `xacro a.xacro > a.urdf` "
    "first."
)


class Document(NamedTuple):
    """The text of an XML file.

    Attributes:
        text: As bytes from a file, whose encoding the parser finds out.
        path: Of the file; None for a text that a caller passed.
    """

    text: str | bytes
    path: Path | None

    @property
    def name(self) -> str:
        """Name in error messages."""
        return "The text" if self.path is None else f"File {str(self.path)!r}"


def document(source: str | Path) -> Document:
    """Open a file, or take a text of XML as it is.

    Args:
        source: A path, or a text that begins with `<` behind white space and a
            byte-order mark.

    Raises:
        ValueError: An empty text, or a path to what is no regular file.
        FileNotFoundError: No such file.
    """
    if isinstance(source, str):
        text = source.strip().removeprefix(_BOM).strip()
        demand(bool(text), "Argument `path` must be a file or XML, but it is empty.")
        if text.startswith("<"):
            return Document(text, None)
    path = Path(source)
    # Reading from a pipe or a device may never end.
    is_strange = path.exists() and not path.is_file()
    message = f"Argument `path` must be a file, but {str(path)!r} is not a regular one."
    demand(not is_strange, message)
    return Document(path.read_bytes(), path)


def tree_of(source: Document) -> ET.Element:
    """Parse XML with its comments, and put what MJCF files include in its place.

    Raises:
        ValueError: XML that is not well-formed, macros, or an include that MuJoCo
            refuses.
    """
    root = _parsed(source)
    if root.tag not in ("robot", "sdf"):
        main = source.path
        _include(root, source, _Includes(main, set() if main is None else {_key(main)}))
    return root


def around_root(source: Document) -> tuple[str, str]:
    """Return the comments before and after the root of well-formed XML.

    It also registers the prefixes of all namespaces, so that they are written again.
    """
    parser = ET.XMLPullParser(("start", "end", "comment", "pi", "start-ns"))
    parser.feed(source.text)
    parser.close()
    depth = 0
    has_begun = False
    before = ""
    after = ""
    # What comes with an event is an element or a pair of names.
    events = cast("Iterable[tuple[str, Any]]", parser.read_events())
    for event, x in events:
        if event == "start":
            depth += 1
            has_begun = True
        elif event == "end":
            depth -= 1
        elif event == "start-ns":
            # ElementTree keeps `ns0`, `ns1`, ... for itself.
            if x[0].strip("0123456789") not in ("", "ns"):
                ET.register_namespace(*x)
        # No element is open outside of the root.
        elif depth == 0:
            line = ET.tostring(x, "unicode").strip() + "\n"
            before += "" if has_begun else line
            after += line if has_begun else ""
    return before, after


def _parsed(source: Document) -> ET.Element:
    """The tree of one file, with comments."""
    builder = ET.TreeBuilder(insert_comments=True, insert_pis=True)
    try:
        root = ET.fromstring(source.text, ET.XMLParser(target=builder))
    # An unknown encoding is a LookupError, one that expat cannot decode a ValueError.
    except (ET.ParseError, LookupError, ValueError) as error:
        raise ValueError(f"{source.name} cannot be parsed as XML: {error}.") from error
    # ElementTree puts the address of a namespace in braces before a tag, as xacro's.
    # Tags of comments are functions, hence `str`.
    demand(not any("/xacro}" in str(x.tag) for x in root.iter()), _MACROS)
    return root


class _Includes(NamedTuple):
    """Files that were included so far.

    Attributes:
        main: The file that includes all others.
        files: Keys of the main file and of all that were included.
    """

    main: Path | None
    files: set[str]


def _key(path: Path) -> str:
    """One name for all ways to write a path; as MuJoCo it follows no links."""
    return os.path.normpath(path.absolute())


def _include(root: ET.Element, source: Document, includes: _Includes) -> None:
    """Replace each `<include>` by the children of the root of its file, in place.

    MuJoCo takes a file once in all, which also rules out cycles. Source: MuJoCo, XML
    reference, `include`.
    """
    # A list, because the loop changes the tree. What it puts in has no includes left.
    for parent in list(root.iter()):
        for child in parent.findall("include"):
            tree = _included(child, source, includes)
            i = list(parent).index(child)
            parent[i : i + 1] = list(tree)


def _included(element: ET.Element, source: Document, includes: _Includes) -> ET.Element:
    """The tree of an included file, with what that file includes."""
    message = (
        "Argument `path` must be a path, but it is the text of a file with includes."
    )
    demand(source.path is not None and includes.main is not None, message)
    assert source.path is not None
    assert includes.main is not None
    name = element.get("file", "")
    demand(bool(name), f"{source.name} has an `<include>` without a `file`.")
    is_empty = not len(element) and not (element.text or "").strip()
    include = f"`<include file={name!r}>`"
    demand(is_empty, f"{source.name} has an {include} with children: delete them.")
    # A name counts from the folder of the main file, or else of the including one.
    beside_main = includes.main.parent / name
    path = beside_main if beside_main.exists() else source.path.parent / name
    demand(path.is_file(), f"{source.name} has an {include}, but that is no file.")
    message = f"{source.name} has an {include}, but MuJoCo takes each file only once."
    demand(_key(path) not in includes.files, message)
    includes.files.add(_key(path))
    document = Document(path.read_bytes(), path)
    tree = _parsed(document)
    is_filled = any(isinstance(x.tag, str) for x in tree)  # comments have no name
    demand(is_filled, f"{document.name} is included, but it has no elements.")
    _include(tree, document, includes)
    return tree
