"""How much a recording may hold: one limit for every format, so that reading takes at most 3 GiB of memory.

Beneath the readers, which count while they unpack: a few kilobytes can unpack to any amount. A number takes eight bytes
in the reader's table, eight in the recording, and for a moment some more while its column is scaled and checked.
"""

from __future__ import annotations

from pathlib import Path

from servod.common.errors import BadInput

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
