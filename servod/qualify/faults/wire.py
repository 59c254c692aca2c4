"""The wire between daemon and virtual axis when both are processes: the hub's Unix socket, or a SocketCAN interface.

Below `processes`. Says how each side is told of the wire, and gives a foreign participant its place on it.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol

from servod.common.errors import BadInput
from servod.drivers.virtual.bus_faults import FRAME_KINDS, MYSELF, BusFault, FaultKind
from servod.drivers.virtual.client import VirtualBus
from servod.formats.config_wire import BusConfig
from servod.runtime.fieldbus.bus import Bus
from servod.runtime.fieldbus.bus.open import open_bus

#: An identifier that nobody sends.
NOTHING = (0x7FF,)


class Wire(Protocol):
    """One bus that processes share."""

    def axis_options(self) -> list[str]:
        """Arguments of servod-virtual-axis that put it on this bus."""
        ...

    def bus_config(self) -> dict[str, Any]:
        """Section `bus` of the daemon's configuration."""
        ...

    def foreign(self, can_ids: tuple[int, ...] = NOTHING) -> Bus:
        """A new participant that hears these identifiers and sends what it likes. Raises Unreachable."""
        ...


class HubWire:
    """The virtual bus: the hub lives in the virtual axis and carries out faults on demand."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "bus"

    def axis_options(self) -> list[str]:
        """Serve at the socket."""
        return ["--socket", str(self.path)]

    def bus_config(self) -> dict[str, Any]:
        """Join at the socket."""
        return {"interface": "virtual", "channel": str(self.path)}

    def foreign(self, can_ids: tuple[int, ...] = NOTHING) -> VirtualBus:
        """A client of the hub."""
        return VirtualBus(str(self.path), can_ids)


class CanWire:
    """A SocketCAN interface, vcan0 in the guest."""

    def __init__(self, interface: str) -> None:
        self.interface = interface

    def axis_options(self) -> list[str]:
        """Join the interface."""
        return ["--can", self.interface]

    def bus_config(self) -> dict[str, Any]:
        """Join the interface."""
        return {"interface": "socketcan", "channel": self.interface}

    def foreign(self, can_ids: tuple[int, ...] = NOTHING) -> Bus:
        """A raw socket of its own."""
        return open_bus(BusConfig(interface="socketcan", channel=self.interface), can_ids)


# --- Others on the bus -----------------------------------------------------------------------------------------------
# What somebody else on the bus does to an axis of processes: frames, requests to the hub. Each visit has a place of its
# own on the wire, and sees by itself what came of it.


#: A participant that leaves takes with it what still waits in its queue.
_SENT_S = 0.01
#: Faults that concern no participant.
_OF_NOBODY = FRAME_KINDS | {FaultKind.BABBLE, FaultKind.CLEAR, FaultKind.WRITE}


def send_heard(wire: Wire, can_id: int, data: bytes) -> int:
    """Send one frame; returns how often a third participant heard such a frame meanwhile. Raises Unreachable."""
    with contextlib.closing(wire.foreign()) as sender, contextlib.closing(wire.foreign((can_id,))) as ear:
        sender.send(can_id, data)
        time.sleep(_SENT_S)
        times = 0
        while (heard := ear.receive()) is not None:
            times += (heard.can_id, heard.data) == (can_id, data)
        return times


@contextlib.contextmanager
def at_the_hub(wire: Wire, fault: BusFault) -> Iterator[VirtualBus]:
    """Somebody who can ask the hub for `fault`; what shall hit the loop's own connection is not to be had: BadInput."""
    with contextlib.closing(wire.foreign()) as foreign:
        of_the_loop = fault.participant == MYSELF and fault.kind not in _OF_NOBODY
        if of_the_loop or not isinstance(foreign, VirtualBus):
            raise BadInput("bus fault", fault.kind.name, "one that another participant of the hub can ask for")
        yield foreign
