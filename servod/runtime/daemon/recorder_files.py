"""Where recordings stand and how many of them: names, rotation, and how many fault files are kept.

Below the recorder, in its writing thread, so that a slow disk holds up nobody.
"""

from __future__ import annotations

import contextlib
import re
from datetime import datetime
from pathlib import Path

from servod.common.errors import BadInput
from servod.formats.config import RecorderConfig

MIB = 1024 * 1024
#: Names are shown in logs, on terminals and on pages: nothing in them may act there, or look like an option.
_FILE_NAME = re.compile(r"\w[\w .,+()-]{0,200}\.mcap")
_STAMP = "%Y%m%d-%H%M%S"


class RecordingFiles:
    """The recordings' directory of one axis."""

    def __init__(self, config: RecorderConfig, axis_name: str) -> None:
        self._directory, self._axis_name = config.directory, axis_name
        self._max_fault_files = config.max_fault_files
        self._fault_name = re.compile(rf"{re.escape(axis_name)}-fault-\d{{8}}-\d{{6}}-\w+(-\d+)?\.mcap")
        self.max_bytes = config.max_file_mib * MIB

    def recording(self, name: str | None) -> Path:
        """A path in the directory, and nowhere else: clients must not write where they please. Raises BadInput."""
        if name is None:
            return self._unused(f"{self._axis_name}-{_now()}")
        path = (self._directory / name).resolve()
        if path.parent != self._directory.resolve() or not _FILE_NAME.fullmatch(path.name):
            allowed = "a file name of letters, digits, spaces and any of . , + ( ) - that ends in .mcap, in"
            raise BadInput("record_start: path", repr(name), f"{allowed} {self._directory}")
        return path

    def next_part(self, first: Path) -> Path:
        """Where a recording goes on that began in `first` and is full: the same name with a number."""
        return self._unused(first.stem)

    def fault(self, label: str) -> Path:
        """A new path for the seconds before a fault."""
        return self._unused(f"{self._axis_name}-fault-{_now()}-{label}")

    def drop_old_fault_files(self) -> None:
        """Remove the oldest fault files beyond recorder.max_fault_files; whoever wants one for good copies it."""
        found = [path for path in self._directory.glob("*.mcap") if self._fault_name.fullmatch(path.name)]
        found.sort(key=lambda path: path.stat().st_mtime_ns)
        for path in found[: -self._max_fault_files]:
            with contextlib.suppress(OSError):
                path.unlink()

    def _unused(self, stem: str) -> Path:
        path, number = self._directory / f"{stem}.mcap", 1
        while path.exists():
            number += 1
            path = self._directory / f"{stem}-{number}.mcap"
        return path


def _now() -> str:
    return datetime.now().astimezone().strftime(_STAMP)
