"""Which version of the computation a number comes from: one hash over the sources that its purpose stands on.

Ground floor. Certificates and provenances carry the hash; the daemon compares it without importing what it names.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

_PACKAGE = Path(__file__).parents[1]

#: The checks of a set, and what they stand on: simulator, control laws, model and design.
VERIFIES = (
    *("lab/verify/*.py", "lab/simulate/*.py", "kernels/**/*.py", "formats/model/*.py"),
    *(f"formats/gains/{name}.py" for name in ("design", "parameters", "gain_set")),
)
#: What computes a design: it judges its choices by the same checks.
SYNTHESIZES = ("lab/synthesize/*.py", *VERIFIES)
#: What a diagnosis comes from, intake and simulator included.
DIAGNOSES = (
    *("lab/diagnose/**/*.py", "lab/recordings/**/*.py", "lab/simulate/*.py", "formats/recording/record.py"),
    "formats/recording/mcap_*.py",
    *("kernels/**/*.py", "formats/model/*.py"),
)


def sources(patterns: tuple[str, ...]) -> list[Path]:
    """Files whose change may change what comes out."""
    return sorted(path for pattern in patterns for path in _PACKAGE.glob(pattern))


@cache
def source_sha256(patterns: tuple[str, ...]) -> str:
    """Hash of these files as they were when this process first asked: what it runs itself."""
    return sha256_on_disk(patterns)


def sha256_on_disk(patterns: tuple[str, ...]) -> str:
    """Hash of these files by their names and contents as they are now: what a process that starts now will run."""
    digest = hashlib.sha256()
    for path in sources(patterns):
        digest.update(path.relative_to(_PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
