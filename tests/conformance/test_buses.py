"""The contract of servod.runtime.fieldbus.bus.Bus, for every kind of bus."""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Iterator

import pytest
from buses_under_test import BUSES, Wire, hub, stepped
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from servod.common.errors import Unreachable
from servod.drivers.virtual.bus_faults import BusFault, FaultKind
from servod.formats.config import BusConfig
from servod.runtime.fieldbus.bus import (
    CAN_ERR_BUSOFF,
    CAN_ERR_CRTL,
    CAN_ERR_FLAG,
    CAN_ERR_RESTARTED,
    CAN_FRAME,
    Bus,
    Frame,
)
from servod.runtime.fieldbus.bus.open import open_bus
from servod.runtime.fieldbus.bus.socketcan import SocketCanBus

WAIT_S = 0.5
#: NMT, SYNC, SDO requests to nodes 1 and 2, LSS: the nodes of a virtual axis that is on the bus too answer these.
ANSWERED = {0x000, 0x080, 0x601, 0x602, 0x7E5}


@pytest.fixture(params=list(BUSES))
def wire(request: pytest.FixtureRequest) -> Iterator[Wire]:
    with BUSES[request.param]() as pair:  # type: ignore[attr-defined]
        yield pair


def take(bus: Bus, count: int) -> list[Frame]:
    frames = [bus.receive(WAIT_S) for _ in range(count)]
    assert None not in frames
    return [frame for frame in frames if frame is not None]


def test_a_frame_reaches_the_other_and_not_its_sender(wire: Wire) -> None:
    assert wire.one.send(0x123, b"\x01\x02\x03")
    (frame,) = take(wire.other, 1)
    assert (frame.can_id, frame.data) == (0x123, b"\x01\x02\x03")
    assert wire.one.receive(0.0) is None


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(can_id=st.sampled_from([i for i in range(0x800) if i not in ANSWERED]), data=st.binary(max_size=8))
def test_every_identifier_and_length_comes_back_as_it_was(wire: Wire, can_id: int, data: bytes) -> None:
    assert wire.other.send(can_id, data)
    (frame,) = take(wire.one, 1)
    assert (frame.can_id, frame.data) == (can_id, data)


def test_frames_with_one_identifier_keep_their_order(wire: Wire) -> None:
    for number in range(10):
        assert wire.one.send(0x200, bytes([number]))
    assert [frame.data[0] for frame in take(wire.other, 10)] == list(range(10))


def test_without_a_frame_nothing_comes_and_nothing_blocks(wire: Wire) -> None:
    started = time.monotonic()
    assert wire.one.receive() is None
    assert wire.one.receive(0.02) is None
    assert time.monotonic() - started < WAIT_S


def test_counters_count(wire: Wire) -> None:
    for _ in range(3):
        wire.one.send(0x10, b"")
    take(wire.other, 3)
    assert (wire.one.counters.sent, wire.other.counters.received) == (3, 3)
    assert not (wire.one.counters.bus_off or wire.one.counters.down or wire.one.counters.queue_full)


def test_stamps_rise_and_lie_between_sending_and_taking(wire: Wire) -> None:
    before_ns = time.monotonic_ns()
    for _ in range(3):
        wire.one.send(0x7F, bytes(8))
    stamps = [frame.time_ns for frame in take(wire.other, 3)]
    assert stamps == sorted(stamps)
    if wire.wall:
        look_ahead_ns = 2_000_000  # the hub's modelled bus may run ahead of the wall clock
        assert before_ns <= stamps[0]
        assert stamps[-1] <= time.monotonic_ns() + look_ahead_ns


def test_a_queue_that_nobody_empties_fills_without_blocking_or_raising(wire: Wire) -> None:
    started, taken, limit = time.monotonic(), True, 20_000
    for _ in range(limit):
        taken = wire.one.send(0x1, bytes(8))
        if not taken:
            break
    assert time.monotonic() - started < 5.0
    if wire.bounded:
        assert wire.one.counters.queue_full == (0 if taken else 1)


def test_sending_after_the_end_is_false_and_not_an_exception(wire: Wire) -> None:
    wire.other.close()
    wire.one.close()
    assert wire.one.send(0x1, b"") is False


@pytest.fixture
def raw() -> Iterator[tuple[SocketCanBus, socket.socket]]:
    """SocketCAN's code, and the bare other end to send what the kernel sends."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    bus = SocketCanBus(near)
    yield bus, far
    bus.close()
    far.close()


def error_frame(error_class: int, controller: int = 0) -> bytes:
    return CAN_FRAME.pack(CAN_ERR_FLAG | error_class, 8, bytes((0, controller, 0, 0, 0, 0, 0, 0)))


def test_bus_off_and_restart_are_states(raw: tuple[SocketCanBus, socket.socket]) -> None:
    bus, kernel = raw
    kernel.send(error_frame(CAN_ERR_BUSOFF))
    assert bus.receive(0.1) is None
    assert bus.counters.bus_off
    assert not bus.send(0x80, b"")
    kernel.send(error_frame(CAN_ERR_RESTARTED))
    assert bus.receive(0.1) is None
    assert not bus.counters.bus_off
    assert bus.send(0x80, b"")
    assert bus.counters.error_frames == 2


def test_a_bus_off_that_is_over_before_anybody_looks_is_counted(raw: tuple[SocketCanBus, socket.socket]) -> None:
    bus, kernel = raw
    for _ in range(2):
        kernel.send(error_frame(CAN_ERR_BUSOFF))
        kernel.send(error_frame(CAN_ERR_RESTARTED))
    assert bus.receive(0.1) is None
    assert not bus.counters.bus_off
    assert bus.counters.bus_off_events == 2


class _Downed(socket.socket):
    """A socket whose next read says that the interface is down, as the kernel does once after `ip link set down`."""

    down = False

    def recvmsg(self, *arguments: int) -> tuple[bytes, list[tuple[int, int, bytes]], int, object]:
        if self.down:
            self.down = False
            raise OSError(errno.ENETDOWN, "Network is down")
        return super().recvmsg(*arguments)


def test_an_interface_that_was_down_for_a_moment_is_counted() -> None:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    downed = _Downed(near.family, near.type, fileno=near.detach())
    bus = SocketCanBus(downed)
    downed.down = True
    assert bus.receive(0.0) is None
    assert bus.counters.down
    assert bus.send(0x80, b"")  # up again before anybody looked
    assert (bus.counters.down, bus.counters.down_events) == (False, 1)
    bus.close()
    far.close()


def test_a_bus_off_in_the_stepped_world_is_counted() -> None:
    with stepped() as wire:
        wire.one.inject(BusFault(FaultKind.BUS_OFF))  # type: ignore[attr-defined]
        wire.one.receive(0.01)
        assert (wire.one.counters.bus_off, wire.one.counters.bus_off_events) == (True, 1)


@pytest.mark.parametrize(("controller", "passive", "full"), [(0x10, True, 0), (0x20, True, 0), (0x02, False, 1)])
def test_controller_trouble_is_decoded(
    raw: tuple[SocketCanBus, socket.socket], controller: int, passive: bool, full: int
) -> None:
    bus, kernel = raw
    kernel.send(error_frame(CAN_ERR_CRTL, controller))
    bus.receive(0.1)
    assert (bus.counters.error_passive, bus.counters.queue_full) == (passive, full)
    kernel.send(error_frame(CAN_ERR_CRTL, 0x40))
    bus.receive(0.1)
    assert not bus.counters.error_passive


def test_an_error_frame_does_not_hide_the_data_behind_it(raw: tuple[SocketCanBus, socket.socket]) -> None:
    bus, kernel = raw
    kernel.send(error_frame(CAN_ERR_CRTL, 0x40))
    kernel.send(CAN_FRAME.pack(0x181, 2, b"\x01\x02"))
    frame = bus.receive(0.1)
    assert frame is not None
    assert (frame.can_id, frame.data) == (0x181, b"\x01\x02")


def test_a_wire_that_is_gone_is_a_state(raw: tuple[SocketCanBus, socket.socket]) -> None:
    bus, kernel = raw
    kernel.close()
    assert bus.receive(0.1) is None
    assert bus.counters.down
    assert not bus.send(0x1, b"")


def test_bus_off_on_the_virtual_bus_is_the_same_state() -> None:
    with hub() as wire:
        wire.one.inject(BusFault(FaultKind.BUS_OFF))  # type: ignore[attr-defined]
        assert wire.one.receive(0.1) is None
        assert wire.one.counters.bus_off
        assert not wire.one.send(0x80, b"")
        assert wire.other.send(0x80, b"")


@pytest.mark.parametrize(
    ("interface", "channel"),
    [
        ("virtual", "/nonexistent/bus"),
        ("socketcan", "nocan9"),
        ("no_such_interface", "0"),
        ("slcan", "/dev/nonexistent"),
    ],
)
def test_a_bus_that_cannot_be_opened_is_unreachable_in_one_line(interface: str, channel: str) -> None:
    with pytest.raises(Unreachable, match=channel) as refusal:
        open_bus(BusConfig(interface=interface, channel=channel))
    assert "\n" not in str(refusal.value)
