"""Where a synthesized set comes from: hashes of the model's file, of the recordings behind it, and of this tool.

Beside the synthesis. The recordings' hashes stand in the model that an identification wrote; the tool's hash is over
the sources that compute, so that two versions of one number are told apart.
"""

from __future__ import annotations

import datetime
import hashlib
from pathlib import Path

import servod
from servod.common.sources import SYNTHESIZES, source_sha256
from servod.formats.gains.gain_set import Provenance
from servod.formats.model.axis_model import AxisModel


def provenance(model: AxisModel, model_path: Path | None, note: str) -> Provenance:
    """The provenance of a set for `model`, which was read from `model_path`. Raises OSError when it cannot be read."""
    return Provenance(
        author="servod",
        date=datetime.datetime.now(datetime.UTC).date(),
        tool=f"servod {servod.__version__} synthesize",
        tool_sha256=source_sha256(SYNTHESIZES),
        model_sha256=hashlib.sha256(model_path.read_bytes()).hexdigest() if model_path else None,
        data_sha256=list(model.identified.data_sha256) if model.identified else [],
        note=note,
    )
