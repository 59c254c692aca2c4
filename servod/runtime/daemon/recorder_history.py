"""The last seconds of cycle records in a ring of fixed memory, so that a fault's recording starts before the fault.

Filled by the supervisor, read when a fault file is written.
"""

from __future__ import annotations

from collections.abc import Iterable

from servod.formats.recording.record import RECORD


class HistoryRing:
    """The newest `capacity` packed records; all memory is taken at the start and never grows."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._data = bytearray(b"\xff") * (
            capacity * RECORD.size
        )  # written, so that the pages are resident from now on
        self._next = 0
        self._count = 0

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
        self._next, self._count = at, min(count, capacity)

    def snapshot(self) -> bytes:
        """A copy of all records, oldest first."""
        size = RECORD.size
        if self._count < self.capacity:
            return bytes(self._data[: self._count * size])
        cut = self._next * size
        return bytes(self._data[cut:]) + bytes(self._data[:cut])
