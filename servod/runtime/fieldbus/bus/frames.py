"""What error frames mean for a connection: one table from the kernel's error classes to BusCounters.

Used by every bus client that receives `struct can_frame` (SocketCAN and the virtual bus). Source: linux/can/error.h.
"""

from __future__ import annotations

from servod.runtime.fieldbus.bus import CAN_ERR_BUSOFF, CAN_ERR_CRTL, CAN_ERR_RESTARTED, BusCounters

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
