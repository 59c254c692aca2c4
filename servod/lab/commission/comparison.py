"""Every law of a comparison on the virtual axis itself, with the same noise; what was measured before is not run again.

Under the step that validates. Figures and curves of a run are kept with the hash of what they were made from.
"""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np

from servod.client.open import VirtualWalkAxis
from servod.common.errors import AnswerIsNo, BadInput
from servod.common.files import make_folder, replacing, unreadable, unwritable
from servod.common.portable import flush_folder
from servod.common.progress import OnProgress
from servod.common.workers import worker_pool
from servod.formats.gains.gain_set import load_gains
from servod.formats.recording.mcap_reader import read_recording
from servod.formats.recording.mcap_writer import split_rows, write_whole
from servod.lab.commission.state import RUNS, digest, write_json
from servod.lab.commission.state import read_walk_json as read_json
from servod.lab.commission.walk import Walk
from servod.lab.recordings.recording import Rows, rows_of
from servod.lab.tracking.metrics import Curves
from servod.lab.tracking.stepped import measure

# --- Jobs of a step --------------------------------------------------------------------------------------------------
# Independent jobs of a step, side by side in worker processes, with progress by the jobs that are done.


T = TypeVar("T")


def run_jobs(
    work: Callable[..., T],
    jobs: Sequence[tuple[Any, ...]],
    names: Sequence[str],
    processes: int,
    on_progress: OnProgress,
) -> list[T]:
    """`work(*job)` for every job, in their order. Raises what the first job that fails raises."""
    on_progress(", ".join(names[:processes]), 0.0)
    with worker_pool(min(processes, len(jobs))) as pool:
        pending = [pool.submit(work, *job) for job in jobs]
        results = []
        for index, result in enumerate(pending):
            results.append(result.result())
            on_progress(", ".join(names[index + 1 : index + 1 + processes]) or names[-1], (index + 1) / len(jobs))
    return results


# --- Runs on disk ----------------------------------------------------------------------------------------------------
# Runs of deployments and comparisons on disk: recordings as MCAP, curves of the comparison as arrays. The report reads
# them back.


def save_rows(path: Path, rows: Rows) -> None:
    """Cycle records as a recording, in place of an earlier one. Raises BadInput."""
    aside = path.with_name(path.name + ".part")
    try:
        make_folder(path.parent)
        aside.unlink(missing_ok=True)
        write_whole(aside, split_rows(rows.tobytes()), 0)
        aside.replace(path)
        flush_folder(path.parent)
    except OSError as error:
        raise unwritable(path, error) from None


def load_rows(path: Path) -> Rows:
    """Cycle records of a recording. Raises BadInput."""
    return rows_of(read_recording(path).rows)


def save_curves(path: Path, curves: dict[str, Curves]) -> None:
    """Curves by motion, in single precision: they are for pictures. Raises BadInput."""
    arrays = {
        f"{motion}.{f.name}": getattr(run, f.name).astype(np.float32)
        for motion, run in curves.items()
        for f in fields(run)
    }
    try:
        make_folder(path.parent)
        with replacing(path) as stream:
            np.savez_compressed(stream, **arrays)
    except OSError as error:
        raise unwritable(path, error) from None


def load_curves(path: Path) -> dict[str, Curves]:
    """Curves by motion. Raises BadInput."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            motions = {name.partition(".")[0] for name in arrays.files}
            return {
                motion: Curves(**{f.name: arrays[f"{motion}.{f.name}"].astype(np.float64) for f in fields(Curves)})
                for motion in sorted(motions)
            }
    except OSError as error:
        raise unreadable(path, error, "runs that servoctl commission wrote") from None
    except (ValueError, KeyError, EOFError, BadZipFile, zlib.error):
        raise BadInput(str(path), "a broken file", "runs that servoctl commission wrote") from None


#: The law that was synthesized and not tuned, by its row in the comparison.
DEPLOYED = "deployed"


def run_files(walk: Walk, key: str) -> tuple[Path, Path]:
    """Where the figures and the curves of one law of the comparison are."""
    return walk.path(RUNS) / f"{key}.json", walk.path(RUNS) / f"{key}.npz"


def measured(
    walk: Walk, axis: VirtualWalkAxis, sets: Mapping[str, Path], cutoff_hz: float, on_progress: OnProgress
) -> dict[str, dict[str, Any]]:
    """Figures of every gain set by its key; those that ran before under the same conditions are read."""
    seed = walk.options.scoring_seed
    hashes = {key: _inputs(axis, file, cutoff_hz, seed) for key, file in sets.items()}
    left = [key for key in sets if not _done(walk, key, hashes[key])]
    jobs = [(axis, sets[key], cutoff_hz, seed, hashes[key], *run_files(walk, key)) for key in left]
    if jobs:
        run_jobs(_measure, jobs, left, walk.options.processes, on_progress)
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
            found = measure(lambda: axis.for_tracking(Path(folder), cutoff_hz, seed), load_gains(gains))
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
