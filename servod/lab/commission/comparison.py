"""Every law of a comparison on the virtual axis itself, with the same noise; what was measured before is not run again.

Under the step that validates. Figures and curves of a run are kept with the hash of what they were made from.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from servod.client.commission_axis import VirtualWalkAxis
from servod.common.errors import AnswerIsNo
from servod.formats.gains.gain_set import load_gains
from servod.lab.commission.files import RUNS, read_json, write_json
from servod.lab.commission.pooled import run_jobs
from servod.lab.commission.runs import save_curves
from servod.lab.commission.state import digest
from servod.lab.commission.walk import Tell, Walk
from servod.lab.tracking.stepped import measure

#: The law that was synthesized and not tuned, by its row in the comparison.
DEPLOYED = "deployed"


def run_files(walk: Walk, key: str) -> tuple[Path, Path]:
    """Where the figures and the curves of one law of the comparison are."""
    return walk.path(RUNS) / f"{key}.json", walk.path(RUNS) / f"{key}.npz"


def measured(
    walk: Walk, axis: VirtualWalkAxis, sets: Mapping[str, Path], cutoff_hz: float, tell: Tell
) -> dict[str, dict[str, Any]]:
    """Figures of every gain set by its key; those that ran before under the same conditions are read."""
    seed = walk.options.scoring_seed
    hashes = {key: _inputs(axis, file, cutoff_hz, seed) for key, file in sets.items()}
    left = [key for key in sets if not _done(walk, key, hashes[key])]
    jobs = [(axis, sets[key], cutoff_hz, seed, hashes[key], *run_files(walk, key)) for key in left]
    if jobs:
        run_jobs(_measure, jobs, left, walk.options.processes, tell)
    return {key: read_json(run_files(walk, key)[0])["figures"] for key in sets}


def _inputs(axis: VirtualWalkAxis, file: Path, cutoff_hz: float, seed: int) -> str:
    """What a run depends on; of the gain set its law and parameters alone."""
    parameters = load_gains(file).parameters_sha256()
    return digest({"axis": axis.identity, "parameters": parameters, "cutoff_hz": cutoff_hz, "seed": seed})


def _done(walk: Walk, key: str, inputs: str) -> bool:
    figures, curves = run_files(walk, key)
    if not figures.exists():
        return False
    found = read_json(figures)
    return bool(found["inputs_sha256"] == inputs and (curves.exists() or "failed" in found["figures"]))


def _measure(
    axis: VirtualWalkAxis, gains: Path, cutoff_hz: float, seed: int, inputs: str, figures: Path, curves: Path
) -> None:
    """In a worker: one law over the whole CAN loop; of one that the axis drops out under only that is told."""
    with tempfile.TemporaryDirectory(prefix="servod-commission-") as folder:
        try:
            found = measure(lambda: axis.open_session(Path(folder), cutoff_hz, seed), load_gains(gains))
        except AnswerIsNo as error:
            document: dict[str, Any] = {
                "rms_error_mrad": None,
                "max_error_mrad": None,
                "steps": {},
                "failed": str(error),
            }
        else:
            document = found.document()
            save_curves(curves, found.curves)
    write_json(figures, {"inputs_sha256": inputs, "figures": document})
