"""How the documentation is built: sphinx-build -W docs build/docs, or tools/test docs."""

from __future__ import annotations

import sys
from importlib.metadata import version as version_of
from pathlib import Path

from sphinx.ext import napoleon
from sphinx.ext.napoleon import GoogleDocstring

sys.path.insert(0, str(Path(__file__).parent))

project = "Skinware"
author = "the Skinware authors"
project_copyright = "the Skinware authors, Apache-2.0"
version = release = version_of("skinware")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_click",
    "code_tables",
    "command_pages",
    "driver_options",
    "json_fields",
]
source_suffix = {".md": "markdown"}
master_doc = "index"
exclude_patterns = ["_build"]

myst_heading_anchors = 3
myst_enable_extensions = ["fieldlist"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True


class _Docstring(GoogleDocstring):
    """Docstrings of attributes: their words up to a colon are no type, and sections in them are sections."""

    def _consume_inline_attribute(self) -> tuple[str, list[str]]:
        return "", GoogleDocstring(self._consume_to_end(), self._config).lines()


napoleon.GoogleDocstring = _Docstring

html_theme = "furo"
pygments_dark_style = "github-dark"  # the default one underlines names, which look like links then
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = f"Skinware {release}"
html_copy_source = False
html_show_sphinx = False
