"""Reads tables of text into arrow columns: CSV, tabs, blanks, plain or packed with gzip, as programs and people write.

The first lines tell the layout (`find_layout`); the rest is never whole in memory: Arrow takes it block by block from a
stream that counts rows and bytes while they are unpacked.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import re
import zlib
from collections.abc import Container, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, cast

from servod.common.errors import BadInput
from servod.common.files import open_file
from servod.lab.recordings.bounds import FileBounds, by_number, first_line, picked, refuse_repeated
from servod.lab.recordings.numbers import number

#: Most that is unpacked at once.
_PIECE_BYTES = 1024 * 1024
_RAGGED = re.compile(r"Row #(\d+): Expected (\d+) columns, got (\d+)")
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def read(path: Path, wanted: Container[str], bounds: FileBounds, notes: list[str]) -> dict[str, Any]:
    """Chunked arrow columns by name, None for those that are not `wanted`. Raises BadInput; OSError as the file does.

    Every cell counts: while Arrow does not know a column's type yet, it keeps the text of all of them.
    """
    with _opened(path, bounds) as text:
        layout = find_layout(text.head, text.whole, path)
        bounds.require_cells(0, len(layout.cells))
        used = picked(layout.names, wanted)
        notes.extend(layout.notes)
        if not used:
            return dict.fromkeys(layout.names)
        table = _table(text, bounds, layout, used, as_text=False)
    if table is None:  # a column that begins as whole numbers, or as nothing, and goes on otherwise
        with _opened(path, bounds) as text:
            table = _table(text, bounds, layout, used, as_text=True)
    return {name: table[name] if name in used else None for name in layout.names}


@contextmanager
def _opened(path: Path, bounds: FileBounds) -> Iterator[_Counted]:
    """The text of the file in UTF-8."""
    with open_file(path) as packed:
        bounds.require_size(packed)
        stream = cast(BinaryIO, gzip.GzipFile(fileobj=packed)) if path.name.lower().endswith(".gz") else packed
        yield _Counted(bounds, stream)


def _table(text: _Counted, bounds: FileBounds, layout: Layout, used: list[str], as_text: bool) -> Any:
    """The columns that are used; None where one of them is not what its first block says."""
    import pyarrow as pa
    import pyarrow.csv as pc

    text.begin_rows(layout)
    try:
        return pc.read_csv(
            pa.PythonFile(text, mode="r"),
            # In this thread alone: one that reads ahead goes on in a file that an error has closed, and hangs.
            read_options=pc.ReadOptions(column_names=list(layout.cells), use_threads=False),
            parse_options=pc.ParseOptions(delimiter=layout.separator),
            convert_options=pc.ConvertOptions(
                include_columns=used,
                column_types=dict.fromkeys(used, pa.string()) if as_text else None,
                strings_can_be_null=as_text,
                decimal_point=layout.decimal,
            ),
            memory_pool=pa.system_memory_pool(),  # gives back what is free; Arrow's own keeps a third more
        )
    except pa.ArrowException as error:
        if not as_text and "conversion error" in str(error):
            return None
        raise _bad_table(bounds.path, first_line(error), layout) from None


def _bad_table(path: Path, error_text: str, layout: Layout) -> BadInput:
    """What Arrow complains of, in our words; rows count from the first below the header, as elsewhere."""
    if ragged := _RAGGED.search(error_text):
        row, wanted, found = (int(number) for number in ragged.groups())
        allowed = f"{wanted} cells, as the first line has"
        if layout.separator == "," and found == 2 * wanted:
            allowed += "; where the decimal sign is a comma, semicolons or tabs between cells"
        return BadInput(f"{path}: row {row}", f"{found} cells", allowed)
    if error_text.startswith("Empty CSV"):
        return BadInput(str(path), "no row below the header", "a header line and rows of numbers")
    return BadInput(str(path), error_text, "rows with as many cells as the header")


class _Counted:
    """A stream of text that ends with BadInput when more comes out of it than a recording may hold.

    `head` are the first octets, of whole lines unless they are the first line; `whole` tells that they are all.
    """

    closed = False  # Arrow asks; the file is closed by who opened it

    def __init__(self, bounds: FileBounds, stream: BinaryIO) -> None:
        self._bounds, self._stream = bounds, stream
        self._bytes = self._lines = self._columns = 0
        self._blanks = False
        self._rest = b""
        self._decoder: codecs.IncrementalDecoder | None = None
        first = self._fill(b"")
        if first.startswith(_UTF16):
            self._decoder = codecs.getincrementaldecoder("utf-16")()
            first = self._decoded(first, final=len(first) < HEAD_BYTES)
        self.whole = len(first) < HEAD_BYTES and not self._decoder
        self.head = first.removeprefix(codecs.BOM_UTF8)

    def begin_rows(self, layout: Layout) -> None:
        """From now on rows of so many columns come, the first of them from the head."""
        self._columns, self._blanks = len(layout.cells), layout.blanks
        self._rest = self.head[layout.skip_bytes :]

    def read(self, count: int) -> bytes:
        """At most so many bytes of rows as Arrow asks for; it asks for more until it has as many as it wants."""
        data = self._take(count)
        if self._blanks:
            data = self._one_blank(data, count)
        self._bytes += len(data)
        self._lines += data.count(b"\n") + data.count(b"\r") - data.count(b"\r\n")
        self._bounds.require_bytes(self._bytes)
        self._bounds.require_cells(self._lines, self._columns)
        return data

    def _take(self, count: int) -> bytes:
        """What comes next, never more than `count` octets: Arrow has room for no more."""
        data = self._rest or self._more(min(count, _PIECE_BYTES))
        self._rest = data[count:]
        return data[:count]

    def _one_blank(self, data: bytes, count: int) -> bytes:
        """Whole lines, with one blank between two cells and none around them."""
        while not (end := max(data.rfind(b"\n"), data.rfind(b"\r")) + 1) and len(data) < count:
            if not (more := self._take(count - len(data))):
                break
            data += more
        if end:
            data, self._rest = data[:end], data[end:] + self._rest
        data = re.sub(rb"[ \t]+", b" ", data)
        return re.sub(rb"(?m)^ | (?=[\r\n]|\Z)", b"", data)

    def _fill(self, data: bytes) -> bytes:
        while len(data) < HEAD_BYTES and (more := self._guarded(HEAD_BYTES - len(data))):
            data += more
        return data

    def _more(self, count: int) -> bytes:
        """What comes next, in UTF-8; nothing at the end alone."""
        data = self._guarded(count)
        while self._decoder is not None and data:
            if decoded := self._decoded(data, final=False):
                return decoded
            data = self._guarded(count)
        return data

    def _decoded(self, data: bytes, final: bool) -> bytes:
        assert self._decoder is not None
        try:
            return self._decoder.decode(data, final).encode()
        except UnicodeError:
            raise BadInput(str(self._bounds.path), "text that is not UTF-16, as it says", "a text file") from None

    def _guarded(self, count: int) -> bytes:
        try:
            return self._stream.read(count)
        except (gzip.BadGzipFile, EOFError, zlib.error) as error:
            cut = isinstance(error, EOFError)
            none = isinstance(error, gzip.BadGzipFile) and str(error).startswith("Not a gzipped")
            found = "a gzip file that is cut off" if cut else "no gzip file" if none else "a damaged gzip file"
            raise BadInput(str(self._bounds.path), found, "a gzip file that is whole") from None


# --- The layout ------------------------------------------------------------------------------------------------------
# The layout of a table of text, as its first lines tell it: separator, names, decimal sign, where the rows begin.
#
# What a spreadsheet adds is taken away: a line `sep=;`, comments, a line of units beneath the names, names without a
# column and columns without a name.


#: So much of a file is looked at: the longest header line.
HEAD_BYTES = 256 * 1024
#: Lines in front of the rows that are looked at.
_MOST_LINES = 64
_COMMENT = ("#", "%", "//")
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?$")
_NOT_A_NUMBER = frozenset({"", "nan", "-nan", "null", "none", "na", "n/a", "#n/a", "-"})


@dataclass(frozen=True)
class Layout:
    """How a table of text is laid out.

    `names` are the columns' names, `cells` the same with those that have none, as many as a row has cells; a separator
    that is a blank stands for any number of them where `blanks` says so. `skip_bytes` lie in front of the first row.
    """

    names: tuple[str, ...]
    cells: tuple[str, ...]
    separator: str
    blanks: bool
    decimal: str
    skip_bytes: int
    notes: tuple[str, ...]


def find_layout(head: bytes, whole: bool, path: Path) -> Layout:
    """The layout that the first octets of a file show; `whole` where they are all of it. Raises BadInput."""
    notes: list[str] = []
    lines = _lines(head, whole, path, notes)
    at, separator, comment = 0, "", ""
    for at, line in enumerate(lines):  # noqa: B007
        bare = line.strip()
        if found := re.fullmatch(r'"?sep=(.)"?', bare, re.IGNORECASE):
            separator = found[1]
        elif bare.startswith(_COMMENT):
            comment = bare.lstrip("#%/").strip()
        elif bare:
            break
    else:
        raise BadInput(str(path), "an empty file", "a header line with column names")
    separator = separator or separator_of(lines[at], lines[at + 1 : at + 2])
    first = split(lines[at], separator)
    if not any(first):
        raise BadInput(str(path), "an empty file", "a header line with column names")
    named, rows = first, at + 1
    if _all_numbers(first):
        above = split(comment, separator_of(comment, ())) if comment else []
        named, rows = (above if len(above) == len(first) else []), at
    elif rows + 1 < len(lines) and _is_unit_row(split(lines[rows], separator), split(lines[rows + 1], separator)):
        notes.append(f"line {rows + 1} taken for units, not applied (a --map file does): {lines[rows].strip()[:120]}")
        rows += 1
    width = _width(first, [split(line, separator) for line in lines[rows : rows + 3]])
    names = _names(named, width, path)
    separator, blanks = (separator, False) if separator != " " else (" ", True)
    decimal = _decimal([split(line, separator) for line in lines[rows:]]) if separator != "," else "."
    skip = sum(len(line) for line in head.splitlines(keepends=True)[:rows])
    named_width = max((at + 1 for at, name in enumerate(named) if name), default=width)
    return Layout(tuple(names[:named_width]), tuple(names), separator, blanks, decimal, skip, tuple(notes))


def _lines(head: bytes, whole: bool, path: Path, notes: list[str]) -> list[str]:
    """The first lines as text. Raises BadInput where they are none."""
    found = head.splitlines(keepends=True)
    if not whole and len(found) > 1:
        found.pop()  # cut in the middle
    if b"\0" in head:
        raise BadInput(str(path), "bytes that are no text", "a text file with a header line")
    try:
        return [line.decode("utf-8").rstrip("\r\n") for line in found[:_MOST_LINES]]
    except UnicodeDecodeError:
        notes.append("the text is not UTF-8; its names are read as Windows writes them (cp1252)")
        return [line.decode("cp1252", "replace").rstrip("\r\n") for line in found[:_MOST_LINES]]


def separator_of(line: str, following: Sequence[str]) -> str:
    """The character between the cells of a line; a blank for any number of blanks and tabs."""
    outside = re.sub(r'"[^"]*"|\[[^]]*\]', "", line)
    below = re.sub(r'"[^"]*"|\[[^]]*\]', "", following[0]) if following else outside
    if ";" in outside and (outside.count(";") >= outside.count(",") or _all_numbers(split(line, ";"))):
        return ";"
    if "\t" in outside and outside.count("\t") >= outside.count(","):
        return "\t"
    words = outside.split()
    if "," in outside and not (len(words) > 1 and all(_DECIMAL_COMMA.match(word) for word in words)):
        return ","
    blank = len(words) > 1 and len(below.split()) > 1
    return " " if blank else ","


def split(line: str, separator: str) -> list[str]:
    """The cells of a line, without quotes and blanks around them."""
    if separator == " ":
        return line.split()
    try:
        cells = next(csv.reader([line], delimiter=separator), [])
    except csv.Error:
        cells = line.split(separator)
    return [cell.strip().strip('"').strip() for cell in cells]


def _all_numbers(cells: Sequence[str]) -> bool:
    filled = [cell for cell in cells if cell]
    return (
        bool(filled)
        and bool(cells[0])
        and all(_is_number(cell) and cell.lower() not in _NOT_A_NUMBER for cell in filled)
    )


def _is_number(cell: str) -> bool:
    try:
        number(cell, "," if _DECIMAL_COMMA.match(cell) else None)
    except ValueError:
        return False
    return True


def _is_unit_row(cells: Sequence[str], below: Sequence[str]) -> bool:
    """Words beneath the names, and numbers beneath the words."""
    words = [cell for cell in cells if cell.lower() not in _NOT_A_NUMBER]
    return bool(words) and not any(map(_is_number, words)) and any(_is_number(cell) for cell in below if cell)


def _width(first: Sequence[str], rows: Sequence[Sequence[str]]) -> int:
    """Cells of a row: as many as the header has, but for empty ones at the end of either."""
    width = len(first)
    while width > 1 and not first[width - 1]:
        width -= 1
    for row in rows:
        if row and any(row) and len(row) != len(first):
            return len(row) if len(row) >= width and not any(row[len(first) :]) else len(first)
    return len(first)


def _names(named: Sequence[str], width: int, path: Path) -> list[str]:
    """A name for every cell, its number where it has none. Raises BadInput for one that stands twice."""
    refuse_repeated([name for name in named if name], path)
    name_at = dict(enumerate(named))
    return [name_at.get(at) or by_number(at) for at in range(width)]


def _decimal(rows: Sequence[Sequence[str]]) -> str:
    """The decimal sign of a table whose cells no comma parts."""
    return "," if any(_DECIMAL_COMMA.match(cell) for row in rows for cell in row) else "."
