"""The mark of a run: tells, after a power cut or kill -9, that a daemon ended without an orderly stop, and when.

Beside the recordings, one small file for each axis, `NAME.run.json`; the daemon writes it, `servoctl faults` reads it.
It says "running" from the start to the orderly end, and which file it is: a copy is of no run. The daemon holds a lock
on it, which ends with the process, and keeps its time of change new. A mark that says "running" and that nobody
holds is of a daemon that is gone: alive at the mark's time of change, and dead when it was looked at. The next start
keeps that as a pair of times, the last few.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple, Self

from pydantic import Field

from servod.common.errors import BadInput, ServodError
from servod.common.files import make_folder, open_file, reason, require_size, unreadable
from servod.common.portable import flush_folder, is_locked, lock_file
from servod.common.yaml import Strict, validate

log = logging.getLogger("servod")

ENDING = ".run.json"
#: Ends that are kept; older ones tell nothing of the axis as it is now.
MOST_ENDS = 20
#: Between two signs of life; so much earlier than its end a daemon may have been seen last.
SIGN_S = 5.0
_MOST_BYTES = 64 * 1024
#: In the year 2262, the last time of many programs.
_LATEST_NS = 2**63 - 1
_ALLOWED = "the mark of a run, as servod writes it"


class AbruptEnd(Strict):
    """A run that ended without an orderly stop: when it was last seen alive and when found ended, ns since 1970."""

    seen_ns: int = Field(ge=0, le=_LATEST_NS)
    found_ns: int = Field(ge=0, le=_LATEST_NS)


class _Mark(Strict):
    """The file."""

    running_since_ns: int | None = Field(None, ge=0, le=_LATEST_NS)
    inode: int | None = None
    abrupt_ends: list[AbruptEnd] = Field(default_factory=list, max_length=MOST_ENDS)


class RunMark:
    """The mark of this process's run, from `with` to the end of the block; a disk that fails is told, and no more.

    An error that nobody foresaw is no orderly end. `found` is the end of the run before, where that was abrupt.
    """

    def __init__(self, folder: Path, axis: str) -> None:
        self.found: AbruptEnd | None = None
        self._path = folder / f"{axis}{ENDING}"
        self._ends: list[AbruptEnd] = []
        self._held: IO[str] | None = None
        self._over = threading.Event()
        self._signs = threading.Thread(target=self._give_signs, name="run mark", daemon=True)

    def __enter__(self) -> Self:
        now_ns = time.time_ns()
        try:
            make_folder(self._path.parent)
            if self._take_over(now_ns):
                self._held = self._write(_Mark(running_since_ns=now_ns, abrupt_ends=self._ends))
                self._signs.start()
        except OSError as error:
            log.warning("%s: no mark of this run (%s)", self._path, reason(error))
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._over.set()
        held, self._held = self._held, None
        if held is None:
            return
        self._signs.join(SIGN_S)
        if kind is None or issubclass(kind, ServodError | KeyboardInterrupt | SystemExit):
            try:
                self._write(_Mark(abrupt_ends=self._ends)).close()
            except OSError as failure:
                log.warning("%s: the end of this run is not marked (%s)", self._path, reason(failure))
        held.close()

    def _take_over(self, now_ns: int) -> bool:
        """Learn what the run before left; False where its process lives: two axes of one name in one folder."""
        if not self._path.exists():
            return True
        try:
            before = _read(self._path, now_ns)
        except BadInput as error:
            log.warning("%s; begun again", error)
            return True
        if before.alive:
            log.warning("%s: another servod holds it; give each axis a `name` of its own", self._path)
            return False
        self.found, self._ends = before.found, before.ends()[-MOST_ENDS:]
        return True

    def _write(self, mark: _Mark) -> IO[str]:
        """Replace the file, whole or not at all, also when the power goes; the new one is locked while it is open."""
        aside = self._path.with_name(f"{self._path.name}.part")
        stream = aside.open("w", encoding="utf-8")
        try:
            lock_file(stream, wait=False)
            inode = os.fstat(stream.fileno()).st_ino
            json.dump(mark.model_copy(update={"inode": inode}).model_dump(mode="json"), stream)
            stream.flush()
            os.fsync(stream.fileno())
            aside.replace(self._path)
            flush_folder(self._path.parent)
        except OSError:
            for give_up in (aside.unlink, stream.close):
                with contextlib.suppress(OSError):  # a full disk refuses the last bytes of it, too
                    give_up()
            raise
        return stream

    def _give_signs(self) -> None:
        """In a thread of its own, which a disk that hangs may hold up."""
        while not self._over.wait(SIGN_S):
            held = self._held
            if held is not None:
                with contextlib.suppress(OSError, ValueError):
                    os.utime(held.fileno())


def abrupt_ends(path: Path, now_ns: int) -> list[AbruptEnd]:
    """The ends without an orderly stop that the mark at `path` tells, oldest first; one found now is the last.

    Raises BadInput.
    """
    return _read(path, now_ns).ends()


class _Told(NamedTuple):
    """What a mark tells: the ends that are kept, one that is found now, and whether its process lives."""

    kept: list[AbruptEnd]
    found: AbruptEnd | None = None
    alive: bool = False

    def ends(self) -> list[AbruptEnd]:
        """All of them, oldest first."""
        return [*self.kept, self.found] if self.found else self.kept


def _read(path: Path, now_ns: int) -> _Told:
    """All of one open file: a daemon that starts meanwhile puts another in its place. Raises BadInput."""
    try:
        with open_file(path) as stream:
            require_size(path, stream, _MOST_BYTES)
            mark = validate(json.loads(stream.read()), _Mark, str(path))
            if mark.running_since_ns is None:
                return _Told(mark.abrupt_ends)
            state = os.fstat(stream.fileno())
            if is_locked(stream.fileno()):
                return _Told(mark.abrupt_ends, alive=True)
            if mark.inode not in (None, state.st_ino):
                return _Told(mark.abrupt_ends)
            if path.stat().st_ino != state.st_ino:  # its run ended meanwhile, and said so in the next file
                return _read(path, now_ns)
            seen_ns = max(mark.running_since_ns, state.st_mtime_ns)
    except OSError as error:
        raise unreadable(path, error) from None
    except ValueError as error:
        raise BadInput(str(path), f"no JSON document ({error})", _ALLOWED) from None
    return _Told(mark.abrupt_ends, AbruptEnd(seen_ns=seen_ns, found_ns=max(seen_ns, now_ns)))
