"""How Sphinx makes the site of the documents: `make site`, or see CONTRIBUTING.md.

Its source folder is the root of the project, so that a link of a page leads to the same place here
and where the repository is read. `_toc.yml` has the pages; one that it lacks is a warning, and so
is a link or an anchor that leads nowhere, and warnings are errors.
"""

from __future__ import annotations

import re
from importlib import import_module
from typing import Any

from numpy.typing import ArrayLike
from sphinx.util.typing import stringify_annotation

from hiersched import __version__

project = "hiersched"
copyright = "the hiersched authors"
version = release = __version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_external_toc",
]
include_patterns = ["*.md", "docs/**", "config/README.md", "src/hiersched/config/README.md"]
exclude_patterns = [".*", "results", "build", "dist"]
external_toc_path = "docs/_toc.yml"
external_toc_exclude_missing = False

# As GitHub does: anchors of headings; tables, but no other extension of Markdown.
myst_heading_anchors = 4
myst_url_schemes = ("https", "mailto")
myst_enable_extensions = []

nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_execution_timeout = 300
nb_merge_streams = True
nb_output_stderr = "remove"  # what compiles, where nothing has been compiled yet

highlight_language = "none"
default_role = "py:obj"
viewcode_follow_imported_members = False  # a name has its source where it is defined
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
python_maximum_signature_line_length = 88
add_module_names = False
napoleon_google_docstring = False
napoleon_use_rtype = False

html_theme = "furo"
html_title = f"hiersched {version}"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False

ARRAY = re.compile(
    r"~numpy\.ndarray\[tuple\[~typing\.Any, \.\.\.\], "
    r"~numpy\.dtype\[~(?:numpy|typing)\.(\w+)(?:\[[^]]*\])?\]\]"
)
ARRAY_LIKE = stringify_annotation(ArrayLike, "smart")


def _name_arrays(*given: Any) -> tuple[str | None, str | None]:
    """Write types of arrays as the code does; autodoc shows what their names stand for."""
    takes, returns = (
        text and ARRAY.sub(r"NDArray[\1]", text).replace(ARRAY_LIKE, "ArrayLike")
        for text in given[-2:]
    )
    return takes, returns


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-signature", _name_arrays)
    for name in ("env", "control"):  # autodoc sees what is there, not what loads on first use
        package = import_module(f"hiersched.{name}")
        vars(package).update((thing, getattr(package, thing)) for thing in package.__all__)
