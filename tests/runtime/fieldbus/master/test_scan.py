"""Scan and LSS on the virtual axis: configured nodes by SDO, unconfigured ones by fast scan, nothing changed."""

from __future__ import annotations

import struct

from rig import stepped_world

from servod.drivers.virtual.bus_faults import BusFault, FaultKind
from servod.drivers.virtual.world import SteppedWorld
from servod.runtime.fieldbus.cia import LSS_TO_SLAVE_ID, NmtCommand
from servod.runtime.fieldbus.master.network import BusNetwork
from servod.runtime.fieldbus.master.scan import LssIdentity, LssMaster, scan

_CONFIGURE_NODE_ID, _UNCONFIGURED = 0x11, 0xFF


def lss_identity(world: SteppedWorld, node_id: int) -> LssIdentity:
    node = next(node for node in scan(world.connect(), world.clock) if node.node_id == node_id)
    assert node.identity is not None
    return LssIdentity(*(getattr(node.identity, name) for name in LssIdentity._fields))


def forget_node_id(world: SteppedWorld, identity: LssIdentity) -> None:
    """Select one node by its identity, take its id away, and let it restart its communication without one."""
    bus = world.connect()
    network = BusNetwork(bus, world.clock, threaded=False)
    for command, number in zip(range(0x40, 0x44), identity, strict=True):
        network.send_message(LSS_TO_SLAVE_ID, struct.pack("<BI3x", command, number))
    network.wait(lambda: False, 0.01)
    network.send_message(LSS_TO_SLAVE_ID, bytes((_CONFIGURE_NODE_ID, _UNCONFIGURED)).ljust(8, b"\0"))
    network.wait(lambda: False, 0.01)
    LssMaster(network).switch_all(configuration=False)
    network.send_message(0, bytes((NmtCommand.RESET_COMMUNICATION, 0)))
    network.wait(lambda: False, 0.1)
    network.disconnect()


def test_configured_nodes_are_found_with_identity_and_name() -> None:
    world = stepped_world(amplifier_node_id=17, encoder_node_id=127)
    found = scan(world.connect(), world.clock)
    assert [node.node_id for node in found] == [17, 127]
    assert [node.identity.profile for node in found if node.identity] == [402, 406]
    assert all(node.name for node in found)


def test_an_empty_bus_has_no_nodes() -> None:
    world = stepped_world()
    bus = world.connect()
    for node_id in (1, 2):
        bus.inject(BusFault(FaultKind.SILENT, amount=60_000, participant=node_id))
    assert scan(bus, world.clock) == []


def test_a_node_without_id_is_found_by_its_identity_and_left_as_it_was() -> None:
    world = stepped_world(encoder_serial=0xDEADBEEF)
    identity = lss_identity(world, 2)
    forget_node_id(world, identity)
    for _ in range(2):
        found = scan(world.connect(), world.clock)
        assert [(node.node_id, node.lss) for node in found] == [(1, None), (None, identity)]


def test_two_nodes_without_id_are_both_found() -> None:
    world = stepped_world()
    identities = {lss_identity(world, 1), lss_identity(world, 2)}
    for identity in sorted(identities):
        forget_node_id(world, identity)
    assert {node.lss for node in scan(world.connect(), world.clock)} == identities
