"""Any bus that python-can opens, as a servod Bus: for adapters without SocketCAN, and for python-can's own virtual bus.

No Notifier and no periodic tasks: frames are read and sent where they are asked for. Time stamps are local
(CLOCK_MONOTONIC at reception in this process), because the adapters' clocks have no common origin.
"""

from __future__ import annotations

import time
from typing import Any

import can

from servod.bus import BusCounters, Frame
from servod.errors import Unreachable

_SEND_AT_ONCE = 0.0  # python-can: do not wait for room in the queue


class PythonCanBus:
    """servod.bus.Bus over a `can.BusABC` that it owns."""

    def __init__(self, bus: can.BusABC) -> None:
        self.counters = BusCounters()
        self._bus = bus

    @classmethod
    def open(cls, interface: str, channel: str, bit_rate: int, options: dict[str, Any]) -> PythonCanBus:
        """Open by python-can's names; raises Unreachable with its reason in one line."""
        try:
            bus = can.Bus(interface=interface, channel=channel, bitrate=bit_rate, **options)
        except (can.CanError, OSError, ImportError, TypeError, ValueError, NotImplementedError) as error:
            reason = " ".join(str(error).split())
            raise Unreachable(f"bus {channel} by python-can interface {interface!r}: {reason}") from error
        return cls(bus)

    def send(self, can_id: int, data: bytes) -> bool:
        """Queue one frame; False and counted when python-can cannot take it now."""
        message = can.Message(arbitration_id=can_id, data=data, is_extended_id=False, check=False)
        try:
            self._bus.send(message, timeout=_SEND_AT_ONCE)
        except can.CanOperationError:
            self.counters.queue_full += 1
            return False
        except (can.CanError, OSError):
            self.counters.down = True
            return False
        self.counters.sent += 1
        return True

    def receive(self, timeout_s: float = 0.0) -> Frame | None:
        """The next data frame with an 11-bit identifier; remote and error frames never come out."""
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                message = self._bus.recv(max(0.0, deadline - time.monotonic()))
            except (can.CanError, OSError):
                self.counters.down = True
                return None
            if message is None:
                return None
            if message.is_error_frame:
                self.counters.error_frames += 1
            elif not message.is_remote_frame and not message.is_extended_id:
                self.counters.received += 1
                return Frame(message.arbitration_id, bytes(message.data), time.monotonic_ns())

    def fileno(self) -> int:
        """python-can's descriptor, -1 when the interface has none."""
        try:
            return int(self._bus.fileno())
        except NotImplementedError:
            return -1

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()
