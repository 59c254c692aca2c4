"""Names of the files in a walk's folder, and how plain values get into them.

Under state and steps.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from servod.common import files
from servod.common.errors import BadInput
from servod.formats.gains.store import write_file

RECORDINGS = "recordings"
MODEL, IDENTIFIED = "model.yaml", "identified.json"
DESIGN, RELAXED, INFEASIBLE = "design.yaml", "relaxed.json", "infeasible.json"
GAINS, CERTIFICATE = "gains.yaml", "certificate.json"
STORE, DEPLOYMENT = "store", "deployment.json"
BEFORE, BEFORE_ROWS, AFTER_ROWS = "runs/before.json", "runs/deploy_before.mcap", "runs/deploy_after.mcap"
RIVALS, TUNING = "rivals", "tuning.json"
TRACKING, RUNS = "tracking.json", "runs"
REPORT, PICTURES = "report.html", "pictures"
RESULT = "commission.json"
#: What steps had left that are done anew.
EARLIER = "earlier"


def write_text(path: Path, text: str) -> None:
    """Replace a file as a whole. Raises BadInput."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(str(path), error.strerror or str(error), "a file that can be written") from None
    write_file(path, text)


def write_json(path: Path, document: Any) -> None:
    """Replace a JSON file as a whole. Raises BadInput."""
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """The document of a JSON file of the walk. Raises BadInput."""
    return files.read_json(path, "the JSON that servoctl commission wrote")
