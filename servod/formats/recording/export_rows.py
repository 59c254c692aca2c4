"""Writes columns of numbers to CSV or Parquet, aside and then renamed, so that a reader never sees half a file.

Behind replay, identification and diagnosis; the daemon's own recordings have `servod.formats.recording.export`.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from servod.common.errors import BadInput


def write_table(path: Path, columns: Mapping[str, NDArray[np.float64]]) -> None:
    """Write `columns` (name -> values of equal length) to `path`, by its suffix `.csv` or `.parquet`.

    Numbers keep every digit. Raises BadInput when the file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.csv as pc
    import pyarrow.parquet as pq

    table = pa.table({name: np.ascontiguousarray(values) for name, values in columns.items()})
    aside = path.with_name(path.name + ".part")
    try:
        with aside.open("wb") as stream:
            if path.suffix == ".parquet":
                pq.write_table(table, stream)
            else:
                stream.write((",".join(columns) + "\n").encode())
                pc.write_csv(table, stream, pc.WriteOptions(include_header=False))
            stream.flush()
            os.fsync(stream.fileno())
        aside.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):  # half a file fills the very disk that took no more
            aside.unlink(missing_ok=True)
        raise BadInput(str(path), error.strerror or str(error), "a file that can be written") from None
