"""Reads files that people name: whole, of bounded size, no pipe or device that might not end; writes them for good.

Ground floor, stands on errors and systems alone; every text that servod reads, and every file that must outlive a power
cut, comes through here.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from servod.common.errors import BadInput, ServodError, one_line
from servod.common.portable import flush_folder

#: Largest file that is read as a whole.
MOST_BYTES = 64 * 1024 * 1024
#: A pipe without a writer would wait; Windows, which has no such pipes, would change line ends.
_READING = os.O_RDONLY | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
_KINDS = {stat.S_IFIFO: "pipe", stat.S_IFCHR: "device", stat.S_IFBLK: "device"}
_FOLDER = "is a folder, a file is needed"
#: What the system says of a file, in words for people; the second is of one that shall be written.
_SENTENCES = {
    errno.ENOENT: ("there is no such file", "there is no such folder to write it in"),
    errno.ENOTDIR: ("there is no such file, for a part of this path is a file itself", "a part of this path is a file"),
    errno.EISDIR: (_FOLDER, _FOLDER),
    errno.EACCES: ("may not be read (permission denied)", "may not be written (permission denied)"),
    errno.EPERM: ("may not be read (permission denied)", "may not be written (permission denied)"),
    errno.EROFS: ("may not be read", "may not be written (the file system is read-only)"),
    errno.EEXIST: ("is in the way", "a file stands where a folder is needed"),
    errno.ENOSPC: ("the disk is full", "cannot be written: the disk is full"),
    errno.EDQUOT: ("the quota is used up", "cannot be written: the quota of this user is used up"),
    errno.ELOOP: ("its links go round in a circle", "its links go round in a circle"),
    errno.ENAMETOOLONG: ("the name is too long", "the name is too long"),
}


class BadFile(BadInput):
    """A file that cannot be had: says it in a sentence, for nobody asks which files are allowed."""

    def __init__(self, where: str, sentence: str, allowed: str, more: str = "") -> None:
        """`more` says what would help where the sentence alone does not."""
        self.where, self.found, self.allowed = where, sentence, allowed
        end = f"; needed: {one_line(more)}" if more else ""
        ServodError.__init__(self, f"{one_line(where)}: {one_line(sentence)}{end}")


def unreadable(where: str | Path, error: Exception, needed: str = "") -> BadFile:
    """The refusal of a file that could not be read; `needed` tells what it should be, where that is not plain."""
    return BadFile(str(where), _sentence(where, error, writing=False), needed or "a readable file", needed)


def unwritable(where: str | Path, error: Exception) -> BadFile:
    """The refusal of a file that could not be written."""
    return BadFile(str(where), _sentence(where, error, writing=True), "a file that can be written")


@contextlib.contextmanager
def named_in(where: str) -> Iterator[None]:
    """What is wrong with a file in the block is told with the place that names it: "axis.yaml: gains.initial"."""
    try:
        yield
    except BadInput as error:
        error.where, error.args = f"{where}: {error.where}", (f"{one_line(where)}: {error}",)
        raise


def is_there(path: Path) -> bool:
    """Whether something is there, as far as one may look; never raises."""
    return os.path.exists(path)  # noqa: PTH110  (Path.exists raises where a folder may not be searched)


def reason(error: OSError) -> str:
    """What the system says, to stand in a sentence: "no such device", "permission denied", but "AF_UNIX path"."""
    text = error.strerror or str(error)
    return text[:1].lower() + text[1:] if text[1:2].islower() else text


def _sentence(where: str | Path, error: Exception, writing: bool) -> str:
    number = getattr(error, "errno", None)
    if number == errno.EACCES and os.path.isdir(where):  # noqa: PTH112  (so Windows says it; never raises)
        number = errno.EISDIR
    if number == errno.ENOENT and writing and os.path.isdir(os.path.dirname(where)):  # noqa: PTH112, PTH120
        number = None  # a file system that takes no files: /proc
    if number in _SENTENCES:
        return _SENTENCES[number][writing]
    if isinstance(error, OSError):
        return f"cannot be {'written' if writing else 'read'} ({reason(error)})"
    return f"is no name of a file ({error})"


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


def read_bytes(path: str | Path, needed: str = "") -> bytes:
    """The file's bytes; raises BadInput when it is missing, unreadable, too large, or no file: pipes may never end.

    `needed` says what file it should be, where its name does not.
    """
    try:
        with open_file(path) as stream:
            require_size(path, stream, MOST_BYTES)
            return stream.read(MOST_BYTES)
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        raise unreadable(path, error, needed) from None


def require_size(path: str | Path, stream: BinaryIO, most_bytes: int) -> None:
    """Refuse a file that is larger, before anything of it is read. Raises BadInput."""
    size = os.fstat(stream.fileno()).st_size
    if size > most_bytes:
        raise BadInput(str(path), f"{size} bytes", f"at most {most_bytes} bytes")


def open_file(path: str | Path) -> BinaryIO:
    """A file to read from, which is no pipe and no device. Raises OSError."""
    descriptor = os.open(path, _READING)
    try:
        _require_file(path, os.fstat(descriptor))
    except OSError:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb")


def open_to_append(path: Path) -> BinaryIO:
    """A file to write to at its end, made where there is none; no pipe and no device. Raises OSError."""
    with contextlib.suppress(FileNotFoundError):
        _require_file(path, path.stat())
    return path.open("ab")


def _require_file(path: str | Path, found: os.stat_result) -> None:
    """Raise OSError for a folder, and for what might not end."""
    kind = stat.S_IFMT(found.st_mode)
    if kind == stat.S_IFDIR:
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if kind != stat.S_IFREG:
        raise OSError(errno.EINVAL, f"a {_KINDS.get(kind, 'special file')}, which might not end", str(path))


# --- Writing ---------------------------------------------------------------------------------------------------------
# Every file that must outlive a power cut: written aside, flushed to the disk, renamed, and the name flushed as well.


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A stream whose content takes the place of `path` at the end of the block, whole or not at all. Raises OSError.

    After a kill or a power cut at any moment there is the old file or the new one; after the block, the new one.
    """
    aside = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        with aside.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        aside.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):  # half a file fills the very disk that took no more
            aside.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:  # a full disk names no file by itself
            error.filename = str(path)
        raise
    flush_folder(path.parent)


def write_atomically(path: Path, text: str) -> None:
    """Replace `path` by `text`, whole or not at all; its folder is there. Raises OSError."""
    with replacing(path) as stream:
        stream.write(text.encode())


def write_bytes(path: Path, content: bytes) -> Path:
    """Replace `path` by `content`, make its folder where it is missing, and return `path`. Raises BadInput."""
    missing = [folder for folder in path.parents if not is_there(folder)]
    try:
        make_folder(path.parent)
        with replacing(path) as stream:
            stream.write(content)
    except OSError as error:
        _remove_empty(missing)
        raise unwritable(path, error) from None
    return path


def _remove_empty(folders: Sequence[Path]) -> None:
    """Take folders away, the deepest first, as far as they are there and empty."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


def write_file(path: Path, text: str) -> None:
    """Replace a file that a user named; its folder must be there. Raises BadInput."""
    try:
        write_atomically(path, text)
    except OSError as error:
        raise unwritable(path, error) from None


def refusal_of(folder: Path) -> str:
    """Why no file can be written in a folder, which is made where it is missing; empty where one can."""
    import tempfile  # 2 ms of every start, for a daemon alone

    missing = [one for one in (folder, *folder.parents) if not is_there(one)]
    try:
        make_folder(folder)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"servod")
    except OSError as error:
        _remove_empty(missing)
        return f"{folder}: no file can be written there ({reason(error)})"
    return ""


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, for good: a power cut takes one that is not, with all in it. Raises OSError."""
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for made in reversed(missing):
        flush_folder(made.parent)
