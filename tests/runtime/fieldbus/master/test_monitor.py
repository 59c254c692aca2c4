"""What the master notices of its nodes: heartbeats that stop, boot-up while operational, EMCY, a node that leaves."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator

import pytest
from witness import Witness, axis_config, master, witness

from servod.common.errors import Unreachable
from servod.common.faults import FaultCode
from servod.runtime.fieldbus.cia import NmtCommand
from servod.runtime.fieldbus.master import Master, NodeEvent

FAST = {"node_period_ms": 20, "node_timeout_ms": 100}


@pytest.fixture
def axis() -> Iterator[tuple[Witness, Master]]:
    with witness() as world, master(world, axis_config(heartbeat=FAST)) as instance:
        instance.bring_up()
        yield world, instance


def events_until(instance: Master, done: Callable[[list[NodeEvent]], bool], limit_s: float = 2.0) -> list[NodeEvent]:
    """Poll as the supervisor does until the events satisfy `done`."""
    seen: list[NodeEvent] = []
    end = time.monotonic() + limit_s
    while time.monotonic() < end and not done(seen):
        instance.poll()
        seen += instance.events()
        time.sleep(0.005)
    return seen


def test_healthy_nodes_make_no_events(axis: tuple[Witness, Master]) -> None:
    assert events_until(axis[1], bool, 0.3) == []


def test_a_lost_heartbeat_is_one_event_for_each_loss(axis: tuple[Witness, Master]) -> None:
    world, instance = axis
    world.encoder.nmt.stop_heartbeat()
    events = events_until(instance, lambda seen: False, 0.4)
    assert [(event.node_id, event.fault) for event in events] == [(2, FaultCode.NODE_HEARTBEAT_LOST)]
    assert [instance.silent(node) for node in (1, 2)] == [False, True]
    world.encoder.nmt.start_heartbeat(20)
    assert events_until(instance, bool, 0.2) == []
    assert not instance.silent(2)
    world.encoder.nmt.stop_heartbeat()
    assert len(events_until(instance, bool)) == 1


def test_a_boot_up_while_operational_is_a_reset(axis: tuple[Witness, Master]) -> None:
    world, instance = axis
    world.amplifier.nmt.stop_heartbeat()
    world.network.send_message(0x701, b"\x00")
    events = events_until(instance, bool)
    assert (events[0].node_id, events[0].fault) == (1, FaultCode.DRIVE_RESET)


def test_a_node_that_leaves_operational_is_seen(axis: tuple[Witness, Master]) -> None:
    world, instance = axis
    world.amplifier.nmt.state = "PRE-OPERATIONAL"
    events = events_until(instance, bool)
    assert (events[0].fault, events[0].code) == (FaultCode.NODE_LEFT_OPERATIONAL, 127)


@pytest.mark.parametrize(("node", "fault"), [(1, FaultCode.DRIVE_FAULT), (2, FaultCode.ENCODER_ALARM)])
def test_emcy_names_its_code_and_meaning(axis: tuple[Witness, Master], node: int, fault: FaultCode) -> None:
    world, instance = axis
    device = world.amplifier if node == 1 else world.encoder
    device.emcy.send(0x8130, 0x11, b"\x01\x02")
    event = events_until(instance, bool)[0]
    assert (event.node_id, event.fault, event.code) == (node, fault, 0x8130)
    assert "EMCY 0x8130 Monitoring, register 0x11, 01 02" in event.text


def test_an_error_that_is_cleared_is_no_event(axis: tuple[Witness, Master]) -> None:
    axis[0].amplifier.emcy.send(0x8130, 0x11)
    assert [event.fault for event in events_until(axis[1], bool)] == [FaultCode.DRIVE_FAULT]
    axis[0].amplifier.emcy.reset()
    assert events_until(axis[1], bool, 0.2) == []
    axis[0].amplifier.emcy.reset()
    assert [event.fault for event in events_until(axis[1], bool)] == [FaultCode.DUPLICATE_NODE]


@pytest.mark.parametrize(
    ("can_id", "data", "said"),
    [
        (0x701, b"", "heartbeat of 0 bytes instead of 1"),
        (0x701, b"\x05\x05", "heartbeat of 2 bytes instead of 1"),
        (0x081, b"\x30\x81", r"EMCY of 2 bytes instead of 8 \(30 81\)"),
        (0x082, b"\x00\x10\x01\x00\x00\x00\x00", "node 2: EMCY of 7 bytes instead of 8"),
    ],
)
def test_frames_of_another_length_than_cia_301_gives_them_are_somebody_elses(
    axis: tuple[Witness, Master], can_id: int, data: bytes, said: str
) -> None:
    world, instance = axis
    world.network.send_message(can_id, data)
    (event,) = events_until(instance, bool)
    assert event.fault is FaultCode.DUPLICATE_NODE and re.search(said, event.text)


def test_a_reset_that_we_ask_for_is_no_event(axis: tuple[Witness, Master]) -> None:
    world, instance = axis
    instance.nmt(NmtCommand.RESET_COMMUNICATION, 1)
    world.network.send_message(0x701, b"\x00")
    assert events_until(instance, bool, 0.2) == []


def test_a_reader_that_ended_is_told(axis: tuple[Witness, Master]) -> None:
    """A thread that dies must not die silently: the next poll says so."""
    _, instance = axis

    def explode(*_: object) -> None:
        raise ValueError("torn frame")

    instance._network.subscribe(0x123, explode)
    axis[0].network.send_message(0x123, b"")
    with pytest.raises(Unreachable, match="bus reader ended: torn frame"):
        events_until(instance, bool)
