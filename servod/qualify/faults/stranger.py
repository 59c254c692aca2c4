"""What somebody else on the bus does to an axis of processes: frames, a service tool's SDO, requests to the hub.

Below `processes`. Each visit has a place of its own on the wire, and sees by itself what came of it.
"""

from __future__ import annotations

import contextlib
import struct
import time
from collections.abc import Iterator

from servod.common.errors import BadInput
from servod.drivers.virtual.amplifier import AMPLIFIER_EDS
from servod.drivers.virtual.bus_faults import FRAME_KINDS, MYSELF, BusFault, FaultKind
from servod.drivers.virtual.client import VirtualBus
from servod.drivers.virtual.dictionary import Dictionary
from servod.drivers.virtual.encoder import ENCODER_EDS
from servod.qualify.faults.under_test import AMPLIFIER
from servod.qualify.faults.wire import Wire
from servod.runtime.fieldbus.cia import SDO_ANSWER_BASE, SDO_REQUEST_BASE

#: A participant that leaves takes with it what still waits in its queue.
_SENT_S = 0.01
_DOWNLOAD = struct.Struct("<BHB4s")
#: The node's answer to a download, and how long it may take [s] (CiA 301, 7.2.4.3.4).
_CONFIRMED, _ANSWER_S = 0x60, 0.2
#: Faults that concern no participant.
_OF_NOBODY = FRAME_KINDS | {FaultKind.BABBLE, FaultKind.CLEAR}


def send_heard(wire: Wire, can_id: int, data: bytes) -> int:
    """Send one frame; returns how often a third participant heard such a frame meanwhile. Raises Unreachable."""
    with contextlib.closing(wire.foreign()) as sender, contextlib.closing(wire.foreign((can_id,))) as ear:
        sender.send(can_id, data)
        time.sleep(_SENT_S)
        times = 0
        while (heard := ear.receive()) is not None:
            times += (heard.can_id, heard.data) == (can_id, data)
        return times


def download(wire: Wire, node_id: int, index: int, subindex: int, value: int) -> bool:
    """One expedited SDO download; True when the node confirms it. Raises Unreachable."""
    entry = Dictionary(AMPLIFIER_EDS if node_id == AMPLIFIER else ENCODER_EDS).entry(index, subindex)
    entry.value = value
    data = entry.encode()
    head = 0x23 | (4 - len(data)) << 2  # expedited, with its length (CiA 301, 7.2.4.3.3)
    request = _DOWNLOAD.pack(head, index, subindex, data)
    with contextlib.closing(wire.foreign((SDO_ANSWER_BASE + node_id,))) as tool:
        tool.send(SDO_REQUEST_BASE + node_id, request)
        deadline = time.monotonic() + _ANSWER_S
        while time.monotonic() < deadline:
            answer = tool.receive(_ANSWER_S)
            if answer is not None and answer.data[1:4] == request[1:4]:
                return answer.data[0] == _CONFIRMED
    return False


@contextlib.contextmanager
def at_the_hub(wire: Wire, fault: BusFault) -> Iterator[VirtualBus]:
    """Somebody who can ask the hub for `fault`; what shall hit the loop's own connection is not to be had: BadInput."""
    with contextlib.closing(wire.foreign()) as foreign:
        of_the_loop = fault.participant == MYSELF and fault.kind not in _OF_NOBODY
        if of_the_loop or not isinstance(foreign, VirtualBus):
            raise BadInput("bus fault", fault.kind.name, "one that another participant of the hub can ask for")
        yield foreign
