"""Writes cycle records into an MCAP file as the recorder's format says, with the mcap library alone."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from mcap.writer import Writer

from servod.formats.recording.record import CDR_HEADER, RECORD, CycleRecord, ros2msg


def write_mcap(path: Path, cycles: Iterable[CycleRecord]) -> Path:
    """One recording with the cycle topic only."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("servod/Cycle", "ros2msg", ros2msg().encode())
        channel = writer.register_channel("/servod/cycle", "cdr", schema)
        for cycle in cycles:
            writer.add_message(channel, cycle.time_ns, CDR_HEADER + RECORD.pack(*cycle), cycle.time_ns)
        writer.finish()
    return path
