"""How Sphinx builds these documents: `make docs`."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from lfpiv_cli import __version__  # noqa: E402

project = "lfpiv"
author = "the lfpiv developers"
copyright = "2026, the lfpiv developers"
release = version = __version__

extensions = ["myst_parser"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
exclude_patterns = ["_generated"]

html_theme = "furo"
html_title = f"lfpiv {release}"
