"""One recording file: MCAP with the cycle records as CDR messages, events as JSON, and attachments.

Below the recorder, in its writing thread. The file survives kill -9: `sync` ends the chunk in progress and hands it to
the kernel, so that only what came since the last `sync` can be lost. Specification: https://mcap.dev/spec.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import CompressionType, Writer

from servod.formats.recording.record import CDR_HEADER, RECORD, ros2msg

CYCLE_TOPIC, EVENT_TOPIC = "/servod/cycle", "/servod/events"
CYCLE_SCHEMA = "servod/msg/Cycle"
_EVENT_SCHEMA = {
    "type": "object",
    "properties": {"time_ns": {"type": "integer"}, "kind": {"type": "string"}, "text": {"type": "string"}},
    "required": ["time_ns", "kind", "text"],
}
_CHUNK_BYTES = 256 * 1024


def wall_offset_ns() -> int:
    """What to add to CLOCK_MONOTONIC to get the time of day, in ns; recordings carry both."""
    return time.time_ns() - time.monotonic_ns()


class _SpooledIndexes(list[ChunkIndex]):
    """The writer's list of chunk indexes, kept in a nameless file beside the recording: in memory it would grow by
    megabytes an hour."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._spool = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - open as long as the recording is
        self._builder = RecordBuilder()

    def append(self, index: ChunkIndex) -> None:
        index.write(self._builder)
        self._spool.write(self._builder.end())

    def __iter__(self) -> Iterator[Any]:
        """One entry that writes them all; it has the one method that the MCAP writer calls."""
        yield self

    def write(self, builder: Any) -> None:
        """Put the spooled indexes into the summary section."""
        self._spool.seek(0)
        builder.write(self._spool.read())

    def close(self) -> None:
        """Let go of the spool; it has no name, so nothing is left."""
        with contextlib.suppress(OSError):  # a full disk may refuse its last bytes
            self._spool.close()


class McapFile:
    """A recording that is being written; every method may raise OSError when the disk does not take it."""

    def __init__(self, path: Path, attachments: Mapping[str, bytes], offset_ns: int) -> None:
        """Create `path`; `offset_ns` turns record times into the log times of the file."""
        self.path, self.records = path, 0
        self._offset_ns = offset_ns
        self._indexes = _SpooledIndexes(path.parent)
        self._stream = path.open("xb")
        try:
            self._begin(attachments)
        except BaseException:
            self.abandon()
            raise

    def _begin(self, attachments: Mapping[str, bytes]) -> None:
        self._writer = Writer(self._stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer._Writer__chunk_indices = self._indexes
        self._writer.start(profile="ros2", library="servod")
        cycle_schema = self._writer.register_schema(CYCLE_SCHEMA, "ros2msg", ros2msg().encode())
        event_schema = self._writer.register_schema("servod.Event", "jsonschema", json.dumps(_EVENT_SCHEMA).encode())
        self._cycle = self._writer.register_channel(CYCLE_TOPIC, "cdr", cycle_schema)
        self._event = self._writer.register_channel(EVENT_TOPIC, "json", event_schema)
        self._writer.add_metadata("servod", {"wall_minus_monotonic_ns": str(self._offset_ns)})
        for name, data in attachments.items():
            self.attach(name, data)
        self.sync()

    def attach(self, name: str, data: bytes) -> None:
        """Add one file to the recording; a later one of the same name replaces it for readers."""
        now_ns = time.time_ns()
        self._writer.add_attachment(now_ns, now_ns, name, "application/yaml", data)

    def write_rows(self, rows: Iterable[bytes]) -> None:
        """Add packed cycle records (RECORD.size bytes each)."""
        add, channel, offset_ns = self._writer.add_message, self._cycle, self._offset_ns
        for row in rows:
            time_ns = int.from_bytes(row[:8], "little") + offset_ns
            add(channel, time_ns, CDR_HEADER + row, time_ns)
            self.records += 1

    def write_event(self, event: Mapping[str, Any]) -> None:
        """Add one event; it has at least time_ns (CLOCK_MONOTONIC), kind and text."""
        time_ns = int(event["time_ns"]) + self._offset_ns
        self._writer.add_message(self._event, time_ns, json.dumps(event).encode(), time_ns)

    def sync(self) -> None:
        """Hand everything so far to the kernel: from here on kill -9 cannot take it away."""
        self._writer.flush()

    def size_bytes(self) -> int:
        """Bytes written so far."""
        return self._stream.tell()

    def close(self) -> None:
        """Write index and footer, and close."""
        self._writer.finish()
        self._stream.close()
        self._indexes.close()

    def abandon(self) -> None:
        """Let go of a file that cannot be written any more; what is in it stays readable."""
        with contextlib.suppress(OSError):
            self._stream.raw.close()
        with contextlib.suppress(OSError, ValueError):
            self._stream.close()
        self._indexes.close()


def split_rows(data: bytes | bytearray | memoryview) -> Iterator[bytes]:
    """The packed cycle records in `data`, one by one."""
    for at in range(0, len(data), RECORD.size):
        yield bytes(data[at : at + RECORD.size])
