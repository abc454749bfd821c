"""The site: `make docs` builds build/docs, which is read without a server."""

import pathlib
import sys
from importlib import metadata

sys.path.insert(0, str(pathlib.Path(__file__).parent))

project = "jrigid"
author = copyright = "The jrigid authors"
version = release = metadata.version("jrigid")

# The source of the site is the repository, so that a page's links are right there and
# here.
root_doc = "docs/index"
include_patterns = [
    *("docs/**", "notebooks/*.ipynb", "benchmarks/results/*.md"),
    *("CHANGELOG.md", "CONTRIBUTING.md"),
]
exclude_patterns = [
    ".*",
    "build",
    "dist",
    "outputs",
    "src",
    "tests",
    "examples",
    "**/.*",
]

extensions = [
    *("sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"),
    *("myst_nb", "sphinx_design", "_site"),
]
nitpicky = True
nitpick_ignore_regex = [(r"py:class", ".*")]  # the types in signatures

add_module_names = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
autodoc_class_signature = "mixed"
autodoc_preserve_defaults = True
autosummary_generate = False
toc_object_entries_show_parents = "hide"
maximum_signature_line_length = 80
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Attributes", "params_style")]

myst_enable_extensions = [
    "dollarmath",
    "amsmath",
    "colon_fence",
    "substitution",
    "attrs_inline",
]
myst_heading_anchors = 3
myst_update_mathjax = False
nb_execution_mode = "off"  # notebooks/execute.py runs them
nb_merge_streams = True
nb_remove_code_source = False

html_math_renderer = "mathml"
html_theme = "pydata_sphinx_theme"
html_title = "jrigid"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_extra_path = ["_root"]  # index.html, which leads to docs/index.html
html_show_sourcelink = html_copy_source = False
html_context = {"default_mode": "auto"}
html_theme_options = {
    "logo": {"text": "jrigid"},
    "navbar_end": ["theme-switcher"],
    "header_links_before_dropdown": 8,
    "navigation_with_keys": False,
    "secondary_sidebar_items": {"**": ["page-toc"], "docs/index": []},
    "show_toc_level": 2,
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "a11y-light",
}
html_sidebars = {f"docs/{x}": [] for x in ("index", "getting_started", "physics")}
