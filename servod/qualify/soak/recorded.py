"""The rows that a daemon recorded, file by file, held against the SYNC frames of the same time.

Behind the recorder of a running daemon. A file that is complete is read, checked and removed, so that a soak of days
fits a disk.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import faults_in
from servod.common.units import NS_PER_US
from servod.formats.config import AxisConfig
from servod.formats.recording.mcap_reader import read_recording
from servod.qualify.soak.explained import Explained
from servod.qualify.soak.finding import Findings, Wrong
from servod.qualify.soak.rows import RowCheck, Rows, rows_of

#: The deadlines of a loop on the wall clock may seem so far off, by what a wake-up costs beyond its lag.
_TOLERANCE_NS = 2_000_000
#: How long, in cycles, drive and axis may disagree where processes wait for their turn.
_ANSWER_CYCLES = 100


class RecordedRows:
    """Checks all recordings of one axis; `files` counts them, `check` holds the counts of rows and cycles."""

    def __init__(self, config: AxisConfig, findings: Findings) -> None:
        period_ns = config.cycle.period_us * NS_PER_US
        self._folder, self._findings = config.recorder.directory, findings
        self.check = RowCheck(period_ns, config.limits.torque_nm, findings, _TOLERANCE_NS)
        self.files = self.syncs = self.syncs_taken = 0
        self._rows_of_session = self._latched = 0
        self.excused: Counter[str] = Counter()

    def take(self, schedule: Explained, starved: Explained, ended: bool) -> None:
        """Check every complete file; with `ended` the daemon is gone and all are.

        A fault has its cause in the schedule, or in a machine that starved the processes at that time; the second are
        counted in `excused`. What is latched stays so, and is judged once.
        """
        paths = [path for path in self._folder.glob("*.mcap") if "-fault-" not in path.name]
        paths.sort(key=lambda path: path.stat().st_mtime_ns)
        for path in paths if ended else paths[:-1]:
            recording = read_recording(path)
            if recording.truncated:
                self._findings.add(Wrong.RECORDER, None, f"{path.name} has no end")
            rows = rows_of(recording.rows)
            self.check.check(rows, self._allowed(rows, schedule, starved), _ANSWER_CYCLES)
            self._rows_of_session += len(recording)
            self.files += 1
            path.unlink()

    def _allowed(self, rows: Rows, schedule: Explained, starved: Explained) -> NDArray[np.int64]:
        """The fault bits that each row may have; counts those that only a starved machine explains."""
        latched = rows["faults_latched"]
        before = np.concatenate(([self._latched], latched[:-1]))[: len(latched)]
        strict = schedule.at(rows["time_ns"])
        allowed = strict | starved.at(rows["time_ns"])
        for bits in (latched & ~before & allowed & ~strict).tolist():
            self.excused.update(fault.code.name for fault in faults_in(bits))
        self._latched = int(latched[-1]) if len(latched) else self._latched
        return allowed | before

    def end_session(self, heard: int, may_be_taken: bool) -> None:
        """The daemon ended: the SYNC frames that were `heard` while it ran are as many as its rows."""
        rows, self._rows_of_session, self._latched = self._rows_of_session, 0, 0
        self.syncs += heard
        if may_be_taken and heard < rows:
            self.syncs_taken += rows - heard
        elif heard != rows:
            self._findings.add(Wrong.SYNC, None, f"{heard} SYNC frames on the bus, {rows} rows recorded")
        self.check.new_session()
