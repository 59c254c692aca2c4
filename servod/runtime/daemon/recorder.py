"""The recorder: every cycle to a file on demand, and the last seconds before a fault without being asked.

Beside the loop, fed by the supervisor with the records it drained. All file work happens in one thread of its own, so
that a slow or full disk never holds up the supervisor; the way there is a bounded queue, and what does not fit is
dropped, counted and reported as RECORDER_FAILED.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import queue
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from datetime import datetime
from pathlib import Path
from typing import Any, TypedDict, TypeVar

from servod.common.errors import BadInput, ServodError, Unreachable
from servod.common.files import make_folder, reason, refusal_of
from servod.formats.config import RecorderConfig
from servod.formats.recording.mcap_writer import McapFile, split_rows, wall_offset_ns
from servod.formats.recording.record import RECORD

log = logging.getLogger("servod.recorder")

# --- Files and names -------------------------------------------------------------------------------------------------
# Where recordings stand and how many of them: names, rotation, what is removed and when. Below the recorder, in its
# writing thread, so that a slow disk holds up nobody.


MIB = 1024 * 1024
_DAY_S = 86400.0
#: A recording goes on in a new file at this share of all, so that the oldest can go while the newest is written.
_PART_SHARE = 4
#: Names are shown in logs, on terminals and on pages: nothing in them may act there, or look like an option.
_FILE_NAME = re.compile(r"\w[\w .,+()-]{0,200}\.mcap")
_STAMP = "%Y%m%d-%H%M%S"


class RecordingFiles:
    """The recordings' directory of one axis."""

    def __init__(self, config: RecorderConfig, axis_name: str) -> None:
        self._directory, self._axis_name = config.directory, axis_name
        self._max_fault_files, self._max_age_days = config.max_fault_files, config.max_age_days
        axis = re.escape(axis_name)
        self._fault_name = re.compile(rf"{axis}-fault-\d{{8}}-\d{{6}}-\w+(-\d+)?\.mcap")
        self._like_own = re.compile(rf"{axis}-(fault-)?\d{{8}}-\d{{6}}")
        self._own_name = re.compile(rf"{axis}-\d{{8}}-\d{{6}}(-\d+)?\.mcap")
        self._max_total_bytes = config.max_total_mib * MIB
        self.max_bytes = min(config.max_file_mib * MIB, self._max_total_bytes // _PART_SHARE)
        self.total_bytes = self.removed = 0

    def refusal(self) -> str:
        """Why no file can be written in the directory, which is made; empty where one can."""
        return refusal_of(self._directory)

    def recording(self, name: str | None) -> Path:
        """A path in the directory, and nowhere else: clients must not write where they please. Raises BadInput."""
        if name is None:
            return self._unused(f"{self._axis_name}-{_now()}")
        path = (self._directory / name.replace("\0", "/")).resolve()  # a zero byte is in no name of a file
        if path.parent != self._directory.resolve() or not _FILE_NAME.fullmatch(path.name):
            allowed = "a file name that ends in .mcap, of letters, digits, _ and, not first, spaces and . , + ( ) -, in"
            raise BadInput("record_start: path", repr(name), f"{allowed} {self._directory}")
        if self._like_own.match(path.name):
            # It would count as one of those that make room, and push the seconds before a real fault out.
            raise BadInput("record_start: path", repr(name), "a name that servod does not give its own files")
        return path

    def next_part(self, first: Path, number: int) -> Path:
        """Where a recording goes on that began in `first`: the same name with this number, or the next that is free.

        Never with a smaller one that has become free: the parts stay in their order.
        """
        return self._unused(first.stem, number)

    def fault(self, label: str) -> Path:
        """A new path for the seconds before a fault."""
        return self._unused(f"{self._axis_name}-fault-{_now()}-{label}")

    def make_room(self, writing: Path | None = None) -> None:
        """Remove the oldest of what is beyond recorder.max_fault_files, max_age_days and max_total_mib.

        Only files that servod named itself: whoever wants one for good copies it. `writing` stays, and has room to
        become a full part; so do the newest fault files, however old they are.
        """
        faults, others = self._found(self._fault_name), self._found(self._own_name)
        part = others.pop(writing, None) if writing else None
        for path in list(faults)[: -self._max_fault_files]:
            self._remove(path, "recorder.max_fault_files")
            del faults[path]
        oldest_s = time.time() - (self._max_age_days or 0.0) * _DAY_S
        left = sum(state.st_size for state in (*faults.values(), *others.values()))
        most = self._max_total_bytes - (self.max_bytes if part else 0)
        for path, state in others.items():
            too_old = self._max_age_days is not None and state.st_mtime < oldest_s
            if too_old or left > most:
                self._remove(path, "recorder.max_age_days" if too_old else "recorder.max_total_mib")
                left -= state.st_size
        self.total_bytes = left + (part.st_size if part else 0)

    def _found(self, name: re.Pattern[str]) -> dict[Path, os.stat_result]:
        """The files of such a name, the oldest first."""
        found = {}
        for path in self._directory.glob("*.mcap"):
            with contextlib.suppress(OSError):  # somebody removed it meanwhile
                if name.fullmatch(path.name):
                    found[path] = path.stat()
        return dict(sorted(found.items(), key=lambda entry: entry[1].st_mtime_ns))

    def _remove(self, path: Path, key: str) -> None:
        try:
            path.unlink()
        except OSError as error:
            log.warning("%s: cannot be removed (%s)", path, reason(error))
        else:
            self.removed += 1
            log.info("%s removed: it was the oldest beyond %s", path, key)

    def _unused(self, stem: str, number: int = 1) -> Path:
        while (path := self._directory / (f"{stem}-{number}.mcap" if number > 1 else f"{stem}.mcap")).exists():
            number += 1
        return path


def _now() -> str:
    return datetime.now().astimezone().strftime(_STAMP)


# --- The last seconds ------------------------------------------------------------------------------------------------
# The last seconds of cycle records in a ring of fixed memory, so that a fault's recording starts before the fault.
# Filled by the supervisor, read when a fault file is written.


class HistoryRing:
    """The newest `capacity` packed records; all memory is taken at the start and never grows.

    `added` counts all that ever came: it is the serial number of the newest.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._data = bytearray(b"\xff") * (
            capacity * RECORD.size
        )  # written, so that the pages are resident from now on
        self._next = 0
        self._count = 0
        self.added = 0

    def __len__(self) -> int:
        return self._count

    def add(self, rows: Iterable[bytes]) -> None:
        """Add records, oldest first; the oldest in the ring make room."""
        if self.capacity == 0:
            return
        size, data, capacity, at, count = RECORD.size, self._data, self.capacity, self._next, self._count
        for row in rows:
            data[at * size : (at + 1) * size] = row
            at += 1
            count += 1
            if at == capacity:
                at = 0
        self.added += count - self._count
        self._next, self._count = at, min(count, capacity)

    def newest(self, most: int) -> bytes:
        """A copy of the newest records, at most so many, oldest first."""
        return self._piece(self._count - min(most, self._count), self._count)

    def after(self, serial: int, most: int) -> tuple[int, bytes]:
        """The oldest records behind that with this serial number, at most so many, and the number of the last of them.

        What has left the ring is left out: the caller sees it in the number.
        """
        oldest = self.added - self._count
        first = min(max(serial, oldest), self.added)
        last = min(first + most, self.added)
        return last, self._piece(first - oldest, last - oldest)

    def _piece(self, first: int, last: int) -> bytes:
        """Records by their place in the ring, the oldest being 0."""
        if first == last:
            return b""
        size, capacity = RECORD.size, self.capacity
        begin = (self._next - self._count + first) % capacity
        end = begin + last - first
        if end <= capacity:
            return bytes(self._data[begin * size : end * size])
        return bytes(self._data[begin * size :]) + bytes(self._data[: (end - capacity) * size])


T = TypeVar("T")

#: A file on disk is never older than this and what the disk takes to sync: kill -9 and power cuts lose no more.
SYNC_PERIOD_S = 0.5
_ROOM_PERIOD_S = 60.0
_QUEUE_BATCHES = 1024
#: A client that reads along may be late by this, however short the history is that fault files get.
_LOOK_BACK_S = 2.0
_KEPT_EVENTS = 256


class RecorderState(TypedDict):
    """What is being recorded: the file written now, and how much in all its parts; `failure` is empty while all is
    well, `dropped` goes on counting after one. Of the folder: bytes of what servod named itself, how many it removed.
    """

    recording: bool
    path: str
    records: int
    bytes: int
    dropped: int
    history_s: float
    failure: str
    total_bytes: int
    removed: int


class Recorder:
    """Recordings of one axis; all methods are for the supervisor's thread and return at once."""

    def __init__(self, config: RecorderConfig, axis_name: str, period_us: int) -> None:
        self._files, self._history_s = RecordingFiles(config, axis_name), config.history_s
        self._history_cycles = round(config.history_s * 1e6 / period_us)
        self._history = HistoryRing(max(self._history_cycles, round(_LOOK_BACK_S * 1e6 / period_us)))
        self._events: deque[dict[str, Any]] = deque(maxlen=_KEPT_EVENTS)
        self._attachments: dict[str, bytes] = {}
        self._attached: dict[str, bytes] = {}  # the same, in the writing thread
        self._offset_ns = wall_offset_ns()
        self._file: McapFile | None = None
        self._first_part, self._parts, self._full_records, self._full_bytes = Path(), 1, 0, 0
        self._path, self._records, self._bytes = "", 0, 0
        #: Cycles for which the queue had no room; those that the writing thread was given, and those that no file took.
        self._dropped, self._given, self._lost = 0, 0, 0
        self._failure, self._new_failure = "", ""
        self._broken = False  # a recording failed, and nobody has asked for its end or another yet
        self._jobs: queue.Queue[Callable[[], None] | None] = queue.Queue(_QUEUE_BATCHES)
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        self._thread.start()

    # --- supervisor's thread -------------------------------------------------------------------------------------
    def add_rows(self, rows: Sequence[bytes]) -> None:
        """Take packed cycle records, oldest first: into the history, and into the file when one is open."""
        self._history.add(rows)
        if not rows or (self._file is None and not self._broken):
            return
        if self._broken:
            self._dropped += len(rows)
        elif not self._put(lambda: self._write_rows(rows)):
            self._dropped += len(rows)
            self._fail("the disk does not keep up; cycles were dropped")

    def add_event(self, kind: str, text: str, **details: Any) -> None:
        """Note something that happened (fault, command, node event); kept for fault files too."""
        event = {"time_ns": time.monotonic_ns(), "kind": kind, "text": text, **details}
        self._events.append(event)
        if not self._put(lambda: self._write_event(event)):
            self._fail("the disk does not keep up; an event was dropped")

    def set_attachment(self, name: str, data: bytes) -> None:
        """Attach a file (config.yaml, gains.yaml, model.yaml) to every recording, the running one included."""
        self._attachments[name] = data
        if not self._put(lambda: self._attach(name, data)):
            self._fail(f"the disk does not keep up; {name} was dropped")

    def try_folder(self) -> None:
        """Fail at once where no file can be written, not first when the seconds before a fault are lost."""
        self._put(lambda: self._fail(text) if (text := self._files.refusal()) else None)

    def start(self, name: str | None = None) -> Future[Path]:
        """Begin a recording in the configured directory; the future gives its path, or BadInput or Unreachable."""
        attachments = dict(self._attachments)
        return self._ask(lambda: self._open(self._files.recording(name), attachments))

    def stop(self) -> Future[RecorderState]:
        """End the recording; the future gives what was written."""
        return self._ask(self._stop)

    def write_fault_file(self, label: str) -> Future[Path]:
        """Write the history, and the events so far, to a file of their own named after `label`."""
        rows, events, attachments = (
            self._history.newest(self._history_cycles),
            list(self._events),
            dict(self._attachments),
        )
        return self._ask(lambda: self._write_history(label, rows, events, attachments))

    @property
    def newest_cycle(self) -> int:
        """Serial number of the newest cycle record."""
        return self._history.added

    def cycles_after(self, serial: int, most: int) -> tuple[int, bytes]:
        """Packed records from memory: HistoryRing.after."""
        return self._history.after(serial, most)

    def take_failure(self) -> str:
        """Why recording failed since the last call; empty when it did not."""
        failure, self._new_failure = self._new_failure, ""
        return failure

    def state(self) -> RecorderState:
        """What `status` shows."""
        return {
            "recording": self._file is not None,
            "path": self._path,
            "records": self._records,
            "bytes": self._bytes,
            "dropped": self._dropped + self._lost,
            "history_s": self._history_s,
            "failure": self._failure,
            "total_bytes": self._files.total_bytes,
            "removed": self._files.removed,
        }

    def close(self, timeout_s: float = 2.0) -> None:
        """Finish what is queued and close the file; gives up on a disk that hangs after `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while not self._put(None) and time.monotonic() < deadline:
            time.sleep(0.01)
        self._thread.join(max(0.0, deadline - time.monotonic()))

    def _put(self, job: Callable[[], None] | None) -> bool:
        try:
            self._jobs.put_nowait(job)
        except queue.Full:
            return False
        return True

    def _ask(self, job: Callable[[], T]) -> Future[T]:
        future: Future[T] = Future()
        if not self._put(lambda: _resolve(future, job)):
            future.set_exception(Unreachable("recorder: the disk does not keep up"))
        return future

    def _fail(self, text: str) -> None:
        if text != self._failure:
            self._failure = self._new_failure = text

    # --- writing thread ------------------------------------------------------------------------------------------
    def _work(self) -> None:
        synced, room = time.monotonic(), -math.inf
        while True:
            if time.monotonic() - room >= _ROOM_PERIOD_S:
                self._guard(self._make_room)
                room = time.monotonic()
            try:
                job = self._jobs.get(timeout=SYNC_PERIOD_S)
            except queue.Empty:
                job = _nothing
            if job is None:
                break
            self._guard(job)
            if time.monotonic() - synced >= SYNC_PERIOD_S:
                self._guard(self._sync)
                synced = time.monotonic()
        self._guard(self._finish)

    def _guard(self, job: Callable[[], None]) -> None:
        """Run one job; whatever fails ends the recording, never the thread."""
        try:
            job()
        except Exception as error:
            if not isinstance(error, OSError | ValueError):
                log.exception("the recorder failed in a way that nobody expected")
            self._fail(f"{self._path or 'recorder'}: {getattr(error, 'strerror', None) or str(error) or repr(error)}")
            if self._file is not None:
                self._give_up(self._file)

    def _give_up(self, file: McapFile) -> None:
        """End a recording whose file takes no more: count what is in it, and what is not."""
        self._broken, self._file = True, None
        self._records = self._full_records + file.abandon()
        self._lost = self._given - self._records

    def _make_room(self) -> None:
        self._files.make_room(None if self._file is None else self._file.path)

    def _write_rows(self, rows: Sequence[bytes]) -> None:
        if self._file is not None:
            self._given += len(rows)
            self._file.write_rows(rows)
            if self._file.size_bytes() >= self._files.max_bytes:  # however much comes between two syncs
                self._sync()
        elif self._broken:
            self._lost += len(rows)

    def _write_event(self, event: dict[str, Any]) -> None:
        if self._file is not None:
            self._file.write_event(event)

    def _attach(self, name: str, data: bytes) -> None:
        self._attached[name] = data
        if self._file is not None:
            self._file.attach(name, data)

    def _sync(self) -> None:
        if self._file is not None:
            self._file.sync()
            size = self._file.size_bytes()
            self._records, self._bytes = self._full_records + self._file.records, self._full_bytes + size
            if size >= self._files.max_bytes:
                self._go_on_in_a_new_file(self._file)

    def _go_on_in_a_new_file(self, full: McapFile) -> None:
        full.close()
        self._full_records, self._full_bytes = self._records, self._full_bytes + full.path.stat().st_size
        self._parts += 1
        path = self._files.next_part(self._first_part, self._parts)
        try:
            make_folder(path.parent)
            self._file = McapFile(path, self._attached, self._offset_ns)
        except OSError:  # what is full is whole: it is only that the recording does not go on
            self._broken, self._file = True, None
            raise
        self._path = str(path)
        self._make_room()

    def _finish(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def _open(self, path: Path, attachments: dict[str, bytes]) -> Path:
        if self._file is not None:
            raise Unreachable(f"recorder: already records to {self._path}; `servoctl record stop` ends it")
        self._file = _create(path, attachments, self._offset_ns)
        self._first_part, self._parts, self._full_records, self._full_bytes = path, 1, 0, 0
        self._path, self._records, self._bytes, self._failure = str(path), 0, 0, ""
        self._dropped, self._given, self._lost, self._broken = 0, 0, 0, False
        self._make_room()
        return path

    def _stop(self) -> RecorderState:
        if self._broken:
            self._broken = False
            raise Unreachable(f"recorder: the recording had failed: {self._failure}")
        try:
            self._sync()
            self._finish()
        except OSError:
            if self._file is not None:
                self._give_up(self._file)  # before the answer goes out: who asked may look at the state at once
            raise
        return self.state()

    def _write_history(
        self, label: str, rows: bytes, events: list[dict[str, Any]], attachments: dict[str, bytes]
    ) -> Path:
        path = self._files.fault(label)
        file = _create(path, attachments, self._offset_ns)
        try:
            file.write_rows(split_rows(rows))
            for event in events:
                file.write_event(event)
            file.close()
        except OSError as error:
            file.abandon()
            raise Unreachable(f"{path}: cannot be written ({reason(error)})") from None
        except Exception:
            file.abandon()
            raise
        self._make_room()
        return path


def _create(path: Path, attachments: dict[str, bytes], offset_ns: int) -> McapFile:
    try:
        make_folder(path.parent)
        return McapFile(path, attachments, offset_ns)
    except OSError as error:
        raise Unreachable(f"{path}: cannot be written ({reason(error)})") from None


def _resolve(future: Future[T], job: Callable[[], T]) -> None:
    if not future.set_running_or_notify_cancel():
        return  # who asked has gone
    try:
        future.set_result(job())
    except ServodError as error:
        future.set_exception(error)
    except OSError as error:
        future.set_exception(Unreachable(f"recorder: {error.filename or 'disk'}: {reason(error)}"))
        raise
    except Exception as error:
        future.set_exception(Unreachable(f"recorder: {str(error) or repr(error)}"))
        raise


def _nothing() -> None:
    """Stands for a job when the queue was empty."""
