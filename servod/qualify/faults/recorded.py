"""How many cycle records a scenario cost: what is missing in the recordings that the daemon left.

Behind the recorder of a daemon that always records. A recording that cannot be read at all is a complaint of its own
(BadInput), and so is none (AnswerIsNo): 0 records are lost only where there were records.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

from servod.common.errors import AnswerIsNo, BadInput
from servod.formats.recording.mcap_reader import read_recording
from servod.formats.recording.record import CycleRecord

#: A row is in the file when its chunk is, after half a second; the rest is for a machine that others use too [s].
_REACHES_S, _POLL_S = 2.0, 0.1


def lost_records(folder: Path, period_ns: int, due_ns: int | None) -> int:
    """Cycles without a row in the recordings of `folder`; the files of single faults are not counted.

    Cycles that the loop skipped are none. Up to `due_ns` there must be rows: now, or when the daemon was hit; None
    where it ended by itself. Raises BadInput for a recording that cannot be read, AnswerIsNo when there is none.
    """
    runs = [rows for path in _recordings(folder) if (rows := read_recording(path).records())]
    if not runs:
        raise AnswerIsNo(f"{folder}: no cycle was recorded, though recorder.always is set")
    tail_ns = 0 if due_ns is None else max(0, due_ns - max(rows[-1].time_ns for rows in runs))
    return sum(_holes(rows) for rows in runs) + tail_ns // period_ns


def wait_for_rows(folder: Path, until_ns: int, timeout_s: float = _REACHES_S) -> None:
    """Give a recorder that runs the time to bring the row of `until_ns` into its file; one that stopped never does."""
    deadline_s = time.monotonic() + timeout_s
    while _last_ns(folder) < until_ns and time.monotonic() < deadline_s:
        time.sleep(_POLL_S)


def _recordings(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.glob("*.mcap")) if "-fault-" not in path.name)


def _last_ns(folder: Path) -> int:
    """Time of the last row in the newest recording; 0 without one, or as long as there is no row in it."""
    newest = max(_recordings(folder), key=lambda path: path.stat().st_mtime_ns, default=None)
    with contextlib.suppress(BadInput):
        rows = read_recording(newest).records() if newest is not None else []
        return rows[-1].time_ns if rows else 0
    return 0


def _holes(rows: list[CycleRecord]) -> int:
    """Cycle numbers between the first row and the last that neither stand there nor were skipped by the loop."""
    return rows[-1].cycle - rows[0].cycle + 1 - len(rows) - (rows[-1].missed - rows[0].missed)
