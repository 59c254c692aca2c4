"""Turns a recording into CSV (core) or Parquet (pyarrow, lab extra), with the column names of servod.lab.recordings.

Behind recorder_read. The first column is t_s, seconds since the first cycle; the others keep the record's names, which
carry their units. Files are written aside, synced and renamed.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from servod.common.files import replacing, unwritable
from servod.formats.recording.mcap_reader import McapRecording

_NS_PER_S = 1e9


def export_csv(recording: McapRecording, path: Path) -> int:
    """Write `recording` to `path` as CSV; returns the number of rows. Raises BadInput when that cannot be written."""
    try:
        with replacing(path) as stream:
            text = io.TextIOWrapper(stream, encoding="utf-8", newline="")
            _write_csv(recording, text)
            text.detach()  # flushes; the stream below is not ours to close
    except OSError as error:
        raise unwritable(path, error) from None
    return len(recording)


def _write_csv(recording: McapRecording, stream: TextIO) -> None:
    writer = csv.writer(stream)
    writer.writerow(["t_s", *recording.names])
    writer.writerows(_csv_rows(recording))


def _csv_rows(recording: McapRecording) -> Iterator[tuple[Any, ...]]:
    columns = [recording.column(name) for name in recording.names]
    times_s = seconds(recording)
    return zip((f"{t:.9f}" for t in times_s), *columns, strict=True)


def seconds(recording: McapRecording) -> list[float]:
    """Seconds of each row since the first; empty when there is none."""
    times_ns = recording.column("time_ns")
    return [(t - times_ns[0]) / _NS_PER_S for t in times_ns]


def export_parquet(recording: McapRecording, path: Path) -> int:
    """Write `recording` to `path` as Parquet, with units in the columns' metadata; returns the number of rows.

    Raises BadInput when the file cannot be written, ImportError without pyarrow.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    types = {"d": pa.float64(), "q": pa.int64()}
    fields = [pa.field("t_s", pa.float64(), metadata={"unit": "s"})]
    columns = [pa.array(seconds(recording), pa.float64())]
    for name, kind, unit in zip(recording.names, recording.kinds, recording.units, strict=True):
        fields.append(pa.field(name, types[kind], metadata={"unit": unit}))
        columns.append(pa.array(recording.column(name), types[kind]))
    try:
        with replacing(path) as stream:
            pq.write_table(pa.table(columns, schema=pa.schema(fields)), stream)
    except OSError as error:
        raise unwritable(path, error) from None
    return len(recording)


# --- Tables of numbers -----------------------------------------------------------------------------------------------
# Writes columns of numbers to CSV or Parquet, aside and then renamed, so that a reader never sees half a file.


def write_table(path: Path, columns: Mapping[str, NDArray[np.float64]]) -> None:
    """Write `columns` (name -> values of equal length) to `path`, by its suffix `.csv` or `.parquet`.

    Numbers keep every digit. Raises BadInput when the file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.csv as pc
    import pyarrow.parquet as pq

    table = pa.table({name: np.ascontiguousarray(values) for name, values in columns.items()})
    try:
        with replacing(path) as stream:
            if path.suffix == ".parquet":
                pq.write_table(table, stream)
            else:
                stream.write((",".join(columns) + "\n").encode())
                pc.write_csv(table, stream, pc.WriteOptions(include_header=False))
    except OSError as error:
        raise unwritable(path, error) from None
