"""Opens the bus that the configuration names; the only place that knows which class stands behind which interface.

The classes are imported here on demand: the loop on SocketCAN loads neither python-can nor the virtual world.
"""

from __future__ import annotations

from servod.formats.config import BusConfig
from servod.runtime.fieldbus.bus import Bus


def open_bus(config: BusConfig, can_ids: tuple[int, ...] | None = None) -> Bus:
    """A new connection to the bus; `can_ids` limits reception where the bus can filter (SocketCAN, virtual).

    Raises Unreachable when the interface, the hub's socket or python-can's driver is not there.
    """
    if config.interface == "socketcan":
        from servod.runtime.fieldbus.bus.socketcan import SocketCanBus

        return SocketCanBus.open(config.channel, can_ids)
    if config.interface == "virtual":
        from servod.drivers.virtual.client import VirtualBus

        bus: Bus = VirtualBus(config.channel, can_ids)
        return bus
    from servod.runtime.fieldbus.bus.python_can import PythonCanBus

    return PythonCanBus.open(config.interface, config.channel, config.bit_rate, config.options)
