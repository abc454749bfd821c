"""The site that `make docs` has built: every name has a page, every page opens."""

import inspect
import re
import shutil
import zlib
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from chromium import Chromium

import jrigid as jr

SITE = Path(__file__).parents[1] / "build" / "docs"
PROGRAM = next(
    filter(None, map(shutil.which, ("chromium", "google-chrome", "chrome"))), None
)
built = pytest.mark.skipif(
    not (SITE / "objects.inv").exists(), reason="`make docs` builds it"
)
seen = pytest.mark.skipif(PROGRAM is None, reason="no chromium on this machine")

MODULES = {
    f"jrigid.{name}": module
    for name, module in inspect.getmembers(jr)
    if inspect.ismodule(module) and hasattr(module, "__all__")
}
NAMES = {
    f"{module}.{name}": getattr(x, name)
    for module, x in MODULES.items()
    for name in x.__all__
}
TOP = {
    f"jrigid.{k}": x
    for k, x in inspect.getmembers(jr)
    if not k.startswith("_") and not inspect.ismodule(x)
}
ALL = NAMES | TOP


@built
@pytest.mark.slow  # a site that was built long ago is no error
def test_the_index_has_every_public_name():
    packed = (SITE / "objects.inv").read_bytes().split(b"\n", 4)[4]
    lines = zlib.decompress(packed).decode().splitlines()
    listed = {x.split(" ", 1)[0] for x in lines if " py:" in x}
    wanted = {*MODULES, *NAMES, *TOP}
    assert not wanted - listed


def is_told(name, shown):
    """Its own example, or that of a function of the module that returns it or speaks of
    it."""
    text = inspect.getdoc(shown) or ""
    module, _, short = name.rpartition(".")
    others = [
        inspect.getdoc(x) or "" for k, x in ALL.items() if k.startswith(f"{module}.")
    ]
    returning = [
        inspect.getdoc(x) or ""
        for k, x in ALL.items()
        if k.startswith(f"{module}.")
        and inspect.isroutine(x)
        and short in str(inspect.signature(x).return_annotation)
    ]
    return any(">>>" in x for x in [text, *returning]) or any(
        ">>>" in x and re.search(rf"\b{short}\b", x.split(">>>", 1)[1]) for x in others
    )


@pytest.mark.parametrize("name", ALL)
def test_every_public_name_is_in_an_example(name):
    shown = ALL[name]
    if inspect.isclass(shown) or inspect.isroutine(shown):  # not an alias of types
        assert is_told(name, shown)


LOOK = """(async () => {
  const images = [...document.images];
  images.forEach(x => x.loading = 'eager');
  await Promise.all(images.map(x => x.decode().catch(() => null)));
  const scrolls = x => x.closest('article') !== x && x.tagName !== 'ARTICLE' &&
    (/auto|scroll/.test(getComputedStyle(x).overflowX) || scrolls(x.parentElement));
  return {
    images: images.filter(x => !x.naturalWidth).map(x => x.src),
    links: [...document.links].map(x => x.href).filter(x => x.startsWith('file:')),
    ids: [...document.querySelectorAll('[id]')].map(x => x.id),
    wide: [...document.querySelectorAll('article *')]
      .filter(x => x.getBoundingClientRect().right > innerWidth + 1 && !scrolls(x))
      .map(x => x.outerHTML.slice(0, 80)),
    formulas: [...document.querySelectorAll('merror')].map(x => x.textContent),
  };
})()"""


@built
@seen
@pytest.mark.slow
def test_every_page_opens_with_its_images_scripts_and_links():
    wrong, pages, links = [], {}, []
    with Chromium(PROGRAM) as tab:
        for path in sorted(SITE.rglob("*.html")):
            if (
                "_static" in path.parts or path == SITE / "index.html"
            ):  # which leads to another
                continue
            tab.open(path.as_uri(), width=390)  # a telephone's: nothing may stand out
            look = tab.evaluate(LOOK)
            page = path.relative_to(SITE)
            pages[path.resolve()] = set(look["ids"])
            links += [(page, x) for x in look["links"]]
            wrong += [(page, "complains", x) for x in tab.complaints()]
            wrong += [(page, "lacks", x) for x in look["images"]]
            wrong += [(page, "no formula", x) for x in look["formulas"]]
            wrong += [(page, "cuts off", x) for x in look["wide"][:3]]
    for page, link in links:
        address = urlsplit(link)
        target = Path(unquote(address.path)).resolve()
        target = target / "index.html" if target.is_dir() else target
        ids = pages.get(target, set())
        if not target.exists():
            wrong.append((page, "dead link", link))
        elif target.suffix == ".html" and unquote(address.fragment) not in {
            "",
            "top",
            *ids,
        }:
            wrong.append((page, "dead anchor", link))
    assert len(pages) > 40
    assert not wrong, "\n".join(" ".join(map(str, x)) for x in wrong)
