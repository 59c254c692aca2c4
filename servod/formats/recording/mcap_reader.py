"""Reads a recording back, whole or cut off by a crash, without numpy.

Behind the recorder; export, replay and the physics side start here. A file that ends in the middle of a record gives
everything before it and says `truncated`; one with a damaged chunk, some half a second of cycles, gives all others.
"""

from __future__ import annotations

import array
import hashlib
import json
import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, cast

import zstandard
from mcap.exceptions import InvalidMagic, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, McapRecord, Message, Metadata, Schema, Statistics
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk, get_chunk_data_stream

from servod.common.errors import BadInput
from servod.common.files import open_file, unreadable
from servod.formats.recording.mcap_writer import CYCLE_TOPIC, EVENT_TOPIC
from servod.formats.recording.record import CDR_HEADER, CycleRecord

#: The column that every recording has.
TIME = "time_ns"
_KINDS = {"float64": "d", "int64": "q"}
_LINE = re.compile(r"^(float64|int64) (\w+)  # \[([^]]*)\]")
_WHOLE = re.compile(r"-?\d{1,19}")
_RECORD_LIMIT_BYTES = 64 * 1024 * 1024
#: Most that a file may hold unpacked; a few kilobytes can claim any amount.
_UNPACKED_LIMIT_BYTES = 4 * 1024**3
#: Most that is kept beside the cycles: attachments, events, and what the file says of its own form.
_BESIDE_LIMIT_BYTES = 32 * 1024 * 1024
_HASHED_BYTES = 1024 * 1024
#: Opcode, length, channel, sequence, log time and publish time of a message, before its data; what the length counts
#: begins behind it.
_MESSAGE_HEAD, _COUNTED_FROM = struct.Struct("<BQHIQQ"), 9
_REMEDY = "record in parts: a smaller recorder.max_file_mib"
_BROKEN = (
    *(McapError, CRCValidationError, struct.error, zlib.error, zstandard.ZstdError, ValueError, EOFError, KeyError),
    *(OverflowError, RecursionError),
)


@dataclass
class McapRecording:
    """A recording in memory: `rows` holds the cycle records one behind the other, eight bytes for each name.

    `kinds` has one letter per name, "d" (float64) or "q" (int64), little endian; `truncated` tells that the file
    ends without its footer, as after kill -9, or is damaged; `damage` says then where, and what could be read.
    `left_out` are the names in the file that were not wanted; `wall_offset_ns` turns its times into the time of day.
    Of attachments of one name the last counts; `attached` has all of them, in their order.
    `sha256` is of the very bytes that were read, to the end that the file had when it was opened.
    """

    names: tuple[str, ...] = ()
    kinds: str = ""
    units: tuple[str, ...] = ()
    rows: bytearray = field(default_factory=bytearray)
    attached: list[tuple[str, bytes]] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    truncated: bool = True
    damage: str = ""
    left_out: tuple[str, ...] = ()
    wall_offset_ns: int = 0
    sha256: str = ""

    def __len__(self) -> int:
        return len(self.rows) // self.row_bytes if self.names else 0

    @property
    def attachments(self) -> dict[str, bytes]:
        """Files in the recording by their names."""
        return dict(self.attached)

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


def read_recording(
    path: str | Path, wanted: Container[str] | None = None, most_cells: int | None = None
) -> McapRecording:
    """The recording at `path`; only its time and the names that are `wanted`, where that is given.

    Raises BadInput when it is missing, no recording of servod's at all, or too large: more than `most_cells` numbers
    in the names that are kept, or over 4 GiB unpacked, 3.4 hours at 1 kHz.
    """
    recording = McapRecording()
    taker = _Taker(path, recording, wanted, most_cells)
    try:
        with open_file(path) as stream:
            bounded = _Bounded(stream)
            _read_stream(_reader(bounded), taker)
            _note_damage(recording, taker, bounded)
            recording.sha256 = bounded.sha256()
    except InvalidMagic:
        raise BadInput(str(path), "a file that is not MCAP", "a recording of servod (.mcap)") from None
    except OSError as error:
        raise unreadable(path, error) from None
    if not recording.names:
        found = f"no topic {CYCLE_TOPIC}" + (f" ({recording.damage})" if recording.damage else "")
        raise BadInput(str(path), found, "a recording of servod (.mcap)")
    if (TIME, "q") not in zip(recording.names, recording.kinds, strict=True):
        raise BadInput(f"{path}: {CYCLE_TOPIC}", f"no field int64 {TIME}", "a recording of servod (.mcap)")
    return recording


def recorded_at_ns(path: str | Path) -> int | None:
    """The time of day of the first cycle of the recording at `path`, ns since 1970 in UTC; reads no further.

    None where the file does not tell: it is none of servod's, it is broken, or its axis was in virtual time.
    """
    found = McapRecording()
    taker = _Taker(path, found, (), None)
    try:
        with open_file(path) as stream:
            for record in _unpacked(_reader(_Bounded(stream)), path):
                taker.take(record)
                if found.rows and (found.names[0], found.kinds[0]) == (TIME, "q"):
                    return found.column(TIME)[0] + found.wall_offset_ns if found.wall_offset_ns else None
    except (*_BROKEN, OSError, BadInput):
        pass
    return None


def foreign_messages(path: str | Path, schema: str) -> Iterator[tuple[Schema, Channel, Message]]:
    """The messages of this schema in an MCAP file of other makers, in their order, with what tells how to decode them.

    Ends where the file breaks off. Raises BadInput when it is no MCAP file, or unpacks to over 4 GiB.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    beside_bytes = 0
    try:
        with open_file(path) as stream:
            for record in _unpacked(_reader(_Bounded(stream)), path):
                if isinstance(record, Schema | Channel):
                    beside_bytes += len(record.data) if isinstance(record, Schema) else len(record.topic)
                    if beside_bytes > _BESIDE_LIMIT_BYTES:
                        raise BadInput(str(path), f"over {beside_bytes} bytes of schemas", "a recording")
                if isinstance(record, Schema) and record.name == schema:
                    schemas[record.id] = record
                elif isinstance(record, Channel) and record.schema_id in schemas:
                    channels[record.id] = record
                elif isinstance(record, Message) and record.channel_id in channels:
                    channel = channels[record.channel_id]
                    yield schemas[channel.schema_id], channel, record
    except InvalidMagic:
        raise BadInput(str(path), "a file that is not MCAP", "a recording (.mcap)") from None
    except OSError as error:
        raise unreadable(path, error) from None
    except _BROKEN:
        return


def _reader(bounded: _Bounded) -> StreamReader:
    return StreamReader(cast(Any, bounded), validate_crcs=True, emit_chunks=True, record_size_limit=_RECORD_LIMIT_BYTES)


class _Bounded:
    """A file that is never asked for more than it had when it was opened: Python makes room for all that is asked for.

    Hashes what is read.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self.size, self.at = os.fstat(stream.fileno()).st_size, 0
        self._stream, self._hash = stream, hashlib.sha256()

    def read(self, count: int) -> bytes:
        """At most `count` bytes."""
        data = self._stream.read(min(count, self.size - self.at))
        self.at += len(data)
        self._hash.update(data)
        return data

    def sha256(self) -> str:
        """Of the whole file: what nobody has read yet is read for it."""
        while self.read(_HASHED_BYTES):
            pass
        return self._hash.hexdigest()


def _note_damage(recording: McapRecording, taker: _Taker, bounded: _Bounded) -> None:
    """Say where a file that has no end breaks off, and what one has lost whose index promises more cycles."""
    if recording.truncated:
        promised, left_out = taker.promised, taker.chunks_left_out
        what = "cut off" if bounded.at >= bounded.size and promised is None and not left_out else "damaged"
        cycles = f"{len(recording)} cycles" if promised is None else f"{len(recording)} of {promised} cycles"
        readable = f"{cycles} could be read, from the first {bounded.at} of {bounded.size} bytes"
        without = f"; damaged within, and left out: {left_out} of its pieces of some half a second" if left_out else ""
        recording.damage = f"the file is {what}: {readable}{without}"


def _read_stream(reader: StreamReader, taker: _Taker) -> None:
    """Read until the footer, or until the file breaks off."""
    started = False
    try:
        for record in _unpacked(reader, taker.path, taker.leave_out):
            started = True
            taker.take(record)
    except InvalidMagic:
        if not started:
            raise
        taker.recording.truncated = True  # the last eight bytes are missing
    except _BROKEN:
        if not started:
            raise InvalidMagic((0,) * 8) from None


def _unpacked(
    reader: StreamReader, path: str | Path, damaged: Callable[[], None] | None = None
) -> Iterator[McapRecord]:
    """All records, those in chunks too. Raises ValueError on a chunk that claims more than any of servod's has.

    A chunk that is damaged is left out where `damaged` wants to be told of it. Raises BadInput when all together are
    too many to be read at once.
    """
    left_bytes = _UNPACKED_LIMIT_BYTES
    for record in reader.records:
        if not isinstance(record, Chunk):
            yield record
            continue
        size = max(record.uncompressed_size, _claimed_bytes(record))
        if size > _RECORD_LIMIT_BYTES:
            raise ValueError(f"a chunk of {size} bytes")
        left_bytes -= size
        if left_bytes < 0:
            found = f"more than {_UNPACKED_LIMIT_BYTES} bytes unpacked"
            raise BadInput(str(path), found, f"at most that much at once; {_REMEDY}")
        try:
            inside = _records_of(record)
        except _BROKEN:
            if damaged is None:
                raise
            damaged()
        else:
            yield from inside


def _records_of(chunk: Chunk) -> list[McapRecord]:
    """What is in a chunk as `breakup_chunk` gives it, in a third of its time where that is messages alone."""
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    data, at, found = stream.read(size), 0, list[McapRecord]()
    while at + _MESSAGE_HEAD.size <= size:
        opcode, length, channel, sequence, logged_ns, published_ns = _MESSAGE_HEAD.unpack_from(data, at)
        end = at + _COUNTED_FROM + length
        if opcode != Opcode.MESSAGE or end < at + _MESSAGE_HEAD.size or end > size:
            break
        found.append(Message(channel, logged_ns, data[at + _MESSAGE_HEAD.size : end], published_ns, sequence))
        at = end
    return found if at == size else breakup_chunk(chunk, validate_crc=True)


def _claimed_bytes(chunk: Chunk) -> int:
    """How much the packed data says that it unpacks to. Raises ValueError for a packing that servod does not write."""
    if chunk.compression not in ("", "zstd"):
        raise ValueError(f"compression {chunk.compression}")
    return max(zstandard.frame_content_size(chunk.data), 0) if chunk.compression else len(chunk.data)


class _Taker:
    """Puts the records of one file into its recording, and counts what is kept of them."""

    def __init__(
        self, path: str | Path, recording: McapRecording, wanted: Container[str] | None, most_cells: int | None
    ) -> None:
        self.path, self.recording = path, recording
        self._wanted, self._most_cells = wanted, most_cells
        self._schemas: dict[int, Schema] = {}
        self._topics: dict[int, str] = {}
        self._row = struct.Struct("")  # splits a row of the file into the cells that are kept
        self._beside_bytes = 0
        self._taken: Counter[int] = Counter()  # messages by channel
        #: How many cycles the index of the file has, where that are not those that were read.
        self.promised: int | None = None
        self.chunks_left_out = 0

    def take(self, record: McapRecord) -> None:
        """Keep of a record what belongs into the recording. Raises BadInput when that becomes too much."""
        if isinstance(record, Message):
            self._taken[record.channel_id] += 1
            self._take_message(record)
        elif isinstance(record, Statistics):
            self._compare(record)
        elif isinstance(record, Footer):
            self.recording.truncated = self.promised is not None or self.chunks_left_out > 0
        elif isinstance(record, Schema):
            self._count_beside(len(record.data))
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._count_beside(len(record.topic))
            self._topics[record.id] = record.topic
            self._take_channel(record)
        elif isinstance(record, Metadata):
            self._count_beside(sum(map(len, record.metadata.values())))
            if record.name == "servod":
                offset = record.metadata.get("wall_minus_monotonic_ns", "")
                self.recording.wall_offset_ns = int(offset) if _WHOLE.fullmatch(offset) else 0
        elif isinstance(record, Attachment):
            self._count_beside(len(record.data))
            self.recording.attached.append((record.name, record.data))

    def leave_out(self) -> None:
        """A chunk is damaged; what stands behind it is read all the same."""
        self.chunks_left_out += 1

    def _compare(self, index: Statistics) -> None:
        """A record whose kind was bent is passed over in silence: the index knows how many there were."""
        counted = {k: n for k, n in index.channel_message_counts.items() if n}
        if counted != self._taken or index.attachment_count != len(self.recording.attached):
            cycles = next((k for k, topic in self._topics.items() if topic == CYCLE_TOPIC), 0)
            self.promised = counted.get(cycles, len(self.recording))

    def _take_channel(self, channel: Channel) -> None:
        if channel.topic != CYCLE_TOPIC or self.recording.names:
            return
        fields = [_LINE.match(line) for line in self._schemas[channel.schema_id].data.decode().splitlines()]
        known = [f.groups() for f in fields if f is not None]
        kept = [self._wanted is None or name == TIME or name in self._wanted for _, name, _ in known]
        fields_kept = [field for field, keep in zip(known, kept, strict=True) if keep]
        self.recording.kinds = "".join(_KINDS[kind] for kind, _, _ in fields_kept)
        self.recording.names = tuple(name for _, name, _ in fields_kept)
        self.recording.units = tuple(unit for _, _, unit in fields_kept)
        self.recording.left_out = tuple(name for (_, name, _), keep in zip(known, kept, strict=True) if not keep)
        self._row = struct.Struct("".join("8s" if keep else "8x" for keep in kept))

    def _take_message(self, message: Message) -> None:
        topic = self._topics.get(message.channel_id)
        if topic == CYCLE_TOPIC and len(message.data) == len(CDR_HEADER) + self._row.size:
            row = message.data[len(CDR_HEADER) :]
            self.recording.rows += b"".join(self._row.unpack(row)) if self.recording.left_out else row
            self._require_cells()
        elif topic == EVENT_TOPIC:
            self._count_beside(len(message.data))
            event = json.loads(message.data)
            if isinstance(event, dict):
                self.recording.events.append(event)

    def _require_cells(self) -> None:
        cells = len(self.recording.rows) // 8
        if self._most_cells is not None and cells > self._most_cells:
            found = f"{len(self.recording)} cycles or more of {len(self.recording.names)} columns"
            raise BadInput(str(self.path), found, f"at most {self._most_cells} numbers; {_REMEDY}")

    def _count_beside(self, count: int) -> None:
        self._beside_bytes += count
        if self._beside_bytes > _BESIDE_LIMIT_BYTES:
            found = f"over {self._beside_bytes} bytes of attachments, events and schemas"
            raise BadInput(str(self.path), found, f"at most {_BESIDE_LIMIT_BYTES} bytes beside the cycles")
