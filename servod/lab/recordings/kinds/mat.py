"""Reads the numeric arrays of a MAT file of version 5: MathWorks' "MAT-File Format", Level 5.

scipy has a reader for all that MATLAB can store, but it is compiled without bounds: a file with a bent length ends the
process. This one reads arrays of numbers and structs of them, and checks every length.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Container, Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import BadInput
from servod.common.files import open_file
from servod.lab.recordings.bounds import FileBounds
from servod.lab.recordings.numbers import Array, widened

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

    bounds: FileBounds
    wanted: Container[str]
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
                    self.bounds.require_bytes(self.unpacked_bytes)
        except zlib.error as error:
            raise BrokenMatError(f"a packed element that cannot be unpacked ({error})") from None
        return memoryview(content)

    def count(self, cells: int) -> None:
        """One more array. Raises BadInput when they are too many numbers for a recording."""
        self.cells, self.vectors = self.cells + cells, self.vectors + 1
        self.bounds.require_cells(-(-self.cells // self.vectors), self.vectors)


def read(path: Path, wanted: Container[str], bounds: FileBounds, _notes: list[str]) -> dict[str, Any]:
    """Numeric arrays by name, members of a struct as `struct.member`: vectors, matrices, and single numbers as arrays
    without dimensions; None for vectors and matrices that are not `wanted`. Raises BadInput; OSError as the file does.
    """
    with open_file(path) as stream:
        bounds.require_size(stream)
        content = stream.read(bounds.most_bytes)
    try:
        return _arrays(content, bounds, wanted)
    except BrokenMatError as error:
        raise BadInput(str(path), str(error), "MAT v5: save('file.mat', '-v7')") from None


def _arrays(content: bytes, bounds: FileBounds, wanted: Container[str]) -> dict[str, Any]:
    if len(content) < _MAT_HEADER_BYTES or not content.startswith(b"MATLAB"):
        raise BrokenMatError("no header of a MAT file")
    mark = content[126:128]
    if mark not in (b"IM", b"MI"):
        raise BrokenMatError("a header without mark of the byte order")
    file = _File(bounds, wanted, "<" if mark == b"IM" else ">")
    if struct.unpack_from(f"{file.order}H", content, 124)[0] >> 8 == 2:
        raise BrokenMatError("version 7.3")
    found: dict[str, Any] = {}
    for element in file.elements(memoryview(content)[_MAT_HEADER_BYTES:]):
        for inner in file.elements(file.unpack(element.data)) if element.type == _Type.COMPRESSED else [element]:
            if inner.type == _Type.MATRIX:
                found.update(_matrix(file, inner.data, "", _DEEPEST))
    return found


def _matrix(file: _File, data: memoryview, name: str, depth: int) -> Iterator[tuple[str, Array | None]]:
    """What one array holds; `name` is the array's where it stands in a struct, which names it."""
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
        yield from _numeric(file, name, shape, _stored(file, _next(parts)))


def _numeric(file: _File, name: str, shape: list[int], values: NDArray[Any]) -> Iterator[tuple[str, Array | None]]:
    """A vector or a matrix, or a single number that is wanted; nothing of an array of another form."""
    if len(values) != math.prod(shape) or len(shape) != 2 or len(values) < 1:
        return
    wanted = name in file.wanted
    if len(values) == 1:
        if wanted:
            yield name, widened(values)[0:1].reshape(())
        return
    if not wanted:
        yield name, None
        return
    file.count(len(values))
    wide = widened(values)
    yield name, wide if 1 in shape else wide.reshape(shape, order="F")


def _struct(file: _File, parts: Iterator[_Element], name: str, depth: int) -> Iterator[tuple[str, Array | None]]:
    """What a struct's members hold; the name of each has a fixed length, filled up with zeros."""
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
