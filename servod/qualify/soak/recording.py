"""Whether the recorder keeps every row: what it wrote is read back and held against what it was given, byte by byte.

Behind the loop's rows; the same recorder as the daemon's.
"""

from __future__ import annotations

from pathlib import Path

from servod.formats.config import AxisConfig, RecorderConfig
from servod.formats.recording.mcap_reader import read_recording
from servod.formats.recording.mcap_writer import split_rows
from servod.qualify.soak.finding import Findings, Wrong
from servod.runtime.daemon.recorder import Recorder


class RecordingCheck:
    """Recordings of single episodes in `folder`, each removed once it was found whole; `rows` counts what was."""

    def __init__(self, config: AxisConfig, folder: Path, findings: Findings) -> None:
        recorder = RecorderConfig(directory=folder, history_s=1.0)
        self._recorder, self._findings = Recorder(recorder, "soak", config.cycle.period_us), findings
        self._given: bytearray | None = None
        self._path = Path()
        self.recordings = self.rows = 0

    def start(self) -> None:
        """Record from now on."""
        self._path = self._recorder.start().result()
        self._given = bytearray()

    def add(self, raw: bytes) -> None:
        """Rows of the loop, when something is being recorded."""
        if self._given is not None:
            self._given += raw
            self._recorder.add_rows(list(split_rows(raw)))

    def stop(self, time_ns: int) -> None:
        """End the recording, if there is one, and compare."""
        given, self._given = self._given, None
        if given is None:
            return
        state = self._recorder.stop().result()
        found = read_recording(self._path)
        if found.rows == given and not found.truncated and not state["failure"]:
            self._path.unlink()
            self.recordings += 1
            self.rows += len(found)
            return
        text = f"{self._path}: {len(found)} rows, {state['dropped']} dropped. {state['failure']}"
        self._findings.add(Wrong.RECORDER, time_ns, text)

    def close(self) -> None:
        """End the recorder."""
        self._recorder.close()
