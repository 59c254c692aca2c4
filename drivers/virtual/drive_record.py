"""The drive's own record: what the virtual drive did, in a mapped file that outlives any kill.

Written by the amplifier node, read by tests and people who want to know how the axis stopped. The file is a ring of
fixed-size samples behind one header; the kernel owns the pages, so `kill -9` of the virtual axis loses nothing.
"""

from __future__ import annotations

import mmap
import os
import struct
from io import BufferedRandom
from pathlib import Path
from typing import NamedTuple

from servod.common.errors import BadInput
from servod.common.files import unreadable, unwritable
from servod.runtime.fieldbus.devices import DriveState

#: magic, size of a sample, capacity in samples, samples written since the start
_HEADER = struct.Struct("<8sIIQ")
_COUNT = struct.Struct("<Q")
_COUNT_OFFSET = _HEADER.size - _COUNT.size
_MAGIC = b"svdrive1"
#: One sample, fields of DriveSample.
SAMPLE = struct.Struct("<qHHHhdddd")
#: Ten minutes at 1 kHz.
CAPACITY = 600_000


class DriveSample(NamedTuple):
    """The drive at one moment; torque in N*m, position and velocity of the true joint."""

    time_ns: int
    state: DriveState
    status_word: int
    control_word: int
    mode: int
    torque_demand_nm: float
    torque_nm: float
    position_rad: float
    velocity_rad_s: float


class DriveRecord:
    """Writer of the record at `path`, which is made again. Raises BadInput when it cannot be written."""

    def __init__(self, path: str | Path, capacity: int = CAPACITY) -> None:
        size = _HEADER.size + capacity * SAMPLE.size
        try:
            with Path(path).open("wb+") as file:
                _reserve(file, size)
                self._map = mmap.mmap(file.fileno(), size)
        except OSError as error:
            raise unwritable(path, error) from None
        self._capacity, self._count = capacity, 0
        self._map[: _HEADER.size] = _HEADER.pack(_MAGIC, SAMPLE.size, capacity, 0)

    def write(self, sample: tuple[int, int, int, int, int, float, float, float, float]) -> None:
        """Append one sample (fields of DriveSample): first the sample, then the count that makes it valid."""
        offset = _HEADER.size + self._count % self._capacity * SAMPLE.size
        SAMPLE.pack_into(self._map, offset, *sample)
        self._count += 1
        _COUNT.pack_into(self._map, _COUNT_OFFSET, self._count)

    def close(self) -> None:
        """Unmap; the file keeps everything."""
        self._map.close()


def _reserve(file: BufferedRandom, size: int) -> None:
    """Take the room now: a page of the map that finds none later ends the process with SIGBUS."""
    try:
        os.posix_fallocate(file.fileno(), 0, size)
    except OSError:
        Path(file.name).unlink()
        raise


class DriveTail:
    """Follows the record at `path` while it is written; `lost` counts samples that the ring had overwritten."""

    def __init__(self, path: str | Path) -> None:
        with Path(path).open("rb") as file:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self._taken = self.lost = 0

    def take(self) -> bytes:
        """All samples since the last call, back to back, fields of DriveSample as in SAMPLE."""
        _, size, capacity, count = _HEADER.unpack_from(self._map)
        first = max(self._taken, count - capacity)
        self.lost += first - self._taken
        self._taken = count
        begin, end = first % capacity, count % capacity
        if first == count:
            return b""
        data = memoryview(self._map)[_HEADER.size :]
        if begin < end:
            return bytes(data[begin * size : end * size])
        return bytes(data[begin * size : capacity * size]) + bytes(data[: end * size])

    def close(self) -> None:
        """Unmap."""
        self._map.close()


def read_drive_record(path: str | Path) -> list[DriveSample]:
    """All samples that the ring still holds, oldest first; also while it is being written. Raises BadInput."""
    try:
        raw = Path(path).read_bytes()
    except OSError as error:
        raise unreadable(path, error) from None
    if len(raw) < _HEADER.size or not raw.startswith(_MAGIC):
        raise BadInput(str(path), "no drive record", "a file written by servod-virtual-axis --record")
    _, size, capacity, count = _HEADER.unpack_from(raw)
    if size != SAMPLE.size or len(raw) != _HEADER.size + capacity * size:
        raise BadInput(str(path), f"{len(raw)} bytes", "a complete drive record of this version")
    numbers = range(max(0, count - capacity), count)
    rows = (SAMPLE.unpack_from(raw, _HEADER.size + n % capacity * size) for n in numbers)
    return [DriveSample(time, DriveState(state), *rest) for time, state, *rest in rows]
