"""Files that servod wrote itself and somebody cut, emptied or overwrote: refused as any other bad input."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from servod.common.errors import BadInput
from servod.formats.gains.store import GainStore
from servod.lab.commission.comparison import load_curves
from servod.lab.commission.state import STATE, State
from servod.lab.commission.state import read_walk_json as read_json
from servod.lab.identify.store import LIST, load
from servod.qualify.blind.conceal import FILE, read_trial


def _packed() -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **{"sines.time": np.zeros(3)})
    return stream.getvalue()


BAD = {
    "empty": b"",
    "cut": b'{"a": [1, 2',
    "deep": b"[" * 100_000,
    "no text": b"\xff\xfe\x00",
    "a list": b"[1]",
    "another document": b'{"a": 1}',
    "numbers beyond all": b'{"conditions": 1e999, "experiments": ' + b"9" * 5000 + b"}",
    "cut archive": _packed()[:-40],
    "bent archive": _packed()[:60] + b"\xff\xff\xff" + _packed()[63:],
}
READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "commission's state": (STATE, lambda folder: State(folder, {}, [])),
    "commission's curves": ("curves.npz", lambda folder: load_curves(folder / "curves.npz")),
    "identify's list": (LIST, load),
    "prove's trial": (FILE, read_trial),
    "the store's active set": ("active.json", lambda folder: GainStore(folder).active()),
}


@pytest.mark.parametrize("content", BAD.values(), ids=BAD)
@pytest.mark.parametrize(("name", "read"), READERS.values(), ids=READERS)
def test_a_broken_file_of_our_own_is_refused_in_one_line(
    name: str, read: Callable[[Path], object], content: bytes, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BadInput) as caught:
        read(tmp_path)
    line = str(caught.value)
    assert str(tmp_path / name) in line and line.isprintable() and "Error" not in line


def test_documents_of_a_walk_are_whole_json(tmp_path: Path) -> None:
    (tmp_path / "tracking.json").write_bytes(BAD["deep"])
    with pytest.raises(BadInput, match=r"tracking.json: found brackets nested without end"):
        read_json(tmp_path / "tracking.json")
