"""The writer of recordings beside the one of the mcap library: the same bytes, and no memory for each chunk."""

import hashlib
import tempfile
import tracemalloc
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import Writer

from servod.formats.recording.mcap_reader import read_recording
from servod.formats.recording.mcap_writer import ChunkedWriter, McapFile
from servod.formats.recording.record import RECORD

MAGIC = b"\x89MCAP0\r\n"
_TIMES = st.integers(0, 2**63)
_WORDS = st.text(max_size=8)
_MESSAGES = st.lists(st.tuples(_TIMES, st.binary(max_size=200)), max_size=12)
_CALLS = st.lists(
    st.one_of(
        st.tuples(st.just("messages"), st.sampled_from((1, 2)), _MESSAGES),
        st.tuples(st.just("attachment"), _TIMES, _WORDS, _WORDS, st.binary(max_size=500)),
        st.tuples(st.just("metadata"), _WORDS, st.dictionaries(_WORDS, _WORDS, max_size=3)),
        st.tuples(st.just("schema"), _WORDS, st.just("jsonschema"), st.binary(max_size=300)),
        st.tuples(st.just("channel"), _WORDS, _WORDS, st.just(1)),
        st.tuples(st.just("flush")),
    ),
    max_size=20,
)
_PRELUDE = (("schema", "a", "jsonschema", b"{}"), ("channel", "/one", "json", 1), ("channel", "/two", "json", 1))


def _by_the_library(calls: list[tuple[Any, ...]], chunk_bytes: int) -> bytes:
    stream = BytesIO()
    writer = Writer(stream, chunk_size=chunk_bytes, enable_data_crcs=True)
    writer.start(profile="ros2", library="servod")
    for name, *values in calls:
        if name == "messages":
            for time_ns, data in values[1]:
                writer.add_message(values[0], time_ns, data, time_ns)
        elif name == "attachment":
            writer.add_attachment(values[0], *values)
        else:
            method = {"schema": "register_schema", "channel": "register_channel", "metadata": "add_metadata"}
            getattr(writer, method.get(name, name))(*values)
    writer.finish()
    return stream.getvalue()


def _by_ours(calls: list[tuple[Any, ...]], chunk_bytes: int) -> bytes:
    stream = BytesIO()
    writer = ChunkedWriter(stream, BytesIO(), chunk_bytes)
    writer.start("ros2", "servod")
    for name, *values in calls:
        getattr(writer, name if name == "flush" else f"add_{name}")(*values)
    writer.finish()
    return stream.getvalue()


@settings(max_examples=200, deadline=None)
@given(_CALLS, st.sampled_from((40, 300, 2000, 100_000)))
def test_the_same_calls_make_the_same_file_as_with_the_library(drawn: list[tuple[Any, ...]], chunk_bytes: int) -> None:
    calls = [*_PRELUDE, *drawn]
    ours = _by_ours(calls, chunk_bytes)
    assert ours == _by_the_library(calls, chunk_bytes)
    reader = make_reader(BytesIO(ours), validate_crcs=True)
    read = sorted((channel.id, m.log_time, m.publish_time, m.data) for _, channel, m in reader.iter_messages())
    written = [(c[1], time, time, data) for c in calls if c[0] == "messages" for time, data in c[2]]
    assert read == sorted(written)
    assert [a.data for a in reader.iter_attachments()] == [c[4] for c in calls if c[0] == "attachment"]


@pytest.mark.parametrize("chunk_bytes", [1000, 256 * 1024])
def test_rows_and_events_across_chunk_borders(chunk_bytes: int) -> None:
    calls: list[tuple[Any, ...]] = [*_PRELUDE, ("messages", 1, []), ("metadata", "servod", {"a": "1"}), ("flush",)]
    for batch in range(100):
        calls.append(("messages", 1, [(batch * 20 + n, bytes([batch, n]) * 160) for n in range(20)]))
        calls.append(("messages", 2, [(batch * 20, b"event")]))
    calls += [("attachment", 5, "gains.yaml", "application/yaml", b"law: pd"), ("flush",), ("flush",)]
    assert _by_ours(calls, chunk_bytes) == _by_the_library(calls, chunk_bytes)


def test_a_file_without_messages_is_that_of_the_library() -> None:
    for calls in ([], [("flush",)], list(_PRELUDE)):
        assert _by_ours(calls, 10) == _by_the_library(calls, 10)


def test_memory_does_not_grow_with_the_chunks(tmp_path: Path) -> None:
    with tempfile.TemporaryFile(dir=tmp_path) as spool, (tmp_path / "a.mcap").open("xb") as stream:
        writer = ChunkedWriter(stream, spool, 1000)
        writer.start("ros2", "servod")
        channel = writer.add_channel("/one", "json", writer.add_schema("a", "jsonschema", b"{}"))
        chunks = 5000

        def write(first: int) -> None:
            for n in range(first, first + chunks):
                writer.add_messages(channel, [(10**18 + n, b"message")])
                writer.flush()

        tracemalloc.start()
        try:
            write(0)
            before, _ = tracemalloc.get_traced_memory()
            write(chunks)
            after, _ = tracemalloc.get_traced_memory()
            tracemalloc.reset_peak()
            writer.finish()
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert after - before < chunks  # less than a byte for each chunk; the library takes 600
        assert peak - after < spool.tell() / 2  # nor are they read at one time for the summary
        assert spool.tell() > 80 * 2 * chunks
    with (tmp_path / "a.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) == 2 * chunks


def test_all_that_was_synced_is_in_the_file_while_it_is_written(tmp_path: Path) -> None:
    file = McapFile(tmp_path / "a.mcap", {"config.yaml": b"name: x\n"}, 0)
    for batch in range(40):
        file.write_rows([(batch * 50 + n).to_bytes(8, "little") + bytes(RECORD.size - 8) for n in range(50)])
        file.write_event({"time_ns": batch * 50, "kind": "fault", "text": "x"})
        file.sync()
        if batch % 13 == 0:
            recording = read_recording(tmp_path / "a.mcap")
            assert list(recording.column("time_ns")) == list(range((batch + 1) * 50))
            assert (len(recording.events), recording.truncated) == (batch + 1, True)
    file.close()
    assert file.records == 2000


def test_a_damaged_piece_costs_itself_alone(tmp_path: Path) -> None:
    path, bent = tmp_path / "a.mcap", tmp_path / "bent.mcap"
    file = McapFile(path, {}, 1)
    for part in range(4):
        file.write_rows([(part * 50 + k).to_bytes(8, "little") + bytes(RECORD.size - 8) for k in range(50)])
        file.sync()
    file.close()
    raw, at, seen = path.read_bytes(), len(MAGIC), []
    while raw[at] != Opcode.DATA_END:
        length = int.from_bytes(raw[at + 1 : at + 9], "little")
        if raw[at] == Opcode.CHUNK and at > 2000:  # behind the first, which says what a cycle has
            data = bytearray(raw)
            data[at + length // 2] ^= 0x10
            bent.write_bytes(data)
            found = read_recording(bent)
            seen.append(sorted(set(range(200)) - set(found.column("time_ns"))))
            assert "150 cycles" in found.damage and "left out: 1 of its pieces" in found.damage and found.truncated
        at += 9 + length
    assert seen == [list(range(50 * part, 50 * part + 50)) for part in range(1, 4)]


def test_no_record_is_lost_in_silence(tmp_path: Path) -> None:
    """A bent kind makes a reader pass a record over, a chunk of cycles too: checksum and index both tell of it.

    Files of earlier versions have no checksum over all; there the index alone tells.
    """
    path, bent = tmp_path / "a.mcap", tmp_path / "bent.mcap"
    file = McapFile(path, {"gains.yaml": b"name: x\n"}, 1)
    for part in range(3):
        file.write_rows([(part * 20 + k).to_bytes(8, "little") + bytes(RECORD.size - 8) for k in range(20)])
        file.write_event({"time_ns": part, "kind": "fault", "text": "x"})
        file.sync()
    file.close()
    raw, at, lost = path.read_bytes(), len(MAGIC), []
    whole = read_recording(path)
    assert (whole.damage, whole.sha256) == ("", hashlib.sha256(raw).hexdigest())
    while at < len(raw) - len(MAGIC):
        length = int.from_bytes(raw[at + 1 : at + 9], "little")
        for crc in (True, False) if raw[at] != Opcode.DATA_END else ():
            data = bytearray(raw)
            data[at] ^= 0x80
            if not crc:
                end = raw.rindex(bytes([Opcode.DATA_END, 4, *bytes(7)]))
                data[end + 9 : end + 13] = bytes(4)
            bent.write_bytes(data)
            found = read_recording(bent) if raw[at] != Opcode.CHUNK or at > 500 else None
            if found is not None and not found.damage and found.rows != whole.rows:
                lost.append((at, raw[at], crc))
            if found is not None and raw[at] == Opcode.CHUNK:
                assert not crc or "damaged" in found.damage
                assert crc or f"{len(found)} of 60 cycles" in found.damage
        at += 9 + length
    assert lost == []
