"""Reads CSV, plain or packed with gzip, into arrow columns; counts rows and bytes while they are unpacked.

Beside `readers`. The text is never whole in memory: Arrow takes it block by block from a stream that counts.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Container
from pathlib import Path
from typing import Any, BinaryIO, cast

from servod.common.errors import BadInput
from servod.common.files import open_file, require_size
from servod.lab.recordings.bounds import MOST_BYTES, require_bytes, require_cells

#: Longest header line that is looked at to find names and separator.
_HEADER_BYTES = 65536
#: Most that is unpacked at once.
_PIECE_BYTES = 1024 * 1024


def read_csv(path: Path, wanted: Container[str]) -> dict[str, Any]:
    """Chunked arrow columns by name, None for those that are not `wanted`. Raises BadInput; OSError as the file does.

    Every cell counts: while Arrow does not know a column's type yet, it keeps the text of all of them.
    """
    with open_file(path) as packed:
        require_size(path, packed, MOST_BYTES)
        stream = cast(BinaryIO, gzip.GzipFile(fileobj=packed)) if path.name.lower().endswith(".gz") else packed
        text = _Counted(path, stream)
        header = text.header()
        separator = max(",;\t", key=header.count)
        names = [name.strip().strip('"') for name in header.rstrip("\r\n").split(separator)]
        refuse_repeated(names, path)
        text.begin_rows(len(names))
        used = [name for name in names if name in wanted]
        table = _table(path, text, names, used, separator) if used else {}
    return {name: table[name] if name in used else None for name in names}


def refuse_repeated(names: list[str], path: Path) -> None:
    """Raises BadInput naming the first column that stands twice."""
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise BadInput(f"{path}: column {repeated[0]}", "the same name twice", "one column of each name")


def first_line(error: Exception) -> str:
    """What Arrow says, without where in its sources it says it."""
    return (str(error).splitlines() or ["a broken file"])[0]


def _table(path: Path, text: _Counted, names: list[str], used: list[str], separator: str) -> Any:
    import pyarrow as pa
    import pyarrow.csv as pc

    try:
        return pc.read_csv(
            pa.PythonFile(text, mode="r"),
            # In this thread alone: one that reads ahead goes on in a file that an error has closed, and hangs.
            read_options=pc.ReadOptions(column_names=names, use_threads=False),
            parse_options=pc.ParseOptions(delimiter=separator),
            convert_options=pc.ConvertOptions(include_columns=used),
            memory_pool=pa.system_memory_pool(),  # gives back what is free; Arrow's own keeps a third more
        )
    except pa.ArrowException as error:
        raise BadInput(str(path), first_line(error), "rows with as many cells as the header") from None


class _Counted:
    """A stream that ends with BadInput when more comes out of it than a recording may hold."""

    closed = False  # Arrow asks; the file is closed by who opened it

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self._path, self._stream = path, stream
        self._bytes = self._lines = self._columns = 0

    def header(self) -> str:
        """The first line. Raises BadInput where there is none, or one that is no text."""
        try:
            text = self._guarded(self._stream.readline, _HEADER_BYTES).decode("utf-8-sig")
        except UnicodeDecodeError:
            raise BadInput(str(self._path), "bytes that are not UTF-8", "a text file with a header line") from None
        if not text.strip():
            raise BadInput(str(self._path), "an empty file", "a header line with column names")
        return text

    def begin_rows(self, columns: int) -> None:
        """From now on rows of so many columns come."""
        self._columns = columns
        require_cells(self._path, 0, columns)

    def read(self, count: int) -> bytes:
        """At most `count` bytes of rows; Arrow asks for more until it has as many as it wants."""
        data = self._guarded(self._stream.read, min(count, _PIECE_BYTES))
        self._bytes += len(data)
        self._lines += data.count(b"\n") + data.count(b"\r") - data.count(b"\r\n")
        require_bytes(self._path, self._bytes)
        require_cells(self._path, self._lines, self._columns)
        return data

    def _guarded(self, read: Any, count: int) -> bytes:
        try:
            return cast(bytes, read(count))
        except (gzip.BadGzipFile, EOFError, zlib.error) as error:
            raise BadInput(str(self._path), str(error), "a gzip file that is whole") from None
