"""One recording file: MCAP with the cycle records as CDR messages, events as JSON, and attachments.

Below the recorder, in its writing thread. The file survives kill -9 and a power cut: `sync` ends the chunk in progress
and has it on the disk, so that only what came since the last `sync` can be lost. Specification: https://mcap.dev/spec.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import struct
import tempfile
import time
import zlib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from servod.common.portable import flush_folder
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


_MAGIC = b"\x89MCAP0\r\n"
#: Opcode, bytes that follow these two, channel, sequence, log time and publish time of a message; its data come next.
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_HEAD_COUNTED = _MESSAGE_HEAD.size - 9
_PIECE_BYTES = 64 * 1024


def _packed(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


class ChunkedWriter:
    """MCAP in chunks packed with zstd and indexed, byte for byte what `mcap.writer.Writer` writes with all checksums.

    The library's writer keeps an object for every chunk until the end, which grows by megabytes an hour, and makes one
    for every message. Here the chunk indexes go to `spool`, packed, and a message is a head and its data.
    """

    def __init__(self, stream: IO[bytes], spool: IO[bytes], chunk_bytes: int) -> None:
        self._stream, self._spool, self._chunk_bytes = stream, spool, chunk_bytes
        self._data_crc = 0  # of all that was written so far: without it a bent opcode hides a whole chunk
        self._chunk = bytearray()  # the chunk in progress: schemas, channels, messages
        self._entries: defaultdict[int, list[int]] = defaultdict(list)  # by channel: time, place, time, place ...
        self._compress = zstandard.ZstdCompressor().compress
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        #: Where chunks end, since the last flush and the one before, and how many messages of each channel are in the
        #: file up to there.
        self.chunk_ends: list[tuple[int, dict[int, int]]] = []
        self._statistics = Statistics(
            attachment_count=0,
            channel_count=0,
            channel_message_counts=defaultdict(int),
            chunk_count=0,
            message_count=0,
            message_end_time=0,
            message_start_time=0,
            metadata_count=0,
            schema_count=0,
        )

    def start(self, profile: str, library: str) -> None:
        """Write the head of the file."""
        self._emit(_MAGIC)
        self._write(Header(profile=profile, library=library))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Number of a new schema; a channel names it."""
        self._statistics.schema_count = number = len(self._schemas) + 1
        self._schemas.append(Schema(id=number, name=name, encoding=encoding, data=data))
        self._chunk += _packed(self._schemas[-1])
        self._end_full_chunk()
        return number

    def add_channel(self, topic: str, encoding: str, schema: int) -> int:
        """Number of a new channel; a message names it."""
        self._statistics.channel_count = number = len(self._channels) + 1
        self._channels.append(Channel(id=number, topic=topic, message_encoding=encoding, schema_id=schema, metadata={}))
        self._chunk += _packed(self._channels[-1])
        self._end_full_chunk()
        return number

    def add_messages(self, channel: int, messages: Iterable[tuple[int, bytes]]) -> int:
        """Add time in ns and data of each message; returns how many there were."""
        chunk, entries, limit, head = self._chunk, self._entries, self._chunk_bytes, _MESSAGE_HEAD.pack
        opcode, count = int(Opcode.MESSAGE), 0
        for time_ns, data in messages:
            at = len(chunk)
            chunk += head(opcode, _HEAD_COUNTED + len(data), channel, 0, time_ns, time_ns)
            chunk += data
            entries[channel].extend((time_ns, at))
            count += 1
            if len(chunk) > limit:
                self._end_chunk()
        return count

    def add_attachment(self, time_ns: int, name: str, media_type: str, data: bytes) -> None:
        """Add a file; what is in the chunk in progress comes after it."""
        attachment = Attachment(create_time=time_ns, log_time=time_ns, name=name, media_type=media_type, data=data)
        at, length = self._write(attachment)
        index = AttachmentIndex(
            offset=at,
            length=length,
            log_time=time_ns,
            create_time=time_ns,
            data_size=len(data),
            name=name,
            media_type=media_type,
        )
        self._attachments.append(index)
        self._statistics.attachment_count += 1

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Add words with their meaning; what is in the chunk in progress comes after them."""
        at, length = self._write(Metadata(name=name, metadata=metadata))
        self._metadata.append(MetadataIndex(offset=at, length=length, name=name))
        self._statistics.metadata_count += 1

    def flush(self) -> None:
        """End the chunk in progress, if there are messages in it, and hand everything to the kernel."""
        self._end_chunk()
        self._stream.flush()
        del self.chunk_ends[:-1]

    def finish(self) -> None:
        """Write what is left, the summary and the foot; the stream stays open."""
        self._end_chunk()
        self._write(DataEnd(data_section_crc=self._data_crc))
        start = self._stream.tell()
        self._spool.seek(0)
        groups: tuple[tuple[int, Iterable[bytes]], ...] = (
            (Opcode.SCHEMA, map(_packed, self._schemas)),
            (Opcode.CHANNEL, map(_packed, self._channels)),
            (Opcode.STATISTICS, [_packed(self._statistics)]),
            (Opcode.CHUNK_INDEX, iter(lambda: self._spool.read(_PIECE_BYTES), b"")),
            (Opcode.ATTACHMENT_INDEX, map(_packed, self._attachments)),
            (Opcode.METADATA_INDEX, map(_packed, self._metadata)),
        )
        offsets, crc, at = [], 0, start
        for opcode, pieces in groups:
            length, crc = self._put(pieces, crc)
            offsets.append(SummaryOffset(group_opcode=opcode, group_start=at, group_length=length))
            at += length
        _, crc = self._put(map(_packed, offsets), crc)
        foot = _packed(Footer(summary_start=start, summary_offset_start=at, summary_crc=0))
        foot = foot[:-4]  # the checksum goes there: of the summary, and of the foot up to it
        self._stream.write(foot + zlib.crc32(foot, crc).to_bytes(4, "little") + _MAGIC)

    def _write(self, record: McapRecord) -> tuple[int, int]:
        """Where `record` stands in the file, and its length."""
        at, data = self._stream.tell(), _packed(record)
        if isinstance(record, Chunk):  # noted first: a disk that is full in the middle of it tells by the file's size
            self.chunk_ends.append((at + len(data), self._messages_by_channel()))
        self._emit(data)
        return at, len(data)

    def _emit(self, data: bytes) -> None:
        """Write a part of the data section."""
        self._data_crc = zlib.crc32(data, self._data_crc)
        self._stream.write(data)

    def _put(self, pieces: Iterable[bytes], crc: int) -> tuple[int, int]:
        """Write `pieces` of the summary; their length, and the checksum `crc` with them."""
        length = 0
        for piece in pieces:
            self._stream.write(piece)
            length, crc = length + len(piece), zlib.crc32(piece, crc)
        return length, crc

    def _end_full_chunk(self) -> None:
        if len(self._chunk) > self._chunk_bytes:
            self._end_chunk()

    def _end_chunk(self) -> None:
        """Write the chunk in progress and where its messages stand in it; without messages it stays in progress."""
        if not self._entries:
            return
        first_ns = min(min(entries[::2]) for entries in self._entries.values())
        last_ns = max(max(entries[::2]) for entries in self._entries.values())
        chunk = Chunk(
            compression="zstd",
            data=self._compress(self._chunk),
            message_end_time=last_ns,
            message_start_time=first_ns,
            uncompressed_crc=zlib.crc32(self._chunk),
            uncompressed_size=len(self._chunk),
        )
        at, length = self._write(chunk)
        end, offsets = at + length, {}
        for channel, entries in self._entries.items():
            size = 8 * len(entries)
            index = struct.pack(f"<BQHI{len(entries)}Q", Opcode.MESSAGE_INDEX, 6 + size, channel, size, *entries)
            self._emit(index)
            offsets[channel] = end
            end += len(index)
        chunk_index = ChunkIndex(
            chunk_length=length,
            chunk_start_offset=at,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=last_ns,
            message_index_length=end - at - length,
            message_index_offsets=offsets,
            message_start_time=first_ns,
            uncompressed_size=chunk.uncompressed_size,
        )
        self._spool.write(_packed(chunk_index))
        self._count_chunk(first_ns, last_ns)
        self._chunk.clear()
        self._entries.clear()

    def _messages_by_channel(self) -> dict[int, int]:
        """Messages so far, those of the chunk in progress among them."""
        counts = dict(self._statistics.channel_message_counts)
        for channel, entries in self._entries.items():
            counts[channel] = counts.get(channel, 0) + len(entries) // 2
        return counts

    def _count_chunk(self, first_ns: int, last_ns: int) -> None:
        total = self._statistics
        total.message_start_time = min(first_ns, total.message_start_time) if total.chunk_count else first_ns
        total.message_end_time = max(last_ns, total.message_end_time)
        total.chunk_count += 1
        for channel, entries in self._entries.items():
            total.channel_message_counts[channel] += len(entries) // 2
            total.message_count += len(entries) // 2


class McapFile:
    """A recording that is being written; every method may raise OSError when the disk does not take it."""

    def __init__(self, path: Path, attachments: Mapping[str, bytes], offset_ns: int) -> None:
        """Create `path`; `offset_ns` turns record times into the log times of the file."""
        self.path, self.records = path, 0
        self._offset_ns = offset_ns
        self._spool = tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115 - open as long as the recording is
        self._stream = path.open("xb")
        try:
            self._begin(attachments)
            flush_folder(path.parent)
        except BaseException:
            self.abandon()
            raise

    def _begin(self, attachments: Mapping[str, bytes]) -> None:
        self._writer = ChunkedWriter(self._stream, self._spool, _CHUNK_BYTES)
        self._writer.start(profile="ros2", library="servod")
        cycle_schema = self._writer.add_schema(CYCLE_SCHEMA, "ros2msg", ros2msg().encode())
        event_schema = self._writer.add_schema("servod.Event", "jsonschema", json.dumps(_EVENT_SCHEMA).encode())
        self._cycle = self._writer.add_channel(CYCLE_TOPIC, "cdr", cycle_schema)
        self._event = self._writer.add_channel(EVENT_TOPIC, "json", event_schema)
        self._writer.add_metadata("servod", {"wall_minus_monotonic_ns": str(self._offset_ns)})
        for name, data in attachments.items():
            self.attach(name, data)
        self.sync()

    def attach(self, name: str, data: bytes) -> None:
        """Add one file to the recording; a later one of the same name replaces it for readers."""
        self._writer.add_attachment(time.time_ns(), name, "application/yaml", data)

    def write_rows(self, rows: Iterable[bytes]) -> None:
        """Add packed cycle records (RECORD.size bytes each)."""
        offset_ns = self._offset_ns
        self.records += self._writer.add_messages(
            self._cycle, ((int.from_bytes(row[:8], "little") + offset_ns, CDR_HEADER + row) for row in rows)
        )

    def write_event(self, event: Mapping[str, Any]) -> None:
        """Add one event; it has at least time_ns (CLOCK_MONOTONIC), kind and text."""
        time_ns = int(event["time_ns"]) + self._offset_ns
        self._writer.add_messages(self._event, [(time_ns, json.dumps(event).encode())])

    def sync(self) -> None:
        """Have everything so far on the disk: from here on neither kill -9 nor a power cut can take it away.

        Raises FileNotFoundError when the file was deleted or moved: nobody would find what is written to it.
        """
        self._writer.flush()
        os.fsync(self._stream.fileno())
        if not self._is_there():
            raise FileNotFoundError(errno.ENOENT, "the file was deleted or moved while it was recorded", str(self.path))

    def _is_there(self) -> bool:
        """The file that is written is the one that its path names."""
        try:
            return os.path.samestat(self.path.stat(), os.fstat(self._stream.fileno()))
        except FileNotFoundError:
            return False

    def size_bytes(self) -> int:
        """Bytes written so far."""
        return self._stream.tell()

    def close(self) -> None:
        """Write index and footer, have it all on the disk, and close."""
        self._writer.finish()
        self.sync()
        self._stream.close()
        self._close_spool()

    def abandon(self) -> int:
        """Let go of a file that cannot be written any more; returns how many cycles can be read from its path.

        A file without any goes: of a full disk it would be an empty one.
        """
        held = 0
        with contextlib.suppress(OSError, ValueError):  # ValueError: it was closed already
            size = os.fstat(self._stream.fileno()).st_size
            ends = [counts for end, counts in self._writer.chunk_ends if end <= size and self._is_there()]
            held = ends[-1].get(self._cycle, 0) if ends else 0
            if not held and self._is_there():
                self.path.unlink()
        with contextlib.suppress(OSError):
            self._stream.raw.close()
        with contextlib.suppress(OSError, ValueError):
            self._stream.close()
        self._close_spool()
        return held

    def _close_spool(self) -> None:
        """Let go of the spool; it has no name, so nothing is left."""
        with contextlib.suppress(OSError):  # a full disk may refuse its last bytes
            self._spool.close()


def write_whole(path: Path, rows: Iterable[bytes], offset_ns: int) -> None:
    """A recording of these cycle records at `path`, where there is none: whole or not at all. Raises OSError."""
    file = McapFile(path, {}, offset_ns)
    try:
        file.write_rows(rows)
        file.close()
    except BaseException:
        file.abandon()
        path.unlink(missing_ok=True)
        raise


def split_rows(data: bytes | bytearray | memoryview) -> Iterator[bytes]:
    """The packed cycle records in `data`, one by one."""
    for at in range(0, len(data), RECORD.size):
        yield bytes(data[at : at + RECORD.size])
