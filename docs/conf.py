"""The manual as a site: Sphinx, MyST Markdown, Furo. `scripts/site` builds it.

The source folder is the checkout, not docs/, so that README, CONTRIBUTING and the others are pages too, and a relative
link leads to the same file on the site and where the checkout is looked at as it is.
"""

from __future__ import annotations

import re
from pathlib import Path

project = "servod"
author = "The servod authors"
project_copyright = author
_version = re.search(r'__version__ = "([^"]+)"', (Path(__file__).parents[1] / "servod/__init__.py").read_text())
release = version = _version[1] if _version else ""

extensions = ["myst_parser"]
root_doc = "docs/index"
#: What is a page. Everything else in the checkout is not looked at.
include_patterns = ["*.md", "docs/**.md", "changelog.d/README.md"]
exclude_patterns = [".*", "build", "demo", "drivers", "examples", "gains", "out", "requirements", "scripts", "servod"]
exclude_patterns += ["systemd", "tests"]
#: Anchors as GitHub makes them, down to this level.
myst_heading_anchors = 4
#: No network is needed to build the site. How these addresses are written is looked at by tests/tools/test_site.py.
linkcheck_ignore = [r"https?://"]

html_theme = "furo"
html_title = f"servod {release}"
html_static_path: list[str] = []
#: index.html at the top of the site leads to the start page.
html_extra_path = ["site"]
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
