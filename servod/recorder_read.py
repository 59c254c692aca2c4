"""Reads a recording back, whole or cut off by a crash, without numpy.

Behind the recorder; export, replay and the physics side start here. A file that ends in the middle of a record gives
everything before it and says `truncated`.
"""

from __future__ import annotations

import array
import json
import os
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, cast

import zstandard
from mcap.exceptions import InvalidMagic, McapError
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, Schema
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from servod.errors import BadInput
from servod.files import open_file
from servod.record import CDR_HEADER, CycleRecord
from servod.recorder_mcap import CYCLE_TOPIC, EVENT_TOPIC

_TIME = "time_ns"
_KINDS = {"float64": "d", "int64": "q"}
_LINE = re.compile(r"^(float64|int64) (\w+)  # \[([^]]*)\]")
_RECORD_LIMIT_BYTES = 64 * 1024 * 1024
#: Most that a file may hold unpacked; a few kilobytes can claim any amount.
_UNPACKED_LIMIT_BYTES = 4 * 1024**3
_BROKEN = (
    *(McapError, CRCValidationError, struct.error, zlib.error, zstandard.ZstdError, ValueError, EOFError, KeyError),
    *(OverflowError, RecursionError),
)


@dataclass
class Recording:
    """A recording in memory: `rows` holds the cycle records one behind the other, eight bytes for each name.

    `kinds` has one letter per name, "d" (float64) or "q" (int64), little endian; `truncated` tells that the file
    ends without its footer, as after kill -9, or is damaged; `damage` says then where, and what could be read.
    """

    names: tuple[str, ...] = ()
    kinds: str = ""
    units: tuple[str, ...] = ()
    rows: bytearray = field(default_factory=bytearray)
    attachments: dict[str, bytes] = field(default_factory=dict)
    events: list[dict[str, Any]] = field(default_factory=list)
    truncated: bool = True
    damage: str = ""

    def __len__(self) -> int:
        return len(self.rows) // self.row_bytes if self.names else 0

    @property
    def row_bytes(self) -> int:
        """Length of one row."""
        return 8 * len(self.names)

    def column(self, name: str) -> array.array[Any]:
        """One column as array('d') or array('q'). Raises KeyError when the recording has no such name."""
        if name not in self.names:
            raise KeyError(name)
        at = self.names.index(name)
        rows = memoryview(self.rows)
        if self.kinds[at] == "d":
            return array.array("d", rows.cast("d")[at :: len(self.names)])
        return array.array("q", rows.cast("q")[at :: len(self.names)])

    def records(self) -> list[CycleRecord]:
        """All rows as cycle records. Raises ValueError when the file was written with other fields than today's."""
        if self.names != CycleRecord._fields:
            raise ValueError("the recording has other fields than this version's cycle record")
        unpack = struct.Struct("<" + self.kinds).iter_unpack
        return [CycleRecord._make(row) for row in unpack(self.rows)]


def read_recording(path: str | Path) -> Recording:
    """The recording at `path`. Raises BadInput when it is missing or no recording of servod's at all."""
    recording = Recording()
    try:
        with open_file(path) as stream:
            bounded = _Bounded(stream)
            reader = StreamReader(
                cast(Any, bounded), validate_crcs=True, emit_chunks=True, record_size_limit=_RECORD_LIMIT_BYTES
            )
            _read_stream(reader, recording)
            _tell_damage(recording, stream.tell(), bounded.size)
    except InvalidMagic:
        raise BadInput(str(path), "a file that is not MCAP", "a recording of servod (.mcap)") from None
    except OSError as error:
        raise BadInput(str(path), error.strerror or str(error), "a readable recording") from None
    if not recording.names:
        found = f"no topic {CYCLE_TOPIC}" + (f" ({recording.damage})" if recording.damage else "")
        raise BadInput(str(path), found, "a recording of servod (.mcap)")
    if (_TIME, "q") not in zip(recording.names, recording.kinds, strict=True):
        raise BadInput(f"{path}: {CYCLE_TOPIC}", f"no field int64 {_TIME}", "a recording of servod (.mcap)")
    return recording


class _Bounded:
    """A file that is never asked for more than it has: Python makes room for all that is asked for."""

    def __init__(self, stream: BinaryIO) -> None:
        self.size = os.fstat(stream.fileno()).st_size
        self._stream = stream

    def read(self, count: int) -> bytes:
        """At most `count` bytes."""
        return self._stream.read(min(count, self.size))


def _tell_damage(recording: Recording, read_bytes: int, all_bytes: int) -> None:
    """Say where a file that has no end breaks off."""
    if recording.truncated:
        what = "cut off" if read_bytes >= all_bytes else "damaged"
        readable = f"{len(recording)} cycles could be read, from the first {read_bytes} of {all_bytes} bytes"
        recording.damage = f"the file is {what}: {readable}"


def _read_stream(reader: StreamReader, recording: Recording) -> None:
    """Read until the footer, or until the file breaks off."""
    schemas: dict[int, Schema] = {}
    topics: dict[int, str] = {}
    started = False
    try:
        for record in _unpacked(reader):
            started = True
            if isinstance(record, Footer):
                recording.truncated = False
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                topics[record.id] = record.topic
                _take_channel(record, schemas, recording)
            else:
                _take(record, topics, recording)
    except InvalidMagic:
        if not started:
            raise
        recording.truncated = True  # the last eight bytes are missing
    except _BROKEN:
        if not started:
            raise InvalidMagic((0,) * 8) from None


def _unpacked(reader: StreamReader) -> Iterator[McapRecord]:
    """All records, those in chunks too. Raises ValueError on a chunk that claims more than any recording has."""
    left_bytes = _UNPACKED_LIMIT_BYTES
    for record in reader.records:
        if not isinstance(record, Chunk):
            yield record
            continue
        size = max(record.uncompressed_size, _claimed_bytes(record))
        left_bytes -= size
        if size > _RECORD_LIMIT_BYTES or left_bytes < 0:
            raise ValueError(f"a chunk of {size} bytes")
        yield from breakup_chunk(record, validate_crc=True)


def _claimed_bytes(chunk: Chunk) -> int:
    """How much the packed data says that it unpacks to. Raises ValueError for a packing that servod does not write."""
    if chunk.compression not in ("", "zstd"):
        raise ValueError(f"compression {chunk.compression}")
    return max(zstandard.frame_content_size(chunk.data), 0) if chunk.compression else len(chunk.data)


def _take_channel(channel: Channel, schemas: dict[int, Schema], recording: Recording) -> None:
    if channel.topic == CYCLE_TOPIC and not recording.names:
        fields = [_LINE.match(line) for line in schemas[channel.schema_id].data.decode().splitlines()]
        known = [f.groups() for f in fields if f is not None]
        recording.kinds = "".join(_KINDS[kind] for kind, _, _ in known)
        recording.names = tuple(name for _, name, _ in known)
        recording.units = tuple(unit for _, _, unit in known)


def _take(record: object, topics: dict[int, str], recording: Recording) -> None:
    if isinstance(record, Attachment):
        recording.attachments[record.name] = record.data
    elif isinstance(record, Message) and topics.get(record.channel_id) == CYCLE_TOPIC:
        if len(record.data) == len(CDR_HEADER) + recording.row_bytes:
            recording.rows += record.data[len(CDR_HEADER) :]
    elif isinstance(record, Message) and topics.get(record.channel_id) == EVENT_TOPIC:
        event = json.loads(record.data)
        if isinstance(event, dict):
            recording.events.append(event)
