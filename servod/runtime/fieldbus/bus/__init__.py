"""CAN frames in and out: one small protocol over raw AF_CAN, the virtual bus and any bus that python-can opens.

Stands on errors alone. A frame travels as the kernel's 16-byte `struct can_frame` (linux/can.h), on SocketCAN and the
virtual bus alike, so that both are the same few lines of socket code.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple, Protocol

#: linux/can.h: struct can_frame { u32 can_id; u8 len; u8 pad[3]; u8 data[8]; }
CAN_FRAME = struct.Struct("<IB3x8s")
CAN_ERR_FLAG = 0x20000000  # error frame (linux/can/error.h)
CAN_RTR_FLAG = 0x40000000
CAN_EFF_FLAG = 0x80000000
CAN_ERR_CRTL = 0x004
CAN_ERR_BUSOFF = 0x040
CAN_ERR_RESTARTED = 0x100


class Frame(NamedTuple):
    """One received frame. `can_id` carries the kernel's flags; `time_ns` is CLOCK_MONOTONIC on a wall-clock bus."""

    can_id: int
    data: bytes
    time_ns: int


@dataclass(slots=True)
class BusCounters:
    """What went wrong on this connection since it was opened.

    The booleans are the state now; the event counts only grow, so that whoever looks once per cycle misses nothing that
    came and went in between.
    """

    sent: int = 0
    received: int = 0
    queue_full: int = 0  # frames that could not be queued (ENOBUFS, EAGAIN)
    error_frames: int = 0
    bus_off: bool = False
    error_passive: bool = False
    down: bool = False
    bus_off_events: int = 0  # how often bus_off became true
    down_events: int = 0  # how often down became true

    def set_bus_off(self) -> None:
        """The controller left the bus (or never was on it)."""
        if not self.bus_off:
            self.bus_off_events += 1
        self.bus_off = True

    def set_down(self) -> None:
        """The interface, the hub or the adapter does not answer."""
        if not self.down:
            self.down_events += 1
        self.down = True


class Bus(Protocol):
    """One connection to one CAN bus. Not thread-safe: each process and thread opens its own."""

    counters: BusCounters

    def send(self, can_id: int, data: bytes) -> bool:
        """Queue one frame without ever blocking; False (and counted) when the queue is full or the bus off or down."""
        ...

    def receive(self, timeout_s: float = 0.0) -> Frame | None:
        """The next frame, waiting up to `timeout_s`; None when none came. Error frames only change the counters."""
        ...

    def fileno(self) -> int:
        """File descriptor for select, or -1 when this bus has none (in-process)."""
        ...

    def close(self) -> None:
        """Leave the bus."""
        ...
