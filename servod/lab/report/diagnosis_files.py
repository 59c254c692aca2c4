"""Writes what a diagnosis leaves in its folder: diagnosis.json, model.yaml, report.html and the pictures.

Behind `servoctl diagnose` and `servoctl demo --diagnose`; every file is written aside and renamed.
"""

from __future__ import annotations

import json
from pathlib import Path
from time import monotonic
from typing import Any

from servod.common.report_files import write_bytes
from servod.formats.model.axis_model import axis_model_yaml
from servod.lab.diagnose.document import diagnosis_document, extended_model, window_evidence
from servod.lab.diagnose.engine import Diagnosis
from servod.lab.report.diagnosis import write_report

#: Names of the files of the outside contract.
DOCUMENT, MODEL = "diagnosis.json", "model.yaml"


def write_files(folder: Path, diagnosis: Diagnosis, title: str) -> dict[str, Any]:
    """Write all files into `folder` and return the document. Without an answer there is no model. Raises BadInput."""
    begun = monotonic()
    evidence = diagnosis.evidence
    windows = window_evidence(diagnosis, evidence) if evidence else []
    document = diagnosis_document(diagnosis, windows)
    document["seconds"]["windows"] = round(monotonic() - begun, 2)
    extended = extended_model(diagnosis)
    if extended is None:
        (folder / MODEL).unlink(missing_ok=True)
    else:
        write_bytes(folder / MODEL, axis_model_yaml(extended).encode())
    write_report(folder, diagnosis, document, windows, title)
    document["seconds"]["report"] = round(monotonic() - begun - document["seconds"]["windows"], 2)
    write_bytes(folder / DOCUMENT, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
    return document
