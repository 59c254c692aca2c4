"""Reads a foreign file into named columns of numbers: CSV, CSV.gz, Parquet, MAT v5, and the daemon's MCAP.

The first step behind the file; `columns` names, `recording` checks and repairs. One reader for each format, chosen by
the file's suffix from one table. Whatever stands in a file, reading it takes bounded memory.
"""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.errors import BadInput
from servod.files import open_file, require_size
from servod.recordings.mat import BrokenMatError, vectors

Array = NDArray[np.float64]
#: Columns of the file at a path; what is to be told of it goes to the list.
Reader = Callable[[Path, list[str]], dict[str, Any]]

#: Longest header line of a CSV that is looked at to find its separator.
_HEADER_BYTES = 65536
#: Largest recording, packed and unpacked, and most numbers in it: a day of three columns at 1 kHz.
_MOST_BYTES = 1024**3
_MOST_CELLS = 260_000_000


def read_columns(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Columns of the file by name, and what is to be told of the file in plain sentences.

    A column is a float array, or an arrow array of text where it is not all numbers; `numbers` turns one into floats.
    Raises BadInput for a missing, empty, broken or unknown file.
    """
    if not path.is_file():
        raise BadInput(str(path), "no such file" if not path.exists() else "no file", "a recording")
    name = path.name.lower()
    reader = next((reader for suffix, reader in READERS.items() if name.endswith(suffix)), None)
    if reader is None:
        raise BadInput(str(path), f"suffix {path.suffix!r}", "a recording: " + ", ".join(READERS))
    notes: list[str] = []
    try:
        columns = reader(path, notes)
    except OSError as error:
        raise BadInput(str(path), error.strerror or str(error), "a readable recording") from None
    if not columns:
        raise BadInput(str(path), "no columns", "a recording with named columns")
    return columns, notes


def _bounded(path: Path) -> bytes:
    """The whole file, unpacked where it is packed. Raises BadInput when that is more than any recording."""
    with open_file(path) as packed:
        require_size(path, packed, _MOST_BYTES)
        stream = gzip.GzipFile(fileobj=packed) if path.name.lower().endswith(".gz") else packed
        try:
            content = stream.read(_MOST_BYTES + 1)
        except (gzip.BadGzipFile, EOFError, zlib.error) as error:
            raise BadInput(str(path), str(error), "a gzip file that is whole") from None
    if len(content) > _MOST_BYTES:
        raise BadInput(str(path), f"more than {_MOST_BYTES} bytes unpacked", "a smaller recording, or one in parts")
    return content


def numbers(column: Any, path: Path, name: str) -> Array:
    """A column as float64, NaN where a cell is empty. Raises BadInput naming the first cell that is no number."""
    if isinstance(column, np.ndarray):
        return column.astype(np.float64)
    import pyarrow as pa

    try:
        return _converted(column, path, name)
    except (pa.ArrowException, ValueError, OverflowError):
        raise BadInput(f"{path}: column {name}", f"values of type {column.type}", "numbers") from None


def _converted(column: Any, path: Path, name: str) -> Array:
    import pyarrow as pa

    if pa.types.is_boolean(column.type):
        column = column.cast(pa.int8())
    if pa.types.is_integer(column.type) or pa.types.is_floating(column.type) or pa.types.is_decimal(column.type):
        return np.asarray(column.cast(pa.float64()).to_numpy(zero_copy_only=False), dtype=np.float64)
    return _parsed(column.to_pylist(), path, name)


def _parsed(cells: Iterable[object], path: Path, name: str) -> Array:
    values = []
    for row, cell in enumerate(cells):
        text = "" if cell is None else str(cell).strip()
        try:
            values.append(float(text) if text else np.nan)
        except ValueError:
            raise BadInput(f"{path}: column {name}, row {row + 1}", repr(text)[:40], "a number") from None
    return np.array(values)


def _read_csv(path: Path, _notes: list[str]) -> dict[str, Any]:
    import pyarrow as pa
    import pyarrow.csv as pc

    content = _bounded(path)
    header = _header(content, path)
    separator = max(",;\t", key=header.count)
    names = [name.strip().strip('"') for name in header.rstrip("\r\n").split(separator)]
    _refuse_repeated(names, path)
    try:
        table = pc.read_csv(
            pa.BufferReader(content),
            read_options=pc.ReadOptions(column_names=names, skip_rows=1),
            parse_options=pc.ParseOptions(delimiter=separator),
        )
    except pa.ArrowException as error:
        raise BadInput(str(path), _first_line(error), "rows with as many cells as the header") from None
    return {name: table.column(name).combine_chunks() for name in names}


def _header(content: bytes, path: Path) -> str:
    line = io.BytesIO(content).readline(_HEADER_BYTES)
    try:
        text = line.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise BadInput(str(path), "bytes that are not UTF-8", "a text file with a header line") from None
    if not text.strip():
        raise BadInput(str(path), "an empty file", "a header line with column names")
    return text


def _refuse_repeated(names: list[str], path: Path) -> None:
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise BadInput(f"{path}: column {repeated[0]}", "the same name twice", "one column of each name")


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or ["a broken file"])[0]


def _read_parquet(path: Path, _notes: list[str]) -> dict[str, Any]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(pa.BufferReader(_bounded(path)))
        cells = file.metadata.num_rows * file.metadata.num_columns
        if cells > _MOST_CELLS:
            raise BadInput(str(path), f"{cells} numbers", f"at most {_MOST_CELLS}")
        table = file.read()
    except (pa.ArrowException, OSError, ValueError) as error:  # ValueError: a name that is no UTF-8
        raise BadInput(str(path), _first_line(error), "a Parquet file") from None
    _refuse_repeated(table.column_names, path)
    return {name: table.column(name).combine_chunks() for name in table.column_names}


def _read_mat(path: Path, _notes: list[str]) -> dict[str, Any]:
    try:
        return dict(vectors(_bounded(path)))
    except BrokenMatError as error:
        raise BadInput(str(path), str(error), "MAT v5: save('file.mat', '-v7')") from None


def _read_mcap(path: Path, notes: list[str]) -> dict[str, Any]:
    from servod.recorder_export import seconds
    from servod.recorder_read import read_recording

    recording = read_recording(path)
    if recording.damage:
        notes.append(recording.damage)
    columns: dict[str, Any] = {name: np.asarray(recording.column(name), dtype=np.float64) for name in recording.names}
    columns["t_s"] = np.asarray(seconds(recording))
    return columns


#: Reader for each suffix.
READERS: dict[str, Reader] = {
    ".csv": _read_csv,
    ".csv.gz": _read_csv,
    ".parquet": _read_parquet,
    ".mat": _read_mat,
    ".mcap": _read_mcap,
}
