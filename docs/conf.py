"""How Sphinx builds these documents: `make docs`. What is made from the code and from the sample is in generate.py."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import generate  # noqa: E402

from lfpiv_cli import __version__  # noqa: E402

project = "lfpiv"
author = "the lfpiv developers"
copyright = "2026, the lfpiv developers"
release = version = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",
    "sphinx_click",
    "numpydoc",
]
# Parts of pages, and the sample's files.
exclude_patterns = ["_generated/sample", *(f"_generated/{name}.md" for name in ("tree", "interface", "gallery"))]
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
# Two dashes begin an option; they are no dash.
smartquotes_action = "qe"
# Names in docstrings are code.
default_role = "literal"
numpydoc_show_class_members = False
autodoc_typehints = "none"

html_theme = "furo"
html_title = f"lfpiv {release}"
html_static_path = ["_static"]
html_css_files = ["wide.css"]


def example_as_code(_app: Any, _ctx: Any, lines: list[str]) -> None:
    """Show the example at the end of a command's help as the code that it is."""
    start = next((n for n, line in enumerate(lines) if line.lstrip("| ").startswith("Example: ")), None)
    if start is not None:
        lines[start:] = list(generate.example(lines[start:]))


def setup(app: Any) -> None:
    """Make what is generated before Sphinx looks for pages."""
    app.connect("builder-inited", lambda _app: generate.everything())
    app.connect("sphinx-click-process-description", example_as_code)
