"""How many cycle records a scenario cost: what is missing in the recordings that the daemon left.

A recording that cannot be read at all is a complaint of its own: BadInput.
"""

from __future__ import annotations

from pathlib import Path

from servod.record import CycleRecord
from servod.recorder_read import read_recording


def lost_records(folder: Path, period_ns: int, ended_ns: int | None) -> int:
    """Cycles without a row in the recordings of `folder`; the files of single faults are not counted.

    Cycles that the loop skipped are none; `ended_ns` is when the daemon was hit, if it is gone: up to then there must
    be rows. Raises BadInput for a recording that cannot be read.
    """
    runs = [read_recording(path).records() for path in sorted(folder.glob("*.mcap")) if "-fault-" not in path.name]
    runs = [rows for rows in runs if rows]
    lost = sum(_holes(rows) for rows in runs)
    if ended_ns is not None and runs:
        last_ns = max(rows[-1].time_ns for rows in runs)
        lost += max(0, ended_ns - last_ns) // period_ns
    return lost


def _holes(rows: list[CycleRecord]) -> int:
    """Cycle numbers between the first row and the last that neither stand there nor were skipped by the loop."""
    return rows[-1].cycle - rows[0].cycle + 1 - len(rows) - (rows[-1].missed - rows[0].missed)
