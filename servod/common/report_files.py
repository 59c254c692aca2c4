"""Writes the files of a report: aside first, flushed, then renamed, so that an interrupted run leaves no half file.

Under page and pictures.
"""

from __future__ import annotations

import os
from pathlib import Path

from servod.common.errors import BadInput


def write_bytes(path: Path, content: bytes) -> Path:
    """Replace `path` by `content`, make its folder where it is missing, and return `path`. Raises BadInput."""
    aside = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with aside.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        aside.replace(path)
    except OSError as error:
        raise BadInput(str(path), error.strerror or str(error), "a path that can be written") from None
    return path
