"""Targets that are recordings: each format through the one reader that replay, identification and diagnosis use."""

from __future__ import annotations

import gzip
import io
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from servod.formats.recording.mcap_reader import read_recording
from servod.formats.recording.mcap_writer import McapFile
from servod.formats.recording.record import FIELDS, RECORD
from servod.lab.recordings import load_recording
from tests.fuzz.recordings_bombs import csv_bomb, mat_bomb
from tests.fuzz.shapes import ODD_NUMBERS, csv_texts, mutated
from tests.fuzz.target import Target

NAMES = ("t_s", "torque_nm", "position_rad", "temperature_c", "reference_rad")
_ROWS = 12


def _columns() -> dict[str, Any]:
    time_s = np.arange(_ROWS) * 1e-3
    return {"t_s": time_s, "torque_nm": np.sin(time_s), "position_rad": np.cos(time_s)}


def _read(path: Path, data: bytes) -> None:
    """What every command does first with a recording."""
    path.write_bytes(data)
    recording = load_recording(path)
    assert np.isfinite(recording.t_s).all()
    assert np.isfinite(recording.position).all()
    assert np.isfinite(recording.drive.torque).all()


def csv(folder: Path) -> Target:
    """CSV as spreadsheets and drives write it."""
    seed = b"t_s,torque_nm,position_rad\n" + b"".join(b"%.3f,0.1,0.2\n" % (k * 1e-3) for k in range(_ROWS))
    words = (b"nan", b"inf", b"1e308", b'"', b";", b"\t", b"\r\n", b"\0", b"\xef\xbb\xbf", b"NULL", b"2026-01-01")
    return Target(lambda data: _read(folder / "run.csv", data), (seed,), csv_texts(NAMES), words)


def csv_gz(folder: Path) -> Target:
    """The same, packed: broken gzip, and text that grows a thousandfold."""
    seed = gzip.compress(csv(folder).seeds[0], mtime=0)
    bomb = gzip.compress(b"t_s,torque_nm,position_rad\n" + b"0,0,0\n" * 3_000_000, mtime=0)
    shape = st.one_of(
        mutated((seed,)),
        csv_texts(NAMES).map(lambda text: gzip.compress(text, mtime=0)),
        st.just(bomb),
        st.just(csv_bomb()),
    )
    return Target(lambda data: _read(folder / "run.csv.gz", data), (seed,), shape, (b"\x1f\x8b\x08",))


def parquet(folder: Path) -> Target:
    """Parquet with the types that its columns may have."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    def packed(columns: dict[str, Any]) -> bytes:
        stream = io.BytesIO()
        pq.write_table(pa.table(columns), stream)
        return stream.getvalue()

    seed = packed(_columns())
    odd = st.sampled_from(_odd_arrays(pa))
    tables = st.dictionaries(st.sampled_from((*NAMES, "")), odd, min_size=1).map(lambda odd: packed(_columns() | odd))
    shape = st.one_of(mutated((seed,)), tables)
    return Target(lambda data: _read(folder / "run.parquet", data), (seed,), shape, (b"PAR1",), longest=8192)


def _odd_arrays(pa: Any) -> list[Any]:
    """Columns of every sort, as long as the good ones."""
    n = _ROWS
    return [
        pa.array(["1", "x"] * (n // 2)),
        pa.array([None] * n),
        pa.array([None] * n, pa.float64()),
        pa.array([True, False] * (n // 2)),
        pa.array([[1.0]] * n),
        pa.array([{"a": 1}] * n),
        pa.array([b"\xff"] * n),
        pa.array(range(n), pa.timestamp("ns")),
        pa.array([2**62] * n, pa.timestamp("ns")),
        pa.array(range(n), pa.time64("ns")),
        pa.array([2**62] * n, pa.duration("ns")),
        pa.array(["a", "b"] * (n // 2)).dictionary_encode(),
        pa.array([1.0, 2.0] * (n // 2)).dictionary_encode(),
        pa.array([2**63 - 1] * n),
        pa.array([1e308, -1e308] * (n // 2)),
        pa.array([float("nan"), float("inf")] * (n // 2)),
        pa.array(range(n), pa.decimal128(30, 3)),
        pa.array(np.arange(n, dtype=np.float16)),
    ]


def mat(folder: Path) -> Target:
    """MAT v5 with matrices, structs, cells and broken headers."""
    from scipy.io import savemat

    def packed(content: dict[str, Any], pack: bool) -> bytes:
        stream = io.BytesIO()
        savemat(stream, content, do_compression=pack)
        return stream.getvalue()

    seeds = tuple(packed(_columns(), pack) for pack in (False, True))
    odd: tuple[Any, ...] = (
        *(np.zeros((3, 4)), np.zeros(0), np.zeros((_ROWS, 1)), np.zeros((1, _ROWS)) + 1j, "text", ["a", "b"], 5, True),
        *(
            {"inner": np.arange(_ROWS)},
            np.array([1, "x", [2.0]], dtype=object),
            np.full(_ROWS, np.nan),
            np.arange(_ROWS),
        ),
        *(np.full(_ROWS, n) for n in (1e308, -1e308, 2**63 - 1, 0.0, np.nan)),
    )
    contents = st.dictionaries(st.sampled_from((*NAMES, "x")), st.sampled_from(odd)).map(lambda o: _columns() | o)
    shape = st.one_of(mutated(seeds), st.builds(packed, contents, st.booleans()), st.just(mat_bomb()))
    return Target(lambda data: _read(folder / "run.mat", data), seeds, shape, (b"MATLAB 5.0",), longest=8192)


def mcap(folder: Path) -> Target:
    """The daemon's own recordings, whole, cut, bent, and of other makers."""
    seeds = (recorded(folder / "seed.mcap"),)
    made = 0

    def run(data: bytes) -> None:
        path = folder / "run.mcap"
        path.write_bytes(data)
        read_recording(path)
        _read(path, data)

    assert made == 0
    words = (b"\x89MCAP0\r\n", b"zstd", b"lz4", b"ros2msg", b"/servod/cycle", b"float64 a  # [s]\n", b"int64 b  # []\n")
    shape = st.one_of(mutated(seeds, words), _records(seeds[0]))
    return Target(run, seeds, shape, words, longest=20_000)


def recorded(path: Path) -> bytes:
    """A short recording, with chunks that are not packed, so that changes reach what is in them."""
    path.unlink(missing_ok=True)
    file = McapFile(path, {"config.yaml": b"name: x\n"}, 0)
    row = RECORD.pack(*(0 if f.kind == "q" else 0.0 for f in FIELDS))
    file.write_rows((k * 1_000_000).to_bytes(8, "little") + row[8:] for k in range(_ROWS))
    file.write_event({"time_ns": 1, "kind": "fault", "text": "x"})
    file.close()
    return path.read_bytes()


@st.composite
def _records(draw: st.DrawFn, seed: bytes) -> bytes:
    """A file of its records, each with its length, some of them made up or bent inside."""
    magic, at, records = seed[:8], 8, []
    while at + 9 <= len(seed) - 8:
        length = int.from_bytes(seed[at + 1 : at + 9], "little")
        records.append((seed[at], seed[at + 9 : at + 9 + length]))
        at += 9 + length
    places = st.integers(0, len(records) - 1)
    for where in draw(st.lists(places, min_size=1, max_size=4, unique=True)):  # a chunk that is bent unpacks no more
        opcode, content = records[where]
        if opcode == 6 and draw(st.booleans()):
            content = _bent_chunk(draw, content)
        else:
            content = draw(mutated([content or b"\0"]))
        records[where] = (draw(st.sampled_from((opcode, opcode, opcode, 3, 4, 5, 6, 8, 9, 15, 0x80))), content)
    body = b"".join(bytes((opcode,)) + len(c).to_bytes(8, "little") + c for opcode, c in records)
    return magic + body + magic


def _bent_chunk(draw: st.DrawFn, content: bytes) -> bytes:
    """A chunk, unpacked, with records in it that are bent, or one that claims to be huge; its checksum fits."""
    import zstandard

    head, name_length = content[:28], int.from_bytes(content[28:32], "little")
    packed = content[32 + name_length + 8 :]
    inside = zstandard.ZstdDecompressor().decompress(packed, 1 << 20)
    words = (
        b"float64",
        b"int64",
        *(int(n).to_bytes(8, "little", signed=True) for n in ODD_NUMBERS[:18] if abs(n) < 2**63),
    )
    inside = draw(mutated([inside], words))
    size = draw(st.sampled_from((len(inside), len(inside), 0, 2**31, 2**62)))
    head = (
        head[:16]
        + size.to_bytes(8, "little")
        + (zlib.crc32(inside) if draw(st.booleans()) else 0).to_bytes(4, "little")
    )
    return head + (0).to_bytes(4, "little") + len(inside).to_bytes(8, "little") + inside
