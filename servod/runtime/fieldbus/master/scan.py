"""Finds out who is on a bus: configured nodes by SDO reads, unconfigured ones by LSS. Off the control path."""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from canopen import ObjectDictionary

from servod.common.clock import Clock
from servod.common.errors import Unreachable
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.cia import LSS_FROM_SLAVE_ID, LSS_TO_SLAVE_ID, SDO_ANSWER_BASE, SDO_REQUEST_BASE, Obj301
from servod.runtime.fieldbus.devices import SdoAbort
from servod.runtime.fieldbus.master.network import BusNetwork
from servod.runtime.fieldbus.master.node import NodeIdentity, read_identity
from servod.runtime.fieldbus.master.sdo import NodeSdo

# --- LSS -------------------------------------------------------------------------------------------------------------
# LSS master (CiA 305): finds nodes that have no node id yet, and leaves them as they are. Fast scan finds one
# unconfigured slave by its 128-bit identity, bit by bit: a slave answers when it agrees with all bits so far, so
# silence is an answer too and its time-out is what the scan costs (about 60 silences for a node).


class LssCommand(IntEnum):
    """Command specifiers that are used here (CiA 305)."""

    SWITCH_GLOBAL = 0x04
    IDENTIFY_SLAVE = 0x4F  # answer to fast scan
    IDENTIFY_NON_CONFIGURED_ANSWER = 0x50
    IDENTIFY_NON_CONFIGURED = 0x4C
    FAST_SCAN = 0x51


class LssIdentity(NamedTuple):
    """The LSS address: object 0x1018, sub-index 1 to 4."""

    vendor_id: int
    product_code: int
    revision: int
    serial: int


_WAITING, _CONFIGURATION = 0, 1
_FAST_SCAN = struct.Struct("<BIBBB")
_CONFIRM_ALL = 128  # bit check value that any unconfigured slave answers
_PARTS, _BITS = 4, 32
#: After an answer others may still be on their way; taken for answers to the next request they would falsify it.
_SETTLE_S = 0.005


class LssMaster:
    """LSS services on a network; `answer_s` is how long an answer may take."""

    def __init__(self, network: BusNetwork, answer_s: float = 0.02) -> None:
        self._network = network
        self._answer_s = answer_s
        self._answers: deque[bytes] = deque(maxlen=128)
        network.subscribe(LSS_FROM_SLAVE_ID, self._on_answer)

    def _on_answer(self, _can_id: int, data: bytearray, _time_ns: float) -> None:
        self._answers.append(bytes(data))

    def _ask(self, request: bytes, answer: int) -> bytes | None:
        """Send a request, wait for an answer with this command specifier; None when none came."""
        self._answers.clear()
        self._network.send_message(LSS_TO_SLAVE_ID, request.ljust(8, b"\0"))

        def came() -> bool:
            return any(data and data[0] == answer for data in self._answers)

        if not self._network.wait(came, self._answer_s):
            return None
        self._network.wait(lambda: False, _SETTLE_S)
        return next(data for data in self._answers if data and data[0] == answer)

    def switch_all(self, configuration: bool) -> None:
        """Put all slaves into configuration or waiting state; nobody answers, so they get an answer's time to act."""
        state = _CONFIGURATION if configuration else _WAITING
        self._network.send_message(LSS_TO_SLAVE_ID, bytes((LssCommand.SWITCH_GLOBAL, state)).ljust(8, b"\0"))
        self._network.wait(lambda: False, self._answer_s)

    def unconfigured_present(self) -> bool:
        """Whether any slave without a node id answers (identify non-configured)."""
        request = bytes((LssCommand.IDENTIFY_NON_CONFIGURED,))
        return self._ask(request, LssCommand.IDENTIFY_NON_CONFIGURED_ANSWER) is not None

    def fast_scan(self) -> LssIdentity | None:
        """Identity of one unconfigured slave, which is in configuration state then; None when there is none."""
        if not self._agrees(0, _CONFIRM_ALL, 0, 0):
            return None
        parts = [0] * _PARTS
        for part in range(_PARTS):
            for bit in reversed(range(_BITS)):
                if not self._agrees(parts[part], bit, part, part):
                    parts[part] |= 1 << bit
            if not self._agrees(parts[part], 0, part, (part + 1) % _PARTS):
                return None  # the slave vanished, or two answered and only one agrees with what was found
        return LssIdentity(*parts)

    def _agrees(self, number: int, bit: int, part: int, next_part: int) -> bool:
        request = _FAST_SCAN.pack(LssCommand.FAST_SCAN, number, bit, part, next_part)
        return self._ask(request, LssCommand.IDENTIFY_SLAVE) is not None


_READ_DEVICE_TYPE = b"\x40\x00\x10\x00\x00\x00\x00\x00"
_LAST_NODE_ID = 127
_ANSWER_S = 0.1
_BURST = 8  # requests at once: less than the shortest transmit queue that interfaces come with
_MAX_UNCONFIGURED = 8


@dataclass(frozen=True, slots=True)
class NodeInfo:
    """One node found; `node_id` is None for a node that has none yet (found by LSS)."""

    node_id: int | None
    identity: NodeIdentity | None
    lss: LssIdentity | None
    name: str


def scan(bus: Bus, clock: Clock, threaded: bool = False, lss: bool = True) -> list[NodeInfo]:
    """All nodes that answer, configured ones by rising node id; takes the bus over and closes it.

    Reads only. With `lss` (the default) unconfigured nodes are found by fast scan and left as they were.
    """
    network = BusNetwork(bus, clock, threaded)
    try:
        found = [_read_node(network, node_id) for node_id in _answering(network)]
        return found + (_unconfigured(network) if lss else [])
    finally:
        network.disconnect()


def _answering(network: BusNetwork) -> list[int]:
    """Node ids whose SDO server answers a read of 0x1000, with data or with an abort."""
    answered: set[int] = set()
    for node_id in range(1, _LAST_NODE_ID + 1):
        network.subscribe(SDO_ANSWER_BASE + node_id, lambda can_id, _data, _time: answered.add(can_id & 0x7F))
    for first in range(1, _LAST_NODE_ID + 1, _BURST):
        for node_id in range(first, min(first + _BURST, _LAST_NODE_ID + 1)):
            network.send_message(SDO_REQUEST_BASE + node_id, _READ_DEVICE_TYPE)
        network.wait(lambda: False, _ANSWER_S / _BURST)  # nobody there is the usual case: only the sum matters
    network.wait(lambda: False, _ANSWER_S)
    for node_id in range(1, _LAST_NODE_ID + 1):
        network.unsubscribe(SDO_ANSWER_BASE + node_id)
    return sorted(answered)


def _read_node(network: BusNetwork, node_id: int) -> NodeInfo:
    sdo = NodeSdo(network, node_id, ObjectDictionary())  # type: ignore[no-untyped-call]
    try:
        identity = read_identity(sdo)
    except Unreachable:
        return NodeInfo(node_id, None, None, "(answers, but 0x1018 cannot be read)")
    try:
        name = sdo.read_text(Obj301.DEVICE_NAME)
    except SdoAbort:
        name = ""
    return NodeInfo(node_id, identity, None, name)


def _unconfigured(network: BusNetwork) -> list[NodeInfo]:
    master = LssMaster(network)
    found: list[NodeInfo] = []
    try:
        while master.unconfigured_present() and len(found) < _MAX_UNCONFIGURED:
            identity = master.fast_scan()
            if identity is None or any(node.lss == identity for node in found):
                break
            found.append(NodeInfo(None, None, identity, "(no node id)"))
    finally:
        master.switch_all(configuration=False)
    return found
