"""Reads JSON: a list of objects, lines of objects, or a document with lists in it; nested keys are joined with points.

A document is read as a whole and so may hold less than lines, which are taken one by one.
"""

from __future__ import annotations

import array
import gzip
import json
import zlib
from collections.abc import Container, Iterator
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from servod.common.errors import BadInput
from servod.common.files import open_file
from servod.lab.recordings.bounds import FileBounds, by_number, first_line
from servod.lab.recordings.numbers import Array

#: Largest document that is read as a whole, and longest line: in memory it takes twenty times as much.
_MOST_BYTES, _LONGEST_LINE = 64 * 1024 * 1024, 1024 * 1024
#: Objects within objects, and lists within objects, that are followed.
_DEEPEST = 8
_LINES = (".jsonl", ".ndjson")
_BROKEN = (ValueError, RecursionError, OverflowError)
_ALLOWED = "JSON: a list of objects, or an object in each line"


def read(path: Path, wanted: Container[str], bounds: FileBounds, _notes: list[str]) -> dict[str, Any]:
    """Columns by name: float arrays, matrices, single numbers as arrays without dimensions; None where not `wanted`.

    Raises BadInput; OSError as the file does.
    """
    name = path.name.lower().removesuffix(".gz")
    with open_file(path) as packed:
        bounds.require_size(packed)
        stream = cast(BinaryIO, gzip.GzipFile(fileobj=packed)) if path.name.lower().endswith(".gz") else packed
        try:
            if name.endswith(_LINES):
                return _lines(stream, wanted, bounds)
            content = bounds.read_all(stream, _MOST_BYTES)
            return _document(content, wanted, bounds)
        except (gzip.BadGzipFile, EOFError, zlib.error) as error:
            raise BadInput(str(path), str(error), "a gzip file that is whole") from None
        except _BROKEN as error:
            raise BadInput(str(path), first_line(error)[:120], _ALLOWED) from None


def _document(content: bytes, wanted: Container[str], bounds: FileBounds) -> dict[str, Any]:
    if len(content) > _MOST_BYTES:
        allowed = f"at most {_MOST_BYTES} bytes in one document; lines of objects (.jsonl) may be longer"
        raise BadInput(str(bounds.path), f"{len(content)} bytes or more", allowed)
    text = content.decode("utf-8-sig")
    try:
        document = json.loads(text)
    except ValueError:
        if not text.lstrip().startswith("{") or "\n" not in text.strip():
            raise
        rows = _Rows(wanted, bounds, "")
        for line in text.splitlines():
            rows.add_line(line)
        return rows.columns()
    return dict(_walk(document, "", wanted, bounds, _DEEPEST))


def _lines(stream: BinaryIO, wanted: Container[str], bounds: FileBounds) -> dict[str, Any]:
    rows, total = _Rows(wanted, bounds, ""), 0
    while line := stream.readline(_LONGEST_LINE):
        total += len(line)
        bounds.require_bytes(total)
        if len(line) == _LONGEST_LINE:
            raise BadInput(str(bounds.path), f"a line of {len(line)} bytes or more", f"under {_LONGEST_LINE} bytes")
        rows.add_line(line.decode("utf-8-sig"))
    return rows.columns()


def _walk(
    value: Any, name: str, wanted: Container[str], bounds: FileBounds, deep: int
) -> Iterator[tuple[str, Array | None]]:
    """The columns that stand in a value, with the path to them as names."""
    if isinstance(value, dict) and deep:
        for key, inner in value.items():
            yield from _walk(inner, f"{name}.{key}" if name else str(key), wanted, bounds, deep - 1)
    elif isinstance(value, list) and value:
        if all(isinstance(row, dict) for row in value):
            rows = _Rows(wanted, bounds, f"{name}." if name else "")
            for row in value:
                rows.add(row)
            yield from rows.columns().items()
        else:
            yield name or "data", _numbers(value, name or "data", wanted, bounds)
    elif name in wanted and isinstance(value, int | float):
        yield name, np.array(float(value))


def _numbers(value: list[Any], name: str, wanted: Container[str], bounds: FileBounds) -> Array | None:
    """A list of numbers, or of lists of numbers as long as each other."""
    if name not in wanted:
        return None
    bounds.require_cells(len(value), max((len(row) for row in value if isinstance(row, list)), default=1))
    try:
        found = np.array(value, dtype=np.float64)
    except (TypeError, *_BROKEN):
        allowed = "numbers, or rows as long as one another"
        raise BadInput(f"{bounds.path}: column {name}", "other values than numbers", allowed) from None
    if found.ndim > 2:
        raise BadInput(f"{bounds.path}: {name}", f"lists within lists, {found.ndim} deep", "a list, or a matrix")
    return found


class _Rows:
    """Objects as rows of a table: only the columns that are wanted are kept."""

    def __init__(self, wanted: Container[str], bounds: FileBounds, prefix: str) -> None:
        self._wanted, self._bounds, self._prefix = wanted, bounds, prefix
        self._kept: dict[str, array.array[float]] = {}
        self._names: dict[str, None] = {}
        self._count = 0

    def add_line(self, line: str) -> None:
        """One more row; nothing where the line is empty. Raises ValueError and BadInput."""
        if line := line.strip():
            found = json.loads(line)
            self.add(found if isinstance(found, dict) else {"data": found})

    def add(self, row: dict[str, Any]) -> None:
        """One more row. Raises BadInput for what is no number in a column that is wanted."""
        for name, value in _flat(row, self._prefix, _DEEPEST):
            self._names.setdefault(name)
            if name in self._wanted:
                column = self._kept.setdefault(name, array.array("d"))
                column.extend([np.nan] * (self._count - len(column)))
                column.append(self._number(name, value))
        self._count += 1
        self._bounds.require_cells(self._count, max(1, len(self._kept)))
        self._bounds.require_cells(0, len(self._names))

    def _number(self, name: str, value: Any) -> float:
        if value is None:
            return np.nan
        if isinstance(value, int | float):
            return float(value)
        where = f"{self._bounds.path}: column {name}, row {self._count + 1}"
        raise BadInput(where, repr(value)[:40], "a number")

    def columns(self) -> dict[str, Any]:
        """All names, those that are wanted with their numbers."""
        for column in self._kept.values():
            column.extend([np.nan] * (self._count - len(column)))
        kept = {name: np.frombuffer(column, np.float64) for name, column in self._kept.items()}
        return {name: kept.get(name) for name in self._names}


def _flat(value: Any, name: str, deep: int) -> Iterator[tuple[str, Any]]:
    """What stands in one row: keys of objects joined with points, elements of lists by their numbers."""
    if isinstance(value, dict) and deep:
        for key, inner in value.items():
            joined = f"{name}{key}" if not name or name.endswith(".") else f"{name}.{key}"
            yield from _flat(inner, joined, deep - 1)
    elif isinstance(value, list) and deep:
        for at, inner in enumerate(value):
            yield from _flat(inner, f"{name}{by_number(at)}", deep - 1)
    else:
        yield name, value
