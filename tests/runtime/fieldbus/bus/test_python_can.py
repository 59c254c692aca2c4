"""How trouble of a python-can adapter becomes counters: error frames in the kernel's format, and the state asked."""

from __future__ import annotations

import errno
import uuid
from collections.abc import Iterator

import can
import pytest
from can.interfaces.virtual import VirtualBus

from servod.runtime.fieldbus.bus import CAN_ERR_BUSOFF, CAN_ERR_CRTL, CAN_ERR_RESTARTED
from servod.runtime.fieldbus.bus.python_can import PythonCanBus


class Adapter(VirtualBus):
    """python-can's bus in the process, with a controller that can leave the bus and a driver that can refuse."""

    controller = can.BusState.ACTIVE
    refusal: can.CanError | None = None

    @property
    def state(self) -> can.BusState:
        return self.controller

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        self.controller = new_state

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.refusal is not None:
            raise self.refusal
        super().send(msg, timeout)


@pytest.fixture
def ends() -> Iterator[tuple[Adapter, can.BusABC]]:
    channel = uuid.uuid4().hex
    near, far = Adapter(channel), VirtualBus(channel)
    yield near, far
    near.shutdown()
    far.shutdown()


def error(error_class: int = 0, controller: int = 0) -> can.Message:
    data = bytes((0, controller, 0, 0, 0, 0, 0, 0))
    return can.Message(arbitration_id=error_class, data=data, is_error_frame=True, is_extended_id=True)


def test_error_frames_of_the_kernel_are_decoded(ends: tuple[Adapter, can.BusABC]) -> None:
    near, far = ends
    bus = PythonCanBus(near, kernel_errors=True)
    far.send(error(CAN_ERR_CRTL, 0x20))
    far.send(error(CAN_ERR_BUSOFF))
    assert bus.receive(0.05) is None
    counters = bus.counters
    assert (counters.error_frames, counters.error_passive, counters.bus_off, counters.bus_off_events) == (2, 1, 1, 1)
    assert not bus.send(0x80, b"")
    far.send(error(CAN_ERR_RESTARTED))
    assert bus.receive(0.05) is None
    assert not counters.bus_off
    assert bus.send(0x80, b"")


def test_other_adapters_are_asked_for_their_state(ends: tuple[Adapter, can.BusABC]) -> None:
    near, far = ends
    bus = PythonCanBus(near, kernel_errors=False)
    far.send(error(CAN_ERR_BUSOFF))  # means something else there
    assert bus.receive(0.05) is None
    assert (bus.counters.error_frames, bus.counters.bus_off) == (1, False)
    near.controller = can.BusState.ERROR
    far.send(error())
    assert bus.receive(0.05) is None
    assert (bus.counters.bus_off, bus.counters.bus_off_events) == (True, 1)
    near.controller = can.BusState.ACTIVE
    assert bus.send(0x80, b"")  # back by itself
    assert not bus.counters.bus_off


@pytest.mark.parametrize(
    ("controller", "refusal", "full", "off", "down"),
    [
        (can.BusState.ACTIVE, can.CanOperationError("Transmit buffer full"), 1, False, False),
        (can.BusState.ERROR, can.CanOperationError("not sent"), 0, True, False),
        (can.BusState.ACTIVE, can.CanOperationError("Failed to transmit", errno.ENETDOWN), 0, False, True),
    ],
)
def test_a_refused_frame_says_why(
    ends: tuple[Adapter, can.BusABC],
    controller: can.BusState,
    refusal: can.CanError,
    full: int,
    off: bool,
    down: bool,
) -> None:
    near, _ = ends
    bus = PythonCanBus(near, kernel_errors=False)
    near.controller, near.refusal = controller, refusal
    assert not bus.send(0x80, b"")
    assert (bus.counters.queue_full, bus.counters.bus_off, bus.counters.down) == (full, off, down)
    near.controller, near.refusal = can.BusState.ACTIVE, None
    assert bus.send(0x80, b"")
    assert not (bus.counters.bus_off or bus.counters.down)
