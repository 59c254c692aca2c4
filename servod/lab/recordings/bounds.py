"""How much a recording may hold: one limit for every kind of file, so that reading takes at most 3 GiB of memory.

Beneath the readers, which count while they unpack: a few kilobytes can unpack to any amount. A number takes eight bytes
in the reader's table, eight in the recording, and for a moment some more while its column is scaled and checked.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from servod.common.errors import BadInput
from servod.common.files import require_size

_REMEDY = "a shorter stretch, or fewer columns, in a file of its own"
_PIECE_BYTES = 1024 * 1024


@dataclass(frozen=True)
class FileBounds:
    """What the file at `path` may hold: numbers in the columns that are used, columns, bytes packed and unpacked."""

    path: Path
    most_cells: int
    most_columns: int
    most_bytes: int

    def require_cells(self, rows: int, columns: int) -> None:
        """Refuse a table of more numbers than a recording may hold. Raises BadInput."""
        if columns > self.most_columns:
            raise BadInput(str(self.path), f"{columns} columns", f"at most {self.most_columns}")
        if rows * columns > self.most_cells:
            found = f"{rows} rows or more of {columns} columns"
            raise BadInput(str(self.path), found, f"at most {self.most_cells} numbers: {_REMEDY}")

    def require_bytes(self, unpacked: int) -> None:
        """Refuse a file that unpacks to more than a recording may. Raises BadInput."""
        if unpacked > self.most_bytes:
            found, allowed = f"{unpacked} bytes or more unpacked", f"at most {self.most_bytes} bytes: {_REMEDY}"
            raise BadInput(str(self.path), found, allowed)

    def require_size(self, stream: BinaryIO) -> None:
        """Refuse an open file that is larger than a recording may be, packed or not. Raises BadInput."""
        require_size(self.path, stream, self.most_bytes)

    def read_all(self, stream: BinaryIO, most_bytes: int | None = None) -> bytes:
        """All that comes out of a stream, counted as it comes; `most_bytes` where less than a recording may be read."""
        content = bytearray()
        while piece := stream.read(_PIECE_BYTES):
            content += piece
            self.require_bytes(len(content))
            if most_bytes is not None and len(content) > most_bytes:
                break
        return bytes(content)


def picked(names: Sequence[str], wanted: Container[str]) -> list[str]:
    """Those of a table's columns that are wanted, by their names or by their numbers, counted from 0."""
    return [name for at, name in enumerate(names) if name in wanted or by_number(at) in wanted]


def by_number(at: int) -> str:
    """How a column is called by its number: the name of one that has no other."""
    return f"[:,{at}]"


def refuse_repeated(names: Sequence[str], path: Path) -> None:
    """Raises BadInput naming the first column that stands twice."""
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise BadInput(f"{path}: column {repeated[0]}", "the same name twice", "one column of each name")


def first_line(error: Exception) -> str:
    """What a library says, without where in its sources it says it."""
    return (str(error).splitlines() or ["a broken file"])[0]
