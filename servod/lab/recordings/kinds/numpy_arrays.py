"""Reads arrays as numpy keeps them, `.npy` and `.npz`: NEP 1, without pickled objects.

numpy's own reader makes room for whatever the header of a file claims; here the claim is counted first, and then the
octets as they come.
"""

from __future__ import annotations

import io
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Container
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from servod.common.errors import BadInput
from servod.common.files import open_file
from servod.lab.recordings.bounds import FileBounds
from servod.lab.recordings.numbers import widened

#: Longest header of an array, and longest list of arrays in a file.
_LONGEST_HEADER, _LONGEST_LIST = 65_536, 1024 * 1024
#: The end of an archive: its mark, its length, and how far from the end of the file it may begin.
_END, _END_BYTES, _END_WITHIN = b"PK\5\6", 22, 65_536 + 22
_PIECE_BYTES = 1024 * 1024
_BROKEN = (
    *(zipfile.BadZipFile, zlib.error, struct.error, EOFError, ValueError, RuntimeError, NotImplementedError),
    *(KeyError, IndexError, SyntaxError, OverflowError, TypeError, MemoryError, RecursionError, tokenize.TokenError),
)


class BrokenArrayError(ValueError):
    """The file holds no array of numbers, or is cut or bent; the message says where."""


class _Header(NamedTuple):
    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype[Any]


def read_npy(path: Path, wanted: Container[str], bounds: FileBounds, _notes: list[str]) -> dict[str, Any]:
    """The array as `data`, or the fields of its rows by their names. Raises BadInput; OSError as the file does."""
    with open_file(path) as stream:
        bounds.require_size(stream)
        try:
            return _columns("data", stream, wanted, bounds)
        except _BROKEN as error:
            raise BadInput(str(path), _error_text(error), "an array of numbers: np.save") from None


def read_npz(path: Path, wanted: Container[str], bounds: FileBounds, _notes: list[str]) -> dict[str, Any]:
    """The arrays by their names; None for those that are not `wanted`. Raises BadInput; OSError as the file does."""
    columns: dict[str, Any] = {}
    with open_file(path) as stream:
        bounds.require_size(stream)
        try:
            _require_short_list(stream)
            with zipfile.ZipFile(stream) as archive:
                for member in archive.infolist():
                    name = member.filename.removesuffix(".npy")
                    with archive.open(member) as packed:
                        columns |= _columns(name, cast(BinaryIO, packed), wanted, bounds)
                    bounds.require_cells(sum(kept.size for kept in columns.values() if kept is not None), 1)
        except _BROKEN as error:
            raise BadInput(str(path), _error_text(error), "arrays of numbers: np.savez") from None
    return columns


def _error_text(error: Exception) -> str:
    """What is wrong: in own words, for those of the libraries speak of themselves."""
    return str(error) if isinstance(error, BrokenArrayError) else "a file that is broken, or of another kind"


def _require_short_list(stream: BinaryIO) -> None:
    """See that the list of an archive's members is short: it is read as a whole. Raises BrokenArrayError."""
    size = stream.seek(0, io.SEEK_END)
    stream.seek(max(0, size - _END_WITHIN))
    tail = stream.read(_END_WITHIN)
    at = tail.find(_END)
    while at >= 0:
        if at + _END_BYTES <= len(tail) and struct.unpack_from("<I", tail, at + 12)[0] > _LONGEST_LIST:
            raise BrokenArrayError("a list of members that is too long")
        at = tail.find(_END, at + 1)
    stream.seek(0)


def _columns(name: str, stream: BinaryIO, wanted: Container[str], bounds: FileBounds) -> dict[str, Any]:
    """What one array holds: a vector, a matrix, a single number, or fields by their names."""
    header = _header(stream)
    fields = header.dtype.names
    if fields:
        names = list(fields) if name == "data" else [f"{name}.{field}" for field in fields]
        if not any(one in wanted for one in names) or len(header.shape) != 1:
            return dict.fromkeys(names)
        rows = _values(header, stream, bounds)
        return {
            one: widened(rows[field]) if one in wanted and rows[field].dtype.kind in "biuf" else None
            for one, field in zip(names, fields, strict=True)
        }
    if (name not in wanted and not (name == "data" and "" in wanted)) or header.dtype.kind not in "biuf":
        return {name: None}
    if len(header.shape) > 2:
        raise BrokenArrayError(f"{name} has {len(header.shape)} dimensions, at most 2 are read")
    values = widened(_values(header, stream, bounds))
    one_wide = values.ndim == 2 and 1 in values.shape and values.size > 1
    return {name: values.reshape(-1) if one_wide else values}


def _header(stream: BinaryIO) -> _Header:
    """Raises BrokenArrayError where the array is none, or holds objects."""
    version = npy.read_magic(stream)
    length = stream.read(2 if version == (1, 0) else 4)
    size = int.from_bytes(length, "little")
    if size > _LONGEST_HEADER or version > (3, 0):
        raise BrokenArrayError("a header that is too long, or of another version")
    text = io.BytesIO(length + stream.read(size))
    shape, fortran, dtype = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(text)
    if dtype.hasobject:
        raise BrokenArrayError("an array of objects, not of numbers")
    return _Header(shape, fortran, dtype)


def _values(header: _Header, stream: BinaryIO, bounds: FileBounds) -> NDArray[Any]:
    """The octets of an array, no more of them than a recording may have. Raises BadInput, BrokenArrayError."""
    cells = math.prod(header.shape)
    bounds.require_cells(cells, 1 if not header.dtype.names else len(header.dtype.names))
    size = cells * header.dtype.itemsize
    bounds.require_bytes(size)
    content = bytearray()
    while len(content) < size:
        piece = stream.read(min(_PIECE_BYTES, size - len(content)))
        if not piece:
            raise BrokenArrayError("an array that is cut off")
        content += piece
    flat = np.frombuffer(content, header.dtype, cells)
    return flat.reshape(header.shape, order="F" if header.fortran else "C")
