"""Any bus that python-can opens, as a servod Bus: for adapters without SocketCAN, and for python-can's own virtual bus.

No Notifier and no periodic tasks: frames are read and sent where they are asked for. Time stamps are local
(CLOCK_MONOTONIC at reception in this process), because the adapters' clocks have no common origin.

What an error frame says is the adapter's own: only two interfaces hand the kernel's through, of the others the
controller's state is asked, where python-can can ask it.
"""

from __future__ import annotations

import errno
import time
from typing import Any

import can

from servod.common.errors import Unreachable
from servod.formats.config_wire import BusConfig
from servod.runtime.fieldbus.bus import BusCounters, Frame
from servod.runtime.fieldbus.bus.socketcan import count_error_frame

_SEND_AT_ONCE = 0.0  # python-can: do not wait for room in the queue
#: Interfaces whose error frames are those of linux/can/error.h (gs_usb's firmware speaks that format).
_KERNEL_ERROR_FRAMES = ("socketcan", "gs_usb")
_DOWN = (errno.ENETDOWN, errno.ENODEV, errno.ENXIO)


class PythonCanBus:
    """servod.runtime.fieldbus.bus.Bus over a `can.BusABC` that it owns; `kernel_errors`: its error frames are
    linux/can/error.h's."""

    def __init__(self, bus: can.BusABC, kernel_errors: bool) -> None:
        self.counters = BusCounters()
        self._bus = bus
        self._kernel_errors = kernel_errors

    @classmethod
    def configured(cls, config: BusConfig, can_ids: tuple[int, ...] | None = None) -> PythonCanBus:
        """The bus that a configuration names; python-can filters nothing for us. Raises Unreachable."""
        return cls.open(config.interface, config.channel, config.bit_rate, config.options)

    @classmethod
    def open(cls, interface: str, channel: str, bit_rate: int, options: dict[str, Any]) -> PythonCanBus:
        """Open by python-can's names; raises Unreachable with its reason in one line."""
        try:
            bus = can.Bus(interface=interface, channel=channel, bitrate=bit_rate, **options)
        except (can.CanError, OSError, ImportError, TypeError, ValueError, NotImplementedError) as error:
            reason = " ".join(str(error).split())
            raise Unreachable(f"bus {channel} by python-can interface {interface!r}: {reason}") from error
        return cls(bus, interface in _KERNEL_ERROR_FRAMES)

    def send(self, can_id: int, data: bytes) -> bool:
        """Queue one frame; False and counted when the queue is full, the adapter down or the controller bus-off."""
        counters = self.counters
        if counters.bus_off:
            self._ask_state()  # nobody else says that the controller is back
            if counters.bus_off:
                return False
        message = can.Message(arbitration_id=can_id, data=data, is_extended_id=False, check=False)
        try:
            self._bus.send(message, timeout=_SEND_AT_ONCE)
        except (can.CanError, OSError) as error:
            self._count_refusal(error)
            return False
        counters.sent += 1
        counters.down = False
        return True

    def _count_refusal(self, error: Exception) -> None:
        """Why a frame was not taken: the controller is off, the interface down, or there is no room."""
        self._ask_state()
        if self.counters.bus_off:
            return
        if isinstance(error, can.CanOperationError) and error.error_code not in _DOWN:
            self.counters.queue_full += 1
        else:
            self.counters.set_down()

    def _ask_state(self) -> None:
        """The controller's state by python-can. Its PASSIVE is listen-only for some adapters, so only ERROR counts."""
        if self._kernel_errors:
            return  # python-can says ACTIVE of these always; their error frames say more
        try:
            off = self._bus.state is can.BusState.ERROR
        except (can.CanError, OSError):
            self.counters.set_down()
            return
        if off:
            self.counters.set_bus_off()
        else:
            self.counters.bus_off = False

    def receive(self, timeout_s: float = 0.0) -> Frame | None:
        """The next data frame with an 11-bit identifier; remote and error frames never come out."""
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                message = self._bus.recv(max(0.0, deadline - time.monotonic()))
            except (can.CanError, OSError):
                self.counters.set_down()
                return None
            if message is None:
                return None
            if message.is_error_frame:
                self._take_error(message)
            elif not message.is_remote_frame and not message.is_extended_id:
                self.counters.received += 1
                return Frame(message.arbitration_id, bytes(message.data), time.monotonic_ns())

    def _take_error(self, message: can.Message) -> None:
        if self._kernel_errors:
            count_error_frame(self.counters, message.arbitration_id, bytes(message.data))
        else:
            self.counters.error_frames += 1
            self._ask_state()

    def fileno(self) -> int:
        """python-can's descriptor, -1 when the interface has none."""
        try:
            return int(self._bus.fileno())
        except NotImplementedError:
            return -1

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()
