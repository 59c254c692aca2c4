"""SocketCAN by a raw AF_CAN socket: what the loop uses on real hardware and on vcan. Step (1) of the cycle.

Sending never blocks. Trouble is a state in the counters, never an exception in the cycle: a full queue, an interface
that is down, a controller that is bus-off. Time stamps are the kernel's software stamps (SO_TIMESTAMPNS, taken when the
driver hands the frame up, CLOCK_REALTIME), moved to CLOCK_MONOTONIC by the offset between the clocks. That offset is
measured at each stamp's age, so a step of the wall clock shifts at most the frames that are in flight; a stamp that
does not lie in the last second is replaced by the local time.
"""

from __future__ import annotations

import errno
import select
import socket
import struct
import time

from servod.common.errors import Unreachable
from servod.common.files import reason
from servod.common.units import NS_PER_S
from servod.formats.config_wire import BusConfig
from servod.runtime.fieldbus.bus import (
    CAN_EFF_FLAG,
    CAN_ERR_BUSOFF,
    CAN_ERR_CRTL,
    CAN_ERR_FLAG,
    CAN_ERR_RESTARTED,
    CAN_FRAME,
    CAN_RTR_FLAG,
    BusCounters,
    Frame,
)

# --- Error frames ----------------------------------------------------------------------------------------------------
# What error frames mean for a connection: one table from the kernel's error classes to BusCounters. Used by every bus
# client that receives `struct can_frame` (SocketCAN and the virtual bus). Source: linux/can/error.h.


_CRTL_TX_OVERFLOW = 0x02
_CRTL_PASSIVE = 0x10 | 0x20  # reception, transmission
_CRTL_ACTIVE = 0x40
#: Error classes that servod wants from the kernel: all of them.
CAN_ERR_MASK = 0x1FFFFFFF


def count_error_frame(counters: BusCounters, can_id: int, data: bytes) -> None:
    """Take one error frame (CAN_ERR_FLAG set) into the counters; data[1] is the controller's state (CAN_ERR_CRTL)."""
    counters.error_frames += 1
    if can_id & CAN_ERR_BUSOFF:
        counters.set_bus_off()
    if can_id & CAN_ERR_RESTARTED:  # the controller came back by restart-ms; a fault has been shown by then
        counters.bus_off = False
        counters.error_passive = False
    if can_id & CAN_ERR_CRTL and len(data) > 1:
        if data[1] & _CRTL_PASSIVE:
            counters.error_passive = True
        elif data[1] & _CRTL_ACTIVE:
            counters.error_passive = False
        if data[1] & _CRTL_TX_OVERFLOW:
            counters.queue_full += 1


_SO_TIMESTAMPNS = 35  # asm-generic/socket.h; not in Python's socket module
_CAN_RAW_ERR_FILTER = 2  # linux/can/raw.h; not in Python's socket module everywhere
_TIMESPEC = struct.Struct("@ll")
_ANCILLARY_BYTES = socket.CMSG_SPACE(_TIMESPEC.size)
_QUEUE_FULL = (errno.ENOBUFS, errno.EAGAIN)
#: At most this many filters go to the kernel; its own limit is 512 (CAN_RAW_FILTER_MAX).
_MAX_FILTERS = 512


def pack_filters(can_ids: tuple[int, ...]) -> bytes:
    """CAN_RAW_FILTER for exactly these 11-bit identifiers, data frames only."""
    mask = 0x7FF | CAN_EFF_FLAG | CAN_RTR_FLAG
    return b"".join(struct.pack("=II", can_id, mask) for can_id in can_ids[:_MAX_FILTERS])


def open_raw(interface: str, can_ids: tuple[int, ...] | None) -> socket.socket:
    """A bound CAN_RAW socket with error frames, time stamps and filters; raises Unreachable in one line."""
    try:
        sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except OSError as error:
        raise Unreachable(f"bus {interface}: this system has no SocketCAN ({reason(error)})") from error
    try:
        sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, CAN_ERR_MASK)
        if can_ids is not None:
            sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, pack_filters(can_ids))
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        sock.bind((interface,))
    except OSError as error:
        sock.close()
        raise Unreachable(f"bus {interface}: {reason(error)}; is the interface there and up?") from error
    return sock


class SocketCanBus:
    """servod.runtime.fieldbus.bus.Bus on a bound socket that carries `struct can_frame`; it owns the socket.

    `open` makes it on an interface such as can0 or vcan0.
    """

    def __init__(self, sock: socket.socket) -> None:
        self.counters = BusCounters()
        self._socket = sock
        self._newest_ns = 0
        sock.setblocking(False)
        self._poll = select.poll()
        self._poll.register(sock, select.POLLIN)

    @classmethod
    def configured(cls, config: BusConfig, can_ids: tuple[int, ...] | None = None) -> SocketCanBus:
        """The bus that a configuration names; the kernel filters. Raises Unreachable."""
        return cls.open(config.channel, can_ids)

    @classmethod
    def open(cls, interface: str, can_ids: tuple[int, ...] | None = None) -> SocketCanBus:
        """Open an interface; `can_ids` limits reception in the kernel. Raises Unreachable."""
        return cls(open_raw(interface, can_ids))

    def send(self, can_id: int, data: bytes) -> bool:
        """Queue one frame; False and counted when the queue is full, the interface down or the controller bus-off."""
        counters = self.counters
        if counters.bus_off:  # frames would wait in the queue and go out stale after a restart
            return False
        try:
            self._socket.send(CAN_FRAME.pack(can_id, len(data), data))
        except OSError as error:
            if error.errno in _QUEUE_FULL:
                counters.queue_full += 1
            else:
                counters.set_down()
            return False
        counters.sent += 1
        counters.down = False  # the interface takes frames again
        return True

    def receive(self, timeout_s: float = 0.0) -> Frame | None:
        """The next data frame, waiting up to `timeout_s`; error frames only change the counters."""
        deadline = time.monotonic() + timeout_s
        while True:
            frame = self._read_one()
            if frame is not None:
                return frame
            remaining = deadline - time.monotonic()
            if remaining <= 0.0 or not self._readable(1000.0 * remaining):
                return None

    def _readable(self, timeout_ms: float) -> bool:
        """Wait for a frame. The supervisor's threads share the bus, and an object of poll serves one of them."""
        try:
            return bool(self._poll.poll(timeout_ms))
        except RuntimeError:
            poll = select.poll()
            poll.register(self._socket, select.POLLIN)
            return bool(poll.poll(timeout_ms))

    def _read_one(self) -> Frame | None:
        while True:
            try:
                packet, ancillary, _, _ = self._socket.recvmsg(CAN_FRAME.size, _ANCILLARY_BYTES)
            except BlockingIOError:
                return None
            except OSError:  # ENETDOWN and its like: a state, until frames flow again
                self.counters.set_down()
                return None
            if len(packet) < CAN_FRAME.size:  # the other end of the socket is gone
                self.counters.set_down()
                return None
            can_id, length, data = CAN_FRAME.unpack(packet)
            if can_id & CAN_ERR_FLAG:
                count_error_frame(self.counters, can_id, data[:length])
                continue
            self.counters.received += 1
            self._newest_ns = max(self._newest_ns, _monotonic_ns(ancillary))  # two clocks never agree: no step back
            return Frame(can_id, data[:length], self._newest_ns)

    def fileno(self) -> int:
        """The socket."""
        return self._socket.fileno()

    def close(self) -> None:
        """Leave the bus."""
        self._socket.close()


def _monotonic_ns(ancillary: list[tuple[int, int, bytes]]) -> int:
    """Kernel stamp of a packet on the scale of CLOCK_MONOTONIC; local time when there is none or it is not credible."""
    wall_ns = time.time_ns()
    now_ns = time.monotonic_ns()  # after the wall clock: who is held up between them must not make a frame older
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(data) >= _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack_from(data)
            age_ns: int = wall_ns - (seconds * NS_PER_S + nanoseconds)
            if 0 <= age_ns < NS_PER_S:
                return now_ns - age_ns
    return now_ns
