"""A client's connection to the virtual bus: `struct can_frame` packets over a Unix socket. Step (1) of the cycle.

Where real hardware has SocketCAN, the virtual axis has this; the loop, the master and python-can come through here. It
stands on the frame codec alone, so that the loop process loads nothing of the virtual world.
"""

from __future__ import annotations

import select
import socket
import struct
import time

from servod.common.errors import Unreachable
from servod.common.files import reason
from servod.drivers.virtual.bus_faults import BusFault, FaultKind
from servod.formats.config import BusConfig
from servod.runtime.fieldbus.bus import CAN_ERR_FLAG, CAN_FRAME, BusCounters, Frame
from servod.runtime.fieldbus.bus.socketcan import count_error_frame

#: What the hub delivers: struct can_frame and the moment (CLOCK_MONOTONIC, ns) at which the frame ended on the bus.
STAMPED_FRAME = struct.Struct("<IB3x8sQ")
#: The kernel's smallest useful buffer: about as many waiting frames as a real transmit queue has.
_SEND_BUFFER_BYTES = 16384


def connect(path: str) -> socket.socket:
    """A socket that is connected to the hub at `path`, not blocking; raises Unreachable."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        sock.connect(path)
    except OSError as error:
        sock.close()
        why = "there is no such socket" if isinstance(error, FileNotFoundError) else reason(error)
        raise Unreachable(f"virtual bus {path}: {why}; is servod-virtual-axis running?") from None
    sock.setblocking(False)
    return sock


class VirtualBus:
    """servod.runtime.fieldbus.bus.Bus over the hub's socket at `channel`. With `can_ids`, only these reach this
    connection (frames that the hub carried before it read the filter excepted).

    Raises Unreachable when no hub serves there.
    """

    def __init__(self, channel: str, can_ids: tuple[int, ...] | None = None) -> None:
        self.counters = BusCounters()
        self._socket = connect(channel)
        for can_id in can_ids or ():
            self.inject(BusFault(FaultKind.ACCEPT, can_id))

    @classmethod
    def configured(cls, config: BusConfig, can_ids: tuple[int, ...] | None = None) -> VirtualBus:
        """The bus that a configuration names; the hub filters. Raises Unreachable."""
        return cls(config.channel, can_ids)

    def send(self, can_id: int, data: bytes) -> bool:
        """Queue one frame; False and counted when the hub does not take it, the bus is off or the hub is gone."""
        counters = self.counters
        if counters.bus_off or counters.down:
            return False
        try:
            self._socket.send(CAN_FRAME.pack(can_id, len(data), data))
        except BlockingIOError:
            counters.queue_full += 1
            return False
        except OSError:
            counters.set_down()
            return False
        counters.sent += 1
        return True

    def receive(self, timeout_s: float = 0.0) -> Frame | None:
        """The next frame, waiting up to `timeout_s`; error frames only change the counters."""
        deadline = 0.0
        while True:
            try:
                packet = self._socket.recv(STAMPED_FRAME.size)
            except BlockingIOError:
                packet = None
            except OSError:
                packet = b""
            if packet:
                frame = self._decode(packet)
                if frame is not None:
                    return frame
                continue
            if packet == b"":
                self.counters.set_down()
            if timeout_s <= 0.0:
                return None
            now = time.monotonic()
            deadline = deadline or now + timeout_s
            if now >= deadline or not self._wait(deadline - now):
                return None

    def inject(self, fault: BusFault) -> bool:
        """Ask the hub for a fault; False when it could not be asked."""
        try:
            self._socket.send(CAN_FRAME.pack(CAN_ERR_FLAG, 8, fault.encode()))
        except OSError:
            return False
        return True

    def happened(self, fault: BusFault, timeout_s: float = 1.0) -> int:
        """How often what `fault` asks for took effect so far; frames that come before the answer are not kept.

        Raises Unreachable when the hub does not answer.
        """
        question = fault._replace(kind=FaultKind.HAPPENED, amount=int(fault.kind))
        deadline = time.monotonic() + timeout_s
        self.inject(question)
        while (left_s := deadline - time.monotonic()) > 0.0 and select.select((self._socket,), (), (), left_s)[0]:
            can_id, _, data, _ = STAMPED_FRAME.unpack(self._socket.recv(STAMPED_FRAME.size))
            answer = BusFault.decode(data) if can_id == CAN_ERR_FLAG else question
            if answer.kind is FaultKind.HAPPENED and answer is not question:
                return answer.amount
        raise Unreachable(f"the hub does not say how often {fault.kind.name} happened")

    def fileno(self) -> int:
        """The socket's descriptor."""
        return self._socket.fileno()

    def close(self) -> None:
        """Leave the bus."""
        self._socket.close()
        self.counters.set_down()

    def _wait(self, timeout_s: float) -> bool:
        """Wait for a packet; a hub that is gone must not turn waiting into a busy loop."""
        if self.counters.down:
            time.sleep(timeout_s)
            return False
        return bool(select.select((self._socket,), (), (), timeout_s)[0])

    def _decode(self, packet: bytes) -> Frame | None:
        can_id, length, data, time_ns = STAMPED_FRAME.unpack(packet)
        if can_id & CAN_ERR_FLAG:
            count_error_frame(self.counters, can_id, data)
            return None
        self.counters.received += 1
        return Frame(can_id, data[:length], time_ns)
