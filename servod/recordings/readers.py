"""Reads a foreign file into named columns of numbers: CSV, CSV.gz, Parquet, MAT v5, and the daemon's MCAP.

The first step behind the file; `columns` names, `recording` checks and repairs. One reader for each format, chosen by
the file's suffix from one table.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servod.errors import BadInput

Array = NDArray[np.float64]
Reader = Callable[[Path], dict[str, Any]]

#: Longest header line of a CSV that is looked at to find its separator.
_HEADER_BYTES = 65536


def read_columns(path: Path) -> dict[str, Any]:
    """Columns of the file by name: float arrays, or arrow arrays of text where a column is not all numbers.

    `numbers` turns one into floats. Raises BadInput for a missing, empty, broken or unknown file.
    """
    if not path.is_file():
        raise BadInput(str(path), "no such file" if not path.exists() else "no file", "a recording")
    name = path.name.lower()
    reader = next((reader for suffix, reader in READERS.items() if name.endswith(suffix)), None)
    if reader is None:
        raise BadInput(str(path), f"suffix {path.suffix!r}", "a recording: " + ", ".join(READERS))
    try:
        columns = reader(path)
    except OSError as error:
        raise BadInput(str(path), error.strerror or str(error), "a readable recording") from None
    if not columns:
        raise BadInput(str(path), "no columns", "a recording with named columns")
    return columns


def numbers(column: Any, path: Path, name: str) -> Array:
    """A column as float64, NaN where a cell is empty. Raises BadInput naming the first cell that is no number."""
    if isinstance(column, np.ndarray):
        return column.astype(np.float64)
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


def _read_csv(path: Path) -> dict[str, Any]:
    import pyarrow as pa
    import pyarrow.csv as pc

    header = _header(path)
    separator = max(",;\t", key=header.count)
    names = [name.strip().strip('"') for name in header.rstrip("\r\n").split(separator)]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise BadInput(f"{path}: column {repeated[0]}", "the same name twice", "one column of each name")
    try:
        table = pc.read_csv(
            path,
            read_options=pc.ReadOptions(column_names=names, skip_rows=1),
            parse_options=pc.ParseOptions(delimiter=separator),
        )
    except (pa.ArrowInvalid, OSError) as error:
        raise BadInput(str(path), str(error).splitlines()[0], "rows with as many cells as the header") from None
    return {name: table.column(name).combine_chunks() for name in names}


def _header(path: Path) -> str:
    opener = gzip.open if path.name.lower().endswith(".gz") else open
    try:
        with opener(path, "rb") as stream:
            line = stream.readline(_HEADER_BYTES)
    except (gzip.BadGzipFile, EOFError) as error:
        raise BadInput(str(path), str(error), "a gzip file that is whole") from None
    try:
        text = line.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise BadInput(str(path), "bytes that are not UTF-8", "a text file with a header line") from None
    if not text.strip():
        raise BadInput(str(path), "an empty file", "a header line with column names")
    return text


def _read_parquet(path: Path) -> dict[str, Any]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path)
    except (pa.ArrowException, OSError) as error:
        raise BadInput(str(path), str(error).splitlines()[0], "a Parquet file") from None
    return {name: table.column(name).combine_chunks() for name in table.column_names}


def _read_mat(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        content = loadmat(path, simplify_cells=True)
    except NotImplementedError:
        raise BadInput(str(path), "a MAT file of version 7.3", "MAT v5: save('file.mat', '-v7')") from None
    except (MatReadError, ValueError, TypeError, EOFError) as error:
        raise BadInput(str(path), str(error).splitlines()[0] or "a broken file", "a MAT v5 file") from None
    return dict(_vectors(content, ""))


def _vectors(content: dict[str, Any], prefix: str) -> Iterable[tuple[str, Array]]:
    """Numeric vectors of a MAT file by name; members of a struct as `struct.member`."""
    for name, value in content.items():
        if name.startswith("__"):
            continue
        if isinstance(value, dict):
            yield from _vectors(value, f"{prefix}{name}.")
        elif (
            isinstance(value, np.ndarray)
            and value.size > 1
            and value.dtype.kind in "biuf"
            and value.size == max(value.shape)
        ):
            yield f"{prefix}{name}", value.ravel().astype(np.float64)


def _read_mcap(path: Path) -> dict[str, Any]:
    from servod.recorder_export import seconds
    from servod.recorder_read import read_recording

    recording = read_recording(path)
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
