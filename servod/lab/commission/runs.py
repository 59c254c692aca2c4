"""Runs of deployments and comparisons on disk: recordings as MCAP, curves of the comparison as arrays.

Under the steps; the report reads them back.
"""

from __future__ import annotations

import zlib
from dataclasses import fields
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import BadInput
from servod.formats.recording.mcap_reader import read_recording
from servod.formats.recording.mcap_writer import McapFile, split_rows
from servod.lab.recordings.rows import ROW
from servod.lab.tracking.metrics import Curves


def save_rows(path: Path, rows: NDArray[np.void]) -> None:
    """Cycle records as a recording, in place of an earlier one. Raises BadInput."""
    aside = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        aside.unlink(missing_ok=True)
        file = McapFile(aside, {}, 0)
        file.write_rows(split_rows(rows.tobytes()))
        file.close()
        aside.replace(path)
    except OSError as error:
        raise BadInput(str(path), error.strerror or str(error), "a file that can be written") from None


def load_rows(path: Path) -> NDArray[np.void]:
    """Cycle records of a recording. Raises BadInput."""
    return np.frombuffer(read_recording(path).rows, dtype=ROW)


def save_curves(path: Path, curves: dict[str, Curves]) -> None:
    """Curves by motion, in single precision: they are for pictures. Raises BadInput."""
    arrays = {
        f"{motion}.{f.name}": getattr(run, f.name).astype(np.float32)
        for motion, run in curves.items()
        for f in fields(run)
    }
    aside = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with aside.open("wb") as stream:
            np.savez_compressed(stream, **arrays)
        aside.replace(path)
    except OSError as error:
        raise BadInput(str(path), error.strerror or str(error), "a file that can be written") from None


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
        raise BadInput(str(path), error.strerror or "a broken file", "runs that servoctl commission wrote") from None
    except (ValueError, KeyError, EOFError, BadZipFile, zlib.error):
        raise BadInput(str(path), "a broken file", "runs that servoctl commission wrote") from None
