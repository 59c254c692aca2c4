"""The virtual bus as a python-can interface, `servod_virtual`: for canopen, can.viewer and every other tool.

Beside the data path; servod itself never comes through here. `can.Bus(interface="servod_virtual", channel=PATH)`.
"""

from __future__ import annotations

import select
import time
from typing import Any

import can

from servod.common.errors import Unreachable
from servod.drivers.virtual.client import STAMPED_FRAME, connect
from servod.runtime.fieldbus.bus import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_FRAME, CAN_RTR_FLAG

_ID_MASK = 0x1FFFFFFF
#: How long `send` waits for a full queue unless told: a full one is empty again within some 10 ms at 1 Mbit/s.
SEND_TIMEOUT_S = 1.0


class VirtualAxisBus(can.BusABC):
    """python-can bus on the hub's socket; `channel` is its path. Raises can.CanInitializationError."""

    def __init__(self, channel: str, can_filters: Any = None, **kwargs: Any) -> None:
        try:
            self._socket = connect(str(channel))
        except Unreachable as error:
            self._is_shutdown = True
            raise can.CanInitializationError(str(error)) from None
        self.channel_info = f"servod virtual bus {channel}"
        self._can_protocol = can.CanProtocol.CAN_20
        super().__init__(channel=channel, can_filters=can_filters, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one message; raises can.CanOperationError when the hub's queue stays full for `timeout` s.

        Without a time it waits for SEND_TIMEOUT_S, so that tools may send many frames at once.
        """
        flags = (CAN_EFF_FLAG if msg.is_extended_id else 0) | (CAN_RTR_FLAG if msg.is_remote_frame else 0)
        packet = CAN_FRAME.pack(msg.arbitration_id | flags, msg.dlc, bytes(msg.data))
        deadline = time.monotonic() + (SEND_TIMEOUT_S if timeout is None else timeout)
        try:
            while not self._send_now(packet):
                if not select.select((), (self._socket,), (), max(0.0, deadline - time.monotonic()))[1]:
                    raise can.CanOperationError("transmit queue full")
        except OSError as error:
            raise can.CanOperationError(f"virtual bus: {error.strerror}") from None

    def _send_now(self, packet: bytes) -> bool:
        """Whether the socket took the packet."""
        try:
            self._socket.send(packet)
        except BlockingIOError:
            return False
        return True

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """The next message within `timeout` s (None: for ever); filtering is left to python-can."""
        if not select.select((self._socket,), (), (), timeout)[0]:
            return None, False
        try:
            packet = self._socket.recv(STAMPED_FRAME.size)
        except OSError as error:
            raise can.CanOperationError(f"virtual bus: {error.strerror}") from None
        if not packet:
            raise can.CanOperationError("virtual bus: the hub is gone")
        can_id, length, data, time_ns = STAMPED_FRAME.unpack(packet)
        message = can.Message(
            timestamp=time.time() + (time_ns - time.monotonic_ns()) / 1e9,
            arbitration_id=can_id & _ID_MASK,
            is_extended_id=bool(can_id & CAN_EFF_FLAG),
            is_remote_frame=bool(can_id & CAN_RTR_FLAG),
            is_error_frame=bool(can_id & CAN_ERR_FLAG),
            dlc=length,
            data=b"" if can_id & CAN_RTR_FLAG else data[:length],
            channel=str(self.channel_info),
        )
        return message, False

    def fileno(self) -> int:
        """The socket's descriptor, for can.Notifier on an event loop."""
        return int(self._socket.fileno())

    def shutdown(self) -> None:
        """Leave the bus."""
        super().shutdown()
        self._socket.close()
