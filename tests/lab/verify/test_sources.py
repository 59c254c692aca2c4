"""What a hash of the tool covers is what the tool really imports, or states here to be without influence."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import servod
from servod.common.sources import DIAGNOSES, SYNTHESIZES, VERIFIES, sources

PACKAGE = Path(servod.__file__).parent
#: Reading and writing of files, names and numbers of commands, processes: no figure depends on them.
NEUTRAL = (
    *("common/", "formats/config", "formats/gains/signature.py", "formats/kinds.py", "formats/protocol.py"),
    "formats/wiring.py",
)


def without_influence(path: str) -> bool:
    """A file that no figure depends on: one of NEUTRAL, or the docstring of a package."""
    return path.startswith(NEUTRAL) or (path.endswith("__init__.py") and len((PACKAGE / path).read_text()) < 400)


def imported(*modules: str) -> set[str]:
    """Files of servod that a fresh process has after importing these."""
    code = (
        f"import sys, {', '.join(modules)}; "
        "print(*(m.__file__ for n, m in list(sys.modules.items()) if n.split('.')[0] == 'servod'), sep='\\n')"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return {Path(line).relative_to(PACKAGE).as_posix() for line in result.stdout.split()}


@pytest.mark.parametrize(
    ("patterns", "modules"),
    [
        (VERIFIES, ["servod.lab.verify.certify"]),
        (DIAGNOSES, ["servod.lab.diagnose.engine", "servod.lab.diagnose.document"]),
        (
            SYNTHESIZES,
            [f"servod.lab.synthesize.{name}" for name in ("gain_set", "reference", "regions", "crosscheck")],
        ),
    ],
    ids=["verify", "diagnose", "synthesize"],
)
def test_the_sources_are_what_is_imported(patterns: tuple[str, ...], modules: list[str]) -> None:
    found = imported(*modules)
    covered = {path.relative_to(PACKAGE).as_posix() for path in sources(patterns)}
    assert {path for path in found - covered if not without_influence(path)} == set()
    for pattern in patterns:
        assert {path.relative_to(PACKAGE).as_posix() for path in sources((pattern,))} & found, pattern
