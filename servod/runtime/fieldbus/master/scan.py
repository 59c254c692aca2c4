"""Finds out who is on a bus: configured nodes by SDO reads, unconfigured ones by LSS. Off the control path."""

from __future__ import annotations

from dataclasses import dataclass

from canopen import ObjectDictionary

from servod.common.clock import Clock
from servod.common.errors import Unreachable
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.cia import SDO_ANSWER_BASE, SDO_REQUEST_BASE, Obj301
from servod.runtime.fieldbus.devices import SdoAbort
from servod.runtime.fieldbus.master.lss import LssIdentity, LssMaster
from servod.runtime.fieldbus.master.network import BusNetwork
from servod.runtime.fieldbus.master.node import NodeIdentity, read_identity
from servod.runtime.fieldbus.master.sdo import NodeSdo

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
