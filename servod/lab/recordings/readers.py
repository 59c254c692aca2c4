"""Reads a foreign file into named columns of numbers: CSV, CSV.gz, Parquet, MAT v5, and the daemon's MCAP.

The first step behind the file; `columns` names, `recording` checks and repairs. One reader for each format, chosen by
the file's suffix from one table. Whatever stands in a file, reading it takes bounded memory: `bounds` says how much a
recording may hold, every reader counts before or while it unpacks, and keeps the columns that are wanted.
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import BadInput
from servod.common.files import open_file, require_size, unreadable

# --- How much may be read --------------------------------------------------------------------------------------------
# How much a recording may hold: one limit for every format, so that reading takes at most 3 GiB of memory. Beneath the
# readers, which count while they unpack: a few kilobytes can unpack to any amount. A number takes eight bytes in the
# reader's table, eight in the recording, and for a moment some more while its column is scaled and checked.


#: Most numbers in the columns that are used: 20 million rows of three columns, five and a half hours at 1 kHz.
MOST_CELLS = 60_000_000
#: Most bytes of text or of a MAT file, packed and unpacked.
MOST_BYTES = 1024**3
#: Most columns of a file, used or not.
MOST_COLUMNS = 4096

_REMEDY = "a shorter stretch, or fewer columns, in a file of its own"


def require_cells(path: Path, rows: int, columns: int) -> None:
    """Refuse a table of more numbers than a recording may hold. Raises BadInput."""
    if columns > MOST_COLUMNS:
        raise BadInput(str(path), f"{columns} columns", f"at most {MOST_COLUMNS}")
    if rows * columns > MOST_CELLS:
        found = f"{rows} rows or more of {columns} columns"
        raise BadInput(str(path), found, f"at most {MOST_CELLS} numbers: {_REMEDY}")


def require_bytes(path: Path, unpacked: int) -> None:
    """Refuse a file that unpacks to more than a recording may. Raises BadInput."""
    if unpacked > MOST_BYTES:
        raise BadInput(str(path), f"{unpacked} bytes or more unpacked", f"at most {MOST_BYTES} bytes: {_REMEDY}")


# --- MAT files -------------------------------------------------------------------------------------------------------
# Reads the numeric vectors of a MAT file of version 5: MathWorks' "MAT-File Format", Level 5. scipy has a reader for
# all that MATLAB can store, but it is compiled without bounds: a file with a bent length ends the process. This one
# reads arrays of numbers and structs of them, and checks every length.


_MAT_HEADER_BYTES = 128
#: A packed element is handed to zlib in pieces of so many bytes, and a piece unpacks in steps of so many.
_PACKED_BYTES, _STEP_BYTES = 65_536, 1024 * 1024
#: Structs within structs that are followed.
_DEEPEST = 8
#: Longest list of dimensions, and longest name, that is looked at; MATLAB's names have 63 letters at most.
_MOST_DIMENSIONS, _LONGEST_NAME = 32, 256
#: Numeric storage types (table 1-1) as numpy knows them.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_COMPLEX, _FLAG_BYTES = 0x0800, 8


class _Type(IntEnum):
    """Element types that are no plain numbers."""

    INT8 = 1
    INT32 = 5
    MATRIX = 14
    COMPRESSED = 15


class _Class(IntEnum):
    """Array classes (table 1-3); the numeric ones are 6 to 15."""

    STRUCT = 2
    FIRST_NUMERIC = 6
    LAST_NUMERIC = 15


class _Element(NamedTuple):
    """One data element: its type and its data."""

    type: int
    data: memoryview


class BrokenMatError(ValueError):
    """The file is no MAT file of version 5, or is cut or bent; the message says where."""


@dataclass
class _File:
    """What holds for the whole file: byte order, and how much was unpacked and kept."""

    path: Path
    order: str
    unpacked_bytes: int = 0
    cells: int = 0
    vectors: int = 0

    def elements(self, data: memoryview) -> Iterator[_Element]:
        """The elements that stand in `data` one behind the other, each filled up to eight bytes but packed ones."""
        at = 0
        while at + 8 <= len(data):
            kind, size = struct.unpack_from(f"{self.order}II", data, at)
            if kind >> 16:  # small element: type and length share four bytes, the data follows in the next four
                kind, size, start, end = kind & 0xFFFF, kind >> 16, at + 4, at + 8
            else:
                start = at + 8
                end = start + size + (0 if kind == _Type.COMPRESSED else -size % 8)
            if start + size > min(end, len(data)):
                raise BrokenMatError(f"an element of {size} bytes where {max(len(data) - start, 0)} are left")
            yield _Element(kind, data[start : start + size])
            at = end

    def unpack(self, data: memoryview) -> memoryview:
        """A packed element's content. Raises BadInput when the file unpacks to too much."""
        unpacker, content = zlib.decompressobj(), bytearray()
        try:
            for start in range(0, len(data), _PACKED_BYTES):
                piece: bytes | memoryview = data[start : start + _PACKED_BYTES]
                while step := unpacker.decompress(piece, _STEP_BYTES):
                    piece = unpacker.unconsumed_tail
                    content += step
                    self.unpacked_bytes += len(step)
                    require_bytes(self.path, self.unpacked_bytes)
        except zlib.error as error:
            raise BrokenMatError(f"a packed element that cannot be unpacked ({error})") from None
        return memoryview(content)

    def count(self, cells: int) -> None:
        """One more vector. Raises BadInput when they are too many numbers for a recording."""
        self.cells, self.vectors = self.cells + cells, self.vectors + 1
        require_cells(self.path, -(-self.cells // self.vectors), self.vectors)


def vectors(content: bytes, path: Path) -> dict[str, Array]:
    """Numeric vectors of more than one value by name, members of a struct as `struct.member`; others are left out.

    Raises BrokenMatError, and BadInput naming `path` when there are more than a recording may hold.
    """
    if len(content) < _MAT_HEADER_BYTES or not content.startswith(b"MATLAB"):
        raise BrokenMatError("no header of a MAT file")
    mark = content[126:128]
    if mark not in (b"IM", b"MI"):
        raise BrokenMatError("a header without mark of the byte order")
    file = _File(path, "<" if mark == b"IM" else ">")
    if struct.unpack_from(f"{file.order}H", content, 124)[0] >> 8 == 2:
        raise BrokenMatError("version 7.3")
    found: dict[str, Array] = {}
    for element in file.elements(memoryview(content)[_MAT_HEADER_BYTES:]):
        for inner in file.elements(file.unpack(element.data)) if element.type == _Type.COMPRESSED else [element]:
            if inner.type == _Type.MATRIX:
                found.update(_matrix(file, inner.data, "", _DEEPEST))
    return found


def _matrix(file: _File, data: memoryview, name: str, depth: int) -> Iterator[tuple[str, Array]]:
    """The vectors of one array; `name` is the array's where it stands in a struct, which names it."""
    parts = file.elements(data)
    flags, dimensions, label = _next(parts), _next(parts), _next(parts)
    if len(flags.data) != _FLAG_BYTES or dimensions.type != _Type.INT32 or label.type != _Type.INT8:
        raise BrokenMatError("an array without flags, dimensions and name")
    word = struct.unpack_from(f"{file.order}I", flags.data)[0]
    name = name or _text(label.data)
    shape = _stored(file, dimensions)[:_MOST_DIMENSIONS].tolist()
    kind = word & 0xFF
    if kind == _Class.STRUCT and math.prod(shape) == 1 and depth:
        yield from _struct(file, parts, name, depth - 1)
    elif _Class.FIRST_NUMERIC <= kind <= _Class.LAST_NUMERIC and not word & _COMPLEX:
        values = _stored(file, _next(parts))
        if 1 < len(values) == max(shape, default=0) == math.prod(shape):
            file.count(len(values))
            yield name, values.astype(np.float64)


def _struct(file: _File, parts: Iterator[_Element], name: str, depth: int) -> Iterator[tuple[str, Array]]:
    """The vectors of a struct's members; the name of each has a fixed length, filled up with zeros."""
    length, names = _next(parts), _next(parts)
    size = int(_stored(file, length)[0]) if len(length.data) else 0
    if length.type != _Type.INT32 or size < 1:
        raise BrokenMatError("a struct without names of its members")
    for start, member in zip(range(0, len(names.data), size), parts, strict=False):
        if member.type == _Type.MATRIX and len(member.data):
            inner = f"{name}.{_text(names.data[start : start + size])}"
            yield from _matrix(file, member.data, inner, depth)


def _next(parts: Iterator[_Element]) -> _Element:
    element = next(parts, None)
    if element is None:
        raise BrokenMatError("an array that ends early")
    return element


def _stored(file: _File, element: _Element) -> NDArray[Any]:
    """An element's numbers as they are stored, in place; MATLAB takes the smallest type that holds them."""
    kind = _TYPES.get(element.type)
    if kind is None or len(element.data) % int(kind[1]):
        raise BrokenMatError(f"an element of type {element.type} with {len(element.data)} bytes where numbers stand")
    return np.frombuffer(element.data, dtype=file.order + kind)


def _text(data: memoryview) -> str:
    return bytes(data[:_LONGEST_NAME]).partition(b"\0")[0].decode("latin-1")


# --- CSV files -------------------------------------------------------------------------------------------------------
# Reads CSV, plain or packed with gzip, into arrow columns; counts rows and bytes while they are unpacked. The text is
# never whole in memory: Arrow takes it block by block from a stream that counts.


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


Array = NDArray[np.float64]
#: Columns of the file at a path, those that are wanted with their content; what is to be told of it goes to the list.
Reader = Callable[[Path, Container[str], list[str]], dict[str, Any]]

#: Cells of text that are parsed at once: each is a Python object meanwhile.
_CELLS_AT_ONCE = 65_536
#: Rows of a Parquet file that are read before they are counted.
_ROWS_AT_ONCE = 1_000_000
_NS_PER_S = 1e9


def read_columns(path: Path, wanted: Container[str]) -> tuple[dict[str, Any], list[str]]:
    """Columns of the file by name, and what is to be told of the file in plain sentences.

    A column is a float array, an arrow array of numbers or text, an arrow type in which no number stands, or None
    where it is not `wanted`; `numbers` turns one into floats. Raises BadInput for a missing, empty, broken, unknown
    or too large file.
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
        columns = reader(path, wanted, notes)
    except OSError as error:
        raise unreadable(path, error) from None
    if not columns:
        raise BadInput(str(path), "no columns", "a recording with named columns")
    return columns, notes


def numbers(column: Any, path: Path, name: str) -> Array:
    """A column as float64, NaN where a cell is empty. Raises BadInput naming the first cell that is no number."""
    if isinstance(column, np.ndarray):
        return column.astype(np.float64, copy=False)
    import pyarrow as pa

    kind = column if isinstance(column, pa.DataType) else column.type
    try:
        return _converted(column, path, name)
    except (pa.ArrowException, ValueError, OverflowError):
        raise BadInput(f"{path}: column {name}", f"values of type {kind}", "numbers") from None


def _converted(column: Any, path: Path, name: str) -> Array:
    """Raises ValueError for an arrow type alone."""
    import pyarrow as pa

    if isinstance(column, pa.DataType):
        raise ValueError("no numbers stand in such a column")
    if pa.types.is_boolean(column.type):
        column = column.cast(pa.int8())
    if _holds_numbers(column.type):
        return np.asarray(column.cast(pa.float64()).to_numpy(zero_copy_only=False), dtype=np.float64)
    return _parsed(column, path, name)


def _holds_numbers(kind: Any) -> bool:
    import pyarrow as pa

    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    tests = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_boolean)
    return any(test(kind) for test in tests)


def _parsed(column: Any, path: Path, name: str) -> Array:
    """A column of text, or one that is empty all through."""
    values = np.full(len(column), np.nan)
    for start in range(0, len(column) if column.null_count < len(column) else 0, _CELLS_AT_ONCE):
        for row, cell in enumerate(column.slice(start, _CELLS_AT_ONCE).to_pylist(), start):
            text = "" if cell is None else str(cell).strip()
            try:
                values[row] = float(text) if text else np.nan
            except ValueError:
                raise BadInput(f"{path}: column {name}, row {row + 1}", repr(text)[:40], "a number") from None
    return values


def _read_csv(path: Path, wanted: Container[str], _notes: list[str]) -> dict[str, Any]:
    return read_csv(path, wanted)


def _read_parquet(path: Path, wanted: Container[str], _notes: list[str]) -> dict[str, Any]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with open_file(path) as stream:
            file = pq.ParquetFile(stream)
            names = list(file.schema_arrow.names)
            refuse_repeated(names, path)
            read = [name for name in names if name in wanted and _holds_numbers(file.schema_arrow.field(name).type)]
            require_cells(path, 0, len(names))
            table = _counted(path, file, read)
            others = {name: file.schema_arrow.field(name).type if name in wanted else None for name in names}
    except (pa.ArrowException, OSError, ValueError) as error:  # ValueError: a name that is no UTF-8
        raise BadInput(str(path), first_line(error), "a Parquet file") from None
    return others | {name: table.column(name) for name in read}


def _counted(path: Path, file: Any, read: list[str]) -> Any:
    """The table of these columns, batch by batch: what the file says of its own size is asked first, and not believed.

    Not by what it says of single columns: Arrow ends the process where that is bent. Numbers that take more than eight
    bytes, as decimals do, count for as many as they take.
    """
    import pyarrow as pa

    kinds = [file.schema_arrow.field(name).type for name in read]
    words = sum(max(1, -(-kind.bit_width // 64)) for kind in kinds)
    require_cells(path, file.metadata.num_rows, words)
    batches, rows = [], 0
    for batch in file.iter_batches(_ROWS_AT_ONCE, columns=read):
        rows += len(batch)
        require_cells(path, rows, words)
        batches.append(batch)
    return pa.Table.from_batches(batches, pa.schema(list(zip(read, kinds, strict=True))))


def _read_mat(path: Path, _wanted: Container[str], _notes: list[str]) -> dict[str, Any]:
    with open_file(path) as stream:
        require_size(path, stream, MOST_BYTES)
        content = stream.read(MOST_BYTES)
    try:
        return dict(vectors(content, path))
    except BrokenMatError as error:
        raise BadInput(str(path), str(error), "MAT v5: save('file.mat', '-v7')") from None


def _read_mcap(path: Path, wanted: Container[str], notes: list[str]) -> dict[str, Any]:
    from servod.formats.recording.mcap_reader import TIME, read_recording

    recording = read_recording(path, wanted, MOST_CELLS)
    if recording.damage:
        notes.append(recording.damage)
    cells = np.frombuffer(recording.rows, "<f8").reshape(-1, len(recording.names))
    columns: dict[str, Any] = dict.fromkeys(recording.left_out)
    for at, (name, kind) in enumerate(zip(recording.names, recording.kinds, strict=True)):
        columns[name] = (cells if kind == "d" else cells.view("<i8"))[:, at]
    times_ns = columns[TIME]
    columns["t_s"] = (times_ns - times_ns[:1]) / _NS_PER_S
    return columns


#: Reader for each suffix.
READERS: dict[str, Reader] = {
    ".csv": _read_csv,
    ".csv.gz": _read_csv,
    ".parquet": _read_parquet,
    ".mat": _read_mat,
    ".mcap": _read_mcap,
}
