"""Reads a foreign file into named columns of numbers: one module of `kinds` for each kind of file, by its suffix.

The first step behind the file; `columns` names, `recording` checks and repairs. Whatever stands in a file, reading it
takes bounded memory: `bounds` says how much a recording may hold, every kind counts before or while it unpacks, and
keeps the columns that are wanted.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from pathlib import Path
from typing import Any

from servod.common.errors import BadInput
from servod.common.files import open_file, unreadable
from servod.lab.recordings.bounds import FileBounds
from servod.lab.recordings.kinds import json_rows, mat, mcap, numpy_arrays, parquet, text
from servod.lab.recordings.numbers import numbers, widened

__all__ = ["MOST_BYTES", "MOST_CELLS", "READERS", "numbers", "read_columns", "widened"]

#: Most numbers in the columns that are used: 20 million rows of three columns, five and a half hours at 1 kHz.
MOST_CELLS = 60_000_000
#: Most bytes of a file, packed and unpacked; an own recording and Parquet count their numbers alone.
MOST_BYTES = 1024**3
#: Most columns of a file, used or not.
MOST_COLUMNS = 4096

#: Columns of the file at a path, those that are wanted with their content; what is to be told of it goes to the list.
Reader = Callable[[Path, Container[str], FileBounds, list[str]], dict[str, Any]]

#: Reader for each suffix.
READERS: dict[str, Reader] = {
    ".csv": text.read,
    ".csv.gz": text.read,
    ".tsv": text.read,
    ".txt": text.read,
    ".txt.gz": text.read,
    ".parquet": parquet.read,
    ".mat": mat.read,
    ".npy": numpy_arrays.read_npy,
    ".npz": numpy_arrays.read_npz,
    ".json": json_rows.read,
    ".jsonl": json_rows.read,
    ".ndjson": json_rows.read,
    ".json.gz": json_rows.read,
    ".jsonl.gz": json_rows.read,
    ".mcap": mcap.read,
}


def read_columns(path: Path, wanted: Container[str]) -> tuple[dict[str, Any], list[str]]:
    """Columns of the file by name, and what is to be told of the file in plain sentences.

    A column is a float array (a matrix, or without dimensions where one number holds for all rows), an arrow array of
    numbers, lists or text, an arrow type in which no number stands, or None where it is not `wanted`; `numbers` turns
    one into floats. Raises BadInput for a missing, empty, broken, unknown or too large file.
    """
    try:
        open_file(path).close()
    except (OSError, ValueError) as error:
        raise unreadable(path, error) from None
    name = path.name.lower()
    reader = next((reader for suffix, reader in READERS.items() if name.endswith(suffix)), None)
    if reader is None:
        raise BadInput(str(path), f"suffix {path.suffix!r}", "a recording: " + ", ".join(READERS))
    notes: list[str] = []
    try:
        columns = reader(path, wanted, FileBounds(path, MOST_CELLS, MOST_COLUMNS, MOST_BYTES), notes)
    except OSError as error:
        raise unreadable(path, error) from None
    if not columns:
        raise BadInput(str(path), "no columns", "a recording with named columns")
    return columns, notes
