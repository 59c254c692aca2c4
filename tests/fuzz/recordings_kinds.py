"""Targets that are recordings of other makers: text without a header, numpy's arrays, JSON, bags of ROS 2.

Each is read with a map that takes columns by number, by element and by path, so that inputs go deeper than names.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from servod.lab.recordings import load_recording
from tests.fuzz.shapes import csv_texts, mutated, odd_values
from tests.fuzz.target import Target
from tests.lab.recordings.test_kinds import write_bag

_ROWS = 12
_TABLE = np.column_stack([np.arange(_ROWS) * 1e-3, np.sin(np.arange(_ROWS)), np.cos(np.arange(_ROWS))])
_BY_NUMBER = "columns: {t_s: 0, torque_nm: 'data[:,1]', position_rad: {from: 2, unit: counts, counts_per_turn: 7}}"


def _reads(folder: Path, name: str, mapped: str) -> Callable[[bytes], None]:
    folder.mkdir(exist_ok=True)
    (folder / "map.yaml").write_text(mapped)

    def run(data: bytes) -> None:
        (folder / name).write_bytes(data)
        recording = load_recording(folder / name, folder / "map.yaml")
        assert np.isfinite(recording.t_s).all() and np.isfinite(recording.position).all()

    return run


def txt(folder: Path) -> Target:
    """Tables between blanks, semicolons and tabs, without a header."""
    plain = "\n".join(" ".join(map(repr, row)) for row in _TABLE.tolist())
    seeds = (
        plain.encode(),
        plain.replace(".", ",").replace(" ", ";").encode(),
        plain.replace(" ", "\t").encode("utf-16"),
    )
    words = (
        b"sep=;\n",
        b"# a b c\n",
        b"s;A;rad\n",
        b"1.234,5",
        b"\xff\xfe",
        b"\xb0",
        b'"',
        b"\t",
        b"  ",
        b"[1, 2]",
        b";;\r\n",
    )
    shape = st.one_of(mutated(seeds, words), csv_texts(("t_s", "torque_nm", "position_rad")))
    return Target(_reads(folder / "txt", "run.txt", _BY_NUMBER), seeds, shape, words)


def _npy(values: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, values)
    return stream.getvalue()


def npy(folder: Path) -> Target:
    """An array: its header, and what it claims."""
    fields = np.rec.fromarrays(_TABLE.T, names="t_s,torque_nm,position_rad")
    seeds = (_npy(_TABLE), _npy(np.asfortranarray(_TABLE.astype(np.float32))), _npy(fields))
    words = (b"'shape': (99999999999, 3)", b"'descr': '|O'", b"'descr': '<f8'", b"True", b"(", b"}", b"\x02\x00", b"-1")
    reads = _reads(folder / "npy", "run.npy", _BY_NUMBER)
    return Target(reads, seeds[:2], mutated(seeds, words), words, longest=8192)


def npz(folder: Path) -> Target:
    """Arrays in an archive, packed and not."""
    streams = io.BytesIO(), io.BytesIO()
    np.savez(streams[0], data=_TABLE, more=_TABLE[:, 0])
    np.savez_compressed(streams[1], data=np.zeros((_ROWS, 3)) + _TABLE)
    seeds = tuple(stream.getvalue() for stream in streams)
    words = (b"PK\5\6", b"PK\1\2", b"PK\3\4", b"\x93NUMPY", b"\xff\xff\xff\xff")
    reads = _reads(folder / "npz", "run.npz", _BY_NUMBER.replace("0", "'data[:,0]'", 1).replace(" 2,", " 'data[:,2]',"))
    return Target(reads, seeds, mutated(seeds, words), words, longest=8192)


def json_rows(folder: Path) -> Target:
    """Records, and lines of them; odd values in them."""
    records = [{"t": t, "m": {"u": u, "x": [x, x]}} for t, u, x in _TABLE.tolist()]
    seeds = (json.dumps(records).encode(), "\n".join(map(json.dumps, records)).encode())
    words = (
        b"[" * 400,
        b'{"a":' * 400,
        b"NaN",
        b"1e999",
        b"9" * 400,
        b'"\\ud800"',
        b"null",
        b"[[1],[2,3]]",
        b"{}",
        b"\n",
    )
    rows = st.lists(st.dictionaries(st.sampled_from(("t", "m", "x")), odd_values, max_size=3), max_size=20)
    odd = rows.map(lambda drawn: json.dumps([*records, *drawn], default=str).encode("utf-8", "surrogatepass"))
    reads = _reads(folder / "json", "run.json", "columns: {t_s: t, torque_nm: m.u, position_rad: 'm.x[:,1]'}")
    return Target(reads, seeds, st.one_of(mutated(seeds, words), odd), words)


def ros2(folder: Path) -> Target:
    """A bag with joint states, whole, cut and bent."""
    write_bag(folder / "seed.mcap", stop=_ROWS)
    seeds = ((folder / "seed.mcap").read_bytes(),)
    words = (b"\xff\xff\xff\x7f", b"elbow", b"float64[] position\n", b"cdr", b"\x00\x01\x00\x00", b"\x89MCAP0\r\n")
    reads = _reads(folder / "ros2", "run.mcap", "columns: {torque_nm: elbow.effort, position_rad: elbow.position}")
    return Target(reads, seeds, mutated(seeds, words), words, longest=20_000)
