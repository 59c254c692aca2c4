"""Reads files that people name: whole, of bounded size, and never a pipe or a device that might not end.

Ground floor, stands on errors alone; every text that servod reads comes through here.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from pathlib import Path
from typing import Any, BinaryIO

from servod.common.errors import BadInput

#: Largest file that is read as a whole.
MOST_BYTES = 64 * 1024 * 1024
#: A pipe without a writer would wait; Windows, which has no such pipes, would change line ends.
_READING = os.O_RDONLY | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
_KINDS = {stat.S_IFDIR: "Is a directory", stat.S_IFIFO: "a pipe", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}


def read_text(path: str | Path) -> str:
    """The file's text; raises BadInput when it is missing, unreadable, too large or not UTF-8."""
    try:
        return read_bytes(path).decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise BadInput(str(path), "bytes that are not UTF-8", "a text file") from None


def read_json(path: str | Path, allowed: str) -> Any:
    """The document of a JSON file; `allowed` says what file it should be. Raises BadInput."""
    try:
        return json.loads(read_bytes(path, allowed))
    except ValueError as error:
        raise BadInput(str(path), f"no JSON document ({error})", allowed) from None
    except RecursionError:
        raise BadInput(str(path), "brackets nested without end", allowed) from None


def read_bytes(path: str | Path, allowed: str = "a readable file") -> bytes:
    """The file's bytes; raises BadInput when it is missing, unreadable, too large, or no file: pipes may never end."""
    try:
        with open_file(path) as stream:
            require_size(path, stream, MOST_BYTES)
            return stream.read(MOST_BYTES)
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        found = getattr(error, "strerror", None) or str(error)
        raise BadInput(str(path), found, allowed) from None


def require_size(path: str | Path, stream: BinaryIO, most_bytes: int) -> None:
    """Refuse a file that is larger, before anything of it is read. Raises BadInput."""
    size = os.fstat(stream.fileno()).st_size
    if size > most_bytes:
        raise BadInput(str(path), f"{size} bytes", f"at most {most_bytes} bytes")


def open_file(path: str | Path) -> BinaryIO:
    """A file to read from, which is no pipe and no device. Raises OSError."""
    descriptor = os.open(path, _READING)
    kind = stat.S_IFMT(os.fstat(descriptor).st_mode)
    if kind == stat.S_IFREG:
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    raise OSError(errno.EISDIR if kind == stat.S_IFDIR else errno.EINVAL, _KINDS.get(kind, "no regular file"))


# Writes the files of a report: aside first, flushed, then renamed, so that an interrupted run leaves no half file.
#
# Under page and pictures.


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
