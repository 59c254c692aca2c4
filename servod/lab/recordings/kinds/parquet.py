"""Reads Parquet into arrow columns; rows are counted while they are unpacked."""

from __future__ import annotations

from collections.abc import Container
from pathlib import Path
from typing import Any

from servod.common.errors import BadInput
from servod.common.files import open_file
from servod.lab.recordings.bounds import FileBounds, first_line, picked, refuse_repeated
from servod.lab.recordings.numbers import holds_numbers

#: Rows that are read before they are counted; fewer where cells hold lists, each of which may be long.
_ROWS_AT_ONCE, _LISTS_AT_ONCE = 1_000_000, 1024


def read(path: Path, wanted: Container[str], bounds: FileBounds, _notes: list[str]) -> dict[str, Any]:
    """Arrow columns by name, the type alone of one in which no number stands, None for those that are not `wanted`.

    Raises BadInput; OSError as the file does.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with open_file(path) as stream:
            file = pq.ParquetFile(stream)
            names = list(file.schema_arrow.names)
            refuse_repeated(names, path)
            used = picked(names, wanted)
            kept = [name for name in used if _readable(file.schema_arrow.field(name).type)]
            bounds.require_cells(0, len(names))
            table = _counted(bounds, file, kept)
            others = {name: file.schema_arrow.field(name).type if name in used else None for name in names}
    except (pa.ArrowException, OSError, ValueError) as error:  # ValueError: a name that is no UTF-8
        raise BadInput(str(path), first_line(error), "a Parquet file") from None
    return others | {name: table.column(name) for name in kept}


def _readable(kind: Any) -> bool:
    return holds_numbers(kind) or _listed(kind)


def _listed(kind: Any) -> bool:
    """Whether each cell is a list of numbers, as states of several joints are kept."""
    import pyarrow as pa

    return (pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind)) and holds_numbers(kind.value_type)


def _counted(bounds: FileBounds, file: Any, names: list[str]) -> Any:
    """The table of these columns, batch by batch: what the file says of its own size is asked first, and not believed.

    Not by what it says of single columns: Arrow ends the process where that is bent. Numbers that take more than eight
    bytes, as decimals do, count for as many as they take.
    """
    import pyarrow as pa

    kinds = [file.schema_arrow.field(name).type for name in names]
    words = sum(_words(kind) for kind in kinds)
    bounds.require_cells(file.metadata.num_rows, words)
    batches, rows, listed = [], 0, 0
    at_once = _LISTS_AT_ONCE if any(map(_listed, kinds)) else _ROWS_AT_ONCE
    for batch in file.iter_batches(at_once, columns=names):
        rows += len(batch)
        listed += sum(len(column.flatten()) for column in batch.columns if pa.types.is_list(column.type))
        bounds.require_cells(rows, words)
        bounds.require_cells(listed, 1)
        batches.append(batch)
    return pa.Table.from_batches(batches, pa.schema(list(zip(names, kinds, strict=True))))


def _words(kind: Any) -> int:
    """So many numbers of eight bytes a cell takes; of lists of any length, one at least."""
    import pyarrow as pa

    if pa.types.is_fixed_size_list(kind):
        return max(1, int(kind.list_size)) * _words(kind.value_type)
    return 1 if pa.types.is_list(kind) else max(1, -(-int(kind.bit_width) // 64))
