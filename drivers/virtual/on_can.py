"""The same nodes on SocketCAN (vcan or a real interface): no hub, the kernel's bus carries the frames.

Each node has its own raw socket, as two devices on one wire have their own controllers.
"""

from __future__ import annotations

import select
import time

from servod.common.units import NS_PER_S
from servod.drivers.virtual.drive_record import DriveRecord
from servod.drivers.virtual.node import Node, Send
from servod.drivers.virtual.port import ErrorState
from servod.drivers.virtual.settings import VirtualAxisSettings
from servod.drivers.virtual.timeline import Timeline
from servod.drivers.virtual.world import Devices
from servod.formats.config import BusConfig
from servod.formats.model.axis_model import AxisModel
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.bus.open import open_bus

_LONGEST_WAIT_S = 0.1
_BURST = 64


class CanServer:
    """The devices on `buses`, the amplifier's and the encoder's connection, until `stop`."""

    def __init__(
        self, settings: VirtualAxisSettings, model: AxisModel, buses: tuple[Bus, Bus], record: DriveRecord | None
    ) -> None:
        self._timeline = Timeline()
        self._buses = buses
        self._devices = Devices(settings, model, self._timeline, record)
        self._devices.build(*(_sender(bus) for bus in self._buses))
        self._bus_off = [False, False]
        self._stopping = False

    def stop(self) -> None:
        """End `run` soon; safe in a signal handler."""
        self._stopping = True

    def run(self) -> None:
        """The loop: wait for frames or the next deadline, serve both."""
        self._devices.power_on(time.monotonic_ns())
        timeline = self._timeline
        while not self._stopping:
            wait_s = (timeline.next_ns() - time.monotonic_ns()) / NS_PER_S
            select.select(self._buses, (), (), min(max(wait_s, 0.0), _LONGEST_WAIT_S))
            for number, (bus, node) in enumerate(zip(self._buses, self._devices.nodes, strict=True)):
                self._serve(number, bus, node)
            now_ns = time.monotonic_ns()
            while timeline.next_ns() <= now_ns:
                timeline.fire_next()

    def close(self) -> None:
        """Leave the interface."""
        for bus in self._buses:
            bus.close()

    def _serve(self, number: int, bus: Bus, node: Node) -> None:
        for _ in range(_BURST):
            frame = bus.receive(0.0)
            if frame is None:
                break
            node.receive(*frame)
        off = bus.counters.bus_off
        if off is not self._bus_off[number]:
            self._bus_off[number] = off
            node.bus_state(ErrorState.BUS_OFF if off else ErrorState.ACTIVE, time.monotonic_ns())


def open_pair(interface: str) -> tuple[Bus, Bus]:
    """One connection for each node. Raises Unreachable when the interface is not there."""
    config = BusConfig(interface="socketcan", channel=interface)
    return open_bus(config), open_bus(config)


def _sender(bus: Bus) -> Send:
    return lambda can_id, data, time_ns: bus.send(can_id, data)
