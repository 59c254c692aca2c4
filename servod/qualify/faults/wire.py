"""The wire between daemon and virtual axis when both are processes: the hub's Unix socket, or a SocketCAN interface.

Below `processes`. Says how each side is told of the wire, and gives a foreign participant its place on it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from servod.drivers.virtual.client import VirtualBus
from servod.formats.config import BusConfig
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
