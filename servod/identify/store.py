"""Recordings of an identification on disk: one MCAP file for each experiment, and a list that says what each is.

Beside the walk; `load` gives the traces back for fits without an axis.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.errors import BadInput
from servod.identify.trace import Kind, Trace
from servod.recorder_mcap import McapFile, split_rows, wall_offset_ns
from servod.recorder_read import read_recording

LIST = "experiments.json"
_COLUMNS = ("torque_nm", "position_rad", "reference_rad", "torque_other_nm", "torque_actual_nm")


class Recordings:
    """A folder that gets a file for every motion, as soon as it is over."""

    def __init__(self, folder: Path) -> None:
        """Use `folder`; recordings of an earlier identification in it are replaced. Raises BadInput."""
        self.folder = folder
        self._list: list[dict[str, Any]] = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for old in [*folder.glob("[0-9][0-9]_*.mcap"), *folder.glob(LIST)]:
                old.unlink()
        except OSError as error:
            raise BadInput(str(folder), error.strerror or str(error), "a folder that can be written") from None

    def keep(self, rows: NDArray[np.void], trace: Trace) -> None:
        """Write one motion and the list with it. Raises BadInput when the disk does not take it."""
        name = f"{len(self._list):02d}_{trace.kind.value}.mcap"
        try:
            file = McapFile(self.folder / name, {}, wall_offset_ns())
            file.write_rows(split_rows(rows.tobytes()))
            file.close()
            self._list.append({"file": name, "kind": trace.kind.value, "settings": trace.settings})
            aside = self.folder / (LIST + ".part")
            aside.write_text(json.dumps(self._list, indent=1) + "\n", encoding="utf-8")
            aside.replace(self.folder / LIST)
        except OSError as error:
            raise BadInput(
                str(self.folder / name), error.strerror or str(error), "a file that can be written"
            ) from None


def load(folder: Path) -> list[Trace]:
    """All traces that `Recordings` wrote to `folder`. Raises BadInput."""
    path = folder / LIST
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        return [_trace(folder, Kind(entry["kind"]), entry["file"], entry["settings"]) for entry in entries]
    except OSError as error:
        raise BadInput(str(path), error.strerror or str(error), "a folder that servoctl identify wrote") from None
    except (ValueError, KeyError, TypeError) as error:
        raise BadInput(str(path), f"{type(error).__name__}: {error}", "the list that servoctl identify wrote") from None


def _trace(folder: Path, kind: Kind, name: str, settings: dict[str, float]) -> Trace:
    recording = read_recording(folder / name)
    time_ns = np.asarray(recording.column("time_ns"), dtype=np.int64)
    torque, position, reference, excitation, actual = (
        np.asarray(recording.column(column), dtype=np.float64) for column in _COLUMNS
    )
    return Trace(kind, (time_ns - time_ns[0]) * 1e-9, torque, position, reference, excitation, actual, settings)
