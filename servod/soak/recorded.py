"""The rows that a daemon recorded, file by file, held against the SYNC frames of the same time.

Behind the recorder of a running daemon. A file that is complete is read, checked and removed, so that a soak of days
fits a disk.
"""

from __future__ import annotations

from servod.config import AxisConfig
from servod.recorder_read import read_recording
from servod.soak.finding import Findings, Wrong
from servod.soak.rows import RowCheck, rows_of
from servod.units import NS_PER_US

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
        self._rows_of_session = 0

    def take(self, explained: int, ended: bool) -> None:
        """Check every complete file; with `ended` the daemon is gone and all are."""
        paths = [path for path in self._folder.glob("*.mcap") if "-fault-" not in path.name]
        paths.sort(key=lambda path: path.stat().st_mtime_ns)
        for path in paths if ended else paths[:-1]:
            recording = read_recording(path)
            if recording.truncated:
                self._findings.add(Wrong.RECORDER, 0, f"{path.name} has no end")
            self.check.check(rows_of(recording.rows), explained, _ANSWER_CYCLES)
            self._rows_of_session += len(recording)
            self.files += 1
            path.unlink()

    def end_session(self, heard: int, may_be_taken: bool) -> None:
        """The daemon ended: the SYNC frames that were `heard` while it ran are as many as its rows."""
        rows, self._rows_of_session = self._rows_of_session, 0
        self.syncs += heard
        if may_be_taken and heard < rows:
            self.syncs_taken += rows - heard
        elif heard != rows:
            self._findings.add(Wrong.SYNC, 0, f"{heard} SYNC frames on the bus, {rows} rows recorded")
        self.check.new_session()
