"""A page's own script is tested where there is node to run it."""

from __future__ import annotations

import shutil

_NODE = shutil.which("node")
collect_ignore = [] if _NODE else ["test_page_script.py"]


def pytest_report_header() -> str:
    """Say whether the script is tested."""
    return f"node: {_NODE or 'ABSENT, tests/lab/report/test_page_script.py does not run'}"
